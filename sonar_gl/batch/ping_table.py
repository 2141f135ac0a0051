"""The table of numbers per ping: pose, time, what varies, and what came of the ping.

It is one file for each part; the end of the batch gathers them into arrays of the store.
"""

from __future__ import annotations

import io
from collections.abc import Iterable, Iterator

import numpy as np

from sonar_gl.batch.folder import Folder
from sonar_gl.batch.manifest import Manifest, record_name, table_name
from sonar_gl.batch.requests import BatchRequest, BatchRequests
from sonar_gl.batch.schema import ArraySpec
from sonar_gl.batch.store import TABLE_CHUNK_PINGS, PingStore
from sonar_gl.core.errors import Error
from sonar_gl.core.names import matching_names

NOT_MADE, MADE, SET_ASIDE = 0, 1, 2  # values of the column `status`
MATRIX, AFFINE = 16, 12  # numbers of a (4, 4) pose, and of its upper three rows


class PingTable:
    """The columns of the table of numbers per ping, float64.

    water, noise : names of the fields that vary
    moved : bodies that move, as (scene, name)
    with_reflectivity : bodies whose reflectivity varies, as (scene, name)
    """

    def __init__(self, requests: BatchRequests):
        job, self._scenes = requests.job, requests.scenes
        self.water, self.noise = sorted(job.vary.water), sorted(job.vary.noise)
        moved, with_reflectivity = {}, {}  # ordered sets
        for scene, contents in enumerate(requests.scenes.contents):
            for table in job.vary.bodies:
                bodies = [(scene, name) for name in matching_names(table.names, contents.names)]
                moved |= dict.fromkeys(bodies)
                if table.reflectivity is not None:
                    with_reflectivity |= dict.fromkeys(one for one in bodies if one[1] in contents.bodies)
        self.moved, self.with_reflectivity = list(moved), list(with_reflectivity)
        widths = {"status": 1, "scene": 1, "time_s": 1, "pose": MATRIX}
        for name, width in (("has_echo", 1), ("echo", 1), ("error_estimate", 1), ("sampling", 2)):
            widths |= {(name, sonar): width for sonar in requests.sonars}  # sampling: columns per beam, rows
        widths |= {"water": len(self.water), "noise": len(self.noise)}
        widths |= {"moved": len(self.moved) * AFFINE, "reflectivity": len(self.with_reflectivity)}
        self._columns, self.width = {}, 0
        for name, width in widths.items():
            self._columns[name] = slice(self.width, self.width + width)
            self.width += width

    def row(self, request: BatchRequest) -> np.ndarray:
        """Return the row of a ping that has not been made yet."""
        out = np.full(self.width, np.nan)

        def put(name, values):
            out[self._columns[name]] = values

        put("status", NOT_MADE)
        put("scene", request.scene)
        put("time_s", request.time_s)
        put("pose", request.vehicle_pose.ravel())
        put("water", [getattr(request.water, key) for key in self.water])
        put("noise", [getattr(request.noise, key) for key in self.noise])
        if self.moved:
            known = self._scenes.moved_bodies(request.scene).known
            poses = np.full((len(self.moved), AFFINE), np.nan)
            for k, (scene, name) in enumerate(self.moved):
                pose = request.bodies.get(name, known[name].pose) if scene == request.scene else None
                if pose is not None:
                    poses[k] = pose[:3].ravel()
            put("moved", poses.ravel())
        mu = [
            request.reflectivity.get(name, np.nan) if scene == request.scene else np.nan
            for scene, name in self.with_reflectivity
        ]
        put("reflectivity", mu)
        return out

    def column(self, rows: np.ndarray, name) -> np.ndarray:
        """Return the view (..., width of the column) of some rows.

        name : status, scene, time_s, pose, water, noise, moved or reflectivity; or a tuple of has_echo, echo,
            error_estimate or sampling, and the sonar
        """
        return rows[..., self._columns[name]]


def rows_to_bytes(rows: np.ndarray) -> bytes:
    """Return rows of the table as an NPY file."""
    out = io.BytesIO()
    np.save(out, rows, allow_pickle=False)
    return out.getvalue()


