"""What has a few numbers a ping: pose, time, what was varied; rows of one table, a file for each part."""

from __future__ import annotations

import io

import numpy as np

from sonar_gl.batch.orders import Order, Orders
from sonar_gl.batch.tables import matching

NOT_MADE, MADE, SET_ASIDE = 0, 1, 2
POSE = 16  # numbers of a matrix
PLACE = 12  # of a body: the upper three rows of its matrix


class Columns:
    """The table's columns.

    Attributes
    ----------
    width : numbers in a row
    moved : bodies that `vary` moves, as (scene, name)

    Raises
    ------
    Error
        for a pattern of bodies that means none in any scene.
    """

    def __init__(self, orders: Orders):
        self.orders, self.job = orders, orders.job
        self.water, self.noise = sorted(self.job.vary.water), sorted(self.job.vary.noise)
        self.moved, self.coloured, known = [], [], {}
        for scene in range(len(self.job.scenes)) if self.job.vary.bodies else ():
            known |= orders.things(scene)
            for k, table in enumerate(self.job.vary.bodies):
                names = [(scene, name) for name in orders.names(scene, k)]
                self.moved += [at for at in names if at not in self.moved]
                if table.reflectivity is not None:
                    self.coloured += [at for at in names if at not in self.coloured]
        for k, table in enumerate(self.job.vary.bodies):
            matching(table.names, known, f"{self.job.where}: vary.bodies[{k}].names")
        self._begin, at = {}, 0
        sizes = {"status": 1, "scene": 1, "time_s": 1, "pose": POSE}
        sizes |= {("has_echo", sonar): 1 for sonar in orders.sonars}
        sizes |= {("echo", sonar): 1 for sonar in orders.sonars}
        sizes |= {"water": len(self.water), "noise": len(self.noise)}
        sizes |= {"moved": len(self.moved) * PLACE, "coloured": len(self.coloured)}
        for name, size in sizes.items():
            self._begin[name] = slice(at, at + size)
            at += size
        self.width = at

    def row(self, order: Order) -> np.ndarray:
        """Of a ping that has not been made."""
        out = np.full(self.width, np.nan)

        def put(name, values):
            out[self._begin[name]] = values

        put("status", NOT_MADE), put("scene", order.scene), put("time_s", order.time_s)
        put("pose", order.pose.ravel())
        put("water", [order.water[key] for key in self.water])
        put("noise", [getattr(order.noise, key) for key in self.noise])
        if self.moved:
            things = self.orders.things(order.scene)
            places = np.full((len(self.moved), PLACE), np.nan)
            for k, (scene, name) in enumerate(self.moved):
                pose = order.bodies.get(name, things[name].pose) if scene == order.scene else None
                if pose is not None:
                    places[k] = pose[:3].ravel()
            put("moved", places.ravel())
        mus = [order.reflectivity.get(n, np.nan) if s == order.scene else np.nan for s, n in self.coloured]
        put("coloured", mus)
        return out

    def of(self, rows: np.ndarray, name) -> np.ndarray:
        """A column, or several, of rows; a view."""
        return rows[..., self._begin[name]]


def to_bytes(rows: np.ndarray) -> bytes:
    """Rows as a NumPy file."""
    out = io.BytesIO()
    np.save(out, rows, allow_pickle=False)
    return out.getvalue()


def from_bytes(data: bytes) -> np.ndarray:
    """What `to_bytes` made."""
    return np.load(io.BytesIO(data), allow_pickle=False)
