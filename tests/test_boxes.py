"""Boxes and maps of bodies, against plain NumPy over each body's bins and pixels."""

import math

import numpy as np
import pytest
import trimesh

import sonar_gl as sg
from sonar_gl.boxes import body_map, boxes_of
from sonar_gl.image import fan_geometry


def make(body_id, fov_deg=60.0, range_m=(2.0, 10.0), n_bodies=None, azimuth=None):
    """A ping whose bins are told to be of bodies."""
    B, K = body_id.shape
    body_id = np.asarray(body_id, np.uint16)
    if azimuth is None:
        azimuth = np.radians((np.arange(B) + 0.5) / B * fov_deg - fov_deg / 2)
    edges = np.linspace(*range_m, K + 1)
    n_bodies = int(body_id.max()) if n_bodies is None else n_bodies
    meta = {"bin_size_m": edges[1] - edges[0]}
    body_echo = np.arange(n_bodies + 1) * 1.5
    ping = np.zeros((B, K), np.float32), azimuth, (edges[1:] + edges[:-1]) / 2
    return sg.Ping(*ping, body_id, body_echo=body_echo, meta=meta)


def blocks(rng, shape, n_bodies):
    """Bodies here and there, in blocks that cover each other."""
    out = np.zeros(shape, int)
    for body in rng.permutation(n_bodies) + 1:
        b, k = rng.integers(0, shape[0]), rng.integers(0, shape[1])
        out[b : b + rng.integers(1, 9), k : k + rng.integers(1, 20)] = body
    return out


@pytest.mark.parametrize("n_bodies", [1, 7, 400])
@pytest.mark.parametrize("fov_deg", [60.0, 200.0, 360.0])
def test_boxes_go_round_each_body(n_bodies, fov_deg):
    ping = make(blocks(np.random.default_rng(n_bodies), (90, 150), n_bodies), fov_deg, n_bodies=n_bodies + 3)
    boxes, bodies = boxes_of(ping, 500), body_map(ping, 500)
    assert bodies.shape == sg.fan_image(ping, 500).shape and bodies.dtype == np.uint16
    assert boxes.body_id.tolist() == sorted(set(ping.body_id.flat) - {0})  # nothing of bodies out of view
    lost = 0
    for row, body in enumerate(boxes.body_id):
        b, k = np.nonzero(ping.body_id == body)
        assert boxes.beams[row].tolist() == [b.min(), b.max()]
        assert boxes.bins[row].tolist() == [k.min(), k.max()]
        assert boxes.n_bins[row] == len(b)
        assert boxes.energy[row] == 1.5 * body
        lines, columns = np.nonzero(bodies == body)
        if len(lines) == 0:  # all of it between pixels
            lost += 1
            assert boxes.pixels[row, 2:].tolist() == [1, 1]
            continue
        size = np.ptp(columns) + 1, np.ptp(lines) + 1
        assert boxes.pixels[row].tolist() == [columns.min(), lines.min(), *size]
    assert lost <= len(boxes.body_id) // 10


@pytest.mark.parametrize("fov_deg, table", [(60.0, False), (250.0, False), (360.0, False), (70.0, True)])
def test_the_map_shows_a_bin_where_the_fan_image_does(fov_deg, table):
    """Each bin has a number of its own; a pixel where its middle lies has that number, beams even or not."""
    azimuth = np.radians([-30.0, -25.0, -13.0, -5.0, 1.0, 12.0, 20.0, 33.0]) if table else None
    ping = make(1 + np.arange(8 * 12).reshape(8, 12), fov_deg, azimuth=azimuth)
    geometry, bodies = fan_geometry(ping, 600), body_map(ping, 600)
    assert set(bodies.flat) == {0, *ping.body_id.flat}
    columns, lines = geometry.pixel(ping.azimuth_rad[:, None], ping.range_m)
    found = bodies[np.rint(lines).astype(int), np.rint(columns).astype(int)]
    np.testing.assert_array_equal(found, ping.body_id)
    # port on the left: the last beam's bins lie left of the first one's
    port, starboard = (np.nonzero(bodies == ping.body_id[b, 5])[1].mean() for b in (-1, 0))
    assert port < starboard or fov_deg == 360.0
    # as large as the fan: pixels of it, less what rounding does along its rim
    low, high = geometry.azimuth_edges_rad
    area = (high - low) / 2 * (10.0**2 - 2.0**2) * geometry.pixels_per_m**2
    assert (bodies > 0).sum() == pytest.approx(area, rel=0.01)


def test_a_body_between_pixels_has_one():
    """A picture much coarser than the bins: the pixel where the body is."""
    body_id = np.zeros((300, 800), int)
    body_id[200, 333] = 2
    ping = make(body_id, n_bodies=2)
    boxes, bodies = boxes_of(ping, 40), body_map(ping, 40)
    assert boxes.body_id.tolist() == [2] and boxes.n_bins.tolist() == [1]
    column, line = fan_geometry(ping, 40).pixel(ping.azimuth_rad[200], ping.range_m[333])
    assert not (bodies == 2).any()
    assert boxes.pixels.tolist() == [[round(float(column)), round(float(line)), 1, 1]]


def test_of_a_ping_that_was_made():
    """What fan_image shows bright and the map tells to be the ball is in its box."""
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


def test_without_labels():
    ping = make(np.ones((3, 4)))
    bare = sg.Ping(ping.intensity, ping.azimuth_rad, ping.range_m)
    for function in (boxes_of, body_map):
        with pytest.raises(sg.Error, match="must have labels"):
            function(bare)
        with pytest.raises(sg.Error, match="height"):
            function(ping, 0)
    nothing = boxes_of(make(np.zeros((3, 4)), n_bodies=2))
    assert nothing.body_id.shape == (0,) and nothing.pixels.shape == (0, 4)
