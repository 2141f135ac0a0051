"""Bodies of another size: a ping is that of a scene whose meshes have this size.

A power of two rounds nothing, so that all bits are the same; other factors differ by rounding.
"""

from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

import sonar_gl as sg
from sonar_gl.engine.body_extents import BodyExtents, greatest_lobe, sphere_about
from sonar_gl.engine.obstruction import is_unobstructed
from sonar_gl.engine.reception import Reception, reception_of
from sonar_gl.engine.replan_trigger import ReplanTrigger
from sonar_gl.raster import level_of_detail, scene_meshes
from sonar_gl.raster.opengl.sheets import draw_near, sheet_of
from sonar_gl.scene.primitives import INFINITE_PLANE_M
from sonar_gl.scene.state import SceneState
from tests.support.errors import error_of
from tests.support.worlds import terrain

SONAR = sg.Sonar("test", 900e3, 64, 200, 60.0, 20.0, 1.5, 0.5, 20.0)
SAMPLING = sg.Sampling(2, 40)
POSE = sg.pose(0.1, 0.2, 0, 0.05, 0.1, -0.1)
BALL, BOX = trimesh.creation.icosphere(3, 0.25), trimesh.creation.box((0.3, 0.4, 0.5))
BOX.apply_translation([0.1, 0.05, -0.2])  # its origin is not its middle
FINE = trimesh.creation.icosphere(5, 0.3)
GROUND = terrain(np.random.default_rng(1), 20.0, 0.5)
PATCHY = np.linspace(0.1, 1.0, 12)


def scaled(pose, scale):
    return pose @ np.diag([scale, scale, scale, 1.0])


def bodies(scale=1.0):
    """Return bodies that are so many times as large as their meshes here."""

    def body(name, mesh, pose, *values, **more):
        return sg.Body(name, mesh.copy().apply_scale(scale), pose, *values, **more)

    return [
        body("plain", BOX, sg.pose(6, 1.5), 0.8),
        body("smooth", BALL, sg.pose(8, -1, 0.3), 0.6, 4 * BALL.vertices, 0.3, 0.2),
        body("flat", BOX, sg.pose(5, -1.2, 0, 0.3, 0.2, 0.7), 0.5, None, 0.4, 0.05),
        body("patchy", BOX, sg.pose(7, 0.3, -0.5, yaw=0.4), PATCHY),
        body("fine", FINE, sg.pose(4, 0.6, -0.4), 0.7),
        body("wall", trimesh.creation.box((0.1, 3, 2)), sg.pose(12, -2, 0, yaw=0.3), 0.6),
        body("ground", GROUND, sg.pose(8, 0, -2.2), 0.4),
    ]


def placed(scale):
    return {body.name: scaled(body.pose, scale) for body in bodies()}


@cache
def own_levels():
    """Return name -> (body, its mesh with levels of detail), of the bodies in the size of their meshes here."""
    return {body.name: (body, level_of_detail.mesh_with_levels(body)) for body in bodies()}


def levels_of_size(body):
    """Return the levels of detail of a body, scaled; how a mesh is simplified depends on the bits of its vertices."""
    own, mesh = own_levels()[body.name]
    scale = np.float32(np.ptp(body.surface.vertices) / np.ptp(own.surface.vertices))
    names = {"error_m": scale, "box": scale, "moment": scale**2, "whole": scale**2}
    levels = replace(mesh.levels, **{name: getattr(mesh.levels, name) * by for name, by in names.items()})
    lengths = {
        name: getattr(mesh, name) * scale for name in ("centre", "bounds", "extremes", "radii", "points")
    }
    return replace(mesh, levels=levels, **lengths)


@pytest.fixture
def levels(monkeypatch):
    monkeypatch.setattr(level_of_detail, "MIN_FACES_TO_SIMPLIFY", 10_000)
    monkeypatch.setattr(scene_meshes, "mesh_with_levels", levels_of_size)


@pytest.fixture(params=["cpu", "opengl"])
def engine(request, monkeypatch):
    monkeypatch.setenv("SONAR_GL_ENGINE", request.param)


FIXED, ADAPTIVE = {"sampling": SAMPLING}, {"tolerance": 0.05}


