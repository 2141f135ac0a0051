"""The samples on each body: their number, their echo, and how well so many show it."""

import math
from dataclasses import replace

import numpy as np
import pytest

import sonar_gl as sg
from sonar_gl.beamform.received import received_parts
from sonar_gl.engine.body_counts import body_error, count_bodies
from sonar_gl.engine.reception import Reception
from sonar_gl.sonar.fan import BeamShape, make_fan
from sonar_gl.sonar.samples import SectorSamples, ViewSamples, sector_table
from sonar_gl.sonar.sector import SHEAR
from tests.support.sampled_scenes import SONAR


def parts_of(fan):
    """What beams receive of the sectors of a fan, without gaps between them."""
    return received_parts(fan.sectors, [np.empty(0)] * len(fan.sectors))


def view_of(samples):
    """Lay the samples of sectors side by side, as engines do."""
    n_rows = max(one.sector.rows for one in samples)
    left = np.cumsum([0, *(one.sector.columns for one in samples)])
    plane_echo, body_id = np.zeros((n_rows, left[-1], 4), np.float32), np.zeros((n_rows, left[-1]), np.uint16)
    for one, first, past in zip(samples, left[:-1], left[1:], strict=True):
        plane_echo[: one.sector.rows, first:past] = one.plane_echo
        body_id[: one.sector.rows, first:past] = one.body_id
    table = tuple(sector_table([one.sector for one in samples], left[:-1]))
    return ViewSamples(tuple(samples), plane_echo, tuple(left[:-1]), body_id=body_id, table=table)


def sphere_samples(sector, body_id, echo=1.0):
    """Return the samples of a sphere of 5 m about the sonar, whose bodies and echo are given."""
    u, v = sector.sample_coordinates()
    q = np.sqrt(1 + u * u + v * v) / 5
    plane_echo = np.stack([q, 0 * q, 0 * q, echo + 0 * q], axis=-1).astype(np.float32)
    return SectorSamples(sector, plane_echo, np.broadcast_to(body_id, u.shape).astype(np.uint16))


def counts_of(fan, samples, n_bodies=1):
    """Count the samples of the sectors of a fan, of which all is received alike."""
    gain = np.ones(SONAR.n_bins, np.float32)
    reception = Reception(SONAR, 0.0, fan.max_elevation_rad, False, gain, np.empty(0), parts_of(fan))
    return count_bodies(view_of(samples), n_bodies, reception)


def test_samples_are_counted_in_the_fan_and_the_aperture_alone():
    """Planes of elevation bound the aperture and curve on the image plane: rows at the sides of a sector count.

    Those that only fill sheared rows, beside the sector, do not.
    """
    fan = make_fan(replace(SONAR, azimuth_fov_deg=100.0), sg.Sampling(2, 40), BeamShape(0.0))
    samples, expected = [], 0
    for sector in fan.sectors:
        u, v = sector.sample_coordinates()
        inside = np.abs(np.arctan(u)) < sector.half_width_rad
        expected += (inside & (np.abs(np.arctan2(v, np.hypot(1, u))) < math.radians(10))).sum()
        samples.append(sphere_samples(sector, 1))
    assert counts_of(fan, samples).samples.tolist() == [0, expected]


