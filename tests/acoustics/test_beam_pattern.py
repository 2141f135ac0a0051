"""Beam patterns against published numbers, and pings with them against the reference."""

import math
from dataclasses import replace

import numpy as np
import pytest
import trimesh

import sonar_gl as sg
from sonar_gl.acoustics.beam_pattern import (
    ArrayPattern,
    aperture_pattern,
    chebyshev_pattern,
    gaussian_pattern,
    line_array_pattern,
    main_lobe_edge,
    taper_series,
)
from sonar_gl.analysis.verify import ping_error
from sonar_gl.core.warn import collected_warnings
from sonar_gl.sonar.sonar import TAPERS
from tests.support.settings import described

pytestmark = pytest.mark.usefixtures("few_first_rays")


@pytest.mark.slow
def test_nulls_and_side_lobes_of_an_untapered_array():
    """First null, first side lobe and width in λ/L have their textbook values."""
    half_power = main_lobe_edge((), 0.5)
    assert half_power == pytest.approx(0.885893 / 2, abs=2.5e-7)
    width = np.radians(1.0)
    apertures = half_power / np.sin(width / 2)  # L/λ
    # 0.885893 / 0.01745329, and 1.3e-5 of it for the sine of half a degree
    assert apertures == pytest.approx(50.7586, abs=5e-5)
    assert line_array_pattern(np.arcsin(1 / apertures), 0.0, width) < 1e-25
    u = np.linspace(1, 2, 100_001) / apertures
    lobe = line_array_pattern(np.arcsin(u), 0.0, width)
    assert 10 * np.log10(lobe.max()) == pytest.approx(-13.2615, abs=5e-5)
    assert u[lobe.argmax()] * apertures == pytest.approx(1.4303, abs=5e-5)
    # equivalent width: the integral over u is λ/L, except for the tail beyond ±1, which is 1/(π² · 50.8) of it
    u = np.linspace(-1, 1, 2_000_001)[1:-1]
    total = line_array_pattern(np.arcsin(u), 0.0, width).sum() * 1e-6 * apertures
    assert total == pytest.approx(1 - 1 / (np.pi**2 * apertures), abs=1e-5)


def test_the_pattern_is_zero_behind_a_line_array():
    behind = np.radians([91.0, 135.0, 180.0, 269.0])
    assert line_array_pattern(behind, 0.0, np.radians(1.0)).tolist() == [0, 0, 0, 0]
    # azimuths beyond ±180° are periodic
    a, b = line_array_pattern(np.radians([0.3, 360.3]), 0.0, np.radians(1.0))
    assert a == pytest.approx(b, rel=1e-12)


def peak_db(pattern):
    """Return the level of the highest side lobe, beyond the first null or minimum."""
    db = 10 * np.log10(np.maximum(pattern, 1e-30))
    return db[np.argmax(np.diff(db) > 0) :].max()


X = np.linspace(0, 40, 400_001)


@pytest.mark.parametrize(
    ("taper", "side_lobe_db", "width", "highest_db", "loss_db"),
    [
        ("uniform", 30.0, 0.885893, -13.2615, 0.0),
        # Harris has other values: of 102 elements, whose weights fall to 0.08 inside the array, not at its ends
        ("hamming", 30.0, 1.3030, -42.675, -1.344),
        ("taylor", 25.0, 1.0565, -25.38, -0.43),
        ("taylor", 30.0, 1.1247, -30.30, -0.69),
        ("taylor", 40.0, 1.2485, -40.17, -1.15),
    ],
)
def test_tapers_have_textbook_values(taper, side_lobe_db, width, highest_db, loss_db):
    """−3 dB width in λ/L, highest side lobe and loss of gain."""
    assert 2 * main_lobe_edge(taper_series(taper, side_lobe_db), 0.5) == pytest.approx(width, rel=2e-4)
    pattern = aperture_pattern(X, taper, side_lobe_db)
    assert pattern[0] == 1.0
    assert peak_db(pattern) == pytest.approx(highest_db, abs=0.02)
    series = np.array(taper_series(taper, side_lobe_db))
    assert -10 * np.log10(1 + 2 * (series**2).sum()) == pytest.approx(loss_db, abs=6e-3)


def test_a_taper_without_a_series_is_not_taken_for_taylors():
    """One that was added to TAPERS alone had Taylor's side lobes, and passed all tests."""
    for taper in ("chebyshev", "kaiser"):
        with pytest.raises(ValueError, match=f"must be one with a series .got '{taper}'"):
            taper_series(taper, 30.0)


