"""The table of numbers per ping."""

import numpy as np
import pytest
import xarray as xr

from sonar_gl.batch.job import Job, read_job
from sonar_gl.batch.ping_table import PingTable
from sonar_gl.batch.requests import BatchRequests
from tests.support.batch_pings import N_SMALL
from tests.support.batches import write_job
from tests.support.command_line import BODY, WALL
from tests.support.errors import error_of


@pytest.mark.slow
def test_varied_values_are_stored(small, requests):
    data = xr.open_dataset(small / "out" / "pings.zarr", group="level")
    n_present = 0
    for number in range(N_SMALL):
        request, stored = requests[number], data.isel(ping=number)
        assert float(stored.water_temperature_c) == request.water.temperature_c
        assert float(stored.noise_ambient_db) == request.noise.ambient_db
        pose = request.bodies["box_1"]
        assert np.isnan(stored.moved_pose[0, :3]).all() == (pose is None)
        if pose is not None:
            n_present += 1
            assert np.array_equal(stored.moved_pose[0], pose)
            assert float(stored.reflectivity[0]) == request.reflectivity["box_1"]
    assert 0 < n_present < N_SMALL
    assert data.moved_pose.attrs["bodies"] == ["box_1"]


def test_bubbles_have_neither_a_reflectivity_nor_a_size(tmp_path):
    """Where they move with bodies, the store holds that of the bodies alone; a table of bubbles alone is refused."""
    path = write_job(tmp_path, 1, "")
    diver = BODY.format("diver", "3 0 -0.2", "0.2 0.2 0.1")
    diver = diver.replace("</link>", "<sonar_gl:bubbles name='breath'/></link>")
    (tmp_path / "tank.sdf").write_text(f'<sdf version="1.9"><world name="tank">{diver}{WALL}</world></sdf>')
    plain = read_job(path).plain

    def found(names, **more):
        return BatchRequests(Job(**plain | {"vary": {"bodies": [{"names": names, **more}]}}))

    table = PingTable(found(["diver", "breath"], reflectivity=0.5, x_m=0.1))
    assert table.moved == [(0, "diver"), (0, "breath")]
    assert table.with_reflectivity == [(0, "diver")]
    for key in ("reflectivity", "scale"):
        assert error_of(lambda key=key: PingTable(found(["breath"], **{key: 0.5}))) == (
            f"{path}: vary.bodies[0].{key} must be that of bodies (got bubbles alone, which have none)"
        )
