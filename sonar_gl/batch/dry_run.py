"""A dry run: some pings of a job tell its size, its time and its hardest views."""

from __future__ import annotations

import tempfile
from collections.abc import Callable

import numpy as np

from sonar_gl.batch.folder import Folder
from sonar_gl.batch.job import Job
from sonar_gl.batch.job_warnings import job_warnings
from sonar_gl.batch.manifest import Manifest
from sonar_gl.batch.pool import Pool
from sonar_gl.batch.requests import BatchRequests
from sonar_gl.batch.survey import HardView, SeenClasses, surveyed_scenes
from sonar_gl.core.poses import pose_numbers
from sonar_gl.scene.extent import other_unit_text

# of each scene and sonar, a dry run names so many
HARDEST = 3  # views
RAREST = 10  # classes


def dry_run(job: Job, devices: list, report: Callable[[str], None]) -> str:
    """Make some pings of a job in a temporary folder, and return a text on the job's size and time."""
    requests = BatchRequests(job)
    for text in job_warnings(requests):
        report(text)
    with tempfile.TemporaryDirectory() as url, Pool(job.plain, url, devices, report, is_dry_run=True) as pool:
        manifest = pool.call("begin")
        manifest.save(Folder(url))
        pool.call("create")
        tried = pool.call("try")
        surveys = {scene: pool.call("survey", scene) for scene in surveyed_scenes(len(job.scenes))}
    n, lines = manifest.n_pings, []
    for run in requests.runs:
        first, last = run.numbers[0], run.numbers[-1]
        (start_s, _), (end_s, _) = run.at(first), run.at(last)
        lines.append(f"pings {first}..{last}: scene {job.scenes[run.scene]}, {start_s:g} to {end_s:g} s")
    if job.changes_scenes:
        for name, contents in zip(job.scenes, requests.scenes.contents, strict=True):
            z_m = contents.surface_z_m
            surface = "" if z_m is None else f"; the water's surface at z = {z_m:g} m"
            lines.append(f"scene {name}: {', '.join(contents.names)}{surface}")
    if len(surveys) < len(job.scenes):
        lines.append(
            f"what follows is of {len(surveys)} of the {len(job.scenes)} scenes, spread over the job"
        )
    for scene, views in surveys.items():
        for name, sonar in requests.sonars.items():
            size = f"{name} in {job.scenes[scene]}: {sonar.n_beams} beams x {sonar.n_bins} bins"
            lines += _views_text(size, [view for view in views if view.sonar == name], requests)
            lines += [_seen_text(one) for one in tried.seen if (one.scene, one.sonar) == (scene, name)]
    for scene, name in enumerate(job.scenes):
        if text := other_unit_text(requests.scenes[scene]):
            report(f"warning: {name}: {text}")
    parts = "1 part" if manifest.n_parts == 1 else f"{manifest.n_parts} parts of {manifest.pings_per_part}"
    files = ", each a file of the bag (a larger pings_per_part makes fewer files)"
    lines.append(f"{n} pings in {parts}{files if job.ros is not None and manifest.n_parts > 1 else ''}")
    size = _amount(n * tried.bytes_per_ping)
    lines.append(f"size: {size} ({tried.bytes_per_ping / 1e3:.0f} kB a ping)")
    one_s, processes = n * tried.seconds_per_ping, min(len(devices), manifest.n_parts)
    best_s = _busiest_pings(manifest, processes) * tried.seconds_per_ping
    lines.append(
        f"speed: {1 / tried.seconds_per_ping:.3g} pings a second in one process ({1e3 * tried.seconds_per_ping:.1f} ms "
        f"a ping, on {manifest.system.gl_renderer}; measured on this machine by "
        f"{_numbers_text(tried.numbers)}, after all was compiled)"
    )
    lines.append(
        f"time: {_duration(one_s)} for all pings in one process, {_duration(best_s)} at best in {processes}, if each "
        "has as many cores"
    )
    return "\n".join(lines)


def _numbers_text(numbers: tuple[int, ...]) -> str:
    """Return a text that names pings spread over a job.

    >>> _numbers_text((0, 9)), _numbers_text((0, 3, 5, 8, 11))
    ('pings 0, 9', '5 pings spread over the job: 0, 3, 5, .., 11')
    """
    if len(numbers) < 5:
        return f"{'pings' if len(numbers) > 1 else 'ping'} {', '.join(map(str, numbers))}"
    first = ", ".join(map(str, numbers[:3]))
    return f"{len(numbers)} pings spread over the job: {first}, .., {numbers[-1]}"


