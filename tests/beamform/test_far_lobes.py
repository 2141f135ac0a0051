"""Far side lobes against the pattern itself: all beams over all columns, a floor, and the level of a wall."""

import math
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
import trimesh

import sonar_gl as sg
from sonar_gl.acoustics.beam_pattern import ArrayPattern
from sonar_gl.beamform.beamformer import make_beamformer
from sonar_gl.beamform.far_lobes import LOBES, TOLERANCE, far_lobes, make_lobe_blocks
from sonar_gl.beamform.workspace import Workspace
from sonar_gl.engine.no_echo import NoEchoWarning
from sonar_gl.sonar.fan import Fan
from sonar_gl.sonar.sonar_files import presets
from tests.support.processes import python

P900 = sg.load_sonar("p900-45")
PHYSICAL = sg.Acoustics.physical(elevation_pattern="box")
DEVICES = {
    "uniform": P900,
    "no floor": replace(P900, element_error_db=None),
    "hamming": replace(P900, receive_taper="hamming"),
    "taylor": replace(P900, receive_taper="taylor", element_error_db=None),
    "chebyshev": replace(P900, receive_taper="chebyshev", element_error_db=-45.0),
    "straight": replace(P900, azimuth_fov_deg=100.0, steered="straight", beam_spacing="sine"),
    "transmit beam": replace(P900, transmit_width_deg=40.0),
    "fewer beams than moments": replace(P900, n_beams=30),
    "full circle": replace(P900, azimuth_fov_deg=360.0, beam_width_deg=4.0),
    "one beam": replace(P900, n_beams=1, azimuth_fov_deg=30.0),
}
FAST = "chebyshev", "straight", "transmit beam", "full circle", "one beam"
SOME_SLOW = [pytest.param(name, marks=() if name in FAST else pytest.mark.slow) for name in DEVICES]


def fan_and_weights(sonar, acoustics, columns_per_beam=1) -> tuple[Fan, np.ndarray]:
    """Return the fan, and (B, columns) what each beam receives of columns that hold 1, each in a bin of its own."""
    workspace = Workspace()
    former = make_beamformer(sonar, acoustics, sg.Sampling(columns_per_beam, 16), workspace=workspace)
    fan = former.fan
    columns = workspace.column_sums(fan.n_columns, sonar.n_bins)
    n_columns, n_bins = columns.sums.shape
    out = np.empty((fan.sonar.n_beams, n_columns))
    for begin in range(0, n_columns, n_bins):
        k = np.arange(min(n_bins, n_columns - begin))
        columns.sums[:], columns.spans[:] = 0, (n_bins, 0)
        columns.sums[begin + k, k] = 1
        columns.spans[begin + k] = np.column_stack([k, k + 1])
        out[:, begin + k] = former.weigh(columns, np.empty(0, np.float32)).intensity[:, k]
    return fan, out


@pytest.mark.parametrize("far_side_lobes", [False, True])
@pytest.mark.parametrize("name", SOME_SLOW)
def test_the_response_of_columns_is_the_sum_of_all_beams(name, far_side_lobes):
    sonar, acoustics = DEVICES[name], replace(PHYSICAL, far_side_lobes=far_side_lobes)
    _, found = fan_and_weights(sonar, acoustics)
    sampling, workspace = sg.Sampling(1, 16), Workspace()
    fan = make_beamformer(sonar, acoustics, sampling, workspace=workspace).fan
    # the weights of these columns are kept, so that none are made
    weights, lobes = workspace.weights(fan.column_edges_rad, None)
    assert (lobes is not None) == far_side_lobes
    # float32 products of some hundred weights
    response = (lobes or weights).column_response
    np.testing.assert_allclose(response, found.sum(axis=0), rtol=1e-5, atol=1e-6 * found.sum(axis=0).max())


