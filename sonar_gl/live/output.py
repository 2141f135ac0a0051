"""What a live session writes: recordings, pictures, command lines, and poses of job files."""

from __future__ import annotations

import logging
import re
from contextlib import suppress
from pathlib import Path
from threading import Lock

from sonar_gl.core.atomic_file import atomic_write, check_output_folder
from sonar_gl.core.errors import Error
from sonar_gl.core.listeners import Listener
from sonar_gl.core.toml import read_toml
from sonar_gl.imaging.files import output_folder, save_npz, save_png
from sonar_gl.live.command_line import SceneSource, render_line
from sonar_gl.live.frame import LiveFrame
from sonar_gl.live.job_file import add_pose, new_job_text
from sonar_gl.live.recording import Recording

logger = logging.getLogger(__name__)

DEFAULT_FOLDER = "sonar_out"
WAITING_FRAMES = 64  # that a recording may lag behind; then it misses some
MAX_NUMBER = 9999  # of files of one kind in the folder


class LiveOutput:
    """Writes files into one folder, under names of its own choice: no caller names a file.

    All methods may be called from any thread.

    Raises Error if there is no such job file, or nothing can be written into the folder.

    folder : of the files; it is made when the first is written
    source : None for a scene that no command line names
    job : path of a job file to which poses are added; None for `poses.toml` of the folder
    """

    def __init__(self, session, folder: str | Path, source: SceneSource | None, job: str | Path | None):
        self._session, self.folder, self._source = session, Path(folder), source
        check_output_folder(self.folder)
        self._job = None if job is None else Path(job)
        if self._job is not None:
            read_toml(self._job, "the job file")  # so that a wrong path is known at the start
        self._name = re.sub(r"[^\w-]+", "_", session.scene.name)[:64] or "scene"
        self._lock = Lock()
        self._recording: Recording | None = None
        self._listener: Listener | None = None
        self._n_missed = 0

    @property
    def is_recording(self) -> bool:
        """Whether pings are recorded; False, too, once a recording has failed."""
        return self._listener is not None and not self._listener.is_closed

    @property
    def recording_folder(self) -> Path | None:
        """The folder of the last recording; None if there was none."""
        return None if self._recording is None else self._recording.folder

    @property
    def n_recorded(self) -> int:
        return 0 if self._recording is None else len(self._recording.files)

    @property
    def n_missed(self) -> int:
        """Number of pings that the last recording missed, since files were written too slowly."""
        return self._n_missed if self._listener is None else self._listener.missed

    @property
    def problem(self) -> str:
        """A sentence about why the recording ended, such as a full disk; "" if all is well."""
        return "" if self._listener is None else _problem(self._listener)

    def start_recording(self) -> Path:
        """Record all pings from now on: each as NPZ, all as an MP4, and the poses as CSV; return their folder.

        Raises Error if the folder cannot be written, or pings are recorded already.
        """
        with self._lock:
            if self.is_recording:
                raise Error("a recording must be stopped before another begins (got one that goes on)")
            with suppress(Error):  # of one that has failed, which is known
                self._end_recording()
            folder = output_folder(self._new_path(""))
            self._recording = Recording(folder)
            self._listener = self._session.listen(self._recording, WAITING_FRAMES)
            return folder

    def stop_recording(self) -> list[Path]:
        """End the recording; return its files, or [] if there was none. Raises Error if some could not be written."""
        with self._lock:
            return self._end_recording()

    def _end_recording(self) -> list[Path]:
        """Finish the files of the recording that there is; raise Error if some could not be written."""
        listener, recording, self._listener = self._listener, self._recording, None
        if listener is None:
            return []
        listener.close(None)
        self._n_missed = listener.missed
        files = recording.close()
        if problem := _problem(listener):  # also one with the pings that were waiting
            raise Error(f"the recording ended early: {problem}")
        return files

    def save_picture(self, frame: LiveFrame | None = None) -> Path:
        """Save the picture of a ping from where the sonar is in a frame, as PNG and NPZ; return the path of the PNG.

        It is what `command_line` makes: the first ping of its noise, with samples planned for this pose, and the pose
        rounded to micrometres. The form is that of the frame's settings. None is the last frame.
        """
        still = self._session.still(frame or self._session.frame)
        with self._lock:
            output_folder(self.folder)
            path = self._new_path(".png", ".npz")
            save_npz(path.with_suffix(".npz"), still.ping)
            save_png(path, still.picture)
        return path

    def command_line(self, frame: LiveFrame | None = None) -> str:
        """Return the line of a shell that makes the picture of `save_picture` of a frame; None is the last one.

        Lines of comments follow where it cannot do the same, as where bodies were moved. Raises Error for a scene or a
        sonar that no command line can name.
        """
        frame = frame or self._session.frame
        line = render_line(frame.settings, frame.pose, self._named_source(), self._session.scene.sonar)
        if frame.bodies:
            line += f"\n# {', '.join(frame.bodies)}: where the scene has them, not where they were moved to"
        if self._session.scene.plumes:
            line += "\n# bubbles: as at time 0"
        if frame.settings.form == "polar":
            line += "\n# a fan image of the same ping, in place of the polar picture"
        return line

    def add_pose_to_job(self, frame: LiveFrame | None = None) -> Path:
        """Add the sonar's pose in a frame, None for the last, to the job file; return its path.

        `job_file.add_pose` says how. The job file of the folder is made if it is not there, with the settings of the
        frame.
        """
        frame = frame or self._session.frame
        with self._lock:
            path = self._job
            if path is None:
                path = output_folder(self.folder) / "poses.toml"
                if not path.exists():
                    text = new_job_text(self._name, frame.settings, self._named_source())
                    with atomic_write(path) as beside:
                        beside.write_text(text, encoding="utf-8")
            add_pose(path, frame.pose)
            return path

    def close(self) -> None:
        """End the recording, and log where it is, or what could not be written: nobody else may tell the user."""
        has_recording = self._listener is not None
        try:
            self.stop_recording()
        except Error as why:
            logger.warning("%s", why)
        else:
            if has_recording:
                logger.warning(
                    "the recording has ended: %d pings in %s", self.n_recorded, self.recording_folder
                )

    def _named_source(self) -> SceneSource:
        if self._source is None:
            raise Error(
                f"a scene on a command line must be a bundled one or a file (got {self._session.scene.name!r}, made in "
                "Python; give sonar_gl.view a name or a path)"
            )
        return self._source

    def _new_path(self, *suffixes: str) -> Path:
        """Return a path in the folder, of the scene's name, a number and the first suffix, free with all suffixes."""
        for number in range(1, MAX_NUMBER + 1):
            paths = [self.folder / f"{self._name}_{number:04d}{suffix}" for suffix in suffixes]
            if not any(path.exists() for path in paths):
                return paths[0]
        raise Error(
            f"{str(self.folder)!r} is full of numbers (got {MAX_NUMBER} files {self._name}_*{suffixes[0]})"
        )


def _problem(listener: Listener) -> str:
    """Return why a recording failed, "" if it did not."""
    return "" if listener.failure is None else str(listener.failure) or type(listener.failure).__name__
