"""Pings of random scenes that differ in a known way, with all kinds of surfaces: relations whatever the echo is."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

import sonar_gl as sg
from tests.support.mixed_scenes import SONARS, difference, mixed_scene, random_body, with_mesh
from tests.support.worlds import random_rotation

FINE = {"tolerance": 0.02}
DIRECT = sg.Acoustics.physical(specular=False, pulse=False, far_side_lobes=False)
families = pytest.mark.parametrize("family", SONARS)
seeds = pytest.mark.parametrize(
    "seed", [2, *(pytest.param(k, marks=pytest.mark.slow) for k in (0, 1, *range(3, 12)))]
)
engines = pytest.mark.parametrize("engine", ["cpu", "opengl"])


@seeds
@families
def test_a_world_that_is_turned_and_far_away_has_the_same_picture(seed, family):
    """As in UTM coordinates, also of a sonar that moves; float32 rounds relative poses alike but for a few."""
    rng = np.random.default_rng([seed, 1])
    here, velocity = mixed_scene(seed, family), rng.normal(0, 0.5, 6)
    away = random_rotation(rng)
    away[:3, 3] = rng.uniform(-5e5, 5e5, 3)
    more = {"velocity": velocity, "background": ["floor"]}
    one, other = here.ping(**more), here.moved(away).ping(**more)
    assert difference(one.intensity, other.intensity) < 1e-6
    np.testing.assert_array_equal(one.body_id, other.body_id)
    np.testing.assert_array_equal(one.shadow, other.shadow)


@seeds
@families
def test_a_mirrored_world_has_a_mirrored_picture(seed, family):
    """But for samples, whose lattice is sheared to one side: within the estimates."""
    here = mixed_scene(seed, family, **FINE)
    velocity = np.random.default_rng(seed).normal(0, 0.5, 6)
    mirrored = velocity * [1, -1, 1, -1, 1, -1]  # angular velocity is an axial vector
    one, other = here.ping(velocity=velocity), here.mirrored(1).ping(velocity=mirrored)
    assert difference(one.intensity, other.intensity[::-1]) < one.error_estimate + other.error_estimate
    assert difference(one.intensity, other.intensity) > 0.2
    same = one.body_id == other.body_id[::-1]
    assert same.mean() > 0.97
    weights = (one.intensity * same)[one.body_id > 0]
    for name in ("elevation_rad", "incidence_rad"):
        change = np.abs(getattr(one, name) - getattr(other, name)[::-1])[one.body_id > 0]
        # radians: the samples of faint bins lie at other elevations
        assert np.average(np.where(weights > 0, change, 0), weights=weights) < 0.02


@seeds
@families
def test_a_world_upside_down_has_the_same_picture_at_opposite_elevations(seed, family):
    here = mixed_scene(seed, family, **FINE)
    one, other = here.ping(), here.mirrored(2).ping()
    assert difference(one.intensity, other.intensity) < one.error_estimate + other.error_estimate
    same = (one.body_id == other.body_id) & (one.body_id > 0)
    weights, change = one.intensity[same], np.abs(one.elevation_rad + other.elevation_rad)[same]
    assert np.average(change, weights=weights) < 0.01
    assert np.average(np.abs(one.elevation_rad[same]), weights=weights) > 0.02


@seeds
@families
def test_an_echo_is_the_sum_of_those_of_bodies_and_labels_name_the_strongest(seed, family):
    """The other bodies are black, but cast their shadows. By OpenGL, which does not join rows of samples.

    For labels columns of a beam are joined where its echo is even: that moves a tenth of the echo of a single bin.
    """
    scene = replace(mixed_scene(seed, family, DIRECT), engine="opengl")
    names = [body.name for body in scene.bodies]
    black = dict.fromkeys(names, 0.0)
    of_body = [{name: mu for name, mu in black.items() if name != one} for one in names]
    with scene.simulator() as simulator:
        whole = simulator.ping(scene.pose, labels=True, label_level_db=-180.0)
        parts = [simulator.ping(scene.pose, reflectivity=mu).intensity.astype(float) for mu in of_body]
    total = np.sum(parts, axis=0)
    assert difference(whole.intensity, total) < 1e-6
    np.testing.assert_allclose(whole.body_echo[1:], np.sum(parts, axis=(1, 2)), atol=1e-4 * total.sum())
    of_label = np.array([np.zeros_like(total), *parts])
    own = np.take_along_axis(of_label, whole.body_id[None].astype(int), axis=0)[0]
    is_bright = (whole.body_id > 0) & (total > 1e-4 * total.max())
    np.testing.assert_allclose(whole.share[is_bright], own[is_bright] / total[is_bright], atol=0.15)
    is_wrong = own < 0.98 * np.max(parts, axis=0)
    assert total[is_wrong].sum() < 5e-3 * total.sum()
    assert not whole.body_id[total == 0].any()
    assert len(np.unique(whole.body_id)) >= 3


@seeds
@families
def test_a_shadow_is_where_less_than_a_tenth_of_the_background_is_left(seed, family):
    """By OpenGL, which does not join rows of samples: at the border of a shadow that moves much of a bin's echo."""
    scene = replace(mixed_scene(seed, family, DIRECT), engine="opengl")
    head = scene.sonar.head_pose(scene.pose)
    screen = sg.Body("screen", trimesh.creation.box((0.2, 3, 6)), head @ sg.pose(3.0, 0.2 * (seed % 5)))
    scene = replace(scene, bodies=(*scene.bodies, screen))
    others = [body.name for body in scene.bodies if body.name != "floor"]
    with scene.simulator() as simulator:
        ping = simulator.ping(scene.pose, labels=True, background=["floor"])
        left = simulator.ping(scene.pose, reflectivity=dict.fromkeys(others, 0.0)).intensity.astype(float)
        alone = simulator.ping(scene.pose, bodies=dict.fromkeys(others)).intensity.astype(float)
    assert not ping.shadow[alone == 0].any()
    has_echo = alone > 1e-6 * alone.max()
    ratio = np.divide(left, alone, out=np.ones_like(left), where=has_echo)
    is_clear = has_echo & (
        np.abs(ratio - 0.1) > 0.02
    )  # columns of a beam are joined where their echo is even
    np.testing.assert_array_equal(ping.shadow[is_clear], ratio[is_clear] < 0.1)
    assert ping.shadow.any()


