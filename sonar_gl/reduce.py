"""G-buffer to ping: samples into columns and bins, columns into beams."""

from __future__ import annotations

import math
from functools import partial

import numpy as np
from numba import uint64

from sonar_gl.compiled import compiled
from sonar_gl.fan import Fan
from sonar_gl.footprint import accumulate
from sonar_gl.given import Given
from sonar_gl.labels import Labeller
from sonar_gl.pair import Pair

# Handing half of the work to the other thread takes as long as so many rows of strips, or products of a
# column's bin with its weight: less is done in one thread.
FEW_ROWS, FEW_PRODUCTS = 5_000, 5_000_000
UNITY = np.empty(0, np.float32)  # no gain
# Of a table of how elevations are heard, drawn by straight lines: off by 1e-5 of the peak at most.
ELEVATIONS = 2049


def bin_tables(bin_edges_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(3, K + 1): s = 1/r at the edges of bins, their integrals of s ds and s² ds; the former in float32."""
    s = 1.0 / np.maximum(bin_edges_m, 1e-6)
    out = np.zeros((3, len(s)))
    out[0] = s
    out[1, :-1] = (s[:-1] ** 2 - s[1:] ** 2) / 2
    out[2, :-1] = (s[:-1] ** 3 - s[1:] ** 3) / 3
    return out, out[1].astype(np.float32)


@compiled
def weigh_columns(echo_sum, spans, first, weights, gain, out):
    """Beams as weighted sums of columns, times a gain.

    echo_sum : (columns, K), zero outside of spans, (columns, 2); first : (B,); weights : (B, W), of
    `fan.beam_weights`, W a multiple of 4; gain : (K,) or of no length; out : (B, K), zeros
    """
    n_columns = echo_sum.shape[0]
    for b in range(out.shape[0]):
        row, begin, end = uint64(b), echo_sum.shape[1], 0
        for w in range(0, weights.shape[1], 4):  # four at a time: a beam is read and written less often
            w0, w1, w2, w3 = weights[b, w], weights[b, w + 1], weights[b, w + 2], weights[b, w + 3]
            c0, c1 = uint64((first[b] + w) % n_columns), uint64((first[b] + w + 1) % n_columns)
            c2, c3 = uint64((first[b] + w + 2) % n_columns), uint64((first[b] + w + 3) % n_columns)
            low = min(spans[c0, 0], spans[c1, 0], spans[c2, 0], spans[c3, 0])
            high = max(spans[c0, 1], spans[c1, 1], spans[c2, 1], spans[c3, 1])
            begin, end = min(begin, low), max(end, high)
            for k in range(uint64(low), uint64(max(low, high))):
                near = w0 * echo_sum[c0, k] + w1 * echo_sum[c1, k]
                out[row, k] += near + (w2 * echo_sum[c2, k] + w3 * echo_sum[c3, k])
        if gain.shape[0]:
            for k in range(uint64(begin), uint64(max(begin, end))):
                out[row, k] *= gain[k]


@compiled
def add_points(points, column_edges_rad, bin_edges_m, elevation, top, shared, sums, spans):
    """Sum points into columns and bins; sums and spans as of `footprint.accumulate`.

    points : (n, 4) azimuth, sine of elevation, range, steradians; elevation : of `Reducer`; top : sine of the
        aperture's half height; shared : between two columns as to where their middle is, not one alone
    """
    K, n_columns = sums.shape[1], sums.shape[0]
    for c in range(n_columns):
        sums[c, spans[c, 0] : spans[c, 1]] = 0.0
        spans[c, 0], spans[c, 1] = K, 0
    per_metre = K / (bin_edges_m[K] - bin_edges_m[0])
    for n in range(points.shape[0]):
        c = np.searchsorted(column_edges_rad, points[n, 0], side="right") - 1
        bin_ = math.floor((points[n, 2] - bin_edges_m[0]) * per_metre)
        if not (0 <= c < n_columns and 0 <= bin_ < K and abs(points[n, 1]) < top):
            continue
        k, heard, share = int(bin_), points[n, 3], 0.0
        if elevation.shape[0]:
            place = (points[n, 1] / top + 1.0) * (elevation.shape[0] - 1) / 2
            m = min(int(place), elevation.shape[0] - 2)
            heard *= elevation[m] + (place - m) * (elevation[m + 1] - elevation[m])
        middle = (column_edges_rad[c] + column_edges_rad[c + 1]) / 2
        other = c + 1 if points[n, 0] > middle else c - 1
        if shared and 0 <= other < n_columns:
            apart = (column_edges_rad[other] + column_edges_rad[other + 1]) / 2 - middle
            share = (points[n, 0] - middle) / apart
            sums[other, k] += share * heard
            spans[other, 0], spans[other, 1] = min(spans[other, 0], k), max(spans[other, 1], k + 1)
        sums[c, k] += (1 - share) * heard
        spans[c, 0], spans[c, 1] = min(spans[c, 0], k), max(spans[c, 1], k + 1)


class Reducer:
    """Turns the samples of a fan into beams and bins; owns the sums that every ping uses again.

    Two threads share the work by columns, each with its own, so that the sums do not depend on which of
    them is quicker.

    Parameters
    ----------
    fan : Fan
    first, weights : of `fan.beam_weights`
    heard : function (sine of elevation) -> linear power, or None where all of the aperture is heard alike

    Attributes
    ----------
    total : the sum of what `intensity` gave last
    """

    def __init__(self, fan: Fan, first: np.ndarray, weights: np.ndarray, heard=None):
        self._pair, self._given = Pair(), Given((len(first), fan.sonar.n_bins))
        self.fan, self.first = fan, first
        self.top = math.sin(math.radians(fan.sonar.elevation_fov_deg) / 2)
        sines = np.linspace(-self.top, self.top, ELEVATIONS)
        self.elevation = UNITY.astype(np.float64) if heard is None else heard(sines)
        self.arcs = np.arcsin(sines) * (1.0 if heard is None else self.elevation)
        self.weights = np.pad(weights, ((0, 0), (0, -weights.shape[1] % 4)))
        self.edges = fan.sonar.bin_edges_m
        self.tables, self.flat = bin_tables(self.edges)
        self.sums = np.zeros((fan.n_columns, fan.sonar.n_bins), np.float32)
        self.spans = np.tile([0, fan.sonar.n_bins], (fan.n_columns, 1))  # bins where these may differ from 0
        self.footprint = fan.sampling.reducer == "footprint"
        listened = np.zeros(fan.n_columns, bool)
        for w in range(weights.shape[1]):
            listened[(first[weights[:, w] > 0] + w) % fan.n_columns] = True
        middle = (len(first) + 1) // 2
        self.halves = slice(0, middle), slice(middle, None)
        self.jobs, self._labeller = [], None
        for half in np.array_split(np.arange(fan.n_columns), 2):
            for index, sector in enumerate(fan.sectors):
                parts = sector.parts
                mine = np.isin(parts.column, half) & listened[parts.column]
                arrays = (parts.column[mine], parts.u[mine], parts.width[mine])
                self.jobs.append((len(self.jobs) // len(fan.sectors), index, arrays))

    def intensity(self, views, gain=UNITY) -> np.ndarray:
        """(B, K) float32 echo times the (K,) float32 gain, from the samples of all sectors."""
        return self._beams(self._accumulate(views), gain)

    def labels(self, views, gain, n_bodies: int, background=None, alone=None) -> dict:
        """Fields of a Ping, as of `Labeller.find`."""
        if self._labeller is None:
            tables = self.tables, self.elevation, self.arcs
            self._labeller = Labeller(self.fan, self.first, self.weights, *tables)
        run = partial(self._both, alone=self._rows(views) < FEW_ROWS)
        return self._labeller.find(views, self.jobs, run, gain, n_bodies, background, alone)

    def sum_with(self, adders, gain) -> np.ndarray:
        """(B, K) as of `intensity`, of what several put into columns, one after the other.

        Parameters
        ----------
        adders : (views, function(view, parts, tables, fresh, sums, spans)) of each; the first one's are fresh
        """
        tables = self.edges, self.tables, self.flat, self.elevation

        def work(half):
            for number, (views, add) in enumerate(adders):
                for owner, index, parts in self.jobs:
                    if owner == half:
                        add(views[index], parts, tables, number == 0, self.sums, self.spans)

        self._both(work)
        return self._beams(self.sums, gain)

    def sum_points(self, points, gain, shared: bool) -> np.ndarray:
        """(B, K) as of `intensity`, of points; points and shared as of `add_points`."""
        tables = self.fan.column_edges_rad, self.edges, self.elevation, self.top
        add_points(points, *tables, shared, self.sums, self.spans)
        return self._beams(self.sums, gain)

    def close(self):
        """End the other thread."""
        self._pair.close()

    def _both(self, work, alone: bool = False):
        """What work(0) and work(1) return, the latter from the other thread unless `alone`."""
        return (work(0), work(1)) if alone else self._pair.run(work)

    def _rows(self, views) -> float:
        """Rows of strips in all, about."""
        whole = zip(self.fan.sectors, views, strict=True)
        return sum(len(s.parts.u) / s.columns * plane_echo[..., 0].size for s, (_, plane_echo, _) in whole)

    def _accumulate(self, views) -> np.ndarray:
        """Fill the columns' sums."""

        def work(half):
            for owner, index, parts in self.jobs:
                if owner != half:
                    continue
                sector, plane_echo, _ = views[index]
                accumulate(
                    plane_echo,
                    sector.u,
                    sector.v,
                    sector.tan_elevation,
                    *parts,
                    self.edges,
                    self.tables,
                    self.flat,
                    self.footprint,
                    self.elevation,
                    self.sums,
                    self.spans,
                )

        self._both(work, self._rows(views) < FEW_ROWS)
        return self.sums

    def _beams(self, sums, gain=UNITY) -> np.ndarray:
        out = self._given.zeros()

        def work(half):
            part = self.halves[half]
            weigh_columns(sums, self.spans, self.first[part], self.weights[part], gain, out[part])

        bins = np.maximum(self.spans[:, 1] - self.spans[:, 0], 0).mean()
        self._both(work, self.weights.size * bins < FEW_PRODUCTS)
        self.total = float(out.sum(dtype=np.float64))
        return out
