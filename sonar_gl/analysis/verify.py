"""The error of a ping, judged by the reference: numbers and a picture."""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np

from sonar_gl.acoustics.acoustics import Acoustics
from sonar_gl.analysis.rays import embree_classes
from sonar_gl.analysis.reference import AGREEMENT, MIN_BODY_SHARE, reference_ping
from sonar_gl.imaging.axes import draw_axes
from sonar_gl.imaging.fan_image import colorize, fan_image
from sonar_gl.ping import Ping
from sonar_gl.scene.scene import Scene
from sonar_gl.simulator import Simulator
from sonar_gl.sonar.counts import Counts
from sonar_gl.sonar.sampling import WORST_BODY, Sampling
from sonar_gl.sonar.sonar import Sonar

N_TIMED = 9  # pings whose median time is reported
# The first reference is refined to judge this error, the next one to judge the error found.
FIRST_ERROR = 0.05
MARGIN = 0.8  # of an error that holds some of the reference's own
MAX_ROUNDS = 3  # of refining the reference
LEAST_LETTER = 0.35  # size of a letter that can be read, as axes of small pictures have it
COLOUR_PERCENTILE = 99  # of the errors of bins: from there on the picture has full colour
SPAN_DB = 50.0  # of the fan images
FAINTEST = 1e-12  # intensity of the brightest colour, so that its law has levels that `Counts` takes
LINEAR = Counts("power", exponent=1.0)


def ping_error(ping: Ping, truth: Ping) -> float:
    """Return the share of the echo that lies in wrong bins, Σ|E − T| / ΣT over beams and bins.

    It is 0 if both pings are empty, and infinite if only the truth is.
    """
    e, t = (np.asarray(p.intensity, np.float64) for p in (ping, truth))
    wrong, total = np.abs(e - t).sum(), t.sum()
    if total > 0:
        return float(wrong / total)
    return float("inf") if wrong > 0 else 0.0


def worst_body(ping: Ping, truth: Ping) -> tuple[float, int]:
    """Return the largest relative error of a body's own echo and that body's number; (0, 0) if no body counts.

    Only bodies that return more than a thousandth of the true echo count. Both pings must have `body_echo`, as
    with labels.
    """
    e, t = (np.asarray(p.body_echo, np.float64) for p in (ping, truth))
    counts = t > MIN_BODY_SHARE * t.sum()
    if not counts.any():
        return 0.0, 0
    errors = np.where(counts, np.abs(e - t) / np.where(counts, t, 1.0), -1.0)
    worst = int(errors.argmax())
    return float(errors[worst]), worst


@dataclass(frozen=True, eq=False)
class Verification:
    """A ping and its truth, without noise. B beams, K bins."""

    # ping, truth: the ping of `Simulator` and that of `reference_ping`, both with `body_echo`
    ping: Ping
    truth: Ping
    tolerance: float  # the share of the echo that may lie in wrong bins
    error: float  # Σ|E − T| / ΣT
    worst_body_error: float  # the largest relative error of a body's own echo
    worst_body: str  # the name of that body, "" if none counts
    time_ms: float  # median time of `Simulator.ping`, without labels, milliseconds
    reference_s: float  # time of the reference, seconds

    @property
    def kept(self) -> bool:
        """Whether the error is within the tolerance, and that of the worst body within five times as much."""
        return self.error <= self.tolerance and self.worst_body_error <= WORST_BODY * self.tolerance

    @property
    def difference(self) -> float:
        """The difference of the reference's two halves, Σ|A − B| over ΣT."""
        return self.truth.meta["difference"]

    @property
    def certain(self) -> bool:
        """Whether the reference is exact enough: its halves differ by no more than a tenth of the error."""
        return self.difference * AGREEMENT <= self.error


