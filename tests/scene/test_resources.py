"""The files that a scene file names: where they are found, what is refused, and what is missing."""

import os
import re

import numpy as np
import pytest
import trimesh

import sonar_gl as sg
from sonar_gl.core.errors import Error
from sonar_gl.core.poses import pose
from sonar_gl.scene.sdf import resources
from sonar_gl.scene.sdf.reader import read_sdf
from tests.support.errors import error_of
from tests.support.sdf_texts import add_model, link, model, model_of, read_warned, write

GAZEBO_PATHS = (
    *("GZ_SIM_RESOURCE_PATH", "IGN_GAZEBO_RESOURCE_PATH", "SDF_PATH"),
    *("GAZEBO_MODEL_PATH", "GAZEBO_RESOURCE_PATH"),
)


def test_include_by_model_config_newest_version_name_and_pose(tmp_path, read_text):
    folder = add_model(
        tmp_path / "models",
        "rock",
        model("<pose>9 9 9 0 0 0</pose>" + link(), "old"),
        "<model><sdf version='1.4'>model.sdf</sdf><sdf version='1.10'>new.sdf</sdf>"
        "<sdf version='1.9'>model.sdf</sdf></model>",
    )
    write(folder / "new.sdf", model("<pose>1 1 1 0 0 0</pose>" + link(), "new"), world=False)
    scene = read_text(
        "<include><uri>model://rock</uri></include>"
        "<include><uri>model://rock/</uri><name>moved</name><pose>2 0 0 0 0 0</pose></include>",
        resource_paths=[tmp_path / "models"],
    )
    assert [b.name for b in scene.bodies] == ["new", "moved"]
    np.testing.assert_array_equal(scene.bodies[0].pose, pose(1, 1, 1))
    np.testing.assert_array_equal(scene.bodies[1].pose, pose(2, 0, 0))


@pytest.mark.parametrize("key", GAZEBO_PATHS)
def test_environment_names_folders_of_models(tmp_path, monkeypatch, key):
    add_model(tmp_path / "b", "rock")
    monkeypatch.setenv(key, f"{tmp_path / 'a'}{os.pathsep}{tmp_path / 'b'}")
    path = write(tmp_path / "worlds" / "a.sdf", "<include><uri>model://rock</uri></include>")
    assert [b.name for b in read_sdf(path).bodies] == ["rock"]


def test_order_of_argument_environment_and_own_folder(tmp_path, monkeypatch, read_text):
    for folder in ("argument", "environment", "."):
        add_model(tmp_path / folder, "rock", model(link(), folder.replace(".", "own")))
    include = "<include><uri>model://rock</uri></include>"
    assert read_text(include).bodies[0].name == "own"
    monkeypatch.setenv("GAZEBO_MODEL_PATH", str(tmp_path / "environment"))
    assert read_text(include).bodies[0].name == "environment"
    assert read_text(include, resource_paths=tmp_path / "argument").bodies[0].name == "argument"


def test_relative_uris_are_relative_to_the_file_that_names_them(tmp_path, read_text):
    rock = model_of("<mesh><uri>meshes/b.stl</uri></mesh>", "rock")
    folder = add_model(tmp_path / "models", "rock", rock)
    (folder / "meshes").mkdir()
    trimesh.creation.box((1, 2, 3)).export(folder / "meshes" / "b.stl")
    scene = read_text("<include><uri>models/rock</uri></include>")
    np.testing.assert_array_equal(scene.bodies[0].mesh.extents, [1, 2, 3])


def test_a_model_opened_alone_finds_its_own_meshes(tmp_path):
    folder = add_model(tmp_path, "rock", model_of("<mesh><uri>model://rock/b.stl</uri></mesh>", "rock"))
    trimesh.creation.box((1, 2, 3)).export(folder / "b.stl")
    assert [b.name for b in read_sdf(folder / "model.sdf").bodies] == ["rock"]


def test_ground_plane_and_sun_are_known_without_files(tmp_path):
    path = write(
        tmp_path / "a.sdf",
        "<include><uri>model://sun</uri></include><include><uri>model://ground_plane</uri>"
        "<name>floor</name><pose>0 0 -3 0 0 0</pose></include>",
    )
    with pytest.warns(UserWarning, match=r"no <laser_retro> in 1 of 1 bodies \(floor\)"):
        scene = read_sdf(path)
    (body,) = scene.bodies
    np.testing.assert_array_equal(body.mesh.bounds, [[-11_000, -11_000, 0], [11_000, 11_000, 0]])
    np.testing.assert_array_equal(body.pose, pose(0, 0, -3))


