"""The bundled harbour: what it is made of, and what a sonar in its basin sees of it."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

import sonar_gl as sg

BODIES = {
    "floor": "medium_silt",
    "quay": "concrete",
    "fender": "wet_wood",
    "steps": "corroded_steel",
    **{f"pile_{k}": "corroded_steel" if k == 4 else "steel" for k in range(1, 8)},
    "rubble": "rock",
    "tyre_flat": "rubber",
    "tyre_leaning": "rubber",
    "sinker": "concrete",
    "buoy": "steel",
    "chain": "corroded_steel",
    "slack_chain": "corroded_steel",
}
ASIDE = {"pile_1", "pile_2", "pile_6", "pile_7"}  # of the berth's piles a fan of 45 degrees sees three


@pytest.fixture(scope="module")
def scene():
    return sg.load_scene("harbour")


@pytest.fixture(scope="module")
def simulator(scene):
    with sg.Simulator(scene, sg.load_sonar("p900-45").with_range(18.0)) as simulator:
        yield simulator


@pytest.fixture(scope="module")
def ping(scene, simulator):
    """Without noise, with labels."""
    return simulator.ping(scene.sonar_pose, labels=True)


def bins_of(scene, ping, name):
    """Return where a body is the strongest in a bin, as (B, K) bool."""
    return ping.body_id == 1 + [body.name for body in scene.bodies].index(name)


def test_bodies_and_materials(scene):
    assert {body.name: body.material for body in scene.bodies} == BODIES
    assert scene.n_triangles < 5000
    assert (scene.surface_z_m, scene.surface_roughness_m) == (0.0, 0.002)


def test_the_floor_alone_has_a_texture(scene):
    assert {body.name: body.speckle_shape for body in scene.bodies if body.speckle_shape} == {"floor": 2.0}


def test_bodies_stand_on_the_floor_or_hang_from_the_surface(scene):
    """The floor is 9 m deep; nothing hovers but the chain, which ends at the buoy and at its block."""
    (floor,) = (body for body in scene.bodies if body.name == "floor")
    assert floor.pose[2, 3] == -9.0
    for body in scene.bodies[1:]:
        z = (body.pose[:3, :3] @ np.asarray(body.mesh.vertices).T)[2] + body.pose[2, 3]
        if body.name == "buoy":
            assert z.min() < 0 < z.max()
        elif body.name == "chain":
            assert -9 < z.min() < -8.4 and z.max() > -0.7  # within the block, and within the buoy
        elif body.name == "steps":
            assert -8 < z.min() < -6 and z.max() > 0
        else:
            assert z.min() <= -9, body.name


@pytest.mark.slow
def test_all_bodies_in_the_fan_are_seen(scene, ping):
    seen = {scene.bodies[number - 1].name for number in np.unique(ping.body_id) if number}
    assert seen == set(BODIES) - ASIDE
    assert ping.error_estimate <= 0.01


def test_stones_lie_on_the_silt_or_on_each_other(scene):
    (rubble,) = (body for body in scene.bodies if body.name == "rubble")
    stones = trimesh.Trimesh(rubble.mesh.vertices, rubble.mesh.faces).split()
    assert len(stones) == 48
    heights = np.array([stone.bounds[:, 2] for stone in stones]) + 9.0
    assert (heights[:, 1] > 0.1).all()
    assert (heights[:, 0] < 0).sum() == 34 and heights[:, 0].max() < 0.35


def test_wall_and_piles_are_bright_and_silt_is_dim(scene, ping):
    own = ping.share * ping.intensity  # side lobes of the wall lie over what is before it

    def level_db(name):
        return 10 * np.log10(np.median(own[bins_of(scene, ping, name)]))

    silt = level_db("floor")
    for name in ("quay", "pile_3", "pile_4", "pile_5", "rubble", "sinker", "chain"):
        assert level_db(name) > silt + 10, name
    # rubber and wet wood reflect little: the tyre is a faint ring, the fender's posts gaps in the wall's line
    assert silt < level_db("tyre_flat") < silt + 5
    assert level_db("fender") < level_db("quay") - 5


def test_the_wall_is_a_slanted_line(scene, ping):
    """Its brightest bins lie where level rays meet its face, which is turned by 0.2 rad, 13.5 m ahead."""
    wall = np.where(bins_of(scene, ping, "quay"), ping.intensity, 0)
    expected_m = 13.5 * np.cos(0.2) / np.cos(ping.azimuth_rad + 0.2)
    off_m = ping.range_m[wall.argmax(axis=1)] - expected_m
    assert np.mean(np.abs(off_m) < 0.05) > 0.7  # two bins; the others are where piles and posts hide it
    assert np.abs(off_m).max() < 0.5


@pytest.mark.slow
def test_silt_speckles_more_than_a_floor_without_texture(scene, simulator, ping):
    """The contrast is sqrt(1 + 2/2) where nothing but silt echoes, and 1 without texture."""
    silt = bins_of(scene, ping, "floor") & (ping.range_m < 7.0)
    bodies = [replace(body, speckle_shape=None) for body in scene.bodies]
    contrasts = []
    with sg.Simulator(sg.Scene(bodies, scene.sonar_pose), simulator.sonar) as other:
        for one in (simulator, other):
            pings = [one.ping(scene.sonar_pose, sg.Noise(speckle=True), seed).intensity for seed in range(6)]
            contrasts.append(np.std([speckled[silt] / ping.intensity[silt] for speckled in pings]))
    # some 2000 cells a ping: the variance of the K distribution is found to 5 % by six
    assert contrasts == pytest.approx([np.sqrt(2), 1.0], rel=0.05)


def test_nothing_in_the_basin_is_a_planar_reflector(scene, simulator):
    """Concrete and silt are rough, and so is the surface: multipath changes nothing."""
    acoustics = sg.Acoustics.physical(multipath="incoherent")
    with sg.Simulator(scene, simulator.sonar, acoustics, simulator.sampling) as other:
        reflected = other.ping(scene.sonar_pose).intensity
    with sg.Simulator(scene, simulator.sonar, sampling=simulator.sampling) as other:
        np.testing.assert_array_equal(reflected, other.ping(scene.sonar_pose).intensity)
