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


@pytest.mark.parametrize("fov_deg, n_bodies", [*product([60.0, 200.0, 360.0], [1, 7]), (60.0, 400)])
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
    # as many pixels as the fan's area has, but for rounding along its rim: a tenth of a pixel on the average
    low, high = geometry.azimuth_edges_rad
    area = (high - low) / 2 * (10.0**2 - 2.0**2) * geometry.pixels_per_m**2
    rim = ((high - low) * (10.0 + 2.0) + 2 * (10.0 - 2.0)) * geometry.pixels_per_m
    assert (bodies > 0).sum() == pytest.approx(area, abs=rim / 10)


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


def test_faint_bins_at_the_ends_of_a_body_do_not_decide_its_box():
    """They keep their labels; a display shows each of them, at 12 to 31 counts of 255."""
    ping = bright_ping(np.ones((60, 80)), 60.0)
    body_id, intensity = np.zeros((60, 80), np.uint16), np.zeros((60, 80), np.float32)
    body_id[20:30, 30:45] = 1
    intensity[20:30, 30:45] = 0.5  # 213 counts
    for b, k in ((3, 40), (55, 33), (25, 2), (22, 70)):  # 31 counts: 0.1 % of all
        body_id[b, k], intensity[b, k] = 1, 3e-4
    ping = replace(ping, body_id=body_id, intensity=intensity)
    boxes, bodies = boxes_of(ping, 300), body_map(ping, 300)
    assert boxes.beams.tolist() == [[20, 29]] and boxes.bins.tolist() == [[30, 44]]
    assert boxes.n_bins.tolist() == [150]
    rows, columns = np.nonzero(bodies)
    size = np.ptp(columns) + 1, np.ptp(rows) + 1
    assert boxes.pixels.tolist() == [[columns.min(), rows.min(), *size]]
    inside = replace(ping, body_id=np.where(intensity > 0.1, body_id, 0).astype(np.uint16))
    np.testing.assert_array_equal(bodies, body_map(inside, 300))
    # a glint of 99.9 % of the echo changes nothing: it is as bright as 255 counts
    intensity[25, 37] = 1e5
    assert boxes_of(replace(ping, intensity=intensity), 300).n_bins.tolist() == [150]
    # what holds more than 0.5 %, in all at one end, stays
    body_id[3, 40:46], intensity[3, 40:46] = 1, 3e-4
    assert boxes_of(ping, 300).beams.tolist() == [[3, 29]]
    # a glint at an end, too: 255 of 32 500 counts
    body_id[3, 40:46], intensity[3, 40:46] = 0, 0
    body_id[3, 44], intensity[3, 44] = 1, 1e5
    assert boxes_of(ping, 300).beams.tolist() == [[3, 29]]


@pytest.mark.parametrize(("n_bins", "is_left_out"), [(200, True), (199, False)])
def test_an_end_of_exactly_half_a_per_cent_is_left_out(n_bins, is_left_out):
    """Of bins that are equally bright one lies apart, at either end of beams or range."""
    for apart in ((3, 45), (55, 45), (25, 2), (25, 70)):
        body_id = np.zeros((60, 80), np.uint16)
        body_id[20:30, 30:50] = 1
        body_id[22, 40 : 241 - n_bins] = 0  # in the middle
        body_id[apart] = 1
        boxes = boxes_of(labelled(body_id), 300)
        (beams,), (bins,) = boxes.beams.tolist(), boxes.bins.tolist()
        assert boxes.n_bins.tolist() == [n_bins - is_left_out]
        for found, inner, outer in zip((beams, bins), ([20, 29], [30, 49]), apart, strict=True):
            assert found == (inner if is_left_out else [min(inner[0], outer), max(inner[1], outer)])


def bright_ping(body_id, fov_deg):
    """Return a labelled ping of a sonar with a fixed gain."""
    ping = labelled(np.asarray(body_id, np.uint16), fov_deg)
    counts = sg.Counts("power", exponent=0.26)
    sonar = sg.Sonar("test", 900e3, *ping.intensity.shape, fov_deg, 20.0, 1.5, 2.0, 10.0, counts=counts)
    return replace(ping, sonar=sonar)


def ends_of(profile):
    """Return the first and the last place of a profile (n,) without what holds 0.5 % of it at either end."""
    first = next(i for i in range(len(profile)) if 200 * profile[: i + 1].sum() > profile.sum())
    last = next(i for i in reversed(range(len(profile))) if 200 * profile[i:].sum() > profile.sum())
    return first, last


@pytest.mark.parametrize("seed", range(8))
def test_boxes_are_those_of_a_plain_sum_of_counts(seed):
    """Of clouds of bins, whose echoes differ by 60 dB."""
    rng, body_id = np.random.default_rng(seed), np.zeros((50, 70), np.uint16)
    for body in range(1, 5):
        b, k = rng.normal(rng.uniform(10, (40, 60)), (5, 8), (150, 2)).astype(int).T
        body_id[b.clip(0, 49), k.clip(0, 69)] = body
    ping = bright_ping(body_id, 60.0)
    ping = replace(ping, intensity=(10 ** rng.uniform(-6, 0, body_id.shape)).astype(np.float32))
    boxes, bodies, kept = boxes_of(ping, 300), body_map(ping, 300), np.zeros_like(ping.body_id)
    counts = ping.counts(replace(ping.sonar.counts, bits=16)).astype(np.int64)
    for n, body in enumerate(boxes.body_id):
        own = np.where(body_id == body, counts, 0)
        (b0, b1), (k0, k1) = ends_of(own.sum(axis=1)), ends_of(own.sum(axis=0))
        at = np.zeros(body_id.shape, bool)
        at[b0 : b1 + 1, k0 : k1 + 1] = body_id[b0 : b1 + 1, k0 : k1 + 1] == body
        kept[at] = body
        b, k = np.nonzero(at)
        assert boxes.n_bins[n] == len(b)
        assert boxes.beams[n].tolist() == [b.min(), b.max()]
        assert boxes.bins[n].tolist() == [k.min(), k.max()]
    assert boxes.n_bins.sum() < (body_id > 0).sum()
    even = replace(ping, body_id=kept, sonar=None)  # of few bins: each of a body has more than 0.5 %
    np.testing.assert_array_equal(bodies, body_map(even, 300))
    np.testing.assert_array_equal(boxes.pixels, boxes_of(even, 300).pixels)


