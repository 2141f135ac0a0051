"""Levels of simulated echoes in dB re 1 µPa, by the active sonar equation."""

import numpy as np
import pytest
import trimesh

import sonar_gl as sg
from sonar_gl.noise.receiver import absolute_levels

RADIUS_M, REFLECTIVITY = 0.02, 0.5


@pytest.mark.parametrize(
    ("name", "beam", "settings"),
    [
        ("p900-45", 60, {"tvg_k": 40.0, "tvg_absorption_db_m": 0.1}),
        pytest.param(
            "p900-45", 128, {"beam_pattern": "box", "elevation_pattern": "box"}, marks=pytest.mark.slow
        ),
        pytest.param("gemini-720im", 5, {}, marks=pytest.mark.slow),
        pytest.param("p900-45,transmit_width_deg=60", 128, {}, marks=pytest.mark.slow),
        *(
            pytest.param(*one, marks=pytest.mark.slow)
            for one in (("p900-45", 128, {}), ("gemini-720im,steered=straight", 0, {}))
        ),
    ],
)
def test_a_diffuse_sphere_has_the_level_of_the_sonar_equation(name, beam, settings):
    """EL = SL + TS − 40 log r − 2αr, TS = 10 log(2 μ a² / 3) of a Lambert sphere, by the levels of the beam."""
    sonar = sg.load_sonar(f"{name},source_level_db=205").with_range(12.0)
    acoustics, r = sg.Acoustics.physical(**settings), 10.0
    azimuth = sonar.azimuth_rad[beam]
    place = sg.pose(r * np.cos(azimuth), r * np.sin(azimuth), 0)
    sphere = sg.Body("sphere", trimesh.creation.icosphere(4, RADIUS_M), place, reflectivity=REFLECTIVITY)
    with sg.Simulator(sg.Scene([sphere]), sonar, acoustics, tolerance=0.005) as simulator:
        ping = simulator.ping(sg.pose())
    received = ping.intensity[beam] / ping.acoustics.tvg(ping.range_m, ping.sonar)
    level_db = absolute_levels(sonar, acoustics, beam).echo_level_db + 10 * np.log10(received.sum())
    alpha_db_m, transmit = ping.meta["absorption_db_m"], acoustics.transmit_pattern(sonar)
    expected_db = (
        205 + 10 * np.log10(2 / 3 * REFLECTIVITY * RADIUS_M**2) - 40 * np.log10(r) - 2 * alpha_db_m * r
    )
    if transmit is not None:
        expected_db += 10 * np.log10(transmit(azimuth))
    # A sphere of a quarter of a degree fills so much of a beam of 1 degree that the pattern takes 0.03 dB; it returns
    # its echo from 1 cm before its middle in the mean, 0.02 dB; the tolerance of the samples is 0.02 dB.
    assert level_db == pytest.approx(expected_db, abs=0.06)
