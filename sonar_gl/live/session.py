"""A sonar that pings a scene again and again, while its settings, its pose and the bodies change.

`LiveSession` is the interface, and joins the parts: `SonarMotion` knows where the sonar is, `SettingsTrial` what to
ping with; `LiveSonar` makes the frame of a ping, and `PingThread` says when. The last section has the way of a ping
from request to listeners.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from threading import RLock

import numpy as np

from sonar_gl.analysis.terms import Price, price
from sonar_gl.core.checks import check_function, check_kind, check_whole_number, unknown_body_error
from sonar_gl.core.closing import Closable
from sonar_gl.core.errors import Error
from sonar_gl.core.listeners import Listener
from sonar_gl.core.pose_track import PoseTrack
from sonar_gl.core.poses import check_pose
from sonar_gl.core.warn import collected_warnings
from sonar_gl.live.command_line import SceneSource
from sonar_gl.live.frame import (
    LiveFrame,
    LiveState,
    Reading,
    Surface,
    body_number,
    check_bin,
    reading_of,
)
from sonar_gl.live.key_motion import SPEED_M_S, TURN_RATE_RAD_S, moved
from sonar_gl.live.live_sonar import FrameRequest, LiveSonar
from sonar_gl.live.output import DEFAULT_FOLDER, LiveOutput
from sonar_gl.live.pictures import pixel_cells
from sonar_gl.live.ping_thread import PingThread
from sonar_gl.live.settings import LiveSettings, SettingsTrial
from sonar_gl.live.sonar_motion import SonarMotion
from sonar_gl.ping import Ping
from sonar_gl.scene.scene import Scene
from sonar_gl.simulator import Simulator

logger = logging.getLogger(__name__)


class LiveSession(Closable):
    """Pings a scene in a thread of its own while somebody listens. Use it in a `with` block, or call `close()`.

    Raises Error if there is no pose, or the first ping fails.

    All methods may be called from any thread, and from listeners.

    Parameters
    ----------
    scene : Scene, which stays as it is
    settings : LiveSettings
    pose : (4, 4) world_from_sonar at the start; None for that of the track, or else of the scene
    track : PoseTrack that the sonar follows at first; None for none. Its time runs from the first frame that a listener
        gets, or from `play`
    folder : of the files that `output` writes, made when the first is written
    source : SceneSource, how a command line names the scene; None if it cannot
    job : path of a job file to which poses are added; None for one in the folder

    Attributes
    ----------
    output : LiveOutput, which records pings, saves pictures, and states command lines
    """

    def __init__(
        self,
        scene: Scene,
        settings: LiveSettings,
        pose: np.ndarray | None = None,
        track: PoseTrack | None = None,
        folder: str | Path = DEFAULT_FOLDER,
        source: SceneSource | None = None,
        job: str | Path | None = None,
    ):
        check_kind("scene", scene, Scene, "sonar_gl.load_scene makes one from a name or a file")
        check_kind("settings", settings, LiveSettings, 'such as LiveSettings("p900-45")')
        if pose is None:
            pose = scene.sonar_pose if track is None else track.at(0.0)
        if pose is None:
            raise Error(f"scene {scene.name!r} has no sonar in it; give a pose")
        self.scene, self.track = scene, track
        self.output = LiveOutput(self, folder, source, job)
        began_s = time.monotonic()
        self._lock = RLock()  # guards all that follows but the sonar, which is the thread's alone
        self._trial = SettingsTrial(settings)
        self._home = {one.name: one.pose for one in scene.bodies_and_plumes}
        # a change makes another mapping, so that a ping may hold this one
        self._moved: Mapping[str, np.ndarray | None] = {}
        self._motion = SonarMotion(pose, track, began_s)
        self._highlight, self._rate_from_s = "", began_s
        self._frame: LiveFrame | None = None
        self._sonar = LiveSonar(scene, began_s)
        self._thread = PingThread(
            self._lock, self._ping_and_tell, lambda: self.settings.max_rate_hz, self._sonar.close
        )
        try:
            self._frame = self.next_frame()
        except BaseException:
            self.close()
            raise

    # ---- state ----------------------------------------------------------------------------------------------

    @property
    def settings(self) -> LiveSettings:
        """The settings of the next ping."""
        return self._trial.settings

    @property
    def frame(self) -> LiveFrame:
        """The last frame."""
        return self._frame

    @property
    def pose(self) -> np.ndarray:
        """Where the sonar is now, (4, 4) world_from_sonar."""
        with self._lock:
            return self._motion.now().pose

    @property
    def highlighted(self) -> str:
        """Name of the body whose pixels frames highlight; "" for none."""
        return self._highlight

    def state(self) -> LiveState:
        """Return what the session does now."""
        with self._lock:
            return LiveState(
                settings=self._trial.settings,
                problem=self._trial.problem,
                **self._motion.playback()._asdict(),
                rate_hz=0.0 if self._frame is None else self._frame.rate_hz,
            )

    def bodies(self) -> dict[str, np.ndarray | None]:
        """Return the names of all bodies and plumes, and where they are now: (4, 4) world_from_body."""
        with self._lock:
            return {**self._home, **self._moved}

    # ---- settings -------------------------------------------------------------------------------------------

    def change(self, **values) -> LiveSettings:
        """Change some settings from the next ping on, as `LiveSettings.changed` does, and return the new ones.

        Raises Error if a value is invalid; the settings then stay as they are. Those that turn out to be impossible
        when they are tried, such as more samples than a driver can draw, are taken back: `state().problem` says why.
        """
        with self._lock:
            settings = self._trial.settings.changed(**values)
            self._trial.change(settings)
            self._rate_from_s = time.monotonic()
            return settings

    def switch(self, term: str, on: bool) -> LiveSettings:
        """Switch a term of acoustics or noise on or off, by its name in `settings.term_names()`."""
        with self._lock:
            switched = self._trial.settings.switched(term, on)
            return self.change(acoustics=switched.acoustics, noise=switched.noise)

    def prices(self, before_ping: Callable[[], None] = lambda: None) -> list[Price]:
        """Return what each term of acoustics and noise changes and costs here and now; takes seconds.

        Pings go on meanwhile, more slowly. Raises Error if the terms cannot be judged, or the session is closed.

        before_ping : function called before each ping that this takes; what it raises ends the work, and is passed on
        """

        def check():
            self._thread.check_open()
            before_ping()

        check()  # a simulator takes long to make
        with self._lock:
            settings, pose, bodies = self._trial.settings, self._motion.now().pose, dict(self._moved)
        with (
            collected_warnings(),
            Simulator(
                self.scene,
                settings.device,
                settings.acoustics,
                tolerance=settings.tolerance,
                engine=settings.engine,
            ) as simulator,
        ):
            simulator.place(bodies)
            return price(
                simulator,
                settings.device,
                settings.tolerance,
                [pose],
                settings.acoustics,
                settings.noise,
                check,
            )

    # ---- motion ---------------------------------------------------------------------------------------------

    def set_pose(self, pose: np.ndarray) -> None:
        """Put the sonar somewhere; it then follows the trajectory no more, until `play` or `seek`."""
        with self._lock:
            self._motion.put(pose)

    def move(
        self,
        keys: Collection[str],
        dt_s: float,
        speed_m_s: float = SPEED_M_S,
        turn_rate_rad_s: float = TURN_RATE_RAD_S,
    ) -> np.ndarray:
        """Move the sonar as by keys held for a time, see `sonar_gl.live.key_motion.moved`; return its pose."""
        with self._lock:
            pose = moved(self._motion.now().pose, keys, dt_s, speed_m_s, turn_rate_rad_s)
            self._motion.put(pose)
            return pose

    def play(self) -> None:
        """Follow the trajectory from where it was left; after its end from the beginning."""
        with self._lock:
            self._motion.play()

    def pause(self) -> None:
        """Let the sonar stand where the trajectory has brought it."""
        with self._lock:
            self._motion.pause()

    def seek(self, time_s: float) -> None:
        """Go to a time of the trajectory, seconds since its first pose; it plays on if it was playing."""
        with self._lock:
            self._motion.seek(time_s)

    def move_body(self, name: str, pose: np.ndarray | None) -> None:
        """Put a body, or a plume, elsewhere: (4, 4) world_from_body, or None to take it away."""
        if not isinstance(name, str) or name not in self._home:
            raise unknown_body_error(name, self._home, "a body that is moved must be one of the scene")
        pose = None if pose is None else check_pose(pose, f"the pose of body {name!r}")
        with self._lock:
            self._moved = {**self._moved, name: pose}

    def reset_bodies(self) -> None:
        """Put all bodies back to where the scene has them."""
        with self._lock:
            self._moved = {}

    # ---- frames ---------------------------------------------------------------------------------------------

    def listen(self, on_frame: Callable[[LiveFrame], None], waiting: int = 1) -> Listener:
        """Have a function called with each new frame, in a thread of its own, until the listener is closed.

        The session pings as long as anybody listens. While the function is busy, the last frames wait, as many as
        `waiting`, 1 or more; it misses those before.
        """
        check_function("on_frame", on_frame, "a LiveFrame")
        check_whole_number("waiting", waiting, 1)
        with self._lock:
            if not self._thread.listeners:
                # there were no pings before, or some that were asked for one by one
                self._rate_from_s = time.monotonic()
            return self._thread.listen(on_frame, waiting)

    def next_frame(self) -> LiveFrame:
        """Make a ping now, and return its frame; listeners do not get it."""
        return self._thread.do(lambda: self._sonar.ping(self._request()))

    def still(self, frame: LiveFrame) -> LiveFrame:
        """Return a frame as `sonar-gl render` makes it: with its pose rounded, and samples planned for that pose alone.

        It is the first ping of its noise, at time 0. Its bodies are where the frame has them. Its picture is that of
        `still_of`: gray of 16 bits is (H, W) uint16. Raises Error if the ping fails.
        """
        return self._thread.do(lambda: self._sonar.still(frame))

    def highlight(self, body: str = "") -> None:
        """Have frames say which pixels show a body, in `LiveFrame.highlight`; "" for none."""
        if body:
            body_number(self.scene, body)
        with self._lock:
            self._highlight = body

    # ---- read-outs ------------------------------------------------------------------------------------------

    def at(self, frame: LiveFrame, row: int, column: int) -> Reading | None:
        """Return what a pixel of a frame's picture shows; None outside the fan.

        Makes the frame's ping again with labels, once.
        """
        cells = pixel_cells(frame.ping, frame.settings)
        height, width = cells.shape
        if not (0 <= row < height and 0 <= column < width) or cells[row, column] < 0:
            return None
        return self.reading(frame, *divmod(int(cells[row, column]), len(frame.ping.range_m)))

    def reading(self, frame: LiveFrame, beam: int, bin: int) -> Reading:
        """Return what stands in a bin of a frame's ping; makes it again with labels, once."""
        beam, bin = check_bin(frame, beam, bin)
        return reading_of(self.scene, frame.ping, self._labelled(frame), beam, bin)

    def surface_of(self, frame: LiveFrame, beam: int, bin: int) -> Surface:
        """Return the visible surface whose echo falls into a bin of a frame's ping.

        Its points are those of rays over the width of the beam and the main lobe in elevation. Echoes by way of image
        sources and of side lobes have no such point.
        """
        beam, bin = check_bin(frame, beam, bin)
        return self._thread.do(lambda: self._sonar.surface(frame, beam, bin))

    def _labelled(self, frame: LiveFrame) -> Ping:
        """Return a frame's ping with labels; it is made again, without noise, unless it has them."""
        if frame.ping.body_id is not None:
            return frame.ping
        return self._thread.do(lambda: self._sonar.labelled(frame))

    # ---- end ------------------------------------------------------------------------------------------------

    def close(self) -> None:
        """End the thread, and give back all that it holds; a second call does nothing."""
        self._thread.close()
        self.output.close()
        for listener in self._thread.listeners:
            listener.close()

    def wait_closed(self, timeout_s: float | None = None) -> bool:
        """Wait until the session is closed, or so many seconds; return whether it is."""
        return self._thread.wait_closed(timeout_s)

    # ---- the way of a ping, in the thread ----------------------------------------------------------------------

    def _ping_and_tell(self) -> bool:
        """Ping, and tell the listeners; return whether that succeeded, or other settings may be tried at once."""
        settings = self.settings
        try:
            request = self._request()
            settings = request.settings  # others may have come since
            frame = self._sonar.ping(request)
        except Exception as why:
            if not isinstance(why, Error):
                logger.exception("a ping of a live session failed")
            text = str(why) if isinstance(why, Error) else f"the ping failed ({type(why).__name__}: {why})"
            with self._lock:
                return self._trial.fail(settings, text)
        with self._lock:
            self._frame = frame
            self._trial.succeed(frame.settings)
            listeners = self._thread.listeners
            if listeners:
                self._motion.start()
        for listener in listeners:
            listener.tell(frame)
        return True

    def _request(self) -> FrameRequest:
        """Return what a ping that is made now depends on."""
        with self._lock:
            return FrameRequest(
                settings=self._trial.settings,
                place=self._motion.now(),
                bodies=self._moved,
                highlight=self._highlight,
                gain_from=self._frame,
                rate_from_s=self._rate_from_s,
            )
