"""Plumes of bubbles: positions, backscatter, and extinction of what lies behind."""

import math
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass, replace

import numpy as np
import pytest
import trimesh

import sonar_gl as sg
from sonar_gl.acoustics.boundary import bubble_backscattering, bubble_extinction
from sonar_gl.scene.sdf.extensions import read_bubbles, read_surface
from tests.support.errors import error_of

SONAR = sg.Sonar("test", 900e3, 40, 400, 20.0, 16.0, 0.5, 0.5, 10.5)  # beams without overlap
BEAM_SR = math.radians(0.5) * 2 * math.sin(math.radians(8))
IDEAL = replace(sg.Acoustics.ideal(), bubbles=True)
HERE = np.eye(4)


@dataclass(frozen=True, eq=False)
class Still(sg.Bubbles):
    """Bubbles of one radius at given places."""

    places: object = None

    def at(self, time_s, pose=None):
        pose = self.pose if pose is None else pose
        return self.places @ pose[:3, :3].T + pose[:3, 3], np.full(len(self.places), self.radius_m)


def still(places, radius_m=5e-3, name="still"):
    return Still(name, radius_m=radius_m, places=np.atleast_2d(np.asarray(places, float)))


def wall(x, size=20.0):
    return sg.Body("wall", trimesh.creation.box((0.1, size, size)), sg.pose(x=x + 0.05), 1.0)


def ping(*things, acoustics=IDEAL, sonar=SONAR, surface_z_m=None, pose=HERE, **settings):
    scene = sg.Scene(things, surface_z_m=surface_z_m)
    with sg.Simulator(scene, sonar, acoustics, sg.Sampling(3, 60)) as simulator:
        return simulator.ping(pose, **settings)


def direction(azimuth_deg, elevation_deg, r):
    psi, phi = np.radians(azimuth_deg), np.radians(elevation_deg)
    return r * np.array([np.cos(phi) * np.cos(psi), np.cos(phi) * np.sin(psi), np.sin(phi)])


# Positions


def test_the_same_time_gives_the_same_bubbles():
    plume, other = sg.Bubbles("a", seed=3), sg.Bubbles("b", seed=4)
    first = plume.at(7.25)
    plume.at(1e6), plume.at(-3.0)
    for again in (plume.at(7.25), replace(plume, name="c").at(7.25)):
        assert all((a == b).all() for a, b in zip(first, again, strict=True))
    assert len(other.at(7.25)[1]) != len(first[1]) or (other.at(7.25)[1] != first[1]).any()


@pytest.mark.parametrize(
    "time_s, message",
    [
        (math.nan, "time_s must lie in -1e+10..1e+10 (got nan; give seconds)"),
        (1.76e18, "time_s must lie in -1e+10..1e+10 (got 1.76e+18; give seconds)"),
        ("7", "time_s must be a number (got '7')"),
    ],
)
def test_a_time_that_no_ping_may_have_raises_an_error(time_s, message):
    assert error_of(sg.Bubbles("a").at, time_s) == message


def test_a_pose_of_bubbles_that_is_none_raises_an_error():
    with pytest.raises(sg.Error, match=r"the pose of bubbles 'a' must have shape \(4, 4\)"):
        sg.Bubbles("a").at(0.0, [1, 2, 3])


def test_bubbles_rise_at_their_own_speeds_on_straight_lines():
    plume = sg.Bubbles("a", sg.pose(1, 2, -9, roll=1.0, yaw=0.4), breath_s=4.0)
    (before, radii), (after, later) = plume.at(100.0), plume.at(100.5)
    assert len(np.unique(radii)) == len(radii)  # so a radius identifies a bubble
    _, i, k = np.intersect1d(radii, later, return_indices=True)
    assert len(i) > 0.9 * len(radii)
    rise = (after[k] - before[i])[:, 2] / 0.5
    assert rise.min() >= 0.8 * 0.25 - 1e-9 and rise.max() <= 1.2 * 0.25 + 1e-9 and np.ptp(rise) > 0.09
    lost = np.setdiff1d(np.arange(len(radii)), i)  # bubbles that reached the top
    assert (before[lost, 2] > -9 + 5.0 - 0.5 * 1.2 * 0.25).all()
    # along a straight line from the source
    apart = np.linalg.norm((after[k] - before[i])[:, :2], axis=1)
    offset = before[i][:, :2] - [1, 2]
    side = np.abs(
        np.cross(np.c_[offset, np.zeros(len(i))], np.c_[after[k][:, :2] - [1, 2], np.zeros(len(i))])
    )
    assert side.max() < 1e-12 and apart.max() > 0


