"""Receiver noise: levels, the TVG, its sum with echoes; and interference from other sonars."""

import math
import re
from dataclasses import replace

import numpy as np
import pytest

from sonar_gl.acoustics.acoustics import Acoustics
from sonar_gl.acoustics.water import Water
from sonar_gl.core.errors import Error
from sonar_gl.noise.noise import add_noise
from sonar_gl.noise.receiver import absolute_levels, add_interference, ambient_noise_db, thermal_noise_db
from sonar_gl.noise.settings import Noise
from sonar_gl.noise.speckle import FieldCorrelation
from sonar_gl.sonar.sonar import Sonar
from tests.support.even_ping import FREQUENCY_HZ, SIGMAS, correlation, even_ping


def noisy(noise, ping) -> np.ndarray:
    return add_noise(ping, noise, seed=1).intensity.astype(np.float64)


def test_thermal_noise_level():
    assert thermal_noise_db(1e3) == -15 and thermal_noise_db(900e3) == pytest.approx(44.085, abs=1e-3)
    # twice the bandwidth is 3.01 dB more, a source louder by 1 dB is 1 dB less
    first, second = ambient_noise_db(900e3, 30e3, 205.0), ambient_noise_db(900e3, 60e3, 206.0)
    assert second - first == pytest.approx(2.0103, abs=1e-4)
    # twice the solid angle of the receive pattern lets in twice as much
    wide = ambient_noise_db(900e3, 30e3, 205.0, receive_per_echo=2.0)
    assert wide - first == pytest.approx(10 * np.log10(2), abs=1e-9)


BY_HAND = Sonar(
    "s",
    500e3,
    64,
    100,
    60.0,
    20.0,
    1.0,
    0.5,
    30.0,
    bandwidth_hz=100e3,
    source_level_db=210.0,
    self_noise_db=-80.0,
)


def test_absolute_levels_of_boxes_by_hand():
    """A beam of 1° x 20° at 500 kHz, SL 210 dB, 100 kHz of bandwidth: the active sonar equation, term by term."""
    levels = absolute_levels(BY_HAND, Acoustics.ideal())
    beam_sr = np.radians(1.0) * 2 * np.sin(np.radians(10.0))
    assert levels.source_level_db == 210 and levels.bandwidth_hz == 100e3
    assert levels.directivity_index_db == pytest.approx(10 * np.log10(4 * np.pi / beam_sr), abs=1e-9)
    # Lambert's lossless surface: 1/π per steradian, over the area Ω that the beam cuts out at 1 m
    assert levels.echo_level_db == pytest.approx(210 + 10 * np.log10(1 / np.pi * beam_sr), abs=1e-9)
    assert levels.thermal_noise_level_db == pytest.approx(-15 + 20 * np.log10(500) + 50, abs=1e-12)
    received_db = levels.thermal_noise_level_db - levels.directivity_index_db
    assert levels.thermal_noise_db == pytest.approx(received_db - levels.echo_level_db, abs=1e-9)
    assert levels.self_noise_level_db == pytest.approx(levels.echo_level_db - 80, abs=1e-12)


def test_noise_is_received_one_way_and_echo_two_ways():
    """Line arrays: DI is that of the receive pattern, the echo's level that of the two-way pattern.

    Both solid angles are sums of sinc² in azimuth and sinc², or sinc⁴, in elevation, whose −3 dB width is two-way.
    """
    levels = absolute_levels(BY_HAND, Acoustics.physical())
    azimuth, elevation = (np.linspace(-a, a, 200_001) for a in (np.pi / 2, np.pi / 2))
    across = np.sinc(0.4429464707 * np.sin(azimuth) / np.sin(np.radians(0.5))) ** 2
    upright = np.sinc(0.3189166 * np.sin(elevation) / np.sin(np.radians(10.0))) ** 2
    width = across.mean() * np.pi
    one_way_sr, two_way_sr = (width * (upright**ways * np.cos(elevation)).mean() * np.pi for ways in (1, 2))
    assert one_way_sr / two_way_sr > 1.4  # 1.5 dB
    # what lies beyond 75 degrees off the axis fades out, and the echo ends with the fan: 0.2 % of the side lobes
    assert levels.directivity_index_db == pytest.approx(10 * np.log10(4 * np.pi / one_way_sr), abs=0.02)
    assert levels.echo_level_db == pytest.approx(210 + 10 * np.log10(two_way_sr / np.pi), abs=0.02)
    received_db = levels.thermal_noise_level_db - levels.directivity_index_db
    assert levels.thermal_noise_db == pytest.approx(received_db - levels.echo_level_db, abs=1e-9)


