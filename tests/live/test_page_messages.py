"""The web page of a live session, told by messages as a browser sends them."""

import re
import threading
import time
from contextlib import contextmanager
from dataclasses import replace

import cv2
import numpy as np
import pytest
import trimesh

import sonar_gl as sg
from sonar_gl.analysis import terms as terms_module
from sonar_gl.core.pose_track import PoseTrack
from sonar_gl.live import live_sonar as live_sonar_module
from sonar_gl.live import recording as recording_module
from sonar_gl.live.session import LiveSession
from sonar_gl.live.settings import LiveSettings
from sonar_gl.live.view import page as page_module
from sonar_gl.live.view.control_panel import MAX_OWN
from sonar_gl.live.view.page import ViewerPage
from sonar_gl.live.view.scene_nodes import pose_of
from sonar_gl.live.viewer import LiveView
from tests.support.live_readings import brightest_pixel
from tests.support.viser_client import connected
from tests.support.waiting import WAIT_S, wait_until

viser = pytest.importorskip("viser", reason="viser, of the extra live, is missing")

SONAR = replace(sg.load_sonar("p900-45").with_range(22.0), n_beams=16, n_bins=32, keeps_n_bins=True)
SETTINGS = LiveSettings(SONAR, acoustics=sg.Acoustics.ideal(), noise="none", height=60, engine="cpu")
ELSEWHERE = (1.0, 0.0, 0.0, 0.0), (3.0, 1.0, -4.0)
IN_THE_PICTURE = [0.5, 0.4]
STRAIGHT = PoseTrack([sg.pose(0, 0, -5), sg.pose(4, 0, -5)], [0.0, 0.4])


@pytest.fixture(scope="module")
def scene():
    return sg.load_scene("pylon")


@pytest.fixture
def session(scene, tmp_path):
    with LiveSession(scene, SETTINGS, folder=tmp_path / "out") as one:
        yield one


@contextmanager
def browsing(session):
    """Open a page of a session, and a browser that shows it."""
    with ViewerPage(session, port=0) as page, connected(page.url) as browser, telling(browser):
        yield browser


@pytest.fixture
def page(session):
    with ViewerPage(session, port=0) as one:
        yield one


@pytest.fixture
def browser(page):
    with connected(page.url) as one, telling(one):
        yield one


@contextmanager
def telling(client):
    """Repeat a browser's state as page.js does, but more often, since the page shows what came before one."""
    is_over = threading.Event()

    def tell():
        while not is_over.wait(0.05):  # there 0.25
            client.tell()

    thread = threading.Thread(target=tell, daemon=True)
    thread.start()
    try:
        yield
    finally:
        is_over.set()
        thread.join()


def position(session):
    return session.pose[:3, 3].tolist()


def body_node(session, name):
    """Name of the node that shows a body."""
    return f"/bodies/{[body.name for body in session.scene.bodies].index(name)}"


def numbers(browser):
    """The HTML with the numbers of the session."""
    texts = [one["content"] for one in browser.values.values() if "ping rate" in str(one.get("content"))]
    return texts[0] if texts else ""


# ---- what drags and clicks do -------------------------------------------------------------------------------


def test_a_body_is_dragged_and_put_back(session, browser):
    node, home = body_node(session, "box"), session.bodies()["box"][:3, 3].tolist()
    browser.change("selected", "box")
    wait_until(lambda: browser.nodes["/move_body"]["visible"])  # as a user does
    browser.drag("/move_body", *ELSEWHERE)
    moved = wait_until(lambda: browser.nodes[node]["position"] != home and browser.nodes[node]["position"])
    assert moved == pytest.approx(session.bodies()["box"][:3, 3])
    browser.press("Put all back")
    wait_until(lambda: browser.nodes[node]["position"] == home)
    assert session.bodies()["box"][:3, 3].tolist() == home


