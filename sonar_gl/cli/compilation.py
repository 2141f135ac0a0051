"""Compilation of all compiled functions before their first use.

The functions are compiled for the types of their arguments, so tiny pings in a tiny scene call each of them as the
product does. Where there is something to compile, a second process, `python -m sonar_gl.cli.compilation`, compiles
half of it at the same time and leaves it on disk.
"""

from __future__ import annotations

import math
import os
import subprocess
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from importlib.util import find_spec
from typing import NamedTuple

import numpy as np
import trimesh
from numba.core import event
from numba.core.dispatcher import Dispatcher

from sonar_gl import cli
from sonar_gl.acoustics.acoustics import Acoustics
from sonar_gl.acoustics.water import Water
from sonar_gl.analysis.reference import reference_ping
from sonar_gl.core.compiled import announce_compilation
from sonar_gl.core.poses import pose
from sonar_gl.embed.camera import Camera
from sonar_gl.embed.sensor import Sensor
from sonar_gl.embed.textures import metres_ahead
from sonar_gl.imaging.boxes import body_map, boxes_of
from sonar_gl.imaging.demarco2015 import demarco_image
from sonar_gl.imaging.fan_image import fan_image
from sonar_gl.noise.noise import add_noise
from sonar_gl.noise.settings import Noise
from sonar_gl.ping import BIN_LABELS, Ping
from sonar_gl.raster.level_of_detail import MIN_FACES_TO_SIMPLIFY, make_levels
from sonar_gl.scene.plume import Bubbles
from sonar_gl.scene.primitives import terrain
from sonar_gl.scene.scene import Body, Scene
from sonar_gl.simulator import Simulator
from sonar_gl.sonar.sampling import Sampling
from sonar_gl.sonar.sonar import Sonar

REPORT_S = 3.0  # between two reports
SONAR = Sonar("tiny", 900e3, 16, 48, 30.0, 20.0, 2.0, 0.5, 8.5)
# its beams overlap so widely that its side lobes have wide columns, and that place-locked speckle is interpolated
WIDE_BEAMS = replace(SONAR, beam_width_deg=20.0)
POSE = pose(z=-1.0, pitch=0.02)  # sees the surface and the floor
VELOCITY = 0.5, 0.0, 0.0, 0.0, 0.0, 0.1  # m/s, rad/s
NOISES = (
    Noise.physical(),
    Noise(speckle=True, looks=2, self_noise=True, ambient_db=-60.0),
    Noise(self_noise=True, gaussian=0.01, salt_and_pepper=0.01, median=3, interference_lines=2.0),
)
HIDING = Noise(ambient_db=0.0)  # nearly all echoes, so that labels go
FAST = Sampling(1.0, 24)


class Compilation(NamedTuple):
    """Result of `compile_everything`: functions in the package, those compiled now and not read from disk, seconds."""

    n_functions: int
    n_compiled: int
    seconds: float


class _Counter(event.Listener):
    """Counts compilations, calls `at_first` at the first, and reports the number every few seconds."""

    def __init__(self, report: Callable[[str], None] | None, at_first: Callable[[], None]):
        self.names, self._report, self._at_first = set(), report, at_first
        self._started_s = self._reported_s = time.monotonic()

    def on_start(self, found):
        dispatcher = found.data["dispatcher"]
        if not dispatcher.py_func.__module__.startswith("sonar_gl."):
            return
        if not self.names:
            self._at_first()
        self.names.add(_name(dispatcher))
        now = time.monotonic()
        if self._report is not None and now - self._reported_s > REPORT_S:
            self._reported_s = now
            self._report(
                f"compiling, once after each installation: {len(self.names)} of {len(compiled_functions())} "
                f"functions, {now - self._started_s:.0f} s"
            )

    def on_end(self, found):
        pass


def _name(dispatcher: Dispatcher) -> str:
    return f"{dispatcher.py_func.__module__}.{dispatcher.py_func.__name__}"


