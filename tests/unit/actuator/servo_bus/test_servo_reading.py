"""Estimated speeds and loads of servos that measure their position only."""

import math

import pytest

from sextant.services.actuator.servo_bus.reading_validation import State
from sextant.services.actuator.servo_bus.servo_reading import PositionReadings, spring_load
from sextant.shared.servo.models import AX_12A
from sextant.shared.servo.servo_model import Feedback

UNITS, STIFFNESS = AX_12A.units, 6.0
MS = 1_000_000


def state(stamp_ns: int, position: int, voltage: int = 0, temperature: int = 0) -> State:
    """Return a state without speed and load."""
    return State(stamp_ns, position, 0, 0, voltage, temperature, 0)


def test_load_is_that_of_the_position_controller() -> None:
    readings = PositionReadings(UNITS, [STIFFNESS])
    goal = UNITS.angle(540)
    one = readings.reading(0, 7, 5, state(20 * MS, 530), goal)
    assert one.load == pytest.approx(STIFFNESS * 10 * UNITS.tick_rad)
    assert (one.servo_id, one.stamp_ns, one.told_ns, one.position_ticks) == (7, 20 * MS, 5, 530)
    assert readings.reading(0, 7, 5, state(40 * MS, 512), UNITS.angle(0)).load == -1.0
    assert readings.reading(0, 7, 5, state(60 * MS, 512), math.nan).load == 0.0


def test_estimates_are_marked_and_what_was_not_read_is_nan() -> None:
    readings = PositionReadings(UNITS, [STIFFNESS])
    one = readings.reading(0, 7, 0, state(0, 512, 111, 30), 0.0)
    assert one.measured == Feedback.POSITION
    assert math.isnan(one.voltage)
    assert math.isnan(one.temperature)
    one = readings.reading(0, 7, 0, state(MS, 512, 111, 30), 0.0, Feedback.VOLTAGE)
    assert one.measured == Feedback.POSITION | Feedback.VOLTAGE
    assert one.voltage == pytest.approx(11.1)
    assert math.isnan(one.temperature)


def test_speed_is_that_between_two_positions_of_one_servo() -> None:
    readings = PositionReadings(UNITS, [STIFFNESS] * 2)
    assert readings.reading(0, 1, 0, state(0, 500), 0.0).speed == 0.0
    assert readings.reading(1, 2, 0, state(10 * MS, 700), 0.0).speed == 0.0
    assert readings.reading(0, 1, 0, state(20 * MS, 504), 0.0).speed == pytest.approx(4 * UNITS.tick_rad / 0.02)
    assert readings.reading(0, 1, 0, state(900 * MS, 600), 0.0).speed == 0.0, "too long ago"


def test_torque_is_limited() -> None:
    assert spring_load(6.0, 0.1) == pytest.approx(0.6)
    assert spring_load(6.0, 3.0) == 1.0
    assert spring_load(6.0, -3.0) == -1.0
