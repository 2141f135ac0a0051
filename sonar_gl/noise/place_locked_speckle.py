"""Place-locked (spatially coherent) speckle: a field that the sonar's pose alone determines."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
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
from sonar_gl.core.compiled import compiled, floats_at, inlined
from sonar_gl.core.worker import SecondThread, run_rows
from sonar_gl.noise.speckle import TAPS, BeamField, FieldCorrelation, aperture_width, has_low_ends, own_nodes
from sonar_gl.noise.wave_cache import CHUNK

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
# Waves that an aperture receives: N_DIRECTIONS in each block, of which those count that add LEAST_POWER to its power.
# Blocks are so long, in apertures: of tapers that are low at the ends of the aperture, and of others.
N_DIRECTIONS = 6
BLOCK_LENGTH, SHARP_BLOCK_LENGTH, LEAST_POWER = 1 / 3, 1 / 5, 1e-6
QUADRATURE = tuple(zip(*(part.tolist() for part in np.polynomial.legendre.leggauss(12)), strict=True))
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
    """

    azimuth_rad: np.ndarray
    first: np.ndarray
    weights: np.ndarray

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
    are interpolated by a sinc in a Kaiser window, which errs by 58 dB less than the field of one aperture. What
    `_weigh_waves` leaves out at the ends of an aperture errs by 44 dB less, by 38 dB of tapers without low ends.

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
    return Nodes(numbers * step, first - first.min(), weights)


@compiled
def add_products(block, direction, matrix, n_directions, shift, weights, out):
    """Add to out (N, n) the mean products of the fields of nodes with their own, and with those of the n − 1 next ones.

    Fields are sums over waves and over bins, so that a product is that of two sums; the real part counts.

    block, direction, matrix, n_directions, shift, weights : of a `_WaveSums`
    out : float64
    """
    n_nodes, n_blocks, n_own, n_weights = len(matrix), matrix.shape[1], matrix.shape[2], weights.shape[1]
    for i in range(n_nodes):
        for aside in range(min(out.shape[1], n_nodes - i)):
            j = i + aside
            further = block[j] - block[i]  # blocks and directions that both receive
            waves = 0.0
            for d in range(n_own):
                turned = (direction[i] + d - direction[j]) % n_directions
                if turned < n_own:
                    for b in range(max(further, 0), n_blocks + min(further, 0)):
                        for part in range(2):
                            waves += matrix[i, b, d, part] * matrix[j, b - further, turned, part]
            further = shift[j] - shift[i]
            bins = 0.0
            for k in range(max(further, 0), n_weights + min(further, 0)):
                bins += weights[i, k] * weights[j, k - further]
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
def _power(weights):
    """Return the sum of the squares of weights (n, 2)."""
    out = 0.0
    for n in range(len(weights)):
        out += weights[n, 0] * weights[n, 0] + weights[n, 1] * weights[n, 1]
    return out


@inlined
def _wave(addresses, direction, first, n, part):
    """Return n real and n imaginary parts of the wave of a direction, from the place `first` on."""
    address = addresses[direction % uint64(len(addresses))] + first
    return floats_at(address, n), floats_at(address + part, n)


@inlined
def _with_wave(x, y, weight, a, b):
    """Return x + iy plus a wave a + ib times its weight, the products one after the other."""
    x = x + weight[0] * a
    y = y + weight[0] * b
    return x - weight[1] * b, y + weight[1] * a


