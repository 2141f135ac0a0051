"""Checks of `doctor` that need the other packages: OpenGL, compiled functions, a scene with a known echo.

Each check returns (ok, detail, cure) of a `doctor.Finding`, or raises an Error that holds the cure.
"""

from __future__ import annotations

import math
import os
from functools import partial

import numpy as np
import trimesh

from sonar_gl.acoustics.acoustics import Acoustics
from sonar_gl.cli import compilation
from sonar_gl.cli.driver_report import MAX_NOISE, sample_noise
from sonar_gl.cli.output import echo
from sonar_gl.core.compiled import reason_not_kept
from sonar_gl.core.data_files import data_folder
from sonar_gl.core.errors import Error
from sonar_gl.core.extras import pip_install
from sonar_gl.core.poses import pose
from sonar_gl.gl import context as gl
from sonar_gl.raster.engine import check_engine
from sonar_gl.scene.load import bundled_scenes
from sonar_gl.scene.pyrender_scene import import_pyrender
from sonar_gl.scene.scene import Body, Scene
from sonar_gl.simulator import Simulator
from sonar_gl.sonar.sampling import Sampling
from sonar_gl.sonar.sonar import Sonar

WITHOUT_OPENGL = "pings are drawn by the CPU; graphics cards and sonars inside other programs need OpenGL"
WITHOUT_CARD = " in place of OpenGL, as there is no graphics card"
TOLERANCE = 0.01  # of the wall's total echo: the default tolerance of a ping


def check_pyrender():
    """Check that scenes of pyrender can be read, which is optional."""
    try:
        return True, import_pyrender().__version__, ""
    except Error as why:
        users = "scenes of pyrender and optical images of batches"
        return None, str(why), f"only {users} need it: {pip_install('pyrender')}"


def check_scenes():
    count = len(bundled_scenes())
    return count > 0, f"{count} in {data_folder('scenes')}", "install sonar_gl again"


def check_egl():
    """List the devices that EGL offers, which of them OpenGL would draw by, and those that do not work."""
    try:
        names = gl.egl_devices()
    except OSError as why:
        return (
            None,
            " ".join(str(why).split()),
            f"{WITHOUT_OPENGL}; on Debian or Ubuntu: apt-get install libegl1 libgl1",
        )
    if names is None:
        return None, "cannot list its devices", "nothing to do if OpenGL works"
    found = gl.devices()
    try:
        used = gl.chosen_device()[0] or 0
    except Error:  # which the check of OpenGL reports
        used = None
    devices = [f"{one}{', chosen for OpenGL' if one.index == used else ''}" for one in found]
    cure = "install a driver; on Debian or Ubuntu Mesa's: apt-get install libegl-mesa0 libgl1-mesa-dri"
    count = f"{len(found)} device{'s' * (len(found) != 1)}"
    return bool(found) or None, ": ".join([count, "; ".join(devices)] if devices else [count]), cure


def check_opengl():
    try:
        context = gl.create_context()
    except Error as why:
        if check_engine(None) == "opengl" or gl.chosen_device()[0] is not None:  # it was asked for
            raise
        return None, str(why), WITHOUT_OPENGL
    try:
        facts = gl.describe(context)
    finally:
        context.release()
    kind = "software" if gl.is_software(facts["renderer"]) else "hardware"
    width, height = facts["max_viewport"]
    return (
        True,
        f"{facts['renderer']} ({kind}), {facts['vendor']}, {facts['version']}; "
        f"textures to {facts['max_texture_size']}, views to {width} x {height} pixels",
        "",
    )


def check_raster_engine():
    sonar = Sonar("doctor", 900e3, 16, 100, 10.0, 4.0, 0.625, 0.55, 10.55)
    with Simulator(Scene([]), sonar, Acoustics.ideal(), Sampling(1, 8)) as simulator:
        info = simulator.gl_info
    why = "" if check_engine(None) != "auto" or info["engine"] == "opengl" else WITHOUT_CARD
    return True, f"{info['engine']}: {info['renderer']}, {info['version']}; it draws pings{why}", ""


def check_compiled_functions():
    """Compile all compiled functions, and check that the machine code can be kept on disk."""
    done = compilation.compile_everything(partial(echo, err=True))
    folder = compilation.cache_folder()
    detail = f"{done.n_functions}; {done.n_compiled} compiled now, {done.seconds:.0f} s"
    reason = reason_not_kept()
    if folder is not None and os.access(folder, os.W_OK) and reason is None:
        return True, f"{detail}; kept in {folder}", ""
    cure = "each run compiles again; set NUMBA_CACHE_DIR to a folder that can be written to"
    where = f" in {folder}" if folder else ""
    return None, f"{detail}; cannot be kept{where}{f' ({reason})' if reason else ''}", cure


def check_known_scene():
    """Compare the echo of a wall 5 m ahead with its closed form; find a box behind the sonar, to
    port once it turns; measure the noise of samples."""
    fov, height, n_beams = 10.0, 4.0, 16  # the wall's corners are at 5.02 m, in the same bin as its middle
    sonar = Sonar("doctor", 900e3, n_beams, 100, fov, height, fov / n_beams, 0.55, 10.55)
    wall = Body("wall", trimesh.creation.box((1.0, 20.0, 20.0)), pose(5.5), 1.0)
    box = Body("box", trimesh.creation.box((0.2, 0.2, 0.2)), pose(-8.0, -0.4), 1.0)
    with Simulator(Scene([wall, box]), sonar, Acoustics.ideal()) as simulator:
        by_opengl = simulator.gl_info["engine"] == "opengl"
        ahead = simulator.ping(pose()).intensity
        behind = simulator.ping(pose(yaw=math.pi)).intensity
    # cos θ = cos φ cos ψ over dΩ = cos φ dφ dψ, divided by a beam's solid angle
    half, top = math.radians(fov / 2), math.radians(height / 2)
    expected = n_beams * math.sin(half) * (top + math.sin(2 * top) / 2) / (2 * half * math.sin(top))
    total, at_wall = float(ahead.sum()), float(ahead[:, 44].sum())
    beam, bin_ = np.unravel_index(behind.argmax(), behind.shape)
    place = f"{sonar.range_m[bin_]:.2f} m, {math.degrees(sonar.azimuth_rad[beam]):+.1f} deg"
    detail = f"wall at 5 m: {total / expected:.4f} of its echo, {at_wall / total:.4f} of that in its bin"
    detail += f"; box to port at 7.91 m, +2.9 deg: found at {place}"
    noise = max(sample_noise())
    detail += f"; samples of a plane within {noise:.1f} x 2^-24"
    right = noise < MAX_NOISE and abs(total / expected - 1) < TOLERANCE and at_wall / total > 1 - TOLERANCE
    right &= abs(sonar.range_m[bin_] - 7.9) < sonar.bin_size_m and sonar.azimuth_rad[beam] > math.radians(1.5)
    cure = (
        "the OpenGL driver draws wrongly: update it, or set SONAR_GL_ENGINE=cpu"
        if by_opengl
        else "install sonar_gl again"
    )
    return bool(right), detail, cure
