"""Files are complete or absent, and read back as they were."""

import errno
import json
import os
import resource
from dataclasses import asdict, is_dataclass

import cv2
import numpy as np
import pytest
from PIL import Image

from sonar_gl.acoustics.acoustics import Acoustics
from sonar_gl.core import atomic_file
from sonar_gl.imaging.files import NPZ_FIELDS, load_npz, output_folder, save_animation, save_npz, save_png
from sonar_gl.ping import BIN_LABELS, Ping
from sonar_gl.sonar.sonar import Sonar
from tests.support.errors import error_of


def make_ping(**changes):
    rng = np.random.default_rng(1)
    fields = {
        "intensity": rng.random((5, 7), np.float32),
        "azimuth_rad": np.linspace(-0.4, 0.4, 5),
        "range_m": np.linspace(1, 9, 7),
        "pose": np.eye(4),
        "meta": {"bin_size_m": 8 / 6, "scene": "mine · µ", "seed": 3, "sampling": None},
    }
    return Ping(**{**fields, **changes})


def moving(count, shape=(45, 61, 3)):
    """Yield frames with a square that moves."""
    for index in range(count):
        frame = np.zeros(shape, np.uint8)
        frame[10:30, 5 + 4 * index : 15 + 4 * index] = 255
        yield frame


@pytest.mark.parametrize(
    "picture",
    [
        np.random.default_rng(0).integers(0, 256, (20, 30, 3), dtype=np.uint8),
        np.random.default_rng(0).integers(0, 256, (20, 30), dtype=np.uint8),
        np.random.default_rng(0).integers(0, 65536, (20, 30), dtype=np.uint16),
    ],
)
def test_png_reads_back(tmp_path, picture):
    save_png(tmp_path / "a.png", picture)
    read = np.asarray(Image.open(tmp_path / "a.png"))
    assert (read == picture).all() and os.listdir(tmp_path) == ["a.png"]


def test_a_name_of_as_many_bytes_as_a_name_may_have(tmp_path):
    name = "😀" * 62 + ".png"  # 252 of 255 bytes, as the name beside it has fewer characters than bytes
    save_png(tmp_path / name, np.zeros((3, 3), np.uint8))
    assert os.listdir(tmp_path) == [name]


def test_a_folder_that_is_a_link_to_nowhere(tmp_path):
    (tmp_path / "loop").symlink_to("loop")
    (tmp_path / "gone").symlink_to("missing")
    said = f"cannot write into the folder {str(tmp_path / 'loop')!r}: a loop of symbolic links"
    assert error_of(output_folder, tmp_path / "loop") == said
    gone = str(tmp_path / "gone")
    assert error_of(output_folder, gone) == (
        f"cannot write into the folder {gone!r}: {gone!r} is a link to 'missing', which does not exist"
    )


def test_png_of_floats(tmp_path):
    save_png(tmp_path / "a.png", np.array([[0.0, 0.5, 1.0, 2.0, -1.0]], np.float32))
    assert np.asarray(Image.open(tmp_path / "a.png")).tolist() == [[0, 128, 255, 255, 0]]


@pytest.mark.parametrize(
    ("picture", "expected"),
    [
        ([[0], [0, 1]], "a PNG must be an array (got a list of parts of 1 and 2 numbers)"),
        (np.zeros((2, 2), int), "a PNG must be uint8, or float 0..1 (got int64)"),
        (np.zeros((2, 2, 3), np.uint16), "a PNG must be uint8, or float 0..1 (got uint16)"),
        (np.zeros((2, 2, 4), np.uint8), "a PNG must have shape (H, W) or (H, W, 3) RGB (got (2, 2, 4))"),
        (np.zeros((0, 2)), "a PNG must have shape (H, W) or (H, W, 3) RGB (got (0, 2))"),
        (np.full((2, 2), np.nan), "a PNG must be finite (got NaN or infinity)"),
        (make_ping(), "a PNG must be an array, (H, W) or (H, W, 3) RGB (got Ping;"),
    ],
)
def test_wrong_pictures(tmp_path, picture, expected):
    assert error_of(save_png, tmp_path / "a.png", picture).startswith(expected)
    assert not os.listdir(tmp_path)


