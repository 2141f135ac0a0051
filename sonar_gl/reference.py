"""The slow truth: the same integral by stratified Embree rays, sharing no code with reduce."""

from __future__ import annotations

import threading
import warnings
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from itertools import pairwise

import numpy as np

from sonar_gl._version import __version__
from sonar_gl.acoustics import Acoustics
from sonar_gl.noise import check_seed
from sonar_gl.pulse import smear
from sonar_gl.rays import Target, hear, land, shoot
from sonar_gl.scene import Scene, check_pose, without_bubbles
from sonar_gl.sonar import Sonar
from sonar_gl.types import Error, Ping, check_kind

NEAR_M = 1e-3  # what is nearer is seen through, as in the fast ping
AGREEMENT = 10  # the two seeds must differ so many times less than the error that is to be judged
WORST_BODY = 5  # a body's own echo may err so many times more than the whole
HEARD = 1e-3  # of the whole echo: bodies that return less are not looked at by themselves
FIRST_RAYS = 2**19  # of a seed, before they are compared for the first time
BATCH = 2**13  # rays and their hits fit the cache
NODES_PER_WIDTH = 64  # a smooth pattern is drawn by straight lines: off by 2e-4 of its peak at most
WIDEST_DEG = 16.0  # what counts as a beam's width there, for patterns of wide beams end in a step


