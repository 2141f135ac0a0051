"""Labels that noise hides: those of bins whose body has a weaker echo than the receiver's noise, in the mean."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numba import uint64

from sonar_gl.core.compiled import compiled
from sonar_gl.ping import BIN_LABELS, Ping

COMPILED_FOR = np.uint16, np.float32  # the types of a ping's labels; NumPy takes three times as long


def without_hidden_labels(ping: Ping, power: np.ndarray | None) -> Ping:
    """Return the ping without the labels of bins in which the body's mean echo is weaker than the receiver's noise.

    Shadows and sums of bodies stay. The echo of a body is its share of the bin's, or all of it where shares are not
    known. The mean power decides, whatever the noise of a ping is: labels do not depend on its seed.

    Returns `ping` itself if no bin is hidden; if its `meta` does not say "labels_above_noise", as where the level
    of labels was stated; or if it has noise, so that its mean echo is not known.

    ping : Ping, to which no noise was added
    power : mean power of the receiver's noise, shape that broadcasts to (B, K), as of `receiver_power`; None for
        no such noise
    """
    if power is None or not ping.meta.get("labels_above_noise") or "noise" in ping.meta:
        return ping
    own = ping.intensity if ping.share is None else ping.share * ping.intensity
    is_hidden = own < power
    if not is_hidden.any():
        return ping
    arrays = {name: getattr(ping, name) for name in BIN_LABELS if name != "shadow"}
    found = {name: array for name, array in arrays.items() if array is not None}
    return replace(
        ping, **{name: _without(array, is_hidden, BIN_LABELS[name]) for name, array in found.items()}
    )


def _without(array: np.ndarray, is_hidden: np.ndarray, empty: float) -> np.ndarray:
    """Return a label of bins, (B, K), with `empty` where `is_hidden`; read-only."""
    empty = array.dtype.type(empty)
    if array.dtype in COMPILED_FOR:
        array, out = np.ascontiguousarray(array).view(), np.empty(array.shape, array.dtype)
        array.setflags(write=False)  # Numba compiles anew for one that is not
        _copy_without(array, is_hidden, empty, out)
    else:
        out = np.where(is_hidden, empty, array)
    out.setflags(write=False)
    return out


@compiled
def _copy_without(array, is_hidden, empty, out):
    """Copy `array` to `out`, but `empty` where `is_hidden`; all (B, K)."""
    for b in range(uint64(array.shape[0])):
        for k in range(uint64(array.shape[1])):
            out[b, k] = empty if is_hidden[b, k] else array[b, k]
