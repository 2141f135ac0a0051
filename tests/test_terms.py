"""What terms are worth in a scene, and the acoustics that it needs."""

import doctest
from dataclasses import replace

import numpy as np
import pytest
import trimesh

import sonar_gl as sg
from sonar_gl import terms
from sonar_gl.noise import add_noise
from sonar_gl.switches import SPECKLE, TERMS, everything_on, without
from sonar_gl.terms import differs, needed, price
from sonar_gl.types import Error

SONAR = sg.Sonar("small", 900e3, 32, 160, 40.0, 16.0, 2.0, 0.5, 12.5)
NAMES = [term.name for term in TERMS]
ACOUSTIC = [term.name for term in TERMS if not term.of_noise]


@pytest.fixture(autouse=True)
def timed_once(monkeypatch):
    """What a term costs is a median of many turns, of which no test here asks how exact it is."""
    monkeypatch.setattr(terms, "TURNS", 1)


def room(pitch=0.15, **more):
    """A sphere above a level floor, and a water's surface if one is named."""
    floor = trimesh.Trimesh([(-30, -30, 0), (30, -30, 0), (30, 30, 0), (-30, 30, 0)], [(0, 1, 2), (0, 2, 3)])
    sphere = trimesh.creation.icosphere(3, 0.4)
    body = {key: more.pop(key) for key in ("specular", "roughness_rad") if key in more}
    bodies = [sg.Body("floor", floor, None, 0.3), sg.Body("sphere", sphere, sg.pose(7, 0.5, 1), 0.8, **body)]
    return sg.Scene(bodies, sg.pose(0, 0, 1.5, 0, pitch), "room", **more)


def priced(scene, *more, **settings):
    """Name -> Price."""
    return {one.name: one for one in price(scene, SONAR, *more, **settings)}


def seen(ping, acoustics, noise, speckle):
    """A ping with its noise; without speckle, the mean of many."""
    if speckle and noise.speckle:
        return np.float64(add_noise(ping, noise, 0).intensity)
    power = 0.0 if noise.electronic_db is None else 10 ** (noise.electronic_db / 10)
    return ping.intensity + power * acoustics.tvg(SONAR.range_m, SONAR)


def test_the_mean_of_many_pings_is_that():
    scene = room()
    full, noise = everything_on(sg.Acoustics.physical(), sg.Noise.physical(), SONAR)
    noise = replace(noise, electronic_db=-50.0)
    with sg.Simulator(scene, SONAR, full, tolerance=0.05) as simulator:
        ping = simulator.ping(scene.sonar_pose)
    many = np.mean([np.float64(add_noise(ping, noise, seed).intensity) for seed in range(400)], axis=0)
    mean = seen(ping, full, noise, speckle=False)
    # 400 exponentials: 5 % each; their sum over beams and bins far less
    assert abs(many.sum() / mean.sum() - 1) < 0.01
    assert np.abs(many / mean - 1).mean() == pytest.approx(0.05 * np.sqrt(2 / np.pi), rel=0.1)


def test_every_switch_switches_its_term_off_and_on_again():
    start = sg.Acoustics.physical(), sg.Noise.physical()
    full = everything_on(*start, SONAR)
    assert everything_on(*full, SONAR) == full
    for term in TERMS:
        less = without(*full, [term])
        assert less != full and less[term.of_noise is False] == full[term.of_noise is False]
        assert everything_on(*less, SONAR)[1 if term.of_noise else 0] == full[1 if term.of_noise else 0]
    bare = without(*full, TERMS)
    assert bare[1] == sg.Noise.none()
    # what the sonar shows then is what "ideal" does, but for the range law; of that only the loss is a term
    ideal = {key: getattr(sg.Acoustics.ideal(), key) for key in ("beam_pattern", "specular", "bubbles")}
    assert {key: getattr(bare[0], key) for key in ideal} == ideal
    assert bare[0].multipath == "none" and bare[0].bandwidth_hz is None and bare[0].elevation_pattern == "box"
    assert bare[0].absorption(900e3) == 0


