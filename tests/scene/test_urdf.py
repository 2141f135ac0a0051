"""URDF and xacro: links, joints, surfaces, the sonar, packages, and what a xacro file may not do."""

import os
import re
import warnings

import numpy as np
import pytest
import trimesh

import sonar_gl as sg
from sonar_gl.core.poses import pose
from sonar_gl.scene.load import load_scene
from sonar_gl.scene.materials import material
from sonar_gl.scene.sdf.xacro import split_arguments
from tests.support.command_line import run
from tests.support.loaded_scenes import boxes_of, error_message, load

ROUNDING = 1e-12  # of a few products of float64 matrices
BOX = "<geometry><box size='2 4 6'/></geometry>"
ARM = f"""<robot name="arm">
  <link name="base"><collision><origin xyz="0 0 3"/>{BOX}</collision></link>
  <link name="elbow"><visual><geometry><cylinder radius="0.1" length="1"/></geometry></visual></link>
  <link name="hand"><collision><geometry><sphere radius="0.2"/></geometry></collision></link>
  <joint name="j1" type="revolute"><parent link="base"/><child link="elbow"/>
    <origin xyz="1 0 6" rpy="0 1.5707963267948966 0"/><axis xyz="0 0 1"/></joint>
  <joint name="j2" type="fixed"><parent link="elbow"/><child link="hand"/><origin xyz="0 0 1"/></joint>
  {{}}
</robot>"""
XACRO = '<robot name="r" xmlns:xacro="http://www.ros.org/wiki/xacro">{}</robot>'


def write(path, text):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return path


# ---- URDF --------------------------------------------------------------------------------------------


def test_links_are_bodies_at_the_zero_of_their_joints(tmp_path):
    scene, warned = load(write(tmp_path / "arm.urdf", ARM.format("")))
    assert (scene.name, scene.sonar_pose, warned) == ("arm", None, [])
    found = boxes_of(scene)
    assert list(found) == ["base", "elbow", "hand"]
    expected = {  # the elbow's z axis is the world's x
        "base": [[-1, -2, 0], [1, 2, 6]],
        "elbow": [[0.5, -0.1, 5.9], [1.5, 0.1, 6.1]],
        "hand": [[1.8, -0.2, 5.8], [2.2, 0.2, 6.2]],
    }
    for name, bounds in expected.items():
        np.testing.assert_allclose(found[name], bounds, rtol=0, atol=ROUNDING)


@pytest.mark.parametrize("element", ["joint", "collision"])
def test_origins_may_hold_quaternions(tmp_path, element):
    """As in URDF 1.2: x y z w, of any length."""
    turned = '<origin xyz="1 0 6" quat_xyzw="0 2 0 2"/>'  # a quarter about y
    text = ARM.replace('<origin xyz="1 0 6" rpy="0 1.5707963267948966 0"/>', turned)
    if element == "collision":
        text = f"<robot name='r'><link name='elbow'><collision>{turned}{BOX}</collision></link></robot>"
    scene, _ = load(write(tmp_path / "r.urdf", text.format("")))
    expected = {"joint": [[0.5, -0.1, 5.9], [1.5, 0.1, 6.1]], "collision": [[-2, -2, 5], [4, 2, 7]]}[element]
    np.testing.assert_allclose(boxes_of(scene)["elbow"], expected, rtol=0, atol=ROUNDING)


def test_the_hint_about_large_angles_is_one_that_urdf_can_follow(tmp_path):
    """Its `<origin>` has no degrees; a `<pose>` of a sensor, which is SDF in a URDF file, has them."""
    text = f"""<robot name="r"><link name="a"><collision name="c"><origin rpy="0 0 90"/>{BOX}</collision></link>
      <link name="b"/><gazebo reference="b"><sensor name="sonar" type="custom"><pose>0 0 0 0 0 45</pose></sensor>
      </gazebo><joint name="j"><parent link="a"/><child link="b"/><origin rpy="0 0 45"/></joint></robot>"""
    path = write(tmp_path / "r.urdf", text)
    said = "angles of more than 2.5π, read as radians, as by Gazebo; if they are degrees, "
    assert [one for one in load(path)[1] if "2.5π" in one] == [
        f'{path}: 1 pose has {said}write <pose degrees="true"> (link[b]/sensor[sonar]/pose)',
        f"{path}: 2 poses have {said}multiply them by π/180, as URDF has no degrees "
        "(joint[j]/origin, link[a]/collision[c]/origin)",
    ]


