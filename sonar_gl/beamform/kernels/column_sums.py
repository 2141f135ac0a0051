"""Sums of samples, and of point scatterers, in columns and range bins.

A row of sums has a span: first bin and past the last outside which it is zero.
"""

from __future__ import annotations

import math

import numpy as np
from numba import uint64

from sonar_gl.beamform.kernels.footprints import find_footprints, keep_within_bodies
from sonar_gl.beamform.kernels.joined_rows import untried_after
from sonar_gl.beamform.kernels.range_bins import BinTable
from sonar_gl.beamform.kernels.spreading import (
    SHORT_RAMP,
    SHORT_RAMP_OF_JOINED,
    bin_points,
    spread_footprints,
)
from sonar_gl.beamform.kernels.strips import Lattice, StripTable, find_strip, is_beside
from sonar_gl.core.compiled import compiled, from_column, uncounted


@compiled
def sum_footprints(
    work,
    plane_echo,
    face_id,
    body_id,
    body_spans,
    table,
    first_strip,
    strips,
    bins,
    spread,
    elevation_pattern,
    sums,
    spans,
):
    """Sum some of the samples of sectors into columns and bins.

    One call sums all sectors of a view: to hand arrays over takes as long as the few samples of a sector of side lobes.

    The surface in a sample's rectangle is the plane that its ray met. There 1/r is linear in (u, v) but for
    the slow length of the ray: the share before r is that of two convolved boxes, exact for planes. It is cut
    at the aperture, at columns and at edges of planes.

    work : of `make_work`, overwritten
    plane_echo, face_id, body_id : image of the samples of all sectors, as in `ViewSamples`
    body_spans : of `ViewSamples`; of no length if it or `body_id` is not known
    table, strips, bins : tuples of SectorTable, StripTable and BinTable
    first_strip : (S + 1,) int64, first strip of each sector, and past the last
    spread : True spreads each sample over its footprint, False adds it to one bin
    elevation_pattern : (n,) two-way beam pattern at even sines of elevation from -1 to 1, or of no length
    sums : (columns, K) float32, μ cos θ times steradians; the rows of these strips are added to
    spans : (columns, 2) int64, first bin and past the last outside which a row of sums is zero; widened
    """
    (places, u, v, limits), strips, bins = table, StripTable(*strips), BinTable(*bins)
    for s in range(places.shape[0]):
        left, columns, rows = places[s, 0], places[s, 1], places[s, 2]
        if rows == 0:
            continue
        samples = (
            from_column(plane_echo, left, rows),
            from_column(face_id, left, min(rows, face_id.shape[0])),
            from_column(body_id, left, min(rows, body_id.shape[0])),
            body_spans,
            Lattice(u[s], v[s], limits[s, 0], limits[s, 1], columns, limits[s, 2], limits[s, 3]),
        )
        mine = first_strip[s], first_strip[s + 1]
        _sum_strips(work, samples, strips, mine, bins, spread, elevation_pattern, sums, spans)


@uncounted
def _sum_strips(work, samples, strips, mine, bins, spread, elevation_pattern, sums, spans):
    """Do the work of `sum_footprints` for one sector.

    samples : with its lattice; mine : first of its strips, and past the last
    """
    (plane_echo, face_id, body_id, body_spans, lattice), untried = samples, 0
    for p in range(mine[0], mine[1]):
        is_tried = spread and untried == 0
        if is_beside(lattice, strips, p, plane_echo.shape[0]):
            untried = untried_after(untried, is_tried, False)
            continue
        piece = (bins.piece_rad if is_tried else 0.0), bins.piece_m
        strip = find_strip(work, plane_echo, face_id, lattice, strips, p, bins.q_unseen, piece)
        untried = untried_after(untried, is_tried, strip.are_joined)
        if strip.first == strip.last:
            continue
        find_footprints(work, strip, elevation_pattern, bins.per_metre)
        if body_spans.shape[0] > 0:
            keep_within_bodies(work, strip, body_id, body_spans, lattice.columns)
        if spread:
            short_ramp = SHORT_RAMP_OF_JOINED if strip.are_joined else SHORT_RAMP
            spread_footprints(work, strip.first, strip.last, sums, spans, strip.column, bins, short_ramp)
        else:
            bin_points(work, sums, spans, lattice.u, strip, bins)


