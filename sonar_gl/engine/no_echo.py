"""Why a ping has no echo, in one sentence."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from sonar_gl.scene.scene import Scene
from sonar_gl.scene.state import SceneState
from sonar_gl.sonar.samples import SectorSamples
from sonar_gl.sonar.sonar import Sonar


def why_no_echo(
    scene: Scene, state: SceneState, sonar: Sonar, true_range: Sonar, pose, samples: Sequence[SectorSamples]
) -> str:
    """Return which surface is nearest, and why it returned no echo.

    Parameters
    ----------
    sonar, true_range : as given, and of `Acoustics.true_range_sonar`; the message has ranges as the sonar shows them
    """
    if not scene.bodies:
        return "no echo came back: the scene has no bodies"
    if not state.present.any():
        return "no echo came back: all bodies of the scene are absent"
    reason = why_view_has_no_echo(sonar, true_range, samples)
    if reason is not None:
        return reason
    name, point = _nearest_body(scene, state, pose)
    range_m = float(np.linalg.norm(point))
    azimuth = math.degrees(math.atan2(point[1], point[0]))
    elevation = math.degrees(math.atan2(point[2], math.hypot(point[0], point[1])))
    return (
        f"no echo came back: no surface lies in the fan; the nearest is {name!r}, {range_m:.2f} m away at "
        f"azimuth {azimuth:.1f}° and elevation {elevation:.1f}° of the sonar, which sees "
        f"±{sonar.azimuth_fov_deg / 2:g}° and ±{true_range.elevation_fov_deg / 2:.4g}°; turn or move the sonar"
    )


def why_view_has_no_echo(sonar: Sonar, true_range: Sonar, samples: Sequence[SectorSamples]) -> str | None:
    """Return why the nearest surface in the fan returned no echo, or None if there is none; as `why_no_echo`."""
    inside = _nearest_in_view(samples)
    if inside is None:
        return None
    range_m, echo = inside[0] * sonar.range_max_m / true_range.range_max_m, inside[1]
    nearest = f"the nearest surface in the fan lies at {range_m:.2f} m"
    if range_m >= sonar.range_max_m:
        return f"no echo came back: {nearest}, beyond range_max_m = {sonar.range_max_m:g}"
    if range_m < sonar.range_min_m:
        return f"no echo came back: {nearest}, nearer than range_min_m = {sonar.range_min_m:g}"
    if echo <= 0:
        return f"no echo came back: {nearest}; its reflectivity is 0, or it is seen edge-on"
    return f"no echo came back: {nearest}; its echo is too weak to differ from 0"


def _nearest_in_view(samples):
    """Return (range, echo) of the nearest sample inside the aperture, or None."""
    best = None
    for sector, plane_echo, _ in samples:
        u, v = sector.sample_coordinates()
        seen = (np.abs(v) < sector.tan_elevation * np.sqrt(1 + u * u)) & (plane_echo[..., 0] > 0)
        if seen.any():
            ranges = np.full(seen.shape, np.inf)
            ranges[seen] = np.sqrt(1 + u * u + v * v)[seen] / plane_echo[..., 0][seen]
            at = np.unravel_index(ranges.argmin(), ranges.shape)
            if best is None or ranges[at] < best[0]:
                best = (float(ranges[at]), float(plane_echo[..., 3][at]))
    return best


def _nearest_body(scene: Scene, state: SceneState, pose):
    """Return the name of the nearest body and its nearest point, metres in the sonar frame."""
    from trimesh.triangles import closest_point

    best = None
    for body, body_pose, is_present in zip(scene.bodies, state.poses, state.present, strict=True):
        if not is_present:
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
