"""Patches that a sector draws: all visible ones, as coarse as the error allows, and few others."""

import json
import os
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import trimesh

import sonar_gl as sg
from sonar_gl.raster import level_of_detail as detail
from sonar_gl.raster import scene_meshes
from sonar_gl.raster import views as raster_views
from sonar_gl.raster.cull import BEYOND, CORNER
from sonar_gl.raster.opengl import buffers
from sonar_gl.raster.views import SectorView, stacked
from sonar_gl.scene.state import SceneState
from sonar_gl.sonar.fan import FAR_FACTOR, NEAR_M
from tests.support.worlds import random_rotation, terrain

SONAR = sg.Sonar("test", 900e3, 64, 200, 100.0, 20.0, 1.5, 0.5, 30.0)
SAMPLING = sg.Sampling(1, 60)
FAR_M = FAR_FACTOR * SONAR.range_max_m


@pytest.fixture(autouse=True, scope="module")
def small_patches():
    """Lower the limits to leaves of 64 faces and levels above 2000 faces, so that small meshes have many of both."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(detail, "LEAF_FACES", 64)
        patch.setattr(detail, "MIN_FACES_TO_SIMPLIFY", 2000)
        yield


@pytest.fixture(scope="module")
def hills():
    """Return sharp hills of 12 000 faces, 60 m wide."""
    return terrain(np.random.default_rng(0), 60.0, 6.0, 80)


@pytest.fixture(scope="module")
def views():
    with sg.Simulator(sg.Scene([]), SONAR, sg.Acoustics.ideal(), SAMPLING) as it:
        return [SectorView(sector, FAR_M, SONAR.range_max_m) for sector in it.fan.sectors]


def meshes_of(bodies):
    """Return the meshes of bodies, divided into patches."""
    some = scene_meshes.SceneMeshes()
    some.add(bodies)
    return some


def choose(some, pose, view):
    """Return the list of (patch, body) that a sector draws of some meshes, and the placed bodies."""
    placed = some.view_from(pose)
    room = np.empty((1, some.most_patches, 2), np.int32)
    ((n, n_faces, *_),) = some.choose(stacked([view]), placed, room)
    assert n_faces == some.levels["n_faces"][room[0, :n, 0]].sum()
    return [tuple(row) for row in room[0, :n].tolist()], placed


def corners_in(view, some, placed, patch, body):
    """Return the corners of a patch's faces in the sector's frame, (n, 3, 3)."""
    levels = some.levels
    first, n = levels["first_face"][patch], levels["n_faces"][patch]
    used = levels["first_vertex"][patch] + levels["faces"][first : first + n].astype(int)
    m = placed.matrices[body]
    # without software rasterization the meshes leave their vertices to the driver; `keep_points` keeps a copy
    points = some.all_points[used]
    return (points @ m[:, :3].T + m[:, 3]) @ view.geometry.rotation.T


@pytest.fixture
def keep_points(monkeypatch):
    """Have SceneMeshes keep the vertices that go to the driver."""
    add = scene_meshes.SceneMeshes.add

    def adding(self, bodies):
        made = add(self, bodies)
        self.all_points = np.concatenate([one.points for one in made]).astype(float)
        return made

    monkeypatch.setattr(scene_meshes.SceneMeshes, "add", adding)


def any_inside(corners, view):
    """Return whether vertices, or random points of the faces, lie in the view of a sector and in range."""
    weights = np.random.default_rng(0).dirichlet([1, 1, 1], 12)
    weights = np.concatenate([weights, np.eye(3)])
    x, y, z = np.einsum("sk,fkc->cfs", weights, corners)
    ahead = x > scene_meshes.NEAR_M
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v = -y / x, z / x
    low_u, high_u, low_v, high_v = view.geometry.limits
    inside = ahead & (u > low_u) & (u < high_u) & (v > low_v) & (v < high_v)
    return (inside & (np.sqrt(x * x + y * y + z * z) < FAR_M)).any()


def poses(n):
    """Yield poses around the origin; all but one look roughly at it, with roll."""
    rng = np.random.default_rng(4)
    for _ in range(n):
        x, y = rng.uniform(-22, 22, 2)
        yaw = np.arctan2(-y, -x) + rng.uniform(-0.8, 0.8)
        yield sg.pose(x, y, rng.uniform(1, 8), rng.uniform(-3, 3), rng.uniform(-0.2, 0.4), yaw)
    yield sg.pose(20, 0, 4)


def test_visible_leaves_are_drawn_and_others_culled(views, keep_points, monkeypatch, hills):
    """Each leaf is checked against points of its faces."""
    monkeypatch.setattr(detail, "MIN_FACES_TO_SIMPLIFY", 10**9)
    ground = terrain(np.random.default_rng(1), 60.0, 6.0, 48)
    ball = trimesh.creation.icosphere(4, 5.0)
    bodies = [sg.Body("ground", ground, sg.pose(z=-2)), sg.Body("ball", ball, sg.pose(3, 2))]
    some = meshes_of(bodies)
    left_out = wasted = drawn = 0
    for pose in poses(5):
        for view in views:
            chosen, placed = choose(some, pose, view)
            assert len(set(chosen)) == len(chosen)
            for body, (first, end) in enumerate(some.boxes.roots):
                for patch in range(first, end):
                    if not some.levels["leaf"][patch]:
                        continue
                    corners = corners_in(view, some, placed, patch, body)
                    in_view = any_inside(corners, view)
                    if (patch, body) in chosen:
                        drawn += 1
                        wasted += not in_view
                        # its box reaches into the view: none lies beyond one side of the view
                        x, y, z = corners.reshape(-1, 3).T
                        low_u, high_u, low_v, high_v = view.geometry.limits
                        side = np.linalg.norm(2 * some.levels["box"][patch, 3:])
                        outside = (x, high_u * x + y, -y - low_u * x, high_v * x - z, z - low_v * x)
                        assert all(away.max() > -2 * side for away in outside)
                    elif in_view:
                        # culled although in view: back faces of a closed body seen from outside
                        assert some.boxes.closed[body]
                        assert placed.outside
                        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
                        assert ((normals * corners[:, 0]).sum(axis=1) >= -1e-9).all()
                        left_out += 1
    assert left_out > 50
    assert drawn > 200
    assert wasted < 0.3 * drawn  # boxes are larger than the faces in them


def test_back_faces_of_open_bodies_and_from_inside_are_drawn(views, keep_points):
    ball = trimesh.creation.icosphere(4, 4.0)
    bowl = trimesh.Trimesh(ball.vertices, ball.faces[:-1], process=False)
    n = {}
    for name, mesh, x in (("closed", ball, 8), ("open", bowl, 8), ("inside", ball, 1)):
        some = meshes_of([sg.Body("ball", mesh, sg.pose(x))])
        chosen, _ = choose(some, np.eye(4), views[len(views) // 2])
        n[name] = int(some.levels["n_faces"][[patch for patch, _ in chosen]].sum())
    assert n["closed"] < 0.75 * n["open"]
    assert n["inside"] > 0


def before_face(rng, mesh, pose, distance_m):
    """Return a sonar's pose, turned at random, so far before the middle of a random face, in units of the mesh."""
    face = rng.integers(len(mesh.faces))
    out = random_rotation(rng)
    place = mesh.triangles_center[face] + distance_m * mesh.face_normals[face]
    out[:3, 3] = pose[:3, :3] @ place + pose[:3, 3]
    return out


