"""Frames over Zenoh; the only file that imports zenoh.

Bulk and control travel in two sessions: a session whose subscriber falls behind stalls as a whole. Every subscription has a
ring or a bounded queue and a thread that empties it at once; nothing is put with blocking congestion control, since a put to
a frozen peer would block for seconds. Sessions are closed under all circumstances: a process that ends without it hangs.

Every frame travels with its address, and is dropped where that is not where it has come: what waits in a router that is frozen
for longer than the lease may come under keys of others once it goes on (seen with Zenoh 1.10, where numbers stand for keys).
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

from sextant.shared.wire.access import Keys
from sextant.shared.wire.endpoint import fault, obstacle, occupied, unknown_host
from sextant.shared.wire.handshake import refusal
from sextant.shared.wire.topics import Delivery, Lane, Topic

CLOSE_TIMEOUT_S = 1.5  # closing waits for peers, a frozen one would hold it for 13 s
LEASE_MS = 1000  # a frozen process is noticed after this, ...
GIVEN_UP_S = 0.75e-3 * LEASE_MS  # ... or sooner: its signs of life are a quarter of that apart
# Batches that may wait for the network, of each priority (16 is Zenoh's limit). With its default for control, a burst of
# three frames on a busy machine lost one in 500: the sending thread had not had its turn within the millisecond of grace.
QUEUE_SIZES = {"real_time": 16, "data": 8}
_RX_BYTES = 1 << 20  # read at once: a map comes in 14 pieces of 64 kB, Zenoh's own choice
_CONNECT_MS = 10_000  # in which what is connected to may still start
# A router that is cut off from another tries again soon: SYNs of the kernel's own wait for seconds.
_ATTEMPT_MS, _RETRY_MS = 500, 100
# Connections that have not opened a session yet. With Zenoh's defaults, 100 for 10 s, 100 silent ones keep all others out.
_ACCEPT_PENDING, _ACCEPT_MS = 8192, 4000
_SEND_BUFFER = 64 * 1024  # [bytes] of bulk over a radio: what waits in the kernel is late already
_LOOK_S = 0.05  # between two looks of a router at the time
_KEPT = 256  # frames of an EVERY topic that may wait to be taken

_SOURCE = re.compile(r" at /\S+?\.rs:\d+(?::\d+)*[.:]?")  # that Zenoh adds to its errors

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Endpoints:
    """How a service finds the others: through the router it connects to, or by scouting.

    With `scouting` off only `connect` counts, so parallel runs on one machine do not meet; with it on, processes of one
    `namespace` find each other by multicast.
    """

    connect: tuple[str, ...] = ()  # e.g. tcp/127.0.0.1:7447
    scouting: bool = False
    namespace: str = "sextant"
    keys: Keys | None = None  # of this machine, for endpoints of tls
    loopback: bool = False  # scout and listen on this machine alone

    def __post_init__(self) -> None:
        if wrong := fault(self.connect):
            raise ValueError(wrong)
        if not self.scouting and not self.connect:
            raise ValueError("with scouting off an endpoint to connect to is needed, e.g. tcp/127.0.0.1:7447")
        secure = [endpoint for endpoint in self.connect if endpoint.startswith("tls/")]
        if secure and self.keys is None:
            raise ValueError(f"{', '.join(secure)} asks for a certificate: give the folder of this machine's with --keys DIR")

    def zenoh_config(self) -> dict[str, Any]:
        """The Zenoh configuration, complete: defaults would listen everywhere and scout."""
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
    """A configuration with more in it, tables within tables likewise."""
    made = dict(config)
    for key, value in more.items():
        there = made.get(key)
        made[key] = merged(there, value) if isinstance(there, dict) and isinstance(value, dict) else value
    return made


def _router_config(listen: tuple[str, ...], upstream: tuple[str, ...]) -> dict[str, Any]:
    """Of a router: two links to each that it is chained to, so that bulk which fills the radio delays no command."""
    config = _config("router", _lanes(upstream), listen, scouting=False, namespace=None)
    accepting = {"accept_pending": _ACCEPT_PENDING, "accept_timeout": _ACCEPT_MS}
    config["transport"]["unicast"] = {"max_links": len(Lane), "open_timeout": _ATTEMPT_MS, **accepting}
    retry = {"period_init_ms": _RETRY_MS, "period_max_ms": 2 * _RETRY_MS, "period_increase_factor": 1.5}
    config["connect"] |= {"timeout_ms": -1, "exit_on_failure": False, "retry": retry}
    return config


def _lanes(endpoints: tuple[str, ...]) -> tuple[str, ...]:
    """Each endpoint twice, once for the priorities of each lane.

    What routers tell each other of themselves (priority 0) is in neither, so it stays on the link that was first: where it
    could change to the other in between, its first words were overtaken now and then, and the routers never met.
    """
    lanes: list[str] = []
    for endpoint in endpoints:
        address, _, settings = endpoint.partition("#")
        small = ";".join(filter(None, (settings, f"so_sndbuf={_SEND_BUFFER}")))
        # Of the priorities, REAL_TIME is 1 and DATA 5.
        lanes += [f"{address}?prio=1-3{'#' if settings else ''}{settings}", f"{address}?prio=4-7#{small}"]
    return tuple(lanes)


class TransportError(RuntimeError):
    """The network could not be opened, with what was tried and what to do."""


def _open(config: Mapping[str, Any]) -> zenoh.Session:
    """Open a session.

    Raises:
        TransportError: Why it could not be opened, and what to do.
    """
    connect, listen = config["connect"]["endpoints"], config["listen"]["endpoints"]
    if wrong := fault((*connect, *listen)):
        raise TransportError(wrong)
    if connect and config["connect"]["exit_on_failure"] and all(unknown := [unknown_host(one) for one in connect]):
        raise TransportError("; ".join(unknown))  # at once: waiting does not help
    try:
        return zenoh.open(zenoh.Config.from_json5(json.dumps(config)))
    except zenoh.ZError as error:
        raise TransportError(_cause(connect, listen) or f"Zenoh could not be opened: {without_source(str(error))}") from None


def _cause(connect: Sequence[str], listen: Sequence[str]) -> str:
    """Why endpoints cannot be listened on or connected to, as far as the system says."""
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
    """Return a text of Zenoh without the places in its source code."""
    return _SOURCE.sub("", text).strip()


def _close(sessions: list[zenoh.Session], pumps: Sequence["_Pump"] = ()) -> None:
    """Close sessions, and wait for their pumps, in bounded time: with a frozen peer closing would take 13 s."""

    def close() -> None:
        for session in sessions:
            session.close()  # type: ignore[no-untyped-call]

    until = time.monotonic() + CLOSE_TIMEOUT_S
    closing = threading.Thread(target=close, name="close zenoh", daemon=True)
    closing.start()
    closing.join(CLOSE_TIMEOUT_S)
    for pump in pumps:
        pump.join(max(0.0, until - time.monotonic()))


def log_to_stdout(levels: str) -> None:
    """Have Zenoh log to this process's standard output, once and for all; `levels` as RUST_LOG has them, which goes first."""
    zenoh.init_log_from_env_or(levels)


