"""Scenes of MuJoCo: bodies, geoms, materials, the sonar, poses in a simulation, and files."""

import subprocess
import sys

import mujoco
import numpy as np
import pytest

import sonar_gl as sg
from sonar_gl.core.errors import Error
from sonar_gl.core.input_files import noted_files
from sonar_gl.core.poses import pose
from sonar_gl.scene.load import load_scene
from sonar_gl.scene.materials import material
from tests.support.loaded_scenes import boxes_of, error_message, load

ROUNDING = 1e-12  # of a few products of float64 matrices
FLOAT32 = 1e-6  # MuJoCo keeps vertices, colours and heights as float32
MODEL = "<mujoco><compiler angle='radian'/>{}<worldbody>{}</worldbody></mujoco>"
ARM = """<geom name="floor" type="plane" size="4 3 1"/>
<body name="arm" pos="1 0 0"><joint name="turn" axis="0 0 1"/><geom type="box" size="1 .1 .2" pos="1 0 0"/>
  <body pos="2 0 0"><joint type="slide"/><geom type="sphere" size=".3"/></body>
</body>"""
CLOTH = """<flexcomp name="cloth" type="grid" dim="2" count="3 3 1" spacing=".1 .1 .1" radius=".01" mass="1">
  <edge equality="true"/></flexcomp>"""


def model_of(bodies, before=""):
    return mujoco.MjModel.from_xml_string(MODEL.format(before, bodies))


# ---- bodies and geoms --------------------------------------------------------------------------------


def test_bodies_and_geoms_of_the_world_are_bodies():
    scene, warned = load(model_of(ARM))
    assert (warned, scene.sonar_pose) == ([], None)
    found = boxes_of(scene)
    assert list(found) == ["floor", "arm", "body_2"]
    np.testing.assert_allclose(found["floor"], [[-4, -3, 0], [4, 3, 0]], rtol=0, atol=ROUNDING)
    np.testing.assert_allclose(found["arm"], [[1, -0.1, -0.2], [3, 0.1, 0.2]], rtol=0, atol=ROUNDING)
    np.testing.assert_allclose(found["body_2"], [[2.7, -0.3, -0.3], [3.3, 0.3, 0.3]], rtol=0, atol=ROUNDING)


@pytest.mark.parametrize(
    "geom, bounds",
    [
        ("type='sphere' size='.5'", [[-0.5] * 3, [0.5] * 3]),
        ("type='ellipsoid' size='.5 1 2'", [[-0.5, -1, -2], [0.5, 1, 2]]),
        ("type='capsule' size='.5 1'", [[-0.5, -0.5, -1.5], [0.5, 0.5, 1.5]]),
        ("type='cylinder' size='.5 1'", [[-0.5, -0.5, -1], [0.5, 0.5, 1]]),
        ("type='box' size='.5 1 2' euler='0 0 1.5707963267948966'", [[-1, -0.5, -2], [1, 0.5, 2]]),
        ("type='plane' size='0 3 1'", [[-11e3, -3, 0], [11e3, 3, 0]]),  # 0: the plane has no end
        ("type='mesh' mesh='wedge' pos='0 0 1'", [[-1, -1, 0], [2, 1, 4]]),
        ("type='hfield' hfield='hill'", [[-2, -1, 0], [2, 1, 0.5]]),
    ],
    ids=lambda value: value.split("'")[1] if isinstance(value, str) else "",
)
def test_every_kind_of_geom(geom, bounds):
    assets = """<asset><mesh name="wedge" vertex="-1 -1 -1  2 -1 -1  -1 1 -1  -1 -1 3"/>
    <hfield name="hill" nrow="2" ncol="3" size="2 1 .5 .1" elevation="0 0 0  0 0 1"/></asset>"""
    scene, _ = load(model_of(f"<geom {geom}/>", assets))
    np.testing.assert_allclose(boxes_of(scene)["geom_0"], bounds, atol=FLOAT32)


