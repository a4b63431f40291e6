"""The emulated servo bus on a TCP port, as a serial-to-network adapter would offer it: `socket://host:port` for pyserial."""

import logging
import select
import socket
import threading
from collections.abc import Callable
from types import TracebackType

from sextant.services.simulator.servo_bus.host_link import Outbox, Outlet, Reply, Wire
from sextant.shared.runtime.clock import now_ns
from sextant.shared.runtime.simulated_time import REACTION_NS, SERVO_BUS, hold

log = logging.getLogger(__name__)

_CHUNK = 4096  # [bytes]
_SEC = 1e9
_STOP_TIMEOUT = 2.0  # [s]
_BREATH_NS = 500_000  # [ns] between two looks at an end that speaks of itself


class TcpBusServer:
    """Serves an emulated bus to one client at a time, from a thread of its own; answers leave when they are due.

    Whoever steps the physics must hold `lock` around `ServoBusEmulator.advance` and the bank's step: the servos are shared. An
    adapter that is unplugged hangs up and listens no more; under another name it is back on the other port.
    """

    def __init__(
        self,
        bus: Wire,
        *,
        host: str = "127.0.0.1",
        port: int = 0,
        other_port: int = 0,
        clock: Callable[[], int] = now_ns,
        answering: Callable[[int], bool] = lambda _now_ns: True,
        turns_away: bool = False,
    ) -> None:
        """Listen and start serving.

        Args:
            bus: The emulated bus.
            host: Address to listen on.
            port: Port to listen on, 0 for a free one.
            other_port: Port to listen on when the bus is back under another name, and so to and fro.
            clock: Bus time [ns]; answers are held back until it reaches them. It is never faster than real time.
            answering: Whether the physics is up to date at a bus time [ns]; while it is not, the servos stay silent
                rather than report where they were some time ago.
            turns_away: Hang up on whoever comes while somebody is connected; else they wait until that one has left.

        Raises:
            OSError: The address cannot be listened on.
        """
        self.lock = threading.Lock()
        self.clients = 0  # connections taken so far
        self._bus = bus
        self._speaks = bus.due_ns is not None  # of itself, too
        self._clock = clock
        self._answering = answering
        self._turns_away = turns_away
        self._host, self._ports = host, [port, other_port]
        self._outlet: Outlet | None = Outlet()
        self._listener: socket.socket | None = self._listen(Outlet())
        self._wake, self._woken = socket.socketpair()
        self._closing = False
        self._thread = threading.Thread(target=self._serve, name="servo-bus", daemon=True)
        self._thread.start()

    @property
    def address(self) -> tuple[str, int]:
        """Host and port being listened on, or listened on last."""
        return self._address

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
            if end is not None:
                end.close()

    def replug(self) -> None:
        """Look whether the adapter was plugged in or out, and hang up if so."""
        self._wake.send(b"x")

    def __enter__(self) -> "TcpBusServer":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    def _serve(self) -> None:
        while not self._closing:
            self._follow(self._bus.outlet(self._clock()))
            ready, _, _ = select.select([self._woken, *([self._listener] if self._listener else [])], [], [])
            if self._woken in ready:
                self._woken.recv(_CHUNK)
            elif self._listener is not None:
                self._accept(self._listener)

    def _follow(self, outlet: Outlet | None) -> None:
        """Listen where the bus is found now, if at all."""
        if outlet == self._outlet:
            return
        if self._listener is not None:
            self._listener.close()
        self._outlet, self._listener = outlet, None if outlet is None else self._listen(outlet)
        log.info("servo bus %s", "unplugged" if outlet is None else f"on {self.url}")

    def _listen(self, outlet: Outlet) -> socket.socket:
        which = outlet.name % len(self._ports)
        listener = socket.create_server((self._host, self._ports[which]), backlog=1)
        host, port = listener.getsockname()[:2]
        self._address, self._ports[which] = (str(host), int(port)), int(port)
        return listener

    def _accept(self, listener: socket.socket) -> None:
        client, peer = listener.accept()
        self.clients += 1
        log.info("servo bus client %s connected", peer)
        with client:
            client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            reason = self._talk(client)
        hold(SERVO_BUS, None)
        log.info("servo bus client %s left: %s", peer, reason)

    def _talk(self, client: socket.socket) -> str:
        """Serve one client until it leaves, the adapter is unplugged or the server closes; return why it ended."""
        outbox = Outbox()
        self._spoken()  # to nobody
        try:
            while True:
                doors = [self._listener] if self._turns_away and self._listener else []
                ready, _, _ = select.select([client, self._woken, *doors], [], [], self._wait_s(outbox))
                if self._closing:
                    return "server closed"
                if self._woken in ready:
                    self._woken.recv(_CHUNK)
                    if self._bus.outlet(self._clock()) != self._outlet:
                        return "adapter unplugged"
                if client in ready:
                    data = client.recv(_CHUNK)
                    if not data:
                        return "client hung up"
                    with self.lock:
                        answers = self._bus.receive(data, self._clock())
                    outbox.put(answers if self._answering(self._clock()) else ())
                    hold(SERVO_BUS, None if outbox.due_ns is None else outbox.due_ns + REACTION_NS)
                for door in doors:
                    if door in ready:  # and the client is still there
                        other, peer = door.accept()
                        other.close()
                        log.info("servo bus client %s turned away: another is connected", peer)
                outbox.put(self._spoken())
                due = outbox.take(self._clock())
                if due:
                    client.sendall(due)
        except OSError as error:  # reset or broken pipe: the client went away without a word
            return str(error)

    def _spoken(self) -> list[Reply]:
        """What has been said without being asked."""
        if not self._speaks:
            return []
        with self.lock:
            said = self._bus.speak(self._clock())
        return said if self._answering(self._clock()) else []

    def _wait_s(self, outbox: Outbox) -> float | None:
        """[s] until there is something to do, though no byte comes; None where there is nothing."""
        now_ns = self._clock()
        due = [] if outbox.due_ns is None else [outbox.due_ns]
        if self._speaks:
            with self.lock:
                due.append(max(self._bus.due_ns or 0, now_ns + _BREATH_NS))
        return max((min(due) - now_ns) / _SEC, 0.0) if due else None
