"""Warnings that name the line of the calling program, and that one thread can keep from being shown."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from typing import NamedTuple
from weakref import ref

from sonar_gl.core.errors import escape_controls

# How many texts Python may remember of a module. Some are new with each ping, as where distances are in them.
MOST_TEXTS = 1000


class CollectedWarning(NamedTuple):
    """A warning that was collected in place of being shown."""

    text: str
    category: type[Warning]


@dataclass(frozen=True, eq=False)
class _Collection:
    category: type[Warning]
    found: list[CollectedWarning] = field(default_factory=list)


# Of this thread, the innermost first. A block that an interrupt ends before it has restored those around it would
# swallow all later warnings: the reference to its collection is dead then.
_collections: ContextVar[tuple[ref[_Collection], ...]] = ContextVar("collections of warnings", default=())


def warn_caller(message: str, category: type[Warning] = UserWarning) -> None:
    """Issue a warning, safe to print, for the nearest stack frame outside of sonar_gl and of `dataclasses.replace`.

    Where this thread is inside `collected_warnings` of its category, it is collected in place of being shown. Where
    Python shows a text once per line, it may show it again after MOST_TEXTS others.
    """
    text = escape_controls(message)
    for reference in _collections.get():
        collection = reference()
        if collection is not None and issubclass(category, collection.category):
            collection.found.append(CollectedWarning(text, category))
            return
    level, frame = 1, sys._getframe(0)
    while frame.f_back is not None and f"{frame.f_globals['__name__']}.".startswith(
        ("sonar_gl.", "dataclasses.")
    ):
        level, frame = level + 1, frame.f_back
    warnings.warn(text, category, stacklevel=level)
    # Python never forgets a text that it has shown: of pings of empty water, for weeks, it would keep gigabytes
    remembered = frame.f_globals.get("__warningregistry__", {})
    if len(remembered) > MOST_TEXTS:
        remembered.clear()


@contextmanager
def collected_warnings(category: type[Warning] = UserWarning) -> Iterator[list[CollectedWarning]]:
    """Have the warnings that `warn_caller` issues in the block go into the list that this yields; none is shown.

    It holds for this thread alone, unlike `warnings.catch_warnings`, which changes the state of the process: of two
    threads that use it at once, one shows what it should not, or swallows what the other should show, for ever.

    category : of the warnings; those of others are issued as they are

    >>> with collected_warnings() as found:
    ...     warn_caller("no echo came back")
    >>> found[0].text
    'no echo came back'
    """
    collection, around = _Collection(category), _collections.get()
    try:
        _collections.set((ref(collection), *around))
        yield collection.found
    finally:
        _collections.set(around)
