"""Signs of life for whoever watches over this process, by systemd's protocol: sd_notify(3), sd_watchdog_enabled(3).

`Type=notify` and `WatchdogSec=` in a unit suffice to have a process that hangs ended and started again; the launcher of
`deploy` speaks the same. Where nobody watches, it costs nothing.
"""

import contextlib
import os
import socket
from collections.abc import Mapping
from typing import Self

_PERIOD_NS = 250_000_000  # [ns] between two signs, or a third of what the watcher waits where that is less


class Watchdog:
    """Tells the watcher that the loop runs, from the thread that does the work, so that a hang shows; a context manager."""

    def __init__(self, environment: Mapping[str, str]):
        """Take up what the watcher asks for.

        Args:
            environment: NOTIFY_SOCKET, a socket's path or `@` and its abstract name; WATCHDOG_USEC, how long the watcher
                waits [us]; WATCHDOG_PID, whom it means. Without the first nobody is told anything, without the second
                only that the work begins.

        Raises:
            ValueError: WATCHDOG_USEC is no number.
        """
        address = environment.get("NOTIFY_SOCKET", "")
        self._address = "\0" + address[1:] if address.startswith("@") else address
        self._period_ns = _period_ns(environment)
        self._due_ns = 0
        self._words = [b"READY=1", *([b"WATCHDOG=1"] if self._period_ns else [])]
        self._socket: socket.socket | None = None
        if address.startswith(("/", "@")):  # others, as of a virtual machine's host, no service manager of ours gives
            self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
            self._socket.setblocking(False)  # a watcher that hangs must not hang the watched

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """Say no more."""
        if self._socket is not None:
            self._socket.close()

    def beat(self, now_ns: int) -> None:
        """Say that the loop runs, if it is time, at a time [ns] of a monotonic clock."""
        if self._socket is None or not self._words or now_ns < self._due_ns:
            return
        self._due_ns = now_ns + (self._period_ns or _PERIOD_NS)
        # A watcher that has gone or does not read its mail: there is nobody to tell, and the work goes on.
        with contextlib.suppress(OSError):
            self._socket.sendto(b"\n".join(self._words), self._address)
            self._words = [word for word in self._words if word != b"READY=1"]


def _period_ns(environment: Mapping[str, str]) -> int:
    """How often to give a sign [ns], 0 for never."""
    asked = environment.get("WATCHDOG_USEC") or "0"
    if not asked.isdecimal():
        raise ValueError(f"WATCHDOG_USEC: microseconds as a whole number expected, found {asked!r}; leave it out")
    if environment.get("WATCHDOG_PID", str(os.getpid())) != str(os.getpid()):
        return 0
    return min(_PERIOD_NS, int(asked) * 1000 // 3)
