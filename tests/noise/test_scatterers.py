"""Volume reverberation of few scatterers: shot noise, by Campbell's theorem, and speckle where there are many."""

import math
from dataclasses import replace

import numpy as np
import pytest

import sonar_gl as sg
from sonar_gl.acoustics.beam_pattern import ArrayPattern, aperture_field, aperture_pattern
from sonar_gl.acoustics.pulse import PULSE_TAPERS, field_weights
from sonar_gl.core.errors import Error
from sonar_gl.noise.noise import add_noise
from sonar_gl.noise.scatterers import MANY, scatterers_of
from sonar_gl.noise.speckle import FieldCorrelation
from tests.support.even_ping import BEAM_WIDTH_RAD, BIN_M, SIGMAS, UNIFORM_WIDTH, correlation, even_ping

SPECKLE = sg.Noise(speckle=True)
LOCKED = sg.Noise(speckle=True, follow_motion=True)
FEW_M3 = 3000.0  # a tenth to several in a cell of `even_ping`
PINGS = 60


def water(density_m3=FEW_M3) -> sg.Water:
    return sg.Water(sound_speed_m_s=1500.0, volume_backscatter_db=-40.0, scatterer_density_m3=density_m3)


def ping_of_water(density_m3=FEW_M3, level=1.0, **settings) -> sg.Ping:
    """Return a ping of an even echo, all of which is the water's."""
    settings = {"volume_reverberation": True, "pose": np.eye(4)} | settings
    ping = even_ping(level=level, water=water(density_m3), **settings)
    return replace(ping, volume=ping.intensity)


def noisy(ping, noise=SPECKLE, pings=PINGS) -> np.ndarray:
    """Return (pings, B, K) float64."""
    return np.array([add_noise(ping, noise, 1, number).intensity for number in range(pings)], np.float64)


def check_mean(found, expected):
    """Compare the mean of `found` over pings with its standard error, by the pings themselves."""
    of_pings = found.reshape(len(found), -1).mean(1)
    assert of_pings.mean() == pytest.approx(
        expected, abs=SIGMAS * of_pings.std() / math.sqrt(len(of_pings) - 1)
    )


def numbers_in_cells(sonar, density_m3=FEW_M3) -> np.ndarray:
    """Return the mean number of scatterers in the volume ∫A² dψ · Δr · 2 sin φ of each bin of a box in elevation."""
    x = np.linspace(-4, 4, 80_001)
    beam_angle_rad = BEAM_WIDTH_RAD / UNIFORM_WIDTH * 8 * aperture_pattern(x).mean()  # of the support
    height = 2 * math.sin(math.radians(sonar.elevation_fov_deg) / 2)
    return density_m3 * sonar.range_m**2 * BIN_M * beam_angle_rad * height


@pytest.mark.slow
@pytest.mark.parametrize("bandwidth_hz", [pytest.param(None, marks=pytest.mark.slow), 30e3])
def test_moments_of_a_box_are_those_of_campbells_theorem(bandwidth_hz):
    """Mean 1, and mean square 2 + η: η = (∫A⁴ / ∫A²) Σ w⁴ over the number in a cell."""
    ping = ping_of_water(bandwidth_hz=bandwidth_hz, pulse=bandwidth_hz is not None, pulse_taper="uniform")
    weights = np.ones(1) if bandwidth_hz is None else field_weights(BIN_M, bandwidth_hz).astype(float)
    assert (len(weights) > 1) is (bandwidth_hz is not None)
    x = np.linspace(-4, 4, 80_001)
    fourth = (aperture_pattern(x) ** 2).mean() / aperture_pattern(x).mean()
    per_cell = numbers_in_cells(ping.sonar)
    assert 0.1 < per_cell[0] < 1 < per_cell[-1] < MANY
    # the pulse spreads the echo of the bins beside, where the number differs by a per cent
    excess = (fourth * (weights**4).sum() / per_cell).mean()
    found = noisy(ping, pings=200)
    check_mean(found, 1.0)
    check_mean(found[:, :, [0, -1]], 1.0)  # the pulse brings echoes from beyond the first and the last bin
    assert excess > 0.2
    check_mean(found**2, 2 + excess)


