"""A scene in a context: what the simulators of several sonars may share."""

from __future__ import annotations

import os
import threading
from contextlib import contextmanager
from dataclasses import replace

import numpy as np

from sonar_gl import egl, gl
from sonar_gl.bubbles import Bubbles
from sonar_gl.draws import REFLECTIVITY, Whereabouts
from sonar_gl.foreign import check_thread, join
from sonar_gl.gpu import SceneOnGpu
from sonar_gl.load import data_folder
from sonar_gl.scene import Body, Scene, check_pose
from sonar_gl.types import Error, check_kind


def _seconds(time_s) -> float:
    if isinstance(time_s, bool) or not isinstance(time_s, (int, float, np.number)):
        raise Error(f"time_s must be a number of seconds (got {time_s!r})")
    if not abs(time_s) <= 1e10:  # NaN too; that is Unix time with room to spare
        raise Error(f"time_s must be seconds within ±1e10 (got {time_s!r})")
    return float(time_s)


class World:
    """A context and a scene's bodies in it, used by one simulator or several, one at a time.

    Parameters
    ----------
    device, context : as for `Simulator`

    Attributes
    ----------
    scene : Scene, of all bodies that there are
    plumes : where its plumes are by name, (4, 4) world_from_plume, or None for what is not there
    """

    def __init__(self, scene: Scene, device: int | None = None, context: str | None = None):
        if context not in (None, "current") or (context and device is not None):
            got = f"{context!r}" if device is None else f"{context!r} and device {device!r}"
            raise Error(f"context must be 'current' without a device, or None (got {got})")
        joins = context is not None
        self.context, self.lock, self.process = None, threading.Lock(), os.getpid()
        self.thread = threading.current_thread() if joins else None
        self.scene, self.users = scene, 0
        self.plumes = {plume.name: plume.pose for plume in scene.plumes}
        gl.release_discarded()
        with egl.kept():
            self.context = join() if joins else gl.create_context(device)
        try:
            with self.context:
                self.gl_info = gl.describe(self.context)
                self.gpu = SceneOnGpu(self.context, scene, data_folder("shaders"))
        except BaseException:
            gl.discard(self.context)  # the exception holds what is in it
            raise
        self._number()

    def _number(self):
        self.numbers = {body.name: number for number, body in enumerate(self.scene.bodies)}

    def check_thread(self) -> None:
        """An Error in another thread than that whose context was joined."""
        if self.thread is not None:
            check_thread(self.thread)

    @contextmanager
    def drawing(self):
        """The context, current for the time of the block, in one thread at a time."""
        if os.getpid() != self.process:
            raise Error("a Simulator must be used in the process that made it; make one in each process")
        self.check_thread()
        with self.lock:
            if self.context is None:
                raise Error("this Simulator is closed; make a new one")
            gl.release_discarded()
            with self.context as context:
                context.gc()
                yield context

    @property
    def where(self) -> Whereabouts:
        """The bodies, for pings that are not told otherwise."""
        return self.gpu.stock.where

    def moved(self, bodies, time_s=None, with_bubbles: bool = False, reflectivity=None) -> Whereabouts:
        """Where bodies are when some are elsewhere, or reflect otherwise, and bubbles at a time.

        Parameters
        ----------
        bodies : None, or names to (4, 4) world_from_body, or to None for what is not there
        time_s : seconds, None for 0
        with_bubbles : of the scene's plumes, if there are any
        reflectivity : None, or names of bodies to μ, 0..1
        """
        where, plumes = self._moved(bodies)
        if time_s is not None:
            where = replace(where, time_s=_seconds(time_s))
        if reflectivity is not None:
            where = replace(where, reflectivity=self._reflectivity(reflectivity))
        if not (with_bubbles and self.scene.plumes):
            return where
        there = [plume for plume in self.scene.plumes if plumes[plume.name] is not None]
        found = [np.column_stack(plume.at(where.time_s or 0.0, plumes[plume.name])) for plume in there]
        bubbles = np.concatenate([np.empty((0, 4)), *found])
        if self.scene.surface_z_m is not None:
            bubbles = bubbles[bubbles[:, 2] < self.scene.surface_z_m]
        return replace(where, bubbles=bubbles)

    def place(self, bodies) -> None:
        """Have bodies elsewhere from now on, as for `moved`; inside `drawing`."""
        self.gpu.stock.where, self.plumes = self._moved(bodies)

    def _moved(self, bodies) -> tuple[Whereabouts, dict]:
        if not bodies:
            return self.where, self.plumes
        check_kind("bodies", bodies, dict, 'such as {"diver": sonar_gl.pose(x=5)}, or None for "not there"')
        poses, shown, plumes = self.where.poses.copy(), self.where.shown.copy(), dict(self.plumes)
        for name, pose in bodies.items():
            if name in plumes:
                plumes[name] = pose if pose is None else check_pose(pose, f"the pose of bubbles {name!r}")
                continue
            number = self._number_of(name, "bodies", plumes)
            shown[number] = pose is not None
            if pose is not None:
                poses[number] = check_pose(pose, f"the pose of body {name!r}")
        return Whereabouts(poses, shown), plumes

    def _number_of(self, name, what: str, plumes=()) -> int:
        if name not in self.numbers:
            known = ", ".join(map(repr, [*self.numbers, *plumes])) or "none"
            raise Error(f"{what} must be bodies of the scene (got {name!r}; there are: {known[:200]})")
        return self.numbers[name]

    def _reflectivity(self, changed) -> np.ndarray:
        check_kind("reflectivity", changed, dict, 'such as {"diver": 0.2}')
        out = self.gpu.stock.rows[:, REFLECTIVITY].copy()
        for name, value in changed.items():
            number = self._number_of(name, "names in reflectivity")
            is_number = isinstance(value, (int, float, np.number)) and not isinstance(value, bool)
            if not (is_number and 0 <= value <= 1):  # NaN too
                raise Error(f"the reflectivity of body {name!r} must be a number in 0..1 (got {value!r})")
            out[number] = value
        return out

    def add(self, bodies) -> None:
        """More bodies or plumes; inside `drawing`."""
        for body in bodies:
            check_kind("body", body, Body | Bubbles, "such as sonar_gl.Body('box', mesh)")
        self.scene = self.scene.with_more(bodies)
        self.gpu.add([body for body in bodies if isinstance(body, Body)])
        self.plumes |= {body.name: body.pose for body in bodies if isinstance(body, Bubbles)}
        self._number()

    def leave(self, give_back) -> None:
        """One user less: have it give its GL objects back; after the last the context goes, too."""
        if os.getpid() != self.process:  # of a fork: the context and the lock are the parent's
            return
        with self.lock:
            self.users -= 1
            context, last = self.context, self.users == 0
            give_back()
            if last:
                self.context = self.gpu = None
                gl.release(context)
        gl.release_discarded()

    def forget(self) -> None:
        """One user less who was not closed: nothing may be drawn or released now."""
        self.users -= 1
        if self.users == 0 and self.context is not None and os.getpid() == self.process:
            gl.discard(self.context)