@pytest.mark.parametrize("breath_s", [None, 4.0])
def test_numbers_and_sizes(breath_s):
    plume = sg.Bubbles("a", rate_hz=400, breath_s=breath_s, seed=1)
    times = np.arange(0.0, 400.0, 20.0) + 0.2 * np.arange(20)  # all phases of a breath
    found = [plume.at(t) for t in times]
    places, radii = (np.concatenate(one) for one in zip(*found, strict=True))
    # height over speed, whose mean inverse is ln(1.2 / 0.8) / 0.4 over the mean speed
    expected = 400 * 5.0 / 0.25 * math.log(1.5) / 0.4
    assert len(radii) / len(times) == pytest.approx(expected, rel=0.01)
    # n = 160000 draws: the mean of e^N errs by 0.53 / sqrt(n) = 0.13 %
    assert radii.mean() == pytest.approx(5e-3, rel=0.005)
    assert np.log(radii).std() == pytest.approx(0.5, rel=0.01)
    cone = 0.05 + np.tan(np.radians(6)) * places[:, 2]
    inside = np.hypot(places[:, 0], places[:, 1]) < cone
    assert inside.mean() == pytest.approx(1 - math.exp(-2), abs=0.005)
    if breath_s is None:  # then the density is the same at all heights
        assert places[:, 2].mean() == pytest.approx(2.5, rel=0.01)


def test_the_default_plume_has_a_diver_s_air():
    radii = np.concatenate([sg.Bubbles("a", seed=seed).at(0.0)[1] for seed in range(8)])
    litres_a_minute = 300 * 60 * (4 / 3 * np.pi * radii**3).mean() * 1e3
    assert litres_a_minute == pytest.approx(20, rel=0.1)


def test_breaths():
    plume = sg.Bubbles("a", rate_hz=500, breath_s=4.0, exhaling=0.25, height_m=1.0)
    # a breath begins at 8 s; during the 3 s before no bubble appeared, and the slowest has risen 0.6 m
    assert plume.at(8.0)[0][:, 2].min() > 3 * 0.2
    fresh = plume.at(9.0)[0][:, 2]
    assert (fresh < 0.3).sum() == pytest.approx(4.0 * 500, abs=2)


@pytest.mark.parametrize(
    "settings, message",
    [
        ({"radius_m": 5.0}, "radius_m must lie in 0.0005..0.1"),
        ({"radius_m": 1e-5}, "resonate"),
        ({"rate_hz": math.nan}, "rate_hz must lie in"),
        ({"rise_m_s": "fast"}, "rise_m_s must be a number"),
        ({"breath_s": 0.0}, "breath_s must lie in"),
        ({"seed": -1}, "seed must be a whole number"),
        ({"rate_hz": 1e5}, "no more than 200000 bubbles"),
        ({"pose": 2 * np.eye(4)}, "pose must be a rotation and a translation"),
    ],
)
def test_invalid_settings_raise_errors(settings, message):
    with pytest.raises(sg.Error, match="bubbles 'plume': .*" + message):
        sg.Bubbles("plume", **settings)


# Backscatter


def test_published_numbers():
    beta, a = 1e-3, 2.5e-3
    n = 3 * beta / (4 * math.pi * a**3)
    assert 10 * math.log10(n * bubble_backscattering(a)) == pytest.approx(-16.2, abs=0.05)
    assert 10 * math.log10(math.e) * n * bubble_extinction(a) == pytest.approx(2.6, abs=0.01)