@pytest.mark.slow
def test_a_pattern_in_elevation_makes_echoes_unlike():
    """η holds the mean square of the two-way power, over the square of its mean."""
    ping = ping_of_water(elevation_pattern="line_array")
    top_sine = math.sin(math.radians(ping.acoustics.elevation_support_deg(ping.sonar)))
    power = ArrayPattern("line_array", math.radians(20.0), two_way_width=True).power(
        np.linspace(-top_sine, top_sine, 10_001)
    )
    power = power**2
    x = np.linspace(-4, 4, 80_001)
    fourth = (aperture_pattern(x) ** 2).mean() / aperture_pattern(x).mean()
    aperture = math.sin(math.radians(ping.sonar.elevation_fov_deg) / 2)
    per_cell = numbers_in_cells(ping.sonar) * top_sine / aperture
    found = noisy(ping, pings=200)
    check_mean(found, 1.0)
    check_mean(found**2, 2 + (fourth * (power**2).mean() / power.mean() ** 2 / per_cell).mean())


@pytest.mark.parametrize(("bin_per_cell", "excess"), [(0.25, 1.0), (0.5, 1.0), (1.0, 8 / 7)])
def test_scatterers_at_the_centres_of_bins_stand_for_those_at_all_ranges(bin_per_cell, excess):
    """By Campbell's theorem the mean square holds ∫w⁴ / (∫w²)² over range, of which Σw⁴ takes the place."""
    cells = np.linspace(-40, 40, 800_001)  # ranges in c/2B
    response = aperture_field(cells, PULSE_TAPERS["hamming"])
    power, fourth = ((response**n).sum() * 1e-4 for n in (2, 4))
    bin_m, bandwidth_hz = 0.02, 1500 / 2 / 0.02 * bin_per_cell * power  # a cell is so many c/2B long
    weights = field_weights(bin_m, bandwidth_hz, "hamming").astype(float)
    everywhere = bin_per_cell * power * fourth / power**2
    assert (weights**4).sum() / everywhere == pytest.approx(excess, rel=0.01)


@pytest.mark.slow
def test_a_single_scatterer_is_the_beam_pattern():
    """So few that most pings have none: each echo has the shape of the pattern, to its 4th null, in one bin."""
    ping = ping_of_water(density_m3=0.02, n_beams=120)
    found = noisy(ping, pings=200)
    single = [one for one in found if len(np.flatnonzero(one.any(0))) == 1]
    assert len(single) > 10
    for one in single:
        arc = one[:, one.any(0)][:, 0]
        b = int(arc.argmax())
        # three beams give the place and the height of a lobe, which the other beams must have, too
        place = np.linspace(-0.5, 0.5, 2001)[:, None] * 0.25
        near = slice(max(b - 12, 0), b + 13)
        offset_rad = ping.azimuth_rad[near] - ping.azimuth_rad[b] - np.radians(place)
        x = UNIFORM_WIDTH * offset_rad / BEAM_WIDTH_RAD
        shape = np.where(np.abs(x) < 4, aperture_pattern(x), 0)  # to the support
        height = (shape @ arc[near]) / (shape**2).sum(1)
        worst = np.abs(shape * height[:, None] - arc[near]).max(1).min()
        if 16 < b < len(arc) - 17:  # otherwise the greatest may be a side lobe of one beside the fan
            assert worst < 2e-3 * arc.max()  # places are tried in steps of an eighth of a thousandth degree


