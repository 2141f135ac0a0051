"""Whether all that is needed works here, found by trying, each finding with its cure."""

from __future__ import annotations

import importlib
import importlib.metadata
import math
import os
import platform
import re
import sys
from typing import NamedTuple

from sonar_gl._version import __version__

SOFTWARE = re.compile(r"llvmpipe|softpipe|swrast|swiftshader|software", re.IGNORECASE)
PACKAGES = (  # what it is imported as, what it is installed as
    ("numpy", "numpy"),
    ("numba", "numba"),
    ("moderngl", "moderngl"),
    ("glcontext", "glcontext"),
    ("trimesh", "trimesh"),
    ("cv2", "opencv-contrib-python-headless"),
    ("click", "click"),
    ("PIL", "pillow"),
    ("defusedxml", "defusedxml"),
)
TOLERANCE = 0.01  # of the wall's total echo: the default tolerance of a ping


class Finding(NamedTuple):
    """`ok` is True, False, or None where something optional is not there; `cure` is one sentence or ''."""

    what: str
    ok: bool | None
    detail: str
    cure: str = ""


def examine() -> list[Finding]:
    """Everything that a ping needs, in the order in which it needs it; never raises for what is missing."""
    python = f"{platform.python_version()}, {platform.system()} {platform.machine()}, {sys.prefix}"
    found = [Finding("sonar_gl", True, __version__), Finding("Python", True, python)]
    found += [_package(module, name) for module, name in PACKAGES]
    for what, examiner, cure in (
        ("pyrender", _pyrender, "pip install pyrender"),
        ("embreex", _embreex, "pip install embreex"),
        ("shaders", _shaders, "install sonar_gl again"),
        ("scenes", _scenes, "install sonar_gl again"),
        ("compiled sums", _numba_cache, "set NUMBA_CACHE_DIR to a folder that can be written to"),
        ("EGL", _egl, "on Debian or Ubuntu: apt-get install libegl1 libgl1"),
        ("OpenGL", _opengl, ""),  # its message holds the cure
        ("known scene", _known_scene, "put right what is wanting above; if nothing is, report this line"),
    ):
        if found[-1][:2] == ("OpenGL", False):
            found.append(Finding(what, False, "not tried without OpenGL"))
            continue
        try:
            found.append(Finding(what, *examiner()))
        except Exception as why:  # whatever is broken here is what is to be told
            found.append(Finding(what, False, " ".join(str(why).split()), cure))
    return found


def _package(module: str, name: str) -> Finding:
    try:
        loaded = importlib.import_module(module)
    except Exception as why:  # a missing system library comes as any of several
        return Finding(name, False, f"cannot be imported ({why})", f"pip install {name}")
    try:
        return Finding(name, True, importlib.metadata.version(name))
    except importlib.metadata.PackageNotFoundError:  # another build of it, such as opencv-python
        return Finding(name, True, str(getattr(loaded, "__version__", "of unknown version")))


def _pyrender():
    from sonar_gl.load import import_pyrender
    from sonar_gl.types import Error

    try:
        return True, import_pyrender().__version__, ""
    except Error as why:
        return None, str(why), "only scenes of pyrender need it: pip install pyrender"


def _embreex():
    _, ok, detail, _ = _package("embreex", "embreex")
    return ok or None, detail, "only reference_ping needs it: pip install 'sonar_gl[reference]'"


def _shaders():
    from sonar_gl.load import data_folder

    folder = data_folder("shaders")
    count = sum(path.suffix in (".vert", ".frag", ".glsl") for path in folder.iterdir())
    return count > 0, f"{count} in {folder}", "install sonar_gl again"


def _scenes():
    from sonar_gl.load import bundled_scenes, data_folder

    return (
        bool(bundled_scenes()),
        f"{len(bundled_scenes())} in {data_folder('scenes')}",
        "install sonar_gl again",
    )