def test_a_height_field_agrees_with_the_rays_of_mujoco():
    asset = "<asset><hfield name='h' nrow='3' ncol='3' size='2 1 .5 .1' elevation='0 .5 1  0 0 0  1 0 .2'/></asset>"
    model = model_of("<geom type='hfield' hfield='h' pos='1 2 3' euler='0 0 .5'/>", asset)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    body = load(model)[0].bodies[0]
    points = body.mesh.vertices @ body.pose[:3, :3].T + body.pose[:3, 3]
    middle = points.mean(axis=0)
    for x, y, z in middle + 0.999 * (points - middle):  # off the borders
        distance_m = mujoco.mj_ray(
            model, data, np.array([x, y, 9.0]), np.array([0, 0, -1.0]), None, 1, -1, np.zeros(1, np.int32)
        )
        assert 9 - distance_m == pytest.approx(z, abs=2e-3)  # a thousandth of the way to the middle, steeply


def test_what_the_viewer_does_not_show_is_left_out():
    geoms = "".join(
        f"<geom name='{name}' size='1' {tags}/>"
        for name, tags in (
            ("seen", "group='2'"),
            ("collision", "group='3'"),
            ("clear", "rgba='1 1 1 0'"),
            ("glass", "material='clear'"),
            ("painted", "material='clear' rgba='1 0 0 1'"),
        )
    )
    material_of_glass = "<asset><material name='clear' rgba='1 1 1 0'/></asset>"
    assert list(boxes_of(load(model_of(geoms, material_of_glass))[0])) == ["seen", "painted"]


def test_materials_of_known_names_have_their_acoustics():
    assets = "<asset><material name='Medium-Sand'/><material name='steel'/><material name='grid'/></asset>"
    bodies = """<geom name="floor" type="plane" size="1 1 1" material="Medium-Sand"/>
      <body name="rov"><geom size=".1" material="grid"/><geom name="frame" size=".2" material="steel"/>
      <geom size=".3" material="Medium-Sand"/></body>"""
    with pytest.warns(UserWarning, match=r"no material of a known name in 1 of 3 bodies \(rov\); .* 0.5"):
        scene = load_scene(model_of(bodies, assets))
    floor, rov, frame = scene.bodies
    sand, steel = material("sand"), material("steel")
    assert (floor.name, floor.reflectivity, floor.material) == ("floor", sand.reflectivity, sand.name)
    assert (rov.name, set(rov.reflectivity), rov.specular) == ("rov", {0.5, sand.reflectivity}, 0.0)
    assert (frame.name, frame.material, frame.specular) == ("rov::frame", "steel", steel.specular)


def test_names_without_acoustic_meaning_cost_no_hint(monkeypatch):
    """Hints about the spelling took much of the time in which many bodies are loaded."""
    monkeypatch.setattr("sonar_gl.scene.materials.nearest_names", lambda *_: pytest.fail("a hint is made"))
    scene, _ = load(model_of("<geom size='1' material='grid'/>", "<asset><material name='grid'/></asset>"))
    assert scene.bodies[0].material is None


def test_a_geom_of_the_world_may_have_the_name_of_a_body():
    scene, _ = load(model_of("<geom name='a' size='1'/><body name='a'><geom size='2'/></body>"))
    assert [body.name for body in scene.bodies] == ["world::a", "a"]


# ---- the sonar and the simulation --------------------------------------------------------------------


def test_the_sonar_is_a_site_or_a_camera():
    camera = "<camera name='my_sonar' pos='0 0 1' xyaxes='0 -1 0 0 0 1'/>"  # looks along x
    rov = "<body name='rov' pos='1 2 3' euler='0 0 .5'>{}<geom size='1'/><body><geom size='2'/></body></body>"
    scene, _ = load(model_of(rov.format(camera)))
    np.testing.assert_allclose(
        scene.sonar_pose, pose(1, 2, 3, 0, 0, 0.5) @ pose(0, 0, 1), rtol=0, atol=ROUNDING
    )
    assert [body.name for body in scene.bodies] == ["body_2"]  # the device itself returns no echo
    site = "<site name='FLS' pos='0 1 0' euler='0 .2 0'/>"
    scene, _ = load(model_of(site + rov.format(camera)))
    np.testing.assert_allclose(scene.sonar_pose, pose(0, 1, 0, 0, 0.2, 0), rtol=0, atol=ROUNDING)
    assert [body.name for body in scene.bodies] == ["rov", "body_2"]


