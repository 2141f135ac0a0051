"""The price of terms in a scene, and the acoustics that it needs."""

import warnings
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import trimesh

import sonar_gl as sg
from sonar_gl.analysis import terms
from sonar_gl.analysis.terms import (
    SPECKLE,
    TERMS,
    changed_bins,
    differs,
    everything_on,
    needed_acoustics,
    price,
    without,
)
from sonar_gl.core.errors import Error
from sonar_gl.noise.noise import add_noise
from sonar_gl.noise.receiver import common_noise_pattern, receiver_levels_db
from tests.support.plain_scenes import without_materials

SONAR = sg.Sonar("small", 900e3, 32, 160, 40.0, 16.0, 2.0, 0.5, 12.5)
NAMES = [term.name for term in TERMS]
SHOWN = 10 ** ((-60 + 60 / 32) / 10)  # by the law of SONAR, dB from -60 to 0
ACOUSTIC = [term.name for term in TERMS if not term.of_noise]

pytestmark = pytest.mark.usefixtures("timed_once")  # no test here depends on the times


def room(pitch=0.15, **more):
    """Return a sphere above a level floor, with fields of the scene, and of the sphere's lobe."""
    floor = trimesh.Trimesh([(-30, -30, 0), (30, -30, 0), (30, 30, 0), (-30, 30, 0)], [(0, 1, 2), (0, 2, 3)])
    sphere = trimesh.creation.icosphere(3, 0.4)
    body = {key: more.pop(key) for key in ("specular", "roughness_rad") if key in more}
    bodies = [sg.Body("floor", floor, None, 0.3), sg.Body("sphere", sphere, sg.pose(7, 0.5, 1), 0.8, **body)]
    return sg.Scene(bodies, sg.pose(0, 0, 1.5, 0, pitch), "room", **more)


def priced(scene, *more, **settings):
    """Return Price by name."""
    return {one.name: one for one in price(scene, SONAR, *more, **settings)}


def image_of(ping, acoustics, noise, speckle):
    """Return a ping with its noise; without speckle, the mean of many such pings."""
    if speckle and noise.speckle:
        return np.float64(add_noise(ping, noise, 0).intensity)
    power = sum(10 ** (db / 10) for db in receiver_levels_db(noise, SONAR, acoustics))
    return ping.intensity + power * acoustics.tvg(SONAR.range_m, SONAR)


@pytest.mark.slow
def test_the_mean_of_many_pings_with_noise_is_echo_plus_noise_power():
    scene = room()
    full, noise = everything_on(sg.Acoustics.physical(), sg.Noise.physical())
    noise = replace(noise, self_noise=False, ambient_db=-50.0)
    with sg.Simulator(scene, SONAR, full, tolerance=0.05) as simulator:
        ping = simulator.ping(scene.sonar_pose)
    many = np.mean([np.float64(add_noise(ping, noise, seed).intensity) for seed in range(400)], axis=0)
    mean = image_of(ping, full, noise, speckle=False)
    # the mean of 400 exponential values errs by 5 %; sums over beams and bins err far less
    assert abs(many.sum() / mean.sum() - 1) < 0.01
    assert np.abs(many / mean - 1).mean() == pytest.approx(0.05 * np.sqrt(2 / np.pi), rel=0.1)


def test_every_switch_switches_its_term_off_and_on_again():
    start = sg.Acoustics.physical(), sg.Noise.physical()
    full = everything_on(*start)
    assert everything_on(*full) == full
    for term in TERMS:
        less = without(*full, [term])
        assert less != full and less[term.of_noise is False] == full[term.of_noise is False]
        assert everything_on(*less)[1 if term.of_noise else 0] == full[1 if term.of_noise else 0]
    bare = without(*full, TERMS)
    assert bare[1] == sg.Noise.none()
    # then the settings are those of "ideal", except for the range law, of which only absorption is a term
    clear = sg.Water(absorption_db_m=0.0)
    assert bare[0] == replace(
        sg.Acoustics.ideal(), profile="physical", range_law="sonar_equation", water=clear
    )


