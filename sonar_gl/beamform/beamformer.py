"""Samples to ping: samples are summed into columns and range bins, and columns into beams."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import NamedTuple

import numpy as np

from sonar_gl.acoustics.acoustics import Acoustics
from sonar_gl.acoustics.beam_pattern import FarPattern
from sonar_gl.beamform.far_lobes import FarLobes, far_lobes, make_lobe_blocks
from sonar_gl.beamform.halves import by_sector, half_of, parts_of_wide_columns, strips_of, strips_within
from sonar_gl.beamform.kernels.beams import TILE_BEAMS, add_far_lobes, weigh_columns
from sonar_gl.beamform.kernels.body_counts import ReceivedParts
from sonar_gl.beamform.kernels.column_sums import (
    add_points,
    clear_columns,
    count_bins,
    share_wide_columns,
    sum_footprints,
)
from sonar_gl.beamform.kernels.image_sources import Reflection, sum_image_source
from sonar_gl.beamform.kernels.range_bins import bin_table
from sonar_gl.beamform.kernels.work_table import MAX_STRIP_ROWS
from sonar_gl.beamform.labels import BodySums, Labeller, Labels, bins_of_bodies, label_columns
from sonar_gl.beamform.received import received_parts, received_u
from sonar_gl.beamform.weights import BeamWeights, beam_weights, elevations_of, gauss_nodes
from sonar_gl.beamform.workspace import ColumnSums, Workspace
from sonar_gl.core.errors import SampleLimitError
from sonar_gl.core.worker import SecondThread, run_halves
from sonar_gl.sonar.fan import USUAL_WIDTHS, BeamShape, ColumnWidths, Fan, make_fan
from sonar_gl.sonar.samples import NO_SPANS, SectorSamples, ViewSamples, sector_table, whole_rows
from sonar_gl.sonar.sampling import Sampling, extend_rows
from sonar_gl.sonar.sector import MAX_AZIMUTH_RAD, SHEAR
from sonar_gl.sonar.sonar import Sonar

# Work below these bounds is done in one thread, since handing half of it to the second one would take longer. Rows of
# strips are counted, rows with labels, which take twice as long, and products of a column's bin with its weight.
FEW_ROWS, FEW_LABEL_ROWS, FEW_PRODUCTS = 10_000, 5_000, 5_000_000
NO_GAIN = np.empty(0, np.float32)
TOUCHING = 1e-7  # of its range: a body that is nearer than the end of the last bin by no more only touches it
HALF_POWER_TWO_WAY = 0.25


@dataclass(frozen=True, eq=False)
class BeamEcho:
    """The echo in beams and bins.

    intensity : (B, K) float32, linear
    total : its sum
    """

    intensity: np.ndarray
    total: float

    def with_more(self, other: BeamEcho | None) -> BeamEcho:
        """Return the sum of both, in the array of this one: fresh memory would cost as much as adding."""
        if other is None:
            return self
        if other.total:
            np.add(self.intensity, other.intensity, out=self.intensity)
        return BeamEcho(self.intensity, self.total + other.total)


class _ImageOfSectors(NamedTuple):
    """Samples of some sectors, side by side.

    arrays : image, spans of bodies and sectors, as `kernels.column_sums.sum_footprints` takes them
    sectors : numbers of the sectors, and one past the last
    """

    arrays: tuple
    sectors: slice


class ShadowedBackground(NamedTuple):
    """The bodies on whose echo others cast shadows.

    is_background : (n_bodies + 1,) bool by number
    view : ViewSamples of these bodies alone
    """

    is_background: np.ndarray
    view: ViewSamples


@dataclass(frozen=True, eq=False)
class ImageSourceView:
    """What the sonar, or its image behind a planar reflector, sees, to be summed as multipath echoes.

    samples : of each sector
    reflections : Reflection of each sector
    strips : of each half of the columns, StripTable of each sector
    """

    samples: Sequence[SectorSamples]
    reflections: Sequence[Reflection]
    strips: Sequence[Sequence[tuple]]


def make_beamformer(
    sonar: Sonar,
    acoustics: Acoustics,
    sampling: Sampling,
    thread: SecondThread | None = None,
    shear: float = SHEAR,
    widths: ColumnWidths = USUAL_WIDTHS,
    workspace: Workspace | None = None,
    side_lobes: bool = True,
) -> Beamformer:
    """Return the beamformer of a sonar with this sampling.

    thread, workspace : of `Beamformer`
    shear, widths : of `make_fan`
    side_lobes : whether the fan has sectors for the side lobes of the elevation pattern
    """
    workspace = workspace or Workspace()
    design = workspace.once(("design", side_lobes), lambda: _design_of(sonar, acoustics, side_lobes))
    extended = extend_rows(sampling, sonar, design.sonar)
    fan = make_fan(design.sonar, extended, design.beams, shear, widths)
    edges = fan.column_edges_rad

    def weigh() -> tuple[BeamWeights, FarLobes | None]:
        blocks, reach = None, design.beams.support_rad
        if design.far_pattern is not None:
            blocks = make_lobe_blocks(design.far_pattern, sonar.azimuth_rad, (edges[0], edges[-1]))
        n_nodes = gauss_nodes(float(np.diff(edges).max()), reach, design.null_rad)
        patterns = design.transmit_pattern, design.elevation_pattern
        weights = beam_weights(fan, design.pattern, reach, *patterns, blocks is not None, n_nodes)
        return weights, None if blocks is None else far_lobes(blocks, weights, edges, patterns[0])

    weights, lobes = workspace.weights(edges, weigh)
    return Beamformer(fan, weights, lobes, design.elevation_pattern, thread, design.beams.is_box, workspace)


def beam_shape(sonar: Sonar, acoustics: Acoustics, side_lobes: bool = True) -> BeamShape:
    """Return what the beams of a sonar ask of its fan; side_lobes : as for `make_beamformer`."""
    has_transmit_beam = acoustics.transmit_pattern(sonar) is not None
    beams = BeamShape(
        acoustics.receive_support_rad(sonar),
        is_box=acoustics.beam_pattern == "box",
        are_cones=acoustics.has_cones(sonar),
        transmit_width_rad=math.radians(sonar.transmit_width_deg) if has_transmit_beam else math.inf,
    )
    if not side_lobes:
        return beams
    return beams._replace(
        dense_elevation_deg=acoustics.dense_elevation_deg(sonar),
        max_elevation_deg=acoustics.max_elevation_deg(sonar),
    )


class _Design(NamedTuple):
    """What a sonar with its acoustics asks of all fans and beamformers.

    sonar : of `Acoustics.true_range_sonar`
    beams : of `beam_shape`
    pattern, transmit_pattern, elevation_pattern : of `beam_weights`
    far_pattern, null_rad : of `Acoustics`
    """

    sonar: Sonar
    beams: BeamShape
    pattern: Callable | None
    transmit_pattern: Callable | None
    elevation_pattern: Callable | None
    far_pattern: FarPattern | None
    null_rad: float


def _design_of(sonar: Sonar, acoustics: Acoustics, side_lobes: bool) -> _Design:
    return _Design(
        acoustics.true_range_sonar(sonar),
        beam_shape(sonar, acoustics, side_lobes),
        acoustics.receive_pattern(sonar),
        acoustics.transmit_pattern(sonar),
        acoustics.two_way_elevation_pattern(sonar),
        acoustics.far_pattern(sonar),
        acoustics.null_rad(sonar),
    )


class Beamformer:
    """Sums samples of a fan into beams and bins.

    The columns are divided into two halves at a fixed border. Each half is summed by one thread, so that the sums do
    not depend on which thread is faster; both by the same one if there is little work.

    Raises SampleLimitError if a sector has more rows than the kernels have room for.

    far_lobes : what beams receive beyond these weights; None for nothing
    elevation_pattern : function (sine of elevation) -> two-way power pattern, or None for a box
    thread : for the second half; None does both halves in the caller's thread
    is_box : beams are boxes, which end where columns end
    workspace : arrays that every ping uses again, to share with other beamformers; None for its own

    strips : StripTable of each sector, for each half of the columns
    elevation_table : (E,) two-way power pattern at even sines from -1 to 1, `elevations_of`; of no length for a box
    """

    def __init__(
        self,
        fan: Fan,
        weights: BeamWeights,
        far_lobes: FarLobes | None = None,
        elevation_pattern: Callable | None = None,
        thread: SecondThread | None = None,
        is_box: bool = True,
        workspace: Workspace | None = None,
    ):
        n_rows = max(sector.rows for sector in fan.sectors)
        if n_rows > MAX_STRIP_ROWS:
            raise SampleLimitError(
                f"a sector must have no more than {MAX_STRIP_ROWS} rows of samples (got {n_rows}, with those "
                "beyond the aperture; ask for fewer rows)"
            )
        self._workspace = workspace or Workspace()
        self.fan, self.is_box, self._thread = fan, is_box, thread
        shape = len(weights.first), fan.sonar.n_bins
        self._pool = self._workspace.pools.pool(shape)
        self.elevation_table, self._bins = self._workspace.once(
            "elevations and bins", lambda: _tables_of(fan, elevation_pattern)
        )
        self._weights, self._tiles = weights, tuple(weights.tiles)
        self._tile_halves = tuple(half_of(len(self._tiles[0]), half) for half in (0, 1))
        # bins, spread and elevation_pattern of `kernels.column_sums.sum_footprints`
        self._spreading = self._bins, fan.sampling.reducer == "footprint", self.elevation_table
        self._far = far_lobes
        # with far side lobes, beams receive all columns
        received = np.ones(fan.n_columns, bool) if far_lobes else weights.received
        n_columns, n_wide, edges = fan.n_columns, fan.n_wide_columns, fan.wide_edges
        # first and past the last of each half: of its columns, and of its wide columns
        self._column_halves = tuple(
            (half_of(n_columns, half), tuple(n_columns + end for end in half_of(n_wide, half)))
            for half in (0, 1)
        )
        self._wide_parts = parts_of_wide_columns(edges, n_columns)
        if n_wide:
            received = np.append(received, np.logical_or.reduceat(received, edges[:-1]))
        self._received = received
        first, table = strips_of(fan)
        self._all_strips = tuple(strips_within(first, table, half, received) for half in self._column_halves)
        self.strips = tuple(by_sector(*strips) for strips in self._all_strips)
        self._wide_shares = fan.wide_shares
        self._strips_per_column = [len(one.strips.middle) / one.columns for one in fan.sectors]

    @cached_property
    def mirrored_strips(self) -> tuple:
        """The strips as `strips` has them, numbered by the columns of the mirrored fan: port and starboard swapped."""
        n_columns, n_wide = self.fan.n_columns, self.fan.n_wide_columns
        mirrored = np.append(np.arange(n_columns)[::-1], n_columns + np.arange(n_wide)[::-1])
        first, (column, *rest) = strips_of(self.fan)
        table, received = (mirrored[column], *rest), self._received[mirrored]
        return tuple(by_sector(*strips_within(first, table, half, received)) for half in self._column_halves)

    @cached_property
    def received_u(self) -> tuple[np.ndarray, ...]:
        """Of each sector, (2n,) float64, rising: begins and ends, in u, of n intervals whose samples some beam takes.

        Empty if beams take all samples. Boxes that are narrower than their spacing leave gaps.
        """
        if not self.is_box or self._received.all():
            return (np.empty(0),) * len(self.fan.sectors)
        return tuple(received_u(sector, self._received) for sector in self.fan.sectors)

    @cached_property
    def received_parts(self) -> ReceivedParts:
        """What beams receive of each sector, to count samples there."""
        return received_parts(self.fan.sectors, self.received_u)

    @cached_property
    def even_response(self) -> np.ndarray:
        """(B,) echo, without gain, that each beam receives from a sphere of reflectivity 1 about the sonar.

        It is 1 unless there is a transmit beam.
        """
        columns = self._column_sums()
        # spans first: what lies outside of them is never cleared, should an interrupt come between
        columns.spans[:] = 0, columns.sums.shape[1]
        columns.sums[:] = self._weights.columns_sr[:, None]
        response = self.weigh(columns, NO_GAIN).intensity[:, 0].astype(np.float64)
        columns.sums[:] = 0
        columns.spans[:] = columns.sums.shape[1], 0
        return response

    @cached_property
    def _labeller(self) -> Labeller:
        response = self._weights.column_response if self._far is None else self._far.column_response
        columns = label_columns(self.fan, self._weights, self.is_box, response)
        return Labeller(
            columns, self._spreading, self._tile_halves, len(self._weights.first), self._workspace
        )

    @property
    def n_bytes(self) -> int:
        """About how many bytes its tables take."""
        # the weights of which the tiles are made are kept for the labeller, which has tiles of its own: three times
        weights = 3 * self._tiles[1].nbytes + (self._far.n_bytes if self._far else 0)
        return weights + sum(a.nbytes for _, strips in self._all_strips for a in strips[:-1])

    def _column_sums(self, n_wide_columns: int = 0) -> ColumnSums:
        """Return the workspace's array of column sums, which holds what any beamformer that shares it summed last."""
        fan = self.fan
        n_wide_columns = max(n_wide_columns, fan.n_wide_columns)
        return self._workspace.column_sums(fan.n_columns, fan.sonar.n_bins, n_wide_columns)

    def clear_columns(self, half: int, columns: ColumnSums) -> None:
        """Set the sums of a half of the columns to zero."""
        for first, last in self._column_halves[half]:
            clear_columns(first, last, columns.all_sums, columns.all_spans)

    def share_wide_columns(self, columns: ColumnSums) -> None:
        """Add the sums of wide columns to those of their columns."""
        for part in self._wide_parts:
            self._share_wide_columns(part, columns)

    def _share_wide_columns(self, part: tuple[int, int], columns: ColumnSums) -> None:
        """Add the sums of wide columns of a part, first and past the last, to those of their columns."""
        if part[0] < part[1]:
            shares = self._wide_shares, columns.all_sums, columns.all_spans
            share_wide_columns(part, self.fan.wide_edges, *shares)

    def sum_view(self, view: ViewSamples, gain: np.ndarray) -> BeamEcho:
        """Return the echo of all surfaces and bubbles in a view, times the (K,) float32 gain."""
        columns = self._sum_surfaces(view)
        self._add_bubbles(view, columns)
        return self.weigh(columns, gain)

    def _add_bubbles(self, view: ViewSamples, columns: ColumnSums) -> None:
        """Add the echo of a view's bubbles to the sums of its surfaces."""
        points = view.bubbles
        if points is None:
            return
        if self.fan.are_cones:
            points = _shown_points(points)
        arrays = self.elevation_table, self.fan.max_sine, not self.is_box, columns.sums, columns.spans
        add_points(points, self.fan.column_edges_rad, self._bins[0], *arrays)

    def sum_footprints(
        self, samples: Sequence[SectorSamples], gain=NO_GAIN, body_spans: np.ndarray = NO_SPANS
    ) -> BeamEcho:
        """Return the echo of surfaces, times the (K,) float32 gain; body_spans : of `ViewSamples`."""
        return self.sum_view(ViewSamples(tuple(samples), body_spans=body_spans), gain)

    def _sum_surfaces(self, view: ViewSamples) -> ColumnSums:
        """Return the sums of a view's surfaces in columns."""
        columns, images = self._column_sums(), self._images_of(view) if self._is_in_range(view) else []

        def work(half):
            self.clear_columns(half, columns)
            first_strip, strips = self._all_strips[half]
            for arrays, sectors in images:
                sum_footprints(
                    self._workspace.works[half],
                    *arrays,
                    first_strip[sectors],
                    strips,
                    *self._spreading,
                    columns.all_sums,
                    columns.all_spans,
                )
            self._share_wide_columns(self._wide_parts[half], columns)

        self._run(work, self._strip_rows(images) < FEW_ROWS)
        self._share_wide_columns(self._wide_parts[2], columns)
        return columns

    def _is_in_range(self, view: ViewSamples) -> bool:
        """Return whether any body may be nearer than the end of the last bin, into which samples behind it reach."""
        nearest = view.body_spans[1:, 1]
        return not len(view.body_spans) or bool((nearest * self._bins[0][-1] > 1 + TOUCHING).any())

    def _images_of(self, view: ViewSamples) -> list[_ImageOfSectors]:
        """Return the image of a view, which holds all sectors side by side; that of each sector if a host drew them."""
        if view.table is not None:
            spans = view.body_spans if view.body_id.size else NO_SPANS
            arrays = view.plane_echo, view.face_id, view.body_id, spans, view.table
            return [_ImageOfSectors(arrays, slice(len(self.fan.sectors) + 1))]
        out = []
        for number, (_, one) in enumerate(zip(self.fan.sectors, view.sectors, strict=True)):
            if not one.sector.columns:
                continue
            arrays = (whole_rows(array) for array in (one.plane_echo, one.face_id, one.body_id))
            spans = view.body_spans if one.body_id.size else NO_SPANS
            table = tuple(sector_table([one.sector], [0]))
            out.append(_ImageOfSectors((*arrays, spans, table), slice(number, number + 2)))
        return out

    def _strip_rows(self, images: Sequence[_ImageOfSectors]) -> float:
        """Return about how many rows of strips some images have."""
        n_rows = 0.0
        for (*_, (places, *_)), sectors in images:
            for per_column, (_, columns, rows) in zip(
                self._strips_per_column[sectors], places.tolist(), strict=False
            ):
                n_rows += per_column * columns * rows
        return n_rows

    def sum_image_sources(
        self,
        images: Sequence[ImageSourceView],
        own: Sequence[ImageSourceView],
        of_images: Beamformer,
        gain: np.ndarray,
    ) -> BeamEcho:
        """Return the multipath echoes of several views, added up.

        images : views of the sonar's images, with `mirrored_strips`
        own : views of the sonar itself, one for each image; a view is summed only if the samples of its image return
            an echo by the reflector
        of_images : the beamformer whose strips the images have; its fan may have other wide columns
        """
        n_wide = of_images.fan.n_wide_columns
        columns, is_seen = self._column_sums(n_wide), np.zeros((2, len(images)), bool)

        def add(half: int, view: ImageSourceView) -> bool:
            returns_echo = False
            for one, reflection, strips in zip(
                view.samples, view.reflections, view.strips[half], strict=True
            ):
                returns_echo |= sum_image_source(
                    self._workspace.works[half],
                    whole_rows(one.plane_echo),
                    one.lattice,
                    strips,
                    self._bins,
                    self.elevation_table,
                    tuple(reflection),
                    columns.all_sums,
                    columns.all_spans,
                )
            return returns_echo

        def add_images(half):
            of_images.clear_columns(half, columns)
            for number, view in enumerate(images):
                is_seen[half, number] = add(half, view)

        def add_own(half):
            clear_columns(*self._column_halves[half][1], columns.all_sums, columns.all_spans)
            for number in np.flatnonzero(is_seen.any(axis=0)):
                add(half, own[number])

        self._run(add_images)
        of_images.share_wide_columns(columns)
        if is_seen.any():
            self._run(add_own)
            self.share_wide_columns(columns)
        return self.weigh(columns, gain)

    def sum_bodies(self, view: ViewSamples, gain) -> tuple[BeamEcho, BodySums]:
        """Return what `sum_view` returns, to the bit, and the sums of each body for `find_labels`.

        view : ViewSamples, whose samples must hold the numbers of bodies
        """
        if not self._is_in_range(view):
            view = view.without_echo()
        columns = self._column_sums()
        is_little = self._strip_rows(self._images_of(view)) < FEW_LABEL_ROWS
        run, clear = partial(self._run, serial=is_little), partial(self.clear_columns, columns=columns)
        runs = self._labeller.sum_up(view, self.strips, run, columns, clear)
        self.share_wide_columns(columns)
        self._add_bubbles(view, columns)
        echo = self.weigh(columns, gain)
        is_more = self._far is not None or view.bubbles is not None
        direct = echo.intensity if is_more else np.empty((0, 0), np.float32)
        return echo, BodySums(runs, bins_of_bodies(view.body_spans, self._bins[0]), direct, is_little)

    def find_labels(
        self, bodies: BodySums, gain, n_bodies: int, background: ShadowedBackground | None = None
    ) -> Labels:
        """Return the labels of the view that `sum_bodies` summed last, with shares of the direct echo.

        bodies : as `sum_bodies` returned them
        gain : (K,) float32, as given to `sum_bodies`
        n_bodies : the highest number of a body
        background : on which bodies cast shadows; None for no shadows
        """
        mask, unshadowed = None, None
        if background is not None:
            mask, view = background
            columns = self._sum_surfaces(view)
            # without far side lobes, which labels leave out
            unshadowed, _ = self._weigh_support(columns, NO_GAIN)
        run = partial(self._run, serial=bodies.is_little)
        return self._labeller.find(bodies, run, gain, n_bodies, mask, unshadowed)

    def _run(self, work, serial: bool = False) -> None:
        """Call work(0) and work(1), one for each half: in two threads, or one after the other if `serial`."""
        run_halves(None if serial else self._thread, work)

    def weigh(self, columns: ColumnSums, gain) -> BeamEcho:
        """Return beams as weighted sums of the columns."""
        if self._far is None:
            return BeamEcho(*self._weigh_support(columns, gain))
        return self._weigh_all(columns, self._far, gain)

    def _weigh_support(self, columns: ColumnSums, gain) -> tuple[np.ndarray, float]:
        """Return (B, K) beams as weighted sums of the columns in the support of their patterns, and their sum."""
        tiles, out, totals = self._tiles, self._pool.empty(), [0.0, 0.0]

        def work(half):
            totals[half] = weigh_columns(
                columns.sums, columns.spans, tiles, self._tile_halves[half], gain, out
            )

        n_bins, _, _ = count_bins(columns.spans)
        self._run(work, tiles[1].size * n_bins / len(columns.spans) < FEW_PRODUCTS)
        return out, sum(totals)

    def _weigh_all(self, columns: ColumnSums, far: FarLobes, gain) -> BeamEcho:
        """Return beams as weighted sums of the columns in their support and of those in far side lobes.

        There are no more than two steps, since handing over half of one takes as long as a third of its work.
        """
        out, totals = self._pool.empty(), [0.0, 0.0]
        n_bins, first, past = count_bins(columns.spans)
        near, condense, couple = tuple(far.near), tuple(far.condense), tuple(far.couple)
        n_condense, n_couple = (TILE_BEAMS * len(tiles[0]) for tiles in (condense, couple))
        of_columns, of_beams = self._workspace.moments(n_condense, n_couple, out.shape[1])
        spans = np.empty((n_condense, 2), np.int64)
        spans[:] = first, past

        def sum_columns(half):
            weigh_columns(columns.sums, columns.spans, near, self._tile_halves[half], gain, out)
            tiles = half_of(len(condense[0]), half)
            weigh_columns(columns.sums, columns.spans, condense, tiles, NO_GAIN, of_columns)

        def add(half):
            beams, tiles = far.halves[half]
            weigh_columns(of_columns, spans, couple, tiles, NO_GAIN, of_beams)
            moments = of_beams, far.first_moment, far.expansion
            totals[half] = add_far_lobes(*moments, beams, (first, past), gain, out)

        n_bins /= len(columns.spans)
        self._run(sum_columns, (near[1].size + condense[1].size) * n_bins < FEW_PRODUCTS)
        if first < past:
            self._run(add, (couple[1].size + far.expansion.size) * (past - first) < FEW_PRODUCTS)
        return BeamEcho(out, sum(totals))


def _tables_of(fan: Fan, elevation_pattern: Callable | None) -> tuple[np.ndarray, tuple]:
    """Return `Beamformer.elevation_table`, and a plain BinTable."""
    if elevation_pattern is None:
        return NO_GAIN.astype(np.float64), tuple(bin_table(fan.sonar.bin_edges_m))
    sines = np.linspace(-1, 1, elevations_of(fan))
    table = elevation_pattern(sines)
    # the fan may be higher, to hold the side lobes of the pattern
    fov_rad = float(np.ptp(np.arcsin(sines[table > HALF_POWER_TWO_WAY])))
    return table, tuple(bin_table(fan.sonar.bin_edges_m, fov_rad))


def _shown_points(points: np.ndarray) -> np.ndarray:
    """Return point scatterers at the azimuths at which a line array shows them, those beside or behind it left out."""
    ahead = points[np.abs(points[:, 0]) < MAX_AZIMUTH_RAD]
    level = np.sqrt(np.maximum(1 - ahead[:, 1] ** 2, 0))
    return np.column_stack([np.arcsin(np.sin(ahead[:, 0]) * level), ahead[:, 1:]])
