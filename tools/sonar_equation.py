"""Compare the level of a flat floor over range with the sonar equation, term by term.

    python -m tools.sonar_equation

The reverberation level of a floor, received and after the TVG, against that at the first range (Urick,
Principles of Underwater Sound, 3rd ed., 1983, chapters 2 and 8):

    RL(r) = −40 log r − 2 α r + S_b + 10 log A + TVG + 2 B

with Lambert's S_b = 20 log sin(grazing) + const., A = r ΔΨ Δr, TVG = k log r + 2 α_tvg r, and B the one-way
beam pattern at the floor's depression, where the beam is not a box.
"""

from __future__ import annotations

import numpy as np
import trimesh

import sonar_gl as sg
from tests.support.settings import described

RANGES_M, HEIGHT_M, HALF_M = (5.0, 10.0, 20.0, 50.0), 2.0, 400.0
ABSORPTION_DB_M = {450e3: 0.109663, 900e3: 0.299463}  # Francois-Garrison at 10 °C, 35, 0 m, pH 8
ONE_WAY_AT_EDGE_DB = 10 * np.log10(0.5) / 2  # a transmitter and a receiver alike make −3 dB
CASES = {  # name: frequency, elevation aperture, settings
    "no TVG": (450e3, 60.0, {"tvg_k": 0.0, "tvg_absorption_db_m": 0.0}),
    "no TVG, 900 kHz": (900e3, 60.0, {"tvg_k": 0.0, "tvg_absorption_db_m": 0.0}),
    "20 log r + 2αr": (450e3, 60.0, {"tvg_k": 20.0}),
    "30 log r + 2αr": (450e3, 60.0, {"tvg_k": 30.0}),
    "40 log r + 2αr": (900e3, 60.0, {"tvg_k": 40.0}),
    "TVG for fresh water": (900e3, 60.0, {"tvg_k": 30.0, "tvg_absorption_db_m": 0.25}),
    "boxes in azimuth": (900e3, 60.0, {"beam_pattern": "box"}),
    "Taylor, projector": (900e3, 60.0, {"receive_taper": "taylor", "transmit_width_deg": 40.0}),
    "line array upright": (900e3, 30.0, {"elevation_pattern": "line_array"}),
    "line array, no TVG": (
        450e3,
        30.0,
        {"elevation_pattern": "line_array", "tvg_k": 0.0, "tvg_absorption_db_m": 0.0},
    ),
    "Gaussian upright": (450e3, 30.0, {"elevation_pattern": "gaussian", "tvg_k": 40.0}),
}


def expected_db(frequency_hz, aperture_deg, settings) -> np.ndarray:
    """Return the level by the sonar equation at RANGES_M, (4,) dB relative to the first range."""
    r, alpha = np.array(RANGES_M), ABSORPTION_DB_M[frequency_hz]
    sine = HEIGHT_M / r  # of grazing, and of depression
    level = -40 * np.log10(r) - 2 * alpha * r + 20 * np.log10(sine) + 10 * np.log10(r)
    level += settings.get("tvg_k", 20.0) * np.log10(r) + 2 * settings.get("tvg_absorption_db_m", alpha) * r
    share = sine / np.sin(np.radians(aperture_deg / 2))
    pattern = settings.get("elevation_pattern")
    if pattern == "gaussian":
        level += 2 * ONE_WAY_AT_EDGE_DB * share**2
    if pattern == "line_array":
        at_edge = 0.318917  # sinc⁴ of it is 1/2: 0.637833 λ/L wide
        level += 40 * np.log10(np.sinc(at_edge * share))
    return level - level[0]


def measured_db(frequency_hz, aperture_deg, settings) -> np.ndarray:
    """Return the level of a ping's beams, (9, 4) dB, each relative to its first range."""
    bins = 505
    sonar = sg.Sonar("floor", frequency_hz, 9, bins, 45.0, aperture_deg, 2.0, 2.05, 2.05 + 0.1 * bins)
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * HALF_M
    floor = sg.Body("floor", trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False))
    sonar, acoustics = described(sonar, water=sg.Water(depth_m=0.0), **settings)
    with sg.Simulator(sg.Scene([floor]), sonar, acoustics, tolerance=0.003) as simulator:
        ping = simulator.ping(sg.pose(0, 0, HEIGHT_M))
    at = [np.abs(ping.range_m - r).argmin() for r in RANGES_M]
    level = 10 * np.log10(ping.intensity[:, at].astype(float))
    return level - level[:, :1]


def main():
    """Print the table: dB relative to 5 m, of the middle beam and by the sonar equation."""
    print(f"{'':22}" + "".join(f"{f'{r:g} m':>18}" for r in RANGES_M[1:]) + "   worst of all beams")
    for name, case in CASES.items():
        measured, expected = measured_db(*case), expected_db(*case)
        pairs = zip(measured[4, 1:], expected[1:], strict=True)
        worst = np.abs(measured - expected).max()
        print(f"{name:22}" + "".join(f"{m:9.2f} {e:8.2f}" for m, e in pairs) + f"{worst:12.3f} dB")


if __name__ == "__main__":
    main()
