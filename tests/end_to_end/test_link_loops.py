"""A path that is a loop of symbolic links is called so wherever it is read."""

import pytest

import sonar_gl as sg
from sonar_gl.batch.job import read_job
from sonar_gl.batch.requests import BatchRequests
from sonar_gl.core.poses import read_poses
from sonar_gl.scene import mesh_files
from sonar_gl.scene.reflectivity_map import read_image

JOB = """scenes = ["{scene}"]
[[sonars]]
sonar = "{sonar}"
[[poses]]
kind = "trajectory"
file = "{file}"
"""
MODEL = "<sdf version='1.9'><model name='m'><link name='l'><collision name='c'><geometry>{}</geometry>{}</collision>"
MODEL += "</link></model></sdf>"
MESH = "<mesh><uri>{}</uri></mesh>"
MAP = "<sonar_gl:reflectivity_map>loop.png</sonar_gl:reflectivity_map>"


def write_scene(folder, geometry, more=""):
    path = folder / "a.sdf"
    path.write_text(MODEL.format(geometry, more))
    return path


def run_job(folder, **names):
    names = {"scene": "pylon", "sonar": "p900-45", "file": "sound.csv"} | names
    (folder / "job.toml").write_text(JOB.format(**names))
    requests = BatchRequests(read_job(folder / "job.toml"))
    return requests.scene(0)


READERS = {
    "scene": lambda folder: sg.load_scene(folder / "loop.sdf"),
    "scene without ending": lambda folder: sg.load_scene(folder / "loop"),
    "scene in a loop": lambda folder: sg.load_scene(folder / "loop" / "a.sdf"),
    "mesh": lambda folder: sg.load_scene(folder / "loop.glb"),
    "mesh of a scene": lambda folder: sg.load_scene(write_scene(folder, MESH.format("loop.glb"))),
    "model of a scene": lambda folder: sg.load_scene(write_scene(folder, MESH.format("model://loop/a.glb"))),
    "map of a scene": lambda folder: sg.load_scene(write_scene(folder, "<box/>", MAP)),
    "resource path": lambda folder: sg.load_scene("pylon", resource_paths=[folder / "loop"]),
    "height map": lambda folder: mesh_files.heightmap(folder / "loop.png"),
    "reflectivity map": lambda folder: read_image(folder / "loop.png"),
    "sonar": lambda folder: sg.load_sonar(folder / "loop.toml"),
    "table of a sonar": lambda folder: sg.load_sonar(f"{folder}/loop.toml#mine"),
    "poses": lambda folder: read_poses(folder / "loop.csv"),
    "ping": lambda folder: sg.load_npz(folder / "loop.npz"),
    "job": lambda folder: read_job(folder / "loop.toml"),
    "scene of a job": lambda folder: run_job(folder, scene="loop.sdf"),
    "sonar of a job": lambda folder: run_job(folder, sonar="loop.toml"),
    "poses of a job": lambda folder: run_job(folder, file="loop.csv"),
}


@pytest.mark.parametrize("reader", READERS)
def test_a_loop_of_symbolic_links_is_called_so(tmp_path, reader):
    for suffix in ("", ".sdf", ".glb", ".png", ".toml", ".csv", ".npz"):
        (tmp_path / f"loop{suffix}").symlink_to(tmp_path / f"other{suffix}")
        (tmp_path / f"other{suffix}").symlink_to(tmp_path / f"loop{suffix}")
    (tmp_path / "sound.csv").write_text("t,x,y,z,roll,pitch,yaw\n0,0,0,0,0,0,0\n")
    with pytest.raises(sg.Error) as caught:
        READERS[reader](tmp_path)
    text = str(caught.value)
    assert "a loop of symbolic links" in text and f"{tmp_path}/loop" in text


def test_a_loop_in_the_environment_is_passed_over_as_is_a_missing_folder(tmp_path, monkeypatch):
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    monkeypatch.setenv("GZ_SIM_RESOURCE_PATH", f"{tmp_path}/loop:{tmp_path}/none")
    assert sg.load_scene("pylon").bodies


def test_a_loop_in_one_resource_path_does_not_hide_the_model_of_another(tmp_path):
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
    (tmp_path / "a" / "box").symlink_to(tmp_path / "a" / "box")
    (tmp_path / "b" / "box").mkdir()
    (tmp_path / "b" / "box" / "model.sdf").write_text(MODEL.format("<box/>", ""))
    world = "<sdf version='1.9'><world name='w'><include><uri>model://box</uri></include></world></sdf>"
    (tmp_path / "w.sdf").write_text(world)
    scene = sg.load_scene(tmp_path / "w.sdf", [tmp_path / "a", tmp_path / "b"])
    assert [body.name for body in scene.bodies] == ["m"]


def test_a_job_names_the_folder_of_a_model_relative_to_its_file(tmp_path):
    (tmp_path / "box").mkdir()
    (tmp_path / "box" / "model.sdf").write_text(MODEL.format("<box/>", ""))
    (tmp_path / "sound.csv").write_text("t,x,y,z,roll,pitch,yaw\n0,0,0,0,0,0,0\n")
    assert [body.name for body in run_job(tmp_path, scene="box").bodies] == ["m"]
