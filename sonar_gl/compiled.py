"""How functions are compiled."""

from __future__ import annotations

from numba import njit


def compiled(function):
    """Numba's njit without the GIL; its machine code is kept on disk where there is a place for it.

    What is kept is looked up by the file of the function alone: it may call others of its own file only, or
    it would go on with what they were before that other file changed.
    """
    options = {"nogil": True, "error_model": "numpy", "fastmath": {"contract", "nsz", "arcp"}}
    try:
        return njit(cache=True, **options)(function)
    except RuntimeError:  # "cannot cache function": no folder that can be written
        return njit(**options)(function)
