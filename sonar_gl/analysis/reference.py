"""The reference: the same integral by stratified ray casting in Embree. It shares no code with `beamform`, which it
judges.
"""

from __future__ import annotations

import threading
import warnings
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from sonar_gl._version import __version__
from sonar_gl.acoustics.acoustics import Acoustics
from sonar_gl.acoustics.cross_talk import leak_between_beams
from sonar_gl.acoustics.pulse import matched_filter
from sonar_gl.analysis.rays import (
    Aperture,
    Bins,
    Nodes,
    Rays,
    RayScene,
    add_echoes,
    form_beams,
    generate_rays,
)
from sonar_gl.core.checks import check_kind, check_number, check_whole_number
from sonar_gl.core.errors import Error
from sonar_gl.core.poses import check_pose
from sonar_gl.ping import Ping
from sonar_gl.scene.scene import Scene
from sonar_gl.sonar.fan import NEAR_M
from sonar_gl.sonar.sampling import WORST_BODY
from sonar_gl.sonar.sector import MAX_AZIMUTH_RAD, MAX_CONE_RAD
from sonar_gl.sonar.sonar import Sonar

AGREEMENT = 10  # the difference of the two halves is this many times smaller than the error that they judge
MIN_BODY_SHARE = 1e-3  # of the total echo: the error of a body that returns less is not judged by itself
MAX_RAYS = 400_000_000
FIRST_RAYS = 2**19  # of each half, before the halves are compared for the first time
BATCH = 2**13  # rays at once: they and their hits fit the processor's cache
NODES_PER_WIDTH = 64  # linear interpolation of a smooth pattern is then off by 2e-4 of its peak at most
PLACES = 1024  # at which the pattern in elevation is evaluated, where its main lobe is not low
WIDEST_DEG = 16.0  # limits the distance of nodes for wide beams, whose patterns end in a step


