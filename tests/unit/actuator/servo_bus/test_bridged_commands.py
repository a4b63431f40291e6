"""Servos with commands behind a bridge: the driver tells what the direct driver tells, and nothing more."""

import math

import numpy as np
import pytest

from sextant.services.actuator.config import Settings
from sextant.services.actuator.safety.health_monitor import SILENT
from sextant.services.actuator.servo_bus.mcu_bridge import READ_NS, Bridge
from sextant.services.actuator.servo_bus.servo_interface import on_port
from sextant.services.simulator.servo_bus.bridge_board import Board
from sextant.services.simulator.servo_bus.bus import BusTiming, ServoBusEmulator
from sextant.services.simulator.servo_bus.memory_port import MemoryPort
from sextant.services.simulator.servo_bus.servo_bank import ServoBank
from sextant.shared.robot.profiles import load_profile
from sextant.shared.servo.bridge_protocol import Goals, Mode, Refusal
from sextant.shared.servo.models import LX_16A
from sextant.shared.servo.servo_model import Feedback, ServoError
from tests.support.families import Bench

PERIOD_NS, BUDGET_NS = 20_000_000, 6_500_000
TABLE, UNITS = LX_16A.table, LX_16A.units
CENTRE, TICK = UNITS.centre, UNITS.tick_rad


class Rig:
    """Servos that stay where the test puts them, with a board and a driver."""

    def __init__(self, n: int = 18, stiffness: list[float] | None = None) -> None:
        self.now_ns, self.ids, self.q = 0, tuple(range(1, n + 1)), np.zeros(n)
        self.bank = ServoBank(self.ids, LX_16A)
        self.emulator = ServoBusEmulator(self.bank, BusTiming(LX_16A.bus_rate, 0))
        self.board = Board(self.emulator, model=LX_16A)
        self.port = MemoryPort(self.board, lambda: self.now_ns, READ_NS * 1e-9)
        self.driver = Bridge(self.port, self.ids, self.port.now_ns, model=LX_16A, stiffness=stiffness)

    def cycle(self, count: int = 1, goals: list[int] | None = None, first: tuple[int, ...] = (), speed: int = 0) -> list:  # type: ignore[type-arg]
        """Run cycles of an actuator, and return all readings."""
        readings = []
        for _ in range(count):
            self.now_ns = max(self.now_ns + PERIOD_NS, self.port.now_ns())
            self.board.advance(self.now_ns)
            self.bank.step(self.q, 0 * self.q, 0 * self.q, PERIOD_NS * 1e-9)
            readings += self.driver.poll(BUDGET_NS, first)
            if goals is not None:
                self.driver.sync_write_goals(goals, speed)
        return readings

    def walking(self) -> "Rig":
        self.driver.setup()
        here = [UNITS.ticks(q) for q in self.q]
        self.cycle(3, here)
        self.driver.set_torque(True)
        self.cycle(4, here)
        assert self.driver.state is not None
        assert self.driver.state.mode is Mode.ON
        assert self.bank.column(TABLE.torque_enable).all()
        return self


def newest(readings: list) -> list:  # type: ignore[type-arg]
    return [found for _, found in sorted({found.index: found for found in readings}.items())]


def test_readings_are_those_of_the_direct_driver() -> None:
    q, goals = np.array([0.0, -0.02, 0.06]), [CENTRE + 5, CENTRE, CENTRE + 10]
    stiffness = [2.0, 5.0, 9.0]
    direct, bridged = Bench("LX-16A", 3), Rig(3, stiffness)
    direct.bus._readings._stiffness = tuple(stiffness)  # type: ignore[attr-defined]
    direct.bus.set_torque(True)
    direct.bus.sync_write_goals(goals)
    direct.pass_time(0.02, q)
    bridged.q = q
    bridged.walking().cycle(4, goals)
    ours, theirs = newest(bridged.cycle(2, goals)), direct.bus.poll(9_000_000)
    for name in ("position", "position_ticks", "speed", "error"):
        assert [getattr(one, name) for one in ours] == [getattr(one, name) for one in theirs]
    np.testing.assert_allclose([one.load for one in ours], [one.load for one in theirs], atol=0.002)
    lacks = {Feedback.SPEED, Feedback.LOAD}
    assert not any(lack in one.measured for lack in lacks for one in ours)
    assert all(Feedback.POSITION in one.measured for one in ours)


def test_readings_without_voltage_or_temperature_have_none() -> None:
    rig = Rig(6).walking()
    rig.bank.temperature[:] = 25.0
    volts, degrees, alone = set(), set(), 0
    for one in rig.cycle(100, [CENTRE] * 6):
        assert math.isnan(one.voltage) == (Feedback.VOLTAGE not in one.measured)
        assert math.isnan(one.temperature) == (Feedback.TEMPERATURE not in one.measured)
        if Feedback.VOLTAGE in one.measured:
            volts.add(one.index)
            assert one.voltage == pytest.approx(rig.bank.voltage, abs=0.06)
        if Feedback.TEMPERATURE in one.measured:
            degrees.add(one.index)
            assert one.temperature == pytest.approx(25.0, abs=1.0)
        alone += one.measured is Feedback.POSITION
    assert volts == degrees == set(range(6))
    assert alone > 400


