"""What is said of a job before any ping."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sonar_gl.batch import job_scenes
from sonar_gl.batch.folder import Folder
from sonar_gl.batch.job import Job, read_job
from sonar_gl.batch.job_warnings import (
    device_warnings,
    hull_warnings,
    job_warnings,
    model_warnings,
    place_warnings,
)
from sonar_gl.batch.parts import Batch
from sonar_gl.batch.requests import BatchRequests
from sonar_gl.batch.steps import begin, create_store, make_part
from sonar_gl.batch.trajectories import SectorScan
from tests.support.batches import open_batch, write_job
from tests.support.command_line import BODY, WALL


def by_sound_hz(requests):
    """Return the rate at which sound comes back to the sonar `level`."""
    return requests.acoustics.water.sound_speed() / (2 * requests.sonars["level"].range_max_m)


def test_pings_that_no_sonar_makes_as_quickly_are_warned_of(requests):
    assert list(device_warnings(requests)) == []  # 5 pings a second
    level = requests.sonars["level"]
    job = requests.job.model_copy(update={"poses": [requests.job.poses[0] | {"ping_rate_hz": 100.0}]})
    quick = BatchRequests(job)
    quick.sonars = {"level": level, "slow": replace(level, ping_rate_max_hz=20.0)}
    assert [text.split(": ", 2)[2] for text in device_warnings(quick)] == [
        f"poses[0]: sonar {name!r} makes {rate_hz:.4g} pings a second at most "
        "(got 100; its range, its ping_rate_max_hz, or the times)"
        for name, rate_hz in (("level", by_sound_hz(requests)), ("slow", 20.0))
    ]
    views = {
        "kind": "random_views",
        "target_m": [0, 0, 0],
        "range_m": [5, 5],
        "n_pings": 3,
        "ping_rate_hz": 100.0,
    }
    unrelated = BatchRequests(requests.job.model_copy(update={"poses": [views]}))
    assert list(device_warnings(unrelated)) == []


def test_ranges_beyond_what_a_device_allows_are_warned_of(requests):
    level, limited = requests.sonars["level"], BatchRequests(requests.job)
    limits = {"short": level.range_max_m / 2, "long": level.range_max_m, "unknown": None}
    limited.sonars = {
        name: replace(level, name=name, range_limit_m=limit_m) for name, limit_m in limits.items()
    }
    (text,) = device_warnings(limited)
    assert text == f"warning: {requests.job.where}: {limited.sonars['short'].beyond_limit_text()}"


def test_a_hull_that_stays_behind_is_warned_of(tmp_path, requests):
    path = write_job(tmp_path)
    assert hull_warnings(requests, 0) == []
    world = (tmp_path / "tank.sdf").read_text()
    sensor = '<link name="mount"><sensor name="sonar" type="custom"/></link>'
    wall = world.index("</model>", world.index('<model name="wall">'))
    (tmp_path / "tank.sdf").write_text(world[:wall] + sensor + world[wall:])
    (text,) = hull_warnings(BatchRequests(read_job(path)), 0)
    assert text == (
        f"warning: {path}: scenes[0], 'tank.sdf': poses move the sonar alone: model 'wall', which carries it, stays "
        'where it is, and returns echo (leave it out: without = ["wall*"])'
    )
    world = (tmp_path / "tank.sdf").read_text()
    (tmp_path / "tank.sdf").write_text(
        world.replace("</world>", f"{BODY.format('wall_2', '9 9 0', '1 1 1')}</world>")
    )
    (text,) = hull_warnings(BatchRequests(read_job(path)), 0)
    assert text.endswith('(leave it out: without = ["wall"])')
    for old, new in (("tolerance", 'without = ["wall*"]\ntolerance'), ('["box_*"]', '["box_*", "wall"]')):
        job = path.read_text()
        path.write_text(job.replace(old, new, 1))
        assert hull_warnings(BatchRequests(read_job(path)), 0) == []
        path.write_text(job)


@pytest.mark.slow
def test_parts_that_a_table_leaves_behind_are_warned_of(tmp_path):
    """The diver's helmet and bubbles stay in the scene when a table names his body alone, as a part of a model."""
    path = write_job(tmp_path, 4, "")
    plain = read_job(path).plain | {"scenes": ["pylon", "diver"]}

    def texts(*tables):
        requests = BatchRequests(Job(**plain | {"vary": {"bodies": list(tables)}}))
        found = [text for index in (0, 1) for text in model_warnings(requests, index)]
        assert set(found) <= set(job_warnings(requests))
        return found

    diver, away = {"names": ["diver"], "yaw_rad": [-3.0, 3.0]}, {"names": ["floor"], "z_m": -1.0}
    assert texts(away, diver) == [
        f"warning: {path}: scenes[1], 'diver': vary.bodies[1] moves 'diver' without diver::weight_left, "
        'diver::corselet, diver::bubbles (add "diver::*" to its names, or to those of a table that changes nothing)'
    ]
    some = {"names": ["diver", "diver::weight*"], "there": 0.5}
    assert [text.partition(" without ")[2].partition(" (")[0] for text in texts(some)] == [
        "diver::corselet, diver::bubbles"
    ]
    (text,) = texts({"names": ["pylon_round", "diver*"], "one_of": True})
    assert "scenes[0], 'pylon': vary.bodies[0] moves 'pylon_round' without pylon_round::column (" in text
    assert len(texts({"names": ["diver"], "rests_on": "floor"})) == 1
    rest = {"names": ["diver::*"]}
    for silent in (
        [diver | {"names": ["diver*"]}],
        [diver, rest],
        [{"names": ["*"], "x_m": 1.0}],
        [{"names": ["diver"], "reflectivity": 0.5}],
        [{"names": ["diver::corselet"], "x_m": 1.0}],
        [diver, {"names": ["diver"]}, away],
    ):
        assert texts(*silent) == []


