"""The Simulator from scene to ping: results, warnings of empty pings, and errors."""

import copy
import gc
import math
import os
import pickle
import re
import subprocess
import sys
import threading
import time
import warnings
import weakref
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

import sonar_gl as sg
from sonar_gl.cli.compilation import compiled_functions
from sonar_gl.core.warn import collected_warnings
from sonar_gl.engine import run as run_module
from sonar_gl.engine.no_echo import MOST_IN_A_ROW, NoEchoWarning
from sonar_gl.gl import context as gl
from sonar_gl.gl import egl, lifetime
from sonar_gl.gl.functions import Functions
from tests.support.errors import error_of
from tests.support.waiting import wait_until

ROOT = Path(__file__).resolve().parents[2]
BOX = sg.Body("box", trimesh.creation.box((1, 1, 1)), sg.pose(6, 2, 0), 0.8)
SONAR = sg.Sonar("test", 900e3, 64, 200, 60.0, 20.0, 1.5, 0.5, 20.0)
SAMPLING = sg.Sampling(2, 40)


def simulator(bodies=(BOX,), sonar=SONAR, acoustics=None, sampling=SAMPLING, **kw):
    return sg.Simulator(
        sg.Scene(bodies, name="things"), sonar, acoustics or sg.Acoustics.ideal(), sampling, **kw
    )


def arrays(vertices, faces):
    """Return what has the arrays of a mesh, but is no trimesh."""
    return SimpleNamespace(vertices=vertices, faces=faces)


def test_a_target_to_port_is_at_positive_azimuth_and_left_in_the_picture():
    with simulator() as it:
        ping = it.ping(np.eye(4))
    beam, _ = np.unravel_index(ping.intensity.argmax(), ping.intensity.shape)
    assert ping.azimuth_rad[beam] == pytest.approx(math.atan2(2, 6), abs=0.15)
    assert (np.diff(ping.azimuth_rad) > 0).all()
    image = sg.fan_image(ping, height=200)
    row, column = np.unravel_index(image.argmax(), image.shape)
    assert column < image.shape[1] / 2 - 10
    assert row < image.shape[0] * 0.75


def test_the_fields_of_a_ping():
    with simulator(acoustics=sg.Acoustics.physical()) as it:
        ping = it.ping(sg.pose(0.5, 0, 0), labels=True, seed=3)
    assert ping.intensity.dtype == np.float32
    assert ping.intensity.shape == ping.body_id.shape == ping.elevation_rad.shape == (64, 200)
    assert ping.body_id.dtype == np.uint16
    assert ping.elevation_rad.dtype == np.float32
    np.testing.assert_allclose(ping.range_m, np.linspace(0.5, 20, 201)[:-1] + 19.5 / 400)
    np.testing.assert_array_equal(ping.pose, sg.pose(0.5, 0, 0))
    assert ping.meta["sonar"]["n_beams"] == 64
    assert ping.meta["profile"] == "physical"
    assert ping.meta["bodies"] == ["box"]
    assert ping.meta["seed"] == 3
    assert ping.meta["gl_renderer"]
    assert np.isfinite(ping.intensity).all()
    assert (ping.intensity >= 0).all()


def test_the_same_input_gives_the_same_bytes():
    """Results repeat in the same simulator after other pings, and in another simulator."""
    noise = sg.Noise.physical()
    with simulator() as first, simulator(sonar=replace(SONAR, n_bins=50)) as other:
        a = first.ping(np.eye(4), noise, seed=7)
        other.ping(sg.pose(1, 0, 0))
        first.ping(sg.pose(0, 1, 0))
        b = first.ping(np.eye(4), noise, seed=7)
    with simulator() as again:
        c = again.ping(np.eye(4), noise, seed=7)
        d = again.ping(np.eye(4), noise, seed=8)
    np.testing.assert_array_equal(a.intensity, b.intensity)
    np.testing.assert_array_equal(a.intensity, c.intensity)
    assert (a.intensity != d.intensity).any()


def test_a_ping_does_not_overwrite_an_earlier_one():
    with simulator() as it:
        first = it.ping(np.eye(4), labels=True)
        copies = first.intensity.copy(), first.body_id.copy()
        it.ping(sg.pose(2, 0, 0), labels=True)
    np.testing.assert_array_equal(first.intensity, copies[0])
    np.testing.assert_array_equal(first.body_id, copies[1])


def test_simulators_are_independent():
    """Simulators made and closed in any order do not affect the open ones."""
    simulators = [simulator() for _ in range(3)]
    expected = simulators[0].ping(np.eye(4)).intensity
    for _ in range(12):
        simulators.pop(0).close()
        simulators.append(simulator())
        for it in simulators:
            np.testing.assert_array_equal(it.ping(np.eye(4)).intensity, expected)
    for it in simulators:
        it.close()
        it.close()


def test_pings_in_two_threads_at_once():
    poses = [sg.pose(0, y, 0) for y in (-1, 0, 1, 2)]
    with simulator() as it:
        alone = [it.ping(pose).intensity for pose in poses]
        with ThreadPoolExecutor(4) as pool:
            together = [ping.intensity for ping in pool.map(it.ping, poses * 5)]
    for k, intensity in enumerate(together):
        np.testing.assert_array_equal(intensity, alone[k % 4])


def test_collecting_a_simulator_during_a_ping_of_another(monkeypatch):
    """The finalizer of a simulator in a reference cycle runs while another simulator draws."""
    with simulator() as it:
        expected = it.ping(sg.pose(1, 0, 0)).intensity
        it.ping(np.eye(4))
        gc.disable()
        cycle = [simulator()]
        cycle.append(cycle)
        del cycle
        renderer = it.run.sampler.resolution.stage.renderer
        render = renderer.render

        def collecting(*args, **settings):
            gc.collect()
            return render(*args, **settings)

        monkeypatch.setattr(renderer, "render", collecting)
        got = it.ping(sg.pose(1, 0, 0)).intensity
        gc.enable()
    np.testing.assert_array_equal(got, expected)


class HostObject:
    """A GL object of another program, in a reference cycle, whose finaliser does what those of programs do."""

    n_finalised = 0

    def __init__(self, finalise):
        self.itself, self.finalise = self, finalise

    def __del__(self):
        HostObject.n_finalised += 1
        self.finalise()


def delete_names():
    """Delete objects by their names in the host's context, which are ours if our context is current."""
    address_of = egl.library().eglGetProcAddress
    functions, names = Functions(lambda name: address_of(name.encode())), np.arange(1, 200, dtype=np.uint32)
    for delete in (functions.glDeleteFramebuffers, functions.glDeleteRenderbuffers):
        delete(len(names), names.ctypes.data)


