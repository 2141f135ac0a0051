"""Messages on their way to a slower reader."""

import logging
import queue
import threading

import pytest

from sonar_gl.ros import inbox as inboxes
from sonar_gl.ros.inbox import Inbox
from tests.support.waiting import WAIT_S, wait_until


@pytest.fixture
def opened():
    """Make inboxes that are closed in the end."""
    made = []

    def make(receive, depth):
        made.append(Inbox("/sonar/pose", receive, depth))
        return made[-1]

    yield make
    for inbox in made:
        inbox.close()


def test_all_messages_are_read_in_their_order_by_one_other_thread(opened):
    read, threads = [], set()

    def receive(message):
        threads.add(threading.current_thread())
        read.append(message)

    inbox = opened(receive, 1000)
    for k in range(1000):
        inbox.tell(b"%d" % k)
    wait_until(lambda: len(read) == 1000)
    assert read == [b"%d" % k for k in range(1000)] and inbox.missed == 0
    assert len(threads) == 1 and threads != {threading.current_thread()}


def test_a_slow_reader_gets_the_newest_messages(opened):
    read, begun, go_on = [], threading.Event(), threading.Event()

    def receive(message):
        begun.set()
        assert go_on.wait(WAIT_S)
        read.append(message)

    inbox = opened(receive, 2)
    inbox.tell(b"first")
    assert begun.wait(WAIT_S)
    for k in range(100):
        inbox.tell(b"%d" % k)
    go_on.set()
    wait_until(lambda: len(read) == 3)
    assert read == [b"first", b"98", b"99"] and inbox.missed == 98


def test_an_error_of_the_reader_is_logged_once_and_ends_nothing(opened, caplog):
    read = []

    def receive(message):
        read.append(message)
        raise ValueError("not a pose")

    inbox = opened(receive, 10)
    with caplog.at_level(logging.ERROR):
        for _ in range(5):
            inbox.tell(b"x")
        wait_until(lambda: len(read) == 5)
        inbox.close()
    assert [record.getMessage() for record in caplog.records] == [
        "messages on /sonar/pose cannot be read; this is logged once"
    ]


def test_a_closed_inbox_is_silent_and_has_no_thread(opened):
    read = []
    inbox = opened(read.append, 1)
    inbox.close()
    inbox.close()
    inbox.tell(b"late")
    assert not read and not [t for t in threading.enumerate() if t.name == "inbox /sonar/pose"]


def test_the_reader_may_close_its_inbox(opened):
    closed = threading.Event()

    def receive(message):
        inbox.close()
        closed.set()

    inbox = opened(receive, 1)
    inbox.tell(b"x")
    assert closed.wait(WAIT_S)
    wait_until(lambda: not [t for t in threading.enumerate() if t.name == "inbox /sonar/pose"])


def test_closing_does_not_wait_for_ever_for_a_reader_that_waits(opened, monkeypatch):
    """A queue of a program that takes nothing any more is full."""
    monkeypatch.setattr(inboxes, "PATIENCE_S", 0.1)
    full = queue.Queue(1)
    inbox = opened(full.put, 5)
    for _ in range(3):
        inbox.tell(b"x")
    wait_until(full.full)
    closing = threading.Thread(target=inbox.close, daemon=True)
    closing.start()
    closing.join(WAIT_S)
    assert not closing.is_alive()
    full.get()  # the reader ends
