"""TCP ports at which this process listens (Linux)."""

from __future__ import annotations

import os
from pathlib import Path

LISTENING = "0A"  # state of a socket in /proc/net/tcp


def listening_ports() -> set[tuple[str, int]]:
    """Return the addresses, as /proc shows them, and the ports at which this process listens."""
    sockets = set()
    for link in Path("/proc/self/fd").iterdir():
        try:
            sockets.add(os.readlink(link))
        except OSError:  # closed since
            continue
    found = set()
    for name in ("tcp", "tcp6"):
        table = Path("/proc/self/net", name)
        for line in table.read_text().splitlines()[1:] if table.exists() else ():
            fields = line.split()
            if fields[3] == LISTENING and f"socket:[{fields[9]}]" in sockets:
                address, _, port = fields[1].rpartition(":")
                found.add((address, int(port, 16)))
    return found


LOOPBACK = "0100007F"  # 127.0.0.1 in /proc/net/tcp of a little-endian machine
