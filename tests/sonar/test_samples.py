"""The arrays of samples that the beamformer sums."""

import numpy as np
import pytest

from sonar_gl.sonar.samples import whole_rows


@pytest.mark.parametrize("tail", [(), (4,)])
def test_whole_rows_are_a_contiguous_view_that_begins_where_the_window_does(tail):
    image = np.arange(5 * 7 * int(np.prod(tail)), dtype=np.float32).reshape(5, 7, *tail)
    window = image[:4, 2:5]
    rows = whole_rows(window)
    assert rows.flags.c_contiguous and rows.shape == (4, 7, *tail) and np.shares_memory(rows, image)
    np.testing.assert_array_equal(rows[:, :3], window)


def test_an_array_of_its_own_is_returned_as_it_is():
    image = np.zeros((5, 7, 4), np.float32)
    assert whole_rows(image) is image and whole_rows(image[:0]).size == 0