@pytest.fixture
def host():
    """Context of another program, current."""
    before, context = egl.current(), gl.create_context()
    yield context
    if before:
        egl.make_current(before)
    else:
        egl.make_current(egl.Binding(context.extra.binding.display))
    lifetime.release(context)


def dropping_in_the_middle(monkeypatch, simulator, drop):
    """Have a simulator call `drop` when it has begun to draw."""
    renderer = simulator.run.sampler.resolution.stage.renderer
    render = renderer.render

    def render_after(*args, **settings):
        drop()
        return render(*args, **settings)

    monkeypatch.setattr(renderer, "render", render_after)


@pytest.mark.parametrize("does", ["make_current", "delete_names"])
def test_a_host_s_objects_are_not_finalised_in_the_middle_of_a_ping(does, host, monkeypatch, opengl_engine):
    """Such a finaliser makes another context current, or deletes objects by names that are ours, too."""
    theirs = egl.current()
    finalise = {"make_current": lambda: egl.make_current(theirs), "delete_names": delete_names}[does]
    with simulator() as it:
        expected = [it.ping(sg.pose(x, 0, 0)).intensity for x in (0, 1)]
        dropping_in_the_middle(monkeypatch, it, lambda: HostObject(finalise))
        threshold, before = gc.get_threshold(), HostObject.n_finalised
        gc.set_threshold(1, 1, 1)
        try:
            got = [it.ping(sg.pose(x, 0, 0)).intensity for x in (0, 1)]
            several = [ping.intensity for ping in it.pings([sg.pose(x, 0, 0) for x in (0, 1, 0, 1, 0, 1)])]
        finally:
            gc.set_threshold(*threshold)
        assert gc.isenabled()
        gc.collect()
        assert HostObject.n_finalised - before >= 3  # two pings, and a batch or more
        assert egl.current() == theirs
        np.testing.assert_array_equal(got, expected)
        np.testing.assert_array_equal(several, expected * 3)


def test_another_context_made_current_in_the_middle_of_a_ping_raises_an_error(
    host, monkeypatch, opengl_engine
):
    """What the collector cannot help: a signal handler, or a call of gc.collect() in one."""
    theirs = egl.current()
    with simulator() as it:
        expected = it.ping(np.eye(4)).intensity
        with monkeypatch.context() as patch:
            dropping_in_the_middle(patch, it, lambda: egl.make_current(theirs))
            with pytest.raises(
                sg.Error, match="must stay current while it draws \\(got another one; a signal"
            ):
                it.ping(np.eye(4))
        with monkeypatch.context() as patch:
            dropping_in_the_middle(patch, it, lambda: egl.make_current(egl.Binding(theirs.display)))
            with pytest.raises(sg.Error, match="must stay current while it draws \\(got none; a signal"):
                it.ping(np.eye(4))
        np.testing.assert_array_equal(it.ping(np.eye(4)).intensity, expected)
        assert egl.current() == theirs


def test_bins_sum_and_do_not_average():
    """The echo of two plates in one bin is the sum of their echoes."""
    plate = trimesh.creation.box((0.01, 1, 0.2))
    up, down = (sg.Body(name, plate, sg.pose(8, 0, z)) for name, z in (("up", 0.5), ("down", -0.5)))
    sums = []
    for bodies in ((up,), (down,), (up, down)):
        with simulator(bodies) as it:
            sums.append(it.ping(np.eye(4)).intensity)
    # whether rows of a strip are joined depends on all that it meets, which moves some of the echo at edges of bins
    total = sums[0] + sums[1]
    np.testing.assert_allclose(sums[2].sum(), total.sum(), rtol=1e-4)
    assert np.abs(sums[2] - total).sum() < 3e-3 * total.sum()


def test_gain_is_applied_per_bin():
    acoustics = sg.Acoustics.physical(tvg_k=40.0, beam_pattern="box", elevation_pattern="box", pulse=False)
    with simulator() as it:
        ideal = it.ping(np.eye(4))
    with simulator(acoustics=acoustics) as it:
        physical = it.ping(np.eye(4))
    gain = acoustics.range_gain(ideal.range_m, SONAR)
    np.testing.assert_allclose(physical.intensity, ideal.intensity * gain, rtol=1e-5)
    assert gain[-1] / gain[0] > 100


def test_one_beam_one_bin_and_many():
    for sonar in (
        replace(SONAR, n_beams=1, n_bins=1, beam_width_deg=60.0),
        replace(SONAR, n_beams=1, n_bins=8192),
        replace(SONAR, n_beams=1001, n_bins=7, beam_width_deg=0.06),
    ):
        with simulator(sonar=sonar, sampling=None, tolerance=0.05) as it:
            ping = it.ping(sg.pose(0, 2, 0))
        assert ping.intensity.shape == (sonar.n_beams, sonar.n_bins)
        assert ping.intensity.any()


def test_point_cloud_lies_on_the_bodies():
    with simulator() as it:
        points, echo = it.point_cloud(sg.pose(0, 0, 0.1, 0, 0, 0.2), columns=120, rows=40)
    assert points.shape == (*echo.shape, 3)
    hit = np.isfinite(points[..., 0])
    assert (hit == (echo > 0)).all()
    world = points[hit].astype(float) @ sg.pose(0, 0, 0, 0, 0, 0.2)[:3, :3].T + [0, 0, 0.1]
    outside = np.abs(world - [6, 2, 0]).max(axis=1) - 0.5
    np.testing.assert_allclose(outside, 0, atol=1e-4)
    azimuth = np.arctan2(points[..., 1], points[..., 0])[hit]
    assert np.abs(azimuth).max() <= math.radians(30) + 1e-6


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("name", ["ping360", "gemini-720is", "oculus-m1200d-hf"])
def test_a_point_cloud_has_the_columns_that_are_asked_for(name):
    """Of one sector or two; also so many in a narrow fan that beams would be warned of."""
    sonar = sg.load_sonar(name)
    with simulator(sonar=sonar) as it:
        points, _ = it.point_cloud(np.eye(4), columns=128, rows=8)
        with pytest.raises(
            sg.Error, match=r"^columns of a point cloud must be a whole number in 1..65536 .got 2.5"
        ):
            it.point_cloud(np.eye(4), 2.5, 8)
    assert points.shape[1] == 128


