"""A power failure at any moment: no record is on the disk without all that it names, and the batch goes on."""

import hashlib
import shutil

import pytest

from sonar_gl.batch import folder as folder_module
from sonar_gl.batch.folder import Folder
from sonar_gl.batch.job import read_job
from sonar_gl.batch.manifest import DoneRecord, Manifest, PartRecord, record_name, recorded_parts
from tests.support.batches import files_of, write_plain_job
from tests.support.disk_log import DiskLog
from tests.support.inline_pool import run_batch, use_inline_pool

N, PART = 4, 2
OUTPUTS = '[labels]\nlayers = ["body"]\n[coco]\nheight = 40\n[ros]\n'


@pytest.fixture(autouse=True)
def _in_this_process(monkeypatch):
    use_inline_pool(monkeypatch)


@pytest.fixture
def job(tmp_path):
    """One sonar, nothing that varies, three outputs."""
    return read_job(write_plain_job(tmp_path, N, PART, OUTPUTS))


def files_of_records(out):
    """Return name -> SHA-256 of all that records name; an undamaged record is what all of them must be."""
    folder, files = Folder(out), {}
    parts, done = recorded_parts(folder), DoneRecord.load(folder)
    assert Manifest.load(folder) is not None or not (parts or done)
    assert done is None or parts == list(range(done.parts))
    for part in parts:
        files |= PartRecord.load(folder, part).files
    return files | (done.files if done else {})


def put(files, out):
    """Have these files alone in a folder."""
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir()
    for name, data in files.items():
        path = out / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)


def remains_of(log):
    """Yield (event, files, whether to resume the batch, which takes time) of all that power failures may leave."""
    seen = set()
    for number, moment in enumerate(log.moments):
        for kind, files in enumerate(moment.remains(seed=number)):
            if (key := frozenset(files.items())) not in seen:
                seen.add(key)
                yield f"moment {number}, {moment.event}", files, kind < 2


def is_whole(files, name, checksum):
    return name in files and hashlib.sha256(files[name]).hexdigest() == checksum


@pytest.fixture
def unflushed(monkeypatch):
    """Real flushes would only take time."""
    for name in ("sync", "sync_file_system"):
        monkeypatch.setattr(folder_module, name, lambda _path: None)


@pytest.mark.slow
@pytest.mark.usefixtures("unflushed")
def test_a_batch_can_be_resumed_after_a_power_failure_at_any_moment(job, tmp_path, monkeypatch):
    whole, out = tmp_path / "whole", tmp_path / "out"
    whole.mkdir()
    with monkeypatch.context() as patch:
        log = DiskLog(whole, patch)

        def check_that_parts_are_on_the_disk():
            assert {record_name(part) for part in recorded_parts(Folder(whole))} <= {*log.moments[-1].kept}

        run_batch(job, whole, check_that_parts_are_on_the_disk)
    expected = files_of(whole)
    on_disk = {path: contents for path, contents in log.moments[-1].kept.items() if path in expected}
    assert on_disk == {path: (data,) for path, data in expected.items()}  # once the batch has ended
    remains = list(remains_of(log))
    assert len(remains) > 100
    for event, files, try_to_resume in remains:
        put(files, out)
        torn = [name for name, found in files_of_records(out).items() if not is_whole(files, name, found)]
        assert torn == [], event
        if try_to_resume:
            run_batch(job, out, resume=True)
            assert files_of(out) == expected, event


@pytest.mark.slow
@pytest.mark.usefixtures("unflushed")
def test_a_power_failure_while_damage_is_mended_does_no_more_damage(job, tmp_path, monkeypatch):
    whole, out = tmp_path / "whole", tmp_path / "out"
    run_batch(job, whole)
    expected = files_of(whole)
    damaged = "pings.zarr/body_id/c/1/0/0"
    (whole / damaged).write_bytes(b"half")
    before = files_of(whole)
    with monkeypatch.context() as patch:
        log = DiskLog(whole, patch)
        run_batch(job, whole, resume=True, mend=True)
    assert files_of(whole) == expected
    for event, files, try_to_resume in remains_of(log):
        put(files, out)
        torn = [name for name, found in files_of_records(out).items() if not is_whole(files, name, found)]
        assert torn in ([], [damaged]), event
        if torn:
            assert files[damaged] == before[damaged], event  # nothing has happened yet
        elif try_to_resume:
            run_batch(job, out, resume=True)
            assert files_of(out) == expected, event
