"""False alarms of a cell-averaging detector on an even floor: those of theory for cells that correlate as the pulse."""

import numpy as np
import pytest

from sonar_gl import pose
from sonar_gl.noise.noise import add_noise
from sonar_gl.noise.settings import Noise
from tests.support.even_ping import BIN_M, SIGMAS, SOUND_SPEED_M_S, even_ping, hamming_correlation

GUARD, TRAINING = 2, 8  # cells on each side
SPECKLE, PLACE_LOCKED = Noise(speckle=True), Noise(speckle=True, follow_motion=True)
PULSE = {"pulse": True, "bandwidth_hz": 1.36 * SOUND_SPEED_M_S / 2 / BIN_M, "pulse_taper": "hamming"}


def false_alarms(intensity: np.ndarray, factor: float) -> float:
    """Return the share of cells that exceed `factor` times the mean of the training cells on both sides."""
    side = np.ones(TRAINING)
    kernel = np.concatenate([side, np.zeros(2 * GUARD + 1), side]) / (2 * TRAINING)
    mean = np.array([np.convolve(row, kernel, "valid") for row in intensity])
    edge = GUARD + TRAINING
    return float((intensity[:, edge:-edge] > factor * mean).mean())


def theory(factor: float, correlation) -> float:
    """Return the probability of a false alarm in a correlated complex Gaussian field.

    It is that of a positive Hermitian form with one positive eigenvalue μ and others −λ: the product of μ / (μ + λ).
    """
    aside = np.arange(GUARD + 1, GUARD + TRAINING + 1)
    cells = np.concatenate([[0], aside, -aside])
    covariance = correlation(np.subtract.outer(cells, cells).astype(float))
    form = np.diag([1.0] + [-factor / (2 * TRAINING)] * (2 * TRAINING))
    values = np.linalg.eigvals(form @ covariance).real
    positive = values.max()
    return float(np.prod(positive / (positive - values[values < 0])))


@pytest.mark.parametrize("designed", [1e-2, pytest.param(1e-3, marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    "noise, level, pulse",
    [
        (SPECKLE, 1.0, {}),
        (Noise(ambient_db=0.0), 0.0, {}),
        (SPECKLE, 1.0, PULSE),
        (PLACE_LOCKED, 1.0, PULSE),
    ],
)
def test_rate_of_a_cell_averaging_detector(noise, level, pulse, designed):
    n = 2 * TRAINING
    factor = n * (designed ** (-1 / n) - 1)  # of independent cells
    wanted = theory(
        factor, (lambda bins: hamming_correlation(1.36 * bins)) if pulse else (lambda bins: bins == 0)
    )
    if not pulse:
        assert wanted == pytest.approx(designed, rel=1e-9)
    # beams that are hardly correlated, and a sonar that is elsewhere within a bin in each ping
    found = [
        false_alarms(add_noise(ping, noise, seed, seed).intensity.astype(np.float64), factor)
        for seed in range(20)
        for ping in [even_ping(64, 1000, 1.1, level, pose=pose(0.13 * seed, 0.07 * seed), **pulse)]
    ]
    # neighbours share training cells, and so alarms come in groups of two or so
    error = SIGMAS * np.sqrt(2 * wanted / (20 * 64 * 980))
    assert np.mean(found) == pytest.approx(wanted, abs=error)
