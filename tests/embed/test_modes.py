"""Embedding modes host-drawn sectors and textures: their pings are those of a Simulator."""

import contextlib
import gc
import math
import os
import warnings
from dataclasses import replace
from functools import cache, partial
from types import SimpleNamespace

import moderngl
import numpy as np
import pytest
import trimesh

import sonar_gl as sg
from sonar_gl import embed
from sonar_gl.gl import egl
from sonar_gl.scene.scene import ROUGHNESS_BOUNDS_RAD
from tests.support import gl_host, host_state, soak
from tests.support.gl_host import GL  # for EGL, whatever was imported before
from tests.support.hosts import EglHost
from tests.support.main_lobe import main_lobe_alone
from tests.support.threads import in_another_thread

SONAR = sg.Sonar("host", 900e3, 128, 256, 45.0, 20.0, 1.0, 0.5, 20.0)
SAMPLING = sg.Sampling(4, 60)
POSE = sg.pose(0.3, -0.2, 0.1, 0.1, 0.15, 0.4)
# A host draws what the Simulator draws, except that it multiplies matrices in float32: of some 20 000 samples one or
# two along an outline hit another body.
ROUNDING = 1e-4
# of a host's 1/x, which a card interpolates between corners that it has moved by up to 1/512 of a sample
SNAPPING = 5e-4
pytestmark = pytest.mark.usefixtures("main_lobe_alone")
__all__ = ["main_lobe_alone"]  # the fixture


@pytest.fixture(autouse=True)
def context(context, monkeypatch):
    # the driver draws all of the Simulator's triangles, as it draws the host's: its rule for samples on an edge is not
    # that of the compiled rasteriser, which is llvmpipe's
    monkeypatch.setenv("SONAR_GL_SOFTWARE", "0")
    while GL.glGetError():  # errors of earlier tests, whose hosts failed on purpose
        pass
    return context


BALL, BOX = trimesh.creation.icosphere(3, 0.8), trimesh.creation.box((1.0, 1.0, 2.0))
OPEN = trimesh.Trimesh([[0, -1, -1], [0, 1, -1], [0, 0, 1]], [[0, 1, 2]], process=False)
# a floor, a smooth ball, a box with a specular lobe, a box with a μ per face, and an open mesh
SCENE = sg.Scene(
    [
        sg.Body("floor", trimesh.creation.box((60, 60, 1)), sg.pose(0, 0, -3), 0.3),
        sg.Body("ball", BALL, sg.pose(6, 4, -1), 0.8, normals=BALL.vertices / 0.8),
        sg.Body("smooth", BOX, sg.pose(7, 1, -1.5, yaw=0.4), 0.4, specular=0.5, roughness_rad=0.2),
        sg.Body("faces", BOX, sg.pose(9, 3, -1.5, yaw=0.9), np.linspace(0.1, 0.9, len(BOX.faces))),
        sg.Body("open", OPEN, sg.pose(8, 6, -1, yaw=0.5), 0.7),
    ]
)
# without specular lobes, smooth normals and μ per face, which textures cannot express
PLAIN = sg.Scene([body for body in SCENE.bodies if body.name in ("floor", "open", "ball")])


@pytest.fixture
def host(context):
    """A host that draws SCENE."""
    return gl_host.Program(SCENE)


@pytest.fixture
def sensor(context):
    with embed.Sensor(SONAR, sampling=SAMPLING) as sensor:
        yield sensor


def names(scene):
    return [body.name for body in scene.bodies]


def simulate(scene, sonar=SONAR, acoustics=None, sampling=SAMPLING, pose=POSE):
    with sg.Simulator(scene, sonar, acoustics, sampling) as simulator:
        return simulator.ping(pose, labels=True)


@cache
def true_ping():
    """Return the ping of SCENE that a host is compared with."""
    return simulate(SCENE)


def difference(ping, true):
    """Return the share of the echo that lies in wrong bins."""
    return np.abs(ping.intensity - true.intensity).sum(dtype=float) / true.intensity.sum(dtype=float)


def draw(host, sensor, pose=POSE, lobes=True):
    for sector in sensor.sectors(pose):
        with sector:
            host.draw("sonar", sector.view, sector.projection, sector.lattice, lobes)


@pytest.mark.parametrize(
    ("profile", "fov_deg"),
    [
        ("ideal", 60.0),
        ("physical", 130.0),
        pytest.param("physical", 360.0, marks=pytest.mark.slow),
        pytest.param("physical", 60.0, marks=pytest.mark.slow),
        pytest.param("ideal", 130.0, marks=pytest.mark.slow),
        pytest.param("ideal", 360.0, marks=pytest.mark.slow),
    ],
)
def test_host_drawn_sectors_give_the_simulator_s_ping(host, profile, fov_deg):
    acoustics = getattr(sg.Acoustics, profile)()
    sonar = replace(SONAR, azimuth_fov_deg=fov_deg)
    true = simulate(SCENE, sonar, acoustics)
    with embed.Sensor(sonar, acoustics, SAMPLING) as sensor:
        draw(host, sensor, lobes=acoustics.specular)
        ping = sensor.finish(labels=True, bodies=names(SCENE))
    # A host does not tell where its bodies are, within whose visible ranges the longest footprints are kept: those at
    # the outline of the ball have a thousandth of the echo of a fan all round.
    assert difference(ping, true) < (SNAPPING if fov_deg < 360 else 2e-3)
    # likewise, most of them behind the outline of a ball, and bins with two equal echoes
    assert (ping.body_id != true.body_id).mean() < 3e-3
    # a body's echo depends on the samples along its outline, one of which may hit another body
    assert np.allclose(ping.body_echo, true.body_echo, rtol=1e-3, atol=1e-4 * true.body_echo.sum())
    assert ping.meta["bodies"] == names(SCENE)
    assert ping.meta["gl_renderer"] == true.meta["gl_renderer"]
    assert np.array_equal(ping.pose, POSE) and ping.error_estimate is None
    # with specular acoustics the box has a lobe; without it the echo would be too weak
    assert (true.body_echo[3] > 1.05 * simulate(SCENE, sonar, sg.Acoustics.ideal()).body_echo[3]) == (
        profile == "physical"
    )


