"""Compiles numerical kernels before the tests, whose time limits would cover it: it takes minutes on a busy machine."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import numba

import sonar_gl
from sonar_gl.core.compiled import sources_of

PROGRAM = """
from sonar_gl.cli.compilation import cache_folder, compile_everything
compile_everything()
print(cache_folder() or "")
"""
KEY = "sonar_gl/kernels"
PACKAGE = Path(sonar_gl.__file__).parent


def compile_kernels(cache, say) -> None:
    """Compile all kernels, unless their files are those of the last time, whose machine code is still there.

    Parameters
    ----------
    cache : of pytest, which keeps what there was the last time
    say : called with a line of text before it compiles
    """
    files, last = _state_of_files(), cache.get(KEY, None) or {}
    if last.get("files") == files and _count(last["folder"]) >= last["count"] > 0:
        return
    say("compiling numerical kernels where they are not kept (a minute or two; some minutes on one core)")
    command = [sys.executable, "-c", PROGRAM]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(PACKAGE.parent), *sys.path])}
    done = subprocess.run(command, env=environment, stdout=subprocess.PIPE, text=True, check=False)
    if done.returncode == 0:  # else tests tell what is wrong
        folder = done.stdout.strip()
        cache.set(KEY, {"files": files, "folder": folder, "count": _count(folder)})


def _state_of_files() -> dict:
    """Return what kept machine code is looked up by: states of the sources of kernels, versions, and the folder."""
    found = {"python": sys.version, "numba": numba.__version__, "folder": str(numba.config.CACHE_DIR)}
    for path in sorted(PACKAGE.rglob("*.py")):
        if re.search(
            r"^@(added_in_any_order|compiled|rounded_alike|uncounted)\b",
            path.read_text(encoding="utf-8"),
            re.MULTILINE,
        ):
            for source in sources_of(str(path)):
                state = os.stat(source)
                found[source] = [state.st_mtime_ns, state.st_size]
    return found


def _count(folder: str) -> int:
    """Return how many kernels are kept below a folder."""
    return sum(1 for _ in Path(folder).rglob("*.nbi")) if folder else 0
