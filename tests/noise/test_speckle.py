"""Speckle: its distribution, and its correlation between beams, under tapers and along the pulse."""

import math
from dataclasses import replace

import numpy as np
import pytest

from sonar_gl.acoustics.beam_pattern import aperture_weights, taper_series
from sonar_gl.noise.gaussian import standard_normal
from sonar_gl.noise.noise import add_noise
from sonar_gl.noise.random_streams import stream
from sonar_gl.noise.settings import Noise
from sonar_gl.noise.speckle import (
    TAPS,
    FieldCorrelation,
    add_field,
    aperture_width,
    beam_nodes,
    correlated_field,
    look_at,
)
from tests.support.even_ping import (
    BEAM_WIDTH_RAD,
    BIN_M,
    HAMMING_SERIES,
    SIGMAS,
    SOUND_SPEED_M_S,
    UNIFORM_WIDTH,
    correlation,
    even_ping,
    hamming_correlation,
)

SPECKLE = Noise(speckle=True)
TWO_BINS_HZ = SOUND_SPEED_M_S / (4 * BIN_M)  # bandwidth whose c/2B is two bins


def speckled(ping, noise=SPECKLE, seed=1) -> np.ndarray:
    return add_noise(ping, noise, seed).intensity.astype(np.float64)


def speckle(azimuth_rad, n_bins, beam_width_rad, generator) -> np.ndarray:
    """Return (B, K) float32 speckle of mean 1."""
    correlated = FieldCorrelation(tuple(azimuth_rad.tolist()), beam_width_rad)
    echo = np.ones((len(azimuth_rad), n_bins), np.float32)
    return look_at(echo, correlated_field(correlated, n_bins, generator))


def beam_matrix(azimuth_rad, beam_width_rad, series=()) -> np.ndarray:
    """Return the (B, M) float64 matrix that turns independent normals into the fields of beams."""
    nodes = beam_nodes(tuple(np.asarray(azimuth_rad).tolist()), float(beam_width_rad), series)
    if nodes.sines is None:
        of_nodes = np.eye(nodes.first[-1] + TAPS)
    else:
        mirrored = np.column_stack([-nodes.sines, nodes.cosines])[::-1]
        of_nodes = np.concatenate([np.column_stack([nodes.sines, nodes.cosines]), mirrored])
    near = nodes.first[:, None] + np.arange(TAPS)
    return np.einsum("bt,btm->bm", nodes.weights.astype(np.float64), of_nodes[near])


def fan(fov_deg, n_beams) -> np.ndarray:
    """Return (B,) beam centres, radians, half a spacing inside the fan's edges."""
    return np.radians(fov_deg * ((np.arange(n_beams) + 0.5) / n_beams - 0.5))


# --- distribution


def test_speckle_is_exponential():
    """Independent beams give n independent draws, so that every tolerance is a known standard error."""
    out = speckled(replace(even_ping(256, 4000), sonar=None))
    n = out.size
    assert out.min() >= 0
    assert out.mean() == pytest.approx(1, abs=SIGMAS / np.sqrt(n))
    # contrast std/mean of an exponential is 1, with variance 1/n
    assert out.std() / out.mean() == pytest.approx(1, abs=SIGMAS / np.sqrt(n))
    for k in (0.5, 1, 3, 6):  # P(I > k) = e^-k
        p = np.exp(-k)
        assert (out > k).mean() == pytest.approx(p, abs=SIGMAS * np.sqrt(p * (1 - p) / n))
    # log of an exponential: mean −2.507 dB, std 5.570 dB, kurtosis 5.4, so var(std) = (5.4 − 1)/4n · std²
    db = 10 * np.log10(out)
    assert db.mean() == pytest.approx(-2.50682, abs=SIGMAS * 5.57 / np.sqrt(n))
    assert db.std() == pytest.approx(5.57004, abs=SIGMAS * 5.57 * np.sqrt(1.1 / n))
    assert abs(correlation(out[1:], out[:-1])) < SIGMAS / np.sqrt(n)
    assert abs(correlation(out[:, 1:], out[:, :-1])) < SIGMAS / np.sqrt(n)


