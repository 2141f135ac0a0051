"""Fan images: positions, brightness and colours."""

import math
from dataclasses import replace

import numpy as np
import pytest

from sonar_gl.core.errors import Error
from sonar_gl.imaging.colormaps import ANCHORS
from sonar_gl.imaging.fan_image import FanGeometry, colorize, colormaps, fan_geometry, fan_image
from sonar_gl.ping import Ping
from sonar_gl.sonar.counts import Counts
from sonar_gl.sonar.sonar import Sonar
from tests.support.errors import error_of
from tests.support.fan_ping import fan_ping

HALF_PIXEL = 0.5
LINEAR = Counts("power", exponent=1.0)


def centroid(image):
    """Return the (column, row) of the image's centre of mass."""
    rows, columns = np.indices(image.shape)
    return (columns * image).sum() / image.sum(), (rows * image).sum() / image.sum()


def test_port_is_left_and_forward_up():
    ping = fan_ping()
    ping.intensity[96, 150] = 1.0  # +22.8 degrees
    column, row = centroid(fan_image(ping, 400))
    expected = fan_geometry(ping, 400).pixel(ping.azimuth_rad[96], ping.range_m[150])
    assert (column, row) == pytest.approx(expected, abs=HALF_PIXEL)
    assert column < fan_geometry(ping, 400).sonar_column - 100 and row < 200


FANS_DEG = 20, 45, 90, 120, 130, 179, 180, 181, 270, 359, 360
FAST = {(fov_deg, 401) for fov_deg in (20, 180, 360)}  # others are slow


@pytest.mark.parametrize(
    "fov_deg, height",
    [
        pytest.param(fov_deg, height, marks=() if (fov_deg, height) in FAST else pytest.mark.slow)
        for height in (401, 800)
        for fov_deg in FANS_DEG
    ],
)
def test_isotropic_within_half_a_pixel(fov_deg, height):
    ping = fan_ping(fov_deg, n_beams=10 * fov_deg)
    x = ping.range_m * np.cos(ping.azimuth_rad)[:, None]
    y = ping.range_m * np.sin(ping.azimuth_rad)[:, None]
    for beam_share in (0.1, 0.3, 0.5, 0.9) if fov_deg > 30 else (0.3, 0.5, 0.7):  # away from the edges
        for bin_ in (60, 110, 170):
            beam = int(beam_share * len(ping.azimuth_rad))
            # a target that is round in metres
            x0, y0 = x[beam, bin_], y[beam, bin_]
            ping.intensity[:] = np.exp(-((x - x0) ** 2 + (y - y0) ** 2) / (2 * 0.15**2))
            ping.intensity[ping.intensity < 1e-3] = 0
            image = fan_image(ping, height, counts=LINEAR)
            geometry = fan_geometry(ping, height)
            assert image.shape == (geometry.height, geometry.width) == (height, geometry.width)
            # from first principles, without geometry.pixel
            half = math.radians(min(fov_deg, 360)) / 2
            scale = height / 20 / (1 - min(0, math.cos(half)))
            expected = ((geometry.width - 1) / 2 - y0 * scale, scale * 20 - 0.5 - x0 * scale)
            assert np.abs(np.subtract(centroid(image), expected)).max() < HALF_PIXEL
            assert np.allclose(geometry.pixel(ping.azimuth_rad[beam], ping.range_m[bin_]), expected)
    assert geometry.pixels_per_m == pytest.approx(scale)


@pytest.mark.parametrize("fov_deg, width", [(60, 300), (90, 425), (180, 600), (360, 300)])
def test_size_of_the_picture(fov_deg, width):
    assert fan_image(fan_ping(fov_deg), 300).shape == (300, width)


def test_db_scale_is_fixed():
    one = fan_image(fan_ping(fill=1e-3), 200)
    two = fan_image(fan_ping(fill=2e-3), 200)
    inside = one > 0
    # float32 of numbers up to 1
    assert one[inside] == pytest.approx(0.5, abs=1e-6)
    assert two[inside] - one[inside] == pytest.approx(10 * math.log10(2) / 60, abs=1e-6)
    assert fan_image(fan_ping(fill=1.0), 200).max() == pytest.approx(1.0, abs=1e-6)
    assert fan_image(fan_ping(fill=7.0), 200).max() == 1.0
    assert not fan_image(fan_ping(fill=1e-6), 200).any()
    assert not fan_image(fan_ping(fill=0.0), 200).any()
    wide = fan_image(fan_ping(fill=1e-3), 200, counts=Counts(low_db=-40, high_db=-20))
    assert wide[inside] == pytest.approx(0.5, abs=1e-6)


