"""Judge the tests by mutations: small mistakes in the code that some test must notice.

    python -m tools.mutations --list                      # the table, and where each applies
    python -m tools.mutations --run --only "labels/*"     # these; prints killed or survived, and the score

A mutation is looked up by its tokens, so that line breaks and spaces do not matter; it must occur once in the
package. The tree is copied to a temporary folder, one mutation is applied, and pytest runs with -x. First the
same tests run without a mutation: a mutation says nothing where they fail by themselves. A mutation is killed
if a test fails, if pytest ends otherwise, or if it takes longer than a quarter of an hour.
"""

from __future__ import annotations

import argparse
import ast
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from functools import cache
from pathlib import Path
from time import perf_counter

ROOT = Path(__file__).resolve().parents[1]
TABLE = Path(__file__).with_suffix(".txt")
UNCOPIED = (".git", ".venv", ".hypothesis", ".pytest_cache", ".ruff_cache", "out", "build", "pictures")
TOKEN = re.compile(r"\w+|[^\w\s]")
PASSED = 0  # exit status of pytest
TIMEOUT_S = 900.0


@dataclass(frozen=True)
class Mutation:
    """One mistake; `TABLE` says what its fields hold."""

    name: str
    old: str
    new: str
    tests: tuple[str, ...]


def read_table(text: str) -> tuple[Mutation, ...]:
    r"""Return the mutations of a text in the form of `TABLE`.

    >>> read_table("tests: test_a test_b::test_c\nroom/what is wrong\n  - old\n  + new")
    (Mutation(name='room/what is wrong', old='old', new='new', tests=('test_a', 'test_b::test_c')),)
    """
    rows, tests = [], ()
    for line in text.splitlines():
        mark, part = line[:4], line[4:]
        if mark == "  - ":
            rows[-1].old.append(part)
        elif mark == "  + ":
            rows[-1].new.append(part)
        elif line.startswith("tests: "):
            tests = tuple(line.split()[1:])
        elif line and not line.startswith("#"):
            rows.append(Mutation(line, [], [], tests))
    return tuple(replace(row, old="\n".join(row.old), new="\n".join(row.new)) for row in rows)


MUTATIONS = read_table(TABLE.read_text(encoding="utf-8"))


@cache
def tokens_of(text: str) -> tuple[list[str], list[tuple[int, int]]]:
    """Return the tokens of a text without its comments, and the span of each."""
    found = []
    start = 0
    for line in text.splitlines(keepends=True):
        code = re.sub(r"(?:^|\s)#\s.*", lambda match: " " * len(match[0]), line.rstrip("\n"))
        found += [(match[0], (start + match.start(), start + match.end())) for match in TOKEN.finditer(code)]
        start += len(line)
    return [token for token, _ in found], [span for _, span in found]


def places_of(old: str, root: Path) -> list[tuple[Path, int, int]]:
    """Return where a text stands in the package: file, first character and past the last."""
    wanted, out = tokens_of(old)[0], []
    for path in sorted((root / "sonar_gl").rglob("*.py")):
        tokens, spans = tokens_of(path.read_text(encoding="utf-8"))
        if " ".join(wanted) not in " ".join(tokens):  # most files, and much faster than the loop
            continue
        for k in range(len(tokens) - len(wanted) + 1):
            if tokens[k] == wanted[0] and tokens[k : k + len(wanted)] == wanted:
                out.append((path, spans[k][0], spans[k + len(wanted) - 1][1]))
    return out


def test_files(mutation: Mutation) -> list[str]:
    """Return the test files of a mutation, or tests of them, as arguments of pytest, relative to the root."""
    out = []
    for words in mutation.tests:
        name, *test = words.split("::")
        found = sorted((ROOT / "tests").rglob(f"{name}.py"))
        if len(found) != 1:
            raise SystemExit(
                f"{mutation.name}: there must be one module {name} in tests/ (there are {len(found)})"
            )
        text = found[0].read_text(encoding="utf-8")
        if not all(re.search(rf"(def|class) {part.partition('[')[0]}\b", text) for part in test):
            raise SystemExit(f"{mutation.name}: there is no {'::'.join(test)} in {found[0]}")
        out.append("::".join((found[0].relative_to(ROOT).as_posix(), *test)))
    return list(dict.fromkeys(out))


