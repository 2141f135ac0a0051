"""The walk over strips: where the footprint of each sample ends, by planes whose edges are known exactly."""

import math
import types

import numpy as np
import pytest
import trimesh

import sonar_gl as sg
from sonar_gl.beamform.beamformer import make_beamformer
from sonar_gl.beamform.kernels.range_bins import bin_table
from sonar_gl.beamform.kernels.strips import Lattice, StripTable, find_strip
from sonar_gl.beamform.kernels.work_table import BORDER, MAX_STRIP_ROWS, make_work
from sonar_gl.core.errors import SampleLimitError
from sonar_gl.sonar.samples import NO_FACES

EDGES = np.linspace(0.5, 30.0, 100)
ROWS, STEP = 40, 0.01  # upright lattice of one column, v from -0.195 to 0.195
V = (np.arange(ROWS) - (ROWS - 1) / 2) * STEP
HALF_WAY = (V[1:] + V[:-1]) / 2


class Plane:
    """A plane seen from the sonar: 1/x = q + along_v v + along_u u."""

    def __init__(self, q, along_v, along_u=0.0):
        self.q, self.along_v, self.along_u = q, along_v, along_u

    def sample(self, v):
        """Return what the shader writes of a sample at u = 0."""
        return self.q + self.along_v * v, self.along_u, self.along_v, 1.0

    def meets(self, other):
        """Return v of the edge where two planes meet at u = 0."""
        return (other.q - self.q) / (self.along_v - other.along_v)


def borders(samples, u=0.0):
    """Return v where the footprints of rows 1, 2, ... begin; `samples` are (ROWS, 4)."""
    lattice = Lattice(np.array([0.0, STEP, 0.0]), np.array([V[0], 0.0, STEP]), -0.2, 0.2, 1, 0.0, 1.0)
    top = np.array([0.2 * math.hypot(1.0, u)])
    strips = StripTable(np.array([0]), np.array([u]), np.array([STEP]), -top, top, False)
    work = make_work()
    work[:, : 2 * ROWS] = np.nan
    image = np.asarray(samples, np.float32).reshape(ROWS, 1, 4)
    strip = find_strip(work, image, NO_FACES, lattice, strips, 0, bin_table(EDGES).q_unseen, (0.0, 0.0))
    return strip, work[BORDER, : ROWS + 1]


def scene_of(v_edge, low, high):
    """Return samples of one plane below v_edge, and of another above; None is open water."""
    nothing = (0.0, 0.0, 0.0, 0.0)
    planes = [low if v < v_edge else high for v in V]
    return [nothing if plane is None else plane.sample(v) for plane, v in zip(planes, V, strict=True)]


def test_planes_that_meet_between_two_rays_share_their_edge():
    """Half way would move up to half a sample of the one body's echo to the other's range."""
    rng = np.random.default_rng(3)
    tried = 0
    for _ in range(400):
        low, high = Plane(*rng.uniform((0.05, -1), (0.5, 1))), Plane(*rng.uniform((0.05, -1), (0.5, 1)))
        edge = low.meets(high)
        samples = scene_of(edge, low, high)
        if not (V[1] < edge < V[-2] and min(q for q, *_ in samples) > 0.01):
            continue
        above = int(np.searchsorted(V, edge))
        if abs((edge - HALF_WAY[above - 1]) * (low.along_v - high.along_v)) < 1e-4:
            continue  # nearly parallel, where half way is as good
        _, found = borders(samples)
        # float32 keeps 1/x and slopes to 6e-8 of values below 1, and the edge to that over the turn
        assert found[above] == pytest.approx(edge, abs=1e-6 / abs(low.along_v - high.along_v))
        others = np.delete(np.arange(1, ROWS), above - 1)
        np.testing.assert_allclose(found[others], HALF_WAY[others - 1], atol=1e-12)
        tried += 1
    assert tried > 50


@pytest.mark.parametrize("row", [1, 20, ROWS - 2])
@pytest.mark.parametrize("half_m", [0.003, 0.0049, 0.0051, 0.008])
def test_a_face_narrower_than_rows_are_apart_has_the_place_of_a_row(row, half_m):
    """Other rows miss it: where one meets it, it stands for all where none does. A wider one has its own place."""
    face = Plane(0.2 - 2.0 * V[row], 2.0)
    # below and above its ray it meets the planes of the other rows
    below, above = (
        Plane(face.sample(v)[0] - slope * v, slope)
        for v, slope in ((V[row] - half_m, 0.1), (V[row] + half_m, -0.1))
    )
    samples = [(below if v < V[row] else face if v == V[row] else above).sample(v) for v in V]
    _, found = borders(samples)
    expected = HALF_WAY.copy()
    if 2 * half_m > STEP:
        expected[row - 1 : row + 1] = V[row] - half_m, V[row] + half_m
    np.testing.assert_allclose(found[1:ROWS], expected, rtol=0, atol=1e-6)


