"""Checks of arguments. Each returns the accepted value or raises an `Error` that names the argument."""

from __future__ import annotations

import inspect
import math
import os
from collections.abc import Iterable
from pathlib import Path
from typing import get_args

import numpy as np

from sonar_gl.core.errors import Error, nearest_names, nearest_of_many

# what arrays of other kinds than numbers hold, by `dtype.kind`
NO_NUMBERS = {"S": "text", "U": "text", "T": "text", "c": "complex numbers", "M": "dates", "m": "durations"}


def _is_read_only(array) -> bool:
    """Return whether an array is read-only, owns what it holds, and has it in C order."""
    if type(array) is not np.ndarray or array.base is not None:
        return False
    return array.flags.c_contiguous and not array.flags.writeable


def frozen_array(array, dtype, shape: tuple, what: str, hint: str = "", shares: bool = False) -> np.ndarray:
    """Return a read-only, finite, contiguous copy of `array`.

    Raises Error if the shape differs, or a value is not a finite number: text is none, nor what a mask hides.

    array : anything that NumPy turns into numbers
    shape : required lengths; None allows any length
    what : name of the argument, with which the message begins
    hint : what to do instead, which ends the message about a shape
    shares : return the array itself if it is all this already, and owns its numbers. Its owner could make it writeable
        again, so this is for arrays that are large, or of which others find by identity that they are the same
    """
    try:
        out = array if shares and _is_read_only(array) else np.array(array, order="C")
        got = _other_contents(out)
        if got is not None:
            raise Error(f"{what} must be an array of numbers (got {got}: {shown(array)})")
        out = out.astype(dtype, order="C", copy=False)
    except Error:
        raise
    except (TypeError, ValueError, OverflowError) as why:  # a whole number may be too large for a float
        if isinstance(why, ValueError) and isinstance(array, (list, tuple)):
            raise _shape_error(what, shape, _parts_text(array), hint) from None
        got = shown(array) if isinstance(why, TypeError) else f"{type(array).__name__}: {why}"
        raise Error(f"{what} must be an array of numbers (got {got})") from None
    if out.shape != shape and not _fits(out.shape, shape):
        raise _shape_error(what, shape, out.shape, hint)
    if np.ma.is_masked(array):
        raise Error(f"{what} must be an array of numbers (got masked ones; fill them in, or leave them out)")
    if count := out.size - np.count_nonzero(np.isfinite(out)):
        raise Error(f"{what} must be finite (got NaN or infinity in {count} of {out.size} numbers)")
    out.setflags(write=False)
    return out


def _fits(got: tuple, wanted: tuple) -> bool:
    """Return whether the lengths of an array are those that are wanted, of which None is any."""
    return len(got) == len(wanted) and all(want in (None, n) for want, n in zip(wanted, got, strict=True))


def _shape_error(what: str, shape: tuple, got, hint: str) -> Error:
    wanted = "(" + ", ".join("any" if n is None else str(n) for n in shape) + ")"
    return Error(f"{what} must have shape {wanted} (got {got}{hint and f'; {hint}'})")


def _parts_text(parts: list | tuple) -> str:
    """Return in words what has parts of several shapes.

    >>> _parts_text(((0, 0, 0), [0, 0, 0, 1])), _parts_text([1, [2, 3]])
    ('a tuple of parts of 3 and 4 numbers', 'a list of parts of several shapes')
    """
    lengths = [*map(_flat_length, parts)] if len(parts) == 2 else [None]
    what = "several shapes" if None in lengths else f"{lengths[0]} and {lengths[1]} numbers"
    return f"a {type(parts).__name__} of parts of {what}"


def _flat_length(one) -> int | None:
    """Return the length of a list, tuple or array that holds no others; None of anything else."""
    is_flat = (
        isinstance(one, (list, tuple, np.ndarray)) and is_iterable(one) and not any(map(is_iterable, one))
    )
    return len(one) if is_flat else None


