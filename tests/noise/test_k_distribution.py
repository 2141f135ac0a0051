"""K-distributed texture: the gamma table, and moments of speckle times texture."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

import sonar_gl as sg
from sonar_gl.engine.pipeline import make_ping
from sonar_gl.engine.request import PingRequest
from sonar_gl.noise.k_distribution import gamma_from_exponential, multiply_by_texture
from sonar_gl.noise.noise import add_noise
from sonar_gl.noise.settings import Noise
from tests.support.even_ping import SIGMAS, correlation, even_ping


def box_of(*size_m):
    return trimesh.creation.box(size_m)


def with_texture(ping, shape):
    """Return the ping of a surface with a texture of this shape."""
    deviation = ping.intensity / np.float32(np.sqrt(shape))
    return replace(ping, texture_deviation=deviation)


@pytest.mark.parametrize("shape", [0.125, 0.5, 1.0, 2.0, 10.0, 1000.0])
def test_table_gives_gamma_variates(shape):
    """Quantiles against NumPy's gamma variates; shape 1 is the exponential itself."""
    u = (np.arange(200_000) + 0.5) / 200_000
    out = np.ones((1, len(u)), np.float32)
    deviation = np.full_like(out, shape**-0.5)
    multiply_by_texture(out, (-np.log1p(-u)).astype(np.float32)[None], deviation)
    out = out[0].astype(np.float64)
    assert out.mean() == pytest.approx(1, rel=2e-3)  # the outermost quantile stands for its whole tail
    assert out.var() * shape == pytest.approx(1, rel=0.01)
    draws = np.sort(np.random.default_rng(0).gamma(shape, 1 / shape, len(u)))
    for q in (0.1, 0.5, 0.9, 0.99):
        probability = np.searchsorted(draws, out[int(q * len(u))]) / len(u)
        assert probability == pytest.approx(q, abs=SIGMAS * np.sqrt(q * (1 - q) / len(u)))
    if shape == 1:
        # the table of this shape is a straight line: float32, of the variate, the table and its slope
        np.testing.assert_allclose(out, -np.log1p(-u), rtol=5e-7)
    assert np.isfinite(gamma_from_exponential(shape)[0]).all()


@pytest.mark.parametrize("shape", [1.0, 5.0])
def test_moments_of_the_k_distribution(shape):
    ping = with_texture(even_ping(100, 10_000, 2.0), shape)
    x = add_noise(ping, Noise(speckle=True), seed=1).intensity.astype(np.float64)
    n = x.size
    assert x.mean() == pytest.approx(1, abs=SIGMAS * np.sqrt((1 + 2 / shape) / n))
    second, fourth = (
        np.prod([1 + j / shape for j in range(m)]) * np.prod(np.arange(1, m + 1)) for m in (2, 4)
    )
    assert second - 1 == pytest.approx(1 + 2 / shape, rel=1e-14)  # contrast squared
    assert (x**2).mean() == pytest.approx(second, abs=SIGMAS * np.sqrt((fourth - second**2) / n))


def test_a_place_locked_texture_is_independent_of_the_speckle():
    """Were both of one pattern, the contrast would be √5: intensities would be squares of exponential variates."""
    ping = with_texture(even_ping(16, 256, 2.0, pose=np.eye(4)), 1.0)
    noise = Noise(speckle=True, follow_motion=True)
    x = np.array([add_noise(ping, noise, seed).intensity for seed in range(8)], np.float64)
    # the contrast of 32768 independent cells, of which the fourth moment is 576, has a standard error of 2.2 %
    assert x.std() / x.mean() == pytest.approx(np.sqrt(3), rel=0.1)


def test_texture_leaves_the_speckle_pattern():
    """A texture of contrast 1 % hardly changes the pattern, so both have the same speckle stream."""
    ping = even_ping()
    plain, textured = (
        add_noise(one, Noise(speckle=True), seed=1).intensity for one in (ping, with_texture(ping, 9e3))
    )
    assert correlation(plain, textured) == pytest.approx(1, abs=1e-3)


def test_texture_of_a_mixture_has_the_variance_of_its_parts():
    """A floor of shape 2, which returns 0.6 of each bin, beside a body without texture: 0.6² / 2 of variance."""
    ping = even_ping(100, 10_000, 2.0)
    ping = replace(ping, texture_deviation=np.full_like(ping.intensity, 0.6 / np.sqrt(2)))
    exponential = add_noise(even_ping(100, 10_000, 2.0), Noise(speckle=True), seed=3).intensity
    out = np.array(ping.intensity)
    multiply_by_texture(out, np.ascontiguousarray(exponential), ping.texture_deviation)
    # tables of two shapes are interpolated: 0.8 % of the variance; and that of a million cells has an error of 0.5 %
    assert out.var(dtype=np.float64) == pytest.approx(0.6**2 / 2, rel=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["cpu", "opengl"])