@pytest.mark.parametrize("scale", [0.05, 1.0, 3.0])
def test_back_faces_are_culled_unless_the_near_plane_may_cut_a_closed_body(scale):
    """In distances of the near plane: half of one behind a face, one and a half before it, and twenty before it.

    From twenty on no fan's near plane reaches the face, not even that of 170 degrees with its corners.
    """
    rng = np.random.default_rng(7)
    box = trimesh.creation.box((1.0, 2.0, 4.0))
    box.apply_translation((3.0, -1.0, 0.5))  # the mesh is not about its own origin
    lid = trimesh.Trimesh(box.vertices, box.faces[:-1], process=False)
    for _ in range(50):
        pose = random_rotation(rng)
        pose[:3, 3] = rng.uniform(-20, 20, 3)
        state = SceneState((pose @ np.diag([scale, scale, scale, 1.0]))[None], np.ones(1, bool))
        for mesh, distances in ((box, {-0.5: False, 1.5: False, 20.0: True}), (lid, {-0.5: True})):
            some = scene_meshes.SceneMeshes()
            some.add([sg.Body("body", mesh, pose)])
            for distance, is_outside in distances.items():
                sonar = before_face(rng, mesh, state.poses[0], distance * scene_meshes.NEAR_M / scale)
                assert some.view_from(sonar, state).outside == is_outside, distance


