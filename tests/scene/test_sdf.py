"""SDF: poses, the choice of shapes, the sonar, includes, extensions, and error messages."""

import dataclasses
import os
import re
import warnings
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh

import sonar_gl as sg
from sonar_gl.core.errors import Error
from sonar_gl.core.poses import pose
from sonar_gl.scene.joined_shapes import SurfaceKind
from sonar_gl.scene.materials import material
from sonar_gl.scene.primitives import closedness
from sonar_gl.scene.sdf import extensions, frames, reader, resources
from sonar_gl.scene.sdf.reader import read_sdf
from sonar_gl.scene.sdf.shapes import EXTENSIONS
from tests.support.errors import error_of

ROUNDING = 1e-12  # of a few products of float64 matrices
BOX = "<geometry><box><size>2 4 6</size></box></geometry>"
RETRO = "<laser_retro>255</laser_retro>"
SHAPE = f"<collision name='c'>{BOX}{RETRO}</collision>"
GAZEBO_PATHS = (
    *("GZ_SIM_RESOURCE_PATH", "IGN_GAZEBO_RESOURCE_PATH", "SDF_PATH"),
    *("GAZEBO_MODEL_PATH", "GAZEBO_RESOURCE_PATH"),
)


@pytest.fixture(autouse=True)
def no_environment(monkeypatch, tmp_path):
    for key in GAZEBO_PATHS:
        monkeypatch.delenv(key, raising=False)
    monkeypatch.setenv("GZ_FUEL_CACHE_PATH", str(tmp_path / "gz"))
    monkeypatch.setenv("IGN_FUEL_CACHE_PATH", str(tmp_path / "ign"))


def test_each_property_of_a_whole_surface_keeps_shapes_apart():
    """Shapes of one link that differed in a property that SurfaceKind lacked would be one body, without it."""
    of_each_shape = {"name", "mesh", "pose", "reflectivity", "normals", "material"}
    properties = {field.name for field in dataclasses.fields(sg.Body) if field.init} - of_each_shape
    assert properties == set(SurfaceKind._fields), (
        "add what a body has to SurfaceKind, and to what readers make of it"
    )


def test_the_page_of_conventions_has_a_row_of_each_tag_of_a_shape():
    page = (Path(__file__).parents[2] / "docs" / "conventions.md").read_text()
    section = page.partition("### Tags of this simulator")[2].partition("\n## ")[0]
    told = re.findall(r"^\| `<sonar_gl:(\w+)>.*` \| collision or visual \|", section, re.MULTILINE)
    assert sorted(told) == sorted(EXTENSIONS)


def shape(tags="", name="c", kind="collision", geometry=BOX):
    return f"<{kind} name='{name}'>{geometry}{tags}</{kind}>"


def link(inside="", name="link", shape=SHAPE):
    return f"<link name='{name}'>{inside}{shape}</link>"


def model(inside, name="m"):
    return f"<model name='{name}'>{inside}</model>"


def model_of(geometry, name="m"):
    """Return a model of one shape, whose geometry is <box>, <mesh> or another."""
    return model(link(shape=shape(RETRO, geometry=f"<geometry>{geometry}</geometry>")), name)


def write(path, inside, world=True):
    path.parent.mkdir(parents=True, exist_ok=True)
    inside = f"<world name='w'>{inside}</world>" if world else inside
    path.write_text(f"<?xml version='1.0'?>\n<sdf version='1.9'>{inside}</sdf>", encoding="utf-8")
    return path


def read_warned(tmp_path, inside, *paths, **options):
    """Return the scene of a world, and the texts of its warnings without the path of its file."""
    path = write(tmp_path / "a.sdf", inside)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        scene = read_sdf(path, paths, **options)
    return scene, [str(w.message).removeprefix(f"{path}: ") for w in caught]


@pytest.fixture
def read(tmp_path):
    """A function that reads a world with these elements; warnings are errors unless a test catches them."""

    def read(inside, world=True, **options):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            return read_sdf(write(tmp_path / "a.sdf", inside, world), **options)

    return read


@pytest.fixture
def message(tmp_path):
    """A function that returns the error message of a world with these elements, without the folder."""

    def message(inside, world=True, **options):
        with pytest.raises(Error) as caught:
            read_sdf(write(tmp_path / "a.sdf", inside, world), **options)
        return str(caught.value).replace(f"{tmp_path}{os.sep}", "")

    return message


def add_model(folder, name, inside=None, config=None):
    text = model(link(), name) if inside is None else inside
    write(folder / name / "model.sdf", text, world=False)
    if config:
        (folder / name / "model.config").write_text(config)
    return folder / name


# ---- poses -------------------------------------------------------------------------------------------