def _busiest_pings(manifest: Manifest, processes: int) -> float:
    """Return how many pings one of these processes makes at least, since a part is made by one process.

    >>> manifest = Manifest({}, "", 20, 8, None, {})
    >>> [_busiest_pings(manifest, processes) for processes in (1, 2, 3)]
    [20.0, 10.0, 8]
    """
    return max(manifest.n_pings / processes, min(manifest.n_pings, manifest.pings_per_part))


def _views_text(size: str, views: list[HardView], requests: BatchRequests) -> list[str]:
    """Return lines on the samples that the views of a sonar need, and on those that need most."""
    counts = sorted(view.n_samples for view in views)
    middle = counts[len(counts) // 2]
    lines = [f"{size}, {counts[0]} to {counts[-1]} samples a ping, median {middle}, of {len(views)} pings"]
    hardest = sorted(views, key=lambda view: -view.n_samples)[:HARDEST]
    for view in hardest if counts[-1] > counts[0] else ():
        pose = _pose_text(requests[view.number].vehicle_pose)
        why = f"body {view.body!r}" if view.body else "the whole ping"
        lines.append(
            f"  ping {view.number}, vehicle at {pose}: {view.n_samples} samples for {why}, estimated error "
            f"{view.error_estimate:.2g}"
        )
    if silent := [view for view in views if not view.has_echo]:
        some = _some_text(silent, len(views), "no echo", requests)
        lines.append(f"{some} ('sonar-gl render --pose' says why)")
    if enclosed := [view for view in views if view.around]:
        some = _some_text(enclosed, len(views), "the sonar in a body or below a floor", requests)
        lines.append(f"{some}, in or below {enclosed[0].around!r}")
    if crowded := [view for view in views if requests[view.number].unplaced]:
        some = _some_text(crowded, len(views), "a body without a clear place, which is absent", requests)
        lines.append(f"{some}, {requests[crowded[0].number].unplaced[0]!r} (clearance_m)")
    return lines


def _some_text(some: list[HardView], n_views: int, what: str, requests: BatchRequests) -> str:
    """Return how many of the pings of a sonar have something, and the first of them."""
    first, verb = some[0], "has" if len(some) == 1 else "have"
    pose = _pose_text(requests[first.number].vehicle_pose @ requests.mounts[first.sonar])
    return (
        f"  {len(some)} of these {n_views} pings {verb} {what}, such as ping {first.number}, sonar at {pose}"
    )


def _seen_text(seen: SeenClasses) -> str:
    """Return a line on how often the classes are seen.

    >>> from sonar_gl.batch.survey import SeenClass
    >>> _seen_text(SeenClasses(0, "p900_45", 16, [SeenClass("diver", 0, 0), SeenClass("box", 9, 210)]))
    '  labels of 16 pings, with the median of their bins: diver in none, box in 9 (210)'
    """
    texts = [
        f"{one.name} in {one.n_pings} ({one.median_bins})" if one.n_pings else f"{one.name} in none"
        for one in seen.classes
    ]
    more = f", and {len(texts) - RAREST} more" if len(texts) > RAREST else ""
    rarest = ", ".join(texts[:RAREST]) or "no class"
    return f"  labels of {seen.n_pings} pings, with the median of their bins: {rarest}{more}"


def _pose_text(pose: np.ndarray) -> str:
    """Return a pose as --pose takes it; 0.0 is added since -0.0 would have a sign.

    >>> at = np.eye(4)
    >>> at[:3, 3] = 451234.5, 4987654.321, -0.00001
    >>> _pose_text(at)
    "'451234.5 4987654.321 0 0 0 0'"
    """
    return repr(" ".join(f"{round(x, 4) + 0.0:.11g}" for x in pose_numbers(pose)))


def _amount(size: float) -> str:
    """Return a number of bytes in words.

    >>> _amount(999.7e6), _amount(2.5e12)
    ('1 GB', '2.5 TB')
    """
    for unit in ("kB", "MB", "GB"):
        size /= 1000
        if size < 999.5:
            return f"{size:.3g} {unit}"
    return f"{size / 1000:.3g} TB"


def _duration(seconds: float) -> str:
    for unit, length in (("days", 86400), ("hours", 3600), ("minutes", 60)):
        if seconds >= 2 * length:
            return f"{seconds / length:.3g} {unit}"
    return f"{seconds:.3g} seconds"
