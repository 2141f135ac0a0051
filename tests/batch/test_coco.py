"""COCO files, read by pycocotools."""

import json
import tracemalloc
from functools import partial

import cv2
import numpy as np
import pytest
from pycocotools import mask
from pycocotools.coco import COCO
from pycocotools.cocoeval import COCOeval

import sonar_gl as sg
from sonar_gl.batch.coco import coco_json, coco_lines, coco_records, mask_picture

# a warning of pycocotools when it decodes
pytestmark = pytest.mark.filterwarnings("ignore:__array__ implementation:DeprecationWarning")

CLASSES = [0, 2, 0, 1, 2, 1]  # of each body by number; body 2 is background
NAMES = ["", "diver", "floor", "tyre \u2028 1", "buoy", "unseen"]
CATEGORIES = [{"id": 1, "name": "tyre", "supercategory": "waste"}, {"id": 2, "name": "thing"}]
ECHO = [0.0, 1.25, 9.0, 0.333333333, 2.0, 0.0]


def id_map(seed):
    """Return an id map with a body in pieces, one with a hole, and one from top to bottom of a column."""
    rng = np.random.default_rng(seed)
    ids = np.zeros((40, 61), np.uint16)
    ids[20:] = 2
    ids[:, 7:9] = 3
    ids[rng.random(ids.shape) < 0.02] = 1
    ids[12:25, 30:44], ids[15:18, 33:40] = 4, 0
    return ids


def records(number):
    echo = {"names": NAMES, "echo": ECHO}
    return coco_records(id_map(number), CLASSES, number, f"png/{number:08d}.png", **echo, sonar="fls")


def join(parts, path, categories, info):
    """Join the files of parts into one file of instances."""
    with path.open("wb") as out:
        out.writelines(coco_json([partial(open, part, "rb") for part in parts], categories, info))


@pytest.fixture(scope="module")
def parts(tmp_path_factory):
    """The files of two parts, with pings 0..2 and 3..4."""
    folder = tmp_path_factory.mktemp("coco")
    for name, numbers in (("a", range(3)), ("b", range(3, 5))):
        (folder / name).write_bytes(b"".join(coco_lines(*records(number)) for number in numbers))
    return [folder / "a", folder / "b"]


@pytest.fixture
def joined(parts):
    """A COCO of its own for each test: COCOeval writes into the annotations."""
    path = parts[0].with_name("instances.json")
    join(parts, path, CATEGORIES, {"description": "made"})
    return COCO(str(path))


def test_boxes_and_masks_are_those_of_the_id_map(joined):
    assert joined.dataset["info"] == {"description": "made"}
    assert joined.loadCats([1, 2]) == CATEGORIES
    assert sorted(joined.getImgIds()) == [0, 1, 2, 3, 4]
    for number in range(5):
        (image,), ids = joined.loadImgs([number]), id_map(number)
        size = {"height": 40, "width": 61}
        assert image == {"id": number, "file_name": f"png/{number:08d}.png", **size, "sonar": "fls"}
        annotations = joined.loadAnns(joined.getAnnIds([number]))
        assert [one["body_id"] for one in annotations] == [1, 3, 4]
        for one in annotations:
            body = one["body_id"]
            rows, columns = np.nonzero(ids == body)
            np.testing.assert_array_equal(joined.annToMask(one), ids == body)
            box = [columns.min(), rows.min(), np.ptp(columns) + 1, np.ptp(rows) + 1]
            rest = {
                "id": number * 65536 + body,
                "image_id": number,
                "category_id": CLASSES[body],
                "iscrowd": 0,
            }
            rest |= {"bbox": box, "area": len(rows), "body": NAMES[body], "echo": round(ECHO[body], 6)}
            rest |= {"segmentation": one["segmentation"], "body_id": body}
            assert one == rest