def test_the_echo_of_a_single_bubble():
    """The sum over beams without overlap is π σ_bs / r² over a beam's solid angle, in one bin."""
    place = direction(3.2, 4.0, 6.31)
    got = ping(still(place))
    assert got.intensity.sum() == pytest.approx(np.pi * 5e-3**2 / 4 / 6.31**2 / BEAM_SR, rel=1e-5)
    beam, bin_ = np.argwhere(got.intensity > 0)[0]
    assert np.count_nonzero(got.intensity) == 1 and got.meta["has_echo"]
    assert abs(got.azimuth_rad[beam] - np.radians(3.2)) <= np.radians(0.25)
    assert abs(got.range_m[bin_] - 6.31) <= got.bin_size_m / 2


def test_a_bubble_echoes_like_a_lambert_sphere():
    """σ_bs of a small Lambert sphere is 2/3 μ a², that of a bubble for μ = 3/8, in every beam and pattern."""
    acoustics = sg.Acoustics.physical(elevation_pattern="line_array", specular=False)
    pose, a = sg.pose(*direction(-2.0, 5.0, 7.0)), 5e-3
    ball = sg.Body("ball", trimesh.creation.icosphere(4, a), pose, reflectivity=3 / 8)
    scene = sg.Scene([ball, still(pose[:3, 3], a)])
    with sg.Simulator(scene, SONAR, acoustics, sg.Sampling(90, 6000)) as simulator:
        simulator.place({"still": None})
        by_ball = simulator.ping(HERE).intensity.sum(axis=1)
        by_bubble = simulator.ping(HERE, bodies={"ball": None, "still": HERE}).intensity.sum(axis=1)
    # the ball is a sixth of a beam wide, with two hundred samples on it
    received = by_ball > 0.01 * by_ball.max()
    assert received.sum() >= 3
    np.testing.assert_allclose(by_bubble[received], by_ball[received], rtol=0.02)
    few = ping(still(pose[:3, 3], a), acoustics=acoustics).intensity.sum(axis=1)
    # three columns per beam give the same main lobe
    main = by_ball > 0.5 * by_ball.max()
    np.testing.assert_allclose(few[main], by_ball[main], rtol=0.03)


def test_elevation_and_gain():
    acoustics = sg.Acoustics.physical(
        elevation_pattern="gaussian", tvg_k=30.0, water=sg.Water(absorption_db_m=0.3)
    )
    level, raised = (
        ping(still(direction(1.0, up, 5.0)), acoustics=acoustics).intensity.sum(dtype=np.float64)
        for up in (0.0, 6.0)
    )
    expected = acoustics.two_way_elevation_pattern(SONAR)(math.sin(math.radians(6.0)))
    assert raised / level == pytest.approx(float(expected), rel=1e-6)  # float32
    far = ping(still(direction(1.0, 0.0, 10.0)), acoustics=acoustics).intensity.sum(dtype=np.float64)
    # r^-4 and a TVG of 30 log r; the TVG compensates absorption; the gain is that of the bin's centre
    assert far / level == pytest.approx(2**-4 * 2**3, rel=0.005)


@pytest.mark.parametrize("elevation_deg", [-8.1, 7.9])
@pytest.mark.parametrize("azimuth_deg", [0.0, 9.6])
def test_bubbles_beyond_the_aperture_do_not_echo(azimuth_deg, elevation_deg):
    """The aperture reaches from -8 to 8 degrees, in every azimuth."""
    made = still(direction(azimuth_deg, elevation_deg, 5.0))
    if abs(elevation_deg) < 8:
        assert ping(made).intensity.any()
    else:
        with pytest.warns(UserWarning, match="no echo came back"):
            assert not ping(made).intensity.any()


def test_bubbles_behind_a_surface_do_not_echo():
    plate = wall(5.0, size=1.0)
    before, behind = still(direction(2.0, 1.0, 4.0)), still(direction(2.0, 1.0, 6.0))
    beside = still(direction(8.0, 1.0, 6.0))
    alone = ping(plate).intensity
    for bubbles, has_echo in ((before, True), (behind, False), (beside, True)):
        r = np.linalg.norm(bubbles.places)
        got = ping(plate, bubbles).intensity
        bin_ = int((r - 0.5) / SONAR.bin_size_m)
        assert (got[:, bin_] - alone[:, bin_] > 0).any() == has_echo
    assert ping(plate, behind).intensity.tobytes() == alone.tobytes()


