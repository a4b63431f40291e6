"""The servo bus tap over local sockets: it forwards all bytes and reports them."""

import contextlib
import queue
import socket
import threading
from collections.abc import Iterator

import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.faults import bus_sniffer
from benchmarks.faults.bus_sniffer import Opened, Sent

_WAIT_S = 10.0


@contextlib.contextmanager
def running_sniffer() -> Iterator[tuple[int, socket.socket, "queue.Queue[Opened | Sent]"]]:
    """Yield a tap's port, the listener in place of the servos, and the tap's reports."""
    said: queue.Queue[Opened | Sent] = queue.Queue()
    with socket.create_server(("127.0.0.1", 0)) as servos, socket.create_server(("127.0.0.1", 0)) as listener:
        servos.settimeout(_WAIT_S)
        serving = threading.Thread(target=bus_sniffer.serve, args=(listener, servos.getsockname()[1], said.put), daemon=True)
        serving.start()
        yield listener.getsockname()[1], servos, said
        listener.shutdown(socket.SHUT_RDWR)
        serving.join(_WAIT_S)
        assert not serving.is_alive()


def dial(port: int) -> socket.socket:
    return socket.create_connection(("127.0.0.1", port), timeout=_WAIT_S)


def test_sniffer_forwards_both_ways_and_reports_host_bytes() -> None:
    with running_sniffer() as (port, servos, said), dial(port) as host:
        bus, _ = servos.accept()
        with bus:
            host.sendall(b"\xff\xff\x01")
            assert bus.recv(10) == b"\xff\xff\x01"
            bus.sendall(b"answer")
            assert host.recv(10) == b"answer"
            opened, sent = said.get(timeout=_WAIT_S), said.get(timeout=_WAIT_S)
            assert isinstance(opened, Opened)
            assert isinstance(sent, Sent)
            assert sent.data == b"\xff\xff\x01"
            assert 0 < opened.at_ns <= sent.at_ns
            assert said.empty(), "the servos' answers are not logged"


def test_host_disconnect_closes_bus_and_next_host_is_served() -> None:
    with running_sniffer() as (port, servos, said):
        for data in (b"one", b"two"):
            with dial(port) as host:
                host.sendall(data)
                bus, _ = servos.accept()
                assert bus.recv(10) == data
            with bus:
                assert bus.recv(10) == b"", "the servos see the host go"
        assert [type(said.get(timeout=_WAIT_S)) for _ in range(4)] == [Opened, Sent, Opened, Sent]


def test_host_is_disconnected_without_servos() -> None:
    with running_sniffer() as (port, servos, _):
        servos.close()
        with dial(port) as host:
            assert host.recv(10) == b""


@given(st.integers(0, 1 << 62), st.binary(min_size=1, max_size=300))
def test_sniffer_reports_round_trip(at_ns: int, data: bytes) -> None:
    for word in (Opened(at_ns), Sent(at_ns, data)):
        assert bus_sniffer.understood(str(word)) == word


@pytest.mark.parametrize("line", ["", "open", "open x", "sent 1", "sent 1 zz", "Traceback (most recent call last):"])
def test_invalid_sniffer_line_is_refused(line: str) -> None:
    with pytest.raises(ValueError, match=r"expected|invalid|non-hexadecimal"):
        bus_sniffer.understood(line)
