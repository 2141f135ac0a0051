"""Styles: the pictures of pings as fan images and as the founding paper's."""

import warnings
from dataclasses import fields, replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

import sonar_gl as sg
from sonar_gl.imaging.styles import DARK_BLUE, DemarcoStyle, FanStyle, shows_echo, what_lacks_16_bits
from tests.support.fan_ping import fan_ping


@pytest.mark.parametrize("axes", [False, True])
def test_fan_style(axes):
    ping = fan_ping(60)
    ping.intensity[:] = np.random.default_rng(0).random(ping.intensity.shape)
    law = sg.Counts("power", gain_percentile=90)
    sonar = sg.Sonar("mine", 1800e3, *ping.intensity.shape, 60.0, 14.0, 0.3, 0.4, 5.4, counts=law)
    ping = replace(ping, sonar=sonar)
    expected = sg.colorize(sg.fan_image(ping, 90, law), "hot")
    expected = sg.draw_axes(expected, ping, "hot", law) if axes else expected
    assert (FanStyle(90, "hot", axes)(ping) == expected).all()


def test_a_notebook_shows_the_picture_of_a_ping():
    ping = fan_ping(60)
    ping.intensity[:] = np.random.default_rng(0).random(ping.intensity.shape)
    picture = sg.draw_axes(sg.colorize(sg.fan_image(ping, 500), "copper"), ping, "copper")
    shown = cv2.imdecode(np.frombuffer(ping._repr_png_(), np.uint8), cv2.IMREAD_COLOR)
    np.testing.assert_array_equal(shown[..., ::-1], picture)
    assert sg.Ping(None, None, None)._repr_png_() is None  # a notebook shows its text


@pytest.mark.parametrize(
    ("colormap", "axes", "setting"),
    [
        ("gray", False, None),
        ("gray", True, "axes"),
        ("hot", False, "colormap hot"),
        ("hot", True, "colormap hot"),
    ],
)
def test_pictures_in_gray_without_axes_have_place_for_16_bits(colormap, axes, setting):
    style = FanStyle(90, colormap, axes)
    assert style.setting_of_8_bits == setting
    assert style.holds_16_bits(sg.Counts(bits=16)) == (setting is None)
    assert not style.holds_16_bits(sg.Counts(bits=8))
    assert what_lacks_16_bits(style, ["npz"]) is None  # a file of intensities
    for formats in (["png"], ["npz", "png"]):
        assert what_lacks_16_bits(style, formats) == setting
    assert what_lacks_16_bits(style, ["png", "mp4"]) == "format mp4"


def test_a_founding_papers_picture_shows_an_echo_where_it_is_neither_dark_blue_nor_black():
    without, echoes = [(0, 0, 0), (0, 0, DARK_BLUE)], [(0, 0, 255), (0, 4, DARK_BLUE), (4, 0, DARK_BLUE)]
    picture = np.array([without + echoes], np.uint8)
    assert shows_echo(picture).tolist() == [[False, False, True, True, True]]


def test_unknown_colour_map():
    with pytest.raises(sg.Error, match=r"unknown colour map \(got 'jett'; did you mean 'jet'\?\)"):
        FanStyle(90, "jett", False)


def test_demarco_style_counts_seeds():
    """The picture of ping n has the seed + n, and the ping's pose alone."""
    pose, poses = sg.pose(1.0), []

    def point_cloud(pose, columns, rows):
        poses.append(pose)
        rng = np.random.default_rng(0)
        points = rng.uniform((1, -2, -1), (8, 2, 1), (rows, columns, 3)).astype(np.float32)
        return points, rng.random((rows, columns), np.float32)

    sonar = sg.Sonar("small", 900e3, 16, 20, 60.0, 20.0, 1.0, 0.5, 10.0)
    simulator = SimpleNamespace(sonar=sonar, acoustics=sg.Acoustics.demarco2015(), point_cloud=point_cloud)
    noise = sg.Noise.demarco2015()
    picture = DemarcoStyle(80, "isotropic", "polygons", noise, 5)(
        simulator, sg.Ping(*3 * [None], pose=pose), 2
    )
    expected = sg.demarco_image(simulator, pose, 7, noise, 80, "isotropic", "polygons")
    assert (picture == expected).all() and all(given is pose for given in poses)


def test_the_founding_papers_picture_needs_a_simulator():
    with pytest.raises(sg.Error, match=r"simulator must be a Simulator \(got Scene; "):
        sg.demarco_image(sg.Scene([]), sg.pose())


IN_THE_PAPER = {"salt_and_pepper", "median", "cloud_gaussian_m"}  # noise that its picture has
CHANGES_ANOTHER = {"looks", "follow_motion", "interference_db"}  # nothing without another term
AMOUNTS = {"ambient_db": -90.0, "gaussian": 0.1, "dropped_beams": 0.1}  # others are 1, or on


def test_demarco_style_warns_of_each_term_of_noise_that_it_lacks():
    for name in {field.name for field in fields(sg.Noise)} - IN_THE_PAPER - CHANGES_ANOTHER:
        default = getattr(sg.Noise(), name)
        noise = sg.Noise(**{name: AMOUNTS.get(name, True if default is False else 1)})
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            DemarcoStyle(80, "isotropic", "circles", noise, 0)
        assert caught, f"DemarcoStyle must warn of {name}, or the paper's picture has it (IN_THE_PAPER)"


@pytest.mark.parametrize(
    ("noise", "missing"),
    [
        (sg.Noise(speckle=True), ["speckle and no gaussian noise"]),
        (sg.Noise(gaussian=0.1), ["speckle and no gaussian noise"]),
        (sg.Noise(ambient_db=-90.0), ["receiver noise and no interference"]),
        (sg.Noise(interference_lines=1), ["receiver noise and no interference"]),
        (sg.Noise(dropped_beams=0.1), ["dropped beams"]),
        (sg.Noise.physical(), ["speckle and no gaussian noise", "receiver noise and no interference"]),
        (sg.Noise.demarco2015(), []),
    ],
)
def test_demarco_style_warns_of_noise_that_it_lacks(noise, missing):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        DemarcoStyle(80, "isotropic", "circles", noise, 0)
    expected = [f"pictures of style demarco2015 have no {what}" for what in missing]
    assert [str(warning.message) for warning in caught] == expected
    assert all(warning.filename == __file__ for warning in caught)