def test_plumes_end_at_the_surface():
    places = np.array([direction(0.0, 2.0, 5.0), direction(0.0, -2.0, 7.0)])
    got = ping(still(places), surface_z_m=0.0)
    assert np.count_nonzero(got.intensity) == 1
    with pytest.warns(UserWarning, match="no echo came back"):
        assert not ping(still(places), surface_z_m=-3.0, pose=sg.pose(z=-4.0)).meta["has_echo"]


# Extinction


def shell(rng, count, low, high):
    """Return positions of uniform density between two ranges, over more than the fan."""
    r = np.cbrt(rng.uniform(low**3, high**3, count))
    azimuth, sine = rng.uniform(-0.26, 0.26, count), rng.uniform(-0.2, 0.2, count)
    level = np.sqrt(1 - sine**2)
    return np.column_stack([level * np.cos(azimuth), level * np.sin(azimuth), sine]) * r[:, None]


@pytest.fixture(scope="module")
def cloud():
    beta, a, low, high = 3e-4, 1.5e-3, 4.0, 6.0
    n = 3 * beta / (4 * np.pi * a**3)
    count = int(n * 0.52 * 0.4 * (high**3 - low**3) / 3)
    bubbles = still(shell(np.random.default_rng(5), count, low, high), a)
    return n, a, low, high, bubbles, ping(wall(8.0), bubbles), ping(wall(8.0))


def test_transmission_of_a_cloud(cloud):
    """The transmission is exp(-n σ L) each way, by the Beer-Lambert law."""
    n, a, low, high, _, got, clear = cloud
    far = got.range_m > 7.5
    left = got.intensity[:, far].sum(dtype=np.float64) / clear.intensity[:, far].sum(dtype=np.float64)
    expected = math.exp(-2 * n * bubble_extinction(a) * (high - low))
    assert 0.1 < expected < 0.5
    # 224000 bubbles, some hundred per cell: τ varies by a few per cent, the mean of exp(-2τ) by less than one
    assert left == pytest.approx(expected, rel=0.01)


def test_echo_of_a_cloud(cloud):
    """Each bin has π s_v Δr per steradian, attenuated on the way: volume reverberation, Urick ch. 8."""
    n, a, low, high, _, got, _ = cloud
    inside = (got.range_m > low + 0.05) & (got.range_m < high - 0.05)
    mean = got.intensity[:, inside].mean(axis=0, dtype=np.float64)
    way = got.range_m[inside] - low
    expected = (
        np.pi * n * bubble_backscattering(a) * got.bin_size_m * np.exp(-2 * n * bubble_extinction(a) * way)
    )
    # a thousand bubbles per bin; echo and extinction together agree within 1 %
    assert mean.sum() / expected.sum() == pytest.approx(1, abs=0.01)
    assert np.abs(mean / expected - 1).max() < 0.1
    # the near and the far half agree
    half = way < (high - low) / 2
    assert (mean / expected)[half].mean() == pytest.approx((mean / expected)[~half].mean(), rel=0.04)


def test_shadows_lie_behind_the_bubbles():
    rng = np.random.default_rng(1)
    # a narrow plume, upright at 3° to port, opaque enough to be seen
    places = np.column_stack(
        [rng.normal(4, 0.05, 4000), rng.normal(0.21, 0.05, 4000), rng.uniform(-1, 1, 4000)]
    )
    bubbles = still(places, 3e-3)
    got, clear = ping(wall(7.0), bubbles), ping(wall(7.0))
    far = got.range_m > 6.5
    left = got.intensity[:, far].sum(axis=1) / clear.intensity[:, far].sum(axis=1)
    azimuth = np.degrees(got.azimuth_rad)
    assert (left[np.abs(azimuth - 3) < 0.6] < 0.6).all()
    # rows of strips beside those that bubbles change may be joined or not, which moves some of the echo
    np.testing.assert_allclose(left[np.abs(azimuth - 3) > 4.0], 1, atol=1e-3)
    assert left.argmin() == pytest.approx(np.abs(azimuth - 3).argmin(), abs=1)
    near = got.range_m < 3.8
    assert (got.intensity[:, near] == clear.intensity[:, near]).all()
    # a surface before the bubbles is not attenuated
    before = ping(wall(2.0), bubbles).intensity
    assert before.tobytes() == ping(wall(2.0)).intensity.tobytes()


