"""What changes from ping to ping: bodies that move, come and go, and values of water and noise."""

import itertools
import math
import re
import warnings
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import sonar_gl as sg
from sonar_gl.batch.job import Job, MovedTable, read_job
from sonar_gl.batch.random_streams import VARY_STREAM, generator
from sonar_gl.batch.requests import BatchRequests
from sonar_gl.batch.variation import MovedBodies, draw_fields
from tests.support.batch_pings import N_SMALL
from tests.support.batches import BOX, FLOOR, write_job, write_plain_job
from tests.support.command_line import BODY, WALL
from tests.support.wall_and_rods import wall


@pytest.mark.parametrize(
    ("changed", "setting"),
    [
        ("wind_speed_m_s = [1.0, 9.0]", 'multipath = "incoherent"'),
        ("salinity_psu = [2.0, 9.0]", "sonar_sound_speed_m_s = 1500.0"),
    ],
)
def test_water_that_no_simulator_may_vary_is_refused_before_any_ping(tmp_path, changed, setting):
    """Otherwise each ping would fail, for a reason of its own, and be set aside."""
    path = write_job(tmp_path, 2, "")
    text = path.read_text().replace("temperature_c = [2.0, 20.0]", changed)
    path.write_text(text.replace("tvg_absorption_db_m = 0.3", setting))
    with pytest.raises(sg.Error, match=f"^{path}: vary.water.* exclude each other .got both;"):
        BatchRequests(read_job(path))


def test_varied_values_are_uniform_within_their_bounds_and_depend_on_the_seed(small, requests):
    temperatures = [requests[n].water.temperature_c for n in range(N_SMALL)]
    again = BatchRequests(read_job(small / "job.toml"))
    assert [again[n].water.temperature_c for n in reversed(range(N_SMALL))] == temperatures[::-1]
    assert len(set(temperatures)) == N_SMALL
    assert all(2 <= t <= 20 for t in temperatures)
    other = BatchRequests(read_job(small / "job.toml").model_copy(update={"seed": 6}))
    assert not {other[n].water.temperature_c for n in range(N_SMALL)} & set(temperatures)
    table = requests.job.vary.bodies[0]
    job = requests.job.model_copy(update={"poses": [requests.job.poses[0] | {"n_pings": 500}]})
    poses = [request.bodies["box_1"] for request in BatchRequests(job)]
    shifts = [pose[0, 3] - 3 for pose in poses if pose is not None]
    # 4 standard errors: of a share of 0.8, and of the mean and variance of a uniform distribution
    assert len(shifts) / 500 == pytest.approx(table.there, abs=4 * math.sqrt(0.8 * 0.2 / 500))
    assert np.mean(shifts) == pytest.approx(0, abs=4 / math.sqrt(12 * len(shifts)))
    assert np.var(shifts) == pytest.approx(1 / 12, abs=4 / math.sqrt(180 * len(shifts)))
    assert min(shifts) >= -0.5 and max(shifts) <= 0.5


