"""What plumes do to a ping: the echoes of their bubbles, and what they leave of what lies behind.

The sum over bubbles of what each takes out of the sound, over the cross-section that a cell of directions
has at its range, is the optical depth τ; sound that goes there and back is left exp(−2τ) of. The shadow of a
bubble is spread over some centimetres, or a cell: about the Fresnel zone, √(λr) at most, and the aperture of
a sonar, which looks around what is near. Narrower shadows do not form.
"""

from __future__ import annotations

import math

import numpy as np

from sonar_gl import lookup
from sonar_gl.bubbles import bubble_extinction, bubble_strength
from sonar_gl.compiled import compiled, compiled_with
from sonar_gl.lookup import Lookup, look_up

CELL_RAD = math.radians(0.5)  # in azimuth, and as much of the sine of elevation
SPREAD_M = 0.05  # a bubble's shadow is as wide, or as a cell
LAYERS = 64  # of range, between the nearest bubble and the farthest
THIN_M = 0.01  # a layer is no thinner
WIDEST_RAD = math.radians(80.0)  # more than half of any sector
NEAR_M = 0.1  # what bubbles do that are nearer is taken from here: σ / r² would exceed all directions


@compiled
def _share(i, x, half):
    """What cell i has of something that lies evenly within `half` of x, in cells; half is 0.5 or more."""
    return max(min(x + half, i + 0.5) - max(x - half, i - 0.5), 0.0) / (2 * half)


@compiled
def _add_depth(points, grid, tau):
    """Share bubbles among the cells about each of them, then sum τ up over range.

    Parameters
    ----------
    points : (n, 5) of `screen`
    grid : (6,) azimuth, sine of elevation and range of the first cell, and their steps
    tau : (I, J, L + 1), zeros; at the far end of each layer
    """
    solid_angle = grid[3] * grid[4]
    for n in range(points.shape[0]):
        x, y = (points[n, 0] - grid[0]) / grid[3], (points[n, 1] - grid[1]) / grid[4]
        layer = min(int((points[n, 2] - grid[2]) / grid[5]), tau.shape[2] - 2) + 1
        r = max(points[n, 2], NEAR_M)
        depth, half = points[n, 4] / (r * r * solid_angle), max(0.5, SPREAD_M / (2 * r * CELL_RAD))
        for i in range(max(int(x + 0.5 - half), 0), min(int(x + 1.5 + half), tau.shape[0])):
            across = depth * _share(i, x, half)
            for j in range(max(int(y + 0.5 - half), 0), min(int(y + 1.5 + half), tau.shape[1])):
                tau[i, j, layer] += across * _share(j, y, half)
    for i in range(tau.shape[0]):
        for j in range(tau.shape[1]):
            for k in range(1, tau.shape[2]):
                tau[i, j, k] += tau[i, j, k - 1]


@compiled
def _depth(azimuth, sine, r, grid, tau):
    """τ on the way to a place, azimuth as in `points`; 0 beside the plume."""
    x, y = (azimuth - grid[0]) / grid[3], (sine - grid[1]) / grid[4]
    if not (0.0 <= x < tau.shape[0] - 1 and 0.0 <= y < tau.shape[1] - 1) or r <= grid[2]:
        return 0.0
    i, j = int(x), int(y)
    z = min((r - grid[2]) / grid[5], tau.shape[2] - 1.0)
    k = min(int(z), tau.shape[2] - 2)
    x, y, z, out = x - i, y - j, z - k, 0.0
    for a in range(2):
        for b in range(2):
            share = (x if a else 1 - x) * (y if b else 1 - y)
            near, far = tau[i + a, j + b, k], tau[i + a, j + b, k + 1]
            out += share * (near + z * (far - near))
    return out


@compiled
def _weaken(picture, sectors, middle, grid, tau):
    """Leave exp(−2τ) of the echo of each sample of a picture, in place.

    Parameters
    ----------
    picture, sectors : of `Lookup`; middle : azimuth from which those of the grid count
    """
    half, last = grid[3] * (tau.shape[0] - 1) / 2, grid[1] + grid[4] * (tau.shape[1] - 1)
    for k in range(sectors.shape[0]):
        t = sectors[k]
        # the middle of the grid, from the sector's axis
        beside = grid[0] + half + middle - math.atan2(t[1], t[0])
        beside -= 2 * math.pi * math.floor(beside / (2 * math.pi) + 0.5)
        low_u, high_u = -math.tan(min(beside + half, WIDEST_RAD)), -math.tan(max(beside - half, -WIDEST_RAD))
        for row in range(int(t[16])):
            start = t[4] + t[6] * row
            first = max(math.ceil((low_u - start) / t[5]), 0.0)
            end = min(math.floor((high_u - start) / t[5]) + 1.0, t[15])
            for column in range(int(first), int(end)):
                at = picture[row, int(t[14]) + column]
                if at[0] <= 0.0:
                    continue
                u, v = start + t[5] * column, t[7] + t[8] * column + t[9] * row
                length = math.sqrt(1.0 + u * u + v * v)
                if grid[1] * length < v < last * length and length > at[0] * grid[2]:
                    azimuth = grid[0] + half - beside - math.atan(u)
                    depth = _depth(azimuth, v / length, length / at[0], grid, tau)
                    at[3] *= math.exp(-2.0 * depth)


