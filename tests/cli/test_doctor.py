"""What `sonar-gl doctor` finds where all is well, and where something is missing."""

import ctypes
import json
import os
import re
import sys
from pathlib import Path

import glcontext
import pytest
import trimesh
from click.testing import CliRunner

import sonar_gl
from sonar_gl.cli import compilation, doctor, system_checks
from sonar_gl.cli import main as cli
from sonar_gl.cli.doctor import examine
from sonar_gl.core.errors import Error
from sonar_gl.core.extras import pip_install
from sonar_gl.gl import context as gl
from sonar_gl.gl import egl
from sonar_gl.scene.materials import material
from sonar_gl.simulator import Simulator
from tests.support import command_line
from tests.support.command_line import BODY, BOX, SENSOR, WALL
from tests.support.processes import HOME, python

pytestmark = pytest.mark.timeout(600)  # the first test of all may have to compile everything


@pytest.fixture(scope="module")
def well():
    return {finding.what: finding for finding in examine()}


@pytest.fixture
def nothing_to_compile(monkeypatch):
    """To compile everything, or to find that it is, takes seconds; `well` has done it."""
    done = compilation.Compilation(300, 0, 0.0)
    monkeypatch.setattr(compilation, "compile_everything", lambda *_: done)


def test_all_is_well_where_these_tests_run(well):
    assert not [finding for finding in well.values() if finding.ok is False]
    assert all(finding.detail for finding in well.values())


def test_names_the_renderer_and_its_kind(well):
    with gl.create_context() as context:
        told = gl.describe(context)
    detail = well["OpenGL"].detail
    assert detail.startswith(told["renderer"]) and told["version"] in detail
    assert ("(software)" in detail) == ("llvmpipe" in told["renderer"] or "softpipe" in told["renderer"])
    assert str(told["max_texture_size"]) in detail


def test_known_scene_tells_how_well(well):
    assert well["known scene"].detail.startswith("wall at 5 m: 1.00")
    assert "box to port at 7.91 m, +2.9 deg: found at 7.90 m, +" in well["known scene"].detail


def test_known_scene_finds_a_wrong_drawing(monkeypatch):
    ping = Simulator.ping

    def mirrored(self, *args, **more):
        out = ping(self, *args, **more)
        return type(out)(out.intensity[::-1], out.azimuth_rad, out.range_m, pose=out.pose, meta=out.meta)

    monkeypatch.setattr(Simulator, "ping", mirrored)
    ok, detail, cure = system_checks.check_known_scene()
    assert ok is False and ", -2." in detail and cure == "install sonar_gl again"


def test_missing_package_has_its_cure(monkeypatch):
    monkeypatch.setitem(sys.modules, "trimesh", None)
    finding = doctor.check_package("trimesh", "trimesh")
    assert finding.ok is False and finding.cure == pip_install("trimesh")
    assert finding.detail.startswith("cannot be imported (")


@pytest.mark.slow
def test_process_without_a_package(tmp_path):
    """The report is complete, though nothing of the simulator can be imported."""
    (tmp_path / "trimesh.py").write_text("raise ImportError('no trimesh here')")
    before_ours = {"PYTHONPATH": f"{tmp_path}{os.pathsep}{HOME}"}
    done = python("-m", "sonar_gl", "doctor", environment=before_ours)
    assert (done.returncode, done.stderr) == (1, "")
    lines = [" ".join(line.split()) for line in done.stdout.splitlines()]
    at = lines.index("FAIL trimesh cannot be imported (no trimesh here)")
    assert lines[at + 1] == pip_install("trimesh")
    assert "FAIL OpenGL not tried (no trimesh here)" in lines
    assert "FAIL known scene not tried (no trimesh here)" in lines
    assert any(line.startswith("ok shaders ") for line in lines)
    assert lines[-1] == "8 of 23 failed"


