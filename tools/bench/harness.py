"""The harness of all benches: timing in turns, aims, tables, the description of the machine.

What is compared is timed in turns: a round of all contenders, then the next round, so that other programs on
the machine disturb all alike. Times are medians over the rounds; ratios are medians of the rounds' ratios.
"""

from __future__ import annotations

import csv
import json
import os
import platform
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter

import numpy as np

import sonar_gl as sg
from sonar_gl.core.atomic_file import atomic_write

WARM_UP = 3  # rounds that are not counted
CREEP_M = 0.001  # the sonar creeps ahead by this much a round, so that no two pings are alike


def processor() -> str:
    """Return what the CPU calls itself."""
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as file:
            names = [line.partition(":")[2].strip() for line in file if line.startswith("model name")]
    except OSError:
        names = []
    return names[0] if names else platform.processor() or "a CPU without a name"


def describe_machine(engine: str | None = None) -> dict:
    """Return versions, renderer of an engine, processor, cores and load: what times depend on."""
    with sg.Simulator(sg.Scene([]), sg.load_sonar("p900-45"), engine=engine) as simulator:
        renderer = simulator.gl_info["renderer"]
    return {
        "version": sg.__version__,
        "gl_renderer": renderer,
        "python": platform.python_version(),
        "machine": platform.machine(),
        "processor": processor(),
        "cores": os.cpu_count(),
        "load": os.getloadavg()[0],
    }


def one_line(machine: Mapping) -> str:
    """Return the versions, GL renderer, processor and cores as text."""
    return (
        f"sonar_gl {machine['version']} on {machine['gl_renderer']}; "
        f"{machine['cores']} cores of {machine['processor']}, Python {machine['python']}"
    )


def creep(pose, number: int):
    """Return a pose moved ahead by `number` rounds of CREEP_M.

    In 2 us, as it is timed with the ping: a product with one of `sg.pose` takes 20, a tenth of the smallest ping.
    """
    moved = np.array(pose)
    moved[:3, 3] += CREEP_M * number * moved[:3, 0]
    return moved


def timed(function: Callable, *arguments, **keywords) -> tuple[float, object]:
    """Call a function; return its milliseconds and its result."""
    start = perf_counter()
    result = function(*arguments, **keywords)
    return 1e3 * (perf_counter() - start), result


@dataclass(frozen=True)
class Contender:
    """What takes part in the turns.

    Attributes
    ----------
    run : function of the round's number, which is timed
    before : function of the round's number, called untimed just before `run`, or None
    every : takes part in every so-manieth round alone; for what is slow
    """

    run: Callable[[int], object]
    before: Callable[[int], object] | None = None
    every: int = 1


def take_turns(contenders: Mapping, rounds: int, warm_up: int = WARM_UP) -> dict:
    """Time contenders round by round.

    Parameters
    ----------
    contenders : {name: Contender, or function of the round's number}
    rounds : how many are counted
    warm_up : how many are run before those; the rounds' numbers start at 0 with the first of these

    Returns
    -------
    dict of name: (n,) float64, milliseconds of each counted round
    """
    entered = {
        name: one if isinstance(one, Contender) else Contender(one) for name, one in contenders.items()
    }
    times = {name: [] for name in entered}
    for number in range(warm_up + rounds):
        for name, one in entered.items():
            if number % one.every:
                continue
            if one.before is not None:
                one.before(number)
            ms, _ = timed(one.run, number)
            if number >= warm_up:
                times[name].append(ms)
    return {name: np.array(ms) for name, ms in times.items()}


def spread_of(ms) -> dict[str, float]:
    """Return median and 95th percentile."""
    return {"median": float(np.median(ms)), "p95": float(np.quantile(ms, 0.95))}


def ratio(ms, base_ms) -> float:
    """Return the median of the rounds' ratios."""
    return float(np.median(np.asarray(ms) / np.asarray(base_ms)))


@dataclass(frozen=True)
class Aim:
    """A figure beside what was aimed at: at most `limit`, or at least."""

    name: str
    measured: float
    unit: str
    limit: float
    at_least: bool = False

    @property
    def met(self) -> bool:
        """Whether the figure is within the limit."""
        return self.measured >= self.limit if self.at_least else self.measured <= self.limit


def print_aims(aims: list[Aim]):
    """Print figures, aims, and which of these are met."""
    width = max(len(aim.name) for aim in aims)
    print(f"\n{'aims':{width + 2}}  {'measured':>8}         {'aim':>8}")
    for aim in aims:
        limit = f"{'>=' if aim.at_least else '<='} {aim.limit:g}"
        verdict = "met" if aim.met else "missed"
        print(f"  {aim.name:{width}}  {aim.measured:8.3g} {aim.unit:5}  {limit:>8}  {verdict}")


def print_table(rows: list[Mapping], indent: int = 2):
    """Print rows under their columns' names; text to the left, numbers (or text of numbers) to the right."""
    if not rows:
        return
    for cells in _cells(rows):
        print(" " * indent + "  ".join(cells).rstrip())


def print_scenes(found: dict):
    """Print a row for each of found["scenes"], a dict of figures by the names of scenes, and then found["aims"]."""
    rows = [
        {"scene": name, **{what: f"{value:.3g}" for what, value in figures.items()}}
        for name, figures in found["scenes"].items()
    ]
    print_table(rows)
    print_aims(found["aims"])


def markdown(rows: list[Mapping]) -> str:
    """Return rows as a table of a Markdown page."""
    columns = list(rows[0])
    lines = ["| " + " | ".join(columns) + " |", "|" + "---|" * len(columns)]
    lines += ["| " + " | ".join(str(row[column]) for column in columns) + " |" for row in rows]
    return "\n".join(lines)


def _cells(rows: list[Mapping]) -> list[list[str]]:
    columns = list(rows[0])
    texts = [{column: str(row.get(column, "")) for column in columns} for row in rows]
    out = [[] for _ in range(1 + len(rows))]
    for number, column in enumerate(columns):
        width = max(len(column), *(len(text[column]) for text in texts))
        side = "<" if number == 0 else ">"
        for line, text in zip(out, [column, *(text[column] for text in texts)], strict=True):
            line.append(f"{text:{side}{width}}")
    return out


def write_csv(path: Path, rows: list[Mapping], columns: list[str] | None = None):
    """Write a CSV file of these columns, or of all; floats with five digits."""
    with atomic_write(Path(path)) as name, open(name, "w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, columns or list(rows[0]), lineterminator="\n", extrasaction="ignore")
        writer.writeheader()
        for row in rows:
            writer.writerow({k: f"{v:.5g}" if isinstance(v, float) else v for k, v in row.items()})


def write_json(path: Path, machine: Mapping, found: Mapping):
    """Write the machine and all figures of a bench."""
    with atomic_write(Path(path)) as name, open(name, "w", encoding="utf-8") as file:
        json.dump({**machine, **found}, file, indent=2, default=lambda aim: {**vars(aim), "met": aim.met})
