"""What the tags of a world's sensor state of its sonar."""

import math
import warnings

import numpy as np
import pytest

import sonar_gl as sg
from sonar_gl.core.poses import pose
from tests.support.sdf_texts import ROUNDING, SHAPE, link, model


def approx(angle_deg):
    """Equal, but for the rounding of radians in files."""
    return pytest.approx(angle_deg, rel=1e-14)


SPECIFIC = "frequency, beam width of p900-45: the sensor states none"
CAMERA = (
    "<camera><horizontal_fov>{fov}</horizontal_fov><image><width>{width}</width><height>{height}</height></image>"
    "<clip><near>{near}</near><far>{far}</far></clip></camera>"
)


def scan(
    horizontal, vertical="", limits="<min>0.5</min><max>20</max><resolution>0.05</resolution>", tag="ray"
):
    return (
        f"<{tag}><scan><horizontal>{horizontal}</horizontal><vertical>{vertical}</vertical></scan>"
        f"<range>{limits}</range></{tag}>"
    )


def angles(low_deg, high_deg, samples):
    low, high = math.radians(low_deg), math.radians(high_deg)
    return f"<samples>{samples}</samples><min_angle>{low}</min_angle><max_angle>{high}</max_angle>"


def sensor(inside, name="front_sonar", kind="gpu_ray", more=""):
    return f"<sensor name='{name}' type='{kind}' {more}>{inside}</sensor>"


@pytest.fixture
def read(tmp_path):
    """A function that returns the scene of a world with these sensors, and the texts of the reader's warnings."""

    def read(*sensors, prefix=""):
        links = "".join(f"<link name='l{k}'>{text}</link>" for k, text in enumerate(sensors))
        path = tmp_path / "a.sdf"
        path.write_text(
            f"<sdf version='1.9' {prefix}><world name='w'><model name='rov'><pose>1 2 3 0 0 0</pose>{links}</model>"
            f"<model name='rock'><link name='l'>{SHAPE}</link></model></world></sdf>"
        )
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            scene = sg.load_scene(path)
        return scene, [str(one.message).removeprefix(f"{path}: ") for one in caught]

    return read


def test_ray_sensors_by_which_a_sonar_may_be_meant_are_named(read):
    """Many worlds simulate their sonar by a laser that keeps the name of a laser."""
    laser = scan(angles(-45, 45, 180))
    scene, texts = read(sensor(laser, "gpu_lidar", "gpu_lidar"), sensor(laser, "altimeter"))
    assert scene.sonar_pose is None
    assert texts == [
        "no sensor is named after a sonar; if a ray sensor stands for one (rov/sensor[gpu_lidar]), write 'sonar' "
        "into its name, and its place and settings are taken"
    ]
    scene, texts = read(sensor(laser, "gpu_lidar", "gpu_lidar"), sensor(laser))
    assert scene.sensors[0].name == "front_sonar" and not texts


def test_a_ray_sensor_states_fan_beams_range_and_bins(read):
    text = scan(angles(-45, 45, 180), angles(-7.5, 7.5, 30)) + "<update_rate>12</update_rate>"
    scene, texts = read(sensor(text))
    found = scene.sonar
    assert (found.name, found.n_beams, found.n_bins) == ("front_sonar", 180, 390)
    assert (found.range_min_m, found.range_max_m) == (0.5, 20.0)
    assert found.azimuth_fov_deg == approx(90) and found.elevation_fov_deg == approx(15)
    preset = sg.load_sonar("p900-45")
    assert (found.frequency_hz, found.beam_width_deg) == (preset.frequency_hz, preset.beam_width_deg)
    (taken,) = scene.sensors
    assert taken.rate_hz == 12 and str(taken) == "sensor 'front_sonar' of model 'rov'"
    np.testing.assert_array_equal(taken.pose, scene.sonar_pose)
    np.testing.assert_array_equal(taken.pose, pose(1, 2, 3))
    assert taken.describe() == f"90 x 15 deg, 180 beams, 0.5 to 20 m in 390 bins, 900 kHz, 12 Hz ({SPECIFIC})"
    assert texts == []


@pytest.mark.parametrize(
    ("text", "kind"),
    [
        (scan(angles(-30, 30, 64), angles(-5, 5, 8), tag="lidar"), "gpu_lidar"),
        (scan(angles(-30, 30, 64).replace("samples", "beams"), angles(-5, 5, 8).replace("samples", "rays")), "custom"),
        (scan("<samples>64</samples><min_angle>-30</min_angle><max_angle>30</max_angle>",
              "<samples>8</samples><min_angle>-5</min_angle><max_angle>5</max_angle>")
         .replace("<ray>", "<ray degrees='true'>"), "ray"),
        (scan(angles(-30, 30, 32) + "<resolution>2</resolution>", angles(-5, 5, 8)), "ray"),
    ],
    ids=["lidar", "beams and rays", "degrees", "resolution"],
)  # fmt: skip
def test_ways_to_write_the_same_scan(read, text, kind):
    found = read(sensor(text, kind=kind))[0].sonar
    assert found.n_beams == 64
    assert found.azimuth_fov_deg == approx(60) and found.elevation_fov_deg == approx(10)


