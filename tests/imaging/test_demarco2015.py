"""The founding paper's picture of point clouds."""

import math
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

import sonar_gl as sg
from sonar_gl.imaging.demarco2015 import PictureSettings, demarco_picture, stamp_rings
from tests.support.errors import error_of

CLEAN = {"cloud_sigma_m": 0.0, "median": 0, "salt_and_pepper": 0.0}
JET = cv2.applyColorMap(np.arange(256, dtype=np.uint8)[:, None], cv2.COLORMAP_JET)[:, 0, ::-1].astype(int)


def picture_of(points, intensity, fov_rad=1.5, grid_shape=None, **settings):
    """Return the picture of a cloud within 10 m."""
    return demarco_picture(points, intensity, PictureSettings(fov_rad, 10.0, **settings), grid_shape)


def levels(picture):
    """Return the gray levels of Jet colours; 0 outside the fan and where there is no point."""
    packed, table = (colours.astype(int) @ [65536, 256, 1] for colours in (picture, JET))
    order = np.argsort(table)
    found = order[np.searchsorted(table[order], packed).clip(0, 255)]
    return np.where(table[found] == packed, found, 0)


def centre(picture):
    """Return the mean (column, row) of the pixels that are not 0."""
    rows, columns = np.nonzero(levels(picture))
    return columns.mean(), rows.mean()


def cloud(n=20000, fov_rad=math.pi / 2):
    """Return random points (n, 3) within a fan and their intensities (n,)."""
    rng = np.random.default_rng(0)
    azimuth, range_m = rng.uniform(-fov_rad / 2, fov_rad / 2, n), rng.uniform(0.5, 10, n)
    points = np.stack([range_m * np.cos(azimuth), range_m * np.sin(azimuth), rng.normal(0, 1, n)], axis=1)
    return points, rng.uniform(0, 255, n)


def scan(rows=40, columns=160):
    """Return points and intensities of a scan by rows: a floor 2 m below, and a post to port."""
    elevation = np.radians(np.linspace(-40, -12, rows))[:, None]
    azimuth = np.linspace(-math.pi / 4, math.pi / 4, columns)
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


def test_rings_equal_cv2_circles_in_scan_order():
    rng = np.random.default_rng(3)
    for shape in ((40, 50), (1, 1), (1, 9), (7, 2)):
        n = 600
        pixels = np.stack([rng.integers(0, shape[0], n), rng.integers(0, shape[1], n)], axis=1)
        values = rng.uniform(0, 255, n)
        values[:50] = np.arange(50) + 0.5  # ties of rounding
        expected, found = np.zeros(shape, np.uint8), np.zeros(shape, np.uint8)
        for (row, column), value in zip(pixels.tolist(), values.tolist(), strict=True):
            cv2.circle(expected, (column, row), 1, value, 1)
        stamp_rings(found, pixels, values)
        assert (found == expected).all()


def test_port_is_left_and_the_sonar_at_the_bottom():
    point = np.array([[8.0, 2.0, 0.5]])
    column, row = centre(picture_of(point, [200.0], math.radians(90), **CLEAN))
    width = math.ceil(1200 * math.sin(math.pi / 4))
    assert (column, row) == pytest.approx((width / 2 - 2 * 60, 600 - 8 * 60), abs=1)


@pytest.mark.parametrize("fov_deg", [20, 180, 360])
def test_isotropic(fov_deg):
    """A metre is as long across as along."""
    half = math.radians(fov_deg) / 2
    scale = 600 / 10 / (1 - min(0, math.cos(half)))
    at = [
        centre(picture_of(np.array([[x, y, 0.0]]), [255.0], 2 * half, **CLEAN))
        for x, y in ((8.0, 0.0), (8.0, 1.0), (9.0, 0.0))
    ]
    assert at[0][0] - at[1][0] == pytest.approx(scale, abs=1)
    assert at[0][1] - at[2][1] == pytest.approx(scale, abs=1)


@pytest.mark.slow
@pytest.mark.parametrize(
    "fov_deg", [90, *(pytest.param(fov_deg, marks=pytest.mark.slow) for fov_deg in (45, 120, 130, 150))]
)
def test_printed_is_anisotropic_and_mirrored(fov_deg):
    half = math.radians(fov_deg) / 2
    points = [np.array([[x, y, 0.0]]) for x, y in ((8.0, 0.0), (8.0, 2.0), (6.0, 0.0))]
    at = [centre(picture_of(p, [255.0], 2 * half, form="printed", height=1000, **CLEAN)) for p in points]
    across, along = at[1][0] - at[0][0], at[2][1] - at[0][1]
    assert across > 0  # port on the right
    assert along == pytest.approx(200, abs=1)  # and forward up
    assert across / along == pytest.approx(1 / (2 * math.cos(half)), abs=0.01)
    picture = picture_of(points[0], [255.0], 2 * half, form="printed", height=1000)
    assert picture.shape == (1000, math.ceil(1000 * math.tan(half) - 1e-6), 3)


