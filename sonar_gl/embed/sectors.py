"""Sectors of the fan that a host draws with its own shaders."""

from __future__ import annotations

import math

import numpy as np

from sonar_gl.core.checks import is_number
from sonar_gl.core.errors import Error
from sonar_gl.embed.camera import OPTICAL_FROM_OPENGL, SONAR_FROM_OPTICAL
from sonar_gl.embed.framebuffer import MAX_RENDERBUFFER_SIZE, Framebuffer
from sonar_gl.engine.stage import Stage
from sonar_gl.gl.host import HostContext
from sonar_gl.sonar.fan import FAR_FACTOR, NEAR_M
from sonar_gl.sonar.samples import SectorSamples
from sonar_gl.sonar.sonar import Sonar


class DrawnSector:
    """One perspective view of part of the fan, for a host to draw in a `with` block.

    Inside the block the sector's framebuffer is bound and empty, the viewport is set, the depth test is on, and all
    other state that affects drawing has OpenGL's default. The block restores the host's state as it ends.

    Attributes
    ----------
    view : (4, 4) float64, eye_from_world, OpenGL's axes: x right, y up, z back
    projection : (4, 4) float64, clip_from_eye, a sheared perspective
    lattice : (3, 3) float64, value of the uniform sonar_gl_lattice of `embed.glsl`
    width, height : pixels
    rotation : (3, 3) float64, sonar_from_camera, optical axes: x right, y down, z ahead; with the tilt of the head
    samples : SectorSamples read at the end of the block, or None
    lost_framebuffer : whether the host had another framebuffer bound at the end of the block

    Matrices multiply column vectors; OpenGL takes their transposes.
    """

    def __init__(self, framebuffer: Framebuffer, sonar: Sonar, pose, near_m: float, far_m: float):
        sector, view_from_head = framebuffer.sector, np.eye(4)
        self.width, self.height = sector.columns, sector.rows
        head_from_camera = sector.rotation().T @ SONAR_FROM_OPTICAL  # a sector's axes are those of a sonar
        view_from_head[:3, :3] = (head_from_camera @ OPTICAL_FROM_OPENGL).T
        self.rotation = sonar.sonar_from_head[:3, :3] @ head_from_camera
        self.view = view_from_head @ np.linalg.inv(sonar.head_pose(pose))
        self.projection = sector.projection(near_m, far_m) @ np.linalg.inv(view_from_head)
        self.lattice = np.stack([sector.u, sector.v, [1 / far_m, 0, 0]])
        self._framebuffer, self.samples, self.lost_framebuffer = framebuffer, None, False
        self._n_outer_blocks = 0  # of the host's guard, while this one is drawn

    def __enter__(self) -> DrawnSector:
        framebuffer = self._framebuffer
        if framebuffer.is_released:
            raise Error("a sector must be one of the last call of Sensor.sectors (got one that was released)")
        host, self._n_outer_blocks = framebuffer.host, framebuffer.host.guard.n_blocks
        try:
            host.__enter__()
            framebuffer.bind()
            host.guard.resume_debug_output()
            framebuffer.is_being_drawn = True
            return self
        except BaseException:
            framebuffer.is_being_drawn = False
            if host.guard.n_blocks > self._n_outer_blocks:  # else it is what `host` raised as it was entered
                host.leave()
            raise

    def __exit__(self, failed, *_) -> None:
        framebuffer, host = self._framebuffer, self._framebuffer.host
        try:
            framebuffer.is_being_drawn = False
            if host.is_in_reach():
                host.guard.save_host_errors()
            if failed is None:
                host.check()
                self.lost_framebuffer = not framebuffer.is_bound()
                self.samples = SectorSamples(framebuffer.sector, *framebuffer.read())
        finally:
            try:
                host.leave()
            except BaseException:  # an interrupt
                if host.is_in_reach():
                    host.end_blocks(self._n_outer_blocks)
                raise


class Drawing:
    """The framebuffers of a fan's sectors in a host's context, and the sectors of the current pose."""

    def __init__(self, host: HostContext, stage: Stage, near_m: float):
        sonar, sectors = stage.fan.sonar, stage.fan.sectors
        # the depth, along a sector's axis, of a point at range_min_m in the corner of the sector
        half = max(sector.half_width_rad for sector in sectors)
        max_m = sonar.range_min_m * math.cos(half) * math.cos(math.radians(sonar.elevation_fov_deg) / 2)
        max_m = max(max_m, NEAR_M)
        if not (is_number(near_m) and 0 < near_m <= max_m):
            raise Error(
                f"near_m must be metres above 0 and no more than {max_m:.3g}, to cut nothing in range "
                f"(got {near_m!r})"
            )
        self.stage, self.near_m, self._pose, self._sectors = stage, near_m, None, []
        self._far_m = FAR_FACTOR * sonar.range_max_m
        self.framebuffers = [Framebuffer(host, sector) for sector in sectors]
        limit = host.gl.integer(MAX_RENDERBUFFER_SIZE)
        columns, rows = (max(getattr(s, side) for s in sectors) for side in ("columns", "rows"))
        if max(columns, rows) > limit:
            raise Error(
                f"samples must fit the driver's limit of {limit} by {limit} pixels (got {columns} columns by "
                f"{rows} rows; ask for a larger tolerance or fewer samples)"
            )

    def make_sectors(self, pose) -> list[DrawnSector]:
        """Return new sectors, seen from `pose`, world_from_sonar; those of the last pose are discarded."""
        self._pose = pose
        settings = self.stage.fan.sonar, pose, self.near_m, self._far_m
        self._sectors = [DrawnSector(framebuffer, *settings) for framebuffer in self.framebuffers]
        return self._sectors

    def samples(self) -> tuple[list[SectorSamples], np.ndarray]:
        """Return the samples of all sectors, and the pose of the sonar for which the host drew them."""
        if (n := sum(one.samples is not None for one in self._sectors)) < len(self._sectors):
            raise Error(
                f"all sectors must be drawn before a ping is finished (got {n} of {len(self._sectors)}; draw "
                "each of the last call of Sensor.sectors inside its `with` block, without an exception)"
            )
        return [one.samples for one in self._sectors], self._pose

    def advice(self) -> str:
        """Return what the host should check if the samples are empty."""
        if any(one.lost_framebuffer for one in self._sectors):
            return (
                "another framebuffer was bound as a block ended: bind and clear none while sectors are drawn"
            )
        return "gl_Position must be projection * view * position, with both matrices transposed for OpenGL"

    def is_being_drawn(self) -> bool:
        return any(framebuffer.is_being_drawn for framebuffer in self.framebuffers)
