"""The documentation: its examples run, its commands and options exist, its links lead somewhere."""

import csv
import dataclasses
import importlib
import json
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

import sonar_gl as sg
from sonar_gl import cli, costs, terms
from sonar_gl.batch.job import Job, read_job
from sonar_gl.batch.orders import Orders
from sonar_gl.batch.paths import KINDS
from sonar_gl.switches import TERMS

ROOT = Path(__file__).resolve().parent.parent
PAGES = [ROOT / "README.md", ROOT / "CHANGELOG.md", *sorted((ROOT / "docs").glob("*.md"))]
MAX_PICTURE_BYTES = 120_000
BATCHES = ROOT / "docs" / "batch.md"  # whose blocks build on one another
POSES_FILE = "dive.csv"  # what README calls the file of its ```csv block


def text_of(page):
    return page.read_text(encoding="utf-8")


def blocks(language, pages=None):
    """Every fenced block of a language, with its page and line; not of the page of batches, unless named."""
    for page in pages or [page for page in PAGES if page != BATCHES]:
        for match in re.finditer(rf"^```{language}\n(.*?)^```", text_of(page), re.DOTALL | re.MULTILINE):
            line = text_of(page)[: match.start()].count("\n") + 1
            yield pytest.param(match[1], id=f"{page.name}:{line}")


def shell_lines():
    """Every line of the pages' shell blocks, without its comment."""
    for block in [*blocks("sh"), *blocks("sh", [BATCHES])]:
        for line in block.values[0].splitlines():
            if words := shlex.split(line, comments=True):
                yield pytest.param(words, id=" ".join(words))


def commands():
    return [p for p in shell_lines() if p.values[0][0] == "sonar-gl" and p.values[0][1] != "batch"]


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """An empty working directory, but for the poses that README shows."""
    monkeypatch.chdir(tmp_path)
    for block in blocks("csv"):
        Path(POSES_FILE).write_text(block.values[0])
    return tmp_path


def run(*words):
    return CliRunner().invoke(cli.main, list(words))


def test_there_is_something_to_check():
    assert all(page.is_file() for page in PAGES)
    assert {page.name for page in PAGES} >= {"README.md", "gallery.md", "method.md", "conventions.md"}
    assert all(len(list(blocks(language))) > 0 for language in ("python", "sh", "xml", "toml", "csv"))
    assert len(commands()) > 5


@pytest.mark.filterwarnings("error::UserWarning")
@pytest.mark.parametrize("code", list(blocks("python")))
def test_python_examples_run(code):
    exec(compile(code, "example", "exec"), {"__name__": "__main__"})


@pytest.mark.parametrize("words", commands())
def test_commands_run(words, folder, monkeypatch):
    for module in (costs, terms):  # what `plan` tells of times need not be exact
        monkeypatch.setattr(module, "TURNS", 1)
    before = set(folder.rglob("*"))
    result = run(*words[1:])
    assert result.exit_code == 0, result.output
    assert "warning" not in result.output
    if words[1] == "render":
        assert {path for path in folder.rglob("*") if path.is_file()} - before


def test_the_python_example_and_the_command_of_the_first_screen_make_the_same_picture(folder):
    command = next(p.values[0] for p in commands())
    assert run(*command[1:], "--out", "command").exit_code == 0
    exec(next(blocks("python")).values[0], {})
    assert Path("pylon.png").read_bytes() == Path("command", "pylon.png").read_bytes()


@pytest.mark.parametrize("words", [p for p in shell_lines() if p.values[0][0] != "sonar-gl"])
def test_other_commands_name_files_that_exist(words):
    paths = [w for w in words[1:] if w.startswith("tools/")]
    assert all((ROOT / path).is_file() for path in paths)
    for path in paths:
        if path.endswith(".py"):
            options = re.findall(r'add_argument\(\s*"(--[a-z-]+)"', (ROOT / path).read_text(encoding="utf-8"))
            assert {w for w in words if w.startswith("--")} <= set(options)


