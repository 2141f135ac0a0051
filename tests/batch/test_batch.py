"""Batches: the requests of a job, the files of its pings, and that users' tools read them."""

import errno
import itertools
import json
import math
import re
import shutil
import warnings
from contextlib import nullcontext
from dataclasses import fields, replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import fsspec
import numpy as np
import pytest
import trimesh
import xarray as xr
from pycocotools.coco import COCO
from rosbags.highlevel import AnyReader

import sonar_gl as sg
from sonar_gl.batch import job_scenes, outputs, parts
from sonar_gl.batch import survey as survey_module
from sonar_gl.batch.cluster import Cluster
from sonar_gl.batch.folder import Folder
from sonar_gl.batch.job import LOCATION_KEYS, Job, MovedTable, read_job
from sonar_gl.batch.job_warnings import (
    device_warnings,
    hull_warnings,
    job_warnings,
    model_warnings,
    place_warnings,
)
from sonar_gl.batch.manifest import Manifest, check, default_pings_per_part
from sonar_gl.batch.parts import Batch
from sonar_gl.batch.ping_table import PingTable
from sonar_gl.batch.pool import IN_PROGRESS
from sonar_gl.batch.random_streams import VARY_STREAM, generator
from sonar_gl.batch.requests import BatchRequests
from sonar_gl.batch.schema import Schema, round_mantissa
from sonar_gl.batch.steps import begin, create_store, finalize, make_part
from sonar_gl.batch.survey import survey, try_pings
from sonar_gl.batch.trajectories import SectorScan
from sonar_gl.batch.variation import MovedBodies, draw_fields
from sonar_gl.core.toml_tables import Table
from sonar_gl.core.warn import warn_caller
from sonar_gl.engine import pipeline, sequence
from sonar_gl.engine.flow import Plan
from sonar_gl.engine.level_search import LevelSearch
from sonar_gl.engine.run import Run
from sonar_gl.imaging.boxes import body_map, boxes_of
from sonar_gl.noise.reception import receiver_power
from sonar_gl.sonar.sampling import ToleranceWarning
from tests.support.batches import (
    BOX,
    FLOOR,
    LABELS,
    MORE,
    files_of,
    make_all,
    open_batch,
    write_job,
    write_plain_job,
)
from tests.support.command_line import BODY, WALL, run
from tests.support.errors import error_of
from tests.support.inline_pool import use_inline_pool
from tests.support.wall_and_rods import wall

N = 10


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """A folder with the job file, and its batch in `out`."""
    folder = tmp_path_factory.mktemp("small")
    make_all(write_job(folder, N, LABELS + MORE), folder / "out")
    return folder


@pytest.fixture(scope="module")
def requests(small):
    return BatchRequests(read_job(small / "job.toml"))


@pytest.fixture(scope="module")
def pings(small, requests):
    return pings_of(small, requests)


@pytest.fixture(scope="module")
def quiet(small, requests):
    """The pings without noise, by which boxes leave out what is faint."""
    return pings_of(small, requests, with_noise=False)


def pings_of(folder, requests, label_level_db=None, with_noise=True):
    """Return the pings that a simulator makes of the requests of a batch in `folder`, by sonar."""
    out = {}
    for name, sonar in requests.sonars.items():
        group = xr.open_dataset(folder / "out" / "pings.zarr", group=name)
        samplings = zip(group.columns_per_beam.values.tolist(), group.rows.values.tolist(), strict=True)
        samplings, pings = [sg.Sampling(*one) for one in samplings], {}
        for sampling in set(samplings):
            with sg.Simulator(requests.scenes[0], sonar, requests.acoustics, sampling) as simulator:
                for request in requests:
                    if samplings[request.number] == sampling:
                        pings[request.number] = simulator.ping(
                            request.vehicle_pose @ requests.mounts[name],
                            request.noise if with_noise else None,
                            requests.noise_seed(name),
                            labels=True,
                            ping_number=request.number,
                            bodies=request.bodies,
                            time_s=request.time_s,
                            reflectivity=request.reflectivity,
                            water=request.water,
                            background=["floor", "wall"],
                            label_level_db=label_level_db,
                        )
        out[name] = [pings[number] for number in range(len(requests))]
    return out


def test_a_preset_of_noise_with_settings_that_need_it(tmp_path):
    """The number of looks needs speckle, which the preset has."""
    path = write_job(tmp_path, 2, "")
    path.write_text(path.read_text().replace('preset = "physical"', 'preset = "physical"\nlooks = 2'))
    assert BatchRequests(read_job(path)).noise == replace(sg.Noise.physical(), looks=2)


def test_the_water_of_a_job_is_that_of_all_pings_but_for_what_varies(tmp_path):
    path = write_job(tmp_path, 2, "")
    path.write_text(path.read_text().replace("[noise]", "[water]\nsalinity_psu = 8.0\nph = 7.9\n[noise]"))
    requests, base = BatchRequests(read_job(path)), sg.Water(salinity_psu=8.0, ph=7.9)
    assert requests.acoustics == sg.Acoustics.physical(tvg_absorption_db_m=0.3, water=base)
    waters = [requests[number].water for number in range(2)]
    assert [replace(water, temperature_c=base.temperature_c) for water in waters] == [base, base]
    assert len({base, *waters}) == 3


@pytest.mark.parametrize(
    ("changed", "setting"),
    [
        ("wind_speed_m_s = [1.0, 9.0]", 'multipath = "incoherent"'),
        ("salinity_psu = [2.0, 9.0]", "sonar_sound_speed_m_s = 1500.0"),
    ],
)
def test_water_that_no_simulator_may_vary_is_refused_before_any_ping(tmp_path, changed, setting):
    """Otherwise each ping would fail, for a reason of its own, and be set aside."""
    path = write_job(tmp_path, 2, "")
    text = path.read_text().replace("temperature_c = [2.0, 20.0]", changed)
    path.write_text(text.replace("tvg_absorption_db_m = 0.3", setting))
    with pytest.raises(sg.Error, match=f"^{path}: vary.water.* exclude each other .got both;"):
        BatchRequests(read_job(path))


@pytest.mark.slow
@pytest.mark.parametrize("sonar", ["level", "upright"])
def test_xarray_reads_the_pings_of_a_simulator_within_the_stated_errors(small, requests, pings, quiet, sonar):
    data = xr.open_dataset(small / "out" / "pings.zarr", group=sonar)
    assert data.intensity.dims == ("ping", "beam", "range")
    assert dict(data.sizes) | {"ping": N} == dict(data.sizes)
    assert np.array_equal(data.azimuth_rad, requests.sonars[sonar].azimuth_rad)
    assert np.array_equal(data.range, requests.sonars[sonar].range_m) and data.range.attrs["units"] == "m"
    n_shadowed = 0
    for number, ping in enumerate(pings[sonar]):
        stored = data.isel(ping=number)
        assert np.array_equal(stored.pose, ping.pose)
        assert float(stored.time_s) == ping.meta["time_s"]
        error = np.abs(stored.intensity.values - ping.intensity)
        assert (error <= stored.intensity.attrs["relative_error_max"] * ping.intensity).all()
        assert np.array_equal(stored.body_id, ping.body_id)
        assert np.array_equal(stored.class_id, np.array([0, 1, 2, 1])[ping.body_id])
        for name, values in (
            ("elevation_rad", ping.elevation_rad),
            ("true_range_m", ping.true_range_m),
            ("incidence_rad", ping.incidence_rad),
            ("share", ping.share),
        ):
            # half a step, and the rounding of float32
            step = stored[name].encoding["scale_factor"]
            assert np.array_equal(np.isnan(stored[name]), np.isnan(values))
            assert np.nanmax(np.abs(stored[name].values - values)) <= step / 2 * (1 + 1e-4) + 1e-6
        assert np.array_equal(stored.shadow, ping.shadow)
        n_shadowed += int(ping.shadow.sum())
        assert np.allclose(stored.body_echo, ping.body_echo[1:], rtol=1e-6)
        boxes = boxes_of(ping, 512, quiet[sonar][number])
        visible = boxes.body_id.astype(int) - 1
        assert np.array_equal(np.flatnonzero(stored.body_bins), visible)
        assert np.array_equal(stored.body_pixels[visible], boxes.pixels)
        assert np.array_equal(stored.body_bins[visible], boxes.n_bins)
        assert np.array_equal(stored.body_box[visible], np.hstack([boxes.beams, boxes.bins]))
    assert n_shadowed > 0 or sonar == "upright"
    assert (data.status == 1).all()
    assert data.attrs["noise_seed"] == requests.noise_seed(sonar) and data.attrs["seed"] == 5
    assert sg.Sonar(**json.loads(data.attrs["specification"])) == requests.sonars[sonar]
    assert sg.Acoustics(**json.loads(data.attrs["acoustics"])) == requests.acoustics
    assert not [key for key, value in data.attrs.items() if isinstance(value, dict)]  # netCDF has none
    assert data.attrs["bodies"] == ["wall", "box_1", "floor"] and data.attrs["classes"] == ["fixed", "target"]


@pytest.mark.slow
def test_units_of_arrays_are_those_that_cf_conventions_know(small):
    """Readers of units, as pint-xarray, refuse the whole set for the sake of one that is none."""
    data = xr.open_dataset(small / "out" / "pings.zarr", group="level", decode_cf=False)
    assert {data[name].attrs["units"] for name in data.variables if "units" in data[name].attrs} == {
        *("1", "m", "rad", "s")
    }


def test_the_root_of_a_set_with_several_sonars_names_their_groups(small):
    root = xr.open_dataset(small / "out" / "pings.zarr")
    assert not root.variables and root.attrs["sonars"] == ["level", "upright"]
    for name in root.attrs["sonars"]:
        group = xr.open_dataset(small / "out" / "pings.zarr", group=name)
        assert group.attrs["sonar"] == name and group.sizes["ping"] == N
        assert {**root.attrs, **group.attrs} == {**group.attrs, "sonars": root.attrs["sonars"]}


@pytest.mark.slow
def test_a_set_from_before_its_root_named_the_groups_is_checked_and_resumed(small, tmp_path):
    copy = shutil.copytree(small / "out", tmp_path / "copy")
    root, folder = copy / "pings.zarr" / "zarr.json", Folder(copy)
    values = json.loads(root.read_bytes())
    del values["attributes"]["sonars"]
    folder.put_json("pings.zarr/zarr.json", values)
    done = folder.get_record("done.json", "")
    done["files"]["pings.zarr/zarr.json"] = folder.checksum("pings.zarr/zarr.json")
    folder.put_record("done.json", done)
    before = files_of(copy)
    assert check(folder, nullcontext) == []
    assert run("batch", small / "job.toml", "--out", copy, "--resume", "--workers", "1")[0] == 0
    assert files_of(copy) == before
    for name in ("done.json", "parts/0000001.json"):
        (copy / name).unlink()
    assert run("batch", small / "job.toml", "--out", copy, "--resume", "--workers", "1")[0] == 0
    assert files_of(copy) == files_of(small / "out")


@pytest.mark.slow
def test_one_line_plots_a_ping_of_one_sonar(tmp_path):
    write_job(tmp_path)
    text = (tmp_path / "job.toml").read_text()
    begin, end = text.index('[[sonars]]\nname = "upright"'), text.index("[[poses]]")
    (tmp_path / "job.toml").write_text(text[:begin] + text[end:])
    make_all(tmp_path / "job.toml", tmp_path / "out")
    mesh = xr.open_dataset(tmp_path / "out" / "pings.zarr").intensity[0].plot()
    assert mesh.get_array().size == 24 * 80


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


def test_the_name_of_a_model_in_place_of_its_bodies_is_told_how_to_write_them(tmp_path):
    path = write_job(tmp_path, 2, "")
    link = re.search("<link.*</link>", BOX, re.DOTALL)[0]
    links = "".join(link.replace('"link"', f'"{name}"') for name in ("hull", "arm"))
    (tmp_path / "tank.sdf").write_text(
        f'<sdf version="1.9"><world name="tank">{WALL}<model name="rov">{links}</model></world></sdf>'
    )
    plain = read_job(path).plain | {"vary": {}}
    cure = "must name bodies of the scene (got 'rov'; give 'rov::*', the bodies of this model)"
    for where, changes in (
        ("without", {"without": ["rov"]}),
        ("labels.classes.robot", {"labels": {"classes": {"robot": ["rov"]}}}),
        ("vary.bodies[0].names", {"vary": {"bodies": [{"names": ["rov"], "x_m": 1.0}]}}),
    ):
        with pytest.raises(sg.Error) as why:
            requests = BatchRequests(Job(**plain | changes))
            Schema(requests)
            PingTable(requests)
        assert str(why.value) == f"{path}: {where} {cure}"


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


def test_pings_later_than_any_ping_can_be_are_refused(requests):
    poses = [requests.job.poses[0] | {"ping_rate_hz": 1e-6, "n_pings": 20_000}]
    job = requests.job.model_copy(update={"poses": poses, "ros": None})
    with pytest.raises(
        sg.Error, match=r": poses must end before 1e\+10 s, as all pings must \(got 1.9999e\+10 s"
    ):
        BatchRequests(job)


def test_a_ping_is_made_again_with_its_noise_from_what_is_stored(tmp_path):
    """With all bits of the mantissa, bit for bit."""
    path = write_plain_job(tmp_path, 2, 2, "[arrays]\nmantissa_bits = 23")
    make_all(path, tmp_path / "out")
    data = xr.open_dataset(tmp_path / "out" / "pings.zarr")
    sonar, acoustics, noise = (
        kind(**json.loads(data.attrs[name]))
        for kind, name in ((sg.Sonar, "specification"), (sg.Acoustics, "acoustics"), (sg.Noise, "noise"))
    )
    for n in range(2):
        sampling = sg.Sampling(float(data.columns_per_beam[n]), int(data.rows[n]))
        with sg.Simulator(sg.load_scene(tmp_path / "tank.sdf"), sonar, acoustics, sampling) as simulator:
            ping = simulator.ping(
                data.pose[n].values,
                noise,
                int(data.attrs["noise_seed"]),
                ping_number=n,
                time_s=float(data.time_s[n]),
            )
        assert np.array_equal(ping.intensity, data.intensity[n])


