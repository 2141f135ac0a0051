"""Sonars, water and noise of a job."""

from dataclasses import replace

import numpy as np

import sonar_gl as sg
from sonar_gl.batch.job import Job, read_job
from sonar_gl.batch.requests import BatchRequests
from tests.support.batches import write_job, write_plain_job


def test_a_preset_of_noise_with_settings_that_need_it(tmp_path):
    """The number of looks needs speckle, which the preset has."""
    path = write_job(tmp_path, 2, "")
    path.write_text(path.read_text().replace('preset = "physical"', 'preset = "physical"\nlooks = 2'))
    assert BatchRequests(read_job(path)).noise == replace(sg.Noise.physical(), looks=2)


def test_the_water_of_a_job_is_that_of_all_pings_but_for_what_varies(tmp_path):
    path = write_job(tmp_path, 2, "")
    path.write_text(path.read_text().replace("[noise]", "[water]\nsalinity_psu = 8.0\nph = 7.9\n[noise]"))
    requests, base = BatchRequests(read_job(path)), sg.Water(salinity_psu=8.0, ph=7.9)
    assert requests.acoustics == sg.Acoustics.physical(tvg_absorption_db_m=0.3, water=base)
    waters = [requests[number].water for number in range(2)]
    assert [replace(water, temperature_c=base.temperature_c) for water in waters] == [base, base]
    assert len({base, *waters}) == 3


def test_sonars_have_the_mounts_ranges_and_bins_of_the_job(tmp_path):
    """Of 80 bins from 0.5 to 8.5 m: another range keeps their length, unless their number is given, too."""
    path = write_job(tmp_path, 2, "")
    tables = [
        {"name": "plain", "sonar": "small.toml", "mount": [0.1, -0.2, 0.3, 0.4, -0.5, 0.6]},
        {"name": "near", "sonar": "small.toml", "range_m": 6.5},
        {"name": "fine", "sonar": "small.toml", "bins": 160},
        {"name": "both", "sonar": "small.toml", "range_m": 6.5, "bins": 30},
    ]
    requests = BatchRequests(Job(**read_job(path).plain | {"sonars": tables}))
    np.testing.assert_array_equal(requests.mounts["plain"], sg.pose(0.1, -0.2, 0.3, 0.4, -0.5, 0.6))
    assert all((requests.mounts[name] == np.eye(4)).all() for name in ("near", "fine", "both"))
    found = {name: (sonar.range_max_m, sonar.n_bins) for name, sonar in requests.sonars.items()}
    assert found == {"plain": (8.5, 80), "near": (6.5, 60), "fine": (8.5, 160), "both": (6.5, 30)}
    vehicle, request = requests[1].vehicle_pose, requests[1]
    np.testing.assert_array_equal(
        request.for_sonar(requests.mounts["plain"]).pose, vehicle @ requests.mounts["plain"]
    )


def test_changes_of_a_sonar_go_with_a_file_beside_the_job(tmp_path, monkeypatch):
    monkeypatch.chdir("/")
    path = write_plain_job(tmp_path, 2, 2)
    text = path.read_text()
    assert 'sonar = "small.toml"' in text
    path.write_text(text.replace("small.toml", "small.toml,receive_taper=hamming, n_bins=7"))
    job = read_job(path)
    (sonar,) = BatchRequests(job).sonars.values()
    assert sonar == replace(sg.load_sonar(tmp_path / "small.toml"), receive_taper="hamming", n_bins=7)
    sheet, digest = tmp_path / "small.toml", job.digest
    sheet.write_text(sheet.read_text() + "# another one\n")
    assert read_job(path).digest != digest
