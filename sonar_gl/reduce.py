"""G-buffer to ping: samples into columns and bins, columns into beams."""

from __future__ import annotations

from queue import SimpleQueue
from threading import Thread

import numpy as np
from numba import uint64

from sonar_gl.compiled import compiled
from sonar_gl.fan import Fan
from sonar_gl.footprint import accumulate


def bin_tables(bin_edges_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(3, K + 1): s = 1/r at the edges of bins, their integrals of s ds and s² ds; the former in float32."""
    s = 1.0 / np.maximum(bin_edges_m, 1e-6)
    out = np.zeros((3, len(s)))
    out[0] = s
    out[1, :-1] = (s[:-1] ** 2 - s[1:] ** 2) / 2
    out[2, :-1] = (s[:-1] ** 3 - s[1:] ** 3) / 3
    return out, out[1].astype(np.float32)


@compiled
def weigh_columns(echo_sum, first, weights, out):
    """Beams as weighted sums of columns.

    echo_sum : (columns, K); first : (B,); weights : (B, W), of `fan.beam_weights`; out : (B, K), overwritten
    """
    n_columns, K = echo_sum.shape
    for b in range(out.shape[0]):
        row = uint64(b)
        for k in range(uint64(K)):
            out[row, k] = 0.0
        for w in range(weights.shape[1]):
            weight = weights[b, w]
            if weight == 0.0:
                continue
            column = uint64((first[b] + w) % n_columns)
            for k in range(uint64(K)):
                out[row, k] += weight * echo_sum[column, k]


def _serve(todo: SimpleQueue, done: SimpleQueue):
    """Do the second halves of work, until there is None."""
    while (work := todo.get()) is not None:
        try:
            done.put(work(1))
        except BaseException as why:
            done.put(why)
        work = None  # it holds its reducer, which must be free to go


class Reducer:
    """Turns the samples of a fan into beams and bins; owns the sums that every ping uses again.

    Two threads share the work by columns, each with its own, so that the sums do not depend on which of
    them is quicker.

    Parameters
    ----------
    fan : Fan
    first, weights : of `fan.beam_weights`
    """

    def __init__(self, fan: Fan, first: np.ndarray, weights: np.ndarray):
        # two queues and a thread hand over in half the time that an executor takes
        self._todo, self._done = SimpleQueue(), SimpleQueue()
        Thread(target=_serve, args=(self._todo, self._done), daemon=True).start()
        self.fan, self.first, self.weights = fan, first, weights
        self.edges = fan.sonar.bin_edges_m
        self.tables, self.flat = bin_tables(self.edges)
        self.sums = np.zeros((fan.n_columns, fan.sonar.n_bins), np.float32)
        self.footprint = fan.sampling.reducer == "footprint"
        heard = np.zeros(fan.n_columns, bool)
        for w in range(weights.shape[1]):
            heard[(first[weights[:, w] > 0] + w) % fan.n_columns] = True
        self.jobs = []
        for half in np.array_split(np.arange(fan.n_columns), 2):
            for index, sector in enumerate(fan.sectors):
                parts = sector.parts
                mine = np.isin(parts.column, half) & heard[parts.column]
                arrays = (parts.column[mine], parts.u[mine], parts.width[mine])
                self.jobs.append((len(self.jobs) // len(fan.sectors), index, arrays))

    def intensity(self, views) -> np.ndarray:
        """(B, K) float32 echo before the gain, from the samples of all sectors."""
        return self._beams(self._accumulate(views))

    def labels(self, views, gain, n_bodies: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The body of the strongest echo, (B, K) uint16; its mean elevation, (B, K) float32, radians; and
        the sum of each body's echo times the (K,) gain, (n_bodies + 1,) float64."""
        shape = (len(self.first), self.fan.sonar.n_bins)
        strongest, body_id = np.zeros(shape, np.float32), np.zeros(shape, np.uint16)
        elevation = np.full(shape, np.nan, np.float32)
        body_echo = np.zeros(n_bodies + 1)
        seen = [np.unique(bodies[plane_echo[..., 3] > 0]) for _, plane_echo, bodies in views]
        for body in np.unique(np.concatenate(seen)).tolist():
            echo = self._beams(self._accumulate(views, body))
            body_echo[body] = (echo @ gain.astype(np.float64)).sum()
            moment = self._beams(self._accumulate(views, body, moment=True))
            stronger = echo > strongest
            strongest[stronger] = echo[stronger]
            body_id[stronger] = body
            elevation[stronger] = moment[stronger] / echo[stronger]
        return body_id, elevation, body_echo

    def close(self):
        """End the other thread."""
        self._todo.put(None)

    def __del__(self):
        self.close()

    def _both(self, work):
        """Call work(0) and work(1), one of them in the other thread."""
        self._todo.put(work)
        try:
            work(0)
        finally:
            failure = self._done.get()
        if failure is not None:
            raise failure

    def _accumulate(self, views, body=0, moment=False) -> np.ndarray:
        """Fill the columns' sums, with one body's echo or all, or its moment; see `accumulate`."""

        def work(half):
            for owner, index, parts in self.jobs:
                if owner != half:
                    continue
                sector, plane_echo, bodies = views[index]
                accumulate(
                    plane_echo,
                    bodies,
                    sector.u,
                    sector.v,
                    sector.tan_elevation,
                    *parts,
                    self.edges,
                    self.tables,
                    self.flat,
                    self.footprint,
                    body,
                    moment,
                    self.sums,
                )

        self._both(work)
        return self.sums

    def _beams(self, sums) -> np.ndarray:
        out = np.empty((len(self.first), sums.shape[1]), np.float32)
        halves = np.array_split(np.arange(len(out)), 2)

        def work(half):
            if len(halves[half]):
                mine = slice(halves[half][0], halves[half][-1] + 1)
                weigh_columns(sums, self.first[mine], self.weights[mine], out[mine])

        self._both(work)
        return out
