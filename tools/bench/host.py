"""Time the pings of one of the hosts in examples/, each beside one of a standalone Simulator.

    python -m tools.bench host pyrender_host            # or any other name of examples/
    python -m tools.bench host mujoco_host --out DIR    # keeps the host's pictures

The example runs in a process of its own. For each embedding mode that it uses, the medians of the
milliseconds of its pings and of a standalone Simulator's are printed (the same scene, samples and
arguments), and the median of their ratios, timed in turns while the host runs. The standalone one has a
thread of its own, since a GLX context allows no other to be current beside it.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from importlib import import_module
from pathlib import Path

import numpy as np

import sonar_gl as sg
from sonar_gl.embed import sensor
from tools.bench import harness

ROUNDS = 12, 12  # how often each ping is timed
ROOT = Path(__file__).resolve().parents[2]
HOSTS = ("pyrender_host", "egl_host", "deferred_host", "window_host", "mujoco_host", "panda3d_host")
TIMED_PINGS = 3  # of an example
FRAMES = {"window_host": {"frames": 60}}  # of hosts that run until they are closed
METHODS = {  # embedding mode: what makes its pings
    "1": (sg.Simulator, "ping"),
    "3": (sensor.Sensor, "ping_from_textures"),
    "4": (sensor.Sensor, "ping_from_depth"),
}


class HostClock:
    """Replaces the functions that make an example's pings by ones that time them.

    Beside each ping, one of a standalone Simulator is timed, which is made of the example's scene as soon as
    a Simulator of its has pinged.
    """

    def __init__(self, example, rounds: int):
        self.rounds, self.thread = rounds, ThreadPoolExecutor(1)
        self.standalone, self.last_arguments = None, None
        self.times, self.plain = {mode: [] for mode in "1234"}, {}
        for mode, (owner, name) in METHODS.items():
            setattr(owner, name, self._wrap(mode, getattr(owner, name)))
        if hasattr(example, "draw_ping"):  # from its sectors to the ping
            example.draw_ping = self._wrap("2", example.draw_ping)

    def _wrap(self, mode, plain):
        def ping(*arguments, **keywords):
            out = plain(*arguments, **keywords)
            if mode == "1":
                simulator, *rest = arguments
                if self.standalone is None:
                    self._make_standalone(simulator.scene, simulator.sonar, out)
                self.last_arguments = rest, keywords
            if len(self.times[mode]) < TIMED_PINGS * self.rounds:
                for _ in range(self.rounds):
                    ms, _ = harness.timed(plain, *arguments, **keywords)
                    self.times[mode].append((ms, self._time_standalone() if self.standalone else np.nan))
            return out

        self.plain[mode] = plain
        return ping

    def _make_standalone(self, scene, sonar, ping):
        """Make a simulator with the samples of a ping, in the other thread."""
        sampling = sg.Sampling(**ping.meta["sampling"])
        self.standalone = self.thread.submit(sg.Simulator, scene, sonar, sampling=sampling).result()

    def _time_standalone(self) -> float:
        """Return the milliseconds of its ping, made with the arguments of the host's last one."""
        arguments, keywords = self.last_arguments
        ping = self.thread.submit(harness.timed, self.plain["1"], self.standalone, *arguments, **keywords)
        return ping.result()[0]

    def finish(self, found: dict) -> list[dict]:
        """Return the figures of each mode; found : what the example's main returned."""
        if self.standalone is None:  # the host has no Simulator: time a standalone one now
            ping = found["texture_ping"]
            self._make_standalone(found["scene"], found["sonar"], ping)
            labels = ping.body_id is not None
            self.last_arguments = (found["pose"],), {"bodies": found.get("bodies"), "labels": labels}
            self._time_standalone()
            for times in self.times.values():
                times[:] = [(ms, self._time_standalone()) for ms, _ in times]
        self.thread.submit(self.standalone.close).result()
        out = []
        for mode, times in self.times.items():
            if times:
                ms, alone_ms = np.array(times).T
                medians = {"ms": float(np.median(ms)), "standalone_ms": float(np.median(alone_ms))}
                out.append({"mode": mode, **medians, "ratio": harness.ratio(ms, alone_ms)})
        return out


def measure(name: str, rounds: int, pictures: Path | None = None) -> list[dict]:
    """Run an example in a process of its own; return mode, ms, standalone_ms and ratio of each mode.

    pictures : folder for its pictures, or None
    """
    with tempfile.TemporaryDirectory() as folder:
        figures = Path(folder) / "figures.json"
        out = str(pictures or folder)
        command = [sys.executable, "-m", "tools.bench.host", name, out, str(figures), str(rounds)]
        if name == "window_host" and "DISPLAY" not in os.environ:
            command = ["xvfb-run", "-a", *command]
        environment = {**os.environ, "PYTHONPATH": str(ROOT)}
        done = subprocess.run(command, capture_output=True, text=True, env=environment)
        if done.returncode:
            raise SystemExit(f"{name} failed:\n{done.stdout}{done.stderr}")
        return json.loads(figures.read_text(encoding="utf-8"))


def run_example(name: str, folder: str, figures: str, rounds: str):
    """Run an example with its pings timed, and write the figures; in the process that `measure` starts."""
    example = import_module(f"examples.{name}")
    clock = HostClock(example, int(rounds))
    found = clock.finish(example.main(folder, **FRAMES.get(name, {})))
    Path(figures).write_text(json.dumps(found), encoding="utf-8")


def add_options(parser):
    """Add the options of this bench."""
    parser.add_argument("name", choices=HOSTS, help="of a file in examples/")
    parser.add_argument("--out", type=Path, help="folder for its pictures; none are kept if left out")


def run(options) -> dict:
    """Return the figures of each mode."""
    return {"host": options.name, "modes": measure(options.name, options.rounds, options.out)}


def report(found: dict):
    """Print one row a mode."""
    names = {"ms": ".1f", "standalone_ms": ".1f", "ratio": ".2f"}
    harness.print_table(
        [
            {"mode": row["mode"], **{name: f"{row[name]:{form}}" for name, form in names.items()}}
            for row in found["modes"]
        ]
    )


if __name__ == "__main__":
    run_example(*sys.argv[1:])
