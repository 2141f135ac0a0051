"""Fields along the pulse, under tapers, with texture, looks, motion; receiver noise and other sonars."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from sonar_gl import pose
from sonar_gl.acoustics import Acoustics
from sonar_gl.noise import Noise, add_noise
from sonar_gl.receiver import ambient_noise_db, thermal_noise_db
from sonar_gl.speckle import _beams_from_elements, aperture_width
from sonar_gl.texture import gamma_from_exponential, multiply_by_texture
from sonar_gl.types import Error, Ping

APERTURE = 0.885892941379  # −3 dB width of a uniform line array in λ/L, twice the x of sinc²(x) = 1/2

SIGMAS = 5.0  # a tolerance of so many standard errors is missed by chance once in 1.7 million
BIN_M, WIDTH = 0.0125, np.radians(1.0)
LENGTH_M = APERTURE * 1500 / 900e3 / WIDTH  # of the aperture
HAMMING = (0.23 / 0.54,)


def even_ping(n_beams=64, n_bins=256, spacing_deg=0.25, where=None, level=1.0, **acoustics) -> Ping:
    azimuth = np.radians(spacing_deg) * (np.arange(n_beams) - (n_beams - 1) / 2)
    meta = {"sonar": {"beam_width_deg": 1.0, "frequency_hz": 900e3}, "acoustics": acoustics}
    intensity = np.full((n_beams, n_bins), level, np.float32)
    return Ping(intensity, azimuth, 1 + BIN_M * (np.arange(n_bins) + 0.5), pose=where, meta=meta)


def drawn(noise, ping, count=1, seed=1) -> np.ndarray:
    return np.array([add_noise(ping, noise, seed, n).intensity for n in range(count)], np.float64)


def alike(a, b) -> float:
    return float(np.corrcoef(a.ravel(), b.ravel())[0, 1])


def hamming_correlation(x):
    f = HAMMING[0]
    near, far = (np.sinc(x - m) + np.sinc(x + m) for m in (1, 2))
    return ((1 + 2 * f * f) * np.sinc(x) + 2 * f * near + f * f * far) / (1 + 2 * f * f)


@pytest.mark.parametrize(("taper", "field"), [("uniform", np.sinc), ("hamming", hamming_correlation)])
def test_a_pulse_longer_than_a_bin_shares_speckle(taper, field):
    ping = even_ping(100, 4000, 2.0, bandwidth_hz=1500 / (4 * BIN_M), pulse_taper=taper)  # c/2B is 2 bins
    x = drawn(Noise(speckle=True), ping)[0]
    n = x.size / 2  # independent ones: c/2B each
    for bins in (1, 2, 3):
        wanted = field(bins / 2) ** 2
        error = SIGMAS * 2 / np.sqrt(n) + 4e-3  # the kernel's end is cut off
        assert alike(x[:, bins:], x[:, :-bins]) == pytest.approx(wanted, abs=error)
    assert x.mean() == pytest.approx(1, abs=SIGMAS * np.sqrt(1 / n))
    assert x.std() == pytest.approx(1, abs=SIGMAS * np.sqrt(2 / n))
    assert abs(alike(x[1:], x[:-1])) < SIGMAS / np.sqrt(n)  # beams two widths apart


def test_both_ways_at_once():
    """Beams and bins: the correlation is the product."""
    ping = even_ping(64, 2000, 0.5, bandwidth_hz=1500 / (4 * BIN_M))
    x = drawn(Noise(speckle=True), ping)[0]
    wanted = (np.sinc(0.5) * np.sinc(0.5 * APERTURE)) ** 2
    error = SIGMAS * 2 / np.sqrt(x.size / 4) + 4e-3
    assert alike(x[1:, 1:], x[:-1, :-1]) == pytest.approx(wanted, abs=error)


@pytest.mark.parametrize("fov_deg", [10.0, 130.0])
def test_a_taper_widens_what_beams_share(fov_deg):
    """By the matrix behind the draws: the transform of the squared taper, at the data sheet's width."""
    azimuth = np.radians(fov_deg * ((np.arange(256) + 0.5) / 256 - 0.5))
    factor = _beams_from_elements(tuple(azimuth.tolist()), float(WIDTH), HAMMING).astype(np.float64)
    apart = np.abs(np.subtract.outer(azimuth, azimuth)) / WIDTH
    found = factor @ factor.T
    np.testing.assert_allclose(np.diag(found), 1, rtol=0, atol=1e-6)
    # few waves instead of the integral: 31 at 10 degrees
    assert np.abs(found - hamming_correlation(aperture_width(HAMMING) * apart)).max() < 5e-3
    assert aperture_width(HAMMING) == pytest.approx(1.302982, abs=1e-6)


