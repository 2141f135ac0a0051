"""Beams of one straight array are cones about its axis: closed forms, the ray caster, and upright beams beside them."""

import math
from dataclasses import replace

import numpy as np
import pytest
import trimesh

import sonar_gl as sg
from sonar_gl.analysis.reference import reference_ping
from sonar_gl.beamform.beamformer import NO_GAIN, make_beamformer
from sonar_gl.beamform.kernels import work_table
from sonar_gl.beamform.kernels.strips import Lattice, lay_on_cone
from sonar_gl.beamform.kernels.work_table import LINE_U, SAMPLE, TILT, V_RAY
from sonar_gl.sonar.fan import BeamShape, make_fan
from sonar_gl.sonar.samples import SectorSamples
from sonar_gl.sonar.sector import cone_end_rad
from tests.support.fans import make_sonar, view_of_points

pytestmark = pytest.mark.usefixtures("few_first_rays")

EVEN = sg.Acoustics.ideal()
CONES = replace(EVEN, beam_pattern="line_array", conical_beams=True)
UPRIGHT = replace(CONES, conical_beams=False)
ARRAY = make_sonar(120.0, 128, 1.0, beam_spacing="sine")


def shown(azimuth_deg, elevation_deg):
    """Return the azimuth at which a line array shows a direction, degrees."""
    return np.degrees(np.arcsin(np.sin(np.radians(azimuth_deg)) * np.cos(np.radians(elevation_deg))))


# ---- the strips of a sector -------------------------------------------------------------------------------

FANS = {
    "narrow": (make_sonar(20.0, 32, beam_spacing="sine"), 0.0),
    "wide": (ARRAY, 0.0),
    "side lobes": (ARRAY, 89.5),
    "tall": (make_sonar(140.0, 64, 2.0, elevation_fov_deg=100.0, beam_spacing="sine"), 0.0),
    "one side": (replace(ARRAY, n_beams=3, beam_azimuths_deg=(20.0, 40.0, 60.0)), 89.5),
}


@pytest.mark.parametrize("name", FANS)
@pytest.mark.parametrize("shear", [0.2764, pytest.param(-0.2764, marks=pytest.mark.slow)])
def test_strips_hold_the_solid_angle_of_their_columns_once(name, shear):
    """Along a strip, a cone of sines from k to k + dk has dk dv / (cos ψ0 (1 + v²) + sin ψ0 u)."""
    sonar, max_elevation_deg = FANS[name]
    beams = BeamShape(math.radians(2.0), False, max_elevation_deg=max_elevation_deg, are_cones=True)
    fan = make_fan(sonar, sg.Sampling(1, 24), beams, shear)
    nodes, weights = np.polynomial.legendre.leggauss(40)
    held = np.zeros(fan.n_columns + fan.n_wide_columns)
    for sector in fan.sectors:
        assert 2 * sector.half_width_rad <= math.radians(60) + 1e-9
        strips, sine, cosine = sector.strips, math.sin(sector.azimuth_rad), math.cos(sector.azimuth_rad)
        low, high, k = strips.v_low[:, None], strips.v_high[:, None], strips.middle[:, None]
        v = (low + high) / 2 + (high - low) / 2 * nodes
        # u on the cone: between the sides of the sector the sine rises to port, so that bisection finds it
        side = math.tan(sector.half_width_rad)
        starboard, port = np.full(v.shape, side), np.full(v.shape, -side)
        for _ in range(60):
            u = (starboard + port) / 2
            is_to_starboard = (sine - cosine * u) / np.sqrt(1 + u * u + v * v) < k
            starboard, port = np.where(is_to_starboard, u, starboard), np.where(is_to_starboard, port, u)
        np.testing.assert_allclose(
            (sine - cosine * u) / np.sqrt(1 + u * u + v * v), np.broadcast_to(k, v.shape), atol=1e-12
        )
        per_v = strips.width[:, None] / (cosine * (1 + v * v) + sine * u)
        np.add.at(held, strips.column, (per_v * (high - low) / 2) @ weights)
    edges = fan.column_edges_rad
    middles = (edges[1:] + edges[:-1]) / 2
    column_sr = 2 * np.cos(middles) * np.diff(edges) * cone_end_rad(middles, fan.max_sine)
    n_wide = fan.n_wide_columns
    shares = np.zeros(fan.n_columns)
    if n_wide:
        shares = np.repeat(held[fan.n_columns :], np.diff(fan.wide_edges)) * fan.wide_shares
    found = held[: fan.n_columns] + shares
    # midpoint rules for columns and wide ones, coarse where cones end at the greatest azimuth
    np.testing.assert_allclose(found, column_sr, rtol=2e-2)
    assert found.sum() == pytest.approx(column_sr.sum(), rel=1e-5)


