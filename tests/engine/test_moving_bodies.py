"""Bodies that move, appear and disappear: a ping is that of a scene built with the same bodies."""

import sys
import time
import tracemalloc
from dataclasses import replace
from itertools import count

import numpy as np
import pytest
import trimesh

import sonar_gl as sg
from sonar_gl.engine.body_extents import BodyExtents
from sonar_gl.engine.reception import Reception
from sonar_gl.raster.opengl.buffers import GrowingBuffer
from sonar_gl.scene import primitives
from sonar_gl.scene import scene as scene_module
from sonar_gl.scene.grown_scene import GrownScene
from sonar_gl.scene.state import SceneState
from tests.support.errors import error_of
from tests.support.estimates import record_estimates

SONAR = sg.Sonar("test", 900e3, 64, 200, 60.0, 20.0, 1.5, 0.5, 20.0)
SAMPLING = sg.Sampling(2, 40)
BALL = trimesh.creation.icosphere(3, 0.5)
BOX = trimesh.creation.box((0.6, 0.8, 1.0))
POSE = sg.pose(0.1, 0.2, 0, 0.05, 0.1, -0.1)
PATCHY = np.linspace(0.1, 1.0, 12)
CLOSED = "this Simulator is closed; make a new one"


def plain(at=None):
    return sg.Body("plain", BOX, sg.pose(6, 1.5) if at is None else at, 0.8)


def smooth(at=None):
    normals = np.asarray(BALL.vertices, np.float32) * 2
    return sg.Body("smooth", BALL, sg.pose(8, -1, 0.3) if at is None else at, 0.6, normals)


def patchy(at=None):
    return sg.Body("patchy", BOX, sg.pose(5, -1.2, 0, 0.3, 0.2, 0.7) if at is None else at, PATCHY)


def both(at=None):
    corners = np.asarray(BOX.vertices, np.float32)
    normals = corners / np.linalg.norm(corners, axis=1, keepdims=True)
    return sg.Body("both", BOX, sg.pose(7, 0.3, -0.5, yaw=0.4) if at is None else at, PATCHY[::-1], normals)


ALL = plain, smooth, patchy, both


def simulator(bodies, sampling=SAMPLING, **kw):
    return sg.Simulator(sg.Scene(bodies), SONAR, sg.Acoustics.ideal(), sampling, **kw)


def fresh(bodies, pose=POSE, engine=None, **kw):
    with simulator(bodies, engine=engine) as it:
        return it.ping(pose, labels=True, **kw)


def check_same(one, other, numbers=None):
    """Check that pings are identical; `numbers` are the numbers in the first ping of the second's bodies."""
    np.testing.assert_array_equal(one.intensity, other.intensity)
    np.testing.assert_array_equal(one.elevation_rad, other.elevation_rad)
    numbers = np.arange(len(other.body_echo)) if numbers is None else np.array([0, *numbers])
    np.testing.assert_array_equal(one.body_id, numbers[other.body_id])
    np.testing.assert_array_equal(one.body_echo[numbers[1:]], other.body_echo[1:])
    assert one.intensity.any()


THERE = {"plain": sg.pose(9, -2, 0.2, 0.3, 0.4, 2), "both": sg.pose(4, 0.5, 0.2, 1)}


def test_a_ping_with_moved_bodies_is_that_of_such_a_scene():
    """The change lasts for one ping."""
    expected = fresh([make(THERE.get(make.__name__)) for make in ALL])
    with simulator([make() for make in ALL]) as it:
        before = it.ping(POSE, labels=True)
        moved = it.ping(POSE, labels=True, bodies=THERE)
        after = it.ping(POSE, labels=True)
    check_same(moved, expected)
    check_same(after, before)
    assert (moved.intensity != before.intensity).any()


@pytest.mark.parametrize("gone", ["plain", "smooth", "both"])
def test_a_ping_without_a_body_is_that_of_such_a_scene(gone):
    rest = [make() for make in ALL if make.__name__ != gone]
    numbers = [k for k, make in enumerate(ALL, 1) if make.__name__ != gone]
    expected = fresh(rest)
    with simulator([make() for make in ALL]) as it:
        before = it.ping(POSE, labels=True)
        without = it.ping(POSE, labels=True, bodies={gone: None})
        after = it.ping(POSE, labels=True)
    check_same(without, expected, numbers)
    number = [make.__name__ for make in ALL].index(gone) + 1
    assert before.body_echo[number] > 0
    assert without.body_echo[number] == 0
    check_same(after, before)


