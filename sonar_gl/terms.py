"""What each term of acoustics and noise is worth in a scene: how the image would change without it, its cost.

Each term is left out by itself, of everything on, with the samples of everything on: so the difference is the
term's and not that of samples.
"""

from __future__ import annotations

import time
import warnings
from contextlib import ExitStack
from dataclasses import dataclass

import numpy as np

from sonar_gl.acoustics import Acoustics
from sonar_gl.noise import Noise, add_noise
from sonar_gl.plan import check_tolerance
from sonar_gl.scene import Scene, check_pose
from sonar_gl.sequence import several
from sonar_gl.simulator import Simulator
from sonar_gl.sonar import Sonar
from sonar_gl.switches import SPECKLE, TERMS, everything_on, without
from sonar_gl.types import Error, check_kind

POSES = 5  # of a sequence are tried
PROBE, COARSEST = 5.0, 0.05  # a probe's tolerance: times the one that is asked for, and no finer than this
TURNS = 7  # of timing
UNMET = "tolerance .* cannot be met"  # which is for those to tell who make the pings
SEED = 0  # of the noise: the same with a term and without it


@dataclass(frozen=True)
class Price:
    """What a term is worth.

    Attributes
    ----------
    name : of the term
    changes : Σ|with − without| / Σ with, over beams and bins; of several poses the largest
    worst_bin : the largest |with − without| of a bin, over the strongest bin of the image, likewise
    time_ms : what it adds to a ping, milliseconds; 0 where it changes nothing
    on : whether it is needed to keep the tolerance
    """

    name: str
    changes: float
    worst_bin: float
    time_ms: float
    on: bool


def differs(whole, other) -> tuple[float, float]:
    """Σ|with − without| / Σ with, and the largest |with − without| over the strongest bin; 0 of nothing.

    Parameters
    ----------
    whole, other : intensities of the same shape, with a term and without it

    >>> differs(np.array([[4.0, 1.0]]), np.array([[3.0, 2.0]]))
    (0.4, 0.25)
    """
    e, t = np.asarray(whole, np.float64), np.asarray(other, np.float64)
    if e.sum() <= 0:
        return 0.0, 0.0
    apart = np.abs(e - t)
    return float(apart.sum() / e.sum()), float(apart.max() / e.max())


class _Probe:
    """Simulators of one world, with the samples that everything on asks for, and pings of them.

    Parameters
    ----------
    first : Simulator of everything on, which has planned
    noise : Noise of everything on
    """

    def __init__(self, stack: ExitStack, first: Simulator, noise: Noise, poses, tolerance: float):
        self.stack, self.first, self.noise, self.poses = stack, first, noise, poses
        self.tolerance, self.simulators, self.pings = tolerance, {}, {}

    def simulator(self, acoustics: Acoustics) -> Simulator:
        """One with these samples; mirrors count by the tolerance that is asked for."""
        if acoustics not in self.simulators:
            made = self.first, self.first.sonar, acoustics, self.first.sampling, self.tolerance
            self.simulators[acoustics] = self.stack.enter_context(Simulator(*made))
        return self.simulators[acoustics]

    def pings_of(self, acoustics: Acoustics) -> list:
        """A ping from each pose, without noise."""
        if acoustics not in self.pings:
            simulator = self.simulator(acoustics)
            self.pings[acoustics] = [simulator.ping(pose) for pose in self.poses]
        return self.pings[acoustics]

    def means(self, terms) -> list:
        """(B, K) mean of many pings from each pose, without these terms: echo and noise, through the TVG."""
        acoustics, noise = without(self.first.acoustics, self.noise, terms)
        sonar = self.first.sonar
        levels = [10 ** (db / 10) for db in (noise.electronic_db, noise.ambient_db) if db is not None]
        heard = sum(levels) * acoustics.tvg(sonar.range_m, sonar)
        return [ping.intensity + heard for ping in self.pings_of(acoustics)]

    def change(self, terms) -> tuple[float, float]:
        """What the image changes without these terms: the whole, and a bin; the largest of all poses."""
        if SPECKLE in terms:  # alone: no tolerance leaves it out
            whole = [add_noise(p, self.noise, SEED).intensity for p in self.pings_of(self.first.acoustics)]
            less = self.means(terms)
        else:
            whole, less = self.means(()), self.means(terms)
        shares, bins = zip(*map(differs, whole, less), strict=True)
        return max(shares), max(bins)

    def time(self, terms) -> list[float]:
        """Of each term what it adds to a ping with its noise, ms; all are pinged in turns."""
        ways = {term: without(self.first.acoustics, self.noise, [term]) for term in terms}
        ways[None] = self.first.acoustics, self.noise
        took = {way: [] for way in ways}
        for turn in range(TURNS):
            pose = self.poses[turn % len(self.poses)]
            for way, (acoustics, noise) in ways.items():
                simulator = self.simulator(acoustics)
                simulator.ping(pose)  # untimed: what was pinged before it leaves cold caches
                start = time.perf_counter()
                ping = simulator.ping(pose)
                drawn = time.perf_counter()
                add_noise(ping, noise, SEED)
                # what noise costs drowns in how a ping's time varies, and noise does not change that
                took[way].append((drawn - start, time.perf_counter() - drawn))
        more_ms = {term: 1e3 * np.subtract(took[None], took[term]) for term in terms}
        return [float(np.median(ms[:, 1] if term.of_noise else ms.sum(1))) for term, ms in more_ms.items()]