@pytest.mark.slow
def test_process_in_which_numba_may_not_compile(tmp_path):
    """The one cure is in the message; others, such as to install packages again, would not help."""
    report, environment = tmp_path / "report.json", {"NUMBA_DISABLE_JIT": "1"}
    done = python("-m", "sonar_gl", "doctor", "--report", str(report), environment=environment)
    assert done.returncode == 1
    why = "(NUMBA_DISABLE_JIT must be 0 or unset, since pings need compiled code (got 1; unset it))"
    failed = [line.split() for line in done.stdout.splitlines()]
    at = [k for k, words in enumerate(failed) if words[0] == "FAIL"]
    assert len(at) == 7 and all(" ".join(failed[k]).endswith(f"not tried {why}") for k in at)
    assert all(failed[k + 1][0] in ("ok", "FAIL", "7") for k in at)  # no cure below
    assert why[1:-1] in json.loads(report.read_text())["failed"]


def test_optional_packages_may_be_missing(monkeypatch):
    monkeypatch.setitem(sys.modules, "embreex", None)
    monkeypatch.setitem(sys.modules, "pyrender", None)
    for what, check in (
        ("reference_ping", doctor.check_embreex),
        ("scenes of pyrender and optical images of batches", system_checks.check_pyrender),
    ):
        ok, _, cure = check()
        assert ok is None and cure.startswith(f"only {what} need")


@pytest.fixture
def no_egl(monkeypatch):
    """A machine without libEGL, also to what has loaded it."""

    def none(*_args, **_more):
        raise Exception("libEGL.so not loaded")

    def no_library(name, *_args, **_more):
        raise OSError(f"{name}: cannot open shared object file")

    with monkeypatch.context() as patch:
        patch.setattr(glcontext, "get_backend_by_name", none)
        patch.setattr(ctypes, "CDLL", no_library)
        egl.library.cache_clear()
        yield
    egl.library.cache_clear()


def test_no_opengl_leaves_pings_to_the_cpu(monkeypatch, no_egl, nothing_to_compile):
    monkeypatch.setattr(doctor, "PACKAGES", ())
    monkeypatch.setenv("SONAR_GL_ENGINE", "auto")
    result = CliRunner().invoke(cli.main, ["doctor"])
    assert result.exit_code == 0
    lines = [" ".join(line.split()) for line in result.output.splitlines()]
    at = lines.index("- EGL libEGL.so.1: cannot open shared object file")
    assert lines[at + 1].endswith("on Debian or Ubuntu: apt-get install libegl1 libgl1")
    assert lines[at + 2].startswith("- OpenGL OpenGL must be reachable through EGL, without a display (got: ")
    assert lines[at + 3].startswith("pings are drawn by the CPU")
    assert lines[at + 4].startswith("ok engine cpu: CPU, Numba ")
    assert any(line.startswith("ok known scene ") for line in lines)
    assert lines[-1] == "all is well"


def test_no_opengl_is_told_with_its_cure_and_status_1_where_it_is_asked_for(monkeypatch, no_egl):
    monkeypatch.setattr(doctor, "PACKAGES", ())
    monkeypatch.setenv("SONAR_GL_ENGINE", "opengl")
    result = CliRunner().invoke(cli.main, ["doctor"])
    assert result.exit_code == 1
    lines = [" ".join(line.split()) for line in result.output.splitlines()]
    why = "OpenGL must be reachable through EGL, without a display (got: "
    for what in ("OpenGL", "engine", "known scene"):
        assert any(line.startswith(f"FAIL {what} {why}") for line in lines)


@pytest.mark.parametrize(
    "wanted, told",
    [
        ("cpu", r"cpu: CPU, Numba [\d.]+; it draws pings"),
        (
            "auto",
            r"cpu: CPU, Numba [\d.]+; it draws pings in place of OpenGL, as there is no graphics card|opengl: .*",
        ),
        ("opengl", r"opengl: .*; it draws pings"),
    ],
)
def test_the_engine_that_draws_is_told_and_why_no_other(monkeypatch, wanted, told):
    monkeypatch.setenv("SONAR_GL_ENGINE", wanted)
    ok, detail, _ = system_checks.check_raster_engine()
    assert ok and re.fullmatch(told, detail)


