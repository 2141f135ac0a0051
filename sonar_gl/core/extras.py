"""Optional extras, and the command that adds one to this installation.

What reads the metadata of packages is imported where it is needed: nearly every process loads this module, and that
takes 20 ms.
"""

from __future__ import annotations

import json
import re
import shlex
import sys
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

    From a checkout, and where the checkout that this was installed from is still there, it installs the extra from
    there; otherwise it installs the requirements of the extra by their own names. It never has pip look for this
    package on an index, where the name may be another's.
    """
    here, origin = Path(__file__).resolve().parents[2], _installed_from()
    named = f"'.[{extra}]'"
    if _is_checkout(here):
        return f"cd {shlex.quote(str(here))} && {pip_install(f'-e {named}')}"
    if origin is not None and _is_checkout(origin):
        return f"cd {shlex.quote(str(origin))} && {pip_install(named)}"
    found = requirements(extra)
    return pip_install(shlex.join(found)) if found else f"install what its extra {extra!r} requires"


def _is_checkout(folder: Path) -> bool:
    return all((folder / name).is_file() for name in ("pyproject.toml", "setup.cfg", "sonar_gl/_version.py"))


def _installed_from() -> Path | None:
    """Return the folder that pip installed this package from, as its metadata say; None if it was no folder."""
    from importlib.metadata import PackageNotFoundError, distribution
    from urllib.parse import urlparse
    from urllib.request import url2pathname

    try:
        text = distribution("sonar_gl").read_text("direct_url.json")
        url = urlparse(json.loads(text or "{}").get("url", ""))
    except (PackageNotFoundError, ValueError, AttributeError):
        return None
    return Path(url2pathname(url.path)) if url.scheme == "file" else None


def requirements(extra: str) -> list[str]:
    """Return what an extra requires beyond the package itself; empty where the package has no metadata.

    Conditions on Python and the machine stay, as in 'tomli>=2; python_version < "3.11"': pip judges them.
    """
    from importlib.metadata import PackageNotFoundError, requires

    try:
        entries = requires("sonar_gl") or []
    except PackageNotFoundError:
        return []
    found, is_extra = [], rf"extra\s*==\s*['\"]{extra}['\"]"
    for entry in entries:
        name, _, marker = (text.strip() for text in entry.partition(";"))
        if re.search(is_extra, marker):
            others = re.sub(rf"\s*\band\s+{is_extra}|{is_extra}(\s+and\s+)?", "", marker)
            inner = re.fullmatch(r"sonar[-_.]gl\s*\[(.*)\]", name)  # an extra may contain others
            if inner is None:
                found.append(f"{name}; {others}" if others else name)
            else:
                found += (each for other in inner[1].split(",") for each in requirements(other.strip()))
    return list(dict.fromkeys(found))
