"""The terms of acoustics and noise: how each is switched, what it changes in the image of a scene, what it costs."""

from __future__ import annotations

import time
from collections.abc import Callable, Container, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from itertools import count
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from sonar_gl.acoustics.acoustics import Acoustics
from sonar_gl.acoustics.water import Water
from sonar_gl.core.checks import check_kind, count_axes, is_position_and_quaternion
from sonar_gl.core.errors import Error
from sonar_gl.core.poses import check_pose
from sonar_gl.core.warn import collected_warnings
from sonar_gl.engine.level_search import evenly_picked
from sonar_gl.engine.no_echo import NoEchoWarning
from sonar_gl.engine.request import several_poses
from sonar_gl.noise.noise import add_noise, mean_intensity
from sonar_gl.noise.settings import Noise
from sonar_gl.ping import Ping
from sonar_gl.scene.scene import Scene
from sonar_gl.simulator import Simulator
from sonar_gl.sonar.counts import Counts
from sonar_gl.sonar.sampling import ToleranceWarning, check_tolerance
from sonar_gl.sonar.sonar import Sonar

MAX_POSES = 5  # of a sequence, at which terms are judged
TURNS = 7  # pings of which a time is the median
SEED = 0  # of the noise: the same with and without a term, where images are compared
# Where noise is timed, a sonar moves ahead by STEP_M from ping to ping, and in each turn begins TURN_M further ahead:
# seven are a cell of place-locked speckle, which costs more near its ends
STEP_M, TURN_M = 0.04, 0.5 / 7
CHANGED_DB = 3.0  # a bin that changes by more has another tone: 13 counts of 255 in a window of 60 dB


# ---- the terms and their switches --------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Term:
    """One term, and how to switch it."""

    name: str  # as in reports
    is_on: Callable[[Acoustics, Noise], bool]  # function (acoustics, noise) -> whether it is on
    # on, off: fields that switch it on, and off
    on: dict
    off: dict
    # of_noise, of_water: True if these are fields of Noise or of Water; else they are of Acoustics
    of_noise: bool = False
    of_water: bool = False
    # function Scene -> False if the scene has nothing that the term could act on
    acts_in: Callable[[Scene], bool] = lambda scene: True
    # function (acoustics, sonar) -> False if the term does not act in such water or with such a sonar
    acts_with: Callable[[Acoustics, Sonar], bool] = lambda acoustics, sonar: True

    def changed(self, acoustics: Acoustics, noise: Noise, values: dict) -> tuple[Acoustics, Noise]:
        """Return both with other values of the term's fields."""
        if self.of_noise:
            return acoustics, replace(noise, **values)
        if self.of_water:
            return replace(acoustics, water=replace(acoustics.water, **values)), noise
        return replace(acoustics, **values), noise


def _of_acoustics(name: str, field: str, on=True, off=False, **acts) -> Term:
    """Return a term that a field of Acoustics switches by two values; `acts` : fields `acts_in` and `acts_with`."""
    return Term(
        name, lambda acoustics, _: getattr(acoustics, field) != off, {field: on}, {field: off}, **acts
    )


SPECKLE = Term(
    "speckle",
    is_on=lambda acoustics, noise: noise.speckle,
    on={"speckle": True, "follow_motion": Noise.physical().follow_motion},
    off={"speckle": False, "looks": 1, "follow_motion": False},
    of_noise=True,
)
# all are on in the profile "physical" and in `Noise.physical`, but multipath, which no profile has
TERMS = (
    # without absorption the TVG remains as it is, so one that assumes the right absorption assumes none
    Term(
        "absorption",
        is_on=lambda acoustics, noise: acoustics.water.absorption_db_m != 0,
        on={"absorption_db_m": None},
        off={"absorption_db_m": 0.0},
        of_water=True,
    ),
    _of_acoustics("azimuth pattern", "beam_pattern", "line_array", "box"),
    _of_acoustics(
        "conical beams",
        "conical_beams",
        acts_with=lambda acoustics, sonar: replace(acoustics, conical_beams=True).has_cones(sonar),
    ),
    _of_acoustics("far side lobes", "far_side_lobes"),
    _of_acoustics(
        "transmit beam",
        "transmit_beam",
        acts_with=lambda acoustics, sonar: sonar.transmit_width_deg is not None,
    ),
    _of_acoustics("elevation pattern", "elevation_pattern", "line_array", "box"),
    _of_acoustics("pulse", "pulse"),
    _of_acoustics(
        "specular lobes", "specular", acts_in=lambda scene: any(body.specular for body in scene.bodies)
    ),
    _of_acoustics("bubbles", "bubbles", acts_in=lambda scene: bool(scene.plumes)),
    _of_acoustics("multipath", "multipath", "incoherent", "none"),
    _of_acoustics(
        "volume reverberation",
        "volume_reverberation",
        acts_with=lambda acoustics, sonar: acoustics.water.volume_backscatter_db is not None,
    ),
    _of_acoustics(
        "surface reverberation",
        "surface_reverberation",
        acts_in=lambda scene: scene.surface_z_m is not None,
        acts_with=lambda acoustics, sonar: acoustics.water.wind_speed_m_s is not None,
    ),
    _of_acoustics(
        "cross-talk", "cross_talk", acts_with=lambda acoustics, sonar: sonar.cross_talk_db is not None
    ),
    SPECKLE,
    Term(
        "receiver noise",
        is_on=lambda acoustics, noise: noise.has_receiver_noise,
        on={"self_noise": True},
        off={"self_noise": False, "thermal_noise": False, "ambient_db": None},
        of_noise=True,
    ),
)