@pytest.mark.parametrize("engine", ["cpu", "opengl"])
def test_the_command_takes_an_engine(monkeypatch, nothing_to_compile, engine):
    monkeypatch.setenv("SONAR_GL_ENGINE", {"cpu": "opengl", "opengl": "cpu"}[engine])
    before, drawn = os.environ["SONAR_GL_ENGINE"], []
    ping = Simulator.ping
    monkeypatch.setattr(
        Simulator,
        "ping",
        lambda self, *_, **more: (drawn.append(self.gl_info["engine"]), ping(self, *_, **more))[1],
    )
    result = CliRunner().invoke(cli.main, ["doctor", "--engine", engine])
    assert result.exit_code == 0, result.output
    (line,) = [line for line in result.output.splitlines() if line.split()[:2] == ["ok", "engine"]]
    assert line.split()[2] == f"{engine}:" and set(drawn) == {engine}  # of the known scene
    assert os.environ["SONAR_GL_ENGINE"] == before


def test_command_is_quiet_about_cures_when_all_is_well(monkeypatch, well):
    monkeypatch.setattr(doctor, "examine", lambda: list(well.values()))
    result = CliRunner().invoke(cli.main, ["doctor"])
    assert result.exit_code == 0
    lines = result.output.splitlines()
    assert lines[-1] == "all is well"
    assert all(line.startswith(("ok ", "-  ")) for line in lines[:-1] if line[0] != " ")
    assert "driver draws wrongly" not in result.output


def test_missing_folder_is_told(monkeypatch, nothing_to_compile):
    def none(*_):
        raise Error("the folder is nowhere")

    monkeypatch.setattr(doctor, "data_folder", none)
    monkeypatch.setattr(system_checks, "bundled_scenes", none)
    findings = {finding.what: finding for finding in examine()}
    for what in ("shaders", "scenes"):
        assert findings[what] == (what, False, "the folder is nowhere", "install sonar_gl again")


# --- compiled functions


def test_compiled_functions_are_counted_with_the_time_and_the_folder(well):
    detail = well["compiled functions"].detail
    assert re.fullmatch(r"\d+; \d+ compiled now, \d+ s; kept in .+", detail)
    assert detail.startswith(f"{len(compilation.compiled_functions())}; ")


@pytest.mark.slow
def test_what_is_compiled_once_is_read_from_disk(well):
    assert compilation.compile_everything().n_compiled == 0


def test_cache_that_cannot_be_kept_is_told(monkeypatch, nothing_to_compile):
    monkeypatch.setattr(system_checks.os, "access", lambda *_: False)
    ok, detail, cure = system_checks.check_compiled_functions()
    assert ok is None and "; cannot be kept in " in detail and "NUMBA_CACHE_DIR" in cure


def test_a_full_disk_of_the_cache_is_told(monkeypatch, nothing_to_compile):
    monkeypatch.setattr(system_checks, "reason_not_kept", lambda: "no space left on device")
    ok, detail, cure = system_checks.check_compiled_functions()
    assert ok is None and detail.endswith(" (no space left on device)") and "NUMBA_CACHE_DIR" in cure


def test_no_compiled_function_is_forgotten():
    """What is compiled calls all of them, by the names in their code; the next test compiles them, which takes minutes.

    In a process of its own, where no other test has called any. With machine code from disk only functions that
    Python calls have signatures, and not those that these call in turn.
    """
    code = """
from numba.core.dispatcher import Dispatcher
from sonar_gl.cli import compilation
compilation.compile_everything(processes=1)
functions = compilation.compiled_functions()
waiting, reached = [one for one in functions.values() if one.signatures], set()
while waiting:
    one = waiting.pop()
    if one not in reached:
        reached.add(one)
        known = one.py_func.__globals__
        waiting += [known[name] for name in one.py_func.__code__.co_names if isinstance(known.get(name), Dispatcher)]
print(len(functions), *(name for name, one in functions.items() if one not in reached))
"""
    n_functions, *forgotten = python("-c", code, check=True, timeout=590).stdout.split()
    assert forgotten == [] and int(n_functions) == n_compiled_in_source()


