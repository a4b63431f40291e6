"""MCU bridge: driver, protocol, reference firmware and emulated servos.

The tests cover normal operation and the failure of each part.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sextant.services.actuator.servo_bus.bus_driver import BusDisconnectedError, BusSetupError, Lost
from sextant.services.actuator.servo_bus.mcu_bridge import READ_NS, Bridge
from sextant.services.simulator.servo_bus.bridge_board import Board
from sextant.services.simulator.servo_bus.bus import BusTiming, ServoBusEmulator
from sextant.services.simulator.servo_bus.memory_port import MemoryPort
from sextant.services.simulator.servo_bus.servo_bank import ServoBank
from sextant.shared.servo import bridge_protocol
from sextant.shared.servo import dynamixel as dxl
from sextant.shared.servo.bridge_protocol import AGE_UNIT_US, ANGLE_RAD, VERSION, Mode, Refusal, Welcome
from sextant.shared.servo.firmware import bridge as firmware
from sextant.shared.servo.servo_model import ServoError

WILD = settings(deadline=None, derandomize=True, max_examples=40)

IDS = (8, 10, 12, 14, 16, 18, 2, 4, 6, 7, 9, 11, 13, 15, 17, 1, 3, 5)
PERIOD = 20_000_000
CYCLE_NS = 1000 * firmware.CYCLE_US
TICK = dxl.TICK_RAD / ANGLE_RAD
FAR_TICKS, NEAR_TICKS = int(firmware.FAR / TICK), round(firmware.NEAR / TICK)
CATCH_UP_TICKS_S = firmware.CATCH_UP_SPEED / TICK
BUDGET = 6_500_000
HERE = np.full(18, 512)


class Rig:
    """Servos that follow their goals, a board, a clock set by the test, and a driver."""

    def __init__(self, ids: tuple[int, ...] = IDS, torque: bool = False) -> None:
        self.now_ns = 0
        self.bank = ServoBank(ids)
        self.bank.tables[:, dxl.TORQUE_ENABLE.address] = torque
        self.board = Board(ServoBusEmulator(self.bank, BusTiming(usb_transaction_ns=0)))
        self.ids = ids
        self.written: list[np.ndarray] = []  # goal registers, cycle by cycle
        self.plug_in()

    def plug_in(self, tamper: Callable[[bytes], bytes] | None = None) -> None:
        """Connect a new driver to a new port."""
        self.port = MemoryPort(self.board, lambda: self.now_ns, READ_NS * 1e-9)
        if tamper is not None:
            read = self.port.read
            self.port.read = lambda size=1: tamper(read(size))  # type: ignore[method-assign]
        self.driver = Bridge(self.port, self.ids, self.port.now_ns)

    def ready(self) -> "Rig":
        self.driver.setup()
        self.cycle(2)
        return self

    @property
    def goals(self) -> np.ndarray:
        return self.bank.tables.view("<u2")[:, dxl.GOAL_POSITION.address // 2].astype(int)

    @property
    def torque(self) -> np.ndarray:
        return self.bank.tables[:, dxl.TORQUE_ENABLE.address].copy()

    @property
    def mode(self) -> Mode:
        assert self.driver.state is not None
        return self.driver.state.mode

    def pass_time(self, count: int = 1) -> None:
        """Advance the board and the servos for some cycles without the host."""
        for _ in range(count):
            self.now_ns = max(self.now_ns + PERIOD, self.port.now_ns())
            self.board.advance(self.now_ns)
            on = self.torque.astype(bool)
            q = np.where(on, (self.goals - 512) * dxl.TICK_RAD, self.bank._q)
            self.bank.step(q, np.zeros(len(q)), np.zeros(len(q)), PERIOD * 1e-9)
            self.written.append(self.goals)

    def cycle(self, count: int = 1, goals: np.ndarray | None = None) -> int:
        """Run cycles of an actuator; return the number of readings in the last one."""
        readings = 0
        for _ in range(count):
            self.pass_time()
            readings = len(self.driver.poll(BUDGET))
            if goals is not None:
                self.driver.sync_write_goals(goals)
        return readings


def walking() -> Rig:
    """Return a rig with torque on that forwards goals."""
    rig = Rig(torque=True).ready()
    rig.cycle(4, HERE)
    assert rig.mode is Mode.ON
    return rig


def test_setup_changes_only_the_return_delay() -> None:
    for torque in (False, True):
        rig = Rig(torque=torque)
        rig.bank.tables.view("<u2")[:, dxl.GOAL_POSITION.address // 2] = 520
        before = rig.bank.tables.copy()
        rig.ready()
        before[:, dxl.RETURN_DELAY.address] = 0
        live = slice(dxl.PRESENT_POSITION.address, dxl.MOVING.address + 1)
        before[:, live] = rig.bank.tables[:, live]
        assert (rig.bank.tables == before).all()
        assert rig.mode is (Mode.HOLDING if torque else Mode.OFF)
        assert not rig.driver.lost


def test_setup_takes_less_than_1_s() -> None:
    rig = Rig()
    rig.driver.setup()
    assert rig.port.now_ns() < 1_000_000_000


def test_all_servos_are_read_in_each_cycle_with_time_stamps() -> None:
    rig = Rig().ready()
    q = np.linspace(-1.0, 1.0, 18)
    rig.bank.step(q, np.full(18, 0.5), np.full(18, -0.3), 0.002)
    voltage = rig.bank.voltage
    rig.pass_time()
    readings = rig.driver.poll(BUDGET)
    assert sorted(r.index for r in readings) == list(range(18))
    for r in readings:
        assert r.servo_id == IDS[r.index]
        assert r.position == pytest.approx(q[r.index], abs=dxl.TICK_RAD / 2 + 1e-9)
        assert r.speed == pytest.approx(0.5, abs=dxl.SPEED_RAD_S)
        assert r.load == pytest.approx(-0.2, abs=1e-3)
        assert r.voltage == pytest.approx(voltage, abs=0.06)
        assert (r.temperature, r.error) == (25.0, ServoError.NONE)
        assert 0 < rig.port.now_ns() - r.stamp_ns < 2 * CYCLE_NS
    assert rig.driver.poll(0) == []
    assert rig.driver.ages().max() < 0.02


def test_reading_refers_to_active_goals_by_board_clock() -> None:
    """Check the time of a reading's goals by the board's clock, within 8 ms.

    Goals arrive 1.1 ms after they were sent, and the board rounds to 0.1 ms. States take 4 ms, which count as none: 7 ms.
    """
    rig, sent_ns, ages = walking(), list[int](), list[int]()
    for half in range(40):
        rig.now_ns = max(rig.now_ns + PERIOD // 2, rig.port.now_ns())
        rig.board.advance(rig.now_ns)
        for r in rig.driver.poll(BUDGET):
            newest_ns = max((at_ns for at_ns in sent_ns if at_ns < r.told_ns), default=None)
            if newest_ns is not None:
                assert r.told_ns - newest_ns < 8_000_000
                ages.append(r.stamp_ns - r.told_ns)
        if half % 2:
            sent_ns.append(rig.port.now_ns())
            rig.driver.sync_write_goals(HERE)
    assert len(ages) > 600
    assert 0 <= min(ages) < 3_000_000
    assert 10_000_000 < max(ages) < PERIOD + 3_000_000


def test_goal_time_of_reading_survives_board_restart_and_rounding() -> None:
    rig = walking()
    seen = rig.driver.state
    assert seen is not None

    def since_ms(time_us: int, sequence: int, goals_age_ms: float, asked_ms: float) -> float:
        ages = tuple([round(asked_ms * 1000 / AGE_UNIT_US)] * 18)
        state = replace(seen, time_us=time_us, sequence=seen.sequence + sequence, goals_age=round(10 * goals_age_ms), age=ages)
        rig.driver._take(state)
        (since_ns,) = {r.stamp_ns - r.told_ns for r in rig.driver.poll(0)}
        return since_ns * 1e-6

    rig.driver.poll(BUDGET)
    begin_us = seen.time_us + 100_000
    assert since_ms(begin_us, 1, 9, 2.0) == pytest.approx(7.05)
    for later_ms, sequence, age_ms in ((10, 2, 19.1), (20, 3, 28.9)):  # the same goals, with 0.1 ms of rounding
        assert since_ms(begin_us + 1000 * later_ms, sequence, age_ms, 2.0) == pytest.approx(7.05 + later_ms, abs=0.11)
    for later_ms, sequence in ((0, 4), (1, 5)):
        found_ms = since_ms(begin_us + 30_000 + 1000 * later_ms, sequence, 8, 11.0)
        assert found_ms == pytest.approx(28.05 + later_ms, abs=1.0), "asked before the newest"
    rig.driver._meet(Welcome(VERSION, rig.driver._session, seen.sequence + 77, 0, "anew", "AX-12A"))
    assert since_ms(50_000, 6, 9, 2.0) == pytest.approx(7.05), "its clock begins at 0"


def test_torque_on_requires_fresh_goals_and_goals_reach_servos() -> None:
    rig = Rig().ready()
    rig.driver.set_torque(True)
    rig.cycle(2)
    assert not rig.torque.any()
    assert rig.driver.state.refusal is Refusal.NO_GOALS  # type: ignore[union-attr]
    rig.cycle(15)
    assert rig.driver.trouble == "the bridge keeps torque off; it last refused torque on without fresh goals"
    goals = 512 + np.arange(18) - 9
    rig.cycle(2, goals)
    assert (rig.goals == 512).all(), "while torque is off goals are not written"
    rig.driver.set_torque(True)
    rig.cycle(2, goals)
    assert rig.torque.all()
    assert (rig.goals == goals).all()
    assert rig.mode is Mode.ON
    assert rig.driver.trouble == ""


def test_torque_on_is_refused_with_a_goal_far_from_the_position() -> None:
    rig = Rig().ready()
    goals = HERE.copy()
    goals[5] += FAR_TICKS + 1
    rig.driver.sync_write_goals(goals)
    rig.driver.set_torque(True)
    rig.cycle(15, goals)
    assert not rig.torque.any()
    assert "a goal far from its servo's position" in rig.driver.trouble
    goals[5] -= 1
    rig.driver.sync_write_goals(goals)
    rig.driver.set_torque(True)
    rig.cycle(2, goals)
    assert rig.torque.all()


def test_torque_off_is_latched_and_not_undone_by_goals() -> None:
    rig = walking()
    rig.driver.set_torque(False)
    rig.cycle(1)
    assert not rig.torque.any()
    rig.cycle(20, HERE + 100)
    assert rig.mode is Mode.OFF
    assert not rig.torque.any()
    assert (rig.goals == 512).all()
    rig.bank.tables[3, dxl.TORQUE_ENABLE.address] = 1  # a packet was lost there
    rig.cycle(2)
    assert not rig.torque.any(), "off is repeated"
    rig.plug_in()  # a new host
    rig.ready().cycle(5, HERE)
    assert rig.mode is Mode.OFF
    assert not rig.torque.any()


def test_a_register_write_may_not_turn_torque_on() -> None:
    rig = Rig().ready()
    assert not rig.driver.write(5, dxl.TORQUE_ENABLE, 1)
    rig.cycle(2)
    assert rig.driver.state.refusal is Refusal.QUESTION  # type: ignore[union-attr]
    assert not rig.torque.any()
    assert rig.driver.write(5, dxl.LED, 1)
    assert rig.driver.read(5, dxl.LED) == 1
    assert rig.driver.read(99, dxl.LED) is None
    assert rig.driver.lost[Lost.TIMEOUT] == 2
    assert rig.driver.lost["bridge: order refused"] == 1


def test_stale_goals_make_bridge_hold_with_torque_on() -> None:
    rig = walking()
    rig.cycle(9)  # 180 ms
    assert rig.mode is Mode.ON
    rig.cycle(4)
    assert rig.mode is Mode.HOLDING
    assert rig.driver.trouble == "", "nobody sends any"
    rig.port.write = len  # type: ignore[method-assign,assignment]
    rig.cycle(250, HERE + 3)
    assert rig.driver.trouble == "the bridge holds the last goals: no fresh goals reach it"
    assert rig.driver.state.goals_age > 50_000  # type: ignore[union-attr]
    assert rig.torque.all()
    assert (rig.goals == 512).all()


def test_distant_goals_after_pause_are_approached_at_coordinated_speed() -> None:
    rig = walking()
    rig.cycle(20)
    rig.written.clear()
    ahead = np.where(np.arange(18) < 9, 60, -30)
    rig.cycle(20, HERE + ahead)
    assert rig.mode is Mode.CATCHING_UP
    assert "catching up" in rig.driver.trouble
    rig.cycle(20, HERE + ahead)
    assert rig.mode is Mode.ON
    assert (rig.goals == HERE + ahead).all()
    written = np.array(rig.written) - 512
    assert np.abs(np.diff(written, axis=0)).max() <= max(NEAR_TICKS, CATCH_UP_TICKS_S * PERIOD // 10**9 + 1)
    assert np.abs(written[:, 0] + 2 * written[:, 17]).max() <= NEAR_TICKS, "each its share of the way"
    rig.cycle(2, HERE + 100)
    assert (rig.goals == 612).all(), "in step again, it passes on what comes"


def test_reconnected_cable_resumes_with_torque_on() -> None:
    rig = walking()
    port = rig.port
    port.close()
    with pytest.raises(BusDisconnectedError, match="port is gone"):
        rig.driver.poll(BUDGET)
    with pytest.raises(BusDisconnectedError, match="port is gone"):
        rig.driver.sync_write_goals(HERE)
    rig.pass_time(100)  # 2 s in which the host reads nothing from the board
    assert rig.torque.all()
    rig.plug_in()
    rig.ready()
    assert rig.mode is Mode.HOLDING
    assert rig.driver.ages().max() < 0.03
    rig.cycle(2, HERE)
    assert rig.mode is Mode.ON
    assert all((goals == 512).all() for goals in rig.written)


def test_silent_serial_line_recovers_without_new_driver() -> None:
    rig, quiet = Rig(torque=True), [False]
    rig.plug_in(lambda data: b"" if quiet[0] else data)
    rig.ready().cycle(4, HERE)
    quiet[0] = True
    rig.cycle(20, HERE)
    assert rig.driver.trouble == "the bridge has been silent for 0.4 s"
    assert rig.driver.ages().min() > 0.35
    quiet[0] = False
    assert rig.cycle(3, HERE) == 18
    assert rig.mode is Mode.ON
    assert rig.driver.trouble == ""
    assert rig.driver.ages().max() < 0.03


def test_firmware_restart_does_not_move_standing_robot() -> None:
    rig = walking()
    rig.cycle(2, HERE + 3)
    rig.board.restart(rig.port.now_ns())
    rig.written.clear()
    rig.cycle(50, HERE + 3)
    assert rig.mode is Mode.ON
    assert rig.driver.restarts == 1
    assert rig.torque.all()
    assert all((goals == 515).all() for goals in rig.written), "no joint moves"
    assert rig.driver.ages().max() < 0.03
    rig.driver.set_torque(False)
    rig.cycle(2)
    assert not rig.torque.any()


def test_torque_off_during_firmware_restart_is_applied_afterwards() -> None:
    rig = walking()
    rig.board.restart(rig.port.now_ns())
    rig.cycle(2, HERE)
    rig.driver.set_torque(False)
    rig.cycle(5)
    assert rig.torque.all(), "it is impossible"
    for _ in range(30):
        rig.cycle()
        if not rig.torque.any():
            break
    assert rig.port.now_ns() - rig.board._dead_until_ns < 60_000_000
    rig.cycle(50, HERE)
    assert rig.mode is Mode.OFF
    assert not rig.torque.any()


def test_buffered_stale_orders_are_refused() -> None:
    rig = walking()
    held: list[bytes] = []
    write = rig.port.write
    rig.port.write = lambda data: held.append(data) or len(data)  # type: ignore[method-assign,func-returns-value]
    rig.cycle(30, HERE + 4)
    rig.port.write = write  # type: ignore[method-assign]
    late = held[:15]  # the newest is 300 ms old
    write(b"".join(late))
    rig.cycle(2)
    assert rig.driver.state.refusal is Refusal.AGE  # type: ignore[union-attr]
    assert (rig.goals == 512).all()


def test_buffered_states_keep_their_true_time_stamps() -> None:
    rig = walking()
    rig.now_ns += 60_000_000  # the host is stopped
    rig.board.advance(rig.now_ns)
    old = rig.driver.ages()
    rig.driver.poll(BUDGET)
    assert old.min() > 0.05
    assert rig.driver.ages().max() < 0.03


def test_other_protocol_version_is_refused_with_its_number(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = Rig()
    monkeypatch.setattr(bridge_protocol, "VERSION", 3)
    hello = bridge_protocol.encode(bridge_protocol.Hello(3, 5, 0, bytes(IDS)))
    welcome = bridge_protocol.encode(bridge_protocol.Welcome(3, 0, 1, 0, "from next year", "AX-12A"))
    monkeypatch.undo()
    rig.port.write(hello)
    rig.pass_time(2)
    assert rig.board.firmware.mode == Mode.WAITING
    said = [
        m
        for r in rig.board.unsolicited_replies(rig.now_ns)
        for m in bridge_protocol.Receiver(bridge_protocol.TO_HOST).feed(r.data)
    ]
    assert {m.version for m in said if isinstance(m, bridge_protocol.Welcome)} == {VERSION}, "it says its own"
    rig.plug_in(lambda data: welcome)
    words = "the bridge uses protocol version 3, version 2 expected; flash"
    with pytest.raises(BusSetupError, match=words):
        rig.driver.setup()


def test_setup_without_bridge_on_the_port_fails_with_hint() -> None:
    rig = Rig()
    bus = ServoBusEmulator(rig.bank)
    port = MemoryPort(bus, lambda: rig.now_ns, READ_NS * 1e-9)
    driver = Bridge(port, IDS, port.now_ns)
    with pytest.raises(BusSetupError, match=r"no bridge answers on the port.*turn the setting `bridge` off"):
        driver.setup()


def test_missing_servos_are_named_and_others_keep_moving() -> None:
    rig = Rig((1, 2, 3), torque=True)
    rig.ids = (1, 42, 3)
    rig.plug_in()
    with pytest.raises(BusSetupError, match="servo 42"):
        rig.driver.setup()
    rig.cycle(4, np.full(3, 514))
    assert np.isinf(rig.driver.ages()).tolist() == [False, True, False]
    assert rig.mode is Mode.ON
    assert rig.goals.tolist() == [514, 512, 514]
    assert rig.driver.lost["bridge: no answer"] > 0


def test_servo_shutdown_is_in_reading_and_ends_with_torque_limit() -> None:
    rig = Rig((1, 2), torque=True).ready()
    for _ in range(1600):
        rig.bank.step(np.zeros(2), np.zeros(2), np.array([1.5, 0.0]), 0.001)
    rig.now_ns = rig.port.now_ns() + PERIOD
    rig.board.advance(rig.now_ns)
    errors = {r.servo_id: r.error for r in rig.driver.poll(BUDGET)}
    assert errors == {1: ServoError.OVERLOAD, 2: ServoError.NONE}
    assert rig.driver.errors.tolist() == [ServoError.OVERLOAD, 0]
    assert rig.driver.write(1, dxl.TORQUE_LIMIT, 1023)
    rig.cycle(3)
    assert not rig.bank.shutdown.any()


@pytest.mark.parametrize(
    "goals", [np.full(18, 1024), np.full(18, -1), np.full(17, 512), np.full(18, 512.0), np.full(18, np.nan)]
)
def test_invalid_goals_are_refused_before_sending(goals: np.ndarray) -> None:
    rig = walking()
    with pytest.raises(ValueError, match="goal position"):
        rig.driver.sync_write_goals(goals)
    rig.cycle(2)
    assert (rig.goals == 512).all()


def test_more_servos_than_a_frame_holds_are_refused() -> None:
    with pytest.raises(ValueError, match="at most 24 servos behind a bridge expected, found 25"):
        Bridge(Rig().port, range(25), lambda: 0)


@pytest.mark.slow
@WILD
@given(st.lists(st.binary(max_size=300), min_size=1, max_size=10))
def test_garbage_on_serial_line_gives_no_error_and_no_false_reading(noise: list[bytes]) -> None:
    rig, parts = Rig((1, 2, 3), torque=True), list(noise)
    rig.plug_in(lambda data: (parts.pop() if parts else b"") + data)
    here = np.full(3, 512)
    for _ in range(4):
        try:
            rig.driver.setup()
            break
        except BusSetupError:
            continue
    for _ in range(8):
        rig.pass_time()
        for reading in rig.driver.poll(BUDGET):
            assert reading.position_ticks == 512
        rig.driver.sync_write_goals(here)
    rig.cycle(20, here)
    assert rig.cycle(2, here) == 3, "and it recovers"
    assert rig.torque.all()


def test_1_percent_corrupted_bytes_cause_no_false_reading() -> None:
    rig, rng = Rig((1, 2, 3), torque=True), np.random.default_rng(3)
    rig.ready()

    def breaks(data: bytes) -> bytes:
        out = bytearray(data)
        for at in np.flatnonzero(rng.random(len(out)) < 0.01):
            out[at] ^= int(rng.integers(1, 256))
        return bytes(out)

    read, write = rig.port.read, rig.port.write
    rig.port.read = lambda size=1: breaks(read(size))  # type: ignore[method-assign]
    rig.port.write = lambda data: write(breaks(data))  # type: ignore[method-assign]
    readings = 0
    for _ in range(500):
        rig.pass_time()
        for reading in rig.driver.poll(BUDGET):
            assert reading.position_ticks in (512, 513)
            readings += 1
        rig.driver.sync_write_goals(np.full(3, 513))
    assert 500 < readings < 1450
    assert rig.driver.lost["frame with a wrong CRC"] > 50
    assert all(set(goals) <= {512, 513} for goals in rig.written)
    assert rig.torque.all()
