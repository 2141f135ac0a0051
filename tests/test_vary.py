"""What is of one ping alone, reflectivity and water: the same as a simulator that was made with it."""

import re
import warnings
from dataclasses import replace

import numpy as np
import pytest
import trimesh

import sonar_gl as sg
from sonar_gl import gpu

SONAR = sg.Sonar("test", 900e3, 48, 160, 60.0, 20.0, 1.5, 0.5, 16.0)
SAMPLING = sg.Sampling(2, 30)
BALL, BOX = trimesh.creation.icosphere(3, 0.5), trimesh.creation.box((0.6, 0.8, 1.0))
PATCHY = np.linspace(0.1, 1.0, 12)
# a TVG that believes in other water, so that the gain follows the water; the pulse, so that its speed counts
ACOUSTICS = sg.Acoustics.physical(
    tvg_k=30.0, tvg_absorption_db_m=0.2, bandwidth_hz=5e3, multipath="incoherent"
)
NOISE = sg.Noise(speckle=True, electronic_db=-60.0)
POSES = [sg.pose(0.1 * k, 0.05 * k, -2.0, yaw=0.02 * k) for k in range(7)]
COLD = {"temperature_c": 2.0, "salinity_psu": 5.0}
FAST = [2.0, 0.5, 0, 0, 0, 0.4]


def scene(plain=0.8, smooth=0.6, patchy=1.0):
    bodies = (
        sg.Body("plain", BOX, sg.pose(6, 1.5, -2), plain),
        sg.Body("smooth", BALL, sg.pose(8, -1, -2), smooth, 2 * BALL.vertices, 0.3, 0.2),
        sg.Body("patchy", BOX, sg.pose(5, -1, -2.5, 0.3, 0.2, 0.7), patchy * PATCHY),
    )
    plume = sg.Bubbles("plume", sg.pose(9, 1, -3))
    return sg.Scene([*bodies, plume], surface_z_m=-1.4, surface_roughness_m=0)  # it mirrors what is near it


def simulator(acoustics=ACOUSTICS, **reflectivity):
    return sg.Simulator(scene(**reflectivity), SONAR, acoustics, SAMPLING)


@pytest.fixture(scope="module")
def it():
    with simulator() as one:
        yield one