@pytest.mark.slow
def test_every_compiled_function_is_compiled(tmp_path):
    """In a process with an empty cache: functions that others call have no signatures where those come from disk.

    Those that count no references return no array, which their callers would release. A host's context, in which
    OpenGL draws where there is no graphics card, finds all compiled.
    """
    code = """
import sonar_gl as sg
from sonar_gl.cli import compilation
reports = []
done = compilation.compile_everything(reports.append, processes=1)
functions = compilation.compiled_functions()
print(done.n_functions, done.n_compiled, len(reports) > 3, *(n for n, f in functions.items() if not f.signatures))
uncounted = [f for f in functions.values() if f.targetoptions.get("_nrt") is False]
returned = [str(one.signature.return_type) for f in uncounted for one in f.overloads.values()]
print(len(returned) > 10, *(one for one in returned if "rray" in one))
known = {name: len(function.signatures) for name, function in functions.items()}
scene = sg.load_scene("pylon")
with sg.Simulator(scene, sg.load_sonar("p900-45"), tolerance=0.1, engine="opengl") as simulator:
    simulator.ping(scene.sonar_pose)
print(*(name for name, function in functions.items() if len(function.signatures) > known[name]))
"""
    nothing_kept = {"NUMBA_CACHE_DIR": str(tmp_path), "SONAR_GL_ENGINE": "cpu"}
    done = python("-c", code, environment=nothing_kept, check=True, timeout=590)
    (n_functions, n_compiled, has_reports, *left), uncounted, more = map(str.split, done.stdout.splitlines())
    assert left == more == [] and uncounted == ["True"]
    assert int(n_functions) == int(n_compiled) == n_compiled_in_source() and has_reports == "True"


def n_compiled_in_source() -> int:
    """Return the number of functions that the sources of the package mark for compilation."""
    home = Path(sonar_gl.__file__).parent
    return sum(
        len(
            re.findall(
                r"^@(?:added_in_any_order|compiled|rounded_alike|uncounted)$",
                path.read_text(encoding="utf-8"),
                re.MULTILINE,
            )
        )
        for path in home.rglob("*.py")
    )


# --- devices


@pytest.fixture
def several(monkeypatch):
    """A machine with three devices, of which the second alone draws; gives the indices that are tried."""
    tried, real = [], gl.egl_context

    def create(index):
        tried.append(index)
        if (index or 0) > 2:
            raise Exception(f"requested device index {index}, but found 3 devices")
        if index != 1:
            raise Exception("eglInitialize failed (0x3001)")
        return real(0)

    monkeypatch.setattr(gl, "egl_devices", lambda: ["/dev/dri/card0", "", "/dev/dri/card1"])
    monkeypatch.setattr(gl, "egl_context", create)
    for variable in gl.DEVICE_VARIABLES:
        monkeypatch.delenv(variable, raising=False)
    return tried


def renderer():
    with gl.create_context() as context:
        return gl.describe(context)["renderer"]


def test_devices_are_those_that_egl_has():
    found = gl.devices()
    assert [one.index for one in found] == list(range(len(gl.egl_devices()))) != []
    assert renderer() in [one.name for one in found if not one.trouble]


def test_devices_that_draw_go_by_their_renderer_and_others_by_file_and_trouble(several):
    trouble = "eglInitialize failed (0x3001)"
    drawing = gl.devices()[1]
    assert gl.devices() == [(0, "/dev/dri/card0", trouble), drawing, (2, "/dev/dri/card1", trouble)]
    assert drawing.trouble == "" and drawing.name and not drawing.name.startswith("/dev")


def test_argument_wins_over_variables_and_ours_over_glcontexts(several, monkeypatch):
    gl.create_context(1).release()
    monkeypatch.setenv("GLCONTEXT_DEVICE_INDEX", "1")
    gl.create_context().release()
    monkeypatch.setenv("GLCONTEXT_DEVICE_INDEX", "2")
    monkeypatch.setenv("SONAR_GL_DEVICE", " 1 ")
    gl.create_context().release()
    monkeypatch.setenv("SONAR_GL_DEVICE", "0")
    gl.create_context(1).release()
    assert several == [1, 1, 1, 1]


