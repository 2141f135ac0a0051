"""The ray-cast reference against closed forms, and its own estimate of its error."""

import math
import sys
import warnings
from itertools import product

import numpy as np
import pytest
import trimesh

import sonar_gl as sg
from sonar_gl.acoustics.acoustics import SWITCHES
from sonar_gl.acoustics.boundary import cos_incidence
from sonar_gl.core.extras import install_command
from tests.support.closed_forms import box_beams, cylinder_echo, plane_echo, plate_on_floor_echo, sphere_echo
from tests.support.errors import error_of

pytestmark = pytest.mark.usefixtures("few_first_rays")

ELEVATION = math.radians(10.0)
# the halves then differ by 0.3 % at most; their mean is half as far from the exact echo, about 0.15 %
ERROR = 0.03
EXACT = 0.002
IDEAL = sg.Acoustics.ideal()


def sonar(beams=8, fov_deg=12.0, width_deg=1.5, bins=150, range_min_m=0.0, range_max_m=30.0, **more):
    return sg.Sonar("test", 900e3, beams, bins, fov_deg, 20.0, width_deg, range_min_m, range_max_m, **more)


SONARS = {
    "contiguous": sonar(),
    "apart": sonar(width_deg=0.5),
    "overlapping": sonar(8, 6.0, 2.0),
    "narrow": sonar(16, 2.8125, 0.17578125),
    "uneven": sonar(3, 20.0, 1.0, beam_azimuths_deg=(-7.3, -7.0, 4.1)),
}


