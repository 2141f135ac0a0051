"""The fan: strips cover it once, columns end where box beams end, beams are normalised by their solid angle."""

import math
from dataclasses import replace

import numpy as np
import pytest

import sonar_gl as sg
from sonar_gl.acoustics.acoustics import Acoustics
from sonar_gl.beamform.weights import beam_weights
from sonar_gl.sonar.fan import BeamShape, ColumnWidths, ends_of_fan_rad, fitted_sampling, make_fan
from sonar_gl.sonar.sampling import FINEST_LEVEL, MAX_COLUMNS_PER_BEAM, fewest_rows, sampling_at
from sonar_gl.sonar.sector import SHEAR
from sonar_gl.sonar.sonar_files import presets
from tests.support.fans import box_fan, make_sonar


@pytest.mark.parametrize("fov_deg", [8.0, 20.0, 45.0, 130.0, 180.0, 359.5, 360.0])
def test_strips_cover_the_fan_once(fov_deg):
    sonar = make_sonar(fov_deg, beam_width_deg=min(1.0, fov_deg))
    fan = box_fan(sonar)
    edges = fan.column_edges_rad
    span = sonar.azimuth_rad[-1] - sonar.azimuth_rad[0] + math.radians(sonar.beam_width_deg)
    assert edges[-1] - edges[0] == pytest.approx(min(2 * math.pi, span), abs=1e-9)
    assert (np.diff(edges) > 0).all()
    widths = np.zeros(fan.n_columns)
    for sector in fan.sectors:
        assert 2 * sector.half_width_rad <= math.radians(60) + 1e-9
        strips = sector.strips
        low = sector.azimuth_rad - np.arctan(strips.middle + strips.width / 2)
        high = sector.azimuth_rad - np.arctan(strips.middle - strips.width / 2)
        np.add.at(widths, strips.column, high - low)
        # each strip lies in its column, and is at most a tenth wider than a sample
        assert (low > edges[strips.column] - 1e-9).all()
        assert (high < edges[strips.column + 1] + 1e-9).all()
        assert (strips.width <= 1.1 * sector.u[1] * (1 + 1e-9)).all()
    np.testing.assert_allclose(widths, np.diff(edges), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("fov_deg", [20.0, 70.0, 130.0])
@pytest.mark.parametrize("n_beams", [15, 256])
def test_rounding_adds_no_sample(fov_deg, n_beams):
    """Boxes side by side fill the field of view: each has as many samples as asked for, in all sectors together."""
    sonar = make_sonar(fov_deg, n_beams, beam_width_deg=fov_deg / n_beams)
    for columns_per_beam in (6, 12):  # that up to three sectors divide evenly
        fan = make_fan(
            sonar, sg.Sampling(columns_per_beam, 20), BeamShape(math.radians(fov_deg / n_beams / 2))
        )
        samples = [2 * math.tan(one.half_width_rad) / one.u[1] for one in fan.sectors]
        assert sum(samples) == pytest.approx(columns_per_beam * n_beams, abs=1e-6)


@pytest.mark.parametrize("fov_deg", [20.0, 130.0, 360.0])
def test_the_sectors_of_side_lobes_cover_all_elevations_once(fov_deg):
    """In every column, up to the limit; and with samples that are few beside those of the aperture."""
    sonar, sampling = make_sonar(fov_deg, 90, elevation_fov_deg=54.0), sg.Sampling(2, 110)
    fan = make_fan(sonar, sampling, BeamShape(math.radians(0.5), max_elevation_deg=89.5))
    plain = make_fan(sonar, sampling, BeamShape(math.radians(0.5)))
    assert [len(f.sectors) > len(plain.sectors) for f in (fan, plain)] == [True, False]
    for mine, one in zip(fan.sectors, plain.sectors, strict=False):  # those of the aperture come first
        np.testing.assert_array_equal(np.concatenate([mine.u, mine.v]), np.concatenate([one.u, one.v]))
    limits = np.array([[s.tan_low, s.tan_high] for s in fan.sectors])
    starts = np.array([s.azimuth_rad - s.half_width_rad for s in fan.sectors])
    for start in np.unique(starts.round(9)):
        bands = np.sort(limits[np.abs(starts - start) < 1e-8], axis=0)
        np.testing.assert_array_equal(bands[1:, 0], bands[:-1, 1])
        np.testing.assert_allclose(np.degrees(np.arctan(bands[[0, -1], [0, 1]])), [-89.5, 89.5], rtol=1e-12)
    for sector in fan.sectors:
        _, v = sector.sample_coordinates()
        level = 1 / math.cos(sector.half_width_rad)
        # the lattice reaches to within a row of its limits, also at its sides, where they are further out
        assert v.min() < min(sector.tan_low, sector.tan_low * level) + sector.v[2]
        assert v.max() > max(sector.tan_high, sector.tan_high * level) - sector.v[2]
    more = sum(s.rows * s.columns for s in fan.sectors) / sum(s.rows * s.columns for s in plain.sectors)
    assert more < 1.3
    assert fan.max_sine == math.sin(math.radians(89.5))
    assert plain.max_sine == math.sin(math.radians(27.0))


SONARS = {
    "even": make_sonar(45.0, 64, 1.0),
    "contiguous": make_sonar(45.0, 64, 45 / 64),
    "apart": make_sonar(45.0, 16, 0.3),
    "full circle": make_sonar(360.0, 90, 6.0),
    "wider than the circle": make_sonar(360.0, 4, 170.0),
    "one beam": make_sonar(10.0, 1, 10.0),
    "table": make_sonar(90.0, 5, 2.0, beam_azimuths_deg=(-40.0, -11.0, 0.5, 1.0, 44.0)),
}


@pytest.mark.parametrize("name", SONARS)
@pytest.mark.parametrize("acoustics", [Acoustics.ideal(), Acoustics.physical()], ids=["box", "line array"])
def test_beams_are_normalised_by_their_solid_angle(name, acoustics):
    """If each column holds its own solid angle, every beam reads 1."""
    sonar = SONARS[name]
    pattern, support_rad = acoustics.receive_pattern(sonar), acoustics.receive_support_rad(sonar)
    fan = make_fan(sonar, sg.Sampling(4, 16), BeamShape(support_rad, pattern is None))
    found = beam_weights(fan, pattern, support_rad)
    aperture = 2 * math.sin(math.radians(sonar.elevation_fov_deg) / 2)
    solid_angles = np.diff(fan.column_edges_rad) * aperture
    columns = (found.first[:, None] + np.arange(found.weights.shape[1])) % fan.n_columns
    beams = (found.weights * solid_angles[columns]).sum(axis=1)
    np.testing.assert_allclose(beams, 1.0, rtol=1e-5)  # float32 weights
    assert (found.weights >= 0).all()


@pytest.mark.parametrize("name", ["even", "contiguous", "apart", "full circle", "table"])
def test_box_beams_consist_of_complete_columns(name):
    """Columns end where beams end, so that no beam contains an unknown part of a column."""
    sonar = SONARS[name]
    support_rad = math.radians(sonar.beam_width_deg) / 2
    fan = make_fan(sonar, sg.Sampling(4, 16), BeamShape(support_rad))
    weights = beam_weights(fan, None, support_rad).weights
    shares = weights * math.radians(sonar.beam_width_deg) * 2 * math.sin(math.radians(10))
    assert ((np.abs(shares) < 1e-5) | (np.abs(shares - 1) < 1e-5)).all()


@pytest.mark.parametrize(("shear", "wider"), [(SHEAR, 1.0), (-SHEAR, math.sqrt(2))])
@pytest.mark.parametrize(
    ("beam_width_deg", "columns_per_beam", "least_per_spacing"),
    [(1.0, 3.516, 0), (1.0, 1.0, 2), (0.5, 1.0, 45 / 16), (90.0, 0.2, 0.25)],
)
def test_columns_of_smooth_patterns(beam_width_deg, columns_per_beam, least_per_spacing, shear, wider):
    """Columns are as wide as a sample, at most half a spacing and an eighth of a beam; wider if beams are much wider.

    As samples, they are even on the plane of a view. Under wider samples their number is the least that is a multiple
    of 24. Those of the mirror image, with which a ping is compared, may be wider as its samples are.
    """
    sonar = make_sonar(n_beams=256, beam_width_deg=beam_width_deg)
    support_rad = Acoustics.physical().receive_support_rad(sonar)
    fan = make_fan(sonar, sg.Sampling(columns_per_beam, 16), BeamShape(support_rad, is_box=False), shear)
    edges, n_views = fan.column_edges_rad, len(fan.sectors)
    half_rad, n = (edges[-1] - edges[0]) / n_views / 2, fan.n_columns // n_views
    for k, sector in enumerate(fan.sectors):
        u = np.tan(edges[k * n : (k + 1) * n + 1] - sector.azimuth_rad)
        np.testing.assert_allclose(np.diff(u), 2 * math.tan(half_rad) / n, rtol=1e-9)
    least = 2 * math.tan(half_rad) / math.radians(45 / 256) * least_per_spacing / wider
    if least:
        assert n == 24 * math.ceil(least / 24)
    else:
        assert n == math.ceil(columns_per_beam * 2 * half_rad / math.radians(45 / 256))


@pytest.mark.parametrize("name", presets())
def test_fitted_samples_serve_whole_strips(name):
    """In the aperture a sample is as wide as a whole number of strips, at all levels of devices with upright beams."""
    sonar, acoustics = sg.load_sonar(name), Acoustics.physical()
    support_rad = acoustics.receive_support_rad(sonar)
    beams = BeamShape(support_rad, is_box=False, are_cones=acoustics.has_cones(sonar))
    for level in range(0, 22, 3):
        asked = sampling_at(sonar, level)
        for shear in SHEAR, -SHEAR:
            fitted = fitted_sampling(sonar, asked, beams, shear)
            if beams.are_cones:
                assert fitted is asked
                continue
            fan = make_fan(sonar, fitted, beams, shear)
            for sector in fan.sectors:
                ratios = sector.u[1] / sector.strips.width
                np.testing.assert_allclose(ratios, round(ratios[0]), rtol=1e-9)
            # as many samples, unless rows are as few as they may be; `count` has whole columns, of few of them
            n, n_asked = (one.columns_per_beam * one.rows for one in (fitted, asked))
            assert n == pytest.approx(n_asked, rel=0.03) or (
                fitted.rows == fewest_rows(sonar) and n > n_asked
            )


@pytest.mark.parametrize(
    ("fov_deg", "n_beams", "beam_width_deg"),
    [(30.0, 1, 30.0), (30.0, 2, 30.0), (60.0, 1, 2.0), (120.0, 3, 40.0), (180.0, 96, 2.0), (360.0, 16, 4.0)],
)
def test_samples_are_fitted_within_their_bounds(fov_deg, n_beams, beam_width_deg):
    """Of sonars with few beams, the finest levels have as many samples across a beam as there may be."""
    sonar = make_sonar(fov_deg, n_beams, beam_width_deg=beam_width_deg)
    beams = BeamShape(Acoustics.physical().receive_support_rad(sonar), is_box=False)
    for level in range(0, FINEST_LEVEL + 1, 5):
        fitted = fitted_sampling(sonar, sampling_at(sonar, level), beams)
        fan = make_fan(sonar, replace(fitted, rows=16), beams)
        for sector in fan.sectors:
            ratios = sector.u[1] / sector.strips.width
            whole = np.allclose(ratios, round(ratios[0]), rtol=1e-9)
            assert whole or fitted.columns_per_beam == MAX_COLUMNS_PER_BEAM


def test_the_largest_width_of_columns_is_a_parameter():
    sonar = make_sonar(n_beams=256, beam_width_deg=0.5)
    support_rad = Acoustics.physical().receive_support_rad(sonar)
    fan = make_fan(
        sonar, sg.Sampling(1.0, 16), BeamShape(support_rad, is_box=False), widths=ColumnWidths(0.25)
    )
    assert np.diff(fan.column_edges_rad).max() <= 0.25 * math.radians(45 / 256) * (1 + 1e-9)


def test_columns_of_a_table_are_half_its_least_spacing_wide_at_most():
    """Beams half a degree apart, as others are 43 degrees apart; samples, and parts of a beam, would be wider."""
    sonar = make_sonar(90.0, 5, 6.0, beam_azimuths_deg=(-40.0, -11.0, 0.5, 1.0, 44.0))
    support_rad = Acoustics.physical().receive_support_rad(sonar)
    fan = make_fan(sonar, sg.Sampling(0.25, 16), BeamShape(support_rad, is_box=False))
    widest_rad, n = np.diff(fan.column_edges_rad).max(), fan.n_columns // len(fan.sectors)
    # 24 fewer would be wider
    assert widest_rad <= math.radians(0.5) / 2 * (1 + 1e-9) < widest_rad * n / (n - 24)


@pytest.mark.parametrize("width_deg", [8.0, 30.0])
def test_columns_of_boxes_follow_the_transmit_beam(width_deg):
    """A box of 40 degrees, whose column would be as wide, has 16 columns in the width of the transmit beam."""
    beams = BeamShape(math.radians(20.0), transmit_width_rad=math.radians(width_deg))
    fan = make_fan(make_sonar(40.0, 1, 40.0), sg.Sampling(100, 16), beams)
    widths_deg = np.degrees(np.diff(fan.column_edges_rad))
    assert widths_deg.max() <= width_deg / 16 * (1 + 1e-9) and widths_deg.min() > width_deg / 32
    assert widths_deg.sum() == pytest.approx(40.0, abs=1e-9)


@pytest.mark.parametrize("fov_deg", [150.0, 60.0])
def test_the_fan_of_a_straight_array_ends_beside_it(fov_deg):
    """It receives nothing from behind, and cones end 6 degrees before; boxes and arrays steered alike go on."""
    sonar, support_rad = make_sonar(fov_deg, 32, 4.0), math.radians(45.0)
    reach = sonar.azimuth_rad[-1] + support_rad
    straight = make_sonar(fov_deg, 32, 4.0, steered="straight")
    for one, beams, end in (
        (sonar, BeamShape(support_rad, is_box=False), reach),
        (straight, BeamShape(support_rad), reach),
        (straight, BeamShape(support_rad, is_box=False), min(reach, math.pi / 2)),
        (straight, BeamShape(support_rad, is_box=False, are_cones=True), min(reach, math.radians(84.0))),
    ):
        assert ends_of_fan_rad(one, beams) == pytest.approx((-end, end), rel=1e-12)


def test_side_lobes_have_wider_and_higher_samples_from_one_sector_to_the_next():
    """4 times at first, then twice as many times each time; and an angle takes more of tan φ there.

    The samples of the aperture are so small that each sector has more rows than its least number.
    """
    sampling = sg.Sampling(40, 4000)
    beams = BeamShape(math.radians(0.5), max_elevation_deg=89.5)
    fan = make_fan(make_sonar(20.0, 90, elevation_fov_deg=54.0), sampling, beams)
    dense, *others = fan.sectors
    row, column, width = dense.v[2], dense.u[1], 2 * math.tan(dense.half_width_rad)
    assert row == pytest.approx(2 * math.tan(math.radians(27.0)) / 4000, rel=1e-12)
    above = sorted((one for one in others if one.tan_low > 0), key=lambda one: one.tan_low)
    below = sorted((one for one in others if one.tan_low < 0), key=lambda one: -one.tan_high)
    assert len(above) == len(below) == 4
    for number, (one, mirrored) in enumerate(zip(above, below, strict=True)):
        assert (mirrored.tan_low, mirrored.tan_high) == (-one.tan_high, -one.tan_low)
        assert (mirrored.rows, mirrored.columns) == (one.rows, one.columns)
        level = 1 + one.tan_low**2
        height, coarser = one.tan_high - one.tan_low, 4 * 2**number
        if number < len(above) - 1:
            assert height == pytest.approx(0.75 * level, rel=1e-12)
        for found, wanted in (
            (height / one.v[2], height / (coarser * row * level)),
            (width / one.u[1], width / (coarser * column * math.sqrt(level))),
        ):
            assert wanted - 1e-6 <= found < wanted + 1 - 1e-6  # the whole number from there on
    last = math.atan(above[-1].tan_high) - math.atan(above[-1].tan_low)
    assert last >= math.radians(1.0) and math.degrees(math.atan(above[-1].tan_high)) == pytest.approx(89.5)


@pytest.mark.parametrize(("max_deg", "n_bands"), [(86.0, 3), (87.0, 3), (87.5, 4)])
def test_no_sector_of_side_lobes_is_lower_than_a_degree(max_deg, n_bands):
    """A third one ends at 86.27 degrees, or goes on to the limit if less than a degree would be left."""
    beams = BeamShape(math.radians(0.5), max_elevation_deg=max_deg)
    fan = make_fan(make_sonar(20.0, 90, elevation_fov_deg=54.0), sg.Sampling(2, 20), beams)
    above = [one for one in fan.sectors if one.tan_low > 0]
    heights = [math.atan(one.tan_high) - math.atan(one.tan_low) for one in above]
    assert len(above) == n_bands and min(heights) >= math.radians(1.0)
    assert max(math.atan(one.tan_high) for one in above) == pytest.approx(math.radians(max_deg), rel=1e-12)


def test_sectors_of_side_lobes_have_16_rows_at_least():
    """With 4, a bin of the first bottom return is 1.2 dB too low where two sectors meet."""
    beams = BeamShape(math.radians(0.5), max_elevation_deg=89.5)
    fan = make_fan(make_sonar(20.0, 90, elevation_fov_deg=54.0), sg.Sampling(2, 20), beams)
    heights = [(one.tan_high - one.tan_low) / one.v[2] for one in fan.sectors[1:]]
    assert len(heights) == 8 and min(heights) >= 16 - 1e-9


def test_where_the_aperture_is_dense_rows_are_as_high_as_asked_for():
    """Up to 10 of 27 degrees; a whole row is the least that is more."""
    beams = BeamShape(math.radians(0.5), dense_elevation_deg=10.0)
    fan = make_fan(make_sonar(20.0, 90, elevation_fov_deg=54.0), sg.Sampling(2, 200), beams)
    dense, row = fan.sectors[0], 2 * math.tan(math.radians(27.0)) / 200
    assert dense.tan_high == -dense.tan_low == pytest.approx(math.tan(math.radians(10.0)), rel=1e-12)
    height = dense.tan_high - dense.tan_low
    assert height / dense.v[2] == pytest.approx(math.ceil(height / row), rel=1e-12)
    # what is left of the aperture lies above and below, up to its ends
    (above,) = (one for one in fan.sectors if one.tan_low > 0)
    (below,) = (one for one in fan.sectors if one.tan_high < 0)
    assert (above.tan_low, below.tan_high) == (dense.tan_high, dense.tan_low)
    assert above.tan_high == -below.tan_low == pytest.approx(math.tan(math.radians(27.0)), rel=1e-12)


@pytest.mark.parametrize("fov_deg", [60.0, 120.0])
def test_sectors_of_cones_are_as_dense_as_those_that_hold_the_columns_at_the_horizon(fov_deg):
    """Cones bend outwards above it, so that their sectors reach further aside, with as many more samples."""
    sonar, support_rad = make_sonar(fov_deg, 64, 1.0, steered="straight"), math.radians(4.0)
    flat, cones = (
        make_fan(sonar, sg.Sampling(4, 40), BeamShape(support_rad, is_box=False, are_cones=are_cones))
        for are_cones in (False, True)
    )

    def samples_per_rad(fan):
        one = fan.sectors[0]
        return one.half_width_rad, math.tan(one.half_width_rad) / one.u[1] / one.half_width_rad

    (narrow, wanted), (wide, found) = samples_per_rad(flat), samples_per_rad(cones)
    assert wide > narrow * 1.001
    assert wanted * (1 - 1e-9) <= found < wanted * 1.02
