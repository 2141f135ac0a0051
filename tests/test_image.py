"""Fan images: where things come to lie, how bright they are, what is drawn about them."""

import math
import time

import numpy as np
import pytest

from sonar_gl.axes import draw_axes
from sonar_gl.image import FanGeometry, colorize, colormaps, fan_geometry, fan_image
from sonar_gl.types import Error, Ping

HALF_PIXEL = 0.5


def make_ping(fov_deg=90.0, n_beams=128, n_bins=200, range_m=(0.0, 20.0), azimuth_rad=None, fill=0.0):
    if azimuth_rad is None:
        azimuth_rad = np.radians(fov_deg * ((np.arange(n_beams) + 0.5) / n_beams - 0.5))
    edges = np.linspace(*range_m, n_bins + 1)
    intensity = np.full((len(azimuth_rad), n_bins), fill, np.float32)
    meta = {"bin_size_m": float(edges[1] - edges[0])}
    return Ping(intensity, np.asarray(azimuth_rad), (edges[1:] + edges[:-1]) / 2, pose=np.eye(4), meta=meta)


def centroid(image):
    rows, columns = np.indices(image.shape)
    return (columns * image).sum() / image.sum(), (rows * image).sum() / image.sum()


def test_port_is_left_and_forward_up():
    ping = make_ping()
    ping.intensity[96, 150] = 1.0  # +22.8 degrees
    column, row = centroid(fan_image(ping, 400))
    assert column < fan_geometry(ping, 400).sonar_column - 100
    assert row < 200


@pytest.mark.parametrize("fov_deg", [20, 45, 90, 120, 130, 179, 180, 181, 270, 359, 360])
@pytest.mark.parametrize("height", [401, 800])
def test_isotropic_to_half_a_pixel(fov_deg, height):
    geometry = None
    for beam_share in (0.1, 0.3, 0.5, 0.9) if fov_deg > 30 else (0.3, 0.5, 0.7):  # clear of the edges
        for bin_ in (60, 110, 170):
            ping = make_ping(fov_deg, n_beams=10 * fov_deg)
            beam = int(beam_share * len(ping.azimuth_rad))
            # a blob, round in metres, as a target is
            x = ping.range_m * np.cos(ping.azimuth_rad)[:, None]
            y = ping.range_m * np.sin(ping.azimuth_rad)[:, None]
            x0, y0 = x[beam, bin_], y[beam, bin_]
            ping.intensity[:] = np.exp(-((x - x0) ** 2 + (y - y0) ** 2) / (2 * 0.15**2))
            ping.intensity[ping.intensity < 1e-3] = 0
            image = fan_image(ping, height, scale="linear")
            geometry = fan_geometry(ping, height)
            assert image.shape == (geometry.height, geometry.width) == (height, geometry.width)
            found = centroid(image)
            # from first principles, not through geometry.pixel
            half = math.radians(min(fov_deg, 360)) / 2
            scale = height / 20 / (1 - min(0, math.cos(half)))
            wanted = ((geometry.width - 1) / 2 - y0 * scale, scale * 20 - 0.5 - x0 * scale)
            assert np.abs(np.subtract(found, wanted)).max() < HALF_PIXEL
            assert np.allclose(geometry.pixel(ping.azimuth_rad[beam], ping.range_m[bin_]), wanted)
    assert geometry.pixels_per_m == pytest.approx(scale)


def test_size_of_the_picture():
    for fov_deg, shape in ((60, (300, 300)), (90, (300, 425)), (180, (300, 600)), (360, (300, 300))):
        assert fan_image(make_ping(fov_deg), 300).shape == shape


def test_db_scale_is_fixed():
    one = fan_image(make_ping(fill=1e-3), 200)
    two = fan_image(make_ping(fill=2e-3), 200)
    inside = one > 0
    assert one[inside] == pytest.approx(0.5, abs=1e-4)
    assert two[inside] - one[inside] == pytest.approx(10 * math.log10(2) / 60, abs=1e-4)
    assert fan_image(make_ping(fill=1.0), 200).max() == pytest.approx(1.0, abs=1e-5)
    assert fan_image(make_ping(fill=7.0), 200).max() == 1.0
    assert not fan_image(make_ping(fill=1e-6), 200).any()
    assert not fan_image(make_ping(fill=0.0), 200).any()
    wide = fan_image(make_ping(fill=1e-3), 200, db_range=(-40, -20))
    assert wide[inside] == pytest.approx(0.5, abs=1e-4)


