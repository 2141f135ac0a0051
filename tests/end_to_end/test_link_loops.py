"""A path that is a loop of symbolic links is called so wherever it is read."""

import pytest

import sonar_gl as sg
from tests.support import file_readers
from tests.support.file_readers import MESH, MODEL, SUFFIXES, run_job, write_scene

READERS = {
    **file_readers.READERS,
    "scene without ending": lambda folder, stem: sg.load_scene(folder / stem),
    "scene in a loop": lambda folder, stem: sg.load_scene(folder / stem / "a.sdf"),
    "model of a scene": lambda folder, stem: sg.load_scene(
        write_scene(folder, MESH.format(f"model://{stem}/a.glb"))
    ),
    "resource path": lambda folder, stem: sg.load_scene("pylon", resource_paths=[folder / stem]),
}


@pytest.mark.parametrize("reader", READERS)
def test_a_loop_of_symbolic_links_is_called_so(tmp_path, reader):
    for suffix in ("", *SUFFIXES):
        (tmp_path / f"loop{suffix}").symlink_to(tmp_path / f"other{suffix}")
        (tmp_path / f"other{suffix}").symlink_to(tmp_path / f"loop{suffix}")
    with pytest.raises(sg.Error) as caught:
        READERS[reader](tmp_path, "loop")
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
    assert [body.name for body in run_job(tmp_path, scene="box").bodies] == ["m"]
