"""The error that the samples of a ping leave, in the whole echo and in that of each body."""

import math
import warnings
from dataclasses import replace

import numpy as np
import pytest
import trimesh

import sonar_gl as sg
from sonar_gl.analysis.verify import ping_error, worst_body
from sonar_gl.beamform.beamformer import BeamEcho
from sonar_gl.engine import error_model
from sonar_gl.engine.body_counts import MIN_BODY_SAMPLES, BodyCounts
from sonar_gl.engine.no_echo import NoEchoWarning
from sonar_gl.engine.request import PingRequest
from sonar_gl.sonar.sampling import WORST_BODY, ToleranceWarning, sampling_at
from sonar_gl.sonar.sector import SHEAR
from tests.support.counted_samples import count_samples
from tests.support.sampled_scenes import IDEAL, SONAR, ball
from tests.support.wall_and_rods import wall

pytestmark = pytest.mark.usefixtures("few_first_rays")


def test_small_bodies_get_the_samples_that_their_echo_needs():
    scene = sg.Scene([wall(19, reflectivity=0.05), ball(x=12, radius=0.07, reflectivity=1.0)])
    truth = sg.reference_ping(scene, SONAR, np.eye(4), IDEAL, error=0.02)
    assert 1e-3 < truth.body_echo[2] / truth.body_echo.sum() < 1e-2
    with sg.Simulator(scene, SONAR, IDEAL, tolerance=0.02) as simulator:
        ping = simulator.ping(np.eye(4), labels=True)
        samples = count_samples(simulator)
        assert abs(ping.body_echo[2] / truth.body_echo[2] - 1) < 5 * 0.02
        # at the coarsest level, sufficient for the wall, fewer than twenty samples hit the ball
        coarse = sampling_at(SONAR, 0)
    with sg.Simulator(scene, SONAR, IDEAL, coarse) as simulator:
        assert count_samples(simulator)[2] < 20 < samples[2]


def floor_at_the_end():
    """Return the scene pylon and a sonar whose side lobes see the floor 3 m below, where its range ends."""
    scene, sonar = sg.load_scene("pylon"), sg.load_sonar("p900-45").with_range(3.0)
    floor_z_m = scene.bodies[0].mesh.vertices[:, 2].max() + scene.bodies[0].pose[2, 3]
    assert scene.sonar_pose[2, 3] - floor_z_m == 3.0
    return scene, sonar


@pytest.mark.parametrize("labels", [False, True])
def test_bodies_of_which_none_is_nearer_than_the_last_bin_ends_have_no_echo(labels):
    """Samples behind the last bin reached into it, the less the finer: as many as fit were drawn, 5.4 million."""
    scene, sonar = floor_at_the_end()
    with sg.Simulator(scene, sonar) as simulator:
        with pytest.warns(NoEchoWarning, match="3.00 m, beyond range_max_m = 3"):
            ping = simulator.ping(scene.sonar_pose, labels=labels, label_level_db=-180.0 if labels else None)
        assert simulator.run.sampler.plan.level <= simulator.run.sampler.search.usual
    assert not ping.intensity.any() and not (labels and ping.body_id.any())


def test_samples_that_only_reach_into_the_last_bin_break_no_tolerance():
    """The more samples, the less they reach into it. A body behind the sonar is nearer."""
    scene, sonar = floor_at_the_end()
    behind = sg.Body("behind", trimesh.creation.box(), scene.sonar_pose @ sg.pose(-2))
    with (
        sg.Simulator(scene.with_bodies([*scene.bodies, behind]), sonar) as simulator,
        warnings.catch_warnings(),
    ):
        warnings.simplefilter("error", ToleranceWarning)
        ping = simulator.ping(scene.sonar_pose)
        assert simulator.plan([scene.sonar_pose]).met
    # a thirtieth of that of the first samples: finer ones might find an echo, or none
    assert 0 < ping.intensity.sum() < 1e-7
    assert ping.error_estimate == 0.0


@pytest.mark.parametrize("acoustics", [IDEAL, sg.Acoustics.physical()])
def test_bodies_beside_the_fan_ask_for_no_samples(acoustics):
    """The sheared lattice and its mirror image jut out of the fan at opposite corners, where they met bodies."""
    half_width = math.radians(SONAR.azimuth_fov_deg / 2) + acoustics.receive_support_rad(SONAR)
    far = sg.Body("far", trimesh.creation.box((1, 60, 30)), sg.pose(18))
    beside = []
    # walls along the edges of the fan, 5 cm outside, which reach from edge to edge of the aperture
    for side in (-1, 1):
        wall = trimesh.creation.box((12, 0.1, 30))
        place = sg.pose(0, 0, 0, 0, 0, side * half_width) @ sg.pose(8, side * 0.1, 0)
        beside.append(sg.Body(f"beside {side}", wall, place))
    with sg.Simulator(sg.Scene([far]), SONAR, acoustics, tolerance=0.05) as simulator:
        alone = simulator.plan([np.eye(4)])
    with sg.Simulator(sg.Scene([far, *beside]), SONAR, acoustics, tolerance=0.05) as simulator:
        plan = simulator.plan([np.eye(4)])
        samples = count_samples(simulator)
    assert samples[1] > 0
    assert not samples[2:].any()
    assert plan.level == alone.level


