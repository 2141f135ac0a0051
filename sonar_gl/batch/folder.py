"""The folder of a batch, on this machine or at any URL that fsspec supports. Files are written atomically."""

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

from sonar_gl.core.atomic_file import temporary_path
from sonar_gl.core.errors import Error

LOCK, UNFINISHED = ".lock", ".begun"  # the latter is a folder of files that are being written


@contextmanager
def _as_error(url: str):
    """Turn any exception into an Error that names the folder; each file system has exceptions of its own."""
    try:
        yield
    except Exception as why:
        reason = getattr(why, "strerror", None) or " ".join(str(why).split())
        raise Error(f"the folder {str(url)!r} must be writable ({reason})") from None


class Folder:
    """A folder at a path or URL.

    Parameters
    ----------
    url : path or URL
    create : create the folder if it does not exist

    Attributes
    ----------
    url : path or URL, for other libraries
    is_local : whether it is on this machine
    fs : file system of fsspec

    Raises
    ------
    Error
        if the folder cannot be reached or created, with the reason.
    """

    def __init__(self, url: str, create: bool = True):
        with _as_error(url):
            self.fs, self.root = url_to_fs(str(url))
        self.is_local = isinstance(self.fs, LocalFileSystem)
        self.url = self.root if self.is_local else str(url).rstrip("/")
        if create:
            self.create()

    def create(self) -> None:
        """Create the folder if it does not exist."""
        with _as_error(self.url):
            self.fs.makedirs(self.root, exist_ok=True)

    def path(self, name: str) -> str:
        """Return the path of a file in `fs`."""
        return f"{self.root}/{name}"

    @contextmanager
    def locked(self):
        """Keep other batches of this machine out of the folder during the block; an Error if one is in it."""
        if not self.is_local:
            yield
            return
        lock = Path(self.path(LOCK))
        with lock.open("w") as file:
            try:
                fcntl.flock(
                    file, fcntl.LOCK_EX | fcntl.LOCK_NB
                )  # released when the process ends, however it does
            except BlockingIOError:
                raise Error(
                    f"{self.root}: must have one batch at a time (another is running in it)"
                ) from None
            shutil.rmtree(self.path(UNFINISHED), ignore_errors=True)  # left by processes that were killed
            try:
                yield
            finally:
                shutil.rmtree(self.path(UNFINISHED), ignore_errors=True)
                lock.unlink(missing_ok=True)

    def open(self, name: str):
        """Open a file for reading bytes."""
        return self.fs.open(self.path(name), "rb")

    @contextmanager
    def writing(self, name: str):
        """Give the path of a local file to write, which becomes the file `name` at the end of the block."""
        target = PurePosixPath(self.path(name))
        if not self.is_local:  # object stores write atomically
            with tempfile.TemporaryDirectory() as folder:
                local = Path(folder, target.name)
                yield local
                self.fs.makedirs(str(target.parent), exist_ok=True)
                self.fs.put_file(str(local), str(target))
            return
        Path(target.parent).mkdir(parents=True, exist_ok=True)
        temporary = temporary_path(Path(self.path(UNFINISHED), target.name))
        temporary.parent.mkdir(exist_ok=True)
        try:
            yield temporary
            os.replace(temporary, target)
        finally:
            temporary.unlink(missing_ok=True)

    def put(self, name: str, data: bytes) -> None:
        """Write bytes to a file."""
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
        """Return the bytes of a file, or None if it does not exist."""
        try:
            return self.fs.cat_file(self.path(name))
        except FileNotFoundError:
            return None

    def get_json(self, name: str):
        """Return the values of a JSON file, or None if it does not exist."""
        data = self.get(name)
        try:
            return None if data is None else json.loads(data)
        except ValueError:
            raise Error(f"{self.path(name)}: must be JSON (it is damaged; delete it)") from None

    def names(self, folder: str) -> list[str]:
        """Return the sorted names of the files in a folder; none if it does not exist."""
        try:
            found = self.fs.ls(self.path(folder), detail=False)
        except FileNotFoundError:
            return []
        return sorted({PurePosixPath(name).name for name in found} - {LOCK})

    def remove(self, name: str) -> None:
        """Delete a file if it exists."""
        with suppress(FileNotFoundError):
            self.fs.rm_file(self.path(name))

    def checksum(self, name: str) -> str | None:
        """Return the SHA-256 of a file in hexadecimal digits, or None if it does not exist."""
        found = hashlib.sha256()
        try:
            with self.fs.open(self.path(name), "rb") as file:
                while block := file.read(1 << 20):
                    found.update(block)
        except FileNotFoundError:
            return None
        return found.hexdigest()