@pytest.mark.parametrize(("fill", "value"), [(0.25, 0.25), (3.0, 1.0), (-1.0, 0.0)])
def test_linear_scale(fill, value):
    image = fan_image(fan_ping(fill=fill), 200, counts=LINEAR)
    assert image.dtype == np.float32 and image.max() == pytest.approx(value, abs=1e-6)


@pytest.mark.parametrize("fov_deg", [30, 90, 180, 270, 360])
def test_fan_fills_its_area_alone(fov_deg):
    ping = fan_ping(fov_deg, range_m=(5.0, 20.0), fill=1.0)
    image, geometry = fan_image(ping, 500), fan_geometry(ping, 500)
    area = math.radians(fov_deg) / 2 * (20**2 - 5**2) * geometry.pixels_per_m**2
    # pixels round along the rim; it lies a quarter of a pixel aside at most, on the average
    arcs_m, sides_m = math.radians(fov_deg) * (20 + 5), 2 * (20 - 5) * (fov_deg < 360)
    rim = (arcs_m + sides_m) * geometry.pixels_per_m
    assert (image > 0).sum() == pytest.approx(area, abs=rim / 4)
    assert set(np.unique(image > 0.999)) == {False, True} and ((image == 0) | (image > 0.999)).all()


@pytest.mark.parametrize("fov_deg", [60, 250, 360])
def test_pixel_rows_are_the_inverse_of_pixel(fov_deg):
    geometry = fan_geometry(fan_ping(fov_deg), 150)
    covered = np.zeros(150, int)
    for rows, azimuth_rad, range_m, inside in geometry.pixel_rows():
        covered[rows] += 1
        row, column = np.mgrid[rows, : geometry.width]
        np.testing.assert_allclose(geometry.pixel(azimuth_rad, range_m), (column, row), atol=1e-9)
        assert (inside <= (range_m <= 20)).all() and (np.abs(azimuth_rad) <= np.pi).all()
    assert (covered == 1).all()


def test_full_circle_has_no_seam():
    """A pattern that is smooth round the circle is as smooth astern as ahead."""
    ping = fan_ping(360, n_beams=48)
    ping.intensity[:] = (0.5 + 0.4 * np.sin(2 * ping.azimuth_rad))[:, None]
    image = fan_image(ping, 400, counts=LINEAR)
    turned = fan_ping(360, n_beams=48)
    turned.intensity[:] = np.roll(ping.intensity, 24, axis=0)
    np.testing.assert_allclose(fan_image(turned, 400, counts=LINEAR)[::-1, ::-1], image, rtol=0, atol=1e-6)
    steps = np.abs(np.diff(image[250:380], axis=1))[:, 150:250]
    assert (image[250:380, 150:250] > 0.05).all() and steps.max() < 0.02


def test_target_on_the_seam_stays_one_target():
    ping = fan_ping(360, n_beams=64)
    ping.intensity[[0, -1], 150] = 1.0
    column, row = centroid(fan_image(ping, 401, counts=LINEAR))
    geometry = fan_geometry(ping, 401)
    assert (column, row) == pytest.approx(geometry.pixel(math.pi, ping.range_m[150]), abs=HALF_PIXEL)


def test_uneven_table_of_beams():
    table = np.radians(60) * np.sin(np.linspace(-1.2, 1.2, 81)) / np.sin(1.2)
    for beam in (4, 40, 70):
        ping = fan_ping(azimuth_rad=table, n_bins=100)
        ping.intensity[beam, 70] = 1.0
        image = fan_image(ping, 800, counts=LINEAR)
        row, column = np.unravel_index(image.argmax(), image.shape)
        expected = fan_geometry(ping, 800).pixel(table[beam], ping.range_m[70])
        assert np.hypot(column - expected[0], row - expected[1]) < 2.0  # the peak is flat within a beam


