"""Measures of the regimes where methods fail, for the naive methods and for ours.

The tests assert the results; `python -m tools.docs.failures` prints them.
"""

import math
import warnings
from dataclasses import replace

import numpy as np
import trimesh

import sonar_gl as sg
from tests.support import naive
from tests.support.closed_forms import box_beams, plane_echo, sphere_echo

SONAR = sg.Sonar("regime", 900e3, 64, 200, 60.0, 20.0, 1.5, 0.5, 20.0)
SAMPLING = sg.Sampling(2, 64)
BOX = trimesh.creation.box((1, 1, 1))
HERE = np.eye(4)


def quad(half_m):
    """Return an open square around the origin, normal to z."""
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * float(half_m)
    return trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False)


def plate(name, x, half_m, reflectivity=1.0, y=0.0):
    """Return a square across the boresight at x."""
    return sg.Body(name, quad(half_m), sg.pose(x, y, 0, 0, np.pi / 2, 0), reflectivity)


def simulate(bodies, sonar=SONAR, sampling=SAMPLING, **settings):
    return sg.Simulator(sg.Scene(bodies), sonar, sg.Acoustics.ideal(), sampling, **settings)


def ping(bodies, sonar=SONAR, pose=HERE, sampling=SAMPLING, **settings):
    with simulate(bodies, sonar, sampling, **settings) as simulator:
        return simulator.ping(pose)


def difference(measured, true):
    """Return the share of the echo that lies in wrong bins."""
    return float(np.abs(measured.astype(np.float64) - true).sum() / true.sum())


def wide_fan(fov_deg):
    """Return (naive, ours): the worst beam's relative error inside a ball, whose echo is its reflectivity.

    The naive method uses one perspective view with as many columns, each added to the beam of its azimuth; its error
    is infinite where no such view exists.
    """
    sonar = replace(SONAR, azimuth_fov_deg=fov_deg, beam_width_deg=fov_deg / 64)
    ball = sg.Body("ball", trimesh.creation.uv_sphere(10.0, count=[90, 180]), reflectivity=1.0)
    ours = ping([ball], sonar).intensity.sum(axis=1, dtype=np.float64)
    try:
        plain = naive.single_view_beams(sonar, SAMPLING.columns_per_beam)
    except ValueError:
        return math.inf, float(np.abs(ours - 1).max())
    return float(np.abs(plain - 1).max()), float(np.abs(ours - 1).max())


def grazing_floor(
    height_m, tolerance, lowest_deg=1.0, roll=0.0, pitch=0.0, yaw=0.0, width_deg=1.0, bins=1000, nodes=50
):
    """Measure a level floor at grazing angles from 20 degrees down to `lowest_deg`.

    Errors of single bins count where the floor fills the bin across the whole beam, independent of the aperture.

    nodes : quadrature nodes of the truth across a beam; a sonar rolled by 1 radian or more needs more

    Returns
    -------
    dict : `empty`, share of bins that the naive method leaves empty; `naive` and `ours`, rms of the bins' relative
        errors; `worst`, our largest error; `off`, share of our bins with an error above one per cent; `bins`, number
        of bins; `naive_wrong` and `wrong`, share of the echo that lies in wrong bins
    """
    first, last = (height_m / math.sin(math.radians(deg)) for deg in (20.0, lowest_deg))
    sonar = sg.Sonar("floor", 900e3, 9, bins, 9.0, 20.0, width_deg, first, last)
    pose = sg.pose(0, 0, height_m, roll, pitch, yaw)
    down = pose[:3, :3].T @ [0.0, 0.0, -1.0]
    scene = sg.Scene([sg.Body("floor", quad(1000 * height_m), reflectivity=1.0)])

    def echo(elevation_rad):
        aperture, edges = (-elevation_rad, elevation_rad), sonar.bin_edges_m
        return box_beams(sonar, lambda azimuth: plane_echo(down, height_m, azimuth, aperture, edges), nodes)

    exact = echo(math.radians(10.0))
    filled = (exact > 0) & (exact > (1 - 1e-9) * echo(np.pi / 2))
    with sg.Simulator(scene, sonar, sg.Acoustics.ideal(), tolerance=tolerance) as simulator:
        got, sampling = simulator.ping(pose).intensity, simulator.sampling
    with naive.plain_grid():
        point = ping(scene.bodies, sonar, pose, naive.in_points(sampling)).intensity
    ours, plain = (intensity[filled] / exact[filled] - 1 for intensity in (got, point))
    return {
        "empty": float((plain == -1).mean()),
        "naive": float(np.sqrt((plain**2).mean())),
        "ours": float(np.sqrt((ours**2).mean())),
        "worst": float(np.abs(ours).max()),
        "off": float((np.abs(ours) > 0.01).mean()),
        "bins": int(filled.sum()),
        "naive_wrong": difference(point, exact),
        "wrong": difference(got, exact),
    }