@pytest.mark.parametrize("engine", ["cpu", "opengl"])
def test_a_ping_without_a_rectangle_is_that_of_such_a_scene(engine):
    """Which OpenGL cuts to what the sonar sees; so is the background of shadows, drawn without it."""
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    mesh = trimesh.Trimesh(1e4 * corners, [[0, 1, 2], [0, 2, 3]], process=False)
    sheet = sg.Body("sheet", mesh, sg.pose(0, 0, -2))
    expected = fresh([plain(), smooth()], engine=engine)
    with simulator([plain(), smooth(), sheet], engine=engine) as it:
        without = it.ping(POSE, labels=True, bodies={"sheet": None})
        shadowed = it.ping(POSE, labels=True, background=["plain"])
        assert (it.ping(POSE, labels=True).body_id == 3).any()
    check_same(without, expected, [1, 2])
    assert not shadowed.shadow.any()  # nothing is before it


@pytest.mark.parametrize(("mu", "specular"), [(0.02, 0.0), (0.5, 0.3)], ids=["bright", "with a lobe"])
def test_multipath_without_a_body_is_that_of_such_a_scene(mu, specular):
    """Which reflectors count depends on the brightest body; lobes are left out, and so all samples are drawn again."""
    floor = trimesh.creation.box((40, 40, 1))
    wall = sg.Body("wall", trimesh.creation.box((8, 0.2, 6)), sg.pose(7, 3, 0, yaw=0.1), 0.05)
    rest = [
        sg.Body("floor", floor, sg.pose(0, 0, -2), mu),
        wall,
        sg.Body("ball", BALL, sg.pose(6, 0, 0.3), mu),
    ]
    more = sg.Body("more", BALL, sg.pose(8, -1, 0.3), 1 - specular, specular=specular)
    acoustics, poses, bodies = (
        sg.Acoustics.physical(multipath="incoherent"),
        [np.eye(4)] * 2,
        [{"more": None}, None],
    )

    def of(bodies):
        return sg.Simulator(sg.Scene(bodies), SONAR, acoustics, tolerance=0.05)

    with of(rest) as it:
        expected = it.ping(np.eye(4), labels=True)
    with of([*rest, more]) as it:
        without = it.ping(np.eye(4), labels=True, bodies={"more": None})
        whole = it.ping(np.eye(4), labels=True)
    with of([*rest, more]) as it:
        sequence = list(it.pings(poses, labels=True, bodies=bodies))
    check_same(without, expected, [1, 2, 3])
    assert without.error_estimate == expected.error_estimate
    check_same(sequence[0], without)
    check_same(sequence[1], whole)


def test_place_lasts_and_can_be_undone():
    there = [make(THERE.get(make.__name__)) for make in ALL]
    expected, shifted = fresh(there), sg.pose(7, 0, 0, yaw=1)
    with simulator([make() for make in ALL]) as it:
        before = it.ping(POSE, labels=True)
        it.place(THERE)
        check_same(it.ping(POSE, labels=True), expected)
        check_same(it.ping(POSE, labels=True), expected)
        # `bodies` of a ping override `place` for that ping
        alone = it.ping(POSE, labels=True, bodies={"smooth": shifted})
        check_same(alone, fresh([*there[:1], smooth(shifted), *there[2:]]))
        check_same(it.ping(POSE, labels=True), expected)
        it.place({"smooth": None})
        check_same(it.ping(POSE, labels=True), fresh([there[0], *there[2:]]), [1, 3, 4])
        check_same(it.ping(POSE, labels=True, bodies={"smooth": smooth().pose}), expected)
        it.place({"smooth": smooth().pose})
        check_same(it.ping(POSE, labels=True), expected)
        it.place({body.name: body.pose for body in it.scene.bodies if body.name in THERE})
        check_same(it.ping(POSE, labels=True), before)
        it.place({})
        check_same(it.ping(POSE, labels=True), before)


def robot(at):
    """A body, and a model of two links whose frame is at `at`."""
    one, other = (
        sg.Body(f"rov::{name}", BOX, at @ sg.pose(0, y, 0, yaw=y), 0.5) for name, y in (("a", -1), ("b", 1))
    )
    return [plain(), one, other]


