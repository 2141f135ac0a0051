"""Images from files: sizes are checked before decoding."""

import struct
import zlib

import cv2
import numpy as np
import pytest

from sonar_gl.core.errors import Error
from sonar_gl.scene import mesh_files
from sonar_gl.scene.image_files import MAX_PIXELS, read_image_file
from sonar_gl.scene.reflectivity_map import read_image

KINDS = "such as PNG"


def png(n_columns, n_rows):
    """Return the header of a 16-bit PNG of this size, and no pixels: whoever decodes it fails in another way."""

    def chunk(kind, content):
        return (
            struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))
        )

    header = struct.pack(">IIBBBBB", n_columns, n_rows, 16, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", b"") + chunk(b"IEND", b"")


def tiff(n_columns, n_rows):
    """Return the tags of a TIFF of 64-bit floats of this size, and no pixels."""
    tags = [(256, 4, n_columns), (257, 4, n_rows), (258, 3, 64), (259, 3, 1), (339, 3, 3)]
    content = b"II*\0" + struct.pack("<IH", 8, len(tags))
    content += b"".join(struct.pack("<HHII", tag, kind, 1, value) for tag, kind, value in tags)
    return content + struct.pack("<I", 0)


@pytest.mark.parametrize("read", [mesh_files.heightmap, read_image])
@pytest.mark.parametrize("make", [png, tiff])
@pytest.mark.parametrize(
    ("size", "got"),
    [
        ((5000, 4001), "5000 x 4001"),
        ((30_000, 30_000), "than|30000 x 30000"),
        ((60_000, 60_000), "than|60000 x 60000"),
        ((2**31 - 1, 2**31 - 1), "than|2147483647 x 2147483647"),
    ],
)
def test_the_size_is_checked_by_the_header(tmp_path, read, make, size, got):
    path = tmp_path / "map.image"
    path.write_bytes(make(*size))
    with pytest.raises(Error) as caught:
        read(str(path))
    text = str(caught.value)
    what = "a height map" if read is mesh_files.heightmap else "a reflectivity map"
    assert text.startswith(f"{path}: {what} must have at most {MAX_PIXELS} pixels (got ")
    assert any(words in text for words in got.split("|")) and text.endswith("; make it smaller)")


@pytest.mark.parametrize(
    ("suffix", "image"),
    [
        ("png", np.arange(6, dtype=np.uint16).reshape(2, 3)),
        ("png", np.arange(24, dtype=np.uint8).reshape(2, 3, 4)),
        ("tiff", np.arange(6, dtype=np.float32).reshape(2, 3)),
        ("tiff", np.arange(6, dtype=np.float64).reshape(2, 3)),  # Pillow knows neither this type
        ("tiff", np.arange(18, dtype=np.float32).reshape(2, 3, 3)),  # nor this one
        ("pgm", np.arange(6, dtype=np.uint8).reshape(2, 3)),
        ("bmp", np.arange(6, dtype=np.uint8).reshape(2, 3)),
    ],
)
def test_images_are_read_as_they_were_stored(tmp_path, suffix, image):
    path = tmp_path / f"a.{suffix}"
    # uncompressed: OpenCV 4 stores three channels of floats with losses otherwise
    cv2.imwrite(str(path), image, [cv2.IMWRITE_TIFF_COMPRESSION, 1] if suffix == "tiff" else [])
    np.testing.assert_array_equal(read_image_file(path, "an image", KINDS), image)


@pytest.mark.parametrize("content", [b" ", b"II*\0", b"MM\0+", b"not an image", png(3, 3), tiff(3, 3)])
def test_what_is_no_image(tmp_path, content):
    path = tmp_path / "a.png"
    path.write_bytes(content)
    with pytest.raises(Error) as caught:
        read_image_file(path, "an image", KINDS)
    assert str(caught.value) == f"{path}: an image must be an image that OpenCV reads ({KINDS})"
