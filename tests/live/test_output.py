"""What a live session writes: files of its own names, in its own folder, that other commands read."""

import os
import shlex
import threading
from dataclasses import replace
from pathlib import Path
from queue import Queue

import cv2
import numpy as np
import pytest
from click.testing import CliRunner

import sonar_gl as sg
from sonar_gl.cli import main as cli
from sonar_gl.core.poses import read_poses
from sonar_gl.core.toml import read_toml
from sonar_gl.live import recording as recording_module
from sonar_gl.live.command_line import SceneSource, rounded_pose_numbers
from sonar_gl.live.recording import FPS, LONGEST_S, Recording, fitted
from sonar_gl.live.session import LiveSession
from sonar_gl.live.settings import LiveSettings
from sonar_gl.sonar.sonar_files import load_sonar
from tests.support.waiting import WAIT_S, wait_until

COARSE = LiveSettings("p900-45,n_beams=24", range_m=15.0, tolerance=0.5, height=120)
START = sg.pose(0.123456789, 0.2, -5.0, 0.0, 0.2, 0.1)


@pytest.fixture(scope="module")
def scene():
    return sg.load_scene("pylon")


@pytest.fixture
def session(scene, tmp_path):
    with LiveSession(scene, COARSE, START, folder=tmp_path / "out", source=SceneSource("pylon")) as one:
        yield one


def run(*words):
    return CliRunner().invoke(cli.main, list(words))


# ---- pictures and command lines ------------------------------------------------------------------------

CHANGES = [
    {},
    {"gain_db": 12.0, "acoustics": sg.Acoustics.physical(pulse=False, tvg_k=30.0), "colormap": "viridis"},
    {"sonar": "p900-90,receive_taper=hamming", "n_bins": 300, "noise": "physical,looks=2", "seed": 3},
    {"water": sg.Water(temperature_c=4.0), "counts": sg.Counts(low_db=-40.0), "noise": "gaussian=0.01"},
    {"acoustics": sg.Acoustics.ideal(), "engine": "cpu"},
    {"counts": sg.Counts("power", gain_percentile=99, bits=16), "colormap": "gray"},
]


@pytest.mark.parametrize(
    "changes",
    [*CHANGES[1:3], *(pytest.param(one, marks=pytest.mark.slow) for one in (CHANGES[0], *CHANGES[3:]))],
)
def test_the_command_line_makes_the_saved_picture(session, tmp_path, changes):
    session.change(**changes)
    frame = session.next_frame()
    saved = session.output.save_picture(frame)
    (line,) = session.output.command_line(frame).splitlines()
    words = shlex.split(line)
    assert words[0] == "sonar-gl"
    done = run(*words[1:], "--out", str(tmp_path / "again"))
    assert done.exit_code == 0, done.output
    for suffix in (".png", ".npz"):
        again = (tmp_path / "again" / "pylon").with_suffix(suffix)
        assert again.read_bytes() == saved.with_suffix(suffix).read_bytes()


@pytest.mark.parametrize("form", [pytest.param("fan", marks=pytest.mark.slow), "polar"])
def test_saved_gray_pictures_hold_16_bits(session, form):
    session.change(counts=sg.Counts(bits=16), colormap="gray", form=form, height=600)
    frame = session.next_frame()
    assert frame.picture.dtype == np.uint8  # what the page shows
    written = cv2.imread(str(session.output.save_picture(frame)), cv2.IMREAD_UNCHANGED)
    assert written.dtype == np.uint16 and len(np.unique(written)) > 256
    if form == "polar":  # whole bins, port on the left, the far end at the top
        assert np.isin(written, session.still(frame).ping.counts()).all()
    with pytest.raises(sg.Error, match="counts of 16 bits need the colour map gray"):
        session.change(colormap="copper")


@pytest.fixture
def sonar_file(tmp_path):
    """A file of a sonar of the user's own."""
    path = tmp_path / "mine.toml"
    path.write_text(
        "frequency_hz=9e5\nn_beams=32\nn_bins=64\nazimuth_fov_deg=30.0\nelevation_fov_deg=20.0\nbeam_width_deg=1.0\n"
        "range_min_m=0.5\nrange_max_m=20.0\n"
    )
    return path


def test_command_lines_name_the_scenes_options_and_the_users_sonar(scene, sonar_file):
    text = str(sonar_file)
    source = SceneSource("pylon", ("a b",), True, ("box",), (), -1.5, text, load_sonar(text))
    with LiveSession(scene, LiveSettings(text, range_m=10.0), START, source=source) as session:
        line = session.output.command_line()
    assert line.startswith(
        f"sonar-gl render pylon --resource-path 'a b' --without box --skip-missing --surface -1.5 --sonar {text} "
        "--range 10.0 "
    )
    assert line.endswith("--pose '0.123457 0.2 -5 0 0.2 0.1'")


