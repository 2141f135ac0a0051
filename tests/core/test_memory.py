"""Arrays that are reused or grow, and large tables of which little is used."""

import gc
import os
import resource
import sys
from pathlib import Path

import numpy as np
import pytest

from sonar_gl.core.memory import (
    MAX_ARRAYS,
    MAX_KEPT_ROWS,
    MIN_KEPT,
    USES_BEFORE_SMALLER,
    ArrayPool,
    DynamicArrays,
    ReusedArray,
    prepare_in_turn,
    return_free_memory,
    sparse_table,
)

MANY, FEW = 10 * MIN_KEPT, 100


# --- pools: an array is reused only when nobody holds a reference to it or to a view of it


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


# --- arrays that are used again: when they become larger, when smaller


@pytest.fixture
def array():
    made = ReusedArray(np.float32, 4)
    made.take(MANY)
    return made


def test_arrays_have_the_rows_that_are_asked_for(array):
    for count in (0, 1, FEW, MANY, 2 * MANY, 20 * MANY):
        assert array.take(count).shape == (count, 4)
    assert array.take(1).dtype == np.float32


def test_uses_that_take_turns_have_one_array(array):
    """As the sectors of a ping do: those of side lobes need few rows."""
    size = len(array)
    for _ in range(3 * USES_BEFORE_SMALLER):
        assert np.shares_memory(array.take(MANY), array.take(FEW))
    assert len(array) == size


def test_a_smaller_array_follows_where_many_uses_in_a_row_need_few_rows(array):
    size, most = len(array), 7 * FEW
    for number in range(USES_BEFORE_SMALLER):
        array.take(most if number == 5 else FEW)
        assert len(array) == size
    array.take(FEW)
    assert most <= len(array) < size / 4  # as large as the largest of these uses