@pytest.mark.parametrize("name", FANS)
def test_samples_cover_every_strip(name):
    """The row of samples nearest to each end of a strip lies within a row of it."""
    sonar, max_elevation_deg = FANS[name]
    beams = BeamShape(0.03, False, max_elevation_deg=max_elevation_deg, are_cones=True)
    fan = make_fan(sonar, sg.Sampling(1, 24), beams)
    for sector in fan.sectors:
        _, v = sector.sample_coordinates()
        assert (sector.strips.v_low > v.max(axis=1).min() - sector.v[2]).all()
        assert (sector.strips.v_high < v.min(axis=1).max() + sector.v[2]).all()
        # rows never rise as steeply as a cone leans, which would give it two samples of one row
        assert (np.diff(v, axis=0) > 0).all()


@pytest.mark.parametrize("name", FANS)
def test_the_sample_of_a_row_is_the_nearest_to_the_strip(name):
    """Half a sample from where its row meets the cone, which leans by half as much at most on the way."""
    sonar, max_elevation_deg = FANS[name]
    beams = BeamShape(0.03, False, max_elevation_deg=max_elevation_deg, are_cones=True)
    fan = make_fan(sonar, sg.Sampling(1, 64), beams)
    work, n_inside = work_table.make_work(), 0
    for sector in fan.sectors:
        lattice = Lattice(*SectorSamples(sector, None, None).lattice)
        strips, j = sector.strips, np.arange(sector.rows)
        for p in range(0, len(strips.middle), 7):
            lay_on_cone(work, lattice, strips.middle[p], 0, sector.rows)
            i, line_u, tilt, v = work[[SAMPLE, LINE_U, TILT, V_RAY], : sector.rows]
            inside = (v > strips.v_low[p]) & (v < strips.v_high[p])
            off = (line_u + tilt * v - (sector.u[0] + sector.u[1] * i + sector.u[2] * j)) / sector.u[1]
            assert np.abs(off[inside]).max(initial=0) < 0.76
            n_inside += inside.sum()
    assert n_inside > 0


# ---- which sonars have them -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "acoustics", "expected"),
    [
        ({}, CONES, True),
        ({"beam_spacing": "angle", "steered": "straight"}, CONES, True),
        ({"beam_spacing": "angle"}, CONES, False),  # as a lens or a curved array
        ({}, UPRIGHT, False),
        ({}, replace(CONES, beam_pattern="gaussian"), True),
        ({}, replace(CONES, beam_pattern="box"), False),
        ({"azimuth_fov_deg": 170.0}, CONES, False),  # its outer beams look along the array
    ],
)
def test_smooth_beams_of_straight_arrays_are_cones(changes, acoustics, expected):
    sonar = replace(ARRAY, **changes)
    assert bool(acoustics.has_cones(sonar)) is expected
    assert make_beamformer(sonar, acoustics, sg.Sampling(1, 16)).fan.are_cones is expected


def test_the_profiles():
    assert sg.Acoustics.physical().conical_beams
    assert not sg.Acoustics.ideal().conical_beams and not sg.Acoustics.demarco2015().conical_beams
    assert not sg.Acoustics.parse("conical_beams=false").conical_beams


# ---- closed forms -----------------------------------------------------------------------------------------


def echo_of(sonar, acoustics, bodies, pose=None, engine="cpu", **settings):
    scene = sg.Scene(bodies)
    with sg.Simulator(scene, sonar, acoustics, engine=engine, **settings) as simulator:
        return simulator.ping(np.eye(4) if pose is None else pose, labels=True)


