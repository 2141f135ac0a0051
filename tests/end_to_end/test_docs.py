"""The documentation: its examples run, its commands and options exist, its links lead somewhere."""

import dataclasses
import doctest
import importlib.util
import json
import os
import pkgutil
import re
import shlex
from functools import cache
from itertools import takewhile
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from click.testing import CliRunner
from pycocotools.coco import COCO

import sonar_gl as sg
from sonar_gl.analysis.terms import TERMS
from sonar_gl.batch.job import Job, read_job
from sonar_gl.batch.requests import BatchRequests
from sonar_gl.batch.trajectories import KINDS
from sonar_gl.cli import main as cli
from sonar_gl.imaging.files import NPZ_FIELDS
from sonar_gl.scene.load import SUFFIXES
from tests.support.batches import LABELS, make_all, write_plain_job
from tests.support.command_line import ended
from tools import compare_real
from tools.bench import __main__ as bench
from tools.bench import embed
from tools.chart import scenes
from tools.docs import ablation, gallery, view

ROOT = Path(__file__).resolve().parents[2]
FRONT = [ROOT / name for name in ("README.md", "CHANGELOG.md", "CONTRIBUTING.md")]
PAGES = [*FRONT, *sorted((ROOT / "docs").glob("*.md"))]
MAX_PICTURE_BYTES = 120_000
MAX_FILM_BYTES = 1_500_000
BATCHES = ROOT / "docs" / "batch.md"  # whose blocks build on one another
ROS2 = ROOT / "docs" / "ros2.md"  # whose XML and TOML are no scenes and sonars
POSES_FILE = "dive.csv"  # what README calls the file of its ```csv block
# of blocks that tests/ros/test_clients.py runs
CLIENTS = re.compile(r"^import (rclpy|brping)$", re.MULTILINE)


@cache
def text_of(page):
    return page.read_text(encoding="utf-8")


