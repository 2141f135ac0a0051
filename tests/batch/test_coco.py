"""COCO files, read by pycocotools."""

import json
import tracemalloc
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
import xarray as xr
from pycocotools import mask
from pycocotools.coco import COCO
from pycocotools.cocoeval import COCOeval

import sonar_gl as sg
from sonar_gl.batch.coco import coco_json, coco_lines, coco_records, mask_picture
from sonar_gl.imaging.boxes import body_map, boxes_of
from sonar_gl.noise.reception import receiver_power
from tests.support.batch_pings import N_SMALL
from tests.support.batches import BOX, LABELS, make_all, write_job, write_plain_job

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
    of_bodies = NAMES, ECHO, [0.5] * len(NAMES)
    return coco_records(id_map(number), CLASSES, number, f"png/{number:08d}.png", *of_bodies, sonar="fls")


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
            rest |= {"own_share": 0.5, "segmentation": one["segmentation"], "body_id": body}
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
            _, annotations = coco_records(ids, [0] + [1] * 60, 7, "a.png", *[[0] * 61] * 3)
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
        coco_records(id_map(0), CLASSES[:3], 0, "a.png", NAMES, ECHO, ECHO)


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


def test_coco_finds_bodies_where_the_labels_are_but_for_what_boxes_leave_out(small, requests, pings, quiet):
    for sonar in requests.sonars:
        folder = small / "out" / "coco" / sonar
        coco = COCO(str(folder / "instances.json"))
        assert coco.getImgIds() == list(range(N_SMALL))
        assert [c["name"] for c in coco.loadCats(coco.getCatIds())] == ["fixed", "target"]
        for number, ping in enumerate(pings[sonar]):
            (image,) = coco.loadImgs(number)
            picture = cv2.imread(str(folder / "images" / image["file_name"]), cv2.IMREAD_UNCHANGED)
            mask = cv2.imread(str(folder / "masks" / image["file_name"]), cv2.IMREAD_UNCHANGED)
            bodies = body_map(ping, 100, quiet[sonar][number])
            assert np.array_equal(mask, np.where(picture > 0, bodies, 0))
            law = sg.Counts(**image["counts"])
            assert law == ping.counts_law() and np.array_equal(
                picture, law.counts_of(sg.fan_image(ping, 100, law))
            )
            annotations = coco.loadAnns(coco.getAnnIds(number))
            assert {a["body_id"] for a in annotations} == set(np.unique(mask)) - {0}
            for annotation in annotations:
                assert np.array_equal(coco.annToMask(annotation), mask == annotation["body_id"])


def test_annotations_state_the_share_of_own_echo_in_what_their_bins_hold(small, requests, pings, quiet):
    """Beside all other echo and the mean of the receiver's noise, which differs from ping to ping."""
    found = []
    for sonar in requests.sonars:
        coco = COCO(str(small / "out" / "coco" / sonar / "instances.json"))
        for request, noisy, ping in zip(requests, pings[sonar], quiet[sonar], strict=True):
            whole, boxes = ping.intensity + receiver_power(ping, request.noise), boxes_of(noisy, 100, ping)
            for one in coco.loadAnns(coco.getAnnIds(request.number)):
                row = boxes.body_id.tolist().index(one["body_id"])
                (beam, last_beam), (bin_, last_bin) = boxes.beams[row], boxes.bins[row]
                inside = np.s_[beam : last_beam + 1, bin_ : last_bin + 1]
                is_own = noisy.body_id[inside] == one["body_id"]
                own = (noisy.share * ping.intensity)[inside][is_own]
                assert one["own_share"] == pytest.approx(own.sum() / whole[inside][is_own].sum(), abs=1e-3)
                found.append(one["own_share"])
    assert len(set(found)) > 10 and 0 < min(found) < 0.9 < max(found) <= 1


@pytest.mark.slow
def test_bodies_of_few_pixels_have_no_annotation_if_the_job_wants_none(small, tmp_path):
    """Only these differ, and images and masks do not."""
    path = write_job(tmp_path, 2, LABELS + "[coco]\nheight = 100\nmin_area = 40\n")
    make_all(path, tmp_path / "out")
    of_all, left_out = [], 0
    for sonar in ("level", "upright"):
        folder = Path("coco") / sonar
        every, large = (COCO(str(at / "out" / folder / "instances.json")) for at in (small, tmp_path))
        for number in range(2):
            found = every.loadAnns(every.getAnnIds(number))
            of_all += found
            assert large.loadAnns(large.getAnnIds(number)) == [one for one in found if one["area"] >= 40]
            left_out += sum(one["area"] < 40 for one in found)
            (image,) = large.loadImgs(number)
            for kind in ("images", "masks"):
                name = folder / kind / image["file_name"]
                assert (tmp_path / "out" / name).read_bytes() == (small / "out" / name).read_bytes()
    assert 0 < left_out < len(of_all)


RIG = """<model name="rig"><pose>3 0.2 -0.3 0 0 0</pose>{}</model>
<model name="rig2"><static>true</static><pose>4 -0.6 -0.3 0 0 0</pose>{}</model>
"""
LINK = """<link name="{}"><pose>{} 0 0 0 0 0</pose><collision name="c">
<geometry><box><size>0.2 0.2 0.2</size></box></geometry><laser_retro>120</laser_retro></collision></link>
"""


@pytest.mark.parametrize("together", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_bodies_of_one_model_and_class_are_one_instance_of_coco(tmp_path, together):
    path, links = write_plain_job(tmp_path, 2, 2, ""), LINK.format("a", 0) + LINK.format("b", 0.5)
    scene = (tmp_path / "tank.sdf").read_text().replace(BOX, RIG.format(links, LINK.format("a", 0)))
    (tmp_path / "tank.sdf").write_text(scene)
    classes = 'rigs = ["rig*"]' if together else 'rigs = ["rig::a", "rig2"]\nother = ["rig::b"]'
    with path.open("a") as job:
        job.write(
            f"[labels]\nlayers = ['body', 'boxes']\n[labels.classes]\n{classes}\n[coco]\nheight = 200\n"
        )
    make_all(path, tmp_path / "out")
    data = xr.open_dataset(tmp_path / "out" / "pings.zarr")
    assert data.attrs["bodies"] == ["wall", "rig::a", "rig::b", "rig2", "floor"]
    folder = tmp_path / "out" / "coco" / "level"
    coco = COCO(str(folder / "instances.json"))
    for number in range(2):
        stored = data.isel(ping=number)
        assert {2, 3, 4} < set(np.unique(stored.body_id))  # the arrays have each body
        mask = cv2.imread(str(folder / "masks" / "00000" / f"{number:08d}.png"), cv2.IMREAD_UNCHANGED)
        assert set(np.unique(mask)) == ({0, 1, 2, 4, 5} if together else {0, 1, 2, 3, 4, 5})
        found = coco.loadAnns(coco.getAnnIds(number))
        told = [
            (one["id"] - 65536 * number, one["body_id"], one["body"], one["category_id"]) for one in found
        ]
        names = ["rig", "rig2"] if together else ["rig::a", "rig::b", "rig2"]
        classes = [1, 1] if together else [1, 2, 1]
        numbers = [2, 4] if together else [2, 3, 4]
        assert told == list(zip(numbers, numbers, names, classes, strict=True))
        for one in found:
            assert np.array_equal(coco.annToMask(one), mask == one["body_id"])
            bodies = [1, 2] if together and one["body_id"] == 2 else [one["body_id"] - 1]
            assert one["echo"] == pytest.approx(float(stored.body_echo[bodies].sum()), rel=1e-5)
