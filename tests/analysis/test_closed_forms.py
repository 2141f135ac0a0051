"""Pings of simple scenes against closed forms: profile `ideal`, samples fixed or chosen for a tolerance."""

import math
from dataclasses import replace

import numpy as np
import pytest
import trimesh

import sonar_gl as sg
from tests.support.closed_forms import (
    box_beams,
    cylinder_echo,
    floor_echo,
    plane_echo,
    plate_on_floor_echo,
    sphere_echo,
)

ELEVATION = math.radians(10.0)
TOLERANCE = 0.01  # the promised share of a beam's echo that may lie in wrong bins
# footprints follow planes exactly; the rest comes from short ramps at the edges of beams, summed as steps
PLANE_TOLERANCE = 0.006


def sonar(beams, fov_deg, width_deg, bins=1181, **changes):
    """Return a sonar with bins of 2.54 cm up to 30 m, unless changed."""
    settings = {"range_min_m": 0.0, "range_max_m": 30.0} | changes
    return sg.Sonar(
        "test", 900e3, beams, bins, fov_deg, 20.0, width_deg, settings["range_min_m"], settings["range_max_m"]
    )


def quad(half=400.0):
    """Return a square about the origin, normal to z."""
    corners = [[-half, -half, 0], [half, -half, 0], [half, half, 0], [-half, half, 0]]
    return trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False)


def plane_body(normal, distance):
    pose = trimesh.geometry.align_vectors([0, 0, 1], normal)
    pose[:3, 3] = np.asarray(normal) * distance
    return sg.Body("plane", quad(), pose, 1.0)


def ping(bodies, sonar, sampling=None, pose=None, tolerance=0.01, **kw):
    with sg.Simulator(sg.Scene(bodies), sonar, sg.Acoustics.ideal(), sampling, tolerance) as simulator:
        return simulator.ping(np.eye(4) if pose is None else pose, **kw)


def samples(it, sample_deg, rows=102):
    """Return samples of that width, or narrower: a box beam has at least three."""
    spacing_deg = it.azimuth_fov_deg / it.n_beams
    return sg.Sampling(spacing_deg / min(sample_deg, it.beam_width_deg / 3), rows)


# degrees, rows: for the bounds of single beams, since a tolerance holds for the whole ping
FINE = (0.08, 102)


def beam_errors(measured, exact):
    """Return the L1 error of each beam over its own echo, for beams with a fair share of the strongest echo."""
    total = exact.sum(axis=1)
    strong = total > 1e-3 * total.max()
    return np.abs(measured - exact).sum(axis=1)[strong] / total[strong]


PLANES = {
    "level floor": ((0, 0, -1), 3.0),
    "wall": ((1, 0, 0), 8.0),
    "yawed wall": ((math.cos(0.6), math.sin(0.6), 0), 8.0),
    "leaning wall": ((math.cos(0.5), 0.2 * math.sin(0.5), math.sin(0.5)), 6.0),
    "sloping floor": ((0.2, 0.1, -1), 2.5),
    "floor at 1 degree of grazing": ((0.0, 0.0, -1), 0.5),
    "floor below a sonar pitched up": ((-0.1, 0, -1), 1.0),
    "ceiling": ((0.1, -0.2, 1), 2.0),
}


FLOOR = 0, 0, -1  # whose echo is the same at all azimuths
SLOW = "yawed wall", "sloping floor"
BEAMS = (9, 9.0, 0.5), (16, 22.5, 3.0), (16, 2.8125, 0.17578125)  # apart, overlapping, contiguous and narrow


@pytest.mark.parametrize(
    "name, beams, fov, width",
    [  # each plane in one kind of beams, each kind before several planes; a leaning wall is yawed, a ceiling slopes.
        # A wall that the sonar faces has most of its echo in one bin, where rows of samples are joined with most care
        pytest.param(
            name,
            *kind,
            marks=() if name == "wall" or (number % 3 == turn and name not in SLOW) else pytest.mark.slow,
        )
        for number, name in enumerate(PLANES)
        for turn, kind in enumerate(BEAMS)
    ],
)
def test_planes(name, beams, fov, width):
    normal, distance = PLANES[name]
    normal = np.array(normal) / np.linalg.norm(normal)
    it = sonar(beams, fov, width)
    # errs by 3e-5 of a beam's echo at most, and 2e-4 for walls, whose echo from one azimuth lies in few bins
    nodes = 200 if name in ("wall", "yawed wall") else 50
    exact = box_beams(
        it,
        lambda azimuth: plane_echo(normal, distance, azimuth, (-ELEVATION, ELEVATION), it.bin_edges_m),
        nodes,
    )
    plane = [plane_body(normal, distance)]
    fine = ping(plane, it, samples(it, *FINE)).intensity
    # no edge of a wall face on runs obliquely through bins; measured: 8e-4, and 6e-3 with even footprints within bins
    assert beam_errors(fine, exact).max() < (2e-3 if name == "wall" else PLANE_TOLERANCE)
    by_tolerance = ping(plane, it).intensity
    assert np.abs(by_tolerance - exact).sum() / exact.sum() < TOLERANCE


