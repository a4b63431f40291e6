"""Hears the signs of life of watched processes, by systemd's protocol (sd_notify(3)), and counts for how long none came."""

import contextlib
import socket
import struct
from collections.abc import Mapping
from math import inf

LOOK_S = 0.1  # [s] between two looks that the counting is made for
_SEEN_S = 5 * LOOK_S  # [s] that one look counts at most: where the watcher itself was away, the watched may have been too
_CREDENTIALS = struct.Struct("3i")  # Linux' struct ucred: process, user, group
_LONGEST = 4096  # [bytes] of a datagram


class Pulses:
    """A socket that processes give signs of life at, and how long each has been silent.

    Its name is abstract and the kernel's choice: nothing is left behind in a file system, whatever ends this process. The
    kernel says which process sent what, so none speaks for another.
    """

    def __init__(self, now_s: float):
        """Open it at a time [s]."""
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_PASSCRED, 1)
        self._socket.bind("")  # Linux: a free abstract name
        self._looked_s = now_s
        self._silent_s: dict[int, float] = {}  # by process id; -inf before the first sign

    def environment(self, patience_s: float) -> Mapping[str, str]:
        """What a process is started with that is to give signs of life more often than every so many seconds."""
        name = self._socket.getsockname()[1:].decode("ascii")
        return {"NOTIFY_SOCKET": f"@{name}", "WATCHDOG_USEC": str(round(patience_s * 1e6))}

    def watch(self, pid: int) -> None:
        """Listen for a process; what has not given its first sign yet is starting, and not late."""
        self._silent_s[pid] = -inf

    def forget(self, pid: int) -> None:
        """No longer listen for a process."""
        self._silent_s.pop(pid, None)

    def silent_s(self, pid: int) -> float:
        """For how long [s], as of the last look, a process has given no sign since its last; -inf before its first."""
        return self._silent_s.get(pid, -inf)

    def look(self, now_s: float) -> None:
        """Hear what has come by a time [s]."""
        passed, self._looked_s = min(now_s - self._looked_s, _SEEN_S), now_s
        for pid in self._silent_s:
            self._silent_s[pid] += passed
        for pid in self._senders():
            if pid in self._silent_s:
                self._silent_s[pid] = 0.0

    def close(self) -> None:
        """Hear no more."""
        self._socket.close()

    def _senders(self) -> set[int]:
        senders: set[int] = set()
        with contextlib.suppress(BlockingIOError):  # all is heard
            while True:
                _, ancillary, _, _ = self._socket.recvmsg(_LONGEST, socket.CMSG_SPACE(_CREDENTIALS.size))
                senders |= {_CREDENTIALS.unpack(data)[0] for _, kind, data in ancillary if kind == socket.SCM_CREDENTIALS}
        return senders


def unwatched(environment: Mapping[str, str]) -> dict[str, str]:
    """An environment without what a watcher of this process has put there for it alone."""
    return {key: value for key, value in environment.items() if key not in ("NOTIFY_SOCKET", "WATCHDOG_USEC", "WATCHDOG_PID")}
