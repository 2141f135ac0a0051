"""The command `render`: pings of a scene, one after the other, as pictures, arrays and films."""

from __future__ import annotations

import math
import statistics
import time
import warnings
from collections import deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sonar_gl.analysis.terms import needed_acoustics
from sonar_gl.cli.common import (
    FILES_ARE_COMPLETE,
    acoustics_from,
    check_output,
    poses_from,
    progress,
    scene_from,
    sonar_from,
    warn_of_hull,
    water_from,
)
from sonar_gl.cli.output import echo
from sonar_gl.core.errors import Error, some_names
from sonar_gl.core.load_numba import load_numba
from sonar_gl.imaging.files import check_fps, output_folder, save_animation, save_npz, save_png
from sonar_gl.imaging.formats import FILMS, STILLS
from sonar_gl.imaging.styles import DemarcoStyle, FanStyle, shows_echo, what_lacks_16_bits
from sonar_gl.noise.reception import receiver_power
from sonar_gl.noise.settings import Noise
from sonar_gl.ping import Ping
from sonar_gl.scene.extent import bodies_beyond
from sonar_gl.simulator import Simulator
from sonar_gl.sonar.sonar import Sonar, too_short_step_s

FAN_ONLY = ("counts", "colormap", "axes")  # options of one style
REPLACED = {  # options of former versions: what stands in their place
    "scale": '--counts law=db, or --counts "law=power,exponent=1" for a linear scale',
    "db_range": '--counts "law=db,low_db=-50,high_db=0"',
}
DEMARCO_ONLY = ("form", "join")
WRITERS = 2  # threads: writing a PNG takes longer than a frame, and compression releases the GIL
NEARLY_EMPTY = 0.01  # share of bright cells
OVER_NOISE = 8.0  # times its mean power, which noise exceeds in e^-8 of all cells, fewer than NEARLY_EMPTY
FALSE_ECHOES = 0.01  # a ping, of noise that is taken for the strongest echo
VISIBLE_SHARE = 0.05  # of full scale: brightness that one tells from black
CLEARLY_BRIGHT_SHARE = 1 / 3  # of full scale: an echo as bright as this is easy to see


def render(scene_name: str, options, given: set[str]) -> str:
    """Write the files that the options name, of which `given` are on the command line; return a line about them."""
    _check_combination(options, given)
    check_output(options)
    load_numba()
    in_demarco = options.style == "demarco2015"
    profile = options.profile or ("demarco2015" if in_demarco else "physical")
    if options.range_law is not None and profile != "demarco2015":
        raise Error(f"--range-law needs --profile demarco2015 (got --profile {profile})")
    acoustics = acoustics_from(options, profile)
    if options.range_law is not None:
        acoustics = replace(acoustics, range_law=options.range_law)
    default_noise = "demarco2015" if in_demarco else "physical" if profile == "physical" else "none"
    noise = Noise.parse(default_noise if options.noise is None else options.noise)
    if in_demarco:
        style = DemarcoStyle(options.height, options.form, options.join, noise, options.seed)
    else:
        style = FanStyle(options.height, options.colormap, options.axes)
    scene = scene_from(scene_name, options)
    times_s, poses = poses_from(options, scene)
    if options.poses is not None:
        warn_of_hull(scene)
    sonar = sonar_from(options, scene)
    if options.counts is not None:
        sonar = _with_counts(sonar, options, style)
    acoustics = acoustics or needed_acoustics(scene, sonar, options.tolerance, poses, water_from(options))
    folder = output_folder(options.out)
    with Simulator(scene, sonar, acoustics, tolerance=options.tolerance) as simulator:
        if not in_demarco or "npz" in options.formats:  # the paper's picture is made of points alone
            simulator.plan(poses)  # before the first ping, so that no ping depends on those before it
        range_m = acoustics.true_range_sonar(sonar).range_max_m
        beyond = bodies_beyond(scene.bodies, np.array(poses)[:, :3, 3], range_m)
        if 0 < len(beyond) < len(scene.bodies):  # where all lie there, the warning of no echo says so
            echo(f"range: {range_m:.4g} m; beyond it: {some_names(beyond)}", err=True)
        writer = FrameWriter(
            simulator=simulator,
            style=style,
            folder=folder,
            formats=options.formats,
            noise=noise,
            seed=options.seed,
            labels=options.labels,
            label_level_db=options.label_level,
            fps=options.fps,
            progress=nullcontext if options.poses is None else progress,
        )
        return writer.write(poses, times_s)


def _check_combination(options, given: set[str]):
    """Raise an Error for options that do not go together, or are those of former versions."""
    for name, now in REPLACED.items():
        if name in given:
            raise Error(f"--{name.replace('_', '-')} is no option any more; give {now}")
    for style, names in (("fan", FAN_ONLY), ("demarco2015", DEMARCO_ONLY)):
        for name in names:
            if name in given and options.style != style:
                option = "--" + name.replace("_", "-")
                raise Error(f"{option} needs --style {style} (got --style {options.style})")
    if options.label_level is not None and not options.labels:
        raise Error(f"--label-level needs --labels (got --label-level {options.label_level:g} alone)")
    if options.labels and "npz" not in options.formats:
        raise Error("--labels needs --format npz (no other file holds labels)")
    films = [film for film in FILMS if film in options.formats]
    if films and options.poses is None:
        raise Error(f"--format {films[0]} needs --poses (a film needs a sequence of poses)")
    if "fps" in given and not films:
        raise Error("--fps needs --format gif or --format mp4 (nothing else has frames)")
    for film in films:
        check_fps(options.fps, film)