def test_bubbles_attenuate_bubbles_behind_them(cloud):
    one = still(direction(1.0, 0.0, 7.0), 5e-3, "one")
    n, a, low, high, bubbles, *_ = cloud
    bin_ = int(6.5 / SONAR.bin_size_m)
    behind = ping(one, bubbles).intensity[:, bin_].sum() / ping(one).intensity[:, bin_].sum()
    # a single point behind the cloud: the transmission varies with τ
    assert behind == pytest.approx(math.exp(-2 * n * bubble_extinction(a) * (high - low)), rel=0.3)


@pytest.mark.slow
def test_shadows_in_all_directions():
    """In a fan of 360 degrees plumes behind the sonar, at the wrap of azimuth, attenuate like those ahead."""
    sonar = sg.Sonar("round", 900e3, 360, 100, 360.0, 10.0, 1.0, 0.5, 10.5)
    rng = np.random.default_rng(2)
    places = np.column_stack(
        [rng.normal(4, 0.1, 2000), rng.normal(0, 0.1, 2000), rng.uniform(-0.5, 0.5, 2000)]
    )
    mesh = trimesh.creation.cylinder(7.0, 6.0, sections=720)
    tank = sg.Body("tank", mesh, reflectivity=1.0)
    left = []
    for yaw in (0.0, np.radians(90), np.radians(179.5), np.radians(-136)):
        turned = replace(still(places), pose=sg.pose(yaw=yaw))
        got, clear = (ping(tank, *more, sonar=sonar).intensity[:, 62:].sum(axis=1) for more in ([turned], []))
        off = sonar.azimuth_rad[(got / clear).argmin()] - yaw
        assert np.abs(np.degrees((off + np.pi) % (2 * np.pi) - np.pi)) < 2
        left.append((1 - got / clear).sum())
    np.testing.assert_allclose(left, left[0], rtol=0.01)


def test_bubbles_on_both_sides_of_the_wrap_of_azimuth_echo_as_those_ahead():
    sonar = sg.Sonar("round", 900e3, 360, 100, 360.0, 10.0, 1.0, 0.5, 10.5)
    echoes = []
    for middle_deg in (0.0, 180.0, 90.0):
        azimuths = middle_deg + np.array([-1.6, -0.6, 0.4, 2.4])
        places = [direction(azimuth, 1.0, 5.0) for azimuth in azimuths]
        by_beam = ping(still(places), sonar=sonar).intensity.sum(axis=1)
        beams = np.floor((azimuths + 180.0) % 360.0).astype(int)
        if sonar.azimuth_rad[0] > sonar.azimuth_rad[-1]:
            beams = 359 - beams
        np.testing.assert_array_equal(np.flatnonzero(by_beam), np.sort(beams))
        echoes.append(by_beam[beams])
    for echo in echoes[1:]:
        np.testing.assert_allclose(echo, echoes[0], rtol=1e-6)


# Settings and poses of plumes


def test_bubbles_can_be_turned_off():
    plume, plate = sg.Bubbles("plume", sg.pose(x=5, z=-2)), wall(7.0)
    off = replace(sg.Acoustics.physical(), bubbles=False)
    for acoustics in (sg.Acoustics.ideal(), sg.Acoustics.demarco2015(), off):
        pings = [ping(plate, *more, acoustics=acoustics, labels=True) for more in ([], [plume])]
        assert pings[0].intensity.tobytes() == pings[1].intensity.tobytes()
        assert pings[1].meta["plumes"] == ["plume"] and "plumes" not in pings[0].meta
    on = ping(plate, plume, acoustics=sg.Acoustics.physical())
    assert on.intensity.tobytes() != ping(plate, plume, acoustics=off).intensity.tobytes()
    assert on.meta["acoustics"]["bubbles"] is True


