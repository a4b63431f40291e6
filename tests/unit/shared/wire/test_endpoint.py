"""Endpoints, and the reasons why one cannot be reached or used for listening."""

import errno
import socket

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sextant.shared.wire import endpoint
from sextant.shared.wire.endpoint import (
    cannot_connect,
    cannot_listen,
    fault,
    for_clients,
    obstacle,
    occupied,
    place,
    unknown_host,
)

AT = "tcp/robot.local:7447"


def test_endpoint_is_split_into_host_and_port() -> None:
    assert place("tls/robot.local:7448") == ("robot.local", 7448)
    assert place("tcp/[fe80::1]:7447?prio=1-3#so_sndbuf=1") == ("fe80::1", 7447)


@pytest.mark.parametrize("listen", ["tls/0.0.0.0:7448", "tls/[::]:7448"])
def test_clients_connect_to_the_name_of_a_machine_that_listens_at_all_addresses(listen: str) -> None:
    assert for_clients(listen) == f"tls/{socket.gethostname()}:7448"
    assert for_clients(AT) == AT


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("tcp/robot.local", "the port is missing: usually 7447 for tcp, 7448 for tls"),
        ("tls/10.0.0.7:", "the port is missing"),
        ("robot.local:7447", "PROTOCOL/HOST:PORT expected"),
        ("tcp/:7447", "PROTOCOL/HOST:PORT expected"),
        ("tcp/robot.local:74470", "PROTOCOL/HOST:PORT expected"),
        ("nonsense", "found 'nonsense'"),
        ("", "found ''"),
        ("tpc/robot.local:7447", "begins with 'tpc': tcp, or tls with certificates, expected"),
    ],
)
def test_invalid_endpoint_is_named(text: str, words: str) -> None:
    assert words in fault([AT, text])
    assert fault([AT]) == ""


@pytest.mark.slow
@given(st.text())
def test_any_text_is_parsed_or_refused(text: str) -> None:
    if not fault([text]):
        host, port = place(text)
        assert host
        assert 0 <= port < 1 << 16


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (
            socket.gaierror(socket.EAI_NONAME, "x"),
            "the host 'robot.local' is not known; check its name, or give its IP address",
        ),
        (ConnectionRefusedError(), "nothing listens on port 7447 of robot.local; is the robot up (`sextant up`)"),
        (TimeoutError(), "robot.local does not answer; is the robot on, on this network"),
        (OSError(errno.EHOSTUNREACH, "x"), "robot.local does not answer"),
        (OSError(errno.EPERM, "Operation not permitted"), "Operation not permitted; is the robot up"),
    ],
)
def test_each_connect_failure_has_its_sentence(error: OSError, words: str) -> None:
    assert f"{AT} cannot be reached: {words}" in cannot_connect(AT, error)


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (OSError(errno.EADDRINUSE, "x"), "another program has port 7447, perhaps another `sextant up`; end it"),
        (OSError(errno.EADDRNOTAVAIL, "x"), "this computer has no address robot.local"),
        (OSError(errno.EACCES, "x"), "ports below 1024 are for the administrator"),
        (OSError(errno.EPERM, "Operation not permitted"), "Operation not permitted; give another endpoint"),
        (socket.gaierror(socket.EAI_NONAME, "x"), "the host 'robot.local' is not known"),
    ],
)
def test_each_listen_failure_has_its_sentence(error: OSError, words: str) -> None:
    assert f"cannot listen on {AT}: {words}" in cannot_listen(AT, error)


def test_usable_endpoint_has_no_obstacle() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        here = f"tcp/127.0.0.1:{server.getsockname()[1]}"
        assert obstacle(here) == unknown_host(here) == ""
        assert "another program has port" in occupied(here)
    assert occupied(here) == ""
    assert "nothing listens on port" in obstacle(here)


def test_invalid_host_name_is_unknown() -> None:
    for host in ("a..b", "x" * 64):
        assert "is not known" in unknown_host(f"tcp/{host}:7447")
        assert "is not known" in obstacle(f"tcp/{host}:7447")
        assert "is not known" in occupied(f"tcp/{host}:7447")


def test_silent_host_is_distinguished_from_silent_program(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(endpoint, "_CONNECT_S", 0.05)
    with socket.socket() as full:  # its backlog is full, so a new connection gets no answer
        full.bind(("127.0.0.1", 0))
        full.listen(0)
        here = f"tls/127.0.0.1:{full.getsockname()[1]}"
        waiting = [socket.socket() for _ in range(4)]
        for one in waiting:
            one.setblocking(False)
            one.connect_ex(full.getsockname())
        assert "does not answer" in obstacle(here)
        for one in waiting:
            one.close()