def test_poses_follow_the_simulation():
    model = model_of(ARM.replace("<joint", "<site name='sonar' pos='0 0 1'/><joint", 1))
    data = mujoco.MjData(model)
    scene, _ = load(model)
    assert [body.name for body in scene.bodies] == ["floor", "body_2"]
    with pytest.raises(Error, match=r"call mujoco\.mj_forward"):
        sg.mujoco_poses(scene, data)
    data.joint("turn").qpos = 0.5
    data.qvel[:] = 1
    mujoco.mj_forward(model, data)
    before = data.qpos.copy(), data.xpos.copy(), data.qvel.copy()
    now, _ = load(data)
    np.testing.assert_array_equal(before[0], data.qpos)
    np.testing.assert_array_equal(before[2], data.qvel)
    poses = sg.mujoco_poses(scene, data)
    assert list(poses) == ["body_2"]  # geoms of the world do not move
    np.testing.assert_array_equal(poses["body_2"], now.bodies[1].pose)
    np.testing.assert_allclose(now.sonar_pose, pose(1, 0, 1, 0, 0, 0.5), rtol=0, atol=ROUNDING)
    np.testing.assert_array_equal(now.sonar_pose, sg.mujoco_sonar_pose(data))
    assert sg.mujoco_poses(scene.without("body_2"), data) == {}


def test_a_mocap_body_is_where_a_simulation_has_placed_it():
    data = mujoco.MjData(model_of("<body name='gate' mocap='true'><geom type='box' size='1 .1 .2'/></body>"))
    data.mocap_pos[0], data.mocap_quat[0] = (2, 3, 4), (np.cos(0.25), 0, 0, np.sin(0.25))
    (body,) = load(data)[0].bodies
    np.testing.assert_allclose(body.pose, pose(2, 3, 4, yaw=0.5), rtol=0, atol=ROUNDING)


def test_further_sonars_are_named():
    sites = "<site name='sonar' pos='0 0 1'/><site name='aft' pos='-1 0 0' euler='0 0 .5'/>"
    camera = "<camera name='aft' pos='9 9 9'/><camera name='down' pos='0 0 -1' euler='0 0 0'/>"
    model = model_of(ARM.replace("<joint", f"{sites}{camera}<joint", 1))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    body = sg.mujoco_sonar_pose(data) @ pose(0, 0, -1)
    np.testing.assert_array_equal(sg.mujoco_sonar_pose(data, "sonar"), sg.mujoco_sonar_pose(data))
    aft = sg.mujoco_sonar_pose(data, "aft")  # the site, not the camera
    np.testing.assert_allclose(aft, body @ pose(-1, 0, 0, 0, 0, 0.5), rtol=0, atol=ROUNDING)
    # a camera without a rotation looks down, its picture's top to +y
    down = sg.mujoco_sonar_pose(data, "down")
    np.testing.assert_allclose(down[:3, 0], -body[:3, 2], rtol=0, atol=ROUNDING)
    np.testing.assert_allclose(down[:3, 2], body[:3, 1], rtol=0, atol=ROUNDING)
    with pytest.raises(Error, match=r"name must be .* \(got 'aftt'; did you mean 'aft'"):
        sg.mujoco_sonar_pose(data, "aftt")
    with pytest.raises(Error, match=r"name must be a str \(got int"):
        sg.mujoco_sonar_pose(data, 1)
    with pytest.raises(Error, match="got 'aft'; there are none"):
        data = mujoco.MjData(model_of("<geom size='1'/>"))
        mujoco.mj_forward(data.model, data)
        sg.mujoco_sonar_pose(data, "aft")


