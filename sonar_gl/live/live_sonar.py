"""The sonar of a live session: it makes the frame of a ping from where all is, and frames again with other samples."""

from __future__ import annotations

import math
import time
from collections import OrderedDict, deque
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from sonar_gl.core.poses import pose as make_pose
from sonar_gl.core.warn import collected_warnings
from sonar_gl.engine.pipeline import make_ping
from sonar_gl.engine.request import PingRequest
from sonar_gl.live.command_line import rounded_pose_numbers
from sonar_gl.live.frame import LiveFrame, Surface, body_number
from sonar_gl.live.pictures import picture_of, pixel_cells, pixels_of, still_of
from sonar_gl.live.settings import LiveSettings
from sonar_gl.live.simulators import SimulatorPool
from sonar_gl.live.sonar_motion import TimedPose
from sonar_gl.live.surfaces import surface_in_bin
from sonar_gl.noise.hidden_labels import without_hidden_labels
from sonar_gl.noise.reception import receiver_power
from sonar_gl.ping import Ping
from sonar_gl.scene.extent import place_texts
from sonar_gl.scene.scene import Scene
from sonar_gl.simulator import Simulator
from sonar_gl.sonar.counts import LEVEL_BOUND_DB

RATE_S = 3.0  # of the last pings, whose mean rate is shown; two of them if they are further apart
KEPT_LABELS = 4  # pings whose labels are kept for read-outs


@dataclass(frozen=True, eq=False)
class FrameRequest:
    """What a ping of a live session depends on, taken at one moment."""

    settings: LiveSettings
    place: TimedPose  # of the sonar
    # names of the bodies and plumes that were moved, to (4, 4) world_from_body, or None for those taken away
    bodies: Mapping[str, np.ndarray | None]
    highlight: str = ""  # name of the body whose pixels the frame has; "" for none
    # by whose gain bins of a highlighted body are black or not; None for the first ping
    gain_from: LiveFrame | None = None
    rate_from_s: float = -math.inf  # `time.monotonic` from which on pings count for the ping rate


