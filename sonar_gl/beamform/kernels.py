"""The compiled sums: samples into columns and range bins, columns into beams, for echoes, labels and
multipath.

The sections, and what each compiles for Python:

| section | what it does | entry functions |
| --- | --- | --- |
| strips | finds the samples of a strip, and the borders of their footprints | |
| footprints | sums footprints into columns and bins | `sum_footprints` |
| point scatterers | sums points into columns and bins | `sum_points` |
| wide columns | adds sums of wide columns to their columns | `share_wide_columns` |
| columns to beams | weighs columns, and adds far side lobes | `weigh_columns`, `add_far_lobes` |
| labels: the echo of each body | sums footprints of each body, with moments | `sum_bodies` |
| labels: columns to beams | finds the strongest body of each bin | `sort_runs`, `find_strongest`, `sum_body_echo` |
| image sources | reflects the samples of a sector, and sums them | `estimate_reflection`, `sum_image_source` |

Footprints, labels and image sources share one walk over the strips of a sector (`find_strip`). The functions stand in
one file because Numba keeps machine code by the file of a function alone: a function that calls one of another file
would run with what that one was before its file changed.

Entry functions take plain tuples where inner ones take the NamedTuples below, and name them on their first
line: Numba finds the type of a plain tuple in 0.1 µs, that of a NamedTuple in 9 µs. Loops over samples pass
none on: each call would count references to all of its arrays, which takes as long as all the rest.

Loops over a strip's samples have no branches, so that the compiler can vectorise them. Indices are unsigned:
an index that may be negative prevents vectorisation.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import int64, uint64

from sonar_gl.core.compiled import as_table, compiled, inlined, uncounted
from sonar_gl.core.memory import sparse_table
from sonar_gl.sonar.fan import FAR_FACTOR
from sonar_gl.sonar.samples import ViewSamples

SAME = 1e-5  # of a plane's 1/x and slope: well above float32's noise, well below what matters
NO_EDGE = 1e30  # beyond all v
ALIKE = 0.3  # of slopes: one face, or two of a smooth one


class Lattice(NamedTuple):
    """Directions of a sector's samples: (3,) u and (3,) v, and the tangents of its lowest and highest elevation;
    see `Sector`. Then the number of columns of samples; what arrays of samples hold beyond is not theirs. At last come
    sine and cosine of the azimuth of its middle.
    """

    u: np.ndarray
    v: np.ndarray
    tan_low: float
    tan_high: float
    columns: int
    sine: float
    cosine: float


class StripTable(NamedTuple):
    """Strips of a sector, (P,) arrays: column of the fan, middle, width, and v of the lower and the upper end; whether
    they are strips of cones. See `Strips`.
    """

    column: np.ndarray
    middle: np.ndarray
    width: np.ndarray
    v_low: np.ndarray
    v_high: np.ndarray
    are_cones: bool


class BinTable(NamedTuple):
    """Range bins: their edges, and tables of `bin_table`.

    edges_m : (K + 1,) slant range
    s : (K + 1,) s = 1/r at the edges, falling
    density32 : (K,) integral of s ds over each bin, which is the energy of an even footprint of height 1 that
        covers the bin; float32
    middle_s32 : (K,) middle of each bin in s, float32
    middle_m : (K,) mean range of that energy, ∫ ds / ∫ s ds
    q_unseen : 1/x at which surfaces are no longer drawn
    first_m, per_metre : where the first bin begins, and bins per metre
    piece_rad, piece_m : how high a footprint of several rows may be, and its square times range
    """

    edges_m: np.ndarray
    s: np.ndarray
    density32: np.ndarray
    middle_s32: np.ndarray
    middle_m: np.ndarray
    q_unseen: float
    first_m: float
    per_metre: float
    piece_rad: float
    piece_m: float


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


# Rows of `work`, one entry per sample of a strip. Found by `_lay_upright` or `lay_on_cone`: column and row of the
# sample in the window; the line u = LINE_U + TILT v that the middle of the strip follows there, a tangent if the strip
# is curved; v of the ray. By `_gather_samples` or `gather_pieces`: 1/x on the ray, 0 where it met nothing; the plane
# that it met: 1/x on that line at v = 0, its slope along the line, with v, and its slope along u; the echo per
# steradian. By `_find_borders`: v where the sample's footprint begins. By `find_faces`: the rows in which another face
# begins. By `gather_pieces`: v of the lowest and of the highest ray of a piece, and by how much its echo is more at the
# upper end than in the middle, as a share of it. By `_divide_faces`, until there are footprints: the row in which a
# piece begins, and a place for the echo at its lower end. By `_find_edges`, likewise: v of the edge between a sample
# and the one below, and whether it met its plane. By `_find_narrow`, likewise: whether other rows miss the face. By
# `_find_footprints`: energy; centre and the two half-widths of the footprint in s = 1/r; by how much its density at the
# nearer end is more than that of an even footprint, as a share of it, and less at the further end. By
# `_find_intervals`: both ends, half the height, and the bins of both ends. For labels: elevation and incidence in the
# middle, radians, and how they change with s. For image sources: see X to BISTATIC.
SAMPLE, ROW, LINE_U, TILT, V_RAY, Q, REST, ALONG, ALONG_U, ECHO, BORDER = range(11)
START, V_LOWEST, V_HIGHEST, ECHO_RISE = range(11, 15)
ENERGY, S, A, B, SLANT, NEAR, FAR, HALF_HEIGHT, NEAR_BIN, FAR_BIN = range(15, 25)
ELEVATION, INCIDENCE, ELEVATION_RISE, INCIDENCE_RISE = range(25, 29)
PIECE, ECHO_BELOW, EDGE, REPEATED, NARROW = ENERGY, S, A, B, SLANT
LABEL_ROWS = INCIDENCE_RISE + 1
# Samples of float64 that a processor does at a time. Loops over a strip do whole groups, so that none is left to be
# done by itself: what they find of a few more samples is not read.
AT_A_TIME = 8
# `work` has one size whatever the strip, see `as_table`. A row is no multiple of a page of memory: else all rows would
# compete for the same lines of fast memory.
MAX_STRIP_ROWS = 1 << 16
WORK_ROWS, WORK_COLUMNS = LABEL_ROWS + 10, MAX_STRIP_ROWS + 168
NOTHING = -1  # of `SectorSamples.face_id`
# Rows of one face are joined where that leaves at most this share of them: with more, it saves less than it costs.
JOINED_SHARE = 0.4
# The share of a bin that a footprint, far longer than wide, covers at least if its density is to change along it. In
# shorter ones that moves too little echo to matter.
LEAST_SLANTED = 1 / 8
# The share of a bin up to which the ramps at both ends of a footprint are neglected. Those of neighbouring rows overlap
# and add up to the same; those of joined rows do not, as on a wall that the sonar sees at an angle.
SHORT_RAMP, SHORT_RAMP_OF_JOINED = 1 / 4, 1 / 8
# strips after one where it does not save time that are not tried, as neighbours are mostly alike
UNTRIED_STRIPS = 15
# Of its range: a longer footprint is kept within the range of its body. Half a sample beyond a face that is seen nearly
# edge-on may lie metres from it.
LONG_FOOTPRINT = 1 / 64
LEAST_POWER = 1e-30  # of an elevation pattern: less in a null
LEAST_AHEAD = 1e-2  # less than x of all that strips of cones hold, see `lay_on_cone`


def make_work() -> np.ndarray:
    """Return `work` of the kernels, for one thread at a time."""
    return sparse_table(WORK_ROWS, WORK_COLUMNS)


def bin_table(bin_edges_m: np.ndarray, elevation_fov_rad: float = math.inf) -> BinTable:
    """Return the tables of range bins.

    Parameters
    ----------
    bin_edges_m : (K + 1,) metres, rising
    elevation_fov_rad : the aperture in elevation, where the pattern changes within it
    """
    s = 1.0 / np.maximum(bin_edges_m, 1e-6)
    density = (s[:-1] ** 2 - s[1:] ** 2) / 2
    middle_m, q_unseen = 2.0 / (s[:-1] + s[1:]), float(1.0 / (FAR_FACTOR * bin_edges_m[-1]))
    first_m, last_m = float(bin_edges_m[0]), float(bin_edges_m[-1])
    per_metre = len(density) / (last_m - first_m)
    density32, middle_s32 = density.astype(np.float32), ((s[:-1] + s[1:]) / 2).astype(np.float32)
    arrays = bin_edges_m, s, density32, middle_s32, middle_m
    limits = piece_limits(bin_edges_m, elevation_fov_rad)
    return BinTable(*arrays, q_unseen, first_m, per_metre, *limits)


# Of a bin: how far off a footprint of several rows may be in range. Into how many the aperture in elevation is divided
# at least, as the beam pattern is linear within each. And what is low enough for derivatives, radians.
PIECE_ERROR, PIECES_PER_FOV, HIGHEST_PIECE_RAD = 1 / 160, 16, 1 / 16
# the share by which 1/x and the echo may change between the middle of a footprint of several rows and its ends
PIECE_CHANGE = 0.05
# The share by which the slope of range may change over a footprint of several rows. Where a plane is nearest, its slope
# is zero, and most of the echo of a wall that faces the sonar lies in one bin. So a footprint is at most so high, as a
# share of what its lower end is apart from that place, below it and above it.
SLOPE_CHANGE = 1 / 3
TOWARDS_NEAREST, FROM_NEAREST = SLOPE_CHANGE / (1 + SLOPE_CHANGE / 2), SLOPE_CHANGE / (1 - SLOPE_CHANGE / 2)


def piece_limits(bin_edges_m: np.ndarray, elevation_fov_rad: float = math.inf) -> tuple[float, float]:
    """Return `piece_rad` and `piece_m` of BinTable; arguments as of `bin_table`.

    Between its ends, where range is exact, the range of a plane deviates from that of a footprint by r h² / 8.
    """
    bin_m = (bin_edges_m[-1] - bin_edges_m[0]) / (len(bin_edges_m) - 1)
    return min(HIGHEST_PIECE_RAD, elevation_fov_rad / PIECES_PER_FOV), float(8 * PIECE_ERROR * bin_m)


# ---- strips ------------------------------------------------------------------------------------------


@inlined
def _whole(first, last):
    """Return past the last of whole groups of AT_A_TIME samples that begin with `first` and hold all before `last`."""
    return first + (last - first + AT_A_TIME - 1) // AT_A_TIME * AT_A_TIME


@uncounted
def find_strip(work, plane_echo, face_id, lattice, strips, p, q_unseen, piece):
    """Return the Strip number `p` of a sector, with its samples and their borders in `work`.

    A sample stands for a rectangle of a strip of the image plane, or of its tangent if the strip is curved. Of each
    row of samples the one nearest to the strip stands for it; where it saves time, one sample stands for several rows
    of one face. A strip without any echo has `first` = `last`.

    This is the walk over samples that all sums share. It is no generator, since Numba never frees the arrays
    that a generator holds.

    Parameters
    ----------
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
        # without rows the middle one lies anywhere, also far beyond the samples
        if n > 0 and face_id.shape[0] > 0 and rise <= JOINED_SHARE * piece[0]:
            if not strips.are_cones:
                _find_upright(work, lattice, middle, bottom_row, n)
            n_faces = find_faces(work, face_id, lattice.columns, bottom_row, n)
            # pieces that a face as far as the middle one would have, and one more for each
            i = min(max(np.int64(work[SAMPLE, uint64(n >> 1)]), 0), lattice.columns - 1)
            depth_inverse = np.float64(plane_echo[uint64(bottom_row + (n >> 1)), uint64(i), 0])
            height = min(piece[0], math.sqrt(piece[1] * depth_inverse)) if depth_inverse > 0.0 else piece[0]
            are_joined = n_faces + n * rise / height <= JOINED_SHARE * n
        if are_joined:
            if not strips.are_cones:
                work[LINE_U, 0] = middle
            n = _divide_faces(
                work, plane_echo, lattice, bottom_row, n_faces, (*piece, rise), strips.are_cones
            )
            first, last = gather_pieces(work, plane_echo, lattice, bottom_row, n, strips.are_cones)
        else:
            if not strips.are_cones:
                _lay_upright(work, lattice, middle, bottom_row, n)
            first, last = _gather_samples(work, plane_echo, lattice, bottom_row, n)
        if first <= last:
            limits = q_unseen, v_low, v_high
            _find_edges(work, max(first - 1, 1), min(last + 3, n), n, are_joined)
            _find_narrow(work, max(first - 1, 1), min(last + 2, n), are_joined)
            _find_borders(work, max(first, 1), min(last + 2, n), are_joined, limits)
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
    for m in range(uint64(_whole(0, n))):
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
def _find_upright(work, lattice, middle, bottom_row, n):
    """Find the columns alone of the samples nearest to an upright strip, n rows from `bottom_row` on."""
    work = as_table(work, WORK_ROWS, WORK_COLUMNS)
    sample, u = work[SAMPLE], lattice.u
    nearest, step = (middle - u[0]) / u[1] + 0.5, u[2] / u[1]
    for m in range(uint64(n)):
        sample[m] = np.int32(nearest - step * (np.int32(m) + np.int32(bottom_row)))


@uncounted
def find_faces(work, face_id, columns, bottom_row, n):
    """Find in which of a strip's rows another face begins than in the row below; return how many."""
    work = as_table(work, WORK_ROWS, WORK_COLUMNS)
    sample, start = work[SAMPLE], work[START]
    n_faces, before, place = 0, np.int32(0), 0.0
    for m in range(uint64(n)):
        i, face = np.int64(sample[m]), np.int32(NOTHING)
        if 0 <= i < columns:
            face = face_id[uint64(np.int64(m) + bottom_row), uint64(i)]
        start[uint64(n_faces)] = place  # overwritten if none begins here
        n_faces += (face != before) | (m == uint64(0))
        before, place = face, place + 1.0
    start[n_faces] = n
    return n_faces


@uncounted
def _untried_after(untried, is_tried, are_joined):
    """Return for how many strips no rows are to be joined, after a strip where that was tried or not."""
    if are_joined:
        return 0
    return UNTRIED_STRIPS if is_tried else max(untried - 1, 0)


@uncounted
def _find_nearest(work, plane_echo, lattice, m, bottom_row, are_cones):
    """Return v where the plane that a row meets is nearest along its strip: the zero of D in `bend_footprints`."""
    work = as_table(work, WORK_ROWS, WORK_COLUMNS)
    u, v = lattice.u, lattice.v
    i, j = np.int64(work[SAMPLE, uint64(m)]), m + bottom_row
    row, column = uint64(j), uint64(min(max(i, 0), lattice.columns - 1))
    line, lean, v_ray = work[LINE_U, 0], 0.0, v[0] + v[1] * i + v[2] * j
    if are_cones:
        line, lean, v_ray = work[LINE_U, uint64(m)], work[TILT, uint64(m)], work[V_RAY, uint64(m)]
    slope_u, slope_v = plane_echo[row, column, 1], plane_echo[row, column, 2]
    rest = plane_echo[row, column, 0] + slope_u * (line - u[0] - u[1] * i - u[2] * j) - slope_v * v_ray
    along = slope_v + slope_u * lean
    slope = rest * (1.0 + lean * lean) - along * line * lean
    return (along * (1.0 + line * line) - rest * line * lean) / slope if slope != 0.0 else math.inf