def test_a_target_to_port_is_received_to_port(sensor):
    """The host looks along y; the image is not mirrored."""
    ball = sg.Body("ball", trimesh.creation.icosphere(3, 0.3), sg.pose(-2, 8, 0), 0.8)
    host, pose = gl_host.Program(sg.Scene([ball])), sg.pose(yaw=math.pi / 2)
    draw(host, sensor, pose)
    ping = sensor.finish()
    beam = ping.intensity.sum(axis=1).argmax()
    assert ping.azimuth_rad[beam] == pytest.approx(math.atan2(2, 8), abs=math.radians(1))
    image = sg.fan_image(ping, height=200)
    assert np.argwhere(image > image.max() - 0.1)[:, 1].mean() < image.shape[1] / 2


def test_sectors_are_drawn_from_the_tilted_head(host):
    sonar, pitched = replace(SONAR, tilt_deg=12.0), sg.pose(pitch=math.radians(12.0))
    with embed.Sensor(sonar, sampling=SAMPLING) as sensor, embed.Sensor(SONAR, sampling=SAMPLING) as level:
        for one, other in zip(sensor.sectors(POSE), level.sectors(POSE @ pitched), strict=True):
            assert np.array_equal(one.view, other.view) and np.array_equal(one.projection, other.projection)
            # of the sonar, whose pose the host knows
            assert np.allclose(one.rotation, pitched[:3, :3] @ other.rotation, rtol=0, atol=1e-15)
        draw(host, sensor)
        ping = sensor.finish()
    assert np.array_equal(ping.pose, POSE)
    assert difference(ping, simulate(SCENE, sonar)) < ROUNDING


def test_noise_and_motion_act_as_in_the_simulator(host):
    """But for lobes, which the host draws as one with the diffuse echo: speckle does not spare them."""
    acoustics = sg.Acoustics.physical(specular=False)
    with (
        sg.Simulator(SCENE, SONAR, acoustics, SAMPLING) as simulator,
        embed.Sensor(SONAR, acoustics, SAMPLING) as sensor,
    ):
        more = {"noise": sg.Noise.physical(), "seed": 3, "ping_number": 7}
        velocity = (1.0, 0.5, 0, 0, 0, 0.3)
        true = simulator.ping(POSE, **more, velocity=velocity)
        draw(host, sensor, lobes=False)
        ping = sensor.finish(**more, velocity=velocity)
        draw(host, sensor, lobes=False)
        again = sensor.finish(**more, velocity=velocity)
    # speckle scales the difference; receiver noise follows the echo
    assert difference(ping, true) < 3 * ROUNDING
    assert np.array_equal(ping.intensity, again.intensity)


def test_the_host_may_change_bindings_while_it_draws(host, sensor):
    """A host that draws a shadow map returns to our framebuffer, but leaves other pixel stores and buffers."""
    true = true_ping()
    for sector in sensor.sectors(POSE):
        with sector:
            ours = GL.glGetIntegerv(GL.GL_DRAW_FRAMEBUFFER_BINDING)
            host.textures(sector.view, sector.projection, 64, 64)
            GL.glBindFramebuffer(GL.GL_FRAMEBUFFER, ours)
            GL.glViewport(0, 0, sector.width, sector.height)
            host.draw("sonar", sector.view, sector.projection, sector.lattice, lobes=True)
            GL.glPixelStorei(GL.GL_PACK_ROW_LENGTH, 7)
            buffer = GL.glGenBuffers(1)
            GL.glBindBuffer(GL.GL_PIXEL_PACK_BUFFER, buffer)
            GL.glBindFramebuffer(GL.GL_FRAMEBUFFER, 0)
    ping = sensor.finish()
    assert difference(ping, true) < ROUNDING
    assert (
        GL.glGetIntegerv(GL.GL_PACK_ROW_LENGTH) == 0
        and GL.glGetIntegerv(GL.GL_PIXEL_PACK_BUFFER_BINDING) == 0
    )


def test_without_a_sampling_the_tolerance_sets_the_samples(host):
    errors, samples = [], []
    fine = simulate(SCENE, sampling=sg.Sampling(16, 400))
    for tolerance in (0.1, 0.02):
        with embed.Sensor(SONAR, tolerance=tolerance) as sensor:
            draw(host, sensor)
            ping = sensor.finish()
        errors.append(difference(ping, fine))
        samples.append(ping.meta["sampling"]["columns_per_beam"] * ping.meta["sampling"]["rows"])
        assert ping.meta["tolerance"] == tolerance
    assert samples[0] < samples[1] and errors[1] < errors[0]
    assert errors[0] < 0.1 and errors[1] < 0.02


def texture_pings(host, sensor, views, holds="planar", normals=True, **more):
    """Return the ping of a host's textures; `views` holds (view, projection, width, height, rotation) of each."""
    drawn = [host.textures(*view[:4]) for view in views]
    return sensor.ping_from_textures(
        [one["z-buffer" if holds == "z-buffer" else "metres"] for one in drawn],
        [view[1] for view in views],
        POSE,
        holds,
        rotation=[view[4] for view in views],
        normals=[one["normals"] for one in drawn] if normals else None,
        body_id=[one["numbers"] for one in drawn],
        **more,
    )


def mu_of(scene):
    return {number: body.reflectivity for number, body in enumerate(scene.bodies, 1)}


def view_of(camera):
    return (
        np.linalg.inv(camera.pose_gl(POSE)),
        camera.projection(0.1, 200.0),
        camera.width,
        camera.height,
        camera.rotation,
    )


