"""A live session: what it pings, that it survives what users do, and what it reads out."""

import math
import threading
import time
from dataclasses import replace

import numpy as np
import pytest
import trimesh

import sonar_gl as sg
from sonar_gl.core.pose_track import PoseTrack
from sonar_gl.engine.no_echo import MOST_IN_A_ROW
from sonar_gl.imaging.styles import FanStyle
from sonar_gl.live import live_sonar as live_sonar_module
from sonar_gl.live import ping_thread as ping_thread_module
from sonar_gl.live import simulators as simulators_module
from sonar_gl.live.pictures import pixel_cells, pixels_of
from sonar_gl.live.session import LiveSession
from sonar_gl.live.settings import LiveSettings, term_names
from sonar_gl.live.simulators import MAX_SIMULATORS, SimulatorPool
from tests.support.live_readings import bodies_in, brightest_pixel
from tests.support.waiting import WAIT_S, wait_until

SONAR = sg.Sonar("small", 900e3, 64, 200, 60.0, 20.0, 1.0, 0.5, 10.5)
QUIET = LiveSettings(SONAR, acoustics=sg.Acoustics.ideal(), noise="none", height=100, max_rate_hz=200.0)
BALL_M, RADIUS_M = np.array([5.0, 1.0, 0.3]), 0.4


@pytest.fixture(scope="module")
def scene():
    """A ball to port before a wall."""
    ball = sg.Body("ball", trimesh.creation.icosphere(4, RADIUS_M), sg.pose(*BALL_M))
    wall = sg.Body("wall", trimesh.creation.box((0.1, 30, 30)), sg.pose(9.0, 0, 0), 0.1)
    return sg.Scene([wall, ball], np.eye(4), "ball and wall")


@pytest.fixture
def session(scene):
    with LiveSession(scene, QUIET) as one:
        yield one


def expected(scene, settings, pose=None, after=None, **more):
    """Return the ping that a simulator makes; `after` one with these arguments, if given."""
    with sg.Simulator(scene, settings.device, settings.acoustics, tolerance=settings.tolerance) as simulator:
        if after is not None:
            simulator.ping(np.eye(4), **after)
        return simulator.ping(np.eye(4) if pose is None else pose, settings.noise, settings.seed, **more)


# ---- pings ---------------------------------------------------------------------------------------------


def test_first_frame_is_the_simulators_ping_as_the_device_shows_it(scene, session):
    frame, ping = session.frame, expected(scene, QUIET)
    assert frame.ping.intensity.tobytes() == ping.intensity.tobytes()
    assert frame.picture.tolist() == FanStyle(100, "copper", False)(ping).tolist()
    assert frame.pose.tolist() == np.eye(4).tolist()
    assert (frame.ping.error_estimate, frame.number, frame.notes) == (ping.error_estimate, 0, ())


def test_every_ping_has_noise_of_its_own_that_depends_on_its_number(scene):
    settings = QUIET.changed(noise="gaussian=0.01")
    with LiveSession(scene, settings) as session:
        session.next_frame()
        frame = session.next_frame()
    assert frame.number == 2
    with sg.Simulator(scene, SONAR, settings.acoustics, tolerance=settings.tolerance) as simulator:
        pings = [simulator.ping(np.eye(4), settings.noise, 0, ping_number=number) for number in range(3)]
    assert frame.ping.intensity.tobytes() == pings[2].intensity.tobytes()


def test_it_pings_only_while_somebody_listens(session):
    time.sleep(0.1)
    assert session.frame.number == 0
    with session.listen(lambda frame: None):
        wait_until(lambda: session.frame.number >= 3)
    number = session.next_frame().number  # the one that was under way is done
    time.sleep(0.1)
    assert session.next_frame().number == number + 1


