"""A thin face before a parallel one: a row that meets it alone does not know its height, whatever lies behind it."""

import numpy as np
import pytest
import trimesh

import sonar_gl as sg

SONAR = sg.Sonar("narrow", 900e3, 16, 100, 8.0, 6.0, 1.0, 0.5, 30.0)


@pytest.mark.parametrize("rows", [100, 200])  # the front edge is a fifth of a row high, or two fifths
def test_a_wall_behind_a_plate_that_points_at_the_sonar_leaves_its_echo(rows):
    # Its lower side is seen at a degree of grazing, so that four fifths of its echo are of its front edge, 1 mm high.
    # Where a row meets this edge, its border with the lower side is known, and the upper one is not: it would lie half
    # a row above on average, and the edge return too little. With both half way it has its own height on average.
    plate = sg.Body("plate", trimesh.creation.box((0.56, 0.27, 0.001)), sg.pose(5.1, 0, 0.103))
    wall = sg.Body("wall", trimesh.creation.box((1, 200, 200)), sg.pose(28.5), reflectivity=0.02)
    rng = np.random.default_rng(0)
    poses = [sg.pose(pitch=rng.uniform(-2e-3, 2e-3), yaw=rng.uniform(-2e-3, 2e-3)) for _ in range(12)]
    sampling, echoes = sg.Sampling(8, rows), []
    for bodies in ([plate], [plate, wall]):
        with sg.Simulator(sg.Scene(bodies), SONAR, sg.Acoustics.ideal(), sampling) as simulator:
            echoes.append([ping.body_echo[1] for ping in simulator.pings(poses, labels=True)])
    alone, before_wall = np.array(echoes)
    np.testing.assert_allclose(before_wall, alone, rtol=1e-5)
