"""Which pings go along which trajectory, in which scene, and when."""

import shutil

import numpy as np
import pytest

import sonar_gl as sg
from sonar_gl.batch.job import Job, read_job
from sonar_gl.batch.requests import BatchRequests
from tests.support.batches import write_job


def test_pings_later_than_any_ping_can_be_are_refused(requests):
    poses = [requests.job.poses[0] | {"ping_rate_hz": 1e-6, "n_pings": 20_000}]
    job = requests.job.model_copy(update={"poses": poses, "ros": None})
    with pytest.raises(
        sg.Error, match=r": poses must end before 1e\+10 s, as all pings must \(got 1.9999e\+10 s"
    ):
        BatchRequests(job)


def test_runs_follow_each_other_a_second_apart_whenever_a_file_of_poses_begins(tmp_path):
    """Along a file that begins at 100 s, in two scenes, and then along a sector."""
    path = write_job(tmp_path, 2, "")
    (tmp_path / "other.sdf").write_text((tmp_path / "tank.sdf").read_text())
    (tmp_path / "dive.csv").write_text("t,x,y,z,roll,pitch,yaw\n100,0,0,0,0,0,0\n100.5,1,0,0,0,0,0\n")
    plain = read_job(path).plain
    poses = [{"kind": "trajectory", "file": "dive.csv"}, *plain["poses"]]
    requests = BatchRequests(
        read_job(path).model_copy(update={"poses": poses, "scenes": ["tank.sdf", "other.sdf"]})
    )
    times = [100.0, 100.5, 101.5, 102.0, 103.0, 103.2, 104.2, 104.4]
    assert [request.time_s for request in requests] == pytest.approx(times, abs=1e-9)
    assert [request.scene for request in requests] == [0, 0, 1, 1] * 2


def test_a_table_of_poses_may_be_for_some_scenes_alone(tmp_path):
    """Numbers, times and views of a ping are those that it has in a job whose other tables are left out or moved."""
    path = write_job(tmp_path, 2, "")
    names = ["tank.sdf", "pool.sdf", "dock.sdf"]
    for name in names[1:]:
        shutil.copy(tmp_path / "tank.sdf", tmp_path / name)
    (sector,) = read_job(path).plain["poses"]
    views = {"kind": "random_views", "target_m": [3.0, 0.0, 0.0], "range_m": [1.0, 2.0], "n_pings": 1}
    tables = [sector | {"scenes": ["dock.sdf", "tank.sdf"]}, views | {"scenes": ["pool.sdf"]}, views]
    job = read_job(path).model_copy(update={"scenes": names, "poses": tables})
    requests = BatchRequests(job)
    assert [request.scene for request in requests] == [0, 0, 2, 2, 1, 0, 1, 2]
    times_s = [0.0, 0.2, 1.2, 1.4, 2.4, 3.4, 4.4, 5.4]
    assert [request.time_s for request in requests] == pytest.approx(times_s, abs=1e-9)
    everywhere = BatchRequests(job.model_copy(update={"poses": [sector, views, views]}))
    for number, other in zip(range(8), (0, 1, 0, 1, 6, 9, 9, 9), strict=True):
        assert np.array_equal(requests[number].vehicle_pose, everywhere[other].vehicle_pose)


def test_scenes_of_poses_are_those_of_the_job_and_each_has_poses(tmp_path):
    path = write_job(tmp_path, 2, "")
    shutil.copy(tmp_path / "tank.sdf", tmp_path / "pool.sdf")
    text = path.read_text().replace('["tank.sdf"]', '["tank.sdf", "pool.sdf"]')
    for key, message in (
        ('scenes = ["tank"]', "poses[0].scenes: unknown scene (got 'tank'; did you mean 'tank.sdf'?)"),
        ("scenes = [1]", "poses[0].scenes: unknown scene (got 1; known are pool.sdf, tank.sdf)"),
        (
            'scenes = "tank.sdf"',
            "poses[0].scenes must be a list of scenes (got 'tank.sdf'; leave it out for all scenes of the job)",
        ),
        (
            "scenes = []",
            "poses[0].scenes must be a list of scenes (got []; leave it out for all scenes of the job)",
        ),
        (
            'scenes = ["tank.sdf"]',
            "scenes[1] must have poses (got 'pool.sdf', which no table of poses has in its scenes; name it in one, or "
            "leave it out)",
        ),
        ('scene = ["tank.sdf"]', "poses[0]: unknown key (got 'scene'; did you mean 'scenes' or 'sweep_s'?)"),
    ):
        path.write_text(text.replace('kind = "sector"', f'kind = "sector"\n{key}'))
        with pytest.raises(sg.Error) as caught:
            BatchRequests(read_job(path))
        assert str(caught.value) == f"{path}: {message}"


def test_random_views_differ_from_table_to_table_and_are_the_same_in_every_scene(tmp_path):
    """Two tables are more views, not the same again; nor are they those of another job."""
    views = {"kind": "random_views", "target_m": [3.0, 0.0, 0.0], "range_m": [1.0, 2.0], "n_pings": 3}
    write_job(tmp_path, 2, "")
    (tmp_path / "other.sdf").write_text((tmp_path / "tank.sdf").read_text())
    orbit = {
        "kind": "orbit",
        "centre_m": [3.0, 0.0, 0.0],
        "radius_m": 1.0,
        "z_m": 0.0,
        "n_pings": 3,
        "turns": 1,
    }
    job = Job(**read_job(tmp_path / "job.toml").plain | {"scenes": ["tank.sdf", "other.sdf"]})

    def poses(seed, *tables):
        """Return the poses of each table in each scene, (tables, scenes, 3, 4, 4)."""
        requests = BatchRequests(job.model_copy(update={"seed": seed, "poses": list(tables)}))
        return np.reshape([one.vehicle_pose for one in requests], (len(tables), 2, 3, 4, 4))

    found = poses(1, views, orbit, views, views)
    assert np.array_equal(found[:, 0], found[:, 1])
    all_views = [*found[[0, 2, 3], 0].reshape(9, 16), *poses(2, views, views)[:, 0].reshape(6, 16)]
    assert len({tuple(one) for one in all_views}) == 15
    alone, stated = poses(1, views), poses(1, views, views | {"seed": 1})
    assert np.array_equal(found[0], alone[0])
    assert np.array_equal(stated[0], alone[0]) and np.array_equal(stated[1], alone[0])
