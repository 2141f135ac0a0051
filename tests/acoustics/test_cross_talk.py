"""Cross-talk: closed forms of a single bright beam and of an even fan, in the function and in pings."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
import trimesh

import sonar_gl as sg
from sonar_gl.acoustics.cross_talk import leak_between_beams
from sonar_gl.core.errors import Error

EPSILON = np.finfo(np.float32).eps
SONAR = sg.Sonar("sets", 1800e3, 48, 100, 29.0, 14.0, 0.6, 0.5, 5.5, cross_talk_db=-20.0, cross_talk_beams=8)


def test_a_bright_beam_shows_in_its_set_alone():
    bright = np.zeros((48, 3), np.float32)
    bright[19] = 1, 10, 100
    out = leak_between_beams(bright, -20.0, 8)
    same_set = np.arange(48) % 8 == 19 % 8
    assert (out[~same_set] == 0).all()
    expected = np.full((6, 1), 0.01 / 1.05) * bright[19]  # 6 beams share: 1 + 5 x 0.01
    expected[2] = bright[19] / 1.05
    np.testing.assert_allclose(out[same_set], expected, rtol=4 * EPSILON)


@pytest.mark.parametrize("n_beams", [1, 7, 8, 9, 47, 768])
@pytest.mark.parametrize("spacing", [1, 3, 8, 1000])
def test_each_bin_keeps_its_sum_and_an_even_echo_its_level(n_beams, spacing):
    """Also where the sets have different numbers of beams."""
    echo = np.random.default_rng(1).exponential(size=(n_beams, 5)).astype(np.float32)
    out = leak_between_beams(echo, -10.0, spacing)
    # sums of up to 768 float32 terms, pairwise at best: their rounding errors grow with the number at most
    np.testing.assert_allclose(out.sum(0, np.float64), echo.sum(0, np.float64), rtol=n_beams * EPSILON)
    even = leak_between_beams(np.full((n_beams, 2), 0.5, np.float32), -10.0, spacing)
    np.testing.assert_allclose(even, 0.5, rtol=n_beams * EPSILON)
    if spacing >= n_beams:
        assert (out == echo).all()


def ping_of(sonar, acoustics=None, **request):
    ball = sg.Body("ball", trimesh.creation.icosphere(3, 0.1), sg.pose(3.0, 0.0, 0.0))
    with sg.Simulator(sg.Scene([ball]), sonar, acoustics, tolerance=0.05) as simulator:
        return simulator.ping(np.eye(4), **request)


def test_the_ping_of_a_ball_has_copies_in_its_sets_and_labels_and_energy_as_without():
    # without far side lobes, which receive the ball in all beams
    acoustics = sg.Acoustics.physical(far_side_lobes=False)
    plain = ping_of(SONAR, replace(acoustics, cross_talk=False), labels=True)
    ping = ping_of(SONAR, acoustics, labels=True)
    assert ping.acoustics.cross_talk and not ping.intensity.flags.writeable
    np.testing.assert_array_equal(ping.intensity, leak_between_beams(plain.intensity, -20.0, 8))
    beam, bin_ = np.unravel_index(plain.intensity.argmax(), plain.intensity.shape)
    others = [b for b in range(beam % 8, 48, 8) if b != beam]
    dark = plain.intensity[others, bin_] == 0
    ratio = ping.intensity[others, bin_][dark] / ping.intensity[beam, bin_]
    assert dark.sum() >= 3
    np.testing.assert_allclose(ratio, 0.01, rtol=1e-4)  # but for the two weak beams beside the ball's own
    np.testing.assert_array_equal(ping.body_id, plain.body_id)
    assert ping.body_echo.sum() == pytest.approx(ping.intensity.sum(dtype=np.float64), rel=1e-4)


def test_what_leaks_over_a_body_is_no_echo_of_it():
    """A faint ball, in a beam of the set in which a bright one lies, at its range."""
    aside = sg.pose(3.0 * np.cos(SONAR.azimuth_rad[32]), 3.0 * np.sin(SONAR.azimuth_rad[32]), 0.0)
    ahead = sg.pose(3.0 * np.cos(SONAR.azimuth_rad[24]), 3.0 * np.sin(SONAR.azimuth_rad[24]), 0.0)
    mesh, pings = trimesh.creation.icosphere(3, 0.1), []
    scene = sg.Scene([sg.Body("bright", mesh, ahead, 0.9), sg.Body("faint", mesh, aside, 1e-4)])
    for is_on in (False, True):
        acoustics = replace(sg.Acoustics.ideal(), cross_talk=is_on)
        with sg.Simulator(scene, SONAR, acoustics, tolerance=0.05) as simulator:
            pings.append(simulator.ping(np.eye(4), labels=True, label_level_db=-180.0))
    plain, leaky = pings
    np.testing.assert_array_equal(leaky.body_id, plain.body_id)
    own, lifted = (
        plain.share * plain.intensity,
        (plain.body_id == 2) & (leaky.intensity > 10 * plain.intensity),
    )
    assert lifted.any()
    # a beam keeps at least 0.94 of its echo
    np.testing.assert_allclose((leaky.share * leaky.intensity)[lifted], own[lifted], rtol=0.06)


def test_it_is_off_without_a_level_and_by_profile():
    level = replace(SONAR, cross_talk_db=None)
    np.testing.assert_array_equal(
        ping_of(level).intensity, ping_of(SONAR, sg.Acoustics.physical(cross_talk=False)).intensity
    )
    assert not sg.Acoustics.ideal().cross_talk and not sg.Acoustics.demarco2015().cross_talk


@pytest.mark.slow
def test_speckle_of_copies_is_fully_developed():
    """Cross-talk mixes mean powers; each bin's power is then exponential, as that of a sum of fields is."""
    n = 400
    ping = ping_of(SONAR)
    beam, bin_ = np.unravel_index(ping.intensity.argmax(), ping.intensity.shape)
    copy = beam % 8
    mean = ping.intensity[copy, bin_]
    with sg.Simulator(
        sg.Scene([sg.Body("ball", trimesh.creation.icosphere(3, 0.1), sg.pose(3.0, 0.0, 0.0))]),
        SONAR,
        tolerance=0.05,
    ) as simulator:
        noise = sg.Noise(speckle=True)
        powers = np.array([simulator.ping(np.eye(4), noise, seed=s).intensity[copy, bin_] for s in range(n)])
    # 5 standard errors: of the mean 1/sqrt(n), of the contrast 1/sqrt(n) for exponential values
    assert powers.mean() / mean == pytest.approx(1, abs=5 / np.sqrt(n))
    assert powers.std() / powers.mean() == pytest.approx(1, abs=5 / np.sqrt(n))


