"""What is built and installed: nothing that a user needs is left behind in the checkout."""

import json
import os
import shutil
import subprocess
import sys
import tarfile
from configparser import ConfigParser
from functools import cache
from importlib import metadata
from pathlib import Path
from zipfile import ZipFile

import pytest

import sonar_gl

ROOT = Path(__file__).resolve().parents[2]
FOLDERS = {
    "sonar_gl": "sonar_gl",
    "sonar_gl/shaders": "shaders",
    "sonar_gl/scenes": "scenes",
}  # installed: kept
NOT_SOURCE = shutil.ignore_patterns(
    ".git", ".venv", ".*_cache", "__pycache__", "*.egg-info", "build", "dist", "out"
)

BUILD = "import sys; from setuptools import build_meta; build_meta.build_{}(sys.argv[1])"
LOOK_AROUND = """
import json, sonar_gl
from sonar_gl.scene.load import bundled_scenes; from sonar_gl.core.data_files import data_folder
print(json.dumps({
    "home": sonar_gl.__file__,
    "version": sonar_gl.__version__,
    "shaders": str(data_folder("shaders")),
    "scenes": [str(path) for path in bundled_scenes().values()],
    "bodies": [body.name for body in sonar_gl.load_scene("pylon").bodies],
    "presets": list(sonar_gl.presets()),
}))
"""


def run(*command, **options):
    done = subprocess.run([str(word) for word in command], capture_output=True, text=True, **options)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def sources():
    """Installed name -> file, of everything in the folders that are to be installed."""
    return {
        f"{installed}/{path.relative_to(ROOT / kept).as_posix()}": path
        for installed, kept in FOLDERS.items()
        for path in (ROOT / kept).rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }


@pytest.fixture(scope="module")
def sdist(tmp_path_factory):
    """The source archive, built in a copy so that the checkout stays clean."""
    folder = tmp_path_factory.mktemp("sdist")
    copy = shutil.copytree(ROOT, folder / "copy", ignore=NOT_SOURCE)
    run(sys.executable, "-c", BUILD.format("sdist"), folder, cwd=copy)
    return next(folder.glob("*.tar.gz"))


@pytest.fixture(scope="module")
def wheel(sdist, tmp_path_factory):
    """The wheel, built from the source archive."""
    folder = tmp_path_factory.mktemp("wheel")
    with tarfile.open(sdist) as archive:
        archive.extractall(folder)
    (source,) = folder.iterdir()
    run(sys.executable, "-c", BUILD.format("wheel"), folder, cwd=source)
    return next(folder.glob("*.whl"))


@pytest.fixture(scope="module")
def installed(wheel, tmp_path_factory):
    """A folder with the wheel unpacked as pip does it, without what it depends on."""
    folder = tmp_path_factory.mktemp("installed")
    pip = (sys.executable, "-m", "pip", "--disable-pip-version-check")
    run(*pip, "install", "--no-deps", "--no-index", "--no-compile", "--target", folder, wheel)
    return folder


@cache
def look_around(folder):
    """What the package in `folder` finds when asked from elsewhere."""
    environment = {**os.environ, "PYTHONPATH": str(folder)}
    return json.loads(run(sys.executable, "-c", LOOK_AROUND, cwd=Path(folder).anchor, env=environment))


def test_every_package_is_listed():
    setup = ConfigParser()
    setup.read(ROOT / "setup.cfg", encoding="utf-8")
    packages = {
        ".".join((installed.replace("/", "."), *path.parent.relative_to(ROOT / kept).parts))
        for installed, kept in FOLDERS.items()
        for path in (ROOT / kept).rglob("__init__.py")
    }
    assert set(setup["options"]["packages"].split()) == packages, "list the packages in setup.cfg"


@pytest.mark.slow
def test_the_wheel_holds_every_file_of_the_package_and_nothing_else(wheel):
    held = {name for name in ZipFile(wheel).namelist() if ".dist-info/" not in name}
    assert held == set(sources())


@pytest.mark.slow
def test_the_source_archive_holds_what_builds_and_checks_it(sdist):
    with tarfile.open(sdist) as archive:
        held = {name.partition("/")[2] for name in archive.getnames()}
    here = {
        path.relative_to(ROOT).as_posix()
        for folder in (*FOLDERS.values(), "docs", "tests", "tools", ".ci")
        for path in (ROOT / folder).rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    files = {"setup.cfg", "pyproject.toml", "ruff.toml", "LICENSE"}
    pages = {"README.md", "CHANGELOG.md", "CONTRIBUTING.md"}
    assert here | files | pages <= held


@pytest.mark.slow
def test_the_installed_wheel_finds_its_files_from_anywhere(installed):
    found = look_around(installed)
    home = installed / "sonar_gl"
    assert Path(found["home"]) == home / "__init__.py"
    assert Path(found["shaders"]) == home / "shaders"
    assert {Path(path) for path in found["scenes"]} == set((home / "scenes").glob("*.sdf")) != set()
    assert "p900-45" in found["presets"]
    assert found["bodies"]


def test_the_checkout_finds_its_files_from_anywhere():
    found = look_around(ROOT)
    assert Path(found["shaders"]) == ROOT / "shaders"
    assert {Path(path) for path in found["scenes"]} == set((ROOT / "scenes").glob("*.sdf"))


def test_a_zip_archive_is_said_to_be_no_place_for_the_package(tmp_path):
    """Its shaders, scenes and machine code are files; lazy_loader told of a non-existent stub."""
    archive = tmp_path / "all.zip"
    with ZipFile(archive, "w") as packed:
        for name, path in sources().items():
            packed.write(path, name)
    environment = {**os.environ, "PYTHONPATH": str(archive)}
    command = [sys.executable, "-c", "import sonar_gl"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, env=environment)
    (last,) = done.stderr.splitlines()[-1:]
    assert last.startswith(
        "ImportError: sonar_gl must lie in a folder with all of its files, as pip installs it ("
    )


@pytest.mark.slow
def test_versions_agree(installed):
    (distribution,) = metadata.distributions(name="sonar_gl", path=[str(installed)])
    assert distribution.version == look_around(installed)["version"] == sonar_gl.__version__


@pytest.mark.slow
def test_the_command_is_installed(installed):
    (distribution,) = metadata.distributions(name="sonar_gl", path=[str(installed)])
    (command,) = distribution.entry_points.select(group="console_scripts")
    assert (command.name, command.value) == ("sonar-gl", "sonar_gl.__main__:main")
    environment = {**os.environ, "PYTHONPATH": str(installed)}
    listed = run(
        sys.executable, installed / "bin" / "sonar-gl", "scenes", cwd=installed.anchor, env=environment
    )
    assert "pylon" in listed
