"""Volume reverberation against closed forms: open water, walls, the water's surface, and the beams' patterns."""

import math
from dataclasses import replace

import numpy as np
import pytest
import trimesh

import sonar_gl as sg
from sonar_gl.core.errors import Error

SONAR = sg.Sonar("volume", 900e3, 24, 120, 40.0, 16.0, 2.0, 0.5, 12.5)
STRENGTH_DB = -40.0
LEVEL = math.pi * 1e-4 * SONAR.bin_size_m  # π s_v Δr: what open water reads with a range gain of 1
MURKY = sg.Water(volume_backscatter_db=STRENGTH_DB)


def ideal(**changes):
    return replace(sg.Acoustics.ideal(), water=MURKY, volume_reverberation=True, **changes)


def volume_of(scene, acoustics, sonar=SONAR, pose=None, **settings):
    """Return what volume reverberation adds to a ping without noise, (B, K) float64."""
    pose = np.eye(4) if pose is None else pose
    settings = {"tolerance": 0.01} | settings
    pings = []
    for is_on in (True, False):
        with sg.Simulator(
            scene, sonar, replace(acoustics, volume_reverberation=is_on), **settings
        ) as simulator:
            pings.append(np.float64(simulator.ping(pose).intensity))
    return pings[0] - pings[1]


def sphere(radius_m):
    return sg.Scene([sg.Body("sphere", trimesh.creation.icosphere(5, radius_m), reflectivity=1e-6)])


@pytest.mark.filterwarnings("ignore:no echo came back")
@pytest.mark.parametrize("beam_pattern", ["box", "line_array", "gaussian"])
@pytest.mark.parametrize("elevation_pattern", ["box", "line_array"])
def test_open_water_reads_its_strength_times_the_bin_whatever_the_beams(beam_pattern, elevation_pattern):
    found = volume_of(sg.Scene([]), ideal(beam_pattern=beam_pattern, elevation_pattern=elevation_pattern))
    np.testing.assert_allclose(found, LEVEL, rtol=1e-6)  # float32 weights


@pytest.mark.filterwarnings("ignore:no echo came back")
def test_it_has_the_range_gain_of_an_echo():
    """Transmission loss and TVG with k = 30 and an absorption other than the water's; ranges shown by another speed."""
    water = replace(MURKY, absorption_db_m=0.3, sound_speed_m_s=1450.0)
    settings = {"tvg_k": 30.0, "tvg_absorption_db_m": 0.2, "sonar_sound_speed_m_s": 1500.0}
    acoustics = ideal(range_law="sonar_equation", **settings)
    acoustics = replace(acoustics, water=water)
    r, scale = SONAR.range_m, 1500.0 / 1450.0
    level_db = 30 * np.log10(r) + 2 * 0.2 * r - 20 * np.log10(r / scale) - 2 * 0.3 * r / scale
    expected = LEVEL / scale * 10 ** (level_db / 10)  # bins are as much shorter in the water
    found = volume_of(sg.Scene([]), acoustics)
    np.testing.assert_allclose(found, np.broadcast_to(expected, found.shape), rtol=1e-6)  # float32


@pytest.mark.parametrize("engine", ["cpu", pytest.param("opengl", marks=pytest.mark.slow)])
def test_it_ends_at_a_wall(engine):
    """A sphere about the sonar: all before it, nothing behind; half a bin's worth where it is."""
    radius_m = SONAR.bin_edges_m[60] + 0.5 * SONAR.bin_size_m
    found = volume_of(sphere(radius_m), ideal(), engine=engine) / LEVEL
    np.testing.assert_allclose(found[:, :59], 1, rtol=1e-6)
    # the sum of float32 shares over the bins of the wall must come to 1 again: to their rounding
    np.testing.assert_allclose(found[:, 62:], 0, atol=1e-6)


@pytest.mark.filterwarnings("ignore:no echo came back")
def test_a_wall_before_the_first_bin_hides_all():
    found = volume_of(sphere(0.2), ideal()) / LEVEL
    np.testing.assert_allclose(found[:, 1:], 0, atol=1e-6)