@compiled_with(lookup)
def _hear(points, middle, grid, tau, picture, sectors, out):
    """Of each bubble that is not hidden, azimuth, sine of elevation, range and what it adds to a ping.

    out : (n, 4), filled from the front; returns how many there are
    """
    count = 0
    for n in range(points.shape[0]):
        azimuth, sine, r = points[n, 0], points[n, 1], points[n, 2]
        level, true = math.sqrt(max(1.0 - sine * sine, 0.0)), azimuth + middle
        x, y = level * math.cos(true), level * math.sin(true)
        seen, ahead = look_up(x, y, sine, picture, sectors)
        if seen < 0.0 or seen * ahead * r > 1.0:
            continue
        tau_here = _depth(azimuth, sine, r, grid, tau)
        # less what the bubble itself has put there
        across, up = (azimuth - grid[0]) / grid[3], (sine - grid[1]) / grid[4]
        along = (r - grid[2]) / grid[5]
        along -= min(int(along), tau.shape[2] - 2)
        held = max(r, NEAR_M)
        half, i, j = max(0.5, SPREAD_M / (2 * held * CELL_RAD)), int(across), int(up)
        own = (i + 1 - across) * _share(i, across, half) + (across - i) * _share(i + 1, across, half)
        own *= (j + 1 - up) * _share(j, up, half) + (up - j) * _share(j + 1, up, half)
        own *= along
        tau_here -= own * points[n, 4] / (held * held * grid[3] * grid[4])
        turns = math.floor(true / (2 * math.pi) + 0.5)
        out[count, 0], out[count, 1], out[count, 2] = true - 2 * math.pi * turns, sine, r
        out[count, 3] = math.pi * points[n, 3] / (held * held) * math.exp(-2.0 * max(tau_here, 0.0))
        count += 1
    return count


def _turned(azimuth_rad):
    """The same directions within ±π."""
    return (azimuth_rad + math.pi) % (2 * math.pi) - math.pi


def screen(seen: Lookup, bubbles: np.ndarray, pose, fan) -> np.ndarray:
    """Weaken what lies behind bubbles in a picture, in place; and what is heard of the bubbles.

    A bubble of σ_bs adds π σ_bs / r² to the sum over solid angle of μ cos θ: that of a small area dA at θ
    is μ cos²θ dA / r², and its σ_bs = μ cos²θ dA / π.

    Parameters
    ----------
    seen : of the ping's picture
    bubbles : (n, 4) x y z in the world and radius, metres
    pose : (4, 4) world_from_sonar
    fan : Fan

    Returns
    -------
    (m, 4) float64 : azimuth, sine of elevation, range, and steradians, of those that can be heard
    """
    places = (bubbles[:, :3] - pose[:3, 3]) @ pose[:3, :3]
    r = np.maximum(np.linalg.norm(places, axis=1), 1e-6)
    sine, azimuth = places[:, 2] / r, np.arctan2(places[:, 1], places[:, 0])
    edges, top = fan.column_edges_rad, math.sin(math.radians(fan.sonar.elevation_fov_deg) / 2)
    off = np.abs(_turned(azimuth - (edges[0] + edges[-1]) / 2))
    reach = np.maximum(SPREAD_M / (2 * np.maximum(r, NEAR_M)), CELL_RAD)  # of a bubble's shadow
    near = (off < (edges[-1] - edges[0]) / 2 + reach) & (np.abs(sine) < top + reach)
    near &= r < fan.sonar.range_max_m
    if not near.any():
        return np.empty((0, 4))
    # azimuths count from the middle of the plumes, so that they break where there are none
    x, y, _ = places[near].mean(axis=0)
    middle, radii = math.atan2(y, x), bubbles[near, 3]
    points = np.column_stack([_turned(azimuth - middle), sine, r])[near]
    apart = np.outer(reach[near], [1, 1, 0])
    low, high = (points - apart).min(axis=0), (points + apart).max(axis=0)
    steps = np.array([CELL_RAD, CELL_RAD, max((high[2] - low[2]) / LAYERS, THIN_M)])
    low[:2] -= CELL_RAD
    cells = (np.ceil((high - low) / steps)[:2] + 2).astype(int)
    grid, tau = np.concatenate([low, steps]), np.zeros((*cells, LAYERS + 1))
    points = np.column_stack([points, bubble_strength(radii), bubble_extinction(radii)])
    _add_depth(points, grid, tau)
    out = np.empty((len(points), 4))
    count = _hear(points, middle, grid, tau, seen.picture, seen.sectors, out)
    _weaken(seen.picture, seen.sectors, middle, grid, tau)
    return out[:count]