def test_collisions_are_taken_before_visuals_and_surfaces_from_gazebo_blocks(tmp_path):
    text = f"""<robot name="r">
      <link name="a"><visual><geometry><sphere radius="9"/></geometry></visual><collision>{BOX}</collision></link>
      <link name="b"><visual>{BOX}</visual></link>
      <gazebo reference="a"><laserRetro>51</laserRetro><mu1>1</mu1></gazebo>
      <gazebo reference="b"><sonar_gl:material>steel</sonar_gl:material></gazebo>
      <gazebo reference="b"><sonar_gl:bubbles><rate>7</rate></sonar_gl:bubbles></gazebo>
    </robot>"""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        scene = load_scene(write(tmp_path / "r.urdf", text))
    a, b = scene.bodies
    assert len(a.surface.faces) == 12 and a.reflectivity == 0.2
    assert (b.material, b.specular) == ("steel", material("steel").specular)
    assert (scene.plumes[0].name, scene.plumes[0].rate_hz) == ("b::bubbles", 7)


def test_the_sonar_is_a_sensor_of_a_gazebo_block(tmp_path):
    sensor = (
        """<gazebo reference="{}"><sensor type="{}" name="{}"><pose>0 0 0.5 0 0 0</pose></sensor></gazebo>"""
    )
    beam = sensor.format("base", "ray", "dvl_sonar0")
    scene, _ = load(write(tmp_path / "a.urdf", ARM.format(beam)))
    assert scene.sonar_pose is None  # a DVL makes no images
    scene, _ = load(write(tmp_path / "b.urdf", ARM.format(beam + sensor.format("hand", "depth", "my_sonar"))))
    np.testing.assert_allclose(
        scene.sonar_pose, pose(1, 0, 6, 0, np.pi / 2, 0) @ pose(0, 0, 1.5), rtol=0, atol=ROUNDING
    )
    assert [body.name for body in scene.bodies] == ["base", "elbow"]  # the device itself returns no echo


@pytest.mark.parametrize("ending", ["urdf", "xacro"])
@pytest.mark.parametrize("declared", ['xmlns="http://www.ros.org"', "xmlns = 'http://drake.mit.edu'"])
def test_a_namespace_of_all_tags_has_no_meaning(tmp_path, declared, ending):
    """The schema of URDF has one, which its parser, as Gazebo's, passes over."""
    text = ARM.format("").replace('<robot name="arm"', f'<robot {declared} name="arm"')
    scene, _ = load(write(tmp_path / f"arm.{ending}", text))
    assert [body.name for body in scene.bodies] == ["base", "elbow", "hand"]


def test_a_robot_can_be_included_in_a_world(tmp_path):
    write(tmp_path / "arm.urdf", ARM.format(""))
    text = """<sdf version="1.9"><world name="w"><include><uri>arm.urdf</uri><name>left</name>
              <pose>10 0 0 0 0 0</pose></include></world></sdf>"""
    scene, _ = load(write(tmp_path / "w.sdf", text))
    found = boxes_of(scene)
    assert list(found) == ["left::base", "left::elbow", "left::hand"]
    np.testing.assert_allclose(
        found["left::hand"], [[11.8, -0.2, 5.8], [12.2, 0.2, 6.2]], rtol=0, atol=ROUNDING
    )


