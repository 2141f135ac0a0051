"""The error class of the package, and helpers for its messages."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager

MAX_NAMES = 10  # in a message
# Characters that a terminal obeys in place of showing them: controls but tab and newline, among them U+009B, which
# starts escape sequences, and those that turn the direction of the text that follows. Names in files may hold them.
CONTROLS = {*range(0x20), *range(0x7F, 0xA0), *range(0x202A, 0x202F), *range(0x2066, 0x206A)} - set(b"\t\n")
ESCAPES = {code: ascii(chr(code))[1:-1] for code in CONTROLS}


def escape_controls(text: str) -> str:
    r"""Return a text with the characters that a terminal would obey as escape sequences, like those of `repr`.

    >>> escape_controls("a\u202eb\x9b")
    'a\\u202eb\\x9b'
    """
    return text.translate(ESCAPES)


def one_line(text: str) -> str:
    r"""Return a name from a file as `escape_controls` does, and on one line: others would pass for output of ours.

    >>> one_line("a\nerror: b")
    'a\\nerror: b'
    """
    return escape_controls(text).replace("\t", "\\t").replace("\n", "\\n")


class Error(ValueError):
    """A mistake that the caller can correct.

    The message states what must hold, what was given instead, where, and what to do. It is safe to print.
    """

    def __init__(self, message: object):
        super().__init__(escape_controls(str(message)))


class MachineError(Error):
    """A failure of the machine, not of the caller: the same may succeed when it is tried again.

    A port that another program uses is no such failure, but an `Error`: the caller can take another one.
    """


RAISE_FILE_LIMIT = "raise the limit of open files, as by 'ulimit -n 1024'"  # of an OSError with errno.EMFILE
OUT_OF_MEMORY = ("cannot allocate memory", "can't start new thread", "insufficient memory")


def is_out_of_memory(why: BaseException) -> bool:
    """Return whether an exception says that memory ran out, which libraries do in words of their own.

    >>> is_out_of_memory(RuntimeError("can't start new thread"))
    True
    """
    if isinstance(why, MemoryError):
        return True
    return any(words in str(why).lower() for words in OUT_OF_MEMORY)


class SampleLimitError(Error):
    """More samples than the driver can draw: fewer would do."""


@contextmanager
def errors_at(location: str) -> Iterator[None]:
    """Put a file, element or argument before the messages of errors raised in a with block.

    >>> with errors_at("scene.sdf"):
    ...     raise Error("must hold a <world>")
    Traceback (most recent call last):
        ...
    sonar_gl.core.errors.Error: scene.sdf: must hold a <world>
    """
    try:
        yield
    except Error as why:
        raise type(why)(f"{location}: {why}") from None


def closed_error(kind: str) -> Error:
    """Return the error for the use of an object after it was closed.

    >>> str(closed_error("Simulator"))
    'this Simulator is closed; make a new one'
    """
    return Error(f"this {kind} is closed; make a new one")


def other_process_error(kind: str) -> Error:
    """Return the error for the use of an object in a fork of the process that made it."""
    return Error(f"a {kind} must be used in the process that made it; make one in each process")


def nearest_names(name: str, known: Iterable[str]) -> str:
    """Return the hint about an unknown name: the most similar known names, or all of them if none is similar.

    >>> nearest_names("hammin", ("uniform", "hamming"))
    "did you mean 'hamming'?"
    >>> nearest_names("x", ("uniform", "hamming"))
    'known are hamming, uniform'
    """
    known = sorted(known)
    return similar_names(name, known) or "known are " + ", ".join(known)


def nearest_of_many(name: str, known: Iterable[str]) -> str:
    """Return the hint of `nearest_names`, with a few of the known names alone: a scene may have thousands, or none.

    >>> nearest_of_many("x", [f"pile_{k:02d}" for k in range(12)])
    'known are pile_00, pile_01, pile_02, pile_03, pile_04, pile_05, pile_06, pile_07, pile_08, pile_09 and 2 more'
    >>> nearest_of_many("x", [])
    'there are none'
    """
    known = sorted(known)
    if not known:
        return "there are none"
    return similar_names(name, known) or f"known are {some_names(known)}"


def similar_names(name: str, known: list[str]) -> str:
    """Return a question about the most similar known names; empty if none is similar.

    >>> similar_names("oculus", ["oculus-m750d-hf", "p900-45"])
    "did you mean 'oculus-m750d-hf'?"
    >>> similar_names("foo", ["looks", "speckle"])
    ''
    """
    if not isinstance(name, str):
        return ""
    near = difflib.get_close_matches(name, known, n=3, cutoff=0.6)
    # half alike suffices for a part of a name, or with its first letter: 'hann' for 'hamming', not 'foo' for 'looks'
    similar = difflib.get_close_matches(name, known, n=3, cutoff=0.5)
    similar = [one for one in similar if one in near or name in one or one[:1] == name[:1]]
    return "did you mean " + " or ".join(repr(n) for n in similar) + "?" if similar else ""


def some_names(names: list[str]) -> str:
    """Return the first names of a list for a message, and how many there are beside them.

    >>> some_names([f"pile_{k}" for k in range(12)][:3])
    'pile_0, pile_1, pile_2'
    """
    more = len(names) - MAX_NAMES
    return f"{', '.join(map(one_line, names[:MAX_NAMES]))}{f' and {more} more' if more > 0 else ''}"
