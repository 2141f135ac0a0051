"""An emulated Oculus: it speaks the device's protocol over the network, and its pings are simulated."""

from __future__ import annotations

import asyncio
import logging
import socket
from collections.abc import Callable, Coroutine, Mapping
from concurrent.futures import Executor
from contextlib import suppress
from dataclasses import dataclass, field, replace

import numpy as np

from sonar_gl.core.errors import Error, MachineError
from sonar_gl.core.poses import pose_numbers
from sonar_gl.live.emulators.oculus_messages import (
    FIRE,
    GAIN_ASSISTANCE,
    HEADER,
    HIGH_FREQUENCY,
    OCULUS_ID,
    SIXTEEN_BITS,
    FireMessage,
    OculusResult,
    WrongFireError,
    parse_fire_message,
    status_message,
)
from sonar_gl.live.emulators.simulated_head import SimulatedHead
from sonar_gl.ping import Ping
from sonar_gl.sonar.counts import LEAST_EXPONENT
from sonar_gl.sonar.sonar import Sonar
from sonar_gl.sonar.sonar_files import load_sonar

logger = logging.getLogger(__name__)

DATA_PORT, STATUS_PORT = 52100, 52102  # of liboculus, include/liboculus/Constants.h
STATUS_S = 1.0  # between announcements
DEVICE_ID = 1
MAX_FIRE_BYTES = 4096  # a program that announces more speaks another protocol
MAX_UNSENT_BYTES = 16 << 20  # a program that reads too slowly misses pings from here on
MAX_PROGRAMS = 32  # connected at once: each may leave that much unsent
# Ranges of an image. An M1200d sends 703 of them at 2 m; how many at most is not published.
MAX_BINS = 1024
GAIN_DB_PER_PERCENT = 0.6  # of the fixed gain; not published, chosen so that 50 per cent suits a sand floor


@dataclass(frozen=True)
class OculusModel:
    """A model of the Oculus family."""

    part_number: int  # that the device announces, OculusPartNumberType in Oculus.h
    presets: tuple[str, str]  # names of the sonars in low and in high frequency mode


MODELS = {
    "m370s": OculusModel(1041, ("oculus-m370s", "oculus-m370s")),
    "m750d": OculusModel(1032, ("oculus-m750d-lf", "oculus-m750d-hf")),
    "m1200d": OculusModel(1042, ("oculus-m1200d-lf", "oculus-m1200d-hf")),
    "m3000d": OculusModel(2203, ("oculus-m3000d-lf", "oculus-m3000d-hf")),
}


class OculusHead:
    """Answers fire messages by pings.

    counts : changes of the presets' laws of counts, in what fire messages do not set
    """

    def __init__(self, model: OculusModel, head: SimulatedHead, counts: Mapping | None = None):
        self.model, self.head, self._counts = model, head, counts or {}

    def sonar(self, fire: FireMessage) -> Sonar:
        """Return the sonar with the settings of a fire message; WrongFireError if the range is too long for it."""
        is_high = fire.mode == HIGH_FREQUENCY
        preset = load_sonar(self.model.presets[is_high])
        greatest_m = preset.range_limit_m
        range_m = fire.range_m(greatest_m)
        if not preset.range_min_m < range_m <= greatest_m:
            raise WrongFireError(
                "range",
                f"the range of {preset.name} must be more than {preset.range_min_m:g} m and at most {greatest_m:g} m "
                f"(got {range_m:g} m)",
            )
        n_bins = min(max(1, round(range_m / preset.bin_size_m)), MAX_BINS)
        exponent = max(0.5 * (fire.gamma or 255) / 255, LEAST_EXPONENT)
        counts = {"exponent": exponent, "bits": 16 if fire.flags & SIXTEEN_BITS else 8}
        if not fire.flags & GAIN_ASSISTANCE:
            counts["gain_db"] = GAIN_DB_PER_PERCENT * fire.gain_percent
        # an image begins at the head
        return replace(
            preset,
            n_beams=fire.n_beams,
            n_bins=n_bins,
            range_min_m=0.0,
            range_max_m=range_m,
            counts=preset.counts.changed(self._counts).changed({"law": "power", **counts}),
        )

    def ping(self, fire: FireMessage, time_s: float, number: int) -> OculusResult:
        """Make a ping with the settings of a fire message; raises Error as `sonar` does."""
        sonar, acoustics = self.sonar(fire), self.head.acoustics
        if fire.sound_speed_m_s:
            acoustics = replace(acoustics, sonar_sound_speed_m_s=fire.sound_speed_m_s)
        return oculus_result(self.head.ping(sonar, acoustics, time_s, number), fire, time_s, number)


