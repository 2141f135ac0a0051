"""The founding paper's picture: from the rays' point cloud to a Jet image [1]_.

Gaussian noise on the cloud, eqs. (8)-(9), a circle a point, median blur, salt and pepper, Jet, black
outside the fan. The paper's text is followed; where it leaves something open, its author's published code.

References
----------
.. [1] K. J. DeMarco, M. E. West, A. M. Howard, "A Computationally-Efficient 2D Imaging Sonar Model for
   Underwater Robotics Simulations in Gazebo", OCEANS 2015, Washington
"""

from __future__ import annotations

import math

import cv2
import numpy as np

from sonar_gl.types import Error, nearest_names

RING = (
    (-1, 0),
    (0, -1),
    (0, 1),
    (1, 0),
)  # (row, column): all that cv2.circle draws for radius 1, thickness 1
MAX_JUMP = 0.1  # of the nearest corner's range: a floor seen at 3° stays joined, a pylon before it does not
MAX_WIDTH = 16384
_CLOUD, _SPECKS = 1, 2  # a random stream a term, so that changing one leaves the other as it was


def demarco_picture(
    points_xyz: np.ndarray,
    intensity: np.ndarray,
    azimuth_fov_rad: float,
    range_max_m: float,
    height: int = 600,
    form: str = "isotropic",
    join: str = "circles",
    grid_shape: tuple[int, int] | None = None,
    cloud_sigma_m: float = 0.01,
    median: int = 3,
    salt_and_pepper: float = 0.005,
    seed: int = 0,
) -> np.ndarray:
    """Picture of a point cloud in the way of the founding paper.

    Parameters
    ----------
    points_xyz : (N, 3), metres, sonar frame (x forward, y port, z up), in scan order, row by row; NaN or
        infinite where a ray met nothing
    intensity : (N,), 0..255; cut to that span
    azimuth_fov_rad : width of the fan θ_S
    range_max_m : R, metres
    height : H, pixels
    form : "isotropic" or "printed", see Notes
    join : "circles", or "polygons": the paper's future work, areas between neighbouring points
    grid_shape : (rows, columns) of the scan, for "polygons"
    cloud_sigma_m : standard deviation of the Gaussian noise on x, y and z, metres
    median : size of the median blur, odd, pixels; 0 or 1 for none
    salt_and_pepper : fraction of the pixels turned white or black, half each
    seed : the same seed gives the same bytes

    Returns
    -------
    array of shape (H, W, 3), uint8 RGB

    Notes
    -----
    "isotropic", as in the author's code: s = H / R, column W/2 − y s, row H − x s, so port is on the
    left and the sonar at the bottom; W = ⌈2 H sin(θ_S / 2)⌉; beyond 180° as for a fan image, the fan
    goes on below the sonar. x and y are those of the point: one above or below the sonar's plane comes
    nearer than its slant range.

    "printed", eqs. (8)-(9) to the letter: s_x = H / (2 cos(θ_S / 2) R) across and s_y = H / R along,
    W = H tan(θ_S / 2), drawn with the sonar on top and then turned by 180°. So port comes to lie on the
    *right*, and the scales differ by 1 / (2 cos(θ_S / 2)), equal at 120° alone and infinite at 180°.

    Circles have radius 1, and of two the later point wins, as in cv2.circle called in scan order. It
    draws the rim, so after the median blur a point with no neighbour is gone. Polygons are quads
    between four neighbours of the grid, filled with their mean intensity, the later one winning; a quad is
    left out where a corner is missing or where its corners' ranges differ by more than a tenth of the
    nearest one's, and points in no quad keep their circle. The author's code adds the noise to x alone;
    the paper's text, to the cloud.

    Raises
    ------
    Error
        if shapes or numbers make no sense, or the printed form is asked for at 180° or more.
    """
    points, values = _cloud(points_xyz, intensity)
    for what, number, low, high in (
        ("azimuth_fov_rad", azimuth_fov_rad, 1e-4, 2 * math.pi + 1e-9),
        ("range_max_m", range_max_m, 1e-3, 1e5),
        ("cloud_sigma_m", cloud_sigma_m, 0.0, 1e5),
        ("salt_and_pepper", salt_and_pepper, 0.0, 1.0),
    ):
        if (
            isinstance(number, bool)
            or not isinstance(number, (int, float, np.number))
            or not low <= number <= high
        ):
            raise Error(f"{what} must be a number in {low:g}..{high:g} (got {number!r})")
    for what, number, high in (("height", height, 16000), ("median", median, 255), ("seed", seed, 2**64 - 1)):
        low = 1 if what == "height" else 0
        if isinstance(number, bool) or not isinstance(number, (int, np.integer)) or not low <= number <= high:
            raise Error(f"{what} must be a whole number in {low}..{high} (got {number!r})")
    if median % 2 == 0 and median != 0:
        raise Error(f"median must be odd, or 0 for none (got {median})")
    for what, name, known in (
        ("form", form, ("isotropic", "printed")),
        ("join", join, ("circles", "polygons")),
    ):
        if name not in known:
            raise Error(f"unknown {what} {name!r} of the picture: {nearest_names(str(name), known)}")

    if cloud_sigma_m > 0:
        points = points + cloud_sigma_m * _stream(seed, _CLOUD).standard_normal(points.shape)
    shape, scale, origin = _layout(form, azimuth_fov_rad, range_max_m, height)
    column = origin[0] - points[:, 1] * scale[0]
    row = origin[1] - points[:, 0] * scale[1]
    seen = np.isfinite(points).all(axis=1)
    with np.errstate(invalid="ignore"):
        seen &= (column >= 0) & (column < shape[1]) & (row >= 0) & (row < shape[0])
    # a pixel holds what lies between its edges
    pixels = np.stack([row, column], axis=1)
    pixels = np.floor(np.where(seen[:, None], pixels, -1)).astype(np.int64)
    image = np.zeros(shape, np.uint8)
    if join == "polygons":
        quads = _quads(points, seen, grid_shape)
        alone = seen.copy()
        alone[quads] = False
        stamp_rings(image, pixels[alone], values[alone])
        for corners in quads:
            # cv2 wants (column, row); the mean rounds as the circles' values do
            outline = pixels[corners, ::-1].astype(np.int32)
            cv2.fillPoly(image, [outline], float(np.rint(values[corners].mean())))
    else:
        stamp_rings(image, pixels[seen], values[seen])
    if median > 1:
        image = cv2.medianBlur(image, int(median))
    draw = _stream(seed, _SPECKS).random(shape)  # one number a pixel whatever the fraction
    image[draw < salt_and_pepper / 2] = 0
    image[draw > 1 - salt_and_pepper / 2] = 255
    picture = cv2.cvtColor(cv2.applyColorMap(image, cv2.COLORMAP_JET), cv2.COLOR_BGR2RGB)
    picture[~_inside(shape, scale, origin, azimuth_fov_rad, range_max_m)] = 0
    # eqs. (8)-(9) have the sonar on top and port on the left; turned by 180° that is the mirror
    # image of the isotropic picture, and port is on the right
    return np.ascontiguousarray(picture[:, ::-1]) if form == "printed" else picture


