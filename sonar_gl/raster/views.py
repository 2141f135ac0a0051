"""Between the bodies of a scene and what draws them: how they lie before a sector, and which part of it they fill."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import accumulate
from typing import NamedTuple

import numpy as np

from sonar_gl.core.errors import SampleLimitError
from sonar_gl.raster.cull import DetailLimits, SectorGeometry
from sonar_gl.sonar.fan import NEAR_M
from sonar_gl.sonar.samples import NO_BODIES, NO_FACES, NO_SPANS, SectorSamples, ViewSamples, sector_table
from sonar_gl.sonar.sector import Sector

# Drawn at a time: 26 bytes each, and with OpenGL 16 in the driver. Samples chosen for a tolerance are fewer, so that a
# view of them takes no more than 220 MB. Wide fans of the finest bins take 5.2 million before the piles of the scene
# pylon, at a tolerance of 0.01.
MAX_SAMPLES, MAX_CHOSEN_SAMPLES = 1 << 24, 1 << 23
NO_PLANE = np.array([0.0, 0.0, 0.0, 1.0])  # a clip plane that cuts nothing
NO_SAMPLES = np.empty((0, 0, 4), np.float32)

# A patch replaces its mesh where its geometric error is at most so many samples, and where its echo changes
# by at most so much per radian of a sample's width; not at all where its normals make a specular lobe.
ERROR_SAMPLES, ECHO_PER_RAD = 0.01, 2.0


class SectorView:
    """Per-sector constants of drawing, computed once.

    far_m, range_max_m : distance of the far plane, and of the last bin
    whole : Window of all its samples
    sample_rad : least width of a sample
    furthest : length of the longest of its rays up to x = 1
    """

    def __init__(self, sector: Sector, far_m: float, range_max_m: float):
        u, v = sector.u, sector.v
        corners = [(i, j) for i in (-0.5, sector.columns - 0.5) for j in (-0.5, sector.rows - 0.5)]
        # in numbers, which take less time than small arrays: a sonar that moves has new samples now and then
        at_u, at_v = (
            [i * along + j * up + w for i, j in corners] for w, along, up in (u.tolist(), v.tolist())
        )
        self.sector, self.sample_rad = sector, min(u[1], v[2])
        self.furthest = max(math.hypot(1.0, *end) for end in zip(at_u, at_v, strict=True))
        self.whole = Window(0, 0, sector.columns, sector.rows)
        self.geometry = SectorGeometry(
            rotation=sector.rotation(),
            limits=np.array([min(at_u), max(at_u), min(at_v), max(at_v)]),
            inverse=np.linalg.inv(sector.steps),
            corner=np.array([u[0], v[0]]),
            size=np.array([sector.columns, sector.rows], float),
            u=u,
            v=v,
        )
        self.limits = DetailLimits(
            near_m=NEAR_M,
            far_m=float(far_m),
            range_max_m=float(range_max_m),
            error_per_m=ERROR_SAMPLES * self.sample_rad,
            echo_error=ECHO_PER_RAD * self.sample_rad,
        )


class SectorViews(NamedTuple):
    """What SectorView holds of each sector, stacked, in plain tuples: `geometry` and `limits`."""

    geometry: tuple
    limits: tuple


def stacked(views: Sequence[SectorView]) -> SectorViews:
    """Return the SectorViews of some views."""
    geometry, limits = ([getattr(view, name) for view in views] for name in SectorViews._fields)
    return SectorViews(*(tuple(np.array(one) for one in zip(*of, strict=True)) for of in (geometry, limits)))


class BodiesInView(NamedTuple):
    """Bodies as seen from one pose of the sonar.

    present : (n,) bool
    matrices : (n, 3, 4) sonar_from_body, about the middle of its mesh
    table : (n, PER_BODY) float32, whose columns `cull` names
    outside : whether back faces may be culled: the sonar is in the box of no closed body
    has_lobes : whether any has a specular lobe
    plane : (4,) a; only a · (x, y, z, 1) > 0 in the sonar's frame is drawn; or None
    is_cut : (n,) bool, bodies that lie on both sides of it
    spans : `body_spans` of `ViewSamples`
    """

    present: np.ndarray
    matrices: np.ndarray
    table: np.ndarray
    outside: bool
    has_lobes: bool
    plane: np.ndarray | None
    is_cut: np.ndarray
    spans: np.ndarray

    @property
    def placed(self) -> tuple:
        """What `choose_patches` takes of it."""
        return self[:4]


class Window(NamedTuple):
    """The samples of a sector whose rays may meet a body; all 0 where there are none."""

    first_column: int = 0
    first_row: int = 0
    columns: int = 0
    rows: int = 0


class PatchRoom:
    """Room for the patches that sectors choose; it grows."""

    def __init__(self):
        self._chosen = np.empty((0, 0, 2), np.int32)

    def take(self, n_sectors: int, most_patches: int) -> np.ndarray:
        """Return room for so many patches, or more, of each sector: (n_sectors, n, 2) int32."""
        n, most = self._chosen.shape[:2]
        if n < n_sectors or most < most_patches:
            self._chosen = np.empty((max(n, n_sectors), max(most, most_patches), 2), np.int32)
        return self._chosen[:n_sectors]


class RenderWorkspace:
    """The memory that renderers draw into, one at a time.

    most_samples : of a view
    make_image : function that returns room for the samples of a view, an object with `drop_large`
    """

    def __init__(self, most_samples: int, make_image: Callable):
        self._most_samples, self._make_image = most_samples, make_image
        self._images, self._other_images = [], []

    def images(self, count: int, keep_last: bool) -> list:
        """Return room for the samples of so many views; with `keep_last` not that of the last call."""
        if keep_last:
            self._images, self._other_images = self._other_images, self._images
        self._images += [self._make_image() for _ in range(count - len(self._images))]
        return self._images[:count]

    def check_samples(self, width: int, height: int) -> None:
        """Raise a SampleLimitError if an image of samples has more than a view may have."""
        if width * height > self._most_samples:
            raise SampleLimitError(
                f"samples with bodies before them must be no more than {self._most_samples} (got {width} columns by "
                f"{height} rows; ask for a larger tolerance or fewer samples)"
            )

    def drop_large(self) -> None:
        """Give back the memory of fine pings; samples that were drawn stay valid."""
        for image in (*self._images, *self._other_images):
            image.drop_large()


def distance_before_plane(plane, matrices, bounds) -> tuple[np.ndarray, np.ndarray]:
    """Return the least and the greatest distance of boxes before a plane; (n, 3, 4) and (n, 2, 3)."""
    middles, halves = (bounds[:, 1] + bounds[:, 0]) / 2, (bounds[:, 1] - bounds[:, 0]) / 2
    along = plane[:3] @ matrices[:, :, :3]
    middle = (along * middles).sum(axis=1) + matrices[:, :, 3] @ plane[:3] + plane[3]
    half = (np.abs(along) * halves).sum(axis=1)
    return middle - half, middle + half


class SectorLayout:
    """Lays the windows of a fan's sectors side by side in an image.

    views : of the sectors
    """

    def __init__(self, views: Sequence[SectorView]):
        self._views, self._last = views, ((), (), (), ())

    def samples(
        self,
        windows: Sequence[Window],
        plane_echo: np.ndarray,
        body_id: np.ndarray,
        face_id: np.ndarray = NO_FACES,
        body_spans: np.ndarray = NO_SPANS,
        is_dark: Sequence[bool] | None = None,
        n_faces: int = 0,
    ) -> ViewSamples:
        """Return the samples of a view.

        windows : of each sector
        plane_echo, body_id, face_id : (H, W, 4) float32, (H, W) uint16 and int32 of `SectorSamples`; body_id and
            face_id of no size if they are not known
        body_spans : of `ViewSamples`
        is_dark : of each sector, whether all of its samples met nothing; None if that is not known
        n_faces : of `ViewSamples`
        """
        sectors, lefts, table = self._place((*windows, is_dark))
        out = []
        for sector, left in zip(sectors, lefts, strict=True):
            if sector.columns == 0:
                out.append(SectorSamples(sector, NO_SAMPLES, NO_BODIES))
                continue
            here = (slice(0, sector.rows), slice(left, left + sector.columns))
            bodies = body_id[here] if body_id.size else NO_BODIES
            faces = face_id[here] if face_id.size else NO_FACES
            out.append(SectorSamples(sector, plane_echo[here], bodies, faces))
        arrays = plane_echo, lefts, face_id, body_id, table, body_spans
        return ViewSamples(tuple(out), *arrays, n_faces=n_faces)

    def _place(self, key: tuple) -> tuple:
        """Return the sectors of windows, where these begin, and their SectorTable; kept, since windows often stay.

        key : the windows, and `is_dark`
        """
        last = self._last  # other threads may replace it
        if last[0] != key:
            *windows, is_dark = key
            sectors = tuple(
                view.sector.within(*window) for view, window in zip(self._views, windows, strict=True)
            )
            lefts = tuple(accumulate((window.columns for window in windows[:-1]), initial=0))
            table = sector_table(sectors, lefts)
            if is_dark is not None:  # nothing to sum
                table.places[np.array(is_dark), 1:] = 0
            last = self._last = key, sectors, lefts, tuple(table)
        return last[1:]