@pytest.mark.parametrize("z_m, is_counted", [(0.6, False), (0.498, True)])
def test_a_body_above_the_water_asks_for_no_samples(z_m, is_counted):
    """A sonar in the water does not see it. The raft is 1 m high; 2 mm of it count as in the water."""
    floor = sg.Body("floor", trimesh.creation.box((60, 60, 1)), sg.pose(0, 0, -3.5))
    raft, levels = sg.Body("raft", trimesh.creation.box((2, 2, 1)), sg.pose(8, 0, z_m)), []
    with warnings.catch_warnings():
        warnings.simplefilter("error", ToleranceWarning)
        for bodies in ([floor], [floor, raft]):
            scene = sg.Scene(bodies, surface_z_m=0.0)
            with sg.Simulator(scene, SONAR, sg.Acoustics.physical(), tolerance=0.05) as simulator:
                levels.append(simulator.plan([sg.pose(0, 0, -1.0, 0, -0.1)]).level)
    assert (levels[1] > levels[0]) == is_counted


def upright_poles(rng):
    """Return four poles before a wall: each thinner than a sample, in front of the same strips in all rows."""
    poles = [
        sg.Body(
            f"pole {k}",
            trimesh.creation.cylinder(10 ** rng.uniform(-2.3, -1.3), 4, sections=16),
            sg.pose(rng.uniform(4, 16), rng.uniform(-2, 2), 0),
        )
        for k in range(4)
    ]
    return [*poles, sg.Body("wall", trimesh.creation.box((1, 40, 40)), sg.pose(18.5), rng.uniform(0.01, 0.3))]


def plate_edge_on(rng):
    """Return a plate seen edge-on above a dark floor: its edge is bright, and thinner than a sample."""
    place = sg.pose(rng.uniform(5, 14), rng.uniform(-2, 2), 0, 0, 0, rng.uniform(-0.2, 0.2))
    floor = sg.Body("floor", trimesh.creation.box((200, 200, 1)), sg.pose(0, 0, -2.5), 0.05)
    return [sg.Body("plate", trimesh.creation.box((4, 0.01, 3)), place, 0.7), floor]


@pytest.mark.parametrize(
    ("bodies", "seed"),
    [
        (upright_poles, [38, 7, ord("u")]),
        (plate_edge_on, [7, 4, ord("e")]),
        *(
            pytest.param(*one, marks=pytest.mark.slow)
            for one in (
                (upright_poles, [32, 7, ord("u")]),
                (upright_poles, [50, 7, ord("u")]),
                (plate_edge_on, [2, 4, ord("e")]),
                (plate_edge_on, [16, 4, ord("e")]),
            )
        ),
    ],
    ids=["poles 38", "plate 7", "poles 32", "poles 50", "plate 2", "plate 16"],
)
def test_the_promise_counts_what_strips_take_of_thin_upright_parts(bodies, seed):
    """Both lattices may show the same echo of the samples, of which the strips take too little, by up to a third."""
    scene, tolerance = sg.Scene(bodies(np.random.default_rng(seed))), 0.02
    sonar, acoustics = sg.Sonar("thin", 900e3, 128, 400, 60.0, 20.0, 1.0, 0.5, 20.0), sg.Acoustics.physical()
    with sg.Simulator(scene, sonar, acoustics, tolerance=tolerance) as simulator:
        ping = simulator.ping(np.eye(4), labels=True)
    with sg.Simulator(scene, sonar, acoustics, sg.Sampling(16, 705)) as simulator:
        truth = simulator.ping(np.eye(4), labels=True)
    assert ping_error(ping, truth) <= tolerance
    assert worst_body(ping, truth)[0] <= WORST_BODY * tolerance


