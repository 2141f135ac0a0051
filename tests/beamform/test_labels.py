"""Labels, the strongest body of each bin and its echo, against closed forms and brute force."""

import math
from dataclasses import fields, replace
from itertools import product

import numpy as np
import pytest
import trimesh

import sonar_gl as sg
from sonar_gl.beamform import labels, workspace
from sonar_gl.beamform.beamformer import Beamformer
from sonar_gl.beamform.kernels import work_table
from sonar_gl.beamform.kernels.footprints import keep_within
from sonar_gl.beamform.kernels.moments import asin, atan
from sonar_gl.beamform.kernels.range_bins import bin_table
from sonar_gl.beamform.kernels.runs import BODY, COLUMN, Runs, sort_runs
from sonar_gl.beamform.labels import BEYOND_BODY, label_columns
from sonar_gl.beamform.weights import beam_weights
from sonar_gl.embed.sensor import Sensor
from sonar_gl.noise.noise import add_noise
from sonar_gl.noise.reception import receiver_power
from sonar_gl.ping import BIN_LABELS
from sonar_gl.raster import scene_meshes
from sonar_gl.sonar.fan import BeamShape, make_fan
from sonar_gl.sonar.samples import NO_SPANS, ViewSamples
from tests.beamform.test_footprint import fan_and_samples, only

IDEAL, HERE = sg.Acoustics.ideal(), np.eye(4)
SONAR = sg.Sonar("test", 900e3, 48, 240, 40.0, 40.0, 2.0, 0.5, 24.5)
HEIGHT_M = 3.0
FLOOR = sg.Body("floor", trimesh.creation.box((400, 400, 1)), sg.pose(0, 0, -HEIGHT_M - 0.5), 0.4)


def plate(name, x, low, high, mu=0.8, y=(-200, 200)):
    """Return a thin plate across the boresight, between two heights relative to the sonar."""
    size = 0.002, y[1] - y[0], high - low
    return sg.Body(name, trimesh.creation.box(size), sg.pose(x + 0.001, sum(y) / 2, (low + high) / 2), mu)


def ping(scene, sonar=SONAR, acoustics=IDEAL, sampling=None, labels=True, **more):
    sampling = sampling or sg.Sampling(2, 160)
    with sg.Simulator(sg.Scene(scene), sonar, acoustics, sampling) as simulator:
        return simulator.ping(HERE, labels=labels, **more)


@pytest.mark.parametrize("reducer", ["footprint", "point"])
@pytest.mark.parametrize("n_bodies, fov_deg", [(2, 90.0), (300, 90.0), (3, 360.0)])
def test_labels_agree_with_the_echoes_of_single_bodies(reducer, n_bodies, fov_deg):
    """The strongest body follows from the echo of each body alone; a fan of 360 degrees wraps its columns."""
    fan, samples = fan_and_samples(reducer, n_bodies=n_bodies, fov_deg=fov_deg)
    beamformer = Beamformer(fan, beam_weights(fan, None, math.radians(1.5)))
    gain = np.linspace(1, 2, fan.sonar.n_bins, dtype=np.float32)
    echoes = np.array(
        [beamformer.sum_footprints(only(body, samples)).intensity for body in range(n_bodies + 1)]
    )
    is_background = np.arange(n_bodies + 2) % 2 == 0
    unshadowed = only(1, samples)  # any samples serve as the unshadowed background
    alone = beamformer.sum_footprints(unshadowed).intensity
    for _ in range(2):  # the second call reuses the arrays of the first
        _, bodies = beamformer.sum_bodies(ViewSamples(tuple(samples)), gain)
        found = beamformer.find_labels(
            bodies, gain, n_bodies + 1, (is_background, ViewSamples(tuple(unshadowed)))
        )
        strongest, whole = echoes.max(axis=0), echoes.sum(axis=0)
        second = np.partition(echoes, -2, axis=0)[-2]
        clear = strongest - second > 1e-5 * strongest  # float32 sums
        assert clear.sum() > 1000
        np.testing.assert_array_equal(found.body_id[clear], echoes.argmax(axis=0)[clear])
        np.testing.assert_array_equal(found.body_id > 0, whole > 0)
        share = np.divide(strongest, whole, out=np.zeros_like(whole), where=whole > 0)
        np.testing.assert_allclose(found.share, share, atol=1e-5)
        body_echo = np.append((echoes.astype(float) @ gain).sum(axis=1), 0.0)
        np.testing.assert_allclose(found.body_echo, body_echo, rtol=1e-5)
        remaining = echoes[0::2].sum(axis=0)
        sure = np.abs(remaining - 0.1 * alone) > 1e-4 * alone
        np.testing.assert_array_equal(found.shadow[sure], ((alone > 0) & (remaining < 0.1 * alone))[sure])
        for name in ("elevation_rad", "incidence_rad", "true_range_m"):
            np.testing.assert_array_equal(np.isnan(getattr(found, name)), whole == 0)


@pytest.mark.parametrize(
    "room", [(1, 1 << 14, 1 << 22), (16, 1, 1 << 22), (16, 1 << 14, 1), (2, 40, 3000), "just enough"]
)
def test_samples_are_summed_again_where_there_was_too_little_room(room, monkeypatch):
    """To the bit. Cells that were too few are left empty: after an interrupt they are used again."""
    fan, samples = fan_and_samples("footprint", n_bodies=10)
    gain, view = np.linspace(1, 2, fan.sonar.n_bins, dtype=np.float32), ViewSamples(tuple(samples))
    taken, most, take = [], [0, 0, 0], workspace.LabelSums.take

    def watched(self, half, needed):
        cells = self.cells[half]
        most[:] = map(max, most, needed)
        taken.append(take(self, half, needed))
        assert not cells.any()
        return taken[-1]

    def echo_and_labels():
        beamformer = Beamformer(fan, beam_weights(fan, None, math.radians(1.5)))
        for _ in range(2):  # the second time there is room
            taken.clear()
            echo, bodies = beamformer.sum_bodies(view, gain)
            yield (
                taken.count(False),
                {"echo": echo.intensity, **vars(beamformer.find_labels(bodies, gain, 10))},
            )

    monkeypatch.setattr(workspace.LabelSums, "take", watched)
    (n_again, expected), _ = echo_and_labels()
    assert n_again == 0
    for name, size in zip(("SLOTS", "RUNS", "POOL"), most if room == "just enough" else room, strict=True):
        monkeypatch.setattr(workspace, name, size)
    for has_room, (n_again, found) in enumerate(echo_and_labels()):
        assert n_again <= 8  # of one slot, either half has 2, 4, 8 and 16
        assert (n_again == 0) == (has_room or room == "just enough")
        for name, array in found.items():
            np.testing.assert_array_equal(array, expected[name])


def test_labels_of_echoes_through_side_lobes():
    """The floor below a level sonar: labelled from its height on, at the elevation that the range gives."""
    acoustics = replace(IDEAL, elevation_pattern="line_array")
    found = ping([FLOOR], acoustics=acoustics)
    ring = (SONAR.range_m > HEIGHT_M + SONAR.bin_size_m) & (SONAR.range_m < 1.5 * HEIGHT_M)
    assert (found.body_id[:, ring] == 1).all()
    # footprints are some degrees high there, and straight up or down elevation hardly changes the range
    expected = np.broadcast_to(-np.arcsin(HEIGHT_M / SONAR.range_m[ring]), found.body_id[:, ring].shape)
    np.testing.assert_allclose(found.elevation_rad[:, ring], expected, atol=math.radians(2.0))
    np.testing.assert_allclose(found.incidence_rad[:, ring], math.pi / 2 + expected, atol=math.radians(2.0))
    np.testing.assert_array_equal(found.intensity, ping([FLOOR], acoustics=acoustics, labels=False).intensity)