@pytest.mark.parametrize(
    "words",
    [
        ["bench.py", "--scene", "pylon", "--repeats", "2", "--rays", "1000000", "--json", "bench.json"],
        ["gallery.py", "diver_vertical", "--out", "pictures"],
        ["promise.py", "--worlds", "1", "--first", "1001"],
        ["failures.py", "--soak", "50"],
        ["bench_frame.py", "--repeats", "2"],
        ["ablation.py", "pylon", "--docs", "docs"],
        ["bench_paper.py", "--scene", "pylon", "--repeats", "2"],
        ["bench_start.py", "--only", "import sonar_gl", "--runs", "1"],
        ["bench_scaling.py", "--quick", "--out", "scaled"],
        ["bench_embed.py", "--only", "pylon", "--quick"],
        ["bench_host.py", "egl_host", "pictures"],
        ["bench_batch.py", "--quick"],
    ],
    ids=lambda words: words[0],
)
def test_tools_run(words, folder):
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    if words[0] == "ablation.py":
        Path("docs", "pictures").mkdir(parents=True)
        Path("docs", "ablation.md").write_text("<!-- table pylon -->\nold\n<!-- end -->\n")
    command = [sys.executable, str(ROOT / "tools" / words[0]), *words[1:]]
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stdout + done.stderr
    if words[0] == "bench.py":
        (scene,) = json.loads(Path("bench.json").read_text())["scenes"]
        footprint, point = (scene["ladder"][name]["error"] for name in ("2 x 64", "2 x 64, point"))
        # so few rays tell no more than this
        assert 0 < footprint < point
    elif words[0] == "promise.py":
        told = re.findall(r"^ +([\d.]+) +1 +([01]) +([01]) +([01]) ", done.stdout, re.MULTILINE)
        assert [float(tolerance) for tolerance, *_ in told] == [0.05, 0.02, 0.01]
        # one world says nothing of 95 in 100, but of this one it is known
        assert all(kept == met == "1" for _, kept, met, _ in told)
    elif words[0] == "failures.py":
        assert done.stdout.startswith("50 pings, ")
        before, after = re.findall(r"^GL objects (?:before|after) +(.+)$", done.stdout, re.MULTILINE)
        assert before == after
    elif words[0] == "bench_frame.py":
        found = re.findall(r"^  (.+?) +(-?[\d.]+)(?: ms)?$", done.stdout, re.MULTILINE)
        for first in (0, len(found) // 2):  # two sonars
            ms = {stage: float(value) for stage, value in found[first : first + len(found) // 2]}
            # two rounds: their medians are means, and of these what a frame adds is the sum, but for rounding
            added = ms["noise"] + ms["fan image"] + ms["Jet"] + ms["physical over ideal"]
            assert abs(ms["frame over bare ping"] - added) < 0.03
            assert min(ms["ping, ideal"], ms["rays by packets"], ms["rays by embreex"]) > 0
    elif words[0] == "ablation.py":
        (picture,) = Path("docs", "pictures").iterdir()
        assert picture.name == "ablation_pylon.png"
        made = Path("docs", "ablation.md").read_text()
        rows = re.findall(r"^\| ([\w ]+) \| ([\d.e-]+) % \|", made, re.MULTILINE)
        assert [name for name, _ in rows] == [term.name for term in TERMS] and "old" not in made
        # which says what the page says, but for times
        page = re.findall(
            r"^\| ([\w ]+) \| ([\d.e-]+) % \|", text_of(ROOT / "docs" / "ablation.md"), re.MULTILINE
        )
        same = dict(page[: len(TERMS)])
        for name, share in rows:
            assert float(share) == pytest.approx(float(same[name]), rel=0.1, abs=0.01)
    elif words[0] == "bench_paper.py":
        paper, ours, physical = re.search(
            r"^pylon +([\d.]+) +([\d.]+) \(.+?\) +([\d.]+) ", done.stdout, re.M
        ).groups()
        assert paper == "3.1"
        assert float(ours) > 0 and float(physical) > 0
    elif words[0] == "bench_start.py":
        (row,) = re.findall(
            r"^import sonar_gl +([\d.]+) +<= 0\.3 +([\d.]+) +(\d+)", done.stdout, re.MULTILINE
        )
        assert float(row[2]) > 5  # MB; the interpreter alone holds more
    elif words[0] == "bench_scaling.py":
        check_scaling(done.stdout, Path("scaled"))
    elif words[0] == "bench_embed.py":
        rows = [line.strip("| ").split(" | ") for line in done.stdout.splitlines() if "%" in line]
        errors = {(row[0][0], row[1]): row[-1] for row in rows}
        for rung in ("0.5 x 24", "1 x 48"):  # the doors where a host draws as we do
            assert errors["s", rung] == errors["1", rung] == errors["2", rung]
        for door in "34":  # finer images err less
            coarse, fine = (float(errors[door, size].strip(" %")) for size in ("66 x 32", "126 x 60"))
            assert 0 < fine < 0.7 * coarse
    elif words[0] == "bench_host.py":
        told = re.findall(r"^door (\d)((?: [\d.]+){3})$", done.stdout, re.MULTILINE)
        assert [door for door, _ in told] == ["1", "2"]
        assert all(float(value) > 0 for _, numbers in told for value in numbers.split())
    elif words[0] == "bench_batch.py":
        check_batches(done.stdout)
    else:
        made, kept = Path("pictures"), ROOT / "docs" / "pictures"
        assert {path.name for path in made.iterdir()} == {path.name for path in kept.glob("diver_vertical*")}


def check_batches(said):
    """What the tool tells agrees with itself, and with what stores are known to do."""
    told = dict(re.findall(r"^  ([a-z].*?)  +([\d.]+)", said, re.MULTILINE))
    told = {name: float(value) for name, value in told.items()}
    rates = {name[0]: value for name, value in told.items() if re.match(r"[abc] (one|batch)", name)}
    for ratio in ("b / a", "c / a", "c / b"):  # of one round; rates are told to 0.1
        assert told[ratio] == pytest.approx(rates[ratio[0]] / rates[ratio[-1]], rel=0.05)
    stages = re.findall(r"^  ([a-z ]+?) +([\d.]+) +([\d.]+)$", said, re.MULTILINE)
    *parts, whole = [float(busy) for _, _, busy in stages[-6:]]
    assert stages[-1][0] == "all" and 0 < sum(parts) < whole
    assert told["share, busy"] == pytest.approx(sum(parts) / whole, abs=0.01)
    stores = re.findall(
        r"^  (Zarr|HDF5)(.*?)  +(\d+ bits|exact|float16) +([\d.]+) +([\d.]+)", said, re.MULTILINE
    )
    sizes = {(kind + way, kept): float(size) for kind, way, kept, _, size in stores}
    shards = {kept: size for (way, kept), size in sizes.items() if way == "Zarr shards, as a batch"}
    assert shards["5 bits"] < 0.8 * shards["exact"]
    assert shards["5 bits"] == pytest.approx(told["kB a ping"], rel=0.2)  # a batch writes a few records more
    hours = [float(h) for h in re.findall(r"workers? +([\d.]+) hours", said)]
    assert hours[0] == pytest.approx(1e7 / (rates["c"] / 2) / 3600, rel=0.01)
    assert hours[0] == pytest.approx(10 * hours[2], rel=0.02)


def check_scaling(said, folder):
    """Every axis was charted, and every aim was told rightly."""
    with open(folder / "scaling.csv", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    axes = {row["axis"] for row in rows}
    assert axes == {
        "triangles",
        "beams",
        "bins",
        "field of view, degrees",
        "bodies",
        "tolerance",
        "one triangle",
    }
    assert all(float(row["ms_median"]) > 0 for row in rows)
    wide = {
        row["at"]: row["samples"] for row in rows if row["line"] == "same samples" and "field" in row["axis"]
    }
    columns = {at: int(samples.split()[0]) for at, samples in wide.items()}
    # eight times the fan; of the narrow one a beam's reach on both sides counts more, the floor has an end
    assert 6 < columns["360"] / columns["45"] < 8.5
    assert (folder / "pictures" / "scaling.png").stat().st_size > 10_000
    aims = re.findall(r" (-?[\d.e+-]+) (?:times|ms   ) +([<>]=) ([\d.]+)  (met|missed)$", said, re.MULTILINE)
    assert len(aims) >= 14
    for measured, sign, aim, told in aims:
        apart = (float(measured) - float(aim)) * (1 if sign == ">=" else -1)
        assert apart == 0 or told == ("met" if apart > 0 else "missed")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)]+)\)", text_of(page)):
        if not target.startswith("https://"):
            assert (page.parent / target).exists(), target


