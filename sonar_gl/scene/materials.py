"""Materials by name: their acoustic properties, and the strength of their echo."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from sonar_gl.acoustics.boundary import coherent_loss, rayleigh_reflection, sediment_backscattering
from sonar_gl.core.checks import shown
from sonar_gl.core.errors import Error, nearest_names
from sonar_gl.core.toml import read_toml

MATERIALS = Path(__file__).with_name("materials.toml")
# at which fine roughness divides |R|² into lobe and diffuse part
WAVENUMBER_RAD_M = 2 * math.pi * 900e3 / 1500
# Grazing angle at which Lambert's law has the strength of a sediment's volume. The volume's own law falls less towards
# grazing: at 10 to 60 degrees it is apart by 3 dB at most.
GRAZING_RAD = math.pi / 4


@dataclass(frozen=True)
class Material:
    """The acoustic properties of a material; None stands for an unknown value.

    Fine roughness scatters a part of what the boundary reflects diffusely, and leaves the rest to the specular lobe.

    name : heading of its table in materials.toml
    density_ratio, speed_ratio, loss : as `rayleigh_reflection` takes them
    impedance_ratio : impedance over that of the water
    reflectivity : μ of the diffuse echo, 0..1; all of |R|² if the surface is rough, and `volume`
    volume : μ of what the volume of a sediment scatters; 0 where the boundary scatters more
    specular : strength of the specular lobe, 0..1; 0 if the surface is rough
    roughness_rad : rms slope, along any one direction, of the facets that make the lobe
    height_m : rms height of the fine roughness, metres
    source : reference for the numbers
    """

    name: str
    density_ratio: float | None
    speed_ratio: float | None
    loss: float | None
    impedance_ratio: float
    reflectivity: float
    specular: float
    roughness_rad: float | None
    height_m: float | None
    source: str = ""
    volume: float = 0.0

    @property
    def reflected(self) -> float:
        """The intensity reflection coefficient |R|² at normal incidence."""
        return self.specular + self.reflectivity - self.volume


def material(name: str) -> Material:
    """Return the material of this name; case does not matter, and spaces and hyphens equal underscores.

    Raises
    ------
    Error
        if the name is unknown.

    >>> material("medium sand").density_ratio
    1.845
    """
    if not isinstance(name, str):
        raise Error(f"a material must be a name (got {shown(name)}; such as {next(iter(_materials()))!r})")
    found = find_material(name)
    if found is None:
        hint = f"{nearest_names(_key(name), _materials())}; `sonar-gl materials` lists them"
        raise Error(f"unknown material (got {name!r}; {hint})")
    return found


def find_material(name: str) -> Material | None:
    """Return the material of a name as `material` does; None for an unknown one, at no cost of a hint."""
    return _materials().get(_key(name))


def _key(name: str) -> str:
    return "_".join(name.casefold().replace("-", " ").replace("_", " ").split())


def materials() -> dict[str, Material]:
    """Return name -> material, with several names for some."""
    return dict(_materials())


@lru_cache(maxsize=1)
def _materials() -> dict[str, Material]:
    tables = read_toml(MATERIALS, "the table of materials")
    own = {name: _from_table(name, table) for name, table in tables.items() if "same_as" not in table}
    return {name: own[table.get("same_as", name)] for name, table in tables.items()}


def _from_table(name: str, table: dict) -> Material:
    """Return the material that one table of materials.toml describes."""
    density, speed = table.get("density_ratio"), table.get("speed_ratio")
    loss = None if density is None else table.get("loss", 0.0)
    if density is None:
        impedance = table["impedance_ratio"]
        intensity = ((impedance - 1) / (impedance + 1)) ** 2
    else:
        impedance = density * speed
        intensity = abs(complex(rayleigh_reflection(np.pi / 2, density, speed, loss))) ** 2
    coherent, height = 0.0, table.get("height_m")
    if height is not None:
        coherent = float(coherent_loss(np.pi / 2, height, WAVENUMBER_RAD_M)) ** 2
    diffuse, specular = intensity * (1 - coherent), intensity * coherent
    slope, volume = table.get("roughness_rad"), 0.0
    if "volume_parameter" in table:
        strength = sediment_backscattering(GRAZING_RAD, density, speed, loss, table["volume_parameter"])
        volume = math.pi * float(strength) / math.sin(GRAZING_RAD) ** 2
    return Material(
        name,
        density,
        speed,
        loss,
        impedance,
        diffuse + volume,
        specular,
        slope,
        height,
        table["source"],
        volume,
    )