@pytest.mark.parametrize("reducer", ["footprint", "point"])
@pytest.mark.parametrize("name", ["pylon", pytest.param("ocean_floor", marks=pytest.mark.slow)])
def test_labels_change_no_bit_of_the_picture(name, reducer):
    """The sums of all bodies in the pass for labels are those of a ping without labels."""
    scene, sonar = sg.load_scene(name), replace(sg.load_sonar("p900-45"), n_bins=400)
    for acoustics in (IDEAL, sg.Acoustics.physical()):
        with sg.Simulator(scene, sonar, acoustics, sg.Sampling(1.5, 48, reducer)) as simulator:
            plain, found = (simulator.ping(scene.sonar_pose, labels=labels) for labels in (False, True))
        assert plain.intensity.any() and found.body_id.any()
        np.testing.assert_array_equal(found.intensity, plain.intensity)


def test_sums_of_bodies_outlast_other_sums():
    """A ping is labelled when it is known to be the last that is tried, after it was compared with another one."""
    fan, samples = fan_and_samples("footprint", n_bodies=5)
    beamformer = Beamformer(fan, beam_weights(fan, None, math.radians(1.5)))
    gain = np.linspace(1, 2, fan.sonar.n_bins, dtype=np.float32)
    background = np.arange(6) == 2, ViewSamples(tuple(only(2, samples)))
    view = ViewSamples(tuple(samples))
    echo, bodies = beamformer.sum_bodies(view, gain)
    expected = beamformer.find_labels(bodies, gain, 5, background)
    np.testing.assert_array_equal(echo.intensity, beamformer.sum_footprints(samples, gain).intensity)
    _, bodies = beamformer.sum_bodies(view, gain)
    beamformer.sum_view(ViewSamples(tuple(only(3, samples))), gain)
    for name, of_name in vars(beamformer.find_labels(bodies, gain, 5, background)).items():
        np.testing.assert_array_equal(of_name, getattr(expected, name))


@pytest.mark.parametrize("scale", [1e-32, 1e-33, 1e-34])
def test_echoes_whose_inverse_no_float32_holds_have_no_label(scale):
    """Weak bins by far side lobes had labels of infinite range: the support returned less than 1e-38 there."""
    fan, samples = fan_and_samples("footprint", n_bodies=5)
    beamformer = Beamformer(fan, beam_weights(fan, None, math.radians(1.5)))
    gain = np.ones(fan.sonar.n_bins, np.float32)
    found = []
    for factor in (1, scale):
        faint = [one._replace(plane_echo=one.plane_echo * np.float32([1, 1, 1, factor])) for one in samples]
        echo, bodies = beamformer.sum_bodies(ViewSamples(tuple(faint)), gain)
        found.append((echo.intensity, beamformer.find_labels(bodies, gain, 5)))
    (intensity, plain), (_, labelled) = found
    strongest = intensity * plain.share * scale
    assert (labelled.body_id[strongest < 0.99e-37] == 0).all()
    clear = strongest > 1.01e-37
    np.testing.assert_array_equal(labelled.body_id[clear], plain.body_id[clear])
    for name in ("elevation_rad", "incidence_rad", "true_range_m"):
        array = getattr(labelled, name)
        np.testing.assert_array_equal(np.isfinite(array), labelled.body_id > 0)
        # sums of some samples each of which may be off by half of the least float32, 1.4e-45, in less than 1e-37
        np.testing.assert_allclose(array[clear], getattr(plain, name)[clear], atol=1e-4)
    assert clear.sum() > 100 and (strongest[~clear] > 0).sum() > 100


def tapered(azimuth_rad, steer_rad):
    """Return a smooth pattern of power, zero from ±0.2 rad on."""
    return np.cos(np.minimum(np.abs(np.sin((azimuth_rad - steer_rad) / 2)) * 2 / 0.2, 1.0) * math.pi / 2) ** 2


@pytest.mark.parametrize("fov_deg", [90.0, 360.0])
@pytest.mark.parametrize("is_box", [True, False])
def test_joined_columns_return_an_even_echo_alike(fov_deg, is_box):
    """Beams receive as much of an even echo, also over the seam of a fan of 360 degrees; no column is left out."""
    sonar = sg.Sonar("test", 900e3, 120, 10, fov_deg, 20.0, 3.0, 0.5, 20.0)
    fan = make_fan(sonar, sg.Sampling(4, 16), BeamShape(0.2, is_box=False))
    weights, widths = beam_weights(fan, tapered, 0.2), np.diff(fan.column_edges_rad)
    response = np.linspace(1, 1.1, fan.n_columns)
    response[7:27] *= np.geomspace(1e-2, 1, 20)  # weak and uneven, as beside a fan
    joined = label_columns(fan, weights, is_box, response)
    of_columns = joined.of_columns[: fan.n_columns]
    np.testing.assert_array_equal(np.unique(of_columns), np.arange(joined.count))
    assert (np.diff(of_columns) >= 0).all()
    if is_box:
        assert joined.count == fan.n_columns
    else:
        widest_rad = weights.width_rad.min() / labels.COLUMNS_PER_BEAM
        assert np.bincount(of_columns, widths).max() <= widest_rad * (1 + 1e-9)
        assert joined.count < fan.n_columns / 2
    assert np.abs(response / joined.response[of_columns] - 1).max() <= labels.UNEVEN
    joined_widths, tiles = np.bincount(of_columns, widths), joined.tiles
    np.testing.assert_allclose(
        joined.response * joined_widths, np.bincount(of_columns, response * widths), rtol=1e-12
    )
    columns = (tiles.first[:, None] + np.arange(tiles.weights.shape[1])) % joined.count
    received = (tiles.weights * joined_widths[columns][..., None]).sum(axis=1).ravel()[: len(weights.first)]
    columns = (weights.first[:, None] + np.arange(weights.weights.shape[1])) % fan.n_columns
    np.testing.assert_allclose(
        received, (weights.weights * widths[columns]).sum(axis=1), rtol=1e-7
    )  # float32


