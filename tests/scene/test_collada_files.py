"""Geometry of COLLADA files that trimesh leaves out without a word."""

import warnings

import pytest

import sonar_gl as sg
from sonar_gl.core.errors import Error
from sonar_gl.scene.extent import bounds_of
from sonar_gl.scene.load import load_scene

GEOMETRY = """<geometry id="{name}"><mesh><source id="{name}-p">
<float_array id="{name}-a" count="{count}">0 0 0 1 0 0 0 2 0</float_array>
<technique_common><accessor source="#{name}-a" count="3" stride="3"><param name="X" type="float"/>
<param name="Y" type="float"/><param name="Z" type="float"/></accessor></technique_common></source>
<vertices id="{name}-v"><input semantic="POSITION" source="#{name}-p"/></vertices>
<triangles count="1" material="mm"><input semantic="VERTEX" source="#{name}-v" offset="0"/><p>0 1 2</p></triangles>
</mesh></geometry>"""
# the picture of the effect is not in <library_images>
PAINTED = """<library_effects><effect id="e"><profile_COMMON>
<newparam sid="s"><surface type="2D"><init_from>no_such_image</init_from></surface></newparam>
<newparam sid="t"><sampler2D><source>s</source></sampler2D></newparam>
<technique sid="c"><phong><diffuse><texture texture="t" texcoord="UV"/></diffuse></phong></technique>
</profile_COMMON></effect></library_effects>
<library_materials><material id="m"><instance_effect url="#e"/></material></library_materials>"""
BIND = """<bind_material><technique_common><instance_material symbol="mm" target="#m"/></technique_common>
</bind_material>"""
SKIN = """<controller id="{name}"><skin source="#{source}"><bind_shape_matrix>{matrix}</bind_shape_matrix>
<joints/><vertex_weights count="0"/></skin></controller>"""
TURNED = "0 -1 0 0 1 0 0 0 0 0 1 7 0 0 0 1"  # a quarter to the left, and 7 up


@pytest.fixture
def read(tmp_path):
    """Return what a file of these libraries and nodes holds: the bounds of its bodies, and the warnings."""

    def bounds(libraries, *nodes):
        path = tmp_path / "a.dae"
        scene = f'<library_visual_scenes><visual_scene id="w">{"".join(nodes)}</visual_scene></library_visual_scenes>'
        path.write_text(
            '<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">'
            f'<asset><unit meter="1"/></asset>{libraries}{scene}'
            '<scene><instance_visual_scene url="#w"/></scene></COLLADA>'
        )
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            bodies = load_scene(path).bodies
        found = [bounds_of([body]) for body in bodies]
        # libraries warn of what others of them will drop
        own = [str(one.message) for one in caught if one.category is UserWarning]
        *said, last = [text.removeprefix(f"{path}: ") for text in own]
        assert last.startswith("a mesh file states no reflectivity; ")
        return found, said

    return bounds


def geometries(*names):
    return (
        f"<library_geometries>{''.join(GEOMETRY.format(name=n, count=9) for n in names)}</library_geometries>"
    )


def test_a_geometry_stays_whose_material_cannot_be_read(read):
    node = f'<node><translate>0 0 5</translate><instance_geometry url="#g">{BIND}</instance_geometry></node>'
    (bounds,), said = read(PAINTED + geometries("g"), node, '<node><instance_light url="#none"/></node>')
    assert bounds.tolist() == [[0, 0, 5], [1, 2, 5]] and said == []


def test_a_skinned_mesh_is_read_in_the_shape_that_its_bones_are_bound_to(read):
    controllers = (
        f"<library_controllers>{SKIN.format(name='c', source='g', matrix=TURNED)}"
        f"{SKIN.format(name='d', source='c', matrix='')}</library_controllers>"
    )
    plain = '<node><instance_geometry url="#h"/></node>'
    nodes = [
        f'<node><translate>0 0 {z}</translate><instance_controller url="#{name}">{BIND}</instance_controller></node>'
        for name, z in (("c", 5), ("d", 10))
    ]
    found, said = read(PAINTED + geometries("g", "h") + controllers, plain, *nodes)
    assert [bounds.tolist() for bounds in found] == [
        [[0, 0, 0], [1, 2, 0]],
        [[-2, 0, 12], [0, 1, 12]],
        [[-2, 0, 17], [0, 1, 17]],
    ]
    assert said == ["2 skinned meshes are read without the pose of the bones"]