@pytest.mark.slow
def test_varied_values_are_stored(small, requests):
    data = xr.open_dataset(small / "out" / "pings.zarr", group="level")
    n_present = 0
    for number in range(N):
        request, stored = requests[number], data.isel(ping=number)
        assert float(stored.water_temperature_c) == request.water.temperature_c
        assert float(stored.noise_ambient_db) == request.noise.ambient_db
        pose = request.bodies["box_1"]
        assert np.isnan(stored.moved_pose[0, :3]).all() == (pose is None)
        if pose is not None:
            n_present += 1
            assert np.array_equal(stored.moved_pose[0], pose)
            assert float(stored.reflectivity[0]) == request.reflectivity["box_1"]
    assert 0 < n_present < N
    assert data.moved_pose.attrs["bodies"] == ["box_1"]


def test_varied_values_are_uniform_within_their_bounds_and_depend_on_the_seed(small, requests):
    temperatures = [requests[n].water.temperature_c for n in range(N)]
    again = BatchRequests(read_job(small / "job.toml"))
    assert [again[n].water.temperature_c for n in reversed(range(N))] == temperatures[::-1]
    assert len(set(temperatures)) == N
    assert all(2 <= t <= 20 for t in temperatures)
    other = BatchRequests(read_job(small / "job.toml").model_copy(update={"seed": 6}))
    assert not {other[n].water.temperature_c for n in range(N)} & set(temperatures)
    table = requests.job.vary.bodies[0]
    job = requests.job.model_copy(update={"poses": [requests.job.poses[0] | {"n_pings": 2000}]})
    poses = [request.bodies["box_1"] for request in BatchRequests(job)]
    shifts = [pose[0, 3] - 3 for pose in poses if pose is not None]
    # 4 standard errors: of a share of 0.8, and of the mean and variance of a uniform distribution
    assert len(shifts) / 2000 == pytest.approx(table.there, abs=4 * math.sqrt(0.8 * 0.2 / 2000))
    assert np.mean(shifts) == pytest.approx(0, abs=4 / math.sqrt(12 * len(shifts)))
    assert np.var(shifts) == pytest.approx(1 / 12, abs=4 / math.sqrt(180 * len(shifts)))
    assert min(shifts) >= -0.5 and max(shifts) <= 0.5


def test_what_moves_apart_moves_as_whole_models(tmp_path):
    """A fish does not lose its tail, be it in a model of its own or in a school; a pattern may name parts alone."""
    link = '<link name="{}"><pose>{} 0 0 0 0 0</pose>{}</link>'
    sphere = "<geometry><sphere><radius>0.1</radius></sphere></geometry>"
    ball = f'<collision name="c">{sphere}<laser_retro>50</laser_retro></collision>'
    links = link.format("head", 0.0, ball) + link.format("tail", -0.3, ball)
    pair = "".join(
        f'<model name="{name}"><pose>{y} 1 0 0 0 1</pose>{links}</model>' for y, name in enumerate("ab")
    )
    path = write_job(tmp_path, 40, "")
    (tmp_path / "tank.sdf").write_text(
        f'<sdf version="1.9"><world name="tank">{pair}<model name="school">{pair}</model></world></sdf>'
    )
    table = {
        "apart": True,
        "x_m": [1.0, 2.0],
        "yaw_rad": [-3.0, 3.0],
        "there": 0.5,
        "reflectivity": [0.1, 0.9],
    }

    def models(*names):
        job = Job(**read_job(path).plain | {"vary": {"bodies": [table | {"names": list(names)}]}})
        for request in BatchRequests(job):
            found = {}
            for name, pose in request.bodies.items():
                found.setdefault(name.rpartition("::")[0], []).append((pose, request.reflectivity.get(name)))
            yield found

    for found in models("a*", "b*", "school::*"):
        assert set(found) == {"a", "b", "school::a", "school::b"}
        there = [parts for parts in found.values() if parts[0][0] is not None]
        assert sum(pose is not None for parts in found.values() for pose, _ in parts) == 2 * len(there)
        for (head, mu), (tail, tail_mu) in there:
            np.testing.assert_allclose(head @ sg.pose(-0.3), tail, atol=1e-12)
            assert head[1, 3] == pytest.approx(1.0, abs=1e-12)  # both turn about the first
            assert mu == tail_mu
        assert len({parts[0][1] for parts in there}) == len(there)
    by_part = [parts for found in models("*::head", "*::tail") for parts in found.values()]
    assert any((head is None) != (tail is None) for (head, _), (tail, _) in by_part)
    for found in models("*"):  # the school is one model
        (a, mu), (b, b_mu) = found["school::a"][0], found["school::b"][0]
        assert (a is None) == (b is None) and mu == b_mu


def test_one_of_several_bodies_is_there_at_a_time_each_as_often(tmp_path):
    """Of three, a fish with its tail among them: what it is made of, its size and shape vary from ping to ping."""
    path = write_job(tmp_path, 1000, "")
    link = re.search("<link.*</link>", BOX, re.DOTALL)[0]
    links = "".join(link.replace('"link"', f'"{name}"') for name in ("head", "tail"))
    fish = f'<model name="fish"><pose>3 0 0 0 0 0</pose>{links}</model>'
    bodies = WALL + BOX + BOX.replace("box_1", "box_2") + fish + FLOOR
    (tmp_path / "tank.sdf").write_text(f'<sdf version="1.9"><world name="tank">{bodies}</world></sdf>')
    (tmp_path / "empty.sdf").write_text(f'<sdf version="1.9"><world name="empty">{WALL}</world></sdf>')
    one = {"names": ["box_*", "fish*"], "one_of": True, "x_m": [-0.5, 0.5], "there": 0.8}
    after = {"names": ["floor"], "z_m": [-0.2, 0.0]}
    plain = read_job(path).plain | {"scenes": ["tank.sdf", "empty.sdf"]}

    def bodies_of(count, *tables):
        requests = BatchRequests(Job(**plain | {"vary": {"bodies": list(tables)}}))
        return [requests[number].bodies for number in range(count)], requests

    found, requests = bodies_of(1000, one, after)
    counts = dict.fromkeys(("", "box_1", "box_2", "fish::head"), 0)
    for moved in found:
        assert set(moved) == {"box_1", "box_2", "fish::head", "fish::tail", "floor"}
        there = [name for name in moved if moved[name] is not None and name != "floor"]
        assert there in ([], ["box_1"], ["box_2"], ["fish::head", "fish::tail"])
        counts[there[0] if there else ""] += 1
    expected = np.array([0.2, 0.8 / 3, 0.8 / 3, 0.8 / 3]) * 1000
    chi_squared = ((np.array(list(counts.values())) - expected) ** 2 / expected).sum()
    assert chi_squared < 16.3  # exceeded once in a thousand seeds
    shifts = np.array([moved["box_1"][0, 3] - 3 for moved in found if moved["box_1"] is not None])
    assert abs(shifts).max() <= 0.5 and shifts.std() == pytest.approx(1 / np.sqrt(12), rel=0.1)
    assert requests[1000].bodies == {}  # a scene without any of them
    # which one is there decides no draw of another table
    floor, _ = bodies_of(300, one | {"there": 1.0}, after)
    assert all(np.array_equal(a["floor"], b["floor"]) for a, b in zip(found[:300], floor, strict=True))
    alone, _ = bodies_of(300, {"names": ["box_1"], "one_of": True})
    assert not any(alone)  # it is always there, as it is in the scene


def test_what_is_drawn_holds_for_consecutive_pings_of_a_path(tmp_path):
    """Bodies, water and noise stay for 4 pings, begin anew with each path and scene, and are those of the first one."""
    path = write_job(tmp_path, 10, "")
    other = f'<sdf version="1.9"><world name="other">{BOX}</world></sdf>'
    (tmp_path / "other.sdf").write_text(other)
    orbit = {"kind": "orbit", "centre_m": [3.0, 0.0, 0.0], "radius_m": 2.0, "z_m": 0.0, "turns": 1}
    plain = read_job(path).plain
    plain |= {"scenes": ["tank.sdf", "other.sdf"], "poses": [*plain["poses"], orbit | {"n_pings": 5}]}
    # places that are drawn again until they are clear hold, too
    box = {
        "names": ["box_1"],
        "x_m": [-0.5, 3.5],
        "y_m": [-1.0, 1.0],
        "there": 0.9,
        "reflectivity": [0.1, 0.9],
    }
    wall = {"names": ["wall"], "x_m": [-2.0, 0.0], "clearance_m": 1.0}
    vary = {"bodies": [wall, box | {"clearance_m": 0.1}], "water": {"temperature_c": [2.0, 20.0]}}
    vary["noise"] = {"ambient_db": [-90.0, -60.0]}

    def drawn(**hold):
        requests = BatchRequests(Job(**plain | {"vary": vary | hold}))
        return requests, [
            repr((one.bodies, one.reflectivity, one.water, one.noise.ambient_db)) for one in requests
        ]

    each, held = drawn()[1], drawn(hold_pings=4)
    requests, found = held
    starts = [run.numbers.start for run in requests.runs]
    assert starts == [0, 10, 20, 25] and len(requests) == 30
    firsts = [0, 4, 8, 10, 14, 18, 20, 24, 25, 29]
    assert found == [each[max(first for first in firsts if first <= n)] for n in range(30)]
    assert len(set(found)) == len(firsts)
    assert [requests[n].vehicle_pose.tolist() for n in range(30)] == [
        one.vehicle_pose.tolist() for one in drawn()[0]
    ]
    assert drawn(hold_pings=1)[1] == each
    assert drawn(hold_pings=100)[1] == [each[max(s for s in starts if s <= n)] for n in range(30)]


def test_a_body_takes_along_what_is_named_after_it():
    """As those of MuJoCo, which are bodies in bodies, and no models."""
    names = ["fish", "fish::tail", "crab"]
    scene = sg.Scene([replace(wall(), name=name) for name in names])
    table = MovedTable(names=["*"], apart=True, x_m=[0.0, 1.0])
    job = SimpleNamespace(seed=0, vary=SimpleNamespace(bodies=[table]))
    poses, *_ = MovedBodies(scene, job, paths=[[]]).draw(0, generator(0, VARY_STREAM, 0), 0, 0.0)
    fish, tail, crab = (poses[name][0, 3] for name in names)
    assert fish == tail != crab


def test_draws_depend_neither_on_constants_nor_on_the_order_of_keys():
    def drawn(table):
        return draw_fields(generator(0, VARY_STREAM, 0), table)

    expected = drawn({"salinity_psu": [30.0, 35.0], "temperature_c": [5.0, 20.0]})
    assert drawn({"temperature_c": [5.0, 20.0], "salinity_psu": [30.0, 35.0]}) == expected
    assert drawn({"salinity_psu": 30.0, "temperature_c": [5.0, 20.0]}) == expected | {"salinity_psu": 30.0}


def test_bodies_shift_along_the_axes_of_the_world_and_turn_about_their_own(tmp_path):
    """A box that lies rolled and turned at another place: its position has the shift added, its axes the turn."""
    path = write_job(tmp_path, 2, "")
    scene = tmp_path / "tank.sdf"
    scene.write_text(
        scene.read_text().replace("<pose>3 0.3 -0.3 0 0 0</pose>", "<pose>3 1 -2 0.4 0.3 1.1</pose>")
    )
    shift, turn = (
        {"x_m": 0.5, "y_m": -0.25, "z_m": 0.125},
        {"roll_rad": 0.1, "pitch_rad": -0.2, "yaw_rad": 0.7},
    )
    job = Job(**read_job(path).plain | {"vary": {"bodies": [{"names": ["box_1"], **shift, **turn}]}})
    requests = BatchRequests(job)
    placed = requests.scenes.moved_bodies(0).known["box_1"].pose
    np.testing.assert_allclose(placed, sg.pose(3, 1, -2, 0.4, 0.3, 1.1), atol=1e-12)
    expected = placed @ sg.pose(0, 0, 0, *turn.values())
    expected[:3, 3] = [3.5, 0.75, -1.875]
    for request in requests:
        np.testing.assert_allclose(request.bodies["box_1"], expected, atol=1e-12)


def test_bodies_rest_on_a_floor_however_they_turn(tmp_path):
    """By their lowest corner, on the floor where a table before has moved it; `z_m` buries them."""
    path = write_job(tmp_path, 20, "")
    turn = {"roll_rad": [-3.0, 3.0], "pitch_rad": [-1.5, 1.5], "yaw_rad": [-3.0, 3.0]}
    drawn, resting = {"names": ["box_1"], "x_m": [-1.0, 1.0], "there": 0.7, **turn}, {"rests_on": "floor"}
    floor = {"names": ["floor"], "z_m": [-0.5, 0.0]}

    def found(*tables):
        return [*BatchRequests(Job(**read_job(path).plain | {"vary": {"bodies": list(tables)}}))]

    for depth_m in (0.0, 0.05):
        tables = floor, drawn | {"z_m": -depth_m}
        for request, free in zip(found(floor, tables[1] | resting), found(*tables), strict=True):
            pose = request.bodies["box_1"]
            if pose is None:
                assert free.bodies["box_1"] is None
                continue
            lowest_m = pose[2, 3] - 0.1 * np.abs(pose[2, :3]).sum()  # of a box with edges of 0.2 m
            assert lowest_m == pytest.approx(request.bodies["floor"][2, 3] - depth_m, abs=1e-9)
            assert np.array_equal(np.delete(pose, 11), np.delete(free.bodies["box_1"], 11))  # all but z
    (still,) = {request.bodies["box_1"][2, 3] for request in found({"names": ["box_1"]} | resting)}
    assert still == pytest.approx(-0.3, abs=1e-9)  # half of its height above the floor at -0.4 m


