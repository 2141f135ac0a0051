"""Sectors that a host draws."""

from __future__ import annotations

import math

import numpy as np

from sonar_gl.camera import AHEAD, OPENGL
from sonar_gl.footprint import FAR_FACTOR
from sonar_gl.foreign import Tenant
from sonar_gl.hearing import Hearing
from sonar_gl.stock import NEAR_M
from sonar_gl.targets import MAX_RENDERBUFFER_SIZE, Target
from sonar_gl.types import Error


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
        sector, view_from_sonar = target.sector, np.eye(4)
        self.width, self.height = sector.columns, sector.rows
        self.rotation = sector.rotation().T @ AHEAD  # a sector looks along its x, upright, as a sonar does
        view_from_sonar[:3, :3] = (self.rotation @ OPENGL).T
        self.view = view_from_sonar @ np.linalg.inv(pose)
        self.projection = sector.projection(near_m, far_m) @ np.linalg.inv(view_from_sonar)
        self.lattice = np.stack([sector.u, sector.v, [1 / far_m, 0, 0]])
        self._target, self.drawn, self.strayed = target, None, False

    def __enter__(self):
        target = self._target
        if target.is_released:
            raise Error(
                "a sector must be one of the last call of Sensor.sectors (got one that was given back)"
            )
        target.tenant.__enter__()
        try:
            target.bind()
            target.tenant.guard.tell_errors()
        except BaseException:
            target.tenant.__exit__()
            raise
        target.is_drawn = True
        return self

    def __exit__(self, failed, *_):
        tenant, self._target.is_drawn = self._target.tenant, False
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
        is_number = isinstance(near_m, (int, float, np.number)) and not isinstance(near_m, bool)
        if not is_number or not 0 < near_m <= most:
            raise Error(
                f"near_m must be metres above 0 and no more than {most:.3g}, to cut nothing that is heard "
                f"(got {near_m!r})"
            )
        self.hearing, self.near_m, self._pose, self._sectors = hearing, near_m, None, []
        self._far_m = FAR_FACTOR * sonar.range_max_m
        self._targets = [Target(tenant, sector) for sector in hearing.fan.sectors]
        limit = tenant.gl.integer(MAX_RENDERBUFFER_SIZE)
        columns, rows = (max(getattr(s, side) for s in hearing.fan.sectors) for side in ("columns", "rows"))
        if max(columns, rows) > limit:
            raise Error(
                f"samples must fit the driver's limit of {limit} by {limit} pixels (got {columns} columns by "
                f"{rows} rows; ask for a larger tolerance or fewer samples)"
            )

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

    @property
    def things(self) -> list[Target]:
        """What is to be given back."""
        return self._targets

    def is_being_drawn(self) -> bool:
        """Whether the host is inside the block of a sector."""
        return any(target.is_drawn for target in self._targets)