def test_chain_of_relative_frames_against_hand_computed_values(read):
    scene = read(
        model(
            "<pose>10 0 0 0 0 1.5707963267948966</pose>"
            "<link name='base'><pose>1 0 0 0 0 0</pose></link>"
            "<frame name='f' attached_to='base'><pose>0 2 0 0 0 0</pose></frame>"
            "<frame name='g'><pose relative_to='f'>0 0 3 1.5707963267948966 0 0</pose></frame>"
            "<link name='tip'><pose relative_to='g'>0 1 0 0 0 0</pose>"
            f"<collision name='c'><pose>0 0 5 0 0 0</pose>{BOX}{RETRO}</collision></link>"
        )
    )
    # in the model: base (1 0 0), f (1 2 0), g (1 2 3) rolled by 90 degrees, whose y is up: tip (1 2 4),
    # and the shape's centre, 5 along its z, (1 -3 4)
    # the model, turned by 90 degrees about z at (10 0 0), takes (x y z) to (10 - y, x, z)
    (body,) = scene.bodies
    expected = [[0, -1, 0, 10], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    np.testing.assert_allclose(body.pose, expected, rtol=0, atol=ROUNDING)
    np.testing.assert_allclose(body.mesh.bounds, [[0, -6, 2], [2, 0, 6]], rtol=0, atol=ROUNDING)
    assert body.name == "m" and body.reflectivity == 1.0 and body.normals is None


def test_shape_relative_to_a_frame_of_its_model(read):
    shape = f"<collision name='c'><pose relative_to='mark'>1 0 0 0 0 0</pose>{BOX}{RETRO}</collision>"
    scene = read(
        model(
            "<frame name='mark'><pose>0 0 9 0 0 3.141592653589793</pose></frame>"
            + link("<pose>5 0 0 0 0 0</pose>", shape=shape)
        )
    )
    # mark points backwards: the shape is at (-1 0 9) in the model, wherever its link is
    np.testing.assert_allclose(scene.bodies[0].mesh.bounds, [[-2, -2, 6], [0, 2, 12]], rtol=0, atol=ROUNDING)


def test_quaternion_degrees_and_old_frame_attribute(read):
    half = np.sqrt(0.5)
    scene = read(
        "<frame name='there'><pose>0 0 7 0 0 0</pose></frame>"
        + model(
            f"<pose rotation_format='quat_xyzw'>1 2 3 0 0 {2 * half} {2 * half}</pose>" + link(), "quaternion"
        )
        + model("<pose degrees='true'>1 2 3 0 0 450</pose>" + link(), "degrees")
        + model("<pose>1 2 3 0 0 1.5707963267948966</pose>" + link(), "radians")
        + model("<pose frame='there'>1 0 0 0 0 0</pose>" + link(), "old")
        + model("<pose frame=''/>" + link(), "empty")
    )
    turned = pose(1, 2, 3, yaw=np.pi / 2)
    for body in scene.bodies[:3]:
        np.testing.assert_allclose(body.pose, turned, rtol=0, atol=ROUNDING)
    np.testing.assert_array_equal(scene.bodies[3].pose, pose(1, 0, 7))
    np.testing.assert_array_equal(scene.bodies[4].pose, np.eye(4))


def test_nested_models_scoped_frames_joints_and_placement(read):
    inner = model("<pose>1 0 0 0 0 0</pose>" + link("<pose>0 1 0 0 0 0</pose>"), "inner")
    scene = read(
        model("<pose>0 0 5 0 0 0</pose>" + inner + link("<pose relative_to='inner::link'/>"), "outer")
        + model("<pose relative_to='outer::inner'>0 0 1 0 0 0</pose>" + link(), "beside")
        + model(
            "<joint name='j'><pose>0 0 2 0 0 0</pose><child>a</child></joint>"
            "<link name='a'><pose>0 0 1 0 0 0</pose></link>" + link("<pose relative_to='j'/>"),
            "jointed",
        )
        + "<model name='placed' placement_frame='foot'><pose>0 0 0 0 0 0</pose>"
        "<frame name='foot'><pose>0 0 -3 0 0 0</pose></frame>" + link() + "</model>"
    )
    assert {body.name: body.pose[:3, 3].tolist() for body in scene.bodies} == {
        "outer::inner": [1, 0, 5],
        "outer": [0, 0, 5],
        "beside": [1, 0, 6],
        "jointed": [0, 0, 0],
        "placed": [0, 0, 3],
    }
    boxes = {
        body.name: (body.pose @ [*body.mesh.bounds.mean(axis=0), 1])[:3].tolist() for body in scene.bodies
    }
    assert boxes == {
        "outer::inner": [1, 1, 5],
        "outer": [1, 1, 5],
        "beside": [1, 0, 6],
        "jointed": [0, 0, 3],
        "placed": [0, 0, 3],
    }


def test_poses_keep_float64_far_from_the_origin(read):
    scene = read(model("<pose>500000.000001 5000000.000001 0 0 0 0</pose>" + link()))
    np.testing.assert_array_equal(scene.bodies[0].pose[:2, 3], [500000.000001, 5000000.000001])


# ---- bodies ------------------------------------------------------------------------------------------


def test_bare_model_and_scene_name(read):
    scene = read(model("<pose>1 2 3 0 0 0</pose>" + link()), world=False)
    assert scene.name == "a" and [b.name for b in scene.bodies] == ["m"] and scene.sonar_pose is None
    np.testing.assert_array_equal(scene.bodies[0].pose, pose(1, 2, 3))


def test_names_of_several_links(read):
    scene = read(
        model(link(name="a") + link(name="b") + "<link name='bare'/>" + model(link(), "inner"), "outer")
    )
    assert [b.name for b in scene.bodies] == ["outer::a", "outer::b", "outer::inner"]


def test_a_body_with_the_name_of_its_model_has_its_pose(read):
    """A simulator that says where the model is places the body by its name; the pose of the link stays."""
    tags = f"<pose>0 0 3 0 0 1.5707963267948966</pose>{shape(RETRO)}"
    scene = read(
        model(
            f"<pose>10 0 0 0 0 0</pose><link name='link'>{tags}"
            f"{shape(RETRO + '<sonar_gl:speckle_shape>1</sonar_gl:speckle_shape>', 'rough')}"
            "<sonar_gl:bubbles name='leak'><pose>1 0 0 0 0 0</pose></sonar_gl:bubbles></link>"
        )
    )
    for body in scene.bodies:
        np.testing.assert_array_equal(body.pose, pose(10))
        np.testing.assert_allclose(body.mesh.bounds, [[-2, -1, 0], [2, 1, 6]], rtol=0, atol=ROUNDING)
    assert [body.name for body in scene.bodies] == ["m", "m::rough"]
    np.testing.assert_allclose(scene.plumes[0].pose[:3, 3], [10, 1, 3], rtol=0, atol=ROUNDING)


def test_the_poses_of_models_are_kept(tmp_path, read):
    add_model(tmp_path, "arms", model(MERGED, "arms"))
    inside = MERGE.format("<pose>0 0 2 0 0 0</pose>") + model("<pose>1 0 0 0 0 0</pose>" + link(), "inner")
    scene = read(model("<pose>10 0 0 0 0 0</pose>" + inside, "rov") + model("", "empty"))
    places = {name: matrix[:3, 3].tolist() for name, matrix in scene.without("rov::hand").models.items()}
    assert places == {
        "rov": [10, 0, 0],
        "rov::tool": [10, 2, 3],
        "rov::inner": [11, 0, 0],
        "empty": [0, 0, 0],
    }


def test_a_body_with_the_name_of_its_link_has_its_pose(read):
    links = "".join(f"<link name='{k}'><pose>{k} 0 3 0 0 0</pose>{shape(RETRO)}</link>" for k in (1, 2))
    scene = read(model(f"<pose>10 0 0 0 0 0</pose>{links}"))
    for k, body in zip((1, 2), scene.bodies, strict=True):
        np.testing.assert_array_equal(body.pose, pose(10 + k, 0, 3))
        np.testing.assert_array_equal(body.mesh.bounds, [[-1, -2, -3], [1, 2, 3]])


SIZES = {"box": (2, 4, 6), "sphere": (2, 2, 2)}
BALL = "<geometry><sphere><radius>1</radius></sphere></geometry>"


@pytest.mark.parametrize(
    ("on_collision", "on_visual", "expected"),
    [(True, True, "box"), (False, False, "box"), (True, False, "box"), (False, True, "sphere")],
)
def test_shapes_with_laser_retro_make_the_body(tmp_path, on_collision, on_visual, expected):
    shapes = (
        f"<visual name='v'>{BALL}{RETRO * on_visual}</visual>"
        f"<collision name='c'>{BOX}{RETRO * on_collision}</collision>"
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        scene = read_sdf(write(tmp_path / "a.sdf", model(link(shape=shapes))))
    np.testing.assert_array_equal(scene.bodies[0].mesh.extents, SIZES[expected])


def test_visuals_make_the_body_without_collisions(read):
    empty = "<collision name='c'><geometry><empty/></geometry></collision>"
    scene = read(model(link(shape=f"{empty}<visual name='v'>{BALL}{RETRO}</visual>")))
    np.testing.assert_array_equal(scene.bodies[0].mesh.extents, SIZES["sphere"])


def test_shapes_of_a_link_are_one_body_with_one_reflectivity_per_face(read):
    scene = read(
        model(
            link(
                shape=f"<collision name='a'>{BOX}<laser_retro>0</laser_retro></collision>"
                f"<collision name='b'>{BALL}<laser_retro>51</laser_retro></collision>"
            )
        )
    )
    (body,) = scene.bodies
    faces = len(body.mesh.faces)
    np.testing.assert_array_equal(body.reflectivity, [0.0] * 12 + [0.2] * (faces - 12))
    assert not body.normals[:8].any()
    # float32, of three numbers
    np.testing.assert_allclose(np.linalg.norm(body.normals[8:], axis=1), 1, rtol=0, atol=2**-23)


def test_one_warning_names_the_bodies_without_laser_retro(tmp_path):
    bare = f"<collision name='c'>{BOX}</collision>"
    inside = model(link(shape=bare), "x") + model(link(), "y") + model(link(shape=bare), "z")
    scene, texts = read_warned(tmp_path, inside)
    assert texts == ["no <laser_retro> in 2 of 3 bodies (x, z); their reflectivity is taken as 0.5"]
    assert [b.reflectivity for b in scene.bodies] == [0.5, 1.0, 0.5]


@pytest.mark.parametrize(
    ("geometry", "extents"),
    [
        ("<cylinder><radius>1</radius><length>3</length></cylinder>", (2, 2, 3)),
        ("<capsule><radius>1</radius><length>3</length></capsule>", (2, 2, 5)),
        ("<ellipsoid><radii>1 2 3</radii></ellipsoid>", (2, 4, 6)),
        ("<plane><normal>0 0 1</normal><size>3 4</size></plane>", (22_000, 22_000, 0)),
    ],
)
def test_geometry_of_collisions(read, geometry, extents):
    np.testing.assert_array_equal(read(model_of(geometry)).bodies[0].mesh.extents, extents)


def test_heightmap_and_scaled_mesh_beside_the_file(tmp_path, read):
    cv2.imwrite(str(tmp_path / "h.png"), np.array([[255, 0], [0, 0]], np.uint8))
    trimesh.creation.box((1, 1, 1)).export(tmp_path / "box.stl")
    field = "<heightmap><uri>h.png</uri><size>4 4 2</size><pos>1 0 0</pos></heightmap>"
    mesh = "<mesh><uri>file://box.stl</uri><scale>1 2 -3</scale></mesh>"
    floor, box = read(model_of(field, "floor") + model_of(mesh, "box")).bodies
    top = floor.mesh.vertices[floor.mesh.vertices[:, 2].argmax()]
    np.testing.assert_array_equal(top, [-1, 2, 2])
    np.testing.assert_array_equal(box.mesh.extents, [1, 2, 3])
    assert box.mesh.volume == pytest.approx(6, rel=ROUNDING)


@pytest.mark.parametrize("scale", ["", "<scale>0.5 0.5 0.5</scale>"])
def test_models_of_one_mesh_share_it(tmp_path, read, scale):
    """A world of a hundred rocks of one file took the memory and the time of a hundred meshes."""
    trimesh.creation.icosphere(1).export(tmp_path / "rock.glb", include_normals=True)
    shape = (
        f"<collision name='c'><geometry><mesh><uri>rock.glb</uri>{scale}</mesh></geometry>{RETRO}</collision>"
    )
    large = (
        shape.replace(scale, "<scale>2 2 2</scale>")
        if scale
        else shape.replace("</uri>", "</uri><scale>2 2 2</scale>")
    )
    poses = [f"<pose>{k} 0 0 0 0 {k}</pose>" for k in range(3)]
    *small, other = read(
        "".join(model(pose + link(shape=shape), f"rock_{k}") for k, pose in enumerate(poses))
        + model(link(shape=large), "large")
    ).bodies
    assert len({(id(body.surface), id(body.normals)) for body in small}) == 1
    assert [body.pose[0, 3] for body in small] == [0, 1, 2]
    size_m = 1 if scale else 2
    np.testing.assert_allclose(
        np.ptp(small[0].surface.vertices, axis=0), size_m, rtol=1e-6
    )  # float32 in the file
    np.testing.assert_allclose(np.ptp(other.surface.vertices, axis=0), 4, rtol=1e-6)


def test_an_elevation_model_keeps_its_heights_and_needs_a_size(tmp_path, read):
    """A world as of gz-sim's tutorial on elevation models: `<size>` z is maximum - minimum, `<pos>` z - maximum."""
    cv2.imwrite(str(tmp_path / "dem.tif"), np.array([[1213.5, 2000], [2000, 2695]], np.float32))
    field = "<heightmap><uri>dem.tif</uri>{}<pos>0 0 -2695</pos></heightmap>"
    (body,) = read(model_of(field.format("<size>3793 3563 1481.5</size>"))).bodies
    np.testing.assert_array_equal(body.mesh.bounds, [[-1896.5, -1781.5, -1481.5], [1896.5, 1781.5, 0]])
    _, texts = read_warned(tmp_path, model_of(field.format("")))
    assert texts == [
        "height maps without <size> are 1 m wide and long, which is SDF's default: "
        "world/model[m]/link[link]/collision[c]/geometry/heightmap"
    ]


def test_a_glb_named_by_sdf_is_not_turned(tmp_path, read):
    trimesh.creation.box((1, 2, 3)).export(tmp_path / "box.glb")
    (body,) = read(model_of("<mesh><uri>box.glb</uri></mesh>")).bodies
    np.testing.assert_array_equal(body.mesh.extents, [1, 2, 3])


STATE = """<state world_name='w'><model name='gone'><pose>9 9 9 0 0 0</pose></model>
<model name='gate'><pose frame=''>1 2 3 0 0 1.5707963267948966</pose><scale>10 1 1.0</scale>
<link name='a'><pose>1 2 3 0 0 1.5707963267948966</pose><velocity>0 0 0 0 0 0</velocity></link>
<link name='b'><pose>1 7 3 0 0 0</pose></link>
<model name='inner'><pose>4 4 4 0 0 0</pose><link name='c'><pose>4 4 5 0 0 0</pose></link></model>
</model>
<model name='flat'><pose>5 0 0 0 0 0</pose><link name='part::d'><pose>5 0 2 0 0 0</pose></link></model>
<model name='rock'><pose>0.001 0 0 0 0 0</pose><scale>1 1 1</scale></model></state>"""


def test_models_stand_where_the_state_of_gazebo_classic_says(tmp_path):
    """It moves them there when it opens the world; a deleted model is still in the state."""
    inner = model(link(name="c", shape=shape(RETRO)), name="inner")
    parts = link(name="a", shape=shape(RETRO)) + link(name="b", shape=shape(RETRO))
    flat = model(model(link(name="d", shape=shape(RETRO)), name="part"), name="flat")
    rock = model(link(shape=shape(RETRO)), name="rock")
    scene, texts = read_warned(tmp_path, model(parts + inner, name="gate") + flat + rock + STATE)
    assert texts == [
        "models stand where <state> says, as in Gazebo Classic (gate, flat); <scale> of <state> is left out "
        "(gate)"
    ]
    middles = {body.name: (body.pose @ [*body.surface.vertices.mean(axis=0), 1])[:3] for body in scene.bodies}
    expected = {
        "gate::a": [1, 2, 3],
        "gate::b": [1, 7, 3],
        "gate::inner": [4, 4, 5],
        "flat::part": [5, 0, 2],
        "rock": [0.001, 0, 0],
    }
    assert list(middles) == list(expected)
    np.testing.assert_allclose(list(middles.values()), list(expected.values()), rtol=0, atol=ROUNDING)
    np.testing.assert_allclose(scene.models["gate"], pose(1, 2, 3, yaw=np.pi / 2), rtol=0, atol=ROUNDING)
    np.testing.assert_allclose(scene.models["gate::inner"][:3, 3], 4, rtol=0, atol=ROUNDING)


def test_a_state_without_poses_or_with_bad_ones(tmp_path, read):
    shaped = model(link(shape=shape(RETRO)), name="m")
    (body,) = read(
        shaped + "<state><model name='m'><link name='nobody'/></model><light name='m'/></state>"
    ).bodies
    assert np.array_equal(body.pose, np.eye(4))
    path = write(tmp_path / "a.world", shaped + "<state><model name='m'><pose>1 2</pose></model></state>")
    assert (
        error_of(read_sdf, path) == f"{path}: world/state/model[m]/pose: must be 6 finite numbers (got '1 2')"
    )


def test_what_gazebo_shows_and_is_not_read_is_told(tmp_path):
    (tmp_path / "walker").mkdir()
    walker = write(tmp_path / "walker" / "model.sdf", "<actor name='walker'/>", world=False)
    inside = (
        "<actor name='swimmer'/><road name='quay'/><population name='crates'><model name='c'/></population>"
    )
    _, texts = read_warned(tmp_path, f"{inside}<include><uri>{walker.parent.name}</uri></include>")
    assert texts == [
        "actors, populations and roads are left out "
        "(actor swimmer, road quay, population crates, actor walker)"
    ]


# ---- the sonar ---------------------------------------------------------------------------------------

SENSOR = "<pose>0 0 1 0 0 0</pose>"


def test_a_custom_sensor_overrides_one_named_sonar_and_its_link_is_no_body(read):
    scene = read(
        model(link(f"<sensor name='my_sonar' type='depth'>{SENSOR}</sensor>"), "first")
        + model(
            "<pose>5 0 0 0 0 1.5707963267948966</pose>"
            + link(f"<pose>1 0 0 0 0 0</pose><sensor name='s' type='custom'>{SENSOR}</sensor>"),
            "second",
        )
    )
    np.testing.assert_allclose(scene.sonar_pose, pose(5, 1, 1, yaw=np.pi / 2), rtol=0, atol=ROUNDING)
    assert [b.name for b in scene.bodies] == ["first"]


@pytest.mark.parametrize(
    ("sensor", "name"),
    [
        ("<sensor name='front_SONAR' type='ray'/>", "m"),
        ("<sensor name='s' type='depth'><plugin name='p' filename='libnps_multibeam.so'/></sensor>", "m"),
        ("<sensor name='s' type='depth'><plugin name='FLS' filename='x'/></sensor>", "m"),
        ("<sensor name='imu' type='imu'/><sensor name='s' type='depth'/>", "p900_multibeam"),
    ],
)
def test_sensors_named_after_a_sonar(read, sensor, name):
    scene = read(model(link("<pose>1 2 3 0 0 0</pose>" + sensor), name))
    np.testing.assert_array_equal(scene.sonar_pose, pose(1, 2, 3))
    assert scene.bodies == ()


def test_a_camera_is_no_sonar(read):
    scene = read(model(link("<sensor name='camera' type='camera'/><sensor name='imu' type='imu'/>")))
    assert scene.sonar_pose is None and len(scene.bodies) == 1


def test_the_mesh_of_the_sonar_is_not_read(read):
    shape = "<collision name='c'><geometry><mesh><uri>model://none/a.stl</uri></mesh></geometry></collision>"
    assert read(model(link("<sensor name='s' type='custom'/>", shape=shape))).bodies == ()


# ---- includes ----------------------------------------------------------------------------------------


def test_include_by_model_config_newest_version_name_and_pose(tmp_path, read):
    folder = add_model(
        tmp_path / "models",
        "rock",
        model("<pose>9 9 9 0 0 0</pose>" + link(), "old"),
        "<model><sdf version='1.4'>model.sdf</sdf><sdf version='1.10'>new.sdf</sdf>"
        "<sdf version='1.9'>model.sdf</sdf></model>",
    )
    write(folder / "new.sdf", model("<pose>1 1 1 0 0 0</pose>" + link(), "new"), world=False)
    scene = read(
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


@pytest.mark.parametrize("declared", ["", " xmlns:experimental='urn:any'"])
def test_changes_of_included_models_are_left_out_with_a_warning(tmp_path, declared):
    """SDF 1.8 moves, adds and removes links of an included model by them."""
    add_model(tmp_path, "rock")
    change = "<pose element_id='link' action='modify'>1 0 0 0 0 0</pose>"
    params = f"<experimental:params{declared}>{change}</experimental:params>"
    include = f"<include><name>reef</name><uri>model://rock</uri>{params}</include>"
    _, texts = read_warned(tmp_path, include)
    assert "changes of included models by <experimental:params> are left out (reef)" in texts


def test_order_of_argument_environment_and_own_folder(tmp_path, monkeypatch, read):
    for folder in ("argument", "environment", "."):
        add_model(tmp_path / folder, "rock", model(link(), folder.replace(".", "own")))
    include = "<include><uri>model://rock</uri></include>"
    assert read(include).bodies[0].name == "own"
    monkeypatch.setenv("GAZEBO_MODEL_PATH", str(tmp_path / "environment"))
    assert read(include).bodies[0].name == "environment"
    assert read(include, resource_paths=tmp_path / "argument").bodies[0].name == "argument"


def test_relative_uris_are_relative_to_the_file_that_names_them(tmp_path, read):
    rock = model_of("<mesh><uri>meshes/b.stl</uri></mesh>", "rock")
    folder = add_model(tmp_path / "models", "rock", rock)
    (folder / "meshes").mkdir()
    trimesh.creation.box((1, 2, 3)).export(folder / "meshes" / "b.stl")
    scene = read("<include><uri>models/rock</uri></include>")
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


def test_files_are_found_whatever_the_scheme(tmp_path, read):
    """Gazebo searches so; some worlds have models:// in place of model://."""
    trimesh.creation.box((5, 1, 1)).export(tmp_path / "b.stl")
    (body,) = read(model_of("<mesh><uri>models://b.stl</uri></mesh>")).bodies
    assert np.ptp(body.surface.vertices[:, 0]) == 5


def test_elements_without_acoustic_meaning_are_ignored(read):
    scene = read(
        "<physics type='ode'><gravity>x y z</gravity></physics><light name='l'><pose>nonsense</pose></light>"
        "<gui><camera name='c'><pose>1 2</pose></camera></gui><plugin name='p' filename='q'><a/></plugin>"
        + model("<static>1</static>" + link("<inertial><pose>bad</pose></inertial>"))
    )
    assert len(scene.bodies) == 1


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


def test_all_that_is_missing_is_named_at_once(tmp_path, message):
    (tmp_path / "models").mkdir()
    text = message(MISSING_WORLD, resource_paths=[tmp_path / "models"])
    expected = MISSING.replace("R/", "") + (
        "Give the folders that hold them (--resource-path, resource_paths=), "
        "or carry on without them (--skip-missing, skip_missing=True)."
    )
    assert text == expected


def test_of_much_that_is_missing_the_first_is_explained(tmp_path, message):
    names = [f"model://m{k}" for k in range(30)]
    text = message("".join(f"<include><uri>{name}</uri></include>" for name in names))
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


def test_a_model_folder_without_a_model_is_missing(tmp_path, message):
    (tmp_path / "rock").mkdir()
    assert message("<include><uri>model://rock</uri></include>").startswith(
        "a.sdf: models or files are missing:\n  model://rock\n"
        "    named by a.sdf: world/include[model://rock]\n    not at rock/model.sdf\n"
    )


# ---- what Gazebo reads, too --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("geometry", "low", "high"),
    [
        ("<box/>", (-0.5, -0.5, -0.5), (0.5, 0.5, 0.5)),
        ("<sphere/>", (-1, -1, -1), (1, 1, 1)),
        ("<cylinder/>", (-1, -1, -0.5), (1, 1, 0.5)),
        ("<capsule/>", (-0.5, -0.5, -1), (0.5, 0.5, 1)),
        ("<ellipsoid/>", (-1, -1, -1), (1, 1, 1)),
        ("<cone/>", (-0.5, -0.5, -0.5), (0.5, 0.5, 0.5)),
        ("<cone><radius>2</radius><length>3</length></cone>", (-2, -2, -1.5), (2, 2, 1.5)),
        (
            "<polyline><point>0 0</point><point>2 0</point><point>2 1</point></polyline>",
            (0, 0, 0),
            (2, 1, 1),
        ),
    ],
)
def test_shapes_have_sdfs_own_defaults(read, geometry, low, high):
    """The values of SDF's specification, http://sdformat.org/spec?elem=geometry."""
    (body,) = read(model_of(geometry)).bodies
    np.testing.assert_allclose(body.surface.vertices.min(axis=0), low, rtol=0, atol=ROUNDING)
    np.testing.assert_allclose(body.surface.vertices.max(axis=0), high, rtol=0, atol=ROUNDING)
    assert closedness(*body.surface) == 1


@pytest.mark.parametrize(
    ("center", "middle"),
    [
        ("", 5.0),
        ("<center>false</center>", 5.0),
        ("<center>1</center>", 0.0),
        ("<center> true </center>", 0.0),
    ],
)
def test_a_submesh_lies_where_it_is_in_its_file_unless_it_is_to_be_centred(tmp_path, read, center, middle):
    scene = trimesh.Scene()
    scene.add_geometry(trimesh.creation.box((1, 1, 1)), node_name="near", geom_name="one")
    scene.add_geometry(
        trimesh.creation.box((2, 2, 2)), node_name="far", geom_name="two", transform=sg.pose(5)
    )
    scene.export(tmp_path / "a.glb")
    geometry = f"<mesh><uri>a.glb</uri><submesh><name>far</name>{center}</submesh></mesh>"
    (body,) = read(model_of(geometry)).bodies
    low, high = (f(body.surface.vertices, axis=0) for f in (np.min, np.max))
    np.testing.assert_allclose([low, high], [[middle - 1, -1, -1], [middle + 1, 1, 1]], atol=ROUNDING)


@pytest.mark.parametrize(
    ("tags", "extents"),
    [
        ("", (1, 1, 0)),
        ("<size>4 6</size>", (4, 6, 0)),
        ("<normal>1 0 0</normal><size>3 4</size>", (0, 4, 3)),
    ],
)
def test_the_plane_of_a_visual_is_as_large_as_stated_or_a_square_metre(read, tags, extents):
    """SDF's default size of a plane is 1 1; that of a collision is infinite."""
    visual = f"<visual name='v'><geometry><plane>{tags}</plane></geometry>{RETRO}</visual>"
    (body,) = read(model(link(shape=visual))).bodies
    half = np.divide(extents, 2)
    np.testing.assert_allclose(body.mesh.bounds, [-half, half], rtol=0, atol=ROUNDING)


@pytest.mark.parametrize(
    ("specular", "n_bodies"), [("", 1), ("<sonar_gl:specular>0.2</sonar_gl:specular>", 2)]
)
def test_the_roughness_of_shapes_without_a_lobe_divides_no_link(read, specular, n_bodies):
    """Only the width of a lobe would differ."""
    shapes = "".join(
        f"<collision name='c{k}'><geometry><box/></geometry>{RETRO}{specular}"
        f"<sonar_gl:roughness>{roughness}</sonar_gl:roughness></collision>"
        for k, roughness in enumerate((0.1, 0.2))
    )
    assert len(read(model(link(shape=shapes))).bodies) == n_bodies


@pytest.mark.parametrize(
    ("points", "count"), [(["0 0", "1 0"], 2), (["0 0", "1 0", "1 0", "0 0"], 2), (["1 2"] * 5, 0)]
)
def test_a_polyline_of_fewer_than_three_different_points_is_refused(read, points, count):
    """Points that follow one another in one place count once; the last one is followed by the first."""
    line = "".join(f"<point>{point}</point>" for point in points)
    with pytest.raises(Error, match=rf"polyline: must have three different points or more \(got {count}\)$"):
        read(model_of(f"<polyline>{line}</polyline>"))


def test_polylines_within_others_are_holes(read):
    """A square ring of area 16 − 4 with a square of 0.25 in its hole, and a triangle beside it; the senses differ."""
    rings = (
        "<point>0 0</point><point>4 0</point><point>4 4</point><point>0 4</point><point>0 0</point>",
        "<point>1 1</point><point>1 3</point><point>3 3</point><point>3 1</point>",
        "<point>9 0</point><point>9 1</point><point>8 0</point>",
    )
    lines = "".join(f"<polyline><height>0.5</height>{points}</polyline>" for points in rings)
    (body,) = read(model_of(lines)).bodies
    assert body.mesh.volume == pytest.approx(0.5 * (16 - 4 + 0.5), rel=ROUNDING)
    assert body.mesh.area == pytest.approx(2 * 12.5 + 0.5 * (16 + 8 + 2 + np.sqrt(2)), rel=ROUNDING)


def test_large_angles_are_radians_and_warn_once(tmp_path):
    """As in Gazebo: any number is an angle, though these are nearly always degrees."""
    turned = SHAPE.replace("<geometry>", "<pose>0 0 0 45 0 0</pose><geometry>")
    world = model("<pose>1 0 0 0 0 -105</pose>" + link(), "a") + model(link(shape=turned), "b")
    world += model("<pose degrees='true'>0 0 0 0 0 720</pose>" + link(), "c")
    scene, (text,) = read_warned(tmp_path, world)
    a, b, _ = scene.bodies
    np.testing.assert_allclose(a.pose, pose(1, 0, 0, 0, 0, -105 + 34 * np.pi), rtol=0, atol=ROUNDING)
    corner = pose(0, 0, 0, 45 - 14 * np.pi) @ (1, 2, 3, 1)
    assert np.abs(b.mesh.vertices - corner[:3]).max(axis=1).min() < 1e-9
    assert text == (
        "2 poses have angles of more than 2.5π, read as radians, as by Gazebo; if they are degrees, write "
        '<pose degrees="true"> (world/model[a]/pose, world/model[b]/link[link]/collision[c]/pose)'
    )


def test_laser_retro_above_255_reflects_all_and_warns_once(tmp_path):
    shapes = shape("<laser_retro>1150</laser_retro>") + shape("<laser_retro>500</laser_retro>", "d")
    scene, texts = read_warned(tmp_path, model(link(shape=shapes)) + model(link(), "other"))
    assert [body.reflectivity for body in scene.bodies] == [1.0, 1.0]
    assert texts == ["<laser_retro> is more than 255 in 1 of 2 bodies (m); their reflectivity is taken as 1"]


@pytest.mark.parametrize(
    ("values", "shown"),
    [
        ((0.8, 0.3, 0.3), "0.3, 0.8"),
        ((0, 1), "0, 1"),
        (("1e-3", None, 0.25), "0.001, 0.25"),
        ((0, 0), None),
        ((0.8, 1.01), None),
        ((None,), None),
    ],
)
def test_a_file_whose_laser_retro_are_shares_of_one_warns_once(tmp_path, values, shown):
    """Meant as reflectivities they are taken as 1/255 of these. What an image overrides says nothing."""
    retro = ["" if value is None else f"<laser_retro>{value}</laser_retro>" for value in values]
    inner = "".join(model(link(shape=shape(text)), f"m{k}") for k, text in enumerate(retro))
    texts = [text for text in read_warned(tmp_path, inner)[1] if "no <laser_retro> in" not in text]
    assert texts == [
        f"no <laser_retro> is more than 1 (got {shown}), where 255 stands for a reflectivity of 1; multiply "
        "them by 255 if they are reflectivities"
    ] * (shown is not None)


def test_warnings_name_the_shapes_where_other_shapes_of_the_link_are_without_fault(tmp_path):
    sheet = shape("", "water_plane", geometry=SHEET)
    shapes = shape(RETRO, "good") + shape("", "bare") + shape("", "too", "visual") + sheet
    shapes += "".join(shape(f"<laser_retro>{n}</laser_retro>", f"shiny_{n}") for n in (1150, 500))
    _, texts = read_warned(tmp_path, model(link(shape=shapes), "rov") + model(link(shape=shape()), "rock"))
    assert texts == [
        "water and marks are no bodies, and are left out (rov::link/collision[water_plane]); "
        "the water's surface is taken from its shape, z = 0 m",
        "no <laser_retro> in 2 of 2 bodies (rov/collision[bare], rock); their reflectivity is taken as 0.5",
        "<laser_retro> is more than 255 in 1 of 2 bodies (rov/collision[shiny_1150], rov/collision[shiny_500]); "
        "their reflectivity is taken as 1",
    ]


def test_submeshes_are_found_without_prefix_and_in_any_case(tmp_path, read):
    parts = {"geom-Steering_Wheel": (1, 1, 1), "geom-Wheel": (2, 2, 2), "Wheel": (3, 3, 3)}
    scene = trimesh.Scene({name: trimesh.creation.box(size) for name, size in parts.items()})
    (tmp_path / "car.glb").write_bytes(scene.export(file_type="glb"))

    def size(name):
        mesh = f"<mesh><uri>car.glb</uri><submesh><name>{name}</name></submesh></mesh>"
        (body,) = read(model_of(mesh)).bodies
        return np.ptp(body.surface.vertices, axis=0).max()

    assert [size(name) for name in ("Steering_Wheel", "steering_wheel", "Wheel")] == [1, 1, 3]
    assert size("geom-wheel") == 2
    with pytest.raises(Error, match="no submesh 'teering_Wheel'"):
        size("teering_Wheel")


def test_an_angle_a_little_over_a_turn(read):
    (body,) = read(model("<pose>0 0 0 0 0 6.597345</pose>" + link())).bodies
    np.testing.assert_allclose(body.pose, pose(yaw=6.597345 - 2 * np.pi), rtol=0, atol=ROUNDING)


def test_the_root_may_hold_includes_and_lights(tmp_path, read):
    add_model(tmp_path, "rock", model(link(), "rock"))
    scene = read("<include><uri>model://rock</uri></include><light name='l'/>", world=False)
    assert [body.name for body in scene.bodies] == ["rock"]
    assert read("<light name='sun'/>", world=False).bodies == ()


def test_a_uri_with_three_slashes(tmp_path, read):
    add_model(tmp_path, "rock", model(link(), "rock"))
    assert [body.name for body in read("<include><uri>model:///rock</uri></include>").bodies] == ["rock"]


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


def test_skip_missing_leaves_out_unknown_shapes(tmp_path):
    shapes = (
        shape(RETRO, geometry="<geometry><torus/></geometry>") + "<collision name='d'/>" + shape(RETRO, "e")
    )
    scene, (text,) = read_warned(tmp_path, model(link(shape=shapes)), skip_missing=True)
    assert text.startswith("read without shapes that cannot be read (")
    assert "collision[c]/geometry/torus: unknown geometry" in text
    assert "collision[d]: must hold a <geom" in text
    np.testing.assert_array_equal(np.ptp(scene.bodies[0].surface.vertices, axis=0), (2, 4, 6))


def test_skip_missing_leaves_out_files_that_cannot_be_read(tmp_path):
    """As in a download that was cut short. What is wrong with each file is said once, however often it is named."""
    (tmp_path / "empty.stl").write_text("")
    (tmp_path / "points.ply").write_bytes(trimesh.PointCloud([[0, 0, 0], [1, 1, 1]]).export(file_type="ply"))
    (tmp_path / "low.png").write_text("no picture")
    mesh = "<geometry><mesh><uri>{}</uri></mesh></geometry>"
    field = "<geometry><heightmap><uri>low.png</uri></heightmap></geometry>"
    geometries = mesh.format("empty.stl"), mesh.format("points.ply"), field, mesh.format("empty.stl")
    shapes = "".join(shape(RETRO, f"n{k}", geometry=one) for k, one in enumerate(geometries))
    path = write(tmp_path / "a.sdf", model(link(shape=shapes + shape(RETRO, "last"))))
    found = [
        f"collision[n0]/geometry/mesh: {tmp_path}/empty.stl: must not be empty (got a file of 0 bytes)",
        f"collision[n1]/geometry/mesh: {tmp_path}/points.ply: a mesh must have at least one face",
        f"collision[n2]/geometry/heightmap: {tmp_path}/low.png: ",
    ]
    with pytest.raises(Error) as caught:
        read_sdf(path)
    lines = str(caught.value).splitlines()
    assert len(lines) == 4 and all(one in line for one, line in zip(found, lines, strict=False))
    assert str(caught.value).endswith(SKIPPABLE)
    with pytest.warns(UserWarning) as caught:
        (body,) = read_sdf(path, skip_missing=True).bodies
    (text,) = (str(w.message) for w in caught)
    assert text.startswith(f"{path}: read without shapes that cannot be read (")
    assert all(text.count(one) == 1 for one in found) and text.count("empty.stl") == 1
    np.testing.assert_array_equal(np.ptp(body.surface.vertices, axis=0), (2, 4, 6))


def test_a_shape_of_water_that_is_unknown_or_missing_is_named_once(tmp_path):
    """The height of water needs the geometry a second time."""
    torus = shape(RETRO, "water", geometry="<geometry><torus/></geometry>")
    field = "<geometry><heightmap><uri>model://sea/a.png</uri></heightmap></geometry>"
    inside = link(shape=torus + shape(RETRO, "waves", geometry=field))
    with pytest.raises(Error) as caught:
        read_sdf(write(tmp_path / "a.sdf", model(inside, "tank")))
    text = str(caught.value)
    assert text.count("collision[water]/geometry/torus: unknown geometry") == 1
    assert text.count("collision[waves]/geometry/heightmap/uri") == 1


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
def test_models_of_fuel_are_read_from_gazebos_cache(tmp_path, read, uri, size, cache):
    """The newest version, unless the URI names one that is there."""
    for version in (2, 12):
        kept = tmp_path / cache / "fuel.gazebosim.org" / "openrobotics" / "models" / "big rock" / str(version)
        add_fuel_model(kept, version)
    (body,) = read(f"<include><uri>{uri}</uri></include>").bodies
    assert np.ptp(body.surface.vertices[:, 0]) == size


@pytest.mark.parametrize("name", ["Big Rock", "big rock", "Big_Rock", "big_rock"])
def test_models_of_fuel_are_read_from_the_resource_paths(tmp_path, read, name):
    """As the message about a missing one says."""
    add_fuel_model(tmp_path / "models" / name, 3)
    (body,) = read(f"<include><uri>{FUEL}</uri></include>", resource_paths=[tmp_path / "models"]).bodies
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


def test_a_file_of_a_model_of_fuel(tmp_path, read):
    kept = tmp_path / "gz" / "fuel.gazebosim.org" / "openrobotics" / "models" / "big rock" / "1"
    kept.mkdir(parents=True)
    trimesh.creation.box((5, 1, 1)).export(kept / "rock.stl")
    (body,) = read(model_of(f"<mesh><uri>{FUEL}/1/files/rock.stl</uri></mesh>")).bodies
    assert np.ptp(body.surface.vertices[:, 0]) == 5


def test_a_uri_of_fuel_does_not_lead_out_of_the_model(tmp_path_factory, message, monkeypatch):
    cache = tmp_path_factory.mktemp("cache")
    monkeypatch.setenv("GZ_FUEL_CACHE_PATH", str(cache))
    kept = cache / "fuel.gazebosim.org" / "openrobotics" / "models" / "big rock" / "1"
    kept.mkdir(parents=True)
    trimesh.creation.box((5, 1, 1)).export(cache / "secret.stl")
    mesh = f"<mesh><uri>{FUEL}/1/files/../../../../../secret.stl</uri></mesh>"
    assert message(model_of(mesh)).startswith("a.sdf: models or files are missing")


# ---- water and marks ---------------------------------------------------------------------------------

SHEET = "<geometry><box><size>400 300 0.1</size></box></geometry>"
WALL = "<geometry><box><size>400 0.1 70</size></box></geometry>"


def visual(name, geometry=SHEET, material="", z=0.0):
    script = f"<material><script><name>{material}</name></script></material>" if material else ""
    return f"<visual name='{name}'><pose>0 0 {z} 0 0 0</pose>{geometry}{script}</visual>"


@pytest.mark.parametrize(
    ("inside", "name"),
    [
        (model(link(shape=visual("surface", material="UUVSimulator/StaticWater", z=3))), "m::link"),
        (model(link(shape=visual("above", material="Any/SimpleWaves", z=3))), "m::link"),
        (model(link(shape=visual("visual", z=3)), "sea_surface"), "sea_surface::link"),
        (model(link(shape=visual("visual", z=3), name="ocean_link"), "wreck"), "wreck::ocean_link"),
        (model(link(shape=visual("water_plane", z=3))), "m::link"),
        (model(link(shape=visual("wave_visual", z=3))), "m::link"),
        (model(link(shape=visual("visual", z=3)), "Coast Waves"), "Coast Waves::link"),
        (
            model(link(shape=f"<pose>0 0 3 0 0 0</pose>{shape('', geometry=SHEET)}"), "water_surface"),
            "water_surface::link",
        ),
    ],
)
def test_water_is_no_wall(tmp_path, inside, name):
    """The naive reader makes it a body of reflectivity 0.5, and a sonar that looks up finds nothing else."""
    scene, texts = read_warned(tmp_path, inside + model(link(), "rock"))
    assert [body.name for body in scene.bodies] == ["rock"]
    assert scene.surface_z_m == 3.0
    assert texts == [
        f"water and marks are no bodies, and are left out ({name}); "
        "the water's surface is taken from its shape, z = 3 m"
    ]


def test_walls_of_water_have_no_surface_and_floors_stay(tmp_path):
    walls = "".join(visual(side, WALL, "UUVSimulator/SeaWall", -35) for side in ("north", "south"))
    ocean = model(
        link(shape=visual("surface", material="A/DeepWater", z=-1) + walls, name="ocean_link")
        + link(name="seabed"),
        "wreck",
    )
    floor = model(link(shape=shape(RETRO, "seafloor"), name="ocean_link"), "ocean")
    scene, texts = read_warned(tmp_path, ocean + floor)
    assert [body.name for body in scene.bodies] == ["wreck", "ocean"] and scene.surface_z_m == -1.0
    assert len(texts) == 1 and "(wreck::ocean_link)" in texts[0]


def test_the_surface_of_a_volume_is_its_top_and_of_a_mesh_its_origin(tmp_path):
    volume = "<geometry><box><size>40 30 8</size></box></geometry>"
    scene, _ = read_warned(tmp_path, model(link(shape=visual("water", volume, z=-3)), "tank"))
    assert scene.surface_z_m == 1.0
    mesh = "<geometry><mesh><uri>file://Media/models/sea_surface.dae</uri></mesh></geometry>"
    scene, texts = read_warned(
        tmp_path, model(link(shape=visual("ocean_surface", mesh, z=2)) + link(name="rock"))
    )
    assert scene.surface_z_m == 2.0 and len(texts) == 1  # the mesh is not missing


def test_the_files_own_surface_wins(tmp_path):
    text = (
        "<sonar_gl:surface>7</sonar_gl:surface>" + model(link(shape=visual("water")), "sea") + model(link())
    )
    scene, texts = read_warned(tmp_path, text)
    assert scene.surface_z_m == 7.0
    assert texts == ["water and marks are no bodies, and are left out (sea::link)"]


def test_the_surface_of_a_model_with_a_floor_is_told(tmp_path):
    """Its collision is the floor, and its visuals make no bodies."""
    scene, texts = read_warned(
        tmp_path,
        model(link(shape=SHAPE + visual("top", material="UUVSimulator/StaticDeepWater")), "ocean_box"),
    )
    assert [body.name for body in scene.bodies] == ["ocean_box"] and scene.surface_z_m == 0.0
    assert texts == ["the water's surface is taken from its shape, z = 0 m"]


@pytest.mark.parametrize("name", ["world_ned", "axes", "ned_frame", "origin", "map_frame"])
def test_marks_are_left_out(tmp_path, name):
    axis = visual("N", "<geometry><cylinder><radius>0.01</radius><length>1</length></cylinder></geometry>")
    scene, texts = read_warned(tmp_path, model(link(shape=axis), name) + model(link()))
    assert [body.name for body in scene.bodies] == ["m"] and scene.surface_z_m is None
    assert texts == [f"water and marks are no bodies, and are left out ({name}::link)"]


@pytest.mark.parametrize(("transparency", "is_left_out"), [("1.0", True), ("0.9", False), ("all", False)])
def test_invisible_visuals_are_left_out(tmp_path, transparency, is_left_out):
    """Worlds of Gazebo put one above the sea's floor, 300 km wide."""
    seen = visual("v").replace("</visual>", f"<transparency>{transparency}</transparency></visual>")
    scene, texts = read_warned(tmp_path, model(link(shape=seen), "plane") + model(link(shape=SHAPE + seen)))
    assert [body.name for body in scene.bodies] == (["m"] if is_left_out else ["plane", "m"])
    assert (
        len(texts) == 1 and ("marks are no bodies, and are left out (plane::link)" in texts[0]) == is_left_out
    )


def test_an_invisible_visual_with_which_things_collide_is_no_mark(tmp_path):
    """Its link has the echo of its visuals, as one of them says how it echoes and the collision does not."""
    seen = visual("v").replace("</visual>", f"{RETRO}</visual>")
    unseen = visual("w", z=1.0).replace("</visual>", "<transparency>1</transparency></visual>")
    scene, _ = read_warned(tmp_path, model(link(shape=shape() + seen + unseen)))
    assert scene.bodies[0].surface.vertices[:, 2].max() == pytest.approx(1.05, rel=ROUNDING)


@pytest.mark.parametrize(
    ("name", "inside"),
    [
        ("water_tower", link(shape=visual("visual"))),
        ("frame", link()),  # which things collide with
        ("world_ned", link("<inertial><mass>1</mass></inertial>", shape=visual("visual"))),
        ("sea_bottom", link(shape=visual("visual"))),
        ("ocean", link(shape=shape(RETRO, "seafloor"))),
        ("lake", link(shape=shape(RETRO, "lake_bottom"), name="lake_link")),
        ("wave_glider", link(shape=visual("visual"))),
        ("breakwater waves wall", link(shape=visual("visual"))),
        (
            "sea_surface",
            link(shape=visual("ice").replace("</visual>", f"{RETRO}</visual>")),
        ),  # says how it echoes
    ],
)
def test_what_is_neither_water_nor_mark_stays(tmp_path, name, inside):
    scene, _ = read_warned(tmp_path, model(inside, name))
    assert [body.name for body in scene.bodies] == [name]


# ---- errors ------------------------------------------------------------------------------------------

SKIPPABLE = "\nCarry on without them (--skip-missing, skip_missing=True)."
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


def test_an_included_file_must_not_declare_a_document_type(tmp_path, message):
    (tmp_path / "rock").mkdir()
    (tmp_path / "rock" / "model.sdf").write_text("<!DOCTYPE sdf><sdf/>")
    assert message("<include><uri>model://rock</uri></include>") == f"rock/model.sdf: {REFUSED}"


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


MERGED = (
    "<frame name='foot'><pose>0 0 -3 0 0 0</pose></frame>"
    f"<link name='arm'><pose>0 1 0 0 0 0</pose>{SHAPE}</link>"
    f"<link name='hand'><pose relative_to='__model__'>0 2 0 0 0 0</pose>{SHAPE}</link>"
    "<joint name='wrist'><child>hand</child></joint>"
    f"<model name='tool'><pose relative_to='hand'>0 0 1 0 0 0</pose><link name='link'>{SHAPE}</link></model>"
)
MERGE = "<include merge='true'><uri>model://arms</uri>{}</include>"


def places(scene):
    return {body.name: body.pose[:3, 3].tolist() for body in scene.bodies}


@pytest.mark.parametrize(
    ("inside", "x", "z"),
    [("", 0, 0), ("<pose>1 0 0 0 0 0</pose>", 1, 0), ("<placement_frame>foot</placement_frame>", 0, 3)],
)
@pytest.mark.parametrize("comes_first", [True, False])
def test_a_merged_include_becomes_a_part_of_the_model(tmp_path, read, inside, x, z, comes_first):
    add_model(tmp_path, "arms", model(MERGED, "arms"))
    parts = [
        "<pose>10 0 0 0 0 0</pose>",
        link("<pose relative_to='hand'>0 0 7 0 0 0</pose>", "held"),
        "<frame name='grip' attached_to='wrist'><pose>0 0 4 0 0 0</pose></frame>",
        model("<pose relative_to='grip'/>" + link(), "gripped"),
        "<model name='held_too'><pose relative_to='tool::link'/>" + link() + "</model>",
    ]
    parts.insert(1 if comes_first else 5, MERGE.format(inside))
    assert places(read(model("".join(parts), "rov"))) == {
        "rov::arm": [10 + x, 1, z],
        "rov::hand": [10 + x, 2, z],
        "rov::tool": [10 + x, 2, z + 1],
        "rov::held": [10 + x, 2, z + 7],
        "rov::gripped": [10 + x, 2, z + 4],
        "rov::held_too": [10 + x, 2, z + 1],
    }


def test_a_model_that_is_merged_twice_is_refused(tmp_path, read):
    add_model(tmp_path, "arms", model(MERGED, "arms"))
    with pytest.raises(sg.Error, match=r"model 'arms' must be merged once \(got it twice"):
        read(model(2 * MERGE.format(""), "rov"))


def test_what_a_merged_include_names_lies_beside_it(tmp_path, read):
    """Files are found in the folder of the included model; a single link makes the body of the outer one."""
    add_model(tmp_path / "far", "arms", model_of("<mesh><uri>a.stl</uri></mesh>", "arms"))
    trimesh.creation.box((2, 2, 2)).export(tmp_path / "far" / "arms" / "a.stl")
    uri = "<uri>far/arms</uri>"
    merge = f"<include merge='1'>{uri}<pose>0 0 5 0 0 0</pose></include>"
    scene = read(model(f"<pose>10 0 0 0 0 0</pose>{merge}", "rov"))
    assert places(scene) == {"rov": [10, 0, 0]}
    np.testing.assert_array_equal(scene.bodies[0].mesh.bounds, [[-1, -1, 4], [1, 1, 6]])


def test_merged_includes_of_merged_includes_and_of_worlds(tmp_path, read):
    add_model(tmp_path, "arms", model(MERGED, "arms"))
    add_model(tmp_path, "upper", model(MERGE.format("<pose>0 0 1 0 0 0</pose>"), "upper"))
    merge = MERGE.replace("arms", "upper").format("<pose>0 0 2 0 0 0</pose>")
    scene = read(model(merge + link("<pose relative_to='hand'>0 1 0 0 0 0</pose>", "held"), "rov"))
    assert places(scene)["rov::hand"] == [0, 2, 3] and places(scene)["rov::held"] == [0, 3, 3]
    add_model(tmp_path, "yard", model(model(link(), "left") + model(link(), "right"), "yard"))
    merge = MERGE.replace("arms", "yard").format("<pose>0 0 2 0 0 0</pose>")
    assert places(read(merge)) == {"left": [0, 0, 2], "right": [0, 0, 2]}


@pytest.mark.parametrize("comes_first", [True, False])
def test_a_merged_include_must_bring_new_names(tmp_path, message, comes_first):
    add_model(tmp_path, "arms", model(MERGED, "arms"))
    parts = [MERGE.format(""), link(name="hand")]
    place = "link[hand]" if comes_first else "include[model://arms]"
    assert message(model("".join(parts if comes_first else parts[::-1]), "rov")) == (
        f"a.sdf: world/model[rov]/{place}: names must be unique (got 'hand' twice)"
    )


def test_a_merged_include_must_not_lie_in_a_frame_of_its_own(tmp_path, message):
    add_model(tmp_path, "arms", model(MERGED, "arms"))
    assert message(model(MERGE.format("<pose relative_to='hand'/>"), "rov")) == (
        "a.sdf: world/model[rov]/include[model://arms]/pose: frames must lead to the model or world "
        "(got _merged__arms__model__ -> _merged__arms__model__ ...)"
    )


def test_links_are_not_merged_into_a_world(tmp_path, message):
    add_model(tmp_path, "arms", model(MERGED, "arms"))
    assert message(MERGE.format("")) == (
        'a.sdf: world/include[model://arms]: a world holds models, no links (got merge="true" of a model with '
        "link 'arm'; leave merge out)"
    )


def test_include_cycles(tmp_path, message):
    add_model(tmp_path, "a", model("<include><uri>model://b</uri></include>", "a"))
    add_model(tmp_path, "b", model("<include><uri>model://a</uri></include>", "b"))
    assert message("<include><uri>model://a</uri></include>") == (
        "b/model.sdf: model[b]/include[model://a]: a model must not include itself "
        "(got a/model.sdf -> b/model.sdf -> a/model.sdf)"
    )


def test_deep_nesting_and_bombs_of_includes(tmp_path, message, monkeypatch):
    nested = link()
    for i in range(40):
        nested = model(nested, f"m{i}")
    assert message(nested).endswith(": a scene must hold at most 65535 models, at most 32 deep")
    monkeypatch.setattr(reader, "MAX_MODELS", 50)
    for i in range(8):  # doubles at every level
        twice = "".join(f"<include><uri>model://b{i + 1}</uri><name>{n}</name></include>" for n in "xy")
        add_model(tmp_path, f"b{i}", model(twice if i < 7 else link(), f"b{i}"))
    assert message("<include><uri>model://b0</uri></include>").endswith(
        ": a scene must hold at most 50 models, at most 32 deep"
    )


@pytest.mark.parametrize(
    ("inside", "expected"),
    [
        (
            model("<pose>1 2 3</pose>" + link()),
            "world/model[m]/pose: must be 6 finite numbers (got '1 2 3')",
        ),
        (
            model("<pose>0 0 0 0 0 nan</pose>" + link()),
            "world/model[m]/pose: must be 6 finite numbers (got '0 0 0 0 0 nan')",
        ),
        (
            model("<pose rotation_format='quat_wxyz'>0 0 0 1 0 0 0</pose>" + link()),
            "world/model[m]/pose: rotation_format must be 'euler_rpy' or 'quat_xyzw' (got 'quat_wxyz')",
        ),
        (
            model(link(shape=shape(geometry="<geometry><box size='2 4 6'/></geometry>"))),
            "world/model[m]/link[link]/collision[c]/geometry/box: 'size' must be an element (got an attribute, as in "
            "SDF 1.2; write <size>2 4 6</size>)",
        ),
        (
            model("<pose rotation_format='quat_xyzw'>0 0 0 0 0 0 0</pose>" + link()),
            "world/model[m]/pose: a quaternion must not be zero (got '0 0 0 0 0 0 0')",
        ),
        (
            model(link("<pose relative_to='lnk2'/>") + link(name="link2")),
            "world/model[m]/link[link]/pose: unknown frame 'lnk2' (did you mean 'link2' or 'link'?)",
        ),
        (
            model(link("<pose relative_to='b'/>", "a") + link("<pose relative_to='a'/>", "b")),
            "world/model[m]/link[b]/pose: frames must lead to the model or world (got a -> b -> a ...)",
        ),
        (model(link()) * 2, "world/model[m]: names must be unique (got 'm' twice)"),
        (model(link() * 2), "world/model[m]/link[link]: names must be unique (got 'link' twice)"),
        (
            model(link()) + "<include><uri>model://ground_plane</uri><name>m</name></include>",
            "world/include[m]: names must be unique (got 'm' twice)",
        ),
        ("<model/>", "world/model[]: must have a name"),
        ("<include/>", "world/include[]: must name a file or a model (got '')"),
        (
            model(link(shape="<collision name='c'/>")),
            "world/model[m]/link[link]/collision[c]: must hold a <geometry> with a shape in it" + SKIPPABLE,
        ),
        (
            model(link(shape=SHAPE.replace("2 4 6", "2 -4 6"))),
            "world/model[m]/link[link]/collision[c]/geometry/box/size: "
            "must be 3 finite positive numbers (got '2 -4 6')",
        ),
        (
            model(link(shape=shape(geometry="<geometry><sphere><radius>0</radius></sphere></geometry>"))),
            "world/model[m]/link[link]/collision[c]/geometry/sphere/radius: "
            "must be 1 finite positive number (got '0')",
        ),
        (
            model(link(shape=shape(geometry="<geometry><sphere><radius/></sphere></geometry>"))),
            "world/model[m]/link[link]/collision[c]/geometry/sphere/radius: "
            "must be 1 finite positive number (got '')",
        ),
        (
            model(link(shape=shape(geometry="<geometry><torus/></geometry>"))),
            "world/model[m]/link[link]/collision[c]/geometry/torus: unknown geometry (known are box, capsule, "
            "cone, cylinder, ellipsoid, heightmap, mesh, plane, polyline, sphere; anything can be a mesh)"
            + SKIPPABLE,
        ),
        (
            model(link(shape=SHAPE.replace("255", "-1"))),
            "world/model[m]/link[link]/collision[c]/laser_retro: must lie in 0..100000 (got -1)",
        ),
        (
            model(link(shape=SHAPE.replace("255", "bright"))),
            "world/model[m]/link[link]/collision[c]/laser_retro: must be 1 finite number (got 'bright')",
        ),
        (
            model(
                link(shape=SHAPE.replace("<geometry>", "<pose degrees='false'>1 2 3 4 5 x</pose><geometry>"))
            ),
            "world/model[m]/link[link]/collision[c]/pose: must be 6 finite numbers (got '1 2 3 4 5 x')",
        ),
    ],
)
def test_messages_name_file_and_element(message, inside, expected):
    assert message(inside) == f"a.sdf: {expected}"


def test_messages_of_a_bare_model_and_of_an_included_file(tmp_path, message):
    bad = link("<pose>1</pose>")
    assert message(model(bad), world=False) == (
        "a.sdf: model[m]/link[link]/pose: must be 6 finite numbers (got '1')"
    )
    add_model(tmp_path, "rock", model(bad, "rock"))
    assert message("<include><uri>model://rock</uri><name>r</name></include>") == (
        "rock/model.sdf: model[r]/link[link]/pose: must be 6 finite numbers (got '1')"
    )


def test_a_mesh_scaled_by_zero_is_refused(tmp_path, message):
    (tmp_path / "b.stl").write_text("")
    mesh = "<geometry><mesh><uri>b.stl</uri><scale>1 0 1</scale></mesh></geometry>"
    assert message(model(link(shape=shape(geometry=mesh)))) == (
        "a.sdf: world/model[m]/link[link]/collision[c]/geometry/mesh/scale: must not be zero (got '1 0 1')"
    )


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("<sdf>\n  <world>\n</sdf>", "line 3, column 3: broken XML (mismatched tag)"),
        (" ", "line 1, column 2: broken XML (no element found)"),
        ("", "must not be empty (got a file of 0 bytes)"),
        (
            "<sdf><a b=c/></sdf>",
            "line 1, column 11: broken XML (not well-formed (invalid token); attribute values need quotes: 'b=c')",
        ),
        ("<sdf><a b='c<'/></sdf>", "line 1, column 13: broken XML (not well-formed (invalid token))"),
        ("<sdf>&nothing;</sdf>", "line 1, column 6: broken XML (undefined entity)"),
        ("<scene/>", "the root element must be <sdf>, or <robot> of URDF (got <scene>)"),
        (
            "<COLLADA xmlns='http://www.collada.org/2005/11/COLLADASchema'/>",
            "the root element must be <sdf>, or <robot> of URDF (got <COLLADA>; this is a mesh: name it .dae)",
        ),
        (
            "<sdf xmlns='a\nb'><a b='c<'/></sdf>",
            "line 2, column 11: broken XML (not well-formed (invalid token))",
        ),
        ("<sdf/>", "must hold a <world> or a <model>"),
    ],
)
def test_files_other_than_sdf(tmp_path, text, expected):
    path = tmp_path / "a.sdf"
    path.write_text(text)
    assert error_of(read_sdf, path) == f"{path}: {expected}"


