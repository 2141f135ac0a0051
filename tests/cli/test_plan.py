"""`sonar-gl plan`: the samples of a tolerance, why, and what others would cost."""

import json
import re
from dataclasses import replace
from pathlib import Path

import pytest

import sonar_gl as sg
from sonar_gl.analysis import reference
from sonar_gl.analysis.terms import TERMS, price
from sonar_gl.cli import plan as costs
from sonar_gl.cli.report import percent
from sonar_gl.core.poses import read_poses
from sonar_gl.engine.body_counts import BODY_ERROR_RATE
from sonar_gl.engine.flow import Plan
from sonar_gl.sonar.sampling import ERROR_RATE, LEVELS_PER_HALF
from tests.support import command_line
from tests.support.command_line import BOX, SENSOR, SONAR, WALL

SCENE = '<sdf version="1.9"><world name="any">{}</world></sdf>'
POSES = "t,x,y,z,roll,pitch,yaw\n0,0,0,0,0,0,0.7\n0.5,-2,0,0,0,0,0\n1.0,1,0,0,0,0,0.1\n"
QUICK = ("--sonar", "small.toml", "--tolerance", 0.05)


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch, timed_once):
    """A folder with small scenes, a small sonar and three poses, which is the working directory."""
    monkeypatch.chdir(tmp_path)
    Path("tank.sdf").write_text(SCENE.format(WALL + BOX + SENSOR))
    Path("wall.sdf").write_text(SCENE.format(WALL + SENSOR))
    Path("empty.sdf").write_text(SCENE.format(SENSOR))
    Path("small.toml").write_text(SONAR)
    Path("dive.csv").write_text(POSES)


def run(*arguments):
    """(exit status, stdout, stderr) of `sonar-gl plan`."""
    return command_line.run("plan", *arguments)


def plan(*arguments, scene="tank.sdf"):
    """What a plan finds, of one that does without a word on stderr."""
    status, out, err = run(scene, *QUICK, "--json", *arguments)
    assert err == "" and status == (0 if json.loads(out)["met"] else 1)
    return json.loads(out)


def table(out):
    """Tolerance in per cent -> the other cells of its row."""
    header, *rows = out.split("\n\n")[1].splitlines()
    assert header.split("  ")[0] == "tolerance" and header.endswith("  met")
    return {float(row.split()[0]): re.split(r"\s{2,}", row)[1:] for row in rows if row[0].isdigit()}


def test_the_command_says_what_was_chosen_why_and_what_else_there_is():
    status, out, err = run("tank.sdf", *QUICK)
    assert (status, err) == (0, "")
    found = dict(re.findall(r"^(\w[\w ]*?)  +(.*)$", out.partition("\n\n")[0], re.MULTILINE))
    assert list(found) == [
        "scene", "sonar", "profile", "tolerance", "samples", "error", "worst body", "bound by", "ping",
    ]  # fmt: skip
    assert (found["scene"], found["sonar"]) == ("tank", "small, 24 beams x 80 bins")
    assert (found["profile"], found["tolerance"]) == ("physical", "5 % can be met")
    samples, per_beam, rows = re.fullmatch(
        r"(\d+), with ([\d.]+) columns per beam x (\d+) rows in the aperture", found["samples"]
    ).groups()
    assert int(samples) > 1.5 * 24 * float(per_beam) * int(rows)  # skirts and side lobes have samples, too
    assert re.fullmatch(r"[\d.]+ % of the echo, estimated", found["error"])
    assert re.fullmatch(r"'(box|wall)', its own echo off by [\d.]+ %, estimated", found["worst body"])
    assert found["bound by"] in costs.BOUND_BY.values()
    assert re.fullmatch(r"\d+\.\d\d ms on .+", found["ping"])
    others = table(out)
    assert list(others) == [2.5, 5, 10]
    assert [int(row[0]) for row in others.values()] == sorted(int(row[0]) for row in others.values())[::-1]
    assert others[5][0] == samples and others[5][-2:] == ["1.00", "yes"]
    assert all(len(row) == 6 and row[1].endswith(" %") and row[2].endswith(" %") for row in others.values())


