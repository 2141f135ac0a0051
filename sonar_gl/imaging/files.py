"""Files of pictures, pings and animations: written under another name and then renamed, so never partial."""

from __future__ import annotations

import dataclasses
import io
import json
import os
from collections.abc import Iterable, Iterator
from itertools import chain
from pathlib import Path

import cv2
import numpy as np

from sonar_gl.acoustics.acoustics import Acoustics
from sonar_gl.core.atomic_file import atomic_write, describe_os_error, write_trial
from sonar_gl.core.checks import (
    as_array,
    check_file_name,
    check_iterable,
    check_kind,
    check_number,
    holds_numbers,
    shown,
)
from sonar_gl.core.errors import Error, errors_at
from sonar_gl.core.input_files import check_is_file
from sonar_gl.core.npz import read_npz
from sonar_gl.core.warn import warn_caller
from sonar_gl.ping import BIN_LABELS, NOISE_PARTS, Ping
from sonar_gl.sonar.sonar import Sonar

MAX_GIF_HUNDREDTHS = 65535  # of a second, the longest duration of a picture: 16 bits
# Fields of a ping that a file does not hold: load_npz makes them from the description in `meta`.
DESCRIBED = {"sonar": Sonar, "acoustics": Acoustics}
NPZ_FIELDS = tuple(f.name for f in dataclasses.fields(Ping) if f.name not in (*DESCRIBED, *NOISE_PARTS))


def output_folder(path) -> Path:
    """Return the folder `path`, created if necessary and tested by writing a trial file.

    Raises Error that names the folder and the reason: not a folder, permission denied, disk full ...
    """
    folder = Path(path)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        write_trial(folder / "trial")
    except OSError as why:
        raise Error(
            f"cannot write into the folder {str(folder)!r}: {describe_os_error(why, folder)}"
        ) from None
    return folder


def save_png(path: str | os.PathLike, picture: np.ndarray) -> None:
    """Write a picture as PNG.

    Parameters
    ----------
    path : ends in .png; its folder exists
    picture : (H, W) or (H, W, 3) RGB, uint8 or float 0..1, stored in 8 bits; or (H, W) uint16, 16-bit gray

    Raises
    ------
    Error
        if the path or the picture is of another kind, or the file cannot be written.
    """
    path = check_file_name(path, (".png",))
    data = png_bytes(picture)
    with atomic_write(path) as beside:
        beside.write_bytes(data)


def png_bytes(picture: np.ndarray) -> bytes:
    """Return the content of a PNG file of a picture, as `save_png` takes it."""
    picture = whole_numbers(picture, "a PNG")
    if picture.ndim == 3:
        picture = cv2.cvtColor(picture, cv2.COLOR_RGB2BGR)
    done, data = cv2.imencode(".png", np.ascontiguousarray(picture))
    if not done:
        raise Error(f"a picture of shape {picture.shape} cannot be written as PNG")
    return data.tobytes()


def save_npz(path: str | os.PathLike, ping: Ping) -> None:
    """Write a ping's arrays under the names of its fields, and `meta` as JSON text.

    `meta` holds the fields of the ping's `sonar` and `acoustics`, from which `load_npz` makes them again. The
    same ping gives the same bytes. The file is not compressed: echoes hardly shrink, and reading stays fast.

    Parameters
    ----------
    path : ends in .npz; its folder exists

    Raises
    ------
    Error
        if the path has another suffix, the arrays do not fit one another, `meta` holds values that JSON cannot, or the
        file cannot be written.
    """
    path = check_file_name(path, (".npz",))
    check_kind("ping", ping, Ping, "as Simulator.ping returns it")
    with errors_at(repr(str(path))):
        data = npz_bytes(ping)
    with atomic_write(path) as beside:
        beside.write_bytes(data)