@pytest.mark.parametrize("elevation_pattern", ["box", "line_array"])
def test_a_wall_all_round_has_its_reflectivity_in_all_beams(elevation_pattern):
    acoustics = replace(CONES, elevation_pattern=elevation_pattern)
    shell = trimesh.creation.icosphere(5, 10.0)
    ping = echo_of(ARRAY, acoustics, [sg.Body("wall", shell, reflectivity=0.5)], sampling=sg.Sampling(2, 64))
    # flat faces of 2 degrees lie up to 1.5e-4 of the radius inside it; the rest are wide columns at the greatest
    # azimuth
    np.testing.assert_allclose(ping.intensity.sum(axis=1), 0.5, rtol=4e-3)


@pytest.mark.slow
@pytest.mark.parametrize("elevation_pattern", ["line_array", "gaussian"])
@pytest.mark.parametrize("conical_beams", [True, False])
def test_a_wall_all_round_has_its_reflectivity_however_low_the_beams(elevation_pattern, conical_beams):
    """A main lobe of a twentieth of a degree is a small part of the hemisphere that side lobes receive."""
    sonar = make_sonar(60.0, 5, 4.0, elevation_fov_deg=0.05, beam_spacing="sine", elevation_taper="chebyshev")
    acoustics = replace(CONES, elevation_pattern=elevation_pattern, conical_beams=conical_beams)
    wall = sg.Body("wall", trimesh.creation.icosphere(5, 10.0), reflectivity=0.5)
    ping = echo_of(sonar, acoustics, [wall], sampling=sg.Sampling(2, 64))
    np.testing.assert_allclose(ping.intensity.sum(axis=1), 0.5, rtol=4e-3)  # as above
    truth = sg.reference_ping(sg.Scene([wall]), sonar, np.eye(4), acoustics, 0.2)
    np.testing.assert_allclose(truth.intensity.sum(axis=1), 0.5, rtol=0.05)  # few rays in the main lobe


@pytest.mark.parametrize("elevation_deg", [-9.0, 0.0, 9.0])
@pytest.mark.parametrize("azimuth_deg", [-60.0, 55.0])
def test_a_ball_stands_where_the_array_shows_it(azimuth_deg, elevation_deg):
    """Upright beams show it at its azimuth, a degree and more off."""
    azimuth, elevation = np.radians([azimuth_deg, elevation_deg])
    place = 10 * np.array(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    )
    ball = sg.Body("ball", trimesh.creation.icosphere(3, 0.1), sg.pose(*place), 1.0)
    places = {}
    for name, acoustics in (("cones", CONES), ("upright", UPRIGHT)):
        sonar = replace(ARRAY, n_beams=257)
        ping = echo_of(sonar, acoustics, [ball], sampling=sg.Sampling(8, 256))
        beam = ping.intensity.sum(axis=1).argmax()
        places[name] = np.degrees(ping.azimuth_rad[beam])
        seen = ping.elevation_rad[beam, ping.intensity[beam].argmax()]
        assert np.degrees(seen) == pytest.approx(elevation_deg, abs=0.3)  # half of the ball's width
    spacing_deg = np.degrees(np.diff(sonar.azimuth_rad).max())
    assert places["cones"] == pytest.approx(shown(azimuth_deg, elevation_deg), abs=spacing_deg)
    assert places["upright"] == pytest.approx(azimuth_deg, abs=spacing_deg)


