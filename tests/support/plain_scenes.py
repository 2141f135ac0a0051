"""Bundled scenes without their materials, for tests of what bodies of known reflectivity alone do."""

from __future__ import annotations

from dataclasses import replace
from fnmatch import fnmatch

import sonar_gl as sg


def without_materials(name: str, reflectivities: dict[str, float]) -> sg.Scene:
    """Return a bundled scene whose bodies have a reflectivity each, no specular lobe and no material.

    Parameters
    ----------
    reflectivities : names of bodies, in which * stands for any text, to μ; the first that fits a body counts
    """
    scene = sg.load_scene(name)
    bodies = [
        replace(
            body,
            reflectivity=next(mu for pattern, mu in reflectivities.items() if fnmatch(body.name, pattern)),
            specular=0.0,
            roughness_rad=None,
            material=None,
        )
        for body in scene.bodies
    ]
    return sg.Scene([*bodies, *scene.plumes], scene.sonar_pose, scene.name, scene.surface_z_m)
