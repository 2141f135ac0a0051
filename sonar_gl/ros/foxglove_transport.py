"""Topics of ROS 2 for Foxglove and Lichtblick, viewers that connect to a WebSocket server; no ROS is needed."""

from __future__ import annotations

import logging
import os
import threading
import time
from collections.abc import Callable
from functools import partial
from types import SimpleNamespace

from sonar_gl.core.checks import check_kind, check_whole_number
from sonar_gl.core.errors import Error, closed_error
from sonar_gl.core.extras import missing_extra
from sonar_gl.core.hosts import is_local, wait_until_free
from sonar_gl.core.warn import warn_caller
from sonar_gl.ros.inbox import Inbox
from sonar_gl.ros.transport import Topic, Transport, check_process, check_same_type

logger = logging.getLogger(__name__)

PORT = 8765  # that viewers propose
ENCODING, SCHEMA_ENCODING = "cdr", "ros2msg"
# logger of the SDK: an error for each wrong request of a viewer
WRONG_REQUESTS = "foxglove.websocket.connected_client"
MAX_BACKLOG = 64  # messages for a viewer that is too slow; it misses the oldest
CLOSE_S = 5.0  # for the server to disconnect its viewers, and to give its port back


def _library() -> SimpleNamespace:
    """Return the modules of foxglove-sdk, loaded on first use, or raise an Error."""
    try:
        import foxglove
        import foxglove.websocket
    except ImportError as why:
        raise missing_extra("live", f"Foxglove needs foxglove-sdk (got no module {why.name})") from None
    return SimpleNamespace(sdk=foxglove, websocket=foxglove.websocket)


