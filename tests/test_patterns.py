"""Beam patterns against published numbers; pings of patterns against the reference."""

import math
from dataclasses import replace

import numpy as np
import pytest
import trimesh

import sonar_gl as sg
from sonar_gl.patterns import (
    Lobe,
    aperture_pattern,
    box_pattern,
    chebyshev_pattern,
    first_of,
    gaussian_pattern,
    line_array_pattern,
    taper_series,
)
from sonar_gl.verify import ping_error


@pytest.mark.parametrize("width_deg", [0.25, 1.0, 2.0, 20.0, 90.0])
@pytest.mark.parametrize("steer_deg", [0.0, 65.0, -180.0])
def test_line_array_half_power(width_deg, steer_deg):
    width, steer = np.radians([width_deg, steer_deg])
    edges = line_array_pattern(steer + np.array([-0.5, 0.5]) * width, steer, width)
    np.testing.assert_allclose(edges, 0.5, rtol=0, atol=1e-13)
    assert line_array_pattern(steer, steer, width) == 1.0
    fine = line_array_pattern(np.linspace(-0.5, 0.5, 101) * width, 0.0, width)
    assert (np.diff(fine[50:]) < 0).all()  # falls from the axis to the edge


def test_line_array_lobes():
    """First null, first side lobe, width in λ/L: a uniform aperture's textbook numbers."""
    half_power = first_of((), 0.5)
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
    # equivalent width: the integral over u is λ/L, all but the tail beyond ±1, 1/(π² · 50.8) of it
    u = np.linspace(-1, 1, 2_000_001)[1:-1]
    total = line_array_pattern(np.arcsin(u), 0.0, width).sum() * 1e-6 * apertures
    assert total == pytest.approx(1 - 1 / (np.pi**2 * apertures), abs=1e-5)


def test_line_array_hears_nothing_from_behind():
    behind = np.radians([91.0, 135.0, 180.0, 269.0])
    assert line_array_pattern(behind, 0.0, np.radians(1.0)).tolist() == [0, 0, 0, 0]
    # angles may run past ±180°
    a, b = line_array_pattern(np.radians([0.3, 360.3]), 0.0, np.radians(1.0))
    assert a == pytest.approx(b, rel=1e-12)


def test_boxes_side_by_side_share_no_direction():
    steer, width = (np.arange(8) - 3.5) / 4, 0.25  # binary fractions: the edges are met exactly
    heard = box_pattern((np.arange(64) / 32 - 1)[:, None], steer, width)
    assert 0.125 in (np.arange(64) / 32 - 1) - steer[0]  # an edge is among them
    assert (heard.sum(axis=1) == 1).all()


def test_box_across_180_degrees():
    assert box_pattern(np.radians([-179.8, 179.8, 179.0]), np.pi, np.radians(1.0)).tolist() == [1, 1, 0]


def peak_db(pattern, x):
    """The highest side lobe: beyond the first null, or the first dip."""
    db = 10 * np.log10(np.maximum(pattern, 1e-30))
    return db[np.argmax(np.diff(db) > 0) :].max()


X = np.linspace(0, 40, 400_001)


@pytest.mark.parametrize(
    ("taper", "side_lobe_db", "width", "highest_db", "loss_db"),
    [
        ("uniform", 30.0, 0.885893, -13.2615, 0.0),
        # the table's own is of 102 elements whose weights reach their 0.08 within the array, not at its ends
        ("hamming", 30.0, 1.3030, -42.675, -1.344),
        ("taylor", 25.0, 1.0565, -25.38, -0.43),
        ("taylor", 30.0, 1.1247, -30.30, -0.69),
        ("taylor", 40.0, 1.2485, -40.17, -1.15),
    ],
)
def test_tapers(taper, side_lobe_db, width, highest_db, loss_db):
    """−3 dB width in λ/L, highest side lobe and loss of gain, textbook numbers."""
    assert 2 * first_of(taper_series(taper, side_lobe_db), 0.5) == pytest.approx(width, rel=2e-4)
    pattern = aperture_pattern(X, taper, side_lobe_db)
    assert pattern[0] == 1.0
    assert peak_db(pattern, X) == pytest.approx(highest_db, abs=0.02)
    series = np.array(taper_series(taper, side_lobe_db))
    assert -10 * np.log10(1 + 2 * (series**2).sum()) == pytest.approx(loss_db, abs=6e-3)


