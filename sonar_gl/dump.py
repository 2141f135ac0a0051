"""From poses to files: pings one after the other, as pictures, arrays and films."""

from __future__ import annotations

import statistics
import time
import warnings
from collections import deque
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sonar_gl.axes import draw_axes
from sonar_gl.export import save_animation, save_npz, save_png
from sonar_gl.image import colorize, fan_image
from sonar_gl.noise import Noise
from sonar_gl.paper import demarco_image
from sonar_gl.simulator import Simulator

STILLS, FILMS = ("png", "npz"), ("gif", "mp4")
WRITERS = 2  # threads: a PNG takes longer than a frame, and compression leaves Python's lock alone


def fan_artist(height: int, scale: str, db_range, colormap: str, axes: bool):
    """Function (simulator, ping, number) -> (H, W, 3) fan image in colour. Raises Error for a bad name."""
    colorize(np.zeros((1, 1), np.float32), colormap)

    def picture(_simulator, ping, _number):
        drawn = colorize(fan_image(ping, height, scale, db_range), colormap)
        return draw_axes(drawn, ping) if axes else drawn

    return picture


def demarco_artist(height: int, form: str, join: str, noise: Noise, seed: int):
    """Function (simulator, ping, number) -> (H, W, 3) picture of the founding paper; ping n has seed + n."""
    if noise.speckle or noise.gaussian:
        warnings.warn("the picture of style demarco2015 knows no speckle and no gaussian noise", stacklevel=2)
    if noise.electronic_db is not None or noise.ambient_db is not None or noise.interference_lines:
        warnings.warn("the picture of style demarco2015 knows no receiver and no other sonars", stacklevel=2)

    def picture(simulator, ping, number):
        return demarco_image(simulator, ping.pose, seed + number, noise, height, form, join)

    return picture


class Behind:
    """Calls functions in other threads while the next frames are made; a `with` block ends when all are done.

    A call waits while there are enough under way, so that memory does not grow, and raises what one before
    it raised. If the block is left by an error or Ctrl-C, what has begun is still done, so that no file is
    half written, and what has not begun is left out.
    """

    def __init__(self):
        self._threads, self._under_way = ThreadPoolExecutor(WRITERS, "writer"), deque()

    def __call__(self, function, *arguments):
        while len(self._under_way) > WRITERS or (self._under_way and self._under_way[0].done()):
            self._under_way.popleft().result()
        self._under_way.append(self._threads.submit(function, *arguments))

    def __enter__(self):
        return self

    def __exit__(self, kind, _why, _where):
        try:
            while kind is None and self._under_way:
                self._under_way.popleft().result()
        finally:
            self._threads.shutdown(cancel_futures=True)


