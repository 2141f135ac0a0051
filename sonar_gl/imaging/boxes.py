"""Bodies in a labelled ping and in its fan image: bounding boxes and maps, to train detectors on.

A few faint bins far from a body, as of its side lobes, do not decide its box: at each end of it, beams or bins are left
out that hold next to nothing of what a display shows of the body.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numba import uint64

from sonar_gl.core.compiled import compiled, inlined
from sonar_gl.core.errors import Error
from sonar_gl.imaging.fan_image import FanGeometry, azimuth_key, fan_geometry, nearest_cells
from sonar_gl.ping import Ping
from sonar_gl.sonar.counts import Counts

# A box leaves out, at each end, beams or bins that hold at most this part of the body's brightness: 0.5 %
LEFT_OUT_OF = 200
_NO_PIXEL = 32767  # first column and row of a bin without pixels: outside any picture
# A table of brightness has an entry for each value of the upper 15 bits of a float32: 64 to a factor of two
_SHIFT, _MASK = np.uint32(17), np.uint32((1 << 14) - 1)
_FULL_BRIGHTNESS = 65535


@dataclass(frozen=True, eq=False)
class Boxes:
    """The n bodies in view of a ping: those with the strongest echo in some bin.

    The beams and bins of a box are those of the body but the outermost ones: at each of the four ends as many beams or
    bins are left out as hold, together, at most 0.5 % of the body's brightness. Where it has none, none are.

    Attributes
    ----------
    body_id : (n,) uint16, their numbers, rising
    n_bins : (n,) int64, number of bins that the box encloses where the body's echo is the strongest
    beams, bins : (n, 2) int64, first and last one. Across the seam of a full circle the first beam is the greater one
    pixels : (n, 4) int64, left column, top row, width and height of the box in the fan image, whole pixels.
        It encloses the body's pixels in `body_map`, or one pixel if the body's bins lie between pixels
    energy : (n,) float64, the body's `body_echo`
    """

    body_id: np.ndarray
    n_bins: np.ndarray
    beams: np.ndarray
    bins: np.ndarray
    pixels: np.ndarray
    energy: np.ndarray


def boxes_of(ping: Ping, height: int = 800, quiet: Ping | None = None) -> Boxes:
    """Return the bounding boxes of the bodies of a labelled ping.

    Parameters
    ----------
    ping : with `body_id` and `body_echo`
    height : of `fan_image`, pixels
    quiet : the same ping without noise, whose counts say how bright each bin is; None for `ping` itself, whose noise
        then has a small part in the boxes. All bins of a ping without a sonar are equally bright

    Raises
    ------
    Error
        if the ping has no labels, or they do not match, or the height is out of bounds.
    """
    geometry = _labelled_geometry(ping, height)
    runs, areas = _areas(ping, quiet, geometry.full_circle)
    found = np.empty((len(areas), 9), np.int64)
    _find_extents(runs, _extents(geometry, ping.body_id.shape, azimuth_key(ping)), areas, found)
    body_id = np.flatnonzero(found[:, 0])
    n_bins, beams, bins, pixels = np.split(found[body_id], [1, 3, 5], axis=1)
    n_beams = len(ping.azimuth_rad)
    for body in np.flatnonzero(pixels[:, 0] > pixels[:, 1]):  # its bins lie between pixels: the nearest pixel
        azimuth, range_m = ping.azimuth_rad[beams[body] % n_beams].mean(), ping.range_m[bins[body]].mean()
        if beams[body, 0] < n_beams <= beams[body, 1]:
            azimuth += np.pi  # the middle of two beams on either side of the seam
        column, row = (round(float(x)) for x in geometry.pixel(azimuth, range_m))
        column, row = min(max(column, 0), geometry.width - 1), min(max(row, 0), geometry.height - 1)
        pixels[body] = column, column, row, row
    left, right, top, bottom = pixels.T
    return Boxes(
        body_id=body_id.astype(np.uint16),
        n_bins=n_bins[:, 0],
        beams=beams % n_beams,
        bins=bins,
        pixels=np.stack([left, top, right - left + 1, bottom - top + 1], axis=1),
        energy=np.asarray(ping.body_echo)[body_id],
    )


def body_map(ping: Ping, height: int = 800, quiet: Ping | None = None) -> np.ndarray:
    """Return the number of the body in the bin nearest to each pixel of `fan_image`, (H, W) uint16.

    It is 0 outside the fan, where no body has an echo, and outside the body's box. Parameters and errors are those of
    `boxes_of`.
    """
    return body_map_and_bins(ping, height, quiet)[0]


def body_map_and_bins(ping: Ping, height: int, quiet: Ping | None) -> tuple[np.ndarray, np.ndarray]:
    """Return `body_map`, and the number of the body whose box encloses each bin, (B, K) uint16, 0 for none."""
    geometry = _labelled_geometry(ping, height)
    out = np.zeros(ping.body_id.size + 1, np.uint16)  # cell −1, outside the fan, is the last one
    bins = out[:-1].reshape(ping.body_id.shape)
    _draw_inside(*_areas(ping, quiet, geometry.full_circle), bins)
    return out[nearest_cells(geometry, ping.body_id.shape, azimuth_key(ping))], bins


def _areas(ping: Ping, quiet: Ping | None, full_circle: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return the runs of bins of one body, and the areas: where the boxes of bodies lie in the polar array.

    runs : (n, 4) int64: body, beam, first bin, end
    areas : (bodies + 1, 4) int64, by number: first beam, number of beams from there on, also across the seam of a full
        circle, first and last bin. A body out of view has no beams
    """
    quiet = ping if quiet is None else quiet
    if quiet.intensity.shape != ping.intensity.shape:
        raise Error(
            f"a ping without noise must have the shape of the noisy one, {ping.intensity.shape} "
            f"(got {quiet.intensity.shape})"
        )
    body_id, n_beams = _fixed(ping.body_id), len(ping.azimuth_rad)
    n_runs = n_beams + np.count_nonzero(body_id[:, 1:] != body_id[:, :-1])
    runs, areas = np.empty((n_runs, 4), np.int64), np.empty((len(ping.body_echo), 4), np.int64)
    runs = runs[: _find_runs(body_id, runs, areas)]
    if full_circle:  # all beams, of which the ends are to be found
        areas[areas[:, 1] > 0, :2] = 0, n_beams
    lengths = np.where(areas[:, 1] > 0, areas[:, 1] + areas[:, 3] - areas[:, 2] + 1, 0)
    ends = np.cumsum(lengths)
    profiles = np.zeros(int(ends[-1]), np.int64)
    echoes = _fixed(np.asarray(quiet.intensity, np.float32)).view(np.uint32)
    table = _EVEN if quiet.sonar is None else _brightness_table(quiet.counts_law())
    _add_brightness(runs, echoes, table, areas, ends - lengths, profiles)
    _leave_out_faint_ends(profiles, ends - lengths, full_circle, areas)
    return runs, areas


