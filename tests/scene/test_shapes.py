"""The shapes of links, as bodies: which are read, their geometry, and how they reflect."""

import re
import warnings
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh

import sonar_gl as sg
from sonar_gl.core.errors import Error
from sonar_gl.scene.materials import material
from sonar_gl.scene.primitives import closedness
from sonar_gl.scene.sdf.reader import read_sdf
from sonar_gl.scene.sdf.shapes import EXTENSIONS
from tests.support.sdf_texts import (
    BOX,
    RETRO,
    ROUNDING,
    SKIPPABLE,
    link,
    model,
    model_of,
    read_warned,
    shape,
    write,
)


def test_the_page_of_conventions_has_a_row_of_each_tag_of_a_shape():
    page = (Path(__file__).parents[2] / "docs" / "conventions.md").read_text()
    section = page.partition("### Tags of this simulator")[2].partition("\n## ")[0]
    told = re.findall(r"^\| `<sonar_gl:(\w+)>.*` \| collision or visual \|", section, re.MULTILINE)
    assert sorted(told) == sorted(EXTENSIONS)


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


def test_visuals_make_the_body_without_collisions(read_text):
    empty = "<collision name='c'><geometry><empty/></geometry></collision>"
    scene = read_text(model(link(shape=f"{empty}<visual name='v'>{BALL}{RETRO}</visual>")))
    np.testing.assert_array_equal(scene.bodies[0].mesh.extents, SIZES["sphere"])


