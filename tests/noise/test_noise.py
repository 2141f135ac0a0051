"""Amounts of noise, and the chain of terms: each acts by itself, and the same seed gives the same bytes."""

import hashlib
import json
from dataclasses import fields, replace

import numpy as np
import pytest
from threadpoolctl import threadpool_limits

import sonar_gl
from sonar_gl.noise.noise import add_noise
from sonar_gl.noise.settings import PRESETS, Noise
from tests.support.errors import error_of
from tests.support.even_ping import SIGMAS, correlation, even_ping
from tests.support.processes import python
from tests.support.threads import counting_thread

HERE = sonar_gl.pose(0.2, 0.2)
LEVEL = "give dB relative to the echo of a sphere about the sonar, at 1 m"
NAMES = sorted(field.name for field in fields(Noise))
ALL_TERMS = Noise(True, 0.01, 0.01, 3, 0.0, 2, False, True, -30.0, 3.0)


def noisy(noise, ping=None, seed=1, ping_number=0) -> np.ndarray:
    """Return the (B, K) float32 intensity of a ping with noise."""
    return add_noise(ping or even_ping(256, 1102), noise, seed, ping_number).intensity


def test_an_absolute_level_of_ambient_noise_is_warned_of():
    with pytest.warns(UserWarning) as caught:
        Noise(ambient_db=88.0)
    assert [str(one.message) for one in caught] == [
        "noise: ambient_db = 88 exceeds the echo of a sphere about the sonar at 1 m, to which it is relative; if it is "
        "in dB re 1 µPa, subtract that echo's level (absolute_levels states it)"
    ]
    assert [one.filename for one in caught] == [__file__]


# --- terms


@pytest.mark.parametrize("noise", [None, Noise(), Noise.none(), Noise(cloud_gaussian_m=0.01)])
def test_no_noise_returns_the_ping(noise):
    ping = even_ping()
    assert add_noise(ping, noise, seed=0) is ping


FIELD_TERMS = {"speckle": True, "self_noise": True, "ambient_db": -30.0, "thermal_noise": True}
FIELD_TERMS |= {"interference_lines": 2.0}
BIN_TERMS = {"gaussian": 0.01, "salt_and_pepper": 0.01, "median": 3, "dropped_beams": 0.1}
MODIFIERS = {"cloud_gaussian_m", "looks", "follow_motion", "interference_db"}  # nothing without another term


def test_each_term_acts_on_the_field_or_on_the_bins():
    """A term that were in neither would be left out of pings without another one."""
    listed = {*FIELD_TERMS, *BIN_TERMS, *MODIFIERS}
    assert {field.name for field in fields(Noise)} == listed, (
        "name a new field in FIELD_TERMS, BIN_TERMS or MODIFIERS here; docs/architecture.md has the other steps"
    )
    for name, amount in (FIELD_TERMS | BIN_TERMS).items():
        noise = Noise(**{name: amount})
        assert (noise.acts_on_field, noise.acts_on_bins) == (name in FIELD_TERMS, name in BIN_TERMS)


def test_gaussian():
    added = noisy(Noise(gaussian=0.01), even_ping(256, 1102, level=0.5)).astype(np.float64) - 0.5
    n = added.size
    assert added.mean() == pytest.approx(0, abs=SIGMAS * 0.01 / np.sqrt(n))
    assert added.std() == pytest.approx(0.01, abs=SIGMAS * 0.01 / np.sqrt(2 * n))


def test_gaussian_is_clipped_at_0():
    out = noisy(Noise(gaussian=0.01), even_ping(256, 1102, level=0.0))
    assert out.min() == 0
    assert (out == 0).mean() == pytest.approx(0.5, abs=SIGMAS * 0.5 / np.sqrt(out.size))


