"""The steps of a batch, each in one process: begin it, create its store, make a part, finalize it."""

from __future__ import annotations

from contextlib import ExitStack

from sonar_gl.batch.manifest import DoneRecord, Manifest, PartRecord, default_pings_per_part
from sonar_gl.batch.outputs import make_outputs, try_outputs
from sonar_gl.batch.parts import Batch, Report, no_report, open_simulators
from sonar_gl.batch.ping_table import gather_ping_variables
from sonar_gl.batch.store import SonarGroup, consolidate, create_arrays, shared_files
from sonar_gl.batch.survey import survey, try_pings
from sonar_gl.batch.system import System, processor


def begin(batch: Batch, report: Report = no_report) -> Manifest:
    """Return the manifest of a new batch, with the engine, driver and libraries of this process.

    Raises Error if an output cannot be written here.
    """
    job, schema, scenes = batch.requests.job, batch.schema, batch.requests.scenes
    with ExitStack() as stack:
        system = System.of(next(iter(open_simulators(batch, 0, stack).values())).gl_info)
    try_outputs(batch.requests, schema, batch.folder)
    n_pings = len(batch.requests)
    per_part = job.pings_per_part or default_pings_per_part(schema.bytes_per_ping, n_pings)
    made_of = scenes.digest, n_pings, per_part, system, scenes.files
    return Manifest(job.plain, *made_of, processor=processor())


def create_store(batch: Batch, report: Report = no_report) -> None:
    """Create the store, empty, as far as it does not exist; what is there of it is repaired."""
    schema, manifest, groups = batch.schema, batch.manifest, {}
    for name, sonar in batch.requests.sonars.items():
        groups[name] = SonarGroup(sonar, schema.arrays(name), schema.sonar_attributes(name))
    create_arrays(batch.folder, manifest, groups, schema.attributes(manifest))


def make_part(
    batch: Batch,
    part: int,
    set_aside: dict[int, str] | None = None,
    one_by_one: bool = False,
    report: Report = no_report,
) -> PartRecord:
    """Make a part, see `PartMaker.make`."""
    return batch.maker.make(part, set_aside, one_by_one, report)


def finalize(batch: Batch, report: Report = no_report) -> None:
    """Join the files of all parts, and write the file that says that the batch is complete."""
    requests, schema, manifest, folder = batch.requests, batch.schema, batch.manifest, batch.folder
    gather_ping_variables(requests, batch.table, manifest, folder)
    consolidate(folder)
    files = [name for output in make_outputs(requests, schema, folder) for name in output.join(manifest)]
    part_arrays = {array.name for sonar in requests.sonars for array in schema.arrays(sonar)}
    files += shared_files(folder, part_arrays)
    checksums = {name: folder.checksum(name) for name in sorted(files)}
    DoneRecord(manifest.n_parts, manifest.n_pings, checksums).save(folder)


# The steps by name, as pools and clusters run them: function (batch, *arguments, report).
STEPS = {
    "begin": begin,
    "create": create_store,
    "make": make_part,
    "try": try_pings,
    "survey": survey,
    "finalize": finalize,
}