@pytest.mark.slow
def test_the_number_of_echoes_is_poisson_distributed_in_the_volume():
    ping = ping_of_water(density_m3=1.0)
    found = noisy(ping, pings=400).any(1).sum(1)  # bins with an echo, in which two are rare
    series = FieldCorrelation(tuple(ping.azimuth_rad), BEAM_WIDTH_RAD)
    scatterers = scatterers_of(1.0, ping.range_m, series, ping.sonar, ping.acoustics)
    r, margin_rad = ping.range_m, 4 * BEAM_WIDTH_RAD / UNIFORM_WIDTH
    fan_rad = np.ptp(ping.azimuth_rad) + 2 * margin_rad
    volume_m3 = (r**2 * BIN_M * fan_rad * 2 * math.sin(math.radians(10))).sum()
    assert scatterers.per_bin.sum() == pytest.approx(volume_m3)
    # a hundredth of the bins has one, so that a half per cent of the echoes share a bin; the table of beams is cut
    # where no beam lies, which hides a per cent at most
    sigma = math.sqrt(volume_m3 / len(found))
    assert found.mean() == pytest.approx(volume_m3, abs=SIGMAS * sigma + 0.02 * volume_m3)


@pytest.mark.parametrize("noise", [SPECKLE, LOCKED], ids=["fresh", "locked"])
def test_many_are_speckle(noise):
    """Exponential, and neighbouring beams correlate as sinc²."""
    ping = ping_of_water(density_m3=1e9)
    found = noisy(ping, noise)
    check_mean(found, 1.0)
    check_mean(found**2, 2.0)
    apart = UNIFORM_WIDTH * np.radians(0.25) / BEAM_WIDTH_RAD
    # some standard errors of 60 x 64 x 256 numbers, of which one in four is independent
    assert correlation(found[:, :-1], found[:, 1:]) == pytest.approx(np.sinc(apart) ** 2, abs=0.015)


@pytest.mark.slow
def test_neighbouring_beams_correlate_as_their_fields_where_there_are_some():
    """cov |s|² = |ρ|² + η(apart): the second term is that of single echoes, which two beams share."""
    ping = ping_of_water()
    apart = UNIFORM_WIDTH * np.radians(0.25) / BEAM_WIDTH_RAD
    x = np.linspace(-4, 4, 80_001)
    shared = (aperture_pattern(x) * aperture_pattern(x + apart)).mean() / aperture_pattern(x).mean()
    per_cell = numbers_in_cells(ping.sonar)
    expected = 1 + np.sinc(apart) ** 2 + (shared / per_cell).mean()
    found = noisy(ping, pings=200)
    check_mean(found[:, :-1] * found[:, 1:], expected)


def test_the_ends_of_a_full_circle_share_scatterers_as_neighbours_do():
    ping = ping_of_water(density_m3=100.0, n_beams=720, spacing_deg=0.5)
    found = noisy(ping, pings=20)
    ends, within = (correlation(found[:, a], found[:, b]) for a, b in ((0, -1), (360, 359)))
    assert within > 0.6 and ends == pytest.approx(within, abs=0.2)  # heavy tails: 0.05 from seed to seed
    check_mean(found, 1.0)


@pytest.mark.slow
def test_bins_from_where_there_are_many_in_a_cell_have_a_gaussian_field():
    ping = ping_of_water(density_m3=2e4)
    series = FieldCorrelation(tuple(ping.azimuth_rad), BEAM_WIDTH_RAD)
    scatterers = scatterers_of(2e4, ping.range_m, series, ping.sonar, ping.acoustics)
    per_cell = numbers_in_cells(ping.sonar, 2e4)
    assert 0 < scatterers.few_bins < len(per_cell)
    assert per_cell[scatterers.few_bins - 1] < MANY <= per_cell[scatterers.few_bins]
    found = noisy(ping)
    check_mean(found[:, :, : scatterers.few_bins], 1.0)
    check_mean(found[:, :, scatterers.few_bins :] ** 2, 2.0)