@pytest.mark.parametrize(
    "text, message",
    [
        ("<robot name='r'/>", "<robot> must hold a <link> (got none; a file of macros has none"),
        (ARM.format("<joint name='j3'><parent link='base'/><child link='hand'/></joint>"), "one parent"),
        (
            ARM.format("<joint name='j3'><parent link='base'/><child link='x'/></joint>"),
            "joint[j3]: unknown link",
        ),
        (
            ARM.replace('<parent link="elbow"/>', '<parent link="x"/>').format(""),
            "joint[j2]: unknown link (got 'x')",
        ),
        (ARM.replace('radius="0.1" ', "").format(""), "link[elbow]/visual[0]/geometry/cylinder:"),
        (ARM.replace('xyz="0 0 1"', 'xyz="0 0"').format(""), "joint[j2]/origin/xyz: must be 3 finite"),
        (ARM.replace('xyz="0 0 3"', 'rpy="a b c"').format(""), "link[base]/collision[0]/origin/rpy:"),
        (
            ARM.replace('<origin xyz="0 0 1"/>', '<origin quat_xyzw="0 0 1"/>').format(""),
            "joint[j2]/origin/quat_xyzw: must be 4 finite numbers (got '0 0 1')",
        ),
        (
            ARM.replace('<origin xyz="0 0 1"/>', '<origin rpy="0 0 1" quat_xyzw="0 0 0 1"/>').format(""),
            "joint[j2]/origin: must have rpy or quat_xyzw (got both)",
        ),
        (ARM.replace("sphere", "torus").format(""), "collision[0]/geometry/torus: unknown geometry"),
        (ARM.format("<link name='hand'/>"), "names must be unique (got 'hand' twice)"),
        (XACRO.format("<xacro:property name='a' value='1'/>"), "xacro macros (<xacro:property>)"),
        ("<mujoco/>", "got <mujoco>; this is a model of MuJoCo: name it .xml"),
        ("<launch/>", "got <launch>; this is a launch file of ROS"),
        ("<!DOCTYPE robot [<!ENTITY a 'b'>]><robot/>", "entities must not be declared (refused)"),
    ],
)
def test_errors_name_file_element_and_cure(tmp_path, text, message):
    path = write(tmp_path / "r.urdf", text)
    assert (found := error_message(path)).startswith(f"{path}: ") and message in found


def test_joints_in_a_ring_are_refused(tmp_path):
    text = ARM.format("<joint name='j3'><parent link='hand'/><child link='base'/></joint>")
    assert "frames must lead to the model or world" in error_message(write(tmp_path / "r.urdf", text))


# ---- packages ----------------------------------------------------------------------------------------


def mesh_robot(uri):
    mesh = f"<geometry><mesh filename='{uri}' scale='2 1 1'/></geometry>"
    return f"<robot name='r'><link name='l'><collision>{mesh}</collision></link></robot>"


@pytest.fixture
def workspace(tmp_path):
    """A folder with the packages own, in which the robot is, and parts, whose folder has another name."""
    for folder, name in (("src/own", "own"), ("src/group/parts-1.0", "parts")):
        write(tmp_path / folder / "package.xml", f"<package><name>{name}</name></package>")
        (tmp_path / folder / "meshes").mkdir()
        trimesh.creation.box((1, 1, 1)).export(tmp_path / folder / "meshes" / "box.stl")
    return tmp_path


def test_meshes_of_packages_are_found_in_the_files_own_package_and_below_resource_paths(
    workspace, monkeypatch
):
    own = write(workspace / "src/own/urdf/a.urdf", mesh_robot("package://own/meshes/box.stl"))
    np.testing.assert_array_equal(boxes_of(load(own)[0])["l"], [[-1, -0.5, -0.5], [1, 0.5, 0.5]])
    other = write(workspace / "src/own/urdf/b.urdf", mesh_robot("package://parts/meshes/box.stl"))
    message = error_message(other)
    assert "give the folder that holds the ROS package 'parts' as resource path" in message
    scene, (warned,) = load(other, skip_missing=True)
    assert scene.bodies == () and "package://parts" in warned
    for name in ("parts", "parts-1.0"):
        write(other, mesh_robot(f"package://{name}/meshes/box.stl"))
        assert len(load(other, [workspace / "src"])[0].bodies) == 1
    monkeypatch.setenv("ROS_PACKAGE_PATH", str(workspace / "src"))
    assert len(load(other)[0].bodies) == 1
    monkeypatch.delenv("ROS_PACKAGE_PATH")
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(workspace / "install"))
    (workspace / "install").mkdir()
    os.rename(workspace / "src/group", workspace / "install/share")
    assert len(load(other)[0].bodies) == 1


def test_nothing_outside_of_the_resource_paths_is_read(workspace):
    inside = write(workspace / "src/own/urdf/a.urdf", "")
    outside = workspace / "src/group/parts-1.0/meshes/box.stl"
    for uri in (f"file://{outside}", str(outside), "package://own/../group/parts-1.0/meshes/box.stl"):
        write(inside, mesh_robot(uri))
        assert "must stay in the scene's folder and the resource paths" in error_message(inside)


