"""Only the window of a sector that holds bodies is drawn, which does not change the ping."""

import math

import numpy as np
import pytest
import trimesh

import sonar_gl as sg
from sonar_gl.raster.scene_meshes import SceneMeshes
from sonar_gl.raster.views import SectorView, stacked
from tests.support.worlds import random_world


def draw_window(scene, sonar, pose, sampling):
    """Return samples of windows, the same of full sectors, the number of hits outside, and the share drawn."""
    with sg.Simulator(scene, sonar, sg.Acoustics.ideal(), sampling) as simulator, simulator.run.drawing():
        stage = simulator.run.sampler.resolution.stage
        sectors = simulator.fan.sectors
        (view,) = stage.renderer.render([pose])
        windows = [(sector, plane_echo.copy()) for sector, plane_echo, *_ in view.sectors]
        (view,) = stage.renderer.render([pose], full=True)
        full_sectors = [plane_echo.copy() for _, plane_echo, *_ in view.sectors]
    in_window, in_full, n_outside = [], [], 0
    for (window, part), sector, full in zip(windows, sectors, full_sectors, strict=True):
        # the window's offset follows from its first ray
        lattice = np.array([[sector.u[1], sector.u[2]], [sector.v[1], sector.v[2]]])
        offset = [window.u[0] - sector.u[0], window.v[0] - sector.v[0]]
        i, j = np.rint(np.linalg.solve(lattice, offset)).astype(int)
        within = full[j : j + window.rows, i : i + window.columns]
        in_window.append(part.reshape(-1, 4))
        in_full.append(within.reshape(-1, 4))
        n_outside += int((full[..., 0] > 0).sum() - (within[..., 0] > 0).sum())
    in_window, in_full = np.concatenate(in_window), np.concatenate(in_full)
    return in_window, in_full, n_outside, len(in_window) / sum(full[..., 0].size for full in full_sectors)


def check_same(in_window, in_full, n_outside):
    """Check that the same rays hit the same surfaces, except at edges within rounding of a ray."""
    assert n_outside == 0
    same = np.isclose(in_window[:, 0], in_full[:, 0], rtol=1e-3)
    assert (~same).sum() <= 1 + 0.002 * (in_full[:, 0] > 0).sum()


@pytest.mark.parametrize(
    "seed", [*range(5), *(pytest.param(n, marks=pytest.mark.slow) for n in range(5, 20))]
)
def test_a_window_has_the_samples_of_the_full_sector(seed):
    scene, sonar, pose = random_world(seed)
    *hits, _ = draw_window(scene, sonar, pose, sg.Sampling(1, 100))
    check_same(*hits)


def test_a_rod_needs_a_small_window():
    sonar = sg.load_sonar("p900-45")
    rod = trimesh.creation.cylinder(0.005, 1.0, sections=16)
    level = trimesh.transformations.rotation_matrix(math.pi / 2, [1, 0, 0])
    for turn in (np.eye(4), level):
        scene = sg.Scene([sg.Body("rod", rod, sg.pose(15, 2, 0.3) @ turn)])
        *hits, share = draw_window(scene, sonar, np.eye(4), sg.Sampling(8, 800))
        check_same(*hits)
        assert (hits[0][:, 0] > 0).sum() > 50
        # the rod is 3.8 degrees long, in a fan of 45 by 20 degrees, oblique to the lattice
        assert share < 0.02


def test_the_window_has_every_ray_that_hits_a_box():
    """Boxes ahead of, behind, above and around the sonar are compared with ray intersections."""
    rng = np.random.default_rng(0)
    sonar = sg.load_sonar("p900-90")
    with sg.Simulator(sg.Scene([]), sonar, sampling=sg.Sampling(0.2, 30)) as simulator:
        sectors = simulator.fan.sectors
    some = 0
    for _ in range(60):
        box = trimesh.creation.box(rng.uniform(0.1, 8, 3))
        pose = trimesh.transformations.random_rotation_matrix(rng.random(3))
        pose[:3, 3] = rng.uniform(-8, 8, 3)
        meshes = SceneMeshes()
        meshes.add([sg.Body("box", box, pose)])
        for sector in sectors:
            bodies = meshes.view_from(np.eye(4))
            room = np.empty((1, meshes.most_patches, 2), np.int32)
            ((*_, i, j, columns, rows),) = meshes.choose(
                stacked([SectorView(sector, 1e3, 1e3)]), bodies, room
            )
            u, v = sector.sample_coordinates()
            d = np.stack([np.ones_like(u), -u, v], axis=-1) @ sector.rotation() @ pose[:3, :3]
            origin = -pose[:3, 3] @ pose[:3, :3]
            with np.errstate(divide="ignore", invalid="ignore"):
                t = (box.bounds[:, None, None] - origin) / d
            near, far = t.min(axis=0).max(axis=-1), t.max(axis=0).min(axis=-1)
            met = (far >= near) & (far > 1e-3)
            inside = np.zeros_like(met)
            inside[j : j + rows, i : i + columns] = True
            assert not (met & ~inside).any()
            some += met.any() and not inside.all()
    assert some > 20