def reference_ping(
    scene: Scene,
    sonar: Sonar,
    pose,
    acoustics: Acoustics | None = None,
    error: float = 0.01,
    max_rays: int = 400_000_000,
    seed: int = 0,
) -> Ping:
    """A ping by ray casting, for judging the fast one: slow, and as exact as is asked for.

    Parameters
    ----------
    scene, sonar, acoustics : as for `Simulator`; pose : (4, 4) world_from_sonar
    error : 1e-4..0.5, the error that is to be judged. Rays are added until two independent halves of them
        differ by no more than a tenth of it, and by half of it in the echo of any body by itself
    max_rays : 1e6 or more, where adding ends in any case
    seed : of the rays; the same seed gives the same bytes

    Returns
    -------
    Ping
        the mean of the two halves, with `body_echo`; meta's `difference` is how far the halves A and B are
        apart, Σ|A − B| over Σ(A + B)/2, `body_difference` the same of the worst body that returns more than a
        thousandth of the echo, `n_rays` what it took, `converged` whether that is near enough.

    Raises
    ------
    Error
        if an argument is of the wrong kind or out of bounds, ghosts or bubbles would be heard, or Embree is
        missing.

    Warns
    -----
    UserWarning
        if max_rays were too few.
    """
    acoustics = _check(scene, sonar, acoustics, error, max_rays)
    check_known(acoustics)
    pose, seed = check_pose(pose), check_seed(seed)
    meta = {
        "sonar": asdict(sonar),
        "acoustics": acoustics.meta(),
        "absorption_db_m": acoustics.absorption(sonar.frequency_hz),
        "sound_speed_m_s": acoustics.sound_speed(),
        "profile": acoustics.profile,
        "bin_size_m": sonar.bin_size_m,
        "scene": scene.name,
        "bodies": [body.name for body in scene.bodies],
        "seed": seed,
        "version": __version__,
    }
    target = Target(without_bubbles(scene, acoustics), pose, acoustics.specular)
    fan = _Fan(sonar, acoustics)
    halves = [_Half(target, fan, key) for key in np.random.SeedSequence(seed).spawn(2)]
    blocks = len(fan.blocks)
    most = max(1, int(max_rays) // (2 * blocks))
    per_block, difference, bodies = min(most, max(1, FIRST_RAYS // blocks)), 0.0, 0.0
    stop = threading.Event()
    with ThreadPoolExecutor(2) as pool:
        try:
            while scene.bodies:
                list(pool.map(lambda half, n=per_block: half.refine(n, stop), halves))
                a, b = (half.sums * fan.gain for half in halves)
                whole = (a.sum() + b.sum()) / 2
                difference = float(np.abs(a - b).sum() / whole) if whole > 0 else 0.0
                bodies = _bodies_differ(*(half.bodies for half in halves))
                excess = max(difference, bodies / WORST_BODY) * AGREEMENT / error
                if excess <= 1 or per_block >= most:
                    break
                # the difference falls about as n^-0.75; at most twice, that the first guesses do not run away
                growth = excess ** (4 / 3)
                per_block = min(int(per_block * np.clip(growth, 1.25, 2)) + 1, most)
        finally:
            stop.set()  # a user who interrupts need not wait for the rays under way
    meta["n_rays"] = 2 * blocks * per_block if scene.bodies else 0
    meta["difference"], meta["body_difference"] = difference, bodies
    meta["converged"] = max(difference, bodies / WORST_BODY) <= error / AGREEMENT
    if difference > error / AGREEMENT:
        warnings.warn(
            f"the reference can judge errors above {AGREEMENT * difference:.2g} only, not {error:g}: after "
            f"{meta['n_rays']} rays its halves still differ by {difference:.2g} (ask for more max_rays)",
            stacklevel=2,
        )
    scale = fan.solid_angle / (2 * per_block * blocks)
    intensity = ((halves[0].sums + halves[1].sums) * (fan.gain * scale)).astype(np.float32)
    if (weights := acoustics.pulse_weights(sonar)) is not None:
        intensity = smear(intensity, weights)
    body_echo = (halves[0].bodies + halves[1].bodies) * scale
    for array in (intensity, body_echo):
        array.setflags(write=False)
    return Ping(intensity, sonar.azimuth_rad, sonar.range_m, pose=pose, meta=meta, body_echo=body_echo)


def _check(scene, sonar, acoustics, error, max_rays) -> Acoustics:
    """The acoustics; or an Error about the first argument that makes no sense."""
    acoustics = Acoustics.physical() if acoustics is None else acoustics
    for name, value, kind, cure in (
        ("scene", scene, Scene, "sonar_gl.load_scene makes one from a name or a file"),
        ("sonar", sonar, Sonar, "sonar_gl.load_sonar makes one from a name or a file"),
        ("acoustics", acoustics, Acoustics, "such as sonar_gl.Acoustics.physical()"),
    ):
        check_kind(name, value, kind, cure)
    for name, value, low, high in (("error", error, 1e-4, 0.5), ("max_rays", max_rays, 1e6, 2**33)):
        if isinstance(value, bool) or not isinstance(value, (int, float, np.number)):
            raise Error(f"{name} of a reference must be a number (got {value!r})")
        if not low <= value <= high:  # NaN too
            raise Error(f"{name} of a reference must lie in {low:g}..{high:g} (got {value:g})")
    return acoustics


def check_known(acoustics: Acoustics) -> None:
    """Refuse what the reference knows nothing of."""
    if acoustics.multipath != "none":
        got = acoustics.multipath
        raise Error(f"the reference knows no ghosts (got multipath {got!r}; give multipath=none)")


def _bodies_differ(a, b) -> float:
    """The largest relative difference of a body's echo in the two halves."""
    both = (a + b) / 2
    heard = both > HEARD * both.sum()
    return float((np.abs(a - b)[heard] / both[heard]).max(initial=0.0))


class _Fan:
    """Azimuths that are looked at, cut into 2^k blocks, and what each beam hears of each block."""

    def __init__(self, sonar: Sonar, acoustics: Acoustics):
        axes, pattern = sonar.azimuth_rad, acoustics.beam_pattern_function(sonar)
        reach = acoustics.beam_reach_rad(sonar)
        self.start, stop = axes[0] - reach, axes[-1] + reach
        if stop - self.start >= 2 * np.pi:
            self.start, stop = -np.pi, np.pi
        self.span, self.hat = stop - self.start, pattern is not None
        drawn, self.elevation = acoustics.drawn_sonar(sonar), acoustics.elevation_function(sonar)
        self.transmit = acoustics.transmit_function(sonar)
        self.top = np.sin(np.radians(drawn.elevation_fov_deg) / 2)
        self.solid_angle = self.span * 2 * self.top
        self.bins = (drawn.range_min_m, 1 / drawn.bin_size_m)
        self.gain, self.shape = acoustics.gain(sonar.range_m, sonar), (sonar.n_beams, sonar.n_bins)
        if self.hat:
            step = np.radians(min(sonar.beam_width_deg, WIDEST_DEG)) / NODES_PER_WIDTH
            self.nodes = np.linspace(self.start, stop, int(np.ceil(self.span / step)) + 1)
            offset = reach * ((np.arange(1024) + 0.5) / 512 - 1)
            heard = pattern(axes[:, None] + offset, axes[:, None]).mean(axis=1)
        else:  # between two nodes no box begins or ends
            ends = _turn(np.concatenate([axes - reach, axes + reach]), self.start)
            self.nodes = np.unique(np.clip(np.append(ends, [self.start, stop]), self.start, stop))
            heard = 1.0
        height = 2 * self.top
        if self.elevation is not None:
            height *= self.elevation(self.top * ((np.arange(1024) + 0.5) / 512 - 1)).mean()
        beam_solid_angle = heard * 2 * reach * height
        self.log2_blocks = int(np.clip(np.ceil(np.log2(len(self.nodes) / 8)), 3, 10))
        edges = np.linspace(self.start, stop, 2**self.log2_blocks + 1)
        self.blocks = []
        for low, high in pairwise(edges):
            first = max(np.searchsorted(self.nodes, low, side="right") - 1, 0)
            last = min(np.searchsorted(self.nodes, high, side="left") + 1, len(self.nodes))
            nodes = self.nodes[first:last]
            places = nodes if self.hat else np.append(nodes[:-1] + nodes[1:], 2 * nodes[-1]) / 2
            offset = _turn(places - axes[:, None], -np.pi)
            weights = (np.abs(offset) <= reach * (1 + 1e-9)).astype(float)
            beams = np.flatnonzero(weights.any(axis=1))
            weights, offset = weights[beams], offset[beams]
            if self.hat:
                weights *= pattern(axes[beams, None] + offset, axes[beams, None])
            weights /= np.broadcast_to(beam_solid_angle, len(axes))[beams, None]
            self.blocks.append((nodes, beams, weights))


def _turn(azimuth_rad, first_rad):
    """The same directions within a turn from `first_rad` on."""
    return (azimuth_rad - first_rad) % (2 * np.pi) + first_rad


class _Half:
    """One of the two independent estimates."""

    def __init__(self, target: Target, fan: _Fan, seeds: np.random.SeedSequence):
        self.target, self.fan, self.keys = target, fan, seeds.generate_state(4, np.uint32)
        self.sums, self.bodies, self.done = np.zeros(fan.shape), np.zeros(target.n_bodies + 1), 0
        self.room, self.even = (np.empty(BATCH), *np.empty((2, BATCH, 3), np.float32)), np.ones(BATCH)
        azimuth = [self._shoot(number, 0, 1)[0][0] for number in range(len(fan.blocks))]
        self.numbers = np.argsort(azimuth)  # of the blocks, in the sequence

    def refine(self, per_block: int, stop: threading.Event):
        """Add rays until there are so many in each block."""
        fan = self.fan
        for number, (nodes, beams, weights) in zip(self.numbers, fan.blocks, strict=True):
            if stop.is_set():
                return
            sums, heard = np.zeros((len(nodes), fan.shape[1])), weights.sum(axis=0)
            for first in range(self.done, per_block, BATCH):
                azimuth, origin, ray = self._shoot(number, first, min(BATCH, per_block - first))
                hits = self.target.hits(origin, ray)
                at = (self.target.faces, self.target.lobes, nodes, fan.hat, heard, fan.bins, fan.gain)
                land(azimuth, ray, NEAR_M, hits, self._strength(azimuth, ray), *at, sums, self.bodies)
            hear(sums, beams, weights, self.sums)
        self.done = per_block

    def _strength(self, azimuth, ray):
        """How strongly each ray is sounded and heard: the projector in azimuth, both ways in elevation."""
        fan, strength = self.fan, self.even[: len(azimuth)]
        if fan.transmit is not None:
            strength = strength * fan.transmit(azimuth)
        if fan.elevation is not None:
            strength = strength * fan.elevation(ray[:, 2])
        return strength

    def _shoot(self, number: int, first: int, count: int):
        """Azimuth, origin and direction of so many rays, valid until the next call."""
        fan, rays = self.fan, tuple(array[:count] for array in self.room)
        place = (number, fan.log2_blocks, self.keys, fan.start, fan.span, fan.top)
        shoot(first, *place, NEAR_M, *rays)
        return rays