def test_a_body_shadows_its_share_of_the_beams():
    """A plate covers the lower half of all beams from 6 m on; beyond, the upper half is left."""
    plate = trimesh.creation.box((0.02, 40.0, 10.0))
    scene = sg.Scene([sg.Body("plate", plate, sg.pose(6.0, 0.0, -5.0), reflectivity=1e-6)])
    found = volume_of(scene, ideal()) / LEVEL
    azimuth = SONAR.azimuth_rad
    for beam in (0, 8, 12, 23):
        # the plate's range over the beam and its elevations: 6 m / (cos azimuth cos elevation)
        near = 6.0 / math.cos(max(abs(azimuth[beam]) - math.radians(1.0), 0)) - 0.01
        far = 6.0 / math.cos(abs(azimuth[beam]) + math.radians(1.0)) / math.cos(math.radians(8.0))
        before, behind = SONAR.bin_edges_m[1:] < near, SONAR.bin_edges_m[:-1] > far
        np.testing.assert_allclose(found[beam, before], 1, rtol=1e-6)
        # samples have rows: the plate's level edge lies within a fraction of one
        np.testing.assert_allclose(found[beam, behind], 0.5, atol=0.01)


@pytest.mark.filterwarnings("ignore:no echo came back")
@pytest.mark.parametrize(("roll", "pitch", "beam"), [(0.0, 0.0, 12), (0.0, -0.3, 12), (0.6, 0.0, 20)])
@pytest.mark.parametrize("elevation_pattern", ["box", "line_array"])
def test_it_ends_at_the_surface_of_the_water(roll, pitch, beam, elevation_pattern):
    """The share of a beam's elevations below the surface, by quadrature over sines of elevation."""
    height_m = 0.6
    acoustics = ideal(elevation_pattern=elevation_pattern)
    pose = sg.pose(0, 0, 3.0 - height_m, roll, pitch)
    found = volume_of(sg.Scene([], surface_z_m=3.0), acoustics, pose=pose)
    top = math.radians(acoustics.elevation_support_deg(SONAR))
    sines = (np.arange(4001) + 0.5) / 4001 * 2 * math.sin(top) - math.sin(top)
    two_way = acoustics.two_way_elevation_pattern(SONAR)
    weight = np.ones_like(sines) if two_way is None else two_way(sines)
    azimuth, cosines = SONAR.azimuth_rad[beam], np.sqrt(1 - sines**2)
    # per metre of range
    rise = pose[2, :3] @ [cosines * math.cos(azimuth), cosines * math.sin(azimuth), sines]
    r = SONAR.range_m
    share = ((rise * r[:, None] < height_m) * weight).sum(1) / weight.sum()
    assert share.min() < 0.7
    # bins of 0.1 m near the sonar, samples of finite height: a few hundredths where the surface crosses the beam
    np.testing.assert_allclose(found[beam] / LEVEL, share, atol=0.03)
    assert abs((found[beam] / LEVEL - share).mean()) < 3e-3


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:no echo came back")
def test_the_transmit_beam_weakens_it_as_it_does_a_wall():
    sonar = replace(SONAR, transmit_width_deg=30.0)
    acoustics = ideal(transmit_beam=True, beam_pattern="line_array")
    found = volume_of(sg.Scene([]), acoustics, sonar)[:, 50]
    clear = replace(acoustics, volume_reverberation=False)
    with sg.Simulator(sphere(6.0), sonar, clear, tolerance=0.01) as simulator:
        echo = simulator.ping(np.eye(4)).intensity.sum(1, np.float64)
    # facets of the icosphere: cos θ differs from 1 by 5e-4, and samples of 0.01 tolerance
    np.testing.assert_allclose(found / found[12], echo / echo[12], rtol=2e-3)
    assert found[0] < 0.5 * found[12]