def is_position_and_quaternion(value) -> bool:
    """Return whether a value is a pair of three numbers and four.

    >>> is_position_and_quaternion(((0, 0, 0), [0, 0, 0, 1])), is_position_and_quaternion(np.eye(4))
    (True, False)
    """
    return isinstance(value, (list, tuple)) and len(value) == 2 and [*map(_flat_length, value)] == [3, 4]


class ArraysStayReadOnly:
    """A class whose arrays `frozen_array` made, in copies and pickles, too: NumPy makes those of both writable."""

    def __setstate__(self, state: dict):
        for value in state.values():
            for array in value.values() if isinstance(value, dict) else (value,):
                if isinstance(array, np.ndarray):
                    array.setflags(write=False)
        self.__dict__.update(state)


def _other_contents(array: np.ndarray) -> str | None:
    """Return what an array holds in place of numbers, though NumPy would make some of it; None if it holds numbers.

    NumPy reads text, also among objects, as in a table that was read as text; it drops imaginary parts and the unit of
    times, and takes a record of one field for a number.
    """
    if array.dtype.kind == "O":
        return "text" if any(isinstance(one, (str, bytes)) for one in array.flat) else None
    return "records" if array.dtype.names else NO_NUMBERS.get(array.dtype.kind)


def check_kind(name: str, value, kind, cure: str):
    """Raise an `Error` unless `value` is an instance of `kind`, a class or a union of classes and None."""
    if not isinstance(value, kind):
        wanted = (get_args(kind) or (kind,))[0].__name__
        article, got = "an" if wanted[0] in "AEIOU" else "a", type(value).__name__
        if got == wanted:  # of another library, such as trimesh.Scene
            got = f"that of {type(value).__module__.partition('.')[0]}"
        raise Error(f"{name} must be {article} {wanted} (got {got}; {cure})")


def is_iterable(value) -> bool:
    """Return whether `value` holds several things, or can: a 0-d array of NumPy has the method for it, but holds one.

    >>> is_iterable([]), is_iterable(np.zeros(0)), is_iterable(np.array(3.0)), is_iterable(3.0)
    (True, True, False, False)
    """
    return isinstance(value, Iterable) and not (isinstance(value, np.ndarray) and value.ndim == 0)


def count_axes(value) -> int | None:
    """Return how many axes the array of a value has: 0 of None and of a dict; None of parts of several shapes.

    >>> count_axes(3.0), count_axes([3.0]), count_axes([[1], [2, 3]])
    (0, 1, None)
    """
    try:
        return np.ndim(value)
    except ValueError:  # also of a list in itself
        return None


def as_array(value, what: str) -> np.ndarray:
    """Return a value as an array, without a copy if it is one; raise an `Error` for parts of several shapes."""
    if count_axes(value) is None:
        raise Error(f"{what} must be an array (got {_parts_text(value)})")
    return np.asarray(value)


def check_iterable(name: str, value, cure: str):
    """Raise an `Error` unless `value` holds several things, as `is_iterable` says."""
    if not is_iterable(value):
        raise Error(f"{name} must be an Iterable (got {type(value).__name__}; {cure})")


def check_function(name: str, value, argument: str):
    """Raise an `Error` unless `value` can be called, and does its work then; `argument` says with what."""
    if not callable(value):
        raise Error(f"{name} must be a function of {argument} (got {shown(value)})")
    if inspect.iscoroutinefunction(value) or inspect.iscoroutinefunction(type(value).__call__):
        # its body would never run, and Python says so elsewhere, in words of its own
        raise Error(
            f"{name} must be a plain function of {argument} (got an async one; it is called in a thread without an "
            "event loop, so have a plain one hand over by loop.call_soon_threadsafe)"
        )


def holds_numbers(array) -> bool:
    """Return whether `array` is an array of NumPy that holds real numbers, or True and False.

    >>> holds_numbers(np.zeros(3)), holds_numbers([0.0]), holds_numbers(np.array([1j])), holds_numbers(np.array("1"))
    (True, False, False, False)
    """
    return isinstance(array, np.ndarray) and array.dtype.kind in "biuf"


