"""Draw the chart's pictures."""

from __future__ import annotations

import pathlib

import matplotlib

matplotlib.use("Agg")

import numpy as np
from matplotlib import pyplot
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from tools.chart.front import OUR_OPENGL, OURS, envelope
from tools.chart.rivals.methods import METHODS
from tools.chart.scenes import BEAMS
from tools.pictures import write_figure

SIZE_INCHES, DPI = (9.0, 6.0), 110
PLAIN = FuncFormatter(lambda x, _: f"{x:g}")


def _draw_panel(axes, methods: dict, title: str, uncertainty: float):
    """Draw the lines of one width of beams; methods: {method: [(ms, error), ...]}."""
    front = envelope([point for points in methods.values() for point in points])
    axes.loglog(
        front[:, 0],
        100 * front[:, 1],
        color="#ffe08a",
        linewidth=9,
        solid_capstyle="round",
        zorder=1,
        label="front",
    )
    if uncertainty > 0:
        label = "uncertainty of the truth"
        axes.axhspan(1e-6, 100 * uncertainty, color="#dddddd", zorder=0, label=label)
    for name, points in methods.items():
        ms, error = np.array(points).T
        look = METHODS[name]
        ours = name in (OURS, OUR_OPENGL)
        axes.loglog(
            ms,
            100 * error,
            color=look.colour,
            marker=look.marker,
            markersize=13 if look.marker == "*" else 5.5,
            markeredgecolor="white",
            markeredgewidth=0.4,
            linewidth=2.4 if ours else 1.3,
            zorder=4 if ours else 3,
            label=look.label,
        )
    axes.set_title(title, fontsize=10)
    axes.set_xlabel("whole ping, ms (median)")
    axes.grid(True, which="major", color="#cccccc", linewidth=0.6)
    axes.grid(True, which="minor", color="#eeeeee", linewidth=0.4)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(LogLocator(10, (1.0, 3.0)))
        axis.set_major_formatter(PLAIN)
        axis.set_minor_formatter(NullFormatter())


def _finish(figure, panels, path: pathlib.Path, title: str, caption: str):
    """Put the legend below the panels and the caption below that; write the picture."""
    known = {}
    for axes in panels:
        known |= {label: handle for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)}
    figure.suptitle(title, fontsize=12)
    figure.legend(
        known.values(),
        known.keys(),
        loc="lower center",
        ncols=3,
        fontsize=8.5,
        frameon=False,
        bbox_to_anchor=(0.5, 0.07),
    )
    figure.text(0.5, 0.015, caption, ha="center", va="bottom", fontsize=7.2, color="#444444")
    figure.subplots_adjust(left=0.095, right=0.985, top=0.89, bottom=0.31, wspace=0.06)
    write_figure(path, figure, DPI)


def _set_limits(panels, times, errors):
    low, high = min(times) / 1.3, max(times) * 1.3
    for axes in panels:
        axes.set_xlim(low, high)
        axes.set_ylim(min(errors) / 1.5, max(errors) * 1.4)


def chart(path: pathlib.Path, name: str, charts: dict, uncertainties: dict, make_sonar, about: str):
    """Draw one scene, a panel a width of beams; charts: {(scene, beams): {method: points}}."""
    figure, panels = pyplot.subplots(1, len(BEAMS), figsize=SIZE_INCHES, sharey=True)
    for axes, (beams, degrees) in zip(panels, BEAMS.items(), strict=True):
        title = f"beams {degrees:.3g}° wide"
        _draw_panel(axes, charts[name, beams], title, uncertainties[beams])
    points = [p for methods in charts.values() for line in methods.values() for p in line]
    _set_limits(panels, [ms for ms, _ in points], [100 * error for _, error in points])
    panels[0].set_ylabel("echo in wrong bins, %")
    sonar = make_sonar(name, "wide")
    uncertain = ", ".join(f"{100 * uncertainties[beams]:.1g} % ({beams})" for beams in BEAMS)
    caption = (
        f"{sonar.n_beams} box beams {sonar.azimuth_fov_deg / sonar.n_beams:.3g}° apart, "
        f"{sonar.azimuth_fov_deg:g} x {sonar.elevation_fov_deg:g}°, "
        f"{sonar.n_bins} bins to {sonar.range_max_m:g} m, "
        f"profile ideal; uncertainty of the truth {uncertain}\n{about}"
    )
    _finish(figure, panels, path, f"{name}: time and error of a ping", caption)


def shimmer(path: pathlib.Path, rows: list[dict], uncertainties: dict, about: str):
    """Draw the shimmer likewise; rows : of `tools.chart.shimmer.shimmer`."""
    figure, panels = pyplot.subplots(1, len(BEAMS), figsize=SIZE_INCHES, sharey=True)
    for axes, (beams, degrees) in zip(panels, BEAMS.items(), strict=True):
        methods = {}
        for row in rows:
            if row["beams"] == beams:
                methods.setdefault(row["method"], []).append((row["ms_median"], row["shimmer"]))
        title = f"beams {degrees:.3g}° wide"
        _draw_panel(axes, methods, title, uncertainties[beams])
    _set_limits(panels, [row["ms_median"] for row in rows], [100 * row["shimmer"] for row in rows])
    panels[0].set_ylabel("shimmer, % of the true change")
    uncertain = ", ".join(f"{100 * uncertainties[beams]:.2g} % ({beams})" for beams in BEAMS)
    caption = (
        "the sonar creeps ahead by a quarter of a bin; 256 box beams 0.176° apart, 45 x 20°, "
        "512 bins to 30 m, "
        f"profile ideal\nuncertainty of the true change {uncertain}; {about}"
    )
    _finish(figure, panels, path, "pylon: false change from ping to ping", caption)
