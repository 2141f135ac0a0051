"""Bodies that follow paths while the pings of a batch go on."""

import json
import re

import numpy as np
import pytest
import xarray as xr

import sonar_gl as sg
from sonar_gl.batch.job import Job, read_job
from sonar_gl.batch.job_warnings import model_warnings
from sonar_gl.batch.requests import BatchRequests
from sonar_gl.core.pose_track import PoseTrack
from sonar_gl.core.poses import read_poses
from tests.support.batches import BOX, FLOOR, files_of, make_all, write_job, write_plain_job
from tests.support.command_line import BODY, WALL, run
from tests.support.inline_pool import use_inline_pool

HEADER = "t,x,y,z,roll,pitch,yaw\n"
# there are pings at its first and at its last time
SWIM = HEADER + "0.4,3,-0.6,-0.1,0,0,1.2\n1.0,3.2,0.1,-0.1,0.1,0.2,1.6\n1.4,3.3,0.6,0,0.1,0,2\n"
STILL = HEADER + "0,2.5,0,0,0,0,0.3\n100,2.5,0,0,0,0,0.3\n"
ORBIT = {"kind": "orbit", "centre_m": [3.0, 0.0, 0.0], "radius_m": 2.0, "z_m": 0.0, "turns": 1}


@pytest.fixture
def job(tmp_path):
    """A job of 10 pings, 0.2 s apart, beside the files of two paths."""
    path = write_job(tmp_path, 10, "")
    (tmp_path / "swim.csv").write_text(SWIM)
    (tmp_path / "still.csv").write_text(STILL)
    return path


def requests_of(path, *tables, **changes):
    return BatchRequests(Job(**read_job(path).plain | {"vary": {"bodies": list(tables)}} | changes))


def assert_follows(requests, times_s, file, name="box_1"):
    """Assert that a body is where the path of a file is at these times, and absent at others."""
    file_times_s, poses = read_poses(file)
    track = PoseTrack(poses, file_times_s)
    for request, time_s in zip(requests, times_s, strict=True):
        if file_times_s[0] <= time_s <= file_times_s[-1]:
            expected = track.at(time_s - file_times_s[0])
            np.testing.assert_allclose(request.bodies[name], expected, rtol=0, atol=1e-12)
        else:
            assert request.bodies[name] is None


def test_a_body_is_where_its_path_is_at_the_time_of_each_ping(job):
    """Before the path begins and after its end the body is absent; hold_pings and another table change nothing."""
    table, times_s = {"names": ["box_1"], "path": "swim.csv"}, np.arange(10) / 5
    requests = requests_of(job, table)
    assert_follows(requests, times_s, job.parent / "swim.csv")
    assert [request.bodies["box_1"] is None for request in requests] == [True] * 2 + [False] * 6 + [True] * 2
    held = requests_of(job, vary={"bodies": [table], "hold_pings": 4})
    assert_follows(held, times_s, job.parent / "swim.csv")
    views = {"kind": "random_views", "target_m": [3.0, 0.0, 0.0], "range_m": [2.0, 3.0], "n_pings": 8}
    for rate_hz in (1.0, 4.0):  # 1 by default
        of_views = requests_of(
            job, table, poses=[views | ({"ping_rate_hz": rate_hz} if rate_hz != 1.0 else {})]
        )
        assert_follows(of_views, np.arange(8) / rate_hz, job.parent / "swim.csv")
    # what other tables draw is what they draw without it
    wall = {"names": ["wall"], "x_m": [-1.0, 0.0], "reflectivity": [0.2, 0.9]}
    for alone, beside in zip(requests_of(job, wall), requests_of(job, table, wall), strict=True):
        assert np.array_equal(alone.bodies["wall"], beside.bodies["wall"])
        assert alone.reflectivity == beside.reflectivity


