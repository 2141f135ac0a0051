"""Large tables of which little is used."""

import os
import sys
from pathlib import Path

import numpy as np
import pytest

from sonar_gl.core.memory import sparse_table


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
