"""The reference firmware as a state machine from bytes and times to bytes.

A recorder on the servo bus checks it.
"""

from collections.abc import Iterable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sextant.services.simulator.config import Settings
from sextant.services.simulator.service import Simulator
from sextant.services.simulator.servo_bus.bridge_board import Board
from sextant.services.simulator.servo_bus.bus import BusTiming, ServoBusEmulator
from sextant.services.simulator.servo_bus.host_link import Reply
from sextant.services.simulator.servo_bus.servo_bank import ServoBank
from sextant.shared.files.config import ConfigError
from sextant.shared.robot.profiles import load_profile
from sextant.shared.scenario.loading import load_scenario
from sextant.shared.servo import bridge_protocol
from sextant.shared.servo import dynamixel as dxl
from sextant.shared.servo.bridge_protocol import Message, Mode, Receiver, Refusal, Result
from sextant.shared.servo.dynamixel import Instruction, PacketParser
from sextant.shared.servo.firmware import servo as firmware_servo
from sextant.shared.servo.firmware.bridge import CYCLE_US, GREETING_US, Firmware
from sextant.shared.servo.servo_model import Packet, Register

WILD = settings(deadline=None, derandomize=True, max_examples=100)
MS = 1_000_000
CYCLE_NS, GREETING_NS = 1000 * CYCLE_US, 1000 * GREETING_US
IDS = bytes([1, 2, 3])
HERE = (0, 0, 0)  # [0.1 mrad]


class Recorded(ServoBusEmulator):
    """A servo bus that records its packets."""

    def __init__(self, bank: ServoBank) -> None:
        super().__init__(bank, BusTiming(usb_transaction_ns=0))
        self.heard: list[Packet] = []
        self._listener = PacketParser()

    def receive(self, data: bytes, now_ns: int) -> list[Reply]:
        self.heard += self._listener.feed(data)
        return super().receive(data, now_ns)