def test_texture_is_that_of_the_bodies_that_have_one(engine):
    """Before a wall with a texture stands one without: each beam sees one of them, and its contrast."""
    sonar = sg.Sonar("walls", 900e3, 32, 150, 60.0, 10.0, 1.0, 5.5, 8.5)
    shape = 1.0
    wall = sg.Body("wall", box_of(0.1, 30, 30), sg.pose(8.05, 0, 0), reflectivity=0.5, speckle_shape=shape)
    plate = sg.Body("plate", box_of(0.1, 10, 30), sg.pose(6.05, 5, 0), reflectivity=0.5)
    with sg.Simulator(sg.Scene([wall, plate]), sonar, sampling=sg.Sampling(2, 8), engine=engine) as simulator:
        pings = [simulator.ping(np.eye(4), Noise(speckle=True), seed=1, ping_number=k) for k in range(300)]
    x = np.array([ping.intensity for ping in pings], np.float64)
    assert pings[0].texture_deviation is None
    mean = x.mean(axis=0)
    bright = mean > 0.3 * mean.max()
    contrast = x.std(axis=0) / np.maximum(mean, 1e-9)
    starboard, port = contrast[2:12][bright[2:12]], contrast[20:30][bright[20:30]]
    # 300 pings: a contrast of 1 has a standard error of 6 %, the mean over some 40 cells of less than 2 %
    assert starboard.mean() == pytest.approx(np.sqrt(1 + 2 / shape), rel=0.1)
    assert port.mean() == pytest.approx(1, rel=0.05)


def test_a_shape_is_checked_and_read_from_files(tmp_path):
    box = box_of(1, 1, 1)
    with pytest.raises(sg.Error, match=r"body 'floor': speckle_shape must lie in 0\.05\.\.10000"):
        sg.Body("floor", box, speckle_shape=0)
    geometry = "<geometry><box><size>1 1 1</size></box></geometry>"
    patchy = f"<collision name='a'>{geometry}<sonar_gl:speckle_shape>2</sonar_gl:speckle_shape></collision>"
    even = f"<collision name='b'><pose>3 0 0 0 0 0</pose>{geometry}</collision>"
    path = tmp_path / "scene.sdf"
    model = f"<model name='m'><static>1</static><link name='l'>{patchy}{even}</link></model>"
    path.write_text(f"<sdf version='1.9'><world name='w'>{model}</world></sdf>")
    with pytest.warns(UserWarning):  # no laser_retro
        bodies = sg.load_scene(str(path)).bodies
    assert [(body.name, body.speckle_shape) for body in bodies] == [("m", 2.0), ("m::b", None)]


@pytest.mark.parametrize(
    "reflectivity, by_face, engine",
    [(None, False, "cpu"), ({"wall": 0.2}, True, "cpu"), (None, True, "opengl")],
)
def test_the_deviation_is_the_diffuse_echo_over_the_root_of_the_shape(reflectivity, by_face, engine):
    """Of a smooth wall with a texture: through pulse, cross-talk and motion, without its glint."""
    sonar = sg.Sonar("wall", 900e3, 32, 200, 60.0, 10.0, 1.0, 1.0, 9.0, bandwidth_hz=10e3)
    sonar = replace(sonar, cross_talk_db=-20.0, cross_talk_beams=8)
    mesh, mu = box_of(0.1, 30, 30), np.linspace(0.1, 0.9, 12) if by_face else 0.5
    wall = sg.Body("wall", mesh, sg.pose(8.05, 0, 0), mu, specular=0.3, speckle_shape=4.0)
    request = PingRequest(
        np.eye(4), noise_parts=True, velocity=(0.5, 0, 0, 0, 0, 0.1), reflectivity=reflectivity
    )
    settings = {"tolerance": 0.05, "engine": engine}
    with sg.Simulator(sg.Scene([wall]), sonar, sg.Acoustics.physical(), **settings) as simulator:
        ping = make_ping(simulator.run, request)
        plain = make_ping(simulator.run, replace(request, noise_parts=False))
    assert plain.texture_deviation is None and plain.coherent is None
    assert ping.coherent.max() > 0.1 * ping.intensity.max()
    # float32 sums of lobe and diffuse echo, of which one is subtracted
    atol = 1e-5 * ping.intensity.max()
    diffuse = ping.intensity - ping.coherent
    np.testing.assert_allclose(ping.texture_deviation, diffuse / 2.0, rtol=1e-4, atol=atol)
    assert add_noise(ping, Noise(speckle=True), 1).texture_deviation is None
