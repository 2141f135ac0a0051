"""Publishes the pings of a sonar as topics of ROS 2, while a loop tells it the time and the poses."""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from threading import Event

import numpy as np
from numpy.typing import ArrayLike

from sonar_gl.acoustics.acoustics import Acoustics
from sonar_gl.core.checks import check_kind, check_whole_number, is_iterable, unknown_body_error
from sonar_gl.core.closing import Closable
from sonar_gl.core.errors import Error, MachineError, closed_error, other_process_error
from sonar_gl.core.poses import check_pose
from sonar_gl.core.warn import collected_warnings
from sonar_gl.engine.no_echo import NoEchoWarning
from sonar_gl.imaging.fan_image import colorize, fan_image
from sonar_gl.noise.settings import Noise
from sonar_gl.ping import Ping
from sonar_gl.ros.message_inputs import BodiesInput, ClockInput, FrameInput, PoseInput, RefusedMessages
from sonar_gl.ros.messages import BEAMS, MAX_TIME_S, TF, TF_STATIC, message_types, nanoseconds
from sonar_gl.ros.ping_schedule import PingSchedule
from sonar_gl.ros.publisher_settings import POSE_SOURCES, TOPICS, PublisherSettings
from sonar_gl.ros.transport import Topic, Transport, publish_static
from sonar_gl.scene.scene import Scene, poses_of_parts
from sonar_gl.simulator import Simulator
from sonar_gl.sonar.sonar import Sonar

logger = logging.getLogger(__name__)

TF_DEPTH = 100  # as in tf2_ros
CLOCK_NS = 10_000_000  # 100 times a second, and at each ping; a loop may be quicker
REPORT_S = 10.0  # of real time, between lines of the log


@dataclass(frozen=True)
class StepResult:
    """What a step of the loop did."""

    has_pinged: bool = False  # whether it made a ping, or began one in the background
    # number of pings that are left out from this step on: their time passed between the steps, or they waited for a
    # ping in the background until the next one was due
    n_dropped: int = 0
    has_jumped: bool = False  # whether time jumped, so that the sonar's rate counts from this step on
    waits_for_pose: bool = False  # whether no pose has come yet
    # the Ping that was published since the step before, or None. In the background that is a ping of an earlier step;
    # its `meta["time_s"]` is its time
    ping: Ping | None = field(default=None, compare=False)


@dataclass(frozen=True)
class PublisherCounts:
    """What became of the pings and of the messages that came."""

    pings: int = 0  # number of pings that were published
    dropped: int = 0  # of pings that were left out since they would have come too late
    failed: int = 0  # of pings that could not be made at the poses that came
    jumps: int = 0  # of jumps of time
    refused: int = 0  # of messages, or parts of them, that were ignored

    def __str__(self):
        text = f"{self.pings} pings published, {self.dropped} dropped as they came too late"
        more = {"failed": self.failed, "jumps of time": self.jumps, "messages ignored": self.refused}
        return ", ".join([text, *(f"{number} {what}" for what, number in more.items() if number)])


def _several(transports) -> tuple[Transport, ...]:
    """Return the transports; an Error if they are none."""
    if not is_iterable(transports):
        raise Error(f"transports must be several, as in [DdsTransport()] (got {type(transports).__name__})")
    transports = tuple(transports)
    for one in transports:
        check_kind("each of transports", one, Transport, "such as sonar_gl.ros.DdsTransport()")
    return transports


