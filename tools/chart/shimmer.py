"""Measure shimmer: the false part of a ping's change while the sonar creeps by a fraction of a bin."""

from __future__ import annotations

from contextlib import closing
from functools import partial

import numpy as np

import sonar_gl as sg
from tools.bench import harness
from tools.chart.rivals.methods import METHODS
from tools.chart.rivals.rays import PointRays
from tools.chart.scenes import BEAMS, make_scene, make_sonar

SHOWN = ("ours", "raster_point", "rays_regular", "rays_jittered")
STEP_BINS, STEPS = 0.25, 5
TRUTH_RESOLUTION = {"wide": (8, 3000), "narrow": (16, 1600)}
FANS = 3  # differently jittered fans of rays in each half of the truth


def changes(scene, sonar, beams: str, poses):
    """Return the true changes between poses, (STEPS, B, K) float64, and their uncertainty.

    All poses take the same rays, and several such fans are averaged. Half the difference of two halves of the
    fans, relative to the true change, estimates the false change that remains.
    """
    halves = np.zeros((2, len(poses), sonar.n_beams, sonar.n_bins))
    for fan in range(2 * FANS):
        rays = PointRays(
            scene,
            sonar,
            sg.Acoustics.ideal(),
            poses[0],
            TRUTH_RESOLUTION[beams],
            jittered=True,
            seed=1000 + fan,
        )
        for number, pose in enumerate(poses):
            halves[fan % 2, number] += rays.ping(pose) / FANS
    steps = np.diff(halves, axis=1)
    true = steps.mean(axis=0)
    return true, float(np.abs(steps[0] - steps[1]).sum() / 2 / np.abs(true).sum())


def ping_three(rival, poses, number: int):
    """Ping from three of the poses, by turns others."""
    for pose in (poses[number % 2], poses[2 + number % 2], poses[4]):
        rival.ping(pose)


def shimmer(rounds: int):
    """Return rows (beams, method, resolution, ms_median, shimmer) of the pylon; the truth's uncertainties."""
    scene, acoustics, rows, uncertainties = make_scene("pylon"), sg.Acoustics.ideal(), [], {}
    for beams in BEAMS:
        sonar = make_sonar("pylon", beams)
        poses = [scene.sonar_pose @ sg.pose(x=STEP_BINS * k * sonar.bin_size_m) for k in range(STEPS + 1)]
        true, uncertainties[beams] = changes(scene, sonar, beams, poses)
        rivals = {
            (name, resolution): METHODS[name].make(scene, sonar, acoustics, poses[0], resolution)
            for name in SHOWN
            for resolution in METHODS[name].resolutions(beams, False)[:-1]
        }

        contenders = {key: partial(ping_three, rival, poses) for key, rival in rivals.items()}
        times = harness.take_turns(contenders, max(1, rounds // 3), warm_up=1)
        for (name, resolution), rival in rivals.items():
            with closing(rival):
                pings = np.array([rival.ping(pose) for pose in poses], np.float64)
            rows.append(
                {
                    "beams": beams,
                    "method": name,
                    "resolution": "x".join(f"{n:g}" for n in resolution),
                    "ms_median": float(np.median(times[name, resolution])) / 3,
                    "shimmer": float(np.abs(np.diff(pings, axis=0) - true).sum() / np.abs(true).sum()),
                }
            )
    return rows, uncertainties