# ---- xacro -------------------------------------------------------------------------------------------


def test_a_xacro_file_is_expanded(workspace):
    write(workspace / "src/own/cfg.yaml", "hull: {radius: 0.25}")
    write(
        workspace / "src/group/parts-1.0/parts.xacro",
        XACRO.format(
            "<xacro:macro name='ball' params='name z *surface'><link name='${name}'><collision><origin xyz='0 0 ${z}'/>"
            "<geometry><sphere radius='${radius * 2}'/></geometry></collision></link>"
            "<gazebo reference='${name}'><xacro:insert_block name='surface'/></gazebo></xacro:macro>"
        ),
    )
    path = write(
        workspace / "src/own/urdf/rov.urdf.xacro",
        XACRO.format(
            "<xacro:arg name='prefix' default='rov'/><xacro:include filename='$(find parts)/parts.xacro'/>"
            "<xacro:include filename='absent.xacro' optional='true'/>"
            "<xacro:property name='radius' value=\"${xacro.load_yaml('$(find own)/cfg.yaml')['hull']['radius']}\"/>"
            "<xacro:ball name='$(arg prefix)/ball' z='${python.sum([cos(pi), 3])}'>"
            "<laser_retro>255</laser_retro></xacro:ball>"
            "<xacro:if value='${&quot;x&quot; in &quot;$(arg prefix)&quot;}'><link name='extra'><collision>"
            "<geometry><mesh filename='file://$(find own)/meshes/box.stl'/></geometry></collision></link></xacro:if>"
        ),
    )
    scene, warned = load(path, [workspace / "src"])
    assert (scene.name, warned, list(boxes_of(scene))) == ("rov", [], ["rov/ball"])
    np.testing.assert_allclose(
        boxes_of(scene)["rov/ball"], [[-0.5, -0.5, 1.5], [0.5, 0.5, 2.5]], rtol=0, atol=ROUNDING
    )
    assert scene.bodies[0].reflectivity == 1.0
    scene, _ = load(f"{path} prefix:=xyz", [workspace / "src"])
    assert list(boxes_of(scene)) == ["xyz/ball", "extra"]
    assert "the ROS package 'parts' must be in the resource paths" in error_message(path)


def test_what_a_file_prints_is_not_shown(tmp_path, capfd):
    text = "<link name=\"${xacro.warning('a')}${xacro.message('b')}l\"/><xacro:property name='pi' value='3'/>"
    assert load(write(tmp_path / "a.xacro", XACRO.format(text)))[0].bodies == ()
    assert capfd.readouterr() == ("", "")


def test_a_world_cannot_have_a_xacro_file_expanded(tmp_path):
    write(tmp_path / "a.xacro", XACRO.format("<xacro:property name='a' value='1'/><link name='l'/>"))
    text = "<sdf version='1.9'><world name='w'><include><uri>a.xacro</uri></include></world></sdf>"
    assert "expanded only in a .xacro file that is itself the scene" in error_message(
        write(tmp_path / "w.sdf", text)
    )


def test_arguments_follow_the_path():
    assert split_arguments("a.xacro") == ("a.xacro", {})
    assert split_arguments("my a.xacro  n:=1 s:=") == ("my a.xacro", {"n": "1", "s": ""})
    assert split_arguments("a.xacro n:=1 b") == ("a.xacro n:=1 b", {})


def test_an_argument_without_default_is_named(tmp_path):
    path = write(tmp_path / "a.xacro", XACRO.format("<link name='$(arg name)'/>"))
    assert error_message(path) == (
        f"{path}: line 1, <link>: the argument 'name' has no default; give it after the file, as in "
        f'"{path} name:=VALUE"'
    )
    assert load(f"{path} name:=x")[0].bodies == ()
    urdf = write(tmp_path / "a.urdf", ARM.format(""))
    assert "only a .xacro file takes arguments (got n)" in error_message(f"{urdf} n:=1")


