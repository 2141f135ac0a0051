"""The compiled kernels against NumPy: the distribution of 1/r over a rectangle, divided into bins."""

import math
import tracemalloc

import numpy as np
import pytest
import trimesh

import sonar_gl as sg
from sonar_gl.beamform.beamformer import FEW_ROWS, Beamformer, make_beamformer
from sonar_gl.beamform.kernels.beams import beam_tiles, weigh_columns
from sonar_gl.beamform.kernels.column_sums import add_points
from sonar_gl.beamform.kernels.range_bins import bin_table
from sonar_gl.beamform.kernels.spreading import SHORT_RAMP, spread_footprints
from sonar_gl.beamform.kernels.work_table import ENERGY, SLANT, A, B, S, make_work
from sonar_gl.beamform.weights import beam_weights
from sonar_gl.core.worker import SecondThread
from sonar_gl.sonar.fan import BeamShape, make_fan
from sonar_gl.sonar.samples import SectorSamples

EDGES = np.linspace(0.5, 30.5, 301)
BINS, WORK = bin_table(EDGES), make_work()  # to make them takes longer than to spread a footprint


def spread(s, a, b, energy=1.0, edges=EDGES, slant=0.0):
    """Return the bins of one footprint, or of several if s, a and b are arrays."""
    s, a, b = np.broadcast_arrays(np.atleast_1d(s), a, b)
    sums, K = np.zeros((3, len(edges) - 1), np.float32), len(edges) - 1
    bins = BINS if edges is EDGES else bin_table(edges)
    spans = np.tile([K, 0], (3, 1))
    sums[[0, 2]] = -0.0  # of other rows, to which another thread may add: not even zeros are added to them
    work, past = WORK, len(s) + 1
    work[:, : 2 * past] = np.nan  # the first and those from the last on are not used
    work[ENERGY, 1:past], work[S, 1:past], work[A, 1:past], work[B, 1:past] = energy, s, a, b
    work[SLANT, 1:past] = slant
    spread_footprints(work, 1, past, sums, spans, 1, bins, SHORT_RAMP)
    assert np.signbit(sums[[0, 2]]).all() and not sums[[0, 2]].any()
    assert (spans[[0, 2]] == [K, 0]).all()
    assert not np.delete(sums[1], slice(*spans[1])).any()  # bins outside of the span are empty
    return sums[1].astype(float)


def brute(s, a, b, slant=0.0):
    """Return the energy s ds by a fine grid over the rectangle; beyond the horizon, s <= 0, there is none.

    It is denser by `slant` at the end of b that is nearer, and less dense by as much at the other one.
    """
    n = 1500 if a and b else 100_000

    def middles(half):
        return half * ((np.arange(n) + 0.5) / n * 2 - 1) if half else np.zeros(1)

    values = s + middles(a)[:, None] + middles(b)[None, :]
    weights = (values * (1 + slant * middles(b) / b) if slant else values).ravel()
    n, values = values.size, values.ravel()
    return np.histogram(1 / values[values > 0], bins=EDGES, weights=weights[values > 0])[0] / n


@pytest.mark.parametrize("slant", [-0.9, 0.0, 0.5])
def test_a_footprint_without_a_width_at_an_edge_of_bins_keeps_its_echo(slant):
    """It has been moved to the end of its body; its density had been divided by its width."""
    s = 1 / EDGES[[1, 30, 299]]
    found = spread(s, 0.0, 0.0, slant=slant)
    assert found.sum() == pytest.approx(s.sum(), rel=1e-6)  # float32


@pytest.mark.parametrize("labels", [False, True])
def test_a_body_that_ends_at_an_edge_of_bins_has_the_echo_that_it_has_within_a_bin(labels):
    """The far side of this ball lies at 3.5 m, and some samples of the side lobes meet it edge-on."""
    ball = sg.Body("ball", trimesh.creation.icosphere(1, 0.5), sg.pose(3), 1.0)
    acoustics, echoes = sg.Acoustics.physical(range_law="constant", pulse=False), []
    for n_bins in (8, 9):  # with an edge there, and without
        sonar = sg.Sonar("coarse", 900e3, 33, n_bins, 40.0, 10.0, 4.0, 0.5, 8.5)
        with sg.Simulator(sg.Scene([ball]), sonar, acoustics, sg.Sampling(1.5, 21)) as simulator:
            echoes.append(simulator.ping(sg.pose(), labels=labels).intensity.sum(dtype=float))
    assert echoes[0] == pytest.approx(echoes[1], rel=1e-6)  # float32