@cache
def anchors_of(page):
    """Anchors of a page's headings, as GitHub forms them."""
    headings = re.findall(r"^#+ (.+)$", text_of(page), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def blocks(language, pages=None):
    """Every fenced block of a language, with its page and line; not of BATCHES and ROS2, unless named."""
    for page in pages or [page for page in PAGES if page not in (BATCHES, ROS2)]:
        for match in re.finditer(rf"^```{language}\n(.*?)^```", text_of(page), re.DOTALL | re.MULTILINE):
            line = text_of(page)[: match.start()].count("\n") + 1
            yield pytest.param(match[1], id=f"{page.name}:{line}")


# that the pages show, and their commands read
FILES = {POSES_FILE: next(blocks("csv")).values[0]} | dict(
    zip(
        ("rov.toml", "gazebo.toml", "stonefish.toml"),
        [block.values[0] for block in blocks("toml", [ROS2])],
        strict=True,
    )
)


def shell_lines(pages=None):
    """Every line of the shell blocks of all pages or some, without its comment."""
    for block in blocks("sh", pages) if pages else [*blocks("sh"), *blocks("sh", [BATCHES, ROS2])]:
        for line in block.values[0].splitlines():
            if words := shlex.split(line, comments=True):
                yield pytest.param(words, id=" ".join(words))


def commands():
    """Commands of the pages; slow are those of other pages than README, that price all terms, or draw large scenes.

    Slow are also those whose arguments, options and settings (as `looks` in `looks=2`) commands before them have.
    """
    found = [p for p in shell_lines() if p.values[0][0] == "sonar-gl" and p.values[0][1] != "batch"]
    fast = {p.id for p in shell_lines([ROOT / "README.md"])}
    slow = {"plan", "needed", "ocean_floor", "diver_vertical", "diver", "diver_swimming", "harbour"}
    seen, params = set(), []
    for p in found:
        _, command, *words = p.values[0]
        named = {*takewhile(lambda word: not word.startswith("--"), words), command}
        named |= {word for word in words if word.startswith("--")}
        named |= {name for word in words for name in re.findall(r"(\w+)=", word)}
        new = {(command, name) for name in named} - seen
        is_slow = p.id not in fast or slow & {command, *words} or not new
        seen |= set() if is_slow else new
        params.append(pytest.param(*p.values, id=p.id, marks=pytest.mark.slow if is_slow else ()))
    return params


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """An empty working directory, but for FILES."""
    monkeypatch.chdir(tmp_path)
    for name, text in FILES.items():
        Path(name).write_text(text)
    return tmp_path


def run(*words):
    return CliRunner().invoke(cli.main, list(words))


def test_there_is_something_to_check():
    assert all(page.is_file() for page in PAGES)
    assert {page.name for page in PAGES} >= {"README.md", "gallery.md", "method.md", "conventions.md"}
    assert all(len(list(blocks(language))) > 0 for language in ("python", "sh", "xml", "toml", "csv"))
    assert len(commands()) > 5


@pytest.mark.filterwarnings("error::UserWarning")
@pytest.mark.parametrize(
    "code",
    [
        pytest.param(*p.values, id=p.id, marks=() if p.id.startswith("README") else pytest.mark.slow)
        for p in [*blocks("python"), *blocks("python", [ROS2])]
        if not CLIENTS.search(p.values[0])
    ],
)
def test_python_examples_run(code):
    if "DdsTransport" in code:
        pytest.importorskip("cyclonedds", reason="cyclonedds, of the extra live, is missing")
    exec(compile(code, "example", "exec"), {"__name__": "__main__"})


def test_examples_of_docstrings_hold():
    """Those of all modules; how NumPy prints a scalar depends on its version, for one."""
    sources = [path for path in (ROOT / "sonar_gl").rglob("*.py") if "\n    >>> " in path.read_text("utf-8")]
    names = [".".join(path.relative_to(ROOT).with_suffix("").parts) for path in sorted(sources)]
    results = {name: doctest.testmod(importlib.import_module(name)) for name in names}
    assert not [name for name, result in results.items() if result.failed]
    assert sum(result.attempted for result in results.values()) > 140


@pytest.mark.parametrize("words", commands())
@pytest.mark.usefixtures("timed_once")
def test_commands_run(words, folder):
    before = set(folder.rglob("*"))
    if words[1] == "ros2":
        pytest.importorskip("cyclonedds", reason="cyclonedds, of the extra live, is missing")
    words = ["sonar-gl", *ended(words[1:], 0.05)]
    result = run(*words[1:])
    assert result.exit_code == 0, result.output
    assert "warning" not in result.output or "no zenoh router answers" in result.output
    if words[1] == "render":
        assert {path for path in folder.rglob("*") if path.is_file()} - before


@pytest.mark.slow
def test_the_python_example_and_the_command_of_the_first_screen_make_the_same_picture(folder):
    command = next(p.values[0] for p in commands())
    assert run(*command[1:], "--out", "command").exit_code == 0
    exec(next(blocks("python")).values[0], {})
    assert Path("pylon.png").read_bytes() == Path("command", "pylon.png").read_bytes()


def options_of(words):
    """Options of the tool or example that `python -m MODULE [NAME]` or `python FILE` runs, as its source has them."""
    if "-m" not in words:
        return options_in((ROOT / words[1]).read_text(encoding="utf-8"))
    module = words[words.index("-m") + 1]
    specs = [importlib.util.find_spec(module)]
    if specs[0].submodule_search_locations:
        specs = [importlib.util.find_spec(f"{module}.__main__")]
    if module == "tools.bench":
        named = next((word for word in words if word in bench.NAMES), "ping")
        specs.append(importlib.util.find_spec(f"{module}.{named}"))
    return options_in("".join(Path(spec.origin).read_text(encoding="utf-8") for spec in specs))


def options_in(source):
    """Options that a source gives its parser."""
    return set(re.findall(r'add_argument\(\s*"(--[a-z-]+)"', source))


@pytest.mark.parametrize("words", [p for p in shell_lines() if p.values[0][0] != "sonar-gl"])
def test_other_commands_name_files_and_options_that_exist(words):
    paths = [w for w in words[1:] if w.startswith(("tools/", "examples/"))]
    assert all((ROOT / path).is_file() for path in paths)
    if "-m" in words or any(path.endswith(".py") for path in paths):
        assert {w for w in words if w.startswith("--")} <= options_of(words)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)]+)\)", text_of(page)):
        if not target.startswith("https://"):
            path, _, anchor = target.partition("#")
            linked = page.parent / path if path else page
            assert linked.exists(), target
            assert not anchor or anchor in anchors_of(linked), target


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_rows_of_tables_have_the_cells_of_their_heads(page):
    """A row that is broken over two lines is two rows."""
    n_cells, wrong = None, []
    for number, line in enumerate(text_of(page).splitlines(), 1):
        n_bars = len(re.findall(r"(?<!\\)\|", line))
        if re.fullmatch(r" *\|(-+:?\|)+", line):
            n_cells = n_bars
        elif not line.lstrip().startswith("|"):
            n_cells = None
        elif n_cells not in (None, n_bars):
            wrong.append(number)
    assert wrong == []


