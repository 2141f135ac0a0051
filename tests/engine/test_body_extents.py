"""What bodies could return at most, by their place, their size and their lobe."""

import math
import warnings
from dataclasses import replace

import numpy as np
import pytest
import trimesh

import sonar_gl as sg
from sonar_gl.analysis.verify import ping_error
from sonar_gl.engine.body_counts import count_bodies
from sonar_gl.engine.body_extents import (
    BodyExtents,
    glint_share,
    greatest_gain,
    greatest_lobe,
    greatest_pattern,
    sphere_about,
)
from sonar_gl.engine.reception import Reception
from sonar_gl.scene.state import SceneState
from sonar_gl.sonar.sampling import sampling_at, typical_level
from tests.support.counted_samples import reception_of
from tests.support.sampled_scenes import SONAR, make_alone


@pytest.mark.parametrize("side", [-1, 1])
def test_a_body_counts_as_soon_as_its_sphere_reaches_into_the_fan(side):
    """The sphere about a ball of 1 m at 10 m fills 5.7 degrees to each side."""
    radius = 1.0
    half = math.degrees(math.asin(radius / 10))
    state = SceneState(np.eye(4)[None], np.ones(1, bool))

    def angle(azimuth_deg=0.0, elevation_deg=0.0, range_m=10.0, reach_deg=0.0):
        psi, phi = math.radians(azimuth_deg), math.radians(elevation_deg)
        place = range_m * np.array(
            [math.cos(phi) * math.cos(psi), math.cos(phi) * math.sin(psi), math.sin(phi)]
        )
        ball = sg.Body("ball", trimesh.creation.icosphere(3, 1.0), sg.pose(*place), 1.0)
        placed = replace(state, poses=ball.pose[None])
        top_rad = math.radians(SONAR.elevation_fov_deg) / 2
        even = Reception(
            SONAR, math.radians(reach_deg), top_rad, False, np.ones(SONAR.n_bins), np.zeros(0), None
        )
        return BodyExtents([ball]).greatest_echo(placed, np.eye(4), even)[1]

    for inside, beyond in (
        ({"elevation_deg": side * (10 + half - 0.1)}, {"elevation_deg": side * (10 + half + 0.1)}),
        ({"azimuth_deg": side * (22.5 + half - 0.1)}, {"azimuth_deg": side * (22.5 + half + 0.1)}),
        (
            {"azimuth_deg": side * (25.5 + half - 0.1), "reach_deg": 3.0},
            {"azimuth_deg": side * (25.5 + half + 0.1), "reach_deg": 3.0},
        ),
        ({"range_m": 20 + radius - 0.1}, {"range_m": 20 + radius + 0.1}),
    ):
        assert angle(**inside) > 0 and angle(**beyond) == 0
    assert angle() >= 2 * math.pi * (1 - math.cos(math.asin(0.1)))  # at least what the ball itself fills


def test_a_sphere_about_points_reaches_to_the_furthest_from_the_middle_of_their_box():
    sphere = sphere_about(np.array([[0.0, 0.0, 0.0], [4.0, 1.0, 0.0], [1.0, 2.0, 8.0]]))
    np.testing.assert_array_equal(sphere.centre, [2.0, 1.0, 4.0])
    assert sphere.radius_m == pytest.approx(math.sqrt(21))  # from the first; 2² + 4² and 1 + 1 + 4² are less


def test_vertices_without_a_face_do_not_extend_a_body():
    ball = trimesh.creation.icosphere(2, 0.5)
    more = trimesh.Trimesh([*ball.vertices, [0, 0, 40]], ball.faces, process=False)
    state, even = SceneState(sg.pose(10)[None], np.ones(1, bool)), np.ones(SONAR.n_bins)
    reception = Reception(SONAR, 0.0, math.radians(10), False, even, np.zeros(0), None)
    found, expected = (
        BodyExtents([sg.Body("ball", mesh, sg.pose(10))]).greatest_echo(state, np.eye(4), reception)
        for mesh in (more, ball)
    )
    assert found.tolist() == expected.tolist()


