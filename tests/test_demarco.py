"""The founding paper's picture."""

import math

import cv2
import numpy as np
import pytest

from sonar_gl.demarco import demarco_picture, stamp_rings
from sonar_gl.types import Error

CLEAN = {"cloud_sigma_m": 0.0, "median": 0, "salt_and_pepper": 0.0}
JET = cv2.applyColorMap(np.arange(256, dtype=np.uint8)[:, None], cv2.COLORMAP_JET)[:, 0, ::-1].astype(int)


def levels(picture):
    """Gray levels behind the Jet colours; 0 outside the fan and where nothing was drawn."""
    packed, table = (colours.astype(int) @ [65536, 256, 1] for colours in (picture, JET))
    order = np.argsort(table)
    found = order[np.searchsorted(table[order], packed).clip(0, 255)]
    return np.where(table[found] == packed, found, 0)


def centre(picture):
    rows, columns = np.nonzero(levels(picture))
    return columns.mean(), rows.mean()


def cloud(n=20000, seed=0, fov_rad=math.pi / 2):
    rng = np.random.default_rng(seed)
    azimuth, range_m = rng.uniform(-fov_rad / 2, fov_rad / 2, n), rng.uniform(0.5, 10, n)
    points = np.stack([range_m * np.cos(azimuth), range_m * np.sin(azimuth), rng.normal(0, 1, n)], axis=1)
    return points, rng.uniform(0, 255, n)


def scan(rows=40, columns=160, fov_rad=math.pi / 2):
    """A floor 2 m below and a post to port, as rays in rows would meet them."""
    elevation = np.radians(np.linspace(-40, -12, rows))[:, None]
    azimuth = np.linspace(-fov_rad / 2, fov_rad / 2, columns)
    direction = np.stack(
        np.broadcast_arrays(
            np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)
        ),
        axis=-1,
    )
    range_m = np.broadcast_to(-2 / np.sin(elevation), direction.shape[:2]).copy()
    post = np.abs(azimuth - 0.3) < 0.03
    range_m[:, post] = np.minimum(range_m[:, post], 5 / np.cos(elevation))
    return (direction * range_m[..., None]).reshape(-1, 3), np.where(
        np.broadcast_to(post, range_m.shape), 230.0, 90.0
    ).ravel()


def test_stamping_equals_circles_in_scan_order():
    rng = np.random.default_rng(3)
    for shape in ((40, 50), (1, 1), (1, 9), (7, 2)):
        n = 600
        pixels = np.stack([rng.integers(0, shape[0], n), rng.integers(0, shape[1], n)], axis=1)
        values = rng.uniform(0, 255, n)
        values[:50] = np.arange(50) + 0.5  # ties of the rounding
        want, got = np.zeros(shape, np.uint8), np.zeros(shape, np.uint8)
        for (row, column), value in zip(pixels.tolist(), values.tolist(), strict=True):
            cv2.circle(want, (column, row), 1, value, 1)
        stamp_rings(got, pixels, values)
        assert (got == want).all()


def test_port_is_left_and_the_sonar_below():
    point = np.array([[8.0, 2.0, 0.5]])
    column, row = centre(demarco_picture(point, [200.0], math.radians(90), 10.0, **CLEAN))
    width = math.ceil(1200 * math.sin(math.pi / 4))
    assert (column, row) == pytest.approx((width / 2 - 2 * 60, 600 - 8 * 60), abs=1)


@pytest.mark.parametrize("fov_deg", [20, 45, 90, 120, 130, 180, 270, 360])
def test_isotropic(fov_deg):
    """Two points a metre apart across and along lie equally far apart in the picture."""
    half = math.radians(fov_deg) / 2
    scale = 600 / 10 / (1 - min(0, math.cos(half)))
    at = [
        centre(demarco_picture(np.array([[x, y, 0.0]]), [255.0], 2 * half, 10.0, **CLEAN))
        for x, y in ((8.0, 0.0), (8.0, 1.0), (9.0, 0.0))
    ]
    assert at[0][0] - at[1][0] == pytest.approx(scale, abs=1)
    assert at[0][1] - at[2][1] == pytest.approx(scale, abs=1)


