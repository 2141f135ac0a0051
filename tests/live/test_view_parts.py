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
from sonar_gl.embed.camera import SONAR_FROM_OPTICAL
from sonar_gl.imaging.fan_image import fan_geometry
from sonar_gl.live.frame import LiveFrame
from sonar_gl.live.key_motion import KEYS
from sonar_gl.live.pictures import OUTLINE_WIDTH, outlined, picture_of, pixel_cells
from sonar_gl.live.settings import LiveSettings
from sonar_gl.live.view.actions import Actions
from sonar_gl.live.view.browser_state import FIELD, BrowserState, script_html
from sonar_gl.live.view.origin import is_other_site
from sonar_gl.live.view.outline import PictureSector, fan_arcs, fan_outline
from sonar_gl.live.view.ping_panel import HELP_HTML, PANEL
from sonar_gl.live.view.price_table import prices_html
from sonar_gl.live.view.range_marks import MarkedPicture, marks_html
from sonar_gl.live.view.scales import allowed_range_m, range_scale, shown_range_m
from sonar_gl.sonar.sonar import Sonar
from sonar_gl.sonar.sonar_files import presets
from tests.support.fan_ping import fan_ping

SONAR = Sonar("made", 900e3, 64, 100, 60.0, 20.0, 1.0, 1.0, 10.0)


def ping_of(sonar):
    """A ping of a sonar, without an echo."""
    return replace(
        fan_ping(),
        intensity=np.zeros((sonar.n_beams, sonar.n_bins), np.float32),
        azimuth_rad=sonar.azimuth_rad,
        range_m=sonar.range_m,
    )


def test_state_of_a_browser_is_read():
    text = json.dumps(
        {"pointer": [0.5, 1], "clicks": 3, "clicked": None, "keys": ["w", "arrowup"], "frame_s": 0.5}
    )
    assert BrowserState.read(text) == BrowserState((0.5, 1.0), 3, None, frozenset({"w", "arrowup"}), 0.5)


def test_script_and_server_agree_on_names():
    html = script_html(True)
    assert f"const FIELD = &quot;{FIELD}&quot;" in html
    assert all(f"&quot;{key}&quot;" in html for key in KEYS)
    assert "data-keys-move-sonar" in html.split("<img")[0]
    assert "data-keys-move-sonar" not in script_html(False).split("<img")[0]
    assert f"const PANEL = &quot;{PANEL}&quot;" in html


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


def test_outline_of_a_fan_that_lies_aside_ends_with_its_beams():
    """Such as a ray sensor of SDF that scans to one side; the field of view reaches as far to the other."""
    azimuths = tuple(np.linspace(-9.5, 39.5, 50))
    aside = replace(SONAR, n_beams=50, beam_azimuths_deg=azimuths, azimuth_fov_deg=80.0)
    for lines in (fan_outline(aside), fan_arcs(aside, 2.0)):
        found = np.degrees(np.arctan2(lines[..., 1], lines[..., 0]))
        assert (found.min(), found.max()) == pytest.approx((-10, 40), abs=1e-3)


def test_outline_tilts_with_the_head():
    tilted = Sonar("made", 900e3, 64, 100, 60.0, 20.0, 1.0, 1.0, 10.0, tilt_deg=25.0)
    expected = fan_outline(SONAR) @ pose(pitch=math.radians(25.0))[:3, :3].T
    assert fan_outline(tilted) == pytest.approx(expected, abs=1e-5)  # float32 at 10 m


def test_arcs_are_ranges_up_to_the_last():
    ranges = np.linalg.norm(fan_arcs(SONAR, 4.0), axis=2)
    assert sorted(set(ranges.round(4).ravel().tolist())) == [4.0, 8.0, 10.0]


WIDE = replace(SONAR, azimuth_fov_deg=130.0)


