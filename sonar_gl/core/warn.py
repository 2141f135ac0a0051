"""Warnings that name the line of the calling program."""

from __future__ import annotations

import sys
import warnings

from sonar_gl.core.errors import escape_controls


def warn_caller(message: str, category: type[Warning] = UserWarning) -> None:
    """Issue a warning, safe to print, for the nearest stack frame outside of sonar_gl, and of `dataclasses.replace`."""
    level, frame = 1, sys._getframe(0)
    while frame.f_back is not None and f"{frame.f_globals['__name__']}.".startswith(
        ("sonar_gl.", "dataclasses.")
    ):
        level, frame = level + 1, frame.f_back
    warnings.warn(escape_controls(message), category, stacklevel=level)