# both engines draw both sizes; how samples are chosen does not depend on the engine
@pytest.mark.parametrize(
    ("engine", "settings", "scale"),
    [
        pytest.param("cpu", FIXED, 2.0, id="cpu-fixed-2.0"),
        pytest.param("cpu", ADAPTIVE, 0.5, id="cpu-adaptive-0.5"),
        pytest.param("opengl", FIXED, 2.0, id="opengl-fixed-2.0", marks=pytest.mark.slow),
        pytest.param("opengl", FIXED, 0.5, id="opengl-fixed-0.5"),
        pytest.param("cpu", FIXED, 0.5, id="cpu-fixed-0.5", marks=pytest.mark.slow),
        pytest.param("cpu", ADAPTIVE, 2.0, id="cpu-adaptive-2.0", marks=pytest.mark.slow),
        pytest.param("opengl", ADAPTIVE, 0.5, id="opengl-adaptive-0.5", marks=pytest.mark.slow),
        pytest.param("opengl", ADAPTIVE, 2.0, id="opengl-adaptive-2.0", marks=pytest.mark.slow),
    ],
    indirect=["engine"],
)
def test_a_body_twice_as_large_gives_the_bytes_of_a_mesh_that_is(levels, engine, settings, scale):
    acoustics = sg.Acoustics.physical(multipath="incoherent")
    more = {"labels": True, "background": ["ground"]}
    with (
        sg.Simulator(sg.Scene(bodies()), SONAR, acoustics, **settings) as one,
        sg.Simulator(sg.Scene(bodies(scale)), SONAR, acoustics, **settings) as other,
    ):
        got, expected = (one.ping(POSE, bodies=placed(scale), **more), other.ping(POSE, **more))
        one.place(placed(scale))
        again = one.ping(POSE, **more)
    assert set(np.unique(expected.body_id)) == set(range(8))
    for ping in (got, again):
        assert ping.meta == expected.meta
        for name in (
            "intensity",
            "body_id",
            "elevation_rad",
            "incidence_rad",
            "share",
            "shadow",
            "body_echo",
        ):
            np.testing.assert_array_equal(getattr(ping, name), getattr(expected, name), name)


def test_factors_that_round_give_the_same_ping_but_for_samples_on_edges(engine):
    """The engines have numbers of 24 bits, which put a sample in 10⁵ on the other side of an edge."""
    scale, acoustics = 1.3, sg.Acoustics.physical(multipath="incoherent")
    with (
        sg.Simulator(sg.Scene(bodies()), SONAR, acoustics, SAMPLING) as one,
        sg.Simulator(sg.Scene(bodies(scale)), SONAR, acoustics, SAMPLING) as other,
    ):
        got, expected = one.ping(POSE, bodies=placed(scale), labels=True), other.ping(POSE, labels=True)
    assert np.abs(got.intensity - expected.intensity).sum() < 1e-3 * expected.intensity.sum()
    assert (got.body_id != expected.body_id).mean() < 1e-3
    np.testing.assert_allclose(got.body_echo, expected.body_echo, rtol=2e-3)


def test_an_endless_floor_that_is_scaled_is_drawn_near_the_sonar(engine):
    """A rectangle that OpenGL cuts to what a sonar sees; a box about the sonar, inside which back faces count."""
    side_m = 2 * INFINITE_PLANE_M
    floor = trimesh.Trimesh(
        [[-side_m, -side_m, 0], [side_m, -side_m, 0], [side_m, side_m, 0], [-side_m, side_m, 0]],
        [[0, 1, 2], [0, 2, 3]],
    )
    room = trimesh.creation.box((60, 60, 12))

    def scene(scale):
        return sg.Scene(
            [
                sg.Body("floor", floor.copy().apply_scale(scale), sg.pose(0.5, 0, -1.2, 0.02)),
                sg.Body("room", room.copy().apply_scale(scale), sg.pose(0.5, 0.3, 0, yaw=0.2)),
            ]
        )

    acoustics = sg.Acoustics.ideal()
    for scale, seen in ((0.5, {1, 2}), (2.0, {1})):
        at = {body.name: scaled(body.pose, scale) for body in scene(1.0).bodies}
        with (
            sg.Simulator(scene(1.0), SONAR, acoustics, SAMPLING) as one,
            sg.Simulator(scene(scale), SONAR, acoustics, SAMPLING) as other,
        ):
            got, expected = one.ping(POSE, bodies=at, labels=True), other.ping(POSE, labels=True)
        assert set(np.unique(expected.body_id)) - {0} == seen
        np.testing.assert_array_equal(got.intensity, expected.intensity)
        np.testing.assert_array_equal(got.body_id, expected.body_id)


def test_a_sheet_is_cut_where_the_sonar_sees_it_whatever_its_scale():
    corners = np.array([[-1500, -1500, 0], [1500, -1500, 0], [1500, 1500, 0], [-1500, 1500, 0]], float)
    rows = []
    for mesh_scale, scale in ((1.0, 2.0), (2.0, 1.0)):
        mesh = trimesh.Trimesh(mesh_scale * corners, [[0, 1, 2], [0, 2, 3]], process=False)
        row = np.zeros(16, np.float32)
        draw_near(
            sheet_of(sg.Body("sheet", mesh)), scaled(sg.pose(5, 300, -1, 0.1, yaw=0.4), scale)[:3], 100.0, row
        )
        rows.append(row[:12].reshape(3, 4) * [mesh_scale, mesh_scale, mesh_scale, 1])
    assert rows[0].any()
    np.testing.assert_allclose(*rows, rtol=1e-6, atol=1e-6)  # float32


