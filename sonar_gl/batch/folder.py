"""The folder of a batch, on this machine or at any URL that fsspec supports. Files are written atomically.

Records say that other files are complete. They have a checksum of their own, and reach the disk after all that
was written before them, so that they are true after a power failure, too.
"""

from __future__ import annotations

import ctypes
import errno
import hashlib
import json
import os
import shutil
import stat
import tempfile
from contextlib import contextmanager, suppress
from pathlib import Path, PurePosixPath

from fsspec.core import url_to_fs
from fsspec.implementations.local import LocalFileSystem

from sonar_gl.core.atomic_file import temporary_path
from sonar_gl.core.errors import Error
from sonar_gl.core.input_files import describe_kind
from sonar_gl.core.warn import warn_caller

try:
    import fcntl
except ImportError:  # on Windows
    fcntl = None
    import msvcrt

LOCK, UNFINISHED = ".lock", ".begun"  # the latter is a folder of files that are being written
# of file systems that lock no files, as Lustre may be mounted
NO_LOCKS = errno.ENOSYS, errno.ENOLCK, errno.EOPNOTSUPP
CHECKSUM_KEY = "sha256"  # of a record: that of its other keys


class DamagedRecordError(Error):
    """A record of a batch is not as it was written."""


def sync_file_system(path: str) -> None:
    """Write all that waits in memory for the file system of a folder to its disk."""
    try:
        syncfs = ctypes.CDLL(None, use_errno=True).syncfs
    except (OSError, AttributeError, TypeError):  # another C library; TypeError: of Windows
        if hasattr(os, "sync"):  # Windows flushes single files alone
            os.sync()
        return
    with _descriptor(path) as descriptor:
        if syncfs(descriptor):
            code = ctypes.get_errno()
            raise OSError(code, os.strerror(code), path)


def sync(path: str) -> None:
    """Write a file, or the names in a folder, to the disk."""
    if fcntl is None and os.path.isdir(path):  # Windows cannot
        return
    with _descriptor(path) as descriptor:
        try:
            os.fsync(descriptor)
        except OSError as why:
            if why.errno != errno.EINVAL:  # some network file systems cannot do this for a folder
                raise


@contextmanager
def _descriptor(path: str):
    # Windows flushes what is open for writing
    descriptor = os.open(path, os.O_RDONLY if fcntl else os.O_RDWR)
    try:
        yield descriptor
    finally:
        os.close(descriptor)


def _lock(descriptor: int) -> None:
    """Lock a file; raise a BlockingIOError, or a PermissionError on Windows, if another process has locked it."""
    if fcntl is not None:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    else:
        msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)


def record_bytes(values: dict) -> bytes:
    """Return the bytes of a record: plain values and their checksum as JSON."""
    checksum = hashlib.sha256(_json_bytes(values)).hexdigest()
    return _json_bytes(values | {CHECKSUM_KEY: checksum})


def _json_bytes(value) -> bytes:
    return (json.dumps(value, indent=1, sort_keys=True, ensure_ascii=False) + "\n").encode(
        errors="backslashreplace"
    )


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

    Raises Error if it is no folder, or cannot be reached or created, with the reason.

    fs : file system of fsspec
    """

    def __init__(self, url: str, create: bool = True):
        with _as_error(url):
            self.fs, self.root = url_to_fs(str(url))
        self.is_local = isinstance(self.fs, LocalFileSystem)
        self.url = self.root if self.is_local else str(url).rstrip("/")
        if self.is_local and os.path.exists(self.root) and not os.path.isdir(self.root):
            mode = os.stat(self.root).st_mode
            got = "a file" if stat.S_ISREG(mode) else describe_kind(mode)
            raise Error(f"{self.root}: the place of a batch must be a folder (got {got})")
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
        """Keep other batches of this machine out of the folder during the block; an Error if one is in it.

        Warns where the file system has no locks: two batches disturb each other there, but finished parts stay as they
        are. The file of the lock stays: who has opened it meanwhile would otherwise lock a file that has gone.
        """
        if not self.is_local:
            yield
            return
        with Path(self.path(LOCK)).open("wb") as file:
            try:
                _lock(file.fileno())  # released when the process ends, however it does
            except (BlockingIOError, PermissionError):
                raise Error(
                    f"{self.root}: must have one batch at a time (another is running in it)"
                ) from None
            except OSError as why:
                if why.errno not in NO_LOCKS:
                    raise
                warn_caller(
                    f"{self.root}: must be on a file system with locks for a second batch to be kept out (got "
                    f"{why.strerror.lower()}; run one at a time)"
                )
            shutil.rmtree(self.path(UNFINISHED), ignore_errors=True)  # left by processes that were killed
            try:
                yield
            finally:
                shutil.rmtree(self.path(UNFINISHED), ignore_errors=True)

    def open(self, name: str):
        """Open a file for reading bytes."""
        return self.fs.open(self.path(name), "rb")

    @contextmanager
    def writing(self, name: str, is_record: bool = False):
        """Give the path of a local file to write, which becomes the file `name` at the end of the block.

        is_record : all that was written before is on the disk before it, and itself at the end of the block
        """
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
            if is_record:
                sync(str(temporary))
                sync_file_system(self.root)
            os.replace(temporary, target)
            if is_record:
                sync(str(target.parent))
        finally:
            temporary.unlink(missing_ok=True)

    def put(self, name: str, data: bytes, is_record: bool = False) -> None:
        """Write bytes to a file; is_record : as for `writing`."""
        with self.writing(name, is_record) as path:
            path.write_bytes(data)

    def put_record(self, name: str, values: dict) -> None:
        """Write plain values as a record; the same values give the same bytes."""
        self.put(name, record_bytes(values), is_record=True)

    def get_record(self, name: str, cure: str) -> dict | None:
        """Return the values of a record, or None if it does not exist.

        Raises DamagedRecordError if it is not as it was written; the message ends with the cure.
        """
        if (data := self.get(name)) is None:
            return None
        with suppress(ValueError, TypeError, AttributeError, KeyError):  # no JSON, no object, no checksum
            values = json.loads(data)
            values.pop(CHECKSUM_KEY)
            if record_bytes(values) == data:
                return values
        raise DamagedRecordError(f"{self.path(name)}: must be as it was written (it is damaged; {cure})")

    def remove_record(self, name: str) -> None:
        """Delete a record if it exists, on the disk, too, before what it says is changed."""
        self.remove(name)
        if self.is_local:
            sync(str(PurePosixPath(self.path(name)).parent))

    def put_json(self, name: str, value) -> None:
        """Write plain values as JSON; the same values give the same bytes."""
        self.put(name, _json_bytes(value))

    def get(self, name: str) -> bytes | None:
        """Return the bytes of a file, or None if it does not exist."""
        try:
            return self.fs.cat_file(self.path(name))
        except FileNotFoundError:
            return None

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
