"""The tags of this simulator in SDF."""

import warnings
import xml.etree.ElementTree as ElementTree

import pytest

from sonar_gl.scene.materials import material
from sonar_gl.scene.sdf import extensions
from sonar_gl.scene.sdf.reader import read_sdf
from tests.support.sdf_texts import link, model, shape, write

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


def test_single_properties_override_the_material(read_text):
    tags = (
        "<sonar_gl:material>steel</sonar_gl:material><laser_retro>51</laser_retro>"
        "<sonar_gl:specular>0.25</sonar_gl:specular><sonar_gl:roughness>0.3</sonar_gl:roughness>"
    )
    (body,) = read_text(model(link(shape=shape(tags)))).bodies
    assert (body.reflectivity, body.specular, body.roughness_rad) == (0.2, 0.25, 0.3)
    assert body.material == "steel"


@pytest.mark.parametrize(
    ("tags", "words"),
    [
        ("<sonar_gl:material>steal</sonar_gl:material>", "/sonar_gl:material: unknown material"),
        ("<sonar_gl:material/>", "/sonar_gl:material: unknown material (got ''; known are "),
        ("<sonar_gl:matter>x</sonar_gl:matter>", ": unknown tag (got 'sonar_gl:matter';"),
        ("<sonar_gl:specular>2</sonar_gl:specular>", "/sonar_gl:specular: must lie in 0..1 (got 2)"),
        ("<sonar_gl:specular>a</sonar_gl:specular>", "/sonar_gl:specular: must be 1 finite number (got 'a')"),
        ("<sonar_gl:roughness>9</sonar_gl:roughness>", "/sonar_gl:roughness: must lie in 0.01..0.5 (got 9)"),
        ("<sonar_gl:reflectivity_map>a.sdf</sonar_gl:reflectivity_map>", "/sonar_gl:reflectivity_map: a.sdf"),
        ("<sonar_gl:reflectivity_map>b.png</sonar_gl:reflectivity_map>", "models or files are missing:"),
        ("<sonar_gl:reflectivity_map/>", "/sonar_gl:reflectivity_map: must name a file or a model (got '')"),
    ],
)
def test_invalid_extensions(message_of, tags, words):
    text = message_of(model(link(shape=shape(tags))))
    assert words in text
    assert "models or files" in words or "world/model[m]/link[link]/collision[c]" in text


def test_extensions_are_found_by_name():
    xml = extensions.declare_namespace(b"<sdf a='1'><sonar_gl:surface/><surface/></sdf>")
    root = ElementTree.fromstring(xml)
    assert extensions.find_extension(root, "surface") is root[0]
    assert extensions.find_extension(root, "floor") is None
    assert extensions.list_extensions(root) == [root[0]]