def test_hamming_taper_against_a_sum_over_elements():
    """NumPy's 102 weights: 1.3114 λ/L wide with L from the first to the last element's centre, −42.6 dB."""
    weights, places = np.hamming(102), np.arange(102) - 50.5
    x = np.linspace(0, 10, 4001)
    field = np.cos(2 * np.pi * places * x[:, None] / 102) @ weights / weights.sum()
    assert peak_db(field**2) == pytest.approx(-42.59, abs=0.02)
    # the aperture is half a spacing longer at either end, 102/101 of the distance of the outer elements
    pattern = aperture_pattern(x * 101 / 102, "hamming")
    assert np.abs(pattern - field**2)[x < 1.5].max() < 3e-3


@pytest.mark.filterwarnings("ignore:This window is not suitable")  # of SciPy, for spectra
@pytest.mark.parametrize(
    ("side_lobe_db", "width", "loss_db"),
    [pytest.param(30.0, 1.0671, -0.63, marks=pytest.mark.slow), (40.0, 1.2113, -1.03)],
)
def test_chebyshev_arrays_have_equal_side_lobes_and_textbook_values(side_lobe_db, width, loss_db):
    """102 elements."""
    # here, since each process of tests would take a while for it
    from scipy.signal.windows import chebwin

    pattern = chebyshev_pattern(X, 102, side_lobe_db)
    assert pattern[0] == pytest.approx(1.0, rel=1e-12)
    # where the Chebyshev polynomial of degree 101 has fallen to √½ of its peak
    peak = 10 ** (side_lobe_db / 20)
    edge, axis = (math.cosh(math.acosh(level) / 101) for level in (peak / math.sqrt(2), peak))
    edge = 102 / math.pi * math.acos(edge / axis)
    assert chebyshev_pattern(np.array([edge]), 102, side_lobe_db) == pytest.approx(0.5, rel=1e-11)
    assert 2 * edge == pytest.approx(width, abs=5e-5)  # as it is printed
    peaks = np.flatnonzero((np.diff(pattern[:-1]) > 0) & (np.diff(pattern[1:]) < 0)) + 1
    np.testing.assert_allclose(10 * np.log10(pattern[peaks]), -side_lobe_db, atol=1e-6)
    # the weights are the Fourier series of the pattern: loss of gain against even weights, by Parseval
    turn = np.linspace(0, 102, 20_400, endpoint=False)
    mean = chebyshev_pattern(turn, 102, side_lobe_db).mean()
    assert -10 * np.log10(102 * mean) == pytest.approx(loss_db, abs=5e-3)  # as it is printed
    weights = chebwin(102, side_lobe_db)
    loss = 102 * (weights**2).sum() / weights.sum() ** 2
    assert mean == pytest.approx(loss / 102, rel=1e-9)


ARRAYS = [("gaussian", "uniform", 30.0), *(("line_array", taper, 30.0) for taper in TAPERS)]
ARRAYS += [("line_array", "chebyshev", s) for s in (20.0, 50.0)]
ARRAYS += [("line_array", "taylor", 45.0)]  # of more terms than the pattern has nulls within its support


@pytest.mark.parametrize("two_way_width", [False, True])
@pytest.mark.parametrize("width_deg", [0.3, 1.0, 20.0, 90.0])
@pytest.mark.parametrize(("shape", "taper", "side_lobe_db"), ARRAYS)
def test_the_width_of_array_patterns_is_exact(shape, taper, side_lobe_db, width_deg, two_way_width):
    pattern = ArrayPattern(shape, math.radians(width_deg), taper, side_lobe_db, two_way_width)
    edge, axis = pattern.power(np.sin(np.radians([width_deg / 2, 0.0])))
    assert edge ** (1 + two_way_width) == pytest.approx(0.5, abs=1e-11)
    assert axis == pytest.approx(1.0, abs=1e-11)  # cosh and arcosh of a Chebyshev array
    for level in (0.9, 0.1):
        assert pattern.power(pattern.main_lobe_sine(level)) == pytest.approx(level, abs=1e-11)


def test_the_two_way_pattern_is_narrower():
    """Its width is 0.637833 λ/L, 0.72 of the one-way width."""
    assert 2 * main_lobe_edge((), math.sqrt(0.5)) == pytest.approx(0.637833, abs=5e-7)


