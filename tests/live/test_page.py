"""The web page of a live session, in a browser without a window."""

import math
import re
import sys
import threading
import time
from contextlib import ExitStack
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import sonar_gl as sg
from sonar_gl.core.errors import Error
from sonar_gl.live.command_line import SceneSource
from sonar_gl.live.session import LiveSession
from sonar_gl.live.settings import LiveSettings
from sonar_gl.live.view import page as page_module
from sonar_gl.live.view.page import ViewerPage
from sonar_gl.live.view.scene_nodes import GIZMO_PIXELS
from tests.support.browser import COUNT_PICTURES, MissingBrowserError, open_browser
from tests.support.live_readings import brightest_pixel

pytestmark = pytest.mark.slow  # as a browser by software is; .ci/run runs them

viser = pytest.importorskip("viser", reason="viser, of the extra live, is missing")

PICTURE = 'img[src^="blob:"]'
WAIT_S = 60.0  # on a machine that draws WebGL by software and does other work beside it
DRAG_S = 10.0  # after which a drag that moved nothing is tried again
SIZE = {"width": 1000, "height": 700}
# Of a drag in five steps over 1.07 lengths of a gizmo's arrow, in such lengths: the one before the last ends at 0.86.
LAST_STEP = 1.0
# software WebGL draws the scene alone, not also the controls and pictures beside it, and a quarter of its pixels: tests
# read values of the page, and places in its own units
BY_PROCESSOR = "--disable-gpu-compositing", "--disable-gpu-rasterization"
DEVICE_SCALE = 0.5
OWN_SONAR = """
frequency_hz = 700e3
n_beams = 24
n_bins = 60
azimuth_fov_deg = 50.0
elevation_fov_deg = 20.0
beam_width_deg = 2.0
range_min_m = 0.5
range_max_m = 18.5
"""


def wait_for(what, timeout_s=WAIT_S):
    """Return the first value of a function that is true; fail if there is none in time."""
    end_s = time.monotonic() + timeout_s
    while time.monotonic() < end_s:
        if value := what():
            return value
        time.sleep(0.02)
    pytest.fail(f"waited {timeout_s:g} s in vain")


def camera_of(viewer):
    """The camera of the first tab, as the page knows it."""
    return next(iter(viewer.page.server.get_clients().values())).camera


def look(viewer, place):
    """Put the camera of the first tab to a (position, look_at), and wait until the tab has drawn that."""
    camera = camera_of(viewer)

    def is_there():
        return np.allclose([camera.position, camera.look_at], place, atol=1e-3)  # messages have float32

    def has_looked():
        camera.position, camera.look_at = place
        wait_until_drawn(viewer.tab)
        return is_there()  # else an older message of the tab came in between

    wait_for(has_looked)


def drag(viewer, place, along, point, has_moved):
    """Drag the gizmo at a point of the world by its arrow along an axis, until it has moved so far.

    Again, where a slow browser had not drawn the scene as it is by then. Such a drag turns the camera, which may put
    the gizmo below a panel, where no pointer reaches it: each starts with everything at home, and the camera in place.
    """
    mouse, end_s = viewer.tab.mouse, time.monotonic() + 2 * WAIT_S
    while time.monotonic() < end_s:
        put_home(viewer)
        look(viewer, place)
        gizmo_m = gizmo_length_m(viewer, point)
        mouse.move(*on_canvas(viewer, point + 0.93 * gizmo_m * along))
        mouse.down()
        mouse.move(*on_canvas(viewer, point + 2.0 * gizmo_m * along), steps=5)
        wait_s = time.monotonic() + DRAG_S
        while not (moved := has_moved(LAST_STEP * gizmo_m)) and time.monotonic() < wait_s:
            time.sleep(0.02)
        mouse.up()
        if moved:
            return
        wait_until_drawn(viewer.tab)  # the camera turns on for a while
    pytest.fail(f"dragged for {2 * WAIT_S:g} s in vain")


def put_home(viewer):
    """Put the sonar and the bodies where the scene has them, and the pointer where nothing is."""
    viewer.session.set_pose(viewer.session.scene.sonar_pose)
    viewer.session.reset_bodies()
    viewer.tab.mouse.move(5, 5)


