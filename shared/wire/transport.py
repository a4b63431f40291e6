"""Zenoh transport of frames; the only file that imports zenoh.

Bulk and control use separate sessions, because one slow subscriber stalls its whole session. Every subscription has a ring or a
bounded queue, and a thread that empties it at once. No publication uses blocking congestion control: publishing to a frozen
peer would block for seconds. Sessions are always closed, because a process that exits without closing them hangs.

Every frame carries its address, and is dropped if it arrives under another key. This happens after a router was frozen for
longer than the lease: it may deliver waiting frames under wrong keys (seen with Zenoh 1.10, which replaces keys by numbers).
"""

import json
import logging
import re
import signal
import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import FrameType, TracebackType
from typing import Any, Self

import zenoh
import zenoh.ext

from sextant.shared.errors import SextantError
from sextant.shared.wire.access import Keys
from sextant.shared.wire.endpoint import fault, obstacle, occupied, unknown_host
from sextant.shared.wire.handshake import refusal
from sextant.shared.wire.topics import Delivery, Lane, Topic

CLOSE_TIMEOUT_S = 1.5  # closing waits for peers; a frozen peer would delay it by 13 s
LEASE_MS = 1000  # peers detect a frozen process after this time, ...
GIVEN_UP_S = 0.75e-3 * LEASE_MS  # ... or up to a quarter earlier: keep-alives are a quarter of the lease apart
# Batches that may wait for the network, per priority (16 is Zenoh's limit). With Zenoh's default for control, a burst of
# three frames on a busy machine lost one frame in 500: the sending thread was not scheduled within the 1 ms that Zenoh waits.
QUEUE_SIZES = {"real_time": 16, "data": 8}
_RX_BYTES = 1 << 20  # read buffer; with Zenoh's default of 64 kB a map arrives in 14 reads
_CONNECT_MS = 10_000  # time for the other side to start
# A router that lost another one retries soon, because the kernel's own SYN retries take seconds.
_ATTEMPT_MS, _RETRY_MS = 500, 100
# Connections without a session yet. With Zenoh's defaults (100 for 10 s), 100 silent connections lock out all others.
_ACCEPT_PENDING, _ACCEPT_MS = 8192, 4000
_SEND_BUFFER = 64 * 1024  # [bytes] for bulk over a radio; frames that wait in the kernel are already late
_LOOK_S = 0.05  # [s] between two reads of the clock by a router
_KEPT = 256  # frames of an EVERY topic that may wait in a queue

_HEARTBEAT_S = 0.5  # between announcements of the number of the newest kept payload, as rmw_zenoh has it
_SOURCE = re.compile(r" at /\S+?\.rs:\d+(?::\d+)*[.:]?")  # source location in Zenoh's error texts

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Endpoints:
    """How a service finds the others: through a router, or by scouting.

    Without `scouting` a service uses only the routers in `connect`, so parallel runs on one machine stay separate. With
    scouting, processes with the same `namespace` find each other by multicast.
    """

    connect: tuple[str, ...] = ()  # e.g. tcp/127.0.0.1:7447
    scouting: bool = False
    namespace: str = "sextant"
    keys: Keys | None = None  # of this machine, for TLS endpoints
    loopback: bool = False  # scout and listen on this machine only

    def __post_init__(self) -> None:
        if wrong := fault(self.connect):
            raise ValueError(wrong)
        if not self.scouting and not self.connect:
            raise ValueError("with scouting off an endpoint to connect to is needed, e.g. tcp/127.0.0.1:7447")
        secure = [endpoint for endpoint in self.connect if endpoint.startswith("tls/")]
        if secure and self.keys is None:
            raise ValueError(f"{', '.join(secure)} asks for a certificate: give the folder of this machine's with --keys DIR")

    @property
    def role(self) -> str:
        """Role under which a client reports its health: that of its certificate, "robot" without one."""
        return "robot" if self.keys is None else self.keys.role.name

    def zenoh_config(self) -> dict[str, Any]:
        """Return the complete Zenoh configuration.

        Zenoh's defaults would scout and listen on all interfaces.
        """
        return _config(
            mode="peer" if self.scouting else "client",
            connect=self.connect,
            listen=("tcp/127.0.0.1:0" if self.loopback else "tcp/0.0.0.0:0",) if self.scouting else (),
            scouting=self.scouting,
            namespace=self.namespace,
            access=merged(
                self.keys.connecting() if self.keys is not None else {},
                {"scouting": {"multicast": {"interface": "lo"}}} if self.loopback else {},
            ),
        )