@pytest.mark.parametrize("engine", ["cpu", "opengl"])
@pytest.mark.parametrize("distance, is_oblique", [(0.5, False), (0.5, True), (1.1, True)])
def test_a_sonar_that_touches_a_closed_body_sees_its_far_side(monkeypatch, engine, distance, is_oblique):
    """It does not look through the body where the near plane cuts the face that it touches.

    Rays hit that face, or else the one opposite. A wall at right angles to the corner of the fan is cut there, although
    it is further away than the near plane.
    """
    monkeypatch.setenv("SONAR_GL_ENGINE", engine)
    sonar = sg.Sonar("test", 900e3, 60, 200, 60.0, 40.0, 1.0, 0.5, 20.0)
    near_m, thickness_m = distance * scene_meshes.NEAR_M, 0.2
    # the corner: 30 degrees to port, 20 degrees up
    corner = np.array([np.cos(np.pi / 6), np.sin(np.pi / 6), np.tan(np.pi / 9)]) if is_oblique else [1, 0, 0]
    normal = corner / np.linalg.norm(corner)
    pose = trimesh.geometry.align_vectors([1, 0, 0], normal)
    pose[:3, 3] = (near_m + thickness_m / 2) * normal
    slab = sg.Body("slab", trimesh.creation.box((thickness_m, 4, 4)), pose)
    wall = sg.Body("wall", trimesh.creation.box((1, 60, 60)), sg.pose(5))
    scene = sg.Scene([slab, wall])
    with sg.Simulator(scene, sonar, sg.Acoustics.ideal(), sg.Sampling(2, 60)) as it:
        (buffer,), (sector,) = it.gbuffers(np.eye(4)), it.fan.sectors
    assert (buffer.body_id == 1).all()
    u, v = sector.sample_coordinates()
    rays = np.stack([np.ones_like(u), -u, v], axis=-1)
    along = rays @ normal  # how far a ray comes along the normal while x rises by 1
    depth = near_m / along / scene_meshes.NEAR_M  # x where it meets the face, in distances of the near plane
    is_clear = np.abs(depth - 1) > 1e-3  # at the edge of the cut, rounding decides
    exact = np.where(depth < 1, near_m + thickness_m, near_m) / along * np.linalg.norm(rays, axis=-1)
    assert ((depth < 1) & is_clear).sum() > 100
    # float32 keeps corners 3 m away to 1e-7 m, some 1e-4 of the face's distance
    np.testing.assert_allclose(buffer.range_m[is_clear], exact[is_clear], rtol=1e-3)


@pytest.mark.parametrize("engine", ["cpu", "opengl"])
def test_a_high_fan_does_not_look_through_a_slab_above_it(monkeypatch, engine):
    """The near plane of a fan of 160 degrees reaches 5.7 times as high as it is far, here into the slab."""
    monkeypatch.setenv("SONAR_GL_ENGINE", engine)
    sonar = sg.Sonar("test", 900e3, 20, 200, 20.0, 160.0, 1.0, 0.5, 20.0)
    slab = sg.Body("slab", trimesh.creation.box((4, 4, 0.2)), sg.pose(z=0.1 + 4 * scene_meshes.NEAR_M))
    with sg.Simulator(sg.Scene([slab]), sonar, sg.Acoustics.ideal(), sg.Sampling(2, 200)) as it:
        (buffer,), (sector,) = it.gbuffers(np.eye(4)), it.fan.sectors
    _, v = sector.sample_coordinates()
    assert (buffer.body_id[v > np.tan(np.radians(10))] == 1).all()  # the slab's far edge is 6 degrees up


