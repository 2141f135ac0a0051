"""Pings of depth images that pyrender draws with the cameras of `Camera.covering`."""

import numpy as np
import pytest
import trimesh

import sonar_gl as sg
from sonar_gl.scene.pyrender_scene import import_pyrender
from tests.support.main_lobe import main_lobe_alone

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("main_lobe_alone")]
__all__ = ["main_lobe_alone"]  # the fixture

BOXES = {
    "floor": ((60, 60, 1), (0, 0, -3)),
    "crate": ((2, 1, 2), (8, 1, -1.5)),
    "post": ((0.3, 0.3, 4), (5, -6, -0.5)),
}


@pytest.mark.usefixtures("opengl_for_pyrender")
def test_a_ping_of_pyrender_s_depth_is_the_simulator_s():
    pyrender = import_pyrender()

    class ProjectionCamera(pyrender.camera.Camera):
        """A pyrender camera with a given projection matrix."""

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
        drawn.main_camera_node = drawn.add(
            ProjectionCamera(camera.projection(0.1, 200.0)), pose=camera.pose_gl(pose)
        )
        renderer = pyrender.OffscreenRenderer(camera.width, camera.height)
        depth.append(renderer.render(drawn, flags=pyrender.RenderFlags.DEPTH_ONLY))
        renderer.delete()
    ping = sg.ping_from_depth(depth, sonar, cameras, acoustics, pose=pose)
    with sg.Simulator(sg.Scene(bodies), sonar, acoustics, tolerance=0.005) as simulator:
        expected = simulator.ping(pose)
    # Pixels are a tenth of a degree wide; a rotation or a shift by ten pixels would change a third of the echo.
    assert np.abs(ping.intensity - expected.intensity).sum() < 0.015 * expected.intensity.sum()
