"""A sonar and scenes for tests of samples that keep a tolerance."""

import trimesh

import sonar_gl as sg
from sonar_gl.engine.pipeline import make_ping
from sonar_gl.engine.request import PingRequest
from tests.support.wall_and_rods import row_of_rods, wall

SONAR = sg.Sonar("plan", 900e3, 64, 200, 45.0, 20.0, 1.0, 0.5, 20.0)
IDEAL = sg.Acoustics.ideal()
WALL_AND_RODS = sg.Scene([wall(), *row_of_rods()])


def ball(x=8.0, radius=1.0, name="ball", **more):
    return sg.Body(name, trimesh.creation.icosphere(4, radius), sg.pose(x), **more)


def ball_and_floor():
    return sg.Scene([ball(), sg.Body("floor", trimesh.creation.box((80, 80, 1)), sg.pose(0, 0, -3.5))])


def make_alone(simulator, pose):
    """Return a ping whose samples are chosen from it alone, whatever was made before."""
    return make_ping(simulator.run, PingRequest(pose, alone=True))


def level_of(simulator):
    return simulator.run.sampler.plan.level
