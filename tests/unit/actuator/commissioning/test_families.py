"""Commissioning of servos of every family, on emulated servos at packet level."""

from datetime import date

import numpy as np
import pytest

from sextant.services.actuator.commissioning import bus_survey, set_ids
from sextant.services.actuator.commissioning.bus_survey import Line
from sextant.services.actuator.commissioning.calibration import calibrate
from sextant.services.actuator.commissioning.joint_test import STEP_DEG, run_joint_test
from sextant.services.actuator.commissioning.limited_motion import torque_words
from sextant.services.actuator.commissioning.torque_off import torque_off
from sextant.services.actuator.servo_bus.bus_driver import ServoBus
from sextant.services.actuator.servo_bus.command_bus import bus_of
from sextant.services.actuator.servo_bus.triage import usual_rates
from sextant.shared.robot.new_profile import Measures, new_profile
from sextant.shared.robot.profile import LEGS, Calibration
from sextant.shared.servo.models import MODELS
from sextant.shared.servo.servo_model import Register
from tests.support.builder import Answer, Builder
from tests.support.desk import PHANTOMX, Desk
from tests.support.families import FAMILIES, robot_with

OTHERS = [name for name in FAMILIES if name != "AX-12A"]  # for which the other tests of this folder are


def line(desk: Desk) -> Line:
    def at(rate: int) -> ServoBus:
        names, model = desk.profile.servo_names, desk.profile.servo_model
        return bus_of(model)(desk.open(rate), list(names), desk.clock, names=names, model=model)

    return Line(at, usual_rates(desk.profile.servo_model))


@pytest.mark.parametrize("name", OTHERS)
def test_ids_of_18_new_servos_are_set(name: str) -> None:
    desk = Desk(robot_with(name), fresh=True)
    writes: list[tuple[Register, int]] = []
    bank = desk.bench._servos

    def plug() -> str:
        desk.bench.plug(desk.bench.unplugged[:1])
        return ""

    answers: list[Answer] = [plug] * 18
    assert set_ids.set_ids(line(desk), desk.profile, Builder(answers)), writes
    desk.settle()
    model, table = bank.model, bank.table
    assert sorted(bank.column(table.id).tolist()) == sorted(desk.profile.servo_names)
    for register, value in {**model.joint_settings, table.baud_rate: model.rate_code(model.bus_rate)}.items():
        assert (bank.column(register) == value).all(), register.name
    assert not bank.column(table.torque_enable).any()
    assert bus_survey.verdict(bus_survey.scan(line(desk)), desk.profile) == []


def test_eeprom_of_feetech_servo_is_unlocked_for_its_id_and_locked_again() -> None:
    desk = Desk(robot_with("STS3215"), fresh=True)
    bank, written = desk.bench._servos, []
    write = bank.write

    def noted(row: int, address: int, data: bytes) -> None:
        written.append((address, data))
        write(row, address, data)

    desk.bench.plug(desk.bench.unplugged[:1])
    bank.write = noted  # type: ignore[method-assign]
    set_ids.set_ids(line(desk), desk.profile, Builder(["", "q"]))
    desk.settle()
    table = bank.table
    assert table.lock is not None
    order = [address for address, data in written if address in (table.lock.address, table.id.address)]
    assert order == [table.lock.address, table.id.address, table.lock.address]
    assert bank.column(table.lock)[0] == 1


def test_settings_of_feetech_servo_outlast_its_power() -> None:
    desk = Desk(robot_with("STS3215"), fresh=True)
    bank = desk.bench._servos
    bank.column(bank.table.baud_rate)[:] = 6  # 57600, as another program may have left it
    desk.bench.plug(desk.bench.unplugged[:1])
    set_ids.set_ids(line(desk), desk.profile, Builder(["left front femur", "q"]))
    desk.settle()
    row = bank.column(bank.table.id).tolist().index(2)
    bank.power_up(row)
    assert bank.column(bank.table.baud_rate)[row] == 0
    assert bank.column(bank.table.id)[row] == 2
    bank.write(row, bank.table.id.address, b"\x09")  # locked: acts, and is lost without power
    assert bank.column(bank.table.id)[row] == 9
    bank.power_up(row)
    assert bank.column(bank.table.id)[row] == 2


def test_torque_off_reaches_servos_of_another_table_with_the_same_packets() -> None:
    desk = Desk(robot_with("STS3215"))
    bank = desk.bench._servos
    bank.column(bank.table.torque_enable)[:] = 1
    names = PHANTOMX.servo_names
    bus = ServoBus(desk.open(), list(names), desk.clock, names=names, model=PHANTOMX.servo_model)
    assert torque_off(bus) == {}
    desk.settle()
    assert not bank.column(bank.table.torque_enable).any()


def test_gain_that_differs_from_the_profile_is_named() -> None:
    desk = Desk(robot_with("XL430-W250"))
    bank = desk.bench._servos
    assert bank.table.position_gain is not None
    bank.column(bank.table.position_gain)[4] = 400
    (problem,) = bus_survey.verdict(bus_survey.scan(line(desk)), desk.profile)
    assert "has a position p gain of 400, 640 in the profile" in problem.words
    assert "set-id" not in problem.advice, "it does not write gains"


@pytest.mark.parametrize("name", [model.name for model in MODELS])
def test_servos_that_are_set_up_are_in_order_with_a_profile_from_measures(name: str) -> None:
    desk = Desk(new_profile("robot", Measures(0.03, 0.045, 0.075, 0.07, 0.035, 0.06, 0.75, name)))
    assert bus_survey.verdict(bus_survey.scan(line(desk), desk.profile.servo_names), desk.profile) == []


@pytest.mark.parametrize("name", OTHERS)
def test_trims_of_a_leg_are_measured(name: str) -> None:
    desk, kept = Desk(robot_with(name)), []

    def bend() -> str:
        desk.bench.bend(1, np.zeros(3))
        return ""

    def keep(entry: Calibration) -> None:
        kept.append(entry)

    assert calibrate(desk.bus(), desk.profile, Builder([bend, ""]), keep, date(2026, 1, 1), legs=LEGS[1:2])
    tick_deg = np.degrees(desk.profile.servo_model.units.tick_rad)
    np.testing.assert_allclose(kept[0].trims_deg, np.degrees(desk.bench.robot.trims[1]), atol=tick_deg)


@pytest.mark.parametrize("name", OTHERS)
def test_joints_of_a_leg_move_and_return(name: str) -> None:
    desk = Desk(robot_with(name))
    moved = run_joint_test(desk.bus(), desk.profile, Builder([True, "y", "y", "y"]), desk.clock, legs=LEGS[:1])
    assert moved is not None
    assert [one.problem for one in moved] == ["", "", ""]
    assert all(abs(one.moved_deg) == pytest.approx(STEP_DEG, abs=0.6) for one in moved)
    assert torque_off(desk.bus()) == {}


def test_words_do_not_promise_a_torque_limit_that_servos_lack() -> None:
    assert torque_words(robot_with("STS3215").servo_model) == "little torque"
    assert "full torque" in torque_words(robot_with("LX-16A").servo_model)