def test_wrong_paths(tmp_path):
    picture = np.zeros((2, 2), np.uint8)
    assert error_of(save_png, "a.jpg", picture) == "'a.jpg' must end in .png (got .jpg)"
    assert error_of(save_png, "a", picture) == "'a' must end in .png (got no suffix)"
    absent = tmp_path / "not" / "a.png"
    assert error_of(save_png, absent, picture) == (
        f"cannot write {str(absent)!r}: the folder {str(absent.parent)!r} does not exist"
    )
    (tmp_path / "file").write_text("x")
    below = tmp_path / "file" / "a.png"
    assert error_of(save_png, below, picture) == (
        f"cannot write {str(below)!r}: the folder {str(below.parent)!r} is not a folder"
    )


@pytest.mark.parametrize("labels", [False, True])
def test_npz_reads_back(tmp_path, labels):
    ping = make_ping()
    if labels:
        elevation = np.full((5, 7), np.nan, np.float32)
        elevation[2, 3] = 0.1
        ping = make_ping(body_id=np.arange(35, dtype=np.uint16).reshape(5, 7), elevation_rad=elevation)
    save_npz(tmp_path / "a.npz", ping)
    read = load_npz(tmp_path / "a.npz")
    for name in ("intensity", "azimuth_rad", "range_m", "body_id", "elevation_rad", "pose"):
        expected, found = getattr(ping, name), getattr(read, name)
        if expected is None:
            assert found is None
        else:
            np.testing.assert_array_equal(found, expected)
            assert found.dtype == expected.dtype and not found.flags.writeable
    assert read.meta == ping.meta and read.bin_size_m == ping.bin_size_m
    save_npz(tmp_path / "b.npz", ping)
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    with np.load(tmp_path / "a.npz", allow_pickle=False) as file:
        assert {"intensity", "azimuth_rad", "range_m", "pose", "meta"} <= set(file.files)


def test_npz_with_every_field_reads_back(tmp_path):
    """`load_npz` knows the shape of each field: one that it does not know would be written, and not read."""
    labels = {name: np.full((5, 7), empty) for name, empty in BIN_LABELS.items()}
    ping = make_ping(**labels, body_echo=np.array([1.0, 2.0]), error_estimate=0.01)
    assert [
        name for name in NPZ_FIELDS if getattr(ping, name) is None
    ] == []  # a new field is to be added here
    save_npz(tmp_path / "a.npz", ping)
    read = load_npz(tmp_path / "a.npz")
    for name in NPZ_FIELDS:
        np.testing.assert_array_equal(getattr(read, name), getattr(ping, name))


def plain(value):
    return asdict(value) if is_dataclass(value) else value.item()


def test_npz_holds_sonar_and_acoustics(tmp_path):
    """In `meta`, as plain values, also if the ping's own `meta` lacks them."""
    sonar = Sonar(
        "five",
        np.float32(9e5),
        5,
        7,
        60,
        20.0,
        1.0,
        0.5,
        9.5,
        (-25.0, -9, 0, 9.1, 30),
        "a test",
        bandwidth_hz=3e4,
    )
    acoustics = Acoustics.physical(tvg_k=30.0, pulse=True)
    described = {"sonar": sonar, "acoustics": acoustics}
    save_npz(tmp_path / "a.npz", make_ping(**described))
    read = load_npz(tmp_path / "a.npz")
    assert (read.sonar, read.acoustics) == (sonar, acoustics)
    assert read.meta == {**make_ping().meta, **json.loads(json.dumps(described, default=plain))}
    save_npz(tmp_path / "b.npz", read)
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    save_npz(tmp_path / "a.npz", make_ping())
    read = load_npz(tmp_path / "a.npz")
    assert read.sonar is None and read.acoustics is None


def test_npz_whose_meta_describes_no_sonar(tmp_path):
    """The arrays load, the sonar is None, and a warning states why."""
    save_npz(tmp_path / "a.npz", make_ping(meta={"sonar": {"name": "mine"}, "acoustics": {"tvg_k": -1}}))
    with pytest.warns(UserWarning) as caught:
        read = load_npz(tmp_path / "a.npz")
    assert read.sonar is None and read.acoustics is None and read.intensity.shape == (5, 7)
    sonar, acoustics = (str(warning.message) for warning in caught)
    assert sonar.startswith(f"{str(tmp_path / 'a.npz')!r}: meta describes no Sonar, so the ping has none (")
    assert "frequency_hz" in sonar
    assert acoustics.endswith("(acoustics: tvg_k must lie in 0..60 (got -1; usual are 20, 30 and 40))")
    assert {warning.filename for warning in caught} == {__file__}


