"""What the doctor finds, well and ill."""

import ctypes
import sys

import moderngl
import pytest
from click.testing import CliRunner

from sonar_gl import cli, doctor, gl, load
from sonar_gl.doctor import examine


@pytest.fixture(scope="module")
def well():
    return {finding.what: finding for finding in examine()}


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


@pytest.mark.parametrize(
    "renderer, software",
    [
        ("llvmpipe (LLVM 15.0.6, 256 bits)", True),
        ("Google SwiftShader", True),
        ("NVIDIA H200/PCIe/SSE2", False),
        ("Mesa Intel(R) UHD Graphics 620 (KBL GT2)", False),
    ],
)
def test_software_renderers_are_known(renderer, software):
    assert bool(doctor.SOFTWARE.search(renderer)) == software


def test_known_scene_tells_how_well(well):
    assert well["known scene"].detail.startswith("wall at 5 m: 1.00")
    assert "box to port at 7.91 m, +2.9 deg: found at 7.90 m, +" in well["known scene"].detail


def test_known_scene_finds_a_wrong_drawing(monkeypatch):
    from sonar_gl.simulator import Simulator

    ping = Simulator.ping

    def mirrored(self, *args, **more):
        out = ping(self, *args, **more)
        return type(out)(out.intensity[::-1], out.azimuth_rad, out.range_m, pose=out.pose, meta=out.meta)

    monkeypatch.setattr(Simulator, "ping", mirrored)
    ok, detail, cure = doctor._known_scene()
    assert ok is False and ", -2." in detail and "driver draws wrongly" in cure


def test_missing_package_has_its_cure(monkeypatch):
    monkeypatch.setitem(sys.modules, "trimesh", None)
    finding = doctor._package("trimesh", "trimesh")
    assert finding.ok is False and finding.cure == "pip install trimesh"
    assert finding.detail.startswith("cannot be imported (")


def test_optional_packages_may_be_missing(monkeypatch):
    monkeypatch.setitem(sys.modules, "embreex", None)
    monkeypatch.setitem(sys.modules, "pyrender", None)
    for what, examiner in (("reference_ping", doctor._embreex), ("scenes of pyrender", doctor._pyrender)):
        ok, _, cure = examiner()
        assert ok is None and cure.startswith(f"only {what} need")


def test_no_opengl_is_told_with_its_cure_and_status_1(monkeypatch):
    def none(*_args, **_more):
        raise Exception("libEGL.so not loaded")

    def no_library(name, *_args, **_more):
        raise OSError(f"{name}: cannot open shared object file")

    monkeypatch.setattr(moderngl, "create_context", none)
    monkeypatch.setattr(ctypes, "CDLL", no_library)
    monkeypatch.setattr(doctor, "PACKAGES", ())
    result = CliRunner().invoke(cli.main, ["doctor"])
    assert result.exit_code == 1
    lines = [" ".join(line.split()) for line in result.output.splitlines()]
    at = lines.index("FAIL EGL libEGL.so.1: cannot open shared object file")
    assert lines[at + 1] == "on Debian or Ubuntu: apt-get install libegl1 libgl1"
    assert lines[at + 2].startswith(
        "FAIL OpenGL OpenGL must be reachable through EGL, without a display (got: "
    )
    assert lines[at + 3] == "FAIL known scene not tried without OpenGL"
    assert lines[-1] == "3 of 10 found wanting"


def test_command_is_quiet_about_cures_when_all_is_well(monkeypatch, well):
    monkeypatch.setattr(doctor, "examine", lambda: list(well.values()))
    result = CliRunner().invoke(cli.main, ["doctor"])
    assert result.exit_code == 0
    lines = result.output.splitlines()
    assert lines[-1] == "all is well"
    assert all(line.startswith(("ok ", "-  ")) for line in lines[:-1] if line[0] != " ")
    assert "driver draws wrongly" not in result.output