def test_a_field_that_the_users_text_changes_is_named_once(scene, sonar_file):
    text = f"{sonar_file},n_bins=128, tilt_deg=8"
    source = SceneSource("pylon", sonar=text, loaded=load_sonar(text))
    tilted = replace(source.loaded, tilt_deg=5.5)
    with LiveSession(scene, LiveSettings(tilted), START, source=source) as session:
        words = shlex.split(session.output.command_line())
    named = words[words.index("--sonar") + 1]
    assert named == f"{sonar_file},n_bins=128,tilt_deg=5.5" and load_sonar(named) == tilted


def test_a_preset_whose_name_begins_like_the_users_has_its_own_counts(scene):
    own = replace(load_sonar("aris-1200"), counts=sg.Counts(low_db=-33.0))
    source = SceneSource("pylon", sonar="aris-1200", loaded=own)
    with LiveSession(scene, COARSE.changed(sonar="aris-1200-lf"), START, source=source) as session:
        words = shlex.split(session.output.command_line())
    assert words[words.index("--sonar") + 1] == "aris-1200-lf" and "--counts" not in words


def test_command_lines_say_what_they_leave_out(session):
    session.move_body("box", sg.pose(3, 0, -9))
    session.change(form="polar")
    _line, *comments = session.output.command_line(session.next_frame()).splitlines()
    assert [comment.split(":")[0].split(" ")[:2] for comment in comments] == [["#", "box"], ["#", "a"]]


def test_scenes_and_sonars_made_in_python_have_no_command_line(scene, tmp_path):
    with LiveSession(scene, COARSE, START, folder=tmp_path) as session:
        command_line = session.output.command_line
        with pytest.raises(sg.Error, match="a scene on a command line must be a bundled one or a file"):
            command_line()
    own = sg.Sonar("own", 900e3, 16, 50, 30.0, 20.0, 2.0, 0.5, 10.0)
    with LiveSession(
        scene, LiveSettings(own), START, folder=tmp_path, source=SceneSource("pylon")
    ) as session:
        with pytest.raises(sg.Error, match="a sonar on a command line must be a preset"):
            session.output.command_line()
        session.output.save_picture()  # needs none


def test_pictures_are_numbered_in_the_folder(session, tmp_path):
    names = [session.output.save_picture().relative_to(tmp_path).as_posix() for _ in range(2)]
    assert names == ["out/pylon_0001.png", "out/pylon_0002.png"]


@pytest.mark.parametrize(
    "name",
    [
        "../../escape",
        "\x00",
        *(pytest.param(name, marks=pytest.mark.slow) for name in ("/etc/x", "a/b", "..")),
        *(pytest.param(one, marks=pytest.mark.slow) for one in ("", "x" * 500)),
    ],
)
def test_no_name_of_a_scene_leads_out_of_the_folder(scene, tmp_path, name):
    odd = sg.Scene(scene.bodies, scene.sonar_pose, name)
    with LiveSession(odd, COARSE, START, folder=tmp_path / "out") as session:
        session.output.start_recording()
        wait_until(lambda: session.output.n_recorded)
        session.output.stop_recording()
        session.output.save_picture()
    written = [path for path in tmp_path.rglob("*") if path.is_file()]
    assert len(written) >= 5
    assert all(path.resolve().is_relative_to(tmp_path / "out") for path in written)


# ---- recordings ----------------------------------------------------------------------------------------


def test_a_recording_holds_pings_film_and_poses(session, tmp_path):
    folder = session.output.start_recording()
    assert session.output.is_recording and folder == tmp_path / "out" / "pylon_0001"
    with pytest.raises(sg.Error, match="a recording must be stopped"):
        session.output.start_recording()
    wait_until(lambda: session.output.n_recorded >= 2)
    session.set_pose(sg.pose(1.0, 0, -5.0))
    wait_until(lambda: session.frame.pose[0, 3] == 1.0)
    number = session.output.n_recorded
    wait_until(lambda: session.output.n_recorded >= number + 2)
    files = session.output.stop_recording()
    assert not session.output.is_recording
    assert set(files) == set(folder.iterdir()) and session.output.n_missed == 0

    *pings, film, csv = files
    times_s, poses = read_poses(csv)
    assert len(pings) == len(poses) == session.output.n_recorded
    for path, pose in zip(pings, poses, strict=True):
        # rounded to a millionth, of which half may be lost, in each of three angles
        assert sg.load_npz(path).pose == pytest.approx(pose, abs=2e-6)
    assert times_s[0] == 0.0 and (np.diff(times_s) > 0).all()
    assert poses[-1].tolist() == sg.pose(1.0, 0, -5.0).tolist()
    video = cv2.VideoCapture(str(film))
    n_frames = int(video.get(cv2.CAP_PROP_FRAME_COUNT))
    # each ping at least once, and rounding of the time that each stands
    assert max(len(pings), FPS * times_s[-1] - 1) <= n_frames <= FPS * times_s[-1] + len(pings)
    assert (video.get(cv2.CAP_PROP_FRAME_HEIGHT), video.get(cv2.CAP_PROP_FPS)) == (120, FPS)


