"""One run: the GL objects of a scene and a sonar, and the stages that make pings of them."""

from __future__ import annotations

import math
import os
import pickle
import threading
import warnings
from collections.abc import Iterable
from contextlib import contextmanager
from dataclasses import asdict, replace

import numpy as np

from sonar_gl import gl
from sonar_gl._version import __version__
from sonar_gl.acoustics import Acoustics
from sonar_gl.fan import Fan, Sampling, make_fan
from sonar_gl.gpu import SceneOnGpu
from sonar_gl.load import data_folder
from sonar_gl.noise import Noise, add_noise, check_seed
from sonar_gl.nothing import why_nothing
from sonar_gl.passes import Fixed, Passes
from sonar_gl.plan import Plan, Planner
from sonar_gl.render import Renderer
from sonar_gl.scene import Scene, check_pose
from sonar_gl.sonar import Sonar
from sonar_gl.types import Error, GBuffer, Ping, check_kind


class Simulator:
    """Makes pings of a scene with a sonar. Use it in a `with` block, or call `close()`.

    Parameters
    ----------
    scene : Scene
    sonar : Sonar
    acoustics : Acoustics; None is `Acoustics.physical()`
    sampling : Sampling, overrides what `tolerance` would choose
    tolerance : 0.001..0.5, the share of the echo that may lie in wrong bins

    Raises
    ------
    Error
        if there is no usable OpenGL, or the samples do not fit its limits.
    """

    def __init__(
        self,
        scene: Scene,
        sonar: Sonar,
        acoustics: Acoustics | None = None,
        sampling: Sampling | None = None,
        tolerance: float = 0.01,
    ):
        for name, value, kind, cure in (
            ("scene", scene, Scene, "sonar_gl.load_scene makes one from a name or a file"),
            ("sonar", sonar, Sonar, "sonar_gl.load_sonar makes one from a name or a file"),
            ("acoustics", acoustics, Acoustics | None, "such as sonar_gl.Acoustics.physical()"),
            ("sampling", sampling, Sampling | None, "such as sonar_gl.Sampling(2, 100)"),
        ):
            check_kind(name, value, kind, cure)
        self.scene, self.sonar = scene, sonar
        self.acoustics = acoustics if acoustics is not None else Acoustics.physical()
        self._context, self._lock, self._process = None, threading.Lock(), os.getpid()
        self._azimuth_rad, self._range_m = sonar.azimuth_rad, sonar.range_m
        self._azimuth_rad.setflags(write=False)  # all pings share them
        self._range_m.setflags(write=False)
        self._context = gl.create_context()
        with self._context:
            self.gl_info = gl.describe(self._context)
            gpu = SceneOnGpu(self._context, scene, data_folder("shaders"))
            self._passes = Passes(gpu, sonar, self.acoustics)
            self._samples = (
                Planner(self._passes, scene, tolerance) if sampling is None else Fixed(self._passes, sampling)
            )
            self._passes.warm()
        meta = {
            "sonar": asdict(sonar),
            "acoustics": self.acoustics.meta(),
            "profile": self.acoustics.profile,
            "tolerance": self._samples.tolerance,
            "bin_size_m": sonar.bin_size_m,
            "scene": scene.name,
            "bodies": [body.name for body in scene.bodies],
            "version": __version__,
            "gl_renderer": self.gl_info["renderer"],
        }
        self._meta = pickle.dumps(meta)  # each ping gets its own copy, ten times quicker than by deepcopy

    @property
    def sampling(self) -> Sampling:
        """The samples of the last ping, or of the first to come."""
        return self._samples.now.sampling

    @property
    def fan(self) -> Fan:
        """The fan with these samples."""
        return self._samples.now.fan

    def plan(self, poses) -> Plan | None:
        """Choose the samples for these poses, a few of a long sequence, and stay with them from now on.

        Without this a tolerance is looked after ping by ping, and the samples of one depend on those before.

        Parameters
        ----------
        poses : sequence of (4, 4) world_from_sonar

        Returns
        -------
        Plan, or None if the samples were given to begin with
        """
        if not isinstance(poses, Iterable) or np.ndim(poses) == 2:
            raise Error(f"poses must be several poses (got {type(poses).__name__}; make [pose] of one)")
        if not (poses := [check_pose(pose) for pose in poses]):
            raise Error("poses must hold at least one pose (got none)")
        with self._drawing():
            plan = self._samples.fix(poses)
        self._warn()
        return plan

    def _warn(self):
        if self._samples.warning:
            warnings.warn(self._samples.warning, stacklevel=3)
            self._samples.warning = None

    def ping(
        self, pose, noise: Noise | None = None, seed: int = 0, labels: bool = False, ping_number: int = 0
    ) -> Ping:
        """One transmission from `pose` and what it brings back.

        Parameters
        ----------
        pose : (4, 4) world_from_sonar, metres; `sonar_gl.pose` makes one from x y z roll pitch yaw
        noise : Noise, or None for none
        seed, ping_number : of the noise; the same two give the same bytes
        labels : also find the body of the strongest echo in each bin, and its elevation

        Warns
        -----
        UserWarning
            if nothing came back, saying what was nearest and why.
        """
        pose, seed = check_pose(pose), check_seed(seed)
        check_kind("noise", noise, Noise | None, "such as sonar_gl.Noise.physical()")
        body_id = elevation_rad = body_echo = None
        with self._drawing():
            views, intensity = self._samples.sense(pose, labels)
            if labels:
                now, n_bodies = self._samples.now, len(self.scene.bodies)
                body_id, elevation_rad, body_echo = now.reducer.labels(views, now.gain, n_bodies)
            has_echo = bool(intensity.max() > 0)
            if not has_echo:
                warnings.warn(why_nothing(self.scene, self.sonar, pose, views), stacklevel=2)
        self._warn()
        for array in (intensity, body_id, elevation_rad, body_echo):
            if array is not None:
                array.setflags(write=False)
        ping = Ping(
            intensity,
            self._azimuth_rad,
            self._range_m,
            body_id,
            elevation_rad,
            pose,
            {
                **pickle.loads(self._meta),
                "sampling": asdict(self.sampling),
                "seed": seed,
                "has_echo": has_echo,
            },
            body_echo,
            self._samples.estimate(pose),
        )
        return ping if noise is None else add_noise(ping, noise, seed, ping_number)

    def gbuffers(self, pose) -> list[GBuffer]:
        """What the depth + normal pass sees from `pose`, one G-buffer a sector of `self.fan.sectors`."""
        with self._drawing():
            self._samples.now.views(check_pose(pose), labels=True, whole=True)
            return self._samples.now.renderer.gbuffers()

    def point_cloud(self, pose, columns: int, rows: int):
        """Points of a plain grid of rays over the field of view, as a ray sensor would give them.

        Returns
        -------
        points : (rows', columns', 3) float32, metres, sonar frame; NaN where nothing was met. About as many
            as asked for: beyond one perspective view, columns' is a multiple of the views
        echo : (rows', columns') float32, μ cos θ
        """
        # one beam a column, that reach to the edges of the field of view and not beyond
        sonar = replace(self.sonar, n_beams=columns, beam_azimuths_deg=None)
        reach = math.radians(sonar.azimuth_fov_deg) / columns / 2
        fan = make_fan(sonar, Sampling(1, rows), reach, shear=0.0)
        with self._drawing() as context:
            renderer = Renderer(context, self._passes.gpu, fan)
            renderer.render(check_pose(pose), whole=True)
        points, echoes = [], []
        for sector, plane_echo, _ in renderer.views():
            u, v = sector.rays()
            q = plane_echo[..., 0]
            missed = (q <= 0) | (np.abs(v) > sector.tan_elevation * np.sqrt(1 + u * u))
            x = np.where(missed, np.nan, 1 / np.where(missed, 1, q))
            echo = plane_echo[..., 3] / (x * np.sqrt(1 + u * u + v * v))
            rays = np.stack([x, -u * x, v * x], axis=-1) @ sector.rotation()
            # only this sector's own rays, by rising azimuth
            inner = np.abs(u[0]) < math.tan(sector.half_width_rad)
            points.append(rays[:, inner][:, ::-1].astype(np.float32))
            echoes.append(np.where(missed, 0, echo)[:, inner][:, ::-1])
        return np.concatenate(points, axis=1), np.concatenate(echoes, axis=1)

    @contextmanager
    def _drawing(self):
        """This simulator's context, current for the time of the block, in one thread at a time."""
        if os.getpid() != self._process:
            raise Error("a Simulator must be used in the process that made it; make one in each process")
        with self._lock:
            if self._context is None:
                raise Error("this Simulator is closed; make a new one")
            with self._context as context:
                context.gc()
                yield context

    def close(self):
        """Give the OpenGL context and all it holds back; twice does no harm."""
        if os.getpid() != self._process:  # of a fork: the context and the lock are the parent's
            self._context = None
            return
        with self._lock:
            context, self._context = self._context, None
            if context is not None:
                self._passes.close()
                with context:
                    self._passes = self._samples = None
                    context.gc()
                context.release()
        gl.release_discarded()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()

    def __del__(self):
        if getattr(self, "_context", None) is not None and os.getpid() == self._process:
            gl.discard(self._context)