def test_those_of_fuel_are_known_without_files_too(tmp_path):
    fuel = "https://fuel.gazebosim.org/1.0/OpenRobotics/models"
    inside = f"<include><uri>{fuel}/Sun</uri></include><include><uri>{fuel}/Ground%20Plane/2</uri></include>"
    with pytest.warns(UserWarning, match="no <laser_retro> in 1 of 1 bodies"):
        (body,) = read_sdf(write(tmp_path / "a.sdf", inside)).bodies
    assert body.name == "ground_plane" and np.ptp(body.surface.vertices[:, 0]) == 22_000


def test_files_are_found_whatever_the_scheme(tmp_path, read_text):
    """Gazebo searches so; some worlds have models:// in place of model://."""
    trimesh.creation.box((5, 1, 1)).export(tmp_path / "b.stl")
    (body,) = read_text(model_of("<mesh><uri>models://b.stl</uri></mesh>")).bodies
    assert np.ptp(body.surface.vertices[:, 0]) == 5


MISSING = """a.sdf: models or files are missing:
  model://no
    named by a.sdf: world/include[model://no]
    named by a.sdf: world/include[again]
    not at R/models/no
    not at R/no
  https://fuel.gazebosim.org/1.0/a/models/b
    named by a.sdf: world/include[https://fuel.gazebosim.org/1.0/a/models/b]
    not at R/gz/fuel.gazebosim.org/a/models/b
    not at R/ign/fuel.gazebosim.org/a/models/b
    not at R/models/b
    not at R/b
    'gz fuel download -u "https://fuel.gazebosim.org/1.0/a/models/b"' downloads it to where it is found; or put \
the model's folder, named 'b', into a folder of the resource paths
  a.stl
    named by a.sdf: world/model[m]/link[link]/collision[c]/geometry/mesh/uri
    not at R/a.stl
    not at R/models/a.stl
"""
MISSING_WORLD = (
    "<include><uri>model://no</uri></include><include><uri>model://no</uri><name>again</name></include>"
    "<include><uri>https://fuel.gazebosim.org/1.0/a/models/b</uri></include>"
    + model(
        link(shape="<collision name='c'><geometry><mesh><uri>a.stl</uri></mesh></geometry></collision>")
        + link(name="other")
    )
    + model("<pose relative_to='again'>0 0 1 0 0 0</pose>" + link(), "beside")
)


def test_all_that_is_missing_is_named_at_once(tmp_path, message_of):
    (tmp_path / "models").mkdir()
    text = message_of(MISSING_WORLD, resource_paths=[tmp_path / "models"])
    expected = MISSING.replace("R/", "") + (
        "Give the folders that hold them (--resource-path, resource_paths=), "
        "or carry on without them (--skip-missing, skip_missing=True)."
    )
    assert text == expected


@pytest.mark.parametrize("place", ["worlds/models", "models", "."])
def test_a_folder_of_models_beside_the_world_is_named(tmp_path, place):
    """Most repositories have their models there, and Gazebo finds them by a variable that their README sets."""
    folder = tmp_path / place
    (folder / "rock").mkdir(parents=True)
    (tmp_path / "worlds").mkdir(exist_ok=True)
    path = write(tmp_path / "worlds/a.sdf", "<include><uri>model://rock</uri></include>")
    with pytest.raises(Error) as caught:
        read_sdf(path)
    expected = f"    not at {path.parent / 'rock'}\n    but in {folder.resolve()}: give that folder as resource path\n"
    assert expected in str(caught.value)


def test_of_much_that_is_missing_the_first_is_explained(tmp_path, message_of):
    names = [f"model://m{k}" for k in range(30)]
    text = message_of("".join(f"<include><uri>{name}</uri></include>" for name in names))
    assert text.count("not at ") == 5
    assert "  and model://m5\n" in text and all(f"{name}\n" in text for name in names)
    path = write(tmp_path / "b.sdf", "".join(f"<include><uri>{name}</uri></include>" for name in names))
    with pytest.warns(UserWarning, match=r"missing \(model://m0, .*, model://m9 and 20 more\)$"):
        read_sdf(path, skip_missing=True)


