"""Two machines on one computer: the radio between them, and evaluation of runs."""

import contextlib
import socket
import subprocess
import sys

import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.net_testbed.channel import QUEUE_BYTES, Channel
from benchmarks.net_testbed.link_outages import judge
from benchmarks.net_testbed.listener import Heard
from benchmarks.net_testbed.namespace import NetTestbedError
from benchmarks.net_testbed.stream import AGAIN_NS, SEGMENT, RadioOutages, Stream
from benchmarks.net_testbed.testbed import Namespaces, OneMachine, two_machines
from sextant.shared.scenario.scenario import Link
from sextant.shared.wire.messages import Mode
from sextant.shared.wire.ports import free_port

_MS, _SEC = 1_000_000, 1_000_000_000
_FOREVER = 10**15


@given(st.lists(st.tuples(st.integers(0, 50), st.integers(1, 1400)), max_size=60), st.floats(0, 200), st.floats(0.1, 100))
def test_packets_arrive_in_order_after_rate_and_delay(sent: list[tuple[int, int]], delay_ms: float, mbit: float) -> None:
    way, now_ns, due = Channel(Link(delay_ms, mbit), 0), 0, []
    for number, (after_ms, size) in enumerate(sent):
        now_ns += after_ms * _MS
        packet = number.to_bytes(2, "big").ljust(size, b"x")[:size]
        way.send(packet, now_ns)
        due.append((now_ns + round(delay_ms * 1e6) + size * 8e3 / mbit, packet))
    arrived: list[bytes] = []
    while (at_ns := way.due_ns) is not None:
        assert not way.arrived(at_ns - 1)
        packets = way.arrived(at_ns)
        assert packets
        for packet in packets:
            assert at_ns >= due[len(arrived)][0] - 1
            assert packet == due[len(arrived)][1]
            arrived.append(packet)
    assert len(arrived) == len(sent) - way.dropped
    assert way.carried == sum(map(len, arrived))
    assert way.dropped == 0


def test_full_channel_drops_newest_packets() -> None:
    way = Channel(Link(0.0, 1.0), 0)
    packets = 2 * QUEUE_BYTES // 1000
    for _ in range(packets):
        way.send(bytes(1000), 0)
    assert way.dropped == packets - QUEUE_BYTES // 1000 - 1
    assert len(way.arrived(_FOREVER)) == packets - way.dropped


def test_packet_loss_matches_rate_and_seed() -> None:
    ways = [Channel(Link(1.0, 0.0, 0.05), seed) for seed in (4, 4, 5)]
    for way in ways:
        for number in range(20_000):
            way.send(number.to_bytes(4, "big"), number)
    there = [way.arrived(_FOREVER) for way in ways]
    assert there[0] == there[1] != there[2]
    assert abs(ways[0].dropped / 20_000 - 0.05) < 0.005


def test_outage_drops_packets_in_flight_and_sent_packets() -> None:
    way = Channel(Link(10.0), 0)
    way.send(b"under way", 0)
    way.cut = True
    way.send(b"sent", 1)
    assert way.arrived(_FOREVER) == []
    way.cut = False
    assert way.arrived(_FOREVER) == []
    assert way.dropped == 2
    way.send(b"later", _SEC)
    assert way.arrived(_FOREVER) == [b"later"]


