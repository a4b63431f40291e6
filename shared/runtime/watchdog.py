"""Watchdog notifications of a process, with systemd's protocol.

See sd_notify(3) and sd_watchdog_enabled(3).

With `Type=notify` and `WatchdogSec=` in its unit, systemd restarts a process that hangs. The launcher in `deploy` uses the same
protocol. Without a supervisor the watchdog does nothing.
"""

import contextlib
import os
import socket
from collections.abc import Mapping
from typing import Self

_PERIOD_NS = 250_000_000  # [ns] between two notifications, or a third of the supervisor's timeout if that is shorter


class Watchdog:
    """Notifies the supervisor that the working thread runs; a context manager."""

    def __init__(self, environment: Mapping[str, str]):
        """Read the supervisor's settings.

        Args:
            environment: NOTIFY_SOCKET is the path of a socket, or `@` and its abstract name. WATCHDOG_USEC is the timeout
                [us]. WATCHDOG_PID is the process that it applies to. Without NOTIFY_SOCKET nothing is sent. Without
                WATCHDOG_USEC only the notification of the start is sent.

        Raises:
            ValueError: WATCHDOG_USEC is not a number.
        """
        address = environment.get("NOTIFY_SOCKET", "")
        self._address = "\0" + address[1:] if address.startswith("@") else address
        self._period_ns = _period_ns(environment)
        self._due_ns = 0
        self._words = [b"READY=1", *([b"WATCHDOG=1"] if self._period_ns else [])]
        self._socket: socket.socket | None = None
        if address.startswith(("/", "@")):  # other addresses (as of a virtual machine's host) are not supported
            self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
            self._socket.setblocking(False)  # a supervisor that hangs must not block this process

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """Close the socket."""
        if self._socket is not None:
            self._socket.close()

    def beat(self, now_ns: int) -> None:
        """Send a notification if it is due at a time [ns] of a monotonic clock."""
        if self._socket is None or not self._words or now_ns < self._due_ns:
            return
        self._due_ns = now_ns + (self._period_ns or _PERIOD_NS)
        # If the supervisor has ended or does not read, the process continues without it.
        with contextlib.suppress(OSError):
            self._socket.sendto(b"\n".join(self._words), self._address)
            self._words = [word for word in self._words if word != b"READY=1"]


def _period_ns(environment: Mapping[str, str]) -> int:
    """Return the period of the notifications [ns], 0 for none."""
    asked = environment.get("WATCHDOG_USEC") or "0"
    if not asked.isdecimal():
        raise ValueError(f"WATCHDOG_USEC: microseconds as a whole number expected, found {asked!r}; leave it out")
    if environment.get("WATCHDOG_PID", str(os.getpid())) != str(os.getpid()):
        return 0
    return min(_PERIOD_NS, int(asked) * 1000 // 3)
