"""Where methods fail: the naive way's failure is measured beside ours, in the same test.

What each measure does stands in `regimes.py` and `oddities.py`, the naive ways in `naive.py`. Regimes that
have tests of their own elsewhere stand here for the sake of the pair.
"""

import math
import warnings
from dataclasses import replace

import naive
import numpy as np
import oddities
import pytest
import regimes

import sonar_gl as sg

pytestmark = pytest.mark.filterwarnings("ignore:no echo came back")  # what is measured

HALF = math.pi / 2


@pytest.mark.parametrize("fov", [120.0, 130.0, 179.0, 180.0, 270.0, 360.0])
def test_wide_fans(fov):
    plain, ours = regimes.wide_fan(fov)
    assert (
        plain > 0.6
    )  # the middle of one view is too thin for its beams; from 180 degrees on there is no view
    assert ours < 1e-3  # facets of 1 degree stand half a degree askew: cos is 4e-5 less


@pytest.mark.parametrize("tolerance", [0.01, 0.05])
@pytest.mark.parametrize(
    "floor",
    [
        {"height_m": 0.3},
        {"height_m": 3.0},
        {"height_m": 20.0},
        {"height_m": 3.0, "lowest_deg": 0.5},
        {"height_m": 3.0, "width_deg": 0.2},
        {"height_m": 3.0, "roll": 0.3, "pitch": 0.1, "yaw": 0.7},
        {"height_m": 3.0, "roll": -0.3, "yaw": 3.0},
        {"height_m": 3.0, "roll": math.pi, "pitch": 0.05},
        {"height_m": 3.0, "roll": 1.2},
    ],
    ids=str,
)
def test_grazing_floors(floor, tolerance):
    got = regimes.grazing_floor(tolerance=tolerance, **floor)
    assert got["bins"] > 4500  # of 9 beams of 1000 bins
    # rows a third of a degree apart, of bins 1000 to 20 degrees: most bins get no sample
    assert got["empty"] > 0.5
    assert got["naive"] > 5.0
    assert got["naive_wrong"] > 0.9
    # footprints are planes' own; what is left is the length of the ray, taken as constant over one, and the
    # ends of those that the aperture cuts aslant
    assert got["wrong"] < 0.003
    assert got["ours"] < 0.006
    # where the footprints of two rows meet in one bin, constant lengths leave a gap or lie double there
    assert got["off"] < 0.001
    assert got["worst"] < 0.02


@pytest.mark.parametrize("turn", [{"roll": HALF}, {"roll": -HALF, "pitch": 0.1}], ids=str)
def test_floors_before_a_sonar_on_its_side(turn):
    got = regimes.grazing_floor(3.0, 0.01, bins=200, nodes=2000, **turn)
    assert got["naive_wrong"] > 0.7
    assert got["wrong"] < 1e-3  # of the ray's length; the truth has 2e-4 of its own


@pytest.mark.parametrize("tolerance, seam", [(0.01, 0.02), (0.05, 0.1)])
def test_fine_bins(tolerance, seam):
    """Of 2.5 mm: some hundred to a sample."""
    plain, ours, empty, worst = regimes.fine_bins(tolerance)
    assert empty > 0.99
    assert plain > 1.9  # all of it is in the wrong place: of 2
    assert ours < 2e-4  # the ray's length, taken as constant over a footprint
    assert worst < seam  # one bin, where two rows meet


@pytest.mark.parametrize(
    "bodies, why",
    [
        ([], "the scene has no bodies"),
        (
            [regimes.plate("wall", 30, 10)],
            "the nearest surface in the fan lies at 30.00 m, beyond range_max_m = 20",
        ),
        (
            [regimes.plate("lens", 0.3, 0.5)],
            "the nearest surface in the fan lies at 0.30 m, nearer than range_min_m = 0.5",
        ),
        (
            [regimes.plate("absorber", 5, 1, 0.0)],
            "the nearest surface in the fan lies at 5.00 m, of reflectivity 0 or seen edge-on",
        ),
        (
            [regimes.plate("wall", -5, 1)],
            "no surface lies in the fan; the nearest is 'wall', 5.00 m away at azimuth 180.0° and elevation "
            "-0.0° of the sonar, which sees ±30° and ±10°; turn or move the sonar",
        ),
    ],
    ids=["no bodies", "too far", "too near", "silent", "behind"],
)
def test_empty_scenes_and_nothing_in_range(bodies, why):
    plain, ours = regimes.nothing(bodies)
    assert plain == (0, [])  # a black image without a word
    assert ours == (0, [f"no echo came back: {why}"])


@pytest.mark.parametrize("distance", [100.0, 300.0, 1000.0])
def test_far_walls(distance):
    plain, ours = regimes.far_wall(distance)
    assert plain > 1e-3 * (distance / 100) ** 2  # r² / (near 2^24) between two steps
    assert ours < 1e-6 * distance  # 1/r in float32 and its interpolation: some 2^-24 of the range


def test_what_is_nearer_than_range_min():
    plain, ours = regimes.hand_before_the_sonar()
    assert plain > 0.99
    assert ours == 0  # the hand fills the fan


