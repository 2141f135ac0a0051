"""Warnings that a thread keeps from being shown, and that other threads show all the same."""

import contextlib
import contextvars
import threading
import warnings

import pytest

from sonar_gl.core.warn import MOST_TEXTS, collected_warnings, warn_caller
from tests.support.interrupts import Interrupter
from tests.support.waiting import WAIT_S


class NarrowWarning(UserWarning):
    pass


def test_warnings_are_collected_in_order_and_none_is_shown():
    with warnings.catch_warnings(record=True) as shown, collected_warnings() as found:
        warnings.simplefilter("always")
        warn_caller("one")
        warn_caller("two\x1b[1m", NarrowWarning)
        warn_caller("one")
    assert [(one.text, one.category) for one in found] == [
        ("one", UserWarning),
        (r"two\x1b[1m", NarrowWarning),
        ("one", UserWarning),
    ]
    assert shown == []


def test_the_innermost_block_of_a_category_collects_and_others_are_shown():
    with collected_warnings(NarrowWarning) as narrow, pytest.warns(UserWarning, match="^shown$"):
        with collected_warnings() as every:
            warn_caller("inside", NarrowWarning)
        warn_caller("outside", NarrowWarning)
        warn_caller("shown")
    assert [one.text for one in every] == ["inside"]
    assert [one.text for one in narrow] == ["outside"]


def test_a_block_that_fails_collects_no_more():
    before = list(contextvars.copy_context().items())
    with pytest.raises(KeyError), collected_warnings(), collected_warnings():
        raise KeyError
    after = [(variable, value) for variable, value in contextvars.copy_context().items() if value != ()]
    assert after == [
        one for one in before if one[1] != ()
    ]  # else each of millions would leave something behind
    with pytest.warns(UserWarning, match="after it"):
        warn_caller("after it")


def collect(at):
    """Collect a warning; return the places of sonar_gl on the way, of which the number `at` is interrupted."""
    with contextlib.suppress(KeyboardInterrupt), Interrupter(at) as interrupter, collected_warnings():
        warn_caller("inside")
    return interrupter.places


def test_a_block_that_is_interrupted_anywhere_collects_no_more():
    """Also as it begins or ends: it would swallow all warnings of the process from then on."""
    places = collect(None)
    assert len(places) > 10
    for at in range(len(places)):
        collect(at)
        with pytest.warns(UserWarning, match=f"after {at}"):
            warn_caller(f"after {at}")


def test_a_warning_names_the_line_of_the_caller():
    with warnings.catch_warnings(record=True) as shown:
        warnings.simplefilter("always")
        warn_caller("here")
    assert shown[0].filename == __file__


def test_python_does_not_remember_all_texts_that_differ():
    """As of a sonar that moves for weeks through water without an echo: each says another distance."""
    with warnings.catch_warnings(record=True) as shown:
        warnings.simplefilter("default")
        for number in range(3 * MOST_TEXTS):
            warn_caller(f"the nearest surface lies at {number} m")
            warn_caller("shown once")
    assert len(globals()["__warningregistry__"]) <= MOST_TEXTS
    assert len(shown) < 3 * MOST_TEXTS + 10


def test_blocks_of_two_threads_that_overlap_change_nothing_for_each_other_or_for_the_process():
    """The first ends inside the second, which `warnings.catch_warnings` does not survive."""
    is_inside, may_end, found = threading.Event(), threading.Event(), []

    def collect():
        with collected_warnings() as own:
            is_inside.set()
            assert may_end.wait(WAIT_S)
            warn_caller("of the thread")
        found.extend(own)

    filters, show = list(warnings.filters), warnings.showwarning
    thread = threading.Thread(target=collect)
    with collected_warnings() as own:
        thread.start()
        assert is_inside.wait(WAIT_S)
        warn_caller("of the caller")
    with pytest.warns(UserWarning, match="shown while the thread collects"):
        warn_caller("shown while the thread collects")
    may_end.set()
    thread.join()
    assert [one.text for one in own] == ["of the caller"]
    assert [one.text for one in found] == ["of the thread"]
    assert (warnings.filters, warnings.showwarning) == (filters, show)
