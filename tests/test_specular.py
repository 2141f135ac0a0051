"""Lobes of smooth faces: a sphere's target strength, one formula in four places, raster against rays."""

import re
from dataclasses import replace

import glsl
import numpy as np
import pytest
import trimesh

import sonar_gl as sg
from sonar_gl import detail, gpu, meshes, rays, sift
from sonar_gl.census import Extent
from sonar_gl.echo import specular_lobe
from sonar_gl.materials import material
from sonar_gl.verify import ping_error

SONAR = sg.Sonar("test", 900e3, 64, 200, 32.0, 20.0, 0.5, 0.5, 12.0)  # box beams, side by side
BEAM_SR = np.radians(0.5) * 2 * np.sin(np.radians(10))
AHEAD = np.eye(4)


IDEAL = replace(sg.Acoustics.ideal(), specular=True)


def body(name, shape, pose, reflectivity=0.0, specular=0.8, roughness_rad=0.1):
    return sg.Body(name, shape[0], pose, reflectivity, shape[1], specular, roughness_rad)


def ping(bodies, acoustics=IDEAL, sampling=None, sonar=SONAR, pose=AHEAD):
    with sg.Simulator(sg.Scene(bodies), sonar, acoustics, sampling) as simulator:
        return simulator.ping(pose)


def sphere_total(radius, distance, strength, slope):
    """Echo of a sphere in steradians, summed over its near side."""
    theta = np.linspace(0, np.pi / 2, 200_001)[:-1]
    # a ray η off the axis makes θ with the normal where it meets the sphere: sin η = a/d sin θ
    eta = np.arcsin(radius / distance * np.sin(theta))
    return np.trapezoid(specular_lobe(np.cos(theta), strength, slope) * 2 * np.pi * np.sin(eta), eta)


@pytest.mark.parametrize("slope", [0.02, 0.05, 0.1, 0.2, 0.4])
def test_the_formula_gives_a_sphere_its_target_strength(slope):
    """σ = |R|² a² / 4, whatever the roughness, to its square: that much echo goes all round."""
    total = sphere_total(0.1, 10.0, 0.8, slope)
    # ∫ t √(1 + t²) exp(−t² / 2s²) dt / s² = 1 + s² − s⁴ + ..; at a finite distance a/d is off by its square
    assert total / (np.pi * 0.1**2 / 4 * 0.8 / 10.0**2) == pytest.approx(1 + slope**2, abs=slope**4 + 2e-4)


@pytest.mark.parametrize("slope", [0.02, 0.05, 0.1, 0.4])
@pytest.mark.parametrize("how", ["raster", "rays"])
def test_a_sphere_returns_its_target_strength(slope, how):
    ball = body("ball", meshes.sphere(0.5), sg.pose(5.0), roughness_rad=slope)
    rays = how == "rays"
    found = sg.reference_ping(sg.Scene([ball]), SONAR, AHEAD, IDEAL) if rays else ping([ball])
    total = float(found.intensity.sum(dtype=np.float64)) * BEAM_SR
    # its mesh lies within 5e-4 of the radius, and normals between corners are off by a little; the rest is
    # what the tolerance allows
    assert total == pytest.approx(sphere_total(0.5, 5.0, 0.8, slope), rel=6e-3)


def test_the_lobe_in_the_shader_and_in_the_sums_is_the_same():
    cosine = np.concatenate([[0.0, 1e-4, 1.0], np.random.default_rng(0).uniform(0.2, 1, 4093)])
    strength, slope = np.float32(0.7), np.random.default_rng(1).uniform(0.02, 0.5, 4096)
    want = specular_lobe(cosine.astype(np.float32), 0.7, slope.astype(np.float32))
    assert np.isfinite(want).all() and (want >= 0).all()
    inputs = {"cosine": cosine, "slope": slope}
    got = glsl.call("echo.glsl", inputs, "specular_lobe(cosine, 0.7, slope)")[:, 0]
    # float32's tan² is off by 2e-7, over 2 s² of 1e-3; far out the exponent of -88 is off by 1e-5 of itself
    np.testing.assert_allclose(got, want, rtol=2e-3, atol=1e-9)

    places, values = np.zeros((4096, 2), np.int32), np.zeros((4096, 4), np.float32)
    nodes, sums = np.array([-1.0, 1.0]), np.zeros((1, 1))
    for k in range(0, 4096, 97):  # 1/x of 1/4, in the middle: range 4
        values[k] = 0.25, 0, 0, 4 * cosine[k]
        sift._shine(k, k + 1, places, values, 0.3, strength, np.float32(slope[k]), np.zeros(3), np.zeros(3))
        assert values[k, 3] == pytest.approx(4 * (0.3 * cosine[k] + want[k]), rel=1e-3, abs=1e-9)
        ray, normal = np.float32([[1, 0, 0]]), np.float32([[-cosine[k], np.sqrt(1 - cosine[k] ** 2), 0]])
        hits = (np.float32([4]), normal, *np.zeros((2, 1), np.float32), *np.zeros((2, 1), np.int32))
        faces = np.array([0, 1]), np.array([0.3]), np.zeros((0, 3, 3), np.float32)
        sums[:] = 0
        lobes = np.array([[0.7, slope[k]]])
        one = np.ones(1)
        rays.land(np.zeros(1), ray, 0.0, hits, one, faces, lobes, nodes, False, one, (0.0, 0.1), one, sums,
                  np.zeros(2))  # fmt: skip
        assert sums[0, 0] == pytest.approx(0.3 * cosine[k] + want[k], rel=1e-3, abs=1e-9)


