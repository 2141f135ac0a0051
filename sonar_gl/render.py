"""Scene to G-buffer: the only stage that draws."""

from __future__ import annotations

from dataclasses import replace

import moderngl
import numpy as np

from sonar_gl.cull import merge
from sonar_gl.draws import LOBE, Draws, SectorView
from sonar_gl.echo import plane_of
from sonar_gl.fan import Fan
from sonar_gl.footprint import FAR_FACTOR
from sonar_gl.gpu import SceneOnGpu
from sonar_gl.stock import NEAR_M
from sonar_gl.types import Error, GBuffer

NOTHING = np.empty((0, 0, 4), np.float32), np.empty((0, 0), np.uint16)
CLIP_DISTANCE, ALL = 0x3000, (0.0, 0.0, 0.0, 1.0)  # GL_CLIP_DISTANCE0, and a plane that leaves nothing out
MAX_SAMPLES = 1 << 24  # drawn at a time: 16 bytes each in the driver, and as many here


class Picture:
    """A framebuffer, arrays of its size to read it into, and what was drawn into it.

    Attributes
    ----------
    width, height : in use; 0 before anything was drawn
    parts : of each sector its `SectorView`, window, column of the picture where that begins, and its samples
        that need no drawing
    plane_echo, body_id : (height, width, 4) and (height, width)
    """

    def __init__(self):
        self.size, self.width, self.height, self.parts, self.labels = (0, 0), 0, 0, [], False
        self.plane_echo, self.body_id = NOTHING

    def fit(self, context, size):
        """Be of a size."""
        if self.size == size:
            return
        self.size, self.arrays = size, {}
        plane_echo = context.renderbuffer(size, 4, dtype="f4")
        body_id = context.renderbuffer(size, 1, dtype="u2")
        depth = context.depth_renderbuffer(size)
        self.framebuffers = {
            False: context.framebuffer([plane_echo], depth),
            True: context.framebuffer([plane_echo, body_id], depth),
        }

    def clear(self):
        framebuffer = self.framebuffers[self.labels]
        framebuffer.use()
        framebuffer.clear(depth=1.0, viewport=(0, 0, self.width, self.height))
        return framebuffer

    def read(self):
        """Have what was drawn in the arrays."""
        self.plane_echo = self._read(4, "f4", 0)
        self.body_id = self._read(1, "u2", 1)[..., 0] if self.labels else NOTHING[1]

    def _read(self, components, dtype, attachment):
        if components not in self.arrays:
            self.arrays[components] = np.zeros(self.size[0] * self.size[1] * components, dtype)
        out = self.arrays[components][: self.width * self.height * components]
        self.framebuffers[self.labels].read_into(
            out,
            viewport=(0, 0, self.width, self.height),
            components=components,
            dtype=dtype,
            attachment=attachment,
            alignment=1,
        )
        return out.reshape(self.height, self.width, components)