def test_what_moves_apart_moves_as_whole_models(tmp_path):
    """A fish does not lose its tail, be it in a model of its own or in a school; a pattern may name parts alone."""
    link = '<link name="{}"><pose>{} 0 0 0 0 0</pose>{}</link>'
    sphere = "<geometry><sphere><radius>0.1</radius></sphere></geometry>"
    ball = f'<collision name="c">{sphere}<laser_retro>50</laser_retro></collision>'
    links = link.format("head", 0.0, ball) + link.format("tail", -0.3, ball)
    pair = "".join(
        f'<model name="{name}"><pose>{y} 1 0 0 0 1</pose>{links}</model>' for y, name in enumerate("ab")
    )
    path = write_job(tmp_path, 40, "")
    (tmp_path / "tank.sdf").write_text(
        f'<sdf version="1.9"><world name="tank">{pair}<model name="school">{pair}</model></world></sdf>'
    )
    table = {
        "apart": True,
        "x_m": [1.0, 2.0],
        "yaw_rad": [-3.0, 3.0],
        "there": 0.5,
        "reflectivity": [0.1, 0.9],
    }

    def models(*names):
        job = Job(**read_job(path).plain | {"vary": {"bodies": [table | {"names": list(names)}]}})
        for request in BatchRequests(job):
            found = {}
            for name, pose in request.bodies.items():
                found.setdefault(name.rpartition("::")[0], []).append((pose, request.reflectivity.get(name)))
            yield found

    for found in models("a*", "b*", "school::*"):
        assert set(found) == {"a", "b", "school::a", "school::b"}
        there = [parts for parts in found.values() if parts[0][0] is not None]
        assert sum(pose is not None for parts in found.values() for pose, _ in parts) == 2 * len(there)
        for (head, mu), (tail, tail_mu) in there:
            np.testing.assert_allclose(head @ sg.pose(-0.3), tail, atol=1e-12)
            assert head[1, 3] == pytest.approx(1.0, abs=1e-12)  # both turn about the first
            assert mu == tail_mu
        assert len({parts[0][1] for parts in there}) == len(there)
    by_part = [parts for found in models("*::head", "*::tail") for parts in found.values()]
    assert any((head is None) != (tail is None) for (head, _), (tail, _) in by_part)
    for found in models("*"):  # the school is one model
        (a, mu), (b, b_mu) = found["school::a"][0], found["school::b"][0]
        assert (a is None) == (b is None) and mu == b_mu


def test_one_of_several_bodies_is_there_at_a_time_each_as_often(tmp_path):
    """Of three, a fish with its tail among them: what it is made of, its size and shape vary from ping to ping."""
    path = write_job(tmp_path, 400, "")
    link = re.search("<link.*</link>", BOX, re.DOTALL)[0]
    links = "".join(link.replace('"link"', f'"{name}"') for name in ("head", "tail"))
    fish = f'<model name="fish"><pose>3 0 0 0 0 0</pose>{links}</model>'
    bodies = WALL + BOX + BOX.replace("box_1", "box_2") + fish + FLOOR
    (tmp_path / "tank.sdf").write_text(f'<sdf version="1.9"><world name="tank">{bodies}</world></sdf>')
    (tmp_path / "empty.sdf").write_text(f'<sdf version="1.9"><world name="empty">{WALL}</world></sdf>')
    one = {"names": ["box_*", "fish*"], "one_of": True, "x_m": [-0.5, 0.5], "there": 0.8}
    after = {"names": ["floor"], "z_m": [-0.2, 0.0]}
    plain = read_job(path).plain | {"scenes": ["tank.sdf", "empty.sdf"]}

    def bodies_of(count, *tables):
        requests = BatchRequests(Job(**plain | {"vary": {"bodies": list(tables)}}))
        return [requests[number].bodies for number in range(count)], requests

    found, requests = bodies_of(400, one, after)
    counts = dict.fromkeys(("", "box_1", "box_2", "fish::head"), 0)
    for moved in found:
        assert set(moved) == {"box_1", "box_2", "fish::head", "fish::tail", "floor"}
        there = [name for name in moved if moved[name] is not None and name != "floor"]
        assert there in ([], ["box_1"], ["box_2"], ["fish::head", "fish::tail"])
        counts[there[0] if there else ""] += 1
    expected = np.array([0.2, 0.8 / 3, 0.8 / 3, 0.8 / 3]) * 400
    chi_squared = ((np.array(list(counts.values())) - expected) ** 2 / expected).sum()
    assert chi_squared < 16.3  # exceeded once in a thousand seeds
    shifts = np.array([moved["box_1"][0, 3] - 3 for moved in found if moved["box_1"] is not None])
    assert abs(shifts).max() <= 0.5 and shifts.std() == pytest.approx(1 / np.sqrt(12), rel=0.1)
    assert requests[400].bodies == {}  # a scene without any of them
    # which one is there decides no draw of another table
    floor, _ = bodies_of(100, one | {"there": 1.0}, after)
    assert all(np.array_equal(a["floor"], b["floor"]) for a, b in zip(found[:100], floor, strict=True))
    alone, _ = bodies_of(100, {"names": ["box_1"], "one_of": True})
    assert not any(alone)  # it is always there, as it is in the scene


