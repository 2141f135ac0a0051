"""The report of `doctor --scene`: what a scene holds, and what of its file was left out."""

from __future__ import annotations

import warnings
from collections.abc import Iterable

import numpy as np

from sonar_gl.cli.common import describe_sonar, scene_from
from sonar_gl.cli.report import table_text
from sonar_gl.core.poses import pose_numbers
from sonar_gl.scene.extent import body_bounds, bounds_of, is_infinite, other_unit_text, place_texts, size_text
from sonar_gl.scene.load import is_sdf, is_turned
from sonar_gl.scene.scene import Body, Scene

ECHOING = (
    "bodies are the collisions of links; visuals count where they alone exist, or alone have <laser_retro> or a "
    "sonar_gl tag"
)
TURNED = "glTF is y-up: the file is turned to z-up, (x, y, z) of the file to (x, -z, y)"
MAX_LISTED = 40  # bodies and other things in a list; a terminal shows as many


def scene_report(scene_name: str, options) -> str:
    """Load a scene as other commands do, and return what it holds, with all warnings of its reader."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        scene = scene_from(scene_name, options)
    messages = [str(one.message) for one in caught]
    messages += filter(None, [other_unit_text(scene)])
    if scene.sonar_pose is not None:
        poses, present = [body.pose for body in scene.bodies], np.ones(len(scene.bodies), bool)
        messages += place_texts(scene, poses, present, scene.sonar_pose)
    note = ECHOING if is_sdf(scene_name) else TURNED if is_turned(scene_name) else ""
    return report_text(scene, messages, note)


def report_text(scene: Scene, messages: Iterable[str] = (), note: str = "") -> str:
    """Return what a scene holds, in words and tables.

    messages : warnings of its reader, in order
    note : what the bodies are, or how they were turned
    """
    surface = "none" if scene.surface_z_m is None else f"surface at z = {scene.surface_z_m:g} m"
    rows = [
        ("scene", scene.name),
        ("bodies", f"{len(scene.bodies)}, {scene.n_triangles} triangles"),
        ("extent", _extent_text(scene)),
        ("water", surface),
        ("sonar", describe_sonar(scene) if scene.sonar is None else f"the scene's own, {scene.sensors[0]}"),
        *(
            ("plume", f"{plume.name!r} at {_numbers(plume.pose[:3, 3])}")
            for plume in scene.plumes[:MAX_LISTED]
        ),
    ]
    parts = ["\n".join(f"{name:8}  {value}" for name, value in rows)]
    if scene.sensors:
        parts.append(_sensors_text(scene))
    elif scene.sonar_pose is not None:
        parts[0] += f"\npose      {_numbers(pose_numbers(scene.sonar_pose))}"
    else:
        parts[0] += "\npose      none in the scene; give the sonar's with --pose"
    if scene.bodies:
        parts += filter(None, [_bodies_text(scene.bodies), note])
    messages = list(dict.fromkeys(messages))
    if messages:
        parts.append("warnings\n" + "\n".join("  " + text.replace("\n", "\n  ") for text in messages))
    return "\n\n".join(parts)


def _extent_text(scene: Scene) -> str:
    bounds = bounds_of(scene.bodies)
    if bounds is None:
        return "none" if not scene.bodies else "infinite planes only"
    text = f"{size_text(np.ptp(bounds, axis=0))}, from {_numbers(bounds[0])} to {_numbers(bounds[1])}"
    planes = sum(map(is_infinite, scene.bodies))
    return f"{text}, without {planes} infinite plane{'s' * (planes != 1)}" if planes else text


def _sensors_text(scene: Scene) -> str:
    """Return the sensors that stand for sonars, one per line, the one that is taken first."""
    lines = []
    for number, sensor in enumerate(scene.sensors[:MAX_LISTED]):
        place = _numbers(pose_numbers(sensor.pose))
        lines += [
            f"{'-' if number else 'taken':5}  {sensor}",
            f"       at {place}",
            f"       {sensor.describe()}",
        ]
    return "\n".join([*lines, *_more(len(scene.sensors), "sensors")])


def _bodies_text(bodies: tuple[Body, ...]) -> str:
    """Return the table of bodies, in the order of the file; of too many the largest."""
    shown = [(body, body_bounds(body)) for body in bodies]
    if len(shown) > MAX_LISTED:
        shown = sorted(shown, key=lambda one: -float(np.ptp(one[1], axis=0).max()))[:MAX_LISTED]
    rows = [
        (
            body.name,
            "infinite" if is_infinite(body) else size_text(np.ptp(bounds, axis=0)),
            _numbers(bounds.mean(axis=0)),
            str(len(body.surface.faces)),
            _reflectivity_text(body),
        )
        for body, bounds in shown
    ]
    text = table_text(("body", "size", "middle, m", "triangles", "reflectivity"), rows)
    return "\n".join(
        [text, *_more(len(bodies), "bodies, which are smaller (--only NAME shows those of a name)")]
    )


def _reflectivity_text(body: Body) -> str:
    low, high = float(np.min(body.reflectivity)), float(np.max(body.reflectivity))
    text = f"{low:.3g}" if low == high else f"{low:.3g} to {high:.3g}"
    if body.specular:
        text += f", lobe {body.specular:.3g}"
    return f"{text}, {body.material}" if body.material else text


def _more(count: int, what: str) -> list[str]:
    return [f"and {count - MAX_LISTED} more {what}"] if count > MAX_LISTED else []


def _numbers(point) -> str:
    """Return numbers in words, far from the origin to a decimetre; 0.0 is added since -0.0 would have a sign.

    >>> _numbers([2.54321, -0.0, 500012.3456])
    '2.543 0 500012.3'
    """
    return " ".join(
        f"{value + 0.0:.4g}" if abs(value) < 1000 else f"{value:.1f}".removesuffix(".0")
        for value in np.round(point, 4)
    )