@pytest.mark.slow
def test_the_first_bottom_return_of_a_level_array_is_a_straight_line():
    """On the cone that is shown at β the floor is nearest at h / cos β, below the axis; upright beams all look there.

    At range r the floor's echo is μ h/r in the solid angle cos β dβ dt, where cos β sin t = h/r around the cone.
    """
    height_m, sonar = 5.0, make_sonar(100.0, 65, 2.0, elevation_fov_deg=160.0, beam_spacing="sine")
    plate = trimesh.creation.box((400.0, 400.0, 1.0))
    floor = sg.Body("floor", plate, sg.pose(0, 0, -height_m - 0.5), 1.0)
    acoustics = replace(CONES, far_side_lobes=False)
    ping = echo_of(sonar, acoustics, [floor], sampling=sg.Sampling(8, 1024))
    upright = echo_of(sonar, replace(acoustics, conical_beams=False), [floor], sampling=sg.Sampling(8, 1024))
    edges, azimuth = sonar.bin_edges_m, sonar.azimuth_rad
    first_m = height_m / np.cos(azimuth)
    # the edges of the main lobe lie nearer the axis, and side lobes return 1e-3 at most
    first_bin = (ping.intensity > 0.05 * ping.intensity.max(axis=1, keepdims=True)).argmax(axis=1)
    reach_m = sonar.bin_size_m + height_m * (1 / np.cos(azimuth) - 1 / np.cos(np.abs(azimuth) - 0.02))
    assert (edges[first_bin + 1] > first_m - reach_m).all()
    assert (edges[first_bin] < first_m + sonar.bin_size_m).all()
    strongest = upright.range_m[upright.intensity.argmax(axis=1)]
    assert np.ptp(strongest) < sonar.bin_size_m and strongest[0] == pytest.approx(height_m, abs=0.6)

    # further off, where a beam is narrow beside the turn of the ring: the integral of μ h/r over the cone
    far = edges[:-1] > 12.0
    end = cone_end_rad(azimuth, math.sin(math.radians(80.0)))[:, None]
    sine = height_m / edges / np.cos(azimuth)[:, None]
    around = np.minimum(np.arcsin(np.minimum(sine, 1)), end)
    # ∫ cos β sin t dt over the solid angle 2 t_end of a radian of the cone
    exact = np.cos(azimuth)[:, None] * np.diff(np.cos(around), axis=1) / (2 * end)
    np.testing.assert_allclose(ping.intensity[:, far], exact[:, far], rtol=0.02)
    error = np.abs(ping.intensity - exact)[:, far].sum() / exact[:, far].sum()
    assert error < 2e-3 < 0.05 < np.abs(upright.intensity - exact)[:, far].sum() / exact[:, far].sum()


@pytest.mark.slow
def test_the_ray_caster_agrees():
    """On a scene with all that the device has, within the tolerance; upright beams are far off."""
    tolerance = 0.04
    sonar = make_sonar(110.0, 96, 1.2, 40.0, beam_spacing="sine", element_error_db=-38.0)
    acoustics = sg.Acoustics.physical()
    rng = np.random.default_rng(5)
    plate = trimesh.creation.box((60.0, 60.0, 1.0))
    bodies = [sg.Body("floor", plate, sg.pose(10, 0, -3.5), 0.3)]
    for number in range(6):
        place = rng.uniform((3, -8, -2.5), (14, 8, 1.0))
        turn = dict(zip(("roll", "pitch", "yaw"), rng.uniform(-1, 1, 3), strict=True))
        bodies.append(
            sg.Body(
                f"box {number}", trimesh.creation.box(rng.uniform(0.5, 2.0, 3)), sg.pose(*place, **turn), 0.5
            )
        )
    scene, pose = sg.Scene(bodies), sg.pose(0, 0, 0.5, pitch=0.2, roll=0.1)
    reference = reference_ping(scene, sonar, pose, acoustics, error=tolerance).intensity
    upright = replace(acoustics, conical_beams=False)
    for settings, engine, is_close in (
        (acoustics, "cpu", True),
        (acoustics, "opengl", True),
        (upright, "cpu", False),
    ):
        with sg.Simulator(scene, sonar, settings, tolerance=tolerance, engine=engine) as simulator:
            difference = np.abs(simulator.ping(pose).intensity - reference).sum() / reference.sum()
        assert difference < tolerance if is_close else difference > 2 * tolerance


@pytest.mark.slow
def test_the_ray_caster_agrees_on_wide_beams_that_are_steered_far():
    """A beam of 20 degrees at 68: side lobes reach 158 degrees from its axis, still before the array."""
    sonar = make_sonar(137.0, 5, 20.0, 16.0, steered="straight", element_error_db=-38.0)
    acoustics = sg.Acoustics.physical(elevation_pattern="box")
    bodies = [sg.Body("ball", trimesh.creation.icosphere(3, 1.0), sg.pose(2, -5, 0), 0.5)]
    reference = reference_ping(sg.Scene(bodies), sonar, np.eye(4), acoustics, error=0.03).intensity
    ping = echo_of(sonar, acoustics, bodies, sampling=sg.Sampling(16, 128))
    assert np.abs(ping.intensity - reference).sum() < 0.03 * reference.sum()
    # far side lobes are exact to a tenth of their peak
    np.testing.assert_allclose(ping.intensity.sum(axis=1), reference.sum(axis=1), rtol=0.15)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:no echo came back")
