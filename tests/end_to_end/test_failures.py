"""Regimes where methods fail: each test measures a naive method and ours.

The measures are in `regimes.py` and `oddities.py`, the naive methods in `naive.py`. Some regimes have further tests
elsewhere; here they are compared.
"""

import math
import warnings
from dataclasses import replace

import numpy as np
import pytest
import trimesh

import sonar_gl as sg
from tests.support import naive, oddities, regimes

pytestmark = pytest.mark.filterwarnings("ignore:no echo came back")  # some pings are empty on purpose

HALF = math.pi / 2


@pytest.mark.parametrize(
    "fov",
    [  # a single view has too few columns, or there is none
        179.0,
        360.0,
    ],
)
def test_wide_fans(fov):
    plain, ours = regimes.wide_fan(fov)
    # the middle of a single view has too few columns; from 180 degrees on no such view exists
    assert plain > 0.6
    assert ours < 1e-3  # facets of 2 degrees are tilted by up to a degree: cos is 1.5e-4 less


TOLERANCES = 0.01, 0.05
FLOORS = (
    {"height_m": 0.3},
    {"height_m": 3.0},
    {"height_m": 3.0, "lowest_deg": 0.5},
    {"height_m": 3.0, "width_deg": 0.2},
    {"height_m": 3.0, "roll": 0.3, "pitch": 0.1, "yaw": 0.7},
    {"height_m": 3.0, "roll": math.pi, "pitch": 0.05},
    {"height_m": 3.0, "roll": 1.2, "nodes": 200},
)


@pytest.mark.parametrize(
    "floor, tolerance",
    [  # each floor with one tolerance, each tolerance on several floors
        pytest.param(
            floor, tolerance, id=f"{floor}-{tolerance}", marks=() if number % 2 == turn else pytest.mark.slow
        )
        for number, floor in enumerate(FLOORS)
        for turn, tolerance in enumerate(TOLERANCES)
    ],
)
def test_grazing_floors(floor, tolerance):
    got = regimes.grazing_floor(tolerance=tolerance, **floor)
    assert got["bins"] > 4500  # of 9 beams of 1000 bins
    # rows are a third of a degree apart and there are 1000 bins to 20 degrees: most bins get no sample
    assert got["empty"] > 0.5
    assert got["naive"] > 5.0
    assert got["naive_wrong"] > 0.9
    # footprints are exact for planes; the remaining error is that of the ray's length, taken as constant over one
    # footprint, and of footprints that the aperture cuts obliquely
    assert got["wrong"] < 0.003
    assert got["ours"] < 0.006
    # where the footprints of two rows meet in a bin, constant lengths leave a gap or an overlap
    assert got["off"] < 0.001
    assert got["worst"] < 0.02


@pytest.mark.parametrize(
    "turn", [pytest.param({"roll": HALF}, marks=pytest.mark.slow), {"roll": -HALF, "pitch": 0.1}], ids=str
)
def test_floors_with_a_sonar_on_its_side(turn):
    got = regimes.grazing_floor(3.0, 0.01, bins=200, nodes=2000, **turn)
    assert got["naive_wrong"] > 0.7
    # errors of the ray's length, and of joined rows where range changes across a strip; the truth errs by 2e-4
    assert got["wrong"] < 1.5e-3


@pytest.mark.parametrize("tolerance, seam", [(0.01, 0.02), (0.05, 0.1)])
def test_fine_bins(tolerance, seam):
    """Bins of 2.5 mm, some hundred per sample."""
    plain, ours, empty, worst = regimes.fine_bins(tolerance)
    assert empty > 0.95
    assert plain > 1.9  # nearly all of the echo is in wrong bins, where 2 is the maximum
    assert ours < 2e-4  # the ray's length, taken as constant over a footprint
    assert worst < seam  # one bin, where two rows meet


def test_nothing_in_range():
    plain, ours = regimes.no_echo([regimes.plate("wall", 30, 10)])
    assert plain == (0, [])  # a black image without a warning
    assert ours[0] == 0 and ours[1][0].endswith("lies at 30.00 m, beyond range_max_m = 20")


