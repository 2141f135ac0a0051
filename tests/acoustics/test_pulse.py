"""The range response of a pulse: width, side lobes, energy, and the correlation of noise."""

from functools import partial

import numpy as np
import pytest
import trimesh

import sonar_gl as sg
from sonar_gl.acoustics.pulse import (
    FEW_PRODUCTS,
    NEGLECTED_ENERGY,
    PULSE_TAPERS,
    amplitude_response,
    bin_weights,
    coarse_weights,
    field_weights,
    is_coarse,
    matched_filter,
    resolution_cell_m,
)
from sonar_gl.sonar.sonar import CHOICES
from tests.support.threads import counting_thread

BANDWIDTH_HZ, SPEED_M_S = 30e3, 1500.0
NULL_M = 0.025  # c/2B


def power(x, taper):
    """Return the power response at x times c/2B."""
    return amplitude_response(np.asarray(x) * NULL_M, BANDWIDTH_HZ, taper, SPEED_M_S) ** 2


@pytest.mark.parametrize(
    ("taper", "width", "first_null", "side_lobe_db"),
    # Harris 1978, Table 1: -13 and -43 dB, widths 0.89 and 1.30; these are exact, of continuous tapers
    [("uniform", 0.885893, 1.0, -13.2615), ("hamming", 1.302982, 2.0, -42.675)],
)
def test_width_null_and_side_lobes_of_the_response(taper, width, first_null, side_lobe_db):
    assert power(0.0, taper) == 1
    assert power([-width / 2, width / 2], taper) == pytest.approx(0.5, abs=2e-6)
    assert power(first_null, taper) == pytest.approx(0, abs=1e-20)
    beyond = power(np.linspace(first_null, 40, 400_001), taper)
    assert 10 * np.log10(beyond.max()) == pytest.approx(side_lobe_db, abs=1e-4)


def test_each_pulse_taper_of_a_sonar_has_a_series():
    assert tuple(PULSE_TAPERS) == CHOICES["pulse_taper"]


@pytest.mark.parametrize("taper", PULSE_TAPERS)
@pytest.mark.parametrize("bin_size_m", [0.002, 0.01, 0.025, 0.04, 0.2])
def test_bin_weights_are_integrals_of_the_response(taper, bin_size_m):
    weights = bin_weights(bin_size_m, BANDWIDTH_HZ, taper, SPEED_M_S)
    assert weights.dtype == np.float32 and len(weights) % 2 == 1 and not weights.flags.writeable
    assert (weights == weights[::-1]).all()
    total = NULL_M * (1 if taper == "uniform" else 1 + 2 * (0.23 / 0.54) ** 2)  # Parseval
    level = max(1, total / bin_size_m)
    assert weights.sum(dtype=np.float64) == pytest.approx(level, rel=1e-6)
    # integrated by the midpoint rule
    per_bin = 200
    half_length = len(weights) // 2 + 0.5
    r = (np.arange(len(weights) * per_bin) + 0.5) / per_bin * bin_size_m - half_length * bin_size_m
    energy = power(r / NULL_M, taper).reshape(-1, per_bin).mean(1) * bin_size_m
    assert (1 - NEGLECTED_ENERGY[taper]) * total <= energy.sum() <= total * (1 + 1e-6)
    # 2e-5 is the error of the midpoint rule
    np.testing.assert_allclose(weights / level, energy / energy.sum(), rtol=0, atol=2e-5)


@pytest.mark.parametrize("taper", PULSE_TAPERS)
@pytest.mark.parametrize("bin_size_m", [0.01, 0.04])
def test_kernels_depend_on_the_length_of_a_bin_over_that_of_the_pulse_alone(taper, bin_size_m):
    """Twice the speed of sound, in bins twice as long."""
    at = np.linspace(-5, 5, 21)
    for kernel in (bin_weights, field_weights, partial(coarse_weights, at)):
        expected = kernel(bin_size_m, BANDWIDTH_HZ, taper, SPEED_M_S)
        found = kernel(2 * bin_size_m, BANDWIDTH_HZ, taper, 2 * SPEED_M_S)
        np.testing.assert_array_equal(found, expected)


def test_bins_far_longer_than_the_pulse_hold_their_own_echo():
    assert bin_weights(1.0, 30e6).tolist() == [1.0]


def test_coarse_bins_contain_nearly_the_whole_pulse():
    """The side lobes of sinc² beyond half a bin, x = 10 c/2B, have 1/(π² x) of the energy.

    Those of Hamming's response have (0.08 / 0.54)² times the power, by the step at the ends of the spectrum.
    """
    assert bin_weights(20 * NULL_M, BANDWIDTH_HZ).max() == pytest.approx(1 - 1 / (np.pi**2 * 10), abs=1e-3)
    outside = (0.08 / 0.54) ** 2 / (np.pi**2 * 10) / (resolution_cell_m(BANDWIDTH_HZ, "hamming") / NULL_M)
    assert bin_weights(20 * NULL_M, BANDWIDTH_HZ, "hamming").max() == pytest.approx(1 - outside, abs=1.1e-4)
    assert bin_weights(40 * NULL_M, BANDWIDTH_HZ, "hamming").tolist() == [1.0]


