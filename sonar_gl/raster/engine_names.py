"""The engines that can be asked for. Imports nothing, since the command line names them in its help."""

ENGINES = ("auto", "opengl", "cpu")  # "auto" takes OpenGL where there is a graphics card, otherwise the CPU