def test_poses_of_a_recording_render_the_same_pings(session, tmp_path):
    session.change(noise="none")
    session.output.start_recording()
    wait_until(lambda: session.output.n_recorded >= 2)
    *_, csv = session.output.stop_recording()
    done = run("render", "pylon", "--sonar", "p900-45", "--range", "15", "--tolerance", "0.2", "--poses", str(csv),
               "--format", "npz", "--out", str(tmp_path / "again"))  # fmt: skip
    assert done.exit_code == 0, done.output
    again = sg.load_npz(tmp_path / "again" / "pylon_0000.npz")
    assert again.pose.tolist() == read_poses(csv)[1][0].tolist()


def test_a_film_survives_pictures_of_other_sizes(session):
    session.output.start_recording()
    wait_until(lambda: session.output.n_recorded >= 1)
    session.change(form="polar", height=90)
    wait_until(lambda: session.frame.picture.shape == (90, 90, 3))
    number = session.output.n_recorded
    wait_until(lambda: session.output.n_recorded > number)
    files = session.output.stop_recording()
    video = cv2.VideoCapture(str(files[-2]))
    assert video.get(cv2.CAP_PROP_FRAME_HEIGHT) == 120
    assert int(video.get(cv2.CAP_PROP_FRAME_COUNT)) > number


def test_pictures_are_fitted_with_black_borders():
    white = np.full((50, 100, 3), 255, np.uint8)
    out = fitted(white, (80, 80))
    assert out.shape == (80, 80, 3)
    assert (out[20:60] == 255).all() and not out[:20].any() and not out[60:].any()
    assert fitted(white, (50, 100)) is white


def test_a_full_disk_ends_the_recording_with_a_sentence(session, monkeypatch):
    def full(path, ping):
        if path.stem == "ping_000002":
            raise sg.Error(f"cannot write {str(path)!r}: No space left on device")
        sg.save_npz(path, ping)

    monkeypatch.setattr(recording_module, "save_npz", full)
    folder = session.output.start_recording()
    wait_until(lambda: not session.output.is_recording)
    assert "No space left" in session.output.problem
    with pytest.raises(sg.Error, match=r"the recording ended early: cannot write .* No space left on device"):
        session.output.stop_recording()
    # what was written is whole
    assert sorted(path.name for path in folder.iterdir()) == [
        "film.mp4", "ping_000000.npz", "ping_000001.npz", "poses.csv"
    ]  # fmt: skip
    monkeypatch.undo()
    assert session.next_frame()  # it lives on
    session.output.start_recording()
    wait_until(lambda: session.output.n_recorded >= 1)
    assert session.output.stop_recording()


def test_pings_that_cannot_be_written_once_the_recording_is_stopped_are_told(session, monkeypatch):
    """Some wait to be written then."""
    is_writing, may_fail, found = threading.Event(), threading.Event(), Queue()

    def full(path, _ping):
        is_writing.set()
        assert may_fail.wait(WAIT_S)
        raise sg.Error(f"cannot write {str(path)!r}: No space left on device")

    def stop():
        try:
            found.put(session.output.stop_recording())
        except sg.Error as why:
            found.put(str(why))

    monkeypatch.setattr(recording_module, "save_npz", full)
    session.output.start_recording()
    assert is_writing.wait(WAIT_S)
    stopping = threading.Thread(target=stop, daemon=True)
    stopping.start()
    wait_until(lambda: not session.output.is_recording)
    may_fail.set()
    told = found.get(timeout=WAIT_S)
    assert str(told).startswith("the recording ended early: cannot write ") and told.endswith("on device")


def fail_on_full_disk(path, frames, fps):
    """Take one frame as `save_animation`, and fail as on a full disk."""
    next(iter(frames))
    raise sg.Error("only 1 of 9 frames could be written (is the disk full?)")