def _rows_by_block(folder: Folder, manifest: Manifest) -> Iterator[tuple[int, np.ndarray]]:
    """Yield (number of the first ping, rows of the table), whole chunks of the store's arrays at a time."""
    first, rows, n_rows = 0, [], 0
    for part in range(manifest.n_parts):
        name = table_name(part)
        try:
            rows.append(np.load(io.BytesIO(folder.get(name)), allow_pickle=False))
        except (ValueError, EOFError):
            cure = f"it is damaged; delete {record_name(part)}, and --resume makes the part again"
            raise Error(f"{folder.path(name)}: must be the table of a part ({cure})") from None
        n_rows += len(rows[-1])
        is_last = part == manifest.n_parts - 1
        if n_rows >= TABLE_CHUNK_PINGS or is_last:
            block = np.concatenate(rows)
            rest = 0 if is_last else len(block) % TABLE_CHUNK_PINGS
            yield first, block[: len(block) - rest]
            first += len(block) - rest
            rows, n_rows = [block[len(block) - rest :]], rest


def ping_variables(requests: BatchRequests, table: PingTable, sonar: str) -> Iterable[ArraySpec]:
    """Yield the variables of one sonar's pings."""
    mount, n_moved = requests.mounts[sonar], len(table.moved)

    def variable(name, values, long_name, dtype="float64", shape=(), dims=(), **more):
        fill = np.nan if dtype == "float64" else 0
        return ArraySpec(name, dtype, shape, dims, fill, {"long_name": long_name, **more}, values)

    def column(name, k=0):
        return lambda rows: table.column(rows, name)[:, k]

    def sonar_poses(rows):
        return table.column(rows, "pose").reshape(-1, 4, 4) @ mount

    def n_rows(rows):
        return np.nan_to_num(table.column(rows, ("sampling", sonar))[:, 1])

    def moved_poses(rows):
        upper = table.column(rows, "moved").reshape(-1, n_moved, 3, 4)
        last = np.broadcast_to([[[[0.0, 0.0, 0.0, 1.0]]]], (len(rows), n_moved, 1, 4))
        return np.concatenate([upper, last], axis=2)

    def mu_of_bodies(rows):
        return table.column(rows, "reflectivity")

    def of_bodies(bodies):
        return {"bodies": [name for _, name in bodies], "scenes": [scene for scene, _ in bodies]}

    flags = {"flag_values": [NOT_MADE, MADE, SET_ASIDE], "flag_meanings": "not_made made set_aside"}
    yield variable("status", column("status"), "0 not made, 1 made, 2 set aside", "uint8", **flags)
    yield variable("scene", column("scene"), "index into scenes", "uint16")
    yield variable("time_s", column("time_s"), "time of transmission", units="s")
    axes = "metres, x ahead, y to port, z up"  # not units, which CF readers would parse
    shape, dims = (4, 4), ("row", "column")
    yield variable("pose", sonar_poses, "world_from_sonar", shape=shape, dims=dims, comment=axes)
    yield variable("echo", column(("echo", sonar)), "sum of intensity before noise", units="1")
    long_name = (
        "estimated share of the echo in wrong bins, or a fifth of the error of a body's own echo if that is more "
        "and breaks the tolerance"
    )
    yield variable("error_estimate", column(("error_estimate", sonar)), long_name, units="1")
    long_name = "samples across one beam spacing, in azimuth"
    yield variable("columns_per_beam", column(("sampling", sonar)), long_name, units="1")
    long_name = "samples up the elevation aperture, 0 where no ping was made"
    yield variable("rows", n_rows, long_name, "uint16", units="1")
    for group, keys in (("water", table.water), ("noise", table.noise)):
        for k, key in enumerate(keys):
            yield variable(f"{group}_{key}", column(group, k), f"{key} of the {group}")
    if n_moved:
        shape, dims = (n_moved, 4, 4), ("moved", "row", "column")
        long_name = "world_from_body, NaN for what is not there"
        yield variable("moved_pose", moved_poses, long_name, shape=shape, dims=dims, **of_bodies(table.moved))
    if coloured := table.with_reflectivity:
        shape, dims = (len(coloured),), ("coloured",)
        long_name = "μ of bodies that differ"
        yield variable("reflectivity", mu_of_bodies, long_name, shape=shape, dims=dims, **of_bodies(coloured))


def gather_ping_variables(
    requests: BatchRequests, table: PingTable, manifest: Manifest, folder: Folder
) -> None:
    """Write the tables of all parts into the store as arrays."""
    store = PingStore(folder, len(requests.sonars))
    variables = {sonar: list(ping_variables(requests, table, sonar)) for sonar in requests.sonars}
    for sonar, entries in variables.items():
        for variable in entries:
            store.create_variable(sonar, variable, manifest.n_pings)
    for first, rows in _rows_by_block(folder, manifest):
        for sonar, entries in variables.items():
            group = store.group(sonar)
            for variable in entries:
                group[variable.name][first : first + len(rows)] = variable.values(rows)
