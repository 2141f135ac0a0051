"""Pings of scenes that differ in a known way: relations that hold whatever the echo is.

The scene has what is aligned on purpose: faces at edges of bins and of beams, along rays, and through the sonar.
"""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

import sonar_gl as sg

HERE = np.eye(4)
IDEAL = sg.Acoustics.ideal()
# without what has a length of its own
BARE = sg.Acoustics.physical(range_law="constant", pulse=False)
SONAR = sg.Sonar("aligned", 900e3, 8, 16, 90.0, 30.0, 11.25, 0.5, 8.5, transmit_width_deg=60.0)
ARRAY = replace(SONAR, beam_spacing="sine", steered="straight")
FAMILIES = [
    pytest.param(SONAR, IDEAL, sg.Sampling(4, 32), id="boxes"),
    pytest.param(SONAR, IDEAL, sg.Sampling(4, 32, "point"), id="points"),
    pytest.param(SONAR, BARE, sg.Sampling(4, 32), id="upright"),
    pytest.param(ARRAY, BARE, sg.Sampling(4, 32), id="cones"),
    pytest.param(replace(SONAR, azimuth_fov_deg=360.0), BARE, sg.Sampling(4, 32), id="all round"),
]
families = pytest.mark.parametrize("sonar, acoustics, sampling", FAMILIES)


def sheet(corners):
    return trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False)


def aligned_bodies(scale=1.0, mu=1.0):
    """Return bodies with corners at whole eighths of `scale` metres, and `mu` times their reflectivity."""
    ray = np.array([[1, 1, -1], [5, 5, -1], [5, 5, 1], [1, 1, 1]]) * 0.5  # at 45°, a border of the fan
    level = np.array([[-1, -3, 0], [3, -3, 0], [3, -1, 0], [-1, -1, 0]])
    meshes = {
        "box": (
            trimesh.creation.box((1, 2, 2)),
            sg.pose(4.0, 1.0, -1.0),
        ),  # a face at 3.5 m, one along the boresight
        "ball": (trimesh.creation.icosphere(1, 0.5), sg.pose(8.0, -1.0, 0.0)),  # in the last bins
        "ray": (sheet(ray), sg.pose()),
        "level": (sheet(level), sg.pose()),
        "floor": (trimesh.creation.box((64, 64, 1)), sg.pose(0, 0, -2.0)),
    }
    bodies = []
    for name, (mesh, pose) in meshes.items():
        pose = pose.copy()
        pose[:3, 3] *= scale
        scaled = trimesh.Trimesh(np.asarray(mesh.vertices) * scale, mesh.faces, process=False)
        bodies.append(sg.Body(name, scaled, pose, 0.5 * mu))
    return bodies


def ping(bodies, sonar, acoustics, sampling, pose=HERE, **more):
    with sg.Simulator(sg.Scene(bodies), sonar, acoustics, sampling) as simulator:
        return simulator.ping(pose, labels=True, **more)


@families
def test_the_order_of_bodies_gives_their_numbers_alone(sonar, acoustics, sampling):
    bodies = aligned_bodies()
    one = ping(bodies, sonar, acoustics, sampling)
    other = ping(bodies[::-1], sonar, acoustics, sampling)
    numbers = np.r_[0, np.arange(len(bodies), 0, -1)]
    np.testing.assert_array_equal(one.intensity, other.intensity)
    np.testing.assert_array_equal(one.body_id, numbers[other.body_id])
    np.testing.assert_allclose(one.body_echo, other.body_echo[numbers], rtol=1e-6)  # float32
    assert len(np.unique(one.body_id)) >= 3


@families
def test_twice_the_reflectivity_is_twice_the_echo(sonar, acoustics, sampling):
    """To the bit, since the factor is a power of two: nothing is added to an echo, and none is cut off."""
    one = ping(aligned_bodies(mu=0.5), sonar, acoustics, sampling)
    other = ping(aligned_bodies(), sonar, acoustics, sampling)
    np.testing.assert_array_equal(2 * one.intensity, other.intensity)
    np.testing.assert_array_equal(2 * one.body_echo, other.body_echo)


