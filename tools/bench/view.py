"""Measure how many new pings a second the page of `sonar-gl view` shows, beside what is aimed at.

python -m tools.bench view                       # pylon, ocean_floor; half a minute
python -m tools.bench view --only pylon

The page is in Chromium without a window, on the same machine, which draws the 3D scene by software, too. The P900-45
swims as in the bench `live`, with the acoustics, noise and tolerance that the page has at first, 640 pixels high.
"pings" are those that the session made, "pictures" those that the browser has shown, "error" the worst error estimate.
"""

from __future__ import annotations

import time

import sonar_gl as sg
from sonar_gl.core.pose_track import PoseTrack
from sonar_gl.live.session import LiveSession
from sonar_gl.live.settings import LiveSettings
from sonar_gl.live.view.page import ViewerPage
from tests.support.browser import COUNT_PICTURES, open_browser
from tools.bench import harness
from tools.bench.harness import Aim
from tools.bench.live import PERIOD_S, path

ROUNDS = 10, 5  # seconds that are counted
AIMS = {"pylon": 20.0, "ocean_floor": 10.0}  # pictures per second
SETTLE_S, WAIT_MS, MAX_RATE_HZ = 8.0, 120_000, 60.0


def watch(browser, name: str, seconds: float) -> dict[str, float]:
    """Return the figures of one scene."""
    scene = sg.load_scene(name)
    numbers = range(round((SETTLE_S + seconds + 20) / PERIOD_S))
    track = PoseTrack([path(scene.sonar_pose, number) for number in numbers], [PERIOD_S * k for k in numbers])
    settings = LiveSettings(sg.load_sonar("p900-45"), max_rate_hz=MAX_RATE_HZ)
    estimates = []
    with LiveSession(scene, settings, track=track) as session, ViewerPage(session, port=0) as page:
        tab = browser.new_page(viewport={"width": 1280, "height": 800})
        tab.set_default_timeout(WAIT_MS)
        tab.add_init_script(COUNT_PICTURES)
        tab.goto(page.url)
        tab.wait_for_selector('img[src^="blob:"]')
        time.sleep(SETTLE_S)  # for the scene to be drawn
        session.seek(0.0)
        with session.listen(lambda frame: estimates.append(frame.ping.error_estimate), waiting=1000):
            shown, started_s = tab.evaluate("window.pictures"), time.perf_counter()
            first = session.frame.number
            time.sleep(seconds)
            pings, pictures = session.frame.number - first, tab.evaluate("window.pictures") - shown
            gone_s = time.perf_counter() - started_s
        tab.close()
    return {"pings, /s": pings / gone_s, "pictures, /s": pictures / gone_s, "error": max(estimates)}


def add_options(parser):
    """Add the scene."""
    parser.add_argument("--only", choices=AIMS, help="this scene")


def run(options) -> dict:
    """Return the figures of each scene."""
    with open_browser() as browser:
        scenes = (options.only,) if options.only else tuple(AIMS)
        found = {name: watch(browser, name, options.rounds) for name in scenes}
    aims = [
        Aim(f"{name}: pictures per second", found[name]["pictures, /s"], "", AIMS[name], at_least=True)
        for name in scenes
    ]
    return {"scenes": found, "aims": aims}


def report(found: dict):
    """Print a row for each scene, and the aims."""
    harness.print_scenes(found)
