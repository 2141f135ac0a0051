"""How far a ping is from the truth: numbers and a picture."""

from __future__ import annotations

import time
import warnings
from dataclasses import dataclass, replace

import cv2
import numpy as np

from sonar_gl.axes import draw_axes
from sonar_gl.image import colorize, fan_image
from sonar_gl.reference import AGREEMENT, HEARD, WORST_BODY, reference_ping
from sonar_gl.simulator import Simulator
from sonar_gl.types import Ping

TIMED = 9  # pings, of which the median is given
FIRST_ERROR = 0.05  # judged first; the error found then says how exact the truth must be
MARGIN = 0.8
ROUNDS = 3  # of finding the error and refining the truth to judge it
COLOUR_PERCENTILE = 99  # of the bins that are wrong, in full colour from there on
SPAN_DB = 50.0  # of the fan images


def ping_error(ping: Ping, truth: Ping) -> float:
    """The share of the echo that lies in wrong bins: Σ|E − T| / ΣT over beams and bins.

    0 where both are empty, infinite where only the truth is.
    """
    e, t = (np.asarray(p.intensity, np.float64) for p in (ping, truth))
    wrong, whole = np.abs(e - t).sum(), t.sum()
    if whole > 0:
        return float(wrong / whole)
    return float("inf") if wrong > 0 else 0.0


def worst_body(ping: Ping, truth: Ping) -> tuple[float, int]:
    """The largest relative error of a body's own echo, and that body's number; (0, 0) if no body counts.

    Only bodies that return more than a thousandth of the true echo are looked at. Both pings must have
    `body_echo`, as with labels.
    """
    e, t = (np.asarray(p.body_echo, np.float64) for p in (ping, truth))
    counts = t > HEARD * t.sum()
    if not counts.any():
        return 0.0, 0
    errors = np.where(counts, np.abs(e - t) / np.where(counts, t, 1.0), -1.0)
    worst = int(errors.argmax())
    return float(errors[worst]), worst


@dataclass(frozen=True, eq=False)
class Verification:
    """A ping beside the truth, noise off. B beams, K bins.

    Attributes
    ----------
    ping, truth : the two, with labels' `body_echo`
    tolerance : that was asked for
    error : Σ|E − T| / ΣT
    worst_body_error, worst_body : of `worst_body`; the body's name, "" if none counts
    time_ms : median of a whole `Simulator.ping`, without labels, milliseconds
    reference_s : time of the reference, seconds
    """

    ping: Ping
    truth: Ping
    tolerance: float
    error: float
    worst_body_error: float
    worst_body: str
    time_ms: float
    reference_s: float

    @property
    def kept(self) -> bool:
        """Whether the error is within the tolerance, and the worst body's within five times it."""
        return self.error <= self.tolerance and self.worst_body_error <= WORST_BODY * self.tolerance

    @property
    def difference(self) -> float:
        """How far the two halves of the reference are apart, Σ|A − B| over ΣT."""
        return self.truth.meta["difference"]

    @property
    def certain(self) -> bool:
        """Whether the reference is exact enough: its halves differ by no more than a tenth of the error."""
        return self.difference * AGREEMENT <= self.error

    @property
    def wrong(self) -> np.ndarray:
        """(B, K) float64, |E − T|."""
        return np.abs(self.ping.intensity.astype(np.float64) - self.truth.intensity)


def verify(scene, sonar, pose, acoustics=None, tolerance=0.01, sampling=None) -> Verification:
    """A fast ping judged by the reference, which is refined until its own error is well below that found.

    Parameters
    ----------
    scene, sonar, acoustics, tolerance, sampling : as for `Simulator`; pose : (4, 4) world_from_sonar

    Raises
    ------
    Error
        as `Simulator` and `reference_ping` do.
    """
    with Simulator(scene, sonar, acoustics, sampling, tolerance) as simulator:
        ping = simulator.ping(pose, labels=True)
        times_s = []
        for _ in range(TIMED):
            start = time.perf_counter()
            simulator.ping(pose)
            times_s.append(time.perf_counter() - start)
    start, error = time.perf_counter(), FIRST_ERROR
    for _ in range(ROUNDS):
        with warnings.catch_warnings():
            # too few rays are told by `certain`
            warnings.filterwarnings("ignore", "the reference can judge")
            truth = reference_ping(scene, sonar, pose, acoustics, error)
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


def error_picture(verification: Verification, height: int = 800) -> np.ndarray:
    """Where in the fan the error sits: the fast ping, the reference and their difference, side by side.

    Parameters
    ----------
    height : of a fan, pixels

    Returns
    -------
    (H, W, 3) uint8 RGB; in the difference red is too much echo, blue too little, on a linear scale
    """
    v, panels = verification, []
    loudest = float(v.truth.intensity.max())
    top_db = 10 * np.log10(loudest) if loudest > 0 else 0.0
    scale = f"from {top_db - SPAN_DB:.0f} dB (blue) to {top_db:.0f} dB (red)"
    for ping, title in (
        (v.ping, f"fast ping, {v.time_ms:.3g} ms"),
        (v.truth, f"reference, {v.truth.meta['n_rays'] / 1e6:.3g} million rays"),
    ):
        image = fan_image(ping, height, "db", (top_db - SPAN_DB, top_db))
        panels.append((draw_axes(colorize(image, "jet"), ping), title, scale))
    wrong = v.wrong[v.wrong > 0]
    limit = float(np.percentile(wrong, COLOUR_PERCENTILE)) if wrong.size else 1.0
    signed = (v.ping.intensity.astype(np.float64) - v.truth.intensity) / limit
    more, less = (
        fan_image(replace(v.ping, intensity=part.clip(0, 1).astype(np.float32)), height, "linear")
        for part in (signed, -signed)
    )
    colour = 1 - np.stack([less, np.maximum(more, less), more], axis=-1)
    picture = draw_axes(np.rint(255 * colour.clip(0, 1)).astype(np.uint8), v.ping)
    title = f"difference: {100 * v.error:.2g} % of the echo"
    panels.append(
        (
            picture,
            title,
            f"red too much, blue too little; in full at {limit:.1e}, percentile {COLOUR_PERCENTILE}",
        )
    )
    width = panels[0][0].shape[1]
    font, widest = cv2.FONT_HERSHEY_SIMPLEX, 0.0
    for _, *lines in panels:
        widest = max(widest, *(cv2.getTextSize(text, font, 1.0, 1)[0][0] for text in lines))
    letter = min(1.2, 0.94 * width / widest)
    line = round(36 * letter)
    head = np.zeros((round(2.6 * line), 3 * width, 3), np.uint8)
    for number, (_, *lines) in enumerate(panels):
        for row, text in enumerate(lines):
            place = (round((number + 0.03) * width), round((row + 1.0) * line))
            cv2.putText(head, text, place, font, letter, (235 - 50 * row,) * 3, 1, cv2.LINE_AA)
    return np.vstack([head, np.hstack([picture for picture, *_ in panels])])