def reference_ping(
    scene: Scene,
    sonar: Sonar,
    pose: ArrayLike,
    acoustics: Acoustics | None = None,
    error: float = 0.01,
    max_rays: int = MAX_RAYS,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> Ping:
    """Return a ping by ray casting, to judge those of `Simulator`: slow, and as exact as requested.

    Parameters
    ----------
    scene, sonar, acoustics : as for `Simulator`
    pose : (4, 4) world_from_sonar
    error : 1e-4..0.5, the error that is to be judged. Rays are added until two independent halves of them
        differ by no more than a tenth of it, and by half of it in the echo of any single body
    max_rays : 1e6 or more, the limit on the number of rays
    seed : seed of the rays; the same seed gives the same bytes
    progress : called as rays are cast, by one thread at a time, with how many are cast and how many are expected

    Returns
    -------
    Ping
        the mean of the two halves, with `body_echo`. In its meta, `difference` is the difference of the halves
        A and B, Σ|A − B| over Σ(A + B)/2; `body_difference` is that of the worst body among those that return
        more than a thousandth of the echo; `n_rays` is the number of rays; `converged` says whether both
        differences are small enough

    Raises
    ------
    Error
        if an argument is of the wrong kind or out of bounds, if the acoustics include multipath, volume
        reverberation, bubbles or the backscatter of the water's surface, which the reference does not model, or
        if Embree is missing.

    Warns
    -----
    UserWarning
        if max_rays were too few.
    """
    acoustics = Acoustics.physical() if acoustics is None else acoustics
    check_kind("scene", scene, Scene, "sonar_gl.load_scene makes one from a name or a file")
    check_kind("sonar", sonar, Sonar, "sonar_gl.load_sonar makes one from a name or a file")
    check_kind("acoustics", acoustics, Acoustics, "such as sonar_gl.Acoustics.physical()")
    check_number("error of a reference", error, 1e-4, 0.5)
    check_number("max_rays of a reference", max_rays, 1e6, 2**33)
    check_known(acoustics)
    _check_contents(scene, acoustics)
    pose, seed = check_pose(pose), check_whole_number("seed", seed)
    ray_scene = RayScene(scene, sonar.head_pose(pose), acoustics.specular)
    fan = _make_fan(sonar, acoustics)
    report = _Progress(progress or (lambda cast, expected: None))
    halves = [_Half(ray_scene, fan, key, report) for key in np.random.SeedSequence(seed).spawn(2)]
    found = _refine(halves, fan, error, max_rays) if scene.bodies else _Convergence(0, 0.0, 0.0)
    if found.difference > error / AGREEMENT:
        warnings.warn(
            f"the reference can judge errors above {AGREEMENT * found.difference:.2g} only, not {error:g}: after "
            f"{found.n_rays} rays its halves still differ by {found.difference:.2g} (give more max_rays)",
            stacklevel=2,
        )
    meta = {
        "sonar": sonar.meta(),
        "acoustics": acoustics.meta(),
        "absorption_db_m": acoustics.water.absorption(sonar.frequency_hz),
        "sound_speed_m_s": acoustics.water.sound_speed(),
        "profile": acoustics.profile,
        "bin_size_m": sonar.bin_size_m,
        "scene": scene.name,
        "bodies": [body.name for body in scene.bodies],
        "seed": seed,
        "version": __version__,
        "n_rays": found.n_rays,
        "difference": found.difference,
        "body_difference": found.body_difference,
        "converged": found.worst <= error / AGREEMENT,
    }
    ray_sr = fan.solid_angle_sr / max(found.n_rays, 1)
    intensity = ((halves[0].beam_sums + halves[1].beam_sums) * (fan.bins.gain * ray_sr)).astype(np.float32)
    if (weights := acoustics.pulse_weights(sonar)) is not None:
        intensity = matched_filter(intensity, weights)
    if acoustics.cross_talk and sonar.cross_talk_db is not None:
        intensity = leak_between_beams(intensity, sonar.cross_talk_db, sonar.cross_talk_beams)
    body_echo = (halves[0].body_sums + halves[1].body_sums) * (ray_sr * acoustics.pulse_level(sonar))
    for array in (intensity, body_echo):
        array.setflags(write=False)
    return Ping(
        intensity,
        sonar.azimuth_rad,
        sonar.range_m,
        pose=pose,
        meta=meta,
        body_echo=body_echo,
        sonar=sonar,
        acoustics=acoustics,
    )


class _Progress:
    """Counts the rays of both halves, and has a function (rays cast, rays expected) report them."""

    def __init__(self, report: Callable[[int, int], None]):
        self.expected = 0  # rays of both halves until they agree, as estimated so far
        self._cast, self._report, self._lock = 0, report, threading.Lock()

    def add(self, n_rays: int) -> None:
        """Count more rays; may be called by both threads."""
        with self._lock:
            self._cast += n_rays
            self._report(self._cast, max(self._cast, self.expected))


def check_known(acoustics: Acoustics) -> None:
    """Raise an Error if the acoustics include what the reference does not model: multipath, scatterers in the water."""
    if acoustics.multipath != "none":
        got = acoustics.multipath
        raise Error(f"the reference does not model multipath (got multipath {got!r}; give multipath=none)")
    if acoustics.volume_backscatter_db is not None:
        raise Error(
            "the reference does not model volume reverberation (got volume_backscatter_db = "
            f"{acoustics.volume_backscatter_db:g}; give volume_reverberation=False)"
        )


def _check_contents(scene: Scene, acoustics: Acoustics) -> None:
    """Raise an Error if the acoustics include bubbles, which rays do not meet, or a surface that scatters."""
    if scene.plumes and acoustics.bubbles:
        raise Error(
            f"the reference does not model bubbles (got {scene.plumes[0].name!r} in the scene; leave them out of "
            "both pings by acoustics with bubbles=False)"
        )
    wind_speed_m_s = acoustics.water.wind_speed_m_s
    if scene.surface_z_m is not None and acoustics.surface_reverberation and wind_speed_m_s is not None:
        raise Error(
            "the reference does not model the backscatter of the water's surface (got wind_speed_m_s = "
            f"{wind_speed_m_s:g}; give surface_reverberation=False)"
        )


@dataclass(frozen=True)
class _Convergence:
    """How far the two halves A and B differ after `n_rays` rays."""

    n_rays: int  # of both halves together
    difference: float  # Σ|A − B| over Σ(A + B)/2, over beams and bins
    body_difference: float  # the largest |A − B| over (A + B)/2 of the echo of a body

    @property
    def worst(self) -> float:
        """The difference that binds: a body's own echo may be off by WORST_BODY times as much."""
        return max(self.difference, self.body_difference / WORST_BODY)


def _refine(halves: list[_Half], fan: _Fan, error: float, max_rays: int) -> _Convergence:
    """Add rays to both halves, each in a thread of its own, until they agree or there are max_rays."""
    n_blocks = len(fan.blocks)
    most = max(1, int(max_rays) // (2 * n_blocks))
    per_block = min(most, max(1, FIRST_RAYS // n_blocks))
    stop, progress = threading.Event(), halves[0].progress
    progress.expected = 2 * n_blocks * per_block
    with ThreadPoolExecutor(2) as pool:
        try:
            while True:
                list(pool.map(lambda half, n=per_block: half.refine(n, stop), halves))
                found = _Convergence(2 * n_blocks * per_block, *_differences(halves, fan))
                excess = found.worst * AGREEMENT / error
                if excess <= 1 or per_block >= most:
                    return found
                # The difference falls about as n^-0.75. The first estimates of it are poor, so n at most doubles.
                growth = excess ** (4 / 3)
                progress.expected = 2 * n_blocks * min(int(per_block * growth), most)
                per_block = min(int(per_block * np.clip(growth, 1.25, 2)) + 1, most)
        finally:
            stop.set()  # on an interrupt the threads need not finish their rays


def _differences(halves: list[_Half], fan: _Fan) -> tuple[float, float]:
    """Return `difference` and `body_difference` of `_Convergence`."""
    a, b = (half.beam_sums * fan.bins.gain for half in halves)
    mean = (a.sum() + b.sum()) / 2
    difference = float(np.abs(a - b).sum() / mean) if mean > 0 else 0.0
    a, b = (half.body_sums for half in halves)
    mean = (a + b) / 2
    counts = mean > MIN_BODY_SHARE * mean.sum()
    return difference, float((np.abs(a - b)[counts] / mean[counts]).max(initial=0.0))


@dataclass(frozen=True, eq=False)
class _Block:
    """One of the 2^k intervals of azimuth that have equally many rays."""

    nodes: Nodes  # N of them
    beams: np.ndarray  # (b,) int64 indices of the beams that receive echoes from the block
    weights: np.ndarray  # (b, N) float64 weight of an echo at each node in each of these beams, per steradian


@dataclass(frozen=True, eq=False)
class _Fan:
    """What rays need of a sonar with B beams and K bins."""

    aperture: Aperture
    bins: Bins
    blocks: tuple[_Block, ...]  # 2^log2_blocks of _Block, by rising azimuth
    log2_blocks: int
    n_beams: int  # B
    # beam pattern of the transmitter, function of azimuths, radians; None if it is even
    transmit: Callable | None
    # two-way beam pattern in elevation, function of sines of elevation; None if it is even
    elevation: Callable | None

    @property
    def solid_angle_sr(self) -> float:
        return self.aperture.span_rad * 2 * self.aperture.max_sine


@dataclass(frozen=True, eq=False)
class _Receiver:
    """In which directions B beams receive, and how much."""

    axes_rad: np.ndarray  # (B,) azimuths of the beams
    pattern: Callable | None  # function (azimuth_rad, steer_rad) -> receive power pattern; None for boxes
    support_rad: float  # how far from its axis a beam receives
    all_lobes: bool  # beams receive from further away, too: all between start_rad and stop_rad
    # start_rad, stop_rad: azimuths between which any beam receives
    start_rad: float
    stop_rad: float

    def node_azimuths(self, beam_width_deg: float) -> np.ndarray:
        """Return the azimuths at which echoes are summed, (N,) rising from `start_rad` to `stop_rad`."""
        start, stop = self.start_rad, self.stop_rad
        if self.pattern is None:  # no box beam begins or ends between two nodes
            ends = _wrap(
                np.concatenate([self.axes_rad - self.support_rad, self.axes_rad + self.support_rad]), start
            )
            return np.unique(np.clip(np.append(ends, [start, stop]), start, stop))
        step = np.radians(min(beam_width_deg, WIDEST_DEG)) / NODES_PER_WIDTH
        return np.linspace(start, stop, int(np.ceil((stop - start) / step)) + 1)

    def mean_pattern(self, node_azimuths: np.ndarray) -> np.ndarray | float:
        """Return the integral of the pattern of each beam over azimuth, over the width of its support, (B,)."""
        if self.pattern is None:
            return 1.0
        steer = self.axes_rad[:, None]
        if not self.all_lobes:
            return self.pattern(steer + self.support_rad * _middles(1024), steer).mean(axis=1)
        # of all azimuths from which rays come, by the trapezoidal rule
        parts = np.diff(node_azimuths, prepend=self.start_rad, append=self.stop_rad)
        power = self.pattern(node_azimuths, steer) @ ((parts[:-1] + parts[1:]) / 2)
        return power / (2 * self.support_rad)

    def block(
        self, node_azimuths: np.ndarray, beam_sr: np.ndarray, low_rad: float, high_rad: float
    ) -> _Block:
        """Return the block of the rays between two azimuths; beam_sr : (B,) solid angle of each beam."""
        first = max(np.searchsorted(node_azimuths, low_rad, side="right") - 1, 0)
        last = min(np.searchsorted(node_azimuths, high_rad, side="left") + 1, len(node_azimuths))
        nodes = places = node_azimuths[first:last]
        if self.pattern is None:  # a node stands for the interval up to the next one
            places = np.append(nodes[:-1] + nodes[1:], 2 * nodes[-1]) / 2
        offset = _wrap(places - self.axes_rad[:, None], -np.pi)
        weights = (self.all_lobes | (np.abs(offset) <= self.support_rad * (1 + 1e-9))).astype(float)
        beams = np.flatnonzero(weights.any(axis=1))
        weights, offset, steer = weights[beams], offset[beams], self.axes_rad[beams, None]
        if self.pattern is not None:
            weights *= self.pattern(steer + offset, steer)
        weights /= beam_sr[beams, None]
        return _Block(Nodes(nodes, self.pattern is not None, weights.sum(axis=0)), beams, weights)


def _make_receiver(sonar: Sonar, acoustics: Acoustics) -> _Receiver:
    """Return how the beams of a sonar receive."""
    axes, support_rad = sonar.azimuth_rad, acoustics.receive_support_rad(sonar)
    # a support of 90 degrees is all that is in front of an array, of a beam that is not steered
    is_all = support_rad >= np.pi / 2 and sonar.steered == "alike"
    all_lobes = acoustics.far_pattern(sonar) is not None and not is_all
    start, stop = axes[0] - support_rad, axes[-1] + support_rad
    if stop - start >= 2 * np.pi:
        start, stop = -np.pi, np.pi
    if acoustics.has_cones(sonar):
        start, stop = max(start, -MAX_CONE_RAD), min(stop, MAX_CONE_RAD)
    return _Receiver(axes, acoustics.receive_pattern(sonar), support_rad, all_lobes, start, stop)


def _make_fan(sonar: Sonar, acoustics: Acoustics) -> _Fan:
    """Return the fan, with the beam patterns evaluated at its nodes."""
    receiver, true_range_sonar = _make_receiver(sonar, acoustics), acoustics.true_range_sonar(sonar)
    start, stop = receiver.start_rad, receiver.stop_rad
    aperture = Aperture(
        start_rad=start,
        span_rad=stop - start,
        max_sine=np.sin(np.radians(acoustics.max_elevation_deg(sonar))),
        are_cones=acoustics.has_cones(sonar),
        max_tan=np.tan(MAX_AZIMUTH_RAD),
    )
    elevation = acoustics.two_way_elevation_pattern(sonar)
    # places within the pattern in elevation: more where its main lobe is a small part of all that is received
    n_places = PLACES * int(np.ceil(1 / min(true_range_sonar.elevation_fov_deg, 1.0)))
    nodes = receiver.node_azimuths(sonar.beam_width_deg)
    beam_sr = _solid_angles(receiver, nodes, aperture, elevation, n_places)
    log2_blocks = int(np.clip(np.ceil(np.log2(len(nodes) / 8)), 3, 10))
    ends = np.linspace(start, stop, 2**log2_blocks + 1)
    return _Fan(
        aperture=aperture,
        bins=Bins(
            true_range_sonar.range_min_m,
            1 / true_range_sonar.bin_size_m,
            acoustics.range_gain(sonar.range_m, sonar),
        ),
        blocks=tuple(receiver.block(nodes, beam_sr, *each) for each in pairwise(ends)),
        log2_blocks=log2_blocks,
        n_beams=sonar.n_beams,
        transmit=acoustics.transmit_pattern(sonar),
        elevation=elevation,
    )


def _middles(n: int) -> np.ndarray:
    """Return the middles of n equal parts of -1..1, (n,)."""
    return (np.arange(n) + 0.5) / (n / 2) - 1


def _solid_angles(
    receiver: _Receiver, node_azimuths: np.ndarray, aperture: Aperture, elevation, n_places: int
) -> np.ndarray:
    """Return the solid angle of each beam over its patterns, (B,).

    n_places : within the pattern in elevation, which is that of `_Fan`
    """
    if aperture.are_cones:
        return _solid_angles_of_cones(receiver, node_azimuths, aperture, elevation, n_places)
    height = 2 * aperture.max_sine
    if elevation is not None:
        height *= elevation(aperture.max_sine * _middles(n_places)).mean()
    mean_pattern = receiver.mean_pattern(node_azimuths)
    return np.broadcast_to(mean_pattern * 2 * receiver.support_rad * height, len(receiver.axes_rad))


def _solid_angles_of_cones(
    receiver: _Receiver, shown_rad: np.ndarray, aperture: Aperture, elevation, n_places: int
) -> np.ndarray:
    """Return the solid angle of each beam that receives along cones, over its patterns, (B,).

    shown_rad : (N,) azimuths at which cones are shown, rising
    n_places : as of `_solid_angles`, around a cone
    """
    above = np.arcsin(np.minimum(aperture.max_sine / np.cos(shown_rad), 1))
    ends = np.minimum(above, np.arccos(np.abs(np.tan(shown_rad)) / aperture.max_tan))
    power = 1.0
    if elevation is not None:
        parts = np.array_split(np.arange(len(ends)), n_places // PLACES)  # in the memory of PLACES
        sines = (
            np.cos(shown_rad[part])[:, None] * np.sin(ends[part][:, None] * _middles(n_places))
            for part in parts
        )
        power = np.concatenate([elevation(one).mean(axis=1) for one in sines])
    per_rad, steer = 2 * ends * np.cos(shown_rad) * power, receiver.axes_rad[:, None]
    received = receiver.pattern(shown_rad, steer) * per_rad
    if not receiver.all_lobes:
        received = np.where(np.abs(shown_rad - steer) <= receiver.support_rad, received, 0)
    parts = np.diff(shown_rad, prepend=shown_rad[0], append=shown_rad[-1])
    return received @ ((parts[:-1] + parts[1:]) / 2)


def _wrap(azimuth_rad, first_rad):
    """Return the same directions within one turn from `first_rad` on."""
    return (azimuth_rad - first_rad) % (2 * np.pi) + first_rad


class _Half:
    """One of the two independent estimates."""

    def __init__(self, scene: RayScene, fan: _Fan, seeds: np.random.SeedSequence, progress: _Progress):
        self.progress = progress
        self.beam_sums = np.zeros((fan.n_beams, len(fan.bins.gain)))  # echo of the rays so far, without gain
        self.body_sums = np.zeros(scene.n_bodies + 1)  # by number of the body, with gain
        self._scene, self._fan, self._keys = scene, fan, seeds.generate_state(4, np.uint32)
        self._rays = Rays(np.empty(BATCH), *np.empty((2, BATCH, 3), np.float32), NEAR_M, np.empty(BATCH))
        self._done = 0  # rays of each block
        first_azimuth = [self._generate(block, 0, 1).azimuth_rad[0] for block in range(len(fan.blocks))]
        self._numbers = np.argsort(first_azimuth)  # of the blocks in the sequence

    def refine(self, per_block: int, stop: threading.Event) -> None:
        """Add rays until each block has `per_block`, or `stop` is set."""
        fan = self._fan
        for number, block in zip(self._numbers, fan.blocks, strict=True):
            if stop.is_set():
                return
            node_sums = np.zeros((len(block.nodes.azimuth_rad), len(fan.bins.gain)))
            for first in range(self._done, per_block, BATCH):
                rays = self._generate(number, first, min(BATCH, per_block - first))
                hits, weights = self._scene.hits(rays), self._weights(rays)
                surfaces = self._scene.surfaces
                add_echoes(rays, hits, weights, surfaces, block.nodes, fan.bins, node_sums, self.body_sums)
            form_beams(node_sums, block.beams, block.weights, self.beam_sums)
            self.progress.add(per_block - self._done)
        self._done = per_block

    def _weights(self, rays: Rays) -> np.ndarray:
        """Return each ray's share of solid angle times its transmit and two-way elevation pattern."""
        fan, weights = self._fan, rays.share
        if fan.transmit is not None:
            weights = weights * fan.transmit(rays.azimuth_rad)
        if fan.elevation is not None:
            weights = weights * fan.elevation(rays.direction[:, 2])
        return weights

    def _generate(self, block: int, first: int, count: int) -> Rays:
        """Return `count` rays of a block from index `first` on, valid until the next call."""
        azimuth, origin, direction, start_m, share = self._rays
        rays = Rays(azimuth[:count], origin[:count], direction[:count], start_m, share[:count])
        generate_rays(rays, first, block, self._fan.log2_blocks, self._keys, self._fan.aperture)
        return rays
