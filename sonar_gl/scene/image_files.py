"""Reading images from files, whose size is known before they are decoded."""

from __future__ import annotations

import warnings
from contextlib import suppress

import numpy as np

from sonar_gl.core.errors import Error
from sonar_gl.core.input_files import check_is_file

# A height map has two triangles for each pixel, and a reflectivity map takes about 50 bytes a pixel to look at. A small
# file may claim many more: a PNG of 8 MB can hold 900 million pixels.
MAX_PIXELS = 20_000_000
# that OpenCV reads, too, but for TIFF
FORMATS = ("PNG", "JPEG", "JPEG2000", "BMP", "PPM", "SUN", "WEBP", "GIF")
TIFF_SIGNATURES = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
TIFF_COLUMNS, TIFF_ROWS = 256, 257  # numbers of the tags


def read_image_file(path, what: str, kinds: str) -> np.ndarray:
    """Return an image as stored: (H, W), or (H, W, channels) in OpenCV's order, of the file's own type.

    Raises Error if the file is missing, no image, or has more than MAX_PIXELS pixels by its header, without decoding
    it.

    what : name of the image in messages, such as "a height map"
    kinds : examples of what is expected, for messages
    """
    import cv2

    check_is_file(path)
    image, (n_columns, n_rows) = None, _size_by_header(path, what, kinds)
    if n_columns * n_rows > MAX_PIXELS:
        got = f"{n_columns} x {n_rows}"
        raise Error(f"{path}: {what} must have at most {MAX_PIXELS} pixels (got {got}; make it smaller)")
    with suppress(cv2.error):
        image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise _not_an_image(path, what, kinds)
    return image


def _size_by_header(path, what: str, kinds: str) -> tuple[int, int]:
    """Return the columns and rows of an image by its header; raise an `Error` if there is no such header."""
    from PIL import Image

    try:
        with open(path, "rb") as file, warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of many pixels, and of metadata
            if file.read(4) in TIFF_SIGNATURES:
                return _tiff_size(file)
            with Image.open(file, formats=FORMATS) as image:
                return image.size
    except Image.DecompressionBombError:
        most = 2 * Image.MAX_IMAGE_PIXELS
        raise Error(
            f"{path}: {what} must have at most {MAX_PIXELS} pixels (got more than {most}; make it smaller)"
        ) from None
    except Exception:  # Pillow raises anything for bytes that are no image
        raise _not_an_image(path, what, kinds) from None


def _tiff_size(file) -> tuple[int, int]:
    """Return the columns and rows of a TIFF by its tags: `Image.open` refuses TIFF of 64 bits, which OpenCV reads."""
    from PIL.TiffImagePlugin import ImageFileDirectory_v2

    file.seek(0)
    header = file.read(8)
    if header[2:4] in (b"+\0", b"\0+"):  # BigTIFF, whose header is longer
        header += file.read(8)
    tags = ImageFileDirectory_v2(header)
    file.seek(tags.next)
    tags.load(file)
    return int(tags[TIFF_COLUMNS]), int(tags[TIFF_ROWS])


def _not_an_image(path, what: str, kinds: str) -> Error:
    return Error(f"{path}: {what} must be an image that OpenCV reads ({kinds})")