def test_labels_and_gbuffers():
    rng = np.random.default_rng(1)
    plume = still(np.column_stack([np.full(5000, 4.0), *rng.uniform(-1.5, 1.5, (2, 5000))]))
    scene = sg.Scene([wall(7.0), plume])
    with sg.Simulator(scene, SONAR, IDEAL, sg.Sampling(3, 60)) as simulator:
        got = simulator.ping(HERE, labels=True)
        total = got.intensity[:, got.range_m > 6.5].sum(dtype=np.float64)
        assert got.body_echo[1] == pytest.approx(total, rel=1e-6)  # attenuated, without echoes of bubbles
        assert set(got.body_id.flat) == {0, 1} and (got.body_id[:, got.range_m < 6.5] == 0).all()
        after = simulator.gbuffers(HERE)[0].echo  # not attenuated
    with sg.Simulator(sg.Scene([wall(7.0)]), SONAR, IDEAL, sg.Sampling(3, 60)) as simulator:
        assert after.tobytes() == simulator.gbuffers(HERE)[0].echo.tobytes()


def test_plumes_move_appear_and_disappear():
    place, plate = direction(2.0, 0.0, 4.0), wall(7.0)
    elsewhere = sg.pose(x=1.0)
    scene = sg.Scene([plate, still(place)])
    assert [body.name for body in scene.bodies] == ["wall"] and scene.plumes[0].name == "still"
    with sg.Simulator(scene, SONAR, IDEAL, sg.Sampling(3, 60)) as simulator:
        still_ping, moved = simulator.ping(HERE), simulator.ping(HERE, bodies={"still": elsewhere})
        gone = simulator.ping(HERE, bodies={"still": None})
        assert gone.intensity.tobytes() == ping(plate).intensity.tobytes() != still_ping.intensity.tobytes()
        there = ping(plate, replace(still(place), pose=elsewhere))
        assert moved.intensity.tobytes() == there.intensity.tobytes() != still_ping.intensity.tobytes()
        several = list(simulator.pings([HERE] * 3, bodies=[None, {"still": elsewhere}, {"still": None}]))
        for one, by_itself in zip(several, (still_ping, moved, gone), strict=True):
            assert one.intensity.tobytes() == by_itself.intensity.tobytes()
        simulator.place({"still": elsewhere})
        assert simulator.ping(HERE).intensity.tobytes() == moved.intensity.tobytes()
        simulator.place({"wall": sg.pose(x=8.0)})  # the plume stays
        simulator.place({"wall": plate.pose, "still": None})
        assert simulator.ping(HERE).intensity.tobytes() == gone.intensity.tobytes()
        simulator.add(still(place, name="second"))
        assert simulator.ping(HERE).intensity.tobytes() == still_ping.intensity.tobytes()
        assert [plume.name for plume in simulator.scene.plumes] == ["still", "second"]
        with pytest.raises(sg.Error, match="got 'stil'; did you mean 'still'"):
            simulator.ping(HERE, bodies={"stil": None})
        with pytest.raises(sg.Error, match="pose of bubbles 'still'"):
            simulator.ping(HERE, bodies={"still": np.zeros((4, 4))})
    with pytest.raises(sg.Error, match="unique"):
        sg.Scene([plate, still(place, name="wall")])


