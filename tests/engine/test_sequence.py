"""Sequences of pings: identical to single pings, in order, without leaks."""

import math
import re
import threading
import tracemalloc
import warnings
from itertools import chain, count, islice

import numpy as np
import pytest
import trimesh

import sonar_gl as sg
from sonar_gl.core.warn import collected_warnings
from sonar_gl.core.worker import Job, JobThreads
from sonar_gl.engine import ping_worker, pipeline, sequence, world
from sonar_gl.engine.adaptive import LOOP_PINGS
from sonar_gl.engine.flow import Resolution
from sonar_gl.engine.no_echo import MOST_IN_A_ROW, NoEchoWarning
from sonar_gl.engine.request import PingRequest
from sonar_gl.engine.run import Run
from sonar_gl.engine.stage import KEPT_VIEWS, StageCache
from tests.support.errors import error_of
from tests.support.estimates import record_estimates
from tests.support.same_pings import check_all_same, check_same
from tests.support.waiting import wait_until

SONAR = sg.Sonar("test", 900e3, 64, 200, 60.0, 20.0, 1.5, 0.5, 20.0)
SAMPLING = sg.Sampling(2, 40)
BALL = trimesh.creation.icosphere(3, 0.5)
BODIES = (
    sg.Body("wall", trimesh.creation.box((1, 40, 40)), sg.pose(14), 0.3),
    sg.Body("box", trimesh.creation.box((1, 1, 1)), sg.pose(6, 2), 0.8),
    sg.Body("ball", BALL, sg.pose(8, -1), 0.6, np.asarray(BALL.vertices, np.float32) * 2),
)
ROUGH_SEA = sg.Water(volume_backscatter_db=-70.0, wind_speed_m_s=10.0)
FEW_SAMPLES = sequence.FEW_SAMPLES  # as the program has it
POSES = [sg.pose(0.1 * k, 0.05 * k, 0, 0, 0.01 * k, 0.02 * k) for k in range(11)]
MOVED = [
    None if k % 3 == 0 else {"box": sg.pose(6, 2 - 0.3 * k), "ball": None if k % 2 else sg.pose(9, 0.1 * k)}
    for k in range(11)
]


# a near one comes into view where the sonar turns
ASIDE = (
    sg.Body("far", trimesh.creation.box((1, 6, 6)), sg.pose(15), 0.2),
    sg.Body("near", trimesh.creation.box((0.1, 2, 2)), sg.pose(3, 3.0), 1.0),
)
TURN = [sg.pose(yaw=0.04 * k) for k in range(14)]


def simulator(sampling=SAMPLING, bodies=BODIES, **kw):
    return sg.Simulator(sg.Scene(bodies), SONAR, sg.Acoustics.ideal(), sampling, **kw)


@pytest.fixture(autouse=True)
def several_threads(monkeypatch):
    """Have another thread make the pings, small as they are, and as many ahead on any number of cores."""
    monkeypatch.setattr(sequence, "FEW_SAMPLES", 0)
    monkeypatch.setattr(sequence, "n_threads", lambda: 2)


@pytest.fixture
def it():
    with simulator() as one:
        yield one


@pytest.mark.parametrize("labels", [False, True])
@pytest.mark.parametrize("n", [1, 4, 11])
def test_a_sequence_gives_the_pings_of_single_calls(it, n, labels):
    """The numbers of pings are less than a batch, whole batches, and in between."""
    together = list(it.pings(POSES[:n], labels=labels))
    check_all_same(together, (it.ping(pose, labels=labels) for pose in POSES[:n]))
    assert len({ping.intensity.tobytes() for ping in together}) == n


def test_noise_depends_on_the_ping_number(it):
    noise = sg.Noise(speckle=True, ambient_db=-90.0)
    together = list(it.pings(POSES[:6], noise, seed=5))
    for number, ping in enumerate(together):
        check_same(ping, it.ping(POSES[number], noise, seed=5, ping_number=number))
    wrong = it.ping(POSES[5], noise, seed=5, ping_number=4).intensity
    assert np.abs(wrong - together[5].intensity).max() > 0.01 * wrong.max()


@pytest.mark.parametrize("labels", [False, True])
def test_bodies_of_each_pose(it, labels):
    together = list(it.pings(POSES, labels=labels, bodies=MOVED))
    check_all_same(
        together,
        (it.ping(pose, labels=labels, bodies=moved) for pose, moved in zip(POSES, MOVED, strict=True)),
    )
    before = it.ping(POSES[1]).intensity
    assert (before != together[1].intensity).any()


def test_shadows_of_the_bodies_of_each_pose(it):
    """The background of each pose is drawn without the moving bodies."""
    together = list(it.pings(POSES, labels=True, bodies=MOVED, background=["wall"]))
    check_all_same(
        together,
        (
            it.ping(pose, labels=True, bodies=moved, background=["wall"])
            for pose, moved in zip(POSES, MOVED, strict=True)
        ),
    )
    assert len({ping.shadow.tobytes() for ping in together}) == len(POSES)


def test_several_sectors_and_a_larger_image_later():
    """A batch needs a larger image than the one before."""
    wide = sg.Sonar("wide", 900e3, 128, 200, 250.0, 20.0, 2.0, 0.5, 20.0)
    poses = [sg.pose(x, yaw=0.3) for x in (-80, -80, -80, -80, 5, 5.2, 5.4, 5.6, -40, 5)]
    with (
        sg.Simulator(sg.Scene(BODIES), wide, sg.Acoustics.ideal(), SAMPLING) as it,
        warnings.catch_warnings(),
    ):
        warnings.simplefilter("ignore")  # far away there is no echo
        together = list(it.pings(poses, labels=True))
        check_all_same(together, (it.ping(pose, labels=True) for pose in poses))
    assert together[0].intensity.sum() == 0
    assert together[4].intensity.sum() > 0


def test_later_pings_do_not_overwrite_earlier_ones(it):
    copies = []
    for ping in it.pings(POSES, labels=True):
        copies.append((ping, ping.intensity.copy(), ping.body_id.copy(), ping.meta.copy()))
    assert len(copies) == len(POSES)
    for ping, intensity, body_id, meta in copies:
        np.testing.assert_array_equal(ping.intensity, intensity)
        np.testing.assert_array_equal(ping.body_id, body_id)
        assert ping.meta == meta