def test_a_recording_that_failed_is_in_the_way_of_no_other(session, monkeypatch):
    with monkeypatch.context() as patched:
        patched.setattr(recording_module, "save_animation", fail_on_full_disk)
        session.output.start_recording()
        wait_until(lambda: session.output.problem)
    session.output.start_recording()
    wait_until(lambda: session.output.n_recorded >= 1)
    assert session.output.stop_recording()


def test_a_picture_takes_no_name_of_another_file(session):
    folder = session.output.folder
    folder.mkdir()
    (folder / "pylon_0001.npz").write_text("mine")
    assert session.output.save_picture() == folder / "pylon_0002.png"
    assert (folder / "pylon_0001.npz").read_text() == "mine"


def test_a_film_that_cannot_be_written_ends_the_recording(session, monkeypatch):
    monkeypatch.setattr(recording_module, "save_animation", fail_on_full_disk)
    session.output.start_recording()
    wait_until(lambda: not session.output.is_recording)
    with pytest.raises(sg.Error, match="is the disk full"):
        session.output.stop_recording()


def finished(recording):
    """Close a recording, in a thread, since a mistake would have it wait for ever; return its files or its Error."""
    results = Queue()

    def close():
        try:
            results.put(recording.close())
        except sg.Error as why:
            results.put(why)

    threading.Thread(target=close, daemon=True).start()
    return results.get(timeout=WAIT_S)


def test_a_recording_whose_first_ping_cannot_be_saved_ends(session, tmp_path, monkeypatch):
    def full(path, _ping):
        raise sg.Error(f"cannot write {str(path)!r}: No space left on device")

    monkeypatch.setattr(recording_module, "save_npz", full)
    recording = Recording(tmp_path)
    with pytest.raises(sg.Error, match="No space left"):
        recording(session.frame)
    assert finished(recording) == []
    assert os.listdir(tmp_path) == []


def test_a_film_that_fails_after_its_last_picture_ends_the_recording(session, tmp_path, monkeypatch):
    def full(_path, frames, _fps):
        raise sg.Error(f"only 0 of {len(list(frames))} frames could be written (is the disk full?)")

    monkeypatch.setattr(recording_module, "save_animation", full)
    recording = Recording(tmp_path)
    recording(session.frame)
    assert str(finished(recording)) == "only 0 of 1 frames could be written (is the disk full?)"
    assert sorted(os.listdir(tmp_path)) == ["ping_000000.npz", "poses.csv"]


def test_a_pause_is_cut_out_of_the_film_once(session, tmp_path, monkeypatch):
    counts = []
    monkeypatch.setattr(
        recording_module, "save_animation", lambda path, frames, fps: counts.append(len(list(frames)))
    )
    recording = Recording(tmp_path)
    for clock_s in (0.0, 60.0, 60.1, 60.2):
        recording(replace(session.frame, clock_s=clock_s))
    finished(recording)
    # the first picture, and 10 s of it in place of a minute; 2 steps of 0.1 s; the last picture
    assert counts == [1 + round(LONGEST_S * FPS) + 2 * round(0.1 * FPS) + 1]


def test_an_empty_recording_has_no_files(tmp_path):
    assert Recording(tmp_path).close() == []


def test_a_folder_that_cannot_be_written_is_an_error(scene, tmp_path):
    with LiveSession(scene, COARSE, START, folder=tmp_path / "file", source=SceneSource("pylon")) as session:
        (tmp_path / "file").write_text("")  # one that was there before is told at the start
        for write in (
            session.output.start_recording,
            session.output.save_picture,
            session.output.add_pose_to_job,
        ):
            with pytest.raises(sg.Error, match="cannot write into the folder"):
                write()
        assert not session.output.is_recording
    with pytest.raises(sg.Error, match="cannot write into the folder"):
        LiveSession(scene, COARSE, START, folder=tmp_path / "file")


def test_closing_a_session_finishes_its_recording(scene, tmp_path):
    with LiveSession(scene, COARSE, START, folder=tmp_path) as session:
        folder = session.output.start_recording()
        wait_until(lambda: session.output.n_recorded >= 1)
    assert {"film.mp4", "poses.csv"} <= {path.name for path in folder.iterdir()}


# ---- job files -----------------------------------------------------------------------------------------