def test_a_missing_scene_file(tmp_path):
    assert error_of(read_sdf, tmp_path / "no.sdf") == f"{tmp_path / 'no.sdf'}: No such file or directory"


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


def test_names_too_long_for_a_file(message):
    long = "x" * 5000
    assert message(f"<include><uri>model://{long}</uri></include>").startswith("a.sdf: ")


def test_a_long_chain_of_frames_is_an_error():
    scope = frames.Scope("a.sdf: world", None, is_world=True)
    for i in range(5000):
        scope.add(f"f{i}", frames.Frame(None, f"a.sdf: world/frame[f{i}]", f"f{i + 1}"))
    with pytest.raises(Error, match=r"frames must lead to the model or world \(got f0 -> f1 "):
        scope.find("f0", "a.sdf: world")


# ---- extensions --------------------------------------------------------------------------------------


DECLARED = "xmlns:sonar_gl='http://example.org/anything'"


@pytest.mark.parametrize("kind", ["collision", "visual"])
@pytest.mark.parametrize("declared", ["", DECLARED])
def test_material_with_and_without_declared_prefix(tmp_path, kind, declared):
    """There is no warning of a missing <laser_retro>. Gazebo reads both files."""
    inside = model(link(shape=shape("<sonar_gl:material>Steel</sonar_gl:material>", kind=kind)))
    path = tmp_path / "a.sdf"
    path.write_text(f"<sdf version='1.9' {declared}><world name='w'>{inside}</world></sdf>")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        (body,) = read_sdf(path).bodies
    steel = material("steel")
    assert (body.reflectivity, body.specular, body.material) == (steel.reflectivity, steel.specular, "steel")
    assert body.roughness_rad == steel.roughness_rad


