"""Place-locked speckle: what it does as the sonar stands still, turns and moves."""

import sys
from dataclasses import replace
from itertools import combinations, count, pairwise

import numpy as np
import pytest

from sonar_gl import Ping, Water, pose
from sonar_gl.acoustics.beam_pattern import aperture_weights
from sonar_gl.acoustics.pulse import PulseResponse, coarse_reach
from sonar_gl.core.errors import Error
from sonar_gl.noise.gaussian import standard_normal
from sonar_gl.noise.noise import add_noise
from sonar_gl.noise.place_locked_speckle import FieldShape, add_products, place_locked_field
from sonar_gl.noise.random_streams import stream
from sonar_gl.noise.reception import receiver_of
from sonar_gl.noise.settings import Noise
from sonar_gl.noise.speckle import TAPS, FieldCorrelation, aperture_width
from sonar_gl.noise.wave_cache import CHUNK, RECENT_USES, WaveCache
from sonar_gl.sonar.sonar_files import presets
from tests.support.even_ping import (
    BEAM_WIDTH_RAD,
    BIN_M,
    FREQUENCY_HZ,
    HAMMING_SERIES,
    SIGMAS,
    SOUND_SPEED_M_S,
    UNIFORM_WIDTH,
    correlation,
    even_ping,
    hamming_correlation,
)
from tests.support.settings import described
from tests.support.threads import counting_thread

APERTURE_M = UNIFORM_WIDTH * SOUND_SPEED_M_S / FREQUENCY_HZ / BEAM_WIDTH_RAD  # length of the array
PLACE_LOCKED = Noise(speckle=True, follow_motion=True)
YAW_RAD = 0.3  # heading of the sonars of `moved`
AHEAD, PORT = np.array([[np.cos(YAW_RAD), np.sin(YAW_RAD)], [-np.sin(YAW_RAD), np.cos(YAW_RAD)]])
BORESIGHT = slice(31, 33)  # the two middle beams of 64


def random_waves(seed=5):
    """Return a function that makes waves as `place_locked_field` takes it."""

    def chunk_of(x, y, chunk, n_bins):
        block, direction = chunk
        return standard_normal(
            stream(seed, 0, "speckle", x + 99, y + 99, block + 9999, direction), (CHUNK, 2, n_bins)
        )

    return lambda x, y, chunks, n_bins: {chunk: chunk_of(x, y, chunk, n_bins) for chunk in chunks}


def field_of_beams(*arguments) -> np.ndarray:
    """Return the (B, 2, K) field of `place_locked_field`."""
    nodes, first, weights, scale = place_locked_field(*arguments)
    return np.einsum("bt,btpk->bpk", weights, nodes[first[:, None] + np.arange(TAPS)]) * scale


def patterns(noise, ping, count=1, seed=1) -> np.ndarray:
    """Return (count, B, K) float64, the intensities of so many pings."""
    return np.array([add_noise(ping, noise, seed, n).intensity for n in range(count)], np.float64)


def moved(seed, x=0.0, y=0.0, yaw=0.0, **acoustics) -> np.ndarray:
    """Return the (B, K) pattern of a sonar, so many metres and radians from one place in the sea."""
    where = pose(99.95 + x, -49.95 + y, 0, 0, 0, YAW_RAD + yaw)
    return patterns(PLACE_LOCKED, even_ping(pose=where, **acoustics), 1, seed)[0]


@pytest.mark.parametrize("noise", [PLACE_LOCKED, replace(PLACE_LOCKED, looks=2)])
@pytest.mark.parametrize("texture", [None, 1.0])
def test_a_still_sonar_has_a_still_pattern(noise, texture):
    ping = even_ping(pose=pose(0.2, 0.2, 0, 0, 0, 0))
    ping = replace(ping, texture_deviation=texture and np.full_like(ping.intensity, texture))
    first, second = patterns(noise, ping, 2)
    assert (first == second).all()
    assert correlation(first, patterns(noise, ping, 1, seed=2)) < 0.1


@pytest.mark.parametrize(
    "where", [pose(0.2, 0.2), pose(0.25, 0.26, yaw=0.3)]
)  # in one cell of the sea, and in four
def test_a_second_thread_leaves_the_field_as_it_is(where):
    beams = FieldCorrelation(tuple(np.radians(np.arange(150) / 4)), BEAM_WIDTH_RAD)
    shape = FieldShape(beams, 700, BIN_M, SOUND_SPEED_M_S / FREQUENCY_HZ)
    with counting_thread() as thread:
        alone, both = (field_of_beams(shape, where, random_waves(), one) for one in (None, thread))
        assert thread.n_jobs
    np.testing.assert_array_equal(both, alone)


