"""Reflectivity and water of a single ping: the ping equals that of a simulator made with them."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
import trimesh

import sonar_gl as sg
from sonar_gl.engine.pipeline import make_ping
from sonar_gl.engine.request import PingRequest
from sonar_gl.engine.stage import StageCache
from tests.support.errors import error_of

SONAR = sg.Sonar("test", 900e3, 48, 160, 60.0, 20.0, 1.5, 0.5, 16.0, bandwidth_hz=5e3)
SAMPLING = sg.Sampling(2, 30)
BALL, BOX = trimesh.creation.icosphere(3, 0.5), trimesh.creation.box((0.6, 0.8, 1.0))
PATCHY = np.linspace(0.1, 1.0, 12)
# a TVG set for other water, so that the gain depends on the water; a pulse, so that the speed of sound matters
ACOUSTICS = sg.Acoustics.physical(tvg_k=30.0, tvg_absorption_db_m=0.2, pulse=True, multipath="incoherent")
NOISE = sg.Noise(speckle=True, ambient_db=-60.0)
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


@pytest.mark.parametrize("engine", ["cpu", pytest.param("opengl", marks=pytest.mark.slow)])
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


KNOWN = "names in reflectivity must be bodies of the scene (got {!r}; known are patchy, plain, smooth)"
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
        assert error_of(call) == message


def test_kernels_are_warmed_up_once_per_process(monkeypatch):
    """A second fan for this took half the time of every later constructor."""
    simulator().close()
    made, make = [], StageCache.make
    monkeypatch.setattr(StageCache, "make", lambda *arguments: made.append(1) or make(*arguments))
    simulator().close()
    assert len(made) == 1


def test_the_reflectivity_of_a_ping_decides_which_bodies_count():
    """Balls that are black in the scene, and fall between the samples of the first try."""
    balls = [
        sg.Body(f"ball {k}", trimesh.creation.icosphere(2, 0.008), sg.pose(15, k - 2, 0.3), 0.0)
        for k in range(5)
    ]
    wall = sg.Body("wall", trimesh.creation.box((0.2, 0.5, 0.5)), sg.pose(8, 0, -1), 0.002)
    white = {body.name: 1.0 for body in balls}
    request = PingRequest(sg.pose(), labels=True, alone=True, reflectivity=white)
    as_given = PingRequest(sg.pose(), labels=True, alone=True)
    sonar = sg.Sonar("test", 900e3, 64, 300, 60.0, 20.0, 1.0, 0.5, 20.0)
    found = []
    for bodies, one in ((balls, request), ([replace(body, reflectivity=1.0) for body in balls], as_given)):
        with sg.Simulator(sg.Scene([*bodies, wall]), sonar, sg.Acoustics.ideal(), tolerance=0.3) as it:
            found.append(make_ping(it.run, one))
    np.testing.assert_array_equal(found[0].body_echo, found[1].body_echo)
    assert (found[0].body_echo[1:6] > 0).all()


def test_multipath_of_a_body_that_is_bright_in_one_ping_alone():
    """What reflectors may return depends on the reflectivity of the ping, not on that of the scene."""
    sonar = sg.Sonar("test", 900e3, 32, 200, 40.0, 30.0, 1.5, 0.5, 12.0)

    def ping(mu, multipath="incoherent", **settings):
        wall = sg.Body("wall", trimesh.creation.box((0.5, 4, 1)), sg.pose(6, 0, -1), mu)
        scene = sg.Scene([wall], surface_z_m=0.0, surface_roughness_m=0.0)
        acoustics = replace(sg.Acoustics.ideal(), multipath=multipath)
        with sg.Simulator(scene, sonar, acoustics, SAMPLING, tolerance=0.05) as it:
            return it.ping(sg.pose(0, 0, -1), **settings).intensity

    expected = ping(1.0)
    assert expected.sum() > 1.1 * ping(1.0, "none").sum()
    np.testing.assert_array_equal(ping(0.01, reflectivity={"wall": 1.0}), expected)