def test_a_point_cloud_takes_specular_lobes_as_diffuse():
    """A wall returns |R|² cos θ, whatever part of it is specular."""
    wall = trimesh.creation.box((0.2, 40, 40))
    x, y, _ = wall.triangles_center.T
    # two triangles make the side that is seen; the others bring the mean to 0.2
    by_face = np.select([x > -0.09, y > 0], [0.2, 0.3], 0.1)
    for given, expected in (
        ({"reflectivity": 0.5}, {0.5}),
        ({"reflectivity": 0.5, "specular": 0.25}, {0.75}),
        ({"reflectivity": 0.0, "specular": 0.25}, {0.25}),
        ({"reflectivity": 0.5, "specular": 0.75}, {1.0}),
        ({"reflectivity": by_face, "specular": 0.2}, {0.2, 0.6}),
    ):
        scene = sg.Scene([sg.Body("wall", wall, sg.pose(6.1, 0, 0), **given)])
        with sg.Simulator(scene, SONAR) as it:
            points, echo = it.point_cloud(np.eye(4), columns=41, rows=11)
        cos = points[..., 0] / np.linalg.norm(points, axis=-1)
        hit = np.isfinite(cos)  # others are beyond the field of view
        # float32: 1/x of the depth + normal pass, and μ
        assert set(np.round((echo / cos)[hit], 5).astype(float).round(5).tolist()) == expected


def test_demarco_image_has_forward_up_and_port_left():
    with simulator(sonar=replace(SONAR, range_max_m=10.0)) as it:
        picture = sg.demarco_image(it, np.eye(4), seed=1, noise=sg.Noise(cloud_gaussian_m=0.01, median=0))
        same = sg.demarco_image(it, np.eye(4), seed=1, noise=sg.Noise(cloud_gaussian_m=0.01, median=0))
    np.testing.assert_array_equal(picture, same)
    assert picture.dtype == np.uint8
    assert picture.shape == (600, 600, 3)
    # zero is a blue of 128 in the colour map jet; the echo is brighter
    echo = np.argwhere((picture[..., 2] > 150) | (picture[..., 1] > 0))
    assert (echo[:, 1] < 300).all()
    # the near face of the box is 5.5 m ahead of the sonar at the bottom, at 60 pixels per metre
    assert abs(echo[:, 0].max() - (600 - 5.5 * 60)) < 4


def test_a_table_of_beams():
    table = (-25.0, -3.0, 0.0, 17.0, 18.0, 19.0, 28.0)
    sonar = replace(SONAR, n_beams=7, beam_azimuths_deg=table)
    with simulator(sonar=sonar, sampling=sg.Sampling(40, 200)) as it:
        ping = it.ping(np.eye(4))
    np.testing.assert_allclose(np.degrees(ping.azimuth_rad), table)
    # the box spans azimuths 13 to 25 degrees
    assert (ping.intensity.sum(axis=1) > 0).tolist() == [False, False, False, True, True, True, False]
    even = replace(SONAR, n_beams=1, azimuth_fov_deg=36.0)  # one beam, 1.5 degrees wide, at 0
    turned = sg.pose(0, 0, 0, 0, 0, math.radians(18.0))
    with simulator(sonar=even, sampling=sg.Sampling(60, 200)) as it:
        alone = it.ping(turned).intensity[0]
    np.testing.assert_allclose(ping.intensity[4].sum(), alone.sum(), rtol=0.02)


def test_of_pings_without_echo_in_a_row_the_first_are_explained(monkeypatch):
    """To explain takes longer than a ping, and each text was new: a vehicle in open water met thousands of warnings."""
    n_explained, why = [], run_module.why_no_echo
    monkeypatch.setattr(run_module, "why_no_echo", lambda *args: n_explained.append(1) or why(*args))
    away, there = [sg.pose(-30 - k, 2, 0) for k in range(MOST_IN_A_ROW + 3)], [sg.pose(0, 2, 0)]
    poses = away + there + away[:2]
    with simulator(bodies=(BOX,)) as it, collected_warnings(NoEchoWarning) as found:
        pings = [it.ping(pose) for pose in poses]
    assert [ping.meta["has_echo"] for ping in pings] == [False] * len(away) + [True, False, False]
    said = [float(re.search(r"lies at ([0-9.]+) m", warning.text)[1]) for warning in found]
    assert said == [35.5 + k for k in range(MOST_IN_A_ROW)] + [35.5, 36.5]
    assert len(n_explained) == len(found)


@pytest.mark.parametrize(
    "bodies, pose, message",
    [
        ((), np.eye(4), "no echo came back: the scene has no bodies"),
        (
            (BOX,),
            sg.pose(-30, 2, 0),
            "no echo came back: the nearest surface in the fan lies at 35.50 m, beyond range_max_m = 20",
        ),
        (
            (BOX,),
            sg.pose(5.3, 2, 0),
            "no echo came back: the nearest surface in the fan lies at 0.20 m, nearer than range_min_m = 0.5",
        ),
        (
            (replace(BOX, reflectivity=0.0),),
            sg.pose(0, 2, 0),
            "no echo came back: the nearest surface in the fan lies at 5.50 m; its reflectivity is 0, or "
            "it is seen edge-on",
        ),
        (
            (BOX,),
            sg.pose(0, 2, 5),
            "no echo came back: no surface lies in the fan; the nearest is 'box', 7.11 m away at "
            "azimuth 0.0° and elevation -39.3° of the sonar, which sees "
            "azimuths within ±30° and elevations within ±10°; turn or move the "
            "sonar",
        ),
        (  # so weak that float32 has no number for its echo in a bin
            (replace(BOX, reflectivity=1e-44),),
            sg.pose(0, 2, 0),
            "no echo came back: the nearest surface in the fan lies at 5.50 m; its echo is too weak to differ from 0",
        ),
        (  # just above the fan, where samples for its corners lie
            (sg.Body("lid", trimesh.creation.box((0.1, 0.1, 0.1)), sg.pose(8, 0, 1.52)),),
            np.eye(4),
            "no echo came back: no surface lies in the fan; the nearest is 'lid', 8.08 m away at azimuth 0.0° and "
            "elevation 10.5° of the sonar, which sees "
            "azimuths within ±30° and elevations within ±10°; turn or move the sonar",
        ),
        (  # seen edge-on, from within the range to far beyond
            (sg.Body("plate", trimesh.Trimesh([[5, -1, 0], [5, 1, 0], [99, 0, 0]], [[0, 1, 2]])),),
            np.eye(4),
            "no echo came back: no sample met a surface; the nearest is 'plate', 5.00 m away: it is seen edge-on, or "
            "is thinner than the samples; move the sonar",
        ),
        (  # the sonar lies in it
            (sg.Body("deck", trimesh.Trimesh([[-9, -9, 0], [9, -9, 0], [0, 9, 0]], [[0, 1, 2]])),),
            np.eye(4),
            "no echo came back: no sample met a surface; the nearest is 'deck', 0.00 m away: it is seen edge-on, or "
            "is thinner than the samples; move the sonar",
        ),
        *(
            (
                (sg.Body("wall", trimesh.creation.box((1, 20, 100)), sg.pose(400.5, 0, side * 200)),),
                np.eye(4),
                "no echo came back: no surface lies in the fan; the nearest is 'wall', 427.20 m away at azimuth 0.0° "
                f"and elevation {side * 20.6}° of the sonar, which sees "
                "azimuths within ±30° and elevations within ±10°; turn or move the sonar",
            )
            for side in (1, -1)
        ),
    ],
)
def test_a_ping_without_an_echo_says_why(bodies, pose, message):
    with simulator(bodies) as it, pytest.warns(UserWarning) as caught:
        ping = it.ping(pose)
    assert [str(w.message) for w in caught] == [message]
    assert not ping.intensity.any()


