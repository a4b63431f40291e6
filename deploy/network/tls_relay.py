"""Carries bytes between pairs of connections, in a thread of its own: the near ends are given, the far ends are dialled."""

import contextlib
import errno
import os
import selectors
import socket
import ssl
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from types import TracebackType
from typing import Any, Self

_LOOK_S = 0.05
_READ = 1 << 16  # [bytes] at once
_ROOM = 1 << 16  # [bytes] that wait for one end, beyond which the other is not read: what waits is late already
_REDIAL_S = 0.1
_WANTS = (ssl.SSLWantReadError, ssl.SSLWantWriteError, BlockingIOError)


@dataclass(frozen=True, slots=True)
class Target:
    """How a far end is met."""

    address: Any  # as `socket.connect` takes it
    family: socket.AddressFamily
    host: str  # name that its certificate must have
    context: ssl.SSLContext
    attempt_s: float  # [s] for connecting and handshake, after which it is dialled again
    patience_s: float  # [s] after which it is given up
    silence_s: float | None = None  # [s] after which a far end that says nothing is given up


@dataclass(slots=True, eq=False)
class _End:
    """One end of a carried connection."""

    socket: socket.socket
    waiting: bytearray = field(default_factory=bytearray)  # to be sent here
    events: int = 0  # that the selector watches for
    ready: bool = False  # its handshake is done
    wants: int = selectors.EVENT_READ  # of its handshake


@dataclass(slots=True, eq=False)
class _Carried:
    near: _End
    far: _End
    target: Target
    answer: Callable[[str], ssl.SSLContext] | None
    ends_s: float  # [s] of the wall clock
    until_s: float  # when the far end is given up
    redial_s: float  # when it is dialled again, unless it is ready
    heard_s: float  # when it last said something
    dialling: bool = False
    over: bool = False