@pytest.mark.parametrize("height, rows", [(200, 200), (200, 80), (640, 320)])
def test_the_picture_of_a_wide_fan_lies_on_its_upper_face_and_has_no_gaps(height, rows):
    elevation_rad = math.radians(10.0)
    geometry = fan_geometry(ping_of(WIDE), height)
    # a picture that has azimuth and range as colours
    parts = list(geometry.pixel_rows())
    azimuth, range_m = (
        np.concatenate([getattr(one, name) for one in parts]) for name in ("azimuth_rad", "range_m")
    )
    for sector in PictureSector.all_of(geometry, elevation_rad, rows):
        pixels = sector.pixels()
        at = np.rint(pixels.row).astype(int), np.rint(pixels.column).astype(int)
        at = np.clip(at[0], 0, geometry.height - 1), np.clip(at[1], 0, geometry.width - 1)
        h, w = sector.shape
        right, down = np.meshgrid((np.arange(w) + 0.5) / w - 0.5, (np.arange(h) + 0.5) / h - 0.5)
        in_picture = np.stack([right * sector.width_m, down * sector.height_m, 0 * right, 1 + 0 * right], -1)
        x, y, z, _ = np.moveaxis(in_picture @ sector.head_from_picture.T, -1, 0)
        # where the fan's sides are far from each other, a pixel of the picture is a small angle
        far = (pixels.cover > 0) & (np.hypot(x, y) * geometry.pixels_per_m > 40)
        pixel_m = math.sqrt(0.5) / geometry.pixels_per_m  # to the nearest pixel, at most
        off_m = np.hypot(x, y) * abs(azimuth[at] - np.arctan2(y, x))
        assert off_m[far].max() < 1.1 * pixel_m  # a tangent for an arc
        assert abs(range_m[at] * math.cos(elevation_rad) - np.hypot(x, y))[far].max() < 1.1 * pixel_m
        # half of 44 degrees from the middle of a part, and half a pixel more
        widest_rad = math.radians(22.0) + 0.5 * geometry.pixels_per_m / (40 * sector.rows_per_m)
        share = z[far] / (np.hypot(x, y)[far] * math.tan(elevation_rad))
        assert math.cos(widest_rad) < share.min() and share.max() <= 1 + 1e-12


def test_parts_of_a_picture_cover_the_fan_once():
    geometry = fan_geometry(ping_of(WIDE), 400)
    parts = PictureSector.all_of(geometry, 0.0, 400)
    area_px = sum(float(one.pixels().cover.sum()) for one in parts)
    low, high = geometry.azimuth_edges_rad
    near_px, far_px = (edge * 400 / geometry.range_edges_m[1] for edge in geometry.range_edges_m)
    # cover is that of an edge along the pixels; a slanted one, and corners, differ by far less than the pixels
    assert area_px == pytest.approx((high - low) / 2 * (far_px**2 - near_px**2), rel=1e-4)


def test_pixels_of_a_part_are_those_of_the_picture():
    geometry = fan_geometry(ping_of(WIDE), 200)
    picture = np.zeros((geometry.height, geometry.width, 3), np.uint8)
    picture[..., 0], picture[..., 1] = np.indices(picture.shape[:2]) % 251
    pixels = PictureSector.all_of(geometry, 0.1, 100)[0].pixels()
    shown = pixels.of(picture)
    row, column = np.argwhere((pixels.cover > 0) & (pixels.column % 251 < 249))[500]
    # linear between pixels, to a level and the steps of 1/32 that old versions of OpenCV take
    assert shown[row, column, 0] == pytest.approx(pixels.row[row, column], abs=1)
    assert shown[row, column, 1] == pytest.approx(pixels.column[row, column] % 251, abs=1)


@pytest.mark.parametrize("fov_deg, count", [(2.0, 1), (45.0, 1), (60.0, 2), (130.0, 3), (360.0, 8)])
def test_no_part_of_a_picture_is_wider_than_45_degrees(fov_deg, count):
    geometry = fan_geometry(ping_of(replace(SONAR, azimuth_fov_deg=fov_deg)), 200)
    parts = PictureSector.all_of(geometry, 0.2, 100)
    assert len(parts) == count
    assert (parts[0].azimuths_rad[0], parts[-1].azimuths_rad[1]) == pytest.approx(geometry.azimuth_edges_rad)


def frame_of(fov_deg, form, height=640):
    sonar = replace(SONAR, n_beams=max(1, round(fov_deg)), azimuth_fov_deg=fov_deg)
    settings, ping = LiveSettings(sonar, form=form, height=height), ping_of(sonar)
    return LiveFrame(0, 0.0, 0.0, np.eye(4), ping, picture_of(ping, settings), settings)


@pytest.mark.parametrize("form", ["fan", "polar"])
@pytest.mark.parametrize("fov_deg", [2.0, 29.0, 130.0, 359.0])
def test_marks_lie_where_the_picture_shows_their_range_and_azimuth(fov_deg, form):
    frame = frame_of(fov_deg, form)
    marked, ping = MarkedPicture.of(frame), frame.ping
    assert marked.size == frame.picture.shape[1::-1]
    beams, bins = np.divmod(pixel_cells(ping, frame.settings), len(ping.range_m))
    for beam in range(0, len(ping.azimuth_rad), 5):
        for bin_ in range(20, len(ping.range_m), 10):  # a pixel nearer shows several beams
            right, down = marked.place(ping.azimuth_rad[beam], ping.range_m[bin_])
            at = min(int(down), frame.picture.shape[0] - 1), min(int(right), frame.picture.shape[1] - 1)
            if fov_deg > 2.0 or form == "polar":  # pixels are as wide as that one beam
                assert abs(beams[at] - beam) <= 1, (beam, bin_)
            assert abs(bins[at] - bin_) <= 1