@pytest.mark.parametrize("bin_m", [0.0025, 0.0254, 0.25])
def test_floor_in_fine_and_coarse_bins(bin_m):
    it = sonar(9, 9.0, 1.0, bins=round(20 / bin_m), range_min_m=10.0, range_max_m=10.0 + 20)
    exact = box_beams(
        it, lambda azimuth: plane_echo(FLOOR, 3.0, azimuth, (-ELEVATION, ELEVATION), it.bin_edges_m), 20
    )
    measured = ping([plane_body((0, 0, -1), 3.0)], it, samples(it, *FINE)).intensity
    assert beam_errors(measured, exact).max() < PLANE_TOLERANCE
    floor = exact > 0
    # no bin of the floor is empty, none is a ring: each is right by itself, except for the two end bins
    inner = floor & (np.cumsum(floor, axis=1) > 1) & (np.cumsum(floor[:, ::-1], axis=1)[:, ::-1] > 1)
    np.testing.assert_allclose(measured[inner], exact[inner], rtol=0.01)


def test_point_bins_leave_rings_where_footprints_do_not():
    it = sonar(9, 9.0, 1.0)
    exact = box_beams(
        it, lambda azimuth: plane_echo(FLOOR, 3.0, azimuth, (-ELEVATION, ELEVATION), it.bin_edges_m), 20
    )
    floor = [plane_body((0, 0, -1), 3.0)]
    naive = ping(floor, it, sg.Sampling(12, 100, reducer="point")).intensity
    assert beam_errors(naive, exact).min() > 0.3
    assert beam_errors(ping(floor, it, sg.Sampling(12, 100)).intensity, exact).max() < PLANE_TOLERANCE


@pytest.mark.slow
@pytest.mark.parametrize(
    "echo, mesh, beams",
    [
        # finer than a tenth of a bin: the sagitta of 1 m over 720 sides is 1e-5 m
        pytest.param(
            "sphere",
            lambda: trimesh.creation.uv_sphere(1.0, count=[360, 720]),
            (0.25, 3.25, 7.75, 9.25),
            marks=pytest.mark.slow,
        ),
        ("cylinder", lambda: trimesh.creation.cylinder(0.5, 20.0, sections=1440), (0.25, 2.25, 5.25)),
    ],
)
def test_curved_bodies(echo, mesh, beams):
    it = sonar(40, 20.0, 0.5)
    exact_of = {
        "sphere": lambda azimuth: sphere_echo(1.0, 6.0, azimuth, ELEVATION, it.bin_edges_m),
        "cylinder": lambda azimuth: cylinder_echo(0.5, 5.0, azimuth, -10, 10, ELEVATION, it.bin_edges_m),
    }[echo]
    exact = box_beams(it, exact_of)
    body = sg.Body(echo, mesh(), sg.pose({"sphere": 6.0, "cylinder": 5.0}[echo], 0, 0), 1.0)
    chosen = [np.abs(np.degrees(it.azimuth_rad) - beam).argmin() for beam in beams]
    worst, total = [], []
    with sg.Simulator(
        sg.Scene([body]), it, sg.Acoustics.ideal()
    ) as prepared:  # half a million faces, loaded once

        def measure(**how):
            with sg.Simulator(prepared, it, sg.Acoustics.ideal(), **how) as simulator:
                return simulator.ping(np.eye(4)).intensity

        for sample_deg, rows in ((0.17, 33), (0.042, 102), (0.016, 364)):
            measured = measure(sampling=samples(it, sample_deg, rows))
            worst.append(beam_errors(measured[chosen], exact[chosen]).max())
            total.append(np.abs(measured - exact).sum() / exact.sum())
        assert worst[1] < TOLERANCE
        assert worst[0] > worst[1] > worst[2]
        assert total[1] < TOLERANCE / 2
        assert total[0] > 1.5 * total[1] > 1.5 * total[2]  # falling as samples grow in number
        for tolerance in (0.05, 0.01, 0.002):
            measured = measure(tolerance=tolerance)
            assert np.abs(measured - exact).sum() / exact.sum() < tolerance


