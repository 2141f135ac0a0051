"""Files: pictures, pings, animations. Each is written beside its place and renamed: never half a file."""

from __future__ import annotations

import dataclasses
import io
import json
import os
import uuid
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np

from sonar_gl.types import Error, Ping


def output_folder(path) -> Path:
    """The folder `path`, made if it is not there, with a trial file to see that it can be written.

    Raises
    ------
    Error
        naming the folder and the reason: not a folder, permission denied, disk full ...
    """
    folder = Path(path)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        trial = _beside(folder / "trial")
        try:
            trial.write_bytes(b"sonar")
        finally:
            trial.unlink(missing_ok=True)
    except OSError as why:
        raise Error(f"cannot write into the folder {str(folder)!r}: {_reason(why, folder)}") from None
    return folder


def save_png(path, picture: np.ndarray) -> None:
    """Write a picture as PNG: path ends in .png, and its folder exists; picture as of `png_bytes`."""
    path = _checked(path, (".png",))
    data = png_bytes(picture)
    with replacing(path) as beside:
        beside.write_bytes(data)


def png_bytes(picture: np.ndarray) -> bytes:
    """A picture as a PNG file holds it.

    Parameters
    ----------
    picture : (H, W) or (H, W, 3) RGB; uint8, float 0..1 (to 8 bit), or (H, W) uint16 (16 bit gray)
    """
    picture = np.asarray(picture)
    if not (picture.ndim == 2 and picture.dtype == np.uint16):
        picture = eight_bit(picture, "a PNG")
    if picture.ndim == 3:
        picture = cv2.cvtColor(picture, cv2.COLOR_RGB2BGR)
    done, data = cv2.imencode(".png", np.ascontiguousarray(picture))
    if not done:
        raise Error(f"a picture of shape {picture.shape} cannot be written as PNG")
    return data.tobytes()


def save_npz(path, ping: Ping) -> None:
    """Write a ping's arrays under the names of its fields, and `meta` as JSON text; path ends in .npz.

    The same ping gives the same bytes. Not compressed: echoes hardly shrink, and reading stays fast.
    """
    path = _checked(path, (".npz",))
    try:
        data = npz_bytes(ping)
    except Error as why:
        raise Error(f"{str(path)!r}: {why}") from None
    with replacing(path) as beside:
        beside.write_bytes(data)


def npz_bytes(ping: Ping) -> bytes:
    """A ping as an NPZ file holds it, see `save_npz`."""
    arrays = {f.name: getattr(ping, f.name) for f in dataclasses.fields(Ping) if f.name != "meta"}
    arrays = {name: np.asarray(array) for name, array in arrays.items() if array is not None}
    try:
        meta = json.dumps(ping.meta, default=_plain, ensure_ascii=False)
    except (TypeError, ValueError) as why:
        raise Error(f"meta of the ping must be plain values that JSON can hold ({why})") from None
    data = io.BytesIO()
    np.savez(data, **arrays, meta=np.array(meta))
    return data.getvalue()


def load_npz(path) -> Ping:
    """The ping that `save_npz` wrote; its arrays are read-only."""
    path = Path(path)
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
    except OSError as why:
        raise Error(f"cannot read the ping {str(path)!r}: {_reason(why, path)}") from None
    except Exception:  # whatever NumPy and zipfile make of bytes that are no archive
        raise Error(f"cannot read the ping {str(path)!r}: not an NPZ file") from None
    names = [f.name for f in dataclasses.fields(Ping)]
    missing = [name for name in ("intensity", "azimuth_rad", "range_m") if name not in arrays]
    if missing:
        raise Error(f"{str(path)!r} holds no ping: it lacks {', '.join(missing)} (got {', '.join(arrays)})")
    shape = (arrays["azimuth_rad"].size, arrays["range_m"].size)
    if arrays["intensity"].shape != shape:
        raise Error(
            f"{str(path)!r}: intensity must be (beams, bins) = {shape} (got {arrays['intensity'].shape})"
        )
    for array in arrays.values():
        array.setflags(write=False)
    meta = json.loads(str(arrays.pop("meta", "{}")))
    if "error_estimate" in arrays:
        arrays["error_estimate"] = float(arrays["error_estimate"])
    return Ping(**{name: arrays[name] for name in names if name in arrays}, meta=meta)


