"""The request for each ping of a job."""

from sonar_gl.batch.requests import BatchRequests


def test_each_sonar_has_noise_of_its_own_and_each_ping_other_draws(requests):
    assert len({requests.noise_seed(name) for name in requests.sonars}) == 2
    many = BatchRequests(requests.job.model_copy(update={"poses": [requests.job.poses[0] | {"n_pings": 40}]}))
    assert len({request.water.temperature_c for request in many}) == 40