def test_fan_aside_of_the_boresight():
    ping = fan_ping(azimuth_rad=np.radians(np.linspace(10, 60, 50)), fill=1.0)
    image = fan_image(ping, 300)
    assert image[:, : image.shape[1] // 2 - 10].any() and not image[:, image.shape[1] // 2 :].any()
    other = fan_image(fan_ping(azimuth_rad=np.radians(np.linspace(-60, -10, 50)), fill=1.0), 300)
    assert (other == image[:, ::-1]).all()


def test_fan_astern():
    """Its azimuths go on beyond 180 degrees."""
    image = fan_image(fan_ping(azimuth_rad=np.radians(np.linspace(101, 259, 80)), fill=1.0), 300)
    share = (100 - 260) / 360
    assert (image > 0).mean() == pytest.approx(-share * math.pi / 4, abs=0.01)  # of a disc in its square
    assert (image == image[:, ::-1]).all() and not image[:100].any()


def test_uneven_beams_cover_a_circle_at_most():
    """Half a spacing outside the outer ones would be 205 degrees."""
    ping = fan_ping(azimuth_rad=np.radians([-170.0, -100.0, 0.0, 100.0, 170.0]), fill=1.0)
    geometry = fan_geometry(ping, 300)
    assert np.degrees(geometry.azimuth_edges_rad) == pytest.approx([-180, 180], abs=1e-12)
    assert geometry.full_circle and fan_image(ping, 300).shape == (300, 300)
    assert not fan_geometry(fan_ping(359.99), 300).full_circle


def test_bins_from_0_on_have_their_edge_at_0_whatever_rounding_leaves():
    for n_bins in range(2, 60):
        assert fan_geometry(fan_ping(n_bins=n_bins, range_m=(0.0, 17.1))).range_edges_m[0] == 0.0


def test_no_bin_begins_behind_the_sonar():
    ping = replace(fan_ping(n_bins=1), range_m=np.array([5.0]), meta={"bin_size_m": 30.0})
    assert fan_geometry(ping).range_edges_m == (0.0, 10.0)


def test_beams_wider_than_pixels_are_not_averaged():
    """A column of pixels lies on the middle beam; others may lie closer together."""
    even = np.radians(np.linspace(-45, 45, 401))  # 1.5 pixels apart at the outer edge
    few = np.radians(np.linspace(-45, 45, 101))
    pairs = np.sort([*few, few[10] + 1e-4, few[-11] - 1e-4])
    for table, height in ((even, 401), (pairs, 400)):  # pictures of an odd width
        ping = fan_ping(azimuth_rad=table)
        ping.intensity[len(table) // 2] = 1.0
        image = fan_image(ping, height, counts=LINEAR)
        middle = image.shape[1] // 2
        assert image.shape[1] == 2 * middle + 1 and (image[:20, middle] == 1).all()


def test_fine_bins_are_averaged_over_a_pixel_each():
    """80 bins to a pixel: whichever has an echo, its pixel straight ahead is a 80th as bright, and no other is lit."""
    for bin_ in (0, 2799, 2800, 6479):
        ping = fan_ping(90, 65, 81 * 80, range_m=(5.0, 20.0))
        ping.intensity[:, bin_] = 1.0
        ahead = fan_image(ping, 108, counts=LINEAR)[:, 76]
        assert np.flatnonzero(ahead).tolist() == [80 - bin_ // 80]
        assert ahead.max() == pytest.approx(1 / 80, rel=1e-5)  # float32 sums


def test_edges_reach_half_a_beam_and_half_a_bin_out():
    ping = fan_ping(azimuth_rad=np.radians([-10.0, 0.0, 10.0]), n_bins=10, range_m=(10.0, 20.0), fill=1.0)
    geometry = fan_geometry(ping, 400)
    assert np.degrees(geometry.azimuth_edges_rad) == pytest.approx([-15, 15])
    assert geometry.range_edges_m == pytest.approx((10.0, 20.0))
    image = fan_image(ping, 400)
    for azimuth_deg, range_m, value in ((14.7, 19.9, 1), (-14.7, 10.1, 1), (15.4, 15, 0), (0, 9.8, 0)):
        column, row = geometry.pixel(math.radians(azimuth_deg), range_m)
        assert image[round(float(row)), round(float(column))] == pytest.approx(value)


@pytest.mark.parametrize(("n_beams", "n_bins"), [(1, 1), (1, 100), (100, 1), (2, 2), (3, 8192), (4096, 3)])
def test_few_or_many_beams_and_bins(n_beams, n_bins):
    ping = fan_ping(60, n_beams, n_bins, fill=1.0)
    image = fan_image(ping, 200)
    assert image.max() == pytest.approx(1.0) and np.isfinite(image).all()


def test_one_beam_is_as_wide_as_the_sonars_fan():
    ping = fan_ping(60, 1, 10, fill=1.0)
    ping = replace(ping, sonar=Sonar("one beam", 900e3, 1, 10, 60.0, 20.0, 1.0, 0.0, 20.0))
    assert np.degrees(fan_geometry(ping).azimuth_edges_rad) == pytest.approx([-30, 30])
    assert fan_image(ping, 100).shape == (100, 100)


def test_one_beam_of_no_sonar_is_a_degree_wide():
    geometry = fan_geometry(fan_ping(60, 1, 10))
    assert np.degrees(geometry.azimuth_edges_rad) == pytest.approx([-0.5, 0.5])


def test_one_bin_is_as_long_as_the_sonars():
    ping = replace(fan_ping(60, 8, 1, range_m=(10.0, 20.0)), meta={})
    assert fan_geometry(ping).range_edges_m == (0.0, 30.0)
    sonar = Sonar("one bin", 900e3, 8, 1, 60.0, 20.0, 1.0, 10.0, 20.0)
    assert fan_geometry(replace(ping, sonar=sonar)).range_edges_m == (10.0, 20.0)


def test_a_mirrored_ping_has_a_mirrored_picture():
    """Of more beams than pixels, of which means are taken first."""
    ping = fan_ping(n_beams=1000)
    ping.intensity[:] = np.random.default_rng(0).random(ping.intensity.shape)
    mirrored = replace(ping, intensity=ping.intensity[::-1])
    picture, other = (fan_image(one, 101, counts=LINEAR) for one in (ping, mirrored))
    np.testing.assert_allclose(other[:, ::-1], picture, rtol=0, atol=2**-22)  # float32 sums in another order


def test_more_beams_than_cv2_can_count():
    ping = fan_ping(60, 40000, 4, fill=0.5)
    assert fan_image(ping, 100, counts=LINEAR).max() == pytest.approx(0.5, abs=1e-5)


@pytest.mark.parametrize("height", [25, 60, 100, 333])
def test_thin_ring_is_never_lost(height):
    """One bin of 8192, far finer than a pixel, shows in every direction, at every range."""
    for bin_ in (2000, 4111, 8000):
        ping = fan_ping(90, 64, 8192)
        ping.intensity[:, bin_] = 1.0
        image, geometry = fan_image(ping, height), fan_geometry(ping, height)
        for azimuth in np.radians(np.linspace(-40, 40, 41)):
            column, row = geometry.pixel(azimuth, ping.range_m[bin_])
            row, column = round(float(row)), round(float(column))
            assert image[max(0, row - 1) : row + 2, max(0, column - 1) : column + 2].max() > 0.2


@pytest.mark.parametrize("height", [60, 200])
def test_thin_ray_is_never_lost(height):
    """One beam of 4096 shows along its whole length."""
    for beam in (5, 1000, 2047, 4000):
        ping = fan_ping(90, 4096, 300)
        ping.intensity[beam] = 1.0
        image, geometry = fan_image(ping, height), fan_geometry(ping, height)
        for range_m in np.linspace(1, 19.5, 60):
            column, row = geometry.pixel(ping.azimuth_rad[beam], range_m)
            row, column = round(float(row)), round(float(column))
            assert image[max(0, row - 1) : row + 2, max(0, column - 1) : column + 2].max() > 0.1


@pytest.mark.parametrize("azimuth_deg", [0, 30, -50, 150])
@pytest.mark.parametrize("height", [60, 61, 200])
def test_a_fan_narrower_than_a_pixel_shows_all_bins(height, azimuth_deg):
    """The single beam of a scanning sonar had no pixels within a twentieth of its range, and more in small pictures."""
    ping = fan_ping(n_bins=40, azimuth_rad=np.radians([azimuth_deg - 0.25, azimuth_deg + 0.25]))
    geometry = fan_geometry(ping, height)
    for bin_ in range(2, 40):  # the first bins lie within a pixel of the sonar
        ping.intensity[:] = 0
        ping.intensity[:, bin_] = 1.0
        image = fan_image(ping, height, counts=LINEAR)
        column, row = geometry.pixel(np.radians(azimuth_deg), ping.range_m[bin_])
        assert image.max() > 0.2
        assert centroid(image) == pytest.approx((column, row), abs=1)


def test_speckle_keeps_its_mean_when_pixels_are_coarse():
    ping = fan_ping(90, 1024, 4000)
    ping.intensity[:] = np.random.default_rng(0).exponential(0.3, ping.intensity.shape)
    image = fan_image(ping, 100, counts=LINEAR)
    # five sigma of four million bins, which weigh as their area
    assert image[image > 0].mean() == pytest.approx(0.3, rel=3e-3)


@pytest.mark.parametrize(
    ("keywords", "message"),
    [
        ({"counts": "db"}, 'counts must be a Counts (got str; such as Counts("power", exponent=0.26))'),
        ({"height": 0}, "height of a fan image must be a whole number in 1..16000 (got 0; give pixels)"),
        ({"height": 9.5}, "height of a fan image must be a whole number in 1..16000 (got 9.5; give pixels)"),
    ],
)
def test_wrong_arguments(keywords, message):
    assert error_of(fan_image, fan_ping(), **keywords) == message


def test_arrays_that_do_not_match():
    """Of lists, which are refused here, and of what has no bins; arrays are refused where the ping is made."""
    assert error_of(fan_image, Ping(np.zeros((3, 4)), np.zeros(3), list(range(5)))) == (
        "a ping's range_m must be an array of numbers (got [0, 1, 2, 3, 4]; numpy.array makes one)"
    )
    assert error_of(fan_image, Ping(np.zeros((3, 0)), np.zeros(3), np.zeros(0))) == (
        "a ping's intensity must be (beams, bins), at least one of each "
        "(got (3, 0) with 3 azimuths and 0 ranges)"
    )


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"azimuth_rad": np.array([-20.0, 0.0, 20.0])}, "azimuth_rad must rise, within -6.283..6.283"),
        ({"azimuth_rad": np.array([0.2, 0.0, -0.2])}, "azimuth_rad must rise, within -6.283..6.283"),
        ({"azimuth_rad": np.array([-0.2, np.nan, 0.2])}, "azimuth_rad must rise, within -6.283..6.283"),
        ({"range_m": np.array([2.0, 1.0])}, "range_m must rise, from 0 on (got 2 to 1; give metres)"),
        ({"range_m": np.array([-1.0, 1.0])}, "range_m must rise, from 0 on (got -1 to 1; give metres)"),
        ({"range_m": np.array([1.0, np.inf])}, "range_m must rise, from 0 on (got 1 to inf; give metres)"),
        ({"intensity": [[0.0, 0.0]] * 3}, "intensity must be an array of numbers"),
        ({"range_m": "ab"}, "range_m must be an array of numbers (got 'ab'; numpy.array makes one)"),
    ],
)
def test_arrays_that_make_no_fan(fields, message):
    """Degrees, for instance, or starboard last: the picture would be wrong, or the error one of OpenCV."""
    good = Ping(np.zeros((3, 2)), np.array([-0.2, 0.0, 0.2]), np.array([1.0, 2.0]))
    fan_image(good)
    assert error_of(fan_image, replace(good, **fields)).startswith(f"a ping's {message}")