@uncounted
def _divide_faces(work, plane_echo, lattice, bottom_row, n_faces, limits, are_cones):
    """Divide the rows of each face into pieces, each of which one footprint stands for.

    Row PIECE of `work` gets the row where each begins, and where the last one ends.

    Parameters
    ----------
    limits : `piece_rad` and `piece_m` of BinTable, height of a row in v

    Returns
    -------
    number of pieces
    """
    work = as_table(work, WORK_ROWS, WORK_COLUMNS)
    start, sample, v_ray, piece = work[START], work[SAMPLE], work[V_RAY], work[PIECE]
    v, columns, bottom = lattice.v, lattice.columns, uint64(bottom_row)
    v0, vi, vj, n, (piece_rad, piece_m, rise) = v[0], v[1], v[2], 0, limits
    rows_per_v = 1.0 / rise
    for face in range(uint64(n_faces)):
        low, past = np.int64(start[face]), np.int64(start[face + uint64(1)])
        n_rows, per_row, nearest_v = past - low, 0.0, math.inf
        if n_rows == 1:
            piece[uint64(n)], n = low, n + 1
            continue
        middle, end = (low + past) >> 1, past - 1
        i = uint64(min(max(np.int64(sample[uint64(middle)]), 0), columns - 1))
        depth_inverse = np.float64(plane_echo[uint64(middle) + bottom, i, 0])
        if depth_inverse > 0.0:
            echo = np.float64(plane_echo[uint64(middle) + bottom, i, 3])
            over_q, over_echo, change = 1.0 / depth_inverse, 1.0 / max(echo, LEAST_POWER), 0.0
            for m in (uint64(low), uint64(end)):
                i = uint64(min(max(np.int64(sample[m]), 0), columns - 1))
                change = max(change, abs(plane_echo[m + bottom, i, 0] * over_q - 1.0))
                change = max(change, abs(plane_echo[m + bottom, i, 3] * over_echo - 1.0))
            per_row = max(
                rise / min(piece_rad, math.sqrt(piece_m * depth_inverse)), change / (PIECE_CHANGE * n_rows)
            )
            nearest_v = _find_nearest(work, plane_echo, lattice, middle, bottom_row, are_cones)
        # pieces that are alike, and how many of them have a row more than the others
        n_left = max(math.ceil(n_rows * per_row - 1e-9), 1)
        length, n_longer = n_rows // n_left, n_rows % n_left
        longest = length + (n_longer > 0)
        while low < past:
            apart = v_ray[uint64(low)]
            if not are_cones:
                apart = v0 + vi * np.int64(sample[uint64(low)]) + vj * (low + bottom_row)
            apart = nearest_v - apart
            n_graded = abs(apart) * (TOWARDS_NEAREST if apart > 0.0 else FROM_NEAREST) * rows_per_v
            piece[uint64(n)], n = low, n + 1
            if n_graded < longest:
                low, n_left = min(low + max(np.int64(n_graded), 1), past), 0
                continue
            if n_left == 0:
                n_left = max(math.ceil((past - low) * per_row - 1e-9), 1)
                length, n_longer = (past - low) // n_left, (past - low) % n_left
            low += length + (n_longer > 0)
            n_left, n_longer = n_left - 1, n_longer - 1
    piece[uint64(n)] = start[uint64(n_faces)]
    return n


@uncounted
def gather_pieces(work, plane_echo, lattice, bottom_row, n, are_cones):
    """Gather what stands for the rows of each of n pieces; return the first and the last with an echo.

    The middle row tells the plane, which is that of all rows; and the echo is that of the first, the middle and the
    last row by Simpson's rule, as it may change with shading normals.
    """
    work = as_table(work, WORK_ROWS, WORK_COLUMNS)
    piece, sample, v_ray, row_of = work[PIECE], work[SAMPLE], work[V_RAY], work[ROW]
    line_u, tilt, v_lowest, v_highest = work[LINE_U], work[TILT], work[V_LOWEST], work[V_HIGHEST]
    q, rest, along, along_u, echo = work[Q], work[REST], work[ALONG], work[ALONG_U], work[ECHO]
    echo_rise, echo_below = work[ECHO_RISE], work[ECHO_BELOW]
    u, v, columns, bottom = lattice.u, lattice.v, lattice.columns, np.int32(bottom_row)
    u0, ui, uj, v0, vi, vj = u[0], u[1], u[2], v[0], v[1], v[2]
    line, most = line_u[0], columns - 1
    # In place: no row is read after a piece is written there, since each piece has a row of its own. Nothing but the
    # reads, as in `_gather_samples`
    for k in range(uint64(n)):
        low, high = np.int32(piece[k]), np.int32(piece[k + uint64(1)]) - np.int32(1)
        m = np.int32((low + high) >> 1)
        i, i_low, i_high = (
            np.int32(sample[uint64(m)]),
            np.int32(sample[uint64(low)]),
            np.int32(sample[uint64(high)]),
        )
        j, j_low, j_high = m + bottom, low + bottom, high + bottom
        if are_cones:
            v_lowest[k], v_highest[k] = v_ray[uint64(low)], v_ray[uint64(high)]
            line_u[k], tilt[k], v_ray[k] = line_u[uint64(m)], tilt[uint64(m)], v_ray[uint64(m)]
        else:
            v_lowest[k], v_highest[k] = v0 + vi * i_low + vj * j_low, v0 + vi * i_high + vj * j_high
            line_u[k], tilt[k], v_ray[k] = line, 0.0, v0 + vi * i + vj * j
        sample[k], row_of[k] = i, j
        row, column = uint64(j), uint64(min(max(i, 0), most))
        q[k], along_u[k] = plane_echo[row, column, 0], plane_echo[row, column, 1]
        along[k], echo[k] = plane_echo[row, column, 2], plane_echo[row, column, 3]
        echo_below[k] = plane_echo[uint64(j_low), uint64(min(max(i_low, 0), most)), 3]
        echo_rise[k] = plane_echo[uint64(j_high), uint64(min(max(i_high, 0), most)), 3]
    for k in range(uint64(_whole(0, n))):
        i, j, further = sample[k], row_of[k], piece[k + uint64(1)] - piece[k] - 1.0
        is_inside = (i >= 0.0) & (i < columns)
        below, mean_echo, above = echo_below[k], echo[k], echo_rise[k]
        mean_of_ends = (below + above) / 2
        mean_of_more = mean_of_ends if further < 1.5 else (mean_of_ends + 2.0 * mean_echo) / 3
        mean_echo = mean_of_more if further > 0.5 else mean_echo
        is_lit = is_inside & (q[k] > 0.0) & (mean_echo > 0.0)
        rise = (above - below) * (further + 1.0) / (2.0 * max(further, 1.0) * max(mean_echo, LEAST_POWER))
        echo_rise[k], echo[k] = rise if is_lit else 0.0, mean_echo if is_lit else 0.0
        q[k], along_u[k] = q[k] if is_inside else 0.0, along_u[k] if is_inside else 0.0
        along_v = along[k] if is_inside else 0.0
        rest[k] = q[k] + along_u[k] * (line_u[k] - u0 - ui * i - uj * j) - along_v * v_ray[k]
        along[k] = along_v + along_u[k] * tilt[k]
    return _lit_part(echo, 0, n)


@uncounted
def _lit_part(echo, begin, end):
    """Return the first and the last sample with an echo from `begin` to before `end`; 0 and −1 if there is none."""
    while begin < end and echo[begin] == 0.0:
        begin += 1
    while begin < end and echo[end - 1] == 0.0:
        end -= 1
    return (begin, end - 1) if begin < end else (0, -1)


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
    for m in range(uint64(_whole(0, n))):
        j, i = np.int32(m) + np.int32(bottom_row), sample[m]
        is_met = (q[m] > 0.0) & (i >= 0.0) & (i < columns)
        q[m], echo[m] = q[m] if is_met else 0.0, max(echo[m], 0.0) if is_met else 0.0
        along_u[m], along_v = along_u[m] if is_met else 0.0, along[m] if is_met else 0.0
        rest[m] = q[m] + along_u[m] * (line_u[m] - u0 - ui * i - uj * j) - along_v * v_ray[m]
        along[m] = along_v + along_u[m] * tilt[m]
    return _lit_part(echo, begin, end)


@uncounted
def _find_edges(work, first, last, n, are_joined):
    """Find v where the planes of two of a strip's n samples make an edge, from `first` to before `last`; else NO_EDGE.

    They do where they meet between their rays. Nearer than SAME they are one plane, and where they meet is noise. Find
    also which samples met about the plane of the one below.

    are_joined : samples have a lowest and a highest ray, else the same one
    """
    work = as_table(work, WORK_ROWS, WORK_COLUMNS)
    q, rest, along, edge = work[Q], work[REST], work[ALONG], work[EDGE]
    along_u, tilt, repeated = work[ALONG_U], work[TILT], work[REPEATED]
    # chosen here: inside the loop it would not be done several samples at a time
    v_lowest = work[V_LOWEST] if are_joined else work[V_RAY]
    v_highest = work[V_HIGHEST] if are_joined else work[V_RAY]
    for m in range(uint64(first), uint64(_whole(first, last))):
        below = uint64(m - 1)
        low, high = v_highest[below], v_lowest[m]
        turn = along[below] - along[m]
        meet = (rest[m] - rest[below]) / turn
        noise = SAME * (max(q[below], q[m]) + abs(along[below]))  # of a plane and of its slope
        are_met = (q[below] > 0.0) & (q[m] > 0.0)
        is_edge = are_met & (low < meet) & (meet < high) & (abs((meet - (low + high) / 2) * turn) > noise)
        edge[m] = meet if is_edge else NO_EDGE
        # TILT differs from row to row
        slope, slope_below = along[m] - along_u[m] * tilt[m], along[below] - along_u[below] * tilt[below]
        is_alike = abs(slope - slope_below) <= ALIKE * (max(q[m], q[below]) + abs(slope))
        repeated[m] = 1.0 if are_met & is_alike else 0.0
    edge[0] = edge[n] = NO_EDGE
    repeated[0] = repeated[n] = 1.0  # those at both ends may have met more of a plane than is drawn


@uncounted
def _find_narrow(work, first, last, are_joined):
    """Find which of a strip's samples met a face that others miss by chance, from `first` to before `last`.

    Such a face is met by a single row, and ends at edges nearer than rows are apart, or another one hides it in part:
    its height is not known then.

    are_joined : as of `_find_edges`
    """
    work = as_table(work, WORK_ROWS, WORK_COLUMNS)
    edge, repeated, narrow = work[EDGE], work[REPEATED], work[NARROW]
    v_lowest = work[V_LOWEST] if are_joined else work[V_RAY]
    v_highest = work[V_HIGHEST] if are_joined else work[V_RAY]
    for m in range(uint64(first), uint64(_whole(first, last))):
        below, above = uint64(m - 1), uint64(m + 1)
        is_single = repeated[m] + repeated[above] + (v_highest[m] - v_lowest[m]) == 0.0
        height = abs(edge[above] - edge[m])
        is_unknown = max(edge[above], edge[m]) == NO_EDGE
        is_low = 2.0 * height < v_lowest[above] - v_highest[below]
        narrow[m] = 1.0 if is_single & (is_unknown | is_low) else 0.0
    narrow[0] = 0.0


@uncounted
def _find_borders(work, first, last, are_joined, limits):
    """Find v where each of a strip's footprints begins, from `first` to before `last`.

    are_joined : as of `_find_edges`
    limits : `q_unseen` of BinTable, v of the strip's ends
    """
    work = as_table(work, WORK_ROWS, WORK_COLUMNS)
    q, rest, along, border, (q_unseen, v_low, v_high) = work[Q], work[REST], work[ALONG], work[BORDER], limits
    edge, narrow = work[EDGE], work[NARROW]
    v_lowest = work[V_LOWEST] if are_joined else work[V_RAY]
    v_highest = work[V_HIGHEST] if are_joined else work[V_RAY]
    for m in range(uint64(first), uint64(_whole(first, last))):
        below = uint64(m - 1)
        low, high = v_highest[below], v_lowest[m]
        met_low, met_high, meet = q[below] > 0.0, q[m] > 0.0, edge[m]
        # At the edge, if there is one, otherwise half way. Where rows miss a narrow face its neighbours have its place:
        # where one meets it, it has that of a whole row.
        is_edge = (meet < NO_EDGE) & (narrow[below] + narrow[m] == 0.0)
        # a plane that is beyond the range where the other ray looks extends to there or to its horizon
        slope = along[below] if met_low else along[m]
        plane = rest[below] if met_low else rest[m]
        is_lost = (met_low != met_high) & (plane + slope * (high if met_low else low) < q_unseen)
        border_here = meet if is_edge else (low + high) / 2
        border_here = min(max(-plane / slope, low), high) if is_lost else border_here
        border[m] = min(max(border_here, v_low), v_high)


@uncounted
def _clear_row(c, sums, spans):
    """Set a row to zero, as far as its span says that it may differ from it."""
    for k in range(uint64(spans[c, 0]), uint64(max(spans[c, 0], spans[c, 1]))):
        sums[c, k] = 0.0
    spans[c, 0], spans[c, 1] = sums.shape[1], 0


# ---- footprints --------------------------------------------------------------------------------------


