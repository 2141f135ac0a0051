"""What a sector chooses to draw: all that it may see, as coarse as does no harm, and little else."""

import json
import os
import re
import subprocess
import sys
from itertools import pairwise

import numpy as np
import pytest
import trimesh
from worlds import terrain

import sonar_gl as sg
from sonar_gl import detail, gpu, stock
from sonar_gl.cull import BEYOND
from sonar_gl.draws import Draws, SectorView
from sonar_gl.footprint import FAR_FACTOR

SONAR = sg.Sonar("test", 900e3, 64, 200, 100.0, 20.0, 1.5, 0.5, 30.0)
SAMPLING = sg.Sampling(1, 60)
FAR_M = FAR_FACTOR * SONAR.range_max_m


@pytest.fixture(autouse=True, scope="module")
def small_patches():
    """Patches of 64 faces, and coarser levels above 2000, so that small meshes have many of both."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(detail, "LEAF", 64)
        patch.setattr(detail, "MANY", 2000)
        yield


@pytest.fixture(scope="module")
def hills():
    """Sharp hills of 12 000 faces, 60 m wide."""
    return terrain(np.random.default_rng(0), 60.0, 6.0, 80)


@pytest.fixture(scope="module")
def views():
    with sg.Simulator(sg.Scene([]), SONAR, sampling=SAMPLING) as it:
        return [SectorView(sector) for sector in it.fan.sectors]


def choose(bodies, pose, view):
    """The (patch, body) that a sector draws, and all that is known of patches."""
    some = stock.Stock()
    some.add(bodies)
    placed = some.place(pose)
    out = Draws()
    some.see(view, placed, FAR_M, SONAR.range_max_m, 0, out)
    draws = out.draws[: out.counts["draws"]]
    firsts = 3 * some.patches["first_face"]
    real = np.flatnonzero(some.patches["n_faces"] > 0)
    at = dict(zip(firsts[real].tolist(), real.tolist(), strict=True))
    return [(at[int(row[2])], int(row[4])) for row in draws], some, placed


def corners_in(view, some, placed, patch, body, m=None):
    """(n, 3, 3) corners of a patch's faces in the sector's frame."""
    levels = some.patches
    first, n = levels["first_face"][patch], levels["n_faces"][patch]
    used = levels["first_vertex"][patch] + levels["faces"][first : first + n].astype(int)
    m = placed.matrices[body]
    # the vertices of a stock that does not sift are with the driver: take the box's about the same centre
    points = some.all_points[used]
    return (points @ m[:, :3].T + m[:, 3]) @ view.rotation.T


@pytest.fixture
def keep_points(monkeypatch):
    """Have a stock keep the vertices that it gave to the driver."""
    add = stock.Stock.add

    def adding(self, bodies):
        made = add(self, bodies)
        self.all_points = np.concatenate([one.points for one in made]).astype(float)
        return made

    monkeypatch.setattr(stock.Stock, "add", adding)


def any_inside(corners, view, slack=0.0):
    """Whether vertices, or points within the faces, lie before a sector and in its reach."""
    weights = np.random.default_rng(0).dirichlet([1, 1, 1], 12)
    weights = np.concatenate([weights, np.eye(3)])
    x, y, z = np.einsum("sk,fkc->cfs", weights, corners)
    ahead = x > stock.NEAR_M + slack
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v = -y / x, z / x
    low_u, high_u, low_v, high_v = view.limits
    inside = ahead & (u > low_u) & (u < high_u) & (v > low_v) & (v < high_v)
    return (inside & (np.sqrt(x * x + y * y + z * z) < FAR_M)).any()


def poses(n=8):
    """About the origin, all but one looking there more or less, rolled."""
    rng = np.random.default_rng(4)
    for _ in range(n):
        x, y = rng.uniform(-22, 22, 2)
        yaw = np.arctan2(-y, -x) + rng.uniform(-0.8, 0.8)
        yield sg.pose(x, y, rng.uniform(1, 8), rng.uniform(-3, 3), rng.uniform(-0.2, 0.4), yaw)
    yield sg.pose(20, 0, 4)


def test_what_a_sector_may_see_is_drawn_and_what_it_may_not_is_left_out(
    views, keep_points, monkeypatch, hills
):
    """Leaf by leaf, against points of their faces."""
    monkeypatch.setattr(detail, "MANY", 10**9)
    ground = terrain(np.random.default_rng(1), 60.0, 6.0, 48)
    ball = trimesh.creation.icosphere(4, 5.0)
    bodies = [sg.Body("ground", ground, sg.pose(z=-2)), sg.Body("ball", ball, sg.pose(3, 2))]
    left_out = wasted = drawn = 0
    for pose in poses():
        for view in views:
            chosen, some, placed = choose(bodies, pose, view)
            assert len(set(chosen)) == len(chosen)
            for body, (first, end) in enumerate(some.roots):
                for patch in range(first, end):
                    if not some.patches["leaf"][patch]:
                        continue
                    corners = corners_in(view, some, placed, patch, body)
                    seen = any_inside(corners, view)
                    if (patch, body) in chosen:
                        drawn += 1
                        wasted += not seen
                        # its box reaches into the view: not one that is wholly beyond a side of it
                        x, y, z = corners.reshape(-1, 3).T
                        low_u, high_u, low_v, high_v = view.limits
                        side = np.linalg.norm(2 * some.patches["box"][patch, 3:])
                        outside = (x, high_u * x + y, -y - low_u * x, high_v * x - z, z - low_v * x)
                        assert all(away.max() > -2 * side for away in outside)
                    elif seen:
                        # though in view: wholly turned away, of a closed body seen from outside
                        assert some.closed[body]
                        assert placed.outside
                        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
                        assert ((normals * corners[:, 0]).sum(axis=1) >= -1e-9).all()
                        left_out += 1
    assert left_out > 50
    assert drawn > 200
    assert wasted < 0.3 * drawn  # boxes are larger than their faces


def test_back_faces_are_drawn_of_open_bodies_and_from_inside(views, keep_points):
    ball = trimesh.creation.icosphere(4, 4.0)
    bowl = trimesh.Trimesh(ball.vertices, ball.faces[:-1], process=False)
    n = {}
    for name, mesh, x in (("closed", ball, 8), ("open", bowl, 8), ("inside", ball, 1)):
        chosen, some, _ = choose([sg.Body("ball", mesh, sg.pose(x))], np.eye(4), views[len(views) // 2])
        n[name] = int(some.patches["n_faces"][[patch for patch, _ in chosen]].sum())
    assert n["closed"] < 0.75 * n["open"]
    assert n["inside"] > 0


def test_what_is_beyond_or_behind_or_not_there_costs_nothing(views, hills):
    for pose in (sg.pose(-2000), sg.pose(200), sg.pose(z=200), sg.pose(z=-200)):
        for view in views:
            chosen, _, _ = choose([sg.Body("hills", hills)], pose, view)
            assert chosen == []


def test_a_body_is_covered_once_and_coarser_with_distance(views, monkeypatch):
    """No patch is drawn together with one below it; from afar a smaller share of the faces in view."""
    view, ground = views[0], terrain(np.random.default_rng(0), 60.0, 1.0, 80)
    faces = {}
    for strays in (stock.STRAY_SAMPLES, 0.0):
        monkeypatch.setattr(stock, "STRAY_SAMPLES", strays)
        faces[strays] = []
        for x in (20, 50, 80, 110):
            chosen, some, _ = choose(
                [sg.Body("ground", ground)], sg.pose(-x, 0, 5, pitch=0.05, yaw=0.5), view
            )
            patches = sorted(patch for patch, _ in chosen)
            for one, following in pairwise(patches):
                assert some.patches["skip"][one] <= following
            faces[strays].append(int(some.patches["n_faces"][patches].sum()))
    levels, whole = (np.array(n) for n in faces.values())
    assert whole.min() > 500
    share = levels / whole
    assert (np.diff(share) < 0).all()
    assert share[-1] < 0.25  # wholly beyond the last bin


def test_a_chosen_patch_strays_by_no_more_than_it_may(views, hills):
    """By its own figures: of a sample's width where it is, or BEYOND times more where it is not heard."""
    coarse = 0
    for x in (20, 35, 50):
        for view in views:
            pose = sg.pose(-x, 0, 5, pitch=0.05)
            chosen, some, _ = choose([sg.Body("hills", hills)], pose, view)
            eye = pose[:3, 3] - some.centres[0]
            for patch, _ in chosen:
                error_m, box = some.patches["error_m"][patch], some.patches["box"][patch]
                nearest = np.linalg.norm(np.maximum(np.abs(box[:3] - eye) - box[3:], 0))
                allowed = stock.STRAY_SAMPLES * view.sample_rad * nearest
                if nearest - error_m > SONAR.range_max_m:
                    allowed *= BEYOND
                assert error_m <= allowed
                coarse += error_m > 0
    assert coarse > 10


