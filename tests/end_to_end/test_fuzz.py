"""Random input gives either one clear `sonar_gl.Error` or a finite image."""

import warnings
from collections import Counter

import numpy as np
import pytest
import trimesh
from click.testing import CliRunner
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import sonar_gl as sg
from sonar_gl.cli.main import main

pytestmark = pytest.mark.filterwarnings("ignore:sonar 'fuzz'")  # warnings that its angles look like radians

# Examples are the same in each run, so that a failure comes from the code. Making a Simulator takes some 50 ms.
FUZZ = settings(
    max_examples=150, derandomize=True, deadline=None, database=None, suppress_health_check=list(HealthCheck)
)
LIGHT = settings(FUZZ, max_examples=20)

ODD = [0.0, -0.0, 1e-30, 1e-9, 1e-3, 1.0, -1.0, 20.0, 1e4, 5e5, 1e9, 1e30, 1e300, np.inf, -np.inf, np.nan]
odd_numbers = st.one_of(st.sampled_from(ODD), st.floats(-30, 30), st.floats(width=32))
any_value = st.one_of(
    odd_numbers, st.integers(-5, 10**6), st.text("a0.,- é漢\n", max_size=5), st.none(), st.booleans()
)
tame_numbers = st.one_of(st.floats(-30, 30), st.sampled_from([0.0, 1e-9, 1e-3, 5e5, 1e7]))