def test_links_move_with_their_model():
    at, there = sg.pose(7, 0, 0, yaw=0.5), sg.pose(5, -0.5, 0.1)
    scene = sg.Scene(robot(at), models={"rov": at, "plain": at, "gone": at})
    with sg.Simulator(scene, SONAR, sg.Acoustics.ideal(), SAMPLING) as it:
        ping = it.ping(POSE, labels=True, bodies={"rov": there})
        # the poses differ by the rounding of float64, of which samples in float32 show little
        np.testing.assert_allclose(ping.intensity, fresh(robot(there)).intensity, atol=1e-6)
        with pytest.warns(UserWarning, match="no echo"):
            it.ping(POSE, bodies={"rov": None, "plain": None})
        it.place({"rov": there, "rov::b": None})
        alone = it.ping(POSE, labels=True)
        np.testing.assert_array_equal(alone.body_echo > 0, [False, True, True, False])
        with pytest.raises(sg.Error, match="the pose of model 'rov' must have shape"):
            it.place({"rov": np.zeros(3)})
        assert error_of(lambda: it.place({"gone": there})) == (
            "bodies must be bodies of the scene (got 'gone', a model without bodies, as where its only shapes are in "
            "the link that carries the scene's sonar, which returns no echo: give the sensor a link of its own)"
        )
        known = "did you mean 'plain'?"
        assert error_of(lambda: it.place({"plane": there})).endswith(f"(got 'plane'; {known})")
        assert "gone'?" not in error_of(lambda: it.place({"gon": there}))


def test_what_is_in_a_model_moves_with_the_body_of_its_name():
    """A part that is named itself goes where its own pose says, whatever the order."""
    at, there, aside = sg.pose(7, 0, 0, yaw=0.5), sg.pose(5, -0.5, 0.1), sg.pose(6, 1.5)
    hull = sg.Body("rov", BOX, at, 0.5)

    def bodies(place, of_a):
        return [replace(body, pose=of_a if body.name == "rov::a" else body.pose) for body in place]

    scene = sg.Scene([hull, *robot(at)[1:]], models={"rov": at, "rov::a": at @ sg.pose(0, -1, yaw=-1)})
    with sg.Simulator(scene, SONAR, sg.Acoustics.ideal(), SAMPLING) as it:
        moved = [replace(hull, pose=there), *robot(there)[1:]]
        np.testing.assert_allclose(
            it.ping(POSE, bodies={"rov": there}).intensity, fresh(moved).intensity, atol=1e-6
        )
        expected = fresh(bodies(moved, aside)).intensity
        for order in ({"rov": there, "rov::a": aside}, {"rov::a": aside, "rov": there}):
            np.testing.assert_allclose(it.ping(POSE, bodies=order).intensity, expected, atol=1e-6)
        with pytest.warns(UserWarning, match="no echo"):
            it.ping(POSE, bodies={"rov": None})


@pytest.mark.slow
def test_a_school_of_models_moves_about_as_fast_as_its_bodies():
    """For each model all bodies were gone through: the time grew with the square of their number."""
    at = {f"fish {k}": sg.pose(5, k) for k in range(1500)}
    bodies = [sg.Body(f"{model}::body", BALL, pose) for model, pose in at.items()]
    names = "a", "a:::b", "a::b", "a::b::c", "ab", "ab::c"
    bodies += [sg.Body(name, BALL) for name in names]
    models = at | {name: np.eye(4) for name in ("a", "a:", "a::b", "ab::c", "c")}
    with sg.Simulator(sg.Scene(bodies, models=models), SONAR, sampling=SAMPLING) as school:
        parts = {
            model: list(school.scene.parts_of(model)) for model in ("a", "a:", "a::b", "ab::c", "c", "ab")
        }
        assert parts == {
            "a": ["a", "a:::b", "a::b", "a::b::c"],
            "a:": ["a:::b"],
            "a::b": ["a::b", "a::b::c"],
            "ab::c": ["ab::c"],
            "c": [],
            "ab": [],
        }

        def seconds(moves):
            times = []
            for _ in range(3):
                start = time.process_time()
                school.place(moves)
                times.append(time.process_time() - start)
            return min(times)

        assert seconds(at) < 15 * seconds({f"{model}::body": pose for model, pose in at.items()})


