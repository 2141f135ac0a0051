"""The founding paper's picture, made from its sensor's point cloud [1]_.

Gaussian noise on the point cloud, a circle per point by eqs. (8)-(9), median blur, salt and pepper, the Jet
colour map, black outside the fan. Where the paper's text is silent, its author's published code decides.

References
----------
.. [1] K. J. DeMarco, M. E. West, A. M. Howard, "A Computationally-Efficient 2D Imaging Sonar Model for
   Underwater Robotics Simulations in Gazebo", OCEANS 2015, Washington
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike

from sonar_gl.acoustics.acoustics import Acoustics
from sonar_gl.core.checks import check_choice, check_kind, check_whole_number
from sonar_gl.core.errors import Error
from sonar_gl.noise.settings import Noise

RANGE_LAWS = ("printed", "constant", "inverse")
# (row, column) of the pixels that cv2.circle draws for radius 1, thickness 1
RING = ((-1, 0), (0, -1), (0, 1), (1, 0))
# Part of the nearest corner's range: a floor at a grazing angle of 3° stays joined, a pylon before it not.
MAX_JUMP = 0.1
MAX_WIDTH = 16384
# Random streams, one per term: changing the amount of one leaves the numbers of the other.
_CLOUD_STREAM, _SALT_AND_PEPPER_STREAM = 1, 2


def demarco_image(
    simulator,
    pose: ArrayLike,
    seed: int = 0,
    noise: Noise | None = None,
    height: int = 600,
    form: str = "isotropic",
    join: str = "circles",
    range_law: str | None = None,
) -> np.ndarray:
    """Return the founding paper's picture of a scene, from rays as dense as its sensor's.

    Its sensor has 280 x 70 rays in 45° x 20°.

    Parameters
    ----------
    simulator : Simulator, for its scene and sonar
    pose : (4, 4) world_from_sonar
    noise : Noise; None is `Noise.demarco2015()`
    seed : of the noise; the same seed gives the same bytes
    height : pixels; the width follows from the fan
    form : "isotropic", equal scales; or "printed", eqs. (8)-(9) of the paper
    join : "circles", or "polygons" between neighbouring points
    range_law : eq. (4) as "printed", "constant" or "inverse"; None takes the simulator's own if it is one of
        these, else "printed"

    Returns
    -------
    array of shape (H, W, 3), uint8 RGB

    Raises
    ------
    Error
        if a setting is out of bounds or unknown.
    """
    check_kind("noise", noise, Noise | None, "such as sonar_gl.Noise.demarco2015()")
    noise = Noise.demarco2015() if noise is None else noise
    if not hasattr(simulator, "point_cloud"):  # its class is of a layer above
        raise Error(
            f"simulator must be a Simulator (got {type(simulator).__name__}; such as sonar_gl.Simulator(scene, sonar))"
        )
    sonar = simulator.sonar
    settings = PictureSettings(
        azimuth_fov_rad=math.radians(sonar.azimuth_fov_deg),
        range_max_m=sonar.range_max_m,
        height=height,
        form=form,
        join=join,
        cloud_sigma_m=noise.cloud_gaussian_m,
        median=noise.median,
        salt_and_pepper=noise.salt_and_pepper,
        seed=seed,
    )
    columns = max(2, round(280 / 45 * sonar.azimuth_fov_deg))
    rows = max(2, round(70 / 20 * sonar.elevation_fov_deg))
    points, echo = simulator.point_cloud(pose, columns, rows)
    points = points.astype(np.float64)
    range_m = np.linalg.norm(points, axis=-1)
    points[~((range_m >= sonar.range_min_m) & (range_m < sonar.range_max_m))] = np.nan
    own = simulator.acoustics.range_law
    law = range_law or (own if own in RANGE_LAWS else "printed")
    gain = Acoustics.demarco2015(law).range_gain(np.nan_to_num(range_m), sonar)
    return demarco_picture(points.reshape(-1, 3), (255 * echo * gain).ravel(), settings, echo.shape)


@dataclass(frozen=True)
class PictureSettings:
    """Settings of `demarco_picture`.

    Raises Error if height, seed, form or join is out of bounds or unknown, or the printed form is chosen for a fan of
    180° or more. The other settings are those of a `Sonar` and a `Noise`, which have checked them.

    "isotropic", as in the author's code: s = H / R, column W/2 − y s, row H − x s. Port is on the left and
    the sonar at the bottom; W = ⌈2 H sin(θ_S / 2)⌉. Beyond 180° the fan continues below the sonar, as in a
    fan image. x and y are the point's own: a point above or below the sonar's plane appears nearer than its
    slant range.

    "printed", eqs. (8)-(9) to the letter: s_x = H / (2 cos(θ_S / 2) R) across and s_y = H / R along,
    W = H tan(θ_S / 2), with the sonar on top, then turned by 180°. So port is on the *right*, and the scales
    differ by 1 / (2 cos(θ_S / 2)): equal at 120° alone, infinitely different at 180°.

    azimuth_fov_rad : width of the fan θ_S
    range_max_m : R, metres
    height : H, pixels
    form : "isotropic" or "printed", see above
    join : "circles", or "polygons": the paper's future work, areas between neighbouring points
    cloud_sigma_m : standard deviation of the Gaussian noise on x, y and z, metres
    median : size of the median blur, odd, pixels; 0 or 1 for none
    salt_and_pepper : fraction of the pixels set to white or black, half each
    seed : the same seed gives the same bytes
    """

    azimuth_fov_rad: float
    range_max_m: float
    height: int = 600
    form: str = "isotropic"
    join: str = "circles"
    cloud_sigma_m: float = 0.01
    median: int = 3
    salt_and_pepper: float = 0.005
    seed: int = 0

    def __post_init__(self):
        for key, low, high in (("height", 1, 16000), ("seed", 0, 2**64 - 1)):
            check_whole_number(key, getattr(self, key), low, high)
        for key, known in (("form", ("isotropic", "printed")), ("join", ("circles", "polygons"))):
            check_choice(f"{key} of the picture", getattr(self, key), known)
        if self.form == "printed" and self.azimuth_fov_rad >= math.pi - 1e-9:
            raise Error(
                "the printed form divides by cos(θ_S / 2) and ends before 180° "
                f"(got {math.degrees(self.azimuth_fov_rad):g}°; use form='isotropic')"
            )


@dataclass(frozen=True)
class _Layout:
    """Where points of the sonar's plane lie in the picture. Positions are pixels from its top left edge.

    rows, columns : size, pixels
    across_px_m, along_px_m : scales of y and x, pixels per metre
    """

    rows: int
    columns: int
    across_px_m: float
    along_px_m: float
    azimuth_fov_rad: float
    range_max_m: float

    @classmethod
    def from_settings(cls, settings: PictureSettings) -> _Layout:
        """Return the layout of a picture; the printed form's is mirrored."""
        fov_rad, range_max_m, height = settings.azimuth_fov_rad, settings.range_max_m, settings.height
        half = fov_rad / 2
        if settings.form == "printed":
            columns = max(1, math.ceil(height * math.tan(half) - 1e-6))
            across, along = height / (2 * math.cos(half) * range_max_m), height / range_max_m
            if columns > MAX_WIDTH:
                raise Error(
                    f"the printed form makes a picture {columns} pixels wide of {math.degrees(fov_rad):g}° "
                    f"(at most {MAX_WIDTH}; use form='isotropic' or less height)"
                )
        else:
            across = along = height / range_max_m / (1 - min(0.0, math.cos(half)))
            columns = max(1, math.ceil(2 * along * range_max_m * math.sin(min(half, math.pi / 2)) - 1e-6))
        return cls(int(height), columns, across, along, fov_rad, range_max_m)

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns)."""
        return self.rows, self.columns

    @property
    def sonar(self) -> tuple[float, float]:
        """(row, column) of the sonar."""
        return self.along_px_m * self.range_max_m, self.columns / 2

    def pixels(self, points_xyz: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the pixels of points, (N, 2) int64 rows and columns, and which points are finite and inside.

        Pixels of points outside are −1.
        """
        sonar_row, sonar_column = self.sonar
        row = sonar_row - points_xyz[:, 0] * self.along_px_m
        column = sonar_column - points_xyz[:, 1] * self.across_px_m
        inside = np.isfinite(points_xyz).all(axis=1)
        with np.errstate(invalid="ignore"):
            inside &= (column >= 0) & (column < self.columns) & (row >= 0) & (row < self.rows)
        pixels = np.where(inside[:, None], np.stack([row, column], axis=1), -1)
        return np.floor(pixels).astype(np.int64), inside

    def fan(self) -> np.ndarray:
        """Return which pixels' centres lie in the fan, (H, W) bool."""
        (sonar_row, sonar_column), (row, column) = self.sonar, np.ogrid[: self.rows, : self.columns]
        x, y = (sonar_row - 0.5 - row) / self.along_px_m, (sonar_column - 0.5 - column) / self.across_px_m
        return (np.hypot(x, y) <= self.range_max_m) & (np.abs(np.arctan2(y, x)) <= self.azimuth_fov_rad / 2)


