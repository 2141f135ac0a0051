"""Checks of paths that are to be read, with errors that say what is wrong with a path."""

from __future__ import annotations

import errno
import os
from pathlib import Path

from sonar_gl.core.errors import Error

LINK_LOOP = "a loop of symbolic links"


def is_link_loop(path) -> bool:
    """Return whether a path leads into a loop of symbolic links, which other tests take for a missing file."""
    try:
        os.stat(path)
    except OSError as why:
        return why.errno == errno.ELOOP
    except ValueError:  # a null character
        return False
    return False


def check_no_link_loop(path) -> None:
    """Raise an `Error` if a path leads into a loop of symbolic links."""
    if is_link_loop(path):
        raise Error(f"{path}: must be a file or folder (got {LINK_LOOP}; remove the link, and make it again)")


def check_is_file(path) -> None:
    """Raise an `Error` unless there is a regular file at a path."""
    check_no_link_loop(path)
    if not Path(path).is_file():
        raise Error(f"{path}: there is no such file")


def read_error_text(why: OSError) -> str:
    """Return why a file could not be read, for an error message."""
    return LINK_LOOP if why.errno == errno.ELOOP else (why.strerror or str(why)).lower()
