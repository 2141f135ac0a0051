"""The sonar moved by keys."""

import numpy as np
import pytest

from sonar_gl.core.poses import pose, pose_numbers
from sonar_gl.live.key_motion import KEYS, moved

START = pose(1, 2, -3, yaw=np.pi / 2)  # looks along y; port is -x


@pytest.mark.parametrize(
    "key, place",
    [
        ("w", (1, 4, -3)),
        ("s", (1, 0, -3)),
        ("a", (-1, 2, -3)),
        ("d", (3, 2, -3)),
        ("e", (1, 2, -1)),
        ("q", (1, 2, -5)),
    ],
)
def test_letters_shift_the_sonar(key, place):
    out = moved(START, {key}, 0.5, speed_m_s=4.0)
    assert out[:3, 3] == pytest.approx(place, abs=1e-12)
    assert out[:3, :3].tolist() == START[:3, :3].tolist()


@pytest.mark.parametrize(
    "key, wanted",
    [
        ("arrowleft", pose(yaw=0.3, pitch=0.2)),
        ("arrowright", pose(yaw=-0.3, pitch=0.2)),
        ("arrowup", pose(pitch=-0.1)),
        ("arrowdown", pose(pitch=0.5)),
    ],
)
def test_arrows_turn_the_sonar_which_stays_level(key, wanted):
    out = moved(pose(pitch=0.2), {key}, 0.6, turn_rate_rad_s=0.5)
    assert out == pytest.approx(wanted, abs=1e-12)


def test_opposite_and_unknown_keys_do_nothing():
    assert moved(START, {"w", "s", "arrowup", "arrowdown", "x", "Shift"}, 1.0).tolist() == START.tolist()


def test_small_steps_add_up_to_a_large_one():
    out = START
    for _ in range(100):
        out = moved(out, {"arrowleft", "e"}, 0.01)
    assert out == pytest.approx(moved(START, {"arrowleft", "e"}, 1.0), abs=1e-9)  # 100 products of rotations


@pytest.mark.parametrize("roll", [0.0, 0.4])
def test_the_sonar_does_not_roll_over(roll):
    out = pose(roll=roll, pitch=1.0, yaw=0.7)
    for _ in range(50):
        out = moved(out, {"arrowdown"}, 0.1)
    *_, roll_now, pitch, yaw = pose_numbers(out)
    # near the pole rounding of the matrix shows in roll and yaw 1/cos(89 degrees) times
    assert (roll_now, pitch, yaw) == pytest.approx((roll, np.radians(89.0), 0.7), abs=1e-9)


def test_a_sonar_beyond_the_steepest_can_turn_back():
    down = pose(pitch=np.pi / 2)
    assert moved(down, {"arrowdown"}, 1.0) == pytest.approx(down, abs=1e-12)
    back = moved(down, {"arrowup"}, 1.0, turn_rate_rad_s=0.5)
    assert np.arcsin(-back[2, 0]) == pytest.approx(np.pi / 2 - 0.5, abs=1e-9)


def test_it_stays_rigid():
    generator, out = np.random.default_rng(0), START
    for _ in range(1000):
        out = moved(out, set(generator.choice(list(KEYS), 3)), 0.05)
    assert out[:3, :3] @ out[:3, :3].T == pytest.approx(np.eye(3), abs=1e-12)