def test_receiver_noise_is_new_in_each_ping():
    ping = even_ping(pose=pose(0.2, 0.2, 0, 0, 0, 0))
    first, second = patterns(replace(PLACE_LOCKED, ambient_db=0.0), ping, 2)
    assert (first != second).mean() > 0.99


@pytest.mark.slow
def test_looks_have_patterns_of_their_own():
    """The contrast of the mean of four is a half; waves that are kept must be those of the look."""
    (x,) = patterns(replace(PLACE_LOCKED, looks=4), even_ping(200, 1000, 2.0, pose=pose(0.2, 0.2)))
    assert x.std() == pytest.approx(0.5, abs=SIGMAS * np.sqrt(2 / x.size))  # beams are two widths apart


def test_it_is_that_of_the_tilted_head():
    """The housing is level, and turned about the boresight: the head below it looks aside as well as down."""
    ping = even_ping(pose=pose(0.2, 0.2, 0, 0.7, 0, YAW_RAD))
    tilted = replace(ping, sonar=replace(ping.sonar, tilt_deg=20.0))
    head = replace(ping, pose=tilted.sonar.head_pose(ping.pose))
    found, expected, level = (patterns(PLACE_LOCKED, one) for one in (tilted, head, ping))
    np.testing.assert_array_equal(found, expected)
    assert correlation(found, level) < 0.9


def test_statistics_are_those_of_speckle():
    x = np.array([moved(seed) for seed in range(30)])
    n = 30 * 256 * 64 * 0.25 * UNIFORM_WIDTH
    assert x.mean() == pytest.approx(1, abs=SIGMAS / np.sqrt(n))
    assert x.std() == pytest.approx(1, abs=SIGMAS * np.sqrt(2 / n))
    half_a_width_apart = np.sinc(UNIFORM_WIDTH / 2) ** 2
    found = correlation(x[:, 2:], x[:, :-2])
    assert found == pytest.approx(half_a_width_apart, abs=SIGMAS * 2 / np.sqrt(n) + 5e-3)


@pytest.mark.parametrize("series, error_db", [((), -38), (HAMMING_SERIES, -44)])
def test_beams_between_nodes_are_those_that_are_summed_themselves(series, error_db):
    """Every fourth of many beams; so few have no nodes. They differ by what is left out of the ends of apertures."""
    azimuth_rad = np.radians(np.arange(64) / 4)
    all_beams, few_beams = (
        field_of_beams(
            FieldShape(
                FieldCorrelation(tuple(some), BEAM_WIDTH_RAD, series),
                300,
                BIN_M,
                SOUND_SPEED_M_S / FREQUENCY_HZ,
            ),
            pose(),
            random_waves(),
        )
        for some in (azimuth_rad, azimuth_rad[1::4])
    )
    error = np.square(all_beams[1::4] - few_beams).sum(1).mean()
    assert 0 < error < 2 * 10 ** (error_db / 10)


@pytest.mark.parametrize("width_deg", [1.0, 6.0])
@pytest.mark.parametrize("series, error", [((), 0.02), (HAMMING_SERIES, 0.006)])
def test_fields_correlate_as_their_apertures_overlap(series, error, width_deg):
    """Those of beams any angle apart, and of sonars any way aside: exactly, from the weights of all waves."""
    width_rad, wavelength_m = np.radians(width_deg), SOUND_SPEED_M_S / FREQUENCY_HZ
    azimuth_rad = width_rad * np.array([-1.1, -0.4, -0.13, 0, 0.05, 0.21, 0.5, 0.9, 1.5])
    n_bins, first_bins = 6000, {}
    # bins so long that no pattern moves along range
    shape = FieldShape(FieldCorrelation(tuple(azimuth_rad), width_rad, series), n_bins, 1e9, wavelength_m)

    def waves(x, y, chunks, n_wave_bins):
        """Each wave is 1 in a bin of its own."""
        out = {chunk: np.zeros((CHUNK, 2, n_wave_bins), np.float32) for chunk in chunks}
        for chunk, of_chunk in out.items():
            first = first_bins.setdefault(chunk, CHUNK * len(first_bins)) + (n_wave_bins - n_bins) // 2
            of_chunk[np.arange(CHUNK), 0, first + np.arange(CHUNK)] = 1
        return out

    aperture_m = aperture_width(series) * wavelength_m / width_rad
    fields, apertures, v = [], [], np.linspace(-2, 3, 10001)  # in apertures
    for aside in (0, 0.013, 0.05, 0.12, 0.23, 0.3, 0.5, 0.7):
        field = field_of_beams(shape, pose(0, aside * aperture_m), waves)
        fields.append(field[:, 0] + 1j * field[:, 1])
        for azimuth in azimuth_rad:
            z = v - 2 * aside * np.cos(azimuth)
            taper = np.where(np.abs(z) <= 0.5, aperture_weights(z, series), 0)
            apertures.append(taper * np.exp(2j * np.pi * azimuth * aperture_m / wavelength_m * v))
    assert CHUNK * len(first_bins) < n_bins
    found, expected = (np.abs(rows @ rows.conj().T) for rows in map(np.vstack, (fields, apertures)))
    # of waves of variance 2; float32
    np.testing.assert_allclose(2 * np.diag(found), 1, rtol=1e-5)
    assert np.abs(2 * found - expected / expected[0, 0]).max() < error