def compiled_functions() -> dict[str, Dispatcher]:
    """Return the compiled functions of all modules of the package that are loaded, by their full names."""
    return {
        _name(value): value
        for module_name, module in list(sys.modules.items())
        if module_name.startswith("sonar_gl.")
        for value in vars(module).values()
        if isinstance(value, Dispatcher)
        and value.py_func.__module__ == module_name
        and value.targetoptions.get("inline") != "always"  # which become part of others
    }


def cache_folder() -> str | None:
    """Return the folder below which the machine code of compiled functions is kept, or None if it is not kept."""
    paths = [path for function in compiled_functions().values() if (path := function.stats.cache_path)]
    return os.path.commonpath(paths) if paths else None


class _SecondProcess:
    """A process that compiles the second half of the functions, once it is started."""

    def __init__(self):
        self._process = None

    def start(self) -> None:
        """Start it if what it compiles is kept on disk, where this process finds it."""
        if cache_folder() is not None:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "sonar_gl.cli.compilation"],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,  # if it fails, this process compiles the rest, and says why that fails
                text=True,
            )

    def wait(self) -> set[str]:
        """Wait for its end; return the names of the functions that it has compiled."""
        return set() if self._process is None else set(self._process.communicate()[0].split())

    def stop(self) -> None:
        if self._process is not None and self._process.poll() is None:
            self._process.terminate()
            self._process.wait()


def compile_everything(report: Callable[[str], None] | None = None, processes: int = 2) -> Compilation:
    """Compile every compiled function of the package, or read its machine code from disk; Error without OpenGL.

    report : called with a line of text every few seconds while functions are compiled
    processes : 1 or 2
    """
    announce_compilation(False)  # the report says more
    second, start = _SecondProcess(), time.perf_counter()
    counter = _Counter(report, second.start if processes > 1 else lambda: None)
    with event.install_listener("numba:compile", counter), warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # tiny pings are coarse
        try:
            _draw()
            _work_without_opengl()
            names = second.wait()
        finally:
            second.stop()
        _receive()
    return Compilation(len(compiled_functions()), len(counter.names | names), time.perf_counter() - start)


def _draw():
    """Draw a scene with every profile; make a ping in motion, whose sums the other process has compiled by then."""
    for simulator in _simulators():
        with simulator:
            simulator.gbuffers(POSE)
    with Simulator(_scene(), SONAR, Acoustics.physical(multipath="none"), FAST) as simulator:
        simulator.ping(POSE, velocity=VELOCITY, time_s=1.0)