@pytest.mark.parametrize("noise", [SPECKLE, LOCKED], ids=["fresh", "locked"])
def test_they_are_new_in_each_ping_and_leave_the_rest_as_it_is(noise):
    ping = ping_of_water(density_m3=3.0)
    whole = replace(ping, intensity=np.full_like(ping.intensity, 2.0))  # half of it from a floor
    rest = replace(whole, intensity=whole.intensity - ping.volume, volume=None)
    found, others = (noisy(one, noise, 3) for one in (whole, rest))
    empty = noisy(ping, noise, 3) == 0
    assert 0.1 < empty.mean() < 1 and not (empty[0] == empty[1]).all()
    if noise is LOCKED:
        np.testing.assert_allclose(found[empty], others[empty], rtol=2**-22)  # of sums in another order
    assert (found[~empty] != others[~empty]).mean() > 0.99


def test_without_speckle_the_water_is_its_mean():
    ping = ping_of_water()
    noise = sg.Noise(ambient_db=-60.0)
    found = add_noise(ping, noise, 1)
    np.testing.assert_array_equal(found.intensity, add_noise(replace(ping, volume=None), noise, 1).intensity)
    assert found.volume is None


@pytest.mark.filterwarnings("ignore:no echo came back")
def test_a_ping_of_open_water_has_them():
    sonar = sg.Sonar("volume", 900e3, 24, 120, 40.0, 16.0, 2.0, 0.5, 2.5, bandwidth_hz=30e3)
    acoustics = sg.Acoustics.physical(water=water(200.0))
    with sg.Simulator(sg.Scene([]), sonar, acoustics, tolerance=0.05) as simulator:
        quiet = simulator.ping(np.eye(4))
        np.testing.assert_array_equal(quiet.volume, quiet.intensity)
        few, same, other = (simulator.ping(np.eye(4), SPECKLE, seed=seed).intensity for seed in (1, 1, 2))
        moving = simulator.ping(np.eye(4), velocity=(0, 0, 0, 0, 0, 0.5))
        np.testing.assert_array_equal(moving.volume, moving.intensity)
        many = simulator.ping(np.eye(4), water=replace(acoustics.water, scatterer_density_m3=None))
        assert many.volume is None
    np.testing.assert_array_equal(few, same)
    assert (few != other).mean() > 0.5
    # a fifth of a scatterer in a cell, by the range: the mean is a tenth of its peaks
    assert np.median(few) < 0.5 * few.mean()


def test_they_lie_at_true_ranges():
    """A sonar that assumes too fast sound shows bins at greater ranges than they have; volumes go by r² Δr."""
    right = ping_of_water()
    series = FieldCorrelation(tuple(right.azimuth_rad), BEAM_WIDTH_RAD)
    fast = replace(right.acoustics, sonar_sound_speed_m_s=1.1 * right.acoustics.water.sound_speed())
    numbers = [
        scatterers_of(FEW_M3, right.range_m, series, right.sonar, acoustics).per_bin
        for acoustics in (right.acoustics, fast)
    ]
    np.testing.assert_allclose(numbers[1], numbers[0] / 1.1**3, rtol=1e-9)


def test_a_density_needs_a_strength_and_a_number():
    with pytest.raises(Error, match=r"scatterer_density_m3 needs volume_backscatter_db \(got 5 without it"):
        sg.Water(scatterer_density_m3=5.0)
    with pytest.raises(Error, match="water: scatterer_density_m3 must lie in 1e-06"):
        sg.Water(volume_backscatter_db=-60.0, scatterer_density_m3=0.0)
    found = sg.Water.parse("volume_backscatter_db=-60,scatterer_density_m3=1e3")
    assert found.scatterer_density_m3 == 1000.0


def test_a_volume_needs_a_sonar():
    ping = replace(ping_of_water(), sonar=None)
    with pytest.raises(Error, match="must have a sonar for the volume in which its water has scatterers"):
        add_noise(ping, SPECKLE, 1)
