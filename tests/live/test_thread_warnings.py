"""Pings in threads neither swallow warnings of the program beside them, nor show their own."""

import math
import threading
import warnings
from concurrent.futures import ThreadPoolExecutor

import pytest
import trimesh

import sonar_gl as sg
from sonar_gl.core.pose_track import PoseTrack
from sonar_gl.engine import pipeline
from sonar_gl.live.emulators.simulated_head import SimulatedHead
from sonar_gl.live.session import LiveSession
from sonar_gl.live.settings import LiveSettings
from sonar_gl.ros import Publisher, PublisherSettings
from tests.support.loopback_transport import LoopbackTransport
from tests.support.waiting import WAIT_S

SONAR = sg.Sonar("small", 900e3, 16, 40, 60.0, 20.0, 2.0, 0.5, 10.5)
ACOUSTICS = sg.Acoustics.ideal()
SETTINGS = LiveSettings(SONAR, acoustics=ACOUSTICS, noise="none", height=40, engine="cpu")
AWAY = sg.pose(yaw=math.pi)  # from the only body: a ping warns that it has no echo


class Gate:
    """Holds up pings of other threads than the main one, from `shut` to `open`, in what they are made with."""

    def __init__(self, monkeypatch):
        self.is_inside, self._may_go_on, self._is_shut = threading.Event(), threading.Event(), False
        sample = pipeline.sample

        def held_up(run, setup):
            if self._is_shut and threading.current_thread() is not threading.main_thread():
                self.is_inside.set()
                assert self._may_go_on.wait(WAIT_S)
            return sample(run, setup)

        monkeypatch.setattr(pipeline, "sample", held_up)

    def shut(self):
        self._is_shut = True

    def open(self):
        self._may_go_on.set()


@pytest.fixture
def gate(monkeypatch):
    return Gate(monkeypatch)


@pytest.fixture
def scene():
    return sg.Scene([sg.Body("wall", trimesh.creation.box((0.1, 30, 30)), sg.pose(9.0, 0, 0))], AWAY, "wall")


def of_session(scene, beside):
    with LiveSession(scene, SETTINGS) as session:
        frame = beside(session.next_frame)
    (note,) = frame.notes
    assert "no echo" in note


def of_prices(scene, beside):
    with LiveSession(scene, SETTINGS) as session:
        assert beside(session.prices)


def of_publisher(scene, beside):
    topics = PublisherSettings(topics={"points": None})
    with Publisher(scene, SONAR, [LoopbackTransport()], ACOUSTICS, settings=topics) as publisher:
        assert beside(lambda: publisher.step(0.0)).has_pinged


def of_emulator(scene, beside):
    head = SimulatedHead(scene, SONAR, ACOUSTICS, sg.Noise(), PoseTrack([AWAY]))
    assert not beside(lambda: head.ping(SONAR, ACOUSTICS, 0.0, 0)).intensity.any()
    head.close()


@pytest.mark.usefixtures("timed_once")
@pytest.mark.parametrize("make", [of_session, of_prices, of_publisher, of_emulator])
def test_a_ping_in_a_thread_leaves_the_warnings_of_the_process_alone(scene, gate, make):
    before = list(warnings.filters), warnings.showwarning

    def beside(work):
        gate.shut()
        with warnings.catch_warnings(record=True) as shown, ThreadPoolExecutor(1) as other:
            warnings.simplefilter("always")
            found = other.submit(work)
            assert gate.is_inside.wait(WAIT_S)
            warnings.warn("of the program", stacklevel=1)
            gate.open()
            result = found.result(WAIT_S)
        assert [str(one.message) for one in shown] == ["of the program"]
        return result

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of what is made before
        make(scene, beside)
    assert (warnings.filters, warnings.showwarning) == before


@pytest.mark.parametrize("make", [of_publisher, of_emulator])
def test_topics_and_emulators_warn_of_a_sonar_in_the_air(make):
    """Not of a ping without an echo, as that of the emulator here, since a device does not say that it sees nothing."""
    wall = sg.Body("wall", trimesh.creation.box((1, 20, 20)), sg.pose(5))
    with warnings.catch_warnings(record=True) as shown:
        warnings.simplefilter("always")
        make(sg.Scene([wall], sg.pose(), surface_z_m=-1.0), lambda work: work())
    (told,) = (str(one.message) for one in shown)
    assert told.startswith("the sonar at z = 0 m is above the water's surface at z = -1 m")
