"""How nodes of ROS 2 announce themselves on DDS: the message of the topic `ros_discovery_info`.

After ros2/rmw_dds_common [1]_: each participant tells its nodes, and which readers and writers belong to each. The
identifiers of DDS entities in it have 16 bytes since Iron, and 24 in Humble, of which the last 8 are 0.

References
----------
.. [1] https://github.com/ros2/rmw_dds_common, folder msg, and https://design.ros2.org/articles/Node_to_Participant_mapping.html
"""

from __future__ import annotations

import struct
from collections.abc import Iterable

DISCOVERY_TOPIC = "ros_discovery_info"  # of DDS: without the rt/ of other topics
DISCOVERY_TYPE = "rmw_dds_common/msg/ParticipantEntitiesInfo"
ENCLAVE = b"enclave=/;"  # user data by which a participant is known as one of ROS
NAMESPACE = "/"
GID_BYTES = {"humble": 24, "jazzy": 16}
DISTRIBUTIONS = tuple(GID_BYTES)
LITTLE_ENDIAN = b"\x00\x01\x00\x00"
SEPARATOR = "=" * 80


def discovery_definition(distribution: str) -> str:
    """Return the fields of the message, in ROS's language.

    distribution : one of DISTRIBUTIONS; "jazzy" is also that of Iron and of all after Jazzy
    """
    return f"""rmw_dds_common/Gid gid
rmw_dds_common/NodeEntitiesInfo[] node_entities_info_seq
{SEPARATOR}
MSG: rmw_dds_common/NodeEntitiesInfo
string<=256 node_namespace
string<=256 node_name
rmw_dds_common/Gid[] reader_gid_seq
rmw_dds_common/Gid[] writer_gid_seq
{SEPARATOR}
MSG: rmw_dds_common/Gid
char[{GID_BYTES[distribution]}] data
"""


def discovery_message(
    distribution: str, node: str, participant: bytes, readers: Iterable[bytes], writers: Iterable[bytes]
) -> bytes:
    """Return the message of a participant with one node, in CDR.

    participant, readers, writers : GUIDs of the entities, 16 bytes each

    >>> discovery_message("jazzy", "sonar", bytes(16), [], []).hex(" ", 4)[36:]
    '00000000 01000000 02000000 2f000000 06000000 736f6e61 72000000 00000000 00000000'
    """
    length = GID_BYTES[distribution]

    def gids(guids):
        padded = [guid.ljust(length, b"\0") for guid in guids]
        return struct.pack("<I", len(padded)) + b"".join(padded)

    message = LITTLE_ENDIAN + participant.ljust(length, b"\0") + struct.pack("<I", 1)
    for text in (NAMESPACE, node):
        data = text.encode() + b"\0"
        message += struct.pack("<I", len(data)) + data
        message += bytes(-len(message) % 4)  # the next number begins at a multiple of its length
    return message + gids(readers) + gids(writers)
