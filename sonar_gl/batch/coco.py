"""Instances in fan images in the format of COCO: boxes and masks of bodies, in one file for a whole data set.

https://cocodataset.org/#format-data describes the fields of images, annotations and categories. Masks are run
lengths along columns, since bodies may be in pieces or have holes; iscrowd stays 0.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator

import numpy as np
from pycocotools import mask

from sonar_gl.core.errors import Error

IDS_PER_IMAGE = 1 << 16  # the id of an annotation is image_id · IDS_PER_IMAGE + body_id
PREFIXES = {"images": b'["image", ', "annotations": b'["annotation", '}  # of lines in the files of parts
END = b"]\n"


def coco_records(
    ids: np.ndarray, class_of_body, image_id: int, file_name: str, names, echo, own_share, **more
) -> tuple[dict, list[dict]]:
    """Return COCO's records of one fan image, and of the bodies in it by rising number.

    Bodies that are one instance have the number of the first one. docs/batch.md describes the fields that COCO does not
    have. Raises Error if a number has no class.

    ids : (H, W) uint16, number of the body at each pixel, 0 for none
    class_of_body : class of each body by number; bodies of class 0 have no annotation
    image_id : unique number, 0 or more
    file_name : path of the picture from the folder of images
    names, echo, own_share : of each body by number its name, its echo as in `Ping.body_echo`, and the share of its own
        echo in what its bins hold
    more : plain values to add to the image
    """
    height, width = ids.shape
    image = {"id": image_id, "file_name": file_name, "height": height, "width": width, **more}
    down, annotations = np.asfortranarray(ids), []
    if (last := ids.max()) >= len(class_of_body):
        raise Error(
            f"bodies of a mask must have a class each (got body {last} of {len(class_of_body)} known)"
        )
    for body in np.flatnonzero(np.bincount(ids.ravel())).tolist():
        if body == 0 or class_of_body[body] == 0:
            continue
        packed = mask.encode((down == body).view(np.uint8))
        annotations.append(
            {
                "id": image_id * IDS_PER_IMAGE + body,
                "image_id": image_id,
                "category_id": int(class_of_body[body]),
                "bbox": [int(edge) for edge in mask.toBbox(packed)],
                "area": int(mask.area(packed)),
                "iscrowd": 0,
                "segmentation": {"size": [height, width], "counts": packed["counts"].decode("ascii")},
                "body_id": body,
                "body": names[body],
                "echo": float(f"{echo[body]:.6g}"),
                "own_share": round(float(own_share[body]), 3),
            }
        )
    return image, annotations


def coco_lines(image: dict, annotations: list[dict]) -> bytes:
    """Return the records of one image as lines of a part's file, for `coco_json`."""
    lines = [(PREFIXES["images"], image), *((PREFIXES["annotations"], one) for one in annotations)]
    return b"".join(kind + _json(record) + END for kind, record in lines)


def coco_json(parts: Iterable[Callable], categories: list[dict], info: dict) -> Iterator[bytes]:
    """Yield the text of one file of instances, joined from the files of parts. Memory use is that of a line.

    Raises Error if a line was not written by `coco_lines`, or is incomplete.

    parts : functions that open the files of parts for reading bytes, in order. Each file is read twice
    categories : id (from 1 on), name and supercategory of each class
    info : plain values; a date, for example, would make the bytes differ from run to run
    """
    parts = list(parts)
    yield _json({"info": info, "licenses": [], "categories": categories})[:-1]
    for name, kind in PREFIXES.items():
        yield f', "{name}": ['.encode()
        between = b"\n"
        for part in parts:
            with part() as lines:
                for number, line in enumerate(lines, 1):
                    if not (line.startswith(tuple(PREFIXES.values())) and line.endswith(END)):
                        where = getattr(lines, "name", "a part")
                        raise Error(
                            f"{where}, line {number}: must be a COCO record (got {line[:40]!r}; delete the "
                            "file and the record of its part, so that the part is made again)"
                        )
                    if line.startswith(kind):
                        yield between + line[len(kind) : -len(END)]
                        between = b",\n"
        yield b"\n]"
    yield b"}\n"


def mask_picture(ids: np.ndarray) -> np.ndarray:
    """Return a (H, W) picture of the bodies' numbers, uint8 if all are below 256, otherwise uint16."""
    return ids.astype(np.uint8 if ids.max() < 256 else np.uint16)


def _json(value) -> bytes:
    return json.dumps(value, ensure_ascii=False, allow_nan=False).encode()