def save_animation(path, frames: Iterable[np.ndarray], fps: float) -> None:
    """Write pictures as a film that loops (.gif) or plays (.mp4).

    Parameters
    ----------
    path : ends in .gif or .mp4; its folder exists
    frames : pictures of one size, (H, W) or (H, W, 3) RGB, uint8 or float 0..1; may be a generator,
        of which .mp4 holds one frame at a time
    fps : frames a second, up to 120

    Notes
    -----
    GIF: each frame has a palette of its own, exact up to 256 colours (a coloured fan image has no
    more) and without dither; times are whole hundredths of a second, right on average; frames that
    do not change are joined. MP4: MPEG-4 part 2, the one codec that every build of OpenCV carries and
    that takes milliseconds a frame; odd sizes get a black row or column, as video needs even ones.
    """
    path = _checked(path, (".gif", ".mp4"))
    if isinstance(fps, bool) or not isinstance(fps, (int, float, np.number)) or not 0.01 <= fps <= 120:
        raise Error(f"fps of an animation must lie in 0.01..120 (got {fps!r})")
    frames = _alike(frames)
    try:
        first = next(frames)
    except StopIteration:
        raise Error(f"{str(path)!r}: an animation needs at least one frame (got none)") from None
    with replacing(path) as beside:
        (_write_gif if path.suffix.lower() == ".gif" else _write_mp4)(beside, first, frames, float(fps))


def _write_gif(path: Path, first, rest, fps: float) -> None:
    from PIL import Image  # a tenth of a second to import, for animations alone

    def paletted(index, frame):
        image = Image.fromarray(frame if frame.ndim == 3 else np.repeat(frame[..., None], 3, axis=2))
        exact = image.getcolors(256) is not None
        method = Image.Quantize.MAXCOVERAGE if exact else Image.Quantize.MEDIANCUT
        image = image.quantize(256, method=method, dither=Image.Dither.NONE)
        hundredths = round((index + 1) * 100 / fps) - round(index * 100 / fps)
        image.info["duration"] = 10 * max(1, hundredths)
        return image

    images = (paletted(index, frame) for index, frame in enumerate(rest, start=1))
    paletted(0, first).save(path, format="GIF", save_all=True, append_images=images, loop=0)


def _write_mp4(path: Path, first, rest, fps: float) -> None:
    height, width = first.shape[:2]
    size = (width + width % 2, height + height % 2)
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter_fourcc(*"mp4v"), fps, size)
    if not writer.isOpened():
        raise Error(f"OpenCV cannot write an MP4 of {size[0]} x {size[1]} pixels here; save a .gif instead")
    count = 0
    try:
        for frame in _chain(first, rest):
            frame = cv2.cvtColor(frame, cv2.COLOR_RGB2BGR if frame.ndim == 3 else cv2.COLOR_GRAY2BGR)
            writer.write(cv2.copyMakeBorder(frame, 0, height % 2, 0, width % 2, cv2.BORDER_CONSTANT))
            count += 1
    finally:
        writer.release()
    written = cv2.VideoCapture(str(path))  # a full disk passes the writer without a word
    found = int(written.get(cv2.CAP_PROP_FRAME_COUNT)) if written.isOpened() else 0
    written.release()
    if found != count:
        raise Error(f"only {found} of {count} frames could be written as MP4 (is the disk full?)")


def _chain(first, rest) -> Iterator[np.ndarray]:
    yield first
    yield from rest


def _alike(frames: Iterable[np.ndarray]) -> Iterator[np.ndarray]:
    """The frames in 8 bits, each checked to be like the first."""
    shape = None
    for index, frame in enumerate(frames):
        frame = eight_bit(np.asarray(frame), f"frame {index} of an animation")
        shape = shape or frame.shape
        if frame.shape != shape:
            raise Error(
                f"frame {index} of an animation must have the first one's shape {shape} (got {frame.shape})"
            )
        yield np.ascontiguousarray(frame)


def eight_bit(picture: np.ndarray, what: str) -> np.ndarray:
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
    """What JSON can hold in place of a value that it cannot."""
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, np.ndarray):
        return value.tolist()
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return dataclasses.asdict(value)
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"got {type(value).__name__}")


def _checked(path, suffixes: tuple[str, ...]) -> Path:
    path = Path(path)
    if path.suffix.lower() not in suffixes:
        raise Error(f"{str(path)!r} must end in {' or '.join(suffixes)} (got {path.suffix or 'no suffix'})")
    return path


def _beside(path: Path) -> Path:
    """A name in the same folder, so that the renaming never crosses file systems."""
    return path.with_name(f".{path.stem[:64]}.{uuid.uuid4().hex[:12]}{path.suffix}")


def _reason(why: OSError, folder: Path) -> str:
    at_fault = next((str(p) for p in (folder, *folder.parents) if p.exists() and not p.is_dir()), None)
    if isinstance(why, (NotADirectoryError, FileExistsError)) and at_fault:
        return f"{at_fault!r} is not a folder"
    return (why.strerror or str(why)).lower()


@contextmanager
def replacing(path: Path):
    """Name to write to; becomes `path` at the end, or goes without a trace if the writing fails."""
    if not path.parent.is_dir():
        what = "is not a folder" if path.parent.exists() else "does not exist"
        raise Error(f"cannot write {str(path)!r}: the folder {str(path.parent)!r} {what}")
    beside = _beside(path)
    try:
        yield beside
        os.replace(beside, path)
    except OSError as why:
        raise Error(f"cannot write {str(path)!r}: {_reason(why, path.parent)}") from None
    finally:
        beside.unlink(missing_ok=True)