def test_printed_mirrors_isotropic_at_120_degrees():
    points, intensity = cloud(fov_rad=math.radians(120))
    two = [
        picture_of(points, intensity, math.radians(120), form=form, **CLEAN)
        for form in ("isotropic", "printed")
    ]
    assert two[0].shape == two[1].shape
    assert (two[0] == two[1][:, ::-1]).mean() > 0.995  # rounding of the scale may move a point


@pytest.mark.parametrize(
    ("values", "level"), [([200.0, 40.0], 40), ([40.0, 200.0], 200), ([40.0, 900.0], 255)]
)
def test_later_point_wins(values, level):
    points = np.array([[5.0, 0.0, 0.0], [5.0, 0.0, 0.0]])
    assert set(np.unique(levels(picture_of(points, values, **CLEAN)))) == {0, level}


def test_outside_the_fan_is_black_and_inside_is_jet():
    picture = picture_of(np.zeros((0, 3)), np.zeros(0), math.radians(90), **CLEAN)
    inside = picture.any(axis=2)
    # pixels round along the rim, which is 600 (π/2 + 2) of them long
    assert inside.sum() == pytest.approx(math.pi / 4 * 600**2, abs=600 * (math.pi / 2 + 2) / 10)
    assert (picture[inside] == JET[0]).all()


def test_rays_that_met_nothing_are_left_out():
    points, intensity = cloud(500)
    gaps = np.concatenate([points, np.full((3, 3), np.nan), np.full((1, 3), np.inf)])
    values = np.concatenate([intensity, [np.nan, 5.0, 9.0, 9.0]])
    assert (picture_of(gaps, values, **CLEAN) == picture_of(points, intensity, **CLEAN)).all()


def test_same_seed_same_bytes():
    points, intensity = cloud()
    pictures = [picture_of(points, intensity, seed=seed) for seed in (5, 5, 6)]
    assert (pictures[0] == pictures[1]).all() and (pictures[0] != pictures[2]).any()


def test_a_larger_fraction_of_salt_adds_to_a_smaller_one():
    nothing = np.full((1, 3), np.nan), np.zeros(1)
    quiet = {"cloud_sigma_m": 0.0, "median": 0, "seed": 2}
    few, many = (levels(picture_of(*nothing, **quiet, salt_and_pepper=n)) == 255 for n in (0.01, 0.05))
    assert few.any() and many[few].all()
    share = many.sum() / picture_of(*nothing, **CLEAN).any(axis=2).sum()
    assert share == pytest.approx(0.025, rel=0.1)


def test_salt_does_not_depend_on_the_cloud():
    nothing, (points, intensity) = (np.full((1, 3), np.nan), np.zeros(1)), cloud()
    noise = {"median": 0, "seed": 2, "salt_and_pepper": 0.01}
    salt = levels(picture_of(*nothing, **noise, cloud_sigma_m=0.0)) == 255
    assert ((levels(picture_of(points, 0 * intensity, **noise)) == 255) == salt).all()


def test_the_cloud_does_not_depend_on_salt():
    points, intensity = cloud()
    clean, salted = (
        picture_of(points, intensity.clip(1, 250), median=0, seed=2, salt_and_pepper=n) for n in (0.0, 0.01)
    )
    assert 0 < (clean != salted).any(axis=2).mean() < 0.011


def test_size_of_the_clouds_noise():
    points = np.tile([5.0, 0.0, 0.0], (4000, 1))
    noise = {"cloud_sigma_m": 0.3, "median": 0, "salt_and_pepper": 0}
    rows, columns = np.nonzero(levels(picture_of(points, np.full(4000, 255.0), **noise)))
    sigma = 0.3 * 60  # pixels
    assert 2 * sigma < np.ptp(rows) / 2 < 5 * sigma and 2 * sigma < np.ptp(columns) / 2 < 5 * sigma
    assert rows.mean() == pytest.approx(300, abs=0.2 * sigma)


def test_polygons_fill_gaps_between_circles():
    points, intensity = scan()
    fan = {"fov_rad": math.radians(90), **CLEAN}
    circles = levels(picture_of(points, intensity, **fan)) > 0
    filled = levels(picture_of(points, intensity, **fan, join="polygons", grid_shape=(40, 160))) > 0
    assert filled.sum() > 1.5 * circles.sum()
    # the floor has no hole between its first and last row, away from the post
    row, column = np.indices(filled.shape)
    x, y = (599.5 - row) / 60, (filled.shape[1] / 2 - 0.5 - column) / 60
    ground, azimuth = np.hypot(x, y), np.arctan2(y, x)
    floor = (ground > 2.6) & (ground < 9.2) & (azimuth < 0.2) & (azimuth > -0.75)
    assert filled[floor].all() and not circles[floor].all()


