"""The command line: what each option does, and what each mistake is told."""

import errno
import json
import os
import pty
import re
import shlex
import subprocess
import sys
from dataclasses import fields, replace
from pathlib import Path

import click
import cv2
import moderngl
import numpy as np
import pytest
from PIL import Image

import sonar_gl as sg
from sonar_gl.acoustics import acoustics as settings
from sonar_gl.cli import main as cli
from sonar_gl.core.poses import pose_numbers, read_poses
from sonar_gl.gl import context as gl
from sonar_gl.imaging import files as export
from sonar_gl.imaging.formats import FORMATS
from sonar_gl.scene.materials import materials
from tests.support.command_line import BODY, BOX, SENSOR, SONAR, WALL, ended, run
from tests.support.processes import HOME, python

SCENE = f'<sdf version="1.9"><world name="any">{WALL}{BOX}{{more}}</world></sdf>'
PRESET_NOTE = "sonar: preset p900-45, as the scene states none\n"
POSES = "t,x,y,z,roll,pitch,yaw\n0,0,0,0,0,0,0\n0.5,0.5,0,0,0,0,0\n1.0,1,0,0,0,0,0.1\n"


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch, timed_once):
    """A folder with a small scene, a small sonar and three poses, which is the working directory."""
    monkeypatch.chdir(tmp_path)
    Path("tank.sdf").write_text(SCENE.format(more=SENSOR))
    Path("mute.sdf").write_text(SCENE.format(more=""))
    Path("small.toml").write_text(SONAR)
    Path("dive.csv").write_text(POSES)
    return tmp_path


def render(
    *arguments, scene="tank.sdf", quick=("--sonar", "small.toml", "--tolerance", 0.05, "--height", 60)
):
    """stdout of a render that must do without a word on stderr."""
    status, out, err = run("render", scene, *quick, *arguments)
    assert (status, err) == (0, "")
    return out


def refused(*arguments, scene="tank.sdf", sonar="small.toml", command="render"):
    """The message of a render, or of another command, that must be refused."""
    status, out, err = run(command, scene, "--sonar", sonar, *arguments)
    assert (status, out) == (2, "")
    assert err.startswith("error: ") and err.endswith("\n")
    return err[7:-1]


def ping(name="tank.npz"):
    return sg.load_npz(name)


def process(*arguments, **environment):
    """A real process; its surroundings are ours and `environment`."""
    return python("-m", "sonar_gl", *arguments, environment=environment)


# --- what is written


def test_render_writes_picture_ping_and_one_line():
    out = render()
    assert sorted(p.name for p in Path().iterdir() if p.suffix in (".png", ".npz")) == [
        "tank.npz",
        "tank.png",
    ]
    got = ping()
    assert got.intensity.shape == (24, 80) and got.body_id is None and got.elevation_rad is None
    np.testing.assert_array_equal(got.pose, np.eye(4))
    assert got.meta["profile"] == "physical" and got.meta["seed"] == 0 and got.meta["scene"] == "tank"
    assert got.meta["version"] == sg.__version__ and got.meta["sonar"]["name"] == "small"
    renderer = re.escape(got.meta["gl_renderer"])
    line = r"tank\.png, tank\.npz: 24 beams x 80 bins, strongest echo (-?\d+\.\d) dB at (\d+\.\d\d) m, "
    line += rf"(\d+\.\d) deg to (port|starboard); \d+\.\d ms on {renderer}\n"
    match = re.fullmatch(line, out)
    beam, bin_ = np.unravel_index(got.intensity.argmax(), got.intensity.shape)
    assert float(match[1]) == pytest.approx(10 * np.log10(got.intensity.max()), abs=0.051)
    assert float(match[2]) == pytest.approx(got.range_m[bin_], abs=0.0051)
    signed_deg = float(match[3]) * (1 if match[4] == "port" else -1)
    assert signed_deg == pytest.approx(np.degrees(got.azimuth_rad[beam]), abs=0.051)
    wanted = sg.colorize(sg.fan_image(got, 60))
    np.testing.assert_array_equal(cv2.imread("tank.png")[..., ::-1], wanted)


def test_same_seed_same_bytes_and_another_seed_other_bytes():
    files = {}
    for name, seed in (("a", 7), ("b", 7), ("c", 8)):
        render("--noise", "physical", "--seed", seed, "--out", name)
        files[name] = [Path(name, f"tank.{f}").read_bytes() for f in ("png", "npz")]
    assert files["a"] == files["b"]
    assert all(one != other for one, other in zip(files["a"], files["c"], strict=True))
    assert ping("c/tank.npz").meta["seed"] == 8


def test_out_is_made_with_its_parents():
    assert render("--out", "new/deep").startswith("new/deep/tank.png, new/deep/tank.npz: ")
    assert Path("new/deep/tank.npz").is_file()


def test_format_may_be_one():
    render("--format", "npz", "--out", "one")
    assert [p.name for p in Path("one").iterdir()] == ["tank.npz"]
    render("--format", "png", "--out", "two")
    assert [p.name for p in Path("two").iterdir()] == ["tank.png"]


def test_every_format_has_a_file():
    """A choice of which nothing is written would go unnoticed: the command ends with status 0 and names no file."""
    given = [word for one in FORMATS for word in ("--format", one)]
    out = render("--poses", "dive.csv", *given, "--out", "all")
    for one in FORMATS:
        assert list(Path("all").glob(f"*.{one}")) and f".{one}" in out, (
            f"render writes no {one} (FrameWriter)"
        )


def test_range_keeps_the_bin_and_bins_sets_their_number():
    render("--range", 5.5, "--format", "npz")
    got = ping()
    assert got.meta["sonar"]["range_max_m"] == 5.5 and got.intensity.shape == (24, 50)
    assert got.bin_size_m == pytest.approx(0.1, abs=1e-12)
    render("--range", 5.5, "--bins", 16, "--format", "npz")
    got = ping()
    assert got.intensity.shape == (24, 16) and got.bin_size_m == pytest.approx(0.3125, abs=1e-12)


def test_pose_takes_the_place_of_the_scenes():
    render("--pose", "-1 0 0 0 0 0.1", "--format", "npz")
    np.testing.assert_array_equal(ping().pose, sg.pose(x=-1, yaw=0.1))
    render("--pose", "1,0,0,0,0,0", scene="mute.sdf")
    np.testing.assert_array_equal(ping("mute.npz").pose, sg.pose(x=1))