@pytest.mark.parametrize(
    ("holds", "limit"),
    # metres are exact to float32, a z-buffer with its near plane at 0.3 m to half a millimetre at 20 m; the host's
    # normals are float32 differences
    [("planar", 1e-3), ("z-buffer", 2e-3)],
)
def test_textures_of_the_sectors_give_the_simulator_s_ping(sensor, holds, limit):
    scene = sg.Scene([sg.Body(b.name, b.mesh, b.pose, b.reflectivity) for b in PLAIN.bodies])
    host, true = gl_host.Program(scene), simulate(scene)
    sectors = sensor.sectors(POSE, near_m=0.3)
    views = [(s.view, s.projection, s.width, s.height, s.rotation) for s in sectors]
    ping = texture_pings(
        host, sensor, views, holds, labels=True, reflectivity=mu_of(scene), bodies=names(scene)
    )
    assert difference(ping, true) < limit
    assert (ping.body_id != true.body_id).mean() < 2e-3
    assert np.allclose(ping.body_echo, true.body_echo, rtol=5e-3, atol=2e-4 * true.body_echo.sum())


@pytest.mark.slow
@pytest.mark.parametrize("normals", [pytest.param(True, marks=pytest.mark.slow), False])
@pytest.mark.parametrize("aside_rad", [pytest.param(0.0, marks=pytest.mark.slow), 0.2])
def test_textures_of_other_projections_give_nearly_the_same_ping(normals, aside_rad):
    host, true = gl_host.Program(PLAIN), simulate(PLAIN, sampling=sg.Sampling(16, 400))
    ahead = sg.Camera.of_fov(4, 4, fov_x_rad=1.0).rotation
    camera = sg.Camera.of_fov(
        1000, 400, fov_x_rad=1.6, rotation=sg.pose(yaw=aside_rad, roll=0.1)[:3, :3] @ ahead
    )
    with embed.Sensor(SONAR) as sensor:
        ping = texture_pings(host, sensor, [view_of(camera)], normals=normals, reflectivity=mu_of(PLAIN))
    # pixels of 0.1 degrees; docs/embedding.md charts the error over the resolution
    assert difference(ping, true) < (0.015 if normals else 0.03)


def reversed_projection(near_m, infinite):
    """Return a projection over 90 by 40 degrees with a z-buffer, zero to one, of 1 at near_m and 0 far away."""
    out = np.zeros((4, 4))
    out[0, 0], out[1, 1], out[3, 2] = 1.0, 1 / math.tan(math.radians(20)), -1.0
    far_m = 100.0
    out[2, 2:] = (0.0, near_m) if infinite else (near_m / (far_m - near_m), near_m * far_m / (far_m - near_m))
    return out


@pytest.mark.parametrize("infinite", [True, False])
def test_a_reversed_z_buffer(sensor, infinite, context):
    """Game engines use z-buffers of zero to one in which nearer surfaces have larger values."""
    host, width, height = gl_host.Program(PLAIN), 800, 300
    projection = reversed_projection(0.1, infinite)
    camera = sg.Camera.of_projection(projection, width, height)
    view = np.linalg.inv(camera.pose_gl(POSE))
    drawn = host.textures(view, projection, width, height)  # all textures except the z-buffer
    gl_host.clip_zero_to_one(context)
    GL.glDepthFunc(GL.GL_GREATER)
    GL.glBindFramebuffer(GL.GL_FRAMEBUFFER, host.framebuffers[width, height][0])
    GL.glClearBufferfv(GL.GL_DEPTH, 0, np.zeros(1, np.float32))
    GL.glClearBufferfv(GL.GL_COLOR, 2, np.zeros(4, np.float32))
    host.draw("deferred", view, projection)
    more = {"pose": POSE, "normals": drawn["normals"]}
    ping = sensor.ping_from_textures(drawn["z-buffer"], projection, zero_to_one=True, **more)
    metres = sensor.ping_from_textures(drawn["metres"], projection, holds="planar", **more)
    advice = "projection must be the one that the z-buffer was drawn with, and zero_to_one be True"
    with pytest.warns(UserWarning, match=f"no echo came back: .*; {advice}") as caught:
        sensor.ping_from_textures(drawn["z-buffer"], projection, zero_to_one=False, **more)
    assert "metres ahead" not in str(caught[-1].message)
    ordinary = camera.projection(0.1, 100.0)  # not reversed: all seems to be at the near plane
    with pytest.warns(UserWarning, match=f"no echo came back: the nearest surface .*; {advice}"):
        sensor.ping_from_textures(drawn["z-buffer"], ordinary, **more)
    with pytest.raises(sg.Error, match=r"^projection must have x to the right and y up, .* without the flip"):
        sensor.ping_from_textures(drawn["z-buffer"], np.diag([1, -1, 1, 1]) @ projection, **more)
    assert difference(ping, metres) < 1e-4  # a reversed float z-buffer is as exact as metres


def test_depth_textures_are_converted_to_range():
    """At 25 degrees the range of a wall is 1.1 times its depth."""
    wall = sg.Body("wall", trimesh.creation.box((0.1, 40, 4)), sg.pose(8.05, 0, 0), 1.0)
    host = gl_host.Program(sg.Scene([wall]))
    camera = sg.Camera.of_fov(800, 400, fov_x_rad=1.4)
    view = (np.linalg.inv(camera.pose_gl(np.eye(4))), camera.projection(0.1, 100.0), 800, 400)
    drawn = host.textures(*view)
    sonar = sg.Sonar("flat", 900e3, 64, 400, 60.0, 1.0, 1.0, 0.5, 20.0)
    with embed.Sensor(sonar, sg.Acoustics.ideal()) as sensor:
        pings = [
            sensor.ping_from_textures(drawn[name], view[1], holds=holds)
            for name, holds in (("z-buffer", "z-buffer"), ("metres", "planar"), ("metres", "range"))
        ]
    true_m = 8 / np.cos(sonar.azimuth_rad)
    found = [sonar.range_m[ping.intensity.argmax(axis=1)] for ping in pings]
    # at the edge of the fan a beam of one degree covers two bins
    for range_m in found[:2]:
        assert np.abs(range_m - true_m).max() < 2 * sonar.bin_size_m
    assert np.abs(found[2] - true_m).max() > 20 * sonar.bin_size_m  # depth taken for range


