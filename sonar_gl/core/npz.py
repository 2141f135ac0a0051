"""Arrays of NPZ files, whose types and sizes are checked before they are read."""

from __future__ import annotations

import math
import zipfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from sonar_gl.core.errors import Error

# The largest pings, of 4096 beams and 8192 bins with all labels, take 0.8 GB. Compressed zeros shrink a thousandfold,
# so that a small file may claim any size; a file as large as its arrays may be larger.
MAX_BYTES = 1_000_000_000


def read_npz(path: Path, kinds: Mapping[str, str]) -> tuple[dict[str, np.ndarray], list[str]]:
    """Return arrays of numbers or text by name, and the names of all arrays; Python objects are never unpickled.

    Raises OSError if the file cannot be read; Error if it is no NPZ file, an array has another kind, or all together
    would be larger than MAX_BYTES and the file.

    kinds : for each array to read, if it is there, the permitted kinds of its dtype, such as "fiub"
    """
    try:
        with zipfile.ZipFile(path) as archive:
            members = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
            chosen = {name: members[name] for name in kinds if name in members}
            n_bytes, n_bytes_on_disk = sum(info.file_size for info in chosen.values()), path.stat().st_size
            if n_bytes > max(MAX_BYTES, n_bytes_on_disk):
                got = f"{n_bytes / 1e9:.1f} GB from {n_bytes_on_disk / 1e6:.1f} MB"
                raise Error(f"its arrays must not exceed {MAX_BYTES / 1e9:g} GB (got {got})")
            arrays = {name: _read_member(archive, info, name, kinds[name]) for name, info in chosen.items()}
            return arrays, list(members)
    except (OSError, Error):
        raise
    except Exception:  # zipfile and NumPy raise various ones for bytes that are no archive
        raise Error("not an NPZ file") from None


def _read_member(archive: zipfile.ZipFile, info: zipfile.ZipInfo, name: str, kinds: str) -> np.ndarray:
    """Return an array; raise an exception unless its header states the member's size and a permitted type."""
    if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise ValueError("a compression that NumPy does not write")
    with archive.open(info) as file:
        version = np.lib.format.read_magic(file)
        read_header = {
            (1, 0): np.lib.format.read_array_header_1_0,
            (2, 0): np.lib.format.read_array_header_2_0,
        }
        shape, _, dtype = read_header[version](file)
        if dtype.hasobject or dtype.kind not in kinds:
            wanted = "text" if kinds == "U" else "numbers"
            raise Error(f"{name} must hold {wanted} (got {'Python objects' if dtype.hasobject else dtype})")
        if file.tell() + math.prod(shape) * dtype.itemsize != info.file_size:
            raise ValueError("a header of another size")
        file.seek(0)
        return np.lib.format.read_array(file, allow_pickle=False)