def test_each_run_of_a_trajectory_has_the_path_from_its_beginning(job):
    """The time of a path is that of the trajectory, as its file has it, whatever runs before and in which scene."""
    folder = job.parent
    (folder / "other.sdf").write_text(f'<sdf version="1.9"><world name="other">{BOX}</world></sdf>')
    (folder / "dive.csv").write_text(HEADER + "1.7e9,0,0,0,0,0,0\n1700000000.5,0,0,0,0,0,0\n")
    (folder / "log.csv").write_text(HEADER + "1.7e9,3,0,0,0,0,0\n1700000001,4,1,0,0,0,0\n")
    dive = {"kind": "trajectory", "file": "dive.csv"}
    changes = {"scenes": ["tank.sdf", "other.sdf"], "poses": [dive, ORBIT | {"n_pings": 5, "speed_m_s": 8.0}]}
    for file, there in (("log.csv", [0, 1, 2, 3]), ("swim.csv", [6, 7, 8, 11, 12, 13])):
        requests = requests_of(job, {"names": ["box_1"], "path": file}, **changes)
        assert [run.numbers.start for run in requests.runs] == [0, 2, 4, 9]
        on_trajectory_s = [
            t for one in requests.runs for t in (one.trajectory[k][0] for k in range(len(one.numbers)))
        ]
        assert_follows(requests, on_trajectory_s, folder / file)
        found = [request.number for request in requests if request.bodies["box_1"] is not None]
        assert found == there


def test_each_run_draws_a_path_and_what_else_its_table_varies_once(job):
    """One of the files, whether and which body is there, its reflectivity, a shift of the path, a turn."""
    folder, sector = job.parent, read_job(job).plain["poses"][0]
    (folder / "tank.sdf").write_text(
        f'<sdf version="1.9"><world name="tank">{WALL}{BOX}{BOX.replace("box_1", "box_2")}{FLOOR}</world></sdf>'
    )
    table = {"names": ["box_*"], "path": ["swim.csv", "still.csv"], "one_of": True, "there": 0.75}
    table |= {"y_m": [-0.5, 0.5], "yaw_rad": [-1.0, 1.0], "reflectivity": [0.2, 0.9]}
    poses = [sector | {"n_pings": 2, "ping_rate_hz": 1.0}] * 200  # at 0 and 1 s
    (folder / "swim.csv").write_text(HEADER + "0,4,0,0,0,0,0\n1,4,1,0,0,0,0\n")

    def drawn(seed, n_runs):
        found = []
        requests = requests_of(job, table, poses=poses, seed=seed)
        for number in range(0, 2 * n_runs, 2):
            first, second = requests[number], requests[number + 1]
            there = [name for name, pose in first.bodies.items() if pose is not None]
            assert len(there) <= 1 and set(first.bodies) == {"box_1", "box_2"}
            assert [name for name, pose in second.bodies.items() if pose is not None] == there
            assert first.reflectivity == second.reflectivity and list(first.reflectivity) == there
            if not there:
                found.append(None)
                continue
            a, b = first.bodies[there[0]], second.bodies[there[0]]
            file = "swim.csv" if a[0, 3] > 3 else "still.csv"
            step = [0, 1, 0] if file == "swim.csv" else [0, 0, 0]
            np.testing.assert_allclose(b[:3, 3] - a[:3, 3], step, atol=1e-12)
            np.testing.assert_allclose(a[:3, :3], b[:3, :3], atol=1e-12)
            turn = np.arctan2(a[1, 0], a[0, 0]) - (0.3 if file == "still.csv" else 0.0)
            assert abs(a[1, 3]) <= 0.5 and abs(turn) <= 1.0
            found.append((there[0], file, a[1, 3], turn, first.reflectivity[there[0]]))
        return found

    found = drawn(5, 200)
    assert found[:20] == drawn(5, 20) != drawn(6, 20)
    there = [one for one in found if one is not None]
    assert 130 <= len(there) <= 170  # of 200 · 0.75, four standard deviations
    for k, names in ((0, ("box_1", "box_2")), (1, ("swim.csv", "still.csv"))):
        counts = [sum(one[k] == name for one in there) for name in names]
        assert min(counts) > len(there) / 2 - 25
    shifts, turns, mu = np.array([one[2:] for one in there]).T
    for values, low, high in ((shifts, -0.5, 0.5), (turns, -1.0, 1.0), (mu, 0.2, 0.9)):
        assert len(set(values.tolist())) == len(values)
        assert values.min() < low + 0.1 * (high - low) and values.max() > high - 0.1 * (high - low)


def test_bodies_apart_each_have_a_path_and_a_shift(job):
    """A shoal: each body follows one of the files beside the others."""
    (job.parent / "tank.sdf").write_text(
        '<sdf version="1.9"><world name="tank">'
        + "".join(BOX.replace("box_1", f"box_{n}") for n in range(1, 9))
        + "</world></sdf>"
    )
    table = {"names": ["box_*"], "path": ["swim.csv", "still.csv"], "apart": True, "z_m": [-0.5, 0.5]}
    first, later = (requests_of(job, table)[number].bodies for number in (2, 5))
    kinds = {name: pose[0, 3] for name, pose in first.items()}
    assert set(kinds.values()) == {2.5, 3.0} and len(kinds) == 8
    assert len({pose[2, 3] for pose in first.values()}) == 8
    for name, x_m in kinds.items():
        assert np.array_equal(first[name], later[name]) == (x_m == 2.5)


