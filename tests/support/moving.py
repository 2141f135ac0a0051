"""A moving sonar whose samples change: what its sequence holds in memory.

python -m tests.support.moving N    # N pings; prints resident memory, MB: after the last one, and at most
"""

from __future__ import annotations

import math
import sys
import warnings

import sonar_gl as sg
from tests.support.memory import resident_bytes

SECONDS = 60.0  # pings a second of the motion below


def poses(home, n_pings: int):
    """Yield poses about `home`, some of them close to a body, so that many sampling levels are used."""
    for k in range(n_pings):
        t = k / SECONDS
        x, y, z = 3 * math.sin(0.7 * t), 2 * math.sin(0.31 * t), 0.5 * math.sin(0.2 * t)
        turn = 0.1 * math.sin(t), 0.15 * math.sin(0.37 * t), 1.2 * math.sin(0.11 * t)
        yield home @ sg.pose(x, y, z, *turn)


def measure(n_pings: int) -> tuple[float, float, int]:
    """Return resident memory after a sequence and at most, MB after each ping; and how many samplings it used."""
    scene, sonar = sg.load_scene("pylon"), sg.load_sonar("p900-45")
    peak, used = 0.0, set()
    with sg.Simulator(scene, sonar, tolerance=0.02) as simulator:
        options = {"noise": sg.Noise.physical(), "labels": True}
        for ping in simulator.pings(poses(scene.sonar_pose, n_pings), **options):
            used.add(str(ping.meta["sampling"]))
            peak = max(peak, resident_bytes() / 1e6)
        return resident_bytes() / 1e6, peak, len(used)


def main() -> None:
    """Print what `measure` finds."""
    warnings.simplefilter("ignore")  # some poses are so close that no samples keep the tolerance
    print(*(f"{number:.0f}" for number in measure(int(sys.argv[1]))))


if __name__ == "__main__":
    main()
