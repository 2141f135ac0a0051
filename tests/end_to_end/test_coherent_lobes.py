"""Specular lobes under speckle: which part of the echo they are, and that a smooth face returns a steady one."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

import sonar_gl as sg
from sonar_gl.engine.pipeline import make_ping
from sonar_gl.engine.request import PingRequest
from sonar_gl.noise.noise import add_noise
from tests.support.even_ping import SIGMAS

SONAR = sg.Sonar("test", 900e3, 64, 200, 32.0, 20.0, 1.0, 0.5, 10.0)
SAMPLING = sg.Sampling(3, 200)
PLATE = sg.Body("plate", trimesh.creation.box((0.02, 1.0, 1.0)), sg.pose(5.0), "steel")
FLOOR = sg.Body("floor", trimesh.creation.box((40, 40, 0.2)), sg.pose(z=-1.6), "sand")
BALL = sg.Body("ball", trimesh.creation.icosphere(3, 0.3), sg.pose(3.5, 0.7, -0.4), 0.5)
SCENE = sg.Scene([FLOOR, PLATE, BALL])
SPECKLE, LOCKED = sg.Noise(speckle=True), sg.Noise(speckle=True, follow_motion=True)
PINGS = 200


def coherent(request, engine=None, acoustics=None, scene=SCENE):
    """Return the ping of a request that keeps the lobes' part."""
    acoustics = acoustics or sg.Acoustics.physical()
    with sg.Simulator(scene, SONAR, acoustics, SAMPLING, engine=engine) as simulator:
        return make_ping(simulator.run, replace(request, noise_parts=True))


@pytest.mark.parametrize(
    "engine, labels, pulse", [("cpu", False, True), ("cpu", True, False), ("opengl", True, True)]
)
def test_the_coherent_part_is_what_lobes_add(engine, labels, pulse):
    """Beside a ping without lobes, with the same samples; labels and shadows draw further views between."""
    request = PingRequest(sg.pose(), labels=labels, background=("floor",) if labels else None)
    acoustics = sg.Acoustics.physical(pulse=pulse)
    found = coherent(request, engine, acoustics)
    with sg.Simulator(SCENE, SONAR, replace(acoustics, specular=False), SAMPLING, engine=engine) as simulator:
        diffuse = simulator.ping(sg.pose(), labels=labels, background=["floor"] if labels else None)
    added = found.intensity.astype(np.float64) - diffuse.intensity
    # sums in float32, of echoes up to the peak; rows are joined in one of the views and not in the other
    np.testing.assert_allclose(found.coherent, added, rtol=1e-3, atol=1e-4 * found.intensity.max())
    assert found.coherent.sum() > 0.1 * found.intensity.sum()
    if labels:
        assert (found.shadow == diffuse.shadow).all()


@pytest.mark.parametrize(
    ("acoustics", "scene"),
    [
        (sg.Acoustics.physical(specular=False), SCENE),
        (sg.Acoustics.physical(), sg.Scene([FLOOR, BALL])),
    ],
)
def test_no_such_part_without_lobes(acoustics, scene):
    assert coherent(PingRequest(sg.pose()), acoustics=acoustics, scene=scene).coherent is None


def test_an_absent_body_has_no_lobe():
    assert coherent(PingRequest(sg.pose(), bodies={"plate": None})).coherent is None


def test_motion_moves_both_parts_alike():
    request = PingRequest(sg.pose(), velocity=[2.0, 1.0, 0, 0, 0, 0.5])
    polished = sg.Scene([replace(PLATE, reflectivity=0.0, material=None, specular=0.8)])
    found = coherent(request, scene=polished)
    np.testing.assert_array_equal(found.coherent, found.intensity)


