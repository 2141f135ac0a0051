"""Addresses of this machine: those that it alone reaches, those to listen at, and ports that are given back."""

from __future__ import annotations

import errno
import ipaddress
import socket
import time

from sonar_gl.core.errors import Error

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


def check_host(host: str, family: int = socket.AF_UNSPEC) -> None:
    """Raise Error unless one can listen at an address or a name, of any family of addresses or of IPv4 alone."""
    kind = "an IPv4 address" if family == socket.AF_INET else "an address"
    try:
        found, stream, protocol, _, address = socket.getaddrinfo(host, 0, family, socket.SOCK_STREAM)[0]
        with socket.socket(found, stream, protocol) as trial:
            trial.bind(address)
    except (OSError, UnicodeError) as why:
        raise Error(
            f"the host must be {kind} of this machine (got {host!r}: {getattr(why, 'strerror', None) or why}; "
            "127.0.0.1 is reached from this machine alone)"
        ) from None


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
