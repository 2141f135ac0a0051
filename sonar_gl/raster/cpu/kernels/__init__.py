"""The compiled rasteriser: triangles of patches to samples, by a visibility buffer.

| module | what it does | entry functions |
| --- | --- | --- |
| `tables` | what the others read and write | |
| `rasterization` | finds the nearest triangle of each sample | |
| `shading` | finds the echoes and specular lobes of the samples | `write_lobes` |
| `windows` | rasterises and shades the windows of all sectors | `draw_windows` |

A visibility buffer holds 1/x and a triangle for each sample. Only the triangles that win are shaded.

Sources: Burns, Hunt, "The Visibility Buffer", J. Computer Graphics Techniques 2(2), 2013; Olano, Greer, "Triangle Scan
Conversion using 2D Homogeneous Coordinates", Graphics Hardware 1997, for triangles with corners behind the sonar.
"""