def test_a_bandwidth_that_is_not_stated_follows_from_the_bins_for_levels_too():
    """A resolution cell, c/2B (1 + 2 (0.23/0.54)²) of Hamming's taper, is as long as a bin at the water's speed."""
    acoustics = replace(Acoustics.ideal(), water=Water(sound_speed_m_s=1450.0))
    cell_m = (30.0 - 0.5) / 100
    expected_hz = 1450.0 / (2 * cell_m) * (1 + 2 * (0.23 / 0.54) ** 2)
    levels = absolute_levels(replace(BY_HAND, bandwidth_hz=None), acoustics)
    assert levels.bandwidth_hz == pytest.approx(expected_hz, rel=1e-12)


def test_beams_that_broaden_aside_have_levels_of_their_own():
    """A straight array's beam at 29.5 degrees is 1/cos of it as wide: its echo is by as much stronger."""
    straight = replace(BY_HAND, steered="straight")
    ahead, aside = (
        absolute_levels(straight, Acoustics.physical(conical_beams=False, far_side_lobes=False), beam)
        for beam in (None, 0)
    )
    louder_db = -10 * np.log10(np.cos(straight.azimuth_rad[0]))
    # all beams end as far aside as the outermost one: the side lobes there are 0.5 % of the others' energy, 0.02 dB
    assert aside.echo_level_db - ahead.echo_level_db == pytest.approx(louder_db, abs=0.03)
    assert ahead.directivity_index_db - aside.directivity_index_db == pytest.approx(louder_db, abs=0.03)


def test_thermal_noise_has_the_level_that_follows_from_the_sonar():
    ping = even_ping(200, 1000, 2.0, level=0.0, source_level_db=180.0, bandwidth_hz=100e3)
    wanted = 10 ** (absolute_levels(ping.sonar, ping.acoustics).thermal_noise_db / 10)
    assert noisy(Noise(thermal_noise=True), ping).mean() == pytest.approx(wanted, rel=SIGMAS / np.sqrt(2e5))
    arrays = {"beam_pattern": "line_array", "elevation_pattern": "line_array", "source_level_db": 180.0}
    of_arrays = even_ping(200, 1000, 2.0, level=0.0, bandwidth_hz=100e3, **arrays)
    more = 10 ** (absolute_levels(of_arrays.sonar, of_arrays.acoustics).thermal_noise_db / 10)
    assert more > 1.4 * wanted  # as the receive pattern is wider than the two-way one, by 1.5 dB
    assert noisy(Noise(thermal_noise=True), of_arrays).mean() == pytest.approx(
        more, rel=SIGMAS / np.sqrt(2e5)
    )
    both = noisy(Noise(thermal_noise=True, ambient_db=10 * np.log10(wanted)), ping)
    assert both.mean() == pytest.approx(2 * wanted, rel=SIGMAS / np.sqrt(2e5))


@pytest.mark.parametrize(
    ("noise", "lacks", "message"),
    [
        (Noise(thermal_noise=True), {}, "sonar 'even': source_level_db must be known for absolute levels"),
        (Noise(self_noise=True), {"sonar": None}, "noise: the ping must have a sonar for the level of its"),
        (Noise(thermal_noise=True), {"acoustics": None}, "noise: the ping must have its acoustics for the"),
    ],
)
def test_levels_need_what_they_follow_from(noise, lacks, message):
    with pytest.raises(Error, match=f"^{re.escape(message)}"):
        add_noise(replace(even_ping(), **lacks), noise, 0)