def oculus_result(ping: Ping, fire: FireMessage, time_s: float, number: int) -> OculusResult:
    sonar, acoustics = ping.sonar, ping.acoustics
    *_, roll, pitch, yaw = np.degrees(pose_numbers(ping.pose))
    return OculusResult(
        fire=fire,
        number=number,
        counts=ping.counts(),
        azimuth_rad=ping.azimuth_rad,
        gain=acoustics.tvg(ping.range_m, sonar),
        bin_size_m=sonar.bin_size_m,
        frequency_hz=sonar.frequency_hz,
        temperature_c=acoustics.water.temperature_c,
        pressure_bar=1.01325 + acoustics.water.depth_m / 10.0,  # ten metres of water make a bar
        sound_speed_m_s=acoustics.assumed_sound_speed_m_s(),
        heading_deg=float(-yaw % 360),  # a compass counts clockwise
        pitch_deg=float(-pitch),  # up is positive
        roll_deg=float(roll),
        time_s=time_s,
    )


@dataclass
class PingCounts:
    """What became of the pings of an emulator."""

    sent: int = 0
    missed: int = 0  # by programs that read too slowly
    refused: int = 0  # fire messages, which were wrong


@dataclass
class _Program:
    """A program that is connected."""

    host: str
    port: int
    reported: set[str] = field(default_factory=set)  # kinds of wrong fire messages that the log explains


