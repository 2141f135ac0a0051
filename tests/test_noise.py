"""Statistics of each term of noise, its independence of the others, and the same bytes for the same seed."""

import hashlib
import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import sonar_gl
from sonar_gl.noise import STREAMS, Noise, add_noise, stream
from sonar_gl.normals import standard_normal
from sonar_gl.speckle import _beams_from_elements, _halves, multiply_by_speckle
from sonar_gl.types import Error, Ping

APERTURE = 0.885892941379  # −3 dB width of a uniform line array in λ/L, twice the x of sinc²(x) = 1/2

OVER = "dB over the echo of an all-round surface at 1 m"
NO_SPECKLE = "says how speckle is, and there is none (switch speckle on)"
SIGMAS = 5.0  # a tolerance of so many standard errors is missed by chance once in 1.7 million


def refused(make, *args, **kwargs) -> str:
    with pytest.raises(Error) as caught:
        make(*args, **kwargs)
    return str(caught.value)


def uniform_ping(n_beams=256, n_bins=1102, fov_deg=45.0, beam_width_deg=1.0, level=1.0) -> Ping:
    azimuth = np.radians(fov_deg * ((np.arange(n_beams) + 0.5) / n_beams - 0.5))
    meta = {} if beam_width_deg is None else {"sonar": {"beam_width_deg": beam_width_deg}}
    intensity = np.full((n_beams, n_bins), level, np.float32)
    return Ping(intensity, azimuth, 0.5 + 0.0254 * (np.arange(n_bins) + 0.5), meta=meta)


def speckle_field(azimuth_rad, n_bins, beam_width_rad, random) -> np.ndarray:
    out = np.ones((len(azimuth_rad), n_bins), np.float32)
    multiply_by_speckle(out, azimuth_rad, beam_width_rad, random)
    return out


def correlation(a, b) -> float:
    return float(np.corrcoef(a.ravel(), b.ravel())[0, 1])


def test_no_noise_is_the_same_ping():
    ping = uniform_ping()
    for noise in (None, Noise(), Noise.none(), Noise(cloud_gaussian_m=0.01)):
        assert add_noise(ping, noise, seed=0) is ping


def test_speckle_is_exponential():
    """Independent beams: n draws, so every tolerance is a known standard error."""
    ping = uniform_ping(256, 4000, beam_width_deg=None)
    out = add_noise(ping, Noise(speckle=True), seed=1).intensity.astype(np.float64)
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


@pytest.mark.parametrize(
    ("spacing_deg", "field", "intensity"),
    # sinc(0.8859 D / width) for a width of 1 degree: the numbers of a uniform line array
    [(0.18, 0.9587, 0.9191), (0.5, 0.7071, 0.5), (1.0 / 0.885893, 0.0, 0.0)],
)
def test_overlapping_beams_share_speckle(spacing_deg, field, intensity):
    # two fans of the same span: the beams that are compared lie 0.18, 0.5 or 1.13 degrees apart
    n_beams = 100
    azimuth = np.radians(spacing_deg / 4 * (np.arange(n_beams) - n_beams / 2))
    draws = speckle_field(azimuth, 20_000, np.radians(1.0), stream(3, 0, "speckle")).astype(np.float64)
    found = np.array([correlation(draws[b], draws[b + 4]) for b in range(0, n_beams - 4, 4)])
    # one bin gives one draw a beam, as many independent ones as the fan has beam widths
    n = 20_000 * max(1.0, n_beams * spacing_deg / 4 * 0.885893)
    # the finite sum of waves instead of the integral errs by (π t/M)²/6 of itself, below 4e-4
    error = SIGMAS * 2 * (1 - intensity**2 + 1e-9) / np.sqrt(n) + 4e-4
    assert found.mean() == pytest.approx(intensity, abs=error)
    assert intensity == pytest.approx(field**2, abs=1e-4)


