"""The manifest of a batch, fixed before its first ping; the records of finished parts; the check of both."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass

from sonar_gl._version import __version__
from sonar_gl.batch.folder import Folder
from sonar_gl.core.errors import Error

MANIFEST_NAME = "planned.json"
DONE_NAME = "done.json"  # written last: the batch is complete
PART_BYTES = 128e6  # of a part's arrays before compression
CHUNK_PINGS = 8  # packed together in the store; a part holds a whole number of chunks
MAX_PART_PINGS = 128  # limits what is lost, or made again, with a part


def record_name(part: int) -> str:
    """Return the name of the file that says that a part is done."""
    return f"parts/{part:07d}.json"


def table_name(part: int) -> str:
    """Return the name of the file with a part's rows of the ping table."""
    return f"parts/{part:07d}.npy"


@dataclass(frozen=True)
class Manifest:
    """The sampling of each scene and sonar, and the division of pings into parts. It follows from the job.

    Attributes
    ----------
    job : the job as plain values
    digest : that of `Schema`
    n_pings, pings_per_part : number of pings in all and of each part but the last
    samplings : for each scene, sonar -> fields of `Sampling`
    estimates : for each scene, sonar -> estimated error of its pings
    version : version of sonar_gl that planned the batch
    gl_renderer : OpenGL renderer that planned it
    """

    job: dict
    digest: str
    n_pings: int
    pings_per_part: int
    samplings: list
    estimates: list
    version: str = __version__
    gl_renderer: str = ""

    @property
    def n_parts(self) -> int:
        return -(-self.n_pings // self.pings_per_part)

    def numbers(self, part: int) -> range:
        """Return the numbers of a part's pings."""
        first = part * self.pings_per_part
        return range(first, min(first + self.pings_per_part, self.n_pings))

    def save(self, folder: Folder) -> None:
        """Write the manifest to the folder of the batch."""
        folder.put_json(MANIFEST_NAME, asdict(self))

    @classmethod
    def load(cls, folder: Folder) -> Manifest | None:
        """Read the manifest of a folder; None if there is none.

        Raises
        ------
        Error
            if it is invalid, or was written by another version, whose pings may differ.
        """
        found = folder.get_json(MANIFEST_NAME)
        if found is None:
            return None
        try:
            manifest = cls(**found)
        except TypeError as why:
            raise Error(f"{folder.path(MANIFEST_NAME)}: must be the manifest of a batch ({why})") from None
        if manifest.version != __version__:
            raise Error(
                f"{folder.path(MANIFEST_NAME)}: a batch must be finished by the version that began it (got "
                f"{manifest.version}, this is {__version__}; use that version, or another folder)"
            )
        return manifest


def default_pings_per_part(bytes_per_ping: float) -> int:
    """Return a part size large enough for a file and small enough to be made again."""
    chunks = int(PART_BYTES / bytes_per_ping) // CHUNK_PINGS
    return max(CHUNK_PINGS, min(MAX_PART_PINGS, chunks * CHUNK_PINGS))


@dataclass(frozen=True)
class PartRecord:
    """What a finished part consists of. Its file is written after all others of the part.

    Attributes
    ----------
    part : number of the part
    first, pings : number of its first ping, and of its pings
    set_aside : number of each ping that could not be made (as text, for JSON) -> why
    without_echo : number of pings without an echo
    files : name of each file of the part -> SHA-256, None for an array of which nothing is stored
    """

    part: int
    first: int
    pings: int
    set_aside: dict[str, str]
    without_echo: int
    files: dict[str, str | None]

    def save(self, folder: Folder) -> None:
        """Write the record to the folder of the batch."""
        folder.put_json(record_name(self.part), asdict(self))

    @classmethod
    def load(cls, folder: Folder, part: int) -> PartRecord | None:
        """Read the record of a part, or None if the part is not done; an Error if the record is damaged."""
        found = folder.get_json(record_name(part))
        try:
            return None if found is None else cls(**found)
        except TypeError:
            raise Error(
                f"{folder.path(record_name(part))}: must be the record of a part (it is damaged; delete it)"
            ) from None


def part_records(folder: Folder, manifest: Manifest) -> Iterator[PartRecord]:
    """Yield the records of the parts that are done."""
    existing = set(folder.names("parts"))
    for part in range(manifest.n_parts):
        if record_name(part).partition("/")[2] in existing:
            yield PartRecord.load(folder, part)


def check(folder: Folder, manifest: Manifest, progress: Callable) -> list[str]:
    """Compare all files of a batch with their checksums.

    Parameters
    ----------
    progress : function that turns the range of parts into a context manager of an iterable of them

    Returns
    -------
    list of str, one line for each file that is missing or changed; for a batch that is not complete, a line
    that says so
    """
    faults = []
    done = folder.get_json(DONE_NAME)
    if done is None:
        faults.append(
            f"{folder.path(DONE_NAME)}: is missing: the batch is not complete; --resume continues it"
        )
    with progress(range(manifest.n_parts)) as parts:
        for part in parts:
            record = PartRecord.load(folder, part)
            if record is not None:
                faults += _faults(folder, record.files)
            elif done is not None:
                faults.append(f"{folder.path(record_name(part))}: is missing")
    return [*faults, *(_faults(folder, done["files"]) if done else ())]


def discard_damaged(folder: Folder, manifest: Manifest, report: Callable[[str], None]) -> None:
    """Delete the records of parts with missing or changed files, so that the parts are made again.

    Parameters
    ----------
    report : function that is given a line for each such file
    """
    is_damaged, done = False, folder.get_json(DONE_NAME)
    for part in range(manifest.n_parts):
        record = PartRecord.load(folder, part)
        for line in _faults(folder, record.files) if record else ():
            report(line)
            folder.remove(record_name(part))
            is_damaged = True
    for name, checksum in (done["files"] if done else {}).items():
        if folder.checksum(name) != checksum:
            report(f"{folder.path(name)}: has changed since it was written")
            folder.remove(name)
            is_damaged = True
    if is_damaged:
        folder.remove(DONE_NAME)


def _faults(folder: Folder, files: dict) -> Iterator[str]:
    """Yield a line for each file that is missing or changed."""
    for name, expected in files.items():
        found = folder.checksum(name)
        if found != expected:
            fault = "is missing" if found is None else "has changed since it was written"
            yield f"{folder.path(name)}: {fault}"
