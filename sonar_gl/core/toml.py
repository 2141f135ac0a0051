"""Reading TOML files, with errors that name the file."""

from __future__ import annotations

from pathlib import Path

from sonar_gl.core.errors import Error
from sonar_gl.core.input_files import check_kind_of_file, read_error_text

try:
    import tomllib
except ModuleNotFoundError:  # Python 3.10
    import tomli as tomllib


def read_toml(path: Path, what: str) -> dict:
    """Return the contents of a TOML file.

    Parameters
    ----------
    path : file, in UTF-8, with or without the mark of byte order that editors on Windows put first
    what : what the file is, such as "the sonar's file"

    Raises
    ------
    Error
        if it is no file, cannot be read, or is not TOML.
    """
    check_kind_of_file(path, pipe=True)
    try:
        return tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except OSError as why:
        raise Error(f"{path}: {what} must be readable ({read_error_text(why)})") from None
    except ValueError as why:  # not TOML (the message names the line), or not UTF-8
        raise Error(f"{path}: {what} must be TOML ({why})") from None
