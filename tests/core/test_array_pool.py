"""A pool reuses an array only when nobody holds a reference to it or to a view of it."""

import gc

import numpy as np

from sonar_gl.core.array_pool import MAX_ARRAYS, ArrayPool


def test_an_array_without_references_is_reused():
    pool = ArrayPool((4, 5))
    one = pool.empty()
    address = one.ctypes.data
    one[:] = 7
    one.setflags(write=False)
    del one
    again = pool.empty()
    assert again.ctypes.data == address and again.flags.writeable
    assert again.shape == (4, 5) and again.dtype == np.float32


def test_an_array_with_references_is_not_reused():
    """References are a list entry, a view, a memoryview and a transposed array in a dict."""
    pool, addresses = ArrayPool((4, 5)), set()

    def keep(array):
        addresses.add(array.ctypes.data)
        array[:] = len(addresses)
        return array

    held = [
        keep(pool.empty()),
        keep(pool.empty())[1:, ::2],
        memoryview(keep(pool.empty())),
        {"a": keep(pool.empty()).T},
    ]
    for _ in range(20):
        assert pool.empty().ctypes.data not in addresses
    assert len(addresses) == 4
    assert (held[0] == 1).all() and (held[1] == 2).all() and held[2][0, 0] == 3 and (held[3]["a"] == 4).all()


def test_a_pool_hands_out_more_arrays_than_it_keeps():
    pool = ArrayPool(3)
    many = [pool.empty() for _ in range(MAX_ARRAYS + 5)]
    assert len({array.ctypes.data for array in many}) == MAX_ARRAYS + 5
    many.clear()
    gc.collect()
    assert len({pool.empty().ctypes.data for _ in range(5)}) == 1
