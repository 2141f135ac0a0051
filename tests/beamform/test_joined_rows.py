"""Rows of one face are summed as one footprint: what that changes, and what whole faces at once would."""

from itertools import pairwise

import numpy as np
import pytest
import trimesh

import sonar_gl as sg
from sonar_gl.beamform.kernels import range_bins, work_table
from sonar_gl.beamform.kernels.footprints import bend_footprints
from sonar_gl.beamform.kernels.joined_rows import find_faces, gather_pieces
from sonar_gl.beamform.kernels.range_bins import piece_limits
from sonar_gl.beamform.kernels.strips import Lattice

SONAR = sg.Sonar("fan", 900e3, 64, 300, 45.0, 20.0, 1.0, 0.5, 15.0)
IDEAL = sg.Acoustics.ideal()
# a tank: walls face on and aside, a floor, all at some angle to the sonar
HERE = sg.pose(-5.6, 0.2, -1.5, 0.02, 0.15, 0.05)
TANK = sg.Body("tank", trimesh.creation.box((12.0, 8.0, 4.0)), sg.pose(z=-2.0), 0.6)


def ping_of(bodies, acoustics=IDEAL, sampling=None, pose=HERE, sonar=SONAR, **settings):
    scene = sg.Scene(bodies)
    with sg.Simulator(scene, sonar, acoustics, sampling or sg.Sampling(2, 160), engine="cpu") as simulator:
        return simulator.ping(pose, **settings)


@pytest.fixture
def piece_height(monkeypatch):
    """Return a function that sets the height of a piece, radians; 0 joins no rows."""
    return lambda height_rad: monkeypatch.setattr(range_bins, "piece_limits", lambda *_: (height_rad, np.inf))


def difference(ping, other):
    """Return the share of the echo that lies in other bins."""
    return np.abs(ping.intensity - other.intensity).sum(dtype=float) / other.intensity.sum(dtype=float)


@pytest.mark.parametrize("acoustics", [IDEAL, sg.Acoustics.physical()], ids=["ideal", "physical"])
def test_joined_rows_of_planes_change_little(acoustics, piece_height):
    """An eightieth of a bin, by which pieces may be off in range, moves less than 2e-3 of the echo.

    The walls begin in bins that their echo fills in part, some of them face on; there alone range counts.
    """
    joined = ping_of([TANK], acoustics)
    piece_height(0.0)
    rows = ping_of([TANK], acoustics)
    piece_height(0.35)
    high = ping_of([TANK], acoustics)
    assert 0 < difference(joined, rows) < 2e-3
    assert joined.intensity.sum(dtype=float) == pytest.approx(rows.intensity.sum(dtype=float), rel=5e-4)
    # as high as faces, but for walls that the sonar faces, and near horizons
    assert difference(high, rows) > 1.5 * difference(joined, rows)


def test_joined_rows_err_as_single_ones_do(piece_height):
    """By an echo of samples five times finer in both directions, none of them joined."""
    joined = ping_of([TANK])
    piece_height(0.0)
    rows, fine = ping_of([TANK]), ping_of([TANK], sampling=sg.Sampling(10, 800))
    assert difference(rows, fine) < 2e-3
    assert difference(joined, fine) < difference(rows, fine) + 2e-3  # a fifth of the tolerance by default


def test_a_smooth_ball_keeps_its_echo(piece_height):
    """Its echo changes over each face by its shading normals: one value for a piece would differ by 1.3e-2."""
    mesh = trimesh.creation.icosphere(2, 1.0)
    ball = sg.Body("ball", mesh, sg.pose(6.0), 0.8, np.asarray(mesh.vertices, np.float32))
    joined = ping_of([ball], pose=sg.pose())
    piece_height(0.0)
    rows = ping_of([ball], pose=sg.pose())
    assert 0 < difference(joined, rows) < 5e-3


def test_a_wall_seen_at_an_angle_begins_where_it_does(piece_height):
    """With ramps neglected as rows may, up to a quarter of a bin, joined rows would differ by 2.4e-3 of the echo."""
    wall = sg.Body("wall", trimesh.creation.box((0.2, 12.0, 8.0)), sg.pose(8.0, yaw=0.9), 0.5)
    narrow = sg.Sonar("narrow", 900e3, 64, 400, 20.0, 20.0, 0.3, 0.5, 20.0)
    settings = {"sonar": narrow, "pose": sg.pose(), "sampling": sg.Sampling(2, 300)}
    joined = ping_of([wall], **settings)
    piece_height(0.0)
    # what is left are pieces that are off by up to 1/160 of a bin, here 4e-4 of the echo
    assert 0 < difference(joined, ping_of([wall], **settings)) < 1e-3


def test_labels_do_not_change_the_bits_of_joined_rows():
    for acoustics in (IDEAL, sg.Acoustics.physical()):
        plain, labelled = ping_of([TANK], acoustics), ping_of([TANK], acoustics, labels=True)
        assert plain.intensity.tobytes() == labelled.intensity.tobytes()


