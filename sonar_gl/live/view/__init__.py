"""The web page of a live session: the scene in 3D, the ping beside it, and controls."""
