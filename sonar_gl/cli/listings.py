"""The commands `scenes`, `sonars` and `materials`: lists of what is known by name."""

from __future__ import annotations

import math
import textwrap

import click

from sonar_gl.acoustics.boundary import specular_lobe
from sonar_gl.cli.report import table_text
from sonar_gl.core.errors import Error
from sonar_gl.scene.load import bundled_scenes, load_scene, scene_description
from sonar_gl.scene.materials import Material, materials
from sonar_gl.sonar.sonar_files import load_sonar, presets, sonar_file_text

LEAST_ECHO = 1e-6  # listed; a perfect reflector has no diffuse part, and next to nothing off its lobe
MATERIALS_NOTE = """\
impedance: over that of the water. |R|^2: intensity reflection coefficient at normal incidence,
the sum of a diffuse part and of a specular lobe, whose width is the rms slope of the facets. The
diffuse part of silts, clay and very fine sand holds what their volume scatters, too.
dB: echo per steradian at an angle of incidence, 0 dB for a diffuse part of 1 at 0 degrees.
Height: rms height of the roughness, which divides |R|^2 at 900 kHz; rough materials have no lobe."""


def scenes_text() -> str:
    formatter = click.HelpFormatter(max_width=100)
    formatter.write_dl([(name, scene_description(path)) for name, path in bundled_scenes().items()])
    return formatter.getvalue().rstrip("\n")


def sonars_text() -> str:
    """Return the preset sonars: beams, field of view, frequency, range and bin size."""
    header = "name", "beams", "view, deg", "kHz", "range, m", "bin, mm"
    rows = [
        (
            name,
            str(sonar.n_beams),
            f"{sonar.azimuth_fov_deg:g} x {sonar.elevation_fov_deg:g}",
            f"{sonar.frequency_hz / 1e3:g}",
            f"{sonar.range_min_m:g} to {sonar.range_max_m:.4g}",
            f"{1e3 * sonar.bin_size_m:.4g}",
        )
        for name, sonar in presets().items()
    ]
    return table_text(header, rows)


def named_sonar_text(what: str) -> str:
    """Return the content of a file that describes the sonar of a --sonar."""
    return sonar_file_text(load_sonar(what)).rstrip("\n")


def scene_sonar_text(scene_name: str, options) -> str:
    """Return the content of a file that describes the sonar of a scene's sensor, and says what was assumed.

    Raises Error if the tags of the sensor at the scene's sonar describe none.
    """
    scene = load_scene(scene_name, options.resource_path, options.skip_missing)
    if scene.sonar is None:
        got = f"{scene.sensors[0]}, whose tags do not" if scene.sensors else "no sensor of a sonar"
        raise Error(
            f"scene {scene.name!r} must have a sonar that the tags of its sensor describe (got {got}; "
            "'sonar-gl sonars' lists the presets)"
        )
    sensor = scene.sensors[0]
    return f"# {sensor}: {sensor.describe()}\n" + sonar_file_text(scene.sonar).rstrip("\n")


def materials_text() -> str:
    """Return the materials: impedance, reflection, echo at two angles of incidence, roughness; and sources."""
    header = (
        *("material", "impedance", "|R|^2", "diffuse", "lobe", "slope, rad"),
        *("dB at 0 deg", "at 60 deg", "height, mm"),
    )
    rows, named, sources = [], {}, {}
    for name, one in materials().items():
        named.setdefault(one.name, []).append(name)
    for name, names in named.items():
        one = materials()[name]
        sources.setdefault(one.source, []).append(name)
        rows += [_material_row(other, one) for other in names]
    paragraphs = (
        textwrap.fill(f"{', '.join(names)}: {source}", 98, subsequent_indent="    ")
        for source, names in sources.items()
    )
    return "\n\n".join((table_text(header, rows), MATERIALS_NOTE, "\n".join(paragraphs)))


def _material_row(name: str, one: Material) -> tuple[str, ...]:
    lobe, slope = ("-", "-") if not one.specular else (f"{one.specular:.3f}", f"{one.roughness_rad:g}")
    return (
        name,
        f"{one.impedance_ratio:.3g}",
        f"{one.reflected:.3f}",
        f"{one.reflectivity:.3f}",
        lobe,
        slope,
        *(_echo_text(one, math.radians(angle_deg)) for angle_deg in (0, 60)),
        "rough" if one.height_m is None else f"{1e3 * one.height_m:g}",
    )


def _echo_text(one: Material, incidence_rad: float) -> str:
    cos = math.cos(incidence_rad)
    lobe = float(specular_lobe(cos, one.specular, one.roughness_rad)) if one.specular else 0.0
    echo = one.reflectivity * cos + lobe
    return f"{10 * math.log10(echo):.1f}" if echo > LEAST_ECHO else "-"
