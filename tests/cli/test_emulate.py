"""The command `emulate`."""

import os
import re
import signal
import socket
import struct
import threading

import pytest

from sonar_gl.cli import emulate
from sonar_gl.live.emulators import oculus
from sonar_gl.live.emulators.simulated_head import SimulatedHead
from tests.support.command_line import run
from tests.support.commands_beside import run_beside
from tests.support.waiting import WAIT_S

KINDS = {"oculus": socket.SOCK_STREAM, "ping360": socket.SOCK_DGRAM}
# the first ping, which is made before all else, is a quick one
PYLON = "pylon", "--profile", "ideal", "--noise", "none", "--tolerance", "0.2"


@pytest.fixture
def servers(monkeypatch):
    """A list of the servers that listen."""
    listen, found = emulate.listen, []

    async def noted(server, describe):
        found.append(server)
        await listen(server, describe)

    monkeypatch.setattr(emulate, "listen", noted)
    return found


@pytest.mark.parametrize("device", KINDS)
def test_a_port_that_is_taken_is_an_error_and_nothing_is_said_to_listen(device):
    with socket.socket(socket.AF_INET, KINDS[device]) as other:
        other.bind(("127.0.0.1", 0))
        if KINDS[device] == socket.SOCK_STREAM:
            other.listen()
        port = str(other.getsockname()[1])
        status, _, errors = run("emulate", device, *PYLON, "--port", port, "--duration", "20")
    assert status == 2
    assert "(got Address already in use; is another program using the port? --port chooses another)" in errors
    assert "Ctrl-C stops it" not in errors


@pytest.mark.parametrize("device", KINDS)
def test_a_ping_is_made_before_programs_can_connect(device, monkeypatch):
    """Noise is compiled by the first ping, for a minute after an installation: clients gave up before."""
    pings, listening = [], []

    def ping(head, sonar, acoustics, time_s, number):
        pings.append((sonar.name, head.track.at(time_s).shape, len(listening)))

    async def listen(server, describe):
        listening.append(describe())

    monkeypatch.setattr(SimulatedHead, "ping", ping)
    monkeypatch.setattr(emulate, "listen", listen)
    status, _, _ = run("emulate", device, *PYLON, "--port", "0")
    assert status == 0 and len(listening) == 1
    assert pings == [({"oculus": "oculus-m1200d-hf", "ping360": "ping360"}[device], (4, 4), 0)]


@pytest.mark.parametrize(
    ("device", "name", "text", "changes"),
    [
        ("oculus", "OculusHead", "gain_percentile=90", {"gain_percentile": 90}),
        ("ping360", "Ping360Head", "law=db,low_db=-40", {"law": "db", "low_db": -40}),
        pytest.param("ping360", "Ping360Head", "exponent=0.5", {"exponent": 0.5}, marks=pytest.mark.slow),
    ],
)
def test_counts_change_what_programs_do_not_set(device, name, text, changes, monkeypatch):
    make, given = getattr(emulate, name), []

    def noted(*arguments):
        given.append(arguments[-1])
        return make(*arguments)

    monkeypatch.setattr(emulate, name, noted)
    status, _, errors = run("emulate", device, *PYLON, "--port", "0", "--duration", "0.1", "--counts", text)
    assert status == 0, errors
    assert given == [changes]


@pytest.mark.parametrize(
    ("device", "text", "sentence"),
    [
        ("oculus", "gain_db=20", "--counts of this device may change gain_percentile alone (got gain_db;"),
        ("ping360", "bits=16", "--counts of this device may change law, exponent, low_db, high_db alone"),
        ("oculus", "gain_percentile=200", "gain_percentile must lie in 0..100 (got 200)"),
        ("ping360", "gamma=3", "counts 'gamma=3': unknown name (got 'gamma'"),
    ],
)
def test_counts_that_programs_set_are_refused(device, text, sentence):
    status, _, errors = run("emulate", device, *PYLON, "--port", "0", "--duration", "0.1", "--counts", text)
    assert status == 2 and sentence in errors


@pytest.mark.parametrize("device", KINDS)
def test_a_device_that_listens_says_so_once(device):
    status, _, errors = run("emulate", device, *PYLON, "--port", "0", "--duration", "0.1")
    assert status == 0
    assert errors.count("Ctrl-C stops it") == 1


@pytest.mark.parametrize("device", KINDS)
def test_port_0_is_told_as_the_port_that_the_system_chose(device, servers):
    status, _, errors = run("emulate", device, *PYLON, "--port", "0", "--duration", "0.1")
    assert status == 0 and servers[0].port != 0
    assert f" at 127.0.0.1:{servers[0].port}" in errors


