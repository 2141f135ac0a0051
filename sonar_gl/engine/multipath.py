"""Multipath echoes by way of planar reflectors, computed from image sources.

An image source is the mirror image of the sonar in a planar reflector. A ray of the sonar that the plane reflects
continues as a straight ray of the image source. Double-bounce echoes therefore form a ping of the image source. In a
single-bounce echo, sound travels one way along a direct ray and the other way along a ray of the image source.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from sonar_gl.beamform import kernels
from sonar_gl.beamform.beamformer import BeamEcho, ImageSourceView
from sonar_gl.core.worker import SecondThread
from sonar_gl.engine.stage import Stage, StageCache
from sonar_gl.scene.reflectors import PlanarReflector, planar_reflectors
from sonar_gl.scene.scene import Scene
from sonar_gl.scene.state import SceneState
from sonar_gl.sonar.samples import ViewSamples
from sonar_gl.sonar.sampling import half_of

BIAS_M = 1e-3  # a reflector's own surface is not drawn from behind
SWAPPED = np.diag([1.0, -1.0, 1.0, 1.0])  # the image's port is the sonar's starboard
# Multipath errs by its share of the echo. Samples are halved twice where it is less than SHARES[0] of the direct
# echo, once where it is less than SHARES[1], and not at all where it is more.
SHARES = 0.1, 0.3
WIDEST_COLUMN = 1.0  # in spacings of beams
MULTIPATH_GAIN = 3.0  # an echo may meet the reflector on its way out, on its way back, or on both


def image_pose(plane) -> tuple[np.ndarray, np.ndarray]:
    """Return (4, 4) sonar_from_image of the sonar's image behind a plane, and a clip plane in its frame.

    plane : (4,) normal and offset in the sonar's frame; clip plane : of `Renderer.render`
    """
    turned = np.eye(4)
    turned[:3, :3] -= 2 * np.outer(plane[:3], plane[:3])
    turned[:3, 3] = 2 * plane[3] * plane[:3]
    out = turned @ SWAPPED
    offset = plane[3] - BIAS_M - plane[:3] @ out[:3, 3]
    return out, np.append(-out[:3, :3].T @ plane[:3], offset)


@dataclass(frozen=True, eq=False)
class ImageSource:
    """A planar reflector that returns an echo in one ping.

    Attributes
    ----------
    reflector : PlanarReflector
    plane : (4,) normal and offset of it, in the sonar's frame
    ceiling : (4,) likewise of the water's surface, normal up; all zeros if there is none
    sonar_from_image : (4, 4)
    own_view, image_view : ViewSamples of the sonar and of its image
    own_index, image_index : kernels.ViewIndex of both
    """

    reflector: PlanarReflector
    plane: np.ndarray
    ceiling: np.ndarray
    sonar_from_image: np.ndarray
    own_view: ViewSamples
    image_view: ViewSamples
    own_index: kernels.ViewIndex
    image_index: kernels.ViewIndex


@dataclass(frozen=True, eq=False)
class ImageSourceSamples:
    """The image sources of one ping.

    Attributes
    ----------
    halvings : how often samples were halved for them
    single_bounce : intensity of the two ways of a single-bounce echo together, over that of one
    own, image : Stage of the sonar and of its images
    sources : ImageSource of each reflector
    """

    halvings: int
    single_bounce: float
    own: Stage
    image: Stage
    sources: tuple[ImageSource, ...]


class HalvingChoice(NamedTuple):
    """How often samples are halved for image sources, and whether that stays."""

    halvings: int
    is_fixed: bool = False


class ImageSources:
    """The planar reflectors of a run, and the sonar's images behind them.

    Parameters
    ----------
    stages : StageCache of the run
    thread : of the run's world
    scene : Scene
    tolerance : reflectors that can return no more than this share of the echo are left out

    Attributes
    ----------
    choice : HalvingChoice
    """

    COARSEST = len(SHARES)  # halvings

    def __init__(self, stages: StageCache, thread: SecondThread, scene: Scene, tolerance: float):
        sonar, engine = stages.sonar, stages.engine
        # specular lobes hold for echoes straight back; the projector's weight would be that of the wrong way
        acoustics = replace(stages.acoustics, specular=False, transmit_beam=False)
        self._tolerance = tolerance
        self._single_bounce = 2.0 if acoustics.multipath == "coherent" else 1.0
        shared = thread, WIDEST_COLUMN, stages.pools
        self._own_stages = StageCache(engine, sonar, acoustics, *shared)
        if sonar.beam_azimuths_deg is not None:
            mirrored = tuple(-azimuth for azimuth in reversed(sonar.beam_azimuths_deg))
            sonar = replace(sonar, beam_azimuths_deg=mirrored)
        self._image_stages = StageCache(engine, sonar, acoustics, *shared)
        self._wavenumber_rad_m = 2 * math.pi * sonar.frequency_hz / acoustics.sound_speed()
        self._scene, self._reflectors, self._rows = None, [], 0
        self.choice = HalvingChoice(self.COARSEST)
        self.use_scene(scene)

    def use_scene(self, scene: Scene) -> None:
        """Find the planar reflectors of a scene, once."""
        if scene is not self._scene:
            self._reflectors = planar_reflectors(scene, self._wavenumber_rad_m)
            self._is_specular = any(body.specular > 0 for body in scene.bodies)
            self._brightest = max([float(np.max(body.reflectivity)) for body in scene.bodies], default=0.0)
            self._scene = scene

    def reset(self) -> None:
        """Begin with the coarsest samples, as if no ping had been made before, unless they are fixed."""
        if not self.choice.is_fixed:
            self.choice = HalvingChoice(self.COARSEST)

    def fix(self, halvings: int) -> None:
        """Halve samples so often from now on."""
        self.choice = HalvingChoice(halvings, True)

    def release(self) -> None:
        """Choose samples ping by ping again."""
        self.choice = HalvingChoice(self.halvings)

    @property
    def halvings(self) -> int:
        """How often samples are halved, by the multipath of the last ping."""
        return self.choice.halvings

    def review(self, images: ImageSourceSamples | None, multipath: BeamEcho | None, direct: BeamEcho) -> bool:
        """Adapt the samples to a ping's multipath; return whether this ping is to be drawn once more with them."""
        if images is None:
            return False
        if not self.choice.is_fixed:
            # coarser only where they would stay so: otherwise they flicker
            wanted, kept = (
                sum(f * multipath.total <= share * direct.total for share in SHARES) for f in (1, 2)
            )
            self.choice = HalvingChoice(min(max(self.halvings, kept), wanted))
        return images.halvings > self.halvings

    def draw(
        self, stage: Stage, views: Sequence[ViewSamples], poses, states: Sequence[SceneState]
    ) -> list[ImageSourceSamples | None]:
        """Draw the image sources of pings whose direct views `stage` has just drawn; None where there are none."""
        # bubbles would have to attenuate each leg by itself
        states = [state.without_bubbles() for state in states]
        indices = [kernels.view_index(view) for view in views]
        found, image_poses, image_states, clip_planes = [], [], [], []
        for number, (pose, state, index) in enumerate(zip(poses, states, indices, strict=True)):
            for reflector in self._reflectors:
                plane = self._plane(reflector, pose, state)
                if plane is not None and self._counts(reflector, plane, index, stage):
                    sonar_from_image, clip_plane = image_pose(plane)
                    found.append((number, (reflector, plane, self._ceiling(pose), sonar_from_image)))
                    image_poses.append(pose @ sonar_from_image)
                    image_states.append(state)
                    clip_planes.append(clip_plane)
        out: list[ImageSourceSamples | None] = [None] * len(poses)
        if not found:
            return out
        numbers = sorted({number for number, _ in found})
        sampling = stage.sampling
        for _ in range(self.halvings):
            sampling = half_of(sampling)
        if sampling.rows < self._rows:
            self._own_stages.drop_large()
            self._image_stages.drop_large()
        self._rows = sampling.rows
        own, image = self._own_stages.stage(sampling), self._image_stages.stage(sampling)
        if self.halvings or self._is_specular or any(view.bubbles is not None for view in views):
            own_views = own.draw([poses[n] for n in numbers], [states[n] for n in numbers], keep_last=True)
            own_indices = [kernels.view_index(view) for view in own_views]
        else:  # the direct views will do
            own_views, own_indices = [views[n] for n in numbers], [indices[n] for n in numbers]
        own_of = dict(zip(numbers, zip(own_views, own_indices, strict=True), strict=True))
        image_views = image.draw(image_poses, image_states, planes=clip_planes, keep_last=True)
        sources: dict[int, list[ImageSource]] = {number: [] for number in numbers}
        for (number, about), image_view in zip(found, image_views, strict=True):
            own_view, own_index = own_of[number]
            views_of_both = own_view, image_view, own_index, kernels.view_index(image_view)
            sources[number].append(ImageSource(*about, *views_of_both))
        for number in numbers:
            out[number] = ImageSourceSamples(
                self.halvings, self._single_bounce, own, image, tuple(sources[number])
            )
        return out

    def _plane(self, reflector: PlanarReflector, pose, state: SceneState):
        """Return (4,) the reflector in the sonar's frame, its offset positive; None if it is absent."""
        if reflector.body is not None and not state.present[reflector.body]:
            return None
        normal, offset = reflector.in_world(state.poses)
        plane = np.append(normal @ pose[:3, :3], offset - normal @ pose[:3, 3])
        if abs(plane[3]) <= BIAS_M:
            return None
        return plane if plane[3] > 0 else -plane

    def _ceiling(self, pose) -> np.ndarray:
        """Return (4,) the water's surface in the sonar's frame, normal up; zeros if there is none."""
        z = self._scene.surface_z_m
        return np.zeros(4) if z is None else np.append(pose[2, :3], z - pose[2, 3])

    def _counts(self, reflector: PlanarReflector, plane, index: kernels.ViewIndex, stage: Stage) -> bool:
        """Return whether a reflector may return more than the tolerance."""
        reflected, echo = kernels.estimate_reflection(
            tuple(index),
            plane,
            reflector.body is not None,
            reflector.reflection_coefficient,
            stage.fan.sonar.range_max_m,
        )
        return MULTIPATH_GAIN * self._brightest * reflected > self._tolerance * echo


