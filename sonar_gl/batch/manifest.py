"""The manifest of a batch, fixed before its first ping; the records of finished parts; the check of both."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from functools import cached_property
from itertools import chain
from pathlib import PurePosixPath

from sonar_gl._version import __version__
from sonar_gl.batch.folder import DamagedRecordError, Folder
from sonar_gl.batch.system import System
from sonar_gl.core.errors import Error

MANIFEST_NAME = "batch.json"
OLD_MANIFEST_NAME = "planned.json"  # of versions that chose the samples of a batch before its first ping
DONE_NAME = "done.json"  # written last: the batch is complete
PART_BYTES = 128e6  # of a part's arrays before compression
CHUNK_PINGS = 8  # packed together in the store; a part holds a whole number of chunks
MAX_PART_PINGS = 128  # limits what is lost, or made again, with a part
SMALL_JOB_PARTS = 64  # of a small job, or more, if each can hold a chunk: processes share it by parts
RECORD_CURE = "delete it, or mend the batch by --resume --mend"
MANIFEST_CURE = (
    "restore a copy, or have --resume --mend write it again; if no part is done, delete the folder"
)


def record_name(part: int) -> str:
    """Return the name of the file that says that a part is done."""
    return f"parts/{part:07d}.json"


def table_name(part: int) -> str:
    """Return the name of the file with a part's rows of the ping table."""
    return f"parts/{part:07d}.npy"