def mostly(usual, other=any_value, one_in=8):
    """Draw another value once in so many times, else a usual one; `one_of` would take each kind as often.

    Of a range of integers Hypothesis draws the ends more often.
    """
    return st.integers(0, one_in - 1).flatmap(lambda k: usual if k != one_in // 2 else other)


@st.composite
def sonars(draw):
    """Draw valid and extreme sonars."""
    n_beams = draw(st.sampled_from([1, 2, 3, 7, 64, 255]))
    start = draw(st.sampled_from([0.0, 0.5, 3.0]))
    fov = draw(st.one_of(st.sampled_from([0.01, 1.0, 60.0, 120.0, 179.9, 180.0, 360.0]), st.floats(1, 360)))
    width = draw(st.sampled_from([0.001, 0.1, 1.0, 20.0, 180.0]))
    return sg.Sonar(
        "fuzz",
        900e3,
        n_beams,
        draw(st.sampled_from([1, 2, 3, 100, 511])),
        fov,
        draw(st.sampled_from([0.01, 1.0, 20.0, 90.0, 170.0])),
        width,
        start,
        start + draw(mostly(st.just(30.0), st.sampled_from([0.001, 1.0, 1000.0]))),
    )


@st.composite
def meshes(draw):
    """Draw modified shapes, and triangles of random numbers."""
    kind = draw(mostly(st.sampled_from(["box", "ball", "sheet"]), st.just("soup")))
    if kind == "soup":
        n = draw(st.integers(1, 12))
        numbers = odd_numbers if draw(st.booleans()) else tame_numbers
        vertices = np.array(draw(st.lists(numbers, min_size=3 * n, max_size=3 * n))).reshape(n, 3)
        faces = np.array(draw(st.lists(st.integers(0, n - 1), min_size=0, max_size=30))).astype(int)
        return trimesh.Trimesh(vertices, faces[: len(faces) // 3 * 3].reshape(-1, 3), process=False)
    mesh = {
        "box": lambda: trimesh.creation.box((1, 2, 3)),
        "ball": lambda: trimesh.creation.icosphere(1, 1.0),
        "sheet": lambda: trimesh.Trimesh([[0, -1, -1], [0, 1, -1], [0, 0, 1]], [[0, 1, 2]], process=False),
    }[kind]()
    scale = draw(mostly(st.just(1.0), st.sampled_from([1e-12, 1e-4, 100.0, 1e5, 1e12, 1e38])))
    faces = np.asarray(mesh.faces)
    change = draw(st.sampled_from(["none", "inside out", "twice", "open", "points"]))
    faces = {
        "none": faces,
        "inside out": faces[:, ::-1],
        "twice": np.vstack([faces, faces]),
        "open": faces[: max(1, len(faces) // 2)],
        "points": faces[:, [0, 0, 0]],
    }[change]
    return trimesh.Trimesh(mesh.vertices * scale, faces, process=False)


angles = st.one_of(st.sampled_from([0.0, np.pi / 2, -np.pi / 2, np.pi, -np.pi, 1e-9]), st.floats(-6.28, 6.28))
poses = st.tuples(tame_numbers, tame_numbers, tame_numbers, angles, angles, angles)
# most sonars are at the origin, and most bodies before them: of random poses few see anything
sonar_poses = mostly(st.just((0.0,) * 6), poses)
ahead = st.tuples(st.floats(1, 25), st.floats(-3, 3), st.floats(-3, 3), angles, angles, angles)


@st.composite
def bodies(draw):
    """Draw functions from a name to a Body with a random mesh, pose, reflectivity and normals or none."""
    mesh = draw(meshes())
    normals = None
    if draw(st.booleans()):
        rows = len(mesh.vertices)
        numbers = draw(mostly(st.just(st.floats(-1, 1)), st.just(odd_numbers)))
        normals = np.resize(draw(st.lists(numbers, min_size=3, max_size=9)), (rows, 3))
    mu = draw(mostly(st.sampled_from([0.5, 1.0]), st.sampled_from([0.0, 1e-30, 1.5, np.nan])))
    if draw(st.booleans()) and len(mesh.faces):
        mu = np.linspace(0, min(mu, 1.0), len(mesh.faces))
    pose = draw(mostly(ahead, poses))
    return lambda name: sg.Body(name, mesh, sg.pose(*pose), mu, normals)


def outcome(work):
    """Return the result of `work`, or None if it raised an `Error` with a message of one line."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # warnings of empty pings and overflow
        try:
            return work()
        except sg.Error as why:
            assert "\n" not in str(why) and 20 < len(str(why)) < 400
            return None


def check(ping, n_bodies):
    """Check that a ping is finite and its labels are consistent."""
    shape = (len(ping.azimuth_rad), len(ping.range_m))
    assert ping.intensity.shape == shape
    assert np.isfinite(ping.intensity).all()
    assert (ping.intensity >= 0).all()
    if ping.body_id is None:
        return
    assert ping.body_id.max() <= n_bodies
    # bins that a display shows as black have no label, to the rounding of float32
    least = ping.counts_law().least_shown(ping.intensity) * (1 + 1e-5)
    assert (np.isnan(ping.elevation_rad) == (ping.body_id == 0)).all()
    assert (np.abs(ping.elevation_rad[ping.body_id > 0]) <= np.pi / 2).all()
    assert np.isfinite(ping.body_echo).all()
    total, bodies = ping.intensity.sum(dtype=np.float64), ping.body_echo.sum()
    # labels are those before the pulse, which carries echo into other bins, and beyond the first and the last one, but
    # leaves in each bin the share of the greatest weight
    weights = ping.acoustics.pulse_weights(ping.sonar)
    if weights is None:
        assert bodies == pytest.approx(total, rel=1e-3, abs=1e-30)
        assert ((ping.intensity <= least) | (ping.body_id > 0)).all()
    else:
        assert bodies >= (1 - 1e-3) * total - 1e-30
        assert bodies * weights.max() / weights.sum() <= (1 + 1e-3) * total + 1e-30


def kind_of(ping):
    return "refused" if ping is None else "echo" if ping.intensity.any() else "silent"


@pytest.mark.slow
def test_any_scene_sonar_and_pose():
    made = Counter()

    @FUZZ
    @given(
        sonar=sonars(),
        things=mostly(st.lists(bodies(), min_size=1, max_size=3), st.just([])),
        pose=sonar_poses,
        columns=st.sampled_from([0.1, 1.0, 2.5]),
        rows=st.sampled_from([1, 2, 17, 40]),
        reducer=st.sampled_from(["footprint", "footprint", "point"]),
        profile=st.sampled_from(["ideal", "physical", "demarco2015"]),
        labels=st.booleans(),
    )
    def test(sonar, things, pose, columns, rows, reducer, profile, labels):
        def work():
            scene = sg.Scene([make(f"body {k}") for k, make in enumerate(things)])
            sampling = sg.Sampling(columns, rows, reducer)
            with sg.Simulator(scene, sonar, sg.Acoustics(profile), sampling) as simulator:
                return simulator.ping(sg.pose(*pose), labels=labels)

        ping = outcome(work)
        if ping is not None:
            check(ping, len(things))
        made[kind_of(ping)] += 1

    test()
    assert min(made[kind] for kind in ("echo", "silent", "refused")) >= 5, made


def test_any_tolerance():
    made = Counter()

    @settings(FUZZ, max_examples=12)
    @given(
        sonar=sonars(),
        thing=bodies(),
        pose=sonar_poses,
        tolerance=mostly(st.floats(0.05, 0.5), odd_numbers),
    )
    def test(sonar, thing, pose, tolerance):
        def work():
            with sg.Simulator(sg.Scene([thing("body")]), sonar, tolerance=tolerance) as simulator:
                return simulator.ping(sg.pose(*pose), labels=True)

        if not 0.05 <= tolerance <= 0.5:  # finer ones take too long
            tolerance = -abs(tolerance)
        ping = outcome(work)
        assert (ping is None) or (0.05 <= tolerance <= 0.5)
        if ping is not None:
            check(ping, 1)
        made[kind_of(ping)] += 1

    test()
    # which examples come depends on the modules that are loaded: Hypothesis takes constants from them
    assert made["echo"] >= 3 <= made["silent"] + made["refused"], made


def test_any_sampling():
    made = []

    @FUZZ
    @given(
        columns=mostly(st.floats(0.01, 8.0), one_in=4),
        rows=mostly(st.integers(1, 100), one_in=4),
        reducer=mostly(st.sampled_from(["point", "footprint"]), one_in=4),
    )
    def test(columns, rows, reducer):
        sampling = outcome(lambda: sg.Sampling(columns, rows, reducer))
        if sampling is not None:
            assert 0 < sampling.columns_per_beam <= 1024 and 1 <= sampling.rows <= 16_000
        made.append(sampling is not None)

    test()
    assert made.count(True) > 20 and made.count(False) > 20


def test_any_sonar():
    """Most numbers are usual ones: of eight odd ones, the first is refused, and nothing else is looked at."""
    made = []

    @settings(FUZZ, max_examples=200)
    @given(
        frequency_hz=mostly(st.floats(1e4, 3e6)),
        n_beams=mostly(st.integers(1, 512)),
        n_bins=mostly(st.integers(1, 2000)),
        angles_deg=st.tuples(*[mostly(st.floats(0.01, 170))] * 3),
        ranges_m=st.tuples(mostly(st.floats(0, 5)), mostly(st.floats(5, 200))),
    )
    def test(frequency_hz, n_beams, n_bins, angles_deg, ranges_m):
        sonar = outcome(lambda: sg.Sonar("fuzz", frequency_hz, n_beams, n_bins, *angles_deg, *ranges_m))
        if sonar is not None:
            assert (np.diff(sonar.bin_edges_m) > 0).all()
            assert np.isfinite(sonar.azimuth_rad).all()
        made.append(sonar is not None)

    test()
    assert made.count(True) > 20 and made.count(False) > 20


@LIGHT
@given(
    option=st.sampled_from(
        ["--range", "--bins", "--tolerance", "--height", "--seed", "--pose", "--counts=low_db"]
    ),
    value=st.one_of(odd_numbers.map(repr), st.text("0123456789.-+e x", max_size=8)),
)
def test_any_number_on_the_command_line(option, value):
    """Invalid numbers end with exit status 2 and a message, without a traceback, before any drawing."""
    # the scene does not exist, which ends the runs with valid numbers
    run = CliRunner().invoke(main, ["render", "no such scene", f"{option}={value}"])
    assert run.exit_code == 2
    assert "Traceback" not in run.output
    assert isinstance(run.exception, SystemExit)
