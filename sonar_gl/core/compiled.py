"""Compilation of functions by Numba."""

from __future__ import annotations

import hashlib
import os
import sys
from contextlib import suppress
from functools import cache
from inspect import getfile
from pathlib import Path
from pickle import UnpicklingError
from stat import S_ISREG

from numba import config, njit
from numba.core import cgutils, event, types
from numba.core.caching import FunctionCache, IndexDataCacheFile
from numba.core.imputils import impl_ret_borrowed
from numba.core.registry import CPUDispatcher
from numba.extending import intrinsic
from numba.np.arrayobj import populate_array

from sonar_gl.core.errors import Error
from sonar_gl.core.signals import delayed_interrupt
from sonar_gl.core.warn import warn_caller

if config.DISABLE_JIT:  # intrinsics have no other form, and a ping would take minutes
    raise Error("NUMBA_DISABLE_JIT must be 0 or unset, since pings need compiled code (got 1; unset it)")

OPTIONS = {
    "nogil": True,
    "no_cfunc_wrapper": True,
    "error_model": "numpy",
    "fastmath": {"contract", "nsz", "arcp"},
}

AFTER_INSTALLATION = "once after each installation ('sonar-gl doctor' compiles them)"
IN_EACH_PROCESS = (
    "in each process, since no folder to keep them in can be written to; set NUMBA_CACHE_DIR to one that can"
)
# What Numba raises for a file of machine code that is cut off, as by a loss of power, that was written where the module
# had another name, or that cannot be read or written.
UNUSABLE_FILE = OSError, EOFError, UnpicklingError, ImportError
TOGETHER = "kernels"  # a package of this name: its functions call those of all its modules


def compiled(function):
    """Compile a function by Numba, without the GIL, and cache its machine code on disk where that is possible.

    The machine code of a function holds the functions that it calls and the constants that it reads, and is looked up
    by the files of `sources_of`. So a compiled function calls functions, and reads constants, of these files only:
    after a change of another file it would run with outdated ones.
    """
    return _kept(function, OPTIONS)


def rounded_alike(function):
    """Compile a function as `compiled` does, but with the roundings of IEEE 754, which are the same on all processors.

    Else those that multiply and add in one step round once where others do twice: a choice by the least of many numbers
    then turns out otherwise.
    """
    return _kept(function, {**OPTIONS, "fastmath": False})


def added_in_any_order(function):
    """Compile a function as `compiled` does, but let it add up numbers in another order than the loop does.

    So a sum takes as many numbers at a time as the processor can. Its last bits are those of that processor.
    """
    return _kept(function, {**OPTIONS, "fastmath": OPTIONS["fastmath"] | {"reassoc"}})


def uncounted(function):
    """Compile a function as `compiled` does, but count no references to arrays in it.

    Else each call, and each row of a table that is given a name, counts some: atomic operations of 5 to 10 ns each,
    which take as long as the work where a function has a few samples to do. The function must make no array, which
    Numba refuses to compile, and must return none, not even in a tuple, since its caller would release it.
    """
    return _kept(function, {**OPTIONS, "_nrt": False})


def _kept(function, options: dict):
    """Compile a function, and keep its machine code on disk where that is possible."""
    kept = _KeptFunction(function, targetoptions={"nopython": True, "boundscheck": None, **options})
    with suppress(RuntimeError):  # "cannot cache function": no writable folder
        kept.enable_caching()
    return kept


def sources_of(file: str) -> list[str]:
    """Return the files by whose content the machine code of a file's functions is looked up, that file first.

    If it is a module of a package named "kernels", they are all modules of the package. This module is one, too: its
    options and `as_table` are part of all machine code.
    """
    files, folder = [file], os.path.dirname(file)
    if os.path.basename(folder) == TOGETHER and os.path.isdir(folder):
        names = sorted(name for name in os.listdir(folder) if name.endswith(".py"))
        files += [path for name in names if (path := os.path.join(folder, name)) != file]
    return [*files, __file__]


def _stamp(file: str) -> str:
    """Return a hash of `sources_of` a file.

    Files of a program that is an executable itself are not found. That executable is part of Numba's own stamp.
    """
    states = filter(None, map(_state_of, sources_of(file)))
    return _hash_of_content(tuple(dict.fromkeys(states)))


def _state_of(path: str) -> tuple | None:
    """Return path, time and size of a file, or of the archive that holds it; None if there is neither."""
    try:
        state = os.stat(path)
    except OSError:
        folder = os.path.dirname(path)
        return _state_of(folder) if folder != path else None
    return (path, state.st_mtime_ns, state.st_size) if S_ISREG(state.st_mode) else None


@cache
def _hash_of_content(states: tuple) -> str:
    """Return a hash of the names and the content of files; states : of `_state_of`, whose times ask for a new one."""
    out = hashlib.sha256()
    for path, *_ in states:
        content = Path(path).read_bytes()
        out.update(f"{os.path.basename(path)} {len(content)}\n".encode() + content)
    return out.hexdigest()


class _FilesOfFunction(FunctionCache):
    """The files of a function's machine code, which Numba takes for outdated after a change of its sources."""

    def __init__(self, py_func):
        super().__init__(py_func)
        stamp = self._impl.locator.get_source_stamp(), _stamp(getfile(py_func))
        self._cache_file = IndexDataCacheFile(self.cache_path, self._impl.filename_base, stamp)