@pytest.mark.parametrize(
    "where",
    [
        pose(0.2, -0.15, yaw=0.3),
        *(pytest.param(at, marks=pytest.mark.slow) for at in (pose(), pose(0.2, 0.2), pose(0.25, 0.25))),
    ],
)
def test_no_beam_is_brighter_than_others(where):
    """Also those between nodes whose patterns lie apart by a bin and more, off the middle of a cell of the sea."""
    azimuth_rad = tuple(np.radians(np.linspace(-60, 60, 512)))
    bin_m, n_bins, n_seeds = 0.004, 400, 12
    pulse = PulseResponse(SOUND_SPEED_M_S / (2 * bin_m), "uniform", SOUND_SPEED_M_S)
    shape = FieldShape(
        FieldCorrelation(azimuth_rad, BEAM_WIDTH_RAD), n_bins, bin_m, SOUND_SPEED_M_S / 720e3, pulse
    )
    power = np.zeros(len(azimuth_rad))
    for seed in range(n_seeds):
        power += np.square(field_of_beams(shape, where, random_waves(seed))).sum(1).mean(1) / n_seeds
    # a bin off the middle of others may take up to half of its power from the next
    assert power == pytest.approx(1, abs=SIGMAS * np.sqrt(1.5 / (n_bins * n_seeds)))
    # beams half a width apart share about half of their variance
    n = n_bins * n_seeds * 120 * UNIFORM_WIDTH
    assert power.mean() == pytest.approx(1, abs=SIGMAS * np.sqrt(1.5 / n))


@pytest.mark.parametrize("yaw", [0.0, np.pi - YAW_RAD - 0.002])
@pytest.mark.parametrize("beams", [1, 5])
def test_turning_moves_the_pattern_by_beams(yaw, beams):
    """Across the seam of the circle, too."""
    turned = moved(0, yaw=yaw + np.radians(0.25) * beams)
    np.testing.assert_allclose(
        turned[:-beams], moved(0, yaw=yaw)[beams:], rtol=0, atol=4e-6
    )  # float32, of up to 12


@pytest.mark.parametrize("roll, pitch", [(np.pi, 0.0), (np.pi - 0.3, -0.4), (0.0, np.pi - 0.4)])
def test_turning_upside_down_moves_the_pattern_the_other_way(roll, pitch):
    """Places keep their speckle: the beams of a sonar that hangs upside down count from port to starboard."""
    before, after = (
        patterns(PLACE_LOCKED, even_ping(pose=pose(0.1, 0.07, 0, roll, pitch, yaw)))[0]
        for yaw in (0.0, np.radians(0.25) * 3)
    )
    np.testing.assert_allclose(after[3:], before[:-3], rtol=0, atol=4e-6)  # float32, of up to 12


def test_upside_down_sonar_sees_the_mirror_image():
    upright, hanging = (
        patterns(PLACE_LOCKED, even_ping(pose=pose(3.2, 1.2, 0, roll, 0, YAW_RAD)))[0]
        for roll in (0.0, np.pi)
    )
    np.testing.assert_allclose(hanging, upright[::-1], rtol=0, atol=4e-6)  # float32, of up to 12


def test_a_slow_turn_never_changes_the_whole_pattern():
    """Steps of a fifth of a beam's spacing: the grid of nodes in the world has one node more at some headings.

    The fan is as wide as a third of the longest period of the field, but for that node.
    """
    still = even_ping(512, 60, 79.33 / 512, beam_width_deg=1.5)
    steps = [patterns(PLACE_LOCKED, replace(still, pose=pose(yaw=0.0005 * k)), 1)[0] for k in range(30)]
    assert min(correlation(a, b) for a, b in pairwise(steps)) > 0.99


