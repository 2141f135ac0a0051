"""Specular lobes: a sphere's target strength, agreement of four implementations, and raster against ray casting."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

import sonar_gl as sg
from sonar_gl.acoustics.boundary import specular_lobe
from sonar_gl.analysis import rays
from sonar_gl.analysis.verify import ping_error
from sonar_gl.beamform.kernels import range_bins
from sonar_gl.engine.body_extents import BodyExtents
from sonar_gl.raster import level_of_detail as detail
from sonar_gl.raster.cpu.kernels.shading import lobe_times_range, mean_lobe_times_range, widens_lobe
from sonar_gl.raster.opengl import buffers
from sonar_gl.scene import primitives
from sonar_gl.scene.materials import material
from sonar_gl.scene.state import SceneState
from tests.support import glsl

pytestmark = pytest.mark.usefixtures("few_first_rays")

SONAR = sg.Sonar("test", 900e3, 64, 200, 32.0, 20.0, 0.5, 0.5, 12.0)  # box beams without overlap
BEAM_SR = np.radians(0.5) * 2 * np.sin(np.radians(10))
AHEAD = np.eye(4)


IDEAL = replace(sg.Acoustics.ideal(), specular=True)


def body(name, shape, pose, reflectivity=0.0, specular=0.8, roughness_rad=0.1):
    return sg.Body(name, shape[0], pose, reflectivity, shape[1], specular, roughness_rad)


def ping(bodies, acoustics=IDEAL, sampling=None, sonar=SONAR, pose=AHEAD):
    with sg.Simulator(sg.Scene(bodies), sonar, acoustics, sampling) as simulator:
        return simulator.ping(pose)


def sphere_total(radius, distance, strength, slope):
    """Return the echo of a sphere in steradians, summed over its near side."""
    theta = np.linspace(0, np.pi / 2, 200_001)[:-1]
    # a ray η off the axis makes θ with the normal where it meets the sphere: sin η = a/d sin θ
    eta = np.arcsin(radius / distance * np.sin(theta))
    return np.trapezoid(specular_lobe(np.cos(theta), strength, slope) * 2 * np.pi * np.sin(eta), eta)


@pytest.mark.parametrize("slope", [0.02, 0.05, 0.1, 0.2, 0.4])
def test_the_formula_gives_the_target_strength_of_a_sphere(slope):
    """σ = |R|² a² / 4 for every roughness, to second order."""
    total = sphere_total(0.1, 10.0, 0.8, slope)
    # ∫ t √(1 + t²) exp(−t² / 2s²) dt / s² = 1 + s² − s⁴ + ..; at a finite distance a/d is off by its square
    assert total / (np.pi * 0.1**2 / 4 * 0.8 / 10.0**2) == pytest.approx(1 + slope**2, abs=slope**4 + 2e-4)


@pytest.mark.parametrize(
    ("how", "slope"),
    [  # rays take the longer, the narrower the lobe is
        *(("raster", slope) for slope in (0.02, 0.05, 0.1, 0.4)),
        ("rays", 0.4),
    ],
)
def test_a_sphere_has_its_target_strength(slope, how):
    ball = body("ball", primitives.sphere(0.5), sg.pose(5.0), roughness_rad=slope)
    rays = how == "rays"
    found = sg.reference_ping(sg.Scene([ball]), SONAR, AHEAD, IDEAL, error=0.03) if rays else ping([ball])
    total = float(found.intensity.sum(dtype=np.float64)) * BEAM_SR
    # the mesh is within 5e-4 of the radius, and interpolated normals err slightly; the tolerance allows the rest, such
    # as 1e-3 of rays, whose echo is in wrong bins by 0.3 %
    assert total == pytest.approx(sphere_total(0.5, 5.0, 0.8, slope), rel=6e-3)


@pytest.mark.parametrize("slope", [0.02, 0.04])
def test_a_long_cylinder_has_its_target_strength(slope):
    """σ = a r |R|² / 4 of a spherical wave at a cylinder across the boresight, half of Urick's a r / 2 of a plane wave.

    The reflected wave has the radii of curvature r and r a / (2r + a) there, and spreads over r once more: with r² / R
    in place of r, R the distance of the axis.
    """
    radius, near = 0.2, 5.0
    pole = body("pole", primitives.cylinder(radius, 6.0), sg.pose(near + radius), roughness_rad=slope)
    total = float(ping([pole]).intensity.sum(dtype=np.float64)) * BEAM_SR
    expected = np.pi / 4 * 0.8 * radius / (near + radius)
    # 1 + 1.5 s² of the lobe, whose part beyond 10 degrees of elevation is less than 1e-4; as for the sphere
    assert total == pytest.approx(expected * (1 + 1.5 * slope**2), rel=6e-3)


@pytest.mark.parametrize("software", ["0", "1"])
@pytest.mark.parametrize("engine", ["cpu", "opengl"])
@pytest.mark.parametrize("slope", [0.02, 0.1])
def test_a_sphere_of_few_samples_has_its_target_strength(slope, engine, software, monkeypatch):
    """Its lobe is far narrower than a sample, and lies anywhere between them."""
    monkeypatch.setenv("SONAR_GL_SOFTWARE", software)
    radius, distance, rng = 0.15, 4.0, np.random.default_rng(3)
    ball = body("ball", primitives.sphere(radius), sg.pose(distance), roughness_rad=slope)
    sampling = sg.Sampling(0.6, 25)  # some 0.8 degrees
    with sg.Simulator(sg.Scene([ball]), SONAR, IDEAL, sampling, engine=engine) as simulator:
        (sector,) = simulator.run.sampler.resolution.stage.fan.sectors
        sample = abs(sector.u[1] * sector.v[2] - sector.u[2] * sector.v[1])
        totals = []
        for _ in range(12):
            y, z = rng.uniform(-0.1, 0.1, 2)
            pose = sg.pose(np.sqrt(distance**2 - y**2 - z**2), y, z, *rng.uniform(-3, 3, 3))
            simulator.place({"ball": pose})
            (seen,) = simulator.gbuffers(AHEAD)
            is_met = seen.body_id > 0
            assert 18 <= is_met.sum() <= 26
            totals.append((seen.echo * seen.direction[..., 0] ** 3)[is_met].sum() * sample)
    # normals turn by as much from sample to sample as these are wide in radii. The lobe is widened to a quarter of its
    # square, and has as much more echo, see above; what lies between samples adds 3 % at most (BLUR)
    wider = 0.25 * sample / (radius / distance) ** 2 - slope**2
    assert wider > 0
    expected = (1 + wider) * sphere_total(radius, distance, 0.8, slope)
    np.testing.assert_allclose(totals, expected, rtol=0.04)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "more_db"), [("brass", 0.90), ("steel", 0.29), ("glass", 0.02), ("rock", 4.26)]
)
def test_a_sphere_of_a_material_adds_lobe_and_diffuse_part(name, more_db):
    """TS = 10 log(a² (S (1 + s²) / 4 + 2μ / 3)): S of the lobe alone, and a Lambert sphere of the diffuse μ.

    With all of |R|² in the place of S, a²|R|²/4 would be too little, by up to 4.26 dB (8/3) of a rough sphere.
    """
    radius, distance, of = 0.3, 8.0, material(name)
    shape, slope = primitives.sphere(radius), of.roughness_rad or 0.0
    ball = sg.Body("ball", shape[0], sg.pose(distance), name, shape[1])
    total = float(ping([ball]).intensity.sum(dtype=np.float64)) * BEAM_SR
    strength_m2 = total * distance**2 / np.pi  # the echo is normalised by Lambert's 1/π
    wanted_m2 = radius**2 * (of.specular * (1 + slope**2) / 4 + 2 * of.reflectivity / 3)
    # as for the lobe alone; s⁴ is left out, and a rim of the nearer side is hidden: a/d squared of the diffuse part
    assert strength_m2 == pytest.approx(wanted_m2, rel=6e-3)
    by_all_m2 = radius**2 * (of.specular + of.reflectivity) / 4
    assert 10 * np.log10(wanted_m2 / by_all_m2) == pytest.approx(more_db, abs=0.01)


@pytest.mark.slow
def test_a_lobe_that_is_not_widened_is_that_of_the_normal_of_its_sample():
    """Normals that turn by less than twice the roughness from sample to sample; some by a little less."""
    rng, n_widened, strength = np.random.default_rng(0), 0, np.float32(0.8)
    for _ in range(1000):
        forms, (x, y), (u, v) = np.zeros(9), rng.uniform(0, 500, 2), rng.uniform(-1, 1, 2)
        slope, normal = np.float32(rng.uniform(0.02, 0.3)), rng.normal(size=3) * 10 ** rng.uniform(-3, 3)
        turns = rng.normal(size=(3, 2))
        turns *= slope * np.linalg.norm(normal) * 10 ** rng.uniform(-2, 1, 2) / np.linalg.norm(turns, axis=0)
        forms[:] = np.column_stack([normal - turns @ (x, y), turns]).ravel()
        range_m = rng.uniform(1, 30)
        echo = range_m * rng.uniform(0.5, 1)
        if widens_lobe(forms, x, y, slope):
            n_widened += 1
            continue
        got = mean_lobe_times_range((forms, x, y), (u, v), echo, range_m, strength, slope)
        # roundings of an exponent of up to 60
        assert got == pytest.approx(lobe_times_range(echo, range_m, strength, slope), rel=1e-12)
    assert 300 < n_widened < 700


def test_all_implementations_of_the_lobe_agree():
    cosine = np.concatenate([[0.0, 1e-4, 1.0], np.random.default_rng(0).uniform(0.2, 1, 4093)])
    strength, slope = np.float32(0.7), np.random.default_rng(1).uniform(0.02, 0.5, 4096)
    want = specular_lobe(cosine.astype(np.float32), 0.7, slope.astype(np.float32))
    assert np.isfinite(want).all() and (want >= 0).all()
    inputs = {"cosine": cosine, "slope": slope}
    got = glsl.call("echo.glsl", inputs, "specular_lobe(cosine, 0.7, slope)")[:, 0]
    # tan² in float32 errs by 2e-7, divided by 2 s² of 1e-3; in the tail the exponent of -88 errs by 1e-5 of itself
    np.testing.assert_allclose(got, want, rtol=2e-3, atol=1e-9)

    for k in range(0, 4096, 97):
        lobe = lobe_times_range(4 * cosine[k], 4.0, strength, np.float32(slope[k]))
        assert lobe == pytest.approx(4 * want[k], rel=1e-3, abs=1e-9)
        assert rays.backscatter(cosine[k], 0.3, 0.7, slope[k]) == pytest.approx(
            0.3 * cosine[k] + want[k], rel=1e-3, abs=1e-9
        )


def shiny_world(slope=0.1):
    """Return a floor of sand; a sphere, a horizontal cylinder and a plate of smooth steel; a box with a μ per face."""
    steel = material("steel")
    smooth_steel = {"reflectivity": steel.reflectivity, "specular": steel.specular, "roughness_rad": slope}
    box, plate = trimesh.creation.box((0.6, 0.6, 0.6)), (trimesh.creation.box((0.02, 1.0, 1.0)), None)
    across = sg.pose(7, -0.7, -1.2, roll=np.pi / 2, yaw=0.15)
    return [
        sg.Body("floor", primitives.plane(size=(40, 40))[0], sg.pose(z=-1.5), "sand"),
        body("sphere", primitives.sphere(0.4), sg.pose(5, 0.8, -1.0), **smooth_steel),
        body("cylinder", primitives.cylinder(0.2, 1.5), across, **smooth_steel),
        body("plate", plate, sg.pose(8.5, 1.0, -0.9, yaw=0.1), **smooth_steel),
        sg.Body("box", box, sg.pose(6, -1.3, -1.2), np.linspace(0.1, 0.9, 12), None, 0.05, 0.3),
    ]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("profile", "slope"),
    [
        ("ideal", 0.05),
        pytest.param("ideal", 0.1, marks=pytest.mark.slow),
        # with the patterns, which test_beam_pattern.py compares without lobes
        pytest.param("physical", 0.05, marks=pytest.mark.slow),
        pytest.param("physical", 0.1, marks=pytest.mark.slow),
    ],
)
def test_raster_against_rays(profile, slope):
    scene = sg.Scene(shiny_world(slope))
    acoustics, pose = replace(getattr(sg.Acoustics, profile)(), specular=True), sg.pose(pitch=0.1)
    truth = sg.reference_ping(scene, SONAR, pose, acoustics, error=0.03)
    found = ping(scene.bodies, acoustics, pose=pose)
    assert ping_error(found, truth) <= 0.01  # of which the reference has 0.3 %
    dark = ping(scene.bodies, replace(acoustics, specular=False), pose=pose)
    assert ping_error(dark, truth) > 0.1  # the lobes count


@pytest.mark.parametrize("software", ["0", "1"], ids=["planes of corners", "planes of the driver"])
@pytest.mark.parametrize("sampling", [sg.Sampling(3, 200), sg.Sampling(0.5, 40)], ids=["fine", "coarse"])
def test_both_engines_give_the_same_lobes(sampling, software, monkeypatch):
    monkeypatch.setenv("SONAR_GL_SOFTWARE", software)
    both = []
    bodies = shiny_world()
    monkeypatch.setattr(
        range_bins, "piece_limits", lambda *_: (0.0, 0.0)
    )  # one engine alone knows faces, and joins rows
    for engine in ("cpu", "opengl"):
        monkeypatch.setenv("SONAR_GL_ENGINE", engine)
        both.append(ping(bodies, sampling=sampling, pose=sg.pose(pitch=0.1)).intensity)
    # except for slopes at edges of triangles, which the driver takes as differences of samples
    assert np.abs(both[0] - both[1]).sum() < 2e-4 * both[0].sum()
    monkeypatch.setattr(
        buffers, "has_indirect_draws", lambda _: False
    )  # as with a driver without indirect draws
    again = ping(bodies, sampling=sampling, pose=sg.pose(pitch=0.1)).intensity
    np.testing.assert_array_equal(again, both[1])


def test_lobes_need_both_the_setting_and_a_specular_body():
    bodies = shiny_world()
    matt = [replace(one, specular=0.0) for one in bodies]
    plain = sg.Acoustics.ideal()
    some = sg.Sampling(2, 80)
    want = ping(matt, plain, some).intensity.tobytes()
    assert ping(bodies, plain, some).intensity.tobytes() == want
    assert ping(matt, IDEAL, some).intensity.tobytes() == want
    assert ping(bodies, IDEAL, some).intensity.tobytes() != want


def test_simulators_of_one_world_have_separate_acoustics():
    bodies, some = shiny_world(), sg.Sampling(2, 80)
    want = [ping(bodies, acoustics, some).intensity.tobytes() for acoustics in (sg.Acoustics.ideal(), IDEAL)]
    with (
        sg.Simulator(sg.Scene(bodies), SONAR, sg.Acoustics.ideal(), some) as one,
        sg.Simulator(one, SONAR, IDEAL, some) as other,
    ):
        for _ in range(2):
            assert [it.ping(AHEAD).intensity.tobytes() for it in (one, other)] == want


@pytest.mark.slow
def test_levels_of_detail_do_not_change_a_lobe(monkeypatch):
    """Coarser levels of a mesh are not used for a body with a specular lobe."""
    mesh = trimesh.creation.icosphere(7, 0.5)
    assert len(mesh.faces) > detail.MIN_FACES_TO_SIMPLIFY
    normals = np.asarray(mesh.vertices, np.float32) * 2
    ball = sg.Body("ball", mesh, sg.pose(6), 0.0, normals, 0.8, 0.03)
    some = sg.Sampling(8, 300)
    fine = ping([ball], sampling=some)
    monkeypatch.setattr(detail, "MIN_FACES_TO_SIMPLIFY", 10**9)
    np.testing.assert_allclose(fine.intensity, ping([replace(ball)], sampling=some).intensity, rtol=1e-4)
    total = float(fine.intensity.sum(dtype=np.float64)) * BEAM_SR
    assert total == pytest.approx(sphere_total(0.5, 6.0, 0.8, 0.03), rel=6e-3)


def test_the_greatest_echo_of_a_body_includes_its_lobe():
    """A body with a specular lobe and μ = 0 is searched for where no sample hit it."""
    wire = body("wire", primitives.cylinder(0.002, 1.0), sg.pose(8), 0.1, 0.8, 0.1)
    state = SceneState(wire.pose[None], np.ones(1, bool))
    assert BodyExtents([wire]).greatest_backscatter(state).tolist() == [0.1]
    (found,) = BodyExtents([wire], specular=True).greatest_backscatter(state)
    assert found == pytest.approx(0.1 + specular_lobe(1, 0.8, 0.1))
