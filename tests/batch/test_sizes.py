"""Bodies whose size differs from ping to ping in a batch."""

import json

import numpy as np
import pytest
import xarray as xr

import sonar_gl as sg
from sonar_gl.batch.job import Job, read_job
from sonar_gl.batch.job_warnings import model_warnings
from sonar_gl.batch.requests import BatchRequests
from sonar_gl.core.poses import scale_of, unscaled
from tests.support.batches import BOX, FLOOR, make_all, write_job, write_plain_job
from tests.support.command_line import BODY, WALL, run

TURN = {"roll_rad": [-3.0, 3.0], "pitch_rad": [-1.5, 1.5], "yaw_rad": [-3.0, 3.0]}
SIZES = {"scale": [0.7, 1.4]}


@pytest.fixture
def job(tmp_path):
    return write_job(tmp_path, 40, "")


def bodies_of(job, *tables, **changes):
    """Return where bodies are in each ping."""
    plain = read_job(job).plain | {"vary": {"bodies": list(tables)}} | changes
    return [request.bodies for request in BatchRequests(Job(**plain))]


def test_each_ping_draws_a_size_and_nothing_else_of_the_body_depends_on_it(job):
    table = {"names": ["box_1"], "x_m": [-1.0, 1.0], "there": 0.8, "reflectivity": [0.1, 0.9], **TURN}
    found, expected, scales = bodies_of(job, table | SIZES), bodies_of(job, table), []
    for larger, own in zip(found, expected, strict=True):
        if own["box_1"] is None:
            assert larger["box_1"] is None
            continue
        scales.append(scale_of(larger["box_1"]))
        # about its own origin: the place stays
        np.testing.assert_allclose(unscaled(larger["box_1"]), own["box_1"], rtol=0, atol=1e-12)
    assert 0.7 <= min(scales) < 0.8 and 1.3 < max(scales) <= 1.4
    assert len(set(scales)) == len(scales)
    assert bodies_of(job, {"names": ["box_1"], "scale": 1.0}) == [{}] * 40


def test_bodies_rest_on_a_floor_whatever_their_size(job):
    table = {"names": ["box_1"], "rests_on": "floor", **TURN, **SIZES}
    for bodies in bodies_of(job, table):
        pose = bodies["box_1"]
        lowest_m = pose[2, 3] - 0.1 * np.abs(pose[2, :3]).sum()  # of a box with edges of 0.2 m, as scaled
        assert lowest_m == pytest.approx(-0.4, abs=1e-9)


def test_bodies_keep_clear_of_each_other_by_their_sizes(job):
    boxes = "".join(BODY.format(f"box_{k}", f"3 {0.3 * k} -0.3", "0.2 0.2 0.2") for k in (1, 2))
    (job.parent / "tank.sdf").write_text(f'<sdf version="1.9"><world name="tank">{boxes}{WALL}</world></sdf>')
    reach = {"x_m": [-0.6, 0.6], "y_m": [-0.6, 0.6], "clearance_m": 0.05, "apart": True, "scale": [0.5, 2.0]}
    for bodies in bodies_of(job, {"names": ["box_*"], **reach}):
        one, two = bodies["box_1"], bodies["box_2"]
        half_m = 0.1 * (scale_of(one) + scale_of(two))
        assert np.abs(one[:2, 3] - two[:2, 3]).max() >= half_m + 0.05 - 1e-12


def test_a_model_has_one_size_about_the_point_about_which_it_turns(job):
    """Along a path, that is its own pose, else the place of the first body named."""
    scene = sg.load_scene("diver")
    names = [one.name for one in scene.bodies_and_plumes if one.name.startswith("diver")]
    table = {"names": ["diver", "diver::*"], "yaw_rad": 0.3, "scale": 1.5}
    swim = job.parent / "swim.csv"
    swim.write_text("t,x,y,z,roll,pitch,yaw\n0,3,0,0,0,0,1\n100,3,0,0,0,0,1\n")
    known = {one.name: one.pose for one in scene.bodies_and_plumes}
    for more, home, place in (
        ({}, known[names[0]], known[names[0]]),
        ({"path": "swim.csv"}, scene.models["diver"], sg.pose(3, yaw=1.0)),
    ):
        (bodies, *_) = bodies_of(job, table | more, scenes=["diver"])
        moved = place @ sg.pose(yaw=0.3) @ np.diag([1.5, 1.5, 1.5, 1]) @ np.linalg.inv(home)
        assert set(bodies) == set(names)
        for name in names:
            np.testing.assert_allclose(bodies[name], moved @ known[name], rtol=0, atol=1e-12)
    plain = read_job(job).plain | {"vary": {"bodies": [{"names": ["diver"], "scale": 1.5}]}}
    (text,) = model_warnings(BatchRequests(Job(**plain | {"scenes": ["diver"]})), 0)
    assert "vary.bodies[0] moves 'diver' without diver::" in text


