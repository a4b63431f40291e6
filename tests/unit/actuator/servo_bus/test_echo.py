"""Adapters that return what is sent, with servos of every family: found at the port, before anything else."""

import pytest

from sextant.services.actuator.commissioning.bus_survey import Line
from sextant.services.actuator.commissioning.limited_motion import ready
from sextant.services.actuator.commissioning.set_ids import set_ids
from sextant.services.actuator.commissioning.single_servo import NotReadyError, identify
from sextant.services.actuator.config import Settings
from sextant.services.actuator.servo_bus import triage
from sextant.services.actuator.servo_bus.bus_driver import BusSetupError, ServoBus
from sextant.services.actuator.servo_bus.bus_scan import ECHO, NO_ECHO
from sextant.services.actuator.servo_bus.command_bus import bus_of
from sextant.services.actuator.servo_bus.servo_interface import on_port
from sextant.services.actuator.servo_bus.triage import Opener
from sextant.shared.servo.models import MODEL_NAMED
from sextant.shared.servo.servo_model import ServoError, ServoModel
from tests.support.builder import Builder
from tests.support.desk import Desk
from tests.support.families import FAMILIES, Bench, robot_with

EACH = pytest.mark.parametrize("name", FAMILIES)
_ADAPTERS = pytest.mark.parametrize(("real", "given"), [(False, False), (True, True), (True, False), (False, True)])


def opener(desk: Desk, *, echo: bool) -> Opener:
    def at(rate: int, model: ServoModel) -> ServoBus:
        return bus_of(model)(desk.open(rate), [1, 2, 3], desk.clock, model=model, echo=echo)

    return Opener(at, "/dev/ttyUSB0", has_rates=True)


@EACH
@_ADAPTERS
def test_setup_refuses_an_echo_that_is_not_as_set(name: str, real: bool, given: bool) -> None:
    desk = Desk(robot_with(name), echo=real)
    bus = on_port(desk.profile, Settings(echo=given), desk.open(), desk.clock)
    if real == given:
        bus.setup()
        return
    with pytest.raises(BusSetupError, match=(ECHO if real else NO_ECHO).words):
        bus.setup()


@EACH
@_ADAPTERS
def test_triage_reports_an_echo_that_is_not_as_set(name: str, real: bool, given: bool) -> None:
    desk, model = Desk(robot_with(name), echo=real), MODEL_NAMED[name]
    found = triage.examine(opener(desk, echo=given), model, [1, 2, 3], triage.usual_rates(model))
    assert found == (None if real == given else ECHO if real else NO_ECHO)


@EACH
def test_echo_without_servos_or_with_others_is_reported(name: str) -> None:
    desk = Desk(robot_with(name), fresh=True, echo=True)
    for expected in ("AX-12A", "XL430-W250", "LX-16A"):
        model = MODEL_NAMED[expected]
        assert triage.examine(opener(desk, echo=False), model, [1, 2], triage.usual_rates(model)) == ECHO


@EACH
def test_commissioning_stops_at_an_echo(name: str) -> None:
    desk = Desk(robot_with(name), echo=True)
    for refuses in (
        lambda operator: ready(desk.bus(), desk.profile, operator),
        lambda operator: set_ids(Line(lambda _rate: desk.bus(), (desk.profile.servo_model.bus_rate,)), desk.profile, operator),
    ):
        builder = Builder([])
        assert not refuses(builder)
        assert builder.told == [": ".join(ECHO)]
    with pytest.raises(NotReadyError, match=ECHO.words):
        identify(opener(desk, echo=False), 1)
    assert ready(desk.bus(echo=True), desk.profile, Builder([]))


def test_answer_that_equals_a_ping_is_no_echo() -> None:
    """An AX-12A that reports its voltage answers a ping with a copy of it."""
    bench = Bench("AX-12A")
    bench.servos.column(bench.model.table.min_voltage)[:] = 200
    assert bench.bus.ping(1) is ServoError.INPUT_VOLTAGE
    assert bench.bus.echo_problem() is None


@EACH
def test_goals_that_echo_before_the_request_hide_nothing(name: str) -> None:
    desk = Desk(robot_with(name), echo=True)
    for echo in (True, False):
        bus = desk.bus(echo=echo)
        bus.set_torque(False)
        assert bus.echo_problem() == (None if echo else ECHO)
        assert bus.ping(1) is not None, "the next request gets its answer"