class Router:
    """Hosts the router in this process, so that no zenohd binary is needed; a context manager.

    Where the process was stopped for about as long as links last, as by Ctrl-Z, it begins anew: all who met there have given it
    up and come again, and Zenoh 1.10 takes some for those whom it knew, and talks to them in the words that it had with these;
    then they misunderstand it, or panic and hear nothing any more. It hears that the process goes on by SIGCONT, which it takes
    for that where it is entered in the main thread.
    """

    def __init__(self, listen: tuple[str, ...], upstream: tuple[str, ...] = (), access: Mapping[str, Any] | None = None):
        """Prepare.

        Args:
            listen: Endpoints to listen on, e.g. tcp/127.0.0.1:7447.
            upstream: Endpoints of routers that this one is chained to, whenever they are there.
            access: Configuration that says who may do what (`sextant.shared.wire.access`).
        """
        self.configuration: Mapping[str, Any] = merged(_router_config(listen, upstream), access or {})
        self._session: zenoh.Session | None = None  # None while it begins anew
        self._ended = False
        self._woken = threading.Event()  # by SIGCONT, or to end
        self._before: Any = None  # who took SIGCONT
        self._awake_s = 0.0  # when it was last known to be
        self._watch = threading.Thread(target=self._begin_anew_when_stopped, name="router", daemon=True)

    def __enter__(self) -> Self:
        self._awake_s = time.monotonic()
        if threading.current_thread() is threading.main_thread():
            self._before = signal.signal(signal.SIGCONT, self._go_on)  # before anybody can meet here
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
        """Whether it is connected to any other router."""
        session = self._session
        return session is not None and bool(list(session.info.routers_zid()))

    def _go_on(self, number: int, frame: FrameType | None) -> None:
        self._woken.set()  # whose lock this thread never holds
        if callable(self._before):  # another router of this process
            self._before(number, frame)

    def _take_no_signals(self) -> None:
        if self._before is not None:
            signal.signal(signal.SIGCONT, self._before)

    def _begin_anew_when_stopped(self) -> None:
        while not self._ended:
            continued = self._woken.wait(_LOOK_S)
            away_s = time.monotonic() - self._awake_s
            if continued and not self._ended:  # without a signal it was others who had the processor
                self._woken.clear()
                if away_s > GIVEN_UP_S:
                    _log.warning("this process was stopped for %.1f s: the router begins anew", away_s)
                    self._begin_anew()
            self._awake_s = time.monotonic()

    def _begin_anew(self) -> None:
        session, self._session = self._session, None
        _close([] if session is None else [session])
        while self._session is None and not self._ended:
            try:
                self._session = _open(self.configuration)
            except TransportError as error:  # its port is not free yet
                _log.warning("%s", error)
                self._woken.wait(_LOOK_S)