def npz_bytes(ping: Ping) -> bytes:
    """Return the content of an NPZ file of a ping, see `save_npz`."""
    arrays = {name: getattr(ping, name) for name in NPZ_FIELDS if name != "meta"}
    needed = "intensity", "azimuth_rad", "range_m"
    arrays = {
        name: np.asarray(array) for name, array in arrays.items() if array is not None or name in needed
    }
    for name, array in arrays.items():
        if not holds_numbers(array):
            raise Error(f"{name} of the ping must be numbers (got {shown(getattr(ping, name))})")
    _check_shapes(arrays)  # as `load_npz` does: what is written can be read
    known = {name: getattr(ping, name) for name in DESCRIBED if getattr(ping, name) is not None}
    try:
        meta = json.dumps({**ping.meta, **known}, default=_plain, ensure_ascii=False)
    except (TypeError, ValueError) as why:
        raise Error(f"meta of the ping must be plain values that JSON can hold ({why})") from None
    data = io.BytesIO()
    np.savez(data, **arrays, meta=np.array(meta))
    return data.getvalue()


def load_npz(path: str | os.PathLike) -> Ping:
    """Return the ping that `save_npz` wrote; its arrays are read-only.

    Raises Error if the file holds no ping, or a small file claims arrays of more than 1 GB. Warns if `meta`
    describes a sonar or acoustics that cannot be made: the ping then has None in their place.
    """
    check_kind("path", path, str | os.PathLike, "the name of a file that save_npz wrote")
    path = Path(path)
    if os.path.exists(path):
        check_is_file(path)
    try:
        arrays, names = read_npz(path, dict.fromkeys(NPZ_FIELDS, "biuf") | {"meta": "U"})
    except (OSError, Error) as why:
        reason = describe_os_error(why, path) if isinstance(why, OSError) else why
        raise Error(f"cannot read the ping {str(path)!r}: {reason}") from None
    missing = [name for name in ("intensity", "azimuth_rad", "range_m") if name not in arrays]
    if missing:
        got = ", ".join(names[:20])
        raise Error(f"{str(path)!r} holds no ping: it lacks {', '.join(missing)} (got {got})")
    meta = arrays.pop("meta", np.array("{}"))
    with errors_at(repr(str(path))):
        _check_shapes(arrays)
    meta = _parse_meta(path, meta)
    for array in arrays.values():
        array.setflags(write=False)
    if "error_estimate" in arrays:
        arrays["error_estimate"] = float(arrays["error_estimate"])
    described = dict.fromkeys(DESCRIBED)
    for name, kind in DESCRIBED.items():
        if meta.get(name) is None:
            continue
        try:
            described[name] = kind(**meta[name])
        except (Error, TypeError) as why:  # TypeError: not the fields of this version, or no object
            what = f"meta describes no {kind.__name__}, so the ping has none"
            warn_caller(f"{str(path)!r}: {what} ({why})")
    return Ping(**{name: arrays[name] for name in NPZ_FIELDS if name in arrays}, meta=meta, **described)


def _check_shapes(arrays: dict[str, np.ndarray]) -> None:
    """Raise an `Error` unless arrays, by the names of the fields of a `Ping`, have shapes that fit one another."""
    shape = (arrays["azimuth_rad"].size, arrays["range_m"].size)
    if arrays["intensity"].shape != shape:
        raise Error(f"intensity must be (beams, bins) = {shape} (got {arrays['intensity'].shape})")
    shapes = dict.fromkeys(("intensity", *BIN_LABELS), shape)
    shapes |= {"azimuth_rad": shape[:1], "range_m": shape[1:]}
    shapes |= {"pose": (4, 4), "error_estimate": (), "body_echo": None}
    for name, array in arrays.items():
        if array.shape != shapes[name] and (shapes[name] is not None or array.ndim != 1):
            wanted = "one number for each body" if shapes[name] is None else f"of shape {shapes[name]}"
            raise Error(f"{name} must be {wanted} (got shape {array.shape})")


