"""What is fixed before the first ping of a batch, from the job alone: the same job gives the same bytes."""

from __future__ import annotations

from dataclasses import asdict, dataclass

from sonar_gl._version import __version__
from sonar_gl.batch.files import Folder
from sonar_gl.types import Error

NAME = "planned.json"
DONE = "done.json"  # the last file of a batch
PART_BYTES = 128e6  # of a part's arrays, before they are packed
CHUNK = 8  # pings; parts hold whole ones
MOST = 128  # pings of a part: no more are lost or made again


def record_name(part: int) -> str:
    """File that says that a part is done."""
    return f"parts/{part:07d}.json"


def table_name(part: int) -> str:
    """File of a part's rows of the table."""
    return f"parts/{part:07d}.npy"


@dataclass(frozen=True)
class Planned:
    """The samples of each scene and sonar, and how pings are dealt into parts.

    Attributes
    ----------
    job : the job as plain values; digest : of `Kept`
    n_pings, pings_per_part
    samplings : of each scene, by sonar, what `Sampling` takes
    estimates : of each scene, by sonar, the error that pings are thought to stay below
    version, gl_renderer : of what planned it
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
        """Pings of a part."""
        first = part * self.pings_per_part
        return range(first, min(first + self.pings_per_part, self.n_pings))

    def save(self, folder: Folder) -> None:
        folder.put_json(NAME, asdict(self))

    @classmethod
    def load(cls, folder: Folder) -> Planned | None:
        """What was planned for a folder, or None if nothing was.

        Raises
        ------
        Error
            if it cannot be read, or another version planned it, whose pings may differ.
        """
        found = folder.get_json(NAME)
        if found is None:
            return None
        try:
            planned = cls(**found)
        except TypeError as why:
            raise Error(f"{folder.path(NAME)}: must be what a batch has planned ({why})") from None
        if planned.version != __version__:
            raise Error(
                f"{folder.path(NAME)}: a batch must be finished by the version that began it (got "
                f"{planned.version}, this is {__version__}; take that one, or another folder)"
            )
        return planned


def pings_per_part(bytes_per_ping: float) -> int:
    """So many that a part is large enough for a file and small enough to be made again."""
    return max(CHUNK, min(MOST, int(PART_BYTES / bytes_per_ping) // CHUNK * CHUNK))