def test_hamming_of_elements():
    """NumPy's 102 weights: 1.3114 λ/L wide with L between the outer elements' middles, and −42.6 dB."""
    weights, places = np.hamming(102), np.arange(102) - 50.5
    x = np.linspace(0, 10, 4001)
    field = np.cos(2 * np.pi * places * x[:, None] / 102) @ weights / weights.sum()
    assert peak_db(field**2, x) == pytest.approx(-42.59, abs=0.02)
    # an element's half spacing on either side makes the aperture 102/101 longer than its weights' ends
    ours = aperture_pattern(x * 101 / 102, "hamming")
    assert np.abs(ours - field**2)[x < 1.5].max() < 3e-3


@pytest.mark.parametrize(("side_lobe_db", "width", "loss_db"), [(30.0, 1.0671, -0.63), (40.0, 1.2113, -1.03)])
def test_chebyshev(side_lobe_db, width, loss_db):
    """Of 102 elements: side lobes all alike, width and loss of the textbook."""
    pattern = chebyshev_pattern(X, 102, side_lobe_db)
    assert pattern[0] == pytest.approx(1.0, rel=1e-12)
    assert 2 * X[np.argmax(pattern < 0.5)] == pytest.approx(width, abs=2e-3)
    peaks = np.flatnonzero((np.diff(pattern[:-1]) > 0) & (np.diff(pattern[1:]) < 0)) + 1
    np.testing.assert_allclose(10 * np.log10(pattern[peaks]), -side_lobe_db, atol=1e-6)
    # weights are the pattern's Fourier series: power on the axis over that of even weights, by Parseval
    turn = np.linspace(0, 102, 20_400, endpoint=False)
    mean = chebyshev_pattern(turn, 102, side_lobe_db).mean()
    assert -10 * np.log10(102 * mean) == pytest.approx(loss_db, abs=6e-3)


LOBES = [("gaussian", "uniform", 30.0), *(("line_array", t, 30.0) for t in ("uniform", "hamming", "taylor"))]
LOBES += [("line_array", "chebyshev", s) for s in (20.0, 30.0, 50.0)]


@pytest.mark.parametrize("both_ways", [False, True])
@pytest.mark.parametrize("width_deg", [0.3, 1.0, 20.0, 90.0])
@pytest.mark.parametrize(("shape", "taper", "side_lobe_db"), LOBES)
def test_the_width_is_exact(shape, taper, side_lobe_db, width_deg, both_ways):
    lobe = Lobe(shape, math.radians(width_deg), taper, side_lobe_db, both_ways)
    edge, axis = lobe.power(np.sin(np.radians([width_deg / 2, 0.0])))
    assert edge ** (1 + both_ways) == pytest.approx(0.5, abs=1e-11)
    assert axis == pytest.approx(1.0, abs=1e-11)  # cosh of so many arcosh
    for level in (0.9, 0.1):
        assert lobe.power(lobe.sine_at(level)) == pytest.approx(level, abs=1e-11)


def test_two_ways_are_narrower():
    """The same array heard both ways: 0.637833 λ/L, 0.72 of one way."""
    assert 2 * first_of((), math.sqrt(0.5)) == pytest.approx(0.637833, abs=5e-7)


@pytest.mark.parametrize(("shape", "taper", "side_lobe_db"), LOBES[1:])
def test_what_lies_beyond_the_last_null_is_below_the_side_lobes(shape, taper, side_lobe_db):
    lobe = Lobe(shape, math.radians(1.0), taper, side_lobe_db)
    sine = lobe.last_null()
    assert lobe.power(sine) < 1e-20
    beyond = 10 * np.log10(lobe.power(np.linspace(sine, 1.0, 1_000_001)[1:]).max())
    limit = {"uniform": -22.9, "hamming": -42.5}.get(taper, -side_lobe_db + 0.01)
    assert beyond <= limit
    within = lobe.power(np.linspace(0, sine, 100_001)[1:-1])
    troughs = (np.diff(within[:-1]) < 0) & (np.diff(within[1:]) > 0)
    assert 2 <= troughs.sum() <= 3  # nulls on the way: side lobes are heard


@pytest.mark.parametrize(("steer_deg", "broader"), [(45.0, 1.414), (65.0, 2.366)])
@pytest.mark.parametrize("pattern", [line_array_pattern, gaussian_pattern])
def test_a_straight_array_broadens_where_it_is_steered(pattern, steer_deg, broader):
    width, steer = np.radians(0.1), np.radians(steer_deg)
    offsets = np.radians(np.linspace(-0.5, 0.5, 200_001))
    for steered, factor in (("alike", 1.0), ("straight", broader)):
        heard = pattern(steer + offsets, steer, width, steered=steered) >= 0.5
        assert np.ptp(offsets[heard]) / width == pytest.approx(factor, rel=1e-3)
    assert pattern(np.radians(91.0), steer, width, steered="straight") == 0  # behind the array