@pytest.mark.slow
def test_a_mesh_in_utm_and_the_sonar_before_it_are_shown_in_their_places(tmp_path):
    """Its vertices are relative to its middle, since browsers round them to float32, and all to a place near by."""
    away = np.array([500_000.0, 4_500_000.25, -30.0])
    wall = trimesh.creation.box((0.2, 4.0, 4.0)).apply_translation(away)
    scene = sg.Scene([sg.Body("wall", wall)], sonar_pose=sg.pose(*away - [5.0, 0.0, 0.0]))
    with LiveSession(scene, SETTINGS, folder=tmp_path / "out") as session, browsing(session) as browser:
        home = wait_until(lambda: browser.nodes.get("/bodies/0", {}).get("position"))
        there = wait_until(lambda: browser.nodes.get("/sonar", {}).get("position"))
        assert np.subtract(home, there).tolist() == [5.0, 0.0, 0.0] and np.abs(home).max() <= 500.0
        # viser takes moves as none that are less than a hundred-thousandth of a position, here 45 m
        session.set_pose(sg.pose(*away - [4.5, 0.0, 0.0]))
        at = wait_until(lambda: (at := browser.nodes["/sonar"]["position"]) != there and at)
        assert np.subtract(home, at).tolist() == [4.5, 0.0, 0.0]
        browser.drag("/move_sonar", (1.0, 0.0, 0.0, 0.0), np.subtract(home, [3.0, 0.0, 0.0]).tolist())
        wait_until(lambda: position(session) == (away - [3.0, 0.0, 0.0]).tolist())


def words(browser, label):
    """The text of the HTML that begins with a label; "" for none."""
    texts = (re.sub("<[^>]*>", " ", str(one.get("content") or "")).strip() for one in browser.values.values())
    return next((text for text in texts if text.startswith(label)), "")


def green_pixels(browser):
    """How many pixels of the picture have the colour of a selected body's outline, which copper has not."""
    data = next(one["_data"] for one in browser.values.values() if "_data" in one)
    red, green, _ = np.moveaxis(
        cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)[..., ::-1].astype(int), -1, 0
    )
    return int((green > red + 60).sum())


def test_a_selected_body_is_named_and_outlined_until_it_is_unselected(session, browser):
    wait_until(lambda: "/sonar/picture_0" in browser.nodes)
    assert words(browser, "selected") == "" and green_pixels(browser) == 0
    unselect = browser.values[browser.uuid("Unselect")]
    assert not unselect["visible"]
    browser.send(
        type="SceneNodeClickMessage",
        name=body_node(session, "floor"),
        instance_index=None,
        ray_origin=(0.0, 0.0, 40.0),
        ray_direction=(0.0, 0.0, -1.0),
        screen_pos=(0.5, 0.5),
        modifier=None,
    )
    wait_until(lambda: "floor" in words(browser, "selected") and unselect["visible"])
    assert "Drag its arrows" in words(browser, "selected")
    wait_until(lambda: browser.shown("selected") == "floor")
    wait_until(lambda: green_pixels(browser) > 20)
    # a body around its gizmo, or a picture above, would take the pointer from it
    assert browser.nodes[body_node(session, "floor")]["bindings"] == []
    assert browser.nodes["/sonar/picture_0"].get("bindings", []) == []
    assert browser.nodes[body_node(session, "box")]["bindings"] != []
    browser.press("Unselect")
    wait_until(lambda: session.highlighted == "" and not unselect["visible"])
    wait_until(lambda: words(browser, "selected") == "" and green_pixels(browser) == 0)
    assert browser.shown("selected") == "none"
    assert browser.nodes["/move_body"]["visible"] is False
    assert browser.nodes[body_node(session, "floor")]["bindings"] != []


@pytest.mark.slow
def test_the_page_says_what_the_last_click_has_met(session, page, browser):
    row, column = brightest_pixel(session, session.frame, "pylon_square")
    height, width, _ = session.frame.picture.shape
    there = [(column + 0.5) / width, (row + 0.5) / height]
    browser.tell(pointer=there)
    wait_until(lambda: "pylon_square" in read_out(browser))  # the page knows of this browser's clicks, none
    assert words(browser, "last click") == ""
    browser.tell(clicks=1, clicked=there)
    range_m = session.at(session.frame, row, column).range_m
    wait_until(lambda: f"pylon_square at {range_m:.2f} m, pink in 3D" in words(browser, "last click"))
    browser.tell(clicks=2, clicked=[0.01, 0.99])  # outside the fan
    wait_until(lambda: words(browser, "last click") == "")
    assert page.marked is None


