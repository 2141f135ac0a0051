"""Ghosts: closed forms, brute force by mirrored rays, and which mirrors count."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from two_bounces import TwoBounces

import sonar_gl as sg
from sonar_gl import multipath
from sonar_gl.reflectors import MIN_AREA_M2, TABLE, find_mirrors, flat_parts, reflection_loss

IDEAL = sg.Acoustics.ideal()
GHOSTS = replace(IDEAL, multipath="incoherent")
SONAR = sg.Sonar("test", 900e3, 32, 200, 40.0, 40.0, 1.25, 0.5, 15.0)
FINE = sg.Sampling(8, 300)


def slab(name, pose, size=200.0, mu=0.5):
    return sg.Body(name, trimesh.creation.box((size, size, 1)), pose, mu)


def box(*pose):
    return sg.Body("box", trimesh.creation.box((0.6, 0.8, 1.0)), sg.pose(*pose), 0.8)


def ball(x, y, z, radius=0.5):
    return sg.Body("ball", trimesh.creation.icosphere(4, radius), sg.pose(x, y, z), 1.0)


@pytest.fixture
def perfect(monkeypatch):
    """A function: the bodies of these names, and the water's surface, mirror all sound, and no others do."""

    def choose(*names):
        def find(scene, wavenumber):
            mirrors = find_mirrors(scene, wavenumber)
            named = [m for m in mirrors if m.body is None or scene.bodies[m.body].name in names]
            return [replace(m, loss=np.ones(TABLE)) for m in named]

        monkeypatch.setattr(multipath, "find_mirrors", find)

    return choose


def ghosts(scene, pose, acoustics=GHOSTS, sonar=SONAR, sampling=FINE, **settings):
    """(B, K) of ghosts alone."""
    out = []
    for one in (acoustics, replace(acoustics, multipath="none")):
        with sg.Simulator(scene, sonar, one, sampling) as simulator:
            out.append(simulator.ping(pose, **settings).intensity.astype(np.float64))
    return out[0] - out[1]


# heights of sonar and target, distance; r_d, (r_d + r_b) / 2, r_b
CASES = (
    (2.0, 0.5, 10.0, 10.1119, 10.2098, 10.3078),
    (2.0, 2.0, 10.0, 10.0000, 10.3852, 10.7703),
    (5.0, 4.5, 8.0, 8.0156, 10.2177, 12.4197),
)


@pytest.mark.parametrize(("h_sonar", "h_target", "x", "direct", "single", "double"), CASES)
def test_a_small_target_has_ghosts_at_the_ranges_and_levels_of_its_image(
    perfect, h_sonar, h_target, x, direct, single, double
):
    perfect("floor")
    radius, sonar = 0.02, sg.Sonar("test", 900e3, 8, 1300, 4.0, 110.0, 0.5, 0.5, 13.5)
    floor = slab("floor", sg.pose(0, 0, -0.5), mu=1e-6)
    scene = sg.Scene([floor, ball(x, 0, h_target, radius)])
    pose, sampling = sg.pose(0, 0, h_sonar), sg.Sampling(40, 12000)
    with sg.Simulator(scene, sonar, IDEAL, sampling) as simulator:
        straight = simulator.ping(pose).intensity.sum(axis=0, dtype=np.float64)
    profile = ghosts(scene, pose, sonar=sonar, sampling=sampling).sum(axis=0)

    def around(values, range_m):
        near = np.abs(sonar.range_m - range_m) < radius + 0.01
        return values[near].sum(), (values * sonar.range_m)[near].sum() / values[near].sum()

    level, where = around(straight, direct)
    off = where - direct  # a sphere's echo comes from before its middle
    assert -radius < off < 0
    once, where_once = around(profile, single)
    twice, where_twice = around(profile, double)
    # what both ways see of the sphere lies aside of what either sees: a cosine of half the angle between them
    assert where_once == pytest.approx(single + off, abs=radius / 2)
    assert where_twice == pytest.approx(double + off, abs=0.003)
    # with G = 1 the levels of points fall as r^-2, and what is summed here is (r_app / ...)² of that
    between = np.arctan2(h_sonar + h_target, x) + np.arctan2(h_sonar - h_target, x)
    lit = (np.sin(between) + (np.pi - between) * np.cos(between)) / np.pi  # of a Lambert sphere, both ways
    assert once / level == pytest.approx(2 * lit * (single / double) ** 2, rel=0.03)
    assert twice / level == pytest.approx((direct / double) ** 2, rel=0.03)
    coherent = ghosts(scene, pose, replace(GHOSTS, multipath="coherent"), sonar, sampling).sum(axis=0)
    assert around(coherent, single)[0] == pytest.approx(2 * once, rel=1e-4)
    assert around(coherent, double)[0] == pytest.approx(twice, rel=1e-4)