@pytest.mark.parametrize(
    "noise, sampling",
    [
        pytest.param(SPECKLE, SAMPLING, id="fresh"),
        pytest.param(LOCKED, None, id="locked, by tolerance"),
        pytest.param(SPECKLE, None, id="fresh, by tolerance", marks=pytest.mark.slow),
        pytest.param(LOCKED, SAMPLING, id="locked", marks=pytest.mark.slow),
    ],
)
def test_sequences_and_batches_give_the_same_bytes(noise, sampling):
    """Of single pings, of sequences, and of pings whose noise is added later, as a batch does."""
    poses = [sg.pose(x) for x in (0.0, 0.1, 0.2, 0.3, 0.4)]
    with sg.Simulator(SCENE, SONAR, sampling=sampling, tolerance=0.05) as simulator:
        if sampling is None:
            simulator.plan(poses)
        single = [simulator.ping(pose, noise, 3, ping_number=n) for n, pose in enumerate(poses)]
        sequence = list(simulator.pings(poses, noise, 3))
        run = simulator.run
        later = [
            add_noise(make_ping(run, PingRequest(pose, noise_parts=True)), noise, 3, n)
            for n, pose in enumerate(poses)
        ]
    for one, other, third in zip(single, sequence, later, strict=True):
        assert one.intensity.tobytes() == other.intensity.tobytes() == third.intensity.tobytes()
        assert one.coherent is None


def peak_levels_db(noise, scene) -> tuple[np.ndarray, float]:
    """Return (PINGS,) levels of the bin that is brightest without noise, and the diffuse part of its echo."""
    with sg.Simulator(scene, SONAR, sampling=SAMPLING) as simulator:
        whole = make_ping(simulator.run, PingRequest(sg.pose(), noise_parts=True))
        at = np.unravel_index(whole.intensity.argmax(), whole.intensity.shape)
        pings = [simulator.ping(sg.pose(), noise, 1, ping_number=n).intensity[at] for n in range(PINGS)]
    return 10 * np.log10(np.array(pings, np.float64)), 1 - whole.coherent[at] / whole.intensity[at]


@pytest.mark.slow
def test_a_plate_face_on_is_steady():
    """Noise 30 dB below the plate: √2N of the amplitude, 0.19 dB; all of it speckled would vary by 5.6 dB.

    The standard error of a standard deviation over 200 pings is 5 %.
    """
    with sg.Simulator(SCENE, SONAR, sampling=SAMPLING) as simulator:
        ping = simulator.ping(sg.pose())
    beam, bin_ = np.unravel_index(ping.intensity.argmax(), ping.intensity.shape)
    tvg_db = 10 * np.log10(ping.acoustics.tvg(ping.range_m, SONAR)[bin_])
    level_db = 10 * np.log10(ping.intensity[beam, bin_]) - 30 - tvg_db
    noise = replace(sg.Noise.physical(), self_noise=False, ambient_db=float(level_db))
    levels_db, _ = peak_levels_db(noise, SCENE)
    assert levels_db.std() < 0.5
    assert levels_db.std() == pytest.approx(10 / np.log(10) * np.sqrt(2e-3), rel=SIGMAS * 0.05)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("diffuse", "below_db"), [pytest.param(None, None, marks=pytest.mark.slow), (0.002, 0.5)]
)
def test_a_plate_speckles_as_its_roughness_tells(diffuse, below_db):
    """With new speckle in each ping: √(2 D/C) of the amplitude, D the diffuse part. Steel's is 19 dB below its lobe."""
    plate = (
        PLATE if diffuse is None else replace(PLATE, reflectivity=diffuse, specular=0.8, roughness_rad=0.1)
    )
    levels_db, part = peak_levels_db(SPECKLE, sg.Scene([plate]))
    rice_db = 10 / np.log(10) * np.sqrt(2 * part)
    assert levels_db.std() == pytest.approx(rice_db, rel=SIGMAS * 0.05)
    assert 0 < rice_db < (below_db or 0.75)


@pytest.mark.slow
def test_the_mean_of_many_pings_is_the_echo():
    """Over seeds: the standard error of each bin is its own spread over √n."""
    with sg.Simulator(SCENE, SONAR, sampling=SAMPLING) as simulator:
        whole = make_ping(simulator.run, PingRequest(sg.pose(), noise_parts=True))
    mean, n = np.zeros(whole.intensity.shape), 400
    for number in range(n):
        mean += add_noise(whole, SPECKLE, 1, number).intensity / n
    diffuse = whole.intensity - whole.coherent.astype(np.float64)
    variance = 2 * whole.coherent * diffuse + diffuse**2
    seen = whole.intensity > 1e-6 * whole.intensity.max()
    off = (mean - whole.intensity)[seen] / np.sqrt(variance[seen] / n)
    # means of 400 are nearly normal: none of 12 800 bins is 6 standard errors off
    assert np.abs(off).max() < 6
    assert off.std() == pytest.approx(1, abs=0.1)
