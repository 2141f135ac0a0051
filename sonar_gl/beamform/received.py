"""Which samples of a fan some beam receives."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from sonar_gl.beamform.kernels.body_counts import ReceivedParts
from sonar_gl.sonar.sector import NO_UPRIGHTS, Sector


def received_u(sector: Sector, received: np.ndarray) -> np.ndarray:
    """Return (2n,) u between which the samples lie that upright strips take.

    A strip narrower than a sample takes the nearest one.

    received : bool of each column, whether a beam receives it
    """
    strips = sector.strips
    is_received = received[strips.column]
    if not is_received.any():
        return np.full(2, np.inf)
    middles, widths = strips.middle[is_received], strips.width[is_received]
    order = np.argsort(middles)
    half_width = np.maximum(widths, sector.u[1])[order] / 2
    low, high = middles[order] - half_width, np.maximum.accumulate(middles[order] + half_width)
    begins = np.append(True, low[1:] > high[:-1] + 1e-3 * sector.u[1])
    return np.column_stack([low[begins], high[np.append(begins[1:], True)]]).ravel()


def received_parts(sectors: Sequence[Sector], intervals_u: Sequence[np.ndarray]) -> ReceivedParts:
    """Return the parts of sectors that beams receive; intervals_u : `Beamformer.received_u`."""
    # in gaps between boxes no strip counts: what the strips take of a sample beside one is not known
    uprights = [
        NO_UPRIGHTS if len(u) else one.strips.uprights for one, u in zip(sectors, intervals_u, strict=True)
    ]
    return ReceivedParts(
        np.array([one.strips.sines for one in sectors]),
        np.array([math.tan(one.half_width_rad) for one in sectors]),
        _begins(intervals_u),
        np.concatenate(intervals_u),
        _begins([one.middle for one in uprights]),
        np.concatenate([one.middle for one in uprights]),
        np.concatenate([one.end for one in uprights]),
    )


def _begins(arrays: Sequence[np.ndarray]) -> np.ndarray:
    """Return where each of some arrays begins in all of them one after the other, and where the last one ends."""
    return np.cumsum([0, *map(len, arrays)])