class Bench:
    """A board with servos, and the actions of a host."""

    def __init__(self, torque: bool = False) -> None:
        self.bank = ServoBank(tuple(IDS))
        self.bank.tables[:, dxl.TORQUE_ENABLE.address] = torque
        self.bus = Recorded(self.bank)
        self.board = Board(self.bus, BusTiming(usb_transaction_ns=0))
        self.receiver = Receiver(bridge_protocol.TO_HOST)
        self.now_ns = 0
        self.sequence = 0

    def pass_time(self, ns: int, *sent: Message | bytes) -> list[Message]:
        """Send, let time pass, and return the answers in that time."""
        said: list[Message] = []
        for message in sent:
            data = message if isinstance(message, bytes) else bridge_protocol.encode(message)
            said += self._heard(self.board.receive(data, self.now_ns))
        while ns > 0:
            beat = min(ns, CYCLE_NS)
            self.now_ns, ns = self.now_ns + beat, ns - beat
            said += self._heard(self.board.unsolicited_replies(self.now_ns))
            self.board.advance(self.now_ns)
            self.bank.step(np.zeros(3), np.zeros(3), np.zeros(3), 1e-3)
        return said

    def _heard(self, replies: Iterable[Reply]) -> list[Message]:
        return [message for reply in replies for message in self.receiver.feed(reply.data)]

    def head(self, session: int = 7, late_us: int = 0) -> tuple[int, int, int]:
        self.sequence += 1
        return session, self.sequence, self.now_ns // 1000 + 1_000_000 - late_us

    def hello(self, session: int = 7) -> bridge_protocol.Hello:
        return bridge_protocol.Hello(bridge_protocol.VERSION, session, self.now_ns // 1000 + 1_000_000, IDS)

    def goals(self, position: tuple[int, ...] = HERE) -> bridge_protocol.Goals:
        return bridge_protocol.Goals(*self.head(), 200, position, (0,) * len(position))

    def state(self) -> bridge_protocol.State:
        said = [m for m in self.pass_time(2 * CYCLE_NS) if isinstance(m, bridge_protocol.State)]
        return said[-1]


def in_session(torque: bool = True) -> Bench:
    bench = Bench(torque)
    bench.pass_time(20 * MS, bench.hello())
    return bench


def writes(bench: Bench, register: Register) -> list[Packet]:
    """Return the writes to a register by any kind of packet."""
    found = []
    for packet in bench.bus.heard:
        if packet.code in (Instruction.WRITE, Instruction.SYNC_WRITE):
            start = packet.parameters[0]
            size = packet.parameters[1] if packet.code == Instruction.SYNC_WRITE else len(packet.parameters) - 1
            if start <= register.address < start + size:
                found.append(packet)
    return found


def test_firmware_only_announces_itself_until_hello() -> None:
    bench = Bench(torque=True)
    said = bench.pass_time(10 * GREETING_NS)
    assert 9 <= len(said) <= 11
    assert {(type(m), m.session) for m in said if isinstance(m, bridge_protocol.Welcome)} == {(bridge_protocol.Welcome, 0)}
    bench.pass_time(
        50 * MS, bench.goals(), bridge_protocol.Torque(*bench.head(), 1), bridge_protocol.Limits(*bench.head(), HERE)
    )
    assert bench.bus.heard == []


def test_torque_off_is_obeyed_before_hello_and_persists() -> None:
    bench = Bench(torque=True)
    bench.pass_time(5 * MS, bridge_protocol.Torque(99, 1, 0, 0))
    assert not bench.bank.tables[:, dxl.TORQUE_ENABLE.address].any()
    bench.pass_time(50 * MS, bench.hello())
    bench.pass_time(20 * MS, bench.goals())
    assert bench.state().mode is Mode.OFF
    assert writes(bench, dxl.GOAL_POSITION) == []


def test_new_session_adopts_torque_state_without_writing() -> None:
    for torque, mode in ((True, Mode.HOLDING), (False, Mode.OFF)):
        bench = in_session(torque)
        state = bench.state()
        assert (state.mode, state.goals_age) == (mode, bridge_protocol.NEVER)
        assert {packet.code for packet in bench.bus.heard} == {Instruction.READ}
    bench = Bench(torque=True)
    bench.bank.tables[1, dxl.TORQUE_ENABLE.address] = 0
    bench.pass_time(20 * MS, bench.hello())
    assert bench.state().mode is Mode.OFF, "one servo has no torque: only an order makes them one again"


def test_repeated_hello_is_ignored_and_new_session_ends_old_one() -> None:
    bench = in_session()
    bench.pass_time(20 * MS, bench.goals())
    bench.pass_time(5 * MS, bench.hello())
    assert bench.state().mode is Mode.ON
    bench.pass_time(20 * MS, bench.hello(session=8))
    bench.pass_time(20 * MS, bench.goals())
    state = bench.state()
    assert (state.session, state.refusal, state.refused, state.heard) == (8, Refusal.SESSION, 1, 0)


def test_each_refusal_is_reported_in_state() -> None:
    cases = {
        Refusal.SESSION: lambda b: bridge_protocol.Goals(8, 99, b.now_ns // 1000, 200, HERE, HERE),
        Refusal.ORDER: lambda b: bridge_protocol.Limits(7, 1, b.now_ns // 1000 + 1_000_000, HERE),
        Refusal.AGE: lambda b: bridge_protocol.Limits(*b.head(late_us=250_000), HERE),
        Refusal.COUNT: lambda b: b.goals((0, 0)),
        Refusal.QUESTION: lambda b: bridge_protocol.Ask(*b.head(), 1, int(Instruction.RESET), 0, 0, b""),
        Refusal.FAR: lambda b: (
            bridge_protocol.encode(b.goals((4500, 0, 0))) + bridge_protocol.encode(bridge_protocol.Torque(*b.head(), 1))
        ),
    }
    for refusal, make in cases.items():
        bench = in_session(torque=False)
        bench.pass_time(20 * MS, bench.goals())
        bench.pass_time(5 * MS, make(bench))
        state = bench.state()
        assert (state.refusal, state.refused) == (refusal, 1)
        assert writes(bench, dxl.TORQUE_ENABLE) == writes(bench, dxl.TORQUE_LIMIT) == []


def test_requests_beyond_queue_size_are_refused_and_all_are_answered() -> None:
    bench = in_session()
    asked = [bridge_protocol.Ask(*bench.head(), 1, int(Instruction.READ), 36, 2, b"") for _ in range(12)]
    said = bench.pass_time(40 * MS, b"".join(map(bridge_protocol.encode, asked)))
    answers = [m for m in said if isinstance(m, bridge_protocol.Answer)]
    assert sorted(m.sequence for m in answers) == [ask.sequence for ask in asked]
    assert {m.result for m in answers} == {Result.ANSWERED, Result.REFUSED}
    assert {m.data for m in answers if m.result is Result.ANSWERED} == {b"\x00\x02"}
    assert bench.state().refusal is Refusal.BUSY


def test_register_write_that_enables_torque_is_refused() -> None:
    for address, data in ((24, b"\1"), (20, bytes((0, 0, 0, 0, 1))), (24, b"\xff\0"), (18, bytes([1] * 20))):
        bench = in_session(torque=False)
        ask = bridge_protocol.Ask(*bench.head(), 1, int(Instruction.WRITE), address, 0, data)
        (answer,) = (m for m in bench.pass_time(20 * MS, ask) if isinstance(m, bridge_protocol.Answer))
        assert answer.result is Result.REFUSED
        assert writes(bench, dxl.TORQUE_ENABLE) == []


def test_state_is_sent_and_all_servos_are_read_in_each_cycle() -> None:
    bench = in_session()
    states = [m for m in bench.pass_time(100 * CYCLE_NS) if isinstance(m, bridge_protocol.State)]
    assert len(states) == 100
    assert np.diff([m.sequence for m in states]).tolist() == [1] * 99
    assert np.diff([m.time_us for m in states]).tolist() == [CYCLE_NS // 1000] * 99
    assert max(max(m.age) for m in states) <= 110


def test_silent_servos_do_not_delay_goals_and_states() -> None:
    bench = in_session()
    bench.bank.tables[:, dxl.STATUS_RETURN_LEVEL.address] = 0
    states = [m for m in bench.pass_time(50 * CYCLE_NS) if isinstance(m, bridge_protocol.State)]
    assert len(states) == 50
    assert states[-1].silent >= 50
    assert min(states[-1].age) >= 4000
    bench.pass_time(5 * MS, bench.goals((102, 102, 102)))
    assert (bench.bank.tables.view("<u2")[:, dxl.GOAL_POSITION.address // 2] == 514).all()


WORDS = st.tuples(*[st.integers(-26179, 26179)] * 3)
ORDERS = st.lists(
    st.tuples(
        st.sampled_from(["goals", "on", "off", "limits", "write", "hello", "new hello", "old", "replay", "wait", "noise"]),
        WORDS,
        st.integers(1, 300),
        st.binary(max_size=40),
    ),
    max_size=25,
)


@pytest.mark.slow
@WILD
@given(ORDERS, st.booleans())
def test_random_orders_enable_torque_only_by_torque_order(
    orders: list[tuple[str, tuple[int, int, int], int, bytes]], torque: bool
) -> None:
    bench = in_session(torque)
    on_ordered, last = False, bridge_protocol.encode(bench.hello())
    for what, words, ms, noise in orders:
        bench.bus.heard.clear()
        message: Message | bytes
        match what:
            case "goals":
                message = bench.goals(words)
            case "on" | "off":
                message = bridge_protocol.Torque(*bench.head(), int(what == "on"))
            case "limits":
                message = bridge_protocol.Limits(*bench.head(), tuple(abs(word) for word in words))
            case "write":
                message = bridge_protocol.Ask(*bench.head(), 1, int(Instruction.WRITE), ms % 60, 0, noise)
            case "hello" | "new hello":
                message = bench.hello(7 if what == "hello" else 7 + ms)
            case "old":
                message = bridge_protocol.Torque(*bench.head(late_us=250_000), 1)
            case "replay":
                message = last
            case "noise":
                message = b"\0" + noise + b"\0"
            case _:
                message = b""
        was_off = bench.board.firmware.mode == Mode.OFF
        bench.pass_time(ms * MS, message)
        turned_on = [p for p in writes(bench, dxl.TORQUE_ENABLE) if p.code == Instruction.SYNC_WRITE or p.parameters[1]]
        if turned_on and what != "write":  # while torque is ordered on, one servo near its goal may get it by a write
            assert what == "on"
            assert writes(bench, dxl.GOAL_POSITION), "behind goals"
            on_ordered = True
        if what == "off":
            assert not bench.bank.tables[:, dxl.TORQUE_ENABLE.address].any()
            on_ordered = False
        elif not on_ordered and not torque:
            assert not bench.bank.tables[:, dxl.TORQUE_ENABLE.address].any()
        if was_off and what not in ("on", "write"):
            assert writes(bench, dxl.GOAL_POSITION) == []
        if what in ("on", "goals"):
            last = bridge_protocol.encode(message) if isinstance(message, Message) else last
    assert bench.board.firmware.due_us > (bench.now_ns - CYCLE_NS) // 1000


@WILD
@given(st.lists(st.tuples(st.integers(0, 30 * MS), st.binary(max_size=120), st.binary(max_size=60)), max_size=20))
def test_random_bytes_raise_no_error_and_cause_no_write(
    parts: list[tuple[int, bytes, bytes]],
) -> None:
    firmware, recorder, now_us = Firmware(1, "AX-12A", "a board"), PacketParser(), 0
    hello = bridge_protocol.encode(bridge_protocol.Hello(bridge_protocol.VERSION, 7, 0, IDS))
    _, sent = firmware.step(now_us, hello)
    for wait_ns, from_host, from_bus in parts:
        now_us += wait_ns // 1000
        to_host, to_bus = firmware.step(now_us, b"\0" + from_host + b"\0", from_bus)
        sent += to_bus
        assert len(to_host) <= 2 * 404
    assert {packet.code for packet in recorder.feed(sent)} <= {Instruction.READ}


def test_simulator_with_servos_that_the_firmware_lacks_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(firmware_servo, "MODELS", {"STS3215": 5})
    words = r"the bridge's firmware: one of the servos \['STS3215'\] expected, found AX-12A"
    with pytest.raises(ConfigError, match=words):
        Simulator(load_profile("phantomx_mk2"), Settings(bridge=True), load_scenario("flat"))
