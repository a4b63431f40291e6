"""Frames over Zenoh on loopback, with the router in this process."""

import contextlib
import json
import os
import signal
import socket
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import pytest
import zenoh

from sextant.shared.wire import topics, transport
from sextant.shared.wire.transport import Endpoints, ForeignLink, Router, TransportError, ZenohLink

MODE, VELOCITY, DEPTH, COLOR = topics.MODE, topics.VELOCITY, topics.DEPTH, topics.COLOR
PATIENCE_S = 10.0  # longest wait for an event


def free_endpoint() -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


@pytest.fixture(scope="module")
def endpoint() -> Iterator[str]:
    address = free_endpoint()
    with Router((address,)):
        yield address


class Receiver:
    """A receiver that collects frames and reports the arrival of the expected one."""

    def __init__(self, last: bytes):
        self.frames: list[bytes] = []
        self.last = last
        self.done = threading.Event()

    def __call__(self, topic: Any, frame: bytes) -> None:
        self.frames.append(frame)
        if frame == self.last:
            self.done.set()

    def expect(self, last: bytes) -> None:
        """Wait for another frame."""
        self.last = last
        self.done.clear()


def wait_until_wanted(link: ZenohLink, topic: Any) -> None:
    """Wait until a declaration has arrived."""
    pause, until = threading.Event(), time.monotonic() + PATIENCE_S
    while not link.wanted(topic):
        assert time.monotonic() < until, f"nobody subscribed to {topic.key}"
        pause.wait(0.001)


def test_every_frame_arrives_in_order(endpoint: str) -> None:
    frames = [b"%d" % n for n in range(60)]
    with ZenohLink(Endpoints((endpoint,))) as sender, ZenohLink(Endpoints((endpoint,))) as reader:
        receiver = Receiver(b"")
        reader.subscribe(MODE, receiver)
        wait_until_wanted(sender, MODE)
        for n in range(0, len(frames), 6):  # a burst of more than 16 may be dropped: the sender never waits
            receiver.expect(frames[n + 5])
            for frame in frames[n : n + 6]:
                sender.send(MODE, frame)
            assert receiver.done.wait(PATIENCE_S)
    assert receiver.frames == frames


def test_slow_reader_receives_newest_state(endpoint: str) -> None:
    release, holding, last = threading.Event(), threading.Event(), threading.Event()
    received: list[bytes] = []

    def slow(_topic: Any, frame: bytes) -> None:
        received.append(frame)
        holding.set()
        release.wait(PATIENCE_S)
        if frame == b"19":
            last.set()

    with ZenohLink(Endpoints((endpoint,))) as sender, ZenohLink(Endpoints((endpoint,))) as reader:
        watcher = Receiver(b"")
        reader.subscribe(VELOCITY, slow)
        reader.subscribe(MODE, watcher)  # in the same lane, so it receives its frame after all earlier ones
        wait_until_wanted(sender, VELOCITY)
        wait_until_wanted(sender, MODE)
        sender.send(VELOCITY, b"first")
        assert holding.wait(PATIENCE_S)
        for n in range(20):
            watcher.expect(b"%d" % n)
            sender.send(VELOCITY, b"%d" % n)
            sender.send(MODE, b"%d" % n)
            assert watcher.done.wait(PATIENCE_S)
        release.set()
        assert last.wait(PATIENCE_S)
    assert received == [b"first", b"19"]  # the frames in between were overwritten


def test_depth_frame_arrives_complete(endpoint: str) -> None:
    frame = bytes(range(256)) * 2400  # 614 kB
    with ZenohLink(Endpoints((endpoint,))) as sender, ZenohLink(Endpoints((endpoint,))) as reader:
        receiver = Receiver(frame)
        reader.subscribe(DEPTH, receiver)
        wait_until_wanted(sender, DEPTH)
        sender.send(DEPTH, frame)
        assert receiver.done.wait(PATIENCE_S)
    assert receiver.frames == [frame]
    assert type(receiver.frames[0]) is bytes


def test_topic_is_wanted_only_while_subscribed(endpoint: str) -> None:
    with ZenohLink(Endpoints((endpoint,))) as sender:
        assert not sender.wanted(COLOR)
        with ZenohLink(Endpoints((endpoint,))) as reader:
            reader.subscribe(COLOR, Receiver(b""))
            wait_until_wanted(sender, COLOR)
            assert not sender.wanted(MODE)
        pause, until = threading.Event(), time.monotonic() + PATIENCE_S
        while sender.wanted(COLOR) and time.monotonic() < until:
            pause.wait(0.001)
        assert not sender.wanted(COLOR)


