"""The examples: each runs headless, and what it pings and paints is right."""

import os
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image, ImageSequence

import sonar_gl as sg
from sonar_gl.imaging.fan_image import fan_geometry
from tests.support.run_example import PINGS

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[2]
# Share of the echo that an embedding mode puts elsewhere than a Simulator without a host, at the first ping's samples.
DRAWN_ERROR = 3e-4  # matrices multiplied in float32: 3e-5 was measured
TEXTURE_ERROR = 0.005  # edges are seen a pixel of 0.1 degrees off: 0.28 % was measured
DEPTH_ERROR = 0.02  # edges are seen a sample or a pixel of 0.1 degrees off: 0.7 and 1.0 % were measured
ROD_ERROR = 0.12  # of a body's echo by depth images: a rod five pixels wide comes out 9 % too strong


class Run:
    """An example, run in a process of its own, and what it left.

    Attributes
    ----------
    printed : text
    pings : of its embedding modes, by names of `run_example.PINGS`
    alone : of the same without a host
    main_lobe : likewise with the main lobe in elevation alone, which is what hosts draw
    picture : (H, W, 3)
    drawn : (H, W', 3), the part of it without fan images
    fans : parts of it, one a ping
    """

    def __init__(self, name, folder, fan_height, *options, display=None):
        hidden = ("DISPLAY", "WAYLAND_DISPLAY")
        environment = {key: value for key, value in os.environ.items() if key not in hidden}
        if display:
            environment["DISPLAY"] = display
        environment["SONAR_GL_ENGINE"] = "opengl"  # hosts draw by OpenGL, and what they are compared with
        environment["PYTHONPATH"] = os.pathsep.join([str(ROOT), environment.get("PYTHONPATH", "")])
        program = sys.executable, "-W", "error::UserWarning", "-m", "tests.support.run_example"
        done = subprocess.run(
            [*program, name, folder, *options],
            env=environment, cwd=folder, capture_output=True, text=True, timeout=240,
        )  # fmt: skip
        assert done.returncode == 0, done.stdout + done.stderr
        assert "Warning" not in done.stderr, done.stderr
        self.printed, self.film = done.stdout, folder / f"{name}.gif"
        self.names = list(np.load(folder / "names.npy"))
        self.alone = sg.load_npz(folder / "alone.npz")
        self.main_lobe = sg.load_npz(folder / "main_lobe.npz")
        there = [key for key in PINGS if (folder / f"{key}.npz").exists()]
        self.pings = {key: sg.load_npz(folder / f"{key}.npz") for key in there}
        self.picture = cv2.cvtColor(cv2.imread(str(folder / f"{name}.png")), cv2.COLOR_BGR2RGB)
        width = fan_geometry(self.alone, fan_height).width
        parts = np.split(self.picture, [-k * width for k in range(len(self.pings), 0, -1)], axis=1)
        self.drawn, self.fans = parts[0], [fan[-fan_height:] for fan in parts[1:]]

    def check_fans(self, *modes):
        """The picture shows the pings of these modes, and they have echoes."""
        assert tuple(self.pings) == modes
        for fan, ping in zip(self.fans, self.pings.values(), strict=True):
            assert ping.intensity.max() > 0
            assert np.array_equal(fan, sg.colorize(sg.fan_image(ping, height=len(fan))))

    def check_joined(self):
        """A host's context changes no bit."""
        assert np.array_equal(self.pings["ping"].intensity, self.alone.intensity)

    def check_sides(self, target, middle):
        """What is to port, and alone red or yellow, is on the left of what the host draws and of the fans.

        middle : of what the host draws, pixels
        """
        red, _, blue = np.moveaxis(self.drawn.astype(int), 2, 0)
        _, columns = np.nonzero((red > 80) & (red > 2 * blue))  # the floors are paler
        assert len(columns) > 200
        assert columns.max() < middle
        seen = self.alone.body_id == 1 + self.names.index(target)
        for fan, ping in zip(self.fans, self.pings.values(), strict=True):
            beam, k = np.unravel_index(np.argmax(ping.intensity * seen), seen.shape)
            assert ping.azimuth_rad[beam] > 0
            where = fan_geometry(ping, len(fan)).pixel(ping.azimuth_rad[beam], ping.range_m[k])
            column, row = np.round(where).astype(int)
            assert column < fan.shape[1] / 2
            bright = fan[..., 1]  # in copper, green rises with the counts
            assert bright[row, column] > max(150, 1.5 * np.percentile(bright, 75))  # floors are darker

    def check_seen(self, mode, error, body_error):
        """What a ping of this mode has what the scene has, of each bin and each body."""
        alone, ping = self.main_lobe, self.pings[mode]
        total = float(alone.intensity.sum())
        assert np.abs(alone.intensity - ping.intensity).sum() < error * total
        assert alone.intensity[alone.body_id == ping.body_id].sum() > (1 - error) * total
        assert ping.body_echo == pytest.approx(alone.body_echo, rel=body_error, abs=1e-4 * total)

    def check_film(self, n_frames):
        """Things move in every frame, in what is drawn and in the fan, and the last one is the picture."""
        with Image.open(self.film) as film:
            frames = [np.asarray(frame.convert("RGB")) for frame in ImageSequence.Iterator(film)]
        assert len(frames) == n_frames
        width = self.drawn.shape[1]
        for before, after in pairwise(frames):
            differs = np.abs(after.astype(int) - before).max(axis=2) > 50
            assert differs[:, :width].any()
            assert differs[:, width:].any()
        # palettes of 256 colours keep fans, which have no more, and change shades
        assert np.abs(frames[-1].astype(int) - self.picture).mean() < 5