@pytest.mark.parametrize("nothing", [[], iter([]), np.empty((0, 4, 4))])
def test_no_poses_give_no_pings(it, nothing):
    assert list(it.pings(nothing)) == []
    assert it.ping(POSES[0]).intensity.any()


def test_poses_as_one_array(it):
    together = list(it.pings(np.stack(POSES[:3])))
    check_all_same(together, map(it.ping, POSES[:3]))


@pytest.mark.parametrize("stop", [1, 4, 9])
def test_an_endless_sequence_may_be_stopped(it, stop):
    """A caller may stop after any ping; the simulator goes on."""
    requested = []

    def poses():
        for k in count():
            requested.append(k)
            yield POSES[k % 11]

    expected = [it.ping(pose).intensity for pose in POSES]
    threads = set(threading.enumerate())
    pings = it.pings(poses())
    for number, ping in enumerate(islice(pings, stop)):
        np.testing.assert_array_equal(ping.intensity, expected[number % 11])
    assert len(requested) <= stop + 2 * sequence.BATCH
    if stop % 2:
        pings.close()
    else:
        del pings
    np.testing.assert_array_equal(it.ping(POSES[3]).intensity, expected[3])
    for number, ping in enumerate(it.pings(POSES[:5])):
        np.testing.assert_array_equal(ping.intensity, expected[number])
    wait_until(lambda: set(threading.enumerate()) <= threads)  # they end by themselves


def test_pings_without_an_echo_are_explained_as_in_single_calls(it):
    """By their own samples, which later pings may have overwritten; of eight in a row the first five."""
    silent = [sg.pose(-40 - k) for k in range(8)]
    poses = [POSES[0], silent[0], POSES[1], *silent, POSES[2], silent[1]]
    with collected_warnings(NoEchoWarning) as of_sequence:
        pings = list(it.pings(poses))
    with simulator() as another, collected_warnings(NoEchoWarning) as of_calls:
        for pose in poses:
            another.ping(pose)
    assert [ping.meta["has_echo"] for ping in pings] == [True, False, True] + [False] * 8 + [True, False]
    assert [one.text for one in of_sequence] == [one.text for one in of_calls]
    assert len({one.text for one in of_calls}) == MOST_IN_A_ROW and len(of_calls) == MOST_IN_A_ROW + 2


def test_invalid_poses_raise_errors():
    with simulator() as it:
        for poses in (np.eye(4), 3, None):
            why = f"poses must be several poses (got {type(poses).__name__}; make [pose] of one)"
            assert error_of(lambda poses=poses: list(it.pings(poses))) == why
        it.close()
        assert error_of(lambda: list(it.pings(POSES))) == "this Simulator is closed; make a new one"


@pytest.mark.parametrize("n", [1, 3])
def test_pings_after_a_sequence_that_was_left_follow_the_last_one_that_came_out(n):
    """Not those that were made ahead, more of them with more cores, which lie far from the one after."""
    path = [sg.pose(0.01 * k) for k in range(n)] + [sg.pose(0.9)] * 5
    after = sg.pose(-0.5)

    with simulator(None, tolerance=0.02) as alone:
        *before, expected = [alone.ping(pose) for pose in [*path[:n], after]]
    with simulator(None, tolerance=0.02) as left:
        pings = left.pings(path)
        check_all_same(before, islice(pings, n))
        pings.close()
        check_same(left.ping(after), expected)


def test_pings_that_an_interrupt_kept_from_being_started_leave_no_history(monkeypatch):
    path, after = [sg.pose(), sg.pose(0.9)], sg.pose(-0.5)

    def interrupted(*_):
        raise KeyboardInterrupt

    with simulator(None, tolerance=0.02) as alone:
        _, expected = [alone.ping(pose) for pose in [path[0], after]]
    with simulator(None, tolerance=0.02) as left:
        with monkeypatch.context() as patched, pytest.raises(KeyboardInterrupt):
            patched.setattr(Run, "await_job", interrupted)
            list(left.pings(path))
        check_same(left.ping(after), expected)


@pytest.mark.parametrize("fails", ["report", "finish"])
def test_a_ping_that_fails_as_it_comes_out_leaves_what_it_leaves_in_single_calls(fails, monkeypatch):
    """Later pings had its samples, but not its place: half of it had come out."""
    path, after = [sg.pose(), sg.pose(0.02), sg.pose(yaw=0.6), sg.pose(yaw=0.61)], sg.pose(0.01)

    def failing(real):
        calls = []

        def call(*arguments):
            calls.append(1)
            if len(calls) == 3:
                raise MemoryError
            return real(*arguments)

        return call

    def pings_after(make):
        with simulator(None, tolerance=0.02, engine="cpu") as it:
            with monkeypatch.context() as patched, pytest.raises(MemoryError):
                if fails == "report":
                    patched.setattr(Run, "report", failing(Run.report))
                for module in (pipeline, sequence) if fails == "finish" else ():
                    patched.setattr(module, "finish", failing(finish))
                for _ in make(it):
                    pass
            history = it.run.sampler.history
            return history.n_pings, history.last.request.pose.tolist(), it.ping(after)

    finish = pipeline.finish
    (n, last, one), (n_other, last_other, other) = (
        pings_after(make) for make in (lambda it: it.pings(path), lambda it: map(it.ping, path))
    )
    assert (n, last) == (n_other, last_other)
    check_same(one, other)