MILLIMETRES = (
    "if it was made in centimetres or millimetres, scale it by 0.01 or 0.001 (<scale>0.001 0.001 "
    "0.001</scale> of a mesh in SDF, mesh.apply_scale(0.001) in Python)"
)


@pytest.mark.parametrize("azimuth_fov_deg", [60.0, 360.0])
@pytest.mark.parametrize("direction", [0.0, 0.4])
def test_a_surface_too_far_to_be_drawn_is_named_with_its_distance(azimuth_fov_deg, direction):
    """A tank in millimetres: the far plane of a range of 20 m cuts everything away."""
    tank = sg.Body("tank", trimesh.creation.box((1000, 4000, 3000)), sg.pose(2500), 1.0)
    sonar = replace(SONAR, azimuth_fov_deg=azimuth_fov_deg)
    with simulator([tank], sonar=sonar) as it, pytest.warns(UserWarning) as caught:
        it.ping(sg.pose(yaw=direction))
    assert [str(w.message) for w in caught] == [
        "no echo came back: the nearest surface in the fan lies at 2.00 km, beyond range_max_m = 20; the scene "
        f"measures 1000 x 4000 x 3000 m: {MILLIMETRES}"
    ]


@pytest.mark.parametrize("azimuth_fov_deg", [90.0, 360.0])
@pytest.mark.parametrize(
    ("share", "elevation_deg", "is_in_fan"), [(0.49, 9.8, True), (0.49, 11, False), (0.25, -11, False)]
)
def test_a_far_surface_near_the_upper_end_of_the_fan_is_in_it_or_not(
    azimuth_fov_deg, share, elevation_deg, is_in_fan
):
    """The end is a cone: a plane that meets it straight ahead at 10 degrees lies at 7 degrees, 45 degrees aside."""
    place = sg.pose(yaw=math.radians(share * azimuth_fov_deg), pitch=-math.radians(elevation_deg))
    far = sg.Body("far", trimesh.creation.icosphere(1, 0.5), place @ sg.pose(400.5), 1.0)
    with (
        simulator([far], sonar=replace(SONAR, azimuth_fov_deg=azimuth_fov_deg)) as it,
        pytest.warns(UserWarning) as caught,
    ):
        it.ping(sg.pose())
    (text,) = (str(w.message) for w in caught)
    assert ("the nearest surface in the fan lies at 400.0" in text) == is_in_fan
    assert ("no surface lies in the fan; the nearest is 'far', 400.0" in text) == (not is_in_fan)


def test_a_far_surface_beside_the_fan_is_in_its_direction():
    wall = sg.Body("wall", trimesh.creation.box((1, 20, 20)), sg.pose(700.5), 1.0)
    with simulator([wall]) as it, pytest.warns(UserWarning) as caught:
        it.ping(sg.pose(yaw=math.pi / 2))
    assert [str(w.message) for w in caught] == [
        "no echo came back: no surface lies in the fan; the nearest is 'wall', 700.00 m away at azimuth -90.0° and "
        "elevation 0.0° of the sonar, which sees "
        "azimuths within ±30° and elevations within ±10°; turn or move the sonar"
    ]


def test_a_scene_of_usual_size_is_not_taken_for_one_in_millimetres_however_far_it_is():
    wall = sg.Body("wall", trimesh.creation.box((1, 20, 20)), sg.pose(5000.5), 1.0)
    with simulator([wall]) as it, pytest.warns(UserWarning) as caught:
        it.ping(sg.pose())
    assert [str(w.message) for w in caught] == [
        "no echo came back: the nearest surface in the fan lies at 5.00 km, beyond range_max_m = 20"
    ]


def test_a_scene_in_millimetres_is_taken_for_one_also_where_the_sonar_is_near():
    tank = sg.Body("tank", trimesh.creation.box((1000, 4000, 3000)), sg.pose(600), 1.0)
    with simulator([tank]) as it, pytest.warns(UserWarning) as caught:
        it.ping(sg.pose())
    assert [str(w.message) for w in caught] == [
        "no echo came back: the nearest surface in the fan lies at 100.00 m, beyond range_max_m = 20; the scene "
        f"measures 1000 x 4000 x 3000 m: {MILLIMETRES}"
    ]


def test_a_far_wall_seen_through_its_corner_is_at_its_nearest_point_in_the_fan():
    """The nearest point of the wall is beside the fan."""
    wall = sg.Body("wall", trimesh.creation.box((1, 1000, 400)), sg.pose(300.5, 500), 1.0)
    with simulator([wall]) as it, pytest.warns(UserWarning) as caught:
        it.ping(sg.pose(yaw=math.radians(50)))
    # the starboard edge of the fan, 30 degrees beside its middle, meets the wall at 20 degrees
    range_m = 300 / math.cos(math.radians(20))
    assert [str(w.message) for w in caught] == [
        f"no echo came back: the nearest surface in the fan lies at {range_m:.2f} m, beyond range_max_m = 20"
    ]


ABOVE = (
    "no echo came back: all bodies lie above the water's surface at z = -1 m, in which the sonar is; give the scene "
    "another surface (--surface, Scene.with_surface)"
)
BESIDE = (
    "no echo came back: no surface lies in the fan; the nearest is 'post', 9.97 m away at azimuth -106.6° and "
    "elevation 1.4° of the sonar, which sees "
    "azimuths within ±30° and elevations within ±10°; turn or move the sonar"
)


