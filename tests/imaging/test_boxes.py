"""Boxes and maps of bodies, compared with plain NumPy over each body's bins and pixels."""

import math
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
import trimesh

import sonar_gl as sg
from sonar_gl.imaging.boxes import body_map, boxes_of
from sonar_gl.imaging.fan_image import fan_geometry
from tests.support.fan_ping import fan_ping


def labelled(body_id, fov_deg=60.0, azimuth_rad=None, n_bodies=None):
    """Return a ping of silent bins from 2 to 10 m with these labels; body n has the echo 1.5 n."""
    ping = fan_ping(fov_deg, *body_id.shape, range_m=(2.0, 10.0), azimuth_rad=azimuth_rad)
    n_bodies = int(body_id.max()) if n_bodies is None else n_bodies
    return replace(ping, body_id=np.asarray(body_id, np.uint16), body_echo=np.arange(n_bodies + 1) * 1.5)


def blocks(rng, shape, n_bodies):
    """Return body numbers (B, K) in blocks that overlap."""
    out = np.zeros(shape, int)
    for body in rng.permutation(n_bodies) + 1:
        b, k = rng.integers(0, shape[0]), rng.integers(0, shape[1])
        out[b : b + rng.integers(1, 9), k : k + rng.integers(1, 20)] = body
    return out


@pytest.mark.parametrize(
    "fov_deg, n_bodies",
    [
        *product([60.0, 200.0, 360.0], [1, 7]),
        (60.0, 400),
        *(pytest.param(fov_deg, 400, marks=pytest.mark.slow) for fov_deg in (200.0, 360.0)),
    ],
)
def test_boxes_enclose_each_body(n_bodies, fov_deg):
    ping = labelled(
        blocks(np.random.default_rng(n_bodies), (90, 150), n_bodies), fov_deg, n_bodies=n_bodies + 3
    )
    boxes, bodies = boxes_of(ping, 500), body_map(ping, 500)
    assert bodies.shape == sg.fan_image(ping, 500).shape and bodies.dtype == np.uint16
    assert boxes.body_id.tolist() == sorted(set(ping.body_id.flat) - {0})
    without_pixels = 0
    for n, body in enumerate(boxes.body_id):
        b, k = np.nonzero(ping.body_id == body)
        assert boxes.beams[n].tolist() == [b.min(), b.max()]
        assert boxes.bins[n].tolist() == [k.min(), k.max()]
        assert boxes.n_bins[n] == len(b)
        assert boxes.energy[n] == 1.5 * body
        rows, columns = np.nonzero(bodies == body)
        if len(rows) == 0:  # its bins lie between pixels
            without_pixels += 1
            assert boxes.pixels[n, 2:].tolist() == [1, 1]
            continue
        size = np.ptp(columns) + 1, np.ptp(rows) + 1
        assert boxes.pixels[n].tolist() == [columns.min(), rows.min(), *size]
    assert without_pixels <= len(boxes.body_id) // 10


UNEVEN_RAD = np.radians([-30.0, -25.0, -13.0, -5.0, 1.0, 12.0, 20.0, 33.0])


@pytest.mark.parametrize(
    "fov_deg, azimuth_rad", [(60.0, None), (250.0, None), (360.0, None), (70.0, UNEVEN_RAD)]
)
def test_the_map_agrees_with_the_fan_image(fov_deg, azimuth_rad):
    """Each bin has its own number, which the pixel at its middle shows."""
    ping = labelled(1 + np.arange(8 * 12).reshape(8, 12), fov_deg, azimuth_rad)
    geometry, bodies = fan_geometry(ping, 600), body_map(ping, 600)
    assert set(bodies.flat) == {0, *ping.body_id.flat}
    columns, rows = geometry.pixel(ping.azimuth_rad[:, None], ping.range_m)
    found = bodies[np.rint(rows).astype(int), np.rint(columns).astype(int)]
    np.testing.assert_array_equal(found, ping.body_id)
    # port on the left: the last beam's bins lie left of the first one's
    port, starboard = (np.nonzero(bodies == ping.body_id[b, 5])[1].mean() for b in (-1, 0))
    assert port < starboard or fov_deg == 360.0
    # as many pixels as the fan's area has, but for rounding along its rim
    low, high = geometry.azimuth_edges_rad
    area = (high - low) / 2 * (10.0**2 - 2.0**2) * geometry.pixels_per_m**2
    assert (bodies > 0).sum() == pytest.approx(area, rel=0.01)