@pytest.mark.parametrize(("first", "later"), [(LOOP_PINGS - 2, 0), (LOOP_PINGS + 2, 4)])
def test_a_body_that_appears_later_gets_finer_samples(first, later):
    """With a tolerance the samples are those of single pings, and finer from the first ping with the body on.

    In a loop, which must not stall, only once two pings have shared the check, and two more have made the stages.
    """
    wall = sg.Body("wall", trimesh.creation.box((1, 60, 60)), sg.pose(9), 0.3)
    buoy = sg.Body("buoy", trimesh.creation.icosphere(2, 0.06), sg.pose(4, 0.3), 1.0)
    bodies = [{"buoy": None} if k < first else None for k in range(first + 5)]
    with simulator(None, [wall, buoy], tolerance=0.05) as it:
        alone = [it.ping(POSES[0], bodies=moved) for moved in bodies]
    with simulator(None, [wall, buoy], tolerance=0.05) as it:
        together = list(it.pings([POSES[0]] * len(bodies), bodies=bodies))
    columns = [ping.meta["sampling"]["columns_per_beam"] for ping in together]
    assert columns == [ping.meta["sampling"]["columns_per_beam"] for ping in alone]
    assert len(set(columns[: first + later])) == 1 and columns[first + later] > columns[0]
    assert (together[first].error_estimate > 0.05) == (later > 0)


def test_a_body_that_appears_in_a_loop_is_unverified_until_a_check():
    """Of so many faces that its check must wait: the estimate without the body would be far below its error."""
    wall = sg.Body("wall", trimesh.creation.box((1, 60, 60)), sg.pose(9), 0.3)
    buoy = sg.Body("buoy", trimesh.creation.icosphere(5, 0.06), sg.pose(4, 0.3), 1.0)
    first = LOOP_PINGS + 2
    with simulator(None, [wall, buoy], tolerance=0.05) as it:
        before = [it.ping(POSES[0], bodies={"buoy": None}) for _ in range(first)]
        after = [it.ping(POSES[0]) for _ in range(3)]
    assert before[-1].error_estimate < 0.05
    assert {ping.meta["sampling"]["rows"] for ping in after} == {before[-1].meta["sampling"]["rows"]}
    assert all(ping.error_estimate > 0.05 for ping in after)


def test_a_change_of_the_echo_causes_a_new_estimate(monkeypatch):
    """The sonar turns slowly until a near body comes into view: the error is estimated at once."""
    with simulator(None, ASIDE, tolerance=0.05) as it:
        alone = [it.ping(pose) for pose in TURN]
    with simulator(None, ASIDE, tolerance=0.05) as it:
        estimates = record_estimates(monkeypatch)
        together = list(it.pings(TURN))
    assert len(estimates) >= 2
    check_all_same(together, alone)


@pytest.mark.parametrize("good", [0, 4])
@pytest.mark.parametrize("way", ["pose", "raise", "bodies"])
def test_an_error_in_the_poses_is_raised_in_order(good, way):
    """The pings before the error come first, then the error itself; the simulator goes on."""

    def poses():
        yield from POSES[:good]
        if way == "raise":
            raise KeyError("no more poses")
        yield 2 * np.eye(4) if way == "pose" else POSES[0]

    bodies = [None] * good + [{"diver": None}] if way == "bodies" else None
    with simulator() as it:
        expected, got = [it.ping(pose).intensity for pose in POSES], []
        with pytest.raises(KeyError if way == "raise" else sg.Error):
            for ping in it.pings(poses(), bodies=bodies):
                got.append(ping.intensity)
        assert len(got) == good
        for one, other in zip(got, expected, strict=False):
            np.testing.assert_array_equal(one, other)
        np.testing.assert_array_equal(it.ping(POSES[2]).intensity, expected[2])


def test_an_interrupt_in_the_poses_is_raised_at_once(it):
    """A caller that stops at one of the pings before would never get it."""

    def poses():
        yield from POSES[:2]
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        next(it.pings(poses()))


def test_the_simulator_is_not_locked_between_pings_of_a_sequence():
    """A single ping between those of a sequence does not block; a lock held over a yield would."""
    with simulator(None, ASIDE, tolerance=0.05) as it:
        for _ in it.pings(TURN):
            it.ping(POSES[0])


def test_other_pings_between_those_of_a_sequence(it):
    """The simulator can make other pings while a sequence waits."""
    expected = [it.ping(pose, labels=True) for pose in POSES]
    there = it.ping(POSES[7], bodies={"box": None})
    for ping, alone in zip(it.pings(POSES, labels=True), expected, strict=True):
        check_same(ping, alone)
        check_same(it.ping(POSES[7], bodies={"box": None}), there)


def test_two_interleaved_sequences(it):
    expected = [it.ping(pose).intensity for pose in POSES]
    both = zip(it.pings(POSES), it.pings(POSES[::-1]), expected, expected[::-1], strict=True)
    for one, other, alone, alone_back in both:
        np.testing.assert_array_equal(one.intensity, alone)
        np.testing.assert_array_equal(other.intensity, alone_back)


def test_pings_from_another_thread_during_a_sequence(it):
    expected = [it.ping(pose, labels=True) for pose in POSES]
    stop, found = threading.Event(), []

    def others():
        while not stop.is_set():
            found.append(it.ping(POSES[4], labels=True))

    thread = threading.Thread(target=others)
    thread.start()
    try:
        for _ in range(3):
            check_all_same(it.pings(POSES, labels=True), expected)
    finally:
        stop.set()
        thread.join()
    assert len(found) > 2
    check_all_same(found, [expected[4]] * len(found))


def test_interleaved_sequences_of_two_sonars(it):
    other = sg.Sonar("other", 450e3, 32, 100, 90.0, 15.0, 3.0, 0.5, 15.0)
    with sg.Simulator(it, other, sg.Acoustics.ideal(), SAMPLING) as second:
        expected = [sonar.ping(pose, labels=True) for pose in POSES for sonar in (it, second)]
        pairs = zip(it.pings(POSES, labels=True), second.pings(POSES, labels=True), strict=True)
        check_all_same(chain.from_iterable(pairs), expected)


