"""Reading TOML files, with errors that name the file."""

from __future__ import annotations

from pathlib import Path

from sonar_gl.core.errors import Error
from sonar_gl.core.input_files import check_kind_of_file, read_error_text

try:
    import tomllib
except ModuleNotFoundError:  # Python 3.10
    import tomli as tomllib

MAX_TOML_DEPTH = 32  # of tables and arrays, which the functions that take them apart may visit by recursion


def read_toml(path: Path, what: str, hint: str = "") -> dict:
    """Return the contents of a TOML file.

    Parameters
    ----------
    path : file, in UTF-8, with or without the mark of byte order that editors on Windows put first
    what : what the file is, such as "the sonar's file"
    hint : what to do instead, which ends the message about a file of another kind

    Raises
    ------
    Error
        if it is no file, cannot be read, is not TOML, or nests tables and arrays more than MAX_TOML_DEPTH deep.
    """
    check_kind_of_file(path, pipe=True)
    try:
        found = tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except OSError as why:
        raise Error(f"{path}: {what} must be readable ({read_error_text(why)})") from None
    except RecursionError:
        raise _nesting_error(path, what) from None
    except ValueError as why:  # not TOML (the message names the line), or not UTF-8
        raise Error(f"{path}: {what} must be TOML ({why}{hint and f'; {hint}'})") from None
    if _is_deep(found):
        raise _nesting_error(path, what)
    return found


def _is_deep(found: dict) -> bool:
    """Return whether there are tables or arrays more than MAX_TOML_DEPTH deep."""
    level = [found]
    for _ in range(MAX_TOML_DEPTH):
        inner = (value for one in level for value in (one.values() if isinstance(one, dict) else one))
        level = [value for value in inner if isinstance(value, (dict, list))]
    return bool(level)


def _nesting_error(path: Path, what: str) -> Error:
    return Error(f"{path}: {what} must nest tables and arrays at most {MAX_TOML_DEPTH} deep (got more)")
