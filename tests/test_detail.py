"""Fewer triangles for the same mesh: what is kept, how far they stray, that any mixture is sewn together."""

import ast
from pathlib import Path

import numpy as np
import pytest
import trimesh
from worlds import terrain

from sonar_gl import detail
from sonar_gl.detail import make_levels
from sonar_gl.simplify import _order_of, simplify


def arrays(mesh):
    return np.array(mesh.vertices, float), np.array(mesh.faces, np.int32)


def grid(n=40):
    """A flat square of (n - 1)² squares, 1 m wide, and its rim."""
    points, faces = arrays(terrain(np.random.default_rng(0), 1.0, 1.0, n))
    points[:, 2] = 0
    return points, faces, (np.abs(points[:, :2]) > 0.5 - 1e-9).any(axis=1)


def faces_per_edge(faces):
    """How many faces each edge has; and whether each has one in each direction for every one in the other."""
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
def test_a_closed_mesh_stays_closed_and_keeps_what_is_locked(name, share):
    points, faces = arrays(CLOSED[name])
    before = points.copy(), faces.copy()
    locked = np.random.default_rng(1).random(len(points)) < 0.02
    target = int(share * len(faces))
    fewer, error_m = simplify(points, faces, locked, target)
    counts, matched = faces_per_edge(fewer)
    assert matched
    assert (counts == 2).all()
    # an edge that goes takes two faces with it
    assert target - 1 <= len(fewer) <= max(target + 1, len(faces) / 7)
    assert np.isin(np.flatnonzero(locked), fewer).all()
    assert error_m > 0
    # the same kind of thing: as many holes
    euler = len(np.unique(fewer)) - len(counts) + len(fewer)
    assert euler == (0 if name == "torus" else 2)
    np.testing.assert_array_equal(points, before[0])
    np.testing.assert_array_equal(faces, before[1])


def test_all_locked_nothing_happens():
    points, faces = arrays(CLOSED["disc"])
    fewer, error_m = simplify(points, faces, np.ones(len(points), bool), 10)
    np.testing.assert_array_equal(fewer, faces)
    assert error_m == 0