def test_what_is_set_stays_as_it_is_set():
    mine = sg.Acoustics.physical(
        beam_pattern="gaussian",
        elevation_pattern="gaussian",
        bandwidth_hz=5e3,
        multipath="coherent",
        tvg_k=40.0,
    )
    noise = sg.Noise(speckle=True, looks=3, ambient_db=-70.0)
    assert everything_on(mine, noise, SONAR) == (mine, noise)
    # a straight array cannot have box beams
    straight = replace(mine, steered="straight")
    assert without(straight, noise, TERMS[1:2])[0] == replace(mine, beam_pattern="box")
    speed = everything_on(sg.Acoustics.physical(sonar_sound_speed_m_s=1600.0), noise, SONAR)[0]
    assert speed.bandwidth_hz == pytest.approx(1600 / 2 / SONAR.bin_size_m)


def test_differences_are_those_of_pings_by_hand():
    """Of each term, from two pings with the same samples, drawn in worlds of their own."""
    scene = room(0.0, surface_z_m=3.0)
    full, noise = everything_on(sg.Acoustics.physical(), sg.Noise.physical(), SONAR)
    with sg.Simulator(scene, SONAR, full, tolerance=0.05) as simulator:
        simulator.plan([scene.sonar_pose])
        sampling = simulator.sampling
    found = priced(scene, 0.01)
    assert list(found) == NAMES
    for term in TERMS:
        images = []
        for acoustics, amounts in ((full, noise), without(full, noise, [term])):
            with sg.Simulator(scene, SONAR, acoustics, sampling, tolerance=0.01) as simulator:
                ping = simulator.ping(scene.sonar_pose)
            images.append(seen(ping, acoustics, amounts, speckle=term is SPECKLE))
        apart, (whole, _) = np.abs(images[0] - images[1]), images
        assert found[term.name].changes == pytest.approx(apart.sum() / whole.sum(), rel=1e-9)
        assert found[term.name].worst_bin == pytest.approx(apart.max() / whole.max(), rel=1e-9)
    # the surface and the floor mirror; E|g − 1| of speckle's exponential g is 2/e, here of few strong grains
    assert found["multipath"].changes > 0.003
    assert found["speckle"].changes == pytest.approx(2 / np.e, rel=0.3)


def test_what_a_scene_has_not_changes_nothing_and_costs_nothing():
    found = priced(room())
    for name in ("lobes", "bubbles"):
        assert (found[name].changes, found[name].worst_bin, found[name].time_ms) == (0, 0, 0)
        assert found[name].on is False
    shiny = priced(room(specular=0.5, roughness_rad=0.05))["lobes"]
    assert shiny.changes > 0.01 and shiny.on and shiny.worst_bin > 0.1
    sphere = sg.Scene(room().bodies[1:], room().sonar_pose)  # curved all over: no mirror
    assert priced(sphere)["multipath"] == type(shiny)("multipath", 0.0, 0.0, 0.0, False)


def test_absorption_acts_through_the_noise_that_the_tvg_lifts():
    """With the TVG right the echo is as if there were none; a TVG that is set does not follow."""
    scene = room()
    assert priced(scene, noise=sg.Noise(speckle=True, electronic_db=-300.0))["absorption"].changes < 1e-6
    wrong = sg.Acoustics.physical(tvg_absorption_db_m=0.0)
    changes = priced(scene, acoustics=wrong)["absorption"].changes
    assert changes > 1  # 0.35 dB/m, both ways, over some 10 m: without it most echoes are twice as strong


def test_of_several_poses_the_largest_change_counts():
    scene = room()
    poses = [scene.sonar_pose, sg.pose(0, 0, 1.5, 0, 0.15, np.pi), sg.pose(3, 0, 1.5, 0, 0.3)]
    apart = [priced(scene, poses=[pose]) for pose in poses]
    together = priced(scene, poses=poses)
    for name in ("azimuth pattern", "elevation pattern", "pulse"):
        # the samples of all three are those that the most demanding asks for
        most = max(one[name].changes for one in apart)
        assert together[name].changes == pytest.approx(most, rel=0.05)


