"""What a batch writes. Each output takes the pings of a part, and at the end joins the files of all parts."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, replace
from functools import partial
from itertools import chain
from operator import itemgetter
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory

import numpy as np

from sonar_gl.batch.coco import coco_json, coco_lines, coco_records, mask_picture
from sonar_gl.batch.folder import Folder
from sonar_gl.batch.job_settings import counts_of_output
from sonar_gl.batch.manifest import CHUNK_PINGS, Manifest
from sonar_gl.batch.optical import OpticalCamera
from sonar_gl.batch.ping_table import MADE
from sonar_gl.batch.requests import BatchRequest, BatchRequests
from sonar_gl.batch.schema import Schema
from sonar_gl.batch.store import PingStore
from sonar_gl.core.errors import errors_at
from sonar_gl.core.poses import pose as make_pose
from sonar_gl.embed.camera import Camera
from sonar_gl.imaging.boxes import body_map_and_bins, boxes_of
from sonar_gl.imaging.fan_image import fan_image
from sonar_gl.imaging.files import npz_bytes, png_bytes, save_animation
from sonar_gl.noise.reception import receiver_power
from sonar_gl.ping import Ping
from sonar_gl.ros.bag import BagSettings, CameraRecord, PingRecord, bag_metadata, read_contents, write_part

MAX_DEPTH_M = 65.5355  # of 16 bits in millimetres, rounded


def ping_file(folder: str, number: int, suffix: str) -> str:
    """Return the name of a ping's file; a folder holds a thousand."""
    return f"{folder}/{number // 1000:05d}/{number:08d}.{suffix}"


class Output:
    """Base class of outputs; it writes nothing.

    names : names of the files of the current part, in the folder
    """

    def __init__(self, requests: BatchRequests, schema: Schema, folder: Folder):
        self.requests, self.schema, self.folder, self.job = requests, schema, folder, requests.job
        self.part, self.numbers, self.names = 0, range(0), []

    def begin(self, part: int, numbers: range) -> None:
        """Begin a part with these pings."""
        self.part, self.numbers, self.names = part, numbers, []

    def add(self, request: BatchRequest, sonar: str, ping: Ping, quiet: Ping) -> None:
        """Take one ping of a sonar, and the same without noise; those of one sonar and scene come by rising number."""

    def end(self) -> list[str]:
        """Write what has not been written yet, and return the names of all files of the part."""
        return self.names

    def join(self, manifest: Manifest) -> list[str]:
        """Join the files of all parts at the end of the batch, and return the names of the files written."""
        return []

    def put(self, name: str, data: bytes) -> None:
        """Write a file of the part."""
        self.folder.put(name, data)
        self.names.append(name)


class CountsOutput(Output):
    """Base class of outputs that hold counts, by the laws of the sonars as a table of the job changes them."""

    table_name: str

    def __init__(self, *context):
        super().__init__(*context)
        self.table = getattr(self.job, self.table_name)
        self._counts = counts_of_output(self.job, self.requests.sonars, self.table_name)

    def with_counts(self, sonar: str, ping: Ping) -> Ping:
        """Return a ping whose sonar delivers the counts of this output."""
        return replace(ping, sonar=replace(ping.sonar, counts=self._counts[sonar]))