def check_same(one, other):
    """Equal to the bit in all that a ping holds."""
    for name in ("intensity", "body_id", "elevation_rad", "body_echo", "pose"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    assert one.meta == other.meta
    assert one.intensity.any()


@pytest.mark.parametrize("who", ["sifted here", "by the driver"])
def test_a_ping_of_other_reflectivity_is_that_of_a_scene_of_bodies_that_have_it(monkeypatch, who):
    """Lobes stay, and what has a value a face takes it as a factor: one half, which rounds nothing."""
    monkeypatch.setattr(gpu, "SOFTWARE", re.compile("" if who == "sifted here" else "(?!)"))
    settings, other = {"labels": True, "time_s": 3.0}, {"plain": 0.3, "smooth": 0.95, "patchy": 0.5}
    # what mirrors return is decided by what bodies are by themselves
    acoustics = replace(ACOUSTICS, multipath="none")
    with simulator(acoustics) as one, simulator(acoustics, **other) as expected:
        before = one.ping(POSES[0], **settings)
        check_same(one.ping(POSES[0], reflectivity=other, **settings), expected.ping(POSES[0], **settings))
        check_same(one.ping(POSES[0], **settings), before)
        with_less = one.ping(POSES[0], reflectivity={"plain": 0.4}, **settings).body_echo
        # halved by a bit of the exponent, and it alone
        np.testing.assert_array_equal(with_less, before.body_echo * [1, 0.5, 1, 1])


def test_a_ping_in_other_water_is_that_of_a_simulator_of_that_water(it):
    """With ghosts, bubbles, pulse, motion and noise; but for the mirrors of a rough surface."""
    acoustics = replace(ACOUSTICS, **COLD)
    settings = {"noise": NOISE, "seed": 3, "labels": True, "time_s": 3.0, "velocity": FAST}
    with simulator(acoustics) as expected:
        in_cold = it.ping(POSES[0], water=COLD, **settings)
        check_same(in_cold, expected.ping(POSES[0], **settings))
        quiet = {**settings, "noise": None}
        cold = it.ping(POSES[0], water=COLD, **quiet)
        check_same(cold, expected.ping(POSES[0], **quiet))
    with sg.Simulator(it, SONAR, replace(ACOUSTICS, multipath="none"), SAMPLING) as straight:
        assert cold.intensity.sum() > 1.01 * straight.ping(POSES[0], water=COLD, **quiet).intensity.sum()
    assert in_cold.meta["sound_speed_m_s"] == acoustics.sound_speed()
    assert in_cold.meta["absorption_db_m"] == acoustics.absorption(900e3)
    warm = it.ping(POSES[0], **settings)
    assert in_cold.body_echo.sum() < 0.9 * warm.body_echo.sum()  # the sound is weakened more
    assert warm.meta["acoustics"] == ACOUSTICS.meta()


def test_by_itself_or_in_a_sequence_a_ping_has_the_same_bytes(it):
    """All that may change from ping to ping at once, in batches and past their ends."""
    bodies = [{"plain": sg.pose(7, 0.2 * k, -2), "plume": None} if k % 2 else None for k in range(7)]
    reflectivities = [None if k == 3 else {"smooth": 0.1 * k} for k in range(7)]
    waters = [None if k == 4 else {**COLD, "temperature_c": 3.0 * k} for k in range(7)]
    settings = {"noise": NOISE, "seed": 5, "labels": True}
    changes = {"bodies": bodies, "reflectivities": iter(reflectivities), "waters": (w for w in waters)}
    together = list(it.pings(POSES, **settings, **changes))
    assert len(together) == 7
    for k, ping in enumerate(together):
        of_it = {"bodies": bodies[k], "reflectivity": reflectivities[k], "water": waters[k]}
        check_same(ping, it.ping(POSES[k], ping_number=k, **settings, **of_it))
    assert len({ping.meta["sound_speed_m_s"] for ping in together}) == 7


def test_samples_by_a_plan_hear_the_water_too():
    """As those that were given do."""
    with sg.Simulator(scene(), SONAR, ACOUSTICS, tolerance=0.2) as one, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # nothing is promised of so small a sonar
        one.plan(POSES[:2])
        sampling = one.sampling
        ping = one.ping(POSES[1], water=COLD, reflectivity={"plain": 0.1}, labels=True)
        pings = list(one.pings(POSES, waters=[COLD] * 7, reflectivities=[{"plain": 0.1}] * 7, labels=True))
    check_same(pings[1], ping)
    with sg.Simulator(scene(plain=0.1), SONAR, replace(ACOUSTICS, **COLD), sampling) as expected:
        np.testing.assert_array_equal(ping.body_echo, expected.ping(POSES[1], labels=True).body_echo)


def test_the_speed_may_not_change_where_the_sonar_is_set_to_one():
    """Echoes would lie in other bins; what leaves it alone may."""
    acoustics = sg.Acoustics.physical(sonar_sound_speed_m_s=1500.0)
    with pytest.raises(sg.Error, match=r"^the speed of sound must stay .* \(got 1418.51 for 1489.97 m/s; "):
        acoustics.in_water({"temperature_c": 2.0, "salinity_psu": 5.0})
    assert acoustics.in_water({"ph": 7.5, "absorption_db_m": 0.1}).absorption(900e3) == 0.1


KNOWN = "names in reflectivity must be bodies of the scene (got {!r}; there are: 'plain', 'smooth', 'patchy')"
OUTSIDE = "the reflectivity of body 'plain' must be a number in 0..1 (got {!r})"
NO_WATER = "water must hold fields of Acoustics that tell the water (got {!r}; known are " + ", ".join(
    ["absorption_db_m", "depth_m", "ph", "salinity_psu", "sound_speed_m_s", "temperature_c)"]
)
NO_DICT = "water must be a dict (got str; such as {})".format({"temperature_c": 4.0, "salinity_psu": 8.0})
REFUSED = [
    ({"reflectivity": {"diver": 0.5}}, KNOWN.format("diver")),
    ({"reflectivity": {"plume": 0.5}}, KNOWN.format("plume")),
    ({"reflectivity": {"plain": 1.01}}, OUTSIDE.format(1.01)),
    ({"reflectivity": {"plain": "mud"}}, OUTSIDE.format("mud")),
    ({"reflectivity": 0.5}, 'reflectivity must be a dict (got float; such as {"diver": 0.2})'),
    ({"water": {"tvg_k": 30.0}}, NO_WATER.format("tvg_k")),
    ({"water": {"ph": 20}}, "acoustics: ph must lie in 7..9 (got 20; sea water has about 8)"),
    ({"water": "cold"}, NO_DICT.replace("'", '"')),
]


@pytest.mark.parametrize(("what", "told"), REFUSED)
def test_what_makes_no_sense_is_told_in_one_sentence(it, what, told):
    (name, value), plural = *what.items(), {"reflectivity": "reflectivities", "water": "waters"}
    for call in (
        lambda: it.ping(POSES[0], **what),
        lambda: list(it.pings(POSES[:1], **{plural[name]: [value]})),
    ):
        with pytest.raises(sg.Error) as caught:
            call()
        assert str(caught.value) == told