def mutated(mutation: Mutation, path: Path, first: int, past: int) -> str:
    """Return the text of a file with the mistake, at a place of the old text."""
    text = path.read_text(encoding="utf-8")
    return text[:first] + mutation.new + text[past:]


def apply(mutation: Mutation, root: Path):
    """Put the mistake into a tree."""
    ((path, first, past),) = places_of(mutation.old, root)
    path.write_text(mutated(mutation, path, first, past), encoding="utf-8")


def run_pytest(root: Path, words: list[str]) -> tuple[int | None, str]:
    """Run pytest in a tree; return its exit status, None after the timeout, and what it printed."""
    environment = {**os.environ, "PYTHONPATH": str(root)}
    command = [sys.executable, "-m", "pytest", "-x", "-rfE", "-p", "no:cacheprovider", *words]
    try:
        done = subprocess.run(
            command, cwd=root, env=environment, capture_output=True, text=True, timeout=TIMEOUT_S
        )
    except subprocess.TimeoutExpired:
        return None, ""
    return done.returncode, done.stdout + done.stderr


def copied(folder: str) -> Path:
    """Copy the tree, with its compiled kernels."""
    out = Path(folder) / "tree"
    shutil.copytree(ROOT, out, ignore=shutil.ignore_patterns(*UNCOPIED), symlinks=True)
    return out


def judge(mutation: Mutation, words: list[str]) -> tuple[bool, str]:
    """Return whether tests notice a mutation, and which."""
    with tempfile.TemporaryDirectory() as folder:
        tree = copied(folder)
        apply(mutation, tree)
        status, printed = run_pytest(tree, words)
    if status == PASSED:
        return False, ""
    if status is None:
        return True, f"longer than {TIMEOUT_S:g} s"
    failed = re.search(r"^(?:FAILED|ERROR) (\S+)", printed, re.MULTILINE)
    return True, failed[1] if failed else f"pytest ended with {status}"


def check_baseline(words: list[str]):
    """End the program unless tests pass without a mutation."""
    with tempfile.TemporaryDirectory() as folder:
        status, printed = run_pytest(copied(folder), words)
    if status != PASSED:
        raise SystemExit(f"{shlex.join(words)} must pass without a mutation:\n{printed[-3000:]}")


def print_list(mutations) -> bool:
    """Print where each mutation applies; return whether all do.

    End the program where one has no tests, or is no Python: any test would notice that.
    """
    good = True
    for mutation in mutations:
        test_files(mutation)
        places = places_of(mutation.old, ROOT)
        for place in places:
            try:
                ast.parse(mutated(mutation, *place))
            except SyntaxError as why:
                raise SystemExit(f"{mutation.name}: {why}") from None
        good &= len(places) == 1
        where = ", ".join(path.relative_to(ROOT).as_posix() for path, *_ in places)
        print(f"{mutation.name:42} {where if len(places) == 1 else f'{len(places)} places: {where}'}")
    return good


def main():
    """List or run mutations."""
    parser = argparse.ArgumentParser(prog="python -m tools.mutations", description=__doc__.partition("\n")[0])
    parser.add_argument(
        "--list", action="store_true", help="print the table; exit status 1 if one does not apply"
    )
    parser.add_argument("--run", action="store_true", help="run them")
    parser.add_argument("--only", default="*", metavar="GLOB", help="mutations by name, such as 'labels/*'")
    options = parser.parse_args()
    mutations = [one for one in MUTATIONS if fnmatchcase(one.name, options.only)]
    if not mutations:
        parser.error(f"no mutation is named like {options.only!r}")
    if not options.run:
        raise SystemExit(0 if print_list(mutations) else 1)
    good, killed, passing = print_list(mutations), 0, set()
    if not good:
        raise SystemExit("each mutation must occur once")
    for mutation in mutations:
        words = test_files(mutation)
        if tuple(words) not in passing:
            check_baseline(words)
            passing.add(tuple(words))
        start = perf_counter()
        is_killed, by = judge(mutation, words)
        killed += is_killed
        verdict = f"killed by {by}" if is_killed else "survived"
        print(f"{mutation.name:42} {perf_counter() - start:5.0f} s  {verdict}", flush=True)
    print(f"killed {killed} of {len(mutations)}, {killed / len(mutations):.0%}")
    raise SystemExit(0 if killed == len(mutations) else 1)


if __name__ == "__main__":
    main()