def demarco_picture(
    points_xyz: np.ndarray,
    intensity: np.ndarray,
    settings: PictureSettings,
    grid_shape: tuple[int, int] | None = None,
) -> np.ndarray:
    """Return the founding paper's picture of a point cloud, (H, W, 3) uint8 RGB.

    Raises Error if the picture would be too wide.

    Circles have radius 1, and the later point wins, as in cv2.circle called in scan order. It draws the rim
    alone, so the median blur removes a point without neighbours. Polygons are quads between four neighbours
    of the grid, filled with their mean intensity; the later one wins. A quad is left out if a corner is
    missing, or if its corners' ranges differ by more than MAX_JUMP of the nearest one's. Points in no quad
    have their circle. The author's code adds the noise to x alone; the paper's text, followed here, adds it
    to all coordinates.

    points_xyz : (N, 3) float64, metres, sonar frame (x forward, y port, z up), in scan order, row by row; NaN or
        infinite for rays that met nothing
    intensity : (N,), clipped to 0..255
    grid_shape : (rows, columns) of the scan, for "polygons"
    """
    points, values = points_xyz, np.asarray(intensity, np.float64).clip(0, 255)
    if settings.cloud_sigma_m > 0:
        normals = _stream(settings.seed, _CLOUD_STREAM).standard_normal(points.shape)
        points = points + settings.cloud_sigma_m * normals
    layout = _Layout.from_settings(settings)
    pixels, inside = layout.pixels(points)
    image = np.zeros(layout.shape, np.uint8)
    if settings.join == "polygons":
        quads = _quads(points, inside, grid_shape)
        single = inside.copy()
        single[quads] = False
        stamp_rings(image, pixels[single], values[single])
        for corners in quads:
            # cv2 takes (column, row); the mean is rounded as the circles' values are
            outline = pixels[corners, ::-1].astype(np.int32)
            cv2.fillPoly(image, [outline], float(np.rint(values[corners].mean())))
    else:
        stamp_rings(image, pixels[inside], values[inside])
    if settings.median > 1:
        image = cv2.medianBlur(image, int(settings.median))
    # one random number per pixel, whatever the fraction
    uniform = _stream(settings.seed, _SALT_AND_PEPPER_STREAM).random(layout.shape)
    image[uniform < settings.salt_and_pepper / 2] = 0
    image[uniform > 1 - settings.salt_and_pepper / 2] = 255
    picture = cv2.cvtColor(cv2.applyColorMap(image, cv2.COLORMAP_JET), cv2.COLOR_BGR2RGB)
    picture[~layout.fan()] = 0
    # eqs. (8)-(9) put the sonar on top and port on the left. Turned by 180° that is the mirror image of the
    # isotropic picture, with port on the right.
    return np.ascontiguousarray(picture[:, ::-1]) if settings.form == "printed" else picture


