"""Drivers compute the reciprocal in gl_FragCoord.w, from which hosts have 1/x, to some units in the last place."""

import numpy as np
import pytest

import sonar_gl as sg
from sonar_gl import embed
from sonar_gl.embed import sensor as sensors
from tests.support import gl_host
from tests.support.noisy_shaders import noisy_shaders

ULPS = 8  # a sloppy reciprocal: OpenGL demands 2.5 of division, and w is the reciprocal of an interpolated reciprocal
# 8 units are 5 µm at 10 m: an even footprint of a bin's length (8 mm) loses 6e-4 of its echo to the next bin or gains
# as much, and a bin has several dozens of footprints, whose noise is independent: 6e-4 / sqrt(36).
ECHO_BOUND = 1e-4
# A slope has the noise of two lanes over the spacing of the samples (5 mrad and less here): 7e-7 / 5e-3 = 1.4e-4 rad
# for one sample. A bin where two planes meet mixes their angles by the footprints' shares. Where noise decides whether
# the planes count as one (SAME in borders.py), the border between them shifts by half a sample at most: by a hundredth
# of the angle between them in a bin of some dozens of footprints, in few bins of a scene.
INCIDENCE_BOUND_RAD, WORST_RAD, SHARE_BEYOND = 5e-3, 0.02, 1e-4
pytestmark = pytest.mark.usefixtures("context")


def labelled_ping(scene, sampling):
    """Return a labelled ping of a scene whose sectors a host draws."""
    host = gl_host.Program(scene)
    with embed.Sensor(sg.load_sonar("p900-45"), sampling=sampling) as sensor:
        for sector in sensor.sectors(scene.sonar_pose):
            with sector:
                host.draw("sonar", sector.view, sector.projection, sector.lattice, lobes=True)
        return sensor.finish(labels=True)


@pytest.mark.parametrize(
    "name, sampling",
    [("pylon", sg.Sampling(0.6, 68)), pytest.param("diver", sg.Sampling(1.2, 136), marks=pytest.mark.slow)],
)
def test_noise_of_8_units_in_the_last_place_leaves_echo_and_labels(tmp_path, monkeypatch, name, sampling):
    scene = sg.load_scene(name)
    expected = labelled_ping(scene, sampling)
    monkeypatch.setattr(sensors, "data_folder", lambda _: noisy_shaders(tmp_path, ULPS))
    got = labelled_ping(scene, sampling)
    difference = np.abs(got.intensity - expected.intensity).sum() / expected.intensity.sum()
    assert 0 < difference < ECHO_BOUND
    assert (got.body_id != expected.body_id).sum() <= 1  # of two bodies with an equal echo
    has_body = (expected.body_id > 0) & (got.body_id == expected.body_id)
    assert has_body.sum() > 10_000
    error_rad = np.abs(got.incidence_rad - expected.incidence_rad)[has_body]
    assert error_rad.max() < WORST_RAD
    assert (error_rad > INCIDENCE_BOUND_RAD).mean() < SHARE_BEYOND