@dataclass(frozen=True, eq=False)
class StatedTerm:
    """A term that acts only where the sonar or the noise states it, and has no switch but its field."""

    name: str  # as in reports
    is_stated: Callable[[Noise, Sonar], bool]  # function (noise, sonar) -> whether it acts
    off: dict  # fields that switch it off
    of_noise: bool = False  # True if these are fields of Noise; else they are of Sonar

    def without(self, noise: Noise, sonar: Sonar) -> tuple[Noise, Sonar]:
        return (replace(noise, **self.off), sonar) if self.of_noise else (noise, replace(sonar, **self.off))


DROPPED_BEAMS = StatedTerm(
    "dropped beams",
    is_stated=lambda noise, sonar: noise.dropped_beams > 0,
    off={"dropped_beams": 0.0},
    of_noise=True,
)
STATED_TERMS = (
    StatedTerm(
        "ring-down",
        is_stated=lambda noise, sonar: noise.self_noise and sonar.ring_down_db is not None,
        off={"ring_down_db": None},
    ),
    StatedTerm(
        "centre streak",
        is_stated=lambda noise, sonar: noise.self_noise and sonar.common_noise_db is not None,
        off={"common_noise_db": None},
    ),
    DROPPED_BEAMS,
)


def everything_on(acoustics: Acoustics, noise: Noise) -> tuple[Acoustics, Noise]:
    """Return both with every term on; a term that is on stays as it is."""
    for term in TERMS:
        if not term.is_on(acoustics, noise):
            acoustics, noise = term.changed(acoustics, noise, term.on)
    return acoustics, noise


def without(acoustics: Acoustics, noise: Noise, terms: Iterable[Term]) -> tuple[Acoustics, Noise]:
    for term in terms:
        acoustics, noise = term.changed(acoustics, noise, term.off)
    return acoustics, noise


# ---- what they change and cost -----------------------------------------------------------------------


@dataclass(frozen=True)
class Price:
    """What a term changes in the image, and what it costs."""

    name: str  # of the term
    changes: float  # Σ|with − without| / Σ with, over beams and bins, a share; the largest over the poses
    worst_bin: float  # the largest |with − without| of a bin over the strongest bin of the image; likewise
    # share of the displayed bins, 0..1, that change by more than 3 dB, see `changed_bins`; likewise
    changed_bins: float
    # what it adds to the time of a ping, milliseconds; 0 if it changes nothing, or adds less than times vary
    time_ms: float
    on: bool  # whether it is needed to keep the tolerance


def differs(full, reduced) -> tuple[float, float]:
    """Return Σ|with − without| / Σ with, and the largest |with − without| over the strongest bin; 0 of no echo.

    full, reduced : (B, K) intensities with a term and without it

    >>> differs(np.array([[4.0, 1.0]]), np.array([[3.0, 2.0]]))
    (0.4, 0.25)
    """
    e, t = np.asarray(full, np.float64), np.asarray(reduced, np.float64)
    if e.sum() <= 0:
        return 0.0, 0.0
    difference = np.abs(e - t)
    return float(difference.sum() / e.sum()), float(difference.max() / e.max())