def _fixed(array: np.ndarray) -> np.ndarray:
    """Return a read-only view of an array, contiguous: compiled functions are compiled anew for one that is not."""
    view = np.ascontiguousarray(array).view()
    view.setflags(write=False)
    return view


@lru_cache(maxsize=4)
def _brightness_table(law: Counts) -> np.ndarray:
    """Return the counts, of 16 bits, of the echo in the middle of each entry's range, (16384,) uint16.

    To find the counts of all bins would take several times as long as the boxes. The middle is wrong by 0.8 % of the
    echo at most. The sign, which is the first bit, counts for nothing.
    """
    middles = (np.arange(_MASK + 1, dtype=np.uint32) << _SHIFT) + (np.uint32(1) << (_SHIFT - np.uint32(1)))
    echoes = middles.view(np.float32)
    is_finite = np.isfinite(echoes)
    share = law.share(np.where(is_finite, echoes, np.float32(0)))
    table = np.rint(np.where(is_finite, share, 1) * _FULL_BRIGHTNESS).astype(np.uint16)
    table[0] = 0  # no echo
    return _fixed(table)


_EVEN = _fixed(np.ones(int(_MASK) + 1, np.uint16))


def _labelled_geometry(ping: Ping, height: int) -> FanGeometry:
    """Return the geometry of a ping's fan image; raise an Error unless its labels say which bodies it shows."""
    if ping.body_id is None or ping.body_echo is None:
        raise Error("a ping must have labels to find bodies in it (got none; make it with labels=True)")
    # compiled functions take numbers of bodies as they are
    body_id, n_numbers = ping.body_id, len(ping.body_echo)
    if body_id.dtype.kind not in "iu" or body_id.shape != ping.intensity.shape:
        got = f"{body_id.dtype} of shape {body_id.shape}"
        raise Error(
            f"body_id of a ping must hold whole numbers of the shape of its intensity, {ping.intensity.shape} "
            f"(got {got})"
        )
    if body_id.size and not 0 <= int(body_id.min()) <= int(body_id.max()) < n_numbers:
        raise Error(
            f"body_id of a ping must lie in 0..{n_numbers - 1}, since its body_echo has {n_numbers} entries "
            f"(got {body_id.min()} to {body_id.max()})"
        )
    return fan_geometry(ping, height)


