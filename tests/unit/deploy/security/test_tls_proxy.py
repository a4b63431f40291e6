"""The TLS proxy on loopback, in front of a stand-in for the router that uses TLS."""

import dataclasses
import shutil
import socket
import ssl
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from sextant.deploy.security import tls_proxy
from sextant.deploy.security.admission import Limits
from sextant.deploy.security.authority import Authority
from sextant.deploy.security.tls_proxy import TlsProxy
from sextant.shared.wire.access import AUTHORITY, CERTIFICATE, KEY, PROXY, ROUTER, Keys
from sextant.shared.wire.handshake import verdict
from sextant.shared.wire.transport import TransportError
from tests.support import gated
from tests.support.echo_server import EchoServer, read

PATIENCE_S = 20.0


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return gated.make_keys(tmp_path_factory.mktemp("keys"))


@dataclasses.dataclass
class At:
    """A running proxy."""

    port: int
    refused: Counter[str]
    router: EchoServer
    keys: Path

    def context(self, folder: Path | None) -> ssl.SSLContext:
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        context.load_verify_locations(self.keys / "robot" / AUTHORITY)
        if folder is not None:
            context.load_cert_chain(folder / CERTIFICATE, folder / KEY)
        return context

    def enter(self, who: str, source: str = "127.0.0.1") -> ssl.SSLSocket:
        """Connect with a role's keys, and return the TLS connection."""
        plain = socket.create_connection(("127.0.0.1", self.port), PATIENCE_S, (source, 0))
        return self.context(self.keys / who).wrap_socket(plain, server_hostname="127.0.0.1")

    def until(self, holds: Callable[[], bool]) -> None:
        until, pause = time.monotonic() + PATIENCE_S, threading.Event()
        while not holds():
            assert time.monotonic() < until, f"refused so far: {dict(self.refused)}"
            pause.wait(0.005)


@contextmanager
def proxy(keys: Path, limits: Limits | None = None) -> Iterator[At]:
    with ExitStack() as stack:
        inner = keys / "robot" / PROXY
        router = EchoServer(inner / AUTHORITY, inner / f"{ROUTER}.pem")
        stack.callback(router.close)
        refused = Counter[str]()
        with socket.create_server(("127.0.0.1", 0)) as probe:
            port = probe.getsockname()[1]
        stack.enter_context(
            TlsProxy(
                [f"tls/127.0.0.1:{port}"], Keys.load(keys / "robot"), router.port, lambda kind: refused.update([kind]), limits
            )
        )
        yield At(port, refused, router, keys)


@pytest.fixture
def at(keys: Path) -> Iterator[At]:
    with proxy(keys) as running:
        yield running


@pytest.mark.parametrize("role", ["robot", "base", "console", "viewer", "site"])
def test_verified_client_reaches_router_under_its_role(at: At, role: str) -> None:
    with at.enter(role) as link:
        assert read(link, 16).decode().strip() == role
        link.sendall(b"there and back")
        assert read(link, 14) == b"there and back"
    assert at.refused == {}


def test_bytes_are_complete_and_ordered_with_slow_side(at: At) -> None:
    data = bytes(range(256)) * (1 << 14)  # 4 MiB, more than all buffers on the way
    with at.enter("base") as link:
        read(link, 16)
        sending = threading.Thread(target=link.sendall, args=(data[: 1 << 16],))
        sending.start()
        sending.join()
        assert read(link, 1 << 16) == data[: 1 << 16]
        link.settimeout(0.5)
        sent = 0
        try:  # without reading, until the other side accepts no more
            while sent < len(data):
                sent += link.send(data[sent : sent + (1 << 14)])
        except TimeoutError:
            pass
        link.settimeout(PATIENCE_S)
        assert read(link, sent) == data[:sent]


def test_closing_one_side_closes_other_side(at: At) -> None:
    with at.enter("base") as link:
        read(link, 16)
        at.router.hang_up()
        assert link.recv(1) == b""


