"""Compilation of numerical kernels before the first ping, so that all pings cost alike."""

from __future__ import annotations

import numpy as np

from sonar_gl.beamform.bubbles import find_shadow
from sonar_gl.core.compiled import announce_compilation
from sonar_gl.core.poses import check_pose
from sonar_gl.engine.run import Run
from sonar_gl.engine.stage import with_bubbles
from sonar_gl.sonar.sampling import sampling_of_width

COARSE_DEG = 180.0
A_BUBBLE = np.array([[2.0, 0.0, 0.0, 0.005]])
_warm = set()


def warm_up(run: Run) -> None:
    """Draw and sum a few samples in the first run of a process: kernels are compiled, or read, when first used."""
    has_bubbles = run.instrument.acoustics.bubbles and bool(run.world.scene.plumes)
    needed = {"surfaces", "bubbles"} if has_bubbles else {"surfaces"}
    if needed <= _warm:
        return
    announce_compilation()
    with run.drawing():
        stage = run.stages.make(sampling_of_width(run.instrument.sonar, COARSE_DEG))
        pose = check_pose(np.eye(4))  # read-only, as in pings
        (view,) = stage.renderer.render([pose], full=True)
        if has_bubbles:
            view = with_bubbles(view, find_shadow(A_BUBBLE, pose, stage.fan))
        stage.beamformer.sum_view(view, run.instrument.gain)
    _warm.update(needed)
