"""Settings whose numbers are NumPy's, as those of arrays and tables are: the same pings as from Python's numbers."""

import dataclasses

import numpy as np
import pytest
import trimesh

import sonar_gl as sg

SONAR = sg.Sonar("typed", 750e3, 32, 100, 45.0, 20.0, 1.0, 0.5, 20.0, self_noise_db=-60.0)
SCENE = sg.Scene([sg.Body("ball", trimesh.creation.icosphere(2, 0.5), sg.pose(5, 0.5))])
NOISE = sg.Noise.physical(gaussian=0.25, ambient_db=-50.0, interference_lines=2.0, looks=4)
SETTINGS = (SONAR, sg.Acoustics.physical(), sg.Water(), NOISE, sg.Sampling(4, 60), sg.Counts())
TYPES = (np.int8, np.int16, np.uint64, np.float16, np.float32, np.longdouble)


def typed(value, dtype):
    """Return a number as that of a type, where the type holds it, else itself."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return value
    if isinstance(value, int) and issubclass(dtype, np.floating):
        return value
    try:
        with np.errstate(over="ignore"):  # float16 has no 750 kHz
            out = dtype(value)
    except OverflowError:
        return value
    return out if float(out) == value else value


def with_types(settings, dtype):
    given = {field.name: getattr(settings, field.name) for field in dataclasses.fields(settings)}
    return dataclasses.replace(settings, **{name: typed(value, dtype) for name, value in given.items()})


def contents(settings, label_level_db):
    sonar, acoustics, water, noise, sampling, counts = settings
    sonar, acoustics = dataclasses.replace(sonar, counts=counts), dataclasses.replace(acoustics, water=water)
    with sg.Simulator(SCENE, sonar, acoustics, sampling) as simulator:
        ping = simulator.ping(sg.pose(), noise, labels=True, label_level_db=label_level_db)
    arrays = ping.intensity, ping.counts(), ping.body_id, sg.fan_image(ping, height=60)
    assert "np." not in repr(ping.meta)
    return [array.tobytes() for array in arrays], ping.meta


@pytest.mark.parametrize("dtype", TYPES)
def test_numbers_of_numpy_make_the_same_pings(dtype):
    """Early versions computed with int8 and float16, summed other echoes by float32, and failed by longdouble."""
    level_db = typed(-80.0, dtype)
    assert contents([with_types(one, dtype) for one in SETTINGS], level_db) == contents(SETTINGS, -80.0)


def test_true_of_numpy_is_true():
    assert sg.Acoustics(specular=np.True_) == sg.Acoustics(specular=True)
    assert repr(sg.Noise(speckle=np.True_)) == repr(sg.Noise(speckle=True))


def test_a_range_of_numpy():
    assert repr(SONAR.with_range(np.float16(30.0))) == repr(SONAR.with_range(30.0))
