"""Counts: the laws against closed forms, gains, clipping, rounding, and the laws of the presets."""

import math
from dataclasses import asdict, replace

import numpy as np
import pytest

from sonar_gl.core.errors import Error
from sonar_gl.ping import Ping
from sonar_gl.sonar import counts as module
from sonar_gl.sonar.counts import Counts
from sonar_gl.sonar.sonar_files import load_sonar, presets
from tests.support.errors import error_of

LAWS = [
    Counts(),
    Counts(low_db=-40, high_db=-5, gain_db=12, bits=16),
    Counts("power"),
    Counts("power", exponent=1.0, gain_db=-7.5),
    Counts("power", exponent=0.5, gain_db=30, bits=16),
]
by_law = pytest.mark.parametrize("law", LAWS, ids=lambda law: f"{law.law}-{law.bits}-{law.exponent:g}")


def speckle(shape, mean=1.0, seed=0):
    return np.random.default_rng(seed).exponential(mean, shape).astype(np.float32)


def expected(law, intensity):
    """Counts by the definition, not rounded, float64."""
    received = intensity.astype(np.float64) * 10 ** (law.gain_db / 10)
    if law.law == "power":
        share = received**law.exponent
    else:
        share = (10 * np.log10(np.maximum(received, 1e-300)) - law.low_db) / (law.high_db - law.low_db)
    return share.clip(0, 1) * law.full_scale


@by_law
def test_counts_are_those_of_the_definition_to_half_a_count(law):
    intensity = np.concatenate([[0.0], np.logspace(-12, 6, 4000)]).astype(np.float32)
    found = law.apply(intensity)
    assert found.dtype == (np.uint8 if law.bits == 8 else np.uint16) and found.shape == intensity.shape
    assert found[0] == 0 and found[-1] == law.full_scale  # clipped
    assert (np.diff(found.astype(int)) >= 0).all()
    np.testing.assert_allclose(found, expected(law, intensity), atol=0.5 + 0.02, rtol=0)


@by_law
def test_the_inverse_gives_the_counts_again(law):
    counts = np.arange(law.full_scale + 1)
    intensity = law.intensity_of(counts)
    assert intensity.dtype == np.float32 and (np.diff(intensity) >= 0).all()
    np.testing.assert_array_equal(law.apply(intensity), counts)
    between = speckle(5000, 0.01)
    clipped = law.apply(between) % law.full_scale == 0
    low, high = (law.intensity_of(law.apply(between) + half) for half in (-0.51, 0.51))
    assert ((low <= between) & (between <= high))[~clipped].all()


def test_speckle_by_the_law_of_an_oculus():
    """Counts of an exponential variate to the power p: a Weibull variate of shape 1/p, whose moments are Γ(1 + np)."""
    law = Counts("power", gain_db=-15, bits=16)
    one, two, three = (math.gamma(1 + n * law.exponent) for n in (1, 2, 3))
    std = math.sqrt(two - one**2)
    skewness = (three - 3 * one * two + 2 * one**3) / std**3
    assert one / std == pytest.approx(3.440, abs=1e-3) and skewness == pytest.approx(-0.0553, abs=1e-3)
    found = law.apply(speckle((1000, 1000))).astype(float)
    deviation = found - found.mean()
    assert found.mean() / found.std() == pytest.approx(one / std, rel=0.005)
    assert (deviation**3).mean() / found.std() ** 3 == pytest.approx(skewness, abs=0.01)


@pytest.mark.parametrize("law", [Counts("power"), Counts(low_db=-50, high_db=-3)], ids=["power", "db"])
@pytest.mark.parametrize("shape", [(256, 1161), (512, 1960), (16, 10), (1, 1)])
def test_automatic_gain_brings_a_percentile_to_full_scale(law, shape):
    intensity = speckle(shape, 1e-5)
    found = replace(law, gain_percentile=98).settle(intensity)
    assert found.gain_percentile is None and replace(found, gain_db=0.0) == law
    full_db = 0.0 if law.law == "power" else -3.0
    level_db = 10 * np.log10(np.percentile(intensity, 98))
    assert found.gain_db == pytest.approx(full_db - level_db, abs=1e-4)
    assert (replace(law, gain_percentile=98).apply(intensity) == found.apply(intensity)).all()
    assert found.settle(intensity) is found


def test_automatic_gain_counts_bins_with_echo_alone():
    intensity = np.zeros((64, 500), np.float32)
    law = Counts("power", gain_percentile=50)
    assert law.settle(intensity).gain_db == 0 and not law.apply(intensity).any()
    intensity[:, :100] = 1e-3
    assert law.settle(intensity).gain_db == pytest.approx(30, abs=1e-4)