def test_samples_as_wide_as_whole_columns_take_thin_upright_parts_by_their_width():
    """Of posts of an eighth of a sample, strips of other widths take up to a quarter too much or too little."""
    sonar, acoustics = sg.Sonar("thin", 900e3, 128, 400, 60.0, 20.0, 1.0, 0.5, 20.0), sg.Acoustics.physical()
    mesh, apart = trimesh.creation.box((0.005, 0.005, 3.0)), {}
    bodies = [
        sg.Body(f"post {k}", mesh, sg.pose(10 * math.cos(azimuth), 10 * math.sin(azimuth), 0, 0, 0, azimuth))
        for k, azimuth in enumerate(np.radians(np.linspace(-29.0, 29.0, 24)))
    ]
    with sg.Simulator(sg.Scene(bodies), sonar, acoustics) as simulator, simulator.run.drawing():
        model, setup = simulator.run.sampler.search.model, simulator.run.resolve(PingRequest(np.eye(4)))
        for level in range(8, 15):
            fitted = model.stage_at(level)
            for way, stage in (
                ("fitted", fitted),
                ("compared with", model.coarser_stage(fitted)),
                ("as asked", simulator.run.stages.stage(sampling_at(sonar, level))),
            ):
                (view,) = stage.draw([setup.head_pose], [setup.state], with_bodies=True)
                counts = model.tried(stage, view, stage.beamformer.sum_view(view, setup.gain)).counts
                off = np.abs(counts.of_strips[1:] / counts.echo[1:] - 1)
                apart.setdefault(way, []).append(off.max())
    assert max(apart["as asked"]) > 0.1
    # of skirts, whose samples and columns are wider
    assert max(apart["fitted"]) < 0.01 and max(apart["compared with"]) < 0.01


def with_gaps(rod_deg, range_m, *more):
    """Return a ping of a rod before a wall by boxes of 0.6 degrees every 2 degrees, one of them at 3 degrees."""
    sonar = sg.Sonar("gaps", 900e3, 24, 200, 48.0, 20.0, 0.6, 0.5, 12.0)
    azimuth, mesh = math.radians(rod_deg), trimesh.creation.cylinder(0.03, 1.0, sections=24)
    place = sg.pose(range_m * math.cos(azimuth), range_m * math.sin(azimuth))
    wall = sg.Body("wall", trimesh.creation.box((0.2, 30, 30)), sg.pose(11), 0.5)
    scene = sg.Scene([wall, sg.Body("rod", mesh, place, 1.0)])
    pings = []
    for bodies in more or (None,):
        with sg.Simulator(scene, sonar, IDEAL, tolerance=0.05) as simulator:
            pings.append(simulator.ping(np.eye(4), labels=True, bodies=bodies))
    return scene, sonar, pings


def test_samples_between_boxes_do_not_count_as_a_body_s():
    """A rod of 0.43 degrees reaches 0.06 degrees into a beam. Those on the rest of it hid that it was 88 % off."""
    scene, sonar, (ping,) = with_gaps(3.46, 8.0)
    truth = sg.reference_ping(scene, sonar, np.eye(4), IDEAL, error=0.05)
    assert truth.body_echo[2] > 1e-3 * truth.body_echo.sum()  # the tolerance holds for it
    assert ping.body_echo[2] == pytest.approx(truth.body_echo[2], rel=5 * 0.05)


@pytest.mark.parametrize("tolerance", [0.1, 0.01])
def test_a_body_wider_than_a_gap_between_boxes_is_not_lost(tolerance):
    """After a wall, for which few samples do: all that meet the body lie in the gap, and its edges in the beams."""
    sonar = sg.Sonar("gaps", 900e3, 32, 64, 45.0, 20.0, 1.0, 0.5, 30.0)  # a gap of 0.4 degrees straight ahead
    box = sg.Body("box", trimesh.creation.box((0.1, 0.1, 0.1)), sg.pose(10))  # 0.58 degrees wide
    behind = sg.Body("wall", trimesh.creation.box((0.2, 4, 4)), sg.pose(-6), 0.8)
    scene, acoustics = sg.Scene([behind, box]), sg.Acoustics.ideal()
    with sg.Simulator(scene, sonar, acoustics, sg.Sampling(200, 3000)) as exact:
        truth = exact.ping(sg.pose()).intensity.sum()
    with sg.Simulator(scene, sonar, acoustics, tolerance=tolerance) as it:
        it.ping(sg.pose(yaw=math.pi))
        ping = it.ping(sg.pose())
    assert abs(ping.intensity.sum() / truth - 1) < 5 * tolerance  # as promised of a body's echo