@pytest.mark.slow
def test_a_rate_is_kept(scene):
    began_s, frames = time.monotonic(), []
    with LiveSession(scene, QUIET.changed(max_rate_hz=10.0)) as session, session.listen(frames.append, 100):
        wait_until(lambda: len(frames) == 5)
        times_s = [frame.clock_s for frame in frames[:5]]
    assert times_s[4] - times_s[0] <= time.monotonic() - began_s
    # four tenths of a second, but for one by which the first may be late, and one by which pings differ in length
    assert times_s[4] - times_s[0] > 0.2


@pytest.mark.slow
def test_the_rate_is_that_of_the_last_pings_since_somebody_listens_with_these_settings(session, monkeypatch):
    monkeypatch.setattr(live_sonar_module, "RATE_S", 0.1)
    frames = [session.frame, *(session.next_frame() for _ in range(30))]
    time.sleep(0.2)  # longer than what counts
    frames += [session.next_frame() for _ in range(2)]
    session.change(tolerance=0.2)
    first_changed = len(frames)
    frames += [session.next_frame() for _ in range(3)]
    first_told = len(frames)
    with session.listen(frames.append, 1000):
        wait_until(lambda: len(frames) >= first_told + 30)
    times_s = [frame.clock_s for frame in frames]
    for first, end in ((0, first_changed), (first_changed, first_told), (first_told, first_told + 30)):
        assert frames[first].rate_hz == 0.0
        for k in range(first + 1, end):
            recent = [time_s for time_s in times_s[first : k + 1] if time_s >= times_s[k] - 0.1]
            recent = recent if len(recent) > 1 else times_s[k - 1 : k + 1]
            # times of this clock are sums, rounded to 1e-16 of what they are
            assert frames[k].rate_hz == pytest.approx((len(recent) - 1) / (recent[-1] - recent[0]))


def test_no_echo_is_explained_in_each_frame(scene):
    with LiveSession(scene, QUIET, sg.pose(yaw=math.pi)) as session:
        frames = [session.frame, *(session.next_frame() for _ in range(MOST_IN_A_ROW))]
    assert all(len(frame.notes) == 1 and frame.notes == frames[0].notes for frame in frames)
    assert "no echo" in frames[0].notes[0]


def test_a_sonar_inside_a_body_or_in_the_air_is_told_in_each_frame_in_which_it_rests(scene):
    """From the second ping at a place on, and in no frame of another place."""
    ball, home = sg.pose(*BALL_M), np.eye(4)
    with LiveSession(scene.with_surface(2.0), QUIET, ball) as session:
        for change, pose, words in (
            (lambda: None, ball, "is inside body 'ball'"),
            (lambda: session.move_body("ball", None), ball, ""),
            (lambda: session.move_body("ball", ball), ball, "is inside body 'ball'"),
            (lambda: session.set_pose(home), home, ""),
            (lambda: session.set_pose(sg.pose(z=3.0)), sg.pose(z=3.0), "is above the water's surface"),
        ):
            change()
            session.next_frame()
            frames = [session.next_frame() for _ in range(2)]
            assert all(np.array_equal(frame.pose, pose) for frame in frames)
            told = [[one for one in frame.notes if "the sonar at" in one] for frame in frames]
            assert [len(texts) for texts in told] == [bool(words)] * 2
            assert all(words in one for texts in told for one in texts)


def test_polar_picture_has_port_on_the_left_and_far_ranges_at_the_top(session):
    session.change(form="polar", colormap="gray")
    frame = session.next_frame()
    assert frame.picture.shape == (100, 100, 3)
    ball = pixels_of(bodies_in(session, frame) == "ball", pixel_cells(frame.ping, frame.settings))
    row, column = np.argwhere(ball).mean(axis=0)
    azimuth, range_m = math.atan2(1.0, 5.0), np.linalg.norm(BALL_M)  # 11 degrees to port
    assert column == pytest.approx(50 - 100 * math.degrees(azimuth) / 60, abs=3)  # the ball is 9 degrees wide
    assert row == pytest.approx(100 - 100 * (range_m - 0.5) / 10, abs=5)  # ... and 0.4 m deep