@pytest.mark.parametrize("counts", [Counts(), LINEAR, Counts("power", gain_percentile=50)])
def test_the_ping_stays_as_it_is(counts):
    """With few beams and bins the law applies to the array itself, without averaging."""
    ping = fan_ping(n_beams=16, n_bins=20, range_m=(10.0, 20.0), fill=7.0)
    ping.intensity.setflags(write=False)
    image = fan_image(ping, 400, counts)
    assert (ping.intensity == 7).all() and image.max() == pytest.approx(1, abs=1e-6)


def test_counts_are_those_of_the_sonar_unless_given():
    ping = fan_ping(fill=0.25)
    sonar = Sonar("any", 900e3, *ping.intensity.shape, 60.0, 20.0, 1.0, 0.0, 30.0, counts={"law": "power"})
    ping = replace(ping, sonar=sonar)
    assert fan_image(ping, 100).max() == pytest.approx(0.25**0.26, abs=1e-5)
    assert fan_image(ping, 100, LINEAR).max() == pytest.approx(0.25, abs=1e-6)


def test_pixels_interpolate_counts_of_bins_and_not_their_intensity():
    """Halfway between two bins of 0 and 81, a viewer shows the mean of what the device sent."""
    ping = fan_ping(n_beams=16, n_bins=20, range_m=(10.0, 20.0))
    ping.intensity[:, 10:] = 1.0
    image, geometry = fan_image(ping, 1000, Counts("power", exponent=0.25)), fan_geometry(ping, 1000)
    column, row = geometry.pixel(0.0, (ping.range_m[9] + ping.range_m[10]) / 2)
    assert image[round(float(row)), round(float(column))] == pytest.approx(0.5, abs=0.05)


