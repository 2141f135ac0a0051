"""Reading TOML files, with errors that name the file, and writing TOML."""

from __future__ import annotations

import json
from pathlib import Path

from sonar_gl.core.checks import shown
from sonar_gl.core.errors import Error
from sonar_gl.core.input_files import check_kind_of_file, is_utf_16, read_error_text

try:
    import tomllib
except ModuleNotFoundError:  # Python 3.10
    import tomli as tomllib

MAX_TOML_DEPTH = 32  # of tables and arrays, which the functions that take them apart may visit by recursion


def read_toml(path: Path, what: str, hint: str = "") -> dict:
    """Return the contents of a TOML file.

    Raises Error if it is no file, cannot be read, is not TOML, or nests tables and arrays more than MAX_TOML_DEPTH
    deep.

    path : file, in UTF-8, with or without the mark of byte order that editors on Windows put first
    what : what the file is, such as "the sonar's file"
    hint : what to do instead, which ends the message about a file of another kind
    """
    check_kind_of_file(path, pipe=True)
    other = None  # than UTF-8
    try:
        text = path.read_text(encoding="utf-8-sig")
        if is_utf_16(
            text[:2].encode()
        ):  # without a mark of byte order and of ASCII alone, it passes for UTF-8
            other = "UTF-16"
    except OSError as why:
        raise Error(f"{path}: {what} must be readable ({read_error_text(why)})") from None
    except UnicodeDecodeError as why:
        line = why.object.count(b"\n", 0, why.start) + 1
        place = f"byte 0x{why.object[why.start]:02x} in line {line}"
        other = "UTF-16" if is_utf_16(why.object) else place
    if other is not None:
        raise Error(f"{path}: {what} must be TOML in UTF-8 (got {other}; {hint or 'save it as UTF-8'})")
    try:
        found = tomllib.loads(text)
        is_deep = _is_deep(found)
    except RecursionError:
        is_deep = True
    except ValueError as why:  # the message names the line
        raise Error(f"{path}: {what} must be TOML ({why}{hint and f'; {hint}'})") from None
    if is_deep:
        raise Error(f"{path}: {what} must nest tables and arrays at most {MAX_TOML_DEPTH} deep (got more)")
    return found


def toml_text(table: dict) -> str:
    """Return a line `key = value` for each value of a table; those that are None are left out, as TOML has no null.

    table : of numbers, texts, truth values, lists, and tables of such, by bare keys; raises Error for a text that
        UTF-8 cannot hold

    >>> print(toml_text({"name": "a", "rate_hz": 9e5, "depth_m": None, "counts": {"law": "db", "bits": 8}}), end="")
    name = "a"
    rate_hz = 900000.0
    counts = { law = "db", bits = 8 }
    """
    for key, value in table.items():
        if isinstance(value, str) and any("\ud800" <= letter <= "\udfff" for letter in value):
            raise Error(
                f"{key} must be text that a file can hold (got {shown(value)}, with half of a letter)"
            )
    return "".join(f"{key} = {value_text(value)}\n" for key, value in table.items() if value is not None)


def value_text(value) -> str:
    """Return a value as TOML."""
    if isinstance(value, dict):
        items = [f"{key} = {value_text(one)}" for key, one in value.items() if one is not None]
        return f"{{ {', '.join(items)} }}"
    # numbers, texts, lists and truth values are those of JSON, but that TOML has no bare DEL
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")


def _is_deep(found: dict) -> bool:
    """Return whether there are tables or arrays more than MAX_TOML_DEPTH deep."""
    level = [found]
    for _ in range(MAX_TOML_DEPTH):
        inner = (value for one in level for value in (one.values() if isinstance(one, dict) else one))
        level = [value for value in inner if isinstance(value, (dict, list))]
    return bool(level)