@pytest.mark.parametrize("form", ["fan", "polar"])
def test_pixels_know_their_bins(session, form):
    session.change(form=form, height=400)
    frame = session.next_frame()
    cells, lit = pixel_cells(frame.ping, frame.settings), frame.ping.counts() > 0
    inside = cells >= 0
    shown = frame.picture.max(axis=2) > 0
    # a pixel shows a blend of its own bin and of neighbours; where these all are dark, or all lit, so is the pixel
    padded = np.pad(lit, 2)
    shifts = [padded[a : a + lit.shape[0], b : b + lit.shape[1]] for a in range(5) for b in range(5)]
    grown, shrunk = np.any(shifts, axis=0), np.all(shifts, axis=0)
    assert not shown[inside & ~grown.ravel()[cells]].any()
    assert shown[inside & shrunk.ravel()[cells]].all()
    assert shrunk.any() and not grown.all()


# ---- settings ------------------------------------------------------------------------------------------


def test_changed_settings_count_from_the_next_ping_on(scene, session):
    settings = session.change(range_m=6.0, tolerance=0.1)
    frame = session.next_frame()
    assert frame.settings == settings == session.settings
    assert frame.ping.intensity.tobytes() == expected(scene, settings).intensity.tobytes()
    assert frame.ping.intensity.shape == (64, 110)  # bins as long as before


@pytest.mark.parametrize(
    "values, message",
    [
        ({"range_m": 0.1}, "range_min_m"),
        ({"tolerance": 2.0}, "tolerance"),
        ({"colormap": "no"}, "colour map"),
        ({"form": "round"}, "form"),
        ({"ranje": 1}, "did you mean 'range_m'"),
        ({"noise": "x"}, "noise"),
        ({"engine": "gpu"}, "engine"),
        ({"gain_db": "loud"}, "gain_db"),
        ({"water": 5}, "water"),
        ({"sonar": None}, "sonar"),
        ({"counts": 3}, "counts"),
        ({"max_rate_hz": 0}, "max_rate_hz"),
    ],
)
def test_wrong_settings_leave_the_old_ones_on(session, values, message):
    before = session.settings
    with pytest.raises(sg.Error, match=message):
        session.change(**values)
    assert session.settings is before


def test_settings_that_cannot_be_drawn_are_taken_back(session, monkeypatch):
    make = simulators_module.Simulator

    def limited(scene, sonar, *arguments, **more):
        if sonar.n_beams > 64:
            raise sg.Error("too many beams for this driver")
        return make(scene, sonar, *arguments, **more)

    monkeypatch.setattr(simulators_module, "Simulator", limited)
    before, frames = session.settings, []
    with session.listen(frames.append):
        session.change(sonar=replace(SONAR, n_beams=65))
        wait_until(lambda: session.state().problem)
        number = session.frame.number
        wait_until(lambda: session.frame.number > number)
        assert session.settings == before
        assert session.state().problem == "too many beams for this driver"
        session.change(range_m=5.0)
        wait_until(lambda: frames and frames[-1].settings.range_m == 5.0)
    assert session.state().problem == ""


def test_a_ping_that_fails_is_reported_and_tried_again(session, monkeypatch):
    monkeypatch.setattr(ping_thread_module, "RETRY_S", 0.01)
    draw, broken = live_sonar_module.picture_of, True

    def picture_of(*arguments):
        if broken:
            raise OSError("the mesh is gone")
        return draw(*arguments)

    monkeypatch.setattr(live_sonar_module, "picture_of", picture_of)
    with session.listen(lambda frame: None):
        wait_until(lambda: session.state().problem)
        assert session.state().problem == "the ping failed (OSError: the mesh is gone)"
        broken = False
        wait_until(lambda: not session.state().problem)