@pytest.mark.parametrize("fov_deg", [10.0, 45.0, 130.0, 360.0])
def test_correlation_holds_across_the_whole_fan(fov_deg):
    """Every pair of beams, by the matrix behind the draws: near pairs as the array, far ones as strangers."""
    azimuth = uniform_ping(512, 1, fov_deg).azimuth_rad
    factor = _beams_from_elements(tuple(azimuth.tolist()), float(np.radians(1.0))).astype(np.float64)
    apart = np.abs(np.subtract.outer(azimuth, azimuth))
    apart = np.minimum(apart, 2 * np.pi - apart)  # a full circle closes
    expected = np.sinc(APERTURE * apart / np.radians(1.0))
    found = factor @ factor.T
    np.testing.assert_allclose(np.diag(found), 1, rtol=0, atol=1e-6)  # float32 rows of unit power
    # M waves replace the integral: sinc(t) errs by (π t/M)²/6 of itself, most with few waves (M = 21 at 10°)
    near = apart < np.radians(1.0)
    assert np.abs(found - expected)[near].max() < 1e-3
    assert np.abs(found**2 - expected**2).max() < 1.2e-3  # of the intensity's variance, all pairs


@pytest.mark.parametrize("n_beams", [2, 7, 64])
def test_mirrored_beams_are_sums_and_differences(n_beams):
    """Half the beams and their mirror images are all the beams; so they are where the fan looks aside."""
    for middle in (0.0, 0.4):
        azimuths = tuple((middle + np.radians(0.3) * (np.arange(n_beams) - (n_beams - 1) / 2)).tolist())
        whole = _beams_from_elements(azimuths, np.radians(1.0))
        sines, cosines = _halves(azimuths, np.radians(1.0))
        assert len(sines) == len(cosines) == (n_beams + 1) // 2
        assert sines.shape[1] + cosines.shape[1] == whole.shape[1]
        mirrored = np.column_stack([-sines, cosines])[::-1]
        both = np.concatenate([np.column_stack([sines, cosines]), mirrored[n_beams % 2 :]])
        np.testing.assert_allclose(both, whole, rtol=0, atol=1e-6)  # float32 of numbers below 1
    uneven = (-0.02, 0.0, 0.01)
    assert all(len(half) == 3 for half in _halves(uneven, np.radians(1.0)))


def test_the_field_is_that_of_the_matrix():
    """A fan with a mirror and one without; 8 bins are drawn at once."""
    even = np.linspace(-0.2, 0.2, 41)
    for azimuth in (even, even[:-1], even + 1e-3 * np.arange(41) ** 2):
        field = speckle_field(azimuth, 8, np.radians(2.0), stream(8, 0, "speckle"))
        factor = _beams_from_elements(tuple(azimuth.tolist()), np.radians(2.0))
        real, imaginary = np.split(
            factor @ standard_normal(stream(8, 0, "speckle"), (factor.shape[1], 16)), 2, 1
        )
        # float32 sums of some 40 numbers of about 0.2, in another order
        np.testing.assert_allclose(field, (real**2 + imaginary**2) / 2, rtol=1e-5, atol=1e-5)


def test_speckle_of_overlapping_beams_keeps_contrast():
    out = add_noise(uniform_ping(256, 4000), Noise(speckle=True), seed=2).intensity.astype(np.float64)
    n = 4000 * 45 * 0.885893  # independent cells: beam widths of the aperture, times bins
    assert out.mean() == pytest.approx(1, abs=SIGMAS / np.sqrt(n))
    assert out.std() == pytest.approx(1, abs=SIGMAS * np.sqrt(2 / n))
    assert (10 * np.log10(out)).std() == pytest.approx(5.57004, abs=SIGMAS * 5.57 * np.sqrt(1.1 / n))


def test_uneven_beams_and_one_beam():
    azimuth = np.radians([-10.0, -9.9, 0.0, 9.0])
    draws = speckle_field(azimuth, 50_000, np.radians(1.0), stream(0, 0, "speckle"))
    expected = np.sinc(0.885893 * 0.1) ** 2
    assert correlation(draws[0], draws[1]) == pytest.approx(expected, abs=5e-3)
    assert abs(correlation(draws[1], draws[2])) < SIGMAS / np.sqrt(50_000) + 1e-3
    assert speckle_field(azimuth[:1], 7, np.radians(1.0), stream(0, 0, "speckle")).shape == (1, 7)


def test_beams_side_by_side_are_independent():
    ping = uniform_ping(64, 10, 64.0, beam_width_deg=1.0)
    alone = uniform_ping(64, 10, 64.0, beam_width_deg=None)
    speckle = Noise(speckle=True)
    assert (add_noise(ping, speckle, 0).intensity == add_noise(alone, speckle, 0).intensity).all()