def receive_images(images: ImageSourceSamples, gain) -> BeamEcho:
    """Return the multipath echoes of a ping."""
    own = [_view_of(source, images.single_bounce, False) for source in images.sources]
    image = [_view_of(source, images.single_bounce, True) for source in images.sources]
    out = images.own.beamformer.sum_image_sources(own, gain)
    mirrored = images.image.beamformer.sum_image_sources(image, gain)
    np.add(out.intensity, mirrored.intensity[::-1], out=out.intensity)
    return BeamEcho(out.intensity, out.total + mirrored.total)


def _view_of(source: ImageSource, single_bounce: float, from_image: bool) -> ImageSourceView:
    """Return the samples of the sonar, or of its image, with the geometry of each sector."""
    to_sonar = source.sonar_from_image
    to_other = to_sonar if from_image else np.linalg.inv(to_sonar)
    own_index = tuple(source.own_index)
    other_index = own_index if from_image else tuple(source.image_index)
    sectors = (source.image_view if from_image else source.own_view).sectors
    reflections = []
    for sector, _, _ in sectors:
        own = np.eye(4)
        own[:3, :3] = sector.rotation().T
        into = own if not from_image else to_sonar @ own
        up = source.ceiling[:3]
        reflections.append(
            kernels.Reflection(
                own=own[:3],
                other=(to_other @ own)[:3],
                ceiling=np.append(up @ into[:3, :3], source.ceiling[3] - up @ into[:3, 3]),
                from_image=from_image,
                single_bounce=single_bounce,
                index=own_index,
                other_index=other_index,
                plane=source.plane,
                is_body=source.reflector.body is not None,
                loss=source.reflector.reflection_coefficient,
            )
        )
    return ImageSourceView(sectors, tuple(reflections))
