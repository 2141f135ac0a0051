"""Exact lit and shadow zones: upright slices through the scene, so that only azimuth is sampled.

A slice cuts each face along a straight line, on which 1/ρ (ρ across, z up) is linear in the slope z/ρ. A
sweep up the slopes finds the nearest line of each interval, and the echo of a line between two slopes has a
closed form in each bin. For scenes of few faces: the time grows with the faces that a slice meets.
"""

from __future__ import annotations

import math

import numpy as np

from sonar_gl.core.compiled import compiled
from tools.chart.rivals.common import Rival

MOST = 4096  # lines in a slice


@compiled
def _cut(corners, c, s, limit):
    """Cut a face at an azimuth (cos, sin); return the lowest and highest slope, and 1/ρ = at + rise slope."""
    count = 0
    rho, z = np.zeros(2), np.zeros(2)
    for i in range(3):
        a, b = corners[i], corners[(i + 1) % 3]
        ta, tb = a[1] * c - a[0] * s, b[1] * c - b[0] * s
        if (ta > 0) != (tb > 0) and count < 2:
            t = ta / (ta - tb)
            rho[count] = (a[0] + t * (b[0] - a[0])) * c + (a[1] + t * (b[1] - a[1])) * s
            z[count] = a[2] + t * (b[2] - a[2])
            count += 1
    near = 1e-6
    if count < 2 or max(rho[0], rho[1]) <= near:
        return 0.0, 0.0, 0.0, 0.0
    for i in range(2):
        if rho[i] < near:
            z[i] += (near - rho[i]) / (rho[1 - i] - rho[i]) * (z[1 - i] - z[i])
            rho[i] = near
    first = 0 if z[0] / rho[0] < z[1] / rho[1] else 1
    low, high = z[first] / rho[first], z[1 - first] / rho[1 - first]
    if high - low < 1e-12:
        return 0.0, 0.0, 0.0, 0.0
    rise = (1 / rho[1 - first] - 1 / rho[first]) / (high - low)
    at = 1 / rho[first] - rise * low
    return max(low, -limit), min(high, limit), at, rise


@compiled
def _add(row, edges, strength, at, rise, low, high):
    """Add the echo of 1/r = at cos φ + rise sin φ between slopes; strength : plane's distance x μ x width.

    With δ = φ − φ0 it is S cos δ, and ∫ cos θ cos φ dφ = D S/2 (δ cos φ0 + sin(φ0 + 2 δ)/2).
    """
    K = len(edges) - 1
    phi0, S = math.atan2(rise, at), math.hypot(at, rise)
    c0, s0, scale = math.cos(phi0), math.sin(phi0), strength * S / 2
    per_metre = K / (edges[K] - edges[0])
    start, stop = math.atan(low) - phi0, math.atan(high) - phi0
    nearest = max(1 / (edges[0] * S), 0.0) if edges[0] > 0 else 2.0
    begin = math.acos(nearest) if nearest < 1 else 0.0
    if 1 / (edges[K] * S) >= 1:
        return
    end = math.acos(1 / (edges[K] * S))
    for sign in (-1.0, 1.0):
        # |δ| from a to b on this side of the nearest point
        a, b = (max(start, 0.0), stop) if sign > 0 else (max(-stop, 0.0), -start)
        a, b = max(a, begin), min(b, end)
        if b <= a:
            continue
        k = min(max(int((1 / (S * math.cos(a)) - edges[0]) * per_metre), 0), K - 1)
        done = sign * a * c0 + math.sin(phi0 + 2 * sign * a) / 2
        while True:
            cosine = 1 / (edges[k + 1] * S)
            last = cosine >= 1 or k == K - 1
            delta = b
            if cosine < 1:
                delta = math.acos(cosine)
                if delta >= b:
                    delta, last = b, True
                else:
                    last = k == K - 1
            else:
                last = False
            sine, cosine = math.sin(delta), math.cos(delta)
            # sin(φ0 ± 2δ)/2
            here = sign * delta * c0 + s0 * (0.5 - sine * sine) + sign * c0 * sine * cosine
            row[k] += scale * abs(here - done)
            done = here
            if last:
                break
            k += 1