@pytest.mark.slow
def test_it_prices_every_term():
    out = run("tank.sdf", *QUICK)[1]
    header, *rows = out.split("\n\n")[2].splitlines()
    assert re.split(r"\s{2,}", header) == [
        "without", "the image changes", "worst bin", "bins > 3 dB", "ms", "needed",
    ]  # fmt: skip
    told = {cells[0]: cells[1:] for cells in (re.split(r"\s{2,}", row) for row in rows)}
    found = plan()["terms"]
    assert list(told) == [term["name"] for term in found] == [term.name for term in TERMS]
    for term in found:
        *told_shares, _, state = told[term["name"]]
        assert told_shares == [percent(term[key]) for key in ("changes", "worst_bin", "changed_bins")]
        assert state == ("on" if term["on"] else "off")
        changes = max(term["changes"], term["changed_bins"])
        assert changes > 0 or (term["time_ms"], term["on"]) == (0, False)


@pytest.mark.slow
def test_it_prices_what_sonar_and_noise_state():
    more = "small.toml,ring_down_db=10,common_noise_db=-60"
    terms = plan("--sonar", more, "--noise", "physical,dropped_beams=0.1")["terms"][len(TERMS) :]
    assert [term["name"] for term in terms] == ["ring-down", "centre streak", "dropped beams"]
    assert all(term["changes"] > 0 for term in terms)


@pytest.mark.slow
def test_it_prices_what_the_options_say():
    """A scene without planar reflectors that matter, smooth faces, bubbles: these terms change nothing."""
    terms = {
        term["name"]: term
        for term in plan("--sonar", "small.toml,bandwidth_hz=2000", "--acoustics", "pulse=on")["terms"]
    }
    with sg.Simulator(sg.load_scene("tank.sdf"), sg.load_sonar("small.toml,bandwidth_hz=2000")) as simulator:
        acoustics = sg.Acoustics.physical(pulse=True)
        wanted = {term.name: term for term in price(simulator, simulator.sonar, 0.05, acoustics=acoustics)}
    assert terms["pulse"]["changes"] == wanted["pulse"].changes > 0.1
    assert [terms[name]["changes"] for name in ("specular lobes", "bubbles")] == [0, 0]


def test_json_holds_what_the_simulator_plans():
    found = plan("--profile", "ideal", "--bins", 40, "--pose", "0 0.2 0 0 0 0.1")
    assert (found["scene"], found["sonar"], found["profile"]) == ("tank", "small", "ideal")
    assert (found["beams"], found["bins"], found["poses"]) == (24, 40, 1)
    assert found["met"] is found["has_echo"] is True
    scene, sonar = sg.load_scene("tank.sdf"), replace(sg.load_sonar("small.toml"), n_bins=40)
    pose = sg.pose(0, 0.2, yaw=0.1)
    for cost, tolerance in ((found, 0.05), (found["halved"], 0.025), (found["doubled"], 0.1)):
        with sg.Simulator(scene, sonar, sg.Acoustics.ideal(), tolerance=tolerance) as simulator:
            wanted = simulator.plan([pose])
        assert cost["tolerance"] == tolerance and cost["level"] == wanted.level
        assert cost["sampling"]["rows"] == wanted.sampling.rows
        assert cost["sampling"]["columns_per_beam"] == wanted.sampling.columns_per_beam
        assert cost["error_estimate"] == wanted.error_estimate <= tolerance
        assert cost["worst_body_estimate"] == wanted.worst_body_estimate <= 5 * tolerance
        assert cost["worst_body"] == ["", "wall", "box"][wanted.worst_body]
        assert cost["time_ms"] > 0
        assert cost["time_ratio"] == cost["time_ms"] / found["time_ms"]


