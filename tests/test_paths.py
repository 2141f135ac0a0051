"""Where a sonar goes in a batch, against closed forms."""

import math
import pickle
from dataclasses import replace

import numpy as np
import pytest

import sonar_gl as sg
from sonar_gl.batch.paths import KINDS, ORTHOGONAL, Lawnmower, Orbit, RandomViews, Sector, Trajectory
from sonar_gl.poses import read_poses

LAWN = Lawnmower(
    centre_m=[100, -50], z_m=-7, length_m=10, width_m=7, line_spacing_m=2, speed_m_s=1.5, ping_rate_hz=3,
    yaw_rad=0.7, pitch_rad=0.2, roll_rad=-0.1,
)  # fmt: skip
ORBIT = Orbit(centre_m=[3, -4, -9], radius_m=5, z_m=-6, n_pings=36, turns=-1.5, start_rad=0.4, speed_m_s=2)
SECTOR = Sector(
    position_m=[1, 2, -3], pan_rad=[-1.0, 2.0], n_pings=39, ping_rate_hz=5, sweep_s=2.5, tilt_rad=0.3
)
VIEWS = RandomViews(
    target_m=[10, 20, -5], range_m=[2, 6], n_pings=3000, elevation_rad=[-0.4, 1.2], z_m=[-6, -1],
    azimuth_jitter_rad=0.3, elevation_jitter_rad=0.1, roll_jitter_rad=0.2, ping_rate_hz=4, seed=7,
)  # fmt: skip
ALL = {path.name(): path for path in (LAWN, ORBIT, SECTOR, VIEWS)}


@pytest.fixture(scope="module")
def views():
    """(N, 4, 4) of VIEWS."""
    return np.array([pose for _, pose in VIEWS])


def columns(path):
    times, poses = zip(*path, strict=True)
    return np.array(times), np.array(poses)


def in_sonar(poses, point):
    """Azimuth, elevation, range of a world point, as sonars see it."""
    x, y, z = (np.linalg.inv(poses) @ [*point, 1])[..., :3].T
    return np.arctan2(y, x), np.arctan2(z, np.hypot(x, y)), np.sqrt(x * x + y * y + z * z)


def check_uniform(values, low, high):
    """By Kolmogorov and Smirnov: one seed in 10 000 would fail, and the seeds stay."""
    share = np.sort((np.asarray(values) - low) / (high - low))
    n = len(share)
    assert share[0] >= -1e-9
    assert share[-1] <= 1 + 1e-9
    assert np.abs(share - (np.arange(n) + 0.5) / n).max() < 2.23 / math.sqrt(n)


# ---- all of them ------------------------------------------------------------------------------------


