"""The naive ways, small: what a first sonar simulator does, so that its failures can be measured beside ours.

Those that draw are our own simulator with one of its cures taken out.
"""

import math
import tempfile
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from unittest import mock

import numpy as np

import sonar_gl as sg
from sonar_gl import fan, lattice, load, render, stock, world


@contextmanager
def plain_grid():
    """Rays in a plain grid: rows and columns are not sheared."""
    with mock.patch.object(fan, "make_sector", lambda *spec: lattice.make_sector(*spec[:-1], 0.0)):
        yield


def in_points(sampling):
    """The same samples, each dropped whole into one bin."""
    return sg.Sampling(sampling.columns_per_beam, sampling.rows, reducer="point")


@contextmanager
def near_plane_at(range_m):
    """The near plane where the first bin begins, instead of at the sonar."""
    with mock.patch.object(render, "NEAR_M", range_m):
        yield


@contextmanager
def back_faces_always_culled():
    """Back faces are left out of open meshes too, and wherever the sonar is."""
    place = stock.Stock.place

    def cull(self, *args):
        self.closed = np.ones_like(self.closed)
        return replace(place(self, *args), outside=True)  # "back faces may be left out"

    with mock.patch.object(stock.Stock, "place", cull):
        yield


@contextmanager
def projection_depth():
    """The z-buffer of the projection, 24 bits from the near plane on, instead of one linear in range."""
    with tempfile.TemporaryDirectory() as folder:
        for path in load.data_folder("shaders").iterdir():
            if path.suffix in (".vert", ".frag", ".glsl"):
                text = path.read_text(encoding="utf-8").replace("gl_FragDepth =", "float unused =")
                (Path(folder) / path.name).write_text(text, encoding="utf-8")
        with mock.patch.object(world, "data_folder", lambda _: Path(folder)):
            yield


def histogram(buffers, sonar):
    """(K,) echo over range of all samples together, and not a word if there is none."""
    ranges, echoes = (
        np.concatenate([getattr(b, name).ravel() for b in buffers]) for name in ("range_m", "echo")
    )
    return np.histogram(ranges, sonar.bin_edges_m, weights=echoes)[0]


def zbuffer_range(range_m, near_m, far_m, bits=24):
    """Range on the axis as a z-buffer of so many bits gives it back."""
    depth = far_m / (far_m - near_m) * (1 - near_m / np.asarray(range_m, np.float64))
    depth = np.round(depth * (2**bits - 1)) / (2**bits - 1)
    return near_m * far_m / (far_m - depth * (far_m - near_m))


def single_view_beams(sonar, columns_per_beam):
    """(B,) azimuth that each beam gets of one perspective view, over what is its own.

    The view has so many columns a beam, even on the picture; each falls whole into the beam of its middle.

    Raises
    ------
    ValueError
        from 180 degrees on: the picture would have no end.
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
    """Bodies and pose with their coordinates rounded to float32 in the world, as a GPU takes them."""
    moved = [sg.Body(b.name, b.mesh, _rounded(b.pose), b.reflectivity, b.normals) for b in bodies]
    return moved, _rounded(pose)


def _rounded(pose):
    out = np.array(pose)
    out[:3, 3] = out[:3, 3].astype(np.float32)
    return out


def euler(pose):
    """roll, pitch, yaw by the formulas of textbooks, which end at pitch = ±90 degrees."""
    r = np.asarray(pose)[:3, :3]
    return math.atan2(r[2, 1], r[2, 2]), math.asin(np.clip(-r[2, 0], -1, 1)), math.atan2(r[1, 0], r[0, 0])


def lambert(normal, direction):
    """The cosine as it stands: of normals as they come, of one side only."""
    return -(np.asarray(normal) * direction).sum(axis=-1)


def face_normals(mesh):
    """Unit normals of faces, whatever their area."""
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    normal = np.cross(b - a, c - a)
    with np.errstate(invalid="ignore"):
        return normal / np.linalg.norm(normal, axis=1, keepdims=True)


def sum_in_sequence(value, count):
    """float32, one after the other; cumsum because sum goes pairwise."""
    return float(np.cumsum(np.full(count, value, np.float32), dtype=np.float32)[-1])


def bin_of(range_m, sonar):
    """int() of the quotient, without a look at the ends."""
    return int((range_m - sonar.range_min_m) / sonar.bin_size_m)


def gain_by_factors(range_m, absorption_db_m):
    """Loss and TVG, each by itself in float32; they ought to cancel."""
    decades = np.float32(2 * absorption_db_m * range_m / 10)
    with np.errstate(over="ignore", under="ignore", invalid="ignore"):
        return np.float32(10) ** -decades * np.float32(10) ** decades
