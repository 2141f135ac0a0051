"""A program that closes sonars and hosts in every order, and counts the OpenGL objects that are left.

    embed_lifetimes.py egl | glx [case ...]

It runs all of CASES, or some, with hosts of EGL or GLX, and prints one JSON object: the traceback of each
case that failed. GLX needs a process of its own, since no EGL context can be current beside one of GLX.
"""

import gc
import itertools
import json
import os
import sys
import traceback
from dataclasses import replace

import numpy as np
import pytest

import sonar_gl as sg
from sonar_gl.gl import lifetime
from sonar_gl.raster.opengl import buffers
from tests.support import soak
from tests.support.host_state import objects
from tests.support.hosts import HOSTS, EglHost
from tests.support.threads import in_another_thread

POSE = sg.pose(0.2, 0.1, -0.5, 0.1, 0.15, 0.05)
SMALL = sg.Sonar("small", 900e3, 16, 40, 60.0, 20.0, 1.0, 0.5, 20.0)
PINGS, WARM_UP = 1200, 400  # caches are full by then


def loader_of(simulator):
    """Return the EglContext or HostContext that a simulator draws in."""
    with simulator.run.drawing() as context:
        return context.extra


def another_thread(kind):
    """A joined simulator can neither ping nor be closed in another thread, and stays usable in its own."""
    host = HOSTS[kind]()
    with soak.make_simulator("current") as simulator:
        before = simulator.ping(POSE).intensity
        for function in (
            lambda: simulator.ping(POSE),
            simulator.close,
            lambda: sg.Simulator(simulator, SMALL),
        ):
            (why,) = in_another_thread(function)
            assert why == (
                "what joined a host's OpenGL context must be used in the thread where that was current (got "
                "'other', made in 'MainThread'); hand pings to other threads, not the sonar"
            )
        (why,) = in_another_thread(lambda: soak.make_simulator("current"))
        assert why.startswith(
            "an OpenGL context must be current in this thread, to be joined (got none in 'other'"
        )
        np.testing.assert_array_equal(simulator.ping(POSE).intensity, before)
    host.destroy()


def nothing_current(kind):
    """Joining needs a current context. So does a ping in a GLX context; on EGL the simulator has its own."""
    host = HOSTS[kind]()
    simulator = soak.make_simulator("current")
    before = simulator.ping(POSE).intensity
    host.make_none_current()
    with pytest.raises(sg.Error, match=r"must be current in this thread, to be joined \(got none in 'Main"):
        soak.make_simulator("current")
    if kind == "glx":
        with pytest.raises(
            sg.Error, match=r"must be current when its sonar is used \(got none\); make it cur"
        ):
            simulator.ping(POSE)
        other = HOSTS[kind]()
        with pytest.raises(sg.Error, match=r"must be current when its sonar is used \(got another one\)"):
            simulator.ping(POSE)
        other.destroy()
    else:  # a context of its own
        np.testing.assert_array_equal(simulator.ping(POSE).intensity, before)
        assert host.platform()[0] is None
    host.make_current()
    np.testing.assert_array_equal(simulator.ping(POSE).intensity, before)
    simulator.close()
    host.destroy()


def no_desktop_opengl(kind):
    """A host of OpenGL ES cannot be joined."""
    if kind == "glx":
        return
    host = EglHost(None)
    current = host.platform()
    with pytest.raises(
        sg.Error, match=r"must be of OpenGL 3.3 or newer \(got OpenGL ES\); ask the host for one"
    ):
        soak.make_simulator("current")
    assert host.platform() == current
    host.destroy()


def closing_in_any_order(kind):
    """Two simulators that joined, and a second sonar of the first: any order leaves the host as it was."""
    host = HOSTS[kind]()
    before = objects(host.gl)
    for order in itertools.permutations(range(3)):
        first, alone = soak.make_simulator("current"), soak.make_simulator("current")
        several = first, sg.Simulator(first, replace(SMALL, n_beams=32)), alone
        pings = [one.ping(POSE).intensity for one in several]
        for k, number in enumerate(order):
            several[number].close()
            several[number].close()
            with pytest.raises(sg.Error, match="this Simulator is closed; make a new one"):
                several[number].ping(POSE)
            for still in order[k + 1 :]:
                np.testing.assert_array_equal(several[still].ping(POSE).intensity, pings[still])
        assert objects(host.gl) == before
    host.destroy()


def host_first(kind):
    """Closing after the host is destroyed raises nothing, and does not touch another host."""
    host, left = HOSTS[kind](), HOSTS[kind]()
    host.make_current()
    simulators = [soak.make_simulator("current") for _ in range(2)]
    simulators.append(sg.Simulator(simulators[0], SMALL))
    host.destroy()
    for simulator in simulators:
        simulator.close()
    left.make_current()
    before = objects(left.gl)
    with soak.make_simulator("current") as simulator:
        simulator.ping(POSE)
    assert objects(left.gl) == before
    assert left.platform()[0]
    left.destroy()


