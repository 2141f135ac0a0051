"""What chooses the samples of pings, and the one of the two that has nothing to choose."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from sonar_gl.core.errors import SampleLimitError
from sonar_gl.engine.flow import DrawnPing, PingSetup, Plan, ReceivedPing, Resolution
from sonar_gl.engine.level_search import LevelSearch
from sonar_gl.engine.stage import Coverage, StageCache
from sonar_gl.sonar.sampling import Sampling


class Sampler(Protocol):
    """Chooses the samples of pings; `AdaptiveSampling` for a tolerance, `FixedSampling` where they were given.

    search : LevelSearch, which chooses those of a ping that `is_apart`; None where none is
    choice : all that checks and plans change, to be put back where a plan or a ping is broken off
    history : all that each ping changes, to be put back where a ping is broken off, or to be made again
    resolution : of the last ping, or of the first to come
    tolerance : that it keeps, or None
    is_live : the samples of pings follow those of the pings before
    """

    search: LevelSearch | None
    choice: object
    history: object
    resolution: Resolution
    tolerance: float | None
    is_live: bool

    def resolution_for(self, setup: PingSetup) -> Resolution:
        """Add a ping to the history, and return its samples."""

    def review(self, received: ReceivedPing) -> Resolution | None:
        """Return the samples to draw the ping with once more, or None if it is good."""

    def fewer_samples(self, error: SampleLimitError) -> Resolution:
        """Return fewer samples for a ping whose samples are more than fit, or raise the error again."""

    def history_with(self, setup: PingSetup) -> object:
        """Return the history with a ping to come, which has the samples of those before."""

    def is_deciding(self, history: object) -> bool:
        """Return whether the last ping of a history may change the samples of those after it, whatever it sees."""

    def has_changed(self, received: ReceivedPing) -> bool:
        """Return whether bodies came or went, or something came into view, or left, by the sum of the echo."""

    def fix(self, setups: Sequence[PingSetup]) -> Plan | None:
        """Choose samples for all of some pings, and stay with them."""

    def is_apart(self, setup: PingSetup) -> bool:
        """Return whether the samples of a ping to come are chosen from it alone."""

    def history_with_apart(self, setup: PingSetup) -> object:
        """Return the history with a ping to come whose samples are being chosen from it alone."""

    def affordable(self, drawn: DrawnPing) -> Resolution:
        """Return the resolution with which to receive a ping that was drawn: its own, unless that stalls a loop."""

    def costs_as_expected(self, coverage: Coverage) -> bool:
        """Return whether `affordable` leaves all as it is for a ping of a coverage."""

    def follow(self, setup: PingSetup, plan: Plan, total: float, coverage: Coverage, n_pings: int) -> None:
        """Have later pings follow samples that were chosen from a ping alone, by this sampler or in another thread.

        total : the sum of its echo
        n_pings : of the history that ends with it, which it becomes unless later ones are in the history already
        """

    def error_estimate(self, setup: PingSetup) -> float | None:
        """Return the estimated error of a ping."""


class FixedSampling(Sampler):
    """Samples that were given: nothing to choose, nothing promised, and no ping depends on those before.

    What it takes over from `Sampler` does nothing, and returns None.
    """

    search = tolerance = choice = history = None
    is_live = False

    def __init__(self, stages: StageCache, sampling: Sampling):
        self.resolution = Resolution(stages.stage(sampling))

    def resolution_for(self, setup: PingSetup) -> Resolution:
        """Return the samples."""
        return self.resolution

    def fewer_samples(self, error: SampleLimitError) -> Resolution:
        """Raise the error."""
        raise error

    def affordable(self, drawn: DrawnPing) -> Resolution:
        """Return the ping's own."""
        return drawn.resolution

    def costs_as_expected(self, coverage: Coverage) -> bool:
        """Return True."""
        return True