def needs(scene, sonar, tolerance):
    """What is needed, everything on, and how far their pings are apart with the tolerance's samples."""
    few = sg.Acoustics.needed(scene, sonar, tolerance)
    full, _ = everything_on(sg.Acoustics.physical(), sg.Noise.physical(), sonar)
    with sg.Simulator(scene, sonar, full, tolerance=tolerance) as simulator:
        simulator.plan([scene.sonar_pose])
        whole = simulator.ping(scene.sonar_pose)
        with sg.Simulator(simulator, sonar, few, simulator.sampling, tolerance) as other:
            part = other.ping(scene.sonar_pose)
    return few, full, differs(whole.intensity, part.intensity)[0]


@pytest.mark.parametrize(
    "name, tolerance",
    [("pylon", 0.02), ("pylon", 0.15), ("diver", 0.15), ("diver_vertical", 0.3), ("ocean_floor", 0.02)],
)
def test_the_image_changes_by_no_more_than_the_tolerance(name, tolerance):
    scene, sonar = sg.load_scene(name), replace(sg.load_sonar("p900-45"), n_bins=500)
    few, full, apart = needs(scene, sonar, tolerance)
    # changes are judged with coarser samples, of which the term's own part may be off by as much as they err
    assert apart <= 1.1 * tolerance
    assert few != full  # no scene here has lobes


def test_small_terms_are_left_out_only_as_far_as_all_of_them_together_stay_small():
    scene, left = room(0.0, surface_z_m=3.0), 0
    for tolerance in (0.006, 0.05, 0.3):
        found = priced(scene, tolerance).values()
        on, off = ([one.changes for one in found if one.on is state] for state in (True, False))
        assert max(off) <= min(on) and max(off) <= tolerance
        *_, apart = needs(scene, SONAR, tolerance)
        assert apart <= 1.1 * tolerance
        assert len(off) >= left
        left = len(off)
    assert left >= 5 and any(changes > 0 for changes in off)


def test_the_same_scene_always_needs_the_same():
    scene = room(surface_z_m=3.0)
    first = sg.Acoustics.needed(scene, SONAR, 0.05)
    assert sg.Acoustics.needed(scene, SONAR, 0.05) == first == needed(scene, SONAR, 0.05, [scene.sonar_pose])
    assert sg.Acoustics.needed(scene, SONAR, 0.05, scene.sonar_pose) == first
    on = {one.name for one in price(scene, SONAR, 0.05) if one.on}
    assert (first.multipath != "none") == ("multipath" in on)
    assert (first.beam_pattern != "box") == ("azimuth pattern" in on)
    assert (first.bandwidth_hz is not None) == ("pulse" in on)
    assert first.profile == "physical" and first.tvg_k == 20


def test_examples():
    assert doctest.testmod(terms).failed == 0


def test_mistakes():
    mute = sg.Scene(room().bodies)
    for function in (price, sg.Acoustics.needed):
        with pytest.raises(Error, match="scene 'scene' has no sonar in it; give a pose"):
            function(mute, SONAR)
        with pytest.raises(Error, match="tolerance must be a number"):
            function(room(), SONAR, 0.7)
        with pytest.raises(Error, match="poses must hold at least one pose"):
            function(room(), SONAR, 0.1, [])
    assert sg.Acoustics.needed(mute, SONAR, 0.1, room().sonar_pose).profile == "physical"


@pytest.mark.filterwarnings("ignore:no echo came back")
def test_where_nothing_comes_back_nothing_is_needed():
    found = price(sg.Scene([], sg.pose()), SONAR, noise=sg.Noise(speckle=True, electronic_db=-300.0))
    assert [one.changes for one in found if one.name in ACOUSTIC and one.name != "absorption"] == [0] * 6


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("needed,tvg_k=3", "needed must stand alone"),
        ("", "must be key=value"),
        ("tvg_k=3,", "must be key=value"),
    ],
)
def test_acoustics_of_a_command_line_that_make_no_sense(text, said):
    with pytest.raises(sg.Error, match=said):
        sg.Acoustics.parse(text)