@pytest.mark.usefixtures("few_first_rays")
def test_without_a_sonar_the_scenes_own_is_taken_and_named():
    angles = "<samples>{}</samples><min_angle>-{}</min_angle><max_angle>{}</max_angle>".format
    ray = (
        f"<ray><scan><horizontal>{angles(24, 0.35, 0.35)}</horizontal><vertical>{angles(5, 0.1, 0.1)}</vertical></scan>"
        "<range><min>0.5</min><max>8.5</max><resolution>0.1</resolution></range></ray><update_rate>10</update_rate>"
    )
    own = SENSOR.replace(
        'type="custom"/>', f'type="custom">{ray}</sensor><sensor name="old_sonar" type="ray"/>'
    )
    Path("own.sdf").write_text(SCENE.format(more=own))
    quick = ("--tolerance", 0.5, "--format", "npz")
    for command, more in (
        ("render", quick),
        ("plan", quick[:2]),
        ("verify", ("--tolerance", 0.5, "--height", 60, "--profile", "ideal")),
    ):
        status, _, err = run(command, "own.sdf", *more)
        if command == "verify":
            err, progress, _ = err.partition("casting rays, ")
            assert progress
        assert status == 0 and err == (
            "sonar: the scene's own, sensor 'imaging_sonar' of model 'sonar': 40.11 x 11.46 deg, 24 beams, "
            "0.5 to 8.5 m in 80 bins, 900 kHz, 10 Hz (frequency of p900-45: the sensor states none); "
            "not taken: sensor 'old_sonar' of model 'sonar'\n"
        )
    made = ping("own.npz").sonar
    assert made == sg.load_scene(
        "own.sdf"
    ).sonar and made.source == "own.sdf: world/model[sonar]/link[link]/" + ("sensor[imaging_sonar]")
    assert run("render", "own.sdf", *quick, "--range", 4.5, "--bins", 20)[0] == 0
    changed = ping("own.npz").sonar
    assert (changed.n_beams, changed.range_max_m, changed.n_bins) == (24, 4.5, 20)
    render("--format", "npz", scene="own.sdf")  # with --sonar, and so without a note
    assert ping("own.npz").sonar == sg.load_sonar("small.toml")
    assert run("render", "tank.sdf", *quick)[2] == PRESET_NOTE
    assert ping().sonar == sg.load_sonar("p900-45")


@pytest.mark.slow
def test_profile_is_that_of_the_simulator():
    """A whole device has its noise, too, unless there is to be none; the other profiles have none."""
    scene, sonar = sg.load_scene("tank.sdf"), sg.load_sonar("small.toml")
    for name in settings.PROFILES:
        own = sg.Noise.physical() if name == "physical" else None
        with sg.Simulator(scene, sonar, sg.Acoustics(name), tolerance=0.05) as simulator:
            for options, noise in (
                ((), own),
                (("--noise", "none"), None),
                (("--noise", "physical"), sg.Noise.physical()),
            ):
                render("--profile", name, *options, "--format", "npz")
                np.testing.assert_array_equal(ping().intensity, simulator.ping(np.eye(4), noise).intensity)
                assert ping().meta["profile"] == name


def test_range_law_is_that_of_the_paper_s_profile():
    scene, sonar = sg.load_scene("tank.sdf"), sg.load_sonar("small.toml")
    for law in ("printed", "constant", "inverse"):
        render("--profile", "demarco2015", "--range-law", law, "--format", "npz")
        acoustics = sg.Acoustics.demarco2015(law)
        with sg.Simulator(scene, sonar, acoustics, tolerance=0.05) as simulator:
            np.testing.assert_array_equal(ping().intensity, simulator.ping(np.eye(4)).intensity)


def test_choices_are_those_of_the_modules():
    choices = {p.name: getattr(p.type, "choices", None) for p in cli.render.params}
    assert list(choices["profile"]) == list(settings.PROFILES)
    assert set(choices["formats"]) == set(FORMATS) == {"png", "npz", "gif", "mp4"}


def test_noise_in_words_and_amounts():
    render("--noise", "gaussian=0.25,median=3", "--format", "npz")
    assert ping().meta["noise"] == {**NO_NOISE, "gaussian": 0.25, "median": 3}
    render("--noise", "demarco2015", "--format", "npz")
    assert ping().meta["noise"]["salt_and_pepper"] == 0.005
    render("--noise", "none", "--format", "npz")
    assert "noise" not in ping().meta


NO_NOISE = {f.name: f.default for f in fields(sg.Noise)}


def test_tolerance_chooses_the_samples():
    rows = []
    for tolerance in (0.05, 0.005):
        render("--tolerance", tolerance, "--format", "npz", quick=("--sonar", "small.toml"))
        rows.append(ping().meta["sampling"]["rows"])
    assert rows[0] < rows[1]


def test_labels_name_bodies():
    out = render("--labels", "--profile", "ideal", "--format", "npz")
    got = ping()
    assert got.body_id.shape == got.elevation_rad.shape == (24, 80)
    assert set(np.unique(got.body_id)) == {0, 1, 2}
    box = np.argwhere(got.body_id == 2)
    assert (got.azimuth_rad[box[:, 0]] > 0).all()  # the box is to port
    assert re.search(r" deg to \w+, of '(wall|box)'; ", out)


def test_labels_from_a_level_on():
    render("--labels", "--profile", "ideal", "--format", "npz")
    shown = ping()
    render("--labels", "--label-level", -15, "--profile", "ideal", "--format", "npz")
    bright = ping()
    assert bright.meta["label_level_db"] == -15
    expected = np.where(bright.intensity >= np.float32(10**-1.5), shown.body_id, 0)
    np.testing.assert_array_equal(bright.body_id, expected)
    assert 0 < (bright.body_id > 0).sum() < (shown.body_id > 0).sum()


def test_fan_options_change_the_picture():
    render("--format", "npz")
    got = ping()

    def draw(counts):
        return sg.colorize(sg.fan_image(got, 60, counts))

    for options, wanted in (
        (("--height", 90), sg.colorize(sg.fan_image(got, 90))),
        (("--counts", "law=power,exponent=1"), draw(sg.Counts("power", exponent=1.0))),
        (("--counts", "low_db=-40,high_db=-10"), draw(sg.Counts(low_db=-40, high_db=-10))),
        (("--counts", "gain_percentile=90"), draw(sg.Counts(gain_percentile=90))),
        (("--colormap", "viridis"), sg.colorize(sg.fan_image(got, 60), "viridis")),
        (("--axes",), sg.draw_axes(sg.colorize(sg.fan_image(got, 60)), got, "copper")),
    ):
        render(*options, "--format", "png")
        np.testing.assert_array_equal(cv2.imread("tank.png")[..., ::-1], wanted, err_msg=str(options))


def test_counts_are_recorded_and_presets_have_their_own():
    render("--format", "npz", "--counts", "law=power,gain_percentile=97,bits=16")
    assert ping().sonar.counts == sg.Counts("power", gain_percentile=97, bits=16)
    assert ping().counts().dtype == np.uint16
    render("--format", "npz", "--sonar", "oculus-m1200d-hf", "--bins", 80, "--counts", "gain_db=40")
    assert ping().sonar.counts == sg.Counts("power", gain_db=40)


