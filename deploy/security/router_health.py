"""Health of a router, with the connections that its TLS proxy has refused.

It is published as the health of a service `router`. Messages that a connected client may not send are not among them: Zenoh
drops these without a report, and a client knows its own permissions (`sextant.shared.wire.access`).
"""

import threading
import time
from collections import Counter
from collections.abc import Callable

import numpy as np

from sextant.shared.wire import codec, topics
from sextant.shared.wire.messages import Health
from sextant.shared.wire.transport import Endpoints, ZenohLink

_PERIOD_NS = 1_000_000_000
_SOON_NS = 200_000_000  # minimum time between two messages if there is a new refusal
_KINDS = 64  # maximum number of kinds: all further ones share one
_OTHERS = "other kinds"
_MAX_STATUS = 500  # characters


class RefusedConnections:
    """Thread-safe counter of refused connections, by kind."""

    def __init__(self) -> None:
        self._count: Counter[str] = Counter()
        self._newest = ""
        self._lock = threading.Lock()

    def add(self, kind: str) -> None:
        """Count one refusal."""
        with self._lock:
            if kind not in self._count and len(self._count) >= _KINDS:
                kind = _OTHERS
            self._count[kind] += 1
            self._newest = kind

    def read(self) -> tuple[Counter[str], str]:
        """Return the counts so far, and the newest kind or an empty string."""
        with self._lock:
            return self._count.copy(), self._newest


class RouterHealthReporter:
    """Publishes a router's health once a second, and soon after a refusal."""

    def __init__(self, refused: RefusedConnections, send: Callable[[Health], None], name: str, doing: str):
        """Initialise without publishing.

        Args:
            refused: Counts the refused connections.
            send: Publishes the health message.
            name: Service name of the router.
            doing: Status text of the router.
        """
        self._refused, self._send, self._name, self._doing = refused, send, name, doing
        self._sent_ns = -_PERIOD_NS
        self._reported: set[str] = set()  # kinds already shown on the terminal
        self._total = 0

    def beat(self, now_ns: int) -> str:
        """Publish the health if it is due.

        Return a line for the terminal if connections of a new kind were refused, else an empty string.
        """
        count, newest = self._refused.read()
        news, self._total = count.total() != self._total, count.total()
        if now_ns - self._sent_ns >= (_SOON_NS if news else _PERIOD_NS):
            self._sent_ns = now_ns
            self._send(self._health(now_ns, count, newest))
        new = [kind for kind in count if kind not in self._reported]
        self._reported.update(new)
        return f"refused: {', '.join(new)}" if new else ""

    def _health(self, now_ns: int, count: Counter[str], newest: str) -> Health:
        kinds = ", ".join(f"{kind}: {number} times" for kind, number in count.most_common())
        doing = f"{self._doing}; refused: {kinds}" if count else self._doing
        last = f"refused: {newest}" if newest else ""
        nothing = np.zeros(0)
        return Health(now_ns, self._name, doing[:_MAX_STATUS], 0, count.total(), 0, last, (), nothing, nothing)


def publish(link: ZenohLink, role: str) -> Callable[[Health], None]:
    """Return a function that publishes the router's health for a role's machine."""
    return lambda health: link.send(
        topics.HEALTH_OF[role], codec.encode(health, codec.Timing(health.stamp_ns, time.monotonic_ns()))
    )


def link_to(endpoint: str, namespace: str) -> ZenohLink:
    """Open a link from this process to its own router."""
    return ZenohLink(Endpoints((endpoint,), namespace=namespace))