@pytest.mark.parametrize("speckle", [True, False])
def test_noise_rises_with_the_tvg(speckle):
    acoustics = Acoustics.physical(tvg_k=30.0)
    ping = even_ping(200, 4000, 2.0, level=0.0, self_noise_db=-30.0, **acoustics.meta())
    r = ping.range_m
    expected = 2e-3 * r**3 * 10 ** (2 * acoustics.water.absorption(FREQUENCY_HZ) * r / 10)
    assert expected[-1] / expected[0] > 1e7  # from 1 to 51 m
    x = noisy(Noise(speckle=speckle, self_noise=True, ambient_db=-30.0), ping) / expected
    assert x.mean() == pytest.approx(1, abs=SIGMAS / np.sqrt(x.size))
    assert x.std() == pytest.approx(1, abs=SIGMAS * np.sqrt(2 / x.size))
    assert x[:, :400].mean() == pytest.approx(1, abs=SIGMAS / np.sqrt(200 * 400))


@pytest.mark.parametrize("law", ["constant", "printed", "inverse"])
def test_other_range_laws_have_no_tvg(law):
    ping = even_ping(200, 1000, 2.0, level=0.0, **Acoustics.physical(range_law=law).meta())
    x = noisy(Noise(ambient_db=-20.0), ping)
    for bins in (slice(0, 500), slice(500, None)):
        assert x[:, bins].mean() == pytest.approx(0.01, rel=SIGMAS / np.sqrt(1e5))


def test_unknown_acoustics_have_no_tvg():
    noise, ping = Noise(ambient_db=-20.0), even_ping(100, 1000, 3.0, level=0.0)
    assert (noisy(noise, replace(ping, acoustics=None)) == noisy(noise, ping)).all()


def test_a_tvg_needs_the_sonar():
    ping = replace(even_ping(**Acoustics.physical().meta()), sonar=None)
    with pytest.raises(Error) as caught:
        add_noise(ping, Noise(ambient_db=-20.0), 0)
    assert str(caught.value) == (
        "noise: the ping must have a sonar for the absorption that its TVG assumes "
        "(got None; pings of a Simulator have one)"
    )


@pytest.mark.parametrize("level", [1.0, 0.09])
def test_echo_and_noise_add_as_fields(level):
    """Without speckle the amplitude is Rician: echo E and noise N give mean E + N, variance N² + 2 E N."""
    ping, mean = even_ping(100, 4000, 2.0, level=level), level + 0.1
    x, variance = noisy(Noise(ambient_db=-10.0), ping), 0.01 + 0.2 * level
    assert x.mean() == pytest.approx(mean, abs=SIGMAS * np.sqrt(variance / x.size))
    # the variance's own error is that of an exponential variate, or less
    assert x.var() == pytest.approx(variance, rel=SIGMAS * np.sqrt(8 / x.size))
    speckled = noisy(Noise(speckle=True, ambient_db=-10.0), ping)
    assert speckled.mean() == pytest.approx(mean, rel=SIGMAS / np.sqrt(x.size))
    assert speckled.std() == pytest.approx(mean, rel=SIGMAS * np.sqrt(2 / x.size))


@pytest.mark.parametrize(
    "noise", [Noise(ambient_db=0.0), Noise(speckle=True, follow_motion=True, ambient_db=0.0)]
)
def test_noise_correlates_between_beams_as_speckle_does(noise):
    x = noisy(noise, even_ping(64, 4000, 0.5, level=0.0, pose=np.eye(4)))
    assert correlation(x[1:], x[:-1]) == pytest.approx(0.5, abs=SIGMAS * 2 / np.sqrt(x.size / 2))


