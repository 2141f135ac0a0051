"""Depth images that another program has drawn with the cameras given to it."""

import numpy as np
import trimesh

import sonar_gl as sg
from sonar_gl.load import import_pyrender

BOXES = {
    "floor": ((60, 60, 1), (0, 0, -3)),
    "crate": ((2, 1, 2), (8, 1, -1.5)),
    "post": ((0.3, 0.3, 4), (5, -6, -0.5)),
}


def test_pyrender_draws_what_the_simulator_hears():
    pyrender = import_pyrender()

    class Given(pyrender.camera.Camera):
        """A camera of a projection that is given."""

        def __init__(self, matrix):
            super().__init__(znear=0.1, zfar=200.0)
            self.matrix = matrix

        def get_projection_matrix(self, width=None, height=None):
            return self.matrix

    sonar = sg.load_sonar("p900-130").with_range(15.0)
    acoustics, pose = sg.Acoustics.physical(), sg.pose(1, 0.5, 0.2, 0.1, 0.15, 0.3)
    drawn, bodies = pyrender.Scene(), []
    for name, (extents, place) in BOXES.items():
        body = sg.Body(name, trimesh.creation.box(extents), sg.pose(*place, yaw=0.4))
        bodies.append(body)
        drawn.add(pyrender.Mesh.from_trimesh(body.mesh, smooth=False), pose=body.pose)
    cameras, depth = sg.Camera.covering(sonar, acoustics), []
    for camera in cameras:
        drawn.main_camera_node = drawn.add(Given(camera.projection(0.1, 200.0)), pose=camera.pose_gl(pose))
        renderer = pyrender.OffscreenRenderer(camera.width, camera.height)
        depth.append(renderer.render(drawn, flags=pyrender.RenderFlags.DEPTH_ONLY))
        renderer.delete()
    ping = sg.ping_from_depth(depth, sonar, cameras, acoustics, pose=pose)
    with sg.Simulator(sg.Scene(bodies), sonar, acoustics, tolerance=0.005) as simulator:
        own = simulator.ping(pose)
    # pixels of a tenth of a degree; turned or shifted by ten of these the ping would be wrong by a third
    assert np.abs(ping.intensity - own.intensity).sum() < 0.015 * own.intensity.sum()
