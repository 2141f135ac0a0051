"""Builds a source archive of the same bytes whenever and wherever the same files are built; setup.cfg has the rest."""

import gzip
import os
import tarfile
from pathlib import Path

from setuptools import setup
from setuptools.command.sdist import sdist

# of all files, also in wheels: that of the commit if it is given, else 1980, the first that a wheel can hold
TIME_S = int(os.environ.setdefault("SOURCE_DATE_EPOCH", "315532800"))


def _alike(entry: tarfile.TarInfo) -> tarfile.TarInfo:
    """Leave out of an archive when, by whom and with which umask its files were made."""
    entry.mtime, entry.uid, entry.gid, entry.uname, entry.gname = TIME_S, 0, 0, "", ""
    entry.mode = 0o755 if entry.isdir() or entry.mode & 0o100 else 0o644
    return entry


class SourceArchive(sdist):
    """The command `sdist`."""

    def make_archive(self, base_name, format, root_dir=None, base_dir=None, owner=None, group=None):
        """Write the archive of a folder, and return its path."""
        path = Path(f"{base_name}.tar.gz")
        with (
            path.open("wb") as file,
            gzip.GzipFile("", "wb", fileobj=file, mtime=TIME_S) as zipped,
            tarfile.open(fileobj=zipped, mode="w", format=tarfile.PAX_FORMAT) as archive,
        ):
            archive.add(base_dir, filter=_alike)  # in the order of names
        return str(path)


setup(cmdclass={"sdist": SourceArchive})