def test_bin_size():
    """That of the sonar, else of meta, else the spacing of ranges; a single bin counts from range 0."""
    sonar = Sonar("five", 9e5, 5, 7, 60.0, 20.0, 1.0, 0.5, 7.5)
    assert make_ping(sonar=sonar).bin_size_m == 1.0
    assert make_ping().bin_size_m == 8 / 6 == make_ping(meta={}).bin_size_m
    assert Ping(np.zeros((5, 1)), np.arange(5.0), np.array([3.0])).bin_size_m == 6.0


def test_npz_takes_numpy_and_paths_in_meta(tmp_path):
    meta = {"a": np.float32(0.5), "b": np.arange(3), "c": tmp_path, "d": make_ping().meta}
    save_npz(tmp_path / "a.npz", make_ping(meta=meta))
    expected = {"a": 0.5, "b": [0, 1, 2], "c": str(tmp_path), "d": make_ping().meta}
    assert load_npz(tmp_path / "a.npz").meta == expected


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"intensity": np.zeros((4, 7)).tolist()}, "intensity must be (beams, bins) = (5, 7) (got (4, 7))"),
        ({"intensity": None}, "intensity of the ping must be numbers (got None)"),
        ({"range_m": "abc"}, "range_m of the ping must be numbers (got 'abc')"),
        ({"pose": np.eye(3)}, "pose must be of shape (4, 4) (got shape (3, 3))"),
        ({"body_id": np.zeros((7, 5), np.uint16)}, "body_id must be of shape (5, 7) (got shape (7, 5))"),
    ],
)
def test_what_could_not_be_read_is_not_written(tmp_path, fields, message):
    path = tmp_path / "a.npz"
    assert error_of(save_npz, path, make_ping(**fields)) == f"{str(path)!r}: {message}"
    assert not os.listdir(tmp_path)


def test_frames_of_an_animation_that_are_none(tmp_path):
    for wrong in (None, 5):
        got = error_of(save_animation, tmp_path / "a.gif", wrong, 5)
        kind = type(wrong).__name__
        assert got == f"frames must be an Iterable (got {kind}; give several pictures, also of a generator)"


def test_files_that_are_no_pings(tmp_path):
    path = tmp_path / "a.npz"
    assert error_of(save_npz, path, make_ping(meta={"a": object()})) == (
        f"{str(path)!r}: meta of the ping must be plain values that JSON can hold (got object)"
    )
    assert not os.listdir(tmp_path)
    assert error_of(load_npz, path) == f"cannot read the ping {str(path)!r}: no such file or directory"
    assert error_of(load_npz, None).startswith("path must be a str (got NoneType; ")
    path.write_bytes(b"this is no archive")
    assert error_of(load_npz, path) == f"cannot read the ping {str(path)!r}: not an NPZ file"
    np.savez(path, intensity=np.zeros((2, 2)), other=1)
    assert error_of(load_npz, path) == (
        f"{str(path)!r} holds no ping: it lacks azimuth_rad, range_m (got intensity, other)"
    )
    np.savez(path, intensity=np.zeros((2, 2)), azimuth_rad=np.zeros(3), range_m=np.zeros(2))
    assert error_of(load_npz, path) == f"{str(path)!r}: intensity must be (beams, bins) = (3, 2) (got (2, 2))"


@pytest.mark.parametrize("name", ["a.gif", "A.GIF"])
def test_gif_reads_back(tmp_path, name):
    frames = list(moving(7))
    save_animation(tmp_path / name, iter(frames), fps=15)
    with Image.open(tmp_path / name) as film:
        assert film.n_frames == 7 and film.size == (61, 45) and film.info["loop"] == 0
        durations = []
        for index, frame in enumerate(frames):
            film.seek(index)
            durations.append(film.info["duration"])
            assert (np.asarray(film.convert("RGB")) == frame).all()
    assert sum(durations) == 470 and set(durations) == {60, 70}  # 7 / 15 s


