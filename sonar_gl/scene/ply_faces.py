"""PLY files, made ready for trimesh.

It takes the lists of all faces of a binary file to be as long as those of the first. Of text, it fails at lists beside
the corners, such as texture coordinates, where faces have several sizes or there is just one.
"""

from __future__ import annotations

import re
import struct

import numpy as np

from sonar_gl.core.errors import Error

# names of a type in PLY -> NumPy's
TYPES = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"}
TYPES |= {"float": "f4", "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2"}
TYPES |= {"int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8"}
HEADER = re.compile(rb"ply\r?\n.*?\nend_header\r?\n", re.DOTALL)
MAX_HEADER = 65_536  # bytes that are searched for what a header says of positions
INDICES = "vertex_indices", "vertex_index"


def has_doubles(path) -> bool:
    """Return whether a PLY file states positions in double precision."""
    with open(path, "rb") as file:
        header = HEADER.match(file.read(MAX_HEADER))
    return bool(header and re.search(rb"\nproperty +(double|float64) +x\s", header[0]))


def tidy_ply(data: bytes) -> bytes:
    """Return the same mesh; of triangles, each polygon a fan, if lists of faces differ in length in a binary file.

    Faces of text that have other lists beside their corners keep the corners alone. Any other file stays as it is, also
    one that is broken: trimesh says what is wrong with it. What a binary file of several sizes states of its faces but
    their corners, and what follows them, is left out.

    Raises Error if faces are strips, which trimesh leaves out.
    """
    header = HEADER.match(data)
    if header and re.search(rb"\nelement +tristrips +0*[1-9]", header[0]):
        raise Error(
            "faces of a PLY file must be polygons of an element 'face' (got strips of triangles, tristrips; write the "
            "mesh as triangles)"
        )
    if header and re.search(rb"\nformat +ascii", header[0]):
        try:
            return _with_corners_alone(data, header)
        except (ValueError, IndexError):
            return data
    order = re.search(rb"\nformat +binary_(little|big)_endian", header[0]) if header else None
    if order is None:
        return data
    order = "<" if order[1] == b"little" else ">"
    try:
        start, properties, count, kept = _faces(header, order)
        triangles = _triangles(data, start, properties, count)
    except (KeyError, ValueError, IndexError, OverflowError, struct.error):
        return data
    if triangles is None:
        return data
    rows = np.zeros(len(triangles), [("n", "u1"), ("corners", f"{order}i4", 3)])
    rows["n"], rows["corners"] = 3, triangles
    kept += b"element face %d\nproperty list uchar int vertex_indices\nend_header\n" % len(rows)
    return kept + data[header.end() : start] + rows.tobytes()


def _with_corners_alone(data: bytes, header) -> bytes:
    """Return a file of text, without what its faces state beside their corners if that holds lists.

    Raises a ValueError or IndexError if there are no faces, or they end too soon.
    """
    elements, kept = [], []  # of elements: name, count, properties (name, whether it is a list)
    for line in header[0].splitlines():
        words = line.decode("latin-1").split()
        if words[:1] == ["element"]:
            elements.append((words[1], int(words[2]), []))
        elif words[:1] == ["property"]:
            elements[-1][2].append((words[-1], words[1] == "list"))
            if elements[-1][0] == "face" and words[-1] not in INDICES:
                continue
        kept.append(line)
    place = [name for name, _, _ in elements].index("face")
    _, count, properties = elements[place]
    if sum(is_list for _, is_list in properties) < 2:
        return data
    start, rows = sum(count for _, count, _ in elements[:place]), data[header.end() :].splitlines()
    rows[start : start + count] = [
        _corners_of_text(rows[start + k].split(), properties) for k in range(count)
    ]
    return b"\n".join([*kept, *rows, b""])


def _corners_of_text(words: list[bytes], properties: list[tuple[str, bool]]) -> bytes:
    """Return the corners in the words of a face, after their number."""
    start = 0
    for name, is_list in properties:
        size = 1 + int(words[start]) if is_list else 1
        if name in INDICES:
            return b" ".join(words[start : start + size])
        start += size
    raise ValueError("no corners")


