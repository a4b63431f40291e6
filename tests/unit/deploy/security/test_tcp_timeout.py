"""Connections without acknowledgements are closed on both sides."""

import socket
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from sextant.deploy.security.tcp_timeout import TcpTimeout

_LIMIT_MS = 1500


def _limit_of(connection: socket.socket) -> int:
    return connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT)


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    with ExitStack() as held:
        yield held


def _listener(stack: ExitStack) -> socket.socket:
    return stack.enter_context(socket.create_server(("127.0.0.1", 0)))


def _descriptors() -> set[str]:
    return {path.name for path in Path("/proc/self/fd").iterdir()}


def test_timeout_applies_to_opened_and_accepted_connections(stack: ExitStack) -> None:
    listener, silence = _listener(stack), TcpTimeout(1e-3 * _LIMIT_MS)
    silence.look()
    opened = stack.enter_context(socket.create_connection(listener.getsockname()))
    accepted = stack.enter_context(listener.accept()[0])
    assert _limit_of(accepted) == _LIMIT_MS, "as the listening socket's"
    assert _limit_of(opened) == 0, "the kernel's own"
    silence.look()
    assert _limit_of(opened) == _LIMIT_MS


def test_timeout_applies_to_reused_descriptor(stack: ExitStack) -> None:
    listener, silence = _listener(stack), TcpTimeout(1e-3 * _LIMIT_MS)
    first = socket.create_connection(listener.getsockname())
    silence.look()
    number = first.fileno()
    first.close()
    second = stack.enter_context(socket.create_connection(listener.getsockname()))
    assert second.fileno() == number
    silence.look()
    assert _limit_of(second) == _LIMIT_MS


def test_non_tcp_sockets_are_unchanged_and_stay_open(stack: ExitStack) -> None:
    near, far = socket.socketpair()
    stack.enter_context(near)
    stack.enter_context(far)
    datagrams = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
    open_before = _descriptors()
    TcpTimeout(1e-3 * _LIMIT_MS).look()
    near.sendall(b"word")
    assert far.recv(4) == b"word"
    assert datagrams.getsockopt(socket.SOL_SOCKET, socket.SO_TYPE) == socket.SOCK_DGRAM
    assert _descriptors() == open_before


def test_closed_descriptor_is_ignored(stack: ExitStack, monkeypatch: pytest.MonkeyPatch) -> None:
    closed = _listener(stack).fileno() + 100
    assert str(closed) not in _descriptors()
    monkeypatch.setattr("sextant.deploy.security.tcp_timeout._open_sockets", lambda: {str(closed): "socket:[1]"})
    TcpTimeout(1.0).look()
