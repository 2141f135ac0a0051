"""Pings of a moving sonar against pings from its position when the echo returns."""

import math
from dataclasses import replace

import numpy as np
import pytest
import trimesh

import sonar_gl as sg
from sonar_gl.engine.motion import check_velocity, shown_in_motion

SONAR = sg.Sonar("test", 900e3, 128, 600, 32.0, 16.0, 0.5, 1.0, 31.0)
ACOUSTICS = replace(sg.Acoustics.ideal(), water=sg.Water(sound_speed_m_s=1500.0))
HERE = np.eye(4)
STEP = math.radians(32 / 128)


def balls(*places):
    mesh = trimesh.creation.icosphere(3, 0.1)
    return sg.Scene([sg.Body(f"ball {k}", mesh, sg.pose(*place), 1.0) for k, place in enumerate(places)])


def simulator(scene, sonar=SONAR, acoustics=ACOUSTICS):
    return sg.Simulator(scene, sonar, acoustics, sg.Sampling(4, 400))


def middle(ping):
    """Return the mean azimuth and range of the echo, and its sum."""
    echo = ping.intensity.astype(np.float64)
    whole = echo.sum()
    return echo.sum(axis=1) @ ping.azimuth_rad / whole, echo.sum(axis=0) @ ping.range_m / whole, whole


def test_yaw_and_surge_of_a_ball():
    """The bearing is ψ - w 2r/c and the range r / (1 + v/c)."""
    psi, r = np.radians(4.0), 25.0
    with simulator(balls((r * np.cos(psi), r * np.sin(psi), 0.0))) as run:
        still = middle(run.ping(HERE))
        turning = middle(run.ping(HERE, velocity=(0, 0, 0, 0, 0, 0.5)))
        closing = middle(run.ping(HERE, velocity=(2, 0, 0, 0, 0, 0)))
        sliding = middle(run.ping(HERE, velocity=(0, 2, 0, 0, 0, 0)))
    off = 0.5 * 2 * still[1] / 1500
    assert off > 3 * STEP  # 0.95°
    # a mean moves as its cells do, but for the rounding of their float32 powers
    assert turning[0] == pytest.approx(still[0] - off, abs=1e-7 * STEP)
    assert turning[1] == pytest.approx(still[1], abs=1e-7 * SONAR.bin_size_m)
    # the ball is met within 0.4 degrees of psi, over which the speed towards it changes
    aside = 25 * 2 / 1500 * math.sin(psi) * np.radians(0.4)
    assert closing[1] == pytest.approx(still[1] / (1 + 2 * math.cos(psi) / 1500), abs=aside)
    assert sliding[1] == pytest.approx(still[1] / (1 + 2 * math.sin(psi) / 1500), abs=25 * 2 / 1500 * 1e-4)
    # a cell that grows by 2v/c cos psi is spread evenly: half of that moves its mean
    grows = STEP * 2 * 2 / 1500 / 2
    assert closing[0] == pytest.approx(still[0] + 2 * 2 * math.sin(psi) / 1500, abs=grows)
    assert sliding[0] == pytest.approx(still[0] - 2 * 2 * math.cos(psi) / 1500, abs=grows * math.sin(psi))
    for moved in (turning, closing, sliding):
        assert moved[2] == pytest.approx(still[2], rel=1e-7)  # no power is lost: float32


@pytest.mark.parametrize("yaw", [0.6, -0.6])
def test_range_and_bearing_against_pings_from_the_pose_of_reception(yaw):
    """The range is half of both ways; the bearing is that from the position of reception."""
    velocity = np.array([1.5, -1.0, 0.0, 0.0, 0.0, yaw])
    fine = replace(SONAR, n_bins=3000)  # bins fine enough for the mean range of the echo
    for place in ((9.0, 1.5, 0.0), (18.0, -2.0, 0.0), (28.0, 2.0, 0.0)):
        with simulator(balls(place), fine) as run:
            still, got = middle(run.ping(HERE)), middle(run.ping(HERE, velocity=velocity))
            time_s = 2 * still[1] / 1500
            pose_received = sg.pose(*(velocity[:3] * time_s), yaw=yaw * time_s)
            pose_halfway = sg.pose(*(velocity[:3] * time_s / 2))  # r + r' is twice the range from this pose
            received, halfway = middle(run.ping(pose_received)), middle(run.ping(pose_halfway))
        assert got[0] == pytest.approx(received[0], abs=0.03 * STEP)
        assert abs(received[0] - still[0]) > 0.3 * STEP
        # 8 to 25 mm nearer, to the accuracy of the ball's samples
        assert got[1] == pytest.approx(halfway[1], abs=3e-4)
        assert still[1] - got[1] > 6e-3