def test_bodies_keep_clear_of_each_other(tmp_path):
    """Also of one that stays. A place that is clear at once is kept."""
    path = write_job(tmp_path, 200, "")
    y_m = {"box_1": 0.0, "box_2": 0.6, "box_3": 0.3, "box_4": 0.3}
    boxes = "".join(BODY.format(name, f"3 {y} -0.3", "0.2 0.2 0.2") for name, y in y_m.items())
    (tmp_path / "tank.sdf").write_text(f'<sdf version="1.9"><world name="tank">{boxes}{WALL}</world></sdf>')
    plain = read_job(path).plain

    def found(side_m, **more):
        reach = {"x_m": [-side_m, side_m], "y_m": [-side_m, side_m], "yaw_rad": [-3.0, 3.0]}
        moved = {"names": ["box_1", "box_2", "box_3"], "apart": True, **reach, **more}
        tables = [{"names": ["box_4"], **more}, moved, {"names": ["wall"], "x_m": [0.0, 1.0]}]
        requests = BatchRequests(Job(**plain | {"vary": {"bodies": tables}}))
        return [one.bodies for one in requests]

    def gaps_m(bodies):
        """The largest gap, along x or y, of each pair; the boxes are 0.2 m long, box_4 at (3, 0.3)."""
        there = [*bodies.values(), sg.pose(3, 0.3)]
        half_m = [0.1 * np.abs(pose[:2, :2]).sum(axis=1) for pose in there]
        pairs = itertools.combinations(range(len(there)), 2)
        return [(np.abs(there[a][:2, 3] - there[b][:2, 3]) - half_m[a] - half_m[b]).max() for a, b in pairs]

    free, clear = found(0.6), found(0.6, clearance_m=0.05)
    walls_m = [[bodies.pop("wall")[0, 3] for bodies in pings] for pings in (free, clear)]
    assert walls_m[0] == walls_m[1]  # no other draw depends on how often a body is redrawn
    n_kept, redrawn = 0, []
    for before, after in zip(free, clear, strict=True):
        assert set(after) == {"box_1", "box_2", "box_3"} and all(pose is not None for pose in after.values())
        assert min(gaps_m(after)) >= 0.05 - 1e-12
        if min(gaps_m(before)) >= 0.05:
            n_kept += 1
            assert all(np.array_equal(before[name], after[name]) for name in before)
        changed = [name for name in before if not np.array_equal(before[name], after[name])]
        redrawn += [round(after[name][1, 3] - y_m[name], 9) for name in changed]
    assert 0 < n_kept < 200
    assert len(set(redrawn)) == len(redrawn) > 100  # each body of each ping has its own draws


def test_a_body_without_a_clear_place_is_absent(tmp_path):
    """It has no reflectivity then, and neither it nor where a later table has moved a body from takes a place."""
    path = write_job(tmp_path, 1, "")
    boxes = BOX + BOX.replace("box_1", "box_2") + BOX.replace("box_1", "box_3")
    (tmp_path / "tank.sdf").write_text(f'<sdf version="1.9"><world name="tank">{boxes}{WALL}</world></sdf>')
    plain, clear = read_job(path).plain, {"clearance_m": 0.1, "reflectivity": 0.5}

    def found(*tables):
        (request,) = BatchRequests(Job(**plain | {"vary": {"bodies": list(tables)}}))
        lacking = [name for name, pose in request.bodies.items() if pose is None]
        assert request.unplaced == [name for name in lacking if tables[-2].get("there") != 0.0]
        assert request.reflectivity == {
            name: 0.5 for name, pose in request.bodies.items() if pose is not None
        }
        return {name: None if pose is None else round(pose[1, 3], 9) for name, pose in request.bodies.items()}

    one, two, three = ({"names": [f"box_{k}"]} | clear for k in (1, 2, 3))
    assert found(one, two, three) == {"box_1": 0.3, "box_2": None, "box_3": None}
    assert found(one, two, three | {"y_m": 0.29}) == {"box_1": 0.3, "box_2": None, "box_3": None}
    assert found(one, two, three | {"y_m": 0.31}) == {"box_1": 0.3, "box_2": None, "box_3": 0.61}
    assert found(one, one | {"y_m": 0.1}) == {"box_1": 0.4}
    assert found(one, one | {"there": 0.0}, two) == {"box_1": None, "box_2": 0.3}


def test_what_rests_takes_plumes_along_and_keeps_its_height_beside_the_floor(tmp_path):
    path = write_job(tmp_path, 1, "")
    floor = BODY.format("floor", "3 0 -0.9", "1 1 1")
    diver = BODY.format("diver", "3 0 -0.2", "0.2 0.2 0.1")
    diver = diver.replace("</link>", "<sonar_gl:bubbles name='breath'/></link>")
    (tmp_path / "tank.sdf").write_text(
        f'<sdf version="1.9"><world name="tank">{BOX}{diver}{floor}</world></sdf>'
    )
    plain, resting = read_job(path).plain, {"rests_on": "floor", "clearance_m": 0.0, "z_m": 0.05}

    def heights_m(names, **more):
        tables = [{"names": names} | resting | more]
        (request,) = BatchRequests(Job(**plain | {"vary": {"bodies": tables}}))
        return [request.bodies[name][2, 3] for name in names]

    assert heights_m(["box_1"]) == pytest.approx([-0.4 + 0.1 + 0.05], abs=1e-9)
    assert heights_m(["box_1"], x_m=2.0) == pytest.approx([-0.3 + 0.05], abs=1e-9)
    # the diver's lower side is 0.15 m above the floor
    assert heights_m(["diver", "breath"]) == pytest.approx([-0.2 - 0.15 + 0.05] * 2, abs=1e-9)


@pytest.mark.parametrize("distances_m", [(0.5, 0.1), (0.1, 0.5)])
def test_bodies_keep_the_larger_distance_of_two_tables_whichever_is_first(tmp_path, distances_m):
    path = write_job(tmp_path, 50, "")
    boxes = "".join(BOX.replace("box_1", f"box_{k}") for k in (1, 2))
    (tmp_path / "tank.sdf").write_text(f'<sdf version="1.9"><world name="tank">{boxes}{WALL}</world></sdf>')
    reach = {"x_m": [-0.8, 0.8], "y_m": [-0.8, 0.8]}
    tables = [
        {"names": [f"box_{k}"], "clearance_m": distance_m, **reach}
        for k, distance_m in zip((1, 2), distances_m, strict=True)
    ]
    for request in BatchRequests(Job(**read_job(path).plain | {"vary": {"bodies": tables}})):
        first, second = request.bodies["box_1"], request.bodies["box_2"]
        assert np.abs(first[:2, 3] - second[:2, 3]).max() - 0.2 >= 0.5 - 1e-12  # boxes of 0.2 m


def test_runs_follow_each_other_a_second_apart_whenever_a_file_of_poses_begins(tmp_path):
    """Along a file that begins at 100 s, in two scenes, and then along a sector."""
    path = write_job(tmp_path, 2, "")
    (tmp_path / "other.sdf").write_text((tmp_path / "tank.sdf").read_text())
    (tmp_path / "dive.csv").write_text("t,x,y,z,roll,pitch,yaw\n100,0,0,0,0,0,0\n100.5,1,0,0,0,0,0\n")
    plain = read_job(path).plain
    poses = [{"kind": "trajectory", "file": "dive.csv"}, *plain["poses"]]
    requests = BatchRequests(
        read_job(path).model_copy(update={"poses": poses, "scenes": ["tank.sdf", "other.sdf"]})
    )
    times = [100.0, 100.5, 101.5, 102.0, 103.0, 103.2, 104.2, 104.4]
    assert [request.time_s for request in requests] == pytest.approx(times, abs=1e-9)
    assert [request.scene for request in requests] == [0, 0, 1, 1] * 2


def test_a_table_of_poses_may_be_for_some_scenes_alone(tmp_path):
    """Numbers, times and views of a ping are those that it has in a job whose other tables are left out or moved."""
    path = write_job(tmp_path, 2, "")
    names = ["tank.sdf", "pool.sdf", "dock.sdf"]
    for name in names[1:]:
        shutil.copy(tmp_path / "tank.sdf", tmp_path / name)
    (sector,) = read_job(path).plain["poses"]
    views = {"kind": "random_views", "target_m": [3.0, 0.0, 0.0], "range_m": [1.0, 2.0], "n_pings": 1}
    tables = [sector | {"scenes": ["dock.sdf", "tank.sdf"]}, views | {"scenes": ["pool.sdf"]}, views]
    job = read_job(path).model_copy(update={"scenes": names, "poses": tables})
    requests = BatchRequests(job)
    assert [request.scene for request in requests] == [0, 0, 2, 2, 1, 0, 1, 2]
    times_s = [0.0, 0.2, 1.2, 1.4, 2.4, 3.4, 4.4, 5.4]
    assert [request.time_s for request in requests] == pytest.approx(times_s, abs=1e-9)
    everywhere = BatchRequests(job.model_copy(update={"poses": [sector, views, views]}))
    for number, other in zip(range(8), (0, 1, 0, 1, 6, 9, 9, 9), strict=True):
        assert np.array_equal(requests[number].vehicle_pose, everywhere[other].vehicle_pose)


def test_scenes_of_poses_are_those_of_the_job_and_each_has_poses(tmp_path):
    path = write_job(tmp_path, 2, "")
    shutil.copy(tmp_path / "tank.sdf", tmp_path / "pool.sdf")
    text = path.read_text().replace('["tank.sdf"]', '["tank.sdf", "pool.sdf"]')
    for key, message in (
        ('scenes = ["tank"]', "poses[0].scenes: unknown scene (got 'tank'; did you mean 'tank.sdf'?)"),
        ("scenes = [1]", "poses[0].scenes: unknown scene (got 1; known are pool.sdf, tank.sdf)"),
        (
            'scenes = "tank.sdf"',
            "poses[0].scenes must be a list of scenes (got 'tank.sdf'; leave it out for all scenes of the job)",
        ),
        (
            "scenes = []",
            "poses[0].scenes must be a list of scenes (got []; leave it out for all scenes of the job)",
        ),
        (
            'scenes = ["tank.sdf"]',
            "scenes[1] must have poses (got 'pool.sdf', which no table of poses has in its scenes; name it in one, or "
            "leave it out)",
        ),
        ('scene = ["tank.sdf"]', "poses[0]: unknown key (got 'scene'; did you mean 'scenes' or 'sweep_s'?)"),
    ):
        path.write_text(text.replace('kind = "sector"', f'kind = "sector"\n{key}'))
        with pytest.raises(sg.Error) as caught:
            BatchRequests(read_job(path))
        assert str(caught.value) == f"{path}: {message}"


def test_sonars_have_the_mounts_ranges_and_bins_of_the_job(tmp_path):
    """Of 80 bins from 0.5 to 8.5 m: another range keeps their length, unless their number is given, too."""
    path = write_job(tmp_path, 2, "")
    tables = [
        {"name": "plain", "sonar": "small.toml", "mount": [0.1, -0.2, 0.3, 0.4, -0.5, 0.6]},
        {"name": "near", "sonar": "small.toml", "range_m": 6.5},
        {"name": "fine", "sonar": "small.toml", "bins": 160},
        {"name": "both", "sonar": "small.toml", "range_m": 6.5, "bins": 30},
    ]
    requests = BatchRequests(Job(**read_job(path).plain | {"sonars": tables}))
    np.testing.assert_array_equal(requests.mounts["plain"], sg.pose(0.1, -0.2, 0.3, 0.4, -0.5, 0.6))
    assert all((requests.mounts[name] == np.eye(4)).all() for name in ("near", "fine", "both"))
    found = {name: (sonar.range_max_m, sonar.n_bins) for name, sonar in requests.sonars.items()}
    assert found == {"plain": (8.5, 80), "near": (6.5, 60), "fine": (8.5, 160), "both": (6.5, 30)}
    vehicle, request = requests[1].vehicle_pose, requests[1]
    np.testing.assert_array_equal(
        request.for_sonar(requests.mounts["plain"]).pose, vehicle @ requests.mounts["plain"]
    )


def test_each_sonar_has_noise_of_its_own_and_each_ping_other_draws(requests):
    assert len({requests.noise_seed(name) for name in requests.sonars}) == 2
    many = BatchRequests(requests.job.model_copy(update={"poses": [requests.job.poses[0] | {"n_pings": 40}]}))
    assert len({request.water.temperature_c for request in many}) == 40


def test_of_two_tables_that_name_a_body_the_later_one_counts(tmp_path):
    """As a whole, also where it changes nothing: "*" moves, and `floor` after it stays."""
    path = write_job(tmp_path, 40, "")
    tables = [
        {"names": ["*"], "apart": True, "x_m": [1.0, 2.0], "reflectivity": 0.9},
        {"names": ["floor"]},
        {"names": ["box_1"], "there": 0.5},
        {"names": ["wall"], "reflectivity": 0.1},
    ]
    job = Job(**read_job(path).plain | {"vary": {"bodies": tables}})
    requests = BatchRequests(job)
    wall = {body.name: body.pose for body in requests.scenes[0].bodies}["wall"]
    boxes = []
    for request in requests:
        assert request.reflectivity == {"wall": 0.1}
        assert set(request.bodies) - {"box_1"} == {"wall"}
        np.testing.assert_array_equal(request.bodies["wall"], wall)
        boxes.append(request.bodies.get("box_1", "unmoved"))
    assert {box is None for box in boxes} == {True, False}
    assert all(box is None or box == "unmoved" for box in boxes)


