"""Range bins: their edges in metres and in s = 1/r, and what the sums need of them."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from sonar_gl.sonar.fan import FAR_FACTOR

# Of a bin: how far off a footprint of several rows may be in range. Into how many the aperture in elevation is divided
# at least, as the beam pattern is linear within each. And what is low enough for derivatives, radians.
PIECE_ERROR, PIECES_PER_FOV, HIGHEST_PIECE_RAD = 1 / 160, 16, 1 / 16


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


def bin_table(bin_edges_m: np.ndarray, elevation_fov_rad: float = math.inf) -> BinTable:
    """Return the tables of range bins.

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


def piece_limits(bin_edges_m: np.ndarray, elevation_fov_rad: float = math.inf) -> tuple[float, float]:
    """Return `piece_rad` and `piece_m` of BinTable; arguments as of `bin_table`.

    Between its ends, where range is exact, the range of a plane deviates from that of a footprint by r h² / 8.
    """
    bin_m = (bin_edges_m[-1] - bin_edges_m[0]) / (len(bin_edges_m) - 1)
    return min(HIGHEST_PIECE_RAD, elevation_fov_rad / PIECES_PER_FOV), float(8 * PIECE_ERROR * bin_m)
