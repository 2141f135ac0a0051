"""The command `batch`: data sets of many pings, by a job file."""

from __future__ import annotations

import shlex
import sys
import threading
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import click

from sonar_gl.commands import load_numba
from sonar_gl.options import option

EPILOG = """\b
Examples:
  sonar-gl batch survey.toml --dry-run
  sonar-gl batch survey.toml --out survey
  sonar-gl batch survey.toml --out survey --resume
  sonar-gl batch --check survey

\b
Exit status: 0 all pings are there, 1 --check found damage, 2 a mistake in the command line or the job, or a
full disk, 3 all pings are there but some that were set aside, 130 stopped by Ctrl-C.
"""


@click.command(epilog=EPILOG, short_help="Make a data set of many pings, by a job file.")
@click.argument("job", required=False)
@option("out", default=None, show_default="named after the job, here")
@click.option("--dry-run", is_flag=True, help="Say what would be made, its size and time, after a trial.")
@click.option("--resume", is_flag=True, help="Go on with what is in the folder.")
@click.option("--mend", is_flag=True, help="With --resume: find what is damaged, and make it again.")
@click.option("--check", metavar="DIR", help="Compare the files of a batch with their checksums.")
@click.option("--workers", type=click.IntRange(min=1), show_default="one for each core", help="Processes.")
@click.option(
    "--device",
    type=click.IntRange(min=0),
    multiple=True,
    show_default="the variable SONAR_GL_DEVICE, or 0",
    help="Index of an OpenGL device; may be repeated: processes take them in turn.",
)
@click.option("--cluster", metavar="ADDRESS", help="Of a Dask scheduler, whose workers make the pings.")
@click.pass_context
def batch(ctx, **options):
    """Make the pings that the file JOB asks for, label and store them.

    JOB is a TOML file; docs/batch.md tells what it may hold.
    """
    o = SimpleNamespace(**options)
    from sonar_gl.types import Error

    load_numba()
    if o.mend and not o.resume:
        raise Error("--mend must stand with --resume (it mends what is there)")
    if (o.job is None) == (o.check is None):
        raise Error("batch must be given a job file, or --check and a folder (got both or neither)")
    try:
        from tqdm import tqdm

        from sonar_gl.batch import run as batches
        from sonar_gl.batch.job import read_job
        from sonar_gl.batch.trial import dry_run
    except ModuleNotFoundError as why:
        raise Error(
            f"batch needs more packages ({why.name} is not there; pip install 'sonar_gl[batch]')"
        ) from None
    tqdm.set_lock(threading.RLock())  # its own is for processes that share a bar, and is left behind
    if o.check is not None:
        ctx.exit(_check(o.check))
    job = read_job(o.job)
    devices = batches.devices_of(o.workers, o.device)
    if o.dry_run:
        click.echo(dry_run(job, devices, _tell))
        ctx.exit(0)
    url = o.out or Path(o.job).stem
    outcome = batches.run(job, url, devices, o.resume, _tell, _progress, o.cluster, o.mend)
    ctx.exit(_say(outcome, url, o))


def _tell(text: str):
    """Show a line, above the bar if there is one."""
    from tqdm import tqdm

    tqdm.write(text, file=sys.stderr)


@contextmanager
def _progress(total: int, there: int):
    """A bar with rate and time left; without a terminal a line every half minute."""
    from tqdm import tqdm

    is_terminal = sys.stderr.isatty()
    settings = {} if is_terminal else {"mininterval": 30.0, "maxinterval": 60.0, "ascii": True, "ncols": 90}
    with tqdm(total=total, initial=there, unit=" pings", smoothing=0.05, **settings) as bar:
        yield bar.update


def _say(outcome, url, o) -> int:
    """Tell what became of it; the exit status."""
    for number, why in sorted(outcome.set_aside.items()):
        _tell(f"set aside: {outcome.describe(number)}: {why}")
    text = f"{url}: {outcome.made} of {outcome.pings} pings"
    if outcome.without_echo:
        text += f", {outcome.without_echo} of them without an echo"
    if not outcome.is_whole:
        again = shlex.join(["sonar-gl", "batch", o.job, "--out", url, "--resume"])
        click.echo(f"{text}; go on with: {again}")
        return 130
    click.echo(text + (f", {len(outcome.set_aside)} set aside" if outcome.set_aside else ""))
    return 3 if outcome.set_aside else 0


def _check(url: str) -> int:
    """Tell of damage; the exit status."""
    from sonar_gl.batch.files import Folder
    from sonar_gl.batch.finish import check
    from sonar_gl.batch.planned import Planned
    from sonar_gl.commands import progress
    from sonar_gl.types import Error

    folder = Folder(url, make=False)
    planned = Planned.load(folder)
    if planned is None:
        raise Error(f"{url}: must be the folder of a batch (there is no planned.json in it)")
    wrong = check(folder, planned, progress)
    for line in wrong:
        click.echo(line)
    click.echo(
        f"{url}: {len(wrong)} files are wrong" if wrong else f"{url}: all files are as they were written"
    )
    return 1 if wrong else 0