def test_plate_and_its_shadow():
    it = sonar(40, 20.0, 0.5)
    plate = sg.Body("plate", trimesh.creation.box((0.002, 400, 1.0)), sg.pose(10.001, 0, -2.5), 1.0)
    floor = plane_body((0, 0, -1), 3.0)
    exact = box_beams(
        it, lambda azimuth: plate_on_floor_echo(3.0, 1.0, 10.0, azimuth, ELEVATION, it.bin_edges_m), 20
    )
    result = ping([plate, floor], it, labels=True)
    # at 17 degrees of grazing the plate hides the floor from 10 m to 15 m
    assert beam_errors(result.intensity, exact).max() < TOLERANCE
    shadow = (exact == 0) & (it.range_m > 10.5)
    assert shadow.any()
    leaked = np.where(shadow, result.intensity, 0).sum()
    assert leaked < 0.002 * result.intensity.sum()


RING = sg.Sonar("ring", 900e3, 9, 400, 45.0, 20.0, 1.0, 0.5, 20.5)
LINE_ARRAY = replace(sg.Acoustics.ideal(), elevation_pattern="line_array")


def floor_before_a_line_array(it, height, pitch_deg):
    """Return the scene, the pose and the (K,) closed form of the middle beam of a sonar over a floor."""
    pattern = LINE_ARRAY.two_way_elevation_pattern(it)
    sines = (np.arange(100_000) + 0.5) / 50_000 - 1
    # the beam is narrow: 4 azimuths are as good as many
    azimuth = math.radians(it.beam_width_deg) * np.array([[-0.375], [-0.125], [0.125], [0.375]])
    pitch_rad = math.radians(pitch_deg)
    exact = floor_echo(height, pitch_rad, azimuth, pattern, it.bin_edges_m).mean(axis=0)
    scene = sg.Scene([plane_body((0, 0, -1), height)])
    return scene, sg.pose(pitch=pitch_rad), exact / (2 * pattern(sines).mean())


def first_bottom_return(it, height, exact):
    """Return where the ring is: bins within 10 dB of its brightest, from the height to 1.7 times as far."""
    ring = (it.range_m > height) & (it.range_m < 1.7 * height)
    return ring & (exact > exact[ring].max() / 10)