def test_invalid_textures_raise_errors():
    host = gl_host.Program(PLAIN)
    camera = sg.Camera.of_fov(64, 32, fov_x_rad=1.4)
    projection = camera.projection(0.1, 100)
    drawn = host.textures(np.linalg.inv(camera.pose_gl(POSE)), projection, 64, 32)
    cube, layers, empty = (gl_host.new_texture() for _ in range(3))
    GL.glBindTexture(GL.GL_TEXTURE_CUBE_MAP, cube)
    GL.glBindTexture(GL.GL_TEXTURE_2D_ARRAY, layers)
    GL.glBindTexture(GL.GL_TEXTURE_2D, empty)
    z_buffer, bytes_ = drawn["z-buffer"], gl_host.new_texture()
    GL.glBindTexture(GL.GL_TEXTURE_2D, bytes_)
    pixels = np.zeros((32, 64, 4), np.uint8)
    GL.glTexImage2D(GL.GL_TEXTURE_2D, 0, GL.GL_RGBA8, 64, 32, 0, GL.GL_RGBA, GL.GL_UNSIGNED_BYTE, pixels)
    GL.glBindTexture(GL.GL_TEXTURE_2D, empty)
    with embed.Sensor(SONAR) as sensor:
        for wrong, message in (
            ({"depth": 9999}, "depth must be the GL name of a texture in the host's context .got 9999"),
            ({"depth": "z"}, "depth must be the GL name of a texture .* .got 'z'"),
            ({"depth": None}, "depth must be the GL name of a texture .* .got None"),
            ({"depth": np.eye(2)}, "depth must be the GL name of a texture .* .got ndarray"),
            ({"depth": SimpleNamespace(glo=3)}, "got SimpleNamespace; give its .glo"),
            ({"depth": cube}, "depth must be a plain 2D texture"),
            ({"depth": layers}, "depth must be a plain 2D texture"),
            ({"depth": empty}, "depth must hold a z-buffer .got texture [0-9]+ with no size there"),
            ({"depth": drawn["metres"]}, "hold a z-buffer .got texture [0-9]+ with nothing of the kind"),
            ({"holds": "planar"}, "depth must hold metres, as floats in red .got .* nothing of the kind"),
            ({"holds": "planar", "depth": bytes_}, "metres, as floats in red .got .* unsigned fractions"),
            ({"holds": "depth"}, "holds must be one of 'z-buffer', 'planar', 'range' .got 'depth'"),
            ({"normals": z_buffer}, "normals must hold x y z of normals, signed"),
            ({"normals": bytes_}, r"signed .got .* unsigned fractions there; decode n \* 2 - 1 into floats"),
            ({"normals": drawn["metres"]}, "normals must hold x y z .* nothing of the kind"),
            ({"body_id": drawn["metres"]}, "body_id must hold whole numbers in red .got .* floats"),
            ({"projection": np.eye(4)}, "projection must be an OpenGL perspective"),
            ({"depth": [z_buffer], "projection": [projection] * 2}, "projection must be .*, 1 .got 2"),
            ({"depth": [z_buffer]}, "projection must be a list of as many as depth has, 1 .got ndarray"),
            ({"depth": [], "projection": []}, "a list of at least one .got an empty list"),
        ):
            arguments = {"depth": z_buffer, "projection": projection, "pose": POSE} | wrong
            with pytest.raises(sg.Error, match=message):
                sensor.ping_from_textures(**arguments)
            assert not GL.glGetError()
    assert GL.glGetIntegerv(GL.GL_TEXTURE_BINDING_2D) == empty


def test_a_ping_needs_all_sectors_drawn(host):
    sonar = replace(SONAR, azimuth_fov_deg=130.0)
    with embed.Sensor(sonar, sampling=SAMPLING) as sensor:
        with pytest.raises(sg.Error, match=r"sectors must be drawn before a ping is finished \(got none"):
            sensor.finish()
        first, *_ = sensor.sectors(POSE)
        with first:
            host.draw("sonar", first.view, first.projection, first.lattice)
        with pytest.raises(sg.Error, match=r"got 1 of 3; draw each"):
            sensor.finish()
        draw(host, sensor)
        sensor.finish()
        sensor.sectors(POSE)  # the next ping: the sectors of the last one do not count
        with pytest.raises(sg.Error, match=r"got 0 of 3; draw each"):
            sensor.finish()


def test_an_exception_inside_a_sector_restores_the_host_s_state(host, sensor):
    true = true_ping()
    GL.glViewport(1, 2, 3, 4)
    (sector,) = sensor.sectors(POSE)
    with pytest.raises(KeyError, match="the host's"), sector:
        raise KeyError("the host's own")
    assert list(GL.glGetIntegerv(GL.GL_VIEWPORT)) == [1, 2, 3, 4]
    assert GL.glGetIntegerv(GL.GL_DRAW_FRAMEBUFFER_BINDING) == 0
    with pytest.raises(sg.Error, match="got 0 of 1"):
        sensor.finish()
    draw(host, sensor)
    assert difference(sensor.finish(), true) < ROUNDING


def test_invalid_shader_outputs_raise_errors(host, sensor):
    """NaN is refused, since loops over bins would run past their ends."""
    for kind, mu in (("nan", "mu * sqrt(-1.0 - mu)"), ("loud", "255.0 * mu")):
        host.programs[kind] = sonar_program("mu, body", f"{mu}, body")
    (sector,) = sensor.sectors(POSE)
    for kind, lattice, message in (
        ("nan", sector.lattice, r"the reflectivity that the host writes must lie in 0\.\.1"),
        ("loud", sector.lattice, r"the reflectivity that the host writes must lie in 0\.\.1"),
        ("sonar", np.zeros((3, 3)), "must be finite .* set the uniform sonar_gl_lattice"),
    ):
        with pytest.raises(sg.Error, match=message), sector:
            host.draw(kind, sector.view, sector.projection, lattice)
        with pytest.raises(sg.Error, match="got 0 of 1"):
            sensor.finish()


def sonar_program(old, new):
    """Return a program that draws sectors with a part of its shader replaced."""
    assert old in gl_host.SONAR
    text = "#version 330 core\n" + embed.glsl() + gl_host.SONAR.replace(old, new)
    return gl_host.make_program(gl_host.VERTEX, text)