def test_settings_of_terms_that_are_on_stay():
    mine = sg.Acoustics.physical(
        beam_pattern="gaussian",
        elevation_pattern="gaussian",
        pulse=True,
        multipath="coherent",
        tvg_k=40.0,
    )
    noise = sg.Noise(speckle=True, looks=3, ambient_db=-70.0)
    assert everything_on(mine, noise) == (mine, noise)
    assert without(mine, noise, TERMS[1:2])[0] == replace(mine, beam_pattern="box")


@pytest.mark.slow
def test_differences_are_those_of_pings_by_hand():
    """Each term's change, from two pings with the same samples, each in a world of its own."""
    scene = room(0.0, surface_z_m=3.0)
    full, noise = everything_on(sg.Acoustics.physical(), sg.Noise.physical())
    with sg.Simulator(scene, SONAR, full, tolerance=0.01) as simulator:
        simulator.plan([scene.sonar_pose])
        sampling = simulator.sampling
    found = priced(scene, 0.01)
    assert list(found) == NAMES
    for term in TERMS:
        images = []
        for acoustics, amounts in ((full, noise), without(full, noise, [term])):
            with sg.Simulator(scene, SONAR, acoustics, sampling, tolerance=0.01) as simulator:
                ping = simulator.ping(scene.sonar_pose)
            images.append(image_of(ping, acoustics, amounts, speckle=term is SPECKLE))
        difference, (full_image, _) = np.abs(images[0] - images[1]), images
        # the power of the noise is float32
        assert found[term.name].changes == pytest.approx(difference.sum() / full_image.sum(), rel=1e-7)
        assert found[term.name].worst_bin == pytest.approx(difference.max() / full_image.max(), rel=1e-7)
        shown = np.maximum(*images) >= SHOWN
        with np.errstate(divide="ignore"):  # bins may have no echo in one of the two
            changed = shown & (np.abs(10 * np.log10(images[0] / images[1])) > 3)
        # pings are float32, so that a bin at exactly 3 dB may fall on either side
        assert found[term.name].changed_bins == pytest.approx(
            changed.sum() / shown.sum(), abs=1 / shown.sum()
        )
    # surface and floor reflect; E|g − 1| of speckle's exponential g is 2/e, here of few strong grains
    assert found["multipath"].changes > 0.003
    assert found["speckle"].changes == pytest.approx(2 / np.e, rel=0.3)


@pytest.mark.slow
def test_a_reflector_that_coarse_samples_hardly_meet_counts():
    """Two faces of the pylons and the water's surface reflect 1.2 % of the echo; samples for 5 % lose one of them.

    Concrete and sand would be too rough to reflect, so that the bodies have no material here.
    """
    scene = without_materials(
        "pylon", {"floor": 70 / 255, "box": 230 / 255, "piles": 120 / 255, "*": 180 / 255}
    )
    sonar = sg.load_sonar("p900-45")
    needed, full, apart = needed_and_full(scene, sonar, 0.01)
    assert needed.multipath == full.multipath == "incoherent" and apart <= 0.01
    # other terms that are left out have a share of the tolerance
    assert sg.needed_acoustics(scene, sonar, 0.03).multipath == "none"


@pytest.mark.slow
def test_no_cost_is_negative(monkeypatch):
    """The clock runs slower and slower, so that pings with a term, which come last, seem to be the fastest."""

    class Clock:
        now_s, calls = 0.0, 0

        def perf_counter(self):
            self.calls += 1
            self.now_s += 1 / self.calls
            return self.now_s

    monkeypatch.setattr(terms, "time", Clock())
    costs = [one.time_ms for one in priced(room()).values()]
    assert min(costs) == 0.0