def test_a_body_added_during_a_sequence_is_in_later_pings():
    """Pings drawn before belong to the old scene; no ping is lost, and body numbers stay."""
    with simulator(bodies=BODIES[:2]) as it:
        before = [it.ping(pose, labels=True) for pose in POSES]
        pings = it.pings(POSES, labels=True)
        together = list(islice(pings, 2))
        it.add(BODIES[2])
        with pytest.warns(UserWarning, match="bodies were placed or added between two pings"):
            together += pings
        after = [it.ping(pose, labels=True) for pose in POSES]
    assert len(together) == len(POSES)
    old = [len(ping.body_echo) == 3 for ping in together]
    assert old == sorted(old, reverse=True)
    assert 3 <= sum(old) <= 2 + 2 * sequence.BATCH
    assert all(len(ping.meta["bodies"]) == len(ping.body_echo) - 1 for ping in together)
    for number, ping in enumerate(together):
        expected = (before if old[number] else after)[number]
        np.testing.assert_array_equal(ping.intensity, expected.intensity)
        np.testing.assert_array_equal(ping.body_id, expected.body_id)


def test_pings_know_the_bodies_of_their_poses_whoever_makes_them(monkeypatch):
    """Of pings whose poses were taken before a body was added, those that were drawn after it named it."""

    def pings(few_samples):
        monkeypatch.setattr(sequence, "FEW_SAMPLES", few_samples)
        with simulator(bodies=BODIES[:2], engine="cpu") as it, warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of the body that was added
            for number, ping in enumerate(it.pings(POSES)):
                yield ping
                if number == 1:
                    it.add(BODIES[2])

    by_threads, by_the_caller = list(pings(0)), list(pings(math.inf))
    check_all_same(by_threads, by_the_caller)
    assert {len(ping.meta["bodies"]) for ping in by_threads[3:]} == {2, 3}


def test_a_body_added_before_a_ping_without_an_echo_is_absent_from_it():
    """Such a ping is drawn again, to find out why, when the scene has more bodies than its request knew."""
    away = sg.pose(yaw=3.0)
    with simulator(bodies=BODIES[:2]) as it:
        pings = it.pings([POSES[0], away, POSES[1]], labels=True)
        together = [next(pings)]
        it.add(BODIES[2])
        with pytest.warns(UserWarning, match="no echo"):
            together += pings
    assert [ping.meta["has_echo"] for ping in together] == [True, False, True]
    assert not together[1].body_id.any()


def test_a_plume_added_during_a_sequence_is_named_by_the_pings_that_have_it():
    with simulator() as it:
        pings = it.pings(POSES)
        together = list(islice(pings, 2))
        it.add(sg.Bubbles("plume", sg.pose(6, 1, -2)))
        with pytest.warns(UserWarning, match="bodies were placed or added between two pings"):
            together += pings
        again = it.ping(POSES[0])
    named = [ping.meta.get("plumes", []) for ping in [*together, again]]
    n_old = named.index(["plume"])
    assert 3 <= n_old <= 2 + 2 * sequence.BATCH
    assert named == [[]] * n_old + [["plume"]] * (len(named) - n_old)


def test_the_poses_may_come_from_a_generator_that_uses_the_simulator(it):
    """Each ping has the scene as it was when its pose came. The naive way holds the lock meanwhile, and hangs."""
    bodies = [{"box": sg.pose(6, 2 - 0.3 * k)} for k in range(11)]
    expected = [it.ping(pose, bodies=moved, labels=True) for pose, moved in zip(POSES, bodies, strict=True)]

    def poses():
        for pose, moved in zip(POSES, bodies, strict=True):
            it.place(moved)
            assert it.ping(pose).intensity.any()
            yield pose

    check_all_same(it.pings(poses(), labels=True), expected)


@pytest.mark.parametrize("change", ["place", "add"])
def test_bodies_that_change_between_two_pings_are_warned_of_once(it, change):
    """Pings made ahead have the bodies where they were: without a word, the picture lags behind the program."""
    lines = []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for number, _ in enumerate(it.pings(POSES)):
            if change == "place":
                it.place({"box": sg.pose(6, 1.7 - 0.3 * number)})
            else:
                it.add(sg.Body(f"ball {number}", BALL, sg.pose(8, 0.3 * number)))
            lines.append(len(caught))
    assert lines == [0] + [1] * 10
    text = str(caught[0].message)
    match = re.fullmatch(
        r"bodies were placed or added between two pings of a sequence, whose next "
        r"(?:(\d+) pings are made ahead and have|ping is made ahead and has) them as they were; "
        r"give bodies= to pings\(\), place them in the generator of poses, or use ping\(\)",
        text,
    )
    assert 1 <= int(match[1] or 1) <= 10  # one on a machine with one core
    assert caught[0].filename == __file__


def test_bodies_that_change_where_no_ping_was_made_ahead_are_not_warned_of(it):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for _ in it.pings(POSES):  # left before the next ping
            it.place({"box": sg.pose(6)})
            break
        for _ in it.pings(POSES[:1]):  # there is no next ping
            it.place({"box": sg.pose(6, 1)})
        for pose in POSES[:2]:
            it.place({"box": sg.pose(6, 2)})
            it.ping(pose)
        where = it.scene.bodies[0].pose
        it.place({it.scene.bodies[0].name: where})
        for _ in it.pings(POSES):  # nothing changes
            it.place({})
            it.place({it.scene.bodies[0].name: where})


def test_bodies_that_generators_place_are_not_warned_of(it):
    """Two sequences of one world in turns: each generator places the bodies of its next pings while the other waits."""

    def poses(y_m):
        for number, pose in enumerate(POSES):
            it.place({"box": sg.pose(6, y_m - 0.3 * number)})
            yield pose

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for _ in zip(it.pings(poses(2)), it.pings(poses(1)), strict=True):
            pass


def test_a_sequence_that_ends_after_its_simulator_keeps_no_workers():
    """Their stages would stay in memory as long as the simulator is held."""
    it = simulator()
    run, pings = it.run, it.pings(POSES)
    next(pings)
    it.close()
    pings.close()
    assert run.take_workers(1, lambda: "new") == ["new"]


def test_a_call_in_the_middle_of_a_ping_raises_an_error(it):
    """A signal handler, for example; the naive way waits for ever for the lock that its own thread holds."""
    expected = it.ping(POSES[0]).intensity
    with it.run.drawing(), pytest.raises(sg.Error, match="must not be used while it makes a ping"):
        it.ping(POSES[0])
    np.testing.assert_array_equal(it.ping(POSES[0]).intensity, expected)


