"""Arrays that grow: when rows are copied, and that none of the arrays before changes."""

import numpy as np

from sonar_gl.core.grown_array import Room


def test_rows_are_copied_when_their_number_has_doubled():
    room, rows, n_copies = Room(), np.zeros((1, 3)), 0
    for number in range(1, 1000):
        more = room.append("rows", rows, [np.full((1, 3), number)])
        n_copies += not np.shares_memory(more, rows)
        rows = more
    assert n_copies == 10
    np.testing.assert_array_equal(rows[:, 1], np.arange(1000))


def test_no_array_changes_and_those_that_nobody_kept_may_be_replaced():
    room = Room()
    first = room.append("rows", np.zeros(0, np.float32), [[1, 2]])
    second = room.append("rows", first, [[3], [4, 5]])
    lost = room.append("rows", second, [[6]])
    other = room.append("rows", second, [[7, 8]])
    assert [one.tolist() for one in (first, second, lost, other)] == [
        [1, 2], [1, 2, 3, 4, 5], [1, 2, 3, 4, 5, 6], [1, 2, 3, 4, 5, 7, 8],
    ]  # fmt: skip
    assert other.dtype == np.float32 and room.append("rows", other, []) is other


def test_names_have_memory_of_their_own():
    room = Room()
    one, other = room.append("one", np.zeros(3), [[1]]), room.append("other", np.zeros(3), [[2]])
    assert one[-1] == 1 and other[-1] == 2