@compiled
def _add_block(addresses, direction, first, n_wave_bins, matrix, real, imaginary):
    """Add to real and imaginary parts (n,) the waves of a block in the directions that an aperture receives.

    Products are added one after the other, wave by wave: more at a time would be rounded in an order of LLVM's choice.

    addresses : (n,) of the waves of a block, (2, n_wave_bins) float32 each
    direction, first : of the first wave, and the place of its bin, in bytes
    matrix : (N_DIRECTIONS, 2) float32, real and imaginary parts of their weights
    """
    n, part = uint64(len(real)), uint64(4) * n_wave_bins
    a0, b0 = _wave(addresses, direction, first, n, part)
    a1, b1 = _wave(addresses, direction + uint64(1), first, n, part)
    a2, b2 = _wave(addresses, direction + uint64(2), first, n, part)
    a3, b3 = _wave(addresses, direction + uint64(3), first, n, part)
    a4, b4 = _wave(addresses, direction + uint64(4), first, n, part)
    a5, b5 = _wave(addresses, direction + uint64(5), first, n, part)
    w0, w1, w2 = (matrix[0, 0], matrix[0, 1]), (matrix[1, 0], matrix[1, 1]), (matrix[2, 0], matrix[2, 1])
    w3, w4, w5 = (matrix[3, 0], matrix[3, 1]), (matrix[4, 0], matrix[4, 1]), (matrix[5, 0], matrix[5, 1])
    for k in range(n):
        x, y = _with_wave(real[k], imaginary[k], w0, a0[k], b0[k])
        x, y = _with_wave(x, y, w1, a1[k], b1[k])
        x, y = _with_wave(x, y, w2, a2[k], b2[k])
        x, y = _with_wave(x, y, w3, a3[k], b3[k])
        x, y = _with_wave(x, y, w4, a4[k], b4[k])
        real[k], imaginary[k] = _with_wave(x, y, w5, a5[k], b5[k])


@compiled
def _sum_waves(addresses, n_wave_bins, block, direction, matrix, shift, weights, out):
    """Add to out (B, 2, K) the waves that the aperture of each beam receives, shifted along range.

    addresses : (blocks, n_directions) uint64 of waves, (2, n_wave_bins) float32 each; 0 where no aperture receives any
    block, direction : (B,) of the first wave that each aperture receives
    matrix : (B, blocks, N_DIRECTIONS, 2) float32, real and imaginary parts of the weights of waves
    shift, weights : (B,) and (B, n), of `_shift_weights`, n a multiple of 4, with zeros at the end
    """
    n_bins, n_weights = uint64(out.shape[2]), uint64(weights.shape[1])
    row = np.empty((2, n_bins + n_weights), np.float32)
    for beam in range(uint64(len(out))):
        first, row[:] = uint64(shift[beam]), float32(0)
        n = min(n_bins + n_weights - uint64(1), n_wave_bins - first)
        real, imaginary = row[0, :n], row[1, :n]
        for b in range(uint64(matrix.shape[1])):
            of_block = matrix[beam, b]
            if _power(of_block) > 0:
                places, turned = addresses[uint64(block[beam]) + b], uint64(direction[beam])
                _add_block(places, turned, uint64(4) * first, n_wave_bins, of_block, real, imaginary)
        _shift(row[0], weights[beam], out[beam, 0])
        _shift(row[1], weights[beam], out[beam, 1])


class _Layout(NamedTuple):
    """Where the waves of a place-locked field go.

    nodes : Nodes; None where the waves are summed for each beam
    azimuth_rad : (N,) of the nodes, or of the beams, radians in the world
    aperture_m : length of the aperture, metres
    n_directions : of waves, in a full circle
    block_length : in apertures
    """

    nodes: Nodes | None
    azimuth_rad: np.ndarray
    aperture_m: float
    n_directions: int
    block_length: float