def truth(bodies, it, acoustics=IDEAL, pose=None, error=ERROR, **more):
    """Return a reference ping, which must not warn."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return sg.reference_ping(
            sg.Scene(bodies), it, np.eye(4) if pose is None else pose, acoustics, error, **more
        )


def share_in_wrong_bins(ping, exact):
    return np.abs(ping.intensity - exact).sum() / exact.sum()


def plane_body(normal, distance, half=400.0, **more):
    corners = [[-half, -half, 0], [half, -half, 0], [half, half, 0], [-half, half, 0]]
    pose = trimesh.geometry.align_vectors([0, 0, 1], normal)
    pose[:3, 3] = np.asarray(normal) * distance
    mesh = trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False)
    return sg.Body(more.pop("name", "plane"), mesh, pose, more.pop("reflectivity", 1.0), **more)


def plane_ping(it, normal, distance):
    def echo(azimuth):
        return plane_echo(normal, distance, azimuth, (-ELEVATION, ELEVATION), it.bin_edges_m)

    return box_beams(it, echo, 50)  # errs by 2e-5 of a beam's echo at most


# --- against closed forms

PLANES = {
    "upright": ((1, 0, 0), 8.0),
    "tilted": ((math.cos(0.5), 0, math.sin(0.5)), 8.0),
    "yawed and pitched": ((math.cos(0.5), 0.2 * math.sin(0.5), math.sin(0.5)), 6.0),
    "level floor": ((0, 0, -1), 3.0),
    "sloping floor": ((0.2, 0.1, -1), 2.5),
    "ceiling": ((0.1, -0.2, 1), 2.0),
}


FAST_PLANES = {*product(["yawed and pitched"], ("apart", "overlapping", "uneven")), ("level floor", "narrow")}


@pytest.mark.parametrize(
    "name, beams",
    [
        pytest.param(name, beams, marks=() if (name, beams) in FAST_PLANES else pytest.mark.slow)
        for name, beams in product(["yawed and pitched", "level floor"], SONARS)
    ],
)
def test_planes_in_beams_of_all_kinds(name, beams):
    normal, distance = PLANES[name]
    normal = np.array(normal) / np.linalg.norm(normal)
    it = SONARS[beams]
    assert (
        share_in_wrong_bins(truth([plane_body(normal, distance)], it), plane_ping(it, normal, distance))
        < EXACT
    )


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.slow if name in ("upright", "sloping floor", "ceiling") else ())
        for name in PLANES
    ],
)
def test_planes(name):
    normal, distance = PLANES[name]
    normal = np.array(normal) / np.linalg.norm(normal)
    it = sonar(range_min_m=2.0, range_max_m=20.0)
    assert (
        share_in_wrong_bins(truth([plane_body(normal, distance)], it), plane_ping(it, normal, distance))
        < EXACT
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    "angles, offset_m",
    [
        ((-2.9, 0.2, 2.5), 500e3),  # both at once
        pytest.param((0.4, 0.2, 0), 500e3, marks=pytest.mark.slow),
        pytest.param((-2.9, 0.2, 2.5), 0.0, marks=pytest.mark.slow),
        pytest.param((0.4, 0.2, 0), 0.0, marks=pytest.mark.slow),
    ],
)
def test_floor_below_a_rotated_sonar(angles, offset_m):
    """Also at UTM coordinates, where float32 rounds by 3 cm, a third of a bin."""
    it = sonar(bins=150, range_max_m=15.0)
    pose = sg.pose(offset_m, -offset_m, 0.0, *angles)
    floor = plane_body((0, 0, -1), 3.0)
    body = sg.Body("floor", floor.mesh, sg.pose(offset_m, -offset_m, 0.0) @ floor.pose, 1.0)
    exact = plane_ping(it, pose[:3, :3].T @ (0, 0, -1), 3.0)
    assert share_in_wrong_bins(truth([body], it, pose=pose), exact) < EXACT


@pytest.mark.slow
def test_sphere():
    it = sonar(20, 20.0, 1.0)
    ball = sg.Body("ball", trimesh.creation.uv_sphere(1.0, count=[360, 720]), sg.pose(6.0), 1.0)
    exact = box_beams(it, lambda azimuth: sphere_echo(1.0, 6.0, azimuth, ELEVATION, it.bin_edges_m))
    assert share_in_wrong_bins(truth([ball], it), exact) < EXACT


@pytest.mark.slow
def test_cylinder():
    it = sonar(20, 20.0, 1.0)
    post = sg.Body("post", trimesh.creation.cylinder(0.5, 20.0, sections=2880), sg.pose(5.0), 1.0)
    exact = box_beams(
        it, lambda azimuth: cylinder_echo(0.5, 5.0, azimuth, -10, 10, ELEVATION, it.bin_edges_m), 1000
    )
    assert share_in_wrong_bins(truth([post], it), exact) < EXACT


def test_plate_and_its_shadow():
    it = sonar()
    plate = sg.Body("plate", trimesh.creation.box((0.002, 400, 1.0)), sg.pose(10.001, 0, -2.5), 1.0)
    # the echo is the same at all azimuths
    exact = box_beams(
        it, lambda azimuth: plate_on_floor_echo(3.0, 1.0, 10.0, azimuth, ELEVATION, it.bin_edges_m), 20
    )
    ping = truth([plate, plane_body((0, 0, -1), 3.0)], it)
    assert share_in_wrong_bins(ping, exact) < EXACT
    assert ping.intensity[:, (it.range_m > 10.5) & (it.range_m < 14.5)].max() == 0


@pytest.mark.parametrize(
    "beams, width_deg, profile",
    [
        pytest.param(24, 15.0, "ideal", marks=pytest.mark.slow),
        (3, 179.0, "physical"),
        pytest.param(16, 40.0, "physical", marks=pytest.mark.slow),
        pytest.param(24, 15.0, "physical", marks=pytest.mark.slow),
        pytest.param(16, 40.0, "ideal", marks=pytest.mark.slow),
        pytest.param(3, 179.0, "ideal", marks=pytest.mark.slow),
    ],
)
def test_a_sphere_about_the_sonar_returns_its_reflectivity_in_every_beam(beams, width_deg, profile):
    it = sonar(beams, 360.0, width_deg, bins=30)
    ball = sg.Body("ball", trimesh.creation.uv_sphere(10.0, count=[90, 180]), reflectivity=0.3)
    totals = truth([ball], it, sg.Acoustics(profile), error=0.1).intensity.sum(axis=1)
    # facets of 2 degrees are tilted by up to 1 degree: 1.5e-4
    np.testing.assert_allclose(totals, 0.3, rtol=1e-3)


# --- structure inside beams and fans


@pytest.mark.slow
def test_a_post_thinner_than_a_beam_is_weighted_by_the_pattern_at_its_azimuth():
    """A thin post shows the beam pattern, wherever it stands between the nodes."""
    acoustics, it = sg.Acoustics.physical(), sonar(20, 4.0, 1.0, bins=30)
    azimuth = math.radians(0.737)
    post = sg.Body(
        "post",
        trimesh.creation.box((0.002, 0.002, 20)),
        sg.pose(10 * math.cos(azimuth), 10 * math.sin(azimuth)),
    )
    received = truth([post], it, acoustics, error=0.1).intensity.sum(axis=1)
    pattern = acoustics.receive_pattern(it)(azimuth, it.azimuth_rad)
    # the post is 0.01 degrees wide, over which the pattern varies by 1e-3; the halves differ by 1 %
    np.testing.assert_allclose(received / received.max(), pattern / pattern.max(), atol=2e-3)


def test_a_step_inside_a_box_beam_is_cut_exactly():
    """A wall ends at an azimuth inside a beam: that beam receives its share, the others all or nothing."""
    it = sonar(4, 4.0, 1.0, bins=10)
    edge = 8 * math.tan(math.radians(0.3))  # of the third beam, from 0 to 1 degree, three tenths
    wall = sg.Body("wall", trimesh.creation.box((0.001, 8, 20)), sg.pose(8, edge - 4), 1.0)
    totals = truth([wall], it).intensity.sum(axis=1)
    wide = truth([sg.Body("wall", trimesh.creation.box((0.001, 80, 20)), sg.pose(8), 1.0)], it)
    np.testing.assert_allclose(totals / wide.intensity.sum(axis=1), [1, 1, 0.3, 0], atol=1e-3)


def test_a_fan_of_a_full_circle_has_no_seam():
    """A level floor in a full circle of wide beams: all beams are equal."""
    it = sonar(12, 360.0, 75.0, bins=20)
    totals = truth([plane_body((0, 0, -1), 3.0, 60)], it, error=0.05).intensity.sum(axis=1)
    np.testing.assert_allclose(totals, totals.mean(), rtol=1e-3)


# --- bodies


@pytest.mark.slow
def test_body_echo_is_each_bodys_part_of_the_intensity():
    # a pulse carries echo out of the last bins, a body's echo is before the pulse
    it, acoustics = sonar(bins=50), sg.Acoustics.physical(tvg_k=40.0, pulse=False)
    floor = plane_body((0, 0, -1), 3.0, name="floor", reflectivity=0.2)
    ball = sg.Body("ball", trimesh.creation.icosphere(4, 0.5), sg.pose(12, 0, -1), 0.7)
    hidden = sg.Body("hidden", trimesh.creation.icosphere(2, 0.2), sg.pose(12, 0, -1), 0.7)
    ping = truth([floor, hidden, ball], it, acoustics)
    assert ping.body_echo.dtype == np.float64 and ping.body_echo.shape == (4,)
    assert ping.body_echo.sum() == pytest.approx(ping.intensity.sum(dtype=np.float64), rel=1e-6)
    assert ping.body_echo[0] == ping.body_echo[2] == 0
    alone = truth([ball], it, acoustics).body_echo[1]  # the ball stands free before the floor
    assert ping.body_echo[3] == pytest.approx(alone, rel=2e-3)
    with sg.Simulator(sg.Scene([floor, hidden, ball]), it, acoustics) as simulator:
        fast = simulator.ping(np.eye(4), labels=True).body_echo
    # the promised 1 %, and sampling error
    np.testing.assert_allclose(fast, ping.body_echo, rtol=0.02, atol=1e-9)


def test_reflectivity_per_face():
    it = sonar(bins=10)
    wall = plane_body((1, 0, 0), 8.0)
    both = truth([plane_body((1, 0, 0), 8.0, reflectivity=[0.25, 0.75])], it).intensity.sum()
    each = [truth([plane_body((1, 0, 0), 8.0, reflectivity=r)], it).intensity.sum() for r in ([1, 0], [0, 1])]
    # all cast the same rays; sums of float32
    assert both == pytest.approx(0.25 * each[0] + 0.75 * each[1], rel=1e-5)
    assert sum(each) == pytest.approx(truth([wall], it).intensity.sum(), rel=1e-5)
    assert min(each) > 0


@pytest.mark.slow
@pytest.mark.parametrize("turn", [1, -1, 0])
def test_shading_normals_give_the_cosine_alone(turn):
    """A wall with the normals of one that leans: cos θ is theirs, turned to the sonar; zero normals are flat."""
    it, lean = sonar(bins=30), 0.7
    # in the wall's own frame, which has z along the sonar's x
    wall = plane_body((1, 0, 0), 8.0)
    leant = wall.pose[:3, :3].T @ (math.cos(lean), 0, math.sin(lean))
    shaded = sg.Body("wall", wall.mesh, wall.pose, 1.0, np.tile(turn * leant * 5, (4, 1)))
    ping = truth([shaded], it)
    # cos θ over directions is x cos(lean) + z sin(lean), and the mean of z is 0
    flat = truth([wall], it).intensity.sum()
    assert ping.intensity.sum() == pytest.approx(flat * (math.cos(lean) if turn else 1), rel=2e-3)
    with sg.Simulator(sg.Scene([shaded]), it, IDEAL) as simulator:
        assert share_in_wrong_bins(ping, simulator.ping(np.eye(4)).intensity) < 0.01


def test_shading_normals_are_interpolated_between_vertices():
    """A wall whose normals spread as (1, a y, 0) before normalization."""
    it, bend, half = sonar(6, 48.0, 8.0, bins=1), 0.8, 30.0
    wall = plane_body((1, 0, 0), 8.0, half)
    at = wall.mesh.vertices @ wall.pose[:3, :3].T
    normals = np.stack([np.ones(4), bend * at[:, 1], np.zeros(4)], axis=1) @ wall.pose[:3, :3]
    shaded = sg.Body("wall", wall.mesh, wall.pose, 1.0, normals)
    middle = (np.arange(400) + 0.5) / 200 - 1
    azimuth = it.azimuth_rad[:, None, None] + math.radians(4.0) * middle[:, None]
    cosine = np.sqrt(1 - (math.sin(ELEVATION) * middle) ** 2)  # at elevations of equal solid angle
    slope = bend * 8 * np.tan(azimuth)
    exact = (cosine * (np.cos(azimuth) + slope * np.sin(azimuth)) / np.hypot(1, slope)).mean(axis=(1, 2))
    flat = (cosine * np.cos(azimuth)).mean(axis=(1, 2))
    assert np.abs(exact - flat).max() > 0.02  # twenty times the bound below
    np.testing.assert_allclose(truth([shaded], it).intensity[:, 0], exact, rtol=1e-3)


@pytest.mark.slow
def test_faces_nearer_than_a_millimetre_are_transparent_and_inner_faces_echo():
    it = sonar(4, 360.0, 90.0, bins=50, range_max_m=5.0)
    room = sg.Body("room", trimesh.creation.icosphere(4, 3.0), reflectivity=0.5)
    skin = sg.Body("skin", trimesh.creation.icosphere(2, 0.0009), reflectivity=1.0)
    alone, within = (truth(bodies, it).intensity for bodies in ([room], [skin, room]))
    np.testing.assert_array_equal(alone, within)
    # facets of an icosphere are tilted by up to 2 degrees
    assert alone.sum(axis=1) == pytest.approx(0.5, rel=2e-3)
    shell = sg.Body("shell", trimesh.creation.icosphere(4, 0.0012), reflectivity=1.0)
    assert truth([shell, room], it).intensity[:, 0] == pytest.approx(1.0, rel=2e-3)


# --- its estimate of its error


@pytest.mark.parametrize(
    "bodies",
    [[], [sg.Body("far", trimesh.creation.box((1, 1, 1)), sg.pose(500))]],
    ids=["none", "out of range"],
)
def test_nothing_in_range(bodies):
    ping = truth(bodies, sonar())
    assert not ping.intensity.any() and not ping.body_echo.any()
    assert ping.intensity.shape == (8, 150) and ping.body_echo.shape == (len(bodies) + 1,)
    assert ping.meta["difference"] == 0.0 and ping.meta["converged"] is True


@pytest.mark.slow
def test_halves_are_independent_and_their_difference_predicts_the_error():
    """Over seeds, the error is half of the halves' difference, as for independent samples."""
    it = sonar()
    normal = np.array([0.2, 0.1, -1]) / np.linalg.norm([0.2, 0.1, -1])
    exact = plane_ping(it, normal, 2.5)
    pings = [truth([plane_body(normal, 2.5)], it, seed=seed, error=0.5) for seed in range(6)]
    errors, differences = zip(
        *((share_in_wrong_bins(p, exact), p.meta["difference"]) for p in pings), strict=True
    )
    assert len(set(errors)) == 6
    # errors of bins are about normal: the mean of two samples is half as wide as their difference
    assert np.mean(errors) == pytest.approx(np.mean(differences) / 2, rel=0.25)


