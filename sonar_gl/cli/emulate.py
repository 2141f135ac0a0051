"""The command `emulate`: a simulated sonar that programs of a real one talk to over the network."""

from __future__ import annotations

import asyncio
import logging
import os
import signal
import socket
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

from sonar_gl.cli.common import acoustics_from, check_address, check_duration, poses_from, scene_from
from sonar_gl.cli.output import echo
from sonar_gl.core.errors import Error
from sonar_gl.core.hosts import check_host, is_local
from sonar_gl.core.key_values import parse_fields
from sonar_gl.core.load_numba import load_numba
from sonar_gl.core.pose_track import PoseTrack
from sonar_gl.live.emulators.oculus import DATA_PORT, MODELS, STATUS_PORT, OculusHead, OculusServer
from sonar_gl.live.emulators.ping360 import PORT, Ping360Head, Ping360Server
from sonar_gl.live.emulators.simulated_head import SimulatedHead
from sonar_gl.noise.settings import Noise
from sonar_gl.sonar.counts import DEFAULT_COUNTS, Counts
from sonar_gl.sonar.sonar import Sonar
from sonar_gl.sonar.sonar_files import load_sonar

# fields of the law of counts that the protocols leave to the device
OCULUS_COUNTS = ("gain_percentile",)
PING360_COUNTS = "law", "exponent", "low_db", "high_db"


def oculus(scene_name: str, options) -> str:
    """Serve an Oculus until it is stopped; return a line about what was sent."""
    model = MODELS[options.model]
    check_address("--status-to", options.status_to)
    preset = load_sonar(model.presets[1])
    counts = _counts_from(
        options, preset, OCULUS_COUNTS, "programs set its gain, gamma and bits by the protocol"
    )

    def serve(simulation, head):
        port = DATA_PORT if options.port is None else options.port
        status_to = None if options.host == "0.0.0.0" else (options.status_to, STATUS_PORT)
        server = OculusServer(OculusHead(model, head, counts), simulation, options.host, port, status_to)
        where = "no status, since --host 0.0.0.0 is no address that a program could connect to"
        if status_to is not None:
            where = f"status to {options.status_to}:{STATUS_PORT} every second"
        return server, lambda: f"Oculus {options.model.upper()} at {options.host}:{server.port}; {where}"

    server = _serve(scene_name, options, preset, serve)
    counts = server.counts
    return (
        f"{counts.sent} results sent, {counts.missed} missed by programs that read too slowly; {counts.refused} wrong "
        "fire messages ignored"
    )


def ping360(scene_name: str, options) -> str:
    """Serve a Ping360 until it is stopped; return a line about what was sent."""
    preset = load_sonar("ping360")
    counts = _counts_from(
        options, preset, PING360_COUNTS, "programs set its gain by the protocol, which has 8 bits"
    )

    def serve(simulation, head):
        port = PORT if options.port is None else options.port
        server = Ping360Server(Ping360Head(head, counts), simulation, options.host, port)
        return server, lambda: f"Ping360 at {options.host}:{server.port} (UDP)"

    server = _serve(scene_name, options, preset, serve)
    return f"{server.pings} pings sent, {server.dropped} messages dropped as more came than could be answered"


def _counts_from(options, preset: Sonar, free: tuple[str, ...], why: str) -> dict:
    """Return the changes of --counts to a preset's law, or raise an Error that says why a field is not free."""
    if options.counts is None:
        return {}
    _, changes = parse_fields("counts", options.counts, Counts)
    for name in changes:
        if name in vars(DEFAULT_COUNTS) and name not in free:
            raise Error(f"--counts of this device may change {', '.join(free)} alone (got {name}; {why})")
    preset.counts.parse_changes(options.counts)  # which raises Error for a wrong one
    return changes


def _serve(scene_name: str, options, sonar: Sonar, make_server):
    """Make the server of a scene, run it for --duration or until Ctrl-C, and return it."""
    load_numba()
    check_duration(options)
    check_address("--host", options.host)
    check_host(options.host, socket.AF_INET)  # messages have room for addresses of IPv4 alone
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    acoustics, noise = acoustics_from(options, options.profile), Noise.parse(options.noise)
    if acoustics is None:
        raise Error(
            "--acoustics needed must know the sonar and its range (programs set those of an emulated device; name the "
            "terms instead)"
        )
    scene = scene_from(scene_name, options)
    times_s, poses = poses_from(options, scene)
    if not is_local(options.host):
        echo(f"warning: any machine that reaches {options.host} can use this sonar", err=True)
    with ThreadPoolExecutor(1, "simulation") as simulation:
        settings = scene, sonar, acoustics, noise, PoseTrack(poses, times_s), options.tolerance, options.seed
        head = simulation.submit(SimulatedHead, *settings).result()
        server = None
        try:
            # the first ping after an installation compiles for some minutes, which no program would wait for
            simulation.submit(head.ping, sonar, acoustics, time_s=0.0, number=0).result()
            server, describe_server = make_server(simulation, head)

            def describe() -> str:
                return f"{describe_server()}; scene {scene.name}, on {head.renderer}; Ctrl-C stops it"

            asyncio.run(asyncio.wait_for(listen(server, describe), options.duration))
        except (KeyboardInterrupt, asyncio.TimeoutError):
            if server is None:  # before it listened
                raise
        except OSError as why:
            check_host(options.host, socket.AF_INET)  # which may have gone meanwhile
            # asyncio puts the address into its text, which the sentence has already
            reason = os.strerror(why.errno) if why.errno else str(why)
            raise Error(
                f"the emulator must be able to listen at {options.host} (got {reason}; is another program using the "
                "port? --port chooses another)"
            ) from None
        finally:
            simulation.submit(head.close).result()
    return server


async def listen(server, describe: Callable[[], str]) -> None:
    """Serve until Ctrl-C or SIGTERM; print what `describe` returns once the port, which may be 0, is open."""
    serving = asyncio.create_task(server.run(lambda: echo(describe(), err=True)))
    with _cancelled_by_signals(serving):
        try:
            await asyncio.wait([serving])
        finally:
            serving.cancel()
            await asyncio.wait([serving])
    if not serving.cancelled():
        serving.result()


@contextmanager
def _cancelled_by_signals(task: asyncio.Task):
    """Have Ctrl-C, SIGTERM and SIGHUP cancel a task; they would raise KeyboardInterrupt in whichever task runs."""
    loop, before = asyncio.get_running_loop(), {}
    if threading.current_thread() is threading.main_thread():  # others may have no handlers
        names = [name for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
        handlers = {number: signal.getsignal(number) for number in (getattr(signal, name) for name in names)}
        before = {number: handler for number, handler in handlers.items() if callable(handler)}
    # by the loop, which wakes up: after a handler of signal.signal it may wait on for its next event
    for number in before:
        loop.add_signal_handler(number, task.cancel)
    try:
        yield
    finally:
        for number, handler in before.items():
            loop.remove_signal_handler(number)
            signal.signal(number, handler)
