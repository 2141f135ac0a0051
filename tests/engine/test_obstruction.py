"""Bodies that few samples met, or none: hidden behind others, out of the fan, or between the samples."""

import math
import warnings
from dataclasses import replace

import numpy as np
import pytest
import trimesh

import sonar_gl as sg
from sonar_gl.engine import obstruction
from sonar_gl.engine.body_extents import sphere_about
from sonar_gl.engine.obstruction import is_unobstructed
from sonar_gl.sonar.sampling import sampling_at
from tests.support.counted_samples import count_samples, reception_of
from tests.support.sampled_scenes import IDEAL, SONAR, ball


@pytest.mark.parametrize("distance_m, is_seen", [(8.0, True), (10.0, False)])
def test_a_body_that_few_samples_met_is_not_hidden_by_them(distance_m, is_seen):
    """Each of its vertices lies beside such a sample; behind a wall all lie behind others."""
    bodies = [
        sg.Body("wall", trimesh.creation.box((0.2, 30, 30)), sg.pose(9)),
        ball(distance_m, radius=0.1, name="small"),
    ]
    with sg.Simulator(sg.Scene(bodies), SONAR, IDEAL, sampling_at(SONAR, 0)) as simulator:
        stage = simulator.run.sampler.resolution.stage
        assert (0 < count_samples(simulator)[2] < 8) == is_seen
        with simulator.run.drawing():
            (view,) = stage.draw([np.eye(4)], [None], with_bodies=True)
            sphere = sphere_about(bodies[1].surface.vertices)
            arguments = sphere, bodies[1].pose, np.eye(4), reception_of(stage.beamformer, SONAR)
            assert is_unobstructed(view.sectors, 2, bodies[1], *arguments) == is_seen


def is_seen_before_a_wall(sonar, body, *drawn, wall_m=12.0, surface_z_m=None):
    """Return whether a body is taken for visible; the samples are those of a wall and of what else is drawn."""
    wall = sg.Body("wall", trimesh.creation.box((0.2, 60, 60)), sg.pose(wall_m))
    with sg.Simulator(sg.Scene([wall, *drawn]), sonar, IDEAL, sg.Sampling(20, 8)) as simulator:
        stage = simulator.run.sampler.resolution.stage
        with simulator.run.drawing():
            (view,) = stage.draw([np.eye(4)], [None], with_bodies=True)
            sphere = sphere_about(body.surface.vertices)
            arguments = sphere, body.pose, np.eye(4), reception_of(stage.beamformer, sonar), surface_z_m
            return is_unobstructed(view.sectors, 2, body, *arguments)


GAPS = replace(SONAR, n_beams=6, beam_width_deg=1.0)  # 7.5 degrees apart
SLIVER = trimesh.Trimesh([[0, -0.55, 0], [0, 0.55, 0], [0, 0.55, 0.004]], [[0, 1, 2]])


@pytest.mark.parametrize(
    "sonar, mesh, place",
    [
        pytest.param(SONAR, trimesh.creation.box((0.004, 4000, 0.004)), sg.pose(8, 137), id="beside the fan"),
        pytest.param(
            SONAR, trimesh.creation.box((0.004, 0.004, 4000)), sg.pose(8, 0, 137), id="above and below"
        ),
        pytest.param(
            SONAR,
            trimesh.creation.box((4000, 0.004, 0.004)),
            sg.pose(8, 0.3, 0, 0, 0, 0.02),
            id="out of range",
        ),
        pytest.param(GAPS, SLIVER, sg.pose(8, 8 * math.tan(math.radians(5))), id="between beams"),
    ],
)
def test_a_thin_body_that_no_sample_met_is_seen_between_its_vertices(sonar, mesh, place):
    """All of its vertices lie where no beam receives."""
    rod = sg.Body("rod", mesh, place)
    assert is_seen_before_a_wall(sonar, rod)
    assert not is_seen_before_a_wall(sonar, rod, wall_m=0.6)  # before the rod


def test_a_thin_body_between_two_beams_is_not_seen():
    upright = sg.Body("rod", trimesh.creation.box((0.004, 0.004, 40)), sg.pose(8))
    assert is_seen_before_a_wall(SONAR, upright)
    assert not is_seen_before_a_wall(GAPS, upright)


@pytest.mark.parametrize(("range_m", "is_seen"), [(19.5, True), (20.5, False)])
def test_a_thin_body_in_a_corner_of_the_sector_is_seen_within_the_range(range_m, is_seen):
    """At 21 degrees; both lie ahead by less than the range of 20 m."""
    place = sg.pose(yaw=math.radians(21)) @ sg.pose(range_m)
    rod = sg.Body("rod", trimesh.creation.box((0.004, 0.004, 1.0)), place)
    assert is_seen_before_a_wall(SONAR, rod, wall_m=60.0) == is_seen