def test_every_part_of_a_body_follows_it():
    assets = "<asset><material name='steel'/></asset>"
    model = model_of(
        "<body name='a'><freejoint/><geom size='.1'/><geom name='s' size='.2' material='steel'/></body>",
        assets,
    )
    data = mujoco.MjData(model)
    data.qpos[:3] = 1, 2, 3
    mujoco.mj_forward(model, data)
    poses = sg.mujoco_poses(load(model)[0], data)
    assert list(poses) == ["a", "a::s"]
    for matrix in poses.values():
        np.testing.assert_array_equal(matrix, pose(1, 2, 3))


def test_a_ping_of_a_simulation():
    model = model_of("<body name='wall' pos='4 0 0'><freejoint/><geom type='box' size='.5 9 9'/></body>")
    data = mujoco.MjData(model)
    data.qpos[0] = 6
    mujoco.mj_forward(model, data)
    scene, _ = load(model)
    sonar = sg.load_sonar("p900-45").with_range(10)
    with sg.Simulator(scene, sonar, sg.Acoustics.ideal(), sg.Sampling(1, 16)) as simulator:
        for poses, range_m in (({}, 3.5), (sg.mujoco_poses(scene, data), 5.5)):
            ping = simulator.ping(sg.pose(), bodies=poses)
            assert abs(ping.range_m[ping.intensity[128].argmax()] - range_m) < sonar.bin_size_m


def test_other_objects_are_refused():
    with pytest.raises(Error, match=r"data must be a mujoco.MjData \(got MjModel\)"):
        sg.mujoco_sonar_pose(model_of(ARM))
    model = model_of(ARM)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    with pytest.raises(Error, match=r"scene must be a Scene \(got MjModel; sonar_gl.load_scene makes one"):
        sg.mujoco_poses(model, data)
    with pytest.raises(Error, match="must have a site or camera for the sonar"):
        sg.mujoco_sonar_pose(data)


def test_what_deforms_is_left_out():
    _, warned = load(model_of(f"<geom size='1'/>{CLOTH}"))
    assert warned == ["flexes and skins of the MuJoCo model are left out (they deform)"]


def test_names_by_number_differ_from_those_that_the_model_gives(tmp_path):
    model = model_of(
        "<body name='body_2'><geom size='1'/></body><body pos='5 0 0'><freejoint/><geom size='1'/></body>"
        "<geom name='geom_1' size='1'/><geom size='1'/>"
    )
    scene, _ = load(model)
    assert [body.name for body in scene.bodies] == ["geom_1", "geom_1_", "body_2", "body_2_"]
    data = mujoco.MjData(model)
    data.qpos[0] = 7
    mujoco.mj_forward(model, data)
    poses = sg.mujoco_poses(scene, data)
    assert {name: matrix[0, 3] for name, matrix in poses.items()} == {"body_2": 0, "body_2_": 7}


# ---- files -------------------------------------------------------------------------------------------


def test_a_file_with_includes_and_meshes(tmp_path):
    (tmp_path / "meshes").mkdir()
    wedge = "v 0 0 0\nv 1 0 0\nv 0 2 0\nv 0 0 3\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    (tmp_path / "meshes" / "wedge.obj").write_text(wedge)
    (tmp_path / "part.xml").write_text(
        "<mujocoinclude><asset><mesh name='w' file='wedge.obj'/></asset></mujocoinclude>"
    )
    path = tmp_path / "tank.xml"
    text = """<mujoco><compiler meshdir='meshes'/><include file='part.xml'/>
      <worldbody><geom name='w' type='mesh' mesh='w'/></worldbody></mujoco>"""
    path.write_text(text)
    with noted_files() as files:
        scene, warned = load(path)
    assert sorted(files) == [f"{tmp_path}/{name}" for name in ("meshes/wedge.obj", "part.xml", "tank.xml")]
    assert (scene.name, warned) == ("tank", [])
    np.testing.assert_allclose(boxes_of(scene)["w"], [[0, 0, 0], [1, 2, 3]], atol=FLOAT32)

    (tmp_path / "meshes" / "wedge.obj").rename(tmp_path / "lost.obj")
    message = error_message(path)
    assert "wedge.obj" in message and f"named by {tmp_path}/part.xml: mesh[w]" in message
    assert message == error_message(path, skip_missing=True)
    path.write_text(text.replace("'meshes'", "'..'"))
    (tmp_path / "lost.obj").rename(tmp_path.parent / "wedge.obj")
    assert "must stay in the scene's folder and the resource paths" in error_message(path)
    assert len(load(path, [tmp_path.parent])[0].bodies) == 1
    path.write_text(text.replace("part.xml", "../part.xml"))
    (tmp_path / "part.xml").rename(tmp_path.parent / "part.xml")
    assert "must stay in the scene's folder and the resource paths" in error_message(path)