def test_speckle_leaves_silence_silent():
    assert (add_noise(uniform_ping(level=0.0), Noise(speckle=True), 0).intensity == 0).all()


def test_gaussian():
    ping = uniform_ping(level=0.5)
    added = add_noise(ping, Noise(gaussian=0.01), seed=1).intensity.astype(np.float64) - 0.5
    n = added.size
    assert added.mean() == pytest.approx(0, abs=SIGMAS * 0.01 / np.sqrt(n))
    assert added.std() == pytest.approx(0.01, abs=SIGMAS * 0.01 / np.sqrt(2 * n))
    silent = add_noise(uniform_ping(level=0.0), Noise(gaussian=0.01), seed=1).intensity
    assert silent.min() == 0
    assert (silent == 0).mean() == pytest.approx(0.5, abs=SIGMAS * 0.5 / np.sqrt(n))  # the clipped half


def test_salt_and_pepper():
    out = add_noise(uniform_ping(level=0.5), Noise(salt_and_pepper=0.1), seed=1).intensity
    assert set(np.unique(out)) == {0, 0.5, 1}
    for value in (0, 1):
        spread = np.sqrt(0.05 * 0.95 / out.size)
        assert (out == value).mean() == pytest.approx(0.05, abs=SIGMAS * spread)
    every = add_noise(uniform_ping(level=0.5), Noise(salt_and_pepper=1), seed=1).intensity
    assert set(np.unique(every)) == {0, 1}


@pytest.mark.parametrize("size", [3, 5])
def test_median(size):
    ping = uniform_ping(20, 30)
    speckled = add_noise(ping, Noise(speckle=True), 0).intensity
    out = add_noise(ping, Noise(speckle=True, median=size), 0).intensity
    half = size // 2
    assert out[10, 10] == np.median(speckled[10 - half : 11 + half, 10 - half : 11 + half])
    assert out.shape == (20, 30)


def test_median_comes_before_salt_and_pepper():
    """A median after it would undo it: the founding paper's order."""
    out = add_noise(uniform_ping(level=0.5), Noise(median=3, salt_and_pepper=0.005), seed=1).intensity
    assert (out != 0.5).mean() == pytest.approx(0.005, rel=0.2)  # 1410 bins, 5 sigma is 13 %


def test_terms_do_not_move_one_another():
    ping = uniform_ping(64, 100, level=2.0)
    both = add_noise(ping, Noise(speckle=True, gaussian=0.01), seed=5).intensity
    speckled = add_noise(ping, Noise(speckle=True), seed=5)
    assert (add_noise(speckled, Noise(gaussian=0.01), seed=5).intensity == both).all()
    pepper = Noise(salt_and_pepper=0.1)
    hit = add_noise(ping, pepper, seed=5).intensity != 2
    hit_too = np.isin(add_noise(ping, Noise(True, 0.01, 0.1), seed=5).intensity, [0, 1])
    assert (hit_too >= hit).all()
    # and the streams themselves differ
    first = {term: stream(5, 0, term).random() for term in STREAMS}
    assert len(set(first.values())) == 7


def test_streams_keep_their_numbers():
    """Bytes would change."""
    numbers = {"speckle": 1, "gaussian": 2, "salt_and_pepper": 3, "cloud": 4}
    assert numbers | {"texture": 5, "receiver": 6, "interference": 7} == STREAMS


def test_the_founding_papers_noise_keeps_its_bytes():
    """From before there were other terms."""
    ping = uniform_ping(64, 100)
    ping = replace(ping, intensity=np.random.default_rng(0).random((64, 100), np.float32))
    found = add_noise(ping, Noise.demarco2015(), seed=7, ping_number=3).intensity.tobytes()
    assert hashlib.sha256(found).hexdigest()[:16] == "9c649b4619528638"


def test_same_seed_same_bytes():
    noise = Noise(True, 0.01, 0.01, 3, 0.0, 0.7, 2, False, -20.0, -30.0, 3.0)
    ping = uniform_ping(64, 100)
    same = [add_noise(ping, noise, seed=9, ping_number=4).intensity.tobytes() for _ in range(3)]
    assert len(set(same)) == 1
    others = {
        add_noise(ping, noise, seed, number).intensity.tobytes() for seed in (9, 10) for number in (4, 5)
    }
    assert len(others) == 4 and same[0] in others


