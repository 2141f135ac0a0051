"""Place-locked (spatially coherent) speckle: a field that the sonar's pose alone determines."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from itertools import product
from typing import NamedTuple

import numpy as np
from numba import float32, uint64

from sonar_gl.acoustics.pulse import (
    PulseResponse,
    amplitude_response,
    coarse_reach,
    coarse_weights,
    field_weights,
    is_coarse,
)
from sonar_gl.core.compiled import compiled
from sonar_gl.core.worker import SecondThread, run_rows
from sonar_gl.noise.speckle import TAPS, BeamField, FieldCorrelation, aperture_width, own_nodes
from sonar_gl.noise.wave_cache import CHUNK, Waves

# Side of the square cells of the sea, each with independent waves. Their middles lie at whole multiples of it, since
# sonars often lie at the origin or at round numbers: one cell makes the field there, at corners four do.
CELL_M = 0.5
FADE_M = 0.1  # width of the cross-fade between two cells
FURTHEST_M = (CELL_M + FADE_M) / 2 * math.sqrt(2)  # of a sonar from the middle of a cell whose field it has
# Nodes between which the fields of beams are interpolated, TAPS for each beam: nodes per period of the field, shape
# of the Kaiser window, and how many for each beam are worth it.
OVERSAMPLING, KAISER, MOST_NODES = 2.0, 5.3, 0.8
# The window I₀(KAISER √z) = Σ ((KAISER/2)² z)ⁿ / n!², z <= 1: the terms that count in float32
KAISER_WINDOW = tuple(((KAISER / 2) ** n / math.factorial(n)) ** 2 for n in range(14))
# least number of waves in an aperture; the outermost count in part, so that it slides smoothly
MIN_WAVES = 64
# of waves and bins, some 0.5 ms; for fewer a hand-over to another thread does not pay
FEW_WAVE_PRODUCTS = 1_000_000


class FieldShape(NamedTuple):
    """What determines a place-locked field, besides the sonar's pose and the random waves.

    correlation : its beams have a width; its pulse weights do not count
    n_bins, bin_size_m, wavelength_m : K, metres, metres; true ones, also where a sonar shows others
    pulse : PulseResponse; None without one
    """

    correlation: FieldCorrelation
    n_bins: int
    bin_size_m: float
    wavelength_m: float
    pulse: PulseResponse | None = None


class Cell(NamedTuple):
    """A cell of the sea along one axis.

    number : whole number of the cell
    offset_m : the sonar's distance from the cell's middle, metres, signed
    amplitude : weight of the cell's field; squares add up to 1
    """

    number: int
    offset_m: float
    amplitude: float


def _cells_at(position_m: float) -> list[Cell]:
    """Return the cell at a position along one axis, or two of them within the cross-fade."""
    u = position_m / CELL_M
    cell = int(np.floor(u))
    share = min(max((u - cell - 0.5) * CELL_M / FADE_M + 0.5, 0.0), 1.0)
    both = ((cell, np.cos(share * np.pi / 2)), (cell + 1, np.sin(share * np.pi / 2)))
    return [Cell(c, position_m - c * CELL_M, float(w)) for c, w in both if w > 1e-6]


def _pulse_reach(shape: FieldShape) -> int:
    """Return how many bins the kernel of the pulse reaches to each side."""
    return 0 if shape.pulse is None else len(field_weights(shape.bin_size_m, *shape.pulse)) // 2


def _shift_weights(shape: FieldShape, shift_bins: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the interpolation that moves the fields of B beams along range.

    Returns weights, (B, n) float32 of unit power, and (B,) int64 bins from a bin to the first one that is weighted.

    shift_bins : (B,) bins; without a pulse the interpolation is linear
    """
    first = np.floor(shift_bins).astype(np.int64)
    fraction = (shift_bins - first)[:, None]
    if shape.pulse is None:
        weights = np.hstack([1 - fraction, fraction])
    elif is_coarse(shape.bin_size_m, *shape.pulse):
        reach = coarse_reach(shape.bin_size_m, *shape.pulse)
        first -= reach - 1
        weights = coarse_weights(fraction - np.arange(1 - reach, reach + 1), shape.bin_size_m, *shape.pulse)
    else:
        reach = _pulse_reach(shape) + 1
        first -= reach
        bins = fraction - np.arange(-reach, reach + 1)
        weights = amplitude_response(bins * shape.bin_size_m, *shape.pulse)
    return (weights / np.sqrt((weights**2).sum(1, keepdims=True))).astype(np.float32), first