def test_bodies_behind_or_beyond_the_fan_draw_nothing(views, hills):
    some = meshes_of([sg.Body("hills", hills)])
    for pose in (sg.pose(-2000), sg.pose(200), sg.pose(z=200), sg.pose(z=-200)):
        for view in views:
            chosen, _ = choose(some, pose, view)
            assert chosen == []


def test_levels_cover_a_body_once_and_coarsen_with_distance(views, monkeypatch):
    """No patch is drawn with one of its descendants; from further away a smaller share of the faces is drawn."""
    ground = terrain(np.random.default_rng(0), 60.0, 1.0, 80)
    some, faces = meshes_of([sg.Body("ground", ground)]), {}
    for error_samples in (raster_views.ERROR_SAMPLES, 0.0):
        monkeypatch.setattr(raster_views, "ERROR_SAMPLES", error_samples)
        view = SectorView(views[0].sector, FAR_M, SONAR.range_max_m)
        faces[error_samples] = []
        for x in (20, 50, 80, 110):
            chosen, _ = choose(some, sg.pose(-x, 0, 5, pitch=0.05, yaw=0.5), view)
            patches = sorted(patch for patch, _ in chosen)
            for one, following in pairwise(patches):
                assert some.levels["skip"][one] <= following
            faces[error_samples].append(int(some.levels["n_faces"][patches].sum()))
    levels, all_faces = (np.array(n) for n in faces.values())
    assert all_faces.min() > 500
    share = levels / all_faces
    assert (np.diff(share) < 0).all()
    assert share[-1] < 0.25  # all of it beyond the last bin


def test_the_error_of_drawn_patches_is_within_the_limit(views, hills):
    """The error is at most a fraction of a sample's width at the patch; beyond the last bin, BEYOND times more."""
    some, coarse = meshes_of([sg.Body("hills", hills)]), 0
    for x in (20, 35, 50):
        for view in views:
            pose = sg.pose(-x, 0, 5, pitch=0.05)
            chosen, _ = choose(some, pose, view)
            eye = pose[:3, 3] - some.boxes.centres[0]
            for patch, _ in chosen:
                error_m, box = some.levels["error_m"][patch], some.levels["box"][patch]
                nearest = np.linalg.norm(np.maximum(np.abs(box[:3] - eye) - box[3:], 0))
                allowed = raster_views.ERROR_SAMPLES * view.sample_rad * nearest
                if nearest - error_m > SONAR.range_max_m:
                    allowed *= BEYOND
                assert error_m <= allowed
                coarse += error_m > 0
    assert coarse > 10


@pytest.mark.parametrize(
    ("mesh", "inner", "outer"),
    [
        (trimesh.creation.box((2, 2, 4)), 1.0, 6**0.5),
        (trimesh.creation.icosphere(5, 1.5), pytest.approx(1.5, rel=3e-4), pytest.approx(1.5, rel=1e-12)),
        (trimesh.creation.torus(2, 0.5), 0.0, pytest.approx(2.5, rel=1e-3)),  # its middle lies outside of it
    ],
)
def test_radii_of_spheres_in_and_about_a_mesh(mesh, inner, outer):
    faces = np.r_[mesh.faces, [[0, 0, 1]]]  # one without area has no plane
    assert detail.radii_about(np.asarray(mesh.vertices), faces).tolist() == [inner, outer]


