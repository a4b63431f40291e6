"""Proxy that terminates other machines' TLS connections in front of the router.

Zenoh's own TLS listener stops accepting for 0.1 s after each failed handshake (`TLS_ACCEPT_THROTTLE_TIME`, a compile-time
constant). So 15 refused handshakes per second would keep every client out. Here, one thread accepts all connections and
verifies their certificates concurrently, within the limits of `sextant.deploy.security.admission`. Only verified connections
reach the router. Another thread forwards their bytes over TLS on loopback, under a certificate of the same role; the router
applies its access rules to that role. These certificates are valid only for that one connection.
"""

import contextlib
import errno
import math
import selectors
import socket
import ssl
import struct
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import Self

from sextant.deploy.security.admission import HandshakeLimit, Limits, Pending, source_of
from sextant.deploy.security.tls_relay import Target, TlsRelay, common_name
from sextant.shared.wire.access import AUTHORITY, CERTIFICATE, KEY, ROLE_NAMED, Keys
from sextant.shared.wire.endpoint import cannot_listen, listener
from sextant.shared.wire.transport import TransportError

_HERE = "127.0.0.1"
_ROUTER_S = 3.0  # [s] timeout of the router for accepting a connection
_BACKLOG = 4096  # size of the kernel's queue of connections to be accepted
_ACCEPTS = 256  # maximum number of connections accepted in a row
_TURN_S = 0.01  # [s] of handshakes before new connections are accepted again
_LOOK_S = 0.1  # [s] between two checks for timeouts
_NO_ROOM = (errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM)
_NO_ROOM_S = 0.01
_RECORD = b"\x16\x03"  # first bytes of a TLS handshake
_DRAIN_BYTES = 4096  # [bytes] read at once from a refused client: closing with unread data would discard the alert

_REFUSALS = (  # part of OpenSSL's error, and its meaning
    ("certificate has expired", "an expired certificate"),
    ("certificate is not yet valid", "a certificate that is not valid yet; check the clocks"),
    ("PEER_DID_NOT_RETURN_A_CERTIFICATE", "a client without a certificate"),
    ("ALERT", "a client that rejects this robot's certificate"),
    ("CERTIFICATE_VERIFY_FAILED", "a certificate of a foreign authority"),
    ("EOF", "a client that hung up"),
)
NOT_TLS = "a client that does not speak TLS"
HUNG_UP = "a client that hung up"
TOO_MANY = "too many handshakes from one address"
TOO_SLOW = "a client that did not finish its handshake"
CROWDED = "a client dropped to make room for others"
CROWDED_ROLE = "too many clients of one role"
UNKNOWN_ROLE = "a certificate of no known role"


@dataclass(slots=True, eq=False)
class _Client:
    """A connection without a verified certificate."""

    socket: socket.socket  # a TLS socket after the handshake has begun
    source: str  # address under which it is counted
    number: int  # serial number of the connection
    refused: bool = False  # refused, but open until the client has read the alert


