"""The folder of a batch: its lock, unfinished files, and folders at URLs."""

from contextlib import nullcontext

import fsspec
import pytest
import xarray as xr

from sonar_gl.batch.folder import Folder
from sonar_gl.batch.manifest import check
from tests.support.batches import files_of, make_all, write_job
from tests.support.command_line import run


@pytest.mark.slow
def test_a_batch_may_be_written_to_a_url(tmp_path):
    write_job(tmp_path, 4, "[pictures]\nheight = 40\n")
    make_all(tmp_path / "job.toml", "memory://batch")
    data = xr.open_dataset("memory://batch/pings.zarr", group="level", engine="zarr")
    assert float(data.intensity.max()) > 0 and (data.status == 1).all()
    assert fsspec.filesystem("memory").exists("/batch/png/level/00000/00000003.png")
    assert check(Folder("memory://batch"), nullcontext) == []
    make_all(tmp_path / "job.toml", tmp_path / "out")
    for name, data in files_of(tmp_path / "out").items():
        assert fsspec.filesystem("memory").cat_file(f"/batch/{name}") == data


def test_unfinished_files_are_removed(tmp_path):
    folder = Folder(tmp_path)
    with folder.writing("png/1.png") as path:
        path.write_bytes(b"half")
        assert not list((tmp_path / "png").iterdir())
    assert folder.get("png/1.png") == b"half"
    with folder.writing("png/2.png") as path:  # as a killed process leaves it
        path.write_bytes(b"half")
        with folder.locked():
            assert not path.exists()
        path.parent.mkdir()
        path.touch()
    assert files_of(tmp_path).keys() == {"png/1.png", "png/2.png"}


def test_a_folder_has_one_batch_at_a_time(small, tmp_path):
    with Folder(tmp_path / "out").locked():
        status, _, err = run("batch", small / "job.toml", "--out", tmp_path / "out")
        expected = f"error: {tmp_path / 'out'}: must have one batch at a time (another is running in it)\n"
        assert (status, err) == (2, expected)
    assert [path.name for path in (tmp_path / "out").iterdir()] == [".lock"]
