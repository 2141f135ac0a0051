"""The contents of the water (bodies, bubble plumes, materials), and the readers of scene files."""