def test_pictures_are_shown_small_and_made_by_the_tools():
    shown = {
        (page.parent / target).resolve()
        for page in PAGES
        for target in re.findall(r"!\[[^\]]+\]\(([^)]+)\)", text_of(page))
    }
    kept = set((ROOT / "docs" / "pictures").iterdir())
    assert shown == kept
    assert max(path.stat().st_size for path in kept) <= MAX_PICTURE_BYTES
    gallery = (ROOT / "tools" / "gallery.py").read_text(encoding="utf-8")
    pairs = re.findall(r'"(\w+)": Pair\(.*?("without", "with")?\)', gallery)
    scenes = (ROOT / "tools" / "chart_scenes.py").read_text(encoding="utf-8")
    charted = re.search(r"^SCENES = \((.*)\)", scenes, re.MULTILINE)[1]
    tool = (ROOT / "tools" / "ablation.py").read_text(encoding="utf-8")
    ablated = re.search(r"^SCENES = \{(.*?)\}", tool, re.MULTILINE | re.DOTALL)[1]
    hosts = (ROOT / "tools" / "bench_embed.py").read_text(encoding="utf-8")
    hosts = re.search(r"^SHOWN = (.*?)  #", hosts, re.MULTILINE)[1]
    assert {path.stem for path in kept} == {
        *(
            f"{name}_{style}"
            for name, terms in pairs
            for style in (("without", "with") if terms else ("demarco2015", "physical"))
        ),
        *(f"chart_{name}" for name in [*re.findall(r'"(\w+)"', charted), "shimmer", "embedding"]),
        *(f"embedding_{name}" for name in re.findall(r'"(\w+)"', hosts)),
        *(f"ablation_{name}" for name in re.findall(r'"(\w+)": [\d.]+', ablated)),
        "scaling",
    }


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_options_exist(page):
    known = {"--help", "--version"}
    for command in cli.main.commands.values():
        known |= {option for parameter in command.params for option in parameter.opts}
    outside_blocks = re.sub(r"^```.*?^```", "", text_of(page), flags=re.DOTALL | re.MULTILINE)
    assert set(re.findall(r"(?<![\w-])--[a-z][a-z-]+", outside_blocks)) <= known


