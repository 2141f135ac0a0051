"""PLY files, made ready for trimesh.

It takes all faces of a binary file to have as many corners as the first one. Of text, it fails at lists beside the
corners, such as texture coordinates, where faces have several sizes or there is just one.
"""

from __future__ import annotations

import re

import numpy as np

from sonar_gl.core.errors import Error

# names of a type in PLY -> NumPy's
TYPES = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"}
TYPES |= {"float": "f4", "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2"}
TYPES |= {"int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8"}
HEADER = re.compile(rb"ply\r?\n.*?\nend_header\r?\n", re.DOTALL)
INDICES = "vertex_indices", "vertex_index"


def tidy_ply(data: bytes) -> bytes:
    """Return the same mesh; of triangles, each polygon a fan, if a binary file has faces of several sizes.

    Faces of text that have other lists beside their corners keep the corners alone. Any other file stays as it is, also
    one that is broken: trimesh says what is wrong with it. What a binary file of several sizes states of its faces but
    their corners, and what follows them, is left out.

    Raises
    ------
    Error
        if faces are strips, which trimesh leaves out.
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
        start, properties, count, kept = _faces(data, header, order)
        corners = _corners(data, start, properties, count)
    except (KeyError, ValueError, IndexError, OverflowError):
        return data
    sizes = {len(face) for face in corners}
    if len(sizes) < 2:
        return data
    fans = [np.column_stack((np.full(len(f) - 2, f[0]), f[1:-1], f[2:])) for f in corners if len(f) > 2]
    triangles = np.concatenate(fans) if fans else np.empty((0, 3))
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


def _faces(data: bytes, header, order: str) -> tuple[int, list, int, bytes]:
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


def _corners(data: bytes, start: int, properties: list, count: int) -> list[np.ndarray]:
    """Return the corners of each face; of none if all lists of the faces are as long as those of the first."""
    if count > len(data) or not any(len(types) == 2 and name in INDICES for name, types in properties):
        raise ValueError("no faces")
    if _is_even(data, start, properties, count):
        return []
    out = []
    for _ in range(count):
        for name, types in properties:
            n = 1
            if len(types) == 2:
                n = _length(data, types[0], start)
                start += types[0].itemsize
                if name in INDICES:
                    out.append(np.frombuffer(data, types[1], n, start))
            start += n * types[-1].itemsize
    return out


def _is_even(data: bytes, start: int, properties: list, count: int) -> bool:
    """Return whether all faces take as many bytes as the first, by the lengths of their lists."""
    fields, end = [], start
    for number, (_, types) in enumerate(properties):
        n = 1
        if len(types) == 2:
            n = _length(data, types[0], end)
            fields.append((f"n{number}", types[0]))
        fields.append((f"values{number}", types[-1], (n,)))
        end = start + np.dtype(fields).itemsize
    if len(data) < start + count * (end - start):
        return False
    rows = np.frombuffer(data, np.dtype(fields), count, start)
    return all((rows[name] == rows[name][:1]).all() for name in rows.dtype.names if name.startswith("n"))


def _length(data: bytes, kind: np.dtype, start: int) -> int:
    n = int(np.frombuffer(data, kind, 1, start)[0])
    if n < 0:
        raise ValueError("a list of negative length")
    return n