class ArraysOutput(Output):
    """Intensities and labels in the store.

    arrays : sonar -> name -> (pings of the part, ...) array
    """

    def __init__(self, *context):
        super().__init__(*context)
        self._layers = {sonar: self.schema.layers(sonar) for sonar in self.requests.sonars}
        self._store, self.arrays = PingStore(self.folder, len(self._layers)), {}

    def begin(self, part, numbers):
        super().begin(part, numbers)
        for sonar, layers in self._layers.items():
            arrays = self.arrays.setdefault(sonar, {})
            for spec in (*layers, *self.schema.body_arrays):
                if len(arrays.get(spec.name, ())) != len(numbers):  # otherwise its memory is used again
                    arrays[spec.name] = np.empty((len(numbers), *spec.shape), spec.dtype)
                arrays[spec.name][...] = spec.fill

    def add(self, request, sonar, ping, quiet):
        row, arrays = request.number - self.numbers[0], self.arrays[sonar]
        class_id, first = self.schema.scene_class_id(request.scene), self.schema.first_body[request.scene]
        for layer in self._layers[sonar]:
            arrays[layer.name][row] = layer.values(ping, class_id, first)
        if self.schema.body_arrays:
            boxes = boxes_of(ping, self.job.labels.height, quiet)
            bodies = first + boxes.body_id.astype(int) - 1
            arrays["body_box"][row, bodies] = np.hstack([boxes.beams, boxes.bins])
            arrays["body_pixels"][row, bodies] = boxes.pixels
            arrays["body_bins"][row, bodies] = boxes.n_bins
            arrays["body_echo"][row, first : first + len(ping.body_echo) - 1] = ping.body_echo[1:]

    def end(self):
        for sonar, arrays in self.arrays.items():
            self.names += self._store.write(sonar, self.numbers[0], arrays)
        return self.names


class PicturesOutput(CountsOutput):
    """Fan images in colour, NPZ files, and a film of each sonar."""

    table_name = "pictures"

    def __init__(self, *context):
        super().__init__(*context)
        self._draw = self.table.style
        self._filmed = tuple(self.requests.sonars) if "mp4" in self.table.formats else ()

    def add(self, request, sonar, ping, quiet):
        ping = self.with_counts(sonar, ping)
        if "png" in self.table.formats:
            picture = self._draw(ping)
            self.put(ping_file(f"png/{sonar}", request.number, "png"), png_bytes(picture))
        if "npz" in self.table.formats:
            self.put(ping_file(f"npz/{sonar}", request.number, "npz"), npz_bytes(ping))

    def try_out(self) -> None:
        """Write a film of one black picture of each sonar; raise an Error if that is not possible on this machine."""
        for name in self._filmed:
            sonar = self.requests.sonars[name]
            silence = np.zeros((sonar.n_beams, sonar.n_bins), np.float32)
            ping = Ping(silence, sonar.azimuth_rad, sonar.range_m, sonar=sonar)
            picture = self._draw(self.with_counts(name, ping))
            with (
                TemporaryDirectory() as folder,
                errors_at(f"{self.job.where}: pictures: the film of {name!r}"),
            ):
                save_animation(Path(folder) / "film.mp4", [picture], self.table.fps)

    def join(self, manifest):
        names = []
        for sonar in self._filmed:
            frames = self._frames(sonar, manifest.n_pings)
            if (first := next(frames, None)) is not None:  # otherwise all pings were set aside
                names.append(f"{sonar}.mp4")
                with self.folder.writing(names[-1]) as path:
                    save_animation(path, chain([first], frames), self.table.fps)
        return names

    def _frames(self, name: str, n_pings: int) -> Iterator[np.ndarray]:
        """Yield the picture of each ping in the store."""
        arrays = PingStore(self.folder, len(self.requests.sonars)).group(name)
        sonar = self.requests.sonars[name]
        for first in range(0, n_pings, CHUNK_PINGS):
            chunk = slice(first, first + CHUNK_PINGS)
            for intensity in arrays["intensity"][chunk][arrays["status"][chunk] == MADE]:
                ping = Ping(intensity, sonar.azimuth_rad, sonar.range_m, sonar=sonar)
                yield self._draw(self.with_counts(name, ping))