def test_automatic_gain_does_not_depend_on_the_height():
    ping = fan_ping(n_beams=256, n_bins=900)
    ping.intensity[:] = np.random.default_rng(0).exponential(1e-4, ping.intensity.shape)
    law = Counts("power", gain_percentile=99)
    settled = ping.counts_law(law)
    for height in (60, 900):
        assert (fan_image(ping, height, law) == fan_image(ping, height, settled)).all()


def test_pictures_do_not_share_memory():
    ping = fan_ping(fill=0.1)
    first, second = fan_image(ping, 100), fan_image(ping, 100)
    assert not np.shares_memory(first, second) and first.flags.writeable
    assert not np.shares_memory(colorize(first), colorize(first))


def test_colours_of_values_outside_0_to_1():
    image = np.array([[-1.0, -0.001, 0.0, 0.5, 1.0, 1.2, 1e9]])
    for kind in (np.float16, np.float32, np.float64):
        with np.errstate(over="ignore"):  # 1e9 is infinite in 16 bits
            typed = image.astype(kind)
        assert (colorize(typed, "gray")[0, :, 0] == [0, 0, 0, 128, 255, 255, 255]).all()


def test_colours_of_arrays_that_are_not_contiguous():
    turned = np.linspace(0, 1, 12, dtype=np.float32).reshape(3, 4).T[::-1]
    assert (colorize(turned, "jet") == colorize(turned.copy(), "jet")).all()


