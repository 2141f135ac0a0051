"""Pictures of the page of `sonar-gl view`, and a short film of it, by Chromium without a window.

python -m tools.docs.view                  # docs/pictures/view_*.png
python -m tools.docs.view --film view.gif  # a film of the page while the sonar moves
"""

from __future__ import annotations

import argparse
import contextlib
import io
import time
from pathlib import Path

from PIL import Image

from sonar_gl.core.atomic_file import atomic_write
from sonar_gl.live.command_line import SceneSource
from sonar_gl.live.session import LiveSession
from sonar_gl.live.settings import LiveSettings
from sonar_gl.live.view.page import ViewerPage
from sonar_gl.scene.load import load_scene
from sonar_gl.sonar.sonar_files import load_sonar
from tests.support.browser import COUNT_PICTURES, open_browser
from tools.pictures import write_small_png

PICTURES = Path(__file__).resolve().parents[2] / "docs" / "pictures"
SIZE = {"width": 1280, "height": 800}
# sonar, range in metres, and a place of the picture, 0..1 to the right and down, at which the pointer is
SCENES = {"pylon": ("p900-45", 22.0, (0.69, 0.41)), "ocean_floor": ("oculus-m750d-lf", 30.0, (0.56, 0.6))}
FILM_WIDTH, FILM_FRAMES, FRAME_MS, TURN_RAD = 800, 30, 120, 0.012
SETTLE_S = 8.0  # for the scene to be drawn by software
WAIT_MS = 120_000


@contextlib.contextmanager
def show(browser, name: str):
    """Yield a tab that shows a scene, and its session; close both afterwards."""
    sonar, range_m, _ = SCENES[name]
    settings = LiveSettings(load_sonar(sonar), range_m=range_m)
    session = LiveSession(load_scene(name), settings, source=SceneSource(name))
    tab_of = contextlib.closing(browser.new_page(viewport=SIZE))
    with session, ViewerPage(session, port=0) as page, tab_of as tab:
        tab.set_default_timeout(WAIT_MS)
        tab.add_init_script(COUNT_PICTURES)
        tab.goto(page.url)
        tab.wait_for_selector('img[src^="blob:"]')
        tab.wait_for_selector("canvas")
        # viser's note about software WebGL, which people with a graphics card do not see
        note = tab.locator(".mantine-Notification-closeButton")
        if note.count():
            note.first.click()
        yield tab, session


def screenshot(tab) -> Image.Image:
    """Return what a tab shows."""
    return Image.open(io.BytesIO(tab.screenshot(timeout=WAIT_MS))).convert("RGB")


def draw(browser, name: str) -> None:
    """Write the picture of a scene's page."""
    with show(browser, name) as (tab, _):
        box = tab.locator('img[src^="blob:"]').first.bounding_box()
        _, _, (right, down) = SCENES[name]
        tab.mouse.move(box["x"] + right * box["width"], box["y"] + down * box["height"])
        time.sleep(SETTLE_S)
        write_small_png(PICTURES / f"view_{name}.png", screenshot(tab))


def film(browser, path: Path) -> None:
    """Write a film of the pylon scene while the sonar turns."""
    frames = []
    with show(browser, "pylon") as (tab, session):
        # so that a browser that draws in software, on the cores that make the pings, keeps up with them
        session.change(max_rate_hz=2.0)
        for number in range(FILM_FRAMES):
            keys = {"arrowleft" if number < FILM_FRAMES // 2 else "arrowright", "w"}
            session.move(keys, 1.0, speed_m_s=0.1, turn_rate_rad_s=TURN_RAD)
            time.sleep(1.0)
            image = screenshot(tab)
            size = FILM_WIDTH, round(image.height * FILM_WIDTH / image.width)
            frames.append(image.resize(size, Image.Resampling.LANCZOS).quantize(64, dither=Image.Dither.NONE))
    with atomic_write(path) as name:
        frames[0].save(
            name,
            format="gif",
            save_all=True,
            append_images=frames[1:],
            duration=FRAME_MS,
            loop=0,
            optimize=True,
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--film", type=Path, metavar="GIF", help="write a film in place of the pictures")
    options = parser.parse_args()
    with open_browser() as browser:
        if options.film is not None:
            film(browser, options.film)
        else:
            for name in SCENES:
                draw(browser, name)


if __name__ == "__main__":
    main()