class _KeptFunction(CPUDispatcher):
    """A compiled function that runs also where the disk is full, or its files there are damaged.

    Numba raises what it meets there, of a full disk after the function has been compiled. After a KeyboardInterrupt in
    the middle of its own work, Numba compiles and reads no more functions in that process.
    """

    def enable_caching(self):
        """Keep machine code on disk; raise RuntimeError if there is no folder that can be written to."""
        self._cache = _FilesOfFunction(self.py_func)

    def compile(self, signature):
        """Compile the function for types of arguments, or read the machine code for them from disk."""
        with delayed_interrupt():
            return self._compile(signature)

    def _compile(self, signature):
        is_new = False
        while True:
            n_before = len(self.overloads)
            try:
                return super().compile(signature)
            except UNUSABLE_FILE as why:
                reason = (getattr(why, "strerror", None) or str(why)).lower()
            if len(self.overloads) > n_before:  # it is compiled, and the next turn finds it
                _warn_not_kept(self.stats.cache_path, reason)
            elif is_new or not self._begin_files_anew():
                raise Error(
                    f"the machine code that is kept in {self.stats.cache_path!r} must be readable (got {reason}; "
                    "delete that folder, or set NUMBA_CACHE_DIR to another one)"
                )
            else:
                is_new = True

    def _begin_files_anew(self) -> bool:
        """Forget the machine code on disk, and return whether that was possible."""
        try:
            self._cache.flush()
        except OSError:
            return False
        return True


_reasons_not_kept = []  # of this process, the first of them


def reason_not_kept() -> str | None:
    """Return why machine code that this process has compiled could not be written to its folder, or None."""
    return _reasons_not_kept[0] if _reasons_not_kept else None


def _warn_not_kept(folder: str, reason: str) -> None:
    """Warn once that machine code could not be written to its folder."""
    if not _reasons_not_kept:
        _reasons_not_kept.append(reason)
        warn_caller(
            f"compiled functions must find room in {folder!r}, else each process compiles them again (got "
            f"{reason}; make room, or set NUMBA_CACHE_DIR to another folder)"
        )


def inlined(function):
    """Compile a function inline into each compiled function that calls it; Python can call it, too.

    With a single caller this compiles faster than two separate functions.
    """
    return njit(inline="always", **OPTIONS)(function)


@intrinsic
def as_table(_typing_context, array, n_rows, n_columns):
    """Return a contiguous (n_rows, n_columns) table in the memory of one at least as large; both must be constants.

    The compiler then knows how far rows are apart. Of an array whose shape it does not know, any two rows might
    overlap: a loop over several of them compares the places of all first, each time, or does one entry at a time.
    """
    if not all(isinstance(n, types.IntegerLiteral) for n in (n_rows, n_columns)):
        return None
    shape, n_bytes = (n_rows.literal_value, n_columns.literal_value), array.dtype.bitwidth // 8
    table = types.Array(array.dtype, 2, "C")
    if array != table:
        return None

    def generate(context, builder, _signature, arguments):
        def numbers(*values):
            return cgutils.pack_array(builder, [context.get_constant(types.intp, n) for n in values])

        out, fields = arguments[0], context.data_model_manager[table]
        parts = {"shape": numbers(*shape), "strides": numbers(n_bytes * shape[1], n_bytes)}
        parts["nitems"] = context.get_constant(types.intp, shape[0] * shape[1])
        for name, part in parts.items():
            out = builder.insert_value(out, part, fields.get_field_position(name))
        return impl_ret_borrowed(context, builder, table, out)

    return table(array, n_rows, n_columns), generate


@intrinsic
def from_column(_typing_context, image, column, n_rows):
    """Return so many rows of an image from a column on, each as long as those of the image, as `whole_rows` does.

    Kernels that take a window as an array are compiled for contiguous ones. The last row ends past the image.
    """
    if not (isinstance(image, types.Array) and image.layout == "C" and image.ndim > 1):
        return None

    def generate(context, builder, _signature, arguments):
        out, column, n_rows = arguments
        part = context.make_array(image)(context, builder, out)
        shape = cgutils.unpack_tuple(builder, part.shape, image.ndim)
        strides = cgutils.unpack_tuple(builder, part.strides, image.ndim)
        place = cgutils.pointer_add(builder, part.data, builder.mul(column, strides[1]), part.data.type)
        fields = context.data_model_manager[image]
        n_items = n_rows
        for n in shape[1:]:
            n_items = builder.mul(n_items, n)
        shape = cgutils.pack_array(builder, [n_rows, *shape[1:]])
        for name, value in (("data", place), ("shape", shape), ("nitems", n_items)):
            out = builder.insert_value(out, value, fields.get_field_position(name))
        return impl_ret_borrowed(context, builder, image, out)

    return image(image, types.intp, types.intp), generate


@intrinsic
def floats_at(_typing_context, address, count):
    """Return the contiguous array of so many float32 numbers at an address in memory, uint64.

    So a kernel takes a number of arrays that varies. Their owner must hold them until it has ended.
    """
    out = types.Array(types.float32, 1, "C")

    def generate(context, builder, _signature, arguments):
        array = context.make_array(out)(context, builder)
        size = context.get_constant(types.intp, 4)
        place = builder.inttoptr(arguments[0], array.data.type)
        parts = {"data": place, "shape": [arguments[1]], "strides": [size], "itemsize": size, "meminfo": None}
        populate_array(array, **parts)
        return array._getvalue()

    return out(types.uint64, types.intp), generate


class _Announcement(event.Listener):
    """A listener that prints a line when Numba compiles the first function of this process."""

    is_wanted = True

    def on_start(self, event):
        module = event.data["dispatcher"].py_func.__module__ or ""  # None of a function that `exec` made
        if not module.startswith("sonar_gl."):
            return  # a function of the program that uses this package
        if self.is_wanted:
            is_kept = event.data["dispatcher"].stats.cache_path is not None
            print(
                "sonar_gl: compiling numerical kernels; all of them take a minute or two (some minutes on one core), "
                + (AFTER_INSTALLATION if is_kept else IN_EACH_PROCESS),
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
