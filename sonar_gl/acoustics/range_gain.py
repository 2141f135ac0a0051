"""Range gains: two-way transmission loss by spreading and absorption, and time-varied gain (TVG)."""

from __future__ import annotations

import math

import numpy as np

MIN_SPREADING_RANGE_M = 1e-3  # shorter ranges spread as this one, so that r^-2 is finite at r = 0
MAX_DECADES = 30.0  # gains stay within 10^±30, so that float32 echoes are finite


def sonar_equation_gain(
    range_m: np.ndarray, tvg_k: float, absorption_db_m: float, assumed_db_m: float, shown_per_true: float
) -> np.ndarray:
    """Return the two-way transmission loss and the TVG, linear power.

    The TVG is `time_varied_gain` of the shown range r. Of the true range, the loss is 40 log r + 2 α r, less the
    20 log r by which the area grows that a solid angle holds: echoes are sums over solid angle.

    range_m : ranges that the sonar shows, metres, any shape, float64
    tvg_k : k of the TVG
    absorption_db_m, assumed_db_m : α of the water and of the TVG, dB per metre, one way
    shown_per_true : ratio of shown to true ranges

    Source: Urick, Principles of Underwater Sound, 3rd ed., 1983

    >>> sonar_equation_gain(np.array([10.0, 100.0]), 20.0, 0.1, 0.1, 1.0).tolist()
    [1.0, 1.0]
    """
    r = np.maximum(range_m, MIN_SPREADING_RANGE_M)
    # one exponent: where TVG and loss cancel they do so exactly, and 10^(-αr) cannot underflow on its own
    decades = (tvg_k / 10 - 2) * np.log10(r) + 2 * math.log10(shown_per_true)
    decades += 2 * (assumed_db_m - absorption_db_m / shown_per_true) * r / 10
    return 10.0 ** np.clip(decades, -MAX_DECADES, MAX_DECADES)


def inverse_square_gain(range_m: np.ndarray, shown_per_true: float) -> np.ndarray:
    """Return 1 / r² of the true range, at most 1; parameters as for `sonar_equation_gain`.

    >>> inverse_square_gain(np.array([0.5, 10.0]), 1.0).tolist()
    [1.0, 0.01]
    """
    r = np.maximum(range_m, MIN_SPREADING_RANGE_M)
    return np.minimum(1.0, (r / shown_per_true) ** -2)


def time_varied_gain(range_m: np.ndarray, tvg_k: float, assumed_db_m: float) -> np.ndarray:
    """Return the TVG k log r + 2 α r dB as linear power; parameters as for `sonar_equation_gain`.

    >>> time_varied_gain(np.array([10.0]), 30.0, 0.5).tolist()
    [10000.0]
    """
    r = np.maximum(range_m, MIN_SPREADING_RANGE_M)
    decades = (tvg_k * np.log10(r) + 2 * assumed_db_m * r) / 10
    return 10.0 ** np.clip(decades, -MAX_DECADES, MAX_DECADES)
