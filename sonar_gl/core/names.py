"""Names that patterns stand for."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable
from functools import lru_cache


def matching_names(patterns: Iterable[str], names: Iterable[str]) -> list[str]:
    """Return the names that match any of the patterns, in the order of the names.

    patterns : in which * stands for any text and ? for one character; every other character stands for itself, also
        brackets, which names of bodies may have

    >>> matching_names(["crate[1]", "b?at*"], ["crate[1]", "crate1", "boat::hull", "Boat"])
    ['crate[1]', 'boat::hull']
    """
    patterns = set(patterns)
    expressions = [_expression(pattern) for pattern in patterns if _has_wildcards(pattern)]
    return [name for name in names if name in patterns or any(one.fullmatch(name) for one in expressions)]


def names_of(pattern: str, names: Collection[str]) -> list[str]:
    """Return the names that one pattern matches.

    names : in which a plain name is looked up: a dict or a set where there may be thousands of both

    >>> names_of("boat", {"boat", "boat_2"})
    ['boat']
    """
    if _has_wildcards(pattern):
        return matching_names([pattern], names)
    return [pattern] if pattern in names else []


def _has_wildcards(pattern: str) -> bool:
    """Return whether a pattern may stand for other names than itself."""
    return "*" in pattern or "?" in pattern


@lru_cache(maxsize=256)
def _expression(pattern: str) -> re.Pattern:
    """Return the regular expression of a pattern."""
    text = "".join({"*": ".*", "?": "."}.get(character, re.escape(character)) for character in pattern)
    return re.compile(text, re.DOTALL)