def test_skip_missing_warns_once_and_carries_on(tmp_path):
    (tmp_path / "models").mkdir()
    scene, texts = read_warned(tmp_path, MISSING_WORLD, tmp_path / "models", skip_missing=True)
    uris = "model://no, https://fuel.gazebosim.org/1.0/a/models/b, a.stl"
    assert texts == [f"read without what is missing ({uris})"]
    assert [b.name for b in scene.bodies] == ["m::other", "beside"]


def test_a_model_folder_without_a_model_is_missing(tmp_path, message_of):
    (tmp_path / "rock").mkdir()
    assert message_of("<include><uri>model://rock</uri></include>").startswith(
        "a.sdf: models or files are missing:\n  model://rock\n"
        "    named by a.sdf: world/include[model://rock]\n    not at rock/model.sdf\n"
    )


def test_a_uri_with_three_slashes(tmp_path, read_text):
    add_model(tmp_path, "rock", model(link(), "rock"))
    assert [body.name for body in read_text("<include><uri>model:///rock</uri></include>").bodies] == ["rock"]


def test_the_folder_of_a_model_is_a_scene(tmp_path):
    add_model(tmp_path, "rock", model(link(), "stone"))
    scene = sg.load_scene(tmp_path / "rock")
    assert scene.name == "rock" and [body.name for body in scene.bodies] == ["stone"]
    (tmp_path / "rock" / "model-2.sdf").write_text(f"<sdf>{model(link(), 'newer')}</sdf>")
    (tmp_path / "rock" / "model.config").write_text(
        "<model><sdf version='1.4'>model.sdf</sdf><sdf version='1.10'>model-2.sdf</sdf></model>"
    )
    assert [body.name for body in sg.load_scene(str(tmp_path / "rock")).bodies] == ["newer"]
    (tmp_path / "other").mkdir()
    with pytest.raises(Error, match="a folder must be that of a model"):
        sg.load_scene(tmp_path / "other")


FUEL = "https://fuel.gazebosim.org/1.0/OpenRobotics/models/Big Rock"


def add_fuel_model(folder, size):
    folder.mkdir(parents=True)
    (folder / "model.sdf").write_text(f"<sdf>{model_of(f'<box><size>{size} 1 1</size></box>', 'rock')}</sdf>")


@pytest.mark.parametrize(
    ("uri", "size"),
    [
        *(
            (FUEL, 12),
            (f"{FUEL}/2", 2),
            (f"{FUEL}/tip", 12),
            (FUEL.replace(" ", "%20"), 12),
            (f"{FUEL}/7", 12),
        ),
        (FUEL.replace("https", "HTTPS"), 12),
    ],
)
@pytest.mark.parametrize("cache", ["gz", "ign"])
def test_models_of_fuel_are_read_from_gazebos_cache(tmp_path, read_text, uri, size, cache):
    """The newest version, unless the URI names one that is there."""
    for version in (2, 12):
        kept = tmp_path / cache / "fuel.gazebosim.org" / "openrobotics" / "models" / "big rock" / str(version)
        add_fuel_model(kept, version)
    (body,) = read_text(f"<include><uri>{uri}</uri></include>").bodies
    assert np.ptp(body.surface.vertices[:, 0]) == size


@pytest.mark.parametrize("name", ["Big Rock", "big rock", "Big_Rock", "big_rock"])
def test_models_of_fuel_are_read_from_the_resource_paths(tmp_path, read_text, name):
    """As the message about a missing one says."""
    add_fuel_model(tmp_path / "models" / name, 3)
    (body,) = read_text(f"<include><uri>{FUEL}</uri></include>", resource_paths=[tmp_path / "models"]).bodies
    assert np.ptp(body.surface.vertices[:, 0]) == 3


def test_a_file_that_stands_for_a_model_of_fuel_of_its_own_name(tmp_path):
    """The model is missing; the file does not include itself."""
    path = write(
        tmp_path / "models" / "big rock" / "model.sdf", f"<include><uri>{FUEL}</uri></include>", world=False
    )
    with pytest.raises(Error) as caught:
        read_sdf(path, resource_paths=[tmp_path / "models"])
    assert str(caught.value).splitlines()[:2] == [f"{path}: models or files are missing:", f"  {FUEL}"]
    assert f'gz fuel download -u "{FUEL}"' in str(caught.value)


