"""A sonar that pings a scene again and again, while its settings, its pose and the bodies change."""

from __future__ import annotations

import logging
import math
import time
import warnings
from collections import OrderedDict, deque
from collections.abc import Callable, Collection, Mapping
from dataclasses import replace
from pathlib import Path
from threading import Condition, Thread, current_thread

import numpy as np

from sonar_gl.analysis.terms import Price, price
from sonar_gl.core.checks import check_kind, check_number, check_whole_number
from sonar_gl.core.errors import Error, closed_error, nearest_names
from sonar_gl.core.poses import check_pose
from sonar_gl.core.poses import pose as make_pose
from sonar_gl.core.worker import Job
from sonar_gl.live.command_line import SceneSource, rounded_pose_numbers
from sonar_gl.live.frame import LiveFrame, LiveState, Reading, Surface
from sonar_gl.live.listeners import Listener
from sonar_gl.live.motion import SPEED_M_S, TURN_RATE_RAD_S, moved
from sonar_gl.live.output import DEFAULT_FOLDER, LiveOutput
from sonar_gl.live.pictures import picture_of, pixel_bins, pixels_of
from sonar_gl.live.pose_track import PoseTrack
from sonar_gl.live.settings import LiveSettings
from sonar_gl.live.simulators import SimulatorPool
from sonar_gl.live.surfaces import surface_in_bin
from sonar_gl.ping import Ping
from sonar_gl.scene.scene import Scene
from sonar_gl.simulator import Simulator
from sonar_gl.sonar.counts import LEVEL_BOUND_DB

logger = logging.getLogger(__name__)

RATE_PINGS = 20  # of which the ping rate is the mean
RETRY_S = 0.5  # after a ping that failed
KEPT_LABELS = 4  # pings whose labels are kept for read-outs


def _check_bin(frame: LiveFrame, beam: int, bin: int) -> tuple[int, int]:
    """Return the indices of a bin of a frame's ping; raise Error if there is no such bin."""
    beams, bins = frame.ping.intensity.shape
    return check_whole_number("beam", beam, 0, beams - 1), check_whole_number("bin", bin, 0, bins - 1)


