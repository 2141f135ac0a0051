"""Scenes from SDF files: bodies and their names, merged models, and what is told of a file as a whole."""

import numpy as np
import pytest
import trimesh

import sonar_gl as sg
from sonar_gl.core.poses import pose
from sonar_gl.scene.sdf import reader
from sonar_gl.scene.sdf.reader import read_sdf
from tests.support.errors import error_of
from tests.support.sdf_texts import (
    BOX,
    RETRO,
    ROUNDING,
    SHAPE,
    SHEET,
    SKIPPABLE,
    add_model,
    link,
    model,
    model_of,
    read_warned,
    shape,
    write,
)


def test_bare_model_and_scene_name(read_text):
    scene = read_text(model("<pose>1 2 3 0 0 0</pose>" + link()), world=False)
    assert scene.name == "a" and [b.name for b in scene.bodies] == ["m"] and scene.sonar_pose is None
    np.testing.assert_array_equal(scene.bodies[0].pose, pose(1, 2, 3))


def test_names_of_several_links(read_text):
    scene = read_text(
        model(link(name="a") + link(name="b") + "<link name='bare'/>" + model(link(), "inner"), "outer")
    )
    assert [b.name for b in scene.bodies] == ["outer::a", "outer::b", "outer::inner"]


def test_a_body_with_the_name_of_its_model_has_its_pose(read_text):
    """A simulator that says where the model is places the body by its name; the pose of the link stays."""
    tags = f"<pose>0 0 3 0 0 1.5707963267948966</pose>{shape(RETRO)}"
    scene = read_text(
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


def test_the_poses_of_models_are_kept(tmp_path, read_text):
    add_model(tmp_path, "arms", model(MERGED, "arms"))
    inside = MERGE.format("<pose>0 0 2 0 0 0</pose>") + model("<pose>1 0 0 0 0 0</pose>" + link(), "inner")
    scene = read_text(model("<pose>10 0 0 0 0 0</pose>" + inside, "rov") + model("", "empty"))
    places = {name: matrix[:3, 3].tolist() for name, matrix in scene.without("rov::hand").models.items()}
    assert places == {
        "rov": [10, 0, 0],
        "rov::tool": [10, 2, 3],
        "rov::inner": [11, 0, 0],
        "empty": [0, 0, 0],
    }


def test_a_body_with_the_name_of_its_link_has_its_pose(read_text):
    links = "".join(f"<link name='{k}'><pose>{k} 0 3 0 0 0</pose>{shape(RETRO)}</link>" for k in (1, 2))
    scene = read_text(model(f"<pose>10 0 0 0 0 0</pose>{links}"))
    for k, body in zip((1, 2), scene.bodies, strict=True):
        np.testing.assert_array_equal(body.pose, pose(10 + k, 0, 3))
        np.testing.assert_array_equal(body.mesh.bounds, [[-1, -2, -3], [1, 2, 3]])


def test_one_warning_names_the_bodies_without_laser_retro(tmp_path):
    bare = f"<collision name='c'>{BOX}</collision>"
    inside = model(link(shape=bare), "x") + model(link(), "y") + model(link(shape=bare), "z")
    scene, texts = read_warned(tmp_path, inside)
    assert texts == ["no <laser_retro> in 2 of 3 bodies (x, z); their reflectivity is taken as 0.5"]
    assert [b.reflectivity for b in scene.bodies] == [0.5, 1.0, 0.5]


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


@pytest.mark.parametrize("declared", ["", " xmlns:experimental='urn:any'"])
def test_changes_of_included_models_are_left_out_with_a_warning(tmp_path, declared):
    """SDF 1.8 moves, adds and removes links of an included model by them."""
    add_model(tmp_path, "rock")
    change = "<pose element_id='link' action='modify'>1 0 0 0 0 0</pose>"
    params = f"<experimental:params{declared}>{change}</experimental:params>"
    include = f"<include><name>reef</name><uri>model://rock</uri>{params}</include>"
    _, texts = read_warned(tmp_path, include)
    assert "changes of included models by <experimental:params> are left out (reef)" in texts


def test_elements_without_acoustic_meaning_are_ignored(read_text):
    scene = read_text(
        "<physics type='ode'><gravity>x y z</gravity></physics><light name='l'><pose>nonsense</pose></light>"
        "<gui><camera name='c'><pose>1 2</pose></camera></gui><plugin name='p' filename='q'><a/></plugin>"
        + model("<static>1</static>" + link("<inertial><pose>bad</pose></inertial>"))
    )
    assert len(scene.bodies) == 1


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


def test_the_root_may_hold_includes_and_lights(tmp_path, read_text):
    add_model(tmp_path, "rock", model(link(), "rock"))
    scene = read_text("<include><uri>model://rock</uri></include><light name='l'/>", world=False)
    assert [body.name for body in scene.bodies] == ["rock"]
    assert read_text("<light name='sun'/>", world=False).bodies == ()


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
def test_a_merged_include_becomes_a_part_of_the_model(tmp_path, read_text, inside, x, z, comes_first):
    add_model(tmp_path, "arms", model(MERGED, "arms"))
    parts = [
        "<pose>10 0 0 0 0 0</pose>",
        link("<pose relative_to='hand'>0 0 7 0 0 0</pose>", "held"),
        "<frame name='grip' attached_to='wrist'><pose>0 0 4 0 0 0</pose></frame>",
        model("<pose relative_to='grip'/>" + link(), "gripped"),
        "<model name='held_too'><pose relative_to='tool::link'/>" + link() + "</model>",
    ]
    parts.insert(1 if comes_first else 5, MERGE.format(inside))
    assert places(read_text(model("".join(parts), "rov"))) == {
        "rov::arm": [10 + x, 1, z],
        "rov::hand": [10 + x, 2, z],
        "rov::tool": [10 + x, 2, z + 1],
        "rov::held": [10 + x, 2, z + 7],
        "rov::gripped": [10 + x, 2, z + 4],
        "rov::held_too": [10 + x, 2, z + 1],
    }


def test_a_model_that_is_merged_twice_is_refused(tmp_path, read_text):
    add_model(tmp_path, "arms", model(MERGED, "arms"))
    with pytest.raises(sg.Error, match=r"model 'arms' must be merged once \(got it twice"):
        read_text(model(2 * MERGE.format(""), "rov"))


def test_what_a_merged_include_names_lies_beside_it(tmp_path, read_text):
    """Files are found in the folder of the included model; a single link makes the body of the outer one."""
    add_model(tmp_path / "far", "arms", model_of("<mesh><uri>a.stl</uri></mesh>", "arms"))
    trimesh.creation.box((2, 2, 2)).export(tmp_path / "far" / "arms" / "a.stl")
    uri = "<uri>far/arms</uri>"
    merge = f"<include merge='1'>{uri}<pose>0 0 5 0 0 0</pose></include>"
    scene = read_text(model(f"<pose>10 0 0 0 0 0</pose>{merge}", "rov"))
    assert places(scene) == {"rov": [10, 0, 0]}
    np.testing.assert_array_equal(scene.bodies[0].mesh.bounds, [[-1, -1, 4], [1, 1, 6]])


def test_merged_includes_of_merged_includes_and_of_worlds(tmp_path, read_text):
    add_model(tmp_path, "arms", model(MERGED, "arms"))
    add_model(tmp_path, "upper", model(MERGE.format("<pose>0 0 1 0 0 0</pose>"), "upper"))
    merge = MERGE.replace("arms", "upper").format("<pose>0 0 2 0 0 0</pose>")
    scene = read_text(model(merge + link("<pose relative_to='hand'>0 1 0 0 0 0</pose>", "held"), "rov"))
    assert places(scene)["rov::hand"] == [0, 2, 3] and places(scene)["rov::held"] == [0, 3, 3]
    add_model(tmp_path, "yard", model(model(link(), "left") + model(link(), "right"), "yard"))
    merge = MERGE.replace("arms", "yard").format("<pose>0 0 2 0 0 0</pose>")
    assert places(read_text(merge)) == {"left": [0, 0, 2], "right": [0, 0, 2]}


@pytest.mark.parametrize("comes_first", [True, False])
def test_a_merged_include_must_bring_new_names(tmp_path, message_of, comes_first):
    add_model(tmp_path, "arms", model(MERGED, "arms"))
    parts = [MERGE.format(""), link(name="hand")]
    place = "link[hand]" if comes_first else "include[model://arms]"
    assert message_of(model("".join(parts if comes_first else parts[::-1]), "rov")) == (
        f"a.sdf: world/model[rov]/{place}: names must be unique (got 'hand' twice)"
    )


def test_a_merged_include_must_not_lie_in_a_frame_of_its_own(tmp_path, message_of):
    add_model(tmp_path, "arms", model(MERGED, "arms"))
    assert message_of(model(MERGE.format("<pose relative_to='hand'/>"), "rov")) == (
        "a.sdf: world/model[rov]/include[model://arms]/pose: frames must lead to the model or world "
        "(got _merged__arms__model__ -> _merged__arms__model__ ...)"
    )


def test_links_are_not_merged_into_a_world(tmp_path, message_of):
    add_model(tmp_path, "arms", model(MERGED, "arms"))
    assert message_of(MERGE.format("")) == (
        'a.sdf: world/include[model://arms]: a world holds models, no links (got merge="true" of a model with '
        "link 'arm'; leave merge out)"
    )


def test_include_cycles(tmp_path, message_of):
    add_model(tmp_path, "a", model("<include><uri>model://b</uri></include>", "a"))
    add_model(tmp_path, "b", model("<include><uri>model://a</uri></include>", "b"))
    assert message_of("<include><uri>model://a</uri></include>") == (
        "b/model.sdf: model[b]/include[model://a]: a model must not include itself "
        "(got a/model.sdf -> b/model.sdf -> a/model.sdf)"
    )


def test_deep_nesting_and_bombs_of_includes(tmp_path, message_of, monkeypatch):
    nested = link()
    for i in range(40):
        nested = model(nested, f"m{i}")
    assert message_of(nested).endswith(": a scene must hold at most 65535 models, at most 32 deep")
    monkeypatch.setattr(reader, "MAX_MODELS", 50)
    for i in range(8):  # doubles at every level
        twice = "".join(f"<include><uri>model://b{i + 1}</uri><name>{n}</name></include>" for n in "xy")
        add_model(tmp_path, f"b{i}", model(twice if i < 7 else link(), f"b{i}"))
    assert message_of("<include><uri>model://b0</uri></include>").endswith(
        ": a scene must hold at most 50 models, at most 32 deep"
    )


@pytest.mark.parametrize(
    ("inside", "expected"),
    [
        (model("<pose>1 2 3</pose>" + link()), "world/model[m]/pose: must be 6 finite numbers (got '1 2 3')"),
        (model("<pose>0 0 0 0 0 nan</pose>" + link()), "world/model[m]/pose: must be 6 finite numbers"),
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
        (model(link("<pose relative_to='lnk2'/>") + link(name="link2")), "world/model[m]/link[link]/pose:"),
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
        (model(link(shape=SHAPE.replace("2 4 6", "2 -4 6"))), "world/model[m]/link[link]/collision[c]/geome"),
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
        (model(link(shape=SHAPE.replace("255", "-1"))), "world/model[m]/link[link]/collision[c]/laser_retro"),
        (model(link(shape=SHAPE.replace("255", "bright"))), "world/model[m]/link[link]/collision[c]/laser_r"),
        (
            model(
                link(shape=SHAPE.replace("<geometry>", "<pose degrees='false'>1 2 3 4 5 x</pose><geometry>"))
            ),
            "world/model[m]/link[link]/collision[c]/pose: must be 6 finite numbers (got '1 2 3 4 5 x')",
        ),
    ],
)
def test_messages_name_file_and_element(message_of, inside, expected):
    assert message_of(inside).startswith(f"a.sdf: {expected}")


def test_messages_of_a_bare_model_and_of_an_included_file(tmp_path, message_of):
    bad = link("<pose>1</pose>")
    assert message_of(model(bad), world=False) == (
        "a.sdf: model[m]/link[link]/pose: must be 6 finite numbers (got '1')"
    )
    add_model(tmp_path, "rock", model(bad, "rock"))
    assert message_of("<include><uri>model://rock</uri><name>r</name></include>") == (
        "rock/model.sdf: model[r]/link[link]/pose: must be 6 finite numbers (got '1')"
    )


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("<sdf>\n  <world>\n</sdf>", "line 3, column 3: broken XML (mismatched tag)"),
        (" ", "line 1, column 2: broken XML (no element found)"),
        ("", "must not be empty (got a file of 0 bytes)"),
        ("<sdf><a b=c/></sdf>", "line 1, column 11: broken XML (not well-formed (invalid token);"),
        ("<sdf><a b='c<'/></sdf>", "line 1, column 13: broken XML (not well-formed (invalid token))"),
        ("<sdf>&nothing;</sdf>", "line 1, column 6: broken XML (undefined entity)"),
        ("<scene/>", "the root element must be <sdf>, or <robot> of URDF (got <scene>)"),
        ("<COLLADA xmlns='http://www.collada.org/2005/11/COLLADASchema'/>", "the root element must be <sdf>"),
        ("<sdf xmlns='a\nb'><a b='c<'/></sdf>", "line 2, column 11: broken XML (not well-formed"),
        ("<sdf/>", "must hold a <world> or a <model>"),
    ],
)
def test_files_other_than_sdf(tmp_path, text, expected):
    path = tmp_path / "a.sdf"
    path.write_text(text)
    assert error_of(read_sdf, path).startswith(f"{path}: {expected}")


def test_a_missing_scene_file(tmp_path):
    assert error_of(read_sdf, tmp_path / "no.sdf") == f"{tmp_path / 'no.sdf'}: No such file or directory"


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
        (model(link("<poses>5 0 0 0 0 0</poses>")), "world/model[m]/link[link]/poses (did you mean 'pose'?)"),
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
