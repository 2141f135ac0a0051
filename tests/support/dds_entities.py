"""Readers and writers of Cyclone DDS with the types of `dds_types`, and what they need to meet ROS 2 nodes.

    python -m tests.support.dds_entities DOMAIN TOPIC TYPE COUNT SECONDS

reads messages in a process of its own. It prints "ready", then each message as JSON, until there are COUNT of them.
"""

from __future__ import annotations

import json
import sys
import time
from dataclasses import asdict

from cyclonedds.core import Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic

from tests.support.dds_types import TYPES

# what a user of rmw_cyclonedds sets in the environment variable CYCLONEDDS_URI: docs/ros2.md
LOOPBACK_URI = (
    "<CycloneDDS><Domain><General><Interfaces>"
    '<NetworkInterface name="lo"/>'
    "</Interfaces></General></Domain></CycloneDDS>"
)
WAIT_NS = 10_000_000_000


def qos(reliable: bool = True, latched: bool = False, depth: int = 100, xcdr2: bool = False):
    """Return the quality of service of a ROS 2 node; `xcdr2`: of a program that writes XCDR2 alone."""
    return Qos(
        Policy.Reliability.Reliable(WAIT_NS) if reliable else Policy.Reliability.BestEffort,
        Policy.Durability.TransientLocal if latched else Policy.Durability.Volatile,
        Policy.History.KeepLast(depth),
        Policy.DataRepresentation(use_cdrv0_representation=not xcdr2, use_xcdrv2_representation=xcdr2),
    )


def reader(participant, topic: str, msgtype: str, **policies):
    """Return a reader of the topic of DDS, such as "rt/sonar/image"."""
    return DataReader(participant, Topic(participant, topic, TYPES[msgtype]), qos=qos(**policies))


def writer(participant, topic: str, msgtype: str, **policies):
    """Return a writer of the topic of DDS."""
    return DataWriter(participant, Topic(participant, topic, TYPES[msgtype]), qos=qos(**policies))


def take(reading) -> list:
    """Return the messages that have come, without notes on writers that are gone."""
    return [sample for sample in reading.take(100) if sample.sample_info.valid_data]


def main(domain: str, topic: str, msgtype: str, count: str, seconds: str) -> None:
    """Read messages, and print them."""
    reading = reader(DomainParticipant(int(domain)), topic, msgtype)
    print("ready", flush=True)
    received, end_s = 0, time.monotonic() + float(seconds)
    while received < int(count) and time.monotonic() < end_s:
        for message in take(reading):
            print(json.dumps(asdict(message), default=list), flush=True)
            received += 1
        time.sleep(0.005)


if __name__ == "__main__":
    main(*sys.argv[1:])
