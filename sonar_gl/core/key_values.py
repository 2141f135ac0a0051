"""Parser of the text "key=value,..." of command-line options into fields of a dataclass."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import fields
from types import NoneType
from typing import get_args, get_type_hints

from sonar_gl.core.checks import check_kind
from sonar_gl.core.errors import Error, nearest_names

SWITCHES = dict.fromkeys(("1", "yes", "true", "on"), True)
SWITCHES |= dict.fromkeys(("0", "no", "false", "off"), False)


def parse_fields(
    what: str,
    text: str,
    cls: type,
    presets: Collection[str] = (),
    without: Collection[str] = (),
    hint_of: Callable[[str, Collection[str]], str] = nearest_names,
) -> tuple[str | None, dict]:
    """Parse `key=value,...` by the types of the fields of a dataclass; return the preset, or None, and the values.

    `cls` checks their bounds. Raises Error if a name is unknown or given twice, or its value is of another type.

    what : name of the option, with which messages begin
    text : items separated by commas. The first may be the name of a preset. A field of type bool takes yes or
        no, true or false, on or off, 1 or 0, and its name alone means yes. A field whose type includes None
        takes none
    cls : dataclass with fields of type bool, int, float or str, or one of these and None
    presets : names that the first item may have in place of a key
    without : fields that text cannot set
    hint_of : what a message says of an unknown name, from that name and the known ones
    """
    check_kind(what, text, str, "such as 'key=value,key=value'")
    hints = get_type_hints(cls)
    kinds = {
        f.name: get_args(hints[f.name]) or (hints[f.name],) for f in fields(cls) if f.name not in without
    }
    location, preset, out = f"{what} {text!r}", None, {}
    for position, item in enumerate(text.split(",")):
        key, equals, value = (part.strip() for part in item.partition("="))
        may_be_preset = position == 0 and not equals
        if may_be_preset and key in presets:
            preset = key
            continue
        if not item.strip() and "," in text:
            raise Error(
                f"{location}: commas must stand between two items (got one with none beside it; leave it out)"
            )
        if key not in kinds:
            known = [*kinds, *presets] if may_be_preset else kinds
            hint = hint_of(key, known)
            if (
                may_be_preset
                and presets
                and not any(repr(name) in hint or f" {name}" in hint for name in presets)
            ):
                hint = f"presets are {', '.join(presets)}; {hint}"
            raise Error(f"{location}: unknown name (got {key!r}; {hint})")
        if key in out:
            raise Error(f"{location}: {key} must be given once")
        if not equals and bool not in kinds[key]:
            raise Error(f"{location}: {key} must have a value, as in {key}=... (got none)")
        out[key] = _parse_value(f"{location}: {key}", value if equals else "yes", kinds[key])
    return preset, out


def _parse_value(what: str, text: str, kinds: tuple[type, ...]):
    """Parse `text` as a value of one of the types `kinds`."""
    if text == "none" and NoneType in kinds:
        return None
    if bool in kinds:
        if text not in SWITCHES:
            raise Error(f"{what} must be yes or no (got {text!r})")
        return SWITCHES[text]
    if str in kinds:
        return text
    try:
        number = float(text)
    except ValueError:
        raise Error(f"{what} must be a number (got {text!r})") from None
    return int(number) if int in kinds and number.is_integer() else number