class TestSideLobes:
    """A ball of 5 cm at 8 m, above the main lobe in elevation of a sonar of 20 degrees."""

    SONAR, PHYSICAL = sg.load_sonar("p900-45"), sg.Acoustics.physical()

    def ball(self, elevation_deg, azimuth_deg=0.0):
        phi, psi = math.radians(elevation_deg), math.radians(azimuth_deg)
        place = 8 * np.array([math.cos(phi) * math.cos(psi), math.cos(phi) * math.sin(psi), math.sin(phi)])
        return sg.Body("ball", trimesh.creation.icosphere(3, 0.025), sg.pose(*place))

    def poses(self, n):
        rng = np.random.default_rng(0)
        return [sg.pose(*rng.uniform(-0.3, 0.3, 3), *np.radians(rng.uniform(-3, 3, 3))) for _ in range(n)]

    @pytest.mark.slow
    def test_a_ball_alone_is_found_and_keeps_the_tolerance(self):
        """The first samples miss it from two of these poses: no echo, and an estimate of 0."""
        scene, missed = sg.Scene([self.ball(40)]), []
        for pose in self.poses(6)[3:]:
            for alone in False, True:
                with sg.Simulator(scene, self.SONAR, self.PHYSICAL, tolerance=0.02) as simulator:
                    ping = make_alone(simulator, pose) if alone else simulator.ping(pose)
                    assert 0 < ping.error_estimate <= 0.02
            sampling, guess = ping.meta["sampling"], sampling_at(self.SONAR, typical_level(0.02))
            finer = sg.Sampling(2 * sampling["columns_per_beam"], 2 * sampling["rows"])
            with sg.Simulator(scene, self.SONAR, self.PHYSICAL, finer) as simulator:
                assert ping_error(ping, simulator.ping(pose)) <= 0.02
            settings = scene, self.SONAR, self.PHYSICAL, guess
            with sg.Simulator(*settings) as simulator, warnings.catch_warnings():
                warnings.simplefilter("ignore")  # that nothing came back
                missed.append(not simulator.ping(pose).intensity.any())
        assert any(missed)

    @pytest.mark.parametrize("elevation_deg", [24, pytest.param(40, marks=pytest.mark.slow)])
    def test_a_ball_over_a_floor_asks_for_no_samples_that_its_echo_does_not_need(self, elevation_deg):
        """Its echo is about 1e-4 of the floor's; without the elevation pattern it could be a thousandth and more."""
        floor = sg.Body("floor", trimesh.creation.box((80, 80, 1)), sg.pose(0, 0, -14))
        levels = []
        for bodies in [floor], [floor, self.ball(elevation_deg)]:
            with sg.Simulator(sg.Scene(bodies), self.SONAR, self.PHYSICAL) as simulator:
                levels.append([simulator.plan([pose]).level for pose in self.poses(4)])
        # Two more where a single sample of the side lobes meets the ball: its echo may be a thousandth. Where it is,
        # the ball takes ten more.
        assert max(np.subtract(levels[1], levels[0])) <= 2

    @pytest.mark.parametrize("azimuth_deg", [pytest.param(0, marks=pytest.mark.slow), 20])
    @pytest.mark.parametrize("elevation_deg", [0, 8, -15, 24, -45, 40, 60, 80])
    def test_the_bound_of_a_body_is_above_its_echo_and_close(self, elevation_deg, azimuth_deg):
        ball, pose = self.ball(elevation_deg, azimuth_deg), np.eye(4)
        with sg.Simulator(
            sg.Scene([ball]), self.SONAR, self.PHYSICAL, sampling_at(self.SONAR, 28)
        ) as simulator:
            run = simulator.run
            stage, gain = run.sampler.resolution.stage, run.instrument.gain
            with run.drawing():
                (view,) = stage.draw([pose], [None], with_bodies=True)
                reception = reception_of(stage.beamformer, stage.fan.sonar, gain)
                reception = reception._replace(reach_rad=self.PHYSICAL.receive_support_rad(self.SONAR))
                counts = count_bodies(view, 1, reception)
        placed = SceneState(ball.pose[None], np.ones(1, bool))
        bound = BodyExtents([ball], specular=True).greatest_echo(placed, pose, reception)
        assert counts.samples[1] > 20
        # a Lambert ball returns 2/3 of its silhouette; the rest is the pattern's change within 0.4 degrees
        assert 1.4 < bound[1] / counts.echo[1] < 2.0