@pytest.mark.parametrize("first", ALL)
@pytest.mark.parametrize("second", ALL)
def test_an_added_body_acts_like_one_of_the_scene(first, second):
    if first is second:
        bodies = [
            first(),
            sg.Body("again", first().mesh, sg.pose(9, 1), first().reflectivity, first().normals),
        ]
    else:
        bodies = [first(), second()]
    expected = fresh(bodies)
    with simulator(bodies[:1]) as it:
        alone = it.ping(POSE, labels=True)
        it.add(bodies[1])
        check_same(it.ping(POSE, labels=True), expected)
        assert it.ping(POSE).meta["bodies"] == [body.name for body in bodies]
        assert [body.name for body in it.scene.bodies] == [body.name for body in bodies]
        hidden = it.ping(POSE, labels=True, bodies={bodies[1].name: None})
    check_same(hidden, alone, [1])


def test_a_body_is_added_after_another_one_has_got_a_mesh_of_trimesh():
    """The triangles that a file gave are gone then, and those of the next file may have their address."""
    vertices, faces = primitives.box((3, 3, 3)).mesh
    first = sg.Body("first", primitives.box((1, 1, 1)).mesh, sg.pose(6, 1.5))
    with simulator([first]) as it:
        assert isinstance(first.mesh, trimesh.Trimesh)  # reading it replaces the triangles
        at_many_addresses = [primitives.Triangles(vertices, faces) for _ in range(100)]
        bodies = [sg.Body(f"box {k}", mesh, sg.pose(40 + 5 * k)) for k, mesh in enumerate(at_many_addresses)]
        it.add(*bodies)
        bounds = it.world.engine.meshes.boxes.bounds
    np.testing.assert_array_equal(bounds[0], [[-0.5] * 3, [0.5] * 3])
    np.testing.assert_array_equal(bounds[1:], np.tile([[-1.5] * 3, [1.5] * 3], (100, 1, 1)))


def test_several_bodies_are_added_to_an_empty_scene():
    bodies = [make() for make in ALL]
    with simulator([]) as it:
        with pytest.warns(UserWarning):
            it.ping(POSE)
        it.add(*bodies)
        check_same(it.ping(POSE, labels=True), fresh(bodies))


def calls_of(work):
    """Return how many functions `work` calls, those of NumPy and the like included."""
    n_calls = 0

    def count(_, event, __):
        nonlocal n_calls
        n_calls += event in ("call", "c_call")

    before = sys.getprofile()
    sys.setprofile(count)
    try:
        work()
    finally:
        sys.setprofile(before)
    return n_calls


def test_adding_a_body_takes_no_more_work_where_many_came_and_went():
    """Of a long run in which bodies come and go: each add went through all bodies that had ever been there."""
    with simulator([plain()]) as it:

        def come_and_go(name):
            it.add(sg.Body(name, BOX, sg.pose(6, 1.5)))
            it.place({name: None})

        for number in range(20):
            come_and_go(f"early {number}")
        # arrays that grow do so once in a while
        early = min(calls_of(lambda name=name: come_and_go(name)) for name in ("one", "two", "three"))
        it.add(*(sg.Body(f"many {number}", BOX, sg.pose(6, 1.5)) for number in range(500)))
        it.place({f"many {number}": None for number in range(500)})
        late = min(calls_of(lambda name=name: come_and_go(name)) for name in ("four", "five", "six"))
        assert late == early
        assert it.world.engine.meshes.most_patches == len(it.scene.bodies)  # one for each box


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["cpu", "opengl"])
def test_bodies_that_are_added_one_by_one_take_no_more_memory_traffic_where_many_are(engine):
    """Each add copied the arrays of all bodies, so that 10 000 of them took 19 s, and all at once 0.2 s."""
    names = (f"box {number}" for number in count())
    with simulator([plain()], engine=engine) as it:

        def bytes_of_an_add():
            body = sg.Body(next(names), primitives.box((1, 1, 1)).mesh, sg.pose(6, 1.5))
            tracemalloc.start()  # for one add: of many bodies it takes twice the time
            try:
                it.add(body)
                return tracemalloc.get_traced_memory()[1]
            finally:
                tracemalloc.stop()

        early = min(bytes_of_an_add() for _ in range(5))
        it.add(*(sg.Body(next(names), primitives.box((1, 1, 1)).mesh) for _ in range(500)))
        bytes_of_an_add()  # the arrays have no more room than they needed
        late = min(bytes_of_an_add() for _ in range(5))
        assert late < early + 10_000  # two pointers for each of the many
        assert len(it.scene.bodies) == 1 + 5 + 500 + 6


