"""What a live session writes: recordings, pictures, command lines, and poses of job files."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from sonar_gl.core.errors import Error

if TYPE_CHECKING:
    from sonar_gl.live.session import LiveSession

DEFAULT_FOLDER = "sonar_out"


@dataclass(frozen=True)
class SceneSource:
    """How a command line names a scene.

    Attributes
    ----------
    name : of a bundled scene, or a path
    options : further options, such as ("--without", "boat*")
    """

    name: str
    options: tuple[str, ...] = ()


class LiveOutput:
    """Writes files into one folder, under names of its own choice.

    Parameters
    ----------
    session : LiveSession
    folder : of the files
    source : SceneSource; None for a scene that no command line names
    """

    def __init__(self, session: LiveSession, folder: str | Path, source: SceneSource | None):
        self._session, self._folder, self._source = session, Path(folder), source

    @property
    def folder(self) -> Path:
        """The folder of all files."""
        return self._folder

    @property
    def is_recording(self) -> bool:
        """Whether pings are recorded."""
        return False

    def start_recording(self) -> Path:
        """Record all pings from now on: each as NPZ, all as an MP4, and the poses as CSV; return their folder.

        Raises Error if the folder cannot be written, or pings are recorded already.
        """
        raise NotImplementedError

    def stop_recording(self) -> list[Path]:
        """End the recording; return its files, or [] if there was none. Raises Error if some could not be written."""
        return []

    def save_picture(self) -> Path:
        """Save the picture of a ping from where the sonar is now, as PNG and NPZ; return the path of the PNG.

        It is what `command_line` makes: the first ping of its noise, with samples planned for this pose.
        """
        raise NotImplementedError

    def command_line(self) -> str:
        """Return the line of a shell that makes the picture of `save_picture`.

        Lines of comments follow where it cannot do the same, as where bodies were moved. Raises Error for a scene or a
        sonar that no command line can name.
        """
        raise NotImplementedError

    def add_pose_to_job(self) -> Path:
        """Add the sonar's pose to the job file `poses.toml` of the folder; return its path.

        The file is made if it is not there. Raises Error if it holds no such job, or cannot be written.
        """
        raise Error("jobs are not written yet")
