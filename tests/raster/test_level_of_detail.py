"""Mesh simplification and levels of detail: geometric error, closed meshes, cuts without cracks."""

import ast
from pathlib import Path

import numpy as np
import pytest
import trimesh

import sonar_gl as sg
from sonar_gl.raster import level_of_detail as detail
from sonar_gl.raster.cpu.kernels.rasterization import MAX_PATCH_VERTICES
from sonar_gl.raster.level_of_detail import make_levels
from sonar_gl.raster.simplify import simplify
from tests.support.processes import python
from tests.support.worlds import terrain


def arrays(mesh):
    return np.array(mesh.vertices, float), np.array(mesh.faces, np.int32)


def grid(n=40):
    """Return a flat square of (n - 1)² squares, 1 m wide, and a mask of its rim."""
    points, faces = arrays(terrain(np.random.default_rng(0), 1.0, 1.0, n))
    points[:, 2] = 0
    return points, faces, (np.abs(points[:, :2]) > 0.5 - 1e-9).any(axis=1)


def faces_per_edge(faces):
    """Return the number of faces of each edge, and whether opposite directions of edges match in number."""
    a, b = faces.astype(np.int64).ravel(), np.roll(faces, -1, axis=1).astype(np.int64).ravel()
    n = int(faces.max()) + 1
    _, counts = np.unique(np.minimum(a, b) * n + np.maximum(a, b), return_counts=True)
    return counts, np.array_equal(np.sort(a * n + b), np.sort(b * n + a))


def area_vectors(points, faces):
    a, b, c = (points[faces[:, k]] for k in range(3))
    return np.cross(b - a, c - a) / 2


CLOSED = {
    "ball": trimesh.creation.icosphere(5),
    "disc": trimesh.creation.icosphere(4).apply_scale([1, 1, 0.1]),
    "torus": trimesh.creation.torus(1, 0.3, 96, 48),
}


@pytest.mark.parametrize("name", CLOSED)
@pytest.mark.parametrize("share", [0.7, 0.5, 0.1, 0.0])
def test_a_closed_mesh_stays_closed_and_keeps_locked_vertices(name, share):
    points, faces = arrays(CLOSED[name])
    before = points.copy(), faces.copy()
    locked = np.random.default_rng(1).random(len(points)) < 0.02
    target = int(share * len(faces))
    fewer, error_m = simplify(points, faces, locked, target)
    counts, matched = faces_per_edge(fewer)
    assert matched
    assert (counts == 2).all()
    # each collapsed edge removes two faces
    assert target - 1 <= len(fewer) <= max(target + 1, len(faces) / 7)
    assert np.isin(np.flatnonzero(locked), fewer).all()
    assert error_m > 0
    # the topology stays: as many holes
    euler = len(np.unique(fewer)) - len(counts) + len(fewer)
    assert euler == (0 if name == "torus" else 2)
    np.testing.assert_array_equal(points, before[0])
    np.testing.assert_array_equal(faces, before[1])


@pytest.mark.parametrize("sides", [3, 4])
def test_a_thin_ring_is_not_pinched(sides):
    """Around a ring of three sides each edge has a neighbour on the far side, with which it bounds no face."""
    points, faces = arrays(trimesh.creation.torus(1, 0.05, 96, sides))
    locked = np.zeros(len(points), bool)
    for share in (0.6, 0.3, 0.1, 0.0):
        fewer, _ = simplify(points, faces, locked, int(share * len(faces)))
        counts, matched = faces_per_edge(fewer)
        assert matched and (counts == 2).all()
        assert len(np.unique(fewer)) - len(counts) + len(fewer) == 0  # Euler's number of a ring


def test_locked_meshes_do_not_change():
    points, faces = arrays(CLOSED["disc"])
    fewer, error_m = simplify(points, faces, np.ones(len(points), bool), 10)
    np.testing.assert_array_equal(fewer, faces)
    assert error_m == 0


