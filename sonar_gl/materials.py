"""What things are made of: materials by name, and how much sound a boundary reflects."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from sonar_gl.types import Error, nearest_names

try:
    import tomllib
except ModuleNotFoundError:  # Python 3.10
    import tomli as tomllib

MATERIALS = Path(__file__).with_name("materials.toml")
WAVENUMBER_RAD_M = 2 * math.pi * 900e3 / 1500  # at which fine roughness parts the lobe from the rest


def rayleigh_reflection(grazing_rad, density_ratio, speed_ratio, loss=0.0):
    """Amplitude reflection coefficient of a plane boundary between water and a fluid; complex.

    R = (m sin g − √(n² − cos² g)) / (m sin g + √(n² − cos² g)), n = (1 + iδ) / speed_ratio.

    Parameters
    ----------
    grazing_rad : g, angle between ray and boundary, 0..π/2; arrays broadcast
    density_ratio : m, of the density below over that of the water; 0 for a vacuum, R = −1
    speed_ratio : likewise of the speeds of sound
    loss : δ, imaginary over real part of the wave number below

    Source: Rayleigh, "The Theory of Sound", vol. 2, 1896; with loss as in APL-UW TR 9407, 1994, ch. IV

    >>> medium_sand = rayleigh_reflection(np.pi / 2, 1.845, 1.1782, 0.01624)
    >>> round(float(20 * np.log10(abs(medium_sand))), 2)
    -8.64
    """
    n = (1 + 1j * np.asarray(loss, np.float64)) / np.asarray(speed_ratio, np.float64)
    sine = np.maximum(np.sin(grazing_rad), 1e-9)  # at 0 the limit: of like speeds, it would be 0 / 0
    below = np.sqrt(n**2 - 1 + sine**2)  # of both roots the one that falls off downwards
    above = np.asarray(density_ratio, np.float64) * sine
    return (above - below) / (above + below)


def coherent_loss(grazing_rad, roughness_m, wavenumber_rad_m):
    """What roughness leaves of the amplitude that a mirror would reflect, 0..1: exp(−2 (k σ sin g)²).

    Parameters
    ----------
    grazing_rad : g, angle between ray and boundary, 0..π/2; arrays broadcast
    roughness_m : σ, rms height, metres
    wavenumber_rad_m : k, 2π over the wavelength

    Source: Eckart, "The scattering of sound from the sea surface", J. Acoust. Soc. Am. 25, 566-570, 1953

    >>> k = 2 * np.pi * 900e3 / 1500
    >>> round(float(20 * np.log10(coherent_loss(np.radians(10), 0.5e-3, k))), 2)
    -1.86
    """
    sigma, k = np.asarray(roughness_m, np.float64), np.asarray(wavenumber_rad_m, np.float64)
    return np.exp(-2 * (k * sigma * np.sin(grazing_rad)) ** 2)


@dataclass(frozen=True)
class Material:
    """What a body or a boundary is made of. What is not known is None.

    `reflectivity` and `specular` together are the intensity |R|² that it reflects at normal incidence: fine
    roughness takes its share out of the lobe and scatters it all round.

    Attributes
    ----------
    name : of the table
    density_ratio, speed_ratio, loss : of `rayleigh_reflection`
    reflectivity : μ of the diffuse echo, 0..1: all of |R|² where the surface is rough
    specular : strength of the lobe, 0..1; 0 where the surface is rough
    roughness_rad : rms slope of the facets that make the lobe, along any one direction
    source : where the numbers come from
    """

    name: str
    density_ratio: float | None
    speed_ratio: float | None
    loss: float | None
    reflectivity: float
    specular: float
    roughness_rad: float | None
    source: str = ""


def material(name: str) -> Material:
    """A material by name; case, and spaces or hyphens for underscores, do not matter.

    Raises
    ------
    Error
        if there is none of that name.

    >>> material("medium sand").density_ratio
    1.845
    """
    known = materials()
    if not isinstance(name, str):
        raise Error(f"a material must be a name (got {name!r}; such as {next(iter(known))!r})")
    key = "_".join(name.casefold().replace("-", " ").replace("_", " ").split())
    if key not in known:
        raise Error(f"unknown material (got {name!r}; {nearest_names(key, known)})")
    return known[key]


def materials() -> dict[str, Material]:
    """All materials, by name; other names of one lead to it, too."""
    return dict(_materials())


@lru_cache(maxsize=1)
def _materials() -> dict[str, Material]:
    tables = tomllib.loads(MATERIALS.read_text(encoding="utf-8"))
    made = {name: _made(name, table) for name, table in tables.items() if "same_as" not in table}
    return {name: made[table.get("same_as", name)] for name, table in tables.items()}


def _made(name: str, table: dict) -> Material:
    """A material of its table."""
    density, speed = table.get("density_ratio"), table.get("speed_ratio")
    loss = None if density is None else table.get("loss", 0.0)
    if density is None:
        z = table["impedance_ratio"]
        reflected = ((z - 1) / (z + 1)) ** 2
    else:
        reflected = abs(complex(rayleigh_reflection(np.pi / 2, density, speed, loss))) ** 2
    kept, height = 0.0, table.get("height_m")
    if height is not None:
        kept = float(coherent_loss(np.pi / 2, height, WAVENUMBER_RAD_M)) ** 2
    diffuse, specular = reflected * (1 - kept), reflected * kept
    slope = table.get("roughness_rad")
    return Material(name, density, speed, loss, diffuse, specular, slope, table["source"])