def test_what_is_drawn_holds_for_consecutive_pings_of_a_path(tmp_path):
    """Bodies, water and noise stay for 4 pings, begin anew with each path and scene, and are those of the first one."""
    path = write_job(tmp_path, 10, "")
    other = f'<sdf version="1.9"><world name="other">{BOX}</world></sdf>'
    (tmp_path / "other.sdf").write_text(other)
    orbit = {"kind": "orbit", "centre_m": [3.0, 0.0, 0.0], "radius_m": 2.0, "z_m": 0.0, "turns": 1}
    plain = read_job(path).plain
    plain |= {"scenes": ["tank.sdf", "other.sdf"], "poses": [*plain["poses"], orbit | {"n_pings": 5}]}
    # places that are drawn again until they are clear hold, too
    box = {
        "names": ["box_1"],
        "x_m": [-0.5, 3.5],
        "y_m": [-1.0, 1.0],
        "there": 0.9,
        "reflectivity": [0.1, 0.9],
    }
    wall = {"names": ["wall"], "x_m": [-2.0, 0.0], "clearance_m": 1.0}
    vary = {"bodies": [wall, box | {"clearance_m": 0.1}], "water": {"temperature_c": [2.0, 20.0]}}
    vary["noise"] = {"ambient_db": [-90.0, -60.0]}

    def drawn(**hold):
        requests = BatchRequests(Job(**plain | {"vary": vary | hold}))
        return requests, [
            repr((one.bodies, one.reflectivity, one.water, one.noise.ambient_db)) for one in requests
        ]

    each, held = drawn()[1], drawn(hold_pings=4)
    requests, found = held
    starts = [run.numbers.start for run in requests.runs]
    assert starts == [0, 10, 20, 25] and len(requests) == 30
    firsts = [0, 4, 8, 10, 14, 18, 20, 24, 25, 29]
    assert found == [each[max(first for first in firsts if first <= n)] for n in range(30)]
    assert len(set(found)) == len(firsts)
    assert [requests[n].vehicle_pose.tolist() for n in range(30)] == [
        one.vehicle_pose.tolist() for one in drawn()[0]
    ]
    assert drawn(hold_pings=1)[1] == each
    assert drawn(hold_pings=100)[1] == [each[max(s for s in starts if s <= n)] for n in range(30)]


def test_a_body_takes_along_what_is_named_after_it():
    """As those of MuJoCo, which are bodies in bodies, and no models."""
    names = ["fish", "fish::tail", "crab"]
    scene = sg.Scene([replace(wall(), name=name) for name in names])
    table = MovedTable(names=["*"], apart=True, x_m=[0.0, 1.0])
    job = SimpleNamespace(seed=0, vary=SimpleNamespace(bodies=[table]))
    poses, *_ = MovedBodies(scene, job, paths=[[]]).draw(0, generator(0, VARY_STREAM, 0), 0, 0.0)
    fish, tail, crab = (poses[name][0, 3] for name in names)
    assert fish == tail != crab


def test_draws_depend_neither_on_constants_nor_on_the_order_of_keys():
    def drawn(table):
        return draw_fields(generator(0, VARY_STREAM, 0), table)

    expected = drawn({"salinity_psu": [30.0, 35.0], "temperature_c": [5.0, 20.0]})
    assert drawn({"temperature_c": [5.0, 20.0], "salinity_psu": [30.0, 35.0]}) == expected
    assert drawn({"salinity_psu": 30.0, "temperature_c": [5.0, 20.0]}) == expected | {"salinity_psu": 30.0}


def test_bodies_shift_along_the_axes_of_the_world_and_turn_about_their_own(tmp_path):
    """A box that lies rolled and turned at another place: its position has the shift added, its axes the turn."""
    path = write_job(tmp_path, 2, "")
    scene = tmp_path / "tank.sdf"
    scene.write_text(
        scene.read_text().replace("<pose>3 0.3 -0.3 0 0 0</pose>", "<pose>3 1 -2 0.4 0.3 1.1</pose>")
    )
    shift, turn = (
        {"x_m": 0.5, "y_m": -0.25, "z_m": 0.125},
        {"roll_rad": 0.1, "pitch_rad": -0.2, "yaw_rad": 0.7},
    )
    job = Job(**read_job(path).plain | {"vary": {"bodies": [{"names": ["box_1"], **shift, **turn}]}})
    requests = BatchRequests(job)
    placed = requests.scenes.moved_bodies(0).known["box_1"].pose
    np.testing.assert_allclose(placed, sg.pose(3, 1, -2, 0.4, 0.3, 1.1), atol=1e-12)
    expected = placed @ sg.pose(0, 0, 0, *turn.values())
    expected[:3, 3] = [3.5, 0.75, -1.875]
    for request in requests:
        np.testing.assert_allclose(request.bodies["box_1"], expected, atol=1e-12)