def test_colours():
    own = tuple(ANCHORS)
    assert colormaps()[: len(own)] == own and {"gray", "copper", "amber", "ice"} <= set(own)
    assert {"jet", "inferno", "viridis", "twilight_shifted"} <= set(colormaps())
    ramp = np.linspace(0, 1, 256, dtype=np.float32).reshape(16, 16)
    for name in colormaps():
        picture = colorize(ramp, name)
        assert picture.shape == (16, 16, 3) and picture.dtype == np.uint8
    assert (colorize(ramp, "gray").reshape(256, 3) == np.arange(256)[:, None]).all()
    jet = colorize(ramp, "jet").reshape(256, 3).astype(int)
    for name in own:  # a brighter pixel has more counts
        brightness = colorize(ramp, name).reshape(256, 3) @ [0.299, 0.587, 0.114]
        as_dark = np.flatnonzero(np.diff(brightness) <= 0) + 1
        assert not as_dark.size, (
            f"{name}: give anchors of more different brightness about these colours of 0..255"
        )
        assert brightness[0] == 0 and brightness[-1] > 235, f"{name} must go from black to nearly white"
    assert jet[0].tolist() == [0, 0, 128] and jet[-1, 0] >= 127 and not jet[-1, 1:].any()  # RGB: blue to red


@pytest.mark.parametrize(
    ("image", "name", "message"),
    [
        (np.zeros((2, 2)), "jett", "unknown colour map (got 'jett'; did you mean 'jet'?)"),
        (np.zeros((2, 2), np.uint8), "jet", "colorize needs an image of shape (H, W), float 0..1 (got"),
        (np.zeros((2, 2, 3)), "jet", "colorize needs an image of shape (H, W), float 0..1 (got"),
        ([[0.5], [0.5, 1.0]], "jet", "the image of colorize must be an array"),
        (np.zeros((0, 5)), "jet", "colorize needs an image of shape (H, W), float 0..1 (got"),
    ],
)
def test_wrong_colours(image, name, message):
    assert error_of(colorize, image, name).startswith(message)


def test_colours_of_a_ping_are_those_of_its_fan_image():
    assert error_of(colorize, fan_ping()) == (
        "colorize needs an image of shape (H, W), float 0..1 (got (), object; sonar_gl.fan_image makes one of a ping)"
    )


def test_a_colour_map_that_is_no_name():
    with pytest.raises(Error, match=r"^unknown colour map \(got \['jet'\]; known are amber, "):
        colorize(np.zeros((2, 2)), ["jet"])


def test_geometry_is_plain_and_comparable():
    assert fan_geometry(fan_ping(), 100) == fan_geometry(fan_ping(), 100) != fan_geometry(fan_ping(), 101)
    assert isinstance(fan_geometry(fan_ping(), 100), FanGeometry)


def test_an_array_in_place_of_a_ping_is_an_error():
    for function in (fan_image, fan_geometry):
        assert error_of(function, np.ones((4, 5), np.float32)) == (
            "ping must be a Ping (got ndarray; sonar_gl.Ping(intensity, azimuth_rad, range_m) makes one of arrays)"
        )
