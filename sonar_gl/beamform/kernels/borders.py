"""Borders between the footprints of a strip: at the edge of two planes, or half way between two rays."""

from __future__ import annotations

from numba import uint64

from sonar_gl.beamform.kernels.work_table import (
    ALONG,
    ALONG_U,
    BORDER,
    EDGE,
    FLAT,
    NARROW,
    REPEATED,
    REST,
    TILT,
    V_HIGHEST,
    V_LOWEST,
    V_RAY,
    WORK_COLUMNS,
    WORK_ROWS,
    Q,
    whole_groups,
)
from sonar_gl.core.compiled import as_table, uncounted

SAME = 1e-5  # of a plane's 1/x and slope: well above float32's noise, well below what matters
NO_EDGE = 1e30  # beyond all v
ALIKE = 0.3  # of slopes: one face, or two of a smooth one
ONE_FACE = 1e-3  # of slopes: one flat face, not two of a smooth one


@uncounted
def find_edges(work, first, last, n, are_joined):
    """Find v where the planes of two of a strip's n samples make an edge, from `first` to before `last`; else NO_EDGE.

    They do where they meet between their rays. Nearer than SAME they are one plane, and where they meet is noise. Find
    also which samples met the plane of the one below, about (REPEATED) or exactly (FLAT).

    are_joined : samples have a lowest and a highest ray, else the same one
    """
    work = as_table(work, WORK_ROWS, WORK_COLUMNS)
    q, rest, along, edge = work[Q], work[REST], work[ALONG], work[EDGE]
    along_u, tilt, repeated, flat = work[ALONG_U], work[TILT], work[REPEATED], work[FLAT]
    # chosen here: inside the loop it would not be done several samples at a time
    v_lowest = work[V_LOWEST] if are_joined else work[V_RAY]
    v_highest = work[V_HIGHEST] if are_joined else work[V_RAY]
    for m in range(uint64(first), uint64(whole_groups(first, last))):
        below = uint64(m - 1)
        low, high = v_highest[below], v_lowest[m]
        turn = along[below] - along[m]
        meet = (rest[m] - rest[below]) / turn
        apart = abs(rest[m] - rest[below] - turn * (low + high) / 2)  # half way between the rays
        noise = SAME * (max(q[below], q[m]) + abs(along[below]))  # of a plane and of its slope
        are_met = (q[below] > 0.0) & (q[m] > 0.0)
        is_edge = are_met & (low < meet) & (meet < high) & (apart > noise)
        edge[m] = meet if is_edge else NO_EDGE
        # TILT differs from row to row
        slope, slope_below = along[m] - along_u[m] * tilt[m], along[below] - along_u[below] * tilt[below]
        change, steepness = abs(slope - slope_below), max(q[m], q[below]) + abs(slope)
        # a smooth surface leaves its plane by no more than its slope changes; a parallel one behind it is another
        is_one = are_met & (apart <= noise + ALIKE * steepness * (high - low))
        repeated[m] = 1.0 if is_one & (change <= ALIKE * steepness) else 0.0
        flat[m] = 1.0 if is_one & (change <= ONE_FACE * steepness) else 0.0
    edge[0] = edge[n] = NO_EDGE
    repeated[0] = repeated[n] = flat[0] = flat[n] = (
        1.0  # those at both ends may have met more of a plane than is drawn
    )


@uncounted
def find_narrow(work, first, last, are_joined):
    """Find which of a strip's samples met a face that others miss by chance, from `first` to before `last`.

    Such a face is met by a single row, and ends at edges nearer than rows are apart, or another one hides it in part:
    its height is not known then.

    are_joined : as of `find_edges`
    """
    work = as_table(work, WORK_ROWS, WORK_COLUMNS)
    edge, repeated, narrow = work[EDGE], work[REPEATED], work[NARROW]
    v_lowest = work[V_LOWEST] if are_joined else work[V_RAY]
    v_highest = work[V_HIGHEST] if are_joined else work[V_RAY]
    for m in range(uint64(first), uint64(whole_groups(first, last))):
        below, above = uint64(m - 1), uint64(m + 1)
        is_single = repeated[m] + repeated[above] + (v_highest[m] - v_lowest[m]) == 0.0
        height = abs(edge[above] - edge[m])
        is_unknown = max(edge[above], edge[m]) == NO_EDGE
        is_low = 2.0 * height < v_lowest[above] - v_highest[below]
        narrow[m] = 1.0 if is_single & (is_unknown | is_low) else 0.0
    narrow[0] = 0.0


@uncounted
def find_borders(work, first, last, are_joined, limits):
    """Find v where each of a strip's footprints begins, from `first` to before `last`.

    are_joined : as of `find_edges`
    limits : `q_unseen` of BinTable, v of the strip's ends
    """
    work = as_table(work, WORK_ROWS, WORK_COLUMNS)
    q, rest, along, border, (q_unseen, v_low, v_high) = work[Q], work[REST], work[ALONG], work[BORDER], limits
    edge, narrow, flat = work[EDGE], work[NARROW], work[FLAT]
    v_lowest = work[V_LOWEST] if are_joined else work[V_RAY]
    v_highest = work[V_HIGHEST] if are_joined else work[V_RAY]
    for m in range(uint64(first), uint64(whole_groups(first, last))):
        below, above = uint64(m - 1), uint64(m + 1)
        low, high = v_highest[below], v_lowest[m]
        met_low, met_high, meet = q[below] > 0.0, q[m] > 0.0, edge[m]
        # At the edge, if there is one, otherwise half way. Where rows miss a narrow face its neighbours have its place:
        # where one meets it, it has that of a whole row. Two faces with one row each may be of a curved surface, whose
        # tangent planes meet outside it: up to such edges the planes would return more than what they touch.
        height = flat[below] + flat[above] + (low - v_lowest[below]) + (v_highest[m] - high)
        is_edge = (meet < NO_EDGE) & (narrow[below] + narrow[m] == 0.0) & (height > 0.0)
        # a plane that is beyond the range where the other ray looks extends to there or to its horizon
        slope = along[below] if met_low else along[m]
        plane = rest[below] if met_low else rest[m]
        is_lost = (met_low != met_high) & (plane + slope * (high if met_low else low) < q_unseen)
        border_here = meet if is_edge else (low + high) / 2
        border_here = min(max(-plane / slope, low), high) if is_lost else border_here
        border[m] = min(max(border_here, v_low), v_high)