@pytest.mark.parametrize("first", ["hull", "mast"])
def test_a_model_follows_a_path_as_a_whole(job, first):
    """The pose is the model's, as for `Simulator.place`, whichever part is first; of a part alone it is its own."""
    links = [
        re.search("<link.*</link>", BOX, re.DOTALL)[0].replace('<link name="link">', link)
        for link in (
            '<link name="hull"><pose>0.4 0 0.1 0 0 0.5</pose>',
            '<link name="mast"><pose>-0.2 0 0.5 0 0.1 0</pose>',
        )
    ]
    vessel = "".join(links if first == "hull" else links[::-1])
    (job.parent / "tank.sdf").write_text(
        f'<sdf version="1.9"><world name="tank"><model name="vessel"><pose>1 2 3 0.1 0.2 0.3</pose>{vessel}</model>'
        f"{BOX}</world></sdf>"
    )
    whole = sg.pose(2.5, 0, 0, yaw=0.3)
    parts = {"vessel::hull": sg.pose(0.4, 0, 0.1, yaw=0.5), "vessel::mast": sg.pose(-0.2, 0, 0.5, pitch=0.1)}
    requests = requests_of(job, {"names": ["vessel::*"], "path": "still.csv"})
    assert set(requests[0].bodies) == set(parts)
    for name, in_model in parts.items():
        np.testing.assert_allclose(requests[0].bodies[name], whole @ in_model, atol=1e-12)
    alone = requests_of(job, {"names": ["vessel::mast"], "path": "still.csv"})[0].bodies
    np.testing.assert_allclose(alone["vessel::mast"], whole, atol=1e-12)
    # a part that is left out of the scene does not shift the others
    rest = requests_of(job, {"names": ["vessel::*"], "path": "still.csv"}, without=["vessel::mast"])[0].bodies
    np.testing.assert_allclose(rest["vessel::hull"], whole @ parts["vessel::hull"], atol=1e-12)
    one_of = {"names": ["vessel::*"], "path": "still.csv", "one_of": True}
    (shown,) = [pose for pose in requests_of(job, one_of)[0].bodies.values() if pose is not None]
    np.testing.assert_allclose(shown, whole, atol=1e-12)
    # of bodies of no common model it is that of the first in the scene
    both = requests_of(job, {"names": ["vessel::*", "box_1"], "path": "still.csv"})[0].bodies
    np.testing.assert_allclose(both[f"vessel::{first}"], whole, atol=1e-12)


def test_a_diver_follows_a_path_with_his_parts_or_a_warning_says_which_stay(job):
    diver = {"names": ["diver", "diver::*"], "path": "swim.csv", "pitch_rad": 1.4}
    requests = requests_of(job, diver, scenes=["diver"])
    scene = requests.scenes[0]
    home = next(body.pose for body in scene.bodies if body.name == "diver")
    moved = requests[5].bodies
    assert set(moved) == {"diver", *(one.name for one in scene.bodies_and_plumes if "diver::" in one.name)}
    np.testing.assert_allclose(
        moved["diver"], sg.pose(3.2, 0.1, -0.1, 0.1, 0.2, 1.6) @ sg.pose(pitch=1.4), atol=1e-12
    )
    for one in scene.bodies_and_plumes:
        if one.name in moved:
            expected = moved["diver"] @ np.linalg.inv(home) @ one.pose
            np.testing.assert_allclose(moved[one.name], expected, atol=1e-12)
    assert model_warnings(requests, 0) == []
    (text,) = model_warnings(requests_of(job, {"names": ["diver"], "path": "swim.csv"}, scenes=["diver"]), 0)
    assert "vary.bodies[0] moves 'diver' without diver::weight_left, " in text


def test_a_body_on_a_path_rests_on_a_floor(job):
    """The file decides x, y and attitude, floor and `z_m` the height."""
    table = {"names": ["box_1"], "path": "swim.csv"}
    free = requests_of(job, table)
    resting = requests_of(job, table | {"rests_on": "floor", "z_m": -0.05})
    for number in range(2, 8):
        pose = resting[number].bodies["box_1"]
        lowest_m = pose[2, 3] - 0.1 * np.abs(pose[2, :3]).sum()  # of a box with edges of 0.2 m
        assert lowest_m == pytest.approx(-0.4 - 0.05, abs=1e-9)
        assert np.array_equal(np.delete(pose, 11), np.delete(free[number].bodies["box_1"], 11))  # all but z


