"""Messages that the tests of transports send, and where a zenoh router for them runs."""

from __future__ import annotations

import json
import socket
import struct
from contextlib import contextmanager

import numpy as np

from sonar_gl.ros.messages import message_types
from sonar_gl.ros.transport import Topic
from tests.support.even_ping import even_ping
from tests.support.ros_topics import PROJECTED, topic_of

STAMP = struct.Struct("<iI")  # seconds and nanoseconds
STAMP_AT = 4  # behind the four bytes of CDR's own header


def sonar_topic(**quality) -> Topic:
    """Return the topic of pings."""
    return topic_of("/sonar/projected_image", PROJECTED, **quality)


def ping_message(n_beams: int = 256, n_bins: int = 512):
    """Return a ping whose counts differ from bin to bin, and the ProjectedSonarImage of it in CDR."""
    ping = even_ping(n_beams, n_bins, 0.35)
    ping.intensity[:] = np.random.default_rng(1).exponential(1.0, ping.intensity.shape)
    types = message_types()
    message = types.ping(types.header(0, "sonar_beams"), ping, "port")
    return ping, types.encode(message)


def stamped(message: bytes, time_ns: int) -> bytes:
    """Return a message that begins with a std_msgs/Header at another time, nanoseconds."""
    seconds, rest = divmod(time_ns, 10**9)
    return message[:STAMP_AT] + STAMP.pack(seconds, rest) + message[STAMP_AT + STAMP.size :]


def stamp_of(message: bytes) -> int:
    """Return the time of a message that begins with a std_msgs/Header, nanoseconds."""
    seconds, rest = STAMP.unpack_from(message, STAMP_AT)
    return seconds * 10**9 + rest


def free_port() -> int:
    """Return a TCP port of 127.0.0.1 that nobody uses."""
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return one.getsockname()[1]


@contextmanager
def zenoh_router(port: int):
    """Run a zenoh router at 127.0.0.1 as rmw_zenohd does: it forwards nothing between peers."""
    with open_session("router", listen=[f"tcp/127.0.0.1:{port}"]) as session:
        yield session


@contextmanager
def open_session(mode: str, connect: tuple = (), listen: tuple = ()):
    """Open a zenoh session with the settings that rmw_zenoh has, and close it in the end.

    It does not wait for others to be found, as rmw_zenoh does for half a second: tests wait for what they need.
    """
    import zenoh

    settings = {
        "mode": mode,
        "connect/endpoints": list(connect),
        "listen/endpoints": list(listen),
        "scouting/multicast/enabled": False,
        "scouting/delay": 0,  # milliseconds
        "timestamping/enabled": True,
        "routing/router/peers_failover_brokering": False,
    }
    config = zenoh.Config()
    for name, value in settings.items():
        config.insert_json5(name, json.dumps(value))
    session = zenoh.open(config)
    try:
        yield session
    finally:
        session.close()
