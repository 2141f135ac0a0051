"""Framebuffers of ours in a host's context, and how they are given back."""

from __future__ import annotations

from collections import deque

import numpy as np

from sonar_gl.foreign import Tenant
from sonar_gl.lattice import Sector
from sonar_gl.types import Error

FRAMEBUFFER, RENDERBUFFER, COMPLETE, DEPTH_TEST, DRAW_BINDING = 0x8D40, 0x8D41, 0x8CD5, 0x0B71, 0x8CA6
MAX_RENDERBUFFER_SIZE = 0x84E8
COLOR, DEPTH, COLOR_0, COLOR_1, DEPTH_ATTACHMENT = 0x1800, 0x1801, 0x8CE0, 0x8CE1, 0x8D00
RGBA, RED_INTEGER, FLOAT, UNSIGNED_SHORT, PACK_ALIGNMENT = 0x1908, 0x8D94, 0x1406, 0x1403, 0x0D05
RGBA32F, R16UI, DEPTH_COMPONENT32F = 0x8814, 0x8234, 0x8CAC


class Target:
    """A framebuffer of ours in a host's context, of a sector's samples; made when first bound.

    Attributes
    ----------
    is_drawn : whether the host draws into it now
    is_released : it was given back, or is waiting for that
    """

    def __init__(self, tenant: Tenant, sector: Sector):
        self.tenant, self.sector, self._name, self._buffers = tenant, sector, None, None
        self.is_drawn = self.is_released = False

    def bind(self):
        """Have it bound and empty, its viewport set, and the depth test on."""
        gl = self.tenant.gl
        if self._name is None:
            self._make(gl)
        gl.glBindFramebuffer(FRAMEBUFFER, self._name)
        nothing, depth = np.zeros(4, np.float32), np.ones(1, np.float32)
        gl.glClearBufferfv(COLOR, 0, nothing.ctypes.data)
        gl.glClearBufferuiv(COLOR, 1, nothing.ctypes.data)
        gl.glClearBufferfv(DEPTH, 0, depth.ctypes.data)
        gl.glViewport(0, 0, self.sector.columns, self.sector.rows)
        gl.glEnable(DEPTH_TEST)

    def is_bound(self) -> bool:
        """Whether the host would draw into it now."""
        return self.tenant.gl.integer(DRAW_BINDING) == self._name

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
        if status != COMPLETE or errors:
            self._delete()
            why = f"status 0x{status:04x}" + "".join(f", error 0x{error:04x}" for error in errors)
            raise Error(
                f"samples must fit the driver (got {columns} columns by {rows} rows, for which it makes no "
                f"framebuffer: {why}; ask for fewer)"
            )

    def read(self):
        """(R, C, 4) float32 and (R, C) uint16 of what the host drew, whatever it has bound by now."""
        gl, size = self.tenant.gl, (0, 0, self.sector.columns, self.sector.rows)
        plane_echo = np.zeros((self.sector.rows, self.sector.columns, 4), np.float32)
        body_id = np.zeros(plane_echo.shape[:2], np.uint16)
        self.tenant.guard.set_defaults()  # the host may have changed pixel stores and the like
        gl.glBindFramebuffer(FRAMEBUFFER, self._name)
        gl.glPixelStorei(PACK_ALIGNMENT, 1)
        gl.glReadBuffer(COLOR_0)
        gl.glReadPixels(*size, RGBA, FLOAT, plane_echo.ctypes.data)
        gl.glReadBuffer(COLOR_1)
        gl.glReadPixels(*size, RED_INTEGER, UNSIGNED_SHORT, body_id.ctypes.data)
        if errors := gl.take_errors():
            got = f"got OpenGL error 0x{errors[0]:04x}"
            raise Error(
                f"what a host has drawn must be there to be read ({got}; was our framebuffer deleted?)"
            )
        # beyond every number, loops over bins would not end where they should
        if not np.isfinite(plane_echo).all():
            raise Error(
                "what a host writes for a sonar must be finite (got NaN or infinity; set the uniform "
                "sonar_gl_lattice for each sector, and look at the normals)"
            )
        if plane_echo[..., 3].min() < 0:
            raise Error("the reflectivity that a host writes must lie in 0..1 (got another; divide by 255?)")
        return plane_echo, body_id

    @property
    def is_gone(self) -> bool:
        """Whether the host's context is there no more."""
        return self.tenant.is_gone

    def is_in_reach(self) -> bool:
        """Whether the host's context can be used here and now."""
        return self.tenant.is_in_reach()

    def release(self):
        """Give it back, in reach."""
        if self._name is not None:
            self._delete()

    def _delete(self):
        name = np.array([self._name], np.uint32)
        self.tenant.gl.glDeleteFramebuffers(1, name.ctypes.data)
        self.tenant.gl.glDeleteRenderbuffers(3, self._buffers.ctypes.data)
        self._name = self._buffers = None


_left: deque = deque(maxlen=1000)  # targets and tenants that nobody holds, whose context was out of reach


def leave(things) -> None:
    """Have targets or tenants released later, when nobody is drawing."""
    _left.extend(things)


def give_back(things) -> None:
    """Release targets or tenants, or have that done as soon as their context is in reach."""
    for thing in things:
        if isinstance(thing, Target):
            thing.is_released = True
        if thing.is_in_reach():
            thing.release()
        elif not thing.is_gone:
            _left.append(thing)


def release_left() -> None:
    """Release what is in reach by now; not to be called while a host draws a sector."""
    give_back([_left.popleft() for _ in range(len(_left))])
