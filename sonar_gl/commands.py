"""What all commands share: how errors and warnings are told, numbers are read, progress is shown."""

from __future__ import annotations

import contextlib
import errno
import sys
import warnings

import click


class Commands(click.Group):
    """Turns what a user can cause into one sentence and exit status 2, and warnings into one line each."""

    def invoke(self, ctx):
        message, status = "", 0
        for stream in (sys.stdout, sys.stderr):
            if hasattr(stream, "reconfigure"):
                stream.reconfigure(errors="replace")  # a terminal that knows no Greek
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("always", UserWarning)
                warnings.showwarning = _one_line()
                super().invoke(ctx)
        except KeyboardInterrupt:
            message, status = "interrupted; the files written so far are whole", 130
        except MemoryError as why:
            message, status = f"memory ran out ({why}); ask for fewer beams, bins or pixels", 2
        except ImportError as why:
            message, status = f"{why}; 'sonar-gl doctor' says what is missing", 2
        except OSError as why:
            if why.errno == errno.EPIPE:  # `| head` has seen enough
                raise
            message, status = f"{why.filename or 'files'}: {why.strerror or why}", 2
        except ValueError as why:
            from sonar_gl.types import Error

            if not isinstance(why, Error):
                raise
            message, status = str(why), 2
        if status:
            click.echo(f"error: {message}", err=True)
            ctx.exit(status)


def _one_line():
    """A `warnings.showwarning` that says a thing once, on one line."""
    shown = set()

    def show(message, *_args, **_more):
        text = " ".join(str(message).split())
        if text not in shown:
            click.echo(f"warning: {text}", err=True)
        shown.add(text)

    return show


def load_numba():
    """Load Numba without scipy.linalg: a fifth of a second and 16 MB, and no function here needs it.

    Numba looks for its BLAS as it loads, and takes what it finds. For the process of a command alone: in one
    that others share, their np.convolve would miss it.
    """
    blas = "scipy.linalg.cython_blas"
    if blas in sys.modules:
        return
    sys.modules[blas] = None  # so the import system takes it for missing
    try:
        import numba.np.arraymath  # noqa: F401
    finally:
        del sys.modules[blas]
    if sys.stderr.isatty():
        _tell_of_compiling()


def _tell_of_compiling():
    """Say so when sums have to be compiled, as the first command after an installation must."""
    from numba.core import event

    class Told(event.Listener):
        told = False

        def on_start(self, _event):
            if not self.told:
                click.echo("compiling, which takes some twenty seconds once", err=True)
            self.told = True

        def on_end(self, _event):
            pass

    event.register("numba:compile", Told())


def numbers(option: str, text: str, names: str) -> list[float]:
    """The numbers of an option's text, as many as there are names."""
    from sonar_gl.types import Error

    count = len(names.split())
    try:
        values = [float(word) for word in text.replace(",", " ").split()]
    except ValueError:
        raise Error(f"{option} must be {count} numbers, {names!r} (got {text!r})") from None
    if len(values) != count:
        raise Error(f"{option} must be {count} numbers, {names!r} (got {len(values)}: {text!r})")
    return values


def progress(numbers):
    """A progress bar on a terminal, nothing elsewhere."""
    if sys.stderr.isatty():
        return click.progressbar(numbers, file=sys.stderr)
    return contextlib.nullcontext(numbers)