def test_a_law_of_counts_needs_no_other_simulator(session, monkeypatch):
    monkeypatch.setattr(simulators_module, "Simulator", None)  # none can be made from now on
    session.change(gain_db=20.0)
    frame = session.next_frame()
    assert frame.ping.sonar.counts == sg.Counts(gain_db=20.0)
    assert sg.Sonar(**frame.ping.meta["sonar"]) == frame.ping.sonar
    assert frame.ping.counts().mean() > session.frame.ping.counts().mean()


def test_another_sonar_comes_with_its_own_range_and_counts():
    changed = QUIET.changed(range_m=5.0, gain_db=3.0).changed(sonar="p900-90")
    assert changed.device == sg.load_sonar("p900-90")


@pytest.mark.parametrize("name", term_names())
def test_terms_are_switched(name):
    settings = LiveSettings(sg.load_sonar("p900-45"))
    for on in (False, True, False):
        settings = settings.switched(name, on)
        assert settings.is_on(name) == on


def test_simulators_of_old_settings_are_closed(scene):
    pool = SimulatorPool(scene)
    made = [pool.simulator(SONAR.with_range(r), QUIET.acoustics, 0.1) for r in np.linspace(5, 10, 9)]
    for number, simulator in enumerate(made):
        if number < len(made) - MAX_SIMULATORS:
            with pytest.raises(sg.Error, match="closed"):
                simulator.ping(np.eye(4))
        else:
            simulator.ping(np.eye(4))
    pool.close()
    with pytest.raises(sg.Error, match="closed"):
        made[-1].ping(np.eye(4))


def test_an_engine_that_cannot_be_had_leaves_the_simulators(scene):
    pool = SimulatorPool(scene)
    simulator = pool.simulator(SONAR, QUIET.acoustics, 0.1)
    with pytest.raises(sg.Error, match="engine"):
        pool.simulator(SONAR, QUIET.acoustics, 0.1, "gpu")
    assert pool.simulator(SONAR, QUIET.acoustics, 0.1) is simulator
    assert pool.simulator(SONAR, QUIET.acoustics, 0.1, "cpu") is not simulator
    with pytest.raises(sg.Error, match="closed"):
        simulator.ping(np.eye(4))
    pool.close()


@pytest.mark.slow
@pytest.mark.usefixtures("timed_once")
def test_terms_are_priced_where_the_sonar_is(session):
    assert [price.name for price in session.prices()] == term_names()


def test_a_closed_session_ends_the_pricing_of_terms_at_its_next_ping(scene):
    calls, session = [], LiveSession(scene, QUIET)

    def close_at_the_third():
        calls.append(None)
        if len(calls) == 3:
            session.close()

    with pytest.raises(sg.Error, match="this LiveSession is closed"):
        session.prices(close_at_the_third)
    assert len(calls) == 3
    with pytest.raises(sg.Error, match="this LiveSession is closed"):
        session.prices()


# ---- motion --------------------------------------------------------------------------------------------


def test_the_sonar_follows_its_trajectory_until_it_is_moved(scene):
    track = PoseTrack([sg.pose(0), sg.pose(2, 0, 0, 0, 0, 0.4)], [10.0, 14.0])
    with LiveSession(scene, QUIET, track=track) as session:
        assert session.state().is_playing
        session.pause()
        session.seek(1.0)
        frame = session.next_frame()
        assert (frame.time_s, frame.pose.tolist()) == (1.0, track.at(1.0).tolist())
        with pytest.raises(sg.Error, match=r"time_s of a trajectory must lie in 0\.\.4"):
            session.seek(5.0)
        session.set_pose(sg.pose(1, 1, 0))
        assert session.next_frame().pose.tolist() == sg.pose(1, 1, 0).tolist()
        assert not session.state().is_following
        session.play()
        state = session.state()
        assert state.is_following and state.is_playing and state.position_s >= 1.0
        assert session.next_frame().time_s > 1.0
        session.seek(4.0)
        assert session.next_frame().pose.tolist() == track.at(4.0).tolist()
        assert session.state().position_s == state.duration_s == 4.0
        session.play()  # from the beginning
        assert session.state().position_s < 4.0