def test_a_simulator_is_not_closed_in_the_middle_of_its_ping(it):
    """A signal handler tries it: an error, no hang; the simulator stays open."""
    with it.run.drawing(), pytest.raises(sg.Error, match="must not be used while it makes a ping"):
        it.close()
    assert it.ping(POSES[0]).intensity.any()


@pytest.mark.timeout(60, method="thread")  # a hang is one that no signal ends
@pytest.mark.parametrize("what", ["ping", "place", "close"])
def test_a_call_in_the_middle_of_a_ping_of_a_sequence_raises_an_error(it, monkeypatch, what):
    """The caller makes some of its pings itself: a signal handler then waited for ever for its own thread."""
    calls = {"ping": lambda: it.ping(POSES[0]), "place": lambda: it.place({"box": None}), "close": it.close}
    expected, messages = [ping.intensity for ping in it.pings(POSES)], []
    receive = pipeline.receive

    def receive_and_call(drawn):
        if threading.current_thread() is threading.main_thread():
            messages.append(error_of(calls[what]))
        return receive(drawn)

    for module in (ping_worker, pipeline, sequence):
        monkeypatch.setattr(module, "receive", receive_and_call)
    monkeypatch.setattr(JobThreads, "submit", lambda *_: None)  # the caller makes all of them
    for ping, right in zip(it.pings(POSES), expected, strict=True):
        np.testing.assert_array_equal(ping.intensity, right)
    assert len(messages) == len(POSES)
    assert all("must not be used while it makes a ping" in message for message in messages)


@pytest.mark.timeout(60)
@pytest.mark.parametrize("where", ["start", "submit"])
def test_an_interrupt_while_pings_are_handed_over_leaves_later_pings_right(it, monkeypatch, where):
    """An executor of the standard library forgets a thread whose start is interrupted: it went on summing."""
    expected = [ping.intensity for ping in it.pings(POSES)]
    owner = threading.Thread if where == "start" else JobThreads
    original = getattr(owner, where)

    def interrupted(self, *arguments):
        original(self, *arguments)
        if threading.current_thread() is threading.main_thread():
            raise KeyboardInterrupt

    for _ in range(10):
        with monkeypatch.context() as patch:
            patch.setattr(owner, where, interrupted)
            with pytest.raises(KeyboardInterrupt):
                list(it.pings(POSES))
        for pose, right in zip(POSES[::4], expected[::4], strict=True):
            np.testing.assert_array_equal(it.ping(pose).intensity, right)
    for ping, right in zip(it.pings(POSES), expected, strict=True):
        np.testing.assert_array_equal(ping.intensity, right)


def test_a_ping_of_another_thread_in_between_does_not_change_the_estimate(monkeypatch):
    """What a ping reports is taken while it holds the lock."""
    assemble = pipeline.assemble
    with simulator(None, ASIDE, tolerance=0.05) as it:
        expected = it.ping(POSES[0]).error_estimate
        here = threading.current_thread()

        def interleaved(*arguments):
            if threading.current_thread() is here:
                other = threading.Thread(target=it.ping, args=(sg.pose(yaw=0.5),))
                other.start()
                other.join()
            return assemble(*arguments)

        monkeypatch.setattr(pipeline, "assemble", interleaved)
        assert it.ping(POSES[0]).error_estimate == expected
        monkeypatch.undo()
        assert it.ping(sg.pose(yaw=0.5)).error_estimate != expected


def test_a_generator_of_poses_may_add_bodies():
    """A body is absent from the pings whose poses came before it was added."""
    with simulator(bodies=BODIES[:2]) as it:
        before = [it.ping(pose, labels=True, background=["wall"]) for pose in POSES[:6]]

        def poses():
            yield from POSES[:6]
            it.add(BODIES[2])
            yield from POSES[6:]

        together = list(
            it.pings(poses(), labels=True, background=["wall"], reflectivities=[{"box": 0.8}] * 11)
        )
        after = [it.ping(pose, labels=True, background=["wall"]) for pose in POSES[6:]]
    assert len(together) == len(POSES)
    for ping, single in zip(together, before + after, strict=True):
        for name in ("intensity", "body_id", "shadow"):
            np.testing.assert_array_equal(getattr(ping, name), getattr(single, name))


@pytest.mark.slow
@pytest.mark.parametrize("step_rad", [0.01, 0.02])
def test_samples_do_not_flicker_where_they_change_within_a_batch(step_rad):
    """Pings that were drawn ahead, before the samples changed, are drawn once more: 41 rows, then 58, never back."""
    near = sg.Body("near", trimesh.creation.box((0.1, 2, 2)), sg.pose(5, 4.0), 1.0)
    far = sg.Body("far", trimesh.creation.box((1, 6, 6)), sg.pose(15), 0.2)
    poses = [sg.pose(yaw=step_rad * k) for k in range(24)]
    with simulator(None, [far, near], tolerance=0.01) as it:
        single = [it.ping(pose) for pose in poses]
    with simulator(None, [far, near], tolerance=0.01) as it:
        together = list(it.pings(poses))
    rows = [ping.meta["sampling"]["rows"] for ping in together]
    assert rows == sorted(rows) and rows[0] < rows[-1]
    check_all_same(together, single)


@pytest.mark.slow
def test_memory_does_not_grow():
    with simulator() as it:

        def some(n):
            for ping in it.pings(POSES[k % 11] for k in range(n)):
                del ping

        some(12)
        tracemalloc.start()
        some(8)
        _, few = tracemalloc.get_traced_memory()
        tracemalloc.reset_peak()
        some(200)
        now, many = tracemalloc.get_traced_memory()
        tracemalloc.stop()
    # a ping has 51 kB; up to three batches are in progress and the pool keeps 16 arrays; 200 pings would be 10 MB
    assert many < 2_000_000
    assert now < few + 16 * 51_200


@pytest.mark.parametrize("after", [1, 4])
def test_an_error_in_the_caller_s_loop_is_raised(after):
    """The block closes the simulator while a batch is in progress; nothing waits for ever."""
    with pytest.raises(KeyError), simulator(sg.Sampling(16, 600)) as it:
        for number, _ in enumerate(it.pings((POSES[k % 11] for k in count()), labels=True), 1):
            if number == after:
                raise KeyError
    with simulator() as another:
        assert another.ping(POSES[0]).intensity.any()


