"""Pauses of the garbage collector."""

import gc
import os
import threading
import weakref

import pytest

from sonar_gl.core.collector import CollectorPause


@pytest.fixture(autouse=True, params=[True, False], ids=["on", "off"])
def was_on(request):
    """The collector's state before, in which a pause must leave it."""
    before = gc.isenabled()
    (gc.enable if request.param else gc.disable)()
    yield request.param
    (gc.enable if before else gc.disable)()


def test_overlapping_pauses_of_two_threads_restore_the_state(was_on):
    first, others = CollectorPause(), []
    thread = threading.Thread(target=lambda: others.append(CollectorPause()))
    thread.start()
    thread.join()
    first.end()
    first.end()  # does nothing
    assert not gc.isenabled()
    others[0].end()
    assert gc.isenabled() == was_on


def test_a_pause_that_has_ended_has_no_finaliser():
    """An interrupt that came in it was lost, and a command went on after Ctrl-C."""
    pause = CollectorPause()
    assert hasattr(pause, "__del__")
    pause.end()
    assert not hasattr(pause, "__del__")
    pause.end()


def test_a_pause_that_is_never_ended_ends_with_its_object(was_on):
    pause = CollectorPause()
    assert not gc.isenabled()
    del pause
    assert gc.isenabled() == was_on


def test_the_collector_does_not_run_inside_and_runs_afterwards(was_on):
    class Thing:
        pass

    thing = Thing()
    thing.itself, seen, threshold = thing, weakref.ref(thing), gc.get_threshold()
    pause = CollectorPause()
    gc.set_threshold(1, 1, 1)
    try:
        del thing
        kept = [[k] for k in range(10_000)]
        assert seen() is not None and len(kept) == 10_000
        pause.end()
        kept += [[k] for k in range(10_000)]
        assert (seen() is None) == was_on
    finally:
        gc.set_threshold(*threshold)


def test_a_fork_ends_the_pauses_of_its_parent(was_on):
    pause = CollectorPause()
    if (child := os.fork()) == 0:
        os._exit(0 if gc.isenabled() == was_on else 1)
    assert os.waitpid(child, 0)[1] == 0
    pause.end()