class TlsRelay:
    """Carries from entering to leaving; a context manager."""

    def __init__(self, name: str):
        """Prepare; `name` is that of the thread."""
        self._carried: dict[_Carried, None] = {}
        self._new: deque[_Carried] = deque()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

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
        for carried in (*self._carried, *self._new):
            carried.near.socket.close()
            carried.far.socket.close()
        self._selector.close()
        self._waking.close()
        self._woken.close()

    def carry(
        self,
        near: socket.socket,
        target: Target,
        answer: Callable[[str], ssl.SSLContext] | None = None,
        ends_s: float = float("inf"),
    ) -> None:
        """Carry a connection from now on; from any thread.

        Args:
            near: Its near end, not blocking.
            target: How its far end is met.
            answer: Returns how a near end that waits for its handshake is answered, by the far end's common name; None where
                the near end has had its handshake.
            ends_s: [s] of the wall clock, when it ends at the latest.
        """
        now_s = time.monotonic()
        far = _End(socket.socket(target.family))
        until_s = now_s + target.patience_s
        self._new.append(_Carried(_End(near, ready=answer is None), far, target, answer, ends_s, until_s, now_s, now_s))
        self._wake()

    def count(self, target: Target) -> int:
        """Return how many connections to a target are carried; from any thread."""
        return sum(one.target is target for one in (*self._carried, *self._new))

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
                carried = self._new.popleft()
                self._carried[carried] = None
                self._dial(carried)
            if (now_s := time.monotonic()) >= due_s:
                due_s = now_s + _LOOK_S
                for carried in list(self._carried):
                    self._look(carried, now_s)

    def _dial(self, carried: _Carried) -> None:
        """Begin to connect to the far end."""
        target = carried.target
        self._forget(carried.far)
        plain = socket.socket(target.family)
        plain.setblocking(False)
        for option in (socket.SO_RCVBUF, socket.SO_SNDBUF):
            plain.setsockopt(socket.SOL_SOCKET, option, _ROOM)
        plain.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        carried.far = _End(plain, wants=selectors.EVENT_WRITE)
        carried.dialling, carried.redial_s = True, time.monotonic() + target.attempt_s
        plain.connect_ex(target.address)  # where that fails, the selector reports it
        self._watch(carried)

    def _look(self, carried: _Carried, now_s: float) -> None:
        """Dial again, or end what is overdue."""
        silence_s = carried.target.silence_s
        silent = carried.far.ready and silence_s is not None and now_s - carried.heard_s > silence_s
        given_up = not carried.far.ready and now_s > carried.until_s
        if silent or given_up or time.time() > carried.ends_s:
            self._end(carried)
        elif not carried.far.ready and now_s >= carried.redial_s:
            self._dial(carried)

    def _advance(self, carried: _Carried, end: _End, events: int) -> None:
        """Do what can be done after something has happened at one end."""
        if carried.over or end.socket.fileno() < 0:
            return
        try:
            if end.ready:
                self._move(carried, end, events)
            elif end is carried.far:
                self._meet(carried)
            else:
                _shake_hands(end)
        except OSError:  # also of TLS; or the end has closed
            if end is carried.far and not end.ready:
                self._fail(carried)
            else:
                self._end(carried)
        else:
            self._watch(carried)

    def _meet(self, carried: _Carried) -> None:
        """Go on with the handshake with the far end, and answer the near one when it is done.

        Raises:
            OSError: The far end does not take the connection.
        """
        far, target = carried.far, carried.target
        if not isinstance(far.socket, ssl.SSLSocket):
            if error := far.socket.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR):
                raise OSError(error, os.strerror(error))
            far.socket = target.context.wrap_socket(far.socket, server_hostname=target.host, do_handshake_on_connect=False)
        _shake_hands(far)
        if far.ready:
            carried.heard_s = time.monotonic()
            if carried.answer is not None:
                assert isinstance(far.socket, ssl.SSLSocket)
                context = carried.answer(common_name(far.socket))
                carried.near.socket = context.wrap_socket(carried.near.socket, server_side=True, do_handshake_on_connect=False)

    def _move(self, carried: _Carried, end: _End, events: int) -> None:
        """Move bytes from and to an end.

        Raises:
            OSError: An end has closed.
        """
        other = carried.near if end is carried.far else carried.far
        if events & selectors.EVENT_WRITE:
            _flush(end)
            _transfer(other, end)
        if events & selectors.EVENT_READ:
            _transfer(end, other)
            if end is carried.far:
                carried.heard_s = time.monotonic()

    def _fail(self, carried: _Carried) -> None:
        """The far end cannot be met now."""
        self._forget(carried.far)
        carried.redial_s = time.monotonic() + _REDIAL_S

    def _watch(self, carried: _Carried) -> None:
        """Have the selector watch for what can be done next."""
        for end, other in ((carried.near, carried.far), (carried.far, carried.near)):
            if end.socket.fileno() < 0:
                continue
            if end.ready:
                reads = other.ready and len(other.waiting) < _ROOM
                wanted = (selectors.EVENT_READ if reads else 0) | (selectors.EVENT_WRITE if end.waiting else 0)
            else:  # the near end waits for the far one
                wanted = end.wants if end is carried.far or other.ready else 0
            if wanted != end.events:
                number = end.socket.fileno()
                if not end.events:
                    self._selector.register(number, wanted, (carried, end))
                elif not wanted:
                    self._selector.unregister(number)
                else:
                    self._selector.modify(number, wanted, (carried, end))
                end.events = wanted

    def _forget(self, end: _End) -> None:
        """Close an end."""
        if end.events:
            self._selector.unregister(end.socket.fileno())
            end.events = 0
        end.socket.close()

    def _end(self, carried: _Carried) -> None:
        carried.over = True
        del self._carried[carried]
        for end in (carried.near, carried.far):
            if end.ready:
                with contextlib.suppress(OSError):
                    _flush(end)  # the last words of the other end
            self._forget(end)


def common_name(link: ssl.SSLSocket) -> str:
    """Return the common name of the other side's verified certificate, empty where it has none."""
    subject: Any = (link.getpeercert() or {}).get("subject", ())
    return str(next((value for pairs in subject for key, value in pairs if key == "commonName"), ""))


def _shake_hands(end: _End) -> None:
    """Go on with a handshake.

    Raises:
        OSError: It failed.
    """
    assert isinstance(end.socket, ssl.SSLSocket)
    try:
        end.socket.do_handshake()
    except ssl.SSLWantWriteError:
        end.wants = selectors.EVENT_WRITE
    except ssl.SSLWantReadError:
        end.wants = selectors.EVENT_READ
    else:
        end.ready = True


def _transfer(source: _End, target: _End) -> None:
    """Move bytes until there are none, or the target takes no more.

    Raises:
        OSError: One of them has closed.
    """
    while target.ready and len(target.waiting) < _ROOM:
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
