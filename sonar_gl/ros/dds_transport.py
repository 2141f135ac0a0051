"""Messages over DDS as ROS 2 nodes send them, through Cyclone DDS and without ROS.

| of ROS 2 | of DDS |
|---|---|
| topic /sonar/image | topic rt/sonar/image |
| type sensor_msgs/msg/Image | type sensor_msgs::msg::dds_::Image_, final, without keys, in XCDR1 |
| its hash | "typehash=RIHS01_...;" in the user data of writers and readers, which nodes since Iron compare |
| reliable, depth, transient local | the same policies |
| node | a message on `ros_discovery_info` with the GUIDs of its readers and writers |

Messages are bytes here: a type only tells Cyclone DDS how they are laid out. By that it refuses bytes of another
layout, sent or received, and describes the type to other programs. Fast DDS 3 compares descriptions where both sides
send one; nodes of ROS 2 Humble to Jazzy send none, and compare names.
"""

from __future__ import annotations

import ipaddress
import logging
import os
import re
import threading
import time
import weakref
from collections.abc import Callable
from contextlib import suppress
from functools import cache, partial
from itertools import count
from types import SimpleNamespace

from sonar_gl.core.checks import check_choice
from sonar_gl.core.errors import Error
from sonar_gl.core.extras import missing_extra
from sonar_gl.core.hosts import is_local
from sonar_gl.ros.discovery import (
    DISCOVERY_TOPIC,
    DISCOVERY_TYPE,
    DISTRIBUTIONS,
    ENCLAVE,
    discovery_definition,
    discovery_message,
)
from sonar_gl.ros.inbox import PATIENCE_S
from sonar_gl.ros.rmw_zenoh import RosNode
from sonar_gl.ros.transport import Topic, Transport, check_process, check_same_type, ros_domain

logger = logging.getLogger(__name__)

LOOPBACK = "127.0.0.1"
LOOPBACK_NAMES = "lo", "lo0"
# Participants of one machine take the ports of an index, and are looked for at those of all indices; 32 as in ROS 2's
# own configuration for the range LOCALHOST.
MAX_INDEX = 32
TAKEN_AT_ONCE = 64
PAUSE_S = 0.1  # after a failure to receive
# Of all transports of a process: the first topic of a type completes the type, and one that is made meanwhile may be
# refused by Cyclone DDS without a reason (https://github.com/eclipse-cyclonedds/cyclonedds-python/issues/214).
_making_topic = threading.Lock()
LITTLE_ENDIAN = b"\x00\x01"  # of a message in XCDR1


def _libraries() -> SimpleNamespace:
    """Return the modules that DDS needs, loaded on first use, or raise an Error."""
    try:
        import cyclonedds.core
        import cyclonedds.domain
        import cyclonedds.idl
        import cyclonedds.idl.types
        import cyclonedds.pub
        import cyclonedds.sub
        import cyclonedds.topic
        import cyclonedds.util
        import rosbags.interfaces
        import rosbags.typesys
    except ImportError as why:
        wheels = "cyclonedds has wheels for Python 3.10 to 3.13, and none for Linux on ARM"
        needs = f"DDS needs cyclonedds and rosbags (got no module {why.name}; {wheels})"
        raise missing_extra("live", needs) from None
    return SimpleNamespace(
        core=cyclonedds.core,
        domain=cyclonedds.domain,
        idl=cyclonedds.idl,
        types=cyclonedds.idl.types,
        pub=cyclonedds.pub,
        sub=cyclonedds.sub,
        topic=cyclonedds.topic,
        duration=cyclonedds.util.duration,
        nodetype=rosbags.interfaces.Nodetype,
        read_definition=rosbags.typesys.get_types_from_msg,
    )


