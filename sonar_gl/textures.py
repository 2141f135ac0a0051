"""A host's textures as arrays, read in its own context."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sonar_gl.camera import Camera, check_projection
from sonar_gl.compiled import compiled
from sonar_gl.depth_images import HOLDS as DEPTHS
from sonar_gl.foreign import Tenant
from sonar_gl.types import Error, frozen_array

TEXTURE_2D, WIDTH, HEIGHT = 0x0DE1, 0x1000, 0x1001
RED_TYPE, BLUE_TYPE, DEPTH_TYPE = 0x8C10, 0x8C12, 0x8C16
FLOAT, SIGNED, UNSIGNED, INTEGER, UNSIGNED_INTEGER = 0x1406, 0x8F9C, 0x8C17, 0x1404, 0x1405
TYPES = {
    0: "nothing of the kind",
    FLOAT: "floats",
    SIGNED: "signed fractions",
    UNSIGNED: "unsigned fractions",
    INTEGER: "integers",
    UNSIGNED_INTEGER: "unsigned integers",
}
HOLDS = "z-buffer", *DEPTHS
UPSIDE = np.float32([1, -1, -1])  # optical axes from OpenGL's, and back


class Kind(NamedTuple):
    """What a texture must hold, and how it is read."""

    wanted: str
    channel: int  # whose type is looked at
    types: tuple
    layout: int
    numbers: int
    dtype: type
    components: int = 1


KINDS = {
    "z-buffer": Kind("a z-buffer", DEPTH_TYPE, (FLOAT, UNSIGNED), 0x1902, FLOAT, np.float32),
    "metres": Kind("metres, as floats in red", RED_TYPE, (FLOAT,), 0x1903, FLOAT, np.float32),
    # read as RGBA, which drivers need not convert
    "normals": Kind("x y z of normals, signed", BLUE_TYPE, (FLOAT, SIGNED), 0x1908, FLOAT, np.float32, 4),
    "numbers": Kind("whole numbers in red", RED_TYPE, (INTEGER, UNSIGNED_INTEGER), 0x8D94, 0x1405, np.uint32),
}


def read_images(tenant: Tenant, depth, projection, holds, zero_to_one, rotation, normals, body_id):
    """Cameras, depth, normals and body_id for `Sensor.ping_from_textures`: lists, or one of each."""
    if not isinstance(holds, str) or holds not in HOLDS:
        raise Error(f"holds must be one of {', '.join(map(repr, HOLDS))} (got {holds!r})")
    several = isinstance(depth, (list, tuple))
    n, columns = len(depth) if several else 1, []
    if n == 0:
        raise Error("depth must be the name of a texture, or a list of at least one (got an empty list)")
    for what, value in (
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
            raise Error(f"{what} must be a list of as many as depth has, {n} (got {got})")
        columns.append(value)
    kind = "z-buffer" if holds == "z-buffer" else "metres"
    wanted = [
        one
        for z, _, _, normal, number in zip(*columns, strict=True)
        for one in ((z, kind, "depth"), (normal, "normals", "normals"), (number, "numbers", "body_id"))
    ]
    arrays = iter(read_all(tenant, wanted))
    images = [], [], [], []
    for matrix, turn in zip(columns[1], columns[2], strict=True):
        seen, normal, number = next(arrays), next(arrays), next(arrays)
        images[0].append(Camera.of_projection(matrix, *seen.shape[::-1], turn))
        images[1].append(metres_ahead(seen, matrix, zero_to_one) if holds == "z-buffer" else seen)
        images[2].append(None if normal is None else normal[..., :3] * UPSIDE)
        images[3].append(number)
    if not several:
        return tuple(column[0] for column in images)
    return tuple(None if column[0] is None else column for column in images)


def read_all(tenant: Tenant, wanted) -> list:
    """Arrays of textures, first row on top.

    Parameters
    ----------
    wanted : (name, kind of KINDS, what to call it in errors) of each; None for a name, but that of depth,
        gives None

    Returns
    -------
    (H, W), or (H, W, 4) of normals

    Raises
    ------
    Error
        if one is no 2D texture, or does not hold that kind.
    """
    gl, out = tenant.gl, []
    with tenant:
        for name, kind, what in wanted:
            skipped = name is None and what != "depth"
            out.append(None if skipped else _read(gl, name, KINDS[kind], what))
    return out


def _read(gl, name, kind: Kind, what: str) -> np.ndarray:
    is_number = isinstance(name, (int, np.integer)) and not isinstance(name, bool)
    if not (is_number and 0 < name < 1 << 32 and gl.glIsTexture(int(name))):
        cure = "; give its .glo" if hasattr(name, "glo") else ""
        got = repr(name) if is_number or isinstance(name, str | None) else type(name).__name__
        raise Error(f"{what} must be the GL name of a texture in the host's context (got {got}{cure})")
    gl.glBindTexture(TEXTURE_2D, int(name))
    if gl.take_errors():
        raise Error(
            f"{what} must be a plain 2D texture (got texture {name} of another target; resolve samples first)"
        )
    found = np.zeros(3, np.int32)
    for k, parameter in enumerate((HEIGHT, WIDTH, kind.channel)):
        gl.glGetTexLevelParameteriv(TEXTURE_2D, 0, parameter, found[k:].ctypes.data)
    *size, held = found.tolist()
    if held not in kind.types or not all(size):
        cure = "; decode n * 2 - 1 into floats" if held == UNSIGNED and kind is KINDS["normals"] else ""
        held = TYPES.get(held, f"type 0x{held:04x}") if all(size) else "no size"
        raise Error(f"{what} must hold {kind.wanted} (got texture {name} with {held} there{cure})")
    out = np.zeros((*size, kind.components) if kind.components > 1 else size, kind.dtype)
    gl.glGetTexImage(TEXTURE_2D, 0, kind.layout, kind.numbers, out.ctypes.data)
    return out[::-1]


def metres_ahead(z_buffer, projection, zero_to_one: bool = False) -> np.ndarray:
    """What a z-buffer tells, as (H, W) float32 metres along the camera's axis; 0 where nothing was drawn.

    Parameters
    ----------
    z_buffer : (H, W) float, 0..1, as read with GL_DEPTH_COMPONENT
    projection : (4, 4) OpenGL clip_from_camera, any perspective: near and far in either order, or no far
    zero_to_one : the host set glClipControl to GL_ZERO_TO_ONE

    Raises
    ------
    Error
        if there is no such image, or no such projection.
    """
    z_buffer = frozen_array(z_buffer, np.float32, (None, None), "z_buffer")
    projection = check_projection(projection)
    if projection[2, 0] or projection[2, 1]:
        raise Error(
            "the projection of a z-buffer must have its near plane across the view (got "
            f"{projection[2].tolist()} for its third row; hand over metres instead)"
        )
    out = np.zeros(z_buffer.shape, np.float32)
    # clip z = a z + b and w = -z, with z < 0 ahead: z over w, in -1..1 or 0..1, is -a - b/z
    a, b = float(projection[2, 2]), float(projection[2, 3])
    _undo(z_buffer, a, b, bool(zero_to_one), out)
    return out


@compiled
def _undo(z_buffer, a, b, zero_to_one, out):
    for j in range(z_buffer.shape[0]):
        for i in range(z_buffer.shape[1]):
            z = np.float64(z_buffer[j, i])
            # cleared to what is furthest, whichever end of the range that is
            is_cleared = z >= 1.0 if b < 0.0 else z <= 0.0
            ahead = b / ((z if zero_to_one else 2.0 * z - 1.0) + a)
            out[j, i] = ahead if not is_cleared and 0.0 < ahead < 1e30 else 0.0