def _work_without_opengl():
    """Add every kind of noise to a ping; make images, boxes and files of it; make levels of detail; cast rays."""
    ping = _labelled_ping()
    for noise in NOISES:
        add_noise(replace(ping, texture_deviation=ping.intensity), noise, 0)
    add_noise(replace(ping, sonar=WIDE_BEAMS), Noise.physical(), 0)
    add_noise(replace(ping, meta={"labels_above_noise": True}), HIDING, 0)
    for density_m3 in (10.0, 1000.0):  # few scatterers in all bins, and many in the last ones
        murky = Acoustics.physical(water=Water(volume_backscatter_db=-60.0, scatterer_density_m3=density_m3))
        add_noise(replace(ping, acoustics=murky, volume=ping.intensity), Noise.physical(), 0)
    fan_image(ping, 40)
    boxes_of(ping, 40)
    body_map(ping, 40)
    with suppress(ModuleNotFoundError):  # the extra `batch` is not installed, or only parts of it
        cli.batch_compilation.encode_layers(ping)
    # levels of detail of a flat floor, the smallest that has any
    n = math.isqrt(MIN_FACES_TO_SIMPLIFY // 2) + 2
    floor = terrain(np.zeros((n, n)), (1.0, 1.0)).mesh
    make_levels(floor.vertices, floor.faces)
    if find_spec("embreex"):
        reference_ping(_scene(), SONAR, POSE, Acoustics.ideal(), 0.5, 1_000_000)


def _receive():
    """Make pings of depth images, and then of a scene: in motion, with labels, and in sequence."""
    _embed()
    for simulator in _simulators():
        with simulator:
            simulator.ping(POSE, Noise(speckle=True), velocity=VELOCITY, time_s=1.0)  # with a view of lobes
            simulator.ping(POSE, labels=True, background=["floor"])
            for _ in simulator.pings([POSE] * 6):
                pass
    with Simulator(_scene(), WIDE_BEAMS, Acoustics.physical(), FAST) as simulator:
        simulator.ping(POSE)
    with Simulator(_scene(), SONAR, Acoustics.ideal(), FAST) as simulator:
        demarco_image(simulator, POSE, height=40)


def _labelled_ping() -> Ping:
    """Return a ping that no scene has made, with labels."""
    ones = np.ones((SONAR.n_beams, SONAR.n_bins), np.float32)
    labels = dict.fromkeys(BIN_LABELS, ones)
    labels |= {"body_id": np.ones(ones.shape, np.uint16), "shadow": np.zeros(ones.shape, bool)}
    arrays = ones, SONAR.azimuth_rad, SONAR.range_m
    labels["body_echo"] = np.ones(2)
    for array in (ones, *labels.values()):
        array.setflags(write=False)  # as those of a simulator
    return Ping(*arrays, pose=POSE, sonar=SONAR, acoustics=Acoustics.physical(), **labels)


def _scene() -> Scene:
    """Return a scene with a floor, flat and smooth bodies, a reflectivity per face, small triangles, a
    texture, a hidden body and bubbles."""
    box, ball = trimesh.creation.box((0.5, 0.5, 0.5)), trimesh.creation.icosphere(4, 0.4)
    return Scene(
        [
            Body("floor", trimesh.creation.box((40.0, 40.0, 1.0)), pose(z=-2.5), "rock", speckle_shape=2.0),
            Body("box", box, pose(4.0, 0.5, -1.4), np.linspace(0.1, 1.0, len(box.faces))),
            Body(
                "ball", ball, pose(5.0, -0.6, -1.5), 0.5, ball.vertex_normals, specular=0.3, roughness_rad=0.1
            ),
            Body("buried", box, pose(4.0, 0.0, -2.4)),  # no sample meets it
            Bubbles("bubbles", pose(6.0, 0.0, -2.0)),
        ],
        surface_z_m=0.0,
    )


def _simulators() -> Iterator[Simulator]:
    """Yield simulators of every profile, reducer and kind of multipath."""
    for acoustics, sampling in (
        (Acoustics.physical(multipath="incoherent"), FAST),
        (Acoustics.physical(multipath="coherent"), None),
        (Acoustics.demarco2015(), FAST),
        (Acoustics.ideal(), replace(FAST, reducer="point")),
        (Acoustics.ideal(), None),
    ):
        # low enough to keep weak image sources; with 0.001 these had so many samples that it took seconds more
        yield Simulator(_scene(), SONAR, acoustics, sampling, 0.1 if sampling is None else 0.02)


def _embed():
    """Make pings of depth images: one camera and several, planar and range, with normals and without."""
    camera = Camera.of_fov(32, 24, fov_x_rad=0.8)
    depth = metres_ahead(np.full((24, 32), 0.9, np.float32), camera.projection(0.1, 10.0))
    normals, numbers = np.zeros((24, 32, 3), np.float32), np.ones((24, 32), np.uint16)
    with Sensor(SONAR, Acoustics.physical(multipath="none")) as sensor:
        sensor.ping_from_depth(depth, camera)
        sensor.ping_from_depth(depth, camera, holds="range", normals=normals, body_id=numbers, labels=True)
        sensor.ping_from_depth([depth, depth], [camera, camera], body_id=[numbers, numbers], labels=True)


def main():
    """Compile what `_receive` calls, and print the names of the functions that were not on disk."""
    announce_compilation(False)
    counter = _Counter(None, lambda: None)
    with event.install_listener("numba:compile", counter), warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        _receive()
    print(*counter.names, sep="\n")


if __name__ == "__main__":
    main()