def test_gray_pictures_hold_16_bits():
    render("--counts", "bits=16", "--colormap", "gray")
    got = ping()
    law = got.counts_law()
    written = cv2.imread("tank.png", cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(written, law.counts_of(sg.fan_image(got, 60)))
    assert law.bits == 16 and written.dtype == np.uint16 and len(np.unique(written)) > 256


@pytest.mark.parametrize(
    ("options", "lacking"),
    [
        ((), "colormap copper"),
        (("--colormap", "gray", "--axes"), "axes"),
        (("--colormap", "gray", "--poses", "dive.csv", "--format", "png", "--format", "gif"), "format gif"),
        (("--poses", "dive.csv", "--format", "mp4"), "format mp4"),
    ],
)
def test_16_bits_that_no_picture_would_hold(options, lacking):
    assert refused("--counts", "bits=16", *options) == (
        "--counts bits=16 needs gray PNG pictures without axes, since others have 8 bits "
        f"(got --{lacking}; give --colormap gray --format png, or --format npz)"
    )
    assert not list(Path().glob("tank*.png"))


def test_a_sonar_of_16_bits_is_shown_in_colour_and_in_films():
    text = Path("small.toml").read_text()
    Path("deep.toml").write_text(text + "counts = { bits = 16 }\n")
    quick = ("--sonar", "deep.toml", "--tolerance", 0.05, "--height", 60)
    render("--format", "png", quick=quick)
    assert cv2.imread("tank.png", cv2.IMREAD_UNCHANGED).dtype == np.uint8
    films = "--format", "png", "--format", "gif", "--poses", "dive.csv"
    render(*films, "--colormap", "gray", quick=quick)
    still = cv2.imread("tank_0000.png", cv2.IMREAD_UNCHANGED)
    assert still.dtype == np.uint16
    with Image.open("tank.gif") as film:
        np.testing.assert_array_equal(np.asarray(film.convert("L")), np.rint(still / 257))


@pytest.mark.slow
def test_demarco_style_is_the_founding_papers_picture():
    scene, sonar = sg.load_scene("tank.sdf"), sg.load_sonar("small.toml")
    with sg.Simulator(scene, sonar, sg.Acoustics.demarco2015(), tolerance=0.05) as simulator:
        for options, settings in (
            (("--seed", 3), {"seed": 3}),
            (("--noise", "none", "--form", "printed"), {"noise": sg.Noise.none(), "form": "printed"}),
            (("--noise", "none", "--join", "polygons"), {"noise": sg.Noise.none(), "join": "polygons"}),
        ):
            render("--style", "demarco2015", *options)
            wanted = sg.demarco_image(simulator, np.eye(4), height=60, **settings)
            np.testing.assert_array_equal(cv2.imread("tank.png")[..., ::-1], wanted, err_msg=str(options))
            assert ping().meta["profile"] == "demarco2015"
    assert "noise" not in ping().meta
    render("--style", "demarco2015", "--profile", "ideal")
    assert ping().meta["profile"] == "ideal" and ping().meta["noise"]["cloud_gaussian_m"] == 0.01


def test_sequence_is_numbered_and_each_ping_is_that_of_its_pose():
    out = render("--poses", "dive.csv", "--noise", "physical", "--seed", 5)
    assert out.startswith("tank_0000..0002.png, tank_0000..0002.npz: 24 beams x 80 bins, strongest echo ")
    assert re.search(r" in ping [012]; \d+\.\d ms a ping on ", out)
    times_s, poses = read_poses("dive.csv")
    scene, sonar = sg.load_scene("tank.sdf"), sg.load_sonar("small.toml")
    with sg.Simulator(scene, sonar, tolerance=0.05) as simulator:
        simulator.plan(poses)
        for n in range(3):
            got = ping(f"tank_{n:04d}.npz")
            wanted = simulator.ping(poses[n], noise=sg.Noise.physical(), seed=5, ping_number=n)
            np.testing.assert_array_equal(got.intensity, wanted.intensity)
            np.testing.assert_array_equal(got.pose, poses[n])
            assert got.meta["time_s"] == times_s[n] and got.meta["ping_number"] == n
            picture = sg.colorize(sg.fan_image(wanted, 60))
            np.testing.assert_array_equal(cv2.imread(f"tank_{n:04d}.png")[..., ::-1], picture)
    assert not Path("tank.png").exists() and not Path("tank_0003.png").exists()


def test_demarco_sequence_has_other_noise_in_each_frame():
    Path("still.csv").write_text("t,x,y,z,roll,pitch,yaw\n0,0,0,0,0,0,0\n1,0,0,0,0,0,0\n")
    render("--poses", "still.csv", "--style", "demarco2015", "--format", "png")
    assert Path("tank_0000.png").read_bytes() != Path("tank_0001.png").read_bytes()


def test_films_have_every_frame_and_their_rate():
    render("--poses", "dive.csv", "--format", "gif", "--format", "mp4", "--format", "npz", "--fps", 4)
    with Image.open("tank.gif") as film:
        assert film.n_frames == 3 and film.info["duration"] == 250
        first = np.array(film.convert("RGB"))
    np.testing.assert_array_equal(first, sg.colorize(sg.fan_image(ping("tank_0000.npz"), 60)))
    film = cv2.VideoCapture("tank.mp4")
    assert film.get(cv2.CAP_PROP_FRAME_COUNT) == 3 and film.get(cv2.CAP_PROP_FPS) == 4
    assert len(list(Path().glob("*.npz"))) == 3 and not list(Path().glob("*.png"))


def test_bodies_and_surface_by_options():
    def bodies(*options):
        status, _, err = run("render", "pylon", "--tolerance", 0.1, "--format", "npz", *options)
        assert status == 0, err
        return sg.load_npz("pylon.npz").meta["bodies"]

    everything = bodies()
    assert bodies("--without", "pylon_*") == [name for name in everything if not name.startswith("pylon_")]
    assert bodies("--only", "box", "--only", "floor") == [
        name for name in everything if name in ("box", "floor")
    ]
    status, out, err = run("render", "pylon", "--without", "bix")
    assert (status, out) == (2, "") and "(got 'bix'; did you mean 'box'?)" in err
    for command in ("render", "plan", "verify"):
        status, out, err = run(command, "pylon", "--without", "*")
        everybody = f"all {len(everything)} bodies of scene 'pylon'"
        assert (status, out, err) == (
            2,
            "",
            f"error: --without and --only must leave a body (they leave out {everybody}; 'sonar-gl doctor --scene' "
            "lists them)\n",
        )
    Path("one.sdf").write_text(f'<sdf version="1.9"><world name="one">{WALL}{SENSOR}</world></sdf>')
    assert run("render", "one.sdf", "--without", "wall")[2] == (
        "error: --without and --only must leave a body (they leave out 'wall', the only body of scene 'one'; "
        "'sonar-gl doctor --scene' lists them)\n"
    )
    assert run("doctor", "--scene", "diver", "--only", "diver::bubbles")[0] == 2


def test_the_surface_by_option_is_that_of_the_scene():
    """The surface mirrors echoes."""
    pings = {}
    for name, options in {"scene": (), "option": ("--surface", "0.2")}.items():
        render("--format", "npz", "--acoustics", "multipath=incoherent", *options)
        pings[name] = ping("tank.npz")
    scene, sonar = sg.load_scene("tank.sdf").with_surface(0.2), sg.load_sonar("small.toml")
    acoustics = sg.Acoustics.parse("multipath=incoherent", "physical")
    with sg.Simulator(scene, sonar, acoustics, tolerance=0.05) as simulator:
        expected = simulator.ping(scene.sonar_pose, sg.Noise.physical())
    np.testing.assert_array_equal(pings["option"].intensity, expected.intensity)
    assert not np.array_equal(pings["option"].intensity, pings["scene"].intensity)
    assert pings["option"].meta["sampling"] == expected.meta["sampling"]


def test_resource_path_and_skip_missing():
    more = "<include><uri>model://rock</uri><pose>2 -0.5 0 0 0 0</pose></include>" + SENSOR
    Path("reef.sdf").write_text(SCENE.format(more=more))
    Path("shelf/rock").mkdir(parents=True)
    rock = BODY.format("rock", "0 0 0", "0.2 0.2 0.2")
    Path("shelf/rock/model.sdf").write_text(f'<sdf version="1.9">{rock}</sdf>')
    render("--resource-path", "shelf", "--format", "npz", scene="reef.sdf")
    assert ping("reef.npz").meta["bodies"] == ["wall", "box", "rock"]
    quick = ("--sonar", "small.toml", "--tolerance", 0.05, "--format", "npz")
    status, _, err = run("render", "reef.sdf", "--skip-missing", *quick)
    here = Path().resolve()
    assert (status, err) == (
        0,
        "warning: reef.sdf: read without what is missing (model://rock)\n",
    )
    assert ping("reef.npz").meta["bodies"] == ["wall", "box"]
    assert refused(scene="reef.sdf") == (
        "reef.sdf: models or files are missing:\n  model://rock\n    named by reef.sdf: world/"
        f"include[model://rock]\n    not at {here}/rock\nGive the folders that hold them (--resource-path, "
        "resource_paths=), or carry on without them (--skip-missing, skip_missing=True)."
    )


def test_empty_ping_warns_on_one_line():
    quick = "render tank.sdf --sonar small.toml --tolerance 0.05 --height 40 --noise none --pose"
    status, out, err = run(*quick.split(), "0 0 0 0 0 3.14159265")
    assert status == 0 and "80 bins, no echo; " in out
    assert re.fullmatch(
        r"warning: no echo came back: no surface lies in the fan; the nearest is 'box', .*\n", err
    )
    assert not ping().intensity.any()
    assert cv2.imread("tank.png").shape[0] == 40


def test_a_warning_is_told_once():
    Path("still.csv").write_text("t,x,y,z,roll,pitch,yaw\n" + "0,0,0,0,0,0,3.14159265\n" * 3)
    _, _, err = run("render", "tank.sdf", "--sonar", "small.toml", "--poses", "still.csv", "--format", "npz")
    assert err.count("warning: ") == err.count("\n") == 1


# --- the other commands


def test_scenes_lists_every_bundled_scene_with_its_description():
    status, out, _ = run("scenes")
    assert status == 0
    names = [line.split()[0] for line in out.splitlines() if line[0] != " "]
    assert names == list(sg.bundled_scenes())
    assert "Two bridge pylons, one round and one square" in " ".join(out.split())


def test_sonars_lists_every_preset():
    status, out, _ = run("sonars")
    assert status == 0
    lines = {line.split()[0]: " ".join(line.split()[1:]) for line in out.splitlines()[1:]}
    assert list(lines) == list(sg.presets())
    assert lines["p900-45"] == "256 45 x 20 900 0.5 to 29.99 25.4"
    assert max(map(len, out.splitlines())) <= 80


def test_sonars_writes_a_sonar_as_a_file(tmp_path):
    status, out, _ = run("sonars", "P900-45,receive_taper=hamming")
    assert status == 0
    (tmp_path / "mine.toml").write_text(out)
    assert sg.load_sonar(tmp_path / "mine.toml") == sg.load_sonar("p900-45,receive_taper=hamming")


def scene_with_a_sonar() -> str:
    """Return an SDF file whose sensor describes a sonar."""
    across = "<samples>64</samples><min_angle>-0.5</min_angle><max_angle>0.5</max_angle>"
    ray = f"<scan><horizontal>{across}</horizontal></scan><range><min>1</min><max>20</max></range>"
    sensor = f'<link name="l"><sensor name="sonar" type="ray"><ray>{ray}</ray></sensor></link>'
    return SCENE.format(more=f'<model name="rov">{sensor}</model>')


def test_sonars_writes_the_sonar_of_a_scene_as_a_file(tmp_path):
    (tmp_path / "rov.sdf").write_text(scene_with_a_sonar())
    status, out, _ = run("sonars", "--scene", tmp_path / "rov.sdf")
    assert status == 0 and out.startswith(
        "# sensor 'sonar' of model 'rov': 57.3 x 20 deg, 64 beams, 1 to 20 m"
    )
    (tmp_path / "mine.toml").write_text(out)
    assert sg.load_sonar(tmp_path / "mine.toml") == sg.load_scene(tmp_path / "rov.sdf").sonar


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ["--scene", "pylon"],
            "scene 'pylon' must have a sonar that the tags of its sensor describe (got sensor 'imaging_sonar' of model "
            "'sonar', whose tags do not; ",
        ),
        (["p900-45", "--scene", "pylon"], "SONAR and --scene exclude each other (leave one out)"),
        (
            ["--skip-missing"],
            "--resource-path and --skip-missing need --scene (they say how a scene is read)",
        ),
        (["p900"], "unknown sonar (got 'p900'; "),
    ],
)
def test_sonars_refuses_what_it_cannot_write(arguments, message):
    status, out, err = run("sonars", *arguments)
    assert status == 2 and not out and message in err