def shiny_world(slope=0.1):
    """A floor of sand, and a sphere, a lying cylinder and a plate of smooth steel; a patchy rough box."""
    steel = material("steel")
    shine = {"reflectivity": steel.reflectivity, "specular": steel.specular, "roughness_rad": slope}
    box, plate = trimesh.creation.box((0.6, 0.6, 0.6)), (trimesh.creation.box((0.02, 1.0, 1.0)), None)
    across = sg.pose(7, -0.7, -1.2, roll=np.pi / 2, yaw=0.15)
    return [
        sg.Body("floor", meshes.plane(size=(40, 40))[0], sg.pose(z=-1.5), "sand"),
        body("sphere", meshes.sphere(0.4), sg.pose(5, 0.8, -1.0), **shine),
        body("cylinder", meshes.cylinder(0.2, 1.5), across, **shine),
        body("plate", plate, sg.pose(8.5, 1.0, -0.9, yaw=0.1), **shine),
        sg.Body("box", box, sg.pose(6, -1.3, -1.2), np.linspace(0.1, 0.9, 12), None, 0.05, 0.3),
    ]


@pytest.mark.parametrize("slope", [0.05, 0.1])
@pytest.mark.parametrize("profile", ["ideal", "physical"])
def test_raster_against_rays(profile, slope):
    scene = sg.Scene(shiny_world(slope))
    acoustics, pose = replace(getattr(sg.Acoustics, profile)(), specular=True), sg.pose(pitch=0.1)
    truth = sg.reference_ping(scene, SONAR, pose, acoustics)
    found = ping(scene.bodies, acoustics, pose=pose)
    assert ping_error(found, truth) <= 0.01
    dark = ping(scene.bodies, replace(acoustics, specular=False), pose=pose)
    assert ping_error(dark, truth) > 0.1  # the lobes count


def test_flat_faces_and_rounded_ones_filled_in_or_drawn(monkeypatch):
    """The CPU fills small triangles in as the driver would."""
    both = []
    bodies = shiny_world()
    for software in ("", "(?!)"):
        monkeypatch.setattr(gpu, "SOFTWARE", re.compile(software))
        both.append(ping(bodies, sampling=sg.Sampling(3, 200), pose=sg.pose(pitch=0.1)).intensity)
    # but for samples on edges of triangles, which fall to either side
    assert np.abs(both[0] - both[1]).sum() < 2e-3 * both[0].sum()
    monkeypatch.setattr(gpu, "INDIRECT_GL", 999)  # as if the driver had no draws from a buffer
    again = ping(bodies, sampling=sg.Sampling(3, 200), pose=sg.pose(pitch=0.1)).intensity
    np.testing.assert_array_equal(again, both[1])


def test_without_lobes_a_ping_is_as_if_there_were_none():
    bodies = shiny_world()
    matt = [replace(one, specular=0.0) for one in bodies]
    plain = sg.Acoustics.ideal()
    some = sg.Sampling(2, 80)
    want = ping(matt, plain, some).intensity.tobytes()
    assert ping(bodies, plain, some).intensity.tobytes() == want
    assert ping(matt, IDEAL, some).intensity.tobytes() == want
    assert ping(bodies, IDEAL, some).intensity.tobytes() != want