class Nodes(NamedTuple):
    """Azimuths at which fewer fields than beams tell those of all beams, and how to interpolate them.

    azimuth_rad : (N,) radians in the world, on a grid that does not depend on the sonar's heading
    first, weights : (B,) int64 and (B, TAPS) float32: the first of the nodes about each beam, and their weights
    span_rad : the greatest distance of the first and the last of them, at any heading
    """

    azimuth_rad: np.ndarray
    first: np.ndarray
    weights: np.ndarray
    span_rad: float

    def even_weights(self, products: np.ndarray) -> np.ndarray:
        """Return the weights, (B, TAPS) float32, that give the field of each beam unit variance.

        Off the middle of a cell the patterns of nodes lie apart in range, and their apertures aside. Fields that differ
        by more than the waves of an aperture do add up to less, or more: by a tenth in power for fine bins.

        products : (N, TAPS) mean products of the field of each node with its own and those of the next nodes
        """
        out = np.empty_like(self.weights)
        _even_weights(self.first, self.weights, products, out)
        return out


@compiled
def _even_weights(first, weights, products, out):
    """Fill out (B, TAPS) with the weights of `Nodes.even_weights`; the others as there."""
    n_taps = uint64(out.shape[1])
    for b in range(uint64(len(out))):
        power = 0.0
        for i in range(n_taps):
            for j in range(i, n_taps):
                of_pair = products[uint64(first[b]) + i, j - i] * weights[b, i] * weights[b, j]
                power += of_pair if j == i else 2 * of_pair
        scale = float32(1 / math.sqrt(power))
        for i in range(n_taps):
            out[b, i] = weights[b, i] * scale