def test_a_face_of_a_single_row_that_another_hides_has_the_place_of_a_row():
    """The height of what is seen of it is not known."""
    below, face, nearer = Plane(0.2, 0.1), Plane(0.2 + 2.0 * 0.003, 2.1), Plane(0.5, 0.0)
    row = 20
    below, face = (Plane(plane.q - plane.along_v * V[row], plane.along_v) for plane in (below, face))
    assert V[row - 1] < below.meets(face) < V[row]
    samples = [(below if v < V[row] else face if v == V[row] else nearer).sample(v) for v in V]
    np.testing.assert_allclose(borders(samples)[1][1:ROWS], HALF_WAY, rtol=0, atol=1e-12)
    samples[row + 1] = face.sample(V[row + 1])  # with two rows it is no narrower than rows are apart
    assert borders(samples)[1][row] == pytest.approx(below.meets(face), abs=1e-6)


def test_the_tangent_planes_of_a_curved_surface_share_no_edge():
    """They meet outside it: up to their edges they return more than the surface, most of all near its outline."""
    distance, radius = 5.0, 0.9  # of an upright circle about (distance, 0)
    samples = []
    for v in V:
        inside = distance**2 - (1 + v * v) * (distance**2 - radius**2)
        if inside <= 0:
            samples.append((0.0, 0.0, 0.0, 0.0))
            continue
        x = (distance - math.sqrt(inside)) / (1 + v * v)
        normal = (
            x - distance,
            v * x,
        )  # of the tangent, on which normal · (x, z) is that of the place that is met
        level = normal[0] * x + normal[1] * v * x
        samples.append(Plane(normal[0] / level, normal[1] / level).sample(v))
    assert 30 < sum(q > 0 for q, *_ in samples) < ROWS
    np.testing.assert_allclose(borders(samples)[1][2 : ROWS - 1], HALF_WAY[1:-1], rtol=0, atol=1e-12)


def test_level_bars_return_as_much_as_they_should():
    """Seen from a little above, each shows a bright front and a narrow dark top, which most rows miss.

    With edges wherever two planes meet, the front had most of the top's place: 5 % too much in all, which coarser
    samples had, too, so that no estimate showed it.
    """
    bars = [trimesh.creation.box((0.0076, 2.0, 0.0076)) for _ in range(30)]
    for number, bar in enumerate(bars):
        bar.apply_translation((0.0, 0.0, 0.0331 * (number - 14.5)))
    scene = sg.Scene([sg.Body("bars", trimesh.util.concatenate(bars), sg.pose(6.7, pitch=0.2))])
    sonar = sg.Sonar("bars", 900e3, 12, 100, 12.0, 14.0, 1.0, 0.5, 10.0)

    def echo(rows):
        with sg.Simulator(scene, sonar, sg.Acoustics.ideal(), sg.Sampling(8, rows)) as simulator:
            return simulator.ping(sg.pose()).intensity.sum(dtype=float)

    true = echo(4000)
    assert echo(270) == pytest.approx(true, rel=0.015)
    assert echo(190) == pytest.approx(true, rel=0.015)


def test_a_slight_bend_is_an_edge():
    """Slopes that differ by 1/100 are two faces."""
    edge = V[20] - 0.0006
    low, high = Plane(0.2, 0.5), Plane(0.2 - 0.005 * edge, 0.505)
    assert low.meets(high) == pytest.approx(edge)
    _, found = borders(scene_of(edge, low, high))
    assert found[20] == pytest.approx(edge, abs=1e-6 / 0.005)


def test_noise_is_no_edge():
    """Eight steps of float32, as graphics cards may err in 1/w, do not make two faces of one."""
    rng = np.random.default_rng(4)
    for _ in range(50):
        exact = np.array([Plane(0.3, *rng.uniform(-1, 1, 2)).sample(v) for v in V])
        noisy = exact * (1 + 2**-24 * rng.uniform(-8, 8, exact.shape) * [1, 1, 1, 0])
        _, found = borders(noisy)
        np.testing.assert_allclose(found[1:ROWS], HALF_WAY, atol=1e-12)


def test_a_body_before_another_ends_half_way():
    """Their planes meet elsewhere, or not at all: nothing tells where between the rays the nearer one ends."""
    for near, far in ((Plane(0.5, 0.0), Plane(0.1, 0.0)), (Plane(0.5, 0.3), Plane(0.1, -0.3))):
        _, found = borders(scene_of(0.0, near, far))
        np.testing.assert_allclose(found[1:ROWS], HALF_WAY, atol=1e-12)