@pytest.mark.parametrize(
    ("shape", "taper", "side_lobe_db"),
    [*ARRAYS[1::2], *(pytest.param(*one, marks=pytest.mark.slow) for one in ARRAYS[2::2])],
)
def test_array_patterns_are_cut_at_a_null_with_only_low_side_lobes_beyond(shape, taper, side_lobe_db):
    pattern = ArrayPattern(shape, math.radians(1.0), taper, side_lobe_db)
    sine = pattern.support_sine()
    assert pattern.power(sine) < 1e-20
    beyond = 10 * np.log10(pattern.power(np.linspace(sine, 1.0, 1_000_001)[1:]).max())
    limit = {"uniform": -22.9, "hamming": -42.5}.get(taper, -side_lobe_db + 0.01)
    assert beyond <= limit
    within = pattern.power(np.linspace(0, sine, 100_001)[1:-1])
    nulls = (np.diff(within[:-1]) < 0) & (np.diff(within[1:]) > 0)
    # the main lobe and three side lobes to each side are kept; of Taylor's all that have a level of their own
    assert nulls.sum() == pattern.support_nulls() - 1 == (6 if side_lobe_db == 45 else 3)


@pytest.mark.parametrize("steer_deg", [-30.0, 45.0, 65.0])
@pytest.mark.parametrize("width_deg", [0.1, 3.0])
@pytest.mark.parametrize("pattern", [line_array_pattern, gaussian_pattern])
def test_beams_of_a_straight_array_broaden_with_the_steering_angle(pattern, width_deg, steer_deg):
    """Their half-power points lie as far apart in sines as those of the beam ahead."""
    width, steer = np.radians([width_deg, steer_deg])
    apart = np.array([-1.0, 1.0]) * np.sin(width / 2)
    edges = np.arcsin(np.sin(steer) + apart)
    for steered, at in (("straight", edges), ("alike", steer + np.arcsin(apart))):
        # a difference of sines is rounded to 1e-13 of the narrow beam's
        np.testing.assert_allclose(pattern(at, steer, width, steered=steered), 0.5, rtol=1e-11)
    # 1 over the cosine of narrow beams, to the second order
    assert np.ptp(edges) / width == pytest.approx(1 / np.cos(steer), rel=(width / np.cos(steer)) ** 2)
    assert pattern(np.radians(91.0), steer, width, steered="straight") == 0  # behind the array


SONAR = sg.Sonar("test", 900e3, 32, 200, 32.0, 20.0, 1.5, 2.0, 16.0)


def ping(bodies, acoustics, sonar=SONAR, pose=None, **more):
    with sg.Simulator(sg.Scene(bodies), sonar, acoustics, **more) as simulator:
        return simulator.ping(np.eye(4) if pose is None else pose, labels=True)


def room():
    """Return a floor, a leaning wall and a ball, at high and low elevations."""
    floor = sg.Body("floor", trimesh.creation.box((60, 60, 0.1)), sg.pose(10, 0, -1.85, 0, 0.05, 0), 0.5)
    wall = sg.Body("wall", trimesh.creation.box((0.1, 40, 12)), sg.pose(12, 0, 2, 0, 0.2, 0.3), 0.3)
    ball = sg.Body("ball", trimesh.creation.icosphere(3, 0.7), sg.pose(5, 1, 1.2), 1.0)
    return [floor, wall, ball]


@pytest.mark.slow
@pytest.mark.parametrize(
    "settings",
    [
        {"elevation_pattern": "line_array", "transmit_width_deg": 25.0},
        pytest.param(
            {"elevation_pattern": "gaussian", "beam_pattern": "box", "transmit_width_deg": 25.0},
            marks=pytest.mark.slow,
        ),
        pytest.param(
            {"receive_taper": "taylor", "steered": "straight", "azimuth_fov_deg": 130.0},
            marks=pytest.mark.slow,
        ),
    ],
    ids=str,
)
def test_pings_with_patterns_agree_with_the_reference(settings):
    coarse = replace(SONAR, n_bins=100)
    sonar, acoustics = described(coarse, **{"azimuth_fov_deg": 32.0, "elevation_pattern": "box"} | settings)
    truth = sg.reference_ping(sg.Scene(room()), sonar, np.eye(4), acoustics, 0.04)
    assert truth.meta["converged"]
    found = ping(room(), acoustics, sonar, tolerance=0.005)
    assert ping_error(found, truth) < 0.01  # including 4e-3, the error of the reference
    np.testing.assert_allclose(found.body_echo[1:], truth.body_echo[1:], rtol=0.01)
    even = replace(coarse, azimuth_fov_deg=sonar.azimuth_fov_deg)
    bare = sg.Acoustics.physical(beam_pattern=acoustics.beam_pattern, elevation_pattern="box")
    plain = ping(room(), bare, even, tolerance=0.01)
    assert ping_error(plain, truth) > 0.04  # the pattern matters here