def own_shares(bins: np.ndarray, ping: Ping, quiet: Ping, power: np.ndarray | None) -> np.ndarray:
    """Return the share of each body's own echo in all that its bins hold in the mean, (bodies + 1,), by number.

    bins : (B, K), number of the body in each bin, 0 for none
    ping, quiet : Ping with the labels, and the same without noise
    power : mean power of the receiver's noise, as of `receiver_power`
    """
    whole = quiet.intensity if power is None else quiet.intensity + power
    own = np.bincount(bins.ravel(), (ping.share * quiet.intensity).ravel(), len(ping.body_echo))
    total = np.bincount(bins.ravel(), whole.ravel(), len(ping.body_echo))
    return np.divide(own, total, out=np.zeros_like(own), where=total > 0)


class CocoOutput(CountsOutput):
    """Gray fan images, masks of the instances in them, and COCO's records of both."""

    table_name = "coco"

    def __init__(self, *context):
        super().__init__(*context)
        self._lines, self._instances = {}, {}

    def begin(self, part, numbers):
        super().begin(part, numbers)
        self._lines = {sonar: [] for sonar in self.requests.sonars}

    def add(self, request, sonar, ping, quiet):
        height, law = self.table.height, self.with_counts(sonar, ping).counts_law()
        picture = law.counts_of(fan_image(ping, height, law))
        if request.scene not in self._instances:
            self._instances[request.scene] = self.schema.instances(request.scene)
        instances = self._instances[request.scene]
        if not instances.are_bodies:
            echo = np.bincount(instances.number_of, ping.body_echo, len(ping.body_echo))
            ping = replace(ping, body_id=instances.number_of[ping.body_id], body_echo=echo)
        ids, bins = body_map_and_bins(ping, height, self.with_counts(sonar, quiet))
        ids = np.where(picture > 0, ids, 0)
        name = ping_file(f"coco/{sonar}/images", request.number, "png")
        self.put(name, png_bytes(picture))
        mask_name = ping_file(f"coco/{sonar}/masks", request.number, "png")
        self.put(mask_name, png_bytes(mask_picture(ids)))
        image, annotations = coco_records(
            ids,
            self.schema.scene_class_id(request.scene),
            request.number,
            name.removeprefix(f"coco/{sonar}/images/"),
            names=instances.names,
            echo=ping.body_echo,
            own_share=own_shares(bins, ping, quiet, receiver_power(quiet, request.noise)),
            ping=request.number,
            scene=self.job.scenes[request.scene],
            counts=asdict(law),
        )
        annotations = [one for one in annotations if one["area"] >= (self.table.min_area or 1)]
        self._lines[sonar].append((request.number, coco_lines(image, annotations)))

    def end(self):
        for sonar, lines in self._lines.items():
            self.put(self._part_name(sonar, self.part), b"".join(line for _, line in sorted(lines)))
        return self.names

    def join(self, manifest):
        names, categories = [], []
        for number, name in enumerate(self.schema.classes, 1):
            categories.append({"id": number, "name": name, "supercategory": ""})
        for sonar in self.requests.sonars:
            names.append(f"coco/{sonar}/instances.json")
            parts = [
                partial(self.folder.open, self._part_name(sonar, part)) for part in range(manifest.n_parts)
            ]
            info = {"description": f"{self.job.name}, sonar {sonar}"}
            with self.folder.writing(names[-1]) as path, path.open("wb") as out:
                out.writelines(coco_json(parts, categories, info))
        return names

    @staticmethod
    def _part_name(sonar: str, part: int) -> str:
        """Return the name of the file with a part's records."""
        return f"coco/{sonar}/parts/{part:07d}.jsonl"