def test_every_command_is_told_in_the_readme():
    told = set(re.findall(r"^\| `sonar-gl (\w+)", text_of(ROOT / "README.md"), re.MULTILINE))
    assert told == set(cli.main.commands)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_names_of_the_package_exist(page):
    for module, name in re.findall(r"`sonar_gl\.(\w+)\.([\w.]+)", text_of(page)):
        found = importlib.import_module(f"sonar_gl.{module}")
        for part in name.split("."):
            found = getattr(found, part)
    for name in re.findall(r"\bsg\.([A-Za-z]\w*)", text_of(page)):
        assert name in sg.__all__
    for path in re.findall(r"`((?:sonar_gl|shaders|tests|tools|docs|scenes)/[\w./]*)`", text_of(page)):
        assert (ROOT / path).exists(), path


def test_constants_of_the_method_exist():
    modules = [
        importlib.import_module(f"sonar_gl.{path.stem}") for path in (ROOT / "sonar_gl").glob("[a-z]*.py")
    ]
    named = set(re.findall(r"`([A-Z][A-Z_]{2,})`", text_of(ROOT / "docs" / "method.md")))
    assert len(named) > 5
    assert {name for name in named if not any(hasattr(module, name) for module in modules)} == set()


@pytest.mark.parametrize("text", list(blocks("xml")))
def test_scenes_load_and_echo(text):
    Path("tank.sdf").write_text(text)
    scene = sg.load_scene("tank.sdf")
    assert scene.sonar_pose is not None
    with sg.Simulator(scene, sg.load_sonar("p900-45"), tolerance=0.05) as simulator:
        assert simulator.ping(scene.sonar_pose).intensity.any()


@pytest.mark.parametrize("text", list(blocks("toml")))
def test_sonars_load(text):
    Path("mine.toml").write_text(text)
    assert sg.load_sonar("mine.toml").name == "mine"


