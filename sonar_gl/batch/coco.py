"""Instances in fan images in the format of COCO: boxes and masks of bodies, in one file for a whole data set.

https://cocodataset.org/#format-data describes the fields of images, annotations and categories. Masks are run
lengths along columns, since bodies may be in pieces or have holes; iscrowd stays 0.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator

import numpy as np

from sonar_gl.core.errors import Error
from sonar_gl.core.extras import missing_module

try:
    from pycocotools import mask
except ModuleNotFoundError as why:
    raise missing_module("batch", why) from None

IDS_PER_IMAGE = 1 << 16  # the id of an annotation is image_id · IDS_PER_IMAGE + body_id
PREFIXES = {"images": b'["image", ', "annotations": b'["annotation", '}  # of lines in the files of parts
END = b"]\n"


def coco_records(
    ids: np.ndarray,
    class_of_body,
    image_id: int,
    file_name: str,
    names=None,
    echo=None,
    own_share=None,
    **more,
) -> tuple[dict, list[dict]]:
    """Return COCO's records of one fan image and of the bodies in it.

    Bodies that are one instance have the number of the first one.

    Raises Error if a number has no class.

    Parameters
    ----------
    ids : (H, W) uint16, number of the body at each pixel, 0 for none
    class_of_body : class of each body by number; bodies of class 0 have no annotation
    image_id : unique number, 0 or more
    file_name : path of the picture from the folder of images
    names, echo, own_share : of each body by number its name, its echo as in `Ping.body_echo`, and the share of its own
        echo in what its bins hold; or None
    more : plain values to add to the image

    Returns
    -------
    image : id, file_name, height, width, and `more`
    annotations : by rising number of the body: id = image_id · 65536 + body_id, image_id, category_id, bbox
        [x, y, w, h] and area in whole pixels, iscrowd, segmentation; and fields that COCO does not have:
        body_id, body (its name), echo and own_share
    """
    ids = np.asarray(ids)
    height, width = ids.shape
    image = {"id": int(image_id), "file_name": str(file_name), "height": height, "width": width, **more}
    down = ids.ravel(order="F")
    starts = np.append(0, np.flatnonzero(down[1:] != down[:-1]) + 1)
    edges, bodies = np.column_stack([starts, np.append(starts[1:], down.size)]), down[starts]
    found, classes = np.unique(bodies).tolist(), np.asarray(class_of_body)
    if found[-1] >= len(classes):
        raise Error(f"bodies of a mask must have a class each (got body {found[-1]} of {len(classes)} known)")
    found = [body for body in found if body > 0 and classes[body] > 0]
    if not found:
        return image, []
    runs = [_run_lengths(edges[bodies == body], down.size) for body in found]
    packed = mask.frPyObjects([{"counts": run, "size": [height, width]} for run in runs], height, width)
    annotations = []
    for body, area, box, one in zip(found, mask.area(packed), mask.toBbox(packed), packed, strict=True):
        annotation = {
            "id": int(image_id) * IDS_PER_IMAGE + body,
            "image_id": int(image_id),
            "category_id": int(classes[body]),
            "bbox": [int(edge) for edge in box],
            "area": int(area),
            "iscrowd": 0,
            "segmentation": {"size": [height, width], "counts": one["counts"].decode("ascii")},
            "body_id": body,
        }
        if names is not None:
            annotation["body"] = str(names[body])
        if echo is not None:
            annotation["echo"] = float(f"{echo[body]:.6g}")
        if own_share is not None:
            annotation["own_share"] = round(float(own_share[body]), 3)
        annotations.append(annotation)
    return image, annotations


def _run_lengths(edges: np.ndarray, total: int) -> list[int]:
    """Return the lengths of runs alternately outside and inside (n, 2) intervals, beginning outside."""
    counts = np.diff(edges.ravel(), prepend=0).tolist()
    rest = total - int(edges[-1, 1])
    return [*counts, rest] if rest else counts


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
    ids = np.asarray(ids)
    return ids.astype(np.uint8 if ids.max(initial=0) < 256 else np.uint16)


def _json(value) -> bytes:
    return json.dumps(value, ensure_ascii=False, allow_nan=False).encode()