def test_speckle_of_no_echo_is_none():
    assert not speckled(even_ping(level=0.0)).any()


@pytest.mark.parametrize("looks", [2, 5])
def test_looks_reduce_the_contrast(looks):
    x = speckled(even_ping(100, 4000, 2.0), Noise(speckle=True, looks=looks))
    n = x.size
    assert x.mean() == pytest.approx(1, abs=SIGMAS / np.sqrt(n * looks))
    assert x.std() == pytest.approx(looks**-0.5, abs=SIGMAS * np.sqrt((2 + 6 / looks) / (4 * n * looks)))


# --- correlation between beams


@pytest.mark.parametrize("fov_deg", [2.0, 10.0, 45.0, 130.0, 360.0])
def test_correlation_of_all_pairs_of_beams(fov_deg):
    """From the matrix itself: near pairs correlate as the array dictates, distant ones not at all."""
    azimuth = fan(fov_deg, 512)
    matrix = beam_matrix(azimuth, BEAM_WIDTH_RAD)
    apart = np.abs(np.subtract.outer(azimuth, azimuth))
    apart = np.minimum(apart, 2 * np.pi - apart)  # a full circle closes
    expected = np.sinc(UNIFORM_WIDTH * apart / BEAM_WIDTH_RAD)
    found = matrix @ matrix.T
    np.testing.assert_allclose(np.diag(found), 1, rtol=0, atol=1e-6)  # float32 rows of unit power
    # a sum of M waves in place of the integral errs by (π t/M)²/6 of it; M is 22 or more
    near = apart < BEAM_WIDTH_RAD
    assert np.abs(found - expected)[near].max() < 1e-3
    assert np.abs(found**2 - expected**2).max() < 1e-3  # of the intensity's variance, all pairs


@pytest.mark.parametrize("series", [(), HAMMING_SERIES])
@pytest.mark.parametrize("n_waves", [317, 318])
def test_fields_go_on_over_the_seam_of_a_full_circle(n_waves, series):
    """With their signs: other fields are added to them before the square is taken."""
    azimuth, width_rad = fan(360.0, 1440), aperture_width(series) * 2 * np.pi / n_waves
    matrix = beam_matrix(azimuth, width_rad, series)
    found = np.einsum(
        "ij,ij->i", matrix, np.roll(matrix, -1, axis=0)
    )  # of each beam and the next one, all around
    x = np.radians(0.25) / (2 * np.pi) * n_waves
    expected = hamming_correlation(x) if series else np.sinc(x)
    # a sum of M waves in place of the integral errs by (π t/M)²/6 of it, and the Kaiser window by 1e-4
    np.testing.assert_allclose(found, expected, rtol=0, atol=2e-4)


@pytest.mark.parametrize(
    ("width_deg", "azimuth_deg"), [(50.0, (-15.0, 15.0)), (60.0, (-50.0, -20.0, 0.0, 10.0, 50.0))]
)
def test_wide_beams_correlate_by_their_own_width(width_deg, azimuth_deg):
    """Few of their waves fit into a circle, and a whole number of them is another width."""
    azimuth = np.radians(azimuth_deg)
    matrix = beam_matrix(azimuth, np.radians(width_deg))
    expected = np.sinc(UNIFORM_WIDTH * np.subtract.outer(azimuth, azimuth) / np.radians(width_deg))
    # by (π t/M)²/6, as above
    assert np.abs(matrix @ matrix.T - expected).max() < 0.01


