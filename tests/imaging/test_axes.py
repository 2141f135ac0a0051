"""Axes: margin, arcs, spokes and labels of a fan image."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from sonar_gl.core.errors import Error
from sonar_gl.imaging import axes
from sonar_gl.imaging.axes import draw_axes, fan_ticks
from sonar_gl.imaging.fan_image import colorize, fan_geometry, fan_image
from sonar_gl.imaging.styles import FanStyle
from sonar_gl.sonar.counts import Counts
from sonar_gl.sonar.sonar import Sonar
from tests.support.fan_ping import fan_ping


def pixels(ping, margin, azimuth_deg, range_m):
    """Return (rows, columns) on the canvas of axes about a fan image 300 pixels high."""
    columns, rows = fan_geometry(ping, 300).pixel(np.radians(azimuth_deg), np.asarray(range_m))
    return np.rint(rows).astype(int) + margin, np.rint(columns).astype(int) + margin


@pytest.mark.parametrize("fov_deg", [1, 20, 90, 180, 270, 360])
def test_margin_with_labels(fov_deg):
    ping = fan_ping(fov_deg, range_m=(1.0, 27.0), fill=0.01)
    picture = colorize(fan_image(ping, 300), "viridis")
    before = picture.copy()
    drawn = draw_axes(picture, ping)
    assert (picture == before).all()
    margin = (drawn.shape[0] - 300) // 2
    assert margin > 20 and drawn.shape == (300 + 2 * margin, picture.shape[1] + 2 * margin, 3)
    assert drawn[:margin].any()


@pytest.mark.parametrize("fov_deg, azimuth_deg", [(20, 3), (90, 22), (180, 22), (270, 22), (360, 22)])
def test_between_lines_the_picture_stays(fov_deg, azimuth_deg):
    ping = fan_ping(fov_deg, range_m=(1.0, 27.0), fill=0.01)
    picture = colorize(fan_image(ping, 300), "viridis")
    drawn = draw_axes(picture, ping)
    margin = (drawn.shape[0] - 300) // 2
    rows, columns = pixels(ping, margin, azimuth_deg, [7, 12, 17, 22])
    assert (drawn[rows, columns] == picture[rows - margin, columns - margin]).all()


def test_arcs_and_spokes():
    """On a black fan of 90° and 27 m: arcs each 5 m and at the rim, spokes each 15°."""
    ping = fan_ping(90, range_m=(1.0, 27.0))
    drawn = draw_axes(np.zeros((*fan_image(ping, 300).shape, 3), np.uint8), ping).max(axis=2)
    margin = (drawn.shape[0] - 300) // 2
    assert (drawn[pixels(ping, margin, 7.5, [5, 10, 15, 20, 25, 27])] > 40).all()
    assert not drawn[pixels(ping, margin, 7.5, [2.5, 7.5, 12.5, 17.5, 22.5, 26])].any()
    spokes = np.arange(-45, 46, 15)
    assert (drawn[pixels(ping, margin, spokes, 12.5)] > 40).all()
    assert not drawn[pixels(ping, margin, spokes[:-1] + 7.5, 12.5)].any()


def test_pictures_of_one_fan_do_not_depend_on_each_other():
    """Their lines are laid once. The picture that is given stays as it is."""
    ping = fan_ping(60, range_m=(5.0, 20.0))
    size = (*fan_image(ping, 300).shape, 3)
    dark, bright = np.zeros(size, np.uint8), np.full(size, 200, np.uint8)
    drawn = [draw_axes(picture, ping) for picture in (dark, bright, dark, bright)]
    np.testing.assert_array_equal(drawn[2], drawn[0])
    np.testing.assert_array_equal(drawn[3], drawn[1])
    assert not dark.any() and (bright == 200).all()


def test_outside_the_fan_it_is_black():
    ping = fan_ping(60, range_m=(5.0, 20.0), fill=1.0)
    drawn = draw_axes(np.full((300, 300, 3), 200, np.uint8), ping)
    margin = (len(drawn) - 300) // 2
    assert not drawn[pixels(ping, margin, [0, 0, 40], [3.0, 4.5, 10.0])].any()


@pytest.mark.parametrize("range_m", [(1.0, 20.0), (15.0, 20.0)])
def test_inside_the_fan_the_picture_stays(range_m):
    """The outline follows the inner arc, too."""
    ping = fan_ping(60, range_m=range_m)
    drawn = draw_axes(np.full((300, 300, 3), 200, np.uint8), ping)
    margin = (len(drawn) - 300) // 2
    assert (drawn[pixels(ping, margin, [-27, -17, -3, 3, 17, 27], 17.5)] == 200).all()


def test_a_full_circle_has_no_edges():
    ping = fan_ping(azimuth_rad=np.radians(np.arange(-159.5, 200.0)))
    drawn = draw_axes(np.zeros((300, 300, 3), np.uint8), ping).max(axis=2)
    margin = (len(drawn) - 300) // 2
    assert not drawn[pixels(ping, margin, -160.0, [7, 12, 17])].any()
    assert (drawn[pixels(ping, margin, [135.0, 180.0], 12)] > 40).all()


@pytest.mark.parametrize(
    ("fov_deg", "range_m", "spoke_pixels", "arcs_m", "spokes_deg"),
    [
        (80, (0.0, 20.0), 1, [5, 10, 15, 20], range(-40, 41, 10)),  # both edges; eight steps
        (90, (1.0, 27.0), 1, [5, 10, 15, 20, 25], range(-45, 46, 15)),
        (90, (10.0, 13.5), 1, [10, 12], range(-45, 46, 15)),
        (90, (1.0, 27.0), 100, [5, 10, 15, 20, 25], [-30, 0, 30]),  # 15 degrees are 79 pixels
        (360, (0.0, 7.0), 1, [1, 2, 3, 4, 5, 6, 7], range(-135, 181, 45)),  # -180 is +180
    ],
)
def test_ticks(fov_deg, range_m, spoke_pixels, arcs_m, spokes_deg):
    ticks = fan_ticks(fan_geometry(fan_ping(fov_deg, range_m=range_m), 300), spoke_pixels)
    assert ticks.arcs_m.tolist() == pytest.approx(arcs_m)  # decimal fractions
    assert ticks.spokes_deg.tolist() == pytest.approx(list(spokes_deg))


def written(monkeypatch):
    """Return a dict that is filled with the place of each text, (column, row), as it goes to OpenCV."""
    places, draw = {}, axes.cv2.putText
    monkeypatch.setattr(axes.cv2, "putText", lambda *more: places.update({more[1]: more[2]}) or draw(*more))
    return places


def test_labels_of_spokes_are_positive_to_port_and_counts_rise_along_the_bar(monkeypatch):
    places, ping = written(monkeypatch), fan_ping(90, range_m=(1.0, 27.0))
    draw_axes(colorize(fan_image(ping, 300)), ping, "copper", Counts("power"))
    columns = [places[f"{deg:+d}"][0] for deg in (30, 15, -15, -30)]
    assert columns == sorted(columns) and len(set(columns)) == 4
    rows = [places[count][1] for count in ("255", "191", "128", "64")]
    assert rows == sorted(rows) and len(set(rows)) == 4


@pytest.mark.parametrize("height", [300, 675, 1200])
def test_degree_signs_are_rings_with_a_hole(monkeypatch, height):
    """Also in the smallest letters."""
    ping = fan_ping(90, range_m=(1.0, 27.0))
    monkeypatch.setattr(axes.cv2, "putText", lambda *_: None)
    drawn = draw_axes(np.zeros((*fan_image(ping, height).shape, 3), np.uint8), ping).max(axis=2)
    margin = (len(drawn) - height) // 2
    above = drawn[: margin - 2]  # the outer arc begins below
    _, _, boxes, centres = cv2.connectedComponentsWithStats((above > 20).astype(np.uint8))
    assert len(boxes) > 1  # the ground, that of 0 degrees, and others that lie as high
    for (_, _, width, rows, _), (column, row) in zip(boxes[1:], centres[1:], strict=True):
        assert abs(width - rows) <= 1 and width >= 5
        ring = above[round(row), round(column) - width : round(column) + width]
        assert above[round(row), round(column)] == 0 and ring.max() > 180


def test_spokes_are_labelled_on_both_sides_or_neither(monkeypatch):
    """Labels of arcs beside the starboard edge may take the place of one; whether by one picture depends on letters."""

    def size_of(
        text, _font, size, _width
    ):  # about those of OpenCV 5; among the wider ones of 4 no label is in the way
        return (round(17 * size * len(text)), round(27 * size)), 1

    monkeypatch.setattr(axes.cv2, "getTextSize", size_of)
    hidden = 0
    for fov_deg in range(8, 360, 9):
        ping = fan_ping(fov_deg, range_m=(0.5, 30.0))
        fan = fan_geometry(ping, 80)
        places = written(monkeypatch)
        draw_axes(np.zeros((80, fan.width, 3), np.uint8), ping)
        spokes = {text for text in places if text[0] in "+-"}
        assert {text.translate({43: 45, 45: 43}) for text in spokes} == spokes
        # spokes are as far apart at this height
        hidden += len(spokes) + 1 < len(fan_ticks(fan, 35).spokes_deg)
    assert hidden


def test_the_bar_has_all_colours_and_stands_beside_the_axes():
    ping = fan_ping(60, range_m=(5.0, 20.0), fill=0.01)
    picture = colorize(fan_image(ping, 300), "ice")
    plain, drawn = draw_axes(picture, ping), draw_axes(picture, ping, "ice")
    assert drawn.shape[0] == plain.shape[0] and drawn.shape[1] > plain.shape[1] + 60
    margin = (len(plain) - 300) // 2
    assert (drawn[margin:-margin, : plain.shape[1]] == plain[margin:-margin]).all()  # but for the title
    strip = drawn[:, plain.shape[1] :]
    bar = strip[len(strip) // 4 : len(strip) * 3 // 4, 8]
    wanted = colorize(np.linspace(1, 0, 256, dtype=np.float32)[:, None], "ice")[:, 0]
    at = np.rint(np.linspace(0, 255, len(bar))).astype(int)
    assert abs(bar.astype(int) - wanted[at]).max() <= 8  # two steps


def test_what_the_title_and_the_bar_say(monkeypatch):
    """The texts, as they go to OpenCV."""
    texts = []
    draw = axes.cv2.putText
    monkeypatch.setattr(axes.cv2, "putText", lambda *more: texts.append(more[1]) or draw(*more))
    ping = fan_ping(60, range_m=(5.0, 20.0), fill=0.01)
    sonar = Sonar("mine", 900e3, *ping.intensity.shape, 60.0, 20.0, 1.0, 5.0, 20.0)
    ping, picture = replace(ping, sonar=sonar), colorize(fan_image(ping, 300))
    draw_axes(picture, ping)
    assert {"mine, 5 to 20 m", "port", "starboard"} <= set(texts) and "counts" not in texts
    texts.clear()
    draw_axes(picture, ping, "copper", Counts(low_db=-50, high_db=-10, gain_db=6))
    assert {"mine, 5 to 20 m, gain +6.0 dB", "counts", "0  -56 dB", "64", "128", "255  -16 dB"} <= set(texts)
    texts.clear()
    draw_axes(picture, ping, "copper", Counts("power", gain_percentile=99, bits=16))
    assert {"mine, 5 to 20 m, gain +20.0 dB", "0", "32768", "65535"} <= set(texts)


def test_pictures_of_a_sonar_have_one_size_whatever_the_gain_of_each_ping(monkeypatch):
    """The size is that of the widest labels, of a gain of ±180 dB; frames of a film must have one size."""
    texts = []
    draw = axes.cv2.putText
    monkeypatch.setattr(axes.cv2, "putText", lambda *more: texts.append(more[1]) or draw(*more))
    law = Counts(low_db=-40, gain_percentile=99.9)
    sizes, ends = set(), set()
    for level_db in (-1000, -330, -181, -179, -100, -99, -41, -9, 0, 1, 41, 100, 200):
        ping = fan_ping(29, range_m=(0.4, 5.4), fill=10 ** (level_db / 10))
        sonar = Sonar("mine", 1800e3, *ping.intensity.shape, 29.0, 14.0, 0.3, 0.4, 5.4, counts=law)
        ping = replace(ping, sonar=sonar)
        texts.clear()
        given = draw_axes(colorize(fan_image(ping, 800)), ping, "copper")
        ends |= {text for text in texts if text.startswith("0  ")}
        sizes |= {given.shape, FanStyle(800, "copper", True)(ping).shape}
        bare = replace(ping, sonar=None)
        sizes.add(draw_axes(colorize(fan_image(bare, 800, law)), bare, "copper", law).shape)
    assert len(sizes) == 1
    assert {"0  -40 dB", "0  -220 dB", "0  140 dB"} <= ends
    fixed = draw_axes(colorize(fan_image(ping, 800, Counts())), ping, "copper", Counts())
    assert fixed.shape[1] < sizes.pop()[1]  # no room for what a fixed gain never writes


def test_a_title_fits_a_narrow_picture():
    ping = fan_ping(2, range_m=(5.0, 20.0), fill=0.01)
    drawn = draw_axes(colorize(fan_image(ping, 300)), ping, "gray")
    assert not drawn[:, :2].any() and not drawn[:, -2:].any()


@pytest.mark.parametrize(
    ("range_m", "said"),
    [((0.0, 0.01), "0 to 0.01 m"), ((0.0, 1000.0), "0 to 1000 m"), ((1234.5, 12345.0), "1234 to 12345 m")],
)
def test_the_title_has_ranges_without_exponents(monkeypatch, range_m, said):
    texts = []
    monkeypatch.setattr(axes.cv2, "putText", lambda *more: texts.append(more[1]))
    ping = fan_ping(60, n_bins=50, range_m=range_m)
    draw_axes(colorize(fan_image(ping, 300)), ping)
    assert said in texts


@pytest.mark.parametrize(("fov_deg", "height"), [(5, 500), (20, 60), (45, 60)])
def test_a_title_fits_whatever_steps_letters_have(fov_deg, height):
    ping = fan_ping(fov_deg, range_m=(0.5, 30.0), fill=0.01)
    sonar = Sonar("my long sonar name", 900e3, *ping.intensity.shape, fov_deg, 20.0, 1.0, 0.5, 30.0)
    drawn = draw_axes(colorize(fan_image(ping, height)), replace(ping, sonar=sonar), "copper")
    assert not drawn[:20, :2].any() and not drawn[:20, -2:].any()


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("two\nlines", "two lines"),
        ("nul\x00 and more", "nul? and more"),
        ("caf\udce9", "caf?"),  # as Python reads a file's name that is not UTF-8
        ("é 声", "é 声"),
        ("x" * 5000, "x" * 57 + "..."),
    ],
)
def test_odd_names_of_sonars_leave_the_title_readable(monkeypatch, name, said):
    """OpenCV ended the process at a lone surrogate, and the title with a NUL; long names made it vanish."""
    texts = []
    draw = axes.cv2.putText
    monkeypatch.setattr(axes.cv2, "putText", lambda *more: texts.append(more[1]) or draw(*more))
    ping = fan_ping(60, range_m=(5.0, 20.0), fill=0.01)
    sonar = Sonar(name, 900e3, *ping.intensity.shape, 60.0, 20.0, 1.0, 5.0, 20.0)
    drawn = draw_axes(colorize(fan_image(ping, 300)), replace(ping, sonar=sonar))
    assert f"{said}, 5 to 20 m" in texts
    assert drawn[:20].any()


def arc_labels(monkeypatch):
    """Return a list that is filled with the box of each label of an arc: left, right, top, bottom, pixels."""
    boxes = []

    def note(_canvas, text, place, font, size, *_more):
        if text.endswith(" m") and " to " not in text:
            (across, up), _ = axes.cv2.getTextSize(text, font, size, 1)
            boxes.append((place[0], place[0] + across, place[1] - up, place[1]))

    monkeypatch.setattr(axes.cv2, "putText", note)
    return boxes


@pytest.mark.parametrize("range_m", [0.3, 30.0, 900.0])
@pytest.mark.parametrize("height", [1, 75, 200])
@pytest.mark.parametrize("fov_deg", [5, 90, 130, 180, 360])
def test_labels_of_arcs_do_not_overlap(monkeypatch, fov_deg, height, range_m):
    """The wide letters of OpenCV 4 need 75 pixels for one."""
    boxes = arc_labels(monkeypatch)
    ping = fan_ping(fov_deg, range_m=(0.0, range_m))
    draw_axes(np.zeros((height, fan_geometry(ping, height).width, 3), np.uint8), ping)
    assert boxes or height < 75
    for one, (left, right, top, bottom) in enumerate(boxes):
        for other in boxes[:one]:
            assert right <= other[0] or other[1] <= left or bottom <= other[2] or other[3] <= top


@pytest.mark.parametrize("range_m", [0.005, 900.0, 20000.0])
@pytest.mark.parametrize("height", [100, 1000])
@pytest.mark.parametrize("fov_deg", [2, 20, 45, 90, 130, 230])
def test_labels_of_arcs_lie_beside_the_fan_and_within_the_picture(monkeypatch, fov_deg, height, range_m):
    """Long ones, and those in the wide letters of OpenCV 4, lay on the echoes of the outermost beams."""
    boxes = arc_labels(monkeypatch)
    ping = fan_ping(fov_deg, range_m=(0.0, range_m))
    fan = fan_geometry(ping, height)
    drawn = draw_axes(np.zeros((height, fan.width, 3), np.uint8), ping)  # echoes move no label
    margin = (len(drawn) - height) // 2
    for left, right, top, bottom in boxes:
        assert right < drawn.shape[1]
        if right >= drawn.shape[1] - 4:  # no room to move it aside
            continue
        rows, columns = np.mgrid[top : bottom + 1, left : right + 1]
        port, forward = fan.sonar_column + margin - columns, fan.sonar_row + margin - rows
        low = fan.azimuth_edges_rad[0]
        past_edge = port * np.cos(low) - forward * np.sin(low) > 1  # pixels
        assert not (past_edge & (np.hypot(port, forward) < fan.range_edges_m[1] * fan.pixels_per_m)).any()


def test_pictures_of_other_fans():
    ping = fan_ping(60)
    with pytest.raises(Error) as caught:
        draw_axes(np.zeros((100, 90, 3), np.uint8), ping)
    assert str(caught.value) == (
        "draw_axes needs the (H, W, 3) uint8 picture of this ping's fan image, here (100, 100, 3) "
        "(got (100, 90, 3), uint8)"
    )
    with pytest.raises(Error, match=r"fan image \(got \(100, 100\), float64\)"):
        draw_axes(np.zeros((100, 100)), ping)