def test_motion_comes_before_cross_talk():
    velocity = (0, 0, 0, 0, 0, 2.0)
    plain = ping_of(SONAR, sg.Acoustics.physical(cross_talk=False), velocity=velocity)
    moving = ping_of(SONAR, velocity=velocity)
    np.testing.assert_array_equal(moving.intensity, leak_between_beams(plain.intensity, -20.0, 8))


def test_interleaved_presets_name_their_transmissions():
    sets = {s.name: (s.n_beams, s.cross_talk_beams) for s in map(sg.load_sonar, ("aris-3000", "didson-hf"))}
    assert sets == {"aris-3000": (128, 8), "didson-hf": (96, 8)}
    assert sg.load_sonar("didson-lf").cross_talk_beams == 4
    assert sg.load_sonar("p900-45").cross_talk_db is None
    assert sg.load_sonar("p900-45,cross_talk_db=-30,cross_talk_beams=6").cross_talk_beams == 6
    assert sg.load_sonar("didson-hf,cross_talk_db=none").cross_talk_db is None


def test_sets_of_one_beam_are_warned_of():
    """They have no cross-talk, whatever its level."""
    with pytest.warns(UserWarning) as caught:
        sonar = replace(SONAR, cross_talk_beams=48)
    assert [str(one.message) for one in caught] == [
        "sonar 'sets': cross_talk_beams = 48 leaves 48 beams without cross-talk; give fewer than 48, the number of "
        "transmissions a frame, or set no cross_talk_db"
    ]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        replace(sonar, cross_talk_beams=47)
        replace(sonar, cross_talk_db=None)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"cross_talk_db": 3.0}, "cross_talk_db must lie in .*not above 0"),
        ({"cross_talk_db": "much"}, "cross_talk_db must be a number"),
        ({"cross_talk_beams": 0}, "cross_talk_beams must be a whole number"),
        ({"cross_talk_beams": 2.5}, "cross_talk_beams must be a whole number"),
    ],
)
def test_wrong_numbers_are_named(change, words):
    with pytest.raises(Error, match=words):
        replace(SONAR, **change)


def test_beams_that_no_other_is_received_with_keep_their_echo():
    """Five beams in three transmissions: 0 with 3, 1 with 4, and 2 alone."""
    intensity = np.diag(np.float32([3, 6, 9, 12, 15]))
    found = leak_between_beams(intensity, 10 * np.log10(0.5), 3)
    shared = [[2, 0, 0, 4, 0], [0, 4, 0, 0, 5], [0, 0, 9, 0, 0], [1, 0, 0, 8, 0], [0, 2, 0, 0, 10]]
    np.testing.assert_allclose(found, shared, rtol=4 * 2**-24)  # float32