@pytest.mark.parametrize(
    "pitch_deg, taper", [*((pitch_deg, "uniform") for pitch_deg in (0.0, 15.0, -10.0)), (0.0, "hamming")]
)
@pytest.mark.parametrize("height", [pytest.param(1.0, marks=pytest.mark.slow), 5.0])
def test_the_first_bottom_return_through_side_lobes(height, pitch_deg, taper):
    """Each bin of the ring within 1 dB, by a tolerance; the closed form has no limit of elevation or level."""
    it = replace(RING, elevation_taper=taper)
    scene, pose, exact = floor_before_a_line_array(it, height, pitch_deg)
    with sg.Simulator(scene, it, LINE_ARRAY, tolerance=0.01) as simulator:
        measured = simulator.ping(pose).intensity[it.n_beams // 2]
    assert np.abs(measured - exact).sum() < TOLERANCE * exact.sum()
    bright = first_bottom_return(it, height, exact)
    if taper == "uniform":
        # theory: 5 dB below the brightest floor before a level sonar, and with the nose up the floor itself is dimmer
        highest_db = 10 * math.log10(exact[bright].max() / exact.max())
        assert highest_db == pytest.approx({0.0: -5.0, 15.0: -8.0, -10.0: 0.0}[pitch_deg], abs=0.6)
    if pitch_deg == -10.0 and taper == "hamming":
        return  # −70 dB or less, part of which is beyond what is received
    assert np.abs(10 * np.log10(measured[bright] / exact[bright])).max() < 1.0


@pytest.mark.parametrize("pitch_deg", [0.0, -10.0])
def test_the_first_bottom_return_with_few_samples(pitch_deg):
    """1/r is nearly linear in each row: bins are 0.5 dB off at most, with four rows to a sector of side lobes 4 dB."""
    scene, pose, exact = floor_before_a_line_array(RING, 5.0, pitch_deg)
    with sg.Simulator(scene, RING, LINE_ARRAY, sg.Sampling(1.0, 24)) as simulator:
        measured = simulator.ping(pose).intensity[RING.n_beams // 2]
    bright = first_bottom_return(RING, 5.0, exact)
    assert np.abs(10 * np.log10(measured[bright] / exact[bright])).max() < 0.6


@pytest.mark.parametrize("roll", [0.0, math.pi])
def test_a_few_rows_of_a_smooth_floor_follow_the_pattern(roll):
    """A floor whose rows are many bins long, right way up and overhead: the pattern is linear within each row."""
    scene, pose, exact = floor_before_a_line_array(RING, 2.0, 10.0)
    pose = pose @ sg.pose(roll=roll)
    with sg.Simulator(scene, RING, LINE_ARRAY, sg.Sampling(1.0, 24)) as simulator:
        intensity = simulator.ping(pose).intensity
    assert intensity.min() >= 0.0  # also next to nulls of the pattern, where it is far from linear
    measured = intensity[RING.n_beams // 2]
    # 2.3 % with one value of the pattern for each row. What is left is the curvature of the pattern in a row.
    assert np.abs(measured - exact).sum() < 0.004 * exact.sum()


@pytest.mark.slow
def test_the_reference_has_the_first_bottom_return():
    scene, pose, exact = floor_before_a_line_array(RING, 2.0, 0.0)
    truth = sg.reference_ping(scene, RING, pose, LINE_ARRAY, error=0.1).intensity[RING.n_beams // 2]
    bright = first_bottom_return(RING, 2.0, exact)
    # the halves of the reference agree to a hundredth, over the whole ping
    np.testing.assert_allclose(truth[bright].sum(), exact[bright].sum(), rtol=0.01)
    np.testing.assert_allclose(truth[bright], exact[bright], rtol=0.1)


def test_a_sphere_about_the_sonar_returns_its_reflectivity():
    it = sonar(32, 360.0, 20.0, bins=30)
    ball = sg.Body("ball", trimesh.creation.uv_sphere(10.0, count=[90, 180]), reflectivity=0.3)
    totals = ping([ball], it).intensity.sum(axis=1)
    np.testing.assert_allclose(totals, 0.3, rtol=2e-3)  # facets of 2 degrees are tilted by up to 1 degree


@pytest.mark.parametrize(
    "fov",
    [
        *(20.0, 130.0, 180.0, 181.0, 360.0),
        *(pytest.param(fov, marks=pytest.mark.slow) for fov in (45.0, 90.0, 179.0, 270.0)),
    ],
)
def test_energy_does_not_depend_on_samples_or_seams(fov):
    """A tilted room at any field of view: the sums of 1x, 2x and 4x samples agree."""
    room = sg.Body("room", trimesh.creation.box((22, 17, 9)), sg.pose(1, 2, 0.5, 0.1, 0.2, 0.3), 1.0)
    it = sonar(90, fov, fov / 90, bins=300)
    sums = [
        ping([room], it, sg.Sampling(columns, rows)).intensity.sum()
        for columns, rows in ((1, 24), (2, 48), (4, 96))
    ]
    np.testing.assert_allclose(sums, sums[-1], rtol=0.005)


@pytest.mark.parametrize("distance", [2.0, 100.0])
def test_range_of_a_plate(distance):
    """The plate's echo begins and is centred at its range, to a tenth of a bin of 2.5 cm."""
    nearest = max(distance - 5.0, 0.0) + 0.01
    it = sg.Sonar("narrow", 900e3, 1, 400, 0.2, 0.2, 0.2, nearest, nearest + 10.0)
    result = ping([plane_body((1, 0, 0), distance)], it)
    centre = (result.intensity[0] @ it.range_m) / result.intensity[0].sum()
    occupied = it.range_m[result.intensity[0] > 0]
    assert len(occupied) <= 2
    assert abs(occupied[0] - distance) <= it.bin_size_m / 2 * 1.001
    assert abs(centre - distance) <= it.bin_size_m / 2
    # the position inside the bin: move the plate by a tenth of a bin across an edge and the bin changes
    edge = it.bin_edges_m[np.searchsorted(it.bin_edges_m, distance)]
    before, after = (
        ping([plane_body((1, 0, 0), edge + sign * it.bin_size_m / 10)], it).intensity[0].argmax()
        for sign in (-1, 1)
    )
    assert after == before + 1


@pytest.mark.slow
def test_a_body_that_touches_the_last_range_returns_what_rounding_puts_before_it():
    """A cap of depth d of a plane has the area 2 pi r d, so that its echo is proportional to d."""
    sonar = sg.Sonar("last", 900e3, 32, 100, 40.0, 10.0, 1.0, 0.5, 30.0)
    totals = {}
    for depth_m in (0.0, 1e-4):
        scene = sg.Scene([sg.Body("box", trimesh.creation.box(), sg.pose(30.5 - depth_m, 0.3, 0.1))])
        with sg.Simulator(scene, sonar, sg.Acoustics.physical(), tolerance=TOLERANCE) as simulator:
            totals[depth_m] = simulator.ping(np.eye(4)).intensity.sum(dtype=float)
    steps_m = 2 * np.spacing(np.float32(30))  # of the vertices, and of the range
    assert totals[1e-4] > 0  # which way the range is rounded depends on the processor
    assert totals[0.0] <= totals[1e-4] * steps_m / 1e-4
