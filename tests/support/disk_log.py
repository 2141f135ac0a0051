"""A log of what a batch does to its folder, from which the folder is put together as a power failure leaves it.

At each rename and each flush the folder is read. What was flushed is on the disk: after `sync_file_system`
everything, after `sync` the content of a file or the names in a folder. Of the rest any part may be: each name
as it was on the disk or as it is now, and a file whose content was not flushed whole, in half, or empty.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from random import Random

from sonar_gl.batch import folder as folder_module

Contents = tuple[bytes, ...]  # what may be left of a file, the whole first


@dataclass(frozen=True)
class Moment:
    """A moment of the log.

    Attributes
    ----------
    event : what has just happened
    now, kept : path -> what may be left of the file that has this name now, and on the disk
    """

    event: str
    now: dict[str, Contents]
    kept: dict[str, Contents]

    def left(self, name: Callable, content: Callable) -> dict[str, bytes]:
        """Return the files that a power failure leaves.

        Parameters
        ----------
        name : function (contents on the disk, contents now) -> one of them; None is no file of this name
        content : function (contents) -> one of them
        """
        files = {
            path: name((self.kept.get(path), self.now.get(path))) for path in sorted({*self.now, *self.kept})
        }
        return {path: content(contents) for path, contents in files.items() if contents is not None}

    def remains(self, seed: int) -> Iterator[dict[str, bytes]]:
        """Yield what power failures may leave: a random mixture, what was flushed, everything, names alone."""

        def kept(pair):
            return pair[0]

        def now(pair):
            return pair[1]

        def whole(contents):
            return contents[0]

        def empty(contents):
            return contents[-1]

        at_random = Random(seed).choice
        for name, content in ((at_random, at_random), (kept, empty), (now, whole), (now, empty)):
            yield self.left(name, content)


class DiskLog:
    """Records moments, in place of the functions that rename and flush.

    Parameters
    ----------
    folder : folder of the batch, whose files are on the disk
    monkeypatch : of pytest
    """

    def __init__(self, folder: Path, monkeypatch):
        self.folder, self.moments, self._lock = folder, [], threading.Lock()
        self._flushed, self._real_replace = set(self._read().values()), os.replace
        self._kept = self._possible()
        self._note("begin")
        monkeypatch.setattr(os, "replace", self.replace)
        monkeypatch.setattr(folder_module, "sync_file_system", self.sync_file_system)
        monkeypatch.setattr(folder_module, "sync", self.sync)

    def replace(self, source, target, **more):
        """Rename a file."""
        with self._lock:
            self._real_replace(source, target, **more)
            self._note(f"rename to {Path(target).name}")

    def sync_file_system(self, _path):
        """Flush everything."""
        with self._lock:
            self._note("begin of syncfs")
            self._flushed |= set(self._read().values())
            self._kept = self._possible()
            self._note("syncfs")

    def sync(self, path):
        """Flush the content of a file, or the names in a folder."""
        with self._lock:
            path = Path(path).relative_to(self.folder)
            self._note(f"begin of fsync of {path}")
            if (self.folder / path).is_dir():
                inside = {name: file for name, file in self._possible().items() if Path(name).parent == path}
                outside = {name: file for name, file in self._kept.items() if Path(name).parent != path}
                self._kept = inside | outside
            else:
                self._flushed.add(self._read()[str(path)])
            self._note(f"fsync of {path}")

    def _read(self) -> dict[str, tuple[int, bytes]]:
        """Return path -> inode and content of the files that are there."""
        out = {}
        for place, _, names in os.walk(self.folder):
            for path in (Path(place, name) for name in names):
                try:
                    out[str(path.relative_to(self.folder))] = path.stat().st_ino, path.read_bytes()
                except FileNotFoundError:  # a thread of Zarr's has deleted it
                    continue
        return out

    def _possible(self) -> dict[str, Contents]:
        """Return path -> what may be left of the file that has this name now."""
        return {
            path: (file[1],) if file in self._flushed else (file[1], file[1][: len(file[1]) // 2], b"")
            for path, file in self._read().items()
        }

    def _note(self, event: str) -> None:
        self.moments.append(Moment(event, self._possible(), dict(self._kept)))
