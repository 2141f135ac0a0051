"""Messages and topics of ROS 2 for the tests of transports."""

from __future__ import annotations

from dataclasses import fields
from functools import cache

import numpy as np
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from sonar_gl.ros.messages import message_types
from sonar_gl.ros.transport import Topic

PROJECTED = "marine_acoustic_msgs/msg/ProjectedSonarImage"
HEADER = "std_msgs/msg/Header"


def topic_of(name: str, msgtype: str = HEADER, **policies) -> Topic:
    """Return a topic with the hash and definition of its type."""
    return Topic.of_type(name, msgtype, **policies)


def header(number: int, frame: str = "sonar_beams"):
    """Return a std_msgs/Header that is different for each number."""
    return message_types().header(number * 1_000_000_007, frame)


def header_bytes(number: int, frame: str = "sonar_beams") -> bytes:
    """Return a std_msgs/Header in CDR."""
    return message_types().encode(header(number, frame))


def projected_image(number: int, n_beams: int = 256, n_bins: int = 512):
    """Return a ProjectedSonarImage whose numbers are all different; the whole of an Oculus takes many packets."""
    types, random = message_types(), np.random.default_rng(number)
    info = types.make(
        "marine_acoustic_msgs/PingInfo",
        900e3,
        1481.5,
        np.linspace(0.3, 0.4, n_beams, dtype=np.float32),
        np.linspace(0.01, 0.02, n_beams, dtype=np.float32),
    )
    directions = [types.make("geometry_msgs/Vector3", *xyz) for xyz in random.normal(size=(n_beams, 3))]
    data = random.integers(0, 256, n_beams * n_bins, dtype=np.uint8)
    image = types.make("marine_acoustic_msgs/SonarImageData", False, 0, n_beams, data)
    ranges = np.linspace(0.5, 30, n_bins, dtype=np.float32)
    return types.make(
        "marine_acoustic_msgs/ProjectedSonarImage", header(number), info, directions, ranges, image
    )


def decode(topic: Topic, message: bytes):
    """Return the message of bytes in CDR, read by the definition that the topic carries."""
    return _store(topic).deserialize_cdr(message, topic.msgtype)


@cache
def _store(topic: Topic):
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(topic.definition, topic.msgtype))
    return store


def plain(message) -> dict | list | str | float:
    """Return the fields of a message as JSON has them."""
    if hasattr(message, "__msgtype__"):
        names = [field.name for field in fields(message)]  # constants are in capitals
        return {name: plain(getattr(message, name)) for name in names if name.islower() and name[0] != "_"}
    if isinstance(message, list):
        return [plain(each) for each in message]
    return message.tolist() if isinstance(message, np.ndarray) else message
