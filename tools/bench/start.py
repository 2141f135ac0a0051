"""Measure time and memory of fresh processes, beside what is aimed at.

    python -m tools.bench start                            # five processes of each kind, half a minute
    python -m tools.bench start --only "import sonar_gl"   # some seconds

Memory is the most that was resident, clean pages of shared libraries included: two LLVMs, Mesa's and Numba's,
make 120 MB of it. Times are of whole processes, the interpreter's own start included; beside them stands how
long a processor was busy, which grows less where other programs use it too. Files are in the page cache,
and Python keeps the bytecode of modules, as pip makes it of what it installs.
Numba's machine code is cached in a folder of its own, empty at the beginning: the first process of all
compiles, and has a row of its own.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path
from statistics import median
from time import perf_counter

from tools.bench import harness

ROUNDS = 5, 1
RENDER = "from sonar_gl.cli.main import main; main(['render', 'pylon', '--out', OUT], standalone_mode=False)"
PING = """
import sonar_gl as sg
scene = sg.load_scene("pylon")
with sg.Simulator(scene, sg.load_sonar("p900-45")) as simulator:
    for number in range(20):
        simulator.ping(scene.sonar_pose @ sg.pose(x=0.001 * number))
"""
FIRST = "sonar-gl render pylon, the very first"
KINDS = {  # name: (code, seconds aimed at, MB aimed at)
    "python": ("pass", None, None),
    "import sonar_gl": ("import sonar_gl", 0.05, None),
    "the same, and all its names": ("from sonar_gl import *", None, None),
    "sonar-gl render pylon": (RENDER, 2.5, 300),
    "20 pings of pylon, p900-45": (PING, None, 300),
}
REPORT = """
import time
for line in open("/proc/self/status"):
    if line.startswith("VmHWM"):
        print("used", time.process_time(), line.split()[1])
"""


def measure(code: str, folder: str) -> tuple[float, float, float]:
    """Return the seconds of a fresh process, those of its processors, and its peak memory in MB."""
    home = str(Path(__file__).resolve().parents[2])
    environment = {**os.environ, "PYTHONPATH": home, "NUMBA_CACHE_DIR": os.path.join(folder, "cache")}
    environment.pop(
        "PYTHONDONTWRITEBYTECODE", None
    )  # with it each process compiles the text of all modules, 0.2 s
    start = perf_counter()
    done = subprocess.run(
        [sys.executable, "-c", f"OUT = {folder!r}\n{code}\n{REPORT}"],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
    )
    took_s = perf_counter() - start
    if done.returncode:
        raise SystemExit(done.stderr.strip())
    busy_s, peak_kib = done.stdout.split()[-2:]
    return took_s, float(busy_s), int(peak_kib) * 1024 / 1e6


def add_options(parser):
    """Add the options of this bench."""
    parser.add_argument("--only", action="append", choices=KINDS, help="may be repeated; default: all")


def run(options) -> dict:
    """Return medians of what `measure` returns, by kind; the kinds take turns."""
    kinds = options.only or list(KINDS)
    with tempfile.TemporaryDirectory() as folder:
        found = {kind: [] for kind in kinds}
        if not options.only:
            found = {FIRST: [measure(RENDER, folder)], **found}
            measure(PING, folder)  # compiles the rest
        for _ in range(options.rounds):
            for kind in kinds:
                found[kind].append(measure(KINDS[kind][0], folder))
    names = ("seconds", "busy_s", "peak_mb")
    return {
        "processes": {
            kind: dict(zip(names, map(median, zip(*rows, strict=True)), strict=True))
            for kind, rows in found.items()
        }
    }


def report(found: dict):
    """Print the medians and the aims."""
    rows = []
    for kind, figures in found["processes"].items():
        _, aim_s, aim_mb = KINDS.get(kind, (None, None, None))
        rows.append(
            {
                "process": kind,
                "seconds": f"{figures['seconds']:.2f}",
                "aim, s": f"<= {aim_s:g}" if aim_s else "",
                "busy": f"{figures['busy_s']:.2f}",
                "MB": f"{figures['peak_mb']:.0f}",
                "aim, MB": f"<= {aim_mb:g}" if aim_mb else "",
            }
        )
    harness.print_table(rows)
