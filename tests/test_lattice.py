"""The fan's geometry: cells fill the fan once, columns end where beams do, beams weigh their solid angle."""

import math
from dataclasses import replace

import numpy as np
import pytest

import sonar_gl as sg
from sonar_gl.acoustics import Acoustics
from sonar_gl.fan import beam_weights, make_fan, rung_sampling


def sonar(fov=45.0, beams=64, width=1.0, elevation=20.0, **more):
    return sg.Sonar("test", 900e3, beams, 100, fov, elevation, width, 0.5, 30.0, **more)


def fan_of(it, columns=2.0, rows=32):
    return make_fan(it, sg.Sampling(columns, rows), math.radians(it.beam_width_deg) / 2)


@pytest.mark.parametrize("fov", [8.0, 20.0, 45.0, 130.0, 180.0, 359.5, 360.0])
def test_strips_cover_the_fan_once(fov):
    it = sonar(fov, width=min(1.0, fov))
    fan = fan_of(it)
    span = min(2 * math.pi, it.azimuth_rad[-1] - it.azimuth_rad[0] + math.radians(it.beam_width_deg))
    assert fan.column_edges_rad[-1] - fan.column_edges_rad[0] == pytest.approx(span, abs=1e-9)
    assert (np.diff(fan.column_edges_rad) > 0).all()
    widths = np.zeros(fan.n_columns)
    for sector in fan.sectors:
        assert 2 * sector.half_width_rad <= math.radians(60) + 1e-9
        parts = sector.parts
        azimuth = sector.azimuth_rad - np.arctan(
            np.stack([parts.u + parts.width / 2, parts.u - parts.width / 2])
        )
        np.add.at(widths, parts.column, azimuth[1] - azimuth[0])
        # a strip lies in its column, and a sample stands for no more than one and a half of its own width
        assert (azimuth[0] > fan.column_edges_rad[parts.column] - 1e-9).all()
        assert (azimuth[1] < fan.column_edges_rad[parts.column + 1] + 1e-9).all()
        assert (parts.width < 1.5 * sector.u[1] + 1e-12).all()
    np.testing.assert_allclose(widths, np.diff(fan.column_edges_rad), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("fov", [20.0, 60.0, 130.0])
def test_a_ray_is_near_every_strip_in_every_row(fov):
    for sector in fan_of(sonar(fov)).sectors:
        u, _ = sector.rays()
        for j in range(sector.rows):
            away = np.abs(u[j, :, None] - sector.parts.u).min(axis=0)
            assert away.max() <= sector.u[1] / 2 + 1e-12


def test_rows_reach_beyond_the_aperture_wherever_the_shear_shifts_them():
    for sector in fan_of(sonar(100.0)).sectors:
        u, v = sector.rays()
        for part in sector.parts.u:
            i = np.abs(u - part).argmin(axis=1)
            at = v[np.arange(sector.rows), i]
            top = sector.tan_elevation * math.sqrt(1 + part * part)
            spacing = sector.v[2]
            assert at[0] < -top + spacing
            assert at[-1] > top - spacing
            assert np.diff(at).max() <= spacing * 1.2


def test_rays_of_neighbouring_rows_look_elsewhere_in_the_strip():
    """The plain grid would look at the same place in every row; ours sweeps the strip several times."""
    sector = fan_of(sonar()).sectors[0]
    u, _ = sector.rays()
    offset = u - sector.parts.u[10]
    offset = np.take_along_axis(offset, np.abs(offset).argmin(axis=1)[:, None], axis=1) / sector.u[1]
    assert np.histogram(offset, bins=4, range=(-0.5, 0.5))[0].min() >= 0.15 * sector.rows
    plain = make_fan(sonar(), sg.Sampling(2, 32), math.radians(0.5), shear=0.0).sectors[0]
    assert np.ptp(plain.rays()[0][:, 5]) == 0


def test_projection_puts_rays_on_pixel_centres():
    for sector in fan_of(sonar(130.0)).sectors:
        clip_from_sonar = sector.projection(1e-3, 100.0)
        u, v = sector.rays()
        rays = np.stack([np.ones_like(u), -u, v], axis=-1) @ sector.rotation()
        clip = np.concatenate([7.0 * rays, np.ones((*u.shape, 1))], axis=-1) @ clip_from_sonar.T
        pixels = (clip[..., :2] / clip[..., 3:] + 1) / 2 * [sector.columns, sector.rows]
        j, i = np.mgrid[0 : sector.rows, 0 : sector.columns]
        np.testing.assert_allclose(pixels[..., 0], i + 0.5, atol=1e-9)
        np.testing.assert_allclose(pixels[..., 1], j + 0.5, atol=1e-9)
        np.testing.assert_allclose(clip[..., 3], 7.0)  # w is x of the sector's frame: 1/w is what is stored


TABLES = {
    "even": sonar(45.0, 64, 1.0),
    "contiguous": sonar(45.0, 64, 45 / 64),
    "apart": sonar(45.0, 16, 0.3),
    "full circle": sonar(360.0, 90, 6.0),
    "wider than the circle": sonar(360.0, 4, 170.0),
    "one beam": sonar(10.0, 1, 10.0),
    "table": sonar(90.0, 5, 2.0, beam_azimuths_deg=(-40.0, -11.0, 0.5, 1.0, 44.0)),
}


@pytest.mark.parametrize("name", TABLES)
@pytest.mark.parametrize("acoustics", [Acoustics.ideal(), Acoustics.physical()], ids=["box", "line array"])
def test_a_beam_weighs_to_one(name, acoustics):
    """Columns filled with their own solid angle give 1 in every beam."""
    it = TABLES[name]
    pattern, reach = acoustics.beam_pattern_function(it), acoustics.beam_reach_rad(it)
    fan = make_fan(it, sg.Sampling(4, 16), reach, box=pattern is None)
    first, weights = beam_weights(fan, pattern, reach)
    aperture = 2 * math.sin(math.radians(it.elevation_fov_deg) / 2)
    solid = np.diff(fan.column_edges_rad) * aperture
    index = (first[:, None] + np.arange(weights.shape[1])) % fan.n_columns
    np.testing.assert_allclose((weights * solid[index]).sum(axis=1), 1.0, rtol=1e-5)  # float32 weights
    assert (weights >= 0).all()


@pytest.mark.parametrize("name", ["even", "contiguous", "apart", "full circle", "table"])
def test_box_beams_hear_whole_columns_only(name):
    """Columns end where beams do, so that no beam has to guess what part of a column it hears."""
    it = TABLES[name]
    reach = math.radians(it.beam_width_deg) / 2
    fan = make_fan(it, sg.Sampling(4, 16), reach)
    _, weights = beam_weights(fan, None, reach)
    shares = weights * it.beam_width_deg * math.pi / 180 * 2 * math.sin(math.radians(10))
    assert ((np.abs(shares) < 1e-5) | (np.abs(shares - 1) < 1e-5)).all()


def test_samples_of_a_rung():
    it = sg.load_sonar("p900-45")
    aperture_deg = math.degrees(2 * math.tan(math.radians(it.elevation_fov_deg) / 2))
    assert rung_sampling(it, 0.2) == sg.Sampling(45 / 0.2 / it.n_beams, math.ceil(aperture_deg / 0.2))
    # however coarse, some columns and rows; however fine, no more than a Sampling may have
    assert rung_sampling(it, 90.0) == sg.Sampling(24 / it.n_beams, math.ceil(aperture_deg / 0.5))
    assert rung_sampling(replace(it, n_beams=1), 1e-4) == sg.Sampling(1024, 16000)


@pytest.mark.parametrize("width, columns_per_spacing", [(0.05, 3.516), (0.5, 2), (90.0, 0.25)])
def test_columns_of_a_smooth_pattern(width, columns_per_spacing):
    """As wide as a sample, at most half a spacing; beams far wider than that need fewer."""
    it = sonar(beams=256, width=width)
    reach = Acoustics.physical().beam_reach_rad(it)
    samples = {0.05: 3.516, 0.5: 1.0, 90.0: 4.0}[width]
    fan = make_fan(it, sg.Sampling(samples, 16), reach, box=False)
    edges = fan.column_edges_rad
    per_spacing = math.radians(45 / 256) * fan.n_columns / (edges[-1] - edges[0])
    assert per_spacing == pytest.approx(columns_per_spacing, rel=0.02)


@pytest.mark.parametrize(
    "make, message",
    [
        (lambda: sg.Sampling(0, 10), "columns_per_beam must be a number in 0..1024 (got 0)"),
        (lambda: sg.Sampling(2, 0), "rows must be a whole number in 1..16000 (got 0)"),
        (lambda: sg.Sampling(2, 10, "mean"), "reducer must be one of footprint, point (got 'mean')"),
    ],
)
def test_errors(make, message):
    with pytest.raises(sg.Error) as caught:
        make()
    assert str(caught.value) == message