def test_a_track_that_fails_is_reported_and_ends_no_session(scene):
    class Gap(PoseTrack):
        is_broken = False

        def at(self, time_s):
            if self.is_broken:
                raise ValueError("no pose at this time")
            return super().at(time_s)

    track = Gap([np.eye(4)])
    with LiveSession(scene, QUIET, track=track) as session, session.listen(lambda frame: None):
        track.is_broken = True
        wait_until(lambda: session.state().problem)
        assert session.state().problem == "the ping failed (ValueError: no pose at this time)"
        track.is_broken = False
        wait_until(lambda: not session.state().problem)


def test_without_a_trajectory_there_is_none_to_play(session):
    for command in (session.play, session.pause, lambda: session.seek(0.0)):
        with pytest.raises(sg.Error, match="no trajectory"):
            command()


def test_keys_move_the_sonar_from_where_it_is(session):
    pose = session.move({"w", "W", "x"}, 0.5, speed_m_s=2.0)
    assert pose.tolist() == session.pose.tolist() == sg.pose(1.0).tolist()


def test_bodies_are_moved_and_put_back(scene, session):
    there = {"ball": sg.pose(4, -1, 0)}
    session.move_body("ball", there["ball"])
    frame = session.next_frame()
    assert (
        frame.ping.intensity.tobytes() == expected(scene, QUIET, after={}, bodies=there).intensity.tobytes()
    )
    assert frame.bodies["ball"].tolist() == session.bodies()["ball"].tolist() == there["ball"].tolist()
    session.change(range_m=9.0)  # another simulator
    moved = expected(scene, session.settings, bodies=there)
    assert session.next_frame().ping.intensity.tobytes() == moved.intensity.tobytes()
    session.reset_bodies()
    back = session.next_frame()
    moved = {"bodies": there}
    assert back.ping.intensity.tobytes() == expected(scene, session.settings, after=moved).intensity.tobytes()
    assert not back.bodies
    session.move_body("ball", None)
    absent = expected(scene, session.settings, after={}, bodies={"ball": None})
    assert session.next_frame().ping.intensity.tobytes() == absent.intensity.tobytes()


def test_wrong_bodies_and_poses_are_refused(session):
    with pytest.raises(sg.Error, match="did you mean 'ball'"):
        session.move_body("bal", np.eye(4))
    with pytest.raises(sg.Error, match="the pose of body 'ball'"):
        session.move_body("ball", 2 * np.eye(4))
    with pytest.raises(sg.Error, match="pose"):
        session.set_pose(np.full((4, 4), np.nan))
    with pytest.raises(sg.Error, match="did you mean 'ball'"):
        session.highlight("bal")
    for wrong in (1, None, ["ball"]):
        with pytest.raises(sg.Error, match="a body that is moved must be one of the scene"):
            session.move_body(wrong, np.eye(4))
    with pytest.raises(sg.Error, match="a body must be one of the scene"):
        session.highlight(1)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda session: session.move({"w"}, None), r"dt_s must be a number \(got None\)"),
        (lambda session: session.move({"w"}, -1.0), "dt_s must be finite and 0 or more"),
        (lambda session: session.listen(None), r"on_frame must be a function of a LiveFrame \(got None\)"),
        (lambda session: session.listen(print, 0), "waiting must be a whole number, 1 or more"),
        (lambda session: session.switch(None, True), r"unknown term \(got None"),
    ],
)
def test_wrong_arguments_are_refused_in_a_sentence(session, call, message):
    with pytest.raises(sg.Error, match=message):
        call(session)


# ---- listeners -----------------------------------------------------------------------------------------


