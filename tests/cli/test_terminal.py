"""Names from files reach the terminal without the characters that it would obey."""

import json
import re
import warnings
from pathlib import Path

import pytest

import sonar_gl as sg
from sonar_gl import cli
from sonar_gl.core.errors import Error
from tests.support import command_line
from tests.support.command_line import BOX, SENSOR, SONAR, WALL, run

# clears the screen; starts a new line; turns the direction of the text; ends an isolated part of it
EVIL = "w\u009b2Jx\u0085y\u202ez\u2069"
SHOWN = r"w\x9b2Jx\x85y\u202ez\u2069"
OBEYED = re.compile("[\0-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069]")
SCENE = '<sdf version="1.9"><world name="any">{}</world></sdf>'
QUICK = ("--sonar", "small.toml", "--tolerance", 0.1)


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch, timed_once, few_first_rays):
    """A folder with a scene whose wall has an evil name, a small sonar, and two poses; the working directory."""
    monkeypatch.chdir(tmp_path)
    wall = re.sub(r'(<model name=)"[^"]*"', rf'\1"{EVIL}"', WALL)
    wall = re.sub("<laser_retro>.*?</laser_retro>", "", wall)
    Path("evil.sdf").write_text(SCENE.format(wall + BOX + SENSOR), encoding="utf-8")
    Path("small.toml").write_text(SONAR)
    return tmp_path


@pytest.mark.parametrize(
    "arguments",
    [
        ("render", "evil.sdf", *QUICK, "--height", 60, "--labels"),
        ("plan", "evil.sdf", *QUICK),
        ("verify", "evil.sdf", *QUICK, "--bins", 20),
        ("render", "evil.sdf", *QUICK, "--only", f"{EVIL}?"),
        ("render", f"{EVIL}.sdf", *QUICK),
        ("plan", "evil.sdf", "--sonar", f"{EVIL}.toml"),
        ("render", "evil.sdf", *QUICK, "--poses", f"{EVIL}.csv"),
        ("batch", f"{EVIL}.toml"),
    ],
    ids=lambda arguments: " ".join(map(str, arguments[::5])).encode("ascii", "replace").decode(),
)
def test_commands_print_names_with_escape_sequences(arguments):
    _, out, err = command_line.run(*arguments)
    assert SHOWN in out + err
    assert not OBEYED.search(out + err)


def test_json_holds_the_name_itself():
    _, out, _ = command_line.run("plan", "evil.sdf", *QUICK, "--json")
    assert not OBEYED.search(out)
    assert json.loads(out)["worst_body"] in (EVIL, "box", "")


def test_cells_of_tables_of_poses():
    Path("p.csv").write_text(f"t,x,y,z,roll,pitch,{EVIL}\n", encoding="utf-8")
    _, out, err = command_line.run("render", "evil.sdf", *QUICK, "--poses", "p.csv")
    assert SHOWN in err and not OBEYED.search(out + err)


def test_errors_and_warnings_of_the_library():
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        scene = sg.load_scene("evil.sdf")
    assert EVIL in [body.name for body in scene.bodies]  # names stay
    (text,) = [str(warning.message) for warning in caught]
    assert SHOWN in text and not OBEYED.search(text)
    with pytest.raises(Error) as error:
        raise Error(f"a\n{EVIL}\tb")
    assert str(error.value) == f"a\n{SHOWN}\tb"


def test_no_command_prints_in_another_way():
    """`echo` of `sonar_gl.cli.output` escapes; click's and Python's own do not."""
    for path in Path(cli.__file__).parent.glob("*.py"):
        if path.name not in ("output.py", "compilation.py"):  # the latter talks to its parent process
            assert not re.search(r"click\.s?echo|(?<![\w.])print\(", path.read_text(encoding="utf-8")), (
                path.name
            )


def test_a_line_break_in_a_name_does_not_forge_a_line_of_output(tmp_path):
    path = tmp_path / "a.sdf"
    name = "a&#10;error: all is lost"
    box = "<geometry><box><size>1 1 1</size></box></geometry>"
    model = f"<model name='{name}'><link name='l'><collision name='c'>{box}</collision></link></model>"
    path.write_text(f"<sdf version='1.7'><world name='w'>{model}</world></sdf>")
    status, shown, err = run("doctor", "--scene", path)
    assert status == 0
    assert "a\\nerror: all is lost" in shown
    assert not any(line.startswith("error") for line in (shown + err).splitlines())
