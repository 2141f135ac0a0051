"""Parts of a batch: the same bytes in any order and process, and pings that fail."""

import errno
import json
import shutil
from contextlib import nullcontext

import numpy as np
import pytest
import xarray as xr
from pycocotools.coco import COCO

import sonar_gl as sg
from sonar_gl.batch import parts
from sonar_gl.batch.folder import Folder
from sonar_gl.batch.job import Job, read_job
from sonar_gl.batch.manifest import Manifest, check
from sonar_gl.batch.parts import Batch
from sonar_gl.batch.requests import BatchRequests
from sonar_gl.batch.steps import begin, create_store, finalize, make_part
from sonar_gl.core.warn import warn_caller
from sonar_gl.engine import pipeline, sequence
from sonar_gl.engine.run import Run
from sonar_gl.sonar.sampling import ToleranceWarning
from tests.support.batches import (
    BOX,
    LABELS,
    MORE,
    files_of,
    make_all,
    open_batch,
    write_job,
    write_plain_job,
)


def test_a_part_made_ping_by_ping_has_the_same_bytes(small, tmp_path):
    batch, reports = open_batch(small / "job.toml", tmp_path / "out"), []
    begin(batch).save(batch.folder)
    create_store(batch)
    make_part(batch, 1, one_by_one=True, report=lambda *report: reports.append(report))
    batch.close()
    assert reports[:2] == [("started", 4), ("finished", 4)]
    before = files_of(small / "out")
    made = files_of(tmp_path / "out")
    assert "parts/0000001.json" in made
    record = json.loads(made["parts/0000001.json"])
    assert len(record["files"]) > 20
    names = [name for name, found in record["files"].items() if found]
    for name in [*names, "parts/0000001.json", "batch.json"]:
        assert made[name] == before[name]


