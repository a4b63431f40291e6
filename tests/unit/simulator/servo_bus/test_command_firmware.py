"""The firmware before servos with commands, whose bus is too slow for all goals and readings.

A recorder on the bus checks it.
"""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sextant.services.simulator.servo_bus.bridge_board import Board
from sextant.services.simulator.servo_bus.bus import BusTiming, ServoBusEmulator
from sextant.services.simulator.servo_bus.host_link import Reply
from sextant.services.simulator.servo_bus.servo_bank import ServoBank
from sextant.shared.servo import bridge_protocol, lx16a
from sextant.shared.servo.bridge_protocol import (
    NEVER,
    Answer,
    Ask,
    First,
    Goals,
    Hello,
    Instruction,
    Limits,
    Message,
    Mode,
    Refusal,
    Result,
    State,
    Torque,
    Welcome,
)
from sextant.shared.servo.firmware.bridge import AFTER_GOALS_US, CATCH_UP_SPEED, CYCLE_US, NEAR
from sextant.shared.servo.firmware.commands import GOALS_US, IN_TURN
from sextant.shared.servo.lx16a import Command
from sextant.shared.servo.models import LX_16A
from sextant.shared.servo.servo_model import Packet

MS, CYCLE_NS = 1_000_000, 1000 * CYCLE_US
TABLE, UNITS = LX_16A.table, LX_16A.units
TICK = UNITS.tick_rad / bridge_protocol.ANGLE_RAD  # [0.1 mrad]
MOVES = {Command.MOVE_TIME_WRITE, Command.MOVE_TIME_WAIT_WRITE, Command.MOVE_START}
READINGS = set(lx16a.READS)


class Recorded(ServoBusEmulator):
    """A servo bus that records its packets with their times [ns], and may spoil answers."""

    def __init__(self, bank: ServoBank) -> None:
        super().__init__(bank, BusTiming(LX_16A.bus_rate, 0))
        self.heard: list[tuple[int, Packet]] = []
        self.replace: dict[int, bytes] = {}  # by the command of a request, the bytes that answer it
        self._listener = lx16a.PacketParser(instructions=True)

    def receive(self, data: bytes, now_ns: int) -> list[Reply]:
        self.heard += [(now_ns, packet) for packet in self._listener.feed(data)]
        replies, spoilt = super().receive(data, now_ns), self.replace.get(data[4])
        return replies if spoilt is None else [reply._replace(data=spoilt) for reply in replies]


