"""Print what effects that the model leaves out would change in bundled scenes.

    python -m tools.docs.unmodelled            # all; some minutes
    python -m tools.docs.unmodelled sediment   # of sediment and reflectors: those that are named

sediment   Roughness and volume backscatter of sea floors by APL-UW TR 9407, 1994, ch. IV, in place of Lambert's law:
           Kirchhoff's approximation near the vertical, down to the angle that the table names, small roughness
           elsewhere, and the sediment's volume. Without its averages over slopes and shadows of large roughness,
           which matter below 10 degrees. Bins whose strongest body is a sea floor get the echo of its law at the
           mean incidence that their labels have.
reflectors Paths over two planar reflectors, one on the way out and another one on the way back, or both on one way,
           by brute force: rays are reflected where they meet a reflector, and each place that they reach is joined
           to the sonar's images. The first line of a scene has paths over one reflector by the same rays, beside
           the simulator's, which judges the rays.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

import sonar_gl as sg
from sonar_gl.acoustics.boundary import rayleigh_reflection, sediment_backscattering
from sonar_gl.analysis.terms import changed_bins, differs
from sonar_gl.scene.materials import material
from tools.bench import harness
from tools.docs import ablation
from tools.docs.two_reflectors import TwoReflectors

SONAR, TOLERANCE = "p900-45", 0.01
GRAZING_DEG = (5, 10, 20, 30, 45, 60, 75, 85)
# TR 9407, ch. IV, table 2: strength w2 of the roughness spectrum, cm^4, and volume parameter sigma2
SEDIMENTS = {"medium_sand": (0.004446, 0.002), "medium_silt": (0.000518, 0.001), "clay": (0.000518, 0.001)}
SPECTRAL_EXPONENT = 3.25  # of the roughness of all sediments
KIRCHHOFF_ENDS_DB = 15.0  # below its largest value, where small roughness takes over
# of means that labels have: nearer to grazing Lambert's law goes to zero
GREATEST_INCIDENCE_RAD = math.radians(88.0)
RAYS = 2_000_000
SOUND_SPEED_M_S = 1500.0


def floor_backscattering(name: str, grazing_rad, frequency_hz: float):
    """Return the backscattering cross section of a sea floor per area and steradian, by TR 9407.

    Parameters
    ----------
    name : of SEDIMENTS
    grazing_rad : array, above 0..π/2

    >>> round(float(10 * np.log10(floor_backscattering("medium_sand", np.pi / 6, 100e3))), 1)
    -21.8
    """
    g, known = np.asarray(grazing_rad, np.float64), material(name)
    w2, sigma2 = SEDIMENTS[name]
    k_cm = 2 * math.pi * frequency_hz / SOUND_SPEED_M_S / 100  # the spectrum is in centimetres
    rho, nu, delta, gamma = known.density_ratio, known.speed_ratio, known.loss, SPECTRAL_EXPONENT
    kappa = (1 + 1j * delta) / nu
    p = np.sqrt(kappa**2 - np.cos(g) ** 2)
    y = ((rho - 1) ** 2 * np.cos(g) ** 2 + rho**2 - kappa**2) / (rho * np.sin(g) + p) ** 2
    spectrum = w2 * np.maximum(2 * k_cm * np.cos(g), 1e-3) ** -gamma
    small = 4 * k_cm**4 * np.sin(g) ** 4 * np.abs(y) ** 2 * spectrum

    rough, ends = kirchhoff(name, frequency_hz)
    share = 1 / (1 + np.exp(80 * (np.cos(g) - np.cos(ends))))
    return share * rough(g) + (1 - share) * small + sediment_backscattering(g, rho, nu, delta, sigma2)


def kirchhoff(name: str, frequency_hz: float) -> tuple[Callable, float]:
    """Return Kirchhoff's cross section of a sea floor by grazing angle, radians, and the angle at which it ends."""
    known, w2, of = material(name), SEDIMENTS[name][0], math.gamma
    k_cm = 2 * math.pi * frequency_hz / SOUND_SPEED_M_S / 100
    alpha = SPECTRAL_EXPONENT / 2 - 1
    a = 8 * alpha**2 * of(0.5 + 0.5 / alpha) / (of(0.5) * of(1 / alpha) * of(0.5 / alpha))
    a = a ** (2 * alpha)
    b = a ** (0.5 + 0.5 / alpha) * of(1 / alpha) / (2 * alpha)
    structure = 2 * math.pi * w2 * of(2 - alpha) * 2 ** (-2 * alpha) / (alpha * (1 - alpha) * of(1 + alpha))
    q = structure * 2 ** (1 - 2 * alpha) * k_cm ** (2 * (1 - alpha))
    vertical = abs(
        complex(rayleigh_reflection(math.pi / 2, known.density_ratio, known.speed_ratio, known.loss))
    )

    def rough(g):
        falls = (np.cos(g) ** (4 * alpha) + a * q**2 * np.sin(g) ** 4) ** ((1 + alpha) / (2 * alpha))
        return b * q * vertical**2 / (8 * math.pi * falls)

    angles = np.linspace(0, math.pi / 2, 4001)
    levels = rough(angles)
    return rough, angles[np.argmax(levels > levels.max() * 10 ** (-KIRCHHOFF_ENDS_DB / 10))]