@pytest.mark.slow
def test_poses_become_a_job_that_batch_takes(session, tmp_path):
    pytest.importorskip("pydantic", reason="batches need the extra batch")
    session.change(water=sg.Water(temperature_c=4.0), noise="physical,looks=2")
    paths = {session.output.add_pose_to_job(session.next_frame()) for _ in range(2)}
    session.set_pose(sg.pose(1, 0.5, -6))
    paths.add(session.output.add_pose_to_job(session.next_frame()))
    assert paths == {tmp_path / "out" / "poses.toml"}
    done = run("batch", str(*paths), "--dry-run")
    assert done.exit_code == 0, done.output
    assert done.output.startswith("pings 0..2: scene pylon, 0 to 2 s\n")
    beams, bins = session.frame.ping.intensity.shape
    assert f"p900_45 in pylon: {beams} beams x {bins} bins" in done.output


@pytest.mark.parametrize(
    "text",
    [
        pytest.param("mine.toml", marks=pytest.mark.slow),
        "mine.toml#b,tilt_deg=5",
        "~/mine.toml#b",
        pytest.param("~mine.toml", marks=pytest.mark.slow),
    ],
)
def test_a_new_job_names_the_users_sonar_as_it_is_found_from_its_folder(scene, tmp_path, monkeypatch, text):
    (tmp_path / "home").mkdir()
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.chdir(tmp_path)
    keys = (
        "frequency_hz=9e5\nn_beams=32\nn_bins=64\nazimuth_fov_deg=30.0\nelevation_fov_deg=20.0\n"
        "beam_width_deg=1.0\nrange_min_m=0.5\nrange_max_m=20.0\n"
    )
    path = tmp_path / text.partition("#")[0].partition(",")[0].replace("~/", "home/")
    path.write_text(f"[a]\n{keys}[b]\n{keys}" if "#" in text else keys)
    own = load_sonar(text.replace("~/", f"{tmp_path}/home/"))
    source = SceneSource("pylon", sonar=text, loaded=own)
    with LiveSession(scene, LiveSettings(own), START, folder=tmp_path / "out", source=source) as session:
        (named,) = read_toml(session.output.add_pose_to_job(session.next_frame()), "the job file")["sonars"]
    monkeypatch.chdir("/")
    assert load_sonar(named["sonar"]) == own


def test_a_new_job_does_not_take_poses_of_one_that_was_deleted(session):
    job = session.output.add_pose_to_job()
    session.output.add_pose_to_job()
    job.unlink()
    session.set_pose(sg.pose(1, 2, 3))
    for number in (1, 2):
        session.output.add_pose_to_job(session.next_frame())
        assert len(read_poses(job.with_name("poses_view_2.csv"))[1]) == number
    assert len(read_poses(job.with_name("poses_view.csv"))[1]) == 2
    assert '"poses_view_2.csv"' in job.read_text() and '"poses_view.csv"' not in job.read_text()


def test_a_users_job_keeps_its_text_and_comments(scene, tmp_path):
    job = tmp_path / "survey.toml"
    text = '# mine\nscenes = ["pylon"]  # one\n[[sonars]]\nsonar = "p900-45"\n\n[[poses]]\nkind = "orbit"'
    job.write_text(text)
    with LiveSession(scene, COARSE, START, folder=tmp_path / "out", job=job) as session:
        assert session.output.add_pose_to_job() == job
        session.set_pose(sg.pose(1, 2, 3, 0.1, 0.2, 0.3))
        session.output.add_pose_to_job(session.next_frame())
    added = '\n\n[[poses]]\nkind = "trajectory"\nfile = "survey_view.csv"  # by sonar-gl view\n'
    assert job.read_text() == text + added
    times_s, poses = read_poses(tmp_path / "survey_view.csv")
    assert times_s.tolist() == [0.0, 1.0]
    assert poses[0].tolist() == sg.pose(*rounded_pose_numbers(START)).tolist()
    assert poses[1].tolist() == sg.pose(1, 2, 3, 0.1, 0.2, 0.3).tolist()
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "text, message",
    [
        ('poses = [{ kind = "orbit" }]\n', r"poses must be tables \[\[poses\]\]"),
        ("poses = 3\n", r"poses must be tables, as in \[\[poses\]\]"),
        ("poses = [", "must be TOML"),
    ],
)
def test_a_job_that_takes_no_more_poses_stays_as_it_is(scene, tmp_path, text, message):
    job = tmp_path / "job.toml"
    job.write_text("")
    with LiveSession(scene, COARSE, START, folder=tmp_path, job=job) as session:
        job.write_text(text)
        with pytest.raises(sg.Error, match=message):
            session.output.add_pose_to_job()
    assert job.read_text() == text
    assert os.listdir(tmp_path) == ["job.toml"]


def test_a_job_that_is_not_there_is_an_error_at_once(scene, tmp_path):
    with pytest.raises(sg.Error, match="the job file must be readable"):
        LiveSession(scene, COARSE, START, folder=tmp_path, job=Path("no.toml"))