def test_the_taper_is_that_of_the_ping():
    plain, tapered = (
        even_ping(64, 2000, 0.5),
        even_ping(64, 2000, 0.5, beam_pattern="line_array", taper="hamming"),
    )
    error = SIGMAS * 2 / np.sqrt(64 * 2000 / 2)
    for ping, wanted in ((plain, 0.5), (tapered, hamming_correlation(1.302982 / 2) ** 2)):
        x = drawn(Noise(speckle=True), ping)[0]
        assert alike(x[1:], x[:-1]) == pytest.approx(wanted, abs=error + 5e-3)


@pytest.mark.parametrize("shape", [0.1, 0.5, 1.0, 2.0, 10.0, 1000.0])
def test_the_table_gives_gamma(shape):
    """Against NumPy's gamma, by quantiles; and exactly for shape 1, which is the exponential itself."""
    u = (np.arange(200_000) + 0.5) / 200_000
    out = np.ones((1, len(u)), np.float32)
    multiply_by_texture(out, (-np.log1p(-u)).astype(np.float32)[None], shape)
    out = out[0].astype(np.float64)
    assert out.mean() == pytest.approx(1, rel=2e-3)  # the outermost quantile stands for its tail
    assert out.var() * shape == pytest.approx(1, rel=0.01)
    draws = np.sort(np.random.default_rng(0).gamma(shape, 1 / shape, len(u)))
    for q in (0.1, 0.5, 0.9, 0.99):
        chance = np.searchsorted(draws, out[int(q * len(u))]) / len(u)
        assert chance == pytest.approx(q, abs=SIGMAS * np.sqrt(q * (1 - q) / len(u)))
    if shape == 1:
        np.testing.assert_allclose(out, -np.log1p(-u), rtol=3e-4)
    assert np.isfinite(gamma_from_exponential(shape)[0]).all()


@pytest.mark.parametrize("shape", [1.0, 5.0])
def test_k_distribution(shape):
    x = drawn(Noise(speckle=True, speckle_shape=shape), even_ping(100, 10_000, 2.0))[0]
    n = x.size
    assert x.mean() == pytest.approx(1, abs=SIGMAS * np.sqrt((1 + 2 / shape) / n))
    moments = [np.prod([1 + j / shape for j in range(m)]) * np.prod(np.arange(1, m + 1)) for m in (2, 4)]
    assert (x**2).mean() == pytest.approx(
        moments[0], abs=SIGMAS * np.sqrt((moments[1] - moments[0] ** 2) / n)
    )
    assert moments[0] - 1 == pytest.approx(1 + 2 / shape)  # contrast squared


def test_texture_does_not_move_speckle():
    ping = even_ping()
    plain, spiky = (drawn(Noise(speckle=True, speckle_shape=s), ping)[0] for s in (None, 1e4))
    assert alike(plain, spiky) == pytest.approx(1, abs=1e-3)  # texture of contrast 1 %


@pytest.mark.parametrize("looks", [2, 5])
def test_looks(looks):
    x = drawn(Noise(speckle=True, looks=looks), even_ping(100, 4000, 2.0))[0]
    n = x.size
    assert x.mean() == pytest.approx(1, abs=SIGMAS / np.sqrt(n * looks))
    assert x.std() == pytest.approx(looks**-0.5, abs=SIGMAS * np.sqrt((2 + 6 / looks) / (4 * n * looks)))


# Motion


def moved(seed, x=0.0, y=0.0, yaw=0.0, z=0.0, **acoustics):
    where = pose(100.2 + x, -50.2 + y, z, 0, 0, 0.3 + yaw)
    return drawn(Noise(speckle=True, follow_motion=True), even_ping(where=where, **acoustics), 1, seed)[0]