def test_the_page_of_batches_runs(folder):
    job, rig = (block.values[0] for block in blocks("toml", [BATCHES]))
    Path("pylons.toml").write_text(re.sub(r"n_pings = \d+", "n_pings = 9", job))
    told = [p.values[0] for p in shell_lines() if p.values[0][:2] == ["sonar-gl", "batch"]]
    told = list(dict.fromkeys(map(tuple, told)))  # README has some of them, too
    assert [words[-1] for words in told] == ["--dry-run", "pylons", "--resume", "pylons"]
    for words in told:
        result = run(*words[1:])
        assert result.exit_code == 0, result.output
        assert "warning" not in result.output
        if words[-1] == "--dry-run":
            assert re.search(r"^9 pings in 1 parts of \d+$", result.stdout, re.M)
            assert re.search(
                r"^p900_45 in pylon: 256 beams x \d+ bins, \d+ x \d+ samples", result.stdout, re.M
            )
            size_kb = float(re.search(r"^size: \S+ \wB \((\d+) kB a ping\)", result.stdout, re.M)[1])
            assert re.search(r"^time: .* ms a ping, on .*\), .* at best in \d+", result.stdout, re.M)
            assert set(os.listdir()) == {"pylons.toml", POSES_FILE}
    found = sum(path.stat().st_size for path in Path("pylons").rglob("*") if path.is_file())
    assert 0.8 < found / 9e3 / size_kb < 1.3  # the rest is what a whole batch has once
    assert result.stdout == "pylons: all files are as they were written\n"
    for block in blocks("python", [BATCHES]):
        exec(compile(block.values[0], "example", "exec"), {"__name__": "__main__"})
    assert Path("ping.png").stat().st_size > 10_000
    shown = Path("rig.toml")
    shown.write_text(job[: job.index("[[sonars]]")] + rig + job[job.index("[[poses]]") :])
    orders = Orders(read_job(shown))
    assert np.allclose(orders.mounts["upright"], sg.pose(roll=np.pi / 2), atol=1e-7)
    # the page's tables know every key, and no other
    page = text_of(BATCHES)
    keys = {
        key
        for row in re.findall(r"^\| (`.*?) \|", page, re.MULTILINE)
        for key in re.findall(r"`\[*(\w+)", row)
    }
    assert set(Job.model_fields) - {"where", "folder", "vary"} <= keys
    for kind, settings in re.findall(r"^\| `(\w+)` \| (.*) \|$", page, re.MULTILINE):
        if kind in KINDS:
            told = set(re.findall(r"`(\w+)`", settings))
            assert told == {field.name for field in dataclasses.fields(KINDS[kind])} - {"seed"}, kind


@pytest.mark.parametrize(
    "message", re.findall(r"^\| `([^`]+)` \|", text_of(ROOT / "README.md"), re.MULTILINE)
)
def test_messages_of_the_readme_are_said(message):
    if message.startswith("sonar-gl"):
        return
    said = "".join(path.read_text(encoding="utf-8") for path in (ROOT / "sonar_gl").glob("*.py"))
    assert message in said


def test_names_and_shapes_of_an_npz_are_those_of_the_page():
    page = text_of(ROOT / "docs" / "conventions.md")
    told = dict(re.findall(r"^\| `(\w+)` \| (\([^)]*\) \w+|JSON text)", page, re.MULTILINE))
    scene, sonar = sg.load_scene("diver"), sg.load_sonar("demarco-2015")
    with sg.Simulator(scene, sonar, tolerance=0.05) as simulator:
        ping = simulator.ping(scene.sonar_pose, sg.Noise.physical(), labels=True, background=["floor"])
    sg.save_npz("diver.npz", ping)
    letters = {sonar.n_beams: "B", sonar.n_bins: "K", len(scene.bodies) + 1: "M"}

    def shape(array):
        inner = ", ".join(str(letters.get(n, n)) for n in array.shape)
        return f"({inner}{',' if array.ndim == 1 else ''}) {array.dtype}"

    with np.load("diver.npz") as file:
        fields = {name: shape(file[name]) for name in file.files if name != "meta"}
    assert told == {**fields, "meta": "JSON text"}
    assert set(told) == {field.name for field in dataclasses.fields(ping)}
    sentence = page[page.index("`meta` has") : page.index("in a sequence, `time_s`")]
    assert set(re.findall(r"`(\w+)`", sentence)) - {"meta"} == set(ping.meta)