@pytest.mark.parametrize(
    "text, message",
    [
        ("<mujoco><worldbody><geom/></worldbody></mujoco>", "MuJoCo cannot read this model"),
        ("<mujoco><nonsense/></mujoco>", "MuJoCo cannot read this model (XML Error: Schema violation"),
        ("<mujoco>", "broken XML"),
        ("<!DOCTYPE m [<!ENTITY a 'b'>]><mujoco/>", "entities must not be declared (refused)"),
        ("<scene/>", "the root element must be <sdf>, or <robot> of URDF (got <scene>)"),
    ],
)
def test_errors_of_files(tmp_path, text, message):
    path = tmp_path / "a.xml"
    path.write_text(text)
    found = error_message(path)
    assert found.startswith(f"{path}: ") and message in found and "\n" not in found


def test_warnings_name_the_file(tmp_path):
    path = tmp_path / "a.xml"
    path.write_text(MODEL.format("", f"<geom size='1'/>{CLOTH}"))
    with pytest.warns(UserWarning) as caught:
        load_scene(path)
    material, deforming = (str(one.message) for one in caught)
    assert material.startswith(f"{path}: no material of a known name in 1 of 1 bodies (geom_0); ")
    assert deforming == f"{path}: flexes and skins of the MuJoCo model are left out (they deform)"


def test_sdf_and_urdf_may_be_named_xml(tmp_path):
    path = tmp_path / "a.xml"
    path.write_text("<robot name='r'><link name='l'/></robot>")
    assert load(path)[0].bodies == ()


def test_a_missing_extra_is_named(tmp_path, monkeypatch):
    path = tmp_path / "a.xml"
    path.write_text("<mujoco/>")
    monkeypatch.setitem(sys.modules, "mujoco", None)
    assert f"{path}: a model of MuJoCo needs MuJoCo (got no module mujoco); to add it: " in error_message(
        path
    )


def test_scenes_of_other_kinds_do_not_import_mujoco():
    code = "import sonar_gl as sg, sys; sg.load_scene('pylon'); print('mujoco' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "False\n"


@pytest.mark.parametrize("side", ["right", "left", "up", "down", "front", "back"])
def test_files_of_a_texture_s_sides_stay_in_the_folder(tmp_path, side):
    outside = tmp_path / "outside.png"
    outside.write_bytes(b"\x89PNG")
    path = tmp_path / "inside" / "a.xml"
    path.parent.mkdir()
    path.write_text(
        f"<mujoco><asset><texture name='t' type='cube' file{side}='../outside.png'/></asset></mujoco>"
    )
    message = error_message(path)
    assert message.startswith(f"{path}: texture[t]: ")
    assert f"must stay in the scene's folder and the resource paths (it leads to {outside}; " in message


