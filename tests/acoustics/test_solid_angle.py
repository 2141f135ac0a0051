"""Solid angles of beams, by sums over directions all around with patterns of their own."""

import math

import numpy as np
import pytest

from sonar_gl.acoustics.acoustics import Acoustics
from sonar_gl.acoustics.solid_angle import beam_solid_angles
from sonar_gl.beamform.beamformer import make_beamformer
from sonar_gl.beamform.weights import beam_weights
from sonar_gl.sonar.sampling import Sampling
from sonar_gl.sonar.sonar import Sonar
from sonar_gl.sonar.sonar_files import load_sonar
from tests.support.settings import described

UNIFORM_EDGE, HAMMING_EDGE = 0.4429464707, 0.6514909  # x of half power of sinc² x and of a Hamming array
TWO_WAY_EDGE = 0.3189166  # sinc⁴ of it is 1/2
WIDTH, HALF_HEIGHT = np.radians([3.0, 12.0])


def hamming(x):
    return (np.sinc(x) + 0.23 / 0.54 * (np.sinc(x - 1) + np.sinc(x + 1))) ** 2


def sonar_and_acoustics(**settings):
    """Return a fan of 61 beams of 3 degrees, 0.9836 degrees apart, 24 degrees high, and its acoustics."""
    return described(Sonar("s", 500e3, 61, 100, 60.0, 24.0, 3.0, 0.5, 30.0), **settings)


def sphere(n_azimuths=36_000, n_elevations=900):
    """Return directions all around: azimuth (A, 1), sine of elevation (1, E), and the solid angle of each, (1, E)."""
    azimuth = (np.arange(n_azimuths) + 0.5) / n_azimuths * 2 * np.pi - np.pi
    elevation = ((np.arange(n_elevations) + 0.5) / n_elevations - 0.5) * np.pi
    each_sr = np.diff(np.sin(np.linspace(-np.pi / 2, np.pi / 2, n_elevations + 1))) * 2 * np.pi / n_azimuths
    return azimuth[:, None], np.sin(elevation)[None], each_sr[None]


def elevation_power(sine):
    """Return the one-way pattern of an untapered array whose two-way pattern is 24 degrees wide."""
    return np.sinc(TWO_WAY_EDGE * sine / np.sin(HALF_HEIGHT)) ** 2


def test_boxes_are_boxes():
    sonar, _ = sonar_and_acoustics()
    box_sr = WIDTH * 2 * np.sin(HALF_HEIGHT)
    assert beam_solid_angles(sonar, Acoustics.ideal()) == pytest.approx((box_sr, box_sr), rel=1e-12)
    # azimuth and elevation by themselves
    part = beam_solid_angles(sonar, Acoustics.physical(beam_pattern="box"))
    _, sine, each_sr = sphere()
    share = each_sr / (2 * np.pi / 36_000)  # of the sine
    heights = [(elevation_power(sine) ** ways * share).sum() for ways in (1, 2)]
    assert part == pytest.approx([WIDTH * height for height in heights], rel=1e-5)


@pytest.mark.parametrize(("taper", "edge"), [("uniform", UNIFORM_EDGE), ("hamming", HAMMING_EDGE)])
@pytest.mark.parametrize("beam", [30, 2])
def test_upright_beams(taper, edge, beam):
    """The sum over the sphere of B(ψ) times the pattern in elevation: one way all around, two ways over the fan."""
    sonar, acoustics = sonar_and_acoustics(
        receive_taper=taper, element_error_db=-35.0, transmit_width_deg=40.0
    )
    azimuth, sine, each_sr = sphere()
    away = azimuth - sonar.azimuth_rad[beam]
    u = np.sin(away) / np.sin(WIDTH / 2)
    pattern = np.sinc(edge * u) ** 2 if taper == "uniform" else hamming(edge * u)
    pattern = np.where(np.cos(away) > 0, pattern + 10**-3.5, 0)
    receive_sr = pattern.sum() * (elevation_power(sine) * each_sr).sum()
    null = math.asin(4 / edge * math.sin(WIDTH / 2))
    in_fan = np.abs(azimuth) <= sonar.azimuth_rad[-1] + null
    echo_sr = (pattern * in_fan).sum() * (elevation_power(sine) ** 2 * each_sr).sum()
    found = beam_solid_angles(sonar, acoustics, beam)
    # beyond 75 degrees off the axis, far lobes and the floor fade out: a twelfth of the floor, which is 1.9 %
    assert found.receive_sr == pytest.approx(receive_sr, rel=2.5e-3)
    assert found.echo_sr == pytest.approx(echo_sr, rel=5e-4)  # the fan ends within a cell of 0.01 degrees


@pytest.mark.slow
@pytest.mark.parametrize("beam", [30, 2])
def test_cones_of_a_straight_array(beam):
    sonar, acoustics = sonar_and_acoustics(steered="straight", element_error_db=-35.0)
    azimuth, sine, each_sr = sphere()
    shown = np.sin(azimuth) * np.sqrt(1 - sine**2)  # sine of the cone's azimuth
    x = UNIFORM_EDGE * (shown - np.sin(sonar.azimuth_rad[beam])) / np.sin(WIDTH / 2)
    pattern = np.where(np.cos(azimuth) > 0, np.sinc(x) ** 2 + 10**-3.5, 0)
    receive_sr = (pattern * elevation_power(sine) * each_sr).sum()
    null = math.asin(math.sin(sonar.azimuth_rad[-1]) + 4 / UNIFORM_EDGE * math.sin(WIDTH / 2))
    in_fan = (np.abs(shown) <= math.sin(null)) & (np.abs(sine) <= np.sin(np.radians(89.5)))
    echo_sr = (pattern * in_fan * elevation_power(sine) ** 2 * each_sr).sum()
    found = beam_solid_angles(sonar, acoustics, beam)
    assert found == pytest.approx(
        (receive_sr, echo_sr), rel=5e-4
    )  # the table of cones, and cells at the fan's ends


@pytest.mark.parametrize("name", ["p900-45", "gemini-720im", "didson-lf"])
def test_intensities_are_normalised_by_the_solid_angle_of_the_echo(name):
    sonar, acoustics = load_sonar(name).with_range(2.0), Acoustics.physical(far_side_lobes=False)
    fan = make_beamformer(sonar, acoustics, Sampling(1, 30)).fan
    patterns = acoustics.receive_pattern(sonar), acoustics.receive_support_rad(sonar)
    weights = beam_weights(fan, *patterns, None, acoustics.two_way_elevation_pattern(sonar))
    for beam in (0, sonar.n_beams // 3, sonar.n_beams // 2):
        found = beam_solid_angles(sonar, acoustics, beam)
        assert found.echo_sr == pytest.approx(weights.width_rad[beam] * weights.height, rel=1e-4)


def test_the_water_and_multipath_do_not_matter_nor_does_the_number_of_beams():
    sonar, acoustics = sonar_and_acoustics()
    other = Acoustics.physical(water={"temperature_c": 3.0, "wind_speed_m_s": 5.0}, multipath="coherent")
    assert beam_solid_angles(sonar, other) == beam_solid_angles(sonar, acoustics)
    assert beam_solid_angles(sonar, acoustics) == beam_solid_angles(sonar, acoustics, 30)  # straight ahead