LABELS = """
[arrays]
mantissa_bits = 23
[labels]
layers = ["body", "class", "elevation", "range", "incidence", "share", "shadow", "boxes"]
[labels.classes]
box = ["box_1"]
[coco]
height = 100
"""


def test_arrays_boxes_and_instances_are_those_of_a_scene_with_a_larger_mesh(tmp_path):
    """Twice as large, which rounds nothing: the same bytes. The ping is made again from what is stored."""
    (one, two) = (tmp_path / name for name in ("one", "two"))
    for folder in (one, two):
        folder.mkdir()
    job = write_plain_job(one, 4, 4, '[[vary.bodies]]\nnames = ["box_1"]\nscale = 2\n' + LABELS)
    other = write_plain_job(two, 4, 4, LABELS)
    larger = BOX.replace("0.2 0.2 0.2", "0.4 0.4 0.4")
    assert larger != BOX
    (two / "tank.sdf").write_text(
        f'<sdf version="1.9"><world name="tank">{WALL}{larger}{FLOOR}</world></sdf>'
    )
    make_all(job, one / "out")
    make_all(other, two / "out")
    data, expected = (xr.open_dataset(folder / "out" / "pings.zarr") for folder in (one, two))
    assert set(data.data_vars) - set(expected.data_vars) == {"moved_pose"}
    for name in expected.data_vars:
        np.testing.assert_array_equal(data[name], expected[name], name)
    annotated = [
        json.loads((folder / "out" / "coco" / "level" / "instances.json").read_text())["annotations"]
        for folder in (one, two)
    ]
    assert annotated[0] and annotated[0] == annotated[1]
    sonar, acoustics, noise = (
        kind(**json.loads(data.attrs[name]))
        for kind, name in ((sg.Sonar, "specification"), (sg.Acoustics, "acoustics"), (sg.Noise, "noise"))
    )
    sampling = sg.Sampling(float(data.columns_per_beam[1]), int(data.rows[1]))
    with sg.Simulator(sg.load_scene(one / "tank.sdf"), sonar, acoustics, sampling) as simulator:
        ping = simulator.ping(
            data.pose[1].values,
            noise,
            int(data.attrs["noise_seed"]),
            ping_number=1,
            time_s=float(data.time_s[1]),
            bodies={"box_1": data.moved_pose[1, 0].values},
        )
    assert np.array_equal(ping.intensity, data.intensity[1])


NUMBER, LIMITS = "should be a number, or [low, high]", "should lie in 0.01..100"


@pytest.mark.parametrize(
    ("value", "sentence"),
    [
        ("0", f"{LIMITS} (got 0; 1 is the size in the scene)"),
        ("-1.5", f"{LIMITS} (got -1.5; 1 is the size in the scene)"),
        ("[0.0, 1.0]", f"{LIMITS} (got [0.0, 1.0]; 1 is the size in the scene)"),
        ("1000", f"{LIMITS} (got 1000; 1 is the size in the scene)"),
        ("[1.4, 0.7]", f"{NUMBER} (got [1.4, 0.7]; 1 is the size in the scene)"),
        ("[1.0]", f"{NUMBER} (got [1.0]; 1 is the size in the scene)"),
        ("[1.0, 1.0, 2.0]", f"{NUMBER} (got [1.0, 1.0, 2.0]; 1 is the size in the scene)"),
        ('"large"', f"{NUMBER} (got 'large'; 1 is the size in the scene)"),
        ("true", f"{NUMBER} (got True; 1 is the size in the scene)"),
        ("inf", f"{NUMBER} (got inf; 1 is the size in the scene)"),
        ("[nan, 1.0]", f"{NUMBER} (got [nan, 1.0]; 1 is the size in the scene)"),
    ],
)
def test_errors_name_the_key_and_what_it_may_hold(tmp_path, value, sentence):
    path = write_job(tmp_path)
    path.write_text(path.read_text().replace("there = 0.8", f"scale = {value}"))
    status, out, err = run("batch", path, "--out", tmp_path / "out", "--workers", "1")
    assert (status, out) == (2, "") and err.startswith(f"error: {path}: vary.bodies[0].scale: {sentence}")