@pytest.mark.timeout(300)
def test_pyrender(tmp_path):
    run = Run("pyrender_host", tmp_path, 600)
    run.check_fans("ping", "depth_ping")
    run.check_joined()
    run.check_sides("pylon", middle=320)
    run.check_seen("depth_ping", DEPTH_ERROR, ROD_ERROR)


@pytest.mark.timeout(300)
def test_bare_egl(tmp_path):
    run = Run("egl_host", tmp_path, 600)
    run.check_fans("ping", "drawn_ping")
    run.check_joined()
    run.check_sides("pipe", middle=320)
    run.check_seen("drawn_ping", DRAWN_ERROR, DRAWN_ERROR)


@pytest.mark.timeout(300)
def test_deferred(tmp_path):
    run = Run("deferred_host", tmp_path, 670)
    run.check_fans("texture_ping")
    run.check_sides("post", middle=293)
    run.check_seen("texture_ping", TEXTURE_ERROR, TEXTURE_ERROR)


@pytest.mark.timeout(300)
def test_window(tmp_path, display):
    run = Run("window_host", tmp_path, 280, "frames=40", display=display)
    run.check_fans("ping")
    run.check_joined()
    run.check_sides("pile", middle=480)
    # a ping before the first frame, and one every six frames of a sixtieth of a second
    assert run.printed == "40 frames and 7 pings in 0.7 s\n"
    # the key is held at 1 m/s, for the 36 frames before the last ping
    assert run.pings["ping"].pose[:3, 3] == pytest.approx([0.6, 0, 1.6], abs=0.02)


def test_a_window_without_a_display_is_refused_in_one_sentence():
    environment = {name: value for name, value in os.environ.items() if "DISPLAY" not in name}
    command = [sys.executable, "examples/window_host.py"]
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=120)
    sentence = "a display is needed (without one: xvfb-run python examples/window_host.py --frames 60)"
    assert (done.returncode, done.stdout, done.stderr) == (2, "", f"error: {sentence}\n")


@pytest.mark.timeout(300)
def test_mujoco(tmp_path):
    run = Run("mujoco_host", tmp_path, 360, "FRAMES=10")
    run.check_fans("ping", "depth_ping")
    run.check_joined()
    run.check_sides("bob", middle=240)
    run.check_seen("depth_ping", DEPTH_ERROR, ROD_ERROR)
    run.check_film(10)


@pytest.mark.timeout(300)
def test_panda3d(tmp_path):
    run = Run("panda3d_host", tmp_path, 360)
    run.check_fans("ping")
    run.check_joined()
    run.check_sides("ball", middle=240)
    run.check_film(20)
