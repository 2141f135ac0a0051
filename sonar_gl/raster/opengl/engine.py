"""A scene in an OpenGL context, and what draws it."""

from __future__ import annotations

import threading
from contextlib import contextmanager

import moderngl

from sonar_gl.core.worker import SecondThread
from sonar_gl.gl import context as gl
from sonar_gl.gl import egl, lifetime
from sonar_gl.gl.host import check_thread, join
from sonar_gl.raster.opengl.buffers import SceneBuffers, UploadedMeshes
from sonar_gl.raster.opengl.renderer import OpenGLRenderer, OpenGLWorkspace
from sonar_gl.raster.scene_meshes import SceneMeshes
from sonar_gl.raster.views import MAX_SAMPLES
from sonar_gl.scene.scene import Scene
from sonar_gl.sonar.fan import Fan


class OpenGLEngine:
    """Draws the bodies of a scene by OpenGL. A `RasterEngine`.

    context : of its own, which goes with it; None joins the context that is current, a host's
    """

    name, draws_in_threads = "opengl", False  # a context is current in one thread

    def __init__(self, scene: Scene, context: moderngl.Context | None):
        self._host_thread = threading.current_thread() if context is None else None
        with egl.preserve_current():
            self._context = join() if context is None else context
        try:
            with self._context:
                self.driver = {"engine": self.name, **gl.describe(self._context)}
                self._buffers = SceneBuffers(self._context, scene)
        except BaseException:
            lifetime.discard(self._context)  # the exception holds what is in it
            raise

    @property
    def contents(self) -> UploadedMeshes:
        """The meshes in GL buffers."""
        return self._buffers.uploaded

    @contents.setter
    def contents(self, more: UploadedMeshes) -> None:
        self._buffers.uploaded = more

    @property
    def meshes(self) -> SceneMeshes:
        """The bodies and their poses."""
        return self._buffers.meshes

    def with_more(self, bodies) -> UploadedMeshes:
        return self._buffers.uploaded.with_more(bodies)

    def make_workspace(
        self, most_samples: int = MAX_SAMPLES, beside: OpenGLWorkspace | None = None
    ) -> OpenGLWorkspace:
        return OpenGLWorkspace(self._context, most_samples)

    def make_renderer(
        self, fan: Fan, specular: bool, workspace: OpenGLWorkspace, thread: SecondThread | None = None
    ) -> OpenGLRenderer:
        return OpenGLRenderer(self._buffers, fan, specular, workspace)  # the driver has threads of its own

    def check_thread(self) -> None:
        if self._host_thread is not None:
            check_thread(self._host_thread)

    @contextmanager
    def drawing(self):
        lifetime.release_waiting()
        # after an interrupt in the context's own end, the outer manager still makes it not current
        with egl.preserve_current(), self._context as context:
            context.gc()
            yield context

    def collect(self) -> None:
        self._context.gc()

    def discard(self) -> None:
        lifetime.discard(self._context)

    @staticmethod
    def release_waiting() -> None:
        lifetime.release_waiting()


def by_device(scene: Scene, device: int | None) -> OpenGLEngine:
    """Return an engine on an EGL device; None takes that of SONAR_GL_DEVICE, or else the first.

    Raises Error if there is no EGL or no such device, or the driver is too old.
    """
    with egl.preserve_current():  # a new context is current at first
        context = gl.create_context(device)
    return OpenGLEngine(scene, context)


def by_card(scene: Scene) -> OpenGLEngine | None:
    """Return an engine on a graphics card; None if OpenGL is missing or in software."""
    with egl.preserve_current():
        context = gl.hardware_context()
    return None if context is None else OpenGLEngine(scene, context)
