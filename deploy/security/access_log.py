"""Access log of this process's router.

Refusals are counted and published as the health of a service `router`.
"""

import os
import sys
import time
from collections.abc import Callable, Mapping
from types import TracebackType
from typing import Self, TextIO

import numpy as np

from sextant.deploy.security.refusals import Refusals
from sextant.shared.wire import codec, topics
from sextant.shared.wire.messages import Health
from sextant.shared.wire.transport import Endpoints, ZenohLink, without_source

_PERIOD_NS = 1_000_000_000
_SOON_NS = 200_000_000  # minimum time between two messages if there is a new refusal
_ROOM = 1 << 20  # [B] size of the log after which the file is truncated
_MOST = 4 << 20  # [B] maximum read at once; the rest of a flood is skipped


class CaughtOutput:
    """Capture this process's standard output in memory, so that writers never block.

    Zenoh's receive threads write their log there. A pipe that is not emptied in time would block them.
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
        """Return the complete lines written since the last call."""
        size = os.fstat(self._file).st_size
        data = os.pread(self._file, min(size - self._read, _MOST), self._read)
        whole = data.rfind(b"\n") + 1
        self._read += whole
        if size - self._read > _MOST or (self._read == size and size > _ROOM):
            os.ftruncate(self._file, 0)  # later appends start at the beginning
            self._read = 0
        return data[:whole].decode(errors="replace")


class RouterHealthReporter:
    """Reader of the router's log; it publishes refusals once a second and on news."""

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
        """Initialise without publishing.

        Args:
            take: Returns the log since its last call.
            send: Publishes the health message.
            name: Service name of the router.
            namespace: Prefix of every key.
            doing: Status text of the router.
            out: Receives the log lines that are no refusals.
            refused: Returns the number of connections refused since its last call, by kind.
        """
        self.refusals = Refusals(namespace)
        self._take, self._send, self._name, self._doing, self._out = take, send, name, doing, out
        self._refused = refused
        self._said_ns = -_PERIOD_NS
        self._told: set[str] = set()  # kinds already shown on the terminal
        self._known = 0

    def look(self, now_ns: int) -> str:
        """Process new refusals.

        Return a line for the terminal if there is a new kind, or an empty string.
        """
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
        self._told.update(new)  # the number of kinds is bounded (`sextant.deploy.security.refusals`)
        return f"refused: {', '.join(new)}" if new else ""

    def _health(self, now_ns: int) -> Health:
        refused = f"; refused: {self.refusals.words()}" if self.refusals.count else ""
        last = f"refused: {self.refusals.newest}" if self.refusals.newest else ""
        nothing = np.zeros(0)
        count = self.refusals.count.total()
        return Health(now_ns, self._name, (self._doing + refused)[:500], 0, count, 0, last, (), nothing, nothing)


def publish(link: ZenohLink, role: str) -> Callable[[Health], None]:
    """Return a function that publishes the router's health for a role's machine."""
    return lambda health: link.send(
        topics.HEALTH_OF[role], codec.encode(health, codec.Timing(health.stamp_ns, time.monotonic_ns()))
    )


def link_to(endpoint: str, namespace: str) -> ZenohLink:
    """Open a link from this process to its own router."""
    return ZenohLink(Endpoints((endpoint,), namespace=namespace))