@pytest.fixture(scope="module")
def viewer(tmp_path_factory):
    """A session, its page, a browser's tab that shows it, and what the tab asked for.

    There are few beams and bins, few pings a second, which share the processor with the browser, and speckle, since
    equal pictures are not sent again.
    """
    folder = tmp_path_factory.mktemp("view") / "out"
    sonar = replace(sg.load_sonar("p900-45").with_range(22.0), n_beams=64, n_bins=128, keeps_n_bins=True)
    settings = LiveSettings(
        sonar,
        acoustics=sg.Acoustics.ideal(),
        noise="speckle=yes",
        height=300,
        engine="cpu",
        max_rate_hz=10.0,
    )
    with ExitStack() as stack:
        try:
            browser = stack.enter_context(open_browser(*BY_PROCESSOR))
        except MissingBrowserError as why:
            pytest.skip(str(why))
        session = stack.enter_context(
            LiveSession(sg.load_scene("pylon"), settings, folder=folder, source=SceneSource("pylon"))
        )
        page = stack.enter_context(ViewerPage(session, port=0))
        tab = browser.new_page(viewport=SIZE, device_scale_factor=DEVICE_SCALE)
        requests, failures = [], []
        tab.on("request", lambda request: requests.append(request.url))
        tab.on("pageerror", lambda why: failures.append(f"{why}\n{why.stack}"))
        tab.on("websocket", lambda socket: requests.append(socket.url))
        tab.add_init_script(COUNT_PICTURES)
        tab.goto(page.url)
        tab.wait_for_selector(PICTURE, timeout=1000 * WAIT_S)
        tab.wait_for_function("window.sonarView", timeout=1000 * WAIT_S)  # page.js, which follows the pointer
        viewer = SimpleNamespace(
            browser=browser,
            session=session,
            page=page,
            tab=tab,
            requests=requests,
            failures=failures,
            folder=folder,
        )
        viewer.place = camera_of(viewer).position, camera_of(viewer).look_at
        yield viewer


@pytest.fixture(autouse=True)
def at_home(request):
    """Each test starts at the scene's pose, with nothing selected, and the pointer elsewhere."""
    if "viewer" in request.fixturenames:
        put_home(request.getfixturevalue("viewer"))


def new_pictures(tab, count=3):
    """Wait until the tab shows so many more pictures."""
    shown = tab.evaluate("window.pictures")
    wait_for(lambda: tab.evaluate("window.pictures") >= shown + count)


def wait_until_drawn(tab):
    """Wait until what was sent before has arrived, as pictures sent after it have, and the tab has drawn it."""
    new_pictures(tab)
    tab.evaluate(
        """async () => {
        for (let k = 0; k < 4; k++) await new Promise((done) => requestAnimationFrame(done));
        }"""
    )


def wait_until_still(session):
    """Wait until the sonar moves no more."""

    def is_still():
        before = session.pose
        time.sleep(0.3)
        return session.pose.tolist() == before.tolist()

    wait_for(is_still)


def control(tab, label):
    """The input beside a label."""
    row = tab.locator("label", has_text=re.compile(f"^{re.escape(label)}$")).locator(
        "xpath=ancestor::p/../.."
    )
    return row.locator("input:not([type=hidden])").last


def read_out(tab):
    """What stands under the picture."""
    return tab.get_by_text("under pointer").locator("xpath=../../..").inner_text()


def place_of(viewer, body):
    """A place of the page where the picture shows a body: the strongest of its pixels."""
    frame = viewer.session.next_frame()
    row, column = brightest_pixel(viewer.session, frame, body)
    box = viewer.tab.locator(PICTURE).first.bounding_box()
    height, width, _ = frame.picture.shape
    return box["x"] + (column + 0.5) / width * box["width"], box["y"] + (row + 0.5) / height * box["height"]


def test_pictures_follow_one_another(viewer):
    assert viewer.session.state().rate_hz > 0
    new_pictures(viewer.tab, 5)