def test_what_rests_on_a_body_is_absent_while_the_path_of_that_has_not_begun_or_is_over(job):
    """It lay where that body is in the scene, and hung in the water."""
    boat = BODY.format("boat", "3 0 -0.3", "1 1 0.1")
    (job.parent / "tank.sdf").write_text(
        f'<sdf version="1.9"><world name="tank">{BOX}{boat}{FLOOR}</world></sdf>'
    )
    table, resting = {"names": ["boat"], "path": "still.csv"}, {"names": ["box_1"], "rests_on": "boat"}
    (job.parent / "still.csv").write_text(HEADER + "0.4,3,0,0.5,0,0,0\n1.4,3,0,0.5,0,0,0\n")
    for request in requests_of(job, table, resting):
        boat_pose, box_pose = request.bodies["boat"], request.bodies["box_1"]
        assert (boat_pose is None) == (box_pose is None) == (not 0.4 <= request.time_s <= 1.4)
        if box_pose is not None:
            assert box_pose[2, 3] == pytest.approx(0.5 + 0.05 + 0.1, abs=1e-9)
    # one that no path takes away has its place in the scene, where other variants of a floor may be
    for request in requests_of(job, {"names": ["boat"], "there": 0.0}, resting):
        assert request.bodies["box_1"][2, 3] == pytest.approx(-0.3 + 0.05 + 0.1, abs=1e-9)
    for request in requests_of(job, table, {"names": ["boat"], "there": 0.0}, resting):
        assert request.bodies["box_1"] is not None


# ---- files ------------------------------------------------------------------------------------------


FOLLOWING = '[[vary.bodies]]\nnames = ["box_1"]\npath = "swim.csv"\n'


def test_pings_of_a_batch_are_those_of_a_simulator_with_these_bodies(job):
    """Bit for bit, with place-locked speckle and labels; `moved_pose` says where the body was, and labels follow it."""
    folder = job.parent
    labels = '[labels]\nlayers = ["body", "boxes"]\n[labels.classes]\nbox = ["box_1"]\n[coco]\nheight = 100\n'
    write_plain_job(folder, 10, 4, FOLLOWING + "[arrays]\nmantissa_bits = 23\n" + labels)
    make_all(job, folder / "out")
    data = xr.open_dataset(folder / "out" / "pings.zarr")
    requests = BatchRequests(read_job(job))
    assert_follows(requests, data.time_s.values, folder / "swim.csv")
    stored = [None if np.isnan(pose).any() else pose for pose in data.moved_pose[:, 0].values]
    for request, pose in zip(requests, stored, strict=True):
        expected = request.bodies["box_1"]
        assert (pose is None) == (expected is None) and (pose is None or np.array_equal(pose, expected))
    samplings = [*zip(data.columns_per_beam.values.tolist(), data.rows.values.tolist(), strict=True)]
    acoustics, noise = sg.Acoustics(**json.loads(data.acoustics)), sg.Noise(**json.loads(data.noise))
    assert noise.follow_motion
    numbers_seen = set()
    for sampling in set(samplings):
        with sg.Simulator(
            requests.scenes[0], requests.sonars["level"], acoustics, sg.Sampling(*sampling)
        ) as s:
            pings = s.pings(
                data.pose.values,
                noise,
                int(data.noise_seed),
                labels=True,
                bodies=[{"box_1": pose} for pose in stored],
                times_s=data.time_s.values.tolist(),
            )
            for n, ping in enumerate(pings):
                if samplings[n] == sampling:
                    numbers_seen.add(n)
                    assert np.array_equal(ping.intensity, data.intensity[n])
                    assert np.array_equal(ping.body_id, data.body_id[n])
    assert numbers_seen == set(range(10))
    box = data.bodies.index("box_1") + 1
    beams = []
    for n in range(10):
        at = np.argwhere(data.body_id[n].values == box)
        assert bool(len(at)) == (stored[n] is not None)
        if len(at):
            x, y, z = stored[n][:3, 3]
            beam, bin_ = np.median(at, axis=0).astype(int)
            in_head = np.linalg.inv(data.pose[n].values) @ [x, y, z, 1]
            assert abs(data.azimuth_rad.values[beam] - np.arctan2(in_head[1], in_head[0])) < 0.05
            assert abs(data.range.values[bin_] - np.linalg.norm(in_head[:3])) < 0.25
            beams.append(in_head[1])
    assert len(beams) == 6
    annotated = json.loads((folder / "out" / "coco" / "level" / "instances.json").read_text())["annotations"]
    assert [one["image_id"] for one in annotated if one["body"] == "box_1"] == list(range(2, 8))