def test_elevation_and_incidence_change_within_a_joined_footprint(piece_height):
    """On a level floor the sine of both follows from range; pieces are 1.3° high, and bins far less."""
    floor = sg.Body("floor", trimesh.creation.box((80.0, 80.0, 0.2)), sg.pose(z=-2.1), 0.5)
    narrow = sg.Sonar("narrow", 900e3, 8, 1400, 4.0, 20.0, 1.0, 0.5, 15.0)
    got = ping_of(
        [floor], sonar=narrow, pose=sg.pose(pitch=np.radians(20)), sampling=sg.Sampling(1, 400), labels=True
    )
    # bins that the floor fills: those at the ends of the aperture hold a part of a bin
    lit = np.flatnonzero((got.intensity > 0).all(axis=0))[2:-2]
    assert len(lit) > 500
    below = np.arcsin(2.0 / got.true_range_m[:, lit])
    # azimuths of up to 2 degrees turn the elevation in the pitched frame by 1e-4
    expected = np.radians(20) - below
    np.testing.assert_allclose(got.elevation_rad[:, lit], expected, atol=1.5e-3)
    np.testing.assert_allclose(got.incidence_rad[:, lit], np.pi / 2 - below, atol=1.5e-3)
    piece_rad, piece_m = piece_limits(narrow.bin_edges_m)
    assert min(piece_rad, np.sqrt(piece_m / 15.0)) > 3 * 1.5e-3


def test_two_coplanar_bodies_end_where_they_do():
    """Tiles of one plane and one reflectivity: each bin shows the body that lies there."""
    tiles = [
        sg.Body(f"tile {n}", trimesh.creation.box((1.0, 60.0, 0.2)), sg.pose(x=2.5 + n, z=-2.1), 0.5)
        for n in range(12)
    ]
    narrow = sg.Sonar("narrow", 900e3, 8, 600, 4.0, 20.0, 1.0, 0.5, 15.0)
    got = ping_of(
        tiles, sonar=narrow, pose=sg.pose(pitch=np.radians(15)), sampling=sg.Sampling(1, 300), labels=True
    )
    along = np.sqrt(np.maximum(got.true_range_m**2 - 4.0, 0)) * np.cos(got.azimuth_rad)[:, None]
    inside = (got.body_id > 0) & (np.abs((along - 2.0) % 1.0 - 0.5) < 0.45)
    assert inside.sum() > 1500
    np.testing.assert_array_equal(got.body_id[inside], np.floor(along[inside] - 2.0) + 1)


def test_pieces_follow_from_bins_range_and_aperture():
    edges = np.linspace(1.0, 31.0, 601)
    _, piece_m = piece_limits(edges)
    assert piece_m / 8 == pytest.approx(0.05 / 160)  # r h² / 8
    assert piece_limits(edges, np.radians(4.0)) == pytest.approx((np.radians(4.0) / 16, piece_m))


@pytest.mark.parametrize("value", [np.nan, -1.0])
@pytest.mark.parametrize(
    "acoustics", [IDEAL, sg.Acoustics.physical(multipath="incoherent")], ids=["ideal", "multipath"]
)
def test_no_bit_depends_on_what_was_in_memory_beside_a_strip(acoustics, value, monkeypatch):
    """Loops over strips do a few samples more than there are."""
    plate = sg.Body("plate", trimesh.creation.box((6.0, 0.2, 6.0)), sg.pose(y=3.5, z=-2.0), material="steel")
    bodies = [TANK, plate]
    clean = ping_of(bodies, acoustics, labels=True)
    make_work = work_table.make_work

    def make_filled():
        work = make_work()
        work[:, :1000] = value
        return work

    monkeypatch.setattr(work_table, "make_work", make_filled)
    filled = ping_of(bodies, acoustics, labels=True)
    for name in (
        "intensity",
        "body_id",
        "elevation_rad",
        "incidence_rad",
        "true_range_m",
        "share",
        "body_echo",
    ):
        np.testing.assert_array_equal(getattr(filled, name), getattr(clean, name), err_msg=name)


@pytest.mark.parametrize(
    ("numbers", "begins"),
    [
        ([0, 0, 0, 7], [0, 3]),  # number 0 is a face as any other, also in the lowest row
        ([7, 7, 0, 0, 7], [0, 2, 4]),
        ([-1, -1, 3, 4], [0, 2, 3]),  # rows that met nothing are joined, too
        ([0], [0]),
    ],
)
@pytest.mark.parametrize("column", [0, 2])
def test_a_face_begins_where_its_number_changes(numbers, begins, column):
    bottom, n = 2, len(numbers)
    face_id = np.full((n + 3, 3), 9, np.int32)
    face_id[bottom : bottom + n, column] = numbers
    work = work_table.make_work()
    work[work_table.SAMPLE, :n] = column
    assert find_faces(work, face_id, 3, bottom, n) == len(begins)
    np.testing.assert_array_equal(work[work_table.START, : len(begins) + 1], [*begins, n])
    # beside the window nothing is met, whatever lies there in memory
    for outside in (-1.0, 3.0):
        work[work_table.SAMPLE, :n] = outside
        assert find_faces(work, face_id, 3, bottom, n) == 1