def test_each_of_many_scenes_is_read_once_before_the_first_ping(tmp_path, monkeypatch):
    """For all checks and warnings: to load each of many once more doubled the time before the first ping."""
    path, names = write_job(tmp_path), [f"tank_{k}.sdf" for k in range(4)]
    for name in names:
        (tmp_path / name).write_text((tmp_path / "tank.sdf").read_text())
    path.write_text(path.read_text().replace('["tank.sdf"]', f'{names}\nonly = ["wall", "box_*", "floor"]'))
    loaded, load = [], job_scenes.load_scene
    monkeypatch.setattr(
        job_scenes, "load_scene", lambda what, *rest: loaded.append(Path(what).name) or load(what, *rest)
    )
    requests = BatchRequests(read_job(path))
    assert list(job_warnings(requests)) == []
    batch = Batch(requests, Folder(tmp_path / "out"))
    assert [*requests.scenes.files] == [*names, "small.toml"] and batch.schema.first_body == [0, 3, 6, 9]
    assert loaded == names
    assert len(requests.scenes[0].bodies) == 3 and loaded == [*names, names[0]]  # all would not fit in memory


def test_rates_are_checked_block_by_block(requests, monkeypatch):
    """The times of all pings at once took all memory: a job may have 1e9."""
    monkeypatch.setattr("sonar_gl.batch.job_warnings.BLOCK_PINGS", 4)
    poses = [requests.job.poses[0] | {"ping_rate_hz": 100.0}]
    quick = BatchRequests(requests.job.model_copy(update={"poses": poses}))
    sizes, time_s = [], SectorScan.time_s

    def noted(self, n):  # the first two pings at once, which have no rate
        sizes.append(np.size(n))
        return np.maximum(time_s(self, n), 0.01)

    monkeypatch.setattr(SectorScan, "time_s", noted)
    assert [text.split(": ", 2)[2] for text in device_warnings(quick)] == [
        f"poses[0]: sonar 'level' makes {by_sound_hz(requests):.4g} pings a second at most "
        "(got 100; its range, its ping_rate_max_hz, or the times)"
    ]
    assert max(sizes) == 5 and sum(sizes) == len(quick) + len(sizes) - 1