def test_linear_scale():
    for fill, value in ((0.25, 0.25), (3.0, 1.0), (-1.0, 0.0)):
        image = fan_image(make_ping(fill=fill), 200, scale="linear")
        assert image.dtype == np.float32 and image.max() == pytest.approx(value, abs=1e-6)


def test_fan_fills_its_own_area_and_nothing_else():
    for fov_deg in (30, 90, 180, 270, 360):
        ping = make_ping(fov_deg, range_m=(5.0, 20.0), fill=1.0)
        image, geometry = fan_image(ping, 500), fan_geometry(ping, 500)
        area = math.radians(fov_deg) / 2 * (20**2 - 5**2) * geometry.pixels_per_m**2
        assert (image > 0).sum() == pytest.approx(area, rel=0.01)
        assert set(np.unique(image > 0.999)) == {False, True} and ((image == 0) | (image > 0.999)).all()


def test_full_circle_has_no_seam():
    """A pattern that is smooth round the circle is as smooth astern as ahead."""
    ping = make_ping(360, n_beams=48)
    ping.intensity[:] = (0.5 + 0.4 * np.sin(2 * ping.azimuth_rad))[:, None]
    image = fan_image(ping, 400, scale="linear")
    turned = make_ping(360, n_beams=48)
    turned.intensity[:] = np.roll(ping.intensity, 24, axis=0)
    assert fan_image(turned, 400, scale="linear")[::-1, ::-1] == pytest.approx(image, abs=0.01)
    steps = np.abs(np.diff(image[250:380], axis=1))[:, 150:250]
    assert (image[250:380, 150:250] > 0.05).all() and steps.max() < 0.02


def test_target_on_the_seam_stays_one_target():
    ping = make_ping(360, n_beams=64)
    ping.intensity[[0, -1], 150] = 1.0
    column, row = centroid(fan_image(ping, 401, scale="linear"))
    geometry = fan_geometry(ping, 401)
    assert (column, row) == pytest.approx(geometry.pixel(math.pi, ping.range_m[150]), abs=HALF_PIXEL)


def test_uneven_table_of_beams():
    table = np.radians(60) * np.sin(np.linspace(-1.2, 1.2, 81)) / np.sin(1.2)
    for beam in (4, 40, 70):
        ping = make_ping(azimuth_rad=table, n_bins=100)
        ping.intensity[beam, 70] = 1.0
        image = fan_image(ping, 800, scale="linear")
        row, column = np.unravel_index(image.argmax(), image.shape)
        wanted = fan_geometry(ping, 800).pixel(table[beam], ping.range_m[70])
        assert np.hypot(column - wanted[0], row - wanted[1]) < 2.0  # the top is flat to within a beam


