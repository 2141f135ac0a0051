"""Axes: margin, arcs, spokes and labels of a fan image."""

import numpy as np
import pytest

from sonar_gl.core.errors import Error
from sonar_gl.imaging.axes import draw_axes
from sonar_gl.imaging.fan_image import colorize, fan_geometry, fan_image
from tests.support.fan_ping import fan_ping


def pixels(ping, margin, azimuth_deg, range_m):
    """Return (rows, columns) on the canvas of axes about a fan image 300 pixels high."""
    columns, rows = fan_geometry(ping, 300).pixel(np.radians(azimuth_deg), np.asarray(range_m))
    return np.rint(rows).astype(int) + margin, np.rint(columns).astype(int) + margin


@pytest.mark.parametrize("fov_deg", [1, 20, 90, 180, 270, 360])
def test_margin_with_labels(fov_deg):
    ping = fan_ping(fov_deg, range_m=(1.0, 27.0), fill=0.01)
    picture = colorize(fan_image(ping, 300), "viridis")
    before = picture.copy()
    drawn = draw_axes(picture, ping)
    assert (picture == before).all()
    margin = (drawn.shape[0] - 300) // 2
    assert margin > 20 and drawn.shape == (300 + 2 * margin, picture.shape[1] + 2 * margin, 3)
    assert drawn[:margin].any()


@pytest.mark.parametrize("fov_deg, azimuth_deg", [(20, 3), (90, 22), (180, 22), (270, 22), (360, 22)])
def test_between_lines_the_picture_stays(fov_deg, azimuth_deg):
    ping = fan_ping(fov_deg, range_m=(1.0, 27.0), fill=0.01)
    picture = colorize(fan_image(ping, 300), "viridis")
    drawn = draw_axes(picture, ping)
    margin = (drawn.shape[0] - 300) // 2
    rows, columns = pixels(ping, margin, azimuth_deg, [7, 12, 17, 22])
    assert (drawn[rows, columns] == picture[rows - margin, columns - margin]).all()


def test_arcs_and_spokes():
    """On a black fan of 90° and 27 m: arcs each 5 m and at the rim, spokes each 15°."""
    ping = fan_ping(90, range_m=(1.0, 27.0))
    drawn = draw_axes(np.zeros((*fan_image(ping, 300).shape, 3), np.uint8), ping).max(axis=2)
    margin = (drawn.shape[0] - 300) // 2
    assert (drawn[pixels(ping, margin, 7.5, [5, 10, 15, 20, 25, 27])] > 40).all()
    assert not drawn[pixels(ping, margin, 7.5, [2.5, 7.5, 12.5, 17.5, 22.5, 26])].any()
    spokes = np.arange(-45, 46, 15)
    assert (drawn[pixels(ping, margin, spokes, 12.5)] > 40).all()
    assert not drawn[pixels(ping, margin, spokes[:-1] + 7.5, 12.5)].any()


def test_outside_the_fan_it_is_black():
    ping = fan_ping(60, range_m=(5.0, 20.0), fill=1.0)
    drawn = draw_axes(np.full((300, 300, 3), 200, np.uint8), ping)
    margin = (len(drawn) - 300) // 2
    assert not drawn[pixels(ping, margin, [0, 0, 40], [3.0, 4.5, 10.0])].any()


def test_pictures_of_other_fans():
    ping = fan_ping(60)
    with pytest.raises(Error) as caught:
        draw_axes(np.zeros((100, 90, 3), np.uint8), ping)
    assert str(caught.value) == (
        "draw_axes needs the (H, W, 3) uint8 picture of this ping's fan image, here (100, 100, 3) "
        "(got (100, 90, 3), uint8)"
    )
    with pytest.raises(Error, match=r"fan image \(got \(100, 100\), float64\)"):
        draw_axes(np.zeros((100, 100)), ping)
