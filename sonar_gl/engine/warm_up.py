"""Compilation of numerical kernels before the first ping, so that all pings cost alike."""

from __future__ import annotations

import numpy as np

from sonar_gl.core.compiled import announce_compilation
from sonar_gl.core.poses import check_pose
from sonar_gl.engine.run import Run
from sonar_gl.sonar.sampling import sampling_of_width

COARSE_DEG = 180.0
_is_warm = False


def warm_up(run: Run) -> None:
    """Draw and sum a few samples in the first run of a process: kernels are compiled when first used."""
    global _is_warm
    if not _is_warm:
        announce_compilation()
        with run.drawing():
            stage = run.stages.make(sampling_of_width(run.instrument.sonar, COARSE_DEG))
            (view,) = stage.renderer.render([check_pose(np.eye(4))], full=True)  # read-only, as in pings
            stage.beamformer.sum_view(view, run.instrument.gain)
        _is_warm = True