class TlsProxy:
    """Proxy for incoming connections; a context manager."""

    def __init__(
        self, listen: Sequence[str], keys: Keys, port: int, refuse: Callable[[str], object], limits: Limits | None = None
    ):
        """Load the certificates.

        Args:
            listen: TLS endpoints for other machines.
            keys: Keys of this machine.
            port: Port of 127.0.0.1 on which the router listens for this proxy (`Keys.behind_proxy`).
            refuse: Called with the kind of each refusal, from a thread of the proxy.
            limits: Limits for connections without a verified certificate.

        Raises:
            AccessError: The folder of keys has no certificates for it.
        """
        self._limits = limits = limits or Limits()
        self._endpoints, self._refuse = tuple(listen), refuse
        self._context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        self._context.verify_mode = ssl.CERT_REQUIRED
        self._context.load_verify_locations(keys.folder / AUTHORITY)
        self._context.load_cert_chain(keys.folder / CERTIFICATE, keys.folder / KEY)
        self._context.num_tickets = 0  # no session resumption
        self._relay, self._to_router = TlsRelay("tls relay"), {role: _target(keys, role, port) for role in ROLE_NAMED}
        self._limit, self._pending = HandshakeLimit(limits), Pending[_Client](limits)
        self._draining = Pending[_Client](limits)
        self._accepted = 0
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="tls proxy", daemon=True)

    def __enter__(self) -> Self:
        """Start listening.

        Raises:
            TransportError: An address cannot be listened on.
        """
        with contextlib.ExitStack() as stack:
            self._selector = stack.enter_context(selectors.DefaultSelector())
            for endpoint in self._endpoints:
                bound = stack.enter_context(_listener(endpoint))
                self._selector.register(bound, selectors.EVENT_READ)
            stack.enter_context(self._relay)
            self._thread.start()
            self._stack = stack.pop_all()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._ended.set()
        self._thread.join()
        self._stack.close()

    def _run(self) -> None:
        while not self._ended.is_set():
            ready = list[_Client]()
            for key, _ in self._selector.select(_LOOK_S):
                if isinstance(key.fileobj, socket.socket):
                    self._accept(key.fileobj)
                else:
                    ready.append(key.data)
            now_s = time.monotonic()
            ready.sort(key=self._urgency, reverse=True)
            for client in ready:
                if client.socket.fileno() >= 0:  # not dropped in this iteration
                    self._advance(client)
                if time.monotonic() - now_s > _TURN_S:  # the others are still ready in the next iteration
                    break
            for client in self._pending.overdue(now_s):
                self._drop(client, TOO_SLOW)
            for client in self._draining.overdue(now_s):
                self._close(client)
        for client in (*self._pending.overdue(math.inf), *self._draining.overdue(math.inf)):
            self._close(client)

    def _urgency(self, client: _Client) -> tuple[bool, bool, int]:
        """Return the sort key by which clients are served under load.

        Clients of verified addresses are first, then those in a handshake, then the newest, because a client that timed out
        retries.
        """
        return self._limit.is_verified(client.source), isinstance(client.socket, ssl.SSLSocket), client.number

    def _accept(self, bound: socket.socket) -> None:
        for _ in range(_ACCEPTS):
            try:
                connection, address = bound.accept()
            except BlockingIOError:
                return
            except OSError as error:
                if error.errno in _NO_ROOM:
                    time.sleep(_NO_ROOM_S)  # descriptors become free when other connections close
                    return
                continue  # the connection has closed already
            connection.setblocking(False)
            self._accepted += 1
            client = _Client(connection, source_of(address[0]), self._accepted)
            self._selector.register(connection.fileno(), selectors.EVENT_READ, client)
            if (crowded := self._pending.add(client, client.source, time.monotonic())) is not None:
                self._drop(crowded, CROWDED)

    def _advance(self, client: _Client) -> None:
        """Continue with a client that is ready."""
        if client.refused:
            self._drain(client)
        elif isinstance(client.socket, ssl.SSLSocket):
            self._shake_hands(client, client.socket)
        else:
            self._begin(client)

    def _begin(self, client: _Client) -> None:
        """Start the handshake of a client whose first bytes begin one."""
        try:
            first = client.socket.recv(len(_RECORD), socket.MSG_PEEK)
        except BlockingIOError:
            return
        except OSError:
            first = b""
        if not first or not _RECORD.startswith(first):
            self._drop(client, NOT_TLS if first else HUNG_UP)
        elif not self._limit.allows(client.source, time.monotonic()):
            self._drop(client, TOO_MANY)
        else:
            self._pending.speaks(client)
            client.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            secured = self._context.wrap_socket(client.socket, server_side=True, do_handshake_on_connect=False)
            client.socket = secured
            self._shake_hands(client, secured)

    def _shake_hands(self, client: _Client, secured: ssl.SSLSocket) -> None:
        try:
            secured.do_handshake()
        except ssl.SSLWantReadError:
            self._selector.modify(secured.fileno(), selectors.EVENT_READ, client)
            return
        except ssl.SSLWantWriteError:
            self._selector.modify(secured.fileno(), selectors.EVENT_WRITE, client)
            return
        except ssl.SSLError as error:
            self._refuse_kindly(client, _kind(error))
            return
        except OSError:
            self._drop(client, HUNG_UP)
            return
        target = self._to_router.get(common_name(secured))
        if target is None:
            self._drop(client, UNKNOWN_ROLE)
            return
        if self._relay.count(target) >= self._limits.verified:
            self._drop(client, CROWDED_ROLE)
            return
        self._pending.remove(client)
        self._limit.verify(client.source)
        self._selector.unregister(secured.fileno())
        certificate = secured.getpeercert() or {}
        self._relay.carry(secured, target, ends_s=ssl.cert_time_to_seconds(str(certificate["notAfter"])))

    def _refuse_kindly(self, client: _Client, why: str) -> None:
        """Refuse a client, and close when it has read the alert.

        Closing with unread data would discard the alert.
        """
        self._pending.remove(client)
        self._refuse(why)
        client.refused = True
        with contextlib.suppress(OSError):
            client.socket.shutdown(socket.SHUT_WR)
        self._selector.modify(client.socket.fileno(), selectors.EVENT_READ, client)
        if (crowded := self._draining.add(client, client.source, time.monotonic())) is not None:
            self._close(crowded)

    def _drain(self, client: _Client) -> None:
        """Read the rest of a refused client's data, and close when the client has closed."""
        try:
            if socket.socket.recv(client.socket, _DRAIN_BYTES):
                return
        except BlockingIOError:
            return
        except OSError:
            pass
        self._draining.remove(client)
        self._close(client)

    def _drop(self, client: _Client, why: str) -> None:
        self._pending.remove(client)
        self._refuse(why)
        with contextlib.suppress(OSError):  # close at once, without TIME_WAIT
            client.socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        self._close(client)

    def _close(self, client: _Client) -> None:
        self._selector.unregister(client.socket.fileno())
        client.socket.close()


def _listener(endpoint: str) -> socket.socket:
    """Open a listening socket.

    Raises:
        TransportError: The address cannot be listened on.
    """
    try:
        bound = listener(endpoint)
    except OSError as error:
        raise TransportError(cannot_listen(endpoint, error)) from None
    try:
        bound.listen(_BACKLOG)
    except OSError as error:  # another program has taken the address in the meantime
        bound.close()
        raise TransportError(cannot_listen(endpoint, error)) from None
    bound.setblocking(False)
    return bound


def _target(keys: Keys, role: str, port: int) -> Target:
    """Return the router's address and TLS context for clients of a role."""
    file = keys.proxy_file(role)
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.load_verify_locations(file.with_name(AUTHORITY))
    context.load_cert_chain(file)
    return Target((_HERE, port), socket.AF_INET, _HERE, context, attempt_s=_ROUTER_S, patience_s=_ROUTER_S)


def _kind(error: ssl.SSLError) -> str:
    """Return the kind of refusal for a handshake error."""
    text = str(error)
    return next((words for sign, words in _REFUSALS if sign in text), NOT_TLS)