def test_what_a_body_may_return_at_most_is_that_of_its_size():
    acoustics = sg.Acoustics("ideal", specular=True)
    with sg.Simulator(sg.Scene([]), SONAR, acoustics, SAMPLING) as simulator:
        run = simulator.run
        reception = reception_of(run.sampler.resolution.stage.beamformer, 0.0, run.instrument.gain)
    for scale in (0.5, 2.0):
        poses = np.array([*placed(scale).values()])
        here, there = bodies(), bodies(scale)
        present = np.ones(len(here), bool)
        own = np.array([body.pose for body in there])
        got = BodyExtents(here, specular=True).greatest_echo(SceneState(poses, present), POSE, reception)
        expected = BodyExtents(there, specular=True).greatest_echo(SceneState(own, present), POSE, reception)
        assert expected[1:].all()
        np.testing.assert_array_equal(got, expected)


def test_the_lobe_in_view_is_that_of_the_place_of_scaled_faces():
    """A face half as large beside the sonar is met at larger angles alone."""
    reception = Reception(SONAR, 0.0, 0.2, False, np.ones(SONAR.n_bins), np.zeros(0), None)
    pose, found = sg.pose(3, -2, 0.1, yaw=0.3), {}
    for scale in (0.5, 1.0, 2.0):
        wall = trimesh.creation.box((0.1, 2, 2))
        here = sg.Body("wall", wall, pose, 0.0, None, 0.4, 0.3)
        there = sg.Body("wall", wall.copy().apply_scale(scale), pose, 0.0, None, 0.4, 0.3)
        found[scale] = greatest_lobe(here, scaled(pose, scale), np.eye(4), reception)
        assert found[scale] == greatest_lobe(there, pose, np.eye(4), reception)
    assert 0 < found[0.5] < found[1.0]


def test_a_small_body_that_no_sample_meets_is_found_by_its_size():
    """Its sphere reaches into the fan, and its edges do, once it is four times as large."""
    wall = sg.Body("wall", trimesh.creation.box((0.2, 60, 60)), sg.pose(12))
    rod = sg.Body("rod", trimesh.creation.box((0.004, 1.0, 0.004)), sg.pose(8, 6.0))
    with sg.Simulator(sg.Scene([wall]), SONAR, sg.Acoustics.ideal(), sg.Sampling(20, 8)) as simulator:
        stage = simulator.run.sampler.resolution.stage
        with simulator.run.drawing():
            (view,) = stage.draw([np.eye(4)], [None], with_bodies=True)
            more = np.eye(4), reception_of(stage.beamformer, 0.0, simulator.run.instrument.gain)
            sphere = sphere_about(rod.surface.vertices)
            found = [
                is_unobstructed(view.sectors, 2, rod, sphere, scaled(rod.pose, scale), *more)
                for scale in (1.0, 4.0)
            ]
    assert found == [False, True]


@pytest.mark.parametrize(
    ("before", "after", "turn_rad", "is_far"),
    [
        (1.0, 1.0, 0.0, False),
        (1.0, 1.3, 0.0, False),
        (1.0, 1.5, 0.0, True),  # more than twice the area
        (1.5, 1.0, 0.0, True),
        (20.0, 20.0, 0.0, False),
        (20.0, 21.0, 0.1, False),
        (20.0, 20.0, 0.5, True),
        (0.05, 0.05, 0.1, False),
    ],
)
def test_a_body_has_changed_much_once_its_area_has_doubled(before, after, turn_rad, is_far):
    trigger = ReplanTrigger(SONAR, lambda state: np.ones(1))
    states = [
        SceneState(scaled(sg.pose(6, yaw=yaw), scale)[None], np.ones(1, bool))
        for scale, yaw in ((before, 0.3), (after, 0.3 + turn_rad))
    ]
    one, other = (SimpleNamespace(head_pose=POSE, state=state) for state in states)
    assert trigger.is_far(one, other) == is_far


