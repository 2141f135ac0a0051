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
