"""Cameras at the sonar's position: pixels, projections, and sets of cameras that cover a fan."""

import math
from dataclasses import replace

import numpy as np
import pytest

import sonar_gl as sg
from sonar_gl import embed
from sonar_gl.embed.camera import covered_fraction
from sonar_gl.sonar.sector import MAX_AZIMUTH_RAD

SQUARE = [[500.0, 0, 320], [0, 500, 240], [0, 0, 1]]


def pixel(camera, point):
    """Return the pixel of a point in the sonar's frame, by the projection written out: starboard is right, up is up."""
    x, y, z = np.asarray(camera.rotation).T @ point
    K = camera.intrinsics
    return [(K[0, 0] * x + K[0, 1] * y) / z + K[0, 2], (K[1, 0] * x + K[1, 1] * y) / z + K[1, 2]]


def gl_pixel(projection, camera_from_world, size, point):
    """Return where OpenGL draws a world point: pixels from the top left, whole numbers at their centres."""
    clip = projection @ camera_from_world @ [*point, 1.0]
    x, y = clip[:2] / clip[3]
    return [(x + 1) / 2 * size[0] - 0.5, (1 - y) / 2 * size[1] - 0.5]


def frustum(left, right, bottom, top, near, far):
    """Return the matrix of OpenGL's glFrustum."""
    return np.array(
        [
            [2 * near / (right - left), 0, (right + left) / (right - left), 0],
            [0, 2 * near / (top - bottom), (top + bottom) / (top - bottom), 0],
            [0, 0, -(far + near) / (far - near), -2 * far * near / (far - near)],
            [0, 0, -1, 0],
        ]
    )


def test_axes_and_first_pixel():
    camera = sg.Camera.of_fov(4, 2, fov_x_rad=math.pi / 2)
    # the image's corner lies 45 degrees to port, half a pixel beyond the centre of the first pixel
    assert pixel(camera, [1, 1, 0.5]) == pytest.approx([-0.5, -0.5], abs=1e-12)
    assert pixel(camera, [1, -1, -0.5]) == pytest.approx([3.5, 1.5], abs=1e-12)
    assert camera.sees([1, 0.999, 0.499]) and not camera.sees([1, 1.001, 0]) and not camera.sees([-1, 0, 0])
    tall = sg.Camera.of_fov(4, 2, fov_y_rad=math.radians(40))
    assert tall.intrinsics[0, 0] == tall.intrinsics[1, 1] == pytest.approx(1 / math.tan(math.radians(20)))
    both = sg.Camera.of_fov(4, 2, math.radians(90), math.radians(40))
    assert (both.intrinsics[0, 0], both.intrinsics[1, 1]) == pytest.approx(
        (2, 1 / math.tan(math.radians(20)))
    )


@pytest.mark.parametrize("change", ["plain", "infinite", "reversed"])
def test_the_depth_mapping_of_a_projection_does_not_change_the_camera(change):
    size, sides = (64, 48), (-0.3, 0.8, -0.2, 0.5)  # off-centre
    P = frustum(*sides, 0.5, 100.0)
    P[2] = {"infinite": [0, 0, -1, -1], "reversed": [0, 0, 0, 0.5]}.get(change, P[2])
    camera = sg.Camera.of_projection(P, *size)
    gl_from_sonar = np.array([[0, -1, 0, 0], [0, 0, 1, 0], [-1, 0, 0, 0], [0, 0, 0, 1.0]])
    for point in ([1, 0, 0], [2.0, -1.5, 0.7], [0.3, 0.1, -0.1]):
        assert pixel(camera, point) == pytest.approx(gl_pixel(P, gl_from_sonar, size, point), abs=1e-9)
    # the camera gives the projection back, with the depth planes of the call
    again = camera.projection(0.5, 100.0)
    assert np.allclose(again, frustum(*sides, 0.5, 100.0), atol=1e-12)