def test_a_body_between_boxes_changes_neither_samples_nor_echo():
    """It and its shadow lie in the gap."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        _, _, (ping, alone) = with_gaps(4.0, 9.0, None, {"rod": None})
    assert ping.meta["sampling"] == alone.meta["sampling"]
    np.testing.assert_array_equal(ping.intensity, alone.intensity)
    assert ping.body_echo[2] == 0


def test_a_slanted_wall_before_beams_as_wide_as_their_spacing_keeps_the_tolerance():
    """Columns half a beam wide spread its echo over ranges alike in both lattices, so that their difference hid it."""
    sonar = sg.load_sonar("aris-3000")
    wall = sg.Body("wall", trimesh.creation.box((0.2, 60, 40)), sg.pose(3.5, yaw=math.radians(60)), 0.4)
    pings = []
    for settings in ({"tolerance": 0.01}, {"sampling": sg.Sampling(8, 200)}):
        with sg.Simulator(sg.Scene([wall]), sonar, **settings) as simulator:
            pings.append(simulator.ping(sg.pose()))
    assert ping_error(*pings) < 0.01


@pytest.mark.filterwarnings("ignore:tolerance 0.002 cannot be met")  # of the truth
class TestBodiesThatSamplesMiss:
    """Small bodies whose echo was lost as a whole, at an estimated error of a hundredth of the tolerance."""

    SONAR = sg.Sonar("s", 900e3, 128, 400, 60.0, 20.0, 60 / 128, 0.5, 20.0)
    LIMIT = 5 * 0.05  # the promise for a body's own echo, at tolerance 0.05

    def body_error(self, bodies, pose=None, acoustics=IDEAL):
        """Return the relative error of the last body's echo at tolerance 0.05, and its share of all."""
        echoes = []
        for tolerance in (0.05, 0.002):
            with sg.Simulator(sg.Scene(bodies), self.SONAR, acoustics, tolerance=tolerance) as simulator:
                echoes.append(simulator.ping(np.eye(4) if pose is None else pose, labels=True).body_echo)
        found, truth = echoes
        return abs(found[-1] / truth[-1] - 1), truth[-1] / truth.sum()

    @pytest.mark.parametrize(
        ("x", "y", "radius_m"),
        [
            (14.79, 3.54, 0.04),
            *(
                pytest.param(*at, marks=pytest.mark.slow)
                for at in ((14.9, -0.14, 0.04), (14.12, -1.68, 0.05))
            ),
        ],
    )
    def test_a_ball_on_a_floor_is_not_hidden_by_what_is_nearer_of_the_floor(self, x, y, radius_m):
        floor = sg.Body("floor", trimesh.creation.box((100, 100, 1)), sg.pose(0, 0, -2.5), "mud")
        ball = sg.Body("ball", trimesh.creation.icosphere(3, radius_m), sg.pose(x, y, radius_m - 2), 0.8)
        error, share = self.body_error([floor, ball], sg.pose(0, 0, 0, 0, 0.15, 0))
        assert share > 0.01 and error < self.LIMIT

    @pytest.mark.slow
    @pytest.mark.parametrize(
        ("depth_m", "x", "y", "radius_m"),
        [(7.85, 0.04, 0.89, 0.028), pytest.param(9.33, 0.89, 3.51, 0.029, marks=pytest.mark.slow)],
    )
    def test_a_pebble_below_a_sonar_that_looks_down_is_seen(self, depth_m, x, y, radius_m):
        """It is less than a hundredth of the range high, and was taken for the floor."""
        floor = sg.Body("floor", trimesh.creation.box((100, 100, 1)), sg.pose(0, 0, -depth_m - 0.5), "mud")
        ball = sg.Body(
            "ball", trimesh.creation.icosphere(3, radius_m), sg.pose(x, y, radius_m - depth_m), 0.8
        )
        error, share = self.body_error([floor, ball], sg.pose(pitch=np.pi / 2))
        assert share > 1e-3 and error < self.LIMIT

    @pytest.mark.slow
    @pytest.mark.parametrize(
        ("material", "y", "radius_m"),
        [
            ("glass", 0.5, 0.15),
            *(
                pytest.param(*one, marks=pytest.mark.slow)
                for one in (("glass", -2.0, 0.3), ("steel", 2.0, 0.1))
            ),
        ],
    )
    def test_the_glint_of_a_round_body_is_met(self, material, y, radius_m):
        ball = sg.Body("ball", trimesh.creation.icosphere(5, radius_m), sg.pose(9, y, 0.3), material)
        error, share = self.body_error(
            [wall(18, reflectivity="sand"), ball], acoustics=sg.Acoustics("ideal", specular=True)
        )
        assert share > 1e-3 and error < self.LIMIT

    def test_a_mirror_whose_glint_lies_beside_the_fan_asks_for_no_samples(self):
        """It met the fan and returned nothing, and was searched for with the most samples that fit."""
        acoustics, shapes = sg.Acoustics("ideal", specular=True), trimesh.creation
        stone = sg.Body("ball", shapes.icosphere(4, 1.0), sg.pose(12, 3))
        levels = []
        for turned in None, {"yaw": 0.9}, {"pitch": 0.7}:
            mirror = sg.Body(
                "mirror", shapes.box((0.02, 3, 3)), sg.pose(8, **turned or {}), 0.0, None, 0.8, 0.05
            )
            bodies = [stone] if turned is None else [stone, mirror]
            with sg.Simulator(sg.Scene(bodies), SONAR, acoustics, tolerance=0.05) as simulator:
                plan = simulator.plan([np.eye(4)])
            assert plan.met
            levels.append(plan.level)
        assert max(levels) <= levels[0] + 2

    @pytest.mark.slow
    @pytest.mark.parametrize("yaw", [0.02, 0.2])
    def test_the_narrow_glint_of_a_small_mirror_is_met(self, yaw):
        """It fills a hundredth of the mirror, whose other samples return nothing."""
        place = sg.pose(9 * math.cos(yaw), 9 * math.sin(yaw), yaw=yaw)
        mirror = sg.Body("mirror", trimesh.creation.box((0.02, 0.8, 0.8)), place, 0.0, None, 0.5, 0.01)
        error, share = self.body_error(
            [wall(18, reflectivity="sand"), mirror], acoustics=sg.Acoustics("ideal", specular=True)
        )
        assert share > 1e-3 and error < self.LIMIT

    @pytest.mark.parametrize("seed", [3, 5])
    def test_a_body_with_a_fine_texture_has_enough_samples(self, seed):
        """A tenth of its faces return nearly all, each narrower than a sample: its outline alone does not tell."""
        n = 24
        y, z = np.meshgrid(*2 * [np.linspace(-0.3, 0.3, n + 1)], indexing="ij")
        i = np.arange(y.size).reshape(y.shape)
        a, b, c, d = (corner.ravel() for corner in (i[:-1, :-1], i[1:, :-1], i[1:, 1:], i[:-1, 1:]))
        faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
        mesh = trimesh.Trimesh(np.stack([0 * y, y, z], -1).reshape(-1, 3), faces, process=False)
        bright = np.random.default_rng(seed).random(n * n) < 0.1
        plate = sg.Body("plate", mesh, sg.pose(9, 0.7, 0.1), np.tile(np.where(bright, 0.9, 0.02), 2))
        scene = sg.Scene([wall(18, reflectivity="sand"), plate])
        echoes = []
        for settings in ({"tolerance": 0.05}, {"sampling": sg.Sampling(10, 500)}):
            with sg.Simulator(scene, self.SONAR, IDEAL, **settings) as simulator:
                echoes.append(simulator.ping(sg.pose(), labels=True).body_echo)
        found, truth = echoes
        assert truth[2] > 1e-3 * truth.sum() and abs(found[2] / truth[2] - 1) < self.LIMIT

    @pytest.mark.slow
    def test_a_body_that_becomes_bright_is_met(self):
        """Nothing moved, so that no ping was checked any more."""
        behind = wall(15, reflectivity="sand")
        lamp = sg.Body("lamp", trimesh.creation.icosphere(3, 0.05), sg.pose(8, 1, 0.3), 0.001)
        bright = sg.Scene([behind, sg.Body("lamp", lamp.mesh, lamp.pose, 1.0)])
        with sg.Simulator(bright, self.SONAR, IDEAL, tolerance=0.005) as simulator:
            truth = simulator.ping(sg.pose(), labels=True).body_echo[2]
        with sg.Simulator(sg.Scene([behind, lamp]), self.SONAR, IDEAL, tolerance=0.05) as simulator:
            simulator.ping(sg.pose())
            for _ in range(10):
                ping = simulator.ping(sg.pose(), reflectivity={"lamp": 1.0}, labels=True)
        assert abs(ping.body_echo[2] / truth - 1) < self.LIMIT