def test_fan_that_looks_aside():
    ping = make_ping(azimuth_rad=np.radians(np.linspace(10, 60, 50)), fill=1.0)
    image = fan_image(ping, 300)
    assert image[:, : image.shape[1] // 2 - 10].any() and not image[:, image.shape[1] // 2 :].any()


def test_edges_reach_half_a_beam_and_half_a_bin_out():
    ping = make_ping(azimuth_rad=np.radians([-10.0, 0.0, 10.0]), n_bins=10, range_m=(10.0, 20.0), fill=1.0)
    geometry = fan_geometry(ping, 400)
    assert np.degrees(geometry.azimuth_edges_rad) == pytest.approx([-15, 15])
    assert geometry.range_edges_m == pytest.approx((10.0, 20.0))
    image = fan_image(ping, 400)
    for azimuth_deg, range_m, seen in ((14.7, 19.9, 1), (-14.7, 10.1, 1), (15.4, 15, 0), (0, 9.8, 0)):
        column, row = geometry.pixel(math.radians(azimuth_deg), range_m)
        assert image[round(float(row)), round(float(column))] == pytest.approx(seen)


@pytest.mark.parametrize(("n_beams", "n_bins"), [(1, 1), (1, 100), (100, 1), (2, 2), (3, 8192), (4096, 3)])
def test_few_or_many_beams_and_bins(n_beams, n_bins):
    ping = make_ping(60, n_beams, n_bins, fill=1.0)
    image = fan_image(ping, 200)
    assert image.max() == pytest.approx(1.0) and np.isfinite(image).all()


def test_one_beam_is_as_wide_as_its_sonar():
    ping = make_ping(60, 1, 10, fill=1.0)
    ping.meta["sonar"] = {"azimuth_fov_deg": 60.0}
    assert np.degrees(fan_geometry(ping).azimuth_edges_rad) == pytest.approx([-30, 30])
    assert fan_image(ping, 100).shape == (100, 100)


def test_more_beams_than_cv2_can_count():
    ping = make_ping(60, 40000, 4, fill=0.5)
    assert fan_image(ping, 100, scale="linear").max() == pytest.approx(0.5, abs=1e-5)


@pytest.mark.parametrize("height", [25, 60, 100, 333])
def test_thin_ring_is_never_lost(height):
    """One bin of 8192, far finer than a pixel: in every direction it is there, at every range alike."""
    for bin_ in (2000, 4111, 8000):
        ping = make_ping(90, 64, 8192)
        ping.intensity[:, bin_] = 1.0
        image, geometry = fan_image(ping, height), fan_geometry(ping, height)
        for azimuth in np.radians(np.linspace(-40, 40, 41)):
            column, row = geometry.pixel(azimuth, ping.range_m[bin_])
            row, column = round(float(row)), round(float(column))
            assert image[max(0, row - 1) : row + 2, max(0, column - 1) : column + 2].max() > 0.2


@pytest.mark.parametrize("height", [60, 200])
def test_thin_ray_is_never_lost(height):
    """One beam of 4096: along its whole length it is there."""
    for beam in (5, 1000, 2047, 4000):
        ping = make_ping(90, 4096, 300)
        ping.intensity[beam] = 1.0
        image, geometry = fan_image(ping, height), fan_geometry(ping, height)
        for range_m in np.linspace(1, 19.5, 60):
            column, row = geometry.pixel(ping.azimuth_rad[beam], range_m)
            row, column = round(float(row)), round(float(column))
            assert image[max(0, row - 1) : row + 2, max(0, column - 1) : column + 2].max() > 0.1


def test_speckle_keeps_its_mean_when_pixels_are_coarse():
    ping = make_ping(90, 1024, 4000)
    ping.intensity[:] = np.random.default_rng(0).exponential(0.3, ping.intensity.shape)
    image = fan_image(ping, 100, scale="linear")
    assert image[image > 0].mean() == pytest.approx(0.3, rel=0.02)


def test_fast_enough():
    """3 ms on an idle machine; a loose bound, for tests run where others work too."""
    ping = make_ping(45, 256, 1102, fill=0.1)
    fan_image(ping, 800)
    times = []
    for _ in range(20):
        start = time.perf_counter()
        fan_image(ping, 800)
        times.append(time.perf_counter() - start)
    assert min(times) < 0.02


def test_errors_of_fan_image():
    ping = make_ping()
    for keywords, message in (
        ({"scale": "dB"}, "unknown scale 'dB' of a fan image: did you mean 'db'?"),
        ({"height": 0}, "height of a fan image must be a whole number of pixels in 1..16000 (got 0)"),
        ({"height": 9.5}, "height of a fan image must be a whole number of pixels in 1..16000 (got 9.5)"),
        ({"db_range": (0, -60)}, "db_range must rise from the darkest to the brightest dB (got 0 and -60)"),
        ({"db_range": -60}, "db_range must be two numbers, darkest and brightest dB (got -60)"),
    ):
        with pytest.raises(Error) as caught:
            fan_image(ping, **keywords)
        assert str(caught.value) == message
    with pytest.raises(Error) as caught:
        fan_image(Ping(np.zeros((3, 4)), np.zeros(3), np.zeros(5)))
    assert str(caught.value) == (
        "a ping's intensity must be (beams, bins), at least one of each "
        "(got (3, 4) with 3 azimuths and 5 ranges)"
    )


@pytest.mark.parametrize("scale", ["db", "linear"])
def test_the_ping_stays_as_it_is(scale):
    """Few beams and bins: nothing is averaged before the scale is applied."""
    ping = make_ping(n_beams=16, n_bins=20, range_m=(10.0, 20.0), fill=7.0)
    ping.intensity.setflags(write=False)
    image = fan_image(ping, 400, scale)
    assert (ping.intensity == 7).all() and image.max() == 1


def test_pictures_do_not_share_memory():
    ping = make_ping(fill=0.1)
    first, second = fan_image(ping, 100), fan_image(ping, 100)
    assert not np.shares_memory(first, second) and first.flags.writeable
    assert not np.shares_memory(colorize(first), colorize(first))


def test_colours_of_what_lies_outside():
    """Cut to 0..1, and turned or sliced pictures too."""
    image = np.array([[-1.0, -0.001, 0.0, 0.5, 1.0, 1.2, 1e9]])
    for kind in (np.float16, np.float32, np.float64):
        with np.errstate(over="ignore"):  # 1e9 is infinite in 16 bits
            given = image.astype(kind)
        assert (colorize(given, "gray")[0, :, 0] == [0, 0, 0, 128, 255, 255, 255]).all()
    turned = np.linspace(0, 1, 12, dtype=np.float32).reshape(3, 4).T[::-1]
    assert (colorize(turned, "jet") == colorize(turned.copy(), "jet")).all()


def test_colours():
    assert colormaps()[0] == "gray" and {"jet", "inferno", "viridis", "twilight_shifted"} <= set(colormaps())
    ramp = np.linspace(0, 1, 256, dtype=np.float32).reshape(16, 16)
    for name in colormaps():
        picture = colorize(ramp, name)
        assert picture.shape == (16, 16, 3) and picture.dtype == np.uint8
    assert (colorize(ramp, "gray").reshape(256, 3) == np.arange(256)[:, None]).all()
    jet = colorize(ramp, "jet").reshape(256, 3).astype(int)
    assert jet[0].tolist() == [0, 0, 128] and jet[-1, 0] >= 127 and not jet[-1, 1:].any()  # RGB: blue to red


def test_errors_of_colours():
    for image, name, message in (
        (np.zeros((2, 2)), "jett", "unknown colour map 'jett': did you mean 'jet'?"),
        (
            np.zeros((2, 2), np.uint8),
            "jet",
            "colorize needs an image of shape (H, W), float 0..1 (got (2, 2), uint8)",
        ),
        (
            np.zeros((2, 2, 3)),
            "jet",
            "colorize needs an image of shape (H, W), float 0..1 (got (2, 2, 3), float64)",
        ),
    ):
        with pytest.raises(Error) as caught:
            colorize(image, name)
        assert str(caught.value) == message


@pytest.mark.parametrize("fov_deg", [1, 20, 90, 180, 270, 360])
def test_axes(fov_deg):
    ping = make_ping(fov_deg, range_m=(1.0, 27.0), fill=0.01)
    picture = colorize(fan_image(ping, 300), "viridis")
    before = picture.copy()
    drawn = draw_axes(picture, ping)
    assert (picture == before).all()
    margin = (drawn.shape[0] - 300) // 2
    assert margin > 20 and drawn.shape == (300 + 2 * margin, picture.shape[1] + 2 * margin, 3)
    assert drawn[:margin].any()  # labels stand in the margin
    geometry = fan_geometry(ping, 300)
    if fov_deg >= 20:  # most of the echo is as it was
        column, row = (
            np.rint(c).astype(int)
            for c in geometry.pixel(*np.meshgrid([0.05 if fov_deg < 90 else 0.4], [7, 12, 17, 22]))
        )
        assert (drawn[row + margin, column + margin] == picture[row, column]).all()


def test_errors_of_axes():
    ping = make_ping(60)
    with pytest.raises(Error) as caught:
        draw_axes(np.zeros((100, 90, 3), np.uint8), ping)
    assert str(caught.value) == (
        "draw_axes needs the (H, W, 3) uint8 picture of this ping's fan image, here (100, 100, 3) "
        "(got (100, 90, 3), uint8)"
    )
    with pytest.raises(Error, match=r"fan image \(got \(100, 100\), float64\)"):
        draw_axes(np.zeros((100, 100)), ping)


def test_geometry_is_plain_and_comparable():
    assert fan_geometry(make_ping(), 100) == fan_geometry(make_ping(), 100)
    assert isinstance(fan_geometry(make_ping(), 100), FanGeometry)
