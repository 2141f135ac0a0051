"""Wide columns, into which the sectors of side lobes are summed: where they lie, and what columns take of them."""

import math
from dataclasses import replace

import numpy as np
import pytest

import sonar_gl as sg
from sonar_gl.beamform.beamformer import make_beamformer
from sonar_gl.sonar import fan as fan_module
from sonar_gl.sonar.fan import BeamShape, make_fan
from sonar_gl.sonar.samples import SectorSamples, ViewSamples
from sonar_gl.sonar.sector import SHEAR
from tests.support.fans import make_sonar

PHYSICAL = sg.Acoustics.physical()
SONARS = {
    "one sector": make_sonar(45.0, 256, 1.0),
    "odd columns": make_sonar(45.0, 255, 1.0),
    "three sectors": make_sonar(130.0, 512, 1.0),
    "full circle": make_sonar(360.0, 180, 10.0),
    "table": make_sonar(90.0, 5, 20.0, beam_azimuths_deg=(-40.0, -11.0, 0.5, 1.0, 44.0)),
}


def fan_of(sonar, samples_per_beam=2.0, box=False, **more):
    """Return a fan with side lobes in elevation."""
    beams = BeamShape(PHYSICAL.receive_support_rad(sonar), box, max_elevation_deg=89.5)
    return make_fan(sonar, sg.Sampling(samples_per_beam, 40), beams, **more)


@pytest.mark.parametrize("name", SONARS)
def test_strips_of_side_lobes_cover_wide_columns_once(name):
    fan = fan_of(SONARS[name])
    edges = fan.column_edges_rad[fan.wide_edges]
    assert fan.wide_edges[0] == 0 and fan.wide_edges[-1] == fan.n_columns
    assert 1 < fan.n_wide_columns < fan.n_columns
    dense = [sector for sector in fan.sectors if sector.tan_low == fan.sectors[0].tan_low]
    n_bands, of_side_lobes = len(fan.sectors) // len(dense), fan.sectors[len(dense) :]
    assert max(sector.strips.column.max() for sector in dense) == fan.n_columns - 1
    widths = np.zeros(fan.n_wide_columns)
    for sector in of_side_lobes:
        strips = sector.strips
        low = sector.azimuth_rad - np.arctan(strips.middle + strips.width / 2)
        high = sector.azimuth_rad - np.arctan(strips.middle - strips.width / 2)
        column = strips.column - fan.n_columns
        assert (low > edges[column] - 1e-9).all() and (high < edges[column + 1] + 1e-9).all()
        np.add.at(widths, column, high - low)
    np.testing.assert_allclose(widths, (n_bands - 1) * np.diff(edges), rtol=1e-9, atol=1e-12)
    # each column takes its share by width, and all shares of a wide column make one
    widths = np.diff(fan.column_edges_rad)
    np.testing.assert_allclose(np.add.reduceat(fan.wide_shares, fan.wide_edges[:-1]), 1.0, rtol=1e-6)
    np.testing.assert_allclose(
        fan.wide_shares * np.repeat(np.diff(edges), np.diff(fan.wide_edges)), widths, rtol=1e-6
    )


@pytest.mark.parametrize("samples_per_beam", [0.25, 1.0, 4.0])
def test_wide_columns_are_as_wide_as_samples_but_far_narrower_than_beams(samples_per_beam):
    sonar = SONARS["one sector"]
    fan, support_rad = fan_of(sonar, samples_per_beam), PHYSICAL.receive_support_rad(sonar)
    width = math.radians(45.0 / 256) / samples_per_beam * fan_module.SKIRTS_COARSER
    width = min(width, support_rad / fan_module.WIDE_COLUMNS_PER_SUPPORT)
    column = np.diff(fan.column_edges_rad).max()
    found = np.diff(fan.column_edges_rad[fan.wide_edges])
    # they are made of whole columns, an odd number of which needs an odd number of wide ones
    assert width - 2 * column < found.mean() and found.max() < width + 0.501 * column
    assert found.max() < math.radians(1.0) / 2.5  # of the −3 dB width of a beam


@pytest.mark.parametrize("name", SONARS)
def test_a_mirrored_fan_has_mirrored_wide_columns(name):
    """Image sources are summed in the columns of the mirror image of their fan."""
    sonar, azimuths = SONARS[name], SONARS[name].azimuth_rad
    mirrored = replace(sonar, beam_azimuths_deg=tuple(np.degrees(-azimuths[::-1])))
    one, other = fan_of(sonar), fan_of(mirrored)
    np.testing.assert_array_equal(other.wide_edges, one.n_columns - one.wide_edges[::-1])


@pytest.mark.parametrize("name", ["one sector", "odd columns", "three sectors", "full circle"])
def test_strips_of_a_mirror_image_lie_in_the_columns_of_the_other_side(name):
    """Of these sonars the fan is its own mirror image."""
    beamformer = make_beamformer(SONARS[name], PHYSICAL, sg.Sampling(2, 40))
    fan = beamformer.fan
    edges = fan.column_edges_rad
    low = np.append(edges[:-1], edges[fan.wide_edges[:-1]])
    high = np.append(edges[1:], edges[fan.wide_edges[1:]])
    rows = []
    for half in beamformer.mirrored_strips:
        for sector, (column, u, *_) in zip(fan.sectors, half, strict=True):
            azimuth = -(sector.azimuth_rad - np.arctan(u))
            assert ((low[column] < azimuth) & (azimuth < high[column])).all()
            rows.append(column)
    assert set(np.concatenate(rows).tolist()) == set(range(fan.n_columns + fan.n_wide_columns))


