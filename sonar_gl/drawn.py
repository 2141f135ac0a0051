"""Sectors that a host draws into framebuffers of ours, in its own context."""

from __future__ import annotations

import numpy as np

from sonar_gl.footprint import FAR_FACTOR
from sonar_gl.foreign import Tenant
from sonar_gl.hearing import Hearing
from sonar_gl.lattice import Sector
from sonar_gl.types import Error

FRAMEBUFFER, RENDERBUFFER, COMPLETE, DEPTH_TEST = 0x8D40, 0x8D41, 0x8CD5, 0x0B71
COLOR, DEPTH, COLOR_0, COLOR_1, DEPTH_ATTACHMENT = 0x1800, 0x1801, 0x8CE0, 0x8CE1, 0x8D00
RGBA, RED_INTEGER, FLOAT, UNSIGNED_SHORT, PACK_ALIGNMENT = 0x1908, 0x8D94, 0x1406, 0x1403, 0x0D05
RGBA32F, R16UI, DEPTH_COMPONENT32F = 0x8814, 0x8234, 0x8CAC
NEAR_M = 1e-3  # nearer than this the sonar looks through things
# x of a sector's frame is what lies behind the view's z axis, y is to its left, z is up
VIEW_FROM_SECTOR = np.array([[0.0, -1, 0, 0], [0, 0, 1, 0], [-1, 0, 0, 0], [0, 0, 0, 1]])


class DrawnSector:
    """One perspective view of part of the fan, for a host to draw. Use it in a `with` block.

    Inside the block its framebuffer is bound and empty, the viewport is set, the depth test is on, and all
    other state that bears on drawing is OpenGL's default. After it all is as it was before.

    Attributes
    ----------
    view : (4, 4) float64, world to OpenGL's eye: x right, y up, z back
    projection : (4, 4) float64, from there to clip coordinates: a sheared perspective
    lattice : (3, 3) float64, for `embed.glsl`
    width, height : pixels
    rotation : (3, 3) float64, sonar_from_camera, where a camera's axes are x right, y down, z ahead

    Matrices multiply columns, as on paper: OpenGL is given them transposed.
    """

    def __init__(self, tenant: Tenant, sector: Sector, near_m: float, far_m: float):
        self._tenant, self.sector = tenant, sector
        self.width, self.height = sector.columns, sector.rows
        turned = np.eye(4)
        turned[:3, :3] = sector.rotation()
        self._view_from_sonar = VIEW_FROM_SECTOR @ turned
        self.rotation = self._view_from_sonar[:3, :3].T @ np.diag([1.0, -1, -1])
        self.projection = sector.projection(near_m, far_m) @ np.linalg.inv(self._view_from_sonar)
        self.lattice = np.stack([sector.u, sector.v, [1 / far_m, 0, 0]])
        self.view, self.views, self._framebuffer, self._names = None, None, None, None

    def aim(self, pose) -> DrawnSector:
        """Look from `pose`, world_from_sonar; nothing is drawn yet."""
        self.view, self.views = self._view_from_sonar @ np.linalg.inv(pose), None
        return self

    def __enter__(self):
        self._tenant.__enter__()
        try:
            gl = self._tenant.gl
            if self._framebuffer is None:
                self._make(gl)
            gl.glBindFramebuffer(FRAMEBUFFER, self._framebuffer)
            nothing, depth = np.zeros(4, np.float32), np.ones(1, np.float32)
            gl.glClearBufferfv(COLOR, 0, nothing.ctypes.data)
            gl.glClearBufferuiv(COLOR, 1, nothing.ctypes.data)
            gl.glClearBufferfv(DEPTH, 0, depth.ctypes.data)
            gl.glViewport(0, 0, self.width, self.height)
            gl.glEnable(DEPTH_TEST)
        except BaseException:
            self._tenant.__exit__()
            raise
        return self

    def __exit__(self, failed, *_):
        try:
            if self._tenant.is_in_reach():
                self._tenant.guard.keep_errors()
            if failed is None:
                self._tenant.check()
                self.views = self._read(self._tenant.gl)
        finally:
            self._tenant.__exit__()

    def _make(self, gl):
        framebuffer, names = np.zeros(1, np.uint32), np.zeros(3, np.uint32)
        gl.glGenFramebuffers(1, framebuffer.ctypes.data)
        gl.glGenRenderbuffers(3, names.ctypes.data)
        self._framebuffer, self._names = int(framebuffer[0]), names
        gl.glBindFramebuffer(FRAMEBUFFER, self._framebuffer)
        attachments = (COLOR_0, RGBA32F), (COLOR_1, R16UI), (DEPTH_ATTACHMENT, DEPTH_COMPONENT32F)
        for name, (attachment, kind) in zip(names.tolist(), attachments, strict=True):
            gl.glBindRenderbuffer(RENDERBUFFER, name)
            gl.glRenderbufferStorage(RENDERBUFFER, kind, self.width, self.height)
            gl.glFramebufferRenderbuffer(FRAMEBUFFER, attachment, RENDERBUFFER, name)
        buffers = np.array([COLOR_0, COLOR_1], np.uint32)
        gl.glDrawBuffers(2, buffers.ctypes.data)
        if (status := gl.glCheckFramebufferStatus(FRAMEBUFFER)) != COMPLETE:
            raise Error(
                f"samples must fit the driver (got {self.width} columns by {self.height} rows, for which it "
                f"makes no framebuffer, status 0x{status:04x}; ask for fewer)"
            )

    def _read(self, gl):
        """(R, C, 4) float32 and (R, C) uint16 of what the host drew, whatever it has bound by now."""
        plane_echo = np.empty((self.height, self.width, 4), np.float32)
        body_id = np.empty((self.height, self.width), np.uint16)
        self._tenant.guard.set_defaults()  # the host may have changed pixel stores and the like
        gl.glBindFramebuffer(FRAMEBUFFER, self._framebuffer)
        size = 0, 0, self.width, self.height
        gl.glPixelStorei(PACK_ALIGNMENT, 1)
        gl.glReadBuffer(COLOR_0)
        gl.glReadPixels(*size, RGBA, FLOAT, plane_echo.ctypes.data)
        gl.glReadBuffer(COLOR_1)
        gl.glReadPixels(*size, RED_INTEGER, UNSIGNED_SHORT, body_id.ctypes.data)
        # beyond every number, loops over bins would not end where they should
        if not np.isfinite(plane_echo).all():
            raise Error(
                "what a host writes for a sonar must be finite (got NaN or infinity; look at its normals)"
            )
        return self.sector, plane_echo, body_id

    def release(self):
        """Give the framebuffer back, where the host's context is in reach: else the host has it."""
        if self._framebuffer is not None and self._tenant.is_in_reach():
            name = np.array([self._framebuffer], np.uint32)
            self._tenant.gl.glDeleteFramebuffers(1, name.ctypes.data)
            self._tenant.gl.glDeleteRenderbuffers(3, self._names.ctypes.data)
        self._framebuffer = self._names = None