@pytest.mark.slow
def test_a_scene_against_pings_from_the_poses_of_reception():
    """Each bin is compared with a ping from the sonar's pose at its time of arrival; yaw only."""
    scene, sonar = sg.load_scene("pylon"), replace(SONAR, n_bins=60)
    acoustics = sg.Acoustics.physical(water=sg.Water(sound_speed_m_s=1480.0))
    yaw = -0.4
    with sg.Simulator(scene, sonar, acoustics, sg.Sampling(4, 100)) as run:
        pose = scene.sonar_pose
        still, got = run.ping(pose), run.ping(pose, velocity=(0, 0, 0, 0, 0, yaw))
        truth = np.stack(
            [
                run.ping(pose @ sg.pose(yaw=yaw * 2 * r / 1480)).intensity[:, k]
                for k, r in enumerate(sonar.range_m)
            ],
            axis=1,
        )
    inside = slice(10, -10)  # outside of these beams new surfaces come into the fan

    def error(ping):
        return np.abs(ping.intensity[inside] - truth[inside]).sum() / truth[inside].sum()

    # interpolation between beams blurs by half a beam of 0.5° at most
    assert error(got) < 0.05 and error(still) > 4 * error(got)


def test_power_is_conserved_inside_the_fan():
    rng = np.random.default_rng(0)
    intensity = np.zeros((128, 600), np.float32)
    intensity[20:-20, 20:-40] = rng.exponential(size=(88, 540))
    table = tuple((16 * np.sin(np.linspace(-1.4, 1.4, 128))).tolist())
    for sonar in (SONAR, replace(SONAR, beam_azimuths_deg=table)):
        with simulator(balls((5, 0, 0)), sonar) as run:
            ping = replace(run.ping(HERE), intensity=intensity)
        middles = (sonar.azimuth_rad[1:] + sonar.azimuth_rad[:-1]) / 2
        width = np.diff(
            [2 * sonar.azimuth_rad[0] - middles[0], *middles, 2 * sonar.azimuth_rad[-1] - middles[-1]]
        )
        for velocity in ((0, 0, 0, 0, 0, 0.7), (3, -2, 0, 0, 0, -0.7)):
            got = in_motion(ping, velocity)
            assert width @ got.intensity.sum(axis=1) == pytest.approx(width @ intensity.sum(axis=1), rel=1e-6)
            if velocity[0] == 0:  # then each bin keeps its power
                np.testing.assert_allclose(width @ got.intensity, width @ intensity, rtol=2e-7)  # float32
            assert (got.intensity >= 0).all() and not got.intensity.flags.writeable
    even = replace(ping, intensity=np.ones_like(intensity))
    inner = in_motion(even, (3, -2, 0, 0, 0, -0.7)).intensity[30:-30, 5:-5]
    np.testing.assert_allclose(inner, 1, atol=0.01)  # no stripes
    leaving = in_motion(even, (0, 0, 0, 0, 0, 0.7)).intensity
    # a turn to port moves all bearings to starboard; the port edge receives nothing
    assert leaving[-1, -1] == 0 and leaving[0, -1] == pytest.approx(1, abs=1e-3)


def in_motion(ping, velocity):
    return shown_in_motion(replace(ping, acoustics=ACOUSTICS), velocity)