@pytest.mark.parametrize("far_m", [40.0, math.inf])
@pytest.mark.parametrize("is_reversed", [False, True])
@pytest.mark.parametrize("zero_to_one", [False, True])
@pytest.mark.parametrize("unit_m", [1.0, 1e-3])
def test_every_projection_has_its_planes_where_they_are_said(far_m, is_reversed, zero_to_one, unit_m):
    """And a world of other units is in metres after projection[2, 3] is."""
    camera = sg.Camera(640, 480, SQUARE)
    projection = camera.projection(
        0.5 / unit_m, far_m / unit_m, reversed=is_reversed, zero_to_one=zero_to_one
    )
    depths = (0.0 if zero_to_one else -1.0), 1.0
    for at_m, depth in zip((0.5, min(far_m, 1e15)), depths[::-1] if is_reversed else depths, strict=True):
        _, _, z, w = projection @ [0.1, 0.2, -at_m / unit_m, 1.0]
        assert z / w == pytest.approx(depth, abs=1e-12) and w == at_m / unit_m
    assert np.array_equal(projection[[0, 1, 3]], camera.projection(0.5, 40.0)[[0, 1, 3]])
    clip = projection @ [0, 0, -3.0 / unit_m, 1.0]
    depth = clip[2] / clip[3]
    in_metres = projection.copy()
    in_metres[2, 3] *= unit_m
    z_buffer = np.array([[depth if zero_to_one else (depth + 1) / 2]])
    # float32 of a depth near 1 resolves 3 m of 0.5 m to 1e-6
    assert embed.metres_ahead(z_buffer, in_metres, zero_to_one) == pytest.approx(3.0, rel=2e-6)


def test_pose_and_projection_draw_points_at_the_camera_s_pixels():
    turned = sg.pose(0, 0, 0, 0.4, -0.3, 2.0)[:3, :3]
    sheared = [[90.0, 7, 50], [-4, 80, 20], [0, 0, 1]]
    camera = sg.Camera(120, 70, sheared, turned @ sg.Camera(2, 2, SQUARE).rotation)
    world_from_sonar = sg.pose(3, -2, 1, 0.1, 0.2, -2.5)
    point = turned @ [4.0, 0.5, 0.2]
    world = (world_from_sonar @ [*point, 1])[:3]
    drawn = gl_pixel(
        camera.projection(0.1, 50), np.linalg.inv(camera.pose_gl(world_from_sonar)), (120, 70), world
    )
    assert drawn == pytest.approx(pixel(camera, point), abs=1e-9)


@pytest.mark.parametrize("name", ["p900-45", "p900-130", "aris-3000", "whole turn"])
@pytest.mark.parametrize(
    "acoustics", [sg.Acoustics.ideal(), sg.Acoustics.physical(elevation_pattern="gaussian")]
)
def test_covering_cameras_see_the_beam_pattern_and_little_more(name, acoustics):
    sonar = sg.load_sonar("p900-130" if name == "whole turn" else name)
    if name == "whole turn":
        sonar = sg.Sonar("turn", 900e3, 720, 100, 360.0, 20.0, 1.0, 0.5, 10.0)
    cameras = sg.Camera.covering(sonar, acoustics, pixel_deg=0.2)
    reach = acoustics.receive_support_rad(sonar)
    top = math.radians(acoustics.true_range_sonar(sonar).elevation_fov_deg) / 2
    psi = np.linspace(sonar.azimuth_rad[0] - reach, sonar.azimuth_rad[-1] + reach, 801)
    phi = np.linspace(-top, top, 101)[:, None]
    d = np.stack(np.broadcast_arrays(np.cos(phi) * np.cos(psi), np.cos(phi) * np.sin(psi), np.sin(phi)), -1)
    n_views = np.sum([camera.sees(d) for camera in cameras], axis=0)
    assert (n_views > 0).all()
    assert (n_views > 1).mean() < 0.02  # only the margins overlap
    # the images end within four pixels of the border
    half = math.atan(cameras[0].width / 2 * math.radians(0.2))
    assert half <= math.pi / 4 + 3 * math.radians(0.2)
    beyond = math.atan(math.tan(top) * 1.0 + 4 * math.radians(0.2) / math.cos(half))
    middle = cameras[0].rotation[:, 2]
    corner = math.atan2(middle[1], middle[0]) + half - 4 * math.radians(0.2)
    above = [math.cos(beyond) * math.cos(corner), math.cos(beyond) * math.sin(corner), math.sin(beyond)]
    assert not cameras[0].sees(above)
    assert np.allclose(cameras[0].pixel_rad(), math.radians(0.2), rtol=1e-3)