def test_a_fan_is_narrower_than_the_period_of_its_field():
    """Of a fan of 120 widths, any two beams two widths or more apart are independent."""
    pattern = patterns(PLACE_LOCKED, even_ping(240, 100, 0.5, pose=pose()), 1)[0] - 1
    sums = [(pattern[:-lag] * pattern[lag:]).sum() for lag in range(4, 200)]
    # beams within a width are alike, so that each counts as half a beam
    errors = [np.sqrt((240 - lag) * 100 * 2) for lag in range(4, 200)]
    assert np.abs(np.divide(sums, errors)).max() < SIGMAS


def test_moving_ahead_moves_the_pattern_in_range():
    forward = 3 * BIN_M * AHEAD
    # beams are interpolated between nodes up to 2 degrees aside, whose apertures slide by some hundredths
    assert correlation(moved(0, *forward)[BORESIGHT, :-3], moved(0)[BORESIGHT, 3:]) > 0.998


@pytest.mark.parametrize("pulse", [False, True])
def test_the_pattern_moves_with_the_echoes_where_the_sonar_assumes_another_speed_of_sound(pulse):
    """Both are shown 1.2 times as far: five bins are six, and the pattern slid away from the bodies by one."""
    settings = {"sonar_sound_speed_m_s": 1.2 * SOUND_SPEED_M_S, "pulse": pulse}
    forward = 5 * BIN_M * AHEAD
    later, first = moved(0, *forward, **settings)[BORESIGHT], moved(0, **settings)[BORESIGHT]
    assert correlation(later[:, :-6], first[:, 6:]) > 0.99
    assert (
        correlation(later[:, :-5], first[:, 5:]) < 0.5 + 0.5 * pulse
    )  # a pulse of two bins correlates neighbours


@pytest.mark.parametrize("bandwidth_hz", [60e3, 20e3])  # c/2B is one bin, and three
def test_the_pattern_is_that_of_true_metres_whatever_ranges_the_sonar_shows(bandwidth_hz):
    """A sonar whose bins are as much longer as the speed that it assumes is higher has the same ping, to the bit."""
    right = even_ping(16, 100, pose=pose(0.2), pulse=True, bandwidth_hz=bandwidth_hz)
    ranges_m = {key: 1.1 * getattr(right.sonar, key) for key in ("range_min_m", "range_max_m")}
    sonar = replace(right.sonar, **ranges_m)
    acoustics = replace(right.acoustics, sonar_sound_speed_m_s=1.1 * SOUND_SPEED_M_S)
    fast = replace(right, sonar=sonar, range_m=sonar.range_m, acoustics=acoustics)
    np.testing.assert_array_equal(*(add_noise(ping, PLACE_LOCKED, 1).intensity for ping in (right, fast)))


def test_moving_ahead_by_many_bins_changes_a_single_bin():
    """Its length is that of the sonar's bin, not its range."""
    before, after = (
        np.array([patterns(PLACE_LOCKED, even_ping(64, 1, pose=pose(x)), 1, seed)[0] for seed in range(30)])
        for x in (0.0, 10 * BIN_M)
    )
    n = 30 * 64 * 0.25 * UNIFORM_WIDTH
    assert abs(correlation(after, before)) < SIGMAS / np.sqrt(n)


def test_moving_ahead_by_half_a_bin_interpolates():
    # c/2B is 2 bins
    pulse = {"pulse": True, "bandwidth_hz": SOUND_SPEED_M_S / (4 * BIN_M), "pulse_taper": "hamming"}
    forward = BIN_M / 2 * AHEAD
    before = np.array([moved(seed, **pulse)[BORESIGHT] for seed in range(30)])
    after = np.array([moved(seed, *forward, **pulse)[BORESIGHT] for seed in range(30)])
    error = SIGMAS * 0.15 / np.sqrt(30 * 128)  # of a correlation of 0.94
    assert correlation(after, before) == pytest.approx(hamming_correlation(0.25) ** 2, abs=error)