# samples, unevenness and strands on a body of echo 1, its echo before and as strips take it, how many runs along rows,
# where the coarser samples have 40, and the error that follows
MANY = 900
BY_NUMBER = 1.8 * (1 + 8 / MANY) / MANY**0.75  # of 900 samples
SHOWN = 1.37 / math.sqrt(1 + 2**1.5)  # of a difference from half the samples
JUDGED = {
    "by the number of samples": (MANY, 0.0, 0.0, 1.0, 1.0, 57, BY_NUMBER),
    "by few samples": (40, 0.0, 0.0, 1.0, 1.0, 57, 1.8 * 1.2 / 40**0.75),
    "by the difference": (MANY, 0.0, 0.0, 0.9, 1.0, 57, 0.1 / 0.9 * SHOWN),
    "by the difference, as well as it may": (MANY, 0.0, 0.0, 0.864, 1.0, 57, 0.136 / 0.864 * SHOWN),
    "by the difference the other way": (MANY, 0.0, 0.0, 1.2, 1.0, 57, 0.2 * SHOWN),
    "by all of the difference from samples that cross it": (MANY, 0.0, 0.0, 0.9, 1.0, 19, 1.37 * 0.1 / 0.9),
    "by half as many runs as any difference": (MANY, 0.0, 0.0, 0.9, 1.0, 20, 0.1 / 0.9 * SHOWN),
    "of so many samples the difference tells nothing": (
        1000,
        0.0,
        0.0,
        0.5,
        1.0,
        57,
        1.8 * 1.008 / 1000**0.75,
    ),
    "by uneven samples": (MANY, 0.05, 0.0, 1.0, 1.0, 57, 0.075),
    "by strands": (MANY, 0.0, 120.0, 1.0, 1.0, 57, 2 * BY_NUMBER),
    "by strips": (MANY, 0.0, 0.0, 1.0, 0.93, 57, math.hypot(0.07, BY_NUMBER)),
    "by strips that take too much": (MANY, 0.0, 0.0, 0.9, 1.05, 57, math.hypot(0.05, 0.1 / 0.9 * SHOWN)),
    "at most all": (MANY, 0.0, 0.0, 9.0, 1.0, 57, 1.0),
}