def test_materials_lists_every_material_with_its_reflection_echo_and_source():
    status, out, _ = run("materials")
    assert status == 0
    table, note, sources = out.rstrip("\n").split("\n\n")
    lines = {line.split()[0]: " ".join(line.split()[1:]) for line in table.splitlines()[1:]}
    assert sorted(lines) == sorted(materials())
    # |R|² of the impedances; 10 log of 0.845 / (8 · 0.1²) + 0.031, and of 0.031 cos 60° where the lobe has ended
    assert lines["steel"] == "30.1 0.875 0.031 0.845 0.1 10.2 -18.2 0.025"
    assert lines["sand"] == lines["medium_sand"] == "2.17 0.137 0.137 - - -8.6 -11.6 rough"
    assert lines["water_surface"].endswith(" 9.4 - 0")  # a perfect reflector scatters nothing to 60°
    assert "900 kHz" in note
    listed = " ".join(sources.split())
    assert all(one.source in listed for one in materials().values())
    assert max(map(len, out.splitlines())) <= 100


HEAVY = (
    "numpy",
    "scipy",
    "numba",
    "llvmlite",
    "trimesh",
    "cv2",
    "moderngl",
    "glcontext",
    "PIL",
    "pydantic",
    "tqdm",
)


def examples():
    """Every command line that a `--help` shows, but those of `batch`, which need a job."""
    for name, command in cli.main.commands.items():
        lines = re.findall(rf"sonar-gl ({name}\b.*)", command.epilog)
        assert lines, name
        if name != "batch":
            yield from lines


