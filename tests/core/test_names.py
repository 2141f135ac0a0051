"""Patterns of names, in which only * and ? have a meaning."""

import pytest

from sonar_gl.core.names import matching_names, names_of

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


@pytest.mark.parametrize("pattern", ["crate[1]", "boat", "oat", "a?b", "*", "crate[?]", ""])
def test_one_pattern_matches_what_several_do(pattern):
    assert names_of(pattern, dict.fromkeys(NAMES)) == matching_names([pattern], NAMES)


def test_a_plain_name_is_looked_up_among_thousands():
    class Listed(dict):
        """Names that must not be gone through."""

        def __iter__(self):
            raise AssertionError

    names = Listed.fromkeys(NAMES)
    assert names_of("boat", names) == ["boat"] and names_of("ship", names) == []