SCENES = {
    "floor, rolled and pitched": (
        sg.Scene([slab("floor", sg.pose(0, 0, -0.5)), box(6, -1, 0.5, 0, 0, 0.4)]),
        sg.pose(0, 0, 1.5, 0.2, 0.15, 0.1),
        ("floor",),
    ),
    "wall beside": (
        sg.Scene([slab("wall", sg.pose(0, 1.5, 0, np.pi / 2)), box(6, 0, 0, 0, 0, 0.5), ball(8, -2, 0.3)]),
        sg.pose(),
        ("wall",),
    ),
    "wall that ends": (
        sg.Scene([slab("wall", sg.pose(0, 1.5, 0, np.pi / 2), 8.5), box(6, 0, 0, 0, 0, 0.5)]),
        sg.pose(),
        ("wall",),
    ),
    "water's surface": (
        sg.Scene([slab("floor", sg.pose(0, 0, -3.5)), box(6, 0, -1, 0, 0, 0.5)], surface_z_m=0.0),
        sg.pose(0, 0, -1),
        (),
    ),
    "one behind the other": (
        sg.Scene([slab("floor", sg.pose(0, 0, -0.5)), box(4, 0, 0, 0, 0, 0.4), ball(8, 0.3, 1.0)]),
        sg.pose(0, 0, 2),
        ("floor",),
    ),
    "tank": (
        sg.Scene(
            [
                slab("floor", sg.pose(0, 0, -2.5)),
                slab("wall", sg.pose(0, 2.5, 0, np.pi / 2)),
                slab("end", sg.pose(9, 0, 0, 0, np.pi / 2)),
                box(6, 0, -1, 0, 0, 0.5),
            ],
            surface_z_m=0.5,
        ),
        sg.pose(0, 0, -1, 0.0, 0.05, 0.2),
        ("floor", "wall", "end"),
    ),
}


@pytest.mark.parametrize("name", SCENES)
def test_ghosts_are_those_of_rays_that_are_mirrored(perfect, name):
    scene, pose, mirrors = SCENES[name]
    perfect(*mirrors)
    straight = sg.reference_ping(scene, SONAR, pose, IDEAL, error=0.02).intensity
    truth = straight + sum(
        TwoBounces(scene, SONAR, pose, mirrors).ping(1_000_000, seed) / 2 for seed in (1, 2)
    )
    with sg.Simulator(scene, SONAR, GHOSTS, tolerance=0.01) as simulator:
        found = simulator.ping(pose).intensity
    # twice the tolerance: it is chosen for straight echoes, and edges of mirrors and of shadows in them are
    # found to half a sample; the worst here is 1.6 of it
    assert np.abs(found - truth).sum() < 0.02 * truth.sum()
    # straight echoes alone, the way of all who leave multipath out, miss many times that
    assert np.abs(straight - truth).sum() > 0.1 * truth.sum()


def test_ghosts_are_heard_as_the_pattern_hears_both_ways(perfect):
    scene, pose, mirrors = SCENES["floor, rolled and pitched"]
    perfect(*mirrors)
    gaussian = replace(GHOSTS, elevation_pattern="gaussian")
    sonar = replace(SONAR, elevation_fov_deg=25.0)
    drawn, heard = gaussian.drawn_sonar(sonar), gaussian.elevation_function(sonar)
    top = np.sin(np.radians(drawn.elevation_fov_deg) / 2)
    sines, parts = np.polynomial.legendre.leggauss(64)
    narrower = top * (heard(top * sines) @ parts) / (2 * top)  # than all of what is drawn
    a, b = (TwoBounces(scene, drawn, pose, mirrors, heard=heard).ping(1_000_000, seed) for seed in (1, 2))
    truth = (a + b) / 2 / narrower
    allowed = np.abs(a - b).sum() / (a + b).sum() + 0.03  # as above
    assert np.abs(ghosts(scene, pose, gaussian, sonar) - truth).sum() / truth.sum() < allowed