def test_a_prefix_declared_on_its_own_element(tmp_path):
    own = f"<sonar_gl:material {DECLARED}>rock</sonar_gl:material>"
    path = write(tmp_path / "a.sdf", model(link(shape=shape(own))))
    assert read_sdf(path).bodies[0].material == "rock"


def test_single_properties_override_the_material(read):
    tags = (
        "<sonar_gl:material>steel</sonar_gl:material><laser_retro>51</laser_retro>"
        "<sonar_gl:specular>0.25</sonar_gl:specular><sonar_gl:roughness>0.3</sonar_gl:roughness>"
    )
    (body,) = read(model(link(shape=shape(tags)))).bodies
    assert (body.reflectivity, body.specular, body.roughness_rad) == (0.2, 0.25, 0.3)
    assert body.material == "steel"


def test_extensions_in_visuals_alone_make_visuals_the_body(read):
    both = shape("", "a") + shape("<sonar_gl:material>rock</sonar_gl:material>", "b", "visual", BALL)
    (body,) = read(model(link(shape=both))).bodies
    assert body.material == "rock"
    assert len(body.surface.faces) > 12


def test_shapes_with_other_lobes_are_separate_bodies(read):
    steel, rock = (f"<sonar_gl:material>{name}</sonar_gl:material>" for name in ("steel", "rock"))
    shapes = shape(steel, "a") + shape(rock, "b", geometry=BALL) + shape(RETRO, "c") + shape(steel, "d")
    bodies = read(model(link(shape=shapes))).bodies
    assert [(one.name, one.material) for one in bodies] == [("m", "steel"), ("m::b", None)]
    assert len(bodies[0].surface.faces) == 24
    # neither rock nor <laser_retro> has a lobe, so they are one body, with one reflectivity per face
    assert bodies[1].specular == 0
    assert sorted(set(bodies[1].reflectivity)) == [material("rock").reflectivity, 1.0]