@uncounted
def _find_footprints(work, strip, elevation_pattern, per_metre):
    """Find energy, centre, half-widths and slant of a strip's footprints.

    Within a footprint the elevation pattern is linear. That slants the footprints that `_is_slanted` names; in others
    the slants of neighbours make up for each other.

    elevation_pattern : (n,) two-way beam pattern at even sines of elevation from -1 to 1, or of no length
    per_metre : of BinTable
    """
    work = as_table(work, WORK_ROWS, WORK_COLUMNS)
    rest, along, along_u, echo, border = work[REST], work[ALONG], work[ALONG_U], work[ECHO], work[BORDER]
    line_u, tilt, first, last = work[LINE_U], work[TILT], strip.first, strip.last
    are_cones, width, sine, cosine = strip.are_cones, strip.width, strip.sine, strip.cosine
    # `_find_intervals` writes the last three rows later
    energy, slant, inverse_length, power, change = (
        work[ENERGY],
        work[SLANT],
        work[NEAR],
        work[FAR],
        work[NEAR_BIN],
    )
    whole = _whole(first, last)
    for m in range(uint64(first), uint64(whole)):
        low, high = border[m], border[uint64(m + 1)]
        vc, height = (low + high) / 2, max(high - low, 0.0)
        uc = line_u[m] + tilt[m] * vc
        length2 = 1.0 + uc * uc + vc * vc
        one_over_L2 = 1.0 / length2
        one_over_L = math.sqrt(one_over_L2)
        # of cones, dk / du is (cosine (1 + v²) + sine u) / L³, with names as in `_u_on_cone`
        across = width
        if are_cones:
            across *= length2 / (max(cosine * (1.0 + vc * vc) + sine * uc, LEAST_AHEAD) * one_over_L)
        at = rest[m] + along[m] * vc
        energy[m] = echo[m] * across * height * one_over_L * one_over_L2
        work[S, m] = at * one_over_L
        work[A, m] = abs(along_u[m] - at * uc * one_over_L2) * one_over_L * across / 2
        work[B, m] = abs(along[m] - at * (vc + uc * tilt[m]) * one_over_L2) * one_over_L * height / 2
        slant[m], inverse_length[m], change[m] = 0.0, one_over_L, 0.0
    if strip.are_joined:
        bend_footprints(work, first, last, per_metre)
    n = elevation_pattern.shape[0]
    if n == 0 and not strip.are_joined:
        return
    # two loops, since compilers do not vectorise one that reads a table
    middle, last_step = (n - 1) / 2, np.int32(n - 2)
    for m in range(uint64(first), uint64(last if n else first)):
        place = middle + middle * (border[m] + border[uint64(m + 1)]) / 2 * inverse_length[m]
        i = uint64(min(max(np.int32(place), np.int32(0)), last_step))
        step = elevation_pattern[i + uint64(1)] - elevation_pattern[i]
        power[m] = elevation_pattern[i] + (place - i) * step
        slant[m] = step * middle
    for m in range(uint64(first), uint64(whole if n else first)):
        vc, one_over_L = (border[m] + border[uint64(m + 1)]) / 2, inverse_length[m]
        uc = line_u[m] + tilt[m] * vc
        energy[m] *= power[m]
        # from the middle to the upper end the sine rises by `rise`
        rise = (1.0 + uc * (uc - vc * tilt[m])) * one_over_L * one_over_L * one_over_L
        rise *= (border[uint64(m + 1)] - border[m]) / 2
        change[m] += slant[m] * rise / max(power[m], LEAST_POWER)
    for m in range(uint64(first), uint64(whole)):
        vc, one_over_L, s, b = (
            (border[m] + border[uint64(m + 1)]) / 2,
            inverse_length[m],
            work[S, m],
            work[B, m],
        )
        uc = line_u[m] + tilt[m] * vc
        # no more than leaves all densities positive
        rise = min(max(change[m], -1.0), 1.0)
        is_nearer_above = along[m] > s * one_over_L * (vc + uc * tilt[m])
        is_slanted = _is_slanted(s, work[A, m], b, per_metre)
        slant[m] = (rise if is_nearer_above else -rise) if is_slanted else 0.0


@inlined
def _is_long(work, m):
    """Return whether a footprint is so long that it is kept within the range of its body."""
    return (
        work[ENERGY, m] > 0.0 and work[S, m] > 0.0 and work[A, m] + work[B, m] > LONG_FOOTPRINT * work[S, m]
    )


@uncounted
def keep_within(work, m, furthest, nearest):
    """Move the ends of a footprint in s to where its body lies, between `furthest` and `nearest`; its echo stays."""
    work = as_table(work, WORK_ROWS, WORK_COLUMNS)
    s, half = work[S, m], work[A, m] + work[B, m]
    if s - half >= furthest and s + half <= nearest:
        return
    far, near = max(s - half, furthest), min(s + half, nearest)
    share = max(near - far, 0.0) / (2 * half)
    middle = (far + near) / 2 if share > 0.0 else min(max(s, furthest), nearest)
    work[ENERGY, m] *= s / middle  # which is multiplied by s later
    work[S, m], work[A, m], work[B, m] = middle, share * work[A, m], share * work[B, m]


@uncounted
def _keep_within_bodies(work, strip, body_id, body_spans, columns):
    """Keep a strip's long footprints within the ranges of their bodies.

    body_id : (R, C) uint16, in `whole_rows`; body_spans : of `ViewSamples`; columns : of Lattice
    """
    work = as_table(work, WORK_ROWS, WORK_COLUMNS)
    for m in range(uint64(strip.first), uint64(strip.last)):
        if _is_long(work, m):
            i = uint64(min(max(np.int64(work[SAMPLE, m]), 0), columns - 1))
            number = uint64(body_id[uint64(work[ROW, m]), i])
            keep_within(work, m, body_spans[number, 0], body_spans[number, 1])


@uncounted
def _is_slanted(s, a, b, per_metre):
    """Return whether density changes along a footprint: it covers a bin, or if it is narrow, LEAST_SLANTED of one."""
    return (a < b) & (b < s) & (2 * b * per_metre > s * s * (LEAST_SLANTED if 4 * a < b else 1.0))


@uncounted
def bend_footprints(work, first, last, per_metre):
    """Let footprints of several rows end where their planes do, and follow the density in between.

    With s = f(v) along the strip, f = (REST + ALONG v) / √w and w = 1 + (LINE_U + TILT v)² + v², the middle of both
    ends is f + f″ h² / 2 for half the height h, and the mean f + f″ h² / 6. The solid angle per s is proportional to
    1 / D, where D = f′ w^(3/2) is linear in v. An even footprint has its middle at the mean.
    """
    work = as_table(work, WORK_ROWS, WORK_COLUMNS)
    rest, along, border, line_u, tilt = work[REST], work[ALONG], work[BORDER], work[LINE_U], work[TILT]
    energy, s, a, b, change = work[ENERGY], work[S], work[A], work[B], work[NEAR_BIN]
    echo_rise = work[ECHO_RISE]
    for m in range(uint64(first), uint64(_whole(first, last))):
        low, high = border[m], border[uint64(m + 1)]
        vc, half, line, lean = (low + high) / 2, max(high - low, 0.0) / 2, line_u[m], tilt[m]
        uc, at, curve = line + lean * vc, rest[m] + along[m] * vc, 1.0 + lean * lean
        over2 = 1.0 / (1.0 + uc * uc + vc * vc)
        turn = vc + uc * lean  # half of the derivative of w
        bend = 3.0 * at * turn * turn * over2 - 2.0 * along[m] * turn - at * curve
        is_slanted = _is_slanted(s[m], a[m], b[m], per_metre)
        bow = bend * over2 * math.sqrt(over2) * half * half / 2  # f″ h² / 2
        s[m] += bow if is_slanted else bow / 3
        # the nearest end of an even one is that of the plane, which may lie between the ends
        inner = b[m] * b[m] / max(-4.0 * bow, LEAST_POWER) - bow / 3
        even_b = inner if b[m] < -2.0 * bow else b[m] + bow * 2 / 3
        b[m] = b[m] if is_slanted else even_b
        energy[m] *= 1.0 + half * half / 2 * over2 * (5.0 * turn * turn * over2 - curve)
        slope = along[m] * line * lean - rest[m] * curve
        density = along[m] * (1.0 + line * line) - rest[m] * lean * line + vc * slope
        change[m] = echo_rise[m] - half * slope / density if is_slanted else 0.0


@uncounted
def _ramp(s, start):
    """Integrate (s - start) s ds from `start` on."""
    t = max(s - start, 0.0)
    return t * t * (t / 3 + start / 2)


@uncounted
def _below(s, middle, wide, thin):
    """Return 4 wide thin times the energy up to s of the convolution of boxes on ±wide and ±thin.

    It rises with s, but where `wide` far exceeds a bin, as on a plane seen edge-on, rounding makes it fall.
    """
    rise = _ramp(s, middle - wide - thin) - _ramp(s, middle - wide + thin)
    return rise - (_ramp(s, middle + wide - thin) - _ramp(s, middle + wide + thin))


@uncounted
def _slanted(rise, s, nearer, further, wide):
    """Return the density between two places in s, over that of an even footprint about s; ramps are as at its ends.

    At an end without density rounding would make it negative.
    """
    return max(1.0 + rise * min(max((nearer + further) / 2 - s, -wide), wide), 0.0)


@uncounted
def _spread_trapezoid(sums, c, bins_s, first_m, per_metre, energy, s, wide, thin, slant):
    """Add a footprint with ramps of more than a fraction of a bin to a row of bins; return first and last
    bin.
    """
    K = sums.shape[1]
    low, high = max(s - wide - thin, bins_s[K]), min(s + wide + thin, bins_s[0])
    if high <= low:
        return uint64(K), uint64(0)
    scale = energy / (4 * wide * thin)
    # a plane beyond its horizon: the energy of the middle is spread over the part in view
    if s < wide + thin:
        scale = energy * s / (_below(s + wide + thin, s, wide, thin) - _below(0.0, s, wide, thin))
    row = uint64(c)
    first = uint64(min(int((1.0 / high - first_m) * per_metre), K - 1))  # as in `_find_intervals`
    last = uint64(min(int((1.0 / low - first_m) * per_metre), K - 1))
    nearer, rise = _below(high, s, wide, thin), slant / wide if slant != 0.0 else 0.0
    for k in range(first, last):
        edge = bins_s[uint64(k + 1)]
        further = _below(edge, s, wide, thin)
        echo = scale * max(nearer - further, 0.0)
        sums[row, k] += np.float32(echo * _slanted(rise, s, high, edge, wide))
        nearer, high = further, edge
    echo = scale * max(nearer - _below(low, s, wide, thin), 0.0)
    sums[row, last] += np.float32(echo * _slanted(rise, s, high, low, wide))
    return first, last


@uncounted
def _find_intervals(work, first, last, bins):
    """Find both ends of footprints, their heights and bins, ramps neglected, from `first` to before `last`."""
    work = as_table(work, WORK_ROWS, WORK_COLUMNS)
    energy, s, a, b = work[ENERGY], work[S], work[A], work[B]
    s_first, s_last, first_m, per_metre = bins.s[0], bins.s[-1], bins.first_m, bins.per_metre
    last_bin = bins.s.shape[0] - 2.0
    for m in range(uint64(first), uint64(_whole(first, last))):
        wide = max(a[m], b[m], 1e-9 * s[m])
        near, far = s[m] + wide, s[m] - wide
        past = far < 0.0  # beyond the horizon, as in `_spread_trapezoid`
        half_height = energy[m] * (s[m] if past else 0.25) / (near * near if past else wide)
        near, far = min(near, s_first), max(far, s_last)
        inverse = 1.0 / (near * far)  # one division for both ranges
        work[NEAR, m], work[FAR, m], work[HALF_HEIGHT, m] = near, far, half_height
        # by rounding, what begins at the end of the last bin would begin beyond it
        work[NEAR_BIN, m] = min((far * inverse - first_m) * per_metre, last_bin)
        work[FAR_BIN, m] = (near * inverse - first_m) * per_metre


@uncounted
def spread_footprints(work, start, stop, sums, spans, c, bins, short_ramp):
    """Add energy times s = 1/r, spread as the sum of two uniforms on ±a and ±b about s, to a row of bins.

    On a plane the cosine of incidence is proportional to s, and so is the energy's density.

    Parameters
    ----------
    work : of `make_work`, of which the rows ENERGY, S, A, B and SLANT, from `start` to before `stop`, are read
    spans : (columns, 2), of rows of sums: extended over the bins that are added to, first and past last
    bins : BinTable
    short_ramp : share of a bin up to which ramps are neglected
    """
    work = as_table(work, WORK_ROWS, WORK_COLUMNS)
    K, bins_s, density32, middle_s32 = sums.shape[1], bins.s, bins.density32, bins.middle_s32
    first_m, per_metre = bins.first_m, bins.per_metre
    _find_intervals(work, start, stop, bins)
    row, lowest, highest = uint64(c), uint64(K), uint64(0)
    for m in range(uint64(start), uint64(stop)):
        energy, s = work[ENERGY, m], work[S, m]
        if energy == 0.0 or s <= 0.0:
            continue
        wide, thin = max(work[A, m], work[B, m]), min(work[A, m], work[B, m])
        if 2 * thin * per_metre >= short_ramp * s * s:
            slant = work[SLANT, m]
            first, last = _spread_trapezoid(sums, c, bins_s, first_m, per_metre, energy, s, wide, thin, slant)
            lowest, highest = min(lowest, first), max(highest, last)
            continue
        near, far, half_height = work[NEAR, m], work[FAR, m], work[HALF_HEIGHT, m]
        if near <= far:  # outside the bins
            continue
        # written out here: a call for each sample takes as long as all the rest
        first, last = uint64(np.int32(work[NEAR_BIN, m])), uint64(min(np.int32(work[FAR_BIN, m]), K - 1))
        lowest, highest = min(lowest, first), max(highest, last)
        if first >= last:
            sums[row, last] += np.float32(half_height * (near - far) * (near + far))
            continue
        inner, outer, rise, height = bins_s[uint64(first + 1)], bins_s[last], 0.0, np.float32(2 * half_height)
        if work[SLANT, m] == 0.0:
            for k in range(uint64(first + 1), last):
                sums[row, k] += height * density32[k]
        else:
            rise = work[SLANT, m] / wide
            steepness, middle_s = np.float32(2 * half_height * rise), np.float32(s)
            for k in range(uint64(first + 1), last):
                sums[row, k] += (height + steepness * (middle_s32[k] - middle_s)) * density32[k]
        slanted = max(1.0 + rise * ((near + inner) / 2 - s), 0.0)
        sums[row, first] += np.float32(half_height * (near * near - inner**2) * slanted)
        slanted = max(1.0 + rise * ((outer + far) / 2 - s), 0.0)
        sums[row, last] += np.float32(half_height * (outer**2 - far * far) * slanted)
    if lowest <= highest:
        spans[c, 0], spans[c, 1] = min(spans[c, 0], int(lowest)), max(spans[c, 1], int(highest) + 1)


@inlined
def _bin_points(work, sums, spans, u, strip, bins):
    """Add each of a strip's samples to the one bin that holds the range of its ray."""
    c = strip.column
    for m in range(strip.first, strip.last):
        j = work[ROW, m]
        u_ray, v_ray = u[0] + u[1] * work[SAMPLE, m] + u[2] * j, work[V_RAY, m]
        s = work[Q, m] / math.sqrt(1.0 + u_ray * u_ray + v_ray * v_ray)
        k = (1.0 / s - bins.first_m) * bins.per_metre
        if 0.0 <= k < sums.shape[1]:
            sums[c, int(k)] += work[ENERGY, m] * s
            spans[c, 0], spans[c, 1] = min(spans[c, 0], int(k)), max(spans[c, 1], int(k) + 1)


