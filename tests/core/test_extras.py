"""Messages about a missing optional extra."""

import json
import re
import shlex
import shutil
import sys
from importlib.metadata import PackageNotFoundError
from pathlib import Path

import pytest

import sonar_gl
from sonar_gl.core import extras
from tests.support.processes import python

ROOT = Path(__file__).resolve().parents[2]
PIP = f"{shlex.quote(sys.executable)} -m pip install"  # of this environment, not of the system
METADATA = [
    "numpy<3,>=1.26",
    'rosbags>=0.11; extra == "ros"',
    "sonar_gl[ros,reference]; extra == 'batch'",
    "zarr>=3.1; extra == 'batch'",
    'embreex>=4.4; python_version > "3" and extra == "reference"',
]


def test_a_checkout_is_installed_in_place():
    assert extras.install_command("batch") == f"cd {ROOT} && {PIP} -e '.[batch]'"
    error = extras.missing_extra("batch", "a store needs zarr (got no module zarr)")
    assert type(error) is sonar_gl.Error
    assert str(error) == (
        f"a store needs zarr (got no module zarr); to add it: cd {ROOT} && {PIP} -e '.[batch]'"
    )


def test_without_a_checkout_the_command_installs_the_requirements(monkeypatch, tmp_path):
    monkeypatch.setattr(extras, "__file__", str(tmp_path / "sonar_gl" / "core" / "extras.py"))
    monkeypatch.setattr("importlib.metadata.requires", lambda name: METADATA)
    monkeypatch.setattr(extras, "_installed_from", lambda: None)
    assert extras.install_command("batch") == (
        f"""{PIP} 'rosbags>=0.11' 'embreex>=4.4; python_version > "3"' 'zarr>=3.1'"""
    )
    assert extras.install_command("unknown") == "install what its extra 'unknown' requires"

    def missing(name):
        raise PackageNotFoundError(name)

    monkeypatch.setattr("importlib.metadata.requires", missing)
    assert extras.install_command("batch") == "install what its extra 'batch' requires"


@pytest.mark.parametrize("folder", ["a checkout", "an_archive.whl", None])
def test_what_was_installed_from_a_checkout_takes_the_extra_from_there(monkeypatch, tmp_path, folder):
    """As the README does; pip notes the folder or file that it installed from."""
    checkout = tmp_path / "a checkout"
    for name in ("pyproject.toml", "setup.cfg", "sonar_gl/_version.py"):
        (checkout / name).parent.mkdir(parents=True, exist_ok=True)
        (checkout / name).touch()
    installed = tmp_path / "site-packages"
    info = installed / "sonar_gl-0.2.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(
        "Metadata-Version: 2.1\nName: sonar_gl\nVersion: 0.2.0\nRequires-Dist: zarr; extra == 'batch'\n"
    )
    if folder is not None:
        url = (tmp_path / folder).as_uri()
        (info / "direct_url.json").write_text(json.dumps({"url": url, "dir_info": {}}))
    monkeypatch.setattr(extras, "__file__", str(installed / "sonar_gl" / "core" / "extras.py"))
    monkeypatch.syspath_prepend(installed)
    command = f"cd '{checkout}' && {PIP} '.[batch]'"
    assert extras.install_command("batch") == (command if folder == "a checkout" else f"{PIP} zarr")
    shutil.rmtree(checkout)
    assert extras.install_command("batch") == f"{PIP} zarr"


@pytest.mark.parametrize("marker", ['({where}) and extra == "live"', 'extra == "live" and ({where})'])
def test_the_command_leaves_out_what_is_not_for_this_machine(monkeypatch, marker):
    """As Cyclone DDS, of which there are no wheels for ARM: pip would install nothing at all."""
    where = 'python_version < "3.14" and (sys_platform != "linux" or platform_machine == "x86_64")'
    entry = f"cyclonedds>=11.0.1; {marker.format(where=where)}"
    monkeypatch.setattr("importlib.metadata.requires", lambda name: [entry])
    assert extras.requirements("live") == [f"cyclonedds>=11.0.1; ({where})"]


@pytest.mark.slow
@pytest.mark.parametrize("missing", ["fsspec.core", "pydantic", "zarr", "pycocotools", "tqdm"])
def test_the_command_of_batches_names_its_extra(missing):
    code = f"""import sys
from sonar_gl.cli.main import main
sys.modules[{missing!r}] = None
main(["batch", "job.toml"])"""
    needs = f"batch needs more packages (got no module {missing})"
    found = python("-c", code)
    assert found.stderr == f"error: {needs}; to add it: {extras.install_command('batch')}\n"
    assert found.returncode == 2


def test_every_extra_has_requirements_in_the_metadata():
    for extra in ("reference", "teos10", "cluster", "ros", "batch"):
        found = extras.requirements(extra)
        assert found and not [name for name in found if name.startswith("sonar")]
    assert set(extras.requirements("ros")) < set(extras.requirements("batch"))


def test_no_message_has_pip_look_for_the_package_on_an_index():
    files = list((ROOT / "sonar_gl").rglob("*.py"))
    assert files
    for path in files:
        assert not re.search(r"pip install\W+sonar[-_.]gl", path.read_text(encoding="utf-8")), path