def _with_counts(sonar: Sonar, options, style: FanStyle) -> Sonar:
    """Return the sonar with the law of --counts; raise an Error where pictures cannot hold the bits that it adds."""
    law = sonar.counts.parse_changes(options.counts)
    lacking = what_lacks_16_bits(style, options.formats)
    if law.bits > sonar.counts.bits and lacking is not None:
        raise Error(
            "--counts bits=16 needs gray PNG pictures without axes, since others have 8 bits "
            f"(got --{lacking}; give --colormap gray --format png, or --format npz)"
        )
    return replace(sonar, counts=law)


class BackgroundCalls:
    """Threads that call functions while the caller goes on; a `with` block ends when all calls are done.

    `start` waits while enough calls are under way, which bounds the memory, and raises what an earlier call raised. If
    an error or Ctrl-C leaves the block, calls that have begun are finished, so that no file is incomplete, and the
    others are dropped.
    """

    def __init__(self):
        self._threads, self._under_way = ThreadPoolExecutor(WRITERS, "writer"), deque()

    def start(self, function, *arguments):
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


class Echo(NamedTuple):
    """The strongest echo of a ping."""

    is_above_noise: bool
    intensity: float  # of the noise, where no echo is above it
    text: str  # what and where it is
    number: int  # of the ping


