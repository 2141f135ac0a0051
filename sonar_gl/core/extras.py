"""Optional extras, and the command that adds one to this installation."""

from __future__ import annotations

import re
import shlex
import sys
from importlib.metadata import PackageNotFoundError, requires
from pathlib import Path

from sonar_gl.core.errors import Error


def pip_install(what: str) -> str:
    """Return the shell command that installs something into the environment of this Python.

    A bare `pip` may be the system's, which on Debian refuses to install anything.
    """
    return f"{shlex.quote(sys.executable)} -m pip install {what}"


def missing_extra(extra: str, why: str) -> Error:
    """Return the error for a missing extra: `why`, and how to add the extra to this installation."""
    return Error(f"{why}; to add it: {install_command(extra)}")


def install_command(extra: str) -> str:
    """Return the shell command that adds an extra to this installation.

    From a checkout it installs the extra in place; otherwise it installs the requirements of the extra by
    their own names. It never has pip look for this package on an index, where the name may be another's.
    """
    checkout = Path(__file__).resolve().parents[2]
    if all((checkout / name).is_file() for name in ("pyproject.toml", "setup.cfg")):
        editable = f"-e '.[{extra}]'"
        return f"cd {shlex.quote(str(checkout))} && {pip_install(editable)}"
    found = requirements(extra)
    return pip_install(shlex.join(found)) if found else f"install what its extra {extra!r} requires"


def requirements(extra: str) -> list[str]:
    """Return what an extra requires beyond the package itself; empty where the package has no metadata."""
    try:
        entries = requires("sonar_gl") or []
    except PackageNotFoundError:
        return []
    found = []
    for entry in entries:
        name, _, marker = (text.strip() for text in entry.partition(";"))
        if re.search(rf"extra\s*==\s*['\"]{extra}['\"]", marker):
            inner = re.fullmatch(r"sonar[-_.]gl\s*\[(.*)\]", name)  # an extra may contain others
            if inner is None:
                found.append(name)
            else:
                found += (each for other in inner[1].split(",") for each in requirements(other.strip()))
    return list(dict.fromkeys(found))