def test_wanted_query_does_not_change_publisher(endpoint: str) -> None:
    with ZenohLink(Endpoints((endpoint,))) as asks, ZenohLink(Endpoints((endpoint,))) as sends:
        for topic in (MODE, DEPTH):
            asks.wanted(topic)
            sends.send(topic, b"x")
            a, b = asks._publishers[topic.key], sends._publishers[topic.key]
            assert a.priority == b.priority
            assert a.congestion_control == b.congestion_control


def test_namespaces_are_isolated(endpoint: str) -> None:
    here, there = Endpoints((endpoint,), namespace="here"), Endpoints((endpoint,), namespace="there")
    with ZenohLink(here) as a, ZenohLink(there) as b, ZenohLink(here) as reader, ZenohLink(there) as other:
        receiver, stranger = Receiver(b"last"), Receiver(b"last")
        reader.subscribe(MODE, receiver)
        wait_until_wanted(a, MODE)
        assert not b.wanted(MODE)
        other.subscribe(MODE, stranger)
        wait_until_wanted(b, MODE)
        a.send(MODE, b"for here")
        b.send(MODE, b"for there")
        a.send(MODE, b"last")
        b.send(MODE, b"last")
        assert receiver.done.wait(PATIENCE_S)
        assert stranger.done.wait(PATIENCE_S)
    assert receiver.frames == [b"for here", b"last"]
    assert stranger.frames == [b"for there", b"last"]


def test_link_receives_own_messages_and_all_readers_receive(endpoint: str) -> None:
    with ZenohLink(Endpoints((endpoint,))) as link, ZenohLink(Endpoints((endpoint,))) as other:
        receivers = [Receiver(b"x"), Receiver(b"x")]
        link.subscribe(MODE, receivers[0])
        other.subscribe(MODE, receivers[1])
        wait_until_wanted(link, MODE)
        probe = threading.Event()
        until = time.monotonic() + PATIENCE_S
        while not all(r.done.is_set() for r in receivers) and time.monotonic() < until:
            link.send(MODE, b"x")  # the second declaration may still be on its way
            probe.wait(0.005)
        assert all(r.done.is_set() for r in receivers)


def test_foreign_attachments_and_liveliness_tokens_are_supported(endpoint: str) -> None:
    received: list[bytes] = []
    config = {"mode": "client", "connect": {"endpoints": [endpoint]}, "scouting": {"multicast": {"enabled": False}}}
    with zenoh.open(zenoh.Config.from_json5(json.dumps(config))) as other:

        def tokens() -> list[str]:
            return [str(reply.ok.key_expr) for reply in other.liveliness().get("@them/**", timeout=PATIENCE_S)]

        with ForeignLink((endpoint,)) as link:
            publisher = link.publisher("7/theirs")
            assert not publisher.wanted()
            subscriber = other.declare_subscriber("7/theirs")
            pause, until = threading.Event(), time.monotonic() + PATIENCE_S
            while not publisher.wanted() and time.monotonic() < until:
                pause.wait(0.001)
            publisher.send(b"payload", b"beside it")
            sample = subscriber.recv()
            assert (sample.payload.to_bytes(), sample.attachment.to_bytes()) == (b"payload", b"beside it")
            link.announce(f"@them/{link.id}/here")
            while not (found := tokens()) and time.monotonic() < until:  # it takes a moment to arrive
                pause.wait(0.001)
            assert found == [f"@them/{link.id}/here"]
            link.subscribe("7/ours", received.append)
            while not received and time.monotonic() < until:
                other.put("7/ours", b"back")
                pause.wait(0.001)
        assert received[0] == b"back"
        while tokens() and time.monotonic() < until:
            pause.wait(0.001)
        assert tokens() == []


def test_close_is_quick_and_ends_threads(endpoint: str) -> None:
    before = set(threading.enumerate())
    with ZenohLink(Endpoints((endpoint,))) as link:
        for topic in (MODE, VELOCITY, DEPTH):
            link.subscribe(topic, Receiver(b""))
        mine = [t for t in threading.enumerate() if t not in before and t.name.startswith("receive ")]
        assert len(mine) == 3
        began = time.monotonic()
    assert time.monotonic() - began < PATIENCE_S
    for thread in mine:
        thread.join(PATIENCE_S)
        assert not thread.is_alive()