def test_closing_the_simulator_ends_a_sequence_with_an_error():
    it = simulator()
    pings = it.pings(POSES[k % 11] for k in count())
    next(pings)
    it.close()
    assert error_of(list, pings) == "this Simulator is closed; make a new one"
    with simulator() as another:
        assert another.ping(POSES[0]).intensity.any()


ONE_A_POSE = {"times_s": 0.0, "bodies": {"box": None}, "velocities": None, "reflectivities": {"box": 0.1}}
ONE_A_POSE |= {"waters": None}


def test_all_lists_must_be_as_long_as_the_poses(it):
    for name, value in ONE_A_POSE.items():
        message = error_of(lambda name=name, value=value: list(it.pings(POSES[:3], **{name: [value]})))
        assert message.startswith(f"{name} must be as many as poses (got 1 for 3 poses")


def test_an_iterator_that_ends_before_the_poses_is_an_error_after_the_pings_before(it):
    refused = "{} must be as many as poses (got 5; pose 5, counted from 0, has none)".format
    for name, value in ONE_A_POSE.items():
        pings, made = it.pings((pose for pose in POSES), **{name: iter([value] * 5)}), []
        assert error_of(made.extend, pings) == refused(name)
        assert len(made) == 5
    assert error_of(it.plan, iter(POSES), times_s=iter([0.0] * 5)) == refused("times_s")


def test_an_iterator_may_go_on_beyond_the_poses(it):
    moved = ({"box": sg.pose(6 + 0.1 * k)} for k in count())
    assert len(list(it.pings(POSES[:3], bodies=moved, times_s=count()))) == 3
    assert next(moved)["box"][0, 3] == pytest.approx(6.3)  # as many were taken as there are poses


# ---- pings that lie far from each other ----------------------------------------------------------------

PLACES = [
    (0, 0, 0.0),
    (1, 3, 2.0),
    (-2, 1, -1.5),
    (-2, 1, -1.49),
    (2, -3, 0.4),
    (2, -3, 0.41),
    (2, -3, 0.42),
    (0, 0, 3.0),
]
FAR_AND_NEAR = [sg.pose(x, y, 0, yaw=yaw) for x, y, yaw in PLACES]
N_FAR = 4  # but for the first one, whose samples are searched


def round_about():
    """Return a scene with something to see from each of FAR_AND_NEAR, and a floor that mirrors bodies."""
    balls = [
        sg.Body(
            f"ball {k}", trimesh.creation.icosphere(3, 0.6), sg.pose(9 * math.cos(k), 9 * math.sin(k)), 0.8
        )
        for k in range(7)
    ]
    return sg.Scene(
        [*balls, sg.Body("floor", trimesh.creation.box((60, 60, 1)), sg.pose(0, 0, -3), "concrete")]
    )


@pytest.mark.parametrize("labels", [pytest.param(False, marks=pytest.mark.slow), True])
@pytest.mark.parametrize("multipath", ["none", "incoherent"])
def test_pings_far_from_each_other_are_those_of_single_calls(labels, multipath, monkeypatch):
    """Threads choose their samples side by side; those near to one of them wait for its choice."""
    started, job = [], ping_worker.PingWorker.job_apart
    monkeypatch.setattr(ping_worker.PingWorker, "job_apart", lambda *a: started.append(a) or job(*a))
    acoustics = sg.Acoustics("ideal", multipath=multipath)
    runs = []
    for many in (True, False):
        with sg.Simulator(round_about(), SONAR, acoustics, tolerance=0.05, engine="cpu") as it:
            make = (
                it.pings(FAR_AND_NEAR, labels=labels)
                if many
                else (it.ping(p, labels=labels) for p in FAR_AND_NEAR)
            )
            runs.append(list(make))
    assert len(started) >= N_FAR  # more often where image sources are made again
    for one, other in zip(*runs, strict=True):
        assert one.intensity.any()
        check_same(one, other)


@pytest.mark.parametrize(
    ("step_m", "tolerance"), [pytest.param(0.02, 0.02, marks=pytest.mark.slow), (0.06, 0.05)]
)
def test_image_sources_are_sampled_as_in_single_calls(step_m, tolerance):
    """Where a check has made a comparison due, the next ping waited for none; one made again skipped its own."""
    bodies = [
        sg.Body("ball", trimesh.creation.icosphere(3, 0.6), sg.pose(5), 0.8),
        sg.Body("box", trimesh.creation.box((1, 1, 1)), sg.pose(8, 1.5), 0.8),
        sg.Body("floor", trimesh.creation.box((60, 60, 1)), sg.pose(0, 0, -2.5), "steel"),
        sg.Body("wall", trimesh.creation.box((1, 60, 20)), sg.pose(11), "steel"),
    ]
    acoustics = sg.Acoustics("ideal", multipath="incoherent")
    poses, runs = [sg.pose(step_m * k, yaw=0.01 * k) for k in range(40)], []
    for many in (True, False):
        with sg.Simulator(sg.Scene(bodies), SONAR, acoustics, tolerance=tolerance, engine="cpu") as it:
            runs.append(list(it.pings(poses) if many else map(it.ping, poses)))
    check_all_same(*runs)


def test_pings_that_nobody_took_change_no_later_one():
    """Threads were ahead by some when the sequence was closed; later pings followed one of them, unseen."""
    with sg.Simulator(round_about(), SONAR, sg.Acoustics.ideal(), tolerance=0.05, engine="cpu") as it:
        pings = it.pings(FAR_AND_NEAR)
        next(pings), next(pings)
        pings.close()
        assert it.run.sampler.history.n_pings == 2
        found = [it.ping(pose) for pose in FAR_AND_NEAR[3:5]]
    with sg.Simulator(round_about(), SONAR, sg.Acoustics.ideal(), tolerance=0.05, engine="cpu") as it:
        *_, one, other = [it.ping(pose) for pose in (*FAR_AND_NEAR[:2], *FAR_AND_NEAR[3:5])]
    check_all_same(found, (one, other))