def is_number(value) -> bool:
    """Return whether `value` is a real number of Python or NumPy; True and False are not, NaN is.

    >>> is_number(1), is_number(np.float32(0.5)), is_number(True), is_number("1")
    (True, True, False, False)
    """
    return isinstance(value, (int, float, np.integer, np.floating)) and not isinstance(
        value, (bool, np.timedelta64)
    )  # NumPy counts durations as integers


def is_whole_number(value) -> bool:
    """Return whether `value` is an integer of Python or NumPy; True, False and 2.0 are not.

    >>> is_whole_number(2), is_whole_number(np.uint8(2)), is_whole_number(2.0), is_whole_number(True)
    (True, True, False, False)
    """
    return isinstance(value, (int, np.integer)) and not isinstance(value, (bool, np.timedelta64))


def plain_number(value):
    """Return a number of NumPy, True and False included, as Python's; anything else as it is.

    Calculations with the former take its precision and range: 100 * np.int8(2) is -56, and np.float16(1e-8) is 0.

    >>> plain_number(np.int8(2)), plain_number(np.float16(0.5)), plain_number(np.True_), plain_number("1")
    (2, 0.5, True, '1')
    """
    if isinstance(value, np.generic):
        if isinstance(value, np.bool_):
            return bool(value)
        if is_number(value):
            return int(value) if isinstance(value, np.integer) else float(value)
    return value


def make_numbers_plain(settings) -> None:
    """Have a dataclass, frozen or not, hold numbers of Python in place of NumPy's, as `plain_number` makes them."""
    for name, value in list(vars(settings).items()):
        if isinstance(value, np.generic):
            object.__setattr__(settings, name, plain_number(value))


def is_finite(value) -> bool:
    """Return whether `value` is a number, and one that a float can hold.

    >>> is_finite(1), is_finite(math.nan), is_finite(10**400), is_finite("1")
    (True, False, False, False)
    """
    try:
        return is_number(value) and math.isfinite(value)
    except OverflowError:
        return False


def shown(value) -> str:
    """Return a value as text for a message, one line of at most 80 characters.

    >>> shown("1"), shown(10**400)
    ("'1'", 'a whole number of more than 300 digits')
    >>> shown(np.eye(2))
    'array([[1., 0.], [0., 1.]])'
    """
    if is_whole_number(value) and abs(value) >= 10**300:
        return "a whole number of more than 300 digits"
    try:
        text = repr(value)
    except ValueError:  # Python refuses to print numbers of more than 4300 digits
        text = f"a {type(value).__name__} with very long numbers"
    if "\n" in text:  # as of an array
        text = " ".join(text.split())
    return text if len(text) <= 80 else f"{text[:77]}..."


def number_text(value) -> str:
    """Return a number as text for a message.

    >>> number_text(1.0), number_text(10**400)
    ('1', 'a whole number of more than 300 digits')
    """
    return shown(value) if is_whole_number(value) else f"{value:g}"


def text_beside(value: float, bound: float, digits: int = 3) -> str:
    """Return a number as text of so many digits, or of as many more as a number above a bound needs to read so.

    >>> text_beside(0.0345678, 0.02), text_beside(0.0200021, 0.02), text_beside(0.0199999, 0.02)
    ('0.0346', '0.020002', '0.02')
    """
    while value > bound >= float(f"{value:.{digits}g}") and digits < 17:
        digits += 1
    return f"{value:.{digits}g}"


def check_number(what: str, value, low: float = -math.inf, high: float = math.inf, hint: str = "") -> float:
    """Return `value` as a float.

    Raises Error if it is not a number, or outside the bounds.

    what : name of the argument, with which the message begins, such as "sonar 'mine': range_max_m"
    low, high : bounds, both included; without one of them `value` must be finite
    hint : unit, or likely cause of a mistake, which ends the message about bounds

    >>> check_number("tvg_k", 20, 0, 60)
    20.0
    >>> check_number("tvg_k", 61, 0, 60, "usual are 20, 30 and 40")
    Traceback (most recent call last):
        ...
    sonar_gl.core.errors.Error: tvg_k must lie in 0..60 (got 61; usual are 20, 30 and 40)
    """
    if not is_number(value):
        raise Error(f"{what} must be a number (got {shown(value)})")
    value = plain_number(value)  # float16 cannot hold all bounds
    if low <= value <= high and is_finite(value):  # false for NaN
        return float(value)
    bounds = [f"{low:g} or more"] if low > -math.inf else []
    bounds += [f"{high:g} or less"] if high < math.inf else []
    wanted = (
        f"must lie in {low:g}..{high:g}" if len(bounds) == 2 else " and ".join(["must be finite", *bounds])
    )
    raise Error(f"{what} {wanted} (got {number_text(value)}{hint and f'; {hint}'})")