def test_a_depth_camera_states_its_image(read):
    text = CAMERA.format(fov=math.radians(60), width=128, height=32, near=0.2, far=12)
    found = read(sensor(text, kind="depth"))[0].sonar
    assert found.n_beams == 128 and (found.range_min_m, found.range_max_m) == (0.2, 12.0)
    assert found.azimuth_fov_deg == approx(60)
    # a pinhole: half the height of the image over its distance
    height_deg = 2 * math.degrees(math.atan(math.tan(math.radians(30)) * 32 / 128))
    assert found.elevation_fov_deg == approx(height_deg)
    # not exactly: there is a whole number of bins
    assert found.bin_size_m == pytest.approx(sg.load_sonar("p900-45").bin_size_m, rel=0.01)


@pytest.mark.parametrize("in_plugin", [True, False], ids=["plugin", "gz"])
def test_the_settings_of_a_plugin_take_precedence(read, in_plugin):
    """The image is taller than the beam, and reaches farther: it is there for the plugin to choose from."""
    settings = (
        "<verticalFOV>12</verticalFOV><sonarFreq>2.1e6</sonarFreq><bandwidth>300e3</bandwidth>"
        "<soundSpeed>1500</soundSpeed><maxDistance>4.1</maxDistance>"
    )
    text = CAMERA.format(fov=math.radians(60), width=256, height=102, near=0.1, far=50)
    if in_plugin:
        text += f"<plugin name='p' filename='libnps_multibeam_sonar_ros_plugin.so'>{settings}</plugin>"
    else:
        text += f"<gz:multibeam_sonar><spec>{settings}</spec></gz:multibeam_sonar>"
    scene, texts = read(sensor(text, kind="depth"), prefix="xmlns:gz='http://gazebosim.org/schema'")
    found = scene.sonar
    assert (found.elevation_fov_deg, found.frequency_hz, found.range_max_m) == (12.0, 2.1e6, 4.1)
    assert found.n_bins == 1600  # c/2B = 2.5 mm
    assert scene.sensors[0].assumed == ("beam width",) and texts == []


def test_a_scan_to_one_side_and_around(read):
    found = read(sensor(scan(angles(-10, 50, 60), angles(-5, 5, 8))))[0].sonar
    assert (found.n_beams, found.azimuth_fov_deg) == (60, approx(100))
    # the file has radians
    np.testing.assert_allclose(found.beam_azimuths_deg, np.arange(60) - 9.5, rtol=1e-13)
    around = read(sensor(scan(angles(0, 360, 90), angles(-5, 5, 8))))[0].sonar
    assert around.azimuth_fov_deg == approx(360) and around.beam_azimuths_deg is None


def test_wide_beams_fill_their_spacing(read):
    scene, _ = read(sensor(scan(angles(-45, 45, 10), angles(-5, 5, 8))))
    assert scene.sonar.beam_width_deg == approx(9)
    assert scene.sensors[0].assumed == ("frequency",)


def test_a_single_ray_has_the_fan_of_the_preset(read):
    one = "<samples>1</samples><min_angle>0</min_angle><max_angle>0</max_angle>"
    scene, texts = read(sensor(scan(one, one)))
    preset = sg.load_sonar("p900-45")
    assert (scene.sonar.n_beams, scene.sonar.azimuth_fov_deg) == (preset.n_beams, preset.azimuth_fov_deg)
    assert scene.sonar.range_max_m == 20.0 and texts == []
    assert scene.sensors[0].assumed[:3] == ("field of view", "vertical aperture", "number of beams")


@pytest.mark.parametrize(
    "text", ["", "<update_rate>5</update_rate>", "<camera/>", "<always_on>1</always_on>"]
)
def test_a_sensor_that_states_nothing_has_a_pose_alone(read, text):
    scene, texts = read(sensor(text))
    assert scene.sonar is None and scene.sonar_pose is not None and texts == []
    assert scene.sensors[0].describe() == "states no sonar; preset p900-45"