def test_a_body_between_pixels_has_one():
    """In a picture much coarser than the bins the box is the pixel at the body."""
    body_id = np.zeros((300, 800), int)
    body_id[200, 333] = 2
    ping = labelled(body_id, n_bodies=2)
    boxes, bodies = boxes_of(ping, 40), body_map(ping, 40)
    assert boxes.body_id.tolist() == [2] and boxes.n_bins.tolist() == [1]
    column, row = fan_geometry(ping, 40).pixel(ping.azimuth_rad[200], ping.range_m[333])
    assert not (bodies == 2).any()
    assert boxes.pixels.tolist() == [[round(float(column)), round(float(row)), 1, 1]]


def test_boxes_of_a_simulated_ping():
    """The box of a ball encloses its bright pixels in the fan image."""
    ball = sg.Body("ball", trimesh.creation.icosphere(3, 0.4), sg.pose(6, 1, 0))
    away = sg.Body("away", trimesh.creation.icosphere(2, 0.4), sg.pose(-6, 1, 0))
    sonar = sg.Sonar("test", 900e3, 64, 200, 60.0, 20.0, 1.5, 0.5, 10.0)
    with sg.Simulator(sg.Scene([away, ball]), sonar, sg.Acoustics.ideal(), sg.Sampling(2, 60)) as simulator:
        ping = simulator.ping(np.eye(4), labels=True)
    boxes, image = boxes_of(ping, 400), sg.fan_image(ping, 400)
    assert boxes.body_id.tolist() == [2]
    left, top, width, height = boxes.pixels[0]
    inside = np.zeros(image.shape, bool)
    inside[top : top + height, left : left + width] = True
    assert image[inside].max() == image.max() and image[~inside].max() < 0.9 * image.max()
    assert boxes.energy[0] == ping.body_echo[2] > 0
    middle = math.atan2(1, 6)
    assert ping.azimuth_rad[boxes.beams[0, 0]] < middle < ping.azimuth_rad[boxes.beams[0, 1]]


@pytest.mark.parametrize("function", [boxes_of, body_map])
def test_wrong_arguments(function):
    with pytest.raises(sg.Error, match="a ping must have labels to find bodies in it"):
        function(fan_ping(60))
    with pytest.raises(sg.Error, match="height of a fan image must be a whole number"):
        function(labelled(np.ones((3, 4))), 0)


@pytest.mark.parametrize("function", [boxes_of, body_map])
@pytest.mark.parametrize(
    ("body_id", "message"),
    [
        (
            np.full((3, 4), 3, np.uint16),
            r"must lie in 0\.\.2, since its body_echo has 3 entries \(got 3 to 3\)",
        ),
        (np.full((3, 4), -1), r"must lie in 0\.\.2, .* \(got -1 to -1\)"),
        (np.ones((3, 4)), r"whole numbers of the shape of its intensity, \(3, 4\) \(got float64"),
        (np.ones((4, 3), np.uint16), r"\(got uint16 of shape \(4, 3\)\)"),
    ],
)
def test_labels_that_do_not_match_are_errors(function, body_id, message):
    """A file may hold them; compiled functions would write beyond their arrays."""
    ping = replace(labelled(np.ones((3, 4)), n_bodies=2), body_id=body_id)
    with pytest.raises(sg.Error, match=message):
        function(ping, 40)


def test_no_body_in_view():
    boxes = boxes_of(labelled(np.zeros((3, 4)), n_bodies=2))
    assert boxes.body_id.shape == (0,) and boxes.pixels.shape == (0, 4)