SONAR = sg.Sonar("test", 900e3, 32, 200, 32.0, 20.0, 1.5, 2.0, 16.0)


def ping(bodies, acoustics, sonar=SONAR, pose=None, **more):
    with sg.Simulator(sg.Scene(bodies), sonar, acoustics, **more) as simulator:
        return simulator.ping(np.eye(4) if pose is None else pose, labels=True)


def room():
    """A floor, a leaning wall and a ball, seen high and low."""
    floor = sg.Body("floor", trimesh.creation.box((60, 60, 0.1)), sg.pose(10, 0, -1.85, 0, 0.05, 0), 0.5)
    wall = sg.Body("wall", trimesh.creation.box((0.1, 40, 12)), sg.pose(12, 0, 2, 0, 0.2, 0.3), 0.3)
    ball = sg.Body("ball", trimesh.creation.icosphere(3, 0.7), sg.pose(5, 1, 1.2), 1.0)
    return [floor, wall, ball]


@pytest.mark.parametrize(
    "settings",
    [
        {"elevation_pattern": "line_array", "transmit_width_deg": 25.0},
        {"elevation_pattern": "gaussian", "beam_pattern": "box", "transmit_width_deg": 25.0},
        {"taper": "taylor", "steered": "straight", "fan": 130.0},
    ],
    ids=str,
)
def test_patterns_against_the_reference(settings):
    sonar = replace(SONAR, azimuth_fov_deg=settings.get("fan", 32.0))
    acoustics = sg.Acoustics.physical(**{key: settings[key] for key in settings if key != "fan"})
    truth = sg.reference_ping(sg.Scene(room()), sonar, np.eye(4), acoustics, 0.02)
    assert truth.meta["converged"]
    ours = ping(room(), acoustics, sonar, tolerance=0.005)
    assert ping_error(ours, truth) < 0.01  # the truth's own error, 2e-3, is in it
    np.testing.assert_allclose(ours.body_echo[1:], truth.body_echo[1:], rtol=0.01)
    plain = ping(room(), sg.Acoustics.physical(beam_pattern=acoustics.beam_pattern), sonar, tolerance=0.01)
    assert ping_error(plain, truth) > 0.04  # the pattern is no trifle here


@pytest.mark.parametrize("settings", [{"elevation_pattern": "line_array"}, {"elevation_pattern": "gaussian"}])
def test_a_sphere_about_the_sonar_still_reads_its_reflectivity(settings):
    ball = sg.Body("ball", trimesh.creation.uv_sphere(10.0, count=[90, 180]), reflectivity=0.3)
    totals = ping([ball], sg.Acoustics.physical(**settings)).intensity.sum(axis=1)
    np.testing.assert_allclose(totals, 0.3, rtol=2e-3)  # facets of 2 degrees stand 1 degree askew
    truth = sg.reference_ping(sg.Scene([ball]), SONAR, np.eye(4), sg.Acoustics.physical(**settings), 0.1)
    np.testing.assert_allclose(truth.intensity.sum(axis=1), 0.3, rtol=2e-3)


def test_the_projector_weighs_the_beams():
    """In a sphere narrow beams read what the projector sends their way."""
    ball = sg.Body("ball", trimesh.creation.uv_sphere(10.0, count=[90, 180]), reflectivity=0.3)
    acoustics = sg.Acoustics.physical(beam_pattern="gaussian", transmit_width_deg=24.0)
    totals = ping([ball], acoustics, replace(SONAR, beam_width_deg=0.5)).intensity.sum(axis=1)
    sent = line_array_pattern(SONAR.azimuth_rad, 0.0, np.radians(24.0))
    assert sent.min() < 0.3
    np.testing.assert_allclose(totals, 0.3 * sent, rtol=3e-3)


def chip(azimuth_deg, elevation_deg, size=0.02):
    """A small plate at 10 m that faces the sonar."""
    azimuth, elevation = np.radians([azimuth_deg, elevation_deg])
    x, y = 10 * np.cos(elevation) * np.array([np.cos(azimuth), np.sin(azimuth)])
    pose = sg.pose(x, y, 10 * np.sin(elevation), 0, -elevation, azimuth)
    return sg.Body("chip", trimesh.creation.box((0.002, size, size)), pose, 1.0)