def test_random_views_differ_from_table_to_table_and_are_the_same_in_every_scene(tmp_path):
    """Two tables are more views, not the same again; nor are they those of another job."""
    views = {"kind": "random_views", "target_m": [3.0, 0.0, 0.0], "range_m": [1.0, 2.0], "n_pings": 3}
    write_job(tmp_path, 2, "")
    (tmp_path / "other.sdf").write_text((tmp_path / "tank.sdf").read_text())
    orbit = {
        "kind": "orbit",
        "centre_m": [3.0, 0.0, 0.0],
        "radius_m": 1.0,
        "z_m": 0.0,
        "n_pings": 3,
        "turns": 1,
    }
    job = Job(**read_job(tmp_path / "job.toml").plain | {"scenes": ["tank.sdf", "other.sdf"]})

    def poses(seed, *tables):
        """Return the poses of each table in each scene, (tables, scenes, 3, 4, 4)."""
        requests = BatchRequests(job.model_copy(update={"seed": seed, "poses": list(tables)}))
        return np.reshape([one.vehicle_pose for one in requests], (len(tables), 2, 3, 4, 4))

    found = poses(1, views, orbit, views, views)
    assert np.array_equal(found[:, 0], found[:, 1])
    all_views = [*found[[0, 2, 3], 0].reshape(9, 16), *poses(2, views, views)[:, 0].reshape(6, 16)]
    assert len({tuple(one) for one in all_views}) == 15
    alone, stated = poses(1, views), poses(1, views, views | {"seed": 1})
    assert np.array_equal(found[0], alone[0])
    assert np.array_equal(stated[0], alone[0]) and np.array_equal(stated[1], alone[0])


@pytest.mark.slow
@pytest.mark.parametrize(("low", "high"), [(2, 5), (1, 2), (3, 3)])
def test_varied_looks_are_whole_numbers_each_equally_probable(small, low, high):
    """Of 600 draws each of n numbers has 600 / n, but for four standard deviations."""
    job = read_job(small / "job.toml")
    poses = [job.poses[0] | {"n_pings": 600}]
    vary = job.vary.model_copy(update={"noise": {"looks": [low, high]}})
    requests = BatchRequests(job.model_copy(update={"vary": vary, "poses": poses}))
    drawn = [request.noise.looks for request in requests]
    share = 1 / (high - low + 1)
    assert {type(looks) for looks in drawn} == {int} and set(drawn) == set(range(low, high + 1))
    for looks in range(low, high + 1):
        assert abs(drawn.count(looks) - 600 * share) <= 4 * math.sqrt(600 * share * (1 - share))
    again = [request.noise.looks for request in reversed(requests)]
    assert again == drawn[::-1]


def test_looks_that_are_no_whole_numbers_are_refused(small):
    job = read_job(small / "job.toml")
    for looks in ([1.5, 3], [1, 2.5], 1.5):
        vary = job.vary.model_copy(update={"noise": {"looks": looks}})
        with pytest.raises(sg.Error, match=r"job.toml: vary.noise.looks must be whole numbers .got \d.5.$"):
            BatchRequests(job.model_copy(update={"vary": vary}))


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


HARD = """<model name="rod"><static>true</static><pose>3.2 1.0 0.2 0.6 0 0</pose><link name="l"><collision name="c">
<geometry><cylinder><radius>0.004</radius><length>0.5</length></cylinder></geometry></collision></link></model>"""


@pytest.fixture(scope="module")
def hard(tmp_path_factory):
    """The job file of a batch with a thin rod that some of its pings see."""
    folder = tmp_path_factory.mktemp("hard")
    path = write_plain_job(folder, 8, 2)
    scene = folder / "tank.sdf"
    scene.write_text(scene.read_text().replace("</world>", f"{HARD}</world>"))
    text = path.read_text().replace("pan_rad = [-0.2, 0.2]", "pan_rad = [-1.5, 0.6]")
    text = text.replace("tolerance = 0.05", "tolerance = 0.01")
    # a box ends before the wall's edge, which takes more samples than the rod in the skirts of a line array
    path.write_text(text.replace('"physical"\ntvg', '"physical"\nelevation_pattern = "box"\ntvg'))
    return path


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


@pytest.mark.slow
def test_a_dry_run_names_the_views_that_need_the_most_samples(hard):
    status, shown, _ = run("batch", hard, "--dry-run", "--workers", "9")
    lines = shown.splitlines()
    at = next(k for k, line in enumerate(lines) if line.startswith("level in tank.sdf: "))
    assert status == 0 and lines[at].endswith(" of 8 pings")
    assert lines[at + 1].startswith("  ping ") and "vehicle at '0 0 0 " in lines[at + 1]
    assert " samples for body 'rod', estimated error 0.0" in lines[at + 1]
    assert lines[at + 4].startswith("8 pings in 4 parts")
    rate, ms = re.fullmatch(
        r"speed: (\S+) pings a second in one process \((\S+) ms a ping, on .*; measured on this machine by pings 0, 7, "
        r"after all was compiled\)",
        lines[at + 6],
    ).groups()
    assert float(rate) * float(ms) == pytest.approx(1000, rel=0.02)  # of three figures, and of 0.1 ms
    one_s = re.match(r"time: (\S+) seconds for all pings in one process, ", lines[at + 7])[1]
    assert float(one_s) == pytest.approx(8e-3 * float(ms), rel=0.02)
    assert lines[at + 7].endswith(" at best in 4, if each has as many cores")  # no more processes than parts


def test_a_survey_says_what_decides_the_samples_of_each_ping(tmp_path, monkeypatch):
    """The whole, or a body that is nearer to its bound of five times the tolerance. It warns of nothing."""
    batch, poses = open_batch(write_job(tmp_path, 3, ""), tmp_path / "out"), []
    needs = [(0.04, 0.15, 1, True, 100), (0.02, 0.15, 1, True, 200), (0.02, 0.6, 2, False, 300)]

    def choose(search, setup):
        number = round(setup.request.time_s / 0.2)
        poses.append(setup.head_pose)
        warn_caller("the tolerance cannot be met", ToleranceWarning)
        plan = Plan(sg.Sampling(1, 8), 3, *needs[number])
        return SimpleNamespace(echo=SimpleNamespace(total=float(number))), plan

    monkeypatch.setattr(LevelSearch, "choose", choose)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = survey(batch, 0)
    one, other, *_ = (body.name for body in batch.requests.scenes[0].bodies)
    expected = [
        (100, 0.04, "", False, ""),
        (200, 0.02, one, True, ""),
        (300, pytest.approx(0.12), other, True, ""),
    ]
    sonars = list(batch.requests.sonars)
    assert found == [(number, name, *view) for name in sonars for number, view in enumerate(expected)]
    mounts = batch.requests.mounts.values()
    np.testing.assert_array_equal(
        poses, [one.vehicle_pose @ mount for mount in mounts for one in batch.requests]
    )


def test_a_survey_that_fails_has_reported_its_warnings(tmp_path, monkeypatch):
    batch, reports = open_batch(write_job(tmp_path, 3, ""), tmp_path / "out"), []

    def choose(search, setup):
        warn_caller("the water is cold")
        raise sg.Error("the samples do not fit")

    monkeypatch.setattr(LevelSearch, "choose", choose)
    with pytest.raises(sg.Error, match="do not fit"):
        survey(batch, 0, lambda *told: reports.append(told))
    sonar, scene = next(iter(batch.requests.sonars)), batch.requests.job.scenes[0]
    assert reports == [("warning", f"warning: {sonar} in {scene}: the water is cold")]


@pytest.mark.slow
@pytest.mark.parametrize(("n_scenes", "more"), [(1, 0), (2, 0), (2, 20)])
def test_the_cost_of_a_ping_is_that_of_pings_spread_over_the_job(tmp_path, monkeypatch, n_scenes, more):
    """By a clock that a ping n advances by n milliseconds, and a thousand times as much the first time.

    more : further pings before them, of the second scene alone
    """
    path, now_s, made = write_job(tmp_path, 40, MORE.replace("[coco]\nheight = 100", "")), [0.0], []
    shutil.copy(tmp_path / "tank.sdf", tmp_path / "pool.sdf")
    text = path.read_text().replace("pings_per_part = 4", "pings_per_part = 12")
    text = text.replace('["tank.sdf"]', str(["tank.sdf", "pool.sdf"][:n_scenes]))
    if more:
        at = text.index("[[poses]]")
        poses = text[at : text.index("[[vary.bodies]]")].replace("n_pings = 40", f"n_pings = {more}")
        text = f'{text[:at]}{poses}scenes = ["pool.sdf"]\n{text[at:]}'
    path.write_text(text)
    batch = open_batch(path, tmp_path / "out")
    number_at = {request.time_s: request.number for request in batch.requests}
    begin(batch).save(batch.folder)
    create_store(batch)

    def timed(run, requests):
        requests = list(requests)
        for number in (number_at[request.time_s] for request in requests):
            now_s[0] += number * (1e-3 if made.count(number) >= 2 else 1.0) / 2  # two sonars
            made.append(number)
        return sequence.make_pings(run, iter(requests))

    monkeypatch.setattr(parts, "make_pings", timed)
    monkeypatch.setattr(survey_module.time, "perf_counter", lambda: now_s[0])
    cost = try_pings(batch)
    numbers = np.arange(more + 40 * n_scenes)
    is_first = (numbers >= more) & (numbers < more + 40)
    n_each = 12 if n_scenes == 1 else 8  # of two scenes a chunk of each, more than half a part
    of_scenes = [numbers[is_first], numbers[~is_first]][:n_scenes]
    expected = [one[np.linspace(0, len(one) - 1, n_each).round().astype(int)] for one in of_scenes]
    expected = np.sort(np.concatenate(expected))
    assert cost.numbers == tuple(expected.tolist())
    assert all(made.count(number) == 4 for number in expected) and len(made) == 4 * len(expected)
    weights = np.where(is_first[expected], 40, 40 + more)  # pings of each scene
    assert cost.seconds_per_ping == pytest.approx(1e-3 * np.average(expected, weights=weights), rel=1e-9)
    batch.close()


@pytest.mark.slow
def test_a_dry_run_says_how_often_each_class_is_seen_in_each_scene(tmp_path):
    """As the labels of the finished batch do; a class without a body in a scene is none that could be seen there."""
    path = write_plain_job(tmp_path, 8, 4, LABELS)  # more pings than a part has
    (tmp_path / "pool.sdf").write_text(f'<sdf version="1.9"><world name="pool">{WALL}</world></sdf>')
    text = path.read_text().replace('["tank.sdf"]', '["pool.sdf", "tank.sdf"]')
    text = text.replace('target = ["box*"]', 'target = ["box*"]\nbehind = ["lost"]')
    text = text.replace('"wall", "floor"', '"wall"')  # the floor is of no class
    path.write_text(text.replace("[labels]", '[[vary.bodies]]\nnames = ["box_1"]\nthere = 0.3\n[labels]'))
    lost = BOX.replace("box_1", "lost").replace("3 0.3 -0.3", "-3 0 0")
    tank = (tmp_path / "tank.sdf").read_text()
    (tmp_path / "tank.sdf").write_text(tank.replace("</world>", lost + "</world>"))
    text = path.read_text()
    path.write_text(text.replace('"shadow", ', ""))
    batch = open_batch(path, tmp_path / "trial")
    begin(batch).save(batch.folder)
    create_store(batch)
    n_outputs = len(batch.maker.outputs)
    tried = try_pings(batch)
    assert len(batch.maker.outputs) == n_outputs
    batch.close()
    make_all(path, tmp_path / "out")
    found = xr.open_dataset(tmp_path / "out" / "pings.zarr")
    assert found.attrs["classes"] == ["fixed", "target", "behind"]
    bins = [(found.class_id == number).sum(("beam", "range")).values for number in (1, 2, 3)]
    assert len(tried.numbers) == 2 * 4  # of each scene no more than a part has
    in_pool, in_tank = tried.seen
    assert (in_tank.scene, in_tank.sonar, in_tank.n_pings) == (1, "level", 8) and in_pool.scene == 0
    fixed, target = (one[8:] for one in bins[:2])
    assert not bins[2].any() and 0 < (target > 0).sum() <= 4  # else the median of all is much the same
    assert in_tank.classes == [
        ("behind", 0, 0),
        ("target", (target > 0).sum(), int(np.median(target[target > 0]))),
        ("fixed", 8, int(np.median(fixed))),
    ]
    assert in_pool.classes == [("fixed", 8, int(np.median(bins[0][:8])))]
    shown = run("batch", path, "--dry-run", "--workers", "1")[1]
    lines = [line for line in shown.splitlines() if line.startswith("  labels of")]
    assert len(lines) == 2 and lines[1].startswith(
        "  labels of 8 pings, with the median of their bins: behind in none, target in "
    )
    path.write_text(text[: text.index("[labels]")])
    assert "labels of" not in run("batch", path, "--dry-run", "--workers", "1")[1]


@pytest.mark.parametrize(
    ("part", "more", "line"),
    [
        (
            4,
            "[ros]\n",
            "8 pings in 2 parts of 4, each a file of the bag (a larger pings_per_part makes fewer files)",
        ),
        (8, "[ros]\n", "8 pings in 1 part"),
        (4, "", "8 pings in 2 parts of 4"),
    ],
)
def test_a_dry_run_says_of_how_many_files_a_bag_is(tmp_path, monkeypatch, part, more, line):
    use_inline_pool(monkeypatch)
    job = write_plain_job(tmp_path, 8, part, more)
    assert line in run("batch", job, "--dry-run", "--workers", "1")[1].splitlines()


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


@pytest.mark.slow
def test_a_film_that_cannot_be_made_is_refused_before_the_first_ping(tmp_path):
    """Video of MPEG-4 part 2 has no 8192 rows; a batch with all pings made could not be completed without its film."""
    more = '[pictures]\nformats = ["mp4"]\nheight = 8192'
    batch = open_batch(write_job(tmp_path, 2, LABELS + more), tmp_path / "out")
    with pytest.raises(sg.Error) as caught:
        begin(batch)
    batch.close()
    pattern = r".*job\.toml.*: pictures: the film of 'level': OpenCV cannot write an MP4 of \d+ x \d+ pixels here; .*"
    assert re.fullmatch(pattern, str(caught.value))


@pytest.mark.slow
def test_a_film_that_failed_is_made_by_the_next_try(small, tmp_path, monkeypatch):
    """As on a full disk: the batch is complete once there is room."""
    out = shutil.copytree(small / "out", tmp_path / "out")
    before = files_of(out)
    for name in ("level.mp4", "done.json"):
        (out / name).unlink()

    def full(*_):
        raise sg.Error("the disk is full")

    batch = open_batch(small / "job.toml", out)
    with monkeypatch.context() as patch:
        patch.setattr(outputs, "save_animation", full)
        with pytest.raises(sg.Error, match=r"^the disk is full$"):
            finalize(batch)
    finalize(batch)
    batch.close()
    assert files_of(out) == before


