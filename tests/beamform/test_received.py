"""What beams receive of the samples of a sector."""

import math

import numpy as np
import pytest

import sonar_gl as sg
from sonar_gl.beamform.beamformer import make_beamformer
from sonar_gl.sonar.samples import SectorSamples
from tests.support.sampled_scenes import IDEAL


@pytest.mark.parametrize("columns_per_beam", [1, 3, 12])
def test_samples_between_boxes_are_those_that_no_beam_receives(columns_per_beam):
    """Each sample of a row by itself, wider than the boxes of 0.6 degrees or narrower, returns an echo or not."""
    sonar = sg.Sonar("gaps", 900e3, 8, 50, 16.0, 20.0, 0.6, 0.5, 12.0)
    former = make_beamformer(sonar, IDEAL, sg.Sampling(columns_per_beam, 8))
    (sector,), (received,) = former.fan.sectors, former.received_u
    u, v = sector.sample_coordinates()
    j, found = sector.rows // 2, []
    echoes = np.zeros((sector.rows, sector.columns, 4), np.float32)
    for i in range(sector.columns):
        echoes[:] = 0
        echoes[j, i] = math.sqrt(1 + u[j, i] ** 2 + v[j, i] ** 2) / 6, 0, 0, 1
        found.append(former.sum_footprints([SectorSamples(sector, echoes, np.empty((0, 0)))]).total > 0)
    inside = np.abs(np.arctan(u[j])) < sector.half_width_rad
    assert sum(found) > 0 and (columns_per_beam == 1 or sum(found) < inside.sum())
    np.testing.assert_array_equal(inside & (np.searchsorted(received, u[j]) % 2 == 1), found)