def test_an_index_that_is_given_is_not_glcontexts_to_change(monkeypatch):
    monkeypatch.setenv("GLCONTEXT_DEVICE_INDEX", "99")  # heeded by glcontext above all arguments
    gl.create_context(0).release()


@pytest.mark.parametrize("index", [-1, 99, True, 1.0, "0"])
def test_an_index_that_is_none_names_the_devices(index):
    found = gl.devices()
    there = f"there {'is' if len(found) == 1 else 'are'} {len(found)}: 0 {found[0].name}"
    with pytest.raises(gl.Error) as why:
        gl.create_context(index)
    indices = "0" if len(found) == 1 else f"0 to {len(found) - 1}"
    message = f"the OpenGL device must be {indices} (got {index!r}; {there}"
    assert str(why.value).startswith(message)


@pytest.mark.parametrize("variable", gl.DEVICE_VARIABLES)
@pytest.mark.parametrize("text", ["3", "-1", "one", "1.0", "²", "9" * 30])
def test_a_variable_that_means_no_device_is_named(several, monkeypatch, variable, text):
    monkeypatch.setenv(variable, text)
    with pytest.raises(gl.Error) as why:
        gl.create_context()
    where = "--device or the variable " if variable == "SONAR_GL_DEVICE" else "the variable "
    message = f"the OpenGL device must be 0 to 2 (got {text}, by {where}{variable}; there are 3: "
    assert str(why.value).startswith(message + "0 /dev/dri/card0 (not to be used: eglInitialize failed")


def test_a_device_that_does_not_work_names_those_that_do(several):
    with pytest.raises(gl.Error) as why:
        gl.create_context()
    assert str(why.value) == (
        "OpenGL device 0 must work (got: eglInitialize failed (0x3001)); "
        f"give --device or SONAR_GL_DEVICE one that does: 1 {gl.devices()[1].name}"
    )


def test_doctor_lists_devices_and_which_is_used(several, monkeypatch, nothing_to_compile):
    monkeypatch.setenv("SONAR_GL_DEVICE", "1")
    ok, detail, _ = system_checks.check_egl()
    assert ok and detail == (
        "3 devices: 0 /dev/dri/card0 (not to be used: eglInitialize failed (0x3001)); "
        f"1 {renderer()}, chosen for OpenGL; 2 /dev/dri/card1 (not to be used: eglInitialize failed (0x3001))"
    )
    monkeypatch.setenv("SONAR_GL_DEVICE", "first")
    findings = {finding.what: finding for finding in examine()}
    assert findings["EGL"].ok and ", chosen for OpenGL" not in findings["EGL"].detail
    assert (
        findings["OpenGL"].ok is False
        and "got first, by --device or the variable SONAR_GL_DEVICE" in findings["OpenGL"].detail
    )


@pytest.mark.parametrize(
    "names, ok, told", [([], None, "0 devices"), (None, None, "cannot list its devices")]
)
def test_no_devices_and_an_egl_that_cannot_list_them(monkeypatch, names, ok, told):
    monkeypatch.setattr(gl, "egl_devices", lambda: names)
    found = system_checks.check_egl()
    assert found[:2] == (ok, told) and found[2]
    with pytest.raises(gl.Error, match=r"\(got 99; there are 0\)$"):
        gl.create_context(99)


@pytest.mark.slow
def test_commands_take_a_device(several, monkeypatch, tmp_path):
    monkeypatch.setenv("SONAR_GL_DEVICE", "2")
    ping = ("pylon", "--range", "8", "--bins", "40", "--tolerance", "0.2")
    for command in (
        ("render", *ping, "--format", "npz", "--out", str(tmp_path)),
        ("plan", *ping),
        ("verify", *ping, "--out", str(tmp_path)),
    ):
        del several[:]
        result = CliRunner().invoke(cli.main, [*command, "--device", "1"])
        assert result.exit_code in (0, 1) and set(several) == {1}, (command, result.output)
        assert os.environ["SONAR_GL_DEVICE"] == "2"  # as it was
    del several[:]
    result = CliRunner().invoke(cli.main, ["doctor", "--device", "1"])
    assert result.exit_code == 0 and f"1 {gl.devices()[1].name}, chosen for OpenGL; 2 " in result.output, (
        result.output
    )
    assert os.environ["SONAR_GL_DEVICE"] == "2"
    result = CliRunner().invoke(cli.main, ["plan", *ping, "--device", "7"])
    told = "error: the OpenGL device must be 0 to 2 (got 7, by --device or the variable SONAR_GL_DEVICE; there are 3: "
    assert result.exit_code == 2 and told in result.output


