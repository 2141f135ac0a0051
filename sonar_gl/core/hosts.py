"""Addresses at which programs of this machine alone can be reached, and ports that are given back."""

from __future__ import annotations

import errno
import ipaddress
import socket
import time

OFTEN_S = 0.001  # between looks at a port


def is_local(host: str) -> bool:
    """Return whether an address is one of this machine's loopback interface, which no other machine reaches.

    >>> is_local("127.0.0.1"), is_local("localhost"), is_local("::1"), is_local("0.0.0.0")
    (True, True, True, False)
    """
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host.lower() == "localhost"


def wait_until_free(host: str, port: int, limit_s: float) -> bool:
    """Wait until nobody listens at a TCP port of this machine; return False if somebody still does after `limit_s`."""
    end_s = time.monotonic() + limit_s
    while not _is_free(host, port):
        if time.monotonic() >= end_s:
            return False
        time.sleep(OFTEN_S)
    return True


def _is_free(host: str, port: int) -> bool:
    """Return whether no address of a name has a port in use; one at which nobody can listen is not in use."""
    try:
        addresses = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
    except OSError:
        return True
    for family, kind, protocol, _, address in addresses:
        try:
            with socket.socket(family, kind, protocol) as probe:
                # as servers have it: connections that have ended do not keep the port
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                probe.bind(address)
        except OSError as why:
            if why.errno == errno.EADDRINUSE:
                return False
    return True
