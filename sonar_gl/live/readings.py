"""What stands in the bins of a frame's ping."""

from __future__ import annotations

import math

from sonar_gl.core.checks import check_whole_number, unknown_body_error
from sonar_gl.live.frame import LiveFrame, Reading
from sonar_gl.ping import Ping
from sonar_gl.scene.scene import Scene


def check_bin(frame: LiveFrame, beam: int, bin: int) -> tuple[int, int]:
    """Return the indices of a bin of a frame's ping; raise Error if there is no such bin."""
    beams, bins = frame.ping.intensity.shape
    return check_whole_number("beam", beam, 0, beams - 1), check_whole_number("bin", bin, 0, bins - 1)


def body_number(scene: Scene, name: str) -> int:
    """Return a body's number in labels, 1 + its index in the scene; raise Error if there is none of this name."""
    names = [one.name for one in scene.bodies]
    if name not in names:
        raise unknown_body_error(name, names, "a body must be one of the scene")
    return 1 + names.index(name)


def reading_of(scene: Scene, ping: Ping, labels: Ping, beam: int, bin: int) -> Reading:
    """Return what stands in a bin of a ping; `labels` is the same ping with labels, perhaps without noise."""
    place = beam, bin
    intensity, number = float(ping.intensity[place]), int(labels.body_id[place])
    elevation_rad = float(labels.elevation_rad[place])
    return Reading(
        beam=beam,
        bin=bin,
        azimuth_rad=float(ping.azimuth_rad[beam]),
        range_m=float(ping.range_m[bin]),
        body=scene.bodies[number - 1].name if number else "",
        elevation_rad=elevation_rad if math.isfinite(elevation_rad) else None,
        level_db=10 * math.log10(intensity) if intensity > 0 else -math.inf,
        count=int(ping.counts()[place]),
    )
