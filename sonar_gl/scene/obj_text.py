"""The text of OBJ files, made ready for trimesh, which reads some of what they may hold wrongly, or not at all."""

from __future__ import annotations

import re

# Lines that are indented, names that tabs follow, lines that go on, ends of lines of old Macs, and corners of faces
# that are counted back from the face. trimesh leaves out the first two, joins words over the next, and counts back
# from the end of the file.
UNTIDY = tuple(
    re.compile(pattern)
    for pattern in (rb"\n[ \t]", rb"\n(?:v|vt|vn|f)\t", rb"\\\r?\n", rb"\r(?!\n)", rb"\nf[ \d/]*-")
)
COUNTED = b"v", b"vt", b"vn"  # what the corner of a face names, in the order of a/b/c


def tidy_obj(text: bytes) -> bytes:
    """Return the same mesh with one space between words, none before them, and indices from the start of the file.

    >>> tidy_obj(b"\\tv 0 0 0\\n v 1 0 0\\nv\\t0 1 0\\nf -3 -2 -1\\nv 5 5 5")
    b'v 0 0 0\\nv 1 0 0\\nv 0 1 0\\nf 1 2 3\\nv 5 5 5'
    """
    parts = b"\n" + text[:200], text  # the first line has no other before it
    if b"\0" in text or not any(
        pattern.search(part) for pattern in UNTIDY for part in parts
    ):  # \0: of UTF-16
        return text
    counts, lines = dict.fromkeys(COUNTED, 0), []
    for line in re.sub(rb"\\\r?\n", b" ", text).splitlines():
        words = line.split()
        if words and words[0] in counts:
            counts[words[0]] += 1
        elif words and words[0] == b"f" and b"-" in line:
            words[1:] = [_from_start(word, list(counts.values())) for word in words[1:]]
        lines.append(b" ".join(words))
    return b"\n".join(lines)


def _from_start(corner: bytes, counts: list[int]) -> bytes:
    """Return a corner of a face, such as -1//-1, with indices that count from the start of the file."""
    parts = corner.split(b"/")
    for place, (part, count) in enumerate(zip(parts, counts, strict=False)):
        if re.fullmatch(rb"-\d+", part):
            parts[place] = b"%d" % (count + 1 + int(part))
    return b"/".join(parts)
