"""Watchdog listener: receives signs of life by systemd's protocol, sd_notify(3).

It measures how long each watched process has been silent.
"""

import contextlib
import socket
import struct
from collections.abc import Mapping
from math import inf

LOOK_S = 0.1  # [s] nominal interval of `look`
_SEEN_S = 5 * LOOK_S  # [s] most that one look adds: a watcher that was suspended must not blame the watched
_CREDENTIALS = struct.Struct("3i")  # Linux' struct ucred: process, user, group
_LONGEST = 4096  # [bytes] of a datagram


def is_supported() -> bool:
    """Return whether this system reports the sender of a datagram; Linux does."""
    return hasattr(socket, "SO_PASSCRED") and hasattr(socket, "SCM_CREDENTIALS")


class WatchdogListener:
    """A socket that receives signs of life, and how long each process has been silent.

    The kernel chooses its abstract name, so no file is left behind, however this process ends. The kernel also reports the
    sender's process id, so no process can send signs of life for another one.
    """

    def __init__(self, now_s: float):
        """Open the socket at a time [s]."""
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_PASSCRED, 1)
        self._socket.bind("")  # Linux: an unused abstract name
        self._looked_s = now_s
        self._silent_s: dict[int, float] = {}  # by process id; -inf before the first sign

    def environment(self, patience_s: float) -> Mapping[str, str]:
        """Return the environment of a process that must send signs of life.

        `patience_s` is the longest time [s] between two signs.
        """
        name = self._socket.getsockname()[1:].decode("ascii")
        return {"NOTIFY_SOCKET": f"@{name}", "WATCHDOG_USEC": str(round(patience_s * 1e6))}

    def watch(self, pid: int) -> None:
        """Watch a process; its silence counts only after its first sign of life."""
        self._silent_s[pid] = -inf

    def forget(self, pid: int) -> None:
        """Stop watching a process."""
        self._silent_s.pop(pid, None)

    def silent_s(self, pid: int) -> float:
        """Return how long [s] a process has been silent, as of the last look.

        It is -inf before the first sign of life.
        """
        return self._silent_s.get(pid, -inf)

    def look(self, now_s: float) -> None:
        """Receive the signs of life that arrived by a time [s]."""
        passed, self._looked_s = min(now_s - self._looked_s, _SEEN_S), now_s
        for pid in self._silent_s:
            self._silent_s[pid] += passed
        for pid in self._senders():
            if pid in self._silent_s:
                self._silent_s[pid] = 0.0

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()

    def _senders(self) -> set[int]:
        senders: set[int] = set()
        with contextlib.suppress(BlockingIOError):  # the queue is empty
            while True:
                _, ancillary, _, _ = self._socket.recvmsg(_LONGEST, socket.CMSG_SPACE(_CREDENTIALS.size))
                senders |= {_CREDENTIALS.unpack(data)[0] for _, kind, data in ancillary if kind == socket.SCM_CREDENTIALS}
        return senders


def unwatched(environment: Mapping[str, str]) -> dict[str, str]:
    """Return an environment without the variables of this process's own watchdog."""
    return {key: value for key, value in environment.items() if key not in ("NOTIFY_SOCKET", "WATCHDOG_USEC", "WATCHDOG_PID")}