@pytest.mark.parametrize("percentile", [0, 1, 50, 99, 99.9, 100])
def test_automatic_gain_is_exact_whatever_bins_are_bright(monkeypatch, percentile):
    """A film flickers where a part of the bins tells the level: bright bodies fill about one bin in a hundred."""
    monkeypatch.setattr(module, "PERCENTILE_BINS", 1000)
    ramp = np.tile(np.arange(1, 1001, dtype=np.float32) / 1000, (100, 1))
    bodies = speckle((100, 1000), 1e-5)
    bodies[:, 300:310] *= 1e4  # an arc across the fan, which ends near the percentile
    few = np.where(np.arange(100_000).reshape(100, 1000) % 101 == 50, bodies, 0)  # where the sample has none
    for intensity in (ramp, bodies, few, bodies.astype(np.float64)):
        found = Counts("power", gain_percentile=percentile).settle(intensity)
        wanted = np.percentile(intensity[intensity > 0].astype(np.float64), percentile)
        assert 10 ** (-found.gain_db / 10) == pytest.approx(wanted, rel=1e-6)


def test_no_echo_has_the_count_zero_in_the_narrowest_window():
    """As a sum of float32 the lower end is off by 5e-6 of a logarithm, which is 8 of 65 535 counts over 0.6 dB."""
    for low_db in np.linspace(-170, 100, 100):
        law = Counts(low_db=float(low_db), high_db=float(low_db) + 0.6, bits=16)
        low = np.float32(10 ** (low_db / 10))
        assert law.apply(np.array([0.0, low / 2, 3e38], np.float32)).tolist() == [0, 0, 65535]
        assert (
            law.share(np.array([low], np.float32))[0] < 2e-6 / 0.6
        )  # float32 of the level itself and of the factor


def test_negative_and_huge_intensities_are_clipped():
    intensity = np.array([[-1.0, 1e38, np.inf]], np.float32)
    for law in LAWS:
        with np.errstate(all="raise"):
            assert law.apply(intensity).tolist() == [[0, law.full_scale, law.full_scale]]


@by_law
def test_what_is_unknown_is_black(law):
    with np.errstate(all="raise"):
        share = law.share(np.array([np.nan, 1.0, np.nan], np.float32))
        assert share.tolist() == law.share(np.array([0.0, 1.0, 0.0], np.float32)).tolist()
        assert law.counts_of(share)[0] == law.apply(np.full((1, 20), np.nan)).max() == 0


def test_an_array_in_any_order():
    intensity = speckle((30, 40), 0.1)
    for law in LAWS:
        assert (law.apply(intensity.T[::-1, ::2]) == law.apply(intensity).T[::-1, ::2]).all()


@pytest.mark.parametrize("law", [*LAWS, Counts(gain_percentile=99), Counts("power", gain_percentile=50)])
def test_intensities_as_a_list_or_of_another_type(law):
    whole = [[0, 1], [2, 3]]
    expected = law.apply(np.array(whole, np.float64))
    for same in (
        whole,
        tuple(map(tuple, whole)),
        np.array(whole),
        np.array(whole, np.uint8),
        np.array(whole, "f4"),
    ):
        assert (law.apply(same) == expected).all()
    bits = np.array([True, False])
    assert (law.apply(bits) == law.apply(bits.astype(float))).all()
    for wrong, shown in (("x", "'x'"), (None, "None"), (0.5, "0.5"), (np.array([1j]), "array([0.+1.j])")):
        assert error_of(law.apply, wrong) == f"intensity must be an array of real numbers (got {shown})"


def test_infinite_intensities_have_no_automatic_gain():
    with pytest.raises(Error, match=r"^automatic gain needs finite intensities \(got infinity\)$"):
        Counts(gain_percentile=99).apply(np.array([[1.0, np.inf]]))


def test_counts_that_are_no_numbers_have_no_intensity():
    assert Counts("power", exponent=1).intensity_of(255) == 1.0
    for wrong in ("x", None):
        with pytest.raises(Error, match=r"^counts must be real numbers \(got "):
            Counts().intensity_of(wrong)


def test_a_ping_has_the_counts_of_its_sonar():
    sonar = load_sonar("oculus-m1200d-hf")
    ping = Ping(speckle((8, 50), 1e-4), np.linspace(-0.1, 0.1, 8), np.arange(50) + 0.5)
    assert (ping.counts() == Counts().apply(ping.intensity)).all()
    ping = replace(ping, sonar=sonar)
    assert (ping.counts() == sonar.counts.apply(ping.intensity)).all() and ping.counts().max() == 255
    assert (ping.counts(Counts(bits=16)) == Counts(bits=16).apply(ping.intensity)).all()
    assert ping.counts_law() == sonar.counts.settle(ping.intensity)
    with pytest.raises(Error, match=r"counts must be a Counts \(got str"):
        ping.counts("db")