def test_the_annotations_as_detections_score_1(joined):
    """By boxes and by masks; an id of 0, for example, would be ignored."""
    for kind, key in (("bbox", "bbox"), ("segm", "segmentation")):
        keys = "image_id", "category_id", key
        found = [{**{key: one[key] for key in keys}, "score": 0.9} for one in joined.dataset["annotations"]]
        score = COCOeval(joined, joined.loadRes(found), kind)
        score.evaluate(), score.accumulate(), score.summarize()
        assert score.stats[0] == 1.0


def test_run_lengths_are_those_of_pycocotools():
    """To the byte, also for maps of one pixel, row or column, empty and full ones."""
    rng = np.random.default_rng(1)
    for shape in [(1, 1), (1, 9), (9, 1), (13, 17), (300, 200)]:
        for share in (0.0, 0.1, 0.6, 1.0):
            ids = rng.integers(1, 60, shape).astype(np.uint16) * (rng.random(shape) < share)
            _, annotations = coco_records(ids, [0] + [1] * 60, 7, "a.png")
            assert [one["body_id"] for one in annotations] == [b for b in np.unique(ids).tolist() if b]
            for one in annotations:
                expected = mask.encode(np.asfortranarray(ids == one["body_id"], np.uint8))
                assert one["segmentation"]["counts"] == expected["counts"].decode()
                assert one["bbox"] == mask.toBbox(expected).tolist()
                assert one["area"] == mask.area(expected)


def test_the_division_into_parts_does_not_change_the_bytes(parts, joined, tmp_path):
    together, path = tmp_path / "all", tmp_path / "instances.json"
    together.write_bytes(b"".join(part.read_bytes() for part in parts))
    join([together], path, CATEGORIES, {"description": "made"})
    assert path.read_bytes() == parts[0].with_name("instances.json").read_bytes()
    assert sorted(tmp_path.iterdir()) == [together, path]
    join([], path, CATEGORIES, {})
    empty = {"info": {}, "licenses": [], "categories": CATEGORIES, "images": [], "annotations": []}
    assert json.loads(path.read_bytes()) == empty


def test_a_damaged_line_is_named(parts, tmp_path):
    path, broken = tmp_path / "instances.json", tmp_path / "broken"
    broken.write_bytes(parts[0].read_bytes()[:-9])
    with pytest.raises(sg.Error, match=r"broken, line 12: must be a COCO record \(got b'\[\"annotation\", "):
        join([parts[1], broken], path, CATEGORIES, {})
    with pytest.raises(sg.Error, match=r"^bodies of a mask must have a class each \(got body 4 of 3 known\)"):
        coco_records(id_map(0), CLASSES[:3], 0, "a.png")


def test_annotations_are_not_kept_in_memory():
    """A hundred times as many take no more memory."""
    lines = coco_lines(*records(1)).splitlines(keepends=True)

    class Part(list):
        def __enter__(self):
            return iter(self)

        def __exit__(self, *_):
            pass

    def peak(times):
        tracemalloc.reset_peak()
        size = sum(map(len, coco_json([lambda: Part(lines)] * times, CATEGORIES, {})))
        return size, tracemalloc.get_traced_memory()[1]

    tracemalloc.start()
    (small, few), (large, many) = peak(10), peak(1000)
    tracemalloc.stop()
    assert large > 90 * small
    assert many < few + 20_000  # for the list of parts; the text has a megabyte


@pytest.mark.parametrize(("highest", "dtype"), [(255, np.uint8), (256, np.uint16), (65535, np.uint16)])
def test_masks_have_the_numbers_of_bodies(tmp_path, highest, dtype):
    ids = id_map(0)
    ids[3, 5] = highest
    sg.save_png(tmp_path / "mask.png", mask_picture(ids))
    again = cv2.imread(str(tmp_path / "mask.png"), cv2.IMREAD_UNCHANGED)
    assert again.dtype == mask_picture(ids).dtype == dtype
    np.testing.assert_array_equal(again, ids)