@pytest.mark.parametrize("name", DEVICES)
def test_the_halves_of_beams_expand_moments_of_their_own(name):
    sonar, workspace = DEVICES[name], Workspace()
    fan = make_beamformer(sonar, PHYSICAL, sg.Sampling(1, 16), workspace=workspace).fan
    _, lobes = workspace.weights(fan.column_edges_rad, None)
    (beams, tiles), (more_beams, more_tiles) = lobes.halves
    assert (beams[0], beams[1], more_beams[1]) == (0, more_beams[0], sonar.n_beams)
    assert (tiles[0], tiles[1], more_tiles[1]) == (0, more_tiles[0], len(lobes.couple.first))
    used = lobes.first_moment[:, None] + np.arange(lobes.expansion.shape[1])
    for half, (first, last) in ((slice(*beams), tiles), (slice(*more_beams), more_tiles)):
        assert (used[half] >= 4 * first).all() and (used[half] < 4 * last).all()


@pytest.mark.parametrize("name", SOME_SLOW)
def test_beams_weigh_all_columns_by_the_pattern(name):
    """Within the support exactly, beyond it within TOLERANCE of the floor and the side lobe's peak."""
    sonar = DEVICES[name]
    # a single beam has its columns in the support alone, and needs finer ones for any to lie inside
    is_one = sonar.n_beams == 1
    fan, weights = fan_and_weights(sonar, PHYSICAL, 300 if is_one else 1)
    edges, axes = fan.column_edges_rad, sonar.azimuth_rad[:, None, None]
    nodes, parts = np.polynomial.legendre.leggauss(8)
    azimuths = edges[:-1, None] + np.diff(edges)[:, None] * (nodes + 1) / 2
    pattern, transmit = PHYSICAL.receive_pattern(sonar), PHYSICAL.transmit_pattern(sonar)
    received = pattern(azimuths, axes) @ (parts / 2)
    insonified = np.ones(fan.n_columns) if transmit is None else transmit(azimuths) @ (parts / 2)
    middles = (edges[1:] + edges[:-1]) / 2
    heights = 2 * math.sin(math.radians(sonar.elevation_fov_deg) / 2)
    if fan.are_cones:  # an arc about the array's axis of radius cos β
        heights = 2 * np.cos(middles) * np.arcsin(heights / 2 / np.cos(middles))
    found = weights * (received @ (np.diff(edges) * heights))[:, None]
    far = PHYSICAL.far_pattern(sonar)
    difference = far.coordinate(middles) - far.coordinate(sonar.azimuth_rad)[:, None]
    null, column = far.array.support_sine(), np.diff(edges).max()
    u, in_front = far.sine_of(difference), pattern(middles, sonar.azimuth_rad[:, None]) > 0
    support = in_front & (u < null - column)
    # the solid angle that normalises a beam holds the far side lobes' error, and lacks what fades off
    # before 90 degrees, of a floor of -38 dB and beams of 4 degrees 2.3e-3 of it
    exact = received * insonified
    np.testing.assert_allclose(found[support], exact[support], rtol=3e-3, atol=1e-6)
    beyond = far.is_far(difference) & in_front & (u > null + column)
    assert support.any() and beyond.any() != is_one
    error = np.abs(found - exact) / (far.peak(difference) * insonified)
    # TOLERANCE bounds the error at nodes; 16 of them a lobe are interpolated linearly, off by 1 % of its peak
    # along beams and as much along columns
    assert error[beyond].max(initial=0) < TOLERANCE + 0.02


def test_all_memory_that_they_hold_is_counted():
    """Stages are given back by it: what the response is made from is larger than the other tables."""
    workspace = Workspace()
    edges = make_beamformer(P900, PHYSICAL, sg.Sampling(1, 16), workspace=workspace).fan.column_edges_rad
    weights, _ = workspace.weights(edges, None)  # and their blocks are kept, too
    blocks = make_lobe_blocks(PHYSICAL.far_pattern(P900), P900.azimuth_rad, (edges[0], edges[-1]))
    tracemalloc.start()
    try:
        lobes = far_lobes(blocks, weights, edges)
        held = tracemalloc.get_traced_memory()[0]
    finally:
        tracemalloc.stop()
    # but for a few objects and arrays of one dimension
    assert lobes.n_bytes == pytest.approx(held, rel=0.05)