class OpticalOutput(Output):
    """RGB and depth of a camera on the vehicle.

    records : number of the ping -> CameraRecord, for the pings of the part, if the job has a ROS bag
    """

    def __init__(self, *context, device: int | None = None):
        super().__init__(*context)
        table, self._device = self.job.optical, device
        self.camera = Camera.of_fov(table.width, table.height, fov_x_rad=table.fov_x_rad)
        self.records = {}
        self._mount, self._scene, self._renderer = make_pose(*table.mount), None, None

    def begin(self, part, numbers):
        super().begin(part, numbers)
        self.records = {}

    def add(self, request, sonar, ping, quiet):
        if sonar != next(iter(self.requests.sonars)):  # one image for all sonars
            return
        if request.scene != self._scene:
            if self._renderer is not None:
                self._renderer.close()
            self._scene = request.scene
            scene = self.requests.scenes[request.scene]
            self._renderer = OpticalCamera(scene, self.camera, device=self._device)
        pose = request.vehicle_pose @ self._mount
        rgb, depth_m = self._renderer(pose, request.bodies)
        millimetres = np.where(depth_m < MAX_DEPTH_M, np.rint(1e3 * depth_m), 0).astype(np.uint16)
        self.put(ping_file("optical/rgb", request.number, "png"), png_bytes(rgb))
        self.put(ping_file("optical/depth", request.number, "png"), png_bytes(millimetres))
        if self.job.ros is not None:
            # a finite depth is a point to readers of ROS, 0 one at the camera (REP 118)
            seen_m = np.where(depth_m > 0, depth_m, np.float32(np.nan))
            self.records[request.number] = CameraRecord(
                request.time_s, pose, self.camera.intrinsics, rgb, seen_m, request.vehicle_pose
            )


class RosOutput(CountsOutput):
    """A ROS 2 bag, one file for each part.

    optical : the camera whose images also go into the bag, or None. It must get each part first
    """

    table_name = "ros"

    def __init__(self, *context, optical: OpticalOutput | None = None):
        super().__init__(*context)
        self._settings = BagSettings(self.table.y_sign)
        self._optical, self._records = optical, []

    def begin(self, part, numbers):
        super().begin(part, numbers)
        self._records = []

    def add(self, request, sonar, ping, quiet):
        ping, height = self.with_counts(sonar, ping), self.table.image_height
        law = ping.counts_law()
        picture = law.counts_of(fan_image(ping, height, law)) if height else None
        record = PingRecord(request.time_s, sonar, ping, picture, request.vehicle_pose)
        self._records.append((request.number, record))

    def end(self):
        self._records += self._optical.records.items() if self._optical else ()
        if self._records:
            self._records.sort(key=itemgetter(0))
            self.names.append(self._part_name(self.part))
            with self.folder.writing(self.names[-1]) as path:
                write_part(path, (record for _, record in self._records), self._settings)
        self._records = []
        return self.names

    def join(self, manifest):
        names = [self._part_name(part) for part in range(manifest.n_parts)]
        existing = [name for name in names if self.folder.fs.exists(self.folder.path(name))]
        if existing:  # otherwise all pings were set aside
            contents = []
            for name in existing:
                with self.folder.open(name) as file:
                    contents.append(read_contents(file, PurePosixPath(name).name))
            self.folder.put("bag/metadata.yaml", bag_metadata(contents).encode())
        return ["bag/metadata.yaml"] if existing else []

    @staticmethod
    def _part_name(part: int) -> str:
        """Return the name of the file with a part's messages."""
        return f"bag/part_{part:07d}.mcap"


def try_outputs(requests: BatchRequests, schema: Schema, folder: Folder) -> None:
    """Raise an Error if this machine cannot write an output, before a batch that cannot be completed is begun."""
    if requests.job.pictures is not None:
        PicturesOutput(requests, schema, folder).try_out()


def make_outputs(
    requests: BatchRequests, schema: Schema, folder: Folder, device: int | None = None
) -> list[Output]:
    """Return the outputs that a job has; those that render do so on this device, as for `OpticalCamera`."""
    job, context = requests.job, (requests, schema, folder)
    optical = OpticalOutput(*context, device=device) if job.optical is not None else None
    outputs = [
        ArraysOutput(*context),
        PicturesOutput(*context) if job.pictures is not None else None,
        CocoOutput(*context) if job.coco is not None else None,
        optical,
        RosOutput(*context, optical=optical) if job.ros is not None else None,
    ]
    return [output for output in outputs if output is not None]