@pytest.mark.filterwarnings("ignore:no echo came back")
def test_bins_finer_than_the_pulse_read_the_level_of_its_cell():
    sonar = replace(SONAR, bandwidth_hz=4e3)
    found = volume_of(sg.Scene([]), ideal(pulse=True), sonar)
    kernel = ideal(pulse=True).pulse_weights(sonar)
    assert kernel.sum() > 2
    margin = len(kernel)
    np.testing.assert_allclose(found[:, margin:-margin], LEVEL * kernel.sum(), rtol=1e-6)


def test_bins_in_which_the_water_is_strongest_have_no_label():
    """Before, murkier water had more labels: it made bins bright in which nothing was seen of a body."""
    ball = sg.Body("ball", trimesh.creation.icosphere(3, 0.3), sg.pose(8, 0, 0), reflectivity=0.5)
    faint = sg.Body("faint", trimesh.creation.icosphere(3, 0.3), sg.pose(8, 2, 0), reflectivity=1e-5)
    scene, labels = sg.Scene([ball, faint]), {}
    for is_on in (True, False):
        acoustics = replace(ideal(), volume_reverberation=is_on)
        with sg.Simulator(scene, SONAR, acoustics, tolerance=0.01) as simulator:
            # all bins are labelled, however faint
            labels[is_on] = simulator.ping(np.eye(4), labels=True, label_level_db=-180.0)
    assert set(np.unique(labels[False].body_id)) == {0, 1, 2}
    assert set(np.unique(labels[True].body_id)) == {0, 1}
    own = labels[False].share * labels[False].intensity
    is_weaker = own < labels[True].intensity - labels[False].intensity
    np.testing.assert_array_equal(labels[True].body_id, np.where(is_weaker, 0, labels[False].body_id))
    gone = is_weaker & (labels[False].body_id == 1)
    assert gone.any() and not labels[True].share[gone].any()
    assert np.isnan(labels[True].elevation_rad[gone]).all()
    # sums of bodies and the labels of others are those of clear water
    np.testing.assert_array_equal(labels[True].body_echo, labels[False].body_echo)
    kept = labels[True].body_id == 1
    np.testing.assert_array_equal(labels[True].elevation_rad[kept], labels[False].elevation_rad[kept])


@pytest.mark.filterwarnings("ignore:no echo came back")
def test_it_is_off_in_clear_water_and_by_profile_and_the_water_of_a_ping_decides():
    assert sg.Acoustics.physical().volume_backscatter_db is None
    assert replace(sg.Acoustics.ideal(), water=MURKY).volume_backscatter_db is None
    acoustics = sg.Acoustics.physical(water=MURKY)
    assert acoustics.volume_backscatter_db == STRENGTH_DB
    with sg.Simulator(sg.Scene([]), SONAR, tolerance=0.05) as simulator:
        assert simulator.ping(np.eye(4)).intensity.max() == 0
        murky = simulator.ping(np.eye(4), water=MURKY)
        assert murky.intensity.min() > 0 and not murky.meta["has_echo"]
    with sg.Simulator(sg.Scene([]), SONAR, acoustics, tolerance=0.05) as simulator:
        np.testing.assert_array_equal(simulator.ping(np.eye(4)).intensity, murky.intensity)
        (of_sequence,) = simulator.pings([np.eye(4)])
        np.testing.assert_array_equal(of_sequence.intensity, murky.intensity)


def test_water_from_text_and_wrong_strengths():
    assert sg.Water.parse("volume_backscatter_db=-55").volume_backscatter_db == -55
    assert sg.Water.parse("volume_backscatter_db=none").volume_backscatter_db is None
    with pytest.raises(Error, match="water: volume_backscatter_db must lie in -200"):
        sg.Water(volume_backscatter_db=3.0)


def test_the_reference_refuses_it():
    with pytest.raises(Error, match="the reference does not model volume reverberation"):
        sg.reference_ping(sphere(5.0), SONAR, np.eye(4), sg.Acoustics.physical(water=MURKY))
