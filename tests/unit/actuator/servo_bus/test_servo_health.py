"""One fault that many servos have is one problem: battery, errors, limits, models."""

from dataclasses import replace

import pytest

from sextant.services.actuator.commissioning import bus_survey
from sextant.services.actuator.commissioning.bus_survey import Line
from sextant.services.actuator.commissioning.limited_motion import ready
from sextant.services.actuator.servo_bus.bus_scan import Problem, call, grouped
from sextant.services.actuator.servo_bus.servo_health import health_problems, span
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.servo import dynamixel as dxl
from sextant.shared.servo.servo_model import ServoError
from tests.support.builder import Builder
from tests.support.desk import PHANTOMX, Desk
from tests.support.families import robot_with

NAMES = PHANTOMX.servo_names
UNGUARDED = "does not shut down for overheating, overload"


def words_of(desk: Desk, profile: RobotProfile = PHANTOMX) -> list[str]:
    desk.profile = profile
    found = bus_survey.scan(Line(lambda rate: desk.bus()), profile.servo_names)
    return [problem.words for problem in bus_survey.verdict(found, profile)]


def warning_at(volts: float) -> RobotProfile:
    return replace(PHANTOMX, battery=replace(PHANTOMX.battery, warn_voltage=volts))


def test_battery_of_all_servos_is_one_problem_with_a_range() -> None:
    expected = "each of the 18 servos has 12.5 V, at least 12.7 V expected: charge the battery"
    assert words_of(Desk(), warning_at(12.7)) == [expected]
    seen, at = call(Desk().bus(), NAMES), dxl.PRESENT_VOLTAGE.address
    for i in range(1, 10):
        seen[i] = replace(seen[i], table=seen[i].table[:at] + b"\x77" + seen[i].table[at + 1 :])
    (problem,) = health_problems(seen, 12.7, NAMES)
    assert problem.words == expected.replace("12.5 V", "11.9 to 12.5 V")
    (problem,) = health_problems(seen, 12.0, NAMES)
    assert problem.words.startswith("each of 9 servos (ids 1, 2, 3, 4, 5, 6,")
    assert problem.words.endswith("has 11.9 V, at least 12.0 V expected: charge the battery")


def test_error_of_all_servos_is_one_problem() -> None:
    desk = Desk()
    desk.bench._servos._latched_errors[:] = ServoError.OVERLOAD
    (words,) = words_of(desk)
    assert words.startswith("each of the 18 servos reports overload")
    assert words.endswith("; switch its power off and on again")
    builder = Builder([])
    assert not ready(desk.bus(), PHANTOMX, builder)
    assert builder.all_told.count("overload") == 1


def test_voltage_outside_the_limits_of_servos_is_named_with_these() -> None:
    desk = Desk()
    desk.bench._servos.column(dxl.MAX_VOLTAGE)[:] = 120
    (words,) = words_of(desk)
    assert words == "each of the 18 servos reports input voltage outside its limits; supply it with 6.0 to 12.0 V, its limits"


@pytest.mark.parametrize(("n", "count"), [(1, 1), (3, 3), (4, 1), (17, 1), (18, 1)])
def test_limits_of_more_than_three_servos_are_one_problem(n: int, count: int) -> None:
    desk = Desk()
    changed = [3, *(i for i in NAMES if i != 3)][:n]
    for i in changed:
        desk.change(i, dxl.SHUTDOWN, 0)
    words = words_of(desk)
    assert len(words) == count
    assert all(one.endswith(UNGUARDED) for one in words)
    if n == 1:
        assert words == [f"servo 3 (left front femur) {UNGUARDED}"]
    elif n == 4:
        ids = ", ".join(map(str, sorted(changed)))
        assert words == [f"each of 4 servos (ids {ids}) {UNGUARDED}"]
    elif n == 18:
        assert words == [f"each of the 18 servos {UNGUARDED}"]


def test_wrong_model_of_all_servos_points_to_their_own_profile() -> None:
    desk = Desk(robot_with("AX-18A"))
    desk.profile = PHANTOMX
    found = bus_survey.scan(Line(lambda rate: desk.bus()), NAMES)
    (problem,) = bus_survey.verdict(found, PHANTOMX)
    assert problem.words == "each of the 18 servos is model 18 (AX-18A), expected 12 (AX-12A)"
    assert problem.advice.startswith("give --robot your_robot.toml")
    desk.bench.unplug([desk.row(9)])
    problems = bus_survey.verdict(bus_survey.scan(Line(lambda rate: desk.bus()), NAMES), PHANTOMX)
    assert any(problem.words.startswith("each of 17 servos (ids 1, ") for problem in problems)


def test_each_servo_keeps_its_problem() -> None:
    found = {i: Problem("is in wheel mode" if i % 2 else f"is {i}", "") for i in NAMES}
    shown = grouped(found, NAMES)
    assert shown.keys() == found.keys()
    assert all(shown[i].words.endswith(found[i].words) for i in found)
    assert len(set(shown.values())) == 1 + 9


def test_span_of_equal_values_is_one_number() -> None:
    assert span([12.51, 12.49], 1) == "12.5"
    assert span([11.0, 12.5, 10.9], 1) == "10.9 to 12.5"
    assert span([25.0], 0) == "25"