def test_bodies_rest_on_a_floor_however_they_turn(tmp_path):
    """By their lowest corner, on the floor where a table before has moved it; `z_m` buries them."""
    path = write_job(tmp_path, 20, "")
    turn = {"roll_rad": [-3.0, 3.0], "pitch_rad": [-1.5, 1.5], "yaw_rad": [-3.0, 3.0]}
    drawn, resting = {"names": ["box_1"], "x_m": [-1.0, 1.0], "there": 0.7, **turn}, {"rests_on": "floor"}
    floor = {"names": ["floor"], "z_m": [-0.5, 0.0]}

    def found(*tables):
        return [*BatchRequests(Job(**read_job(path).plain | {"vary": {"bodies": list(tables)}}))]

    for depth_m in (0.0, 0.05):
        tables = floor, drawn | {"z_m": -depth_m}
        for request, free in zip(found(floor, tables[1] | resting), found(*tables), strict=True):
            pose = request.bodies["box_1"]
            if pose is None:
                assert free.bodies["box_1"] is None
                continue
            lowest_m = pose[2, 3] - 0.1 * np.abs(pose[2, :3]).sum()  # of a box with edges of 0.2 m
            assert lowest_m == pytest.approx(request.bodies["floor"][2, 3] - depth_m, abs=1e-9)
            assert np.array_equal(np.delete(pose, 11), np.delete(free.bodies["box_1"], 11))  # all but z
    (still,) = {request.bodies["box_1"][2, 3] for request in found({"names": ["box_1"]} | resting)}
    assert still == pytest.approx(-0.3, abs=1e-9)  # half of its height above the floor at -0.4 m


def test_bodies_keep_clear_of_each_other(tmp_path):
    """Also of one that stays. A place that is clear at once is kept."""
    path = write_job(tmp_path, 100, "")
    y_m = {"box_1": 0.0, "box_2": 0.6, "box_3": 0.3, "box_4": 0.3}
    boxes = "".join(BODY.format(name, f"3 {y} -0.3", "0.2 0.2 0.2") for name, y in y_m.items())
    (tmp_path / "tank.sdf").write_text(f'<sdf version="1.9"><world name="tank">{boxes}{WALL}</world></sdf>')
    plain = read_job(path).plain

    def found(side_m, **more):
        reach = {"x_m": [-side_m, side_m], "y_m": [-side_m, side_m], "yaw_rad": [-3.0, 3.0]}
        moved = {"names": ["box_1", "box_2", "box_3"], "apart": True, **reach, **more}
        tables = [{"names": ["box_4"], **more}, moved, {"names": ["wall"], "x_m": [0.0, 1.0]}]
        requests = BatchRequests(Job(**plain | {"vary": {"bodies": tables}}))
        return [one.bodies for one in requests]

    def gaps_m(bodies):
        """The largest gap, along x or y, of each pair; the boxes are 0.2 m long, box_4 at (3, 0.3)."""
        there = [*bodies.values(), sg.pose(3, 0.3)]
        half_m = [0.1 * np.abs(pose[:2, :2]).sum(axis=1) for pose in there]
        pairs = itertools.combinations(range(len(there)), 2)
        return [(np.abs(there[a][:2, 3] - there[b][:2, 3]) - half_m[a] - half_m[b]).max() for a, b in pairs]

    free, clear = found(0.6), found(0.6, clearance_m=0.05)
    walls_m = [[bodies.pop("wall")[0, 3] for bodies in pings] for pings in (free, clear)]
    assert walls_m[0] == walls_m[1]  # no other draw depends on how often a body is redrawn
    n_kept, redrawn = 0, []
    for before, after in zip(free, clear, strict=True):
        assert set(after) == {"box_1", "box_2", "box_3"} and all(pose is not None for pose in after.values())
        assert min(gaps_m(after)) >= 0.05 - 1e-12
        if min(gaps_m(before)) >= 0.05:
            n_kept += 1
            assert all(np.array_equal(before[name], after[name]) for name in before)
        changed = [name for name in before if not np.array_equal(before[name], after[name])]
        redrawn += [round(after[name][1, 3] - y_m[name], 9) for name in changed]
    assert 0 < n_kept < 100
    assert len(set(redrawn)) == len(redrawn) > 50  # each body of each ping has its own draws