@pytest.mark.parametrize(
    "x, post, message",
    [
        (0.0, (), ABOVE),
        (-700.0, (), ABOVE),  # beyond the range
        # a leaning post, of which only the foot is in the water: nearest at (-2.85, -9.55, 0.25) of the sonar
        (0.0, [(-3, -10, 0), (-3, -10, 4.9), (0, -1, 5)], BESIDE),
    ],
)
def test_what_is_above_the_water_of_the_sonar_is_not_named_as_its_nearest_surface(x, post, message):
    bodies = [BOX]
    if post:
        bodies.append(sg.Body("post", trimesh.Trimesh(post, [[0, 1, 2]]), sg.pose(z=-1.25)))
    scene = sg.Scene(bodies, surface_z_m=-1.0)
    with (
        sg.Simulator(scene, SONAR, sg.Acoustics.ideal(), SAMPLING) as it,
        pytest.warns(UserWarning) as caught,
    ):
        it.ping(sg.pose(x, 0, -1.25))
    assert [str(w.message) for w in caught] == [message]


def test_the_nearest_surface_lies_at_the_range_that_the_sonar_shows():
    """It takes the speed of sound to be a tenth higher than it is; 5.5 m are 6.05 m for it."""
    acoustics = replace(sg.Acoustics.ideal(), water=sg.Water(sound_speed_m_s=1450.0))
    fast = replace(acoustics, sonar_sound_speed_m_s=1.1 * 1450.0)
    silent = replace(BOX, reflectivity=0.0)
    for model, range_m in ((acoustics, "5.50"), (fast, "6.05")):
        with simulator([silent], acoustics=model) as it, pytest.warns(UserWarning) as caught:
            it.ping(sg.pose(0, 2, 0))
        assert [str(w.message) for w in caught] == [
            f"no echo came back: the nearest surface in the fan lies at {range_m} m; its reflectivity is 0, or it is "
            "seen edge-on"
        ]


def test_a_surface_too_far_to_be_drawn_lies_at_the_range_that_the_sonar_shows_too():
    wall = sg.Body("wall", trimesh.creation.box((1, 20, 20)), sg.pose(400.5), 1.0)
    fast = replace(
        sg.Acoustics.ideal(), water=sg.Water(sound_speed_m_s=1450.0), sonar_sound_speed_m_s=1.1 * 1450.0
    )
    with simulator([wall], acoustics=fast) as it, pytest.warns(UserWarning) as caught:
        it.ping(sg.pose())
    assert [str(w.message) for w in caught] == [
        "no echo came back: the nearest surface in the fan lies at 440.00 m, beyond range_max_m = 20"
    ]


@pytest.mark.parametrize("side", [1, -1])
def test_of_surfaces_in_several_sectors_the_nearest_is_named(side):
    """Two that return nothing, to either side of a wide fan, each before the middle of a sector."""
    sonar = replace(SONAR, azimuth_fov_deg=130.0)
    silent = [
        sg.Body(name, trimesh.creation.box((1, 1, 1)), sg.pose(yaw=yaw) @ sg.pose(x + 0.5), 0.0)
        for name, x, yaw in (("near", 4, 0.8 * side), ("far", 7, -0.8 * side))
    ]
    with simulator(silent, sonar=sonar) as it, pytest.warns(UserWarning) as caught:
        it.ping(sg.pose())
    assert [str(w.message) for w in caught] == [
        "no echo came back: the nearest surface in the fan lies at 4.00 m; its reflectivity is 0, or it is seen edge-on"
    ]


@pytest.mark.parametrize("order", [1, -1])
@pytest.mark.parametrize("pose", [sg.pose(), sg.pose(0, 0, -300.0)])
def test_of_several_bodies_the_nearest_that_is_there_is_named(order, pose):
    """Behind the sonar, at 5, 9 and 3 m, of which the last is absent; and deep below the surface of the water."""
    bodies = [
        sg.Body(name, trimesh.creation.box((1, 1, 1)), pose @ sg.pose(-x - 0.5))
        for name, x in (("near", 5), ("far", 9), ("gone", 3))
    ][::order]
    scene = sg.Scene(bodies, surface_z_m=2.0)
    with (
        sg.Simulator(scene, SONAR, sg.Acoustics.ideal(), SAMPLING) as it,
        pytest.warns(UserWarning) as caught,
    ):
        it.ping(pose, bodies={"gone": None})
    assert [str(w.message) for w in caught] == [
        "no echo came back: no surface lies in the fan; the nearest is 'near', 5.00 m away at azimuth 180.0° and "
        "elevation 0.0° of the sonar, which sees "
        "azimuths within ±30° and elevations within ±10°; turn or move the sonar"
    ]


@pytest.mark.parametrize("order", [1, -1])
def test_of_several_far_surfaces_in_the_fan_the_nearest_is_named(order):
    """In two wedges of a wide fan, beyond the range."""
    walls = [
        sg.Body(name, trimesh.creation.box((1, 20, 20)), sg.pose(yaw=yaw) @ sg.pose(x + 0.5))
        for name, x, yaw in (("near", 400, 0.9), ("far", 700, -0.9))
    ][::order]
    sonar = replace(SONAR, azimuth_fov_deg=130.0)
    with simulator(walls, sonar=sonar) as it, pytest.warns(UserWarning) as caught:
        it.ping(sg.pose())
    assert [str(w.message) for w in caught] == [
        "no echo came back: the nearest surface in the fan lies at 400.00 m, beyond range_max_m = 20"
    ]


NAN_MESH = trimesh.Trimesh([[0, 0, np.nan], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]], process=False)
NAN = np.eye(4)
NAN[0, 3] = np.nan


