"""What a job would make, its size and its time, found by making a little of it."""

from __future__ import annotations

import tempfile

from sonar_gl.batch.files import Folder
from sonar_gl.batch.job import Job
from sonar_gl.batch.orders import Orders
from sonar_gl.batch.pool import Pool


def dry_run(job: Job, devices, tell) -> str:
    """What a job would make, its size and the time that it takes, by a short trial."""
    orders = Orders(job)
    with tempfile.TemporaryDirectory() as url, Pool(job.plain, url, devices, tell) as pool:
        planned = pool.ask("plan")
        planned.save(Folder(url))
        pool.ask("create")
        trial = pool.ask("probe", planned)
    n, lines = planned.n_pings, []
    for scene, run in orders.runs():
        start_s, end_s = orders[run[0]].time_s, orders[run[-1]].time_s
        lines.append(f"pings {run[0]}..{run[-1]}: scene {job.scenes[scene]}, {start_s:g} to {end_s:g} s")
    for scene, (samplings, estimates) in enumerate(zip(planned.samplings, planned.estimates, strict=True)):
        for name, sampling in samplings.items():
            sonar = orders.sonars[name]
            size = f"{sonar.n_beams} beams x {sonar.n_bins} bins"
            samples = f"{sampling['columns_per_beam'] * sonar.n_beams:.0f} x {sampling['rows']} samples"
            error = f"error thought to be below {estimates[name]:.2g}"
            lines.append(f"{name} in {job.scenes[scene]}: {size}, {samples}, {error}")
    lines.append(f"{n} pings in {planned.n_parts} parts of {planned.pings_per_part}")
    lines.append(f"size: {_amount(n * trial['ping_bytes'])} ({trial['ping_bytes'] / 1e3:.0f} kB a ping)")
    alone_s = n * trial["ping_s"]
    lines.append(
        f"time: {_duration(alone_s)} in one process ({1e3 * trial['ping_s']:.1f} ms a ping, on "
        f"{planned.gl_renderer}), {_duration(alone_s / len(devices))} at best in {len(devices)}"
    )
    return "\n".join(lines)


def _amount(size: float) -> str:
    for unit in ("kB", "MB", "GB"):
        size /= 1000
        if size < 1000:
            return f"{size:.3g} {unit}"
    return f"{size / 1000:.3g} TB"


def _duration(seconds: float) -> str:
    for unit, length in (("days", 86400), ("hours", 3600), ("minutes", 60)):
        if seconds >= 2 * length:
            return f"{seconds / length:.3g} {unit}"
    return f"{seconds:.3g} seconds"