def test_nothing_is_seen_above_the_water(perfect):
    perfect()
    pile = sg.Body("pile", trimesh.creation.cylinder(0.3, 6.0), sg.pose(6, 0, 0), 0.8)
    cut = sg.Body("pile", trimesh.creation.cylinder(0.3, 3.0), sg.pose(6, 0, -1.5), 0.8)
    pose = sg.pose(0, 0, -1, 0, -0.1)
    for make in (
        lambda scene: sg.reference_ping(scene, SONAR, pose, IDEAL, error=0.02),
        lambda scene: sg.Simulator(scene, SONAR, IDEAL, FINE).ping(pose),
    ):
        crossing = make(sg.Scene([pile], surface_z_m=0.0)).intensity
        above = make(sg.Scene([pile])).intensity
        below = make(sg.Scene([cut])).intensity
        assert np.abs(crossing - below).sum() < 0.01 * below.sum()  # of samples at the edge
        assert above.sum() > 1.2 * below.sum()


def test_what_stands_before_the_mirror_takes_its_ghosts_away(perfect):
    perfect("floor")
    screen = sg.Body("screen", trimesh.creation.box((0.05, 4, 0.9)), sg.pose(5.0, 0, 0.45), 0.0)
    bare = sg.Scene([slab("floor", sg.pose(0, 0, -0.5), mu=1e-6), box(8, 0, 1.5)])
    hidden = sg.Scene([*bare.bodies, screen])
    pose = sg.pose(0, 0, 1.5)  # of the box it hides nothing, of the floor where the box is mirrored all
    assert ghosts(bare, pose).sum() > 0.01
    # to half a sample at the screen's edges
    assert ghosts(hidden, pose).sum() < 0.01 * ghosts(bare, pose).sum()


def test_sequences_and_reruns_give_the_same_bytes(perfect):
    perfect("floor", "wall", "end")
    scene, pose, _ = SCENES["tank"]
    poses = [pose @ sg.pose(0.05 * k, yaw=0.01 * k) for k in range(6)]
    with sg.Simulator(scene, SONAR, GHOSTS, sg.Sampling(2, 80)) as simulator:
        one_by_one = [simulator.ping(p, labels=True).intensity for p in poses]
        for ping, single in zip(simulator.pings(poses, labels=True), one_by_one, strict=True):
            np.testing.assert_array_equal(ping.intensity, single)


def test_a_fan_from_a_table_is_mirrored_with_its_table(perfect):
    perfect("wall")
    scene, pose, _ = SCENES["wall beside"]
    # from starboard −10 to port 20: not the mirror image of itself
    table = tuple(np.arange(-9.375, 20.0, 1.25).tolist())
    lopsided = replace(SONAR, n_beams=len(table), beam_azimuths_deg=table)
    cut = ghosts(scene, pose, sonar=lopsided, sampling=sg.Sampling(11, 300))
    whole = ghosts(scene, pose)[-len(table) :]
    # the whole fan also hears what is sounded to starboard of the table's
    assert np.abs(cut - whole).sum() < 0.03 * whole.sum()


def test_mirrors_that_return_too_little_are_not_drawn(perfect):
    scene, pose, _ = SCENES["floor, rolled and pitched"]
    perfect("floor")
    for loss, drawn in ((1.0, 1), (1e-2, 1), (1e-4, 0)):
        with sg.Simulator(scene, SONAR, GHOSTS, tolerance=0.01) as simulator:
            simulator.ping(pose)
            found = simulator._multipath
            found.mirrors = [replace(mirror, loss=mirror.loss * loss) for mirror in found.mirrors]
            with simulator._drawing():
                simulator._samples.now.views(pose)
                (left,) = found.draw(simulator._samples.now, [pose], [None])
            assert (0 if left is None else len(left.mirrored)) == drawn, loss


