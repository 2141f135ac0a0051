"""Shimmer: how much of a ping's change, while the sonar creeps by a fraction of a bin, is false."""

from __future__ import annotations

from contextlib import closing
from time import perf_counter

import numpy as np
from chart_scenes import BEAMS, make_scene, make_sonar
from rivals.methods import METHODS
from rivals.rays import PointRays

import sonar_gl as sg

SHOWN = ("ours", "raster_point", "rays_regular", "rays_jittered")
STEP_BINS, STEPS = 0.25, 5
TRUTH_RUNG = {"wide": (8, 3000), "narrow": (16, 1600)}
FANS = 3  # of differently jittered rays, in each half of the truth


def changes(scene, sonar, beams: str, poses):
    """The true changes between poses, (STEPS, B, K) float64, and their doubt.

    The same rays look from all poses, and many such fans are averaged: what is left of their own false change
    is half the difference of two halves of the fans, given relative to the true change.
    """
    halves = np.zeros((2, len(poses), sonar.n_beams, sonar.n_bins))
    for fan in range(2 * FANS):
        rays = PointRays(
            scene, sonar, sg.Acoustics.ideal(), poses[0], TRUTH_RUNG[beams], jittered=True, seed=1000 + fan
        )
        for number, pose in enumerate(poses):
            halves[fan % 2, number] += rays.ping(pose) / FANS
    steps = np.diff(halves, axis=1)
    true = steps.mean(axis=0)
    return true, float(np.abs(steps[0] - steps[1]).sum() / 2 / np.abs(true).sum())


def shimmer(repeats: int):
    """Rows of beams, method, rung, ms_median, shimmer on the pylon scene; and the truth's doubt by beams."""
    scene, acoustics, rows, doubts = make_scene("pylon"), sg.Acoustics.ideal(), [], {}
    for beams in BEAMS:
        sonar = make_sonar("pylon", beams)
        poses = [scene.sonar_pose @ sg.pose(x=STEP_BINS * k * sonar.bin_size_m) for k in range(STEPS + 1)]
        true, doubts[beams] = changes(scene, sonar, beams, poses)
        contenders = []
        for name in SHOWN:
            for rung in METHODS[name].ladder(beams, False)[:-1]:
                contenders.append(
                    (name, rung, METHODS[name].make(scene, sonar, acoustics, poses[0], rung), [])
                )
        for number in range(1 + max(1, repeats // 3)):
            for _, _, contender, times in contenders:
                for pose in (poses[number % 2], poses[2 + number % 2], poses[4]):
                    start = perf_counter()
                    contender.ping(pose)
                    times.append(1e3 * (perf_counter() - start))
        for name, rung, contender, times in contenders:
            with closing(contender):
                pings = np.array([contender.ping(pose) for pose in poses], np.float64)
            rows.append(
                {
                    "beams": beams,
                    "method": name,
                    "rung": "x".join(f"{n:g}" for n in rung),
                    "ms_median": float(np.median(times[3:])),
                    "shimmer": float(np.abs(np.diff(pings, axis=0) - true).sum() / np.abs(true).sum()),
                }
            )
    return rows, doubts