@compiled
def slices(corners, distance, mu, azimuth, width, column, limit, edges, sums, first, last):
    """Sum slices, each of a width in azimuth, into the columns that they lie in.

    corners : (T, 3, 3) in the sonar's frame; distance : (T,) of their planes; limit : of the slope
    azimuth, width, column : (C,), of which first to last; sums : added to
    """
    T = len(corners)
    span = np.empty((T, 2))
    for t in range(T):
        span[t, 0], span[t, 1] = -4.0, 4.0
        if min(corners[t, 0, 0], corners[t, 1, 0], corners[t, 2, 0]) > 0:
            angle = [math.atan2(corners[t, i, 1], corners[t, i, 0]) for i in range(3)]
            span[t, 0], span[t, 1] = min(angle), max(angle)
    lines, face = np.empty((MOST, 4)), np.empty(MOST, np.int64)
    active = np.empty(MOST, np.int64)
    for i in range(first, last):
        c, s, n = math.cos(azimuth[i]), math.sin(azimuth[i]), 0
        for t in range(T):
            if span[t, 0] <= azimuth[i] <= span[t, 1] and n < MOST:
                low, high, at, rise = _cut(corners[t], c, s, limit)
                if high > low:
                    lines[n, 0], lines[n, 1], lines[n, 2], lines[n, 3] = low, high, at, rise
                    face[n] = t
                    n += 1
        if n == 0:
            continue
        order = np.argsort(lines[:n, 0])
        stops = np.sort(lines[:n, :2].copy().ravel())
        taken = alive = 0
        winner, since = -1, 0.0
        for e in range(len(stops)):
            here = stops[e]
            while taken < n and lines[order[taken], 0] <= here:
                active[alive] = order[taken]
                taken += 1
                alive += 1
            best, closest, kept = -1, 0.0, 0
            middle = (here + stops[e + 1]) / 2 if e + 1 < len(stops) else here
            for a in range(alive):
                line = active[a]
                if lines[line, 1] > here:
                    active[kept] = line
                    kept += 1
                    near = lines[line, 2] + lines[line, 3] * middle
                    if near > closest:
                        best, closest = line, near
            alive = kept
            if best != winner and (e + 1 == len(stops) or stops[e + 1] > here):
                if winner >= 0:
                    t = face[winner]
                    strength = distance[t] * mu[t] * width[i]
                    _add(sums[column[i]], edges, strength, lines[winner, 2], lines[winner, 3], since, here)
                winner, since = best, here


class Slices(Rival):
    """Continuous faces, no rays; a resolution is (slices a beam spacing, 0)."""

    def __init__(self, scene, sonar, acoustics, pose, resolution):
        super().__init__(sonar, acoustics)
        corners, mu = [], []
        for body in scene.bodies:
            vertices = np.asarray(body.mesh.vertices) @ body.pose[:3, :3].T + body.pose[:3, 3]
            corners.append(vertices[np.asarray(body.mesh.faces)])
            mu.append(np.broadcast_to(body.reflectivity, len(corners[-1])))
        self.corners, self.mu = np.concatenate(corners), np.concatenate(mu).astype(float)
        self.column, azimuth = self.cells(resolution[0])
        self.azimuth, self.width = (azimuth[1:] + azimuth[:-1]) / 2, np.diff(azimuth)
        self.samples = len(self.column)
        cut = int(np.searchsorted(self.column, self.halves[1].start))
        self.slice_halves = (0, cut), (cut, self.samples)

    def ping(self, pose):
        """Return (B, K) intensity."""
        corners = (self.corners - pose[:3, 3]) @ pose[:3, :3]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normal /= np.maximum(np.sqrt((normal * normal).sum(axis=1, keepdims=True)), 1e-30)
        distance = np.abs((normal * corners[:, 0]).sum(axis=1))

        def work(half):
            self.sums[self.halves[half]] = 0
            slices(
                corners, distance, self.mu, self.azimuth, self.width, self.column, math.tan(self.top),
                self.bins.edges_m, self.sums, *self.slice_halves[half],
            )  # fmt: skip

        self.both(work)
        return self.beams()