@pytest.mark.parametrize(
    "azimuth",
    [
        np.linspace(-0.2, 0.2, 41),
        np.linspace(-0.2, 0.2, 41)[:-1],
        np.linspace(-0.2, 0.2, 41) + 1e-3 * np.arange(41) ** 2,
    ],
    ids=["symmetric", "off_centre", "uneven"],
)
def test_speckle_is_the_matrix_times_normals(azimuth):
    found = speckle(azimuth, 8, 2 * BEAM_WIDTH_RAD, stream(8, 0, "speckle"))
    matrix = beam_matrix(azimuth, 2 * BEAM_WIDTH_RAD)
    normals = standard_normal(stream(8, 0, "speckle"), (matrix.shape[1], 16))
    real, imaginary = np.split(matrix @ normals, 2, axis=1)
    # float32 sums of some 40 numbers of about 0.2, in another order
    np.testing.assert_allclose(found, (real**2 + imaginary**2) / 2, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("series", [(), HAMMING_SERIES], ids=["uniform", "hamming"])
@pytest.mark.parametrize("per_beam", [False, True])
@pytest.mark.parametrize("n_beams", [40, 41])
def test_a_field_is_the_matrix_times_normals(n_beams, per_beam, series):
    azimuth = tuple(np.linspace(-0.2, 0.2, n_beams).tolist())
    amplitude = np.linspace(1, 3, n_beams if per_beam else 1, dtype=np.float32)[:, None] * np.ones(
        8, np.float32
    )
    found = np.zeros((n_beams, 2, 8), np.float32)
    add_field(
        found, amplitude, FieldCorrelation(azimuth, 2 * BEAM_WIDTH_RAD, series), stream(8, 0, "speckle")
    )
    matrix = beam_matrix(azimuth, 2 * BEAM_WIDTH_RAD, series)
    normals = standard_normal(stream(8, 0, "speckle"), (matrix.shape[1], 16))
    expected = (matrix @ normals).reshape(n_beams, 2, 8) * amplitude[:, None] * np.sqrt(0.5)
    # float32 sums of some 40 numbers of about 0.2, in another order
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize(("n_beams", "width_rad"), [(6, 0.03), (40, 0.03), (400, 0.004)])
def test_the_pulse_acts_on_all_bins_alike(n_beams, width_rad):
    """Of many beams, the fields of nodes are summed in blocks of bins; 997 is a multiple of none."""
    azimuth, weights = tuple(np.linspace(-0.2, 0.2, n_beams).tolist()), (0.5, math.sqrt(0.5), 0.5)
    found = np.zeros((n_beams, 2, 997), np.float32)
    correlation = FieldCorrelation(azimuth, width_rad, (), np.array(weights, np.float32))
    add_field(found, np.ones((1, 997), np.float32), correlation, stream(8, 0, "speckle"))
    matrix = beam_matrix(azimuth, width_rad)
    normals = standard_normal(stream(8, 0, "speckle"), (2 * matrix.shape[1], 999))
    filtered = np.array([np.convolve(row, weights, "valid") for row in normals])
    expected = np.tensordot(matrix, filtered.reshape(-1, 2, 997), 1) * np.sqrt(0.5)
    # float32 sums of up to some 100 numbers of about 0.1, in another order
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-5)


def test_uneven_beams():
    azimuth = np.radians([-10.0, -9.9, 0.0, 9.0])
    draws = speckle(azimuth, 50_000, BEAM_WIDTH_RAD, stream(0, 0, "speckle"))
    expected = np.sinc(UNIFORM_WIDTH * 0.1) ** 2
    assert correlation(draws[0], draws[1]) == pytest.approx(expected, abs=5e-3)
    assert abs(correlation(draws[1], draws[2])) < SIGMAS / np.sqrt(50_000) + 1e-3


def test_one_beam():
    assert speckle(np.zeros(1), 7, BEAM_WIDTH_RAD, stream(0, 0, "speckle")).shape == (1, 7)


def test_beams_that_do_not_overlap_are_independent():
    ping = even_ping(64, 10, 1.0)
    assert (speckled(ping) == speckled(replace(ping, sonar=None))).all()


# --- tapers