@pytest.mark.parametrize(
    ("samples", "unevenness", "strands", "before", "taken", "runs", "error"),
    JUDGED.values(),
    ids=list(JUDGED),
)
def test_the_error_of_a_body_is_judged_by_what_its_samples_show(
    samples, unevenness, strands, before, taken, runs, error
):
    """As stated in numbers; a third body returns too little to count, whatever it errs."""
    level, tolerance = 12, 0.02
    bodies = [sg.Body(name, trimesh.creation.box((1, 1, 1)), sg.pose(5)) for name in "abc"]
    with sg.Simulator(sg.Scene(bodies), SONAR, IDEAL, tolerance=tolerance) as simulator:
        run = simulator.run
        model, setup = run.sampler.search.model, run.set_up(PingRequest(np.eye(4)))
        with run.drawing():
            fine = model.draw(setup, level)
            coarse = model.coarser_stage(fine.stage)
        of_fine = BodyCounts(
            samples=np.array([0.0, 2000.0, samples, 9.0]),
            echo=np.array([0.0, 5.0, 1.0, 0.0029]),
            of_strips=np.array([0.0, 5.0, taken, 0.0029]),
            unevenness=np.array([0, 0, unevenness, 0.0]),
            strands=np.array([0, 0, strands, 0.0]),
            runs=np.array([0, 100.0, runs, 3.0]),
        )
        of_coarse = of_fine._replace(
            echo=np.array([0.0, 5.0, before, 0.01]), runs=np.array([0, 70.0, 40.0, 2.0])
        )
        echo = np.zeros_like(fine.echo.intensity)
        echo[3, 5:9] = 1.0
        other = echo.copy()
        other[3, 5], other[4, 5] = 0.98, 0.02  # a hundredth of the echo lies elsewhere
        tried = fine._replace(echo=BeamEcho(echo, 4.0), counts=of_fine)
        judged = model.judge(
            setup, level, tried, fine._replace(stage=coarse, echo=BeamEcho(other, 4.0), counts=of_coarse)
        )
        ratio = fine.stage.sampling.count(SONAR) / coarse.sampling.count(SONAR)
    assert ratio == pytest.approx(2, rel=0.03)  # whole columns and rows
    # on the mirrored lattice
    assert coarse.fan.sectors[0].u[2] / coarse.fan.sectors[0].u[1] == -SHEAR
    assert fine.stage.fan.sectors[0].u[2] / fine.stage.fan.sectors[0].u[1] == SHEAR
    plan = judged.plan
    assert plan.n_samples == fine.stage.fan.n_samples
    of_strips = abs(taken - 1.0) / 6.0029
    of_difference = 1.35 * 1.4 * 0.01 / math.sqrt(1 + ratio**1.3)  # which lies in two bins
    assert plan.error_estimate == pytest.approx(of_difference + of_strips, rel=1e-6)
    assert plan.worst_body_estimate == pytest.approx(error, rel=0.01)
    assert plan.worst_body == 2
    # widths of samples that would do: the errors fall as these to the power 1.3, and as the samples to the power 0.75
    narrower = max(
        (plan.error_estimate / tolerance) ** (1 / 1.3),
        (plan.worst_body_estimate / (5 * tolerance)) ** (0.5 / 0.75),
    )
    assert judged.steps == min(math.ceil(4 * math.log2(narrower)), 8)
    assert plan.met == (judged.steps <= 0)


def test_what_a_view_shows_of_bodies_is_weighed_by_their_kind(monkeypatch):
    """Unevenness is that of bodies with a lobe, or a value a face."""
    made, box = trimesh.creation, trimesh.creation.box((1, 1, 1))
    ball = sg.Body("ball", made.icosphere(4, 0.5), sg.pose(5, 1), 0.1, specular=0.5, roughness_rad=0.1)
    bodies = [ball, sg.Body("striped", box, sg.pose(5, -1), np.linspace(0.1, 0.9, 12))]
    met = BodyCounts(*(np.arange(1.0, 25.0).reshape(6, 4)))
    monkeypatch.setattr(error_model, "count_bodies", lambda *arguments: met)
    with sg.Simulator(sg.Scene(bodies), SONAR, replace(IDEAL, specular=True), tolerance=0.02) as simulator:
        run = simulator.run
        model = run.sampler.search.model
        simulator.add(sg.Body("box", box, sg.pose(7)))
        setup = run.set_up(PingRequest(np.eye(4)))
        with run.drawing():
            shown = model.draw(setup, 8)
            louder = model.draw(replace(setup, gain=2 * setup.gain), 8)
            silent = shown._replace(counts=BodyCounts(*np.zeros((6, 4)))._replace(samples=np.full(4, 1e3)))
            judged = model.judge(setup, 8, silent, silent)
    np.testing.assert_array_equal(shown.counts, met._replace(unevenness=met.unevenness * [0, 1, 1, 0]))
    assert louder.echo.total == pytest.approx(2 * shown.echo.total, rel=1e-5)
    assert judged.steps < 0  # where none counts, as of bubbles alone, the whole decides


