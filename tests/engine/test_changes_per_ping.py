"""Reflectivity and water of a single ping: the ping equals that of a simulator made with them."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
import trimesh

import sonar_gl as sg
from sonar_gl.engine.stage import StageCache

SONAR = sg.Sonar("test", 900e3, 48, 160, 60.0, 20.0, 1.5, 0.5, 16.0, bandwidth_hz=5e3)
SAMPLING = sg.Sampling(2, 30)
BALL, BOX = trimesh.creation.icosphere(3, 0.5), trimesh.creation.box((0.6, 0.8, 1.0))
PATCHY = np.linspace(0.1, 1.0, 12)
# a TVG set for other water, so that the gain depends on the water; a pulse, so that the speed of sound matters
ACOUSTICS = sg.Acoustics.physical(tvg_k=30.0, tvg_absorption_db_m=0.2, pulse=True, multipath="incoherent")
NOISE = sg.Noise(speckle=True, electronic_db=-60.0)
POSES = [sg.pose(0.1 * k, 0.05 * k, -2.0, yaw=0.02 * k) for k in range(7)]
COLD = sg.Water(temperature_c=2.0, salinity_psu=5.0)
FAST = [2.0, 0.5, 0, 0, 0, 0.4]


def scene(plain=0.8, smooth=0.6, patchy=1.0):
    bodies = (
        sg.Body("plain", BOX, sg.pose(6, 1.5, -2), plain),
        sg.Body("smooth", BALL, sg.pose(8, -1, -2), smooth, 2 * BALL.vertices, 0.3, 0.2),
        sg.Body("patchy", BOX, sg.pose(5, -1, -2.5, 0.3, 0.2, 0.7), patchy * PATCHY),
    )
    plume = sg.Bubbles("plume", sg.pose(9, 1, -3))
    # a planar reflector near the bodies
    return sg.Scene([*bodies, plume], surface_z_m=-1.4, surface_roughness_m=0)


def simulator(acoustics=ACOUSTICS, **reflectivity):
    return sg.Simulator(scene(**reflectivity), SONAR, acoustics, SAMPLING)


@pytest.fixture(scope="module")
def it():
    with simulator() as one:
        yield one


def check_same(one, other):
    """Check that all arrays and the meta of two pings are identical."""
    for name in ("intensity", "body_id", "elevation_rad", "body_echo", "pose"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    assert one.meta == other.meta
    assert one.intensity.any()


@pytest.mark.parametrize("engine", ["cpu", "opengl"])
def test_a_ping_with_other_reflectivity_is_that_of_such_a_scene(monkeypatch, engine):
    """Specular lobes stay; values per face are scaled by the factor, here one half, which causes no rounding."""
    monkeypatch.setenv("SONAR_GL_ENGINE", engine)
    settings, other = {"labels": True, "time_s": 3.0}, {"plain": 0.3, "smooth": 0.95, "patchy": 0.5}
    # reflection coefficients follow from the bodies' own values, so multipath is off
    acoustics = replace(ACOUSTICS, multipath="none")
    with simulator(acoustics) as one, simulator(acoustics, **other) as expected:
        before = one.ping(POSES[0], **settings)
        check_same(one.ping(POSES[0], reflectivity=other, **settings), expected.ping(POSES[0], **settings))
        check_same(one.ping(POSES[0], **settings), before)
        halved = one.ping(POSES[0], reflectivity={"plain": 0.4}, **settings).body_echo
        # exactly halved, as only the exponent changes
        np.testing.assert_array_equal(halved, before.body_echo * [1, 0.5, 1, 1])


def test_a_ping_in_other_water_is_that_of_such_a_simulator(it):
    """The scene has multipath, bubbles, pulse, motion and noise; its surface is smooth."""
    acoustics = replace(ACOUSTICS, water=COLD)
    settings = {"noise": NOISE, "seed": 3, "labels": True, "time_s": 3.0, "velocity": FAST}
    with simulator(acoustics) as expected:
        in_cold = it.ping(POSES[0], water=COLD, **settings)
        check_same(in_cold, expected.ping(POSES[0], **settings))
        quiet = {**settings, "noise": None}
        cold = it.ping(POSES[0], water=COLD, **quiet)
        check_same(cold, expected.ping(POSES[0], **quiet))
    with sg.Simulator(it, SONAR, replace(ACOUSTICS, multipath="none"), SAMPLING) as straight:
        assert cold.intensity.sum() > 1.01 * straight.ping(POSES[0], water=COLD, **quiet).intensity.sum()
    assert in_cold.meta["sound_speed_m_s"] == COLD.sound_speed()
    assert in_cold.meta["absorption_db_m"] == COLD.absorption(900e3)
    warm = it.ping(POSES[0], **settings)
    assert in_cold.body_echo.sum() < 0.9 * warm.body_echo.sum()  # more absorption
    assert warm.meta["acoustics"] == ACOUSTICS.meta()


def test_single_pings_and_sequences_give_the_same_bytes(it):
    """Bodies, reflectivity and water change from ping to ping, within and across batches."""
    bodies = [{"plain": sg.pose(7, 0.2 * k, -2), "plume": None} if k % 2 else None for k in range(7)]
    reflectivities = [None if k == 3 else {"smooth": 0.1 * k} for k in range(7)]
    waters = [None if k == 4 else replace(COLD, temperature_c=3.0 * k) for k in range(7)]
    settings = {"noise": NOISE, "seed": 5, "labels": True}
    changes = {"bodies": bodies, "reflectivities": iter(reflectivities), "waters": (w for w in waters)}
    together = list(it.pings(POSES, **settings, **changes))
    assert len(together) == 7
    for k, ping in enumerate(together):
        changed = {"bodies": bodies[k], "reflectivity": reflectivities[k], "water": waters[k]}
        check_same(ping, it.ping(POSES[k], ping_number=k, **settings, **changed))
    assert len({ping.meta["sound_speed_m_s"] for ping in together}) == 7


def test_a_planned_sampling_follows_water_and_reflectivity():
    """A planned sampling acts like a fixed one."""
    with sg.Simulator(scene(), SONAR, ACOUSTICS, tolerance=0.2) as one, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the tolerance does not hold for so small a sonar
        one.plan(POSES[:2])
        sampling = one.sampling
        ping = one.ping(POSES[1], water=COLD, reflectivity={"plain": 0.1}, labels=True)
        pings = list(one.pings(POSES, waters=[COLD] * 7, reflectivities=[{"plain": 0.1}] * 7, labels=True))
    check_same(pings[1], ping)
    with sg.Simulator(scene(plain=0.1), SONAR, replace(ACOUSTICS, water=COLD), sampling) as expected:
        np.testing.assert_array_equal(ping.body_echo, expected.ping(POSES[1], labels=True).body_echo)


def test_the_speed_of_sound_may_not_change_if_the_sonar_is_set_to_one():
    """Another speed would shift echoes to other bins; other properties of the water may change."""
    acoustics = sg.Acoustics.physical(sonar_sound_speed_m_s=1500.0)
    with pytest.raises(
        sg.Error, match=r"^the speed of sound must not change .* \(got 1418.51 for 1489.97 m/s; "
    ):
        acoustics.in_water(COLD)
    sour = sg.Water(ph=7.5, absorption_db_m=0.1)
    assert acoustics.in_water(sour).water == sour


KNOWN = "names in reflectivity must be bodies of the scene (got {!r}; there are: 'plain', 'smooth', 'patchy')"
OUTSIDE = "the reflectivity of body 'plain' must be a number in 0..1 (got {!r})"
NO_WATER = "water must be a Water (got {}; such as dataclasses.replace(acoustics.water, temperature_c=4.0))"
REFUSED = [
    ({"reflectivity": {"diver": 0.5}}, KNOWN.format("diver")),
    ({"reflectivity": {"plume": 0.5}}, KNOWN.format("plume")),
    ({"reflectivity": {"plain": 1.01}}, OUTSIDE.format(1.01)),
    ({"reflectivity": {"plain": "mud"}}, OUTSIDE.format("mud")),
    ({"reflectivity": 0.5}, 'reflectivity must be a dict (got float; such as {"diver": 0.2})'),
    ({"water": {"temperature_c": 4.0}}, NO_WATER.format("dict")),
    ({"water": "cold"}, NO_WATER.format("str")),
]


@pytest.mark.parametrize(("arguments", "message"), REFUSED)
def test_invalid_arguments_raise_errors(it, arguments, message):
    (name, value), plural = *arguments.items(), {"reflectivity": "reflectivities", "water": "waters"}
    for call in (
        lambda: it.ping(POSES[0], **arguments),
        lambda: list(it.pings(POSES[:1], **{plural[name]: [value]})),
    ):
        with pytest.raises(sg.Error) as caught:
            call()
        assert str(caught.value) == message


def test_kernels_are_warmed_up_once_per_process(monkeypatch):
    """A second fan for this took half the time of every later constructor."""
    simulator().close()
    made, make = [], StageCache.make
    monkeypatch.setattr(StageCache, "make", lambda *arguments: made.append(1) or make(*arguments))
    simulator().close()
    assert len(made) == 1
