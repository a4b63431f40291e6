"""The driver of servos with commands, against their byte-level emulator: what a slow bus without acknowledgements allows."""

import math
import re
from pathlib import Path

import numpy as np
import pytest

from sextant.services.actuator.safety.health_monitor import SILENT
from sextant.services.actuator.servo_bus.bus_scan import call, problems, scan_servo
from sextant.services.actuator.servo_bus.command_bus import _SLOW_EVERY, _SLOW_TURNS, CommandBus, bus_of
from sextant.services.simulator.servo_bus.host_link import Reply
from sextant.shared.servo import lx16a
from sextant.shared.servo.lx16a import Command
from sextant.shared.servo.models import AX_12A, LX_16A, MODELS
from sextant.shared.servo.servo_model import Feedback, ServoError
from tests.support.families import Bench

ROOT = Path(__file__).parents[4]
_BUDGET_NS, _CYCLE_S = 9_000_000, 0.02
_TICK, _CENTRE = LX_16A.units.tick_rad, LX_16A.units.centre
TABLE = LX_16A.table


class _Legs(Bench):
    """Servos in cycles of 20 ms whose joints follow their goals, or stay where they are."""

    def __init__(self, n: int = 18) -> None:
        super().__init__("LX-16A", n)
        self.q = np.zeros(n)
        self.sent: list[bytes] = []
        self.silent = 0  # id of a servo that receives nothing
        self._receive = self.emulator.receive
        self.emulator.receive = self._heard  # type: ignore[method-assign]

    def _heard(self, data: bytes, now_ns: int) -> list[Reply]:
        self.sent.append(data)
        return [] if data[2] == self.silent else self._receive(data, now_ns)

    def cycle(self, goals: list[int], speeds: list[int] | int = 0, first: tuple[int, ...] = ()) -> list:  # type: ignore[type-arg]
        """Read, and write goals, as the actuator does; return the readings."""
        readings = self.bus.poll(_BUDGET_NS, first)
        self.bus.sync_write_goals(goals, speeds)
        began = self.now_ns
        self.pass_time(0.0, self.q)
        assert self.now_ns - began < 20_000_000, "the cycle is on time"
        self.now_ns = began + 20_000_000
        self.emulator.advance(self.now_ns)
        self.servos.set_joint_state(self.q, 0 * self.q, 0 * self.q, self.now_ns)
        self.command = self.servos.advance(_CYCLE_S)
        return readings


def test_only_servos_with_commands_get_this_driver() -> None:
    assert {model.name for model in MODELS if bus_of(model) is CommandBus} == {"LX-16A", "HX-35H"}
    with pytest.raises(ValueError, match="a model with commands expected, found AX-12A"):
        CommandBus(Bench("AX-12A").port, [1], lambda: 0, model=AX_12A)


def test_readings_have_positions_and_estimates_only() -> None:
    legs = _Legs(3)
    legs.bus.setup()
    legs.bus.set_torque(True)
    legs.bus.sync_write_goals([_CENTRE + 5, _CENTRE, _CENTRE - 300])
    legs.pass_time(0.02, np.array([0.0, -0.02, 0.3]))
    readings = legs.bus.poll(_BUDGET_NS)
    assert [one.servo_id for one in readings] == [1, 2, 3]
    np.testing.assert_allclose([one.position for one in readings], [0.0, -0.02, 0.3], atol=_TICK)
    share = LX_16A.gain_stiffness
    np.testing.assert_allclose([one.load for one in readings], [5 * _TICK * share, 0.02 * share, -1.0], atol=_TICK * share)
    assert {one.measured & (Feedback.SPEED | Feedback.LOAD) for one in readings} == {Feedback.NONE}
    assert all(math.isnan(one.voltage) and math.isnan(one.temperature) for one in readings)
    assert {one.error for one in readings} == {ServoError.NONE}


def test_without_torque_or_a_goal_nothing_is_estimated() -> None:
    legs = _Legs(2)
    assert {one.load for one in legs.bus.poll(_BUDGET_NS)} == {0.0}
    legs.bus.set_torque(False)
    legs.bus.sync_write_goals([800, 200])
    legs.pass_time(0.02)
    assert {one.load for one in legs.bus.poll(_BUDGET_NS)} == {0.0}
    assert not legs.command.torque_limit.any()


def test_all_servos_are_read_and_moved_in_time_on_the_slow_bus() -> None:
    """Eighteen goals change in each cycle; none is ever more than three cycles old, and no servo unread for more than 20."""
    legs = _Legs()
    legs.bus.set_torque(True)
    legs.now_ns = legs.port.now_ns() + 20_000_000
    read, goals = np.zeros(18, dtype=int), np.full(18, _CENTRE)
    sent = np.zeros((100, 18), dtype=int)
    for k in range(100):
        goals = _CENTRE + k * np.array([3, 2, 1] * 6)
        read += 1
        for one in legs.cycle(goals.tolist(), first=(1, 4)):
            read[one.index] = 0
        sent[k] = legs.servos.column(TABLE.goal_position)
        if k > 12:
            assert (goals - sent[k] <= 4 * np.array([3, 2, 1] * 6)).all()
            assert read.max() <= 20
            assert max(read[[1, 4]]) <= 3
    assert not legs.bus.lost, "no request times out because goals keep the wire busy"


