"""Proxy that connects to another machine's TLS endpoint for this machine's router.

With it, the router never cancels an attempt. Zenoh 1.10 stops opening a session after `open_timeout`. This timeout must be
short for a router behind a radio, which has to reconnect soon after an outage. If it expires just when the session is
registered, a session remains that sends and never receives. Its link occupies the place of another one, and the routers never
reconnect (1 of 25 outages of a link of 20 ms). Here, the router connects to loopback, waits for as long as necessary, and a
failure only closes its connection. The proxy retries the other machine, and answers under that machine's role
(`sextant.deploy.security.tls_proxy`).
"""

import socket
import ssl
import threading
from types import TracebackType
from typing import Self

from sextant.deploy.security.tls_relay import Target, TlsRelay
from sextant.shared.wire.access import AUTHORITY, CERTIFICATE, KEY, ROLE_NAMED, Keys
from sextant.shared.wire.endpoint import place, resolved
from sextant.shared.wire.transport import LEASE_MS

_HERE = "127.0.0.1"
_ATTEMPT_S = 0.5  # [s] for connection and handshake
PATIENCE_S = 5.0  # [s] after which the router's connection is closed because the other machine is unreachable
_LOOK_S = 0.1
_END_S = 1.0
_BUFFER = 1 << 16  # [bytes]


class TlsDialer:
    """Proxy for outgoing connections; a context manager."""

    def __init__(self, endpoint: str, keys: Keys):
        """Load the certificates.

        Args:
            endpoint: TLS endpoint of the other machine.
            keys: Keys of this machine.

        Raises:
            AccessError: The folder of keys has no certificates for it.
        """
        self._endpoint, self._host = endpoint, place(endpoint)[0]
        self._relay = TlsRelay("tls dialer's relay")
        self._context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        self._context.load_verify_locations(keys.folder / AUTHORITY)
        self._context.load_cert_chain(keys.folder / CERTIFICATE, keys.folder / KEY)
        self._answers = {role: _server(keys, role) for role in ROLE_NAMED}
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="tls dialer", daemon=True)

    def __enter__(self) -> Self:
        self._listener = socket.create_server((_HERE, 0))
        self._listener.settimeout(_LOOK_S)
        self._listener.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER)
        self._relay.__enter__()
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._ended.set()
        self._thread.join(_END_S)  # name resolution may block the thread
        self._listener.close()
        self._relay.__exit__(kind, error, trace)

    @property
    def port(self) -> int:
        """Port of 127.0.0.1 to which the router connects."""
        return int(self._listener.getsockname()[1])

    def _run(self) -> None:
        while not self._ended.is_set():
            try:
                near, _ = self._listener.accept()
            except TimeoutError:
                continue
            near.setblocking(False)
            near.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            try:
                family, address = resolved(self._endpoint)
            except socket.gaierror:  # reported by `sextant.deploy.security.connect_probe`
                near.close()
                continue
            if self._ended.is_set():
                near.close()
                return
            target = Target(address, family, self._host, self._context, _ATTEMPT_S, PATIENCE_S, LEASE_MS * 1e-3)
            self._relay.carry(near, target, self._answer)

    def _answer(self, role: str) -> ssl.SSLContext:
        """Return the TLS context for the router's connection to a machine of a role.

        Raises:
            OSError: There is no such role.
        """
        if role not in self._answers:
            raise ConnectionAbortedError(f"a certificate of no known role: {role!r}")
        return self._answers[role]


def _server(keys: Keys, role: str) -> ssl.SSLContext:
    file = keys.proxy_file(role)
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.verify_mode = ssl.CERT_REQUIRED  # programs of other users have no certificate
    context.load_verify_locations(file.with_name(AUTHORITY))
    context.load_cert_chain(file)
    return context
