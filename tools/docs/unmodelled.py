"""Estimate what two effects that the model leaves out would change in bundled scenes, from closed forms.

    python -m tools.docs.unmodelled

cones      A line array receives along cones about its axis: what lies at azimuth ψ and elevation ε is shown at
           asin(sin ψ cos ε), as it measures the cosine of the angle to its axis (Van Trees, Optimum Array
           Processing, 2002, ch. 2). Each bin's echo is taken at the mean elevation that its label has.
two planes A path over two planar reflectors loses as much as a path over one, and once more by the reflection at the
           other: the level of multipath times |R|² of the second strongest reflector, at a grazing angle of
           half the aperture in elevation. This is an order of magnitude: it counts every such path as open,
           within the range and within the aperture.
"""

from __future__ import annotations

import numpy as np

import sonar_gl as sg
from sonar_gl.scene.reflectors import planar_reflectors
from tools.bench import harness

SCENES = {"pylon": 30.0, "diver": 10.0, "ocean_floor": 30.0}  # range, metres
SONAR, TOLERANCE = "p900-45", 0.01
EDGE_DEG, ELEVATION_DEG = 60.0, 10.0  # of the example: a wide fan, and half an aperture of 20 degrees


def cone_azimuth(azimuth_rad, elevation_rad):
    """Return the azimuth at which a line array shows what lies at an azimuth and elevation, radians.

    >>> round(float(np.degrees(cone_azimuth(np.radians(60.0), np.radians(10.0)))), 2)
    58.53
    """
    return np.arcsin(np.sin(azimuth_rad) * np.cos(elevation_rad))


def estimates_of(name: str) -> dict[str, str]:
    """Return the estimates of one scene as a row of a table."""
    scene, sonar = sg.load_scene(name), sg.load_sonar(SONAR).with_range(SCENES[name])
    totals = {}
    for multipath in ("none", "incoherent"):
        with sg.Simulator(
            scene, sonar, sg.Acoustics.physical(multipath=multipath), tolerance=TOLERANCE
        ) as sim:
            ping = sim.ping(scene.sonar_pose, labels=True)
        totals[multipath] = float(ping.intensity.sum(dtype=np.float64))
    labelled = ping.body_id > 0
    azimuth = np.broadcast_to(ping.azimuth_rad[:, None], labelled.shape)[labelled]
    elevation, echo = ping.elevation_rad[labelled].astype(np.float64), ping.intensity[labelled]
    moved_deg = np.degrees(np.abs(azimuth - cone_azimuth(azimuth, elevation)))
    far = np.average(moved_deg > sonar.beam_width_deg / 2, weights=echo)
    more = totals["incoherent"] / totals["none"] - 1
    wavenumber = 2 * np.pi * sonar.frequency_hz / sg.Acoustics.physical().water.sound_speed()
    tables = [one.reflection_coefficient for one in planar_reflectors(scene, wavenumber)]
    sine = np.sin(np.radians(sonar.elevation_fov_deg / 2))  # of the grazing angle
    strengths = [np.interp(sine, np.linspace(0, 1, len(table)), table) for table in tables]
    second = sorted([0.0, 0.0, *strengths])[-2]
    return {
        "scene": name,
        "cones: echo moves by, deg": f"{np.average(moved_deg, weights=echo):.3f}",
        "most": f"{moved_deg.max():.2f}",
        "echo moved > half a beam": f"{far:.2%}",
        "multipath over one": f"{more:.2%}",
        "second |R|^2": f"{second:.3f}",
        "over two": f"{more * second:.2%}",
    }


def main():
    """Print the estimates."""
    edge, elevation = np.radians([EDGE_DEG, ELEVATION_DEG])
    at = np.degrees(np.arcsin(np.sin(edge) / np.cos(elevation)))
    print(
        f"cones: what is shown at {EDGE_DEG:g} deg lies at {at:.1f} deg, if its elevation is {ELEVATION_DEG:g} deg"
    )
    print(f"{SONAR}, tolerance {TOLERANCE:.0%}")
    harness.print_table([estimates_of(name) for name in SCENES])


if __name__ == "__main__":
    main()