@pytest.mark.parametrize(
    "expression",
    [
        "${().__class__}",
        "${(lambda: ().__class__)()}",  # the library's own check does not look into functions
        "${[x for x in (c.__class__ for c in [1])]}",
        "${(x for x in [1]).gi_frame.f_back.f_builtins}",
        "${map(str.format, [1])}",
        "${__builtins__}",
        "${(y := 1)}",
        "$(eval __import__)",
        "$(eval str.__base__)",
    ],
)
def test_expressions_cannot_run_code(tmp_path, expression):
    path = write(tmp_path / "a.xacro", XACRO.format(f'<link name="{expression}"/>'))
    assert "expressions must be simple ones" in error_message(path)


@pytest.mark.parametrize("name", ["type", "vars"])
def test_expressions_cannot_reach_classes(tmp_path, name):
    path = write(tmp_path / "a.xacro", XACRO.format(f"<link name='${{python.{name}(list)}}'/>"))
    assert f"name '{name}' is not defined" in error_message(path)


def test_names_of_a_file_may_be_those_of_python(tmp_path):
    text = """<xacro:property name='type' value='2'/>
      <xacro:property name='f_x' value='${[_n * type for _n in [1, 2]][1]}'/>
      <link name='l${f_x}'><collision><geometry><sphere radius='1'/></geometry></collision></link>"""
    path = write(tmp_path / "a.xacro", XACRO.format(text))
    assert [body.name for body in load(path)[0].bodies] == ["l4"]


def test_a_xacro_file_reads_nothing_outside_of_the_resource_paths(tmp_path):
    write(tmp_path / "secret.yaml", "a: 1")
    write(tmp_path / "other.xacro", XACRO.format("<link name='l'/>"))
    for content in (
        "<xacro:include filename='../other.xacro'/>",
        f"<xacro:include filename='{tmp_path}/oth*.xacro'/>",
        "<link name=\"${xacro.load_yaml('../secret.yaml')['a']}\"/>",
        f"<link name=\"${{xacro.load_yaml('{tmp_path}/secret.yaml')['a']}}\"/>",
    ):
        path = write(tmp_path / "robot" / "a.xacro", XACRO.format(content))
        assert "must stay in the scene's folder and the resource paths" in error_message(path)
        assert load(path, [tmp_path])[0].bodies == ()


@pytest.mark.parametrize(
    "content, message",
    [
        ("<xacro:include filename='x.xacro'/>", "there is no file"),
        ("<xacro:include filename='$(find no_such)/x.xacro'/>", "the ROS package 'no_such' must be in the"),
        ("<xacro:include filename='a.xacro'/>", "macros and includes must end"),
        (
            "<xacro:macro name='m' params=''><xacro:m/></xacro:macro><xacro:m/>",
            "macros and includes must end",
        ),
        ("<link name='$(eval 1 + )'/>", "invalid syntax"),
        ("<xacro:thing/>", "unknown macro name: xacro:thing;"),
        ("<link name='${n}'/>", "name 'n' is not defined"),
        ("<link name='${1/0}'/>", "division by zero"),
        ("<link name='${1 +}'/>", "invalid syntax"),
        ("<link name='$(env NO_SUCH_VARIABLE)'/>", "the environment variable 'NO_SUCH_VARIABLE' is not set"),
        ("<link name='$(shell ls)'/>", "unknown substitution (got '$(shell ls)'"),
        ("<link", "broken XML"),
    ],
)
def test_errors_of_xacro_files(tmp_path, content, message):
    path = write(tmp_path / "a.xacro", XACRO.format(content))
    assert (found := error_message(path)).startswith(f"{path}: ") and message in found


def test_errors_of_xacro_files_name_file_and_line(tmp_path):
    """The line of the element that is expanded; of a macro, of its body; of an included file, that of the other."""
    write(
        tmp_path / "parts.xacro",
        XACRO.format("\n<xacro:macro name='ball' params='z'>\n<link name='${z / 0}'/></xacro:macro>"),
    )
    start = "\n<xacro:include filename='parts.xacro'/>\n"
    parts = f"{tmp_path / 'parts.xacro'}: line 3, <link>"
    for content, where in (
        ("\n\n<link name='a'/><link name='${n}'/>", "line 3, <link>: "),
        ("\n<xacro:if value='maybe'><link name='l'/></xacro:if>", "line 2, <xacro:if>: "),
        ("\n<xacro:property name='a-b' value='1'/>", "line 2, <xacro:property>: "),
        ("\n<xacro:include filename='x.xacro'/>", "line 2, <xacro:include>: there is no file "),
        (
            "\n<xacro:include filename='$(find no)/x.xacro'/>",
            "line 2, <xacro:include>: the ROS package 'no' ",
        ),
        (start + "<xacro:ball/>", "line 3, <xacro:ball>: "),
        (start + "<xacro:ball z='2'/>", f"{parts}: "),
    ):
        path = write(tmp_path / "a.xacro", XACRO.format(content))
        found = error_message(path)
        assert found.startswith(f"{path}: {where}"), found
        assert "\n" not in found


