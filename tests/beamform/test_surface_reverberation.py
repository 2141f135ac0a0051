"""The backscatter of the water's surface against the sonar equation, quadratures, and what hides it."""

import math
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import trimesh

import sonar_gl as sg
from sonar_gl.acoustics.sea_surface import surface_backscattering
from sonar_gl.beamform.surface_reverberation import over_lambert
from sonar_gl.core.errors import Error

SONAR = sg.Sonar("surface", 900e3, 24, 240, 40.0, 16.0, 2.0, 0.5, 24.5)
WIND_M_S = 7.0
WINDY = sg.Water(wind_speed_m_s=WIND_M_S)
SIGMA = partial(surface_backscattering, frequency_hz=900e3, wind_speed_m_s=WIND_M_S)


def ideal(**changes):
    return replace(sg.Acoustics.ideal(), water=WINDY, surface_reverberation=True, **changes)


def at(height_m, roll=0.0, pitch=0.0):
    """Return the pose of a sonar so far below the surface at z = 3."""
    return sg.pose(0, 0, 3.0 - height_m, roll, pitch)


def surface_of(acoustics, pose, bodies=(), sonar=SONAR, **settings):
    """Return what the surface at z = 3 adds to a ping without noise, (B, K) float64."""
    settings, pings = {"tolerance": 0.01} | settings, []
    scene = sg.Scene(bodies, surface_z_m=3.0)
    for is_on in (True, False):
        changed = replace(acoustics, surface_reverberation=is_on)
        with sg.Simulator(scene, sonar, changed, **settings) as simulator:
            pings.append(np.float64(simulator.ping(pose).intensity))
    return pings[0] - pings[1]


def mean_in_bins(f, edges_m):
    """Return the means of f(range) over bins."""
    r = edges_m[:-1, None] + np.diff(edges_m)[:, None] * (np.arange(64) + 0.5) / 64
    return f(r).mean(axis=1)


@pytest.mark.filterwarnings("ignore:no echo came back")
@pytest.mark.parametrize("engine", ["cpu", "opengl"])
@pytest.mark.parametrize("height_m", [0.7, 2.0])
def test_the_reverberation_level_follows_the_sonar_equation(engine, height_m):
    """RL = SL - 40 log r - 2 α r + S_s + 10 log(φ r Δr), over the echo of a sphere at 1 m, and the TVG."""
    water = replace(WINDY, absorption_db_m=0.3)
    acoustics = replace(ideal(range_law="sonar_equation", tvg_k=30.0, tvg_absorption_db_m=0.2), water=water)
    found = surface_of(acoustics, at(height_m), engine=engine)
    half, width = math.radians(SONAR.elevation_fov_deg) / 2, math.radians(SONAR.beam_width_deg)
    r = SONAR.range_m

    def area_law(r):  # φ r σ: the ring of the surface in a beam, per metre of range
        return width * r * SIGMA(np.arcsin(height_m / r))

    first = np.flatnonzero(SONAR.bin_edges_m > height_m / math.sin(half))[0]
    edges = SONAR.bin_edges_m[first:]
    area_sigma = mean_in_bins(lambda r: area_law(r) * r**-4.0, edges) * SONAR.bin_size_m
    gain_db = (30 * np.log10(r) + 2 * 0.2 * r - 2 * 0.3 * r)[first:]
    unit = width * 2 * math.sin(half) / math.pi  # the echo of the sphere of reflectivity 1 at 1 m
    expected = area_sigma * 10 ** (gain_db / 10) / unit
    # the gain of a bin is that of its middle, r^-4 in the bin is r^-2 of it times r^-2: 1e-3 at 0.1 m in 5 m
    beams = slice(2, -2)
    np.testing.assert_allclose(
        found[beams, first:], np.broadcast_to(expected, found[beams, first:].shape), rtol=4e-3
    )
    assert not found[:, : first - 1].any()


