"""The table `work`: what is known of the samples of one strip, a row of the table for each quantity.

One table serves a thread for all strips: functions write its rows in turn, and some rows have two meanings, one after
the other.
"""

from __future__ import annotations

import numpy as np

from sonar_gl.core.compiled import inlined, uncounted
from sonar_gl.core.memory import sparse_table

# Rows of `work`, one entry per sample of a strip.
#
# Where samples lie, by `_lay_upright` or `lay_on_cone`: column and row of the sample in the window; the line
# u = LINE_U + TILT v that the middle of the strip follows there, a tangent if the strip is curved; v of the ray.
SAMPLE, ROW, LINE_U, TILT, V_RAY = range(5)
# What they met, by `_gather_samples` or `gather_pieces`: 1/x on the ray, 0 where it met nothing; the plane that it met:
# 1/x on that line at v = 0, its slope along the line, with v, and its slope along u; the echo per steradian.
Q, REST, ALONG, ALONG_U, ECHO = range(5, 10)
# By `find_borders`: v where the sample's footprint begins.
BORDER = 10
# Joined rows. By `find_faces`: the rows in which another face begins. By `gather_pieces`: v of the lowest and of the
# highest ray of a piece, and by how much its echo is more at the upper end than in the middle, as a share of it.
START, V_LOWEST, V_HIGHEST, ECHO_RISE = range(11, 15)
# Footprints. By `find_footprints`: energy; centre and the two half-widths of the footprint in s = 1/r; by how much its
# density at the nearer end is more than that of an even footprint, as a share of it, and less at the further end. By
# `find_intervals`: both ends, half the height, and the bins of both ends.
ENERGY, S, A, B, SLANT, NEAR, FAR, HALF_HEIGHT, NEAR_BIN, FAR_BIN = range(15, 25)
# The same rows until there are footprints. By `divide_faces`: the row in which a piece begins, and a place for the echo
# at its lower end. By `find_edges`: v of the edge between a sample and the one below, whether it met about its plane,
# and whether exactly. By `find_narrow`: whether other rows miss the face.
PIECE, ECHO_BELOW, EDGE, REPEATED, NARROW, FLAT = ENERGY, S, A, B, SLANT, NEAR
# Labels, by `find_angles`: elevation and incidence in the middle, radians, and how they change with s.
ELEVATION, INCIDENCE, ELEVATION_RISE, INCIDENCE_RISE = range(25, 29)
# Of a footprint that labels spread, one entry per bin: echo, its elevation and incidence, and echo times range less
# `middle_m`. Labels have no image sources, whose rows these are.
BIN_ECHO, BIN_ELEVATION, BIN_INCIDENCE, BIN_RANGE = range(29, 33)
# Image sources: position of each sample for the other of S and S', and whether that is before the surface; a direction
# to look into, zeros for none, and what is seen there, as `find_surfaces` returns it; reflected intensity; the bistatic
# echo.
X, Y, Z, SIDE, LEG_X, LEG_Y, LEG_Z, SEEN, REFLECTED, BISTATIC = range(29, 39)

# Samples of float64 that a processor does at a time. Loops over a strip do whole groups, so that none is left to be
# done by itself: what they find of a few more samples is not read.
AT_A_TIME = 8
# `work` has one size whatever the strip, see `as_table`. A row is no multiple of a page of memory: else all rows would
# compete for the same lines of fast memory.
MAX_STRIP_ROWS = 1 << 16
WORK_ROWS, WORK_COLUMNS = BISTATIC + 1, MAX_STRIP_ROWS + 168
LEAST_POWER = 1e-30  # of an elevation pattern: less in a null


def make_work() -> np.ndarray:
    """Return `work` of the kernels, for one thread at a time."""
    return sparse_table(WORK_ROWS, WORK_COLUMNS)


@inlined
def whole_groups(first, last):
    """Return past the last of whole groups of AT_A_TIME samples that begin with `first` and hold all before `last`."""
    return first + (last - first + AT_A_TIME - 1) // AT_A_TIME * AT_A_TIME


@uncounted
def lit_part(echo, begin, end):
    """Return the first and the last sample with an echo from `begin` to before `end`; 0 and −1 if there is none."""
    while begin < end and echo[begin] == 0.0:
        begin += 1
    while begin < end and echo[end - 1] == 0.0:
        end -= 1
    return (begin, end - 1) if begin < end else (0, -1)
