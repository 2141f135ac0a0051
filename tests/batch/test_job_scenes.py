"""The scenes of a job: which bodies they hold, and what their digest knows of."""

from dataclasses import fields, replace

import numpy as np
import pytest
import trimesh
import xarray as xr

import sonar_gl as sg
from sonar_gl.batch import job_scenes
from sonar_gl.batch.job import Job, read_job
from sonar_gl.batch.ping_table import PingTable
from sonar_gl.batch.requests import BatchRequests
from sonar_gl.batch.schema import Schema
from tests.support.batches import make_all, write_job, write_plain_job
from tests.support.command_line import run


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