@pytest.mark.parametrize("level", [0, 255])
@pytest.mark.parametrize("others", [0, 2])
def test_gif_of_a_picture_that_stays_longer_than_a_duration_can_be(tmp_path, level, others):
    """Equal frames of 2000 s, where a picture of a GIF lasts 655 s at most."""
    frames = [np.full((20, 31), level, np.uint8)] * 20 + [np.full((20, 31), 99, np.uint8)] * others
    save_animation(tmp_path / "a.gif", frames, fps=0.01)
    with Image.open(tmp_path / "a.gif") as film:
        total_s, seen = 0.0, []
        for number in range(film.n_frames):
            film.seek(number)
            total_s += film.info["duration"] / 1000
            seen.append(np.unique(np.asarray(film.convert("RGB"))).tolist())
    assert total_s == 100 * len(frames)
    assert seen == [[level]] * (film.n_frames - (others > 0)) + [[99]] * (others > 0)


def test_an_mp4_without_room_is_named(tmp_path):
    """OpenCV's writer says nothing of it. Files of more than a limit are refused as those on a full disk are."""
    noise = np.random.default_rng(1).integers(0, 256, (4, 64, 64), np.uint8)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2048, limits[1]))
    try:
        got = error_of(save_animation, tmp_path / "a.mp4", noise, 10)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    path = str(tmp_path / "a.mp4")
    assert got == f"cannot write {path!r}: only 0 of 4 frames could be written (is the disk full?)"
    assert not list(tmp_path.iterdir())


def test_gif_is_no_faster_than_its_durations(tmp_path):
    got = error_of(save_animation, tmp_path / "a.gif", moving(2), 120)
    assert got == "fps of a GIF must lie in 0.01..100 (got 120; give fewer, or save an .mp4)"
    save_animation(tmp_path / "a.mp4", moving(2), 120)


def test_gif_of_16_bits_is_rounded_to_8(tmp_path):
    ramp = np.arange(65536, dtype=np.uint16).reshape(256, 256)
    save_animation(tmp_path / "a.gif", [ramp], fps=10)
    with Image.open(tmp_path / "a.gif") as film:
        assert (np.asarray(film.convert("L")) == np.rint(ramp / 257)).all()


def test_gif_of_256_colours_is_exact(tmp_path):
    ramp = cv2.applyColorMap(np.arange(256, dtype=np.uint8).reshape(16, 16), cv2.COLORMAP_JET)
    save_animation(tmp_path / "a.gif", [ramp, ramp[::-1]], fps=10)
    with Image.open(tmp_path / "a.gif") as film:
        assert (np.asarray(film.convert("RGB")) == ramp).all()
        film.seek(1)
        assert (np.asarray(film.convert("RGB")) == ramp[::-1]).all()


@pytest.mark.parametrize("shape", [(45, 61, 3), (45, 61), (64, 96, 3)])
def test_mp4_reads_back(tmp_path, shape):
    save_animation(tmp_path / "a.mp4", moving(7, shape), fps=12.5)
    film = cv2.VideoCapture(str(tmp_path / "a.mp4"))
    assert film.get(cv2.CAP_PROP_FPS) == pytest.approx(12.5, abs=0.01)
    for expected in moving(7, shape):
        done, frame = film.read()
        assert done and frame.shape == (shape[0] + shape[0] % 2, shape[1] + shape[1] % 2, 3)
        expected = expected if expected.ndim == 3 else np.repeat(expected[..., None], 3, axis=2)
        assert np.abs(frame[: shape[0], : shape[1]].astype(int) - expected).mean() < 6  # lossy
    assert not film.read()[0]
    assert os.listdir(tmp_path) == ["a.mp4"]


def test_mp4_holds_one_frame_at_a_time(tmp_path):
    alive, most = 0, 0

    class Frame(np.ndarray):
        def __del__(self):
            nonlocal alive
            alive -= 1

    def frames():
        nonlocal alive, most
        for _ in range(20):
            alive += 1
            most = max(most, alive)
            yield np.ndarray.__new__(Frame, (32, 32, 3), np.uint8)

    save_animation(tmp_path / "a.mp4", frames(), fps=10)
    assert most <= 5  # the first, the last, and those between generator and writer


