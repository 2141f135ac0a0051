"""The commands `scenes` and `sonars`: lists of what is known by name."""

from __future__ import annotations

import click

from sonar_gl.cli.report import table_text
from sonar_gl.scene.load import bundled_scenes, scene_description
from sonar_gl.sonar.sonar import presets


def scenes_text() -> str:
    """Return the bundled scenes with their descriptions."""
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