@pytest.mark.parametrize(
    ("who", "told", "kind"),
    [
        ("foreign", "does not trust the authority", "a certificate of a foreign authority"),
        ("expired", "has expired", "an expired certificate"),
        (None, "asks for a certificate", "a client without a certificate"),
    ],
)
def test_refused_client_receives_alert_and_is_counted(at: At, who: str | None, told: str, kind: str) -> None:
    context = at.context(None if who is None else at.keys / who)
    for number in range(1, 21):  # the alert is never lost
        assert told in verdict(f"tls/127.0.0.1:{at.port}", context, PATIENCE_S)
        at.until(lambda number=number: at.refused == {kind: number})  # type: ignore[misc]


def test_certificate_with_unknown_role_is_refused(keys: Path, tmp_path: Path) -> None:
    authority = Authority(days=1)
    for role in ("robot", "nobody"):
        authority.issue(tmp_path / role, role)
    with proxy(tmp_path) as at:
        with at.enter("nobody") as link, suppress(ConnectionResetError):
            assert link.recv(1) == b""
        at.until(lambda: at.refused == {"a certificate of no known role": 1})


def test_client_rejecting_server_certificate_is_counted(at: At) -> None:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.load_verify_locations(at.keys / "foreign" / AUTHORITY)
    with pytest.raises(ssl.SSLCertVerificationError), socket.create_connection(("127.0.0.1", at.port)) as plain:
        context.wrap_socket(plain, server_hostname="127.0.0.1")
    at.until(lambda: at.refused == {"a client that rejects this robot's certificate": 1})


def test_non_tls_connection_is_closed_immediately(at: At) -> None:
    for said in (b"GET / HTTP/1.1\r\n\r\n", b"\x00", b"\x16\x02\x01"):
        with socket.create_connection(("127.0.0.1", at.port), PATIENCE_S) as link:
            link.sendall(said)
            with suppress(ConnectionResetError):
                assert link.recv(1) == b""
    at.until(lambda: at.refused == {tls_proxy.NOT_TLS: 3})
    for said in (b"", b"\x16", b"\x16\x03\x01\x00\x05hello"):
        with socket.create_connection(("127.0.0.1", at.port), PATIENCE_S) as link:
            link.sendall(said)
    at.until(lambda: at.refused.total() == 6)


def test_silent_connections_are_bounded_and_block_no_client(keys: Path) -> None:
    with proxy(keys, Limits(pending=100, timeout_s=0.5)) as at, ExitStack() as stack:
        for _ in range(300):
            stack.enter_context(socket.create_connection(("127.0.0.1", at.port), PATIENCE_S))
        with at.enter("base") as link:
            assert read(link, 16).decode().strip() == "base"
        at.until(lambda: at.refused.total() == 300)
    assert at.refused[tls_proxy.CROWDED] >= 200
    assert set(at.refused) == {tls_proxy.CROWDED, tls_proxy.TOO_SLOW}


def test_stalled_handshake_times_out(keys: Path) -> None:
    incoming, outgoing = ssl.MemoryBIO(), ssl.MemoryBIO()
    with proxy(keys, Limits(timeout_s=0.3)) as at:
        half = at.context(keys / "base").wrap_bio(incoming, outgoing, server_hostname="127.0.0.1")
        with pytest.raises(ssl.SSLWantReadError):
            half.do_handshake()
        with socket.create_connection(("127.0.0.1", at.port), PATIENCE_S) as link:
            link.sendall(outgoing.read())
            at.until(lambda: at.refused == {tls_proxy.TOO_SLOW: 1})


