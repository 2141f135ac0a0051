"""The far side lobes of receive beams: what a beam receives beyond the support of its pattern.

Each of B beams receives each of C columns there, which directly would take B C products in each bin, some six times as
many as the support takes. But far from its axis a pattern is simple: within a block of a few side lobes, a handful of
functions of azimuth describe what all beams receive. So columns are summed into `rank` moments of each block; the
moments of all blocks, by a matrix, into those of blocks of beams; and these into beams:

    far = V M Uᵀ columns

as with H² matrices of a single level (W. Hackbusch, Hierarchical Matrices, 2015, chapter 8). The pattern depends on the
difference of the coordinates of direction and axis alone, so that the functions of all blocks are the same, and M is
that of the blocks' distance. The first function is the constant: a floor is exact. Blocks are as large as the pattern
allows within TOLERANCE: large for a taper, whose side lobes lie below the floor.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Callable
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache, cached_property, lru_cache, partial
from threading import RLock
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from threadpoolctl import ThreadpoolController

from sonar_gl.acoustics.beam_pattern import FarPattern
from sonar_gl.beamform.kernels.beams import TILE_BEAMS, BeamTiles, beam_tiles
from sonar_gl.beamform.weights import BeamWeights
from sonar_gl.core.worker import STEP_BACK

# Largest error of the far pattern, relative to the floor and the peak of the side lobe there: 0.46 dB.
TOLERANCE = 0.1
RANKS = 4, 8, 12  # multiples of TILE_BEAMS
LOBES = 1, 1.25, 1.5, 1.75, 2, 2.25, 2.5, 3, 3.5, 4, 5, 6, 7, 8, 10, 12  # in a block, whole steps of nodes
COLUMNS_PER_BEAM = 2.5  # about, for the cost of blocks
# Fans of more side lobes, and more moments of columns, are left without: the memory would be gigabytes. Devices have up
# to 200 lobes and five million moments.
MAX_LOBES, MAX_MOMENTS = 1024, 20_000_000
NODES_PER_LOBE = 16  # of functions, which are interpolated linearly: off by 1 % of a lobe's peak at most
BEAMS_AT_ONCE = 32  # neighbours, for what is received in their support
BASIS_STRIDE = 4  # of pieces of the pattern that functions are made for: four a lobe hold all others


# The last bits of LAPACK's results depend on the number of its threads, and pings have the same bytes with any number.
# The limit is that of the process: while one thread has it, another must neither lift it nor begin. Within it a signal
# handler may make a simulator, which must not wait for what its own thread holds.
_LAPACK = RLock()


@cache
def _libraries() -> ThreadpoolController:
    """Return what limits the threads of NumPy's LAPACK, which is loaded; to look for it takes milliseconds."""
    return ThreadpoolController()


@contextmanager
def _one_thread():
    """Have LAPACK use one thread inside the block, which threads enter one by one."""
    with _LAPACK, STEP_BACK, _libraries().limit(limits=1, user_api="blas"):
        yield


@dataclass(frozen=True, eq=False)
class LobeBlocks:
    """The far side lobes of a sonar's beams, whatever its columns are.

    edges : (J + 1,) coordinates of `FarPattern.coordinate` between which the blocks lie, evenly
    nodes : (N,) coordinates from the edge of a block on
    functions : (N, rank) values there
    first_moment : (B,) of each beam's block of beams
    expansion : (B, rank) V
    coupling : (I rank, J rank) M; for few beams the rank of V is less
    error : the largest, as TOLERANCE
    """

    pattern: FarPattern
    edges: np.ndarray
    nodes: np.ndarray
    functions: np.ndarray
    first_moment: np.ndarray
    expansion: np.ndarray
    coupling: np.ndarray
    error: float

    @property
    def rank(self) -> int:
        """Number of functions."""
        return self.functions.shape[1]

    def values(self, places) -> np.ndarray:
        """Return the functions at coordinates from the edge of a block on: (..., rank)."""
        return np.stack([np.interp(places, self.nodes, one) for one in self.functions.T], axis=-1)