@pytest.mark.parametrize(
    "is_met, strands, runs",
    [
        (lambda i, j: (i < 20) & (j < 12), 0, 12),
        (lambda i, j: (i < 30) & (j < 20) & ((i + 2 * j) % 5 == 0), 120, 120),
        (lambda i, j: (i < 40) & (j < 40) & (i == j), 0, 40),
        (lambda i, j: (i < 40) & (j == i // 20), 0, 2),
    ],
    ids=["box", "net", "wire", "wire along rows"],
)
def test_strands_are_the_runs_of_samples_on_a_body_of_many_thin_parts(is_met, strands, runs):
    fan = make_fan(SONAR, sg.Sampling(2, 60), BeamShape(0.0))
    (sector,) = fan.sectors
    j, i = np.indices((sector.rows, sector.columns))
    is_on = (i >= 40) & (j >= 10) & is_met(i - 40, j - 10)
    found = counts_of(fan, [sphere_samples(sector, is_on, is_on)])
    assert found.samples[1] == is_on.sum()
    assert found.strands.tolist() == [0, strands]
    assert found.runs.tolist() == [0, runs]


@pytest.mark.parametrize(
    "columns_per_beam", [2.0, 2.6, 0.7], ids=["as wide", "narrower", "columns finer than samples"]
)
def test_the_echo_of_strips_is_what_the_nearest_samples_of_upright_rods_give_them(columns_per_beam):
    """Of rods all over the fan, strip by strip; together they have the echo of the samples."""
    fan = make_fan(SONAR, sg.Sampling(columns_per_beam, 60), BeamShape(0.0))
    (sector,) = fan.sectors
    u, v = sector.sample_coordinates()
    place = np.floor((u - u.min()) / (0.3 * sector.u[1])).astype(int)
    found = counts_of(fan, [sphere_samples(sector, 1 + place)], place.max() + 1)
    expected, rows = np.zeros(place.max() + 2), np.arange(sector.rows)
    of_area = (1 + u * u + v * v) ** -1.5  # steradians per du dv
    for middle, width in zip(sector.strips.middle, sector.strips.width, strict=True):
        nearest = np.abs(u - middle).argmin(axis=1)
        holds = sector.holds_elevation(u[rows, nearest], v[rows, nearest])
        np.add.at(expected, 1 + place[rows, nearest], holds * of_area[rows, nearest] * width)
    is_seen = found.echo > 0
    scale = expected.sum() / found.of_strips.sum()
    np.testing.assert_allclose(
        found.of_strips[is_seen] * scale, expected[is_seen], rtol=1e-3, atol=1e-3 * expected.max()
    )
    assert found.of_strips.sum() == pytest.approx(found.echo.sum(), rel=0.01)
    apart = np.abs(found.of_strips - found.echo)[is_seen] / found.echo[is_seen]
    assert np.median(apart) < 0.05 if columns_per_beam == 2.0 else np.median(apart) > 0.1


@pytest.mark.parametrize("stripes", ["along rows", "across rows"])
def test_the_echo_of_a_body_and_its_unevenness_are_those_of_its_samples(stripes):
    """By NumPy: of stripes of reflectivities at random, at other ranges in each row; they show across them alone.

    Or by every third row alone.
    """
    fan, random = make_fan(SONAR, sg.Sampling(2, 60), BeamShape(0.0)), np.random.default_rng(0)
    (sector,) = fan.sectors
    u, v = sector.sample_coordinates()
    j, i = np.indices(u.shape)
    is_on, length = (i >= 40) & (i < 70) & (j >= 20) & (j < 40), np.sqrt(1 + u * u + v * v)
    mu = np.where(is_on, random.random(200)[i if stripes == "across rows" else j], 0.0)
    q, gain = length / SONAR.range_m[40 + j], random.random(SONAR.n_bins).astype(np.float32)
    plane_echo = np.stack([q, 0 * q, 0 * q, mu * length / q], axis=-1).astype(np.float32)
    table = 1 + np.linspace(-1, 1, 4001)  # of a pattern that rises with the sine of the elevation
    reception = Reception(SONAR, 0.0, fan.max_elevation_rad, False, gain, table, parts_of(fan))
    view = view_of([SectorSamples(sector, plane_echo, is_on.astype(np.uint16))])
    found, thinned = (count_bodies(view, 1, reception, every=every) for every in (1, 3))
    angle = np.linalg.det(sector.steps) / length**3
    echo = mu * angle * gain[40 + j] * (1 + v / length)
    assert found.samples.tolist() == [0, 600]
    assert found.echo[1] == pytest.approx(echo.sum(), rel=1e-3)  # the nearest entry of the table
    assert thinned.samples.tolist() == [0, 210]
    assert thinned.echo[1] == pytest.approx(3 * echo[::3].sum(), rel=1e-3)  # as high as three rows
    inside = echo[20:40, 40:70]
    both = ((np.diff(inside, axis=axis) ** 2).sum() for axis in (0, 1))
    assert found.unevenness[1] == pytest.approx(math.sqrt(max(both) / 2), rel=1e-3)


@pytest.mark.parametrize("n", [100, 400])
@pytest.mark.parametrize(
    "is_met", [lambda p: np.hypot(*p.T) < 1 / math.sqrt(math.pi), lambda p: abs(p).max(1) < 0.5]
)
def test_the_error_by_the_number_of_samples_bounds_that_of_discs_and_squares(n, is_met):
    """Of a solid angle by counting a sheared lattice, anywhere and turned at random: in 95 of 100 cases it is less.

    The bound, which was fitted to bodies of all shapes, is no more than three times as large.
    """
    rng, reach = np.random.default_rng(0), math.ceil(0.75 * math.sqrt(n)) + 2
    rows, columns = np.indices((2 * reach + 1, 2 * reach + 1)).reshape(2, -1) - reach
    lattice, errors = np.stack([columns + SHEAR * rows, rows], axis=1), []
    for _ in range(100):
        turn = rng.uniform(0, math.pi)
        rotation = np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
        met = is_met((lattice - rng.uniform(-0.5, 0.5, 2)) @ rotation / math.sqrt(n))
        errors.append(abs(met.sum() / n - 1))
    bound = body_error(float(n))
    assert bound / 3 < np.quantile(errors, 0.95) < bound


def test_the_error_of_wires_falls_as_the_root_of_their_samples_alone():
    """Of many thin parts nearly all samples lie along an outline; of a compact body the root of them does."""
    for n in (100.0, 10_000.0):
        compact, wires = body_error(n), body_error(n, n)
        assert wires / compact == pytest.approx(n**0.25, rel=1e-12)
        assert body_error(n, math.sqrt(n) / 2) == compact  # fewer runs than an outline has
    few = body_error(1e6) / body_error(16e6)
    assert few == pytest.approx(8, rel=1e-4)  # 16 to the power of 3/4
