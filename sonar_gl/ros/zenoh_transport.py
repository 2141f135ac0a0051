"""Topics of ROS 2 over zenoh, as programs with rmw_zenoh exchange them; no ROS is needed."""

from __future__ import annotations

import json
import os
import re
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from itertools import count
from types import SimpleNamespace

from sonar_gl.core.checks import shown
from sonar_gl.core.errors import Error, MachineError, closed_error
from sonar_gl.core.extras import missing_extra
from sonar_gl.core.hosts import is_local
from sonar_gl.core.warn import warn_caller
from sonar_gl.ros.inbox import Inbox
from sonar_gl.ros.rmw_zenoh import PUBLISHER, SUBSCRIPTION, RosNode, attachment, gid_of
from sonar_gl.ros.transport import Topic, Transport, check_process, check_same_type, ros_domain

ROUTER = "tcp/127.0.0.1:7447"  # where rmw_zenohd listens
ADDRESS = re.compile(r"tcp/(\[[0-9A-Fa-f:.]+\]|[\w.-]+):(\d{1,5})", re.ASCII)
REMOTE_TIMEOUT_MS = 3000  # for the first connection to a router of another machine
HEARTBEAT_S = 0.5  # between announcements of the last message of a latched topic; rmw_zenoh's
MAX_BATCHES = 16  # zenoh's most; its default, 2, does not hold a ping of 256 beams and 512 bins
RETRY = {
    "period_init_ms": 500,
    "period_max_ms": 2000,
    "period_increase_factor": 2,
}  # towards a router that is gone


def _libraries() -> SimpleNamespace:
    """Return the modules of eclipse-zenoh, loaded on first use, or raise an Error."""
    try:
        import zenoh
        import zenoh.ext
    except ImportError as why:
        raise missing_extra("live", f"zenoh needs eclipse-zenoh (got no module {why.name})") from None
    return SimpleNamespace(zenoh=zenoh, ext=zenoh.ext)


@dataclass
class _Sender:
    """A publisher of zenoh, with what is attached to its messages."""

    topic: Topic
    publisher: object
    gid: bytes
    number: int = 0  # of the last message
    lock: threading.Lock = field(default_factory=threading.Lock)  # numbers arrive in their order