def _config(
    mode: str,
    connect: tuple[str, ...],
    listen: tuple[str, ...],
    scouting: bool,
    namespace: str | None,
    access: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    config: dict[str, Any] = {
        "mode": mode,
        "connect": {"endpoints": list(connect), "timeout_ms": _CONNECT_MS, "exit_on_failure": True},
        "listen": {"endpoints": list(listen)},
        "scouting": {"multicast": {"enabled": scouting}, "gossip": {"enabled": scouting}},
        "transport": {
            "link": {"tx": {"lease": LEASE_MS, "queue": {"size": QUEUE_SIZES}}, "rx": {"buffer_size": _RX_BYTES}},
            "shared_memory": {"enabled": False},
        },
    }
    if namespace is not None:
        config["namespace"] = namespace
    return merged(config, access or {})


def merged(config: Mapping[str, Any], more: Mapping[str, Any]) -> dict[str, Any]:
    """Return a configuration with the entries of another merged into it, recursively."""
    made = dict(config)
    for key, value in more.items():
        there = made.get(key)
        made[key] = merged(there, value) if isinstance(there, dict) and isinstance(value, dict) else value
    return made


def _router_config(listen: tuple[str, ...], upstream: tuple[str, ...]) -> dict[str, Any]:
    """Return the configuration of a router.

    It has two links to each upstream router, so that bulk on a saturated radio does not delay commands.
    """
    config = _config("router", _lanes(upstream), listen, scouting=False, namespace=None)
    accepting = {"accept_pending": _ACCEPT_PENDING, "accept_timeout": _ACCEPT_MS}
    config["transport"]["unicast"] = {"max_links": len(Lane), "open_timeout": _ATTEMPT_MS, **accepting}
    retry = {"period_init_ms": _RETRY_MS, "period_max_ms": 2 * _RETRY_MS, "period_increase_factor": 1.5}
    config["connect"] |= {"timeout_ms": -1, "exit_on_failure": False, "retry": retry}
    return config


def _lanes(endpoints: tuple[str, ...]) -> tuple[str, ...]:
    """Return each endpoint twice, once for the priorities of each lane.

    Neither link includes the routers' own protocol messages (priority 0), so these stay on the link that opened first. When
    they could change links, the first ones sometimes arrived out of order, and the routers never connected.
    """
    lanes: list[str] = []
    for endpoint in endpoints:
        address, _, settings = endpoint.partition("#")
        small = ";".join(filter(None, (settings, f"so_sndbuf={_SEND_BUFFER}")))
        # REAL_TIME has priority 1 and DATA has priority 5.
        lanes += [f"{address}?prio=1-3{'#' if settings else ''}{settings}", f"{address}?prio=4-7#{small}"]
    return tuple(lanes)


class TransportError(SextantError, RuntimeError):
    """The network could not be opened; the text gives the cause and what to do."""

    exit_status = 1


def _open(config: Mapping[str, Any]) -> zenoh.Session:
    """Open a session.

    Raises:
        TransportError: The session could not be opened; the text gives the cause and what to do.
    """
    connect, listen = config["connect"]["endpoints"], config["listen"]["endpoints"]
    if wrong := fault((*connect, *listen)):
        raise TransportError(wrong)
    if connect and config["connect"]["exit_on_failure"] and all(unknown := [unknown_host(one) for one in connect]):
        raise TransportError("; ".join(unknown))  # at once, because waiting does not help
    try:
        return zenoh.open(zenoh.Config.from_json5(json.dumps(config)))
    except zenoh.ZError as error:
        raise TransportError(_cause(connect, listen) or f"Zenoh could not be opened: {without_source(str(error))}") from None


def _cause(connect: Sequence[str], listen: Sequence[str]) -> str:
    """Return why endpoints cannot be used, as far as the system reports it."""
    if taken := [*filter(None, map(occupied, listen))]:
        return "; ".join(taken)
    if not connect:
        return ""
    missing = [*filter(None, map(obstacle, connect))]
    return "; ".join(missing) or (
        f"{', '.join(connect)} takes the connection, but does not answer as a router of Sextant; is another program there, or "
        "does it ask for certificates (tls/HOST:7448 with --keys DIR)?"
    )


def without_source(text: str) -> str:
    """Return a text of Zenoh without its source locations."""
    return _SOURCE.sub("", text).strip()


def _close(sessions: list[zenoh.Session], pumps: Sequence["_Pump"] = ()) -> None:
    """Close sessions and wait for their pumps, in bounded time.

    With a frozen peer, closing alone would take 13 s.
    """

    def close() -> None:
        for session in sessions:
            session.close()  # type: ignore[no-untyped-call]

    until = time.monotonic() + CLOSE_TIMEOUT_S
    closing = threading.Thread(target=close, name="close zenoh", daemon=True)
    closing.start()
    closing.join(CLOSE_TIMEOUT_S)
    for pump in pumps:
        pump.join(max(0.0, until - time.monotonic()))


class Router:
    """Zenoh router in this process, in place of zenohd; a context manager.

    The router restarts after the process was stopped (e.g. by Ctrl-Z) for about as long as the lease. By then its clients
    have dropped it and reconnect. Zenoh 1.10 confuses some of them with their old sessions and uses the old key numbers; these
    clients then read wrong keys, or panic and receive nothing. SIGCONT signals that the process continues. The router handles
    this signal only if the main thread enters it.
    """

    def __init__(self, listen: tuple[str, ...], upstream: tuple[str, ...] = (), access: Mapping[str, Any] | None = None):
        """Prepare the configuration.

        Args:
            listen: Endpoints to listen on, e.g. tcp/127.0.0.1:7447.
            upstream: Endpoints of routers to connect to whenever they are available.
            access: Access control configuration (`sextant.shared.wire.access`).
        """
        self.configuration: Mapping[str, Any] = merged(_router_config(listen, upstream), access or {})
        self._session: zenoh.Session | None = None  # None during a restart
        self._ended = False
        self._woken = threading.Event()  # set by SIGCONT, and to end the thread
        self._before: Any = None  # previous handler of SIGCONT
        self._awake_s = 0.0  # last time at which the process was known to run
        self._watch = threading.Thread(target=self._begin_anew_when_stopped, name="router", daemon=True)

    def __enter__(self) -> Self:
        self._awake_s = time.monotonic()
        if threading.current_thread() is threading.main_thread():
            self._before = signal.signal(signal.SIGCONT, self._go_on)  # before a client can connect
        try:
            self._session = _open(self.configuration)
        except TransportError:
            self._take_no_signals()
            raise
        self._watch.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._take_no_signals()
        self._ended = True
        self._woken.set()
        self._watch.join()
        if self._session is not None:
            _close([self._session])

    @property
    def chained(self) -> bool:
        """Whether this router is connected to another router."""
        session = self._session
        return session is not None and bool(list(session.info.routers_zid()))

    def _go_on(self, number: int, frame: FrameType | None) -> None:
        self._woken.set()  # safe in a signal handler: the main thread never holds the lock of this event
        if callable(self._before):  # another router of this process
            self._before(number, frame)

    def _take_no_signals(self) -> None:
        if self._before is not None:
            signal.signal(signal.SIGCONT, self._before)

    def _begin_anew_when_stopped(self) -> None:
        while not self._ended:
            continued = self._woken.wait(_LOOK_S)
            away_s = time.monotonic() - self._awake_s
            if continued and not self._ended:  # a gap without SIGCONT means only that other processes had the processor
                self._woken.clear()
                if away_s > GIVEN_UP_S:
                    _log.warning("this process was stopped for %.1f s: the router restarts", away_s)
                    self._begin_anew()
            self._awake_s = time.monotonic()

    def _begin_anew(self) -> None:
        session, self._session = self._session, None
        _close([] if session is None else [session])
        while self._session is None and not self._ended:
            try:
                self._session = _open(self.configuration)
            except TransportError as error:  # the port is not free yet
                _log.warning("%s", error)
                self._woken.wait(_LOOK_S)


class ForeignPublisher:
    """Publisher on one key of a foreign (non-Sextant) system."""

    def __init__(self, publisher: Any):
        self._publisher = publisher

    def send(self, payload: bytes, attachment: bytes) -> None:
        """Publish a payload and its attachment, without blocking.

        Under congestion the payload is dropped.
        """
        self._publisher.put(payload, attachment=attachment)

    def wanted(self) -> bool:
        """Return whether the key has subscribers; not for a publisher that keeps payloads."""
        return bool(self._publisher.matching_status.matching)


class ForeignLink:
    """Session with a foreign system, with its keys and conventions; a context manager."""

    def __init__(self, connect: tuple[str, ...]):
        """Prepare a connection to routers, e.g. tcp/127.0.0.1:7447."""
        self._config = _config(mode="client", connect=connect, listen=(), scouting=False, namespace=None)

    def __enter__(self) -> Self:
        self._session = _open(self._config)
        self._tokens: list[Any] = []
        self._pumps: list[_Pump] = []
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        _close([self._session], self._pumps)

    @property
    def id(self) -> str:
        """Zenoh id of the session."""
        return str(self._session.info.zid())

    def announce(self, token: str) -> None:
        """Declare a liveliness token for the lifetime of the session."""
        self._tokens.append(self._session.liveliness().declare_token(token))

    def publisher(self, key: str, kept: int = 0) -> ForeignPublisher:
        """Declare a publisher on a key; `kept` of its newest payloads are kept for later subscribers that ask for them."""
        drop = zenoh.CongestionControl.DROP
        if not kept:
            return ForeignPublisher(self._session.declare_publisher(key, congestion_control=drop))
        publisher = zenoh.ext.declare_advanced_publisher(
            self._session,
            key,
            congestion_control=drop,
            cache=zenoh.ext.CacheConfig(kept),
            sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=_HEARTBEAT_S),
            publisher_detection=True,
        )
        return ForeignPublisher(publisher)

    def subscribe(self, key: str, receive: Callable[[bytes], None]) -> None:
        """Pass every payload of a key to `receive`, from a thread of this link."""
        subscriber = self._session.declare_subscriber(key, zenoh.handlers.FifoChannel(256))
        self._pumps.append(_Pump(subscriber, lambda sample: receive(sample.payload.to_bytes()), f"receive {key}"))