def test_a_still_sonar_sees_a_still_pattern():
    ping = even_ping(where=pose(0.2, 0.2, 0, 0, 0, 0))
    plain = Noise(speckle=True, follow_motion=True)
    for noise in (plain, replace(plain, speckle_shape=1.0, looks=2)):
        frozen = drawn(noise, ping, 2)
        assert (frozen[0] == frozen[1]).all()
        assert alike(frozen[0], drawn(noise, ping, 1, seed=2)[0]) < 0.1
    # what the receiver adds flickers
    noisy = drawn(replace(plain, electronic_db=0.0), ping, 2)
    assert (noisy[0] != noisy[1]).mean() > 0.99
    # where it looks and whose ping it is do not matter to its statistics
    x = np.array([moved(seed) for seed in range(30)])
    n = 30 * 256 * 64 * 0.25 * APERTURE
    assert x.mean() == pytest.approx(1, abs=SIGMAS / np.sqrt(n))
    assert x.std() == pytest.approx(1, abs=SIGMAS * np.sqrt(2 / n))
    wanted = np.sinc(APERTURE / 2) ** 2
    assert alike(x[:, 2:], x[:, :-2]) == pytest.approx(wanted, abs=SIGMAS * 2 / np.sqrt(n) + 5e-3)


def test_turning_moves_the_pattern_by_beams():
    """Over the seam of the circle too: nothing is drawn anew."""
    for yaw in (0.0, np.pi - 0.3 - 0.002):
        first = moved(0, yaw=yaw)
        for beams in (1, 5):
            turned = moved(0, yaw=yaw + np.radians(0.25) * beams)
            np.testing.assert_allclose(turned[:-beams], first[beams:], rtol=0, atol=2e-4)  # float32


def test_going_forward_moves_the_pattern_in_range():
    """Of the beam that looks ahead; at the half of a bin what it hears is of both sides."""
    ahead = moved(0)[31:33]
    forward = 3 * BIN_M * np.array([np.cos(0.3), np.sin(0.3)])
    assert alike(moved(0, *forward)[31:33, :-3], ahead[:, 3:]) > 0.999
    pulse = {"bandwidth_hz": 1500 / (4 * BIN_M), "pulse_taper": "hamming"}  # c/2B is 2 bins
    pairs = [(moved(s, *forward / 6, **pulse)[31:33], moved(s, **pulse)[31:33]) for s in range(30)]
    error = SIGMAS * 0.15 / np.sqrt(30 * 128)  # of a correlation of 0.94
    found = alike(*(np.array(part) for part in zip(*pairs, strict=True)))
    assert found == pytest.approx(hamming_correlation(0.25) ** 2, abs=error)


@pytest.mark.parametrize("share", [0.05, 0.15, 0.25])
def test_going_aside_slides_the_aperture(share):
    aside = share * LENGTH_M * np.array([-np.sin(0.3), np.cos(0.3)])
    pairs = [(moved(s, *aside)[31:33], moved(s)[31:33]) for s in range(40)]
    found = alike(*(np.array(part) for part in zip(*pairs, strict=True)))
    # the waves at the aperture's ends count in part: a third of one of 79 too much is alike
    assert found == pytest.approx(
        (1 - 2 * share) ** 2, abs=SIGMAS / np.sqrt(40 * 256) * (1 - found**2) + 0.01
    )


def test_nothing_pops_between_two_squares_of_the_sea():
    """Millimetres at a time across a border: each step is as alike as within a square."""
    ping = even_ping(where=pose(0, 0, 0, 0, 0, 0))
    noise = Noise(speckle=True, follow_motion=True)
    steps = [
        drawn(noise, replace(ping, pose=pose(x, 0.2, 0, 0, 0, 0)))[0] for x in np.arange(0.44, 0.5601, 0.004)
    ]
    within = [alike(a[:, :-1], b[:, :-1]) for a, b in pairwise(steps[:3])]
    assert min(alike(a, b) for a, b in pairwise(steps)) > min(within) - 0.05
    assert all(abs(step.mean() - 1) < SIGMAS / np.sqrt(256 * 14) for step in steps)
    assert alike(steps[0], steps[-1]) < 0.1  # each square has its own


@pytest.mark.parametrize(
    ("ping", "message"),
    [
        (
            even_ping(),
            "noise: the ping must have a pose for speckle that follows its motion (a Simulator's has)",
        ),
        (
            replace(even_ping(where=np.eye(4)), meta={}),
            "noise: the ping must have beam_width_deg in meta['sonar'] for speckle that follows its motion "
            "(a Simulator's has)",
        ),
    ],
)
def test_what_motion_needs(ping, message):
    with pytest.raises(Error) as caught:
        add_noise(ping, Noise(speckle=True, follow_motion=True), 0)
    assert str(caught.value) == message


# The receiver


def test_levels():
    assert thermal_noise_db(1e3) == -15 and thermal_noise_db(900e3) == pytest.approx(44.085, abs=1e-3)
    # twice the band, 3 dB; the source a dB louder, a dB less
    assert ambient_noise_db(900e3, 60e3, 206.0) - ambient_noise_db(900e3, 30e3, 205.0) == pytest.approx(
        2.0103, abs=1e-4
    )


