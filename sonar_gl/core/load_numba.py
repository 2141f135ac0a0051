"""Loading of Numba in the process of a command."""

from __future__ import annotations

import sys


def load_numba() -> None:
    """Load Numba without scipy.linalg, which saves a fifth of a second and 16 MB.

    Numba looks for the BLAS of scipy.linalg as it loads; no function of this package needs it. Only the process of a
    command calls this: in a process shared with other code, their compiled np.convolve would miss the BLAS.
    """
    blas = "scipy.linalg.cython_blas"
    if blas in sys.modules:
        return
    sys.modules[blas] = None  # the import system then treats it as missing
    try:
        import numba.np.arraymath  # noqa: F401
    finally:
        del sys.modules[blas]
