"""How long connections of this process wait for a machine that no longer acknowledges anything.

Zenoh closes a link that died with something unsent in a call that blocks until the other machine has taken it, for up to 10 s
(SO_LINGER, not configurable in 1.10: eclipse-zenoh/zenoh#2547), and lets nobody in meanwhile: a robot whose radio was back
walked again after up to 4.5 s. The kernel gives such a connection up after TCP_USER_TIMEOUT; then closing it blocks no more.
"""

import errno
import socket
from pathlib import Path

_DESCRIPTORS = Path("/proc/self/fd")  # of Linux; elsewhere nothing is limited
_INTERNET = (socket.AF_INET, socket.AF_INET6)
_GONE = (errno.EBADF, errno.ENOTSOCK)  # of a descriptor that was closed, and perhaps is a file by now


class SilenceLimit:
    """Gives up TCP connections of this process on which nothing sent was acknowledged for a while, whoever opened them.

    Those that a listening socket accepts have its limit from the beginning; those that are opened get it at the next look.
    """

    def __init__(self, limit_s: float):
        """Limit nothing before the first look.

        Args:
            limit_s: [s] without acknowledgement of something that was sent.
        """
        self._limit_ms = round(1e3 * limit_s)
        self._known: dict[str, str] = {}  # socket by file descriptor

    def look(self) -> None:
        """Limit what has been opened since the last look."""
        found = _open_sockets()
        for number, name in found.items():
            if self._known.get(number) != name:
                _limit(int(number), self._limit_ms)
        self._known = found


def _open_sockets() -> dict[str, str]:
    """Names of this process' sockets by file descriptor."""
    found: dict[str, str] = {}
    for descriptor in _DESCRIPTORS.iterdir() if _DESCRIPTORS.is_dir() else ():
        try:
            target = str(descriptor.readlink())
        except FileNotFoundError:  # closed in the meantime
            continue
        if target.startswith("socket:"):
            found[descriptor.name] = target
    return found


def _limit(number: int, limit_ms: int) -> None:
    """Limit one socket, if it is still there and one of TCP."""
    try:
        borrowed = socket.socket(fileno=number)
    except OSError as error:
        if error.errno not in _GONE:
            raise
        return
    try:
        if borrowed.family in _INTERNET and borrowed.type == socket.SOCK_STREAM:
            borrowed.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, limit_ms)
    except OSError as error:
        if error.errno not in _GONE:
            raise
    finally:
        borrowed.detach()  # it is its owner who closes it
