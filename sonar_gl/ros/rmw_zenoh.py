"""How ROS 2 names its topics on zenoh: the keys, liveliness tokens and attachments of rmw_zenoh.

After the design document of ros2/rmw_zenoh [1]_, and `qos_to_keyexpr` in its liveliness_utils.cpp.

References
----------
.. [1] https://github.com/ros2/rmw_zenoh/blob/rolling/docs/design.md, "Graph Cache" and "Publishers"
"""

from __future__ import annotations

import hashlib
import re
import struct
from dataclasses import dataclass

from sonar_gl.core.checks import check_whole_number, shown
from sonar_gl.core.errors import Error
from sonar_gl.ros.transport import MAX_DOMAIN, Topic, check_topic

NO_HASH = "TypeHashNotSupported"  # in place of the hash with ROS 2 Humble
PUBLISHER, SUBSCRIPTION = "MP", "MS"  # kinds of entities
# enumerators of rmw/types.h; what is rmw_zenoh's default is left out of a token: reliable, volatile, 42 messages
BEST_EFFORT, TRANSIENT_LOCAL, DEFAULT_DEPTH = 2, 1, 42
GID_BYTES = 16
ATTACHMENT = struct.Struct(f"<qqB{GID_BYTES}s")  # number, time, length of the GID, GID
NODE_NAME, TYPE_NAME = re.compile(r"[A-Za-z_]\w*", re.ASCII), re.compile(r"(\w+)/msg/(\w+)", re.ASCII)


@dataclass(frozen=True)
class RosNode:
    """A node of ROS 2 without a namespace, the only one of its session; Error if ROS allows no such name or domain."""

    name: str  # letters, digits and "_", first a letter or "_"
    domain: int = 0  # ROS_DOMAIN_ID, 0..232
    type_hashes: bool = True  # False for ROS 2 Humble, which knows no hashes of types

    def __post_init__(self):
        check_whole_number("the ROS domain", self.domain, 0, MAX_DOMAIN, "as in ROS_DOMAIN_ID")
        if not isinstance(self.name, str) or not NODE_NAME.fullmatch(self.name):
            raise Error(
                "the name of a ROS node must have letters, digits and '_' only, and begin with no digit "
                f"(got {shown(self.name)})"
            )

    def key(self, topic: Topic) -> str:
        """Return the key expression of a topic's messages; an Error if ROS does not allow its name or type.

        >>> RosNode("talker").key(Topic("/chatter", "std_msgs/msg/String", "RIHS01_df66", "string data"))
        '0/chatter/std_msgs::msg::dds_::String_/RIHS01_df66'
        """
        name = check_topic("Topic.name", topic.name)
        return "/".join([str(self.domain), name[1:], *self._type(topic)])

    def token(self, session: str) -> str:
        """Return the liveliness token of this node; `session` is the identifier of the zenoh session, hexadecimal."""
        return self._token(session, 0, "NN")

    def entity_token(self, session: str, number: int, kind: str, topic: Topic) -> str:
        """Return the liveliness token of a publisher or subscription.

        number : of the entity, which no other one of the session has, 1 or more
        kind : PUBLISHER or SUBSCRIPTION
        """
        parts = topic.name.replace("/", "%"), *self._type(topic), quality_text(topic)
        return "/".join([self._token(session, number, kind), *parts])

    def _token(self, session: str, number: int, kind: str) -> str:
        # the first 0 is this node's number; enclave and namespace are "/", with % for the slash
        return f"@ros2_lv/{self.domain}/{session}/0/{number}/{kind}/%/%/{self.name}"

    def _type(self, topic: Topic) -> tuple[str, str]:
        """Return the name that DDS has for the type of a topic, and its hash."""
        found = TYPE_NAME.fullmatch(topic.msgtype)
        if found is None:
            raise Error(
                f"the type of {topic.name} must be like 'sensor_msgs/msg/Image' (got {shown(topic.msgtype)})"
            )
        return f"{found[1]}::msg::dds_::{found[2]}_", topic.type_hash if self.type_hashes else NO_HASH


def quality_text(topic: Topic) -> str:
    """Return the quality of service of a topic as tokens have it.

    RELIABILITY:DURABILITY:HISTORY,DEPTH:DEADLINE:LIFESPAN:LIVELINESS, each empty for the default.

    >>> quality_text(Topic("/chatter", "std_msgs/msg/String", "", "", depth=7))
    '::,7:,:,:,,'
    """
    reliability = "" if topic.reliable else str(BEST_EFFORT)
    durability = str(TRANSIENT_LOCAL) if topic.latched else ""
    depth = "" if topic.depth == DEFAULT_DEPTH else str(topic.depth)
    return f"{reliability}:{durability}:,{depth}:,:,:,,"


def gid_of(token: str) -> bytes:
    """Return an identifier of a publisher, 16 bytes, from its token.

    rmw_zenoh takes XXH3; any number that is the same in all messages of one publisher, and of no other, will do.
    """
    return hashlib.blake2b(token.encode(), digest_size=GID_BYTES).digest()


def attachment(number: int, time_ns: int, gid: bytes) -> bytes:
    """Return what is attached to a message, 33 bytes.

    number : of the message, from 1 for the first one of its publisher
    time_ns : time of sending, nanoseconds since 1970, by the computer's clock
    gid : of the publisher, 16 bytes
    """
    return ATTACHMENT.pack(number, time_ns, GID_BYTES, gid)