@given(
    st.lists(st.tuples(st.integers(0, 50), st.integers(0, 5000)), max_size=40),
    st.floats(0, 200),
    st.floats(0.1, 100),
    st.floats(0, 0.5),
    st.integers(0, 3),
)
def test_stream_is_complete_and_ordered_despite_packet_loss(
    sent: list[tuple[int, int]], delay_ms: float, mbit: float, loss: float, seed: int
) -> None:
    air = RadioOutages(Link(delay_ms, mbit, loss), seed)
    stream, now_ns, out, said = Stream(air), 0, 0, b""
    first_ns: list[int] = []  # earliest arrival of each byte
    for number, (after_ms, size) in enumerate(sent):
        now_ns += after_ms * _MS
        stream.send(bytes([number]) * size, now_ns)
        said += bytes([number]) * size
        first_ns += [now_ns + round(delay_ms * 1e6)] * size
    assert stream.waiting == len(said)
    there = b""
    while (due_ns := stream.due_ns) is not None:
        assert stream.arrived(due_ns - 1) == b""
        data = stream.arrived(due_ns)
        assert data
        out += len(data)
        assert due_ns >= first_ns[len(there) + len(data) - 1]
        there += data
        assert due_ns >= out * 8e3 / mbit
    assert there == said
    assert stream.waiting == 0
    assert air.carried == len(said)
    assert air.packets == sum(-(-size // SEGMENT) for _, size in sent)


def test_streams_share_rate_and_retransmit_lost_packets() -> None:
    air = RadioOutages(Link(0.0, 8.0), 0)  # one byte per microsecond
    one, other = Stream(air), Stream(air)
    one.send(bytes(SEGMENT), 0)
    other.send(bytes(SEGMENT), 0)
    assert (one.due_ns, other.due_ns) == (1_400_000, 2_800_000)
    lossy = Stream(RadioOutages(Link(0.0, 0.0, 0.5), 1))
    for now_ns in range(20):
        lossy.send(b"x", now_ns)
    early = lossy.arrived(AGAIN_NS - 1)
    assert len(early) < 20, "what is behind a lost packet waits for it"
    assert early + lossy.arrived(_FOREVER) == b"x" * 20


def test_outage_delays_stream_without_loss() -> None:
    air = RadioOutages(Link(10.0), 0)
    stream = Stream(air)
    stream.send(b"under way, ", 0)
    air.cut()
    stream.send(b"sent", 1)
    assert stream.due_ns is None
    assert stream.arrived(_FOREVER) == b""
    air.mend(_SEC)
    assert stream.due_ns == _SEC + AGAIN_NS
    assert stream.arrived(_SEC + AGAIN_NS) == b"under way, sent"


def _received_states(*changes: tuple[float, Mode, str, int, float]) -> list[Heard]:
    return [Heard(round(at * _SEC), mode, why, step, round(plan * _SEC)) for at, mode, why, step, plan in changes]


_LATE = "no new plan received for 0.18 s; the step is reversed"


def test_hold_and_resume_by_fresh_plan_passes() -> None:
    heard = _received_states(
        (9.0, Mode.WALK, "walking", 3, 8.9),
        (10.2, Mode.WALK, _LATE, 3, 8.9),
        (10.6, Mode.HOLD, _LATE, 3, 8.9),
        (11.0, Mode.HOLD, _LATE, 3, -1e-9),  # without a plan
        (12.9, Mode.WALK, "walking", 4, 12.8),
    )
    cut = judge(10 * _SEC, 12 * _SEC, heard)
    assert (cut.lasted_s, cut.held_s, cut.rested_s, cut.back_s) == pytest.approx((2.0, 0.2, 0.6, 0.9))
    assert cut.oldest_s == pytest.approx(0.1)
    assert cut.problems == ()


def test_standing_robot_counts_as_holding_at_outage() -> None:
    heard = _received_states((9.0, Mode.HOLD, "standing", 3, 8.0), (11.5, Mode.WALK, "walking", 4, 11.2))
    assert judge(10 * _SEC, 11 * _SEC, heard).held_s == 0.0


def test_short_outage_need_not_stop_robot() -> None:
    heard = _received_states((9.0, Mode.WALK, "walking", 3, 8.9), (10.3, Mode.WALK, "walking", 4, 10.2))
    cut = judge(10 * _SEC, 10 * _SEC + 100 * _MS, heard)
    assert cut.held_s is None
    assert cut.back_s == 0.0
    assert cut.problems == ()


@pytest.mark.parametrize(
    ("heard", "problem"),
    [
        (_received_states((9.0, Mode.WALK, "walking", 3, 8.9), (12.5, Mode.WALK, "walking", 4, 12.4)), "held after never"),
        (
            _received_states(
                (9.0, Mode.WALK, "walking", 3, 8.9), (10.4, Mode.HOLD, _LATE, 3, 8.9), (12.5, Mode.WALK, "walking", 4, 12.4)
            ),
            "held after 0.40 s",
        ),
        (_received_states((9.0, Mode.WALK, "walking", 3, 8.9), (10.2, Mode.HOLD, _LATE, 3, 8.9)), "walked again after never"),
        (
            _received_states(
                (9.0, Mode.WALK, "walking", 3, 8.9), (10.2, Mode.HOLD, _LATE, 3, 8.9), (14.5, Mode.WALK, "walking", 4, 14.4)
            ),
            "walked again after 2.50 s",
        ),
        (
            _received_states(
                (9.0, Mode.WALK, "walking", 3, 8.9), (10.2, Mode.HOLD, _LATE, 3, 8.9), (12.5, Mode.WALK, "walking", 4, 9.9)
            ),
            "accepted a plan 2.60 s old",
        ),
    ],
)
def test_outage_violation_is_reported(heard: list[Heard], problem: str) -> None:
    assert problem in judge(10 * _SEC, 12 * _SEC, heard).problems


def test_state_line_round_trips() -> None:
    heard = _received_states((1.0, Mode.WALK, 'a "reason"\n', 3, -1.0))[0]
    assert Heard.of(heard.line()) == heard
    assert "\n" not in heard.line()


@pytest.mark.slow
def test_namespaces_connect_only_through_radio_and_are_removed() -> None:
    with contextlib.ExitStack() as stack:
        try:
            bed = stack.enter_context(Namespaces(Link(5.0, 0.0, 0.0)))
        except NetTestbedError as error:
            pytest.skip(str(error))
        listen = (
            "import socket; s = socket.create_server(('10.77.0.2', 9000)); print('up', flush=True); "
            "c = s.accept()[0]; print(c.makefile().read(), flush=True)"
        )
        there = subprocess.Popen(bed.on_base(sys.executable, "-c", listen), stdout=subprocess.PIPE, text=True)
        with there:
            assert there.stdout is not None
            assert there.stdout.readline() == "up\n"
            say = "import socket; socket.create_connection(('10.77.0.2', 9000), 10).sendall(b'through the air')"
            subprocess.run(bed.on_robot(sys.executable, "-c", say), check=True, timeout=30.0)
            assert there.stdout.readline() == "through the air\n"
        carried = bed.carried()
        assert carried.from_robot > len("through the air")
        assert carried.lost_from_robot == carried.lost_to_robot == 0
        bed.cut()
        say = "import socket; socket.create_connection(('10.77.0.2', 9000), 0.3)"
        failed = subprocess.run(
            bed.on_robot(sys.executable, "-c", say), capture_output=True, text=True, timeout=30.0, check=False
        )
        assert "TimeoutError" in failed.stderr
        assert bed.carried().lost_from_robot > 0
        entering = bed.on_robot("true")
    gone = subprocess.run(entering, capture_output=True, text=True, timeout=30.0, check=False)
    assert gone.returncode == 1
    assert "has ended" in gone.stderr


def test_relay_carries_connections_with_outages() -> None:
    behind = free_port()
    with OneMachine(Link(5.0, 0.0, 0.0), behind=(behind,)) as bed:
        listen = (
            f"import socket; s = socket.create_server(('127.0.0.1', {behind})); print('up', flush=True); c = s.accept()[0]; "
            "f = c.makefile(); print(f.readline(), flush=True); c.sendall(b'heard'); print(f.read(), flush=True)"
        )
        with subprocess.Popen(bed.on_robot(sys.executable, "-c", listen), stdout=subprocess.PIPE, text=True) as there:
            assert there.stdout is not None
            assert there.stdout.readline() == "up\n"
            host, _, port = bed.seen(behind).rpartition(":")
            with socket.create_connection((host, int(port)), 10.0) as speaker:
                speaker.settimeout(10.0)
                speaker.sendall(b"through the air\n")
                assert there.stdout.readline() == "through the air\n"
                assert speaker.recv(9) == b"heard"
                there.stdout.readline()
                bed.cut()
                speaker.sendall(b"later")
                speaker.shutdown(socket.SHUT_WR)
                speaker.settimeout(0.3)
                with pytest.raises(TimeoutError):
                    speaker.recv(9)
                speaker.settimeout(10.0)
                assert bed.carried().to_robot == len("through the air\n")
                bed.mend()
                assert there.stdout.readline() == "later\n", "the end of it has come, too"
                assert speaker.recv(9) == b""
        with socket.create_connection((host, int(port)), 10.0) as speaker:
            speaker.settimeout(10.0)
            assert speaker.recv(9) == b"", "nobody is there"
        assert bed.carried().from_robot == len("heard")


def test_unavailable_namespaces_are_reported_and_relay_is_used(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Namespaces, "_command", lambda _: ("-m", "benchmarks.net_testbed.not_there"))
    with pytest.raises(NetTestbedError, match=r"no two machines here: .*not_there"):
        Namespaces(Link()).__enter__()
    # The test then uses one machine, and a report states it.
    with two_machines(Link()) as bed:
        assert bed.words.startswith(
            "one machine, the connections between the halves carried by a relay (no two machines here: "
        )
        assert "not_there" in bed.words


@pytest.mark.parametrize("words", [(), ("robot", "true"), ("12",)])
def test_enter_command_with_invalid_arguments_is_refused(words: tuple[str, ...]) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks.net_testbed.enter", *words], capture_output=True, text=True, check=False
    )
    assert done.returncode == 2
    assert "a process id and a command expected" in done.stderr
