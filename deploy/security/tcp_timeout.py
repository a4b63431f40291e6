"""Limit how long this process's connections wait for acknowledgements.

If a link died with unsent data, Zenoh closes it in a call that blocks until the other machine has received the data. The call
blocks for up to 10 s (SO_LINGER, not configurable in 1.10: eclipse-zenoh/zenoh#2547). Meanwhile, it accepts no connection: a
robot took up to 4.5 s to walk again after its radio was back. The kernel drops such a connection after TCP_USER_TIMEOUT; then
closing it does not block any more.
"""

import errno
import socket
from pathlib import Path

_DESCRIPTORS = Path("/proc/self/fd")  # Linux only; elsewhere, nothing is limited
_INTERNET = (socket.AF_INET, socket.AF_INET6)
_GONE = (errno.EBADF, errno.ENOTSOCK)  # for a descriptor that was closed, and may be a file by now


class TcpTimeout:
    """Closes this process's TCP connections after a time without acknowledgement.

    Sockets accepted by a listening socket inherit its limit. Sockets of outgoing connections get it at the next `look`.
    """

    def __init__(self, limit_s: float):
        """Initialise; no limit applies before the first `look`.

        Args:
            limit_s: [s] without acknowledgement of sent data.
        """
        self._limit_ms = round(1e3 * limit_s)
        self._known: dict[str, str] = {}  # file descriptor -> name of the socket

    def look(self) -> None:
        """Limit the sockets opened since the last call."""
        found = _open_sockets()
        for number, name in found.items():
            if self._known.get(number) != name:
                _limit(int(number), self._limit_ms)
        self._known = found


def _open_sockets() -> dict[str, str]:
    """Return the names of this process's sockets by file descriptor."""
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
    """Limit one socket, if it still exists and uses TCP."""
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
        borrowed.detach()  # the owner closes the descriptor