FEW_NODES = {
    **{name: DEVICES[name] for name in ("uniform", "taylor", "straight", "transmit beam")},
    # the widest beam's support is many times as wide as the others', whose patterns change as fast as ever
    "straight, wide": replace(
        P900,
        n_beams=32,
        azimuth_fov_deg=150.0,
        beam_width_deg=1.0,
        steered="straight",
        receive_taper="uniform",
    ),
    # the support ends at the 12th null
    "60 dB": replace(
        P900, azimuth_fov_deg=150.0, beam_width_deg=1.5, receive_taper="taylor", side_lobe_db=60.0, n_beams=50
    ),
    "narrow transmit beam": replace(
        P900, n_beams=8, azimuth_fov_deg=90.0, beam_width_deg=11.0, transmit_width_deg=5.0
    ),
}


@pytest.mark.parametrize("name", FEW_NODES)
def test_few_nodes_give_the_means_of_columns_to_the_last_bit_of_float32(name, monkeypatch):
    """Two nodes would not."""
    sonar, acoustics = FEW_NODES[name], replace(PHYSICAL, far_side_lobes=False)

    def weights():
        workspace = Workspace()
        edges = make_beamformer(
            sonar, acoustics, sg.Sampling(1, 16), workspace=workspace
        ).fan.column_edges_rad
        return workspace.weights(edges, None)[0].weights.astype(float)

    found = weights()
    monkeypatch.setattr("sonar_gl.beamform.weights.GAUSS_NODES", ((math.inf, 24),))
    exact = weights()
    monkeypatch.setattr("sonar_gl.beamform.weights.GAUSS_NODES", ((math.inf, 2),))
    too_few = weights()
    last_bit = np.finfo(np.float32).eps * exact.max()
    # where the support ends the pattern does in a step, which no rule resolves
    inside = exact > 1e-5 * exact.max()
    assert np.abs(found - exact)[inside].max() <= last_bit < np.abs(too_few - exact)[inside].max()


@pytest.mark.parametrize(
    "name", [name for name, sonar in DEVICES.items() if sonar.transmit_width_deg is None]
)
def test_a_wall_all_round_has_the_level_1_in_all_beams(name):
    former = make_beamformer(DEVICES[name], PHYSICAL, sg.Sampling(1, 16))
    # float32 sums of some hundred columns
    np.testing.assert_allclose(former.even_response, 1, rtol=1e-6)


@pytest.mark.parametrize("name", presets())
def test_far_side_lobes_of_the_presets_keep_the_tolerance_and_cost_less_than_a_product(name):
    sonar = presets()[name]
    support, pattern = PHYSICAL.receive_support_rad(sonar), PHYSICAL.far_pattern(sonar)
    ends = sonar.azimuth_rad[0] - support, sonar.azimuth_rad[-1] + support
    blocks = make_lobe_blocks(pattern, sonar.azimuth_rad, ends)
    assert blocks.error <= TOLERANCE
    # others are too few beams for blocks
    if sonar.beam_width_deg > 2 * sonar.azimuth_fov_deg / sonar.n_beams:
        columns = 2 * sonar.n_beams * (ends[1] - ends[0]) / math.radians(sonar.azimuth_fov_deg)  # at least
        products = blocks.coupling.size + blocks.expansion.size + blocks.rank * columns
        assert products < 0.8 * sonar.n_beams * columns


def test_the_pattern_is_decomposed_once_for_each_size_of_block_that_is_tried(monkeypatch):
    """Bisections try few sizes, and all numbers of functions share a decomposition: setting up is quick."""
    sizes, eigh = [], np.linalg.eigh

    def counted(matrix):
        sizes.append(len(matrix))
        return eigh(matrix)

    monkeypatch.setattr(np.linalg, "eigh", counted)
    sonar = replace(P900, n_beams=251)  # blocks of no other test
    support = PHYSICAL.receive_support_rad(sonar)
    ends = sonar.azimuth_rad[0] - support, sonar.azimuth_rad[-1] + support
    make_lobe_blocks(PHYSICAL.far_pattern(sonar), sonar.azimuth_rad, ends)
    assert sorted(set(sizes)) == sorted(sizes)
    assert 0 < len(sizes) < len(LOBES)