@pytest.mark.filterwarnings("ignore:no echo came back")
@pytest.mark.parametrize(
    ("elevation_pattern", "roll", "pitch"),
    [  # quadratures of a million directions: each turn and each pattern once
        pytest.param("box", 0.0, -math.pi / 2, marks=pytest.mark.slow),
        ("line_array", 0.5, -0.1),
        pytest.param("box", 0.0, -0.25, marks=pytest.mark.slow),
        pytest.param("box", 0.5, -0.1, marks=pytest.mark.slow),
        pytest.param("line_array", 0.0, -0.25, marks=pytest.mark.slow),
        pytest.param("line_array", 0.0, -math.pi / 2, marks=pytest.mark.slow),
    ],
)
def test_a_turned_sonar_receives_what_a_quadrature_over_directions_gives(roll, pitch, elevation_pattern):
    """∫ π σ / sin g over the directions of a beam that rise, into bins; the last looks straight up."""
    acoustics, height_m = ideal(elevation_pattern=elevation_pattern), 2.0
    pose = at(height_m, roll, pitch)
    found = surface_of(acoustics, pose)
    top = math.radians(acoustics.max_elevation_deg(SONAR))  # with side lobes
    two_way = acoustics.two_way_elevation_pattern(SONAR)
    n_sines, n_azimuths = 20001, 41
    sines = ((np.arange(n_sines) + 0.5) / n_sines * 2 - 1) * math.sin(top)
    weight = np.ones(n_sines) if two_way is None else two_way(sines)
    for beam in (3, 12, 20):
        azimuths = SONAR.azimuth_rad[beam] + math.radians(2.0) * (
            (np.arange(n_azimuths) + 0.5) / n_azimuths - 0.5
        )
        cosines = np.sqrt(1 - sines**2)
        rise = (
            np.outer(np.cos(azimuths), cosines) * pose[2, 0]
            + np.outer(np.sin(azimuths), cosines) * pose[2, 1]
            + sines * pose[2, 2]
        )
        up = rise > height_m / SONAR.range_max_m
        g = np.arcsin(rise[up])
        echo = np.pi * SIGMA(g) / np.sin(g) * np.broadcast_to(weight, rise.shape)[up]
        expected, _ = np.histogram(height_m / rise[up], SONAR.bin_edges_m, weights=echo)
        expected /= n_azimuths * weight.sum()
        # the tolerance of the samples
        assert found[beam].sum() == pytest.approx(expected.sum(), rel=0.01)
        # a far bin has some ten directions of the quadrature
        smooth = partial(np.convolve, np.ones(8) / 8, mode="valid")
        np.testing.assert_allclose(smooth(found[beam]), smooth(expected), atol=0.02 * smooth(expected).max())


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:no echo came back")
def test_beams_that_look_up_have_their_echo_where_the_backscatter_falls_much_from_bin_to_bin():
    """Straight above, bins of 15 cm hold many degrees each, and samples cover parts of two of them."""
    sonar, height_m = sg.Sonar("upwards", 900e3, 16, 200, 20.0, 20.0, 1.25, 0.5, 30.0), 5.0
    pose = at(height_m, pitch=-math.pi / 2)
    found = surface_of(ideal(), pose, sonar=sonar).sum(axis=1)
    sines = math.sin(math.radians(10.0)) * ((np.arange(2000) + 0.5) / 1000 - 1)
    off_axis = math.radians(1.25) * ((np.arange(40) + 0.5) / 40 - 0.5)
    rise = np.cos(sonar.azimuth_rad[:, None] + off_axis)[..., None] * np.sqrt(1 - sines**2)
    expected = (np.pi * SIGMA(np.arcsin(rise)) / rise).mean(axis=(1, 2))
    np.testing.assert_allclose(found, expected, rtol=0.01)


def test_the_law_of_each_bin_is_exact_where_the_backscatter_has_a_primitive():
    """σ = a sin g, a dense layer of bubbles: π a ∫ d(sin² g) / sin g = 2 π a sin g."""
    edges, height_m, a = np.array([0.5, 1.0, 2.0, 2.1, 5.0, 5.1]), 2.0, 1e-3
    sines = height_m / np.maximum(edges, height_m)
    expected = np.zeros(5)
    expected[2:] = 2 * np.pi * a * np.diff(sines)[2:] / np.diff(sines**2)[2:]
    found = over_lambert(edges, height_m, lambda g: a * np.sin(g))
    # the integrand is smooth: eight nodes are exact to rounding
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-15)


def test_a_body_hides_the_surface_behind_it():
    """A wide plate from the water's surface down, at 6 m before the port half of the fan."""
    plate = sg.Body(
        "plate",
        trimesh.creation.box((0.02, 20.0, 6.0)),
        sg.pose(6.0, 10.0, 0.0),
        reflectivity=1e-6,
    )
    height_m = 0.5
    found, clear = surface_of(ideal(), at(height_m), [plate]), surface_of(ideal(), at(height_m), [])
    before, behind = SONAR.bin_edges_m[1:] < 5.9, SONAR.bin_edges_m[:-1] > 6.0 / math.cos(0.4) + 0.1
    # with a body the tolerance of 0.01 takes other samples; bins differ by less than half of it
    inside = before & (SONAR.bin_edges_m[:-1] > height_m / math.sin(math.radians(8.0)) + 0.2)
    np.testing.assert_allclose(found[:, inside], clear[:, inside], rtol=5e-3)
    assert not found[14:, behind].any()
    np.testing.assert_allclose(found[:10, behind], clear[:10, behind], rtol=5e-3)


