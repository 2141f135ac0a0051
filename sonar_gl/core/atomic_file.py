"""Atomic writing of files: to a temporary name in the same folder, then renamed."""

from __future__ import annotations

import os
import uuid
from contextlib import contextmanager
from pathlib import Path

from sonar_gl.core.errors import Error
from sonar_gl.core.input_files import LINK_LOOP, describe_kind, is_link_loop, read_error_text


def temporary_path(path: Path) -> Path:
    """Return a unique path in the same folder, so that renaming it to `path` never crosses file systems."""
    stem = path.stem[:64]
    while len(os.fsencode(stem)) > 64:  # a name may have 255 bytes, and a letter has up to four
        stem = stem[:-1]
    return path.with_name(f".{stem}.{uuid.uuid4().hex[:12]}{path.suffix}")


def describe_os_error(why: OSError, folder: Path) -> str:
    """Return why a file in this folder could not be written or read, for an error message."""
    at_fault = next((str(p) for p in (folder, *folder.parents) if p.exists() and not p.is_dir()), None)
    if isinstance(why, (NotADirectoryError, FileExistsError)) and at_fault:
        return f"{at_fault!r} is not a folder"
    link = next((p for p in (folder, *folder.parents) if p.is_symlink() and not p.exists()), None)
    if isinstance(why, FileExistsError) and link is not None:  # the system says "file exists" of it
        if is_link_loop(link):
            return LINK_LOOP
        return f"{str(link)!r} is a link to {os.readlink(link)!r}, which does not exist"
    return read_error_text(why)


def check_output_file(path: Path) -> None:
    """Raise an `Error` unless a file can be written at a path; for work that takes long before it writes."""
    with _writing(path):
        write_trial(path)


def write_trial(path: Path) -> None:
    """Write a trial file beside a path, and remove it."""
    trial = temporary_path(path)
    try:
        trial.write_bytes(b"sonar")
    finally:
        trial.unlink(missing_ok=True)


def check_output_folder(path: Path) -> None:
    """Raise an `Error` unless files can be written into a folder, or it can be made. It is not made."""
    nearest = next(one for one in (path, *path.parents) if os.path.lexists(one) or one == one.parent)
    if not nearest.is_dir():
        why = f"{str(nearest)!r} is not a folder"
    elif not os.access(nearest, os.W_OK | os.X_OK):
        why = "permission denied"
    else:
        return
    raise Error(f"cannot write into the folder {str(path)!r}: {why}")


@contextmanager
def _writing(path: Path):
    """Have the errors of a block that writes a file be an `Error`; refuse a path that can be none at once."""
    if not path.parent.is_dir():
        what = "is not a folder" if path.parent.exists() else "does not exist"
        raise Error(f"cannot write {str(path)!r}: the folder {str(path.parent)!r} {what}")
    if _leads_to_open_file(path):  # as /dev/stdout does: renaming would replace the link
        raise Error(
            f"cannot write {str(path)!r}: must be the name of a file (got that of an output of the process)"
        )
    if path.exists() and not path.is_file():  # renaming would replace a pipe, or /dev/null
        got = describe_kind(path.stat().st_mode)
        raise Error(f"cannot write {str(path)!r}: must be the name of a file (got {got})")
    try:
        yield
    except OSError as why:
        raise Error(f"cannot write {str(path)!r}: {describe_os_error(why, path.parent)}") from None


def _leads_to_open_file(path: Path) -> bool:
    """Return whether a path is a link to what a process has open, in /proc."""
    for _ in range(40):  # links to links, as many as Linux follows
        if not os.path.islink(path):
            return False
        path = Path(os.path.join(path.parent, os.readlink(path)))
        if path.parts[:2] == ("/", "proc"):
            return True
    return False


@contextmanager
def atomic_write(path: Path):
    """Yield a temporary path to write to; the block's end renames it to `path`, an exception removes it.

    Raises Error if the folder does not exist, something else than a file is there, or the file cannot be written.
    """
    with _writing(path):
        temporary = temporary_path(path)
        try:
            yield temporary
            os.replace(temporary, path)
        finally:
            temporary.unlink(missing_ok=True)
