"""Patterns of names, in which only * and ? have a meaning."""

import pytest

from sonar_gl.core.names import matching_names

NAMES = ["crate[1]", "crate1", "crate[12]", "boat::hull", "boat", "a.b", "two\nlines", "!x", "(x)"]


@pytest.mark.parametrize(
    ("patterns", "expected"),
    [
        (["crate[1]"], ["crate[1]"]),
        (["crate[?]"], ["crate[1]"]),
        (["crate[*]"], ["crate[1]", "crate[12]"]),
        (["*"], NAMES),
        (["boat", "*hull"], ["boat::hull", "boat"]),
        (["oat", "BOAT", "boa", ""], []),
        (["a?b", "a.b"], ["a.b"]),
        (["two*lines"], ["two\nlines"]),
        (["[!]x", "[(]x)"], []),
        ([], []),
    ],
)
def test_names_match_patterns(patterns, expected):
    assert matching_names(patterns, NAMES) == expected