class ForeignPublisher:
    """Puts payloads on one key that is somebody else's."""

    def __init__(self, publisher: Any):
        self._publisher = publisher

    def send(self, payload: bytes, attachment: bytes) -> None:
        """Publish a payload with what goes with it; under congestion it is dropped, never waited for."""
        self._publisher.put(payload, attachment=attachment)

    def wanted(self) -> bool:
        """Whether anybody is subscribed."""
        return bool(self._publisher.matching_status.matching)


class ForeignLink:
    """A session among others than our services, by their keys and conventions; a context manager."""

    def __init__(self, connect: tuple[str, ...]):
        """Meet them at routers, e.g. tcp/127.0.0.1:7447."""
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
        """Of the session."""
        return str(self._session.info.zid())

    def announce(self, token: str) -> None:
        """Declare a liveliness token, which lasts as long as the session."""
        self._tokens.append(self._session.liveliness().declare_token(token))

    def publisher(self, key: str) -> ForeignPublisher:
        """Declare a publisher."""
        drop = zenoh.CongestionControl.DROP
        return ForeignPublisher(self._session.declare_publisher(key, congestion_control=drop))

    def subscribe(self, key: str, receive: Callable[[bytes], None]) -> None:
        """Hand every payload of a key to `receive` from a thread of this link."""
        subscriber = self._session.declare_subscriber(key, zenoh.handlers.FifoChannel(256))
        self._pumps.append(_Pump(subscriber, lambda sample: receive(sample.payload.to_bytes()), f"receive {key}"))


class _Pump:
    """Hands every sample of a subscriber on at once, from a thread that ends with its session."""

    def __init__(self, subscriber: Any, take: Callable[[Any], None], name: str):
        # Taken once: `undeclare` borrows the subscriber for itself, and asking it for its handler meanwhile is an error.
        self._subscriber, self._handler, self._take = subscriber, subscriber.handler, take
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def end(self) -> None:
        """Listen no longer."""
        self._subscriber.undeclare()
        self._thread.join()

    def join(self, timeout_s: float) -> None:
        """Wait for the thread, whose session has been closed: one that is left when Python ends brings the process down."""
        self._thread.join(timeout_s)

    def _run(self) -> None:
        while True:
            try:
                sample = self._handler.recv()
            except zenoh.ZError:
                return  # it has been ended, or the session closed
            self._take(sample)


class ZenohLink:
    """A process's connection to the others; a context manager."""

    def __init__(self, endpoints: Endpoints):
        self.astray = 0  # frames that came under the key of others, and were dropped
        self.last_astray = ""  # where the last was to go, and where it came, in words
        self._counting = threading.Lock()  # between subscriptions
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
        """Say why at once, where opening would only say after its timeout that it could not be."""
        keys, endpoints = self._endpoints.keys, self._endpoints.connect
        refusals = [refusal(endpoint, keys) if keys and endpoint.startswith("tls/") else "" for endpoint in endpoints]
        if refusals and all(refusals):
            raise TransportError("; ".join(refusals))

    def send(self, topic: Topic[Any], frame: bytes) -> None:
        """Publish a frame; under congestion it is dropped, never waited for."""
        self._publisher(topic).put(frame, attachment=topic.address(self._endpoints.namespace))

    def wanted(self, topic: Topic[Any]) -> bool:
        """Whether anybody is subscribed to a topic."""
        status: Any = self._publisher(topic).matching_status  # an object that is always true, though the stubs say bool
        return bool(status.matching)

    def subscribe(self, topic: Topic[Any], receive: Callable[[Topic[Any], bytes], None]) -> Callable[[], None]:
        """Hand every frame of a topic to `receive` from a thread of this link, until what is returned is called."""
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
        """Keep what comes of a topic, the newest frame or some hundred, until it is fetched, with no thread; what fetches it.

        Where nobody fetches, the oldest go: a queue that is full would hold up all of the session.
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
        """The frame of a sample that was sent to where it has come; one without an address, of another's program, is believed.

        Others are counted, and come to nothing.
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
    """What somebody hears who connects to an endpoint without keys and asks for everything: key -> messages.

    Raises:
        TransportError: Nobody is let in there.
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
    """Endpoints of routers and peers that answer to scouting by multicast."""
    config = _config("client", (), (), scouting=True, namespace=None)
    found: set[str] = set()
    answers: Any = zenoh.scout(zenoh.handlers.RingChannel(_KEPT), "router|peer", zenoh.Config.from_json5(json.dumps(config)))
    try:
        _look_for(seconds, answers, lambda hello: found.update(str(locator) for locator in hello.locators))
    finally:
        answers.stop()
    return sorted(found)


def _look_for(seconds: float, source: Any, take: Callable[[Any], object]) -> None:
    """Take what comes for some time [s]."""
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        time.sleep(0.02)
        while (item := source.try_recv()) is not None:
            take(item)