def _lay_out(shape: FieldShape, pose) -> _Layout:
    """Return the layout of a field for a sonar's heading, and for which side of it is up."""
    heading_rad = np.arctan2(pose[1, 0], pose[0, 0])
    is_upside_down = pose[0, 0] * pose[1, 1] < pose[0, 1] * pose[1, 0]  # its z axis points below the horizon
    beams, width = np.asarray(shape.correlation.azimuth_rad), shape.correlation.beam_width_rad
    if is_upside_down:  # port beams look to starboard
        beams = -beams
    taper_series = shape.correlation.taper_series
    nodes = _nodes(heading_rad, beams, width, taper_series)
    azimuth = heading_rad + beams if nodes is None else nodes.azimuth_rad
    wavelengths = aperture_width(taper_series) / width  # in the aperture
    least_length = BLOCK_LENGTH if has_low_ends(taper_series) else SHARP_BLOCK_LENGTH
    # even, so that after a full circle all blocks have the same phase
    n_directions = 2 * max(math.ceil(2 * np.pi * wavelengths * least_length), N_DIRECTIONS // 2)
    block_length = n_directions / (4 * np.pi * wavelengths)
    return _Layout(nodes, azimuth, wavelengths * shape.wavelength_m, n_directions, block_length)


@compiled
def _weigh_waves(middle, turn, phase, phase_step, block_length, taper_series, amplitude, out):
    """Fill out (B, blocks, N_DIRECTIONS, 2) float32 with the weights by which apertures receive waves.

    A weight is the integral of what the aperture makes of its direction, a plane wave with the taper, times what a
    wave of the frame is: a plane wave in the window of its block. Those of an aperture have the power amplitude².

    middle : (B,) of apertures, from the middle of their first block, in apertures
    turn : (B,) from the first direction to that of the aperture, in directions
    phase, phase_step : (B,) of the first block, and from each block to the next, radians
    block_length : in apertures
    taper_series : (n,) of `FieldCorrelation`
    """
    integral = np.empty((N_DIRECTIONS, 2))
    for beam in range(len(out)):
        is_known = False
        c, s = math.cos(phase[beam]), math.sin(phase[beam])
        cos_step, sin_step = math.cos(phase_step[beam]), math.sin(phase_step[beam])
        power = 0.0
        for block in range(out.shape[1]):
            of_block, from_block = out[beam, block], middle[beam] - block * block_length
            is_even = len(taper_series) == 0 and abs(from_block) + block_length <= 0.5
            if not (is_even and is_known):  # else it is that of the block before
                _integrate(from_block, turn[beam], block_length, taper_series, integral)
            is_known = is_even
            for direction in range(N_DIRECTIONS):
                x, y = integral[direction]
                of_block[direction, 0], of_block[direction, 1] = x * c - y * s, x * s + y * c
            power += _power(of_block)
            c, s = c * cos_step - s * sin_step, s * cos_step + c * sin_step
        scale = float32(amplitude / math.sqrt(power))
        for block in range(out.shape[1]):
            of_block = out[beam, block]
            if _power(of_block) < LEAST_POWER * power:
                of_block[:] = float32(0)
            else:
                of_block *= scale


@compiled
def _integrate(from_block, turn, block_length, taper_series, out):
    """Fill out (N_DIRECTIONS, 2) with the integrals of `_weigh_waves`, without phase, for one aperture and block.

    from_block : of the middle of the aperture from that of the block, in apertures
    """
    out[:] = 0.0
    first, last = max(-block_length, from_block - 0.5), min(block_length, from_block + 0.5)
    if first >= last:
        return
    for node, share in QUADRATURE:
        v = (first + last) / 2 + node * (last - first) / 2
        angle = math.pi / 2 * v / block_length
        window, sine = math.cos(angle), math.sin(angle)
        weight = share * (last - first) * window
        if len(taper_series):
            # 1 + 2 Σ F_m cos(2πmv) by Clenshaw's recurrence
            cosine, near, far = math.cos(2 * math.pi * (v - from_block)), 0.0, 0.0
            for m in range(len(taper_series) - 1, -1, -1):
                near, far = taper_series[m] + 2 * cosine * near - far, near
            weight *= 1 + 2 * (cosine * near - far)
        # from each direction to the next, the wave turns by −2 angle
        cos_turn, sin_turn = 2 * window * window - 1, 2 * window * sine
        x, y = weight * math.cos(2 * angle * turn), weight * math.sin(2 * angle * turn)
        for direction in range(N_DIRECTIONS):
            out[direction, 0] += x
            out[direction, 1] += y
            x, y = x * cos_turn + y * sin_turn, y * cos_turn - x * sin_turn


@compiled
def _mark_received(block, direction, matrix, n_directions, n_of_chunk, out):
    """Mark those chunks of waves, out (blocks, chunks) bool, of which an aperture receives some.

    block, direction, matrix : of a `_WaveSums`
    n_of_chunk : directions
    """
    for beam in range(len(matrix)):
        for b in range(matrix.shape[1]):
            if _power(matrix[beam, b]) > 0:
                for d in range(N_DIRECTIONS):
                    out[block[beam] + b, (direction[beam] + d) % n_directions // n_of_chunk] = True


class _WaveSums(NamedTuple):
    """What the apertures of N beams, or nodes, receive of the waves of a cell; arrays as `_sum_waves` takes them.

    waves : whose addresses these are
    """

    waves: list[np.ndarray]
    addresses: np.ndarray
    n_wave_bins: int
    block: np.ndarray
    direction: np.ndarray
    matrix: np.ndarray
    shift: np.ndarray
    weights: np.ndarray

    def add_to(self, fields: np.ndarray, rows: slice) -> None:
        """Add the waves of some beams to their fields (N, 2, K)."""
        arrays = (one[rows] for one in (self.block, self.direction, self.matrix, self.shift, self.weights))
        _sum_waves(self.addresses, np.uint64(self.n_wave_bins), *arrays, fields[rows])

    def add_products_to(self, products: np.ndarray) -> None:
        """Add the mean products of the fields of nodes, as `add_products` does."""
        n_directions = self.addresses.shape[1]
        add_products(
            self.block, self.direction, self.matrix, n_directions, self.shift, self.weights, products
        )


def _wave_sums(shape: FieldShape, layout: _Layout, cells: tuple[Cell, Cell], waves_of) -> _WaveSums:
    """Return the sums over the waves of a cell of the sea; `waves_of` as for `place_locked_field`."""
    (_, azimuth, aperture_m, n_directions, length), ((cx, x, wx), (cy, y, wy)) = layout, cells
    along_m = x * np.cos(azimuth) + y * np.sin(azimuth)
    across_m = y * np.cos(azimuth) - x * np.sin(azimuth)
    middle = 2 * across_m / aperture_m
    block = np.floor((middle - 0.5) / length).astype(np.int64)
    place = azimuth * (n_directions / (2 * np.pi))
    # a direction on the grid has the same waves in each turn of the circle, in spite of rounding
    direction = np.floor(place + 1e-6).astype(np.int64) - (N_DIRECTIONS // 2 - 1)
    # Less the phase of the way from the cell's middle to the sonar and back. The field of a cell would else turn by
    # that from beam to beam, each cell by its own, and neighbours would not correlate where cells cross-fade.
    phase = np.pi * place * block - 4 * np.pi / shape.wavelength_m * along_m
    matrix = np.empty((len(azimuth), math.ceil(1 / length) + 2, N_DIRECTIONS, 2), np.float32)
    series = np.array(shape.correlation.taper_series, np.float64)
    amplitude = wx * wy * math.sqrt(0.5)
    _weigh_waves(
        middle - block * length, place - direction, phase, np.pi * place, length, series, amplitude, matrix
    )
    weights, shift = _shift_weights(shape, along_m / shape.bin_size_m)
    # the number of bins is a part of a pattern's bytes, since waves are drawn for all of them at once
    margin = int(np.ceil(CELL_M / shape.bin_size_m)) + _pulse_reach(shape) + (1 if shape.pulse is None else 2)
    if shape.pulse is not None and is_coarse(shape.bin_size_m, *shape.pulse):
        furthest = int(np.ceil(FURTHEST_M / shape.bin_size_m)) + coarse_reach(shape.bin_size_m, *shape.pulse)
        margin = max(margin, furthest)
    n_wave_bins = shape.n_bins + 2 * margin
    direction %= n_directions
    first_block = int(block.min())
    block -= first_block
    chunks = np.zeros((int(block.max()) + matrix.shape[1], -(-n_directions // CHUNK)), bool)
    _mark_received(block, direction, matrix, n_directions, CHUNK, chunks)
    places = [(b + first_block, d) for b, d in np.argwhere(chunks).tolist()]
    found = waves_of(cx, cy, places, n_wave_bins)
    waves = [found[place] for place in places]
    addresses = np.zeros((*chunks.shape, CHUNK), np.uint64)
    each = np.arange(CHUNK, dtype=np.uint64) * np.uint64(waves[0][0].nbytes)
    addresses[chunks] = np.array([one.ctypes.data for one in waves], np.uint64)[:, None] + each
    addresses = addresses.reshape(len(chunks), -1)[:, :n_directions]
    weights = np.pad(weights, ((0, 0), (0, -weights.shape[1] % 4)))
    addresses = np.ascontiguousarray(addresses)
    return _WaveSums(waves, addresses, n_wave_bins, block, direction, matrix, shift + margin, weights)


def place_locked_field(
    shape: FieldShape,
    pose,
    waves_of: Callable[[int, int, list[tuple[int, int]], int], Mapping[tuple[int, int], np.ndarray]],
    thread: SecondThread | None = None,
) -> BeamField:
    """Return a complex Gaussian field of unit variance that the sonar's pose alone determines.

    pose : (4, 4) world_from_sonar, or its first two rows; its heading, its horizontal position and which side is up
        count
    waves_of : function (cell x, cell y, chunks, number of bins) -> chunks of waves by their places, those or more, as
        `WaveCache.waves`
    thread : does a part of the work, with the same bytes

    Random waves from all directions of the circle lie on a line through the sonar. They are fixed in the
    world, and a beam receives them through its aperture, at its azimuth in the world. They are those of a tight frame:
    directions that lie evenly on the circle, in each block of the line, with windows whose squares add up to 1. Of
    such waves, with independent amplitudes, apertures receive fields that correlate as they overlap. N_DIRECTIONS about
    a beam have nearly all of its power in a block; with those alone, fields correlate by up to 0.006 otherwise than the
    array says, and by 0.02 of tapers without low ends.

    - Turning by the spacing of two beams moves the pattern by one beam.
    - Moving across a beam by d slides the aperture by 2 d, since transmitter and receiver both move: of a
      uniform array of length L, (1 − 2d/L)² of the intensity's variance stays correlated.
    - Moving along a beam by d moves its pattern by d in range.

    The cells of the sea, CELL_M wide, have independent waves and cross-fade, so patterns farther apart than a
    cell are uncorrelated. Pitch, roll and heave leave the pattern as it is, but of a sonar that hangs upside down it
    is the mirror image, as are its beams. As an approximation, the bearing
    of a scatterer does not change as the sonar passes it; near ones would move by d / r.

    Source: Daubechies, Grossmann, Meyer, "Painless nonorthogonal expansions", J. Math. Phys. 27, 1271-1283, 1986
    """
    layout = _lay_out(shape, pose)
    nodes, n_nodes = layout.nodes, len(layout.azimuth_rad)
    fields = np.zeros((max(n_nodes, TAPS), 2, shape.n_bins), np.float32)
    products = np.zeros((n_nodes, TAPS))
    is_little = fields.size * N_DIRECTIONS / layout.block_length < FEW_WAVE_PRODUCTS
    for cells in product(_cells_at(pose[0, 3]), _cells_at(pose[1, 3])):
        sums = _wave_sums(shape, layout, cells, waves_of)
        run_rows(None if is_little else thread, partial(sums.add_to, fields), n_nodes)
        if nodes is not None:
            sums.add_products_to(products)
    first, weights = own_nodes(n_nodes) if nodes is None else (nodes.first, nodes.even_weights(products))
    return BeamField(fields, first, weights, 1.0)
