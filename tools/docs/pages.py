"""Put generated tables, and what commands print, into pages of docs/.

    python -m tools.docs.pages performance.md                # runs each command that has its output below it
    python -m tools.docs.pages performance.md --only frame   # of these, only commands with this word

A command is replaced by its output where a page has a block of one command, a blank line, and a block of text:

    ```sh
    python -m tools.bench frame
    ```

    ```text
    (what the command printed)
    ```
"""

from __future__ import annotations

import argparse
import re
import shlex
import subprocess
import sys
from pathlib import Path

DOCS = Path(__file__).resolve().parents[2] / "docs"
# a block of one command of tools/, and the block of text that it printed
PRINTED = re.compile(r"(```sh\npython (-m tools\.[^\n#]+)\n```\n\n```text\n)(.*?)(\n```\n)", re.DOTALL)


def find_table(path: Path, name: str) -> re.Match:
    """Return a match of the marks `<!-- table NAME -->` and `<!-- end -->` of a page; its group is the text between."""
    first, last = f"<!-- table {name} -->\n", "\n<!-- end -->"
    pattern = re.compile(f"{re.escape(first)}(.*?){re.escape(last)}", re.DOTALL)
    if found := pattern.search(path.read_text(encoding="utf-8")):
        return found
    raise SystemExit(
        f"{path} must have the line {first.strip()!r}, and a later {last.strip()!r} (got neither, or one)"
    )


def put_table(path: Path, name: str, text: str):
    """Replace what stands between the marks of a table of a page."""
    found = find_table(path, name)
    path.write_text(found.string[: found.start(1)] + text + found.string[found.end(1) :], encoding="utf-8")


def fill_printed(path: Path, only: str = ""):
    """Run the commands of a page whose output stands below them, and put in what they print now.

    `only` selects commands that have it as a word. The page is written after each command, so that an interrupt loses
    only one.
    """
    commands = [found[2].strip() for found in PRINTED.finditer(path.read_text(encoding="utf-8"))]
    commands = [each for each in commands if not only or only in each.split()]
    if not commands:
        raise SystemExit(f"{path} must have a command with its output below it (got none with {only!r})")
    for command in commands:
        print(f"python {command}", flush=True)
        done = subprocess.run(
            [sys.executable, *shlex.split(command)],
            stdout=subprocess.PIPE,
            text=True,
            cwd=DOCS.parent,
            check=False,
        )
        if done.returncode not in (0, 1):  # 1 says that an aim was missed
            raise SystemExit(f"python {command} must end with status 0 or 1 (got {done.returncode})")

        page = path.read_text(encoding="utf-8")
        (place,) = [found for found in PRINTED.finditer(page) if found[2].strip() == command]
        page = page[: place.start(3)] + done.stdout.strip("\n") + page[place.end(3) :]
        path.write_text(page, encoding="utf-8")


def main():
    """Fill the page that the command line names."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("page", help="a page of docs/")
    parser.add_argument("--only", default="", metavar="WORD", help="only commands that have this word")
    args = parser.parse_args()
    fill_printed(DOCS / args.page, args.only)


if __name__ == "__main__":
    main()