@compiled
def sum_footprints(
    work,
    plane_echo,
    face_id,
    body_id,
    body_spans,
    lattice,
    strips,
    bins,
    spread,
    elevation_pattern,
    sums,
    spans,
):
    """Sum some of one sector's samples into columns and bins.

    The surface in a sample's rectangle is the plane that its ray met. There 1/r is linear in (u, v) but for
    the slow length of the ray: the share before r is that of two convolved boxes, exact for planes. It is cut
    at the aperture, at columns and at edges of planes.

    Parameters
    ----------
    work, plane_echo, face_id : as in `find_strip`
    body_id : (R, C) uint16, in `whole_rows`
    body_spans : of `ViewSamples`; of no length if it or `body_id` is not known
    lattice, strips, bins : tuples of Lattice, StripTable and BinTable
    spread : True spreads each sample over its footprint, False adds it to one bin
    elevation_pattern : (n,) two-way beam pattern at even sines of elevation from -1 to 1, or of no length
    sums : (columns, K) float32, μ cos θ times steradians; the rows of these strips are added to
    spans : (columns, 2) int64, first bin and past the last outside which a row of sums is zero; widened
    """
    samples = plane_echo, face_id, body_id, body_spans, Lattice(*lattice)
    _sum_strips(work, samples, StripTable(*strips), BinTable(*bins), spread, elevation_pattern, sums, spans)


@uncounted
def _sum_strips(work, samples, strips, bins, spread, elevation_pattern, sums, spans):
    """Do the work of `sum_footprints`; samples : with the lattice."""
    (plane_echo, face_id, body_id, body_spans, lattice), untried = samples, 0
    for p in range(strips.middle.shape[0]):
        is_tried = spread and untried == 0
        if is_beside(lattice, strips, p, plane_echo.shape[0]):
            untried = _untried_after(untried, is_tried, False)
            continue
        piece = (bins.piece_rad if is_tried else 0.0), bins.piece_m
        strip = find_strip(work, plane_echo, face_id, lattice, strips, p, bins.q_unseen, piece)
        untried = _untried_after(untried, is_tried, strip.are_joined)
        if strip.first == strip.last:
            continue
        _find_footprints(work, strip, elevation_pattern, bins.per_metre)
        if body_spans.shape[0] > 0:
            _keep_within_bodies(work, strip, body_id, body_spans, lattice.columns)
        if spread:
            short_ramp = SHORT_RAMP_OF_JOINED if strip.are_joined else SHORT_RAMP
            spread_footprints(work, strip.first, strip.last, sums, spans, strip.column, bins, short_ramp)
        else:
            _bin_points(work, sums, spans, lattice.u, strip, bins)


# ---- point scatterers --------------------------------------------------------------------------------


@compiled
def _column_at(column_edges_rad, azimuth_rad):
    """Return the column that holds an azimuth; −1 and the number of columns outside."""
    low, high = 0, column_edges_rad.shape[0]
    while low < high:
        middle = (low + high) // 2
        if azimuth_rad < column_edges_rad[middle]:
            high = middle
        else:
            low = middle + 1
    return low - 1


@compiled
def sum_points(points, column_edges_rad, bin_edges_m, elevation_pattern, top, shared, sums, spans):
    """Sum point scatterers into columns and bins; `sums` and `spans` as in `sum_footprints`.

    points : (n, 4) azimuth, sine of elevation, range, steradians
    elevation_pattern : as in `sum_footprints`; top : sine of the highest elevation
    shared : share each point between the two columns whose middles it lies between, instead of one
    """
    K, n_columns = sums.shape[1], sums.shape[0]
    for c in range(n_columns):
        _clear_row(c, sums, spans)
    per_metre = K / (bin_edges_m[K] - bin_edges_m[0])
    for n in range(points.shape[0]):
        c = _column_at(column_edges_rad, points[n, 0])
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


# ---- wide columns ------------------------------------------------------------------------------------


@uncounted
def share_wide_columns(wide_edges, shares, sums, spans):
    """Add what wide columns hold to their columns.

    Parameters
    ----------
    wide_edges : (W + 1,) column where each of the wide columns begins, and past the last column
    shares : (columns,) float32, the share of its wide column that a column takes
    sums, spans : as in `sum_footprints`; the rows of the wide columns follow those of the columns
    """
    n_columns = shares.shape[0]
    for wide in range(wide_edges.shape[0] - 1):
        row = uint64(n_columns + wide)
        first, past = spans[row, 0], spans[row, 1]
        if first >= past:
            continue
        for c in range(wide_edges[wide], wide_edges[wide + 1]):
            column, share = uint64(c), shares[c]
            for k in range(uint64(first), uint64(past)):
                sums[column, k] += share * sums[row, k]
            spans[c, 0], spans[c, 1] = min(spans[c, 0], first), max(spans[c, 1], past)


# ---- columns to beams --------------------------------------------------------------------------------


@uncounted
def count_bins(spans):
    """Return how many bins of all columns may differ from zero; spans : as in `sum_footprints`."""
    total = 0
    for c in range(spans.shape[0]):
        total += max(spans[c, 1] - spans[c, 0], 0)
    return total


TILE_BEAMS = 4  # beams at a time, so that what is read of columns serves several


class BeamTiles(NamedTuple):
    """Weights of TILE_BEAMS beams at a time: see `beam_tiles`.

    first : (T,) int64, column where each tile begins, may be negative; weights : (T, W', TILE_BEAMS) float32,
        W' a multiple of 4
    """

    first: np.ndarray
    weights: np.ndarray


def beam_tiles(first, weights) -> BeamTiles:
    """Lay the weights of beams side by side, TILE_BEAMS at a time; arguments as `beam_weights` returns them."""
    (B, W), corners = weights.shape, np.arange(0, len(first), TILE_BEAMS)
    starts = np.minimum.reduceat(first, corners)
    n_columns = W + TILE_BEAMS + (np.maximum.reduceat(first, corners) - starts).max()
    out = np.zeros((len(starts), n_columns + -n_columns % 4, TILE_BEAMS), np.float32)
    tile, of_tile = np.divmod(np.arange(B), TILE_BEAMS)
    columns = (first - starts[tile])[:, None] + np.arange(W)
    out[tile[:, None], columns, of_tile[:, None]] = weights
    return BeamTiles(starts, out)


@inlined
def _write_beam(rows, r, begin, end, gain, out, b):
    """Write a row of sums as a beam, times the gain, and return its sum; four sums, since each waits for its last."""
    for k in range(uint64(0), uint64(begin)):
        out[b, k] = 0.0
    for k in range(uint64(end), uint64(out.shape[1])):
        out[b, k] = 0.0
    for k in range(uint64(begin), uint64(end)):
        out[b, k] = rows[r, k] * gain[k] if gain.shape[0] else rows[r, k]
    first = second = third = fourth = 0.0
    last = begin + (end - begin) // 4 * 4
    for k in range(uint64(begin), uint64(last), uint64(4)):
        first, second = first + out[b, k], second + out[b, k + uint64(1)]
        third, fourth = third + out[b, k + uint64(2)], fourth + out[b, k + uint64(3)]
    for k in range(uint64(last), uint64(end)):
        first += out[b, k]
    return (first + second) + (third + fourth)


@compiled
def weigh_columns(column_sums, spans, tiles, part, gain, out):
    """Write some beams as weighted sums of columns, times a gain; return their sum.

    Parameters
    ----------
    column_sums, spans : (columns, K), zero outside of spans, (columns, 2)
    tiles : tuple of BeamTiles
    part : (2,) first and past the last of the tiles that are done
    gain : (K,) or of no length
    out : (B, K) of all beams
    """
    tiles = BeamTiles(*tiles)
    n_columns, K, total = column_sums.shape[0], out.shape[1], 0.0
    rows = np.zeros((TILE_BEAMS, K), np.float32)
    for t in range(part[0], part[1]):
        begin, end = K, 0
        for x in range(0, tiles.weights.shape[1], 4):  # four at a time: beams are read and written less often
            at, w = tiles.first[t] + x, tiles.weights[t, x : x + 4]
            c0, c1 = uint64(at % n_columns), uint64((at + 1) % n_columns)
            c2, c3 = uint64((at + 2) % n_columns), uint64((at + 3) % n_columns)
            low = min(spans[c0, 0], spans[c1, 0], spans[c2, 0], spans[c3, 0])
            high = max(spans[c0, 1], spans[c1, 1], spans[c2, 1], spans[c3, 1])
            if low >= high:
                continue
            begin, end = min(begin, low), max(end, high)
            a0, a1, a2, a3 = w[0, 0], w[0, 1], w[0, 2], w[0, 3]
            b0, b1, b2, b3 = w[1, 0], w[1, 1], w[1, 2], w[1, 3]
            w0, w1, w2, w3 = w[2, 0], w[2, 1], w[2, 2], w[2, 3]
            d0, d1, d2, d3 = w[3, 0], w[3, 1], w[3, 2], w[3, 3]
            for k in range(uint64(low), uint64(high)):
                a, b, c, d = column_sums[c0, k], column_sums[c1, k], column_sums[c2, k], column_sums[c3, k]
                rows[0, k] += (a0 * a + b0 * b) + (w0 * c + d0 * d)
                rows[1, k] += (a1 * a + b1 * b) + (w1 * c + d1 * d)
                rows[2, k] += (a2 * a + b2 * b) + (w2 * c + d2 * d)
                rows[3, k] += (a3 * a + b3 * b) + (w3 * c + d3 * d)
        end = max(begin, end)
        for r in range(min(TILE_BEAMS, out.shape[0] - TILE_BEAMS * t)):
            total += _write_beam(rows, uint64(r), begin, end, gain, out, uint64(TILE_BEAMS * t + r))
        for r in range(uint64(TILE_BEAMS)):
            for k in range(uint64(begin), uint64(end)):
                rows[r, k] = 0.0
    return total


@compiled
def add_far_lobes(moments, first_moment, expansion, part, span, gain, out):
    """Add what some beams receive by far side lobes, times the gain; return the sum of these beams.

    Where the pattern has a null, errors of the far side lobes may leave less than nothing, which counts as nothing.

    Parameters
    ----------
    moments : (n, K) of blocks of beams
    first_moment, expansion : (B,) int64 and (B, rank) float32; the rank is a multiple of 4
    part : (2,) first and past the last of the beams
    span : (2,) first bin and past the last that may differ from 0
    gain, out : as in `weigh_columns`
    """
    total = 0.0
    begin, end = uint64(span[0]), uint64(span[1])
    n = expansion.shape[1]
    row = np.empty(out.shape[1], np.float32)
    for b in range(part[0], part[1]):
        for k in range(begin, end):
            row[k] = 0.0
        for r in range(0, n, 4):
            m = first_moment[b] + r
            m0, m1, m2, m3 = uint64(m), uint64(m + 1), uint64(m + 2), uint64(m + 3)
            w0, w1, w2, w3 = expansion[b, r], expansion[b, r + 1], expansion[b, r + 2], expansion[b, r + 3]
            for k in range(begin, end):
                row[k] += (w0 * moments[m0, k] + w1 * moments[m1, k]) + (
                    w2 * moments[m2, k] + w3 * moments[m3, k]
                )
        ub = uint64(b)
        if gain.shape[0]:
            for k in range(begin, end):
                row[k] *= gain[k]
        for k in range(begin, end):
            out[ub, k] = max(out[ub, k] + row[k], np.float32(0.0))
        first = second = third = fourth = 0.0
        last = begin + (end - begin) // uint64(4) * uint64(4)
        for k in range(begin, last, uint64(4)):
            first, second = first + out[ub, k], second + out[ub, k + uint64(1)]
            third, fourth = third + out[ub, k + uint64(2)], fourth + out[ub, k + uint64(3)]
        for k in range(last, end):
            first += out[ub, k]
        total += (first + second) + (third + fourth)
    return total


# ---- labels: the echo of each body, and its moments ---------------------------------------------------

# Rows of a body's cells, one cell per bin: echo, and echo times elevation, incidence, and range less `middle_m`,
# which is the mean range of a footprint that fills the bin.
CELL_ECHO, CELL_ELEVATION, CELL_INCIDENCE, CELL_RANGE = range(4)
MOMENTS = 4
BODY, COLUMN, FIRST_BIN, PAST_BIN, PLACE = range(5)  # of a run: one body in one column; PLACE: in the pool
RUN = 5


class ColumnBodies(NamedTuple):
    """The bodies of one column of `LabelColumns`, each in a slot.

    slots : (n, 3) int64, body, its first bin and past its last; the first `n_slots` are in use
    cells : (n, MOMENTS, K) float32, zeros of slots that are not in use
    """

    slots: np.ndarray
    n_slots: int
    cells: np.ndarray


class RunStore(NamedTuple):
    """Where runs are stored, and how much of it is in use.

    runs : (n, RUN) int64, BODY .. PLACE
    pool : (n,) float32, of each run MOMENTS rows of its bins
    """

    runs: np.ndarray
    n_runs: int
    pool: np.ndarray
    n_pool: int


class LabelRoom(NamedTuple):
    """How much of a RunStore is in use, `n_runs` and `n_pool`, and how long `cells`, `runs` and `pool` must be."""

    n_runs: int
    n_pool: int
    cells: int
    runs: int
    pool: int


@uncounted
def atan(t):
    """Return arctan of 0..1 to 2e-8; unlike the library's, the compiler can vectorise it.

    Source: Abramowitz, Stegun, "Handbook of Mathematical Functions", 4.4.49
    """
    x = t * t
    p = (0.0028662257 * x - 0.0161657367) * x + 0.0429096138
    p = ((p * x - 0.0752896400) * x + 0.1065626393) * x - 0.1420889944
    return (((p * x + 0.1999355085) * x - 0.3333314528) * x + 1.0) * t


@uncounted
def asin(x):
    """Return arcsin of 0..1 to 2e-8, with one square root.

    Source: Abramowitz, Stegun, "Handbook of Mathematical Functions", 4.4.46
    """
    p = ((-0.0012624911 * x + 0.0066700901) * x - 0.0170881256) * x + 0.0308918810
    p = (((p * x - 0.0501743046) * x + 0.0889789874) * x - 0.2145988016) * x + 1.5707963050
    return math.pi / 2 - math.sqrt(max(1.0 - x, 0.0)) * p


@inlined
def _find_angles(work, strip):
    """Find elevation and incidence of a strip's footprints, before `_find_intervals`."""
    rest, along, along_u, border, s = work[REST], work[ALONG], work[ALONG_U], work[BORDER], work[S]
    line_u, tilt, elevation, incidence = work[LINE_U], work[TILT], work[ELEVATION], work[INCIDENCE]
    inverse_length, incidence_rise = work[NEAR], work[INCIDENCE_RISE]
    first, last = strip.first, strip.last
    for m in range(uint64(first), uint64(_whole(first, last))):
        # of the plane p · x = 1, whose other parts are the slopes
        x, along_v = rest[m] - along_u[m] * line_u[m], along[m] - along_u[m] * tilt[m]
        towards = max(s[m], 0.0)
        past2 = x * x + along_u[m] * along_u[m] + along_v * along_v - towards * towards
        past = math.sqrt(max(past2, 0.0))
        angle = atan(min(towards, past) / max(towards, past))
        incidence[m] = math.pi / 2 - angle if past > towards else angle
        incidence_rise[m] = past  # for `_find_rises`
        vc = (border[m] + border[uint64(m + 1)]) / 2
        elevation[m] = math.copysign(asin(abs(vc) * inverse_length[m]), vc)
    _find_rises(work, strip)