@pytest.mark.parametrize(
    "make, message",
    [
        (lambda: sg.Simulator("pylon", SONAR), "scene must be a Scene (got str;"),
        (lambda: sg.Simulator(trimesh.Scene(BOX.mesh), SONAR), "scene must be a Scene (got that of"),
        (lambda: sg.Scene(trimesh.Scene(BOX.mesh)), "a body of a scene must be a Body (got Scene;"),
        (lambda: sg.Scene([BOX.mesh]), "a body of a scene must be a Body (got Trimesh;"),
        (lambda: sg.Simulator(sg.Scene([BOX]), "p900-45"), "sonar must be a Sonar (got str;"),
        (lambda: sg.Simulator(sg.Scene([BOX]), SONAR, "physical"), "acoustics must be an Acoustics"),
        (lambda: sg.Simulator(sg.Scene([BOX]), SONAR, sampling=3), "sampling must be a Sampling (got int;"),
        (lambda: simulator().ping(np.eye(4), noise="physical"), "noise must be a Noise (got str;"),
        (lambda: simulator().ping(np.eye(4), seed=1.5), "seed must be a whole number, 0 or more (got 1.5)"),
        (lambda: simulator().ping(np.eye(4), ping_number="1"), "ping_number must be a whole number"),
        (lambda: simulator().ping(np.eye(4), labels="no"), "labels must be True or False (got 'no')"),
        (lambda: simulator().ping(np.eye(4), labels=np.array([1, 2])), "labels must be True or False"),
        (lambda: simulator().place(None), "bodies must be a dict (got NoneType;"),
        (lambda: simulator().ping(NAN), "pose must be finite (got NaN or infinity in 1 of 16 numbers)"),
        (lambda: simulator().ping(np.eye(3)), "pose must have shape (4, 4) (got (3, 3);"),
        (
            lambda: sg.Body("b", trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [])),
            "body 'b': mesh must have at least one face (got 3 vertices, 0 faces)",
        ),
        (lambda: sg.Body("b", NAN_MESH), "body 'b': mesh vertices must be finite"),
        (
            lambda: sg.Body("b", arrays(-3.4028235e38 * np.eye(3), np.array([[0, 1, 2]]))),
            "body 'b': mesh vertices must lie within 1e+09 m of the mesh's origin (got -3.40282e+38; give metres, and "
            "leave out vertices that stand for missing data)",
        ),
        (lambda: sg.Body("b", [1, 2]), "body 'b': mesh must be a trimesh.Trimesh (got list;"),
        (lambda: sg.Body("b", arrays(np.eye(3), np.array([[0, 1, 2, 0]]))), "body 'b': mesh faces must be"),
        (lambda: sg.Body("b", arrays(np.eye(3), np.array([[0, 1, 1.5]]))), "body 'b': mesh faces must be"),
        (
            lambda: sg.Body("b", arrays(np.empty((0, 3)), np.array([[0, 1, 2]]))),
            "body 'b': faces must name vertices 0..-1 (got 2)",
        ),
        (lambda: sg.Body(None, BOX.mesh), 'the name of a body must be a str (got NoneType; such as "diver")'),
        (lambda: sg.Bubbles(7), 'the name of bubbles must be a str (got int; such as "diver::bubbles")'),
        (lambda: replace(BOX, reflectivity=255), "body 'box': reflectivity must lie in 0..1"),
        (lambda: sg.Scene([BOX], name=None), "the name of a scene must be a str (got NoneType;"),
        (lambda: sg.Scene([BOX], sensors=SONAR), "sensors of a scene must be an Iterable (got Sonar;"),
        (lambda: sg.Scene([BOX], models=np.eye(4)), "models of a scene must be a dict (got ndarray;"),
        (lambda: sg.Scene([BOX], models={5: np.eye(4)}), "the name of a model must be a str (got int;"),
    ],
)
def test_invalid_arguments_raise_errors(make, message):
    assert error_of(make).startswith(message)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda one: sg.Scene(one), "a body of a scene must be a Body (got ndarray; "),
        (lambda one: sg.Scene([BOX], sensors=one), "sensors of a scene must be an Iterable (got ndarray; "),
        (lambda one: sg.Scene([BOX]).with_bodies(one), "bodies of a scene must be an Iterable"),
        (lambda one: sg.Scene([BOX]).with_more(one), "bodies to add must be an Iterable (got ndarray;"),
        (lambda one: list(simulator().pings(one)), "poses must be several poses (got ndarray; "),
        (lambda one: simulator().plan(one), "poses must be several poses (got ndarray; "),
        (lambda one: list(simulator().pings([np.eye(4)], times_s=one)), "times_s must be several, one a"),
        (
            lambda one: simulator().ping(np.eye(4), labels=True, background=one),
            "background must be several names of bodies (got array(3.); ",
        ),
        (lambda one: sg.save_animation("none.gif", one, 5), "frames must be an Iterable (got ndarray;"),
    ],
)
def test_an_array_of_no_axis_is_not_several(make, message):
    assert error_of(make, np.array(3.0)).startswith(message)


def test_a_simulator_refuses_to_be_copied_and_still_pings():
    with simulator() as it:
        expected = it.ping(np.eye(4)).intensity
        for take in (copy.copy, copy.deepcopy, pickle.dumps):
            assert error_of(take, it) == (
                "a Simulator cannot be copied or pickled, since its threads and memory belong to it and to its "
                "process; make another one with the same arguments"
            )
            np.testing.assert_array_equal(it.ping(np.eye(4)).intensity, expected)


@pytest.mark.usefixtures("few_first_rays")
def test_reference_and_raster_agree_on_the_pylons():
    """Ray casting by Embree and rasterization, which share no code, agree on a bundled scene with flat faces."""
    scene = sg.load_scene("pylon")
    flat = sg.Scene([replace(body, normals=None) for body in scene.bodies], scene.sonar_pose)
    sonar = replace(SONAR, n_beams=64, azimuth_fov_deg=45.0, beam_width_deg=1.0, range_max_m=30.0)
    truth = sg.reference_ping(flat, sonar, scene.sonar_pose, sg.Acoustics.ideal(), error=0.03).intensity
    errors = []
    for tolerance in (0.05, 0.01):
        with sg.Simulator(flat, sonar, sg.Acoustics.ideal(), tolerance=tolerance) as it:
            errors.append(np.abs(it.ping(scene.sonar_pose).intensity - truth).sum() / truth.sum())
    assert errors[1] < 0.01
    assert errors[0] > 2 * errors[1]


@pytest.mark.slow
@pytest.mark.parametrize("fov", [100.0, 200.0, 360.0])
def test_demarco_image_of_wide_fans(fov):
    room = sg.Body("room", trimesh.creation.box((12, 10, 4)), reflectivity=1.0)
    with simulator((room,), replace(SONAR, azimuth_fov_deg=fov, n_beams=8)) as it:
        points, _ = it.point_cloud(np.eye(4), columns=1500, rows=5)
        picture = sg.demarco_image(it, np.eye(4), range_law="constant")
    azimuth = np.arctan2(points[2, :, 1], points[2, :, 0])
    assert 1500 <= points.shape[1] < 1520
    assert np.degrees(np.abs(azimuth)).max() == pytest.approx(fov / 2, abs=fov / 1000)
    assert (np.diff(azimuth) > 0).all()
    assert (picture[..., 0] > 0).any()


