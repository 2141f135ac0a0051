"""Many pings at once: the same as one after the other, in order, and nothing is left behind."""

import threading
import tracemalloc
import warnings
from itertools import count, islice

import numpy as np
import pytest
import trimesh

import sonar_gl as sg
from sonar_gl import sequence

SONAR = sg.Sonar("test", 900e3, 64, 200, 60.0, 20.0, 1.5, 0.5, 20.0)
SAMPLING = sg.Sampling(2, 40)
BALL = trimesh.creation.icosphere(3, 0.5)
BODIES = (
    sg.Body("wall", trimesh.creation.box((1, 40, 40)), sg.pose(14), 0.3),
    sg.Body("box", trimesh.creation.box((1, 1, 1)), sg.pose(6, 2), 0.8),
    sg.Body("ball", BALL, sg.pose(8, -1), 0.6, np.asarray(BALL.vertices, np.float32) * 2),
)
POSES = [sg.pose(0.1 * k, 0.05 * k, 0, 0, 0.01 * k, 0.02 * k) for k in range(11)]
MOVED = [
    None if k % 3 == 0 else {"box": sg.pose(6, 2 - 0.3 * k), "ball": None if k % 2 else sg.pose(9, 0.1 * k)}
    for k in range(11)
]


def simulator(sampling=SAMPLING, bodies=BODIES, **kw):
    return sg.Simulator(sg.Scene(bodies), SONAR, sg.Acoustics.ideal(), sampling, **kw)


@pytest.fixture
def it():
    with simulator() as one:
        yield one


def check_same(one, other, to_the_bit=False):
    """Equal in all that a ping holds; to rounding where it was drawn at another place of a larger picture."""
    check = np.testing.assert_array_equal
    for name in ("azimuth_rad", "range_m", "pose"):
        check(getattr(one, name), getattr(other, name))
    assert one.meta == other.meta
    assert one.error_estimate == other.error_estimate
    if to_the_bit:
        check(one.intensity, other.intensity)
    # float32 pixels count from elsewhere: 1/x changes by 1e-7, of which slopes are differences
    strongest = other.intensity.max(initial=0)
    np.testing.assert_allclose(one.intensity, other.intensity, atol=5e-5 * strongest)
    assert (one.body_id is None) == (other.body_id is None)
    if one.body_id is not None:
        assert (one.body_id != other.body_id).sum() <= 2  # where two bodies share a bin evenly
        same = one.body_id == other.body_id
        np.testing.assert_allclose(one.elevation_rad[same], other.elevation_rad[same], atol=5e-4)
        np.testing.assert_allclose(one.body_echo, other.body_echo, rtol=1e-4, atol=1e-6)


def check_like(intensity, other):
    """Two intensities of one ping, to the same rounding."""
    np.testing.assert_allclose(intensity, other, atol=5e-5 * other.max())


@pytest.mark.parametrize("labels", [False, True])
@pytest.mark.parametrize("n", [1, 3, 4, 5, 8, 11])
def test_the_same_as_one_by_one(it, n, labels):
    """Less than a batch, whole ones, and some over."""
    together = list(it.pings(POSES[:n], labels=labels))
    assert len(together) == n
    for number, (pose, ping) in enumerate(zip(POSES, together, strict=False)):
        check_same(ping, it.ping(pose, labels=labels), number % sequence.BATCH == 0)
    assert len({ping.intensity.tobytes() for ping in together}) == n


def test_with_noise_by_its_number(it):
    """The same noise on nearly the same ping is nearly the same."""
    noise = sg.Noise.physical()
    together = list(it.pings(POSES[:6], noise, seed=5))
    for number, ping in enumerate(together):
        check_same(
            ping, it.ping(POSES[number], noise, seed=5, ping_number=number), number % sequence.BATCH == 0
        )
    wrong = it.ping(POSES[5], noise, seed=5, ping_number=4).intensity
    assert np.abs(wrong - together[5].intensity).max() > 0.01 * wrong.max()


@pytest.mark.parametrize("labels", [False, True])
def test_with_bodies_of_each_pose(it, labels):
    together = list(it.pings(POSES, labels=labels, bodies=MOVED))
    for pose, moved, ping in zip(POSES, MOVED, together, strict=True):
        check_same(ping, it.ping(pose, labels=labels, bodies=moved))
    before = it.ping(POSES[1]).intensity
    assert (before != together[1].intensity).any()


def test_pings_from_one_pose_with_bodies_that_move(it):
    """Poses without end, as many pings as there are bodies' poses."""
    endless = (POSES[0] for _ in count())
    together = list(it.pings(endless, bodies=iter(MOVED)))
    assert len(together) == len(MOVED)
    for moved, ping in zip(MOVED, together, strict=True):
        check_same(ping, it.ping(POSES[0], bodies=moved))


def test_of_several_sectors_and_a_larger_picture_in_the_midst():
    """A batch has to fit more pixels than the one before."""
    wide = sg.Sonar("wide", 900e3, 128, 200, 250.0, 20.0, 2.0, 0.5, 20.0)
    poses = [sg.pose(x, yaw=0.3) for x in (-80, -80, -80, -80, 5, 5.2, 5.4, 5.6, -40, 5)]
    with (
        sg.Simulator(sg.Scene(BODIES), wide, sg.Acoustics.ideal(), SAMPLING) as it,
        warnings.catch_warnings(),
    ):
        warnings.simplefilter("ignore")  # far away nothing comes back
        together = list(it.pings(poses, labels=True))
        for pose, ping in zip(poses, together, strict=True):
            check_same(ping, it.ping(pose, labels=True))
    assert together[0].intensity.sum() == 0
    assert together[4].intensity.sum() > 0


