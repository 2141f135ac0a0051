"""A wall ahead, for which the coarsest samples suffice, and a row of thin rods, which need fine ones."""

import trimesh

import sonar_gl as sg


def wall(x_m=8.0, **more):
    return sg.Body("wall", trimesh.creation.box((1, 60, 60)), sg.pose(x_m), **more)


def row_of_rods(x_m=-8.0):
    mesh = trimesh.creation.cylinder(0.02, 3.0, sections=16)
    return [sg.Body(f"rod {k}", mesh, sg.pose(x_m, 0.3 * k)) for k in range(-9, 10)]