@pytest.mark.parametrize("moved_bins", [0.0, 0.5])
@pytest.mark.parametrize(
    "bins_per_null", [1.36, *(pytest.param(n, marks=pytest.mark.slow) for n in (1.0, 2.0, 3.0))]
)
@pytest.mark.parametrize("taper", ["hamming", "uniform"])
def test_bins_longer_than_the_pulse_correlate_as_it_does_wherever_the_sonar_is(
    taper, bins_per_null, moved_bins
):
    """As in fine bins, of which they are some: presets without a bandwidth have bins of 1.36 c/2B."""
    pulse = {
        "pulse": True,
        "bandwidth_hz": SOUND_SPEED_M_S / 2 / (BIN_M / bins_per_null),
        "pulse_taper": taper,
    }
    forward = moved_bins * BIN_M * AHEAD
    pattern = np.array([moved(seed, *forward, **pulse)[BORESIGHT] for seed in range(60)])
    theory = hamming_correlation if taper == "hamming" else np.sinc
    for bins in (1, 2, 3):
        wanted = theory(bins * bins_per_null)
        # two beams that are nearly one; weights end after 4 to 16 bins, so that amplitudes correlate by up to 0.02 more
        error = SIGMAS / np.sqrt(60 * 256) + 0.02 * (2 * abs(wanted) + 0.02)
        assert correlation(pattern[..., bins:], pattern[..., :-bins]) == pytest.approx(wanted**2, abs=error)


def test_waves_have_as_many_bins_as_coarse_weights_reach_from_the_furthest_place():
    """Beams that look along the diagonal of a cell, from its end: with fewer bins memory beside them would be read."""
    bin_m, n_bins, n_wave_bins = 0.1, 40, []
    pulse = PulseResponse(SOUND_SPEED_M_S / (2 * bin_m), "uniform", SOUND_SPEED_M_S)
    correlated = FieldCorrelation((np.radians(45.0), np.radians(46.0)), BEAM_WIDTH_RAD)
    shape = FieldShape(correlated, n_bins, bin_m, SOUND_SPEED_M_S / FREQUENCY_HZ, pulse)

    def waves(x, y, chunks, n):
        n_wave_bins.append(n)
        return dict.fromkeys(chunks, np.zeros((CHUNK, 2, n), np.float32))

    place_locked_field(shape, pose(0.29, 0.29), waves)
    reach = coarse_reach(bin_m, *pulse)
    assert min(n_wave_bins) >= n_bins + 2 * (0.29 * np.sqrt(2) / bin_m + reach - 1)


def waves_in_margins(rng, margin: int):
    """Return a function as `random_waves` does: each wave is the same in all bins, and chunks lie between NaN."""

    def waves_of(x, y, chunks, n_bins):
        out = {}
        for chunk in chunks:
            memory = np.full(2 * margin + CHUNK * 2 * n_bins, np.nan, np.float32)
            out[chunk] = memory[margin:-margin].reshape(CHUNK, 2, n_bins)
            out[chunk][:] = rng.normal(size=(CHUNK, 2, 1))
        return out

    return waves_of


def any_shape(rng, sonar) -> FieldShape:
    """Return the shape of the field of a sonar, with bins far shorter and longer than its pulse."""
    n_bins = int(rng.choice([1, 2, 3, 16, 61]))
    range_max_m = sonar.range_min_m + n_bins * 10 ** rng.uniform(-3, 0.3)
    drawn = {"beam_pattern": rng.choice(["gaussian", "line_array"]).item(), "pulse": bool(rng.integers(2))}
    sonar, acoustics = described(sonar, **drawn, n_bins=n_bins, range_max_m=range_max_m)
    ping = Ping(
        np.zeros((sonar.n_beams, n_bins)), sonar.azimuth_rad, sonar.range_m, sonar=sonar, acoustics=acoustics
    )
    reception = receiver_of(ping, PLACE_LOCKED)
    beams = reception.correlation._replace(pulse_weights=None)
    wavelength_m = reception.sound_speed_m_s / sonar.frequency_hz
    return FieldShape(beams, n_bins, ping.bin_size_m, wavelength_m, reception.pulse)


@pytest.mark.parametrize("name", presets())
def test_sums_read_all_bins_of_waves_that_count_and_no_memory_beside_them(name):
    """Where no bin is left out, waves that are even in range make even fields; memory beside them would make NaN.

    The six waves of an aperture are next to each other on the circle. So the first and the last wave of some chunk are
    among them, beside which a read that is off by some bins gets NaN. Places of the sonar are those furthest from the
    middle of their cell, and others.
    """
    rng = np.random.default_rng(len(name))
    for _ in range(8):
        shape = any_shape(rng, presets()[name])
        end = rng.choice([-0.2999, 0.2999, 0.0, rng.uniform(-0.3, 0.3)], 2) + 0.5 * rng.integers(-9, 9, 2)
        where = pose(*end, 0, *rng.uniform(-np.pi, np.pi, 3))
        nodes, first, _, _ = place_locked_field(shape, where, waves_in_margins(rng, 5000))
        assert first.min() >= 0
        assert first.max() + TAPS <= len(nodes)  # nodes that are interpolated
        own = nodes[: first.max() + TAPS]
        assert np.isfinite(own).all()
        # fields of bins are sums of the same products; vectors and what they leave over may round otherwise
        np.testing.assert_allclose(own, own[..., :1] + 0 * own, rtol=0, atol=1e-6 * np.abs(own).max())