@pytest.mark.parametrize("exponent", [-100, 66])
def test_the_length_of_a_host_s_normals_changes_nothing(host, sensor, exponent):
    """Powers of two round nothing. Those of a world in millimetres, 1e-3 long, were taken for those of flat faces."""
    pings = []
    for factor in (1.0, 2.0**exponent, 0.0):
        host.programs["sonar"] = sonar_program("view_normal, mu", f"view_normal * {factor!r}, mu")
        draw(host, sensor)
        pings.append(sensor.finish())
    unit, scaled, flat = pings
    assert np.array_equal(scaled.intensity, unit.intensity)
    assert difference(flat, unit) > 5e-4


@pytest.mark.parametrize("unit_m", [0.01, 0.001])
def test_a_host_s_world_of_other_units_gives_the_same_ping(sensor, unit_m):
    """Its view is scaled, and with it the normals, which are as short as the unit."""
    pings = []
    larger = sg.Scene(
        [
            replace(
                body,
                mesh=body.mesh.copy().apply_scale(1 / unit_m),
                pose=np.block([[body.pose[:3, :3], body.pose[:3, 3:] / unit_m], [0, 0, 0, 1]]),
            )
            for body in SCENE.bodies
        ]
    )
    for world, unit in ((SCENE, 1.0), (larger, unit_m)):
        host = gl_host.Program(world)
        for sector in sensor.sectors(POSE):
            view = sector.view @ np.diag([unit, unit, unit, 1.0])
            with sector:
                host.draw("sonar", view, sector.projection, sector.lattice, lobes=True)
        pings.append(sensor.finish())
    assert difference(pings[1], pings[0]) < ROUNDING


@pytest.mark.parametrize(
    "normal",
    # NaN, also in one component alone, and both infinities, none of which a compiler knows
    [
        "vec3(sqrt(-1.0 - mu))",
        "vec3(0.0, sqrt(-1.0 - mu), 1.0)",
        "vec3(0.0, 0.0, exp2(200.0 + mu))",
        "vec3(1.0, -exp2(200.0 + mu), 0.0)",
    ],
)
def test_normals_that_are_not_finite_raise_an_error(host, sensor, normal):
    """The echo of the body was lost: drivers clamp NaN to 0."""
    host.programs["sonar"] = sonar_program("view_normal, mu", f"body == 2u ? {normal} : view_normal, mu")
    message = r"^the normals that the host writes must be finite \(got NaN or infinity; .*check the normals"
    (sector,) = sensor.sectors(POSE)
    with pytest.raises(sg.Error, match=message), sector:
        host.draw("sonar", sector.view, sector.projection, sector.lattice)
    with pytest.raises(sg.Error, match="got 0 of 1"):
        sensor.finish()


@pytest.mark.parametrize(
    "lobe, is_right",
    [
        ("0.0, 7.0", True),  # none, whatever its slope
        (f"0.5, {np.float32(ROUGHNESS_BOUNDS_RAD[0])!s}", True),
        (f"0.5, {np.float32(ROUGHNESS_BOUNDS_RAD[1])!s}", True),
        (f"0.5, {np.nextafter(np.float32(ROUGHNESS_BOUNDS_RAD[0]), np.float32(0))!s}", False),
        (f"0.5, {np.nextafter(np.float32(ROUGHNESS_BOUNDS_RAD[1]), np.float32(1))!s}", False),
        ("1.0000001, 0.1", False),
        ("-0.5, 0.1", False),
        ("0.5, sqrt(-1.0 - mu)", False),
        ("0.5, exp2(200.0 + mu)", False),
    ],
)
def test_a_lobe_outside_the_bounds_of_bodies_raises_an_error(host, sensor, lobe, is_right):
    """An |R|² of 50 was accepted, -0.5 was none, and of a slope of 0 the message blamed the reflectivity."""
    host.programs["sonar"] = sonar_program("body, lobe", f"body, body == 2u ? vec2({lobe}) : lobe")
    message = r"^a lobe .* \|R\|² in 0\.\.1 and .* slope in 0\.01\.\.0\.5 \(got another"
    (sector,) = sensor.sectors(POSE)
    expected = contextlib.nullcontext() if is_right else pytest.raises(sg.Error, match=message)
    with expected, sector:
        host.draw("sonar", sector.view, sector.projection, sector.lattice, lobes=True)
    if is_right:
        assert sensor.finish().intensity.any()


def test_a_warning_says_why_a_ping_has_no_echo(sensor):
    host = gl_host.Program(sg.Scene([sg.Body("far", trimesh.creation.box((1, 1, 1)), sg.pose(40, 0, 0))]))
    away = sg.pose(yaw=3), "shows no surface in the fan"
    for pose, why in ((np.eye(4), "beyond range_max_m = 20"), away):
        draw(host, sensor, pose)
        with pytest.warns(UserWarning, match=f"no echo came back: .*{why}") as caught:
            assert not sensor.finish().intensity.any()
        assert caught[0].filename == __file__


def test_objects_of_another_context_are_released_later(host, context):
    """Objects of a closed or deleted sensor are released at the next use of any sensor in their context."""
    plain, was = host_state.GL(), egl.current()
    before = host_state.objects(plain)
    closed, forgotten = (embed.Sensor(SONAR, sampling=SAMPLING) for _ in range(2))
    for sensor in (closed, forgotten):
        draw(host, sensor)
    other = gl_host.make_context()
    other_objects = host_state.objects(plain)
    closed.close()
    assert host_state.objects(plain) == other_objects  # the other context is unchanged
    egl.library().eglMakeCurrent(*was)
    other.release()
    egl.library().eglMakeCurrent(*was)
    del forgotten, sensor
    gc.collect()
    assert host_state.objects(plain) != before
    with embed.Sensor(SONAR, sampling=SAMPLING) as last:
        last.sectors(POSE)
    assert host_state.objects(plain) == before


