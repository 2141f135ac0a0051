"""Rivals that trace rays."""

from __future__ import annotations

import numpy as np

import sonar_gl as sg
from sonar_gl.beamform.beamformer import Beamformer
from sonar_gl.beamform.kernels.work_table import make_work
from sonar_gl.sonar.samples import SectorSamples
from tools.chart.rivals.common import Rival
from tools.chart.rivals.embree import in_embree, make_packet, trace
from tools.chart.rivals.sums import hits, planes, point_bins, tubes

FAR_FACTOR = 8.0  # as ours: the footprint of a hit beyond the last bin may reach into it
PAPER = 140  # columns and rows of the founding paper's cloud


class Rays(Rival):
    """The base of rivals that trace; `lay` takes their rays."""

    def __init__(self, scene, sonar, acoustics, pose, **how):
        super().__init__(sonar, acoustics, **how)
        self.embree = in_embree(scene, pose)
        self.packets = make_packet(), make_packet()

    def lay(self, rays, cut=None):
        """Set the rays, (N, 3); one thread traces the first `cut`, a multiple of eight."""
        n = len(rays)
        self.rays = np.ascontiguousarray(
            np.concatenate([rays, np.repeat(rays[-1:], -n % 8, axis=0)]), np.float32
        )
        cut = n // 16 * 8 if cut is None else cut
        self.shares = ((0, cut), (cut, len(self.rays)))
        self.length = np.zeros(len(self.rays), np.float32)
        self.face = np.full(len(self.rays), -1, np.int32)
        self.samples = n

    def trace(self, half, rotation, origin, far):
        """Trace one thread's share."""
        e, (first, last) = self.embree, self.shares[half]
        trace(
            e.address, e.arguments, self.packets[half], self.rays, rotation, origin, np.float32(far),
            first, last, self.length, self.face,
        )  # fmt: skip


class PointRays(Rays):
    """Rays with point bins: a fan of even steps in azimuth and elevation, or jittered within its cells."""

    def __init__(self, scene, sonar, acoustics, pose, resolution, jittered=False, even=None, seed=0):
        super().__init__(scene, sonar, acoustics, pose, n_columns=even)
        per_spacing, rows = resolution
        columns, edges = self.cells(1e-9 if even else per_spacing)
        rng = np.random.default_rng(seed)
        heights = np.linspace(-self.top, self.top, rows + 1)
        rays, shares, owners = [], [], []
        for half in np.array_split(np.arange(self.fan.n_columns), 2):
            mine = np.flatnonzero(np.isin(columns, half))
            mine = np.append(mine, np.repeat(mine[-1:], -len(mine) % 8)).reshape(-1, 1, 8)
            again = np.zeros(mine.size, bool)
            again[1:] = np.diff(mine.ravel()) == 0
            shape = (len(mine), rows, 8)
            at = rng.random((2, *shape)) if jittered else np.full((2, 1, 1, 1), 0.5)
            azimuth = edges[mine] + at[0] * np.diff(edges)[mine]
            low, step = heights[:-1, None], np.diff(heights)[:, None]
            elevation = low + at[1] * step
            cosine = np.cos(elevation)
            d = [cosine * np.cos(azimuth), cosine * np.sin(azimuth), np.sin(elevation)]
            rays.append(np.stack([np.broadcast_to(x, shape) for x in d], axis=-1).reshape(-1, 3))
            solid = np.diff(edges)[mine] * step * cosine * ~again.reshape(mine.shape)
            shares.append(np.broadcast_to(solid, shape).ravel())
            owners.append(np.broadcast_to(columns[mine], shape).ravel())
        self.lay(np.concatenate(rays), len(rays[0]))
        self.samples = len(columns) * rows
        self.weight = np.concatenate(shares).astype(np.float32)
        self.column = np.concatenate(owners).astype(np.int32)

    def ping(self, pose):
        """Return (B, K) intensity."""
        rotation, origin = self.embree.place(pose)
        sums = self.sums
        middle = self.column[self.shares[1][0]] if len(sums) > 1 else 0

        def work(half):
            self.trace(half, rotation, origin, self.sonar.range_max_m)
            sums[slice(middle) if half == 0 else slice(middle, None)] = 0
            point_bins(
                self.rays, rotation, self.embree.faces, self.length, self.face, self.weight, self.column,
                *self.shares[half], self.r_first, self.per_metre, sums,
            )  # fmt: skip

        self.both(work)
        return self.beams()