def test_the_time_of_noise_is_that_of_a_sonar_that_moves(monkeypatch):
    """Place-locked speckle costs nothing at rest, and more where no ping of that seed has been nearby."""
    events = []

    class Clock:
        def perf_counter(self):
            events.append("clock")
            return 0.0

    def noted(ping, noise, seed):
        events.append((seed, tuple(ping.pose.ravel())))
        return add_noise(ping, noise, seed)

    monkeypatch.setattr(terms, "time", Clock())
    monkeypatch.setattr(terms, "add_noise", noted)
    priced(room(), 0.1, timed=("pulse", "speckle", "receiver noise"))
    # between a start and an end
    timed = [n for n, event in enumerate(events) if event != "clock" and events[:n].count("clock") % 2]
    assert len(timed) == 4  # and everything
    for n in timed:
        before = [event for event in events[:n] if event != "clock"]
        assert events[n] not in before
        (seed, pose), (seed_before, pose_before) = events[n], before[-1]
        assert seed == seed_before
        way_m = np.subtract(pose, pose_before).reshape(4, 4)
        assert np.linalg.norm(way_m) == pytest.approx(terms.STEP_M, rel=1e-9)
        assert not way_m[:, :3].any()


@pytest.mark.slow
def test_only_named_terms_are_timed():
    """All are judged, so that what is needed does not depend on the names; each one that is timed makes pings."""
    asked, found = {}, {}
    for timed in (None, (), ("pulse", "bubbles")):  # the room has no bubbles
        events = []
        ask = partial(events.append, "asked")
        found[timed] = priced(room(), 0.1, before_ping=ask, timed=timed)
        asked[timed] = len(events)
    assert asked["pulse", "bubbles"] == asked[()] + 1  # before two pings without the pulse
    acting = sum(one.changes > 0 or one.changed_bins > 0 for one in found[None].values())
    assert asked[None] == asked[()] + acting
    assert all(one.time_ms == 0 for name, one in found["pulse", "bubbles"].items() if name != "pulse")
    for some in found.values():
        assert {name: replace(one, time_ms=0.0) for name, one in some.items()} == found[()]


@pytest.mark.slow
def test_the_pricing_asks_before_each_ping_and_ends_where_that_raises(monkeypatch):
    events, ping, plan = [], sg.Simulator.ping, sg.Simulator.plan

    def noted(name, call):
        return lambda *values, **more: (events.append(name), call(*values, **more))[1]

    monkeypatch.setattr(sg.Simulator, "ping", noted("ping", ping))
    monkeypatch.setattr(sg.Simulator, "plan", noted("plan", plan))
    price(room(), SONAR, 0.1, before_ping=lambda: events.append("asked"))
    # of the two pings of a turn the first only warms the caches; both are one piece of work
    assert events[:4] == ["asked", "plan", "asked", "ping"]
    assert all(what != "ping" or "asked" in events[k - 2 : k] for k, what in enumerate(events))

    events.clear()

    def stop():
        if events.count("ping") == 3:
            raise KeyError("enough")

    with pytest.raises(KeyError, match="enough"):
        price(room(), SONAR, 0.1, before_ping=stop)
    assert events.count("ping") == 3


@pytest.mark.slow
def test_the_transmit_beam_of_a_sonar_that_has_one_is_priced():
    """The two-way beam of a fan of 40 degrees is down by 12 dB and more at its edges."""
    narrow = replace(SONAR, transmit_width_deg=20.0)
    found = {one.name: one for one in price(room(), narrow, 0.05)}["transmit beam"]
    assert found.changes > 0.1 and found.on
    assert needed_acoustics(room(), narrow, 0.05).transmit_beam
    assert not needed_acoustics(room(), SONAR, 0.05).transmit_beam


STATED = replace(
    SONAR, ring_down_db=10.0, ring_down_decay_db_m=40.0, common_noise_db=-70.0, common_noise_width_deg=4.0
)