@pytest.mark.parametrize(
    "settings",
    [
        {"elevation_pattern": "line_array"},
        pytest.param({"elevation_pattern": "gaussian"}, marks=pytest.mark.slow),
    ],
)
def test_a_sphere_about_the_sonar_reads_its_reflectivity_with_every_elevation_pattern(settings):
    ball = sg.Body("ball", trimesh.creation.uv_sphere(10.0, count=[90, 180]), reflectivity=0.3)
    totals = ping([ball], sg.Acoustics.physical(**settings)).intensity.sum(axis=1)
    # facets of 2 degrees deviate from the sphere by 1 degree
    np.testing.assert_allclose(totals, 0.3, rtol=2e-3)
    truth = sg.reference_ping(sg.Scene([ball]), SONAR, np.eye(4), sg.Acoustics.physical(**settings), 0.1)
    np.testing.assert_allclose(truth.intensity.sum(axis=1), 0.3, rtol=2e-3)


def test_the_transmit_pattern_weights_the_beams():
    """Inside a sphere, narrow beams read the transmit pattern on their axes."""
    ball = sg.Body("ball", trimesh.creation.uv_sphere(10.0, count=[90, 180]), reflectivity=0.3)
    sonar, acoustics = described(SONAR, beam_pattern="gaussian", transmit_width_deg=24.0, beam_width_deg=0.5)
    totals = ping([ball], acoustics, sonar).intensity.sum(axis=1)
    transmitted = line_array_pattern(SONAR.azimuth_rad, 0.0, np.radians(24.0))
    assert transmitted.min() < 0.3
    np.testing.assert_allclose(totals, 0.3 * transmitted, rtol=3e-3)
    evenly = ping([ball], replace(acoustics, transmit_beam=False), sonar).intensity.sum(axis=1)
    np.testing.assert_allclose(evenly, 0.3, rtol=3e-3)


