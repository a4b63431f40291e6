"""Carries the bytes of verified clients to the router and back, in a thread of its own."""

import contextlib
import errno
import os
import selectors
import socket
import ssl
import threading
import time
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Self

from shared.access import AUTHORITY

_HERE = "127.0.0.1"
_LOOK_S = 0.5
_READ = 1 << 16  # [bytes] at once
_ROOM = 1 << 17  # [bytes] that wait for one side, beyond which the other is not read: what waits is late already
_CONNECT_S = 5.0  # [s] in which the router has to take a connection
_WANTS = (ssl.SSLWantReadError, ssl.SSLWantWriteError, BlockingIOError)


@dataclass(slots=True, eq=False)
class _End:
    """One end of a carried connection."""

    socket: socket.socket  # of TLS once it is connected
    waiting: bytearray = field(default_factory=bytearray)  # to be sent here
    events: int = 0  # that the selector watches for
    connected: bool = True  # its handshake is done


@dataclass(slots=True, eq=False)
class _Carried:
    """A client's connection and the one to the router."""

    role: str
    client: _End
    router: _End
    since_s: float
    ends_s: float  # [s] of the wall clock, when the client's certificate does
    over: bool = False


class TlsRelay:
    """Carries from entering to leaving; a context manager."""

    def __init__(self, certificates: Mapping[str, Path], port: int):
        """Prepare.

        Args:
            certificates: Role -> certificate and private key by which the router knows it.
            port: Of 127.0.0.1, on which the router listens.
        """
        self._contexts = {role: _context(file) for role, file in certificates.items()}
        self._port = port
        self._carried: dict[_Carried, None] = {}
        self._new: deque[tuple[ssl.SSLSocket, str, float]] = deque()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="tls relay", daemon=True)

    def __enter__(self) -> Self:
        self._selector = selectors.DefaultSelector()
        self._waking, self._woken = socket.socketpair()
        self._woken.setblocking(False)
        self._waking.setblocking(False)
        self._selector.register(self._woken, selectors.EVENT_READ)
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._ended.set()
        self._wake()
        self._thread.join()
        for carried in self._carried:
            carried.client.socket.close()
            carried.router.socket.close()
        for client, _, _ in self._new:
            client.close()
        self._selector.close()
        self._waking.close()
        self._woken.close()

    def carry(self, client: ssl.SSLSocket, role: str, ends_s: float) -> None:
        """Carry a verified client from now on, until its certificate ends; from any thread."""
        self._new.append((client, role, ends_s))
        self._wake()

    def _wake(self) -> None:
        with contextlib.suppress(BlockingIOError):  # enough of them are on their way
            self._waking.send(b"w")

    def _run(self) -> None:
        due_s = 0.0
        while not self._ended.is_set():
            for key, events in self._selector.select(_LOOK_S):
                if key.data is None:
                    with contextlib.suppress(BlockingIOError):
                        self._woken.recv(4096)
                else:
                    carried, end = key.data
                    self._advance(carried, end, events)
            while self._new:
                self._connect(*self._new.popleft())
            if (now_s := time.monotonic()) >= due_s:
                due_s = now_s + _LOOK_S
                self._end_overdue(now_s)

    def _connect(self, client: ssl.SSLSocket, role: str, ends_s: float) -> None:
        """Connect to the router for a client."""
        plain = socket.socket()
        plain.setblocking(False)
        plain.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        plain.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _ROOM)
        plain.connect_ex((_HERE, self._port))  # where that fails, the selector reports it
        carried = _Carried(role, _End(client), _End(plain, connected=False), time.monotonic(), ends_s)
        self._carried[carried] = None
        self._watch(carried)

    def _advance(self, carried: _Carried, end: _End, events: int) -> None:
        """Move what can be moved, after something has happened at one end."""
        if carried.over:
            return
        other = carried.router if end is carried.client else carried.client
        try:
            if not end.connected:
                end.connected = self._shaken(carried)
            elif events & selectors.EVENT_WRITE:
                _flush(end)
                _move(other, end)
            if end.connected and events & selectors.EVENT_READ:
                _move(end, other)
        except OSError:  # also of TLS; or the end has closed
            self._end(carried)
        else:
            self._watch(carried)

    def _shaken(self, carried: _Carried) -> bool:
        """Go on with the handshake with the router; whether it is done.

        Raises:
            OSError: The router does not take the connection.
        """
        end = carried.router
        if not isinstance(end.socket, ssl.SSLSocket):
            if error := end.socket.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR):
                raise OSError(error, os.strerror(error))
            context = self._contexts[carried.role]
            end.socket = context.wrap_socket(end.socket, server_hostname=_HERE, do_handshake_on_connect=False)
        assert isinstance(end.socket, ssl.SSLSocket)
        try:
            end.socket.do_handshake()
        except _WANTS:
            return False
        return True

    def _watch(self, carried: _Carried) -> None:
        """Have the selector watch for what can be moved next."""
        client, router = carried.client, carried.router
        for end, other in ((client, router), (router, client)):
            if not end.connected:
                wanted = selectors.EVENT_WRITE if not end.events else selectors.EVENT_READ
            else:
                reads = other.connected and len(other.waiting) < _ROOM
                wanted = (selectors.EVENT_READ if reads else 0) | (selectors.EVENT_WRITE if end.waiting else 0)
            if wanted != end.events:
                if not end.events:
                    self._selector.register(end.socket.fileno(), wanted, (carried, end))
                elif not wanted:
                    self._selector.unregister(end.socket.fileno())
                else:
                    self._selector.modify(end.socket.fileno(), wanted, (carried, end))
                end.events = wanted

    def _end(self, carried: _Carried) -> None:
        carried.over = True
        del self._carried[carried]
        for end in (carried.client, carried.router):
            if end.events:
                self._selector.unregister(end.socket.fileno())
            with contextlib.suppress(OSError):
                _flush(end)  # the last words of the other end
            end.socket.close()

    def _end_overdue(self, now_s: float) -> None:
        """End what the router does not take, and whose certificate has ended."""
        for carried in list(self._carried):
            late = not carried.router.connected and now_s - carried.since_s > _CONNECT_S
            if late or time.time() > carried.ends_s:
                self._end(carried)


def _context(file: Path) -> ssl.SSLContext:
    """What connects to the router for a role."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.load_verify_locations(file.with_name(AUTHORITY))
    context.load_cert_chain(file)
    return context


def _move(source: _End, target: _End) -> None:
    """Move bytes until there are none, or the target takes no more.

    Raises:
        OSError: One of them has closed.
    """
    while target.connected and len(target.waiting) < _ROOM:
        try:
            data = source.socket.recv(_READ)
        except _WANTS:
            return
        if not data:
            raise ConnectionResetError(errno.ECONNRESET, "closed")
        target.waiting += data
        _flush(target)


def _flush(end: _End) -> None:
    """Send what waits, as far as it is taken.

    Raises:
        OSError: The end has closed.
    """
    while end.waiting:
        try:
            del end.waiting[: end.socket.send(end.waiting)]
        except _WANTS:
            return