def test_the_same_seed_gives_the_same_bytes():
    one, two, other = (truth([plane_body((0, 0, -1), 3.0)], sonar(), seed=s, error=0.1) for s in (3, 3, 4))
    assert one.intensity.tobytes() == two.intensity.tobytes() != other.intensity.tobytes()
    assert one.body_echo.tobytes() == two.body_echo.tobytes()
    assert one.meta == two.meta and one.meta["seed"] == 3
    assert not one.intensity.flags.writeable and not one.body_echo.flags.writeable


@pytest.mark.slow
def test_a_smaller_error_takes_more_rays():
    floor = [plane_body((0.3, 0.2, -1) / np.sqrt(1.13), 3.0)]
    coarse, fine = (truth(floor, sonar(), error=error) for error in (0.3, 0.03))
    assert coarse.meta["n_rays"] < fine.meta["n_rays"]
    assert fine.meta["difference"] <= 0.003 < coarse.meta["difference"] <= 0.03


@pytest.mark.slow
def test_progress_counts_all_rays_and_changes_no_byte():
    floor, told = [plane_body((0.3, 0.2, -1) / np.sqrt(1.13), 3.0)], []
    counted = truth(floor, sonar(), progress=lambda cast, expected: told.append((cast, expected)))
    assert told[-1][0] == counted.meta["n_rays"] and all(cast <= expected for cast, expected in told)
    assert [cast for cast, _ in told] == sorted(cast for cast, _ in told)
    assert counted.intensity.tobytes() == truth(floor, sonar()).intensity.tobytes()


