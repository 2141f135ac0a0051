"""The command `batch`: data sets of many pings, from a job file."""

from __future__ import annotations

import shlex
import sys
import threading
from contextlib import contextmanager
from pathlib import Path

from tqdm import tqdm

from sonar_gl.batch import run as runs
from sonar_gl.batch.dry_run import dry_run
from sonar_gl.batch.folder import Folder
from sonar_gl.batch.job import read_job
from sonar_gl.batch.manifest import check
from sonar_gl.cli.common import FILES_ARE_COMPLETE
from sonar_gl.cli.common import progress as show_progress
from sonar_gl.cli.output import echo
from sonar_gl.core.errors import Error, escape_controls
from sonar_gl.core.load_numba import load_numba

# options that say how pings are made
MAKING = "dry_run", "out", "resume", "any_system", "workers", "device", "cluster"


def batch(options) -> int:
    """Run, check or try the batch that the options describe, and return the exit status."""
    load_numba()
    if options.mend and not options.resume:
        raise Error("--mend needs --resume (it mends what is in the folder)")
    if (options.job is None) == (options.check is None):
        given = "neither" if options.job is None else "both"
        raise Error(f"batch must be given either a job file, or --check and a folder (got {given})")
    if options.check is not None:
        _check_alone(options, "--check", "a check makes no pings", MAKING)
    if options.dry_run:
        _check_alone(options, "--dry-run", "a dry run counts the whole job", ("resume",))
    tqdm.set_lock(threading.RLock())  # by default it is a lock of processes, which would outlive the command
    if options.check is not None:
        return _show_faults(options.check, check(Folder(options.check, create=False), show_progress))
    job = read_job(options.job)
    devices = runs.devices_of(options.workers, options.device)
    if options.dry_run:
        echo(dry_run(job, devices, _report))
        return 0
    url = options.out or Path(options.job).stem
    settings = runs.RunSettings(options.resume, options.mend, options.any_system, options.cluster)
    try:
        outcome = runs.run(job, url, devices, _report, _progress, settings)
    except KeyboardInterrupt:
        has_files = any(not name.startswith(".") for name in Folder(url, create=False).names(""))
        raise KeyboardInterrupt(*[FILES_ARE_COMPLETE] * has_files) from None
    for number, why in sorted(outcome.set_aside.items()):
        _report(f"set aside: {outcome.describe(number)}: {why}")
    return _show_outcome(outcome, url, options.job)


def _check_alone(options, option: str, why: str, others: tuple[str, ...]):
    """Raise an Error if options are given that another one would leave without effect."""
    for name in others:
        if getattr(options, name):
            raise Error(f"{option} and --{name.replace('_', '-')} exclude each other ({why}; leave one out)")


def _report(text: str):
    """Show a line, above the progress bar if there is one."""
    tqdm.write(escape_controls(text), file=sys.stderr)


class Lines:
    """A stream that writes each state of a bar as a line; a terminal overwrites the one before."""

    def __init__(self, stream):
        self._stream, self._last = stream, ""

    def write(self, text: str) -> None:
        """Write what a bar shows, unless it has not changed."""
        line = text.strip()
        if line and line != self._last:
            self._stream.write(line + "\n")
            self._last = line

    def flush(self) -> None:
        self._stream.flush()


@contextmanager
def _progress(n_pings: int, n_done: int):
    """Show a bar with rate and time left; without a terminal, a line every half minute."""
    rarely = {"mininterval": 30.0, "maxinterval": 60.0, "ascii": True, "ncols": 90, "file": Lines(sys.stderr)}
    settings = {} if sys.stderr.isatty() else rarely
    with tqdm(total=n_pings, initial=n_done, unit=" pings", smoothing=0.05, **settings) as bar:
        yield bar.update


def _show_outcome(outcome, url: str, job_file: str) -> int:
    text = f"{url}: {outcome.n_made} of {outcome.n_pings} pings"
    if outcome.without_echo:
        text += f", {outcome.without_echo} of them without an echo"
    if not outcome.is_complete:
        command = shlex.join(["sonar-gl", "batch", job_file, "--out", url, "--resume"])
        echo(f"{text}; continue with: {command}")
        return 130
    echo(text + (f", {len(outcome.set_aside)} set aside" if outcome.set_aside else ""))
    return 3 if outcome.set_aside else 0


def _show_faults(url: str, faults: list[str]) -> int:
    for line in faults:
        echo(line)
    counted = "1 file is" if len(faults) == 1 else f"{len(faults)} files are"
    echo(f"{url}: {f'{counted} missing or damaged' if faults else 'all files are as they were written'}")
    return 1 if faults else 0
