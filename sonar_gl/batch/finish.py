"""What is joined of all parts at the end, numbers of each ping, films, indices; and whether all is whole."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from itertools import chain

import numpy as np

from sonar_gl.batch import store
from sonar_gl.batch import table as table_of
from sonar_gl.batch.files import Folder
from sonar_gl.batch.kept import Kept
from sonar_gl.batch.orders import Orders
from sonar_gl.batch.outputs import bag_name, coco_name
from sonar_gl.batch.planned import DONE, Planned, record_name, table_name
from sonar_gl.dump import fan_artist
from sonar_gl.export import save_animation
from sonar_gl.types import Error, Ping


def _blocks(folder: Folder, planned: Planned) -> Iterator[tuple[int, np.ndarray]]:
    """(number of the first ping, rows of the table), some thousand pings at a time."""
    first, rows, some = 0, [], 0
    for part in range(planned.n_parts):
        try:
            rows.append(table_of.from_bytes(folder.get(table_name(part))))
        except (ValueError, EOFError):
            cure = f"it is damaged; delete {record_name(part)}, and --resume makes the part again"
            raise Error(f"{folder.path(table_name(part))}: must be the table of a part ({cure})") from None
        some += len(rows[-1])
        if some >= store.TABLE_CHUNK or part == planned.n_parts - 1:
            whole = np.concatenate(rows)
            keep = 0 if part == planned.n_parts - 1 else len(whole) % store.TABLE_CHUNK
            yield first, whole[: len(whole) - keep]
            first += len(whole) - keep
            rows, some = [whole[len(whole) - keep :]], keep


def _variables(orders: Orders, columns: table_of.Columns, planned: Planned, sonar: str):
    """(name, dtype, dims, shape of a ping, attributes, function (rows) -> values) of one sonar's pings."""
    of, mount, n = columns.of, orders.mounts[sonar], len(columns.moved)
    estimates = np.array([thought[sonar] for thought in planned.estimates])

    def places(rows):
        out = of(rows, "moved").reshape(-1, n, 3, 4)
        return np.concatenate(
            [out, np.broadcast_to([[[[0.0, 0.0, 0.0, 1.0]]]], (len(rows), n, 1, 4))], axis=2
        )

    out = [
        ("status", "uint8", (), (), {
            "long_name": "0 not made, 1 made, 2 set aside", "flag_values": [0, 1, 2],
            "flag_meanings": "not_made made set_aside"}, lambda rows: of(rows, "status")[:, 0]),
        ("scene", "uint16", (), (), {"long_name": "index into scenes"}, lambda rows: of(rows, "scene")[:, 0]),
        ("time_s", "float64", (), (), {"long_name": "time of transmission", "units": "s"},
         lambda rows: of(rows, "time_s")[:, 0]),
        ("pose", "float64", ("row", "column"), (4, 4), {
            "long_name": "world_from_sonar", "units": "metres, x ahead, y to port, z up"},
         lambda rows: of(rows, "pose").reshape(-1, 4, 4) @ mount),
        ("echo", "float64", (), (), {"long_name": "sum of intensity before noise", "units": "1"},
         lambda rows: of(rows, ("echo", sonar))[:, 0]),
        ("error_estimate", "float64", (), (), {
            "long_name": "share of the echo in wrong bins, in 95 of 100 pings less", "units": "1"},
         lambda rows: estimates[of(rows, "scene")[:, 0].astype(int)]),
    ]  # fmt: skip
    for word in ("water", "noise"):
        for k, key in enumerate(getattr(columns, word)):
            out.append((f"{word}_{key}", "float64", (), (), {"long_name": f"{key} of the {word}"},
                        lambda rows, k=k, word=word: of(rows, word)[:, k]))  # fmt: skip
    if n:
        names = [name for _, name in columns.moved]
        out.append(("moved_pose", "float64", ("moved", "row", "column"), (n, 4, 4), {
            "long_name": "world_from_body, NaN for what is not there", "bodies": names,
            "scenes": [scene for scene, _ in columns.moved]}, places))  # fmt: skip
    if columns.coloured:
        names = [name for _, name in columns.coloured]
        out.append(("reflectivity", "float64", ("coloured",), (len(names),), {
            "long_name": "μ of bodies that differ", "bodies": names,
            "scenes": [scene for scene, _ in columns.coloured]},
            lambda rows: of(rows, "coloured")))  # fmt: skip
    return out


def _add_numbers(orders, folder, planned) -> None:
    """Put the table's columns into the store, by name."""
    columns = table_of.Columns(orders)
    variables = {sonar: _variables(orders, columns, planned, sonar) for sonar in orders.sonars}
    writer = store.Writer(folder, len(orders.sonars))
    for sonar, entries in variables.items():
        for name, dtype, dims, shape, attributes, _ in entries:
            writer.add(sonar, name, dtype, dims, (planned.n_pings, *shape), attributes)
    for first, rows in _blocks(folder, planned):
        for sonar, entries in variables.items():
            for name, *_, values in entries:
                writer.group(sonar)[name][first : first + len(rows)] = values(rows)