@pytest.mark.parametrize(
    "s, a, b",
    [
        (0.103, 1e-9, 1e-9),  # facing: one bin
        (0.103, 0.0, 0.0),
        (0.1, 0.02, 0.0),  # a box
        (0.1, 0.02, 0.01),  # a trapezoid
        (0.1, 0.015, 0.015),  # a triangle
        (0.5, 1.2, 0.0),  # from before the first bin
        (0.3, 0.28, 0.1),  # the ramp of a trapezoid reaches beyond the horizon
        (0.1, 0.053, 0.2),  # and so does its middle part
    ],
)
def test_spread_is_the_distribution_over_the_rectangle(s, a, b):
    got, want = spread(s, a, b), brute(s, a, b)
    if s - a - b <= 0:
        # a plane cut by its horizon: the energy of the centre is spread over the visible part
        inside = np.linspace(-1, 1, 501)
        visible = np.clip(s + a * inside[:, None] + b * inside[None, :], 0, None).mean()
        want *= s / visible
    np.testing.assert_allclose(got.sum(), want.sum(), rtol=2e-3)
    # 1 %: the grid of the brute force. Ramps shorter than a quarter of the box become steps, which moves
    # thin / (2 wide) of a single sample's energy, and none of a row of samples whose ramps overlap
    thin, wide = min(a, b), max(a, b, 1e-12)
    steps = thin / wide / 2 if 4 * thin < wide else 0.0
    assert np.abs(got - want).sum() <= (0.01 + steps) * want.sum()


@pytest.mark.parametrize("slant", [0.6, *(pytest.param(one, marks=pytest.mark.slow) for one in (-1.0, -0.3))])
@pytest.mark.parametrize(
    "s, a, b", [(0.1, 0.0, 0.02), (0.06, 0.0, 0.05), (0.1, 0.001, 0.02), (0.3, 0.02, 0.2)]
)
def test_a_slanted_footprint_is_denser_at_one_end(s, a, b, slant):
    got, even, want = spread(s, a, b, slant=slant), spread(s, a, b), brute(s, a, b, slant=slant)
    # ramps have the densities of the ends, and are about as long as a tenth of the footprint where it has any
    error = 0.006 if a else 0.002
    assert np.abs(got - want).sum() < error * want.sum()
    assert abs(got.sum() / want.sum() - 1) < error / 2
    assert np.abs(even - want).sum() > 0.15 * want.sum()


@pytest.mark.parametrize("slant", [-1.0, pytest.param(1.0, marks=pytest.mark.slow)])
def test_slanted_bins_lie_between_none_and_twice_even_ones(slant):
    """At the end without density rounding made some negative, and noise took the root: a bin without a number."""
    rng, n = np.random.default_rng(0), 300
    s = 1 / rng.uniform(1, 30, n)
    wide = s * rng.uniform(0.01, 0.9, n)
    for thin in (0.0 * wide, 0.2 * wide * rng.random(n), 0.9 * wide):
        for footprint in zip(s, thin, wide, strict=True):
            bins, even = spread(*footprint, slant=slant), spread(*footprint)
            # ramps have the densities of the ends; sums of float32, of bins up to the greatest
            assert bins.min() >= 0 and (bins <= 2 * even + 1e-6 * even.max()).all()


@pytest.mark.parametrize(("slant", "end"), [(-1.0, 1), (1.0, -1)])
def test_no_bin_is_negative_where_a_footprint_ends_at_the_edge_of_one(slant, end):
    """By rounding such an end lies on either side of the edge, and the density there on either side of zero."""
    rng = np.random.default_rng(2)
    for edge in rng.choice(BINS.s[20:-20], 300):
        wide = edge * rng.uniform(0.01, 0.3)
        for steps in range(-6, 7):
            at_end = edge + steps * np.spacing(edge)
            assert spread(at_end - end * wide, 0.0, wide, slant=slant).min() >= 0


def test_footprints_outside_the_bins_add_nothing():
    for s in (1 / 40.0, 1 / 0.4, 10.0):
        assert not spread(s, 1e-4, 1e-5).any()
    assert spread(1 / EDGES[0] * (1 - 1e-9), 0.0, 0.0).argmax() == 0
    assert spread(1 / EDGES[-1] * (1 + 1e-9), 0.0, 0.0).argmax() == 299


def test_what_begins_at_the_end_of_the_last_bin_leaves_nothing_outside_of_its_span():
    """The next ping clears what lies within the spans alone; `spread` looks outside."""
    rng = np.random.default_rng(1)
    for _ in range(300):
        range_min_m, steps = rng.uniform(0, 3), rng.integers(1, 4)
        edges = np.linspace(range_min_m, range_min_m + rng.uniform(0.01, 40), rng.integers(2, 200))
        nearest = far = bin_table(edges).s[-1]
        for _ in range(steps):  # by rounding, this is the end of the last bin
            nearest = np.nextafter(nearest, np.inf)
        wide = far * rng.choice([1e-9, 1e-6, 1e-3])
        for thin in (0.0, wide / 2):  # a box and a trapezoid
            spread(nearest - wide - thin, wide, thin, 1e15, edges)


