"""Forward bytes between pairs of connections, in a separate thread.

The near ends are given; the relay connects to the far ends.
"""

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
_READ = 1 << 16  # [bytes] maximum read at once
_ROOM = 1 << 16  # [bytes] maximum queue for one end, above which the other is not read: queued data is late already
_REDIAL_S = 0.1
_WANTS = (ssl.SSLWantReadError, ssl.SSLWantWriteError, BlockingIOError)


@dataclass(frozen=True, slots=True)
class Target:
    """How to connect to a far end."""

    address: Any  # as `socket.connect` takes it
    family: socket.AddressFamily
    host: str  # host name that its certificate must have
    context: ssl.SSLContext
    attempt_s: float  # [s] timeout of one connection attempt with its handshake
    patience_s: float  # [s] after which no further attempt is made
    silence_s: float | None = None  # [s] without data after which the far end is closed


@dataclass(slots=True, eq=False)
class _End:
    """One end of a forwarded connection."""

    socket: socket.socket
    waiting: bytearray = field(default_factory=bytearray)  # data to be sent here
    events: int = 0  # events registered with the selector
    ready: bool = False  # whether its handshake is finished
    wants: int = selectors.EVENT_READ  # event that its handshake waits for


@dataclass(slots=True, eq=False)
class _Carried:
    near: _End
    far: _End
    target: Target
    answer: Callable[[str], ssl.SSLContext] | None
    ends_s: float  # [s] wall-clock time of its end
    until_s: float  # time after which no further attempt is made
    redial_s: float  # time of the next attempt, unless it is ready
    heard_s: float  # time of the last data from the far end
    dialling: bool = False
    over: bool = False


class TlsRelay:
    """Forwards connections in a thread; a context manager."""

    def __init__(self, name: str):
        """Prepare the thread; `name` is its name."""
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
        """Start forwarding a connection; thread-safe.

        Args:
            near: Near end, non-blocking.
            target: Far end.
            answer: Returns the near end's TLS context for the far end's common name, if the near end still needs its handshake;
                None if it had its handshake.
            ends_s: [s] wall-clock time at which the connection ends at the latest.
        """
        now_s = time.monotonic()
        far = _End(socket.socket(target.family))
        until_s = now_s + target.patience_s
        self._new.append(_Carried(_End(near, ready=answer is None), far, target, answer, ends_s, until_s, now_s, now_s))
        self._wake()

    def count(self, target: Target) -> int:
        """Return the number of connections to a target; thread-safe."""
        return sum(one.target is target for one in (*self._carried, *self._new))

    def _wake(self) -> None:
        with contextlib.suppress(BlockingIOError):  # enough wake-ups are pending
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
        """Start connecting to the far end."""
        target = carried.target
        self._forget(carried.far)
        plain = socket.socket(target.family)
        plain.setblocking(False)
        for option in (socket.SO_RCVBUF, socket.SO_SNDBUF):
            plain.setsockopt(socket.SOL_SOCKET, option, _ROOM)
        plain.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        carried.far = _End(plain, wants=selectors.EVENT_WRITE)
        carried.dialling, carried.redial_s = True, time.monotonic() + target.attempt_s
        plain.connect_ex(target.address)  # the selector reports failures
        self._watch(carried)

    def _look(self, carried: _Carried, now_s: float) -> None:
        """Connect again, or close a connection after its timeouts."""
        silence_s = carried.target.silence_s
        silent = carried.far.ready and silence_s is not None and now_s - carried.heard_s > silence_s
        given_up = not carried.far.ready and now_s > carried.until_s
        if silent or given_up or time.time() > carried.ends_s:
            self._end(carried)
        elif not carried.far.ready and now_s >= carried.redial_s:
            self._dial(carried)

    def _advance(self, carried: _Carried, end: _End, events: int) -> None:
        """Process events at one end."""
        if carried.over or end.socket.fileno() < 0:
            return
        try:
            if end.ready:
                self._move(carried, end, events)
            elif end is carried.far:
                self._meet(carried)
            else:
                _shake_hands(end)
        except OSError:  # includes TLS errors and a closed end
            if end is carried.far and not end.ready:
                self._fail(carried)
            else:
                self._end(carried)
        else:
            self._watch(carried)

    def _meet(self, carried: _Carried) -> None:
        """Continue the handshake with the far end; when finished, start the near end's.

        Raises:
            OSError: The far end does not accept the connection.
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
        """Schedule another attempt after the far end could not be reached."""
        self._forget(carried.far)
        carried.redial_s = time.monotonic() + _REDIAL_S

    def _watch(self, carried: _Carried) -> None:
        """Register both ends with the selector for the next possible events."""
        for end, other in ((carried.near, carried.far), (carried.far, carried.near)):
            if end.socket.fileno() < 0:
                continue
            if end.ready:
                reads = other.ready and len(other.waiting) < _ROOM
                wanted = (selectors.EVENT_READ if reads else 0) | (selectors.EVENT_WRITE if end.waiting else 0)
            else:  # the near end waits for the far end
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
                    _flush(end)  # the other end's last data
            self._forget(end)


def common_name(link: ssl.SSLSocket) -> str:
    """Return the common name of the peer's verified certificate, or an empty string."""
    subject: Any = (link.getpeercert() or {}).get("subject", ())
    return str(next((value for pairs in subject for key, value in pairs if key == "commonName"), ""))


def _shake_hands(end: _End) -> None:
    """Continue a handshake.

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
    """Move bytes until there are none left, or the target accepts no more.

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
    """Send queued data, as far as the socket accepts it.

    Raises:
        OSError: The end has closed.
    """
    while end.waiting:
        try:
            del end.waiting[: end.socket.send(end.waiting)]
        except _WANTS:
            return