def test_sonar_moves_while_a_key_is_held(viewer):
    session, tab = viewer.session, viewer.tab
    start = session.pose
    tab.keyboard.down("w")
    wait_for(lambda: np.linalg.norm(session.pose[:3, 3] - start[:3, 3]) > 0.3)
    tab.keyboard.up("w")
    wait_until_still(session)
    moved = session.pose[:3, 3] - start[:3, 3]
    assert moved / np.linalg.norm(moved) == pytest.approx(start[:3, 0], abs=1e-9)
    assert session.pose[:3, :3].tolist() == start[:3, :3].tolist()
    new_pictures(tab)
    tab.keyboard.down("ArrowLeft")
    wait_for(lambda: session.pose[1, 0] > 0.05)  # the boresight turns to port
    tab.keyboard.up("ArrowLeft")
    wait_until_still(session)  # the page learns of a released key later; the next test has another start


def test_keys_that_are_typed_move_nothing(viewer):
    start = viewer.session.pose
    field = control(viewer.tab, "speed, m/s")
    field.click()
    viewer.tab.keyboard.press("w")
    viewer.tab.keyboard.press("ArrowUp")
    viewer.tab.evaluate("document.activeElement.blur()")
    new_pictures(viewer.tab)
    assert viewer.session.pose.tolist() == start.tolist()


def test_a_control_changes_the_settings(viewer):
    field = control(viewer.tab, "range, m")
    field.fill("15")
    field.press("Enter")
    viewer.tab.evaluate("document.activeElement.blur()")
    wait_for(lambda: viewer.session.settings.range_m == 15.0)
    wait_for(lambda: viewer.session.frame.ping.range_m[-1] < 15.0)
    viewer.session.change(range_m=22.0)
    # what the session has, the control shows
    wait_for(lambda: control(viewer.tab, "range, m").input_value() == "22")


def test_a_slider_is_moved_by_keys(viewer):
    thumb = viewer.tab.locator('[role=slider][aria-valuenow="22"]').first  # of the range
    thumb.focus()
    thumb.press("ArrowLeft")
    wait_for(lambda: 20.0 < viewer.session.settings.range_m < 22.0)
    viewer.tab.evaluate("document.activeElement.blur()")
    wait_for(lambda: viewer.session.frame.ping.range_m[-1] < viewer.session.settings.range_m)
    viewer.session.change(range_m=22.0)
    wait_for(lambda: control(viewer.tab, "range, m").input_value() == "22")


def choose(tab, label, option):
    """Choose an option of a dropdown."""
    control(tab, label).click()
    tab.get_by_role("option", name=option, exact=True).click()


@pytest.mark.parametrize("typed", ["", "-"])
def test_a_number_that_is_emptied_comes_back_and_changes_nothing(viewer, typed):
    before, field = viewer.session.settings, control(viewer.tab, "range, m")
    shown = field.input_value()
    field.fill(typed)
    assert field.input_value() == typed
    viewer.tab.evaluate("document.activeElement.blur()")
    wait_for(lambda: field.input_value() == shown)
    wait_until_drawn(viewer.tab)
    assert viewer.session.settings == before and field.input_value() == shown


def box_of(tab, selector):
    """The box of an element, as (left, top, right, bottom)."""
    return tab.evaluate(
        """(selector) => {
        const box = document.querySelector(selector).getBoundingClientRect();
        return [box.left, box.top, box.right, box.bottom];
        }""",
        selector,
    )


@pytest.fixture
def narrow(viewer):
    """A session whose fan is 15 degrees wide."""
    session = viewer.session
    before = session.settings
    session.change(sonar=replace(before.sonar, azimuth_fov_deg=15.0))
    wait_for(lambda: session.frame.settings is session.settings)
    wait_until_drawn(viewer.tab)
    yield session
    session.change(sonar=before.sonar)
    wait_for(lambda: session.frame.settings is session.settings)


def test_a_narrow_picture_stands_in_the_middle_of_its_panel(viewer, narrow):
    left, _, right, _ = box_of(viewer.tab, PICTURE)
    panel = viewer.tab.locator(PICTURE).first.locator("xpath=..").bounding_box()
    assert right - left < panel["width"] / 2
    assert (left + right) / 2 == pytest.approx(panel["x"] + panel["width"] / 2, abs=1.0)  # a pixel