@pytest.mark.parametrize("height", [40, 57, 60, 90])
def test_a_polar_picture_shows_each_beam_where_pixels_are_wider(height):
    sonar = replace(SONAR, n_beams=60)
    settings, ping = LiveSettings(sonar, form="polar", height=height, colormap="gray"), ping_of(sonar)
    beams = pixel_cells(ping, settings) // len(ping.range_m)
    for beam in range(60):
        bright = np.zeros_like(ping.intensity)
        bright[beam] = 1.0
        columns = np.flatnonzero(picture_of(replace(ping, intensity=bright), settings).any(axis=(0, 2)))
        assert len(columns), beam
        assert (abs(beams[0, columns] - beam) <= max(1, 60 / height)).all()


@pytest.mark.parametrize("form", ["fan", "polar"])
@pytest.mark.parametrize("fov_deg", [2.0, 15.0, 29.0, 45.0, 90.0, 130.0, 200.0, 359.0])
def test_ranges_are_numbered_and_no_number_covers_another(fov_deg, form):
    marked = MarkedPicture.of(frame_of(fov_deg, form))
    width, height = marked.size
    html = marks_html(marked)
    texts = re.findall(r'<text x="([-.\d]+)" y="([-.\d]+)">([^<]+)</text>', html)
    assert [text for _, _, text in texts if text.endswith(" m")] == [f"{n} m" for n in (2, 4, 6, 8, 10)]
    assert fov_deg < 15.0 or "0°" in [text for _, _, text in texts]
    letter = float(re.search(r"font-size:([.\d]+)px", html)[1])
    beside = max(0.0, (0.62 * height - width) / 2)  # room beside the picture of a narrow fan
    boxes = []
    for x, y, text in texts:
        half = 0.3 * letter * len(text)
        boxes.append((float(x) - half, float(y) - letter / 2, float(x) + half, float(y) + letter / 2))
        left, top, right, bottom = boxes[-1]
        assert left >= -beside - 1 and right <= width + beside + 1 and top >= -1 and bottom <= height + 1, (
            text
        )
    for number, one in enumerate(boxes):
        for other in boxes[:number]:
            apart = one[0] >= other[2] or other[0] >= one[2] or one[1] >= other[3] or other[1] >= one[3]
            assert apart, (texts[number], one, other)


def test_a_whole_circle_has_numbers_straight_aside():
    """They lay half a letter within the rim, as if the circle were as high as a fan, and were left out."""
    html = marks_html(MarkedPicture.of(frame_of(360.0, "fan")))
    texts = re.findall(r">([^<]+)</text>", html)
    assert {"+90°", "-90°", "0°", "+45°", "-135°"} <= set(texts)


def test_sonar_looks_where_its_camera_does():
    # axes of a camera: x right, y down, z ahead; those of a sonar: x ahead, y to port, z up
    right, down, ahead = np.eye(3)
    assert (SONAR_FROM_OPTICAL @ ahead).tolist() == [1, 0, 0]
    assert (SONAR_FROM_OPTICAL @ right).tolist() == [0, -1, 0]
    assert (SONAR_FROM_OPTICAL @ down).tolist() == [0, 0, -1]


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
    settings = LiveSettings(sonar, range_m=set_m)
    scale = range_scale(settings)
    got = scale.low, scale.high, scale.step, shown_range_m(settings)
    assert got == pytest.approx(expected)  # decimal fractions


@pytest.mark.parametrize("name", presets())
def test_each_preset_takes_every_range_of_its_slider(name):
    scale = range_scale(LiveSettings(name))
    assert scale.low < shown_range_m(LiveSettings(name)) <= scale.high
    for range_m in (scale.low, scale.high):
        device = LiveSettings(name, range_m=range_m).device
        assert device.range_max_m == range_m == allowed_range_m(device, range_m)


def test_a_range_beyond_the_limit_of_a_sonar_becomes_the_limit():
    limited = replace(SONAR, range_limit_m=20.0)
    assert [allowed_range_m(limited, range_m) for range_m in (15.0, 20.0, 20.5)] == [15.0, 20.0, 20.0]
    assert allowed_range_m(SONAR, 500.0) == 500.0  # no limit is known


def test_a_range_that_is_too_near_for_a_sonar_becomes_its_own():
    assert allowed_range_m(replace(SONAR, range_min_m=2.0), 2.0) == SONAR.range_max_m


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


@pytest.mark.parametrize("listens_at", ["127.0.0.1", "127.0.0.2", "localhost", "::1"])
def test_a_site_whose_name_means_this_machine_is_another_site(listens_at):
    assert is_other_site("http://example.org:8080", "example.org:8080", listens_at)
    assert not is_other_site("http://127.0.0.2:8080", "127.0.0.2:8080", listens_at)