@pytest.mark.parametrize("slant", [0.0, 0.7])
def test_trapezoids_are_alike_one_bin_at_a_time_and_in_whole_groups(slant):
    """Near the last bin groups do not fit. Edges are exact, so that the first bins are those of more bins, too."""
    rng = np.random.default_rng(2)
    for n_bins in range(1, 41):
        short, long = (0.5 + 0.25 * np.arange(n + 1) for n in (n_bins, n_bins + 8))
        last, first = 1 / rng.uniform(short[-2], short[-1]), 1 / rng.uniform(short[0], short[-1])
        s, half = (first + last) / 2, abs(first - last) / 2
        thin = half * rng.uniform(0.2, 0.5)
        got, want = (spread(s, half - thin, thin, edges=one, slant=slant) for one in (short, long))
        assert not want[n_bins:].any()
        np.testing.assert_allclose(got, want[:n_bins], rtol=1e-6, atol=1e-7 * want.max())  # float32


def test_neighbouring_rows_leave_no_gaps_or_rings():
    """Footprints of the rows of a grazing floor tile it, and their sum is smooth to float32."""
    h, rows = 3.0, np.linspace(-0.02, -0.16, 60)
    half = (rows[0] - rows[1]) / 2
    total = np.zeros(len(EDGES) - 1)
    for v in rows:
        total += spread(-v / h, 0.0, half / h, energy=1.0)
    inner = (EDGES[1:] < 29) & (EDGES[:-1] > h / 0.16 + 0.2)
    want = -np.diff(1 / EDGES**2) / 2 * h / (2 * half)
    np.testing.assert_allclose(total[inner], want[inner], rtol=1e-6)


def test_many_footprints_are_the_sum_of_each():
    """Boxes and trapezoids, in range or not, are spread in one call."""
    rng = np.random.default_rng(3)
    s = 1 / rng.uniform(0.3, 60, 41)
    a, b = s * rng.random((2, 41)) ** 4
    want = sum(spread(*one) for one in zip(s, a, b, strict=True))
    np.testing.assert_allclose(spread(s, a, b), want, rtol=1e-5, atol=1e-7 * want.max())  # float32 sums


@pytest.mark.parametrize("n_weights", [1, 4, 5, 6, 7, 8])
def test_weigh_columns_is_a_circular_matrix_product(n_weights):
    """Of four beams at a time, and of the two that are left; of four columns at a time, in any number."""
    rng = np.random.default_rng(1)
    sums = rng.random((7, 37), np.float32)
    spans = np.array([[0, 37], [37, 0], [3, 4], [0, 5], [6, 37], [37, 0], [2, 29]])
    for row, span in zip(sums, spans, strict=True):
        row[: span[0]], row[span[1] :] = 0, 0
    first, weights = np.array([-2, 0, 5, 1, 3, -1]), rng.random((6, n_weights), np.float32)
    tiles, gain = tuple(beam_tiles(first, weights)), rng.random(37, np.float32)
    dense = np.zeros((6, 7))
    for b in range(6):
        for w in range(n_weights):
            dense[b, (first[b] + w) % 7] += weights[b, w]
    for one, times in ((gain[:0], 1.0), (gain, gain)):
        out = np.full((6, 37), np.nan, np.float32)
        for tile, of_tile in ((1, slice(4, 6)), (0, slice(0, 4))):
            assert np.isnan(out[of_tile]).all()
            total = weigh_columns(sums, spans, tiles, (tile, tile + 1), one, out)
            np.testing.assert_allclose(total, out[of_tile].sum(dtype=np.float64), rtol=1e-12)
        together = np.full_like(out, np.nan)
        weigh_columns(sums, spans, tiles, (0, 2), one, together)
        np.testing.assert_array_equal(together, out)
        np.testing.assert_allclose(out, dense @ sums * times, rtol=1e-5)  # float32 sums


@pytest.mark.parametrize("table", [np.empty(0), np.ones(5)], ids=["box", "pattern"])
def test_points_are_added_inside_the_fan_alone(table):
    """Of azimuth, sine of elevation and range, each lies inside or out; the aperture ends at a sine of 0.1."""
    edges = np.linspace(-0.2, 0.2, 5)  # four columns
    for azimuth, sine, range_m, inside in (
        (0.05, 0.0, 5.05, True),
        (0.05, 0.0999, 5.05, True),
        (0.05, -0.1001, 5.05, False),
        (0.05, 0.15, 5.05, False),
        (0.2001, 0.0, 5.05, False),
        (-0.2001, 0.0, 5.05, False),
        (0.05, 0.0, EDGES[0] - 1e-6, False),
        (0.05, 0.0, EDGES[-1] + 1e-6, False),
    ):
        sums, spans = np.zeros((4, len(EDGES) - 1), np.float32), np.tile([len(EDGES) - 1, 0], (4, 1))
        points = np.array([[azimuth, sine, range_m, 2.0]])
        add_points(points, edges, EDGES, table, 0.1, False, sums, spans)
        assert np.argwhere(sums).tolist() == ([[2, 45]] if inside else [])
        assert sums.sum() == 2.0 * inside