def test_controllers_that_lead_nowhere_are_told(read):
    controllers = (
        f"<library_controllers>{SKIN.format(name='c', source='c', matrix=TURNED)}</library_controllers>"
    )
    nodes = '<node><instance_geometry url="#g"/></node>', '<node><instance_controller url="#c"/></node>'
    found, said = read(geometries("g") + controllers, *nodes)
    assert len(found) == 1
    assert said[0].startswith("read without what is broken in it (")


def test_what_is_broken_is_told(read):
    libraries = geometries("g").replace("</library_geometries>", "") + GEOMETRY.format(name="h", count=8)
    libraries = libraries.replace('count="8">0 0 0 1 0 0 0 2 0', 'count="8">0 0 0 1 0 0 0 2 x')
    nodes = [f'<node><instance_geometry url="#{name}"/></node>' for name in "gh"]
    found, said = read(libraries + "</library_geometries>", *nodes)
    assert len(found) == 1
    (message,) = said  # in brackets stand words of NumPy before 2, else of pycollada
    assert message.startswith("read without what is broken in it (") and message.endswith(")")


def test_nodes_that_multiply_one_another_are_refused_before_they_are_placed(read):
    """Ten nodes that each hold the next ten times would place a milliard geometries, of a file of 3 kB."""

    def chain(length):
        ten = [f"<instance_node url='#n{k + 1}'/>" * 10 for k in range(length)]
        inner = [*ten, "<instance_geometry url='#a'/>"]
        nodes = "".join(f"<node id='n{k}'>{content}</node>" for k, content in enumerate(inner))
        return f"<library_nodes>{nodes}</library_nodes>"

    bounds, _ = read(geometries("a") + chain(2), '<node><instance_node url="#n0"/></node>')
    assert len(bounds) == 100
    with pytest.raises(
        sg.Error, match=r"place at most 65535 geometries \(got 1000000000; nodes that hold others"
    ):
        read(geometries("a") + chain(9), '<node><instance_node url="#n0"/></node>')


@pytest.mark.parametrize("kind", ["lookat", "skew"])
def test_transforms_that_are_not_read_are_refused_where_they_place_geometry(read, kind):
    transform = f"<{kind}>{'30 1 0 0 0 1 0' if kind == 'skew' else '0 0 5 1 0 5 0 0 1'}</{kind}>"
    plain, camera = (
        '<node><instance_geometry url="#g"/></node>',
        f'<node>{transform}<instance_camera url="#c"/></node>',
    )
    (bounds,), said = read(geometries("g"), plain, camera)
    assert bounds.tolist() == [[0, 0, 0], [1, 2, 0]] and said == []
    with pytest.raises(sg.Error, match=rf"a\.dae: node 'arm': <{kind}> is not supported .*write a <matrix>"):
        read(geometries("g"), f'<node id="n" name="arm">{transform}{plain}</node>')


def test_polygons_with_holes_are_refused(read):
    """The parser reads the others alone, which may be none."""
    holed = "<polygons count='1'><ph><p>0 1 2</p><h>0 1 2</h></ph></polygons></mesh>"
    library, node = geometries("g").replace("</mesh>", holed), '<node><instance_geometry url="#g"/></node>'
    with pytest.raises(
        sg.Error, match=r"a\.dae: geometry 'g': polygons must have no holes \(got <ph>; triangulate"
    ):
        read(library, node)


def test_a_file_without_a_scene_is_an_error_that_says_so(tmp_path):
    path = tmp_path / "a.dae"
    path.write_text(
        '<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1"><asset/>'
        f"{geometries('a')}</COLLADA>"
    )
    with pytest.raises(Error, match=r"a\.dae: a COLLADA file must place its geometries by a <scene> "):
        load_scene(path)