def test_a_reflectivity_map_is_applied_from_above(read, tmp_path):
    image = np.array([[255, 0], [51, 102]], np.uint8)
    cv2.imwrite(str(tmp_path / "map.png"), image)
    plane = "<geometry><plane><normal>0 0 1</normal><size>4 4</size></plane></geometry>"
    image_tag = "<sonar_gl:reflectivity_map>map.png</sonar_gl:reflectivity_map>"
    (body,) = read(
        model(link("<pose>10 0 0 0 0 0</pose>", shape=shape(image_tag, "c", "visual", plane)))
    ).bodies
    x, y, _ = body.surface.vertices[body.surface.faces].mean(axis=1).T
    # first row at the highest y, first column at the lowest x, as in a height map
    np.testing.assert_allclose(
        body.reflectivity, image[(y < 0).astype(int), (x > 10).astype(int)] / 255, rtol=ROUNDING
    )
    np.testing.assert_array_equal(body.pose, np.eye(4))


def test_a_shape_with_a_map_beside_one_without(read, tmp_path):
    cv2.imwrite(str(tmp_path / "map.png"), np.array([[255, 0]], np.uint8))
    image_tag = "<sonar_gl:reflectivity_map>map.png</sonar_gl:reflectivity_map>"
    shapes = shape(image_tag, "a", geometry=BALL) + shape("<laser_retro>51</laser_retro>", "b")
    (body,) = read(model(link(shape=shapes))).bodies
    assert len(body.reflectivity) == len(body.surface.faces)
    assert (body.reflectivity[-12:] == 0.2).all()
    assert {0.0, 1.0} <= set(body.reflectivity[:-12])