def test_small_arrays_stay():
    array = ReusedArray(np.int32)
    array.take(MIN_KEPT // 2)
    size = len(array)
    for _ in range(2 * USES_BEFORE_SMALLER):
        array.take(1)
    assert len(array) == size


def test_large_arrays_are_dropped_where_asked_and_what_was_taken_stays(array):
    taken = array.take(MANY)
    taken[:] = 3.0
    array.drop_large()
    assert MANY > MAX_KEPT_ROWS > MIN_KEPT
    assert len(array) == 0
    array.take(MANY)[:] = 4.0
    assert (taken == 3.0).all()


def page_faults(work) -> int:
    """Return how many pages of memory the system provides while `work` is done."""
    before = resource.getrusage(resource.RUSAGE_THREAD).ru_minflt
    work()
    return resource.getrusage(resource.RUSAGE_THREAD).ru_minflt - before


@pytest.mark.parametrize(("share", "growth"), [(1.0, 3.0), (0.5, 2.0)])
def test_memory_that_was_made_ready_needs_no_more_pages(share, growth):
    """Of 10 MB more, which are 5 large pages or 2560 small ones; the same again needs none."""
    return_free_memory()  # or else the array may lie in pages that the process has from others
    array = ReusedArray(np.float32, 4)
    array.take(MANY)[:] = 3.0
    assert page_faults(lambda: array.prepare(3 * MANY, share)) > 2
    assert page_faults(lambda: array.prepare(3 * MANY, share)) <= 1
    taken = array.take(int(growth * MANY))
    assert page_faults(lambda: taken.fill(4.0)) <= 2


def test_what_was_taken_stays_as_more_memory_is_made_ready(array):
    taken = array.take(MANY)
    taken[:] = 3.0
    for share in (0.3, 0.6, 1.0):
        array.prepare(2 * MANY, share)
    assert (taken == 3.0).all()
    assert np.shares_memory(taken, array.take(2 * MANY))  # finer samples use the memory of the coarser ones


def test_memory_is_made_ready_in_another_array_where_there_is_no_room(array):
    """In parts, too. What was taken stays, and the other array is there once it is needed."""
    return_free_memory()
    taken, size = array.take(MANY), len(array)
    taken[:] = 3.0
    count = 2 * size
    for share in (0.5, 1.0):
        assert page_faults(lambda share=share: array.prepare(count, share)) > 2
    assert len(array) == size and (array.take(MANY) == 3.0).all()
    larger = array.take(count)
    assert page_faults(lambda: larger.fill(4.0)) <= 2
    assert (taken == 3.0).all()


def test_memory_of_still_more_rows_is_made_ready_in_a_third_array():
    """Where another one, which was not needed yet, has no room for them."""
    array = ReusedArray(np.uint8)
    array.take(MANY)
    array.prepare(len(array) + 1, 1.0)
    count = 8 * len(array)
    return_free_memory()
    assert page_faults(lambda: array.prepare(count, 1.0)) > 2
    taken = array.take(count)
    assert page_faults(lambda: taken.fill(4)) <= 2


def test_arrays_get_their_memory_one_after_the_other(array):
    """Of a share of each, a large page would be the least."""
    return_free_memory()
    arrays = [array, *(ReusedArray(np.int32, 2) for _ in range(2))]
    for one in arrays:
        one.take(MANY)[:] = 1
    wanted = [(one, 4 * MANY) for one in arrays]  # of which the first one has as many bytes as both others
    assert page_faults(lambda: prepare_in_turn(wanted, 0.5)) > 2
    assert page_faults(lambda: array.take(4 * MANY).fill(1.0)) <= 2
    for one in arrays[1:]:
        assert page_faults(lambda one=one: one.take(4 * MANY).fill(1)) > 5  # of 8 large pages none is there


def test_all_of_the_arrays_have_their_memory_in_the_end(array):
    """Also one without room, all of whose rows are missing."""
    return_free_memory()
    other, count = ReusedArray(np.uint16), 4 * MANY
    array.take(MANY)[:] = 1.0
    other.take(MANY)[:] = 1
    assert len(other) < count <= len(array)
    assert (array.missing_bytes(count), other.missing_bytes(count)) == (3 * MANY * 16, count * 2)
    for share in (0.3, 0.9, 1.0):
        prepare_in_turn([(array, count), (other, count)], share)
    for one in (array, other):
        assert page_faults(lambda one=one: one.take(count).fill(1)) <= 2


def test_another_array_that_was_not_needed_is_dropped(array):
    array.prepare(2 * len(array), 1.0)
    array.drop_large()
    return_free_memory()
    assert page_faults(lambda: array.take(MANY).fill(1.0)) > 2


# --- dynamic arrays: when rows are copied, and that none of the arrays before changes


def test_rows_are_copied_when_their_number_has_doubled():
    room, rows, n_copies = DynamicArrays(), np.zeros((1, 3)), 0
    for number in range(1, 1000):
        more = room.append("rows", rows, [np.full((1, 3), number)])
        n_copies += not np.shares_memory(more, rows)
        rows = more
    assert n_copies == 10
    np.testing.assert_array_equal(rows[:, 1], np.arange(1000))


def test_no_array_changes_and_those_that_nobody_kept_may_be_replaced():
    room = DynamicArrays()
    first = room.append("rows", np.zeros(0, np.float32), [[1, 2]])
    second = room.append("rows", first, [[3], [4, 5]])
    lost = room.append("rows", second, [[6]])
    other = room.append("rows", second, [[7, 8]])
    assert [one.tolist() for one in (first, second, lost, other)] == [
        [1, 2], [1, 2, 3, 4, 5], [1, 2, 3, 4, 5, 6], [1, 2, 3, 4, 5, 7, 8],
    ]  # fmt: skip
    assert other.dtype == np.float32 and room.append("rows", other, []) is other


def test_names_have_memory_of_their_own():
    room = DynamicArrays()
    one, other = room.append("one", np.zeros(3), [[1]]), room.append("other", np.zeros(3), [[2]])
    assert one[-1] == 1 and other[-1] == 2


# --- sparse tables


def resident_mb():
    """Return the resident memory of this process."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_only_what_is_written_of_a_sparse_table_becomes_resident():
    """An array of NumPy becomes resident as a whole, 41 MB, where Linux has pages of 2 MB for programs that ask."""
    before = resident_mb()
    table = sparse_table(39, 1 << 17)
    table[:, :100] = 1.0
    # a page or two of each row, and what Python needs meanwhile
    assert resident_mb() - before < 4
    assert table.sum() == 3900


def test_a_sparse_table_holds_zeros_that_can_be_written():
    table = sparse_table(3, 1000)
    assert table.shape == (3, 1000) and table.dtype == np.float64 and not table.any()
    table[2, 999] = 7.0
    assert table.sum() == 7.0


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_a_forked_child_has_a_sparse_table_of_its_own():
    table = sparse_table(2, 1000)
    child = os.fork()
    if child == 0:
        table[0, 0] = 1.0
        os._exit(0)
    assert os.waitpid(child, 0)[1] == 0
    assert table[0, 0] == 0.0


def test_a_table_for_which_there_is_no_room_is_a_memory_error():
    with pytest.raises(MemoryError, match="no room for"):
        sparse_table(1 << 20, 1 << 36)