def pings(bodies, poses, **kw):
    with sg.Simulator(sg.Scene(bodies), SONAR, sg.Acoustics.ideal(), SAMPLING, **kw) as it:
        return [it.ping(pose, labels=True) for pose in poses]


def test_levels_change_a_ping_by_less_than_its_samples_err(monkeypatch):
    """105 000 faces of gentle hills: with levels and without, both against nine times the samples without."""
    monkeypatch.setattr(detail, "LEAF", 512)
    monkeypatch.setattr(detail, "MANY", 100_000)
    ground = terrain(np.random.default_rng(2), 60.0, 0.6, 230)
    ball = sg.Body("ball", trimesh.creation.icosphere(3), sg.pose(9))
    scene, ideal = sg.Scene([sg.Body("ground", ground, sg.pose(z=-5)), ball]), sg.Acoustics.ideal()
    where = [sg.pose(0, y, 0, 0, 0.15, yaw) for y, yaw in ((0, 0), (5, 1), (-20, 2.5))]
    with (
        sg.Simulator(scene, SONAR, ideal, sg.Sampling(2, 120)) as it,
        sg.Simulator(it, SONAR, ideal, sg.Sampling(6, 360)) as fine,
    ):
        levels = [it.ping(pose, labels=True) for pose in where]
        monkeypatch.setattr(stock, "STRAY_SAMPLES", 0.0)
        whole = [it.ping(pose, labels=True) for pose in where]
        truth = [fine.ping(pose).intensity for pose in where]
    for one, other, true in zip(levels, whole, truth, strict=True):
        change, error, samples = (
            np.abs(a - b).sum() / true.sum()
            for a, b in (
                (one.intensity, other.intensity),
                (one.intensity, true),
                (other.intensity, true),
            )
        )
        assert change > 0, "no coarser level was drawn"
        # 0.2 to 0.3 % were found, of 0.5 to 1 % that so many samples err by themselves
        assert change < 0.5 * samples
        assert error < 1.15 * samples
        # a patch's echo may differ by 2 per radian of a sample's width, 0.003, to either side
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


