"""Servos of another model than the robot's, with the same packets: named by their number, in any register."""

from itertools import permutations

import pytest

from sextant.services.actuator.commissioning import bus_survey, set_ids
from sextant.services.actuator.commissioning.bus_survey import Line
from sextant.services.actuator.commissioning.set_ids import OtherServosError
from sextant.services.actuator.servo_bus import bus_scan
from sextant.services.actuator.servo_bus.bus_driver import ServoBus
from sextant.services.actuator.servo_bus.bus_scan import BusResponse
from sextant.shared.servo.models import MODEL_NAMED
from tests.support.builder import Builder
from tests.support.desk import Desk
from tests.support.families import robot_with

OF_PROTOCOL_1 = ("AX-12A", "AX-18A", "RX-64", "MX-28", "STS3215", "SCS0009")
OF_PROTOCOL_2 = ("XL-320", "XL430-W250", "XM430-W350")
PAIRS = [*permutations(OF_PROTOCOL_1, 2), *permutations(OF_PROTOCOL_2, 2)]
EACH = pytest.mark.parametrize(("there", "expected"), PAIRS)


def bus_for(desk: Desk, expected: str) -> ServoBus:
    """Return the driver of servos of the expected model on the port to others."""
    desk.profile = robot_with(expected)
    return desk.bus()


@EACH
def test_each_servo_is_named_by_its_model(there: str, expected: str) -> None:
    desk = Desk(robot_with(there))
    bus = bus_for(desk, expected)
    names = desk.profile.servo_names
    seen = bus_scan.call(bus, names)
    assert [one.model for one in seen.values()] == [there] * 18
    (problem,) = set(bus_scan.problems(names, seen).values())
    number, wanted = MODEL_NAMED[there].number, MODEL_NAMED[expected].number
    assert problem.words == f"each of the 18 servos is model {number} ({there}), expected {wanted} ({expected})"


@EACH
def test_its_torque_is_read_where_it_has_it(there: str, expected: str) -> None:
    desk, table = Desk(robot_with(there)), MODEL_NAMED[there].table
    line = Line(lambda rate: bus_for(desk, expected))
    assert not bus_survey.holding(bus_survey.scan(line, range(1, 4)), robot_with(expected))
    desk.change(2, table.torque_enable, 1)
    assert "servo 2" in bus_survey.holding(bus_survey.scan(line, range(1, 4)), robot_with(expected))


@EACH
def test_row_of_a_table_has_measurements_only_if_their_registers_are_known(there: str, expected: str) -> None:
    desk = Desk(robot_with(there))
    found = bus_survey.scan(Line(lambda rate: bus_for(desk, expected)), [1])
    alike = MODEL_NAMED[there].table.of_bus == MODEL_NAMED[expected].table.of_bus
    row = bus_survey.in_words(found, robot_with(expected)).splitlines()[1]
    assert there in row
    assert (" V " in row) == alike


@EACH
def test_ids_of_another_robot_are_refused_before_any_question(there: str, expected: str) -> None:
    desk, builder = Desk(robot_with(there)), Builder([])
    line = Line(lambda rate: bus_for(desk, expected))
    with pytest.raises(OtherServosError, match=f"servo 1 is {there}, {expected} expected for the left front coxa"):
        set_ids.set_ids(line, robot_with(expected), builder)


def test_servo_that_answers_only_short_requests_is_still_fading() -> None:
    desk = Desk(robot_with("STS3215"))
    bus, receive = desk.bus(), desk.bench.receive
    desk.bench.receive = lambda data, now_ns: [] if data[6:7] > b"\x02" else receive(data, now_ns)  # type: ignore[method-assign]
    seen = bus_scan.scan_servo(bus, 9)
    assert seen is not None
    assert seen.response is BusResponse.FADING