def test_released_sectors_raise_errors():
    plain = host_state.GL()
    before = host_state.objects(plain)
    sensor = embed.Sensor(SONAR, sampling=SAMPLING)
    (old,) = sensor.sectors(POSE)
    (new,) = sensor.sectors(POSE, near_m=0.2)
    with pytest.raises(sg.Error, match="must be one of the last call of Sensor"), old:
        pass
    GL.glViewport(1, 2, 3, 4)
    with pytest.raises(sg.Error, match="must be closed outside of the blocks of its sectors"), new:
        sensor.close()
    assert list(GL.glGetIntegerv(GL.GL_VIEWPORT)) == [1, 2, 3, 4]
    sensor.close()
    with pytest.raises(sg.Error, match="must be one of the last call of Sensor"), new:
        pass
    assert host_state.objects(plain) == before


def test_more_samples_than_the_driver_supports(monkeypatch):
    plain = host_state.GL()
    before, state = host_state.objects(plain), host_state.snapshot(plain)
    fits = pytest.raises(sg.Error, match="samples must fit the driver's limit of ")
    with embed.Sensor(SONAR, sampling=sg.Sampling(1000, 10)) as sensor, fits:
        sensor.sectors(POSE)
    # GL_MAX_TEXTURE_SIZE is as large; with an invalid format no framebuffer can be made
    monkeypatch.setattr("sonar_gl.embed.sectors.MAX_RENDERBUFFER_SIZE", 0x0D33)
    monkeypatch.setattr("sonar_gl.embed.framebuffer.R16UI", 0x1234)
    with embed.Sensor(SONAR, sampling=SAMPLING) as sensor:
        (sector,) = sensor.sectors(POSE)
        for _ in range(3):  # every time, and never a read of uninitialized memory
            with (
                pytest.raises(sg.Error, match=r"for which it creates no framebuffer: .*error 0x0500"),
                sector,
            ):
                pass
            assert host_state.snapshot(plain) == state
        with pytest.raises(sg.Error, match="got 0 of 1"):
            sensor.finish()
    assert host_state.objects(plain) == before


def test_sectors_in_another_thread_raise_an_error(host, sensor):
    true = true_ping()
    (sector,) = sensor.sectors(POSE)
    for call in (lambda: sensor.sectors(POSE), sector.__enter__):
        (message,) = in_another_thread(call)
        assert "must be used in the thread" in message and "'other'" in message
    draw(host, sensor)
    assert difference(sensor.finish(), true) < ROUNDING


def test_invalid_arguments_of_a_sensor_raise_errors():
    for wrong, message in (
        ({"acoustics": sg.Acoustics(multipath="incoherent")}, 'must have multipath "none"'),
        ({"tolerance": 2}, "tolerance must be a number in 0.001..0.5"),
        ({"sampling": 3}, "sampling must be a Sampling"),
    ):
        with pytest.raises(sg.Error, match=message):
            embed.Sensor(SONAR, **wrong)
    with embed.Sensor(SONAR, sg.Acoustics.physical(elevation_pattern="box"), SAMPLING) as sensor:
        # the depth of half a metre of range in the corner of 30 by 10 degrees
        for near_m in (0, -1, 1e6, 0.5, "near", True):
            with pytest.raises(sg.Error, match=r"near_m must be metres above 0 and no more than 0\.4"):
                sensor.sectors(POSE, near_m)
        with pytest.raises(sg.Error, match="pose must"):
            sensor.sectors(np.eye(3))


def test_a_missing_context_raises_an_error():
    library = egl.library()
    was = egl.current()
    library.eglMakeCurrent(was[0], None, None, None)
    try:
        with embed.Sensor(SONAR, sampling=SAMPLING) as sensor, warnings.catch_warnings():
            warnings.simplefilter("error")
            with pytest.raises(sg.Error, match="an OpenGL context must be current in this thread"):
                sensor.sectors(POSE)
        with pytest.raises(sg.Error, match="an OpenGL context must be current in this thread"):
            sg.Simulator(SCENE, SONAR, context="current")
    finally:
        library.eglMakeCurrent(*was)


@pytest.mark.parametrize("error", ["INVALID_ENUM", "INVALID_OPERATION"])
def test_an_opengl_error_of_the_host_stays_pending(host, sensor, error):
    """The error is still pending after the block."""
    plain = host_state.GL()
    (sector,) = sensor.sectors(POSE)
    with sector:
        host.draw("sonar", sector.view, sector.projection, sector.lattice)
        plain.make_error(error)
    assert plain.errors() == [error]
    sensor.finish()
    with pytest.raises(KeyError), sector:
        plain.make_error(error)
        raise KeyError
    assert plain.errors() == [error]


def test_a_host_that_changes_the_context_while_it_draws(host, sensor, context):
    """If another context is current at the end of a block, it stays unchanged; the sonar goes on with the first."""
    true = true_ping()
    (sector,) = sensor.sectors(POSE)
    other = None
    was = egl.current()
    with pytest.raises(sg.Error, match="must be current when its sonar is used"), sector:
        other = gl_host.make_context()
        GL.glViewport(5, 6, 7, 8)
    assert list(GL.glGetIntegerv(GL.GL_VIEWPORT)) == [5, 6, 7, 8]
    egl.library().eglMakeCurrent(*was)
    draw(host, sensor)
    assert difference(sensor.finish(), true) < ROUNDING
    other.release()
    egl.library().eglMakeCurrent(*was)


def leave_by_exception(host, sensor):
    with contextlib.suppress(KeyError):
        for sector in sensor.sectors(POSE):
            with sector:
                raise KeyError


def leave_undrawn(host, sensor):
    first, *_ = sensor.sectors(POSE)
    with first:
        pass


def leave_other_projections(host, sensor):
    draw(host, sensor)
    sensor.sectors(POSE, near_m=0.2)