class Lattice(Rays):
    """The very rays of our raster through Embree, and our footprints."""

    def __init__(self, scene, sonar, acoustics, pose, resolution):
        super().__init__(scene, sonar, acoustics, pose, sampling=sg.Sampling(*resolution))
        (self.sector,) = self.fan.sectors  # of the chart's sonars
        u, v = self.sector.sample_coordinates()
        # rows further out than one step beyond the aperture have no share in it
        near = np.abs(v) <= self.sector.tan_high * np.sqrt(1 + u * u) + 1.01 * self.sector.v[2]
        self.lay(np.stack([np.ones(near.sum()), -u[near], v[near]], axis=-1))
        index = np.flatnonzero(near)
        self.index = np.append(index, np.repeat(index[-1:], -self.samples % 8))
        self.plane_echo = np.zeros((*u.shape, 4), np.float32)
        self.no_bodies = np.empty((0, 0), np.uint16)
        self.beamformer = Beamformer(self.fan, self.weights, None, None, self.thread, self.is_box)
        self.to_sonar = self.sector.rotation().T

    def ping(self, pose):
        """Return (B, K) intensity."""
        rotation, origin = self.embree.place(pose)
        rotation = rotation @ self.to_sonar

        def work(half):
            self.trace(half, rotation, origin, FAR_FACTOR * self.sonar.range_max_m)
            planes(
                self.rays, rotation, origin, self.embree.faces, self.face, self.index,
                *self.shares[half], self.plane_echo.reshape(-1, 4),
            )  # fmt: skip

        self.both(work)
        samples = SectorSamples(self.sector, self.plane_echo, self.no_bodies)
        return self.beamformer.sum_footprints([samples], self.gain).intensity


class Tubes(Rays):
    """Four neighbouring rays bound a tube, whose echo is spread over the ranges between them."""

    def __init__(self, scene, sonar, acoustics, pose, resolution):
        super().__init__(scene, sonar, acoustics, pose)
        per_spacing, rows = resolution
        columns, azimuth = self.cells(per_spacing)
        elevation = np.linspace(-self.top, self.top, rows + 1)[:, None]
        d = [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth)]
        self.lay(np.stack([*d, np.broadcast_to(np.sin(elevation), d[0].shape)], axis=-1).reshape(-1, 3))
        self.column, self.width = columns, np.diff(azimuth)
        self.height = np.diff(np.sin(elevation[:, 0]))
        self.s, self.echo = np.zeros((2, len(self.rays)), np.float32)
        cut = int(np.searchsorted(columns, self.halves[1].start))
        self.cell_halves = (0, cut), (cut, len(columns))
        self.works = make_work(), make_work()

    def ping(self, pose):
        """Return (B, K) intensity."""
        rotation, origin = self.embree.place(pose)
        faces = self.embree.faces

        def work(half):
            self.trace(half, rotation, origin, FAR_FACTOR * self.sonar.range_max_m)
            hits(self.rays, rotation, origin, faces, self.face, *self.shares[half], self.s, self.echo)

        def spread(half):
            self.sums[self.halves[half]] = 0
            tubes(
                self.works[half], self.rays, rotation, origin, faces, self.face, self.s, self.echo, self.column,
                self.width, self.height, *self.cell_halves[half], self.bins, self.sums,
            )  # fmt: skip

        self.both(work)
        self.both(spread)
        return self.beams()