# --- scenes


def run(*arguments):
    return command_line.run("doctor", *arguments)


def write_world(path, more=""):
    path.write_text(f'<sdf version="1.9"><world name="w">{WALL}{BOX}{SENSOR}{more}</world></sdf>')
    return path


def test_scene_says_what_a_world_holds(tmp_path):
    sea = (
        '<model name="sea_surface"><link name="l"><visual name="v"><pose>0 0 2 0 0 0</pose><geometry><box>'
        "<size>99 99 0.01</size></box></geometry></visual></link></model>"
    )
    floor = "<include><uri>model://ground_plane</uri><pose>0 0 -4 0 0 0</pose></include>"
    status, out, err = run("--scene", write_world(tmp_path / "reef.sdf", sea + floor))
    assert (status, err) == (0, "")
    assert (
        out
        == f"""scene     reef
bodies    3, 42 triangles
extent    3.1 x 20 x 20 m, from 2.9 -10 -10 to 6 10 10, without 1 infinite plane
water     surface at z = 2 m
sonar     preset p900-45, as the scene states none

taken  sensor 'imaging_sonar' of model 'sonar'
       at 0 0 0 0 0 0
       states no sonar; preset p900-45

body                       size  middle, m  triangles  reflectivity
wall              1 x 20 x 20 m    5.5 0 0         12             1
box           0.2 x 0.2 x 0.2 m    3 0.5 0         12             1
ground_plane           infinite     0 0 -4         18           0.5

bodies are the collisions of links; visuals count where they alone exist, or alone have <laser_retro> or a sonar_gl tag

warnings
  {tmp_path}/reef.sdf: water and marks are no bodies, and are left out (sea_surface::l); the water's surface is taken \
from its shape, z = 2 m
  {tmp_path}/reef.sdf: no <laser_retro> in 1 of 3 bodies (ground_plane); their reflectivity is taken as 0.5
"""
    )


def test_scene_says_how_much_a_smooth_body_reflects_beside_what_it_scatters(tmp_path):
    """Of steel the lobe is nearly all: by its reflectivity alone it would look as dark as mud."""
    plate = (
        '<model name="plate"><link name="l"><collision name="c"><geometry><box/></geometry>'
        "<sonar_gl:material>steel</sonar_gl:material></collision></link></model>"
    )
    status, out, _ = run("--scene", write_world(tmp_path / "dock.sdf", plate))
    assert status == 0
    (row,) = (line for line in out.splitlines() if line.startswith("plate"))
    steel = material("steel")
    assert row.endswith(f"{steel.reflectivity:.3g}, lobe {steel.specular:.3g}, steel")


@pytest.mark.slow
def test_scene_lists_the_largest_of_many_bodies_and_counts_the_others(tmp_path):
    many = "".join(BODY.format(f"rock_{k}", f"{k} 3 0", f"0.{k + 10:03d} 0.01 0.01") for k in range(300))
    _, out, _ = run("--scene", write_world(tmp_path / "field.sdf", many))
    assert "bodies    302, 3624 triangles\n" in out
    names = re.findall(r"^((?:rock|wall|box)\S*) ", out, re.MULTILINE)
    assert names == ["wall", *(f"rock_{k}" for k in range(299, 260, -1))]
    assert "\nand 262 more bodies, which are smaller (--only NAME shows those of a name)\n" in out
    _, out, _ = run("--scene", tmp_path / "field.sdf", "--only", "rock_7")
    assert re.findall(r"^rock\S* ", out, re.MULTILINE) == ["rock_7 "]