def test_salt_and_pepper():
    out = noisy(Noise(salt_and_pepper=0.1), even_ping(256, 1102, level=0.5))
    assert set(np.unique(out)) == {0, 0.5, 1}
    for value in (0, 1):
        error = SIGMAS * np.sqrt(0.05 * 0.95 / out.size)
        assert (out == value).mean() == pytest.approx(0.05, abs=error)
    assert set(np.unique(noisy(Noise(salt_and_pepper=1), even_ping(level=0.5)))) == {0, 1}


@pytest.mark.parametrize("size", [3, 5])
def test_median(size):
    ping, half = even_ping(20, 30), size // 2
    speckle = noisy(Noise(speckle=True), ping)
    out = noisy(Noise(speckle=True, median=size), ping)
    assert out.shape == (20, 30)
    for b, k in ((10, 10), (half, half), (19 - half, 29 - half)):
        assert out[b, k] == np.median(speckle[b - half : b + half + 1, k - half : k + half + 1])


def test_salt_and_pepper_come_after_the_median():
    """The founding paper's order; a median filter would remove them."""
    out = noisy(Noise(median=3, salt_and_pepper=0.005), even_ping(256, 1102, level=0.5))
    assert (out != 0.5).mean() == pytest.approx(0.005, rel=0.2)  # 1410 bins; 5 sigma is 13 %


def test_a_term_leaves_the_numbers_of_others():
    ping = even_ping(level=2.0)
    both = noisy(Noise(speckle=True, gaussian=0.01), ping, 5)
    speckle = add_noise(ping, Noise(speckle=True), 5)
    assert (noisy(Noise(gaussian=0.01), speckle, 5) == both).all()
    hit = noisy(Noise(salt_and_pepper=0.1), ping, 5) != 2
    hit_beside_others = np.isin(noisy(Noise(True, 0.01, 0.1), ping, 5), [0, 1])
    assert hit.any() and hit_beside_others[hit].all()


@pytest.mark.parametrize("follow_motion", [True, False])
def test_only_place_locked_speckle_leaves_the_numbers_of_receiver_noise(follow_motion):
    dark = even_ping(level=0.0, pose=HERE)
    both = noisy(Noise(speckle=True, follow_motion=follow_motion, ambient_db=-30.0), dark, 5)
    alone = noisy(Noise(ambient_db=-30.0), dark, 5)
    if follow_motion:
        np.testing.assert_allclose(both, alone, rtol=1e-6)  # float32
    else:  # one field for both
        assert abs(correlation(both, alone)) < 0.2


# --- seeds and bytes


def test_founding_papers_noise_never_changes():
    ping = replace(even_ping(64, 100), intensity=np.random.default_rng(0).random((64, 100), np.float32))
    found = noisy(Noise.demarco2015(), ping, 7, 3).tobytes()
    assert hashlib.sha256(found).hexdigest()[:16] == "9c649b4619528638"


def test_same_seed_same_bytes():
    ping = even_ping(64, 100)
    first, second, third = (noisy(ALL_TERMS, ping, 9, 4).tobytes() for _ in range(3))
    assert first == second == third


def test_seeds_and_ping_numbers_differ():
    ping = even_ping(64, 100)
    pings = {noisy(ALL_TERMS, ping, seed, number).tobytes() for seed in (9, 10) for number in (4, 5)}
    assert len(pings) == 4


@pytest.mark.slow
def test_same_bytes_for_any_number_of_threads(capsys):
    """BLAS starts a thread per core; no sum may depend on their number: one here, five in another process."""
    code = (
        "import hashlib; import numpy as np; from sonar_gl.noise.noise import add_noise; "
        "from sonar_gl.noise.settings import Noise; "
        "from tests.support.even_ping import even_ping; "
        "ping = even_ping(512, 700, 0.09, pose=np.eye(4)); "
        "amounts = [Noise(speckle=True, follow_motion=locked, ambient_db=-90.0) for locked in (False, True)]; "
        "print(*[hashlib.sha256(add_noise(ping, one, 3).intensity.tobytes()).hexdigest() for one in amounts])"
    )
    with threadpool_limits(1):
        exec(code, {})
    one = capsys.readouterr().out
    settings = {f"{name}_NUM_THREADS": "5" for name in ("OPENBLAS", "OMP", "MKL")}
    assert python("-c", code, environment=settings, check=True).stdout == one != ""


