"""The frames that do not move, of all publishers of a transport.

A latched topic keeps one message for late subscribers, so that each message of /tf_static must hold all links, as those
of tf2_ros' StaticTransformBroadcaster do. A frame stays when its publisher is closed, as it does there.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from weakref import WeakKeyDictionary

from sonar_gl.ros.messages import message_types
from sonar_gl.ros.transport import Topic, Transport

# links by name of the topic and child frame
_published: WeakKeyDictionary[Transport, dict[tuple[str, str], object]] = WeakKeyDictionary()
_lock = threading.Lock()  # also while a message is sent, so that a later one holds no fewer links


def publish_static(transport: Transport, topic: Topic, links: Sequence, time_ns: int) -> None:
    """Publish links together with those that were published before; one of the same child frame replaces another.

    links : geometry_msgs/TransformStamped
    """
    types = message_types()
    with _lock:
        known = _published.setdefault(transport, {})
        known |= {(topic.name, link.child_frame_id): link for link in links}
        links = [link for (name, _), link in known.items() if name == topic.name]
        transport.publish(topic, types.encode(types.transforms(links)), time_ns)