def test_scene_is_read_as_other_commands_read_it(tmp_path):
    path = write_world(tmp_path / "a.sdf", "<include><uri>model://rock</uri></include>")
    status, out, err = run("--scene", path)
    assert (status, out) == (2, "") and "model://rock\n" in err
    status, out, err = run("--scene", path, "--skip-missing", "--without", "box", "--surface", 3)
    assert (status, err) == (0, "")
    assert "model://rock" in out and "surface at z = 3 m" in out and "\nbox " not in out
    (tmp_path / "shelf" / "rock").mkdir(parents=True)
    rock = BODY.format("rock", "0 0 0", "1 2 3")
    (tmp_path / "shelf" / "rock" / "model.sdf").write_text(f'<sdf version="1.9">{rock}</sdf>')
    assert "rock" in run("--scene", path, "--resource-path", tmp_path / "shelf")[1]


def test_scenes_without_bodies_or_sonar_and_options_without_a_scene(tmp_path):
    (tmp_path / "empty.sdf").write_text('<sdf version="1.9"><world name="w"/></sdf>')
    out = run("--scene", tmp_path / "empty.sdf")[1]
    assert out == (
        "scene     empty\nbodies    0, 0 triangles\nextent    none\nwater     none\n"
        "sonar     preset p900-45, as the scene states none\n"
        "pose      none in the scene; give the sonar's with --pose\n"
    )
    assert run("--skip-missing") == (
        2,
        "",
        "error: --skip-missing needs --scene (it says how a scene is read)\n",
    )


def test_scene_says_the_plumes_and_materials_of_a_bundled_scene():
    out = run("--scene", "diver_vertical")[1]
    assert "plume     'diver::bubbles' at " in out and re.search(
        "^floor .* 0.235, lobe 0.048, smooth_concrete$", out, re.MULTILINE
    )


def test_scene_says_the_bodies_and_the_water_of_the_harbour():
    status, out, err = run("--scene", "harbour")
    assert (status, err) == (0, "")
    assert "\nbodies    18, 4094 triangles\n" in out and "\nwater     surface at z = 0 m\n" in out
    rows = (("floor", "0.0133, medium_silt"), ("rubble", "0.524, rock"), ("tyre_flat", "0.00998, rubber"))
    for body, ends in rows:
        assert re.search(f"^{body} .* {ends}$", out, re.MULTILINE)


def test_shapes_that_echo_are_told_of_files_that_have_two_kinds(tmp_path):
    (tmp_path / "r.urdf").write_text(
        "<robot name='r'><link name='l'><visual><geometry><sphere radius='1'/></geometry></visual></link></robot>"
    )
    trimesh.creation.box((1, 1, 1)).export(tmp_path / "m.stl")
    told = "\nbodies are the collisions of links; "
    for scene, is_told in (("pylon", True), (f"{tmp_path}/r.urdf", True), (tmp_path / "m.stl", False)):
        status, out, _ = run("--scene", scene)
        assert status == 0 and (told in out) == is_told, out


@pytest.mark.parametrize("suffix", ["glb", "gltf", "stl"])
def test_a_gltf_that_is_turned_is_told(tmp_path, suffix):
    """A box 3 m high in the y-up axes of glTF; the other file keeps its coordinates."""
    made = trimesh.Scene(trimesh.creation.box((1, 3, 2))).export(file_type=suffix)
    files = (
        made if isinstance(made, dict) else {f"m.{suffix}": made}
    )  # a .gltf has a file of its numbers beside it
    for name, data in files.items():
        (tmp_path / name.replace("model", "m")).write_bytes(data)
    status, out, _ = run("--scene", tmp_path / f"m.{suffix}")
    told = "\nglTF is y-up: the file is turned to z-up, (x, y, z) of the file to (x, -z, y)\n" in out
    size = "1 x 3 x 2 m" if suffix == "stl" else "1 x 2 x 3 m"
    assert status == 0 and told == (suffix != "stl") and size in out, out