class DdsTransport(Transport):
    """Carries messages over DDS, as nodes of ROS 2 do with Fast DDS or Cyclone DDS.

    Parameters
    ----------
    domain : 0..232; None is the environment variable ROS_DOMAIN_ID, or 0, as for nodes of ROS 2
    interface : address or name of the network interface to use, such as "eth0"; None leaves the choice to Cyclone DDS
        and its environment variable CYCLONEDDS_URI. Any but the loopback interface is a warning, since whoever reaches
        it can read and send messages
    node : name by which `ros2 node list` shows this program
    distribution : of the ROS 2 that lists nodes: "jazzy", also for Iron and later, or "humble", whose message about
        nodes has another layout

    Raises
    ------
    Error
        if a parameter is wrong, there is no such interface, all places of a machine are taken, or a package is missing.

    Notes
    -----
    Nodes are found by multicast and at the well-known ports of 127.0.0.1, since `lo` of Linux is not marked as
    capable of multicast, and since nodes with ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST listen only there.
    All transports of a process on one domain share one interface.
    """

    def __init__(
        self,
        domain: int | None = None,
        interface: str | None = LOOPBACK,
        node: str = "sonar_gl",
        distribution: str = "jazzy",
    ):
        self.domain, self._process = ros_domain(domain), os.getpid()
        RosNode(node)  # checks the name
        check_choice("distribution", distribution, DISTRIBUTIONS)
        self._node, self._distribution = node, distribution
        self.interface = interface
        self._dds = dds = _libraries()
        self._lock = threading.Lock()  # of the two tables
        self._topics, self._writers = {}, {}  # of the first, by name: the Topic, and the topic of DDS
        self._reader_guids = {}  # by the number of the receiver
        self._opened = None if interface is None else _open_domain(self.domain, interface)
        try:
            enclave = dds.core.Qos(dds.core.Policy.Userdata(data=ENCLAVE))
            self._participant = dds.domain.DomainParticipant(self.domain, qos=enclave)
            self._publisher = dds.pub.Publisher(self._participant)
            self._announcer = self._make_announcer()
            self._receiver = _Receiver(dds, self._participant)
            # its thread must end before Cyclone DDS does, also where nobody closes this
            self._end_receiver = weakref.finalize(self, self._receiver.close)
            self._announce()
        except dds.core.DDSException as why:
            raise Error(f"DDS domain {self.domain} does not open: {_reason(why)}") from None
        if interface is None or not _is_loopback(interface):
            through = "the interface that Cyclone DDS chooses" if interface is None else interface
            logger.warning(
                "DDS domain %d is open to the network through %s: who reaches it can read and send messages",
                self.domain,
                through,
            )

    def advertise(self, topic: Topic) -> None:
        """Make a topic known; raise Error if DDS cannot carry its type, its name has another, or this is closed."""
        self._writer(topic)

    def publish(self, topic: Topic, message: bytes, time_ns: int) -> None:
        """Send a message without waiting for readers; the oldest of more than `depth` that wait for one is dropped.

        DDS stamps messages by the clock, not by `time_ns`. Raises Error as `advertise` does, or if the message does not
        have the layout of its type.
        """
        writer = self._writer(topic)
        try:
            writer.write(writer.data_type(message))
        except self._dds.core.DDSException as why:
            raise Error(
                f"a message of {topic.name!r} must be a {topic.msgtype} in CDR "
                f"(Cyclone DDS refuses it: {_reason(why)})"
            ) from None

    def subscribe(self, topic: Topic, receive: Callable[[bytes], None]) -> Callable[[], None]:
        """Call `receive` with each message of other participants, in a thread of the transport.

        Messages that do not have the layout of the type do not arrive. Up to three bytes that only fill the last word
        may follow a message. What `receive` raises is logged, once for the topic. Raises Error as `advertise` does.
        """
        dds = self._dds
        check_process(self._process, "DdsTransport")
        with self._lock:
            dds_topic = self._topic(topic)
            try:
                reader = dds.sub.DataReader(
                    self._receiver.subscriber, dds_topic, qos=_qos(dds, topic, topic.depth)
                )
            except dds.core.DDSException as why:
                raise Error(f"DDS topic {topic.name!r} cannot be read: {_reason(why)}") from None
            number = self._receiver.add(topic.name, reader, receive)
            self._reader_guids[number] = reader.guid.bytes
            self._announce()
            return partial(self._withdraw, number)

    def close(self) -> None:
        """Withdraw the topics and leave the domain; messages that are on their way may be lost."""
        if os.getpid() != self._process:  # of a fork: all is the parent's
            return
        # not under the lock, which a function that receives a message may need to end
        self._end_receiver()
        with self._lock:
            if self._participant is None:
                return
            # Cyclone DDS deletes what nothing refers to any more: what depends on the participant goes first
            self._writers, self._topics, self._announcer = {}, {}, None
            self._receiver = self._publisher = self._participant = self._opened = None

    def _withdraw(self, number: int) -> None:
        """End a subscription, if it has not ended yet."""
        with self._lock:
            if self._receiver is not None:
                self._receiver.remove(number)
                if self._reader_guids.pop(number, None) is not None:
                    self._announce()

    def _make_announcer(self):
        """Return the writer of the topic by which nodes of ROS 2 know of one another."""
        dds, definition = self._dds, discovery_definition(self._distribution)
        topic = Topic(DISCOVERY_TOPIC, DISCOVERY_TYPE, "", definition, latched=True)
        with _making_topic:
            data_type = _data_type(DISCOVERY_TYPE, definition)
            made = dds.topic.Topic(self._participant, DISCOVERY_TOPIC, data_type)
        return dds.pub.DataWriter(self._publisher, made, qos=_qos(dds, topic, 1))

    def _announce(self) -> None:
        """Tell nodes of ROS 2 which readers and writers this one has; the lock is held, or nobody else is there yet."""
        writers = [writer.guid.bytes for writer in self._writers.values()]
        readers = self._reader_guids.values()
        participant = self._participant.guid.bytes
        message = discovery_message(self._distribution, self._node, participant, readers, writers)
        self._announcer.write(self._announcer.data_type(message))

    def _writer(self, topic: Topic):
        dds = self._dds
        check_process(self._process, "DdsTransport")
        with self._lock:
            writer = self._writers.get(topic)
            if writer is None:
                dds_topic = self._topic(topic)
                try:
                    depth = 1 if topic.latched else topic.depth
                    writer = dds.pub.DataWriter(self._publisher, dds_topic, qos=_qos(dds, topic, depth))
                except dds.core.DDSException as why:
                    raise Error(f"DDS topic {topic.name!r} cannot be written: {_reason(why)}") from None
                self._writers[topic] = writer
                self._announce()
            return writer

    def _topic(self, topic: Topic):
        """Return the topic of DDS, made on first use; the lock is held."""
        dds = self._dds
        if self._participant is None:
            raise Error(f"the DDS transport must be open to carry {topic.name!r} (it was closed)")
        with _making_topic:
            data_type = _data_type(topic.msgtype, topic.definition)
            if topic.name in self._topics:
                known, made = self._topics[topic.name]
                check_same_type(topic, known)
                return made
            try:
                made = dds.topic.Topic(self._participant, f"rt/{topic.name.removeprefix('/')}", data_type)
            except dds.core.DDSException as why:
                raise Error(
                    f"{topic.name!r} must be a name that DDS allows, with a type that no other topic of that name "
                    f"has (Cyclone DDS refuses it: {_reason(why)})"
                ) from None
        self._topics[topic.name] = topic, made
        return made