@pytest.mark.parametrize(
    "share", [0.15, *(pytest.param(one, marks=pytest.mark.slow) for one in (0.05, 0.25))]
)
def test_moving_sideways_slides_the_aperture(share):
    aside = share * APERTURE_M * PORT
    before = np.array([moved(seed)[BORESIGHT] for seed in range(40)])
    after = np.array([moved(seed, *aside)[BORESIGHT] for seed in range(40)])
    found = correlation(after, before)
    # the outermost of 79 waves count in part, which correlates by up to a third of a wave too much
    error = SIGMAS / np.sqrt(40 * 256) * (1 - found**2) + 0.01
    assert found == pytest.approx((1 - 2 * share) ** 2, abs=error)


def test_waves_come_into_the_aperture_gradually():
    """Steps of a twentieth of a wave all change the pattern alike; a wave at once would be a jump."""
    step = APERTURE_M / 158 / 20 * PORT  # 79 waves, which slide by twice the way of the sonar
    steps = [moved(0, *(k * step))[BORESIGHT] for k in range(40)]
    changes = [np.abs(after - before).mean() for before, after in pairwise(steps)]
    assert max(changes) < 1.1 * np.median(changes)


@pytest.mark.parametrize("bins", [4, *(pytest.param(one, marks=pytest.mark.slow) for one in (2, 6))])
def test_a_step_ahead_into_the_fade_of_cells_keeps_the_share_of_its_cell(bins):
    """From 0.05 m before a border on, amplitudes fall as a quarter of a cosine; 6 bins end 2.5 cm behind it."""
    before, after = (
        np.array(
            [
                patterns(PLACE_LOCKED, even_ping(pose=pose(0.2 + x, 0.1)), 1, seed)[0, BORESIGHT]
                for seed in range(40)
            ]
        )
        for x in (0, bins * BIN_M)
    )
    found = correlation(after[..., :-bins], before[..., bins:])
    # beams an eighth of a degree off the boresight move aside, too, by 0.2 % of their aperture
    error = SIGMAS / np.sqrt(40 * 256) * (1 - found**2) + 0.008
    assert found == pytest.approx(np.cos(np.pi / 2 * bins * BIN_M / 0.1) ** 2, abs=error)


def test_heave_roll_and_pitch_leave_the_pattern():
    level, tilted = (
        patterns(PLACE_LOCKED, even_ping(pose=pose(3.2, 1.2, z, roll, pitch, YAW_RAD)))[0]
        for z, roll, pitch in ((0, 0, 0), (-7.0, 0.3, -0.4))
    )
    np.testing.assert_allclose(tilted, level, rtol=0, atol=4e-6)  # float32, of up to 12


def test_the_pattern_is_that_of_the_wavelength_in_the_water():
    """The same at a frequency higher by a ratio, and in water in which sound is faster by it."""
    ping = even_ping(pose=pose(0.2, 0.2))
    higher = replace(ping, sonar=replace(ping.sonar, frequency_hz=1.1 * FREQUENCY_HZ))
    faster = even_ping(pose=pose(0.2, 0.2), water=Water(sound_speed_m_s=1.1 * SOUND_SPEED_M_S))
    both = replace(faster, sonar=higher.sonar)
    for found, expected in (
        (both, ping),
        (faster, replace(ping, sonar=replace(ping.sonar, frequency_hz=FREQUENCY_HZ / 1.1))),
    ):
        assert correlation(patterns(PLACE_LOCKED, found), patterns(PLACE_LOCKED, expected)) > 0.999
    assert correlation(patterns(PLACE_LOCKED, higher), patterns(PLACE_LOCKED, ping)) < 0.5


