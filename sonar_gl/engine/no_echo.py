"""Why a ping has no echo, in one sentence."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from sonar_gl.core.poses import pose as make_pose
from sonar_gl.engine.instrument import Instrument
from sonar_gl.scene.extent import other_unit_text
from sonar_gl.scene.scene import Body, Scene
from sonar_gl.scene.state import SceneState
from sonar_gl.sonar.fan import SURFACE_MARGIN_M
from sonar_gl.sonar.samples import SectorSamples
from sonar_gl.sonar.sonar import Sonar

MOST_IN_A_ROW = 5  # warnings of pings without echo
ECHO_LOST = "no echo came back: what returned one in the ping before has left the fan, or its range"
WIDEST_WEDGE_DEG = 30.0  # whose planar ends reach beyond the elevations of the fan by 3 % at most


class NoEchoWarning(UserWarning):
    """A ping has no echo."""


class SilentPings:
    """Counts the pings without echo in a row: the first MOST_IN_A_ROW are explained.

    To explain takes many times as long as such a ping, and a vehicle in open water has thousands. In a live loop, which
    it would stall, a row after a ping with echo is not explained: what was seen has just left.
    """

    def __init__(self):
        self._in_a_row, self._had_echo = 0, False

    def start_again(self) -> None:
        """Have the next ping be the first in a row, after none with echo."""
        self._in_a_row, self._had_echo = 0, False

    def is_to_explain(self, total: float, is_live: bool) -> bool:
        """Return whether the next ping, with this sum of its echo, is to be explained.

        is_live : it follows the pings before, in small steps
        """
        return total <= 0 and self._in_a_row < MOST_IN_A_ROW and not (is_live and self._had_echo)

    def has_lost_echo(self, total: float, is_live: bool) -> bool:
        """Return whether the next ping, with this sum of its echo, is the first of a row that is not explained."""
        return total <= 0 and self._in_a_row == 0 and is_live and self._had_echo

    def add(self, total: float) -> None:
        """Count a ping, with this sum of its echo."""
        self._in_a_row = self._in_a_row + 1 if total <= 0 else 0
        self._had_echo = self._had_echo or total > 0


def why_no_echo(
    scene: Scene, state: SceneState, instrument: Instrument, pose, samples: Sequence[SectorSamples]
) -> str:
    """Return which surface is nearest, and why it returned no echo; ranges are those that the sonar shows."""
    sonar, acoustics = instrument.sonar, instrument.acoustics
    true_range, top_deg = acoustics.true_range_sonar(sonar), acoustics.max_elevation_deg(sonar)
    if not scene.bodies:
        return "no echo came back: the scene has no bodies"
    if not state.present.any():
        return "no echo came back: all bodies of the scene are absent"
    inside = _nearest_in_view(samples)
    if inside is not None:
        return _why_nearest_has_no_echo(sonar, true_range, *inside) + _scale_hint(scene)
    beyond_m = _nearest_beyond(scene, state, pose, true_range, top_deg)
    if beyond_m is not None:
        shown_m = _shown_m(beyond_m, sonar, true_range)
        nearest = f"the nearest surface in the fan lies at {_length(shown_m)}"
        reason = f"no echo came back: {nearest}, beyond range_max_m = {sonar.range_max_m:g}"
        return reason + _scale_hint(scene)
    nearest = _nearest_body(scene, state, pose)
    if nearest is None:
        return (
            "no echo came back: all bodies lie above the water's surface at "
            f"z = {scene.surface_z_m:.4g} m, in which the sonar is; give the scene another surface (--surface, "
            "Scene.with_surface)"
        )
    name, point = nearest
    range_m = float(np.linalg.norm(point))
    azimuth = math.degrees(math.atan2(point[1], point[0]))
    elevation = math.degrees(math.atan2(point[2], math.hypot(point[0], point[1])))
    if range_m == 0 or (abs(azimuth) <= sonar.azimuth_fov_deg / 2 and abs(elevation) <= top_deg):
        return (
            f"no echo came back: no sample met a surface; the nearest is {name!r}, {_length(range_m)} away: it is seen "
            "edge-on, or is thinner than the samples; move the sonar" + _scale_hint(scene)
        )
    return (
        f"no echo came back: no surface lies in the fan; the nearest is {name!r}, {_length(range_m)} away at "
        f"azimuth {azimuth:.1f}° and elevation {elevation:.1f}° of the sonar, which sees azimuths within "
        f"±{sonar.azimuth_fov_deg / 2:g}° and elevations within ±{top_deg:.4g}°; turn or move the sonar"
        + _scale_hint(scene)
    )


def _shown_m(true_range_m: float, sonar: Sonar, true_range: Sonar) -> float:
    """Return the range at which a sonar shows what lies at a true range; its bins are those of `true_range`."""
    return true_range_m * sonar.range_max_m / true_range.range_max_m


def _length(length_m: float) -> str:
    return f"{length_m:.2f} m" if length_m < 1000 else f"{length_m / 1000:.2f} km"


def _scale_hint(scene: Scene) -> str:
    """Return the size of a scene that is suspiciously large, and how to scale it; else ""."""
    text = other_unit_text(scene)
    return f"; {text}" if text else ""


def why_view_has_no_echo(sonar: Sonar, true_range: Sonar, samples: Sequence[SectorSamples]) -> str | None:
    """Return why the nearest surface in the fan returned no echo, or None if there is none; as `why_no_echo`."""
    inside = _nearest_in_view(samples)
    return None if inside is None else _why_nearest_has_no_echo(sonar, true_range, *inside)


def _why_nearest_has_no_echo(sonar: Sonar, true_range: Sonar, true_range_m: float, echo: float) -> str:
    range_m = _shown_m(true_range_m, sonar, true_range)
    nearest = f"the nearest surface in the fan lies at {_length(range_m)}"
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
    for sector, plane_echo, *_ in samples:
        u, v = sector.sample_coordinates()
        seen = sector.holds_elevation(u, v) & (plane_echo[..., 0] > 0)
        if seen.any():
            ranges = np.full(seen.shape, np.inf)
            ranges[seen] = np.sqrt(1 + u * u + v * v)[seen] / plane_echo[..., 0][seen]
            at = np.unravel_index(ranges.argmin(), ranges.shape)
            if best is None or ranges[at] < best[0]:
                best = (float(ranges[at]), float(plane_echo[..., 3][at]))
    return best


def _nearest_beyond(scene: Scene, state: SceneState, pose, sonar: Sonar, top_deg: float) -> float | None:
    """Return the range of the nearest surface in the fan that is too far to be drawn, metres; None if there is none.

    The fan is cut into wedges between four planes, which the bodies are cut by.

    sonar : with true ranges, as the range is
    """
    from trimesh.intersections import slice_faces_plane
    from trimesh.triangles import closest_point

    n_wedges = math.ceil(sonar.azimuth_fov_deg / WIDEST_WEDGE_DEG)
    half = math.radians(sonar.azimuth_fov_deg) / 2 / n_wedges
    # at the highest elevation in the wedge's sides, above it between them
    slope = math.tan(math.radians(top_deg)) / math.cos(half)
    inward = [[math.sin(half), math.cos(half), 0], [math.sin(half), -math.cos(half), 0]]
    inward += [[slope, 0, 1], [slope, 0, -1]]
    nearest_m = math.inf
    for _, vertices, wet_faces in _bodies_in_water(scene, state, pose):
        if not np.isfinite(vertices).all():
            continue
        if np.linalg.norm(vertices, axis=1).max(initial=0.0) < sonar.range_max_m:
            continue  # it was drawn, and is not in the fan
        for wedge in range(n_wedges):
            turn = make_pose(yaw=(2 * wedge + 1 - n_wedges) * half)[:3, :3]
            corners, faces = vertices, wet_faces
            for normal in np.array(inward) @ turn.T:
                corners, faces = slice_faces_plane(corners, faces, normal, np.zeros(3))[:2]
            if len(faces):
                points = closest_point(corners[faces], np.zeros((len(faces), 3)))
                nearest_m = min(nearest_m, float(np.linalg.norm(points, axis=1).min()))
    return nearest_m if sonar.range_max_m <= nearest_m < math.inf else None


def _nearest_body(scene: Scene, state: SceneState, pose):
    """Return the name of the nearest body and its nearest point, metres in the sonar frame; None if all are in air."""
    from trimesh.triangles import closest_point

    best = None
    for body, vertices, faces in _bodies_in_water(scene, state, pose):
        if not len(faces):
            continue
        points = closest_point(vertices[faces], np.zeros((len(faces), 3)))
        squares = (points**2).sum(axis=1)
        index = np.nanargmin(squares) if np.isfinite(squares).any() else 0
        if best is None or squares[index] < best[0]:
            best = squares[index], body.name, points[index]
    return None if best is None else best[1:]


def _bodies_in_water(scene: Scene, state: SceneState, pose) -> Iterator[tuple[Body, np.ndarray, np.ndarray]]:
    """Yield each body that is present, with what `_in_water` returns of it."""
    for body, body_pose, is_present in zip(scene.bodies, state.poses, state.present, strict=True):
        if is_present:
            yield body, *_in_water(body, body_pose, pose, scene.surface_z_m)


def _in_water(body: Body, body_pose, pose, surface_z_m: float | None) -> tuple[np.ndarray, np.ndarray]:
    """Return (V, 3) vertices in the sonar frame and (F, 3) faces of a body, without what is above a sonar's water."""
    from trimesh.intersections import slice_faces_plane

    matrix, faces = np.linalg.inv(pose) @ body_pose, np.asarray(body.surface.faces)
    vertices = np.asarray(body.surface.vertices, np.float64) @ matrix[:3, :3].T + matrix[:3, 3]
    if surface_z_m is None or pose[2, 3] >= surface_z_m or not np.isfinite(vertices).all():
        return vertices, faces
    up = pose[2, :3]
    return slice_faces_plane(vertices, faces, -up, up * (surface_z_m - SURFACE_MARGIN_M - pose[2, 3]))[:2]