@pytest.mark.parametrize("scale", [1.0, 2.5])
@pytest.mark.parametrize(
    "mesh",
    [
        trimesh.creation.box((2, 2, 4)),
        trimesh.creation.icosphere(3, 1.5),
        trimesh.creation.cylinder(0.5, 3.0),
        trimesh.creation.capsule(1.0, 0.8),
    ],
)
def test_all_that_is_visible_of_a_body_is_nearer_than_its_span(mesh, scale):
    """Of convex bodies the corners of faces that look towards the sonar; the outline ends a ball."""
    rng, some = np.random.default_rng(5), meshes_of([sg.Body("body", mesh)])
    is_ball = len(mesh.faces) == 1280
    for _ in range(20):
        body = np.eye(4)
        body[:3, :3], body[:3, 3] = (
            scale * random_rotation(rng)[:3, :3],
            scale * rng.uniform(4, 20) * np.eye(3)[0],
        )
        spans = some.view_from(np.eye(4), SceneState(body[None], np.ones(1, bool))).spans
        corners = trimesh.transform_points(mesh.vertices, body)[mesh.faces]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        looks_here = np.einsum("fi,fi->f", normals, corners[:, 0]) < 0
        furthest_m = np.linalg.norm(corners[looks_here], axis=2).max()
        assert furthest_m <= 1 / spans[1, 0] * (1 + 1e-12)
        assert 1 / spans[1, 0] <= np.linalg.norm(corners, axis=2).max() * (1 + 1e-12)
        if is_ball:
            assert 1 / spans[1, 0] < furthest_m + 0.2 * scale  # about the length of an edge


def test_what_is_behind_a_body_that_is_cut_open_counts():
    """From an image of the sonar behind a mirror, which cuts the ball, its far side is seen."""
    some, pose = meshes_of([sg.Body("ball", trimesh.creation.icosphere(3, 1.5), sg.pose(6))]), np.eye(4)
    planes = None, np.array([1.0, 0, 0, -6])
    outline_m, furthest_m = (1 / some.view_from(pose, plane=plane).spans[1, 0] for plane in planes)
    assert outline_m < 6.0 < 7.4 < furthest_m <= 7.5


def pings(bodies, poses, **kw):
    with sg.Simulator(sg.Scene(bodies), SONAR, sg.Acoustics.ideal(), SAMPLING, **kw) as it:
        return [it.ping(pose, labels=True) for pose in poses]


def test_levels_change_a_ping_by_less_than_its_sampling_error(monkeypatch):
    """105 000 faces of gentle hills, with and without levels, against nine times as many samples without levels."""
    monkeypatch.setattr(detail, "LEAF_FACES", 512)
    monkeypatch.setattr(detail, "MIN_FACES_TO_SIMPLIFY", 100_000)
    ground = terrain(np.random.default_rng(2), 60.0, 0.6, 230)
    ball = sg.Body("ball", trimesh.creation.icosphere(3), sg.pose(9))
    scene, ideal = sg.Scene([sg.Body("ground", ground, sg.pose(z=-5)), ball]), sg.Acoustics.ideal()
    places = [sg.pose(0, y, 0, 0, 0.15, yaw) for y, yaw in ((0, 0), (5, 1), (-20, 2.5))]
    with (
        sg.Simulator(scene, SONAR, ideal, sg.Sampling(2, 120)) as it,
        sg.Simulator(it, SONAR, ideal, sg.Sampling(6, 360)) as fine,
    ):
        levels = [it.ping(pose, labels=True) for pose in places]
        monkeypatch.setattr(raster_views, "ERROR_SAMPLES", 0.0)
        with sg.Simulator(it, SONAR, ideal, sg.Sampling(2, 120)) as without_levels:
            full = [without_levels.ping(pose, labels=True) for pose in places]
        truth = [fine.ping(pose).intensity for pose in places]
    for one, other, true in zip(levels, full, truth, strict=True):
        change, error, samples = (
            np.abs(a - b).sum() / true.sum()
            for a, b in (
                (one.intensity, other.intensity),
                (one.intensity, true),
                (other.intensity, true),
            )
        )
        assert change > 0, "no coarser level was drawn"
        # measured: 0.2 to 0.3 %, where the samples alone err by 0.5 to 1 %
        assert change < 0.5 * samples
        assert error < 1.15 * samples
        # a body's echo may change by a sample's width in radians, 0.003
        np.testing.assert_allclose(one.body_echo[1:], other.body_echo[1:], rtol=3e-3)