@pytest.mark.parametrize("n_waves", [pytest.param(318, marks=pytest.mark.slow), 319])
def test_it_adds_to_the_receivers_noise_alike_over_the_seam_of_a_full_circle(n_waves):
    """The two are added as fields, so that the sign of neither may change there."""
    width_deg = np.degrees(UNIFORM_WIDTH * 2 * np.pi / n_waves)
    ping = even_ping(720, 1500, 0.5, pose=pose(0.2, 0.2, yaw=0.4), beam_width_deg=width_deg)
    (found,) = patterns(replace(PLACE_LOCKED, ambient_db=0.0), ping)
    of_neighbours = [
        correlation(one, next_one) for one, next_one in zip(found, np.roll(found, -1, axis=0), strict=True)
    ]
    expected = np.mean(of_neighbours)
    # of 1500 bins that are independent
    assert of_neighbours[-1] == pytest.approx(expected, abs=SIGMAS / np.sqrt(1500))


def test_each_cell_of_the_sea_has_a_pattern_of_its_own():
    """At one place within it, of cells half a metre apart along either axis."""
    places = ((0, 0), (1, 0), (0, 1), (1, 1), (-1, 0), (0, -1))
    found = [patterns(PLACE_LOCKED, even_ping(pose=pose(0.2 + x / 2, 0.2 + y / 2)))[0] for x, y in places]
    assert max(correlation(a, b) for a, b in combinations(found, 2)) < 0.1


def test_cells_of_the_sea_fade_into_each_other():
    """Across a border in steps of 4 mm: each step correlates as well as within a cell."""
    steps = [
        patterns(PLACE_LOCKED, even_ping(pose=pose(x, 0, 0, 0, 0, 0)))[0]
        for x in np.arange(0.69, 0.8101, 0.004)
    ]
    within = [correlation(a[:, :-1], b[:, :-1]) for a, b in pairwise(steps[:3])]
    assert min(correlation(a, b) for a, b in pairwise(steps)) > min(within) - 0.05
    assert all(abs(step.mean() - 1) < SIGMAS / np.sqrt(256 * 14) for step in steps)
    assert correlation(steps[0], steps[-1]) < 0.1  # each cell has its own waves


@pytest.mark.parametrize(
    "x, y",
    [(0.75, 0.5), *(pytest.param(*one, marks=pytest.mark.slow) for one in ((0.25, 0.25), (1.27, 0.72)))],
)
def test_beams_overlap_in_the_cross_fade_as_within_a_cell(x, y):
    """Two or four cells add up there, with waves of very different phases over beams."""
    found = [
        correlation(pattern[2:], pattern[:-2])
        for pattern in (patterns(PLACE_LOCKED, even_ping(pose=pose(x, y)), 1, seed)[0] for seed in range(20))
    ]
    # beams half a width apart; 1 mm of range, of bins of 12.5 mm, that their patterns lie apart costs the rest
    n = 20 * 256 * 64 * 0.25 * UNIFORM_WIDTH
    assert np.mean(found) == pytest.approx(
        np.sinc(UNIFORM_WIDTH / 2) ** 2, abs=SIGMAS * 2 / np.sqrt(n) + 0.05
    )


def cached_waves(cache, chunks, key=0):
    """Return waves of a cache, and how many chunks were generated."""
    generated = []

    def generator(chunk):
        generated.append(chunk)
        return stream(1, 0, "speckle", key, chunk)

    return cache.waves(key, chunks, 10, generator), generated


def test_only_waves_that_the_pings_before_did_not_receive_are_generated():
    cache, wanted = WaveCache(1 << 20), range(4, 9)
    assert cached_waves(cache, range(3, 6))[1] == [3, 4, 5]
    assert cached_waves(cache, range(4, 5))[1] == []
    found, generated = cached_waves(cache, wanted)
    assert generated == [6, 7, 8]
    new, _ = cached_waves(WaveCache(1 << 20), wanted)
    assert list(found) == list(new) == list(wanted)
    for chunk in wanted:
        assert not found[chunk].flags.writeable  # later pings have the same
        np.testing.assert_array_equal(found[chunk], new[chunk])


def test_the_cache_of_waves_keeps_those_that_were_used_last():
    chunk = CHUNK * 2 * 10 * 4  # bytes
    cache = WaveCache(2 * chunk)
    for key in (0, 1, *[0] * RECENT_USES, 2):
        cached_waves(cache, range(1), key)
    assert cached_waves(cache, range(1), 0)[1] == []
    assert cached_waves(cache, range(1), 1)[1] == [0]
    cached_waves(cache, range(3), 3)  # more than fits: not kept
    assert cached_waves(cache, range(3), 3)[1] == [0, 1, 2]


def test_waves_that_all_fit_stay_however_long_ago_they_were_used():
    cache = WaveCache(2 * CHUNK * 2 * 10 * 4)  # bytes of two chunks
    for key in (0, 1, *[0] * 3 * RECENT_USES):
        cached_waves(cache, range(1), key)
    assert cached_waves(cache, range(1), 1)[1] == []