@pytest.mark.parametrize("is_closed", [False, True])
def test_pings_made_ahead_leave_the_samples_of_one_made_since(is_closed):
    """Whether they come out, or never will: the next single ping follows the last single one."""
    with sg.Simulator(round_about(), SONAR, sg.Acoustics.ideal(), tolerance=0.05, engine="cpu") as it:
        pings = it.pings(FAR_AND_NEAR[:3])
        next(pings), next(pings)
        it.ping(FAR_AND_NEAR[-1])
        sampler = it.run.sampler
        history, choice = sampler.history, sampler.choice
        pings.close() if is_closed else next(pings)
        assert sampler.history is history and sampler.choice is choice


def test_a_body_that_another_simulator_adds_waits_for_the_pings_that_are_being_made(monkeypatch):
    """They have the scene as it was, in which compiled code would look for that body outside of arrays."""
    monkeypatch.setattr(JobThreads, "submit", lambda thread, job: None)  # a busy thread, which begins no job
    scene = sg.Scene(BODIES, surface_z_m=3.0)
    with (
        sg.Simulator(scene, SONAR, sg.Acoustics.ideal(), SAMPLING, engine="cpu") as one,
        sg.Simulator(one, SONAR.with_range(5), sg.Acoustics.ideal(), SAMPLING) as other,
    ):
        want = one.ping(POSES[0], labels=True)
        pings = one.pings([POSES[0]] * 2, labels=True)
        found = [next(pings)]
        other.add(sg.Body("more", BALL, sg.pose(4)))
        with pytest.warns(UserWarning, match="bodies were placed or added between two pings"):
            found += pings
        for ping in found:
            np.testing.assert_array_equal(ping.intensity, want.intensity)
            np.testing.assert_array_equal(ping.body_id, want.body_id)


@pytest.mark.timeout(60, method="thread")  # a hang is one that no signal ends
@pytest.mark.parametrize("engine", ["cpu", "opengl"])
def test_a_body_that_another_simulator_adds_in_the_middle_of_a_ping_raises_an_error(engine, monkeypatch):
    """A signal handler, which waited for ever for a later ping of the thread whose ping it interrupted."""
    later_first = type("LaterFirst", (list,), {"add": lambda jobs, job: jobs.insert(0, job)})
    monkeypatch.setattr(world, "WeakSet", later_first)
    with simulator(engine=engine) as one, sg.Simulator(one, SONAR, sg.Acoustics.ideal(), SAMPLING) as other:
        expected, messages = [ping.intensity for ping in one.pings(POSES)], []
        receive = pipeline.receive

        def receive_and_add(drawn):
            if threading.current_thread() is threading.main_thread():
                messages.append(error_of(other.add, sg.Body(f"more {len(messages)}", BALL, sg.pose(4))))
            return receive(drawn)

        for module in (ping_worker, pipeline, sequence):
            monkeypatch.setattr(module, "receive", receive_and_add)
        monkeypatch.setattr(JobThreads, "submit", lambda *_: None)  # the caller makes all of them
        for ping, right in zip(one.pings(POSES), expected, strict=True):
            np.testing.assert_array_equal(ping.intensity, right)
        assert len(one.scene.bodies) == len(BODIES)
    assert messages
    assert all("must not be used while it makes a ping" in message for message in messages)


def test_bodies_that_change_while_another_thread_waits_for_a_pose_are_warned_of(it):
    """As where a generator waits for the pose of a ROS message; only what a generator itself places is in time."""
    is_waiting, end = threading.Event(), threading.Event()

    def waiting_poses():
        is_waiting.set()
        end.wait(60)
        yield POSES[0]

    thread = threading.Thread(target=lambda: list(it.pings(waiting_poses())))
    thread.start()
    try:
        assert is_waiting.wait(60)
        pings = it.pings(POSES)
        next(pings)
        it.place({"box": sg.pose(6, -2)})
        with pytest.warns(UserWarning, match="bodies were placed or added between two pings"):
            next(pings)
        pings.close()
    finally:
        end.set()
        thread.join()


# ---- pings that are too small to hand them over --------------------------------------------------------


@pytest.fixture
def handed_over(monkeypatch):
    """Return a list of the numbers of pings that threads make from now on; with OpenGL of None for some at once."""
    numbers = []

    def noting(make):
        def noted(worker, setup, *more):
            numbers.append(setup.request.number)
            return make(worker, setup, *more)

        return noted

    for name in ("job", "job_apart"):
        monkeypatch.setattr(ping_worker.PingWorker, name, noting(getattr(ping_worker.PingWorker, name)))
    receive_later = Run.receive_later
    monkeypatch.setattr(Run, "receive_later", lambda *some: numbers.append(None) or receive_later(*some))
    return numbers


@pytest.mark.parametrize("engine", ["cpu", "opengl"])
def test_small_pings_are_those_of_single_calls_and_need_no_other_thread(engine, handed_over, monkeypatch):
    monkeypatch.setattr(sequence, "FEW_SAMPLES", FEW_SAMPLES)
    with simulator(engine=engine) as it:
        check_all_same(
            it.pings(POSES, bodies=MOVED),
            (it.ping(pose, bodies=moved) for pose, moved in zip(POSES, MOVED, strict=True)),
        )
    assert handed_over == []


def test_the_first_ping_tells_whether_others_are_made_by_threads(handed_over):
    with simulator(engine="cpu") as it:
        pings = it.pings(POSES)
        next(pings)
        assert handed_over == []
        next(pings)
        assert handed_over == [1, 2, 3, 4]
        pings.close()


def test_pings_that_become_small_and_large_again_are_those_of_single_calls(handed_over, monkeypatch):
    monkeypatch.setattr(sequence, "FEW_SAMPLES", 1)
    away = sg.pose(yaw=3.0)  # nothing is drawn there
    path = [*POSES[:7], *[away] * 11, *POSES[7:]]
    with simulator(engine="cpu") as it, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of pings without an echo
        expected = [it.ping(pose) for pose in path]
        check_all_same(it.pings(path), expected)
    assert set(handed_over) >= {*range(1, 7), *range(19, len(path))}  # a large one before each of them
    assert not {0, *range(12, 19)} & set(
        handed_over
    )  # some small ones were handed over before the first came out