def test_bubbles_depend_on_the_time_of_a_ping():
    plume = sg.Bubbles("plume", sg.pose(x=4, z=-1.5), breath_s=3.0)
    times = [0.0, 1.0, 2.5, 1.0]
    with sg.Simulator(sg.Scene([wall(7.0), plume]), SONAR, sampling=sg.Sampling(3, 60)) as simulator:
        ones = [simulator.ping(HERE, time_s=t) for t in times]
        several = list(simulator.pings([HERE] * 4, times_s=iter(times)))
        without_time = simulator.ping(HERE)
        for wrong in (math.nan, "now", True):
            with pytest.raises(sg.Error, match=r"^time_s must "):
                simulator.ping(HERE, time_s=wrong)
        with pytest.raises(sg.Error, match="times_s must be several"):
            list(simulator.pings([HERE], times_s=1.0))
    for one, other, t in zip(ones, several, times, strict=True):
        assert one.intensity.tobytes() == other.intensity.tobytes()
        assert one.meta["time_s"] == other.meta["time_s"] == t
    assert ones[1].intensity.tobytes() == ones[3].intensity.tobytes() != ones[0].intensity.tobytes()
    assert without_time.intensity.tobytes() == ones[0].intensity.tobytes()
    assert "time_s" not in without_time.meta


def test_bubbles_are_found_once_while_nothing_differs():
    plume, wanted = sg.Bubbles("plume", sg.pose(x=4, z=-1.5)), {}
    with sg.Simulator(sg.Scene([wall(7.0), plume]), SONAR, sampling=sg.Sampling(3, 60)) as simulator:

        def found(bodies=None, time_s=None):
            return simulator.world.state_of(bodies, time_s, needs_bubbles=True).bubbles

        before = found()
        assert found({"wall": None}, 0.0) is before and not before.flags.writeable
        for changed in (
            {"time_s": 1.0},
            {"bodies": {"plume": sg.pose(x=5)}},
            {"bodies": {"plume": None}},
            {},
        ):
            wanted[str(changed)] = found(**changed).tobytes()
        assert len(set(wanted.values())) == len(wanted) and found().tobytes() == before.tobytes()


def test_the_tolerance_holds_with_bubbles():
    """Samples are chosen for the attenuated surfaces; the bubbles do not depend on them."""
    plume = sg.Bubbles("plume", sg.pose(x=4, z=-1.5))
    with sg.Simulator(sg.Scene([wall(7.0), plume]), SONAR, tolerance=0.02) as simulator:
        fast = simulator.ping(HERE)
        assert simulator.run.sampler.plan.met
    with sg.Simulator(sg.Scene([wall(7.0), plume]), SONAR, sampling=sg.Sampling(20, 500)) as simulator:
        fine = simulator.ping(HERE)
    assert np.abs(fast.intensity - fine.intensity).sum() < 0.02 * fine.intensity.sum()


@pytest.mark.slow
def test_a_sonar_inside_a_plume_with_multipath():
    """With bubbles on all sides, and at the sonar itself, echoes are finite and not negative."""
    plume = sg.Bubbles("plume", sg.pose(z=-1.0), rate_hz=2000)
    sonar = replace(SONAR, range_min_m=0.0)
    for multipath in ("none", "coherent"):
        # a line array in elevation would let in more echo by way of the surface
        acoustics = sg.Acoustics.physical(multipath=multipath, elevation_pattern="box")
        got = ping(wall(7.0), plume, still(np.zeros(3)), acoustics=acoustics, sonar=sonar, surface_z_m=0.5)
        clear = ping(wall(7.0), acoustics=acoustics, sonar=sonar, surface_z_m=0.5)
        assert np.isfinite(got.intensity).all() and (got.intensity >= 0).all()
        left = got.intensity[:, 270:].sum() / clear.intensity[:, 270:].sum()
        # multipath by the surface is attenuated on the direct path only
        assert 0 < left < (0.2 if multipath == "none" else 0.7)


def test_the_reference_refuses_bubbles():
    scene = sg.Scene([wall(7.0), sg.Bubbles("plume", sg.pose(x=4))])
    with pytest.raises(sg.Error, match=r"the reference does not model bubbles .*'plume'.*bubbles=False"):
        sg.reference_ping(scene, SONAR, HERE)
    truth = sg.reference_ping(scene, SONAR, HERE, sg.Acoustics.ideal(), error=0.3, max_rays=1e6)
    assert truth.intensity.sum() > 0


# Scene files


def element(text):
    return ElementTree.fromstring(f'<x xmlns:sonar_gl="urn:sonar_gl">{text}</x>')[0]