def test_simulators_of_one_world_each_have_their_own_acoustics():
    bodies, some = shiny_world(), sg.Sampling(2, 80)
    want = [ping(bodies, acoustics, some).intensity.tobytes() for acoustics in (sg.Acoustics.ideal(), IDEAL)]
    with (
        sg.Simulator(sg.Scene(bodies), SONAR, sg.Acoustics.ideal(), some) as one,
        sg.Simulator(one, SONAR, IDEAL, some) as other,
    ):
        for _ in range(2):
            assert [it.ping(AHEAD).intensity.tobytes() for it in (one, other)] == want


def test_levels_of_detail_do_not_dull_a_lobe(monkeypatch):
    """A mesh of so many faces has coarser levels; of a body with a lobe they do not stand in."""
    mesh = trimesh.creation.icosphere(7, 0.5)
    assert len(mesh.faces) > detail.MANY
    normals = np.asarray(mesh.vertices, np.float32) * 2
    ball = sg.Body("ball", mesh, sg.pose(6), 0.0, normals, 0.8, 0.03)
    some = sg.Sampling(8, 300)
    fine = ping([ball], sampling=some)
    monkeypatch.setattr(detail, "MANY", 10**9)
    np.testing.assert_allclose(fine.intensity, ping([replace(ball)], sampling=some).intensity, rtol=1e-4)
    total = float(fine.intensity.sum(dtype=np.float64)) * BEAM_SR
    assert total == pytest.approx(sphere_total(0.5, 6.0, 0.8, 0.03), rel=6e-3)


def test_a_body_made_of_steel():
    steel, one = material("steel"), sg.Body("one", trimesh.creation.box(), reflectivity="Steel")
    assert (one.reflectivity, one.specular, one.roughness_rad) == (steel.reflectivity, steel.specular, 0.1)
    assert one.material == "steel"
    assert replace(one, pose=sg.pose(1)).material == "steel"
    rusty = sg.Body("one", trimesh.creation.box(), reflectivity="steel", roughness_rad=0.3, specular=0.2)
    assert (rusty.reflectivity, rusty.specular, rusty.roughness_rad) == (steel.reflectivity, 0.2, 0.3)
    plain = sg.Body("one", trimesh.creation.box())
    assert (plain.reflectivity, plain.specular, plain.roughness_rad, plain.material) == (0.5, 0.0, 0.1, None)
    sand = sg.Body("one", trimesh.creation.box(), reflectivity="sand")
    assert (sand.specular, sand.roughness_rad, sand.material) == (0.0, 0.1, "medium_sand")


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"reflectivity": "steal"}, "body 'one': unknown material (got 'steal'; did you mean 'steel'"),
        ({"specular": 1.5}, "body 'one': specular must lie in 0..1 (got 1.5)"),
        ({"specular": np.nan}, "body 'one': specular must be finite"),
        ({"specular": "much"}, "body 'one': specular must be an array of numbers"),
        ({"roughness_rad": 0.0}, "body 'one': roughness_rad must lie in 0.01..0.5 (got 0)"),
        ({"roughness_rad": 5.0}, "body 'one': roughness_rad must lie in 0.01..0.5 (got 5)"),
    ],
)
def test_nonsense_is_refused(given, words):
    with pytest.raises(sg.Error, match=re.escape(words)):
        sg.Body("one", trimesh.creation.box(), **given)


def test_what_a_mirror_could_return_counts_its_lobe():
    """So that one of μ = 0 is looked for where no sample met it."""
    mirror = body("wire", meshes.cylinder(0.002, 1.0), sg.pose(8), 0.1, 0.8, 0.1)
    assert Extent([mirror]).reflectivity.tolist() == [0.0, 0.1]
    assert Extent([mirror], specular=True).reflectivity[1] == pytest.approx(0.1 + specular_lobe(1, 0.8, 0.1))


def test_a_body_that_is_replaced_takes_all_from_its_new_material():
    steel = sg.Body("ball", trimesh.creation.icosphere(2), reflectivity="steel")
    sand = replace(steel, reflectivity="medium sand")
    fresh = sg.Body("ball", steel.mesh, reflectivity="medium_sand")
    for name in ("reflectivity", "specular", "roughness_rad", "material"):
        assert getattr(sand, name) == getattr(fresh, name), name


def test_a_material_of_no_known_name_is_refused_with_the_body():
    with pytest.raises(sg.Error, match=r"body 'ball': unknown material \(got 'stel'; did you mean 'steel'"):
        sg.Body("ball", trimesh.creation.icosphere(2), material="stel")


@pytest.mark.parametrize("bodies", ["pylon", [3], None, 7])
def test_a_scene_holds_bodies_and_nothing_else(bodies):
    with pytest.raises(sg.Error, match="a body of a scene must be a"):
        sg.Scene(bodies)
