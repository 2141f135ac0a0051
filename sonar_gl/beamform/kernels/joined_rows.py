"""Rows of samples of a strip that met one face, joined into pieces, each of which one footprint stands for."""

from __future__ import annotations

import math

import numpy as np
from numba import uint64

from sonar_gl.beamform.kernels.work_table import (
    ALONG,
    ALONG_U,
    ECHO,
    ECHO_BELOW,
    ECHO_RISE,
    LEAST_POWER,
    LINE_U,
    PIECE,
    REST,
    ROW,
    SAMPLE,
    START,
    TILT,
    V_HIGHEST,
    V_LOWEST,
    V_RAY,
    WORK_COLUMNS,
    WORK_ROWS,
    Q,
    lit_part,
    whole_groups,
)
from sonar_gl.core.compiled import as_table, uncounted

NOTHING = -1  # of `SectorSamples.face_id`
# Rows of one face are joined where that leaves at most this share of them: with more, it saves less than it costs.
JOINED_SHARE = 0.4
# strips after one where it does not save time that are not tried, as neighbours are mostly alike
UNTRIED_STRIPS = 15
# the share by which 1/x and the echo may change between the middle of a footprint of several rows and its ends
PIECE_CHANGE = 0.05
# The share by which the slope of range may change over a footprint of several rows. Where a plane is nearest, its slope
# is zero, and most of the echo of a wall that faces the sonar lies in one bin. So a footprint is at most so high, as a
# share of what its lower end is apart from that place, below it and above it.
SLOPE_CHANGE = 1 / 3
TOWARDS_NEAREST, FROM_NEAREST = SLOPE_CHANGE / (1 + SLOPE_CHANGE / 2), SLOPE_CHANGE / (1 - SLOPE_CHANGE / 2)


@uncounted
def untried_after(untried, is_tried, are_joined):
    """Return for how many strips no rows are to be joined, after a strip where that was tried or not."""
    if are_joined:
        return 0
    return UNTRIED_STRIPS if is_tried else max(untried - 1, 0)


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
def divide_faces(work, plane_echo, lattice, bottom_row, n_faces, limits):
    """Divide the rows of each face into pieces, each of which one footprint stands for.

    Pieces are as high as `piece_rad` and `piece_m` let them, and as PIECE_CHANGE does; those of one face have as many
    rows, or one more. Near the place where the plane is nearest they have fewer, see SLOPE_CHANGE. Row PIECE of `work`
    gets the row where each begins, and where the last one ends.

    Returns the number of pieces.

    limits : `piece_rad` and `piece_m` of BinTable, height of a row in v
    """
    work = as_table(work, WORK_ROWS, WORK_COLUMNS)
    start, sample, v_ray, piece = work[START], work[SAMPLE], work[V_RAY], work[PIECE]
    columns, bottom, n, (piece_rad, piece_m, rise) = lattice.columns, uint64(bottom_row), 0, limits
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
            nearest_v = _find_nearest(work, plane_echo, lattice, middle, bottom_row)
        # pieces that are alike, and how many of them have a row more than the others
        n_left = max(math.ceil(n_rows * per_row - 1e-9), 1)
        length, n_longer = n_rows // n_left, n_rows % n_left
        longest = length + (n_longer > 0)
        while low < past:
            apart = nearest_v - v_ray[uint64(low)]
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
def _find_nearest(work, plane_echo, lattice, m, bottom_row):
    """Return v where the plane that a row meets is nearest along its strip: the zero of D in `bend_footprints`."""
    work = as_table(work, WORK_ROWS, WORK_COLUMNS)
    u, i, j = lattice.u, np.int64(work[SAMPLE, uint64(m)]), m + bottom_row
    row, column = uint64(j), uint64(min(max(i, 0), lattice.columns - 1))
    line, lean, v_ray = work[LINE_U, uint64(m)], work[TILT, uint64(m)], work[V_RAY, uint64(m)]
    slope_u, slope_v = plane_echo[row, column, 1], plane_echo[row, column, 2]
    rest = plane_echo[row, column, 0] + slope_u * (line - u[0] - u[1] * i - u[2] * j) - slope_v * v_ray
    along = slope_v + slope_u * lean
    slope = rest * (1.0 + lean * lean) - along * line * lean
    return (along * (1.0 + line * line) - rest * line * lean) / slope if slope != 0.0 else math.inf


@uncounted
def gather_pieces(work, plane_echo, lattice, bottom_row, n):
    """Gather what stands for the rows of each of n pieces; return the first and the last with an echo.

    The middle row tells the plane, which is that of all rows; and the echo is that of the first, the middle and the
    last row by Simpson's rule, as it may change with shading normals.
    """
    work = as_table(work, WORK_ROWS, WORK_COLUMNS)
    piece, sample, v_ray, row_of = work[PIECE], work[SAMPLE], work[V_RAY], work[ROW]
    line_u, tilt, v_lowest, v_highest = work[LINE_U], work[TILT], work[V_LOWEST], work[V_HIGHEST]
    q, rest, along, along_u, echo = work[Q], work[REST], work[ALONG], work[ALONG_U], work[ECHO]
    echo_rise, echo_below = work[ECHO_RISE], work[ECHO_BELOW]
    u, columns, bottom = lattice.u, lattice.columns, np.int32(bottom_row)
    u0, ui, uj, most = u[0], u[1], u[2], columns - 1
    # In place: no row is read after a piece is written there, since each piece has a row of its own. Nothing but the
    # reads, as in `_gather_samples`
    for k in range(uint64(n)):
        low, high = np.int32(piece[k]), np.int32(piece[k + uint64(1)]) - np.int32(1)
        m = np.int32((low + high) >> 1)
        i, i_high = np.int32(sample[uint64(m)]), np.int32(sample[uint64(high)])
        i_low = np.int32(sample[uint64(low)])
        j, j_low, j_high = m + bottom, low + bottom, high + bottom
        v_lowest[k], v_highest[k] = v_ray[uint64(low)], v_ray[uint64(high)]
        line_u[k], tilt[k], v_ray[k] = line_u[uint64(m)], tilt[uint64(m)], v_ray[uint64(m)]
        sample[k], row_of[k] = i, j
        row, column = uint64(j), uint64(min(max(i, 0), most))
        q[k], along_u[k] = plane_echo[row, column, 0], plane_echo[row, column, 1]
        along[k], echo[k] = plane_echo[row, column, 2], plane_echo[row, column, 3]
        echo_below[k] = plane_echo[uint64(j_low), uint64(min(max(i_low, 0), most)), 3]
        echo_rise[k] = plane_echo[uint64(j_high), uint64(min(max(i_high, 0), most)), 3]
    for k in range(uint64(whole_groups(0, n))):
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
    return lit_part(echo, 0, n)