def world_of(bodies, engine):
    """Return a simulator to which bodies were added one by one, placed elsewhere and taken away in between."""
    it = simulator(bodies[:1], engine=engine)
    for number, body in enumerate(bodies[1:]):
        it.add(body)
        if number % 3 == 0:
            it.place({body.name: THERE["plain"], bodies[0].name: None})
        if number % 3 == 1:
            it.place({body.name: None, bodies[0].name: bodies[0].pose})
        if number % 5 == 0:
            it.ping(POSE)
    return it


@pytest.mark.parametrize("engine", ["cpu", pytest.param("opengl", marks=pytest.mark.slow)])
def test_bodies_that_were_added_one_by_one_act_like_those_of_one_call(engine):
    rng = np.random.default_rng(4)
    makes = [ALL[number] for number in rng.integers(len(ALL), size=20)]
    bodies = [replace(make(), name=f"{k} {make.__name__}") for k, make in enumerate(makes)]
    bodies = [replace(body, pose=sg.pose(*rng.uniform((4, -2, -1), (9, 2, 1)))) for body in bodies]
    with world_of(bodies, engine) as one_by_one, simulator([], engine=engine) as at_once:
        at_once.add(*bodies)
        state = one_by_one.world.engine.meshes.state
        poses = {
            body.name: pose if present else None
            for body, pose, present in zip(bodies, state.poses, state.present, strict=True)
        }
        check_same(one_by_one.ping(POSE, labels=True), at_once.ping(POSE, labels=True, bodies=poses))
        home = {body.name: body.pose for body in bodies}
        check_same(one_by_one.ping(POSE, labels=True, bodies=home), at_once.ping(POSE, labels=True))


def test_an_add_that_fails_leaves_no_trace_in_the_arrays_that_grow(monkeypatch):
    """Its bodies lie in the memory behind those of the scene, where the next ones go."""
    with simulator([plain()]) as it:
        it.add(smooth())

        def fail(*_):
            raise KeyboardInterrupt

        with monkeypatch.context() as patch:
            patch.setattr(GrownScene, "with_more", fail)
            with pytest.raises(KeyboardInterrupt):
                it.add(replace(patchy(), pose=sg.pose(3)))
        check_same(it.ping(POSE, labels=True), fresh([plain(), smooth()]))
        it.add(both())
        it.add(patchy())
        check_same(it.ping(POSE, labels=True), fresh([plain(), smooth(), both(), patchy()]))


def test_more_bodies_than_a_scene_holds_are_refused(monkeypatch):
    monkeypatch.setattr(scene_module, "MAX_BODIES", 2)
    with simulator([plain()]) as it:
        it.add(smooth())
        it.place({"smooth": None})
        assert error_of(lambda: it.add(patchy())) == (
            "a scene holds at most 2 bodies (got 3; join some meshes, or `place` absent bodies again in place of "
            "adding others)"
        )
        assert [body.name for body in it.scene.bodies] == ["plain", "smooth"]


def test_the_extents_of_added_bodies_are_those_of_all_at_once():
    shiny = sg.Body("shiny", BALL, sg.pose(4), 0.2, specular=0.5)
    bodies = [*(make() for make in ALL), shiny, replace(shiny, normals=BALL.vertex_normals)]
    state = SceneState(np.array([body.pose for body in bodies]), np.ones(len(bodies), bool))
    expected, extents = BodyExtents(bodies, specular=True), BodyExtents([], specular=True)
    for body in bodies:
        extents.add([body])
    assert extents.n_bodies == len(bodies)
    some = np.linspace(0.0, 0.3, len(bodies) + 1), np.ones(len(bodies) + 1), state
    shares = expected.glint_shares(*some)
    assert shares[-2] < 1 and (np.delete(shares, -2) == 1).all()
    np.testing.assert_array_equal(extents.glint_shares(*some), shares)
    np.testing.assert_array_equal(extents.are_smooth, [*[False] * (len(bodies) - 1), True, True])
    np.testing.assert_array_equal(extents.greatest_backscatter(state), expected.greatest_backscatter(state))
    reception = Reception(SONAR, 0.0, 0.2, False, np.ones(SONAR.n_bins), np.zeros(0), None)
    echo = expected.greatest_echo(state, POSE, reception)
    assert (echo[1:] > 0).all()
    np.testing.assert_array_equal(extents.greatest_echo(state, POSE, reception), echo)