@pytest.mark.parametrize("use", [draw, leave_by_exception, leave_undrawn, leave_other_projections])
def test_a_closed_sensor_leaves_no_objects(host, use):
    plain = host_state.GL()
    sonar = replace(SONAR, azimuth_fov_deg=130.0)
    before = host_state.objects(plain)
    sensor = embed.Sensor(sonar, sampling=SAMPLING)
    use(host, sensor)
    assert host_state.objects(plain) != before
    sensor.close()
    sensor.close()
    assert host_state.objects(plain) == before
    texture = partial(sensor.ping_from_textures, 1, np.eye(4))
    for call in (lambda: sensor.sectors(POSE), texture, sensor.finish):
        with pytest.raises(sg.Error, match="this Sensor is closed; make a new one"):
            call()


def test_a_closed_sensor_outlives_the_modules_that_it_uses(monkeypatch):
    """As Python ends; a host that keeps it, as Panda3D may, showed an exception that nobody can catch."""
    sensor = embed.Sensor(SONAR, sampling=SAMPLING)
    sensor.close()
    monkeypatch.setattr(os, "getpid", None)
    sensor.__del__()


def test_a_sensor_must_be_closed_in_its_own_thread(host):
    plain = host_state.GL()
    before = host_state.objects(plain)
    sensor = embed.Sensor(SONAR, sampling=SAMPLING)
    draw(host, sensor)
    (message,) = in_another_thread(sensor.close)
    assert "must be used in the thread" in message
    sensor.close()
    assert host_state.objects(plain) == before


def test_a_host_that_ends_before_the_sensor():
    """Its objects end with it; a later context, even at the same address, keeps its own objects."""
    context = gl_host.make_context()
    host = gl_host.Program(SCENE)
    sensor = embed.Sensor(SONAR, sampling=SAMPLING)
    draw(host, sensor)
    context.release()
    later = gl_host.make_context()
    buffers = GL.glGenFramebuffers(9)
    for name in buffers:
        GL.glBindFramebuffer(GL.GL_FRAMEBUFFER, name)
    with pytest.raises(sg.Error, match=r"host's OpenGL context must be current|must still be there"):
        sensor.sectors(POSE)
    sensor.close()
    assert all(GL.glIsFramebuffer(name) for name in buffers)
    later.release()


@pytest.mark.slow
def test_many_pings_do_not_leak():
    """1000 pings of host-drawn sectors and of textures leave no GL objects and no memory."""
    host, plain = gl_host.Program(PLAIN), host_state.GL()
    camera = sg.Camera.of_fov(200, 90, fov_x_rad=1.0)
    view, projection, width, height, _ = view_of(camera)
    drawn = host.textures(view, projection, width, height)
    more = {"normals": drawn["normals"], "body_id": drawn["numbers"]}
    with embed.Sensor(soak.SONAR, sampling=sg.Sampling(1, 24)) as sensor:

        def run(n):
            for k in range(n):
                draw(host, sensor, soak.pose_of(k % 50))
                sensor.finish(labels=k % 50 == 0)
                sensor.ping_from_textures(drawn["z-buffer"], projection, **more)

        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # warnings of empty pings and of the uncovered part of the fan
            run(400)  # pings 100 to 400 add some 400 blocks, later ones 100 and fewer: caches, no leak
            objects, resident, used = host_state.objects(plain), soak.settled_bytes(), soak.allocated()
            run(1000)
        soak.check_growth(used, resident, 1000)
        assert host_state.objects(plain) == objects


def test_too_large_body_numbers_raise_an_error(host, sensor):
    host.programs["sonar"] = sonar_program("body, lobe", "body + 70000u, lobe")
    draw(host, sensor)
    assert sensor.finish().intensity.any()
    with pytest.raises(sg.Error, match=r"numbers of bodies must lie in 1\.\.65534"):
        sensor.finish(labels=True)


def test_a_host_that_draws_elsewhere_gets_advice(host, sensor):
    """A host that binds its own framebuffer inside the block, and one with a wrong matrix, get advice."""
    (sector,) = sensor.sectors(POSE)
    with sector:
        host.textures(sector.view, sector.projection, 64, 64)
    with pytest.warns(UserWarning, match="no echo .*; another framebuffer was bound as a block ended"):
        sensor.finish()
    (sector,) = sensor.sectors(POSE)
    with sector:
        host.draw("sonar", sector.view, sector.projection.T, sector.lattice)
    with pytest.warns(UserWarning, match="no echo .*; gl_Position must be projection"):
        sensor.finish()


def test_names_of_a_host_s_shader_do_not_clash_with_ours():
    own = """
    float cos_incidence(vec3 a, vec3 b) { return a.x; }
    vec3 plane_of(float a, vec2 b, vec2 c) { return vec3(a); }
    vec2 specular_lobe; float cos_times_range; float lobe_times_range;
    """
    text = "#version 330 core\n" + embed.glsl() + own + gl_host.SONAR
    assert gl_host.make_program(gl_host.VERTEX, text)


def test_sectors_of_two_poses_are_kept_apart(host, sensor):
    (first,), (second,) = sensor.sectors(POSE), sensor.sectors(np.eye(4))
    for sector in (first, second):
        with sector:
            host.draw("sonar", sector.view, sector.projection, sector.lattice, lobes=True)
    ping = sensor.finish()
    assert difference(ping, simulate(SCENE, pose=np.eye(4))) < SNAPPING
    (third,) = sensor.sectors(POSE)
    with first:  # a sector of an earlier pose
        host.draw("sonar", first.view, first.projection, first.lattice)
    with pytest.raises(sg.Error, match="got 0 of 1"):
        sensor.finish()
    assert np.array_equal(third.view, first.view)