def _probe(stack: ExitStack, scene, sonar, acoustics, noise, poses, tolerance: float, of: float) -> _Probe:
    """One with the samples that a tolerance asks for, everything on; mirrors count by `of`."""
    first = stack.enter_context(Simulator(scene, sonar, acoustics, tolerance=tolerance))
    first.plan(poses)
    return _Probe(stack, first, noise, poses, of)


def _judge(probe: _Probe, tolerance: float) -> dict:
    """Of each term its change, the worst bin, and whether it is on.

    Those that change least are left out first, as long as the image without all of them stays within the
    tolerance.
    """
    scene = probe.first.scene
    nothing = {
        "lobes": not any(body.specular for body in scene.bodies),
        "bubbles": not scene.plumes,
    }
    changes = {term: (0.0, 0.0) if nothing.get(term.name) else probe.change([term]) for term in TERMS}
    dropped = [term for term in TERMS if changes[term][0] == 0]
    for term in sorted(TERMS, key=lambda term: changes[term][0]):
        if term in dropped:
            continue
        if changes[term][0] > tolerance or probe.change([*dropped, term])[0] > tolerance:
            break
        dropped.append(term)
    return {term: (*change, term not in dropped) for term, change in changes.items()}


def _prepared(scene, sonar, tolerance, poses, acoustics, noise):
    """What `price` and `needed` were given, everything on, and a few of the poses."""
    check_tolerance(tolerance)
    check_kind("scene", scene, Scene | Simulator, "sonar_gl.load_scene makes one from a name or a file")
    check_kind("sonar", sonar, Sonar, "sonar_gl.load_sonar makes one from a name or a file")
    poses = poses if poses is None or hasattr(poses, "__len__") else list(several(poses))
    if poses is None:
        placed = scene.scene if isinstance(scene, Simulator) else scene
        if placed.sonar_pose is None:
            raise Error(f"scene {placed.name!r} has no sonar in it; give a pose")
        poses = [placed.sonar_pose]
    if not len(poses):
        raise Error("poses must hold at least one pose (got none)")
    picked = np.unique(np.linspace(0, len(poses) - 1, POSES).round().astype(int))
    both = everything_on(acoustics or Acoustics.physical(), noise or Noise.physical(), sonar)
    return *both, [check_pose(poses[k]) for k in picked]


def price(
    scene: Scene | Simulator,
    sonar: Sonar,
    tolerance: float = 0.01,
    poses=None,
    acoustics: Acoustics | None = None,
    noise: Noise | None = None,
) -> list[Price]:
    """What each term changes in the image of this scene, and what it costs.

    Parameters
    ----------
    scene : Scene, or a Simulator whose world is shared
    sonar : Sonar
    tolerance : 0.001..0.5, how much the image may change; changes are found with samples of five times it
    poses : several (4, 4) world_from_sonar, of which five at most are tried; None = the scene's own
    acoustics, noise : how a term is where it is on; None is `Acoustics.physical()` and `Noise.physical()`.
        What they have off is a line array in elevation, a pulse as short as the bins, incoherent multipath

    Returns
    -------
    list of Price, one a term, in the order of TERMS. Images are means of many pings, in which noise is its
    mean power; with speckle there is one ping against that mean

    Raises
    ------
    Error
        if there is no pose, or an argument makes no sense.
    """
    acoustics, noise, poses = _prepared(scene, sonar, tolerance, poses, acoustics, noise)
    with ExitStack() as stack, warnings.catch_warnings():
        warnings.filterwarnings("ignore", UNMET)
        about = stack, scene, sonar, acoustics, noise, poses
        coarse = _probe(*about, _coarse(tolerance), tolerance)
        judged = _judge(coarse, tolerance)
        fine = _probe(stack, coarse.first, *about[2:], tolerance, tolerance)
        timed = [term for term, (changes, *_) in judged.items() if changes > 0]
        times_ms = dict(zip(timed, fine.time(timed), strict=True))
    return [
        Price(term.name, changes, worst_bin, times_ms.get(term, 0.0), on)
        for term, (changes, worst_bin, on) in judged.items()
    ]


def _coarse(tolerance: float) -> float:
    return min(max(PROBE * tolerance, COARSEST), 0.5)


def needed(scene, sonar, tolerance: float = 0.01, pose=None) -> Acoustics:
    """See `Acoustics.needed`."""
    poses = [pose] if pose is not None and np.ndim(pose) == 2 else pose
    acoustics, noise, poses = _prepared(scene, sonar, tolerance, poses, None, None)
    with ExitStack() as stack, warnings.catch_warnings():
        warnings.filterwarnings("ignore", UNMET)
        probe = _probe(stack, scene, sonar, acoustics, noise, poses, _coarse(tolerance), tolerance)
        judged = _judge(probe, tolerance)
    off = [term for term, (*_, on) in judged.items() if not on and not term.of_noise]
    return without(acoustics, noise, off)[0]
