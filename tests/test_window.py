"""Only the part of a sector that holds bodies is drawn, and the ping is the same as if all were."""

import math

import numpy as np
import pytest
import trimesh
from worlds import random_world

import sonar_gl as sg
from sonar_gl.draws import Draws, SectorView
from sonar_gl.stock import Stock


def drawn(scene, sonar, pose, sampling):
    """Samples of the windows, of the whole sectors there, hits of the whole elsewhere, share of it drawn."""
    with sg.Simulator(scene, sonar, sg.Acoustics.ideal(), sampling) as simulator, simulator._drawing():
        one = simulator._samples.now
        cut = [plane_echo.copy() for _, plane_echo, _ in one.views(pose)]
        windows = one.renderer.windows
        whole = [plane_echo.copy() for _, plane_echo, _ in one.views(pose, whole=True)]
    here, there, elsewhere = [], [], 0
    for part, (i, j, columns, rows), full in zip(cut, windows, whole, strict=True):
        within = full[j : j + rows, i : i + columns]
        here.append(part.reshape(-1, 4))
        there.append(within.reshape(-1, 4))
        elsewhere += int((full[..., 0] > 0).sum() - (within[..., 0] > 0).sum())
    here, there = np.concatenate(here), np.concatenate(there)
    return here, there, elsewhere, len(here) / sum(full[..., 0].size for full in whole)


def check_same(here, there, elsewhere):
    """The same rays meet the same surfaces, but for edges that pass a ray within rounding."""
    assert elsewhere == 0
    same = np.isclose(here[:, 0], there[:, 0], rtol=1e-3)
    assert (~same).sum() <= 1 + 0.002 * (there[:, 0] > 0).sum()


@pytest.mark.parametrize("seed", range(30))
def test_the_rays_are_those_of_the_whole_sector(seed):
    scene, sonar, pose = random_world(seed)
    *hits, _ = drawn(scene, sonar, pose, sg.Sampling(1, 100))
    check_same(*hits)


def test_a_rod_costs_what_it_fills():
    sonar = sg.load_sonar("p900-45")
    rod = trimesh.creation.cylinder(0.005, 1.0, sections=16)
    level = trimesh.transformations.rotation_matrix(math.pi / 2, [1, 0, 0])
    for turn in (np.eye(4), level):
        scene = sg.Scene([sg.Body("rod", rod, sg.pose(15, 2, 0.3) @ turn)])
        *hits, share = drawn(scene, sonar, np.eye(4), sg.Sampling(8, 800))
        check_same(*hits)
        assert (hits[0][:, 0] > 0).sum() > 50
        # 3.8 degrees long, in 45 by 20 degrees; the lattice's lines run aslant to it
        assert share < 0.02


def test_every_ray_that_meets_a_box_is_in_the_window():
    """Boxes before, behind, above and about the sonar, against rays met one by one."""
    rng = np.random.default_rng(0)
    sonar = sg.load_sonar("p900-90")
    with sg.Simulator(sg.Scene([]), sonar, sampling=sg.Sampling(0.2, 30)) as simulator:
        sectors = simulator.fan.sectors
    some = 0
    for _ in range(60):
        box = trimesh.creation.box(rng.uniform(0.1, 8, 3))
        pose = trimesh.transformations.random_rotation_matrix(rng.random(3))
        pose[:3, 3] = rng.uniform(-8, 8, 3)
        stock = Stock()
        stock.add([sg.Body("box", box, pose)])
        for sector in sectors:
            i, j, columns, rows = stock.see(SectorView(sector), stock.place(np.eye(4)), 1e3, 1e3, 0, Draws())[
                -1
            ]
            u, v = sector.rays()
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


def test_nothing_before_the_sonar_draws_nothing():
    behind = sg.Scene([sg.Body("box", trimesh.creation.box((1, 1, 1)), sg.pose(-5))])
    here, _, elsewhere, share = drawn(behind, sg.load_sonar("p900-45"), np.eye(4), sg.Sampling(1, 100))
    assert len(here) == elsewhere == share == 0
