"""Whether somebody listens on a TCP port of this machine; imports nothing that takes long."""

import contextlib
import socket


def port_taken(port: int) -> bool:
    """Whether somebody listens on a TCP port of 127.0.0.1; found out without connecting, for a servo bus has one client."""
    with contextlib.closing(socket.socket()) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # closed connections that linger do not count
        try:
            probe.bind(("127.0.0.1", port))
        except OSError:
            return True
    return False