class Renderer:
    """Draws a fan's sectors side by side, a picture for each pose, and reads them back.

    Of each sector only the window that holds bodies is drawn. Lobes of smooth bodies are added if `specular`.
    """

    def __init__(self, context: moderngl.Context, gpu: SceneOnGpu, fan: Fan, specular: bool = False):
        self.context, self.gpu, self.fan, self.specular = context, gpu, fan, specular
        self.far_m = FAR_FACTOR * fan.sonar.range_max_m
        self.limit = min(context.info["GL_MAX_TEXTURE_SIZE"], *context.info["GL_MAX_VIEWPORT_DIMS"])
        self._check_size(max(s.columns for s in fan.sectors), max(s.rows for s in fan.sectors))
        self.sectors = [SectorView(sector) for sector in fan.sectors]
        self.out, self.uniforms, self.size = Draws(), {}, (0, 0)
        self.pictures, self.others, self.drawn = [], [], []

    @property
    def windows(self) -> list:
        """First column, first row, columns and rows of each sector that were drawn last."""
        return [part[1] for picture in self.drawn for part in picture.parts]

    def turn(self):
        """Draw the next pictures beside the last ones: `views` of those stay as they are once more."""
        self.pictures, self.others = self.others, self.pictures

    def render(self, poses, wheres=(None,), labels: bool = False, whole: bool = False, planes=None):
        """Draw all sectors as seen from some poses, world_from_sonar, and read them back.

        The arrays behind `views` are used again by the next call.

        Parameters
        ----------
        poses, wheres : of the sonar, and for each the Whereabouts of the bodies, or None
        labels : read the bodies' numbers too
        whole : draw the empty water, too
        planes : of each pose a plane before which all lies that is drawn, or None: the water's surface
        """
        gpu, out = self.gpu, self.out
        planes = planes or [None] * len(poses)
        placed = [gpu.stock.place(*spot, self.specular) for spot in zip(poses, wheres, planes, strict=True)]
        rows = placed[0].rows if len(placed) == 1 else np.concatenate([one.rows for one in placed])
        self.pictures += [Picture() for _ in placed[len(self.pictures) :]]
        self.drawn = self.pictures[: len(placed)]
        out.clear()
        draws = [self._lay(*pair, whole) for pair in zip(self.drawn, enumerate(placed), strict=True)]
        self._fit(max(one.width for one in self.drawn), max(one.height for one in self.drawn))
        if out.counts["draws"]:
            gpu.upload(rows, out)
        for picture, parts, seen in zip(self.drawn, draws, placed, strict=True):
            picture.labels = labels
            if picture.width:
                picture.fit(self.context, self.size)
                self._draw(picture, picture.clear(), rows, parts, seen.plane)
        for picture in self.drawn:  # while one is read the driver's threads may fill the next
            if picture.width:
                picture.read()
                for _, (i, j, *_), left, mine in picture.parts:
                    samples = out.places[mine], out.values[mine], out.bodies[mine]
                    merge(*samples, i, j, left, picture.plane_echo, picture.body_id)

    def _lay(self, picture, numbered, whole: bool) -> list:
        """Find what a picture shows and lay its sectors side by side; each one's draws."""
        (number, placed), stock, out = numbered, self.gpu.stock, self.out
        n_bodies, draws = len(stock.bodies), []
        picture.parts, picture.width, picture.height = [], 0, 0
        for view in self.sectors:
            first, n_closed, n, window = 0, 0, 0, (0, 0, 0, 0)
            begin = out.counts["samples"]
            if n_bodies:
                reach = self.far_m, self.fan.sonar.range_max_m
                first, n_closed, n, window = stock.see(view, placed, *reach, number * n_bodies, out)
            if whole:
                window = (0, 0, view.sector.columns, view.sector.rows)
            picture.parts.append((view, window, picture.width, slice(begin, out.counts["samples"])))
            draws.append((first, n_closed if placed.outside else 0, n))
            picture.width, picture.height = picture.width + window[2], max(picture.height, window[3])
        return draws

    def _draw(self, picture, framebuffer, rows, draws, plane):
        array = self.gpu.array(picture.labels, bool(rows[:, LOBE].any()))
        array.program["before"].write(np.asarray(ALL if plane is None else plane, np.float32))
        self.context.enable_direct(CLIP_DISTANCE)
        for (view, (i, j, columns, n_rows), left, _), (first, split, n) in zip(
            picture.parts, draws, strict=True
        ):
            if n == 0:
                continue
            sector = view.sector
            framebuffer.viewport = (left - i, -j, sector.columns, sector.rows)
            framebuffer.scissor = (left, 0, columns, n_rows)
            for name, value in self._uniforms(array.program, view):
                array.program[name].write(value)
            for name in ("u", "v"):  # pixels count from the framebuffer's corner
                u = getattr(sector, name)
                array.program[name] = (u[0] + u[1] * (i - left) + u[2] * j, u[1], u[2])
            self.gpu.draw(array, moderngl.DEPTH_TEST | moderngl.CULL_FACE, rows, self.out, first, split)
            self.gpu.draw(array, moderngl.DEPTH_TEST, rows, self.out, first + split, n - split)
        framebuffer.scissor = None
        self.context.disable_direct(CLIP_DISTANCE)

    def _check_size(self, width: int, height: int):
        got = f"(got {width} columns by {height} rows; ask for a larger tolerance or fewer samples)"
        if max(width, height) > self.limit:
            raise Error(f"samples must fit the driver's limit of {self.limit} by {self.limit} pixels {got}")

    def _fit(self, width: int, height: int):
        """Have room for so many pixels in a picture."""
        self._check_size(width, height)
        if width * height > MAX_SAMPLES:
            raise Error(
                f"samples with bodies before them must be no more than {MAX_SAMPLES} (got {width} columns "
                f"by {height} rows; ask for a larger tolerance or fewer samples)"
            )
        if width > self.size[0] or height > self.size[1]:
            # a little more, so that a window that grows does not ask for new ones every time
            self.size = tuple(
                min(max(old, 64 * -(-new // 64)), self.limit)
                for old, new in zip(self.size, (width, height), strict=True)
            )

    def _uniforms(self, program, view) -> list[tuple[str, bytes]]:
        """What a program needs to know of a sector; the same for every ping."""
        key = (program.glo, id(view))
        if key not in self.uniforms:
            values = {
                "clip_from_sonar": view.sector.projection(NEAR_M, self.far_m).T,
                "sector_from_sonar": view.sector.rotation().T,
                "pixel_from_uv": view.inverse.T,
                "far_m": self.far_m,
            }
            self.uniforms[key] = [
                (name, np.ascontiguousarray(value, np.float32).tobytes())
                for name, value in values.items()
                if name in program
            ]
        return self.uniforms[key]

    def views(self):
        """(sector, (R, C, 4) plane and echo, (R, C) body) of each sector, of the last render.

        The sector is that of the window: its lattice begins there.
        """
        for picture in self.drawn:
            for view, (i, j, columns, rows), left, _ in picture.parts:
                sector = view.sector
                if columns == 0:
                    yield replace(sector, columns=0, rows=0), *NOTHING
                    continue
                here = (slice(0, rows), slice(left, left + columns))
                u, v = (np.array([w[0] + w[1] * i + w[2] * j, w[1], w[2]]) for w in (sector.u, sector.v))
                cut = replace(sector, u=u, v=v, columns=columns, rows=rows)
                yield cut, picture.plane_echo[here], picture.body_id[here] if picture.labels else NOTHING[1]

    def gbuffers(self) -> list[GBuffer]:
        """What was read, one `GBuffer` a sector."""
        out = []
        for sector, plane_echo, body_id in self.views():
            u, v = sector.rays()
            q, slopes = np.split(plane_echo[..., :3].astype(np.float64), [1], axis=-1)
            q = q[..., 0]
            plane = plane_of(q, slopes, np.stack([u, v], axis=-1))
            hit = q > 0
            length = np.where(hit, np.linalg.norm(plane, axis=-1), 1.0)
            normal = -(plane / length[..., None]) @ sector.rotation()
            range_m = np.where(hit, np.sqrt(1 + u * u + v * v) / np.where(hit, q, 1.0), 0.0)
            out.append(
                GBuffer(
                    range_m=range_m.astype(np.float32),
                    normal=np.where(hit[..., None], normal, 0).astype(np.float32),
                    echo=np.where(hit, plane_echo[..., 3] / np.where(hit, range_m, 1), 0).astype(np.float32),
                    body_id=np.where(hit, body_id, 0),  # cleared or not is left open for integers
                )
            )
        return out