@pytest.mark.slow
def test_the_greatest_lobe_in_view_bounds_what_samples_return():
    """Boxes at random places; where the glint is in view and met, the bound is close.

    The lobe of a roughness of 0.5 is greatest 27 degrees beside face on.
    """
    acoustics, rng, met = sg.Acoustics("ideal", specular=True), np.random.default_rng(1), [0, 0]
    for number in range(40):
        roughness_rad = (0.1, 0.5)[number % 2]
        size, at = rng.uniform(0.1, 4, 3), (*rng.uniform((2, -5, -2), (15, 5, 2)), *rng.uniform(-0.6, 0.6, 3))
        box = sg.Body("box", trimesh.creation.box(size), sg.pose(*at), 0.0, None, 0.8, roughness_rad)
        with sg.Simulator(sg.Scene([box]), SONAR, acoustics, sg.Sampling(4, 200)) as simulator:
            run = simulator.run
            stage = run.sampler.resolution.stage
            with run.drawing():
                (view,) = stage.draw([np.eye(4)], [None])
            reception = reception_of(stage.beamformer, SONAR, run.instrument.gain)
        (samples,) = view.sectors
        j, i = np.indices(samples.plane_echo.shape[:2])
        u, v = (one[0] + one[1] * i + one[2] * j for one in (samples.sector.u, samples.sector.v))
        is_received = samples.sector.holds_elevation(u, v) & (np.abs(np.arctan(u)) < np.radians(22.5))
        echo = samples.plane_echo[..., 3] * samples.plane_echo[..., 0] / np.sqrt(1 + u * u + v * v)
        greatest = echo[is_received].max(initial=0.0)
        bound = greatest_lobe(box, box.pose, np.eye(4), reception)
        assert greatest <= bound * (1 + 1e-4)
        met[number % 2] += greatest > 0.9 * bound > 0
    assert min(met) >= 3


def sheet(n=1):
    """Return a square of 1 m in the plane y = 0.25, of 2 n² faces, with a vertex that no face uses."""
    x, z = np.meshgrid(np.linspace(-0.5, 0.5, n + 1), np.linspace(-0.5, 0.5, n + 1))
    k = np.arange(x.size).reshape(x.shape)
    quads = np.stack([k[:-1, :-1], k[:-1, 1:], k[1:, 1:], k[1:, :-1]], axis=-1).reshape(-1, 4)
    corners = np.stack([x, np.full(x.shape, 0.25), z], axis=-1).reshape(-1, 3)
    return trimesh.Trimesh(np.vstack([corners, [[9, 9, 9]]]), quads, process=False)


@pytest.mark.parametrize("n", [1, 40])
@pytest.mark.parametrize("scale", [1.0, 3.0])
def test_a_body_in_a_plane_returns_nothing_to_a_sonar_in_that_plane(n, scale):
    """And little to one near it: no more than by its silhouette. Bodies that are not in a plane have no such limit."""
    sonar_pose, shape = sg.pose(1.0, 2.0, 3.0, 0.3, -0.2, 0.5), np.diag([scale, scale, scale, 1.0])
    reception = Reception(SONAR, 0.0, 0.2, False, np.ones(SONAR.n_bins), np.zeros(0), None)
    for offset_m, mesh in ((0.0, sheet(n)), (0.01, sheet(n)), (0.0, trimesh.creation.box((1, 1e-5, 1)))):
        body = sg.Body("sheet", mesh, sonar_pose @ sg.pose(5.0, -0.25 * scale + offset_m), 1.0)
        state = SceneState((body.pose @ shape)[None], np.ones(1, bool))
        extents = BodyExtents([body])
        share = extents.share_in_view(1, body, state, sonar_pose, reception)
        if len(mesh.faces) == 12:
            assert share == 1.0
        elif offset_m == 0.0:
            assert share == 0.0
        else:
            # silhouette by that at right angles, at the nearest point of the circle about the square
            silhouette = offset_m / (math.hypot(5.0, offset_m) - math.sqrt(0.5) * scale) * np.pi * 0.5
            assert share == pytest.approx(silhouette / 0.5, rel=1e-9)


@pytest.mark.parametrize(
    "acoustics", [sg.Acoustics.ideal(), sg.Acoustics.physical()], ids=["ideal", "physical"]
)
def test_a_sheet_in_whose_plane_the_sonar_lies_takes_no_samples(acoustics):
    """It asked for the most that fit, which took a thousand times as long, and its error was unknown."""
    floor = sg.Body("floor", trimesh.creation.box((60, 60, 0.1)), sg.pose(0, 0, -2), 0.3)
    net = sg.Body("net", sheet(), sg.pose(5, -0.25), 0.5)
    pings = []
    for bodies in ([floor], [floor, net]):
        with sg.Simulator(sg.Scene(bodies), SONAR, acoustics, tolerance=0.05) as simulator:
            pings.append(simulator.ping(sg.pose(pitch=0.3)))
    alone, both = pings
    assert both.error_estimate <= 0.05
    assert both.meta["sampling"] == alone.meta["sampling"]
    np.testing.assert_array_equal(both.intensity, alone.intensity)