def test_subscriber_is_not_accessed_during_undeclaration() -> None:
    """Do not access a subscriber during its undeclaration.

    Zenoh's subscriber then raises an error: `Already mutably borrowed`.
    """
    ended, failed = threading.Event(), list[str]()

    class Handler:
        def recv(self) -> Any:
            if ended.wait(0.0):
                raise zenoh.ZError("closed")
            return "sample"

    class Subscriber:
        undeclaring = False

        @property
        def handler(self) -> Handler:
            if self.undeclaring:
                failed.append("asked while it is undeclared")
            return Handler()

        def undeclare(self) -> None:
            self.undeclaring = True
            samples.wait(PATIENCE_S)  # the thread goes on receiving
            ended.set()

    count, samples = [0], threading.Event()

    def take(_sample: Any) -> None:
        count[0] += 1
        if subscriber.undeclaring:
            samples.set()

    subscriber = Subscriber()
    pump = transport._Pump(subscriber, take, "receive")
    pump.end()
    assert samples.is_set()
    assert failed == []


def test_close_does_not_wait_for_hung_session(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(transport, "CLOSE_TIMEOUT_S", 0.05)
    release = threading.Event()

    class Frozen:
        def close(self) -> None:
            release.wait(2 * PATIENCE_S)

    began = time.monotonic()
    transport._close([Frozen()])  # type: ignore[list-item]
    assert time.monotonic() - began < PATIENCE_S
    release.set()


def test_link_closes_after_error_in_block(endpoint: str) -> None:
    def fail() -> None:
        with ZenohLink(Endpoints((endpoint,))) as link:
            link.subscribe(MODE, Receiver(b""))
            raise KeyError

    with pytest.raises(KeyError):
        fail()
    with ZenohLink(Endpoints((endpoint,))) as link:  # the next one opens
        link.send(MODE, b"x")


# ------------------------------------------------------------------------------------------------- endpoints


def test_endpoint_is_required_without_scouting() -> None:
    with pytest.raises(ValueError, match=r"with scouting off an endpoint to connect to is needed, e\.g\. tcp/"):
        Endpoints()
    assert Endpoints(scouting=True).connect == ()


def test_only_configured_endpoints_are_opened() -> None:
    quiet = Endpoints(("tcp/10.0.0.1:7447",)).zenoh_config()
    assert quiet["mode"] == "client"
    assert quiet["listen"]["endpoints"] == []
    assert not quiet["scouting"]["multicast"]["enabled"]
    assert not quiet["scouting"]["gossip"]["enabled"]
    assert quiet["namespace"] == "sextant"
    scouting = Endpoints(scouting=True, namespace="lab").zenoh_config()
    assert scouting["mode"] == "peer"
    assert scouting["scouting"]["multicast"]["enabled"]
    assert scouting["namespace"] == "lab"


def test_invalid_endpoint_is_named() -> None:
    with pytest.raises(ValueError, match=r"PROTOCOL/HOST:PORT expected.*'nonsense'"):
        Endpoints(("nonsense",))
    with pytest.raises(TransportError, match=r"PROTOCOL/HOST:PORT expected.*'nonsense'"), ForeignLink(("nonsense",)):
        pass


def test_taken_port_is_named(endpoint: str) -> None:
    with pytest.raises(TransportError, match=f"cannot listen on {endpoint}: another program has port"), Router((endpoint,)):
        pass


@pytest.mark.parametrize("namespace", ["", "*", "/x", "x/"])
def test_invalid_namespace_is_refused(endpoint: str, namespace: str) -> None:
    with pytest.raises((ValueError, TransportError)), ZenohLink(replace(Endpoints((endpoint,)), namespace=namespace)):
        pass


def test_missing_router_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(transport, "_CONNECT_MS", 50)
    address = free_endpoint()
    with pytest.raises(TransportError, match=f"{address} cannot be reached: nothing listens"), ZenohLink(Endpoints((address,))):
        pass


def test_silent_connections_do_not_block_clients(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(transport, "_CONNECT_MS", 3000)  # with Zenoh's defaults the first 100 keep all others out for 10 s
    address = free_endpoint()
    host, port = address.removeprefix("tcp/").split(":")
    with Router((address,)), contextlib.ExitStack() as stack:
        for _ in range(300):
            stack.enter_context(socket.create_connection((host, int(port)), PATIENCE_S))
        with ZenohLink(Endpoints((address,))) as link:
            link.send(MODE, b"x")


def test_program_that_is_no_router_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(transport, "_CONNECT_MS", 200)
    with socket.create_server(("127.0.0.1", 0)) as other:
        address = f"tcp/127.0.0.1:{other.getsockname()[1]}"
        with pytest.raises(TransportError, match=f"{address} takes the connection, but does not answer as a router of Sextant"):
            ForeignLink((address,)).__enter__()


def test_zenoh_source_locations_are_removed() -> None:
    said = "Unable to connect to [tcp/1.2.3.4:1]. Timeout! at /root/.cargo/git/x/zenoh/src/orchestrator.rs:388.. Then more"
    assert transport.without_source(said) == "Unable to connect to [tcp/1.2.3.4:1]. Timeout!. Then more"
    said = "thread 'rx-0' panicked at /root/.cargo/git/checkouts/zenoh/src/keyexpr.rs:241:32:"
    assert transport.without_source(said) == "thread 'rx-0' panicked"


def test_collected_messages_wait_until_fetched(endpoint: str) -> None:
    endpoints = Endpoints((endpoint,), namespace="collected")
    with ZenohLink(endpoints) as sender, ZenohLink(endpoints) as receiver:
        come = {topic: receiver.collect(topic) for topic in (MODE, VELOCITY)}
        for topic in come:
            wait_until_wanted(sender, topic)
            assert come[topic]() == []
        marker = Receiver(b"")
        receiver.subscribe(MODE, marker)
        receiver.subscribe(VELOCITY, marker)
        for topic in come:
            for n in range(300):
                last = b"%s %d" % (topic.key.encode(), n)
                marker.expect(last)
                sender.send(topic, last)
                assert marker.done.wait(PATIENCE_S)
        assert come[VELOCITY]() == [b"operator/velocity 299"], "of states the newest"
        found = come[MODE]()
        assert len(found) == 256, "some hundred events; a slow reader blocks no other process"
        assert found[-1] == b"operator/mode 299"
        assert come[MODE]() == come[VELOCITY]() == []


def test_misrouted_frame_is_dropped_and_reported(endpoint: str) -> None:
    endpoints = Endpoints((endpoint,), namespace="a")
    with ZenohLink(endpoints) as reader, zenoh.open(zenoh.Config.from_json5(json.dumps(endpoints.zenoh_config()))) as sender:
        receiver = Receiver(b"")
        reader.subscribe(MODE, receiver)
        come = reader.collect(MODE)
        publisher = sender.declare_publisher(MODE.key)
        pause, until = threading.Event(), time.monotonic() + PATIENCE_S
        while not publisher.matching_status.matching:
            assert time.monotonic() < until
            pause.wait(0.001)
        sent = {"a/operator/velocity": b"1", "b/operator/mode": b"2", "a/operator/mode": b"3", None: b"4"}
        receiver.expect(b"4")
        for address, frame in sent.items():
            publisher.put(frame, attachment=address)
        assert receiver.done.wait(PATIENCE_S)
        collected = come()
        while collected[-1:] != [b"4"]:
            assert time.monotonic() < until
            collected += come()
        assert receiver.frames == collected == [b"3", b"4"], "who gives no address is another program, and taken at its word"
        assert reader.astray == 4, "two by each way"
        assert reader.last_astray == "operator/mode: a frame that was sent to b/operator/mode has come"


@pytest.fixture
def nobody_takes_sigcont() -> Iterator[None]:
    before = signal.signal(signal.SIGCONT, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGCONT, before)


@pytest.mark.usefixtures("nobody_takes_sigcont")
def test_router_stopped_for_long_restarts_and_clients_reconnect(monkeypatch: pytest.MonkeyPatch) -> None:
    address, away_s, looks = free_endpoint(), [0.0], [0]
    told: list[str] = []

    class Clock:
        sleep = time.sleep

        @staticmethod
        def monotonic() -> float:
            looks[0] += 1
            return time.monotonic() + away_s[0]

    monkeypatch.setattr(transport, "time", Clock)
    monkeypatch.setattr(transport._log, "warning", lambda words, *values: told.append(words % values))
    endpoints = Endpoints((address,))
    pause, until = threading.Event(), time.monotonic() + PATIENCE_S
    with Router((address,)), ZenohLink(endpoints) as sender, ZenohLink(endpoints) as reader:
        receiver = Receiver(b"before")
        reader.subscribe(MODE, receiver)
        wait_until_wanted(sender, MODE)
        away_s[0], looks[0] = 5.0, 0
        while looks[0] < 4:
            assert time.monotonic() < until
            pause.wait(0.01)
        sender.send(MODE, b"before")
        assert receiver.done.wait(PATIENCE_S)
        assert told == [], "without a signal it was others who had the processor"
        receiver.expect(b"after")
        while not told:
            assert time.monotonic() < until
            away_s[0] += 5.0
            os.kill(os.getpid(), signal.SIGCONT)
            pause.wait(0.01)
        assert told[0].startswith("this process was stopped for 5.")
        while not receiver.done.wait(0.05):
            assert time.monotonic() < until
            sender.send(MODE, b"after")
    assert signal.getsignal(signal.SIGCONT) is signal.SIG_DFL, "as it was"


def test_every_frame_carries_its_address(endpoint: str) -> None:
    endpoints = Endpoints((endpoint,), namespace="addressed")
    with ZenohLink(endpoints) as sender, zenoh.open(zenoh.Config.from_json5(json.dumps(endpoints.zenoh_config()))) as reader:
        subscriber: Any = reader.declare_subscriber(MODE.key)
        wait_until_wanted(sender, MODE)
        sender.send(MODE, b"1")
        sample = subscriber.recv()
        assert (sample.payload.to_bytes(), sample.attachment.to_bytes()) == (b"1", b"addressed/operator/mode")


@pytest.mark.parametrize("first", ["robot", "base"])
def test_chained_routers_relay_both_ways_in_any_start_order(first: str) -> None:
    robot, base = free_endpoint(), free_endpoint()
    routers = {"robot": Router((robot,)), "base": Router((base,), upstream=(robot,))}
    with contextlib.ExitStack() as stack:
        for name in sorted(routers, key=lambda name: name != first):
            stack.enter_context(routers[name])
        onboard = stack.enter_context(ZenohLink(Endpoints((robot,))))
        offboard = stack.enter_context(ZenohLink(Endpoints((base,))))
        for sender, reader, topic in ((onboard, offboard, DEPTH), (offboard, onboard, MODE)):
            got = Receiver(b"over the radio")
            reader.subscribe(topic, got)
            wait_until_wanted(sender, topic)
            sender.send(topic, b"over the radio")
            assert got.done.wait(PATIENCE_S)


def test_returning_robot_is_reconnected() -> None:
    robot, base = free_endpoint(), free_endpoint()
    with Router((base,), upstream=(robot,)), ZenohLink(Endpoints((base,))) as offboard:
        for word in (b"first", b"and again"):
            with Router((robot,)), ZenohLink(Endpoints((robot,))) as onboard:
                got = Receiver(word)
                onboard.subscribe(MODE, got)
                wait_until_wanted(offboard, MODE)
                offboard.send(MODE, word)
                assert got.done.wait(PATIENCE_S)


def test_commands_and_bulk_use_separate_links_between_routers() -> None:
    upstream = transport._router_config(("tcp/127.0.0.1:1",), ("tls/robot.local:7447",))
    assert upstream["transport"]["unicast"]["max_links"] == 2
    commands, bulk = (endpoint.partition("?")[2] for endpoint in upstream["connect"]["endpoints"])
    low, high = (int(n) for n in commands.removeprefix("prio=").split("-"))
    assert low <= int(zenoh.Priority.REAL_TIME) <= high < int(zenoh.Priority.DATA)
    low, high = (int(n) for n in bulk.partition("#")[0].removeprefix("prio=").split("-"))
    assert int(zenoh.Priority.REAL_TIME) < low <= int(zenoh.Priority.DATA) <= high
    assert upstream["connect"]["exit_on_failure"] is False, "it may be there later"


def test_router_notices_long_stop_before_new_connections(monkeypatch: pytest.MonkeyPatch) -> None:
    usual, meanwhile = signal.getsignal(signal.SIGCONT), []  # type: ignore[var-annotated]

    def fail(_config: object) -> None:
        meanwhile.append(signal.getsignal(signal.SIGCONT))
        raise TransportError("its port is taken")

    monkeypatch.setattr(transport, "_open", fail)
    router = Router(("tcp/127.0.0.1:1",))
    with pytest.raises(TransportError, match="its port is taken"):
        router.__enter__()
    assert meanwhile[0] != usual
    assert signal.getsignal(signal.SIGCONT) == usual, "as it was"