def test_coco_finds_bodies_where_the_labels_are_but_for_what_boxes_leave_out(small, requests, pings, quiet):
    for sonar in requests.sonars:
        folder = small / "out" / "coco" / sonar
        coco = COCO(str(folder / "instances.json"))
        assert coco.getImgIds() == list(range(N))
        assert [c["name"] for c in coco.loadCats(coco.getCatIds())] == ["fixed", "target"]
        for number, ping in enumerate(pings[sonar]):
            (image,) = coco.loadImgs(number)
            picture = cv2.imread(str(folder / "images" / image["file_name"]), cv2.IMREAD_UNCHANGED)
            mask = cv2.imread(str(folder / "masks" / image["file_name"]), cv2.IMREAD_UNCHANGED)
            bodies = body_map(ping, 100, quiet[sonar][number])
            assert np.array_equal(mask, np.where(picture > 0, bodies, 0))
            law = sg.Counts(**image["counts"])
            assert law == ping.counts_law() and np.array_equal(
                picture, law.counts_of(sg.fan_image(ping, 100, law))
            )
            annotations = coco.loadAnns(coco.getAnnIds(number))
            assert {a["body_id"] for a in annotations} == set(np.unique(mask)) - {0}
            for annotation in annotations:
                assert np.array_equal(coco.annToMask(annotation), mask == annotation["body_id"])


def test_annotations_state_the_share_of_own_echo_in_what_their_bins_hold(small, requests, pings, quiet):
    """Beside all other echo and the mean of the receiver's noise, which differs from ping to ping."""
    found = []
    for sonar in requests.sonars:
        coco = COCO(str(small / "out" / "coco" / sonar / "instances.json"))
        for request, noisy, ping in zip(requests, pings[sonar], quiet[sonar], strict=True):
            whole, boxes = ping.intensity + receiver_power(ping, request.noise), boxes_of(noisy, 100, ping)
            for one in coco.loadAnns(coco.getAnnIds(request.number)):
                row = boxes.body_id.tolist().index(one["body_id"])
                (beam, last_beam), (bin_, last_bin) = boxes.beams[row], boxes.bins[row]
                inside = np.s_[beam : last_beam + 1, bin_ : last_bin + 1]
                is_own = noisy.body_id[inside] == one["body_id"]
                own = (noisy.share * ping.intensity)[inside][is_own]
                assert one["own_share"] == pytest.approx(own.sum() / whole[inside][is_own].sum(), abs=1e-3)
                found.append(one["own_share"])
    assert len(set(found)) > 10 and 0 < min(found) < 0.9 < max(found) <= 1


@pytest.mark.slow
def test_bodies_of_few_pixels_have_no_annotation_if_the_job_wants_none(small, tmp_path):
    """Only these differ, and images and masks do not."""
    path = write_job(tmp_path, 2, LABELS + "[coco]\nheight = 100\nmin_area = 40\n")
    make_all(path, tmp_path / "out")
    of_all, left_out = [], 0
    for sonar in ("level", "upright"):
        folder = Path("coco") / sonar
        every, large = (COCO(str(at / "out" / folder / "instances.json")) for at in (small, tmp_path))
        for number in range(2):
            found = every.loadAnns(every.getAnnIds(number))
            of_all += found
            assert large.loadAnns(large.getAnnIds(number)) == [one for one in found if one["area"] >= 40]
            left_out += sum(one["area"] < 40 for one in found)
            (image,) = large.loadImgs(number)
            for kind in ("images", "masks"):
                name = folder / kind / image["file_name"]
                assert (tmp_path / "out" / name).read_bytes() == (small / "out" / name).read_bytes()
    assert 0 < left_out < len(of_all)


RIG = """<model name="rig"><pose>3 0.2 -0.3 0 0 0</pose>{}</model>
<model name="rig2"><static>true</static><pose>4 -0.6 -0.3 0 0 0</pose>{}</model>
"""
LINK = """<link name="{}"><pose>{} 0 0 0 0 0</pose><collision name="c">
<geometry><box><size>0.2 0.2 0.2</size></box></geometry><laser_retro>120</laser_retro></collision></link>
"""


