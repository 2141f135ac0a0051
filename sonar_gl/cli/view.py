"""The command `view`: a page in the browser that shows a scene and the pings of a sonar in it."""

from __future__ import annotations

from contextlib import suppress
from urllib.parse import urlsplit

from sonar_gl.acoustics.acoustics import Acoustics
from sonar_gl.analysis.terms import needed_acoustics
from sonar_gl.cli.common import (
    acoustics_from,
    check_address,
    check_duration,
    check_output,
    named_sonar,
    poses_from,
    scene_from,
    sonar_from,
    water_from,
)
from sonar_gl.cli.output import echo
from sonar_gl.core.load_numba import load_numba
from sonar_gl.core.pose_track import PoseTrack
from sonar_gl.live.command_line import SceneSource
from sonar_gl.live.session import LiveSession
from sonar_gl.live.settings import LiveSettings
from sonar_gl.live.view.page import load_viser
from sonar_gl.live.viewer import LiveView, warn_of_host
from sonar_gl.noise.settings import Noise
from sonar_gl.raster.engine import check_engine
from sonar_gl.scene.sonar_sensor import DEFAULT_SONAR
from sonar_gl.sonar.sonar_files import load_sonar


def view(scene_name: str, options) -> None:
    """Show the page for --duration, or until Ctrl-C."""
    load_numba()
    check_duration(options)
    check_address("--host", options.host)
    check_output(options)
    session = session_from(scene_name, options)
    warn_of_host(options.host)
    # around all that follows the address: Ctrl-C may come before `wait` has begun
    with LiveView(session, options.host, options.port) as opened, suppress(KeyboardInterrupt):
        is_other = options.port not in (0, urlsplit(opened.url).port)
        why = f", since another program has port {options.port}" if is_other else ""
        echo(f"the page is at {opened.url}{why}; Ctrl-C ends it", err=True)
        opened.wait(options.duration)


def session_from(scene_name: str, options) -> LiveSession:
    acoustics, noise = acoustics_from(options, options.profile), Noise.parse(options.noise)
    scene = scene_from(scene_name, options)
    times_s, poses = poses_from(options, scene)
    sonar = sonar_from(options, scene)
    named = None if options.sonar is None else named_sonar(options.sonar)
    source = SceneSource(
        scene_name,
        resource_paths=tuple(options.resource_path),
        skip_missing=options.skip_missing,
        without=tuple(options.without),
        only=tuple(options.only),
        surface_z_m=options.surface,
        sonar=options.sonar,
        loaded=named,
    )
    engine = check_engine(None)
    settings = LiveSettings(
        sonar=named or scene.sonar or load_sonar(DEFAULT_SONAR),
        range_m=options.range,
        n_bins=options.bins,
        acoustics=acoustics or Acoustics.physical(),
        noise=noise,
        tolerance=options.tolerance,
        engine=None if engine == "auto" else engine,
        seed=options.seed,
        colormap=options.colormap,
        form="polar" if options.polar else "fan",
        height=options.height,
    )
    if options.counts is not None:
        settings = settings.changed(counts=settings.law.parse_changes(options.counts))
    track = None if times_s is None else PoseTrack(poses, times_s)
    load_viser()  # after the user's mistakes, and before pings
    if acoustics is None:
        needed = needed_acoustics(scene, sonar, options.tolerance, poses, water_from(options))
        settings = settings.changed(acoustics=needed)
    return LiveSession(scene, settings, poses[0], track, options.out, source, options.job)
