"""How commands of `sonar-gl` end: signals, errors, warnings and the exit status."""

from __future__ import annotations

import _thread
import errno
import math
import os
import signal
import sys
import threading
import time
import warnings
from collections.abc import Callable
from contextlib import contextmanager, suppress

import click

from sonar_gl.cli.output import echo
from sonar_gl.core.errors import RAISE_FILE_LIMIT, Error, MachineError
from sonar_gl.core.signals import REPEAT_S, exit_interrupted

PAUSE_S = 0.05  # until a signal that came where it would be lost is tried again


class CommandGroup(click.Group):
    """Commands that report a user's error in one sentence with exit status 2, and each warning once, on one line."""

    def invoke(self, ctx):
        message, status = "", 0
        for stream in (sys.stdout, sys.stderr):
            if hasattr(stream, "reconfigure"):
                stream.reconfigure(errors="replace")  # the terminal may not have Greek letters
        try:
            with _interrupts(), warnings.catch_warnings():
                warnings.simplefilter("always", UserWarning)
                warnings.showwarning = _one_line_warnings()
                _check_threads()
                super().invoke(ctx)
        except KeyboardInterrupt as why:  # commands that write files say what is with these
            message, status = "; ".join(["interrupted", *map(str, why.args)]), 130
        except MemoryError as why:
            message, status = f"memory ran out ({why}); ask for fewer beams, bins or pixels", 2
        except ImportError as why:
            message, status = f"{why}; 'sonar-gl doctor' says what is missing", 2
        except OSError as why:
            if why.errno == errno.EPIPE:  # `| head` has closed the pipe
                raise
            message, status = _describe_os_error(why), 2
        except MachineError as why:
            message, status = str(why), 4
        except Error as why:
            message, status = str(why), 2
        if status:
            with suppress(OSError):  # a log on a full disk; the status says at least that the command failed
                echo(f"error: {message}", err=True)
            ctx.exit(status)

    def resolve_command(self, ctx, args):
        """Return what click finds; raise Error for a --pose without quotes, of which click takes one number alone."""
        for word, *numbers in zip(args, args[1:], args[2:], strict=False):
            if word == "--pose" and all(map(_is_number, numbers)):
                got = " ".join(numbers)
                raise Error(
                    f'--pose must be 6 numbers in quotes: --pose "x y z roll pitch yaw" (got {got} ...)'
                )
        return super().resolve_command(ctx, args)


def _is_number(word: str) -> bool:
    """Return whether a word is a number, which a comma may follow."""
    try:
        float(word.removesuffix(","))
    except ValueError:
        return False
    return True


def _check_threads() -> None:
    """Raise Error for a number of threads with which Numba cannot be imported."""
    try:
        number = int(os.environ["NUMBA_NUM_THREADS"])
    except (KeyError, ValueError):  # of no number Numba warns, and takes its own
        return
    if number < 1:
        raise Error(f"NUMBA_NUM_THREADS must be 1 or more, or unset (got {number}; unset it)")


@contextmanager
def _interrupts():
    """Have SIGTERM, which service managers and containers send, and SIGHUP end a command as Ctrl-C does; lose none.

    While modules are imported a signal waits: trimesh imports others under `except BaseException`, and would take the
    KeyboardInterrupt for the lack of a module. Where Python has to ignore the KeyboardInterrupt, as in a finaliser or
    in what LLVM calls while Numba compiles or reads a function, the signal comes again.
    """
    if threading.current_thread() is not threading.main_thread():  # where Python allows no handlers
        yield
        return
    n_around, waiting, raised_s = _count_imports(sys._getframe()), [], -math.inf
    hook_before = sys.unraisablehook

    def send_again(number):
        again = threading.Timer(PAUSE_S, *_sending(number))
        again.daemon = True
        waiting.append(again)
        again.start()

    def report_unraisable(found):
        nonlocal raised_s
        if not issubclass(found.exc_type, KeyboardInterrupt):
            hook_before(found)
            return
        raised_s = -math.inf
        send_again(signal.SIGTERM)  # all signals end a command alike

    def interrupt(number, frame):
        nonlocal raised_s
        # another KeyboardInterrupt would cut the end of a command short
        if time.monotonic() < raised_s + REPEAT_S:
            return
        if _count_imports(frame) <= n_around:
            raised_s = time.monotonic()
            raise KeyboardInterrupt
        send_again(number)

    numbers = [signal.SIGTERM]
    # not where the caller has set another handler, or it is ignored, as in the background
    if signal.getsignal(signal.SIGINT) in (signal.default_int_handler, exit_interrupted):
        numbers.append(signal.SIGINT)
    # of a terminal that is closed, else files that are half written stay; nohup has it ignored
    if hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) is signal.SIG_DFL:
        numbers.append(signal.SIGHUP)
    before = {number: signal.signal(number, interrupt) for number in numbers}
    sys.unraisablehook = report_unraisable
    try:
        yield
    finally:
        sys.unraisablehook = hook_before
        for again in waiting:
            again.cancel()
        for number, handler in before.items():
            signal.signal(number, handler or signal.SIG_DFL)  # None: of a handler that Python cannot set


def _sending(number: int) -> tuple[Callable, tuple]:
    """Return a function that sends this thread, the main one, a signal, and its arguments."""
    if hasattr(signal, "pthread_kill"):
        return signal.pthread_kill, (threading.get_ident(), number)
    return _thread.interrupt_main, (number,)  # on Windows


def _count_imports(frame) -> int:
    """Return how many frames of Python's import lie around a frame, itself included."""
    count = 0
    while frame is not None:
        count += frame.f_code.co_filename.startswith("<frozen importlib")
        frame = frame.f_back
    return count


def _describe_os_error(why: OSError) -> str:
    """Return what is wrong with a file, or, where the error names none, with the output of the command."""
    reason = why.strerror or str(why)
    if why.filename is None and why.errno == errno.ENOSPC:
        return f"the standard output must be writable (got {reason.lower()})"
    if why.filename is None and reason.startswith("No usable temporary directory"):  # of `tempfile`
        return (
            "a folder for temporary files must be there (got none that can be written to; set TMPDIR to one)"
        )
    if why.filename is None and why.errno == errno.ENOENT:  # of `os.getcwd`
        return "the working directory must exist (it has been removed; change to another folder)"
    cure = f"; {RAISE_FILE_LIMIT}" if why.errno == errno.EMFILE else ""
    return f"{why.filename or 'files'}: {reason}{cure}"


def _one_line_warnings():
    """Return a `warnings.showwarning` that shows each text once, on one line."""
    shown = set()

    def show(message, *_args, **_more):
        text = " ".join(str(message).split())
        if text not in shown:
            echo(f"warning: {text}", err=True)
        shown.add(text)

    return show
