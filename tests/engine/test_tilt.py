"""A tilted head: the pings of a sonar are those of a level head at the pose that the tilt gives it, to the bit."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

import sonar_gl as sg
from sonar_gl.analysis.reference import reference_ping
from sonar_gl.embed.sensor import Sensor
from sonar_gl.ping import BIN_LABELS
from tests.support.casting import Cast, plane, sphere

LEVEL = sg.Sonar("test", 900e3, 48, 160, 60.0, 20.0, 1.5, 0.5, 16.0, bandwidth_hz=5e3)
TILTED = replace(LEVEL, tilt_deg=10.0)
TILT = sg.pose(pitch=np.radians(10.0))
SAMPLING = sg.Sampling(2, 30)
ACOUSTICS = sg.Acoustics.physical(pulse=True, multipath="incoherent", elevation_pattern="line_array")
NOISE = sg.Noise(speckle=True, follow_motion=True, self_noise=True)
# rolled, so that the tilt changes the heading of the head, too
POSES = [sg.pose(0.1 * k, 0.05 * k, -2.0, roll=0.3, pitch=-0.1, yaw=0.02 * k) for k in range(5)]
VELOCITY = np.array([2.0, 0.5, 0.3, 0.1, 0.2, 0.4])
LABELS = (*BIN_LABELS, "body_echo")


def scene() -> sg.Scene:
    """Return a floor, a box and a smooth ball beneath the water's surface, and a plume of bubbles."""
    ball = trimesh.creation.icosphere(3, 0.5)
    bodies = (
        sg.Body("floor", trimesh.creation.box((40, 40, 0.2)), sg.pose(8, 0, -4.1), 0.3),
        sg.Body("box", trimesh.creation.box((0.6, 0.8, 1.0)), sg.pose(6, 1.5, -2.5), 0.8),
        sg.Body("ball", ball, sg.pose(7, -1, -3), 0.6, 2 * ball.vertices, 0.3, 0.2),
    )
    return sg.Scene(
        [*bodies, sg.Bubbles("plume", sg.pose(9, 1, -3))], surface_z_m=-1.4, surface_roughness_m=0
    )


def check_same(tilted: sg.Ping, level: sg.Ping, pose) -> None:
    """Check that all arrays are identical, and that each ping has the pose that was asked for."""
    np.testing.assert_array_equal(tilted.intensity, level.intensity)
    for name in LABELS:
        np.testing.assert_array_equal(getattr(tilted, name), getattr(level, name))
    np.testing.assert_array_equal(tilted.pose, pose)
    np.testing.assert_array_equal(level.pose, pose @ TILT)
    assert tilted.intensity.any() and tilted.meta["sonar"]["tilt_deg"] == 10.0


@pytest.mark.parametrize("engine", ["cpu", pytest.param("opengl", marks=pytest.mark.slow)])
def test_a_tilted_head_sees_what_a_level_one_sees_at_its_pose(engine):
    settings = {"noise": NOISE, "labels": True, "background": ["floor"]}
    with (
        sg.Simulator(scene(), TILTED, ACOUSTICS, SAMPLING, 0.3, engine=engine) as tilted,
        sg.Simulator(tilted, LEVEL, ACOUSTICS, SAMPLING, 0.3) as level,
    ):
        in_head = (VELOCITY.reshape(2, 3) @ TILT[:3, :3]).ravel()
        for pose in POSES[:2]:
            check_same(
                tilted.ping(pose, time_s=3.0, velocity=VELOCITY, **settings),
                level.ping(pose @ TILT, time_s=3.0, velocity=in_head, **settings),
                pose,
            )
        moving = tilted.ping(POSES[0], velocity=VELOCITY)
        assert moving.meta["velocity"] == VELOCITY.tolist()  # of the housing, as it was given
        path = POSES[2:]
        several = tilted.pings(path, **settings), level.pings([pose @ TILT for pose in path], **settings)
        for pose, *pings in zip(path, *several, strict=True):
            check_same(*pings, pose)
        for one, other in zip(tilted.gbuffers(POSES[0]), level.gbuffers(POSES[0] @ TILT), strict=True):
            for name in vars(one):
                np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
        clouds = tilted.point_cloud(POSES[0], 40, 20), level.point_cloud(POSES[0] @ TILT, 40, 20)
        for one, other in zip(*clouds, strict=True):
            np.testing.assert_array_equal(one, other)
        pictures = sg.demarco_image(tilted, POSES[0], 1), sg.demarco_image(level, POSES[0] @ TILT, 1)
        np.testing.assert_array_equal(*pictures)