def test_silent_servo_shows_while_landing_legs_take_the_time_of_the_bus() -> None:
    """Its fourth request without an answer comes within 0.6 s, at each moment of falling silent."""
    for silent_after in range(20, 36):
        legs, cycles = _Legs(), 0
        legs.bus.set_torque(True)
        legs.now_ns = legs.port.now_ns() + 20_000_000
        goals = np.full(18, _CENTRE)
        for k in range(silent_after):
            legs.cycle((goals + 3 * k).tolist(), first=(1, 7, 13))
        legs.silent = 9
        while legs.bus.missed[8] < SILENT:
            legs.cycle((goals + 3 * (silent_after + cycles)).tolist(), first=(1, 7, 13))
            cycles += 1
        assert cycles <= 30


def test_all_servos_are_read_soon_after_a_silence_of_the_bus() -> None:
    legs, goals = _Legs(), [_CENTRE] * 18
    legs.bus.set_torque(True)
    legs.now_ns = legs.port.now_ns() + 20_000_000
    heard, legs.emulator.receive = legs.emulator.receive, lambda data, now_ns: []  # type: ignore[method-assign, assignment]
    for _ in range(100):
        assert not legs.cycle(goals)
    legs.emulator.receive = heard  # type: ignore[method-assign]
    back: set[int] = set()
    for _ in range(25):
        back |= {one.index for one in legs.cycle(goals)}
    assert back == set(range(18))


def test_goals_of_landing_legs_are_sent_in_a_cycle_that_reading_has_used_up() -> None:
    legs = _Legs()
    legs.bus.set_torque(True)
    legs.cycle([_CENTRE] * 18)
    legs.cycle([_CENTRE] * 18)
    goals = [_CENTRE + 40 + k for k in range(18)]  # those of the last servos have changed most
    legs.bus.poll(_BUDGET_NS, (1, 7))
    legs.now_ns = legs.port.now_ns() + 9_000_000
    legs.sent.clear()
    legs.bus.sync_write_goals(goals)
    sent = b"".join(legs.sent)
    assert len(sent) == 4 * 10
    for servo_id, goal in ((2, goals[1]), (8, goals[7]), (18, goals[17]), (17, goals[16])):
        assert lx16a.write(servo_id, Command.MOVE_TIME_WRITE, goal, 0) in sent


def test_dead_servo_does_not_take_the_turns_of_the_others() -> None:
    legs, unread = _Legs(), np.zeros(18, dtype=int)
    legs.bus.set_torque(True)
    legs.now_ns = legs.port.now_ns() + 20_000_000
    legs.silent, goals, longest = 9, np.full(18, _CENTRE), np.zeros(18, dtype=int)
    for k in range(200):
        unread += 1
        for one in legs.cycle((goals + k % 40).tolist(), first=(1, 7, 13)):
            unread[one.index] = 0
        if k >= 60:
            longest = np.maximum(longest, unread)
    assert legs.bus.missed[8] >= SILENT
    assert np.delete(longest, 8).max() <= 30


def test_voltage_and_temperature_of_each_servo_are_read_in_turn() -> None:
    legs = _Legs(6)
    legs.bus.set_torque(True)
    volts, degrees = set(), set()
    for _ in range(5 * 3 * 6 + 5):
        for one in legs.cycle([_CENTRE] * 6):
            if Feedback.VOLTAGE in one.measured:
                volts.add(one.index)
                assert one.voltage == pytest.approx(legs.servos.voltage, abs=0.01)
            if Feedback.TEMPERATURE in one.measured:
                degrees.add(one.index)
                assert one.temperature == 25.0
    assert volts == degrees == set(range(6))


@pytest.mark.parametrize("silent", [0, 9])
def test_temperature_of_the_hottest_servo_that_answers_is_read_often(silent: int) -> None:
    legs = _Legs()
    legs.bus.set_torque(True)
    legs.servos.temperature[7], legs.servos.temperature[8] = 58.0, 50.0 + silent
    unread, longest = 0, 0
    for k in range(600):
        if k == 5 * 3 * 18:
            legs.silent, unread = silent, 0
        readings = legs.cycle([_CENTRE] * 18)
        unread += 1
        if any(one.index == 7 and Feedback.TEMPERATURE in one.measured for one in readings):
            unread = 0
        if k >= 5 * 3 * 18:
            longest = max(longest, unread)
    assert longest < 20, "0.4 s"


@pytest.mark.parametrize("page", ["servos", "firmware"])
def test_page_states_how_often_temperatures_are_read(page: str) -> None:
    text = " ".join((ROOT / "docs" / f"{page}.md").read_text(encoding="utf-8").split())
    turn_s = _SLOW_TURNS * _SLOW_EVERY * _CYCLE_S
    words = rf"each of (the|18) servos (within|once in) {18 * turn_s:.1f} s, the hottest one every {turn_s:.1f} s"
    assert re.search(words, text)