class ZenohTransport(Transport):
    """Carries messages over zenoh, with the keys, tokens and attachments of rmw_zenoh.

    With a router on this machine this is a peer as ROS's own programs are: it finds them by the router, and
    exchanges messages with them directly, by a port at 127.0.0.1. With a router on another machine it is a client:
    all messages go through that router, and no port is opened. It reconnects by itself to a router that returns.

    Parameters
    ----------
    connect : "tcp/HOST:PORT" of a zenoh router, such as rmw_zenohd
    domain : of the programs to reach, 0..232; None is the environment variable ROS_DOMAIN_ID, or 0
    node : name by which `ros2 node list` shows this program
    type_hashes : False for programs of ROS 2 Humble, whose topics have no hashes

    Raises
    ------
    Error
        if an argument is wrong, a router of another machine does not answer, or the extra `live` is not installed.

    Notes
    -----
    Without a router on this machine there is a warning, and messages reach nobody until it is started.
    A router on another machine is a warning, since whoever reaches it can read and send messages.
    What is published while nobody is connected is not sent later, but for the last messages of latched topics.
    """

    def __init__(
        self,
        connect: str = ROUTER,
        domain: int | None = None,
        node: str = "sonar_gl",
        type_hashes: bool = True,
    ):
        self._node, self._process = RosNode(node, ros_domain(domain), type_hashes), os.getpid()
        is_local = _is_local(connect)
        self._libraries, self._lock = _libraries(), threading.Lock()
        self._session = self._opened(connect, is_local)
        self._senders, self._numbers, self._dropped = {}, count(1), 0
        # what zenoh has declared lasts as long as Python holds it
        self._subscribed = {}  # inbox: subscriber and token
        try:
            self._declared = [self._session.liveliness().declare_token(self._node.token(self.session_id))]
            self._warn(connect, is_local)
        except BaseException:
            self._session.close()
            raise

    @property
    def session_id(self) -> str:
        """The identifier of the session, hexadecimal, as in tokens."""
        return str(self._session.zid())

    @property
    def dropped(self) -> int:
        """Number of received messages that were dropped, as more came than were read."""
        with self._lock:
            return self._dropped + sum(inbox.missed for inbox in self._subscribed)

    def advertise(self, topic: Topic) -> None:
        """Make a topic known; Error if ROS does not allow its name or type, its name has another, or this is closed."""
        self._sender(topic)

    def publish(self, topic: Topic, message: bytes, time_ns: int) -> None:
        """Send a message without waiting; where the network is too slow, it is dropped, as rmw_zenoh does.

        The time of sending goes with it, by the computer's clock as of rmw_zenoh, not `time_ns`. Raises Error as
        `advertise`.
        """
        sender = self._sender(topic)
        with sender.lock:
            sender.number += 1
            attached = attachment(sender.number, time.time_ns(), sender.gid)
            try:
                sender.publisher.put(message, attachment=attached)
            except self._libraries.zenoh.ZError:
                raise closed_error("ZenohTransport") from None

    def subscribe(self, topic: Topic, receive: Callable[[bytes], None]) -> Callable[[], None]:
        """Call `receive` with each message of other programs on a topic, in a thread of its own.

        While it works, `topic.depth` messages wait, of which newer ones replace older ones. Raises Error as
        `advertise`.
        """
        check_process(self._process, "ZenohTransport")
        key, zenoh, ext = self._node.key(topic), self._libraries.zenoh, self._libraries.ext
        inbox = Inbox(topic.name, receive, topic.depth)
        # without a thread of zenoh's in between, whose queue has no limit
        handler = zenoh.handlers.Callback(
            lambda sample: inbox.tell(sample.payload.to_bytes()), indirect=False
        )
        latched = {}
        if topic.latched:
            latched["subscriber_detection"] = True
            latched["history"] = ext.HistoryConfig(detect_late_publishers=True, max_samples=topic.depth)
            if topic.reliable:
                latched["recovery"] = ext.RecoveryConfig(periodic_queries=None, heartbeat=True)
        try:
            with self._lock:
                subscriber = ext.declare_advanced_subscriber(
                    self._session, key, handler, allowed_origin=zenoh.Locality.REMOTE, **latched
                )
                self._subscribed[inbox] = subscriber, self._declare_token(SUBSCRIPTION, topic)[1]
        except zenoh.ZError:
            inbox.close()
            raise closed_error("ZenohTransport") from None
        return partial(self._withdraw, inbox)

    def close(self) -> None:
        """Withdraw the topics, and end the session and its threads; may be called twice."""
        if os.getpid() != self._process:  # of a fork: the threads that would end are the parent's
            return
        self._session.close()  # before the inboxes, so that no more messages come
        for inbox in list(self._subscribed):
            inbox.close()

    def _withdraw(self, inbox: Inbox) -> None:
        """End the subscription of an inbox, if it has not ended yet."""
        with self._lock:
            declared = self._subscribed.pop(inbox, ())
            self._dropped += inbox.missed if declared else 0
        for one in declared:
            with suppress(self._libraries.zenoh.ZError):  # of a session that is closed
                one.undeclare()
        inbox.close()

    def _opened(self, connect: str, is_local: bool):
        config, zenoh = self._libraries.zenoh.Config(), self._libraries.zenoh
        settings = {
            # a peer that can be reached at 127.0.0.1 only is none for a router elsewhere, which forwards for clients
            "mode": "peer" if is_local else "client",
            "connect/endpoints": [connect],
            "connect/timeout_ms": -1 if is_local else REMOTE_TIMEOUT_MS,
            "connect/retry": RETRY,
            "listen/endpoints": ["tcp/127.0.0.1:0"] if is_local else [],
            "scouting/multicast/enabled": False,
            "timestamping/enabled": True,  # caches of latched topics sort by time
            # batches of 64 kB that wait for the network; a message that does not fit in at once is dropped
            "transport/link/tx/queue/size/data": MAX_BATCHES,
            "transport/shared_memory/enabled": False,  # files of processes that crash would remain
        }
        for name, value in settings.items():
            config.insert_json5(name, json.dumps(value))
        try:
            return zenoh.open(config)
        except zenoh.ZError as why:
            if is_local:
                raise MachineError(f"zenoh must be able to listen at 127.0.0.1 (got {why})") from None
            wait = f"no answer in {REMOTE_TIMEOUT_MS / 1000:g} s"
            raise MachineError(
                f"a zenoh router must answer at {connect} (got {wait}; start it there, or give its address)"
            ) from None

    def _warn(self, connect: str, is_local: bool) -> None:
        if not is_local:
            warn_caller(
                f"zenoh leaves this machine by the router at {connect}: who reaches it can read these topics and send "
                "poses"
            )
        if not list(self._session.info.routers_zid()):
            warn_caller(
                f"no zenoh router answers at {connect}: other programs find these topics once one runs there, "
                "such as `ros2 run rmw_zenoh_cpp rmw_zenohd`"
            )

    def _sender(self, topic: Topic) -> _Sender:
        """Return what sends the messages of a topic, declared on first use."""
        check_process(self._process, "ZenohTransport")
        with self._lock:
            sender = self._senders.get(topic.name)
            if sender is None:
                sender = self._senders[topic.name] = self._declare_sender(topic)
            check_same_type(topic, sender.topic)
            return sender

    def _declare_sender(self, topic: Topic) -> _Sender:
        """Return a publisher of a topic that other programs know of."""
        key, zenoh, ext = self._node.key(topic), self._libraries.zenoh, self._libraries.ext
        latched = {}
        if topic.latched:
            latched["cache"] = ext.CacheConfig(topic.depth)
            latched["publisher_detection"] = True
            if topic.reliable:
                latched["sample_miss_detection"] = ext.MissDetectionConfig(
                    heartbeat=None, sporadic_heartbeat=HEARTBEAT_S
                )
        reliability = zenoh.Reliability
        try:
            publisher = ext.declare_advanced_publisher(
                self._session,
                key,
                congestion_control=zenoh.CongestionControl.DROP,
                reliability=reliability.RELIABLE if topic.reliable else reliability.BEST_EFFORT,
                **latched,
            )
            text, token = self._declare_token(PUBLISHER, topic)
        except zenoh.ZError:
            raise closed_error("ZenohTransport") from None
        self._declared.append(token)
        return _Sender(topic, publisher, gid_of(text))

    def _declare_token(self, kind: str, topic: Topic):
        """Declare the token of a publisher or subscription; return its text and itself."""
        text = self._node.entity_token(self.session_id, next(self._numbers), kind, topic)
        return text, self._session.liveliness().declare_token(text)


def _is_local(connect: str) -> bool:
    """Return whether an address is one of this machine; an Error if it is no address."""
    found = ADDRESS.fullmatch(connect) if isinstance(connect, str) else None
    if found is None or not 0 < int(found[2]) < 2**16:
        raise Error(f"the address of a zenoh router must be like {ROUTER!r} (got {shown(connect)})")
    return is_local(found[1].strip("[]"))
