"""A noisy ping from one without noise: all noise terms in their order."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sonar_gl.core.checks import check_whole_number
from sonar_gl.core.worker import SecondThread
from sonar_gl.noise.field import FieldNoise
from sonar_gl.noise.gaussian import add_normal
from sonar_gl.noise.hidden_labels import without_hidden_labels
from sonar_gl.noise.random_streams import stream
from sonar_gl.noise.reception import receiver_of
from sonar_gl.noise.settings import Noise
from sonar_gl.ping import NOISE_PARTS, Ping


def add_noise(
    ping: Ping, noise: Noise | None, seed: int, ping_number: int = 0, thread: SecondThread | None = None
) -> Ping:
    """Return the ping with noise, and with a record of it in `meta`.

    Labels go where the mean noise of the receiver is stronger than the mean echo of the body, as
    `without_hidden_labels` says.

    Parameters
    ----------
    ping : speckle spares its `coherent` echo, texture has its `texture_deviation`, and the scatterers of its `volume`
        show one by one; the beam width of its `sonar` correlates the fields of overlapping beams, and its
        `bandwidth_hz` and `pulse_taper` those of bins if its `acoustics` have a pulse; without them beams or bins are
        independent. A ping of `Simulator.ping` without noise, or of an NPZ, has none of the three parts: all of its
        echo has fully developed speckle. To a noisy ping, noise is added as to an echo
    noise : amounts; None for no noise
    seed, ping_number : whole numbers, 0 or more; the same two give the same bytes
    thread : does a part of the work beside the caller, with the same bytes

    Returns
    -------
    Ping with (B, K) float32 intensity, not negative; `ping` itself if no term acts on it

    Raises
    ------
    Error
        if a seed is no whole number, or a term needs a sonar or a pose that the ping lacks.
    """
    seed, ping_number = check_whole_number("seed", seed), check_whole_number("ping_number", ping_number)
    if noise is None or not (noise.acts_on_field or noise.acts_on_bins):
        return ping
    if noise.acts_on_field:
        out = FieldNoise(ping, noise, seed, ping_number, thread).noisy()
    else:
        out = np.array(ping.intensity, dtype=np.float32, order="C")
    receiver = receiver_of(ping, noise)
    if receiver.ring_down is not None:
        out += receiver.ring_down
    if noise.gaussian:
        add_normal(stream(seed, ping_number, "gaussian"), noise.gaussian, out)
    if noise.median:
        import cv2  # slow to import and rarely needed

        out = cv2.medianBlur(out, int(noise.median))
    if noise.salt_and_pepper:  # after the median filter, which would remove it; as in the founding paper
        uniform = stream(seed, ping_number, "salt_and_pepper").random(out.shape, dtype=np.float32)
        out[uniform < noise.salt_and_pepper / 2] = 0.0
        out[uniform >= 1 - noise.salt_and_pepper / 2] = 1.0
    if noise.dropped_beams:
        out[stream(seed, ping_number, "dropped_beams").random(len(out)) < noise.dropped_beams] = 0.0
    out.setflags(write=False)
    # as asdict, in a twentieth of its time
    record = {"noise": dict(vars(noise)), "seed": seed, "ping_number": ping_number}
    labelled = without_hidden_labels(ping, receiver.receiver_power)
    return replace(labelled, intensity=out, **dict.fromkeys(NOISE_PARTS), meta={**ping.meta, **record})


def mean_intensity(ping: Ping, noise: Noise) -> np.ndarray:
    """Return the mean intensity of many pings with this noise, (B, K) float64: the echo, and what the receiver adds.

    Speckle has the mean 1. Terms of single bins and interference are left out. Parameters and errors are those of
    `add_noise`.
    """
    receiver = receiver_of(ping, noise)
    added = (power for power in (receiver.receiver_power, receiver.ring_down) if power is not None)
    return sum(added, start=np.asarray(ping.intensity, np.float64))
