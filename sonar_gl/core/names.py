"""Names that patterns stand for."""

from __future__ import annotations

import re
from collections.abc import Iterable
from functools import lru_cache


def matching_names(patterns: Iterable[str], names: Iterable[str]) -> list[str]:
    """Return the names that match any of the patterns, in the order of the names.

    Parameters
    ----------
    patterns : in which * stands for any text and ? for one character; every other character stands for itself, also
        brackets, which names of bodies may have

    >>> matching_names(["crate[1]", "b?at*"], ["crate[1]", "crate1", "boat::hull", "Boat"])
    ['crate[1]', 'boat::hull']
    """
    expressions = [_expression(pattern) for pattern in patterns]
    return [name for name in names if any(one.fullmatch(name) for one in expressions)]


@lru_cache(maxsize=256)
def _expression(pattern: str) -> re.Pattern:
    """Return the regular expression of a pattern."""
    text = "".join({"*": ".*", "?": "."}.get(character, re.escape(character)) for character in pattern)
    return re.compile(text, re.DOTALL)
