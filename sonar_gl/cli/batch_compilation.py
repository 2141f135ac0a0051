"""Compilation of the functions of batches, whose modules need the extra `batch`."""

from __future__ import annotations

import numpy as np

from sonar_gl.batch.schema import bin_layers
from sonar_gl.ping import Ping


def encode_layers(ping: Ping) -> None:
    for layer in bin_layers(("elevation", "range", "share"), ping.sonar, ping.acoustics, 8, 9, 9):
        layer.values(ping, np.zeros(9, np.uint8), 0)
