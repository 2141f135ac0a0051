"""Sonars and fans for tests of the geometry."""

import math

import numpy as np

import sonar_gl as sg
from sonar_gl.sonar.fan import BeamShape, Fan, make_fan
from sonar_gl.sonar.samples import NO_BODIES, SectorSamples, ViewSamples


def make_sonar(
    azimuth_fov_deg=45.0, n_beams=64, beam_width_deg=1.0, elevation_fov_deg=20.0, **more
) -> sg.Sonar:
    """Return a sonar with 100 bins from 0.5 to 30 m."""
    return sg.Sonar(
        "test", 900e3, n_beams, 100, azimuth_fov_deg, elevation_fov_deg, beam_width_deg, 0.5, 30.0, **more
    )


def box_fan(sonar) -> Fan:
    """Return the fan of a sonar whose beams are boxes."""
    return make_fan(sonar, sg.Sampling(2.0, 32), BeamShape(math.radians(sonar.beam_width_deg) / 2))


def view_of_points(fan: Fan, points) -> ViewSamples:
    """Return a view of the fan that holds nothing but bubbles, (n, 4) as of `ViewSamples`."""
    nothing = np.empty((0, 0, 4), np.float32), NO_BODIES
    windows = (SectorSamples(one.within(0, 0, 0, 0), *nothing) for one in fan.sectors)
    return ViewSamples(tuple(windows), bubbles=np.asarray(points, np.float64))