def _parse_meta(path: Path, text: np.ndarray) -> dict:
    """Return the `meta` of a file from its JSON text."""
    try:
        meta = json.loads(str(text))
    except (ValueError, RecursionError):
        meta = None
    if not isinstance(meta, dict):
        raise Error(f"{str(path)!r}: meta must be JSON, an object (got {str(text)[:40]!r})")
    return meta


def check_fps(fps, film: str) -> float:
    """Return the frames per second of a film, "gif" or "mp4", as `save_animation` takes them, or raise an Error."""
    fps = check_number("fps of an animation", fps, 0.01, 120)
    if film == "gif":
        check_number("fps of a GIF", fps, 0.01, 100, "give fewer, or save an .mp4")
    return fps


def save_animation(path: str | os.PathLike, frames: Iterable[np.ndarray], fps: float) -> None:
    """Write pictures as an animation: .gif, which loops, or .mp4.

    Parameters
    ----------
    path : ends in .gif or .mp4; its folder exists
    frames : pictures of one size, (H, W) or (H, W, 3) RGB, uint8 or float 0..1; or (H, W) uint16, rounded to 8 bits.
        May be a generator; for .mp4 one frame at a time is in memory
    fps : frames per second, 0.01..120; of .gif, whose durations are whole hundredths of a second, 0.01..100

    Raises
    ------
    Error
        if the path has another suffix, `fps` is out of bounds, there is no frame, frames differ in shape, or
        the file cannot be written.

    Notes
    -----
    GIF: each frame has its own palette, without dither. It is exact up to 256 colours, and a coloured fan
    image has no more. Durations are whole hundredths of a second with the right mean; browsers slow down what is
    faster than 50 frames per second. Identical successive frames are joined. MP4: the codec is MPEG-4 part 2, which
    every build of OpenCV includes and which encodes a frame in milliseconds. Video needs even sizes, so odd ones get a
    black row or column.
    """
    path = check_file_name(path, (".gif", ".mp4"))
    film = path.suffix.lower()[1:]
    fps = check_fps(fps, film)
    check_iterable("frames", frames, "give several pictures, also of a generator")
    frames = _checked_frames(frames)
    try:
        first = next(frames)
    except StopIteration:
        raise Error(f"{str(path)!r}: an animation needs at least one frame (got none)") from None
    write = _write_gif if film == "gif" else _write_mp4
    with atomic_write(path) as beside:
        write(beside, first, frames, fps)


def _write_gif(path: Path, first: np.ndarray, rest: Iterator[np.ndarray], fps: float) -> None:
    from PIL import Image  # takes a tenth of a second to import; only animations need it

    def with_palette(frame):
        image = Image.fromarray(frame if frame.ndim == 3 else np.repeat(frame[..., None], 3, axis=2))
        exact = image.getcolors(256) is not None
        method = Image.Quantize.MAXCOVERAGE if exact else Image.Quantize.MEDIANCUT
        return image.quantize(256, method=method, dither=Image.Dither.NONE)

    def images():
        before, shown = None, 0  # hundredths of a second since a picture began
        for index, frame in enumerate(chain((first,), rest)):
            hundredths = round((index + 1) * 100 / fps) - round(index * 100 / fps)
            shown = hundredths + (shown if before is not None and np.array_equal(frame, before) else 0)
            if shown <= MAX_GIF_HUNDREDTHS:
                image, before = with_palette(frame), frame
            else:  # Pillow joins equal pictures, of any number: one that shows what is there begins another
                image, before = _transparent_picture(Image, frame), None
            image.info["duration"] = 10 * hundredths
            yield image

    images = images()
    next(images).save(path, format="GIF", save_all=True, append_images=images, loop=0)