def test_a_box_may_lie_across_the_seam_of_a_full_circle():
    """Its ends are those of the widest gap, wherever the first beam points."""
    body_id, intensity = np.zeros((90, 60), np.uint16), np.zeros((90, 60), np.float32)
    body_id[20:30, 30:40], intensity[20:30, 30:40] = 1, 0.5
    for beam in (5, 35, 70):  # of which the widest gap ends at the last
        body_id[beam, 35], intensity[beam, 35] = 1, 1e-4
    ping = bright_ping(np.ones((90, 60)), 360.0)
    for turn in (0, 65, 67, 45):
        at = {"body_id": np.roll(body_id, turn, axis=0), "intensity": np.roll(intensity, turn, axis=0)}
        turned = replace(ping, **at)
        boxes, bodies = boxes_of(turned, 400), body_map(turned, 400)
        assert boxes.beams.tolist() == [[(20 + turn) % 90, (29 + turn) % 90]]
        assert boxes.bins.tolist() == [[30, 39]] and boxes.n_bins.tolist() == [100]
        rows, columns = np.nonzero(bodies)
        size = [np.ptp(columns) + 1, np.ptp(rows) + 1]
        assert boxes.pixels.tolist() == [[columns.min(), rows.min(), *size]] and max(size) < 150
    around = np.ones((90, 60), np.float32)
    around[:3] = 1e-5  # at 13 counts: without a gap there is no end
    assert boxes_of(replace(ping, intensity=around), 400).beams.tolist() == [[0, 89]]
    # the widest gap, of 40 beams, lies half before and half behind the seam; another one has 35
    halves = np.zeros((90, 60), np.uint16)
    halves[[*range(20, 30), *range(65, 70)]] = 1
    ping = replace(ping, body_id=halves, intensity=halves.astype(np.float32))
    assert boxes_of(ping, 400).beams.tolist() == [[20, 69]]


def test_a_body_between_pixels_across_the_seam_has_the_nearest_one():
    body_id = np.zeros((3000, 800), np.uint16)
    body_id[[0, -1], 333] = 1
    ping = labelled(body_id, 360.0)
    boxes = boxes_of(ping, 40)
    assert boxes.beams.tolist() == [[2999, 0]] and not body_map(ping, 40).any()
    column, row = fan_geometry(ping, 40).pixel(math.pi, ping.range_m[333])
    assert boxes.pixels.tolist() == [[round(float(column)), round(float(row)), 1, 1]]


def test_a_body_behind_the_seam_is_not_shown_ahead():
    """Of its first beam, before the seam, both bins are left out at the ends of the range."""
    body_id = np.zeros((3000, 800), np.uint16)
    body_id[0:15, 322:342] = 1
    body_id[-1, [100, 700]] = 1
    ping = replace(labelled(body_id, 360.0), sonar=None)  # all bins count alike
    boxes = boxes_of(ping, 40)
    assert boxes.beams.tolist() == [[0, 14]] and boxes.bins.tolist() == [[322, 341]]
    assert not body_map(ping, 40).any()  # between pixels
    column, row = fan_geometry(ping, 40).pixel(ping.azimuth_rad[:15].mean(), ping.range_m[322:342].mean())
    assert boxes.pixels.tolist() == [[round(float(column)), round(float(row)), 1, 1]]


def test_bodies_that_a_display_does_not_show_have_all_their_bins():
    """As where `label_level_db` labels what is black."""
    ping = bright_ping(np.ones((40, 30)), 60.0)
    boxes = boxes_of(ping, 100)
    assert boxes.beams.tolist() == [[0, 39]] and boxes.bins.tolist() == [[0, 29]]
    assert boxes.n_bins.tolist() == [1200]


def test_noise_does_not_change_boxes_if_the_quiet_ping_is_given():
    scene, sonar = sg.load_scene("pylon"), sg.load_sonar("p900-45").with_range(20.0)
    noise = sg.Noise(speckle=True)  # hides no label
    with sg.Simulator(scene, sonar, tolerance=0.05) as simulator:
        quiet = simulator.ping(scene.sonar_pose, labels=True)
        noisy = simulator.ping(scene.sonar_pose, noise, labels=True)
    expected, found = boxes_of(quiet, 300), boxes_of(noisy, 300, quiet)
    for name in ("body_id", "n_bins", "beams", "bins", "pixels", "energy"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))
    np.testing.assert_array_equal(body_map(noisy, 300, quiet), body_map(quiet, 300))
    with pytest.raises(sg.Error, match=r"must have the shape of the noisy one, \(256, \d+\) \(got \(2, 3\)"):
        boxes_of(noisy, 300, fan_ping(n_beams=2, n_bins=3))


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