def test_presets_use_the_whole_range_of_8_bits():
    for name, sonar in presets().items():
        by_db, what = name.startswith(("aris", "didson")), f"{name}: name a device of other counts here"
        assert (sonar.counts.law, sonar.counts.bits) == ("db" if by_db else "power", 8), what
        assert sonar.counts.gain_percentile and (by_db or sonar.counts.exponent == 0.26), what


@pytest.mark.parametrize("inline", [True, False])
def test_a_file_states_counts(tmp_path, inline):
    keys = (
        "frequency_hz = 900e3\nn_beams = 4\nn_bins = 8\nazimuth_fov_deg = 40\nelevation_fov_deg = 20\n"
        "beam_width_deg = 1\nrange_min_m = 0.5\nrange_max_m = 8\n"
    )
    path = tmp_path / "mine.toml"
    path.write_text(keys)
    assert load_sonar(path).counts == Counts()
    law = 'counts = { law = "power", gain_percentile = 95 }\n'
    path.write_text(keys + (law if inline else '[counts]\nlaw = "power"\ngain_percentile = 95\n'))
    assert load_sonar(path).counts == Counts("power", gain_percentile=95)
    path.write_text(f"[one]\n{keys}{law}[two]\n{keys}")
    assert load_sonar(f"{path}#one").counts.law == "power" and load_sonar(f"{path}#two").counts.law == "db"
    for wrong, message in (
        ("counts = 8", "must be a table such as"),
        ("counts = { low = -50 }", "unknown key (got 'low'; did you mean 'low_db'"),
        ("counts = { exponent = 0.3 }", "exponent needs the law 'power' (got the law 'db')"),
        ('counts = { law = "db", exponent = 0.3 }', "exponent needs the law 'power' (got the law 'db')"),
    ):
        path.write_text(keys + wrong)
        with pytest.raises(Error) as caught:
            load_sonar(path)
        assert str(caught.value).startswith(f"{path} [mine]: sonar 'mine': counts") and message in str(
            caught.value
        )


def test_changes_keep_the_rest():
    law = Counts("power", exponent=0.3, gain_percentile=99)
    assert law.changed({"bits": 16}) == replace(law, bits=16)
    assert law.changed({"gain_db": 20}) == Counts("power", exponent=0.3, gain_db=20)
    assert law.changed({"gain_percentile": 50}).gain_percentile == 50
    assert Counts(gain_db=3).changed({"gain_percentile": 50}) == Counts(gain_percentile=50)
    assert law.changed({"law": "db", "low_db": -40}) == replace(law, law="db", low_db=-40)
    assert law.changed(asdict(law)) == law
    for values in ({"low_db": -40}, {"law": "power", "low_db": -40}):
        with pytest.raises(Error, match="low_db needs the law 'db' \\(got the law 'power'"):
            law.changed(values)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"law": "log"}, "counts: unknown law (got 'log'; known are db, power)"),
        ({"exponent": 0}, "counts: exponent must lie in 0.01..2 (got 0)"),
        ({"low_db": -1000}, "counts: low_db must lie in -180..180 (got -1000; give dB)"),
        ({"low_db": "x"}, "counts: low_db must be a number (got 'x')"),
        ({"high_db": -60}, "counts: low_db must be less than high_db (got -60 and -60)"),
        ({"gain_percentile": 101}, "counts: gain_percentile must lie in 0..100 (got 101)"),
        ({"gain_db": 3, "gain_percentile": 99}, "counts: gain_db and gain_percentile exclude each other"),
        (
            {"bits": 12},
            "counts: bits must be 8 or 16 (got 12; take 16, and shift its counts right by 4 bits)",
        ),
        ({"bits": 8.0}, "counts: bits must be 8 or 16 (got 8.0)"),
    ],
)
def test_invalid_fields(fields, message):
    assert error_of(Counts, **fields).startswith(message)


def test_automatic_gain_has_no_inverse():
    with pytest.raises(Error, match="intensity_of needs a fixed gain \\(got gain_percentile = 99"):
        Counts(gain_percentile=99).intensity_of([3])


@pytest.mark.parametrize(("level", "gain_db"), [(1e-25, 180.0), (1e25, -180.0)])
def test_automatic_gain_has_the_bounds_of_a_fixed_one(level, gain_db):
    law = Counts("power", gain_percentile=50)
    assert law.settle(np.full((4, 4), level, np.float32)).gain_db == gain_db


def test_what_is_shown_is_above_0_whatever_the_exponent():
    """A level in dB is made of it; 1/32 to the power of 100 is 0 as float32."""
    assert Counts("power", exponent=0.01).least_shown(np.ones((1, 1))) == np.finfo(np.float32).tiny


def test_no_automatic_gain_leaves_a_fixed_one_as_it_is():
    assert Counts(gain_db=20.0).changed({"gain_percentile": None}) == Counts(gain_db=20.0)
    assert Counts(gain_percentile=99.0).changed({"gain_percentile": None}) == Counts()