def test_a_line_is_named_though_macros_repeat_blocks(tmp_path):
    text = (
        "<xacro:macro name='twice' params='*block'><xacro:insert_block name='block'/></xacro:macro>\n"
        "<xacro:twice>\n<link name='${n}'/>\n</xacro:twice>"
    )
    path = write(tmp_path / "a.xacro", XACRO.format(text))
    assert error_message(path).startswith(f"{path}: line 3, <link>: ")


def test_a_missing_package_of_includes_cannot_be_skipped(tmp_path):
    path = write(tmp_path / "a.xacro", XACRO.format("<xacro:include filename='$(find no_such)/x.xacro'/>"))
    with pytest.raises(sg.Error) as caught:
        sg.load_scene(path, skip_missing=True)
    assert "; its macros cannot be skipped (--skip-missing, skip_missing= are for models and meshes))" in str(
        caught.value
    )


def test_entities_and_comments_that_gazebo_accepts(tmp_path):
    path = write(tmp_path / "a.xacro", "<!DOCTYPE r [<!ENTITY a 'b'>]>" + XACRO.format("<link name='&a;'/>"))
    assert "entities must not be declared (refused)" in error_message(path)
    write(path, XACRO.format("<!-- a -- b --><link name='l'/>"))
    _, (warned,) = load(path)
    assert '"--" in a comment' in warned


def test_the_library_of_the_process_is_left_alone(tmp_path):
    import xacro

    before = {name: getattr(xacro, name) for name in ("safe_eval", "parse", "load_yaml", "eval_extension")}
    load(write(tmp_path / "a.xacro", XACRO.format("<link name='${1 + 1}'/>")))
    assert {name: getattr(xacro, name) for name in before} == before
    assert xacro.filestack is None


def test_the_command_line_renders_a_robot(tmp_path):
    write(tmp_path / "wall.urdf.xacro", XACRO.format(
        "<xacro:arg name='x' default='100'/><link name='wall'><collision><origin xyz='$(arg x) 0 0'/>"
        "<geometry><box size='1 9 9'/></geometry></collision></link>"
        "<gazebo reference='wall'><laserRetro>255</laserRetro></gazebo>"))  # fmt: skip
    status, out, _ = run(
        "render", f"{tmp_path}/wall.urdf.xacro x:=5", "--pose", "0 0 0 0 0 0", "--range", 8, "--tolerance", 0.1,
        "--noise", "none", "--format", "npz", "--out", tmp_path)  # fmt: skip
    assert status == 0 and "wall.npz" in out
    ping = sg.load_npz(tmp_path / "wall.npz")
    assert abs(ping.range_m[ping.intensity[128].argmax()] - 4.5) < 2 * ping.meta["bin_size_m"]
    status, _, err = run(
        "render", f"{tmp_path}/wall.urdf.xacro x:=a", "--pose", "0 0 0 0 0 0", "--out", tmp_path
    )
    assert status == 2 and re.fullmatch(r"error: .*wall\.urdf\.xacro: .*3 finite numbers.*\n", err)


def test_slips_in_arguments_of_xacro_are_told_of(tmp_path):
    """ROS's own command passes over an argument that the file does not have."""
    link = "<xacro:arg name='width' default='1'/><link name='l$(arg width)'/>"
    path = write(tmp_path / "a.xacro", XACRO.format(link))
    _, texts = load(f"{path} widht:=3")
    assert texts == [f"{path}: the file has no argument 'widht' (did you mean 'width'?)"]
    assert load(f"{path} width:=3")[1] == []
    assert error_message(f"{path} width=3").endswith(
        "arguments of xacro are given as name:=value, with a colon"
    )