@pytest.mark.slow
@pytest.mark.parametrize("line", [line for line in examples() if line != "doctor"])
def test_examples_of_the_help_show_something(line):
    """Nearly empty pictures would warn."""
    x, y, z, *angles = pose_numbers(sg.load_scene("pylon").sonar_pose)
    rows = [f"{n},{x + n},{y},{z},{','.join(map(str, angles))}" for n in range(2)]
    Path("dive.csv").write_text("\n".join(["t,x,y,z,roll,pitch,yaw", *rows]))
    Path("world.sdf").write_text(scene_with_a_sonar())
    line, _, file = line.partition(" > ")
    words = ended(shlex.split(line), 1.0)
    status, out, err = run(*words)
    if file:
        Path(file).write_text(out)
        assert status == 0 and sg.load_sonar(file)
    if words[0] == "view":
        assert status == 0 and "the page is at http://127.0.0.1:" in err
        return
    if words[0] in ("emulate", "ros2"):
        assert status == 0 and re.search(" sent, | pings published, ", out)
        return
    if words[0] == "verify":
        err, progress, _ = err.partition("casting rays, ")
        assert progress
    says_preset = line.startswith(("render", "plan", "verify")) and "--sonar" not in line
    assert (status, err) == (0, PRESET_NOTE if says_preset else "")
    if line.startswith("verify"):
        rays = re.search(r'"reference_rays": (\d+)|([\d.]+) million rays', out)
        assert (float(rays[1]) if rays[1] else 1e6 * float(rays[2])) < 1e7  # some seconds
    if line.startswith("render"):
        assert [path for path in Path().rglob("*.[pg][ni][gf]") if path.stat().st_size > 5000]


def test_version_and_help_with_an_example():
    assert run("--version")[1] == f"sonar-gl, version {sg.__version__}\n"
    assert run()[0] in (0, 2) and "render" in run("--help")[1]
    for name, command in cli.main.commands.items():
        status, out, _ = run(name, "--help")
        assert status == 0 and f"sonar-gl {name}" in out and "Example" in out, name
        assert not [p.name for p in command.params if isinstance(p, click.Option) and not p.help], name


def test_help_of_every_command_loads_no_library_but_click():
    """Nor what reads the metadata of packages, for the messages of missing ones."""
    code = f"""
import sys
from sonar_gl.cli.main import main
for name in main.commands:
    main([name, "--help"], standalone_mode=False)
print("loaded", *(name for name in {[*HEAVY, "importlib.metadata", "urllib.request"]} if name in sys.modules))
"""
    done = python("-c", code, check=True, encoding="utf-8")  # of commands, whatever the locale
    assert done.stdout.splitlines()[-1] == "loaded"


def test_lists_are_quick_for_they_load_no_numba():
    code = """
import sys
from sonar_gl.cli.main import main
for name in ("scenes", "sonars", "materials"):
    main([name], standalone_mode=False)
print("loaded", *(name for name in ("numba", "moderngl", "cv2", "trimesh") if name in sys.modules))
"""
    done = python("-c", code, check=True)
    assert done.stdout.splitlines()[-1] == "loaded"


@pytest.mark.slow
def test_the_garbage_collector_passes_over_the_modules_of_a_command():
    code = """
import gc
from sonar_gl import cli
runs = []
gc.callbacks.append(lambda phase, info: runs.append(phase))
cli.render
print(len(runs), gc.isenabled(), gc.get_freeze_count() > 50_000, len(gc.get_objects()) < 1000)
assert not hasattr(cli, "rendered") and gc.isenabled()
"""
    done = python("-c", code, check=True)
    assert done.stdout.split() == ["0", "True", "True", "True"]


def test_import_is_quick_for_it_loads_no_library():
    code = f"import sys, sonar_gl; print(*[name for name in {[*HEAVY, 'click']} if name in sys.modules])"
    done = python("-c", code, check=True)
    assert done.stdout.split() == []


@pytest.mark.slow
def test_numba_is_loaded_without_scipy_which_is_there_all_the_same():
    code = """
import sys
from sonar_gl.core.load_numba import load_numba
load_numba()
print("scipy.linalg" in sys.modules, "numba.np.arraymath" in sys.modules)
import scipy.linalg.cython_blas
from numba.np.linalg import ensure_blas
ensure_blas()
"""
    done = python("-c", code)
    assert (done.returncode, done.stdout) == (0, "False True\n"), done.stderr


# --- mistakes


def test_a_number_of_threads_without_which_numba_is_not_loaded():
    """Early versions ended in Numba's traceback, which does not name the variable."""
    for text in ("0", "-2"):
        done = python("-m", "sonar_gl", "plan", "pylon", environment={"NUMBA_NUM_THREADS": text})
        message = f"NUMBA_NUM_THREADS must be 1 or more, or unset (got {text}; unset it)"
        assert (done.returncode, done.stderr) == (2, f"error: {message}\n")


def test_scene_files_that_cannot_be_read():
    Path("broken.sdf").write_text("<sdf><world>\n<model></sdf>")
    assert refused(scene="broken.sdf") == "broken.sdf: line 2, column 10: broken XML (mismatched tag)"
    Path("latin.sdf").write_bytes("<sdf><world><model name='é'/></world></sdf>".encode("latin-1"))
    message = refused(scene="latin.sdf")
    assert message == "latin.sdf: line 1, column 26: broken XML (not well-formed (invalid token))"


def test_a_pose_beyond_all_seas_is_refused():
    """Its squares overflowed, with warnings of NumPy."""
    assert refused("--pose", "1e300 0 0 0 0 0") == (
        "pose must lie within 1e+09 m of the origin (got x y z = 1e+300 0 0; give metres)"
    )


