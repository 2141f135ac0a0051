"""A small batch for tests: a job of few pings, two small sonars, a wall and a box."""

from pathlib import Path

from sonar_gl.batch.folder import LOCK, Folder
from sonar_gl.batch.job import read_job
from sonar_gl.batch.manifest import Manifest
from sonar_gl.batch.parts import Batch
from sonar_gl.batch.requests import BatchRequests
from sonar_gl.batch.steps import begin, create_store, finalize, make_part
from tests.support.command_line import BODY, SONAR, WALL

BOX = BODY.format("box_1", "3 0.3 -0.3", "0.2 0.2 0.2")
FLOOR = """<model name="floor"><static>true</static><pose>0 0 -0.4 0 0 0</pose><link name="link">
<collision name="c"><geometry><plane><normal>0 0 1</normal><size>40 40</size></plane></geometry>
<laser_retro>120</laser_retro></collision></link></model>
"""
JOB = """
name = "small"
scenes = ["tank.sdf"]
seed = 5
pings_per_part = 4
tolerance = 0.05

[acoustics]
profile = "physical"
tvg_absorption_db_m = 0.3

[noise]
preset = "physical"

[[sonars]]
name = "level"
sonar = "small.toml"

[[sonars]]
name = "upright"
sonar = "small.toml"
range_m = 6.5
mount = [0.0, 0.0, 0.0, 1.5707963267948966, 0.0, 0.0]

[[poses]]
kind = "sector"
position_m = [0.0, 0.0, 0.0]
pan_rad = [-0.2, 0.2]
n_pings = {n_pings}
ping_rate_hz = 5.0
sweep_s = 1.0

[[vary.bodies]]
names = ["box_*"]
x_m = [-0.5, 0.5]
yaw_rad = [-1.0, 1.0]
there = 0.8
reflectivity = [0.2, 0.9]

[vary.water]
temperature_c = [2.0, 20.0]

[vary.noise]
ambient_db = [-80.0, -60.0]
"""
LABELS = """
[labels]
layers = ["body", "class", "elevation", "range", "incidence", "share", "shadow", "boxes"]

[labels.classes]
fixed = ["wall", "floor"]
target = ["box*"]
"""
MORE = """
[coco]
height = 100

[pictures]
formats = ["png", "npz", "mp4"]
height = 60

[ros]
image_height = 50
"""


def write_job(folder: Path, n_pings: int = 10, more: str = LABELS) -> Path:
    """Write the job file and the files that it names into a folder; return the path of the job file."""
    (folder / "tank.sdf").write_text(
        f'<sdf version="1.9"><world name="tank">{WALL}{BOX}{FLOOR}</world></sdf>'
    )
    (folder / "small.toml").write_text(SONAR)
    path = folder / "job.toml"
    path.write_text(JOB.format(n_pings=n_pings) + more)
    return path


def write_plain_job(folder: Path, n_pings: int, part: int, more: str = "") -> Path:
    """Write a job with one sonar, in which nothing varies; return the path of its file."""
    path = write_job(folder, n_pings)
    text = path.read_text().replace("pings_per_part = 4", f"pings_per_part = {part}")
    one, poses, vary = (text.index(at) for at in ('[[sonars]]\nname = "upright"', "[[poses]]", "[[vary"))
    path.write_text(text[:one] + text[poses:vary] + more)
    return path


def files_of(folder: Path) -> dict[str, bytes]:
    """Return the bytes of every file in a folder, by name, but for that by which batches lock it."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name != LOCK
    }


def open_batch(job_file, url) -> Batch:
    """Return the batch of a job in a folder."""
    return Batch(BatchRequests(read_job(job_file)), Folder(url))


def make_all(job_file, url) -> Manifest:
    """Make a complete batch in this process."""
    batch = open_batch(job_file, url)
    begin(batch).save(batch.folder)
    create_store(batch)
    for part in range(batch.manifest.n_parts):
        make_part(batch, part)
    finalize(batch)
    batch.close()
    return batch.manifest