def test_bins_in_which_the_surface_is_strongest_have_no_label():
    ball = sg.Body("ball", trimesh.creation.icosphere(3, 0.3), sg.pose(8, 0, 2.0), reflectivity=0.5)
    faint = sg.Body("faint", trimesh.creation.icosphere(3, 0.3), sg.pose(8, 2, 2.0), reflectivity=1e-5)
    scene, labels = sg.Scene([ball, faint], surface_z_m=3.0), {}
    for is_on in (True, False):
        acoustics = replace(ideal(), surface_reverberation=is_on)
        with sg.Simulator(scene, SONAR, acoustics, tolerance=0.01) as simulator:
            # all bins are labelled, however faint
            ping = simulator.ping(at(0.9), labels=True, label_level_db=-180.0)
        labels[is_on] = ping
    assert set(np.unique(labels[False].body_id)) == {0, 1, 2}
    assert set(np.unique(labels[True].body_id)) == {0, 1}
    gone = labels[False].body_id == 2
    assert not labels[True].share[gone].any() and np.isnan(labels[True].elevation_rad[gone]).all()
    # sums of bodies and the labels of others are those without the surface
    np.testing.assert_array_equal(labels[True].body_echo, labels[False].body_echo)
    kept = labels[True].body_id == 1
    np.testing.assert_array_equal(labels[True].elevation_rad[kept], labels[False].elevation_rad[kept])


@pytest.mark.filterwarnings("ignore:no echo came back")
def test_it_is_off_without_wind_surface_or_by_profile_and_the_water_of_a_ping_decides():
    assert sg.Acoustics.physical().surface_backscatter(SONAR) is None
    assert replace(sg.Acoustics.ideal(), water=WINDY).surface_backscatter(SONAR) is None
    acoustics, pose = sg.Acoustics.physical(water=WINDY), at(0.6)
    with sg.Simulator(sg.Scene([]), SONAR, acoustics, tolerance=0.05) as simulator:
        assert not simulator.ping(pose).intensity.any()
    scene = sg.Scene([], surface_z_m=3.0)
    with sg.Simulator(scene, SONAR, tolerance=0.05) as simulator:
        assert not simulator.ping(pose).intensity.any()
        windy = simulator.ping(pose, water=WINDY)
        assert windy.intensity.any() and windy.meta["has_echo"]
        assert not simulator.ping(sg.pose(0, 0, 4.0), water=WINDY).intensity.any()  # in the air
        assert not simulator.ping(sg.pose(0, 0, -30.0), water=WINDY).intensity.any()  # out of range
    with sg.Simulator(scene, SONAR, acoustics, tolerance=0.05) as simulator:
        np.testing.assert_array_equal(simulator.ping(pose).intensity, windy.intensity)
        (of_sequence,) = simulator.pings([pose])
        np.testing.assert_array_equal(of_sequence.intensity, windy.intensity)


def test_waves_end_multipath_by_the_surface():
    """A breeze of 3 m/s makes waves of 5 cm, from which nothing at 900 kHz is reflected as by a plane."""
    ball = sg.Body("ball", trimesh.creation.icosphere(3, 0.5), sg.pose(16, 0, 2.0), reflectivity=0.5)
    scene, pose = sg.Scene([ball], surface_z_m=3.0), at(0.7)
    totals = {}
    for wind in (None, 3.0):
        for multipath in ("none", "incoherent"):
            acoustics = replace(
                sg.Acoustics.ideal(), water=sg.Water(wind_speed_m_s=wind), multipath=multipath
            )
            with sg.Simulator(scene, SONAR, acoustics, tolerance=0.01) as simulator:
                totals[wind, multipath] = simulator.ping(pose).intensity.sum(dtype=np.float64)
    assert totals[None, "incoherent"] > 1.1 * totals[None, "none"]
    assert totals[3.0, "incoherent"] == totals[3.0, "none"] == totals[None, "none"]


def test_water_from_text_and_wrong_winds():
    assert sg.Water.parse("wind_speed_m_s=7").wind_speed_m_s == 7
    assert sg.Water().wave_height_m() == 0
    # facets are never smoother than at 1 m/s: a calm surface, which is a planar reflector, would scatter as well
    with pytest.raises(Error, match="leave it out for a calm surface"):
        sg.Water(wind_speed_m_s=0.0)
    with pytest.raises(Error, match="water: wind_speed_m_s must lie in 1"):
        sg.Water(wind_speed_m_s=-1.0)
    with pytest.raises(Error, match="wind_speed_m_s describes the water"):
        sg.Acoustics.physical(wind_speed_m_s=7.0)


def test_the_wind_of_a_ping_must_be_that_of_the_simulator_where_the_surface_may_reflect():
    calm = sg.Acoustics.physical(multipath="incoherent")
    with pytest.raises(Error, match="the wind must not change where there is multipath"):
        calm.in_water(WINDY)
    assert replace(calm, multipath="none").in_water(WINDY).water is WINDY


def test_the_reference_refuses_it():
    scene = sg.Scene([sg.Body("ball", trimesh.creation.icosphere(2), sg.pose(5, 0, 0))], surface_z_m=3.0)
    with pytest.raises(Error, match="the reference does not model the backscatter of the water's surface"):
        sg.reference_ping(scene, SONAR, np.eye(4), sg.Acoustics.physical(water=WINDY))