@pytest.mark.parametrize("one_by_one", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_warnings_of_pings_are_reported_a_tolerance_once_for_a_sonar(
    small, tmp_path, monkeypatch, one_by_one
):
    finish = pipeline.finish

    def warns(*values):
        warn_caller("the tolerance cannot be met", ToleranceWarning)
        warn_caller("the ping is odd")
        return finish(*values)

    for module in (sequence, pipeline):
        monkeypatch.setattr(module, "finish", warns)
    batch, reports = open_batch(small / "job.toml", tmp_path / "out"), []
    begin(batch).save(batch.folder)
    create_store(batch)
    make_part(batch, 1, one_by_one=one_by_one, report=lambda *report: reports.append(report))
    batch.close()
    texts = [value for kind, value in reports if kind == "warning"]
    odd, unmet = [], []
    for sonar in batch.requests.sonars:
        place = f"warning: {sonar} in tank.sdf: "
        odd.append(f"{place}the ping is odd")
        once = "; this is said once, error_estimate of the arrays tells of each ping"
        unmet.append(f"{place}the tolerance cannot be met{once}")
    assert all(texts.count(text) == 1 for text in unmet) and set(texts) == {*odd, *unmet}
    assert all(texts.count(text) == 4 for text in odd)


@pytest.mark.slow
def test_a_ping_that_fails_has_reported_its_warnings(small, tmp_path, monkeypatch):
    """Since the simulator may warn once, and the next try succeed."""
    finish, calls = pipeline.finish, []

    def warns_once(*values):
        calls.append(values)
        if len(calls) == 1:
            warn_caller("the sonar is in the air")
            raise RuntimeError("the first try fails")
        return finish(*values)

    for module in (sequence, pipeline):
        monkeypatch.setattr(module, "finish", warns_once)
    batch, reports = open_batch(small / "job.toml", tmp_path / "out"), []
    begin(batch).save(batch.folder)
    create_store(batch)
    record = make_part(batch, 1, report=lambda *report: reports.append(report))
    batch.close()
    sonar = next(iter(batch.requests.sonars))
    texts = [value for kind, value in reports if kind == "warning"]
    assert not record.set_aside and texts == [f"warning: {sonar} in tank.sdf: the sonar is in the air"]


def test_parts_in_any_order_by_any_process_have_the_same_bytes(hard, tmp_path):
    """No ping takes its samples from those before it, though they need different ones."""
    make_all(hard, tmp_path / "one")
    batch = open_batch(hard, tmp_path / "other")
    begin(batch).save(batch.folder)
    create_store(batch)
    for part in (3, 0):
        make_part(batch, part)
    batch.close()
    other = open_batch(hard, tmp_path / "other")  # as another process, or after a stop
    for part in (2, 1):
        make_part(other, part, one_by_one=True)
    finalize(other)
    other.close()
    assert files_of(tmp_path / "one") == files_of(tmp_path / "other")
    found = xr.open_dataset(tmp_path / "one" / "pings.zarr")
    assert len(set(found.rows.values.tolist())) > 1
    assert (found.error_estimate <= 0.01).all() and len(set(found.error_estimate.values.tolist())) > 2


@pytest.mark.slow
def test_a_set_of_scenes_with_poses_and_variants_of_their_own_has_the_same_bytes(tmp_path, monkeypatch):
    """In any order of parts, of several scenes each, and ping by ping. Only the last scene stays open."""
    path = write_plain_job(tmp_path, 3, 4, "")
    text = path.read_text().replace('["tank.sdf"]', '["tank.sdf", "pool.sdf"]')
    (tmp_path / "pool.sdf").write_text((tmp_path / "tank.sdf").read_text().replace(BOX, ""))
    poses = text[text.index("[[poses]]") :].replace("-0.2, 0.2", "0.2, 0.1")
    vary = '[[vary.bodies]]\nnames = ["box_1", "floor"]\none_of = true\nx_m = [-0.5, 0.5]\n'
    path.write_text(text + f'scenes = ["pool.sdf"]\n{poses}{vary}{LABELS}[coco]\nheight = 100\n')
    make_all(path, tmp_path / "one")
    batch = open_batch(path, tmp_path / "other")
    assert [request.scene for request in batch.requests] == [1, 1, 1, 0, 0, 0, 1, 1, 1]
    begin(batch).save(batch.folder)
    create_store(batch)
    made, real = [], parts.Simulator
    monkeypatch.setattr(parts, "Simulator", lambda *of, **more: made.append(real(*of, **more)) or made[-1])
    for part in (2, 0, 1):
        make_part(batch, part, one_by_one=True)
        assert [repr(one).endswith("closed>") for one in made] == [True] * (len(made) - 1) + [False]
    assert len(made) == 3
    finalize(batch)
    batch.close()
    assert files_of(tmp_path / "one") == files_of(tmp_path / "other")
    found = xr.open_dataset(tmp_path / "one" / "pings.zarr")
    box_or_floor = np.isnan(found.moved_pose[3:6, :, 0, 0])
    assert found.moved_pose.attrs["bodies"][:2] == ["box_1", "floor"] and found.moved_pose.attrs["scenes"][
        :2
    ] == [0, 0]
    assert (box_or_floor[:, 0] != box_or_floor[:, 1]).all()


def test_pings_that_fail_are_tried_again_and_then_set_aside(small, tmp_path, monkeypatch):
    """One ping fails once, as when the device is short of memory; another fails each time.

    Both sonars draw what one engine holds.
    """
    tries, engines, real = [], set(), Run.resolve

    def failing(run, request):
        tries.append(request.time_s)
        engines.add(run.stages.engine)
        if request.time_s == 1.0 or (request.time_s == 1.2 and tries.count(1.2) == 1):
            raise RuntimeError("out of something")
        return real(run, request)

    batch = open_batch(small / "job.toml", tmp_path / "out")
    Manifest.load(Folder(small / "out")).save(batch.folder)
    create_store(batch)
    monkeypatch.setattr(Run, "resolve", failing)
    record = make_part(batch, 1)
    batch.close()
    assert record.set_aside == {"5": "RuntimeError: out of something"} and len(engines) == 1
    made = xr.open_zarr(tmp_path / "out" / "pings.zarr", group="level", consolidated=False).intensity
    expected = xr.open_dataset(small / "out" / "pings.zarr", group="level").intensity
    assert (made[5] == 0).all()
    assert np.array_equal(made[[4, 6, 7]], expected[[4, 6, 7]])


def test_pings_without_an_echo_are_those_that_no_sonar_sees_anything_in(tmp_path):
    """Of four: both sonars see the wall, only the one of longer range does, none does, and one that is set aside.

    No warning says so.
    """
    path = write_job(tmp_path, 2, "")
    rows = "0,0,0,0,0,0,0", "1,-2.5,0,0,0,0,0", "2,0,0,50,0,0,0", "3,0,0,50,0,0,0"
    (tmp_path / "dive.csv").write_text("\n".join(["t,x,y,z,roll,pitch,yaw", *rows]))
    changes = {"poses": [{"kind": "trajectory", "file": "dive.csv"}], "only": ["wall"], "vary": {}}
    changes["noise"] = {"preset": "none"}
    batch = Batch(BatchRequests(Job(**read_job(path).plain | changes)), Folder(tmp_path / "out"))
    begin(batch).save(batch.folder)
    create_store(batch)
    reports = []
    record = make_part(batch, 0, {3: "it kills"}, report=lambda *report: reports.append(report))
    batch.close()
    assert "finished" in (kinds := {kind for kind, _ in reports}) and "warning" not in kinds
    made = {
        name: xr.open_zarr(tmp_path / "out" / "pings.zarr", group=name, consolidated=False).intensity
        for name in batch.requests.sonars
    }
    seen = {name: (values > 0).any(("beam", "range")).values.tolist() for name, values in made.items()}
    assert seen == {"level": [True, True, False, False], "upright": [True, False, False, False]}
    assert record.without_echo == 1 and record.set_aside == {"3": "it kills"}


@pytest.mark.parametrize(
    "failure", [OSError(errno.ENOSPC, "No space left on device"), MemoryError()], ids=repr
)
def test_what_the_machine_lacks_sets_no_ping_aside(small, tmp_path, monkeypatch, failure):
    """The part is made again where there is space; a ping that is set aside is lost. So also of pings made alone."""
    tries = []

    def failing(*_):
        tries.append(1)
        raise failure

    batch = open_batch(small / "job.toml", tmp_path / "out")
    Manifest.load(Folder(small / "out")).save(batch.folder)
    create_store(batch)
    monkeypatch.setattr(Run, "resolve", failing)
    for one_by_one in (False, True):
        with pytest.raises(type(failure)):
            make_part(batch, 1, one_by_one=one_by_one)
    batch.close()
    assert len(tries) == 2  # at once
    assert not list((tmp_path / "out").glob("parts/*"))


def test_a_part_without_a_single_ping_ends_the_batch(small, tmp_path, monkeypatch):
    def failing(*_):
        raise sg.Error("nothing works")

    batch = open_batch(small / "job.toml", tmp_path / "out")
    Manifest.load(Folder(small / "out")).save(batch.folder)
    create_store(batch)
    monkeypatch.setattr(Run, "resolve", failing)
    with pytest.raises(sg.Error, match=r"^no ping of part 1 could be made \(nothing works\)$"):
        make_part(batch, 1)
    batch.close()
    assert not list((tmp_path / "out").glob("parts/*"))


def test_pings_that_fail_for_reasons_of_their_own_or_alone_in_a_part_are_set_aside(tmp_path, monkeypatch):
    """Only what several pings have in common ends the batch. A part may be made after the simulators were closed."""
    batch, tries, tolerances = open_batch(write_plain_job(tmp_path, 3, 2), tmp_path / "out"), [], set()
    begin(batch).save(batch.folder)
    create_store(batch)
    made, real = [], parts.Simulator
    monkeypatch.setattr(parts, "Simulator", lambda *of, **more: made.append(real(*of, **more)) or made[-1])

    def failing(run, request):
        tries.append(request.time_s)
        tolerances.add(run.sampler.tolerance)
        raise RuntimeError(f"not at {request.time_s} s")

    with monkeypatch.context() as patch:
        patch.setattr(Run, "resolve", failing)
        records = [make_part(batch, part) for part in range(2)]
    reasons = {str(k): f"RuntimeError: not at {0.2 * k} s" for k in range(3)}
    assert {**records[0].set_aside, **records[1].set_aside} == reasons
    assert tries == [0.0, 0.0, 0.0, 0.2, 0.2, 0.4, 0.4, 0.4]  # with others, and then twice by itself
    assert tolerances == {batch.requests.job.tolerance} == {0.05}
    batch.close()
    assert make_part(batch, 1).set_aside == {}
    batch.close()
    assert len(made) == 2 and all(repr(one).endswith("closed>") for one in made)


def test_a_part_replaces_its_damaged_files(small, tmp_path):
    out = shutil.copytree(small / "out", tmp_path / "out")
    before = files_of(out)
    for name in ("pings.zarr/level/intensity/c/2/0/0", "pings.zarr/upright/share/c/2/0/0"):
        (out / name).write_bytes(before[name][:100])  # of the last part
    batch = open_batch(small / "job.toml", out)
    make_part(batch, 2)
    batch.close()
    assert files_of(out) == before


@pytest.mark.slow
def test_a_batch_may_end_with_all_pings_set_aside(tmp_path):
    batch = open_batch(write_job(tmp_path, 2, LABELS + MORE), tmp_path / "out")
    begin(batch).save(batch.folder)
    create_store(batch)
    make_part(batch, 0, {0: "it kills", 1: "it kills"}, one_by_one=True)
    finalize(batch)
    batch.close()
    assert (xr.open_dataset(tmp_path / "out" / "pings.zarr", group="level").status == 2).all()
    assert COCO(str(tmp_path / "out" / "coco" / "level" / "instances.json")).getImgIds() == []
    assert not list((tmp_path / "out").glob("*.mp4")) and not (tmp_path / "out" / "bag").exists()
    assert check(batch.folder, nullcontext) == []