@pytest.mark.slow  # processes of their own, as other jobs of test_batch have
def test_bytes_do_not_depend_on_processes_and_a_changed_path_is_not_resumed(job, tmp_path):
    write_plain_job(tmp_path, 10, 4, FOLLOWING.replace('"swim.csv"', '["swim.csv", "still.csv"]'))
    make_all(job, tmp_path / "one")
    folder = tmp_path / "two"
    status, _, err = run("batch", job, "--out", folder, "--workers", "2")
    assert status == 0, err
    one, two = files_of(tmp_path / "one"), files_of(folder)
    assert one.keys() == two.keys() and {name for name in one if one[name] != two[name]} <= {"batch.json"}
    for name in ("parts/0000001.json", "done.json"):  # the second part is made again
        (folder / name).unlink()
    assert run("batch", job, "--out", folder, "--workers", "1", "--resume")[0] == 0
    assert files_of(folder) == two
    (tmp_path / "swim.csv").write_text(SWIM.replace("3.2", "3.1"))
    status, _, err = run("batch", job, "--out", folder, "--resume")
    assert status == 2 and "(changed: swim.csv; restore that, or give another folder)" in err


def test_a_dry_run_counts_pings_in_which_a_body_swims_over_the_sonar(job, tmp_path, monkeypatch):
    use_inline_pool(monkeypatch)
    (tmp_path / "over.csv").write_text(HEADER + "0,0,0,0,0,0,0\n0.9,0,0,0,0,0,0\n")
    write_plain_job(tmp_path, 10, 4, FOLLOWING.replace("swim", "over"))
    status, out, err = run("batch", job, "--dry-run", "--workers", "1")
    assert status == 0, err
    assert "5 of these 10 pings have the sonar in a body" in out and "'box_1'" in out


BAD = [
    ("swim.csv", "swam.csv", "vary.bodies[0].path: {folder}/swam.csv: the file of poses must be readable ("),
    ("0.1,0.2,1.6", "0.1,0.2", "vary.bodies[0].path: {folder}/swim.csv: line 3: must have 7 cells"),
    ('path = "swim.csv"', 'path = "a\\u0000b"', "vary.bodies[0].path: {folder}/a\\x00b:"),
    ("1.0,3.2", "0.1,3.2", "vary.bodies[0].path: {folder}/swim.csv: line 3, column t: times must not fall"),
    ("0,0,1.2", "0,0,90", "vary.bodies[0].path: {folder}/swim.csv: line 2: pose angles must be radians"),
    (SWIM, HEADER + "100,3,0,0,0,0,0\n130,3,0,0,0,0,0\n", "vary.bodies[0].path must hold times of pings"),
    (SWIM, HEADER + "0.25,3,0,0,0,0,0\n0.35,3,0,0,0,0,0\n", "vary.bodies[0].path must hold times of"),
    (SWIM, HEADER + "0.4,3,0,0,0,0,0\n", "vary.bodies[0].path: {folder}/swim.csv:"),
    ('path = "swim.csv"', 'path = "swim.csv"\nclearance_m = 0.5', "vary.bodies[0]: path and clearance_m"),
    ('path = "swim.csv"', "path = []", "vary.bodies[0].path: should have a length of at least 1 (got [];"),
    ('path = "swim.csv"', "path = 0.5", "vary.bodies[0].path: should be a valid list (got 0.5;"),
    ('path = "swim.csv"', 'path = "."', "vary.bodies[0].path: {folder}: must be a file (got a folder"),
]  # fmt: skip


@pytest.mark.parametrize(("old", "new", "sentence"), BAD, ids=[sentence[:60] for *_, sentence in BAD])
def test_errors_name_the_table_and_the_line_of_the_file(job, tmp_path, old, new, sentence):
    write_plain_job(tmp_path, 10, 4, FOLLOWING)
    for path in (job, tmp_path / "swim.csv"):
        path.write_text(path.read_text().replace(old, new))
    status, out, err = run("batch", job, "--out", tmp_path / "out", "--workers", "1")
    assert (status, out) == (2, "")
    assert err.startswith(f"error: {job}: {sentence.format(folder=tmp_path)}") and err.count("\n") == 1
    assert not (tmp_path / "out").exists()