def test_a_working_directory_that_is_gone_is_named(folder):
    (folder / "gone").mkdir()
    os.chdir(folder / "gone")
    (folder / "gone").rmdir()
    status, out, err = run("render", "pylon", "--sonar", "mine.toml")
    assert (status, out) == (2, "")
    assert err == "error: the working directory must exist (it has been removed; change to another folder)\n"


def test_a_missing_folder_for_temporary_files_is_named(monkeypatch):
    """A dry run said that the working directory had been removed, in a container where nothing can be written to."""

    def none(*_):
        raise FileNotFoundError(errno.ENOENT, "No usable temporary directory found in ['/tmp', '/']")

    monkeypatch.setattr("sonar_gl.cli.listings.scenes_text", none)
    assert run("scenes") == (
        2,
        "",
        "error: a folder for temporary files must be there (got none that can be written to; set TMPDIR to one)\n",
    )


@pytest.mark.parametrize(("name", "where"), [(None, "files"), ("a.npz", "a.npz")])
def test_the_limit_of_open_files_is_named(monkeypatch, name, where):
    def refuse(*_):
        raise OSError(errno.EMFILE, os.strerror(errno.EMFILE), name)

    monkeypatch.setattr("sonar_gl.cli.listings.scenes_text", refuse)
    cure = "raise the limit of open files, as by 'ulimit -n 1024'"
    assert run("scenes") == (2, "", f"error: {where}: Too many open files; {cure}\n")


@pytest.mark.slow
def test_a_mistake_has_its_status_where_errors_cannot_be_written():
    with open("/dev/full", "w") as full:
        ran = python("-m", "sonar_gl", "batch", "nope.toml", capture_output=False, stderr=full)
    assert ran.returncode == 2


def test_an_output_that_takes_nothing_is_named():
    with open("/dev/full", "w") as full:
        ran = python("-m", "sonar_gl", "sonars", capture_output=False, stdout=full, stderr=subprocess.PIPE)
    message = "error: the standard output must be writable (got no space left on device)\n"
    assert (ran.returncode, ran.stderr) == (2, message)


def test_poses_that_make_no_sense():
    six = "--pose must be 6 numbers, 'x y z roll pitch yaw'"
    assert refused("--pose", "1 2 3") == f"{six} (got 3: '1 2 3')"
    assert refused("--pose", "") == f"{six} (got 0: '')"
    assert refused("--pose", "0 0 0 0 0 north") == f"{six} (got '0 0 0 0 0 north')"
    assert refused("--pose", "0 0 0 0 0 nan") == (
        "--pose '0 0 0 0 0 nan': pose x y z roll pitch yaw must be finite (got NaN or infinity "
        "in 1 of 6 numbers)"
    )
    assert refused("--pose", "0 0 0 0 12 90") == (
        "--pose '0 0 0 0 12 90': pose angles must be radians, within ±2π (got roll pitch yaw = 0 12 90; "
        "if these are degrees, multiply by π/180; if one is the sum of many turns, wrap it: "
        "math.remainder(yaw, 2 * math.pi))"
    )
    assert refused(scene="mute.sdf") == (
        "scene 'mute' has no sonar in it; give its place with --pose "
        '"x y z roll pitch yaw", metres and radians'
    )


@pytest.mark.parametrize("command", [("render",), ("plan",), ("ros2",), ("emulate", "oculus")])
@pytest.mark.parametrize(
    "words", [("1", "2", "3", "0", "0", "0"), ("-4", "1", "-6", "0", ".3", "0"), ("-1e1,", "0")]
)
def test_a_pose_without_quotes(command, words):
    """The second number was "unexpected extra argument", or, below zero, "no such option"."""
    must = 'error: --pose must be 6 numbers in quotes: --pose "x y z roll pitch yaw"'
    message = f"{must} (got {words[0]} {words[1]} ...)\n"
    assert run(*command, "pylon", "--pose", *words) == (2, "", message)


def test_ranges_and_bins_that_no_sonar_has():
    assert refused("--bins", 0) == "sonar 'small': n_bins must be a whole number in 1..65536 (got 0)"
    far = refused("--range", 8000)
    assert far.startswith(
        "sonar 'small': the range must not exceed 6554 m with bins of 0.1 m, of which a sonar has 65536"
    )
    assert (
        run("render", "tank.sdf", "--sonar", "small.toml", "--range", 8000, "--bins", 100, "--format", "npz")[
            0
        ]
        == 0
    )
    for text in ("0.5", "nan", "-3"):
        assert refused("--range", text) == (
            f"sonar 'small': the range must exceed range_min_m = 0.5 m (got {text})"
        )


@pytest.mark.parametrize("command", ["render", "verify", "view"])
def test_the_name_of_a_file_is_refused_as_output_folder(command, folder):
    """`--out p.png` made a folder p.png; one that is there may be meant."""
    for name in "p.png", "deep/P.NPZ":
        assert refused("--out", name, command=command) == (
            f"--out must be a folder (got {name!r}; the files in it are named after the scene)"
        )
    if command == "render":
        Path("p.png").mkdir()
        assert "p.png/tank.npz: " in render("--out", "p.png", "--format", "npz")


def test_the_home_folder_is_found_where_the_shell_leaves_its_sign(folder, monkeypatch):
    """A shell replaces the sign in `--out ~/x`, not in `--out=~/x`, which made a folder of the name ~."""
    monkeypatch.setenv("HOME", str(folder / "home"))
    Path("home").mkdir()
    Path("dive.csv").rename("home/dive.csv")
    Path("small.toml").rename("home/small.toml")
    out = render("--out=~/x", "--poses=~/dive.csv", "--sonar=~/small.toml", "--format", "npz")
    assert out.startswith(f"{folder}/home/x/tank_0000..0002.npz: ") and not Path("~").exists()


@pytest.mark.parametrize("option", ["out", "poses", "resource-path"])
def test_a_path_of_no_characters_is_refused(option):
    """As of a variable of the shell that is not set; such a path was taken for the working directory."""
    assert refused(f"--{option}", "") == (
        f"--{option} must be a path (got an empty text; is a variable of the shell empty?)"
    )
    assert refused(scene="") == "SCENE must be a path (got an empty text; is a variable of the shell empty?)"


def test_disk_full_and_permission_denied(monkeypatch):
    for number, reason in ((errno.ENOSPC, "no space left on device"), (errno.EACCES, "permission denied")):

        def full(path, data, number=number):
            raise OSError(number, os.strerror(number), str(path))

        with monkeypatch.context() as patch:
            patch.setattr(export.Path, "write_bytes", full)
            assert refused("--out", "there") == f"cannot write into the folder 'there': {reason}"