def stamp_rings(image: np.ndarray, pixels: np.ndarray, values: np.ndarray) -> None:
    """Draw a circle of radius 1 about each pixel, in place, the later one winning.

    Equal to cv2.circle(image, (column, row), 1, value, 1) called point by point.

    Parameters
    ----------
    image : (H, W) uint8
    pixels : (N, 2) integers, (row, column), centres within the image
    values : (N,) 0..255, rounded
    """
    padded = np.zeros((image.shape[0] + 2, image.shape[1] + 2), np.uint8)
    padded[1:-1, 1:-1] = image
    stride = padded.shape[1]
    offsets = np.array([row * stride + column for row, column in RING])
    index = ((pixels[:, 0] + 1) * stride + pixels[:, 1] + 1)[:, None] + offsets
    # of repeated indices NumPy keeps the last
    padded.reshape(-1)[index.reshape(-1)] = np.repeat(np.rint(values).astype(np.uint8), len(RING))
    image[:] = padded[1:-1, 1:-1]


def _cloud(points_xyz, intensity) -> tuple[np.ndarray, np.ndarray]:
    points, values = np.asarray(points_xyz, np.float64), np.asarray(intensity, np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise Error(f"points_xyz must have shape (N, 3) (got {points.shape})")
    if values.shape != points.shape[:1]:
        raise Error(f"intensity must have shape {points.shape[:1]}, one a point (got {values.shape})")
    if np.isnan(values[np.isfinite(points).all(axis=1)]).any():
        raise Error("intensity must be a number wherever a point was met (got NaN)")
    return points, np.nan_to_num(values).clip(0, 255)


def _stream(seed: int, term: int) -> np.random.Generator:
    return np.random.Generator(np.random.Philox(key=np.array([seed, term], np.uint64)))


def _layout(form: str, fov_rad: float, range_max_m: float, height: int):
    """(rows, columns), pixels per metre (across, along) and the sonar's (column, row) at pixel edges."""
    half = fov_rad / 2
    if form == "printed":
        if fov_rad >= math.pi - 1e-9:
            raise Error(
                "the printed form divides by cos(θ_S / 2) and ends before 180° "
                f"(got {math.degrees(fov_rad):g}°; use form='isotropic')"
            )
        width = max(1, math.ceil(height * math.tan(half) - 1e-6))
        scale = (height / (2 * math.cos(half) * range_max_m), height / range_max_m)
        if width > MAX_WIDTH:
            raise Error(
                f"the printed form makes a picture {width} pixels wide of {math.degrees(fov_rad):g}° "
                f"(at most {MAX_WIDTH}; use form='isotropic' or less height)"
            )
    else:
        along = height / range_max_m / (1 - min(0.0, math.cos(half)))
        scale = (along, along)
        width = max(1, math.ceil(2 * along * range_max_m * math.sin(min(half, math.pi / 2)) - 1e-6))
    return (int(height), width), scale, (width / 2, scale[1] * range_max_m)


def _quads(points, seen, grid_shape) -> np.ndarray:
    """(Q, 4) indices of the corners, round the quad, row by row."""
    if grid_shape is None or len(grid_shape) != 2 or math.prod(grid_shape) != len(points):
        raise Error(
            f"join='polygons' needs grid_shape = (rows, columns) with one cell for each of "
            f"the {len(points)} points (got {grid_shape})"
        )
    index = np.arange(len(points)).reshape(grid_shape)
    around = (index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1])
    quads = np.stack(around, axis=-1).reshape(-1, 4)
    quads = quads[seen[quads].all(axis=1)]
    range_m = np.linalg.norm(points, axis=1)[quads]
    return quads[np.ptp(range_m, axis=1) <= MAX_JUMP * range_m.min(axis=1)]


def _inside(shape, scale, origin, fov_rad: float, range_max_m: float) -> np.ndarray:
    """Which pixels' centres lie in the fan."""
    row, column = np.ogrid[: shape[0], : shape[1]]
    x, y = (origin[1] - 0.5 - row) / scale[1], (origin[0] - 0.5 - column) / scale[0]
    return (np.hypot(x, y) <= range_max_m) & (np.abs(np.arctan2(y, x)) <= fov_rad / 2)