@pytest.mark.parametrize("suffix", ["gif", "mp4"])
def test_errors_of_animation(tmp_path, suffix):
    path = tmp_path / f"a.{suffix}"
    path.write_bytes(b"old")
    assert error_of(save_animation, path, [], 10) == (
        f"{str(path)!r}: an animation needs at least one frame (got none)"
    )
    uneven = [np.zeros((4, 4), np.uint8), np.zeros((4, 6), np.uint8)]
    assert error_of(save_animation, path, uneven, 10) == (
        "frame 1 of an animation must have the first one's shape (4, 4) (got (4, 6))"
    )
    wrong = [np.zeros((4, 4), int)]
    assert error_of(save_animation, path, wrong, 10) == (
        "frame 0 of an animation must be uint8, or float 0..1 (got int64)"
    )
    assert error_of(save_animation, path, moving(2), 0) == "fps of an animation must lie in 0.01..120 (got 0)"
    assert error_of(save_animation, "a.avi", moving(2), 5) == "'a.avi' must end in .gif or .mp4 (got .avi)"

    def breaks():
        yield from moving(3)
        raise RuntimeError("the renderer stopped")

    with pytest.raises(RuntimeError, match="the renderer stopped"):
        save_animation(path, breaks(), 10)
    assert os.listdir(tmp_path) == [path.name] and path.read_bytes() == b"old"


@pytest.mark.parametrize("name", ["a.png", "a.npz", "a.gif", "a.mp4"])
@pytest.mark.parametrize(
    ("number", "words"), [(errno.ENOSPC, "no space left on device"), (errno.EACCES, "permission denied")]
)
def test_a_failure_leaves_the_old_file(tmp_path, monkeypatch, name, number, words):
    path = tmp_path / name
    path.write_bytes(b"old")

    def fail(*_):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(atomic_file.os, "replace", fail)
    save = {
        "a.png": lambda: save_png(path, np.zeros((4, 4), np.uint8)),
        "a.npz": lambda: save_npz(path, make_ping()),
        "a.gif": lambda: save_animation(path, moving(2), 5),
        "a.mp4": lambda: save_animation(path, moving(2), 5),
    }[name]
    assert error_of(save) == f"cannot write {str(path)!r}: {words}"
    assert os.listdir(tmp_path) == [name] and path.read_bytes() == b"old"


def test_disk_that_fills_while_writing(tmp_path, monkeypatch):
    path = tmp_path / "a.png"
    path.write_bytes(b"old")
    write = type(path).write_bytes

    def half(self, data):
        write(self, bytes(data)[:10])
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(type(path), "write_bytes", half)
    assert error_of(save_png, path, np.zeros((4, 4), np.uint8)) == (
        f"cannot write {str(path)!r}: no space left on device"
    )
    assert os.listdir(tmp_path) == ["a.png"] and path.read_bytes() == b"old"


def test_output_folder(tmp_path, monkeypatch):
    made = output_folder(tmp_path / "x" / "y")
    assert made == tmp_path / "x" / "y" and made.is_dir() and not os.listdir(made)
    assert output_folder(str(made)) == made
    (tmp_path / "file").write_text("x")
    for below in (tmp_path / "file", tmp_path / "file" / "deeper"):
        assert error_of(output_folder, below) == (
            f"cannot write into the folder {str(below)!r}: {str(tmp_path / 'file')!r} is not a folder"
        )

    def fail(*_):
        raise OSError(errno.EACCES, os.strerror(errno.EACCES))

    monkeypatch.setattr(type(made), "write_bytes", fail)
    assert error_of(output_folder, made) == f"cannot write into the folder {str(made)!r}: permission denied"


def test_arguments_in_another_order_are_errors(tmp_path):
    ping, picture, path = make_ping(), np.zeros((2, 2), np.uint8), tmp_path / "a.npz"
    name = "the name of a file that ends in"
    assert error_of(save_npz, ping, path) == f"path must be a str (got Ping; {name} .npz)"
    assert error_of(save_png, picture, path) == f"path must be a str (got ndarray; {name} .png)"
    assert (
        error_of(save_animation, [picture], path, 10) == f"path must be a str (got list; {name} .gif or .mp4)"
    )
    assert (
        error_of(save_npz, path, picture) == "ping must be a Ping (got ndarray; as Simulator.ping returns it)"
    )
    assert list(tmp_path.iterdir()) == []