@inlined
def _find_rises(work, strip):
    """Find how elevation and incidence change with s within footprints."""
    rest, along, border, s = work[REST], work[ALONG], work[BORDER], work[S]
    line_u, tilt, a, b, incidence = work[LINE_U], work[TILT], work[A], work[B], work[INCIDENCE]
    elevation_rise, incidence_rise = work[ELEVATION_RISE], work[INCIDENCE_RISE]
    for m in range(uint64(strip.first), uint64(_whole(strip.first, strip.last))):
        # the plane's vector has the part s along the ray, and this one across it
        past, low, high = incidence_rise[m], border[m], border[uint64(m + 1)]
        # by linear regression, if s changes across the strip, too: b² / (a² + b²), over b
        share = b[m] / max(a[m] * a[m] + b[m] * b[m], LEAST_POWER)
        share = share if b[m] > 1e-9 * s[m] else 0.0
        # cos θ is s over the length of the plane's vector; at normal incidence θ falls to 0 at an end
        incidence_rise[m] = -share * min(b[m] / max(past, LEAST_POWER), incidence[m])
        vc, uc = (low + high) / 2, line_u[m] + tilt[m] * (low + high) / 2
        level2 = 1.0 + uc * uc
        length2 = level2 + vc * vc
        rise = share * (high - low) / 2 * math.sqrt(level2) / length2
        is_nearer_above = along[m] * length2 > (rest[m] + along[m] * vc) * (vc + uc * tilt[m])
        elevation_rise[m] = rise if is_nearer_above else -rise


@inlined
def _find_numbers(work, strip, columns, body_id, numbers):
    """Find the body of each of a strip's samples, whether it has energy or not: to ask would be a branch."""
    sample, row = work[SAMPLE], work[ROW]
    for m in range(uint64(strip.first), uint64(strip.last)):
        i = min(max(np.int64(sample[m]), 0), columns - 1)
        numbers[m] = body_id[uint64(i), uint64(row[m])]


@inlined
def _slot_of(body, bodies):
    """Return the slot of a body, a new one at first; and ColumnBodies, grown if full."""
    slots, n_slots, cells = bodies
    slot = 0
    while slot < n_slots and slots[slot, 0] != body:
        slot += 1
    if slot < n_slots:
        return slot, bodies
    if n_slots == slots.shape[0]:
        more_cells = np.zeros((2 * n_slots, MOMENTS, cells.shape[2]), np.float32)
        more_slots = np.empty((2 * n_slots, 3), np.int64)
        for old in range(n_slots):
            for n in range(MOMENTS):
                for k in range(cells.shape[2]):
                    more_cells[old, n, k] = cells[old, n, k]
                    cells[old, n, k] = 0.0  # the caller's, to whom these are lost
            for n in range(3):
                more_slots[old, n] = slots[old, n]
        cells, slots = more_cells, more_slots
    slots[slot, 0], slots[slot, 1], slots[slot, 2] = body, cells.shape[2], 0
    return slot, ColumnBodies(slots, n_slots + 1, cells)


@inlined
def _store_runs(bodies, column, store):
    """Move the cells of a column's bodies to a RunStore; return it, grown if full."""
    slots, n_slots, cells = bodies
    runs, n_runs, pool, used = store
    for slot in range(n_slots):
        first, past = slots[slot, 1], slots[slot, 2]
        if first >= past:
            continue
        if n_runs == runs.shape[0]:
            more_runs = np.empty((2 * n_runs, RUN), np.int64)
            for old in range(n_runs):
                for n in range(RUN):
                    more_runs[old, n] = runs[old, n]
            runs = more_runs
        length = past - first
        wanted = used + MOMENTS * length
        if wanted > pool.shape[0]:
            larger = np.empty(2 * wanted, np.float32)
            for old in range(used):
                larger[old] = pool[old]
            pool = larger
        for n in range(MOMENTS):
            mine, at = cells[slot, n], uint64(used + n * length)
            for i in range(uint64(length)):
                pool[at + i] = mine[uint64(first) + i]
            for k in range(uint64(first), uint64(past)):
                mine[k] = 0.0
        runs[n_runs, BODY], runs[n_runs, COLUMN] = slots[slot, 0], column
        runs[n_runs, FIRST_BIN], runs[n_runs, PAST_BIN], runs[n_runs, PLACE] = first, past, used
        n_runs, used = n_runs + 1, wanted
    return RunStore(runs, n_runs, pool, used)


@uncounted
def _add_moments(cells, slot, k, echo, elevation, incidence, range_):
    """Add an echo with its elevation, incidence and echo times range less `middle_m` to a cell."""
    cells[slot, CELL_ECHO, k] += echo
    cells[slot, CELL_ELEVATION, k] += echo * elevation
    cells[slot, CELL_INCIDENCE, k] += echo * incidence
    cells[slot, CELL_RANGE, k] += range_


@uncounted
def _ramp_range(s, start):
    """As `_ramp`, for (s - start) ds."""
    t = max(s - start, 0.0)
    return t * t / 2


@uncounted
def _below_range(s, middle, wide, thin):
    """As `_below`, for range times energy."""
    rise = _ramp_range(s, middle - wide - thin) - _ramp_range(s, middle - wide + thin)
    return rise - (_ramp_range(s, middle + wide - thin) - _ramp_range(s, middle + wide + thin))


@inlined
def _angles_at(work, m, s):
    """Return elevation and incidence of a footprint at s, float32."""
    off = s - work[S, m]
    elevation = work[ELEVATION, m] + work[ELEVATION_RISE, m] * off
    return np.float32(elevation), np.float32(work[INCIDENCE, m] + work[INCIDENCE_RISE, m] * off)


@inlined
def _spread_moments_trapezoid(work, m, cells, slot, sums, row, bins_s, middle_m, first_m, per_metre):
    """As `_spread_trapezoid`, with moments; return first and last bin."""
    K, energy, s = middle_m.shape[0], work[ENERGY, m], work[S, m]
    wide, thin = max(work[A, m], work[B, m]), min(work[A, m], work[B, m])
    low, high = max(s - wide - thin, bins_s[K]), min(s + wide + thin, bins_s[0])
    if high <= low:
        return uint64(K), uint64(0)
    scale = energy / (4 * wide * thin)
    if s < wide + thin:
        scale = energy * s / (_below(s + wide + thin, s, wide, thin) - _below(0.0, s, wide, thin))
    first = uint64(min(int((1.0 / high - first_m) * per_metre), K - 1))
    last = uint64(min(int((1.0 / low - first_m) * per_metre), K - 1))
    nearer, range_nearer = _below(high, s, wide, thin), _below_range(high, s, wide, thin)
    rise = work[SLANT, m] / wide
    for k in range(first, uint64(last + 1)):
        edge = bins_s[uint64(k + 1)] if k < last else low
        further, range_further = _below(edge, s, wide, thin), _below_range(edge, s, wide, thin)
        slanted, even_echo = _slanted(rise, s, high, edge, wide), scale * max(nearer - further, 0.0)
        echo = even_echo * slanted
        sums[row, k] += np.float32(echo)
        elevation, incidence = _angles_at(work, m, min(max((high + edge) / 2, s - wide), s + wide))
        range_ = np.float32((scale * (range_nearer - range_further) - even_echo * middle_m[k]) * slanted)
        _add_moments(cells, slot, k, np.float32(echo), elevation, incidence, range_)
        nearer, range_nearer, high = further, range_further, edge
    return first, last


@inlined
def _spread_moments(work, start, stop, cells, slot, sums, row, bins, short_ramp):
    """Do as `spread_footprints`, and the same into one body's cells; return the first bin and past the last."""
    bins_s, middle_m, density32, middle_s32 = bins.s, bins.middle_m, bins.density32, bins.middle_s32
    first_m, per_metre = bins.first_m, bins.per_metre
    K, slot, row = middle_m.shape[0], uint64(slot), uint64(row)
    lowest, highest = uint64(K), uint64(0)
    for m in range(uint64(start), uint64(stop)):
        energy, s = work[ENERGY, m], work[S, m]
        if energy == 0.0 or s <= 0.0:
            continue
        if 2 * min(work[A, m], work[B, m]) * per_metre >= short_ramp * s * s:
            first, last = _spread_moments_trapezoid(
                work, m, cells, slot, sums, row, bins_s, middle_m, first_m, per_metre
            )
            lowest, highest = min(lowest, first), max(highest, last)
            continue
        near, far, half_height = work[NEAR, m], work[FAR, m], work[HALF_HEIGHT, m]
        if near <= far:
            continue
        first, last = uint64(np.int32(work[NEAR_BIN, m])), uint64(min(np.int32(work[FAR_BIN, m]), K - 1))
        lowest, highest = min(lowest, first), max(highest, last)
        elevation, incidence = np.float32(work[ELEVATION, m]), np.float32(work[INCIDENCE, m])
        if first >= last:
            echo, part = half_height * (near - far) * (near + far), half_height * (near - far)
            sums[row, last] += np.float32(echo)
            range_ = np.float32(2 * part - echo * middle_m[last])
            _add_moments(cells, slot, last, np.float32(echo), elevation, incidence, range_)
            continue
        inner, outer = bins_s[uint64(first + 1)], bins_s[last]
        rise = work[SLANT, m] / max(work[A, m], work[B, m])
        slanted, even_echo = (
            max(1.0 + rise * ((near + inner) / 2 - s), 0.0),
            half_height * (near * near - inner**2),
        )
        echo = even_echo * slanted
        sums[row, first] += np.float32(echo)
        range_ = np.float32((2 * half_height * (near - inner) - even_echo * middle_m[first]) * slanted)
        _add_moments(cells, slot, first, np.float32(echo), *_angles_at(work, m, (near + inner) / 2), range_)
        slanted, even_echo = (
            max(1.0 + rise * ((outer + far) / 2 - s), 0.0),
            half_height * (outer**2 - far * far),
        )
        echo = even_echo * slanted
        sums[row, last] += np.float32(echo)
        range_ = np.float32((2 * half_height * (outer - far) - even_echo * middle_m[last]) * slanted)
        _add_moments(cells, slot, last, np.float32(echo), *_angles_at(work, m, (outer + far) / 2), range_)
        height, middle_s = np.float32(2 * half_height), np.float32(s)
        steepness = np.float32(2 * half_height * rise)
        # not in the loop below: there the product would be rounded before it is added, and sums have other bits
        if rise == 0.0:
            for k in range(uint64(first + 1), last):
                sums[row, k] += height * density32[k]
        else:
            for k in range(uint64(first + 1), last):
                sums[row, k] += (height + steepness * (middle_s32[k] - middle_s)) * density32[k]
        elevation_rise, incidence_rise = (
            np.float32(work[ELEVATION_RISE, m]),
            np.float32(work[INCIDENCE_RISE, m]),
        )
        for k in range(uint64(first + 1), last):
            off = middle_s32[k] - middle_s
            echo32 = (height + steepness * off) * density32[k]
            cells[slot, CELL_ECHO, k] += echo32
            cells[slot, CELL_ELEVATION, k] += echo32 * (elevation + elevation_rise * off)
            cells[slot, CELL_INCIDENCE, k] += echo32 * (incidence + incidence_rise * off)
    return int(lowest), int(highest) + 1 if lowest <= highest else 0


@inlined
def _bin_moments(work, start, stop, cells, slot, u, bins):
    """As `_bin_points`, into one body's cells; return the first bin and past the last."""
    middle_m = bins.middle_m
    K = middle_m.shape[0]
    lowest, highest = K, 0
    for m in range(start, stop):
        j = work[ROW, m]
        u_ray, v_ray = u[0] + u[1] * work[SAMPLE, m] + u[2] * j, work[V_RAY, m]
        s = work[Q, m] / math.sqrt(1.0 + u_ray * u_ray + v_ray * v_ray)
        bin_ = (1.0 / s - bins.first_m) * bins.per_metre
        if work[ENERGY, m] > 0.0 and 0.0 <= bin_ < K:
            k, echo = int(bin_), work[ENERGY, m] * s
            elevation, incidence = np.float32(work[ELEVATION, m]), np.float32(work[INCIDENCE, m])
            range_ = np.float32(work[ENERGY, m] - echo * middle_m[k])
            _add_moments(cells, slot, k, np.float32(echo), elevation, incidence, range_)
            lowest, highest = min(lowest, k), max(highest, k + 1)
    return lowest, highest


@compiled
def sum_bodies(
    work,
    plane_echo,
    face_id,
    body_id,
    body_spans,
    lattice,
    strips,
    bins,
    spread,
    elevation_pattern,
    label_column,
    cells,
    store,
    sums,
    spans,
):
    """Sum some of one sector's samples into columns and bins, for each body by itself, and all of them.

    Parameters
    ----------
    work .. elevation_pattern : as in `sum_footprints`, but for body_id
    body_id : (C, R) uint16, column by column, as a strip reads it
    label_column : (columns,) int64, with the wide ones, that of `LabelColumns` which each is part of
    cells : of ColumnBodies, zeros before and after
    store : tuple of RunStore
    sums, spans : as in `sum_footprints`, with the same bits

    Returns
    -------
    plain tuple of LabelRoom: how much of the store is in use, and how long `cells`, `runs` and `pool` must be. Where
    one of them is shorter, the results are lost, and all samples must be summed again
    """
    lattice, strips, bins, store = Lattice(*lattice), StripTable(*strips), BinTable(*bins), RunStore(*store)
    work = as_table(work, WORK_ROWS, WORK_COLUMNS)
    numbers, untried = np.empty(plane_echo.shape[0] + 1, np.int64), 0
    bodies, joined = ColumnBodies(np.empty((cells.shape[0], 3), np.int64), 0, cells), -1
    for p in range(strips.middle.shape[0]):
        is_tried = spread and untried == 0
        piece = (bins.piece_rad if is_tried else 0.0), bins.piece_m
        strip = find_strip(work, plane_echo, face_id, lattice, strips, p, bins.q_unseen, piece)
        untried = _untried_after(untried, is_tried, strip.are_joined)
        start, last = strip.first, strip.last
        if start == last:
            continue
        column = strip.column
        if label_column[column] != joined:
            store = _store_runs(bodies, joined, store)
            bodies, joined = ColumnBodies(bodies.slots, 0, bodies.cells), label_column[column]
        _find_footprints(work, strip, elevation_pattern, bins.per_metre)
        _find_numbers(work, strip, lattice.columns, body_id, numbers)
        if body_spans.shape[0] > 0:
            for m in range(uint64(start), uint64(last)):
                if _is_long(work, m):
                    number = uint64(numbers[m])
                    keep_within(work, m, body_spans[number, 0], body_spans[number, 1])
        _find_angles(work, strip)
        if spread:
            _find_intervals(work, start, last, bins)
        else:
            _bin_points(work, sums, spans, lattice.u, strip, bins)
        short_ramp = SHORT_RAMP_OF_JOINED if strip.are_joined else SHORT_RAMP
        while start < last:  # consecutive samples of one body at a time
            stop = start + 1
            while stop < last and numbers[stop] == numbers[start]:
                stop += 1
            slot, bodies = _slot_of(numbers[start], bodies)
            slots, cells = bodies.slots, bodies.cells
            if spread:
                low, high = _spread_moments(work, start, stop, cells, slot, sums, column, bins, short_ramp)
                spans[column, 0], spans[column, 1] = min(spans[column, 0], low), max(spans[column, 1], high)
            else:
                low, high = _bin_moments(work, start, stop, cells, slot, lattice.u, bins)
            slots[slot, 1], slots[slot, 2] = min(slots[slot, 1], low), max(slots[slot, 2], high)
            start = stop
    runs, n_runs, pool, n_pool = _store_runs(bodies, joined, store)
    return n_runs, n_pool, bodies.cells.shape[0], runs.shape[0], pool.shape[0]