def test_motion_with_a_fan_of_360_degrees():
    """A fan of 360 degrees has no ends: an echo that leaves on one side comes in on the other."""
    sonar = sg.Sonar("round", 900e3, 360, 100, 360.0, 10.0, 1.0, 0.5, 30.5)
    with simulator(balls((-20, 0.1, 0)), sonar) as run:
        still, got = run.ping(HERE), run.ping(HERE, velocity=(0, 0, 0, 0, 0, 1.0))
    assert got.intensity.sum() == pytest.approx(still.intensity.sum(), rel=1e-6)
    z = [(p.intensity.sum(axis=1) * np.exp(1j * p.azimuth_rad)).sum() for p in (still, got)]
    assert np.angle(z[1] / z[0]) == pytest.approx(-2 * 19.9 / 1500, abs=1e-4)


def test_a_turn_of_more_than_a_whole_one_loses_no_echo():
    """From 300 m an echo takes 0.4 s, in which a sonar at 20 rad/s turns by 8 radians."""
    sonar = sg.Sonar("round", 900e3, 180, 200, 360.0, 10.0, 2.0, 0.5, 300.5)
    with simulator(balls((20, 0, 0)), sonar) as run:
        ping = run.ping(HERE)
    intensity = np.random.default_rng(0).random(ping.intensity.shape, np.float32)
    for yaw in (20.0, -20.0):
        got = in_motion(replace(ping, intensity=intensity), (0, 0, 0, 0, 0, yaw)).intensity
        np.testing.assert_allclose(got.sum(axis=0), intensity.sum(axis=0), rtol=1e-5)


def test_an_echo_that_leaves_a_wide_fan_may_enter_on_its_other_side():
    """A bearing of -100 degrees less 180 is 80 degrees, which the fan held when the sound went out."""
    sonar = sg.Sonar("wide", 900e3, 240, 100, 240.0, 10.0, 1.0, 0.5, 300.5)
    psi, r = np.radians(-100.0), 200.0
    with simulator(balls((5, 0, 0)), sonar) as run:
        ping = run.ping(HERE)
    intensity, body_id = np.zeros((240, 100), np.float32), np.zeros((240, 100), np.uint16)
    beam, bin_ = np.argmin(abs(sonar.azimuth_rad - psi)), np.argmin(abs(sonar.range_m - r))
    intensity[beam, bin_], body_id[beam - 2 : beam + 3, bin_] = 1.0, 1
    yaw = math.pi / (2 * sonar.range_m[bin_] / 1500)
    got = in_motion(replace(ping, intensity=intensity, body_id=body_id), (0, 0, 0, 0, 0, yaw))
    assert got.intensity.sum() == pytest.approx(1.0)
    shown = np.argmax(got.intensity[:, bin_])
    assert np.degrees(sonar.azimuth_rad[shown]) == pytest.approx(80.0, abs=1.0)
    assert got.body_id[shown, bin_] == 1


def test_zero_velocity_and_ignored_components():
    with simulator(balls((20, 1, 0), (10, -1, 0))) as run:
        none, still = run.ping(HERE, labels=True), run.ping(HERE, labels=True, velocity=np.zeros(6))
        up = run.ping(HERE, velocity=(0, 0, 1, 0.3, 0.3, 0))
    # float32, by way of the widths of beams
    np.testing.assert_allclose(still.intensity, none.intensity, rtol=2e-7)
    np.testing.assert_allclose(up.intensity, none.intensity, rtol=2e-7)
    assert (still.body_id == none.body_id).all()
    np.testing.assert_array_equal(still.elevation_rad, none.elevation_rad)
    assert still.meta["velocity"] == [0.0] * 6 and "velocity" not in none.meta


