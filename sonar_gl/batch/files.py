"""A folder of results, here or at any URL that fsspec knows; files appear in it whole or not at all."""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import shutil
import tempfile
from contextlib import contextmanager, suppress
from pathlib import Path, PurePosixPath

from fsspec.core import url_to_fs
from fsspec.implementations.local import LocalFileSystem

from sonar_gl.types import Error
from sonar_gl.whole import name_beside

LOCK, BEGUN = ".lock", ".begun"  # the latter a folder of files that are being written


class Folder:
    """A folder at a path or URL.

    Parameters
    ----------
    make : make it if it is not there

    Raises
    ------
    Error
        if it cannot be reached or written to, with the reason.
    """

    def __init__(self, url: str, make: bool = True):
        try:
            self.fs, self.root = url_to_fs(str(url))
            self.is_local = isinstance(self.fs, LocalFileSystem)
            if make:
                self.fs.makedirs(self.root, exist_ok=True)
        except Exception as why:  # of as many kinds as there are file systems
            reason = getattr(why, "strerror", None) or " ".join(str(why).split())
            raise Error(f"the folder {str(url)!r} must be one that can be written to ({reason})") from None
        self.url = self.root if self.is_local else str(url).rstrip("/")

    def path(self, name: str) -> str:
        """Where a file is, for `fs`."""
        return f"{self.root}/{name}"

    @contextmanager
    def locked(self):
        """Nobody else's for the time of the block, on this machine; an Error if it is somebody's."""
        if not self.is_local:
            yield
            return
        place = Path(self.path(LOCK))
        with place.open("w") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)  # the kernel's, so it ends with the process
            except BlockingIOError:
                text = "must be one batch's at a time (another is at work there)"
                raise Error(f"{self.root}: {text}") from None
            shutil.rmtree(self.path(BEGUN), ignore_errors=True)  # of processes that were killed
            try:
                yield
            finally:
                shutil.rmtree(self.path(BEGUN), ignore_errors=True)
                place.unlink(missing_ok=True)

    def open(self, name: str):
        """A file, to read its bytes."""
        return self.fs.open(self.path(name), "rb")

    @contextmanager
    def writing(self, name: str):
        """Path of a file here to write, which becomes the file `name` at the end of the block."""
        place = PurePosixPath(self.path(name))
        if not self.is_local:  # an object is put there whole or not at all
            with tempfile.TemporaryDirectory() as here:
                yield Path(here, place.name)
                self.fs.makedirs(str(place.parent), exist_ok=True)
                self.fs.put_file(str(Path(here, place.name)), str(place))
            return
        Path(place.parent).mkdir(parents=True, exist_ok=True)
        beside = name_beside(Path(self.path(BEGUN), place.name))
        beside.parent.mkdir(exist_ok=True)
        try:
            yield beside
            os.replace(beside, place)
        finally:
            beside.unlink(missing_ok=True)

    def put(self, name: str, data: bytes) -> None:
        """Write a file."""
        if self.is_local:
            with self.writing(name) as path:
                path.write_bytes(data)
        else:
            self.fs.makedirs(str(PurePosixPath(self.path(name)).parent), exist_ok=True)
            self.fs.pipe_file(self.path(name), data)

    def put_json(self, name: str, value) -> None:
        """Write plain values as JSON; the same values give the same bytes."""
        self.put(name, (json.dumps(value, indent=1, sort_keys=True, ensure_ascii=False) + "\n").encode())

    def get(self, name: str) -> bytes | None:
        """What is in a file, or None if it is not there."""
        try:
            return self.fs.cat_file(self.path(name))
        except FileNotFoundError:
            return None

    def get_json(self, name: str):
        """The plain values of a JSON file, or None if it is not there."""
        data = self.get(name)
        try:
            return None if data is None else json.loads(data)
        except ValueError:
            raise Error(f"{self.path(name)}: must be JSON (it is damaged; delete it)") from None

    def names(self, folder: str) -> list[str]:
        """Files of a folder in it, sorted; none if there is no such folder."""
        try:
            found = self.fs.ls(self.path(folder), detail=False)
        except FileNotFoundError:
            return []
        return sorted({PurePosixPath(name).name for name in found} - {LOCK})

    def forget(self, name: str) -> None:
        """Take a file away, if it is there."""
        with suppress(FileNotFoundError):
            self.fs.rm_file(self.path(name))

    def checksum(self, name: str) -> str | None:
        """SHA-256 of a file as hexadecimal digits, or None if it is not there."""
        found = hashlib.sha256()
        try:
            with self.fs.open(self.path(name), "rb") as file:
                while block := file.read(1 << 20):
                    found.update(block)
        except FileNotFoundError:
            return None
        return found.hexdigest()