@compiled
def add_points(points, column_edges_rad, bin_edges_m, elevation_pattern, top, shared, sums, spans):
    """Add point scatterers to columns and bins; `sums` and `spans` as in `sum_footprints`.

    points : (n, 4) azimuth, sine of elevation, range, steradians
    elevation_pattern : as in `sum_footprints`; top : sine of the highest elevation
    shared : share each point between the two columns whose middles it lies between, instead of one
    """
    K, n_columns = sums.shape[1], sums.shape[0]
    per_metre = K / (bin_edges_m[K] - bin_edges_m[0])
    for n in range(points.shape[0]):
        c = np.searchsorted(column_edges_rad, points[n, 0], side="right") - 1  # or outside
        bin_ = math.floor((points[n, 2] - bin_edges_m[0]) * per_metre)
        if not (0 <= c < n_columns and 0 <= bin_ < K and abs(points[n, 1]) < top):
            continue
        k, energy, share = int(bin_), points[n, 3], 0.0
        if elevation_pattern.shape[0]:
            place = (points[n, 1] + 1.0) * (elevation_pattern.shape[0] - 1) / 2
            m = min(int(place), elevation_pattern.shape[0] - 2)
            energy *= elevation_pattern[m] + (place - m) * (elevation_pattern[m + 1] - elevation_pattern[m])
        middle = (column_edges_rad[c] + column_edges_rad[c + 1]) / 2
        other = c + 1 if points[n, 0] > middle else c - 1
        if shared and 0 <= other < n_columns:
            apart = (column_edges_rad[other] + column_edges_rad[other + 1]) / 2 - middle
            share = (points[n, 0] - middle) / apart
            sums[other, k] += share * energy
            spans[other, 0], spans[other, 1] = min(spans[other, 0], k), max(spans[other, 1], k + 1)
        sums[c, k] += (1 - share) * energy
        spans[c, 0], spans[c, 1] = min(spans[c, 0], k), max(spans[c, 1], k + 1)


@uncounted
def share_wide_columns(part, wide_edges, shares, sums, spans):
    """Add what some wide columns hold to their columns.

    part : (2,) first and past the last of the wide columns, counted on from the others
    wide_edges : (W + 1,) column where each of the wide columns begins, and past the last column
    shares : (columns,) float32, the share of its wide column that a column takes
    sums, spans : as in `sum_footprints`; the rows of the wide columns follow those of the columns
    """
    n_columns = shares.shape[0]
    for at in range(part[0], part[1]):
        row, wide = uint64(at), at - n_columns
        first, past = spans[row, 0], spans[row, 1]
        if first >= past:
            continue
        for c in range(wide_edges[wide], wide_edges[wide + 1]):
            column, share = uint64(c), shares[c]
            for k in range(uint64(first), uint64(past)):
                sums[column, k] += share * sums[row, k]
            spans[c, 0], spans[c, 1] = min(spans[c, 0], first), max(spans[c, 1], past)


@uncounted
def clear_columns(first, last, sums, spans):
    """Set rows of sums to zero, from `first` to before `last`; `sums` and `spans` as in `sum_footprints`."""
    for c in range(first, last):
        _clear_row(c, sums, spans)


@uncounted
def _clear_row(c, sums, spans):
    """Set a row to zero, as far as its span says that it may differ from it."""
    for k in range(uint64(spans[c, 0]), uint64(max(spans[c, 0], spans[c, 1]))):
        sums[c, k] = 0.0
    spans[c, 0], spans[c, 1] = sums.shape[1], 0


@uncounted
def count_bins(spans):
    """Return how many bins of all columns may differ from zero, the first of them, and past the last.

    spans : as in `sum_footprints`; without such a bin, past the last comes before the first
    """
    total, first, past = 0, np.iinfo(np.int64).max, 0
    for c in range(spans.shape[0]):
        if spans[c, 0] < spans[c, 1]:
            total += spans[c, 1] - spans[c, 0]
            first, past = min(first, spans[c, 0]), max(past, spans[c, 1])
    return total, first, past