def small_scene(hills):
    ball = trimesh.creation.icosphere(3)
    patchy = np.linspace(0.1, 1, len(ball.faces))
    normals = np.asarray(ball.vertices, np.float32)
    return [
        sg.Body("hills", hills, sg.pose(z=-5), 0.4),
        sg.Body("patchy", ball, sg.pose(7, 2), patchy),
        sg.Body("smooth", ball, sg.pose(9, -2), 0.9, normals),
        sg.Body("box", trimesh.creation.box((1, 1, 2)), sg.pose(5, -0.5, yaw=0.4), 1.0),
    ]


VIEWS = [sg.pose(0, 0, 0, 0, 0.1, 0), sg.pose(-3, 1, 1, 0.2, 0.1, 0.3)]


@pytest.mark.slow
def test_pings_without_indirect_draws_are_identical(monkeypatch, hills, opengl_engine):
    expected, calls = pings(small_scene(hills), VIEWS), []
    draw = buffers.SceneBuffers.draw
    monkeypatch.setattr(
        buffers.SceneBuffers, "draw", lambda self, *a: calls.append(self.indirect) or draw(self, *a)
    )
    monkeypatch.setattr(buffers, "has_indirect_draws", lambda _: False)
    found = pings(small_scene(hills), VIEWS)
    assert calls
    assert not any(calls)
    for one, other in zip(found, expected, strict=True):
        assert other.intensity.any()
        for name in ("intensity", "body_id", "elevation_rad", "body_echo"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


OLD_DRIVER_PROGRAM = """
import json, sys
import numpy as np
sys.path.insert(0, sys.argv[1])
from tests.raster import test_cull as here
here.detail.LEAF_FACES, here.detail.MIN_FACES_TO_SIMPLIFY = 64, 2000
from sonar_gl.raster.opengl import buffers
used = []
draw = buffers.SceneBuffers.draw
buffers.SceneBuffers.draw = lambda self, *a: used.append(self.indirect) or draw(self, *a)
with here.sg.Simulator(
    here.sg.Scene(here.small_scene(here.old_hills())), here.SONAR, here.sg.Acoustics.ideal(), here.SAMPLING
) as it:
    found = [it.ping(pose).intensity for pose in here.VIEWS]
    with it.run.drawing() as context:
        code = context.version_code
np.save(sys.argv[2], found)
print(json.dumps({"code": code, "indirect": used}))
"""


def old_hills():
    return terrain(np.random.default_rng(0), 60.0, 6.0, 30)


@pytest.mark.slow
@pytest.mark.parametrize("extensions, indirect", [("-GL_ARB_multi_draw_indirect", False), ("", True)])
def test_a_driver_of_opengl_3_3_gives_the_same_ping(extensions, indirect, tmp_path, opengl_engine):
    """Mesa offers version 3.3 in a separate process. NVIDIA's driver gives no later one where 3.3 is asked for."""
    bodies = small_scene(old_hills())
    with sg.Simulator(sg.Scene(bodies), SONAR, sg.Acoustics.ideal(), SAMPLING) as it:
        if "Mesa" not in it.gl_info["version"]:
            pytest.skip("only Mesa can be set to another version")
        expected = [it.ping(pose).intensity for pose in VIEWS]
    versions = {"MESA_GL_VERSION_OVERRIDE": "3.3", "MESA_GLSL_VERSION_OVERRIDE": "330"}
    versions["MESA_EXTENSION_OVERRIDE"] = extensions
    command = [
        sys.executable,
        "-c",
        OLD_DRIVER_PROGRAM,
        str(Path(__file__).resolve().parents[2]),
        tmp_path / "found.npy",
    ]
    done = subprocess.run(
        command, env={**os.environ, **versions}, capture_output=True, text=True, timeout=100
    )
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    assert report["code"] == 330
    assert set(report["indirect"]) == {indirect}
    np.testing.assert_array_equal(np.load(tmp_path / "found.npy"), expected)


@pytest.mark.parametrize(
    ("mesh", "share"),
    [
        pytest.param(
            trimesh.creation.box((0.5, 0.1, 2.0)), 0.0, marks=pytest.mark.slow
        ),  # each corner is the outermost in some direction
        (trimesh.creation.icosphere(3, 0.7), 0.08),  # 1 - cos 23°
        pytest.param(trimesh.creation.cylinder(0.1, 0.6, sections=48), 0.02, marks=pytest.mark.slow),
    ],
)
def test_the_spans_of_bodies_hold_all_of_their_visible_places(mesh, share):
    """The nearest place is that of the box; how much too near the furthest is found is a share of the radius."""
    rng, bodies = np.random.default_rng(1), []
    for number in range(20):
        place = random_rotation(rng)
        place[:3, 3] = rng.uniform(-3, 3, 3)
        bodies.append(sg.Body(f"{number}", mesh.copy().apply_translation((0.3, 0, 1)), place))
    some = meshes_of(bodies)
    pose = random_rotation(rng)
    pose[:3, 3] = 0.5, 0.2, -0.1
    spans = some.view_from(pose).spans
    assert spans[0].tolist() == [0.0, np.inf]
    radius_m = np.linalg.norm(mesh.vertices, axis=1).max()
    for body, (furthest, nearest) in zip(bodies, spans[1:], strict=True):
        places = np.asarray(body.mesh.vertices) @ body.pose[:3, :3].T + body.pose[:3, 3]
        ranges_m = np.linalg.norm(places - pose[:3, 3], axis=1)
        normals, faces = body.mesh.face_normals @ body.pose[:3, :3].T, body.mesh.faces
        looks_here = ((pose[:3, 3] - places[faces[:, 0]]) * normals).sum(axis=1) > 0
        visible_m = ranges_m[faces[looks_here]].max(initial=0.0)  # none is where the sonar is inside
        assert ranges_m.max() * (1 + 1e-12) >= 1 / furthest >= visible_m - share * radius_m - 1e-12
        low, high = body.mesh.bounds
        sonar = body.pose[:3, :3].T @ (pose[:3, 3] - body.pose[:3, 3])
        expected_m = np.linalg.norm(np.maximum(0, np.maximum(low - sonar, sonar - high)))
        assert 1 / nearest == pytest.approx(expected_m, rel=1e-12)
        assert expected_m <= ranges_m.min() * (1 + 1e-12)


@pytest.mark.parametrize("is_inverted", [True, False])
@pytest.mark.parametrize(
    "mesh", [trimesh.creation.box((12, 8, 4)), trimesh.creation.icosphere(3, 4.0)], ids=["box", "ball"]
)
def test_the_spans_of_a_body_about_the_sonar_hold_all_of_it(mesh, is_inverted):
    """As of a tank, whose walls are seen through the sphere that it fills; also just outside, before the near plane."""
    mesh = mesh.copy()
    if is_inverted:
        mesh.invert()
    ends = mesh.bounds[1]
    for place in (0.9 * ends / np.sqrt(3), ends * (0.97, 0, 0), ends * (1, 0, 0) + (CORNER * NEAR_M, 0, 0)):
        spans = meshes_of([sg.Body("tank", mesh)]).view_from(sg.pose(*place)).spans
        furthest_m = np.linalg.norm(mesh.vertices - place, axis=1).max()
        # some vertices of a ball stand for all
        assert 1 / spans[1, 0] >= furthest_m - (0.02 * ends[0] if len(mesh.vertices) > 8 else 1e-12)


def test_a_mesh_that_takes_long_to_prepare_is_warned_of(monkeypatch):
    """Once: another body that has it takes no time."""
    ball = trimesh.creation.icosphere(2)
    bodies = [
        sg.Body("ball", ball),
        sg.Body("other", ball, sg.pose(3)),
        sg.Body("box", trimesh.creation.box()),
    ]
    monkeypatch.setattr(scene_meshes, "MANY_FACES", 319)
    with pytest.warns(
        UserWarning, match=r"^body 'ball' has 320 triangles, whose levels of detail take"
    ) as found:
        meshes_of(bodies)
    assert len(found) == 1
