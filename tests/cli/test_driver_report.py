"""`sonar-gl doctor --report`: a file about the driver that users of graphics cards can send in."""

import json

import pytest
from click.testing import CliRunner

from sonar_gl import __version__
from sonar_gl.cli import doctor, driver_report, system_checks
from sonar_gl.cli import main as cli
from sonar_gl.cli.doctor import Finding
from sonar_gl.gl import context as gl
from sonar_gl.raster.opengl import buffers
from tests.support.noisy_shaders import noisy_shaders


@pytest.fixture
def report(monkeypatch, tmp_path):
    """Function () -> the result of the command, and the report; of one check and one scene."""
    monkeypatch.setattr(doctor, "examine", lambda: [Finding("known scene", True, "wall at 5 m")])
    monkeypatch.setattr(driver_report, "bundled_scenes", lambda: ["pylon"])
    monkeypatch.setenv("MESA_DEBUG", "silent")

    def run():
        path = tmp_path / "report.json"
        result = CliRunner().invoke(cli.main, ["doctor", "--report", str(path)])
        return result, json.loads(path.read_text()) if path.exists() else None

    return run


@pytest.mark.slow
def test_the_report_holds_driver_noise_and_times(report):
    result, found = report()
    assert result.exit_code == 0 and "wrote " in result.output
    with gl.create_context() as context:
        told = json.loads(json.dumps(gl.describe(context)))
        limit = context.info["GL_MAX_RENDERBUFFER_SIZE"]
    assert {key: found["driver"][key] for key in told} == told
    assert found["driver"]["limits"]["GL_MAX_RENDERBUFFER_SIZE"] == limit
    assert found["sonar_gl"] == __version__ and found["environment"]["MESA_DEBUG"] == "silent"
    assert found["checks"] == [{"what": "known scene", "ok": True, "detail": "wall at 5 m", "cure": ""}]
    assert 0 < max(found["noise_2_to_the_-24"].values()) < driver_report.MAX_NOISE
    ((name, scene),) = found["scenes"].items()
    assert name == "pylon" and 0 < scene["ms_least"] <= scene["ms_median"] and scene["rows"] > 20


def test_a_part_that_fails_is_in_the_report(report, monkeypatch):
    def fail():
        raise RuntimeError("no scenes on this card")

    monkeypatch.setattr(driver_report, "scene_times", fail)
    result, found = report()
    assert result.exit_code == 0
    assert (
        found["scenes"] == {"failed": "RuntimeError: no scenes on this card"} and found["driver"]["renderer"]
    )


def test_a_report_that_cannot_be_written(monkeypatch, tmp_path):
    monkeypatch.setattr(doctor, "examine", lambda: [Finding("known scene", True, "wall at 5 m")])
    monkeypatch.setattr(driver_report, "measure", dict)
    result = CliRunner().invoke(cli.main, ["doctor", "--report", str(tmp_path / "none" / "report.json")])
    assert result.exit_code == 2 and "does not exist" in result.output


@pytest.mark.parametrize("units", [8, pytest.param(256, marks=pytest.mark.slow)])
def test_the_noise_of_a_driver_is_measured(units, monkeypatch, tmp_path, opengl_engine):
    """Of some thousand samples one has nearly the greatest noise, and a difference of two nearly twice that.

    Rows are sheared, so that slopes along v take some of the noise along u, too. The driver adds its own. The known
    scene is wrong where noise makes edges.
    """
    monkeypatch.setenv(
        "SONAR_GL_SOFTWARE", "1"
    )  # on a card slopes come from the corners of triangles, without noise
    own = driver_report.sample_noise()
    folder = noisy_shaders(tmp_path, units)
    monkeypatch.setattr(buffers, "data_folder", lambda _: folder)
    noise = driver_report.sample_noise()
    assert 0.95 * units - own.depth < noise.depth < units + own.depth + 1
    assert 1.6 * units - own.slopes < noise.slopes < 3 * units + own.slopes + 1
    ok, detail, _ = system_checks.check_known_scene()
    assert ok == (units < driver_report.MAX_NOISE) and "samples of a plane within " in detail
