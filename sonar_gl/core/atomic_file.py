"""Atomic writing of files: to a temporary name in the same folder, then renamed."""

from __future__ import annotations

import os
import uuid
from contextlib import contextmanager
from pathlib import Path

from sonar_gl.core.errors import Error
from sonar_gl.core.input_files import read_error_text


def temporary_path(path: Path) -> Path:
    """Return a unique path in the same folder, so that renaming it to `path` never crosses file systems."""
    return path.with_name(f".{path.stem[:64]}.{uuid.uuid4().hex[:12]}{path.suffix}")


def describe_os_error(why: OSError, folder: Path) -> str:
    """Return why a file in this folder could not be written or read, for an error message."""
    at_fault = next((str(p) for p in (folder, *folder.parents) if p.exists() and not p.is_dir()), None)
    if isinstance(why, (NotADirectoryError, FileExistsError)) and at_fault:
        return f"{at_fault!r} is not a folder"
    return read_error_text(why)


@contextmanager
def atomic_write(path: Path):
    """Yield a temporary path to write to; the block's end renames it to `path`, an exception removes it.

    Raises
    ------
    Error
        if the folder does not exist, or the file cannot be written.
    """
    if not path.parent.is_dir():
        what = "is not a folder" if path.parent.exists() else "does not exist"
        raise Error(f"cannot write {str(path)!r}: the folder {str(path.parent)!r} {what}")
    temporary = temporary_path(path)
    try:
        yield temporary
        os.replace(temporary, path)
    except OSError as why:
        raise Error(f"cannot write {str(path)!r}: {describe_os_error(why, path.parent)}") from None
    finally:
        temporary.unlink(missing_ok=True)