def test_of_a_coarser_view_those_bodies_alone_are_counted_that_it_is_compared_by():
    """It is judged as if all were; of the ball, which few samples meet, the two views differ."""
    scene = sg.Scene([wall(19), ball(x=12, radius=0.1)])
    with sg.Simulator(scene, SONAR, IDEAL, tolerance=0.02) as simulator:
        run = simulator.run
        model, setup = run.sampler.search.model, run.set_up(PingRequest(np.eye(4)))
        with run.drawing():
            tried = model.draw(setup, 14)
            judged, coarser = model.judge(setup, 14, tried), model.coarser_stage(tried.stage)
            (view,) = coarser.draw([np.eye(4)], [setup.state], with_bodies=True)
            echo = coarser.beamformer.sum_view(view, setup.gain)
            whole = model.tried(coarser, view, echo)
            found = model.tried(coarser, view, echo, np.array([False, False, True]))
            other = whole._replace(counts=whole.counts._replace(echo=whole.counts.echo * [1, 1, 2]))
            assert model.judge(setup, 14, tried, whole) == judged
            assert (
                model.judge(setup, 14, tried, other).plan.worst_body_estimate
                > judged.plan.worst_body_estimate
            )
    assert judged.plan.worst_body == 2
    for some, all_ in zip(found.counts, whole.counts, strict=True):
        np.testing.assert_array_equal(some, [0, 0, all_[2]])


FEW = MIN_BODY_SAMPLES
NEAR = sg.Body("near", trimesh.creation.box((1, 1, 1)), sg.pose(5))


def worst_beside_near(other, samples, share, acoustics=IDEAL, **request):
    """Return the number of the worst body where the first is known well, and the second, which errs, by this much."""
    with sg.Simulator(sg.Scene([NEAR, other]), SONAR, acoustics, tolerance=0.02) as simulator:
        run = simulator.run
        model, setup = run.sampler.search.model, run.set_up(PingRequest(np.eye(4), **request))
        with run.drawing():
            view = model.draw(setup, 8)
            of_near, of_both = np.array([0, 0.01, 0]), 0.01 * np.array([0, 1, share])
            met = BodyCounts(np.array([0, 1e6, samples]), of_both, of_both, *np.zeros((3, 3)))
            before = view._replace(counts=met._replace(echo=of_near))
            return model.judge(setup, 8, view._replace(counts=met), before).plan.worst_body


# Samples on a ball of a roughness of 0.1, their strands, the echo before, their unevenness, whether there are shading
# normals, and the error that follows. Without normals 0.16 of the samples may lie in its glint.
APART = SHOWN * 0.3 / 0.7


def by_number(samples):
    """Return the error of so many samples on a compact body."""
    return 1.8 * (1 + 8 / samples) / samples**0.75


GLINTS = {
    "by all samples": (900, 0.0, 1.0, 0.0, False, BY_NUMBER),
    "by strands": (900, 400.0, 1.0, 0.0, False, math.sqrt(400 / 30) * BY_NUMBER),
    "by the difference": (900, 0.0, 0.7, 0.2, False, APART),
    "by uneven samples": (900, 0.0, 0.9, 0.2, False, math.hypot(BY_NUMBER, 0.2)),
    "at most all": (900, 0.0, 1.0, 2.0, False, math.hypot(BY_NUMBER, 1.0)),
    "by the difference of many, few of them in the glint": (2000, 0.0, 0.7, 0.0, False, APART),
    "of so many in the glint the difference tells nothing": (7000, 0.0, 0.7, 0.0, False, by_number(7000)),
    "at most all of the difference": (900, 0.0, 0.1, 0.0, False, 1.0),
    "at most all of the difference of few": (199, 0.0, 0.1, 0.0, False, 1.0),
    "by few in the glint": (199, 0.0, 1.0, 0.2, False, by_number(0.16 * 199)),
    "by strands in the glint": (199, 100.0, 1.0, 0.2, False, math.sqrt(16 / 31.84**0.5) * by_number(31.84)),
    "by the difference of few in the glint": (199, 0.0, 0.7, 0.2, False, 2 * APART),
    "by enough in the glint": (201, 0.0, 1.0, 0.1, False, math.hypot(by_number(201), 0.1)),
    "by means of uneven samples": (900, 0.0, 1.0, 0.2, True, BY_NUMBER),
    "by the difference of means": (900, 0.0, 0.7, 1.2, True, 2 * APART),
    "by means of even samples": (900, 0.0, 0.7, 0.7, True, math.hypot(BY_NUMBER, 0.6 * 0.7)),
}