def fine_bins(tolerance):
    """Return (naive, ours, empty, worst) of a floor in bins of 2.5 mm.

    These are the shares of echo in wrong bins, the share of bins that the naive method leaves empty, and our largest
    relative error of a bin.
    """
    sonar = sg.Sonar("fine", 900e3, 9, 2000, 9.0, 20.0, 1.0, 20.0, 25.0)
    floor, down = sg.Body("floor", quad(3000), reflectivity=1.0), (0.0, 0.0, -1.0)
    aperture, pose = (-math.radians(10.0), math.radians(10.0)), sg.pose(0, 0, 3)
    exact = box_beams(sonar, lambda azimuth: plane_echo(down, 3.0, azimuth, aperture, sonar.bin_edges_m), 20)
    with sg.Simulator(sg.Scene([floor]), sonar, sg.Acoustics.ideal(), tolerance=tolerance) as simulator:
        ours, sampling = simulator.ping(pose).intensity, simulator.sampling
    with naive.plain_grid():
        point = ping([floor], sonar, pose, naive.in_points(sampling)).intensity
    worst = np.abs(ours / exact - 1).max()
    return difference(point, exact), difference(ours, exact), float((point == 0).mean()), float(worst)


def no_echo(bodies):
    """Return (naive, ours): the sum of a ping without an echo, and the warnings.

    The naive method is a histogram of samples over range.
    """
    results = []
    with simulate(bodies) as simulator:
        buffers = simulator.gbuffers(HERE)
        for make in (lambda: naive.histogram(buffers, SONAR), lambda: simulator.ping(HERE).intensity):
            with warnings.catch_warnings(record=True) as caught:
                warnings.simplefilter("always")
                total = float(make().sum())
            results.append((total, [str(one.message) for one in caught]))
    return results


def far_wall(distance_m):
    """Return (naive, ours): largest error of the range of a wall, metres; the naive method has a 24-bit z-buffer."""
    far = distance_m * 8
    sonar = replace(SONAR, range_min_m=distance_m - 1, range_max_m=distance_m + 1, n_bins=800)
    with simulate([plate("wall", distance_m, 2 * distance_m)], sonar) as simulator:
        buffers, sectors = simulator.gbuffers(HERE), simulator.fan.sectors
    ours = 0.0
    for buffer, sector in zip(buffers, sectors, strict=True):
        u, v = sector.sample_coordinates()
        ahead = np.stack([np.ones_like(u), -u, v], axis=-1) @ sector.rotation()[:, 0]
        exact = distance_m * np.sqrt(1 + u * u + v * v) / ahead
        ours = max(ours, np.abs(buffer.range_m - exact)[buffer.range_m > 0].max())
    through = naive.zbuffer_range(np.linspace(distance_m - 1, distance_m + 1, 2001), 0.1, far)
    worst = np.abs(through - np.linspace(distance_m - 1, distance_m + 1, 2001)).max()
    return float(worst), float(ours)