@pytest.mark.parametrize(
    ("physics", "options"),
    [
        ({}, {"labels": True}),
        ({"multipath": "incoherent"}, {}),
        *(
            pytest.param(*one, marks=pytest.mark.slow)
            for one in (
                ({"volume_reverberation": True, "water": ROUGH_SEA}, {}),
                ({"surface_reverberation": True, "water": ROUGH_SEA}, {}),
                ({"specular": True}, {"noise": sg.Noise(speckle=True)}),
                ({"bubbles": True}, {}),
            )
        ),
    ],
)
def test_pings_of_more_than_a_direct_echo_are_not_small(physics, options, handed_over, monkeypatch):
    monkeypatch.setattr(sequence, "FEW_SAMPLES", math.inf)
    mirror = sg.Body("mirror", BALL, sg.pose(5), 0.5, specular=1.0)
    scene = sg.Scene([*BODIES, mirror], surface_z_m=1.5).with_more([sg.Bubbles("plume", sg.pose(6, 1, -2))])
    with sg.Simulator(scene, SONAR, sg.Acoustics("ideal", **physics), SAMPLING, engine="cpu") as it:
        list(it.pings(POSES[:6], **options))
    assert set(handed_over) == set(range(1, 6))  # some more than once, to make their image sources finer


def test_requests_are_taken_as_far_ahead_whoever_makes_the_pings(monkeypatch):
    """What a program does between two pings acts on the same ping, however large pings are."""

    def n_taken():
        taken = []

        def poses():
            for pose in POSES:
                taken.append(pose)
                yield pose

        with simulator(engine="cpu") as it:
            return [len(taken) for _ in it.pings(poses())]

    by_threads = n_taken()
    monkeypatch.setattr(sequence, "FEW_SAMPLES", math.inf)
    assert n_taken() == by_threads
    assert by_threads[0] > 1


def test_one_core_has_no_thread_make_pings(handed_over, monkeypatch):
    monkeypatch.setattr(sequence, "n_threads", lambda: 1)
    with simulator(engine="cpu") as it:
        check_all_same(it.pings(POSES, labels=True), (it.ping(pose, labels=True) for pose in POSES))
    assert handed_over == []


# ---- who makes pings ------------------------------------------------------------------------------------


def test_the_caller_makes_pings_while_it_waits_for_the_first(it, monkeypatch):
    expected, receive = [it.ping(pose) for pose in POSES], pipeline.receive
    has_begun, has_made, were_made = threading.Event(), threading.Event(), []

    def wait_for_the_caller(drawn):
        if threading.current_thread() is threading.main_thread():
            has_made.set()
        else:
            has_begun.set()
            were_made.append(has_made.wait(20))
            has_made.set()  # whatever comes after a wait in vain need not wait
        return receive(drawn)

    class Waiting(JobThreads):
        def submit(self, job):
            super().submit(job)
            assert has_begun.wait(60)  # else the caller may come first, and make the first ping

    monkeypatch.setattr(ping_worker, "receive", wait_for_the_caller)
    monkeypatch.setattr(sequence, "JobThreads", Waiting)
    check_all_same(it.pings(POSES), expected)
    assert all(were_made)


@pytest.mark.parametrize("is_first_made", [True, False])
def test_the_caller_makes_no_ping_after_the_first_is_there(is_first_made):
    """It has that one to hand over, and the others are the threads' to make."""
    first, second = jobs = Job(lambda: None), Job(lambda: None)
    if is_first_made:
        first.settle()
    sequence.PingThreads(None).help_with(jobs)
    assert first.is_over and not second.is_over


def test_threads_and_the_caller_are_as_many_as_the_cores(monkeypatch):
    def n_alive():
        return sum(thread.name == "sonar_gl ping" for thread in threading.enumerate())

    wait_until(lambda: n_alive() == 0)  # those of sequences before, which end by themselves
    monkeypatch.setattr(sequence, "n_threads", lambda: 4)
    with simulator(engine="cpu") as it:
        pings = it.pings(POSES)
        next(pings), next(pings)
        assert n_alive() == 3
        pings.close()
        wait_until(lambda: n_alive() == 0)


def test_a_worker_keeps_its_memory_as_samples_become_fewer_and_more(it, monkeypatch):
    """To give it back with each change of sampling took the time of fresh memory in the next ping of many samples."""
    given_back = []
    monkeypatch.setattr(StageCache, "drop_large", lambda _: given_back.append(1))
    run, worker = it.run, ping_worker.PingWorker(it.run)
    setup = run.set_up(PingRequest(np.eye(4)))
    with run.drawing():
        fine, coarse = (
            Resolution(run.stages.stage(one)) for one in (sg.Sampling(6, 120), sg.Sampling(1, 20))
        )
    for resolution in (fine, *[coarse] * (KEPT_VIEWS - 1), fine, *[coarse] * KEPT_VIEWS):
        assert given_back == []
        job = worker.job(setup, resolution, run.world.scene)
        job.begin()
        job.result()
    assert given_back == [1]


def test_a_ping_inside_a_job_is_refused_before_any_other_job_is_awaited(it):
    """As by a signal handler: another thread waits for what this one's job holds, so that both would wait for ever."""
    run, held, has_begun, failures = it.run, threading.Lock(), threading.Event(), []

    def wait_for_it():
        has_begun.set()
        held.acquire(timeout=20)  # not for ever, so that the test ends
        return []

    def ping():
        with held:
            threading.Thread(target=first.begin, daemon=True).start()
            has_begun.wait()
            it.ping(np.eye(4))

    def make():
        second.begin()
        failures.append(second.failure)

    first, second = (run.await_job(Job(work, world.IN_USE)) for work in (wait_for_it, ping))
    thread = threading.Thread(target=make, daemon=True)
    thread.start()
    thread.join(10)
    assert [str(one) for one in failures] == [world.IN_USE]
    assert it.ping(np.eye(4)).intensity.sum() > 0