@pytest.mark.parametrize("far_m", [4.43, 8.0])
def test_polygons_do_not_bridge_jumps(far_m):
    """The range between a wall at 4 m and one behind it by more than a tenth of that stays empty."""
    azimuth = np.linspace(-0.5, 0.5, 101)
    range_m = np.where(azimuth < 0, 4.0, far_m)
    row = np.stack([range_m * np.cos(azimuth), range_m * np.sin(azimuth), 0 * azimuth], axis=1)
    points = np.concatenate([row, row + np.array([0, 0, 0.1])])
    picture = picture_of(points, np.full(202, 200.0), 1.2, (2, 101), join="polygons", **CLEAN)
    rows, columns = np.nonzero(levels(picture))
    found_m = np.hypot(599.5 - rows, picture.shape[1] / 2 - 0.5 - columns) / 60
    assert ((np.abs(found_m - 4) < 0.1) | (np.abs(found_m - far_m) < 0.1)).all()


def test_a_quad_has_the_mean_of_its_corners():
    points = np.array([[6.0, 0.2, 0], [6.0, -0.2, 0], [6.4, 0.2, 0], [6.4, -0.2, 0]])
    picture = picture_of(points, [100, 120, 180, 200], grid_shape=(2, 2), join="polygons", **CLEAN)
    assert set(np.unique(levels(picture)).tolist()) == {0, 150}


def test_the_fan_is_symmetric():
    inside = picture_of(np.full((1, 3), np.nan), np.zeros(1), **CLEAN).any(axis=2)
    np.testing.assert_array_equal(inside, inside[:, ::-1])
    assert inside[0].any() and inside.mean() == pytest.approx(
        1.5 / (4 * np.sin(0.75)), rel=2e-3
    )  # of 2 R² sin(θ/2)


def test_the_picture_of_a_simulator_has_the_papers_rays_within_the_sonars_range_by_its_range_law():
    sonar = sg.Sonar("paper", 900e3, 16, 100, 45.0, 20.0, 1.0, 1.0, 10.0)
    azimuth, range_m = np.radians(np.linspace(22, -22, 280)), np.tile(np.linspace(0.5, 11, 280), (70, 1))
    points = np.stack([range_m * np.cos(azimuth), range_m * np.sin(azimuth), 0 * range_m], axis=-1)
    asked, acoustics = [], sg.Acoustics.demarco2015("inverse")

    def point_cloud(_, columns, rows):
        asked.append((rows, columns))
        return points, np.full(range_m.shape, 0.8)

    simulator = SimpleNamespace(sonar=sonar, acoustics=acoustics, point_cloud=point_cloud)
    picture = sg.demarco_image(simulator, np.eye(4), noise=sg.Noise.none(), height=200)
    shown = (range_m >= 1) & (range_m < 10)
    intensity = (255 * 0.8 * acoustics.range_gain(range_m, sonar))[shown]
    wanted = demarco_picture(points[shown], intensity, PictureSettings(math.radians(45), 10.0, 200, **CLEAN))
    assert asked == [range_m.shape] and levels(wanted).max() > 2 * levels(wanted)[levels(wanted) > 0].min()
    np.testing.assert_array_equal(picture, wanted)


def test_point_in_no_quad_has_its_circle():
    points = np.full((2, 3, 3), np.nan)
    points[0, 1] = [5.0, 0.0, 0.0]
    cloud = points.reshape(-1, 3), np.full(6, 200.0)
    picture = picture_of(*cloud, grid_shape=(2, 3), join="polygons", **CLEAN)
    assert (levels(picture) == 200).sum() == 4


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"form": "print"}, "unknown form of the picture (got 'print'; did you mean 'printed'?)"),
        ({"join": "x"}, "unknown join of the picture (got 'x'; known are circles, polygons)"),
        ({"form": "printed", "azimuth_fov_rad": math.pi}, "the printed form divides by cos(θ_S / 2) and"),
        ({"height": 0}, "height must be a whole number in 1..16000 (got 0)"),
        ({"seed": -1}, "seed must be a whole number in 0..18446744073709551615 (got -1)"),
    ],
)
def test_wrong_settings(settings, message):
    found = error_of(PictureSettings, **{"azimuth_fov_rad": 1.5, "range_max_m": 10.0, **settings})
    assert found.startswith(message)


def test_a_printed_picture_that_would_be_too_wide():
    assert error_of(picture_of, *cloud(10), math.radians(179), form="printed") == (
        "the printed form makes a picture 68754 pixels wide of 179° "
        "(at most 16384; use form='isotropic' or less height)"
    )