@dataclass
class Dump:
    """Writes pings of one simulator into a folder, which exists.

    Parameters
    ----------
    artist : function (simulator, ping, number) -> (H, W, 3) picture
    folder, formats : where, and which of png, npz, gif and mp4
    noise, seed, labels : of `Simulator.ping`
    fps : frames a second, of gif and mp4
    progress : makes of a range a context manager that gives it, as click.progressbar does
    """

    simulator: Simulator
    artist: object
    folder: Path
    formats: tuple[str, ...]
    noise: Noise
    seed: int = 0
    labels: bool = False
    fps: float = 10.0
    progress: object = nullcontext

    def __post_init__(self):
        self._strongest = (-1.0, "", 0)  # intensity, what and where, number of the ping
        self._took_ms = []

    def write(self, poses, times_s=None) -> str:
        """Write all files, and say what was written and found, on one line.

        Parameters
        ----------
        poses : (N, 4, 4) world_from_sonar
        times_s : (N,) seconds, for a sequence, whose files are numbered; None for one ping
        """
        self._look_at(times_s)
        name, last = self.simulator.scene.name, len(poses) - 1
        width = max(4, len(str(last)))
        names = [name] if times_s is None else [f"{name}_{n:0{width}d}" for n in range(len(poses))]
        films = [f for f in FILMS if f in self.formats]
        stills = [f for f in STILLS if f in self.formats]
        with Behind() as behind:
            for film in films:  # a second film draws all again: the same seed gives the same bytes
                frames = self._frames(names, poses, times_s, stills if film == films[0] else (), behind)
                save_animation(self.folder / f"{name}.{film}", frames, self.fps)
            if not films:
                for _ in self._frames(names, poses, times_s, stills, behind):
                    pass
        several = name if times_s is None else f"{names[0]}..{last:0{width}d}"
        files = [f"{self.folder / several}.{f}" for f in stills]
        files += [f"{self.folder / name}.{f}" for f in films]
        _, strongest, number = self._strongest
        number = -number  # of equals the first
        which = "" if times_s is None else f" in ping {number}"
        beams, bins = self.simulator.sonar.n_beams, self.simulator.sonar.n_bins
        pace = f"{statistics.median(self._took_ms):.1f} ms" + ("" if times_s is None else " a ping")
        renderer = self.simulator.gl_info["renderer"]
        return f"{', '.join(files)}: {beams} beams x {bins} bins, {strongest}{which}; {pace} on {renderer}"

    def _look_at(self, times_s):
        """Warn once of pings that follow each other more quickly than sound can."""
        steps_s = np.diff([] if times_s is None else times_s)
        steps_s = steps_s[steps_s != 0]  # where time stands still there is no rate
        if not len(steps_s):
            return
        acoustics, sonar = self.simulator.acoustics, self.simulator.sonar
        most_hz = sonar.max_ping_rate_hz(acoustics.sonar_sound_speed_m_s or acoustics.sound_speed())
        shortest_s = float(steps_s.min())
        if shortest_s < (1 - 1e-6) / most_hz:
            warnings.warn(
                f"the poses' times must be {1 / most_hz:.4g} s apart or more, in which sound comes back from "
                f"{sonar.range_max_m:g} m (got {shortest_s:.4g} s; no sonar pings as quickly)",
                stacklevel=3,
            )

    def _frames(self, names, poses, times_s, stills, behind):
        """The pictures, one after the other; in passing, the still files, written `behind`."""
        with self.progress(range(len(poses))) as numbers:
            for number in numbers:
                start = time.perf_counter()
                time_s = None if times_s is None else times_s[number]
                settings = self.noise, self.seed, self.labels, number
                ping = self.simulator.ping(poses[number], *settings, time_s=time_s)
                self._took_ms.append(1e3 * (time.perf_counter() - start))
                self._strongest = max(self._strongest, (*self._find(ping), -number))
                drawn = set(self.formats) != {"npz"}
                picture = self.artist(self.simulator, ping, number) if drawn else None
                if "png" in stills:
                    behind(save_png, self.folder / f"{names[number]}.png", picture)
                if "npz" in stills:
                    behind(save_npz, self.folder / f"{names[number]}.npz", ping)
                yield picture

    def _find(self, ping) -> tuple[float, str]:
        """Intensity of the strongest echo, and what and where it is."""
        if not ping.meta["has_echo"]:  # what there is is noise
            return 0.0, "no echo"
        intensity = ping.intensity
        if self.noise.salt_and_pepper:
            intensity = np.where(intensity == 1.0, 0.0, intensity)  # grains of salt
        beam, bin_ = np.unravel_index(intensity.argmax(), intensity.shape)
        echo = float(intensity[beam, bin_])
        if echo <= 0:
            return 0.0, "no echo"
        azimuth_deg = float(np.degrees(ping.azimuth_rad[beam]))
        side = "port" if azimuth_deg > 0 else "starboard"
        text = f"strongest echo {10 * np.log10(echo):.1f} dB at {ping.range_m[bin_]:.2f} m, "
        text += f"{abs(azimuth_deg):.1f} deg to {side}"
        if ping.body_id is not None and ping.body_id[beam, bin_]:
            text += f", of {self.simulator.scene.bodies[ping.body_id[beam, bin_] - 1].name!r}"
        return echo, text