def test_marks_lie_over_the_picture_and_can_be_switched_off(viewer, narrow):
    tab, layer = viewer.tab, f"{PICTURE} + .sonar-marks"
    wait_for(lambda: box_of(tab, layer) == pytest.approx(box_of(tab, PICTURE), abs=1.0))  # a pixel
    marks = tab.locator(layer)
    wait_for(lambda: "20 m" in marks.inner_text())
    narrow.change(range_m=10.0)
    wait_for(lambda: "8 m" in marks.inner_text() and "20 m" not in marks.inner_text())
    narrow.change(range_m=22.0)
    control(tab, "range marks").click()
    wait_for(lambda: marks.inner_text() == "")
    control(tab, "range marks").click()
    wait_for(lambda: "20 m" in marks.inner_text())


@pytest.mark.parametrize("size", [(1024, 640), (853, 533)])  # the second is 1280 x 800 at a zoom of 150 %
def test_numbers_are_in_sight_in_a_small_window(viewer, size):
    tab = viewer.tab
    tab.set_viewport_size({"width": size[0], "height": size[1]})
    try:
        wait_for(lambda: box_of(tab, PICTURE)[3] < 0.7 * size[1])
        last = tab.get_by_text("to look around").bounding_box()
        assert last["y"] + last["height"] <= size[1]
    finally:
        tab.set_viewport_size(SIZE)


def test_a_phone_shows_the_picture_before_the_controls(viewer):
    phone = viewer.browser.new_page(viewport={"width": 390, "height": 844}, has_touch=True)
    phone.goto(viewer.page.url)
    phone.wait_for_selector(PICTURE, timeout=1000 * WAIT_S)
    wait_for(
        lambda: box_of(phone, PICTURE)[3] <= phone.get_by_text("moved by", exact=True).bounding_box()["y"]
    )
    left, top, right, bottom = box_of(phone, PICTURE)
    phone.touchscreen.tap((left + right) / 2, (top + bottom) / 2)
    wait_for(lambda: re.search(r"range\s*[\d.]+ m", read_out(phone)))
    phone.close()
    viewer.page.marked = None  # by the tap


def test_two_browsers_show_and_change_the_same(viewer):
    first, session = viewer.tab, viewer.session
    second = viewer.browser.new_page(viewport=SIZE)
    second.goto(viewer.page.url)
    second.wait_for_selector(PICTURE, timeout=1000 * WAIT_S)
    second.wait_for_function("window.sonarView", timeout=1000 * WAIT_S)
    for tab, other, range_text in ((first, second, "15"), (second, first, "22")):
        control(tab, "range, m").fill(range_text)
        tab.evaluate("document.activeElement.blur()")
        wait_for(lambda: session.settings.range_m == float(range_text))  # noqa: B023
        wait_for(lambda: control(other, "range, m").input_value() == range_text)  # noqa: B023
        control(tab, "range marks").click()
        shows = range_text == "22"
        wait_for(lambda: control(other, "range marks").is_checked() is shows)  # noqa: B023
        start = session.pose
        tab.keyboard.down("w")
        wait_for(lambda: np.linalg.norm(session.pose[:3, 3] - start[:3, 3]) > 0.3)  # noqa: B023
        tab.keyboard.up("w")
        wait_until_still(session)
    second.close()


def test_noise_water_and_engine_are_those_of_the_next_pings(viewer):
    session, tab = viewer.session, viewer.tab
    before = session.settings
    folders = [tab.get_by_text(name, exact=True) for name in ("Acoustics and noise", "Water")]
    try:
        for folder in folders:
            folder.click()
        control(tab, "salinity, psu").wait_for(state="visible", timeout=1000 * WAIT_S)
        choose(tab, "noise", "none")
        field = control(tab, "temperature, °C")
        field.fill("4")
        field.press("Enter")
        choose(tab, "engine", "auto")
        water = replace(before.water, temperature_c=4.0)
        expected = before.changed(noise="none", water=water, engine="auto")
        wait_for(lambda: session.frame.settings == expected)
        assert session.frame.ping.acoustics.water == water
        tab.get_by_text("speckle", exact=True).click()  # a term by itself, which no profile of noise has
        wait_for(lambda: control(tab, "noise").input_value() == "other")
        assert session.settings == expected.switched("speckle", True)
    finally:
        for folder in folders:
            folder.click()
        tab.evaluate("document.activeElement.blur()")
        session.change(noise=before.noise, acoustics=before.acoustics, engine=before.engine)
    wait_for(lambda: control(tab, "engine").input_value() == "cpu")


