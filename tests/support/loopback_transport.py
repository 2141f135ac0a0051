"""A transport within the process, for tests."""

from __future__ import annotations

from collections import defaultdict

from sonar_gl.ros.messages import message_types
from sonar_gl.ros.transport import Transport


class LoopbackTransport(Transport):
    """Keeps what is published, and hands messages of other programs at once to those who subscribe.

    Attributes
    ----------
    sent : (Topic, bytes, time in nanoseconds) of each message
    topics : Topic of each that was advertised or subscribed to, by name
    """

    def __init__(self):
        self.sent, self.topics, self.is_closed = [], {}, False
        self._receivers = defaultdict(list)

    def advertise(self, topic):
        self.topics[topic.name] = topic

    def publish(self, topic, message, time_ns):
        self.topics[topic.name] = topic
        self.sent.append((topic, message, time_ns))

    def subscribe(self, topic, receive):
        self.topics[topic.name] = topic
        self._receivers[topic.name].append(receive)
        return lambda: self._receivers[topic.name].remove(receive)

    def close(self):
        self.is_closed = True

    def inject(self, name, message):
        """Have a message of another program arrive."""
        for receive in list(self._receivers[name]):
            receive(message)

    def messages(self, name):
        """Return the decoded messages of a topic, in the order in which they were sent."""
        types = message_types()
        return [types.decode(data, topic.msgtype) for topic, data, _ in self.sent if topic.name == name]
