"""An interrupt (Ctrl-C) at any line: afterwards a simulator makes the same bytes, or raises an Error."""

import numba
import numpy as np
import pytest
import trimesh
from numba.core import serialize

import sonar_gl as sg
from tests.support import interrupts

EVERY = 20


class Unpickled(dict):
    """What Numba has unpickled, which it looks up in Python code as it boxes an array that a kernel returns.

    Attributes
    ----------
    n_reads : how often
    """

    n_reads = 0

    def __getitem__(self, key):
        self.n_reads += 1
        return super().__getitem__(key)


@pytest.mark.slow
def test_no_kernel_runs_python_code_as_it_returns(monkeypatch):
    """There Ctrl-C is a SystemError, or a ValueError, that no `except KeyboardInterrupt` catches.

    Of pings with labels half the interrupts came so: kernels without the GIL take most of their time.
    """
    monkeypatch.setattr(serialize, "_unpickled_memo", unpickled := Unpickled())
    assert numba.njit(lambda: np.zeros(1))() == 0
    assert unpickled.n_reads > 0  # this version of Numba does it still
    unpickled.n_reads = 0
    for action in interrupts.ACTIONS.values():
        with interrupts.make_simulator(action.settings) as simulator:
            action.do(simulator)
    ball = sg.Body("ball", trimesh.creation.icosphere(5, 0.5), sg.pose(4))  # of levels of detail
    for levels in (True, False):
        with sg.Simulator(sg.Scene([ball]), interrupts.SONAR, tolerance=0.5) as simulator:
            ping = simulator.ping(sg.pose(), labels=levels)
    assert ping.intensity.any()
    (camera,) = sg.Camera.covering(interrupts.SONAR)
    depth = np.full((camera.height, camera.width), 4.0)
    assert sg.ping_from_depth(depth, interrupts.SONAR, camera, labels=True).intensity.any()
    assert unpickled.n_reads == 0


@pytest.mark.timeout(60, method="thread")  # a hang may be one that no signal ends
@pytest.mark.parametrize("every", [6, pytest.param(1, marks=pytest.mark.slow)])
def test_a_ping_is_interrupted_at_its_lines(every):
    """Early versions hung, gave the ping before, or lacked framebuffers."""
    found = interrupts.interrupt(
        interrupts.ACTIONS["ping"], lambda places: list(dict.fromkeys(places))[::every]
    )
    assert found.n_interrupts > 300 / every
    assert found.faults == []


@pytest.mark.slow
@pytest.mark.timeout(60, method="thread")
@pytest.mark.parametrize(
    "module, n_least",
    [
        ("far_lobes", 60),
        pytest.param("workspace", 25, marks=pytest.mark.slow),
        pytest.param("labels", 90, marks=pytest.mark.slow),
    ],
)
def test_the_first_labels_are_interrupted_where_weights_are_found_and_kept(module, n_least):
    """Other stages use the weights and the response of columns that an interrupted ping has left."""
    acoustics = sg.Acoustics.physical(elevation_pattern="box")
    labelled = interrupts.ACTIONS["ping with labels"]._replace(
        settings={"acoustics": acoustics, "tolerance": 0.3}
    )
    file = f"beamform/{module}.py"
    found = interrupts.interrupt(
        labelled, lambda places: [place for place in dict.fromkeys(places) if place[0] == file]
    )
    assert found.n_interrupts > n_least
    assert found.faults == []


@pytest.mark.slow
@pytest.mark.timeout(300, method="thread")
def test_everything_that_a_simulator_does_is_interrupted():
    """Each line at least once, and of those that several actions run every EVERY-th again.

    `python -m tests.support.interrupts` interrupts all lines of all actions, which takes many minutes.
    """
    seen, faults, n_interrupts = set(), [], 0
    for name, action in interrupts.ACTIONS.items():

        def choose(places):
            new = [place for place in dict.fromkeys(places) if place not in seen]
            return [*new, *[place for place in dict.fromkeys(places) if place in seen][::EVERY]]

        found = interrupts.interrupt(action, choose)
        seen.update(found.places)
        n_interrupts += found.n_interrupts
        faults += [(name, fault) for fault in found.faults]
    assert n_interrupts > 1500
    assert faults == []


@pytest.mark.parametrize("kind", [KeyError, SystemExit, GeneratorExit])
def test_what_a_generator_of_poses_raises_comes_after_the_pings_before(kind):
    """Early versions lost up to five pings to what is no Exception."""

    def poses():
        yield from interrupts.POSES
        raise kind("no more poses")

    with interrupts.make_simulator(interrupts.ACTIONS["pings"].settings) as it:
        expected, got = [interrupts.contents(it.ping(pose)) for pose in interrupts.POSES], []
        with pytest.raises(kind):
            for ping in it.pings(poses()):
                got.append(interrupts.contents(ping))
        assert got == expected
        assert interrupts.contents(it.ping(interrupts.POSES[0])) == expected[0]


def test_an_interrupt_in_a_generator_of_poses_comes_at_once():
    """A caller that takes one more ping only would never get it otherwise."""

    def poses():
        yield interrupts.POSES[0]
        raise KeyboardInterrupt

    with interrupts.make_simulator(interrupts.ACTIONS["pings"].settings) as it:
        expected = interrupts.contents(it.ping(interrupts.POSES[0]))
        with pytest.raises(KeyboardInterrupt):
            next(it.pings(poses()))
        assert interrupts.contents(it.ping(interrupts.POSES[0])) == expected
