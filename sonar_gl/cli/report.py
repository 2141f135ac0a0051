"""Reports of commands: facts, one to a line, and tables."""

from __future__ import annotations

import math

from sonar_gl.core.checks import text_beside
from sonar_gl.core.errors import one_line
from sonar_gl.ping import Ping


def ping_facts(ping: Ping) -> dict:
    """Return what a report says first of a ping, as plain values."""
    known = {name: ping.meta[name] for name in ("scene", "profile", "gl_renderer")}
    beams, bins = ping.intensity.shape
    return {**known, "sonar": ping.sonar.name, "beams": beams, "bins": bins}


def facts_text(found: dict, rows: list[tuple[str, str]]) -> str:
    """Return a report: `ping_facts`, which `found` holds, then the rows; one name and its value per line."""
    head = [
        ("scene", found["scene"]),
        ("sonar", f"{found['sonar']}, {found['beams']} beams x {found['bins']} bins"),
        ("profile", found["profile"]),
    ]
    return "\n".join(f"{name:10}  {value}" for name, value in [*head, *rows])


def table_text(header: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    """Return a table with columns as wide as needed; the first is aligned to the left, others to the right."""
    rows = [tuple(map(one_line, row)) for row in rows]
    widths = [max(map(len, column)) for column in zip(header, *rows, strict=True)]
    lines = []
    for first, *others in (header, *rows):
        cells = [first.ljust(widths[0])]
        cells += [cell.rjust(width) for cell, width in zip(others, widths[1:], strict=True)]
        lines.append("  ".join(cells).rstrip())
    return "\n".join(lines)


def percent(share: float, bound: float = math.inf) -> str:
    """Return a share as per cent, with two significant digits, or with as many as show that it exceeds a bound.

    >>> percent(0.0123), percent(1.5), percent(0.02004, 0.02)
    ('1.2 %', '150 %', '2.004 %')
    """
    if share >= 0.995:
        return f"{100 * share:.0f} %"
    return f"{text_beside(100 * share, 100 * bound, digits=2)} %"
