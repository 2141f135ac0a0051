"""The second thread: both halves run, also after an interrupted wait, and no caller waits for ever."""

import os
import signal
import threading
import warnings

import pytest

import sonar_gl as sg
from sonar_gl.core.worker import Job, JobThreads, SecondThread
from sonar_gl.engine import world
from tests.support.waiting import wait_until

LIMIT_S = 60  # a machine that tests run on may be slow


def finishes(function):
    """Return whether a call in a daemon thread ends within LIMIT_S."""
    thread = threading.Thread(target=function, daemon=True)
    thread.start()
    thread.join(LIMIT_S)
    return not thread.is_alive()


def test_each_half_runs_once_in_two_threads():
    thread, here = SecondThread(), threading.get_ident()
    names, has_begun = set(), threading.Event()

    def work(half):
        if half == 1:
            has_begun.set()
        assert has_begun.wait(LIMIT_S)  # so that the second thread has to claim its half
        names.add((half, threading.get_ident() == here))
        return half

    assert [thread.run_halves(work) for _ in range(20)] == [(0, 1)] * 20
    assert {(0, True), (1, False)} <= names
    assert threading.active_count() >= 2
    thread.close()


def test_a_closed_thread_raises_an_error():
    """An early version waited for ever."""
    thread, failures = SecondThread(), []
    thread.run_halves(lambda half: half)
    thread.close()
    thread.close()

    def use():
        try:
            thread.run_halves(lambda half: half)
        except sg.Error as why:
            failures.append(str(why))

    assert finishes(use)
    assert failures == ["this SecondThread is closed; make a new one"]


@pytest.mark.parametrize("failing", [0, 1])
def test_an_exception_of_a_half_is_raised_and_the_next_job_runs(failing):
    thread = SecondThread()

    def work(half):
        if half == failing:
            raise ZeroDivisionError(f"half {half}")
        return half

    for _ in range(3):
        with pytest.raises(ZeroDivisionError, match=f"half {failing}"):
            thread.run_halves(work)
        assert thread.run_halves(lambda half: 10 + half) == (10, 11)
    thread.close()


def test_the_job_after_an_interrupted_one_gets_its_own_answer():
    """An early version returned the answer of the previous job from then on."""
    thread, begun, may_end, ended = SecondThread(), threading.Event(), threading.Event(), []

    def interrupted(half):
        if half == 0:
            begun.wait(LIMIT_S)
            raise KeyboardInterrupt
        begun.set()
        may_end.wait(LIMIT_S)
        ended.append("first")
        return "of the first job"

    with pytest.raises(KeyboardInterrupt):
        thread.run_halves(interrupted)
    assert not ended  # the second half still runs
    threading.Timer(0.05, may_end.set).start()
    answers = thread.run_halves(lambda half: ended.append(half) or f"of the second, {half}")
    assert answers == ("of the second, 0", "of the second, 1")
    assert ended[0] == "first"  # the next job waits for it
    thread.close()


def test_a_caller_that_is_interrupted_in_its_own_second_half_blocks_no_later_job(monkeypatch):
    """An early version took that half for one that the thread still runs, and waited for it for ever."""
    thread, is_busy, may_end = SecondThread(), threading.Event(), threading.Event()

    def occupy(half):
        if half == 1:
            is_busy.set()
            may_end.wait(LIMIT_S)

    other = threading.Thread(target=thread.run_halves, args=(occupy,), daemon=True)
    other.start()
    is_busy.wait(LIMIT_S)

    def interrupted(_job):
        raise KeyboardInterrupt

    monkeypatch.setattr("sonar_gl.core.worker.Job.settle", interrupted)
    with pytest.raises(KeyboardInterrupt):
        thread.run_halves(lambda half: half)  # the thread is busy, so that this caller runs both halves
    monkeypatch.undo()
    may_end.set()
    assert finishes(lambda: thread.run_halves(lambda half: half))
    thread.close()


def test_a_thread_that_cannot_start_is_tried_again(monkeypatch):
    thread = SecondThread()

    def fail(_thread):
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(threading.Thread, "start", fail)
    with pytest.raises(RuntimeError, match="can't start"):
        thread.run_halves(lambda half: half)
    monkeypatch.undo()
    assert thread.run_halves(lambda half: half) == (0, 1)
    thread.close()


def test_several_callers_share_a_thread():
    thread, results = SecondThread(), []

    def call(number):
        for _ in range(50):
            results.append(thread.run_halves(lambda half: (number, half)) == ((number, 0), (number, 1)))

    callers = [threading.Thread(target=call, args=(number,)) for number in range(3)]
    for caller in callers:
        caller.start()
    for caller in callers:
        caller.join(LIMIT_S)
    assert results == [True] * 150
    thread.close()


@pytest.mark.parametrize("n_threads", [pytest.param(1, marks=pytest.mark.slow), 2])
def test_a_world_has_one_second_thread_which_ends_with_it(monkeypatch, n_threads):
    """An early version had one thread per beamformer: ten more after four pings with multipath. On one core, none."""
    monkeypatch.setattr(world, "n_threads", lambda: n_threads)
    scene, sonar = sg.load_scene("pylon"), sg.load_sonar("p900-45")
    before = set(threading.enumerate())  # by thread, not by number: those of earlier tests may end meanwhile
    acoustics = sg.Acoustics.physical(multipath="incoherent")
    with sg.Simulator(scene, sonar, acoustics, tolerance=0.2) as simulator:
        for k in range(4):
            simulator.ping(scene.sonar_pose @ sg.pose(0.5 * k, yaw=0.3 * k))
        with sg.Simulator(simulator, sonar, sg.Acoustics.ideal(), tolerance=0.2) as other:
            other.ping(scene.sonar_pose)
        started = set(threading.enumerate()) - before
    assert len(started) == n_threads - 1
    for second in started:
        second.join(LIMIT_S)
        assert not second.is_alive()


def test_a_forked_process_does_both_halves_itself():
    """It lacks the thread."""
    thread = SecondThread()
    assert thread.run_halves(lambda half: half) == (0, 1)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of forks with threads, since Python 3.12
        child = os.fork()
    if child == 0:
        signal.alarm(30)
        os._exit(0 if thread.run_halves(lambda half: half) == (0, 1) else 1)
    assert os.waitpid(child, 0)[1] == 0
    assert thread.run_halves(lambda half: half) == (0, 1)
    thread.close()


def test_several_threads_do_jobs_at_once_and_all_end():
    together, threads = threading.Barrier(4), JobThreads("together", 3)

    def count() -> int:  # not of threads that earlier tests have left to end
        return sum(thread.name == "together" for thread in threading.enumerate())

    jobs = [Job(lambda: together.wait(LIMIT_S)) for _ in range(3)]
    for job in jobs:
        threads.submit(job)
    together.wait(LIMIT_S)
    assert sorted([job.result() for job in jobs]) == sorted({job.answer for job in jobs})
    assert count() == 3
    threads.close()
    wait_until(lambda: count() == 0)