def test_a_tank_has_the_mirrors_that_a_diver_would_name():
    tank, _, _ = SCENES["tank"]
    mirrors = find_mirrors(tank, 3770.0)
    assert mirrors[0].body is None
    up, z = mirrors[0].in_world(np.array([body.pose for body in tank.bodies]))
    assert up.tolist() == [0, 0, 1] and z == 0.5
    # the broad faces of slabs; of the box the ends, 0.48 m², are too small
    sizes = [len(flat_parts(body.surface)) for body in tank.bodies]
    assert sizes == [2, 2, 2, 4]
    normals = [normal @ [0, 0, 1] for normal, _ in flat_parts(tank.bodies[0].surface)[:2]]
    assert sorted(normals) == [-1, 1]


def test_curved_bodies_and_terrain_are_no_mirrors():
    assert flat_parts(ball(0, 0, 0, 5.0).surface) == []
    rough = trimesh.creation.box((10, 10, 1)).subdivide().subdivide().subdivide()
    assert rough.area_faces.max() > MIN_AREA_M2
    rough.vertices += 0.01 * np.random.default_rng(1).standard_normal(rough.vertices.shape)
    assert flat_parts(rough) == []


def test_roughness_takes_the_mirror_out_of_a_plane():
    k = 2 * np.pi * 900e3 / 1500
    at_10_deg = lambda loss: np.interp(np.sin(np.radians(10)), np.linspace(0, 1, TABLE), loss)  # noqa: E731
    for height, db in ((1e-4, -0.07), (5e-4, -1.86), (1e-3, -7.44)):
        assert 10 * np.log10(at_10_deg(reflection_loss(1.0, height, k))) == pytest.approx(db, abs=0.01)


@pytest.mark.parametrize(
    ("field", "value"), [("surface_z_m", float("nan")), ("surface_z_m", "top"), ("surface_roughness_m", -1)]
)
def test_a_surface_that_makes_no_sense_is_refused(field, value):
    with pytest.raises(sg.Error, match=field):
        sg.Scene([], **{field: value})


def test_a_multipath_of_no_known_kind_is_refused():
    with pytest.raises(sg.Error, match="multipath"):
        sg.Acoustics.physical(multipath="strong")


def test_pings_say_how_ghosts_were_made(perfect):
    perfect("floor")
    scene, pose, _ = SCENES["floor, rolled and pitched"]
    with sg.Simulator(scene, SONAR, GHOSTS, sg.Sampling(1, 40)) as simulator:
        assert simulator.ping(pose).meta["acoustics"]["multipath"] == "incoherent"
    with sg.Simulator(scene, SONAR, IDEAL, sg.Sampling(1, 40)) as simulator:
        assert simulator.ping(pose).meta["acoustics"]["multipath"] == "none"


@pytest.mark.parametrize("depth_m", [2.0, 10.0, 40.0, 2000.0])
def test_deep_water_hides_nothing_below_its_surface(depth_m):
    walls = [sg.Body("wall", trimesh.creation.box((0.2, 2, 2)), sg.pose(x, 0, -depth_m)) for x in (0.9, 3, 8)]
    for wall in walls:
        bare, below = sg.Scene([wall]), sg.Scene([wall], surface_z_m=0.0)
        pings = []
        for scene in (bare, below):
            with sg.Simulator(scene, SONAR, IDEAL, sg.Sampling(2, 60)) as simulator:
                pings.append(simulator.ping(sg.pose(0, 0, -depth_m)).intensity)
        # bodies that touch the surface's plane are drawn by the driver as a whole, others partly filled in
        np.testing.assert_allclose(*pings, rtol=1e-4, atol=1e-6)
        assert pings[0].any()


def test_a_convex_body_makes_no_ghosts_of_itself(perfect):
    perfect("box")
    lone = sg.Body("box", trimesh.creation.box((2, 3, 4)), sg.pose(6, 0, 0, 0, 0, 0.7), 0.8)
    scene = sg.Scene([lone])
    with sg.Simulator(scene, SONAR, IDEAL, FINE) as simulator:
        straight = simulator.ping(sg.pose()).intensity.sum()
    # where two faces meet, a sample's plane goes on for half a sample past the edge; it was 71 % of the echo
    assert ghosts(scene, sg.pose()).sum() < 0.01 * straight


