"""A browser without a window, for tests and pictures of web pages: Debian's chromium, driven by Playwright."""

from __future__ import annotations

import shutil
from contextlib import contextmanager

NAMES = "chromium", "chromium-browser", "google-chrome", "chrome"
# draws WebGL by software, since test machines have no graphics card; as root, as in CI, a sandbox is not to be had
OPTIONS = ["--no-sandbox", "--enable-unsafe-swiftshader", "--use-angle=swiftshader"]
# counts new pictures; software WebGL draws a frame or two per second, so that frames would not do
COUNT_PICTURES = """
window.pictures = 0;
new MutationObserver((changes) => {
  window.pictures += changes.filter((one) => one.target instanceof HTMLImageElement).length;
}).observe(document, { subtree: true, attributes: true, attributeFilter: ["src"] });
"""


class MissingBrowserError(RuntimeError):
    """There is no browser to be driven, or nothing that drives it."""


@contextmanager
def open_browser(*options: str):
    """Yield a playwright Browser that has further options; raise MissingBrowserError where there is none."""
    try:
        from playwright.sync_api import sync_playwright
    except ImportError:
        raise MissingBrowserError("Playwright, of the extra test, is missing") from None
    path = next((found for found in map(shutil.which, NAMES) if found), None)
    if path is None:
        raise MissingBrowserError("there is no Chromium (apt-get install chromium brings it in)")
    with sync_playwright() as running:
        browser = running.chromium.launch(executable_path=path, args=[*OPTIONS, *options])
        try:
            yield browser
        finally:
            browser.close()
