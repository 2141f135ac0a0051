"""Many pings of a small scene, and the memory and GL objects that remain."""

import ctypes
import gc
import sys
from dataclasses import replace

import numpy as np
import trimesh

import sonar_gl as sg
from sonar_gl.core.memory import return_free_memory
from tests.support.memory import resident_bytes

SONAR = sg.Sonar("soak", 900e3, 128, 200, 60.0, 20.0, 1.0, 0.5, 20.0)
N_POSES = 997  # then they repeat


def make_bodies():
    """Return a floor and two bodies."""
    return [
        sg.Body("floor", trimesh.creation.box((60, 60, 1)), sg.pose(0, 0, -3), 0.3),
        sg.Body("ball", trimesh.creation.icosphere(3, 1.0), sg.pose(7, 2, -1), 0.8),
        sg.Body("box", trimesh.creation.box((1, 1, 2)), sg.pose(9, -2, -1.5), 0.8),
    ]


def make_simulator(context=None):
    """Return a simulator of these bodies with 256 by 40 samples."""
    return sg.Simulator(sg.Scene(make_bodies()), SONAR, sampling=sg.Sampling(2, 40), context=context)


def pose_of(k):
    """Return the pose of ping k, near the origin, looking ahead."""
    x, y, z, roll, pitch, yaw = np.random.default_rng(k % N_POSES).uniform(-1, 1, 6)
    return sg.pose(x, y, z, 0.2 * roll, 0.2 * pitch, 0.2 * yaw)


def run(simulator, n_pings):
    """Make pings, some with labels or noise, and some point clouds and G-buffers."""
    # the waves of place-locked speckle are kept up to a bound, see tests/noise/test_place_locked_speckle.py
    noise = replace(sg.Noise.physical(), follow_motion=False)
    for k in range(n_pings):
        simulator.ping(pose_of(k), noise if k % 5 == 0 else None, k, labels=k % 10 == 0)
        if k % 100 == 0:
            simulator.point_cloud(pose_of(k), 40, 10)
            simulator.gbuffers(pose_of(k))


def settled_bytes():
    """Return the resident memory without what was freed: what other tests of the process freed comes and goes."""
    return_free_memory()
    return resident_bytes()


class _Mallinfo2(ctypes.Structure):
    _names = ("arena", "ordblks", "smblks", "hblks", "hblkhd", "usmblks", "fsmblks", "uordblks", "fordblks")
    _fields_ = [(name, ctypes.c_size_t) for name in (*_names, "keepcost")]


def allocated():
    """Return allocated memory, which is steady to some kilobytes, unlike resident memory.

    Returns
    -------
    (2,) : bytes allocated by malloc (glibc 2.33 or newer), memory blocks of Python's objects
    """
    gc.collect()
    mallinfo2 = ctypes.CDLL(None).mallinfo2
    mallinfo2.restype = _Mallinfo2
    info = mallinfo2()
    return np.array([info.uordblks + info.hblkhd, sys.getallocatedblocks()])


def check_growth(before, resident, n_pings):
    """Check that less memory remains than one small object per ping; caches may still grow a little.

    before : result of `allocated`, resident : result of `settled_bytes`, both n_pings earlier
    """
    remaining_bytes, blocks = allocated() - before
    assert remaining_bytes < 256 * n_pings, f"{remaining_bytes} bytes of malloc are left of {n_pings} pings"
    assert blocks < 0.9 * n_pings, f"{blocks} blocks of Python's memory are left of {n_pings} pings"
    # allocations of whole pages are not counted by malloc
    grown = settled_bytes() - resident
    assert grown < 4e6, f"{grown} bytes more are resident after {n_pings} pings"


def gl_objects(simulator):
    """Return the number of OpenGL objects of each kind in a simulator's context; none where the CPU draws."""
    if simulator.gl_info["engine"] == "cpu":
        return {}
    library = ctypes.CDLL("libGL.so.1")
    with simulator.run.drawing() as context:
        context.gc()
        return {
            kind: sum(bool(getattr(library, f"glIs{kind}")(name)) for name in range(1, 100_000))
            for kind in ("Buffer", "Texture", "Framebuffer", "Renderbuffer", "Program")
        }