@pytest.mark.parametrize(
    ("velocity", "places"),
    [((2, 0, 0, 0, 0, 0.5), ((20, 1), (10, -1))), ((0, 30, 0, 0, 0, 0), ((26, 6.5), (10, -1)))],
)
def test_labels_move_with_the_echo(velocity, places):
    with simulator(balls(*((*place, 0) for place in places))) as run:
        got = run.ping(HERE, labels=True, velocity=velocity)
    for number, place in enumerate(places, 1):
        at_rest = math.atan2(place[1], place[0])
        ahead = velocity[0] * math.cos(at_rest) + velocity[1] * math.sin(at_rest)
        aside = velocity[1] * math.cos(at_rest) - velocity[0] * math.sin(at_rest)
        r = math.hypot(*place) / (1 + ahead / 1500.0)
        azimuth = at_rest - velocity[5] * 2 * r / 1500.0 - 2 * aside / 1500.0
        beam, bin_ = (
            math.floor(x) for x in ((azimuth + 64 * STEP) / STEP, (r - 0.05 - 1.0) / SONAR.bin_size_m)
        )
        assert got.body_id[beam, bin_] == number and abs(got.elevation_rad[beam, bin_]) < 0.02
        labelled_cells = got.body_id == number
        labelled = got.intensity[labelled_cells].sum() / got.body_echo[number]
        assert labelled > 0.85  # interpolation moves the rest to neighbouring cells
    assert np.isnan(got.elevation_rad[got.body_id == 0]).all()
    assert got.body_id.dtype == np.uint16 and got.elevation_rad.dtype == np.float32


def test_a_sonar_set_to_another_speed_of_sound():
    """Displayed ranges are c t / 2 with the speed that is set."""
    acoustics = replace(ACOUSTICS, sonar_sound_speed_m_s=1450.0)
    with simulator(balls((20.0, 1.0, 0))) as run, simulator(balls((20.0, 1.0, 0)), SONAR, acoustics) as other:
        velocity = (2, 0, 0, 0, 0, 0.5)
        right, wrong = middle(run.ping(HERE, velocity=velocity)), middle(other.ping(HERE, velocity=velocity))
        still, sliding = middle(other.ping(HERE)), middle(other.ping(HERE, velocity=(0, 10, 0, 0, 0, 0)))
    assert wrong[1] / right[1] == pytest.approx(1450 / 1500, rel=3e-4)
    assert wrong[0] == pytest.approx(right[0], abs=1e-3 * STEP)
    # the time of travel over the range is that of the water, whatever the sonar is set to
    psi = math.atan2(1.0, 20.0)
    assert sliding[0] - still[0] == pytest.approx(-2 * 10 * math.cos(psi) / 1500, abs=1e-3 * STEP)


def test_sequences_and_noise():
    velocities = [None, (1, 0, 0, 0, 0, 0.5), (0, 0, 0, 0, 0, -0.5)]
    with simulator(balls((20, 1, 0))) as run:
        several = list(run.pings([HERE] * 3, sg.Noise.physical(), seed=4, velocities=iter(velocities)))
        for number, (velocity, ping) in enumerate(zip(velocities, several, strict=True)):
            noise = sg.Noise.physical()
            alone = run.ping(HERE, noise, seed=4, ping_number=number, velocity=velocity)
            assert alone.intensity.tobytes() == ping.intensity.tobytes() and alone.meta == ping.meta


@pytest.mark.parametrize(
    "velocity, message",
    [
        ((1, 2, 3), "velocity vx vy vz wx wy wz must have shape"),
        ((0, 0, 0, 0, 0, math.nan), "must be finite"),
        ((0, 0, 0, 0, 0, 30), "radians per second within ±20"),
        ((99, 0, 0, 0, 0, 0), "metres per second within ±30"),
        ("fast", "must be an array of numbers"),
    ],
)
def test_invalid_velocities_raise_errors(velocity, message):
    with simulator(balls((20, 1, 0))) as run, pytest.raises(sg.Error, match=message):
        run.ping(HERE, velocity=velocity)


def test_the_bounds_of_velocities_are_allowed():
    for bound in ((30.0, 0, 0, 0, 0, 20.0), (0, 0, -30.0, -20.0, 0, 0)):
        assert check_velocity(bound).tolist() == list(bound)


def test_motion_with_a_single_beam():
    sonar = sg.Sonar("one", 900e3, 1, 100, 2.0, 10.0, 2.0, 0.5, 30.5)
    with simulator(balls((20.0, 0, 0)), sonar) as run:
        still, got = run.ping(HERE), run.ping(HERE, velocity=(0, 0, 0, 0, 0, 0.5))
    off = math.degrees(0.5 * 2 * 19.9 / 1500)
    assert got.intensity.sum() / still.intensity.sum() == pytest.approx(1 - off / 2, abs=0.01)