def test_placed_bodies_stay_when_others_are_added():
    with simulator([plain()]) as it:
        it.place({"plain": THERE["plain"]})
        it.add(patchy())
        check_same(it.ping(POSE, labels=True), fresh([plain(THERE["plain"]), patchy()]))
        it.place({"patchy": None})
        it.add(smooth())
        check_same(it.ping(POSE, labels=True), fresh([plain(THERE["plain"]), smooth()]), [1, 3])


@pytest.fixture
def one_body():
    with simulator([plain(), smooth()]) as it:
        yield it


KNOWN = "bodies must be bodies of the scene (got 'diver'; known are plain, smooth)"
NO_DICT = 'bodies must be a dict (got list; such as {"diver": sonar_gl.pose(x=5)}, or None for "not there")'
TURNED = (
    "the pose of body 'plain' must be a rotation, a translation and one scale for all axes (its 3x3 part shears, "
    "reflects or stretches; scale the mesh instead)"
)


@pytest.mark.parametrize("way", ["ping", "place", "pings"])
def test_invalid_bodies_raise_errors(one_body, way):
    def message_of(bodies):
        if way == "ping":
            return error_of(lambda: one_body.ping(POSE, bodies=bodies))
        if way == "place":
            return error_of(lambda: one_body.place(bodies))
        return error_of(lambda: list(one_body.pings([POSE], bodies=[bodies])))

    before = one_body.ping(POSE).intensity
    assert message_of({"diver": sg.pose(5)}) == KNOWN
    assert message_of({"plain": sg.pose(9), "diver": None}) == KNOWN
    assert message_of({"plain": np.diag([1.0, 2.0, 1.0, 1.0])}) == TURNED
    assert message_of({"plain": [1, 2, 3]}) == (
        "the pose of body 'plain' must have shape (4, 4) (got (3,); sonar_gl.pose makes one from x y z roll pitch yaw)"
    )
    assert message_of([("plain", sg.pose(5))]) == NO_DICT
    assert message_of(sg.pose(5)) == NO_DICT.replace("list", "ndarray")
    # the scene is unchanged
    np.testing.assert_array_equal(one_body.ping(POSE).intensity, before)


def test_invalid_added_bodies_raise_errors(one_body):
    before = one_body.ping(POSE, labels=True)
    assert (
        error_of(lambda: one_body.add(plain()))
        == "names of bodies must be unique (got 'plain' more than once)"
    )
    twice = error_of(lambda: one_body.add(both(), both()))
    assert twice == "names of bodies must be unique (got 'both' more than once)"
    no_body = "body must be a Body (got {}; such as sonar_gl.Body('box', mesh))"
    assert error_of(lambda: one_body.add(BOX)) == no_body.format("Trimesh")
    assert error_of(lambda: one_body.add(patchy(), None)) == no_body.format("NoneType")
    assert [body.name for body in one_body.scene.bodies] == ["plain", "smooth"]
    check_same(one_body.ping(POSE, labels=True), before)
    one_body.add(patchy())
    check_same(one_body.ping(POSE, labels=True), fresh([plain(), smooth(), patchy()]))


def test_a_closed_simulator_raises_errors():
    it = simulator([plain()])
    it.close()
    assert error_of(it.place, {"plain": None}) == CLOSED
    assert error_of(it.add, smooth()) == CLOSED
    assert error_of(it.ping, POSE, bodies={"plain": None}) == CLOSED


