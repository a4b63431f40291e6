"""Commissioning of a robot whose femurs have servos with other registers than its other joints."""

from datetime import date

import numpy as np
import pytest

from sextant.services.actuator.commissioning import bus_survey, set_ids
from sextant.services.actuator.commissioning.bus_survey import Line
from sextant.services.actuator.commissioning.calibration import calibrate
from sextant.services.actuator.commissioning.joint_test import STEP_DEG, run_joint_test
from sextant.services.actuator.commissioning.torque_off import torque_off
from sextant.services.actuator.servo_bus.bus_driver import ServoBus
from sextant.services.actuator.servo_bus.triage import rates_of_all, usual_rates
from sextant.shared.robot.profile import LEGS, Calibration
from tests.support.builder import Answer, Builder
from tests.support.desk import Desk
from tests.support.families import MIXED, mixed_robot

ROBOTS = [mixed_robot(*name.split("+"), name.split("+")[0]) for name in MIXED]
EACH = pytest.mark.parametrize("profile", ROBOTS, ids=MIXED)


def line(desk: Desk) -> Line:
    profile = desk.profile

    def at(rate: int) -> ServoBus:
        names, models = profile.servo_names, profile.servo_models
        return ServoBus(desk.open(rate), list(names), desk.clock, names=names, model=profile.servo_model, models=models)

    return Line(at, rates_of_all(profile.servos.models, usual_rates))


@EACH
def test_ids_of_new_servos_are_set_by_the_registers_of_their_joints(profile) -> None:  # type: ignore[no-untyped-def]
    desk, rows = Desk(profile, fresh=True), iter((*range(1, 18), 0))  # the joint with the factory id comes last

    def plug() -> str:
        desk.bench.plug([next(rows)])
        return ""

    builder = Builder([plug] * 18)
    assert set_ids.set_ids(line(desk), profile, builder), builder.all_told
    assert f"Plug in the {profile.servos.models[1].name} of the left front femur" in builder.asked[0]
    desk.settle()
    for row, (servo_id, model) in enumerate(profile.servo_models.items()):
        for register, value in {**model.joint_settings, model.table.id: servo_id}.items():
            assert int.from_bytes(desk.bench._servos.read(row, register.address, register.size), "little") == value
    assert bus_survey.verdict(bus_survey.scan(line(desk), range(20)), profile) == []


@EACH
def test_servo_of_another_joint_is_left_unchanged(profile) -> None:  # type: ignore[no-untyped-def]
    desk = Desk(profile, fresh=True)
    coxa, femur = (model.name for model in profile.servos.models[:2])

    def plug() -> str:
        desk.bench.plug([3])
        return ""

    answers: list[Answer] = [plug, "q"]
    builder = Builder(answers)
    assert not set_ids.set_ids(line(desk), profile, builder)
    assert f"servo 1 is {coxa}, {femur} expected for the left front femur: it is unchanged" in builder.all_told
    assert desk.bench._value(3, desk.bench._tables[3].id) == 1


@EACH
def test_trims_are_measured_and_joints_move(profile) -> None:  # type: ignore[no-untyped-def]
    desk, kept = Desk(profile), list[Calibration]()

    def bend() -> str:
        desk.bench.bend(1, np.zeros(3))
        return ""

    assert calibrate(desk.bus(), profile, Builder([bend, ""]), kept.append, date(2026, 1, 1), legs=LEGS[1:2])
    tick_deg = np.degrees([model.units.tick_rad for model in profile.servos.models[3:6]])
    assert (np.abs(kept[0].trims_deg - np.degrees(desk.bench.robot.trims[1])) <= tick_deg).all()
    moved = run_joint_test(desk.bus(), profile, Builder([True, "y", "y", "y"]), desk.clock, legs=LEGS[:1])
    assert moved is not None
    assert [one.problem for one in moved] == ["", "", ""]
    assert all(abs(one.moved_deg) == pytest.approx(STEP_DEG, abs=0.6) for one in moved)
    assert torque_off(desk.bus()) == {}