class LiveSession:
    """Pings a scene in a thread of its own while somebody listens. Use it in a `with` block, or call `close()`.

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

    Raises
    ------
    Error
        if there is no pose, or the first ping fails.
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
        self._home = {thing.name: _pose_of(thing) for thing in (*scene.bodies, *scene.plumes)}
        self._changed = Condition()  # guards all that follows
        self._settings = self._good_settings = settings
        self._settings_problem = self._ping_problem = ""
        self._pose, self._is_following, self._is_playing = check_pose(pose), track is not None, True
        self._position_s, self._position_at_s = 0.0, time.monotonic()
        self._runs = False  # the trajectory's time: from the first frame that somebody gets
        self._moved = {}
        self._highlight = ""
        self._listeners: list[Listener] = []
        self._requests: deque[Job] = deque()
        self._is_closing = False
        # of the worker alone
        self._began_s, self._number, self._pinged_s = time.monotonic(), 0, deque(maxlen=RATE_PINGS)
        self._placed: Mapping = self._moved
        self._labels: OrderedDict[int, Ping] = OrderedDict()
        self._frame: LiveFrame | None = None
        self._pool = SimulatorPool(scene)
        self._thread = Thread(target=self._serve, name="sonar_gl live", daemon=True)
        self._thread.start()
        try:
            self._frame = self._do(self._ping)
        except BaseException:
            self.close()
            raise

    # ---- state ----------------------------------------------------------------------------------------------

    @property
    def settings(self) -> LiveSettings:
        """The settings of the next ping."""
        return self._settings

    @property
    def frame(self) -> LiveFrame:
        """The last frame."""
        return self._frame

    @property
    def pose(self) -> np.ndarray:
        """Where the sonar is now, (4, 4) world_from_sonar."""
        with self._changed:
            return self._pose_now()[0]

    @property
    def highlighted(self) -> str:
        """Name of the body whose pixels frames highlight; "" for none."""
        return self._highlight

    def state(self) -> LiveState:
        """Return what the session does now."""
        duration_s = 0.0 if self.track is None else self.track.duration_s
        with self._changed:
            return LiveState(
                settings=self._settings,
                problem=self._settings_problem or self._ping_problem,
                is_following=self._is_following,
                is_playing=self._is_following and self._is_playing and self._position_now() < duration_s,
                position_s=self._position_now(),
                duration_s=duration_s,
                rate_hz=0.0 if self._frame is None else self._frame.rate_hz,
            )

    def bodies(self) -> dict[str, np.ndarray | None]:
        """Return the names of all bodies and plumes, and where they are now: (4, 4) world_from_body."""
        with self._changed:
            return {**self._home, **self._moved}

    # ---- settings -------------------------------------------------------------------------------------------

    def change(self, **values) -> LiveSettings:
        """Change some settings from the next ping on, as `LiveSettings.changed` does, and return the new ones.

        Settings that turn out to be impossible when they are tried, such as more samples than a driver can draw, are
        taken back: `state().problem` then says why.

        Raises
        ------
        Error
            if a value is invalid; the settings then stay as they are.
        """
        with self._changed:
            settings = self._settings.changed(**values)
            self._settings, self._settings_problem = settings, ""
            self._changed.notify_all()
            return settings

    def switch(self, term: str, on: bool) -> LiveSettings:
        """Switch a term of acoustics or noise on or off, by its name in `settings.term_names()`."""
        with self._changed:
            switched = self._settings.switched(term, on)
            return self.change(acoustics=switched.acoustics, noise=switched.noise)

    def prices(self, before_ping: Callable[[], None] = lambda: None) -> list[Price]:
        """Return what each term of acoustics and noise changes and costs here and now; takes seconds.

        Pings go on meanwhile, more slowly.

        Parameters
        ----------
        before_ping : function called before each ping that this takes; what it raises ends the work, and is passed on

        Raises
        ------
        Error
            if the terms cannot be judged, or the session is closed meanwhile.
        """

        def check():
            self._check_open()
            before_ping()

        check()  # a simulator takes long to make
        with self._changed:
            settings, pose, bodies = self._settings, self._pose_now()[0], dict(self._moved)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            with Simulator(
                self.scene,
                settings.device,
                settings.acoustics,
                tolerance=settings.tolerance,
                engine=settings.engine,
            ) as simulator:
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
        pose = check_pose(pose)
        with self._changed:
            self._hold_position()
            self._pose, self._is_following = pose, False
            self._changed.notify_all()

    def move(
        self,
        keys: Collection[str],
        dt_s: float,
        speed_m_s: float = SPEED_M_S,
        turn_rate_rad_s: float = TURN_RATE_RAD_S,
    ) -> np.ndarray:
        """Move the sonar as by keys that were held for a time, see `motion.moved`; return its new pose."""
        with self._changed:
            pose = moved(self._pose_now()[0], keys, dt_s, speed_m_s, turn_rate_rad_s)
            self.set_pose(pose)
            return pose

    def play(self) -> None:
        """Follow the trajectory from where it was left; after its end from the beginning."""
        self._follow(True)

    def pause(self) -> None:
        """Let the sonar stand where the trajectory has brought it."""
        self._follow(False)

    def seek(self, time_s: float) -> None:
        """Go to a time of the trajectory, seconds since its first pose; it plays on if it was playing."""
        self._check_track()
        time_s = check_number("time_s of a trajectory", time_s, 0.0, self.track.duration_s, "give seconds")
        with self._changed:
            self._hold_position()
            self._position_s, self._is_following = time_s, True
            self._changed.notify_all()

    def move_body(self, name: str, pose: np.ndarray | None) -> None:
        """Put a body, or a plume, elsewhere: (4, 4) world_from_body, or None to take it away."""
        if name not in self._home:
            hint = nearest_names(name, self._home) if self._home else "there are none"
            raise Error(f"a body that is moved must be one of the scene (got {name!r}; {hint})")
        pose = None if pose is None else check_pose(pose, f"the pose of body {name!r}")
        with self._changed:
            self._moved = {**self._moved, name: pose}
            self._changed.notify_all()

    def reset_bodies(self) -> None:
        """Put all bodies back to where the scene has them."""
        with self._changed:
            self._moved = {}
            self._changed.notify_all()

    # ---- frames ---------------------------------------------------------------------------------------------

    def listen(self, on_frame: Callable[[LiveFrame], None], waiting: int = 1) -> Listener:
        """Have a function called with each new frame, in a thread of its own, until the listener is closed.

        The session pings as long as anybody listens. While the function is busy, the last frames wait, as many as
        `waiting`; it misses those before.
        """
        with self._changed:
            self._check_open()
            listener = Listener(on_frame, self._forget_listener, waiting)
            self._listeners.append(listener)
            self._changed.notify_all()
            return listener

    def next_frame(self) -> LiveFrame:
        """Make a ping now, and return its frame; listeners do not get it."""
        return self._do(self._ping)

    def still(self, frame: LiveFrame) -> LiveFrame:
        """Return a frame as `sonar-gl render` makes it: with its pose rounded, and samples planned for that pose alone.

        It is the first ping of its noise, at time 0. Its bodies are where the frame has them. Raises Error if the ping
        fails.
        """
        return self._do(lambda: self._still(frame))

    def highlight(self, body: str = "") -> None:
        """Have frames say which pixels show a body, in `LiveFrame.highlight`; "" for none."""
        if body:
            self._number_of(body)
        with self._changed:
            self._highlight = body

    # ---- read-outs ------------------------------------------------------------------------------------------

    def at(self, frame: LiveFrame, row: int, column: int) -> Reading | None:
        """Return what a pixel of a frame's picture shows; None outside the fan.

        Makes the frame's ping again with labels, once.
        """
        bins = pixel_bins(frame.ping, frame.settings)
        height, width = bins.beam.shape
        if not (0 <= row < height and 0 <= column < width) or bins.beam[row, column] < 0:
            return None
        return self.reading(frame, int(bins.beam[row, column]), int(bins.bin[row, column]))

    def reading(self, frame: LiveFrame, beam: int, bin: int) -> Reading:
        """Return what stands in a bin of a frame's ping; makes it again with labels, once."""
        beam, bin = _check_bin(frame, beam, bin)
        ping, labels = frame.ping, self._labels_of(frame)
        intensity, number = float(ping.intensity[beam, bin]), int(labels.body_id[beam, bin])
        elevation_rad = float(labels.elevation_rad[beam, bin])
        return Reading(
            beam=beam,
            bin=bin,
            azimuth_rad=float(ping.azimuth_rad[beam]),
            range_m=float(ping.range_m[bin]),
            body=self.scene.bodies[number - 1].name if number else "",
            elevation_rad=elevation_rad if math.isfinite(elevation_rad) else None,
            level_db=10 * math.log10(intensity) if intensity > 0 else -math.inf,
            count=int(ping.counts()[beam, bin]),
        )

    def surface_of(self, frame: LiveFrame, beam: int, bin: int) -> Surface:
        """Return the visible surface whose echo falls into a bin of a frame's ping.

        Its points are those of rays over the width of the beam and the main lobe in elevation. Echoes by way of image
        sources and of side lobes have no such point.
        """
        beam, bin = _check_bin(frame, beam, bin)
        return self._do(lambda: self._surface_of(frame, beam, bin))

    def bins_of(self, frame: LiveFrame, body: str) -> np.ndarray:
        """Return the bins of a frame's ping in which a body has the strongest echo, (B, K) bool."""
        return self._labels_of(frame).body_id == self._number_of(body)

    def pixels_of(self, frame: LiveFrame, body: str) -> np.ndarray:
        """Return the pixels of a frame's picture in which a body has the strongest echo, (H, W) bool."""
        return pixels_of(self.bins_of(frame, body), pixel_bins(frame.ping, frame.settings))

    # ---- end ------------------------------------------------------------------------------------------------

    def close(self) -> None:
        """End the thread, and give back all that it holds; a second call does nothing."""
        with self._changed:
            self._is_closing = True
            self._changed.notify_all()
        if current_thread() is not self._thread:
            self._thread.join()
        self.output.close()
        for listener in list(self._listeners):
            listener.close()

    def wait_closed(self, timeout_s: float | None = None) -> bool:
        """Wait until the session is closed, or so many seconds; return whether it is."""
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()

    # ---- inner parts: with the lock held --------------------------------------------------------------------

    def _check_open(self) -> None:
        if self._is_closing:
            raise closed_error("LiveSession")

    def _check_track(self) -> None:
        if self.track is None:
            raise Error("there is no trajectory to follow (give a file of poses by --poses)")

    def _follow(self, plays: bool) -> None:
        self._check_track()
        with self._changed:
            self._hold_position()
            if plays and self._position_s >= self.track.duration_s:
                self._position_s = 0.0
            self._is_following, self._is_playing = True, plays
            self._runs = self._runs or plays
            self._changed.notify_all()

    def _position_now(self) -> float:
        if self.track is None:
            return 0.0
        goes_on = self._is_following and self._is_playing and self._runs
        gone_s = time.monotonic() - self._position_at_s if goes_on else 0.0
        return min(self._position_s + gone_s, self.track.duration_s)

    def _hold_position(self) -> None:
        """Count the trajectory's time from where it is now."""
        self._position_s, self._position_at_s = self._position_now(), time.monotonic()

    def _pose_now(self) -> tuple[np.ndarray, float]:
        """Return the sonar's pose and the time in seconds that belongs to it."""
        if not self._is_following:
            return self._pose, time.monotonic() - self._began_s
        self._pose = self.track.at(self._position_now())
        return self._pose, self._position_now()

    def _number_of(self, body: str) -> int:
        """Return a body's number in labels."""
        names = [one.name for one in self.scene.bodies]
        if body not in names:
            hint = nearest_names(body, names) if names else "there are none"
            raise Error(f"a body must be one of the scene (got {body!r}; {hint})")
        return 1 + names.index(body)

    def _forget_listener(self, listener: Listener) -> None:
        with self._changed:
            if listener in self._listeners:
                self._listeners.remove(listener)

    # ---- inner parts: the worker ----------------------------------------------------------------------------

    def _do(self, work: Callable):
        """Have the worker do something between two pings; return its answer, or raise its exception."""
        if current_thread() is self._thread:
            return work()
        job = Job(work)
        with self._changed:
            self._check_open()
            self._requests.append(job)
            self._changed.notify_all()
            while not job.is_over and self._thread.is_alive():
                self._changed.wait(0.5)
        if not job.is_over:
            raise closed_error("LiveSession")
        return job.result()

    def _serve(self) -> None:
        """Ping and answer requests until the session is closed."""
        next_s = 0.0
        try:
            while True:
                with self._changed:
                    while not (self._is_closing or self._requests):
                        wait_s = next_s - time.monotonic() if self._listeners else None
                        if wait_s is not None and wait_s <= 0:
                            break
                        self._changed.wait(wait_s)
                    if self._is_closing:
                        return
                    request = self._requests.popleft() if self._requests else None
                if request is None:
                    period_s, now_s = 1 / self._settings.max_rate_hz, time.monotonic()
                    # a ping that is late is not made up for, but for what a timer is late by
                    next_s = (now_s if now_s - next_s > period_s else next_s) + period_s
                    if not self._try_to_ping():
                        next_s = time.monotonic() + RETRY_S
                    continue
                request.begin()
                with self._changed:
                    self._changed.notify_all()
        finally:
            self._pool.close()
            with self._changed:
                self._is_closing = True
                self._changed.notify_all()

    def _try_to_ping(self) -> bool:
        """Ping, and tell the listeners; return whether that succeeded, or other settings may be tried at once."""
        settings = self._settings
        try:
            frame = self._ping()
        except Exception as why:
            if not isinstance(why, Error):
                logger.exception("a ping of a live session failed")
            text = str(why) if isinstance(why, Error) else f"the ping failed ({type(why).__name__}: {why})"
            with self._changed:
                if settings == self._good_settings:
                    self._ping_problem = text
                    return False
                if self._settings == settings:
                    self._settings, self._settings_problem = self._good_settings, text
                return True
        with self._changed:
            self._frame, self._ping_problem, self._good_settings = frame, "", frame.settings
            listeners = list(self._listeners)
            if listeners and not self._runs:
                self._hold_position()
                self._runs = True
        for listener in listeners:
            listener.tell(frame)
        return True

    def _simulator(self, settings: LiveSettings) -> Simulator:
        """Return the simulator of some settings; another law of counts needs no other one."""
        sonar = replace(settings.device, counts=settings.sonar.counts)
        return self._pool.simulator(sonar, settings.acoustics, settings.tolerance, settings.engine)

    def _ping(self) -> LiveFrame:
        """Return the frame of a ping from where all is now."""
        with self._changed:
            settings, (pose, time_s), bodies = self._settings, self._pose_now(), self._moved
            highlight = self._highlight
        self._place(bodies)
        simulator, number = self._simulator(settings), self._number
        self._number += 1
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", UserWarning)
            ping = simulator.ping(
                pose,
                settings.noise,
                settings.seed,
                ping_number=number,
                time_s=time_s,
                labels=bool(highlight),
                label_level_db=_label_level_db(self._frame, settings) if highlight else None,
            )
        ping = replace(ping, sonar=settings.device)
        shown = None
        if highlight:
            shown = pixels_of(ping.body_id == self._number_of(highlight), pixel_bins(ping, settings))
        self._pinged_s.append(time.monotonic())
        gone_s = self._pinged_s[-1] - self._pinged_s[0]
        return LiveFrame(
            number=number,
            clock_s=self._pinged_s[-1] - self._began_s,
            time_s=time_s,
            pose=pose,
            ping=ping,
            picture=picture_of(ping, settings),
            settings=settings,
            rate_hz=(len(self._pinged_s) - 1) / gone_s if gone_s > 0 else 0.0,
            samples=simulator.sampling.count(settings.device),
            bodies=bodies,
            highlight=shown,
            notes=tuple(dict.fromkeys(str(one.message) for one in caught)),
        )

    def _labels_of(self, frame: LiveFrame) -> Ping:
        """Return a frame's ping with labels; it is made again, without noise, unless it has them."""
        if frame.ping.body_id is not None:
            return frame.ping
        return self._do(lambda: self._make_labels(frame))

    def _make_labels(self, frame: LiveFrame) -> Ping:
        if frame.number not in self._labels:
            while len(self._labels) >= KEPT_LABELS:
                self._labels.popitem(last=False)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)
                self._labels[frame.number] = self._simulator(frame.settings).ping(
                    frame.pose,
                    labels=True,
                    time_s=frame.time_s,
                    bodies=self._home | frame.bodies,
                    label_level_db=_label_level_db(frame, frame.settings),
                )
        return self._labels[frame.number]

    def _still(self, frame: LiveFrame) -> LiveFrame:
        settings, pose = frame.settings, make_pose(*rounded_pose_numbers(frame.pose))
        self._place(frame.bodies)  # the next ping puts them back
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            world = self._simulator(settings)
            with Simulator(
                world, settings.device, settings.acoustics, tolerance=settings.tolerance
            ) as simulator:
                simulator.plan([pose])
                ping = simulator.ping(pose, settings.noise, settings.seed)
                samples = simulator.sampling.count(settings.device)
        return replace(
            frame, number=0, time_s=0.0, pose=pose, ping=ping, picture=picture_of(ping, settings), samples=samples,
            highlight=None, notes=(),
        )  # fmt: skip

    def _surface_of(self, frame: LiveFrame, beam: int, bin: int) -> Surface:
        """Return the surface of a bin, with the bodies where they were in the frame."""
        settings = frame.settings
        self._place(frame.bodies)  # the next ping puts them back
        return surface_in_bin(
            self._simulator(settings), settings.device, settings.acoustics, frame.pose, beam, bin
        )

    def _place(self, bodies: Mapping[str, np.ndarray | None]) -> None:
        """Have the bodies where some of them were moved to."""
        if bodies is not self._placed:
            self._pool.place(self._home | bodies)
            self._placed = bodies


def _label_level_db(frame: LiveFrame, settings: LiveSettings) -> float:
    """Return the level from which on a bin is not black, dB, with the gain that the settings have in a frame."""
    least = settings.law.least_shown(frame.ping.intensity)
    return min(max(10 * math.log10(least), -LEVEL_BOUND_DB), LEVEL_BOUND_DB)


def _pose_of(thing) -> np.ndarray:
    return thing.pose
