"""Put generated tables into pages of docs/."""

from __future__ import annotations

import re
from pathlib import Path

DOCS = Path(__file__).resolve().parents[2] / "docs"


def put_table(path: Path, name: str, text: str):
    """Replace what stands between the marks `<!-- table NAME -->` and `<!-- end -->` of a page."""
    page = path.read_text(encoding="utf-8")
    first, last = f"<!-- table {name} -->\n", "\n<!-- end -->"
    pattern = re.compile(re.escape(first) + ".*?" + re.escape(last), re.DOTALL)
    if not pattern.search(page):
        raise SystemExit(
            f"{path} must have the line {first.strip()!r}, and a later {last.strip()!r} (got neither, or one)"
        )
    path.write_text(pattern.sub(lambda _: first + text + last, page, count=1), encoding="utf-8")