@pytest.mark.parametrize("together", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_bodies_of_one_model_and_class_are_one_instance_of_coco(tmp_path, together):
    path, links = write_plain_job(tmp_path, 2, 2, ""), LINK.format("a", 0) + LINK.format("b", 0.5)
    scene = (tmp_path / "tank.sdf").read_text().replace(BOX, RIG.format(links, LINK.format("a", 0)))
    (tmp_path / "tank.sdf").write_text(scene)
    classes = 'rigs = ["rig*"]' if together else 'rigs = ["rig::a", "rig2"]\nother = ["rig::b"]'
    with path.open("a") as job:
        job.write(
            f"[labels]\nlayers = ['body', 'boxes']\n[labels.classes]\n{classes}\n[coco]\nheight = 200\n"
        )
    make_all(path, tmp_path / "out")
    data = xr.open_dataset(tmp_path / "out" / "pings.zarr")
    assert data.attrs["bodies"] == ["wall", "rig::a", "rig::b", "rig2", "floor"]
    folder = tmp_path / "out" / "coco" / "level"
    coco = COCO(str(folder / "instances.json"))
    for number in range(2):
        stored = data.isel(ping=number)
        assert {2, 3, 4} < set(np.unique(stored.body_id))  # the arrays have each body
        mask = cv2.imread(str(folder / "masks" / "00000" / f"{number:08d}.png"), cv2.IMREAD_UNCHANGED)
        assert set(np.unique(mask)) == ({0, 1, 2, 4, 5} if together else {0, 1, 2, 3, 4, 5})
        found = coco.loadAnns(coco.getAnnIds(number))
        told = [
            (one["id"] - 65536 * number, one["body_id"], one["body"], one["category_id"]) for one in found
        ]
        names = ["rig", "rig2"] if together else ["rig::a", "rig::b", "rig2"]
        classes = [1, 1] if together else [1, 2, 1]
        numbers = [2, 4] if together else [2, 3, 4]
        assert told == list(zip(numbers, numbers, names, classes, strict=True))
        for one in found:
            assert np.array_equal(coco.annToMask(one), mask == one["body_id"])
            bodies = [1, 2] if together and one["body_id"] == 2 else [one["body_id"] - 1]
            assert one["echo"] == pytest.approx(float(stored.body_echo[bodies].sum()), rel=1e-5)


@pytest.mark.slow
def test_layers_boxes_and_masks_leave_out_what_the_noise_hides(tmp_path):
    """Beside the same batch without noise: whether a bin keeps its label follows from its echo there."""
    data, masks, noise = {}, {}, sg.Noise(self_noise=True, ambient_db=-32.0)
    for name, text in (("quiet", 'preset = "none"'), ("noisy", "self_noise = true\nambient_db = -32.0")):
        (folder := tmp_path / name).mkdir()
        path = write_plain_job(folder, 2, 2, LABELS + "[coco]\nheight = 100\n[arrays]\nmantissa_bits = 23")
        path.write_text(path.read_text().replace('preset = "physical"', text))
        make_all(path, folder / "out")
        data[name] = xr.open_dataset(folder / "out" / "pings.zarr")
        found = sorted((folder / "out" / "coco" / "level" / "masks").rglob("*.png"))
        masks[name] = [cv2.imread(str(one), cv2.IMREAD_UNCHANGED) for one in found]
    requests = BatchRequests(read_job(path))
    about = {"sonar": requests.sonars["level"], "acoustics": requests.acoustics}
    for number in range(2):
        quiet, noisy = (data[name].isel(ping=number) for name in ("quiet", "noisy"))
        arrays = quiet.intensity.values, quiet.azimuth_rad.values, quiet.range.values
        ping = sg.Ping(*arrays, **about)
        # the share is stored in steps of 1/255
        least, most = ((quiet.share.values + step / 510) * ping.intensity for step in (-1, 1))
        power, labels = receiver_power(ping, noise), noisy.body_id.values
        assert (labels[least > power] == quiet.body_id.values[least > power]).all()
        assert not labels[most < power].any() and np.mean((least <= power) & (power <= most)) < 0.01
        assert ((labels == quiet.body_id.values) | (labels == 0)).all()
        assert np.array_equal(noisy.shadow, quiet.shadow)
        assert 0 < (labels > 0).sum() < 0.9 * (quiet.body_id.values > 0).sum()
        ping = replace(ping, body_id=labels, body_echo=np.zeros(1 + len(noisy.body_bins)))
        boxes, mask = boxes_of(ping, 512), masks["noisy"][number]
        assert np.array_equal(noisy.body_bins[boxes.body_id - 1], boxes.n_bins)
        # black pixels belong to no body
        assert (mask[mask > 0] == body_map(ping, 100)[mask > 0]).all()
        assert 0 < (mask > 0).sum() < 0.9 * (masks["quiet"][number] > 0).sum()


@pytest.mark.slow
def test_the_level_of_a_job_is_that_of_its_labels(tmp_path, pings):
    """Layers, boxes and masks are those of pings with this level; by default they are what the display shows."""
    level_db = -25.0
    path = write_job(
        tmp_path, 2, LABELS.replace("[labels]", f"[labels]\nlevel_db = {level_db}") + "[coco]\nheight = 100"
    )
    make_all(path, tmp_path / "out")
    requests = BatchRequests(read_job(path))
    made, quiet = (pings_of(tmp_path, requests, level_db, with_noise) for with_noise in (True, False))
    for sonar in made:
        data = xr.open_dataset(tmp_path / "out" / "pings.zarr", group=sonar)
        for number, (ping, without) in enumerate(zip(made[sonar], quiet[sonar], strict=True)):
            stored, boxes = data.isel(ping=number), boxes_of(ping, 512, without)
            assert np.array_equal(stored.body_id, ping.body_id)
            assert 0 < (ping.body_id > 0).sum() < (pings[sonar][number].body_id > 0).sum()
            assert np.array_equal(stored.body_bins[boxes.body_id - 1], boxes.n_bins)
            mask = tmp_path / "out" / "coco" / sonar / "masks" / "00000" / f"{number:08d}.png"
            mask = cv2.imread(str(mask), cv2.IMREAD_UNCHANGED)
            bodies = body_map(ping, 100, without)
            assert (mask[mask > 0] == bodies[mask > 0]).all() and (mask > 0).any()


def test_pictures_and_npz_files_are_those_of_a_simulator(small, pings):
    for number in (0, N - 1):
        ping = pings["upright"][number]
        name = f"upright/00000/{number:08d}"
        loaded = sg.load_npz(small / "out" / "npz" / f"{name}.npz")
        assert np.array_equal(loaded.intensity, ping.intensity)
        assert loaded.meta["ping_number"] == number
        picture = cv2.imread(str(small / "out" / "png" / f"{name}.png"))[..., ::-1]
        assert np.array_equal(picture, sg.colorize(sg.fan_image(ping, 60)))
    film = cv2.VideoCapture(str(small / "out" / "level.mp4"))
    assert film.get(cv2.CAP_PROP_FRAME_COUNT) == N


def test_the_bag_holds_every_ping_in_order(small, pings):
    with AnyReader([small / "out" / "bag"]) as reader:
        topics = {c.topic: c.msgcount for c in reader.connections}
        assert topics["/level/projected_image"] == topics["/upright/projected_image"] == N
        assert topics["/level/image"] == N
        times = [t / 1e9 for c, t, _ in reader.messages() if c.topic == "/level/projected_image"]
    assert times == pytest.approx([p.meta["time_s"] for p in pings["level"]], abs=1e-9)


def test_optical_images_are_stored_with_the_pings(small, tmp_path):
    more = "[optical]\nwidth = 40\nheight = 30\nmount = [0, 0, 0, 0, -1.3, 0]\n[ros]\n"
    write_job(tmp_path, 4, more)
    make_all(tmp_path / "job.toml", tmp_path / "out")
    names = sorted(path.name for path in (tmp_path / "out" / "optical" / "rgb").rglob("*.png"))
    assert names == [f"{n:08d}.png" for n in range(4)]
    depth = cv2.imread(str(tmp_path / "out/optical/depth/00000/00000000.png"), cv2.IMREAD_UNCHANGED)
    assert depth.dtype == np.uint16 and depth.shape == (30, 40)
    with AnyReader([tmp_path / "out" / "bag"]) as reader:
        topics = {c.topic: c.msgcount for c in reader.connections}
        of_depth = [c for c in reader.connections if c.topic == "/camera/depth"]
        raw = [reader.deserialize(raw, c.msgtype).data for c, _, raw in reader.messages(of_depth)]
    assert topics["/camera/image"] == topics["/camera/depth"] == topics["/camera/camera_info"] == 4
    # as depth_image_proc reads it: what is finite is a point, also 0
    metres = np.frombuffer(raw[0].tobytes(), "<f4").reshape(30, 40)
    assert np.array_equal(np.isfinite(metres), depth > 0) and not (depth > 0).all()


@pytest.mark.slow
def test_optical_images_are_rendered_on_the_device_of_the_process(tmp_path, monkeypatch):
    """As pings are; processes of a batch share several devices."""
    devices = []

    def camera(_scene, camera, device=None):
        devices.append(device)
        size = camera.height, camera.width
        return lambda *_: (np.zeros((*size, 3), np.uint8), np.zeros(size, np.float32))

    monkeypatch.setattr(outputs, "OpticalCamera", camera)
    job = read_job(write_job(tmp_path, 2, "[optical]\nwidth = 40\nheight = 30\n"))
    batch = Batch(BatchRequests(job), Folder(tmp_path / "out"), device=0)
    begin(batch).save(batch.folder)
    create_store(batch)
    make_part(batch, 0)
    batch.close()
    assert devices == [0]  # None is the default


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


@pytest.mark.parametrize("bits", [1, 5, 12, 22])
def test_mantissas_are_rounded_within_the_stated_error(bits):
    values = np.exp(np.random.default_rng(0).uniform(-80, 80, 10000)).astype(np.float32)
    rounded = round_mantissa(values, bits)
    error = np.abs(rounded.astype(float) - values) / values
    assert error.max() <= 2.0 ** -(bits + 1)
    half = 2.0 ** -(bits + 1)  # half a step above 1, where the relative error is largest
    assert error.max() == pytest.approx(half / (1 + half), rel=0.02)
    assert (rounded.view(np.uint32) & ((1 << (23 - bits)) - 1) == 0).all()
    assert round_mantissa(np.zeros(3, np.float32), bits).tolist() == [0, 0, 0]
    assert round_mantissa(values, 23) is values


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


def test_a_scene_may_be_a_xacro_file_with_arguments(tmp_path):
    write_job(tmp_path, 2, "[labels]\n")
    (tmp_path / "robots").mkdir()
    (tmp_path / "robots" / "wall.xacro").write_text(
        "<robot name='r' xmlns:xacro='http://www.ros.org/wiki/xacro'><link name='$(arg name)'><collision><geometry>"
        "<box size='1 1 1'/></geometry></collision></link>"
        "<gazebo reference='$(arg name)'><laserRetro>9</laserRetro></gazebo></robot>"
    )
    scenes = ["robots/wall.xacro name:=a", "robots/wall.xacro name:=b"]
    job = Job(**read_job(tmp_path / "job.toml").plain | {"scenes": scenes, "vary": {}})
    assert tmp_path / "robots" / "wall.xacro" in job.files()
    requests = BatchRequests(job)
    assert [requests.scenes[index].bodies[0].name for index in (0, 1)] == ["a", "b"]


def test_bodies_of_several_scenes_have_numbers_of_their_own(tmp_path):
    write_job(tmp_path, 2, "[labels]\n")
    text = (tmp_path / "tank.sdf").read_text()
    (tmp_path / "other.sdf").write_text(
        text.replace("box_1", "rock_2").replace('world name="tank"', 'world name="o"')
    )
    job = read_job(tmp_path / "job.toml")
    job = job.model_copy(update={"scenes": ["tank.sdf", "other.sdf"]})
    requests = BatchRequests(job)
    assert len(requests) == 4
    assert [request.scene for request in requests] == [0, 0, 1, 1]
    # there is a second between runs
    assert [request.time_s for request in requests] == pytest.approx([0, 0.2, 1.2, 1.4])
    schema = Schema(requests)
    assert schema.bodies == ["wall", "box_1", "floor", "wall", "rock_2", "floor"]
    assert schema.classes == ["wall", "box", "floor", "rock"]
    assert schema.class_id.tolist() == [0, 1, 2, 3, 1, 4, 3]
    assert [schema.scene_class_id(scene).tolist() for scene in (0, 1)] == [[0, 1, 2, 3], [0, 1, 4, 3]]
    assert schema.first_body == [0, 3]


def test_moved_bodies_and_background_need_not_be_in_every_scene(tmp_path):
    more = '[[vary.bodies]]\nnames = ["rock_?"]\nz_m = [1.0, 2.0]\nrests_on = "sand"\n'
    path = write_job(tmp_path, 2, more + '[labels]\nlayers = ["shadow"]\nbackground = ["floor", "sand"]\n')
    text = (tmp_path / "tank.sdf").read_text().replace('world name="tank"', 'world name="o"')
    (tmp_path / "other.sdf").write_text(text.replace("box_1", "rock_1").replace("floor", "sand"))
    job = read_job(path).model_copy(update={"scenes": ["tank.sdf", "other.sdf"]})
    requests = BatchRequests(job)
    table = PingTable(requests)
    assert table.moved == [(0, "box_1"), (1, "rock_1")]
    assert [set(request.bodies) for request in requests] == [{"box_1"}] * 2 + [{"rock_1"}] * 2
    rows = np.array([table.row(request) for request in requests])
    poses = table.column(rows, "moved").reshape(4, 2, 12)
    shift_z = poses[2:, 1, 11] + 0.3  # from the rock's height in the scene
    assert np.isnan(poses[:2, 1]).all() and np.isnan(poses[2:, 0]).all()
    assert ((shift_z >= 1) & (shift_z <= 2)).all()
    assert [Schema(requests).background(scene) for scene in (0, 1)] == [["floor"], ["sand"]]
    for changes, place, name in (
        ({}, "vary.bodies[1].names", "rock_?"),
        ({"vary": {}}, "labels.background", "sand"),
    ):
        with pytest.raises(sg.Error) as caught:
            Schema(BatchRequests(Job(**read_job(path).plain | changes)))
        assert str(caught.value).startswith(f"{path}: {place} must name bodies of the scene (got {name!r};")


SELECTION = """without = ["box_*"]
only = ["box_1", "wall"]
surface_z_m = 0.2
"""


@pytest.mark.slow
def test_a_job_leaves_bodies_out_and_sets_the_surface(tmp_path):
    path = write_plain_job(tmp_path, 2, 2, "[arrays]\nmantissa_bits = 23\n")
    text = path.read_text().replace('[noise]\npreset = "physical"', 'multipath = "incoherent"')
    path.write_text(SELECTION + text)
    make_all(path, tmp_path / "out")
    found = xr.open_dataset(tmp_path / "out" / "pings.zarr")
    (sampling,) = {*zip(found.columns_per_beam.values.tolist(), found.rows.values.tolist(), strict=True)}
    requests = BatchRequests(read_job(path))
    (sonar,) = requests.sonars.values()
    whole = sg.load_scene(tmp_path / "tank.sdf")
    scenes = whole, whole.only("box_1", "wall").without("box_*").with_surface(0.2), whole.only("wall")
    pings, samples = [], (sg.Sampling(*sampling), found.attrs["tolerance"])  # it decides on multipath
    for scene in scenes:
        with sg.Simulator(scene, sonar, requests.acoustics, *samples) as simulator:
            pings.append([simulator.ping(request.vehicle_pose).intensity for request in requests])
    whole_pings, expected, without_surface = np.array(pings)
    assert np.array_equal(found.intensity, expected)
    assert not np.array_equal(expected, whole_pings) and not np.array_equal(expected, without_surface)
    assert found.attrs["bodies"] == ["wall"]
    job = read_job(path)
    assert Job(**job.plain).digest == job.digest != Job(**job.plain | {"surface_z_m": 0.3}).digest
    status, shown, _ = run("batch", path, "--dry-run", "--workers", "1")
    assert status == 0 and "scene tank.sdf: wall; the water's surface at z = 0.2 m\n" in shown


def test_names_of_bodies_need_not_be_in_every_scene(tmp_path):
    path = write_job(tmp_path, 2, "")
    text = (tmp_path / "tank.sdf").read_text().replace('world name="tank"', 'world name="o"')
    (tmp_path / "other.sdf").write_text(text.replace("floor", "sand"))
    plain = read_job(path).plain | {"scenes": ["tank.sdf", "other.sdf"], "vary": {}}
    changes = {"without": ["sand"], "only": ["wall", "floor", "sand"]}
    requests = BatchRequests(Job(**plain | changes))
    assert [[body.name for body in requests.scenes[k].bodies] for k in (0, 1)] == [
        ["wall", "floor"],
        ["wall"],
    ]
    for changes, message in (
        ({"without": ["sund"]}, r"without must name bodies of the scene \(got 'sund'; did you mean 'sand'"),
        ({"only": ["sund"]}, r"only must name bodies of the scene \(got 'sund'; did you mean 'sand'"),
        ({"without": ["*"]}, r"must leave a body of each scene \(got none of scenes\[0\], 'tank.sdf'\)$"),
        ({"only": ["floor"]}, r"must leave a body of each scene \(got none of scenes\[1\], 'other.sdf'\)$"),
    ):
        with pytest.raises(sg.Error, match=rf"^{path}: .*{message}"):
            Schema(BatchRequests(Job(**plain | changes)))


def test_names_may_have_brackets(tmp_path):
    """As those of copies of an object have."""
    path = write_job(tmp_path, 1)
    scene = (tmp_path / "tank.sdf").read_text().replace('name="box_1"', 'name="box[1]"')
    (tmp_path / "tank.sdf").write_text(scene)
    text = path.read_text().replace('["box_*"]', '["box[1]"]').replace('["box*"]', '["box[?]"]')
    path.write_text(text.replace("seed = 5", 'seed = 5\nwithout = ["floor"]').replace(', "floor"]', "]"))
    requests = BatchRequests(read_job(path))
    assert Schema(requests).class_id.tolist() == [0, 1, 2]
    assert PingTable(requests).moved == [(0, "box[1]")]
    assert [body.name for body in requests.scenes[0].only("box[1]").bodies] == ["box[1]"]


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


def test_a_changed_mesh_changes_the_digest(tmp_path):
    path = write_job(tmp_path, 2, "")
    wall = "<box><size>1 20 20</size></box>"
    text = (tmp_path / "tank.sdf").read_text()
    assert wall in text
    (tmp_path / "tank.sdf").write_text(text.replace(wall, "<mesh><uri>wall.stl</uri></mesh>"))
    digests = set()
    for size in (1, 1, 1.01):
        trimesh.creation.box((size, 20, 20)).export(tmp_path / "wall.stl")
        digests.add(BatchRequests(read_job(path)).scenes.digest)
    assert len(digests) == 2


def test_what_an_included_model_states_of_its_surface_changes_the_digest(tmp_path):
    """The file of the scene itself stays as it is."""
    path = write_job(tmp_path, 2, "")
    box = "<collision name='c'><geometry><box><size>1 1 1</size></box></geometry>{}</collision>"
    model = f"<sdf version='1.9'><model name='m'><link name='l'>{box}{{}}</link></model></sdf>"
    (tmp_path / "tank.sdf").write_text(
        "<sdf version='1.9'><world name='w'><include><uri>model://rock</uri></include></world></sdf>"
    )
    (tmp_path / "rock").mkdir()
    text = path.read_text()
    path.write_text(text[: text.index("[[vary.bodies]]")])
    surface, digests = "<laser_retro>100</laser_retro>", []
    for shape, link in (
        ("", ""),
        ("<sonar_gl:specular>0.2</sonar_gl:specular>", ""),
        ("<sonar_gl:specular>0.2</sonar_gl:specular><sonar_gl:roughness>0.2</sonar_gl:roughness>", ""),
        ("<sonar_gl:speckle_shape>2</sonar_gl:speckle_shape>", ""),
        ("", "<sonar_gl:bubbles/>"),
        ("", "<sonar_gl:bubbles><rate>100</rate></sonar_gl:bubbles>"),
    ):
        (tmp_path / "rock" / "model.sdf").write_text(model.format(surface + shape, link))
        digests.append(BatchRequests(read_job(path)).scenes.digest)
    assert len(set(digests)) == len(digests)


def test_each_field_of_a_body_is_known_to_the_digest(tmp_path, monkeypatch):
    """A field that the digest lacks would let a batch go on with bodies of another echo."""
    mesh, other = trimesh.creation.box((1, 20, 20)), trimesh.creation.box((1, 20, 20.5))
    normals = other.vertex_normals
    body = sg.Body("wall", mesh, sg.pose(8.0), 0.5)
    changed = {
        "name": "floor", "mesh": other, "pose": sg.pose(8.5), "reflectivity": 0.25, "normals": normals,
        "material": "concrete", "specular": 0.25, "roughness_rad": 0.25, "speckle_shape": 2.0,
    }  # fmt: skip
    assert {field.name for field in fields(sg.Body) if field.init} == set(changed), (
        "add a new field to the digest of scenes in sonar_gl/batch/job_scenes.py, and then another value of it here"
    )
    path = write_job(tmp_path, 2, "")
    text = path.read_text()
    path.write_text(text[: text.index("[[vary.bodies]]")])

    def digest_of(one):
        monkeypatch.setattr(job_scenes, "load_scene", lambda *_: sg.Scene([one]))
        return BatchRequests(read_job(path)).scenes.digest

    digests = [digest_of(body), *(digest_of(replace(body, **{name: to})) for name, to in changed.items())]
    assert len(set(digests)) == len(digests)
    assert digest_of(replace(body)) == digests[0]


def test_the_surface_and_places_of_plumes_are_known_to_the_digest(tmp_path, monkeypatch):
    path = write_job(tmp_path, 2, "")
    text = path.read_text()
    path.write_text(text[: text.index("[[vary.bodies]]")])
    body, digests = sg.Body("wall", trimesh.creation.box((1, 20, 20))), set()
    for settings in (
        {},
        {"surface_z_m": 2.0},
        {"surface_z_m": 2.5},
        {"surface_z_m": 2.5, "surface_roughness_m": 1e-3},
        {"plumes": [sg.Bubbles("plume", sg.pose(3.0))]},
        {"plumes": [sg.Bubbles("plume", sg.pose(3.5))]},
    ):
        scene = sg.Scene([body, *settings.pop("plumes", ())], **settings)
        monkeypatch.setattr(job_scenes, "load_scene", lambda *_, scene=scene: scene)
        digests.add(BatchRequests(read_job(path)).scenes.digest)
    assert len(digests) == 6


def test_changes_of_a_sonar_go_with_a_file_beside_the_job(tmp_path, monkeypatch):
    monkeypatch.chdir("/")
    path = write_plain_job(tmp_path, 2, 2)
    text = path.read_text()
    assert 'sonar = "small.toml"' in text
    path.write_text(text.replace("small.toml", "small.toml,receive_taper=hamming, n_bins=7"))
    job = read_job(path)
    (sonar,) = BatchRequests(job).sonars.values()
    assert sonar == replace(sg.load_sonar(tmp_path / "small.toml"), receive_taper="hamming", n_bins=7)
    sheet, digest = tmp_path / "small.toml", job.digest
    sheet.write_text(sheet.read_text() + "# another one\n")
    assert read_job(path).digest != digest


def test_what_is_missing_of_a_scene_is_cured_by_keys_of_the_job(tmp_path):
    path = write_job(tmp_path, 2, "")
    text = (tmp_path / "tank.sdf").read_text()
    (tmp_path / "tank.sdf").write_text(
        text.replace("<box><size>1 20 20</size></box>", "<mesh><uri>wall.stl</uri></mesh>", 1)
    )
    status, _, err = run("batch", path, "--out", tmp_path / "out")
    assert status == 2 and err.endswith(
        "\nGive the folders that hold them (the key resource_paths), or carry on without them (skip_missing = true).\n"
    )
    robot = (
        "<robot name='r' xmlns:xacro='http://www.ros.org/wiki/xacro'><xacro:include filename='{}'/></robot>"
    )
    (tmp_path / "r.xacro").write_text(robot.format("package://none/a.xacro"))
    path.write_text(path.read_text().replace("tank.sdf", "r.xacro"))
    status, _, err = run("batch", path, "--out", tmp_path / "out")
    assert status == 2 and "that holds it (the key resource_paths; searched: " in err
    assert err.endswith("macros cannot be skipped (skip_missing is for models and meshes))\n")


def test_files_are_those_beside_the_job_and_no_others(tmp_path, monkeypatch):
    """A file of the same name where the command runs is not taken: other processes, and a resumption, would miss it."""
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    path = write_job(tmp_path, 2, "")
    for name, message in (
        ("small.toml", r"sonars\[0\]: .*/small.toml: the sonar's file must exist"),
        ("tank.sdf", r"scenes\[0\]: .*/tank.sdf: there is no such file"),
    ):
        (tmp_path / name).rename(tmp_path / "here" / name)
        with pytest.raises(sg.Error, match=message) as caught:
            Schema(BatchRequests(read_job(path)))
        assert f"{tmp_path}/{name}: " in str(caught.value)
        (tmp_path / "here" / name).rename(tmp_path / name)
    Schema(BatchRequests(read_job(path)))


def test_classes_are_numbered_in_the_order_of_the_job(tmp_path):
    """On workers of a cluster, too. Another order changes the digest."""
    path = write_job(tmp_path)
    text = path.read_text()
    one = read_job(path)
    fixed, target = 'fixed = ["wall", "floor"]\n', 'target = ["box*"]\n'
    path.write_text(text.replace(fixed + target, target + fixed))
    other = read_job(path)
    assert other.digest != one.digest
    assert Schema(BatchRequests(other)).classes == ["target", "fixed"]
    on_worker = Job(**json.loads(Cluster("tcp://nowhere", other, "").arguments[0]))
    assert Schema(BatchRequests(on_worker)).classes == ["target", "fixed"]
    assert on_worker.digest == other.digest


def schema_of_bodies(folder, monkeypatch, names, labels=""):
    """Return the schema of a job with boxes of some names in its scene."""
    path, mesh = write_job(folder, 2, labels), trimesh.creation.box((1, 1, 1))
    text = path.read_text()
    vary, mark = text.index("[[vary.bodies]]"), "[vary.water]"
    path.write_text(text[:vary] + text[text.index(mark) :])
    scene = sg.Scene([sg.Body(name, mesh, sg.pose(4.0 * k)) for k, name in enumerate(names)])
    requests = BatchRequests(read_job(path))
    monkeypatch.setattr(job_scenes, "load_scene", lambda *_: scene)
    return Schema(requests)


def test_bodies_whose_names_differ_by_a_final_number_are_one_class(tmp_path, monkeypatch):
    names = ["pile_1", "pile_23", "pile - 4", "pile5", "2nd pile", "7", "12"]
    schema = schema_of_bodies(tmp_path, monkeypatch, names)
    assert schema.classes == ["pile", "2nd pile", "7", "12"]  # a name that is a number stays
    assert schema.class_id.tolist() == [0, 1, 1, 1, 1, 2, 3, 4]


@pytest.mark.parametrize(("n_classes", "dtype"), [(255, "uint8"), (256, "uint16")])
def test_the_numbers_of_classes_fit(tmp_path, monkeypatch, n_classes, dtype):
    schema = schema_of_bodies(tmp_path, monkeypatch, [f"{k} m" for k in range(n_classes)])
    np.testing.assert_array_equal(schema.class_id, np.arange(1 + n_classes, dtype=dtype), strict=True)


def test_shadows_fall_on_what_is_named_like_a_floor_or_a_wall(tmp_path, monkeypatch):
    background = ["Seabed 1", "old Wall", "ground_plane", "Terrain", "HEIGHTMAP", "tank::Floor"]
    labels = '[labels]\nlayers = ["shadow"]\n'
    schema = schema_of_bodies(tmp_path, monkeypatch, ["rock", *background], labels)
    assert schema.background(0) == background


def test_bodies_of_no_class_are_instances_of_their_own(tmp_path, monkeypatch):
    """Also where they are parts of one model."""
    names, labels = (
        ["rig::a", "rig::b", "rig::c", "rig::d"],
        '[labels.classes]\nrigs = ["rig::a", "rig::d"]\n',
    )
    instances = schema_of_bodies(tmp_path, monkeypatch, names, labels).instances(0)
    assert instances.number_of.tolist() == [0, 1, 2, 3, 1] and not instances.are_bodies
    assert instances.names == ["", "rig", "rig::b", "rig::c", "rig::d"]


def test_the_size_of_a_ping_is_that_of_its_arrays(tmp_path, monkeypatch):
    labels = '[labels]\nlayers = ["body", "boxes"]\nheight = 77\n'
    schema = schema_of_bodies(tmp_path, monkeypatch, ["one", "two"], labels)
    n_bins = sum(
        one.n_beams * one.n_bins for one in BatchRequests(read_job(tmp_path / "job.toml")).sonars.values()
    )
    # intensities and numbers of bodies; for each sonar and body its echo, bins, and two boxes
    assert schema.bytes_per_ping == n_bins * (4 + 2) + 2 * 2 * (4 + 4 + 16 + 16)
    # a body that is not there has no box
    fills = {one.name: one.fill for one in schema.body_arrays}
    assert fills == {"body_echo": 0, "body_bins": 0, "body_box": -1, "body_pixels": -1}
    (pixels,) = (one for one in schema.body_arrays if one.name == "body_pixels")
    assert pixels.attributes["fan_image_height"] == 77


def test_the_attributes_of_a_set_hold_its_sonars_and_classes(small, requests):
    schema = Schema(requests)
    for name, sonar in requests.sonars.items():
        found = schema.sonar_attributes(name)
        assert (found["sonar"], found["noise_seed"]) == (name, requests.noise_seed(name))
        assert json.loads(found["mount"]) == requests.mounts[name].tolist()
        assert json.loads(found["specification"])["range_max_m"] == sonar.range_max_m
    found = schema.attributes(Manifest.load(Folder(small / "out")))
    assert (found["title"], found["bodies"]) == ("small", ["wall", "box_1", "floor"])
    assert (found["classes"], found["class_of_body"]) == (["fixed", "target"], [1, 2, 1])


def test_the_page_of_batches_states_the_keys_of_a_job():
    page = (Path(__file__).parents[2] / "docs" / "batch.md").read_text()
    rows = page.partition("| key | meaning |")[2].partition("\n\n")[0]
    stated = set(
        re.findall(r"`\[*(\w+)", " ".join(row.split("|")[1] for row in rows.strip().splitlines()[1:]))
    )
    assert stated == set(Job.model_fields) - set(LOCATION_KEYS), "the table of keys in docs/batch.md"


def test_the_page_of_batches_states_the_keys_of_the_outputs():
    page = (Path(__file__).parents[2] / "docs" / "batch.md").read_text()
    section = page.partition("### Keys of the outputs")[2].partition("### ")[0]
    rows = re.findall(r"^\| `\[(\w+)\]` \| (.*) \|$", section, re.M)
    kinds = {name: field.annotation for name, field in Job.model_fields.items() if name != "vary"}
    tables = {name for name, kind in kinds.items() if isinstance(kind, type) and issubclass(kind, Table)}
    assert {name for name, _ in rows} == tables, (
        "docs/batch.md must have a row of each table of Job, and no other"
    )
    for name, keys in rows:
        settings = Job.model_fields[name].annotation.model_fields
        known = {key: field.get_default() for key, field in settings.items()}
        stated = re.findall(r"`(\w+)(?: = (.*?))?`", keys)
        assert sorted(key for key, _ in stated) == sorted(known), (
            f"the row [{name}] of docs/batch.md must state the keys of its table in sonar_gl/batch/job.py"
        )
        for key, default in stated:
            assert json.loads(default) == known[key] if default else not known[key], (name, key)


BAD = [
    ("seed = 5", "seed = -1", "seed: should be greater than or equal to 0 (got -1)"),
    ("seed = 5", "sead = 5", "the job: unknown key (got 'sead'; did you mean 'seed'"),
    ("tolerance = 0.05", "tolerane = 0.05", "(got 'tolerane'; did you mean 'tolerance'?)"),
    ("seed = 5", "where = 'x'", "the job: unknown key (got 'where'; did you mean 'water'"),
    ('preset = "physical"', 'prest = "physical"', "noise: unknown key (got 'prest'; did you mean 'preset'?)"),
    ('kind = "sector"', 'kid = "sector"', "poses[0]: unknown key (got 'kid'; did you mean 'kind'"),
    (
        'kind = "sector"\n',
        "",
        "poses[0]: kind must be one of trajectory, lawnmower, orbit, sector, random_views (got none)",
    ),
    (
        "[[vary.bodies]]",
        '[[poses]]\nkind = "trajectory"\nfile = ["dive.csv"]\n[[vary.bodies]]',
        "poses[1].file: should be a valid string (got ['dive.csv'])",
    ),
    (
        'name = "level"',
        'name = "front-left"',
        "sonars[0].name: should begin with a letter, A-Z or a-z, and go on with such letters, digits and _ "
        "(got 'front-left'; arrays and topics have this name)",
    ),
    (
        'name = "small"',
        'name = "my survey"',
        "name: should consist of letters, digits, _, - and . (got 'my survey'; the store has it as its title)",
    ),
    ("seed = 5", "only = []", "only: should have a length of at least 1 (got []"),
    ("seed = 5", "without = ['boat']", "without must name bodies of the scene (got 'boat';"),
    ("seed = 5", "surface_z_m = 'x'", "surface_z_m: should be a valid number (got 'x')"),
    ("seed = 5", "seed = 'x'", "seed: should be a valid integer (got 'x')"),
    (
        "seed = 5",
        "ros = 'bag'",
        "ros: should be a table (got 'bag'; its keys are image_height, y_sign, counts)",
    ),
    ("seed = 5", "water = 8", "water: should be a table (got 8)"),
    ("[[poses]]", "[poses]", "; write [[poses]], since there may be several)"),
    ("[[vary.bodies]]", "[vary.bodies]", "; write [[vary.bodies]], since there may be several)"),
    ("n_pings = 10", "n_ping = 10", "poses[0]: unknown key (got 'n_ping'; did you mean 'n_pings'"),
    ('kind = "sector"', 'kind = "circle"', "poses[0]: kind must be one of trajectory, lawnmower"),
    ('sonar = "small.toml"\n\n', 'sonar = "p900"\n\n', "sonars[0]: unknown sonar (got 'p900'; did you mean"),
    ("mount = [0.0,", "mount = [", "sonars[1].mount: should have a length of at least 6 (got "),
    (
        "mount = [0.0, 0.0, 0.0, 1.5707963267948966, 0.0, 0.0]",
        "mount = [0, 0, 0, 0, 30, 0]",
        "sonars[1].mount: pose angles must be radians, within ±2π (got roll pitch yaw = 0 30 0; if these are degrees,",
    ),
    (
        "[labels]",
        "[optical]\nmount = [1e10, 0, 0, 0, 0, 0]\n[labels]",
        "optical.mount: pose must lie within 1e+09 m of the origin (got x y z = 1e+10 0 0; give metres)",
    ),
    (
        "range_m = 6.5",
        "range_m = 8000",
        "sonars[1].range_m: sonar 'small': the range must not exceed 6554 m with bins of",
    ),
    ("range_m = 6.5", "bins = 70000", "sonars[1].bins: should be less than or equal to 65536 (got 70000)"),
    ("range_m = 6.5", "range = 6.5", "sonars[1]: unknown key (got 'range'; did you mean 'range_m'"),
    ('name = "upright"', 'name = "level"', "sonars[1].name must differ from those before (got 'level')"),
    (
        '"physical"\ntvg',
        '"fysical"\ntvg',
        "acoustics: acoustics: unknown profile (got 'fysical'",
    ),
    ("tvg_absorption_db_m = 0.3", "tvg = 1", "acoustics: unknown key (got 'tvg'; did you mean 'tvg_k'"),
    (
        "temperature_c = [2.0, 20.0]",
        "temperature_c = [2.0, 90.0]",
        "temperature_c must lie in -2..40",
    ),
    (
        "tvg_absorption_db_m = 0.3",
        "ph = 8",
        "acoustics: ph describes the water, and is a field of Water now (",
    ),
    (
        "tvg_absorption_db_m = 0.3",
        "taper = 'hamming'",
        "acoustics: taper describes the device, and is a field of",
    ),
    (
        "tvg_absorption_db_m = 0.3",
        "water = {}",
        "acoustics: water is a table of its own (give a line [water]",
    ),
    (
        "[noise]",
        "[water]\ntemp_c = 8\n[noise]",
        "water: unknown key (got 'temp_c'; did you mean 'temperature_c'",
    ),
    (
        "[noise]",
        "[water]\nph = 20\n[noise]",
        "water: water: ph must lie in 7..9 (got 20; sea water has about 8)",
    ),
    (
        "temperature_c",
        "absorption_formula",
        "vary.water: unknown key (got 'absorption_formula'; did you mean",
    ),
    ("temperature_c", "temp_c", "vary.water: unknown key (got 'temp_c'; did you mean 'temperature_c'"),
    (
        "ambient_db",
        "ambience_db",
        "vary.noise: unknown key (got 'ambience_db'; did you mean 'ambient_db'",
    ),
    (
        "ambient_db",
        "electronic_db",
        "vary.noise: electronic_db describes the device, and is self_noise_db of Sonar now",
    ),
    (
        'names = ["box_*"]',
        'names = ["bax*"]',
        "vary.bodies[0].names must name bodies",
    ),
    (
        "x_m = [-0.5, 0.5]",
        "x_m = [0.5, -0.5]",
        "vary.bodies[0].x_m: should be a number, or [low, high] (got [0.5,",
    ),
    (
        "reflectivity = [0.2, 0.9]",
        "reflectivity = [0.2, 9]",
        "bodies[0].reflectivity: should lie in 0..1",
    ),
    (
        "ambient_db = [-80.0, -60.0]",
        "median = [3, 5]",
        "vary.noise: median cannot vary; set it in the table noise",
    ),
    (
        "yaw_rad = [-1.0, 1.0]",
        "yaw_rad = 90.0",
        "vary.bodies[0].yaw_rad: should lie in -6.283..6.283 (got 90.0; give radians: degrees times π/180)\n",
    ),
    (
        "yaw_rad = [-1.0, 1.0]",
        "yaw_rad = [-180, 180]",
        "vary.bodies[0].yaw_rad: should lie in -6.283..6.283 (got [-180, 180]; give radians: degrees times π/180)\n",
    ),
    ('kind = "sector"', 'kind = ["sector"]', "poses[0]: kind must be one of trajectory, lawnmower"),
    (
        "[labels]",
        "[pictures]\ndb_range = [0, -60]\n[labels]",
        "pictures.db_range is no key any more; give counts",
    ),
    ("[labels]", "[ros]\nbits = 16\n[labels]", "ros.bits is no key any more; give counts = { bits = 16 }"),
    (
        "[labels]",
        "[pictures]\ncounts = { low_db = 0, high_db = -60 }\n[labels]",
        "pictures.counts: counts: low_db must be less than high_db (got 0 and -60)",
    ),
    (
        "[labels]",
        "[pictures]\ncounts = { bits = 16 }\n[labels]",
        "pictures: counts of 16 bits need gray PNG pictures without axes, since others have 8 bits "
        '(got colormap copper; give colormap = "gray" and formats = ["png"])',
    ),
    (
        "[labels]",
        '[pictures]\ncounts = { bits = 16 }\ncolormap = "gray"\nformats = ["png", "mp4"]\n[labels]',
        "without axes, since others have 8 bits (got format mp4; ",
    ),
    (
        '"shadow", "boxes"]',
        '"boxes"]\nbackground = ["floor"]',
        "labels: background needs the layer shadow, since it names the bodies on which shadows fall (got ",
    ),
    ("[labels]", "[coco]\ncounts = { gain = 3 }\n[labels]", "coco.counts: counts: unknown key (got 'gain'"),
    ("[labels]", "[coco]\ncounts = 3\n[labels]", "coco.counts: should be a table, such as { law"),
    ("[labels]", '[pictures]\ncolormap = "jett"\n[labels]', "pictures.colormap: unknown colour map"),
    (
        "there = 0.8",
        "apart = true\none_of = true",
        "vary.bodies[0]: apart and one_of exclude each other (got both; leave apart out: one alone moves)",
    ),
    (
        "there = 0.8",
        'rests_on = "flor"',
        "vary.bodies[0].rests_on must name a body of each scene of 'box_1' (got 'flor', which scenes[0] lacks; did you "
        "mean 'floor'?)",
    ),
    (
        "there = 0.8",
        'rests_on = "floor"\n[[vary.bodies]]\nnames = ["flo*"]',
        "vary.bodies[0].rests_on must name a body that no later table names (got 'floor', which vary.bodies[1] names; "
        "give that table first)",
    ),
    (
        "there = 0.8",
        'rests_on = "box_1"',
        "vary.bodies[0].rests_on must name a body that does not move with the others (got 'box_1')",
    ),
    ("there = 0.8", "there = 1.8", "vary.bodies[0].there: should be less than or equal to 1 (got 1.8)"),
    (
        'target = ["box*"]',
        'target = ["box*", "wa*"]',
        "labels.classes.target must hold bodies of no other class (got 'wall', which is in 'fixed')",
    ),
    (
        'target = ["box*"]',
        'target = ["bax*"]',
        "labels.classes.target must name bodies",
    ),
    (
        '"share", "shadow"',
        '"share", "share"',
        "labels.layers: should name each layer once (got 'share' 2 times)",
    ),
    ('"share", "shadow"', '"share", "shade"', "labels.layers[6]: should be 'body', 'class'"),
    (
        'preset = "physical"',
        'preset = "loud"',
        "noise.preset must be one of none",
    ),
    ('scenes = ["tank.sdf"]', 'scenes = ["tonk.sdf"]', "scenes[0]: "),
    ('scenes = ["tank.sdf"]', 'scenes = "tank.sdf"', """(got 'tank.sdf'; write ["tank.sdf"])"""),
    ('scenes = ["tank.sdf"]', "", "scenes must be given"),
    (
        'sonar = "small.toml"',
        "",
        "sonars[0].sonar must be given (name a preset, as 'sonar-gl sonars' lists them, or a file;",
    ),
    ("seed = 5", "seed = = 5", "the job file must be TOML ("),
]


@pytest.mark.parametrize(("old", "new", "sentence"), BAD, ids=[new or sentence for _, new, sentence in BAD])
def test_errors_in_a_job_name_file_table_and_key(tmp_path, old, new, sentence):
    path = write_job(tmp_path)
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    status, out, err = run("batch", path, "--out", tmp_path / "out", "--workers", "1")
    assert (status, out) == (2, "")
    assert err.startswith(f"error: {path}: ") and sentence in err
    assert "Traceback" not in err
    assert not (tmp_path / "out").exists()


def test_needs_of_outputs_are_checked_before_anything_is_made(tmp_path):
    path = write_job(tmp_path, 10, "[coco]\n")
    with pytest.raises(sg.Error, match=f"^{path}: coco needs labels .got none; add a line"):
        read_job(path)
    write_job(tmp_path, 10, '[ros]\n[[poses]]\nkind = "trajectory"\nfile = "dive.csv"\n')
    text = path.read_text()
    path.write_text(text[: text.index("[[poses]]")] + text[text.index("[[vary.bodies]]") :])
    for times, message in (
        ([0, 1, 1, 0.5, 2], r"poses\[0\]: .*: line 5, column t: times must not fall \(got 0.5 s after 1 s"),
        ([-1, 0], r"poses\[0\].file must hold times from 0 on, for a bag \(got -1 s"),
        (
            [0, 3e9],
            r"poses must end before 2147483648 s, for a bag \(got 3000000000 s; give times in seconds",
        ),
        ([2, 2, 3], None),
    ):
        lines = [f"{t},0,0,0,0,0,0" for t in times]
        (tmp_path / "dive.csv").write_text("\n".join(["t,x,y,z,roll,pitch,yaw", *lines]))
        if message is None:
            assert len(BatchRequests(read_job(path))) == 3
        else:
            with pytest.raises(sg.Error, match=rf"^{path}: {message}"):
                BatchRequests(read_job(path))
    path.write_text(path.read_text().replace("tank.sdf", "~nobody-of-that-name/tank.sdf"))
    with pytest.raises(
        sg.Error, match=r"scenes\[0\]: .*/~nobody-of-that-name/tank.sdf: there is no such file"
    ):
        Schema(BatchRequests(read_job(path)))


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
    assert (status, out) == (0, f"{copy}: {N} of {N} pings\n")
    assert f"{one}: has changed since it was written\n" in err
    assert untouched.stat().st_mtime_ns == before
    assert files_of(copy) == expected
    status, _, err = run("batch", "--check", tmp_path / "nowhere")
    assert status == 2 and "must be the folder of a batch" in err and not (tmp_path / "nowhere").exists()


@pytest.mark.slow
def test_partial_files_are_removed_from_a_store(small, tmp_path):
    """A process that is killed leaves them, while the store is created or the batch is finalized."""
    out = shutil.copytree(small / "out", tmp_path / "out")
    before = files_of(out)
    store = out / "pings.zarr"
    partial = [store / name / "zarr.1.partial" for name in ("", "level", "level/echo")]
    batch = open_batch(small / "job.toml", out)
    for step in (create_store, finalize):
        for path in partial:
            path.write_bytes(b"half")
        step(batch)
        assert not [path for path in partial if path.exists()]
    assert files_of(out) == before


def test_a_folder_has_one_batch_at_a_time(small, tmp_path):
    with Folder(tmp_path / "out").locked():
        status, _, err = run("batch", small / "job.toml", "--out", tmp_path / "out")
        expected = f"error: {tmp_path / 'out'}: must have one batch at a time (another is running in it)\n"
        assert (status, err) == (2, expected)
    assert [path.name for path in (tmp_path / "out").iterdir()] == [".lock"]


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
    assert (status, shown) == (0, f"{copy}: {N} of {N} pings\n")
    assert files_of(copy) == files_of(small / "out")


def test_existing_files_are_not_overwritten(small, tmp_path):
    job, out = small / "job.toml", small / "out"
    before = files_of(out)
    status, _, err = run("batch", job, "--out", out)
    assert status == 2 and "must hold no batch yet (continue it by --resume" in err
    changed = tmp_path / "job.toml"
    write_job(tmp_path, N, LABELS + MORE)
    changed.write_text(changed.read_text().replace("seed = 5", "seed = 6"))
    status, _, err = run("batch", changed, "--out", out, "--resume")
    assert status == 2 and "(changed: seed;" in err
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.txt").write_text("years")
    status, _, err = run("batch", job, "--out", tmp_path / "full", "--resume")
    assert status == 2 and "must be an empty folder, or one with a batch to --resume" in err
    assert files_of(out) == before
    status, shown, _ = run("batch", job, "--out", out, "--resume")  # nothing is left to do
    assert (status, shown) == (0, f"{out}: {N} of {N} pings\n")
    assert files_of(out) == before


def test_resuming_names_the_files_that_have_changed(tmp_path):
    """Files of the job, meshes, included models and what these name; in and beside the folder of the job."""
    folder, meshes = tmp_path / "job", tmp_path / "meshes"
    (meshes / "rock").mkdir(parents=True)
    folder.mkdir()
    job = write_job(folder, 2, "")
    job.write_text('resource_paths = ["../meshes"]\n' + job.read_text())
    trimesh.creation.box((1, 20, 20)).export(folder / "wall.obj")
    for name, data in _gltf(1.0).items():
        (meshes / "rock" / name).write_bytes(data)
    (meshes / "rock" / "model.sdf").write_text(
        "<sdf version='1.9'><model name='rock'><link name='l'><collision name='c'><geometry><mesh><uri>model.gltf</uri>"
        "</mesh></geometry><laser_retro>9</laser_retro></collision></link></model></sdf>"
    )
    rock = "<include><uri>model://rock</uri><pose>4 1 0 0 0 0</pose></include></world>"
    text = (folder / "tank.sdf").read_text().replace("</world>", rock)
    wall = "<box><size>1 20 20</size></box>"
    (folder / "tank.sdf").write_text(text.replace(wall, "<mesh><uri>wall.obj</uri></mesh>", 1))
    batch = open_batch(job, tmp_path / "out")
    begin(batch).save(batch.folder)

    def changed():
        status, out, err = run("batch", job, "--out", tmp_path / "out", "--resume", "--workers", "1")
        assert (status, out) == (2, "")
        return re.search(r"resumed with the job that began it \(changed: (.*); restore that, or", err)[1]

    buffer = "gltf_buffer_1.bin"  # the vertices
    changes = {
        folder / "wall.obj": ("wall.obj", lambda data: data.replace(b"v 0.5", b"v 0.6")),
        folder / "tank.sdf": ("tank.sdf", lambda data: data + b"<!-- another one -->"),
        folder / "small.toml": ("small.toml", lambda data: data + b"# another one"),
        meshes / "rock" / "model.sdf": (
            None,
            lambda data: data.replace(b"</uri>", b"</uri><scale>1 1 2</scale>"),
        ),
        meshes / "rock" / buffer: (None, lambda _: _gltf(1.5)[buffer]),
    }
    for path, (name, change) in changes.items():
        before = path.read_bytes()
        path.write_bytes(change(before))
        assert changed() == (name or str(path))
        path.write_bytes(before)
    for path in (folder / "wall.obj", folder / "small.toml"):
        path.write_bytes(changes[path][1](path.read_bytes()))
    job.write_text(job.read_text().replace("seed = 5", "seed = 6"))
    assert changed() == "seed, small.toml, wall.obj"


def _gltf(height_m):
    """Return the files of a box, by name."""
    return trimesh.creation.box((1, 1, height_m)).scene().export(file_type="gltf")


def test_the_pings_in_progress_are_those_that_a_sequence_may_have_begun():
    assert IN_PROGRESS == 2 * sequence.BATCH + 1


@pytest.mark.parametrize("low_db", [-80, 3])
def test_a_varied_noise_that_is_too_high_is_warned_of_once(tmp_path, low_db):
    """By the upper end of its range; each ping, whose level is another, warned of its own."""
    path = write_plain_job(tmp_path, 4, 4, f"[vary.noise]\nambient_db = [{low_db}, 5]\n")
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        requests = BatchRequests(read_job(path))
        assert len({request.noise.ambient_db for request in requests}) == 4
    assert [str(one.message).partition(" exceeds")[0] for one in found] == ["noise: ambient_db = 5"]


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


def test_a_dry_run_counts_pings_in_which_a_body_has_no_clear_place(tmp_path):
    path = write_plain_job(tmp_path, 4, 4)
    boxes = BOX + BOX.replace("box_1", "box_2")
    (tmp_path / "tank.sdf").write_text(f'<sdf version="1.9"><world name="tank">{boxes}{WALL}</world></sdf>')
    text = path.read_text()
    path.write_text(text + '[[vary.bodies]]\nnames = ["box_*"]\napart = true\nclearance_m = 0.1\n')
    status, out, err = run("batch", path, "--dry-run", "--workers", "1")
    assert status == 0, err
    assert (
        "  4 of these 4 pings have a body without a clear place, which is absent, such as ping 0, sonar at "
        "'0 0 0 0 0 -0.2', 'box_2' (clearance_m)\n"
    ) in out