def changed_bins(full, reduced, counts: Counts) -> float:
    """Return the share of the displayed bins, 0..1, that change by more than 3 dB; 0 if no bin is displayed.

    A bin is displayed if the device shows it brighter than black, see `Counts.least_shown`, in either image, each with
    the gain that the image has.

    full, reduced : (B, K) intensities with a term and without it
    counts : of the device

    The first bin stays, the second loses 6 dB, the third is black in both:

    >>> changed_bins(np.array([[1.0, 0.4, 1e-9]]), np.array([[1.0, 0.1, 1e-7]]), Counts(low_db=-60))
    0.5
    """
    images = [np.asarray(image, np.float32) for image in (full, reduced)]
    shown = np.logical_or(*(image >= counts.least_shown(image) for image in images))
    weaker, stronger = np.minimum(*images), np.maximum(*images)
    changed = shown & (stronger > np.float32(10 ** (CHANGED_DB / 10)) * weaker)
    return float(changed.sum() / max(shown.sum(), 1))


def without_beams(image, share: float) -> np.ndarray:
    """Return an image, (B, K), in which a share of the beams, one at least, is 0: beams that lie evenly apart.

    >>> without_beams(np.ones((6, 1)), 0.3)[:, 0].tolist()
    [1.0, 0.0, 1.0, 1.0, 0.0, 1.0]
    """
    out, n_dropped = np.array(image), max(1, round(share * len(image)))
    out[((np.arange(n_dropped) + 0.5) * len(out) / n_dropped).astype(int)] = 0.0
    return out


class _Change(NamedTuple):
    """What some terms change in the image; see `Price`."""

    changes: float
    worst_bin: float
    changed_bins: float

    @property
    def most(self) -> float:
        """The larger of the two shares that the tolerance bounds."""
        return max(self.changes, self.changed_bins)


@dataclass(frozen=True, eq=False)
class _Case:
    """What terms are judged by."""

    scene: Scene | Simulator  # or a Simulator whose world is shared
    sonar: Sonar
    # acoustics, noise: Acoustics and Noise with every term on
    acoustics: Acoustics
    noise: Noise
    poses: list[np.ndarray]  # (4, 4) world_from_sonar, MAX_POSES at most
    tolerance: float  # how much the image may change


def _make_case(scene, sonar, tolerance, poses, acoustics, noise=None) -> _Case:
    """Check the arguments of `price` and `needed_acoustics`; return the case that they describe."""
    check_tolerance(tolerance)
    check_kind("scene", scene, Scene | Simulator, "sonar_gl.load_scene makes one from a name or a file")
    check_kind("sonar", sonar, Sonar, "sonar_gl.load_sonar makes one from a name or a file")
    if poses is None:
        described = scene.scene if isinstance(scene, Simulator) else scene
        if described.sonar_pose is None:
            raise Error(f"scene {described.name!r} has no sonar in it; give a pose")
        poses = [described.sonar_pose]
    elif not isinstance(several_poses(poses), Sequence | np.ndarray):
        poses = list(poses)
    if not len(poses):
        raise Error("poses must hold at least one pose (got none)")
    acoustics, noise = everything_on(acoustics or Acoustics.physical(), noise or Noise.physical())
    picked = [check_pose(pose) for pose in evenly_picked(poses, MAX_POSES)]
    return _Case(scene, sonar, acoustics, noise, picked, tolerance)


def _ahead(ping: Ping, way_m: float) -> Ping:
    """Return the ping as if it were of a sonar further ahead."""
    pose = np.array(ping.pose)
    pose[:3, 3] += way_m * pose[:3, 0]
    return replace(ping, pose=pose)


