"""A program of its own that reads a topic by zenoh as rmw_zenoh does, and prints what comes as lines of JSON.

python -m tests.support.zenoh_reader ADDRESS KEY COUNT [latched]

It prints "ready" once it has subscribed, "connected" when it receives PROBE, which does not count, and then COUNT
messages. It knows nothing of sonar_gl's transports.
"""

from __future__ import annotations

import json
import select
import subprocess
import sys
import threading
from collections.abc import Callable
from contextlib import contextmanager
from pathlib import Path

import zenoh
import zenoh.ext

from tests.support.live_messages import open_session
from tests.support.waiting import WAIT_S, wait_until

ROOT = Path(__file__).resolve().parents[2]
PROBE = b"probe"


def main(address: str, key: str, count: str, latched: str = ""):
    """Print the key, the payload and the attachment of so many messages."""
    lines, connected, done = [], threading.Event(), threading.Event()

    def note(sample):
        payload, attached = sample.payload.to_bytes(), sample.attachment
        if payload == PROBE:
            if not connected.is_set():
                connected.set()
                print("connected", flush=True)
            return
        attached = attached and attached.to_bytes().hex()
        lines.append({"key": str(sample.key_expr), "payload": payload.hex(), "attachment": attached})
        if len(lines) >= int(count):
            done.set()

    history = {}
    if latched:
        history["history"] = zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=1)
    with open_session("peer", [address], ["tcp/127.0.0.1:0"]) as session:
        _subscriber = zenoh.ext.declare_advanced_subscriber(session, key, note, **history)
        print("ready", flush=True)
        done.wait(WAIT_S)
    for line in lines:
        print(json.dumps(line))


class Reading:
    """The program while it runs."""

    def __init__(self, child: subprocess.Popen):
        self._child = child

    def connect(self, publish: Callable[[bytes], None]) -> int:
        """Publish probes until one arrives; return how many were published."""
        probes = 0

        def is_connected():
            nonlocal probes
            publish(PROBE)
            probes += 1
            return bool(select.select([self._child.stdout], [], [], 0.05)[0])

        wait_until(is_connected)
        assert self._child.stdout.readline() == "connected\n"
        return probes

    def messages(self) -> list[dict]:
        """Return what it has printed of the messages, once it has them all."""
        return [json.loads(line) for line in self._child.communicate(timeout=WAIT_S)[0].splitlines()]


@contextmanager
def reading(address: str, key: str, count: int, *more: str):
    """Run this program beside a block."""
    command = [sys.executable, "-m", "tests.support.zenoh_reader", address, key, str(count), *more]
    child = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=ROOT)
    try:
        assert child.stdout.readline() == "ready\n"
        yield Reading(child)
    finally:
        child.kill()
        child.communicate()


if __name__ == "__main__":
    main(*sys.argv[1:])
