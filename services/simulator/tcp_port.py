"""The emulated servo bus on a TCP port, as a serial-to-network adapter would offer it: `socket://host:port` for pyserial."""

import logging
import select
import socket
import threading
import time
from collections import deque
from collections.abc import Callable
from types import TracebackType

from services.simulator.bus import Reply, ServoBusEmulator

log = logging.getLogger(__name__)

_CHUNK = 4096  # [bytes]
_SEC = 1e9
_STOP_TIMEOUT = 2.0  # [s]


class TcpBusServer:
    """Serves an emulated bus to one client at a time, from a thread of its own; answers leave when they are due.

    Whoever steps the physics must hold `lock` around `ServoBusEmulator.advance` and the bank's step: the servos are shared.
    """

    def __init__(
        self,
        bus: ServoBusEmulator,
        *,
        host: str = "127.0.0.1",
        port: int = 0,
        clock: Callable[[], int] = time.monotonic_ns,
        answering: Callable[[], bool] = lambda: True,
    ) -> None:
        """Listen and start serving.

        Args:
            bus: The emulated bus.
            host: Address to listen on.
            port: Port to listen on, 0 for a free one.
            clock: Bus time [ns]; it must run at real time, for answers are held back until it reaches them.
            answering: Whether the physics is up to date; while it is not the servos stay silent, rather than tell where
                they were some time ago.

        Raises:
            OSError: The address cannot be listened on.
        """
        self.lock = threading.Lock()
        self.clients = 0  # connections taken so far
        self._bus = bus
        self._clock = clock
        self._answering = answering
        self._listener = socket.create_server((host, port), backlog=1)
        self._wake, self._woken = socket.socketpair()
        self._closing = False
        self._thread = threading.Thread(target=self._serve, name="servo-bus", daemon=True)
        self._thread.start()

    @property
    def address(self) -> tuple[str, int]:
        """Host and port being listened on."""
        host, port = self._listener.getsockname()[:2]
        return str(host), int(port)

    @property
    def url(self) -> str:
        """What to open with pyserial."""
        host, port = self.address
        return f"socket://{host}:{port}"

    def close(self) -> None:
        """Hang up, stop listening and wait for the thread; safe to call twice."""
        if self._closing:
            return
        self._closing = True
        self._wake.send(b"x")
        self._thread.join(_STOP_TIMEOUT)
        for end in (self._listener, self._wake, self._woken):
            end.close()

    def __enter__(self) -> "TcpBusServer":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    def _serve(self) -> None:
        while not self._closing:
            ready, _, _ = select.select([self._listener, self._woken], [], [])
            if self._woken in ready:
                return
            client, peer = self._listener.accept()
            self.clients += 1
            log.info("servo bus client %s connected", peer)
            with client:
                client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                reason = self._talk(client)
            log.info("servo bus client %s left: %s", peer, reason)

    def _talk(self, client: socket.socket) -> str:
        """Serve one client until it leaves or the server closes; return why it ended."""
        replies: deque[Reply] = deque()
        try:
            while True:
                wait = (replies[0].due_ns - self._clock()) / _SEC if replies else None
                ready, _, _ = select.select([client, self._woken], [], [], None if wait is None else max(wait, 0.0))
                if self._woken in ready:
                    return "server closed"
                if client in ready:
                    data = client.recv(_CHUNK)
                    if not data:
                        return "client hung up"
                    with self.lock:
                        answers = self._bus.receive(data, self._clock())
                    replies.extend(answers if self._answering() else ())
                due = bytearray()
                now = self._clock()
                while replies and replies[0].due_ns <= now:
                    due += replies.popleft().data
                if due:
                    client.sendall(due)
        except OSError as error:  # reset or broken pipe: the client went away without a word
            return str(error)