@pytest.mark.parametrize("path", ALL.values(), ids=ALL)
def test_a_ping_is_of_its_number_alone(path):
    times, poses = columns(path)
    assert len(times) == len(path)
    np.testing.assert_array_equal(path.times_s, times)
    assert path.times_s.dtype == poses.dtype == np.float64
    assert (np.diff(times) > 0).all()
    for n in (len(path) - 1, 0, len(path) // 2):
        fresh = pickle.loads(pickle.dumps(replace(path)))
        time_s, pose = fresh[n]
        assert type(time_s) is float
        assert (time_s, pose.tobytes()) == (times[n], poses[n].tobytes())
        assert fresh[n - len(path)][1].tobytes() == poses[n].tobytes()
        sg.scene.check_pose(pose)
    np.testing.assert_allclose(poses[:, :3, :3] @ poses[:, :3, :3].transpose(0, 2, 1), np.eye(3)[None].repeat(
        len(poses), axis=0), atol=1e-14)  # fmt: skip
    for n in (len(path), -len(path) - 1):
        with pytest.raises(IndexError, match=f"{path.name()} has pings 0..{len(path) - 1}"):
            path[n]


def test_kinds_are_named_as_in_jobs():
    assert list(KINDS) == ["trajectory", "lawnmower", "orbit", "sector", "random_views"]
    assert {name: KINDS[name] for name in ALL} == {name: type(path) for name, path in ALL.items()}


@pytest.mark.parametrize("path", [replace(path, n_pings=10**9) for path in (ORBIT, SECTOR, VIEWS)], ids=repr)
def test_a_thousand_million_pings_take_no_memory(path):
    assert len(path) == 10**9
    time_s, pose = path[10**9 - 1]
    assert time_s > 1e-6
    assert np.isfinite(pose).all()


def test_a_table_of_poses(tmp_path):
    file = tmp_path / "dive.csv"
    file.write_text("t,x,y,z,roll,pitch,yaw\n0,1,2,3,0.1,0.2,0.3\n0.5,2,2,3,0,0,-1\n2,3,2,3,0,0,0\n")
    path, (times, poses) = Trajectory(str(file)), read_poses(file)
    assert len(path) == 3
    np.testing.assert_array_equal(path.times_s, times)
    np.testing.assert_array_equal(columns(path)[1], poses)
    file.unlink()
    other = pickle.loads(pickle.dumps(path))
    assert other == path
    np.testing.assert_array_equal(other[1][1], sg.pose(2, 2, 3, yaw=-1))
    with pytest.raises(sg.Error, match=r"dive\.csv: the file of poses must be readable"):
        Trajectory(str(file))


# ---- along lines ------------------------------------------------------------------------------------


def test_lawnmower_geometry():
    """7 m in lines of 2 m are four legs at -3 -1 1 3; 10 m at 0.5 m a ping are 21 pings."""
    times, poses = columns(LAWN)
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
    """No point is more than half a spacing from a leg; 2.1 / 0.3 and 0.57 * 100 are not quite whole."""
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


# ---- round a target ---------------------------------------------------------------------------------


def test_orbit_looks_at_its_centre():
    times, poses = columns(ORBIT)
    azimuth, elevation, range_m = in_sonar(poses, (3, -4, -9))
    np.testing.assert_allclose([azimuth, elevation], 0, atol=1e-12)
    np.testing.assert_allclose(range_m, math.hypot(5, 3), rtol=1e-14)
    x, y, z = poses[:, :3, 3].T - [[3], [-4], [-9]]
    np.testing.assert_allclose(np.hypot(x, y), 5, rtol=1e-14)
    np.testing.assert_allclose(z, 3, rtol=1e-14)
    step = -1.5 * 2 * math.pi / 36  # clockwise
    np.testing.assert_allclose(np.unwrap(np.arctan2(y, x)), 0.4 + step * np.arange(36), atol=1e-12)
    np.testing.assert_allclose(times, np.arange(36) * 5 * -step / 2, rtol=1e-14)
    np.testing.assert_allclose(poses[:, 2, 1], 0, atol=1e-12)  # level: its port is neither up nor down


def test_whole_turns_repeat_no_place():
    path = Orbit(centre_m=(0, 0, 0), radius_m=1, z_m=0, n_pings=4, turns=1)
    places = np.array([pose[:2, 3] for _, pose in path])
    np.testing.assert_allclose(places, [[1, 0], [0, 1], [-1, 0], [0, -1]], atol=1e-15)


def test_sector_turns_to_and_fro():
    """12.5 steps of 0.2 s from end to end: 3 radians there, back, and there."""
    times, poses = columns(SECTOR)
    np.testing.assert_allclose(times, np.arange(39) / 5, rtol=1e-15)
    there = np.arange(13) * 3 / 12.5 - 1
    back = 2 - (np.arange(13, 26) - 12.5) * 3 / 12.5
    wanted = [sg.pose(1, 2, -3, pitch=0.3, yaw=yaw) for yaw in (*there, *back[:12], *there, *back[:1])]
    np.testing.assert_allclose(poses, wanted, atol=1e-14)


def test_sector_reaches_its_ends_by_way_of_the_angles_between():
    path = Sector(position_m=(0, 0, 0), pan_rad=(3, 6.2832), n_pings=9, ping_rate_hz=1, sweep_s=4)
    ahead = np.array([pose[:2, 0] for _, pose in path])
    yaw = np.array([3, 3.8208, 4.6416, 5.4624, 6.2832, 5.4624, 4.6416, 3.8208, 3])
    np.testing.assert_allclose(ahead, np.column_stack([np.cos(yaw), np.sin(yaw)]), atol=1e-12)


# ---- at random --------------------------------------------------------------------------------------


def test_views_are_uniform_where_they_say_so(views):
    """Points above -6 can be seen from all ranges; then the sine is uniform over what z leaves of it."""
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
    # what is left of the turn when the point is brought back to the boresight is the roll
    straight = [pose for _, pose in replace(VIEWS, azimuth_jitter_rad=0, elevation_jitter_rad=0)]
    check_uniform(np.arctan2([p[2, 1] for p in straight], [p[2, 2] for p in straight]), -0.2, 0.2)
    np.testing.assert_array_equal(np.array(straight)[:, :3, 3], views[:, :3, 3])  # jitters move no place
    azimuth, elevation, _ = in_sonar(np.array(straight), (10, 20, -5))
    np.testing.assert_allclose([azimuth, elevation], 0, atol=1e-12)


def test_views_from_one_side(views):
    places = [pose[:3, 3] for _, pose in replace(VIEWS, azimuth_rad=(2.0, 4.0))]
    offset = np.array(places) - (10, 20, -5)
    check_uniform(np.arctan2(offset[:, 1], offset[:, 0]) % (2 * math.pi), 2.0, 4.0)
    np.testing.assert_allclose(offset[:, 2], views[:, 2, 3] + 5)  # it moves nothing else


def test_points_of_a_box_are_aimed_at():
    path = RandomViews(target_m=(1, 2, 3), target_size_m=(4, 2, 0.5), range_m=(1e-3, 1e-3), n_pings=2000)
    places = np.array([pose[:3, 3] for _, pose in path])
    for axis, (at, size) in enumerate(zip((1, 2, 3), (4, 2, 0.5), strict=True)):
        check_uniform(places[:, axis], at - size / 2 - 1e-3, at + size / 2 + 1e-3)


@pytest.mark.parametrize(
    "elevation_rad, z_m, low, high",
    [
        ((0.5, 1.0), (-9, 2.0), 1.0, 2 / math.sin(0.5)),  # from further off it would stand too high
        ((0.5, 1.0), (2.0, 50), 2 / math.sin(1.0), 10.0),  # from nearer too low
        ((-1.0, -0.5), (-2.0, 9), 1.0, 2 / math.sin(0.5)),
        ((-1.0, -0.5), (-50, -2.0), 2 / math.sin(1.0), 10.0),
        ((0.0, 0.0), (-1, 1), 1.0, 10.0),
        ((-1.5708, 1.5708), (3, 3), 3.0, 10.0),
    ],
)
def test_ranges_are_those_that_z_allows(elevation_rad, z_m, low, high):
    path = RandomViews(target_m=(0, 0, 0), range_m=(1, 10), n_pings=400, elevation_rad=elevation_rad, z_m=z_m)
    places = np.array([pose[:3, 3] for _, pose in path])
    check_uniform(np.linalg.norm(places, axis=1), low, high)
    assert places[:, 2].min() >= z_m[0] - 1e-9
    assert places[:, 2].max() <= z_m[1] + 1e-9


def test_seeds_and_numbers_make_others(views):
    assert len({pose.tobytes() for pose in views}) == len(views)
    other = [pose for _, pose in replace(VIEWS, seed=8, n_pings=50)]
    assert not {pose.tobytes() for pose in views} & {pose.tobytes() for pose in other}
    np.testing.assert_array_equal(replace(VIEWS, n_pings=50)[49][1], views[49])  # more pings change none


# ---- two sonars -------------------------------------------------------------------------------------


def test_orthogonal_fans_share_a_boresight():
    vehicle = sg.pose(1, 2, 3, 0.1, 0.2, 0.3)
    above = (vehicle @ sg.pose(pitch=-0.25) @ [5, 0, 0, 1])[:3]
    azimuth, elevation, _ = in_sonar(vehicle @ ORTHOGONAL["horizontal"], above)
    assert (azimuth, elevation) == pytest.approx((0, 0.25), abs=1e-12)
    azimuth, elevation, _ = in_sonar(vehicle @ ORTHOGONAL["vertical"], above)
    assert (azimuth, elevation) == pytest.approx((0.25, 0), abs=1e-12)
    with pytest.raises(ValueError, match="read-only"):
        ORTHOGONAL["vertical"][0, 0] = 2


# ---- messages ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "path, change, message",
    [
        (LAWN, {"centre_m": [1, 2, 3]}, "lawnmower: centre_m must be 2 numbers (got [1, 2, 3]; give metres)"),
        (LAWN, {"centre_m": 5}, "lawnmower: centre_m must be 2 numbers (got 5; give metres)"),
        (LAWN, {"centre_m": "12"}, "lawnmower: centre_m must be 2 numbers (got '12'; give metres)"),
        (LAWN, {"centre_m": [1, "a"]}, "lawnmower: centre_m must be a number (got 'a'; give metres)"),
        (LAWN, {"z_m": True}, "lawnmower: z_m must be a number (got True; give metres)"),
        (LAWN, {"z_m": math.nan}, "lawnmower: z_m must lie in -1e+08..1e+08 (got nan; give metres)"),
        (LAWN, {"length_m": 0}, "lawnmower: length_m must lie in 0.001..1e+08 (got 0; give metres)"),
        (LAWN, {"width_m": -1}, "lawnmower: width_m must lie in 0.001..1e+08 (got -1; give metres)"),
        (LAWN, {"line_spacing_m": 0}, "lawnmower: line_spacing_m must lie in 0.001..1e+08 (got 0; give"),
        (LAWN, {"speed_m_s": 0}, "speed_m_s must lie in 1e-06..1000 (got 0; give metres per second)"),
        (LAWN, {"ping_rate_hz": 0}, "ping_rate_hz must lie in 1e-06..1e+06 (got 0; give pings a second)"),
        (LAWN, {"yaw_rad": 90}, "lawnmower: yaw_rad must lie in -6.2832..6.2832 (got 90; give radians"),
        (LAWN, {"pitch_rad": 2}, "lawnmower: pitch_rad must lie in -1.5708..1.5708 (got 2; give radians"),
        (LAWN, {"roll_rad": 4}, "lawnmower: roll_rad must lie in -3.1416..3.1416 (got 4; give radians"),
        (
            LAWN,
            {"length_m": 1e6, "width_m": 1e6},
            "lawnmower: must have at most 1e+09 pings (got 500000 legs of 2000001; give a larger "
            "line_spacing_m, or a smaller ping_rate_hz)",
        ),
        (ORBIT, {"centre_m": [1, 2]}, "orbit: centre_m must be 3 numbers (got [1, 2]; give metres)"),
        (ORBIT, {"radius_m": 0}, "orbit: radius_m must lie in 0.001..1e+08 (got 0; give metres)"),
        (ORBIT, {"n_pings": 2.5}, "orbit: n_pings must be a whole number (got 2.5; give how many pings)"),
        (ORBIT, {"n_pings": 0}, "orbit: n_pings must lie in 1..1e+09 (got 0; give how many pings)"),
        (ORBIT, {"turns": 0}, "orbit: turns must not be 0 (got 0; 1 is once round, -1 the other way)"),
        (ORBIT, {"turns": 1e7}, "orbit: turns must lie in -1e+06..1e+06 (got 1e+07; 1 is once round, -1"),
        (SECTOR, {"pan_rad": 1.0}, "sector: pan_rad must be 2 numbers (got 1.0; give radians: degrees"),
        (SECTOR, {"pan_rad": [-45, 45]}, "sector: pan_rad must lie in -6.2832..6.2832 (got -45; give"),
        (SECTOR, {"sweep_s": 0}, "sector: sweep_s must lie in 0.001..1e+09 (got 0; give seconds from"),
        (SECTOR, {"tilt_rad": 30}, "sector: tilt_rad must lie in -1.5708..1.5708 (got 30; give radians"),
        (VIEWS, {"range_m": [5, 2]}, "random_views: range_m must be [low, high] (got 5 and 2; swap them)"),
        (VIEWS, {"range_m": [0, 2]}, "random_views: range_m must lie in 0.001..1e+08 (got 0; give metres)"),
        (VIEWS, {"elevation_rad": [1, 0]}, "elevation_rad must be [low, high] (got 1 and 0; swap them)"),
        (VIEWS, {"z_m": [0, -9]}, "random_views: z_m must be [low, high] (got 0 and -9; swap them)"),
        (VIEWS, {"target_size_m": [1, 1, -1]}, "target_size_m must lie in 0..1e+08 (got -1; give metres)"),
        (VIEWS, {"azimuth_jitter_rad": -0.1}, "azimuth_jitter_rad must lie in 0..3.1416 (got -0.1; give rad"),
        (VIEWS, {"seed": -1}, "random_views: seed must be a whole number, 0 or more (got -1)"),
        (
            VIEWS,
            {"z_m": [2.0, 5.0]},
            "random_views: range_m and elevation_rad must leave a place within z_m = [2.0, 5.0] from which "
            "to look at z = -5 (got [2.0, 6.0] and [-0.4, 1.2]; widen one of the three, or make "
            "target_size_m smaller)",
        ),
        (VIEWS, {"target_size_m": [0, 0, 30]}, "from which to look at z = -20 (got [2.0, 6.0] and"),
        (VIEWS, {"target_size_m": [0, 0, 14], "z_m": [-14, -4]}, "from which to look at z = 2 (got"),
        (VIEWS, {"elevation_rad": [0, 0], "z_m": [-9, -6]}, "from which to look at z = -5 (got [2.0, 6.0]"),
    ],
)  # fmt: skip
def test_messages(path, change, message):
    with pytest.raises(sg.Error) as caught:
        replace(path, **change)
    assert message in str(caught.value)
    assert str(caught.value).startswith(path.name())