def test_a_sonar_of_ones_own_is_offered_beside_the_presets(viewer, tmp_path):
    session, tab, given = viewer.session, viewer.tab, viewer.session.settings.sonar
    dropdown = control(tab, "sonar")
    assert dropdown.input_value() == "p900-45 (given)"  # it differs from the preset of that name
    file = tmp_path / "mine.toml"
    file.write_text(OWN_SONAR)
    own = sg.load_sonar(str(file))
    session.change(sonar=own, range_m=None)
    wait_for(lambda: dropdown.input_value() == own.name)
    wait_for(lambda: session.frame.ping.intensity.shape == (24, 60))
    new_pictures(tab)
    dropdown.click()
    tab.get_by_role("option", name="p900-45 (given)", exact=True).click()
    wait_for(lambda: session.settings.sonar == given)
    dropdown.click()
    tab.get_by_role("option", name=own.name, exact=True).click()
    wait_for(lambda: session.settings.sonar == own)
    session.change(sonar=given, range_m=22.0)
    wait_for(lambda: dropdown.input_value() == "p900-45 (given)")


def test_the_pointer_reads_what_is_under_it(viewer):
    def read_pylon():
        # as a hand does, it moves on: a single event is lost where the page is laid out anew meanwhile
        viewer.tab.mouse.move(*place_of(viewer, "pylon_square"))
        time.sleep(0.5)
        shown = read_out(viewer.tab)
        return shown if "pylon_square" in shown else None

    text = wait_for(read_pylon)
    range_m = float(re.search(r"range\s*([\d.]+) m", text)[1])
    azimuth_deg = float(re.search(r"azimuth\s*([+-][\d.]+)°", text)[1])
    # its walls: 15.5 m ahead, 3.7 m to starboard, 3 m wide; beams are 1° wide
    assert 13.0 < range_m < 17.5
    assert -22.0 < azimuth_deg < -6.0
    viewer.tab.mouse.move(5, 5)
    wait_for(lambda: "pylon_square" not in read_out(viewer.tab))


def test_a_click_marks_the_surface_of_the_bin(viewer):
    x, y = place_of(viewer, "pylon_square")
    viewer.tab.mouse.click(x, y)
    surface = wait_for(lambda: viewer.page.marked)
    names = [body.name for body in viewer.session.scene.bodies]
    assert 1 + names.index("pylon_square") in set(surface.body_id.tolist())
    distances = np.linalg.norm(surface.points_m - viewer.session.pose[:3, 3], axis=1)
    bin_m = viewer.session.frame.ping.bin_size_m
    assert distances.max() - distances.min() < 3 * bin_m  # a bin, and a footprint on either side


def test_a_selected_body_stands_out(viewer):
    select = control(viewer.tab, "selected")
    viewer.tab.get_by_text("Bodies", exact=True).click()
    select.wait_for(state="visible", timeout=1000 * WAIT_S)
    select.click()
    viewer.tab.get_by_role("option", name="pylon_square").click()
    wait_for(lambda: viewer.session.highlighted == "pylon_square")
    frame = wait_for(lambda: viewer.session.frame if viewer.session.frame.highlight is not None else None)
    assert frame.highlight.any() and not frame.highlight.all()
    select.click()
    viewer.tab.get_by_role("option", name="none").click()
    wait_for(lambda: viewer.session.highlighted == "")
    viewer.tab.get_by_text("Bodies", exact=True).click()


def on_canvas(viewer, point):
    """The place of the page where a point of the world is drawn."""
    camera = camera_of(viewer)
    box = viewer.tab.locator("canvas").first.bounding_box()
    ahead = camera.look_at - camera.position
    ahead = ahead / np.linalg.norm(ahead)
    right = np.cross(ahead, camera.up_direction)
    right = right / np.linalg.norm(right)
    offset = point - camera.position
    scale = box["height"] / 2 / math.tan(camera.fov / 2) / (offset @ ahead)
    return (
        box["x"] + box["width"] / 2 + scale * (offset @ right),
        box["y"] + box["height"] / 2 - scale * (offset @ np.cross(right, ahead)),
    )