def test_the_echo_of_a_piece_is_the_mean_of_its_rows_and_rises_as_they_do():
    """Exactly, where it is linear and the piece has a middle row, or no more than two rows."""
    n_rows, begins, step = 11, [0, 1, 3, 6, 11], 0.01
    lattice = Lattice(np.array([0.0, step, 0.0]), np.array([0.05, 0.0, step]), -0.2, 0.2, 1, 0.0, 1.0)
    image = np.empty((n_rows, 1, 4), np.float32)
    image[..., :3], echo = (0.2, 0.0, 0.0), 0.5 + 0.03125 * np.arange(n_rows)
    image[:, 0, 3] = echo
    work = work_table.make_work()
    for row in (work_table.SAMPLE, work_table.LINE_U, work_table.TILT):
        work[row, :n_rows] = 0.0
    work[work_table.V_RAY, :n_rows] = 0.05 + step * np.arange(n_rows)
    work[work_table.PIECE, : len(begins)] = begins
    assert gather_pieces(work, image, lattice, 0, len(begins) - 1) == (0, len(begins) - 2)
    for k, (begin, past) in enumerate(pairwise(begins)):
        mean = echo[begin:past].mean()
        assert work[work_table.ECHO, k] == pytest.approx(mean, rel=1e-12)
        # of one row nothing tells a rise; of more it is that up to half a row beyond the last
        rise = 0.03125 * (past - begin) / 2 / mean if past - begin > 1 else 0.0
        assert work[work_table.ECHO_RISE, k] == pytest.approx(rise, rel=1e-12)
        rays = 0.05 + step * np.array([begin, past - 1])
        assert work[[work_table.V_LOWEST, work_table.V_HIGHEST], k] == pytest.approx(rays)


@pytest.mark.parametrize("tilt", [0.0, 0.3])
@pytest.mark.parametrize("is_slanted", [False, True])
@pytest.mark.parametrize("place", [-0.4, 0.3, "below the nearest", "above the nearest"])
def test_a_footprint_of_several_rows_ends_where_its_plane_does_to_second_order(place, is_slanted, tilt):
    """By its mean 1/range, its ends, its solid angle and its density there, all of the plane itself."""
    rest, line, half, at = 0.2, -0.3, 4e-3, 5
    along = 0.15

    def length(v):
        return np.sqrt(1 + (line + tilt * v) ** 2 + v * v)

    def s_at(v):
        return (rest + along * v) / length(v)

    def slope_at(v):
        return (along - (rest + along * v) * (v + (line + tilt * v) * tilt) / length(v) ** 2) / length(v)

    curve = 1 + tilt * tilt
    nearest_v = (along * (1 + line * line) - rest * line * tilt) / (rest * curve - along * line * tilt)
    has_nearest = isinstance(place, str)
    middle = nearest_v + 0.8 * (half if "above" in place else -half) if has_nearest else place
    low, high = middle - half, middle + half
    v, weights = np.polynomial.legendre.leggauss(12)
    v = middle + half * v
    work = work_table.make_work()
    values = {
        work_table.REST: rest,
        work_table.ALONG: along,
        work_table.LINE_U: line,
        work_table.TILT: tilt,
        work_table.ENERGY: 2 * half / length(middle) ** 3,
        work_table.S: s_at(middle),
        work_table.B: abs(slope_at(middle)) * half,
        work_table.ECHO_RISE: 0.07,
    }
    for row, value in values.items():
        work[row, : at + 2 * work_table.AT_A_TIME] = value
    work[work_table.A] = 0.0
    work[work_table.BORDER, at], work[work_table.BORDER, at + 1] = low, high
    bend_footprints(work, at, at + 1, 1e12 if is_slanted else 1e-12)
    energy, s, b, change = work[[work_table.ENERGY, work_table.S, work_table.B, work_table.NEAR_BIN], at]
    # of mean and energy the fourth order in `half` is left out, of ends the third; the second is some 1e-5
    assert energy == pytest.approx(half * (weights / length(v) ** 3).sum(), rel=1e-9)
    if is_slanted:
        assert s == pytest.approx((s_at(low) + s_at(high)) / 2, rel=1e-9)
        assert b == pytest.approx(abs(slope_at(middle)) * half, rel=1e-12)
        # the solid angle per s is proportional to 1 / (slope times length³), and the echo rises on its own
        density = slope_at(middle) * length(middle) ** 3
        there = slope_at(high) * length(high) ** 3
        assert change == pytest.approx(0.07 + 1 - there / density, rel=1e-6)
    else:
        nearest = s_at(nearest_v) if has_nearest else max(s_at(low), s_at(high))
        assert s == pytest.approx((weights * s_at(v)).sum() / 2, rel=1e-8)
        assert s + b == pytest.approx(nearest, rel=1e-7)
        assert change == 0.0