def test_a_simulator_in_a_forked_process_raises_an_error():
    """A forked process has no OpenGL context; it gets an error, does not hang, and leaves its parent's context."""
    with simulator() as it:
        expected = it.ping(np.eye(4)).intensity
        read, write = os.pipe()
        child = os.fork()
        if child == 0:  # pragma: no cover
            try:
                it.ping(np.eye(4))
            except sg.Error as why:
                os.write(write, str(why).encode())
            it.close()
            os._exit(0)
        os.close(write)
        with os.fdopen(read) as pipe:
            message = pipe.read()
        os.waitpid(child, 0)
        np.testing.assert_array_equal(it.ping(np.eye(4)).intensity, expected)
    assert message == "a Simulator must be used in the process that made it; make one in each process"


MAKE_IN_FORK = """
import os, signal, sys
import numpy as np
import sonar_gl as sg
from tests.end_to_end.test_simulator import simulator

def make_in_fork():
    read, write = os.pipe()
    if (child := os.fork()) == 0:
        signal.alarm(60)
        try:
            with simulator() as it:
                reply = f"an echo of {it.ping(np.eye(4)).intensity.sum():.6g}"
        except sg.Error as why:
            reply = str(why)
        os.write(write, reply.encode())
        os._exit(0)
    os.close(write)
    with os.fdopen(read) as pipe:
        return pipe.read() or f"signal {os.waitpid(child, 0)[1]}"

early = make_in_fork()
with simulator() as it:
    here = f"an echo of {it.ping(np.eye(4)).intensity.sum():.6g}"
print(early == here)
print(make_in_fork())
"""


@pytest.mark.slow
def test_a_process_forked_after_a_context_was_made_makes_no_other(opengl_engine):
    """It would hang: the driver's threads are the parent's. One forked before makes its own."""
    run = subprocess.run(
        [sys.executable, "-W", "ignore::DeprecationWarning", "-c", MAKE_IN_FORK],
        capture_output=True, text=True, timeout=150, cwd=ROOT,
    )  # fmt: skip
    early, late = run.stdout.splitlines()
    assert early == "True", run.stderr
    assert "whose driver's threads it lacks); start processes by multiprocessing.get_context('spawn')" in late


def test_pings_do_not_share_mutable_state():
    with simulator() as it:
        first = it.ping(np.eye(4))
        first.meta["sonar"]["n_beams"] = -1
        second = it.ping(np.eye(4), sg.Noise(gaussian=1e-6), labels=True)
    assert second.meta["sonar"]["n_beams"] == 64
    for array in (first.intensity, second.intensity, second.body_id, second.elevation_rad):
        assert not array.flags.writeable
    assert not first.range_m.flags.writeable
    assert not first.azimuth_rad.flags.writeable


def test_a_deleted_simulator_is_freed():
    it = simulator()
    it.ping(np.eye(4))
    beamformer = weakref.ref(it.run.sampler.resolution.stage.beamformer)
    del it

    def is_freed():
        gc.collect()
        return beamformer() is None

    wait_until(is_freed, often_s=0.01)  # the second thread drops its last work with a delay


def test_point_clouds_do_not_leak_gl_objects(opengl_engine):
    """Each call deletes the objects that the last one released, so their number does not grow."""
    with simulator() as it:
        waiting = []
        for _ in range(6):
            it.point_cloud(np.eye(4), 40, 10)
            with it.run.drawing() as context:
                waiting.append(len(context.objects))
        assert len(set(waiting[1:])) == 1


def test_closing_in_another_thread_while_a_ping_waits():
    it = simulator()
    run, outcome = it.run, []

    def is_closed(run):
        try:
            run.check_open()
        except sg.Error:
            return True
        return False

    def wait():
        try:
            it.ping(np.eye(4))
        except Exception as why:
            outcome.append(why)

    with it.run.drawing():
        waiting = threading.Thread(target=wait)
        waiting.start()
        time.sleep(0.1)
        closing = threading.Thread(target=it.close)
        closing.start()
        wait_until(lambda: is_closed(run))  # else the ping may be first, and succeed
    closing.join()
    waiting.join()
    assert [type(why) for why in outcome] == [sg.Error]


def test_a_sonar_above_the_water_warns_once():
    """The surface has no effect on it, so that a wrong sign would go unnoticed."""
    body = sg.Body("wall", trimesh.creation.box((1, 20, 20)), sg.pose(8))
    scene, kinds = sg.Scene([body], surface_z_m=-2.0), (sg.load_sonar("p900-45"), sg.Acoustics.ideal())
    with sg.Simulator(scene, *kinds, sg.Sampling(1, 20)) as simulator:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            simulator.ping(sg.pose(z=-2.5))
        with pytest.warns(UserWarning) as caught:
            for _ in range(2):
                simulator.ping(sg.pose(z=-1.5))
            list(simulator.pings([sg.pose(z=1.0)] * 2))
    (only,) = caught
    assert str(only.message) == (
        "the sonar at z = -1.5 m is above the water's surface at z = -2 m, which has no effect on it; give it a "
        "lower pose, or the scene another surface (--surface, Scene.with_surface)"
    )
    assert only.filename == __file__


def test_the_first_ping_of_a_sonar_inside_a_body_warns():
    """Later ones do not, since to look at each pose would take long; nor where the body is absent."""
    ball, wall = (
        sg.Body(name, mesh, sg.pose(x))
        for name, mesh, x in (
            ("ball", trimesh.creation.icosphere(2, 0.5), 0.3),
            ("wall", trimesh.creation.box((1, 20, 20)), 8),
        )
    )
    scene, kinds = (
        sg.Scene([ball, wall]),
        (sg.load_sonar("p900-45"), sg.Acoustics.ideal(), sg.Sampling(1, 20)),
    )
    for poses, bodies, n_warnings in (
        ([sg.pose(), sg.pose()], None, 1),
        ([sg.pose(2), sg.pose()], None, 0),
        ([sg.pose()], {"ball": None}, 0),
    ):
        with sg.Simulator(scene, *kinds) as simulator, warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            for pose in poses:
                simulator.ping(pose, bodies=bodies)
        assert len(caught) == n_warnings
        for one in caught:
            assert str(one.message) == (
                "the sonar at (0, 0, 0) m is inside body 'ball', or below it if it is a terrain, and sees what no "
                "sonar does from there; give it another pose, have the body absent in its pings "
                "(Simulator.ping(bodies=...)), or, if it is a tank, turn its faces to the inside (mesh.invert())"
            )
            assert one.filename == __file__