def _numba_cache():
    from sonar_gl import reduce

    stats = [value.stats for value in vars(reduce).values() if hasattr(value, "stats")]
    folder = next(s.cache_path for s in stats if s.cache_path)
    kept = os.access(folder if os.path.isdir(folder) else os.path.dirname(folder), os.W_OK)
    cure = "each run compiles anew, some seconds; set NUMBA_CACHE_DIR to a folder that can be written to"
    return True if kept else None, f"{'kept' if kept else 'cannot be kept'} in {folder}", cure


def _egl():
    """Devices that EGL offers, which of them is used, and which cannot be; none is told as wanting."""
    from sonar_gl import gl
    from sonar_gl.types import Error

    if gl.egl_devices() is None:
        return None, "cannot list its devices", "nothing to do if OpenGL is well"
    found = gl.devices()
    try:
        used = gl.chosen_device()[0] or 0
    except Error:  # which OpenGL tells
        used = None
    told = [f"{one}{', used' if one.index == used else ''}" for one in found]
    cure = "install a driver; on Debian or Ubuntu Mesa's: apt-get install libegl-mesa0 libgl1-mesa-dri"
    count = f"{len(found)} device{'s' * (len(found) != 1)}"
    return bool(found), ": ".join([count, "; ".join(told)] if told else [count]), cure


def _opengl():
    from sonar_gl import gl

    context = gl.create_context()  # or an Error, with its cure
    try:
        told = gl.describe(context)
    finally:
        context.release()
    kind = "software" if SOFTWARE.search(told["renderer"]) else "hardware"
    width, height = told["max_viewport"]
    return True, (
        f"{told['renderer']} ({kind}), {told['vendor']}, {told['version']}; "
        f"textures to {told['max_texture_size']}, views to {width} x {height} pixels"
    )


def _known_scene():
    """A wall 5 m ahead, against its closed form; a box behind, to port once the sonar is turned round."""
    import numpy as np
    import trimesh

    from sonar_gl.acoustics import Acoustics
    from sonar_gl.scene import Body, Scene, pose
    from sonar_gl.simulator import Simulator
    from sonar_gl.sonar import Sonar

    fov, height, n_beams = 10.0, 4.0, 16  # the wall's corners are at 5.02 m, in the same bin as its middle
    sonar = Sonar("doctor", 900e3, n_beams, 100, fov, height, fov / n_beams, 0.55, 10.55)
    wall = Body("wall", trimesh.creation.box((1.0, 20.0, 20.0)), pose(5.5), 1.0)
    box = Body("box", trimesh.creation.box((0.2, 0.2, 0.2)), pose(-8.0, -0.4), 1.0)
    with Simulator(Scene([wall, box]), sonar, Acoustics.ideal()) as simulator:
        ahead = simulator.ping(pose()).intensity
        behind = simulator.ping(pose(yaw=math.pi)).intensity
    # cos θ = cos φ cos ψ over dΩ = cos φ dφ dψ, by a beam's solid angle
    half, top = math.radians(fov / 2), math.radians(height / 2)
    expected = n_beams * math.sin(half) * (top + math.sin(2 * top) / 2) / (2 * half * math.sin(top))
    total, at_wall = float(ahead.sum()), float(ahead[:, 44].sum())
    beam, bin_ = np.unravel_index(behind.argmax(), behind.shape)
    place = f"{sonar.range_m[bin_]:.2f} m, {math.degrees(sonar.azimuth_rad[beam]):+.1f} deg"
    detail = f"wall at 5 m: {total / expected:.4f} of its echo, {at_wall / total:.4f} of that in its bin"
    detail += f"; box to port at 7.91 m, +2.9 deg: found at {place}"
    right = abs(total / expected - 1) < TOLERANCE and at_wall / total > 1 - TOLERANCE
    right &= abs(sonar.range_m[bin_] - 7.9) < sonar.bin_size_m and sonar.azimuth_rad[beam] > math.radians(1.5)
    return bool(right), detail, "the OpenGL driver draws wrongly: update it, or try LIBGL_ALWAYS_SOFTWARE=1"
