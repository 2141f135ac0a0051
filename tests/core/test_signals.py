import signal
import threading

import pytest

from sonar_gl.core.signals import delayed_interrupt, exit_at_interrupt
from tests.support.processes import python


@pytest.fixture(autouse=True)
def python_handler():
    """Python's own handler of Ctrl-C, and after the test the one before."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def is_python_handler():
    return signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_an_interrupt_comes_at_the_end_of_the_outer_block():
    done = []
    with pytest.raises(KeyboardInterrupt), delayed_interrupt():
        with delayed_interrupt():
            signal.raise_signal(signal.SIGINT)
            done.append("inner")
        done.append("outer")
    assert done == ["inner", "outer"] and is_python_handler()


def test_a_second_interrupt_comes_at_once():
    done = []
    with pytest.raises(KeyboardInterrupt), delayed_interrupt():
        signal.raise_signal(signal.SIGINT)
        done.append("first")
        signal.raise_signal(signal.SIGINT)
        done.append("second")
    assert done == ["first"] and is_python_handler()


def test_errors_pass_and_nothing_is_raised_without_an_interrupt():
    with delayed_interrupt():
        assert not is_python_handler()
    with pytest.raises(ZeroDivisionError), delayed_interrupt():
        raise ZeroDivisionError
    assert is_python_handler()


def test_a_handler_of_the_program_stays():
    came = []
    signal.signal(signal.SIGINT, handler := lambda number, frame: came.append(number))
    with delayed_interrupt():
        signal.raise_signal(signal.SIGINT)
        assert came == [signal.SIGINT]
    assert signal.getsignal(signal.SIGINT) is handler


def test_other_threads_leave_the_handler_alone():
    def work():
        with delayed_interrupt():
            seen.append(is_python_handler())

    seen = []
    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert seen == [True]


def test_exit_at_interrupt_ends_the_process_at_once():
    code = "import os, signal\nfrom sonar_gl.core.signals import exit_at_interrupt\n"
    code += "exit_at_interrupt()\nos.kill(os.getpid(), signal.SIGINT)\nprint('went on')"
    done = python("-c", code)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "error: interrupted\n")


def test_exit_at_interrupt_leaves_other_handlers_and_threads_alone():
    thread = threading.Thread(target=exit_at_interrupt)
    thread.start()
    thread.join()
    assert is_python_handler()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # as in the background
    exit_at_interrupt()
    assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    signal.signal(signal.SIGINT, signal.default_int_handler)
    exit_at_interrupt()
    assert not is_python_handler()
