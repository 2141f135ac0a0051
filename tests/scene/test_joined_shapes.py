"""What keeps the shapes of a link apart."""

import dataclasses

import sonar_gl as sg
from sonar_gl.scene.joined_shapes import SurfaceKind


def test_each_property_of_a_whole_surface_keeps_shapes_apart():
    """Shapes of one link that differed in a property that SurfaceKind lacked would be one body, without it."""
    of_each_shape = {"name", "mesh", "pose", "reflectivity", "normals", "material"}
    properties = {field.name for field in dataclasses.fields(sg.Body) if field.init} - of_each_shape
    assert properties == set(SurfaceKind._fields), (
        "add what a body has to SurfaceKind, and to what readers make of it"
    )
