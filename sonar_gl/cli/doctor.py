"""The command `doctor`: checks of everything that a ping needs, each with its cure.

Imports no package that may be missing; the checks that need such packages are in `system_checks`.
"""

from __future__ import annotations

import importlib
import importlib.metadata
import json
import os
import platform
import sys
from pathlib import Path
from typing import NamedTuple

from sonar_gl import cli
from sonar_gl._version import __version__
from sonar_gl.core.atomic_file import atomic_write
from sonar_gl.core.data_files import data_folder
from sonar_gl.core.errors import Error
from sonar_gl.core.extras import install_command, pip_install

PACKAGES = (  # name of the import, name of the package
    ("numpy", "numpy"),
    ("numba", "numba"),
    ("moderngl", "moderngl"),
    ("glcontext", "glcontext"),
    ("trimesh", "trimesh"),
    ("cv2", "opencv-contrib-python-headless"),
    ("click", "click"),
    ("PIL", "pillow"),
    ("defusedxml", "defusedxml"),
    ("lxml", "lxml"),
    ("xacro", "xacro"),
    ("mapbox_earcut", "mapbox_earcut"),
)
# of the environment: what chooses a driver
REPORTED_VARIABLES = (
    "SONAR_GL_",
    "MESA_",
    "GALLIUM_",
    "LIBGL_",
    "LP_",
    "EGL_",
    "GLCONTEXT_",
    "__EGL_",
    "__GLX_",
    "VK_",
)
INSTALL_AGAIN = "install sonar_gl again"


class Finding(NamedTuple):
    """The result of one check: `ok` is None if something optional is missing; `cure` is one sentence or ''."""

    what: str
    ok: bool | None
    detail: str
    cure: str = ""


def examine() -> list[Finding]:
    """Check everything that a ping needs, in the order in which it needs it; a failed check raises nothing."""
    python = f"{platform.python_version()}, {platform.system()} {platform.machine()}, {sys.prefix}"
    found = [Finding("sonar_gl", True, __version__), Finding("Python", True, python)]
    found += [check_package(module, name) for module, name in PACKAGES]
    for what, check, cure in (
        ("pyrender", lambda: _system_checks().check_pyrender(), pip_install("pyrender")),
        ("embreex", check_embreex, install_command("reference")),
        ("shaders", check_shaders, INSTALL_AGAIN),
        ("scenes", lambda: _system_checks().check_scenes(), INSTALL_AGAIN),
        ("EGL", lambda: _system_checks().check_egl(), ""),
        ("OpenGL", lambda: _system_checks().check_opengl(), ""),  # the message holds the cure
        ("engine", lambda: _system_checks().check_raster_engine(), ""),
        ("compiled functions", lambda: _system_checks().check_compiled_functions(), ""),
        (
            "known scene",
            lambda: _system_checks().check_known_scene(),
            "correct the failures above; if there are none, report this",
        ),
    ):
        try:
            found.append(Finding(what, *check()))
        except ImportError as why:
            found.append(Finding(what, False, f"not tried ({why})"))
        except Exception as why:  # the check reports whatever does not work
            found.append(Finding(what, False, " ".join(str(why).split()), cure))
    return found


def _system_checks():
    """Return the module `system_checks`.

    Raises ImportError where it cannot be loaded, since a package is missing, or since Numba may not compile.
    """
    try:
        return cli.system_checks
    except Error as why:
        raise ImportError(str(why)) from None


def report_text(found: list[Finding]) -> str:
    """Return the findings in words, with the cures of those that are not ok."""
    marks, width = {True: "ok", False: "FAIL", None: "-"}, max(len(finding.what) for finding in found)
    lines = []
    for what, ok, detail, cure in found:
        lines.append(f"{marks[ok]:4}  {what:{width}}  {detail}")
        if ok is not True and cure:
            lines.append(f"{'':4}  {'':{width}}  {cure}")
    failed = sum(finding.ok is False for finding in found)
    return "\n".join([*lines, f"{failed} of {len(found)} failed" if failed else "all is well"])


def write_report(path: Path, found: list[Finding]) -> None:
    """Write the findings and what is measured of the driver to a JSON file, which a user may send in."""
    report = {"sonar_gl": __version__, "python": sys.version, "platform": platform.platform()}
    report["environment"] = {
        name: value for name, value in os.environ.items() if name.startswith(REPORTED_VARIABLES)
    }
    report["checks"] = [finding._asdict() for finding in found]
    try:
        report |= cli.driver_report.measure()
    except (ImportError, Error) as why:
        report["failed"] = str(why)
    with atomic_write(path) as temporary:
        temporary.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")


def check_package(module: str, name: str) -> Finding:
    try:
        loaded = importlib.import_module(module)
    except Exception as why:  # a missing system library raises one of several kinds
        return Finding(name, False, f"cannot be imported ({why})", pip_install(name))
    try:
        return Finding(name, True, importlib.metadata.version(name))
    except importlib.metadata.PackageNotFoundError:  # another build of it, such as opencv-python
        return Finding(name, True, str(getattr(loaded, "__version__", "of unknown version")))


def check_embreex():
    """Check the package that casts rays, which is optional."""
    _, ok, detail, _ = check_package("embreex", "embreex")
    return ok or None, detail, f"only reference_ping needs it: {install_command('reference')}"


def check_shaders():
    folder = data_folder("shaders")
    count = sum(path.suffix in (".vert", ".geom", ".frag", ".glsl") for path in folder.iterdir())
    return count > 0, f"{count} in {folder}", INSTALL_AGAIN
