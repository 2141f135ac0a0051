"""Checks of arguments: accepted values, results and error messages."""

from __future__ import annotations

import functools
import math

import numpy as np
import pytest

from sonar_gl.core.checks import check_choice, check_function, check_number, check_whole_number, frozen_array
from sonar_gl.core.errors import Error
from tests.support.errors import error_of


@pytest.mark.parametrize(
    ("array", "message"),
    [
        (["1", "2"], "x must be an array of numbers (got text: ['1', '2'])"),
        (np.array([1, 2j]), "x must be an array of numbers (got complex numbers: array([1.+0.j, 0.+2.j]))"),
        (
            np.ma.masked_array([1.0, 2.0], [False, True]),
            "x must be an array of numbers (got masked ones; fill them in, or leave them out)",
        ),
    ],
)
def test_arrays_whose_numbers_would_be_guessed(array, message):
    """NumPy reads text, drops imaginary parts, and shows what a mask hides."""
    assert error_of(frozen_array, array, np.float64, (2,), "x") == message


@pytest.mark.parametrize("dtype", [bool, np.int8, np.uint64, np.float16, np.float32, ">f8", object])
def test_arrays_of_any_type_of_numbers(dtype):
    given = np.array([[1, 0], [0, 1]], dtype)
    for same in (
        given,
        np.asfortranarray(given),
        given[::-1][::-1],
        given.tolist(),
        np.ma.masked_array(given),
    ):
        out = frozen_array(same, np.float64, (2, None), "x")
        assert out.tolist() == [[1.0, 0.0], [0.0, 1.0]] and out.dtype == np.float64
        assert out.flags.c_contiguous and not out.flags.writeable and not np.shares_memory(out, given)


def test_only_a_read_only_array_of_its_own_is_not_copied_where_it_may_be_shared():
    """Bodies that share normals are found by them."""
    mine = np.zeros((2, 3))
    kept = frozen_array(mine, np.float64, (2, 3), "x", shares=True)
    assert not np.shares_memory(kept, mine) and not kept.flags.writeable
    assert frozen_array(kept, np.float64, (2, 3), "x", shares=True) is kept
    view = mine[:]
    view.flags.writeable = False  # `mine` is not
    for other in (view, kept.T, kept.astype(np.float32)):
        assert not np.shares_memory(frozen_array(other, np.float64, (None, None), "x", shares=True), other)
    assert not np.shares_memory(frozen_array(kept, np.float64, (2, 3), "x"), kept)
    with pytest.raises(Error, match="finite"):
        mine[0, 0] = np.nan
        mine.flags.writeable = False
        frozen_array(mine, np.float64, (2, 3), "x")


@pytest.mark.parametrize("value", [0, 1, 0.5, np.float32(0.5), np.int64(1), np.uint8(0), np.float16(0.25)])
def test_numbers_within_bounds_become_floats(value):
    out = check_number("x", value, 0, 1)
    assert type(out) is float and out == value


@pytest.mark.parametrize("value", [1, 1000, np.int8(5), np.uint64(7)])
def test_whole_numbers_within_bounds_become_ints(value):
    out = check_whole_number("n", value, 1, 1000)
    assert type(out) is int and out == value


@pytest.mark.parametrize("value", [True, np.True_, None, "1", 1j, np.complex64(1), [1.0], np.array([1.0])])
def test_values_that_are_not_numbers(value):
    assert error_of(check_number, "x", value, 0, 1) == f"x must be a number (got {value!r})"


@pytest.mark.parametrize(
    "bounds, value, message",
    [
        ((0, 1, "give metres"), 2, "x must lie in 0..1 (got 2; give metres)"),
        ((0, 1), math.nan, "x must lie in 0..1 (got nan)"),
        ((0, 1e8), np.float32(-0.5), "x must lie in 0..1e+08 (got -0.5)"),
        ((), math.inf, "x must be finite (got inf)"),
        ((), math.nan, "x must be finite (got nan)"),
        ((0,), -1, "x must be finite and 0 or more (got -1)"),
        ((0,), math.inf, "x must be finite and 0 or more (got inf)"),
        ((-math.inf, 0), 1, "x must be finite and 0 or less (got 1)"),
    ],
)
def test_numbers_out_of_bounds(bounds, value, message):
    assert error_of(check_number, "x", value, *bounds) == message


@pytest.mark.parametrize(
    "bounds, value, message",
    [
        ((), -1, "n must be a whole number, 0 or more (got -1)"),
        ((1,), 0, "n must be a whole number, 1 or more (got 0)"),
        ((1, 9), 10, "n must be a whole number in 1..9 (got 10)"),
        ((1, 9, "count from 1"), 0, "n must be a whole number in 1..9 (got 0; count from 1)"),
        ((1, 9), 2.0, "n must be a whole number in 1..9 (got 2.0)"),
        ((1, 9), True, "n must be a whole number in 1..9 (got True)"),
        ((1, 9), "2", "n must be a whole number in 1..9 (got '2')"),
    ],
)
def test_whole_numbers_out_of_bounds(bounds, value, message):
    assert error_of(check_whole_number, "n", value, *bounds) == message


def test_choices():
    assert check_choice("taper", "uniform", ("uniform", "hamming")) == "uniform"
    for value in (None, 3, ["uniform"], "Uniform"):
        with pytest.raises(Error, match=r"^unknown taper "):
            check_choice("taper", value, {"uniform": 1, "hamming": 2})


@pytest.mark.parametrize(
    ("array", "got"),
    [
        (np.array([["1", 2.0]], object)[0], "text"),
        (np.array([1, 2], "m8[s]"), "durations"),
        (np.array([1, 2], "M8[s]"), "dates"),
        (np.array([(1,), (2,)], [("x", "f8")]), "records"),
    ],
)
def test_arrays_of_which_numpy_would_make_numbers(array, got):
    """Early versions took a day for 86400 m, and text for numbers where it came from a table of mixed columns."""
    with pytest.raises(Error, match=rf"^x must be an array of numbers \(got {got}: "):
        frozen_array(array, np.float64, (2,), "x")


@pytest.mark.parametrize("check", [check_number, check_whole_number])
def test_a_duration_is_no_number(check):
    """NumPy counts it as an integer; early versions had a traceback of a comparison."""
    with pytest.raises(Error, match=r"^x must be a (whole )?number"):
        check("x", np.timedelta64(2, "s"), 0, 10)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("dtype", [np.int8, np.float16, np.longdouble])
def test_numbers_of_numpy_need_not_hold_the_bounds(dtype):
    assert check_number("x", dtype(2), -1e10, 1e10) == 2


class _Later:
    async def __call__(self, ping): ...


async def _later(ping): ...


@pytest.mark.parametrize("function", [_later, _Later(), functools.partial(_later, ping=None)])
def test_a_function_that_would_have_to_be_awaited_is_refused(function):
    with pytest.raises(Error, match=r"^on_ping must be a plain function of a Ping \(got an async one; "):
        check_function("on_ping", function, "a Ping")
    check_function("on_ping", [].append, "a Ping")
    check_function("on_ping", functools.partial(print, end=""), "a Ping")
    check_function("on_ping", np.max, "a Ping")
