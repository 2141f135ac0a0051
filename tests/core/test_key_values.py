"""Parsing of text into fields of a dataclass."""

from __future__ import annotations

from dataclasses import dataclass

import pytest

import sonar_gl as sg
from sonar_gl.core.errors import Error
from sonar_gl.core.key_values import parse_fields


@dataclass
class Settings:
    on: bool = False
    maybe: bool | None = None
    count: int = 0
    level: float = 0.0
    limit: float | None = None
    law: str = "flat"
    hidden: int = 0


def parse(text):
    return parse_fields("settings", text, Settings, presets=("quiet", "loud"), without=("hidden",))


@pytest.mark.parametrize(
    "text, preset, values",
    [
        ("quiet", "quiet", {}),
        ("level=1e3", None, {"level": 1000.0}),
        ("loud, count = 3 ,law=steep", "loud", {"count": 3, "law": "steep"}),
        ("on", None, {"on": True}),
        ("on=no,maybe=none,limit=none", None, {"on": False, "maybe": None, "limit": None}),
        ("maybe=1,limit=-2", None, {"maybe": True, "limit": -2.0}),
        ("count=3.5", None, {"count": 3.5}),  # refused by the class, which knows what it must be
    ],
)
def test_values_have_the_types_of_the_fields(text, preset, values):
    out = parse(text)
    assert out == (preset, values)
    assert [type(value) for value in out[1].values()] == [type(value) for value in values.values()]


@pytest.mark.parametrize(
    "text, message",
    [
        ("", "unknown name (got ''; known are count, law, level, limit, loud, maybe, on, quiet)"),
        *(
            (text, "commas must stand between two items (got one with none beside it; leave it out)")
            for text in ("on,", "on,,", ",on", "on, ,count=3", ",")
        ),
        ("on,quiet", "unknown name (got 'quiet'; known are count, law, level, limit, maybe, on)"),
        ("quiet=1", "unknown name (got 'quiet'; known are count, law, level, limit, maybe, on)"),
        ("levl=1", "unknown name (got 'levl'; did you mean 'level'?)"),
        ("hidden=1", "unknown name (got 'hidden'; known are count, law, level, limit, maybe, on)"),
        ("level", "level must have a value, as in level=... (got none)"),
        ("level=", "level must be a number (got '')"),
        ("level=none", "level must be a number (got 'none')"),
        ("on=maybe", "on must be yes or no (got 'maybe')"),
        ("on=none", "on must be yes or no (got 'none')"),
        ("on,on=no", "on must be given once"),
    ],
)
def test_invalid_text_raises_errors(text, message):
    with pytest.raises(Error) as why:
        parse(text)
    assert str(why.value).startswith(f"settings {text!r}: {message}")


@pytest.mark.parametrize("value", [None, 5, {"level": 1.0}])
def test_what_is_no_text_is_refused(value):
    with pytest.raises(Error) as why:
        parse(value)
    kind = type(value).__name__
    assert str(why.value) == f"settings must be a str (got {kind}; such as 'key=value,key=value')"


@pytest.mark.parametrize("kind", [sg.Acoustics, sg.Noise, sg.Water])
def test_settings_are_parsed_from_text_alone(kind):
    with pytest.raises(Error, match=rf"^{kind.__name__.lower()} must be a str \(got dict; such as '"):
        kind.parse({})