class _Pump:
    """Thread that passes on every sample of a subscriber, and ends with its session."""

    def __init__(self, subscriber: Any, take: Callable[[Any], None], name: str):
        # Store the handler: reading it from the subscriber during `undeclare` is an error.
        self._subscriber, self._handler, self._take = subscriber, subscriber.handler, take
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def end(self) -> None:
        """Undeclare the subscriber and end the thread."""
        self._subscriber.undeclare()
        self._thread.join()

    def join(self, timeout_s: float) -> None:
        """Wait for the thread after its session was closed.

        A thread that still runs when Python exits crashes the process.
        """
        self._thread.join(timeout_s)

    def _run(self) -> None:
        while True:
            try:
                sample = self._handler.recv()
            except zenoh.ZError:
                return  # the subscriber was undeclared, or the session closed
            self._take(sample)


class ZenohLink:
    """Zenoh connection of a process to the others; a context manager."""

    def __init__(self, endpoints: Endpoints):
        self.astray = 0  # frames dropped because they arrived under another key
        self.last_astray = ""  # intended address and key of the last such frame
        self._counting = threading.Lock()  # guards `astray`, which the threads of all subscriptions increment
        self._endpoints = endpoints
        self._sessions: dict[Lane, zenoh.Session] = {}
        self._publishers: dict[str, zenoh.Publisher] = {}
        self._pumps: list[_Pump] = []

    def __enter__(self) -> Self:
        config = self._endpoints.zenoh_config()
        self._see_whether_let_in()
        try:
            for lane in Lane:
                self._sessions[lane] = _open(config)
        except TransportError:
            _close(list(self._sessions.values()))
            raise
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        _close(list(self._sessions.values()), self._pumps)

    def _see_whether_let_in(self) -> None:
        """Raise the cause of a refused TLS connection at once, without the timeout."""
        keys, endpoints = self._endpoints.keys, self._endpoints.connect
        refusals = [refusal(endpoint, keys) if keys and endpoint.startswith("tls/") else "" for endpoint in endpoints]
        if refusals and all(refusals):
            raise TransportError("; ".join(refusals))

    def send(self, topic: Topic[Any], frame: bytes) -> None:
        """Publish a frame; it is dropped under congestion and never blocks."""
        self._publisher(topic).put(frame, attachment=topic.address(self._endpoints.namespace))

    def wanted(self, topic: Topic[Any]) -> bool:
        """Return whether a topic has subscribers."""
        status: Any = self._publisher(topic).matching_status  # the stubs declare bool, but it is an object that is always true
        return bool(status.matching)

    def subscribe(self, topic: Topic[Any], receive: Callable[[Topic[Any], bytes], None]) -> Callable[[], None]:
        """Pass every frame of a topic to `receive`, from a thread of this link.

        Returns:
            A function that ends the subscription.
        """
        latest = topic.delivery is Delivery.LATEST
        channel: Any = zenoh.handlers.RingChannel(1) if latest else zenoh.handlers.FifoChannel(_KEPT)
        subscriber = self._sessions[topic.lane].declare_subscriber(topic.key, channel)

        def take(sample: Any) -> None:
            if (frame := self._meant(topic, sample)) is not None:
                receive(topic, frame)

        pump = _Pump(subscriber, take, f"receive {topic.key}")
        self._pumps.append(pump)

        def end() -> None:
            if pump in self._pumps:
                self._pumps.remove(pump)
                pump.end()

        return end

    def collect(self, topic: Topic[Any]) -> Callable[[], list[bytes]]:
        """Queue the frames of a topic without a thread.

        The queue holds the newest frame (LATEST) or 256 frames (EVERY).

        A full queue drops its oldest frame, because blocking would stall the whole session.

        Returns:
            A function that fetches and removes the queued frames.
        """
        ring: Any = zenoh.handlers.RingChannel(1 if topic.delivery is Delivery.LATEST else _KEPT)
        subscriber = self._sessions[topic.lane].declare_subscriber(topic.key, ring)

        def come() -> list[bytes]:
            frames: list[bytes] = []
            while (sample := subscriber.try_recv()) is not None:
                if (frame := self._meant(topic, sample)) is not None:
                    frames.append(frame)
            return frames

        return come

    def _meant(self, topic: Topic[Any], sample: Any) -> bytes | None:
        """Return the frame of a sample if its address is the key that it arrived under.

        A sample without an address (from a foreign program) is accepted. A sample with another address is counted and dropped.
        """
        address = topic.address(self._endpoints.namespace).encode()
        sent_to = address if sample.attachment is None else sample.attachment.to_bytes()
        if sent_to != address:
            found = sent_to[:80].decode(errors="backslashreplace")
            self.last_astray = f"{topic.key}: a frame that was sent to {found} has come"
            with self._counting:
                self.astray += 1
            return None
        frame: bytes = sample.payload.to_bytes()
        return frame

    def _publisher(self, topic: Topic[Any]) -> zenoh.Publisher:
        publisher = self._publishers.get(topic.key)
        if publisher is None:
            publisher = self._publishers[topic.key] = self._sessions[topic.lane].declare_publisher(
                topic.key,
                congestion_control=zenoh.CongestionControl.DROP,
                priority=zenoh.Priority.REAL_TIME if topic.lane is Lane.CONTROL else zenoh.Priority.DATA,
                express=topic.lane is Lane.CONTROL,
            )
        return publisher