def test_pictures_are_shown_small_and_made_by_the_tools():
    shown = {
        (page.parent / target).resolve()
        for page in PAGES
        for target in re.findall(r"!\[[^\]]+\]\(([^)]+)\)", text_of(page))
    }
    kept = set((ROOT / "docs" / "pictures").iterdir())
    film = ROOT / "docs" / "view.gif"  # by tools.docs.view
    assert shown == kept | {film}
    assert max(path.stat().st_size for path in kept) <= MAX_PICTURE_BYTES
    assert film.stat().st_size <= MAX_FILM_BYTES
    assert {path.stem for path in kept} == {
        *(f"{name}_{style}" for name, one in gallery.COMPARISONS.items() for style in one.styles),
        *(f"chart_{name}" for name in (*scenes.SCENES, "shimmer", "embedding")),
        *(f"embedding_{name}" for name in embed.SHOWN),
        *(f"ablation_{name}" for name in ablation.SCENES),
        *(f"view_{name}" for name in view.SCENES),
        "scaling",
        compare_real.OURS,
    }


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_options_exist(page):
    known = {"--help", "--version"}
    commands = list(cli.main.commands.values())
    for command in (*commands, *cli.main.commands["emulate"].commands.values()):
        known |= {option for parameter in command.params for option in parameter.opts}
    outside_blocks = re.sub(r"^```.*?^```", "", text_of(page), flags=re.DOTALL | re.MULTILINE)
    unknown = set(re.findall(r"(?<![\w-])--[a-z][a-z-]+", outside_blocks)) - known
    assert unknown == set(), "outside of blocks pages name options of sonar-gl alone, as its help has them"


def test_every_command_is_told_in_the_readme():
    told = set(re.findall(r"^\| `sonar-gl (\w+)", text_of(ROOT / "README.md"), re.MULTILINE))
    assert told == set(cli.main.commands), (
        "the README's table of commands must have a row for each, and no other"
    )


@pytest.mark.parametrize("settings", [sg.Acoustics, sg.Noise, sg.Water])
def test_every_setting_is_told_on_the_page_of_acoustics(settings):
    told = set(re.findall(r"\w+", text_of(ROOT / "docs" / "acoustics.md")))
    untold = {field.name for field in dataclasses.fields(settings)} - told
    assert untold == set(), "docs/acoustics.md must have a row for each of these"


def test_every_term_has_its_row_in_each_table_of_the_ablation():
    page = text_of(ROOT / "docs" / "ablation.md")
    tables = dict(re.findall(r"<!-- table (\w+) -->(.*?)<!-- end -->", page, re.DOTALL))
    assert set(tables) == {*ablation.SCENES, "cost"}
    for name in ablation.SCENES:
        rows = re.findall(r"^\| ([\w -]+) \|", tables[name], re.MULTILINE)
        assert rows == ["without", *(term.name for term in TERMS)], (
            f'table {name} of docs/ablation.md must have a row for each of TERMS: run "python -m tools.docs.ablation '
            '--only TERM" with the name of a term that is new'
        )


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_names_of_the_package_exist(page):
    for name in re.findall(r"`(sonar_gl\.[\w.]+)", text_of(page)):
        pkgutil.resolve_name(name.rstrip("."))
    for name in re.findall(r"\bsg\.([A-Za-z]\w*)", text_of(page)):
        assert name in sg.__all__
    for path in re.findall(r"`((?:sonar_gl|shaders|tests|tools|docs|scenes)/[\w./]*)`", text_of(page)):
        assert (ROOT / path).exists(), path


