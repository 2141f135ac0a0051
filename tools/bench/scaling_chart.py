"""Draw the picture of docs/performance.md: how the time of a ping grows."""

from __future__ import annotations

import pathlib

import matplotlib

matplotlib.use("Agg")

from matplotlib import pyplot
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from tools.pictures import write_figure

SIZE_INCHES, DPI = (10.0, 6.6), 105
COLOURS = ("#c00000", "#2060c0", "#208030")
MARKERS = ("o", "D", "s")
PLAIN = FuncFormatter(lambda x, _: f"{x:g}")
COUNT = FuncFormatter(
    lambda x, _: f"{x / 1e6:g} M" if x >= 1e6 else f"{x / 1e3:g} k" if x >= 1e4 else f"{x:g}"
)


def draw(path: pathlib.Path, rows: list[dict], about: str):
    """Draw one panel an axis; rows as in scaling.csv."""
    axes_of = dict.fromkeys(row["axis"] for row in rows)
    figure, panels = pyplot.subplots(2, 3, figsize=SIZE_INCHES, sharey=True)
    for panel, axis in zip(panels.flat, axes_of, strict=True):
        mine = [row for row in rows if row["axis"] == axis]
        for line, colour, marker in zip(
            dict.fromkeys(row["line"] for row in mine), COLOURS, MARKERS, strict=False
        ):
            points = [(float(row["at"]), float(row["ms_median"])) for row in mine if row["line"] == line]
            at, ms = zip(*points, strict=True)
            panel.loglog(at, ms, color=colour, marker=marker, markersize=5, linewidth=1.6, label=line)
        panel.set_xticks(sorted({float(row["at"]) for row in mine}))
        panel.xaxis.set_major_formatter(COUNT)
        panel.xaxis.set_minor_formatter(NullFormatter())
        panel.minorticks_off()
        if axis == "tolerance":
            panel.invert_xaxis()
        panel.set_xlabel(axis, fontsize=9)
        panel.tick_params(labelsize=8)
        panel.grid(True, color="#dddddd", linewidth=0.6)
        if len({row["line"] for row in mine}) > 1:
            panel.legend(fontsize=7.5, frameon=False, loc="upper left")
    for panel in panels[:, 0]:
        panel.set_ylabel("whole ping, ms (median)", fontsize=9)
        panel.yaxis.set_major_locator(LogLocator(10, (1.0, 3.0)))
        panel.yaxis.set_major_formatter(PLAIN)
    times = [float(row["ms_median"]) for row in rows]
    panels[0, 0].set_ylim(min(times) / 1.3, max(times) * 2.2)  # room for the legends
    figure.suptitle("How the time of a ping grows", fontsize=12)
    figure.text(0.5, 0.01, about, ha="center", va="bottom", fontsize=7.5, color="#444444")
    figure.subplots_adjust(left=0.07, right=0.985, top=0.93, bottom=0.11, wspace=0.06, hspace=0.27)
    write_figure(path, figure, DPI)