def not_current_as_it_is_closed(kind):
    """What cannot be released while another context is current is released at the next use."""
    host, other = HOSTS[kind](), HOSTS[kind]()
    host.make_current()
    before = objects(host.gl)
    simulator = soak.make_simulator("current")
    other.make_current()
    simulator.close()
    with soak.make_simulator("current"):  # the first host's objects are out of reach here
        pass
    host.make_current()
    with soak.make_simulator("current"):
        pass
    assert objects(host.gl) == before
    other.destroy()
    host.destroy()


def forgotten(kind):
    """A simulator that is never closed is released at the next use of another."""
    host = HOSTS[kind]()
    before = objects(host.gl)
    kept = soak.make_simulator("current")
    for _ in range(2):  # the second ping releases what the first has replaced
        kept.ping(POSE)
    alive = objects(host.gl)
    for _ in range(3):
        simulator = soak.make_simulator("current")
        simulator.ping(POSE)
        assert objects(host.gl) != alive
        del simulator
        gc.collect()
        kept.ping(POSE)
        assert objects(host.gl) == alive
    kept.close()
    assert objects(host.gl) == before
    host.destroy()


def exceptions(kind):
    """Exceptions leave no objects behind, and the simulator that raised them goes on working."""
    host = HOSTS[kind]()
    before, current = objects(host.gl), host.platform()
    with pytest.raises(sg.Error, match="samples must fit the driver's limit"):
        sg.Simulator(
            sg.Scene(soak.make_bodies()), soak.SONAR, sampling=sg.Sampling(1024, 40), context="current"
        )
    assert host.platform() == current
    gc.collect()
    with soak.make_simulator("current") as simulator:
        simulator.ping(POSE)  # releases what its constructor has replaced
        good = simulator.ping(POSE).intensity
        alive = objects(host.gl)
        for wrong in ({"bodies": {"nobody": None}}, {"time_s": float("nan")}):
            with pytest.raises(sg.Error):
                simulator.ping(POSE, **wrong)
        assert host.platform() == current
        np.testing.assert_array_equal(simulator.ping(POSE).intensity, good)
        assert objects(host.gl) == alive
    assert objects(host.gl) == before
    assert host.gl.errors() == []
    host.destroy()


def failing_to_be_made(kind):
    """Objects that a failed constructor has made are released at the next use."""
    host = HOSTS[kind]()
    before, current = objects(host.gl), host.platform()

    def fail(*_):
        raise sg.Error("none of these")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(buffers.UploadedMeshes, "with_more", fail)
        with pytest.raises(sg.Error, match="none of these"):
            soak.make_simulator("current")
    assert host.platform() == current
    assert objects(host.gl) != before
    gc.collect()
    soak.make_simulator("current").close()
    assert objects(host.gl) == before
    host.destroy()


def hosts_without_end(kind):
    """Of many hosts, each destroyed before its sonar is closed, a bounded number of contexts waits."""
    for _ in range(20):
        host = HOSTS[kind]()
        simulator = soak.make_simulator("current")
        host.destroy()
        simulator.close()
    # on GLX a destroyed context cannot be told from one that is not current
    waiting = lifetime.waiting()
    assert waiting <= (min(20, lifetime.MAX_UNREACHABLE) if kind == "glx" else 0)
    host = HOSTS[kind]()
    before = objects(host.gl)
    with soak.make_simulator("current") as simulator:
        assert simulator.ping(POSE).intensity.any()
    assert objects(host.gl) == before
    assert lifetime.waiting() <= waiting
    host.destroy()


def address_taken(kind):
    """A later context at the address of a destroyed one is neither drawn in nor destroyed."""
    host, later = HOSTS[kind](), HOSTS[kind]()
    host.make_current()
    simulator = soak.make_simulator("current")
    loader = loader_of(simulator)
    later.make_current()
    other = soak.make_simulator("current")
    wanted, its = other.ping(POSE).intensity, loader_of(other)
    if kind == "egl":
        loader.binding, loader.destroy = its.binding, its.destroy
    else:
        loader.current.handle = its.current.handle
    before = objects(later.gl), later.platform()
    with pytest.raises(sg.Error, match="must still be there"):
        simulator.ping(POSE)
    simulator.close()
    assert (objects(later.gl), later.platform()) == before
    np.testing.assert_array_equal(other.ping(POSE).intensity, wanted)
    other.close()
    later.destroy()
    host.destroy()


