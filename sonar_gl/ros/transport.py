"""What carries messages to other programs: one interface over zenoh, DDS and Foxglove."""

from __future__ import annotations

import os
import re
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from weakref import WeakKeyDictionary

from sonar_gl.core.checks import check_whole_number, shown
from sonar_gl.core.errors import Error, other_process_error
from sonar_gl.ros.messages import message_types

MAX_DOMAIN = 232  # of ROS 2; beyond, DDS has no ports
# of REP 144 and ROS 2's design of names, with a full path
TOPIC_NAME = re.compile(r"(/[A-Za-z_][A-Za-z0-9_]*)+")


def ros_domain(domain: int | None = None) -> int:
    """Return a domain of ROS 2, a whole number in 0..232, or raise an Error.

    None is the environment variable ROS_DOMAIN_ID, or 0, as for nodes of ROS 2.
    """
    if domain is not None:
        return check_whole_number("the ROS domain", domain, 0, MAX_DOMAIN, "as in ROS_DOMAIN_ID")
    text = os.environ.get("ROS_DOMAIN_ID", "").strip() or "0"
    if not re.fullmatch("[0-9]{1,9}", text):
        raise Error(f"ROS_DOMAIN_ID must be a whole number in 0..{MAX_DOMAIN} (got {shown(text)})")
    return check_whole_number("ROS_DOMAIN_ID", int(text), 0, MAX_DOMAIN)


def check_topic(what: str, name) -> str:
    """Return the full name of a topic, which begins with "/"; an Error if ROS does not allow it."""
    if isinstance(name, str) and TOPIC_NAME.fullmatch(name) and "__" not in name and len(name) < 200:
        return name
    raise Error(
        f"{what} must be the full name of a topic: words of letters, digits and single _, each after a / (got "
        f"{shown(name)}; such as /sonar/image)"
    )


@dataclass(frozen=True)
class Topic:
    """A topic of ROS 2 and the type of its messages.

    Parameters
    ----------
    name : begins with "/", such as "/sonar/image"
    msgtype : such as "sensor_msgs/msg/Image"
    type_hash : "RIHS01_" and 64 hexadecimal digits, as ROS 2 Iron and later compare them
    definition : fields of the type, and of the types in it, in ROS's language
    reliable : True if what is lost is sent again
    latched : True if late subscribers receive the last message ("transient local")
    depth : number of messages that wait for a slow subscriber
    """

    name: str
    msgtype: str
    type_hash: str
    definition: str
    reliable: bool = True
    latched: bool = False
    depth: int = 5

    @classmethod
    def of_type(cls, name: str, msgtype: str, **quality) -> Topic:
        """Return a topic of a type that `message_types` knows, with its hash and definition.

        name, msgtype : as of a Topic; types are those of ROS 2 Humble, and of pings. Of others make a `Topic` with hash
            and definition: here they are an Error
        quality : `reliable`, `latched` and `depth` of the Topic

        >>> Topic.of_type("/chatter", "std_msgs/msg/String").type_hash[:15]
        'RIHS01_df668c74'
        """
        definition, type_hash = message_types().schema(msgtype)
        return cls(name, msgtype, type_hash, definition, **quality)


def check_process(process: int, kind: str) -> None:
    """Raise an Error in a fork of the process that made a transport: it lacks the threads that send."""
    if os.getpid() != process:
        raise other_process_error(kind)


def check_same_type(topic: Topic, known: Topic) -> None:
    """Raise an Error if a topic has another type than one of the same name before, whose messages are laid out so."""
    if (topic.msgtype, topic.definition) != (known.msgtype, known.definition):
        raise Error(
            f"a topic must have one type (got {topic.msgtype} for {topic.name!r}, which had {known.msgtype} before"
            f"{'' if topic.msgtype != known.msgtype else ', with another definition'})"
        )


class Transport(ABC):
    """Carries messages in CDR, little endian, with its header of four bytes. Threads may share it."""

    @abstractmethod
    def advertise(self, topic: Topic) -> None:
        """Make a topic known to other programs; `publish` does so, too, where this was not called."""

    @abstractmethod
    def publish(self, topic: Topic, message: bytes, time_ns: int) -> None:
        """Send a message without waiting for those who receive it, nor for messages of other topics.

        time_ns : time of the message in nanoseconds, as in its header
        """

    @abstractmethod
    def subscribe(self, topic: Topic, receive: Callable[[bytes], None]) -> Callable[[], None]:
        """Call `receive` with each message of other programs on a topic, in a thread of the transport.

        Returns a function that withdraws the subscription, which may be called twice, and after `close`. A call of
        `receive` that has begun by then still ends.
        """

    @abstractmethod
    def close(self) -> None:
        """Withdraw the topics and give back what it holds; may be called twice."""


# of each transport: links of all publishers, by name of the topic and child frame
_static_links: WeakKeyDictionary[Transport, dict[tuple[str, str], object]] = WeakKeyDictionary()
_static_lock = threading.Lock()  # also while a message is sent, so that a later one holds no fewer links


def publish_static(transport: Transport, topic: Topic, links: Sequence, time_ns: int) -> None:
    """Publish frames that do not move, together with those of before; one of the same child frame replaces another.

    A latched topic keeps one message for late subscribers, so that each message of /tf_static must hold all links, as
    those of tf2_ros' StaticTransformBroadcaster do. A frame stays when its publisher is closed, as it does there.

    links : geometry_msgs/TransformStamped
    """
    types = message_types()
    with _static_lock:
        known = _static_links.setdefault(transport, {})
        known |= {(topic.name, link.child_frame_id): link for link in links}
        links = [link for (name, _), link in known.items() if name == topic.name]
        transport.publish(topic, types.encode(types.transforms(links)), time_ns)
