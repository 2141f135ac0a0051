"""Why a ping came back empty, in one sentence."""

from __future__ import annotations

import math

import numpy as np

from sonar_gl.scene import Scene
from sonar_gl.sonar import Sonar


def why_nothing(scene: Scene, where, sonar: Sonar, drawn: Sonar, pose, views) -> str:
    """What was nearest, and why nothing came back.

    Parameters
    ----------
    where : Whereabouts of the bodies
    sonar, drawn : as given, and of `Acoustics.drawn_sonar`; ranges are told as the sonar shows them
    views : (sector, (R, C, 4) plane and echo, _) of each sector, as rendered
    """
    if not scene.bodies:
        return "no echo came back: the scene has no bodies"
    if not where.shown.any():
        return "no echo came back: all bodies of the scene were taken away"
    seen = why_unheard(sonar, drawn, views)
    if seen is not None:
        return seen
    name, point = _nearest_body(scene, where, pose)
    range_m = float(np.linalg.norm(point))
    azimuth = math.degrees(math.atan2(point[1], point[0]))
    elevation = math.degrees(math.atan2(point[2], math.hypot(point[0], point[1])))
    return (
        f"no echo came back: no surface lies in the fan; the nearest is {name!r}, {range_m:.2f} m away at "
        f"azimuth {azimuth:.1f}° and elevation {elevation:.1f}° of the sonar, which sees "
        f"±{sonar.azimuth_fov_deg / 2:g}° and ±{drawn.elevation_fov_deg / 2:.4g}°; turn or move the sonar"
    )


def why_unheard(sonar: Sonar, drawn: Sonar, views) -> str | None:
    """Why what lies in the fan was not heard, or None if nothing does; arguments as of `why_nothing`."""
    inside = _nearest_in_view(views)
    if inside is None:
        return None
    range_m, echo = inside[0] * sonar.range_max_m / drawn.range_max_m, inside[1]
    where = f"the nearest surface in the fan lies at {range_m:.2f} m"
    if range_m >= sonar.range_max_m:
        return f"no echo came back: {where}, beyond range_max_m = {sonar.range_max_m:g}"
    if range_m < sonar.range_min_m:
        return f"no echo came back: {where}, nearer than range_min_m = {sonar.range_min_m:g}"
    if echo <= 0:
        return f"no echo came back: {where}, of reflectivity 0 or seen edge-on"
    return f"no echo came back: {where}, and its echo is too weak to be told from zero"


def _nearest_in_view(views):
    """(range, echo) of the nearest sample inside the aperture, or None."""
    best = None
    for sector, plane_echo, _ in views:
        u, v = sector.rays()
        seen = (np.abs(v) < sector.tan_elevation * np.sqrt(1 + u * u)) & (plane_echo[..., 0] > 0)
        if seen.any():
            ranges = np.full(seen.shape, np.inf)
            ranges[seen] = np.sqrt(1 + u * u + v * v)[seen] / plane_echo[..., 0][seen]
            at = np.unravel_index(ranges.argmin(), ranges.shape)
            if best is None or ranges[at] < best[0]:
                best = (float(ranges[at]), float(plane_echo[..., 3][at]))
    return best


def _nearest_body(scene: Scene, where, pose):
    """Name of the nearest body and its nearest point, metres in the sonar frame."""
    from trimesh.triangles import closest_point

    best = None
    for body, body_pose, shown in zip(scene.bodies, where.poses, where.shown, strict=True):
        if not shown:
            continue
        sonar_from_body = np.linalg.inv(pose) @ body_pose
        origin = np.linalg.inv(sonar_from_body)[:3, 3]
        triangles = np.asarray(body.surface.vertices, np.float64)[np.asarray(body.surface.faces)]
        points = closest_point(triangles, np.broadcast_to(origin, (len(triangles), 3)))
        squares = ((points - origin) ** 2).sum(axis=1)
        index = np.nanargmin(squares) if np.isfinite(squares).any() else 0
        point = sonar_from_body[:3, :3] @ points[index] + sonar_from_body[:3, 3]
        if best is None or squares[index] < best[0]:
            best = (squares[index], body.name, point)
    return best[1], best[2]