def display_closed(kind):
    """A host closes the display, as pyrender's delete() does: pings raise an Error, and closing is silent."""
    if kind == "glx":
        return
    host = EglHost()
    simulators = soak.make_simulator("current"), soak.make_simulator("current")
    addresses = {loader_of(one).binding.context for one in simulators}
    host.terminate()
    for simulator in simulators:
        with pytest.raises(
            sg.Error, match=r"must still be there \(got EGL error 0x30.*pyrender's delete\(\)"
        ):
            simulator.ping(POSE)
    later = [EglHost() for _ in range(20)]  # some may get the address of a destroyed context
    reused = [one for one in later if one.context.value in addresses]
    for one in reused or later[:1]:
        one.make_current()
        before = one.platform(), objects(one.gl)
        with pytest.raises(sg.Error, match="must still be there"):
            simulators[0].ping(POSE)
        assert (one.platform(), objects(one.gl)) == before
    for simulator in simulators:
        simulator.close()
    for one in later:
        one.make_current()  # none was destroyed
        one.destroy()


def alone_beside_a_host(kind):
    """A simulator with a context of its own keeps an EGL host current. Beside a GLX host it is refused."""
    alone = soak.make_simulator()
    wanted = alone.ping(POSE).intensity
    host = HOSTS[kind]()
    current, before = host.platform(), objects(host.gl)
    if kind == "egl":
        np.testing.assert_array_equal(alone.ping(POSE).intensity, wanted)
        with soak.make_simulator() as simulator:
            assert host.platform() == current
            np.testing.assert_array_equal(simulator.ping(POSE).intensity, wanted)
    else:
        for function in (soak.make_simulator, lambda: alone.ping(POSE)):
            with pytest.raises(sg.Error, match=r"no OpenGL context of GLX may be current.*context='current'"):
                function()
    assert (host.platform(), objects(host.gl)) == (current, before)
    alone.close()
    assert (host.platform(), objects(host.gl)) == (current, before)
    host.destroy()


def many_pings(kind):
    """Neither memory nor the number of objects grows."""
    host = HOSTS[kind]()
    before, current = objects(host.gl), host.platform()
    scene = sg.Scene(soak.make_bodies()[1:])
    with sg.Simulator(scene, SMALL, sampling=sg.Sampling(1, 8), context="current") as simulator:
        for k in range(WARM_UP + PINGS):
            if k == WARM_UP:
                alive, resident, used = objects(host.gl), soak.settled_bytes(), soak.allocated()
            simulator.ping(POSE, labels=k % 10 == 0)
        assert objects(host.gl) == alive
        soak.check_growth(used, resident, PINGS)
        assert host.platform() == current
    assert objects(host.gl) == before
    host.destroy()


CASES = [
    another_thread,
    nothing_current,
    no_desktop_opengl,
    closing_in_any_order,
    host_first,
    not_current_as_it_is_closed,
    forgotten,
    exceptions,
    failing_to_be_made,
    hosts_without_end,
    address_taken,
    display_closed,
    alone_beside_a_host,
    many_pings,
]


def too_old(kind):
    """A host of OpenGL 3.2 cannot be joined. Mesa has that with MESA_GL_VERSION_OVERRIDE."""
    host = HOSTS[kind]((3, 2))
    assert host.gl.version == 320
    with pytest.raises(sg.Error, match=r"must be of OpenGL 3.3 or newer \(got 3.2\); ask the host for one"):
        soak.make_simulator("current")
    assert host.gl.errors() == []
    host.destroy()


def closed_by_pyrender(kind):
    """pyrender closes the display, and with it the contexts of sonars that joined it or have their own."""
    os.environ["PYGLET_HEADLESS"] = "1"
    import pyrender

    alone = soak.make_simulator()
    scene = pyrender.Scene()
    scene.add(pyrender.PerspectiveCamera(1.0))
    renderer = pyrender.OffscreenRenderer(32, 32)
    renderer.render(scene)  # its context stays current
    joined = soak.make_simulator("current")
    np.testing.assert_array_equal(joined.ping(POSE).intensity, alone.ping(POSE).intensity)
    renderer.render(scene)
    renderer.delete()
    with pytest.raises(
        sg.Error, match=r"got one that was destroyed, or whose display was closed, as pyrender's"
    ):
        soak.make_simulator("current")
    gone = pytest.raises(sg.Error, match=r"must still be there .*pyrender's delete\(\)")
    for simulator in (joined, alone):
        with gone:
            simulator.ping(POSE)
    renderer = pyrender.OffscreenRenderer(32, 32)
    renderer.render(scene)
    for simulator in (joined, alone):  # a new context does not bring them back
        with gone:
            simulator.ping(POSE)
    joined.close()
    alone.close()
    with soak.make_simulator("current") as simulator:
        assert simulator.ping(POSE).intensity.any()
    renderer.render(scene)
    renderer.delete()


def main(kind: str, *names: str):
    """Run all cases or some, and print the tracebacks of those that failed."""
    failed = {}
    for case in [globals()[name] for name in names] or CASES:
        try:
            case(kind)
        except BaseException:
            failed[case.__name__] = traceback.format_exc()
    print(json.dumps(failed), flush=True)
    os._exit(0)  # without the clean-up of drivers, which is not under test


if __name__ == "__main__":
    main(*sys.argv[1:])
