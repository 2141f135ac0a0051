"""When a sonar pings inside a loop that runs faster, or at times falls behind."""

from __future__ import annotations

from typing import NamedTuple

# a longer step ahead is a jump of time, as when a bag begins; a shorter one is a loop that was held up
JUMP_NS = 10 * 10**9
# a longer step back is one, as when a short bag begins again; a shorter one may be messages that overtake each other
BACK_NS = 10**9


class Slot(NamedTuple):
    """What a schedule says of one step of the loop."""

    is_due: bool  # whether to ping now
    # number of earlier pings that are left out from this step on: there was no step for them, or they waited until the
    # next one was due
    n_dropped: int = 0
    has_jumped: bool = False  # whether time jumped, so that the schedule began anew


class PingSchedule:
    """The times at which a sonar pings: the first step that it sees, and from then on evenly.

    A ping is made in the first step at or after its time. If another one's time has come by then, it is dropped, so
    that nothing piles up, and the times that follow do not drift. After a ping that had to wait until it could be made
    the next one follows a period later, and after any ping half a period later at the soonest.

    rate_hz : pings per second, of the time of the steps

    >>> schedule = PingSchedule(10.0)
    >>> [schedule.advance(time_ns)[:2] for time_ns in (0, 50_000_000, 110_000_000, 450_000_000)]
    [(True, 0), (False, 0), (True, 0), (True, 2)]
    """

    def __init__(self, rate_hz: float):
        self._period_ns = 1e9 / rate_hz
        self._start_ns = self._seen_ns = self._last_ns = None
        self._number = 0  # of the next ping since the start
        self._earliest_ns = 0.0  # of the next ping, after the start

    def advance(self, time_ns: int, is_ready: bool = True) -> Slot:
        """Return what to do at a time.

        Steps that go back by up to BACK_NS, and no more than a period before the last ping, wait until their time
        comes again. Larger ones, and those that go ahead by more than JUMP_NS, are a jump: the simulation was reset,
        or a bag began again. The sonar then pings at once, and nothing counts as dropped.

        time_ns : nanoseconds
        is_ready : whether a ping can be made; if not, one that is due waits for the next step
        """
        has_jumped = self._start_ns is not None and self._is_jump(time_ns)
        if self._start_ns is None or has_jumped:
            self._start_ns = self._last_ns = self._seen_ns = time_ns
            self._number, self._earliest_ns = 0, 0.0
        elapsed_ns, before_ns = time_ns - self._start_ns, self._seen_ns - self._start_ns
        self._seen_ns = time_ns
        number = max(self._number, int((elapsed_ns + 0.5) // self._period_ns))
        # counted at once, not when the next ping begins: there may be none, at the end or before a jump
        n_dropped, self._number = number - self._number, number
        due_ns = max(number * self._period_ns, self._earliest_ns)
        if not is_ready or elapsed_ns + 0.5 < due_ns:
            return Slot(False, n_dropped, has_jumped)
        has_waited = due_ns <= before_ns  # it was not made in the step before
        begun_ns = elapsed_ns if has_waited else due_ns
        self._earliest_ns = max(begun_ns + self._period_ns, elapsed_ns + self._period_ns / 2)
        self._number, self._last_ns = number + 1, time_ns
        return Slot(True, n_dropped, has_jumped)

    def _is_jump(self, time_ns: int) -> bool:
        ahead_ns = time_ns - self._seen_ns
        return ahead_ns > JUMP_NS or ahead_ns < -BACK_NS or time_ns < self._last_ns - self._period_ns
