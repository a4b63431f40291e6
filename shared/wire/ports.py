"""TCP ports of this machine: which are taken, and free ones; imports nothing that takes long."""

import contextlib
import random
import socket
from collections import deque

from sextant.shared.errors import SextantError

# Below the kernel's ephemeral ports (32768 and up), so that no outgoing connection takes one in the meantime.
_PORTS = range(20_000, 32_000)
_ATTEMPTS = 100
_given: deque[int] = deque(maxlen=1000)  # ports that this process returned lately


class NoFreePortError(SextantError, RuntimeError):
    """No free port was found."""


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


def free_port() -> int:
    """Return an unused TCP port of 127.0.0.1, a different one at each call.

    Callers often request several ports before they open the first one.

    Raises:
        NoFreePortError: None was found.
    """
    chooser = random.SystemRandom()
    for _ in range(_ATTEMPTS):
        port = chooser.choice(_PORTS)
        if port not in _given and not port_taken(port):
            _given.append(port)
            return port
    raise NoFreePortError(f"no free TCP port in {_PORTS.start} to {_PORTS.stop} on 127.0.0.1; close programs that listen there")