@seeds
@families
def test_lobes_and_diffuse_echo_add_up(seed, family):
    scene = mixed_scene(seed, family, sg.Acoustics.physical())
    scene = replace(scene, bodies=tuple(replace(b, specular=0.3, roughness_rad=0.2) for b in scene.bodies))
    black = dict.fromkeys((body.name for body in scene.bodies), 0.0)
    diffuse = replace(scene, acoustics=sg.Acoustics.physical(specular=False)).ping().intensity.astype(float)
    lobes = scene.ping(reflectivity=black).intensity
    assert difference(scene.ping().intensity, diffuse + lobes) < 2e-3  # joined rows
    assert lobes.sum() > 1e-3 * diffuse.sum() > 0


def shuffled(body, rng):
    """Return a body whose faces and vertices have another order."""
    faces, vertices = rng.permutation(len(body.surface.faces)), rng.permutation(len(body.surface.vertices))
    mu = body.reflectivity if np.ndim(body.reflectivity) == 0 else body.reflectivity[faces]
    normals = None if body.normals is None else body.normals[vertices]
    renamed = np.argsort(vertices)[np.asarray(body.surface.faces)[faces]]
    return [with_mesh(body, np.asarray(body.surface.vertices)[vertices], renamed, mu, normals)]


def unmerged(body, _):
    """Return a body each of whose faces has vertices of its own."""
    corners = np.asarray(body.surface.faces).ravel()
    normals = None if body.normals is None else body.normals[corners]
    faces = np.arange(len(corners)).reshape(-1, 3)
    return [with_mesh(body, np.asarray(body.surface.vertices)[corners], faces, normals=normals)]


def inside_out(body, _):
    """Return a body whose faces turn the other way."""
    faces = np.asarray(body.surface.faces)[:, ::-1]
    return [with_mesh(body, body.surface.vertices, faces, normals=body.normals)]


def in_two(body, rng):
    """Return the faces of a body on both sides of a plane as two bodies."""
    vertices, faces = np.asarray(body.surface.vertices), np.asarray(body.surface.faces)
    sides = vertices[faces].mean(axis=1) @ rng.normal(size=3)
    is_first = sides <= np.median(sides)
    parts = []
    for number, chosen in enumerate((is_first, ~is_first)):
        if chosen.any():
            mu = body.reflectivity if np.ndim(body.reflectivity) == 0 else body.reflectivity[chosen]
            name = f"{body.name} {number}"
            parts.append(with_mesh(body, vertices, faces[chosen], mu, body.normals, name))
    return parts


@seeds
@families
@pytest.mark.parametrize(
    ("change", "most"),
    # faces in another order; footprints are kept within a body, of which each part has a box of its own
    [(shuffled, 1e-5), (inside_out, 1e-5), (unmerged, 2e-3), (in_two, 5e-3)],
)
def test_how_a_mesh_describes_a_surface_does_not_matter(seed, family, change, most):
    rng, scene = np.random.default_rng([seed, 2]), mixed_scene(seed, family, sg.Acoustics.physical())
    parts = [change(body, rng) for body in scene.bodies]
    one, other = scene.ping(), scene.ping([part for of_body in parts for part in of_body])
    assert difference(one.intensity, other.intensity) < most
    owners = np.repeat(np.arange(1, len(parts) + 1), [len(of_body) for of_body in parts])
    echo = np.bincount(np.r_[0, owners], other.body_echo)
    np.testing.assert_allclose(echo, one.body_echo, atol=most * one.body_echo.sum())


