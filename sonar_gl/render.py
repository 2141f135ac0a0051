"""Scene to G-buffer: the only stage that draws."""

from __future__ import annotations

from dataclasses import replace

import moderngl
import numpy as np

from sonar_gl.cull import merge
from sonar_gl.draws import Draws, SectorView
from sonar_gl.fan import Fan
from sonar_gl.footprint import FAR_FACTOR
from sonar_gl.gpu import SceneOnGpu
from sonar_gl.stock import NEAR_M
from sonar_gl.types import Error, GBuffer

NOTHING = np.empty((0, 0, 4), np.float32), np.empty((0, 0), np.uint16)
MAX_SAMPLES = 1 << 24  # drawn at a time: 16 bytes each in the driver, and as many here


class Renderer:
    """Draws a fan's sectors side by side into one framebuffer and reads them back.

    Of each sector only the window that holds bodies is drawn.
    """

    def __init__(self, context: moderngl.Context, gpu: SceneOnGpu, fan: Fan):
        self.context, self.gpu, self.fan = context, gpu, fan
        self.far_m = FAR_FACTOR * fan.sonar.range_max_m
        self.limit = min(context.info["GL_MAX_TEXTURE_SIZE"], *context.info["GL_MAX_VIEWPORT_DIMS"])
        self._check_size(max(s.columns for s in fan.sectors), max(s.rows for s in fan.sectors))
        self.sectors = [SectorView(sector) for sector in fan.sectors]
        self.out = Draws()
        self.size = (0, 0)
        self.uniforms = {}
        self.windows, self.buffers = [], [{}, {}]

    def turn(self):
        """Read the next picture into other arrays: those behind the last `views` stay once more."""
        self.buffers.reverse()

    def render(self, poses, wheres=(None,), labels: bool = False, whole: bool = False):
        """Draw all sectors as seen from some poses, world_from_sonar, and read them back.

        The arrays behind `views` are used again by the next call.

        Parameters
        ----------
        poses, wheres : of the sonar, and for each the Whereabouts of the bodies, or None
        labels : read the bodies' numbers too
        whole : draw the empty water, too
        """
        placed = [self.gpu.stock.place(*spot) for spot in zip(poses, wheres, strict=True)]
        gpu, stock, out, range_max_m = self.gpu, self.gpu.stock, self.out, self.fan.sonar.range_max_m
        n_bodies, scenes = len(stock.bodies), []
        rows = placed[0].rows if len(placed) == 1 else np.concatenate([one.rows for one in placed])
        left = height = samples = 0
        out.clear()
        for number, one in enumerate(placed):
            for view in self.sectors:
                first, n_closed, n, window = 0, 0, 0, (0, 0, 0, 0)
                if n_bodies:
                    row = number * n_bodies
                    first, n_closed, n, window = stock.see(view, one, self.far_m, range_max_m, row, out)
                if whole:
                    window = (0, 0, view.sector.columns, view.sector.rows)
                filled = slice(samples, out.counts["samples"])
                samples = filled.stop
                scenes.append((view, window, left, first, n_closed if one.outside else 0, n, filled))
                left, height = left + window[2], max(height, window[3])
        self.windows, self.labels = [scene[1] for scene in scenes], labels
        if left == 0:
            return
        self._fit(left, height)
        framebuffer = self.framebuffers[labels]
        framebuffer.use()
        framebuffer.clear(depth=1.0, viewport=(0, 0, left, height))
        if out.counts["draws"]:
            gpu.upload(rows, out)
            array = gpu.array(labels)
            for view, (i, j, columns, n_rows), at, first, split, n, _ in scenes:
                sector = view.sector
                framebuffer.viewport = (at - i, -j, sector.columns, sector.rows)
                framebuffer.scissor = (at, 0, columns, n_rows)
                for name, value in self._uniforms(array.program, view):
                    array.program[name].write(value)
                for name in ("u", "v"):  # pixels count from the framebuffer's corner
                    u = getattr(sector, name)
                    array.program[name] = (u[0] + u[1] * (i - at) + u[2] * j, u[1], u[2])
                gpu.draw(array, moderngl.DEPTH_TEST | moderngl.CULL_FACE, rows, out, first, split)
                gpu.draw(array, moderngl.DEPTH_TEST, rows, out, first + split, n - split)
            framebuffer.scissor = None
        self.plane_echo = self._read(framebuffer, left, height, 4, "f4", 0)
        if labels:
            self.body_id = self._read(framebuffer, left, height, 1, "u2", 1)
        bodies = self.body_id if labels else NOTHING[1]
        for _, (i, j, *_), at, *_, filled in scenes:
            merge(
                out.places[filled], out.values[filled], out.bodies[filled], i, j, at, self.plane_echo, bodies
            )

    def _check_size(self, width: int, height: int):
        got = f"(got {width} columns by {height} rows; ask for a larger tolerance or fewer samples)"
        if max(width, height) > self.limit:
            raise Error(f"samples must fit the driver's limit of {self.limit} by {self.limit} pixels {got}")

    def _fit(self, width: int, height: int):
        """Have framebuffers that hold so many pixels."""
        self._check_size(width, height)
        if width * height > MAX_SAMPLES:
            raise Error(
                f"samples with bodies before them must be no more than {MAX_SAMPLES} (got {width} columns "
                f"by {height} rows; ask for a larger tolerance or fewer samples)"
            )
        if width <= self.size[0] and height <= self.size[1]:
            return
        # a little more, so that a window that grows does not ask for new ones every time
        self.size = tuple(
            min(max(old, 64 * -(-new // 64)), self.limit)
            for old, new in zip(self.size, (width, height), strict=True)
        )
        plane_echo = self.context.renderbuffer(self.size, 4, dtype="f4")
        body_id = self.context.renderbuffer(self.size, 1, dtype="u2")
        depth = self.context.depth_renderbuffer(self.size)
        self.framebuffers = {
            False: self.context.framebuffer([plane_echo], depth),
            True: self.context.framebuffer([plane_echo, body_id], depth),
        }
        self.buffers = [{}, {}]

    def _read(self, framebuffer, width, height, components, dtype, attachment):
        buffers, n = self.buffers[0], self.size[0] * self.size[1]
        if components not in buffers:
            buffers[components] = np.zeros(n * components, dtype)
        out = buffers[components][: width * height * components]
        framebuffer.read_into(
            out,
            viewport=(0, 0, width, height),
            components=components,
            dtype=dtype,
            attachment=attachment,
            alignment=1,
        )
        return out.reshape(height, width, components) if components > 1 else out.reshape(height, width)

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
        left = 0
        sectors = [view.sector for view in self.sectors] * (len(self.windows) // len(self.sectors))
        for sector, (i, j, columns, rows) in zip(sectors, self.windows, strict=True):
            if columns == 0:
                yield replace(sector, columns=0, rows=0), *NOTHING
                continue
            here = (slice(0, rows), slice(left, left + columns))
            left += columns
            u, v = (np.array([w[0] + w[1] * i + w[2] * j, w[1], w[2]]) for w in (sector.u, sector.v))
            cut = replace(sector, u=u, v=v, columns=columns, rows=rows)
            yield cut, self.plane_echo[here], self.body_id[here] if self.labels else NOTHING[1]

    def gbuffers(self) -> list[GBuffer]:
        """What was read, one `GBuffer` a sector."""
        out = []
        for sector, plane_echo, body_id in self.views():
            u, v = sector.rays()
            q, along_u, along_v = (plane_echo[..., k].astype(np.float64) for k in range(3))
            plane = np.stack([q - along_u * u - along_v * v, -along_u, along_v], axis=-1)
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