def test_upright_beams_of_a_straight_array_receive_nothing_from_behind_it():
    """Beams of 8 degrees at ±75 are so wide that their supports end far behind the array."""
    sonar = make_sonar(150.0, 2, 8.0, steered="straight", beam_spacing="sine")
    acoustics = sg.Acoustics.physical(elevation_pattern="box", conical_beams=False)
    bodies = [
        sg.Body(f"ball at {x} m", trimesh.creation.icosphere(3, 0.5), sg.pose(x, -4, 0), 0.5)
        for x in (-1.5, 1.5)  # at azimuths of -111 and -69 degrees
    ]
    behind, ahead = (echo_of(sonar, acoustics, [body], sampling=sg.Sampling(64, 64)) for body in bodies)
    assert not behind.intensity.any()
    reference = reference_ping(sg.Scene(bodies), sonar, np.eye(4), acoustics, error=0.02).intensity
    assert np.abs(ahead.intensity - reference).sum() < 0.02 * reference.sum()


@pytest.mark.slow
def test_bodies_beside_the_cones_take_no_samples():
    """Views reach as far aside as the outermost cone at their highest elevation: their lower corners are in no beam."""
    sonar = make_sonar(45.0, 32, 1.5, beam_spacing="sine")
    ball = trimesh.creation.icosphere(3, 0.4)
    ahead = sg.Body("ahead", ball, sg.pose(8, 1, 0), 0.5)
    azimuth, elevation = np.radians([50.0, 40.0])  # shown at 36 degrees, 14 degrees from the nearest beam
    assert shown(50.0, 40.0) > 35
    place = 5 * np.array(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    )
    behind = sg.Body("behind", ball, sg.pose(-5, 1, 0), 0.5)
    plans = []
    for more in ([], [sg.Body("beside", ball, sg.pose(*place), 1.0)], [behind]):
        scene = sg.Scene([ahead, *more])
        with sg.Simulator(scene, sonar, sg.Acoustics.physical(), tolerance=0.02) as simulator:
            plans.append(simulator.plan([np.eye(4)]).sampling)
    assert plans[0] == plans[1] == plans[2]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("sonar", "sampling"),
    [
        (make_sonar(30.0, 1, 10.0, beam_spacing="sine"), sg.Sampling(16, 64)),
        (make_sonar(150.0, 2, 1.0, beam_spacing="sine"), sg.Sampling(100, 128)),
        (make_sonar(120.0, 64, 2.0, beam_spacing="sine"), sg.Sampling(2, 64)),
        (replace(ARRAY, n_beams=3, beam_azimuths_deg=(20.0, 40.0, 60.0)), sg.Sampling(8, 64)),
        (replace(ARRAY, elevation_fov_deg=170.0), sg.Sampling(2, 512)),
    ],
)
def test_odd_sonars_receive_a_wall_all_round_in_full(sonar, sampling):
    shell = sg.Body("wall", trimesh.creation.icosphere(5, 10.0), reflectivity=0.5)
    ping = echo_of(sonar, replace(CONES, far_side_lobes=True), [shell], sampling=sampling)
    # the tolerance is that of the wall above, and more for few columns
    np.testing.assert_allclose(ping.intensity.sum(axis=1), 0.5, rtol=6e-3)


# ---- what shares the sums ---------------------------------------------------------------------------------


def two_boxes():
    near = trimesh.creation.box((1.0, 2.0, 2.0))
    floor = trimesh.creation.box((60.0, 60.0, 1.0))
    return [
        sg.Body("near", near, sg.pose(8, 3, 0.5, yaw=0.4), 0.8),
        sg.Body("far", near, sg.pose(9, -7, 0, pitch=0.5), 0.4),
        sg.Body("floor", floor, sg.pose(10, 0, -3.5), 0.3),
    ]


def test_labels_have_the_bits_of_the_sums():
    with sg.Simulator(sg.Scene(two_boxes()), ARRAY, sg.Acoustics.physical(), tolerance=0.05) as one:
        plain, labelled = one.ping(np.eye(4)), one.ping(np.eye(4), labels=True)
    np.testing.assert_array_equal(plain.intensity, labelled.intensity)
    assert set(np.unique(labelled.body_id)) == {0, 1, 2, 3}