def test_a_sonar_below_a_sheet_in_the_surface_of_the_water_is_in_no_body():
    """A mesh of the surface, for a viewer, is not seen from the water; others see the sonar below a terrain."""
    sheet = sg.Body("surface", trimesh.Trimesh([[-9, -9, 0], [9, -9, 0], [0, 9, 0]], [[0, 1, 2]]))
    for surface_z_m, said in ((None, ["InsideWarning"]), (0.0, [])):
        scene = sg.Scene([sheet, BOX], surface_z_m=surface_z_m)
        with (
            sg.Simulator(scene, SONAR, sampling=SAMPLING) as it,
            warnings.catch_warnings(record=True) as caught,
        ):
            warnings.simplefilter("always")
            assert it.ping(sg.pose(0, 2, -0.4)).intensity.any()
        assert [one.category.__name__ for one in caught] == said


def test_the_place_of_a_sonar_in_a_body_is_told_to_millimetres_also_in_utm():
    place = sg.pose(451234.5, 4987654.321, -5)
    ball = sg.Body("ball", trimesh.creation.icosphere(3, 1.0), place)
    with sg.Simulator(sg.Scene([ball]), SONAR, sampling=SAMPLING) as it, pytest.warns(UserWarning) as caught:
        it.ping(place)
    assert str(caught[0].message).startswith(
        "the sonar at (451234.5, 4987654.321, -5) m is inside body 'ball', "
    )


def test_a_tank_whose_faces_look_inside_looks_alike_without_a_warning():
    """As the warning of a sonar inside a body says: a box is often meant as a tank."""
    box, turned = (trimesh.creation.box((12, 8, 6)) for _ in range(2))
    turned.invert()
    pings = []
    for mesh, n_warnings in ((box, 1), (turned, 0)):
        scene = sg.Scene([sg.Body("tank", mesh)])
        with (
            sg.Simulator(scene, sg.load_sonar("p900-45"), sampling=sg.Sampling(1, 20)) as simulator,
            warnings.catch_warnings(record=True) as caught,
        ):
            warnings.simplefilter("always")
            pings.append(simulator.ping(sg.pose(pitch=0.2)))
        assert len(caught) == n_warnings and all("if it is a tank" in str(one.message) for one in caught)
    assert pings[0].intensity.any()
    np.testing.assert_array_equal(pings[0].intensity, pings[1].intensity)


def test_whole_numbers_of_a_sonar_compile_nothing_more():
    """Also where a ping chooses its samples, judges bodies that they miss, and has multipath."""
    wall, hidden = (
        sg.Body(f"wall at {x} m", trimesh.creation.box((1, 20, 20)), sg.pose(x)) for x in (8.0, 8.2)
    )
    kinds = []
    for range_min_m, range_max_m in ((1.0, 10.0), (1, 10)):
        sonar = sg.Sonar("test", 900e3, 32, 64, 45.0, 20.0, 2.0, range_min_m, range_max_m)
        acoustics = sg.Acoustics.ideal(multipath="incoherent")
        with sg.Simulator(sg.Scene([wall, hidden]), sonar, acoustics, tolerance=0.3) as simulator:
            simulator.ping(sg.pose(), labels=True)
        kinds.append({name: len(one.signatures) for name, one in compiled_functions().items()})
    assert kinds[0] == kinds[1]


def test_the_repr_of_a_ping_is_one_short_line():
    """That of a dataclass printed its arrays and its whole meta, 16 000 characters."""
    sonar = sg.Sonar("test", 900e3, 4, 30, 20.0, 10.0, 3.0, 0.5, 10.0)
    with sg.Simulator(sg.Scene([]), sonar, sampling=sg.Sampling(1, 8)) as simulator:
        renderer = simulator.gl_info["renderer"]
        with pytest.warns(UserWarning, match="the scene has no bodies"):
            ping = simulator.ping(sg.pose())
    assert repr(ping) == f"<Ping of 4 beams x 30 bins, sonar 'test', by {renderer}>"
    assert repr(sg.Ping(ping.intensity, ping.azimuth_rad, ping.range_m)) == "<Ping of 4 beams x 30 bins>"
    assert repr(sg.Ping(None, None, None)) == "<Ping of shape ()>"


@pytest.mark.parametrize(("got", "cure"), [((20, 8), "; give its transpose, intensity.T"), ((8, 19), "")])
def test_an_intensity_that_does_not_fit_is_refused_where_the_ping_is_made(got, cure):
    """Swapped axes were an error of the first picture or file, or none at all, as of `counts`."""
    with pytest.raises(sg.Error) as caught:
        sg.Ping(np.zeros(got), np.linspace(-0.3, 0.3, 8), np.linspace(1.0, 5.0, 20))
    assert str(caught.value) == (
        "a ping's intensity must be (beams, bins) = (8, 20), as long as azimuth_rad and range_m "
        f"(got {got}{cure})"
    )


def test_the_repr_of_a_simulator_and_of_what_it_shows_is_short():
    """In a notebook a cell `simulator.gbuffers(pose)` or `simulator.fan` printed over 100 000 characters."""
    sonar = sg.load_sonar("p900-45")
    with sg.Simulator(sg.Scene([], name="sea"), sonar, sampling=sg.Sampling(1, 8)) as simulator:
        renderer = simulator.gl_info["renderer"]
        assert repr(simulator) == f"<Simulator of scene 'sea', sonar 'p900-45', by {renderer}>"
        buffer, *_ = simulator.gbuffers(sg.pose())
        rows, columns = buffer.range_m.shape
        assert repr(buffer) == f"<GBuffer of {rows} rows x {columns} columns>"
        assert len(repr(simulator.fan)) < 5000
    assert repr(simulator) == "<Simulator of sonar 'p900-45', closed>"
    assert repr(sg.GBuffer(None, None, None, None, None)) == "<GBuffer of shape ()>"


@pytest.mark.parametrize("name", ["sonar", "acoustics"])
def test_what_a_simulator_was_made_with_is_not_changed(name):
    """Else `simulator.sonar = sonar.with_range(5)` is taken, and pings keep the range that they had."""
    with sg.Simulator(sg.Scene([]), sg.load_sonar("p900-45"), sampling=sg.Sampling(1, 8)) as simulator:
        given = getattr(simulator, name)
        with pytest.raises(sg.Error, match=rf"the {name} of a Simulator must not be changed .*with_range"):
            setattr(simulator, name, given)
        assert getattr(simulator, name) is given
