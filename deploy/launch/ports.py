"""Check whether a local TCP port is in use; imports nothing that takes long."""

import contextlib
import socket


def port_taken(port: int) -> bool:
    """Return whether a process listens on a TCP port of 127.0.0.1.

    The check does not connect, because a servo bus accepts only one client.
    """
    with contextlib.closing(socket.socket()) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # ignore closed connections in TIME_WAIT
        try:
            probe.bind(("127.0.0.1", port))
        except OSError:
            return True
    return False
