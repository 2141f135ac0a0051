"""Multipath echoes by way of planar reflectors, computed from image sources.

An image source is the mirror image of the sonar in a planar reflector. A ray of the sonar that the plane reflects
continues as a straight ray of the image source. Double-bounce echoes therefore form a ping of the image source. In a
single-bounce echo, sound travels one way along a direct ray and the other way along a ray of the image source.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import compress, islice
from typing import NamedTuple

import numpy as np

from sonar_gl.acoustics.acoustics import Acoustics
from sonar_gl.beamform.beamformer import BeamEcho, ImageSourceView
from sonar_gl.beamform.kernels.image_sources import (
    SAME_PLANE,
    Interference,
    Reflection,
    estimate_reflection,
    expect_imaged,
)
from sonar_gl.beamform.kernels.views import ViewIndex, view_index
from sonar_gl.beamform.water_surface import water_surface
from sonar_gl.core.poses import scales_of
from sonar_gl.core.worker import SecondThread, run_halves
from sonar_gl.engine.body_counts import count_bodies
from sonar_gl.engine.reception import reception_of
from sonar_gl.engine.stage import Stage, StageCache
from sonar_gl.scene.reflectors import MIN_AREA_M2, PlanarReflector, planar_reflectors
from sonar_gl.scene.scene import Scene
from sonar_gl.scene.state import GreatestReflectivity, SceneState
from sonar_gl.sonar.fan import ColumnWidths
from sonar_gl.sonar.samples import SectorSamples, ViewSamples, whole_rows
from sonar_gl.sonar.sampling import MAX_COLUMNS_PER_BEAM, MAX_ROWS
from sonar_gl.sonar.sonar import Sonar

BIAS_M = 1e-3  # a reflector's own surface is not drawn from behind
SWAPPED = np.diag([1.0, -1.0, 1.0, 1.0])  # the image's port is the sonar's starboard
WIDEST_COLUMN = 1.0  # twice as wide as those of direct echoes; with four times as wide ones slanted walls err
# The half-width of the beams' support holds so many wide columns for the sonar's own samples: beams become half as wide
# again for these. What goes straight to or from the skirts returns a hundredth of multipath, where it goes by way of
# the reflector, or there both ways, as much as other directions.
OWN_WIDE_COLUMNS = 3
MULTIPATH_GAIN = 3.0  # an echo may meet the reflector on its way out, on its way back, or on both
# Samples of a view, about, on which bodies are counted: where a tolerance asks for ten times as many, it asks for so
# many on each body that none lies between the rows that are counted.
COUNTED = 1 << 16
EXPECTED = 1 << 13  # likewise, by which it is computed how many samples the images should have on each body


class Thinning(NamedTuple):
    """Which samples are summed for image sources.

    columns, rows : samples of the direct view for one that is summed. Faces are planes, which few columns resolve,
        while most edges that matter are level
    is_drawn_alike : image sources are drawn with all samples, of whose rows so many are summed. Others are looked up,
        since most of the error lies where shadows end. Drawing costs little beside sums, but more than weak multipath
    """

    columns: float
    rows: float
    is_drawn_alike: bool = False

    @property
    def times_fewer(self) -> float:
        """How many times fewer samples are summed than are drawn for the direct echo."""
        return self.rows if self.is_drawn_alike else self.columns * self.rows


# After so many halvings of the rows. Where all are drawn they are whole numbers, so that some of them serve. Finer ones
# are finer in both directions: rows alone would leave the error of columns, and not show it. The finest make of the
# coarsest direct echo as many as a tolerance may choose.
THINNINGS = {
    **{-n: Thinning(2 ** (-n / 2), 2 ** (-n / 2)) for n in range(14, 0, -1)},
    0: Thinning(1, 1, True),
    1: Thinning(2, 2, True),
    2: Thinning(4, 4),
    3: Thinning(4, 8),
}
COARSEST, FINEST = max(THINNINGS), min(THINNINGS)


class ImagePose(NamedTuple):
    """The sonar's image behind a plane.

    sonar_from_image, image_from_sonar : (4, 4)
    clip_plane : (4,) of `Renderer.render`, in the frame of the image
    """

    sonar_from_image: np.ndarray
    image_from_sonar: np.ndarray
    clip_plane: np.ndarray


def image_pose(plane) -> ImagePose:
    """Return the sonar's image behind a plane, (4,) normal and offset in the sonar's frame."""
    normal, offset = plane[:3], float(plane[3])
    reflection = np.eye(4)  # its own inverse
    reflection[:3, :3] -= 2 * np.outer(normal, normal)
    reflection[:3, 3] = 2 * offset * normal
    # seen from the image, the plane lies as far behind it as before the sonar, with port and starboard exchanged
    clip_plane = np.array([normal[0], -normal[1], normal[2], -offset - BIAS_M])
    return ImagePose(reflection @ SWAPPED, SWAPPED @ reflection, clip_plane)


@dataclass(frozen=True, eq=False)
class ImageSource:
    """A planar reflector that returns an echo in one ping.

    plane : (4,) normal and offset of it, in the sonar's frame
    ceiling : (4,) likewise of the water's surface over the sonar, normal up; all zeros if there is none
    own_view, image_view : SectorSamples of each sector, of the sonar and of its image
    own_index, image_index : ViewIndex of both; that of the sonar has all samples of its direct view
    """

    reflector: PlanarReflector
    plane: np.ndarray
    ceiling: np.ndarray
    pose: ImagePose
    own_view: Sequence[SectorSamples]
    image_view: Sequence[SectorSamples]
    own_index: ViewIndex
    image_index: ViewIndex


class BodySamples(NamedTuple):
    """How many samples met each body, as if all were compact, and about its echo; (n,) each."""

    samples: np.ndarray
    echo: np.ndarray


@dataclass(frozen=True, eq=False)
class ImageSourceSamples:
    """The image sources of one ping.

    halvings : how often rows were halved for them
    direct : BodySamples of the direct view, by number
    expected : BodySamples that the images should have, one after the other, if nothing hid from them what the sonar
        sees, and none was halved; the echo is that of one way by the image
    imaged : BodySamples of the views of the images, one after the other, as if none was halved
    interference : of the two ways of single-bounce echoes
    own, image : Stage of the sonar and of its images
    sources : ImageSource of each reflector
    """

    halvings: int
    direct: BodySamples
    expected: BodySamples
    imaged: BodySamples
    interference: Interference
    own: Stage
    image: Stage
    sources: tuple[ImageSource, ...]

    @property
    def rows(self) -> float:
        """How many rows of the fan are summed, as if samples were halved or doubled in their height alone."""
        return self.own.sampling.rows * THINNINGS[self.halvings].rows / 2**self.halvings


class DirectView(NamedTuple):
    """The direct view of a ping, by which its image sources are found, and beside which they are drawn.

    pose : (4, 4) world_from_head
    gain : (K,) float32 of the bins
    """

    view: ViewSamples
    pose: np.ndarray
    state: SceneState
    gain: np.ndarray


class _FoundImage(NamedTuple):
    """The sonar's image behind a reflector that may return an echo, still without samples; as of `ImageSource`."""

    reflector: PlanarReflector
    plane: np.ndarray
    pose: ImagePose