WHERE = [sg.pose(0, 0, 0, 0, 0.1, 0), sg.pose(-3, 1, 1, 0.2, 0.1, 0.3)]


@pytest.mark.parametrize("software", ["", "(?!)"])
def test_without_indirect_draws_the_same_bytes(monkeypatch, hills, software):
    monkeypatch.setattr(gpu, "SOFTWARE", re.compile(software))
    expected, calls = pings(small_scene(hills), WHERE), []
    draw = gpu.SceneOnGpu.draw
    monkeypatch.setattr(
        gpu.SceneOnGpu, "draw", lambda self, *a: calls.append(self.indirect) or draw(self, *a)
    )
    monkeypatch.setattr(gpu, "INDIRECT_GL", 999)
    found = pings(small_scene(hills), WHERE)
    assert calls
    assert not any(calls)
    for one, other in zip(found, expected, strict=True):
        assert other.intensity.any()
        for name in ("intensity", "body_id", "elevation_rad", "body_echo"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


OLD = """
import json, sys
import numpy as np
sys.path.insert(0, sys.argv[1])
import test_culling as here
here.detail.LEAF, here.detail.MANY = 64, 2000
from sonar_gl import gpu
used = []
draw = gpu.SceneOnGpu.draw
gpu.SceneOnGpu.draw = lambda self, *a: used.append(self.indirect) or draw(self, *a)
with here.sg.Simulator(
    here.sg.Scene(here.small_scene(here.old_hills())), here.SONAR, here.sg.Acoustics.ideal(), here.SAMPLING
) as it:
    found = [it.ping(pose).intensity for pose in here.WHERE]
    code = it._world.context.version_code
np.save(sys.argv[2], found)
print(json.dumps({"code": code, "indirect": used}))
"""


def old_hills():
    return terrain(np.random.default_rng(0), 60.0, 6.0, 30)


def test_a_driver_of_opengl_3_3_gives_the_same_ping(tmp_path):
    """Mesa told to offer no more than that, in a process of its own."""
    bodies = small_scene(old_hills())
    with sg.Simulator(sg.Scene(bodies), SONAR, sg.Acoustics.ideal(), SAMPLING) as it:
        if "Mesa" not in it.gl_info["version"]:
            pytest.skip("only Mesa can be told its version")
        expected = [it.ping(pose).intensity for pose in WHERE]
    versions = {"MESA_GL_VERSION_OVERRIDE": "3.3", "MESA_GLSL_VERSION_OVERRIDE": "330"}
    command = [sys.executable, "-c", OLD, os.path.dirname(__file__), tmp_path / "found.npy"]
    done = subprocess.run(
        command, env={**os.environ, **versions}, capture_output=True, text=True, timeout=100
    )
    assert done.returncode == 0, done.stderr
    said = json.loads(done.stdout)
    assert said["code"] == 330
    assert said["indirect"]
    assert not any(said["indirect"])
    np.testing.assert_array_equal(np.load(tmp_path / "found.npy"), expected)
