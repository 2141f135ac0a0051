"""An emulated Ping360, a mechanical scanning sonar: each angle that a program asks for is one ping of one beam."""

from __future__ import annotations

import asyncio
import logging
import math
import socket
from collections.abc import Callable, Mapping
from concurrent.futures import Executor
from contextlib import contextmanager
from dataclasses import replace
from itertools import count

from sonar_gl.core.errors import Error, MachineError
from sonar_gl.core.poses import pose
from sonar_gl.live.emulators.ping360_messages import (
    ACK,
    AUTO_TRANSMIT,
    DEVICE_DATA,
    DEVICE_INFORMATION,
    GENERAL_REQUEST,
    GRADIANS,
    MOTOR_OFF,
    NACK,
    PROTOCOL_VERSION,
    RESET,
    SET_DEVICE_ID,
    TRANSDUCER,
    PingMessage,
    Scan,
    TransducerSettings,
    parse_messages,
    parse_scan,
    parse_transducer,
)
from sonar_gl.live.emulators.simulated_head import SimulatedHead
from sonar_gl.sonar.sonar import Sonar
from sonar_gl.sonar.sonar_files import load_sonar

logger = logging.getLogger(__name__)

PORT = 9092
DEVICE_NUMBER = 2  # of messages
MAX_WAITING = 64  # datagrams; more are dropped, as by a device that is busy
# type, revision and firmware of a Ping360 with the message AUTO_TRANSMIT; version of the protocol
INFORMATION, PROTOCOL = bytes([2, 1, 3, 3, 8, 0]), bytes([1, 0, 0, 0])
FIRST_SETTINGS = TransducerSettings(1, 0, 0, 32, 80, 740, 200)
GAIN_DB = 10.0, 20.0, 30.0  # of the settings low, normal and high; not published


class Ping360Head:
    """Answers messages by pings of one beam.

    counts : changes of the preset's law of counts, in what messages do not set
    """

    def __init__(self, head: SimulatedHead, counts: Mapping | None = None):
        preset = load_sonar("ping360")
        self._preset = replace(preset, counts=preset.counts.changed(counts or {}))
        self.head, self._number = head, 0

    def sonar(self, settings: TransducerSettings) -> Sonar:
        """Return the sonar with these settings: a sample is a bin, the pulse's bandwidth is one over its length.

        A pulse has one period at least.
        """
        speed_m_s = self.head.acoustics.assumed_sound_speed_m_s()
        preset, range_m = self._preset, settings.n_samples * settings.sample_time_s * speed_m_s / 2
        counts = preset.counts.changed({"gain_db": GAIN_DB[settings.gain_setting]})
        frequency_hz = 1e3 * settings.transmit_frequency_khz
        return replace(
            preset,
            frequency_hz=frequency_hz,
            n_bins=settings.n_samples,
            range_min_m=0.0,
            range_max_m=range_m,
            bandwidth_hz=min(1e6 / settings.transmit_duration_us, frequency_hz),
            counts=counts,
        )

    def ping(self, settings: TransducerSettings, time_s: float) -> bytes:
        """Return the counts of a ping, uint8, one for each sample."""
        self._number += 1
        # angles of the head grow clockwise from ahead, as seen from above
        turn = pose(yaw=-2 * math.pi * settings.angle / GRADIANS)
        sonar, acoustics = self.sonar(settings), self.head.acoustics
        return self.head.ping(sonar, acoustics, time_s, self._number, turn).counts()[0].tobytes()