def check_fields(what: str, settings, bounds: Iterable[tuple[str, float, float, str]]) -> None:
    """Raise an `Error` unless fields of a dataclass are numbers within bounds; those that are None by default may be.

    what : the settings, with which the message begins, such as "sonar 'mine'"
    bounds : name of each field; `low`, `high` and `hint` of `check_number`
    """
    for name, low, high, hint in bounds:
        value = getattr(settings, name)
        if value is not None or settings.__dataclass_fields__[name].default is not None:
            check_number(f"{what}: {name}", value, low, high, hint)


def check_whole_number(what: str, value, low: int = 0, high: int | None = None, hint: str = "") -> int:
    """Return `value` as an int.

    Raises Error if it is not a whole number, or outside the bounds.

    what : name of the argument, with which the message begins
    low, high : bounds, both included; None for no upper bound
    hint : unit, or likely cause of a mistake, which ends the message

    >>> check_whole_number("looks", 0, 1, 1000)
    Traceback (most recent call last):
        ...
    sonar_gl.core.errors.Error: looks must be a whole number in 1..1000 (got 0)
    """
    if is_whole_number(value) and low <= value and (high is None or value <= high):
        return int(value)
    wanted = f", {low} or more" if high is None else f" in {low}..{high}"
    raise Error(f"{what} must be a whole number{wanted} (got {shown(value)}{hint and f'; {hint}'})")


def check_choice(kind: str, value, choices: Iterable[str], location: str = "") -> str:
    """Return `value`, one of the strings `choices`.

    Raises Error if it is none of them; the message names the most similar ones.

    kind : what is chosen, such as "taper"
    location : place with which the message begins, such as "pulse"

    >>> check_choice("taper", "hammin", ("uniform", "hamming"), "pulse")
    Traceback (most recent call last):
        ...
    sonar_gl.core.errors.Error: pulse: unknown taper (got 'hammin'; did you mean 'hamming'?)
    """
    if isinstance(value, str) and value in choices:
        return value
    hint = nearest_names(value if isinstance(value, str) else "", choices)
    raise Error(f"{location}{': ' if location else ''}unknown {kind} (got {shown(value)}; {hint})")


def unknown_body_error(
    name, known: Iterable[str], rule: str = "bodies must be bodies of the scene", models: Iterable[str] = ()
) -> Error:
    """Return the error for a name that no body has.

    name : what was given, of any type
    known : names of the bodies of the scene, and of what else may be named
    rule : what must hold, with which the message begins
    models : names of models of the scene that hold no body

    >>> str(unknown_body_error("wal", ["floor", "wall"]))
    "bodies must be bodies of the scene (got 'wal'; did you mean 'wall'?)"
    """
    if name in models:
        return Error(
            f"{rule} (got {shown(name)}, a model without bodies, as where its only shapes are in the link that carries "
            "the scene's sonar, which returns no echo: give the sensor a link of its own)"
        )
    return Error(f"{rule} (got {shown(name)}; {nearest_of_many(name, known)})")


def check_file_name(path, suffixes: tuple[str, ...]) -> Path:
    """Return the path of a file to be written; raise an `Error` unless it ends in one of the suffixes, in any case."""
    check_kind("path", path, str | os.PathLike, f"the name of a file that ends in {' or '.join(suffixes)}")
    path = Path(path)
    if path.suffix.lower() not in suffixes:
        raise Error(f"{str(path)!r} must end in {' or '.join(suffixes)} (got {path.suffix or 'no suffix'})")
    return path
