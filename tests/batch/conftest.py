"""Batches and jobs that the tests of several modules read, made once in a process."""

import pytest

from sonar_gl.batch.job import read_job
from sonar_gl.batch.requests import BatchRequests
from tests.support.batch_pings import N_SMALL, pings_of
from tests.support.batches import LABELS, MORE, make_all, write_job, write_plain_job


@pytest.fixture(scope="session")
def small(tmp_path_factory):
    """A folder with the job file, and its batch in `out`."""
    folder = tmp_path_factory.mktemp("small")
    make_all(write_job(folder, N_SMALL, LABELS + MORE), folder / "out")
    return folder


@pytest.fixture(scope="session")
def requests(small):
    return BatchRequests(read_job(small / "job.toml"))


@pytest.fixture(scope="session")
def pings(small, requests):
    return pings_of(small, requests)


@pytest.fixture(scope="session")
def quiet(small, requests):
    """The pings without noise, by which boxes leave out what is faint."""
    return pings_of(small, requests, with_noise=False)


HARD = """<model name="rod"><static>true</static><pose>3.2 1.0 0.2 0.6 0 0</pose><link name="l"><collision name="c">
<geometry><cylinder><radius>0.004</radius><length>0.5</length></cylinder></geometry></collision></link></model>"""


@pytest.fixture(scope="session")
def hard(tmp_path_factory):
    """The job file of a batch with a thin rod that some of its pings see."""
    folder = tmp_path_factory.mktemp("hard")
    path = write_plain_job(folder, 8, 2)
    scene = folder / "tank.sdf"
    scene.write_text(scene.read_text().replace("</world>", f"{HARD}</world>"))
    text = path.read_text().replace("pan_rad = [-0.2, 0.2]", "pan_rad = [-1.5, 0.6]")
    text = text.replace("tolerance = 0.05", "tolerance = 0.01")
    # a box ends before the wall's edge, which takes more samples than the rod in the skirts of a line array
    path.write_text(text.replace('"physical"\ntvg', '"physical"\nelevation_pattern = "box"\ntvg'))
    return path