def test_interference():
    noise = Noise(interference_lines=3.0, interference_db=-20.0)
    ping = even_ping(64, 2000, 0.5, level=0.0)
    counts, brightest = [], []
    for number in range(100):
        x = add_noise(ping, noise, 0, number).intensity
        on = (x > 0).any(0)
        # every beam receives it, if only through side lobes
        assert (x[:, on] >= 0.01 * 10**-3.5 * (1 - 1e-6)).all() and not x[:, ~on].any()
        counts.append(np.count_nonzero(on))
        brightest.extend(x.max(0)[on].tolist())
    # 100 µs are 6 bins; pulses that overlap count once, those at the ends of the range in part
    assert np.mean(counts) == pytest.approx(18, abs=SIGMAS * 6 * np.sqrt(3 / 100) + 0.2)
    # at most half a spacing off the axis of a beam twice as wide: −0.7 dB
    assert np.median(brightest) == pytest.approx(0.01, rel=0.2) and min(brightest) > 0.008
    first, second = (add_noise(ping, noise, 5, 3).intensity.tobytes() for _ in range(2))
    assert first == second


def test_interference_rises_with_the_tvg():
    """Of the same pulses."""
    noise, laws = Noise(interference_lines=20.0, interference_db=-20.0), ("sonar_equation", "constant")
    rising, even = (
        noisy(noise, even_ping(8, 400, 0.5, level=0.0, range_law=law, tvg_k=30.0)) for law in laws
    )
    r, is_on = even_ping(n_bins=400).range_m, even > 0
    expected = r**3 * 10 ** (2 * Acoustics.ideal().water.absorption(FREQUENCY_HZ) * r / 10)
    np.testing.assert_allclose(rising[is_on], (even * expected)[is_on], rtol=1e-5)  # float32
    assert is_on.any(axis=0).sum() > 60 and not rising[~is_on].any()


@pytest.mark.slow
def test_interference_comes_evenly_from_the_fan_and_over_the_range():
    """A pulse that began before the first bin, or goes on after the last one, is received in part."""
    ping, noise = even_ping(64, 40, 0.5, level=0.0), Noise(interference_lines=50.0, interference_db=0.0)
    x = sum(add_noise(ping, noise, 0, number).intensity.astype(np.float64) for number in range(200))
    by_bin, by_beam = x.sum(axis=0) / x.sum(axis=0).mean(), x.sum(axis=1) / x.sum(axis=1).mean()
    # 10 000 pulses of 6 bins that begin in one of 45: each bin has 1330 of them
    np.testing.assert_allclose(by_bin, 1, atol=SIGMAS / np.sqrt(1330))
    # a beam receives those of 1 degree of 32, about 310; both ends receive from one side alone
    np.testing.assert_allclose(by_beam[4:-4], by_beam[4:-4].mean(), atol=SIGMAS / np.sqrt(310))


@pytest.mark.parametrize(("water_m_s", "assumed_m_s", "bins"), [(1400.0, 1600.0, 16), (1600.0, 1400.0, 14)])
def test_the_bins_of_an_interfering_pulse_last_as_long_as_the_sonar_takes_them_to(
    water_m_s, assumed_m_s, bins
):
    """100 µs, of bins of 5 mm that last twice that over the speed that the sonar assumes."""
    sonar = {"n_beams": 8, "n_bins": 400, "level": 0.0, "spacing_deg": 0.5}
    ping = even_ping(**sonar, water=Water(sound_speed_m_s=water_m_s), sonar_sound_speed_m_s=assumed_m_s)
    finer = replace(ping.sonar, range_max_m=ping.sonar.range_min_m + 400 * 0.005)
    ping = replace(ping, sonar=finer, range_m=finer.range_m)
    noise, found = Noise(interference_lines=0.2, interference_db=0.0), []
    for number in range(60):
        on = (add_noise(ping, noise, 0, number).intensity > 0).any(0).astype(int)
        edges = np.flatnonzero(np.diff(np.concatenate([[0], on, [0]])))
        found += [end - begin for begin, end in zip(edges[::2], edges[1::2], strict=True)]
    assert np.median(found) == bins  # pulses at the ends of the range, or upon each other, are few


