"""Addresses of this machine alone, and ports that are given back."""

import socket
import threading
import time

import pytest

from sonar_gl.core.hosts import is_local, wait_until_free


@pytest.mark.parametrize(
    "host", ["127.0.0.1", "127.0.0.2", "127.255.255.254", "localhost", "LocalHost", "::1"]
)
def test_addresses_of_the_loopback_interface_are_local(host):
    assert is_local(host)


@pytest.mark.parametrize(
    "host", ["0.0.0.0", "::", "", "192.0.2.1", "128.0.0.1", "127.0.0.1.example.org", "localhost.example.org"]
)
def test_others_are_not(host):
    assert not is_local(host)


@pytest.mark.parametrize("host", ["127.0.0.1", "localhost"])
def test_a_port_is_free_once_nobody_listens(host):
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        assert not wait_until_free(host, port, 0.05)
        began_s = time.monotonic()
        threading.Timer(0.2, server.close).start()
        assert wait_until_free(host, port, 60.0)
        assert time.monotonic() - began_s >= 0.2
    assert wait_until_free(host, port, 0.0)


def test_connections_that_are_open_do_not_keep_a_port():
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        with socket.create_connection(("127.0.0.1", port)), server.accept()[0]:
            server.close()
            assert wait_until_free("127.0.0.1", port, 0.0)


def test_a_name_without_addresses_and_an_address_of_no_interface_are_not_waited_for():
    for host in ("no.such.host.invalid", "192.0.2.1"):  # RFC 2606, RFC 5737
        assert wait_until_free(host, 8765, 0.0)


def test_every_address_of_a_name_counts(monkeypatch):
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        here, other = (
            socket.getaddrinfo(host, port, type=socket.SOCK_STREAM) for host in ("127.0.0.1", "127.0.0.2")
        )
        monkeypatch.setattr(socket, "getaddrinfo", lambda *_, **__: other + here)
        assert not wait_until_free("two", port, 0.0)