def test_what_lies_in_a_pit_has_no_ghosts_by_the_floor_around_it(perfect):
    perfect("floor")
    rings = [((-50, 4), (-50, 50)), ((6, 50), (-50, 50)), ((4, 6), (-50, -1)), ((4, 6), (1, 50))]
    corners = [[(x0, y0, 0), (x1, y0, 0), (x1, y1, 0), (x0, y1, 0)] for (x0, x1), (y0, y1) in rings]
    faces = [(k, k + 1, k + 2) for k in range(0, 16, 4)] + [(k, k + 2, k + 3) for k in range(0, 16, 4)]
    floor = sg.Body("floor", trimesh.Trimesh(np.concatenate(corners), faces, process=False), None, 0.3)
    # its far wall: the sonar's image would see it, from below the floor
    wall = sg.Body("wall", trimesh.creation.box((0.1, 1.6, 0.5)), sg.pose(5.5, 0, -0.45), 1.0)
    scene, pose = sg.Scene([floor, wall]), sg.pose(0, 0, 1.5, 0, 0.25)
    assert TwoBounces(scene, SONAR, pose, ("floor",)).ping(200_000).sum() == 0
    assert not ghosts(scene, pose).any()


def test_ghosts_know_no_lobes_however_strong_they_are(perfect):
    perfect("floor")
    shiny = replace(ball(7, 0, 1.0), reflectivity=0.2, specular=0.7)
    out = []
    for specular in (True, False):
        scene = sg.Scene([slab("floor", sg.pose(0, 0, -0.5), mu=1e-3), shiny])
        out.append(
            ghosts(
                scene, sg.pose(0, 0, 1.0), replace(GHOSTS, specular=specular), sampling=sg.Sampling(4, 150)
            )
        )
    np.testing.assert_allclose(*out, rtol=1e-5, atol=1e-7)
    assert out[0].sum() > 0


def test_with_given_samples_no_ping_depends_on_those_before(perfect):
    perfect("floor")
    scene, strong, _ = SCENES["floor, rolled and pitched"]
    weak = sg.pose(0, 0, 2.5, 0.2, 0.5, 0.1)
    with sg.Simulator(scene, SONAR, GHOSTS, sg.Sampling(2, 80)) as simulator:
        first, *_, again = (simulator.ping(pose).intensity for pose in (weak, strong, weak))
        np.testing.assert_array_equal(first, again)
        poses = [weak, strong, weak, strong, strong, weak]
        one_by_one = [simulator.ping(pose).intensity for pose in poses]
        for ping, alone in zip(simulator.pings(poses), one_by_one, strict=True):
            np.testing.assert_array_equal(ping.intensity, alone)


def test_what_a_mirror_leaves_goes_by_the_angle(perfect, monkeypatch):
    slope = np.linspace(0.0, 1.0, TABLE)  # the sine of the grazing angle itself
    floor, pose = slab("floor", sg.pose(0, 0, -0.5), mu=1e-6), sg.pose(0, 0, 2.0)
    scene, sonar = sg.Scene([floor, ball(10, 0, 2.0, 0.05)]), replace(SONAR, elevation_fov_deg=60.0)
    out = []
    for loss in (np.ones(TABLE), slope):
        monkeypatch.setattr(
            multipath,
            "find_mirrors",
            lambda s, k, loss=loss: [replace(m, loss=loss) for m in find_mirrors(s, k) if m.body == 0],
        )
        out.append(ghosts(scene, pose, sonar=sonar, sampling=sg.Sampling(8, 1500)).sum(axis=0))
    sine = 4.0 / np.hypot(10.0, 4.0)
    once, twice = (np.abs(sonar.range_m - r) < 0.15 for r in (10.385, 10.770))
    assert out[1][once].sum() / out[0][once].sum() == pytest.approx(sine, rel=0.01)
    assert out[1][twice].sum() / out[0][twice].sum() == pytest.approx(sine**2, rel=0.01)