def test_a_body_without_a_clear_place_is_absent(tmp_path):
    """It has no reflectivity then, and neither it nor where a later table has moved a body from takes a place."""
    path = write_job(tmp_path, 1, "")
    boxes = BOX + BOX.replace("box_1", "box_2") + BOX.replace("box_1", "box_3")
    (tmp_path / "tank.sdf").write_text(f'<sdf version="1.9"><world name="tank">{boxes}{WALL}</world></sdf>')
    plain, clear = read_job(path).plain, {"clearance_m": 0.1, "reflectivity": 0.5}

    def found(*tables):
        (request,) = BatchRequests(Job(**plain | {"vary": {"bodies": list(tables)}}))
        lacking = [name for name, pose in request.bodies.items() if pose is None]
        assert request.unplaced == [name for name in lacking if tables[-2].get("there") != 0.0]
        assert request.reflectivity == {
            name: 0.5 for name, pose in request.bodies.items() if pose is not None
        }
        return {name: None if pose is None else round(pose[1, 3], 9) for name, pose in request.bodies.items()}

    one, two, three = ({"names": [f"box_{k}"]} | clear for k in (1, 2, 3))
    assert found(one, two, three) == {"box_1": 0.3, "box_2": None, "box_3": None}
    assert found(one, two, three | {"y_m": 0.29}) == {"box_1": 0.3, "box_2": None, "box_3": None}
    assert found(one, two, three | {"y_m": 0.31}) == {"box_1": 0.3, "box_2": None, "box_3": 0.61}
    assert found(one, one | {"y_m": 0.1}) == {"box_1": 0.4}
    assert found(one, two, two | {"y_m": 0.31}) == {"box_1": 0.3, "box_2": 0.61}
    assert found(one, one | {"there": 0.0}, two) == {"box_1": None, "box_2": 0.3}


def test_what_rests_takes_plumes_along_and_keeps_its_height_beside_the_floor(tmp_path):
    path = write_job(tmp_path, 1, "")
    floor = BODY.format("floor", "3 0 -0.9", "1 1 1")
    diver = BODY.format("diver", "3 0 -0.2", "0.2 0.2 0.1")
    diver = diver.replace("</link>", "<sonar_gl:bubbles name='breath'/></link>")
    (tmp_path / "tank.sdf").write_text(
        f'<sdf version="1.9"><world name="tank">{BOX}{diver}{floor}</world></sdf>'
    )
    plain, resting = read_job(path).plain, {"rests_on": "floor", "clearance_m": 0.0, "z_m": 0.05}

    def heights_m(names, **more):
        tables = [{"names": names} | resting | more]
        (request,) = BatchRequests(Job(**plain | {"vary": {"bodies": tables}}))
        return [request.bodies[name][2, 3] for name in names]

    assert heights_m(["box_1"]) == pytest.approx([-0.4 + 0.1 + 0.05], abs=1e-9)
    assert heights_m(["box_1"], x_m=2.0) == pytest.approx([-0.3 + 0.05], abs=1e-9)
    # the diver's lower side is 0.15 m above the floor
    assert heights_m(["diver", "breath"]) == pytest.approx([-0.2 - 0.15 + 0.05] * 2, abs=1e-9)


