"""A host's textures as arrays, read in its own context."""

from __future__ import annotations

import numpy as np

from sonar_gl.camera import Camera
from sonar_gl.compiled import compiled
from sonar_gl.foreign import Tenant
from sonar_gl.types import Error

TEXTURE_2D, WIDTH, HEIGHT = 0x0DE1, 0x1000, 0x1001
PACK_ALIGNMENT = 0x0D05
HOLDS = "z-buffer", "planar", "range"
UPSIDE = np.float32([1, -1, -1])  # optical axes from OpenGL's, and back
# format, type and array of what is asked for
KINDS = {
    "z-buffer": (0x1902, 0x1406, np.float32, 1),  # GL_DEPTH_COMPONENT
    "metres": (0x1903, 0x1406, np.float32, 1),  # GL_RED
    "normals": (0x1908, 0x1406, np.float32, 4),  # GL_RGBA, which drivers need not convert
    "numbers": (0x8D94, 0x1405, np.uint32, 1),  # GL_RED_INTEGER
}


def read_images(tenant: Tenant, depth, projection, holds, zero_to_one, rotation, normals, body_id):
    """Cameras, and (depth, normals, body_id) as lists of arrays, or None; see `Sensor.ping_from_textures`."""
    if holds not in HOLDS:
        raise Error(f"holds must be one of {', '.join(map(repr, HOLDS))} (got {holds!r})")
    several = isinstance(depth, (list, tuple))
    n, columns = len(depth) if several else 1, []
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
            raise Error(f"{what} must be a list of as many as depth has (got {value!r} for {n})")
        columns.append(value)
    kind = "z-buffer" if holds == "z-buffer" else "metres"
    wanted = [
        one
        for z, _, _, normal, number in zip(*columns, strict=True)
        for one in ((z, kind, "depth"), (normal, "normals", "normals"), (number, "numbers", "body_id"))
    ]
    arrays = iter(read_all(tenant, wanted))
    cameras, images = [], ([], [], [])
    for _, matrix, turn, *_ in zip(*columns, strict=True):
        seen, normal, number = next(arrays), next(arrays), next(arrays)
        camera = Camera.of_projection(matrix, *seen.shape[::-1], turn)
        if holds == "z-buffer":
            seen = metres_ahead(seen, np.asarray(matrix, np.float64), zero_to_one)
        cameras.append(camera)
        images[0].append(seen)
        images[1].append(None if normal is None else normal[..., :3] * UPSIDE)
        images[2].append(number)
    made = [None if all(one is None for one in column) else column for column in images]
    return cameras, made


def read_all(tenant: Tenant, wanted) -> list:
    """Arrays of textures, first row on top.

    Parameters
    ----------
    wanted : (name, kind of KINDS, what to call it in errors) of each; None for a name gives None

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
        gl.glPixelStorei(PACK_ALIGNMENT, 1)
        for name, kind, what in wanted:
            out.append(None if name is None else _read(gl, name, kind, what))
    return out


def _read(gl, name, kind: str, what: str) -> np.ndarray:
    is_number = isinstance(name, (int, np.integer)) and not isinstance(name, bool)
    if not (is_number and 0 < name < 1 << 32 and gl.glIsTexture(int(name))):
        raise Error(f"{what} must be the GL name of a texture in the host's context (got {name!r})")
    gl.glBindTexture(TEXTURE_2D, int(name))
    if gl.take_errors():
        raise Error(
            f"{what} must be a plain 2D texture (got texture {name} of another target; resolve samples first)"
        )
    size = np.zeros(2, np.int32)
    for k, side in enumerate((HEIGHT, WIDTH)):
        gl.glGetTexLevelParameteriv(TEXTURE_2D, 0, side, size[k:].ctypes.data)
    layout, numbers, dtype, components = KINDS[kind]
    shape = (*size.tolist(), components) if components > 1 else tuple(size.tolist())
    out = np.zeros(shape, dtype)
    if out.size:
        gl.glGetTexImage(TEXTURE_2D, 0, layout, numbers, out.ctypes.data)
    if gl.take_errors() or not out.size:
        raise Error(f"{what} must hold {kind} (got texture {name} of {shape[1]} by {shape[0]} that does not)")
    return out[::-1]


def metres_ahead(z_buffer, projection, zero_to_one: bool = False) -> np.ndarray:
    """What a z-buffer tells, as (H, W) float32 metres along the camera's axis; 0 where nothing was drawn.

    Parameters
    ----------
    z_buffer : (H, W) float32, 0..1
    projection : (4, 4) OpenGL clip_from_camera, any perspective: near and far in either order, or no far
    zero_to_one : the host set glClipControl to GL_ZERO_TO_ONE
    """
    out = np.zeros(z_buffer.shape, np.float32)
    # clip z = a z + b and w = -z, with z < 0 ahead: z over w, in -1..1 or 0..1, is -a - b/z
    a, b = float(projection[2, 2]), float(projection[2, 3])
    _undo(np.asarray(z_buffer, np.float32), a, b, bool(zero_to_one), out)
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
