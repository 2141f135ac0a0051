"""Batches in the process of a test: the steps that a `Pool` gives to other processes run here, and start at once."""

from contextlib import contextmanager

from sonar_gl.batch import dry_run
from sonar_gl.batch import run as runs
from sonar_gl.batch.folder import Folder
from sonar_gl.batch.job import Job
from sonar_gl.batch.parts import Batch
from sonar_gl.batch.requests import BatchRequests
from sonar_gl.batch.steps import STEPS


class InlinePool:
    """Runs steps where it is; parameters as for `Pool`."""

    def __init__(self, job, url, devices, warn, any_system=False, is_dry_run=False):
        self.batch, self.stopping = (
            Batch(BatchRequests(Job(**job)), Folder(url), devices[0], any_system),
            False,
        )

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.batch.close()

    def call(self, name, *arguments):
        return STEPS[name](self.batch, *arguments)

    def run_parts(self, parts, numbers, done, one_by_one=False):
        for part in parts:
            done(self.call("make", part, None, one_by_one))


def use_inline_pool(monkeypatch) -> None:
    """Have batches that this process begins, also by the command line, run in it."""
    for module in (runs, dry_run):
        monkeypatch.setattr(module, "Pool", InlinePool)


def run_batch(job, out, done=lambda: None, **settings) -> None:
    """Run a batch to its end; `done` is called after each part, `settings` are those of `RunSettings`."""

    @contextmanager
    def progress(_n_pings, _n_done):
        yield lambda _count: done()

    outcome = runs.run(job, str(out), [None], lambda _text: None, progress, runs.RunSettings(**settings))
    assert outcome.is_complete and not outcome.set_aside
