"""What plumes of bubbles do to a ping: the echoes of the bubbles, and the attenuation of what lies behind.

The sum of the bubbles' extinction cross sections over the cross section of a cell of directions at its range
is the optical depth τ; sound that travels there and back is attenuated by exp(−2τ). The shadow of a bubble is
spread over some centimetres, or a cell: about the Fresnel zone, √(λr) at most, and the aperture of a sonar,
which looks around what is near. Narrower shadows do not form.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import uint64

from sonar_gl.acoustics.boundary import bubble_backscattering, bubble_extinction
from sonar_gl.beamform.kernels.views import ViewIndex, find_surfaces
from sonar_gl.core.compiled import compiled, uncounted
from sonar_gl.sonar.fan import Fan

CELL_RAD = math.radians(0.5)  # in azimuth, and as much of the sine of elevation
SINGLE = -2  # of `SectorSamples.face_id`
SHADOW_M = 0.05  # width of a bubble's shadow, or a cell's width if that is more
LAYERS = 64  # of range, between the nearest bubble and the furthest
MIN_LAYER_M = 0.01
MAX_HALF_RAD = math.radians(80.0)  # more than half of any sector
MIN_RANGE_M = 0.1  # nearer bubbles count as if they were here: σ / r² would exceed all directions
# columns of `points`: azimuth from the middle of the plumes, sine of elevation, range, and two cross sections
AZIMUTH, SINE, RANGE, BACKSCATTER, EXTINCTION = range(5)
ECHO = 3  # column of point scatterers, after the first three of `points`: steradians
# elements of `grid`: where the first cell is, and how far apart cells are
FIRST_AZIMUTH, FIRST_SINE, FIRST_RANGE, AZIMUTH_STEP, SINE_STEP, RANGE_STEP = range(6)


class BubbleShadow(NamedTuple):
    """The optical depth of bubbles, as seen from one pose.

    points : (n, 5) of the bubbles in or about the fan; columns AZIMUTH to EXTINCTION
    middle : azimuth from which those of `points` and `grid` count
    grid : (6,) azimuth, sine of elevation and range of the first cell, and their steps
    tau : (I, J, L + 1) optical depth at the near end of each layer of range, and at the far end of the last
    """

    points: np.ndarray
    middle: float
    grid: np.ndarray
    tau: np.ndarray


@compiled
def _share(i, x, half):
    """Return the share of cell i in what is spread evenly within `half` of x, in cells; half is 0.5 or more."""
    return max(min(x + half, i + 0.5) - max(x - half, i - 0.5), 0.0) / (2 * half)


@compiled
def _add_depth(points, grid, tau):
    """Share the extinction of bubbles among the cells about each, then sum τ over range.

    points, grid : of BubbleShadow
    tau : of BubbleShadow, zeros
    """
    solid_angle = grid[AZIMUTH_STEP] * grid[SINE_STEP]
    for n in range(points.shape[0]):
        x = (points[n, AZIMUTH] - grid[FIRST_AZIMUTH]) / grid[AZIMUTH_STEP]
        y = (points[n, SINE] - grid[FIRST_SINE]) / grid[SINE_STEP]
        layer = min(int((points[n, RANGE] - grid[FIRST_RANGE]) / grid[RANGE_STEP]), tau.shape[2] - 2) + 1
        r = max(points[n, RANGE], MIN_RANGE_M)
        depth, half = points[n, EXTINCTION] / (r * r * solid_angle), max(0.5, SHADOW_M / (2 * r * CELL_RAD))
        for i in range(max(int(x + 0.5 - half), 0), min(int(x + 1.5 + half), tau.shape[0])):
            across = depth * _share(i, x, half)
            for j in range(max(int(y + 0.5 - half), 0), min(int(y + 1.5 + half), tau.shape[1])):
                tau[i, j, layer] += across * _share(j, y, half)
    for i in range(tau.shape[0]):
        for j in range(tau.shape[1]):
            for k in range(1, tau.shape[2]):
                tau[i, j, k] += tau[i, j, k - 1]


@uncounted
def _depth(azimuth, sine, r, grid, tau):
    """Return τ on the way to a position, azimuth as in `points`; 0 outside the plume."""
    x, y = (azimuth - grid[FIRST_AZIMUTH]) / grid[AZIMUTH_STEP], (sine - grid[FIRST_SINE]) / grid[SINE_STEP]
    if not (0.0 <= x < tau.shape[0] - 1 and 0.0 <= y < tau.shape[1] - 1) or r <= grid[FIRST_RANGE]:
        return 0.0
    i, j = int(x), int(y)
    z = min((r - grid[FIRST_RANGE]) / grid[RANGE_STEP], tau.shape[2] - 1.0)
    k = min(int(z), tau.shape[2] - 2)
    x, y, z, out = x - i, y - j, z - k, 0.0
    for a in range(2):
        for b in range(2):
            share = (x if a else 1 - x) * (y if b else 1 - y)
            near, far = tau[i + a, j + b, k], tau[i + a, j + b, k + 1]
            out += share * (near + z * (far - near))
    return out


@uncounted
def _attenuate(plane_echo, face_id, sectors, middle, grid, tau):
    """Multiply the echo of each sample of a view by exp(−2τ), in place, and give those that change faces of their own.

    plane_echo, sectors : of ViewIndex; middle : azimuth from which those of the grid count
    face_id : of ViewSamples
    """
    half = grid[AZIMUTH_STEP] * (tau.shape[0] - 1) / 2
    last = grid[FIRST_SINE] + grid[SINE_STEP] * (tau.shape[1] - 1)
    for k in range(sectors.shape[0]):
        t = sectors[k]
        # the middle of the grid, from the sector's axis
        beside = grid[FIRST_AZIMUTH] + half + middle - math.atan2(t.sin, t.cos)
        beside -= 2 * math.pi * math.floor(beside / (2 * math.pi) + 0.5)
        low_u = -math.tan(min(beside + half, MAX_HALF_RAD))
        high_u = -math.tan(max(beside - half, -MAX_HALF_RAD))
        for row in range(t.rows):
            start = t.u0 + t.uj * row
            first = max(math.ceil((low_u - start) / t.ui), 0.0)
            end = min(math.floor((high_u - start) / t.ui) + 1.0, t.columns)
            for column in range(int(first), int(end)):
                j, i = uint64(row), uint64(t.left + column)
                q = plane_echo[j, i, 0]
                if q <= 0.0:
                    continue
                u, v = start + t.ui * column, t.v0 + t.vi * column + t.vj * row
                length = math.sqrt(1.0 + u * u + v * v)
                if grid[FIRST_SINE] * length < v < last * length and length > q * grid[FIRST_RANGE]:
                    azimuth = grid[FIRST_AZIMUTH] + half - beside - math.atan(u)
                    depth = _depth(azimuth, v / length, length / q, grid, tau)
                    if depth > 0.0:
                        plane_echo[j, i, 3] *= math.exp(-2.0 * depth)
                        if face_id.shape[0] > 0:
                            face_id[j, i] = SINGLE - row


@compiled
def _find_directions(points, middle, out):
    """Fill (3, n) `out` with unit vectors to the bubbles in the sonar's frame."""
    for n in range(points.shape[0]):
        azimuth, sine = points[n, AZIMUTH], points[n, SINE]
        level, true = math.sqrt(max(1.0 - sine * sine, 0.0)), azimuth + middle
        out[0, n], out[1, n], out[2, n] = level * math.cos(true), level * math.sin(true), sine