def _reason(why: Exception) -> str:
    """Return what an exception of Cyclone DDS says, without its place in the code."""
    return str(why).partition("] ")[2].partition(". ")[0].rstrip(".").lower() or str(why)


# ---- domains ----------------------------------------------------------------------------------------


class _OpenDomain:
    """A domain that this process has configured."""

    def __init__(self, interface: str, configuration: str, entity):
        self.interface, self.configuration, self.entity = interface, configuration, entity


# of this process, while a transport uses them
_domains: weakref.WeakValueDictionary[int, _OpenDomain] = weakref.WeakValueDictionary()
_domains_lock = threading.Lock()


def _is_loopback(interface: str) -> bool:
    return interface in LOOPBACK_NAMES or is_local(interface)


def _open_domain(domain: int, interface: str) -> _OpenDomain:
    """Configure a domain in this process; whoever has it open already shares it."""
    dds = _libraries()
    configuration = _configuration(interface)
    with _domains_lock:
        opened = _domains.get(domain)
        if opened is not None:
            if opened.configuration != configuration:
                raise Error(
                    f"a process must use one interface for a DDS domain (got {interface!r} for domain {domain}, "
                    f"which is open through {opened.interface!r})"
                )
            return opened
        try:
            opened = _OpenDomain(interface, configuration, dds.domain.Domain(domain, configuration))
        except dds.core.DDSException as why:
            if why.code == why.DDS_RETCODE_PRECONDITION_NOT_MET:
                raise Error(
                    f"DDS domain {domain} must not be open in this process already (other code has opened it; take "
                    f"another domain, or interface=None to share it)"
                ) from None
            raise Error(
                f"the interface of DDS must be the name or the address of one of this machine (got {interface!r} for "
                f"domain {domain}: {_reason(why)})"
            ) from None
        _domains[domain] = opened
        return opened