def test_shapes_of_a_link_are_one_body_with_one_reflectivity_per_face(read_text):
    scene = read_text(
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


@pytest.mark.parametrize(
    ("geometry", "extents"),
    [
        ("<cylinder><radius>1</radius><length>3</length></cylinder>", (2, 2, 3)),
        ("<capsule><radius>1</radius><length>3</length></capsule>", (2, 2, 5)),
        ("<ellipsoid><radii>1 2 3</radii></ellipsoid>", (2, 4, 6)),
        ("<plane><normal>0 0 1</normal><size>3 4</size></plane>", (22_000, 22_000, 0)),
    ],
)
def test_geometry_of_collisions(read_text, geometry, extents):
    np.testing.assert_array_equal(read_text(model_of(geometry)).bodies[0].mesh.extents, extents)


def test_heightmap_and_scaled_mesh_beside_the_file(tmp_path, read_text):
    cv2.imwrite(str(tmp_path / "h.png"), np.array([[255, 0], [0, 0]], np.uint8))
    trimesh.creation.box((1, 1, 1)).export(tmp_path / "box.stl")
    field = "<heightmap><uri>h.png</uri><size>4 4 2</size><pos>1 0 0</pos></heightmap>"
    mesh = "<mesh><uri>file://box.stl</uri><scale>1 2 -3</scale></mesh>"
    floor, box = read_text(model_of(field, "floor") + model_of(mesh, "box")).bodies
    top = floor.mesh.vertices[floor.mesh.vertices[:, 2].argmax()]
    np.testing.assert_array_equal(top, [-1, 2, 2])
    np.testing.assert_array_equal(box.mesh.extents, [1, 2, 3])
    assert box.mesh.volume == pytest.approx(6, rel=ROUNDING)


@pytest.mark.parametrize("scale", ["", "<scale>0.5 0.5 0.5</scale>"])
def test_models_of_one_mesh_share_it(tmp_path, read_text, scale):
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
    *small, other = read_text(
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


def test_an_elevation_model_keeps_its_heights_and_needs_a_size(tmp_path, read_text):
    """A world as of gz-sim's tutorial on elevation models: `<size>` z is maximum - minimum, `<pos>` z - maximum."""
    cv2.imwrite(str(tmp_path / "dem.tif"), np.array([[1213.5, 2000], [2000, 2695]], np.float32))
    field = "<heightmap><uri>dem.tif</uri>{}<pos>0 0 -2695</pos></heightmap>"
    (body,) = read_text(model_of(field.format("<size>3793 3563 1481.5</size>"))).bodies
    np.testing.assert_array_equal(body.mesh.bounds, [[-1896.5, -1781.5, -1481.5], [1896.5, 1781.5, 0]])
    _, texts = read_warned(tmp_path, model_of(field.format("")))
    assert texts == [
        "height maps without <size> are 1 m wide and long, which is SDF's default: "
        "world/model[m]/link[link]/collision[c]/geometry/heightmap"
    ]


def test_a_glb_named_by_sdf_is_not_turned(tmp_path, read_text):
    trimesh.creation.box((1, 2, 3)).export(tmp_path / "box.glb")
    (body,) = read_text(model_of("<mesh><uri>box.glb</uri></mesh>")).bodies
    np.testing.assert_array_equal(body.mesh.extents, [1, 2, 3])


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
def test_shapes_have_sdfs_own_defaults(read_text, geometry, low, high):
    """The values of SDF's specification, http://sdformat.org/spec?elem=geometry."""
    (body,) = read_text(model_of(geometry)).bodies
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
def test_a_submesh_lies_where_it_is_in_its_file_unless_it_is_to_be_centred(
    tmp_path, read_text, center, middle
):
    scene = trimesh.Scene()
    scene.add_geometry(trimesh.creation.box((1, 1, 1)), node_name="near", geom_name="one")
    scene.add_geometry(
        trimesh.creation.box((2, 2, 2)), node_name="far", geom_name="two", transform=sg.pose(5)
    )
    scene.export(tmp_path / "a.glb")
    geometry = f"<mesh><uri>a.glb</uri><submesh><name>far</name>{center}</submesh></mesh>"
    (body,) = read_text(model_of(geometry)).bodies
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
def test_the_plane_of_a_visual_is_as_large_as_stated_or_a_square_metre(read_text, tags, extents):
    """SDF's default size of a plane is 1 1; that of a collision is infinite."""
    visual = f"<visual name='v'><geometry><plane>{tags}</plane></geometry>{RETRO}</visual>"
    (body,) = read_text(model(link(shape=visual))).bodies
    half = np.divide(extents, 2)
    np.testing.assert_allclose(body.mesh.bounds, [-half, half], rtol=0, atol=ROUNDING)


@pytest.mark.parametrize(
    ("specular", "n_bodies"), [("", 1), ("<sonar_gl:specular>0.2</sonar_gl:specular>", 2)]
)
def test_the_roughness_of_shapes_without_a_lobe_divides_no_link(read_text, specular, n_bodies):
    """Only the width of a lobe would differ."""
    shapes = "".join(
        f"<collision name='c{k}'><geometry><box/></geometry>{RETRO}{specular}"
        f"<sonar_gl:roughness>{roughness}</sonar_gl:roughness></collision>"
        for k, roughness in enumerate((0.1, 0.2))
    )
    assert len(read_text(model(link(shape=shapes))).bodies) == n_bodies


@pytest.mark.parametrize(
    ("points", "count"), [(["0 0", "1 0"], 2), (["0 0", "1 0", "1 0", "0 0"], 2), (["1 2"] * 5, 0)]
)
def test_a_polyline_of_fewer_than_three_different_points_is_refused(read_text, points, count):
    """Points that follow one another in one place count once; the last one is followed by the first."""
    line = "".join(f"<point>{point}</point>" for point in points)
    with pytest.raises(Error, match=rf"polyline: must have three different points or more \(got {count}\)$"):
        read_text(model_of(f"<polyline>{line}</polyline>"))


def test_polylines_within_others_are_holes(read_text):
    """A square ring of area 16 − 4 with a square of 0.25 in its hole, and a triangle beside it; the senses differ."""
    rings = (
        "<point>0 0</point><point>4 0</point><point>4 4</point><point>0 4</point><point>0 0</point>",
        "<point>1 1</point><point>1 3</point><point>3 3</point><point>3 1</point>",
        "<point>9 0</point><point>9 1</point><point>8 0</point>",
    )
    lines = "".join(f"<polyline><height>0.5</height>{points}</polyline>" for points in rings)
    (body,) = read_text(model_of(lines)).bodies
    assert body.mesh.volume == pytest.approx(0.5 * (16 - 4 + 0.5), rel=ROUNDING)
    assert body.mesh.area == pytest.approx(2 * 12.5 + 0.5 * (16 + 8 + 2 + np.sqrt(2)), rel=ROUNDING)


def test_submeshes_are_found_without_prefix_and_in_any_case(tmp_path, read_text):
    parts = {"geom-Steering_Wheel": (1, 1, 1), "geom-Wheel": (2, 2, 2), "Wheel": (3, 3, 3)}
    scene = trimesh.Scene({name: trimesh.creation.box(size) for name, size in parts.items()})
    (tmp_path / "car.glb").write_bytes(scene.export(file_type="glb"))

    def size(name):
        mesh = f"<mesh><uri>car.glb</uri><submesh><name>{name}</name></submesh></mesh>"
        (body,) = read_text(model_of(mesh)).bodies
        return np.ptp(body.surface.vertices, axis=0).max()

    assert [size(name) for name in ("Steering_Wheel", "steering_wheel", "Wheel")] == [1, 1, 3]
    assert size("geom-wheel") == 2
    with pytest.raises(Error, match="no submesh 'teering_Wheel'"):
        size("teering_Wheel")


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


def test_a_mesh_scaled_by_zero_is_refused(tmp_path, message_of):
    (tmp_path / "b.stl").write_text("")
    mesh = "<geometry><mesh><uri>b.stl</uri><scale>1 0 1</scale></mesh></geometry>"
    assert message_of(model(link(shape=shape(geometry=mesh)))) == (
        "a.sdf: world/model[m]/link[link]/collision[c]/geometry/mesh/scale: must not be zero (got '1 0 1')"
    )


def test_extensions_in_visuals_alone_make_visuals_the_body(read_text):
    both = shape("", "a") + shape("<sonar_gl:material>rock</sonar_gl:material>", "b", "visual", BALL)
    (body,) = read_text(model(link(shape=both))).bodies
    assert body.material == "rock"
    assert len(body.surface.faces) > 12


def test_shapes_with_other_lobes_are_separate_bodies(read_text):
    steel, rock = (f"<sonar_gl:material>{name}</sonar_gl:material>" for name in ("steel", "rock"))
    shapes = shape(steel, "a") + shape(rock, "b", geometry=BALL) + shape(RETRO, "c") + shape(steel, "d")
    bodies = read_text(model(link(shape=shapes))).bodies
    assert [(one.name, one.material) for one in bodies] == [("m", "steel"), ("m::b", None)]
    assert len(bodies[0].surface.faces) == 24
    # neither rock nor <laser_retro> has a lobe, so they are one body, with one reflectivity per face
    assert bodies[1].specular == 0
    assert sorted(set(bodies[1].reflectivity)) == [material("rock").reflectivity, 1.0]


def test_a_reflectivity_map_is_applied_from_above(read_text, tmp_path):
    image = np.array([[255, 0], [51, 102]], np.uint8)
    cv2.imwrite(str(tmp_path / "map.png"), image)
    plane = "<geometry><plane><normal>0 0 1</normal><size>4 4</size></plane></geometry>"
    image_tag = "<sonar_gl:reflectivity_map>map.png</sonar_gl:reflectivity_map>"
    (body,) = read_text(
        model(link("<pose>10 0 0 0 0 0</pose>", shape=shape(image_tag, "c", "visual", plane)))
    ).bodies
    x, y, _ = body.surface.vertices[body.surface.faces].mean(axis=1).T
    # first row at the highest y, first column at the lowest x, as in a height map
    np.testing.assert_allclose(
        body.reflectivity, image[(y < 0).astype(int), (x > 10).astype(int)] / 255, rtol=ROUNDING
    )
    np.testing.assert_array_equal(body.pose, np.eye(4))


def test_a_shape_with_a_map_beside_one_without(read_text, tmp_path):
    cv2.imwrite(str(tmp_path / "map.png"), np.array([[255, 0]], np.uint8))
    image_tag = "<sonar_gl:reflectivity_map>map.png</sonar_gl:reflectivity_map>"
    shapes = shape(image_tag, "a", geometry=BALL) + shape("<laser_retro>51</laser_retro>", "b")
    (body,) = read_text(model(link(shape=shapes))).bodies
    assert len(body.reflectivity) == len(body.surface.faces)
    assert (body.reflectivity[-12:] == 0.2).all()
    assert {0.0, 1.0} <= set(body.reflectivity[:-12])


def test_a_map_on_an_infinite_plane_is_refused(message_of):
    image_tag = "<sonar_gl:reflectivity_map>map.png</sonar_gl:reflectivity_map>"
    plane = "<geometry><plane><normal>0 0 1</normal></plane></geometry>"
    assert "the plane of a collision is infinite" in message_of(
        model(link(shape=shape(image_tag, geometry=plane)))
    )


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


def test_other_tags_of_shapes_give_no_warning(read_text):
    assert len(read_text(model_of("<box><size>1 2 3</size><sizes>x</sizes><texture/></box>")).bodies) == 1