@lru_cache(maxsize=4)
def _extents(geometry: FanGeometry, shape: tuple[int, int], key: bytes) -> np.ndarray:
    """Return the first and last column, and row, of the pixels of each bin, (4, B, K) int16.

    Parameters are those of `nearest_cells`.
    """
    extents = np.empty((4, math.prod(shape)), np.int16)
    extents[0::2], extents[1::2] = _NO_PIXEL, -1
    _grow_extents(nearest_cells(geometry, shape, key), extents)
    return extents.reshape(4, *shape)


@compiled
def _grow_extents(cells, extents):
    """Grow the extents (4, B × K) of bins until they enclose their pixels."""
    for row in range(cells.shape[0]):
        for column in range(cells.shape[1]):
            cell = cells[row, column]
            if cell >= 0:
                extents[0, cell] = min(extents[0, cell], column)
                extents[1, cell] = max(extents[1, cell], column)
                extents[2, cell] = min(extents[2, cell], row)
                extents[3, cell] = max(extents[3, cell], row)


@compiled
def _find_runs(body_id, runs, areas):
    """Find the runs of bins of one body, and where each body lies; return the number of runs.

    body_id : (B, K) uint16
    runs : (at least as many as there are, 4) int64, filled: body, beam, first bin, end
    areas : (bodies, 4) int64, filled: first beam, number of beams, first and last bin
    """
    B, K = body_id.shape
    for body in range(areas.shape[0]):
        areas[body, 0], areas[body, 1], areas[body, 2], areas[body, 3] = B, 0, K, -1
    n = 0
    for b in range(B):
        k = 0
        while k < K:
            body, first = body_id[b, k], k
            while k < K and body_id[b, k] == body:
                k += 1
            if body == 0:
                continue
            runs[n, 0], runs[n, 1], runs[n, 2], runs[n, 3] = body, b, first, k
            n += 1
            areas[body, 0] = min(areas[body, 0], b)
            areas[body, 1] = b - areas[body, 0] + 1
            areas[body, 2], areas[body, 3] = min(areas[body, 2], first), max(areas[body, 3], k - 1)
    return n


@compiled
def _add_brightness(runs, echoes, table, areas, starts, profiles):
    """Add the brightness of each bin to the profiles of its body: first over its beams, then over its bins.

    runs, areas : of `_find_runs`
    echoes : (B, K) uint32, the bits of float32
    table : of `_brightness_table`
    starts : (bodies,) int64, where the profiles of each body begin
    profiles : zeros, added to
    """
    for n in range(runs.shape[0]):
        body, b, first, end = runs[n]
        start = starts[body]
        at = uint64(start + areas[body, 1] + first - areas[body, 2])
        total = 0
        for i in range(uint64(end - first)):
            bright = np.int64(table[(echoes[b, uint64(first) + i] >> _SHIFT) & _MASK])
            profiles[at + i] += bright
            total += bright
        profiles[start + b - areas[body, 0]] += total


