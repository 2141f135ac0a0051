"""Addresses of this machine alone, and ports that are given back."""

import re
import socket
import threading
import time

import pytest

from sonar_gl.core.errors import Error
from sonar_gl.core.hosts import check_host, is_local, wait_until_free


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


@pytest.mark.parametrize("host", ["127.0.0.1", "127.0.0.2", "localhost", "0.0.0.0"])
@pytest.mark.parametrize("family", [socket.AF_UNSPEC, socket.AF_INET])
def test_one_can_listen_at_addresses_of_this_machine(host, family):
    check_host(host, family)


@pytest.mark.parametrize(
    ("host", "family", "words"),
    [
        ("192.0.2.1", socket.AF_UNSPEC, "an address of this machine (got '192.0.2.1': Cannot assign"),
        ("192.0.2.1", socket.AF_INET, "an IPv4 address of this machine (got '192.0.2.1': Cannot assign"),
        ("::1", socket.AF_INET, "an IPv4 address of this machine (got '::1': "),
        (
            "no.such.host.invalid",
            socket.AF_INET,
            "an IPv4 address of this machine (got 'no.such.host.invalid': ",
        ),
        ("x" * 64, socket.AF_INET, "an IPv4 address of this machine (got 'xx"),  # longer than a label may be
    ],
)
def test_one_cannot_listen_at_others(host, family, words):
    with pytest.raises(Error, match=re.escape(f"the host must be {words}")):
        check_host(host, family)


@pytest.mark.parametrize("host", [pytest.param("127.0.0.1", marks=pytest.mark.slow), "localhost"])
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