@pytest.mark.parametrize("distance", [100.0, 300.0, 1000.0])
def test_far_walls(distance):
    plain, ours = regimes.far_wall(distance)
    assert plain > 1e-3 * (distance / 100) ** 2  # steps of r² / (near 2^24)
    assert ours < 1e-6 * distance  # float32 and interpolation of 1/r: some 2^-24 of the range


def test_surfaces_nearer_than_range_min():
    plain, ours = regimes.hand_before_the_sonar()
    assert plain > 0.99
    assert ours == 0  # the hand fills the fan


def test_inside_a_closed_body():
    plain, ours = regimes.inside_a_body()
    assert plain == 0
    assert ours == pytest.approx(1, abs=1e-3)  # facets of 2 degrees are tilted by up to 1 degree


@pytest.mark.parametrize("place", [(0.3, 0.2, 0), (2, 0.5, 0), (2, 2, 0)], ids=["face", "edge", "corner"])
def test_on_a_face_an_edge_a_corner(place):
    plain, ours = oddities.on_a_body(*place)
    assert plain == 1
    # surfaces nearer than 1 mm are clipped, and the rays lead away; rows are joined or not by all that a strip meets
    assert ours < 1e-3


@pytest.mark.slow
def test_silhouettes():
    plain, ours = regimes.silhouette()
    assert plain > 0.1
    assert ours < 0.02  # 2 samples per beam; half of the error is at the ball's rim, where 1/r is not linear


@pytest.mark.parametrize("distance", [20.0, 50.0, 100.0])
def test_surfaces_close_one_behind_the_other(distance):
    """Of two surfaces 5 mm apart the further one stays hidden, with a near plane of 1 mm as ours."""
    plain, ours = regimes.paint_before_a_wall(distance)
    # steps of r² / (near 2^24) are 24 mm at 20 m; how many samples that hides is the driver's rounding
    assert plain > 0.2
    assert ours == 0  # steps of 8 range_max / 2^24 are 0.06 mm at 100 m


@pytest.mark.parametrize("mu", [(1.0, 1.0), (1.0, 0.2), (0.2, 1.0)], ids=str)
def test_coplanar_faces(mu):
    plain, ours = oddities.coplanar(mu)
    assert plain > 1.15
    # each sample shows one of the two, it is not defined which; 1e-6 is the float32 error of slopes
    assert min(mu) * (1 - 1e-6) <= ours <= max(mu) * (1 + 1e-6)


def test_sheets_from_behind():
    plain, ours = regimes.sheet_from_behind()
    assert plain == 0
    assert ours == pytest.approx(1, rel=1e-5)  # float32


@pytest.mark.parametrize(
    "change, naive_ratio, tolerance",
    [
        (lambda n: -n, -1.0, 1e-6),  # the visible side counts
        (lambda n: 10 * n, 10.0, 1e-6),
        (lambda n: 0 * n, 0.0, 2e-3),  # without normals: the mean cosine of the flat facets
    ],
    ids=["reversed", "long", "missing"],
)
def test_odd_normals(change, naive_ratio, tolerance):
    plain, ours = oddities.shading_normals(change)
    assert plain == pytest.approx(naive_ratio)
    assert ours == pytest.approx(1, abs=tolerance)


def test_normals_that_are_not_numbers():
    normals = np.asarray(oddities.BALL.vertex_normals).copy()
    normals[3, 1] = np.nan
    with pytest.raises(sg.Error) as caught:
        sg.Body("ball", oddities.BALL, normals=normals)
    assert str(caught.value) == (
        f"body 'ball': normals must be finite (got NaN or infinity in 1 of {normals.size} numbers)"
    )


def test_degenerate_and_duplicate_triangles():
    plain, ours = oddities.broken_triangles()
    assert plain == 24  # all degenerate faces
    # the box with them is not closed: samples at its outline may reach behind what is visible of it
    assert ours < 2e-4


