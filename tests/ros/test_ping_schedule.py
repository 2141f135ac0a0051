"""When a sonar pings inside a loop."""

import math

import pytest

from sonar_gl.ros.ping_schedule import BACK_NS, JUMP_NS, PingSchedule

MILLISECOND = 10**6


def steps(schedule, times_ms, **more):
    return [schedule.advance(round(time_ms * MILLISECOND), **more) for time_ms in times_ms]


@pytest.mark.parametrize("rate_hz", [15, 7.3, 40])
def test_a_fast_loop_pings_at_the_first_step_at_or_after_each_time_without_drift(rate_hz):
    slots = steps(PingSchedule(rate_hz), range(20_001))
    pinged_ms = [time_ms for time_ms, slot in enumerate(slots) if slot.is_due]
    # 1e-9: a time that is a whole number of milliseconds is not late by rounding
    assert pinged_ms == [math.ceil(k * 1000 / rate_hz - 1e-9) for k in range(math.floor(20 * rate_hz) + 1)]
    assert not any(slot.n_dropped or slot.has_jumped for slot in slots)


def test_a_slow_loop_pings_at_each_step_and_counts_what_it_missed():
    slots = steps(PingSchedule(10), [5000, 5350, 5400, 5799, 6000])
    assert [slot.is_due for slot in slots] == [True, True, True, True, True]
    # of the eleven pings up to 1000 ms after the start, numbers 1, 2, 5, 6, 8 and 9 have no step of their own
    assert [slot.n_dropped for slot in slots] == [0, 2, 0, 2, 2]


def test_a_ping_that_cannot_be_made_waits_and_is_dropped_when_the_next_is_due():
    schedule = PingSchedule(10)
    assert steps(schedule, [0])[0].is_due
    assert not any(slot.is_due or slot.n_dropped for slot in steps(schedule, [100, 150, 180], is_ready=False))
    assert steps(schedule, [190])[0][:2] == (True, 0)  # late by less than a period
    assert steps(schedule, [200])[0][:2] == (True, 0)
    late = steps(schedule, [300, 399, 400, 450, 701], is_ready=False)
    assert [slot[:2] for slot in late] == [(False, 0), (False, 0), (False, 1), (False, 0), (False, 3)]
    assert steps(schedule, [750])[0][:2] == (True, 0)


def test_a_jump_of_time_begins_anew():
    schedule = PingSchedule(10)
    steps(schedule, range(0, 1001, 50))
    assert steps(schedule, [0, 50, 100]) == [(True, 0, True), (False, 0, False), (True, 0, False)]
    ahead_ms = 100 + JUMP_NS / MILLISECOND
    assert steps(schedule, [ahead_ms])[0] == (True, 99, False)  # as far as a loop may be held up
    assert steps(schedule, [2 * ahead_ms + 1])[0] == (True, 0, True)


def test_a_bag_that_is_shorter_than_a_period_and_begins_again_is_a_jump():
    schedule = PingSchedule(0.1)
    assert steps(schedule, [500, 2500]) == [(True, 0, False), (False, 0, False)]
    assert steps(schedule, [500, 2500]) == [(True, 0, True), (False, 0, False)]
    assert steps(schedule, [2500 - BACK_NS / MILLISECOND]) == [(False, 0, False)]  # as messages may come late


def test_times_that_overtake_each_other_are_no_jump():
    schedule = PingSchedule(10)
    slots = steps(schedule, [1000, 1090, 1080, 1100, 1095, 1110, 1001, 1199, 1200])
    assert [slot.is_due for slot in slots] == [True, False, False, True, False, False, False, False, True]
    assert not any(slot.has_jumped or slot.n_dropped for slot in slots)
