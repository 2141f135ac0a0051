"""Parts of the web page that need neither a browser nor viser."""

import json
import math
import re
import time
from dataclasses import replace

import numpy as np
import pytest

from sonar_gl.analysis.terms import Price
from sonar_gl.core.errors import Error
from sonar_gl.core.poses import pose
from sonar_gl.imaging.fan_image import fan_geometry
from sonar_gl.live.motion import KEYS
from sonar_gl.live.pictures import OUTLINE_WIDTH, outlined
from sonar_gl.live.settings import LiveSettings
from sonar_gl.live.view.actions import Actions
from sonar_gl.live.view.browser_state import FIELD, BrowserState, script_html
from sonar_gl.live.view.control_panel import chosen
from sonar_gl.live.view.origin import is_other_site
from sonar_gl.live.view.outline import PicturePlane, fan_arcs, fan_outline
from sonar_gl.live.view.ping_panel import HELP_HTML
from sonar_gl.live.view.price_table import prices_html
from sonar_gl.live.view.range_scale import RangeScale, allowed_range_m
from sonar_gl.live.view.scene_nodes import SONAR_FROM_CAMERA
from sonar_gl.sonar.sonar import Sonar, presets
from tests.support.fan_ping import fan_ping

SONAR = Sonar("made", 900e3, 64, 100, 60.0, 20.0, 1.0, 1.0, 10.0)


def test_state_of_a_browser_is_read():
    text = json.dumps(
        {"pointer": [0.5, 1], "clicks": 3, "clicked": None, "keys": ["w", "arrowup"], "frame_s": 0.5}
    )
    assert BrowserState.read(text) == BrowserState((0.5, 1.0), 3, None, frozenset({"w", "arrowup"}), 0.5)


@pytest.mark.parametrize(
    "text",
    [
        "", "{", "null", "[1, 2]", '"w"', "[" * 100_000,
        '{"pointer": [0.5]}', '{"pointer": [0.5, -0.1]}', '{"pointer": [0.5, NaN]}', '{"pointer": ["a", "b"]}',
        '{"clicks": "3"}', '{"clicks": true}', '{"clicked": {"x": 1}}', '{"keys": "w"}', '{"keys": [1, null, ["w"]]}',
        '{"frame_s": -1}', '{"frame_s": 1e9}', '{"frame_s": "1"}', '{"frame_s": NaN}',
    ],
)  # fmt: skip
def test_text_that_no_page_sends_is_an_empty_state(text):
    assert BrowserState.read(text) == BrowserState()


def test_script_and_server_agree_on_names():
    html = script_html(True)
    assert f"const FIELD = &quot;{FIELD}&quot;" in html
    assert all(f"&quot;{key}&quot;" in html for key in KEYS)
    assert "data-keys-move-sonar" in html.split("<img")[0]
    assert "data-keys-move-sonar" not in script_html(False).split("<img")[0]


def test_all_keys_are_named_on_the_page():
    named = re.sub("<[^>]*>", " ", HELP_HTML).lower()
    for sign, key in zip("←→↑↓", ("arrowleft", "arrowright", "arrowup", "arrowdown"), strict=True):
        named = named.replace(sign, key)
    assert [key for key in KEYS if key not in re.findall(r"\w+", named)] == []


def test_an_outline_surrounds_pixels_and_changes_no_other():
    picture = np.random.default_rng(1).integers(0, 200, (60, 80, 3), dtype=np.uint8)
    row, column = np.ogrid[:60, :80]
    mask = (abs(row - 30) <= 8) & (abs(column - 40) <= 12)
    mask[30, 38:41] = False  # a gap, which has no outline of its own
    around = (abs(row - 30) <= 8 + OUTLINE_WIDTH) & (abs(column - 40) <= 12 + OUTLINE_WIDTH)
    around &= ~((abs(row - 30) <= 8) & (abs(column - 40) <= 12))
    before = picture.copy()
    drawn = outlined(picture, mask, (1, 255, 2))
    assert (picture == before).all()
    assert (drawn[around] == (1, 255, 2)).all()
    assert (drawn[~around] == picture[~around]).all()
    assert (outlined(picture, np.zeros_like(mask), (1, 255, 2)) == picture).all()


