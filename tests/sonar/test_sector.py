"""The lattice of samples and the strips of a sector."""

import math

import numpy as np
import pytest

import sonar_gl as sg
from sonar_gl.sonar.fan import BeamShape, make_fan
from sonar_gl.sonar.sector import merge_close_azimuths
from tests.support.fans import box_fan, make_sonar


@pytest.mark.parametrize("fov_deg", [20.0, 60.0, 130.0])
def test_every_row_has_a_sample_within_half_a_sample_of_each_strip(fov_deg):
    for sector in box_fan(make_sonar(fov_deg)).sectors:
        u, _ = sector.sample_coordinates()
        for j in range(sector.rows):
            distance = np.abs(u[j, :, None] - sector.strips.middle).min(axis=0)
            assert distance.max() <= sector.u[1] / 2 + 1e-12


def test_rows_cover_the_aperture_in_every_strip_in_spite_of_the_shear():
    for sector in box_fan(make_sonar(100.0)).sectors:
        u, v = sector.sample_coordinates()
        for strip_u in sector.strips.middle:
            i = np.abs(u - strip_u).argmin(axis=1)
            strip_v = v[np.arange(sector.rows), i]
            top = sector.tan_high * math.sqrt(1 + strip_u * strip_u)
            spacing = sector.v[2]
            assert strip_v[0] < -top + spacing
            assert strip_v[-1] > top - spacing
            assert np.diff(strip_v).max() <= spacing * 1.2


def test_rows_sample_a_strip_at_different_places():
    """The nearest samples of the rows are spread over the width of a strip; those of a plain grid all coincide."""
    sector = box_fan(make_sonar()).sectors[0]
    u, _ = sector.sample_coordinates()
    offset = u - sector.strips.middle[10]
    offset = np.take_along_axis(offset, np.abs(offset).argmin(axis=1)[:, None], axis=1) / sector.u[1]
    assert np.histogram(offset, bins=4, range=(-0.5, 0.5))[0].min() >= 0.15 * sector.rows
    plain = make_fan(make_sonar(), sg.Sampling(2, 32), BeamShape(math.radians(0.5)), shear=0.0).sectors[0]
    u, v = plain.sample_coordinates()
    assert np.ptp(u, axis=0).max() == 0 and np.ptp(v, axis=1).max() == 0


def test_negative_shear_mirrors_the_lattice():
    fan = box_fan(make_sonar(130.0))
    mirrored = make_fan(fan.sonar, fan.sampling, BeamShape(math.radians(0.5)), shear=-0.2764)
    for sector, image in zip(fan.sectors, mirrored.sectors, strict=True):
        u, v = sector.sample_coordinates()
        image_u, image_v = image.sample_coordinates()
        np.testing.assert_allclose(image_u, -u[:, ::-1], atol=1e-12)
        np.testing.assert_allclose(image_v, v[:, ::-1], atol=1e-12)


def test_projection_puts_samples_on_pixel_centres():
    for sector in box_fan(make_sonar(130.0)).sectors:
        clip_from_sonar = sector.projection(1e-3, 100.0)
        u, v = sector.sample_coordinates()
        rays = np.stack([np.ones_like(u), -u, v], axis=-1) @ sector.rotation()
        clip = np.concatenate([7.0 * rays, np.ones((*u.shape, 1))], axis=-1) @ clip_from_sonar.T
        pixels = (clip[..., :2] / clip[..., 3:] + 1) / 2 * [sector.columns, sector.rows]
        j, i = np.mgrid[0 : sector.rows, 0 : sector.columns]
        np.testing.assert_allclose(pixels[..., 0], i + 0.5, atol=1e-9)
        np.testing.assert_allclose(pixels[..., 1], j + 0.5, atol=1e-9)
        np.testing.assert_allclose(clip[..., 3], 7.0)  # w is x of the sector's frame; samples store 1/w


def test_projection_puts_the_near_and_the_far_plane_at_the_ends_of_clip_space():
    clip_from_sonar = box_fan(make_sonar()).sectors[0].projection(0.5, 100.0)
    clip = clip_from_sonar @ np.array([[0.5, 0, 0, 1], [100, 0, 0, 1]]).T
    np.testing.assert_allclose(clip[2] / clip[3], [-1, 1], rtol=1e-12)


def test_azimuths_closer_than_a_nanoradian_are_merged():
    assert merge_close_azimuths([0.5, -1.0, 0.5 + 9e-10, 0.5 + 3e-9]).tolist() == [-1.0, 0.5, 0.5 + 3e-9]