def hand_before_the_sonar():
    """Return (naive, ours): share of a wall's echo that passes through a hand nearer than range_min.

    The naive method has its near plane at range_min.
    """
    wall, hand = plate("wall", 10.0, 30.0), sg.Body("hand", BOX, sg.pose(0.7, 0, 0))  # 0.2 m away
    open_water, hidden = ping([wall]).intensity.sum(), ping([wall, hand]).intensity.sum()
    with naive.near_plane_at(SONAR.range_min_m + 0.8):  # beyond the hand, also off the axis
        leaked = ping([wall, hand]).intensity.sum()
    return float(leaked / open_water), float(hidden / open_water)


def inside_a_body():
    """Return (naive, ours): echo from inside a closed sphere, relative to the closed form."""
    room = sg.Body("room", trimesh.creation.uv_sphere(6.0, count=[90, 180]), reflectivity=1.0)
    ours = ping([room]).intensity.sum() / SONAR.n_beams
    with naive.back_faces_always_culled():
        culled = ping([room]).intensity.sum() / SONAR.n_beams
    return float(culled), float(ours)


def sheet_from_behind():
    """Return (naive, ours): echo of an open sheet from its back, relative to that from its front."""
    sheet = trimesh.Trimesh([[0, -1, -1], [0, 1, -1], [0, 1, 1], [0, -1, 1]], [[0, 1, 2], [0, 2, 3]])
    front, back = (
        ping([sg.Body("s", sheet, sg.pose(5, 0, 0, 0, 0, yaw))]).intensity.sum() for yaw in (0, np.pi)
    )
    with naive.back_faces_always_culled():
        culled = [
            ping([sg.Body("s", sheet, sg.pose(5, 0, 0, 0, 0, yaw))]).intensity.sum() for yaw in (0, np.pi)
        ]
    return float(min(culled) / max(front, back)), float(min(front, back) / max(front, back))


def silhouette():
    """Return (naive, ours): share of a ball's echo in wrong bins, against its closed form, with the same samples."""
    sonar = sg.Sonar("ball", 900e3, 40, 512, 20.0, 20.0, 0.5, 0.5, 15.0)
    ball = sg.Body("ball", trimesh.creation.uv_sphere(1.0, count=[180, 360]), sg.pose(6.0), 1.0)
    edges, top = sonar.bin_edges_m, math.radians(10.0)
    exact = box_beams(sonar, lambda azimuth: sphere_echo(1.0, 6.0, azimuth, top, edges))
    ours = ping([ball], sonar).intensity
    with naive.plain_grid():
        point = ping([ball], sonar, sampling=naive.in_points(SAMPLING)).intensity
    return difference(point, exact), difference(ours, exact)


def paint_before_a_wall(distance_m):
    """Return (naive, ours): share of a wall's echo that passes through a silent plate 5 mm before it.

    The naive method uses the depth of the projection; both have a near plane of 1 mm.
    """
    bodies = [plate("wall", distance_m, distance_m), plate("paint", distance_m - 0.005, distance_m, 0.0)]
    sonar = replace(SONAR, range_max_m=1.3 * distance_m)
    bare, ours = ping(bodies[:1], sonar).intensity.sum(), ping(bodies, sonar).intensity.sum()
    with naive.projection_depth():
        leaked = ping(bodies, sonar).intensity.sum()
    return float(leaked / bare), float(ours / bare)


def far_from_the_origin():
    """Return (naive, ours): share of echo in wrong bins at UTM coordinates; the naive method rounds them to float32."""
    images = []
    for offset in (np.zeros(3), np.array([500_000.3, 4_500_000.7, -30.0])):
        x, y, z = offset
        bodies = [
            sg.Body("floor", trimesh.creation.box((40, 40, 1)), sg.pose(x, y, z - 3)),
            sg.Body("box", BOX, sg.pose(x + 6.13, y + 1.21, z - 1.57, 0.1, 0.2, 0.3)),
        ]
        pose = sg.pose(x, y, z, 0, 0.2, 0.1)
        images.append(ping(bodies, pose=pose).intensity)
    moved, rounded = naive.float32_world(bodies, pose)
    return difference(ping(moved, pose=rounded).intensity, images[0]), difference(images[1], images[0])