@pytest.mark.parametrize(
    ("scale", "reflectivity", "is_far"),
    [
        (1.0, 0.6, False),
        (1.5, 0.6, True),  # 2.25 times the area
        (1.5, 0.4, False),  # 1.8 times the echo
        (1.3, 0.6, True),  # 1.69 times the area, 2.03 times the echo
        (0.8, 0.35, True),
    ],
)
def test_a_body_has_changed_much_once_its_area_times_its_reflectivity_has_doubled(
    scale, reflectivity, is_far
):
    trigger = ReplanTrigger(SONAR, lambda state: state.reflectivity)
    states = [
        SceneState(scaled(sg.pose(6), scale)[None], np.ones(1, bool), reflectivity=np.array([mu]))
        for scale, mu in ((1.0, 0.5), (scale, reflectivity))
    ]
    one, other = (SimpleNamespace(head_pose=POSE, state=state) for state in states)
    assert trigger.is_far(one, other) == is_far
    assert trigger.is_far(other, one) == is_far


def test_a_model_is_scaled_as_a_whole_and_its_bubbles_keep_their_size():
    tail = sg.Body("fish::tail", BOX, sg.pose(6.5, 1.0, 0.1, yaw=0.2), 0.8)
    body = sg.Body("fish::body", BALL, sg.pose(6, 1.0, 0.1), 0.8)
    plume = sg.Bubbles("fish::breath", sg.pose(6, 1.0, 0.5))
    home = sg.pose(6, 1)
    scene = sg.Scene([tail, body, plume], models={"fish": home})
    larger = scaled(sg.pose(7, 0.5, yaw=0.3), 1.5)
    there = larger @ np.linalg.inv(home)
    breath = there @ plume.pose
    breath[:3, :3] /= 1.5
    one_by_one = {tail.name: there @ tail.pose, body.name: there @ body.pose, plume.name: breath}
    with sg.Simulator(scene, SONAR, sg.Acoustics.physical(multipath="none"), SAMPLING) as simulator:
        got = simulator.ping(POSE, bodies={"fish": larger}, time_s=2.0)
        np.testing.assert_array_equal(
            got.intensity, simulator.ping(POSE, bodies=one_by_one, time_s=2.0).intensity
        )
        assert (got.intensity != simulator.ping(POSE, time_s=2.0).intensity).any()


@pytest.mark.parametrize("part", ["fish", "fish::body", "fish::breath"])
def test_any_scale_near_1_is_one(part):
    """Scales that are drawn, as in a batch, come as near to 1 as may be."""
    scene = sg.Scene(
        [sg.Body("fish::body", BOX, sg.pose(6, 1)), sg.Bubbles("fish::breath", sg.pose(6, 1, 0.5))],
        models={"fish": sg.pose(6, 1)},
    )
    with sg.Simulator(scene, SONAR, sampling=SAMPLING) as simulator:
        for power in np.arange(-7, -3, 0.1):
            for sign in (-1, 1):
                simulator.place({part: scaled(sg.pose(6, 1, 0, 0.3, 0.2, 0.1), 1 + sign * 10**power)})


def test_of_bodies_in_one_plane_that_reflects_which_is_the_largest_in_the_ping():
    large, small = (trimesh.creation.box((side_m, side_m, 0.5)) for side_m in (4.0, 3.0))
    for mesh in (large, small):
        mesh.apply_translation([0, 0, -0.25])  # a scale leaves its upper side in the plane
    beside = sg.Body("beside", large, sg.pose(3, -3.5, -1), 0.1)
    ball = sg.Body("ball", BALL, sg.pose(6, 0.5, 0.3))
    pose = sg.pose(3, 2, -1)
    twice = small.copy().apply_scale(2.0)
    scenes = [sg.Scene([beside, ball, sg.Body("floor", mesh, pose, 0.9)]) for mesh in (small, twice)]
    acoustics = sg.Acoustics.physical(multipath="incoherent")
    with (
        sg.Simulator(scenes[0], SONAR, acoustics, SAMPLING) as one,
        sg.Simulator(scenes[1], SONAR, acoustics, SAMPLING) as other,
    ):
        got, expected = one.ping(POSE, bodies={"floor": scaled(pose, 2.0)}), other.ping(POSE)
    np.testing.assert_array_equal(got.intensity, expected.intensity)


@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        (np.diag([2.0, 2.0, 1.0, 1.0]), "the pose of body 'b' must be a rotation"),
        (np.diag([-2.0, 2.0, 2.0, 1.0]), "the pose of body 'b' must be a rotation"),
        (np.diag([0.0, 0.0, 0.0, 1.0]), "the pose of body 'b' must scale by 0.001..1000 (got 0;"),
        (np.diag([1e4, 1e4, 1e4, 1.0]), "the pose of body 'b' must scale by 0.001..1000 (got 10000;"),
    ],
)
def test_a_pose_that_stretches_a_body_is_refused(matrix, message):
    with sg.Simulator(sg.Scene([sg.Body("b", BOX)]), SONAR, sampling=SAMPLING) as simulator:
        assert error_of(simulator.ping, POSE, bodies={"b": matrix}).startswith(message)
        assert error_of(simulator.place, {"b": matrix}).startswith(message)
