"""What is joined of all parts at the end: numbers of each ping, films, indices; and whether all is as it was."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from sonar_gl.batch import store, table
from sonar_gl.batch.files import Folder
from sonar_gl.batch.kept import Kept
from sonar_gl.batch.maker import record_name, table_name
from sonar_gl.batch.orders import Orders
from sonar_gl.batch.planned import Planned

DONE = "done.json"  # the last file of a batch


def _blocks(folder: Folder, planned: Planned) -> Iterator[tuple[int, np.ndarray]]:
    """(number of the first ping, rows of the table), some thousand pings at a time."""
    first, rows, some = 0, [], 0
    for part in range(planned.n_parts):
        rows.append(table.from_bytes(folder.get(table_name(part))))
        some += len(rows[-1])
        if some >= store.TABLE_CHUNK or part == planned.n_parts - 1:
            whole = np.concatenate(rows)
            keep = 0 if part == planned.n_parts - 1 else len(whole) % store.TABLE_CHUNK
            yield first, whole[: len(whole) - keep]
            first += len(whole) - keep
            rows, some = [whole[len(whole) - keep :]], keep


def _variables(orders: Orders, columns: table.Columns, planned: Planned, sonar: str):
    """(name, dtype, dims, shape of a ping, attributes, function (rows) -> values) of one sonar's pings."""
    of, mount, n = columns.of, orders.mounts[sonar], len(columns.moved)
    estimates = np.array([thought[sonar] for thought in planned.estimates])

    def places(rows):
        out = of(rows, "moved").reshape(-1, n, 3, 4)
        return np.concatenate([out, np.broadcast_to([[[[0.0, 0.0, 0.0, 1.0]]]], (len(rows), n, 1, 4))], axis=2)

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
            "long_name": "share of the echo in wrong bins, thought to be less in 95 of 100 pings", "units": "1"},
         lambda rows: estimates[of(rows, "scene")[:, 0].astype(int)]),
    ]  # fmt: skip
    for word in ("water", "noise"):
        for k, key in enumerate(getattr(columns, word)):
            out.append((f"{word}_{key}", "float64", (), (), {"long_name": f"{key} of the {word}"},
                        lambda rows, k=k, word=word: of(rows, word)[:, k]))  # fmt: skip
    if n:
        names = [name for _, name in columns.moved]
        out.append(("moved_pose", "float64", ("moved", "row", "column"), (n, 4, 4), {
            "long_name": "world_from_body, NaN for what is not there", "bodies": names}, places))  # fmt: skip
    if columns.coloured:
        names = [name for _, name in columns.coloured]
        out.append(("reflectivity", "float64", ("coloured",), (len(names),), {
            "long_name": "μ of bodies that differ", "bodies": names},
            lambda rows: of(rows, "coloured")))  # fmt: skip
    return out


def _add_numbers(orders, folder, planned) -> None:
    """Put the table's columns into the store, by name."""
    columns = table.Columns(orders)
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
    of_parts = {name for layers in map(Kept(orders).layers, orders.sonars) for name in _names(layers)}
    files = store.files(folder, of_parts)
    summary = {"parts": planned.n_parts, "pings": planned.n_pings}
    folder.put_json(DONE, summary | {"files": {name: folder.checksum(name) for name in sorted(files)}})


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
    return wrong + (_compare(folder, done["files"]) if done else [])


def _compare(folder, files):
    for name, expected in files.items():
        found = folder.checksum(name)
        if found != expected:
            yield f"{folder.path(name)}: " + ("is missing" if found is None else "is not what was written")