@seeds
def test_a_part_of_a_fan_all_round_is_a_fan_of_its_own(seed):
    acoustics = sg.Acoustics.physical(far_side_lobes=False)
    whole = mixed_scene(seed, "all round", acoustics, **FINE)
    azimuth = whole.sonar.azimuth_rad
    first, n_beams = 5 + 2 * seed % 20, 9
    part = replace(whole.sonar, n_beams=n_beams, azimuth_fov_deg=90.0)
    turn = sg.pose(yaw=float(azimuth[first : first + n_beams].mean()))
    one, other = whole.ping(), replace(whole, sonar=part, pose=whole.pose @ turn).ping()
    rows = slice(first, first + n_beams)
    assert np.abs(one.intensity[rows] - other.intensity).sum() < 0.01 * one.intensity.sum()
    assert (one.body_id[rows] == other.body_id).mean() > 0.95
    assert other.intensity.sum() > 0.01 * one.intensity.sum()


@pytest.mark.parametrize(
    ("noise", "of_sonar", "sign"),
    [
        (sg.Noise(self_noise=True), ("self_noise_db", "common_noise_db", "ring_down_db"), 1),
        (sg.Noise(thermal_noise=True), ("source_level_db",), -1),
    ],
)
def test_noise_without_echo_rises_with_its_level(noise, of_sonar, sign):
    levels = {
        "self_noise_db": -80.0,
        "common_noise_db": -85.0,
        "ring_down_db": -20.0,
        "source_level_db": 200.0,
    }
    quiet = replace(SONARS["upright"], **levels)
    louder = replace(quiet, **{name: levels[name] + 3.0 * sign for name in of_sonar})
    far = [random_body(np.random.default_rng(0), "far", quiet)]
    far = [replace(body, pose=sg.pose(9e3)) for body in far]
    images = []
    for sonar in (quiet, louder):
        with (
            sg.Simulator(sg.Scene(far), sonar, sampling=sg.Sampling(1, 16)) as simulator,
            pytest.warns(UserWarning),
        ):
            images.append(simulator.ping(np.eye(4), noise, seed=3).intensity.astype(float))
    np.testing.assert_allclose(images[1], images[0] * 10**0.3, rtol=1e-5)
    assert images[0].any()


@seeds
@engines
def test_pings_after_any_changes_are_those_of_a_new_scene(seed, engine):
    """Bodies are placed, added, taken away and brought back, from now on and for one ping, before two sonars."""
    rng = np.random.default_rng([seed, 3])
    scene = replace(
        mixed_scene(seed, "upright", sg.Acoustics.physical(multipath="incoherent")), engine=engine
    )
    second = replace(scene, sonar=SONARS["cones"], samples={"sampling": sg.Sampling(1, 30)})
    bodies, there = list(scene.bodies), {body.name: body.pose for body in scene.bodies}

    def elsewhere(least=0.0):
        if rng.random() < least:
            return None
        return scene.pose @ random_body(rng, "other", scene.sonar).pose

    with (
        scene.simulator() as first,
        sg.Simulator(first, second.sonar, second.acoustics, second.samples["sampling"]) as other,
    ):
        for step in range(2):
            added = random_body(rng, f"added {step}", scene.sonar)
            added = replace(added, pose=scene.pose @ added.pose)
            (first, other)[step % 2].add(added)
            bodies.append(added)
            there[added.name] = added.pose
            name = bodies[rng.integers(len(bodies))].name
            there[name] = elsewhere(0.5)
            (other, first)[step % 2].place({name: there[name]})
            moved = {body.name: elsewhere(0.5) for body in bodies if rng.random() < 0.3}
            present = {n: pose for n, pose in (there | moved).items() if pose is not None}
            mu = {n: float(rng.uniform(0, 1)) for n in present if rng.random() < 0.3}
            more = {"reflectivity": mu, "noise": sg.Noise.physical(), "background": list(present)[:1]}
            for simulator, of in ((first, scene), (other, second)):
                got = simulator.ping(of.pose, labels=True, bodies=moved, **more)
                fresh = [replace(body, pose=present[body.name]) for body in bodies if body.name in present]
                wanted = of.ping(fresh, **more)
                numbers = np.array([0, *(k for k, body in enumerate(bodies, 1) if body.name in present)])
                np.testing.assert_array_equal(got.intensity, wanted.intensity)
                np.testing.assert_array_equal(got.body_id, numbers[wanted.body_id])
                np.testing.assert_array_equal(got.shadow, wanted.shadow)
                np.testing.assert_array_equal(got.body_echo[numbers], wanted.body_echo)
