"""The memory that beamformers of one sonar share."""

import numpy as np

import sonar_gl as sg
from sonar_gl.beamform import workspace as workspace_module
from sonar_gl.beamform.beamformer import make_beamformer
from sonar_gl.beamform.kernels.body_sums import LabelRoom
from sonar_gl.beamform.workspace import LabelSums, Workspace
from sonar_gl.sonar.fan import Fan
from tests.support.fans import view_of_points

SONAR = sg.Sonar("shared", 900e3, 32, 100, 30.0, 10.0, 1.0, 0.5, 10.0)
# of few columns, of many, of few again
SAMPLINGS = sg.Sampling(3, 16), sg.Sampling(9, 40), sg.Sampling(3, 16)


def points_in(fan: Fan, seed: int) -> np.ndarray:
    """Return some point scatterers in a fan."""
    rng, n = np.random.default_rng(seed), 200
    azimuth = rng.uniform(fan.column_edges_rad[0], fan.column_edges_rad[-1], n)
    return np.column_stack([azimuth, rng.uniform(-0.05, 0.05, n), rng.uniform(1, 9, n), rng.uniform(1, 2, n)])


def test_samplings_of_other_columns_sum_in_one_table():
    """A check of the error sums two samplings; to make and clear a table for each took more time than the sums."""
    workspace = Workspace()
    workspace.column_sums(900, SONAR.n_bins)
    few, many = (workspace.column_sums(n, SONAR.n_bins) for n in (300, 900))
    assert len(few.sums) == len(few.spans) == 300
    assert len(many.sums) == len(many.spans) == 900
    for one, other in ((few.sums, many.sums), (few.spans, many.spans), (few.all_sums, many.all_sums)):
        assert np.shares_memory(one, other)


def test_what_another_sampling_summed_leaves_no_echo():
    workspace, n_columns = Workspace(), []
    for number, sampling in enumerate(SAMPLINGS):
        shared, alone = (
            make_beamformer(SONAR, sg.Acoustics.physical(), sampling, workspace=space)
            for space in (workspace, Workspace())
        )
        view, gain = (
            view_of_points(shared.fan, points_in(shared.fan, number)),
            np.ones(SONAR.n_bins, np.float32),
        )
        found, expected = (former.sum_view(view, gain) for former in (shared, alone))
        assert expected.total > 0
        np.testing.assert_array_equal(found.intensity, expected.intensity)
        assert found.total == expected.total
        n_columns.append(shared.fan.n_columns)
    assert n_columns[1] > n_columns[0] == n_columns[2]


def test_room_for_labels_grows_to_twice_what_was_needed_and_never_shrinks(monkeypatch):
    for name, size in (("SLOTS", 2), ("RUNS", 10), ("POOL", 100)):
        monkeypatch.setattr(workspace_module, name, size)
    sums, half = LabelSums(n_bins=8), 1
    cells = sums.cells[half]

    def state():
        runs, n_runs, pool, n_pool = sums.stores[half]
        return len(runs), n_runs, len(pool), n_pool

    assert sums.take(half, LabelRoom(2, 10, 100))
    assert state() == (10, 10, 100, 100)
    assert not sums.take(half, LabelRoom(2, 11, 60))
    assert state() == (22, 0, 120, 0)
    assert not sums.take(half, LabelRoom(1, 5, 121))
    assert state() == (22, 0, 242, 0)
    assert sums.cells[half] is cells
    assert not sums.take(half, LabelRoom(3, 22, 242))
    assert sums.cells[half].shape == (3, *cells.shape[1:]) and not sums.cells[half].any()
    assert state() == (22, 0, 242, 0)
