"""What is kept of pings: each output takes those of a part one by one, and ends with its files' names."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sonar_gl.batch import store
from sonar_gl.batch.files import Folder
from sonar_gl.batch.kept import Kept
from sonar_gl.batch.orders import Order, Orders
from sonar_gl.boxes import boxes_of
from sonar_gl.dump import fan_artist
from sonar_gl.export import npz_bytes, png_bytes
from sonar_gl.types import Ping


def numbered(folder: str, number: int, suffix: str) -> str:
    """Name of a ping's file; a folder holds a thousand."""
    return f"{folder}/{number // 1000:05d}/{number:08d}.{suffix}"


def coco_name(sonar: str, part: int) -> str:
    """File of a part's records for COCO."""
    return f"coco/{sonar}/parts/{part:07d}.jsonl"


def bag_name(part: int) -> str:
    """File of a part's messages."""
    return f"bag/part_{part:07d}.mcap"


class Output:
    """What all outputs do: nothing yet.

    Parameters
    ----------
    orders, kept, folder
    """

    def __init__(self, orders: Orders, kept: Kept, folder: Folder):
        self.orders, self.kept, self.folder, self.names = orders, kept, folder, []

    def begin(self, part: int, numbers: range) -> None:
        """A part begins, of these pings."""
        self.part, self.numbers, self.names = part, numbers, []

    def take(self, order: Order, sonar: str, ping: Ping) -> None:
        """One ping of a sonar; those of one sonar come by rising numbers within a scene."""

    def end(self) -> list[str]:
        """Write what is left; the names of all files of the part, in the folder."""
        return self.names

    def put(self, name: str, data: bytes) -> None:
        """Write a file of the part."""
        self.folder.put(name, data)
        self.names.append(name)


class Arrays(Output):
    """Intensities and labels of each sonar, into the store."""

    def __init__(self, *made_of):
        super().__init__(*made_of)
        self.layers = {name: self.kept.layers(name) for name in self.orders.sonars}
        self.writer, self.arrays = store.Writer(self.folder, len(self.layers)), {}

    def begin(self, part, numbers):
        super().begin(part, numbers)
        for name, (layers, per_body) in self.layers.items():
            sonar = self.orders.sonars[name]
            entries = [
                (layer.name, layer.dtype, (sonar.n_beams, sonar.n_bins), layer.fill) for layer in layers
            ]
            entries += [(key, dtype, shape, fill) for key, dtype, shape, _, fill, _ in per_body]
            before = self.arrays.get(name, {})
            for key, dtype, shape, fill in entries:
                if len(before.get(key, ())) != len(numbers):  # of the same pages again, where one can
                    before[key] = np.empty((len(numbers), *shape), dtype)
                before[key][...] = fill
            self.arrays[name] = before

    def take(self, order, sonar, ping):
        at, arrays = order.number - self.numbers[0], self.arrays[sonar]
        classes, first = self.kept.classes_of(order.scene), self.kept.first_body[order.scene]
        layers, per_body = self.layers[sonar]
        for layer in layers:
            arrays[layer.name][at] = layer.encode(ping, classes, first)
        if per_body:
            table = self.orders.job.labels
            bright = np.where(ping.intensity >= 10 ** (table.level_db / 10), ping.body_id, np.uint16(0))
            boxes = boxes_of(replace(ping, body_id=bright), table.height)
            these = first + boxes.body_id.astype(int) - 1
            arrays["body_box"][at, these] = np.hstack([boxes.beams, boxes.bins])
            arrays["body_pixels"][at, these] = boxes.pixels
            arrays["body_bins"][at, these] = boxes.n_bins
            arrays["body_echo"][at, first : first + len(ping.body_echo) - 1] = ping.body_echo[1:]

    def end(self):
        for name, arrays in self.arrays.items():
            self.names += self.writer.write(name, self.numbers[0], arrays)
        return self.names


class Pictures(Output):
    """Fan images in colour, and NPZ files."""

    def __init__(self, *made_of):
        super().__init__(*made_of)
        table = self.orders.job.pictures
        self.formats = table.formats
        self.artist = fan_artist(table.height, table.scale, table.db_range, table.colormap, table.axes)

    def take(self, order, sonar, ping):
        if "png" in self.formats:
            name = numbered(f"png/{sonar}", order.number, "png")
            self.put(name, png_bytes(self.artist(None, ping, order.number)))
        if "npz" in self.formats:
            self.put(numbered(f"npz/{sonar}", order.number, "npz"), npz_bytes(ping))