def test_unknown_names_of_options():
    assert refused("--colormap", "jett") == "unknown colour map (got 'jett'; did you mean 'jet'?)"
    assert refused("--noise", "phisical").startswith(
        "noise 'phisical': unknown name (got 'phisical'; did you mean 'physical'"
    )
    assert refused("--noise", "gaussian=x") == ("noise 'gaussian=x': gaussian must be a number (got 'x')")
    for option, value, known in (
        ("style", "cubist", "'fan', 'demarco2015'"),
        ("profile", "real", "'ideal', 'demarco2015', 'physical'"),
        ("format", "bmp", "'png', 'npz', 'gif', 'mp4'"),
    ):
        status, out, err = run("render", "tank.sdf", f"--{option}", value)
        assert (status, out) == (2, "")
        assert f"Error: Invalid value for '--{option}': '{value}' is not one of {known}." in err


def test_numbers_out_of_range():
    assert refused("--tolerance", 0.9) == (
        "tolerance must be a number in 0.001..0.5 (got 0.9; 0.01 is one per cent)"
    )
    assert (
        refused("--height", 0)
        == "height of a fan image must be a whole number in 1..16000 (got 0; give pixels)"
    )
    assert refused("--seed", -1) == "seed must be a whole number, 0 or more (got -1)"
    assert refused("--counts", "exponent=0.3") == (
        "counts: exponent needs the law 'power' (got the law 'db')"
    )
    assert "did you mean 'gain_db'" in refused("--counts", "gain_bd=3")
    assert refused("--db-range", "-50 0") == (
        '--db-range is no option any more; give --counts "law=db,low_db=-50,high_db=0"'
    )
    assert refused("--scale", "db").startswith("--scale is no option any more; give --counts law=db, or ")
    assert refused("--poses", "dive.csv", "--format", "gif", "--fps", 0) == (
        "fps of an animation must lie in 0.01..120 (got 0)"
    )
    films = "--format", "mp4", "--format", "gif"
    assert refused("--poses", "dive.csv", *films, "--fps", 120, "--out", "new") == (
        "fps of a GIF must lie in 0.01..100 (got 120; give fewer, or save an .mp4)"
    )
    assert not Path("new").exists()  # nothing was begun


def test_options_that_do_not_go_together():
    paper = ("--style", "demarco2015")
    for options, message in (
        (
            ("--range-law", "constant"),
            "--range-law needs --profile demarco2015 (got --profile physical)",
        ),
        (("--form", "printed"), "--form needs --style demarco2015 (got --style fan)"),
        (("--join", "circles"), "--join needs --style demarco2015 (got --style fan)"),
        ((*paper, "--axes"), "--axes needs --style fan (got --style demarco2015)"),
        ((*paper, "--counts", "law=db"), "--counts needs --style fan (got --style demarco2015)"),
        ((*paper, "--colormap", "hot"), "--colormap needs --style fan (got --style demarco2015)"),
        (
            ("--pose", "0 0 0 0 0 0", "--poses", "dive.csv"),
            "--pose and --poses exclude each other (the file of --poses has all poses; leave one out)",
        ),
        (
            ("--format", "mp4"),
            "--format mp4 needs --poses (a film needs a sequence of poses)",
        ),
        (("--labels", "--format", "png"), "--labels needs --format npz (no other file holds labels)"),
        (("--fps", "5"), "--fps needs --format gif or --format mp4 (nothing else has frames)"),
    ):
        assert refused(*options) == message


@pytest.mark.parametrize("command", ["render", "plan", "verify", "view", "ros2", "batch"])
def test_a_device_is_refused_where_the_engine_draws_on_none(command, monkeypatch):
    told = (
        "--device must not be given with the engine cpu, which needs no OpenGL device (got 1; leave it out, or give "
        "--engine opengl)"
    )
    what = "job.toml" if command == "batch" else "tank.sdf"
    monkeypatch.setenv("SONAR_GL_ENGINE", "opengl")
    for options in (("--engine", "cpu", "--device", 1), ("--device", 1, "--engine", "cpu")):
        assert run(command, what, *options) == (2, "", f"error: {told}\n")
    monkeypatch.setenv("SONAR_GL_ENGINE", "cpu")
    assert run(command, what, "--device", 1) == (2, "", f"error: {told}\n")


def test_the_variable_of_a_device_does_no_harm_beside_the_engine_cpu(monkeypatch):
    monkeypatch.setenv("SONAR_GL_DEVICE", "1")
    render("--engine", "cpu", "--format", "npz")
    assert ping().meta["engine"] == "cpu"


NO_EGL = (
    "OpenGL must be reachable through EGL, without a display (got: {}); pings need none with the engine 'cpu'; on "
    "Debian or Ubuntu install it with 'apt-get install libegl1 libgl1', in a container with a GPU let the driver's EGL "
    "library in"
)


def test_no_egl_and_too_old_an_opengl(monkeypatch, opengl_engine):
    def failing(message):
        def create(*_args, **_more):
            raise Exception(message)

        return create

    monkeypatch.setattr(moderngl, "create_context", failing("libEGL.so not loaded"))
    assert refused() == NO_EGL.format("libEGL.so not loaded")
    told = "Requested OpenGL version 330, got version 310"
    monkeypatch.setattr(moderngl, "create_context", failing(told))
    assert re.fullmatch(
        r"OpenGL must be 3\.3 or newer \(got 3\.[13]\); update the driver, or ask for .*", refused()
    )


def test_interrupt_and_memory(monkeypatch):
    def raising(what):
        def ping(*_args, **_more):
            raise what

        return ping

    monkeypatch.setattr(sg.Simulator, "ping", raising(KeyboardInterrupt()))
    status, out, err = run("render", "tank.sdf", "--sonar", "small.toml")
    assert (status, out, err) == (130, "", "error: interrupted\n")  # before the first file
    monkeypatch.setattr(sg.Simulator, "ping", raising(MemoryError("8 GiB")))
    assert refused() == "memory ran out (8 GiB); ask for fewer beams, bins or pixels"


def test_what_is_no_mistake_of_the_user_is_not_hidden(monkeypatch):
    def broken(*_args, **_more):
        raise ValueError("a bug")

    monkeypatch.setattr(sg.Simulator, "ping", broken)
    with pytest.raises(ValueError, match="a bug"):
        run("render", "tank.sdf", "--sonar", "small.toml")


def test_progress_is_shown_on_a_terminal_alone(monkeypatch, capsys):
    ours, theirs = pty.openpty()
    arguments = ["render", "tank.sdf", "--sonar", "small.toml", "--poses", "dive.csv", "--format", "npz"]
    with open(theirs, "w") as terminal, monkeypatch.context() as patch:
        patch.setattr(sys, "stderr", terminal)
        cli.main(arguments, standalone_mode=False)
    assert capsys.readouterr().out.startswith("tank_0000..0002.npz: ")
    shown = b""
    while b"100%" not in shown:  # it comes in parts; reading fails at the end, as the terminal is closed
        shown += os.read(ours, 10000)  # elsewhere stderr stays empty, as every `render` above sees
    os.close(ours)


