"""Other processes of Python, which import the package from where this one has it."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

import sonar_gl as sg

HOME = str(Path(sg.__file__).parent.parent)


def python(*words, environment: Mapping[str, str] | None = None, **options) -> subprocess.CompletedProcess:
    """Run Python to its end, and return what it wrote, as text.

    Parameters
    ----------
    words : of the command line
    environment : variables besides those of this process
    options : of `subprocess.run`, in place of these
    """
    variables = {**os.environ, "PYTHONPATH": HOME, **(environment or {})}
    options = {"capture_output": True, "text": True, "timeout": 100, **options}
    return subprocess.run([sys.executable, *map(str, words)], env=variables, **options)