@pytest.mark.slow
@pytest.mark.parametrize("multipath", [pytest.param("none", marks=pytest.mark.slow), "incoherent"])
def test_a_mirrored_world_has_a_mirrored_picture(multipath):
    """Also by way of reflectors, whose image sources have the strips of the mirrored fan."""
    steel = trimesh.creation.box((12.0, 0.2, 8.0))
    floor = trimesh.creation.box((60.0, 60.0, 1.0))
    pings = []
    for side in (1, -1):
        bodies = [
            sg.Body("wall", steel, sg.pose(8, 6 * side, 0), 0.5, material="steel"),
            sg.Body("floor", floor, sg.pose(10, 0, -3.5), 0.3, material="concrete"),
            sg.Body("ball", trimesh.creation.icosphere(3, 0.5), sg.pose(7, 2 * side, -1.0), 0.8),
        ]
        acoustics = sg.Acoustics.physical(multipath=multipath)
        with sg.Simulator(sg.Scene(bodies), ARRAY, acoustics, tolerance=0.02) as simulator:
            pings.append(simulator.ping(np.eye(4)).intensity)
    one, other = pings[0], pings[1][::-1]
    # the lattice is sheared to one side, so that both err on their own
    assert np.abs(one - other).sum() < 0.04 * one.sum()


@pytest.mark.slow
def test_multipath_echoes_come_from_the_cones_of_their_images():
    """The image of a ball behind a planar reflector is shown where a ball at the image's place would be."""
    floor = trimesh.creation.box((60.0, 60.0, 1.0))
    place = np.array([6.0, 7.0, -2.0])
    depth_m = 4.0
    bodies = [
        sg.Body("reflector", floor, sg.pose(10, 0, -depth_m - 0.5), 0.0, material="steel"),
        sg.Body("ball", trimesh.creation.icosphere(3, 0.4), sg.pose(*place), 0.8),
    ]
    acoustics = replace(
        CONES, multipath="incoherent", far_side_lobes=False, elevation_pattern="box", range_law="constant"
    )
    sonar = make_sonar(120.0, 257, 1.0, elevation_fov_deg=100.0, beam_spacing="sine")
    scene = sg.Scene(bodies)
    with (
        sg.Simulator(scene, sonar, acoustics, sampling=sg.Sampling(4, 256)) as both,
        sg.Simulator(both, sonar, replace(acoustics, multipath="none")) as direct,
    ):
        image = both.ping(np.eye(4)).intensity - direct.ping(np.eye(4)).intensity
    mirrored = place * [1, 1, -1] - [0, 0, 2 * depth_m]
    range_m = np.linalg.norm(mirrored)
    last = (sonar.range_m > range_m - 0.4 - sonar.bin_size_m) & (sonar.range_m < range_m + 0.4)
    beam = image[:, last].sum(axis=1).argmax()
    expected = np.arcsin(mirrored[1] / range_m)
    assert sonar.azimuth_rad[beam] == pytest.approx(expected, abs=math.radians(1.0))
    upright = np.arctan2(mirrored[1], mirrored[0])  # where such beams show it
    assert upright - expected > math.radians(9.0)


def test_bubbles_are_shown_on_their_cones_and_those_behind_the_array_are_not():
    sonar = replace(ARRAY, n_beams=257)
    beamformer = make_beamformer(sonar, CONES, sg.Sampling(1, 16))
    azimuth, elevation = math.radians(50.0), math.radians(9.0)

    def received(azimuth_rad, sine):
        view = view_of_points(beamformer.fan, [[azimuth_rad, sine, 10.0, 1e-3]])
        return beamformer.sum_view(view, NO_GAIN).intensity.sum(axis=1)

    found = received(azimuth, math.sin(elevation))
    assert np.degrees(sonar.azimuth_rad[found.argmax()]) == pytest.approx(shown(50.0, 9.0), abs=0.3)
    for behind in (math.pi - azimuth, math.radians(88.0)):  # beyond MAX_AZIMUTH_RAD
        assert not received(behind, 0.1).any()