# ---- labels: columns to beams, and the body with the strongest echo ------------------------------------

# Bins at a time, so that what a tile's beams read and write stays in fast memory; and the moments of these bins,
# one row after the other.
TILE_BINS = 64
TILE_ROW = MOMENTS * TILE_BINS
# A fainter echo counts as none: a float32 holds neither its inverse nor its moments.
FAINTEST = np.float32(1e-37)


class Runs(NamedTuple):
    """Runs of all bodies, sorted by body and column.

    bodies : (m,) numbers, rising; begins : (m + 1,) where the runs of each begin and end
    table : (n, RUN) of RunStore; owner : (n,) which of the two pools holds each
    share : (n,) float32, how much of what the pool holds belongs to the run
    pools : two, of RunStore
    """

    bodies: np.ndarray
    begins: np.ndarray
    table: np.ndarray
    owner: np.ndarray
    share: np.ndarray
    pools: tuple


def sort_runs(stores, n_columns: int, wide_edges: np.ndarray, wide_shares: np.ndarray) -> tuple:
    """Return the Runs of both halves, by body and column; each column takes its share of the run of a wide one.

    Parameters
    ----------
    stores : of each half, tuple of RunStore
    n_columns, wide_edges, wide_shares : of `LabelColumns`

    Returns
    -------
    plain tuple of Runs
    """
    n, highest = _count_runs(stores, n_columns, wide_edges)
    bodies, begins = np.empty(highest + 1, np.int64), np.empty(highest + 2, np.int64)
    table, owner, share = np.empty((n, RUN), np.int64), np.empty(n, np.int64), np.empty(n, np.float32)
    n_bodies = _sort_runs(stores, n_columns, wide_edges, wide_shares, bodies, begins, table, owner, share)
    return bodies[:n_bodies], begins[: n_bodies + 1], table, owner, share, (stores[0][2], stores[1][2])


@compiled
def _count_runs(stores, n_columns, wide_edges):
    """Return how many runs there are, those of wide columns once for each column, and the highest number of a body."""
    first, second = RunStore(*stores[0]), RunStore(*stores[1])
    n_first, n_all = first.n_runs, first.n_runs + second.n_runs
    n, highest = 0, 0
    for i in range(n_all):
        run = first.runs[i] if i < n_first else second.runs[i - n_first]
        wide = run[COLUMN] - n_columns
        n += 1 if wide < 0 else wide_edges[wide + 1] - wide_edges[wide]
        highest = max(highest, run[BODY])
    return n, highest


@compiled
def _sort_runs(stores, n_columns, wide_edges, wide_shares, bodies, begins, table, owner, share):
    """Fill the arrays of Runs, of which `bodies` and `begins` may be longer; return the number of bodies."""
    first, second = RunStore(*stores[0]), RunStore(*stores[1])
    n_first, n_all = first.n_runs, first.n_runs + second.n_runs
    # in their order, one for each column: which run, its column, its body
    entry = np.empty((3, table.shape[0]), np.int64)
    n = 0
    for i in range(n_all):
        run = first.runs[i] if i < n_first else second.runs[i - n_first]
        wide = run[COLUMN] - n_columns
        begin, end = (run[COLUMN], run[COLUMN] + 1) if wide < 0 else (wide_edges[wide], wide_edges[wide + 1])
        for column in range(begin, end):
            entry[0, n], entry[1, n], entry[2, n] = i, column, run[BODY]
            n += 1
    # by counting, and by the least significant key first: runs of one body and column stay in their order
    order, sorted_ = np.arange(n), np.empty(n, np.int64)
    for key, n_keys in ((1, n_columns), (2, bodies.shape[0])):
        places = np.zeros(n_keys + 1, np.int64)
        for i in range(n):
            places[entry[key, i] + 1] += 1
        for k in range(n_keys):
            places[k + 1] += places[k]
        for i in range(n):
            at = entry[key, order[i]]
            sorted_[places[at]] = order[i]
            places[at] += 1
        order, sorted_ = sorted_, order
    n_bodies = 0
    for i in range(n):
        k = entry[0, order[i]]
        run = first.runs[k] if k < n_first else second.runs[k - n_first]
        for number in range(RUN):
            table[i, number] = run[number]
        is_wide, column = run[COLUMN] >= n_columns, entry[1, order[i]]
        table[i, COLUMN], owner[i] = column, int(k >= n_first)
        share[i] = wide_shares[column] if is_wide else np.float32(1.0)
        if i == 0 or table[i, BODY] != table[i - 1, BODY]:
            bodies[n_bodies], begins[n_bodies] = table[i, BODY], i
            n_bodies += 1
    begins[n_bodies] = n
    return n_bodies


class StrongestEcho(NamedTuple):
    """What is known of the strongest body's echo in each bin: (B, K) arrays, overwritten.

    share : float32, of all echo in the bin; body_id : uint16
    background : float32, the echo of background bodies; of no length if it is not wanted
    means : (3, B, K) float32: mean elevation and incidence, radians, and range, metres
    """

    share: np.ndarray
    body_id: np.ndarray
    background: np.ndarray
    means: np.ndarray


class Panel(NamedTuple):
    """The runs of all bodies in one block of bins, side by side; those of one body in one column are added up.

    begins : (m + 1,) where the runs of each body begin and end
    column : (n,) of each run, rising in each body, counted on from the tiles' first column
    moments : ((n + 3) TILE_ROW,) float32; what follows a body's last run is finite
    """

    begins: np.ndarray
    column: np.ndarray
    moments: np.ndarray