def plan_of_mirror(samples, strands, before, unevenness, with_normals, reflectivity=0.1):
    """Return the Plan where a smooth ball beside a body that is known well was met as `GLINTS` says."""
    mesh = trimesh.creation.icosphere(4, 0.5)
    normals = mesh.vertex_normals if with_normals else None
    mirror = sg.Body("mirror", mesh, sg.pose(5, 1), reflectivity, normals, 0.5, 0.1)
    acoustics = sg.Acoustics("ideal", specular=True)
    with sg.Simulator(sg.Scene([NEAR, mirror]), SONAR, acoustics, tolerance=0.02) as simulator:
        run = simulator.run
        model, setup = run.sampler.search.model, run.set_up(PingRequest(np.eye(4)))
        with run.drawing():
            view = model.draw(setup, 8)
            # far brighter than a sphere, so that all samples tell of a mean
            zeros, echo, of_mirror = np.zeros(3), np.array([0, 1, 1.0]), np.array([0, 0, 1.0])
            met = BodyCounts(
                np.array([0, 1e6, samples]), echo, echo, unevenness * of_mirror, strands * of_mirror, zeros
            )
            other = view._replace(counts=met._replace(echo=echo * (1 - (1 - before) * of_mirror)))
            coarse = model.coarser_stage(view.stage)
            return model.judge(setup, 8, view._replace(counts=met), other._replace(stage=coarse)).plan


@pytest.mark.parametrize(
    ("samples", "strands", "before", "unevenness", "with_normals", "error"), GLINTS.values(), ids=list(GLINTS)
)
def test_a_smooth_body_is_judged_by_its_glint(samples, strands, before, unevenness, with_normals, error):
    """By what its samples show, if enough of them may lie in it; else by these, and twice the difference.

    Where its lobe is a mean about each sample, the smaller of both counts.
    """
    plan = plan_of_mirror(samples, strands, before, unevenness, with_normals)
    assert plan.worst_body == 2
    assert plan.worst_body_estimate == pytest.approx(error, rel=0.01)


@pytest.mark.parametrize("with_normals", [False, True])
def test_a_smooth_body_with_a_value_a_face_is_judged_as_others_of_uneven_faces_are(with_normals):
    """Of faces that return unlike shares the unevenness counts for more, whether they are smooth or not."""
    of_faces = np.linspace(0.05, 0.15, 5120)
    plan = plan_of_mirror(900, 0.0, 1.0, 0.2, with_normals, of_faces)
    assert (plan.worst_body, plan.worst_body_estimate) == (2, pytest.approx(1.5 * 0.2, rel=0.01))


@pytest.mark.parametrize(
    ("samples", "share", "counts"),
    [(900, 0.00051, True), (900, 0.00049, False), (FEW - 1, 0.0, True), (FEW, 0.0, False)],
    ids=["strong", "weak", "few samples", "enough samples"],
)
@pytest.mark.parametrize("place", ["beside", pytest.param("behind", marks=pytest.mark.slow)])
def test_a_body_counts_if_its_echo_is_strong_or_is_not_known(samples, share, counts, place):
    """From a two thousandth of the total on; or where few samples met it, and it is not hidden where it is now."""
    places = {"beside": sg.pose(6, 3), "behind": sg.pose(8)}
    now, (before,) = places.pop(place), places.values()
    other = sg.Body("other", trimesh.creation.box((1, 1, 1)), before)
    worst = worst_beside_near(other, samples, share, bodies={"other": now})
    is_hidden = place == "behind" and share == 0
    assert worst == (2 if counts and not is_hidden else 1)


@pytest.mark.parametrize(("reaches", "is_counted"), [(0.9, True), (1.1, False)])
def test_a_body_beside_the_fan_counts_as_far_as_its_beams_receive(reaches, is_counted):
    acoustics = sg.Acoustics.physical()
    angle = math.radians(SONAR.azimuth_fov_deg / 2) + reaches * acoustics.receive_support_rad(SONAR)
    place = sg.pose(6 * math.cos(angle), 6 * math.sin(angle))
    cube = sg.Body("cube", trimesh.creation.box((0.1, 0.1, 0.1)), place)
    assert worst_beside_near(cube, 1, 0.0, acoustics) == (2 if is_counted else 1)