def _faces(header, order: str) -> tuple[int, list, int, bytes]:
    """Return where the faces start, their properties (name, types), their number, and the header before them.

    Raises a ValueError if lists come before them, or there are none.
    """
    start, size, count, name, kept, properties = header.end(), 0, 0, "", b"", []
    for line in header[0].splitlines():
        words = line.decode("latin-1").split()
        if words[:1] in (["element"], ["end_header"]):
            start += count * size
            if name == "face":
                return start - count * size, properties, count, kept
            name, count, size, properties = words[1], int(words[2]), 0, []
        elif words[:1] == ["property"]:
            types = [np.dtype(order + TYPES[word]) for word in words[1:-1] if word != "list"]
            properties.append((words[-1], types))
            size += types[0].itemsize
            if words[1] == "list" and name != "face":
                raise ValueError("a list before the faces")
        if name != "face":
            kept += line + b"\n"
    raise ValueError("no faces")


def _triangles(data: bytes, start: int, properties: list, count: int) -> np.ndarray | None:
    """Return (T, 3) corners of fans, of each polygon one; None if all lists of the faces are as long as in the first.

    Raises a ValueError or struct.error if the file ends before, or corners are no vertices.
    """
    corners = next((types for name, types in properties if len(types) == 2 and name in INDICES), None)
    if count > len(data) or corners is None:
        raise ValueError("no faces")
    if _is_even(data, start, properties, count):
        return None
    n_corners, starts = _places_of_corners(data, start, properties, count)
    n_triangles = np.maximum(n_corners - 2, 0)
    first = np.repeat(starts, n_triangles)
    number = np.arange(len(first)) - np.repeat(np.cumsum(n_triangles) - n_triangles, n_triangles)
    kind = corners[1]
    places = first[:, None] + kind.itemsize * np.column_stack((0 * number, number + 1, number + 2))
    each = np.arange(kind.itemsize)
    values = np.frombuffer(data, np.uint8)[places[..., None] + each].view(kind)[..., 0]
    if kind.kind == "f" or values.max(initial=0) > np.iinfo(np.int32).max:
        raise ValueError("corners that are no vertices")
    return values


def _places_of_corners(
    data: bytes, start: int, properties: list, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return how many corners each face has, and where those begin."""
    steps, n_corners, starts = [], np.empty(count, np.int64), np.empty(count, np.int64)
    for name, types in properties:
        is_list = len(types) == 2
        # a million faces take a second by this, and ten by NumPy
        read = (
            struct.Struct(types[0].str[0].replace("|", "<") + types[0].char).unpack_from if is_list else None
        )
        steps.append((read, types[0].itemsize, types[-1].itemsize, is_list and name in INDICES))
    for face in range(count):
        for read, length_size, size, is_corners in steps:
            if read is None:
                start += size
                continue
            n = int(read(data, start)[0])
            if n < 0:
                raise ValueError("a list of negative length")
            start += length_size
            if is_corners:
                n_corners[face], starts[face] = n, start
            start += n * size
    if start > len(data):
        raise ValueError("the file ends before its faces")
    return n_corners, starts


def _is_even(data: bytes, start: int, properties: list, count: int) -> bool:
    """Return whether all faces take as many bytes as the first, by the lengths of their lists."""
    fields, end = [], start
    for number, (_, types) in enumerate(properties):
        n = 1
        if len(types) == 2:
            n = int(np.frombuffer(data, types[0], 1, end)[0])
            if n < 0:
                raise ValueError("a list of negative length")
            fields.append((f"n{number}", types[0]))
            end += types[0].itemsize
        fields.append((f"values{number}", types[-1], (n,)))
        end += n * types[-1].itemsize
    if len(data) < start + count * (end - start):
        return False
    rows = np.frombuffer(data, np.dtype(fields), count, start)
    return all((rows[name] == rows[name][:1]).all() for name in rows.dtype.names if name.startswith("n"))