def test_a_texture_with_an_image_of_reflectivity(sensor):
    host, camera = gl_host.Program(PLAIN), sg.Camera.of_fov(300, 130, fov_x_rad=1.2)
    view, projection, width, height, _ = view_of(camera)
    drawn = host.textures(view, projection, width, height)
    names = drawn["z-buffer"], projection, POSE
    one = sensor.ping_from_textures(*names, reflectivity=0.25)
    image = sensor.ping_from_textures(*names, reflectivity=np.full((height, width), 0.25))
    upper = np.where(np.arange(height)[:, None] < height // 2, 0.25, 0.0) * np.ones(width)
    half = sensor.ping_from_textures(*names, reflectivity=upper, labels=True)
    assert np.array_equal(one.intensity, image.intensity)
    has_echo = np.isfinite(half.elevation_rad)
    assert has_echo.any() and half.elevation_rad[has_echo].min() > -math.radians(1.0)  # first row on top


@pytest.mark.parametrize("zero_to_one", [False, True])
@pytest.mark.parametrize("is_reversed", [False, True])
@pytest.mark.parametrize("is_infinite", [False, True])
def test_every_z_buffer_becomes_metres(zero_to_one, is_reversed, is_infinite):
    """`metres_ahead` inverts OpenGL's depth formula; cleared pixels are empty, even with a near far plane."""
    near_m, far_m = 0.5, math.inf if is_infinite else 12.0
    depths = (1.0, 0.0) if is_reversed else (0.0, 1.0)  # at the near and the far plane
    low, high = depths if zero_to_one else (2 * depth - 1 for depth in depths)
    projection = np.zeros((4, 4))
    projection[0, 0], projection[1, 1], projection[3, 2] = 1.2, 1.5, -1.0
    share = 0.0 if is_infinite else near_m / far_m
    # ndc(z) = a + b / z takes the values low and high at the two planes
    b = (low - high) * near_m / (1 - share)
    projection[2, 2:] = -(high - b / far_m), b
    metres = np.array([[0.5, 1.0, 3.0, 11.0]])
    ndc = (projection[2, 3] - projection[2, 2] * metres) / metres
    z_buffer = np.append(ndc if zero_to_one else (ndc + 1) / 2, [[depths[1]]], axis=1)
    found = embed.metres_ahead(z_buffer, projection, zero_to_one)
    np.testing.assert_allclose(found[:, :-1], metres, rtol=2e-6 if is_reversed else 2e-5)  # float32 near 1
    assert found[0, -1] == 0
    oblique = projection.copy()
    oblique[2, 0] = 0.1
    with pytest.raises(sg.Error, match="must have its near plane across the view"):
        embed.metres_ahead(z_buffer, oblique, zero_to_one)


def test_a_host_far_from_the_origin(sensor):
    """At UTM coordinates float32 errs by centimetres, unless the host multiplies the matrices in float64."""
    far = sg.pose(450_000.3, 5_400_000.7, 0)
    moved = sg.Scene([replace(body, pose=far @ body.pose) for body in SCENE.bodies])
    host, true = gl_host.Program(moved), true_ping()
    errors = []
    for in_double in (False, True):
        for sector in sensor.sectors(far @ POSE):
            with sector:
                host.draw("sonar", sector.view, sector.projection, sector.lattice, True, in_double)
        errors.append(difference(sensor.finish(), true))
    assert errors[0] > 0.05
    assert errors[1] < ROUNDING


def test_a_host_that_destroyed_its_current_context(context):
    """A destroyed context stays current until another one is; after a ping none is, and other threads may ping."""
    ended = gl_host.make_context()
    library, was = egl.library(), egl.current()
    library.eglDestroyContext(was[0], was[3])
    with sg.Simulator(SCENE, SONAR, None, SAMPLING) as simulator:
        here = simulator.ping(POSE)
        assert egl.current() is None
        there = []
        assert in_another_thread(lambda: there.append(simulator.ping(POSE))) == []
    assert np.array_equal(here.intensity, there[0].intensity)
    assert ended


def test_a_destroyed_context_cannot_be_joined(context):
    """It is not a driver that lacks something."""
    ended = gl_host.make_context()
    egl.library().eglDestroyContext(egl.current().display, egl.current().context)
    with pytest.raises(sg.Error, match=r"current in this thread, .* \(got one that was destroyed"):
        sg.Simulator(SCENE, SONAR, context="current")
    assert ended


@pytest.fixture(scope="module")
def newest_version():
    """The newest OpenGL that the driver has, (major, minor)."""
    for code in (460, 450, 440, 430, 420, 410, 400):
        with contextlib.suppress(Exception):  # moderngl and glcontext raise plain Exception
            moderngl.create_context(standalone=True, require=code, backend="egl").release()
            return divmod(code // 10, 10)
    return 3, 3


@pytest.mark.parametrize("is_newest", [pytest.param(False, marks=pytest.mark.slow), True])
@pytest.mark.parametrize(
    "more",
    [
        (),
        pytest.param((0x31B2, 1), marks=pytest.mark.slow),  # EGL_CONTEXT_OPENGL_ROBUST_ACCESS
        pytest.param((0x31BD, 0x31BE), marks=pytest.mark.slow),  # its reset notification strategy: none
        pytest.param((0x31BD, 0x31BF), marks=pytest.mark.slow),  # to lose the context
        (0x31B2, 1, 0x31BD, 0x31BF),
        (0x31B3, 1),  # EGL_CONTEXT_OPENGL_NO_ERROR_KHR
    ],
)
def test_contexts_of_any_attributes_can_be_joined(is_newest, more, newest_version):
    """Contexts share objects only where both notify of resets, and where both check for errors."""
    host = EglHost(newest_version if is_newest else (3, 3), more)
    current = host.platform()
    with sg.Simulator(SCENE, SONAR, None, SAMPLING, context="current") as simulator:
        joined = simulator.ping(POSE)
        assert host.platform() == current
    assert host.gl.errors() == []
    host.destroy()
    assert np.array_equal(joined.intensity, true_ping().intensity)


def test_a_context_that_lets_none_join_says_why_and_what_to_do(monkeypatch):
    library = egl.library()
    monkeypatch.setattr(library, "eglCreateContext", lambda *_: None)
    monkeypatch.setattr(library, "eglGetError", lambda: 0x3009)
    message = (
        r"^the driver must make an OpenGL context that shares the host's objects \(got EGL error 0x3009; .* has "
        r"attributes that ours lacks; make it with version and profile alone, or leave out context='current'\)$"
    )
    with pytest.raises(sg.Error, match=message):
        sg.Simulator(SCENE, SONAR, context="current")