@pytest.mark.parametrize("fov_deg", [2.0, 130.0, 250.0])
@pytest.mark.parametrize("width_deg", [1.0, 15.0])
@pytest.mark.parametrize(
    "spread", [lambda x: x, lambda x: np.arcsin(0.95 * x) / math.asin(0.95), lambda x: x**3]
)
def test_a_taper_widens_the_correlation(fov_deg, width_deg, spread):
    """From the matrix itself: the transform of the squared taper, at the data sheet's width."""
    azimuth = np.radians(fov_deg / 2) * spread(np.linspace(-1, 1, 300))
    matrix = beam_matrix(azimuth, np.radians(width_deg), HAMMING_SERIES)
    apart = np.abs(np.subtract.outer(azimuth, azimuth)) / np.radians(width_deg)
    found, expected = matrix @ matrix.T, hamming_correlation(aperture_width(HAMMING_SERIES) * apart)
    np.testing.assert_allclose(np.diag(found), 1, rtol=0, atol=1e-6)
    # the pattern is cut off 3.2 λ/L from the axis
    assert np.abs(found - expected).max() < 6e-3
    assert np.abs(found**2 - expected**2).max() < 1e-3
    assert aperture_width(HAMMING_SERIES) == pytest.approx(1.302982, abs=1e-6)


@pytest.mark.parametrize("side_lobe_db", [20.0, 43.0])
@pytest.mark.parametrize("fov_deg", [10.0, 130.0])
def test_taylor_arrays_correlate_as_theirs(side_lobe_db, fov_deg):
    azimuth, series = fan(fov_deg, 256), taper_series("taylor", side_lobe_db)
    matrix = beam_matrix(azimuth, BEAM_WIDTH_RAD, series)
    z = (np.arange(10_000) + 0.5) / 10_000 - 0.5
    power = aperture_weights(z, series) ** 2
    apart = aperture_width(series) * (azimuth - azimuth[0]) / BEAM_WIDTH_RAD
    expected = np.cos(2 * np.pi * np.multiply.outer(apart, z)) @ power / power.sum()
    assert np.abs((matrix @ matrix[0]) ** 2 - expected**2).max() < 1e-3


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ({}, 0.5),
        ({"beam_pattern": "line_array", "receive_taper": "hamming"}, hamming_correlation(1.302982 / 2) ** 2),
        ({"beam_pattern": "box", "receive_taper": "hamming"}, 0.5),
    ],
    ids=["uniform", "hamming", "no array"],
)
def test_the_taper_is_that_of_the_ping(settings, expected):
    x = speckled(even_ping(64, 2000, 0.5, **settings))
    error = SIGMAS * 2 / np.sqrt(64 * 2000 / 2)
    assert correlation(x[1:], x[:-1]) == pytest.approx(expected, abs=error + 5e-3)


# --- correlation along the pulse


@pytest.mark.parametrize(("taper", "field"), [("uniform", np.sinc), ("hamming", hamming_correlation)])
def test_bins_shorter_than_the_pulse_share_speckle(taper, field):
    x = speckled(even_ping(100, 4000, 2.0, pulse=True, bandwidth_hz=TWO_BINS_HZ, pulse_taper=taper))
    n = x.size / 2  # independent draws, one per c/2B
    for bins in (1, 2, 3):
        error = SIGMAS * 2 / np.sqrt(n) + 4e-3  # the pulse weights are cut off
        assert correlation(x[:, bins:], x[:, :-bins]) == pytest.approx(field(bins / 2) ** 2, abs=error)
    assert x.mean() == pytest.approx(1, abs=SIGMAS * np.sqrt(1 / n))
    assert x.std() == pytest.approx(1, abs=SIGMAS * np.sqrt(2 / n))
    assert abs(correlation(x[1:], x[:-1])) < SIGMAS / np.sqrt(n)  # beams almost two widths apart


def test_correlation_over_beams_and_bins_is_the_product():
    x = speckled(even_ping(64, 2000, 0.5, pulse=True, bandwidth_hz=TWO_BINS_HZ, pulse_taper="uniform"))
    expected = (np.sinc(0.5) * np.sinc(0.5 * UNIFORM_WIDTH)) ** 2
    error = SIGMAS * 2 / np.sqrt(x.size / 4) + 4e-3
    assert correlation(x[1:, 1:], x[:-1, :-1]) == pytest.approx(expected, abs=error)
