"""Trajectories of a batch against closed forms."""

import math
import pickle
from dataclasses import asdict, replace

import numpy as np
import pytest

import sonar_gl as sg
from sonar_gl.batch.trajectories import (
    KINDS,
    FileTrajectory,
    Lawnmower,
    Orbit,
    RandomViews,
    SectorScan,
    build_trajectory,
)
from sonar_gl.core.poses import check_pose, read_poses

LAWN = Lawnmower(
    centre_m=[100, -50], z_m=-7, length_m=10, width_m=7, line_spacing_m=2, speed_m_s=1.5, ping_rate_hz=3,
    yaw_rad=0.7, pitch_rad=0.2, roll_rad=-0.1,
)  # fmt: skip
ORBIT = Orbit(centre_m=[3, -4, -9], radius_m=5, z_m=-6, n_pings=36, turns=-1.5, start_rad=0.4, speed_m_s=2)
SECTOR = SectorScan(
    position_m=[1, 2, -3], pan_rad=[-1.0, 2.0], n_pings=39, ping_rate_hz=5, sweep_s=2.5, tilt_rad=0.3
)
VIEWS = RandomViews(
    target_m=[10, 20, -5], range_m=[2, 6], n_pings=1000, elevation_rad=[-0.4, 1.2], z_m=[-6, -1],
    azimuth_jitter_rad=0.3, elevation_jitter_rad=0.1, roll_jitter_rad=0.2, ping_rate_hz=4, seed=7,
)  # fmt: skip
ALL = {"lawnmower": LAWN, "orbit": ORBIT, "sector": SECTOR, "random_views": VIEWS}


@pytest.fixture(scope="module")
def views():
    """The (N, 4, 4) poses of VIEWS."""
    return np.array([pose for _, pose in VIEWS])


def times_and_poses(path):
    times, poses = zip(*path, strict=True)
    return np.array(times), np.array(poses)


def in_sonar(poses, point):
    """Return azimuth, elevation and range of a world point in the frames of sonars."""
    x, y, z = (np.linalg.inv(poses) @ [*point, 1])[..., :3].T
    return np.arctan2(y, x), np.arctan2(z, np.hypot(x, y)), np.sqrt(x * x + y * y + z * z)


def check_uniform(values, low, high):
    """Test by Kolmogorov and Smirnov; one seed in 10 000 would fail, and the seeds are fixed."""
    share = np.sort((np.asarray(values) - low) / (high - low))
    n = len(share)
    assert share[0] >= -1e-9
    assert share[-1] <= 1 + 1e-9
    assert np.abs(share - (np.arange(n) + 0.5) / n).max() < 2.23 / math.sqrt(n)


# ---- all kinds --------------------------------------------------------------------------------------