def test_points_lie_on_the_held_parts_of_all_edges():
    """Between x = 0 and 4, and below the water."""
    slab, sea = [[1.0, 0, 0, 0], [-1, 0, 0, 4]], [[0, 0, -1.0, 3]]

    def points(*edges, planes=slab):
        return obstruction.points_within(np.array(planes, np.float64), np.array(edges, np.float64))

    across = points([[-3, 1, 2], [9, 1, 2]])
    np.testing.assert_allclose(across, np.stack([np.arange(256) / 64, np.ones(256), np.full(256, 2.0)], 1))
    back = points([[3, 0, 0], [-5, 8, 0]])
    assert back[0].tolist() == [3, 0, 0] and back[-1] == pytest.approx([3 / 256, 3 - 3 / 256, 0])
    wet = points([[1, 0, 4], [3, 0, 0]], planes=slab + sea)
    assert wet[:, 0].min() == pytest.approx(1.5) and wet[:, 0].max() > 2.99
    # it enters the water before the slab, and leaves it after the slab
    entered = points([[-1, 0, 4], [3, 0, -6]], planes=slab + sea)
    left = points([[3, 0, -6], [-1, 0, 4]], planes=slab + sea)
    assert entered[:, 0].min() == 0 and left[:, 0].min() == pytest.approx(3 / 256)
    both = points(*[[[-1, y, 0], [5, y, 0]] for y in (0, 1)])
    assert len(both) == 256 and not set(both[both[:, 1] == 0, 0]) & set(both[both[:, 1] == 1, 0])
    many = points(*[[[1, y, 0], [2, y, 0]] for y in range(1000)])
    assert 200 < len(many) <= 256 and max(np.diff(np.unique(many[:, 1]))) <= 4 and many[:, 1].max() > 990
    assert not len(points([[5, 0, 0], [9, 0, 0]])) and not len(points([[-5, 0, 0], [-1, 9, 0]]))


@pytest.mark.parametrize("azimuth_deg", [-150, 30, 90])
def test_edges_are_cut_for_the_sector_that_holds_the_body_alone(azimuth_deg, monkeypatch):
    """A fan of six sectors, and a body in the middle of one: to cut a thousand bodies for all took seconds."""
    round_about = replace(SONAR, n_beams=360, azimuth_fov_deg=359.0, beam_width_deg=1.0)
    cut, cut_edges = [], obstruction.points_within
    monkeypatch.setattr(obstruction, "points_within", lambda *args: cut.append(1) or cut_edges(*args))
    place = sg.pose(yaw=math.radians(azimuth_deg)) @ sg.pose(8)
    is_seen_before_a_wall(round_about, sg.Body("ball", trimesh.creation.icosphere(2, 0.6), place))
    assert len(cut) == 1


@pytest.mark.parametrize("inside_m, is_seen", [(0.001, False), (0.5, True)])
def test_a_body_of_which_an_edge_reaches_into_the_fan_is_not_looked_for(inside_m, is_seen):
    """Samples beside the fan meet it: it does not lie between them, and ever finer ones found as little of it."""
    edge = 8 * math.tan(SONAR.azimuth_rad.max() + math.radians(SONAR.beam_width_deg / 2))
    sheet = sg.Body("sheet", trimesh.creation.box((1e-4, 3, 10)), sg.pose(8, edge + 1.5 - inside_m))
    assert is_seen_before_a_wall(SONAR, sheet, sheet) == is_seen


@pytest.mark.parametrize("surface_z_m, is_seen", [(None, True), (1.3, True), (1.0, False), (-1.0, True)])
def test_only_a_sonar_in_the_water_does_not_see_what_is_above(surface_z_m, is_seen):
    rod = sg.Body("rod", trimesh.creation.box((0.004, 0.004, 0.3)), sg.pose(8, 0, 1.25))
    assert is_seen_before_a_wall(SONAR, rod, surface_z_m=surface_z_m) == is_seen


@pytest.mark.parametrize("mesh", [trimesh.creation.box((1, 1, 1)), trimesh.creation.icosphere(3, 0.4)])
def test_a_body_in_the_place_of_another_needs_no_finer_samples(mesh):
    """Its corners lie beside samples of the other, before the empty water: it was taken for one not met yet."""
    bodies = [sg.Body(name, mesh, sg.pose(6, 0.2)) for name in ("one", "again")]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = []
        for present in (bodies, bodies[:1]):
            with sg.Simulator(sg.Scene(present), SONAR, IDEAL, tolerance=0.05) as simulator:
                found.append(simulator.ping(np.eye(4)))
    both, one = found
    assert both.meta["sampling"] == one.meta["sampling"]
    np.testing.assert_array_equal(both.intensity, one.intensity)


@pytest.mark.parametrize("azimuth_rad", [0.0, 0.4])
def test_a_small_body_at_the_border_of_two_sectors_is_not_missed(azimuth_rad):
    """Samples of both sectors met it beyond the border, where they do not count: the ping had no echo and no error."""
    wide = replace(SONAR, n_beams=65, n_bins=450, azimuth_fov_deg=64.0, beam_width_deg=1.2, range_max_m=46.0)
    wide = replace(wide, elevation_fov_deg=15.0)
    place = sg.pose(20 * math.cos(azimuth_rad), 20 * math.sin(azimuth_rad))
    body = sg.Body("ball", trimesh.creation.icosphere(3, 0.02), place)
    echoes = []
    for sampling in (None, sg.Sampling(300, 4600)):
        with sg.Simulator(sg.Scene([body]), wide, IDEAL, sampling, tolerance=0.05) as simulator:
            echoes.append(simulator.ping(np.eye(4)).intensity.sum())
    # the promise for the echo of a body: five times the tolerance
    assert echoes[0] == pytest.approx(echoes[1], rel=0.25)
