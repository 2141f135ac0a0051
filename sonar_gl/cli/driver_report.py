"""What `doctor --report` says of the OpenGL driver: limits, extensions, noise of samples, scenes and their times."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable
from time import perf_counter
from typing import NamedTuple

import numpy as np
import trimesh

from sonar_gl.acoustics.acoustics import Acoustics
from sonar_gl.core.poses import pose
from sonar_gl.gl import context as gl
from sonar_gl.gl.driver import free_bytes
from sonar_gl.scene.load import bundled_scenes, load_scene
from sonar_gl.scene.scene import Body, Scene
from sonar_gl.simulator import Simulator
from sonar_gl.sonar.sampling import Sampling
from sonar_gl.sonar.sonar import Sonar
from sonar_gl.sonar.sonar_files import load_sonar

SONAR, TOLERANCE, N_PINGS = "p900-45", 0.02, 9  # of the scenes
UNIT = 2.0**-24  # half of the distance of float32 numbers, relative
# Samples count as of one plane if their planes differ by less than 1e-5 (SAME in borders.py) on the border between
# them, where each is off by its noise in 1/x and by half a spacing's noise of its slope.
MAX_NOISE = 1e-5 / UNIT / 3
LIMITS = (
    "GL_MAX_TEXTURE_SIZE",
    "GL_MAX_RENDERBUFFER_SIZE",
    "GL_MAX_VIEWPORT_DIMS",
    "GL_VIEWPORT_BOUNDS_RANGE",
    "GL_SUBPIXEL_BITS",
    "GL_MAX_COLOR_ATTACHMENTS",
    "GL_MAX_ELEMENTS_INDICES",
    "GL_MAX_ELEMENTS_VERTICES",
)
EXTENSIONS = (
    "GL_ARB_multi_draw_indirect",
    "GL_ARB_base_instance",
    "GL_ARB_derivative_control",
    "GL_ARB_clip_control",
    "GL_ARB_buffer_storage",
    "GL_KHR_robustness",
    "GL_ATI_meminfo",
    "GL_NVX_gpu_memory_info",
)


class SampleNoise(NamedTuple):
    """Deviations of a plane's samples from the plane, in units of 2^-24 of 1/x; the greatest of each."""

    depth: float  # of 1/x
    slopes: float  # of its slopes, over the spacing of the samples


def sample_noise() -> SampleNoise:
    """Return the noise of the samples of a tilted wall, as the driver draws it."""
    sonar = Sonar("tilted", 900e3, 64, 64, 40.0, 20.0, 1.0, 0.5, 20.0)
    wall = Body("wall", trimesh.creation.box((1.0, 60.0, 60.0)), pose(6.0, pitch=0.5, yaw=0.4))
    made_of = Scene([wall]), sonar, Acoustics.ideal(), Sampling(4, 100)
    with Simulator(*made_of) as simulator, simulator.run.drawing():
        (view,) = simulator.run.sampler.resolution.stage.draw([pose()], [None])
        ((sector, plane_echo, *_),) = view.sectors
        samples = plane_echo[..., :3].astype(float)
    u, v = sector.sample_coordinates()
    inside = samples[..., 0] > 0
    columns = np.stack([np.ones_like(u), u, v], axis=-1)[inside]
    # the plane of least squares: rounding of the vertices shifts it as a whole
    plane, *_ = np.linalg.lstsq(columns, samples[inside][:, 0], rcond=None)
    exact = columns @ plane
    depth = np.abs(samples[inside][:, 0] / exact - 1).max()
    along = np.abs(samples[inside][:, 1:] - plane[1:]) * (sector.u[1], sector.v[2]) / exact[:, None]
    return SampleNoise(float(depth / UNIT), float(along.max() / UNIT))


def driver_facts() -> dict:
    """Return the OpenGL driver's names, limits, extensions that matter, and free memory."""
    context = gl.create_context()
    try:
        return {
            **gl.describe(context),
            "is_software": gl.is_software(context.info["GL_RENDERER"]),
            "version_code": context.version_code,
            "limits": {name: context.info.get(name) for name in LIMITS},
            "extensions": {name: name in context.extensions for name in EXTENSIONS},
            "free_bytes": free_bytes(context),
        }
    finally:
        context.release()


def engine_facts() -> dict:
    """Return the names and limits of the engine that draws pings."""
    with Simulator(Scene([]), load_sonar(SONAR), sampling=Sampling(1, 8)) as simulator:
        return dict(simulator.gl_info)


def scene_times() -> dict:
    out = {}
    for name in bundled_scenes():
        scene = load_scene(name)
        with Simulator(scene, load_sonar(SONAR), tolerance=TOLERANCE) as simulator:
            times_ms = []
            for number in range(N_PINGS + 1):  # the first one chooses the samples
                begin = perf_counter()
                ping = simulator.ping(scene.sonar_pose @ pose(0.001 * number))
                times_ms.append(1e3 * (perf_counter() - begin))
            out[name] = {
                "ms_median": round(statistics.median(times_ms[1:]), 3),
                "ms_least": round(min(times_ms[1:]), 3),
                "columns_per_beam": simulator.sampling.columns_per_beam,
                "rows": simulator.sampling.rows,
                "echo": math.fsum(ping.intensity.ravel().tolist()),
            }
    return out


def measure() -> dict:
    """Return what is known of the driver; in place of what fails, why."""
    parts: dict[str, Callable] = {
        "driver": driver_facts,
        "noise_2_to_the_-24": lambda: sample_noise()._asdict(),
        "scenes": scene_times,
        "engine": engine_facts,
    }
    out = {"settings": {"sonar": SONAR, "tolerance": TOLERANCE, "pings": N_PINGS}}
    for name, part in parts.items():
        try:
            out[name] = part()
        except Exception as why:  # the report is about what does not work, too
            out[name] = {"failed": f"{type(why).__name__}: {why}"}
    return out