@pytest.mark.parametrize(
    ("mesh", "share"),
    [
        (trimesh.creation.box((1, 2, 3)), 1.0),
        (trimesh.creation.cylinder(0.1, 3.0, sections=64), 0.4),
        (trimesh.creation.icosphere(4, 0.3), 0.16),
        (trimesh.creation.torus(1.0, 0.2), 0.16),
    ],
    ids=["box", "cylinder", "ball", "torus"],
)
def test_a_glint_fills_a_part_of_round_bodies(mesh, share):
    """4 times a roughness of 0.1 rad, in one direction or in two."""
    assert glint_share(sg.Body("body", mesh).surface, 0.1) == pytest.approx(share)


@pytest.mark.parametrize(
    ("normals", "mean", "share"),
    [
        ("all", 1.0, 1.0),
        ("all", 0.5, 0.5),
        ("all", 0.1, 0.16),
        ("all", 9.0, 1.0),
        ("none", 1.0, 0.16),
        ("some", 1.0, 0.16),
        ("all that faces use", 0.5, 0.5),
    ],
)
def test_samples_show_a_lobe_that_is_a_mean_as_far_as_its_echo_is_that_of_a_sphere(normals, mean, share):
    """A sphere returns |R|²/4 by its lobe, here some times as much; faces without normals have no mean."""
    mesh = trimesh.creation.icosphere(4, 0.3)
    of_vertices = None if normals == "none" else np.array(mesh.vertex_normals)
    if normals == "some":
        of_vertices[7] = 0.0
    if normals == "all that faces use":
        mesh = trimesh.Trimesh(np.vstack([mesh.vertices, np.zeros(3)]), mesh.faces, process=False)
        of_vertices = np.vstack([of_vertices, np.zeros(3)])
    smooth = sg.Body("ball", mesh, sg.pose(5), 0.2, of_vertices, 0.8, 0.1)
    rough = sg.Body("rough", mesh, sg.pose(5), 0.2)
    extents = BodyExtents([smooth, rough], specular=True)
    state = SceneState(np.array([smooth.pose] * 2), np.ones(2, bool))
    greatest = np.array([0.0, 3.0, 3.0])  # of the reflectivity, and of the lobe face on
    echo = greatest * (0.2 + mean * 0.8 / 4) / (0.2 + 0.8 / (8 * 0.1**2))
    np.testing.assert_allclose(extents.glint_shares(echo, greatest, state), [1, share, 1], rtol=1e-6)


def test_the_greatest_gain_and_pattern_are_those_within_the_span():
    rng, sonar = np.random.default_rng(0), replace(SONAR, n_bins=40)
    gain, table = rng.random(40), rng.random(201)
    near, far = np.sort(rng.uniform(0.0, 22.0, (2, 300)), axis=0)
    edges = sonar.bin_edges_m
    held = (edges[1:, None] > near) & (edges[:-1, None] <= far)
    some = held.any(axis=0)
    assert some.sum() > 250 and held[0].any() and held[-1].any()
    expected = np.where(held, gain[:, None], 0.0).max(axis=0)
    bins = gain, sonar.range_min_m, sonar.bin_size_m
    found = np.array([greatest_gain(*bins, *span) for span in zip(near, far, strict=True)])
    np.testing.assert_array_equal(found[some], expected[some])
    low, high = np.sort(rng.uniform(-1.0, 1.0, (2, 300)), axis=0)
    low[0], high[1] = -1.0, 1.0
    sines, step = np.linspace(-1, 1, 201), 0.01
    beside = (sines[:, None] > low - step) & (
        sines[:, None] < high + step
    )  # between which the pattern is linear
    expected = np.where(beside, table[:, None], 0.0).max(axis=0)
    found = [greatest_pattern(table, *span) for span in zip(low, high, strict=True)]
    np.testing.assert_array_equal(found, expected)
    assert greatest_pattern(np.zeros(0), -0.1, 0.1) == 1.0