def test_without_bodies_ahead_nothing_is_drawn():
    behind = sg.Scene([sg.Body("box", trimesh.creation.box((1, 1, 1)), sg.pose(-5))])
    samples, _, n_outside, share = draw_window(
        behind, sg.load_sonar("p900-45"), np.eye(4), sg.Sampling(1, 100)
    )
    assert len(samples) == n_outside == share == 0


def test_what_lies_between_samples_is_left_out_as_a_whole_or_face_by_face():
    """A face far above each body, and one far below, make its box so high that none lies between samples."""
    rng, corners = np.random.default_rng(0), []
    for _ in range(300):
        size = rng.uniform(
            -0.15, 0.15, 3
        )  # with the opposite corner, so that the middle of the box is the origin
        corners.append([size, -size, rng.uniform(-1, 1, 3) * size])
    wing = 1e-3 * np.array([[-1, 0, 0], [1, 0, 0], [0, 1, 0]])
    places = [sg.pose(*rng.uniform((3, -6, -2), (16, 6, 2))) for _ in corners]
    views = []
    for has_wings in (False, True):
        bodies = []
        for k, (triangle, place) in enumerate(zip(corners, places, strict=True)):
            up = np.array([0, 0, 40])
            wings = [wing + up, wing * [1, -1, 1] - up] if has_wings else []
            points = np.concatenate([triangle, *wings])
            faces = np.arange(len(points)).reshape(-1, 3)
            bodies.append(sg.Body(str(k), trimesh.Trimesh(points, faces, process=False), place))
        samples, _, n_outside, _ = draw_window(
            sg.Scene(bodies), sg.load_sonar("p900-45"), np.eye(4), sg.Sampling(0.4, 24)
        )
        views.append(samples)
        assert n_outside == 0
    met = [view[view[:, 0] > 0] for view in views]
    assert np.array_equal(*met)
    assert 20 < len(met[0]) < 200  # most bodies lie between samples


@pytest.mark.parametrize("engine", ["cpu", "opengl"])
def test_a_view_is_summed_as_its_sectors_are(engine):
    """In one call, to the bit; the engine that knows leaves out sectors in which nothing is."""
    floor = sg.Body("floor", trimesh.creation.box((60, 60, 0.1)), sg.pose(0, 0, -4), 0.3)
    ball = sg.Body("ball", trimesh.creation.icosphere(2, 0.5), sg.pose(6, 1, 0))
    device = sg.Acoustics.physical()
    with sg.Simulator(
        sg.Scene([floor, ball]), sg.load_sonar("p900-45"), device, sg.Sampling(1, 60), engine=engine
    ) as simulator:
        run = simulator.run
        stage, gain = run.sampler.resolution.stage, np.linspace(1, 2, run.instrument.sonar.n_bins)
        with run.drawing():
            (view,) = stage.draw([np.eye(4)], [None], with_bodies=True)
            gain = gain.astype(np.float32)
            whole = stage.beamformer.sum_view(view, gain)
            parts = stage.beamformer.sum_footprints(view.sectors, gain, view.body_spans)
    np.testing.assert_array_equal(whole.intensity, parts.intensity)
    assert whole.total == parts.total > 0
    if engine == "cpu":
        is_dark = np.array([not one.plane_echo.any() for one in view.sectors])
        assert 0 < is_dark.sum() < len(is_dark)
        np.testing.assert_array_equal(view.table[0][:, 2] == 0, is_dark)
