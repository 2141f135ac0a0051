"""The manifest of a batch, and the check of its files."""

import json
import shutil

import numpy as np
import pytest

from sonar_gl.batch.manifest import Manifest, default_pings_per_part
from tests.support.batch_pings import N_SMALL
from tests.support.batches import LABELS, MORE, files_of, make_all, write_job
from tests.support.command_line import run


def test_the_size_of_parts_follows_from_that_of_pings():
    assert default_pings_per_part(1e9, 10**6) == 8
    assert default_pings_per_part(1.0, 10**6) == 128
    assert default_pings_per_part(1e6, 10**6) == 128
    assert default_pings_per_part(4e6, 10**6) == 32
    manifest = Manifest({}, "", 10, 4, None, {})
    assert manifest.n_parts == 3 and list(manifest.numbers(2)) == [8, 9]


def test_a_small_job_has_parts_for_many_processes():
    n_pings = np.arange(1, 20_000)
    sizes = np.array([default_pings_per_part(1.0, int(n)) for n in n_pings])
    n_parts = -(-n_pings // sizes)
    assert (sizes % 8 == 0).all() and (np.diff(sizes) >= 0).all()
    assert (n_parts[n_pings < 64 * 8] == -(-n_pings[n_pings < 64 * 8] // 8)).all()  # a chunk each
    assert n_parts[n_pings >= 64 * 8].min() >= 64


@pytest.mark.slow
def test_a_job_elsewhere_gives_the_same_bytes_but_for_its_path(tmp_path):
    made = []
    for name in ("here", "there"):
        (tmp_path / name).mkdir()
        make_all(write_job(tmp_path / name, 2, LABELS + MORE), tmp_path / name / "out")
        made.append(files_of(tmp_path / name / "out"))
        path = str(tmp_path / name / "job.toml")
        assert json.loads(made[-1]["batch.json"])["job"]["where"] == path
    assert {name for name in made[0] | made[1] if made[0].get(name) != made[1].get(name)} == {"batch.json"}


@pytest.mark.slow
def test_damage_is_found_and_mended(small, tmp_path):
    copy = shutil.copytree(small / "out", tmp_path / "copy")
    status, out, _ = run("batch", "--check", copy)
    assert (status, out) == (0, f"{copy}: all files are as they were written\n")
    one = copy / "pings.zarr" / "level" / "intensity" / "c" / "1" / "0" / "0"
    data = bytearray(one.read_bytes())
    data[len(data) // 2] ^= 1
    one.write_bytes(data)
    two = next((copy / "png").rglob("*.png"))
    two.unlink()
    three = copy / "pings.zarr" / "level" / "time_s" / "c" / "0"
    three.write_bytes(b"")
    status, out, _ = run("batch", "--check", copy)
    assert status == 1
    assert f"{one}: has changed since it was written\n" in out and f"{two}: is missing\n" in out
    assert f"{three}: has changed since it was written\n" in out
    assert out.endswith(f"{copy}: 3 files are missing or damaged\n")

    # to mend it, only damaged parts are made again
    untouched = copy / "parts" / "0000002.json"
    before, expected = untouched.stat().st_mtime_ns, files_of(small / "out")
    status, out, err = run("batch", small / "job.toml", "--out", copy, "--resume", "--mend", "--workers", "1")
    assert (status, out) == (0, f"{copy}: {N_SMALL} of {N_SMALL} pings\n")
    assert f"{one}: has changed since it was written\n" in err
    assert untouched.stat().st_mtime_ns == before
    assert files_of(copy) == expected
    status, _, err = run("batch", "--check", tmp_path / "nowhere")
    assert status == 2 and "must be the folder of a batch" in err and not (tmp_path / "nowhere").exists()


@pytest.mark.slow
def test_the_error_for_a_damaged_part_says_how_to_make_it_again(small, tmp_path):
    copy = shutil.copytree(small / "out", tmp_path / "copy")
    (copy / "done.json").unlink()
    table, record = copy / "parts" / "0000001.npy", copy / "parts" / "0000001.json"
    table.write_bytes(b"half")
    status, _, err = run("batch", small / "job.toml", "--out", copy, "--resume", "--workers", "1")
    assert status == 2
    assert f"error: {table}: must be the table of a part (it is damaged; delete parts/0000001.json" in err
    record.unlink()
    status, shown, _ = run("batch", small / "job.toml", "--out", copy, "--resume", "--workers", "1")
    assert (status, shown) == (0, f"{copy}: {N_SMALL} of {N_SMALL} pings\n")
    assert files_of(copy) == files_of(small / "out")