@pytest.mark.parametrize(
    ("tags", "words"),
    [
        (
            "<sonar_gl:material>steal</sonar_gl:material>",
            "/sonar_gl:material: unknown material (got 'steal'; ",
        ),
        ("<sonar_gl:material/>", "/sonar_gl:material: unknown material (got ''; known are "),
        (
            "<sonar_gl:matter>x</sonar_gl:matter>",
            ": unknown tag (got 'sonar_gl:matter'; did you mean 'material'",
        ),
        ("<sonar_gl:specular>2</sonar_gl:specular>", "/sonar_gl:specular: must lie in 0..1 (got 2)"),
        ("<sonar_gl:specular>a</sonar_gl:specular>", "/sonar_gl:specular: must be 1 finite number (got 'a')"),
        ("<sonar_gl:roughness>9</sonar_gl:roughness>", "/sonar_gl:roughness: must lie in 0.01..0.5 (got 9)"),
        (
            "<sonar_gl:reflectivity_map>a.sdf</sonar_gl:reflectivity_map>",
            "/sonar_gl:reflectivity_map: a.sdf: a reflectivity map must be an image that OpenCV reads",
        ),
        ("<sonar_gl:reflectivity_map>b.png</sonar_gl:reflectivity_map>", "models or files are missing:"),
        ("<sonar_gl:reflectivity_map/>", "/sonar_gl:reflectivity_map: must name a file or a model (got '')"),
    ],
)
def test_invalid_extensions(message, tags, words):
    text = message(model(link(shape=shape(tags))))
    assert words in text
    assert "models or files" in words or "world/model[m]/link[link]/collision[c]" in text