class LiveSonar:
    """Makes frames of one scene. To be used by one thread, then closed.

    began_s : `time.monotonic` at which the clock of the frames is 0
    """

    def __init__(self, scene: Scene, began_s: float):
        self._scene, self._began_s = scene, began_s
        self._home = {one.name: one.pose for one in scene.bodies_and_plumes}
        self._pool = SimulatorPool(scene)
        self._number, self._pinged_s = 0, deque()
        # until the first is moved, bodies stay where the simulators have them
        self._are_moved, self._placed = False, None
        self._labels: OrderedDict[LiveFrame, Ping] = OrderedDict()
        self._last_place = None, None  # pose of the sonar, and bodies, of the last ping
        self._place_notes: list[str] | None = None  # of that place; None before a second ping there

    def ping(self, request: FrameRequest) -> LiveFrame:
        """Return the frame of the next ping; raise Error if it fails."""
        settings, highlight = request.settings, request.highlight
        self._place(request.bodies)
        simulator, number = self._simulator(settings), self._number
        self._number += 1
        with collected_warnings() as found:
            labels = _labels_shown(request.gain_from, settings) if highlight else {}
            wanted = PingRequest(
                request.place.pose,
                settings.noise,
                settings.seed,
                number,
                time_s=request.place.time_s,
                **labels,
            )
            simulator.run.silent_pings.start_again()  # each frame says why it has no echo
            ping = make_ping(simulator.run, wanted)
            place_notes = self._notes_of_place(simulator, request)
        device = settings.device
        ping = replace(ping, sonar=device, meta=ping.meta | {"sonar": device.meta()})
        shown = None
        if highlight:
            shown = pixels_of(
                ping.body_id == body_number(self._scene, highlight), pixel_cells(ping, settings)
            )
        self._pinged_s.append(time.monotonic())
        return LiveFrame(
            number=number,
            clock_s=self._pinged_s[-1] - self._began_s,
            time_s=request.place.time_s,
            pose=request.place.pose,
            ping=ping,
            picture=picture_of(ping, settings),
            settings=settings,
            rate_hz=self._rate_hz(request.rate_from_s),
            samples=simulator.sampling.count(settings.device),
            bodies=request.bodies,
            highlight=shown,
            notes=tuple(dict.fromkeys([*(one.text for one in found), *place_notes])),
        )

    def _notes_of_place(self, simulator: Simulator, request: FrameRequest) -> list[str]:
        """Return what is said of a sonar in the air or inside a body, as long as it rests there.

        A simulator says it once, which is one frame among many. To look at each pose would slow a sonar that moves.
        """
        pose, (last_pose, last_bodies) = request.place.pose, self._last_place
        if request.bodies is not last_bodies or not np.array_equal(pose, last_pose):
            self._last_place, self._place_notes = (pose, request.bodies), None
            return []
        if self._place_notes is None:
            state = simulator.run.set_up(PingRequest(pose, time_s=request.place.time_s)).state
            self._place_notes = place_texts(self._scene, state.poses, state.present, pose)
        return self._place_notes

    def still(self, frame: LiveFrame) -> LiveFrame:
        settings, pose = frame.settings, make_pose(*rounded_pose_numbers(frame.pose))
        self._place(frame.bodies)  # the next ping puts them back
        with collected_warnings():
            world = self._simulator(settings)
            with Simulator(
                world, settings.device, settings.acoustics, tolerance=settings.tolerance
            ) as simulator:
                simulator.plan([pose])
                ping = simulator.ping(pose, settings.noise, settings.seed)
                samples = simulator.sampling.count(settings.device)
        return replace(
            frame, number=0, time_s=0.0, pose=pose, ping=ping, picture=still_of(ping, settings), samples=samples,
            highlight=None, notes=(),
        )  # fmt: skip

    def labelled(self, frame: LiveFrame) -> Ping:
        """Return a frame's ping with labels, made again without noise; those of the last few frames are kept.

        Bins in which the noise of the frame's settings is stronger have none.
        """
        if frame not in self._labels:
            while len(self._labels) >= KEPT_LABELS:
                self._labels.popitem(last=False)
            wanted = PingRequest(
                frame.pose,
                time_s=frame.time_s,
                bodies=self._home | frame.bodies,
                **_labels_shown(frame, frame.settings),
            )
            with collected_warnings():
                ping = make_ping(self._simulator(frame.settings).run, wanted)
            self._labels[frame] = without_hidden_labels(ping, receiver_power(ping, frame.settings.noise))
        return self._labels[frame]

    def surface(self, frame: LiveFrame, beam: int, bin: int) -> Surface:
        """Return the surface of a bin, with the bodies where they were in the frame."""
        settings = frame.settings
        self._place(frame.bodies)  # the next ping puts them back
        return surface_in_bin(
            self._simulator(settings), settings.device, settings.acoustics, frame.pose, beam, bin
        )

    def close(self) -> None:
        self._pool.close()

    def _simulator(self, settings: LiveSettings) -> Simulator:
        return self._pool.simulator(settings.device, settings.acoustics, settings.tolerance, settings.engine)

    def _place(self, bodies: Mapping[str, np.ndarray | None]) -> None:
        """Have the bodies where some of them were moved to."""
        if bodies is not self._placed and (bodies or self._are_moved):
            self._are_moved = True
            self._pool.place(self._home | bodies)
            self._placed = bodies

    def _rate_hz(self, from_s: float) -> float:
        """Return the mean rate of the last pings; 0 for the first from a time on."""
        pinged_s = self._pinged_s
        while pinged_s[0] < from_s or (len(pinged_s) > 2 and pinged_s[0] < pinged_s[-1] - RATE_S):
            pinged_s.popleft()
        gone_s = pinged_s[-1] - pinged_s[0]
        return (len(pinged_s) - 1) / gone_s if gone_s > 0 else 0.0


def _labels_shown(frame: LiveFrame, settings: LiveSettings) -> dict:
    """Return what asks for the labels of bins that are not black, with the gain of a frame, and that no noise hides."""
    least = settings.law.least_shown(frame.ping.intensity)
    level_db = min(max(10 * math.log10(least), -LEVEL_BOUND_DB), LEVEL_BOUND_DB)
    return {"labels": True, "label_level_db": level_db, "labels_above_noise": True}