@pytest.mark.parametrize(
    ("text", "field", "value", "why"),
    [
        (scan(angles(-300, 300, 50)), "azimuth_fov_deg", 360.0, "field of view must lie in 0.01 to 360"),
        (scan(angles(-9, 9, 99999)), "n_beams", 4096, "number of beams must lie in 1 to 4096 (got 99999);"),
        (scan(angles(-9, 9, 50), limits="<min>-1</min>"), "range_min_m", 0.0, "least range must lie in 0 to 100000"),
        (scan(angles(-9, 9, 50), limits="<max>inf</max>"), "range_max_m", 29.9894, "<max> must be a number"),
        (scan(angles(-9, 9, 50), limits="<max>far</max>"), "range_max_m", 29.9894, "<max> must be a number"),
        (scan(angles(-9, 9, 50), limits="<min>8</min><max>2</max>"), "range_max_m", 29.9894,
         "the range must rise (got 8 to 2 m); it is that of p900-45"),
        (scan(angles(-9, 9, 50), limits="<max>100</max><resolution>0.0002</resolution>"), "n_bins", 65536,
         "497500 bins of 0.0002 m are too many; there are 65536"),
        (scan(angles(-9, 9, 50), angles(-30, 0, 9)), "elevation_fov_deg", 30.0,
         "the scan's elevations must lie about 0 (got -30 to 0 deg); turn the sonar by its pose"),
        ("<verticalFOV>0</verticalFOV>", "elevation_fov_deg", 0.01, "vertical aperture must lie in 0.01 to"),
        ("<sonarFreq>1e12</sonarFreq>", "frequency_hz", 1e8, "frequency must lie in 10000 to 1e+08"),
    ],
)  # fmt: skip
def test_what_no_sonar_has_is_replaced_with_one_warning(read, text, field, value, why):
    scene, (told,) = read(sensor(text))
    assert getattr(scene.sonar, field) == approx(value)
    assert told.startswith(f"sensor 'front_sonar' of model 'rov': {why}")


def test_ranges_that_only_one_end_states(read):
    near = read(sensor(scan(angles(-9, 9, 50), limits="<max>0.3</max>")))[0].sonar
    assert (near.range_min_m, near.range_max_m) == (0.0, 0.3)
    far = read(sensor(scan(angles(-9, 9, 50), limits="<min>40</min>")))[0].sonar
    assert (far.range_min_m, far.range_max_m) == (40.0, 80.0)


def test_gazebos_own_sonar_states_its_range(read):
    found = read(sensor("<sonar><min>0.2</min><max>7</max><radius>1</radius></sonar>", "echo", "sonar"))[
        0
    ].sonar
    assert (found.range_min_m, found.range_max_m, found.azimuth_fov_deg) == (0.2, 7.0, 45.0)


def test_the_sensor_of_the_pose_is_taken_and_the_others_are_listed(read):
    wide, narrow = scan(angles(-60, 60, 50)), scan(angles(-20, 20, 50))
    scene, texts = read(
        sensor(wide, "a_sonar"),
        sensor(narrow, "b", "custom") + "<pose>0 0 1 0 0 0</pose>",
        sensor("", "c", "imu"),
    )
    assert [one.name for one in scene.sensors] == ["b", "a_sonar"]
    assert scene.sonar.azimuth_fov_deg == approx(40) and texts == []
    np.testing.assert_array_equal(scene.sonar_pose, pose(1, 2, 4))


def test_a_wrong_pose_of_a_sensor_that_is_not_taken_is_no_error(read):
    scene, texts = read(sensor(""), sensor("<pose>here</pose>", "second_sonar"))
    assert [one.name for one in scene.sensors] == ["front_sonar"] and texts == []


@pytest.mark.parametrize(
    ("model", "name", "is_sonar"),
    [
        ("rov_with_dvl", "multibeam_sonar", True),
        ("rov_with_dvl", "front", False),
        ("sonar_rov", "front", True),
        ("sonar_rov", "dvl_sonar", False),
        ("dvl_sonar", "front", False),
    ],
)
def test_sensors_named_after_a_dvl_are_no_imaging_sonars(tmp_path, model, name, is_sonar):
    """A vehicle that is named after its DVL may carry a sonar as well."""
    text = sensor(scan(angles(-45, 45, 180)), name)
    (tmp_path / "a.sdf").write_text(
        f"<sdf version='1.9'><world name='w'><model name='{model}'><link name='l'>{text}</link></model></world></sdf>"
    )
    assert (sg.load_scene(tmp_path / "a.sdf").sonar_pose is not None) == is_sonar


def test_rays_beyond_all_floats_are_replaced(read):
    samples = "<samples>1e308</samples><resolution>1e308</resolution><min_angle>-1</min_angle>"
    scene, (text,) = read(sensor(scan(samples + "<max_angle>1</max_angle>")))
    assert scene.sonar.n_beams == 256
    assert "the rays of <horizontal> must be a number (got 1e+308 samples x 1e+308)" in text