def test_a_map_on_an_infinite_plane_is_refused(message):
    image_tag = "<sonar_gl:reflectivity_map>map.png</sonar_gl:reflectivity_map>"
    plane = "<geometry><plane><normal>0 0 1</normal></plane></geometry>"
    assert "the plane of a collision is infinite" in message(
        model(link(shape=shape(image_tag, geometry=plane)))
    )


@pytest.mark.parametrize(
    ("xml", "why"),
    [
        ("<sdf version='1.9'><gz:y b='1'/>{}</sdf>", "line 1: a prefix is not declared"),
        ("<sdf version='1.9'><y gz:type='1'/>{}</sdf>", "line 1: a prefix is not declared"),
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
    assert [str(w.message) for w in caught] == [
        f"{path}: broken XML, read as Gazebo reads it: {path} ({why})"
    ]
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


def test_extensions_are_found_by_name():
    xml = extensions.declare_namespace(b"<sdf a='1'><sonar_gl:surface/><surface/></sdf>")
    root = ElementTree.fromstring(xml)
    assert extensions.find_extension(root, "surface") is root[0]
    assert extensions.find_extension(root, "floor") is None
    assert extensions.list_extensions(root) == [root[0]]


@pytest.mark.parametrize("scheme", ["", "file://", "model://", "package://parts/"])
def test_names_of_files_may_be_escaped_as_in_uris(tmp_path, read, message, scheme):
    folder = tmp_path / "parts" / "my hülle"
    folder.mkdir(parents=True)
    trimesh.creation.box((2, 4, 6)).export(folder / "50% box.STL")
    prefix = scheme if scheme.startswith("package") else f"{scheme}parts/"

    def mesh(name):
        return model_of(f"<mesh><uri>{prefix}{name}</uri></mesh>")

    for name in ("my hülle/50% box.STL", "my%20h%C3%BClle/50%25%20box.STL"):
        np.testing.assert_array_equal(read(mesh(name)).bodies[0].mesh.extents, (2, 4, 6))
    (tmp_path / "parts" / "%20.stl").write_bytes((folder / "50% box.STL").read_bytes())
    assert len(read(mesh("%20.stl")).bodies) == 1  # a file that has this very name
    (tmp_path.parent / "secret.stl").write_bytes((folder / "50% box.STL").read_bytes())
    if not scheme:
        got = message(mesh("%2E%2E/%2E%2E/secret.stl"))
        assert "must stay in the scene's folder and the resource paths" in got


@pytest.mark.parametrize(
    ("geometry", "tag", "hint"),
    [
        (
            "<cylinder><radius>1</radius><lenght>4</lenght></cylinder>",
            "cylinder/lenght",
            "did you mean 'length'?",
        ),
        ("<sphere><RADIUS>4</RADIUS></sphere>", "sphere/RADIUS", "did you mean 'radius'?"),
        ("<box><sizes>1 2 3</sizes></box>", "box/sizes", "did you mean 'size'?"),
        ("<cylinder><diameter> 4.5 </diameter></cylinder>", "cylinder/diameter", "known are length, radius"),
        ("<box><dimensions>1 2 3</dimensions></box>", "box/dimensions", "known are size"),
        ("<box><x>1</x></box>", "box/x", "known are size"),
    ],
)
def test_an_unknown_tag_of_numbers_in_a_shape_is_told_of(tmp_path, geometry, tag, hint):
    """SDF's default takes the place of the size that it was meant for, a body of another size."""
    _, texts = read_warned(tmp_path, model_of(geometry))
    assert texts == [
        "tags that SDF does not know there are left out: world/model[m]/link[link]/collision[c]/"
        f"geometry/{tag} ({hint})"
    ]


def test_other_tags_of_shapes_give_no_warning(read):
    assert len(read(model_of("<box><size>1 2 3</size><sizes>x</sizes><texture/></box>")).bodies) == 1


A_POSE, ANOTHER_POSE = "<pose>5 0 0 0 0 0</pose>", "<pose>0 7 0 0 0 0</pose>"
POSES, IN_FRAME = A_POSE + ANOTHER_POSE, "<pose relative_to='f'/>"


@pytest.mark.parametrize(
    ("inside", "places"),
    [
        (model(POSES + link()), "world/model[m]/pose"),
        (model(link(POSES)), "world/model[m]/link[link]/pose"),
        (model(link(shape=shape(RETRO + POSES))), "world/model[m]/link[link]/collision[c]/pose"),
        (model(f"<frame name='f'>{POSES}</frame>{link(IN_FRAME)}"), "world/model[m]/frame[f]/pose"),
        (f"<include><uri>model://buoy</uri>{POSES}</include>", "world/include[model://buoy]/pose"),
        (
            f"<include><uri>model://buoy</uri><uri>model://none</uri>{A_POSE}</include>",
            "world/include[model://buoy]/uri",
        ),
        (f"{model(A_POSE + link())}</world><world name='other'>{model(link(), 'n')}", "world[other]"),
        (f"{model(A_POSE + link())}</world>{model(link(), 'n')}<world name='w2'>", "world[w2], model[n]"),
    ],
)  # fmt: skip
def test_where_one_element_may_stand_the_first_is_read_and_others_are_told_of(tmp_path, inside, places):
    add_model(tmp_path, "buoy", model(link(), "buoy"))
    scene, texts = read_warned(tmp_path, inside, tmp_path)
    told = f"where one element may stand, the first is read, and others are left out ({places})"
    assert texts == [told]
    (body,) = scene.bodies
    middle = body.mesh.vertices.mean(axis=0)
    assert (body.pose[:3, 3] + middle).tolist() == [5, 0, 0]


def test_a_second_pose_of_a_sensor_is_told_of(tmp_path):
    sensor = f"<sensor name='sonar' type='custom'>{POSES}</sensor>"
    path = write(tmp_path / "a.sdf", model(link(), "n") + model(f"<link name='l'>{sensor}</link>"))
    with pytest.warns(
        UserWarning, match=r"others are left out \(world/model\[m\]/link\[l\]/sensor\[sonar\]/pose\)$"
    ):
        assert read_sdf(path).sonar_pose[:3, 3].tolist() == [5, 0, 0]


def test_a_second_model_in_the_file_of_a_model_is_told_of(tmp_path):
    file = add_model(tmp_path, "buoy", model(link()) + model(link(), "second")) / "model.sdf"
    path = write(tmp_path / "a.sdf", "<include><uri>model://buoy</uri></include>")
    with pytest.warns(UserWarning) as caught:
        assert [body.name for body in read_sdf(path, [tmp_path]).bodies] == ["m"]
    assert (
        f"{path}: where one element may stand, the first is read, and others are left out ({file}: model[second])"
        in [str(w.message) for w in caught]
    )


@pytest.mark.parametrize(
    ("inside", "told"),
    [
        (model(f"<pos>5 0 0 0 0 0</pos>{link()}"), "world/model[m]/pos (did you mean 'pose'?)"),
        (
            model(link("<origin>5 0 0 0 0 0</origin>")),
            "world/model[m]/link[link]/origin (did you mean 'pose'?)",
        ),
        (
            model(link("<poses>5 0 0 0 0 0</poses>")),
            "world/model[m]/link[link]/poses (did you mean 'pose'?)",
        ),
        (
            model(link(shape=SHAPE.replace("<geometry>", "<POSE>5 0 0 0 0 0</POSE><geometry>"))),
            "world/model[m]/link[link]/collision[c]/POSE (did you mean 'pose'?)",
        ),
        (
            model(link(shape=SHAPE.replace("<geometry>", "<origin>5 0 0 0 0 0</origin><geometry>"))),
            "world/model[m]/link[link]/collision[c]/origin (did you mean 'pose'?)",
        ),
        (
            model(link(shape=SHAPE.replace("collision", "colision"))),
            "world/model[m]/link[link]/colision (did you mean 'collision'?)",
        ),
        (model(link().replace("link", "Link")), "world/model[m]/Link (did you mean 'link'?)"),
        (model(link()).replace("model", "models"), "world/models (did you mean 'model'?)"),
        (model(SHAPE), "world/model[m]/collision[c] (it must be in a link)"),
        (SHAPE, "world/collision[c] (it must be in a link)"),
    ],
)
def test_shapes_out_of_links_and_misspelt_tags_are_told_of(tmp_path, inside, told):
    assert read_warned(tmp_path, inside)[1] == [f"tags that SDF does not know there are left out: {told}"]
