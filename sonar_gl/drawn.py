"""Sectors that a host draws into framebuffers of ours, in its own context."""

from __future__ import annotations

import math

import numpy as np

from sonar_gl.footprint import FAR_FACTOR
from sonar_gl.foreign import Tenant
from sonar_gl.hearing import Hearing
from sonar_gl.lattice import Sector
from sonar_gl.types import Error

FRAMEBUFFER, RENDERBUFFER, COMPLETE, DEPTH_TEST, DRAW_BINDING = 0x8D40, 0x8D41, 0x8CD5, 0x0B71, 0x8CA6
COLOR, DEPTH, COLOR_0, COLOR_1, DEPTH_ATTACHMENT = 0x1800, 0x1801, 0x8CE0, 0x8CE1, 0x8D00
RGBA, RED_INTEGER, FLOAT, UNSIGNED_SHORT, PACK_ALIGNMENT = 0x1908, 0x8D94, 0x1406, 0x1403, 0x0D05
RGBA32F, R16UI, DEPTH_COMPONENT32F = 0x8814, 0x8234, 0x8CAC
NEAR_M = 1e-3  # nearer than this the sonar looks through things
# x of a sector's frame is what lies behind the view's z axis, y is to its left, z is up
VIEW_FROM_SECTOR = np.array([[0.0, -1, 0, 0], [0, 0, 1, 0], [-1, 0, 0, 0], [0, 0, 0, 1]])


class Target:
    """A framebuffer of ours in a host's context, of a sector's samples; made when first bound."""

    def __init__(self, tenant: Tenant, sector: Sector):
        self.tenant, self.sector, self._name, self._buffers = tenant, sector, None, None

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
        if (status := gl.glCheckFramebufferStatus(FRAMEBUFFER)) != COMPLETE:
            raise Error(
                f"samples must fit the driver (got {columns} columns by {rows} rows, for which it "
                f"makes no framebuffer, status 0x{status:04x}; ask for fewer)"
            )

    def read(self):
        """(R, C, 4) float32 and (R, C) uint16 of what the host drew, whatever it has bound by now."""
        gl, size = self.tenant.gl, (0, 0, self.sector.columns, self.sector.rows)
        plane_echo = np.empty((self.sector.rows, self.sector.columns, 4), np.float32)
        body_id = np.empty(plane_echo.shape[:2], np.uint16)
        self.tenant.guard.set_defaults()  # the host may have changed pixel stores and the like
        gl.glBindFramebuffer(FRAMEBUFFER, self._name)
        gl.glPixelStorei(PACK_ALIGNMENT, 1)
        gl.glReadBuffer(COLOR_0)
        gl.glReadPixels(*size, RGBA, FLOAT, plane_echo.ctypes.data)
        gl.glReadBuffer(COLOR_1)
        gl.glReadPixels(*size, RED_INTEGER, UNSIGNED_SHORT, body_id.ctypes.data)
        # beyond every number, loops over bins would not end where they should
        if not np.isfinite(plane_echo).all():
            raise Error(
                "what a host writes for a sonar must be finite (got NaN or infinity; set the uniform "
                "sonar_gl_lattice for each sector, and look at the normals)"
            )
        if plane_echo[..., 3].min() < 0:
            raise Error("the reflectivity that a host writes must lie in 0..1 (got another; divide by 255?)")
        return plane_echo, body_id

    def release(self):
        """Give it back, where the host's context is in reach: else the host has it."""
        if self._name is not None and self.tenant.is_in_reach():
            name = np.array([self._name], np.uint32)
            self.tenant.gl.glDeleteFramebuffers(1, name.ctypes.data)
            self.tenant.gl.glDeleteRenderbuffers(3, self._buffers.ctypes.data)
        self._name = self._buffers = None


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

    def __init__(self, target: Target, pose, near_m: float, far_m: float):
        sector, turned = target.sector, np.eye(4)
        turned[:3, :3] = sector.rotation()
        view_from_sonar = VIEW_FROM_SECTOR @ turned
        self.width, self.height = sector.columns, sector.rows
        self.view = view_from_sonar @ np.linalg.inv(pose)
        self.rotation = view_from_sonar[:3, :3].T @ np.diag([1.0, -1, -1])
        self.projection = sector.projection(near_m, far_m) @ np.linalg.inv(view_from_sonar)
        self.lattice = np.stack([sector.u, sector.v, [1 / far_m, 0, 0]])
        self._target, self.drawn, self.strayed = target, None, False

    def __enter__(self):
        self._target.tenant.__enter__()
        try:
            self._target.bind()
        except BaseException:
            self._target.tenant.__exit__()
            raise
        return self

    def __exit__(self, failed, *_):
        tenant = self._target.tenant
        try:
            if tenant.is_in_reach():
                tenant.guard.keep_errors()
            if failed is None:
                tenant.check()
                self.strayed = not self._target.is_bound()
                self.drawn = self._target.read()
        finally:
            tenant.__exit__()


class Drawing:
    """The sectors of a fan that a host draws.

    Attributes
    ----------
    hearing : Hearing
    near_m : of the projections
    """

    def __init__(self, tenant: Tenant, hearing: Hearing, near_m: float):
        sonar = hearing.fan.sonar
        # what lies at the least range, in the corner of a sector, lies as far ahead as this
        half = max(sector.half_width_rad for sector in hearing.fan.sectors)
        most = sonar.range_min_m * math.cos(half) * math.cos(math.radians(sonar.elevation_fov_deg) / 2)
        most = max(most, NEAR_M)
        if isinstance(near_m, bool) or not isinstance(near_m, (int, float)) or not 0 < near_m <= most:
            raise Error(
                f"near_m must be metres above 0 and no more than {most:.3g}, to cut nothing that is heard "
                f"(got {near_m!r})"
            )
        self.hearing, self.near_m, self._pose, self._sectors = hearing, near_m, None, []
        self._far_m = FAR_FACTOR * sonar.range_max_m
        self._targets = [Target(tenant, sector) for sector in hearing.fan.sectors]

    def aim(self, pose) -> list[DrawnSector]:
        """All sectors, looking from `pose`, world_from_sonar, to be drawn anew."""
        self._pose = pose
        self._sectors = [DrawnSector(one, pose, self.near_m, self._far_m) for one in self._targets]
        return self._sectors

    def views(self):
        """What was drawn, (sector, (R, C, 4), (R, C)) of each, and the pose."""
        if (n := sum(one.drawn is not None for one in self._sectors)) < len(self._sectors):
            raise Error(
                f"all sectors must be drawn before a ping is finished (got {n} of {len(self._sectors)}; draw "
                "each of the last call of Sensor.sectors inside its `with` block, without an exception)"
            )
        pairs = zip(self._targets, self._sectors, strict=True)
        return [(target.sector, *one.drawn) for target, one in pairs], self._pose

    def advice(self) -> str:
        """What to look at, if nothing was seen."""
        if any(one.strayed for one in self._sectors):
            return (
                "another framebuffer was bound as a block ended: bind and clear none while sectors are drawn"
            )
        return "gl_Position must be projection * view * position, with both matrices transposed for OpenGL"

    def close(self):
        """Give all back."""
        for target in self._targets:
            target.release()
        self.hearing.reducer.close()