LAPACK_THREADS = """
import numpy as np
import threadpoolctl

made, during, decompose, Controller = [], [], np.linalg.eigh, threadpoolctl.ThreadpoolController

def threads():
    return [one["num_threads"] for one in Controller().select(user_api="blas").info()]

def noted(matrix):
    during.append(threads())
    return decompose(matrix)

class Noted(Controller):
    def __init__(self):
        made.append(self)
        super().__init__()

np.linalg.eigh, threadpoolctl.ThreadpoolController = noted, Noted
from tests.beamform.test_far_lobes import P900, PHYSICAL, make_lobe_blocks, replace

before = threads()
for width_deg in (1.0, 2.0):
    sonar = replace(P900, beam_width_deg=width_deg)
    make_lobe_blocks(PHYSICAL.far_pattern(sonar), sonar.azimuth_rad, (-0.5, 0.5))
assert len(made) == 1, f"{len(made)} searches"
assert len(during) > 1 and during == [[1] * len(before)] * len(during), during
assert threads() == before, (threads(), before)
print(*before)
"""


@pytest.mark.slow
def test_lapack_has_one_thread_and_is_looked_for_once():
    """To look through the libraries of the process takes longer than the rest of a small sonar's weights.

    Another process has loaded NumPy's libraries alone, and decomposed nothing yet.
    """
    settings = {f"{name}_NUM_THREADS": "2" for name in ("OPENBLAS", "OMP", "MKL")}
    assert python("-c", LAPACK_THREADS, environment=settings, check=True).stdout.split()


def test_a_signal_handler_may_make_a_sonar_while_lapack_is_at_work(monkeypatch):
    """Early versions hung: the handler waited for LAPACK, which the code below it had."""
    real, others = np.linalg.eigh, []

    def eigh(*args, **more):
        if not others:  # as a handler that comes here
            others.append(None)
            others.append(fan_and_weights(replace(P900, n_beams=40), PHYSICAL)[1])
        return real(*args, **more)

    expected = fan_and_weights(replace(P900, n_beams=50), PHYSICAL)[1]
    monkeypatch.setattr(np.linalg, "eigh", eigh)
    sonar = replace(P900, n_beams=50, azimuth_fov_deg=44.9)
    fan_and_weights(sonar, PHYSICAL)
    assert len(others) == 2
    np.testing.assert_array_equal(fan_and_weights(replace(P900, n_beams=50), PHYSICAL)[1], expected)


def test_a_floor_alone_is_exact():
    """Of a Hamming array all lobes are weak; what floors of -20 and -30 dB add differs by their difference."""
    sonar = replace(P900, receive_taper="hamming")
    weights = {}
    for level in (-20.0, -30.0):
        device = replace(sonar, element_error_db=level)
        fan, found = fan_and_weights(device, PHYSICAL)
        edges = fan.column_edges_rad
        power = PHYSICAL.receive_pattern(device)((edges[1:] + edges[:-1]) / 2, device.azimuth_rad[:, None])
        weights[level] = found * (power @ np.diff(edges))[:, None]
        far = PHYSICAL.far_pattern(device)
    sines = far.sine_of((edges[1:] + edges[:-1]) / 2 - device.azimuth_rad[:, None])
    beyond = sines > far.array.support_sine() + np.diff(edges).max()
    height = 2 * math.sin(math.radians(10))
    added = (weights[-20.0] - weights[-30.0])[beyond] * height
    # the blocks of both differ, each within TOLERANCE of lobes of -43 dB; and the solid angle, by 1e-3 of the floor
    np.testing.assert_allclose(added, 0.01 - 0.001, atol=3 * TOLERANCE * 10**-4.27)


def test_a_bright_post_spreads_over_the_fan_as_the_pattern_says():
    """The arc of a post, to 30 degrees from it, is within 1 dB of theory, but for the depths of nulls."""
    azimuth = math.radians(-14.87)
    post = sg.Body(
        "post",
        trimesh.creation.box((0.004, 0.004, 20)),
        sg.pose(10 * math.cos(azimuth), 10 * math.sin(azimuth), 0, 0, 0, azimuth),
    )
    sonar = replace(P900.with_range(12.0), n_beams=250)
    with sg.Simulator(sg.Scene([post]), sonar, PHYSICAL, sg.Sampling(12, 200)) as simulator:
        received = simulator.ping(np.eye(4)).intensity.sum(axis=1)
    array = ArrayPattern("line_array", math.radians(1.0))
    off = sonar.azimuth_rad - azimuth
    want = array.power(np.sin(off)) + 10**-3.8
    peak = PHYSICAL.far_pattern(sonar).peak(off)
    difference_db = 10 * np.log10(received / received.max() / (want / want.max()))
    lobes = (np.abs(np.degrees(off)) < 30) & ((want > 0.3 * peak) | (np.abs(off) < np.radians(4)))
    assert lobes.sum() > 100
    assert np.abs(difference_db[lobes]).max() < 1.0