class OculusServer:
    """Serves the results of an Oculus to all programs that connect.

    The last fire message of any program counts, as with the device. A ping that is late is left out: the ping rate
    falls, and nothing piles up.

    device : which `simulation`, an Executor of one thread, alone uses
    port : of the results; 0 takes a free one, which is known once `run` has started
    status_to : (host, port) that receives the status, or None for no status
    """

    def __init__(
        self,
        device: OculusHead,
        simulation: Executor,
        host: str = "127.0.0.1",
        port: int = DATA_PORT,
        status_to: tuple[str, int] | None = ("127.0.0.1", STATUS_PORT),
    ):
        self.counts, self.port = PingCounts(), port
        self._device, self._simulation = device, simulation
        self._host, self._status_to = host, status_to
        self._fire: FireMessage | None = None
        self._logged: FireMessage | None = None  # the last one that the log names
        self._firing: _Program | None = None  # whose fire message it is
        self._asked = asyncio.Event()
        self._programs: dict[asyncio.StreamWriter, _Program] = {}
        self._is_full = False  # and the log says so
        self._tasks: set[asyncio.Task] = set()

    async def run(self, on_open: Callable[[], None] = lambda: None) -> None:
        """Serve until this is cancelled; raises OSError if the port is taken, or the host is no address of IPv4.

        on_open : called once the port is open
        """
        # messages have room for addresses of IPv4 alone
        server = await asyncio.start_server(self._admit, self._host, self.port, family=socket.AF_INET)
        self.port = server.sockets[0].getsockname()[1]
        on_open()
        tasks = [self._start(self._ping())]
        if self._status_to is not None:
            tasks.append(self._start(self._announce()))
        try:
            await asyncio.gather(*tasks)
        finally:
            server.close()
            for task in self._tasks:
                task.cancel()
            await asyncio.gather(*self._tasks, return_exceptions=True)

    def _start(self, work: Coroutine) -> asyncio.Task:
        task = asyncio.create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        return task

    def _admit(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Serve a program that connects, in a task of this server's own: that of asyncio ends with a traceback.

        One beyond MAX_PROGRAMS is disconnected at once.
        """
        if len(self._programs) >= MAX_PROGRAMS:
            if not self._is_full:
                logger.warning("%d programs are connected, and others are disconnected at once", MAX_PROGRAMS)
            self._is_full = True
            writer.transport.abort()
            return
        # without a name if it has gone already
        name = writer.get_extra_info("peername") or ("0.0.0.0", 0)
        program = self._programs[writer] = _Program(*name[:2])
        task = self._start(self._serve(reader, program))
        task.add_done_callback(lambda _: self._leave(writer))  # also if it is cancelled before it begins

    def _leave(self, writer: asyncio.StreamWriter) -> None:
        """Close the connection of a program, whose place another one may take."""
        writer.close()
        del self._programs[writer]
        self._is_full = False

    async def _serve(self, reader: asyncio.StreamReader, program: _Program) -> None:
        """Read the messages of a program until it goes, or sends what is none."""
        name = program.host, program.port
        logger.info("%s:%s connects", *name)
        try:
            while True:
                mark, _, _, kind, version, size, _ = HEADER.unpack(await reader.readexactly(HEADER.size))
                if mark != OCULUS_ID or size > MAX_FIRE_BYTES:
                    logger.warning("%s:%s sends no messages of an Oculus: it is disconnected", *name)
                    return
                payload = await reader.readexactly(size)
                if kind == FIRE:
                    self._take_fire_message(program, version, payload)
        except (asyncio.IncompleteReadError, OSError):  # also that the network is lost
            pass
        finally:
            logger.info("%s:%s is gone", *name)

    def _take_fire_message(self, program: _Program, version: int, payload: bytes) -> None:
        """Ping with the settings of a program's fire message from now on; a wrong one changes nothing."""
        try:
            fire = parse_fire_message(version, payload)
            self._device.sonar(fire)
        except Error as why:
            self._refuse(program, why)
            return
        if fire != self._logged:
            logger.info("fire message: %s", fire.describe(self._logged))
        self._fire = self._logged = fire
        self._firing = program
        self._asked.set()

    def _refuse(self, program: _Program, why: Error) -> None:
        """Count a wrong fire message; log why, unless the log says so of one like it of the same program."""
        self.counts.refused += 1
        kind = why.field if isinstance(why, WrongFireError) else "ping"
        if kind not in program.reported:
            program.reported.add(kind)
            logger.warning("a fire message is ignored: %s (others like it are only counted)", why)

    async def _ping(self) -> None:
        """Ping as long as a program listens and has asked for it."""
        loop = asyncio.get_running_loop()
        began_s, next_s, number = loop.time(), loop.time(), 0
        while True:
            fire, program = self._fire, self._firing
            if fire is None or not fire.ping_rate_hz or not self._programs:
                self._asked.clear()
                with suppress(asyncio.TimeoutError):  # programs come and go without asking anew
                    await asyncio.wait_for(self._asked.wait(), 0.1)
                next_s = loop.time()
                continue
            try:
                result = await loop.run_in_executor(
                    self._simulation, self._device.ping, fire, loop.time() - began_s, number
                )
            except MachineError:
                raise
            except Error as why:
                self._refuse(program, why)
                self._fire = None if self._fire is fire else self._fire
                continue
            number += 1
            self._send(result.message(DEVICE_ID))
            next_s = max(next_s + 1 / fire.ping_rate_hz, loop.time())
            await asyncio.sleep(next_s - loop.time())

    def _send(self, message: bytes) -> None:
        """Send a message to all programs; one that reads too slowly misses it."""
        for writer in list(self._programs):
            if writer.transport.get_write_buffer_size() + len(message) > MAX_UNSENT_BYTES:
                self.counts.missed += 1
                continue
            writer.write(message)
            self.counts.sent += 1

    async def _announce(self) -> None:
        loop, to = asyncio.get_running_loop(), self._status_to
        transport, protocol = await loop.create_datagram_endpoint(
            lambda: _StatusProtocol(to),
            local_addr=(self._host, 0),
            family=socket.AF_INET,
            allow_broadcast=True,
        )
        own, part = transport.get_extra_info("sockname")[0], self._device.model.part_number
        temperature_c = self._device.head.acoustics.water.temperature_c
        try:
            while True:
                connected = next((program.host for program in self._programs.values()), "0.0.0.0")
                message = status_message(DEVICE_ID, part, own, connected, temperature_c)
                try:
                    # in a thread: the look-up of a name may take seconds
                    found = await loop.getaddrinfo(*to, family=socket.AF_INET, type=socket.SOCK_DGRAM)
                    transport.sendto(message, found[0][4])
                except OSError as why:
                    protocol.error_received(why)
                await asyncio.sleep(STATUS_S)
        finally:
            transport.close()


class _StatusProtocol(asyncio.DatagramProtocol):
    """Says once why a status does not go out `to` a (host, port)."""

    def __init__(self, to: tuple[str, int]):
        self._to, self._has_failed = to, False

    def error_received(self, why: OSError) -> None:
        if not self._has_failed:
            logger.warning(
                "no status reaches %s:%d: %s (this is logged once)", *self._to, why.strerror or why
            )
        self._has_failed = True
