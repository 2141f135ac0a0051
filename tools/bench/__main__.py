"""Time sonar_gl.

    python -m tools.bench                       # stages of a ping, its error, a picture; some minutes
    python -m tools.bench --quick               # fewer rounds and rays, less than a minute
    python -m tools.bench NAME [--help]         # one of the benches below
    python -m tools.bench NAME --json out.json  # writes all figures, too

ping      time of a ping by stages and its error, over samplings and tolerances (what runs without a NAME)
frame     what noise and picture add to a ping, beside a trace of as many rays through Embree
scaling   how the time grows with triangles, beams, bins, field of view, bodies and tolerance
engines   both raster engines; what labels, multipath and pictures add; sequences
live      how even the pings of a live loop are
view      how many new pings a second the page of `sonar-gl view` shows; needs Chromium
changes   two sonars in one world, bodies that come, go and move
batch     rate of a headless batch, where a worker's time goes, what ten million pings take
embed     the four embedding modes, in a bare OpenGL program and in the hosts of examples/
host      one of the hosts of examples/, as `embed` runs them
start     time and memory of fresh processes
paper     the founding paper's Table I, ours beside theirs
"""

from __future__ import annotations

import argparse
import sys
from importlib import import_module

from tools.bench import harness

NAMES = (
    "ping",
    "frame",
    "scaling",
    "engines",
    "live",
    "view",
    "changes",
    "batch",
    "embed",
    "host",
    "start",
    "paper",
)


def main(arguments=None):
    """Run one bench: a module with ROUNDS, add_options(parser), run(options) -> figures, report(figures)."""
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    if arguments[:1] in (["--help"], ["-h"]):
        print(__doc__.strip())
        return
    name = "ping"
    if arguments and not arguments[0].startswith("-"):
        name = arguments.pop(0)
    if name not in NAMES:
        raise SystemExit(f"there is no bench {name!r} (known are {', '.join(NAMES)})")
    bench = import_module(f"tools.bench.{name}")
    parser = argparse.ArgumentParser(
        prog=f"python -m tools.bench {name}",
        description=bench.__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    rounds, few = bench.ROUNDS
    parser.add_argument("--rounds", type=int, help=f"{rounds}, or {few} if quick")
    parser.add_argument("--quick", action="store_true", help="little of everything: whether it runs")
    parser.add_argument("--json", metavar="FILE", help="write all figures there, too")
    bench.add_options(parser)
    options = parser.parse_args(arguments)
    options.rounds = options.rounds or (few if options.quick else rounds)
    machine = harness.describe_machine()
    print(harness.one_line(machine))
    print(f"{options.rounds} rounds, medians; the load at the start is {machine['load']:.1f}", flush=True)
    found = {"bench": name, "rounds": options.rounds, **bench.run(options)}
    bench.report(found)
    if options.json:
        harness.write_json(options.json, machine, found)


if __name__ == "__main__":
    main()