def test_meshes_are_uploaded_once(monkeypatch, opengl_engine):
    """Moving and hiding upload no vertices; adding uploads those of a new mesh only."""
    sent, append = [], GrowingBuffer.append
    monkeypatch.setattr(
        GrowingBuffer, "append", lambda self, data: sent.append(data.nbytes) or append(self, data)
    )
    with simulator([plain(), smooth(), patchy()]) as it:
        assert sum(sent) > 0
        sent.clear()
        it.ping(POSE)
        it.ping(POSE, bodies={"plain": sg.pose(7), "smooth": None})
        it.place({"plain": sg.pose(8)})
        it.ping(POSE)
        assert sent == []
        box = plain()
        it.add(*(sg.Body(f"more {k}", box.mesh, sg.pose(5, k), 0.1 * k) for k in range(3)))
        it.ping(POSE)
        assert sent == []
        new = trimesh.creation.box((1, 1, 1))
        it.add(sg.Body("new", new, sg.pose(7)))
        it.ping(POSE)
        # 8 corners with position, normal and reflectivity, and indices
        assert sum(sent) == 8 * 28 + 12 * 3 * 4


def test_a_mesh_that_was_changed_in_place_is_added_with_its_new_shape():
    mesh = trimesh.creation.box((0.6, 0.8, 1.0))
    with simulator([sg.Body("before", mesh, sg.pose(6, 1.5))]) as it:
        mesh.apply_scale(0.5)
        it.add(sg.Body("scaled", mesh, sg.pose(7)))
        mesh.vertices[:, 2] += 0.2
        it.add(sg.Body("raised", mesh, sg.pose(5, -1)))
        mesh.faces = mesh.faces[6:]  # without its front
        it.add(sg.Body("open", mesh, sg.pose(7, -2.5)))
        found = it.ping(POSE, labels=True)
    small = BOX.copy().apply_scale(0.5)
    raised = small.copy().apply_translation((0, 0, 0.2))
    half = trimesh.Trimesh(raised.vertices, raised.faces[6:], process=False)
    bodies = [
        sg.Body("before", BOX, sg.pose(6, 1.5)),
        sg.Body("scaled", small, sg.pose(7)),
        sg.Body("raised", raised, sg.pose(5, -1)),
        sg.Body("open", half, sg.pose(7, -2.5)),
    ]
    check_same(found, fresh(bodies))


def test_the_error_is_estimated_again_when_bodies_change(monkeypatch):
    floor = sg.Body("floor", trimesh.creation.box((60, 60, 1)), sg.pose(z=-3), 0.3)
    with simulator([floor, plain(), smooth()], None, tolerance=0.05) as it:
        it.ping(POSE)
        estimates = record_estimates(monkeypatch)

        def is_estimated(**kw):
            estimates.clear()
            assert it.ping(POSE, **kw).error_estimate is not None
            return bool(estimates)

        assert not is_estimated()
        assert not is_estimated(bodies={})
        assert not is_estimated(bodies={"smooth": smooth().pose @ sg.pose(0.1)})  # of a range of 20 m
        assert is_estimated(bodies={"smooth": smooth().pose @ sg.pose(1.5)})
        assert is_estimated()  # and back
        assert not is_estimated()
        assert is_estimated(bodies={"smooth": smooth().pose @ sg.pose(yaw=1.0)})
        assert is_estimated(bodies={"smooth": None})
        assert not is_estimated(bodies={"smooth": None})
        assert is_estimated()
        it.place({"plain": None})
        assert is_estimated()
        assert not is_estimated()
        it.add(both())
        assert is_estimated()
        assert not is_estimated()


OTHER = sg.Sonar("other", 450e3, 32, 100, 90.0, 15.0, 3.0, 0.5, 15.0)


def pair(bodies):
    first = simulator(bodies)
    return first, sg.Simulator(first, OTHER, sg.Acoustics.ideal(), SAMPLING)


def alone_of_other(bodies):
    with sg.Simulator(sg.Scene(bodies), OTHER, sg.Acoustics.ideal(), SAMPLING) as it:
        return it.ping(POSE, labels=True)