def fan_and_samples(reducer="footprint", rows=60, n_bodies=2, fov_deg=90.0):
    """Return a small fan of two or more sectors, and synthetic samples: planes with gaps, of several bodies."""
    sonar = sg.Sonar("test", 900e3, 40, 200, fov_deg, 20.0, 3.0, 0.5, 20.0)
    fan = make_fan(sonar, sg.Sampling(1, rows, reducer), BeamShape(math.radians(1.5)))
    rng, samples = np.random.default_rng(rows), []
    for sector in fan.sectors:
        u, v = sector.sample_coordinates()
        plane_echo = np.zeros((*u.shape, 4), np.float32)
        bodies = rng.integers(1, n_bodies + 1, u.shape).astype(np.uint16)
        slope_u, slope_v = rng.normal(0, 0.1, (2, *u.shape))
        q = 0.12 + slope_u * u + slope_v * v
        plane_echo[..., 0], plane_echo[..., 1], plane_echo[..., 2] = q, slope_u, slope_v
        plane_echo[..., 3] = rng.random(u.shape)
        plane_echo[(q <= 0) | (rng.random(u.shape) < 0.3)] = 0
        samples.append(SectorSamples(sector, plane_echo, bodies))
    return fan, samples


def silent(samples, row=None):
    """Return the samples with one row of surfaces, or none."""
    return [
        one._replace(
            plane_echo=np.where(np.arange(len(one.plane_echo))[:, None, None] == row, one.plane_echo, 0)
        )
        for one in samples
    ]


@pytest.mark.parametrize("reducer", ["footprint", "point"])
def test_a_ping_does_not_depend_on_the_one_before(reducer):
    fan, samples = fan_and_samples(reducer)
    weights = beam_weights(fan, None, math.radians(1.5))
    used, fresh = Beamformer(fan, weights), Beamformer(fan, weights)
    before = used.sum_footprints(samples).intensity
    copy = before.copy()
    for others in (silent(samples, row=30), silent(samples), samples):
        echo = used.sum_footprints(others)
        np.testing.assert_array_equal(echo.intensity, fresh.sum_footprints(others).intensity)
        assert echo.total == pytest.approx(echo.intensity.sum(dtype=np.float64), rel=1e-12)
        fresh = Beamformer(fan, weights)
    assert not used.sum_footprints(silent(samples)).intensity.any()
    np.testing.assert_array_equal(before, copy)  # the caller owns the result
    assert before.any()


def only(body, samples):
    """Return the samples with the echo of one body only; the other bodies still bound its samples."""
    mask = np.array([1, 1, 1, 0])
    return [
        one._replace(plane_echo=np.where((one.body_id == body)[..., None] | mask, one.plane_echo, 0))
        for one in samples
    ]


def test_the_echo_is_the_sum_over_bodies():
    """The echoes of single bodies sum to the echo of all, with one thread and with two."""
    fan, samples = fan_and_samples(rows=120)
    weights = beam_weights(fan, None, math.radians(1.5))
    beamformer = Beamformer(fan, weights, thread=SecondThread())
    # enough for two threads
    assert sum(len(one.sector.strips.middle) * len(one.plane_echo) for one in samples) > FEW_ROWS
    whole = beamformer.sum_footprints(samples).intensity
    parts = [beamformer.sum_footprints(only(body, samples)).intensity for body in (1, 2)]
    assert all(part.any() for part in parts)
    np.testing.assert_allclose(sum(parts), whole, rtol=1e-5, atol=1e-6 * whole.max())  # float32 sums
    np.testing.assert_array_equal(Beamformer(fan, weights).sum_footprints(samples).intensity, whole)


def test_the_weights_of_many_beams_take_no_more_memory_than_a_few_times_their_size():
    """Beams a degree wide, that are spaced by a few thousandths of it: each takes a hundred columns and more."""
    sonar = sg.load_sonar("p900-45,n_beams=8192")
    make_beamformer(sg.load_sonar("p900-45"), sg.Acoustics.ideal(), sg.Sampling(2, 4))  # loads modules
    tracemalloc.start()
    try:
        beamformer = make_beamformer(sonar, sg.Acoustics.ideal(), sg.Sampling(2, 4))
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    n_weights = sonar.n_beams * sonar.beam_width_deg / sonar.azimuth_fov_deg * beamformer.fan.n_columns
    assert peak < 8 * 4 * n_weights