class Drawing:
    """The sectors of a fan that a host draws.

    Attributes
    ----------
    hearing : Hearing
    near_m : of the projections
    """

    def __init__(self, tenant: Tenant, hearing: Hearing, near_m: float):
        far_m = FAR_FACTOR * hearing.fan.sonar.range_max_m
        if isinstance(near_m, bool) or not isinstance(near_m, (int, float)) or not 0 < near_m < far_m:
            raise Error(f"near_m must be metres between 0 and {far_m:g} (got {near_m!r})")
        self.hearing, self.near_m, self._pose = hearing, near_m, None
        self._sectors = [DrawnSector(tenant, sector, near_m, far_m) for sector in hearing.fan.sectors]

    def aim(self, pose) -> list[DrawnSector]:
        """All sectors, looking from `pose`, to be drawn anew."""
        self._pose = pose
        return [sector.aim(pose) for sector in self._sectors]

    def views(self):
        """What was drawn, (sector, (R, C, 4), (R, C)) of each, and the pose."""
        views = [sector.views for sector in self._sectors]
        if (n := sum(view is not None for view in views)) < len(views):
            raise Error(
                f"all sectors must be drawn before a ping is finished (got {n} of {len(views)}; draw each "
                "inside its `with` block, without an exception)"
            )
        return views, self._pose

    def close(self):
        """Give all back."""
        for sector in self._sectors:
            sector.release()
        self.hearing.reducer.close()