def test_a_plane_stays_plane_and_keeps_its_area():
    points, faces, rim = grid()
    fewer, error_m = simplify(points, faces, rim, len(faces) // 10)
    assert len(fewer) < len(faces) / 8
    assert np.isin(np.flatnonzero(rim), fewer).all()
    # z is 0 and normals (0, 0, 1) to the bit
    assert error_m == 0
    assert area_vectors(points, fewer)[:, 2].sum() == pytest.approx(1.0, abs=1e-12)


def test_a_sharp_edge_stays():
    """On a floor and a wall the error is 0 while vertices stay in their plane or on the common edge."""
    points, faces, rim = grid(41)
    bent = points.copy()
    bent[:, 2], bent[:, 0] = np.maximum(points[:, 0], 0), np.minimum(points[:, 0], 0)
    fewer, error_m = simplify(bent, faces, rim, len(faces) // 8)
    assert len(fewer) < len(faces) / 5
    assert error_m < 1e-9  # rounding of squared metres, 1e-16
    normals = area_vectors(bent, fewer)
    # no face cuts the corner
    assert (np.count_nonzero(np.abs(normals) > 1e-12, axis=1) <= 1).all()
    assert np.abs(normals.sum(axis=0)) == pytest.approx([0.5, 0, 0.5], abs=1e-9)


@pytest.mark.parametrize("share", [0.7, 0.5, 0.25, 0.1, 0.02])
def test_the_error_bounds_the_distance_from_a_ball(share):
    """`error_m` is an rms over planes; the middle of a face lies deeper inside the ball, 1.8 times as deep here."""
    points, faces = arrays(CLOSED["ball"])
    fewer, error_m = simplify(points, faces, np.zeros(len(points), bool), int(share * len(faces)))
    weights = np.random.default_rng(0).dirichlet([1, 1, 1], 32)
    weights = np.concatenate([weights, np.full((1, 3), 1 / 3)])
    depths = 1 - np.linalg.norm(np.einsum("sk,fkc->fsc", weights, points[fewer]), axis=-1)
    assert depths.max() < 2 * error_m
    assert depths.max() > 0.5 * error_m  # nor is the error overestimated
    assert np.sqrt((depths**2).mean()) < error_m


def patch_faces(levels, number):
    """Return the faces of a patch, (n, 3), as indices of the mesh's vertices."""
    first, n = levels.first_face[number], levels.n_faces[number]
    return levels.vertices[levels.first_vertex[number] + levels.faces[first : first + n].astype(int)]


def children_of(levels, number):
    """Return the children of a patch."""
    out, at = [], number + 1
    while at < levels.skip[number]:
        out.append(at)
        at = levels.skip[at]
    return out


def by_points(faces):
    """Return faces in a canonical order, each rotated to begin with its lowest vertex."""
    start = faces.argmin(axis=1)
    turned = np.stack([faces[np.arange(len(faces)), (start + k) % 3] for k in range(3)], axis=1)
    return turned[np.lexsort(turned.T[::-1])]


def meshes():
    hills = terrain(np.random.default_rng(3), 50.0, 6.0, 70)
    two = trimesh.util.concatenate(
        [trimesh.creation.icosphere(4), trimesh.creation.icosphere(4).apply_translation([5, 0, 0])]
    )
    return {**CLOSED, "hills": hills, "two": two}


@pytest.fixture(params=meshes())
def tree(request, monkeypatch):
    """Return a mesh and its patch tree, with limits lowered as for a large mesh."""
    monkeypatch.setattr(detail, "MIN_FACES_TO_SIMPLIFY", 1000)
    monkeypatch.setattr(detail, "LEAF_FACES", 200)
    points, faces = arrays(meshes()[request.param])
    return request.param, points, faces, make_levels(points, faces)


def test_leaves_hold_the_faces_of_the_mesh(tree):
    _, _, faces, levels = tree
    leaves = np.flatnonzero(levels.leaf)
    assert len(leaves) >= 8
    assert levels.n_faces[leaves].max() <= 200
    assert (levels.error_m[leaves] == 0).all()
    assert (levels.skip[leaves] == leaves + 1).all()
    together = np.concatenate([patch_faces(levels, number) for number in leaves])
    np.testing.assert_array_equal(by_points(together), by_points(faces))


def test_patches_form_a_tree(tree):
    """Patches are in depth-first order with one parent each; a parent has fewer faces and a larger error."""
    _, _, _, levels = tree
    n = len(levels.skip)
    assert levels.skip[0] == n
    n_parents = np.zeros(n, int)
    for number in range(n):
        for one in children_of(levels, number):
            n_parents[one] += 1
            assert levels.error_m[one] <= levels.error_m[number]
        has_faces = levels.n_faces[number] > 0
        if has_faces and not levels.leaf[number]:
            assert levels.n_faces[number] < sum(levels.n_faces[one] for one in children_of(levels, number))
        assert has_faces or np.isinf(levels.error_m[number])
    assert n_parents[0] == 0
    assert (n_parents[1:] == 1).all()
    assert levels.n_faces[0] < 1000, "there must be coarser levels"


def test_the_patch_of_the_whole_mesh_is_halved_until_it_has_few_faces(tree):
    name, _, _, levels = tree
    chain = [0]
    while len(children := children_of(levels, chain[-1])) == 1:
        chain += children
    n_faces = levels.n_faces[chain[::-1]]
    if name == "hills":  # open: nearly all that is left lies on its rim, which stays
        assert len(chain) == 1 and detail.COARSEST_FACES < n_faces[0] < 1.2 * 4 * 69
        return
    assert len(chain) >= 3 and (np.diff(levels.error_m[chain]) < 0).all()
    # each collapsed edge removes two faces
    assert (np.abs(n_faces[1:] - n_faces[:-1] // 2) <= 1).all()
    assert n_faces[-1] <= detail.COARSEST_FACES < n_faces[-2]


def cut(levels, take):
    """Return a cut through the tree: the patches that `take` accepts, without their descendants."""
    out, number = [], 0
    while number < len(levels.skip):
        if levels.leaf[number] or (levels.n_faces[number] > 0 and take(number)):
            out.append(number)
            number = levels.skip[number]
        else:
            number += 1
    return out


def test_every_cut_through_the_tree_has_no_cracks(tree):
    """In random cuts, and in cuts by distance as a sonar makes them, every inner edge has two faces."""
    name, points, faces, levels = tree
    rng, sizes = np.random.default_rng(0), set()
    whole = area_vectors(points, faces).sum(axis=0)
    least = levels.error_m[levels.error_m > 0].min()
    span = np.ptp(points, axis=0).max()

    def by_chance(chance):
        return lambda number: rng.random() < chance

    def by_distance(eye, ratio):
        return lambda number: levels.error_m[number] <= ratio * np.linalg.norm(levels.box[number, :3] - eye)

    takes = [by_chance(chance) for chance in np.repeat([0.05, 0.2, 0.5, 0.8], 4)]
    for ratio in np.geomspace(least / span, 100 * least / span, 12):
        takes.append(by_distance(rng.uniform(-1, 1, 3) * span, ratio))
    for take in takes:
        chosen = cut(levels, take)
        sizes.add(len(chosen))
        mixed = np.concatenate([patch_faces(levels, number) for number in chosen])
        counts, matched = faces_per_edge(mixed)
        if name == "hills":  # open: the edges of its rim have one face, as in the mesh
            assert counts.max() <= 2
            assert (counts == 1).sum() == (faces_per_edge(faces)[0] == 1).sum()
        else:
            assert matched
            assert (counts == 2).all()
        # surfaces with the same rim have the same area vector
        np.testing.assert_allclose(area_vectors(points, mixed).sum(axis=0), whole, atol=1e-9 * span**2)
    assert len(sizes) > 4


def test_boxes_and_cones_enclose_their_patches(tree):
    _, points, _, levels = tree
    slack = 1e-9 * np.ptp(points, axis=0).max()
    for number in range(len(levels.skip)):
        middle, half = levels.box[number, :3], levels.box[number, 3:]
        for one in range(number, levels.skip[number]):
            faces = patch_faces(levels, one)
            if len(faces):
                assert (np.abs(points[faces] - middle) <= half + slack).all()
        faces = patch_faces(levels, number)
        if len(faces) == 0:
            assert levels.cone[number, 3] == -1
            continue
        normals = area_vectors(points, faces)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        cosines = normals @ levels.cone[number, :3]
        assert cosines.min() == pytest.approx(levels.cone[number, 3], abs=1e-9)


def test_moments_are_sums_over_faces(tree):
    _, points, _, levels = tree
    axes = [(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)]

    def moment(faces):
        vectors = area_vectors(points, faces)
        areas = np.linalg.norm(vectors, axis=1)
        return np.array([(vectors[:, i] * vectors[:, j] / areas).sum() for i, j in axes])

    moments = np.array(
        [
            moment(patch_faces(levels, n)) if levels.n_faces[n] else np.zeros(6)
            for n in range(len(levels.skip))
        ]
    )
    np.testing.assert_allclose(levels.moment, moments, atol=1e-9 * np.abs(moments).max())
    for number in range(len(levels.skip)):
        leaves = [one for one in range(number, levels.skip[number]) if levels.leaf[one]]
        np.testing.assert_allclose(
            levels.whole[number], moments[leaves].sum(axis=0), atol=1e-9 * np.abs(moments).max()
        )


def test_a_small_mesh_is_one_patch_and_a_larger_one_has_no_coarser_levels(monkeypatch):
    monkeypatch.setattr(detail, "LEAF_FACES", 200)
    points, faces = arrays(trimesh.creation.icosphere(1))
    levels = make_levels(points, faces)
    assert levels.n_faces.tolist() == [80]
    assert levels.leaf.tolist() == [True]
    points, faces = arrays(CLOSED["ball"])
    levels = make_levels(points, faces)
    assert levels.n_faces[~levels.leaf].sum() == 0
    assert np.isinf(levels.error_m[~levels.leaf]).all()
    assert levels.n_faces[levels.leaf].sum() == len(faces)
    assert (levels.cone[~levels.leaf, 3] == -1).all()  # faces in any direction may be below
    # the box of the whole mesh, though the root has no faces
    np.testing.assert_allclose(levels.box[0], [0, 0, 0, 1, 1, 1], atol=1e-2)


def test_a_plane_far_from_the_origin_loses_nothing(monkeypatch):
    monkeypatch.setattr(detail, "MIN_FACES_TO_SIMPLIFY", 1000)
    monkeypatch.setattr(detail, "LEAF_FACES", 200)
    points, faces, _ = grid()
    levels = make_levels(points + 1e6, faces)
    assert not levels.error_m.any() and levels.n_faces[0] < len(faces) / 4


def test_a_closed_mesh_that_is_inside_out_is_turned():
    ball = trimesh.creation.icosphere(2)
    inside_out = ball.copy()
    inside_out.invert()
    one, other = (detail.mesh_with_levels(sg.Body("ball", mesh)) for mesh in (ball, inside_out))
    assert one.closed == other.closed == 1
    faces, turned = (by_points(patch_faces(mesh.levels, 0)) for mesh in (one, other))
    np.testing.assert_array_equal(turned, faces)


def test_corners_at_one_place_are_one_vertex_whatever_the_sign_of_zero():
    """Two triangles of one reflectivity, with corners of their own."""
    points = [[-1, -1, -1], [0.0, -1, -1], [0.0, 1, 1], [-0.0, -1, -1], [1, 1, 1], [-0.0, 1, 1]]
    two = trimesh.Trimesh(points, [[0, 1, 2], [3, 4, 5]], process=False)
    assert len(detail.mesh_with_levels(sg.Body("two", two, reflectivity=[0.5, 0.5])).points) == 4


def test_a_plane_is_not_folded():
    points, faces, rim = grid()
    fewer, _ = simplify(points, faces, rim, len(faces) // 10)
    assert (area_vectors(points, fewer)[:, 2] > 0).all()  # no face is degenerate or flipped


def test_a_floor_and_a_wall_are_not_folded():
    points, faces, rim = grid(41)
    bent = points.copy()
    bent[:, 2], bent[:, 0] = np.maximum(points[:, 0], 0), np.minimum(points[:, 0], 0)
    fewer, _ = simplify(bent, faces, rim, len(faces) // 8)
    assert np.abs(area_vectors(bent, fewer)).sum(axis=0) == pytest.approx([0.5, 0, 0.5], abs=1e-9)


@pytest.mark.slow
def test_compiled_functions_do_not_sort():
    """Numba caches parts of np.sort and np.argsort under names that collide with those of another process."""
    package, n_compiled = Path(sg.__file__).parent, 0
    for path in package.rglob("*.py"):
        source = path.read_text(encoding="utf-8")
        for function in ast.walk(ast.parse(source)) if "core.compiled import" in source else ():
            marks = [ast.unparse(one) for one in getattr(function, "decorator_list", ())]
            if {"added_in_any_order", "compiled", "inlined", "rounded_alike", "uncounted"} & set(marks):
                n_compiled += 1
                called = {ast.unparse(call.func) for call in ast.walk(function) if isinstance(call, ast.Call)}
                sorts = {name for name in called if name.endswith((".sort", ".argsort")) or name == "sorted"}
                assert not sorts, f"{path.name}: {function.name}"
    assert n_compiled > 100


LEVELS_OF_A_TORUS = """
import hashlib
import numpy as np
import trimesh
from sonar_gl.raster import level_of_detail as detail

detail.MIN_FACES_TO_SIMPLIFY, detail.LEAF_FACES = 1000, 200
torus = trimesh.creation.torus(1, 0.3, 96, 48)
levels = detail.make_levels(np.array(torus.vertices, float), np.array(torus.faces, np.int32))
assert levels.error_m.max() > 0
print(hashlib.sha256(levels.vertices.tobytes() + levels.faces.tobytes()).hexdigest())
"""


@pytest.mark.slow  # compiles twice
def test_levels_are_the_same_on_all_processors(tmp_path):
    """The naive way multiplies and adds in one step where the processor can, and cuts another mesh."""
    generic = {"NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": "", "NUMBA_CACHE_DIR": str(tmp_path)}
    found = [python("-c", LEVELS_OF_A_TORUS, environment=one, check=True).stdout for one in ({}, generic)]
    assert len(found[0]) == 65 and found[0] == found[1]


@pytest.mark.parametrize("is_simplified", [False, True])
def test_the_rasteriser_has_room_for_the_vertices_of_any_patch(monkeypatch, is_simplified):
    """Compiled code does not look where its memory ends."""
    assert detail.LEAF_FACES <= detail.MAX_PATCH_FACES and 3 * detail.MAX_PATCH_FACES <= MAX_PATCH_VERTICES
    if is_simplified:
        monkeypatch.setattr(detail, "MIN_FACES_TO_SIMPLIFY", 1000)
    most = detail.MAX_PATCH_FACES if is_simplified else detail.LEAF_FACES
    soup = np.random.default_rng(2).uniform(-1, 1, (3 * 5000, 3))  # no two triangles share a vertex
    levels = make_levels(*arrays(trimesh.Trimesh(soup, np.arange(15_000).reshape(-1, 3), process=False)))
    assert (levels.n_vertices == 3 * levels.n_faces).all() and most / 2 < levels.n_faces.max() <= most