def test_what_is_flat_stays_flat_and_as_large():
    points, faces, rim = grid()
    fewer, error_m = simplify(points, faces, rim, len(faces) // 10)
    assert len(fewer) < len(faces) / 8
    assert np.isin(np.flatnonzero(rim), fewer).all()
    # z is 0 and normals (0, 0, 1) to the bit
    assert error_m == 0
    assert area_vectors(points, fewer)[:, 2].sum() == pytest.approx(1.0, abs=1e-12)


def test_a_step_keeps_its_edge():
    """A floor and a wall: error 0 as long as no vertex leaves its plane, or the edge between the two."""
    points, faces, rim = grid(41)
    bent = points.copy()
    bent[:, 2], bent[:, 0] = np.maximum(points[:, 0], 0), np.minimum(points[:, 0], 0)
    fewer, error_m = simplify(bent, faces, rim, len(faces) // 8)
    assert len(fewer) < len(faces) / 5
    assert error_m < 1e-9  # rounding: a square of 1e-16 m²
    normals = area_vectors(bent, fewer)
    # none lies aslant, across the edge
    assert (np.count_nonzero(np.abs(normals) > 1e-12, axis=1) <= 1).all()
    assert np.abs(normals.sum(axis=0)) == pytest.approx([0.5, 0, 0.5], abs=1e-9)


@pytest.mark.parametrize("share", [0.7, 0.5, 0.25, 0.1, 0.02])
def test_error_tells_how_far_a_ball_is_left(share):
    """error_m is a root mean square over the planes that a vertex stands for.

    A face's middle lies deeper than their mean: it cuts through the ball between three vertices. 1.8 times as
    deep is what was found.
    """
    points, faces = arrays(CLOSED["ball"])
    fewer, error_m = simplify(points, faces, np.zeros(len(points), bool), int(share * len(faces)))
    weights = np.random.default_rng(0).dirichlet([1, 1, 1], 32)
    weights = np.concatenate([weights, np.full((1, 3), 1 / 3)])
    depths = 1 - np.linalg.norm(np.einsum("sk,fkc->fsc", weights, points[fewer]), axis=-1)
    assert depths.max() < 2 * error_m
    assert depths.max() > 0.5 * error_m  # nor does it cry wolf
    assert np.sqrt((depths**2).mean()) < error_m


def patch_faces(levels, number):
    """(n, 3) faces of a patch, by the mesh's vertices."""
    first, n = levels.first_face[number], levels.n_faces[number]
    return levels.vertices[levels.first_vertex[number] + levels.faces[first : first + n].astype(int)]


def below(levels, number):
    """Patches right below one."""
    out, at = [], number + 1
    while at < levels.skip[number]:
        out.append(at)
        at = levels.skip[at]
    return out


def by_points(faces):
    """Sorted triples, which begin with their least vertex: a face is known by them."""
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
    """A mesh and its tree, as if it were a large one."""
    monkeypatch.setattr(detail, "MANY", 1000)
    monkeypatch.setattr(detail, "LEAF", 200)
    points, faces = arrays(meshes()[request.param])
    return request.param, points, faces, make_levels(points, faces)


def test_leaves_are_the_mesh(tree):
    _, _, faces, levels = tree
    leaves = np.flatnonzero(levels.leaf)
    assert len(leaves) >= 8
    assert levels.n_faces[leaves].max() <= 200
    assert (levels.error_m[leaves] == 0).all()
    assert (levels.skip[leaves] == leaves + 1).all()
    together = np.concatenate([patch_faces(levels, number) for number in leaves])
    np.testing.assert_array_equal(by_points(together), by_points(faces))


def test_the_tree_is_one(tree):
    """Depth first, each patch but the first below one other; above, fewer faces and more error."""
    _, _, _, levels = tree
    n = len(levels.skip)
    assert levels.skip[0] == n
    above = np.zeros(n, int)
    for number in range(n):
        for one in below(levels, number):
            above[one] += 1
            assert levels.error_m[one] <= levels.error_m[number]
        real = levels.n_faces[number] > 0
        if real and not levels.leaf[number]:
            assert levels.n_faces[number] < sum(levels.n_faces[one] for one in below(levels, number))
        assert real or np.isinf(levels.error_m[number])
    assert above[0] == 0
    assert (above[1:] == 1).all()
    assert levels.n_faces[0] < 1000, "some coarser levels came about"


def cut(levels, take):
    """Patches of a way through the tree: of each that `take` takes, none below."""
    out, number = [], 0
    while number < len(levels.skip):
        if levels.leaf[number] or (levels.n_faces[number] > 0 and take(number)):
            out.append(number)
            number = levels.skip[number]
        else:
            number += 1
    return out


def test_any_mixture_of_levels_is_sewn_together(tree):
    """By chance, and by distance as a sonar chooses: every inner edge has its two faces."""
    name, points, faces, levels = tree
    rng, sizes = np.random.default_rng(0), set()
    whole = area_vectors(points, faces).sum(axis=0)
    least = levels.error_m[levels.error_m > 0].min()
    span = np.ptp(points, axis=0).max()

    def by_chance(chance):
        return lambda number: rng.random() < chance

    def by_distance(eye, strays):
        return lambda number: levels.error_m[number] <= strays * np.linalg.norm(levels.box[number, :3] - eye)

    takes = [by_chance(chance) for chance in np.repeat([0.05, 0.2, 0.5, 0.8], 4)]
    for strays in np.geomspace(least / span, 100 * least / span, 12):
        takes.append(by_distance(rng.uniform(-1, 1, 3) * span, strays))
    for take in takes:
        chosen = cut(levels, take)
        sizes.add(len(chosen))
        mixed = np.concatenate([patch_faces(levels, number) for number in chosen])
        counts, matched = faces_per_edge(mixed)
        if name == "hills":  # open: its rim has one face, of all vertices that the mesh has there
            assert counts.max() <= 2
            assert (counts == 1).sum() == (faces_per_edge(faces)[0] == 1).sum()
        else:
            assert matched
            assert (counts == 2).all()
        # what is sewn to the same rim has the same area vector
        np.testing.assert_allclose(area_vectors(points, mixed).sum(axis=0), whole, atol=1e-9 * span**2)
    assert len(sizes) > 4


def test_boxes_and_cones_hold_all_that_is_below(tree):
    _, points, _, levels = tree
    slack = 1e-9 * np.ptp(points, axis=0).max()
    for number in range(len(levels.skip)):
        middle, half = levels.box[number, :3], levels.box[number, 3:]
        for one in range(number, levels.skip[number]):
            own = patch_faces(levels, one)
            if len(own):
                assert (np.abs(points[own] - middle) <= half + slack).all()
        own = patch_faces(levels, number)
        if len(own) == 0:
            assert levels.cone[number, 3] == -1
            continue
        normals = area_vectors(points, own)
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

    own = np.array(
        [
            moment(patch_faces(levels, n)) if levels.n_faces[n] else np.zeros(6)
            for n in range(len(levels.skip))
        ]
    )
    np.testing.assert_allclose(levels.moment, own, atol=1e-9 * np.abs(own).max())
    for number in range(len(levels.skip)):
        leaves = [one for one in range(number, levels.skip[number]) if levels.leaf[one]]
        np.testing.assert_allclose(
            levels.whole[number], own[leaves].sum(axis=0), atol=1e-9 * np.abs(own).max()
        )


def test_a_small_mesh_is_one_patch_and_a_larger_one_has_no_coarser_levels(monkeypatch):
    monkeypatch.setattr(detail, "LEAF", 200)
    points, faces = arrays(trimesh.creation.icosphere(1))
    levels = make_levels(points, faces)
    assert levels.n_faces.tolist() == [80]
    assert levels.leaf.tolist() == [True]
    points, faces = arrays(CLOSED["ball"])
    levels = make_levels(points, faces)
    assert levels.n_faces[~levels.leaf].sum() == 0
    assert np.isinf(levels.error_m[~levels.leaf]).all()
    assert levels.n_faces[levels.leaf].sum() == len(faces)
    np.testing.assert_allclose(levels.box[0], [0, 0, 0, 1, 1, 1], atol=1e-2)  # of all, though it has no faces


def test_what_is_flat_is_not_folded():
    points, faces, rim = grid()
    fewer, _ = simplify(points, faces, rim, len(faces) // 10)
    assert (area_vectors(points, fewer)[:, 2] > 0).all()  # none without area, none that lies on another


def test_a_floor_and_a_wall_are_not_folded():
    points, faces, rim = grid(41)
    bent = points.copy()
    bent[:, 2], bent[:, 0] = np.maximum(points[:, 0], 0), np.minimum(points[:, 0], 0)
    fewer, _ = simplify(bent, faces, rim, len(faces) // 8)
    assert np.abs(area_vectors(bent, fewer)).sum(axis=0) == pytest.approx([0.5, 0, 0.5], abs=1e-9)


def test_no_machine_code_is_kept_that_may_be_taken_for_anothers():
    """Numba names the parts of np.sort and np.argsort by numbers that another process gives to others."""
    package = Path(detail.__file__).parent
    for path in package.glob("*.py"):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        for function in ast.walk(tree):
            marks = [ast.unparse(one) for one in getattr(function, "decorator_list", ())]
            if any(mark.startswith("compiled") for mark in marks):
                called = {ast.unparse(call.func) for call in ast.walk(function) if isinstance(call, ast.Call)}
                sorts = {name for name in called if name.endswith((".sort", ".argsort")) or name == "sorted"}
                assert not sorts, f"{path.name}: {function.name}"


@pytest.mark.parametrize("n", [0, 1, 2, 3, 1000, 4097])
def test_costs_are_put_in_order(n):
    costs = np.random.default_rng(n).integers(0, 50, n).astype(float)  # with ties
    assert np.array_equal(_order_of(costs), np.argsort(costs, kind="stable"))
