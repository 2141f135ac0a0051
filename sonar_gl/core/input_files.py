"""Checks of paths that are to be read, with errors that say what is wrong with a path."""

from __future__ import annotations

import errno
import os
import stat
from codecs import BOM_UTF16_BE, BOM_UTF16_LE
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar

from sonar_gl.core.errors import Error

LINK_LOOP = "a loop of symbolic links"
GIT_LFS_HEAD = b"version https://git-lfs"  # of what stands in the place of a large file until it is fetched

_noted: ContextVar[list[str] | None] = ContextVar("files noted in this thread", default=None)


@contextmanager
def noted_files() -> Iterator[list[str]]:
    """Yield a list that this thread's calls of `note_file` in the block fill, with absolute paths; others get none.

    >>> with noted_files() as found:
    ...     check_is_file(__file__)
    >>> found == [os.path.abspath(__file__)]
    True
    """
    found: list[str] = []
    token = _noted.set(found)
    try:
        yield found
    finally:
        _noted.reset(token)


def note_file(path) -> None:
    """Note, for `noted_files`, a file that is about to be read; `check_is_file` does so."""
    found, place = _noted.get(), os.path.abspath(path)
    if found is not None and place not in found:
        found.append(place)


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
    """Raise an `Error` unless there is a regular file at a path, which holds something."""
    check_no_link_loop(path)
    if not os.path.exists(path):
        raise Error(f"{path}: there is no such file")
    check_kind_of_file(path)
    if os.path.getsize(path) == 0:
        raise Error(f"{path}: must not be empty (got a file of 0 bytes)")
    note_file(path)


def check_kind_of_file(path, pipe: bool = False) -> None:
    """Raise an `Error` if something else than a file is at a path, or a pointer of Git LFS in the place of a file.

    Opening a named pipe waits until somebody writes to it, and a device may never end. A missing file passes.

    pipe : whether a pipe will do that is open already, as /dev/stdin may be, or what a shell makes of <(...)
    """
    try:
        mode = os.stat(path).st_mode
    except (OSError, ValueError):  # missing, a loop, a null character: reading tells
        return
    if stat.S_ISREG(mode):
        with suppress(OSError), open(path, "rb") as file:  # who reads it says why that fails
            if file.read(len(GIT_LFS_HEAD)) == GIT_LFS_HEAD:
                raise Error(
                    f"{path}: must be the file itself (got a pointer of Git LFS; fetch the file by 'git lfs pull' in "
                    "its repository)"
                )
        return
    is_pipe = stat.S_ISFIFO(mode)
    is_open_pipe = is_pipe and not os.path.exists(os.path.realpath(path))
    if pipe and is_open_pipe:
        return
    got = "a pipe" if is_open_pipe else describe_kind(mode)
    raise Error(
        f"{path}: must be a file (got {got}{'; write its content to a file first' if is_pipe else ''})"
    )


def describe_kind(mode: int) -> str:
    """Return what is at a path that is no regular file, by the mode of `os.stat`.

    >>> describe_kind(os.stat("/dev/null").st_mode)
    'a device'
    """
    kinds = {stat.S_IFDIR: "a folder", stat.S_IFIFO: "a named pipe", stat.S_IFSOCK: "a socket"}
    return kinds.get(stat.S_IFMT(mode), "a device")


def read_error_text(why: OSError) -> str:
    """Return why a file could not be read, for an error message."""
    return LINK_LOOP if why.errno == errno.ELOOP else (why.strerror or str(why)).lower()


def is_utf_16(data: bytes) -> bool:
    """Return whether a file of text begins as UTF-16 does: by its mark of byte order, or a letter of two bytes."""
    return data[:2] in (BOM_UTF16_LE, BOM_UTF16_BE) or 0 in data[:2]
