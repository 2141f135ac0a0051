"""The queue of OpenGL objects that wait to be released, with stand-ins for the objects."""

import os
import threading
import types

import pytest

from sonar_gl.core.errors import Error
from sonar_gl.gl import context as gl
from sonar_gl.gl import egl, lifetime


@pytest.fixture
def queue():
    """A queue of its own: tests before may have left objects in the one that all share."""
    return lifetime.ReleaseQueue()


@pytest.fixture
def released():
    """Names of the objects that were released, in order."""
    return []


@pytest.fixture
def make(released):
    """Function (name) -> Releasable that is in reach."""

    def make(name, **state):
        one = types.SimpleNamespace(is_gone=False, here=True, **state)
        one.is_in_reach = lambda: one.here and not one.is_gone
        one.release = lambda: released.append(name)
        return one

    return make


def test_what_is_in_reach_is_released_at_once_and_in_order(make, released, queue):
    queue.release(make("framebuffer"), make("context"))
    assert released == ["framebuffer", "context"]


def test_what_is_discarded_is_released_later(make, released, queue):
    queue.discard(make("framebuffer"), make("context"))
    assert released == [] and queue.waiting() == 1
    queue.release_waiting()
    assert released == ["framebuffer", "context"]


@pytest.mark.parametrize("leave", ["release", "discard"])
def test_a_group_waits_while_one_of_it_is_out_of_reach(make, released, leave, queue):
    one = make("one")
    one.here = False
    getattr(queue, leave)(make("other"), one)
    for _ in range(3):
        queue.release_waiting()
        assert released == [] and queue.waiting() == 1
    one.here = True
    queue.release_waiting()
    assert released == ["other", "one"]


def test_groups_do_not_wait_for_each_other(make, released, queue):
    away, near = make("away"), make("near")
    away.here = False
    queue.release(away)
    queue.release(near)
    queue.discard(make("late"))
    queue.release_waiting()
    assert released == ["near", "late"]
    away.here = True


def test_what_has_gone_with_its_context_is_forgotten(make, queue):
    one = make("one")
    one.here = False
    queue.release(one)
    one.is_gone = True
    queue.release_waiting()
    assert queue.waiting() == 0


def test_the_oldest_of_too_many_are_given_up(make, released, queue):
    all_ = [make(k) for k in range(lifetime.MAX_UNREACHABLE + 3)]
    for one in all_:
        one.here = False
        queue.release(one)
    assert queue.waiting() == lifetime.MAX_UNREACHABLE
    for one in all_:
        one.here = True
    queue.release_waiting()
    assert released == list(range(3, lifetime.MAX_UNREACHABLE + 3))


def test_finalisers_may_discard_while_others_are_released(make, released, queue):
    """As when the garbage collector runs meanwhile: there is no deadlock, and the new one waits its turn."""
    one = make("one")
    one.release = lambda: queue.discard(make("new"))
    queue.discard(one)
    queue.release_waiting()
    assert queue.waiting() == 1
    queue.release_waiting()
    assert released == ["new"]


@pytest.mark.timeout(60, method="thread")  # a hang is one that no signal ends
def test_a_signal_handler_may_release_while_others_are_released(make, released, queue):
    """It makes a ping of another scene; it waited for ever for the lock that its own thread holds."""
    for name in ("one", "other"):
        one = make(name)
        one.release = lambda name=name: (released.append(name), queue.release_waiting())
        queue.discard(one)
    queue.release_waiting()
    assert released == ["one", "other"] and queue.waiting() == 0


def test_one_that_fails_does_not_keep_the_others_of_its_group(make, released, queue):
    broken = make("broken")

    def fail():
        raise Error("the driver has gone")

    broken.release = fail
    with pytest.raises(Error, match="the driver has gone"):
        queue.release(make("framebuffer"), broken, make("context"))
    assert released == ["framebuffer", "context"] and queue.waiting() == 0


def test_a_forked_process_leaves_its_parents_objects_alone(make, released):
    try:
        lifetime.discard(make("mine"))
        before = lifetime.waiting()
        if (child := os.fork()) == 0:
            os._exit(0 if lifetime.waiting() == 0 else 1)
        assert os.waitpid(child, 0)[1] == 0
        assert lifetime.waiting() == before and before > 0
    finally:
        lifetime.release_waiting()
    assert released == ["mine"]


def test_a_context_in_use_in_another_thread_waits(queue):
    context, other, done = gl.create_context(), threading.Event(), threading.Event()

    def use():
        with context:
            other.set()
            done.wait(30)

    egl.make_current(egl.Binding(egl.current().display))
    thread = threading.Thread(target=use)
    thread.start()
    assert other.wait(30)
    queue.release(context)
    assert queue.waiting() == 1
    done.set()
    thread.join()
    queue.release_waiting()
    assert queue.waiting() == 0
