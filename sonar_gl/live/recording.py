"""Recordings of a live session: pings, a film and poses."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from queue import Queue
from threading import Thread

import cv2
import numpy as np

from sonar_gl.core.atomic_file import atomic_write
from sonar_gl.core.errors import Error
from sonar_gl.core.poses import COLUMNS
from sonar_gl.imaging.files import save_animation, save_npz
from sonar_gl.live.command_line import rounded_pose_numbers
from sonar_gl.live.frame import LiveFrame

FPS = 20.0  # of the film, in which pings stand for as long as they stood on the screen
LONGEST_S = 10.0  # that one picture stands in the film
WAITING_PICTURES = 64  # for the film; then the recording waits, and its listener misses frames


class Recording:
    """Writes the frames that it is called with: `ping_000000.npz` ..., `film.mp4` and `poses.csv`.

    To be called by one thread at a time, then closed; the folder exists.
    """

    def __init__(self, folder: Path):
        self.folder, self.files = folder, []
        self._rows, self._began_s = [], None
        self._pictures: Queue = Queue(WAITING_PICTURES)
        self._film_problem, self._has_all_pictures = "", False
        self._film = Thread(target=self._write_film, name="sonar_gl film", daemon=True)

    def __call__(self, frame: LiveFrame) -> None:
        """Write a frame; raises Error if that fails, as for a full disk."""
        if self._film_problem:
            raise Error(self._film_problem)
        if self._began_s is None:
            self._began_s = frame.clock_s
        time_s = frame.clock_s - self._began_s
        path = self.folder / f"ping_{len(self.files):06d}.npz"
        save_npz(path, frame.ping)
        if not self.files:  # a film needs a picture
            self._film.start()
        self.files.append(path)
        self._rows.append([round(time_s, 6), *rounded_pose_numbers(frame.pose)])
        self._pictures.put((time_s, frame.picture))

    def close(self) -> list[Path]:
        """Finish the files; return their paths. Raises Error if some could not be written."""
        if not self.files:
            return []
        path = self.folder / "poses.csv"
        self._pictures.put(None)
        try:
            write_poses(path, self._rows)
        finally:
            self._film.join()
        if self._film_problem:
            raise Error(self._film_problem)
        return [*self.files, self.folder / "film.mp4", path]

    def _write_film(self) -> None:
        try:
            save_animation(self.folder / "film.mp4", self._frames(), FPS)
        except Exception as why:
            self._film_problem = str(why)
            # nobody shall wait for room in the queue; after its end no more comes, and `get` would wait for ever
            while not self._has_all_pictures:
                self._has_all_pictures = self._pictures.get() is None

    def _frames(self) -> Iterator[np.ndarray]:
        """Yield each picture as often as it stood on the screen, at least once."""
        size, last, n_yielded = None, None, 0
        while (item := self._pictures.get()) is not None:
            time_s, picture = item
            size = size or picture.shape[:2]
            if last is not None:
                due = round(time_s * FPS)
                for _ in range(min(due - n_yielded, round(LONGEST_S * FPS))):
                    yield last
                n_yielded = max(n_yielded, due)  # as if all had been yielded: a pause is cut out
            last = fitted(picture, size)
            yield last
            n_yielded += 1
        self._has_all_pictures = True


def fitted(picture: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Return a picture scaled to fit into (height, width) pixels, with black borders; of this size as it is."""
    height, width = picture.shape[:2]
    if (height, width) == size:
        return picture
    scale = min(size[0] / height, size[1] / width)
    inner = max(1, round(scale * height)), max(1, round(scale * width))
    out = np.zeros((*size, 3), np.uint8)
    top, left = (size[0] - inner[0]) // 2, (size[1] - inner[1]) // 2
    out[top : top + inner[0], left : left + inner[1]] = cv2.resize(
        picture, inner[::-1], interpolation=cv2.INTER_AREA
    )
    return out


def write_poses(path: Path, rows: list[list[float]]) -> None:
    """Write a file of poses that `core.poses.read_poses` reads; rows are t x y z roll pitch yaw."""
    lines = [",".join(COLUMNS), *(",".join(map(str, row)) for row in rows)]
    with atomic_write(path) as beside:
        beside.write_text("\n".join(lines) + "\n", encoding="utf-8")