@pytest.mark.parametrize("beside, is_received", [(0.6, True), (0.85, True), (1.1, False)])
def test_beams_receive_what_lies_beside_the_fan_as_far_as_the_support_of_the_outermost(beside, is_received):
    """Within it the outermost beam has the level of its pattern, away from nulls; beyond it no beam receives."""
    sonar = P900.with_range(12.0)
    azimuth = sonar.azimuth_rad[-1] + beside * PHYSICAL.receive_support_rad(sonar)

    def received_from(psi):
        place = sg.pose(10 * math.cos(psi), 10 * math.sin(psi))
        post = sg.Body("post", trimesh.creation.box((0.004, 0.004, 20)), place @ sg.pose(yaw=psi))
        with sg.Simulator(sg.Scene([post]), sonar, PHYSICAL, sg.Sampling(12, 200)) as simulator:
            return simulator.ping(np.eye(4)).intensity.sum(axis=1)

    if not is_received:
        with pytest.warns(NoEchoWarning):
            assert not received_from(azimuth).any()
        return
    on_axis = received_from(sonar.azimuth_rad[-1])[-1]
    off = azimuth - sonar.azimuth_rad[-1]
    want = ArrayPattern("line_array", math.radians(1.0)).power(np.sin(off)) + 10**-3.8
    assert 10 * np.log10(received_from(azimuth)[-1] / on_axis / want) == pytest.approx(0, abs=0.5)


def test_boxes_and_gaussian_beams_have_no_far_side_lobes():
    for pattern in ("box", "gaussian"):
        off, on = (sg.Acoustics.physical(beam_pattern=pattern, far_side_lobes=far) for far in (False, True))
        weights = [fan_and_weights(P900, one)[1] for one in (off, on)]
        np.testing.assert_array_equal(*weights)


def test_switched_off_the_pattern_ends_at_its_support():
    acoustics = sg.Acoustics.physical(far_side_lobes=False)
    fan, weights = fan_and_weights(P900, acoustics)
    edges = fan.column_edges_rad
    apart = np.abs((edges[1:] + edges[:-1]) / 2 - P900.azimuth_rad[:, None])
    outside = apart > acoustics.receive_support_rad(P900) + np.diff(edges).max()
    assert not weights[outside].any()


def test_labels_do_not_depend_on_far_side_lobes():
    """Bins that a body reaches by far side lobes alone have no label; labels of others stay."""
    post = sg.Body("post", trimesh.creation.box((0.02, 0.02, 20)), sg.pose(10, 0, 0))
    pings = []
    for far in (False, True):
        acoustics = sg.Acoustics.physical(far_side_lobes=far)
        with sg.Simulator(
            sg.Scene([post]), P900.with_range(12.0), acoustics, sg.Sampling(2, 64)
        ) as simulator:
            pings.append(simulator.ping(np.eye(4), labels=True, label_level_db=-180.0))
    without, ping = pings
    far = np.abs(P900.azimuth_rad) > np.radians(6)
    assert (ping.intensity[far] > 0).any()
    assert not ping.body_id[far].any()
    np.testing.assert_array_equal(
        ping.body_id[np.abs(P900.azimuth_rad) < np.radians(4)],
        without.body_id[np.abs(P900.azimuth_rad) < np.radians(4)],
    )


@pytest.mark.parametrize(
    "odd",
    [
        {"beam_width_deg": 1e-3},  # 100 000 lobes
        {"n_beams": 65536, "n_bins": 1, "beam_width_deg": 0.1},  # of many columns each
    ],
)
def test_fans_of_too_many_lobes_are_left_without(odd):
    """They would take gigabytes."""
    sonar = replace(P900, **odd)
    ends = sonar.azimuth_rad[0] - 0.1, sonar.azimuth_rad[-1] + 0.1
    assert make_lobe_blocks(PHYSICAL.far_pattern(sonar), sonar.azimuth_rad, ends) is None