@pytest.mark.slow
def test_what_sonar_and_noise_state_is_priced_by_itself():
    """By hand: each adds its power to an image that has everything else; a lost beam is black."""
    scene, noise = room(), replace(sg.Noise.physical(), dropped_beams=0.1)
    found = {one.name: one for one in price(scene, STATED, 0.05, noise=noise)}
    assert list(found) == [*NAMES, "ring-down", "centre streak", "dropped beams"]
    full = everything_on(sg.Acoustics.physical(), noise)[0]
    with sg.Simulator(scene, STATED, full, tolerance=0.05) as simulator:
        simulator.plan([scene.sonar_pose])
        ping = simulator.ping(scene.sonar_pose)
    tvg = full.tvg(SONAR.range_m, SONAR)
    streak = np.outer(common_noise_pattern(SONAR.azimuth_rad, 4.0), 10**-7.0 * tvg)
    ringing = np.tile(10 ** (1.0 - 4.0 * SONAR.range_m) * tvg, (SONAR.n_beams, 1))
    image = ping.intensity + 10**-9.0 * tvg + streak + ringing
    for name, power in (("ring-down", ringing), ("centre streak", streak)):
        assert found[name].changes == pytest.approx(power.sum() / image.sum(), rel=1e-6)
        assert found[name].worst_bin == pytest.approx(power.max() / image.max(), rel=1e-6)
    stay = np.ones(32, bool)
    stay[[5, 16, 26]] = False  # 0.1 of 32 beams, evenly apart
    lost, shown = found["dropped beams"], image >= SHOWN
    assert lost.changes == pytest.approx(image[~stay].sum() / image[stay].sum(), rel=1e-6)
    assert lost.changed_bins == pytest.approx(shown[~stay].sum() / shown.sum()) and lost.on
    together = found["ring-down"].changes + found["centre streak"].changes
    assert found["receiver noise"].changes > together  # which are parts of it


@pytest.mark.slow
def test_what_is_stated_changes_no_other_price():
    scene, noise = room(), replace(sg.Noise.physical(), dropped_beams=0.3)
    plain = price(scene, SONAR, 0.05)
    found = price(scene, SONAR, 0.05, noise=noise)
    assert [replace(one, time_ms=0.0) for one in found[: len(TERMS)]] == [
        replace(one, time_ms=0.0) for one in plain
    ]
    assert [one.name for one in found[len(TERMS) :]] == ["dropped beams"]
    # a sonar's ring-down is part of its own noise
    assert [one.name for one in price(scene, STATED, 0.05, noise=sg.Noise(ambient_db=-90.0))] == NAMES


@pytest.mark.slow
def test_terms_without_anything_to_act_on_change_and_cost_nothing():
    found = priced(room())
    for name in ("specular lobes", "bubbles"):
        measures = found[name].changes, found[name].worst_bin, found[name].changed_bins
        assert (*measures, found[name].time_ms) == (0, 0, 0, 0)
        assert found[name].on is False
    shiny = priced(room(specular=0.5, roughness_rad=0.05))["specular lobes"]
    assert shiny.changes > 0.01 and shiny.on and shiny.worst_bin > 0.1
    sphere = sg.Scene(room().bodies[1:], room().sonar_pose)  # curved everywhere: no planar reflector
    assert priced(sphere)["multipath"] == type(shiny)("multipath", 0.0, 0.0, 0.0, 0.0, False)


@pytest.mark.slow
def test_absorption_acts_through_the_noise_that_the_tvg_amplifies():
    """A right TVG cancels absorption in the echo; a TVG of fixed absorption does not."""
    scene = room()
    assert priced(scene, noise=sg.Noise(speckle=True, ambient_db=-300.0))["absorption"].changes < 1e-6
    wrong = sg.Acoustics.physical(tvg_absorption_db_m=0.0)
    changes = priced(scene, acoustics=wrong)["absorption"].changes
    assert changes > 1  # 0.35 dB/m, both ways, over some 10 m: without it most echoes are twice as strong