def test_names_of_code_in_the_architecture_exist():
    """Half of the page says where to add what, by names that a reader looks up, and that others rename."""
    page = text_of(ROOT / "docs" / "architecture.md")
    code = re.findall(r"^```text$(.*?)^```", page, re.DOTALL | re.MULTILINE) + re.findall(
        r"`([^`\n]+)`", page
    )
    named = set(re.findall(r"\b\w*(?:[a-z]_[a-z]|[a-z][A-Z]|[A-Z]_[A-Z])\w*", " ".join(code)))
    assert len(named) > 200
    endings = {".py", ".pyi", ".glsl", ".vert", ".frag", ".geom", ".toml"}
    for folder in ("sonar_gl", "shaders", "tests", "tools"):
        for path in (ROOT / folder).rglob("*"):
            if path.suffix in endings:
                named -= {path.stem, *re.findall(r"\w+", text_of(path))}
    assert named == set(), "docs/architecture.md must name what exists: these were renamed or removed"


def test_constants_of_the_method_exist():
    modules = [
        importlib.import_module(module.name)
        for module in pkgutil.walk_packages(sg.__path__, "sonar_gl.")
        if not module.name.endswith("__main__")
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


SETS = "pylons", "validation"


@pytest.mark.slow
@pytest.mark.timeout(300)  # a minute on a quiet machine
def test_the_page_of_batches_runs(folder):
    job, rig, elsewhere, swim = (block.values[0] for block in blocks("toml", [BATCHES]))
    assert swim.count("n_pings = 60\n") == swim.count("ping_rate_hz = 5.0\n") == 1
    fewer = swim.replace("n_pings = 60", "n_pings = 12").replace("ping_rate_hz = 5.0", "ping_rate_hz = 1.0")
    Path("swim.toml").write_text(fewer)
    (path,) = blocks("csv", [BATCHES])
    Path("swim.csv").write_text(path.values[0])
    Path("pylons.toml").write_text(re.sub(r"n_pings = \d+", "n_pings = 9", job))
    Path("validation.toml").write_text(Path("pylons.toml").read_text().replace("seed = 1", "seed = 2"))
    before = set(os.listdir())
    told = [p.values[0] for p in shell_lines() if p.values[0][:2] == ["sonar-gl", "batch"]]
    told = list(dict.fromkeys(map(tuple, told)))  # README has some of them, too
    assert [words[-1] for words in told] == [
        "--dry-run",
        "pylons",
        "--resume",
        "pylons",
        "swim",
        "validation",
    ]
    for words in told:
        result = run(*words[1:])
        assert result.exit_code == 0, result.output
        assert "warning" not in result.output
        if words[-1] == "--dry-run":
            assert re.search(r"^9 pings in 2 parts of 8$", result.stdout, re.M)
            assert re.search(
                r"^p900_45 in pylon: 256 beams x \d+ bins, \d+ to \d+ samples a ping", result.stdout, re.M
            )
            assert re.search(
                r"^  labels of 9 pings, with the median of their bins: \w+ in \d \(", result.stdout, re.M
            )
            size_kb = float(re.search(r"^size: \S+ \wB \((\d+) kB a ping\)", result.stdout, re.M)[1])
            assert re.search(
                r"^speed: \S+ pings a second in one process \(\S+ ms a ping, on .*; measured on this machine by ",
                result.stdout,
                re.M,
            )
            assert re.search(r"^time: .* in one process, .* at best in \d+, if each", result.stdout, re.M)
            assert set(os.listdir()) == before
        if "--check" in words:
            assert result.stdout == "pylons: all files are as they were written\n"
    found = sum(path.stat().st_size for path in Path("pylons").rglob("*") if path.is_file())
    assert 0.8 < found / 9e3 / size_kb < 1.3  # the rest is what a whole batch has once
    shown = Path("rig.toml")
    text = re.sub(r"n_pings = \d+", "n_pings = 1", job)
    shown.write_text(text[: text.index("[[sonars]]")] + rig + text[text.index("[[poses]]") :])
    assert run("batch", "rig.toml", "--out", "rig").exit_code == 0
    names = {"__name__": "__main__"}
    for block in blocks("python", [BATCHES]):
        exec(compile(block.values[0], "example", "exec"), names)
    assert Path("ping.png").stat().st_size > 10_000
    # sets of several jobs keep what a ping needs to be made again, and their images have numbers of their own
    both, sets = names["both"], [xr.open_dataset(f"{name}/pings.zarr") for name in SETS]
    for n, one in enumerate(sets):
        part = both.isel(ping=slice(9 * n, 9 * n + 9))
        assert part.number.values.tolist() == list(range(9))
        for key in ("seed", "noise_seed"):
            assert set(part[key].values.tolist()) == {one.attrs[key]} and key not in both.attrs
        assert part.intensity.equals(one.intensity) and part.azimuth_rad.equals(one.azimuth_rad)
    assert sets[0].attrs["noise_seed"] != sets[1].attrs["noise_seed"] and not sets[0].pose.equals(
        sets[1].pose
    )
    swimming = COCO("swim/coco/p900_45/instances.json")
    places = [one["bbox"][0] for one in swimming.anns.values()]
    assert 7 < len(places) < 11 and places == sorted(places, reverse=True)  # to port, which is left
    joined, ones = COCO("joined.json"), [COCO(f"{name}/coco/p900_45/instances.json") for name in SETS]
    assert len(joined.imgs) == 18 and len(joined.anns) == sum(len(one.anns) for one in ones)
    for image in joined.imgs.values():
        assert Path(image["file_name"]).is_file()
        one = ones[image["id"] // 9]
        ids = joined.getAnnIds(image["id"]), one.getAnnIds(image["id"] % 9)
        assert [a["bbox"] for a in joined.loadAnns(ids[0])] == [a["bbox"] for a in one.loadAnns(ids[1])]
    seabed = Path("seabed.toml").read_text().replace("n_pings = 300", "n_pings = 12")
    Path("seabed.toml").write_text(seabed)
    assert run("batch", "seabed.toml", "--out", "seabed").exit_code == 0
    lying = COCO("seabed/coco/oculus_m1200d_lf/instances.json")
    assert [category["name"] for category in lying.cats.values()] == ["tyre", "crate", "mine"]
    assert all(lying.getAnnIds(catIds=number) for number in lying.cats)
    Path("elsewhere.toml").write_text(elsewhere + text[text.index("[[sonars]]") : text.index("[[poses]]")])
    requests = BatchRequests(read_job(Path("elsewhere.toml")))
    assert [request.scene for request in requests] == [0] * 200 + [1] * 100
    requests = BatchRequests(read_job(shown))
    assert np.allclose(requests.mounts["upright"], sg.pose(roll=np.pi / 2), atol=1e-7)
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
            assert told == {field.name for field in dataclasses.fields(KINDS[kind])}, kind


VARIED = '[[vary.bodies]]\nnames = ["box_1"]\nx_m = [-0.5, 0.5]\n'
VARIED_ONE = VARIED.replace('"box_1"', '"box_1", "wall"') + "one_of = true\n"
ON_PATH = (
    '[[vary.bodies]]\nnames = ["box_1"]\npath = "swim.csv"\ny_m = [-0.5, 0.5]\nreflectivity = [0.2, 0.9]\n'
)
SWIM = "t,x,y,z,roll,pitch,yaw\n0.1,3,-0.3,-0.1,0,0,1.2\n1.0,3.4,0.3,-0.1,0.1,0.2,1.6\n"
VARIED_MEDIA = (
    "[vary.water]\ntemperature_c = [2.0, 20.0]\n[vary.noise]\nambient_db = [-80.0, -60.0]\nlooks = [2, 4]\n"
)


@pytest.mark.slow
@pytest.mark.filterwarnings("error::UserWarning")
@pytest.mark.parametrize(
    ("vary", "has_labels", "scenes"),
    [
        pytest.param("", True, ["tank.sdf"], id="nothing"),
        pytest.param(VARIED, True, ["tank.sdf"], id="poses"),
        pytest.param(
            VARIED + "there = 0.5\nreflectivity = [0.2, 0.9]\n" + VARIED_MEDIA, False, ["tank.sdf"], id="all"
        ),
        pytest.param(VARIED_ONE, True, ["pool.sdf", "tank.sdf"], id="one of two"),
        # in the first scene, too, bodies of these names move
        pytest.param(VARIED, True, ["pool.sdf", "tank.sdf"], id="scenes"),
        # the path begins anew in the second scene, whose pings are later
        pytest.param(ON_PATH, True, ["pool.sdf", "tank.sdf"], id="path"),
    ],
)
def test_the_block_that_makes_a_ping_again_is_for_any_job(folder, vary, has_labels, scenes):
    job = write_plain_job(folder, 4, 4, vary + LABELS * has_labels)
    Path("swim.csv").write_text(SWIM)
    Path("pool.sdf").write_text(Path("tank.sdf").read_text().replace('"tank"', '"pool"'))
    job.write_text(job.read_text().replace('["tank.sdf"]', json.dumps(scenes)))
    make_all(job, folder / "pylons")
    (code,) = [
        block.values[0] for block in blocks("python", [BATCHES]) if "receiver_power(again" in block.values[0]
    ]
    number = 4 * len(scenes) - 1  # of the last scene
    names = {"__name__": "__main__"}
    exec(compile(code.replace("n, pings = 3,", f"n, pings = {number},"), "example", "exec"), names)
    assert names["n"] == number and names["scene_number"] == len(scenes) - 1
    assert names["again"].intensity.sum() == pytest.approx(float(names["pings"].echo[number]), rel=1e-6)
    assert ("body_id" in names) == has_labels
    if vary == ON_PATH:
        assert list(names["state"]["reflectivity"]) == ["box_1"]
        np.testing.assert_allclose(names["state"]["bodies"]["box_1"][0, 3], 3 + 0.4 * 0.5 / 0.9, atol=1e-12)


@pytest.mark.parametrize(
    "message", re.findall(r"^\| `([^`]+)` \|", text_of(ROOT / "README.md"), re.MULTILINE)
)
def test_messages_of_the_readme_are_said(message):
    if message.startswith("sonar-gl"):
        return
    said = "".join(path.read_text(encoding="utf-8") for path in (ROOT / "sonar_gl").rglob("*.py"))
    assert message in said


@pytest.mark.parametrize("ending", SUFFIXES)
def test_every_ending_of_a_scene_is_told(ending):
    assert f"`{ending}`" in text_of(ROOT / "docs" / "conventions.md"), (
        "docs/conventions.md must name the ending"
    )
    assert re.search(rf"{re.escape(ending)}\b", sg.load_scene.__doc__), (
        "the docstring of load_scene must name the ending"
    )


def test_names_and_shapes_of_an_npz_are_those_of_the_page():
    page = text_of(ROOT / "docs" / "conventions.md")
    told = dict(re.findall(r"^\| `(\w+)` \| (\([^)]*\) \w+|JSON text)", page, re.MULTILINE))
    scene, sonar = sg.load_scene("diver"), sg.load_sonar("demarco-2015")
    with sg.Simulator(scene, sonar, tolerance=0.5) as simulator:
        motion = {"time_s": 1.0, "velocity": (0.1, 0, 0, 0, 0, 0)}
        ping = simulator.ping(
            scene.sonar_pose, sg.Noise.physical(), labels=True, background=["floor"], **motion
        )
    sg.save_npz("diver.npz", ping)
    letters = {sonar.n_beams: "B", sonar.n_bins: "K", len(scene.bodies) + 1: "M"}

    def shape(array):
        inner = ", ".join(str(letters.get(n, n)) for n in array.shape)
        return f"({inner}{',' if array.ndim == 1 else ''}) {array.dtype}"

    with np.load("diver.npz") as file:
        fields = {name: shape(file[name]) for name in file.files if name != "meta"}
    assert told == {**fields, "meta": "JSON text"}, (
        'the table of docs/conventions.md, "Files", must have a row for each field of an NPZ file'
    )
    assert set(told) == set(NPZ_FIELDS), "a field of Ping that this ping lacks needs a ping here that has it"
    table = re.search(r"^\| keys \|.*?\n\n", page, re.DOTALL | re.MULTILINE)[0]
    keys = [cells.split("|")[1] for cells in table.splitlines()[2:] if cells]
    assert set(re.findall(r"`(\w+)`", " ".join(keys))) == set(ping.meta)