@pytest.mark.parametrize("device", KINDS)
def test_ctrl_c_before_it_listens_ends_it(device, monkeypatch):
    """The first ping may compile for some minutes."""

    def interrupt(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(SimulatedHead, "ping", interrupt)
    status, _, errors = run("emulate", device, *PYLON, "--port", "0")
    assert status == 130 and "Traceback" not in errors


def fire_at(server):
    """Connect a program to an Oculus, and have it ping; return the connection."""
    program = socket.create_connection(("127.0.0.1", server.port), WAIT_S)
    settings = struct.pack("<5B4d", 2, 2, 255, 127, 25, 3.0, 50.0, 0.0, 0.0)
    program.sendall(struct.pack("<HHHHHIH", 0x4F53, 0, 0, 0x15, 1, len(settings), 0) + settings)
    return program


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_an_oculus_with_its_closing_line_alone_while_programs_listen(number, servers, caplog):
    programs = []

    def work():
        programs.append(fire_at(servers[0]))
        assert len(programs[0].recv(16)) == 16

    printed, _ = run_beside(["emulate", "oculus", *PYLON, "--port", "0"], work, WAIT_S, number)
    programs[0].close()
    assert printed.splitlines()[-1].endswith("; 0 wrong fire messages ignored")
    assert [record.message for record in caplog.records if record.name == "asyncio"] == []


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_while_a_result_is_packed_ends_it_as_any_other(number, servers, caplog, monkeypatch):
    """Raised within a task it would leave the others to themselves."""
    programs, message = [], oculus.OculusResult.message

    def interrupted(result, device_id):
        os.kill(os.getpid(), number)
        return message(result, device_id)

    monkeypatch.setattr(oculus.OculusResult, "message", interrupted)
    listen = emulate.listen

    async def fired(server, describe):
        def described():
            programs.append(fire_at(server))
            return describe()

        await listen(server, described)

    monkeypatch.setattr(emulate, "listen", fired)
    status, printed, errors = run("emulate", "oculus", *PYLON, "--port", "0", "--duration", "60")
    programs[0].close()
    assert status == 0 and printed.splitlines()[-1].endswith("; 0 wrong fire messages ignored")
    assert "Traceback" not in errors
    assert [record.message for record in caplog.records if record.name == "asyncio"] == []


@pytest.mark.parametrize("device", KINDS)
@pytest.mark.parametrize("host", ["127.0.0.1", "localhost", "127.0.0.2", "0.0.0.0", "192.0.2.1"])
def test_an_address_that_other_machines_may_reach_is_warned_of(device, host, monkeypatch):
    """The last is for documentation; nobody listens at any, as the server is left out."""

    async def listen(server, describe):
        assert f"at {host}:" in describe()

    monkeypatch.setattr(SimulatedHead, "ping", lambda *_, **__: None)
    monkeypatch.setattr(emulate, "listen", listen)
    monkeypatch.setattr(emulate, "check_host", lambda *_: None)
    status, _, errors = run("emulate", device, *PYLON, "--port", "0", "--host", host)
    warning = f"warning: any machine that reaches {host} can use this sonar\n"
    is_reached = host in ("0.0.0.0", "192.0.2.1")
    assert status == 0 and errors == warning * is_reached


@pytest.mark.parametrize("device", KINDS)
@pytest.mark.parametrize(
    ("host", "reason"),
    [
        ("192.0.2.1", "Cannot assign requested address"),  # for documentation
        # messages of an Oculus have room for addresses of IPv4 alone; the devices know no others
        ("::1", "[A-Za-z ]+"),  # here and below the words are those of the system's resolver
        ("no.such.host.invalid", "[A-Za-z -]+"),
    ],
)
def test_a_host_that_nobody_can_listen_at_is_an_error_before_the_first_ping(
    device, host, reason, monkeypatch
):
    """Which may compile for some minutes; and it is no matter of the port."""
    monkeypatch.setattr(SimulatedHead, "ping", lambda *_, **__: pytest.fail("a ping"))
    status, _, errors = run("emulate", device, *PYLON, "--port", "0", "--host", host, "--duration", "5")
    sentence = (
        rf"error: the host must be an IPv4 address of this machine \(got '{re.escape(host)}': {reason}; "
        r"127\.0\.0\.1 is reached from this machine alone\)\n"
    )
    assert status == 2 and re.fullmatch(sentence, errors)
    assert "Unknown error" not in errors


@pytest.mark.slow
def test_a_status_that_cannot_be_sent_is_said_once(monkeypatch, caplog):
    """Names are looked up beside the thread that serves programs, which a slow answer would hold up."""
    monkeypatch.setattr(oculus, "STATUS_S", 0.01)
    look_up, threads = socket.getaddrinfo, set()

    def noted(host, *values, **more):
        if host == "no.such.host.invalid":
            threads.add(threading.current_thread())
        return look_up(host, *values, **more)

    monkeypatch.setattr(socket, "getaddrinfo", noted)
    words = "--status-to", "no.such.host.invalid", "--duration", "0.5"
    status, _, errors = run("emulate", "oculus", *PYLON, "--port", "0", *words)
    assert status == 0 and "Ctrl-C stops it" in errors
    assert threads and threading.main_thread() not in threads
    assert len(caplog.messages) == 1
    assert caplog.messages[0].startswith("no status reaches no.such.host.invalid:52102: ")


@pytest.mark.parametrize(
    ("device", "option"), [("oculus", "--host"), ("ping360", "--host"), ("oculus", "--status-to")]
)
def test_an_address_of_no_characters_is_refused(device, option):
    """Such a host is that of all networks for asyncio."""
    status, _, errors = run("emulate", device, *PYLON, "--port", "0", option, "", "--duration", "0.1")
    message = f"{option} must be an address (got an empty text; is a variable of the shell empty?)"
    assert (status, errors) == (2, f"error: {message}\n")
