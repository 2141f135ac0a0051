"""Draw the windows of all sectors of a view: rasterise and shade each."""

from __future__ import annotations

from sonar_gl.core.compiled import compiled
from sonar_gl.raster.cpu.kernels.rasterization import make_room, rasterize
from sonar_gl.raster.cpu.kernels.shading import shade


@compiled
def draw_windows(
    chosen,
    found,
    patches,
    vertices,
    placed,
    views,
    part,
    limits,
    memory,
    bodies_seen,
    image,
    lobes,
    is_met,
    lit,
):
    """Draw some columns of the window of each of S sectors into an image.

    One call draws all sectors: to hand arrays over takes as long as to draw a sector of side lobes.

    chosen, found : of `choose_in_sectors`; windows lie in the image side by side
    patches, vertices, placed, limits : as for `rasterize`
    views : of each sector, tuple of SectorGeometry, whose parts are stacked
    part : (2,) which of how many parts of the columns
    memory : depth and triangle, flat, of the largest VisibilityBuffer, and tuple of Triangles of the most faces
    bodies_seen, image, lobes : as for `shade`
    is_met : (S,) bool, overwritten: whether any sample of the sector may meet something
    lit : (S, 4) int64, overwritten: what `shade` returns of each sector, columns counted from those of its window
    """
    (depth, triangle, triangles), left, room = memory, 0, make_room()
    for s in range(found.shape[0]):
        i, j, columns, rows = found[s, 2], found[s, 3], found[s, 4], found[s, 5]
        first, last = part[0] * columns // part[1], (part[0] + 1) * columns // part[1]
        is_met[s] = False
        lit[s, 0], lit[s, 1], lit[s, 2], lit[s, 3] = columns, 0, rows, 0
        if first < last:
            view = (views[0][s], views[1][s], views[2][s], views[3][s], views[4][s], views[5][s], views[6][s])
            extent = i + first, i + last - 1, j, j + rows - 1
            count, shape = rows * (last - first), (rows, last - first)
            buffer = depth[:count].reshape(shape), triangle[:count].reshape(shape)
            n = rasterize(
                chosen[s, : found[s, 0]],
                patches,
                vertices,
                placed,
                view,
                extent,
                limits,
                buffer,
                triangles,
                room,
            )
            is_met[s] = n > 0
            low, past, bottom, top = shade(
                buffer, triangles, view, extent, bodies_seen, left + first, image, lobes
            )
            if low < past:
                lit[s, 0], lit[s, 1], lit[s, 2], lit[s, 3] = first + low, first + past, bottom, top
        left += columns
