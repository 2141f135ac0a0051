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


def amount_text(amount: float, unit: str, nothing: str) -> str:
    """Return an amount and its unit; `nothing` in place of 0.

    >>> [amount_text(ms, "ms", NOT_MEASURED) for ms in (0.0, 0.04, 0.26, 31.4)]
    ['–', '< 0.1 ms', '0.3 ms', '31 ms']
    """
    if amount == 0:
        return nothing
    if amount < 0.1:
        return f"< 0.1 {unit}"
    return f"{amount:.1f} {unit}" if amount < 9.95 else f"{amount:.0f} {unit}"


def prices_html(prices: Sequence[Price]) -> str:
    """Return a table of what terms change and cost; "" of none."""
    if not prices:
        return ""
    heads = ("term", "echo", "bins", "time")
    rows = [
        (
            one.name,
            *(amount_text(100 * share, "%", "0 %") for share in (one.changes, one.changed_bins)),
            amount_text(one.time_ms, "ms", NOT_MEASURED),
        )
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