@pytest.mark.parametrize("azimuth_deg", [0.9, 1.1])
@pytest.mark.parametrize("n_beams, fov_deg", [(1, 2.0), (8, 40.0), (48, 40.0)])
@pytest.mark.parametrize("far_side_lobes", [False, True])
def test_the_echo_of_a_lone_body_is_that_of_the_ping(n_beams, fov_deg, azimuth_deg, far_side_lobes):
    """Also between beams that do not overlap, and beside a single one."""
    sonar = sg.Sonar("gaps", 900e3, n_beams, 200, fov_deg, 20.0, 1.0, 0.5, 10.0)
    turn = math.radians(azimuth_deg) + sonar.azimuth_rad[n_beams // 2]
    ball = sg.Body(
        "ball", trimesh.creation.icosphere(3, 0.1), sg.pose(6 * math.cos(turn), 6 * math.sin(turn))
    )
    acoustics = sg.Acoustics.physical(far_side_lobes=far_side_lobes)
    got = ping([ball], sonar, acoustics, sg.Sampling(80 / n_beams + 2, 100))
    # joined columns are received alike but for a share of 2e-3, which is about the mean of theirs
    assert got.body_echo[1] == pytest.approx(got.intensity.sum(dtype=float), rel=5e-5)


@pytest.mark.parametrize("pulse_taper", ["hamming", pytest.param("uniform", marks=pytest.mark.slow)])
def test_the_echo_of_a_body_has_the_level_of_a_pulse_longer_than_a_bin(pulse_taper):
    """Bins shorter than the resolution cell hold its echo: the sum of the intensity is cell / bin times as much."""
    more = {"bandwidth_hz": 5e3, "pulse_taper": pulse_taper}
    sonar = sg.Sonar("long", 900e3, 16, 240, 20.0, 20.0, 2.0, 0.5, 12.5, **more)
    ball = sg.Body("ball", trimesh.creation.icosphere(3, 0.3), sg.pose(6.0))
    acoustics = sg.Acoustics.physical()
    got = ping([ball], sonar, acoustics, sg.Sampling(8, 100))
    assert got.body_echo[1] == pytest.approx(got.intensity.sum(dtype=float), rel=2e-3)
    truth = sg.reference_ping(sg.Scene([ball]), sonar, HERE, acoustics, error=0.1)
    assert truth.body_echo[1] == pytest.approx(truth.intensity.sum(dtype=float), rel=2e-3)
    cell_m = {"hamming": 1.363, "uniform": 1.0}[pulse_taper] * acoustics.water.sound_speed() / 2 / 5e3
    without = ping([ball], sonar, replace(acoustics, pulse=False), sg.Sampling(8, 100))
    assert got.body_echo[1] == pytest.approx(without.body_echo[1] * cell_m / sonar.bin_size_m, rel=1e-3)


def test_the_echo_of_a_body_beside_the_fan_is_received_by_far_side_lobes():
    """Half of it was missing: that of the lobes beyond the support of beams, which labels leave out."""
    sonar = sg.Sonar("fan", 900e3, 48, 200, 40.0, 20.0, 1.0, 0.5, 10.0)
    turn = math.radians(22.5)
    beside = sg.pose(6 * math.cos(turn), 6 * math.sin(turn))
    bodies = [
        sg.Body("beside", trimesh.creation.icosphere(3, 0.3), beside),
        sg.Body("ahead", trimesh.creation.icosphere(3, 0.3), sg.pose(8.0)),
    ]
    for acoustics in (sg.Acoustics.physical(), sg.Acoustics.physical(far_side_lobes=False)):
        both, alone = (ping(some, sonar, acoustics, sg.Sampling(4, 200)) for some in (bodies, bodies[:1]))
        # within 2e-3, by which joined columns may be uneven
        np.testing.assert_allclose(both.body_echo.sum(), both.intensity.sum(dtype=float), rtol=2e-3)
        assert alone.body_echo[1] == pytest.approx(alone.intensity.sum(dtype=float), rel=2e-3)
        # rows of a strip are joined or not by all that it meets, which moves the echo of a body by less than a tenth of
        # what joined columns do
        assert both.body_echo[1] == pytest.approx(alone.body_echo[1], rel=1e-4)


@pytest.mark.parametrize("azimuth_deg", [21.25, 22.875])
@pytest.mark.parametrize("far_side_lobes", [False, True])
def test_joined_columns_keep_the_echo_of_a_thin_rod_beside_the_fan(monkeypatch, azimuth_deg, far_side_lobes):
    """All beams receive little there, and unevenly: the rod, in one column, was off by up to 13 %."""
    sonar = sg.Sonar("fan", 900e3, 48, 200, 40.0, 20.0, 1.0, 0.5, 10.0)
    turn = math.radians(azimuth_deg)
    beside = sg.pose(6 * math.cos(turn), 6 * math.sin(turn), 0, 0, 0, turn)
    rod = sg.Body("rod", trimesh.creation.box((0.002, 0.002, 4)), beside)
    acoustics = sg.Acoustics.physical(far_side_lobes=far_side_lobes)
    got = ping([rod], sonar, acoustics, sg.Sampling(12, 100))
    monkeypatch.setattr(labels, "COLUMNS_PER_BEAM", 1000)
    exact = ping([rod], sonar, acoustics, sg.Sampling(12, 100))
    assert got.body_echo[1] == pytest.approx(exact.body_echo[1], rel=labels.UNEVEN)
    # the sum of beams counts less than nothing as nothing in each bin, the response of columns in each column
    assert exact.body_echo[1] == pytest.approx(exact.intensity.sum(dtype=float), rel=5e-4)


@pytest.mark.slow
def test_joined_columns_change_labels_less_than_finer_samples_do(monkeypatch):
    """Of the bins that are labelled, and of the elevations there."""
    scene, sonar = sg.load_scene("pylon"), replace(sg.load_sonar("p900-45"), n_bins=300)

    def labelled(columns_per_beam, finer):
        monkeypatch.setattr(labels, "COLUMNS_PER_BEAM", columns_per_beam)
        sampling = sg.Sampling(1.0 * finer, round(80 * finer))
        with sg.Simulator(scene, sonar, sampling=sampling) as simulator:
            return simulator.ping(scene.sonar_pose, labels=True, background=[scene.bodies[0].name])

    found, exact, finer = labelled(4, 1.0), labelled(1000, 1.0), labelled(1000, 1.5)

    def change(one):
        """Return the share of bins whose body is another one, and the 95th percentile of changed elevations."""
        same = (one.body_id == exact.body_id) & (exact.body_id > 0)
        elevations = np.abs(one.elevation_rad - exact.elevation_rad)[same]
        return 1 - same.sum() / ((one.body_id > 0) | (exact.body_id > 0)).sum(), np.quantile(elevations, 0.95)

    np.testing.assert_array_equal(found.intensity, exact.intensity)
    np.testing.assert_allclose(found.body_echo, exact.body_echo, rtol=1e-3)
    assert (found.shadow != exact.shadow).mean() <= (finer.shadow != exact.shadow).mean()
    joined, sampled = change(found), change(finer)
    assert 0 < joined[0] < sampled[0] and 0 < joined[1] < sampled[1]


def test_atan_asin_and_the_centre_of_bins():
    t = np.linspace(0, 1, 1001)
    np.testing.assert_allclose([atan(one) for one in t], np.arctan(t), atol=3e-8)
    np.testing.assert_allclose([asin(one) for one in t], np.arcsin(t), atol=3e-8)
    edges = np.array([0.5, 1.0, 1.7])
    fine = 1 / np.linspace(1 / edges[:-1], 1 / edges[1:], 100_001)  # even in s = 1/r
    # ∫ r s ds / ∫ s ds over each bin
    np.testing.assert_allclose(bin_table(edges).middle_m, 1 / (1 / fine).mean(axis=0), rtol=1e-6)


@pytest.fixture(scope="module", params=[40, 160], ids=["single_rows", "joined_rows"])
def walled(request):
    """Return a ping of a floor and a wall at 16 m; samples are 1° or 0.25° high."""
    walls = [FLOOR, plate("wall", 16.0, -HEIGHT_M, 30.0)]
    return ping(walls, sampling=sg.Sampling(2, request.param))


def test_incidence_and_elevation_of_a_floor_and_a_wall(walled):
    """cos θ is a plane's distance divided by the range."""
    r = walled.true_range_m
    floor, wall = (walled.body_id == 1) & (r < 15.5), (walled.body_id == 2) & (walled.share == 1)
    assert floor.sum() > 500 and wall.sum() > 300
    # far below the height of a sample, which covers several bins: within it, angles follow the range
    limit = math.radians(0.01)
    np.testing.assert_allclose(walled.incidence_rad[floor], np.arccos(HEIGHT_M / r[floor]), atol=limit)
    np.testing.assert_allclose(walled.elevation_rad[floor], -np.arcsin(HEIGHT_M / r[floor]), atol=limit)
    limit = math.radians(0.25) / 2
    # near normal incidence the mean of angles exceeds the angle of the mean
    far = wall & (r > 16.5)
    np.testing.assert_allclose(walled.incidence_rad[far], np.arccos(16 / r[far]), atol=2 * limit)
    assert np.nanmin(walled.incidence_rad[walled.body_id == 2]) < 0.1
    assert walled.incidence_rad.dtype == walled.true_range_m.dtype == walled.share.dtype == np.float32
    assert not any(array.flags.writeable for array in (walled.incidence_rad, walled.share))


def test_incidence_of_an_oblique_wall():
    """The wall is 10 m away and oblique, so that 1/x has slopes along both axes of the view."""
    yaw = 0.9
    wall = trimesh.creation.box((0.002, 200, 200))
    wall_pose = sg.pose(10.001 * math.cos(yaw), 10.001 * math.sin(yaw), 0, yaw=yaw)
    got = ping([sg.Body("wall", wall, wall_pose, 0.8)])
    lone = (got.share == 1) & (got.true_range_m < 20)
    assert lone.sum() > 500
    # a sample is 0.42° wide and 0.25° high, which bounds the change of the angle
    np.testing.assert_allclose(got.incidence_rad[lone], np.arccos(10 / got.true_range_m[lone]), atol=0.005)


@pytest.mark.parametrize("height_m, tilt_deg, rows", [(1.0, 75, 4), (0.1, 85, 1), (0.1, 60, 8)])
def test_angles_of_footprints_that_fill_the_aperture_stay_below_a_right_one(height_m, tilt_deg, rows):
    """Angles are linear within a footprint; by their slope at its middle elevations end at up to 638° here.

    In the last case only incidence exceeds a right angle, by 2°.
    """
    sonar = sg.Sonar("high", 900e3, 1, 64, 1.0, 170.0, 1.0, 0.0, 8.0)
    slope = sg.pose(pitch=math.radians(tilt_deg)) @ sg.pose(z=height_m + 5e-4)
    ceiling = sg.Body("ceiling", trimesh.creation.box((1000, 1000, 1e-3)), slope, 0.5)
    found = ping([ceiling], sonar, sampling=sg.Sampling(8, rows))
    lone = found.body_id > 0
    assert lone.any()
    assert np.abs(found.elevation_rad[lone]).max() <= np.float32(math.pi / 2)
    assert 0 <= found.incidence_rad[lone].min() <= found.incidence_rad[lone].max() <= np.float32(math.pi / 2)


@pytest.mark.parametrize("reducer", ["footprint", "point"])
def test_true_range_is_the_mean_within_the_bin(reducer):
    """The true range is the mean of bins forty times as fine; in partly filled bins it is far from the centre."""
    bodies = [FLOOR, plate("upright", 9.3, -2.0, 1.0), plate("far", 17.9, -3.0, 2.0)]
    sampling = sg.Sampling(2, 160, reducer)
    coarse = ping(bodies, replace(SONAR, n_bins=24), sampling=sampling)
    fine = ping(bodies, replace(SONAR, n_bins=960), sampling=sampling)
    echo = np.where(fine.body_id.reshape(48, 24, 40) == coarse.body_id[..., None], 1.0, 0.0)
    echo *= (fine.intensity * fine.share).reshape(48, 24, 40)
    lone = (coarse.share > 0.999) & (coarse.body_id > 0)
    mean = (echo * fine.range_m.reshape(24, 40)).sum(axis=-1)[lone] / echo.sum(axis=-1)[lone]
    assert lone.sum() > 250
    # the error is that of half a fine bin
    assert np.abs(coarse.true_range_m[lone] - mean).max() < 0.025 / 2 + 1e-4
    assert np.abs(coarse.true_range_m - coarse.range_m)[lone].max() > 0.35
    edges = np.linspace(0.5, 24.5, 25)
    inside = (coarse.true_range_m >= edges[:-1]) & (coarse.true_range_m <= edges[1:])
    np.testing.assert_array_equal(inside, coarse.body_id > 0)


def test_true_range_does_not_depend_on_the_sonar_s_speed_setting():
    """A sonar set to a higher speed of sound displays a plate too far away; the true range is unaffected."""
    set_wrong = sg.Acoustics.physical(water=sg.Water(sound_speed_m_s=1450.0), sonar_sound_speed_m_s=1500.0)
    got = ping([plate("plate", 10.0, -0.3, 0.3, y=(-0.3, 0.3))], acoustics=set_wrong)
    assert np.nanmin(got.true_range_m) == pytest.approx(10.0, abs=0.005)
    shown = got.range_m[(got.body_id > 0).any(axis=0)]
    assert shown.min() == pytest.approx(10 * 1500 / 1450, abs=0.1)


def test_shadow_of_a_plate_on_a_floor():
    """The shadow of a plate of height h at X extends from hypot(X, H) to hypot(X H / (H - h), H).

    H is the height of the sonar over the floor; X grows as 1/cos ψ across the fan.
    """
    x, top = 9.0, 1.5
    got = ping([FLOOR, plate("plate", x, -HEIGHT_M, top - HEIGHT_M)], background=["floor"])
    across = (x / np.cos(got.azimuth_rad))[:, None]
    foot, head = np.hypot(across, HEIGHT_M), np.hypot(across * HEIGHT_M / (HEIGHT_M - top), HEIGHT_M)
    low, high = SONAR.bin_edges_m[:-1], SONAR.bin_edges_m[1:]
    # within a beam of 2° at 20° the ends vary by 0.7 %; and by a bin
    inside = (low > foot * 1.007 + 0.1) & (high < head * 0.993 - 0.1)
    outside = (high < foot * 0.993 - 0.1) | (low > head * 1.007 + 0.1)
    assert inside.sum() > 1000 and outside.sum() > 1000
    assert got.shadow.dtype == bool and not got.shadow.flags.writeable
    assert got.shadow[inside].all()
    assert not got.shadow[outside].any()


@pytest.mark.parametrize("tolerance", [0.05, 0.01])
@pytest.mark.parametrize("acoustics", [IDEAL, sg.Acoustics.physical()], ids=["ideal", "physical"])
def test_little_of_a_ball_lies_behind_its_outline(acoustics, tolerance):
    """Samples at the outline are planes that reach behind it. Of a mesh, the outline is a polygon.

    The page states the first bound. The outline is at √(d² − a²) of a ball of radius a at the distance d.
    """
    radius, distance = 1.5, 6.0
    ball = sg.Body("ball", trimesh.creation.icosphere(5, radius), sg.pose(distance), 0.5)
    sonar = sg.load_sonar("p900-45").with_range(8.0)
    with sg.Simulator(sg.Scene([ball]), sonar, acoustics, tolerance=tolerance) as simulator:
        got = simulator.ping(HERE, labels=True)
    outline = math.sqrt(distance**2 - radius**2)
    behind = (got.body_id > 0) & (got.range_m > outline + sonar.bin_size_m)
    assert behind.sum() < 0.025 * (got.body_id > 0).sum()
    assert got.intensity[behind].sum() < tolerance / 200 * got.intensity.sum()


@pytest.mark.parametrize("rows", [40, 80, 160])
def test_a_shadow_ends_within_half_a_sample(rows):
    """The end of a shadow on a floor errs by at most half a row, r² Δφ / 2h in range, besides whole bins."""
    x, top = 9.0, 1.5
    sonar, sampling = replace(SONAR, beam_width_deg=0.2), sg.Sampling(columns_per_beam=4, rows=rows)
    bodies = [FLOOR, plate("plate", x, -HEIGHT_M, top - HEIGHT_M)]
    got = ping(bodies, sonar, sampling=sampling, background=["floor"])
    end = np.hypot(x / np.cos(got.azimuth_rad) * HEIGHT_M / (HEIGHT_M - top), HEIGHT_M)
    found = np.array([sonar.bin_edges_m[1:][beam].max() for beam in got.shadow])
    half_row_m = end**2 / (2 * HEIGHT_M) * math.radians(sonar.elevation_fov_deg) / rows
    assert (np.abs(found - end) < half_row_m + sonar.bin_size_m).all()


def test_open_water_is_not_a_shadow():
    """A body without background behind it casts no shadow; over a floor only the floor's own echo counts."""
    hung = plate("hung", 5.0, -1.0, 0.0, y=(-0.5, 0.5))
    behind = plate("behind", 12.0, -6, -4, y=(-1, 1))
    assert not ping([hung, behind], background=["behind"]).shadow.any()
    floor_only = ping([FLOOR], background=["floor"])
    assert not floor_only.shadow.any() and (floor_only.body_id > 0).any()
    over = ping([FLOOR, hung], background=["floor"])
    alone, remaining = floor_only.intensity, ping([FLOOR, replace(hung, reflectivity=0.0)]).intensity
    np.testing.assert_array_equal(over.shadow, (alone > 0) & (remaining < 0.1 * alone))
    assert over.shadow.any() and (alone[over.shadow] > 0).all()
    assert not over.shadow[:, over.range_m < 8].any()  # the floor begins at 3 m / sin 20°


def test_the_background_casts_no_shadow_on_itself():
    """Bodies of the background and absent bodies cast no shadows."""
    bodies = [FLOOR, plate("wall", 10.0, -HEIGHT_M, 5.0), plate("box", 6.0, -HEIGHT_M, -1, y=(-1, 1))]
    assert not ping(bodies, background=["floor", "wall", "box"]).shadow.any()
    assert not ping(bodies[:2], background=["floor", "wall"]).shadow.any()
    assert not ping(bodies, background=["floor", "wall"], bodies={"box": None}).shadow.any()
    assert ping(bodies, background=["floor", "wall"]).shadow.any()
    assert not ping(bodies, background=[]).shadow.any()
    assert ping(bodies).shadow is None
    plain = ping(bodies, labels=False)
    assert all(getattr(plain, name) is None for name in (*BIN_LABELS, "body_echo"))


def test_the_list_of_the_labels_of_bins_is_complete():
    assert {field.name for field in fields(labels.Labels)} == {*BIN_LABELS, "body_echo"}


def test_background_must_be_bodies():
    for more, message in (
        ({"background": ["flor"]}, r"background must be bodies .*'flor'; did you mean 'floor'"),
        ({"background": "floor"}, r"several names .*'floor'; make \[name\]"),
        ({"background": 7}, "several names .*got 7"),
        ({"background": ["floor"], "labels": False}, "background needs labels=True"),
    ):
        with pytest.raises(sg.Error, match=message):
            ping([FLOOR], **more)


def test_labels_of_a_moving_sonar():
    """All labels of a cell move with its echo."""
    bodies = [FLOOR, plate("box", 7.0, -HEIGHT_M, -1, y=(-1, 1))]
    still = ping(bodies, background=["floor"])
    moved = ping(bodies, background=["floor"], velocity=(1.0, 0, 0, 0, 0, 3.0))
    cells = {tuple(getattr(still, name)[at] for name in BIN_LABELS) for at in np.ndindex(still.body_id.shape)}
    changed = np.argwhere((moved.body_id > 0) & (still.body_id != moved.body_id))
    assert len(changed) > 50
    assert all(tuple(getattr(moved, name)[tuple(at)] for name in BIN_LABELS) in cells for at in changed)


PILE = sg.Body("pile", trimesh.creation.cylinder(0.15, 40, sections=64), sg.pose(10, 0, 0), 0.8)
LINE_ARRAY = replace(IDEAL, beam_pattern="line_array")
PER_BIN = "body_id", "elevation_rad", "incidence_rad", "true_range_m", "share"


def test_side_lobes_of_a_pile_do_not_carry_its_label():
    """The pile lies within 0.86°; beams have their first null λ/L = 2°/0.886 beyond, and side lobes at -13 dB."""
    bare = replace(SONAR, counts=sg.Counts(low_db=-180.0, high_db=0.0))
    whole = ping([PILE], bare, LINE_ARRAY, label_level_db=-180.0)
    top_db = 10 * np.log10(whole.intensity.max())
    on_pile = np.abs(whole.azimuth_rad) < math.asin(0.15 / 10)
    in_lobe = np.abs(whole.azimuth_rad) < math.asin(0.15 / 10) + math.asin(math.radians(2.0) / 0.886)
    assert (whole.body_id[~in_lobe] == 1).sum() > 50  # the rectangle beside the pile
    # the pile's width raises side lobes by less than 1.3 dB: down to 12 dB below the strongest bin there are none
    window = sg.Counts(low_db=top_db - 12 - 1e-6, high_db=top_db - 12 + 1e-6)
    shown = ping([PILE], replace(SONAR, counts=window), LINE_ARRAY)
    np.testing.assert_array_equal(shown.intensity, whole.intensity)
    assert not shown.body_id[~in_lobe].any()
    strongest = whole.intensity.max(axis=0).argmax()
    assert (shown.body_id[on_pile, strongest] == 1).all()
    own = whole.share * whole.intensity
    bright = own >= np.float32(10 ** (shown.meta["label_level_db"] / 10))
    assert 0 < bright.sum() < (whole.body_id > 0).sum()
    for name, empty in zip(PER_BIN, (0, np.nan, np.nan, np.nan, 0.0), strict=True):
        array = getattr(whole, name)
        np.testing.assert_array_equal(getattr(shown, name), np.where(bright, array, array.dtype.type(empty)))
    np.testing.assert_array_equal(shown.body_echo, whole.body_echo)


def wall_behind_a_slat(range_m, ahead_m, length_m):
    """Return a wall and, of the same body, a slat ahead of it that is seen nearly edge-on and returns little."""
    wall, slat = trimesh.creation.box((0.002, 20, 20)), trimesh.creation.box((length_m, 20, 1e-6))
    slat.apply_transform(trimesh.transformations.rotation_matrix(-0.01, [0, 1, 0]))
    wall.apply_translation((range_m + 0.001, 0, 0))
    slat.apply_translation((range_m - ahead_m, 0, 0))
    return sg.Body("wall", trimesh.util.concatenate([wall, slat]), reflectivity=0.8)


@pytest.mark.parametrize(
    ("preset", "engine", "pulse_taper"),
    [
        ("p900-45", "opengl", "hamming"),
        ("p900-45,bandwidth_hz=20e3", "cpu", "uniform"),
        ("kongsberg-m3", "cpu", "hamming"),
        *(
            pytest.param(*one, marks=pytest.mark.slow)
            for one in (
                ("p900-45", "opengl", "uniform"),
                ("p900-45,bandwidth_hz=20e3", "cpu", "hamming"),
                ("kongsberg-m3", "cpu", "uniform"),
                *product(("m900-2250", "norbit-fls", "didson-hf"), ["cpu"], ("hamming", "uniform")),
            )
        ),
    ],
)
def test_what_the_pulse_alone_lights_has_no_label(preset, engine, pulse_taper):
    """Before a wall its range side lobes are bright; a slat of its body has a label there only if it is, too."""
    sonar, range_m = replace(sg.load_sonar(preset).with_range(5.0), pulse_taper=pulse_taper), 4.0
    body = wall_behind_a_slat(range_m, 2.5 * sonar.bin_size_m, sonar.bin_size_m)

    def labelled(level_db=-180.0, pulse=True):
        acoustics, sampling = replace(IDEAL, pulse=pulse), sg.Sampling(2, 400)
        with sg.Simulator(sg.Scene([body]), sonar, acoustics, sampling, engine=engine) as simulator:
            return simulator.ping(HERE, labels=True, label_level_db=level_db)

    whole, bare = labelled(), labelled(pulse=False)
    ahead = whole.range_m + sonar.bin_size_m / 2 < range_m
    raised = replace(IDEAL, pulse=True).pulse_level(sonar)
    shown, own = whole.share * whole.intensity, bare.share * bare.intensity
    slat_db = 10 * math.log10(raised * own[:, ahead].max())
    for level_db in (slat_db - 1, slat_db + 1):
        least, ping = 10 ** (level_db / 10), labelled(level_db)
        is_bright, has_echo = shown >= np.float32(least), own >= np.float32(least / raised)
        assert is_bright[:, ahead].any()
        assert ping.body_id[:, ahead].any() == (level_db < slat_db)
        np.testing.assert_array_equal(ping.body_id, is_bright & has_echo)
        np.testing.assert_array_equal(np.isnan(ping.true_range_m), ping.body_id == 0)
        np.testing.assert_array_equal(ping.body_echo, whole.body_echo)


@pytest.mark.parametrize(
    "law",
    [
        sg.Counts(low_db=-25.0),
        sg.Counts(low_db=-40.0, gain_db=7.0, bits=16),
        sg.Counts(low_db=-20.0, gain_percentile=95.0),
        sg.Counts("power", exponent=0.5, gain_percentile=99.0),
    ],
    ids=str,
)
def test_labelled_bins_are_those_that_a_display_shows(law):
    """A display is black below 1/32 of full scale; counts are rounded."""
    bodies = [FLOOR, plate("upright", 8.0, -HEIGHT_M, 1.0, y=(-3.0, 3.0))]
    shown = ping(bodies, replace(SONAR, counts=law), LINE_ARRAY, background=["floor"])
    counts, least = shown.counts().astype(float), law.full_scale / 32
    assert (counts[shown.body_id > 0] >= least - 0.51).all() and (shown.body_id > 0).any()
    whole = ping(bodies, acoustics=LINE_ARRAY, background=["floor"], label_level_db=-180.0)
    own = law.settle(shown.intensity).share(whole.share * whole.intensity) * law.full_scale
    assert (shown.body_id[own > least + 0.51] > 0).all()
    assert (shown.body_id > 0).sum() < (whole.body_id > 0).sum()
    np.testing.assert_array_equal(shown.shadow, whole.shadow)
    assert shown.shadow.any()


# a bright pile, which specular lobes make brighter, and at its range, aside, a ball that is seen through far side lobes
BRIGHT_PILE = sg.Body("pile", trimesh.creation.cylinder(0.3, 40, sections=64), sg.pose(10, 0, 0), "steel")
FAR_LOBES = sg.Acoustics.physical(pulse=False)


def ball_aside(db):
    """Return a ball of a reflectivity in dB."""
    at = 9.7 * math.cos(0.2), 9.7 * math.sin(0.2), 0.0
    return sg.Body("ball", trimesh.creation.icosphere(3, 0.2), sg.pose(*at), 10 ** (db / 10))


@pytest.mark.parametrize("db, is_shown", [(-60.0, False), (-10.0, True)])
def test_far_side_lobes_of_a_bright_body_do_not_make_others_visible(db, is_shown):
    """What lies below the lobes is labelled if its own echo reaches the level, on the display and above the noise."""
    level_db = -40.0
    more = {"acoustics": FAR_LOBES, "sampling": sg.Sampling(4, 160), "label_level_db": level_db}
    alone, both = ping([ball_aside(db)], **more), ping([BRIGHT_PILE, ball_aside(db)], **more)
    assert (alone.body_id == 1).any() == is_shown
    whole = ping([BRIGHT_PILE, ball_aside(db)], **more | {"label_level_db": -180.0})
    is_ball = whole.body_id == 2
    lifted = is_ball & (whole.intensity >= np.float32(10 ** (level_db / 10)))
    assert lifted.sum() > 10  # by the side lobes, of the faint ball
    assert (both.body_id == 2).any() == is_shown and (both.body_id == 1).any()
    # where the ball is visible by itself, it is with the pile as well; joined columns err in faint bins
    own = ping([ball_aside(db)], **more | {"label_level_db": -180.0}).intensity
    is_clear = is_ball & (np.abs(np.log2(np.maximum(own, 1e-30)) - np.log2(10 ** (level_db / 10))) > 1)
    np.testing.assert_array_equal((both.body_id == 2)[is_clear], (alone.body_id == 1)[is_clear])
    bright = is_ball & (own > 0.1 * own.max())
    np.testing.assert_allclose((whole.share * whole.intensity)[bright], own[bright], rtol=0.1)


def test_multipath_does_not_make_bodies_visible():
    """Echoes by way of the surface lie over a faint floor below; labels are those of the direct echo."""
    surface = {"surface_z_m": 2.0}
    bodies = [replace(FLOOR, reflectivity=1e-6), plate("wall", 6.0, -1.0, 1.5, y=(-2.0, 2.0))]
    sonar = replace(SONAR, elevation_fov_deg=60.0)
    pings = {}
    for kind in ("none", "incoherent"):
        acoustics = replace(IDEAL, multipath=kind)
        with sg.Simulator(sg.Scene(bodies, **surface), sonar, acoustics, sg.Sampling(2, 160)) as simulator:
            pings[kind] = {
                level_db: simulator.ping(HERE, labels=True, label_level_db=level_db)
                for level_db in (-180.0, -45.0)
            }
    level = np.float32(10**-4.5)
    (direct, shown_direct), (whole, shown) = (tuple(one.values()) for one in pings.values())
    np.testing.assert_array_equal(whole.body_id, direct.body_id)
    own = direct.share * direct.intensity
    np.testing.assert_allclose(whole.share * whole.intensity, own, rtol=1e-5)
    lifted = (whole.body_id > 0) & (whole.intensity >= level) & (own < level)
    assert (lifted & (whole.body_id == 1)).sum() > 100
    clear = np.abs(own / level - 1) > 1e-4
    np.testing.assert_array_equal(shown.body_id[clear], np.where(own >= level, direct.body_id, 0)[clear])
    np.testing.assert_array_equal(shown.body_id[clear], shown_direct.body_id[clear])
    # as for noise of this level
    noise = sg.Noise(ambient_db=-45.0)
    with_more = replace(whole, meta={**whole.meta, "labels_above_noise": True})
    above = own >= receiver_power(whole, noise)
    hidden = add_noise(with_more, noise, 1).body_id
    clear = np.abs(own / receiver_power(whole, noise) - 1) > 1e-4
    np.testing.assert_array_equal(hidden[clear], np.where(above, whole.body_id, 0)[clear])


def assert_same_labels(one, other):
    for name in (*PER_BIN, "shadow", "body_echo"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


AMBIENT = sg.Noise(speckle=True, ambient_db=-28.0)
AUTOMATIC = replace(SONAR, counts=sg.Counts(low_db=-30.0, gain_percentile=95.0))
PHYSICAL = sg.Acoustics.physical(tvg_k=20.0, cross_talk=True)
LEAKY = replace(AUTOMATIC, cross_talk_db=-20.0, self_noise_db=-55.0)


@pytest.mark.parametrize(
    ("sonar", "acoustics", "noise", "more"),
    [
        (AUTOMATIC, IDEAL, AMBIENT, {}),
        (LEAKY, PHYSICAL, sg.Noise.physical(), {"background": ["floor"]}),
        (LEAKY, PHYSICAL, sg.Noise.physical(), {"velocity": (1.0, 0, 0, 0, 0, 0.3)}),
        (replace(LEAKY, common_noise_db=-40.0), PHYSICAL, sg.Noise(self_noise=True), {}),
    ],
    ids=["ambient", "cross-talk", "motion", "common"],
)
def test_labels_are_those_of_bins_above_the_mean_noise(sonar, acoustics, noise, more):
    """Whether the noise comes with the ping or later, alone or in a sequence, and whatever its seed."""
    bodies = [FLOOR, plate("box", 7.0, -HEIGHT_M, -1, y=(-1, 1))]
    with sg.Simulator(sg.Scene(bodies), sonar, acoustics, sg.Sampling(2, 160)) as simulator:
        quiet = simulator.ping(HERE, labels=True, **more)
        noisy = simulator.ping(HERE, noise, 3, True, ping_number=0, **more)
        others = [simulator.ping(HERE, noise, 4, True, ping_number=0, **more)]
        if "velocity" not in more:
            others += simulator.pings([HERE, HERE], noise, 3, True, **more)
    others += [add_noise(quiet, noise, 3), add_noise(quiet, noise, 5, 1)]
    is_above = quiet.share * quiet.intensity >= receiver_power(quiet, noise)
    assert 0 < (is_above & (quiet.body_id > 0)).sum() < (quiet.body_id > 0).sum()
    for name, empty in zip(PER_BIN, (0, np.nan, np.nan, np.nan, 0.0), strict=True):
        array = getattr(quiet, name)
        np.testing.assert_array_equal(
            getattr(noisy, name), np.where(is_above, array, array.dtype.type(empty))
        )
    assert noisy.shadow is None or noisy.shadow.any()
    np.testing.assert_array_equal(noisy.body_echo, quiet.body_echo)
    for other in others:
        assert_same_labels(other, noisy)
    assert (others[0].intensity != noisy.intensity).any()


def test_noise_hides_no_labels_of_a_stated_level():
    for level_db in (-180.0, -40.0):
        quiet = ping([FLOOR], AUTOMATIC, label_level_db=level_db)
        noisy = ping([FLOOR], AUTOMATIC, noise=AMBIENT, seed=3, label_level_db=level_db)
        own = quiet.share * quiet.intensity
        assert (own < receiver_power(quiet, AMBIENT))[quiet.body_id > 0].any()
        assert_same_labels(noisy, quiet)
        assert_same_labels(add_noise(quiet, AMBIENT, 3), quiet)
        assert noisy.meta["label_level_db"] == level_db and "labels_above_noise" not in noisy.meta
    assert ping([FLOOR]).meta["labels_above_noise"] is True
    assert "labels_above_noise" not in ping([FLOOR], labels=False).meta


def test_side_lobes_of_a_pile_in_open_water_mark_no_stripe_where_there_is_noise():
    """A preset's law shows 58 dB: without noise a stripe 10 degrees wide behind the pile has its label."""
    sonar, body = sg.load_sonar("p900-45").with_range(30.0), replace(PILE, pose=sg.pose(20, 0, 0))
    with sg.Simulator(sg.Scene([body]), sonar, sampling=sg.Sampling(4, 100)) as simulator:
        quiet = simulator.ping(HERE, labels=True)
        noisy = simulator.ping(HERE, sg.Noise.physical(), 1, labels=True)
    aside, behind = np.abs(quiet.azimuth_rad) > math.radians(2.0), quiet.range_m > 23.0
    assert (quiet.body_id[aside][:, behind] > 0).sum() > 3000
    assert not noisy.body_id[aside][:, behind].any()
    ahead, face = np.abs(quiet.azimuth_rad) < math.radians(0.5), np.abs(quiet.range_m - 19.86).argmin()
    assert (noisy.body_id[ahead, face] == 1).all()


def test_level_of_labels_in_sequences_and_of_depth_images():
    level_db = -40.0
    with sg.Simulator(sg.Scene([FLOOR]), SONAR, IDEAL, sg.Sampling(2, 160)) as simulator:
        (one,) = simulator.pings([HERE], labels=True, label_level_db=level_db)
    np.testing.assert_array_equal(one.body_id > 0, one.intensity >= np.float32(10 ** (level_db / 10)))
    assert 0 < (one.body_id > 0).sum() < (ping([FLOOR]).body_id > 0).sum()
    camera, image = sg.Camera.of_fov(200, 120, fov_x_rad=1.0), np.full((120, 200), 6.0)
    sonar, numbers = replace(SONAR, elevation_fov_deg=20.0), np.full((120, 200), 3)
    with Sensor(sonar, IDEAL) as sensor:
        got, all_of_it = (
            sensor.ping_from_depth(image, camera, body_id=numbers, labels=True, label_level_db=level_db)
            for level_db in (-15.0, -180.0)
        )
        shown = sensor.ping_from_depth(image, camera, body_id=numbers, labels=True)
        noisy = sensor.ping_from_depth(image, camera, body_id=numbers, labels=True, noise=AMBIENT, seed=1)
    bright = got.share * got.intensity >= np.float32(10**-1.5)
    np.testing.assert_array_equal(got.body_id, np.where(bright, all_of_it.body_id, 0))
    assert 0 < bright.sum() < (all_of_it.body_id > 0).sum()
    is_above = shown.intensity >= receiver_power(shown, AMBIENT)
    np.testing.assert_array_equal(noisy.body_id, np.where(is_above, shown.body_id, 0))
    assert 0 < (noisy.body_id > 0).sum() < (shown.body_id > 0).sum()


def test_level_of_labels_that_is_wrong():
    for more, message in (
        (
            {"label_level_db": -40.0, "labels": False},
            r"label_level_db needs labels=True \(got labels=False\)",
        ),
        ({"label_level_db": -200.0}, r"label_level_db must lie in -180\.\.180 \(got -200"),
        ({"label_level_db": "low"}, "label_level_db must be a number .*'low'"),
        ({"label_level_db": np.nan}, "label_level_db must lie in"),
    ):
        with pytest.raises(sg.Error, match=message):
            ping([FLOOR], **more)


def test_labels_of_depth_images():
    """For a wall before a depth camera cos θ is its distance over the range; the true range is that of the rays."""
    sonar = replace(SONAR, elevation_fov_deg=20.0)
    camera = sg.Camera.of_fov(400, 240, fov_x_rad=1.0)
    numbers = np.full((240, 400), 3)
    numbers[:, :200] = 0  # unknown, to port
    got = sg.ping_from_depth(np.full((240, 400), 6.0), sonar, camera, IDEAL, body_id=numbers, labels=True)
    has_echo = got.share > 0
    assert got.shadow is None and set(got.body_id[has_echo].tolist()) == {0, 3}
    assert got.body_echo[0] == pytest.approx(got.body_echo[3], rel=1e-6) and not got.body_echo[1:3].any()
    assert np.isfinite(got.incidence_rad[has_echo]).all() and np.isnan(got.incidence_rad[~has_echo]).all()
    off = got.incidence_rad[has_echo] - np.arccos(np.minimum(6 / got.true_range_m[has_echo], 1))
    # The angle of the mean range is not the mean angle: of evenly spread ranges the two differ by a 24th of the square
    # of a bin times the curvature, 0.061 degrees at 6.15 m; in the first bin angles change quickly.
    assert np.abs(off[got.true_range_m[has_echo] > 6.1]).max() < math.radians(0.065)
    rounding = 1e-5  # float32 of the plane's samples
    assert np.abs(got.true_range_m - got.range_m)[has_echo].max() <= sonar.bin_size_m / 2 + rounding
    assert got.true_range_m[has_echo].min() == pytest.approx(6.0, abs=rounding)


DEVICE = sg.load_sonar("oculus-m1200d-hf")


def cylinder(yaw_deg):
    """Return a cylinder of 0.6 m by 0.2 m that lies level, 0.9 m below a sonar that is pitched down."""
    mesh = trimesh.creation.cylinder(0.1, 0.6, sections=48)
    mesh.apply_transform(trimesh.transformations.rotation_matrix(math.pi / 2, [0, 1, 0]))
    place = np.linalg.inv(sg.pose(pitch=0.27)) @ sg.pose(3, 0, -0.9, 0, 0, math.radians(yaw_deg))
    return sg.Body("cylinder", mesh, place, 0.9)


EDGE_ON = {
    "plate": sg.Body("plate", trimesh.creation.box((0.5, 0.5, 0.1)), sg.pose(3, 0, -0.07), 0.5),
    "15": cylinder(15),
    "135": cylinder(135),
    "165": cylinder(165),
}


@pytest.mark.parametrize("engine", ["cpu", pytest.param("opengl", marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow if name in ("135", "165") else ()) for name in EDGE_ON]
)
def test_no_label_lies_nearer_or_further_than_its_body(engine, name, monkeypatch):
    """Half a sample beyond a face that is seen edge-on lies far from it: faint, but without noise it had a label."""
    body = EDGE_ON[name]

    def labelled(labels=True):
        with sg.Simulator(
            sg.Scene([body]), DEVICE, sampling=sg.Sampling(1.3, 137), engine=engine
        ) as simulator:
            return simulator.ping(HERE, labels=labels, label_level_db=-180.0 if labels else None)

    low, high = body.mesh.bounds
    sonar = -body.pose[:3, :3].T @ body.pose[:3, 3]  # in the body's frame
    nearest_m = np.linalg.norm(np.maximum(0.0, np.maximum(low - sonar, sonar - high)))  # of its box
    furthest_m = np.linalg.norm(np.asarray(body.mesh.vertices) - sonar, axis=1).max()

    def off_m(ping):
        found_m = ping.true_range_m[ping.body_id > 0]
        return max(nearest_m - found_m.min(), found_m.max() - furthest_m)

    ping = labelled()
    assert off_m(ping) < BEYOND_BODY * DEVICE.bin_size_m
    np.testing.assert_array_equal(ping.intensity, labelled(labels=False).intensity)
    monkeypatch.setattr(scene_meshes, "body_spans", lambda *_: NO_SPANS)
    other = labelled()
    assert off_m(other) > 0.05
    # what is moved is faint
    assert np.abs(other.intensity - ping.intensity).sum() < 1e-3 * ping.intensity.sum()


@pytest.mark.parametrize("engine", ["cpu", "opengl"])
@pytest.mark.parametrize("yaw_deg", [10, *(pytest.param(n, marks=pytest.mark.slow) for n in (5, 20, 45))])
@pytest.mark.parametrize("tolerance", [0.1, 0.01])
def test_no_label_lies_nearer_than_the_upright_edge_of_a_box(engine, tolerance, yaw_deg):
    """A sample that meets a face beside its edge reaches half of its width beyond: at 12 m up to 0.9 m before it."""
    box = sg.Body("box", trimesh.creation.box((1, 1, 2)), reflectivity=0.5)
    sonar = sg.load_sonar("p900-45")
    with sg.Simulator(
        sg.Scene([box]), sonar, sg.Acoustics.ideal(), tolerance=tolerance, engine=engine
    ) as simulator:
        for y in np.linspace(0.94, 1.06, 5):
            pose = sg.pose(12, y, yaw=math.radians(yaw_deg))
            ping = simulator.ping(sg.pose(), labels=True, label_level_db=-180.0, bodies={"box": pose})
            here = -pose[:3, :3].T @ pose[:3, 3]  # the sonar, in the axes of the box
            nearest_m = np.linalg.norm(np.maximum(np.abs(here) - [0.5, 0.5, 1], 0))
            first_m = ping.range_m[(ping.body_id > 0).any(axis=0)][0] + sonar.bin_size_m / 2
            assert first_m > nearest_m - BEYOND_BODY * sonar.bin_size_m


@pytest.mark.slow
@pytest.mark.parametrize(
    ("s", "a", "b", "ends"),
    [
        (0.3, 0.01, 0.02, (0.28, 0.36)),  # of its ends the further one is moved
        (0.3, 0.1, 0.2, (0.28, 0.32)),
        (0.3, 0.2, 4.0, (0.28, 0.32)),  # from behind the sonar to its horizon
        (0.3, 0.005, 0.01, (0.28, 0.32)),  # fits
        (0.3, 0.01, 0.02, (0.32, 0.36)),  # its middle lies beyond
        (0.3, 0.001, 0.004, (0.31, 0.36)),  # all of it does
    ],
)
def test_a_long_footprint_is_kept_between_two_ranges_with_its_echo(s, a, b, ends):
    work = work_table.make_work()
    work[[work_table.S, work_table.A, work_table.B, work_table.ENERGY], 7] = s, a, b, 0.6
    keep_within(work, 7, *ends)
    middle, half = work[work_table.S, 7], work[work_table.A, 7] + work[work_table.B, 7]
    far, near = max(s - a - b, ends[0]), min(s + a + b, ends[1])
    expected = ((far + near) / 2, (near - far) / 2) if near > far else (ends[0], 0.0)
    assert (middle, half) == pytest.approx(expected, abs=1e-15)
    assert work[work_table.ENERGY, 7] * middle == pytest.approx(0.6 * s, rel=1e-14)
    if half > 0:
        assert work[work_table.A, 7] / half == pytest.approx(a / (a + b), rel=1e-14)


@pytest.mark.parametrize("n_beams, n_bins", [(1, 1), (1, 65), (4, 64), (5, 63)])
def test_few_beams_and_bins(n_beams, n_bins):
    """Kernels take beams by fours and bins by sixty-fours, in two threads, one of which may have no work here."""
    sonar = replace(SONAR, n_beams=n_beams, n_bins=n_bins)
    found = ping([FLOOR, plate("wall", 9.0, -3.0, 3.0)], sonar)
    assert found.intensity.any()
    np.testing.assert_array_equal(found.body_id > 0, found.intensity > 0)
    np.testing.assert_allclose(found.body_echo.sum(), found.intensity.sum(dtype=float), rtol=1e-5)
    assert np.isfinite(found.true_range_m[found.body_id > 0]).all()


def test_runs_are_sorted_by_body_and_column_and_columns_share_those_of_wide_ones():
    rng, n_columns = np.random.default_rng(0), 6
    wide_edges, wide_shares = np.array([1, 3, 6]), np.float32([0, 0.4, 0.6, 0.2, 0.3, 0.5])
    stores, expected = [], []
    for half, n in enumerate((40, 25)):
        runs = np.column_stack(
            [rng.integers(0, 9, n), rng.integers(0, n_columns + 2, n), rng.integers(0, 99, (n, 3))]
        )
        runs[:, BODY] *= 2  # some numbers are of no body
        stores.append((np.vstack([runs, runs[:1]]), n, np.empty(0, np.float32), 0))
        for run in runs:
            wide = run[COLUMN] - n_columns
            columns = [run[COLUMN]] if wide < 0 else range(*wide_edges[wide : wide + 2])
            expected += [
                (run[BODY], column, *run[2:], half, 1 if wide < 0 else wide_shares[column])
                for column in columns
            ]
    expected.sort(key=lambda run: run[:2])  # those of one body and column stay in their order
    found = Runs(*sort_runs(tuple(stores), n_columns, wide_edges, wide_shares))
    rows = np.column_stack([found.table, found.owner, found.share])
    assert np.array_equal(rows, np.array(expected))
    assert np.array_equal(found.bodies, np.unique(found.table[:, BODY]))
    numbers = np.repeat(found.bodies, np.diff(found.begins))
    assert found.begins[0] == 0 and np.array_equal(numbers, found.table[:, BODY])