@dataclass(frozen=True)
class Manifest:
    """The division of a job's pings into parts, and what makes them. It follows from the job and the system.

    digest : that of `JobScenes`
    n_pings, pings_per_part : number of pings in all and of each part but the last
    system : OpenGL and libraries that began the batch
    files : those of `JobScenes`, by which a changed file is named
    processor : kind of the processor that began it; parts may be made by others
    """

    job: dict
    digest: str
    n_pings: int
    pings_per_part: int
    system: System
    files: dict[str, str]
    version: str = __version__
    processor: str = ""

    @property
    def n_parts(self) -> int:
        return -(-self.n_pings // self.pings_per_part)

    @cached_property
    def identity(self) -> str:
        """SHA-256 of all that decides the parts, by which records say of which batch they are.

        Job and files are in it by the digest, which does not depend on where they are.
        """
        left_out = "job", "files", "processor"
        values = {key: value for key, value in asdict(self).items() if key not in left_out}
        return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()

    def changed_files(self, files: dict[str, str]) -> list[str]:
        """Return the names of files that are others now: that have changed; if none has, that are new or gone.

        files : those of `JobScenes` of now
        """
        both, either = {*self.files} & {*files}, {*self.files} ^ {*files}
        changed = [name for name in sorted(both) if self.files[name] != files[name]]
        return changed or sorted(either)

    def numbers(self, part: int) -> range:
        """Return the numbers of a part's pings."""
        first = part * self.pings_per_part
        return range(first, min(first + self.pings_per_part, self.n_pings))

    def save(self, folder: Folder) -> None:
        """Write the manifest to the folder of the batch."""
        folder.put_record(MANIFEST_NAME, asdict(self))

    @classmethod
    def load(cls, folder: Folder) -> Manifest | None:
        """Read the manifest of a folder; None if there is none.

        Raises DamagedRecordError if it is not as it was written; Error if it, or the folder, was written by another
        version, whose pings may differ.
        """
        found = folder.get_record(MANIFEST_NAME, MANIFEST_CURE)
        if found is None and folder.get(OLD_MANIFEST_NAME) is not None:
            raise Error(
                f"{folder.path(OLD_MANIFEST_NAME)}: a batch must be finished by the version that began it (got one "
                "whose samples were chosen before its first ping, as this version no longer does; use that version, "
                "or another folder)"
            )
        if found is None:
            return None
        if found.get("version") != __version__:
            raise Error(
                f"{folder.path(MANIFEST_NAME)}: a batch must be finished by the version that began it (got "
                f"{found.get('version')}, this is {__version__}; use that version, or another folder)"
            )
        return cls(**found | {"system": System(**found["system"])})


def default_pings_per_part(bytes_per_ping: float, n_pings: int) -> int:
    """Return a part size large enough for a file, and small enough to be made again and to share the job.

    n_pings : pings of the job; their share does not depend on the number of processes, as the bytes of a batch do not

    >>> default_pings_per_part(1e6, 10**6), default_pings_per_part(1e6, 60)
    (128, 8)
    """
    chunks = min(int(PART_BYTES / bytes_per_ping), n_pings // SMALL_JOB_PARTS) // CHUNK_PINGS
    return max(CHUNK_PINGS, min(MAX_PART_PINGS, chunks * CHUNK_PINGS))


@dataclass(frozen=True)
class PartRecord:
    """What a finished part consists of. Its file is written after all others of the part.

    batch : `Manifest.identity` of its batch
    set_aside : number of each ping that could not be made (as text, for JSON) -> why
    without_echo : number of pings without an echo
    files : name of each file of the part -> SHA-256
    system : None, or what made it, if that is not the system that began the batch
    """

    batch: str
    part: int
    first: int
    pings: int
    set_aside: dict[str, str]
    without_echo: int
    files: dict[str, str]
    system: dict[str, str] | None = None

    def save(self, folder: Folder) -> None:
        """Write the record to the folder of the batch."""
        folder.put_record(record_name(self.part), asdict(self))

    @classmethod
    def load(cls, folder: Folder, part: int) -> PartRecord | None:
        """Read the record of a part, or None if the part is not done; an Error if the record is damaged."""
        found = folder.get_record(record_name(part), RECORD_CURE)
        return None if found is None else cls(**found)


@dataclass(frozen=True)
class DoneRecord:
    """What a complete batch consists of beside its parts.

    files : name of each file that belongs to no part -> SHA-256
    """

    parts: int
    pings: int
    files: dict[str, str]

    def save(self, folder: Folder) -> None:
        """Write the record to the folder of the batch."""
        folder.put_record(DONE_NAME, asdict(self))

    @classmethod
    def load(cls, folder: Folder) -> DoneRecord | None:
        """Read the record, or None if the batch is not complete; an Error if it is damaged."""
        found = folder.get_record(DONE_NAME, RECORD_CURE)
        return None if found is None else cls(**found)


def recorded_parts(folder: Folder) -> list[int]:
    """Return the numbers of the parts that have a record."""
    names = [PurePosixPath(name) for name in folder.names("parts")]
    return [int(name.stem) for name in names if name.suffix == ".json" and name.stem.isdigit()]


def part_records(folder: Folder, manifest: Manifest) -> Iterator[PartRecord]:
    """Yield the records of the parts that are done; an Error if one is damaged or of another batch."""
    for part in recorded_parts(folder):
        record = PartRecord.load(folder, part)
        if record.batch != manifest.identity:
            raise Error(
                f"{folder.path(record_name(part))}: must be of the batch in {MANIFEST_NAME} (got one of another; "
                f"restore {MANIFEST_NAME}, or make the part again by --resume --mend)"
            )
        yield record


def check(folder: Folder, progress: Callable) -> list[str]:
    """Compare all files of a batch with their checksums; return a line for each that is missing or has changed.

    A batch that is not complete has a line that says so. Raises Error if the folder holds no batch, or one of another
    version.

    progress : function that turns the numbers of parts into a context manager of an iterable of them
    """
    found = recorded_parts(folder)
    faults, done, manifest = [], None, None
    try:
        manifest = Manifest.load(folder)
    except DamagedRecordError:
        faults.append(_changed(folder, MANIFEST_NAME))
    else:
        if manifest is None and not found:
            raise Error(f"{folder.url}: must be the folder of a batch (there is no {MANIFEST_NAME} in it)")
        if manifest is None:
            faults.append(_missing(folder, MANIFEST_NAME))
    try:
        if (done := DoneRecord.load(folder)) is None:
            faults.append(f"{_missing(folder, DONE_NAME)}: the batch is not complete; --resume continues it")
    except DamagedRecordError:
        faults.append(_changed(folder, DONE_NAME))
    with progress(sorted({*found, *range(done.parts if done else 0)})) as parts:
        for part in parts:
            faults += _faults_of_part(folder, part, manifest)
    return [*faults, *(_faults(folder, done.files) if done else ())]


def discard_damaged(folder: Folder, manifest: Manifest, report: Callable[[str], None]) -> None:
    """Delete the records of parts with missing or changed files, so that the parts are made again.

    report : function that is given a line for each such file
    """
    try:
        done = DoneRecord.load(folder)
        faults = list(_faults(folder, done.files)) if done else []
    except DamagedRecordError:
        faults = [_changed(folder, DONE_NAME)]
    recorded = recorded_parts(folder)
    by_part = {part: list(_faults_of_part(folder, part, manifest)) for part in recorded}
    damaged = [part for part, lines in by_part.items() if lines]
    for line in chain(faults, *by_part.values()):
        report(line)
    if faults or damaged or len(recorded) < manifest.n_parts:
        folder.remove_record(DONE_NAME)
    for part in damaged:
        folder.remove_record(record_name(part))


def _faults_of_part(folder: Folder, part: int, manifest: Manifest | None) -> Iterator[str]:
    """Yield a line for each file of a part that is missing or changed."""
    name = record_name(part)
    try:
        record = PartRecord.load(folder, part)
    except DamagedRecordError:
        yield _changed(folder, name)
        return
    if record is None:
        yield _missing(folder, name)
        return
    if manifest is not None and record.batch != manifest.identity:
        yield f"{folder.path(name)}: is of another batch than that of {MANIFEST_NAME}"
    yield from _faults(folder, record.files)


def _faults(folder: Folder, files: dict) -> Iterator[str]:
    """Yield a line for each file that is missing or changed."""
    for name, expected in files.items():
        found = folder.checksum(name)
        if found != expected:
            yield (_missing if found is None else _changed)(folder, name)


def _missing(folder: Folder, name: str) -> str:
    return f"{folder.path(name)}: is missing"


def _changed(folder: Folder, name: str) -> str:
    return f"{folder.path(name)}: has changed since it was written"