@pytest.mark.slow
def test_a_sequence_takes_the_samples_that_render_gives_it():
    found = plan("--poses", "dive.csv")
    assert found["poses"] == 3
    render = ["render", "tank.sdf", *map(str, QUICK), "--poses", "dive.csv", "--format", "npz"]
    assert command_line.run(*render)[0] == 0
    for number in range(3):
        assert sg.load_npz(f"tank_{number:04d}.npz").meta["sampling"] == found["sampling"]
    with sg.Simulator(sg.load_scene("tank.sdf"), sg.load_sonar("small.toml"), tolerance=0.05) as simulator:
        assert simulator.plan(read_poses("dive.csv")[1]).level == found["level"]
    assert "poses       3\n" in run("tank.sdf", *QUICK, "--poses", "dive.csv")[1]


@pytest.mark.slow
def test_a_flat_wall_asks_for_nothing():
    found = plan(scene="wall.sdf")
    assert (found["level"], found["bound_by"]) == (0, "nothing")


def cost_of(error, body, met=True, level=5):
    """What binds a plan with such estimates, of a tolerance of 0.01."""
    made = Plan(sg.Sampling(2, 10), level, error, body, 1, met, n_samples=480)
    return costs.plan_facts(made, 0.01, sg.load_scene("wall.sdf"))["bound_by"]


def test_the_nearer_of_two_estimates_binds():
    assert cost_of(0.009, 0.04) == "error" and cost_of(0.008, 0.045) == "worst body"
    assert cost_of(0.02, 1.0, met=False) == "worst body" and cost_of(0.3, 1.0, met=False) == "error"
    # a coarser level would have kept both, and was left all the same
    assert cost_of(0.005, 0.02) == "finding"
    assert cost_of(0.005, 0.02, level=0) == "nothing" and cost_of(0.009, 0.02, level=0) == "error"
    assert set(costs.BOUND_BY) == {"error", "worst body", "finding", "nothing"}


def test_one_level_changes_estimates_by_so_much():
    """A plan that keeps the tolerance can gain two levels at most; otherwise it would have moved on."""
    rates = (ERROR_RATE, 2 * BODY_ERROR_RATE)  # hits are as many as the square of the width
    assert min(2 ** (-2 * rate / LEVELS_PER_HALF) for rate in rates) >= costs.TWO_LEVELS
    assert costs.WORST_BODY == reference.WORST_BODY


@pytest.mark.slow
@pytest.mark.parametrize("tolerance, left", [(0.001, "halved"), (0.5, "doubled")])
def test_tolerances_out_of_bounds_are_left_out(tolerance, left):
    status, out, _ = run("wall.sdf", "--sonar", "small.toml", "--tolerance", tolerance)
    assert status == 0
    assert f"\n{left}, it would lie outside 0.1 % to 50 %\n\n" in out
    assert len(table(out)) == 2
    found = plan("--tolerance", tolerance, scene="wall.sdf")
    assert [name for name in ("halved", "doubled") if found[name] is None] == [left]


def test_a_tolerance_out_of_reach_has_status_1(monkeypatch):
    monkeypatch.setattr("sonar_gl.engine.level_search.FINEST_LEVEL", 6)
    status, out, err = run("tank.sdf", "--sonar", "small.toml", "--tolerance", 0.0015)
    assert (status, err) == (1, "")
    assert (
        "tolerance   0.15 % can NOT be met: these are the most samples that fit; go nearer, narrow the fan, "
        "or ask for a larger one\n"
    ) in out
    assert table(out)[0.15][-1] == "no"
    assert plan("--tolerance", 0.0015)["met"] is False  # and status 1


@pytest.mark.slow
def test_an_estimate_that_breaks_a_tolerance_does_not_read_like_it():
    """ "2 % can NOT be met" stood above "error 2 %"."""
    missed = {"met": False, "error_estimate": 0.05004, "worst_body_estimate": 0.2501}
    out = costs.plan_text(plan() | missed)
    assert "tolerance   5 % can NOT be met" in out and "error       5.004 % of the echo" in out
    assert "off by 25.01 %, estimated" in out
    assert table(out)[5][1:3] == ["5.004 %", "25.01 %"]


