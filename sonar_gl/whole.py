"""Files that appear whole or not at all: written beside their place and renamed."""

from __future__ import annotations

import os
import uuid
from contextlib import contextmanager
from pathlib import Path

from sonar_gl.types import Error


def name_beside(path: Path) -> Path:
    """A name in the same folder, so that the renaming never crosses file systems."""
    return path.with_name(f".{path.stem[:64]}.{uuid.uuid4().hex[:12]}{path.suffix}")


def reason(why: OSError, folder: Path) -> str:
    """Why a file could not be written into a folder, or read there."""
    at_fault = next((str(p) for p in (folder, *folder.parents) if p.exists() and not p.is_dir()), None)
    if isinstance(why, (NotADirectoryError, FileExistsError)) and at_fault:
        return f"{at_fault!r} is not a folder"
    return (why.strerror or str(why)).lower()


@contextmanager
def replacing(path: Path):
    """Name to write to; becomes `path` at the end, or goes without a trace if the writing fails."""
    if not path.parent.is_dir():
        what = "is not a folder" if path.parent.exists() else "does not exist"
        raise Error(f"cannot write {str(path)!r}: the folder {str(path.parent)!r} {what}")
    beside = name_beside(path)
    try:
        yield beside
        os.replace(beside, path)
    except OSError as why:
        raise Error(f"cannot write {str(path)!r}: {reason(why, path.parent)}") from None
    finally:
        beside.unlink(missing_ok=True)