def test_fans_without_side_lobes_and_of_boxes_have_none():
    sonar = SONARS["one sector"]
    plain = make_fan(sonar, sg.Sampling(2, 40), BeamShape(PHYSICAL.receive_support_rad(sonar), is_box=False))
    for fan in (plain, fan_of(sonar, box=True)):
        assert fan.n_wide_columns == 0
        assert max(sector.strips.column.max() for sector in fan.sectors) == fan.n_columns - 1


def shell(beamformer, range_m=7.0):
    """Return samples of a sphere about the sonar that returns 1 per steradian, as body 1."""
    out = []
    for sector in beamformer.fan.sectors:
        u, v = sector.sample_coordinates()
        length = np.sqrt(1 + u * u + v * v)
        slope = 1 / (length * range_m)  # of 1/x, over u and over v
        plane_echo = np.stack([length / range_m, u * slope, v * slope, np.full_like(u, range_m)], -1)
        body_id = np.ones(u.shape, np.uint16)
        out.append(SectorSamples(sector, plane_echo.astype(np.float32), body_id))
    return out


@pytest.mark.parametrize("name", SONARS)
def test_each_beam_receives_the_same_of_a_sphere_about_the_sonar(name):
    """And of its part in the side lobes their share. The elevation pattern is that of the middles of samples, of which
    those of the side lobes are four and more times as high."""
    beamformer = make_beamformer(SONARS[name], PHYSICAL, sg.Sampling(4, 80))
    sines = np.linspace(0, beamformer.fan.max_sine, 100_001)
    power = PHYSICAL.two_way_elevation_pattern(SONARS[name])(sines)
    is_coarse = sines > math.sin(math.radians(PHYSICAL.dense_elevation_deg(SONARS[name])))
    share = power[is_coarse].sum() / power.sum()
    assert beamformer.fan.n_wide_columns > 1
    of_side_lobes = [
        one if one.sector.tan_low * one.sector.tan_high > 0 else one._replace(plane_echo=one.plane_echo * 0)
        for one in shell(beamformer)
    ]
    for samples, exact, error in ((shell(beamformer), 1.0, 1e-3), (of_side_lobes, share, 1e-2)):
        beams = beamformer.sum_footprints(samples).intensity.sum(axis=1, dtype=float)
        np.testing.assert_allclose(beams, exact, rtol=error)


@pytest.mark.parametrize("name", SONARS)
def test_labels_take_their_shares_of_wide_columns(name):
    """The echo of a body that fills the view is that of the ping, but for far side lobes in azimuth."""
    acoustics = replace(PHYSICAL, far_side_lobes=False)
    beamformer = make_beamformer(SONARS[name], acoustics, sg.Sampling(4, 80))
    samples, gain = shell(beamformer), np.ones(SONARS[name].n_bins, np.float32)
    echo = beamformer.sum_footprints(samples).intensity
    found = beamformer.find_labels(beamformer.sum_bodies(ViewSamples(tuple(samples)), gain)[1], gain, 1)
    np.testing.assert_allclose(found.body_echo, [0.0, echo.sum(dtype=float)], rtol=1e-5)  # float32 sums
    np.testing.assert_array_equal(found.body_id, echo > 0)


def test_each_body_of_the_side_lobes_has_its_label():
    """Two halves of a sphere, below and above the sonar: each has half of the echo, in side lobes alone."""
    acoustics = replace(PHYSICAL, far_side_lobes=False)
    beamformer = make_beamformer(SONARS["odd columns"], acoustics, sg.Sampling(4, 80))
    samples = []
    for one in shell(beamformer):
        _, v = one.sector.sample_coordinates()
        is_kept = one.sector.tan_low * one.sector.tan_high > 0
        body_id = np.where(v < 0, 1, 2).astype(np.uint16)
        samples.append(one._replace(plane_echo=one.plane_echo * is_kept, body_id=body_id))
    gain = np.ones(100, np.float32)
    whole = beamformer.sum_footprints(samples).total
    _, bodies = beamformer.sum_bodies(ViewSamples(tuple(samples)), gain)
    body_echo = beamformer.find_labels(bodies, gain, 2).body_echo
    # the lattice of one half is that of the other turned by half a circle
    np.testing.assert_allclose(body_echo, [0.0, whole / 2, whole / 2], rtol=1e-5)  # float32 sums


@pytest.mark.parametrize("samples_per_beam", [0.7, 2.0])
def test_the_lattice_that_a_ping_is_compared_with_has_wider_ones(samples_per_beam):
    """Were they the same, the difference of the two would not hold the error that they make."""
    for sonar in SONARS.values():
        fewer = fan_of(sonar, samples_per_beam / math.sqrt(2), shear=-SHEAR)
        assert fewer.n_wide_columns < fan_of(sonar, samples_per_beam).n_wide_columns
