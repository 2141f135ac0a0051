"""Records of a batch: damage of any kind is found, and can be mended; other drivers and libraries are refused."""

import errno
import fcntl
import json
import os
import re
import shutil
from dataclasses import replace
from itertools import product

import llvmlite.binding
import pytest

import sonar_gl as sg
from sonar_gl.batch import steps
from sonar_gl.batch.cluster import Cluster
from sonar_gl.batch.folder import LOCK, Folder, record_bytes
from sonar_gl.batch.job import read_job
from sonar_gl.batch.manifest import Manifest, PartRecord
from sonar_gl.batch.system import System
from tests.support.batches import files_of, make_all, open_batch, write_plain_job
from tests.support.command_line import run
from tests.support.inline_pool import use_inline_pool

N = 4
BEGUN, DONE, RECORD = "batch.json", "done.json", "parts/0000001.json"


@pytest.fixture(autouse=True)
def _in_this_process(monkeypatch):
    use_inline_pool(monkeypatch)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A folder with a job file, and its batch in `out`."""
    folder = tmp_path_factory.mktemp("made")
    make_all(write_plain_job(folder, N, 2), folder / "out")
    return folder


@pytest.fixture
def out(made, tmp_path):
    """A copy of the batch."""
    return shutil.copytree(made / "out", tmp_path / "out")


def resume(made, out, *more):
    return run("batch", made / "job.toml", "--out", out, "--resume", "--workers", "1", *more)


def assert_mended(made, out):
    status, shown, err = resume(made, out, "--mend")
    assert (status, shown) == (0, f"{out}: {N} of {N} pings\n"), err
    assert files_of(out) == files_of(made / "out")
    assert run("batch", "--check", out)[0] == 0


CURES = {
    BEGUN: "restore a copy, or have --resume --mend write it again; if no part is done, delete the folder",
    DONE: "delete it, or mend the batch by --resume --mend",
    RECORD: "delete it, or mend the batch by --resume --mend",
}


def change_a_digit(text):
    """Change the last digit."""
    at = max(match.start() for match in re.finditer(r"\d", text))
    return text[:at] + str((int(text[at]) + 1) % 10) + text[at + 1 :]


DAMAGE = {
    "a digit": change_a_digit,
    "half": lambda text: text[: len(text) // 2],
    "no JSON": lambda _text: "nothing",
    "nothing": lambda _text: "",
    "other JSON": lambda _text: "[1]\n",
    "an unknown key": lambda text: text.replace('"sha256"', '"sha255"'),
    "a space": lambda text: text + " ",
}


# kinds of damage to the record of a part, and one to each of the others, which are read in the same way; half a record
# or none is as wrong as no JSON, and a space as a digit
SLOW_DAMAGE = [(name, damage) for name in (BEGUN, DONE) for damage in list(DAMAGE)[1:]]
SLOW_DAMAGE += [(name, damage) for name in CURES for damage in ("half", "a space", "other JSON", "nothing")]


@pytest.mark.parametrize(
    "name, damage",
    [
        pytest.param(*both, marks=pytest.mark.slow if both in SLOW_DAMAGE else ())
        for both in product(CURES, DAMAGE)
    ],
)
def test_damage_of_a_record_is_found_refused_and_mended(made, out, name, damage):
    path = out / name
    before = path.read_text()
    path.write_text(DAMAGE[damage](before))
    assert path.read_text() != before
    status, shown, err = run("batch", "--check", out)
    assert (status, err) == (1, "")
    expected = f"{path}: has changed since it was written\n{out}: 1 file is missing or damaged\n"
    assert shown == expected
    status, shown, err = resume(made, out)
    assert (status, shown) == (2, "")
    assert err == f"error: {path}: must be as it was written (it is damaged; {CURES[name]})\n"
    assert_mended(made, out)


def test_each_changed_digit_of_the_manifest_is_found(made, out):
    """A digit that is changed would divide what is made from then on otherwise."""
    text = (out / BEGUN).read_text()
    places = [m.start() for m in re.finditer(r"\d", text)]
    assert places
    for place in places:
        (out / BEGUN).write_text(text[:place] + str((int(text[place]) + 1) % 10) + text[place + 1 :])
        with pytest.raises(sg.Error, match="must be as it was written"):
            Manifest.load(Folder(out))


@pytest.mark.parametrize("name", CURES)
def test_a_record_that_is_missing_is_found_and_made_again(made, out, name):
    (out / name).unlink()
    status, shown, _ = run("batch", "--check", out)
    assert status == 1 and f"{out / name}: is missing" in shown
    assert_mended(made, out)


def test_a_damaged_manifest_without_finished_parts_is_not_mended(made, out):
    shutil.rmtree(out / "parts")
    (out / BEGUN).write_text("{}")
    for more in ((), ("--mend",)):
        status, _, err = resume(made, out, *more)
        assert status == 2 and err.endswith("if no part is done, delete the folder)\n")


def test_a_damaged_manifest_is_not_replaced_by_that_of_another_job(made, out, tmp_path):
    (out / BEGUN).write_text("{}")
    before = files_of(out)
    (tmp_path / "other").mkdir()
    other = write_plain_job(tmp_path / "other", N, 2)
    other.write_text(other.read_text().replace("seed = 5", "seed = 6"))
    status, _, err = run("batch", other, "--out", out, "--resume", "--mend", "--workers", "1")
    assert status == 2 and "error: " in err
    assert (
        f"{out}: batch.json must be written again by the job, OpenGL and libraries that began the batch"
        in err
    )
    assert files_of(out) == before


def test_a_valid_manifest_in_place_of_another_is_refused(made, out):
    """Its parts would be mixed with those of the former one."""
    plan = json.loads((out / BEGUN).read_text())
    del plan["sha256"]
    plan["system"]["numpy"] += "1"
    (out / BEGUN).write_bytes(record_bytes(plan))
    status, shown, _ = run("batch", "--check", out)
    assert status == 1
    assert f"{out / RECORD}: is of another batch than that of batch.json\n" in shown
    status, _, err = resume(made, out)
    assert status == 2 and "parts/0000000.json: must be of the batch in batch.json (got one of another" in err


def test_a_folder_of_a_version_that_planned_batches_is_refused(made, out):
    (out / BEGUN).rename(out / "planned.json")
    for command in (("--check", out), (made / "job.toml", "--out", out, "--resume", "--workers", "1")):
        status, _, err = run("batch", *command)
        assert status == 2
        assert err == (
            f"error: {out}/planned.json: a batch must be finished by the version that began it (got one whose samples "
            "were chosen before its first ping, as this version no longer does; use that version, or another folder)\n"
        )


def test_a_batch_that_another_version_began_is_refused(made, out):
    """Also one of 0.1.0, the version before this one: its pings differ."""
    begun = json.loads((out / BEGUN).read_text()) | {"version": "0.1.0"}
    del begun["sha256"], begun["files"]  # a field that records of that version lack
    (out / BEGUN).write_bytes(record_bytes(begun))
    for command in (("--check", out), (made / "job.toml", "--out", out, "--resume", "--workers", "1")):
        assert run("batch", *command) == (
            2,
            "",
            f"error: {out / BEGUN}: a batch must be finished by the version that began it (got 0.1.0, this is "
            f"{sg.__version__}; use that version, or another folder)\n",
        )


def test_a_batch_that_is_whole_is_not_touched(made, out):
    times = {path: path.stat().st_mtime_ns for path in out.rglob("*") if path.is_file()}
    for more in ((), ("--mend",)):
        assert resume(made, out, *more)[0] == 0
    assert {path: path.stat().st_mtime_ns for path in times} == times
    assert run("batch", "--check", out)[0] == 0


def test_files_that_belong_to_no_part_are_mended(made, out):
    for name in ("pings.zarr/zarr.json", "pings.zarr/intensity/zarr.json", "pings.zarr/range/c/0"):
        (out / name).write_bytes(b"half")
    status, shown, _ = run("batch", "--check", out)
    assert status == 1 and shown.endswith("3 files are missing or damaged\n")
    assert_mended(made, out)


def test_each_file_has_its_checksum_in_one_record(made):
    """Those of parts in theirs, so that the end of a batch need not read them."""
    out = made / "out"
    records = [json.loads(path.read_text()) for path in (out / "parts").glob("*.json")]
    records.append(json.loads((out / DONE).read_text()))
    named = [name for record in records for name in record["files"]]
    without = {BEGUN, DONE} | {f"parts/{path.name}" for path in (out / "parts").glob("*.json")}
    assert sorted([*named, *without]) == sorted(files_of(out))


def test_paths_that_are_no_utf8_come_back_from_records(tmp_path):
    """The job file of a batch may lie in such a folder, which ended with a UnicodeEncodeError."""
    folder, values = Folder(tmp_path), {"file": os.fsdecode(b"\xff/\xc3\xa4.toml")}
    folder.put_record("one.json", values)
    assert folder.get_record("one.json", "") == values
    assert json.loads((tmp_path / "one.json").read_text(encoding="utf-8"))["file"] == values["file"]


# ---- the lock ---------------------------------------------------------------------------------------


def test_one_process_at_a_time_has_the_lock_even_if_it_was_waited_for(tmp_path):
    """Who has opened the file of the lock before it is released has the same lock as those who come later."""
    folder = Folder(tmp_path)
    with folder.locked():
        late = (tmp_path / LOCK).open("w")
    with late:
        fcntl.flock(late, fcntl.LOCK_EX | fcntl.LOCK_NB)
        with pytest.raises(sg.Error, match="must have one batch at a time"), folder.locked():
            pass
    with folder.locked():
        pass


@pytest.mark.parametrize("code", [errno.ENOSYS, errno.ENOLCK, errno.EOPNOTSUPP])
def test_a_file_system_without_locks_is_warned_of(code, tmp_path, monkeypatch):
    """As Lustre may be mounted. Every batch ended there with 'files: Function not implemented'."""

    def flock(*_):
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(fcntl, "flock", flock)
    expected = f"locks .* {os.strerror(code).lower()}; run one at a time"
    with pytest.warns(UserWarning, match=expected), Folder(tmp_path).locked():
        pass


def test_other_errors_of_the_lock_are_raised(tmp_path, monkeypatch):
    def flock(*_):
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    monkeypatch.setattr(fcntl, "flock", flock)
    with pytest.raises(OSError, match="Input/output error"), Folder(tmp_path).locked():
        pass


def test_a_part_that_is_made_again_never_lacks_a_file(made, out, monkeypatch):
    """As by a process whose batch was killed, when the next one has already recorded the part."""
    batch, names = open_batch(made / "job.toml", out), [*json.loads((out / RECORD).read_text())["files"]]
    real, lacking = Folder.remove, []
    monkeypatch.setattr(Folder, "remove", lambda folder, name: (lacking.append(name), real(folder, name)))
    steps.make_part(batch, 1)
    batch.close()
    assert len(names) > 1 and lacking == []
    assert files_of(out) == files_of(made / "out")


# ---- other drivers and libraries --------------------------------------------------------------------

OTHERS = {"gl_renderer": "NVIDIA", "gl_version": "4.6 Mesa 99", "numpy": "9.9", "numba": "0.1"}


@pytest.fixture
def half(out):
    """The batch, with one part to be made."""
    for name in (DONE, RECORD):
        (out / name).unlink()
    return out


def on_another_system(monkeypatch, **changes):
    """Have this process work with other OpenGL or libraries, as far as it can tell."""
    real = System.of
    monkeypatch.setattr(System, "of", lambda gl_info: replace(real(gl_info), **changes))


@pytest.mark.parametrize(
    "field",
    ["gl_renderer", *(pytest.param(x, marks=pytest.mark.slow) for x in ("numpy", "gl_version", "numba"))],
)
def test_a_batch_is_not_resumed_on_another_system_unless_that_is_wanted(made, half, field, monkeypatch):
    before = files_of(half)
    planned = json.loads(before[BEGUN])["system"][field]
    on_another_system(monkeypatch, **{field: OTHERS[field]})
    status, _, err = resume(made, half)
    *_, line = err.splitlines()
    assert status == 2 and "Traceback" not in err
    said = (
        "pings must be made by the OpenGL and the libraries that began the batch, as others round otherwise"
    )
    assert line.startswith(f"error: {half}: {said} (got ")
    assert f"(got {field} {OTHERS[field]!r} instead of {planned!r} on " in line
    assert line.endswith("restore these, give another folder, or accept other last bits by --any-system)")
    assert {name: data for name, data in files_of(half).items() if before.get(name) != data} == {
        "pings.zarr/zarr.json": files_of(half)["pings.zarr/zarr.json"]  # until the batch is complete again
    }
    assert resume(made, half, "--any-system")[0] == 0
    assert PartRecord.load(Folder(half), 1).system[field] == OTHERS[field]
    assert PartRecord.load(Folder(half), 0).system is None
    assert run("batch", "--check", half)[0] == 0


def test_workers_of_a_cluster_compare_their_system(made, half, monkeypatch):
    on_another_system(monkeypatch, numpy="9.9")
    job = read_job(made / "job.toml")
    for any_system in (False, True):
        arguments = Cluster("tcp://nowhere", job, str(half), any_system).arguments
        name, url, allowed = arguments
        assert json.loads(name) == job.plain and (url, allowed) == (str(half), any_system)
    batch = open_batch(made / "job.toml", half)
    for _ in range(2):  # a worker lives on, and gets the next part
        with pytest.raises(sg.Error, match=r"numpy '9.9' instead of .* on .*--any-system"):
            batch.maker.make(1)
    batch.close()


def test_a_plan_says_what_made_it(made):
    system = Manifest.load(Folder(made / "out")).system
    with sg.Simulator(
        sg.load_scene("pylon"), sg.load_sonar("p900-45"), sampling=sg.Sampling(1, 20)
    ) as simulator:
        assert (system.gl_renderer, system.gl_version) == tuple(
            simulator.gl_info[key] for key in ("renderer", "version")
        )
    import_versions = {name: __import__(name).__version__ for name in ("numpy", "numba")}
    assert {"numpy": system.numpy, "numba": system.numba} == import_versions


def test_a_plan_says_on_what_processor_it_began_and_goes_on_with_another(made, half, monkeypatch):
    begun = Manifest.load(Folder(half))
    assert begun.processor == llvmlite.binding.get_host_cpu_name()
    monkeypatch.setattr(steps, "processor", lambda: "generic")
    assert replace(begun, processor="generic").identity == begun.identity
    (half / BEGUN).unlink()
    assert resume(made, half, "--mend")[0] == 0 and run("batch", "--check", half)[0] == 0
    assert Manifest.load(Folder(half)) == replace(begun, processor="generic")


def test_a_plan_that_is_missing_is_mended_or_the_message_says_how(made, half):
    (half / BEGUN).unlink()
    status, _, err = resume(made, half)
    assert status == 2
    assert err.endswith(f"--resume (there is no {BEGUN}; --resume --mend makes it again)\n")
    assert resume(made, half, "--mend")[0] == 0 and run("batch", "--check", half)[0] == 0


def test_a_folder_without_a_batch_is_called_so(tmp_path):
    status, _, err = run("batch", "--check", tmp_path)
    assert status == 2 and err.endswith(f"must be the folder of a batch (there is no {BEGUN} in it)\n")