def test_same_bytes_whatever_the_threads():
    """BLAS takes as many threads as there are cores; no sum may depend on them."""
    code = (
        "import hashlib, sys, numpy as np; from sonar_gl.noise import Noise, add_noise; "
        "from sonar_gl.types import Ping; a = np.linspace(-0.4, 0.4, 512); "
        "p = Ping(np.ones((512, 700), np.float32), a, np.arange(700.0), "
        "meta={'sonar': {'beam_width_deg': 1.0}}); "
        "print(hashlib.sha256(add_noise(p, Noise.physical(), 3).intensity.tobytes()).hexdigest())"
    )
    found = set()
    for threads in ("1", "5"):
        more = {f"{name}_NUM_THREADS": threads for name in ("OPENBLAS", "OMP", "MKL")}
        surroundings = {**os.environ, "PYTHONPATH": str(Path(sonar_gl.__file__).parent.parent), **more}
        found.add(subprocess.check_output([sys.executable, "-c", code], env=surroundings, timeout=60))
    assert len(found) == 1


def test_large_seeds_do_not_run_into_ping_numbers():
    values = [
        stream(s, n, "speckle").random()
        for s, n in [(0, 1), (1 << 32, 0), (1 << 32, 1), (1, 0), (0, 1 << 32)]
    ]
    assert len(set(values)) == 5


def test_the_ping_itself_stays():
    ping = uniform_ping(8, 9)
    out = add_noise(ping, Noise.physical(), seed=np.int64(3), ping_number=2)
    assert (ping.intensity == 1).all() and "noise" not in ping.meta
    assert out.intensity.dtype == np.float32 and out.intensity.shape == (8, 9)
    assert not out.intensity.flags.writeable
    assert out.azimuth_rad is ping.azimuth_rad and out.range_m is ping.range_m
    record = json.loads(json.dumps(out.meta))
    assert (record["seed"], record["ping_number"]) == (3, 2)
    assert Noise(**record["noise"]) == Noise.physical()
    assert record["sonar"] == {"beam_width_deg": 1.0}


def test_read_only_and_transposed_input():
    ping = uniform_ping(8, 9)
    ping.intensity.setflags(write=False)
    turned = Ping(np.full((9, 8), 1, np.float32).T, ping.azimuth_rad, ping.range_m, meta=ping.meta)
    noise = Noise(True, 0.01, 0.1, 3)
    assert (add_noise(ping, noise, 0).intensity == add_noise(turned, noise, 0).intensity).all()


def test_profiles():
    assert Noise.none() == Noise()
    assert Noise.demarco2015() == Noise(median=3, salt_and_pepper=0.005, cloud_gaussian_m=0.01)
    assert Noise.physical() == Noise(speckle=True, electronic_db=-90.0)


@pytest.mark.parametrize(
    ("text", "noise"),
    [
        ("none", Noise()),
        ("physical", Noise.physical()),
        ("demarco2015", Noise.demarco2015()),
        ("gaussian=0.01,median=3", Noise(gaussian=0.01, median=3)),
        (" speckle , gaussian = 1e-3 ", Noise(speckle=True, gaussian=1e-3)),
        ("speckle=no", Noise()),
        ("physical,median=3.0", Noise(speckle=True, electronic_db=-90.0, median=3)),
        ("speckle,follow_motion,looks=4", Noise(speckle=True, follow_motion=True, looks=4)),
        ("speckle,speckle_shape=0.5,follow_motion=no", Noise(speckle=True, speckle_shape=0.5)),
        ("electronic_db=-85,ambient_db=-100", Noise(electronic_db=-85.0, ambient_db=-100.0)),
        ("physical,electronic_db=none,speckle_shape=none", Noise(speckle=True)),
        ("interference_lines=2,interference_db=-30", Noise(interference_lines=2, interference_db=-30)),
    ],
)
def test_parse(text, noise):
    assert Noise.parse(text) == noise


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("fysical", "noise 'fysical': unknown name (got 'fysical'; did you mean 'physical'?)"),
        (
            "gausian=1",
            "noise 'gausian=1': unknown name (got 'gausian'; did you mean 'gaussian' or 'cloud_gaussian_m'?)",
        ),
        (
            "median=3,none",
            "noise 'median=3,none': unknown name (got 'none'; known are ambient_db, cloud_gaussian_m, "
            "electronic_db, follow_motion, gaussian, interference_db, interference_lines, looks, median, "
            "salt_and_pepper, speckle, speckle_shape)",
        ),
        (
            "none=1",
            "noise 'none=1': unknown name (got 'none'; known are ambient_db, cloud_gaussian_m, "
            "electronic_db, follow_motion, gaussian, interference_db, interference_lines, looks, median, "
            "salt_and_pepper, speckle, speckle_shape)",
        ),
        ("gaussian=a", "noise 'gaussian=a': gaussian must be a number, as in gaussian=0 (got 'a')"),
        ("median", "noise 'median': median must be a number, as in median=0 (got no number)"),
        ("speckle=2", "noise 'speckle=2': speckle must be yes or no (got '2')"),
        ("median=3,median=5", "noise 'median=3,median=5': median must be given once"),
        ("median=4", "noise: median must be 0, 3 or 5 (got 4; 0 is none)"),
        ("median=3.5", "noise: median must be 0, 3 or 5 (got 3.5; 0 is none)"),
        ("gaussian=-1", "noise: gaussian must lie in 0..1 (got -1; a fraction of full scale)"),
        ("gaussian=nan", "noise: gaussian must lie in 0..1 (got nan; a fraction of full scale)"),
        ("salt_and_pepper=5", "noise: salt_and_pepper must lie in 0..1 (got 5; a fraction of the bins)"),
        ("cloud_gaussian_m=20", "noise: cloud_gaussian_m must lie in 0..10 (got 20; give metres)"),
    ],
)
def test_wrong_text(text, message):
    assert refused(Noise.parse, text) == message