def write_enclosed_job(folder, more=""):
    """Write a job whose sonars are inside a body all along their way, in two parts."""
    path = write_job(folder, 8, "")
    sector = path.read_text().index("[[poses]]"), path.read_text().index("[[vary.bodies]]")
    way = '[[poses]]\nkind = "orbit"\ncentre_m = [0, 0, 0]\nradius_m = 2\nz_m = 0\nturns = 1\nn_pings = 8\n\n'
    text = (path.read_text()[: sector[0]] + way + path.read_text()[sector[1] :]).replace(
        "there = 0.8", "there = 1.0"
    )
    path.write_text(text.replace("tolerance = 0.05", f"tolerance = 0.05\n{more}"))
    world = BODY.format("box_1", "0 0 0", "200 200 200")
    (folder / "tank.sdf").write_text(f'<sdf version="1.9"><world name="tank">{world}</world></sdf>')
    return path


def warnings_of_parts(path, folder, parts, one_by_one=False):
    """Return the warnings of one process that makes these parts."""
    batch, reports = open_batch(path, folder), []
    if not (folder / "batch.json").exists():
        begin(batch).save(batch.folder)
        create_store(batch)
    for part in parts:
        record = make_part(batch, part, one_by_one=one_by_one, report=lambda *report: reports.append(report))
        assert record.without_echo == 4
    batch.close()
    return {value for kind, value in reports if kind == "warning"}


@pytest.mark.parametrize("one_by_one", [False, True])
def test_a_sonar_inside_a_body_is_reported_whatever_process_makes_its_pings(tmp_path, one_by_one):
    path = write_enclosed_job(tmp_path)
    requests = BatchRequests(read_job(path))
    assert list(job_warnings(requests)) == place_warnings(requests, 0)
    for sonar, text in zip(requests.sonars, place_warnings(requests, 0), strict=True):
        begins = f"warning: {sonar} in tank.sdf: ping 0: the sonar at (2, 0, 0) m is inside body 'box_1', or"
        assert text.startswith(begins)
    assert warnings_of_parts(path, tmp_path / "out", [1], one_by_one) == set()


def test_a_sonar_inside_a_body_is_reported_of_the_first_ping_in_each_scene(tmp_path):
    path = write_enclosed_job(tmp_path)
    (tmp_path / "other.sdf").write_text((tmp_path / "tank.sdf").read_text())
    requests = BatchRequests(read_job(path).model_copy(update={"scenes": ["tank.sdf", "other.sdf"]}))
    begins = [f"warning: {sonar} in other.sdf: ping 8: the sonar at" for sonar in requests.sonars]
    assert [
        text[: len(begin)] for text, begin in zip(place_warnings(requests, 1), begins, strict=True)
    ] == begins


@pytest.mark.parametrize(
    ("place", "moved", "warned"),
    [
        ("0 0 0", {}, ["level"]),
        ("0 0 0", {"there": 0.0}, []),
        ("0 0 0", {"x_m": 3.0}, ["upright"]),
        ("3 0 0", {}, ["upright"]),
        ("3 0 0", {"x_m": -3.0}, ["level"]),
    ],
)
def test_a_sonar_is_inside_a_body_where_the_first_ping_has_both(tmp_path, place, moved, warned):
    """One sonar is mounted 3 m before the other."""
    path = write_job(tmp_path, 2, "")
    path.write_text(path.read_text().replace("mount = [0.0, ", "mount = [3.0, "))
    body = BODY.format("box_1", place, "1 2 1")
    (tmp_path / "tank.sdf").write_text(f'<sdf version="1.9"><world name="tank">{body}{WALL}</world></sdf>')
    vary = {"bodies": [{"names": ["box_1"], **moved}]}
    texts = place_warnings(BatchRequests(Job(**read_job(path).plain | {"vary": vary})), 0)
    assert [text.split()[1] for text in texts] == warned


@pytest.mark.slow
def test_a_sonar_in_the_air_is_reported_alike_by_all_processes(tmp_path):
    path = write_enclosed_job(tmp_path, "surface_z_m = -1.0")
    texts = {
        f"warning: {sonar} in tank.sdf: the sonar is above the water's surface in some pings, on which it has no "
        "effect"
        for sonar in ("level", "upright")
    }
    for number, made in enumerate(([0], [1], [0, 1])):
        assert warnings_of_parts(path, tmp_path / f"out_{number}", made) == texts