def _configuration(interface: str) -> str:
    """Return the configuration of Cyclone DDS for an interface.

    See https://cyclonedds.io/docs/cyclonedds/latest/config/config_file_reference.html
    """
    if not isinstance(interface, str) or not re.fullmatch(r"[A-Za-z0-9_.:-]+", interface):
        raise Error(f"the interface of DDS must be a name or an address, such as 'eth0' (got {interface!r})")
    discovery = ""
    if _is_loopback(interface):
        key, value = "address", LOOPBACK
        discovery = f"""<Discovery>
            <ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>{MAX_INDEX}</MaxAutoParticipantIndex>
            <Peers><Peer address="{LOOPBACK}"/></Peers>
        </Discovery>"""
    else:
        key, value = "name", interface
        with suppress(ValueError):
            key, value = "address", str(ipaddress.ip_address(interface))
    return f"""<CycloneDDS><Domain>
        <General><Interfaces><NetworkInterface {key}="{value}"/></Interfaces></General>
        {discovery}
    </Domain></CycloneDDS>"""


# ---- quality of service and types -------------------------------------------------------------------


def _qos(dds: SimpleNamespace, topic: Topic, depth: int):
    """Return the quality of service of a topic's writer or reader, as ROS 2 nodes set it.

    depth : number of messages that are kept; those of a reader are of all writers together
    """
    policy = dds.core.Policy
    return dds.core.Qos(
        policy.Reliability.Reliable(0) if topic.reliable else policy.Reliability.BestEffort,
        policy.Durability.TransientLocal if topic.latched else policy.Durability.Volatile,
        # such a writer drops its oldest message rather than wait for slow readers
        policy.History.KeepLast(depth),
        # XCDR1 alone: readers of ROS 2 know no other
        policy.DataRepresentation(use_cdrv0_representation=True, use_xcdrv2_representation=False),
        *([policy.Userdata(data=f"typehash={topic.type_hash};".encode())] if topic.type_hash else []),
        policy.WriterDataLifecycle(autodispose=False),  # a message outlives its publisher, as in ROS 2
        policy.IgnoreLocal.Participant,
    )


@cache
def _data_type(msgtype: str, definition: str) -> type:
    """Return the type of Cyclone DDS whose samples are the bytes of messages.

    msgtype : such as "sensor_msgs/msg/Image"
    definition : fields of it, and of the types in it, in ROS's language
    """
    dds = _libraries()
    try:
        fields = dds.read_definition(definition, msgtype)
        data_type = _IdlTypes(dds, fields).struct(msgtype)
    except Exception as why:  # rosbags and Cyclone DDS raise what they like
        understood = f"its definition is not understood ({why})"
        raise Error(f"DDS cannot carry the type {msgtype!r}: {understood}") from None
    data_type.__init__ = lambda sample, message: setattr(sample, "message", message)
    data_type.serialize = lambda sample, **_: sample.message
    data_type.deserialize = data_type.deserialize_key = classmethod(lambda made, message, **_: made(message))
    return data_type


