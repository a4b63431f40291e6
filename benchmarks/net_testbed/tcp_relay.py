"""Radio between two processes of one machine.

python -m benchmarks.net_testbed.tcp_relay --to PORT [--to PORT ...]

A connection to one of its ports is forwarded, through the emulated radio, to the corresponding port of this machine. It prints
its ports on standard output, in the order of the target ports. It accepts `cut`, `mend` and `what it carried` on standard
input, as `benchmarks.net_testbed.relay` does. When that is closed, it ends.
"""

import contextlib
import os
import selectors
import socket
import sys
import time
from dataclasses import dataclass, field

from benchmarks.net_testbed import orders
from benchmarks.net_testbed.stream import QUEUE_BYTES, RadioOutages, Stream
from sextant.shared.runtime.process_priority import go_first
from sextant.shared.scenario.scenario import Link

HERE = "127.0.0.1"
_BUFFER = 1 << 16  # [bytes] of the sockets: small, because their data has not been sent
_READ = 1 << 14  # [bytes] maximum read at once


@dataclass(slots=True)
class _Way:
    """One direction of a connection between two sockets."""

    source: socket.socket
    to: socket.socket
    stream: Stream
    ready: bytearray = field(default_factory=bytearray)  # received, but not accepted by the target yet
    over: bool = False  # the source has closed
    done: bool = False  # the target was notified of that


class _Relay:
    def __init__(self, link: Link, seed: int, behind: list[int]):
        self._from_robot, self._to_robot = RadioOutages(link, seed), RadioOutages(link, seed + 1)
        self._ways: list[_Way] = []
        self._cut = False
        self._listeners = {self._listener(): port for port in behind}

    def ports(self) -> list[int]:
        return [listener.getsockname()[1] for listener in self._listeners]

    def run(self) -> None:
        """Forward until standard input ends."""
        while True:
            with selectors.DefaultSelector() as selector:
                self._watch(selector)
                ready = {key.fileobj for key, _ in selector.select(self._wait_s())}
            if sys.stdin in ready and not self._obey(os.read(sys.stdin.fileno(), 4096).decode()):
                return
            for listener, port in self._listeners.items():
                if listener in ready:
                    self._connect(listener.accept()[0], port)
            now_ns = time.monotonic_ns()
            for way in self._ways:
                if way.source in ready and not way.over and way.stream.waiting < QUEUE_BYTES:
                    self._take(way, now_ns)
                self._give(way, now_ns)
            self._forget()

    def _watch(self, selector: selectors.BaseSelector) -> None:
        """Register all sockets that are to be read or written."""
        selector.register(sys.stdin, selectors.EVENT_READ)
        if not self._cut:  # new connections wait during an outage
            for listener in self._listeners:
                selector.register(listener, selectors.EVENT_READ)
        wanted: dict[socket.socket, int] = {}
        for way in self._ways:
            if not way.over and way.stream.waiting < QUEUE_BYTES:
                wanted[way.source] = wanted.get(way.source, 0) | selectors.EVENT_READ
            if way.ready:
                wanted[way.to] = wanted.get(way.to, 0) | selectors.EVENT_WRITE
        for one, events in wanted.items():
            selector.register(one, events)

    def _wait_s(self) -> float | None:
        due = [way.stream.due_ns for way in self._ways if way.stream.due_ns is not None]
        return max(min(due) - time.monotonic_ns(), 0) * 1e-9 if due else None

    def _connect(self, near: socket.socket, port: int) -> None:
        far = socket.socket()
        for one in (near, far):
            one.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            one.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER)
            one.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER)
        try:
            far.connect((HERE, port))
        except OSError:  # no listener yet
            near.close()
            far.close()
            return
        near.setblocking(False)
        far.setblocking(False)
        self._ways += [_Way(near, far, Stream(self._to_robot)), _Way(far, near, Stream(self._from_robot))]

    def _take(self, way: _Way, now_ns: int) -> None:
        try:
            data = way.source.recv(_READ)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        way.over = not data
        way.stream.send(data, now_ns)

    def _give(self, way: _Way, now_ns: int) -> None:
        way.ready += way.stream.arrived(now_ns)
        try:
            while way.ready:
                del way.ready[: way.to.send(way.ready)]
        except BlockingIOError:
            return
        except OSError:  # the target has closed
            way.ready.clear()
            way.over = way.done = True
            return
        if way.over and not way.done and not way.stream.waiting and not self._cut:
            way.done = True
            with contextlib.suppress(OSError):
                way.to.shutdown(socket.SHUT_WR)

    def _forget(self) -> None:
        """Close connections that have ended in both directions."""
        over = [way for way in self._ways if way.done]
        for way in over:
            if any(other.source is way.to and other.done for other in over):
                way.source.close()
        self._ways = [way for way in self._ways if way.source.fileno() >= 0 and way.to.fileno() >= 0]

    def _obey(self, said: str) -> bool:
        """Execute the commands in some lines; return whether to continue."""
        airs = (self._from_robot, self._to_robot)
        for order in orders.read(said):
            now_ns = time.monotonic_ns()
            for air in airs:
                if order == orders.CUT:
                    air.cut()
                elif order == orders.MEND:
                    air.mend(now_ns)
            self._cut = self._cut if order == orders.ASK else order == orders.CUT
            orders.answer(now_ns, [(air.carried, air.packets, air.lost) for air in airs])
        return bool(said)

    @staticmethod
    def _listener() -> socket.socket:
        listener = socket.create_server((HERE, 0))
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER)
        return listener


def main() -> int:
    """Forward connections until standard input ends."""
    parser = orders.parser("benchmarks.net_testbed.tcp_relay", __doc__)
    parser.add_argument(
        "--to", type=int, action="append", required=True, help="local port to forward to; the relay opens one port for each"
    )
    arguments = parser.parse_args()
    relay = _Relay(*orders.radio(arguments), arguments.to)
    go_first()  # high priority if permitted: a real radio is not delayed by programs
    orders.say(" ".join(map(str, relay.ports())))
    relay.run()
    return 0


if __name__ == "__main__":
    sys.exit(main())