TRIANGLES = "v 0 0 0\nv 1 0 0\nv 0 2 0\nv 0 0 3\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
OF_MESH = "<worldbody><geom type='mesh' mesh='hull'/></worldbody>"
NAMED_FILES = {
    "an include beside the file that includes it": {
        "a.xml": "<mujoco><include file='parts/one.xml'/></mujoco>",
        "parts/one.xml": "<mujocoinclude><include file='two.xml'/></mujocoinclude>",
        "parts/two.xml": "<mujocoinclude><worldbody><geom size='1'/></worldbody></mujocoinclude>",
    },
    "a mesh beside the file that includes it": {
        "a.xml": f"<mujoco><include file='parts/one.xml'/>{OF_MESH}</mujoco>",
        "parts/one.xml": "<mujocoinclude><asset><mesh file='hull.obj'/></asset></mujocoinclude>",
        "parts/hull.obj": TRIANGLES,
    },
    "a folder that the last compiler names": {
        "a.xml": f"<mujoco><include file='one.xml'/><compiler meshdir='meshes'/>{OF_MESH}</mujoco>",
        "one.xml": "<mujocoinclude><compiler meshdir='old'/><asset><mesh file='hull.obj'/></asset></mujocoinclude>",
        "meshes/hull.obj": TRIANGLES,
    },
    "a folder of all assets after one of meshes": {
        "a.xml": "<mujoco><compiler meshdir='old'/><compiler assetdir='meshes'/>"
        f"<asset><mesh file='hull.obj'/></asset>{OF_MESH}</mujoco>",
        "meshes/hull.obj": TRIANGLES,
    },
    "backslashes": {
        "a.xml": rf"<mujoco><asset><mesh file='meshes\hull.obj'/></asset>{OF_MESH}</mujoco>",
        "meshes/hull.obj": TRIANGLES,
    },
    "a path of Windows that is stripped": {
        "a.xml": r"<mujoco><compiler strippath='true'/><asset><mesh file='C:\rov\hull.obj'/></asset>"
        f"{OF_MESH}</mujoco>",
        "hull.obj": TRIANGLES,
    },
    "a folder that there is not, and back": {
        "a.xml": f"<mujoco><asset><mesh file='old/../hull.obj'/></asset>{OF_MESH}</mujoco>",
        "hull.obj": TRIANGLES,
    },
}


@pytest.mark.parametrize("files", NAMED_FILES.values(), ids=NAMED_FILES)
def test_files_are_found_where_mujoco_finds_them(tmp_path, monkeypatch, files):
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    mujoco.MjModel.from_xml_path(f"{tmp_path}/a.xml")
    with noted_files() as noted:
        assert len(load(tmp_path / "a.xml")[0].bodies) == 1
    assert sorted(noted) == sorted(f"{tmp_path}/{name}" for name in files)
    monkeypatch.chdir(tmp_path.parent)
    assert len(load(f"{tmp_path.name}/a.xml")[0].bodies) == 1


@pytest.mark.parametrize(
    "robot",
    [
        "<robot name='r'><mujoco><compiler strippath='false' discardvisual='false'/></mujoco><link name='a'><visual>"
        "<geometry><mesh filename='{}'/></geometry></visual></link></robot>",
        "<mujoco><compiler meshdir='.'/><compiler assetdir='{.parent}'/><asset><mesh file='hull.obj'/></asset>"
        "<worldbody><body name='a'><geom type='mesh' mesh='hull'/></body></worldbody></mujoco>",
    ],
    ids=["urdf", "assetdir"],
)
def test_files_of_an_attached_model_stay_in_the_folder(tmp_path, robot):
    outside, path = tmp_path / "hull.obj", tmp_path / "inside" / "a.xml"
    path.parent.mkdir()
    for file in (outside, path.parent / "hull.obj"):
        file.write_text(TRIANGLES)
    path.with_name("robot.xml").write_text(robot.format(outside))
    path.write_text(
        "<mujoco><asset><model name='m' file='robot.xml'/></asset><worldbody><body>"
        "<attach model='m' body='a' prefix='m_'/></body></worldbody></mujoco>"
    )
    message = error_message(path)
    assert message.startswith(f"{path.parent}/robot.xml: mesh[")
    assert f"must stay in the scene's folder and the resource paths (it leads to {outside}; " in message
