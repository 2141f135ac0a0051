"""Tables of a job file: what they may hold, and errors that name file, table and key."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import MISSING, fields
from fnmatch import fnmatchcase
from functools import partial
from typing import Annotated, Any

from pydantic import BaseModel, BeforeValidator, ConfigDict, ValidationError

from sonar_gl.types import Error, nearest_names


def _is_number(value) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


def _varied(value, low: float = -math.inf, high: float = math.inf):
    pair = value if isinstance(value, list) else [value, value]
    if len(pair) != 2 or not all(map(_is_number, pair)) or pair[0] > pair[1]:
        raise ValueError("should be a number, or [low, high]")
    if not low <= pair[0] <= pair[1] <= high:
        raise ValueError(f"should lie in {low:g}..{high:g}")
    return value


def _range(value):
    if not isinstance(value, list) or len(value) != 2 or not all(map(_is_number, value)):
        raise ValueError("should be [darkest, brightest]")
    if value[0] >= value[1]:
        raise ValueError("should be [darkest, brightest], which rise")
    return value


# what is drawn evenly between two numbers, or is one; likewise within 0..1, metres, and radians; dB of dark
# and bright
Varied = Annotated[Any, BeforeValidator(_varied)]
VariedShare = Annotated[Any, BeforeValidator(partial(_varied, low=0.0, high=1.0))]
VariedMetres = Annotated[Any, BeforeValidator(partial(_varied, low=-1e8, high=1e8))]
VariedRadians = Annotated[Any, BeforeValidator(partial(_varied, low=-6.283, high=6.283))]
Decibels = Annotated[Any, BeforeValidator(_range)]


class Table(BaseModel):
    """A table of a job file; what it does not know it refuses."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


def named(place) -> str:
    """A path of keys as one finds it in the file: sonars[1].mount, counted from 0."""
    out = ""
    for key in place:
        out += f"[{key}]" if isinstance(key, int) else f".{key}" if out else str(key)
    return out


def meant(patterns, names) -> list[str]:
    """The names that patterns mean, in their own order."""
    return [name for name in names if any(fnmatchcase(name, pattern) for pattern in patterns)]


def matching(patterns, names, where: str) -> list[str]:
    """Likewise; an Error for a pattern that means none."""
    names = list(names)
    for pattern in patterns:
        if not any(fnmatchcase(name, pattern) for name in names):
            raise Error(
                f"{where} must name bodies of the scene (got {pattern!r}; {nearest_names(pattern, names)})"
            )
    return meant(patterns, names)


def read(table_type, data: Mapping, where: str):
    """A `Table` from plain values.

    Raises
    ------
    Error
        with all that is wrong, each by its place in the file `where`.
    """
    try:
        return table_type.model_validate(data)
    except ValidationError as why:
        told = [_sentence(error, table_type) for error in why.errors()]
        raise Error(f"{where}: " + "; ".join(dict.fromkeys(told))) from None


def _sentence(error, table_type) -> str:
    place, kind = error["loc"], error["type"]
    if kind == "extra_forbidden":
        known = _known(table_type, place[:-1])
        hint = f"; {nearest_names(str(place[-1]), known)}" if known else ""
        return f"{named(place[:-1]) or 'the job'}: unknown key (got {str(place[-1])!r}{hint})"
    if kind == "missing":
        return f"{named(place)} must be given"
    text = error["msg"].removeprefix("Value error, ").removeprefix("Input ")
    text = text[:1].lower() + text[1:]
    got = error["input"]
    got = f"a table of {', '.join(map(str, got))}" if isinstance(got, dict) else repr(got)[:80]
    return f"{named(place)}: {text} (got {got})"


def _known(table_type, place):
    """Keys of the table at a place, as far as the types tell."""
    for key in place:
        if isinstance(key, int) or not hasattr(table_type, "model_fields"):
            continue
        field = table_type.model_fields.get(key)
        inner = [] if field is None else [field.annotation, *getattr(field.annotation, "__args__", ())]
        found = [t for t in inner if isinstance(t, type) and issubclass(t, BaseModel)]
        table_type = found[0] if found else None
    return list(getattr(table_type, "model_fields", ()))


def made(kind, table: Mapping, where: str):
    """A dataclass that checks itself, from a table of its fields; errors say where."""
    keys = {
        field.name: field.default is MISSING and field.default_factory is MISSING for field in fields(kind)
    }
    for key in table:
        if key not in keys:
            raise Error(f"{where}: unknown key (got {key!r}; {nearest_names(key, keys)})")
    if missing := [key for key, needed in keys.items() if needed and key not in table]:
        raise Error(f"{where}: {' and '.join(missing)} must be given")
    try:
        return kind(**{key: tuple(v) if isinstance(v, list) else v for key, v in table.items()})
    except Error as why:
        raise Error(f"{where}: {why}") from None
    except TypeError as why:
        raise Error(f"{where}: must hold what {kind.__name__} takes ({why})") from None