@pytest.mark.parametrize("path", ALL.values(), ids=ALL)
def test_a_ping_depends_on_its_number_only(path):
    times, poses = times_and_poses(path)
    assert len(times) == len(path)
    np.testing.assert_array_equal(path.time_s(np.arange(len(path))), times)
    assert path.time_s(np.arange(len(path))).dtype == poses.dtype == np.float64
    assert (np.diff(times) > 0).all()
    for n in (len(path) - 1, 0, len(path) // 2):
        fresh = pickle.loads(pickle.dumps(replace(path)))
        time_s, pose = fresh[n]
        assert type(time_s) is float
        assert (time_s, pose.tobytes()) == (times[n], poses[n].tobytes())
        assert fresh[n - len(path)][1].tobytes() == poses[n].tobytes()
        check_pose(pose)
    np.testing.assert_allclose(poses[:, :3, :3] @ poses[:, :3, :3].transpose(0, 2, 1), np.eye(3)[None].repeat(
        len(poses), axis=0), atol=1e-14)  # fmt: skip
    for n in (len(path), -len(path) - 1):
        with pytest.raises(IndexError, match=rf"{type(path).__name__} has pings 0\.\.{len(path) - 1} "):
            path[n]


def test_kinds_have_the_names_of_the_job_file():
    assert list(KINDS) == ["trajectory", "lawnmower", "orbit", "sector", "random_views"]
    assert {name: KINDS[name] for name in ALL} == {name: type(path) for name, path in ALL.items()}


@pytest.mark.parametrize("path", [replace(path, n_pings=10**9) for path in (ORBIT, SECTOR, VIEWS)], ids=repr)
def test_a_billion_pings_take_no_memory(path):
    assert len(path) == 10**9
    time_s, pose = path[10**9 - 1]
    assert time_s > 1e-6
    assert np.isfinite(pose).all()


def test_a_file_of_poses(tmp_path):
    file = tmp_path / "dive.csv"
    file.write_text("t,x,y,z,roll,pitch,yaw\n0,1,2,3,0.1,0.2,0.3\n0.5,2,2,3,0,0,-1\n2,3,2,3,0,0,0\n")
    path, (times, poses) = FileTrajectory(str(file)), read_poses(file)
    assert len(path) == 3
    np.testing.assert_array_equal(path.time_s(np.arange(len(path))), times)
    np.testing.assert_array_equal(times_and_poses(path)[1], poses)
    assert not path[0][1].flags.writeable  # the table is in memory
    file.unlink()
    other = pickle.loads(pickle.dumps(path))
    assert other == path
    np.testing.assert_array_equal(other[1][1], sg.pose(2, 2, 3, yaw=-1))
    with pytest.raises(
        sg.Error, match=r"^job: poses\[0\]: .*dive\.csv: the file of poses must be readable \(no such file"
    ):
        build_trajectory({"kind": "trajectory", "file": str(file)}, "job")


# ---- lawnmower --------------------------------------------------------------------------------------


def test_lawnmower_geometry():
    """A width of 7 m with lines 2 m apart has four legs at -3 -1 1 3; 10 m with a ping each 0.5 m have 21."""
    times, poses = times_and_poses(LAWN)
    assert len(LAWN) == 4 * 21
    area = sg.pose(100, -50, -7, yaw=0.7)
    along, aside, up = (np.linalg.inv(area) @ poses[:, :, 3:])[:, :3, 0].T.reshape(3, 4, 21)
    there = np.arange(21) * 0.5 - 5
    np.testing.assert_allclose(along, [there, -there, there, -there], atol=1e-12)
    np.testing.assert_allclose(aside, np.repeat([[-3.0], [-1], [1], [3]], 21, axis=1), atol=1e-12)
    np.testing.assert_allclose(up, 0, atol=1e-12)
    for leg in range(4):
        looks = area @ sg.pose(roll=-0.1, pitch=0.2, yaw=math.pi * (leg % 2))
        np.testing.assert_allclose(
            poses[21 * leg :][:21, :3, :3], looks[None, :3, :3].repeat(21, 0), atol=1e-12
        )
    # 10 m of leg and π m of half circle at 1.5 m/s
    starts = np.arange(4)[:, None] * (10 + math.pi) / 1.5
    np.testing.assert_allclose(times.reshape(4, 21), starts + np.arange(21) / 3, atol=1e-12)
    assert poses[0, 2, 0] < 0  # a positive pitch looks down


@pytest.mark.parametrize("width_m, spacing_m, legs", [(2.1, 0.3, 7), (0.31, 0.1, 4), (1, 5, 1), (12, 2, 6)])
@pytest.mark.parametrize("length_m, rate_hz, pings", [(0.57, 100.0, 58), (0.29, 10.0, 3), (0.05, 10.0, 1)])
def test_lawnmower_covers_its_rectangle(width_m, spacing_m, legs, length_m, rate_hz, pings):
    """No point is more than half a spacing from a leg. 2.1 / 0.3 and 0.57 * 100 are rounded."""
    path = Lawnmower(
        centre_m=(0, 0), z_m=0, length_m=length_m, width_m=width_m, line_spacing_m=spacing_m, speed_m_s=1.0,
        ping_rate_hz=rate_hz,
    )  # fmt: skip
    assert len(path) == legs * pings
    aside = np.unique([pose[1, 3].round(9) for _, pose in path])
    assert len(aside) == legs
    points = np.linspace(-width_m / 2, width_m / 2, 101)
    assert np.abs(points[:, None] - aside).min(axis=1).max() <= spacing_m / 2 + 1e-9
    assert np.abs(aside).max() < width_m / 2 + 1e-9 or legs == 1


# ---- orbit and sector -------------------------------------------------------------------------------


def test_orbit_looks_at_its_centre():
    times, poses = times_and_poses(ORBIT)
    azimuth, elevation, range_m = in_sonar(poses, (3, -4, -9))
    np.testing.assert_allclose([azimuth, elevation], 0, atol=1e-12)
    np.testing.assert_allclose(range_m, math.hypot(5, 3), rtol=1e-14)
    x, y, z = poses[:, :3, 3].T - [[3], [-4], [-9]]
    np.testing.assert_allclose(np.hypot(x, y), 5, rtol=1e-14)
    np.testing.assert_allclose(z, 3, rtol=1e-14)
    step = -1.5 * 2 * math.pi / 36  # clockwise
    np.testing.assert_allclose(np.unwrap(np.arctan2(y, x)), 0.4 + step * np.arange(36), atol=1e-12)
    np.testing.assert_allclose(times, np.arange(36) * 5 * -step / 2, rtol=1e-14)
    np.testing.assert_allclose(poses[:, 2, 1], 0, atol=1e-12)  # port is horizontal


def test_whole_turns_repeat_no_position():
    path = Orbit(centre_m=(0, 0, 0), radius_m=1, z_m=0, n_pings=4, turns=1)
    positions = np.array([pose[:2, 3] for _, pose in path])
    np.testing.assert_allclose(positions, [[1, 0], [0, 1], [-1, 0], [0, -1]], atol=1e-15)


def test_sector_pans_to_and_fro():
    """A sweep of 3 radians takes 12.5 steps of 0.2 s: there, back, and there."""
    times, poses = times_and_poses(SECTOR)
    np.testing.assert_allclose(times, np.arange(39) / 5, rtol=1e-15)
    there = np.arange(13) * 3 / 12.5 - 1
    back = 2 - (np.arange(13, 26) - 12.5) * 3 / 12.5
    wanted = [sg.pose(1, 2, -3, pitch=0.3, yaw=yaw) for yaw in (*there, *back[:12], *there, *back[:1])]
    np.testing.assert_allclose(poses, wanted, atol=1e-14)


def test_sector_pans_through_the_angles_between_its_ends():
    path = SectorScan(position_m=(0, 0, 0), pan_rad=(3, 6.2832), n_pings=9, ping_rate_hz=1, sweep_s=4)
    ahead = np.array([pose[:2, 0] for _, pose in path])
    yaw = np.array([3, 3.8208, 4.6416, 5.4624, 6.2832, 5.4624, 4.6416, 3.8208, 3])
    np.testing.assert_allclose(ahead, np.column_stack([np.cos(yaw), np.sin(yaw)]), atol=1e-12)


# ---- random views -----------------------------------------------------------------------------------


def test_views_are_uniform(views):
    """Points above -6 are in view from all ranges; the sine is uniform over elevations that z_m allows."""
    offset = views[:, :3, 3] - [10, 20, -5]
    range_m = np.linalg.norm(offset, axis=1)
    check_uniform(range_m, 2, 6)
    check_uniform(np.arctan2(offset[:, 1], offset[:, 0]), -math.pi, math.pi)
    low, high = np.maximum(math.sin(-0.4), -1 / range_m), np.minimum(math.sin(1.2), 4 / range_m)
    assert (low > math.sin(-0.4)).any()
    assert (high < math.sin(1.2)).any()
    check_uniform((offset[:, 2] / range_m - low) / (high - low), 0, 1)
    assert (views[:, 2, 3] >= -6 - 1e-9).all()
    assert (views[:, 2, 3] <= -1 + 1e-9).all()


def test_the_target_appears_within_the_jitters(views):
    azimuth, elevation, _ = in_sonar(views, (10, 20, -5))
    check_uniform(azimuth, -0.3, 0.3)
    check_uniform(elevation, -0.1, 0.1)
    assert abs(np.corrcoef(azimuth, elevation)[0, 1]) < 4 / math.sqrt(len(views))
    # without jitter of the boresight, only the roll remains
    straight = [pose for _, pose in replace(VIEWS, azimuth_jitter_rad=0, elevation_jitter_rad=0)]
    check_uniform(np.arctan2([p[2, 1] for p in straight], [p[2, 2] for p in straight]), -0.2, 0.2)
    np.testing.assert_array_equal(np.array(straight)[:, :3, 3], views[:, :3, 3])  # jitters change no position
    azimuth, elevation, _ = in_sonar(np.array(straight), (10, 20, -5))
    np.testing.assert_allclose([azimuth, elevation], 0, atol=1e-12)


def test_views_from_one_side(views):
    positions = [pose[:3, 3] for _, pose in replace(VIEWS, azimuth_rad=(2.0, 4.0))]
    offset = np.array(positions) - (10, 20, -5)
    check_uniform(np.arctan2(offset[:, 1], offset[:, 0]) % (2 * math.pi), 2.0, 4.0)
    np.testing.assert_allclose(offset[:, 2], views[:, 2, 3] + 5)  # nothing else changes


def test_views_aim_at_points_of_a_box():
    path = RandomViews(target_m=(1, 2, 3), target_size_m=(4, 2, 0.5), range_m=(1e-3, 1e-3), n_pings=2000)
    positions = np.array([pose[:3, 3] for _, pose in path])
    for axis, (at, size) in enumerate(zip((1, 2, 3), (4, 2, 0.5), strict=True)):
        check_uniform(positions[:, axis], at - size / 2 - 1e-3, at + size / 2 + 1e-3)


@pytest.mark.parametrize(
    "elevation_rad, z_m, low, high",
    [
        ((0.5, 1.0), (-9, 2.0), 1.0, 2 / math.sin(0.5)),  # from farther away it would be too high
        ((-1.0, -0.5), (-50, -2.0), 2 / math.sin(1.0), 10.0),
    ],
)
def test_ranges_are_those_that_z_m_allows(elevation_rad, z_m, low, high):
    path = RandomViews(target_m=(0, 0, 0), range_m=(1, 10), n_pings=400, elevation_rad=elevation_rad, z_m=z_m)
    positions = np.array([pose[:3, 3] for _, pose in path])
    check_uniform(np.linalg.norm(positions, axis=1), low, high)
    assert positions[:, 2].min() >= z_m[0] - 1e-9
    assert positions[:, 2].max() <= z_m[1] + 1e-9


def test_every_seed_and_number_gives_another_view(views):
    assert len({pose.tobytes() for pose in views}) == len(views)
    other = [pose for _, pose in replace(VIEWS, seed=8, n_pings=50)]
    assert not {pose.tobytes() for pose in views} & {pose.tobytes() for pose in other}
    np.testing.assert_array_equal(replace(VIEWS, n_pings=50)[49][1], views[49])  # more pings change none


# ---- messages ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "kind, change, message",
    [
        ("lawnmower", {"centre_m": [1, 2, 3]}, "should have a length of at most 2 (got [1, 2, 3];"),
        ("lawnmower", {"centre_m": 5}, ".centre_m: should be a valid list (got 5; give [x, y] in metres)"),
        ("lawnmower", {"centre_m": "12"}, ".centre_m: should be a valid list (got '12';"),
        ("lawnmower", {"centre_m": [1, "a"]}, ".centre_m[1]: should be a valid number (got 'a';"),
        ("lawnmower", {"z_m": True}, ".z_m: should be a valid number (got True; give metres)"),
        ("lawnmower", {"z_m": math.nan}, ".z_m: should be a finite number (got nan; give metres)"),
        ("lawnmower", {"z_m": -2e8}, ".z_m: should be greater than or equal to -100000000 (got -200000000.0"),
        ("lawnmower", {"length_m": 0}, ".length_m: should be greater than or equal to 0.001 (got 0; give me"),
        ("lawnmower", {"width_m": -1}, ".width_m: should be greater than or equal to 0.001 (got -1; give me"),
        ("lawnmower", {"line_spacing_m": 0}, ".line_spacing_m: should be greater than or equal to 0.001 (go"),
        ("lawnmower", {"speed_m_s": 0}, ".speed_m_s: should be greater than or equal to 0.000001 (got 0; gi"),
        ("lawnmower", {"ping_rate_hz": 0}, "(got 0; give pings per second)"),
        ("lawnmower", {"yaw_rad": 90}, ".yaw_rad: should be less than or equal to 6.2832 (got 90; give radi"),
        ("lawnmower", {"pitch_rad": 2}, ".pitch_rad: should be less than or equal to 1.5708 (got 2; give ra"),
        ("lawnmower", {"roll_rad": 4}, ".roll_rad: should be less than or equal to 3.1416 (got 4; give radi"),
        ("lawnmower", {"length_m": 1e6, "width_m": 1e6}, ": should have at most 1e+09 pings"),
        ("lawnmower", {"speed": 1}, ": unknown key (got 'speed'; did you mean 'speed_m_s' or "),
        ("orbit", {"centre_m": [1, 2]}, ".centre_m: should have a length of at least 3 (got [1, 2]; "),
        ("orbit", {"radius_m": 0}, ".radius_m: should be greater than or equal to 0.001 (got 0; give metres"),
        ("orbit", {"n_pings": 2.5}, ".n_pings: should be a valid integer (got 2.5; give the number of pings"),
        ("orbit", {"n_pings": 0}, ".n_pings: should be greater than or equal to 1 (got 0; give the number o"),
        ("orbit", {"turns": 0}, ".turns: should not be 0 (got 0; 1 is one turn, -1 one clockwise)"),
        ("orbit", {"turns": 1e7}, ".turns: should be less than or equal to 1000000 (got 10000000.0; 1 is on"),
        ("sector", {"pan_rad": 1.0}, ".pan_rad: should be a valid list (got 1.0; give [from, to] in radians"),
        ("sector", {"pan_rad": [-45, 45]}, ".pan_rad[0]: should be greater than or equal to -6.2832 (got -4"),
        ("sector", {"sweep_s": 0}, "(got 0; give seconds from one end to the other)"),
        ("sector", {"tilt_rad": 30}, ".tilt_rad: should be less than or equal to 1.5708 (got 30; give radia"),
        ("random_views", {"range_m": 5}, ".range_m: should be a valid list (got 5;"),
        ("random_views", {"range_m": [5, 2]}, ".range_m: should be [low, high] (got 5 and 2; swap them)"),
        ("random_views", {"range_m": [0, 2]}, ".range_m[0]: should be greater than or equal to 0.001 (got 0"),
        ("random_views", {"elevation_rad": [1, 0]}, ".elevation_rad: should be [low, high] (got 1 and 0; sw"),
        ("random_views", {"z_m": [0, -9]}, ".z_m: should be [low, high] (got 0 and -9; swap them)"),
        ("random_views", {"target_size_m": [1, 1, -1]}, ".target_size_m[2]: should be greater than or equal"),
        ("random_views", {"azimuth_jitter_rad": -0.1}, ".azimuth_jitter_rad: should be greater than or equa"),
        ("random_views", {"seed": -1}, ".seed: should be greater than or equal to 0 (got -1; give a whole n"),
        ("random_views", {"z_m": [2.0, 5.0]}, ": range_m and elevation_rad should leave a position within"),
        ("random_views", {"target_size_m": [0, 0, 30]}, "from which to look at z = -20 (got [2.0, 6.0] and"),
        ("random_views", {"target_size_m": [0, 0, 14], "z_m": [-14, -4]}, "to look at z = 2 (got"),
        ("random_views", {"elevation_rad": [0, 0], "z_m": [-9, -6]}, "to look at z = -5 (got [2.0, 6.0]"),
    ],
)  # fmt: skip
def test_messages(kind, change, message):
    with pytest.raises(sg.Error) as caught:
        build_trajectory({"kind": kind, **asdict(ALL[kind]), **change}, "job.toml", 3)
    assert message in str(caught.value)
    assert str(caught.value).startswith("job.toml: poses[3]")


def test_one_message_has_all_that_is_wrong_with_a_table():
    with pytest.raises(sg.Error) as caught:
        build_trajectory({"kind": "orbit", **asdict(ORBIT), "n_pings": 0, "turns": 0}, "job.toml")
    assert str(caught.value) == (
        "job.toml: poses[0].n_pings: should be greater than or equal to 1 (got 0; give the number of pings); "
        "poses[0].turns: should not be 0 (got 0; 1 is one turn, -1 one clockwise)"
    )
