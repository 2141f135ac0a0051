"""The text of OBJ files, made ready for trimesh, which reads some of what they may hold wrongly, or not at all."""

from __future__ import annotations

import codecs
import re

import numpy as np

from sonar_gl.core.checks import shown
from sonar_gl.core.errors import Error
from sonar_gl.scene.primitives import triangulated

# Lines that are indented, names that tabs follow, lines that go on, ends of lines of old Macs, comments after numbers,
# and corners of faces that are counted back from the face. trimesh leaves out the first two, joins words over the next,
# takes comments for numbers, and counts back from the end of the file. It takes vertex 0, which no file has, as vertex
# 1, and makes a fan of each polygon.
UNTIDY = tuple(
    re.compile(pattern)
    for pattern in (
        rb"\n[ \t]",
        rb"\n(?:v|vt|vn|f|g)\t",
        rb"\\\r?\n",
        rb"\r(?!\n)",
        rb"\n(?:v|vt|vn|f) [^\n#]*#",
        rb"\nf[ \d/]*-",
        rb"\nf[ \d/]* 0+(?!\d)",
        rb"\nf(?: +[\d/]+){5}",
    )
)
# Lines of faces to other readers, which trimesh leaves out: of an outline, an older name of a face, and in upper case
OTHER_FACES = re.compile(rb"\n(?:fo|F|FO) [^\r\n]*")
COUNTED = b"v", b"vt", b"vn"  # what the corner of a face names, in the order of a/b/c
# corners from which on a face may be concave; quadrilaterals stay as they are, since there are many
POLYGON = 5


def tidy_obj(text: bytes) -> bytes:
    """Return the same mesh with one space between words, none before them, and indices from the start of the file.

    Concave polygons become triangles. Where a file has groups and no objects, its groups become objects.

    Raises Error if a face names a vertex 0, or one that is counted back beyond the first, or its line is not named f.

    >>> tidy_obj(b"\\tv 0 0 0\\n v 1 0 0\\nv\\t0 1 0\\nf -3 -2 -1\\nv 5 5 5")
    b'v 0 0 0\\nv 1 0 0\\nv 0 1 0\\nf 1 2 3\\nv 5 5 5'
    >>> tidy_obj(b"v 0 0 0\\nv 1 0 0\\nv 0 1 0\\ng a\\nf 1 2 3\\ng b\\nf 3 2 1")
    b'v 0 0 0\\nv 1 0 0\\nv 0 1 0\\no a\\nf 1 2 3\\no b\\nf 3 2 1'
    """
    if b"\0" in text:  # of UTF-16
        return text
    text = text.removeprefix(codecs.BOM_UTF8)  # trimesh leaves out the line that it begins
    parts = b"\n" + text[:200], text  # the first line has no other before it
    if any(pattern.search(part) for pattern in UNTIDY for part in parts):
        text = _tidy_lines(text)
    if other := OTHER_FACES.search(text):
        raise Error(
            f"faces of an OBJ file must be lines that begin with 'f' (got {shown(other[0].decode('latin-1').strip())}; "
            "write f in place of fo, and the names of all lines in lower case)"
        )
    if not re.search(rb"(?m)^o ", text) and len(set(re.findall(rb"(?m)^g +\S[^\r\n]*", text))) > 1:
        text = re.sub(rb"(?m)^g ", b"o ", text)
    return text


def _tidy_lines(text: bytes) -> bytes:
    counts, vertices, lines = dict.fromkeys(COUNTED, 0), [], []
    for line in re.sub(rb"\\\r?\n", b" ", text).splitlines():
        words = line.split()
        kind = words[0] if words else b""
        if b"#" in line and (kind == b"f" or kind in counts):
            words = line.partition(b"#")[0].split()
        if kind in counts:
            counts[kind] += 1
        if kind == b"v":
            vertices.append(words[1:4])
        elif kind == b"f":
            if b"-" in line:
                words[1:] = [_from_start(word, list(counts.values())) for word in words[1:]]
            if any(re.fullmatch(rb"(?:0+|-\d+)(?:/.*)?", word) for word in words[1:]):
                raise Error(
                    f"faces of an OBJ file must name vertices that exist, the first of which is 1 (got "
                    f"{shown(line.decode('latin-1').strip())}; add 1 to the numbers of a file that counts from 0)"
                )
            if len(words) > POLYGON:
                lines += [b" ".join((b"f", *face)) for face in _convex_faces(words[1:], vertices)]
                continue
        lines.append(b" ".join(words))
    return b"\n".join(lines)


def _from_start(corner: bytes, counts: list[int]) -> bytes:
    """Return a corner of a face, such as -1//-1, with indices that count from the start of the file."""
    parts = corner.split(b"/")
    for place, (part, count) in enumerate(zip(parts, counts, strict=False)):
        if re.fullmatch(rb"-\d+", part):
            parts[place] = b"%d" % (count + 1 + int(part))
    return b"/".join(parts)


def _convex_faces(corners: list[bytes], vertices: list[list[bytes]]) -> list[list[bytes]]:
    """Return the corners of a polygon, or of triangles if it is concave; a polygon that is broken stays as it is."""
    try:
        points = np.array([vertices[int(corner.split(b"/")[0]) - 1] for corner in corners], np.float64)
    except (ValueError, IndexError):
        return [corners]
    points = points - points[0]
    edges = np.roll(points, -1, axis=0) - points
    normal = np.cross(points, np.roll(points, -1, axis=0)).sum(axis=0)  # of Newell, twice the area long
    turns = np.cross(np.roll(edges, 1, axis=0), edges) @ normal
    if not turns.min() < -1e-9 * (normal @ normal):
        return [corners]
    axis = int(np.abs(normal).argmax())
    flat = np.roll(points, -axis - 1, axis=1)[:, :2]  # the other two axes, in the order that keeps the sense
    faces = triangulated(flat, [len(flat)])[:, :: -1 if normal[axis] < 0 else 1]
    return [[corners[k] for k in face] for face in faces] or [corners]