@dataclass
class FrameWriter:
    """Writes pings of one simulator into a folder, which must exist."""

    simulator: Simulator
    style: FanStyle | DemarcoStyle
    folder: Path
    formats: tuple[str, ...]  # which of png, npz, gif and mp4
    noise: Noise  # as for `Simulator.ping`, and so the next three
    seed: int = 0
    labels: bool = False
    label_level_db: float | None = None
    fps: float = 10.0  # of gif and mp4
    progress: Callable = nullcontext  # (range) -> context manager that yields it, such as click.progressbar

    def __post_init__(self):
        self._strongest, self._bright_share, self._times_ms = None, None, []
        self._has_files = False  # whether the writing of a file has begun, which is then finished

    def write(self, poses, times_s=None) -> str:
        """Write all files, and return one line about them and the strongest echo.

        KeyboardInterrupt of Ctrl-C gets a sentence about the files if there are any.

        poses : (N, 4, 4) world_from_sonar
        times_s : (N,) seconds, for a sequence, whose files are numbered; None for one ping
        """
        try:
            return self._write(poses, times_s)
        except KeyboardInterrupt:
            raise KeyboardInterrupt(*[FILES_ARE_COMPLETE] * self._has_files) from None

    def _write(self, poses, times_s) -> str:
        self._check_ping_rate(times_s)
        name, last = self.simulator.scene.name, len(poses) - 1
        width = max(4, len(str(last)))
        names = [name] if times_s is None else [f"{name}_{n:0{width}d}" for n in range(len(poses))]
        films = [film for film in FILMS if film in self.formats]
        stills = [still for still in STILLS if still in self.formats]
        with BackgroundCalls() as calls:
            for film in films:  # a second film renders all frames again: the same seed gives the same bytes
                frames = self._frames(names, poses, times_s, stills if film == films[0] else (), calls)
                save_animation(self.folder / f"{name}.{film}", frames, self.fps)
                self._has_files = True
            if not films:
                for _ in self._frames(names, poses, times_s, stills, calls):
                    pass
        self._warn_if_nearly_empty("the picture is" if times_s is None else "all pictures are")
        several = name if times_s is None else f"{names[0]}..{last:0{width}d}"
        files = [f"{self.folder / several}.{still}" for still in stills]
        files += [f"{self.folder / name}.{film}" for film in films]
        which = "" if times_s is None else f" in ping {self._strongest.number}"
        beams, bins = self.simulator.sonar.n_beams, self.simulator.sonar.n_bins
        pace = f"{statistics.median(self._times_ms):.1f} ms" + ("" if times_s is None else " a ping")
        return (
            f"{', '.join(files)}: {beams} beams x {bins} bins, {self._strongest.text}{which}; "
            f"{pace} on {self.simulator.gl_info['renderer']}"
        )

    def _check_ping_rate(self, times_s):
        """Warn once of pings that follow each other faster than sound returns."""
        sonar = self.simulator.sonar
        max_rate_hz = sonar.max_ping_rate_hz(self.simulator.acoustics.assumed_sound_speed_m_s())
        shortest_s = too_short_step_s([] if times_s is None else times_s, max_rate_hz)
        if shortest_s is not None:
            cure = "no sonar pings as quickly"
            reason = f"in which sound comes back from {sonar.range_max_m:g} m"
            if max_rate_hz == sonar.ping_rate_max_hz:
                cure = "change its ping_rate_max_hz, or the times"
                reason = f"since sonar {sonar.name!r} makes {max_rate_hz:g} pings a second at most"
            warnings.warn(
                f"the poses' times must be {1 / max_rate_hz:.4g} s apart or more, {reason} (got {shortest_s:.4g} s; "
                f"{cure})",
                stacklevel=3,
            )

    def _warn_if_nearly_empty(self, subject: str):
        """Warn if no picture shows more than a few bright cells, and say what to change."""
        if self._bright_share is None or self._strongest.intensity <= 0 or self._bright_share >= NEARLY_EMPTY:
            return  # a ping without echo has a warning of its own
        sonar = self.simulator.sonar
        cure = f"change --range ({sonar.range_min_m:g} to {sonar.range_max_m:.4g} m) or the sonar's pose"
        what = "pixels show an echo"
        if isinstance(self.style, FanStyle):
            what = "cells are bright enough to be seen"
            share = sonar.counts.share(np.array([[self._strongest.intensity]], np.float32))[0, 0]
            if share < CLEARLY_BRIGHT_SHARE:  # never with automatic gain
                cure = "give --counts gain_percentile=99"
                if self.simulator.acoustics.range_law == "sonar_equation":  # of which the TVG is a part
                    cure += ", or more gain by --acoustics tvg_k=40"
            elif self.noise.has_receiver_noise:  # of which the picture may be bright
                what = "cells show an echo above the noise"
        share = f"{subject} nearly empty: {100 * self._bright_share:.2g} % of its"
        warnings.warn(f"{share} {what}; {cure}", stacklevel=3)

    def _frames(self, names, poses, times_s, stills, calls: BackgroundCalls):
        """Yield the pictures one after the other, and have `calls` write the still files."""
        with self.progress(range(len(poses))) as numbers:
            for number in numbers:
                start = time.perf_counter()
                time_s = None if times_s is None else times_s[number]
                settings = self.noise, self.seed, self.labels, number
                more = {"time_s": time_s, "label_level_db": self.label_level_db}
                ping = self.simulator.ping(poses[number], *settings, **more)
                self._times_ms.append(1e3 * (time.perf_counter() - start))
                found = self._strongest_echo(ping, number)
                if self._strongest is None or found[:2] > self._strongest[:2]:
                    self._strongest = found
                picture = None
                if set(self.formats) != {"npz"}:
                    by_paper = isinstance(self.style, DemarcoStyle)  # which draws by the pose of a ping
                    picture = self.style(self.simulator, ping, number) if by_paper else self.style(ping)
                    bright = self._is_bright(ping, picture)
                    self._bright_share = max(
                        self._bright_share or 0.0, np.count_nonzero(bright) / bright.size
                    )
                self._has_files |= bool(stills)
                contents = {"png": (save_png, picture), "npz": (save_npz, ping)}
                for still in stills:
                    save, content = contents[still]
                    calls.start(save, self.folder / f"{names[number]}.{still}", content)
                yield picture

    def _is_bright(self, ping: Ping, picture: np.ndarray) -> np.ndarray:
        """Return which bins, or pixels of the founding paper's picture, which has an echo of its own, can be seen."""
        if isinstance(self.style, DemarcoStyle):
            return shows_echo(picture)
        law = ping.counts_law()
        least, power = law.intensity_of(VISIBLE_SHARE * law.full_scale), receiver_power(ping, self.noise)
        return ping.intensity > (least if power is None else np.maximum(least, OVER_NOISE * power))

    def _strongest_echo(self, ping: Ping, number: int) -> Echo:
        """Return the strongest echo, or that there is none, or none above the noise, which rises with range."""
        if not ping.meta["has_echo"]:  # the intensity is noise
            return Echo(False, 0.0, "no echo", number)
        intensity = ping.intensity
        if self.noise.salt_and_pepper:
            intensity = np.where(intensity == 1.0, 0.0, intensity)  # grains of salt
        most = float(intensity.max())
        if most <= 0:
            return Echo(False, 0.0, "no echo", number)
        power = receiver_power(ping, self.noise)
        if power is not None:  # of an exponential distribution
            intensity = np.where(intensity > math.log(intensity.size / FALSE_ECHOES) * power, intensity, 0.0)
        beam, bin_ = np.unravel_index(intensity.argmax(), intensity.shape)
        strongest = float(intensity[beam, bin_])
        if strongest <= 0:
            return Echo(False, most, "no echo above the noise", number)
        azimuth_deg = float(np.degrees(ping.azimuth_rad[beam]))
        side = "port" if azimuth_deg > 0 else "starboard"
        text = f"strongest echo {10 * np.log10(strongest):.1f} dB at {ping.range_m[bin_]:.2f} m, "
        text += f"{abs(azimuth_deg):.1f} deg to {side}"
        if ping.body_id is not None and ping.body_id[beam, bin_]:
            text += f", of {self.simulator.scene.bodies[ping.body_id[beam, bin_] - 1].name!r}"
        return Echo(True, strongest, text, number)