# --- real processes


@pytest.mark.slow
def test_process_renders_and_says_nothing_on_stderr():
    done = process("render", "tank.sdf", "--sonar", "small.toml", "--height", 60, PYTHONIOENCODING="ascii")
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith("tank.png, tank.npz: 24 beams x 80 bins, strongest echo ")
    with np.load("tank.npz") as file:
        assert json.loads(str(file["meta"]))["scene"] == "tank"


@pytest.mark.slow
def test_process_without_egl():
    words = "render", "tank.sdf", "--sonar", "small.toml", "--engine", "opengl"
    done = process(*words, __EGL_VENDOR_LIBRARY_FILENAMES="/nowhere.json")
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == f"error: {NO_EGL.format('requested device index 0, but found 0 devices')}\n"


@pytest.mark.slow
def test_process_with_too_old_an_opengl():
    """Mesa can be told to be old; other drivers do not listen."""
    with gl.create_context() as context:
        if "Mesa" not in gl.describe(context)["version"]:
            pytest.skip("needs Mesa")
    words = "render", "tank.sdf", "--sonar", "small.toml", "--engine", "opengl"
    done = process(*words, MESA_GL_VERSION_OVERRIDE="3.1")
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("error: OpenGL must be ") and done.stderr.count("\n") == 1


def test_process_without_a_package():
    Path("numpy.py").write_text("raise ImportError('no numpy here')")
    done = process("render", "tank.sdf", PYTHONPATH=f"{Path.cwd()}{os.pathsep}{HOME}")
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == "error: no numpy here; 'sonar-gl doctor' says what is missing\n"


@pytest.mark.slow
def test_process_in_ascii_tells_mistakes():
    done = process("render", "tank.sdf", "--pose", "0 0 0 0 0 90", PYTHONIOENCODING="ascii")
    assert done.returncode == 2
    assert done.stderr.startswith("error: --pose '0 0 0 0 0 90': pose angles must be radians, within ")


# --- acoustics


def test_acoustics_change_fields_of_a_profile():
    text = "tvg_k=30,elevation_pattern=gaussian,specular=off,tvg_absorption_db_m=0.5,multipath=none"
    render("--acoustics", text)
    made = ping().meta["acoustics"]
    wanted = sg.Acoustics.physical(
        tvg_k=30.0, elevation_pattern="gaussian", specular=False, tvg_absorption_db_m=0.5, multipath="none"
    )
    assert made == wanted.meta()
    render("--profile", "ideal", "--acoustics", "tvg_absorption_db_m=none,beam_pattern=line_array")
    assert ping().meta["acoustics"] == replace(sg.Acoustics.ideal(), beam_pattern="line_array").meta()
    render("--profile", "demarco2015", "--range-law", "inverse", "--acoustics", "pulse=yes")
    assert ping().meta["acoustics"] == replace(sg.Acoustics.demarco2015("inverse"), pulse=True).meta()


def test_water():
    render("--water", "temperature_c=4,absorption_db_m=none", "--acoustics", "tvg_k=30")
    water = sg.Water(temperature_c=4.0)
    assert ping().meta["acoustics"] == sg.Acoustics.physical(tvg_k=30.0, water=water).meta()
    assert ping().meta["absorption_db_m"] == water.absorption(900e3)
    render("--water", "temperature_c=4", "--acoustics", "needed")
    scene, sonar = sg.load_scene("tank.sdf"), sg.load_sonar("small.toml")
    assert ping().meta["acoustics"] == sg.needed_acoustics(scene, sonar, 0.05, sg.pose(), water).meta()


@pytest.mark.slow
def test_acoustics_are_those_that_the_scene_needs():
    scene, sonar = sg.load_scene("tank.sdf"), sg.load_sonar("small.toml")
    render("--acoustics", "needed")
    wanted = sg.needed_acoustics(scene, sonar, 0.05, sg.pose())
    assert ping().meta["acoustics"] == wanted.meta() and wanted.beam_pattern == "line_array"
    render("--acoustics", "needed", "--poses", "dive.csv", "--format", "npz")
    wanted = sg.needed_acoustics(scene, sonar, 0.05, read_poses("dive.csv")[1])
    assert [ping(f"tank_{n:04d}.npz").meta["acoustics"] for n in range(3)] == 3 * [wanted.meta()]


@pytest.mark.parametrize(
    ("option", "text", "message"),
    [
        ("acoustics", "needed,tvg_k=30", "acoustics 'needed,tvg_k=30': needed takes no other settings"),
        ("acoustics", "profile=ideal", "acoustics 'profile=ideal': unknown name (got 'profile'; "),
        ("acoustics", "water=cold", "acoustics 'water=cold': water has an option of its own (give --water "),
        ("acoustics", "tvg_k=400", "acoustics: tvg_k must lie in 0..60 (got 400; usual are 20, 30 and 40)"),
        ("water", "tvg_k=30", "water 'tvg_k=30': unknown name (got 'tvg_k'; "),
        ("water", "salinity_psu=-1", "water: salinity_psu must lie in 0..45 (got -1; give grams of salt "),
    ],
)
def test_mistakes_in_settings_are_told_of_their_option(option, text, message):
    assert refused(f"--{option}", text).startswith(f"--{message}")


def test_what_a_scene_needs_is_of_the_profile_physical():
    for options, profile in ((["--profile", "ideal"], "ideal"), (["--style", "demarco2015"], "demarco2015")):
        message = f"--acoustics needed needs --profile physical (got --profile {profile})"
        assert refused("--acoustics", "needed", *options) == message


@pytest.mark.slow
def test_verify_refuses_what_rays_know_nothing_of():
    words = "verify", "tank.sdf", "--sonar", "small.toml", "--acoustics"
    assert run(*words, "multipath=coherent") == (
        2,
        "",
        "error: the reference does not model multipath (got multipath 'coherent'; give multipath=none)\n",
    )
    status, out, _ = run(*words, "pulse=on", "--tolerance", 0.2)
    assert status == 0 and "tolerance of 20 % is kept" in out
    scene, sonar = sg.load_scene("tank.sdf"), sg.load_sonar("small.toml")
    with pytest.raises(sg.Error, match="does not model multipath"):
        sg.reference_ping(scene, sonar, sg.pose(), sg.Acoustics.physical(multipath="incoherent"))


@pytest.mark.parametrize("words", [("view",), ("emulate", "oculus"), ("emulate", "ping360"), ("ros2",)])
@pytest.mark.parametrize("duration", ["-1", "nan"])
def test_a_duration_must_be_a_time(words, duration):
    shown = f"error: --duration must lie in 0..1e+09 (got {duration}; seconds)\n"
    assert run(*words, "pylon", "--duration", duration) == (2, "", shown)