@compiled
def _find_echoes(points, middle, grid, tau, surfaces, out):
    """Find azimuth, sine of elevation, range and echo of each bubble that no surface hides.

    surfaces : (n,) inverse distance of the surface in the direction of each bubble; −1 outside the fan
    out : (n, 4), filled from the front; returns how many there are
    """
    count = 0
    for n in range(points.shape[0]):
        azimuth, sine, r = points[n, AZIMUTH], points[n, SINE], points[n, RANGE]
        if surfaces[n] < 0.0 or surfaces[n] * r > 1.0:
            continue
        tau_here = _depth(azimuth, sine, r, grid, tau)
        # less what the bubble itself has contributed
        across = (azimuth - grid[FIRST_AZIMUTH]) / grid[AZIMUTH_STEP]
        up = (sine - grid[FIRST_SINE]) / grid[SINE_STEP]
        along = (r - grid[FIRST_RANGE]) / grid[RANGE_STEP]
        along -= min(int(along), tau.shape[2] - 2)
        held = max(r, MIN_RANGE_M)
        half, i, j = max(0.5, SHADOW_M / (2 * held * CELL_RAD)), int(across), int(up)
        own = (i + 1 - across) * _share(i, across, half) + (across - i) * _share(i + 1, across, half)
        own *= (j + 1 - up) * _share(j, up, half) + (up - j) * _share(j + 1, up, half)
        own *= along
        tau_here -= own * points[n, EXTINCTION] / (held * held * grid[AZIMUTH_STEP] * grid[SINE_STEP])
        true = azimuth + middle
        turns = math.floor(true / (2 * math.pi) + 0.5)
        out[count, AZIMUTH], out[count, SINE], out[count, RANGE] = true - 2 * math.pi * turns, sine, r
        solid_angle = math.pi * points[n, BACKSCATTER] / (held * held)
        out[count, ECHO] = solid_angle * math.exp(-2.0 * max(tau_here, 0.0))
        count += 1
    return count


