#!/usr/bin/env python
"""What it costs to begin: time and memory of fresh processes, beside what is aimed at.

    python tools/bench_start.py            # five processes of each kind, half a minute
    python tools/bench_start.py --runs 15
    python tools/bench_start.py --only "import sonar_gl"   # a second

Memory is the most that was resident, clean pages of shared libraries counted too: two LLVMs, Mesa's and
Numba's, make 120 MB of it. Times are of whole processes, the interpreter's own start included; beside them
stands how long a processor was busy, which grows less where others use it too. Files are in the page cache.
Numba's machine code is kept in a folder of its own, empty at the beginning: so the first process of all
compiles, and is told apart.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from statistics import median
from time import perf_counter

RENDER = "from sonar_gl.cli import main; main(['render', 'pylon', '--out', OUT], standalone_mode=False)"
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
    "import sonar_gl": ("import sonar_gl", 0.3, None),
    "the same, and all its names": ("from sonar_gl import *", None, None),
    "sonar-gl render pylon": (RENDER, 2.5, 300),
    "20 pings of pylon, p900-45": (PING, None, 300),
}
TOLD = """
import time
for line in open("/proc/self/status"):
    if line.startswith("VmHWM"):
        print("told", time.process_time(), line.split()[1])
"""


def measure(code: str, folder: str) -> tuple[float, float, float]:
    """Seconds of a fresh process, those of its processors, and the most memory that it held, MB."""
    home = str(Path(__file__).resolve().parent.parent)
    environment = {**os.environ, "PYTHONPATH": home, "NUMBA_CACHE_DIR": os.path.join(folder, "cache")}
    start = perf_counter()
    done = subprocess.run(
        [sys.executable, "-c", f"OUT = {folder!r}\n{code}\n{TOLD}"],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
    )
    took_s = perf_counter() - start
    if done.returncode:
        raise SystemExit(done.stderr.strip())
    busy_s, held_kib = done.stdout.split()[-2:]
    return took_s, float(busy_s), int(held_kib) * 1024 / 1e6


def start_costs(runs: int, only=()) -> dict[str, list[tuple[float, float, float]]]:
    """What `measure` tells of each process of each kind, or of some, the kinds in turns."""
    with tempfile.TemporaryDirectory() as folder:
        found = {kind: [] for kind in only or KINDS}
        if not only:
            found = {FIRST: [measure(RENDER, folder)], **found}
            measure(PING, folder)  # compiles what is left
        for _ in range(runs):
            for kind in only or KINDS:
                found[kind].append(measure(KINDS[kind][0], folder))
    return found


def tell(found: dict):
    """Print medians of what `start_costs` found, and the aims."""
    print(f"{'':38}  {'seconds':>7}  {'aim':>6}  {'busy':>5}  {'MB':>5}  {'aim':>6}")
    for kind, rows in found.items():
        _, aim_s, aim_mb = KINDS.get(kind, (None, None, None))
        took_s, busy_s, held_mb = (median(column) for column in zip(*rows, strict=True))
        aims = [f"{'<= ' + f'{aim:g}' if aim else '':>6}" for aim in (aim_s, aim_mb)]
        print(f"{kind:38}  {took_s:7.2f}  {aims[0]}  {busy_s:5.2f}  {held_mb:5.0f}  {aims[1]}")


def main():
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--runs", type=int, default=5, help="processes of each kind")
    parser.add_argument("--only", action="append", choices=KINDS, help="may be repeated; all if left out")
    options = parser.parse_args()
    print(f"medians of {options.runs} processes; {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}")
    tell(start_costs(options.runs, options.only))


if __name__ == "__main__":
    main()
