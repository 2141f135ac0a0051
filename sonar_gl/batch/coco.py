"""Instances in fan images as COCO has them: boxes and masks of bodies, in one file of a whole data set.

https://cocodataset.org/#format-data tells the fields of images, annotations and categories. Masks are run
lengths down the columns, which bodies in pieces and with holes need; iscrowd stays 0.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator

import numpy as np
from pycocotools import mask

from sonar_gl.types import Error

BODIES = 1 << 16  # annotations' numbers are image_id times this, and the body's
KINDS = {"images": b'["image", ', "annotations": b'["annotation", '}  # how their lines begin
END = b"]\n"


def coco_records(
    ids: np.ndarray, class_of_body, image_id: int, file_name: str, names=None, echo=None, **more
) -> tuple[dict, list[dict]]:
    """One fan image and the bodies in it.

    Parameters
    ----------
    ids : (H, W) uint16, number of the body at each pixel, 0 for none
    class_of_body : of each number, from 0 on; 0 for the background, which has no annotation
    image_id : 0 or more, unlike that of all others
    file_name : of the picture, from the folder that tools are told
    names, echo : of each number, from 0 on: its name, and the sum of its echo as in `Ping.body_echo`; or None
    more : plain values for the image

    Returns
    -------
    image : id, file_name, height, width, and `more`
    annotations : by rising number of the body: id = image_id · 65536 + body_id, image_id, category_id, bbox
        [x, y, w, h] and area in whole pixels, iscrowd, segmentation; and, which tools pass over, body_id,
        body (its name) and echo

    Raises
    ------
    Error
        if a number has no class.
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
            "id": int(image_id) * BODIES + body,
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
        annotations.append(annotation)
    return image, annotations


def _run_lengths(edges: np.ndarray, total: int) -> list[int]:
    """Lengths of runs out of and in what (n, 2) edges enclose, by turns, the first of them out of it."""
    counts = np.diff(edges.ravel(), prepend=0).tolist()
    rest = total - int(edges[-1, 1])
    return [*counts, rest] if rest else counts


def coco_lines(image: dict, annotations: list[dict]) -> bytes:
    """Records of one image as lines of a part's file, for `coco_json`; the same give the same bytes."""
    lines = [(KINDS["images"], image), *((KINDS["annotations"], one) for one in annotations)]
    return b"".join(kind + _json(record) + END for kind, record in lines)


def coco_json(parts: Iterable[Callable], categories: list[dict], info: dict) -> Iterator[bytes]:
    """One file of instances from those of parts, piece by piece; each part is read twice, a line at a time.

    Parameters
    ----------
    parts : functions that open, for reading bytes, what `coco_lines` made, in order
    categories : id (from 1 on), name and supercategory of each class
    info : plain values; what changes from run to run, such as a date, changes the bytes

    Raises
    ------
    Error
        if a line is none of `coco_lines`, or not whole.
    """
    parts = list(parts)
    yield _json({"info": info, "licenses": [], "categories": categories})[:-1]
    for name, kind in KINDS.items():
        yield f', "{name}": ['.encode()
        between = b"\n"
        for part in parts:
            with part() as lines:
                for number, line in enumerate(lines, 1):
                    if not (line.startswith(tuple(KINDS.values())) and line.endswith(END)):
                        where = getattr(lines, "name", "a part")
                        raise Error(
                            f"{where}, line {number}: must be a COCO record (got {line[:40]!r}; delete the "
                            "file, and have its part made again)"
                        )
                    if line.startswith(kind):
                        yield between + line[len(kind) : -len(END)]
                        between = b",\n"
        yield b"\n]"
    yield b"}\n"


def mask_picture(ids: np.ndarray) -> np.ndarray:
    """(H, W) picture whose values are the bodies' numbers: uint8 if they are below 256, or else uint16."""
    ids = np.asarray(ids)
    return ids.astype(np.uint8 if ids.max(initial=0) < 256 else np.uint16)


def _json(value) -> bytes:
    return json.dumps(value, ensure_ascii=False, allow_nan=False).encode()
