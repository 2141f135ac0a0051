"""Compilation of functions by Numba."""

from __future__ import annotations

import sys
from functools import cache

from numba import njit
from numba.core import cgutils, event, types
from numba.core.imputils import impl_ret_borrowed
from numba.extending import intrinsic

OPTIONS = {
    "nogil": True,
    "no_cfunc_wrapper": True,
    "error_model": "numpy",
    "fastmath": {"contract", "nsz", "arcp"},
}


def compiled(function):
    """Compile a function by Numba, without the GIL, and cache its machine code on disk where that is possible.

    Numba looks a cached function up by the state of the function's own file. So a compiled function calls functions,
    and uses constants, of its own file only: after a change of another file it would run with outdated ones.
    """
    return _kept(function, OPTIONS)


def uncounted(function):
    """Compile a function as `compiled` does, but count no references to arrays in it.

    Else each call, and each row of a table that is given a name, counts some: atomic operations of 5 to 10 ns each,
    which take as long as the work where a function has a few samples to do. The function must make no array, which
    Numba refuses to compile, and must return none, not even in a tuple, since its caller would release it.
    """
    return _kept(function, {**OPTIONS, "_nrt": False})


def _kept(function, options: dict):
    """Compile a function, and keep its machine code on disk where that is possible."""
    try:
        return njit(cache=True, **options)(function)
    except RuntimeError:  # "cannot cache function": no writable folder
        return njit(**options)(function)


def inlined(function):
    """Compile a function inline into each compiled function that calls it; Python can call it, too.

    With a single caller this compiles faster than two separate functions.
    """
    return njit(inline="always", **OPTIONS)(function)


@intrinsic
def as_table(_typing_context, array, n_rows, n_columns):
    """Return a table of float64 in the memory of an array at least as large; its shape must be of constants.

    The compiler then knows how far rows are apart. Of an array whose shape it does not know, any two rows might
    overlap: a loop over several of them compares the places of all first, each time, or does one entry at a time.
    """
    if not all(isinstance(n, types.IntegerLiteral) for n in (n_rows, n_columns)):
        return None
    shape, table = (n_rows.literal_value, n_columns.literal_value), types.Array(types.float64, 2, "C")

    def generate(context, builder, signature, arguments):
        def numbers(*values):
            return [context.get_constant(types.intp, n) for n in values]

        given = context.make_array(signature.args[0])(context, builder, value=arguments[0])
        out = context.make_array(table)(context, builder)
        out.data, out.meminfo, out.parent = given.data, given.meminfo, given.parent
        out.nitems, out.itemsize = numbers(shape[0] * shape[1], 8)
        out.shape = cgutils.pack_array(builder, numbers(*shape))
        out.strides = cgutils.pack_array(builder, numbers(8 * shape[1], 8))
        return impl_ret_borrowed(context, builder, table, out._getvalue())

    return table(array, n_rows, n_columns), generate


class _Announcement(event.Listener):
    """A listener that prints a line when Numba compiles the first function of this process."""

    is_wanted = True

    def on_start(self, event):
        if not event.data["dispatcher"].py_func.__module__.startswith("sonar_gl."):
            return  # a function of the program that uses this package
        if self.is_wanted:
            print(
                "sonar_gl: compiling numerical kernels, which takes about half a minute, once after each installation "
                "('sonar-gl doctor' compiles all of them)",
                file=sys.stderr,
            )
        self.is_wanted = False

    def on_end(self, _event):
        pass


@cache
def _announcement() -> _Announcement:
    """Return the listener of this process, registered at the first call."""
    announcement = _Announcement()
    event.register("numba:compile", announcement)
    return announcement


def announce_compilation(is_wanted: bool | None = None) -> None:
    """Have this process print a line to stderr when it begins to compile; False turns the line off."""
    announcement = _announcement()
    if is_wanted is not None:
        announcement.is_wanted = is_wanted