@pytest.mark.parametrize("speckle", [True, False])
def test_noise_rises_with_the_tvg(speckle):
    acoustics = Acoustics.physical(tvg_k=30.0)
    ping = even_ping(200, 4000, 2.0, level=0.0, **acoustics.meta())
    x = drawn(Noise(speckle=speckle, electronic_db=-30.0, ambient_db=-30.0), ping)[0]
    r = ping.range_m
    wanted = 2e-3 * r**3 * 10 ** (2 * acoustics.absorption(900e3) * r / 10)
    assert wanted[-1] / wanted[0] > 1e7  # from 1 to 51 m
    share = x / wanted
    assert share.mean() == pytest.approx(1, abs=SIGMAS / np.sqrt(x.size))
    assert share.std() == pytest.approx(1, abs=SIGMAS * np.sqrt(2 / x.size))
    assert share[:, :400].mean() == pytest.approx(1, abs=SIGMAS / np.sqrt(200 * 400))


@pytest.mark.parametrize("law", ["constant", "printed", "inverse"])
def test_other_range_laws_have_no_tvg(law):
    ping = even_ping(200, 1000, 2.0, level=0.0, **Acoustics.physical(range_law=law).meta())
    x = drawn(Noise(electronic_db=-20.0), ping)[0]
    assert x[:, :500].mean() == pytest.approx(0.01, rel=SIGMAS / np.sqrt(1e5))
    assert x[:, 500:].mean() == pytest.approx(0.01, rel=SIGMAS / np.sqrt(1e5))


def test_echo_and_noise_add_as_fields():
    """Without speckle the amplitude is Rice's: of echo E and noise N, mean E + N, variance N^2 + 2 E N."""
    x = drawn(Noise(electronic_db=-10.0), even_ping(100, 4000, 2.0))[0]
    error = SIGMAS * np.sqrt(0.21 / x.size)
    assert x.mean() == pytest.approx(1.1, abs=error)
    assert x.var() == pytest.approx(0.21, rel=SIGMAS * np.sqrt(3 / x.size))
    speckled = drawn(Noise(speckle=True, electronic_db=-10.0), even_ping(100, 4000, 2.0))[0]
    assert speckled.mean() == pytest.approx(1.1, rel=SIGMAS / np.sqrt(x.size))
    assert speckled.std() == pytest.approx(1.1, rel=SIGMAS * np.sqrt(2 / x.size))


def test_noise_is_as_alike_as_beams_are():
    for noise in (Noise(electronic_db=0.0), Noise(speckle=True, follow_motion=True, electronic_db=0.0)):
        x = drawn(noise, even_ping(64, 4000, 0.5, np.eye(4), level=0.0))[0]
        assert alike(x[1:], x[:-1]) == pytest.approx(0.5, abs=SIGMAS * 2 / np.sqrt(x.size / 2))


def test_another_sonar():
    noise = Noise(interference_lines=3.0, interference_db=-20.0)
    ping = even_ping(64, 2000, 0.5, level=0.0)
    counts, brightest = [], []
    for number in range(100):
        x = add_noise(ping, noise, 0, number).intensity
        on = (x > 0).any(0)
        assert (x[:, on] >= 0.99 * 0.01 * 10**-3.5).all() and not x[:, ~on].any()  # all beams hear it
        counts.append(np.count_nonzero(on))
        brightest.extend(x.max(0)[on].tolist())
    # 100 us are 6 bins; two that meet count once, and those at the ends in part
    assert np.mean(counts) == pytest.approx(18, abs=SIGMAS * 6 * np.sqrt(3 / 100) + 0.2)
    # half a beam's spacing aside at most, that is -0.7 dB of a beam twice as wide
    assert np.median(brightest) == pytest.approx(0.01, rel=0.2) and min(brightest) > 0.008
    same = [add_noise(ping, noise, 5, 3).intensity.tobytes() for _ in range(2)]
    assert same[0] == same[1]


def test_loud_noise_stays_finite():
    ping = even_ping(16, 64, **Acoustics.physical(tvg_k=60.0, tvg_absorption_db_m=1e5).meta())
    for noise in (
        Noise(electronic_db=100.0),
        Noise(True, electronic_db=100.0, interference_lines=9, interference_db=100),
    ):
        x = add_noise(ping, noise, 0).intensity
        assert np.isfinite(x).all() and x.max() > 1e25
