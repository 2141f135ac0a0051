"""What a job stores: the encoding of arrays, numbers of bodies and classes, attributes."""

import json

import numpy as np
import pytest
import trimesh
import xarray as xr

import sonar_gl as sg
from sonar_gl.batch import job_scenes
from sonar_gl.batch.cluster import Cluster
from sonar_gl.batch.folder import Folder
from sonar_gl.batch.job import Job, read_job
from sonar_gl.batch.manifest import Manifest
from sonar_gl.batch.requests import BatchRequests
from sonar_gl.batch.schema import Schema, round_mantissa
from tests.support.batches import write_job


@pytest.mark.slow
def test_units_of_arrays_are_those_that_cf_conventions_know(small):
    """Readers of units, as pint-xarray, refuse the whole set for the sake of one that is none."""
    data = xr.open_dataset(small / "out" / "pings.zarr", group="level", decode_cf=False)
    assert {data[name].attrs["units"] for name in data.variables if "units" in data[name].attrs} == {
        *("1", "m", "rad", "s")
    }


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