def test_empty_text_names_what_there_is():
    assert refused(Noise.parse, "") == (
        "noise '': unknown name (got ''; known are ambient_db, cloud_gaussian_m, demarco2015, electronic_db, "
        "follow_motion, gaussian, interference_db, interference_lines, looks, median, none, physical, "
        "salt_and_pepper, speckle, speckle_shape)"
    )


@pytest.mark.parametrize(
    ("amounts", "message"),
    [
        ({"speckle": 0.5}, "noise: speckle must be True or False (got 0.5)"),
        ({"follow_motion": 1}, "noise: follow_motion must be True or False (got 1)"),
        (
            {"speckle_shape": 0},
            "noise: speckle_shape must lie in 0.05..10000 (got 0; below 1 is spiky, None is fully developed)",
        ),
        ({"speckle_shape": "K"}, "noise: speckle_shape must be a number (got 'K')"),
        ({"looks": 0}, "noise: looks must be a whole number in 1..1000 (got 0)"),
        ({"looks": 2.0}, "noise: looks must be a whole number in 1..1000 (got 2.0)"),
        ({"looks": 2}, f"noise: looks {NO_SPECKLE}"),
        (
            {"follow_motion": True},
            "noise: follow_motion says how speckle is, and there is none (switch speckle on)",
        ),
        (
            {"electronic_db": np.nan},
            f"noise: electronic_db must lie in -300..100 (got nan; {OVER})",
        ),
        (
            {"ambient_db": 101},
            f"noise: ambient_db must lie in -300..100 (got 101; {OVER})",
        ),
        (
            {"interference_lines": -1},
            "noise: interference_lines must lie in 0..1000 (got -1; a mean number in a ping)",
        ),
        ({"interference_db": None}, "noise: interference_db must be a number (got None)"),
        ({"gaussian": True}, "noise: gaussian must be a number (got True)"),
        ({"gaussian": "a"}, "noise: gaussian must be a number (got 'a')"),
        ({"median": True}, "noise: median must be 0, 3 or 5 (got True; 0 is none)"),
        ({"median": [3]}, "noise: median must be 0, 3 or 5 (got [3]; 0 is none)"),
    ],
)
def test_wrong_amount(amounts, message):
    assert refused(Noise, **amounts) == message


@pytest.mark.parametrize("seed", [-1, 1.0, None, "0", True])
def test_wrong_seed(seed):
    message = f"seed must be a whole number, 0 or more (got {seed!r})"
    for noise in (Noise(), Noise.physical()):  # told even where nothing is drawn
        assert refused(add_noise, uniform_ping(2, 2), noise, seed) == message


def test_wrong_ping_number():
    message = "ping_number must be a whole number, 0 or more (got -1)"
    assert refused(add_noise, uniform_ping(2, 2), Noise(), 0, -1) == message