def finish(orders: Orders, planned: Planned, folder: Folder) -> None:
    """Join what is joined, of a batch whose parts are all done."""
    _add_numbers(orders, folder, planned)
    store.consolidate(folder)
    files = []
    if orders.job.coco is not None:
        files += _join_coco(orders, planned, folder)
    if orders.job.ros is not None:
        files += _join_bag(planned, folder)
    if orders.job.pictures is not None and "mp4" in orders.job.pictures.formats:
        files += _films(orders, planned, folder)
    of_parts = {name for layers in map(Kept(orders).layers, orders.sonars) for name in _names(layers)}
    files += store.files(folder, of_parts)
    summary = {"parts": planned.n_parts, "pings": planned.n_pings}
    folder.put_json(DONE, summary | {"files": {name: folder.checksum(name) for name in sorted(files)}})


def _join_coco(orders, planned, folder) -> list[str]:
    """One file of instances for each sonar."""
    from sonar_gl.batch.coco import coco_json

    kept, names = Kept(orders), []
    categories = [{"id": n, "name": name, "supercategory": ""} for n, name in enumerate(kept.classes, 1)]
    for sonar in orders.sonars:
        names.append(f"coco/{sonar}/instances.json")
        parts = [partial(folder.open, coco_name(sonar, part)) for part in range(planned.n_parts)]
        with folder.writing(names[-1]) as path, path.open("wb") as out:
            out.writelines(coco_json(parts, categories, {"description": f"{orders.job.name}, sonar {sonar}"}))
    return names


def _join_bag(planned, folder) -> list[str]:
    """What makes a bag of the parts' files."""
    from sonar_gl.batch.ros import finish_bag

    there = [name for part in range(planned.n_parts) if folder.fs.exists(folder.path(name := bag_name(part)))]
    if there:  # else all pings were set aside
        finish_bag(folder.path("bag"), there)
    return ["bag/metadata.yaml"] if there else []


def _films(orders, planned, folder) -> list[str]:
    """A film of each sonar's pings that were made."""
    table, names = orders.job.pictures, []
    draw = fan_artist(table.height, table.scale, table.db_range, table.colormap, table.axes)
    for name, sonar in orders.sonars.items():
        arrays = store.Writer(folder, len(orders.sonars)).group(name)

        def frames(arrays=arrays, sonar=sonar):
            for first in range(0, planned.n_pings, store.CHUNK):
                some = arrays["intensity"][first : first + store.CHUNK]
                made = arrays["status"][first : first + store.CHUNK] == table_of.MADE
                for intensity in some[made]:
                    ping = Ping(
                        intensity, sonar.azimuth_rad, sonar.range_m, meta={"bin_size_m": sonar.bin_size_m}
                    )
                    yield draw(None, ping, first)

        shown = frames()
        if (first := next(shown, None)) is not None:  # else all pings were set aside
            names.append(f"{name}.mp4")
            with folder.writing(names[-1]) as path:
                save_animation(path, chain([first], shown), table.fps)
    return names


def _names(layers):
    return [*(layer.name for layer in layers[0]), *(entry[0] for entry in layers[1])]


def check(folder: Folder, planned: Planned, progress) -> list[str]:
    """What is not as it was written, one line for each file; and what is not there yet.

    progress : makes of a range a context manager that gives it
    """
    wrong = []
    done = folder.get_json(DONE)
    if done is None:
        wrong.append(f"{folder.path(DONE)}: is missing: the batch is not finished; go on with it by --resume")
    with progress(range(planned.n_parts)) as parts:
        for part in parts:
            record = folder.get_json(record_name(part))
            if record is None:
                if done is not None:
                    wrong.append(f"{folder.path(record_name(part))}: is missing")
                continue
            wrong += _compare(folder, record["files"])
    return [*wrong, *(_compare(folder, done["files"]) if done else ())]


def forget_damage(folder: Folder, planned: Planned, tell) -> None:
    """Take away the records of parts whose files are not as they were written, so that they are made again.

    tell : function (text)
    """
    again, done = False, folder.get_json(DONE)
    for part in range(planned.n_parts):
        record = folder.get_json(record_name(part))
        for line in _compare(folder, record["files"]) if record else ():
            tell(line)
            folder.forget(record_name(part))
            again = True
    for name, found in ((name, folder.checksum(name)) for name in (done["files"] if done else ())):
        if found != done["files"][name]:
            tell(f"{folder.path(name)}: is not what was written")
            folder.forget(name)
            again = True
    if again:
        folder.forget(DONE)


def _compare(folder, files):
    for name, expected in files.items():
        found = folder.checksum(name)
        if found != expected:
            yield f"{folder.path(name)}: " + ("is missing" if found is None else "is not what was written")
