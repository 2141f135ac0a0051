"""OpenGL without a window, and in the context of a host program."""