def test_a_user_without_a_home_is_told_what_is_missing(tmp_path, monkeypatch):
    """As in a container. pathlib raises a RuntimeError of a home that it cannot find."""
    for key, value in {"GZ_FUEL_CACHE_PATH": "~nobody-of-this-name/fuel", "IGN_FUEL_CACHE_PATH": ""}.items():
        monkeypatch.setenv(key, value)
    monkeypatch.setattr(os.path, "expanduser", lambda path: path)  # what Python does without a home
    path = write(tmp_path / "a.sdf", f"<include><uri>{FUEL}</uri></include>")
    with pytest.raises(
        Error, match=r"(?s)models or files are missing:.*not at ~nobody-of-this-name/fuel/fuel\."
    ) as caught:
        read_sdf(path)
    assert "~/.ignition/fuel/" in str(caught.value)


def test_a_file_of_a_model_of_fuel(tmp_path, read_text):
    kept = tmp_path / "gz" / "fuel.gazebosim.org" / "openrobotics" / "models" / "big rock" / "1"
    kept.mkdir(parents=True)
    trimesh.creation.box((5, 1, 1)).export(kept / "rock.stl")
    (body,) = read_text(model_of(f"<mesh><uri>{FUEL}/1/files/rock.stl</uri></mesh>")).bodies
    assert np.ptp(body.surface.vertices[:, 0]) == 5


def test_a_uri_of_fuel_does_not_lead_out_of_the_model(tmp_path_factory, message_of, monkeypatch):
    cache = tmp_path_factory.mktemp("cache")
    monkeypatch.setenv("GZ_FUEL_CACHE_PATH", str(cache))
    kept = cache / "fuel.gazebosim.org" / "openrobotics" / "models" / "big rock" / "1"
    kept.mkdir(parents=True)
    trimesh.creation.box((5, 1, 1)).export(cache / "secret.stl")
    mesh = f"<mesh><uri>{FUEL}/1/files/../../../../../secret.stl</uri></mesh>"
    assert message_of(model_of(mesh)).startswith("a.sdf: models or files are missing")


REFUSED = "a document type or entities must not be declared (refused)"


def test_billion_laughs_and_external_entities_are_refused(tmp_path):
    secret = tmp_path / "secret.txt"
    secret.write_text("secret")
    laughs = "".join(f"<!ENTITY l{i + 1} '{f'&l{i};' * 10}'>" for i in range(9))
    for dtd, use in (
        (f"<!DOCTYPE sdf [<!ENTITY l0 'lol'>{laughs}]>", "&l9;"),
        (f"<!DOCTYPE sdf [<!ENTITY x SYSTEM '{secret.as_uri()}'>]>", "&x;"),
        (f"<!DOCTYPE sdf SYSTEM '{secret.as_uri()}'>", ""),
    ):
        path = tmp_path / "a.sdf"
        path.write_text(f"<?xml version='1.0'?>{dtd}<sdf><world name='w'>{use}</world></sdf>")
        assert error_of(read_sdf, path) == f"{path}: {REFUSED}"


def test_an_included_file_must_not_declare_a_document_type(tmp_path, message_of):
    (tmp_path / "rock").mkdir()
    (tmp_path / "rock" / "model.sdf").write_text("<!DOCTYPE sdf><sdf/>")
    assert message_of("<include><uri>model://rock</uri></include>") == f"rock/model.sdf: {REFUSED}"


def test_huge_files_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(resources, "MAX_XML_BYTES", 1_000_000)
    path = tmp_path / "a.sdf"
    path.write_text("<sdf>" + " " * 1_000_000 + "</sdf>")
    assert error_of(read_sdf, path) == f"{path}: a scene file must not exceed 1 MB of XML"