@inlined
def _make_panel(runs, n_columns, origin, end, n_bins):
    """Return a Panel with room for the runs of any block of bins, in columns `origin` to `end`."""
    table, n_blocks = runs.table, (n_bins - 1) // TILE_BINS + 1
    counts = np.zeros(n_blocks, np.int64)
    for n in range(table.shape[0]):
        for block in range(table[n, FIRST_BIN] // TILE_BINS, (table[n, PAST_BIN] - 1) // TILE_BINS + 1):
            counts[block] += 1
    most = counts.max() * ((end - 1) // n_columns - origin // n_columns + 1)
    begins = np.zeros(runs.bodies.shape[0] + 1, np.int64)
    return Panel(begins, np.empty(most, np.int64), np.zeros((most + 3) * TILE_ROW, np.float32))


@inlined
def _pack_panel(panel, runs, k0, n_columns, origin, end):
    """Lay the runs in a block of bins from `k0` on side by side."""
    table, moments, n_packed = runs.table, panel.moments, 0
    for m in range(runs.bodies.shape[0]):
        panel.begins[m] = n_packed
        # columns repeat where the fan is a circle
        for turn in range(origin // n_columns * n_columns, end, n_columns):
            for n in range(runs.begins[m], runs.begins[m + 1]):
                x, first, past = turn + table[n, COLUMN], table[n, FIRST_BIN], table[n, PAST_BIN]
                if not (origin <= x < end and first < k0 + TILE_BINS and past > k0):
                    continue
                pool, share = runs.pools[runs.owner[n]], runs.share[n]
                low, high = uint64(max(first - k0, 0)), uint64(min(past - k0, TILE_BINS))
                # main lobe and side lobes, and wide columns, make several runs of one body in one column
                if n_packed == panel.begins[m] or panel.column[n_packed - 1] != x:
                    panel.column[n_packed] = x
                    n_packed += 1
                    for k in range(uint64((n_packed - 1) * TILE_ROW), uint64(n_packed * TILE_ROW)):
                        moments[k] = 0.0
                for moment in range(MOMENTS):
                    from_ = uint64(table[n, PLACE] + moment * (past - first) + max(k0 - first, 0))
                    to = uint64((n_packed - 1) * TILE_ROW + moment * TILE_BINS) + low
                    for k in range(high - low):
                        moments[to + k] += share * pool[from_ + k]
    panel.begins[runs.bodies.shape[0]] = n_packed


@inlined
def _weigh_runs(panel, first, past, start, weights, w, rows):
    """Weigh some runs of a panel into the beams of one tile.

    start, weights : of the tile; w : (16,) float32, overwritten; rows : (TILE_BEAMS * TILE_ROW,), overwritten
    """
    moments = panel.moments
    for k in range(uint64(rows.shape[0])):
        rows[k] = 0.0
    for n in range(first, past, 4):  # four at a time: beams are read and written less often
        for i in range(uint64(4)):
            x = uint64(panel.column[min(n + i, past - 1)] - start)
            is_one = np.float32(n + i < past)
            for r in range(uint64(TILE_BEAMS)):
                w[uint64(TILE_BEAMS) * i + r] = weights[x, r] * is_one
        at = uint64(n * TILE_ROW)
        a0, a1, a2, a3 = w[0], w[1], w[2], w[3]
        b0, b1, b2, b3 = w[4], w[5], w[6], w[7]
        c0, c1, c2, c3 = w[8], w[9], w[10], w[11]
        d0, d1, d2, d3 = w[12], w[13], w[14], w[15]
        for k in range(uint64(TILE_ROW)):
            a, b = moments[at + k], moments[at + uint64(TILE_ROW) + k]
            c, d = moments[at + uint64(2 * TILE_ROW) + k], moments[at + uint64(3 * TILE_ROW) + k]
            rows[k] += (a0 * a + b0 * b) + (c0 * c + d0 * d)
            rows[uint64(TILE_ROW) + k] += (a1 * a + b1 * b) + (c1 * c + d1 * d)
            rows[uint64(2 * TILE_ROW) + k] += (a2 * a + b2 * b) + (c2 * c + d2 * d)
            rows[uint64(3 * TILE_ROW) + k] += (a3 * a + b3 * b) + (c3 * c + d3 * d)


@inlined
def _begin_comparison(best, body, total, body_id):
    """Begin with the first body in a tile's beams, whose moments `best` holds; arguments as of `_compare`."""
    for r in range(TILE_BEAMS):
        at, bins = uint64(r * TILE_ROW), uint64(r * TILE_BINS)
        for k in range(uint64(TILE_BINS)):
            total[bins + k] = best[at + k]
            body_id[bins + k] = body if best[at + k] > np.float32(0.0) else np.int32(0)


@inlined
def _compare(rows, body, best, total, body_id, stronger):
    """Keep what is known of the stronger echo in each bin of a tile's beams, and add up all.

    rows, best : (TILE_BEAMS * TILE_ROW,)
    total, body_id : (TILE_BEAMS * TILE_BINS,); numbers of bodies are as wide as floats, to select both alike
    stronger : (TILE_BINS,) int32, overwritten
    """
    for r in range(TILE_BEAMS):
        at, bins, n_stronger = uint64(r * TILE_ROW), uint64(r * TILE_BINS), np.int32(0)
        for k in range(uint64(TILE_BINS)):
            total[bins + k] += rows[at + k]
            is_stronger = np.int32(rows[at + k] > best[at + k])
            stronger[k] = is_stronger
            n_stronger += is_stronger
        if n_stronger == 0:
            continue
        for k in range(uint64(TILE_BINS)):
            body_id[bins + k] = body if stronger[k] else body_id[bins + k]
        for moment in range(MOMENTS):
            mine = at + uint64(moment * TILE_BINS)
            for k in range(uint64(TILE_BINS)):
                best[mine + k] = rows[mine + k] if stronger[k] else best[mine + k]


@inlined
def _write_strongest(best, total, body_id, r, middle_m, b, k0, n, strongest):
    """Write what is known of the strongest echo in a block of a beam's bins; `best` is overwritten."""
    at, bins, b, k0 = uint64(r * TILE_ROW), uint64(r * TILE_BINS), uint64(b), uint64(k0)
    share, means, whole, nothing = strongest.share, strongest.means, np.float32(1.0), np.float32(0.0)
    for k in range(uint64(n)):
        share[b, k0 + k] = min(best[at + k] / total[bins + k], whole) if best[at + k] > FAINTEST else nothing
    for k in range(uint64(n)):
        strongest.body_id[b, k0 + k] = body_id[bins + k] if best[at + k] > FAINTEST else np.int32(0)
    for k in range(uint64(TILE_BINS)):
        best[at + k] = whole / best[at + k] if best[at + k] > FAINTEST else np.float32(np.nan)
    for moment in range(uint64(MOMENTS - 1)):
        mine = at + (moment + uint64(1)) * uint64(TILE_BINS)
        for k in range(uint64(n)):
            means[moment, b, k0 + k] = best[mine + k] * best[at + k]
    for k in range(uint64(n)):
        means[MOMENTS - 2, b, k0 + k] += middle_m[k0 + k]


@compiled
def sum_body_echo(runs, response, gain, half, body_echo):
    """Sum the echo of a half of each body's runs in all beams.

    Parameters
    ----------
    runs : tuple of Runs
    response : (columns of `LabelColumns`,) float64, what all beams together return of the echo in a column
    gain : (K,)
    half : 0 or 1
    body_echo : (numbers,) float64, added to: the echo with the gain
    """
    runs, K = Runs(*runs), gain.shape[0]
    row = np.zeros(K, np.float32)
    for m in range(runs.bodies.shape[0]):
        begin, end = runs.begins[m], runs.begins[m + 1]
        middle, lowest, highest = (begin + end) // 2, uint64(K), uint64(0)
        # bin by bin, and these at last: the compiler vectorises no sum over bins
        for n in range(middle if half else begin, end if half else middle):
            first, past = uint64(runs.table[n, FIRST_BIN]), uint64(runs.table[n, PAST_BIN])
            pool, at = runs.pools[runs.owner[n]], uint64(runs.table[n, PLACE])
            weight = np.float32(response[runs.table[n, COLUMN]] * runs.share[n])
            for k in range(past - first):
                row[first + k] += weight * pool[at + k]
            lowest, highest = min(lowest, first), max(highest, past)
        total = 0.0
        for k in range(lowest, max(lowest, highest)):
            total += np.float64(row[k]) * gain[k]
            row[k] = 0.0
        body_echo[runs.bodies[m]] += total


@inlined
def _clear_outside(rows, body_bins, body, k0):
    """Set the echo of a body to zero in those bins from k0 on in which it cannot be; `rows` as of `_compare`."""
    low, high = max(body_bins[body, 0] - k0, 0), max(body_bins[body, 1] - k0, 0)
    for r in range(TILE_BEAMS):
        for k in range(min(low, TILE_BINS)):
            rows[r * TILE_ROW + k] = 0.0
        for k in range(high, TILE_BINS):
            rows[r * TILE_ROW + k] = 0.0


@compiled
def find_strongest(runs, tiles, part, n_columns, middle_m, is_background, body_bins, strongest):
    """Find in each bin of some beams the body with the strongest echo, and what is known of that echo.

    Parameters
    ----------
    runs, tiles, strongest : tuples of Runs, BeamTiles and StrongestEcho
    part : (2,) first and past the last of the tiles that are done
    n_columns : of `LabelColumns`
    middle_m : (K,) float32, of BinTable
    is_background : (numbers,) bool
    body_bins : (numbers, 2) int64, first bin in which a body may be and past the last; of no length if not known
    """
    runs, tiles, strongest = Runs(*runs), BeamTiles(*tiles), StrongestEcho(*strongest)
    B, K = strongest.share.shape
    t0, t1 = part
    if t0 >= t1:  # of few beams the other half has all
        return
    width, with_background = tiles.weights.shape[1], strongest.background.shape[0] > 0
    origin, end = tiles.first[t0:t1].min(), tiles.first[t0:t1].max() + width
    pasts = tiles.first + width  # past the last column that a beam of the tile receives
    for t in range(t0, t1):
        while pasts[t] > tiles.first[t] and not tiles.weights[t, pasts[t] - tiles.first[t] - 1].any():
            pasts[t] -= 1
    panel = _make_panel(runs, n_columns, origin, end, K)
    rows, best = np.empty(TILE_BEAMS * TILE_ROW, np.float32), np.empty(TILE_BEAMS * TILE_ROW, np.float32)
    total, w = np.empty(TILE_BEAMS * TILE_BINS, np.float32), np.empty(4 * TILE_BEAMS, np.float32)
    body_id, stronger = np.empty(TILE_BEAMS * TILE_BINS, np.int32), np.empty(TILE_BINS, np.int32)
    for k0 in range(0, K, TILE_BINS):
        n_bins = min(TILE_BINS, K - k0)
        _pack_panel(panel, runs, k0, n_columns, origin, end)
        for t in range(t0, t1):
            start = tiles.first[t]
            is_first, b0, b1 = True, TILE_BEAMS * t, min(TILE_BEAMS * (t + 1), B)
            if with_background:
                strongest.background[b0:b1, k0 : k0 + n_bins] = 0.0
            for m in range(runs.bodies.shape[0]):
                if panel.begins[m] == panel.begins[m + 1]:
                    continue
                body, columns = runs.bodies[m], panel.column[panel.begins[m] : panel.begins[m + 1]]
                first = panel.begins[m] + np.searchsorted(columns, start)
                past = panel.begins[m] + np.searchsorted(columns, pasts[t])
                if first == past:
                    continue
                mine = best if is_first else rows
                _weigh_runs(panel, first, past, start, tiles.weights[t], w, mine)
                if is_background[body]:
                    for b in range(b0, b1):
                        for k in range(n_bins):
                            strongest.background[b, k0 + k] += mine[(b - b0) * TILE_ROW + k]
                if body_bins.shape[0] > 0:
                    _clear_outside(mine, body_bins, body, k0)
                if is_first:
                    _begin_comparison(best, np.int32(body), total, body_id)
                else:
                    _compare(rows, np.int32(body), best, total, body_id, stronger)
                is_first = False
            if is_first:
                best[:], total[:], body_id[:] = 0.0, 0.0, 0
            for b in range(b0, b1):
                _write_strongest(best, total, body_id, b - b0, middle_m, b, k0, n_bins, strongest)


# ---- image sources: multipath echoes by way of a planar reflector ---------------------------------------
#
# S is the sonar, S' its image behind the reflector. S' sees through the reflector what S sees in it. The
# samples of each are summed and looked up in the view of the other: an echo that goes straight one way and by
# way of the reflector the other needs both ways open.

# Two views of one place may differ by so much of its distance; less on a reflector, which is flat.
SAME_PLACE, SAME_PLANE = 2e-3, 2e-4
MIN_REFLECTED = 1e-4  # of the intensity: what reflects less is no reflector
GRID, SKIRTS_GRID = 24, 12  # directions along each side of a sector that are tried, and of one of the skirts
HORIZON = 1e-9  # 1/x of a plane past its horizon
# Rows of `work` for image sources: position of each sample for the other of S and S', and whether that is before the
# surface; a direction to look into, zeros for none, and what is seen there, as `find_surfaces` returns it; reflected
# intensity; the bistatic echo.
X, Y, Z, SIDE, LEG_X, LEG_Y, LEG_Z, SEEN, REFLECTED, BISTATIC = range(LABEL_ROWS, WORK_ROWS)


# One sector of a ViewIndex: its azimuth's cosine and sine; tangents of half its width and of its lowest and highest
# elevation.
# Its lattice: u = u0 + ui i + uj j and v = v0 + vi i + vj j of column i and row j, and the inverse,
# i = iu (u - u0) + iv (v - v0) and j likewise. Its window: first column in `plane_echo`, columns and rows.
# These names are part of the array's type, by which Numba keeps machine code: other files may use them, too.
SECTOR = np.dtype(
    [(name, np.float64) for name in ("cos", "sin", "tan_half_width", "tan_low", "tan_high")]
    + [(name, np.float64) for name in ("u0", "ui", "uj", "v0", "vi", "vj", "iu", "iv", "ju", "jv")]
    + [(name, np.int64) for name in ("left", "columns", "rows")]
)


class ViewIndex(NamedTuple):
    """All samples of one view of the fan, to find what it sees in a direction.

    plane_echo : (H, W, 4) float32, the windows of sectors side by side
    sectors : (n,) SECTOR
    """

    plane_echo: np.ndarray
    sectors: np.ndarray


def view_index(view: ViewSamples) -> ViewIndex:
    """Return the index of a view, of its own arrays."""
    rows = []
    for (sector, *_), left in zip(view.sectors, view.left, strict=True):
        u, v = sector.u.tolist(), sector.v.tolist()
        scale = 1.0 / (u[1] * v[2] - u[2] * v[1])
        inverse = scale * v[2], -scale * u[2], -scale * v[1], scale * u[1]
        azimuth = math.cos(sector.azimuth_rad), math.sin(sector.azimuth_rad)
        limits = math.tan(sector.half_width_rad) * (1 + 1e-9), sector.tan_low, sector.tan_high
        rows.append((*azimuth, *limits, *u, *v, *inverse, left, sector.columns, sector.rows))
    return ViewIndex(view.plane_echo, np.array(rows, SECTOR))


class Reflection(NamedTuple):
    """Geometry of the image source behind one planar reflector, for the samples of one sector.

    azimuth_rad : of the sector's middle
    to_other : (4, 4) from the frame of these samples' own sonar (S or S') to that of the other one
    ceiling : (4,) a · x > offset of what lies above the water's surface, in the frame of S
    from_image : these are samples of S': echoes by way of the reflector both ways are summed, too
    single_bounce : intensity of the two ways of a single-bounce echo together, over that of one
    index, other_index : plain tuples of ViewIndex of S, and of the other one
    plane : (4,) normal and offset of normal · x = offset in the frame of S, offset > 0
    is_body : the reflector is a body and must be seen there; the water's surface is not seen
    reflected_intensity : (n,) by the sine of the grazing angle, 0 to 1
    """

    azimuth_rad: float
    to_other: np.ndarray
    ceiling: np.ndarray
    from_image: bool
    single_bounce: float
    index: tuple
    other_index: tuple
    plane: np.ndarray
    is_body: bool
    reflected_intensity: np.ndarray


class SectorFrame(NamedTuple):
    """The geometry of a `Reflection` in the frame of its sector.

    own, other : (3, 4) from the sector's frame to that of its own sonar (S or S'), and to the other's
    ceiling : (4,) of `Reflection`
    """

    own: np.ndarray
    other: np.ndarray
    ceiling: np.ndarray


@inlined
def _sector_frame(reflection):
    """Return the SectorFrame of a Reflection."""
    own, other, ceiling = np.zeros((3, 4)), np.empty((3, 4)), np.empty(4)
    cos, sin, to = math.cos(reflection.azimuth_rad), math.sin(reflection.azimuth_rad), reflection.to_other
    own[0, 0] = own[1, 1] = cos
    own[0, 1], own[1, 0], own[2, 2] = -sin, sin, 1.0
    for k in range(3):
        other[k, 0], other[k, 1] = to[k, 0] * cos + to[k, 1] * sin, to[k, 1] * cos - to[k, 0] * sin
        other[k, 2], other[k, 3] = to[k, 2], to[k, 3]
    from_sector, up = other if reflection.from_image else own, reflection.ceiling
    for k in range(4):
        ceiling[k] = up[0] * from_sector[0, k] + up[1] * from_sector[1, k] + up[2] * from_sector[2, k]
    ceiling[3] = up[3] - ceiling[3]
    return SectorFrame(own, other, ceiling)


@uncounted
def find_surfaces(x, y, z, first, last, view, out):
    """Find what a view shows in some directions, all in the frame of its sonar.

    One call finds all of them: it takes as long to count the references to a view's arrays as to look into it, longer
    where two threads do.

    Parameters
    ----------
    x, y, z : (n,) directions, of which those from `first` to before `last` are read
    view : tuple of ViewIndex
    out : (n,) 1 over the distance of the surface, in lengths of the direction; 0 where there is none, −1 outside
        the fan, where all zeros lie
    """
    view = ViewIndex(*view)
    plane_echo, sectors = view
    for n in range(first, last):
        out[n] = -1.0
        for k in range(sectors.shape[0]):
            t = sectors[k]
            ahead, beside = t.cos * x[n] + t.sin * y[n], t.cos * y[n] - t.sin * x[n]
            if ahead <= 0.0 or abs(beside) > t.tan_half_width * ahead:
                continue
            u, v = -beside / ahead, z[n] / ahead
            u2, v2 = 1.0 + u * u, v * abs(v)
            if v2 > t.tan_high * abs(t.tan_high) * u2 or v2 < t.tan_low * abs(t.tan_low) * u2:
                continue
            out[n] = 0.0
            du, dv = u - t.u0, v - t.v0
            i = math.floor(t.iu * du + t.iv * dv + 0.5)
            j = math.floor(t.ju * du + t.jv * dv + 0.5)
            if not (0 <= i < t.columns and 0 <= j < t.rows):
                break  # no body is near
            row, column = int(j), int(t.left + i)
            q = float(plane_echo[row, column, 0])
            if q > 0.0:
                # from the sample's own ray to this direction, in the plane that it met
                off_u, off_v = du - (t.ui * i + t.uj * j), dv - (t.vi * i + t.vj * j)
                q += plane_echo[row, column, 1] * off_u + plane_echo[row, column, 2] * off_v
                out[n] = max(q, 0.0) * ahead
            break


@uncounted
def _is_first(distance_ratio, is_body):
    """Return whether sound meets a reflector before anything else.

    distance_ratio : distance of the reflector over that of the surface seen in that direction
    is_body : of `Reflection`
    """
    return distance_ratio <= 1.0 + SAME_PLANE and (distance_ratio >= 1.0 - SAME_PLANE or not is_body)


@uncounted
def _place_in_table(share, n):
    """Return the entry of a table of n below a share of its length, and how far beyond it that lies, 0 to 1."""
    at = min(max(share, 0.0), 1.0) * (n - 1)
    k = min(int(at), n - 2)
    return k, at - k


@uncounted
def _elevation_power(elevation_pattern, sine):
    """Return the two-way elevation pattern at a sine of elevation."""
    k, rest = _place_in_table((sine + 1.0) / 2, elevation_pattern.shape[0])
    return max(elevation_pattern[k] + rest * (elevation_pattern[k + 1] - elevation_pattern[k]), 0.0)


@compiled
def estimate_reflection(
    view, planes, are_bodies, reflected_intensities, range_max_m, elevation_pattern, reflected
):
    """Estimate, on a coarse grid of directions, how much intensity reflectors return, and the direct echo.

    Parameters
    ----------
    view : tuple of ViewIndex
    planes, are_bodies, reflected_intensities : (n, 4), (n,) and (n, sines) of n reflectors, as in `Reflection`
    elevation_pattern : as in `sum_footprints`
    reflected : (n,) float64, overwritten; in the unit of the direct echo

    Returns
    -------
    the direct echo
    """
    view = ViewIndex(*view)
    plane_echo, sectors = view
    work = np.empty((4, GRID * GRID))
    x, y, z, seen = work[0], work[1], work[2], work[3]
    echo = 0.0
    reflected[:] = 0.0
    for k in range(sectors.shape[0]):
        t = sectors[k]
        middle, half = (t.tan_high + t.tan_low) / 2, (t.tan_high - t.tan_low) / 2
        height = (t.tan_high - t.tan_low) / (sectors[0].tan_high - sectors[0].tan_low)
        n = GRID if t.tan_low < 0.0 < t.tan_high else SKIRTS_GRID
        height *= (GRID / n) ** 2
        for g in range(n * n):
            u = t.tan_half_width * ((2 * (g % n) + 1) / n - 1)
            v = math.sqrt(1.0 + u * u) * (middle + half * ((2 * (g // n) + 1) / n - 1))
            x[g], y[g], z[g] = t.cos + t.sin * u, t.sin - t.cos * u, v
        find_surfaces(x, y, z, 0, n * n, view, seen)
        for g in range(n * n):
            if seen[g] < 0.0:
                continue
            u, v = t.sin * x[g] - t.cos * y[g], z[g]
            length = math.sqrt(1.0 + u * u + v * v)
            weight = two_way = height / length**3
            # of an echo by way of a reflector, one leg may lie on the boresight
            if elevation_pattern.shape[0]:
                power = _elevation_power(elevation_pattern, v / length)
                weight, two_way = weight * math.sqrt(power), weight * power
            if seen[g] > 0.0 and length / seen[g] < range_max_m:
                du, dv = u - t.u0, v - t.v0
                # half way between two samples, rounding may give another one than the one seen, also beside the window
                i = min(max(math.floor(t.iu * du + t.iv * dv + 0.5), 0.0), t.columns - 1.0)
                j = min(max(math.floor(t.ju * du + t.jv * dv + 0.5), 0.0), t.rows - 1.0)
                at = plane_echo[int(j), int(t.left + i), 3]
                echo += two_way * at * seen[g] / length
            for p in range(planes.shape[0]):
                along = planes[p, 0] * x[g] + planes[p, 1] * y[g] + planes[p, 2] * z[g]
                if along <= 0.0 or planes[p, 3] * length >= range_max_m * along:
                    continue
                if _is_first(seen[g] * planes[p, 3] / along, are_bodies[p]):
                    m, rest = _place_in_table(along / length, reflected_intensities.shape[1])
                    lower, upper = reflected_intensities[p, m], reflected_intensities[p, m + 1]
                    reflected[p] += weight * (lower + rest * (upper - lower))
    return echo


@inlined
def find_other_leg(work, strip, other):
    """Find where a strip's samples lie for the other of S and S', and whether that is before their surface."""
    rest, along_u, along, border = work[REST], work[ALONG_U], work[ALONG], work[BORDER]
    line_u, tilt, first, last = work[LINE_U], work[TILT], strip.first, strip.last
    a, b, c, d = other[:, 0], other[:, 1], other[:, 2], other[:, 3]
    # position of the other one, in the frame of this sector
    ox = -(a[0] * d[0] + a[1] * d[1] + a[2] * d[2])
    oy = -(b[0] * d[0] + b[1] * d[1] + b[2] * d[2])
    oz = -(c[0] * d[0] + c[1] * d[1] + c[2] * d[2])
    for m in range(uint64(first), uint64(last)):
        vc = (border[m] + border[uint64(m + 1)]) / 2
        uc, along_v = line_u[m] + tilt[m] * vc, along[m] - along_u[m] * tilt[m]
        depth = 1.0 / max(rest[m] + along[m] * vc, HORIZON)
        work[X, m] = (a[0] - b[0] * uc + c[0] * vc) * depth + d[0]
        work[Y, m] = (a[1] - b[1] * uc + c[1] * vc) * depth + d[1]
        work[Z, m] = (a[2] - b[2] * uc + c[2] * vc) * depth + d[2]
        work[SIDE, m] = 1.0 - ((rest[m] - along_u[m] * line_u[m]) * ox - along_u[m] * oy + along_v * oz)


@inlined
def _find_rays_by_reflector(work, strip, frame, reflection):
    """Find for a strip's samples what a reflector reflects there, and the direction in which the sonar sees it.

    Samples that cannot return anything have no direction, and a reflected intensity of 0.
    """
    rest, along, border, echo = work[REST], work[ALONG], work[BORDER], work[ECHO]
    line_u, tilt, from_image = work[LINE_U], work[TILT], reflection.from_image
    reflected_intensity = reflection.reflected_intensity
    there_x, there_y, there_z, side = work[X], work[Y], work[Z], work[SIDE]
    leg_x, leg_y, leg_z, reflected = (
        work[LEG_X],
        work[LEG_Y],
        work[LEG_Z],
        work[REFLECTED],
    )
    bistatic, own, ceiling, plane = work[BISTATIC], frame.own, frame.ceiling, reflection.plane
    x_0, x_u, x_v, y_0, y_u, y_v = own[0, 0], own[0, 1], own[0, 2], own[1, 0], own[1, 1], own[1, 2]
    z_0, z_u, z_v = own[2, 0], own[2, 1], own[2, 2]
    normal_x, normal_y, normal_z, offset = plane[0], plane[1], plane[2], plane[3]
    up_0, up_u, up_v, top = ceiling[0], ceiling[1], ceiling[2], ceiling[3]
    # without branches, so that the compiler can vectorise it
    for m in range(uint64(strip.first), uint64(strip.last)):
        low, high = border[m], border[uint64(m + 1)]
        vc = (low + high) / 2
        uc, q = line_u[m] + tilt[m] * vc, rest[m] + along[m] * vc
        x, y, z = x_0 - x_u * uc + x_v * vc, y_0 - y_u * uc + y_v * vc, z_0 - z_u * uc + z_v * vc
        # what lies behind the reflector's plane, or turns away from the other one, meets no sound by way of it
        is_met = (side[m] > 0.0) & (normal_x * x + normal_y * y + normal_z * z <= offset * q)
        is_met |= from_image
        is_met &= (echo[m] > 0.0) & (high > low) & (q > HORIZON) & (up_0 - up_u * uc + up_v * vc <= top * q)
        x = x if from_image else there_x[m]
        y = -y if from_image else -there_y[m]  # the image has port and starboard exchanged
        z = z if from_image else there_z[m]
        sine = (normal_x * x + normal_y * y + normal_z * z) / math.sqrt(x * x + y * y + z * z)
        is_met &= sine > 1e-6
        reflected[m] = sine if is_met else 0.0
        leg_x[m], leg_y[m], leg_z[m] = x if is_met else 0.0, y if is_met else 0.0, z if is_met else 0.0
        bistatic[m] = 0.0
    for m in range(uint64(strip.first), uint64(strip.last)):
        if reflected[m] > 0.0:
            k, between = _place_in_table(reflected[m], reflected_intensity.shape[0])
            lower, upper = reflected_intensity[k], reflected_intensity[k + 1]
            reflected[m] = lower + between * (upper - lower)
            if reflected[m] < MIN_REFLECTED:
                reflected[m] = leg_x[m] = leg_y[m] = leg_z[m] = 0.0


@inlined
def _keep_seen(work, strip, reflection):
    """Set the reflected intensity to 0 where the sonar does not see the reflector; turn to the other one.

    Returns
    -------
    first, last : samples that are reflected, from the first to before the last
    """
    plane, is_body, first, last = reflection.plane, reflection.is_body, strip.last, strip.first
    for m in range(strip.first, strip.last):
        if work[REFLECTED, m] == 0.0:
            continue
        leg_x, leg_y, leg_z = work[LEG_X, m], work[LEG_Y, m], work[LEG_Z, m]
        work[LEG_X, m] = work[LEG_Y, m] = work[LEG_Z, m] = 0.0
        seen = work[SEEN, m]
        distance_ratio = seen * plane[3] / (plane[0] * leg_x + plane[1] * leg_y + plane[2] * leg_z)
        if seen < 0.0 or not _is_first(distance_ratio, is_body):
            work[REFLECTED, m] = 0.0
            continue
        first, last = min(first, m), m + 1
        if work[SIDE, m] > 0.0:
            x, y, z = work[X, m], work[Y, m], work[Z, m]
            work[LEG_X, m], work[LEG_Y, m], work[LEG_Z, m] = x, y, z
    return first, last


@inlined
def _find_bistatic(work, begin, end, elevation_pattern):
    """Find the bistatic echo per steradian of a strip's samples that the other one sees, from `begin` to before `end`.

    Returns
    -------
    first, last : samples with such an echo, from the first to before the last
    """
    border, line_u, tilt, echo = work[BORDER], work[LINE_U], work[TILT], work[ECHO]
    there_x, there_y, there_z, side = work[X], work[Y], work[Z], work[SIDE]
    # directions are no longer needed: their rows take the sines of elevation here and there
    seen, bistatic, sine_here, sine_there = (
        work[SEEN],
        work[BISTATIC],
        work[LEG_X],
        work[LEG_Y],
    )
    for m in range(uint64(begin), uint64(end)):
        x, y, z = there_x[m], there_y[m], there_z[m]
        range_there = math.sqrt(x * x + y * y + z * z)
        vc = (border[m] + border[uint64(m + 1)]) / 2
        uc = line_u[m] + tilt[m] * vc
        sine_here[m], sine_there[m] = vc / math.sqrt(1.0 + uc * uc + vc * vc), z / range_there
        is_seen = (seen[m] >= 0.0) & (seen[m] <= 1.0 + SAME_PLACE)
        bistatic[m] = min(echo[m] * side[m] / range_there, 1.0) if is_seen else 0.0
    first, last = end, begin
    for m in range(uint64(begin), uint64(end)):
        if bistatic[m] == 0.0:
            continue
        if elevation_pattern.shape[0]:  # insonified in one direction, received in the other
            here = _elevation_power(elevation_pattern, sine_here[m])
            bistatic[m] *= math.sqrt(here * _elevation_power(elevation_pattern, sine_there[m]))
        first, last = min(first, int64(m)), int64(m) + 1
    return first, last


@inlined
def find_single_bounce(work, strip, first, last, other, single_bounce):
    """Find the footprints of echoes that go one way straight and the other by way of the reflector.

    first, last : samples of the strip, from the first to before the last
    """
    rest, along_u, along, border = work[REST], work[ALONG_U], work[ALONG], work[BORDER]
    line_u, tilt, width = work[LINE_U], work[TILT], strip.width
    # numbers, not arrays, so that the compiler can vectorise the loop
    a0, a1, a2, b0, b1, b2 = other[0, 0], other[1, 0], other[2, 0], other[0, 1], other[1, 1], other[2, 1]
    c0, c1, c2, d0, d1, d2 = other[0, 2], other[1, 2], other[2, 2], other[0, 3], other[1, 3], other[2, 3]
    for m in range(uint64(first), uint64(last)):
        low, high = border[m], border[uint64(m + 1)]
        vc, height = (low + high) / 2, max(high - low, 0.0)
        uc = line_u[m] + tilt[m] * vc
        e0, e1, e2 = a0 - b0 * uc, a1 - b1 * uc, a2 - b2 * uc
        q = max(rest[m] + along[m] * vc, HORIZON)
        u2 = 1.0 + uc * uc
        length2 = u2 + vc * vc
        there_x, there_y, there_z = work[X, m], work[Y, m], work[Z, m]
        length = math.sqrt(length2)
        range_there = math.sqrt(there_x * there_x + there_y * there_y + there_z * there_z)
        s = 2.0 / (length / q + range_there)
        across = width
        if strip.are_cones:  # as in `_find_footprints`
            across *= length2 * length / max(strip.cosine * (1.0 + vc * vc) + strip.sine * uc, LEAST_AHEAD)
        # across, where strips are narrow: by how both ranges change with u
        x, x_u = 1.0 / q, -along_u[m] / (q * q)
        r_u = (uc * x + length2 * x_u) / length
        r_u += there_x / range_there * ((e0 + c0 * vc) * x_u - b0 * x)
        r_u += there_y / range_there * ((e1 + c1 * vc) * x_u - b1 * x)
        r_u += there_z / range_there * ((e2 + c2 * vc) * x_u - b2 * x)
        # up and down, where planes may extend far: at both ends
        low_x, high_x = (
            1.0 / max(rest[m] + along[m] * low, HORIZON),
            1.0 / max(rest[m] + along[m] * high, HORIZON),
        )
        end_u = line_u[m] + tilt[m] * low
        tx, ty, tz = (
            (a0 - b0 * end_u + c0 * low) * low_x + d0,
            (a1 - b1 * end_u + c1 * low) * low_x + d1,
            (a2 - b2 * end_u + c2 * low) * low_x + d2,
        )
        end_length = math.sqrt(1.0 + end_u * end_u + low * low)
        low_s = 2.0 / (end_length * low_x + math.sqrt(tx * tx + ty * ty + tz * tz))
        end_u = line_u[m] + tilt[m] * high
        tx, ty, tz = (
            (a0 - b0 * end_u + c0 * high) * high_x + d0,
            (a1 - b1 * end_u + c1 * high) * high_x + d1,
            (a2 - b2 * end_u + c2 * high) * high_x + d2,
        )
        end_length = math.sqrt(1.0 + end_u * end_u + high * high)
        high_s = 2.0 / (end_length * high_x + math.sqrt(tx * tx + ty * ty + tz * tz))
        work[S, m], work[A, m], work[B, m] = s, abs(r_u) * s * s * across / 4, abs(high_s - low_s) / 2
        work[SLANT, m] = 0.0
        # r^-2 of the way there and back over that of the bin's gain, which is 1 / r'^2 of the mean range
        spreading = 1.0 / (s * range_there)
        strength = single_bounce * work[REFLECTED, m] * work[BISTATIC, m] * spreading * spreading
        work[ENERGY, m] = strength * across * height / (length * length2 * s)


@uncounted
def clear_columns(first, last, sums, spans):
    """Set rows of sums to zero, from `first` to before `last`; `sums` and `spans` as in `sum_footprints`."""
    for c in range(first, last):
        _clear_row(c, sums, spans)


@compiled
def sum_image_source(work, plane_echo, lattice, strips, bins, elevation_pattern, reflection, sums, spans):
    """Add some of one sector's samples to columns and bins, as a planar reflector returns them.

    Parameters
    ----------
    work .. elevation_pattern : as in `sum_footprints`; samples of the sonar, or of its image
    reflection : tuple of Reflection
    sums, spans : as in `sum_footprints`; the rows of these strips are added to

    Returns
    -------
    whether any of the samples is seen in the reflector
    """
    lattice, strips, bins = Lattice(*lattice), StripTable(*strips), BinTable(*bins)
    reflection = Reflection(*reflection)
    frame = _sector_frame(reflection)
    view, other_view = reflection.index, reflection.other_index
    work, no_face_id = as_table(work, WORK_ROWS, WORK_COLUMNS), np.empty((0, 0), np.int32)
    leg_x, leg_y, leg_z, seen = work[LEG_X], work[LEG_Y], work[LEG_Z], work[SEEN]
    is_reflected = False
    for p in range(strips.middle.shape[0]):
        strip = find_strip(work, plane_echo, no_face_id, lattice, strips, p, bins.q_unseen, (0.0, 0.0))
        if strip.first == strip.last:
            continue
        find_other_leg(work, strip, frame.other)
        _find_rays_by_reflector(work, strip, frame, reflection)
        find_surfaces(leg_x, leg_y, leg_z, strip.first, strip.last, view, seen)
        reflected_first, reflected_last = _keep_seen(work, strip, reflection)
        if reflected_first >= reflected_last:
            continue
        find_surfaces(leg_x, leg_y, leg_z, reflected_first, reflected_last, other_view, seen)
        first, last = _find_bistatic(work, reflected_first, reflected_last, elevation_pattern)
        is_reflected = True
        if reflection.from_image:
            _find_footprints(work, strip, elevation_pattern, bins.per_metre)
            for m in range(reflected_first, reflected_last):
                work[ENERGY, m] *= work[REFLECTED, m] * work[REFLECTED, m]
            spread_footprints(
                work, reflected_first, reflected_last, sums, spans, strip.column, bins, SHORT_RAMP
            )
        if first < last:
            find_single_bounce(work, strip, first, last, frame.other, reflection.single_bounce)
            spread_footprints(work, first, last, sums, spans, strip.column, bins, SHORT_RAMP)
    return is_reflected