@pytest.mark.parametrize("prefix", ["xmlns:gz='http://gazebosim.org/schema'", ""])
@pytest.mark.parametrize(("kind", "is_sonar"), [("odometer", False), ("multibeam_sonar", True)])
def test_a_custom_sensor_of_another_kind_is_no_sonar(read, prefix, kind, is_sonar):
    scene, _ = read(sensor("", "s", "custom", f"gz:type='{kind}'"), prefix=prefix)
    assert (scene.sonar_pose is not None) == is_sonar


@pytest.mark.parametrize("prefix", ["xmlns:gz='http://gazebosim.org/schema'", ""])
def test_a_dvl_is_no_sonar_whatever_its_name(read, prefix):
    """Sonardyne makes DVLs, and their models are named after it."""
    scene, _ = read(sensor("", "sonardyne_syrinx600", "custom", "gz:type='dvl'"), prefix=prefix)
    assert scene.sonar_pose is None


@pytest.mark.parametrize("name", ["dvl", "teledyne_dvl_sensor", "altimeter"])
def test_a_custom_sensor_that_is_named_after_a_dvl_is_no_sonar(read, name):
    """Some files do not say by `gz:type` what a custom sensor is."""
    scene, _ = read(sensor("", name, "custom"), sensor("", "front_sonar", "gpu_lidar"))
    assert [one.name for one in scene.sensors] == ["front_sonar"]


def test_scenes_made_from_a_scene_keep_its_sensors(read):
    scene, _ = read(sensor(scan(angles(-45, 45, 180))))
    for other in (scene.without("rock"), scene.only("rock"), scene.with_surface(2.0), scene.with_more([])):
        assert other.sensors == scene.sensors and other.sonar == scene.sonar
    assert scene.with_surface(None).surface_z_m is None and scene.without("rock").surface_z_m is None
    assert sg.Scene([]).sonar is None
    with pytest.raises(sg.Error, match="a sensor of a scene must be a SonarSensor"):
        sg.Scene([], sensors=[scene.sonar])


def test_bundled_scenes_state_no_sonar():
    """Their pictures are those of the preset."""
    for name in sg.bundled_scenes():
        scene = sg.load_scene(name)
        assert scene.sonar is None and len(scene.sensors) == 1, name


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("name", 3, "the name of a sensor must be a str (got int; such as 'sonar', or '')"),
        ("model", None, "the model of a sensor must be a str (got NoneType; such as 'rov', or '')"),
        ("pose", None, "the pose of a sensor must have shape (4, 4) (got ();"),
        ("sonar", "p900-45", "the sonar of a sensor must be a Sonar (got str;"),
        ("rate_hz", "10", "rate_hz of a sensor must be a number (got '10')"),
        ("assumed", "n_beams", "assumed of a sensor must be a tuple (got str; of names of fields)"),
    ],
)
def test_a_sensor_made_of_what_it_is_not_is_refused(field, value, message):
    with pytest.raises(sg.Error) as caught:
        sg.SonarSensor(**{"name": "sonar", "model": "rov", "pose": np.eye(4)} | {field: value})
    assert str(caught.value).startswith(message)


SENSOR = "<pose>0 0 1 0 0 0</pose>"


def test_a_custom_sensor_overrides_one_named_sonar_and_its_link_is_no_body(read_text):
    scene = read_text(
        model(link(f"<sensor name='my_sonar' type='depth'>{SENSOR}</sensor>"), "first")
        + model(
            "<pose>5 0 0 0 0 1.5707963267948966</pose>"
            + link(f"<pose>1 0 0 0 0 0</pose><sensor name='s' type='custom'>{SENSOR}</sensor>"),
            "second",
        )
    )
    np.testing.assert_allclose(scene.sonar_pose, pose(5, 1, 1, yaw=np.pi / 2), rtol=0, atol=ROUNDING)
    assert [b.name for b in scene.bodies] == ["first"]


@pytest.mark.parametrize(
    ("sensor", "name"),
    [
        ("<sensor name='front_SONAR' type='ray'/>", "m"),
        ("<sensor name='s' type='depth'><plugin name='p' filename='libnps_multibeam.so'/></sensor>", "m"),
        ("<sensor name='s' type='depth'><plugin name='FLS' filename='x'/></sensor>", "m"),
        ("<sensor name='imu' type='imu'/><sensor name='s' type='depth'/>", "p900_multibeam"),
    ],
)
def test_sensors_named_after_a_sonar(read_text, sensor, name):
    scene = read_text(model(link("<pose>1 2 3 0 0 0</pose>" + sensor), name))
    np.testing.assert_array_equal(scene.sonar_pose, pose(1, 2, 3))
    assert scene.bodies == ()


def test_the_mesh_of_the_sonar_is_not_read(read_text):
    shape = "<collision name='c'><geometry><mesh><uri>model://none/a.stl</uri></mesh></geometry></collision>"
    assert read_text(model(link("<sensor name='s' type='custom'/>", shape=shape))).bodies == ()