def test_a_body_that_is_taken_away_is_not_drawn(session, browser):
    node = body_node(session, "box")
    wait_until(lambda: "/sonar/picture_0" in browser.nodes)
    session.move_body("box", None)
    wait_until(lambda: browser.nodes[node].get("visible") is False)
    session.reset_bodies()
    wait_until(lambda: browser.nodes[node]["visible"])


def placed(node):
    """The pose that a browser shows a node at, (4, 4)."""
    return pose_of(node["wxyz"], node["position"])


@pytest.mark.slow
def test_the_fan_and_its_picture_tilt_with_the_head(session, browser):
    wait_until(lambda: "wxyz" in browser.nodes.get("/sonar/picture_0", {}))
    outlines, flat = browser.counts["/sonar/outline"], placed(browser.nodes["/sonar/picture_0"])
    turn = sg.pose(pitch=np.radians(30.0))  # down
    session.change(sonar=replace(session.settings.sonar, tilt_deg=30.0))
    # float32 at 22 m
    wait_until(lambda: np.allclose(placed(browser.nodes["/sonar/picture_0"]), turn @ flat, atol=1e-5))
    # it is drawn anew; what it is then, test_view_parts.py says
    assert browser.counts["/sonar/outline"] > outlines


@pytest.mark.slow
def test_a_browser_that_is_slow_slows_the_scene_alone_and_no_longer_than_a_bound(
    session, page, browser, monkeypatch
):
    bound_s = 0.3
    monkeypatch.setattr(page_module, "LONGEST_NODES_S", bound_s)

    def counted():
        return browser.counts["/sonar/picture_0"], browser.counts[panel]

    wait_until(lambda: "/sonar/picture_0" in browser.nodes)
    panel = next(uuid for uuid, one in browser.values.items() if "_data" in one)
    session.change(noise="speckle=yes")  # equal pictures are not sent again
    with connected(page.url) as slow, telling(slow):
        slow.tell(frame_s=5.0)
        time.sleep(2 * bound_s)  # until that has come
        began_s, (scene, pictures), number = time.monotonic(), counted(), session.frame.number
        wait_until(lambda: counted()[0] >= scene + 5)  # goes on
        gone_s, frames = time.monotonic() - began_s, session.frame.number - number
    shown = counted()[1]
    # the first may have been due at once, and messages come late by a little
    assert gone_s > 3.5 * bound_s
    # all frames but a few come to the panel of the other
    assert shown - pictures > 0.5 * frames > 2 * 5


def read_out(browser):
    """The HTML with what is under the pointer."""
    return next(
        one["content"] for one in browser.values.values() if "under pointer" in str(one.get("content"))
    )


def test_clicks_before_a_connection_that_was_lost_are_not_done_again(session, page, browser):
    browser.tell(clicks=3, clicked=IN_THE_PICTURE)
    browser.change("speed, m/s", 2.0)  # is done later
    with connected(page.url) as second:
        second.tell(clicks=3, clicked=IN_THE_PICTURE)
        wait_until(lambda: second.shown("speed, m/s") == 2.0)
        second.tell(keys=["w"])
        start = position(session)
        wait_until(lambda: position(session) != start)
    assert page.marked is None


def test_a_browser_that_has_gone_before_its_turn_is_passed_over(session, page, browser, monkeypatch, recwarn):
    """viser warns of what is sent to it, of which a user can do nothing."""
    is_inside, may_go_on = threading.Event(), threading.Event()

    def wait(_pose):
        is_inside.set()
        assert may_go_on.wait(WAIT_S)

    monkeypatch.setattr(session, "set_pose", wait)
    browser.drag("/move_sonar", *ELSEWHERE)
    assert is_inside.wait(WAIT_S)
    with connected(page.url):
        wait_until(lambda: len(page.server.get_clients()) == 2)
    wait_until(lambda: len(page.server.get_clients()) == 1)
    may_go_on.set()
    with connected(page.url) as last:  # welcomed after what had waited
        wait_until(lambda: "speed, m/s" in last.uuids)
        browser.change("speed, m/s", 3.0)
        wait_until(lambda: last.shown("speed, m/s") == 3.0)
    assert [str(one.message) for one in recwarn] == []