@pytest.mark.parametrize("first_closed", [0, 1])
def test_two_sonars_in_one_world(first_closed):
    bodies = [plain(), smooth()]
    two, expected = pair(bodies), [fresh(bodies), alone_of_other(bodies)]
    assert two[0].scene is two[1].scene
    for _ in range(2):
        for it, ping in zip(two, expected, strict=True):
            check_same(it.ping(POSE, labels=True), ping)
    # changes through one simulator affect the other
    two[0].add(patchy())
    two[1].place({"plain": None})
    left = [smooth(), patchy()]
    check_same(two[0].ping(POSE, labels=True), fresh(left), [2, 3])
    check_same(two[1].ping(POSE, labels=True), alone_of_other(left), [2, 3])
    assert two[1].ping(POSE).meta["bodies"] == ["plain", "smooth", "patchy"]
    two[first_closed].close()
    two[first_closed].close()
    assert error_of(two[first_closed].ping, POSE) == CLOSED
    assert error_of(lambda: two[first_closed].scene) == CLOSED
    assert error_of(sg.Simulator, two[first_closed], OTHER) == CLOSED
    rest = two[1 - first_closed]
    again = (fresh, alone_of_other)[1 - first_closed](left)
    check_same(rest.ping(POSE, labels=True), again, [2, 3])
    with sg.Simulator(rest, OTHER, sg.Acoustics.ideal(), SAMPLING) as it:
        check_same(it.ping(POSE, labels=True), alone_of_other(left), [2, 3])
    check_same(rest.ping(POSE, labels=True), again, [2, 3])
    rest.close()
    assert error_of(rest.ping, POSE) == CLOSED


def test_deleting_one_sonar_does_not_affect_the_other():
    first, second = pair([plain()])
    expected = first.ping(POSE).intensity
    del second
    np.testing.assert_array_equal(first.ping(POSE).intensity, expected)
    first.close()


@pytest.mark.parametrize("multipath", [pytest.param("none", marks=pytest.mark.slow), "coherent"])
def test_a_mesh_that_is_changed_in_place_stays_as_it_was_when_its_body_was_taken(multipath):
    """Also where it is read late: for the estimate of the error, reflectors, and why a ping has no echo."""
    acoustics = replace(sg.Acoustics.ideal(), multipath=multipath)

    def pings(change):
        floor, ball = trimesh.creation.box((30, 30, 1)), trimesh.creation.icosphere(3, 0.3)
        bodies = [sg.Body("floor", floor, sg.pose(0, 0, -2), 0.05), sg.Body("ball", ball, sg.pose(5, 0.5))]
        more = trimesh.creation.box((0.2, 0.2, 0.2))
        with sg.Simulator(sg.Scene(bodies), SONAR, acoustics, tolerance=0.05) as it:
            change(floor), change(ball)
            found = [it.ping(POSE, labels=True)]
            it.add(sg.Body("more", more, sg.pose(4, -0.5)))
            change(more)
            found += [it.ping(POSE, labels=True), *it.pings([POSE] * 3, labels=True)]
            with pytest.warns(UserWarning, match="no echo came back") as caught:
                it.ping(sg.pose(0, 0, 60))
        return found, [str(one.message) for one in caught]

    def change(mesh):
        mesh.apply_scale(0.3)
        mesh.vertices[:, 2] += 7.0

    (found, texts), (expected, expected_texts) = pings(change), pings(lambda _: None)
    for one, other in zip(found, expected, strict=True):
        check_same(one, other)
        assert one.error_estimate == other.error_estimate
    assert texts == expected_texts


def test_bodies_of_one_mesh_share_one_copy_of_it():
    mesh = trimesh.creation.box((0.5, 0.5, 0.5))
    with simulator([sg.Body(f"body {k}", mesh, sg.pose(5, k)) for k in range(3)]) as it:
        it.add(sg.Body("body 3", mesh, sg.pose(6)))
        mesh.apply_scale(2.0)
        it.add(sg.Body("body 4", mesh, sg.pose(7)))
        first, *others, last = [body.surface for body in it.world.scene.bodies]
        assert all(one is first for one in others) and last is not first
        assert np.ptp(first.vertices[:, 0]) == 0.5 and np.ptp(last.vertices[:, 0]) == 1.0
        assert [body.mesh for body in it.scene.bodies] == [mesh] * 5  # those of the caller


def test_the_mesh_of_a_body_from_a_file_may_be_changed_in_place():
    """The trimesh is made when it is first read."""
    scene = sg.load_scene("pylon")
    with sg.Simulator(scene, SONAR, sg.Acoustics.ideal(), SAMPLING) as it:
        kept = [body.surface for body in it.world.scene.bodies]
        vertices = [surface.vertices.copy() for surface in kept]
        for body in scene.bodies:
            body.mesh.vertices[:] *= 0.5
        for body, surface, before in zip(it.world.scene.bodies, kept, vertices, strict=True):
            assert body.surface is surface
            np.testing.assert_array_equal(surface.vertices, before)