def test_cameras_for_the_cones_of_a_straight_array_see_what_it_shows_at_the_edge():
    """A cone that is shown at an azimuth lies further aside above and below."""
    sonar, acoustics = sg.load_sonar("oculus-m750d-lf"), sg.Acoustics.physical()
    top = math.radians(acoustics.true_range_sonar(sonar).elevation_fov_deg) / 2
    edge = sonar.azimuth_rad[-1] + acoustics.receive_support_rad(sonar)
    shown, phi = np.linspace(-edge, edge, 801), np.linspace(-top, top, 101)[:, None]
    y, z = np.broadcast_arrays(np.sin(shown), np.sin(phi))
    ahead = np.sqrt(np.maximum(1 - y * y - z * z, 0))
    d = np.stack([ahead, y, z], axis=-1)[np.abs(y) < math.tan(MAX_AZIMUTH_RAD) * ahead]
    for pixel_deg in (0.2, 1.0):
        seen = [camera.sees(d) for camera in sg.Camera.covering(sonar, acoustics, pixel_deg)]
        assert np.any(seen, axis=0).all()
    upright = sg.Camera.covering(sonar, replace(acoustics, conical_beams=False), 0.2)
    assert not np.any([camera.sees(d) for camera in upright], axis=0).all()
    # and a rig of the upright fan's cameras says so
    narrow = sg.Camera.covering(sonar, sg.Acoustics.ideal(), 0.2)
    assert covered_fraction(sonar, narrow) == 1.0 > 0.999 > covered_fraction(sonar, narrow, are_cones=True)
    wide = sg.Camera.covering(sonar, acoustics, 0.2)
    assert covered_fraction(sonar, wide, are_cones=True) == 1.0


def test_a_fan_that_lies_aside_is_covered_by_its_own_cameras():
    """Such as a ray sensor of SDF that scans to one side; the field of view reaches as far to the other."""
    azimuths = tuple(np.linspace(-10, 40, 101))
    sonar = replace(sg.load_sonar("p900-45"), n_beams=101, beam_azimuths_deg=azimuths, azimuth_fov_deg=81.0)
    cameras = sg.Camera.covering(sonar, sg.Acoustics.ideal(), pixel_deg=0.2)
    assert covered_fraction(sonar, cameras) == 1.0
    assert covered_fraction(sonar, sg.Camera.covering(sg.load_sonar("p900-45"), pixel_deg=0.2)) < 0.8


def test_pixel_size_in_azimuth_and_elevation():
    upright = sg.Camera.of_fov(200, 100, math.radians(60), math.radians(20))
    across, up = upright.pixel_rad()
    assert (across, up) == pytest.approx(
        (2 * math.tan(math.radians(30)) / 200, 2 * math.tan(math.radians(10)) / 100)
    )
    roll = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]])
    assert sg.Camera.of_fov(
        200, 100, math.radians(60), math.radians(20), upright.rotation @ roll
    ).pixel_rad() == pytest.approx((up, across))
    # 40 degrees up a pixel spans more azimuth, since meridians converge there
    tilted = sg.Camera.of_fov(
        200,
        100,
        math.radians(60),
        math.radians(20),
        sg.pose(pitch=-math.radians(40))[:3, :3] @ upright.rotation,
    )
    assert tilted.pixel_rad() == pytest.approx((across / math.cos(math.radians(40)), up), rel=1e-3)


def flipped(P):
    return np.diag([1, -1, 1, 1]) @ P


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: sg.Camera(0, 2, SQUARE), "width of a camera must be a whole number of pixels"),
        (lambda: sg.Camera(2, 2.0, SQUARE), "height of a camera must be a whole number of pixels"),
        (lambda: sg.Camera(2, 2, np.eye(4)), r"intrinsics of a camera must have shape \(3, 3\)"),
        (lambda: sg.Camera(2, 2, np.transpose(SQUARE)), "must have the last row 0 0 1"),
        (lambda: sg.Camera(2, 2, np.full((3, 3), np.nan)), "intrinsics of a camera must be finite"),
        (lambda: sg.Camera(2, 2, np.diag([1.0, -1, 1])), "must have fx and fy above 0"),
        (
            lambda: sg.Camera(2, 2, SQUARE, np.diag([1.0, 1, -1])),
            "rotation of a camera must be sonar_from_camera",
        ),
        (
            lambda: sg.Camera(2, 2, SQUARE, 2 * np.eye(3)),
            "rotation of a camera must be sonar_from_camera",
        ),
        (lambda: sg.Camera.of_fov(2, 2), "must be given its field of view"),
        (lambda: sg.Camera.of_fov(2, 2, 90), r"fov_x_rad must be radians between 0 and π \(got 90\)"),
        (lambda: sg.Camera.of_fov(2, 2, fov_y_rad=0), "fov_y_rad must be radians"),
        (
            lambda: sg.Camera.of_projection(flipped(frustum(-1, 1, -1, 1, 1, 9)), 2, 2),
            r"projection must have x to the right and y up, \[0, 0\] and \[1, 1\] above 0 \(got 1 and -1; give it",
        ),
        (
            lambda: sg.Camera(2, 2, SQUARE).projection(1.0, 0.5),
            r"near_m must be metres above 0, and far_m above that .got 1.0 and 0.5\)",
        ),
        (
            lambda: sg.Camera(2, 2, SQUARE).projection(math.inf, math.inf),
            "near_m must be metres above 0, and far_m",
        ),
        (lambda: sg.Camera(2, 2, SQUARE).pose_gl(np.eye(3)), r"pose must have shape \(4, 4\)"),
        (lambda: sg.Camera.covering("p900-45"), "sonar must be a Sonar"),
        (lambda: sg.Camera.covering(sg.load_sonar("p900-45"), pixel_deg=1e-3), "at most 16384 pixels a side"),
    ],
)
def test_invalid_cameras_raise_errors(make, message):
    with pytest.raises(sg.Error, match=message):
        make()


