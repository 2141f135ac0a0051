"""Load every SDF file of some checkouts, and print how many load, and why the others do not.

    python -m tools.worlds DIR [DIR ...]          # checkouts of public repositories; prints Markdown
    python -m tools.worlds DIR --ping             # also make one ping of each world, by tolerance 0.1
    python -m tools.worlds DIR --refused out.txt  # also write each refused file and the whole message

Each file is opened three times: as it is; with resource paths, which are the folders of models in its own checkout,
then in the others; and with what is missing left out. Anything but a scene or an Error counts as a crash.
"""

from __future__ import annotations

import argparse
import multiprocessing
import re
import subprocess
import warnings
from collections import Counter
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from tqdm import tqdm

import sonar_gl as sg
from tools.bench import harness

PATTERNS = ("*.world", "*.sdf")
REASONS = (  # what a message says, and the reason in the table; the first that matches
    ("models or files are missing", "models or files are missing"),
    ("broken XML", "broken XML, which Gazebo refuses, too"),
    ("has no bodies|holds no", "nothing that echoes"),
)
TOLERANCE = 0.1  # of the pings: they only have to come back


@dataclass(frozen=True)
class Opened:
    """What came of one file, opened in one way.

    Attributes
    ----------
    error : message, None if it loaded
    is_crash : whether something other than an Error was raised
    """

    error: str | None = None
    is_crash: bool = False


def files_of(checkout: Path) -> list[Path]:
    """Return the files of worlds and models in a checkout."""
    return sorted(path for pattern in PATTERNS for path in checkout.rglob(pattern) if path.is_file())


def model_folders(checkout: Path) -> list[str]:
    """Return the folders that hold models, as a user would name them in GZ_SIM_RESOURCE_PATH."""
    return sorted({str(path.parent.parent) for path in checkout.rglob("model.config")})


def ways_of(paths: list[str]) -> tuple[dict, ...]:
    """Return the keyword arguments of the three ways to open a file."""
    return {}, {"resource_paths": paths}, {"resource_paths": paths, "skip_missing": True}


def open_world(path: Path, paths: list[str], with_ping: bool = False) -> list[Opened]:
    """Open a file in the three ways; the last one also makes a ping if that is wanted."""
    as_it_is, with_paths, skipping = ways_of(paths)
    return [_opened(path, as_it_is), _opened(path, with_paths), _opened(path, skipping, with_ping)]


def _opened(path: Path, kwargs: dict, with_ping: bool = False) -> Opened:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            scene = sg.load_scene(path, **kwargs)
            if with_ping and scene.bodies:
                with sg.Simulator(scene, sg.load_sonar("p900-45"), tolerance=TOLERANCE) as simulator:
                    simulator.ping(sg.pose() if scene.sonar_pose is None else scene.sonar_pose)
        except sg.Error as why:
            return Opened(str(why))
        except Exception as why:  # a crash is a result here
            return Opened(f"{type(why).__name__}: {why}", is_crash=True)
    return Opened()


def reason_of(message: str) -> str:
    """Return the reason in a message, without names and places."""
    for pattern, reason in REASONS:
        if re.search(pattern, message):
            return reason
    return message.partition("\n")[0][:100]


def commit_of(checkout: Path) -> str:
    """Return the commit of a checkout, or '' if it is no Git repository."""
    command = ["git", "-C", str(checkout), "log", "-1", "--format=%h of %cs"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    return done.stdout.strip() if (checkout / ".git").exists() else ""


def print_table(found: dict[Path, list[list[Opened]]]):
    """Print a row per checkout, and the reasons of all."""
    ways = "load as they are", "with resource paths", "with `--skip-missing`"
    table, totals = [], Counter()
    for checkout, rows in found.items():
        loaded = {way: sum(row[k].error is None for row in rows) for k, way in enumerate(ways)}
        refused, crashes = len(rows) - loaded[ways[2]], sum(opened.is_crash for row in rows for opened in row)
        counts = {"files": len(rows), **loaded, "refused": refused, "crashes": crashes}
        totals.update(counts)
        table.append({"repository": " ".join(filter(None, [checkout.name, commit_of(checkout)])), **counts})
    print(harness.markdown([*table, {"repository": "all", **totals}]))
    for way, says in ((0, "as they are"), (2, "with `--skip-missing`")):
        reasons = Counter(
            reason_of(row[way].error) for rows in found.values() for row in rows if row[way].error
        )
        print(f"\nRefused {says}:\n")
        for reason, n in reasons.most_common():
            print(f"- {n}: {reason}")


def main():
    """Open all files and print the table."""
    parser = argparse.ArgumentParser(prog="python -m tools.worlds", description=__doc__.partition("\n")[0])
    parser.add_argument("checkouts", nargs="+", type=Path, metavar="DIR", help="a checkout")
    parser.add_argument("--ping", action="store_true", help="also make a ping of each world")
    parser.add_argument("--refused", type=Path, metavar="FILE", help="write what was refused, and why")
    options = parser.parse_args()
    checkouts = [path.resolve() for path in options.checkouts]
    for checkout in checkouts:
        if not checkout.is_dir():
            parser.error(f"{checkout} must be a folder")
    folders, found = {checkout: model_folders(checkout) for checkout in checkouts}, {}
    # a fresh process each few files: libraries that read meshes keep memory
    with multiprocessing.get_context("spawn").Pool(2, maxtasksperchild=100) as pool:
        for checkout in checkouts:
            others = [folder for other in checkouts if other != checkout for folder in folders[other]]
            opener = partial(open_world, paths=folders[checkout] + others, with_ping=options.ping)
            files = files_of(checkout)
            found[checkout] = list(tqdm(pool.imap(opener, files), checkout.name, len(files)))
    print_table(found)
    if options.refused:
        lines = [
            f"{path}\n    {row[2].error}\n"
            for checkout in checkouts
            for path, row in zip(files_of(checkout), found[checkout], strict=True)
            if row[2].error
        ]
        options.refused.write_text("".join(lines), encoding="utf-8")


if __name__ == "__main__":
    main()