class _Comparison:
    """Pings of a case with every term on and without some of them, all with the same samples.

    They are those that the tolerance takes with every term on: coarser ones would leave out planar reflectors that few
    of them meet, and find multipath weaker than it is.

    stack : closes the simulators
    case : _Case
    before_ping : function called before the samples are planned, and before each ping; what it raises ends the work
    """

    def __init__(self, stack: ExitStack, case: _Case, before_ping: Callable[[], None] = lambda: None):
        self._stack, self._case, self._simulators, self._pings = stack, case, {}, {}
        self._before_ping = before_ping
        before_ping()
        self.planner = stack.enter_context(
            Simulator(case.scene, case.sonar, case.acoustics, tolerance=case.tolerance)
        )
        self.planner.plan(case.poses)

    def judge(self, stated: Iterable[StatedTerm] = ()) -> dict[Term | StatedTerm, Price]:
        """Return the price of each term of TERMS, and of stated ones, with a time of 0.

        The terms that change least are switched off first, as long as the image without all of them stays
        within the tolerance: in its echo and in its displayed bins. Stated ones come last, so that the others are
        judged alike with any sonar.
        """
        scene, tolerance = self.planner.scene, self._case.tolerance
        device = self._case.acoustics, self._case.sonar
        acting = [term for term in TERMS if term.acts_in(scene) and term.acts_with(*device)]
        changes = {term: self._change([term]) if term in acting else _Change(0, 0, 0) for term in TERMS}
        off = [term for term in TERMS if changes[term].most == 0]
        for term in sorted(TERMS, key=lambda term: changes[term].most):
            if term in off:
                continue
            if changes[term].most > tolerance or self._change([*off, term]).most > tolerance:
                break
            off.append(term)
        changes |= {term: self._change([term]) for term in stated}
        for term in sorted(stated, key=lambda term: changes[term].most):
            if changes[term].most == 0 or self._change([*off, term]).most <= tolerance:
                off.append(term)
        return {term: Price(term.name, *change, 0.0, term not in off) for term, change in changes.items()}

    def added_times_ms(self, terms: list[Term | StatedTerm]) -> dict[str, float]:
        """Return what each term adds to the time of a ping with its noise, milliseconds, by name.

        Pings with and without the terms take turns, so that a change of the machine's load affects all alike. Noise is
        that of a sonar that moves by STEP_M from ping to ping. Each has a seed of its own, since noise that another has
        made is kept.
        """
        case, seeds = self._case, count(SEED + 1)
        variants = {term: self._settings([term]) for term in terms}
        variants[None] = self._settings(())
        times_s = {variant: [] for variant in variants}
        for turn in range(TURNS):
            pose = case.poses[turn % len(case.poses)]
            for variant, (acoustics, noise, sonar) in variants.items():
                simulator = self._simulator(acoustics)
                self._before_ping()
                simulator.ping(pose)  # not timed: the other simulators left the caches cold
                start = time.perf_counter()
                ping = replace(simulator.ping(pose), sonar=sonar)
                pinged_s, seed = time.perf_counter() - start, next(seeds)
                before, moved = (_ahead(ping, turn * TURN_M + way_m) for way_m in (0, STEP_M))
                add_noise(before, noise, seed)  # not timed: a ping has much of the noise of the one before
                start = time.perf_counter()
                add_noise(moved, noise, seed)
                times_s[variant].append((pinged_s, time.perf_counter() - start))
        out = {}
        for term in terms:
            added_ms = 1e3 * np.subtract(times_s[None], times_s[term])
            # noise costs less than the time of a ping varies, and does not change that time
            of_noise = term.of_noise or isinstance(term, StatedTerm)
            added = float(np.median(added_ms[:, 1] if of_noise else added_ms.sum(1)))
            out[term.name] = max(added, 0.0)  # a cost below 0 is the variation of the times
        return out

    def _simulator(self, acoustics: Acoustics) -> Simulator:
        """Return a simulator with these samples. The tolerance decides which planar reflectors it includes."""
        if acoustics not in self._simulators:
            self._simulators[acoustics] = self._stack.enter_context(
                Simulator(
                    self.planner, self._case.sonar, acoustics, self.planner.sampling, self._case.tolerance
                )
            )
        return self._simulators[acoustics]

    def _pings_with(self, acoustics: Acoustics) -> list[Ping]:
        """Return a ping from each pose, without noise."""
        if acoustics not in self._pings:
            simulator, pings = self._simulator(acoustics), []
            for pose in self._case.poses:
                self._before_ping()
                pings.append(simulator.ping(pose))
            self._pings[acoustics] = pings
        return self._pings[acoustics]

    def _settings(self, terms: Iterable[Term | StatedTerm]) -> tuple[Acoustics, Noise, Sonar]:
        """Return the settings without these terms."""
        stated = [term for term in terms if isinstance(term, StatedTerm)]
        others = [term for term in terms if not isinstance(term, StatedTerm)]
        (acoustics, noise), sonar = without(self._case.acoustics, self._case.noise, others), self._case.sonar
        for term in stated:
            noise, sonar = term.without(noise, sonar)
        return acoustics, noise, sonar

    def _mean_images(self, terms: Iterable[Term | StatedTerm]) -> list[np.ndarray]:
        """Return the (B, K) mean of many pings without these terms, from each pose, without dropped beams."""
        acoustics, noise, sonar = self._settings(terms)
        return [mean_intensity(replace(ping, sonar=sonar), noise) for ping in self._pings_with(acoustics)]

    def _change(self, terms: list[Term | StatedTerm]) -> _Change:
        """Return how the image without these terms differs; each measure is the largest over the poses."""
        full, reduced = self._mean_images(()), self._mean_images(terms)
        if SPECKLE in terms:  # a single ping against the mean; no tolerance leaves speckle out
            noise = replace(self._case.noise, dropped_beams=0.0)
            full = [add_noise(ping, noise, SEED).intensity for ping in self._pings_with(self._case.acoustics)]
        if DROPPED_BEAMS in terms:  # a single ping, too
            full = [without_beams(image, self._case.noise.dropped_beams) for image in full]
        pairs, counts = list(zip(full, reduced, strict=True)), self._case.sonar.counts
        found = [_Change(*differs(*pair), changed_bins(*pair, counts)) for pair in pairs]
        return _Change(*np.max(found, axis=0).tolist())


