"""The thread of a live session by itself: when it pings, and what it does in between."""

import signal
import threading
import time

import pytest

import sonar_gl as sg
from sonar_gl.live import ping_thread as ping_thread_module
from sonar_gl.live.ping_thread import PingThread, following_s
from tests.support.waiting import WAIT_S


class Pings:
    """Counts the pings of a thread, which succeed or fail."""

    def __init__(self, succeed):
        self.succeed, self.number, self.released_in = succeed, 0, []
        self.begun = threading.Event()

    def ping(self):
        self.number += 1
        self.begun.set()
        return self.succeed

    def release(self):
        self.released_in.append(threading.current_thread().name)

    def thread(self):
        return PingThread(threading.RLock(), self.ping, lambda: 1000.0, self.release)


def test_a_ping_that_is_late_is_not_made_up_for_but_a_timer_is():
    assert following_s(10.0, 10.0, 0.5) == 10.5
    assert following_s(10.0, 10.25, 0.5) == 10.5  # no later for the timer
    assert following_s(10.0, 12.0, 0.5) == 12.5  # not at once for the three that were missed


def test_after_a_ping_that_failed_it_waits_and_does_jobs_meanwhile(monkeypatch):
    monkeypatch.setattr(ping_thread_module, "RETRY_S", 1000.0)
    pings = Pings(succeed=False)
    thread = pings.thread()
    with thread.listen(lambda frame: None, 1):
        assert pings.begun.wait(WAIT_S)
        time.sleep(0.05)  # 50 periods
        assert [thread.do(lambda: threading.current_thread().name) for _ in range(3)] == ["sonar_gl live"] * 3
        assert pings.number == 1
    thread.close()


def test_jobs_pass_on_what_they_raise_and_end_no_thread():
    pings = Pings(succeed=True)
    thread = pings.thread()

    def fail():
        raise KeyError("job")

    with pytest.raises(KeyError, match="job"):
        thread.do(fail)
    assert thread.do(lambda: thread.do(lambda: 5)) == 5  # a job of the thread itself
    assert pings.number == 0  # nobody listens
    thread.close()


def test_it_releases_what_it_holds_once_in_the_thread_itself():
    pings = Pings(succeed=True)
    thread = pings.thread()
    thread.do(thread.close)  # by itself, which must not wait for itself
    assert thread.wait_closed(WAIT_S)
    thread.close()
    assert pings.released_in == ["sonar_gl live"]
    for call in (lambda: thread.do(int), lambda: thread.listen(print, 1), thread.check_open):
        with pytest.raises(sg.Error, match="this LiveSession is closed"):
            call()


def test_it_is_waited_for_after_a_wait_that_ctrl_c_has_ended():
    # else the interpreter ends beside a ping, and the process aborts in OpenCV now and then
    thread = Pings(True).thread()
    busy, over = threading.Event(), threading.Event()

    def work():
        busy.set()
        over.wait(WAIT_S)

    asking = threading.Thread(target=lambda: thread.do(work))
    asking.start()
    assert busy.wait(WAIT_S)
    interrupt = threading.Timer(0.2, signal.pthread_kill, [threading.main_thread().ident, signal.SIGINT])
    interrupt.start()
    with pytest.raises(KeyboardInterrupt):
        thread.wait_closed(WAIT_S)
    closing = threading.Thread(target=thread.close)
    closing.start()
    closing.join(0.2)
    assert closing.is_alive()
    over.set()
    closing.join(WAIT_S)
    asking.join(WAIT_S)
    assert thread.wait_closed(WAIT_S) and not closing.is_alive()
