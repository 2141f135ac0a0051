"""A scene in Embree, through its C interface: coherent packets of eight rays, the fastest that it offers.

The library is that of `embreex`. A ray takes a third to four fifths of the time that it takes through
`embreex`, and holds no lock, so that two threads can trace.
"""

from __future__ import annotations

import ctypes
import glob
import os
import struct
from functools import lru_cache

import embreex
import llvmlite.binding
import numpy as np
from numba import types

from sonar_gl.core.compiled import compiled

PACKET = 8
_WORDS = 21 * PACKET  # of RTCRayHit8: twelve fields of a ray, nine of a hit
_folder = os.path.join(os.path.dirname(os.path.dirname(embreex.__file__)), "embreex.libs")
LIBRARY = next(iter(glob.glob(os.path.join(_folder, "libembree4*"))), None)
if LIBRARY is None:
    raise ImportError(f"Embree's library must lie in {_folder} (got none); install embreex by pip")
llvmlite.binding.load_library_permanently(LIBRARY)
_pointer = types.uint64
_intersect = types.ExternalFunction("rtcIntersect8", types.void(_pointer, _pointer, _pointer, _pointer))


def make_packet() -> np.ndarray:
    """Return (words,) uint32 on a cache line: a packet, then the mask that enables all rays."""
    raw = np.zeros(_WORDS + PACKET + 16, np.uint32)
    start = -raw.ctypes.data % 64 // 4
    out = raw[start : start + _WORDS + PACKET]
    out[_WORDS:] = 0xFFFFFFFF
    return out


@compiled
def trace(scene, arguments, packet, rays, rotation, origin, far, first, last, length, face):
    """Find the nearest faces that rays meet.

    Parameters
    ----------
    scene, arguments : addresses of RTCScene and RTCIntersectArguments; packet : of `make_packet`
    rays : (N, 3) float32, N a multiple of eight, neighbours side by side; rotation, origin : scene from rays
    far, length : (N,) float32, in lengths of the ray; face : (N,) int32, -1 for none
    first, last : which rays, multiples of eight
    """
    f, address = packet.view(np.float32), packet.ctypes.data
    for i in range(first, last, 8):
        for k in range(8):
            x, y, z = rays[i + k, 0], rays[i + k, 1], rays[i + k, 2]
            for axis in range(3):
                f[8 * axis + k] = origin[axis]
                f[32 + 8 * axis + k] = rotation[axis, 0] * x + rotation[axis, 1] * y + rotation[axis, 2] * z
            f[24 + k] = 1e-3  # the near plane, as ours
            f[56 + k] = 0.0
            f[64 + k] = far
            packet[72 + k] = 0xFFFFFFFF  # mask
            packet[88 + k] = 0  # flags
            packet[136 + k] = 0xFFFFFFFF  # face
            packet[144 + k] = 0xFFFFFFFF  # geometry: no hit yet
        _intersect(address + 4 * 168, scene, address, arguments)
        for k in range(8):
            length[i + k] = f[64 + k]
            face[i + k] = np.int32(packet[136 + k])


class Embree:
    """A scene in Embree, in the frame of the sonar's first pose, built once at the best quality."""

    def __init__(self, scene, pose):
        self.inverse = np.linalg.inv(pose)
        library = ctypes.CDLL(LIBRARY)
        pointer, number, size = ctypes.c_void_p, ctypes.c_uint, ctypes.c_size_t
        for name, result, arguments in (
            ("rtcNewDevice", pointer, [ctypes.c_char_p]),
            ("rtcNewScene", pointer, [pointer]),
            ("rtcSetSceneBuildQuality", None, [pointer, number]),
            ("rtcNewGeometry", pointer, [pointer, number]),
            ("rtcSetNewGeometryBuffer", pointer, [pointer, number, number, number, size, size]),
            ("rtcCommitGeometry", None, [pointer]),
            ("rtcAttachGeometry", number, [pointer, pointer]),
            ("rtcCommitScene", None, [pointer]),
            ("rtcGetDeviceError", number, [pointer]),
            ("rtcReleaseGeometry", None, [pointer]),
            ("rtcReleaseScene", None, [pointer]),
            ("rtcReleaseDevice", None, [pointer]),
        ):
            function = getattr(library, name)
            function.restype, function.argtypes = result, arguments
        self.library, self.device = library, library.rtcNewDevice(None)
        self.address = library.rtcNewScene(self.device)
        corners = self._corners(scene)
        vertices = np.ascontiguousarray(corners.reshape(-1, 3), np.float32)
        faces = np.arange(len(vertices), dtype=np.uint32)
        library.rtcSetSceneBuildQuality(self.address, 2)  # high
        geometry = library.rtcNewGeometry(self.device, 0)  # triangles
        for kind, layout, array, count in (
            (1, 0x9003, vertices, len(vertices)),
            (0, 0x5003, faces, len(corners)),
        ):
            place = library.rtcSetNewGeometryBuffer(geometry, kind, 0, layout, 12, count)
            ctypes.memmove(place, array.ctypes.data, array.nbytes)
        library.rtcCommitGeometry(geometry)
        library.rtcAttachGeometry(self.address, geometry)
        library.rtcReleaseGeometry(geometry)
        library.rtcCommitScene(self.address)
        if error := library.rtcGetDeviceError(self.device):
            raise RuntimeError(f"Embree failed with error {error}")
        # flags: coherent; all features; no context, no filter, no function
        self._arguments = ctypes.create_string_buffer(struct.pack("IIQQQ", 1 << 16, 0xFFFFFFFF, 0, 0, 0))
        self.arguments = ctypes.addressof(self._arguments)

    def _corners(self, scene) -> np.ndarray:
        """Return (T, 3, 3) corners; set `faces`, (T, 8) float32: normal, distance, μ, body."""
        corners, rest = [], []
        for number, body in enumerate(scene.bodies):
            matrix = self.inverse @ body.pose
            vertices = np.asarray(body.mesh.vertices, np.float64) @ matrix[:3, :3].T + matrix[:3, 3]
            corners.append(vertices[np.asarray(body.mesh.faces)])
            rest.append(np.zeros((len(corners[-1]), 4)))
            rest[-1][:, 0], rest[-1][:, 1] = body.reflectivity, number
        corners = np.concatenate(corners)
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
        distance = (normal * corners[:, 0]).sum(axis=1)
        self.faces = np.column_stack([normal, distance, np.concatenate(rest)[:, :4]]).astype(np.float32)
        return corners

    def place(self, pose) -> tuple[np.ndarray, np.ndarray]:
        """Return rotation (3, 3) and origin (3,), float32, of a pose in the scene's frame."""
        matrix = self.inverse @ pose
        return matrix[:3, :3].copy(), matrix[:3, 3].astype(np.float32)

    def __del__(self):
        self.library.rtcReleaseScene(self.address)
        self.library.rtcReleaseDevice(self.device)


@lru_cache(maxsize=1)
def _cached(scene, pose_bytes) -> Embree:
    return Embree(scene, np.frombuffer(pose_bytes).reshape(4, 4))


def in_embree(scene, pose) -> Embree:
    """Return the scene in Embree; all rivals share it."""
    return _cached(scene, np.ascontiguousarray(pose, np.float64).tobytes())
