"""Output of commands to the terminal."""

from __future__ import annotations

import click

from sonar_gl.core.errors import escape_controls


def echo(text: str, err: bool = False) -> None:
    """Print a text, in which names from files may be, to the standard output, or to that of errors."""
    click.echo(escape_controls(text), err=err)