@pytest.mark.slow
def test_of_several_poses_the_largest_change_counts():
    scene = room()
    poses = [scene.sonar_pose, sg.pose(0, 0, 1.5, 0, 0.15, np.pi), sg.pose(3, 0, 1.5, 0, 0.3)]
    single = [priced(scene, poses=[pose]) for pose in poses]
    together = priced(scene, poses=poses)
    for name in ("azimuth pattern", "elevation pattern", "pulse"):
        # all three share the samples that the most demanding one needs
        most = max(one[name].changes for one in single)
        assert together[name].changes == pytest.approx(most, rel=0.05)


def test_a_bin_changes_if_a_display_shows_another_tone():
    law = sg.Counts(low_db=-64.0)  # a display is black up to -62 dB
    ratio = 10 ** (np.array([-3.1, -2.9, 0.0, 2.9, 3.1]) / 10)
    for level_db, share in ((-61.0, 2 / 5), (-62.5, 1 / 2), (-66.0, 0.0)):
        full = np.full((1, 5), 10 ** (level_db / 10))
        # at -62.5 dB two of the other image's bins alone are brighter than black; one of them changes by more than 3 dB
        assert changed_bins(full, full * ratio, law) == changed_bins(full * ratio, full, law) == share
    appears, black = np.full((1, 4), 10**-6.1), np.zeros((1, 4))
    assert changed_bins(appears, black, law) == changed_bins(black, appears, law) == 1.0
    assert changed_bins(black, black, law) == 0.0
    # automatic gain brings the level of each image to full scale: both are shown, and differ by 20 dB
    faint = sg.Counts(low_db=-40.0, gain_percentile=99.0)
    assert changed_bins(100 * appears, appears, faint) == 1.0
    assert changed_bins(100 * appears, appears, replace(faint, gain_percentile=None)) == 0.0


@pytest.mark.slow
def test_a_term_that_changes_the_display_is_needed_however_little_echo_it_changes():
    """A right TVG leaves absorption in the noise alone, which fills the empty half of the image."""
    scene, sonar = sg.load_scene("diver_vertical"), sg.load_sonar("p900-45,self_noise_db=-75").with_range(8.0)
    (absorption,) = [one for one in price(scene, sonar, 0.05) if one.name == "absorption"]
    assert absorption.changes < 0.003 and absorption.changed_bins > 0.1 and absorption.on
    assert sg.needed_acoustics(scene, sonar, 0.05).water.absorption_db_m is None


def needed_and_full(scene, sonar, tolerance):
    """Return the needed acoustics, those with everything on, and the share by which their pings differ."""
    needed = sg.needed_acoustics(scene, sonar, tolerance)
    full, _ = everything_on(sg.Acoustics.physical(), sg.Noise.physical())
    with sg.Simulator(scene, sonar, full, tolerance=tolerance) as simulator:
        simulator.plan([scene.sonar_pose])
        full_ping = simulator.ping(scene.sonar_pose)
        with sg.Simulator(simulator, sonar, needed, simulator.sampling, tolerance) as other:
            needed_ping = other.ping(scene.sonar_pose)
    return needed, full, differs(full_ping.intensity, needed_ping.intensity)[0]


@pytest.mark.slow
@pytest.mark.parametrize(
    "name, tolerance",
    [
        ("pylon", 0.02),
        *(
            pytest.param(*case, marks=pytest.mark.slow)
            for case in (("pylon", 0.15), ("diver", 0.15), ("diver_vertical", 0.3), ("ocean_floor", 0.02))
        ),
    ],
)
def test_the_image_changes_by_no_more_than_the_tolerance(name, tolerance):
    scene, sonar = sg.load_scene(name), replace(sg.load_sonar("p900-45"), n_bins=500)
    needed, full, share = needed_and_full(scene, sonar, tolerance)
    # changes are measured with the samples of the tolerance, and err as those do
    assert share <= 1.1 * tolerance
    assert needed != full  # each scene lacks something: bubbles, or a noise that counts