def test_outline_is_that_of_the_fan():
    ends = fan_outline(SONAR).reshape(-1, 3)
    ranges = np.linalg.norm(ends, axis=1)
    azimuths, elevations = np.arctan2(ends[:, 1], ends[:, 0]), np.arcsin(ends[:, 2] / ranges)
    for got, edges in (
        (ranges, (1, 10)),
        (azimuths, (-math.pi / 6, math.pi / 6)),
        (abs(elevations), (math.radians(10),)),
    ):
        assert got.min() == pytest.approx(min(edges), abs=1e-5)  # float32
        assert got.max() == pytest.approx(max(edges), abs=1e-5)


def test_outline_tilts_with_the_head():
    tilted = Sonar("made", 900e3, 64, 100, 60.0, 20.0, 1.0, 1.0, 10.0, tilt_deg=25.0)
    expected = fan_outline(SONAR) @ pose(pitch=math.radians(25.0))[:3, :3].T
    assert fan_outline(tilted) == pytest.approx(expected, abs=1e-5)  # float32 at 10 m


def test_arcs_are_ranges_up_to_the_last():
    ranges = np.linalg.norm(fan_arcs(SONAR, 4.0), axis=2)
    assert sorted(set(ranges.round(4).ravel().tolist())) == [4.0, 8.0, 10.0]


@pytest.mark.parametrize("elevation_rad", [0.0, 0.2])
def test_a_ray_meets_the_picture_where_its_pixel_lies(elevation_rad):
    geometry = fan_geometry(fan_ping(), 200)
    plane = PicturePlane.of(geometry, elevation_rad)
    azimuth, range_m = geometry.azimuth_edges_rad[1] / 2, 0.7 * geometry.range_edges_m[1]
    column, row = geometry.pixel(azimuth, range_m)
    # the plane is tilted about the axis to port: azimuth and range are those within it
    point = pose(pitch=-elevation_rad) @ [range_m * np.cos(azimuth), range_m * np.sin(azimuth), 0, 1]
    world_from_head = pose(3, -2, 1, 0.1, 0.2, 0.3)
    eye, target = np.array([5.0, 4.0, 30.0]), (world_from_head @ point)[:3]
    place = plane.place_of_ray(np.linalg.inv(world_from_head), eye, target - eye)
    assert place == pytest.approx(((column + 0.5) / geometry.width, (row + 0.5) / geometry.height), abs=1e-9)


def test_a_ray_beside_the_picture_or_away_from_it_meets_nothing():
    plane = PicturePlane.of(fan_geometry(fan_ping(), 200), 0.0)
    above, down = np.array([5.0, 0.0, 3.0]), np.array([0.0, 0.0, -1.0])
    assert plane.place_of_ray(np.eye(4), above, down) is not None
    assert plane.place_of_ray(np.eye(4), above, -down) is None
    assert plane.place_of_ray(np.eye(4), above, np.array([1.0, 0.0, 0.0])) is None
    assert plane.place_of_ray(np.eye(4), np.array([5.0, 1e4, 3.0]), down) is None


def test_sonar_looks_where_its_camera_does():
    # axes of a camera: x right, y down, z ahead; those of a sonar: x ahead, y to port, z up
    right, down, ahead = np.eye(3)
    assert (SONAR_FROM_CAMERA @ ahead).tolist() == [1, 0, 0]
    assert (SONAR_FROM_CAMERA @ right).tolist() == [0, -1, 0]
    assert (SONAR_FROM_CAMERA @ down).tolist() == [0, 0, -1]


def test_prices_are_a_table_without_zeros_that_were_not_measured():
    prices = [
        Price("absorption", 0.052, 0.1, 0.31, 0.0, True),
        Price("a < b", 0.0004, 0.0, 0.0, 0.04, False),
    ]
    rows = [re.sub("<[^>]*>", "|", row) for row in prices_html(prices).split("</tr>")[1:3]]
    assert [[cell for cell in row.split("|") if cell] for row in rows] == [
        ["absorption", "5.2 %", "31 %", "–"],
        ["a &lt; b", "&lt; 0.1 %", "0 %", "&lt; 0.1 ms"],
    ]
    assert prices_html([]) == ""