@pytest.mark.parametrize("azimuth_deg", [-18.0, -7.0, 0.5, 12.0])
def test_the_transmit_pattern_weights_places_within_a_wide_box(azimuth_deg):
    """A chip anywhere in one box of 40 degrees."""
    sonar = replace(SONAR, n_beams=1, beam_width_deg=40.0, azimuth_fov_deg=40.0, transmit_width_deg=24.0)
    acoustics = sg.Acoustics.physical(beam_pattern="box", elevation_pattern="box")
    echoes = [
        ping([chip(azimuth_deg, 0.0)], one, sonar, sampling=sg.Sampling(4096 // 8, 256)).intensity.sum()
        for one in (acoustics, replace(acoustics, transmit_beam=False))
    ]
    expected = line_array_pattern(np.radians(azimuth_deg), 0.0, np.radians(24.0))
    # the middle of a column is at most 0.75 degrees off: where the pattern falls most, it changes by 0.08 there
    assert echoes[0] / echoes[1] == pytest.approx(float(expected), abs=0.08)


def chip(azimuth_deg, elevation_deg, size=0.02):
    """Return a small plate at 10 m that faces the sonar."""
    azimuth, elevation = np.radians([azimuth_deg, elevation_deg])
    x, y = 10 * np.cos(elevation) * np.array([np.cos(azimuth), np.sin(azimuth)])
    pose = sg.pose(x, y, 10 * np.sin(elevation), 0, -elevation, azimuth)
    return sg.Body("chip", trimesh.creation.box((0.002, size, size)), pose, 1.0)


def test_echoes_follow_the_two_way_elevation_pattern():
    """A plate at several elevations: −3 dB at the edges of the aperture, less beyond, and side lobes of −26.5 dB."""
    acoustics = sg.Acoustics.physical(elevation_pattern="line_array", beam_pattern="box")
    sonar = replace(SONAR, n_beams=3, azimuth_fov_deg=3.0, beam_width_deg=1.0)
    at_deg = np.array([0.0, 5.0, 10.0, -10.0, 20.0, -24.0])
    fine = sg.Sampling(300, 2000)  # 170 columns and 57 rows on a plate, a quarter in skirts
    levels = [ping([chip(0.0, e, 0.1)], acoustics, sonar, sampling=fine).intensity.sum() for e in at_deg]
    x = 0.318917 * np.sin(np.radians(at_deg)) / np.sin(np.radians(10.0))
    np.testing.assert_allclose(np.array(levels) / levels[0], np.sinc(x) ** 4, rtol=0.02)
    # in side lobes there are up to 256 times fewer samples; beams are boxes, within which a plate seems wider
    fine = sg.Sampling(300, 2000)
    at_deg = np.array([28.0, 50.0, -50.0, 65.0, -75.0])
    levels = [ping([chip(0.0, e, 0.1)], acoustics, sonar, sampling=fine).intensity.sum() for e in at_deg]
    middle = ping([chip(0.0, 0.0, 0.1)], acoustics, sonar, sampling=fine).intensity.sum()
    x = 0.318917 * np.sin(np.radians(at_deg)) / np.sin(np.radians(10.0))
    np.testing.assert_allclose(np.array(levels) / middle, np.sinc(x) ** 4, rtol=0.15)


def test_a_tapered_array_receives_nothing_through_its_side_lobes():
    """Those of Hamming's taper are below −80 dB two ways, which nothing shows."""
    sonar, acoustics = described(
        SONAR, n_beams=3, azimuth_fov_deg=3.0, elevation_pattern="line_array", elevation_taper="hamming"
    )
    acoustics = replace(acoustics, beam_pattern="box")
    with pytest.warns(UserWarning, match=r"azimuths within ±1\.5° and elevations within ±45\.1\d?°"):
        dark = ping([chip(0.0, 50.0)], acoustics, sonar)
    assert dark.intensity.sum() == 0
    assert ping([chip(0.0, 40.0, 1.0)], acoustics, sonar).intensity.sum() > 0
    # more than any aperture
    with pytest.warns(UserWarning, match=r"azimuths within ±1\.5° and elevations within ±89\.5°"):
        ping([chip(90.0, 0.0)], acoustics, replace(sonar, elevation_taper="uniform"))


@pytest.mark.parametrize(
    ("taper", "highest_db"), [("uniform", -13.26), ("taylor", -30.3), ("hamming", -43.6)]
)
def test_a_strong_target_has_side_lobes_in_azimuth(taper, highest_db):
    """Beams a tenth of their width apart sample the pattern: main lobe, nulls and side lobes."""
    narrow = {"n_beams": 160, "azimuth_fov_deg": 16.0, "beam_width_deg": 1.0}
    sonar, acoustics = described(SONAR, receive_taper=taper, far_side_lobes=False, **narrow)
    target = chip(0.0, 0.0, 0.01)
    power = ping([target], acoustics, sonar, sampling=sg.Sampling(4, 800)).intensity.sum(axis=1)
    power = power / power.max()
    off = np.abs(np.degrees(sonar.azimuth_rad))
    support = np.degrees(acoustics.receive_support_rad(sonar))
    null = np.degrees(math.asin(math.sin(math.radians(0.5)) / main_lobe_edge(taper_series(taper, 30.0), 0.5)))
    if taper == "hamming":
        null *= 2
    elif taper == "taylor":
        null *= 1.5
    side = (off > null) & (off < support - 0.1)
    # beams miss the peak by half of their spacing at most, a 23rd of a lobe's width, where it is 0.08 dB lower; and the
    # samples that meet the chip lie up to half a sample beside it, a quarter as far
    assert 10 * np.log10(power[side].max()) == pytest.approx(highest_db, abs=0.125)
    assert power[side].min() < power[side].max() / 10  # nulls between
    assert not power[off > support + 0.15].any()


def test_a_target_beside_the_fan_echoes_through_side_lobes():
    """It lies in the main lobe of no beam: 2.5 and 3.5 degrees beyond the axis of the last one."""
    sonar = replace(SONAR, n_beams=160, azimuth_fov_deg=16.0, beam_width_deg=1.0)
    fine, last = sg.Sampling(12, 2400), np.degrees(sonar.azimuth_rad[-1])  # some 190 samples on a target
    acoustics = sg.Acoustics.physical()
    axis = ping([chip(last, 0.0)], acoustics, sonar, sampling=fine).intensity.sum(axis=1)[-1]
    for beyond_deg in (2.5, 3.5):
        power = ping([chip(last + beyond_deg, 0.0)], acoustics, sonar, sampling=fine)
        expected = line_array_pattern(np.radians(last + beyond_deg), sonar.azimuth_rad, np.radians(1.0))
        reached = last + beyond_deg - np.degrees(sonar.azimuth_rad) < 4.4  # up to the last null that is kept
        # columns are a quarter of a beam wide, over which a null fills by up to 1e-3 of the peak
        np.testing.assert_allclose(
            power.intensity.sum(axis=1)[reached] / axis, expected[reached], rtol=0.05, atol=1e-3
        )
        assert 10 * np.log10(expected[reached].max()) > -24  # the third side lobe, at least


def test_the_support_of_a_straight_array_holds_the_fourth_null_of_each_beam():
    """It was that of the outermost beam, which ends at 90 degrees, 34 degrees from a beam whose 4th null is 45 away."""
    sonar, acoustics = described(SONAR, azimuth_fov_deg=150.0, beam_width_deg=4.0, steered="straight")
    null = 4 / 0.885892941379 * 2 * np.sin(np.radians(2.0))  # in sines, of a uniform array
    steer = sonar.azimuth_rad
    ends = [np.arcsin(np.clip(np.sin(steer) + side * null, -1, 1)) - steer for side in (-1, 1)]
    assert acoustics.receive_support_rad(sonar) == pytest.approx(np.abs(ends).max(), rel=1e-6)
    assert np.degrees(np.abs(ends).max()) > 45


def test_the_support_of_a_straight_array_holds_the_fourth_null_on_the_side_of_the_boresight():
    """Aside it ends at 90 degrees: no other beam of this fan is wider than its outermost ones are inward."""
    sonar, acoustics = described(
        SONAR,
        n_beams=3,
        azimuth_fov_deg=150.0,
        beam_azimuths_deg=(-75.0, 0.0, 75.0),
        beam_width_deg=4.0,
        steered="straight",
    )
    null = 4 / 0.885892941379 * 2 * np.sin(np.radians(2.0))
    inward = np.radians(75.0) - np.arcsin(np.sin(np.radians(75.0)) - null)
    assert acoustics.receive_support_rad(sonar) == pytest.approx(inward, rel=1e-6)


def test_the_periods_of_receive_and_transmit_pattern_add_up():
    """The spectrum of a product is as wide as both together: that of sin² x sin² y has no waves beyond x + y."""
    sonar, acoustics = described(SONAR, beam_width_deg=4.0, transmit_width_deg=10.0)
    half_width = 0.885892941379 / 2  # of a uniform array, in λ/L
    per_rad = half_width / np.sin(np.radians(2.0)) + half_width / np.sin(np.radians(5.0))
    assert acoustics.null_rad(sonar) == pytest.approx(1 / per_rad, rel=1e-9)


def test_a_gaussian_pattern_has_few_waves_that_are_shorter_than_its_null():
    pattern = ArrayPattern("gaussian", math.radians(20.0))
    u = np.linspace(-4, 4, 80_001)  # beyond 1, too: the whole Gaussian
    power = pattern.power(u)
    share = (power * np.cos(2 * np.pi * u / pattern.null_sine())).sum() / power.sum()
    assert 3.5e-8 < share < 4e-8


def test_straight_arrays_are_limited_in_steering():
    sonar, acoustics = described(SONAR, azimuth_fov_deg=170.0, steered="straight")
    with pytest.raises(sg.Error) as caught:
        ping(room(), acoustics, sonar)
    assert str(caught.value) == (
        f'sonar {SONAR.name!r}: steered "straight" needs beams within ±80° of the boresight '
        '(got 82.34°: one array cannot receive along its own line; take "alike")'
    )


@pytest.mark.filterwarnings("ignore:.* elevation_fov_deg = 0.6")
def test_side_lobes_are_received_down_to_80_db_and_nearly_straight_up():
    def max_deg(**device):
        sonar, acoustics = described(SONAR, elevation_pattern="line_array", **device)
        return acoustics.max_elevation_deg(sonar), acoustics.two_way_elevation_pattern(sonar)

    assert sg.Acoustics.physical(elevation_pattern="box").max_elevation_deg(SONAR) == 10.0
    assert max_deg()[0] == 89.5
    for device in ({"elevation_taper": "hamming"}, {"elevation_fov_deg": 0.6}):
        limit_deg, pattern = max_deg(**device)
        assert limit_deg < 80
        sine = math.sin(math.radians(limit_deg))
        # found on a grid of sines, the last of which lies within 1/8192 of the limit
        assert (pattern(np.linspace(sine + 2 / 8192, 1, 10_001)) < 1.001e-8).all()
        assert pattern(np.linspace(sine - 2 / 8192, sine, 101)).max() > 1e-8


def test_the_true_range_sonar_covers_the_support_in_elevation():
    """Down to −30 dB of the two-way pattern, but 85 degrees at most; a box keeps the aperture of the sonar."""
    acoustics = sg.Acoustics.physical(elevation_pattern="line_array")
    assert sg.Acoustics.physical(elevation_pattern="box").true_range_sonar(SONAR) is SONAR
    top = acoustics.true_range_sonar(SONAR).elevation_fov_deg / 2
    assert acoustics.two_way_elevation_pattern(SONAR)(math.sin(math.radians(top))) == pytest.approx(
        1e-3, rel=1e-9
    )
    assert acoustics.true_range_sonar(replace(SONAR, elevation_fov_deg=80.0)).elevation_fov_deg == 170.0
    # little of the pattern lies beyond: 3e-4 of a Gaussian, and the side lobes of a line array
    sines = np.linspace(0, 1, 100_001)
    for pattern, limit in (("line_array", 4e-3), ("gaussian", 3e-4)):
        acoustics = sg.Acoustics.physical(elevation_pattern=pattern)
        power = acoustics.two_way_elevation_pattern(SONAR)(sines)
        top = acoustics.true_range_sonar(SONAR).elevation_fov_deg / 2
        assert power[sines > math.sin(math.radians(top))].sum() < limit * power.sum()


@pytest.mark.parametrize(
    "change",
    [
        # the support in elevation is higher: the text would be another one
        {"elevation_fov_deg": 0.26},
        # too little only against the support, which no user has set
        {"elevation_fov_deg": 3.0, "tilt_deg": 0.7},
    ],
)
def test_the_true_range_sonar_warns_of_nothing(change):
    """Its numbers are none that the user has written: what is unlikely in the sonar itself has been said."""
    with collected_warnings():
        sonar = replace(SONAR, **change)
    with collected_warnings() as found:
        sg.Acoustics.physical().true_range_sonar(sonar)
    assert found == []


@pytest.mark.parametrize(
    ("pattern", "taper", "within"),
    [
        ("line_array", "uniform", 5e-3),  # side lobes reach beyond the integral
        ("line_array", "hamming", 1e-4),  # interpolated
        ("line_array", "taylor", 1e-3),
        ("line_array", "chebyshev", 0.06),  # counts as Taylor's, whose side lobes fall
        ("gaussian", "uniform", 1e-5),
        ("box", "uniform", 2e-3),  # steps of the integral
    ],
)
def test_the_amplitudes_of_two_directions_correlate_as_the_integral_over_beams(pattern, taper, within):
    sonar = replace(sg.load_sonar("p900-45"), beam_width_deg=2.0, receive_taper=taper)
    acoustics = sg.Acoustics.physical(beam_pattern=pattern)
    correlation, reach = acoustics.receive_correlation(sonar)
    square = reach**2 * np.linspace(0, 1, len(correlation))
    width, step = np.radians(2.0), 1e-5
    v = step * np.arange(-150_000, 150_001)
    if pattern == "box":
        amplitude = (np.abs(v) <= width / 2).astype(float)
    else:
        power = ArrayPattern(pattern, width, taper, sonar.side_lobe_db).power(v)
        dip = (power[1:-1] < power[:-2]) & (power[1:-1] <= power[2:])  # the amplitude changes sign
        signs = (
            np.append(1, np.where(dip, -1, 1)).cumprod() if pattern == "line_array" else np.ones(len(v) - 1)
        )
        amplitude = np.sqrt(power) * np.append(signs, signs[-1])
    for steps in (0, 500, 1500, 3500, 7000):
        product = (amplitude[steps:] * amplitude[: len(v) - steps]).sum() / (amplitude**2).sum()
        found = np.interp((steps * step) ** 2, square, correlation)
        assert found == pytest.approx(product, abs=within)