def gizmo_length_m(viewer, point):
    """The length in the world of a gizmo's arrow at a point: so many pixels at its distance."""
    camera = camera_of(viewer)
    ahead = camera.look_at - camera.position
    depth_m = (point - camera.position) @ ahead / np.linalg.norm(ahead)
    height = viewer.tab.locator("canvas").first.bounding_box()["height"]
    return GIZMO_PIXELS * depth_m * 2 * math.tan(camera.fov / 2) / height


def test_the_gizmo_drags_a_body_that_was_clicked(viewer):
    session, mouse, tab = viewer.session, viewer.tab.mouse, viewer.tab
    home, up = session.bodies()["pylon_square"], np.array([0.0, 0.0, 1.0])
    (pylon,) = (one for one in session.scene.bodies if one.name == "pylon_square")
    middle = (home @ [*pylon.mesh.bounds.mean(0), 1.0])[:3]  # where the gizmo is
    place = middle - 12.0 * np.eye(3)[0] + 8.0 * up, middle
    look(viewer, place)
    mouse.move(*on_canvas(viewer, middle))
    mouse.click(*on_canvas(viewer, middle))
    tab.get_by_role("button", name="Unselect").wait_for(timeout=1000 * WAIT_S)
    assert session.highlighted == "pylon_square"
    drag(
        viewer, place, up, middle, lambda far_m: (session.bodies()["pylon_square"] - home)[:3, 3] @ up > far_m
    )
    moved = (session.bodies()["pylon_square"] - home)[:3, 3]
    assert moved - (moved @ up) * up == pytest.approx(np.zeros(3), abs=1e-3)  # messages have float32
    tab.get_by_role("button", name="Unselect").click()
    wait_for(lambda: session.highlighted == "")


@pytest.mark.parametrize("axis", [0, 2])  # the first is below the picture
def test_the_gizmo_drags_the_sonar(viewer, axis):
    session, start = viewer.session, viewer.session.pose
    along = start[:3, axis]
    gizmo = viewer.page.server.scene.get_handle_by_name("/move_sonar")
    # pictures are shown before the scene is: of slow browsers it changes each 1.5 s
    wait_for(lambda: np.allclose(gizmo.position, start[:3, 3], atol=1e-6))
    new_pictures(viewer.tab, 10)
    drag(
        viewer,
        viewer.place,
        along,
        start[:3, 3],
        lambda far_m: (session.pose[:3, 3] - start[:3, 3]) @ along > far_m,
    )
    wait_until_still(session)  # the page learns of the end of a drag later; the next test has another start
    moved = session.pose[:3, 3] - start[:3, 3]
    # along its axis; messages have float32
    assert moved - (moved @ along) * along == pytest.approx(np.zeros(3), abs=1e-3)


def test_files_are_written_into_the_folder(viewer):
    tab, folder = viewer.tab, viewer.folder
    tab.get_by_role("button", name="Record", exact=True).click()
    tab.get_by_role("button", name="Stop recording").wait_for(timeout=1000 * WAIT_S)
    new_pictures(tab, 5)
    tab.get_by_role("button", name="Stop recording").click()
    wait_for(lambda: not viewer.session.output.is_recording)
    tab.get_by_role("button", name="Save picture").click()
    tab.get_by_role("button", name="Add pose to job").click()
    kinds = {".npz", ".mp4", ".csv", ".png", ".toml"}
    wait_for(lambda: kinds <= {path.suffix for path in folder.rglob("*")})
    tab.get_by_text("Pose added").wait_for(timeout=1000 * WAIT_S)


def test_the_command_line_can_be_copied(viewer):
    viewer.tab.get_by_role("button", name="Command line").click()
    field = viewer.tab.locator("textarea:visible").first
    field.wait_for(timeout=1000 * WAIT_S)
    assert field.input_value() == viewer.session.output.command_line()
    viewer.tab.context.grant_permissions(["clipboard-read", "clipboard-write"])
    viewer.tab.get_by_role("button", name="Copy", exact=True).click()
    wait_for(lambda: viewer.tab.evaluate("navigator.clipboard.readText()") == field.input_value())
    viewer.tab.get_by_role("button", name="Close", exact=True).click()
    wait_for(lambda: not field.is_visible())


