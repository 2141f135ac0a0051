"""Arrays are given again only when nobody holds them or a part of them."""

import gc

import numpy as np

from sonar_gl.given import MOST, Given


def test_one_that_was_let_go_of_is_given_again():
    given = Given((4, 5))
    one = given.zeros()
    address = one.ctypes.data
    one[:] = 7
    one.setflags(write=False)
    del one
    again = given.zeros()
    assert again.ctypes.data == address and again.flags.writeable
    np.testing.assert_array_equal(again, np.zeros((4, 5), np.float32))


def test_what_is_held_stays():
    """By name, in a list, in part, as bytes, in a function's frame."""
    given, addresses = Given((4, 5)), set()

    def keep(array):
        addresses.add(array.ctypes.data)
        array[:] = len(addresses)
        return array

    held = [
        keep(given.zeros()),
        keep(given.zeros())[1:, ::2],
        memoryview(keep(given.zeros())),
        {"a": keep(given.zeros()).T},
    ]
    for _ in range(20):
        assert given.zeros().ctypes.data not in addresses
    assert len(addresses) == 4
    assert (held[0] == 1).all() and (held[1] == 2).all() and held[2][0, 0] == 3 and (held[3]["a"] == 4).all()


def test_more_than_are_kept():
    given = Given(3)
    many = [given.zeros() for _ in range(MOST + 5)]
    assert len({array.ctypes.data for array in many}) == MOST + 5
    many.clear()
    gc.collect()
    assert len({given.zeros().ctypes.data for _ in range(5)}) == 1