def test_handshake_limit_exempts_verified_address(keys: Path) -> None:
    with proxy(keys, Limits(handshakes_hz=1e-6, handshakes_burst=3)) as at:
        foreign = at.context(keys / "foreign")
        endpoint = f"tls/127.0.0.1:{at.port}"
        at.enter("base", "127.0.0.2").close()
        for _ in range(6):
            assert verdict(endpoint, foreign, PATIENCE_S)
        at.until(lambda: at.refused[tls_proxy.TOO_MANY] == 3)
        with pytest.raises((ConnectionResetError, ssl.SSLEOFError)):
            at.enter("base")
        for _ in range(6):
            with at.enter("base", "127.0.0.2") as link:
                assert read(link, 16).decode().strip() == "base"


def test_verified_clients_are_bounded_per_role(keys: Path) -> None:
    with proxy(keys, Limits(verified=3)) as at, ExitStack() as stack:
        for _ in range(3):
            assert read(stack.enter_context(at.enter("viewer")), 16)
        with at.enter("viewer") as link, pytest.raises((ConnectionResetError, AssertionError)):
            read(link, 16)
        assert at.refused == {tls_proxy.CROWDED_ROLE: 1}
        assert read(stack.enter_context(at.enter("base")), 16)


def test_client_priority_is_verified_then_handshaking_then_newest(keys: Path) -> None:
    """Rank the clients of an overloaded proxy."""
    made = TlsProxy(["tls/127.0.0.1:1"], Keys.load(keys / "robot"), 1, lambda _: None)
    made._limit.verify("base")
    with socket.socket() as plain, ssl.create_default_context().wrap_socket(socket.socket(), server_hostname="x") as secured:
        old, new, known, begun = (
            tls_proxy._Client(link, source, number)
            for number, (link, source) in enumerate(((plain, "a"), (plain, "a"), (plain, "base"), (secured, "a")))
        )
        served = sorted([old, begun, known, new], key=made._urgency, reverse=True)
    assert [client.number for client in served] == [known.number, begun.number, new.number, old.number]


def test_connection_ends_when_certificate_expires(keys: Path, tmp_path: Path) -> None:
    authority = Authority(days=1)
    authority.issue(tmp_path / "robot", "robot")
    authority.issue(tmp_path / "base", "base", ends=datetime.now(UTC) + timedelta(seconds=4))
    with proxy(tmp_path) as at, at.enter("base") as link:
        assert read(link, 16)
        assert link.recv(1) == b""


def test_missing_router_closes_client_connection(keys: Path) -> None:
    with proxy(keys) as at:
        at.router.close()
        with at.enter("base") as link:
            assert link.recv(1) == b""


def test_occupied_port_is_reported(keys: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        endpoint = f"tls/127.0.0.1:{taken.getsockname()[1]}"
        made = TlsProxy([endpoint], Keys.load(keys / "robot"), 1, lambda _: None)
        with pytest.raises(TransportError, match=f"cannot listen on {endpoint}: another program has port"):
            made.__enter__()


def test_close_ends_all_threads_and_connections(keys: Path) -> None:
    before = set(threading.enumerate())
    with proxy(keys) as at:
        link = at.enter("base")
        read(link, 16)
        silent = socket.create_connection(("127.0.0.1", at.port), PATIENCE_S)
        mine = [one for one in threading.enumerate() if one not in before and one.name.startswith("tls ")]
        assert len(mine) == 2
    assert not any(one.is_alive() for one in mine)
    for one in (link, silent):
        with one, suppress(ConnectionResetError):
            assert one.recv(1) == b""


def test_inner_proxy_keys_are_refused_at_outer_port(at: At, keys: Path, tmp_path: Path) -> None:
    """Reject the proxy's inner keys at its outer port.

    The inner keys of one machine open neither another machine nor this one under another role.
    """
    stolen = tmp_path / "stolen"
    stolen.mkdir()
    for name in (CERTIFICATE, KEY):
        shutil.copy(keys / "robot" / PROXY / "console.pem", stolen / name)
    assert "does not trust the authority" in verdict(f"tls/127.0.0.1:{at.port}", at.context(stolen), PATIENCE_S)