class _IdlTypes:
    """Makes types of Cyclone DDS from fields as rosbags reads them."""

    def __init__(self, dds: SimpleNamespace, fields: dict):
        self._dds, self._fields, self._structs = dds, fields, {}

    def struct(self, msgtype: str) -> type:
        """Return the type of a message, such as "std_msgs/msg/Header"."""
        if msgtype not in self._structs:
            package, kind, name = msgtype.split("/")
            fields = {field: self._field(*what) for field, what in self._fields[msgtype][1]}
            self._structs[msgtype] = self._dds.idl.make_idl_struct(
                f"{name}_", f"{package}::{kind}::dds_::{name}_", fields, dataclassify=False
            )
        return self._structs[msgtype]

    def _field(self, node, what):
        nodetype, types = self._dds.nodetype, self._dds.types
        if node == nodetype.NAME:
            return self.struct(what)
        if node == nodetype.BASE:
            name, bound = what
            if name == "string":
                return types.bounded_str[bound] if bound else str
            return {"bool": bool, "char": types.uint8}.get(name) or getattr(types, name)
        element, length = self._field(*what[0]), what[1]
        if node == nodetype.ARRAY:
            return types.array[element, length]
        return types.sequence[element, length] if length else types.sequence[element]


# ---- receiving --------------------------------------------------------------------------------------


class _Receiver:
    """A thread that gives the messages of readers to the functions that wait for them."""

    def __init__(self, dds: SimpleNamespace, participant):
        core = dds.core
        self.subscriber = dds.sub.Subscriber(participant)
        self._dds = dds
        self._stop = core.GuardCondition(participant)
        self._waiting = core.WaitSet(participant)
        self._waiting.attach(self._stop)
        self._readers = {}  # by number: name of the topic, reader, condition, function
        self._numbers = count()
        self._failed = set()  # names of topics whose function has raised, and None where DDS has
        self._is_closed, self._process = False, os.getpid()
        self._thread = threading.Thread(target=self._run, name="DDS messages", daemon=True)
        self._thread.start()

    def add(self, name: str, reader, receive: Callable[[bytes], None]) -> int:
        """Give the messages of a reader to a function from now on; return its number."""
        core = self._dds.core
        mask = core.SampleState.Any | core.ViewState.Any | core.InstanceState.Any
        condition = core.ReadCondition(reader, mask)
        number = next(self._numbers)
        self._readers[number] = name, reader, condition, receive
        self._waiting.attach(condition)
        return number

    def remove(self, number: int) -> None:
        if number in self._readers:
            _, _, condition, _ = self._readers.pop(number)
            self._waiting.detach(condition)

    def close(self) -> None:
        """End the thread, and let the readers go; a function that receives messages may call this, too."""
        self._is_closed = True
        if os.getpid() != self._process:  # of a fork, at its end, too: the thread is the parent's
            return
        self._stop.set(True)
        if threading.current_thread() is not self._thread:
            self._thread.join(PATIENCE_S)
        for _, _, condition, _ in self._readers.values():
            self._waiting.detach(condition)
        self._readers.clear()

    def _run(self) -> None:
        forever = self._dds.duration(infinite=True)
        while not self._is_closed:
            self._attempt(self._waiting.wait, forever)
            for number in list(self._readers):
                self._attempt(self._take, number)

    def _attempt(self, act: Callable, argument) -> None:
        """Do what DDS may fail at; the next attempt may succeed, and that of another reader."""
        try:
            act(argument)
        except Exception:
            if not self._is_closed:
                self._log_once(None, "messages of DDS cannot be taken; they are waited for again")
                time.sleep(PAUSE_S)

    def _take(self, number: int) -> None:
        """Give what a reader has received to its function, unless it was let go meanwhile."""
        if self._is_closed or (found := self._readers.get(number)) is None:
            return
        name, reader, condition, receive = found
        for sample in reader.take(TAKEN_AT_ONCE, condition):
            # a sample without data tells that a writer is gone
            is_message = sample.sample_info.valid_data and sample.message[:2] == LITTLE_ENDIAN
            if not is_message or self._is_closed or number not in self._readers:
                continue
            try:
                receive(sample.message)
            except Exception:
                self._log_once(name, "a message of %r is lost: the function that receives it fails", name)

    def _log_once(self, kind: str | None, *message) -> None:
        if kind not in self._failed:
            self._failed.add(kind)
            logger.exception(*message)