def _transparent_picture(module, frame: np.ndarray):
    """Return a transparent picture of `PIL.Image`, whose hidden colour the frame's first pixel does not have."""
    image = module.new("P", frame.shape[1::-1])
    image.putpalette([255 - int(value) for value in np.broadcast_to(frame[0, 0], 3)])
    image.info["transparency"] = 0
    return image


def _write_mp4(path: Path, first: np.ndarray, rest: Iterator[np.ndarray], fps: float) -> None:
    height, width = first.shape[:2]
    size = (width + width % 2, height + height % 2)
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter_fourcc(*"mp4v"), fps, size)
    if not writer.isOpened():
        raise Error(f"OpenCV cannot write an MP4 of {size[0]} x {size[1]} pixels here; save a .gif instead")
    count = 0
    try:
        for frame in chain((first,), rest):
            frame = cv2.cvtColor(frame, cv2.COLOR_RGB2BGR if frame.ndim == 3 else cv2.COLOR_GRAY2BGR)
            writer.write(cv2.copyMakeBorder(frame, 0, height % 2, 0, width % 2, cv2.BORDER_CONSTANT))
            count += 1
    finally:
        writer.release()
    written = cv2.VideoCapture(str(path))  # the writer does not report a full disk
    found = int(written.get(cv2.CAP_PROP_FRAME_COUNT)) if written.isOpened() else 0
    written.release()
    if found != count:
        raise OSError(f"only {found} of {count} frames could be written (is the disk full?)")


def _checked_frames(frames: Iterable[np.ndarray]) -> Iterator[np.ndarray]:
    """Yield the frames in 8 bits; raise an Error for one whose shape differs from the first one's."""
    shape = None
    for index, frame in enumerate(frames):
        frame = as_array(frame, f"frame {index} of an animation")
        frame = frame / np.float32(65535) if _is_16_bit(frame) else frame
        frame = eight_bit(frame, f"frame {index} of an animation")
        shape = shape or frame.shape
        if frame.shape != shape:
            raise Error(
                f"frame {index} of an animation must have the first one's shape {shape} (got {frame.shape})"
            )
        yield np.ascontiguousarray(frame)


def whole_numbers(picture: np.ndarray, what: str) -> np.ndarray:
    """Return 16-bit gray, (H, W) uint16, as it is, and any other picture as `eight_bit` does."""
    picture = as_array(picture, what)
    return picture if _is_16_bit(picture) else eight_bit(picture, what)


def _is_16_bit(picture: np.ndarray) -> bool:
    """Return whether a picture is 16-bit gray."""
    return picture.ndim == 2 and picture.dtype == np.uint16 and picture.size > 0


def eight_bit(picture: np.ndarray, what: str) -> np.ndarray:
    """Return a picture, (H, W) or (H, W, 3) RGB, uint8 or float 0..1, as uint8.

    Raises Error, which begins with `what`, if the picture has another shape or type, or is not finite.
    """
    if picture.dtype == object and not picture.ndim:
        kind, cure = (
            type(picture.item()).__name__,
            "sonar_gl.colorize(sonar_gl.fan_image(ping)) makes one of a ping",
        )
        raise Error(f"{what} must be an array, (H, W) or (H, W, 3) RGB (got {kind}; {cure})")
    if picture.ndim not in (2, 3) or picture.shape[2:] not in ((), (3,)) or not picture.size:
        raise Error(f"{what} must have shape (H, W) or (H, W, 3) RGB (got {picture.shape})")
    if picture.dtype.kind == "f":
        if not np.isfinite(picture).all():
            raise Error(f"{what} must be finite (got NaN or infinity)")
        return np.rint(picture.clip(0, 1) * 255).astype(np.uint8)
    if picture.dtype != np.uint8:
        raise Error(f"{what} must be uint8, or float 0..1 (got {picture.dtype})")
    return picture


def _plain(value):
    """Return a value that JSON can hold in place of one that it cannot."""
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, np.ndarray):
        return value.tolist()
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return dataclasses.asdict(value)
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"got {type(value).__name__}")