@pytest.mark.parametrize("taper", PULSE_TAPERS)
@pytest.mark.parametrize("ratio", [0.1, 0.25, 1.0, 1.36])
def test_side_lobes_are_kept_down_to_50_db(taper, ratio):
    """What `bin_weights` leave out is weaker than −50 dB of the peak, and what they keep is not much weaker."""
    weights = bin_weights(ratio * NULL_M, BANDWIDTH_HZ, taper, SPEED_M_S)
    reach = ratio * len(weights) / 2  # in c/2B
    x = np.linspace(0, 200, 400_001)
    # the last bin ends within a bin of the place at which the envelope is there
    assert power(x[x > reach], taper).max() < 1.05e-5
    assert power(x[(x > 0.9 * reach) & (x < reach)], taper).max() > 0.9e-5


@pytest.mark.parametrize("taper", PULSE_TAPERS)
def test_levels_do_not_depend_on_the_size_of_bins_that_are_shorter_than_the_cell(taper):
    """An even echo of 1 per metre, and a point of 1: the levels are those of one resolution cell, and of the point."""
    cell_m = resolution_cell_m(BANDWIDTH_HZ, taper)
    for bin_size_m in (cell_m, cell_m / 2, cell_m / 8, cell_m / 31):
        weights = bin_weights(bin_size_m, BANDWIDTH_HZ, taper)
        n = 3 * len(weights)
        even = matched_filter(np.full((1, n), bin_size_m, np.float32), weights)[0, n // 2]
        assert even == pytest.approx(cell_m, rel=1e-5)
        if bin_size_m <= cell_m / 8:
            assert weights.max() == pytest.approx(1, abs=1.5e-2)  # the mean of the response over a bin


def test_a_bandwidth_that_follows_from_the_bins_is_no_wider_than_the_frequency():
    """As `Sonar.bandwidth_hz` must not be: bins far shorter than a wavelength then have the level of the cell."""
    sonar = sg.Sonar(
        "short", 750e3, 1, 1000, 2.0, 25.0, 2.0, 1.0, 1.1
    )  # bins of 0.1 mm, a 20th of the wavelength
    pulse = sg.Acoustics.physical().pulse_response(sonar)
    assert pulse.bandwidth_hz == 750e3
    cell_m = resolution_cell_m(*pulse)
    weights = sg.Acoustics.physical().pulse_weights(sonar)
    assert weights.sum() == pytest.approx(cell_m / sonar.bin_size_m, rel=1e-6) and cell_m > 1e-3


@pytest.mark.slow
def test_the_level_of_a_floor_and_of_a_ball_is_that_of_the_cell():
    """In bins of 1, 1/2, 1/4 and 1/8 of it, within 0.1 dB; without a pulse it falls by 3 dB each time."""
    corners = np.array([[5.0, -9, -1], [5, 9, -1], [15, 9, -1], [15, -9, -1]])
    floor = sg.Body(
        "floor", trimesh.Trimesh(corners, [[0, 2, 1], [0, 3, 2]], process=False), reflectivity=0.3
    )
    ball = sg.Body("ball", trimesh.creation.icosphere(4, 0.3), sg.pose(7.5))
    levels_db = {}
    for pulse in (True, False):
        for parts in (1, 2, 4, 8):
            sonar = sg.Sonar("s", 900e3, 9, 160 * parts, 9.0, 20.0, 1.0, 7.0, 11.0, bandwidth_hz=30e3)
            with sg.Simulator(
                sg.Scene([floor, ball]), sonar, sg.Acoustics.physical(pulse=pulse), tolerance=0.01
            ) as simulator:
                power = simulator.ping(np.eye(4)).intensity.astype(float)
            at = (sonar.range_m > 8.5) & (sonar.range_m < 10.5)
            levels = power[4, at].mean(), power[4, sonar.range_m < 8].max()
            levels_db[pulse, parts] = 10 * np.log10(levels)
    for parts in (2, 4, 8):
        apart = levels_db[True, parts] - levels_db[True, 1]
        # the second is of the ball, the largest bin: where bins lie matters
        assert abs(apart[0]) < 0.01 and abs(apart[1]) < 0.1
        naive = levels_db[False, parts] - levels_db[False, 1]
        assert naive[0] == pytest.approx(-10 * np.log10(parts), abs=0.01)


def test_the_matched_filter_keeps_energy_except_at_the_ends():
    weights = bin_weights(0.03, BANDWIDTH_HZ)  # longer than a cell
    half_length = len(weights) // 2
    rng = np.random.default_rng(1)
    echo = np.zeros((7, 4 * half_length), np.float32)
    echo[:, half_length:-half_length] = rng.random((7, 2 * half_length))
    out = matched_filter(echo, weights)
    assert out.shape == echo.shape and out.dtype == np.float32 and out.min() >= 0
    assert out.sum(1, dtype=np.float64) == pytest.approx(echo.sum(1, dtype=np.float64), rel=1e-6)
    expected = [np.convolve(row.astype(np.float64), weights, "same") for row in echo]
    np.testing.assert_allclose(out, expected, rtol=1e-5)  # float32 sums of about 500 numbers
    at_the_end = matched_filter(np.eye(1, 50, dtype=np.float32), np.float32([0.25, 0.5, 0.25]))
    assert at_the_end[0, :3].tolist() == [0.5, 0.25, 0.0]  # a quarter is lost


@pytest.mark.parametrize("n_bins", [1, 2, 5, 64])
def test_kernels_may_be_longer_than_the_ping(n_bins):
    weights = bin_weights(0.002, BANDWIDTH_HZ)
    assert len(weights) > 2 * n_bins
    echo = np.random.default_rng(0).random((3, n_bins)).astype(np.float32)
    middle = len(weights) // 2
    expected = [np.convolve(row, weights)[middle : middle + n_bins] for row in echo]
    np.testing.assert_allclose(matched_filter(echo, weights), expected, rtol=1e-5)  # float32 sums
    assert matched_filter(echo, np.ones(1, np.float32)).tolist() == echo.tolist()


@pytest.mark.parametrize("first, past", [(0, 0), (0, 1), (130, 131), (60, 200), (299, 300), (0, 300)])
def test_zeros_at_the_ends_of_a_row_are_zeros_as_any_others(first, past):
    """They are left out of the sums. A weight for each bin gives the share of each bin as it is."""
    echo, weights = np.zeros((2, 300), np.float32), np.arange(1, 24, dtype=np.float32)
    echo[1, first:past] = np.arange(1, past - first + 1)
    expected = [np.convolve(row, weights[::-1], "same") for row in echo]
    np.testing.assert_array_equal(matched_filter(echo, weights), expected)  # whole numbers below 2^24


def test_a_second_thread_filters_the_same_bytes():
    echo, weights = np.random.default_rng(2).random((61, 900)).astype(np.float32), bin_weights(0.03, 30e3)
    assert echo.size * len(weights) > FEW_PRODUCTS
    with counting_thread() as thread:
        beside = matched_filter(echo, weights, thread)
        assert thread.n_jobs == 1
    assert beside.tobytes() == matched_filter(echo, weights).tobytes()


def test_range_side_lobes_of_a_point_echo():
    """In fine bins the side lobes have the place and the level of those of the response."""
    echo = np.zeros((1, 2001), np.float32)
    echo[0, 1000] = 1
    out = matched_filter(echo, bin_weights(NULL_M / 50, BANDWIDTH_HZ))[0]
    assert out.argmax() == 1000
    lobe = out[1050:1100]
    assert 50 + lobe.argmax() == pytest.approx(1.4303 * 50, abs=1)
    assert 10 * np.log10(lobe.max() / out.max()) == pytest.approx(-13.26, abs=0.02)  # bins are 1/50 c/2B long


def test_field_weights_of_an_untapered_pulse_end_after_50_nulls():
    """Its side lobes hold 1e-4 of the power beyond a thousand. Bins of half a null are 100 to each side."""
    assert len(field_weights(NULL_M / 2, BANDWIDTH_HZ, "uniform", SPEED_M_S)) == 201


@pytest.mark.parametrize(("ratio", "coarse"), [(1.0, True), (1 - 1e-6, False), (1 + 1e-6, True)])
def test_bins_of_a_null_are_coarse(ratio, coarse):
    assert is_coarse(ratio * NULL_M, BANDWIDTH_HZ, "uniform", SPEED_M_S) is coarse


@pytest.mark.parametrize("taper", PULSE_TAPERS)
@pytest.mark.parametrize("ratio", [0.1, 0.4, 0.5, 1.0, 1.5, 3.0])
def test_field_weights_correlate_noise_as_the_pulse_does(taper, ratio):
    """The correlation over bins is the Fourier transform of the power spectrum."""
    weights = field_weights(ratio * NULL_M, BANDWIDTH_HZ, taper, SPEED_M_S).astype(np.float64)
    assert (weights**2).sum() == pytest.approx(1, abs=1e-6)
    found = np.correlate(weights, weights, "full")[len(weights) - 1 :]
    f = (np.arange(20_000) + 0.5) / 20_000 - 0.5
    spectrum = (np.ones_like(f) if taper == "uniform" else 0.54 + 0.46 * np.cos(2 * np.pi * f)) ** 2
    lags = np.arange(min(len(found), 40))
    expected = np.cos(2 * np.pi * np.outer(lags * ratio, f)) @ spectrum / spectrum.sum()
    assert np.abs(found[: len(lags)] - expected).max() < 8e-3  # amplitudes below a per cent are left out
