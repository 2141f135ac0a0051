"""What is kept of pings for other tools: COCO, optical images, ROS 2; and all outputs of a job."""

from __future__ import annotations

import numpy as np

from sonar_gl.batch.files import Folder
from sonar_gl.batch.kept import Kept
from sonar_gl.batch.orders import Orders
from sonar_gl.batch.outputs import Arrays, Output, Pictures, bag_name, coco_name, numbered
from sonar_gl.boxes import body_map
from sonar_gl.camera import Camera
from sonar_gl.export import png_bytes
from sonar_gl.image import fan_image
from sonar_gl.rigid import pose as make_pose


class Coco(Output):
    """Gray fan images, masks of bodies in them, and the records of both."""

    def __init__(self, *made_of):
        super().__init__(*made_of)
        self.table = self.orders.job.coco

    def begin(self, part, numbers):
        super().begin(part, numbers)
        self.lines = {name: [] for name in self.orders.sonars}

    def take(self, order, sonar, ping):
        from sonar_gl.batch.coco import coco_lines, coco_records, mask_picture

        height = self.table.height
        picture = np.rint(255 * fan_image(ping, height, "db", self.table.db_range)).astype(np.uint8)
        ids = np.where(picture > 0, body_map(ping, height), 0)  # what cannot be seen is no instance
        name = numbered(f"coco/{sonar}/images", order.number, "png")
        self.put(name, png_bytes(picture))
        self.put(numbered(f"coco/{sonar}/masks", order.number, "png"), png_bytes(mask_picture(ids)))
        names = ["", *(body.name for body in self.orders.scene(order.scene).bodies)]
        relative = name.removeprefix(f"coco/{sonar}/images/")
        about = self.kept.classes_of(order.scene), order.number, relative, names, ping.body_echo
        more = {"ping": order.number, "scene": self.orders.job.scenes[order.scene]}
        self.lines[sonar].append((order.number, coco_lines(*coco_records(ids, *about, **more))))

    def end(self):
        for sonar, lines in self.lines.items():
            self.put(coco_name(sonar, self.part), b"".join(line for _, line in sorted(lines)))
        return self.names


class Optical(Output):
    """RGB and depth of a camera on the vehicle.

    Attributes
    ----------
    seen : (pose, rgb, depth_m) of each ping of the part, by number, while `keep` is set
    """

    def __init__(self, *made_of):
        super().__init__(*made_of)
        table = self.orders.job.optical
        self.camera = Camera.of_fov(table.width, table.height, fov_x_rad=table.fov_x_rad)
        self.mount, self.keep, self.seen = make_pose(*table.mount), False, {}
        self._scene, self._drawn = None, None

    def begin(self, part, numbers):
        super().begin(part, numbers)
        self.seen = {}

    def take(self, order, sonar, ping):
        from sonar_gl.batch.optical import Optical as Drawn

        if sonar != next(iter(self.orders.sonars)):
            return
        if order.scene != self._scene:
            if self._drawn is not None:
                self._drawn.close()
            self._scene, self._drawn = order.scene, Drawn(self.orders.scene(order.scene), self.camera)
        pose = order.pose @ self.mount
        known = {body.name for body in self.orders.scene(order.scene).bodies}
        rgb, depth_m = self._drawn(pose, {name: at for name, at in order.bodies.items() if name in known})
        millimetres = np.where(depth_m < 65.5355, np.rint(1e3 * depth_m), 0).astype(np.uint16)
        self.put(numbered("optical/rgb", order.number, "png"), png_bytes(rgb))
        self.put(numbered("optical/depth", order.number, "png"), png_bytes(millimetres))
        if self.keep:
            self.seen[order.number] = pose, rgb, depth_m


class Ros(Output):
    """Parts of a ROS 2 bag."""

    def __init__(self, *made_of, optical: Optical | None = None):
        from sonar_gl.batch.ros_records import BagSettings

        super().__init__(*made_of)
        self.table, self.optical = self.orders.job.ros, optical
        table = self.table
        self.settings = BagSettings(table.y_sign, table.bits, table.scale, tuple(table.db_range))
        if optical is not None:
            optical.keep = True

    def begin(self, part, numbers):
        super().begin(part, numbers)
        self.records = []

    def take(self, order, sonar, ping):
        from sonar_gl.batch.ros_records import PingRecord

        height = self.table.image_height
        picture = fan_image(ping, height, self.table.scale, self.table.db_range) if height else None
        record = PingRecord(order.time_s, sonar, ping, picture, order.pose)
        self.records.append((order.number, len(self.records), record))

    def end(self):
        from sonar_gl.batch.ros import write_part
        from sonar_gl.batch.ros_records import CameraRecord

        for number, (pose, rgb, depth_m) in self.optical.seen.items() if self.optical else ():
            at = self.orders[number]
            about = at.time_s, "camera", pose, self.optical.camera.intrinsics, rgb, depth_m, at.pose
            self.records.append((number, len(self.records), CameraRecord(*about)))
        if self.records:
            name = bag_name(self.part)
            with self.folder.writing(name) as path:
                write_part(
                    path, (record for *_, record in sorted(self.records, key=lambda r: r[:2])), self.settings
                )
            self.names.append(name)
        self.records = []
        return self.names


def outputs_of(orders: Orders, kept: Kept, folder: Folder) -> list[Output]:
    """Those that the job asks for."""
    job, made_of = orders.job, (orders, kept, folder)
    out = [Arrays(*made_of)]
    if job.pictures is not None and {"png", "npz"} & set(job.pictures.formats):
        out.append(Pictures(*made_of))
    if job.coco is not None:
        out.append(Coco(*made_of))
    if job.optical is not None:
        out.append(Optical(*made_of))
    if job.ros is not None:
        out.append(Ros(*made_of, optical=out[-1] if job.optical is not None else None))
    return out