def test_a_scene_in_millimetres_is_told(tmp_path):
    """A tank of 6 x 4 x 3 m, and a terrain of 2 km, which may well be in metres."""
    told = (
        "\n  the scene measures 6000 x 4000 x 3000 m: if it was made in centimetres or millimetres, scale it by "
        "0.01 or 0.001 (<scale>0.001 0.001 0.001</scale> of a mesh in SDF, mesh.apply_scale(0.001) in Python)\n"
    )
    for size, is_told in (((6000, 4000, 3000), True), ((6, 4, 3), False), ((2000, 2000, 90), False)):
        trimesh.creation.box(size).export(tmp_path / "m.stl")
        status, out, _ = run("--scene", tmp_path / "m.stl")
        assert status == 0 and (told in out) == is_told and ("the scene measures" in out) == is_told, out


def test_a_sonar_above_the_water_is_told(tmp_path):
    path = write_world(tmp_path / "a.sdf")
    assert "above" not in run("--scene", path, "--surface", 1)[1]
    out = run("--scene", path, "--surface", -3)[1]
    assert (
        "\nwarnings\n" in out and "  the sonar at z = 0 m is above the water's surface at z = -3 m, " in out
    )


def test_a_sonar_inside_a_body_is_told(tmp_path):
    hull = (
        '<model name="hull"><link name="l"><collision name="c"><geometry><sphere><radius>0.4</radius></sphere>'
        "</geometry></collision></link></model>"
    )
    out = run("--scene", write_world(tmp_path / "a.sdf", hull))[1]
    assert "\nwarnings\n" in out and "  the sonar at (0, 0, 0) m is inside body 'hull', " in out
    assert "inside" not in run("--scene", write_world(tmp_path / "a.sdf"))[1]


def test_the_pose_of_a_sonar_that_no_sensor_gives_is_shown(tmp_path):
    """As of a MuJoCo model, whose site is the sonar."""
    (tmp_path / "m.xml").write_text(
        "<mujoco><worldbody><site name='sonar' pos='0 0 1.5'/><geom size='1'/></worldbody></mujoco>"
    )
    status, out, _ = run("--scene", tmp_path / "m.xml")
    assert status == 0 and "pose      0 0 1.5 0 0 0" in out


@pytest.mark.parametrize(
    ("path", "message"),
    [
        ("nowhere/a.json", "cannot write 'nowhere/a.json': the folder 'nowhere' does not exist"),
        ("folder", "cannot write 'folder': must be the name of a file (got a folder)"),
        ("pipe", "cannot write 'pipe': must be the name of a file (got a named pipe)"),
        ("/dev/null", "cannot write '/dev/null': must be the name of a file (got a device)"),
        (
            "output",
            "cannot write 'output': must be the name of a file (got that of an output of the process)",
        ),
        ("/proc/a.json", "cannot write '/proc/a.json': no such file or directory"),
        ("", "--report must be a path (got an empty text; is a variable of the shell empty?)"),
    ],
)
def test_a_report_that_cannot_be_written_is_told_before_the_work(tmp_path, monkeypatch, path, message):
    """The work takes a minute; a named pipe, or /dev/null, was replaced by a file."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(doctor, "examine", lambda: pytest.fail("it works before it looks"))
    Path("folder").mkdir()
    os.mkfifo("pipe")
    Path("open.txt").write_text("open")
    with open("open.txt") as file:  # as /dev/stdout is where the output goes to a file
        os.symlink(f"/proc/self/fd/{file.fileno()}", "output")
        assert command_line.run("doctor", "--report", path) == (2, "", f"error: {message}\n")
    assert sorted(os.listdir()) == ["folder", "open.txt", "output", "pipe"]


def test_places_far_from_the_origin_are_told_to_a_decimetre(tmp_path):
    """As in UTM, where four digits are kilometres."""
    box = trimesh.creation.box((2, 2, 2))
    box.apply_translation((500000, 6000000.25, -20))
    box.export(tmp_path / "box.obj")
    _, out, _ = run("--scene", tmp_path / "box.obj")
    assert "extent    2 x 2 x 2 m, from 499999 5999999.2 -21 to 500001 6000001.2 -19\n" in out
    assert "box   2 x 2 x 2 m  500000 6000000.2 -20 " in out
