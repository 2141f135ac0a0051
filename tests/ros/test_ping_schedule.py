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
    late = steps(schedule, [300, 399, 400, 450, 701], is_ready=False)
    assert [slot[:2] for slot in late] == [(False, 1), (False, 0), (False, 1), (False, 0), (False, 3)]
    assert steps(schedule, [750])[0][:2] == (True, 0)


@pytest.mark.parametrize(
    ("busy_ms", "pinged_ms", "n_dropped"),
    [
        # the first ping takes long, as one that has to search its samples
        ([190, *[60] * 9], [0, 190, 290, 390, 490, 590, 690, 790, 890, 990], 0),
        ([1995, 60, 60], [0, 1995, 2095, 2195], 18),
        # each ping takes longer than a period: as many pings as there can be, and one of six is dropped
        ([120] * 12, [120 * k for k in range(13)], 2),
    ],
)
def test_pings_after_one_that_waited_are_no_nearer_than_a_period(busy_ms, pinged_ms, n_dropped):
    schedule, busy_until_ms, dropped, pinged = PingSchedule(10), 0, 0, []
    for time_ms in range(0, pinged_ms[-1] + 1, 5):
        (slot,) = steps(schedule, [time_ms], is_ready=time_ms >= busy_until_ms)
        dropped += slot.n_dropped
        if slot.is_due:
            busy_until_ms = time_ms + busy_ms[min(len(pinged), len(busy_ms) - 1)]
            pinged.append(time_ms)
    assert pinged == pinged_ms and dropped == n_dropped


def test_a_ping_after_a_loop_was_held_up_comes_no_sooner_than_half_a_period_later():
    slots = steps(PingSchedule(10), [0, *range(295, 501, 5)])
    pinged_ms = [5 * k + 290 for k, slot in enumerate(slots) if slot.is_due]
    assert pinged_ms == [290, 295, 345, 445]  # the first is that at 0
    assert [slot.n_dropped for slot in slots if slot.n_dropped] == [1]


@pytest.mark.parametrize("early_ms", [0, 2])
def test_a_loop_as_fast_as_the_sonar_pings_at_each_step(early_ms):
    """Its steps may be uneven."""
    times_ms = [100 * k + 3 - early_ms * (k % 2) for k in range(20)]
    slots = steps(PingSchedule(10), [0, *times_ms[1:]])
    assert all(slot.is_due and not slot.n_dropped for slot in slots)


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