def test_a_slow_listener_misses_frames_and_holds_up_nobody(session):
    go_on, slow, fast = threading.Event(), [], []

    def wait(frame):
        slow.append(frame.number)
        go_on.wait(WAIT_S)

    with session.listen(wait) as waiting, session.listen(fast.append, 1000) as quick:
        wait_until(lambda: slow and fast and fast[-1].number >= slow[0] + 10)
        assert len(slow) == 1
        go_on.set()
        wait_until(lambda: len(slow) >= 2)
        assert slow[1] - slow[0] >= 9  # it gets the newest
        assert (quick.missed, waiting.missed >= 8) == (0, True)
    numbers = [frame.number for frame in fast]
    assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))


def test_a_listener_that_fails_gets_no_more_and_disturbs_nobody(session):
    frames = []

    def fail(frame):
        raise ValueError("a mistake of the user's function")

    failing = session.listen(fail)
    with session.listen(frames.append):
        wait_until(lambda: failing.is_closed and len(frames) >= 3)
    assert str(failing.failure) == "a mistake of the user's function"


def test_a_listener_may_ask_the_session(session):
    readings = []

    def read(frame):
        readings.append(session.at(frame, 50, frame.picture.shape[1] // 2))

    with session.listen(read):
        wait_until(lambda: readings)
    assert readings[0].body in ("wall", "ball", "")


@pytest.mark.slow
def test_many_threads_change_and_ask_at_once(session):
    failures = []

    def change(number):
        try:
            for step in range(4):
                session.change(range_m=6.0 + (number + step) % 3)
                session.move_body("ball", sg.pose(4 + 0.1 * number, 0, 0))
                frame = session.next_frame()
                session.at(frame, 40, 40)
        except Exception as why:
            failures.append(why)

    threads = [threading.Thread(target=change, args=(number,)) for number in range(4)]
    with session.listen(lambda frame: None):
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(WAIT_S)
    assert failures == [] and not any(thread.is_alive() for thread in threads)


# ---- read-outs -----------------------------------------------------------------------------------------


def ball_bin(frame):
    """Return beam and bin of the point of the ball that is nearest to a sonar at the origin."""
    azimuth, range_m = math.atan2(BALL_M[1], BALL_M[0]), np.linalg.norm(BALL_M) - RADIUS_M
    return np.abs(frame.ping.azimuth_rad - azimuth).argmin(), np.abs(
        frame.ping.range_m - range_m
    ).argmin() + 1


def test_a_bin_says_what_stands_in_it(session):
    frame = session.frame
    beam, bin = ball_bin(frame)
    found = session.reading(frame, beam, bin)
    assert found.body == "ball"
    assert found.range_m == frame.ping.range_m[bin] and found.azimuth_rad == frame.ping.azimuth_rad[beam]
    # the nearest point lies in the direction of the middle; the bin holds a cap of the ball about it
    elevation = math.atan2(BALL_M[2], math.hypot(*BALL_M[:2]))
    assert found.elevation_rad == pytest.approx(elevation, abs=RADIUS_M / np.linalg.norm(BALL_M))
    intensity = frame.ping.intensity[beam, bin]
    assert found.level_db == pytest.approx(10 * math.log10(intensity), abs=1e-9)  # of one float32
    assert found.count == frame.ping.counts()[beam, bin]


def test_a_pixel_says_what_it_shows_and_nothing_outside_the_fan(session):
    frame = session.frame
    row, column = brightest_pixel(session, frame, "ball")
    found, cell = session.at(frame, row, column), pixel_cells(frame.ping, frame.settings)[row, column]
    assert (found.beam, found.bin) == divmod(cell, 200) and found.range_m < 5.5  # the wall is at 9 m
    for row, column in ((99, 0), (-1, 5), (100, 5), (5, 10_000)):
        assert session.at(frame, row, column) is None


def test_an_empty_bin_has_no_body(session):
    found = session.reading(session.frame, 0, 0)
    assert (found.body, found.elevation_rad, found.level_db, found.count) == ("", None, -math.inf, 0)
    with pytest.raises(sg.Error, match=r"beam must be a whole number in 0\.\.63"):
        session.reading(session.frame, 64, 0)


def test_the_surface_of_a_bin_lies_where_its_echo_comes_from(session):
    frame = session.frame
    beam, bin = ball_bin(frame)
    found = session.surface_of(frame, beam, bin)
    points = found.points_m.astype(np.float64)
    assert len(points) > 10 and set(found.body_id) == {2}
    # on the ball: its triangles lie up to 1 - cos(half of an edge's angle of 4 degrees) inside, and float32 rounds
    assert np.linalg.norm(points - BALL_M, axis=1) == pytest.approx(RADIUS_M, abs=1e-3)
    # in the bin, or not farther from it than half of the way to the next sample, which is 0.01 degrees away
    half_bin_m = frame.ping.bin_size_m / 2
    assert np.abs(np.linalg.norm(points, axis=1) - frame.ping.range_m[bin]).max() < half_bin_m + 0.01
    azimuth = np.arctan2(points[:, 1], points[:, 0])
    assert np.abs(azimuth - frame.ping.azimuth_rad[beam]).max() < math.radians(0.5) + 1e-6
    towards = -points / np.linalg.norm(points, axis=1)[:, None]
    assert ((found.normals * towards).sum(axis=1) > 0).all()


@pytest.mark.slow
def test_labelled_bins_have_a_surface_of_their_body(session):
    session.change(tolerance=0.001)  # coarser samples spread the ball's rim into bins beside it
    frame = session.next_frame()
    bodies = bodies_in(session, frame)
    for number, body in ((1, "wall"), (2, "ball")):
        found = np.argwhere(bodies == body)
        assert len(found)
        for beam, bin in found[:: max(1, len(found) // 15)]:
            assert number in session.surface_of(frame, beam, bin).body_id


def test_surfaces_and_labels_are_those_of_the_frame_after_bodies_were_moved(session):
    frame = session.frame
    session.move_body("ball", None)
    session.next_frame()
    beam, bin = ball_bin(frame)
    assert set(session.surface_of(frame, beam, bin).body_id) == {2}
    assert session.reading(frame, beam, bin).body == "ball"
    assert not (bodies_in(session, session.next_frame()) == "ball").any()


def test_labels_of_a_still_are_its_own_though_it_has_the_number_of_the_first_frame(session):
    first = session.frame
    beam, bin = ball_bin(first)
    assert session.reading(first, beam, bin).body == "ball"
    session.move_body("ball", None)
    still = session.still(session.next_frame())
    assert still.number == first.number == 0
    assert session.reading(still, beam, bin).body != "ball"


def test_a_tilted_head_sees_its_surface(scene):
    tilted = QUIET.changed(sonar=replace(SONAR, tilt_deg=30.0))
    with LiveSession(scene, tilted, sg.pose(pitch=-math.radians(30))) as session:
        beam, bin = ball_bin(session.frame)
        assert set(session.surface_of(session.frame, beam, bin).body_id) == {2}


def test_a_beam_that_is_a_cone_sees_its_surface_further_aside_than_it_points():
    sonar = replace(SONAR, n_beams=128, azimuth_fov_deg=120.0, beam_spacing="sine")
    azimuth, elevation = math.radians(55.0), math.radians(-9.0)
    level = math.cos(elevation)
    place = 8.0 * np.array([level * math.cos(azimuth), level * math.sin(azimuth), math.sin(elevation)])
    ball = sg.Body("ball", trimesh.creation.icosphere(4, 0.1), sg.pose(*place), 0.8)
    settings = QUIET.changed(sonar=sonar, acoustics=sg.Acoustics.physical(far_side_lobes=False))
    with LiveSession(sg.Scene([ball]), settings, np.eye(4)) as session:
        frame = session.frame
        beam, bin = np.unravel_index(frame.ping.intensity.argmax(), frame.ping.intensity.shape)
        points = session.surface_of(frame, beam, bin).points_m
    assert len(points) and np.abs(np.linalg.norm(points - place, axis=1) - 0.1).max() < 1e-3
    # 0.65 degrees beside, which is more than half of the beam's width
    assert azimuth - frame.ping.azimuth_rad[beam] > math.radians(0.6)


def test_frames_highlight_the_pixels_of_a_body(session):
    first = session.frame
    plain = pixels_of(bodies_in(session, first) == "ball", pixel_cells(first.ping, first.settings))
    session.highlight("ball")
    frame = session.next_frame()
    assert frame.highlight.tolist() == plain.tolist() and plain.any()
    assert frame.picture.tolist() == session.frame.picture.tolist()
    session.highlight()
    assert session.next_frame().highlight is None


def test_what_noise_hides_has_neither_a_reading_nor_a_highlight(scene):
    """The echo of the wall lies below the noise at -12 dB, that of the ball in part above it."""
    settings = QUIET.changed(noise="ambient_db=-12", counts=sg.Counts(low_db=-60.0))
    quiet = expected(scene, settings.changed(noise="none"), labels=True, label_level_db=-180.0)
    is_above = quiet.intensity >= np.float32(10**-1.2)
    with LiveSession(scene, settings) as session:
        bodies = bodies_in(session, session.frame, quiet.intensity > 0)
        for body, number in (("wall", 1), ("ball", 2)):
            assert ((bodies == body) == (is_above & (quiet.body_id == number))).all()
        assert (quiet.body_id == 1).any() and set(bodies.flat) == {"", "ball"}
        beam, bin = np.argwhere(quiet.body_id == 1)[0]
        reading = session.reading(session.frame, beam, bin)
        assert reading.body == "" and reading.elevation_rad is None and reading.count > 0
        plain = pixels_of(bodies == "ball", pixel_cells(session.frame.ping, settings))
        session.highlight("ball")
        assert session.next_frame().highlight.tolist() == plain.tolist()
        session.highlight("wall")
        assert not session.next_frame().highlight.any()


def test_labels_follow_the_gain_of_the_display(session):
    session.change(counts=sg.Counts(low_db=-30.0))
    strict = session.next_frame()
    session.change(counts=sg.Counts(low_db=-60.0))
    lenient = session.next_frame()
    bodies = bodies_in(session, strict)
    assert (bodies == "wall").sum() < (bodies_in(session, lenient) == "wall").sum()
    least = sg.Counts(low_db=-30.0).least_shown(strict.ping.intensity)
    assert strict.ping.intensity[bodies == "ball"].min() >= np.float32(least)


# ---- end -----------------------------------------------------------------------------------------------


def test_a_closed_session_leaves_no_thread_and_says_so(scene):
    before = set(threading.enumerate())
    session = LiveSession(scene, QUIET)
    session.listen(lambda frame: None)
    wait_until(lambda: session.frame.number > 1)
    session.close()
    session.close()
    # threads of Numba and of the simulator are shared by all
    left = {one.name for one in set(threading.enumerate()) - before if one.is_alive()}
    assert not {name for name in left if "live" in name or "listener" in name}
    for call in (
        session.next_frame,
        lambda: session.listen(print),
        lambda: session.reading(session.frame, 0, 0),
    ):
        with pytest.raises(sg.Error, match="this LiveSession is closed"):
            call()
    assert session.wait_closed(0.0)


def test_a_scene_without_a_sonar_needs_a_pose(scene):
    with pytest.raises(sg.Error, match="has no sonar in it; give a pose"):
        LiveSession(sg.Scene(scene.bodies), QUIET)


def test_a_first_ping_that_fails_is_an_error(scene):
    with pytest.raises(sg.Error, match="settings must be a LiveSettings"):
        LiveSession(scene, None)
    with pytest.raises(sg.Error, match="pose"):
        LiveSession(scene, QUIET, pose=np.zeros((4, 4)))