@pytest.mark.parametrize("distances_m", [(0.5, 0.1), (0.1, 0.5)])
def test_bodies_keep_the_larger_distance_of_two_tables_whichever_is_first(tmp_path, distances_m):
    path = write_job(tmp_path, 50, "")
    boxes = "".join(BOX.replace("box_1", f"box_{k}") for k in (1, 2))
    (tmp_path / "tank.sdf").write_text(f'<sdf version="1.9"><world name="tank">{boxes}{WALL}</world></sdf>')
    reach = {"x_m": [-0.8, 0.8], "y_m": [-0.8, 0.8]}
    tables = [
        {"names": [f"box_{k}"], "clearance_m": distance_m, **reach}
        for k, distance_m in zip((1, 2), distances_m, strict=True)
    ]
    for request in BatchRequests(Job(**read_job(path).plain | {"vary": {"bodies": tables}})):
        first, second = request.bodies["box_1"], request.bodies["box_2"]
        assert np.abs(first[:2, 3] - second[:2, 3]).max() - 0.2 >= 0.5 - 1e-12  # boxes of 0.2 m


def test_of_two_tables_that_name_a_body_the_later_one_counts(tmp_path):
    """As a whole, also where it changes nothing: "*" moves, and `floor` after it stays."""
    path = write_job(tmp_path, 40, "")
    tables = [
        {"names": ["*"], "apart": True, "x_m": [1.0, 2.0], "reflectivity": 0.9},
        {"names": ["floor"]},
        {"names": ["box_1"], "there": 0.5},
        {"names": ["wall"], "reflectivity": 0.1},
    ]
    job = Job(**read_job(path).plain | {"vary": {"bodies": tables}})
    requests = BatchRequests(job)
    wall = {body.name: body.pose for body in requests.scenes[0].bodies}["wall"]
    boxes = []
    for request in requests:
        assert request.reflectivity == {"wall": 0.1}
        assert set(request.bodies) - {"box_1"} == {"wall"}
        np.testing.assert_array_equal(request.bodies["wall"], wall)
        boxes.append(request.bodies.get("box_1", "unmoved"))
    assert {box is None for box in boxes} == {True, False}
    assert all(box is None or box == "unmoved" for box in boxes)


@pytest.mark.slow
@pytest.mark.parametrize(("low", "high"), [(2, 5), (1, 2), (3, 3)])
def test_varied_looks_are_whole_numbers_each_equally_probable(small, low, high):
    """Of 600 draws each of n numbers has 600 / n, but for four standard deviations."""
    job = read_job(small / "job.toml")
    poses = [job.poses[0] | {"n_pings": 600}]
    vary = job.vary.model_copy(update={"noise": {"looks": [low, high]}})
    requests = BatchRequests(job.model_copy(update={"vary": vary, "poses": poses}))
    drawn = [request.noise.looks for request in requests]
    share = 1 / (high - low + 1)
    assert {type(looks) for looks in drawn} == {int} and set(drawn) == set(range(low, high + 1))
    for looks in range(low, high + 1):
        assert abs(drawn.count(looks) - 600 * share) <= 4 * math.sqrt(600 * share * (1 - share))
    again = [request.noise.looks for request in reversed(requests)]
    assert again == drawn[::-1]


def test_looks_that_are_no_whole_numbers_are_refused(small):
    job = read_job(small / "job.toml")
    for looks in ([1.5, 3], [1, 2.5], 1.5):
        vary = job.vary.model_copy(update={"noise": {"looks": looks}})
        with pytest.raises(sg.Error, match=r"job.toml: vary.noise.looks must be whole numbers .got \d.5.$"):
            BatchRequests(job.model_copy(update={"vary": vary}))


@pytest.mark.parametrize("low_db", [-80, 3])
def test_a_varied_noise_that_is_too_high_is_warned_of_once(tmp_path, low_db):
    """By the upper end of its range; each ping, whose level is another, warned of its own."""
    path = write_plain_job(tmp_path, 4, 4, f"[vary.noise]\nambient_db = [{low_db}, 5]\n")
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        requests = BatchRequests(read_job(path))
        assert len({request.noise.ambient_db for request in requests}) == 4
    assert [str(one.message).partition(" exceeds")[0] for one in found] == ["noise: ambient_db = 5"]