@families
@pytest.mark.parametrize("scale", [0.5, pytest.param(2.0, marks=pytest.mark.slow)])
def test_a_world_of_another_size_has_the_same_picture(sonar, acoustics, sampling, scale):
    """To the bit, since the factor is a power of two: no length is stated anywhere."""
    ranges = {"range_min_m": sonar.range_min_m * scale, "range_max_m": sonar.range_max_m * scale}
    one = ping(aligned_bodies(), sonar, acoustics, sampling)
    other = ping(aligned_bodies(scale), replace(sonar, **ranges), acoustics, sampling)
    np.testing.assert_array_equal(one.intensity, other.intensity)
    np.testing.assert_array_equal(one.body_id, other.body_id)
    np.testing.assert_array_equal(one.true_range_m * np.float32(scale), other.true_range_m)


@families
def test_a_world_that_is_elsewhere_has_the_same_picture(sonar, acoustics, sampling):
    """To the bit, since float64 holds these places exactly."""
    away = sg.pose(1024.0, -96.0, 8.0)
    moved = [replace(body, pose=away @ body.pose) for body in aligned_bodies()]
    one, other = (
        ping(bodies, sonar, acoustics, sampling, pose)
        for bodies, pose in ((aligned_bodies(), HERE), (moved, away))
    )
    np.testing.assert_array_equal(one.intensity, other.intensity)
    np.testing.assert_array_equal(one.body_id, other.body_id)


@families
def test_bodies_behind_a_closed_wall_change_nothing(sonar, acoustics, sampling):
    shell = sg.Body("shell", trimesh.creation.box((1.5, 1.5, 1.5)), HERE, 0.5)
    bodies = [body for body in aligned_bodies() if body.name in ("box", "ball", "floor")]
    one = ping([shell], sonar, acoustics, sampling)
    other = ping([shell, *bodies], sonar, acoustics, sampling)
    np.testing.assert_array_equal(one.intensity, other.intensity)
    np.testing.assert_array_equal(one.body_id, other.body_id)
    assert one.intensity.any() and not other.body_echo[2:].any()


@families
def test_two_bins_are_one_of_twice_the_length(sonar, acoustics, sampling):
    """In beams without a pattern in elevation, which slants footprints that are longer than a bin."""
    acoustics = replace(acoustics, elevation_pattern="box")
    fine = ping(aligned_bodies(), sonar, acoustics, sampling).intensity.astype(float)
    coarse = ping(aligned_bodies(), replace(sonar, n_bins=8), acoustics, sampling).intensity.astype(float)
    pairs = fine[:, ::2] + fine[:, 1::2]
    # ramps at the ends of a footprint are left out where they are short for the bins; float32
    assert np.abs(pairs - coarse).sum() <= 3e-5 * coarse.sum()


@families
def test_the_echo_of_the_water_does_not_depend_on_reflectivity(sonar, acoustics, sampling):
    """Bodies hide the water behind them, black ones, too. Scenes end at the water's surface."""
    water = sg.Water(volume_backscatter_db=-20.0, wind_speed_m_s=5.0)
    windy = replace(acoustics, volume_reverberation=True, surface_reverberation=True)
    black = [replace(body, reflectivity=0.0) for body in aligned_bodies()]

    def echo(bodies, **more):
        with sg.Simulator(sg.Scene(bodies, surface_z_m=1.0), sonar, windy, sampling) as simulator:
            return simulator.ping(HERE, **more).intensity.astype(float)

    of_water, all_of_it = echo(black, water=water), echo(aligned_bodies(), water=water)
    assert not echo(black).any() and of_water.any()
    np.testing.assert_allclose(all_of_it - echo(aligned_bodies()), of_water, atol=2**-23 * all_of_it.max())
