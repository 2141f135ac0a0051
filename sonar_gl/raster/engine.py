"""The two raster engines behind one interface, and the choice between them."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from sonar_gl.core.errors import Error
from sonar_gl.core.worker import SecondThread
from sonar_gl.raster import opengl
from sonar_gl.raster.cpu.engine import CpuEngine
from sonar_gl.raster.engine_names import ENGINES
from sonar_gl.raster.scene_meshes import SceneMeshes
from sonar_gl.raster.views import MAX_SAMPLES, RenderWorkspace
from sonar_gl.scene.scene import Scene
from sonar_gl.sonar.fan import Fan
from sonar_gl.sonar.samples import ViewSamples

ENGINE_VARIABLE, DEVICE_VARIABLE = "SONAR_GL_ENGINE", "SONAR_GL_DEVICE"
WITHOUT_EGL = "darwin", "win32"  # systems on which the package that makes contexts has none by EGL
# Files of graphics drivers in /dev: a machine without any of them has no graphics card, and needs no OpenGL to say so.
CARDS = "dri/renderD*", "nvidia[0-9]*", "dxg", "mali*", "kgsl*"


class Renderer(Protocol):
    """Draws a fan's sectors side by side, an image for each pose. Of each sector only the window that holds bodies
    is drawn.
    """

    def render(
        self,
        poses: Sequence[np.ndarray],
        states: Sequence = (None,),
        with_bodies: bool = False,
        full: bool = False,
        planes: Sequence | None = None,
        keep_last: bool = False,
    ) -> list[ViewSamples]:
        """Draw all sectors as seen from some poses, world_from_sonar.

        The next call, of any renderer that shares the workspace, overwrites the samples.

        Raises SampleLimitError if there are more samples than fit.

        poses, states : of the sonar, and for each the SceneState, or None for that of the meshes
        with_bodies : with the bodies' numbers
        full : draw the empty water, too, instead of the window that holds bodies
        planes : clip plane of each pose, before which all lies that is drawn, or None: the water's surface
        keep_last : the samples of the last call stay valid until the next one
        """

    def prepare(self, n_samples: int, share: float) -> None:
        """Have the memory of a view of so many samples ready before it is drawn, where new memory takes time.

        Samples that were drawn stay valid.

        share : of what is missing
        """


class RasterEngine(Protocol):
    """Draws the bodies of a scene.

    name : one of ENGINES, but "auto"
    draws_in_threads : whether several threads may draw at once, each with renderers of a workspace of its own. If not,
        the thread of the caller draws all pings of a sequence
    driver : names and limits of what draws, which `Simulator.gl_info` shows: "engine" is the name; "renderer",
        "vendor" and "version" are text, of which pings and batches record some; others are for reports alone
    contents : the meshes as they are drawn; replaced as a whole when bodies are added
    meshes : SceneMeshes of the contents
    """

    name: str
    draws_in_threads: bool
    driver: dict[str, Any]
    contents: Any
    meshes: SceneMeshes

    def with_more(self, bodies) -> Any:
        """Return contents with more bodies; inside `drawing`."""

    def make_workspace(
        self, most_samples: int = MAX_SAMPLES, beside: RenderWorkspace | None = None
    ) -> RenderWorkspace:
        """Return memory to draw into, for views of at most so many samples.

        beside : into which nobody draws at the same time; it may share what a view needs while it is drawn
        """

    def make_renderer(
        self, fan: Fan, specular: bool, workspace: RenderWorkspace, thread: SecondThread | None = None
    ) -> Renderer:
        """Return a renderer; inside `drawing`.

        specular : add the specular lobes of smooth bodies
        thread : may draw the second half of a ping
        """

    def check_thread(self) -> None:
        """Raise an Error if this thread may not draw."""

    def drawing(self) -> AbstractContextManager:
        """Have the engine ready to draw for the time of the block."""

    def collect(self) -> None:
        """Give back the memory of what nobody holds any more; inside `drawing`."""

    def discard(self) -> None:
        """Have all that it holds released by a later call; a finaliser may call this."""

    @staticmethod
    def release_waiting() -> None:
        """Release what was discarded, and is held by nobody; not inside `drawing`."""


def check_engine(engine: str | None) -> str:
    """Return the engine that is asked for: the argument, or SONAR_GL_ENGINE, or "auto"."""
    asked, where = engine, ""
    if engine is None:
        asked = os.environ.get(ENGINE_VARIABLE, "").strip() or "auto"
        where = f", by the variable {ENGINE_VARIABLE}"
    if not isinstance(asked, str) or asked not in ENGINES:
        raise Error(f"the engine must be one of {', '.join(ENGINES)} (got {asked!r}{where})")
    return asked


def has_graphics_card() -> bool:
    """Return whether EGL may have a graphics card, by the files of its driver; True where that does not tell."""
    if sys.platform in WITHOUT_EGL:
        return False
    return sys.platform != "linux" or any(any(Path("/dev").glob(pattern)) for pattern in CARDS)


def make_engine(
    scene: Scene, engine: str | None = None, device: int | None = None, context: str | None = None
) -> RasterEngine:
    """Return the engine that draws a scene.

    Raises Error if there is no usable OpenGL where it is asked for, or the arguments contradict each other.

    engine : "opengl"; "cpu"; "auto" takes OpenGL where a graphics card has it, or a device or context is given, and
        else the CPU; None takes what the environment variable SONAR_GL_ENGINE says, or "auto"
    device : index of an EGL device; None takes that of SONAR_GL_DEVICE, or else the first
    context : "current" joins the OpenGL context that is current; None creates one
    """
    is_known = context is None or (isinstance(context, str) and context == "current")
    if not is_known or (context is not None and device is not None):
        got = f"{context!r}" if device is None else f"{context!r} and device {device!r}"
        cure = "" if isinstance(context, str) else "; make a host's context current, and give 'current'"
        raise Error(f"context must be 'current' without a device, or None (got {got}{cure})")
    asked = check_engine(engine)
    if engine == "cpu" and (context is not None or device is not None):
        got = f"context {context!r}" if context is not None else f"device {device!r}"
        raise Error(f"the cpu engine needs no OpenGL (got {got}; leave it out, or ask for engine 'opengl')")
    if context is not None:
        return opengl.engine.OpenGLEngine(scene, None)
    is_sure = asked == "opengl" or device is not None
    is_sure |= asked == "auto" and bool(os.environ.get(DEVICE_VARIABLE, "").strip())
    if not is_sure and (asked == "cpu" or not has_graphics_card()):
        return CpuEngine(scene)
    # loaded here alone, since the CPU needs nothing of OpenGL
    made = opengl.engine.by_device(scene, device) if is_sure else opengl.engine.by_card(scene)
    return made or CpuEngine(scene)