@pytest.mark.parametrize("uri", ["../out/b.stl", "file://../out/b.stl", "model://../out/b.stl", "ABSOLUTE"])
def test_paths_out_of_the_folders_are_refused(tmp_path, uri):
    (tmp_path / "out").mkdir()
    trimesh.creation.box().export(tmp_path / "out" / "b.stl")
    uri = f"file://{tmp_path}/out/b.stl" if uri == "ABSOLUTE" else uri
    path = write(tmp_path / "in" / "a.sdf", model_of(f"<mesh><uri>{uri}</uri></mesh>"))
    assert error_of(read_sdf, path, skip_missing=True) == (
        f"{path}: world/model[m]/link[link]/collision[c]/geometry/mesh/uri: {uri!r} must stay in the scene's "
        f"folder and the resource paths (it leads to {tmp_path}/out/b.stl; if that is to be trusted, "
        "make its folder a resource path)"
    )
    assert len(read_sdf(path, [tmp_path / "out", tmp_path]).bodies) == 1


@pytest.mark.parametrize(
    "uri", ["file:///home/nobody/b.stl", "/home/nobody/b.stl", "../b.stl", "model://../b.stl"]
)
def test_what_is_missing_out_of_the_folders_can_be_skipped_too(tmp_path, uri):
    """A world names files of the machine that it was made on."""
    path = write(tmp_path / "in" / "a.sdf", model_of(f"<mesh><uri>{uri}</uri></mesh>"))
    with pytest.raises(Error) as caught:
        read_sdf(path)
    where = "/home/nobody/b.stl" if "nobody" in uri else f"{tmp_path}/in/../b.stl"
    assert str(caught.value).splitlines()[1:4] == [
        f"  {uri}",
        "    named by " + f"{path}: world/model[m]/link[link]/collision[c]/geometry/mesh/uri",
        f"    not at {where}",
    ]
    with pytest.warns(UserWarning, match="read without what is missing"):
        assert read_sdf(path, skip_missing=True).bodies == ()


def test_symbolic_links_out_of_the_folders_are_refused(tmp_path):
    add_model(tmp_path / "out", "rock")
    path = write(tmp_path / "in" / "a.sdf", "<include><uri>model://rock</uri></include>")
    (tmp_path / "in" / "rock").symlink_to(tmp_path / "out" / "rock")
    assert error_of(read_sdf, path) == (
        f"{path}: world/include[model://rock]: 'model://rock' must stay in the scene's folder and the "
        f"resource paths (it leads to {tmp_path}/out/rock; if that is to be trusted, make its folder "
        "a resource path)"
    )


def test_a_symbolic_link_that_leads_out_by_its_model_file_is_refused(tmp_path):
    add_model(tmp_path / "out", "rock")
    path = write(tmp_path / "in" / "a.sdf", "<include><uri>model://rock</uri></include>")
    (tmp_path / "in" / "rock").mkdir()
    (tmp_path / "in" / "rock" / "model.sdf").symlink_to(tmp_path / "out" / "rock" / "model.sdf")
    with pytest.raises(Error, match="must name a file beside it"):
        read_sdf(path)


def test_a_model_config_that_leads_out_is_refused(tmp_path):
    add_model(tmp_path / "out", "rock")
    config = "<model><sdf version='1.9'>../../out/rock/model.sdf</sdf></model>"
    folder = add_model(tmp_path / "in", "rock", config=config)
    path = write(tmp_path / "in" / "a.sdf", "<include><uri>model://rock</uri></include>")
    with pytest.raises(Error) as caught:
        read_sdf(path)
    outside = folder / "../../out/rock/model.sdf"
    assert str(caught.value) == (
        f"{folder / 'model.config'}: sdf must name a file beside it (got {str(outside)!r})"
    )


@pytest.mark.parametrize(
    ("paths", "words"),
    [
        (None, "resource_paths must be folders, each text or a Path (got None)"),
        (["models", 3], "resource_paths must be folders, each text or a Path (got ['models', 3])"),
        (__file__, f"resource path {__file__!r} must be a folder (got a file)"),
        (["/no/such"], "resource path '/no/such' must be a folder (there is none of that name)"),
    ],
)
def test_resource_paths_that_are_no_folders_are_refused(tmp_path, paths, words):
    with pytest.raises(Error, match=re.escape(words)):
        sg.load_scene(write(tmp_path / "a.sdf", model(link())), paths)


def test_names_too_long_for_a_file(message_of):
    long = "x" * 5000
    assert message_of(f"<include><uri>model://{long}</uri></include>").startswith("a.sdf: ")