@pytest.mark.parametrize("fov_deg", [45, 90, 120, 130, 150])
def test_printed_is_anisotropic_and_mirrored(fov_deg):
    half = math.radians(fov_deg) / 2
    points = [np.array([[x, y, 0.0]]) for x, y in ((8.0, 0.0), (8.0, 2.0), (6.0, 0.0))]
    at = [
        centre(demarco_picture(p, [255.0], 2 * half, 10.0, form="printed", height=1000, **CLEAN))
        for p in points
    ]
    across, along = at[1][0] - at[0][0], at[2][1] - at[0][1]
    assert across > 0  # port on the right
    assert along == pytest.approx(200, abs=1)  # and forward up
    assert across / along == pytest.approx(1 / (2 * math.cos(half)), abs=0.01)
    picture = demarco_picture(points[0], [255.0], 2 * half, 10.0, form="printed", height=1000)
    assert picture.shape == (1000, math.ceil(1000 * math.tan(half) - 1e-6), 3)


def test_printed_equals_isotropic_at_120_but_for_the_mirror():
    points, intensity = cloud(fov_rad=math.radians(120))
    two = [
        demarco_picture(points, intensity, math.radians(120), 10.0, form=form, **CLEAN)
        for form in ("isotropic", "printed")
    ]
    assert two[0].shape == two[1].shape
    assert (two[0] == two[1][:, ::-1]).mean() > 0.995  # a rounding of the scale may move a point


def test_later_point_wins():
    points = np.array([[5.0, 0.0, 0.0], [5.0, 0.0, 0.0]])
    for values, level in (([200.0, 40.0], 40), ([40.0, 200.0], 200), ([40.0, 900.0], 255)):
        assert levels(demarco_picture(points, values, 1.5, 10.0, **CLEAN)).max() == level


def test_outside_the_fan_is_black_and_inside_is_jet():
    picture = demarco_picture(np.zeros((0, 3)), np.zeros(0), math.radians(90), 10.0, **CLEAN)
    inside = picture.any(axis=2)
    assert inside.sum() == pytest.approx(math.pi / 4 * 600**2, rel=0.01)
    assert (picture[inside] == JET[0]).all()


def test_rays_that_met_nothing_are_passed_over():
    points, intensity = cloud(500)
    gaps = np.concatenate([points, np.full((3, 3), np.nan), np.full((1, 3), np.inf)])
    values = np.concatenate([intensity, [np.nan, 5.0, 9.0, 9.0]])
    got = demarco_picture(gaps, values, 1.5, 10.0, **CLEAN)
    assert (got == demarco_picture(points, intensity, 1.5, 10.0, **CLEAN)).all()


def test_same_seed_same_bytes():
    points, intensity = cloud()
    pictures = [demarco_picture(points, intensity, 1.5, 10.0, seed=seed) for seed in (5, 5, 6)]
    assert (pictures[0] == pictures[1]).all() and (pictures[0] != pictures[2]).any()


def test_streams_are_independent():
    """Specks stay where they are whatever the cloud does; a larger fraction keeps a smaller one's."""
    none = np.full((1, 3), np.nan), np.zeros(1)
    fan = 1.5, 10.0
    quiet = {"cloud_sigma_m": 0.0, "median": 0, "seed": 2}
    few = levels(demarco_picture(*none, *fan, **quiet, salt_and_pepper=0.01)) == 255
    many = levels(demarco_picture(*none, *fan, **quiet, salt_and_pepper=0.05)) == 255
    assert few.any() and many[few].all()
    share = many.sum() / demarco_picture(*none, *fan, **CLEAN).any(axis=2).sum()
    assert share == pytest.approx(0.025, rel=0.1)
    points, intensity = cloud()
    dark = demarco_picture(points, 0 * intensity, *fan, median=0, seed=2, salt_and_pepper=0.01)
    assert ((levels(dark) == 255) == few).all()
    # and the cloud's noise does not feel the specks
    still = demarco_picture(points, intensity.clip(1, 250), *fan, median=0, seed=2, salt_and_pepper=0.0)
    specks = demarco_picture(points, intensity.clip(1, 250), *fan, median=0, seed=2, salt_and_pepper=0.01)
    assert (still != specks).any(axis=2).mean() < 0.011


def test_cloud_noise_has_the_asked_size():
    points = np.tile([5.0, 0.0, 0.0], (4000, 1))
    picture = demarco_picture(
        points, np.full(4000, 255.0), 1.5, 10.0, cloud_sigma_m=0.3, median=0, salt_and_pepper=0
    )
    rows, columns = np.nonzero(levels(picture))
    spread = 0.3 * 60
    assert 2 * spread < np.ptp(rows) / 2 < 5 * spread and 2 * spread < np.ptp(columns) / 2 < 5 * spread
    assert rows.mean() == pytest.approx(300, abs=0.2 * spread)