@pytest.mark.parametrize("horizon", [0.0021, 0.0721, -0.1279], ids=["level", "nose up", "nose down"])
@pytest.mark.parametrize("flipped", [False, True])
def test_a_floor_extends_to_its_horizon(flipped, horizon):
    """The last row that meets a grazing floor stands for all of it up to where it leaves the range."""
    sign = -1.0 if flipped else 1.0  # a ceiling
    horizon *= sign  # between two rays, and not half way
    # half a metre below, so that the last ray meets it in range
    floor = Plane(2 * horizon * sign, -2.0 * sign)
    assert floor.sample(horizon)[0] == pytest.approx(0.0, abs=1e-12)
    seen = [plane if (plane := floor.sample(v))[0] > 0 else (0.0, 0.0, 0.0, 0.0) for v in V]
    strip, found = borders(seen)
    row = int(np.searchsorted(V, horizon))
    assert V[row - 1] < horizon < V[row]
    # float32 keeps 1/x below 0.7 to 3e-8, and the horizon to that over the slope of 2
    assert found[row] == pytest.approx(horizon, abs=1e-7)
    assert (strip.first, strip.last) == ((row, ROWS) if flipped else (0, row))
    inner = slice(strip.first + 1, strip.last)
    np.testing.assert_allclose(found[inner], HALF_WAY[strip.first : strip.last - 1], atol=1e-12)


@pytest.mark.parametrize("v_edge", [0.0031, 0.0731, -0.1269])
@pytest.mark.parametrize("flipped", [False, True])
def test_a_plate_before_open_water_ends_half_way(flipped, v_edge):
    """Its plane would go on in range: it ends at an edge, anywhere between the two rays."""
    plate, row = Plane(0.2, 0.1), int(np.searchsorted(V, v_edge))
    strip, found = borders(scene_of(v_edge, *((None, plate) if flipped else (plate, None))))
    assert found[row] == pytest.approx(HALF_WAY[row - 1], abs=1e-12)
    assert (strip.first, strip.last) == ((row, ROWS) if flipped else (0, row))


def test_planes_are_taken_to_the_middle_of_the_strip():
    """The sample lies beside the strip's middle by up to half a sample; its plane is known there, too."""
    wall, other = Plane(0.2, 0.3, 0.4), Plane(0.21, -0.5, -0.2)
    u = 0.3 * STEP
    edge = (other.q + other.along_u * u - wall.q - wall.along_u * u) / (wall.along_v - other.along_v)
    _, found = borders(scene_of(edge, wall, other), u=u)
    assert found[int(np.searchsorted(V, edge))] == pytest.approx(edge, abs=1e-6)


def test_the_ends_of_the_aperture_end_footprints():
    strip, found = borders(scene_of(0.0, Plane(0.2, 0.0), Plane(0.2, 0.0)))
    assert (found[0], found[ROWS]) == (-0.2, 0.2)
    strip, found = borders(scene_of(0.0, Plane(0.2, 0.0), Plane(0.2, 0.0)), u=0.4 * STEP)
    assert found[ROWS] == pytest.approx(0.2 * math.hypot(1, 0.4 * STEP))
    assert (strip.first, strip.last) == (0, ROWS)


def test_more_rows_than_there_is_room_for_are_refused():
    """Kernels do not look where their memory ends. The side lobes of a low aperture reach far beyond it."""
    sonar, acoustics = sg.Sonar("low", 900e3, 4, 100, 45.0, 1.0, 1.0, 0.5, 15.0), sg.Acoustics.physical()
    fitting = make_beamformer(sonar, acoustics, sg.Sampling(1, 1_000))
    assert 1_000 < max(sector.rows for sector in fitting.fan.sectors) <= MAX_STRIP_ROWS
    with pytest.raises(SampleLimitError, match=f"no more than {MAX_STRIP_ROWS} rows of samples"):
        make_beamformer(sonar, acoustics, sg.Sampling(1, 16_000))


@pytest.mark.slow
def test_of_a_strip_without_rows_no_sample_is_read():
    """Its middle row would lie far beyond the samples. Compiled code reads there; the same code in Python refuses."""
    in_python = {**find_strip.py_func.__globals__, "as_table": lambda table, *_: table}
    find = types.FunctionType(find_strip.py_func.__code__, in_python)
    lattice = Lattice(np.array([0.0, STEP, 0.0]), np.array([V[0], 0.0, STEP]), -0.2, 0.2, 1, 0.0, 1.0)
    far_above = np.array([50.0]), np.array([51.0])
    strips = StripTable(np.array([0]), np.array([0.0]), np.array([STEP]), *far_above, False)
    image, faces = np.ones((ROWS, 1, 4), np.float32), np.zeros((ROWS, 1), np.int32)
    strip = find(make_work(), image, faces, lattice, strips, 0, bin_table(EDGES).q_unseen, (0.1, 1.0))
    assert strip.first == strip.last