@contextmanager
def _without_warnings_of_pings() -> Iterator[None]:
    """Show no warning of pings: they are for callers that make some, and without a term there may be no echo."""
    with collected_warnings(ToleranceWarning), collected_warnings(NoEchoWarning):
        yield


def price(
    scene: Scene | Simulator,
    sonar: Sonar,
    tolerance: float = 0.01,
    poses=None,
    acoustics: Acoustics | None = None,
    noise: Noise | None = None,
    before_ping: Callable[[], None] = lambda: None,
    timed: Container[str] | None = None,
) -> list[Price]:
    """Measure what each term changes in the image of a scene, and what it costs.

    Parameters
    ----------
    scene : Scene, or a Simulator whose world is shared
    sonar : Sonar
    tolerance : 0.001..0.5, how much the image may change, in its echo and in its displayed bins; changes are measured
        with the samples that it takes
    poses : several (4, 4) world_from_sonar, of which five at most are used; None = the scene's own
    acoustics, noise : settings of the terms that are on; None is `Acoustics.physical()` and `Noise.physical()`.
        Terms that are off in them are measured as a line array in elevation, a pulse as short as the bins,
        incoherent multipath
    before_ping : function called before the samples are planned, and before each ping; what it raises ends the work,
        and is passed on
    timed : names of the terms whose times are measured, which takes most of the time; None = all. Others have 0

    Returns
    -------
    list of Price, one per term, in the order of TERMS, then of those STATED_TERMS that sonar and noise state. Images
    are means of many pings, to which noise adds its mean power; for speckle and dropped beams, one ping is compared
    with that mean

    Raises
    ------
    Error
        if there is no pose, or an argument is wrong.
    """
    case = _make_case(scene, sonar, tolerance, poses, acoustics, noise)
    with ExitStack() as stack, _without_warnings_of_pings():
        comparison = _Comparison(stack, case, before_ping)
        prices = comparison.judge([term for term in STATED_TERMS if term.is_stated(case.noise, case.sonar)])
        acting = [term for term, found in prices.items() if found.changes > 0 or found.changed_bins > 0]
        times_ms = comparison.added_times_ms([term for term in acting if timed is None or term.name in timed])
    return [replace(found, time_ms=times_ms.get(found.name, 0.0)) for found in prices.values()]


def needed_acoustics(
    scene: Scene | Simulator,
    sonar: Sonar,
    tolerance: float = 0.01,
    pose: ArrayLike | Sequence[ArrayLike] | None = None,
    water: Water | None = None,
) -> Acoustics:
    """Return `Acoustics.physical` with only those terms on that a scene needs.

    The terms that are left out change the image by no more than the tolerance, all together, in two measures: the
    share of the echo that differs, and the share of the displayed bins that change by more than 3 dB. Images have the
    mean power of the noise of `Noise.physical`, so that what lies far below it is left out. The same arguments give the
    same terms, whatever the times of pings.

    Parameters
    ----------
    scene, sonar : Scene, or a Simulator of it, and Sonar
    tolerance : 0.001..0.5, the share of the echo that may differ from that with every term on, and the share of the
        displayed bins that may change by more than 3 dB, see `changed_bins`
    pose : (4, 4) world_from_sonar, or several of a sequence, of which five at most are used; None = the scene's
    water : Water; None is `Water()`

    Raises
    ------
    Error
        if there is no pose, or an argument is wrong.
    """
    acoustics = Acoustics.physical() if water is None else Acoustics.physical().in_water(water)
    poses = [pose] if count_axes(pose) == 2 or is_position_and_quaternion(pose) else pose
    case = _make_case(scene, sonar, tolerance, poses, acoustics)
    with ExitStack() as stack, _without_warnings_of_pings():
        prices = _Comparison(stack, case).judge()
    off = [term for term, found in prices.items() if not found.on and not term.of_noise]
    return without(case.acoustics, case.noise, off)[0]