def lambert_backscattering(name: str, grazing_rad):
    """Return what the project takes: μ sin² g / π."""
    return material(name).reflectivity * np.sin(grazing_rad) ** 2 / math.pi


def labelled_ping(name: str) -> tuple:
    """Return the scene and a ping of it with labels."""
    scene, sonar = ablation.setting(name)
    sonar = sg.load_sonar(SONAR).with_range(sonar.range_max_m)
    with sg.Simulator(scene, sonar, sg.Acoustics.physical(), tolerance=TOLERANCE) as simulator:
        return scene, simulator.ping(scene.sonar_pose, labels=True, label_level_db=-180.0)


def changes(full, changed, sonar) -> dict[str, str]:
    """Return the change of an image as columns of a table, in the two measures of `plan`."""
    share, _ = differs(full, changed)
    return {
        "change of the image": f"{share:.2%}",
        "bins > 3 dB": f"{changed_bins(full, changed, sonar.counts):.2%}",
    }


# ---- sediment ----------------------------------------------------------------------------------------


def print_sediment() -> None:
    """Print both laws by grazing angle, and what the one in place of the other changes."""
    print("sediment: backscattering strength, dB, by grazing angle in degrees")
    g = np.radians(GRAZING_DEG)
    rows = []
    for name in SEDIMENTS:
        laws, ends = {"Lambert": lambert_backscattering(name, g)}, {"Lambert": "-"}
        for frequency_hz in (100e3, 900e3):
            law = f"TR 9407, {frequency_hz / 1e3:g} kHz"
            laws[law] = floor_backscattering(name, g, frequency_hz)
            ends[law] = f"{np.degrees(kirchhoff(name, frequency_hz)[1]):.0f}"
        for law, sigma in laws.items():
            levels = {
                f"{angle}": f"{10 * np.log10(one):.1f}" for angle, one in zip(GRAZING_DEG, sigma, strict=True)
            }
            rows.append({"floor": name, "law": law, **levels, "Kirchhoff from": ends[law]})
    harness.print_table(rows)
    rows = []
    for name in ablation.SCENES:
        scene, ping = labelled_ping(name)
        changed, of_floors = ping.intensity.astype(np.float64), 0.0
        for number, body in enumerate(scene.bodies, 1):
            if body.material in SEDIMENTS:
                mine = ping.body_id == number
                of_floors += ping.intensity[mine].sum() / ping.intensity.sum()
                grazing = np.pi / 2 - np.minimum(
                    ping.incidence_rad[mine].astype(np.float64), GREATEST_INCIDENCE_RAD
                )
                law = floor_backscattering(body.material, grazing, ping.sonar.frequency_hz)
                changed[mine] *= law / lambert_backscattering(body.material, grazing)
        columns = {"scene": name, "echo of sea floors": f"{of_floors:.2%}"}
        rows.append(columns | changes(ping.intensity, changed, ping.sonar))
    harness.print_table(rows)


# ---- reflectors --------------------------------------------------------------------------------------


def print_reflectors() -> None:
    """Print what paths over two reflectors return, beside those over one."""
    print(f"reflectors: box beams in azimuth, no pulse, {RAYS / 1e6:g} million rays")
    rows = []
    for name in ablation.SCENES:
        scene, sonar = ablation.setting(name)
        plain = sg.Acoustics.physical(beam_pattern="box", transmit_beam=False, pulse=False, specular=False)
        images = {}
        for multipath in ("none", "incoherent"):
            acoustics = replace(plain, multipath=multipath, bubbles=False)
            with sg.Simulator(scene, sonar, acoustics, tolerance=TOLERANCE) as simulator:
                images[multipath] = simulator.ping(scene.sonar_pose).intensity.astype(np.float64)
        one, two = TwoReflectors(scene, sonar, plain).ping(RAYS)
        full = images["incoherent"]
        by_simulator = full.sum() - images["none"].sum()
        for what, image in (("one", one), ("two", two)):
            columns = {
                "scene": name,
                "reflectors on the path": what,
                "share of the echo": f"{image.sum() / full.sum():.2%}",
                "by the simulator": f"{by_simulator / full.sum():.2%}" if what == "one" else "-",
            }
            more = images["none"] + one if what == "one" else full + two
            rows.append(columns | changes(more, images["none"] if what == "one" else full, sonar))
    harness.print_table(rows)


STUDIES = {"sediment": print_sediment, "reflectors": print_reflectors}


def main():
    """Print the studies that are named."""
    parser = argparse.ArgumentParser(
        prog="python -m tools.docs.unmodelled", description=__doc__.partition("\n")[0]
    )
    parser.add_argument("studies", nargs="*", metavar="study", help=f"of {', '.join(STUDIES)}; default: all")
    named = parser.parse_args().studies or list(STUDIES)
    for name in named:
        if name not in STUDIES:
            parser.error(f"no study {name!r} (of {', '.join(STUDIES)})")
    print(f"{SONAR}, tolerance {TOLERANCE:.0%}")
    for name in named:
        STUDIES[name]()


if __name__ == "__main__":
    main()
