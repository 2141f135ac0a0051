"""Scene to samples: the depth + normal pass in OpenGL."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import moderngl
import numpy as np

from sonar_gl.core.errors import Error, MachineError, SampleLimitError
from sonar_gl.core.memory import USES_BEFORE_SMALLER
from sonar_gl.gl import egl
from sonar_gl.gl.context import is_software
from sonar_gl.gl.driver import check_driver, check_room, side_limit
from sonar_gl.gl.enums import CLIP_DISTANCE0
from sonar_gl.raster.opengl.buffers import SceneBuffers, draws_of
from sonar_gl.raster.opengl.sheets import FURTHEST, MARGIN, draw_near
from sonar_gl.raster.views import (
    NO_PLANE,
    NO_SAMPLES,
    BodiesInView,
    PatchRoom,
    RenderWorkspace,
    SectorLayout,
    SectorView,
    Window,
    stacked,
)
from sonar_gl.sonar.fan import FAR_FACTOR, NEAR_M, Fan
from sonar_gl.sonar.samples import NO_BODIES, ViewSamples
from sonar_gl.sonar.sector import Sector

LAYOUTS = (4, "f4"), (1, "u2")  # components and type of each attachment
DEPTH_BYTES = 4
NOT_READ = np.full(1, np.nan, np.float32)  # stays in place of 1/x where a lost context reads nothing
# A render target is replaced by a smaller one where so many uses in a row as of a ReusedArray have needed less than one
# of so many of its pixels, or else coarse pings would keep the memory of a fine one; not below MIN_PIXELS, 3 MB. A
# smaller one at once would be replaced by a larger one where windows of two sizes take turns.
MAX_PIXELS_PER_USED, MIN_PIXELS = 2, 1 << 16
MAX_KEPT_PIXELS = 1 << 18  # 10 MB
# How many columns and rows a viewport has beyond each side of its sector, over those of the sector; the scissor
# leaves them out. A software driver cuts triangles at the viewport, and rounds where their edges meet it, so that these
# move by up to 1/256 of a sample. Cut much further away, edges that come from behind the sonar move by more: the ends
# that remain are float32.
BORDER = 1


class SectorDraws(NamedTuple):
    """What a sector draws.

    first, n_closed, n : its draws among those of all poses; the first of them are of closed bodies
    window : Window
    n_faces : how many faces these draws have
    """

    first: int
    n_closed: int
    n: int
    window: Window
    n_faces: int


class RenderTarget:
    """A framebuffer, and arrays of its size to read it into.

    asynchronous : copy the samples to buffers of the driver after drawing, and read those later, so that a graphics
        card copies one picture while it draws the next. A software driver would only copy twice.
    width, height : pixels in use; 0 before anything was drawn
    has_bodies : whether bodies' numbers are drawn, too
    """

    def __init__(self, asynchronous: bool):
        self.width, self.height, self.has_bodies = 0, 0, False
        self._asynchronous = asynchronous
        self._drop()

    def _drop(self) -> None:
        self._size, self._arrays, self._framebuffers, self._copies = (0, 0), {}, {}, []
        # the largest sides, and the number of uses, since most of the pixels were in use
        self._most, self._n_uses = (0, 0), 0

    def drop_large(self) -> None:
        """Drop a framebuffer of more than MAX_KEPT_PIXELS; samples that were read from it stay valid."""
        if math.prod(self._size) > MAX_KEPT_PIXELS:
            self._drop()

    def allocate(self, context: moderngl.Context, limit: int) -> None:
        """Have room for the pixels in use, and not for far more than many uses in a row need.

        Raises Error if the graphics card is known to lack the memory, or the driver makes no such framebuffer.
        """
        in_use = self.width, self.height
        most_kept = max(MAX_PIXELS_PER_USED * self.width * self.height, MIN_PIXELS)
        if math.prod(self._size) <= most_kept:
            self._most, self._n_uses = (0, 0), 0
        else:
            self._most, self._n_uses = tuple(map(max, self._most, in_use)), self._n_uses + 1
        fits = self.width <= self._size[0] and self.height <= self._size[1]
        if fits and self._n_uses <= USES_BEFORE_SMALLER:
            return
        # a little more, so that a window that grows does not need a new target every time
        size = tuple(min(64 * -(-n // 64), limit) for n in (self._most if fits else in_use))
        both = tuple(map(max, size, self._size))
        if math.prod(both) <= most_kept:
            size = both
        self._drop()
        context.gc()  # releases the old renderbuffers before as much memory is taken again
        check_room(context, math.prod(size) * self._bytes_per_pixel())
        try:
            plane_echo = context.renderbuffer(size, 4, dtype="f4")
            body_id = context.renderbuffer(size, 1, dtype="u2")
            depth = context.depth_renderbuffer(size)
            framebuffers = {
                False: context.framebuffer([plane_echo], depth),
                True: context.framebuffer([plane_echo, body_id], depth),
            }
            if self._asynchronous:
                self._copies = [context.buffer(reserve=math.prod(size) * n, dynamic=True) for n in (16, 2)]
        except moderngl.Error as why:  # an incomplete framebuffer, perhaps for want of memory
            check_driver(context)
            raise Error(
                f"the driver must make a framebuffer of {size[0]} columns by {size[1]} rows (got: {why}; "
                "ask for a larger tolerance or fewer samples)"
            ) from None
        check_driver(context)
        # the size last: after an interrupt or an error of the driver the next ping begins anew
        self._framebuffers = framebuffers
        self._size = size

    def _bytes_per_pixel(self) -> int:
        """Return the bytes that a pixel takes in the driver's memory."""
        read = sum(components * np.dtype(dtype).itemsize for components, dtype in LAYOUTS)
        return DEPTH_BYTES + read * (2 if self._asynchronous else 1)

    def clear(self) -> moderngl.Framebuffer:
        """Bind and clear the framebuffer."""
        framebuffer = self._framebuffers[self.has_bodies]
        framebuffer.use()
        framebuffer.clear(depth=1.0, viewport=(0, 0, self.width, self.height))
        return framebuffer

    def begin_read(self) -> None:
        """Have the driver copy what was drawn, if that is to be read later."""
        if self._asynchronous:
            self._copies[0].write(NOT_READ)
            for attachment in range(1 + self.has_bodies):
                self._copy(self._copies[attachment], attachment)

    def read(self) -> tuple[np.ndarray, np.ndarray]:
        """Return (H, W, 4) float32 and (H, W) uint16; of no size what was not drawn. The next call overwrites
        them.
        """
        if not self.width:
            return NO_SAMPLES, NO_BODIES
        plane_echo = self._read(0)
        return plane_echo, self._read(1)[..., 0] if self.has_bodies else NO_BODIES

    def _read(self, attachment: int) -> np.ndarray:
        components, dtype = LAYOUTS[attachment]
        if attachment not in self._arrays:
            self._arrays[attachment] = np.zeros(self._size[0] * self._size[1] * components, dtype)
        out = self._arrays[attachment][: self.width * self.height * components]
        if attachment == 0:
            out[:1] = NOT_READ
        if self._asynchronous:
            self._copies[attachment].read_into(out, size=out.nbytes)
        else:
            self._copy(out, attachment)
        if attachment == 0 and np.isnan(out[0]):
            raise MachineError(egl.LOST)
        return out.reshape(self.height, self.width, components)

    def _copy(self, out, attachment: int) -> None:
        components, dtype = LAYOUTS[attachment]
        self._framebuffers[self.has_bodies].read_into(
            out,
            viewport=(0, 0, self.width, self.height),
            components=components,
            dtype=dtype,
            attachment=attachment,
            alignment=1,
        )