def test_what_fails_is_told_and_the_page_goes_on(viewer):
    job = viewer.folder / "poses.toml"
    job.parent.mkdir(exist_ok=True)
    job.write_text("this is no job")
    try:
        viewer.tab.get_by_role("button", name="Add pose to job").click()
        viewer.tab.get_by_text("That did not work").wait_for(timeout=1000 * WAIT_S)
        viewer.tab.get_by_text("poses.toml").last.wait_for(timeout=1000 * WAIT_S)
    finally:
        job.unlink()
    new_pictures(viewer.tab)


def test_a_browser_that_closes_stops_no_other(viewer):
    second = viewer.browser.new_page(viewport=SIZE)
    second.add_init_script(COUNT_PICTURES)
    second.goto(viewer.page.url)
    second.wait_for_selector(PICTURE, timeout=1000 * WAIT_S)
    new_pictures(second)
    new_pictures(viewer.tab)
    second.close()
    new_pictures(viewer.tab)


def test_the_camera_carries_the_sonar(viewer):
    session, tab = viewer.session, viewer.tab
    mover = control(tab, "moved by")
    mover.click()
    tab.get_by_role("option", name="browser's camera").click()
    client = next(iter(viewer.page.server.get_clients().values()))
    wait_for(lambda: np.allclose(client.camera.position, session.pose[:3, 3], atol=1e-3))
    client.camera.position = (1.0, 2.0, -4.0)
    wait_for(lambda: np.allclose(session.pose[:3, 3], (1.0, 2.0, -4.0), atol=1e-3))
    ahead = client.camera.look_at - client.camera.position
    assert session.pose[:3, 0] == pytest.approx(ahead / np.linalg.norm(ahead), abs=1e-3)  # float32 on the way
    mover.click()
    tab.get_by_role("option", name="keys and gizmo").click()
    wait_for(lambda: not np.allclose(client.camera.position, session.pose[:3, 3], atol=1.0))


def test_no_request_leaves_the_machine(viewer):
    assert len(viewer.requests) > 2
    local = re.compile(r"(blob:http|http|ws)://127\.0\.0\.1:\d+(/|$)")
    assert [url for url in viewer.requests if not (local.match(url) or url.startswith("data:"))] == []
    assert viewer.page.server.request_share_url() is None
    assert viewer.failures == []


# ---- without a browser ------------------------------------------------------------------------------------------


@pytest.fixture
def session(tmp_path):
    sonar = replace(sg.load_sonar("p900-45").with_range(22.0), n_beams=16, n_bins=32, keeps_n_bins=True)
    settings = LiveSettings(sonar, acoustics=sg.Acoustics.ideal(), noise="none", height=60, engine="cpu")
    with LiveSession(sg.load_scene("pylon"), settings, folder=tmp_path) as session:
        yield session


def test_a_session_does_not_ping_for_a_page_that_nobody_sees(session):
    with ViewerPage(session, port=0):
        first = session.frame.number
        time.sleep(0.5)  # ten pings and more
        assert session.frame.number == first


def test_a_closed_page_frees_its_port_and_its_threads(session):
    with ViewerPage(session, port=0) as page:
        port = page.server.get_port()
        page.close()
    with ViewerPage(session, port=port) as again:
        assert again.url == f"http://127.0.0.1:{port}"


def test_a_host_that_is_not_of_this_machine_is_an_error(session):
    for host in ("192.0.2.1", "no such host", ""):  # the first is for documentation
        with pytest.raises(Error, match="host must be an address of this machine"):
            ViewerPage(session, host=host, port=0)


def test_a_page_that_cannot_be_made_stops_its_server(session, monkeypatch):
    def fail(*_):
        raise RuntimeError("no panel")

    before = set(threading.enumerate())
    monkeypatch.setattr(page_module, "ControlPanel", fail)
    with pytest.raises(RuntimeError, match="no panel"):
        ViewerPage(session, port=0)
    wait_for(lambda: set(threading.enumerate()) <= before)


def test_a_page_prints_nothing_and_leaves_the_output_as_it_is(session, capsys):
    output = sys.stdout
    with ViewerPage(session, port=0):
        assert sys.stdout is output
    assert capsys.readouterr().out == ""


def test_the_address_of_ipv6_has_brackets(session):
    with ViewerPage(session, host="::1", port=0) as page:
        assert re.fullmatch(r"http://\[::1\]:\d+", page.url)