def test_one_broken_voltage_is_not_believed() -> None:
    legs = _Legs(2)
    receive, broken = legs.emulator.receive, [0]

    def spoil(data: bytes, now_ns: int) -> list:  # type: ignore[type-arg]
        replies = receive(data, now_ns)
        if data[4] == Command.VIN_READ and broken[0] < 1:
            broken[0] += 1
            wrong = lx16a.response(replies[0].servo_id, Command.VIN_READ, 3000)
            return [replies[0]._replace(data=wrong)]
        return replies

    legs.emulator.receive = spoil  # type: ignore[method-assign]
    found = [one.voltage for _ in range(60) for one in legs.cycle([_CENTRE] * 2) if Feedback.VOLTAGE in one.measured]
    assert broken == [1]
    assert found
    assert min(found) > 7.0


def test_goals_wait_while_torque_is_off_and_precede_torque_on() -> None:
    legs = _Legs(2)
    legs.bus.set_torque(False)
    legs.sent.clear()
    legs.bus.sync_write_goals([600, 400])
    assert not legs.sent, "a goal may turn torque on"
    legs.bus.set_torque(True)
    assert b"".join(legs.sent).startswith(lx16a.write(1, Command.MOVE_TIME_WRITE, 600, 0))
    assert legs.sent[-1] == lx16a.write(254, Command.LOAD_OR_UNLOAD_WRITE, 1)
    legs.sent.clear()
    legs.bus.sync_write_goals([600, 400])
    assert len(b"".join(legs.sent)) == 2 * 10, "they are sent again, because torque on may have replaced them"


def test_speed_limit_becomes_the_time_of_the_goal() -> None:
    legs = _Legs(1)
    legs.bus.set_torque(True)
    legs.bus.poll(_BUDGET_NS)
    legs.bus.sync_write_goals([_CENTRE + 100], [500])  # 0.5 rad/s over 100 ticks
    expected_ms = math.ceil(100 * _TICK / 0.5 * 1e3)
    assert lx16a.write(1, Command.MOVE_TIME_WRITE, _CENTRE + 100, expected_ms) in legs.sent[-1]
    legs.pass_time(0.02)
    legs.pass_time(expected_ms * 1e-3 / 2)
    way = legs.command.setpoint[0] / (100 * _TICK)
    assert 0.4 < way < 0.65, "the servo is half-way"
    assert abs(legs.bus.poll(_BUDGET_NS)[0].load) < LX_16A.gain_stiffness * 100 * _TICK * 0.7, "and so is the estimate"


def test_writes_are_verified_by_reading_them_again() -> None:
    legs = _Legs(2)
    bus = legs.bus
    assert bus.write(1, TABLE.low_limit, 100)
    assert (bus.read(1, TABLE.low_limit), bus.read(1, TABLE.high_limit)) == (100, 1000), "the other value of the command stays"
    assert bus.write(2, TABLE.torque_enable, 1)
    assert not bus.write(1, TABLE.torque_limit, 300), "the servo has none"
    assert not bus.write(7, TABLE.torque_enable, 0), "nobody answers"


def test_hot_servo_has_no_torque_until_it_is_cool_and_reports_nothing() -> None:
    legs = _Legs(2)
    legs.bus.set_torque(True)
    legs.pass_time(0.02)
    legs.servos.temperature[0] = 90.0
    legs.pass_time(0.02)
    assert legs.command.torque_limit[0] == 0.0 < legs.command.torque_limit[1]
    assert {one.error for one in legs.bus.poll(_BUDGET_NS)} == {ServoError.NONE}
    legs.servos.temperature[0] = 60.0
    legs.pass_time(0.02)
    assert legs.command.torque_limit.all(), "its maker: it works again below the limit"


def test_scan_shows_nothing_that_the_servo_does_not_tell() -> None:
    legs = _Legs(3)
    seen = scan_servo(legs.bus, 2)
    assert seen is not None
    assert (seen.model, seen.firmware) == ("not told", None)
    assert seen.voltage == pytest.approx(legs.servos.voltage, abs=0.01)
    names = {1: "left front coxa", 2: "left front femur", 3: "left front tibia"}
    assert not problems(names, call(legs.bus, names))


def test_servo_in_motor_mode_is_refused() -> None:
    legs = _Legs(2)
    mode = next(register for register in TABLE.registers if register.name == "mode")
    legs.servos.column(mode)[1] = 1
    names = {1: "left front coxa", 2: "left front femur"}
    assert "mode of 1" in problems(names, call(legs.bus, names))[2].words


def test_late_answer_to_another_command_is_not_taken() -> None:
    legs = _Legs(1)
    receive = legs.emulator.receive

    def replace(data: bytes, now_ns: int) -> list:  # type: ignore[type-arg]
        replies = receive(data, now_ns)
        return [reply._replace(data=lx16a.response(1, Command.VIN_READ, 512)) for reply in replies]

    legs.emulator.receive = replace  # type: ignore[method-assign]
    assert legs.bus.poll(_BUDGET_NS) == []
    assert legs.bus.lost["answer from another servo"] > 0