def test_missing_folder_is_told(monkeypatch):
    def none(name):
        raise load.Error(f"the folder {name!r} is nowhere")

    monkeypatch.setattr(load, "data_folder", none)
    findings = {finding.what: finding for finding in examine()}
    assert findings["shaders"] == (
        "shaders",
        False,
        "the folder 'shaders' is nowhere",
        "install sonar_gl again",
    )
    assert findings["scenes"].ok is False


def test_cache_that_cannot_be_kept_is_told(monkeypatch):
    monkeypatch.setattr(doctor.os, "access", lambda *_: False)
    ok, detail, cure = doctor._numba_cache()
    assert ok is None and detail.startswith("cannot be kept in ") and "NUMBA_CACHE_DIR" in cure


# --- devices


@pytest.fixture
def several(monkeypatch):
    """A machine with three devices, of which the second alone draws; gives the indices that are tried."""
    tried, real = [], gl._create

    def create(index):
        tried.append(index)
        if (index or 0) > 2:
            raise Exception(f"requested device index {index}, but found 3 devices")
        if index != 1:
            raise Exception("eglInitialize failed (0x3001)")
        return real(0)

    monkeypatch.setattr(gl, "egl_devices", lambda: ["/dev/dri/card0", "", "/dev/dri/card1"])
    monkeypatch.setattr(gl, "_create", create)
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
    message = f"the OpenGL device must be the index of an EGL device (got {index!r}; {there}"
    assert str(why.value).startswith(message)


@pytest.mark.parametrize("variable", gl.DEVICE_VARIABLES)
@pytest.mark.parametrize("text", ["3", "-1", "one", "1.0", "²", "9" * 30])
def test_a_variable_that_means_no_device_is_named(several, monkeypatch, variable, text):
    monkeypatch.setenv(variable, text)
    with pytest.raises(gl.Error) as why:
        gl.create_context()
    message = f"the OpenGL device must be the index of an EGL device (got {variable}={text}; there are 3: "
    assert str(why.value).startswith(message + "0 /dev/dri/card0 (not to be used: eglInitialize failed")


def test_a_device_that_does_not_work_names_those_that_do(several):
    with pytest.raises(gl.Error) as why:
        gl.create_context()
    assert str(why.value) == (
        "OpenGL device 0 must work (got: eglInitialize failed (0x3001)); "
        f"set SONAR_GL_DEVICE to one that does: 1 {gl.devices()[1].name}"
    )


def test_doctor_lists_devices_and_which_is_used(several, monkeypatch):
    monkeypatch.setenv("SONAR_GL_DEVICE", "1")
    ok, detail, _ = doctor._egl()
    assert ok and detail == (
        "3 devices: 0 /dev/dri/card0 (not to be used: eglInitialize failed (0x3001)); "
        f"1 {renderer()}, used; 2 /dev/dri/card1 (not to be used: eglInitialize failed (0x3001))"
    )
    monkeypatch.setenv("SONAR_GL_DEVICE", "first")
    findings = {finding.what: finding for finding in examine()}
    assert findings["EGL"].ok and ", used" not in findings["EGL"].detail
    assert findings["OpenGL"].ok is False and "got SONAR_GL_DEVICE=first" in findings["OpenGL"].detail


@pytest.mark.parametrize(
    "names, ok, told", [([], False, "0 devices"), (None, None, "cannot list its devices")]
)
def test_no_devices_and_an_egl_that_cannot_list_them(monkeypatch, names, ok, told):
    monkeypatch.setattr(gl, "egl_devices", lambda: names)
    found = doctor._egl()
    assert found[:2] == (ok, told) and found[2]
    with pytest.raises(gl.Error, match=r"\(got 99; there are 0\)$"):
        gl.create_context(99)


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
        assert doctor.os.environ["SONAR_GL_DEVICE"] == "2"  # as it was
    result = CliRunner().invoke(cli.main, ["plan", *ping, "--device", "7"])
    told = "error: the OpenGL device must be the index of an EGL device (got SONAR_GL_DEVICE=7; there are 3: "
    assert result.exit_code == 2 and told in result.output
