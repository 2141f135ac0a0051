"""Framebuffers of a sonar in a host's context, into which the host draws the sectors."""

from __future__ import annotations

import numpy as np

from sonar_gl.core.errors import Error
from sonar_gl.gl import lifetime
from sonar_gl.gl.enums import DEPTH_TEST, DRAW_FRAMEBUFFER_BINDING, FLOAT, RED_INTEGER, RENDERBUFFER, RGBA
from sonar_gl.gl.host import HostContext
from sonar_gl.scene.scene import ROUGHNESS_BOUNDS_RAD
from sonar_gl.sonar.sector import Sector

FRAMEBUFFER, FRAMEBUFFER_COMPLETE, UNSIGNED_SHORT = 0x8D40, 0x8CD5, 0x1403
MAX_RENDERBUFFER_SIZE, PACK_ALIGNMENT = 0x84E8, 0x0D05
COLOR, DEPTH, COLOR_0, COLOR_1, DEPTH_ATTACHMENT = 0x1800, 0x1801, 0x8CE0, 0x8CE1, 0x8D00
RGBA32F, R16UI, DEPTH_COMPONENT32F = 0x8814, 0x8234, 0x8CAC
# what is wrong, by the negative echo that shaders/embed.glsl writes then
WRONG_ECHO = -1.0
MISTAKES = {
    WRONG_ECHO: "the reflectivity that the host writes must lie in 0..1 (got another value; divide by 255?)",
    -2.0: (
        "the normals that the host writes must be finite (got NaN or infinity; check the normals of the mesh: "
        "normalize(vec3(0.0)) may be NaN, where vec3(0.0) itself stands for the normal of the flat face)"
    ),
    -3.0: (
        "a lobe that the host writes must have |R|² in 0..1 and an rms slope in {:g}..{:g} (got another value; "
        "vec2(0.0) is none)".format(*ROUGHNESS_BOUNDS_RAD)
    ),
}


class Framebuffer:
    """A framebuffer for the samples of one sector in a host's context, created at the first `bind`."""

    def __init__(self, host: HostContext, sector: Sector):
        self.host, self.sector, self._name, self._buffers = host, sector, None, None
        self.is_being_drawn = False  # by the host
        self.is_released = False  # or queued for release

    def bind(self):
        """Bind and clear the framebuffer, set the viewport, and enable the depth test."""
        gl = self.host.gl
        if self._name is None:
            self._make(gl)
        gl.glBindFramebuffer(FRAMEBUFFER, self._name)
        zeros, depth = np.zeros(4, np.float32), np.ones(1, np.float32)
        gl.glClearBufferfv(COLOR, 0, zeros.ctypes.data)
        gl.glClearBufferuiv(COLOR, 1, zeros.ctypes.data)
        gl.glClearBufferfv(DEPTH, 0, depth.ctypes.data)
        gl.glViewport(0, 0, self.sector.columns, self.sector.rows)
        gl.glEnable(DEPTH_TEST)

    def is_bound(self) -> bool:
        return self.host.gl.integer(DRAW_FRAMEBUFFER_BINDING) == self._name

    def _make(self, gl):
        name, buffers = np.zeros(1, np.uint32), np.zeros(3, np.uint32)
        gl.glGenFramebuffers(1, name.ctypes.data)
        gl.glGenRenderbuffers(3, buffers.ctypes.data)
        self._name, self._buffers = int(name[0]), buffers
        gl.glBindFramebuffer(FRAMEBUFFER, self._name)
        columns, rows = self.sector.columns, self.sector.rows
        attachments = (COLOR_0, RGBA32F), (COLOR_1, R16UI), (DEPTH_ATTACHMENT, DEPTH_COMPONENT32F)
        for buffer, (attachment, kind) in zip(buffers.tolist(), attachments, strict=True):
            gl.glBindRenderbuffer(RENDERBUFFER, buffer)
            gl.glRenderbufferStorage(RENDERBUFFER, kind, columns, rows)
            gl.glFramebufferRenderbuffer(FRAMEBUFFER, attachment, RENDERBUFFER, buffer)
        outputs = np.array([COLOR_0, COLOR_1], np.uint32)
        gl.glDrawBuffers(2, outputs.ctypes.data)
        status, errors = gl.glCheckFramebufferStatus(FRAMEBUFFER), gl.take_errors()
        if status != FRAMEBUFFER_COMPLETE or errors:
            self._delete()
            why = f"status 0x{status:04x}" + "".join(f", error 0x{error:04x}" for error in errors)
            raise Error(
                f"samples must fit the driver (got {columns} columns by {rows} rows, for which it creates no "
                f"framebuffer: {why}; use a coarser sampling)"
            )

    def read(self):
        """Read the samples that the host drew; another framebuffer may be bound.

        Returns plane_echo, (R, C, 4) float32, and body_id, (R, C) uint16. Raises Error if the framebuffer was deleted,
        a value or a normal is not finite, or a reflectivity or a lobe is out of bounds.
        """
        gl, size = self.host.gl, (0, 0, self.sector.columns, self.sector.rows)
        plane_echo = np.zeros((self.sector.rows, self.sector.columns, 4), np.float32)
        body_id = np.zeros(plane_echo.shape[:2], np.uint16)
        self.host.guard.set_defaults()  # the host may have changed the pixel store, for example
        gl.glBindFramebuffer(FRAMEBUFFER, self._name)
        gl.glPixelStorei(PACK_ALIGNMENT, 1)
        gl.glReadBuffer(COLOR_0)
        gl.glReadPixels(*size, RGBA, FLOAT, plane_echo.ctypes.data)
        gl.glReadBuffer(COLOR_1)
        gl.glReadPixels(*size, RED_INTEGER, UNSIGNED_SHORT, body_id.ctypes.data)
        if errors := gl.take_errors():
            got = f"got OpenGL error 0x{errors[0]:04x}"
            raise Error(
                f"the samples that the host drew must be readable ({got}; did the host delete the framebuffer?)"
            )
        # With infinity or NaN the loops over range bins would run past their ends.
        if not np.isfinite(plane_echo).all():
            raise Error(
                "the samples that the host writes must be finite (got NaN or infinity; set the uniform "
                "sonar_gl_lattice for each sector)"
            )
        if (lowest := float(plane_echo[..., 3].min())) < 0:
            raise Error(MISTAKES.get(lowest, MISTAKES[WRONG_ECHO]))
        return plane_echo, body_id

    @property
    def is_gone(self) -> bool:
        """Whether the host's context is known to have been destroyed."""
        return self.host.is_gone

    def is_in_reach(self) -> bool:
        """Return whether it can be deleted now: the host's context is current, and the host is not drawing into it."""
        return not self.is_being_drawn and self.host.is_in_reach()

    def release(self):
        """Delete the OpenGL objects, unless their context was destroyed."""
        self.is_released = True
        if self._name is not None and not self.is_gone:
            self._delete()

    def _delete(self):
        name = np.array([self._name], np.uint32)
        self.host.gl.glDeleteFramebuffers(1, name.ctypes.data)
        self.host.gl.glDeleteRenderbuffers(3, self._buffers.ctypes.data)
        self._name = self._buffers = None


def release_framebuffers(framebuffers) -> None:
    """Release framebuffers of one host, now or once its context is current; they cannot be drawn into again."""
    for framebuffer in framebuffers:
        framebuffer.is_released = True
    lifetime.release(*framebuffers)