def test_too_few_rays_warn():
    with pytest.warns(UserWarning) as caught:
        ping = sg.reference_ping(
            sg.Scene([plane_body((0.3, 0.2, -1) / np.sqrt(1.13), 3.0)]), sonar(), np.eye(4), IDEAL, 1e-4, 2e6
        )
    difference = ping.meta["difference"]
    assert not ping.meta["converged"] and 1e-5 < difference < 0.03
    assert 1.9e6 < ping.meta["n_rays"] <= 2e6
    assert [str(w.message) for w in caught] == [
        f"the reference can judge errors above {10 * difference:.2g} only, not 0.0001: after "
        f"{ping.meta['n_rays']} rays its halves still differ by {difference:.2g} (give more max_rays)"
    ]


SCENE = sg.Scene([])


MODELLED = {"conical_beams", "far_side_lobes", "transmit_beam", "pulse", "specular", "cross_talk"}
REFUSED = {"bubbles", "volume_reverberation", "surface_reverberation"}


def test_the_reference_models_or_refuses_each_switch():
    """A ping with a new term would be held to be wrong, by a reference that lacks it."""
    assert set(SWITCHES) == MODELLED | REFUSED, (
        "have the reference model a new term, or refuse it in `check_known`"
    )


@pytest.mark.parametrize(
    "change, message",
    [
        ({"scene": "pylon"}, "scene must be a Scene (got str;"),
        ({"sonar": 3}, "sonar must be a Sonar (got int;"),
        ({"acoustics": "ideal"}, "acoustics must be an Acoustics (got str;"),
        ({"pose": np.eye(3)}, "pose must have shape (4, 4) (got (3, 3);"),
        ({"error": 0.0}, "error of a reference must lie in 0.0001..0.5 (got 0)"),
        ({"error": math.nan}, "error of a reference must lie in 0.0001..0.5 (got nan)"),
        ({"error": "1 %"}, "error of a reference must be a number (got '1 %')"),
        ({"max_rays": 10}, "max_rays of a reference must lie in 1e+06..8.58993e+09 (got 10)"),
        ({"max_rays": True}, "max_rays of a reference must be a number (got True)"),
        ({"seed": -1}, "seed must be a whole number, 0 or more (got -1)"),
    ],
)
def test_bad_input(change, message):
    arguments = {"scene": SCENE, "sonar": sonar(), "pose": np.eye(4), "acoustics": IDEAL} | change
    assert error_of(sg.reference_ping, **arguments).startswith(message)


def test_without_embree(monkeypatch):
    monkeypatch.setitem(sys.modules, "embreex.rtcore_scene", None)
    assert error_of(sg.reference_ping, SCENE, sonar(), np.eye(4)) == (
        f"the reference needs Embree (got no module embreex); to add it: {install_command('reference')}"
    )


def test_cosine_is_clipped_to_0_and_1():
    directions = np.array([[1.0, 0, 0], [1.0000001, 0, 0], [-1, 0, 0]])
    np.testing.assert_array_equal(cos_incidence(np.array([-1.0, 0, 0]), directions), [1, 1, 0])