def _wrapped(azimuth_rad):
    """Return the same directions within ±π."""
    return (azimuth_rad + math.pi) % (2 * math.pi) - math.pi


def find_shadow(bubbles: np.ndarray, pose, fan: Fan) -> BubbleShadow | None:
    """Return the optical depth of bubbles as seen from a pose; None if none lies in or about the fan.

    bubbles : (n, 4) x y z in the world and radius, metres
    pose : (4, 4) world_from_sonar
    """
    positions = (bubbles[:, :3] - pose[:3, 3]) @ pose[:3, :3]
    r = np.maximum(np.linalg.norm(positions, axis=1), 1e-6)
    sine, azimuth = positions[:, 2] / r, np.arctan2(positions[:, 1], positions[:, 0])
    edges, top = fan.column_edges_rad, fan.max_sine
    shown = azimuth
    if fan.are_cones:  # those behind the array are in no view of the fan
        shown = np.arcsin(np.clip(positions[:, 1] / r, -1, 1))
    off = np.abs(_wrapped(shown - (edges[0] + edges[-1]) / 2))
    reach = np.maximum(SHADOW_M / (2 * np.maximum(r, MIN_RANGE_M)), CELL_RAD)  # of a bubble's shadow
    near = (off < (edges[-1] - edges[0]) / 2 + reach) & (np.abs(sine) < top + reach)
    near &= r < fan.sonar.range_max_m
    if not near.any():
        return None
    # azimuths count from the middle of the plumes, so that they wrap where there are none
    x, y, _ = positions[near].mean(axis=0)
    middle, radii = math.atan2(y, x), bubbles[near, 3]
    points = np.column_stack([_wrapped(azimuth - middle), sine, r])[near]
    apart = np.outer(reach[near], [1, 1, 0])
    low, high = (points - apart).min(axis=0), (points + apart).max(axis=0)
    steps = np.array([CELL_RAD, CELL_RAD, max((high[2] - low[2]) / LAYERS, MIN_LAYER_M)])
    low[:2] -= CELL_RAD
    cells = (np.ceil((high - low) / steps)[:2] + 2).astype(int)
    grid, tau = np.concatenate([low, steps]), np.zeros((*cells, LAYERS + 1))
    points = np.column_stack([points, bubble_backscattering(radii), bubble_extinction(radii)])
    _add_depth(points, grid, tau)
    return BubbleShadow(points, middle, grid, tau)


def attenuate(view: ViewIndex, face_id: np.ndarray, shadow: BubbleShadow | None) -> None:
    """Attenuate the samples of a view behind bubbles, in place.

    view, face_id : of the ping's samples; face_id of `ViewSamples`, changed where the echo changes
    """
    if shadow is not None:
        _attenuate(view.plane_echo, face_id, view.sectors, shadow.middle, shadow.grid, shadow.tau)


def find_echoes(view: ViewIndex, shadow: BubbleShadow | None) -> np.ndarray:
    """Return bubbles that no surface of a view hides as point scatterers.

    A bubble of backscattering cross section σ_bs adds π σ_bs / r² to the sum over solid angle of μ cos θ: a
    small area dA at θ adds μ cos²θ dA / r², and its σ_bs is μ cos²θ dA / π.

    Returns (m, 4) float64: azimuth, sine of elevation, range, and steradians.
    """
    if shadow is None:
        return np.empty((0, 4))
    points, middle, grid, tau = shadow
    directions, surfaces, out = np.empty((3, len(points))), np.empty(len(points)), np.empty((len(points), 4))
    _find_directions(points, middle, directions)
    find_surfaces(*directions, 0, len(points), tuple(view), surfaces)
    return out[: _find_echoes(points, middle, grid, tau, surfaces, out)]