@compiled
def _interpolate_nodes(fraction, out):
    """Fill out (B, TAPS) float32 with the weights of the nodes about places, a sinc in a Kaiser window, of sum 1.

    fraction : (B,) of the way between the two middle nodes, 0 to 1
    """
    n_taps = out.shape[1]
    for b in range(uint64(len(out))):
        f, total = fraction[b], 0.0
        # sin πf, accurate also just before 1; from one node to the next it changes its sign
        sine = math.sin(math.pi * min(f, 1 - f))
        for tap in range(n_taps):
            off = f + (n_taps // 2 - 1 - tap)
            z, weight = max(1 - (2 * off / n_taps) ** 2, 0.0), 0.0
            for term in KAISER_WINDOW[::-1]:
                weight = weight * z + term
            if off != 0.0:
                weight *= (sine if tap % 2 else -sine) / (math.pi * off)
            out[b, tap] = weight
            total += weight
        for tap in range(n_taps):
            out[b, tap] /= total


def _nodes(
    heading_rad: float, beams_rad: np.ndarray, width_rad: float, taper_series: tuple[float, ...]
) -> Nodes | None:
    """Return the nodes of a sonar; None where they would hardly be fewer than its (B,) beams, at any heading.

    An aperture limits the field to one period per width / aperture_width() radians. OVERSAMPLING times as many nodes
    are interpolated by a sinc in a Kaiser window, which errs by 58 dB less than the field of one aperture.

    Source: Oppenheim, Schafer, Discrete-Time Signal Processing, 3rd ed., 2010, section 7.5.3
    """
    n_circle = int(np.ceil(OVERSAMPLING * aperture_width(taper_series) * 2 * np.pi / width_rad))
    step = 2 * np.pi / n_circle
    most = int(np.ceil(np.ptp(beams_rad) / step)) + TAPS
    if most > MOST_NODES * len(beams_rad):
        return None
    place = (heading_rad + beams_rad) / step
    first = np.floor(place).astype(np.int64) - (TAPS // 2 - 1)
    numbers = np.arange(first.min(), first.max() + TAPS)
    weights = np.empty((len(place), TAPS), np.float32)
    _interpolate_nodes(place - np.floor(place), weights)
    return Nodes(numbers * step, first - first.min(), weights, (most - 1) * step)


@compiled
def _dot(a, b):
    """Return the sum of the products of a and b, (N,) float32: four sums, which do not wait for one another."""
    p = q = r = s = float32(0)
    n = uint64(len(a)) // uint64(4) * uint64(4)
    for k in range(uint64(0), n, uint64(4)):
        p += a[k] * b[k]
        q += a[k + uint64(1)] * b[k + uint64(1)]
        r += a[k + uint64(2)] * b[k + uint64(2)]
        s += a[k + uint64(3)] * b[k + uint64(3)]
    for k in range(n, uint64(len(a))):
        p += a[k] * b[k]
    return (p + q) + (r + s)


@compiled
def add_products(start, matrix, shift, weights, out):
    """Add to out (N, n) the mean products of the fields of nodes with their own, and with those of the n − 1 next ones.

    Fields are sums over waves and over bins, so that a product is that of two sums; the real part counts.

    start, matrix, shift, weights : of a `_WaveSums`
    out : float64
    """
    n_nodes, n_waves, n_weights = len(matrix), matrix.shape[2], weights.shape[1]
    for i in range(n_nodes):
        for aside in range(min(out.shape[1], n_nodes - i)):
            j = i + aside
            further = start[j] - start[i]  # waves that both receive
            first, last = max(further, 0), n_waves + min(further, 0)
            waves = float32(0)
            if first < last:
                for part in range(2):
                    waves += _dot(
                        matrix[i, part, first:last], matrix[j, part, first - further : last - further]
                    )
            further = shift[j] - shift[i]
            first, last = max(further, 0), n_weights + min(further, 0)
            bins = float32(0)
            if first < last:
                bins = _dot(weights[i, first:last], weights[j, first - further : last - further])
            out[i, aside] += 2.0 * waves * bins


@compiled
def _shift(row, weights, out):
    """Add to out (K,) the values in row (K + n − 1 or more,), interpolated by weights (n,), n a multiple of 4."""
    for j in range(uint64(0), uint64(len(weights)), uint64(4)):
        a, b, c, d = weights[j], weights[j + 1], weights[j + 2], weights[j + 3]
        p, q, r, s = row[j:], row[j + 1 :], row[j + 2 :], row[j + 3 :]
        for k in range(uint64(len(out))):
            x = out[k] + a * p[k]
            x = x + b * q[k]
            x = x + c * r[k]
            out[k] = x + d * s[k]


@compiled
def _sum_waves(coefficients, start, matrix, shift, weights, out):
    """Add to out (B, 2, K) the waves that the aperture of each beam receives, shifted along range.

    Two neighbouring beams are summed at a time, since each wave is then read once for both. They take its bins at the
    same places, and those waves that only one of them receives count 0 for the other. Products are added one after the
    other, wave by wave, so that bytes do not depend on which beams are paired.

    coefficients : (M, 2, N) float32, complex amplitudes of M waves at N bins
    start : (B,) number of each beam's first wave
    matrix : (B, 2, W) float32, real and imaginary parts of the weights of each beam's W waves
    shift, weights : (B,) and (B, n), of `_shift_weights`, n a multiple of 4, with zeros at the end
    """
    n_beams, n_bins, n_waves = uint64(out.shape[0]), uint64(out.shape[2]), uint64(matrix.shape[2])
    n_weights = uint64(weights.shape[1])
    row = np.zeros((4, uint64(coefficients.shape[2]) + n_weights), np.float32)
    i, j, u, v = row[0], row[1], row[2], row[3]
    for one in range(uint64(0), n_beams, uint64(2)):
        other = min(one + uint64(1), n_beams - uint64(1))  # the last of an odd number is beside itself
        from_one, from_other = uint64(start[one]), uint64(start[other])
        first = uint64(min(shift[one], shift[other]))
        last = uint64(max(shift[one], shift[other])) + n_bins + n_weights - uint64(1)
        last = min(last, uint64(coefficients.shape[2]))
        n = last - first
        for k in range(n):
            i[k] = j[k] = u[k] = v[k] = float32(0)
        # two waves at a time, of which the second may be beyond the last: sums stay in registers
        end = max(from_one, from_other) + n_waves
        for wave in range(min(from_one, from_other), end, uint64(2)):
            c, s = _weight_of(matrix, one, wave - from_one)
            d, t = _weight_of(matrix, one, wave + uint64(1) - from_one)
            e, f = _weight_of(matrix, other, wave - from_other)
            g, h = _weight_of(matrix, other, wave + uint64(1) - from_other)
            following = min(wave + uint64(1), end - uint64(1))
            a, b = coefficients[wave, 0, first:last], coefficients[wave, 1, first:last]
            p, q = coefficients[following, 0, first:last], coefficients[following, 1, first:last]
            for k in range(n):
                ak, bk, pk, qk = a[k], b[k], p[k], q[k]
                # one product a statement: more would be rounded in an order of LLVM's choice
                ik = i[k] + c * ak
                ik = ik - s * bk
                ik = ik + d * pk
                ik = ik - t * qk
                jk = j[k] + c * bk
                jk = jk + s * ak
                jk = jk + d * qk
                jk = jk + t * pk
                uk = u[k] + e * ak
                uk = uk - f * bk
                uk = uk + g * pk
                uk = uk - h * qk
                vk = v[k] + e * bk
                vk = vk + f * ak
                vk = vk + g * qk
                vk = vk + h * pk
                i[k], j[k], u[k], v[k] = ik, jk, uk, vk
        near = uint64(shift[one]) - first
        _shift(i[near:], weights[one], out[one, 0])
        _shift(j[near:], weights[one], out[one, 1])
        if other != one:
            near = uint64(shift[other]) - first
            _shift(u[near:], weights[other], out[other, 0])
            _shift(v[near:], weights[other], out[other, 1])


@compiled
def _weight_of(matrix, beam, wave):
    """Return the real and the imaginary part of a beam's weight of a wave, its number in the aperture; 0 beyond."""
    if wave < uint64(matrix.shape[2]):  # which unsigned numbers below 0 are not
        return matrix[beam, 0, wave], matrix[beam, 1, wave]
    return float32(0), float32(0)


class _Layout(NamedTuple):
    """Where the waves of a place-locked field go.

    nodes : Nodes; None where the waves are summed for each beam
    azimuth_rad : (N,) of the nodes, or of the beams, radians in the world
    length : of the aperture, in waves
    repeats : how often the field repeats in a full circle
    """

    nodes: Nodes | None
    azimuth_rad: np.ndarray
    length: float
    repeats: int


def _lay_out(shape: FieldShape, pose) -> _Layout:
    """Return the layout of a field for a sonar's heading, and for which side of it is up."""
    heading_rad = np.arctan2(pose[1, 0], pose[0, 0])
    is_upside_down = pose[0, 0] * pose[1, 1] < pose[0, 1] * pose[1, 0]  # its z axis points below the horizon
    beams, width = np.asarray(shape.correlation.azimuth_rad), shape.correlation.beam_width_rad
    if is_upside_down:  # port beams look to starboard
        beams = -beams
    taper_series = shape.correlation.taper_series
    nodes = _nodes(heading_rad, beams, width, taper_series)
    if nodes is None:
        azimuth, span = heading_rad + beams, np.ptp(beams)
    else:
        azimuth, span = nodes.azimuth_rad, nodes.span_rad
    # number of waves in an aperture, if the field repeats after one full circle ...
    waves = aperture_width(taper_series) * 2 * np.pi / width
    # ... and after the `repeats`-th part of it, which must be longer than the fan; the same at any heading
    repeats = max(1, int(min(2 * np.pi / (1.2 * span + 12 * width), waves / MIN_WAVES)))
    return _Layout(nodes, azimuth, waves / repeats, repeats)


@compiled
def _weigh_waves(position, length, taper_series, phase, turn, amplitude, out):
    """Fill out (B, 2, W) float32 with the weights, real and imaginary parts, by which apertures receive waves.

    Those of each aperture have the power amplitude². The angles of its waves are evenly spread: each direction is the
    one before, turned. In float64 that errs by less than float32 rounds, and takes a tenth of the time.

    position : (B,) of the first wave from the middle of the aperture, in waves
    length : of the apertures, in waves
    taper_series : (n,) of `FieldCorrelation`
    phase, turn : (B,) of the first wave, and from each wave to the next, radians
    """
    step = 2 * math.pi / length
    cos_step, sin_step = math.cos(step), math.sin(step)
    for b in range(len(out)):
        x, y = math.cos(step * position[b]), math.sin(step * position[b])  # of the place in the aperture
        c, s = math.cos(phase[b]), math.sin(phase[b])
        cos_turn, sin_turn = math.cos(turn[b]), math.sin(turn[b])
        power = 0.0
        for w in range(uint64(out.shape[2])):
            from_middle = abs(position[b] + w)
            # 1 + 2 Σ F_m cos(mx) by Clenshaw's recurrence
            cosine, near, far = x if from_middle < length / 2 else -1.0, 0.0, 0.0
            for m in range(len(taper_series) - 1, -1, -1):
                near, far = taper_series[m] + 2 * cosine * near - far, near
            weight = 1 + 2 * (cosine * near - far)
            weight *= min(max(length / 2 + 0.5 - from_middle, 0.0), 1.0)  # the outermost waves count in part
            out[b, 0, w], out[b, 1, w] = weight * c, weight * s
            power += weight * weight
            x, y = x * cos_step - y * sin_step, y * cos_step + x * sin_step
            c, s = c * cos_turn - s * sin_turn, s * cos_turn + c * sin_turn
        scale = float32(amplitude / math.sqrt(power))
        for part in range(2):
            for w in range(uint64(out.shape[2])):
                out[b, part, w] *= scale


class _WaveSums(NamedTuple):
    """What the apertures of N beams, or nodes, receive of the waves of a cell; arrays as `_sum_waves` takes them."""

    coefficients: np.ndarray
    start: np.ndarray
    matrix: np.ndarray
    shift: np.ndarray
    weights: np.ndarray

    def add_to(self, fields: np.ndarray, rows: slice) -> None:
        """Add the waves of some beams to their fields (N, 2, K)."""
        arrays = self.start[rows], self.matrix[rows], self.shift[rows], self.weights[rows]
        _sum_waves(self.coefficients, *arrays, fields[rows])


def _wave_sums(shape: FieldShape, layout: _Layout, cells: tuple[Cell, Cell], waves_of) -> _WaveSums:
    """Return the sums over the waves of a cell of the sea; `waves_of` as for `place_locked_field`."""
    (_, azimuth, length, repeats), ((cx, x, wx), (cy, y, wy)) = layout, cells
    spacing_m = shape.wavelength_m * repeats / (2 * np.pi)
    along_m = x * np.cos(azimuth) + y * np.sin(azimuth)
    across_m = y * np.cos(azimuth) - x * np.sin(azimuth)
    middle = 2 * across_m / spacing_m
    start = np.ceil(middle - length / 2 - 0.5).astype(np.int64)
    # Less the phase of the way from the cell's middle to the sonar and back. The field of a cell would else turn by
    # that from beam to beam, each cell by its own, and neighbours would not correlate where cells cross-fade.
    phase = start * repeats * azimuth - 4 * np.pi / shape.wavelength_m * along_m
    matrix = np.empty((len(azimuth), 2, math.ceil(length) + 1), np.float32)
    series = np.array(shape.correlation.taper_series, np.float64)
    _weigh_waves(start - middle, length, series, phase, repeats * azimuth, wx * wy * math.sqrt(0.5), matrix)
    weights, shift = _shift_weights(shape, along_m / shape.bin_size_m)
    # the number of bins is a part of a pattern's bytes, since waves are drawn for all of them at once
    margin = int(np.ceil(CELL_M / shape.bin_size_m)) + _pulse_reach(shape) + (1 if shape.pulse is None else 2)
    if shape.pulse is not None and is_coarse(shape.bin_size_m, *shape.pulse):
        furthest = int(np.ceil(FURTHEST_M / shape.bin_size_m)) + coarse_reach(shape.bin_size_m, *shape.pulse)
        margin = max(margin, furthest)
    past = int(start.max()) + matrix.shape[2]
    chunks = range(int(start.min()) // CHUNK, (past - 1) // CHUNK + 1)
    chunks, coefficients = waves_of(cx, cy, chunks, shape.n_bins + 2 * margin)
    weights = np.pad(weights, ((0, 0), (0, -weights.shape[1] % 4)))
    return _WaveSums(coefficients, start - chunks.start * CHUNK, matrix, shift + margin, weights)


def place_locked_field(
    shape: FieldShape,
    pose,
    waves_of: Callable[[int, int, range, int], Waves],
    thread: SecondThread | None = None,
) -> BeamField:
    """Return a complex Gaussian field of unit variance that the sonar's pose alone determines.

    pose : (4, 4) world_from_sonar, or its first two rows; its heading, its horizontal position and which side is up
        count
    waves_of : function (cell x, cell y, chunks, number of bins) of those waves, or more
    thread : does a part of the work, with the same bytes

    Random waves from all directions of the circle lie on a line through the sonar. They are fixed in the
    world, and a beam receives them through its aperture, at its azimuth in the world.

    - Turning by the spacing of two beams moves the pattern by one beam.
    - Moving across a beam by d slides the aperture by 2 d, since transmitter and receiver both move: of a
      uniform array of length L, (1 − 2d/L)² of the intensity's variance stays correlated.
    - Moving along a beam by d moves its pattern by d in range.

    The cells of the sea, CELL_M wide, have independent waves and cross-fade, so patterns farther apart than a
    cell are uncorrelated. Pitch, roll and heave leave the pattern as it is, but of a sonar that hangs upside down it
    is the mirror image, as are its beams. As an approximation, the bearing
    of a scatterer does not change as the sonar passes it; near ones would move by d / r.
    """
    layout = _lay_out(shape, pose)
    nodes, n_nodes = layout.nodes, len(layout.azimuth_rad)
    fields = np.zeros((max(n_nodes, TAPS), 2, shape.n_bins), np.float32)
    products = np.zeros((n_nodes, TAPS))
    is_little = fields.size * layout.length < FEW_WAVE_PRODUCTS
    for cells in product(_cells_at(pose[0, 3]), _cells_at(pose[1, 3])):
        sums = _wave_sums(shape, layout, cells, waves_of)
        run_rows(None if is_little else thread, partial(sums.add_to, fields), 0, n_nodes)
        if nodes is not None:
            add_products(*sums[1:], products)
    first, weights = own_nodes(n_nodes) if nodes is None else (nodes.first, nodes.even_weights(products))
    return BeamField(fields, first, weights, 1.0)
