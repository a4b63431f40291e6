"""Says on the console whom the router of this process refuses: counted, as the word of a service `router`."""

import os
import sys
import time
from collections.abc import Callable, Mapping
from types import TracebackType
from typing import Self, TextIO

import numpy as np

from sextant.deploy.network.refusals import Refusals
from sextant.shared.wire import codec, topics
from sextant.shared.wire.messages import Health
from sextant.shared.wire.transport import Endpoints, ZenohLink, without_source

_PERIOD_NS = 1_000_000_000
_SOON_NS = 200_000_000  # between two words where there is news
_ROOM = 1 << 20  # [B] of the log after which it begins anew
_MOST = 4 << 20  # [B] that are read at once; of a flood the rest is passed over


class CaughtOutput:
    """What this process writes to its standard output from now on, in memory: whoever writes there is never held up.

    Zenoh's log goes there, from the threads that receive, and a pipe that nobody empties in time would stop them.
    """

    def __init__(self) -> None:
        self._file = os.memfd_create("log of zenoh")
        self._before = os.dup(1)
        self._read = 0

    def __enter__(self) -> Self:
        sys.stdout.flush()
        os.set_inheritable(self._file, False)
        writing = os.open(f"/proc/self/fd/{self._file}", os.O_WRONLY | os.O_APPEND)
        os.dup2(writing, 1)
        os.close(writing)
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        os.dup2(self._before, 1)
        os.close(self._before)
        os.close(self._file)

    def take(self) -> str:
        """What has been written since, whole lines."""
        size = os.fstat(self._file).st_size
        data = os.pread(self._file, min(size - self._read, _MOST), self._read)
        whole = data.rfind(b"\n") + 1
        self._read += whole
        if size - self._read > _MOST or (self._read == size and size > _ROOM):
            os.ftruncate(self._file, 0)  # who appends goes on at the beginning
            self._read = 0
        return data[:whole].decode(errors="replace")


class Gatekeeper:
    """Looks at the log now and then, and says once a second, and at once when there is news, what was refused."""

    def __init__(
        self,
        take: Callable[[], str],
        send: Callable[[Health], None],
        name: str,
        namespace: str,
        doing: str,
        out: TextIO,
        refused: Callable[[], Mapping[str, int]] = dict,
    ):
        """Begin.

        Args:
            take: What was logged since it was last asked.
            send: Publishes.
            name: Of the router, among the services.
            namespace: Prefix of every key.
            doing: What the router does, in words.
            out: Where what is no refusal goes, as it is.
            refused: Returns how many connections were refused since its last call, by kind.
        """
        self.refusals = Refusals(namespace)
        self._take, self._send, self._name, self._doing, self._out = take, send, name, doing, out
        self._refused = refused
        self._said_ns = -_PERIOD_NS
        self._told: set[str] = set()  # kinds that the terminal knows
        self._known = 0

    def look(self, now_ns: int) -> str:
        """See what was refused; a line for the terminal where it is of a new kind, or nothing."""
        for line in self.refusals.read(self._take()):
            self._out.write(without_source(line) + "\n")
        for kind, number in self._refused().items():
            self.refusals.add(kind, number)
        total = self.refusals.count.total()
        news, self._known = total != self._known, total
        if now_ns - self._said_ns >= (_SOON_NS if news else _PERIOD_NS):
            self._said_ns = now_ns
            self._send(self._health(now_ns))
        new = [kind for kind in self.refusals.count if kind not in self._told]
        self._told.update(new)  # kinds are bounded in number (`sextant.deploy.network.refusals`)
        return f"refused: {', '.join(new)}" if new else ""

    def _health(self, now_ns: int) -> Health:
        refused = f"; refused: {self.refusals.words()}" if self.refusals.count else ""
        last = f"refused: {self.refusals.newest}" if self.refusals.newest else ""
        nothing = np.zeros(0)
        count = self.refusals.count.total()
        return Health(now_ns, self._name, (self._doing + refused)[:500], 0, count, 0, last, (), nothing, nothing)


def publish(link: ZenohLink, role: str) -> Callable[[Health], None]:
    """What publishes the health of a router by a link, as that of a machine of a role."""
    return lambda health: link.send(
        topics.HEALTH_OF[role], codec.encode(health, codec.Timing(health.stamp_ns, time.monotonic_ns()))
    )


def link_to(endpoint: str, namespace: str) -> ZenohLink:
    """A link of this process to its own router."""
    return ZenohLink(Endpoints((endpoint,), namespace=namespace))
