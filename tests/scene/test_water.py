"""Shapes of a world that are no solids: its water, and marks."""

import pytest

from sonar_gl.core.errors import Error
from sonar_gl.scene.sdf.reader import read_sdf
from tests.support.sdf_texts import (
    RETRO,
    ROUNDING,
    SHAPE,
    SHEET,
    link,
    model,
    read_warned,
    shape,
    visual,
    write,
)


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


WALL = "<geometry><box><size>400 0.1 70</size></box></geometry>"


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
