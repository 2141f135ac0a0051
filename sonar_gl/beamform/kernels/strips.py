"""The walk over the strips of a sector: finds the samples of a strip, and the borders of their footprints.

Footprints, labels and image sources share it (`find_strip`).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import uint64

from sonar_gl.beamform.kernels.borders import find_borders, find_edges, find_narrow
from sonar_gl.beamform.kernels.joined_rows import JOINED_SHARE, divide_faces, find_faces, gather_pieces
from sonar_gl.beamform.kernels.work_table import (
    ALONG,
    ALONG_U,
    BORDER,
    ECHO,
    LINE_U,
    REST,
    ROW,
    SAMPLE,
    TILT,
    V_RAY,
    WORK_COLUMNS,
    WORK_ROWS,
    Q,
    lit_part,
    whole_groups,
)
from sonar_gl.core.compiled import as_table, inlined, uncounted

LEAST_AHEAD = 1e-2  # less than x of all that strips of cones hold, see `lay_on_cone`


class Lattice(NamedTuple):
    """Directions of a sector's samples; see `Sector`.

    u, v : (3,) of the sample in column i and row j, u[0] + u[1] i + u[2] j, and v likewise
    tan_low, tan_high : tangents of the lowest and the highest elevation
    columns : number of columns of samples; what arrays of samples hold beyond is not theirs
    sine, cosine : of the azimuth of the sector's middle
    """

    u: np.ndarray
    v: np.ndarray
    tan_low: float
    tan_high: float
    columns: int
    sine: float
    cosine: float


class StripTable(NamedTuple):
    """Strips of a sector, (P,) arrays; see `Strips`.

    column : of the fan
    middle, width : in u; of strips of cones in sines about the array's axis, see `_u_on_cone`
    v_low, v_high : of the lower and the upper end
    are_cones : they are strips of cones, and so are curved
    """

    column: np.ndarray
    middle: np.ndarray
    width: np.ndarray
    v_low: np.ndarray
    v_high: np.ndarray
    are_cones: bool


class Strip(NamedTuple):
    """One strip, and the samples of it that returned an echo.

    column, width : as in `StripTable`
    first, last : samples of `work` with an echo, from `first` to before `last`
    are_joined : samples stand for several rows of one face
    are_cones, sine, cosine : of `StripTable` and `Lattice`
    """

    column: int
    width: float
    first: int
    last: int
    are_joined: bool
    are_cones: bool
    sine: float
    cosine: float


@uncounted
def find_strip(work, plane_echo, face_id, lattice, strips, p, q_unseen, piece):
    """Return the Strip number `p` of a sector, with its samples and their borders in `work`.

    A sample stands for a rectangle of a strip of the image plane, or of its tangent if the strip is curved. Of each
    row of samples the one nearest to the strip stands for it; where it saves time, one sample stands for several rows
    of one face. A strip without any echo has `first` = `last`.

    This is the walk over samples that all sums share. It is no generator, since Numba never frees the arrays
    that a generator holds.

    work : of `make_work`, overwritten
    plane_echo, face_id : (R, C, 4) float32 and (R, C) int32, as in `SectorSamples`; contiguous, see `whole_rows`
    lattice, strips : Lattice and StripTable
    q_unseen, piece : of BinTable; `piece` is (piece_rad, piece_m), of which a `piece_rad` of 0 joins no rows
    """
    work = as_table(work, WORK_ROWS, WORK_COLUMNS)
    u, v, R, middle = lattice.u, lattice.v, plane_echo.shape[0], strips.middle[p]
    v_low, v_high, step = strips.v_low[p], strips.v_high[p], u[2] / u[1]
    first, last, are_joined = 0, -1, False
    if not is_beside(lattice, strips, p, R):
        low_u, high_u = _ends_of(lattice, strips, p)
        # rows that may touch the aperture: v of the nearest ray is linear in j but for the rounding of i
        low_v, high_v, rise = (
            v[0] + v[1] * ((low_u - u[0]) / u[1] + 0.5),
            v[0] + v[1] * ((high_u - u[0]) / u[1] + 0.5),
            v[2] - v[1] * step,
        )
        bottom_row = max(int((v_low - low_v) / rise) - 2, 0)
        # 0: the window lies above or below
        n = max(min(int((v_high - high_v) / rise) + 3, R - 1) - bottom_row + 1, 0)
        if strips.are_cones:
            lay_on_cone(work, lattice, middle, bottom_row, n)
        else:
            _lay_upright(work, lattice, middle, bottom_row, n)
        # without rows the middle one lies anywhere, also far beyond the samples
        if n > 0 and face_id.shape[0] > 0 and rise <= JOINED_SHARE * piece[0]:
            n_faces = find_faces(work, face_id, lattice.columns, bottom_row, n)
            # pieces that a face as far as the middle one would have, and one more for each
            i = min(max(np.int64(work[SAMPLE, uint64(n >> 1)]), 0), lattice.columns - 1)
            depth_inverse = np.float64(plane_echo[uint64(bottom_row + (n >> 1)), uint64(i), 0])
            height = min(piece[0], math.sqrt(piece[1] * depth_inverse)) if depth_inverse > 0.0 else piece[0]
            are_joined = n_faces + n * rise / height <= JOINED_SHARE * n
        if are_joined:
            n = divide_faces(work, plane_echo, lattice, bottom_row, n_faces, (*piece, rise))
            first, last = gather_pieces(work, plane_echo, lattice, bottom_row, n)
        else:
            first, last = _gather_samples(work, plane_echo, lattice, bottom_row, n)
        if first <= last:
            limits = q_unseen, v_low, v_high
            find_edges(work, max(first - 1, 1), min(last + 3, n), n, are_joined)
            find_narrow(work, max(first - 1, 1), min(last + 2, n), are_joined)
            find_borders(work, max(first, 1), min(last + 2, n), are_joined, limits)
            work[BORDER, 0], work[BORDER, n] = v_low, v_high
    last = max(last + 1, first)
    geometry = strips.are_cones, lattice.sine, lattice.cosine
    return Strip(strips.column[p], strips.width[p], first, last, are_joined, *geometry)


@inlined
def is_beside(lattice, strips, p, n_rows):
    """Return whether strip number `p` lies beside a window of so many rows, as most strips do of a small body.

    The sum without labels asks before it calls `find_strip`, which asks, too: that call takes longer than the answer.
    """
    u, (low_u, high_u) = lattice.u, _ends_of(lattice, strips, p)
    level_u, lean = low_u, u[2] / u[1] * n_rows
    if strips.are_cones and strips.v_low[p] * strips.v_high[p] < 0.0:
        level_u = _u_on_cone(strips.middle[p], 1.0, lattice.sine, lattice.cosine)
    leftmost = (min(low_u, high_u, level_u) - u[0]) / u[1] + 0.5
    rightmost = (max(low_u, high_u, level_u) - u[0]) / u[1] + 0.5
    return max(rightmost, rightmost - lean) <= -1.0 or min(leftmost, leftmost - lean) >= lattice.columns


@inlined
def _ends_of(lattice, strips, p):
    """Return u of the lower and the upper end of strip number `p`, which differ if it is curved."""
    low_u = high_u = middle = strips.middle[p]
    if strips.are_cones:
        v_low, v_high = strips.v_low[p], strips.v_high[p]
        low_u = _u_on_cone(middle, 1.0 + v_low * v_low, lattice.sine, lattice.cosine)
        high_u = _u_on_cone(middle, 1.0 + v_high * v_high, lattice.sine, lattice.cosine)
    return low_u, high_u


@uncounted
def _u_on_cone(k, w, sine, cosine):
    """Return u where the cone of sine k about the array's axis has v² = w - 1, in the sector of this azimuth.

    The direction (1, −u, v) of the sector has (sine − cosine u) / √(u² + w) along the array: a quadratic equation.
    """
    root = math.sqrt(max(sine * sine + w * (cosine * cosine - k * k), 0.0))
    if sine * k > 0.0:  # of the two forms of its solution the one whose divisor is no difference
        return (sine * sine - k * k * w) / (sine * cosine + k * root)
    return (sine * cosine - k * root) / (cosine * cosine - k * k)


@uncounted
def _lay_upright(work, lattice, middle, bottom_row, n):
    """Find the samples nearest to an upright strip, n rows from `bottom_row` on."""
    work = as_table(work, WORK_ROWS, WORK_COLUMNS)
    sample, row, line_u, tilt, v_ray = work[SAMPLE], work[ROW], work[LINE_U], work[TILT], work[V_RAY]
    u, v = lattice.u, lattice.v
    nearest, step, v0, vi, vj = (middle - u[0]) / u[1] + 0.5, u[2] / u[1], v[0], v[1], v[2]
    for m in range(uint64(n)):
        j = np.int32(m) + np.int32(bottom_row)
        i = np.int32(nearest - step * j)
        sample[m], row[m] = i, j
        line_u[m], tilt[m] = middle, 0.0
        v_ray[m] = v0 + vi * i + vj * j


@uncounted
def lay_on_cone(work, lattice, k, bottom_row, n):
    """Find the samples nearest to the strip of the cone of sine k, n rows from `bottom_row` on.

    Along the cone, x and all of sine, cosine, u and v as in `_u_on_cone`, dv is −(cosine (1 + v²) + sine u) du over
    (sine − cosine u) v.
    """
    work = as_table(work, WORK_ROWS, WORK_COLUMNS)
    sample, row, line_u, tilt, v_ray = work[SAMPLE], work[ROW], work[LINE_U], work[TILT], work[V_RAY]
    u, v, sine, cosine = lattice.u, lattice.v, lattice.sine, lattice.cosine
    u0, ui, uj, v0, vi, vj = u[0], u[1], u[2], v[0], v[1], v[2]
    square, k2, rise = sine * sine, k * k, vi / ui
    for m in range(uint64(whole_groups(0, n))):
        j = float(np.int32(m) + np.int32(bottom_row))
        start, level = u0 + uj * j, v0 + vj * j
        # where the row, v = a + rise u, meets the cone: as in `_u_on_cone`
        a = level - rise * start
        across, half = sine * rise + cosine * a, sine * cosine + k2 * a * rise
        root = k * math.sqrt(max(1.0 + across * across - k2 * (1.0 + a * a + rise * rise), 0.0))
        is_aside = half * k > 0.0
        over = square - k2 * (1.0 + a * a) if is_aside else half - root
        under = half + root if is_aside else cosine * cosine - k2 * (1.0 + rise * rise)
        i = math.floor((over / under - start) / ui + 0.5)
        vc = level + vi * i
        # where the cone has the height of that sample
        w = 1.0 + vc * vc
        root = k * math.sqrt(max(square + w * (cosine * cosine - k2), 0.0))
        is_aside = sine * k > 0.0
        over = square - k2 * w if is_aside else sine * cosine - root
        under = sine * cosine + root if is_aside else cosine * cosine - k2
        uc = over / under
        slope = -(sine - cosine * uc) * vc / max(cosine * w + sine * uc, LEAST_AHEAD)
        sample[m], row[m], v_ray[m] = i, j, vc
        line_u[m], tilt[m] = uc - slope * vc, slope


@uncounted
def _gather_samples(work, plane_echo, lattice, bottom_row, n):
    """Gather the samples of a strip, n rows from `bottom_row` on; return the first and the last with an echo."""
    work = as_table(work, WORK_ROWS, WORK_COLUMNS)
    sample, line_u, tilt, v_ray = work[SAMPLE], work[LINE_U], work[TILT], work[V_RAY]
    q, rest, along, along_u, echo = work[Q], work[REST], work[ALONG], work[ALONG_U], work[ECHO]
    u, columns = lattice.u, lattice.columns
    # rows in which the strip lies in the window; a curved one may leave it in between
    begin, end = 0, n
    while begin < end and not 0 <= sample[begin] < columns:
        begin += 1
    while begin < end and not 0 <= sample[end - 1] < columns:
        end -= 1
    for m in range(uint64(0), uint64(begin)):
        q[m] = along_u[m] = along[m] = echo[m] = 0.0
    for m in range(uint64(end), uint64(n)):
        q[m] = along_u[m] = along[m] = echo[m] = 0.0
    # nothing but the reads, each of another row and so of slow memory: the shorter this loop, the more are under way
    for m in range(uint64(begin), uint64(end)):
        j = np.int32(m) + np.int32(bottom_row)
        row, i = uint64(j), uint64(min(max(np.int32(sample[m]), 0), columns - 1))
        q[m], along_u[m] = plane_echo[row, i, 0], plane_echo[row, i, 1]
        along[m], echo[m] = plane_echo[row, i, 2], plane_echo[row, i, 3]
    u0, ui, uj = u[0], u[1], u[2]
    for m in range(uint64(whole_groups(0, n))):
        j, i = np.int32(m) + np.int32(bottom_row), sample[m]
        is_met = (q[m] > 0.0) & (i >= 0.0) & (i < columns)
        q[m], echo[m] = q[m] if is_met else 0.0, max(echo[m], 0.0) if is_met else 0.0
        along_u[m], along_v = along_u[m] if is_met else 0.0, along[m] if is_met else 0.0
        rest[m] = q[m] + along_u[m] * (line_u[m] - u0 - ui * i - uj * j) - along_v * v_ray[m]
        along[m] = along_v + along_u[m] * tilt[m]
    return lit_part(echo, begin, end)
