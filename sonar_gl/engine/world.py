"""A scene in a raster engine: what the simulators of several sonars may share."""

from __future__ import annotations

import os
import threading
from collections import ChainMap
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from weakref import WeakSet

import numpy as np

from sonar_gl.core.checks import check_kind, check_number, is_number, shown, unknown_body_error
from sonar_gl.core.cores import n_threads
from sonar_gl.core.errors import Error, closed_error, other_process_error
from sonar_gl.core.poses import MAX_TIME_S, check_pose, unscaled
from sonar_gl.core.worker import Job, SecondThread, ThreadLock
from sonar_gl.raster.engine import RasterEngine, make_engine
from sonar_gl.scene.grown_scene import GrownScene
from sonar_gl.scene.kept_meshes import KeptMeshes
from sonar_gl.scene.plume import Bubbles
from sonar_gl.scene.scene import Body, Scene, check_added, poses_of_parts
from sonar_gl.scene.state import SceneState

IN_USE = (
    "a Simulator must not be used while it makes a ping "
    "(got a call from a signal handler or another callback; have it set a flag, and act after the ping)"
)

BODIES_CURE = 'such as {"diver": sonar_gl.pose(x=5)}, or None for "not there"'  # for messages


class World:
    """A scene's bodies in a raster engine, used by one simulator or several, one at a time.

    engine, device, context : as for `Simulator`; later `engine` is the RasterEngine, None once it is given back
    thread : SecondThread, which all simulators share; None where no core is free for it
    gl_info : names and limits of what draws
    n_changes : how often bodies were placed elsewhere or added, but while a sequence takes its requests
    """

    def __init__(
        self, scene: Scene, engine: str | None = None, device: int | None = None, context: str | None = None
    ):
        self.engine: RasterEngine | None = None
        self._lock, self._process = ThreadLock(IN_USE), os.getpid()
        self._kept_meshes = KeptMeshes()
        self._models = scene.models
        self._given, self._kept = GrownScene(scene), GrownScene(self._kept_meshes.scene(scene))
        self._users, self._jobs = set(), WeakSet()
        self.thread = SecondThread() if n_threads() > 1 else None
        self.n_changes, self._taking = 0, threading.local()
        self._plume_poses = {plume.name: plume.pose for plume in scene.plumes}
        # of the last ping with any: the time, the plumes and their poses, and what came of these
        self._released = 0.0, [], np.empty((0, 4))
        self.engine = make_engine(self.scene, engine, device, context)
        self.gl_info = self.engine.driver
        self._indices: dict[str, int] = {}  # of the first bodies; see `_numbered`

    @property
    def given_scene(self) -> Scene:
        """Scene of all bodies as they were given."""
        return self._given.scene

    @property
    def scene(self) -> Scene:
        """The same with copies of their meshes, which stay as they are drawn."""
        return self._kept.scene

    def check_idle(self) -> None:
        """Raise an Error if this thread is in the middle of drawing."""
        self._lock.check_free()

    def check_thread(self) -> None:
        """Raise an Error in a thread that may not draw."""
        if self.engine is not None:
            self.engine.check_thread()

    @contextmanager
    def unchanged(self):
        """Have no other thread change the scene, or draw, for the time of the block."""
        if os.getpid() != self._process:
            raise other_process_error("Simulator")
        self.check_thread()
        with self._lock.held():
            if self.engine is None:
                raise closed_error("Simulator")
            yield

    def await_job(self, job: Job) -> None:
        """Have `add` wait for a job, of any user, that draws in another thread; inside `Run.drawing`."""
        self._jobs.add(job)

    def state_of(self, bodies, time_s=None, needs_bubbles: bool = False, reflectivity=None) -> SceneState:
        """Return where bodies and bubbles are in a ping.

        Raises Error if a name is of nothing in the scene, or a value is not one of these.

        bodies : None, or names to (4, 4) world_from_body, which may scale by one factor for all axes, or to None for a
            body that is absent; the name of a model of the scene stands for all that is in it
        time_s : seconds, None for 0
        needs_bubbles : of the scene's plumes, if there are any
        reflectivity : None, or names of bodies to μ, 0..1
        """
        state, plume_poses = self._moved(bodies)
        if time_s is not None:
            time_s = check_number("time_s", time_s, -MAX_TIME_S, MAX_TIME_S, "give seconds")
            state = replace(state, time_s=time_s)
        if reflectivity is not None:
            state = replace(state, reflectivity=self._reflectivity(reflectivity))
        if not (needs_bubbles and self.scene.plumes):
            return state
        return replace(state, bubbles=self._bubbles_at(state.time_s or 0.0, plume_poses))

    def _bubbles_at(self, time_s: float, plume_poses: dict) -> np.ndarray:
        """Return the bubbles of the plumes that are present: those of the ping before, where nothing differs.

        They take a millisecond to find, and most pings of a simulator have no time of their own.
        """
        plumes = [plume for plume in self.scene.plumes if plume_poses[plume.name] is not None]
        poses = [plume_poses[plume.name] for plume in plumes]
        last_s, last, bubbles = self._released
        is_same = time_s == last_s and len(last) == 2 * len(plumes)
        if not (is_same and all(one is other for one, other in zip(last, plumes + poses, strict=True))):
            found = map(
                np.column_stack, (one.at(time_s, pose) for one, pose in zip(plumes, poses, strict=True))
            )
            bubbles = np.concatenate([np.empty((0, 4)), *found])
            if self.scene.surface_z_m is not None:
                bubbles = bubbles[bubbles[:, 2] < self.scene.surface_z_m]
            bubbles.setflags(write=False)
            self._released = time_s, plumes + poses, bubbles
        return bubbles

    def mask_of(self, names) -> np.ndarray:
        """Return (bodies + 1,) bool by number, True for these bodies: a background for shadows.

        Raises Error if a name is of no body in the scene.
        """
        out = np.zeros(len(self.scene.bodies) + 1, bool)
        for name in names:
            out[1 + self._index_of(name, "background")] = True
        return out

    def place(self, bodies) -> None:
        """Put bodies elsewhere from now on; parameter and errors as of `state_of`; inside `drawing`."""
        check_kind("bodies", bodies, dict, BODIES_CURE)
        before, plumes = self.engine.meshes.state, self._plume_poses
        self.engine.meshes.state, self._plume_poses = self._moved(bodies)
        state = self.engine.meshes.state
        is_moved = not (
            np.array_equal(state.poses, before.poses) and np.array_equal(state.present, before.present)
        )
        self._count_change(is_moved or any(self._plume_poses[name] is not plumes[name] for name in plumes))

    def next_request(self, requests: Iterator):
        """Return the next request of a sequence; count no changes meanwhile: its generator places bodies in time."""
        # a generator may take from a sequence itself: the inner call must not end the outer one
        before = self._is_taking_request()
        self._taking.request = True
        try:
            return next(requests)
        finally:
            self._taking.request = before

    def _is_taking_request(self) -> bool:
        return getattr(self._taking, "request", False)

    def _count_change(self, has_changed: bool) -> None:
        self.n_changes += has_changed and not self._is_taking_request()

    def _moved(self, bodies) -> tuple[SceneState, dict]:
        """Return where bodies are with some of them elsewhere, and the poses of plumes; `bodies` as of `state_of`."""
        state = self.engine.meshes.state
        if bodies is None:
            return state, self._plume_poses
        check_kind("bodies", bodies, dict, BODIES_CURE)
        if not bodies:
            return state, self._plume_poses
        poses, present, plume_poses = state.poses.copy(), state.present.copy(), dict(self._plume_poses)
        for name, pose in poses_of_parts(bodies, self._parts_of).items():
            if name in plume_poses:
                if pose is not None:  # bubbles have the size that they have
                    pose = unscaled(check_pose(pose, f"the pose of bubbles {name!r}", may_scale=True))
                plume_poses[name] = pose
                continue
            index = self._index_of(name, "bodies", plume_poses, self._models)
            present[index] = pose is not None
            if pose is not None:
                poses[index] = check_pose(pose, f"the pose of body {name!r}", may_scale=True)
        return SceneState(poses, present), plume_poses

    def _parts_of(self, name) -> dict[str, np.ndarray]:
        """Return `Scene.parts_of`; the scene is not put together for this alone, as after each of many adds."""
        return self.scene.parts_of(name) if name in self._models else {}

    def _index_of(self, name, what: str, plumes=(), models=()) -> int:
        """Return the index of a body by its name.

        what : that names it, for the message of an Error
        plumes, models : names that may stand there, too
        """
        indices = self._numbered()
        if name not in indices:
            empty = {model for model in models if not self.scene.parts_of(model)}
            known = {*indices, *plumes, *models} - empty
            raise unknown_body_error(name, known, f"{what} must be bodies of the scene", empty)
        return indices[name]

    def _numbered(self) -> dict[str, int]:
        """Return the index of each body by its name; those of bodies that were added since the last call are found."""
        bodies, indices = self.engine.meshes.bodies, self._indices
        for index in range(len(indices), len(bodies)):
            indices[bodies[index].name] = index
        return indices

    def _reflectivity(self, changed) -> np.ndarray:
        check_kind("reflectivity", changed, dict, 'such as {"diver": 0.2}')
        out = self.engine.meshes.reflectivity.copy()
        for name, value in changed.items():
            index = self._index_of(name, "names in reflectivity")
            if not (is_number(value) and 0 <= value <= 1):  # NaN too
                raise Error(
                    f"the reflectivity of body {name!r} must be a number in 0..1 (got {shown(value)})"
                )
            out[index] = value
        return out

    def add(self, bodies) -> None:
        """Append bodies or plumes; inside `drawing`.

        Raises Error if one is neither, or has a name that the scene has; if there are too many; or in the middle of a
        ping that another simulator makes in this thread.
        """
        for body in bodies:
            check_kind("body", body, Body | Bubbles, "such as sonar_gl.Body('box', mesh)")
        indices = self._numbered()
        check_added(bodies, len(indices), ChainMap(indices, self._plume_poses))
        kept = self._kept_meshes.bodies(bodies)
        contents = self.engine.with_more([body for body in kept if isinstance(body, Body)])
        given_scene, scene = self._given.with_more(bodies), self._kept.with_more(kept)
        plume_poses = {body.name: body.pose for body in bodies if isinstance(body, Bubbles)}
        plume_poses = self._plume_poses | plume_poses
        # compiled code would look for these bodies in the states of pings that lack them
        jobs = list(self._jobs)
        for job in jobs:
            job.check_free()  # all of them first: others may wait for the one that this thread is in the middle of
        for job in jobs:
            job.settle()
        # all in one step: an interrupt before it leaves the scene without these bodies
        self.engine.contents, self._given, self._kept, self._plume_poses = (
            contents, given_scene, scene, plume_poses
        )  # fmt: skip
        self._count_change(bool(bodies))

    def join(self, user: int) -> None:
        """Count one user more, by its id."""
        self._users.add(user)

    def leave(self, user: int, release) -> None:
        """Take one user less: `release` drops what it has in the engine; after the last user the engine goes, too.

        After an interrupt, call it again: each step may be repeated.
        """
        if os.getpid() != self._process:  # of a fork: the engine and the lock are the parent's
            return
        # a function alone: what still held the engine would keep its objects
        release_waiting = None if self.engine is None else self.engine.release_waiting
        with self._lock.held():
            release()
            self._users.discard(user)
            if not self._users:
                self._close_thread()
                if self.engine is not None:
                    self.engine.discard()
                self.engine = None
        if release_waiting is not None:
            release_waiting()

    def _close_thread(self) -> None:
        if self.thread is not None:
            self.thread.close()

    def forget(self, user: int) -> None:
        """Take one user less that was not closed: nothing may be drawn or released now."""
        self._users.discard(user)
        if not self._users and self.engine is not None and os.getpid() == self._process:
            self._close_thread()
            self.engine.discard()