@pytest.mark.slow
def test_interference_goes_on_over_the_seam_of_a_full_circle():
    """Beams of 10 degrees, 2 degrees apart: one a spacing from the brightest one receives at least half as much."""
    ping = even_ping(180, 20, 2.0, level=0.0, beam_width_deg=10.0)
    noise = Noise(interference_lines=1.0, interference_db=0.0)
    pulses = np.array([add_noise(ping, noise, 0, number).intensity.max(axis=1) for number in range(800)])
    at_an_end = pulses[pulses.any(1) & np.isin(pulses.argmax(1), (0, 179))]
    assert len(at_an_end) and (at_an_end[:, [0, -1]] > 0.5).all()


@pytest.mark.filterwarnings("ignore:.* if it is in dB:UserWarning")
@pytest.mark.parametrize(
    "amounts",
    [
        {"ambient_db": 100.0},
        {"speckle": True, "ambient_db": 100.0, "interference_lines": 9, "interference_db": 100},
        {"self_noise": True},  # the ring-down alone: without it the noise of the receiver is cut off, too
    ],
)
def test_loud_noise_stays_finite(amounts):
    acoustics = Acoustics.physical(tvg_k=60.0, tvg_absorption_db_m=1e5).meta()
    ping = even_ping(16, 64, self_noise_db=-300.0, ring_down_db=300.0, ring_down_decay_db_m=0.1, **acoustics)
    x = add_noise(ping, Noise(**amounts), 0).intensity
    assert np.isfinite(x).all() and x.max() > 1e25


class OnePulse:
    """In place of a generator: one pulse, from bin 5 on, a quarter of the fan from starboard."""

    def poisson(self, _mean):
        return 1

    def integers(self, _low, _past):
        return 5

    def random(self):
        return 0.25


def uniform(x):
    return np.sinc(x)


def hamming(x):
    return np.sinc(x) + 0.23 / 0.54 * (np.sinc(x - 1) + np.sinc(x + 1))


@pytest.mark.parametrize(
    ("field", "series", "half_power", "width_deg"),
    [
        (uniform, (), 0.442946470, 2.0),
        (hamming, (0.23 / 0.54,), 0.651490863, 2.0),
        (uniform, (), 0.442946470, None),
    ],
)
@pytest.mark.parametrize("fov_deg", [40.0, 330.0])
def test_an_interfering_pulse_has_the_power_pattern_of_the_beams(
    field, series, half_power, width_deg, fov_deg
):
    """A floor of -35 dB, 100 µs, which are 6 bins, and azimuths across the back the shorter way round."""
    degrees = np.linspace(-fov_deg / 2, fov_deg / 2, 221)
    width = None if width_deg is None else math.radians(width_deg)
    beams = FieldCorrelation(tuple(np.radians(degrees)), width, series)
    intensity = np.zeros((221, 20), np.float32)
    power = np.arange(1.0, 21.0)
    add_interference(intensity, 1.0, power, beams, 0.0125, 1500.0, OnePulse())
    assert not intensity[:, :5].any() and not intensity[:, 11:].any()
    off = np.abs(degrees + fov_deg / 4)
    off = np.minimum(off, 360 - off) / (width_deg or fov_deg / 221)
    pattern = np.maximum(field(2 * half_power * off) ** 2, 10**-3.5)
    np.testing.assert_allclose(intensity[:, 5:11], np.outer(pattern, power[5:11]), rtol=1e-5)  # float32


@pytest.mark.parametrize("width_rad", [math.radians(2.0), None], ids=["of 2 degrees", "unknown"])
def test_an_interfering_pulse_shorter_than_a_bin_fills_one_bin_also_of_a_single_beam(width_rad):
    """75 mm, of bins of half a metre; the beam lies in its direction, however wide it is."""
    intensity, power = np.zeros((1, 20), np.float32), np.arange(1.0, 21.0)
    beam = FieldCorrelation((0.3,), width_rad, ())
    add_interference(intensity, 1.0, power, beam, 0.5, 1500.0, OnePulse())
    assert intensity[0].tolist() == [6.0 if k == 5 else 0.0 for k in range(20)]