@pytest.mark.parametrize(
    "near_m, far_m, limit_m, set_m, expected",
    [
        (0.5, 29.9894, 100.0, None, (1.0, 100.0, 0.5, 29.99)),
        (1.0, 10.0, None, None, (1.2, 40.0, 0.2, 10.0)),  # four times its own
        (1.0, 10.0, 20.0, 35.0, (1.2, 35.0, 0.2, 35.0)),  # set beyond the data sheet
        (0.7, 5.0, 5.0, 0.71, (0.71, 5.0, 0.02, 0.71)),
        (9.999, 10.0, 10.0, None, (10.0, 10.05, 0.05, 10.0)),  # a slider has some length
        (0.0, 0.002, None, None, (0.00005, 0.008, 0.00005, 0.002)),
    ],
)
def test_the_slider_of_the_range_follows_the_sonar(near_m, far_m, limit_m, set_m, expected):
    sonar = replace(SONAR, n_bins=1, range_min_m=near_m, range_max_m=far_m, range_limit_m=limit_m)
    scale = RangeScale.of(LiveSettings(sonar, range_m=set_m))
    got = scale.low_m, scale.high_m, scale.step_m, scale.shown_m
    assert got == pytest.approx(expected)  # decimal fractions


@pytest.mark.parametrize("name", presets())
def test_each_preset_takes_every_range_of_its_slider(name):
    scale = RangeScale.of(LiveSettings(name))
    assert scale.low_m < scale.shown_m <= scale.high_m
    for range_m in (scale.low_m, scale.high_m):
        device = LiveSettings(name, range_m=range_m).device
        assert device.range_max_m == range_m == allowed_range_m(device, range_m)


def test_a_range_that_is_too_near_for_a_sonar_becomes_its_own():
    assert allowed_range_m(replace(SONAR, range_min_m=2.0), 2.0) == SONAR.range_max_m


def test_a_choice_that_the_page_does_not_offer_is_refused():
    assert chosen("fan", ("fan", "polar"), "form") == "fan"
    assert chosen("a", {"a": 1}, "sonar") == 1
    for text in ("/etc/passwd", "../sonar.toml", ""):
        with pytest.raises(Error, match="must be one of those that the page offers"):
            chosen(text, {"a": 1}, "sonar")


@pytest.mark.parametrize(
    "origin, host, listens_at, expected",
    [
        (None, "127.0.0.1:8080", "127.0.0.1", False),
        ("http://[::1]:8080", "[::1]:8080", "::1", False),
        ("http://robot:8080", "robot:8080", "0.0.0.0", False),  # any name of this machine
        ("http://example.org", "robot:8080", "0.0.0.0", True),
        ("http://example.org:8080", "example.org:8080", "127.0.0.1", True),  # a name that means 127.0.0.1
        (None, "example.org:8080", "127.0.0.1", True),
        (None, None, "127.0.0.1", True),
        ("null", "localhost:8080", "127.0.0.1", True),
        ("http://[", "localhost:8080", "127.0.0.1", True),
    ],
)
def test_requests_of_other_sites_are_known(origin, host, listens_at, expected):
    assert is_other_site(origin, host, listens_at) is expected


class Notes:
    """A browser that keeps what it is told."""

    def __init__(self):
        self.texts = []

    def add_notification(self, _title, text, **_settings):
        self.texts.append(text)


def test_actions_go_on_after_one_that_fails():
    browser, done = Notes(), []

    def fail():
        raise Error("the range must be more")

    actions = Actions(lambda: done.append("told"))
    for action in (fail, fail, lambda: done.append("moved"), None):
        actions.ask(browser, action)
    actions.do(0.0)
    assert browser.texts == ["the range must be more"]  # once, though it failed twice
    assert done == ["moved", "told"]  # told once, after all


def test_of_a_slider_that_is_dragged_the_newest_value_alone_is_set():
    done, slider = [], object()
    actions = Actions(lambda: done.append("told"))
    for value in range(5):
        actions.ask(None, lambda value=value: done.append(value), slider)
        actions.ask(None, lambda: done.append("button"))
    assert actions.waits(slider)
    actions.do(0.0)
    assert done == [*["button"] * 4, 4, "button", "told"]
    assert not actions.waits(slider)


def test_actions_that_come_meanwhile_do_not_hold_up_the_page():
    done = []
    actions = Actions(lambda: None)

    def again():
        done.append("done")
        actions.ask(None, again)

    again()
    actions.do(0.0)
    assert done == ["done"] * 2


def test_a_page_that_is_woken_does_not_wait():
    actions = Actions(lambda: None)
    actions.ask(None, None)
    start_s = time.monotonic()
    actions.do(60.0)
    assert time.monotonic() - start_s < 30.0  # a machine that tests run on may be slow
