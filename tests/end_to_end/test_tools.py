"""Every tool runs, and its figures agree with one another and with the pages of docs/."""

import csv
import json
import os
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh

import sonar_gl as sg
from sonar_gl.analysis.terms import TERMS
from tests.support import browser
from tools import drivers, internals
from tools.bench import harness
from tools.bench.harness import Aim, Contender
from tools.chart.front import by_scene
from tools.docs.ablation import keep_rows
from tools.docs.pages import fill_printed, put_table
from tools.mutations import MUTATIONS

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """An empty working directory."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


def run(module, *words):
    """Run a tool in a process of its own; return what it printed."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-m", module, *words]
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def bench(*words):
    """Run a bench; return its figures, and what it printed."""
    printed = run("tools.bench", *words, "--json", "found.json")
    return json.loads(Path("found.json").read_text()), printed


def test_contenders_take_turns_and_slow_ones_skip_rounds():
    calls = []

    def noted(name):
        return lambda number: calls.append((name, number))

    contenders = {"a": noted("a"), "b": Contender(noted("b"), before=noted("before b"), every=2)}
    times = harness.take_turns(contenders, rounds=2, warm_up=1)
    assert calls == [
        ("a", 0),
        ("before b", 0),
        ("b", 0),
        ("a", 1),
        ("a", 2),
        ("before b", 2),
        ("b", 2),
    ]
    assert (len(times["a"]), len(times["b"])) == (2, 1)
    assert all((ms >= 0).all() for ms in times.values())


def test_ratios_are_those_of_rounds():
    assert harness.ratio([2.0, 30.0, 4.0], [1.0, 10.0, 4.0]) == 2.0


def test_aims_are_bounds_from_either_side():
    assert Aim("rate", 1.5, "times", 1.5, at_least=True).met
    assert not Aim("rate", 1.4, "times", 1.5, at_least=True).met
    assert Aim("time", 1.4, "ms", 1.5).met
    assert not Aim("time", 1.6, "ms", 1.5).met


def test_tables_are_aligned(capsys):
    harness.print_table([{"name": "a", "ms": "1.50"}, {"name": "longer", "ms": "10.25"}])
    assert capsys.readouterr().out.splitlines() == ["  name       ms", "  a        1.50", "  longer  10.25"]
    assert harness.markdown([{"name": "a", "ms": 1}]) == "| name | ms |\n|---|---|\n| a | 1 |"


PAGE = """Before.

```sh
python -m tools.bench {word}
```

```text
of yesterday
```

After.
"""


def test_the_output_of_a_command_replaces_that_of_before(tmp_path, monkeypatch):
    """The page has two commands; only the one with the word runs, and the rest of the page stays."""
    page = tmp_path / "page.md"
    page.write_text(PAGE.format(word="one") + PAGE.format(word="two"))
    ran = []

    def run(command, **_):
        ran.append(command)
        return subprocess.CompletedProcess(command, 1, "of today\n")  # 1: an aim was missed

    monkeypatch.setattr(subprocess, "run", run)
    fill_printed(page, only="two")

    assert ran == [[sys.executable, "-m", "tools.bench", "two"]]
    assert page.read_text() == PAGE.format(word="one") + PAGE.format(word="two").replace("yesterday", "today")


def test_a_page_is_kept_where_its_command_fails(tmp_path, monkeypatch):
    page = tmp_path / "page.md"
    page.write_text(PAGE.format(word="one"))
    monkeypatch.setattr(subprocess, "run", lambda command, **_: subprocess.CompletedProcess(command, 2, ""))
    with pytest.raises(SystemExit, match=r"must end with status 0 or 1 \(got 2\)"):
        fill_printed(page)
    with pytest.raises(SystemExit, match=r"must have a command with its output below it"):
        fill_printed(page, only="three")
    assert page.read_text() == PAGE.format(word="one")


def test_each_stage_of_a_ping_takes_a_part_of_its_time():
    ball = sg.Scene([sg.Body("ball", trimesh.creation.icosphere(2, 0.5), sg.pose(4))])
    with sg.Simulator(ball, sg.load_sonar("p900-45"), sampling=sg.Sampling(1, 40)) as simulator:
        simulator.ping(sg.pose())
        clock, start = internals.StageClock(simulator), time.perf_counter()
        simulator.ping(sg.pose())
        took_ms, stages_ms = 1e3 * (time.perf_counter() - start), clock.lap_ms()
    assert len(stages_ms) == len(internals.STAGES) and min(stages_ms) > 0 and sum(stages_ms) < took_ms


