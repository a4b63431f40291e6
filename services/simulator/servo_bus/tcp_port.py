"""TCP server of the emulated servo bus, like a serial-to-network adapter.

Its URL for pyserial is `socket://host:port`.
"""

import logging
import select
import socket
import threading
from collections.abc import Callable
from types import TracebackType

from sextant.services.simulator.servo_bus.host_link import AdapterPort, HostLink, Outbox, Reply
from sextant.shared.runtime.clock import now_ns
from sextant.shared.runtime.simulated_time import REACTION_NS, SERVO_BUS, hold, limit_of

log = logging.getLogger(__name__)

_CHUNK_BYTES = 4096  # [bytes]
_NS_PER_S = 1e9
_STOP_TIMEOUT_S = 2.0  # [s]
_POLL_NS = 500_000  # [ns] minimum period of polling a device with unsolicited replies


class TcpBusServer:
    """Server of an emulated bus for one client at a time.

    It runs in a separate thread and sends replies when they are due. The caller must hold `lock` around
    `ServoBusEmulator.advance` and `ServoBank.step`, because both threads use the servos. If the emulated USB adapter is
    unplugged, the server closes the connection and its listening socket. If the adapter returns under another device name, the
    server listens on the other TCP port.
    """

    def __init__(
        self,
        bus: HostLink,
        *,
        host: str = "127.0.0.1",
        port: int = 0,
        other_port: int = 0,
        clock: Callable[[], int] = now_ns,
        is_current: Callable[[int], bool] = lambda _now_ns: True,
        rejects_others: bool = False,
    ) -> None:
        """Open the listening socket and start the thread.

        Args:
            bus: The emulated bus.
            host: Address to listen on.
            port: Port to listen on, 0 for a free one.
            other_port: Port to listen on after the adapter returns under another name; the ports alternate.
            clock: Bus time [ns], at which replies become due. It must not run faster than real time.
            is_current: Returns whether the physics is up to date at a bus time [ns]. Otherwise the servos do not respond,
                because their measured values would be outdated.
            rejects_others: Whether to close other connections while a client is connected; by default they wait.

        Raises:
            OSError: The address is not available.
        """
        self.lock = threading.Lock()
        self.clients = 0  # number of accepted connections
        self._bus = bus
        self._sends_unsolicited = bus.due_ns is not None  # whether the bus has unsolicited replies
        self._clock = clock
        self._is_current = is_current
        self._rejects_others = rejects_others
        self._host, self._ports = host, [port, other_port]
        self._adapter_port: AdapterPort | None = AdapterPort()
        self._listener: socket.socket | None = self._listen(AdapterPort())
        self._wake, self._woken = socket.socketpair()
        self._closing = False
        self._thread = threading.Thread(target=self._serve, name="servo-bus", daemon=True)
        self._thread.start()

    @property
    def address(self) -> tuple[str, int]:
        """Host and port of the current or last listening socket."""
        return self._address

    @property
    def url(self) -> str:
        """URL for pyserial."""
        host, port = self.address
        return f"socket://{host}:{port}"

    def close(self) -> None:
        """Close all sockets and join the thread; safe to call twice."""
        if self._closing:
            return
        self._closing = True
        self._wake.send(b"x")
        self._thread.join(_STOP_TIMEOUT_S)
        for end in (self._listener, self._wake, self._woken):
            if end is not None:
                end.close()

    def replug(self) -> None:
        """Check whether the adapter was plugged in or unplugged, and close the connection if so."""
        self._wake.send(b"x")

    def __enter__(self) -> "TcpBusServer":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    def _serve(self) -> None:
        while not self._closing:
            self._update_listener(self._bus.adapter_port(self._clock()))
            ready, _, _ = select.select([self._woken, *([self._listener] if self._listener else [])], [], [])
            if self._woken in ready:
                self._woken.recv(_CHUNK_BYTES)
            elif self._listener is not None:
                self._accept(self._listener)

    def _update_listener(self, adapter_port: AdapterPort | None) -> None:
        """Listen on the port of the adapter's current name, if it is plugged in."""
        if adapter_port == self._adapter_port:
            return
        if self._listener is not None:
            self._listener.close()
        self._adapter_port, self._listener = adapter_port, None if adapter_port is None else self._listen(adapter_port)
        log.info("servo bus %s", "unplugged" if adapter_port is None else f"on {self.url}")

    def _listen(self, adapter_port: AdapterPort) -> socket.socket:
        which = adapter_port.name % len(self._ports)
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
            reason = self._serve_client(client)
        hold(SERVO_BUS, None)
        log.info("servo bus client %s left: %s", peer, reason)

    def _serve_client(self, client: socket.socket) -> str:
        """Serve one client, and return the reason for the end of the connection.

        It ends when the client disconnects, the adapter is unplugged or the server closes.
        """
        outbox = Outbox()
        self._unsolicited_replies()  # discard the replies from before the connection
        try:
            while True:
                listeners = [self._listener] if self._rejects_others and self._listener else []
                ready, _, _ = select.select([client, self._woken, *listeners], [], [], self._wait_s(outbox))
                if self._closing:
                    return "server closed"
                if self._woken in ready:
                    self._woken.recv(_CHUNK_BYTES)
                    if self._bus.adapter_port(self._clock()) != self._adapter_port:
                        return "adapter unplugged"
                if client in ready:
                    data = client.recv(_CHUNK_BYTES)
                    if not data:
                        return "client disconnected"
                    with self.lock:  # this thread may have waited: the servos answer as if it had not
                        answers = self._bus.receive(data, min(self._clock(), limit_of(SERVO_BUS) - REACTION_NS))
                    outbox.put(answers if self._is_current(self._clock()) else ())
                for listener in listeners:
                    if listener in ready:  # while the client is still connected
                        other, peer = listener.accept()
                        other.close()
                        log.info("servo bus client %s rejected: another client is connected", peer)
                outbox.put(self._unsolicited_replies())
                due = outbox.take(self._clock())
                if due:
                    client.sendall(due)
                if (due or client in ready) and not select.select([client], [], [], 0)[0]:  # no other request has arrived
                    hold(SERVO_BUS, None if outbox.due_ns is None else outbox.due_ns + REACTION_NS)
        except OSError as error:  # reset or broken pipe: the client did not close the connection
            return str(error)

    def _unsolicited_replies(self) -> list[Reply]:
        """Return the replies that the device sends without a request."""
        if not self._sends_unsolicited:
            return []
        with self.lock:
            replies = self._bus.unsolicited_replies(self._clock())
        return replies if self._is_current(self._clock()) else []

    def _wait_s(self, outbox: Outbox) -> float | None:
        """Return the time [s] to the next due reply or poll, None without one."""
        now_ns = self._clock()
        due = [] if outbox.due_ns is None else [outbox.due_ns]
        if self._sends_unsolicited:
            with self.lock:
                due.append(max(self._bus.due_ns or 0, now_ns + _POLL_NS))
        return max((min(due) - now_ns) / _NS_PER_S, 0.0) if due else None