@pytest.mark.slow
def test_where_half_of_it_is_out_of_reach_the_table_says_so(monkeypatch):
    fine = "--tolerance", 0.004
    monkeypatch.setattr("sonar_gl.engine.level_search.FINEST_LEVEL", plan(*fine)["level"])
    status, out, err = run("tank.sdf", "--sonar", "small.toml", *fine)
    assert (status, err) == (0, "")
    assert next(row[-1] for row in table(out).values()) == "no"
    assert "NOT" not in out


@pytest.mark.parametrize(
    "scene, pose, why",
    [
        ("empty.sdf", "0 0 0 0 0 0", "the scene has no bodies"),
        ("tank.sdf", "0 0 0 0 1.5 0", "no surface lies"),
    ],
)
def test_where_nothing_comes_back_it_says_so(scene, pose, why):
    aside = *QUICK, "--profile", "ideal", "--pose", pose  # side lobes in elevation receive from all around
    status, out, err = run(scene, *aside)
    assert status == 0
    assert "error       none: no echo comes back from this pose\n" in out
    assert "worst body  '" not in out and "bound by" not in out
    assert err.startswith("warning: no echo came back: ") and why in err and err.count("\n") == 1
    found = json.loads(run(scene, *aside, "--json")[1])
    assert (found["has_echo"], found["error_estimate"]) == (False, 0)


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["nowhere.sdf"], "nowhere.sdf: there is no such file (bundled scenes are named without an ending)"),
        (["tank.sdf", "--poses", "none.csv"], "none.csv: the file of poses must be readable"),
        (["tank.sdf", "--bins", 0], "sonar 'small': n_bins must be a whole number in 1..65536 (got 0)"),
        (["tank.sdf", "--tolerance", 0.0001], "tolerance must be a number in 0.001..0.5 (got 0.0001;"),
    ],
)
def test_mistakes_are_told_in_one_sentence(arguments, message):
    status, out, err = run("--sonar", "small.toml", *arguments)
    assert (status, out) == (2, "") and err.startswith(f"error: {message}")


def test_help_says_what_the_exit_status_means():
    out = run("--help")[1]
    assert "Exit status: 0 the tolerance can be met, 1 it cannot, 2 a mistake" in " ".join(out.split())


@pytest.mark.slow
def test_frames_do_not_depend_on_those_before_them():
    """A sequence and the reversed one have the same files; looked after ping by ping they would not."""
    header, *rows = POSES.splitlines()
    # all at one time, which falls in neither sense
    rows = [f"0,{row.partition(',')[2]}" for row in rows] * 2
    files = {}
    for name, lines in (("there", rows), ("back", rows[::-1])):
        Path(f"{name}.csv").write_text("\n".join([header, *lines]))
        # without noise, since each frame has random numbers of its own
        more = f"--height 60 --noise none --poses {name}.csv --out {name}".split()
        assert command_line.run("render", "tank.sdf", *map(str, QUICK), *more)[0] == 0
        files[name] = [
            [Path(name, f"tank_{n:04d}.{f}").read_bytes() for f in ("png", "npz")] for n in range(6)
        ]
    assert files["there"] == files["back"][::-1]
    assert len({png for png, _ in files["there"]}) == 3
    scene, sonar = sg.load_scene("tank.sdf"), sg.load_sonar("small.toml")
    looked_after = {}
    for name in files:
        with sg.Simulator(scene, sonar, tolerance=0.05) as simulator:
            looked_after[name] = [simulator.ping(p).intensity.tobytes() for p in read_poses(f"{name}.csv")[1]]
    assert looked_after["there"] != looked_after["back"][::-1]


@pytest.mark.slow
@pytest.mark.parametrize(
    "options, planned",
    [([], True), (["--style", "demarco2015"], True), (["--style", "demarco2015", "--format", "png"], False)],
)
def test_only_the_papers_picture_alone_is_not_planned(monkeypatch, options, planned):
    """It is made of points, of which there are as many as the paper says."""
    asked = []
    monkeypatch.setattr(sg.Simulator, "plan", lambda _, poses: asked.append(len(poses)))
    render = ["render", "tank.sdf", *map(str, QUICK), "--height", "40", "--poses", "dive.csv", *options]
    assert command_line.run(*render)[0] == 0
    assert asked == ([3] if planned else [])
