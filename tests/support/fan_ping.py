"""Pings without a sonar, to draw fan images of."""

import numpy as np

from sonar_gl.ping import Ping


def fan_ping(fov_deg=90.0, n_beams=128, n_bins=200, range_m=(0.0, 20.0), azimuth_rad=None, fill=0.0) -> Ping:
    """Return a ping whose intensity is `fill`; beams are even, or at `azimuth_rad`."""
    if azimuth_rad is None:
        azimuth_rad = np.radians(fov_deg * ((np.arange(n_beams) + 0.5) / n_beams - 0.5))
    edges_m = np.linspace(*range_m, n_bins + 1)
    intensity = np.full((len(azimuth_rad), n_bins), fill, np.float32)
    meta = {"bin_size_m": float(edges_m[1] - edges_m[0])}
    range_m = (edges_m[1:] + edges_m[:-1]) / 2
    return Ping(intensity, np.asarray(azimuth_rad), range_m, pose=np.eye(4), meta=meta)