# ---- what the page reads ------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_pointer_is_read_once_and_no_more_once_its_browser_is_gone(session, page, monkeypatch):
    reads = []
    at = session.at
    monkeypatch.setattr(session, "at", lambda *place: reads.append(place) or at(*place))
    with connected(page.url) as browser:
        for step in range(200):
            browser.tell(pointer=[0.5, 0.3 + 0.001 * step])
        wait_until(lambda: reads)
        wait_until(lambda: "dB" in read_out(browser))
    wait_until(lambda: not page.server.get_clients())
    time.sleep(0.6)  # two read-outs and more
    n_reads = len(reads)
    assert n_reads < 20  # of 200 places: it takes the newest
    time.sleep(0.6)
    assert len(reads) == n_reads


# ---- who may ask --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "headers",
    [
        {"Origin": "https://example.org"},
        pytest.param({"Origin": "null"}, marks=pytest.mark.slow),
        pytest.param({"Origin": "http://127.0.0.1:1"}, marks=pytest.mark.slow),
        {"Host": "example.org:8080", "Origin": "http://example.org:8080"},  # a name that means 127.0.0.1
    ],
)
def test_other_web_sites_are_refused(page, headers):
    from websockets.exceptions import InvalidStatus

    with pytest.raises(InvalidStatus, match="403"), connected(page.url, **headers):
        pass
    assert page.server.get_clients() == {}


def test_the_page_itself_and_programs_are_served(page):
    for headers in ({"Origin": page.url}, {}):
        with connected(page.url, **headers) as browser:
            wait_until(lambda browser=browser: "Record" in browser.uuids)


# ---- what fails ---------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_speed_that_is_no_number_is_refused(session, browser):
    browser.change("speed, m/s", float("nan"))
    wait_until(lambda: browser.notes == ["speed must lie in 0.1..10 (got nan; give m/s)"])
    start = position(session)
    browser.tell(keys=["w"])
    wait_until(lambda: position(session) != start)
    assert browser.shown("speed, m/s") == 1.0


def test_numbers_beyond_the_ends_of_a_slider_are_refused_in_its_own_words(session, browser):
    before = session.settings
    for label, value, why in (
        ("tolerance, %", 50.0, "tolerance must lie in 0.5..20 (got 50; give %)"),
        ("pings per s", 0.0, "pings per s must lie in 1..60 (got 0)"),
        ("gain, dB", 100.0, "gain must lie in -40..60 (got 100; give dB)"),
        ("depth, m", -3.0, "depth must lie in 0..1000 (got -3; give m)"),
    ):
        browser.change(label, value)
        wait_until(lambda why=why: browser.notes[-1:] == [why])
        wait_until(lambda label=label, value=value: browser.shown(label) != value)
        wait_until(lambda label=label, value=value: browser.shown(label) != value)
    assert session.settings == before


@pytest.mark.slow
def test_sliders_show_numbers_in_force_beyond_their_ends(session, browser):
    water = replace(session.settings.water, depth_m=3000.0)
    session.change(
        tolerance=0.3,
        max_rate_hz=0.25,
        gain_db=80.0,
        acoustics=replace(session.settings.acoustics, water=water),
    )
    for label, value, end in (
        ("tolerance, %", 30.0, "max"),
        ("pings per s", 0.25, "min"),
        ("gain, dB", 80.0, "max"),
        ("depth, m", 3000.0, "max"),
    ):
        wait_until(lambda label=label, value=value: browser.shown(label) == value)
        assert browser.values[browser.uuid(label)][end] == value
    assert browser.values[browser.uuid("pings per s")]["precision"] == 2
    session.change(tolerance=0.05)
    wait_until(lambda: browser.values[browser.uuid("tolerance, %")]["max"] == 20.0)


