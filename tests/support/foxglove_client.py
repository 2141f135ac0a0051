"""A viewer as Foxglove's protocol describes it: https://github.com/foxglove/ws-protocol, version 1."""

from __future__ import annotations

import array
import fcntl
import json
import struct
import termios

from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from tests.support.waiting import WAIT_S

MESSAGE = struct.Struct("<BIQ")  # opcode, subscription, nanoseconds
OPCODE = 1  # of messages in both directions
Disconnected = ConnectionClosed  # raised by a use of the connection once the server has ended it


class FoxgloveClient:
    """A viewer that is connected to a port of 127.0.0.1."""

    def __init__(self, port: int):
        self._socket = connect(
            f"ws://127.0.0.1:{port}", subprotocols=["foxglove.sdk.v1"], max_size=None, close_timeout=1.0
        )
        self.server, self.channels = self.next_text("serverInfo"), {}

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()

    def close(self) -> None:
        """Disconnect."""
        self._socket.close()

    def send(self, data: str | bytes) -> None:
        """Send anything."""
        self._socket.send(data)

    def waiting_bytes(self) -> int:
        """Return how many bytes wait in the system for this client, which reads a few messages ahead."""
        count = array.array("i", [0])
        fcntl.ioctl(self._socket.socket, termios.FIONREAD, count)
        return count[0]

    def next_text(self, operation: str) -> dict:
        """Return the next message of an operation, and note channels on the way."""
        while True:
            data = self._socket.recv(timeout=WAIT_S)
            if isinstance(data, str):
                found = json.loads(data)
                if found["op"] == "advertise":
                    self.channels |= {channel["topic"]: channel for channel in found["channels"]}
                if found["op"] == operation:
                    return found

    def subscribe(self, topic: str, number: int = 7) -> dict:
        """Subscribe to a topic, by a number of one's own; return what the server says of it."""
        while topic not in self.channels:
            self.next_text("advertise")
        wanted = {"id": number, "channelId": self.channels[topic]["id"]}
        self.send(json.dumps({"op": "subscribe", "subscriptions": [wanted]}))
        return self.channels[topic]

    def next_message(self) -> tuple[int, int, bytes]:
        """Return subscription, time in nanoseconds and bytes of the next message."""
        while True:
            data = self._socket.recv(timeout=WAIT_S)
            if isinstance(data, bytes):
                opcode, subscription, time_ns = MESSAGE.unpack_from(data)
                assert opcode == OPCODE
                return subscription, time_ns, data[MESSAGE.size :]

    def advertise(self, number: int, topic: str, msgtype: str, encoding: str = "cdr") -> None:
        """Tell of a topic that this viewer publishes."""
        channel = {"id": number, "topic": topic, "encoding": encoding, "schemaName": msgtype}
        self.send(json.dumps({"op": "advertise", "channels": [channel]}))

    def publish(self, number: int, message: bytes) -> None:
        """Publish a message."""
        self.send(struct.pack("<BI", OPCODE, number) + message)
