"""The TLS dialer on loopback, between stand-ins for the routers of two machines."""

import socket
import ssl
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import pytest

from sextant.deploy.security import tls_dialer
from sextant.deploy.security.tls_dialer import TlsDialer
from sextant.shared.wire.access import AUTHORITY, CERTIFICATE, KEY, PROXY, ROUTER, Keys
from tests.support import gated
from tests.support.echo_server import EchoServer, read

PATIENCE_S = 20.0


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return gated.make_keys(tmp_path_factory.mktemp("keys"))


def remote_server(keys: Path, role: str = "robot", port: int = 0) -> EchoServer:
    return EchoServer(keys / role / AUTHORITY, keys / role / CERTIFICATE, keys / role / KEY, port)


@dataclass
class At:
    """The port of a dialer, and the TLS context with which its router connects."""

    port: int
    context: ssl.SSLContext

    def call(self) -> socket.socket:
        return socket.create_connection(("127.0.0.1", self.port), PATIENCE_S)

    def connect(self) -> ssl.SSLSocket:
        return self.context.wrap_socket(self.call(), server_hostname="127.0.0.1")


@contextmanager
def running_dialer(keys: Path, port: int) -> Iterator["At"]:
    """Run the dialer of a base."""
    inner = keys / "base" / PROXY
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.load_verify_locations(inner / AUTHORITY)
    context.load_cert_chain(inner / f"{ROUTER}.pem")
    with TlsDialer(f"tls/127.0.0.1:{port}", Keys.load(keys / "base")) as running:
        yield At(running.port, context)


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as probe:
        return int(probe.getsockname()[1])


@pytest.mark.parametrize("role", ["robot", "site"])
def test_dialer_presents_remote_role_to_router(keys: Path, role: str) -> None:
    far = remote_server(keys, role)
    with running_dialer(keys, far.port) as at, at.connect() as link:
        subject = (link.getpeercert() or {})["subject"]
        assert (("commonName", role),) in subject
        assert read(link, 16).decode().strip() == "base", "this machine's certificate is that of its role"
        link.sendall(bytes(100_000))
        assert read(link, 100_000) == bytes(100_000)
    far.close()


def test_waiting_connection_attempt_reaches_late_machine(keys: Path) -> None:
    port = free_port()
    with running_dialer(keys, port) as at, at.call() as plain:
        plain.settimeout(0.3)
        with pytest.raises(TimeoutError):  # the connection stays open while nothing listens at the far end
            plain.recv(1)
        plain.settimeout(PATIENCE_S)
        far = remote_server(keys, port=port)
        with at.context.wrap_socket(plain, server_hostname="127.0.0.1") as link:
            assert read(link, 16)
        far.close()


@pytest.mark.parametrize("why", ["nothing listens", "it says nothing", "a foreign authority"])
def test_unreachable_machine_closes_router_connection(keys: Path, why: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tls_dialer, "PATIENCE_S", 0.4)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        if why == "nothing listens":
            port = free_port()
        elif why == "it says nothing":
            port = silent.getsockname()[1]
        else:
            foreign = remote_server(keys, "foreign")
            port = foreign.port
        with running_dialer(keys, port) as at, pytest.raises((ConnectionResetError, ssl.SSLEOFError)):
            at.connect()


def test_connection_to_silent_machine_is_closed(keys: Path) -> None:
    far = remote_server(keys)
    began_s = time.monotonic()
    with running_dialer(keys, far.port) as at, at.connect() as link:
        read(link, 16)
        assert link.recv(1) == b""
        assert time.monotonic() - began_s > 0.5
    far.close()


def test_local_program_without_keys_is_refused(keys: Path) -> None:
    far = remote_server(keys)
    with running_dialer(keys, far.port) as at:
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
        with at.call() as plain, suppress(OSError), context.wrap_socket(plain) as link:
            assert link.recv(1) == b""
    far.close()