class _DrawnImage(NamedTuple):
    """An image with its samples, and how many of them met each body."""

    found: _FoundImage
    view: ViewSamples
    counted: BodySamples


class ImageSources:
    """The planar reflectors of a run, and the sonar's images behind them.

    stages : StageCache of the run
    thread : of the run's world
    tolerance : of the whole echo. Reflectors that can return no more than this share of it are left out
    """

    def __init__(self, stages: StageCache, thread: SecondThread | None, scene: Scene, tolerance: float):
        sonar, engine = stages.sonar, stages.engine
        # specular lobes hold for echoes straight back; the projector's weight would be that of the wrong way
        acoustics = replace(stages.acoustics, specular=False, transmit_beam=False)
        self._draws_lobes, self._tolerance = stages.acoustics.specular, tolerance
        self._thread = thread
        self._reach_rad = acoustics.receive_support_rad(sonar)
        self._interference = _interference_of(sonar, acoustics)
        widths, pools = ColumnWidths(WIDEST_COLUMN), stages.pools
        own_widths = widths._replace(wide_per_support=OWN_WIDE_COLUMNS)
        self._own_stages = StageCache(engine, sonar, acoustics, thread, own_widths, pools)
        if sonar.beam_azimuths_deg is not None:
            mirrored = tuple(-azimuth for azimuth in reversed(sonar.beam_azimuths_deg))
            sonar = replace(sonar, beam_azimuths_deg=mirrored)
        self._image_stages = StageCache(engine, sonar, acoustics, thread, widths, pools)
        self._wavenumber_rad_m = 2 * math.pi * sonar.frequency_hz / acoustics.water.sound_speed()
        self._wave_height_m = acoustics.water.wave_height_m()
        self._scene, self._reflectors = None, []
        self.use_scene(scene)

    def use_scene(self, scene: Scene) -> None:
        """Find the planar reflectors of a scene, once."""
        if scene is not self._scene:
            self._reflectors = planar_reflectors(scene, self._wavenumber_rad_m, self._wave_height_m)
            self._have_lobes = np.array(
                [self._draws_lobes and body.specular > 0 for body in scene.bodies], bool
            )
            self._reflectivity = GreatestReflectivity.of(scene.bodies)
            self._scene = scene

    def draw(
        self,
        stage: Stage,
        halvings: int,
        pings: Sequence[DirectView],
        coarser: ImageSourceSamples | None = None,
    ) -> list[ImageSourceSamples | None]:
        """Draw the image sources of pings whose direct views `stage` has just drawn; None where there are none.

        halvings : how often rows are halved, a key of THINNINGS
        coarser : those of a single ping that too few samples were drawn for, and that these replace; None for none
        """
        # bubbles would have to attenuate each leg by itself
        pings = [ping._replace(state=ping.state.without_bubbles()) for ping in pings]
        indices = [view_index(ping.view) for ping in pings]
        found = [self._find_images(ping, index, stage) for ping, index in zip(pings, indices, strict=True)]
        out: list[ImageSourceSamples | None] = [None] * len(pings)
        numbers = [number for number, images in enumerate(found) if images]  # of pings that have any
        if not numbers:
            return out
        thinning = THINNINGS[halvings]
        own, image = self._stages_for(stage, thinning)
        own_views = self._own_views(own, thinning, [pings[number] for number in numbers])
        drawing = self._image_stages.stage(stage.sampling) if thinning.is_drawn_alike else image
        drawn, direct = self._draw_images(
            drawing,
            [(pings[number], found[number]) for number in numbers],
            stage if coarser is None else None,
        )
        for number, own_view, images, of_direct in zip(numbers, own_views, drawn, direct, strict=True):
            ping, index = pings[number], indices[number]
            if coarser is None:
                planes = [one.found.plane for one in images]
                expected = self._expect_bodies(stage, ping.view, index, planes, of_direct)
            else:
                of_direct, expected = coarser.direct, coarser.expected
            times_fewer = 1 if thinning.is_drawn_alike else thinning.times_fewer
            out[number] = ImageSourceSamples(
                halvings=halvings,
                direct=of_direct,
                expected=expected,
                imaged=BodySamples(
                    samples=times_fewer * np.concatenate([one.counted.samples for one in images]),
                    echo=np.concatenate([one.counted.echo for one in images]),
                ),
                interference=self._interference,
                own=own,
                image=image,
                sources=self._sources(ping, index, own_view, images, thinning),
            )
        return out

    def _draw_images(
        self, drawing: Stage, pings: Sequence[tuple[DirectView, list[_FoundImage]]], direct: Stage | None
    ) -> tuple[list[list[_DrawnImage]], list[BodySamples | None]]:
        """Draw the images of pings, and count their samples; count those of the direct views at the same time.

        drawing : Stage of the images
        direct : Stage of the direct views; None where these are not to be counted again
        """
        images = [(ping, one) for ping, found in pings for one in found]
        views = drawing.draw(
            [ping.pose @ one.pose.sonar_from_image for ping, one in images],
            [ping.state for ping, _ in images],
            with_bodies=True,
            planes=[one.pose.clip_plane for _, one in images],
            keep_last=True,
        )
        counted = [(drawing, view, ping.gain) for (ping, _), view in zip(images, views, strict=True)]
        if direct is not None:
            counted += [(direct, ping.view, ping.gain) for ping, _ in pings]
        counts = self._count_bodies(counted)
        of_images, of_direct = counts[: len(images)], counts[len(images) :]
        found = [one for _, one in images]
        drawn = iter([_DrawnImage(*one) for one in zip(found, views, of_images, strict=True)])
        of_pings = [list(islice(drawn, len(one))) for _, one in pings]
        return of_pings, of_direct or [None] * len(pings)

    def _sources(
        self,
        ping: DirectView,
        index: ViewIndex,
        own_view: Sequence[SectorSamples],
        images: Sequence[_DrawnImage],
        thinning: Thinning,
    ) -> tuple[ImageSource, ...]:
        """Return the image sources of a ping; index : of its direct view."""
        step = thinning.rows if thinning.is_drawn_alike else 1
        return tuple(
            ImageSource(
                reflector=found.reflector,
                plane=found.plane,
                pose=found.pose,
                ceiling=self._ceiling(ping.pose),
                own_view=own_view,
                image_view=[every_row(sector, step) for sector in view.sectors],
                own_index=index,
                image_index=view_index(view),
            )
            for found, view, _ in images
        )

    def _stages_for(self, stage: Stage, thinning: Thinning) -> tuple[Stage, Stage]:
        """Return the stages that sum the samples of the sonar and of its images beside direct views of `stage`."""
        sampling = replace(
            stage.sampling,
            columns_per_beam=min(stage.sampling.columns_per_beam / thinning.columns, MAX_COLUMNS_PER_BEAM),
            rows=min(math.ceil(stage.sampling.rows / thinning.rows), MAX_ROWS),
        )
        # halved ones may be for this ping alone, or for a first look at it
        for stages in (self._own_stages, self._image_stages):
            stages.settle(stage.fan.n_samples)
        return self._own_stages.stage(sampling), self._image_stages.stage(sampling)

    def _own_views(
        self, own: Stage, thinning: Thinning, pings: Sequence[DirectView]
    ) -> list[Sequence[SectorSamples]]:
        """Return the sonar's own samples of pings: rows of their direct views, or others where these do not serve."""
        # of fewer rows than all, the outermost that is left of a window might meet a surface
        must_draw = [not thinning.is_drawn_alike or self._has_more_than_diffuse_echo(ping) for ping in pings]
        to_draw = list(compress(pings, must_draw))
        poses, states = [ping.pose for ping in to_draw], [ping.state for ping in to_draw]
        drawn = iter(own.draw(poses, states, keep_last=True) if to_draw else ())
        return [
            next(drawn).sectors if is_drawn else [every_row(one, thinning.rows) for one in ping.view.sectors]
            for ping, is_drawn in zip(pings, must_draw, strict=True)
        ]

    def _has_more_than_diffuse_echo(self, ping: DirectView) -> bool:
        """Return whether the direct view may have lobes, or bubbles, which multipath leaves out."""
        return ping.view.bubbles is not None or bool(self._have_lobes[ping.state.present].any())

    def _count_bodies(self, views: Sequence[tuple[Stage, ViewSamples, np.ndarray]]) -> list[BodySamples]:
        """Count the samples on each body, by every so-manieth row where there are many.

        views : each with its stage and the gain of the bins
        """

        def count(stage, view, gain):
            reception = reception_of(stage.beamformer, self._reach_rad, gain)
            step = max(1, sum(one.plane_echo[..., 0].size for one in view.sectors) // COUNTED)
            found = count_bodies(view, len(self._scene.bodies), reception, every=step)
            return BodySamples(found.samples * step, found.echo)  # rows of a step are as many times as high

        counts: list = [None] * len(views)
        halves = run_halves(self._thread, lambda half: [count(*one) for one in views[half::2]])
        counts[::2], counts[1::2] = halves
        return counts

    def _expect_bodies(
        self,
        stage: Stage,
        view: ViewSamples,
        index: ViewIndex,
        planes: Sequence[np.ndarray],
        direct: BodySamples,
    ) -> BodySamples:
        """Return `ImageSourceSamples.expected` of the sonar's images behind some planes.

        A body on which no sample is read counts as in the direct view.

        view, index, direct : of the sonar
        """
        step = max(1, math.isqrt(sum(one.body_id.size for one in view.sectors) // EXPECTED))
        range_max_m, pattern = float(stage.fan.sonar.range_max_m), stage.beamformer.elevation_table
        sums = np.zeros((len(planes), 4, len(direct.samples)))
        for one in view.sectors:
            if not one.plane_echo.size:  # no body lies in it
                continue
            arrays = whole_rows(one.plane_echo), whole_rows(one.body_id)
            for plane, of_plane in zip(planes, sums, strict=True):
                expect_imaged(arrays, one.lattice, index.sectors, plane, step, range_max_m, pattern, of_plane)
        was_read, n_imaged, echo, one_way = np.moveaxis(sums, 1, 0)
        times = np.divide(n_imaged, was_read, out=np.ones_like(echo), where=was_read > 0)
        share = np.divide(one_way, echo, out=np.ones_like(echo), where=echo > 0)
        return BodySamples((times * direct.samples).ravel(), (share * direct.echo).ravel())

    def _find_images(self, ping: DirectView, index: ViewIndex, stage: Stage) -> list[_FoundImage]:
        """Return the images behind reflectors that may return more than the tolerance, one of each plane.

        Of several bodies in one plane, such as a floor and what stands on it, it is the largest. The offsets of planes
        are positive.
        """
        pose, state = ping.pose, ping.state
        squares = np.where(state.present, scales_of(state.poses) ** 2, 0.0)
        surface_m2 = 0.0 if water_surface(pose, self._scene.surface_z_m) is None else np.inf
        areas_m2 = [
            surface_m2 if one.body is None else one.area_m2 * squares[one.body] for one in self._reflectors
        ]
        large = [n for n, area_m2 in enumerate(areas_m2) if area_m2 >= MIN_AREA_M2]
        if not large:
            return []
        found, areas_m2 = [self._reflectors[n] for n in large], [areas_m2[n] for n in large]
        normals, offsets_m = zip(*(one.in_world(state.poses) for one in found), strict=True)
        rotated = np.column_stack([np.array(normals) @ pose[:3, :4], offsets_m])
        distances_m = rotated[:, 4] - rotated[:, 3]
        planes = np.column_stack([rotated[:, :3], distances_m]) * np.sign(distances_m)[:, None]
        reflected = np.empty(len(found))
        echo = estimate_reflection(
            tuple(index),
            planes,
            np.array([one.body is not None for one in found]),
            np.array([one.reflection_coefficient for one in found]),
            float(stage.fan.sonar.range_max_m),
            stage.beamformer.elevation_table,
            reflected,
        )
        brightest = self._reflectivity.in_state(state)[state.present].max(initial=0.0)
        counts = MULTIPATH_GAIN * brightest * reflected > self._tolerance * echo
        counts &= np.abs(distances_m) > BIAS_M
        kept: list[int] = []
        for n in sorted(np.flatnonzero(counts), key=lambda n: -areas_m2[n]):
            # an image source is that of all surfaces in its plane: a second one would return their echo twice
            beside = [m for m in kept if found[m].body is not None and found[n].body is not None]
            if not any(_are_alike(planes[m], planes[n]) for m in beside):
                kept.append(n)
        return [_FoundImage(found[n], planes[n], image_pose(planes[n])) for n in sorted(kept)]

    def _ceiling(self, pose) -> np.ndarray:
        """Return (4,) the water's surface over the sonar, in its frame, normal up; zeros if there is none."""
        surface = water_surface(pose, self._scene.surface_z_m)
        return np.zeros(4) if surface is None else np.append(surface.up, surface.height_m)


def _are_alike(a, b) -> bool:
    """Return whether two planes, (4,) normal and offset, are one to the echoes of image sources."""
    return bool(np.abs(a[:3] - b[:3]).max() < SAME_PLANE and abs(a[3] - b[3]) < SAME_PLANE * a[3])


def every_row(samples: SectorSamples, step: int) -> SectorSamples:
    """Return every so-manieth row of samples, no further apart than the margin of a window."""
    if step == 1:
        return samples
    sector = samples.sector
    of_step = np.array([1, 1, step])
    plane_echo = samples.plane_echo[::step]
    sector = replace(sector, rows=len(plane_echo), u=sector.u * of_step, v=sector.v * of_step)
    return SectorSamples(sector, plane_echo, samples.body_id[::step])


def receive_images(images: ImageSourceSamples, gain) -> BeamEcho:
    """Return the multipath echoes of a ping."""
    beamformer, strips = images.own.beamformer, images.image.beamformer.mirrored_strips
    own = [_view_of(source, images.interference, False, beamformer.strips) for source in images.sources]
    image = [_view_of(source, images.interference, True, strips) for source in images.sources]
    return beamformer.sum_image_sources(image, own, images.image.beamformer, gain)


def _interference_of(sonar: Sonar, acoustics: Acoustics) -> Interference:
    if acoustics.multipath != "coherent":
        return Interference(np.empty(0), 1.0, False)
    is_straight = acoustics.beam_pattern != "box" and sonar.steered == "straight"
    return Interference(*acoustics.receive_correlation(sonar), is_straight)


def _view_of(source: ImageSource, interference: Interference, from_image: bool, strips) -> ImageSourceView:
    """Return the samples of the sonar, or of its image, with the geometry of each sector."""
    own_index = tuple(source.own_index)
    sectors = source.image_view if from_image else source.own_view
    reflections = tuple(
        Reflection(
            azimuth_rad=sector.azimuth_rad,
            to_other=source.pose.sonar_from_image if from_image else source.pose.image_from_sonar,
            ceiling=source.ceiling,
            from_image=from_image,
            interference=tuple(interference),
            index=own_index,
            other_index=own_index if from_image else tuple(source.image_index),
            plane=source.plane,
            is_body=source.reflector.body is not None,
            reflected_intensity=source.reflector.reflection_coefficient,
        )
        for sector in (one.sector for one in sectors)
    )
    return ImageSourceView(sectors, reflections, strips)