def test_polygons_fill_what_circles_leave_open():
    points, intensity = scan()
    fan = {"azimuth_fov_rad": math.radians(90), "range_max_m": 10.0, **CLEAN}
    circles = levels(demarco_picture(points, intensity, **fan)) > 0
    filled = levels(demarco_picture(points, intensity, **fan, join="polygons", grid_shape=(40, 160))) > 0
    assert filled.sum() > 1.5 * circles.sum()
    # a floor of one strength has no hole between its first and last ring, away from the post
    row, column = np.indices(filled.shape)
    x, y = (599.5 - row) / 60, (filled.shape[1] / 2 - 0.5 - column) / 60
    ground, azimuth = np.hypot(x, y), np.arctan2(y, x)
    floor = (ground > 2.6) & (ground < 9.2) & (azimuth < 0.2) & (azimuth > -0.75)
    assert filled[floor].all() and not circles[floor].all()


def test_polygons_do_not_bridge_jumps():
    """Two walls at 4 and 8 m: nothing is drawn between them."""
    azimuth = np.linspace(-0.5, 0.5, 101)
    range_m = np.where(azimuth < 0, 4.0, 8.0)
    row = np.stack([range_m * np.cos(azimuth), range_m * np.sin(azimuth), 0 * azimuth], axis=1)
    points = np.concatenate([row, row + np.array([0, 0, 0.1])])
    picture = demarco_picture(
        points, np.full(202, 200.0), 1.2, 10.0, join="polygons", grid_shape=(2, 101), **CLEAN
    )
    rows, columns = np.nonzero(levels(picture))
    range_seen = np.hypot(599.5 - rows, picture.shape[1] / 2 - 0.5 - columns) / 60
    assert ((np.abs(range_seen - 4) < 0.1) | (np.abs(range_seen - 8) < 0.1)).all()


def test_point_without_a_quad_keeps_its_circle():
    points = np.full((2, 3, 3), np.nan)
    points[0, 1] = [5.0, 0.0, 0.0]
    picture = demarco_picture(
        points.reshape(-1, 3), np.full(6, 200.0), 1.5, 10.0, join="polygons", grid_shape=(2, 3), **CLEAN
    )
    assert (levels(picture) == 200).sum() == 4


def test_errors():
    points, intensity = cloud(10)
    for keywords, message in (
        ({"form": "print"}, "unknown form 'print' of the picture: did you mean 'printed'?"),
        ({"join": "x"}, "unknown join 'x' of the picture: known are circles, polygons"),
        (
            {"form": "printed", "azimuth_fov_rad": math.pi},
            "the printed form divides by cos(θ_S / 2) and ends before 180° (got 180°; use form='isotropic')",
        ),
        (
            {"form": "printed", "azimuth_fov_rad": math.radians(179)},
            "the printed form makes a picture 68754 pixels wide of 179° "
            "(at most 16384; use form='isotropic' or less height)",
        ),
        ({"azimuth_fov_rad": 7.0}, "azimuth_fov_rad must be a number in 0.0001..6.28319 (got 7.0)"),
        ({"median": 4}, "median must be odd, or 0 for none (got 4)"),
        ({"height": 0}, "height must be a whole number in 1..16000 (got 0)"),
        ({"seed": -1}, "seed must be a whole number in 0..18446744073709551615 (got -1)"),
        ({"salt_and_pepper": 2}, "salt_and_pepper must be a number in 0..1 (got 2)"),
        ({"cloud_sigma_m": math.nan}, "cloud_sigma_m must be a number in 0..100000 (got nan)"),
        (
            {"join": "polygons"},
            "join='polygons' needs grid_shape = (rows, columns) with one cell for each of "
            "the 10 points (got None)",
        ),
        ({"points_xyz": np.zeros((3, 2))}, "points_xyz must have shape (N, 3) (got (3, 2))"),
        ({"intensity": np.zeros(3)}, "intensity must have shape (10,), one a point (got (3,))"),
        (
            {"intensity": np.full(10, np.nan)},
            "intensity must be a number wherever a point was met (got NaN)",
        ),
    ):
        asked = {"points_xyz": points, "intensity": intensity, "azimuth_fov_rad": 1.5, "range_max_m": 10.0}
        with pytest.raises(Error) as caught:
            demarco_picture(**{**asked, **keywords})
        assert str(caught.value) == message