def verify(
    scene: Scene,
    sonar: Sonar,
    pose,
    acoustics: Acoustics | None = None,
    tolerance: float = 0.01,
    sampling: Sampling | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Verification:
    """Judge a ping by the reference, which is refined until its own error is well below the one found.

    Parameters
    ----------
    scene, sonar, acoustics, tolerance, sampling : as for `Simulator`
    pose : (4, 4) world_from_sonar
    progress : as for `reference_ping`; the rays of each refinement are counted from 0

    Raises
    ------
    Error
        as `Simulator` and `reference_ping` do.
    """
    embree_classes()  # refused before the first ping, which compiles for minutes in a new installation
    with Simulator(scene, sonar, acoustics, sampling, tolerance) as simulator:
        ping = simulator.ping(pose, labels=True)
        times_s = []
        for _ in range(N_TIMED):
            start = time.perf_counter()
            simulator.ping(pose)
            times_s.append(time.perf_counter() - start)
    start, error = time.perf_counter(), FIRST_ERROR
    for _ in range(MAX_ROUNDS):
        with warnings.catch_warnings():
            # `Verification.certain` reports too few rays
            warnings.filterwarnings("ignore", "the reference can judge")
            truth = reference_ping(scene, sonar, pose, acoustics, error, progress=progress)
        error = ping_error(ping, truth)
        if truth.meta["difference"] * AGREEMENT <= error or not truth.meta["converged"]:
            break
        # this error holds some of the reference's own: the next will be smaller
        error = float(np.clip(MARGIN * error, 1e-4, 0.5))
    reference_s = time.perf_counter() - start
    worst, number = worst_body(ping, truth)
    return Verification(
        ping=ping,
        truth=truth,
        tolerance=tolerance,
        error=ping_error(ping, truth),
        worst_body_error=worst,
        worst_body=scene.bodies[number - 1].name if number else "",
        time_ms=1e3 * float(np.median(times_s)),
        reference_s=reference_s,
    )


class _Panel(NamedTuple):
    """One of the three parts of the picture: (H, W, 3) uint8 image, title, and a line that explains its colours."""

    image: np.ndarray
    title: str
    scale: str


def error_picture(verification: Verification, height: int) -> np.ndarray:
    """Draw the ping, the reference and their difference side by side, to show where in the fan the error lies.

    Returns (H, W, 3) uint8 RGB; in the difference red is too much echo, blue too little, on a linear scale. `height` is
    that of a fan, pixels.
    """
    v = verification
    strongest = float(v.truth.intensity.max())
    top_db = 10 * np.log10(max(strongest, FAINTEST)) if strongest > 0 else 0.0
    scale = f"from {top_db - SPAN_DB:.0f} dB (blue) to {top_db:.0f} dB (red)"

    def draw(ping: Ping) -> np.ndarray:
        image = fan_image(ping, height, Counts(low_db=top_db - SPAN_DB, high_db=top_db))
        return draw_axes(colorize(image, "jet"), ping)

    n_rays = v.truth.meta["n_rays"]
    return _join(
        [
            _Panel(draw(v.ping), f"fast ping, {v.time_ms:.3g} ms", scale),
            _Panel(draw(v.truth), f"reference, {n_rays / 1e6:.3g} million rays", scale),
            _difference_panel(v, height),
        ]
    )


def _difference_panel(v: Verification, height: int) -> _Panel:
    """Draw the difference, with full colour from a percentile of the errors on."""
    signed = v.ping.intensity.astype(np.float64) - v.truth.intensity
    wrong = np.abs(signed[signed != 0])
    limit = float(np.percentile(wrong, COLOUR_PERCENTILE)) if wrong.size else 1.0
    signed /= limit
    more, less = (
        fan_image(replace(v.ping, intensity=part.clip(0, 1).astype(np.float32)), height, LINEAR)
        for part in (signed, -signed)
    )
    colour = 1 - np.stack([less, np.maximum(more, less), more], axis=-1)
    return _Panel(
        draw_axes(np.rint(255 * colour.clip(0, 1)).astype(np.uint8), v.ping),
        f"difference: {100 * v.error:.2g} % of the echo",
        f"red too much, blue too little; full colour from {limit:.1e} on",
    )


def _join(panels: list[_Panel]) -> np.ndarray:
    """Return the panels side by side below their titles, in letters that fit the widest of them.

    Panels of narrow fans get black margins, so that letters stay large enough to be read.
    """
    font, texts = cv2.FONT_HERSHEY_SIMPLEX, [text for panel in panels for text in (panel.title, panel.scale)]

    def widest(letter: float) -> int:
        return max(cv2.getTextSize(text, font, letter, 1)[0][0] for text in texts)

    width = max(panels[0].image.shape[1], math.ceil(widest(LEAST_LETTER) / 0.94))
    letter = max(LEAST_LETTER, min(1.2, 0.94 * width / widest(1.0)))
    line = round(36 * letter)
    head = np.zeros((round(2.6 * line), len(panels) * width, 3), np.uint8)
    images = []
    for number, panel in enumerate(panels):
        for row, text in enumerate((panel.title, panel.scale)):
            place = (round((number + 0.03) * width), round((row + 1.0) * line))
            cv2.putText(head, text, place, font, letter, (235 - 50 * row,) * 3, 1, cv2.LINE_AA)
        left, odd = divmod(width - panel.image.shape[1], 2)
        images.append(cv2.copyMakeBorder(panel.image, 0, 0, left, left + odd, cv2.BORDER_CONSTANT))
    return np.vstack([head, np.hstack(images)])