def test_bubbles_of_a_scene_file():
    text = "<!-- slow --><rate>120</rate><radius>0.004</radius><seed>7</seed>"
    template = "<sonar_gl:bubbles>{}</sonar_gl:bubbles>"
    plume = read_bubbles(element(template.format(text)), "diver", sg.pose(z=-3), "here")
    assert (plume.rate_hz, plume.radius_m, plume.seed, plume.name) == (120, 0.004, 7, "diver")
    assert (plume.rise_m_s, plume.pose[2, 3]) == (0.25, -3)
    for inner, says in (
        ("<raet>1</raet>", "here: unknown tag .*'raet'; did you mean 'rate'"),
        ("<rate>1</rate><rate>2</rate>", "here: <rate> must be given once"),
        ("<rate>many</rate>", "here/rate: must be 1 finite number"),
        ("<seed>1.5</seed>", "here: .*seed must be a whole number"),
        ("<radius>5</radius>", "here: .*radius_m must lie in"),
    ):
        with pytest.raises(sg.Error, match=says):
            read_bubbles(element(template.format(inner)), "diver", None, "here")


def test_surface_of_a_scene_file():
    surface = '<sonar_gl:surface roughness="{}">{}</sonar_gl:surface>'
    assert read_surface(element("<sonar_gl:surface>-1.5</sonar_gl:surface>"), "") == {"surface_z_m": -1.5}
    scene = sg.Scene([], **read_surface(element(surface.format(0.01, 2)), ""))
    assert (scene.surface_z_m, scene.surface_roughness_m) == (2, 0.01)
    for roughness, z, says in (
        ("rough", 2, "here: roughness must be a number"),
        (0.1, "up", "here: must be 1"),
    ):
        with pytest.raises(sg.Error, match=says):
            read_surface(element(surface.format(roughness, z)), "here")


WORLD = """<sdf version="1.9"><world name="w">{}
  <model name="diver"><pose>5 0 -2 0 0 0</pose>
    <link name="head"><pose>0 0 1 0 0 0</pose>
      <collision name="head"><geometry><sphere><radius>0.1</radius></sphere></geometry>
        <laser_retro>90</laser_retro></collision>
      {}
    </link>
  </model>
</world></sdf>"""


def test_a_scene_file_with_bubbles(tmp_path):
    path = tmp_path / "diver.sdf"
    bubbles = "<sonar_gl:bubbles{}><pose>0.1 0 0.2 0 0 0</pose><rate>200</rate></sonar_gl:bubbles>"
    path.write_text(
        WORLD.format('<sonar_gl:surface roughness="0.002">3</sonar_gl:surface>', bubbles.format(""))
    )
    scene = sg.load_scene(path)
    (plume,) = scene.plumes
    assert [body.name for body in scene.bodies] == ["diver"] and plume.name == "diver::bubbles"
    np.testing.assert_allclose(plume.pose[:3, 3], [5.1, 0, -0.8])
    assert (plume.rate_hz, scene.surface_z_m, scene.surface_roughness_m) == (200, 3, 0.002)
    path.write_text(WORLD.format("", bubbles.format(' name="air"')))
    scene = sg.load_scene(path)
    assert scene.plumes[0].name == "air" and scene.surface_z_m is None
    for outer, inner, says in (
        ("", "<sonar_gl:bubles/>", r"link\[head\]: unknown tag .*'sonar_gl:bubles'"),
        ("<sonar_gl:surfaces>1</sonar_gl:surfaces>", "", "world: unknown tag .*'sonar_gl:surfaces'"),
        ("<sonar_gl:surface>high</sonar_gl:surface>", "", "sonar_gl:surface: must be 1 finite number"),
        (
            "",
            "<sonar_gl:bubbles><rate>0</rate></sonar_gl:bubbles>",
            "sonar_gl:bubbles: .*rate_hz must lie in",
        ),
        ("", 2 * bubbles.format(""), "'diver::bubbles' more than once"),
    ):
        path.write_text(WORLD.format(outer, inner))
        with pytest.raises(sg.Error, match=says):
            sg.load_scene(path)