def test_earlier_pings_are_not_written_to(it):
    kept = []
    for ping in it.pings(POSES, labels=True):
        kept.append((ping, ping.intensity.copy(), ping.body_id.copy(), ping.meta.copy()))
    for ping, intensity, body_id, meta in kept:
        np.testing.assert_array_equal(ping.intensity, intensity)
        np.testing.assert_array_equal(ping.body_id, body_id)
        assert ping.meta == meta


@pytest.mark.parametrize("nothing", [[], iter([]), np.empty((0, 4, 4))])
def test_no_poses_no_pings(it, nothing):
    assert list(it.pings(nothing)) == []
    assert it.ping(POSES[0]).intensity.any()


def test_poses_as_one_array(it):
    together = list(it.pings(np.stack(POSES[:3])))
    for pose, ping in zip(POSES, together, strict=False):
        check_same(ping, it.ping(pose))
    assert len(together) == 3


@pytest.mark.parametrize("stop", [1, 2, 4, 5, 9])
def test_an_endless_sequence_may_be_left(it, stop):
    """At any place; what was asked for came, and the simulator goes on."""
    asked = []

    def poses():
        for k in count():
            asked.append(k)
            yield POSES[k % 11]

    expected = [it.ping(pose).intensity for pose in POSES]
    threads = threading.active_count()
    pings = it.pings(poses())
    for number, ping in enumerate(islice(pings, stop)):
        check_like(ping.intensity, expected[number % 11])
    assert len(asked) <= stop + 2 * sequence.BATCH
    if stop % 2:
        pings.close()
    else:
        del pings
    np.testing.assert_array_equal(it.ping(POSES[3]).intensity, expected[3])
    for number, ping in enumerate(it.pings(POSES[:5])):
        check_like(ping.intensity, expected[number])
    assert threading.active_count() <= threads


def test_nothing_came_back_is_said_of_the_pings_that_it_is_true_of(it):
    away = sg.pose(yaw=3.0)
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        pings = list(it.pings([POSES[0], away, POSES[1], away, away, POSES[2]]))
    assert [ping.meta["has_echo"] for ping in pings] == [True, False, True, False, False, True]
    assert len(told) == 3


def test_what_is_no_sequence_is_told_at_once_or_with_the_first():
    with simulator() as it:
        for poses in (np.eye(4), 3, None):
            with pytest.raises(sg.Error) as caught:
                list(it.pings(poses))
            name = type(poses).__name__
            assert str(caught.value) == f"poses must be several poses (got {name}; make [pose] of one)"
        it.close()
        with pytest.raises(sg.Error) as caught:
            list(it.pings(POSES))
        assert str(caught.value) == "this Simulator is closed; make a new one"


def look_counter(it, monkeypatch):
    seen, judge = [], it._samples._judge
    monkeypatch.setattr(it._samples, "_judge", lambda *args, **kw: seen.append(1) or judge(*args, **kw))
    return seen


def test_a_thing_that_appears_is_noticed():
    """With a tolerance: samples get finer as they do ping by ping, at the first ping of a batch at once."""
    wall = sg.Body("wall", trimesh.creation.box((1, 60, 60)), sg.pose(9), 0.3)
    buoy = sg.Body("buoy", trimesh.creation.icosphere(3, 0.06), sg.pose(4, 0.3), 1.0)
    # the first ping is planned, four by four come after it
    first = 2 * sequence.BATCH
    bodies = [{"buoy": None}] * first + [None] * 5
    with simulator(None, [wall, buoy], tolerance=0.05) as it:
        alone = [it.ping(POSES[0], bodies=moved).meta["sampling"]["rows"] for moved in bodies]
    with simulator(None, [wall, buoy], tolerance=0.05) as it:
        together = [
            ping.meta["sampling"]["rows"] for ping in it.pings([POSES[0]] * len(bodies), bodies=bodies)
        ]
    assert together == alone
    assert together[first] > together[first - 1]


def test_a_change_of_the_echo_in_the_midst_is_noticed(monkeypatch):
    """The sonar turns little by little until a near thing comes into view: the planner looks at once."""
    near = sg.Body("near", trimesh.creation.box((0.1, 2, 2)), sg.pose(3, 3.0), 1.0)
    far = sg.Body("far", trimesh.creation.box((1, 6, 6)), sg.pose(15), 0.2)
    poses = [sg.pose(yaw=0.04 * k) for k in range(14)]
    with simulator(None, [far, near], tolerance=0.05) as it:
        alone = [it.ping(pose) for pose in poses]
    with simulator(None, [far, near], tolerance=0.05) as it:
        seen = look_counter(it, monkeypatch)
        together = list(it.pings(poses))
    assert len(seen) >= 2
    assert [p.pose.tobytes() for p in together] == [p.pose.tobytes() for p in alone]
    # each keeps its tolerance: the two need not have the same samples, but differ by no more than both err
    for one, other in zip(together, alone, strict=True):
        apart = np.abs(one.intensity - other.intensity).sum() / other.intensity.sum()
        assert apart < 0.1


def test_memory_does_not_grow():
    with simulator() as it:

        def some(n):
            for ping in it.pings(POSES[k % 11] for k in range(n)):
                del ping

        some(12)
        tracemalloc.start()
        some(8)
        _, few = tracemalloc.get_traced_memory()
        tracemalloc.reset_peak()
        some(200)
        now, many = tracemalloc.get_traced_memory()
        tracemalloc.stop()
    # a ping holds 51 kB, and up to three batches are underway; 200 of them would be 10 MB
    assert many < 1_000_000
    assert now < few