class Bench:
    """A board with servos that follow their goals, and the actions of a host."""

    def __init__(self, torque: bool = False, n: int = 3) -> None:
        self.ids = bytes(range(1, n + 1))
        self.bank = ServoBank(tuple(self.ids), LX_16A)
        self.bank.column(TABLE.torque_enable)[:] = torque
        self.bus = Recorded(self.bank)
        self.board = Board(self.bus, BusTiming(usb_transaction_ns=0), LX_16A)
        self.receiver = bridge_protocol.Receiver(bridge_protocol.TO_HOST)
        self.now_ns = self.sequence = 0
        self.here = (0,) * n

    def pass_time(self, ns: int, *sent: Message | bytes) -> list[Message]:
        """Send, let time pass, and return the answers in that time."""
        said: list[Message] = []
        for message in sent:
            data = message if isinstance(message, bytes) else bridge_protocol.encode(message)
            said += self._heard(self.board.receive(data, self.now_ns))
        while ns > 0:
            beat = min(ns, MS)
            self.now_ns, ns = self.now_ns + beat, ns - beat
            said += self._heard(self.board.unsolicited_replies(self.now_ns))
            self.board.advance(self.now_ns)
            on = self.torque.astype(bool)
            angles = (self.goals - UNITS.centre) * UNITS.tick_rad
            self.bank.step(np.where(on, angles, self.bank._q), 0 * angles, 0 * angles, 1e-3)
        return said

    def _heard(self, replies: list[Reply]) -> list[Message]:
        return [message for reply in replies for message in self.receiver.feed(reply.data)]

    @property
    def goals(self) -> np.ndarray:
        return self.bank.column(TABLE.goal_position).astype(int)

    @property
    def torque(self) -> np.ndarray:
        return self.bank.column(TABLE.torque_enable).copy()

    def head(self, late_us: int = 0) -> tuple[int, int, int]:
        self.sequence += 1
        return 7, self.sequence, self.now_ns // 1000 + 1_000_000 - late_us

    def hello(self, session: int = 7) -> Hello:
        return Hello(bridge_protocol.VERSION, session, self.now_ns // 1000 + 1_000_000, self.ids)

    def to(self, position: tuple[int, ...] | None = None, speed: int = 0) -> Goals:
        return Goals(*self.head(), 200, self.here if position is None else position, (speed,) * len(self.ids))

    def state(self) -> State:
        return [message for message in self.pass_time(2 * CYCLE_NS) if isinstance(message, State)][-1]

    def sent(self, commands: set[Command] | None = None) -> list[Packet]:
        """Return the packets to the servos since the last call, of these commands or all that write."""
        found = [packet for _, packet in self.bus.heard]
        self.bus.heard.clear()
        return [packet for packet in found if (packet.code in commands if commands else packet.code not in READINGS)]


def in_session(torque: bool = False, n: int = 3) -> Bench:
    bench = Bench(torque, n)
    bench.pass_time(120 * MS, bench.hello())
    return bench


def on(n: int = 3) -> Bench:
    bench = in_session(n=n)
    bench.pass_time(20 * MS, bench.to())
    bench.pass_time(20 * MS, bench.to(), Torque(*bench.head(), 1))
    bench.pass_time(20 * MS, bench.to())
    bench.sent()
    assert bench.board.firmware.mode == Mode.ON
    return bench


def test_nothing_but_torque_off_reaches_servos_before_hello() -> None:
    bench = Bench(torque=True)
    said = bench.pass_time(1000 * MS, bench.to(), Torque(*bench.head(), 1), First(*bench.head(), bench.ids))
    assert {type(message) for message in said} == {Welcome}
    assert bench.bus.heard == []
    bench.pass_time(5 * MS, Torque(99, 1, 0, 0))
    assert not bench.torque.any()
    bench.pass_time(150 * MS, bench.hello())
    bench.pass_time(20 * MS, bench.to())
    assert bench.state().mode is Mode.OFF
    off = lx16a.write(lx16a.BROADCAST_ID, Command.LOAD_OR_UNLOAD_WRITE, 0)
    assert {lx16a.encode(packet.servo_id, packet.code, packet.parameters) for packet in bench.sent()} == {off}


@pytest.mark.parametrize(("torque", "mode"), [(True, Mode.HOLDING), (False, Mode.OFF)])
def test_new_session_adopts_torque_and_goals_without_writing(torque: bool, mode: Mode) -> None:
    bench = Bench(torque)
    bench.bank.column(TABLE.goal_position)[:] = [500, 520, 700]  # the last one is 48 deg from its servo
    bench.bank._q[:] = 0.0
    bench.bank.step(np.zeros(3), np.zeros(3), np.zeros(3), 1e-3)
    held = bench.bank.step
    bench.bank.step = lambda q, *rest: held(np.zeros(3), *rest)  # type: ignore[method-assign]
    bench.pass_time(100 * MS, bench.hello())
    state = bench.state()
    assert (state.mode, state.goals_age) == (mode, NEVER)
    assert bench.sent() == []
    expected = [0, 20 * UNITS.tick_rad * LX_16A.gain_stiffness / bridge_protocol.LOAD, 0] if torque else [0, 0, 0]
    assert state.load == pytest.approx(expected, abs=2), "the goal that each servo has, less its position"


def test_a_servo_without_torque_ends_that_of_all() -> None:
    bench = Bench(torque=True)
    bench.bank.column(TABLE.torque_enable)[1] = 0
    bench.pass_time(100 * MS, bench.hello())
    assert bench.state().mode is Mode.OFF


def test_all_goals_precede_torque_on_and_follow_it() -> None:
    bench = in_session(n=18)
    bench.pass_time(20 * MS, bench.to())
    assert bench.sent() == [], "whether a goal turns torque on is not published"
    bench.pass_time(40 * MS, bench.to(), Torque(*bench.head(), 1))
    sent = bench.sent()
    at = [packet.code for packet in sent].index(Command.LOAD_OR_UNLOAD_WRITE)
    assert sent[at].servo_id == lx16a.BROADCAST_ID
    before, after = ({packet.servo_id for packet in part if packet.code in MOVES} for part in (sent[:at], sent[at:]))
    assert before == after == set(bench.ids)
    assert bench.torque.all()


def test_refusals_are_those_of_servos_with_registers() -> None:
    def write(bench: Bench, command: Command, data: bytes) -> Ask:
        return Ask(*bench.head(), 1, int(Instruction.WRITE), int(command), 0, data)

    cases = [
        (Refusal.QUESTION, lambda b: Limits(*b.head(), b.here)),
        (Refusal.QUESTION, lambda b: write(b, Command.LOAD_OR_UNLOAD_WRITE, b"\1")),
        (Refusal.QUESTION, lambda b: write(b, Command.MOVE_TIME_WRITE, bytes(4))),
        (Refusal.QUESTION, lambda b: write(b, Command.MOVE_TIME_WAIT_WRITE, bytes(4))),
        (Refusal.QUESTION, lambda b: write(b, Command.MODE_WRITE, b"\1\0\0\1")),
        (Refusal.QUESTION, lambda b: write(b, Command.POS_READ, b"\1\1")),
        (Refusal.QUESTION, lambda b: Ask(*b.head(), 1, int(Instruction.WRITE), int(Command.MOVE_START), 0, b"\1")),
        (Refusal.QUESTION, lambda b: Ask(*b.head(), 1, int(Instruction.READ), int(Command.POS_READ), 3, b"")),
        (Refusal.QUESTION, lambda b: Ask(*b.head(), 1, int(Instruction.READ), int(Command.ID_WRITE), 1, b"")),
        (Refusal.QUESTION, lambda b: Ask(*b.head(), 1, int(Instruction.REBOOT), 0, 0, b"")),
        (Refusal.AGE, lambda b: First(*b.head(late_us=250_000), b.ids)),
        (Refusal.COUNT, lambda b: Goals(*b.head(), 200, (0,), (0,))),
        (
            Refusal.FAR,
            lambda b: bridge_protocol.encode(b.to((4500, 0, 0))) + bridge_protocol.encode(Torque(*b.head(), 1)),
        ),
    ]
    for refusal, make in cases:
        bench = in_session()
        bench.pass_time(20 * MS, bench.to())
        bench.pass_time(5 * MS, make(bench))
        state = bench.state()
        assert (state.refusal, state.refused) == (refusal, 1), make
        assert bench.sent() == []


def test_requests_are_commands_and_writes_are_not_answered_by_servos() -> None:
    bench = in_session()
    read = Ask(*bench.head(), 2, int(Instruction.READ), int(Command.ANGLE_LIMIT_READ), 4, b"")
    write = Ask(*bench.head(), 2, int(Instruction.WRITE), int(Command.ANGLE_LIMIT_WRITE), 0, b"\1\0\2\0")
    again = Ask(*bench.head(), 2, int(Instruction.READ), int(Command.ANGLE_LIMIT_READ), 4, b"")
    missing = Ask(*bench.head(), 9, int(Instruction.PING), 0, 0, b"")
    answers = [m for m in bench.pass_time(30 * MS, read, write, again, missing) if isinstance(m, Answer)]
    assert [m.result for m in answers] == [Result.ANSWERED, Result.ANSWERED, Result.ANSWERED, Result.SILENT]
    code = int(Command.ANGLE_LIMIT_READ)
    limits = (1000).to_bytes(2, "little")
    assert [(m.error, m.data) for m in answers] == [(code, b"\0\0" + limits), (0, b""), (code, b"\1\0\2\0"), (0, b"")]


def test_one_servo_gets_torque_only_in_mode_on_near_its_goal() -> None:
    bench = on()
    bench.bank.column(TABLE.torque_enable)[0] = 0
    bench.pass_time(10 * MS, Ask(*bench.head(), 1, int(Instruction.WRITE), int(Command.LOAD_OR_UNLOAD_WRITE), 0, b"\1"))
    assert bench.torque.all()


def test_each_servo_is_read_and_each_goal_written_in_time() -> None:
    """Eighteen goals change in each cycle: the bus carries most of them, and four readings besides the named ones."""
    bench, aims, slopes = on(18), np.zeros(18), np.array([3, 2, 1] * 6)
    first = bytes((2, 8, 14))
    oldest = 0
    for k in range(60):
        aims = k * slopes * TICK
        sent = bench.to(tuple(map(round, aims)))
        said = bench.pass_time(GOALS_US * 1000, First(*bench.head(), first), replace_sequence(bench, sent))
        if k > 10:
            states = [m for m in said if isinstance(m, State)]
            oldest = max(oldest, *states[-1].age)
            lags = UNITS.centre + k * slopes - bench.goals
            assert (lags[[1, 7, 13]] == 0).all()
            assert (lags <= 3 * slopes).all()
    assert oldest <= 1300, "0.1 ms"
    times: dict[int, list[int]] = {}
    for at_ns, packet in bench.bus.heard:
        if packet.code == Command.POS_READ:
            times.setdefault(packet.servo_id, []).append(at_ns)
    readings = sum(map(len, times.values())) / 60
    assert 3 + IN_TURN - 1 <= readings <= 3 + IN_TURN + 1
    assert all(len(times[i]) >= 58 for i in first), "in each cycle"
    moved = [at_ns for at_ns, packet in bench.bus.heard if packet.servo_id == 2 and packet.code in MOVES][-1]
    read = times[2][-1]
    assert 4 * MS < read - moved < AFTER_GOALS_US * 1000, "after its goal, and before the state behind it"


def replace_sequence(bench: Bench, goals: Goals) -> Goals:
    """Return the same goals as a newer order."""
    return Goals(*bench.head(), goals.lifetime_ms, goals.position, goals.speed)


def test_unchanged_goals_are_repeated_because_a_lost_one_is_not_noticed() -> None:
    bench = on(18)
    bench.bank.column(TABLE.goal_position)[5] = 777  # its last goal was lost
    for _ in range(12):
        bench.pass_time(20 * MS, bench.to())
    assert (bench.goals == UNITS.centre).all()


def test_torque_off_stops_goals_that_wait() -> None:
    bench = on(18)
    bench.pass_time(3 * MS, bench.to((150,) * 18))
    bench.sent()
    bench.pass_time(100 * MS, Torque(*bench.head(), 0), bench.to((150,) * 18))
    sent = bench.sent()
    assert {packet.code for packet in sent} == {Command.LOAD_OR_UNLOAD_WRITE}
    assert {packet.parameters for packet in sent} == {b"\0"}
    assert len(sent) >= 9, "in each cycle"
    assert not bench.torque.any()
    assert set(bench.state().load) == {0}


def test_stale_goals_make_the_board_hold_and_distant_ones_are_caught_up_together() -> None:
    bench = on()
    bench.pass_time(230 * MS)
    bench.sent()
    assert bench.state().mode is Mode.HOLDING
    bench.pass_time(500 * MS)
    assert bench.sent() == []
    aims = (5000, -2500, 0)
    took, before = 0, bench.goals
    while bench.board.firmware.mode != Mode.ON or took == 0:
        bench.pass_time(20 * MS, bench.to(aims))
        took += 1
        moved, near = np.abs(bench.goals - before) * TICK, bench.board.firmware.mode == Mode.ON
        assert moved.max() <= (NEAR if near else CATCH_UP_SPEED * 0.02) + 1.5 * TICK
        before = bench.goals
        assert took < 100
    assert took >= (5000 - NEAR) / (CATCH_UP_SPEED * 0.02) - 1
    bench.pass_time(40 * MS, bench.to(aims))
    assert (bench.goals == [UNITS.ticks(aim * bridge_protocol.ANGLE_RAD) for aim in aims]).all()


def test_speed_limit_becomes_the_time_of_the_way() -> None:
    bench = on()
    bench.bank.step = lambda *_: None  # type: ignore[method-assign]
    bench.pass_time(10 * MS, bench.to((1000, 0, 0), speed=500))
    goal = next(packet for packet in bench.sent(MOVES) if packet.servo_id == 1)
    assert lx16a.values_of(goal) == (UNITS.ticks(0.1), 200)
    bench.pass_time(90 * MS)
    load = bench.state().load[0] * bridge_protocol.LOAD / LX_16A.gain_stiffness
    assert 0.03 < load < 0.09, "of a servo that stands still: the way of its goal until then"


def test_silent_servo_and_wrong_answers_do_not_stop_the_others() -> None:
    bench = on()
    bench.bus.cut_off(frozenset((1,)))
    for _ in range(25):
        said = bench.pass_time(20 * MS, bench.to())
    state = [m for m in said if isinstance(m, State)][-1]
    assert state.age[1] > 4500
    assert max(state.age[0], state.age[2]) < 300
    assert state.silent > 10
    bench.bus.replace = {int(Command.POS_READ): lx16a.response(1, Command.VIN_READ, 512)}
    for _ in range(25):
        said = bench.pass_time(20 * MS, bench.to())
    state = [m for m in said if isinstance(m, State)][-1]
    assert min(state.age) > 4000, "an answer to another command is none"
    bench.bus.replace = {int(Command.POS_READ): lx16a.response(1, Command.POS_READ, 1200)}
    garbled = state.garbled
    for _ in range(25):
        said = bench.pass_time(20 * MS, bench.to())
    state = [m for m in said if isinstance(m, State)][-1]
    assert min(state.age) > 4000, "a position that no servo has is none"
    assert state.garbled > garbled


def test_lost_readings_are_repeated_but_not_those_of_a_silent_servo() -> None:
    bench, rng, receive = on(18), np.random.default_rng(1000), ServoBusEmulator.receive
    bench.bus.cut_off(frozenset((5,)))

    def lose(data: bytes, now_ns: int) -> list[Reply]:
        bench.bus.heard += [(now_ns, packet) for packet in bench.bus._listener.feed(data)]
        replies = receive(bench.bus, data, now_ns)
        return [] if data[4] == Command.POS_READ and rng.random() < 0.1 else replies

    bench.bus.receive = lose  # type: ignore[method-assign]
    oldest = np.zeros(18)
    for k in range(100):
        said = bench.pass_time(20 * MS, bench.to((round(2 * k * TICK),) * 18))
        if k > 20:
            oldest = np.maximum(oldest, [m for m in said if isinstance(m, State)][-1].age)
    assert np.delete(oldest, 5).max() < 3000, "0.1 ms"
    assert oldest[5] > 15_000
    asked = [packet.servo_id for at_ns, packet in bench.bus.heard if packet.code == Command.POS_READ][-300:]
    repeated = [one for one, before in itertools.pairwise(asked) if one == before]
    assert 6 in asked
    assert 6 not in repeated
    assert len(repeated) > 10


def test_voltage_and_temperature_of_each_servo_come_in_turn() -> None:
    bench = in_session()
    bench.bank.temperature[:] = [31.0, 32.0, 33.0]
    volts, degrees = [set[int](), set[int](), set[int]()], [set[int](), set[int](), set[int]()]
    for message in bench.pass_time(1000 * MS):
        if isinstance(message, State):
            for k in range(3):
                volts[k].add(message.voltage[k])
                degrees[k].add(message.temperature[k])
    volt = round(float(bench.bank.voltage) / bridge_protocol.VOLT)
    assert [found - {0} for found in volts] == [{volt}] * 3
    assert all(len(found - {0}) == 1 and 0 in found for found in degrees)
    assert [max(found) for found in degrees] == pytest.approx([31, 32, 33], abs=1)


@pytest.mark.parametrize("silent", [False, True])
def test_temperature_of_the_hottest_servo_that_answers_comes_often(silent: bool) -> None:
    bench = in_session(n=18)
    bench.bank.temperature[7], bench.bank.temperature[8] = 58.0, 59.0 if silent else 50.0
    bench.pass_time(6000 * MS)
    bench.bus.cut_off(frozenset((8,) if silent else ()))
    bench.pass_time(200 * MS)
    found = [message for message in bench.pass_time(3000 * MS) if isinstance(message, State)]
    told = [k for k, message in enumerate(found) if message.temperature[7]]
    assert max(later - before for before, later in itertools.pairwise((0, *told))) * 3000 / len(found) < 400, "[ms]"


def test_new_session_with_fewer_servos_forgets_those_before() -> None:
    bench = on(18)
    bench.pass_time(4 * MS, First(*bench.head(), bytes((17, 18))), bench.to((20,) * 18))
    bench.ids, bench.here = bytes((1, 2)), (0, 0)
    bench.sent()
    bench.pass_time(100 * MS, bench.hello(8))
    bench.bus.heard = [found for found in bench.bus.heard if found[0] > bench.now_ns - 80 * MS]
    assert {packet.servo_id for packet in bench.sent(READINGS)} == {1, 2}


ORDERS = st.lists(
    st.tuples(
        st.sampled_from(["goals", "on", "off", "first", "write", "hello", "new hello", "old", "wait", "noise"]),
        st.tuples(*[st.integers(-26179, 26179)] * 3),
        st.integers(1, 300),
        st.binary(max_size=6),
    ),
    max_size=25,
)


@pytest.mark.slow
@settings(deadline=None, derandomize=True, max_examples=100)
@given(ORDERS, st.booleans())
def test_random_orders_move_and_enable_only_by_torque_order(
    orders: list[tuple[str, tuple[int, int, int], int, bytes]], torque: bool
) -> None:
    bench = in_session(torque)
    on_ordered = False
    for what, words, ms, noise in orders:
        bench.bus.heard.clear()
        message: Message | bytes
        match what:
            case "goals":
                message = bench.to(words, abs(words[0]))
            case "on" | "off":
                message = Torque(*bench.head(), int(what == "on"))
            case "first":
                message = First(*bench.head(), bytes({1 + ms % 3, 9}))
            case "write":
                message = Ask(*bench.head(), 1, int(Instruction.WRITE), ms % 40, 0, noise)
            case "hello" | "new hello":
                message = bench.hello(7 if what == "hello" else 7 + ms)
            case "old":
                message = Torque(*bench.head(late_us=250_000), 1)
            case "noise":
                message = b"\0" + noise + b"\0"
            case _:
                message = b""
        was_off = bench.board.firmware.mode == Mode.OFF
        bench.pass_time(ms * MS, message)
        sent = bench.sent()
        turned_on = [p for p in sent if p.code == Command.LOAD_OR_UNLOAD_WRITE and p.parameters != b"\0"]
        if turned_on and what != "write":
            assert what == "on"
            assert sent[0].code in MOVES, "behind goals"
            on_ordered = True
        if what == "off":
            assert not bench.torque.any()
            on_ordered = False
        elif not on_ordered and not torque:
            assert not bench.torque.any()
        if was_off and what != "on":
            assert not [p for p in sent if p.code in MOVES]
    assert bench.board.firmware.due_us > (bench.now_ns - CYCLE_NS) // 1000