class Ping360Server(asyncio.DatagramProtocol):
    """Answers programs that send datagrams of the Ping protocol, one after the other as the device does.

    device : which `simulation`, an Executor of one thread, alone uses
    port : where it listens; 0 takes a free one, which is known once `run` has started
    """

    def __init__(self, device: Ping360Head, simulation: Executor, host: str = "127.0.0.1", port: int = PORT):
        self.pings, self.dropped, self.port = 0, 0, port
        self._device, self._simulation, self._host = device, simulation, host
        self._transport, self._waiting, self._began_s = None, None, 0.0
        self._last = FIRST_SETTINGS

    def connection_made(self, transport) -> None:
        self._transport = transport

    def datagram_received(self, data: bytes, address) -> None:
        for message in parse_messages(data):
            try:
                self._waiting.put_nowait((message, address))
            except asyncio.QueueFull:
                self.dropped += 1

    async def run(self, on_open: Callable[[], None] = lambda: None) -> None:
        """Serve until this is cancelled; raises OSError if the port is taken, or the host no address of IPv4.

        on_open : called once the port is open
        """
        loop = asyncio.get_running_loop()
        self._waiting, self._began_s = asyncio.Queue(MAX_WAITING), loop.time()
        # of the addresses of a name, the one by which programs find a device, which knows IPv4 alone
        transport, _ = await loop.create_datagram_endpoint(
            lambda: self, local_addr=(self._host, self.port), family=socket.AF_INET
        )
        self.port = transport.get_extra_info("sockname")[1]
        on_open()
        scanning = None
        try:
            while True:
                message, address = await self._next_message(scanning)
                if scanning is not None:  # any message ends a scan
                    scanning.cancel()
                    scanning = None
                with self._refusing(message.kind, address):
                    if message.kind == AUTO_TRANSMIT:
                        scanning = asyncio.create_task(self._scan_on(parse_scan(message.payload), address))
                    else:
                        await self._answer(message, address)
        finally:
            if scanning is not None:
                scanning.cancel()
                await asyncio.gather(scanning, return_exceptions=True)
            transport.close()

    async def _next_message(self, scanning: asyncio.Task | None) -> tuple[PingMessage, object]:
        """Return the next message and where it came from; raise what ends a scan, as a failure of the machine does."""
        coming = asyncio.ensure_future(self._waiting.get())
        try:
            running = {coming} if scanning is None else {coming, scanning}
            await asyncio.wait(running, return_when=asyncio.FIRST_COMPLETED)
            if scanning is not None and scanning.done():
                scanning.result()
            return await coming
        finally:
            coming.cancel()

    async def _answer(self, message: PingMessage, address) -> None:
        """Answer a message; raises Error for a wrong one."""
        kind = message.kind
        if kind == TRANSDUCER:
            self._last, transmits = parse_transducer(message.payload)
            self._send(self._last.data(await self._counts(self._last) if transmits else b""), address)
        elif kind == GENERAL_REQUEST and len(message.payload) == 2:
            self._send(self._reply(int.from_bytes(message.payload, "little")), address)
        elif kind in (SET_DEVICE_ID, RESET, MOTOR_OFF):
            self._send(PingMessage(ACK, kind.to_bytes(2, "little")), address)
        else:
            self._send(_nack(kind, "this device does not know the message"), address)

    def _reply(self, kind: int) -> PingMessage:
        replies = {
            DEVICE_INFORMATION: PingMessage(kind, INFORMATION),
            PROTOCOL_VERSION: PingMessage(kind, PROTOCOL),
            DEVICE_DATA: self._last.data(b""),
        }
        return replies.get(kind) or _nack(kind, "this device does not have the message")

    @contextmanager
    def _refusing(self, kind: int, address):
        """Refuse a type of message that is wrong, or whose ping fails, but where the machine is at fault."""
        try:
            yield
        except MachineError:
            raise
        except Error as why:
            self._send(_nack(kind, str(why)), address)

    async def _scan_on(self, scan: Scan, address) -> None:
        with self._refusing(AUTO_TRANSMIT, address):
            for number in count():
                settings = replace(scan.settings, angle=scan.angle(number))
                self._send(scan.data(settings, await self._counts(settings)), address)
                await asyncio.sleep(scan.delay_s)

    async def _counts(self, settings: TransducerSettings) -> bytes:
        """Return the counts of a ping, made beside the network."""
        loop = asyncio.get_running_loop()
        time_s = loop.time() - self._began_s
        counts = await loop.run_in_executor(self._simulation, self._device.ping, settings, time_s)
        self.pings += 1
        return counts

    def _send(self, message: PingMessage, address) -> None:
        self._transport.sendto(message.pack(DEVICE_NUMBER, 0), address)


def _nack(kind: int, why: str) -> PingMessage:
    return PingMessage(NACK, kind.to_bytes(2, "little") + why.encode("ascii", "replace") + b"\0")