@pytest.mark.parametrize(
    ("xml", "why"),
    [
        (
            "<sdf version='1.9'><gz:y b='1'/>{}</sdf>",
            "line 1: the prefix gz is not declared; add xmlns:gz='http://gazebosim.org/schema' to <sdf>",
        ),
        (
            "<sdf version='1.9'>\n<y rov:type='1'/>{}</sdf>",
            "line 2: the prefix rov is not declared; add xmlns:rov='urn:rov' to <sdf>",
        ),
        ("<sdf version='1.9'>\n<gz:/>{}</sdf>", "line 2: 'gz:' is no name of XML; remove its colon"),
        ("<sdf version='1.9'><y gz:='1'/>{}</sdf>", "line 1: 'gz:' is no name of XML; remove its colon"),
        ("<sdf version='1.9'>\n<!-- a -- b -->{}</sdf>", 'line 2: "--" in a comment'),
        (
            "<!-- who -->\n<?xml version='1.0'?><sdf version='1.9'>{}</sdf>",
            "line 2: the XML declaration is not first",
        ),
        ("<sdf version='1.9'>\n<y>http://a/?b=1&c=2 &amp; &#65; A & B</y>{}</sdf>", "line 2: a bare '&'"),
        ("<sdf version='1.9'><y b='1&2'/><!-- -- -->{}</sdf>", 'line 1: "--" in a comment'),
    ],
)
def test_xml_that_only_gazebo_accepts_is_read_with_one_warning(tmp_path, xml, why):
    path = tmp_path / "a.sdf"
    path.write_text(xml.format(f"<sonar_gl:surface>3</sonar_gl:surface>{model(link())}"))
    with pytest.warns(UserWarning) as caught:
        scene = read_sdf(path)
    assert [str(w.message) for w in caught] == [f"{path}: broken XML, read as Gazebo reads it: {why}"]
    assert [body.name for body in scene.bodies] == ["m"]
    np.testing.assert_array_equal(np.ptp(scene.bodies[0].surface.vertices, axis=0), (2, 4, 6))


def test_a_bare_and_stays_in_names(tmp_path):
    trimesh.creation.box((5, 1, 1)).export(tmp_path / "a&b.stl")
    path = write(tmp_path / "a.sdf", model_of("<mesh><uri>a&b.stl</uri></mesh>", "A & B &amp; C"))
    with pytest.warns(UserWarning, match="line 2: a bare '&'"):
        (body,) = read_sdf(path).bodies
    assert body.name == "A & B & C" and np.ptp(body.surface.vertices[:, 0]) == 5


@pytest.mark.parametrize("use", ["&x;", ""])
def test_entities_are_refused_in_xml_that_only_gazebo_accepts(tmp_path, use):
    """lxml, which reads it, would replace them; strict parsing stops before it sees the declaration."""
    secret = tmp_path / "secret.txt"
    secret.write_text("secret")
    path = tmp_path / "a.sdf"
    path.write_text(
        f"<!-- a -- b --><!DOCTYPE sdf [<!ENTITY x SYSTEM '{secret.as_uri()}'>]><sdf>{use}{model(link())}</sdf>"
    )
    with pytest.raises(Error, match=re.escape(REFUSED)):
        read_sdf(path)


@pytest.mark.parametrize("scheme", ["", "file://", "model://", "package://parts/"])
def test_names_of_files_may_be_escaped_as_in_uris(tmp_path, read_text, message_of, scheme):
    folder = tmp_path / "parts" / "my hülle"
    folder.mkdir(parents=True)
    trimesh.creation.box((2, 4, 6)).export(folder / "50% box.STL")
    prefix = scheme if scheme.startswith("package") else f"{scheme}parts/"

    def mesh(name):
        return model_of(f"<mesh><uri>{prefix}{name}</uri></mesh>")

    for name in ("my hülle/50% box.STL", "my%20h%C3%BClle/50%25%20box.STL"):
        np.testing.assert_array_equal(read_text(mesh(name)).bodies[0].mesh.extents, (2, 4, 6))
    (tmp_path / "parts" / "%20.stl").write_bytes((folder / "50% box.STL").read_bytes())
    assert len(read_text(mesh("%20.stl")).bodies) == 1  # a file that has this very name
    (tmp_path.parent / "secret.stl").write_bytes((folder / "50% box.STL").read_bytes())
    if not scheme:
        got = message_of(mesh("%2E%2E/%2E%2E/secret.stl"))
        assert "must stay in the scene's folder and the resource paths" in got