def test_a_part_of_the_page_that_fails_stops_no_other(session, browser, monkeypatch, caplog):
    def fail(*_):
        raise RuntimeError("keys are broken")

    monkeypatch.setattr(session, "move", fail)
    browser.tell(keys=["w"])
    wait_until(lambda: "keys are broken" in caplog.text)
    browser.change("range, m", 15.0)
    wait_until(lambda: session.frame.settings.range_m == 15.0)
    browser.drag("/move_sonar", *ELSEWHERE)
    wait_until(lambda: browser.nodes["/sonar"].get("position") == list(ELSEWHERE[1]))
    assert caplog.text.count("Traceback") == 1


@pytest.mark.slow
def test_a_recording_that_fails_is_reported_to_all(session, page, browser, monkeypatch):
    def full(path, _ping):
        raise sg.Error(f"cannot write {str(path)!r}: No space left on device")

    with connected(page.url) as second:
        wait_until(lambda: len(page.server.get_clients()) == 2)
        monkeypatch.setattr(recording_module, "save_npz", full)
        browser.press("Record")
        for one in (browser, second):
            wait_until(lambda one=one: any("No space left" in note for note in one.notes))
    assert not session.output.is_recording and session.output.problem == ""
    record = browser.uuids["Record"]
    wait_until(lambda: browser.values[record]["label"] == "Record")


def test_a_recording_that_ends_names_its_folder_once(session, browser):
    browser.press("Record")
    wait_until(lambda: session.output.n_recorded >= 3)
    browser.press("Record")
    wait_until(lambda: len(browser.notes) == 2)
    # the name first, since a browser cuts off what is too long for a line
    assert browser.notes[1] == f"{session.output.n_recorded} pings into pylon_0001 in {session.output.folder}"


@pytest.mark.slow
def test_a_recording_goes_on_without_a_browser_and_the_log_says_so(scene, tmp_path, caplog):
    folder = tmp_path / "out" / "pylon_0001"
    session = LiveSession(scene, SETTINGS, folder=tmp_path / "out")
    with LiveView(session, "127.0.0.1", 0) as view:
        with connected(view.url) as first, telling(first):
            with connected(view.url) as second:
                first.press("Record")
                wait_until(lambda: session.output.n_recorded >= 2)
                assert second.uuids
            wait_until(lambda: session.output.n_recorded >= 4)
            assert not caplog.messages  # one browser is left
        wait_until(lambda: caplog.messages)
        number = session.output.n_recorded
        wait_until(lambda: session.output.n_recorded >= number + 2)
    number = session.output.n_recorded
    assert caplog.messages == [
        f"the last browser has gone, and the recording into {folder} goes on until a browser stops it or this program "
        "ends",
        f"the recording has ended: {number} pings in {folder}",
    ]
    assert len(list(folder.glob("ping_*.npz"))) == number and (folder / "film.mp4").exists()


def test_the_log_is_silent_when_the_last_browser_goes_and_nothing_is_recorded(session, page, caplog):
    before = set(threading.enumerate())

    def listeners():
        return [one for one in set(threading.enumerate()) - before if one.name == "sonar_gl listener"]

    with connected(page.url):
        wait_until(listeners)
    wait_until(lambda: not listeners())
    assert not caplog.messages


@pytest.mark.slow
def test_pings_that_fail_are_reported_without_a_frame(session, browser, monkeypatch):
    wait_until(lambda: session.frame.number > 0)

    def fail(*_):
        raise sg.Error("the ping must succeed (got none)")

    monkeypatch.setattr(live_sonar_module, "picture_of", fail)
    wait_until(lambda: "the ping must succeed (got none)" in numbers(browser))
    monkeypatch.undo()
    wait_until(lambda: "the ping must succeed (got none)" not in numbers(browser))