def test_far_from_the_origin():
    plain, ours = regimes.far_from_the_origin()
    assert plain > 0.3  # float32 has steps of half a metre at 4 500 km, bins are 10 cm
    assert ours < 1e-4  # float64 has steps of a nanometre


@pytest.mark.parametrize("angles", [(HALF, 0, 0), (0, HALF, 0), (0, 0, HALF)], ids=["roll", "pitch", "yaw"])
@pytest.mark.parametrize("times", [-1, 2])
def test_quarter_and_half_turns(angles, times):
    _, ours = oddities.attitude(*(np.array(angles) * times))
    assert ours < 1e-5  # float32 matrices


@pytest.mark.parametrize("pitch", [-HALF, HALF])
def test_looking_straight_down_and_up(pitch):
    plain, ours = oddities.attitude(0.3, pitch, 1.0)
    assert plain > 10  # degrees; Euler angles are singular there
    assert ours < 1e-5  # float32 matrices


def test_a_cosine_a_hair_above_one():
    plain, ours = oddities.cosine_above_one()
    assert plain > 0.1  # a unit vector of float32, squared, is above 1 as often as not
    assert ours <= 4  # the echo is stored times range: two roundings


def test_the_ends_of_the_bins():
    plain, ours = oddities.bin_ends()
    assert plain == [0, 0, 11, 12]  # truncated towards the first bin, and one past the last
    assert ours == [-1, 0, 11, -1]


@pytest.mark.parametrize("beams, bins", [(1, 1), (7, 3), (4096, 512), (1, 8192)])
def test_few_many_and_odd_counts(beams, bins):
    plain, ours = oddities.many_beams_and_bins(beams, bins)
    if beams > 100:
        assert plain >= 1  # every other beam gets no column
    assert ours < 1e-3  # facets of 2 degrees are tilted by up to 1 degree


@pytest.mark.slow
def test_saturation_of_sums():
    plain, ours = oddities.long_sums()
    assert plain > 0.5  # float32 counts no further than 2^24
    assert ours < 2e-3  # a million samples in one bin err by 1e-3; a tolerance chooses fewer samples


@pytest.mark.parametrize("settings", [{"tvg_k": 60.0}, {"tvg_k": 0.0, "tvg_absorption_db_m": 0.0}])
def test_overflow_and_underflow_of_gains(settings):
    """An echo of 1e-30 at 50 km, with 30 000 dB of absorption or a very large gain, stays finite."""
    sonar = replace(regimes.SONAR, range_max_m=1e5, n_bins=1000)
    wall = regimes.plate("wall", 5e4, 1e5, 1e-30)
    with regimes.simulate([wall], sonar) as simulator, warnings.catch_warnings():
        warnings.simplefilter("error")
        quiet = simulator.ping(regimes.HERE).intensity.sum()
    acoustics = sg.Acoustics.physical(**settings)
    with sg.Simulator(sg.Scene([wall]), sonar, acoustics, regimes.SAMPLING) as simulator:
        ping = simulator.ping(regimes.HERE)
    assert 1e-31 < quiet < 1e-27  # 64 beams of 1e-30, not flushed to zero
    assert np.isfinite(ping.intensity).all()
    assert (ping.intensity >= 0).all()
    assert np.isnan(naive.gain_by_factors(5e4, acoustics.water.absorption(sonar.frequency_hz)))


def test_a_plane_seen_edge_on_has_no_negative_echo():
    """The footprint of a sample on it is far wider than a bin, and differences of its energy are rounded."""
    corners = [[-1000, 0, -1000], [1000, 0, -1000], [1000, 0, 1000], [-1000, 0, 1000]]
    plane = sg.Body("plane", trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False))
    sonar = sg.load_sonar("p900-45")
    with sg.Simulator(sg.Scene([plane]), sonar, sg.Acoustics.physical(), sg.Sampling(2.0, 60)) as simulator:
        ping = simulator.ping(sg.pose(z=-2.0, pitch=0.2), labels=True)
    assert ping.intensity.min() >= 0.0 and ping.body_echo.min() >= 0.0
