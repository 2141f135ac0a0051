"""The command `ros2`: live topics of ROS 2 from a simulated sonar."""

from __future__ import annotations

import contextlib
import logging
import time
from dataclasses import replace
from types import SimpleNamespace

from sonar_gl import ros
from sonar_gl.cli.common import (
    acoustics_from,
    check_duration,
    poses_from,
    scene_from,
    sonar_from,
    warn_of_hull,
)
from sonar_gl.cli.output import echo
from sonar_gl.cli.ros2_file import OPTIONS, Ros2File, read_ros2_file
from sonar_gl.core.checks import shown
from sonar_gl.core.errors import Error, errors_at
from sonar_gl.core.load_numba import load_numba
from sonar_gl.core.pose_track import PoseTrack
from sonar_gl.noise.settings import Noise
from sonar_gl.ros.publisher import Publisher
from sonar_gl.ros.publisher_settings import TOPICS, PoseSource, PublisherSettings
from sonar_gl.ros.transport import ros_domain

logger = logging.getLogger(__name__)

LOOP_S = 0.01  # between steps in real time
CLOCK_WAIT_S = 0.1  # for a message of /clock, before the end is looked for again
CLOCK_REPORT_S = 10.0  # of real time, between lines of the log where none comes


def ros2(scene_name: str, options, given: set[str]) -> str:
    """Publish until it is stopped; return a line about what was sent. `given` are the options of the command line."""
    load_numba()
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    file = Ros2File()
    if options.config is not None:
        file = read_ros2_file(options.config)
        options = _with_file(options, given, file)
    check_duration(options)
    acoustics, noise = acoustics_from(options, options.profile), Noise.parse(options.noise)
    if acoustics is None:
        raise Error(
            "--acoustics needed must know the poses beforehand (live ones are not known; name the terms instead)"
        )
    with errors_at(str(options.config)) if options.config is not None else contextlib.nullcontext():
        settings = _settings(options, file)
    if settings.pose_from is not None and (options.pose, options.poses) != (None, None):
        raise Error(
            "--pose-from excludes --pose and --poses (poses come from one of them; leave the others out)"
        )
    scene = scene_from(scene_name, options)
    track = None if settings.pose_from is not None else PoseTrack(*poses_from(options, scene)[::-1])
    if (options.pose, options.poses) == (None, None):
        # the publisher has the scene's pose, which is the sonar's, where options state that of a vehicle
        track = None
    if (settings.pose_from, options.poses) != (None, None) and settings.bodies_from is None:
        warn_of_hull(scene)
    sonar = sonar_from(options, scene)
    if options.counts is not None:
        sonar = replace(sonar, counts=sonar.counts.parse_changes(options.counts))
    with contextlib.ExitStack() as stack:
        transports = []
        for kind in dict.fromkeys(options.transport):
            transports.append(_transport(kind, options, file))
            stack.callback(transports[-1].close)
        publisher = stack.enter_context(
            Publisher(scene, sonar, transports, acoustics, noise, settings, in_background=True)
        )
        names = ", ".join(settings.topic_names.values())
        carried = " and ".join(dict.fromkeys(options.transport))
        echo(
            f"{names} by {carried}, {publisher.rate_hz:.4g} pings/s; scene {scene.name}, on {publisher.renderer}; "
            "Ctrl-C stops it",
            err=True,
        )
        with contextlib.suppress(KeyboardInterrupt):
            _run(publisher, options, track)
    return str(publisher.counts)


def _with_file(options, given: set[str], file: Ros2File) -> SimpleNamespace:
    """Return the options with those of the file that the command line does not name."""
    changes = {name: getattr(file, name) for name in OPTIONS if name not in given}
    # one source of poses replaces another
    if not given.isdisjoint(("pose", "poses", "pose_from")):
        changes |= {name: None for name in ("pose", "poses", "pose_from") if name not in given}
    return SimpleNamespace(
        **{**vars(options), **{name: value for name, value in changes.items() if value is not None}}
    )


def _settings(options, file: Ros2File) -> PublisherSettings:
    topics = {kind: name or None for kind in TOPICS if (name := getattr(file.topics, kind)) is not None}
    if options.topics is not None:
        wanted = options.topics.replace(",", " ").split()
        if unknown := [word for word in wanted if word not in TOPICS]:
            raise Error(f"--topics must be some of {','.join(TOPICS)} (got {shown(unknown[0])})")
        if not wanted:
            raise Error(f"--topics must name one or more of {','.join(TOPICS)} (got none)")
        topics |= dict.fromkeys(set(TOPICS) - set(wanted))
    if options.clock != "own":
        topics["clock"] = None
        if all(kind in topics and topics[kind] is None for kind in TOPICS):
            raise Error("some topic must be published (got none; /clock is sent with --clock own alone)")
    changes = {
        "world_frame": file.world_frame,
        "vehicle_frame": file.vehicle_frame,
        "mount": None if file.mount is None else tuple(file.mount),
        "y_sign": file.y_sign,
        "image_height": file.image.height,
        "colormap": file.image.colormap,
        "points_columns": file.points.columns,
        "points_rows": file.points.rows,
    }
    return PublisherSettings(
        name=options.name,
        rate_hz=options.rate,
        topics=topics,
        pose_from=None if options.pose_from is None else PoseSource.parse(options.pose_from),
        bodies_from=options.bodies_from,
        tolerance=options.tolerance,
        seed=options.seed,
        **{key: value for key, value in changes.items() if value is not None},
    )


def _transport(kind: str, options, file: Ros2File):
    """Return a transport with the settings of its table."""
    table = getattr(file, kind).model_dump(exclude_none=True)
    if kind == "foxglove":
        return ros.FoxgloveTransport(**table)
    domain, node = ros_domain(options.domain), options.name.rpartition("/")[2]
    if kind == "dds":
        return ros.DdsTransport(domain=domain, node=node, **table)
    return ros.ZenohTransport(domain=domain, node=node, **table)


def _run(publisher: Publisher, options, track: PoseTrack | None) -> None:
    """Step through time until --duration has passed."""
    times = publisher.clock() if options.clock == "ros" else None
    began_s = told_s = time.monotonic()
    first_ns = None
    while options.duration is None or time.monotonic() < began_s + options.duration:
        if times is not None:
            time_ns = times.wait(CLOCK_WAIT_S)
            if time_ns is None:
                if first_ns is None and time.monotonic() >= told_s + CLOCK_REPORT_S:
                    logger.warning(
                        "no /clock has come yet; a simulator publishes it, or ros2 bag play --clock"
                    )
                    told_s = time.monotonic()
                continue
        elif options.clock == "system":
            time_ns = time.time_ns()
        else:
            time_ns = int((time.monotonic() - began_s) * 1e9)
        first_ns = time_ns if first_ns is None else first_ns
        publisher.step_at(time_ns, None if track is None else track.at((time_ns - first_ns) / 1e9))
        if times is None:
            now_s = time.monotonic() - began_s
            time.sleep(LOOP_S - now_s % LOOP_S)