def test_elevation_is_heard_as_the_pattern_says():
    """A chip up and down: −3 dB at the aperture's edge both ways, something beyond, nothing past the cut."""
    acoustics = sg.Acoustics.physical(elevation_pattern="line_array", beam_pattern="box")
    sonar = replace(SONAR, n_beams=3, azimuth_fov_deg=3.0, beam_width_deg=1.0)
    at_deg = np.array([0.0, 5.0, 10.0, -10.0, 20.0, -24.0])
    fine = sg.Sampling(150, 1000)  # 85 across a chip, 28 up
    levels = [ping([chip(0.0, e, 0.1)], acoustics, sonar, sampling=fine).intensity.sum() for e in at_deg]
    x = 0.318917 * np.sin(np.radians(at_deg)) / np.sin(np.radians(10.0))
    np.testing.assert_allclose(np.array(levels) / levels[0], np.sinc(x) ** 4, rtol=0.02)
    with pytest.warns(UserWarning, match=r"sees ±1\.5° and ±27\.3\d°"):
        dark = ping([chip(0.0, 30.0)], acoustics, sonar)
    assert dark.intensity.sum() == 0


@pytest.mark.parametrize(
    ("taper", "highest_db"), [("uniform", -13.26), ("taylor", -30.3), ("hamming", -43.6)]
)
def test_a_strong_target_shows_its_side_lobes_beside_it(taper, highest_db):
    """Beams a tenth of their width apart draw the pattern itself: main lobe, nulls and side lobes."""
    sonar = replace(SONAR, n_beams=160, azimuth_fov_deg=16.0, beam_width_deg=1.0)
    acoustics = sg.Acoustics.physical(taper=taper)
    heard = ping([chip(0.0, 0.0, 0.01)], acoustics, sonar, sampling=sg.Sampling(4, 800)).intensity.sum(axis=1)
    heard = heard / heard.max()
    off = np.abs(np.degrees(sonar.azimuth_rad))
    reach = np.degrees(acoustics.beam_reach_rad(sonar))
    null = np.degrees(math.asin(math.sin(math.radians(0.5)) / first_of(taper_series(taper, 30.0), 0.5)))
    if taper == "hamming":
        null *= 2
    elif taper == "taylor":
        null *= 1.5
    side = (off > null) & (off < reach - 0.1)
    assert 10 * np.log10(heard[side].max()) == pytest.approx(highest_db, abs=0.6)
    assert heard[side].min() < heard[side].max() / 10  # nulls between
    assert not heard[off > reach + 0.15].any()


def test_straight_arrays_have_limits():
    sonar = replace(SONAR, azimuth_fov_deg=170.0)
    acoustics = sg.Acoustics.physical(steered="straight")
    with pytest.raises(sg.Error) as caught:
        ping(room(), acoustics, sonar)
    assert str(caught.value) == (
        'acoustics: steered "straight" needs beams within ±80° of the boresight '
        '(got 82.34°: one array cannot hear along its own line; take "alike")'
    )
    with pytest.raises(sg.Error, match="needs a beam_pattern that a straight array can have"):
        sg.Acoustics.ideal().__class__("ideal", steered="straight")


def test_the_aperture_that_is_drawn():
    """Wider by as much as is heard; no further than 85 degrees; as given where the pattern is a box."""
    acoustics = sg.Acoustics.physical(elevation_pattern="line_array")
    assert sg.Acoustics.physical().drawn_sonar(SONAR) is SONAR
    top = acoustics.drawn_sonar(SONAR).elevation_fov_deg / 2
    assert acoustics.elevation_function(SONAR)(math.sin(math.radians(top))) == pytest.approx(1e-3, rel=1e-9)
    assert acoustics.drawn_sonar(replace(SONAR, elevation_fov_deg=80.0)).elevation_fov_deg == 170.0
    # what is cut off is little: of the main lobe 3e-4 at most
    sines = np.linspace(0, 1, 100_001)
    for pattern in ("line_array", "gaussian"):
        it = replace(acoustics, elevation_pattern=pattern)
        heard, last = it.elevation_function(SONAR)(sines), it.drawn_sonar(SONAR).elevation_fov_deg / 2
        beyond = heard[sines > math.sin(math.radians(last))].sum() / heard.sum()
        assert beyond < {"line_array": 4e-3, "gaussian": 3e-4}[pattern]
