"""Stages: what they share, so that another sampling costs little."""

import numpy as np
import pytest

import sonar_gl as sg
from sonar_gl.acoustics.beam_pattern import ArrayPattern
from sonar_gl.beamform import beamformer, workspace
from sonar_gl.sonar.sampling import sampling_at
from sonar_gl.sonar.sector import SHEAR

SONAR = sg.Sonar("stage", 900e3, 64, 200, 45.0, 20.0, 1.0, 0.5, 20.0)


def test_samplings_of_the_same_columns_share_the_weights_of_their_beams(monkeypatch):
    """Columns are at most half a beam spacing wide: all coarse samplings have the same ones."""
    calls, weigh = [], beamformer.beam_weights
    monkeypatch.setattr(beamformer, "beam_weights", lambda *a: calls.append(1) or weigh(*a))
    with sg.Simulator(sg.Scene([]), SONAR, sampling=sampling_at(SONAR, 0)) as simulator:
        stages = simulator.run.stages
        calls.clear()
        with simulator.run.drawing():
            fans = [stages.stage(sampling_at(SONAR, level)).fan for level in (0, 2, 4, 20, 4)]
    edges = [fan.column_edges_rad for fan in fans]
    assert np.array_equal(edges[0], edges[2]) and len(edges[3]) > len(edges[0])
    assert len(calls) == 1  # of level 20, whose columns are narrower; the last is kept as a whole


@pytest.mark.parametrize(("kept_bytes", "n_made"), [(workspace.KEPT_BYTES, 0), (0, 1)])
def test_weights_of_few_bytes_are_kept_while_finer_samplings_are_used(kept_bytes, n_made, monkeypatch):
    """Else a live loop would find them anew in the ping in which its samples get coarse again."""
    monkeypatch.setattr(workspace, "KEPT_BYTES", kept_bytes)
    calls, weigh = [], beamformer.beam_weights
    with sg.Simulator(sg.Scene([]), SONAR, sampling=sampling_at(SONAR, 0)) as simulator:
        stages = simulator.run.stages
        with simulator.run.drawing():
            for level in (18, 20):
                stages.stage(sampling_at(SONAR, level))
            monkeypatch.setattr(beamformer, "beam_weights", lambda *a: calls.append(1) or weigh(*a))
            stages.stage(sampling_at(SONAR, 2))
    assert len(calls) == n_made


def test_what_no_sampling_changes_is_found_once(monkeypatch):
    """In a ping of a live loop that checks its error, to find it anew took a twentieth of the ping."""
    calls, power = [], ArrayPattern.power
    monkeypatch.setattr(ArrayPattern, "power", lambda *a: calls.append(np.size(a[1])) or power(*a))
    with sg.Simulator(sg.Scene([]), SONAR, sampling=sampling_at(SONAR, 0)) as simulator:
        stages = simulator.run.stages
        with simulator.run.drawing():
            stages.stage(sampling_at(SONAR, 2), -SHEAR)  # whose columns are wider: other weights
            calls.clear()
            first, other = (stages.stage(sampling_at(SONAR, 4), shear) for shear in (SHEAR, -SHEAR))
    assert not calls
    assert first.beamformer.elevation_table is other.beamformer.elevation_table
