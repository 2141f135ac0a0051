"""Read a host's textures as arrays, in the host's own context."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from sonar_gl.core.checks import frozen_array, is_whole_number
from sonar_gl.core.compiled import compiled
from sonar_gl.core.errors import Error
from sonar_gl.embed.camera import Camera, check_projection
from sonar_gl.embed.depth_images import DEPTH_KINDS
from sonar_gl.gl.enums import FLOAT, RED_INTEGER, RGBA, TEXTURE_2D
from sonar_gl.gl.host import HostContext

ROUNDING = 1e-6  # by which a z-buffer that was computed may exceed 0..1
TEXTURE_WIDTH, TEXTURE_HEIGHT = 0x1000, 0x1001
RED_TYPE, BLUE_TYPE, DEPTH_TYPE = 0x8C10, 0x8C12, 0x8C16
SIGNED_NORMALIZED, UNSIGNED_NORMALIZED = 0x8F9C, 0x8C17
INT, UNSIGNED_INT = 0x1404, 0x1405
RED, DEPTH_COMPONENT = 0x1903, 0x1902
TYPE_NAMES = {
    0: "nothing of the kind",
    FLOAT: "floats",
    SIGNED_NORMALIZED: "signed fractions",
    UNSIGNED_NORMALIZED: "unsigned fractions",
    INT: "integers",
    UNSIGNED_INT: "unsigned integers",
}
TEXTURE_DEPTH_KINDS = "z-buffer", *DEPTH_KINDS
OPTICAL_SIGNS = np.float32([1, -1, -1])  # optical axes from OpenGL's: y and z change sign


class TextureFormat(NamedTuple):
    """The contents that a texture must have, and the format in which it is read."""

    description: str  # contents, for error messages
    type_query: int  # GL parameter that returns the type of the channel that matters
    types: tuple  # accepted GL types of that channel
    # pixel_format, pixel_type: arguments of glGetTexImage
    pixel_format: int
    pixel_type: int
    # dtype, components: of the array that is read
    dtype: type
    components: int = 1


FORMATS = {
    "z-buffer": TextureFormat(
        "a z-buffer", DEPTH_TYPE, (FLOAT, UNSIGNED_NORMALIZED), DEPTH_COMPONENT, FLOAT, np.float32
    ),
    "metres": TextureFormat("metres, as floats in red", RED_TYPE, (FLOAT,), RED, FLOAT, np.float32),
    # RGBA, which drivers need not convert
    "normals": TextureFormat(
        "x y z of normals, signed", BLUE_TYPE, (FLOAT, SIGNED_NORMALIZED), RGBA, FLOAT, np.float32, 4
    ),
    "numbers": TextureFormat(
        "whole numbers in red", RED_TYPE, (INT, UNSIGNED_INT), RED_INTEGER, UNSIGNED_INT, np.uint32
    ),
}


def read_images(host: HostContext, depth, projection, holds, zero_to_one, rotation, normals, body_id):
    """Return camera, depth, normals and body_id of `Sensor.ping_from_textures`: one of each, or lists."""
    if not isinstance(holds, str) or holds not in TEXTURE_DEPTH_KINDS:
        raise Error(f"holds must be one of {', '.join(map(repr, TEXTURE_DEPTH_KINDS))} (got {holds!r})")
    several = isinstance(depth, (list, tuple))
    n, columns = len(depth) if several else 1, []
    if n == 0:
        raise Error("depth must be the name of a texture, or a list of at least one (got an empty list)")
    for name, value in (
        ("depth", depth),
        ("projection", projection),
        ("rotation", rotation),
        ("normals", normals),
        ("body_id", body_id),
    ):
        if value is None or not several:
            value = [value] * n
        if not isinstance(value, (list, tuple)) or len(value) != n:
            got = f"{len(value)}" if isinstance(value, (list, tuple)) else type(value).__name__
            raise Error(f"{name} must be a list of as many as depth has, {n} (got {got})")
        columns.append(value)
    kind = "z-buffer" if holds == "z-buffer" else "metres"
    requests = [
        one
        for z, _, _, normal, number in zip(*columns, strict=True)
        for one in ((z, kind, "depth"), (normal, "normals", "normals"), (number, "numbers", "body_id"))
    ]
    arrays = iter(read_textures(host, requests))
    images = [], [], [], []
    for matrix, turn in zip(columns[1], columns[2], strict=True):
        z, normal, number = next(arrays), next(arrays), next(arrays)
        images[0].append(Camera.of_projection(matrix, *z.shape[::-1], turn))
        images[1].append(metres_ahead(z, matrix, zero_to_one) if holds == "z-buffer" else z)
        images[2].append(None if normal is None else normal[..., :3] * OPTICAL_SIGNS)
        images[3].append(number)
    if not several:
        return tuple(column[0] for column in images)
    return tuple(None if column[0] is None else column for column in images)


def read_textures(host: HostContext, requests) -> list:
    """Return textures as (H, W) arrays, (H, W, 4) for normals, first row on top; raise Error if one has another type.

    requests : (GL name, key of FORMATS, name of the argument for error messages) of each texture. A GL name of None
        gives None, except for depth
    """
    gl, out = host.gl, []
    with host:
        for name, key, argument in requests:
            is_omitted = name is None and argument != "depth"
            out.append(None if is_omitted else _read_texture(gl, name, FORMATS[key], argument))
    return out


def _read_texture(gl, name, form: TextureFormat, argument: str) -> np.ndarray:
    """Return one texture as an array; `argument` is its name in error messages."""
    is_whole = is_whole_number(name)
    if not (is_whole and 0 < name < 1 << 32 and gl.glIsTexture(int(name))):
        cure = "; give its .glo" if hasattr(name, "glo") else ""
        got = repr(name) if is_whole or isinstance(name, str | None) else type(name).__name__
        raise Error(f"{argument} must be the GL name of a texture in the host's context (got {got}{cure})")
    gl.glBindTexture(TEXTURE_2D, int(name))
    if gl.take_errors():
        raise Error(
            f"{argument} must be a plain 2D texture (got texture {name} of another target; resolve samples first)"
        )
    properties = np.zeros(3, np.int32)
    for k, parameter in enumerate((TEXTURE_HEIGHT, TEXTURE_WIDTH, form.type_query)):
        gl.glGetTexLevelParameteriv(TEXTURE_2D, 0, parameter, properties[k:].ctypes.data)
    *size, channel_type = properties.tolist()
    if channel_type not in form.types or not all(size):
        is_coded = channel_type == UNSIGNED_NORMALIZED and form is FORMATS["normals"]
        cure = "; decode n * 2 - 1 into floats" if is_coded else ""
        got = TYPE_NAMES.get(channel_type, f"type 0x{channel_type:04x}") if all(size) else "no size"
        raise Error(f"{argument} must hold {form.description} (got texture {name} with {got} there{cure})")
    out = np.zeros((*size, form.components) if form.components > 1 else size, form.dtype)
    gl.glGetTexImage(TEXTURE_2D, 0, form.pixel_format, form.pixel_type, out.ctypes.data)
    return out[::-1]


def metres_ahead(z_buffer: ArrayLike, projection: ArrayLike, zero_to_one: bool = False) -> np.ndarray:
    """Convert a z-buffer to metres along the camera's axis, (H, W) float32; 0 where nothing was drawn.

    Parameters
    ----------
    z_buffer : (H, W) float, 0..1, as read with GL_DEPTH_COMPONENT
    projection : (4, 4) OpenGL clip_from_camera, any perspective, also reversed or with an infinite far plane
    zero_to_one : whether the host set glClipControl to GL_ZERO_TO_ONE

    Raises
    ------
    Error
        if the z-buffer is not an image of 0..1, or the projection is not such a perspective.
    """
    dtype = getattr(z_buffer, "dtype", None)
    if dtype == np.float16:
        raise Error("z_buffer must be in float32 (got float16, whose steps near 1 are metres at a distance)")
    z_buffer = frozen_array(z_buffer, np.float32, (None, None), "z_buffer")
    low, high = (z_buffer.min(), z_buffer.max()) if z_buffer.size else (0, 1)
    if low < -ROUNDING or high > 1 + ROUNDING:
        if high <= 1:
            cure = "make 0..1 of -1..1 by d / 2 + 0.5"
        elif dtype is not None and dtype.kind in "iu":
            cure = "divide whole numbers by the largest of their type"
        else:
            cure = "what holds metres already needs no conversion"
        raise Error(f"z_buffer must lie in 0..1 (got {low:g} to {high:g}; {cure})")
    projection = check_projection(projection)
    if projection[2, 0] or projection[2, 1]:
        raise Error(
            "the projection of a z-buffer must have its near plane across the view (got "
            f"{projection[2].tolist()} for its third row; hand over metres instead)"
        )
    out = np.zeros(z_buffer.shape, np.float32)
    # clip z = a z + b and w = -z, with z < 0 ahead: z over w, in -1..1 or 0..1, is -a - b/z
    a, b = float(projection[2, 2]), float(projection[2, 3])
    _linearize(z_buffer, a, b, bool(zero_to_one), out)
    return out


@compiled
def _linearize(z_buffer, a, b, zero_to_one, out):
    """Fill `out` with metres; see `metres_ahead`."""
    for j in range(z_buffer.shape[0]):
        for i in range(z_buffer.shape[1]):
            z = np.float64(z_buffer[j, i])
            # a cleared pixel holds the depth of the far plane, 1, or 0 in a reversed z-buffer
            is_cleared = z >= 1.0 if b < 0.0 else z <= 0.0
            ahead = b / ((z if zero_to_one else 2.0 * z - 1.0) + a)
            out[j, i] = ahead if not is_cleared and 0.0 < ahead < 1e30 else 0.0