def test_a_camera_copies_its_intrinsics():
    K = np.array(SQUARE)
    camera = sg.Camera(640, 480, K)
    K[0, 0] = 1.0
    assert camera.intrinsics[0, 0] == 500 and not camera.intrinsics.flags.writeable


def test_sonar_pose_of_an_opengl_camera():
    """`sonar_pose` inverts `pose_gl`, also for a camera that looks aside."""
    for rotation in (None, sg.pose(yaw=0.7, pitch=0.2)[:3, :3] @ sg.Camera.of_fov(4, 4, 1.0).rotation):
        camera, pose = sg.Camera.of_fov(64, 48, 1.2, rotation=rotation), sg.pose(1, 2, 3, 0.3, -0.2, 1.1)
        np.testing.assert_allclose(camera.sonar_pose(camera.pose_gl(pose)), pose, atol=1e-12)
    # an OpenGL camera at the origin looks along -z with y up; the sonar's x and z axes do the same
    sonar = sg.Camera.of_fov(64, 48, 1.2).sonar_pose(np.eye(4))
    np.testing.assert_allclose(sonar[:3, :3] @ [1, 0, 0], [0, 0, -1], atol=1e-12)
    np.testing.assert_allclose(sonar[:3, :3] @ [0, 0, 1], [0, 1, 0], atol=1e-12)
    with pytest.raises(sg.Error, match="world_from_camera"):
        sg.Camera.of_fov(64, 48, 1.2).sonar_pose(np.eye(3))


def test_cameras_that_cover_a_tilted_head_look_where_it_looks():
    """30 degrees down, with an aperture of 20 degrees: what lies level with the housing is not in it."""
    sonar = sg.Sonar("tilted", 900e3, 64, 100, 40.0, 20.0, 1.0, 0.5, 10.0, tilt_deg=30.0)
    cameras = sg.Camera.covering(sonar, sg.Acoustics.ideal(), pixel_deg=0.2)
    for elevation_deg, is_seen in ((-30.0, True), (-39.9, True), (-20.1, True), (-42.0, False), (0.0, False)):
        direction = [math.cos(math.radians(elevation_deg)), 0.0, math.sin(math.radians(elevation_deg))]
        assert any(camera.sees(direction) for camera in cameras) == is_seen


def test_cameras_that_cover_a_tilted_head_see_all_of_its_fan_in_the_axes_of_the_head():
    """Up to the corners of an aperture of 80 degrees; one that looks ahead of the housing looks up from the head."""
    sonar = sg.Sonar("tilted", 900e3, 64, 100, 40.0, 80.0, 1.0, 0.5, 10.0, tilt_deg=30.0)
    cameras = sg.Camera.covering(sonar, sg.Acoustics.ideal(), pixel_deg=0.2)
    assert covered_fraction(sonar, [camera.seen_from_head(sonar) for camera in cameras]) == 1.0
    ahead = sg.Camera.of_fov(64, 48, 0.5).seen_from_head(sonar)
    directions = [sg.pose(pitch=math.radians(down_deg))[:3, 0] for down_deg in (-30, 0, 30)]
    assert ahead.sees(directions).tolist() == [True, False, False]


def test_pixels_of_covering_cameras_may_be_up_to_ten_degrees_wide():
    sonar = sg.load_sonar("p900-45")
    assert sg.Camera.covering(sonar, pixel_deg=10.0)
    for pixel_deg in (0.0, 10.1, math.nan):
        with pytest.raises(sg.Error, match=r"^pixel_deg must be degrees above 0"):
            sg.Camera.covering(sonar, pixel_deg=pixel_deg)


@pytest.mark.parametrize("place", [(0, 3), (1, 3), (3, 0), (3, 1), (3, 3)])
def test_a_matrix_that_is_no_perspective_is_refused(place):
    matrix = frustum(-1, 1, -1, 1, 1.0, 10.0)
    sg.Camera.of_projection(matrix, 4, 4)
    matrix[place] += 0.5
    with pytest.raises(sg.Error, match=r"^projection must be an OpenGL perspective"):
        sg.Camera.of_projection(matrix, 4, 4)
