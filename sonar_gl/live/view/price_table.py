"""The prices of terms, as the page shows them."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

from sonar_gl.analysis.terms import Price

NOT_MEASURED = "–"
_CELL = "padding:0 4px;text-align:right;white-space:nowrap"
_NOTE = (
    "echo: share of the echo that changes; bins: share of the displayed bins that change by more than 3 dB; time: "
    f"added to a ping, {NOT_MEASURED} where it is less than the times of pings vary"
)


def share_text(share: float) -> str:
    """Return a share in per cent.

    >>> share_text(0.0), share_text(0.0004), share_text(0.0123), share_text(1.2)
    ('0 %', '< 0.1 %', '1.2 %', '120 %')
    """
    percent = 100 * share
    if percent == 0:
        return "0 %"
    if percent < 0.1:
        return "< 0.1 %"
    return f"{percent:.1f} %" if percent < 9.95 else f"{percent:.0f} %"


def time_text(time_ms: float) -> str:
    """Return an added time; one that is 0 could not be told from the variation of the times.

    >>> time_text(0.0), time_text(0.04), time_text(0.26), time_text(31.4)
    ('–', '< 0.1 ms', '0.3 ms', '31 ms')
    """
    if time_ms == 0:
        return NOT_MEASURED
    if time_ms < 0.1:
        return "< 0.1 ms"
    return f"{time_ms:.1f} ms" if time_ms < 9.95 else f"{time_ms:.0f} ms"


def prices_html(prices: Sequence[Price]) -> str:
    """Return a table of what terms change and cost; "" of none."""
    if not prices:
        return ""
    heads = ("term", "echo", "bins", "time")
    rows = [
        (one.name, share_text(one.changes), share_text(one.changed_bins), time_text(one.time_ms))
        for one in prices
    ]
    lines = [_row_html(heads, "opacity:.6"), *(_row_html(row) for row in rows)]
    return (
        '<table style="width:100%;font-size:12px;line-height:1.5;border-collapse:collapse;'
        f'font-variant-numeric:tabular-nums">{"".join(lines)}</table>'
        f'<div style="font-size:11px;line-height:1.35;opacity:.6;padding:2px 4px">{escape(_NOTE)}</div>'
    )


def _row_html(cells: Sequence[str], style: str = "") -> str:
    name, *numbers = (escape(cell) for cell in cells)
    others = "".join(f'<td style="{_CELL}">{number}</td>' for number in numbers)
    return f'<tr style="{style}"><td style="padding:0 4px">{name}</td>{others}</tr>'