def stamp_rings(image: np.ndarray, pixels: np.ndarray, values: np.ndarray) -> None:
    """Draw a circle of radius 1 about each pixel, in place; the later one wins.

    The result equals that of cv2.circle(image, (column, row), 1, value, 1) called point by point.

    image : (H, W) uint8
    pixels : (N, 2) integers, (row, column), centres within the image
    values : (N,) 0..255, rounded
    """
    padded = np.zeros((image.shape[0] + 2, image.shape[1] + 2), np.uint8)
    padded[1:-1, 1:-1] = image
    stride = padded.shape[1]
    offsets = np.array([row * stride + column for row, column in RING])
    index = ((pixels[:, 0] + 1) * stride + pixels[:, 1] + 1)[:, None] + offsets
    # NumPy assigns repeated indices in order, so that the last value stays
    padded.reshape(-1)[index.reshape(-1)] = np.repeat(np.rint(values).astype(np.uint8), len(RING))
    image[:] = padded[1:-1, 1:-1]


def _stream(seed: int, term: int) -> np.random.Generator:
    """Return the random generator of a term."""
    return np.random.Generator(np.random.Philox(key=np.array([seed, term], np.uint64)))


def _quads(points: np.ndarray, inside: np.ndarray, grid_shape) -> np.ndarray:
    """Return quads of neighbouring points, (Q, 4) indices of corners in order round the quad, row by row."""
    index = np.arange(len(points)).reshape(grid_shape)
    corners = (index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1])
    quads = np.stack(corners, axis=-1).reshape(-1, 4)
    quads = quads[inside[quads].all(axis=1)]
    range_m = np.linalg.norm(points, axis=1)[quads]
    return quads[np.ptp(range_m, axis=1) <= MAX_JUMP * range_m.min(axis=1)]