def test_a_table_replaces_that_between_its_marks(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("<!-- table a -->\nold\n<!-- end -->\n<!-- table b -->\nold\n<!-- end -->\n")
    put_table(page, "b", r"new \1")
    assert page.read_text() == (
        "<!-- table a -->\nold\n<!-- end -->\n<!-- table b -->\nnew \\1\n<!-- end -->\n"
    )
    with pytest.raises(SystemExit, match=r"must have the line '<!-- table c -->'"):
        put_table(page, "c", "new")


def test_a_term_gets_its_row_and_the_others_keep_theirs():
    head = "| without | cost, ms |\n|---|---|\n"
    standing = f"of then\n\n{head}| a | 1.0 |\n| of old | 4.0 |\n| b-c | 2.0 |"
    found = f"of now\n\n{head}| a | 1.5 |\n| new | - |\n| b-c | 2.5 |"
    assert keep_rows(found, standing, {"a", "new"}) == (
        f"of then\n\n{head}| a | 1.5 |\n| new | - |\n| b-c | 2.0 |"
    )


def test_a_scene_is_a_row_with_both_widths_of_beams():
    """A scene on which ours never errs as much as 1 % has no time at that error, and no row."""
    times = [
        {"scene": scene, "beams": beams, "method": method, "ms_at_0.01": ms, "ratio_at_0.01": ratio}
        for scene, beams, method, ms, ratio in (
            ("pylon", "wide", "ours", "1.25", "1"),
            ("pylon", "narrow", "ours", "1.16", "1"),
            ("pylon", "wide", "rays_jittered", ">20.21", ">16.17"),
            ("grazing", "wide", "ours", "<1", "?1"),
            ("grazing", "narrow", "ours", "<0.7", "?1"),
        )
    ]
    (row,) = by_scene(times, 0.01)
    assert row["at 1 %"] == "`pylon`"
    assert row["ours, ms"] == "1.2 / 1.2"
    assert row["rays, jittered"] == ">16 / -"
    assert row["tubes"] == "- / -"


def test_unknown_benches_are_refused():
    done = subprocess.run(
        [sys.executable, "-m", "tools.bench", "speed"],
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )
    assert done.returncode == 1
    assert done.stderr.startswith("there is no bench 'speed' (known are ping, frame, ")


@pytest.mark.slow
def test_bench_ping():
    found, printed = bench("--scene", "pylon", "--rounds", "2", "--rays", "1000000")
    (scene,) = found["scenes"]
    footprint, point = (scene["samplings"][name]["error"] for name in ("2 x 64", "2 x 64, point"))
    # so few rays allow no stronger statement
    assert 0 < footprint < point
    assert f"{footprint:.2%}" in printed


@pytest.mark.slow
def test_bench_frame():
    found, _ = bench("frame", "--quick")
    assert len(found["frames"]) == 2  # sonars
    for ms in found["frames"].values():
        # medians of two rounds are means, so that the parts of a frame add up
        added = ms["noise"] + ms["fan image"] + ms["Jet"] + ms["physical over ideal"]
        assert ms["frame over bare ping"] == pytest.approx(added)
        assert min(ms["ping, ideal"], ms["rays by packets"], ms["rays by embreex"]) > 0


@pytest.mark.slow
def test_bench_paper():
    found, printed = bench("paper", "--quick", "--scene", "pylon")
    assert all(mean > 0 for mean, _ in found["rates_hz"]["pylon"].values())
    assert re.search(r"^  pylon +3\.1 ", printed, re.MULTILINE)


@pytest.mark.slow
def test_bench_start():
    found, _ = bench("start", "--quick", "--only", "import sonar_gl")
    assert found["processes"]["import sonar_gl"]["peak_mb"] > 5  # the interpreter alone takes more


@pytest.mark.slow
def test_bench_scaling():
    found, printed = bench("scaling", "--quick", "--large", "--out", "scaled")
    with open("scaled/scaling.csv", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    axes = {row["axis"] for row in rows}
    assert axes == {"triangles", "beams", "bins", "field of view, degrees", "bodies", "tolerance"}
    assert all(float(row["ms_median"]) > 0 for row in rows)
    same = {
        row["at"]: row["samples"] for row in rows if row["line"] == "same samples" and "field" in row["axis"]
    }
    columns = {at: int(samples.split()[0]) for at, samples in same.items()}
    # eight times the fan; the beam pattern beyond its ends counts more for the narrow one, and the floor ends
    assert 6 < columns["360"] / columns["45"] < 8.5
    assert Path("scaled/pictures/scaling.png").stat().st_size > 10_000
    assert found["large"]["triangles"] >= 200_000
    assert found["large"]["peak_mb"] > 100
    check_aims(found["aims"], printed, 5)


@pytest.mark.slow
def test_bench_changes():
    found, printed = bench("changes", "--quick")
    check_aims(found["aims"], printed, 9)


def check_aims(aims, printed, least):
    """Every aim is printed, with the verdict that its figure calls for."""
    assert len(aims) >= least
    for aim in aims:
        apart = (aim["measured"] - aim["limit"]) * (1 if aim["at_least"] else -1)
        assert aim["met"] == (apart >= 0)
        (line,) = (line for line in printed.splitlines() if line.startswith(f"  {aim['name']} "))
        assert line.endswith("met" if aim["met"] else "missed")


@pytest.mark.slow
def test_bench_view():
    if not any(map(shutil.which, browser.NAMES)):
        pytest.skip("there is no Chromium (apt-get install chromium brings it in)")
    found, printed = bench("view", "--quick", "--only", "pylon")
    check_aims(found["aims"], printed, 1)
    assert 0 < found["scenes"]["pylon"]["pictures, /s"] <= 1.2 * found["scenes"]["pylon"]["pings, /s"]


@pytest.mark.slow
def test_bench_embed():
    found, _ = bench("embed", "--only", "pylon", "--quick")
    errors = {(row["mode"][0], row["samples"]): row["error"] for row in found["modes"]["pylon"]}
    for samples in ("0.5 x 24", "1 x 48"):  # the modes in which a host draws as the simulator does
        assert errors["s", samples] == errors["1", samples]
        assert errors["s", samples] == pytest.approx(errors["2", samples], rel=1e-3)  # its own vertex shader
    for mode in "34":  # finer images err less
        assert 0 < errors[mode, "126 x 60"] < 0.7 * errors[mode, "66 x 32"]


@pytest.mark.slow
def test_bench_host():
    found, _ = bench("host", "egl_host")
    assert [row["mode"] for row in found["modes"]] == ["1", "2"]
    assert all(row[name] > 0 for row in found["modes"] for name in ("ms", "standalone_ms", "ratio"))


@pytest.mark.slow
def test_bench_batch():
    found, _ = bench("batch", "--quick", "rate", "writing", "flushes", "plan", "long", "--pings", "12")
    rate, writing, plan = found["rate"], found["writing"], found["plan"]
    for pair in ("b / a", "c / a", "c / b"):  # of one round
        assert rate[pair] == pytest.approx(rate[pair[0]] / rate[pair[-1]])
    stages = [busy_s for stage, (_, busy_s) in writing.items() if stage != "all"]
    assert len(stages) == 5
    assert 0 < sum(stages) < writing["all"][1]
    assert found["flushes"]["ms a part"] > 0 and found["flushes"]["ratio"] > 0
    hours = {row["workers"]: row["hours"] for row in plan["workers"]}
    assert hours[1] == pytest.approx(1e7 / (rate["c"] / 2) / 3600)
    assert hours[1] == pytest.approx(10 * hours[10])
    assert found["long"]["pings"] == 12
    # a whole batch has some files once, and few pings to share them
    assert found["long"]["mb"] * 1e3 / 12 == pytest.approx(rate["kB a ping"], rel=1.0)


@pytest.mark.slow
@pytest.mark.parametrize("how", [["--worlds"], ["--alone", "--worlds"], ["--lone"]])
def test_promise(how):
    printed = run("tools.promise", "--first", "1001", *how, "1")
    rows = re.findall(r"^([\d.]+) +1 +([01]) +([01]) +([01]) ", printed, re.MULTILINE)
    assert [float(tolerance) for tolerance, *_ in rows] == [0.05, 0.02, 0.01]
    # one world is no evidence for 95 of 100, but of this one the outcome is known
    assert all(kept == met == "1" for _, kept, met, _ in rows)
    assert ("all pings alone over all planned pings" in printed) == ("--alone" in how)


BOX = "<link name='l'><collision name='c'><geometry><box/></geometry></collision></link>"
WORLD = "<sdf version='1.9'><world name='w'>{}</world></sdf>"


@pytest.mark.slow
def test_worlds(folder):
    """Two checkouts: one has a model that a world of the other includes; a model is nowhere, and a file is broken."""
    for name, text in {
        "a/fine.sdf": WORLD.format(f"<model name='m'>{BOX}</model>"),
        "a/other.world": WORLD.format("<include><uri>model://crate</uri></include>"),
        "a/nowhere.sdf": WORLD.format(
            f"<include><uri>model://gone</uri></include><model name='m'>{BOX}</model>"
        ),
        "a/broken.sdf": WORLD.format("<model name=></model>"),
        "b/models/crate/model.config": "<model><sdf version='1.9'>model.sdf</sdf></model>",
        "b/models/crate/model.sdf": f"<sdf version='1.9'><model name='crate'>{BOX}</model></sdf>",
    }.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    printed = run("tools.worlds", "a", "b", "--ping", "--refused", "refused.txt")
    rows = [line.strip("| ").split(" | ") for line in printed.splitlines() if line.startswith("|")]
    # files, as they are, with paths, with --skip-missing, refused, crashes
    assert [row[0] for row in rows[2:]] == ["a", "b", "all"]
    assert [row[1:] for row in rows[2:]] == [
        ["4", "1", "2", "3", "1", "0"],
        ["1", "1", "1", "1", "0", "0"],
        ["5", "2", "3", "4", "1", "0"],
    ]
    assert "- 2: models or files are missing" in printed and "- 1: broken XML" in printed
    assert "broken.sdf" in Path("refused.txt").read_text()


@pytest.mark.slow
def test_each_mutation_applies_once_and_has_tests():
    """Those that are no Python are refused, since any test would notice them."""
    printed = run("tools.mutations", "--list")
    assert len(printed.splitlines()) == len(MUTATIONS)


@pytest.mark.slow
def test_a_mutation_that_is_run_names_the_test_that_notices_it():
    printed = run("tools.mutations", "--run", "--only", "warn/control characters")
    assert re.search(r"killed by tests/core/test_warn\.py::test_\w+$", printed, re.MULTILINE)
    assert printed.endswith("killed 1 of 1, 100%\n")


@pytest.mark.slow
def test_failures():
    printed = run("tools.docs.failures", "--soak", "50")
    assert printed.startswith("50 pings, ")
    before, after = re.findall(r"^GL objects (?:before|after) +(.+)$", printed, re.MULTILINE)
    assert before == after


@pytest.mark.slow
def test_gallery():
    run("tools.docs.gallery", "diver_vertical", "--out", "pictures")
    published = (ROOT / "docs" / "pictures").glob("diver_vertical*")
    assert {path.name for path in Path("pictures").iterdir()} == {path.name for path in published}


@pytest.mark.slow
def test_ablation():
    """The table of the pylon is that of the page, but for times."""
    Path("docs", "pictures").mkdir(parents=True)
    Path("docs", "ablation.md").write_text("<!-- table pylon -->\nold\n<!-- end -->\n")
    run("tools.docs.ablation", "pylon", "--docs", "docs")
    (picture,) = Path("docs", "pictures").iterdir()
    assert picture.name == "ablation_pylon.png"
    made = Path("docs", "ablation.md").read_text()
    assert "old" not in made
    published = (ROOT / "docs" / "ablation.md").read_text(encoding="utf-8")
    rows, page = (
        re.findall(r"^\| ([\w -]+) \| ([\d.e-]+) % \|", text, re.MULTILINE) for text in (made, published)
    )
    assert [name for name, _ in rows] == [term.name for term in TERMS]
    np.testing.assert_allclose(
        [float(share) for _, share in rows],
        [float(share) for _, share in page[: len(TERMS)]],
        rtol=0.1,
        atol=0.01,
    )


@pytest.mark.slow
def test_ablation_of_terms_without_rows():
    """One that changes nothing gets its row alone; one that acts changes what everything on is, and so all rows."""
    published = (ROOT / "docs" / "ablation.md").read_text(encoding="utf-8")
    Path("docs", "pictures").mkdir(parents=True)
    page = Path("docs", "ablation.md")
    page.write_text(re.sub(r"^\| multipath \|.*\n", "", published, flags=re.MULTILINE), encoding="utf-8")
    run("tools.docs.ablation", "pylon", "tank", "--only", "bubbles", "--docs", "docs")
    tables = [
        dict(re.findall(r"<!-- table (\w+) -->\n(.*?)\n<!-- end -->", text, re.DOTALL))
        for text in (page.read_text(encoding="utf-8"), published)
    ]
    assert tables[0]["pylon"] == tables[1]["pylon"]
    assert re.search(r"^\| multipath \| 16 % ", tables[0]["tank"], re.MULTILINE)
    assert [path.name for path in Path("docs", "pictures").iterdir()] == ["ablation_tank.png"]


@pytest.mark.slow
def test_cost_of_a_device():
    """The chart's page has a place for the table; a device takes more time than profile ideal."""
    page = (ROOT / "docs" / "chart.md").read_text(encoding="utf-8")
    assert len(re.findall("<!-- table device -->\n.*?\n<!-- end -->", page, re.DOTALL)) == 1
    Path("docs").mkdir()
    Path("docs", "chart.md").write_text("<!-- table device -->\nold\n<!-- end -->\n")
    run("tools.chart", "--device", "--only", "pylon", "--rounds", "5", "--out", "docs")
    made = Path("docs", "chart.md").read_text()
    row = re.search(
        r"^\| `pylon` \| ([\d.]+) \| ([\d.]+) \| ([\d.]+) \| ([\d.]+)%, ([\d.]+)% \|$", made, re.MULTILINE
    )
    _, device, whole, *errors = map(float, row.groups())
    assert 1 < device < whole and max(errors) <= 1.0


@pytest.mark.slow
def test_estimates_of_what_is_not_modelled():
    """They do not depend on the machine's speed; other drivers draw the same samples."""
    printed = run("tools.docs.unmodelled")
    lines = printed.strip().splitlines()
    assert lines
    for line in lines:
        assert line in (ROOT / "docs" / "method.md").read_text(encoding="utf-8")


@pytest.mark.slow
def test_cost_of_multipath():
    printed = run("tools.docs.ablation", "tank", "--cost")
    assert re.match(
        r"tank +[1-9]\d* planar reflectors, [1-9] simulated; a ping +[\d.]+ ms, "
        r"multipath +[\d.-]+ of it, [\d.-]+ per reflector",
        printed,
    )


@pytest.mark.slow
def test_generated_scenes_are_those_in_the_repository():
    run("tools.docs.make_scenes", "--out", "scenes")
    made = sorted(Path("scenes").iterdir())
    assert [path.name for path in made if path.suffix == ".png"] == ["ocean_floor.png"]
    assert len(made) == 6
    for path in made:
        published = ROOT / "scenes" / path.name
        if path.suffix == ".png":  # OpenCV's versions pack alike pixels differently
            here, there = (cv2.imread(str(one), cv2.IMREAD_UNCHANGED) for one in (path, published))
            np.testing.assert_array_equal(here, there)
        else:
            assert path.read_text(encoding="utf-8") == published.read_text(encoding="utf-8")


def pictures_of(echo, bodies):
    return drivers.Pictures({}, {"a, echo": np.float32(echo), "a, bodies": np.uint16(bodies)})


def test_differences_of_drivers_are_shares():
    reference = pictures_of([[4.0, 0.0, 4.0]], [[1, 0, 2]])
    assert drivers.differences(reference, reference) == (0, 0)
    assert drivers.differences(pictures_of([[4.0, 1.0, 4.0]], [[1, 1, 2]]), reference) == (1 / 8, 0)
    assert drivers.differences(pictures_of([[4.0, 0.0, 4.0]], [[1, 0, 1]]), reference) == (0, 1 / 2)


@pytest.mark.parametrize(
    "missing, user, why",
    [("debootstrap", 0, "needs debootstrap: apt-get install debootstrap"), ("none", 1000, "needs root")],
)
def test_a_driver_that_cannot_be_had_says_why(missing, user, why, folder, monkeypatch):
    monkeypatch.setattr(drivers.shutil, "which", lambda name: None if name == missing else f"/bin/{name}")
    monkeypatch.setattr(drivers.os, "geteuid", lambda: user)
    assert drivers.install_debian(folder / "debian").startswith(why)
    (folder / "debian/usr/share/vulkan/icd.d").mkdir(parents=True)
    (folder / "debian/usr/share/vulkan/icd.d/lvp_icd.json").touch()
    assert drivers.install_debian(folder / "debian") == ""  # it is there already


@pytest.mark.slow
def test_drivers_draw_the_same_pictures():
    """The engine cpu draws its own pictures, and OpenGL 3.3, body by body, those of the same driver."""
    printed = run("tools.drivers", "--no-tests", "llvmpipe", "OpenGL 3.3", "none").splitlines()
    by_calls, one_by_one, own = ([cell.strip() for cell in line.split("|")] for line in printed[2:5])
    assert one_by_one[1] == "OpenGL 3.3" and one_by_one[3:6] == by_calls[3:6]
    assert own[1] == "none" and own[3:6] == ["ok", "0.0e+00", "0.0e+00"]


def test_an_unknown_driver_is_an_error(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["drivers", "glide"])
    with pytest.raises(SystemExit) as end:
        drivers.main()
    assert end.value.code == 2 and "drivers must be of card, llvmpipe, softpipe" in capsys.readouterr().err