class OpenGLWorkspace(RenderWorkspace):
    """Render targets, and room for chosen patches."""

    def __init__(self, context: moderngl.Context, most_samples: int):
        # graphics cards copy samples while the next are drawn
        asynchronous = not is_software(context.info["GL_RENDERER"])
        super().__init__(most_samples, lambda: RenderTarget(asynchronous))
        self.chosen = PatchRoom()


class OpenGLRenderer:
    """Draws a fan's sectors side by side, an image for each pose, and reads them back. A `Renderer`.

    Of each sector only the window that holds bodies is drawn.

    Raises Error if the samples do not fit the driver's limits.

    specular : add the specular lobes of smooth bodies
    workspace : OpenGLWorkspace, which renderers may share
    """

    def __init__(self, buffers: SceneBuffers, fan: Fan, specular: bool, workspace: OpenGLWorkspace):
        context = buffers.context
        self._context, self._buffers, self._specular = context, buffers, specular
        self._far_m = FAR_FACTOR * fan.sonar.range_max_m
        self._limit = side_limit(context)
        self._check_size(max(s.columns for s in fan.sectors), max(s.rows for s in fan.sectors))
        self._sectors = [SectorView(sector, self._far_m, fan.sonar.range_max_m) for sector in fan.sectors]
        self._layout, self._stacked = SectorLayout(self._sectors), stacked(self._sectors)
        self._uniforms, self._workspace = {}, workspace
        # the far plane lies across the middle of a sector, and so is further away in its corners
        furthest = max((view.furthest for view in self._sectors), default=1.0)
        self._reach_m = MARGIN * self._far_m * min(furthest, FURTHEST)

    def render(
        self,
        poses: Sequence[np.ndarray],
        states: Sequence = (None,),
        with_bodies: bool = False,
        full: bool = False,
        planes: Sequence | None = None,
        keep_last: bool = False,
    ) -> list[ViewSamples]:
        """Draw all sectors as seen from some poses, and read them back; see `raster.engine.Renderer.render`."""
        planes, meshes = planes or [None] * len(poses), self._buffers.meshes
        bodies = [meshes.view_from(*view, self._specular) for view in zip(poses, states, planes, strict=True)]
        for number, sheet in self._buffers.uploaded.sheets.items():
            for one in bodies:
                if one.present[number]:  # an absent body has no matrix
                    draw_near(sheet, one.matrices[number], self._reach_m, one.table[number])
        rows = bodies[0].table if len(bodies) == 1 else np.concatenate([one.table for one in bodies])
        targets = self._workspace.images(len(bodies), keep_last)
        listed = [np.empty((0, 5), np.uint32)]
        laid_out = [self._lay_out(number, one, full, listed) for number, one in enumerate(bodies)]
        draws = np.concatenate(listed)
        for target, sectors in zip(targets, laid_out, strict=True):
            target.width = sum(d.window.columns for d in sectors)
            target.height = max(d.window.rows for d in sectors)
            target.has_bodies = with_bodies
        width, height = (max(getattr(one, side) for one in targets) for side in ("width", "height"))
        self._check_size(width, height)
        self._workspace.check_samples(width, height)
        if len(draws):
            self._buffers.upload(rows, draws)
        for target, sectors, one in zip(targets, laid_out, bodies, strict=True):
            if target.width:
                target.allocate(self._context, self._limit)
                self._draw(target, rows, draws, sectors, one)
                target.begin_read()
        # while one is read the driver's threads may fill the next
        views = [self._read(*one) for one in zip(targets, laid_out, bodies, strict=True)]
        check_driver(self._context)
        return views

    def prepare(self, n_samples: int, share: float) -> None:
        """Do nothing: the driver has its own memory."""

    def _lay_out(self, number: int, bodies: BodiesInView, full: bool, listed: list) -> list[SectorDraws]:
        """Find what each sector draws of the bodies of one pose, and append the draws to a list."""
        meshes, out = self._buffers.meshes, []
        chosen = self._workspace.chosen.take(len(self._sectors), meshes.most_patches)
        found = meshes.choose(self._stacked, bodies, chosen)
        for view, patches, (n, n_faces, *window) in zip(self._sectors, chosen, found.tolist(), strict=True):
            first, n_closed = sum(map(len, listed)), 0
            if n:
                listed.append(draws_of(patches[:n], meshes, number * len(meshes.bodies)))
                if bodies.outside:
                    n_closed = np.count_nonzero(meshes.boxes.closed[patches[:n, 1]])
            out.append(SectorDraws(first, n_closed, n, view.whole if full else Window(*window), n_faces))
        return out

    def _draw(
        self, target: RenderTarget, rows, draws: np.ndarray, sectors: list[SectorDraws], bodies: BodiesInView
    ) -> None:
        framebuffer = target.clear()
        array = self._buffers.array(target.has_bodies, bodies.has_lobes)
        array.program["before"].write(
            np.asarray(NO_PLANE if bodies.plane is None else bodies.plane, np.float32)
        )
        self._context.enable_direct(CLIP_DISTANCE0)
        left = 0
        for view, (first, n_closed, n, window, _) in zip(self._sectors, sectors, strict=True):
            if n:
                sector, (i, j, columns, n_rows) = view.sector, window
                side, end = self._border_of(sector)
                size = sector.columns + 2 * side, sector.rows + 2 * end
                framebuffer.viewport = (left - i - side, -j - end, *size)
                framebuffer.scissor = (left, 0, columns, n_rows)
                for name, value in self._uniforms_of(array.program, view):
                    array.program[name].write(value)
                for name in ("u", "v"):  # pixels count from the framebuffer's corner
                    u = getattr(sector, name)
                    array.program[name] = (u[0] + u[1] * (i - left) + u[2] * j, u[1], u[2])
                one_sided, two_sided = moderngl.DEPTH_TEST | moderngl.CULL_FACE, moderngl.DEPTH_TEST
                self._buffers.draw(array, one_sided, rows, draws, first, n_closed)
                self._buffers.draw(array, two_sided, rows, draws, first + n_closed, n - n_closed)
            left += window.columns
        framebuffer.scissor = None
        self._context.disable_direct(CLIP_DISTANCE0)

    def _read(self, target: RenderTarget, draws: list[SectorDraws], bodies: BodiesInView) -> ViewSamples:
        """Return what was drawn."""
        windows, n_faces = [one.window for one in draws], sum(one.n_faces for one in draws)
        return self._layout.samples(windows, *target.read(), body_spans=bodies.spans, n_faces=n_faces)

    def _check_size(self, width: int, height: int) -> None:
        if max(width, height) > self._limit:
            raise SampleLimitError(
                f"samples must fit the driver's limit of {self._limit} by {self._limit} pixels (got {width} columns by "
                f"{height} rows; ask for a larger tolerance or fewer samples)"
            )

    def _border_of(self, sector: Sector) -> tuple[int, int]:
        """Return how many columns at each side, and rows at each end, the viewport of a sector has beyond it."""
        return tuple(min(BORDER * n, (self._limit - n) // 2) for n in (sector.columns, sector.rows))

    def _uniforms_of(self, program, view: SectorView) -> list[tuple[str, bytes]]:
        """Return the uniforms of a sector, the same for every ping."""
        key = (program.glo, id(view))
        if key not in self._uniforms:
            sector, (side, end) = view.sector, self._border_of(view.sector)
            clip = sector.projection(NEAR_M, self._far_m)
            clip[0] *= sector.columns / (sector.columns + 2 * side)
            clip[1] *= sector.rows / (sector.rows + 2 * end)
            values = {
                "clip_from_sonar": clip.T,
                "sector_from_sonar": sector.rotation().T,
                "pixel_from_uv": view.geometry.inverse.T,
                "far_m": self._far_m,
            }
            self._uniforms[key] = [
                (name, np.ascontiguousarray(value, np.float32).tobytes())
                for name, value in values.items()
                if name in program
            ]
        return self._uniforms[key]