class Publisher(Closable):
    """Publishes pings over transports. Use it in a `with` block, or call `close()`; it does not close the transports.

    Where the scene places the sonar, it makes a ping at once and does not publish it: the first one is not late then.

    Parameters
    ----------
    scene : Scene
    sonar : Sonar
    transports : of the messages, in and out
    acoustics : Acoustics; None is `Acoustics.physical()`
    noise : Noise, or None for none
    settings : PublisherSettings; None is `PublisherSettings()`
    in_background : make pings beside the loop, which `step` then never holds up: for loops in real time. Otherwise
        `step` returns when the ping is published

    Raises
    ------
    Error
        if an argument is invalid, the extra `live` is not installed, or there is no usable OpenGL.

    Examples
    --------
    >>> with Publisher(load_scene("pylon"), load_sonar("p900-45"), [transport]) as publisher:  # doctest: +SKIP
    ...     while running:
    ...         publisher.step(time_s, world_from_sonar, {"diver": world_from_diver})
    """

    def __init__(
        self,
        scene: Scene,
        sonar: Sonar,
        transports: Sequence[Transport],
        acoustics: Acoustics | None = None,
        noise: Noise | None = None,
        settings: PublisherSettings | None = None,
        in_background: bool = False,
    ):
        self._executor, self._withdrawals, self._process = None, [], os.getpid()
        check_kind("scene", scene, Scene, "sonar_gl.load_scene makes one from a name or a file")
        check_kind("sonar", sonar, Sonar, "sonar_gl.load_sonar makes one from a name or a file")
        check_kind("acoustics", acoustics, Acoustics | None, "such as sonar_gl.Acoustics.physical()")
        check_kind("noise", noise, Noise | None, "such as sonar_gl.Noise.physical()")
        check_kind("settings", settings, PublisherSettings | None, "such as PublisherSettings(rate_hz=10)")
        self.settings = PublisherSettings() if settings is None else settings
        self._types = message_types()
        self._transports = _several(transports)
        self._topics = self._make_topics()
        acoustics = Acoustics.physical() if acoustics is None else acoustics
        most_hz = sonar.max_ping_rate_hz(acoustics.assumed_sound_speed_m_s())
        self.rate_hz = self.settings.rate_hz or most_hz
        if self.rate_hz > most_hz * (1 + 1e-9):
            logger.warning(
                "%s makes at most %.4g pings per second at this range; %.4g are asked for",
                sonar.name,
                most_hz,
                self.rate_hz,
            )
        self._schedule = PingSchedule(self.rate_hz)
        self._refused = RefusedMessages()
        self._n_dropped = self._n_jumps = 0  # the loop counts these, and the thread of the simulation those
        self._n_pings = self._n_failed = 0
        self._in_background, self._work, self._published = in_background, None, None
        self._clock_ns, self._reported_s, self._reported = None, time.monotonic(), PublisherCounts()
        self._is_placed, self._pose, self._moved = False, None, {}
        self._parts_of = scene.parts_of
        self._empty_models = {model for model in scene.models if not scene.parts_of(model)}
        self._names = {*scene.models, *(thing.name for thing in scene.bodies_and_plumes)} - self._empty_models
        self._is_own_pose, self._are_own_bodies = True, True
        self._sonar, self._noise = sonar, noise
        self._executor = ThreadPoolExecutor(1, "simulation")
        try:
            self._simulator = self._executor.submit(
                Simulator, scene, sonar, acoustics, tolerance=self.settings.tolerance
            ).result()
            self._pose_input, self._bodies_input = self._make_inputs(scene)
            self._other_clock = self._make_other_clock()
            if self._pose_input is None and scene.sonar_pose is not None:
                self._pose = scene.sonar_pose @ np.linalg.inv(self.settings.vehicle_from_sonar)
            for topic in self._topics.values():
                for transport in self._transports:
                    transport.advertise(topic)
            if scene.sonar_pose is not None:
                self._executor.submit(self._make_ready, scene.sonar_pose).result()
        except BaseException:
            self.close()
            raise

    # ---- topics --------------------------------------------------------------------------------------

    def _make_topics(self) -> dict[str, Topic]:
        """Return what is published, by kind; with "tf" also "tf_static"."""
        topics = {}
        for kind, name in self.settings.topic_names.items():
            if kind == "tf":
                topics["tf_static"] = Topic.of_type(f"{name}_static", TOPICS[kind], latched=True, depth=1)
                if self.settings.reads_tf:  # others publish the frame that moves
                    continue
            depth = {"depth": TF_DEPTH} if kind == "tf" else {}
            topics[kind] = Topic.of_type(name, TOPICS[kind], **depth)
        return topics

    def _make_inputs(self, scene: Scene):
        settings, source, poses, bodies = self.settings, self.settings.pose_from, None, None
        if source is not None and source.kind == "tf":
            poses = FrameInput(source.name, settings.world_frame, self._refused)
            self._subscribe(TF, POSE_SOURCES["tf"], poses.receive, depth=TF_DEPTH)
            latched = {"reliable": True, "latched": True}
            self._subscribe(TF_STATIC, POSE_SOURCES["tf"], poses.receive, depth=TF_DEPTH, **latched)
        elif source is not None:
            msgtype = POSE_SOURCES[source.kind]
            poses = PoseInput(source.name, msgtype, settings.world_frame, self._refused)
            self._subscribe(source.name, msgtype, poses.receive)
        if settings.bodies_from is not None:
            bodies = BodiesInput(settings.bodies_from, scene, settings.world_frame, self._refused)
            self._subscribe(settings.bodies_from, POSE_SOURCES["tf"], bodies.receive, depth=TF_DEPTH)
        return poses, bodies

    def _make_other_clock(self) -> Event | None:
        """Subscribe to the clock of others while this one is the clock; a transport leaves its own messages out."""
        if "clock" not in self._topics:
            return None
        has_come = Event()
        self._subscribe(self._topics["clock"].name, TOPICS["clock"], lambda _message: has_come.set(), depth=1)
        return has_come

    def _subscribe(self, name: str, msgtype: str, receive: Callable, reliable: bool = False, **quality):
        """Have a function receive a topic; by best effort, which every publisher offers."""
        topic = Topic.of_type(name, msgtype, reliable=reliable, **quality)
        for transport in self._transports:
            self._withdrawals.append(transport.subscribe(topic, receive))

    def clock(self, name: str = "/clock") -> ClockInput:
        """Return what follows the time of a topic, for the loop; the publisher must not publish this topic itself."""
        if name in (topic.name for topic in self._topics.values()):
            raise Error(
                f"a clock must not be published and followed at once (got {name!r}; set its topic to None)"
            )
        times = ClockInput(name, self._refused)
        self._subscribe(name, TOPICS["clock"], times.receive, depth=1)
        return times

    # ---- the loop ------------------------------------------------------------------------------------

    @property
    def renderer(self) -> str:
        return self._simulator.gl_info["renderer"]

    @property
    def counts(self) -> PublisherCounts:
        return PublisherCounts(
            self._n_pings, self._n_dropped, self._n_failed, self._n_jumps, self._refused.total
        )

    def step(self, time_s: float, pose: ArrayLike | None = None, bodies: dict | None = None) -> StepResult:
        """Tell the time and, where no messages do, the poses; ping if the sonar's time has come.

        Parameters
        ----------
        time_s : time of the simulation, seconds, 0 or more; it becomes the stamp of the ping
        pose : (4, 4) pose of the vehicle in the world, or of the sonar if the settings name no vehicle; None for the
            last that came by messages, or else that of the step before, or the scene's
        bodies : names to (4, 4) world_from_body, or to None to take one away; others stay where they are

        Returns
        -------
        StepResult

        Raises
        ------
        Error
            if an argument is invalid, the ping cannot be made at the caller's poses, or the publisher is closed. In
            the background, what is wrong with a ping is raised by a later step.
        """
        return self.step_at(nanoseconds(time_s), pose, bodies)

    def step_at(self, time_ns: int, pose: ArrayLike | None = None, bodies: dict | None = None) -> StepResult:
        """Do what `step` does, at a time in nanoseconds, a whole number."""
        if os.getpid() != self._process:  # a forked process lacks the thread of the simulation
            raise other_process_error("Publisher")
        if self._executor is None:
            raise closed_error("Publisher")
        time_ns = check_whole_number(
            "time_ns", time_ns, 0, MAX_TIME_S * 10**9 - 1, "give nanoseconds; `step` takes seconds"
        )
        if self._work is not None and self._work.done():
            self._finish()
        if not self._is_placed:
            self._place_fixed(time_ns)
            self._is_placed = True
        self._take_poses(pose, bodies)
        if self._pose is None:
            self._tick(time_ns)
            self._report()
            return StepResult(waits_for_pose=True)  # nothing has been published yet
        slot = self._schedule.advance(time_ns, is_ready=self._work is None)
        self._n_dropped += slot.n_dropped
        self._n_jumps += slot.has_jumped
        self._tick(time_ns, slot.is_due)
        if slot.is_due:
            is_own = self._is_own_pose and self._are_own_bodies
            self._work = self._executor.submit(self._ping, time_ns, self._pose, self._moved, is_own)
            self._moved = {}
            if not self._in_background:
                self._finish()
        self._report()
        published, self._published = self._published, None
        return StepResult(slot.is_due, slot.n_dropped, slot.has_jumped, ping=published)

    def _finish(self) -> None:
        """Wait for the ping that is made, and raise what was wrong with it."""
        work, self._work = self._work, None
        self._published = work.result()

    def _tick(self, time_ns: int, is_due: bool = False) -> None:
        """Publish the clock, also before a ping, whose stamp must not lie ahead of it."""
        if "clock" not in self._topics or time_ns == self._clock_ns:
            return
        if is_due or self._clock_ns is None or time_ns // CLOCK_NS != self._clock_ns // CLOCK_NS:
            self._clock_ns = time_ns
            self._send("clock", self._types.clock(time_ns), time_ns)

    def _take_poses(self, pose, bodies: dict | None) -> None:
        """Keep the poses of the caller, or those that came by messages."""
        # all is checked before anything is kept
        own, moved = None if pose is None else check_pose(pose), self._checked(bodies)
        if own is not None:
            self._pose, self._is_own_pose = own, True
        elif self._pose_input is not None and (came := self._pose_input.latest()) is not None:
            self._pose, self._is_own_pose = came, False
        self._moved |= moved
        if self._bodies_input is not None and (moved := self._bodies_input.take()):
            self._moved |= moved
            self._are_own_bodies = False  # from now on, since they stay where they are

    def _checked(self, bodies: dict | None) -> dict:
        """Return copies of the poses of bodies: a ping takes them later, when a loop may have changed its arrays."""
        if bodies is None:
            return {}
        check_kind("bodies", bodies, dict, 'such as {"diver": sonar_gl.pose(x=5)}')
        for name in bodies:
            if name not in self._names:
                raise unknown_body_error(name, self._names, models=self._empty_models)
        poses = {
            name: None if pose is None else check_pose(pose, f"the pose of body {name!r}")
            for name, pose in bodies.items()
        }
        # now, since a later step may move a model whose part this one moves
        return poses_of_parts(poses, self._parts_of)

    # ---- a ping, in the thread of the simulation -------------------------------------------------------

    def _ping(self, time_ns: int, vehicle_pose: np.ndarray, bodies: dict, is_own: bool) -> Ping | None:
        """Make a ping, publish and return it; None if it cannot be made.

        vehicle_pose : (4, 4) world_from_vehicle, or that of the sonar if the settings name no vehicle
        bodies : poses of those that have moved since the ping before
        is_own : whether the caller placed all that is there, and is told what is wrong with the ping
        """
        settings = self.settings
        pose = vehicle_pose @ settings.vehicle_from_sonar
        if bodies:
            self._simulator.place(bodies)
        try:
            with collected_warnings(NoEchoWarning):  # a device does not say that it sees nothing
                ping = self._simulator.ping(
                    pose, self._noise, settings.seed, ping_number=self._n_pings, time_s=time_ns / 1e9
                )
        except MachineError:
            raise
        except Error as why:
            if is_own:
                raise
            if not self._n_failed:
                text = "a ping cannot be made at the poses that came: %s (others are only counted)"
                logger.warning(text, why)
            self._n_failed += 1
            return None
        if "tf" in self._topics:
            link = settings.world_frame, settings.vehicle or settings.frame, vehicle_pose
            self._send("tf", self._types.transforms([self._types.transform(time_ns, *link)]), time_ns)
        for kind, message in self._messages_of(ping, time_ns):
            self._send(kind, message, time_ns)
        self._n_pings += 1
        return ping

    def _make_ready(self, pose: np.ndarray) -> None:
        """Make the messages of a ping and publish none, so that the first one takes hardly longer than others.

        Numerical kernels are compiled, samples searched and encoders of messages made before the sonar's time begins.
        """
        try:
            with collected_warnings(NoEchoWarning):
                ping = self._simulator.ping(pose, self._noise, self.settings.seed)
            links = [self._types.transform(0, self.settings.world_frame, self.settings.frame, pose)]
            for message in (self._types.transforms(links), *dict(self._messages_of(ping, 0)).values()):
                self._types.encode(message)
        except MachineError:
            raise
        except Error as why:  # of a place where the sonar may never be
            logger.debug("no ping can be made where the scene places the sonar: %s", why)

    def _place_fixed(self, time_ns: int) -> None:
        """Publish the frames that do not move: that of the sonar on its vehicle, and that of the beams."""
        if "tf_static" not in self._topics:
            return
        settings, turn = self.settings, np.eye(4)
        turn[:3, :3] = self._sonar.sonar_from_head[:3, :3] @ BEAMS[settings.y_sign]
        links = [(settings.frame, settings.beams_frame, turn)]
        if settings.vehicle is not None:
            links.insert(0, (settings.vehicle, settings.frame, settings.vehicle_from_sonar))
        links = [self._types.transform(time_ns, *link) for link in links]
        for transport in self._transports:
            publish_static(transport, self._topics["tf_static"], links, time_ns)

    def _messages_of(self, ping: Ping, time_ns: int) -> Iterator[tuple[str, object]]:
        types, settings = self._types, self.settings
        header = types.header(time_ns, settings.beams_frame)
        if "projected_image" in self._topics:
            yield "projected_image", types.ping(header, ping, settings.y_sign)
        if "raw_image" in self._topics:
            yield "raw_image", types.raw_ping(header, ping, settings.y_sign)
        if "image" in self._topics:
            law = ping.counts_law()
            picture = fan_image(ping, settings.image_height, law)
            if settings.colormap is None:
                picture = law.counts_of(picture)
            else:
                picture = colorize(picture, settings.colormap)
            yield "image", types.image(header, picture)
        if "points" in self._topics:
            yield "points", self._points(ping.pose, time_ns)

    def _points(self, pose: np.ndarray, time_ns: int):
        settings = self.settings
        points, echo = self._simulator.point_cloud(pose, settings.points_columns, settings.points_rows)
        points = points @ self._sonar.sonar_from_head[:3, :3].T.astype(np.float32)
        header = self._types.header(time_ns, settings.frame)
        return self._types.points(header, points, echo)

    def _send(self, kind: str, message, time_ns: int) -> None:
        topic, data = self._topics[kind], self._types.encode(message)
        # the loop sends the clock while the simulation sends a ping: transports may be used by several threads
        for transport in self._transports:
            transport.publish(topic, data, time_ns)

    # ---- reports and end -----------------------------------------------------------------------------

    def _report(self) -> None:
        """Log another clock, once, and what was lost, now and then."""
        if self._other_clock is not None and self._other_clock.is_set():
            self._other_clock = None
            logger.warning(
                "another program publishes %s as well, so that time jumps to and fro for all that follow it; one alone "
                'must do so, and the others follow it (--clock ros) or leave it out (topics={"clock": None})',
                self._topics["clock"].name,
            )
        now_s = time.monotonic()
        if now_s < self._reported_s + REPORT_S:
            return
        counts, before = self.counts, self._reported
        self._reported_s, self._reported = now_s, counts
        if self._pose is None:
            logger.warning("no pose of the sonar has come yet")
        # the first of each kind of message that is refused is in the log already, and others may come for ever
        if (counts.dropped, counts.failed) > (before.dropped, before.failed):
            logger.warning("%s", counts)

    def close(self) -> None:
        """Finish the ping that is made, and give back what it holds; `counts` stays. May be called twice."""
        executor, self._executor = self._executor, None
        if executor is None or os.getpid() != self._process:  # of a fork: all is the parent's
            return
        for withdraw in self._withdrawals:
            withdraw()
        self._withdrawals.clear()
        simulator = getattr(self, "_simulator", None)
        if simulator is not None:
            executor.submit(simulator.close).result()  # after the ping that is made
        executor.shutdown()
        if self._work is not None and (why := self._work.exception()) is not None:
            logger.warning("the last ping could not be made: %s", why)