@pytest.mark.slow
def test_the_page_says_that_the_picture_is_of_the_settings_before(session, browser, monkeypatch):
    wait_until(lambda: "Hz" in words(browser, "ping rate"))
    may_go_on = threading.Event()
    made = live_sonar_module.picture_of

    def slowly(*values):
        assert may_go_on.wait(WAIT_S)
        return made(*values)

    monkeypatch.setattr(live_sonar_module, "picture_of", slowly)
    browser.change("range, m", 12.0)
    wait_until(lambda: "computing with the new settings" in words(browser, "ping rate"))
    assert session.frame.settings.range_m != 12.0
    may_go_on.set()
    wait_until(lambda: "Hz" in words(browser, "ping rate"))
    assert session.frame.settings.range_m == 12.0


@pytest.mark.slow
def test_the_first_ping_has_no_rate(scene):
    settings = SETTINGS.changed(max_rate_hz=0.01)  # there is no second one
    with LiveSession(scene, settings) as session, browsing(session) as browser:
        wait_until(lambda: session.frame.number == 1)
        wait_until(lambda: re.match(r"ping rate\s+–\s", words(browser, "ping rate")))


# ---- trajectories -------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_trajectory_starts_with_the_first_browser_and_ends(scene):
    with LiveSession(scene, SETTINGS, track=STRAIGHT) as session, ViewerPage(session, port=0) as page:
        time.sleep(2 * STRAIGHT.duration_s)
        assert session.state().position_s == 0.0 and session.state().is_playing
        with connected(page.url) as browser, telling(browser):
            wait_until(lambda: session.state().position_s > 0.0)
            play = browser.uuid("Pause")
            wait_until(lambda: browser.values[play]["label"] == "Play")  # at the end
            assert not session.state().is_playing and position(session) == [4.0, 0.0, -5.0]
            assert browser.shown("moved by") == "trajectory"
            assert browser.shown("time, s") == 0.4
            browser.drag("/move_sonar", *ELSEWHERE)
            wait_until(lambda: browser.shown("moved by") == "keys and gizmo")
            assert position(session) == list(ELSEWHERE[1])
            browser.change("time, s", 0.2)
            wait_until(lambda: browser.shown("moved by") == "trajectory")
            wait_until(lambda: position(session) == [4.0, 0.0, -5.0])  # it plays on
            browser.press("Pause")
            wait_until(lambda: session.state().is_playing or position(session)[0] < 4.0)  # from the beginning


# ---- settings -----------------------------------------------------------------------------------------------


def price_tables(browser):
    """The HTML of the prices of terms."""
    return [text for one in browser.values.values() if "multipath</td>" in (text := str(one.get("content")))]


@pytest.mark.slow
@pytest.mark.usefixtures("timed_once")
def test_terms_are_switched_and_priced(session, browser):
    browser.change("absorption", True)
    wait_until(lambda: session.settings.is_on("absorption"))
    wait_until(lambda: session.frame.settings.is_on("absorption"))
    browser.change("absorption", False)
    wait_until(lambda: not session.settings.is_on("absorption"))
    browser.press("Price the terms")
    browser.press("Price the terms")
    wait_until(lambda: price_tables(browser))
    assert browser.notes == [] or browser.notes == ["terms are being priced already (wait until they are)"]
    browser.change("tolerance, %", 10.0)
    wait_until(lambda: not price_tables(browser))  # the prices were those of another tolerance


def test_a_fixed_gain_begins_where_the_automatic_one_was(session, browser):
    wait_until(lambda: session.frame is not None)
    assert session.settings.law.gain_percentile is not None
    automatic_db = round(session.frame.ping.counts_law().gain_db)
    browser.change("gain of the device", False)
    wait_until(lambda: session.settings.counts is not None)
    assert session.settings.law.gain_db == automatic_db != 0
    wait_until(lambda: browser.shown("gain, dB") == automatic_db)


def open_and_close(scene, folder, prices=False):
    """Open a view before a browser, and close it, while terms are priced or not."""
    opened = LiveView(LiveSession(scene, SETTINGS, folder=folder), "127.0.0.1", 0)
    session = opened.session
    with connected(opened.url) as client:
        with telling(client):
            wait_until(lambda: session.frame.number > 1)
            if prices:
                client.press("Price the terms")
                wait_until(lambda: "sonar_gl prices" in {one.name for one in threading.enumerate()})
        began_s = time.monotonic()
        opened.close()
        assert time.monotonic() - began_s < WAIT_S / 2
        assert not price_tables(client)