@pytest.mark.slow
def test_small_terms_are_left_out_only_as_far_as_all_of_them_together_stay_small():
    scene, left = room(0.0, surface_z_m=3.0), 0
    for tolerance in (0.006, 0.05, 0.3):
        found = priced(scene, tolerance).values()
        on, off = (
            [max(one.changes, one.changed_bins) for one in found if one.on is state]
            for state in (True, False)
        )
        assert max(off) <= min(on) and max(off) <= tolerance
        *_, share = needed_and_full(scene, SONAR, tolerance)
        assert share <= 1.1 * tolerance
        assert len(off) >= left
        left = len(off)
    assert left >= 5 and any(changes > 0 for changes in off)


@pytest.mark.slow
def test_needed_acoustics_are_reproducible():
    scene = room(surface_z_m=3.0)
    first = sg.needed_acoustics(scene, SONAR, 0.05)
    assert (
        sg.needed_acoustics(scene, SONAR, 0.05)
        == first
        == needed_acoustics(scene, SONAR, 0.05, [scene.sonar_pose])
    )
    assert sg.needed_acoustics(scene, SONAR, 0.05, scene.sonar_pose) == first
    on = {one.name for one in price(scene, SONAR, 0.05) if one.on}
    assert (first.multipath != "none") == ("multipath" in on)
    assert (first.beam_pattern != "box") == ("azimuth pattern" in on)
    assert first.pulse == ("pulse" in on)
    assert first.profile == "physical" and first.tvg_k == 20


def test_mistakes():
    without_sonar = sg.Scene(room().bodies)
    for function in (price, sg.needed_acoustics):
        with pytest.raises(Error, match="scene 'scene' has no sonar in it; give a pose"):
            function(without_sonar, SONAR)
        with pytest.raises(Error, match="tolerance must be a number"):
            function(room(), SONAR, 0.7)
        with pytest.raises(Error, match="poses must hold at least one pose"):
            function(room(), SONAR, 0.1, [])
        for poses in (3, np.array(3.0)):
            with pytest.raises(Error, match="poses must be several poses"):
                function(room(), SONAR, 0.1, poses)
        for poses in ({0: np.eye(4)}, {1}, [np.zeros(3), np.eye(3)]):
            with pytest.raises(Error, match=r"pose must have shape \(4, 4\) \(got"):
                function(room(), SONAR, 0.1, poses)
    with pytest.raises(Error, match="of a position and a quaternion, fill"):
        sg.needed_acoustics(room(), SONAR, 0.1, ((0, 0, 0), (0, 0, 0, 1)))
    assert sg.needed_acoustics(without_sonar, SONAR, 0.1, room().sonar_pose).profile == "physical"


@pytest.mark.filterwarnings("ignore:no echo came back")
def test_a_scene_without_echo_needs_no_term():
    found = price(sg.Scene([], sg.pose()), SONAR, noise=sg.Noise(speckle=True, ambient_db=-300.0))
    assert not any(one.changes for one in found if one.name in ACOUSTIC and one.name != "absorption")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("needed,tvg_k=3", "needed takes no other settings"),
        ("", "must be key=value"),
        ("tvg_k=3,", "must be key=value"),
    ],
)
def test_acoustics_of_a_command_line_that_are_wrong(text, message):
    with pytest.raises(sg.Error, match=message):
        sg.Acoustics.parse(text)


def test_terms_without_which_there_is_no_echo_are_priced_without_a_warning():
    """Within 3.5 m side lobes see the floor; the box beams of `ideal` see nothing."""
    scene = sg.load_scene("pylon")
    sonar = replace(sg.load_sonar("p900-45").with_range(3.5), n_beams=16, n_bins=32)
    no_echo = pytest.warns(UserWarning, match="no echo came back: the nearest surface in the fan lies at")
    with sg.Simulator(scene, sonar, sg.Acoustics.ideal()) as simulator, no_echo:
        simulator.ping(scene.sonar_pose)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        sg.needed_acoustics(scene, sonar, tolerance=0.05)
