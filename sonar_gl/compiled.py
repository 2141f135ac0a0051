"""How functions are compiled."""

from __future__ import annotations

import os

from numba import njit


def compiled(function):
    """Numba's njit without the GIL; its machine code is kept on disk where there is a place for it.

    What is kept is looked up by the file of the function alone: it may call others of its own file only, or
    it would go on with what they, or numbers taken from there, were before that other file changed. See
    `compiled_with`.
    """
    options = {"nogil": True, "error_model": "numpy", "fastmath": {"contract", "nsz", "arcp"}}
    try:
        return njit(cache=True, **options)(function)
    except RuntimeError:  # "cannot cache function": no folder that can be written
        return njit(**options)(function)


def compiled_with(*others):
    """`compiled`, for a function that calls some of other modules: what is kept is theirs, too."""

    def decorate(function):
        out = compiled(function)
        kept = getattr(getattr(out, "_cache", None), "_cache_file", None)
        if hasattr(kept, "_source_stamp"):  # Numba's own, by time and size of the file
            files = [os.stat(module.__file__) for module in others]
            kept._source_stamp = kept._source_stamp, *((file.st_mtime, file.st_size) for file in files)
        return out

    return decorate