@pytest.mark.slow
def test_a_view_that_is_closed_ends_the_pricing_of_terms_and_leaves_no_thread(scene, tmp_path, monkeypatch):
    # so many turns take minutes: only an end at the next ping is in time
    monkeypatch.setattr(terms_module, "TURNS", 2000)
    open_and_close(scene, tmp_path)  # starts threads that all views share, and that stay
    before = set(threading.enumerate())
    open_and_close(scene, tmp_path, prices=True)
    wait_until(lambda: set(threading.enumerate()) <= before)


def test_the_range_ends_where_the_sonar_does_and_stays_where_the_next_sonar_allows_it(session, browser):
    slider = browser.values[browser.uuid("range, m")]
    assert (slider["max"], browser.shown("range, m")) == (100.0, 22.0)  # of the P900's data sheet
    browser.change("sonar", "oculus-m1200d-hf")  # 10 m
    wait_until(lambda: (slider["max"], slider["value"]) == (10.0, 10.0))
    assert session.settings.device.range_max_m == 10.0
    wait_until(lambda: browser.notes)
    assert browser.notes == ["10 m, since oculus-m1200d-hf does not allow 22 m"]
    browser.change("range, m", 8.0)
    wait_until(lambda: session.settings.range_m == 8.0)
    browser.change("sonar", "p900-45 (given)")
    wait_until(lambda: slider["max"] == 100.0)
    assert session.settings.device.range_max_m == 8.0 and len(browser.notes) == 1


@pytest.mark.slow
def test_a_program_that_changes_the_sonar_again_and_again_fills_no_list(session, browser):
    dropdown = browser.values[browser.uuid("sonar")]
    first, own = dropdown["value"], session.settings.sonar
    for number in range(2, 13):
        session.change(sonar=replace(own, tilt_deg=number))
        wait_until(lambda number=number: dropdown["value"] == f"{own.name} (given {number})")
    wait_until(lambda: dropdown["value"] in dropdown["options"])
    offered = [name for name in dropdown["options"] if "given" in name]
    assert offered[0] == first == f"{own.name} (given)" and offered[-1] == dropdown["value"]
    assert len(offered) == MAX_OWN
    browser.change("sonar", first)
    wait_until(lambda: session.settings.sonar == own)


@pytest.mark.slow
def test_the_polar_form_has_no_picture_in_3d(session, browser):
    wait_until(lambda: "/sonar/picture_0" in browser.nodes)
    browser.change("form", "polar")
    wait_until(lambda: session.frame.settings.form == "polar")
    assert session.frame.picture.shape[:2] == (60, 60)
    wait_until(lambda: browser.nodes["/sonar/picture_0"].get("visible") is False)
    browser.change("form", "fan")
    wait_until(lambda: browser.nodes["/sonar/picture_0"].get("visible"))


def test_a_slider_that_is_dragged_is_not_put_back(session, browser):
    for value in np.arange(10.0, 20.5, 0.5):
        browser.change("range, m", float(value))
    wait_until(lambda: session.frame.settings.range_m == 20.0)
    assert browser.shown("range, m") in (22.0, 20.0)  # as it was, or what the user set: no value in between


def test_the_picture_is_that_of_the_last_frame(session, browser):
    wait_until(lambda: "/sonar/picture_0" in browser.nodes)
    before = session.frame.picture.astype(int)
    image = next(one for one in browser.values.values() if "_data" in one)

    def distance(picture):
        shown = cv2.imdecode(np.frombuffer(image["_data"], np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
        return abs(shown.astype(int) - picture).mean() if shown.shape == picture.shape else np.inf

    browser.change("range, m", 12.0)
    wait_until(lambda: session.frame.settings.range_m == 12.0)
    wait_until(lambda: distance(session.frame.picture.astype(int)) < distance(before))