@inlined
def _first_after_gap(profile, n):
    """Return the first beam after the widest gap in a full circle's profile of n beams; -1 without a gap."""
    begin, widest, gap = -1, 0, 0
    for i in range(2 * n):
        gap = gap + 1 if profile[i % n] == 0 else 0
        if gap > widest:
            widest, begin = gap, (i + 1) % n
    return begin


@inlined
def _bright_part(profile, n, begin, total):
    """Return the first and the last place, counted from `begin` on, between the faint ends of a profile.

    profile : of which n entries count, as a circle
    total : of these
    """
    low, left = 0, profile[begin]
    while left * LEFT_OUT_OF <= total:
        low += 1
        left += profile[(begin + low) % n]
    high, left = n - 1, profile[(begin + n - 1) % n]
    while left * LEFT_OUT_OF <= total:
        high -= 1
        left += profile[(begin + high) % n]
    return low, high


@compiled
def _leave_out_faint_ends(profiles, starts, full_circle, areas):
    """Shorten the areas of bodies at each end by beams, or bins, that hold next to nothing of their brightness.

    On a full circle the ends are those of the widest gap; without a gap there are none.
    """
    for body in range(areas.shape[0]):
        n_beams, n_bins = areas[body, 1], areas[body, 3] - areas[body, 2] + 1
        if n_beams == 0:
            continue
        of_beams, of_bins = profiles[starts[body] :], profiles[starts[body] + n_beams :]
        total = of_beams[:n_beams].sum()
        if total == 0:
            continue
        begin = _first_after_gap(of_beams, n_beams) if full_circle else 0
        if begin >= 0:
            low, high = _bright_part(of_beams, n_beams, begin, total)
            first = areas[body, 0] + begin + low
            areas[body, 0] = first % n_beams if full_circle else first
            areas[body, 1] = high - low + 1
        low, high = _bright_part(of_bins, n_bins, 0, total)
        areas[body, 3] = areas[body, 2] + high
        areas[body, 2] += low


@compiled
def _find_extents(runs, extents, areas, found):
    """Find, for each body, its number of bins in its area, and their first and last beam, bin, column and row.

    runs, areas : of `_areas`
    extents : (4, B, K) int16, of `_extents`
    found : (bodies, 9) int64, filled in this order. A beam behind the seam counts on from the last one
    """
    B, K = extents.shape[1:]
    for body in range(found.shape[0]):
        found[body] = 0
        found[body, 1], found[body, 3] = 2 * B, K
        found[body, 5] = found[body, 7] = _NO_PIXEL
        found[body, 2] = found[body, 4] = found[body, 6] = found[body, 8] = -1
    for n in range(runs.shape[0]):
        body, b, first, end = runs[n]
        first, end = max(first, areas[body, 2]), min(end, areas[body, 3] + 1)
        beam = b if b >= areas[body, 0] else b + B
        if beam - areas[body, 0] >= areas[body, 1] or first >= end:
            continue
        own = found[body]
        own[0] += end - first
        own[1], own[2] = min(own[1], beam), max(own[2], beam)
        own[3], own[4] = min(own[3], first), max(own[4], end - 1)
        left, right, top, bottom = np.int16(_NO_PIXEL), np.int16(-1), np.int16(_NO_PIXEL), np.int16(-1)
        for i in range(uint64(first), uint64(end)):
            left, right = min(left, extents[0, b, i]), max(right, extents[1, b, i])
            top, bottom = min(top, extents[2, b, i]), max(bottom, extents[3, b, i])
        own[5], own[6] = min(own[5], left), max(own[6], right)
        own[7], own[8] = min(own[7], top), max(own[8], bottom)


@compiled
def _draw_inside(runs, areas, out):
    """Write the numbers of bodies to their bins of `out`, (B, K), as far as these lie in the areas."""
    for n in range(runs.shape[0]):
        body, b, first, end = runs[n]
        beam = b if b >= areas[body, 0] else b + out.shape[0]
        if beam - areas[body, 0] < areas[body, 1]:
            for i in range(uint64(max(first, areas[body, 2])), uint64(min(end, areas[body, 3] + 1))):
                out[b, i] = body