def test_of_waves_in_turn_that_do_not_all_fit_some_are_kept():
    """Were those to go that were not used for longest, none would be there when its turn comes."""
    cache = WaveCache(2 * CHUNK * 2 * 10 * 4)  # bytes of two chunks
    generated = [bool(cached_waves(cache, range(1), key)[1]) for _ in range(3) for key in range(3)]
    assert generated == [True, True, True, False, False, True, False, False, True]


def test_a_signal_handler_may_use_the_cache_at_any_line_of_a_use():
    """Early versions hung: the handler waited for a lock that the code below it held."""
    chunk = CHUNK * 2 * 10 * 4  # bytes
    cache, own_lines, keys = WaveCache(2 * chunk), [], count(2)

    def handler(frame, event, _):
        if event == "line":
            sys.settrace(None)
            own_lines.append(frame.f_lineno)
            cached_waves(cache, range(1), next(keys))
            sys.settrace(trace)
        return handler

    def trace(frame, *_):
        return handler if isinstance(frame.f_locals.get("self"), WaveCache) else None

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        found = [cached_waves(cache, range(2), 0)[0] for _ in range(3)]
    finally:
        sys.settrace(before)
    assert len(set(own_lines)) > 10
    new, _ = cached_waves(WaveCache(0), range(2), 0)
    for waves in found:
        for chunk in range(2):
            np.testing.assert_array_equal(waves[chunk], new[chunk])


def test_pings_before_do_not_change_a_pattern():
    """The way there and back takes other waves of the same cell, of which some are kept and some new."""
    first = moved(0, x=0.07, y=0.03)
    for step in range(8):
        moved(0, x=0.07 - 0.02 * step, y=0.03 - 0.01 * step)
    np.testing.assert_array_equal(moved(0, x=0.07, y=0.03), first)


@pytest.mark.parametrize("far", [(-1.1e9, 0.0), (0.0, -1e12), (1e300, -1e300)])
def test_a_sonar_far_from_the_origin_has_speckle(far):
    """Streams take no negative numbers, and cells have some to the west and the south."""
    pattern = patterns(PLACE_LOCKED, even_ping(pose=pose(*far)))[0]
    assert pattern.mean() == pytest.approx(1, abs=SIGMAS / np.sqrt(256 * 14))


@pytest.mark.parametrize("missing", ["pose", "sonar"])
def test_it_needs_a_pose_and_a_sonar(missing):
    with pytest.raises(Error) as caught:
        add_noise(replace(even_ping(pose=np.eye(4)), **{missing: None}), PLACE_LOCKED, 0)
    assert str(caught.value) == (
        f"noise: the ping must have a {missing} for place-locked speckle, follow_motion=True "
        "(got None; pings of a Simulator have one)"
    )


def test_mean_products_of_fields_are_those_of_their_sums_written_out():
    """Apertures slide over blocks to either side, and patterns along range: with overlaps of all lengths.

    Directions turn on over the end of the circle.
    """
    rng = np.random.default_rng(4)
    n_nodes, n_blocks, n_own, n_circle, n_weights, n_next = 7, 5, 6, 20, 4, 5
    block, direction = np.array([9, 12, 10, 3, 3, 11, 20]), np.array([17, 18, 0, 2, 2, 9, 14])
    shift = np.array([5, 3, 4, 8, 4, 6, 9])
    matrix = rng.normal(size=(n_nodes, n_blocks, n_own, 2)).astype(np.float32)
    weights = rng.normal(size=(n_nodes, n_weights)).astype(np.float32)
    out = np.ones((n_nodes, n_next))  # which is added to
    add_products(block, direction, matrix, n_circle, shift, weights, out)
    of_waves, of_bins = np.zeros((n_nodes, 40, n_circle, 2)), np.zeros((n_nodes, 40))
    for node in range(n_nodes):
        own = (direction[node] + np.arange(n_own)) % n_circle
        of_waves[node, block[node] : block[node] + n_blocks, own] = matrix[node].swapaxes(0, 1)
        of_bins[node, shift[node] : shift[node] + n_weights] = weights[node]
    expected = np.ones((n_nodes, n_next))
    for node in range(n_nodes):
        for aside in range(min(n_next, n_nodes - node)):
            other = node + aside
            waves, bins = (of_waves[node] * of_waves[other]).sum(), of_bins[node] @ of_bins[other]
            expected[node, aside] += 2 * waves * bins
    np.testing.assert_allclose(out, expected, rtol=1e-5, atol=1e-5)  # float32
