"""The raster engine for machines without a graphics card: compiled code, without OpenGL."""