def test_without_torque_nothing_is_estimated() -> None:
    rig = Rig(3)
    rig.driver.setup()
    assert {one.load for one in rig.cycle(5, [CENTRE + 100] * 3)} == {0.0}
    assert (rig.bank.column(TABLE.goal_position) == CENTRE).all(), "no goal is written"


def test_far_goal_keeps_torque_off_and_is_named() -> None:
    rig = Rig(3)
    rig.driver.setup()
    rig.cycle(3, [CENTRE, CENTRE, CENTRE + 60])
    rig.driver.set_torque(True)
    rig.cycle(8, [CENTRE, CENTRE, CENTRE + 60])
    assert rig.driver.state is not None
    assert rig.driver.state.refusal is Refusal.FAR
    assert "keeps torque off; it last refused torque on with a goal far" in rig.driver.trouble
    assert not rig.bank.column(TABLE.torque_enable).any()


def test_silent_servo_shows_and_the_others_are_read() -> None:
    rig = Rig().walking()
    rig.emulator.cut_off(frozenset((9,)))
    for k in range(30):
        rig.cycle(1, [CENTRE + k % 5] * 18, first=(1, 7, 13))
        assert np.delete(rig.driver.missed, 9).max() <= 1
    assert rig.driver.missed[9] >= SILENT, "within 0.6 s"
    assert np.delete(rig.driver.ages(), 9).max() < 0.25
    rig.emulator.cut_off(frozenset())
    rig.cycle(10, [CENTRE] * 18)
    assert rig.driver.missed.max() == 0


def test_servos_named_first_are_read_in_each_cycle_after_their_newest_goals() -> None:
    rig = Rig().walking()
    sent_ns, gaps = [0], []
    send = rig.driver._send

    def note(message: object) -> None:
        if isinstance(message, Goals):
            sent_ns.append(rig.port.now_ns())
        send(message)  # type: ignore[arg-type]

    rig.driver._send = note  # type: ignore[method-assign, assignment]
    for k in range(40):
        found = rig.cycle(1, [CENTRE + k] * 18, first=(1, 7, 13))
        if k > 1:
            urgent = {one.index: one for one in found if one.index in (1, 7, 13)}
            assert urgent.keys() == {1, 7, 13}
            assert all(one.told_ns >= sent_ns[-2] for one in urgent.values())
            gaps += [(one.stamp_ns - one.told_ns) * 1e-6 for one in urgent.values()]
    assert min(gaps) > 4.0
    assert max(gaps) < 12.0


def test_reading_of_earlier_goals_is_withheld_of_servos_named_first() -> None:
    found = {}
    for first in ((), tuple(range(18))):
        rig = Rig().walking()
        for k in range(20):
            rig.cycle(1, [CENTRE + 3 * k] * 18)
        sent_ns = rig.driver._goals_ns
        found[first] = [one.told_ns >= sent_ns for one in rig.cycle(1, None, first)]
    assert not all(found[()]), "some were read before these goals"
    assert all(found[tuple(range(18))])


def test_table_is_read_and_written_by_commands() -> None:
    rig = Rig(3)
    rig.driver.setup()
    assert rig.port.now_ns() < 400_000_000
    assert rig.driver.write(1, TABLE.low_limit, 100)
    assert (rig.driver.read(1, TABLE.low_limit), rig.driver.read(1, TABLE.high_limit)) == (100, 1000)
    assert not rig.driver.write(1, TABLE.torque_limit, 300), "the servo has none"
    assert not rig.driver.write(2, TABLE.torque_enable, 1), "torque has a separate order"
    assert not rig.driver.write(2, TABLE.goal_position, 510), "a goal may turn torque on"
    assert rig.bank.column(TABLE.goal_position).tolist() == [CENTRE] * 3
    condition = TABLE.condition
    found = rig.driver.read_bytes(3, condition.address, condition.size)
    assert found is not None
    assert condition.unpack(found) == (1000, 0, CENTRE, 1000, CENTRE, 0), "those that no command reads are of the model"


def test_board_restart_keeps_torque_and_goals() -> None:
    rig = Rig(6).walking()
    rig.cycle(10, [CENTRE + 7] * 6)
    rig.board.restart(rig.port.now_ns())
    rig.cycle(30, [CENTRE + 7] * 6)
    assert rig.driver.state is not None
    assert (rig.driver.restarts, rig.driver.state.mode) == (1, Mode.ON)
    assert rig.bank.column(TABLE.torque_enable).all()
    assert (rig.bank.column(TABLE.goal_position) == CENTRE + 7).all()


def test_hot_servo_reports_nothing_behind_the_bridge_either() -> None:
    rig = Rig(3).walking()
    rig.bank.temperature[0] = 90.0
    found = rig.cycle(60, [CENTRE] * 3)
    assert {one.error for one in found} == {ServoError.NONE}
    assert rig.driver.errors.tolist() == [0, 0, 0]
    assert max(one.temperature for one in found if not math.isnan(one.temperature)) >= 89


def test_robot_with_these_servos_gets_a_bridge_with_its_stiffness() -> None:
    profile = load_profile("jethexa_hx35h")
    rig = Rig(3)
    found = on_port(profile, Settings(bridge=True), rig.port, rig.port.now_ns)
    assert isinstance(found, Bridge)
    assert found._estimates is not None
    assert found._estimates._stiffness == pytest.approx([19.7 / 3.43] * 18)