def test_inside_a_closed_body():
    plain, ours = regimes.inside_a_body()
    assert plain == 0
    assert ours == pytest.approx(1, abs=1e-3)  # facets of 2 degrees stand 1 degree askew


@pytest.mark.parametrize("place", [(0.3, 0.2, 0), (2, 0.5, 0), (2, 2, 0)], ids=["face", "edge", "corner"])
def test_on_a_face_an_edge_a_corner(place):
    plain, ours = oddities.on_a_body(*place)
    assert plain == 1
    assert ours == 0  # nearer than 1 mm nothing is seen, and the rays lead away


def test_silhouettes():
    plain, ours = regimes.silhouette()
    assert plain > 0.1
    assert ours < 0.02  # 2 samples a beam; half of it is the ball's rim, where 1/r is no plane's


@pytest.mark.parametrize("distance", [10.0, 50.0, 100.0])
def test_surfaces_close_one_behind_the_other(distance):
    """5 mm apart: the further one does not shine through. At a near plane of 1 mm, as ours is."""
    plain, ours = regimes.paint_before_a_wall(distance)
    assert plain > 0.3  # steps of r² / (near 2^24) are 6 mm at 10 m
    assert ours == 0  # steps of 8 range_max / 2^24 are 0.06 mm at 100 m


@pytest.mark.parametrize("mu", [(1.0, 1.0), (1.0, 0.2), (0.2, 1.0)], ids=str)
def test_coplanar_faces(mu):
    plain, ours = oddities.coplanar(mu)
    assert plain > 1.15
    # one of the two is seen in each place, which one is not defined; 1e-6: float32 of the slopes
    assert min(mu) * (1 - 1e-6) <= ours <= max(mu) * (1 + 1e-6)


def test_sheets_from_behind():
    plain, ours = regimes.sheet_from_behind()
    assert plain == 0
    assert ours == pytest.approx(1, rel=1e-5)  # float32


@pytest.mark.parametrize(
    "change, taken_as_it_is, tolerance",
    [
        (lambda n: -n, -1.0, 1e-6),  # the side that is seen counts
        (lambda n: 10 * n, 10.0, 1e-6),
        (lambda n: 0 * n, 0.0, 2e-3),  # none: flat faces, whose mean cosine is that of the facets
    ],
    ids=["reversed", "long", "missing"],
)
def test_odd_normals(change, taken_as_it_is, tolerance):
    plain, ours = oddities.shading_normals(change)
    assert plain == pytest.approx(taken_as_it_is)
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
    assert plain == 24  # all that have no area
    assert ours < 1e-5  # float32: the same faces in another order


def test_far_from_the_origin():
    plain, ours = regimes.far_from_the_origin()
    assert plain > 0.3  # float32 has steps of half a metre at 4 500 km, bins are 10 cm
    assert ours < 1e-4  # float64 has steps of a nanometre


@pytest.mark.parametrize("angles", [(HALF, 0, 0), (0, HALF, 0), (0, 0, HALF)], ids=["roll", "pitch", "yaw"])
@pytest.mark.parametrize("times", [-2, -1, 1, 2])
def test_quarter_and_half_turns(angles, times):
    _, ours = oddities.attitude(*(np.array(angles) * times))
    assert ours < 1e-5  # float32 of the matrices


@pytest.mark.parametrize("pitch", [-HALF, HALF])
def test_looking_straight_down_and_up(pitch):
    plain, ours = oddities.attitude(0.3, pitch, 1.0)
    assert plain > 10  # degrees: Euler's angles are not unique there
    assert ours < 1e-5  # float32 of the matrices


def test_a_cosine_a_hair_above_one():
    plain, ours = oddities.cosine_above_one()
    assert plain > 0.1  # a unit vector of float32, squared, is above 1 as often as not
    assert ours <= 4  # the echo is kept times range: two roundings


def test_the_ends_of_the_bins():
    plain, ours = oddities.bin_ends()
    assert plain == [0, 0, 11, 12]  # truncated towards the first bin, and one past the last
    assert ours == [-1, 0, 11, -1]


@pytest.mark.parametrize("beams, bins", [(1, 1), (3, 7), (7, 3), (255, 8191), (4096, 512), (1, 8192)])
def test_few_many_and_odd_counts(beams, bins):
    plain, ours = oddities.many_beams_and_bins(beams, bins)
    if beams > 100:
        assert plain >= 1  # every other beam gets no column
    assert ours < 1e-3  # facets of 2 degrees stand 1 degree askew


def test_saturation_of_sums():
    plain, ours = oddities.long_sums()
    assert plain > 0.5  # float32 counts to 2^24 and stays there
    assert ours < 2e-3  # a million samples in one bin drift by 1e-3; what a tolerance chooses, by less


@pytest.mark.parametrize("settings", [{"tvg_k": 60.0}, {"tvg_k": 0.0, "tvg_absorption_db_m": 0.0}])
def test_overflow_and_underflow_of_gains(settings):
    """An echo of 1e-30 at 50 km, absorbed by 30 000 dB or amplified without end, is a number."""
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
    assert np.isnan(naive.gain_by_factors(5e4, acoustics.absorption(sonar.frequency_hz)))