@pytest.mark.parametrize(
    ("amounts", "spacing_deg", "where", "jobs"),
    [
        ({}, 0.25, HERE, 3),  # speckle and receiver noise, the waves of speckle, the look
        ({"ambient_db": None}, 0.25, HERE, 2),
        ({}, 0.25, sonar_gl.pose(0.25, 0.26, yaw=0.3), 6),  # in the middle of four cells of the sea
        ({}, 0.9, HERE, 3),  # no nodes
        ({"looks": 2}, 0.25, HERE, 6),
        ({"follow_motion": False}, 0.25, HERE, 1),
    ],
)
@pytest.mark.parametrize("pulse", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_a_second_thread_gives_the_same_bytes(amounts, spacing_deg, where, jobs, pulse):
    noise = Noise(**{"speckle": True, "follow_motion": True, "ambient_db": -60.0} | amounts)
    ping = even_ping(151, 701, spacing_deg, pose=where, pulse=pulse, bandwidth_hz=40e3)
    ping = replace(ping, coherent=ping.intensity / 3)

    def made_anew(thread=None):
        for x in (8.0, 9.0):  # two fields are remembered
            add_noise(replace(ping, pose=sonar_gl.pose(x)), noise, 3, 2)
        return add_noise(ping, noise, 3, 2, thread).intensity

    with counting_thread() as thread:
        beside = made_anew(thread)
        assert thread.n_jobs == jobs
    np.testing.assert_array_equal(beside, made_anew())


# --- the ping


def test_the_ping_itself_stays():
    ping = even_ping(8, 9, pose=HERE)
    out = add_noise(ping, Noise.physical(), seed=np.int64(3), ping_number=2)
    assert (ping.intensity == 1).all() and "noise" not in ping.meta
    assert out.intensity.dtype == np.float32 and out.intensity.shape == (8, 9)
    assert not out.intensity.flags.writeable
    for name in ("azimuth_rad", "range_m", "sonar", "acoustics"):
        assert getattr(out, name) is getattr(ping, name)


def test_meta_records_the_noise():
    record = json.loads(
        json.dumps(add_noise(even_ping(8, 9, pose=HERE), Noise.physical(), np.int64(3), 2).meta)
    )
    assert (record["seed"], record["ping_number"]) == (3, 2)
    assert Noise(**record["noise"]) == Noise.physical()


def test_read_only_and_transposed_arrays():
    ping = even_ping(8, 9)
    ping.intensity.setflags(write=False)
    transposed = replace(ping, intensity=np.ones((9, 8), np.float32).T)
    noise = Noise(True, 0.01, 0.1, 3)
    assert (noisy(noise, ping) == noisy(noise, transposed)).all()


# --- amounts


def test_profiles():
    assert Noise.none() == Noise()
    assert Noise.demarco2015() == Noise(median=3, salt_and_pepper=0.005, cloud_gaussian_m=0.01)
    assert Noise.physical() == Noise(speckle=True, follow_motion=True, self_noise=True)
    without = Noise.physical(speckle=False, ambient_db=-60.0)
    assert without == Noise(follow_motion=True, self_noise=True, ambient_db=-60.0)


@pytest.mark.parametrize(
    ("text", "noise"),
    [
        ("none", Noise()),
        ("physical", Noise.physical()),
        ("demarco2015", Noise.demarco2015()),
        ("gaussian=0.01,median=3", Noise(gaussian=0.01, median=3)),
        (" speckle , gaussian = 1e-3 ", Noise(speckle=True, gaussian=1e-3)),
        ("speckle=no", Noise()),
        ("physical,median=3.0", replace(Noise.physical(), median=3)),
        ("physical,speckle=no", Noise(follow_motion=True, self_noise=True)),
        ("speckle,follow_motion,looks=4", Noise(speckle=True, follow_motion=True, looks=4)),
        ("speckle,looks=2,follow_motion=no", Noise(speckle=True, looks=2)),
        ("self_noise,ambient_db=-100", Noise(self_noise=True, ambient_db=-100.0)),
        ("physical,self_noise=off,ambient_db=none", Noise(speckle=True, follow_motion=True)),
        ("interference_lines=2,interference_db=-30", Noise(interference_lines=2, interference_db=-30)),
    ],
)
def test_parse(text, noise):
    assert Noise.parse(text) == noise


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("foo", "noise 'foo': unknown name (got 'foo'; known are " + ", ".join(sorted([*NAMES, *PRESETS]))),
        ("fysical", "noise 'fysical': unknown name (got 'fysical'; did you mean 'physical'?)"),
        ("gausian=1", "noise 'gausian=1': unknown name (got 'gausian';"),
        ("median=3,none", f"noise 'median=3,none': unknown name (got 'none'; known are {', '.join(NAMES)})"),
        ("none=1", f"noise 'none=1': unknown name (got 'none'; known are {', '.join(NAMES)})"),
        ("gaussian=a", "noise 'gaussian=a': gaussian must be a number (got 'a')"),
        ("median", "noise 'median': median must have a value, as in median=... (got none)"),
        ("physical,electronic_db=-50", "noise 'physical,electronic_db=-50':"),
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
def test_wrong_text(text, expected):
    assert error_of(Noise.parse, text).startswith(expected)


def test_empty_text_names_all_choices():
    choices = ", ".join(sorted({*NAMES, *PRESETS}))
    assert error_of(Noise.parse, "") == f"noise '': unknown name (got ''; known are {choices})"


@pytest.mark.parametrize(
    ("amounts", "expected"),
    [
        ({"speckle": 0.5}, "speckle must be True or False (got 0.5)"),
        ({"follow_motion": 1}, "follow_motion must be True or False (got 1)"),
        ({"speckle_shape": 2.0}, "speckle_shape describes a surface, and is a field of Body now"),
        ({"looks": 0}, "looks must be a whole number in 1..1000 (got 0)"),
        ({"looks": 2.0}, "looks must be a whole number in 1..1000 (got 2.0)"),
        ({"looks": 2}, "looks needs speckle (got 2 without it; switch speckle on)"),
        ({"ambient_db": np.nan}, f"ambient_db must lie in -300..100 (got nan; {LEVEL})"),
        ({"ambient_db": 101}, f"ambient_db must lie in -300..100 (got 101; {LEVEL})"),
        ({"interference_lines": -1}, "interference_lines must lie in 0..1000 (got -1;"),
        ({"interference_db": None}, "interference_db must be a number (got None)"),
        ({"gaussian": True}, "gaussian must be a number (got True)"),
        ({"gaussian": "a"}, "gaussian must be a number (got 'a')"),
        ({"median": True}, "median must be 0, 3 or 5 (got True; 0 is none)"),
        ({"median": [3]}, "median must be 0, 3 or 5 (got [3]; 0 is none)"),
    ],
)
def test_wrong_amount(amounts, expected):
    assert error_of(Noise, **amounts).startswith(f"noise: {expected}")


@pytest.mark.parametrize("seed", [-1, 1.0, None, "0", True])
@pytest.mark.parametrize("noise", [None, Noise.physical()])  # checked even if no term is random
def test_wrong_seed(seed, noise):
    expected = f"must be a whole number, 0 or more (got {seed!r})"
    assert error_of(add_noise, even_ping(2, 2), noise, seed) == f"seed {expected}"
    assert error_of(add_noise, even_ping(2, 2), noise, 0, seed) == f"ping_number {expected}"