def _expand(expansion, first_moment, coupling) -> np.ndarray:
    """Return the rows V M of beams, (B, J rank), one product for each block of beams."""
    first, start = np.unique(first_moment, return_index=True)
    blocks = zip(first, np.split(expansion, start[1:]), strict=True)
    return np.concatenate([beams @ coupling[m : m + beams.shape[1]] for m, beams in blocks])


@dataclass(frozen=True, eq=False)
class FarLobes:
    """The far side lobes of beams over some columns.

    near : BeamTiles of the support: the pattern less what the far side lobes hold there
    condense, couple : BeamTiles of Uᵀ and M
    first_moment, expansion : (B,) int64 and (B, rank) float32, V over the solid angle of each beam
    response : function without arguments to `column_response`
    """

    near: BeamTiles
    condense: BeamTiles
    couple: BeamTiles
    first_moment: np.ndarray
    expansion: np.ndarray
    response: Callable[[], np.ndarray]

    @cached_property
    def column_response(self) -> np.ndarray:
        """What all beams together return of the echo in a column, that of the support included: (C,) float64.

        Pings without labels, and samplings that are tried, do without.
        """
        return self.response()

    @property
    def n_bytes(self) -> int:
        """Bytes of its tables, about."""
        tiles = self.near, self.condense, self.couple
        return sum(one.weights.nbytes for one in tiles) + self.expansion.nbytes

    @cached_property
    def halves(self) -> tuple[tuple[tuple[int, int], tuple[int, int]], ...]:
        """Of each half of the beams first and past the last of them, and of the tiles of `couple` that it expands.

        Beams of one block are in one half, so that none is coupled twice.
        """
        n_beams, n_tiles = len(self.first_moment), len(self.couple.first)
        middle = int(np.searchsorted(self.first_moment, self.first_moment[(n_beams - 1) // 2], side="right"))
        tile = n_tiles if middle == n_beams else int(self.first_moment[middle]) // TILE_BEAMS
        return ((0, middle), (0, tile)), ((middle, n_beams), (tile, n_tiles))


def make_lobe_blocks(pattern: FarPattern, axes_rad, ends_rad) -> LobeBlocks | None:
    """Return the far side lobes of beams; None if the supports of all beams cover the fan, or there are too many.

    Simulators of one sonar share them.

    axes_rad : (B,) of the beams
    ends_rad : first and last azimuth of the columns
    """
    with _one_thread():
        return _cheapest_blocks(pattern, tuple(np.asarray(axes_rad).tolist()), tuple(map(float, ends_rad)))


@lru_cache(maxsize=32)
def _cheapest_blocks(pattern: FarPattern, axes_rad: tuple, ends_rad: tuple) -> LobeBlocks | None:
    """Return the blocks of fewest products that keep TOLERANCE, or the smallest."""
    axes = pattern.coordinate(np.array(axes_rad))
    start, stop = pattern.coordinate(np.array(ends_rad))
    farthest = max(stop - axes[0], axes[-1] - start)
    n_lobes = (stop - start) / pattern.lobe_sine
    if n_lobes > MAX_LOBES or not pattern.is_far(np.linspace(0, farthest, 4096)).any():
        return None

    table = _node_table(pattern, stop - start)
    basis = cache(partial(_basis, table))  # one decomposition serves all ranks

    @cache
    def fit(rank: int, lobes: float) -> Fit:
        return _fit(table, basis(round(lobes * NODES_PER_LOBE))[:, :rank])

    cheapest, least, n_fit = None, math.inf, 0
    for rank in RANKS:
        # larger blocks err more; those that fewer functions fit need not be tried again, since more would cost more
        n_fit = bisect_left(
            LOBES, True, lo=n_fit, key=lambda lobes, rank=rank: fit(rank, lobes).error > TOLERANCE
        )
        if n_fit == 0 and rank < RANKS[-1]:
            continue
        lobes = LOBES[max(n_fit - 1, 0)]
        n_moments = math.ceil(n_lobes / lobes) * rank
        products = n_moments * min(n_moments, len(axes)) + (1 + COLUMNS_PER_BEAM) * len(axes) * rank
        if n_moments * COLUMNS_PER_BEAM * len(axes) <= MAX_MOMENTS and products < least:
            cheapest, least = (rank, lobes), products
    return None if cheapest is None else _blocks(table, fit(*cheapest), axes, start)


class NodeTable(NamedTuple):
    """The far pattern at the differences of two nodes, −N..N times their spacing.

    span : width of the fan, of coordinates
    power : (2 N + 1,)
    peak : (2 N + 1,) `FarPattern.peak`; infinite where errors do not count
    relative : (2 N + 1,) power over the peak: weak lobes are to be as exact as strong ones
    """

    pattern: FarPattern
    span: float
    power: np.ndarray
    peak: np.ndarray
    relative: np.ndarray

    @property
    def spacing(self) -> float:
        """The distance of two nodes."""
        return self.pattern.lobe_sine / NODES_PER_LOBE

    def n_blocks(self, n_steps: int) -> int:
        """Return how many blocks of so many steps from node to node cover the fan."""
        return math.ceil(self.span / (n_steps * self.spacing))

    def of_blocks(self, values, n_steps: int) -> np.ndarray:
        """Return `values` between the nodes of two blocks 0, 1, ... apart: (J, beam's node, column's node)."""
        middle, n_blocks = len(values) // 2, self.n_blocks(n_steps)
        rows = sliding_window_view(values, n_steps + 1)
        return rows[middle + n_steps * np.arange(n_blocks)[:, None] - np.arange(n_steps + 1)]


def _node_table(pattern: FarPattern, span: float) -> NodeTable:
    """Return the table for a fan of so many coordinates."""
    spacing = pattern.lobe_sine / NODES_PER_LOBE
    differences = spacing * np.arange(math.ceil(span / spacing) + LOBES[-1] * NODES_PER_LOBE + 1)
    power, peak = pattern.power(differences), pattern.peak(differences)
    counts = pattern.is_far(differences) & (differences <= span + spacing)
    halves = power, np.where(counts, peak, np.inf), power / peak
    return NodeTable(pattern, span, *(np.concatenate([half[:0:-1], half]) for half in halves))


class Fit(NamedTuple):
    """Functions of a block, and what they describe.

    functions : (N, rank) at its nodes
    coupling : (J, rank, rank) of blocks 0, 1, ... apart, the beam's function first
    error : the largest, as TOLERANCE
    """

    functions: np.ndarray
    coupling: np.ndarray
    error: float


def _fit(table: NodeTable, functions: np.ndarray) -> Fit:
    """Return how (N, rank) orthonormal functions describe the pattern in blocks of N nodes."""
    n_steps = len(functions) - 1
    power = table.of_blocks(table.power, n_steps)
    coupling = functions.T @ power @ functions
    # the pattern is even: between blocks that lie the other way round, all is the transpose
    error = functions @ coupling @ functions.T
    error -= power
    error /= table.of_blocks(table.peak, n_steps)
    return Fit(functions, coupling, float(max(error.max(), -error.min())))


def _basis(table: NodeTable, n_steps: int) -> np.ndarray:
    """Return orthonormal functions, the constant and then those that describe the pattern best, best first.

    They are (n_steps + 1, RANKS[-1]) float64.
    """
    n = n_steps + 1
    windows = sliding_window_view(table.relative, n)[::BASIS_STRIDE]
    windows = windows - windows.mean(axis=1, keepdims=True)
    _, vectors = np.linalg.eigh(windows.T @ windows)  # by rising eigenvalue
    constant = np.full((n, 1), 1 / math.sqrt(n))
    functions, _ = np.linalg.qr(np.hstack([constant, vectors[:, : -RANKS[-1] : -1]]))
    return functions


def _blocks(table: NodeTable, fit: Fit, axes, start: float) -> LobeBlocks:
    """Return the far side lobes of beams at coordinates `axes` over blocks of this fit from a coordinate on."""
    n_blocks, (n_nodes, rank) = len(fit.coupling), fit.functions.shape
    nodes = table.spacing * np.arange(n_nodes)
    edges = start + nodes[-1] * np.arange(n_blocks + 1)
    # of column's blocks from J − 1 to starboard to J − 1 to port of the beam's
    coupling = np.concatenate([fit.coupling[:0:-1].transpose(0, 2, 1), fit.coupling])
    block = np.clip((axes - start) // nodes[-1], 0, n_blocks - 1).astype(int)
    used, number = np.unique(block, return_inverse=True)
    distance = np.arange(n_blocks) - used[:, None] + n_blocks - 1
    matrix = coupling[distance].transpose(0, 2, 1, 3).reshape(len(used) * rank, n_blocks * rank)
    functions = fit.functions
    found = LobeBlocks(table.pattern, edges, nodes, functions, number * rank, functions, matrix, fit.error)
    expansion = found.values(axes - edges[block])
    if len(axes) >= len(matrix):
        return replace(found, expansion=expansion)
    # fewer beams than moments: M Uᵀ makes beams right away, and each expands itself alone
    beams = np.arange(len(axes))
    tile = TILE_BEAMS
    of_beams = _expand(expansion, number * rank, matrix)
    return replace(
        found,
        first_moment=beams // tile * tile,
        expansion=(beams[:, None] % tile == np.arange(tile)).astype(float),
        coupling=np.pad(of_beams, ((0, -len(axes) % tile), (0, 0))),
    )


@_one_thread()
def far_lobes(blocks: LobeBlocks, near: BeamWeights, column_edges_rad, transmit_pattern=None) -> FarLobes:
    """Return the far side lobes over some columns, and the support's weights less their share of it.

    Beams are normalised by the solid angle of all that they receive from the columns: a sphere about the sonar has the
    level 1 in each.

    near : of `beam_weights`, of whole columns
    transmit_pattern : of `beam_weights`
    """
    edges = np.asarray(column_edges_rad)
    shares = _shares(blocks, near, edges, transmit_pattern)
    return FarLobes(
        near=beam_tiles(near.first, shares.corrected),
        condense=_condensing_tiles(shares.means * shares.transmitted[:, None], shares.block),
        couple=beam_tiles(np.zeros(len(blocks.coupling), np.int64), blocks.coupling),
        first_moment=blocks.first_moment.astype(np.int64),
        expansion=(blocks.expansion * shares.per_sr[:, None]).astype(np.float32),
        # found once more for the few stages that need it: what it is made from takes four times the memory of the rest
        response=partial(_column_response, blocks, near, edges, transmit_pattern),
    )


class _Shares(NamedTuple):
    """What far side lobes receive of columns.

    block : (C, 8) of nodes of the columns, rising
    means : (J, C, rank) of the functions of each block over columns
    per_block, by_moment : (B, M) and (M, C) float32, whose product is what each beam receives, 1 on its axis
    columns, corrected : (B, W) about the support of each beam, and its weights there less what far side lobes receive
        in it
    transmitted, per_sr : (C,) power of the projector, and (B,) over the solid angle of each beam
    """

    block: np.ndarray
    means: np.ndarray
    per_block: np.ndarray
    by_moment: np.ndarray
    columns: np.ndarray
    corrected: np.ndarray
    transmitted: np.ndarray
    per_sr: np.ndarray


def _shares(blocks: LobeBlocks, near: BeamWeights, edges: np.ndarray, transmit_pattern) -> _Shares:
    """Return what far side lobes receive; arguments as of `far_lobes`."""
    C, rank, n_blocks = len(edges) - 1, blocks.rank, len(blocks.edges) - 1
    nodes, node_weights = np.polynomial.legendre.leggauss(8)
    widths = np.diff(edges)
    azimuths = edges[:-1, None] + widths[:, None] * (nodes + 1) / 2
    places = blocks.pattern.coordinate(azimuths)
    block = np.clip(np.searchsorted(blocks.edges, places, side="right") - 1, 0, n_blocks - 1)
    values = blocks.values(places - blocks.edges[block]) * (node_weights / 2)[:, None]
    means = np.zeros((n_blocks, C, rank))  # a wide column may lie in several blocks
    for node in range(len(nodes)):  # `np.add.at` takes ten times as long
        means[block[:, node], np.arange(C)] += values[:, node]
    by_moment = means.transpose(0, 2, 1).reshape(n_blocks * rank, C).astype(np.float32)
    per_block = _expand(blocks.expansion, blocks.first_moment, blocks.coupling).astype(np.float32)
    columns = (near.first[:, None] + np.arange(near.weights.shape[1])) % C
    of_support = np.where(near.weights, _in_support(per_block, by_moment, near, block, rank), 0)
    as_upright_rad = near.columns_sr / near.height
    beyond_rad = per_block @ (by_moment @ as_upright_rad) - (of_support * as_upright_rad[columns]).sum(axis=1)
    width_rad = near.width_rad + beyond_rad
    transmitted = np.ones(C)
    if transmit_pattern is not None:
        transmitted = transmit_pattern(azimuths) @ (node_weights / 2)
    per_sr = 1 / (width_rad * near.height)
    less = of_support * transmitted[columns] * per_sr[:, None]
    corrected = (near.weights * (near.width_rad / width_rad)[:, None] - less).astype(np.float32)
    return _Shares(block, means, per_block, by_moment, columns, corrected, transmitted, per_sr)


def _in_support(per_block, by_moment, near: BeamWeights, block, rank: int) -> np.ndarray:
    """Return what far side lobes receive of the columns in the support of each beam, 1 on its axis: (B, W) float32.

    Some beams at a time, which share columns and few blocks of them: all beams by all columns are ten times as many.

    per_block, by_moment, block : as of _Shares
    """
    (B, W), n_columns = near.weights.shape, len(block)
    out = np.empty((B, W), np.float32)
    for begin in range(0, B, BEAMS_AT_ONCE):
        first = near.first[begin : begin + BEAMS_AT_ONCE]
        columns = (first.min() + np.arange(np.ptp(first) + W)) % n_columns
        moments = (np.unique(block[columns])[:, None] * rank + np.arange(rank)).ravel()
        beams = slice(begin, begin + BEAMS_AT_ONCE)
        received = per_block[beams, moments] @ by_moment[moments[:, None], columns]
        out[beams] = np.take_along_axis(received, (first - first.min())[:, None] + np.arange(W), axis=1)
    return out


def _column_response(
    blocks: LobeBlocks, near: BeamWeights, edges: np.ndarray, transmit_pattern
) -> np.ndarray:
    """Return `FarLobes.column_response`; arguments as of `far_lobes`."""
    with _one_thread():
        shares = _shares(blocks, near, edges, transmit_pattern)
        far = shares.per_block @ shares.by_moment
    far *= shares.transmitted.astype(np.float32)
    far *= shares.per_sr.astype(np.float32)[:, None]
    np.add.at(far, (np.arange(len(far))[:, None], shares.columns), shares.corrected)
    # less than nothing counts as nothing, as in `add_far_lobes`
    np.maximum(far, 0, out=far)
    return far.sum(axis=0, dtype=np.float64)


def _condensing_tiles(means, block) -> BeamTiles:
    """Return tiles that sum columns into the moments of blocks.

    means : (J, C, rank) of the functions over columns
    block : (C, n) of nodes of the columns, rising
    """
    n_blocks, C, rank = means.shape
    first = np.minimum(np.searchsorted(block[:, -1], np.arange(n_blocks)), C - 1)
    past = np.searchsorted(block[:, 0], np.arange(n_blocks), side="right")
    width = max(int((past - first).max()), 1)
    weights = np.zeros((n_blocks, rank, width + -width % 4), np.float32)
    for j, (a, b) in enumerate(zip(first, past, strict=True)):
        weights[j, :, : max(b - a, 0)] = means[j, a:b].T
    tiles = weights.reshape(-1, TILE_BEAMS, weights.shape[2]).transpose(0, 2, 1)
    return BeamTiles(np.repeat(first, rank // TILE_BEAMS), np.ascontiguousarray(tiles))
