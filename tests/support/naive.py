"""Naive methods, as a first sonar simulator has them, whose failures the tests measure beside ours.

Those that draw are our own simulator with one of its remedies removed.
"""

import math
import os
import tempfile
from contextlib import contextmanager
from pathlib import Path
from unittest import mock

import numpy as np

import sonar_gl as sg
from sonar_gl.raster import scene_meshes
from sonar_gl.raster.cpu import engine as cpu
from sonar_gl.raster.opengl import buffers, renderer
from sonar_gl.scene import load
from sonar_gl.sonar import fan, sector


@contextmanager
def plain_grid():
    """Sample on a plain grid, with rows and columns that are not sheared."""
    with mock.patch.object(
        fan, "make_sector", lambda *spec, **more: sector.make_sector(*spec[:-1], 0.0, **more)
    ):
        yield


def in_points(sampling):
    """Return the sampling with each sample added to a single bin."""
    return sg.Sampling(sampling.columns_per_beam, sampling.rows, reducer="point")


@contextmanager
def near_plane_at(range_m):
    """Put the near plane at the given range instead of at the sonar."""
    with mock.patch.object(renderer, "NEAR_M", range_m), mock.patch.object(cpu, "NEAR_M", range_m):
        yield


@contextmanager
def back_faces_always_culled():
    """Cull back faces of open meshes, too, and for every pose of the sonar."""
    view_from = scene_meshes.SceneMeshes.view_from

    def cull(self, *args):
        self.boxes = self.boxes._replace(closed=np.ones_like(self.boxes.closed))
        return view_from(self, *args)._replace(outside=True)  # "back faces may be culled"

    with mock.patch.object(scene_meshes.SceneMeshes, "view_from", cull):
        yield


@contextmanager
def projection_depth():
    """Draw by OpenGL with the projection's z-buffer of 24 bits instead of a depth that is linear in range."""
    with tempfile.TemporaryDirectory() as folder:
        for path in load.data_folder("shaders").iterdir():
            if path.suffix in (".vert", ".geom", ".frag", ".glsl"):
                text = path.read_text(encoding="utf-8").replace("gl_FragDepth =", "float unused =")
                (Path(folder) / path.name).write_text(text, encoding="utf-8")
        shaders = mock.patch.object(buffers, "data_folder", lambda _: Path(folder))
        with shaders, mock.patch.dict(os.environ, SONAR_GL_ENGINE="opengl"):
            yield


def histogram(buffers, sonar):
    """Return the echo of all samples over range, (K,), without a warning if there is none."""
    ranges, echoes = (
        np.concatenate([getattr(b, name).ravel() for b in buffers]) for name in ("range_m", "echo")
    )
    return np.histogram(ranges, sonar.bin_edges_m, weights=echoes)[0]


def zbuffer_range(range_m, near_m, far_m):
    """Return a range on the axis after rounding by a z-buffer of 24 bits."""
    depth = far_m / (far_m - near_m) * (1 - near_m / np.asarray(range_m, np.float64))
    depth = np.round(depth * (2**24 - 1)) / (2**24 - 1)
    return near_m * far_m / (far_m - depth * (far_m - near_m))


def single_view_beams(sonar, columns_per_beam):
    """Return the azimuth that each beam gets from a single perspective view, relative to the true one, (B,).

    The columns of the view have equal width on the image; each counts for the beam at its centre.

    Raises
    ------
    ValueError
        from 180 degrees on, where the image would be infinite.
    """
    half = math.radians(sonar.azimuth_fov_deg) / 2
    if half > math.pi / 2 - 1e-9:
        raise ValueError("a perspective view is narrower than 180 degrees")
    columns = round(columns_per_beam * sonar.n_beams)
    edges = np.arctan(math.tan(half) * (np.arange(columns + 1) / columns * 2 - 1))
    middle = np.arctan(math.tan(half) * ((np.arange(columns) + 0.5) / columns * 2 - 1))
    return (
        np.histogram(middle, sonar.n_beams, (-half, half), weights=np.diff(edges))[0]
        * sonar.n_beams
        / (2 * half)
    )


def float32_world(bodies, pose):
    """Return bodies and pose with world coordinates rounded to float32, as on a GPU."""
    moved = [sg.Body(b.name, b.mesh, _rounded(b.pose), b.reflectivity, b.normals) for b in bodies]
    return moved, _rounded(pose)


def _rounded(pose):
    out = np.array(pose)
    out[:3, 3] = out[:3, 3].astype(np.float32)
    return out


def euler(pose):
    """Return roll, pitch and yaw by the textbook formulas, which are singular at pitch = ±90 degrees."""
    r = np.asarray(pose)[:3, :3]
    return math.atan2(r[2, 1], r[2, 2]), math.asin(np.clip(-r[2, 0], -1, 1)), math.atan2(r[1, 0], r[0, 0])


def lambert(normal, direction):
    """Return the cosine of incidence without normalization, for one side of faces only."""
    return -(np.asarray(normal) * direction).sum(axis=-1)


def face_normals(mesh):
    """Return unit normals of faces, also of degenerate ones."""
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    normal = np.cross(b - a, c - a)
    with np.errstate(invalid="ignore"):
        return normal / np.linalg.norm(normal, axis=1, keepdims=True)


def sum_in_sequence(value, count):
    """Sum float32 values one by one; np.sum would sum pairwise."""
    return float(np.cumsum(np.full(count, value, np.float32), dtype=np.float32)[-1])


def bin_of(range_m, sonar):
    """Return the truncated index of the bin, without a check of the ends."""
    return int((range_m - sonar.range_min_m) / sonar.bin_size_m)


def gain_by_factors(range_m, absorption_db_m):
    """Return the product of absorption loss and TVG, each in float32, which should be 1."""
    decades = np.float32(2 * absorption_db_m * range_m / 10)
    with np.errstate(over="ignore", under="ignore", invalid="ignore"):
        return np.float32(10) ** -decades * np.float32(10) ** decades