def overhear(endpoint: str, seconds: float) -> dict[str, int]:
    """Subscribe to all keys at an endpoint without a certificate, and count messages.

    Returns:
        Key -> number of messages received.

    Raises:
        TransportError: The endpoint refuses the connection.
    """
    config = _config("client", (endpoint,), (), scouting=False, namespace=None)
    config["connect"]["timeout_ms"] = round(1e3 * seconds)
    heard: Counter[str] = Counter()
    session = _open(config)
    try:
        everything: Any = session.declare_subscriber("**", zenoh.handlers.RingChannel(_KEPT))
        _look_for(seconds, everything, lambda sample: heard.update([str(sample.key_expr)]))
    finally:
        _close([session])
    return heard


def scout(seconds: float) -> list[str]:
    """Return the endpoints of routers and peers that answer multicast scouting."""
    config = _config("client", (), (), scouting=True, namespace=None)
    found: set[str] = set()
    answers: Any = zenoh.scout(zenoh.handlers.RingChannel(_KEPT), "router|peer", zenoh.Config.from_json5(json.dumps(config)))
    try:
        _look_for(seconds, answers, lambda hello: found.update(str(locator) for locator in hello.locators))
    finally:
        answers.stop()
    return sorted(found)


def _look_for(seconds: float, source: Any, take: Callable[[Any], object]) -> None:
    """Pass items of a source to `take` for some time [s]."""
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        time.sleep(0.02)
        while (item := source.try_recv()) is not None:
            take(item)