class FoxgloveTransport(Transport):
    """Serves messages to viewers that connect, and takes those that they publish.

    Messages are in CDR, as over ROS, and each topic states the definition of its type.

    Parameters
    ----------
    host : address of this machine at which it listens; any but 127.0.0.1 is warned of
    port : TCP port, 0 for one that is free

    Raises
    ------
    Error
        if an argument is wrong, it cannot listen there, or the extra `live` is not installed.
    """

    def __init__(self, host: str = "127.0.0.1", port: int = PORT):
        check_kind("host", host, str, "such as '127.0.0.1'")
        check_whole_number("port", port, 0, 2**16 - 1)
        self._library, self._lock, self._is_open = _library(), threading.Lock(), True
        self._host, self._process = host, os.getpid()
        self._context = self._library.sdk.Context()
        self._topics: dict[str, Topic] = {}  # by name, as the next two
        self._channels, self._last = {}, {}  # latched topics have a last message and its time
        self._readers: list[tuple[Topic, Inbox]] = []
        self._dropped = 0  # of subscriptions that have ended
        # viewers are told; nobody else can fill a log
        logging.getLogger(WRONG_REQUESTS).setLevel(logging.CRITICAL)
        if not is_local(host):
            warn_caller(f"any machine that reaches {host} can see these topics, and publish poses")
        try:
            self._server = self._library.sdk.start_server(
                name="sonar_gl",
                host=host,
                port=port,
                capabilities=[self._library.websocket.Capability.ClientPublish],
                supported_encodings=[ENCODING],
                server_listener=_Listener(self._repeat, self._read),
                context=self._context,
                message_backlog_size=MAX_BACKLOG,
            )
        except RuntimeError as why:
            reason = str(why).rpartition("port: ")[2].partition(" (os error")[0].lower()
            raise Error(
                f"the Foxglove server must be able to listen at {host}:{port} (got {reason}; is another program using "
                "the port? port=0 takes a free one)"
            ) from None

    @property
    def port(self) -> int:
        """The port: the one that was asked for, or the one that the system chose for 0."""
        return self._server.port

    @property
    def dropped(self) -> int:
        """Number of received messages that were dropped, as more came than were read."""
        with self._lock:
            return self._dropped + sum(inbox.missed for _, inbox in self._readers)

    def advertise(self, topic: Topic) -> None:
        """Make a topic known to viewers; raise Error if the same name has another type, or the transport is closed."""
        with self._lock:
            self._channel(topic)

    def publish(self, topic: Topic, message: bytes, time_ns: int) -> None:
        """Send a message without waiting; a viewer that is too slow misses the oldest of MAX_BACKLOG.

        Raises Error as `advertise`.
        """
        with self._lock:
            channel = self._channel(topic)
            if topic.latched:
                self._last[topic.name] = message, time_ns
        channel.log(message, log_time=time_ns)

    def subscribe(self, topic: Topic, receive: Callable[[bytes], None]) -> Callable[[], None]:
        """Call `receive` with each message that viewers publish on a topic, in a thread of its own.

        Messages of another type are ignored, and those in another encoding than CDR, of which the log tells. While
        `receive` works, `topic.depth` messages wait, of which newer ones replace older ones. Raises Error if the
        transport is closed.
        """
        with self._lock:
            self._check_open()
            reader = topic, Inbox(topic.name, receive, topic.depth)
            self._readers.append(reader)
        return partial(self._withdraw, reader)

    def close(self) -> None:
        """Disconnect the viewers, end the server and its threads, and give the port back; may be called twice.

        It takes CLOSE_S at most. The connection of a viewer that does not read ends with the viewer or the program.
        """
        if os.getpid() != self._process:  # of a fork: the server is the parent's
            return
        with self._lock:
            was_open, self._is_open = self._is_open, False
        if not was_open:
            return
        port, end_s = self.port, time.monotonic() + CLOSE_S  # a server that has stopped forgets its port
        # `stop` takes no limit: it waits for ever for a viewer that does not read what is sent to it, and no signal
        # ends it. At the end of the program the SDK's own `atexit` ends what is left of it
        stopping = threading.Thread(target=self._server.stop, name="foxglove stop", daemon=True)
        stopping.start()
        try:
            stopping.join(CLOSE_S)
        finally:  # also after Ctrl-C
            for channel in self._channels.values():
                channel.close()
            for _, inbox in self._readers:
                inbox.close()
        if stopping.is_alive():
            logger.warning(
                "a viewer does not read, and is not disconnected after %g s; its connection ends with this program",
                CLOSE_S,
            )
        # `stop` waits for the viewers' connections only: a task of the SDK that it does not wait for ends the listening
        if not wait_until_free(self._host, port, end_s - time.monotonic()):
            logger.warning(
                "port %d is still in use %g s after the Foxglove server was closed, by it or by another program",
                port,
                CLOSE_S,
            )

    def _withdraw(self, reader: tuple[Topic, Inbox]) -> None:
        """End a subscription, if it has not ended yet."""
        with self._lock:
            if reader not in self._readers:
                return
            self._readers.remove(reader)
            self._dropped += reader[1].missed
        reader[1].close()

    def _check_open(self) -> None:
        check_process(self._process, "FoxgloveTransport")
        if not self._is_open:
            raise closed_error("FoxgloveTransport")

    def _channel(self, topic: Topic):
        """Return the channel of a topic, made on first use, or raise an Error."""
        self._check_open()
        check_same_type(topic, self._topics.setdefault(topic.name, topic))
        if topic.name not in self._channels:
            data = topic.definition.encode()
            schema = self._library.sdk.Schema(name=topic.msgtype, encoding=SCHEMA_ENCODING, data=data)
            self._channels[topic.name] = self._library.sdk.Channel(
                topic.name, schema=schema, message_encoding=ENCODING, context=self._context
            )
        return self._channels[topic.name]

    def _repeat(self, name: str) -> None:
        """Send the last message of a latched topic again; all viewers receive it, for whom it is nothing new."""
        with self._lock:
            channel, last = self._channels.get(name), self._last.get(name)
        if last is not None:
            message, time_ns = last
            channel.log(message, log_time=time_ns)

    def _read(self, name: str, msgtype: str, message: bytes) -> None:
        """Pass a message of a viewer on to those who read its topic."""
        with self._lock:
            readers = list(self._readers) if self._is_open else []
        for topic, inbox in readers:
            if (topic.name, topic.msgtype) == (name, msgtype):
                inbox.tell(message)


class _Listener:
    """Told by the server, in its threads, of what viewers do.

    repeat : called with the name of a topic to which a viewer subscribes
    read : called with name, type and bytes of each message in CDR that a viewer publishes
    """

    def __init__(self, repeat: Callable[[str], None], read: Callable[[str, str, bytes], None]):
        self._repeat, self._read = repeat, read
        self._published = {}  # client and its number of a channel -> name and type of the topic

    def on_subscribe(self, client, channel) -> None:
        self._repeat(channel.topic)

    def on_unsubscribe(self, client, channel) -> None:
        """Do nothing."""

    def on_client_advertise(self, client, channel) -> None:
        if channel.encoding == ENCODING:
            self._published[client.id, channel.id] = channel.topic, channel.schema_name
        else:
            logger.warning(
                "messages of a viewer on %r are ignored: they must be in %s, not in %r",
                channel.topic,
                ENCODING,
                channel.encoding,
            )

    def on_client_unadvertise(self, client, client_channel_id: int) -> None:
        """Forget a topic of a viewer, which also happens when it disconnects."""
        self._published.pop((client.id, client_channel_id), None)

    def on_message_data(self, client, client_channel_id: int, data: bytes) -> None:
        published = self._published.get((client.id, client_channel_id))
        if published is not None:
            self._read(*published, data)