@pytest.mark.slow
def test_the_planner_chooses_the_samples_of_the_tilted_head():
    poses = [pose @ TILT for pose in POSES]
    with sg.Simulator(scene(), TILTED) as tilted, sg.Simulator(scene(), LEVEL) as level:
        assert tilted.plan(POSES) == level.plan(poses)
        assert tilted.sampling == level.sampling
        one, other = tilted.ping(POSES[1]), level.ping(poses[1])
    assert one.error_estimate == other.error_estimate is not None
    np.testing.assert_array_equal(one.intensity, other.intensity)


@pytest.mark.slow
def test_the_reference_is_that_of_the_tilted_head():
    bodies = sg.Scene(scene().bodies)
    settings = {"acoustics": sg.Acoustics.physical(bubbles=False), "error": 0.3, "max_rays": 1_000_000}
    one = reference_ping(bodies, TILTED, POSES[0], **settings)
    other = reference_ping(bodies, LEVEL, POSES[0] @ TILT, **settings)
    np.testing.assert_array_equal(one.intensity, other.intensity)
    np.testing.assert_array_equal(one.pose, POSES[0])


def test_a_floor_is_seen_where_the_head_points():
    """The axis of a head tilted by 10° meets a floor 2 m below at 2 m / sin 10°; that of a level head never."""
    floor = sg.Scene([sg.Body("floor", trimesh.creation.box((60, 60, 0.2)), sg.pose(0, 0, -2.1))])
    narrow = replace(TILTED, elevation_fov_deg=1.0)
    with sg.Simulator(floor, narrow, sg.Acoustics.ideal()) as simulator:
        ping = simulator.ping(sg.pose(), labels=True)
    lit_m = ping.range_m[ping.intensity[24] > 0]
    half, bin_m = np.radians(0.5), ping.bin_size_m
    assert lit_m[0] == pytest.approx(2 / np.sin(np.radians(10) + half), abs=bin_m)
    assert lit_m[-1] == pytest.approx(2 / np.sin(np.radians(10) - half), abs=bin_m)
    # elevations are those of the head
    assert np.nanmax(np.abs(ping.elevation_rad)) <= half


@pytest.mark.slow
def test_depth_images_are_in_the_axes_of_the_housing():
    """A level head is given the same pixels: cameras that cover the fan are tilted with the head."""
    pings = []
    for sonar, turn in ((TILTED, np.eye(3)), (LEVEL, TILT[:3, :3].T)):  # the level sonar sees a tilted world
        shapes = Cast(sphere(turn @ [6, 0.5, -1.0], 0.7), plane(turn @ [0, 0, -1.0], 2.0))
        cameras = sg.Camera.covering(sonar)
        depth = [shapes.images(camera)[1] for camera in cameras]
        with Sensor(sonar) as sensor:
            pings.append(sensor.ping_from_depth(depth, cameras, POSES[0]))
    tilted, level = (np.float64(ping.intensity) for ping in pings)
    np.testing.assert_array_equal(pings[0].pose, POSES[0])
    # the rays of the pixels differ by rounding, which may move a sample at an edge of a bin
    assert np.abs(tilted - level).sum() < 1e-3 * level.sum()
    assert level.sum() > 0


def test_a_level_camera_sees_part_of_a_tilted_fan():
    camera, depth = sg.Camera.of_fov(400, 100, fov_x_rad=1.2), np.full((100, 400), 5.0)
    with pytest.warns(UserWarning, match=r"elevations within ±10° of a head tilted 10° down are needed"):
        ping = sg.ping_from_depth(depth, TILTED, camera)
    assert ping.intensity.any()
