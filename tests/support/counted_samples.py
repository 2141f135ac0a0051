"""What a sonar receives of the samples of its beams, and how many of them meet each body."""

import numpy as np

from sonar_gl.engine.body_counts import count_bodies
from sonar_gl.engine.reception import Reception
from tests.support.sampled_scenes import SONAR


def reception_of(beamformer, sonar, gain=None):
    """What a sonar receives of its beams alone, with a gain of 1 unless another is given."""
    gain = np.ones(sonar.n_bins, np.float32) if gain is None else gain
    tables = beamformer.elevation_table, beamformer.received_parts
    return Reception(sonar, 0.0, beamformer.fan.max_elevation_rad, beamformer.fan.are_cones, gain, *tables)


def count_samples(simulator):
    run = simulator.run
    stage, gain = run.sampler.resolution.stage, run.instrument.gain
    with run.drawing():
        (view,) = stage.draw([np.eye(4)], [None], with_bodies=True)
        reception = reception_of(stage.beamformer, SONAR, gain)
        return count_bodies(view, len(simulator.scene.bodies), reception).samples
