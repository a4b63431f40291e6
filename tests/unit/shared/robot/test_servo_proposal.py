"""Proposed servos: data of their models, and the torques that the simulator has, too."""

import numpy as np
import pytest

from sextant.services.simulator.servo_bus.motors import MOTOR_AND_SUPPLY
from sextant.services.simulator.servo_bus.servo_bank import make_servo_bank
from sextant.shared.robot.profiles import load_profile
from sextant.shared.robot.servo_proposal import AT_VOLTS, STALL_TORQUES, nearest_servo, proposed_battery, proposed_servo
from sextant.shared.servo.models import MODEL_NAMED


def test_every_model_has_the_torque_of_its_simulated_motor() -> None:
    assert {name: motor.stall_torque for name, (motor, _) in MOTOR_AND_SUPPLY.items()} == dict(STALL_TORQUES)
    assert set(STALL_TORQUES) == set(MODEL_NAMED)


@pytest.mark.parametrize("name", sorted(STALL_TORQUES))
def test_proposed_servo_has_the_data_of_its_model(name: str) -> None:
    servo, model = proposed_servo(name), MODEL_NAMED[name]
    assert servo.model == name
    assert servo.stiffness == pytest.approx(servo.nominal_stiffness, rel=1e-3)
    assert servo.no_load_speed <= 1.001 * model.no_load_speed
    assert servo.controller_settings == {register: model.default(register) for register in servo.controller_settings}
    assert servo.temperature_limit == model.default(model.table.temperature_limit)
    doubled = proposed_servo(name, 2.0 * servo.stall_torque)
    assert doubled.stiffness == pytest.approx(2.0 * servo.stiffness, rel=1e-3)


def test_proposed_servos_are_those_of_the_shipped_profiles() -> None:
    for robot in ("phantomx_mk2", "lotriet_rx64"):
        servo = load_profile(robot).servo
        proposed = proposed_servo(nearest_servo(servo.stall_torque))
        for value in ("model", "stall_torque", "compliance_slope", "temperature_limit"):
            assert getattr(proposed, value) == getattr(servo, value)
        assert (proposed.stiffness, proposed.no_load_speed) == pytest.approx((servo.stiffness, servo.no_load_speed), rel=0.01)
    assert nearest_servo(None) == "AX-12A"
    printed, proposed = load_profile("printed_sts3215").servo, proposed_servo("STS3215")
    for value in ("armature", "friction", "stall_torque", "position_gain", "stiffness"):
        assert getattr(proposed, value) == getattr(printed, value)


@pytest.mark.parametrize("name", sorted(AT_VOLTS))
def test_no_load_speed_of_a_model_is_that_at_its_highest_voltage(name: str) -> None:
    volts = max(AT_VOLTS[name])
    highest = 18.5 if name in ("RX-28", "RX-64") else volts  # more than a battery of four cells has
    assert AT_VOLTS[name][volts][1] == pytest.approx(MODEL_NAMED[name].no_load_rpm * volts / highest)


@pytest.mark.parametrize("name", sorted(STALL_TORQUES))
def test_simulated_battery_is_that_of_the_profile(name: str) -> None:
    """A full battery is above the limit at which the robot warns, and an empty one at the limit at which it sits down."""
    for volts in (None, *AT_VOLTS.get(name, ())):
        servo, battery = proposed_servo(name, volts=volts), proposed_battery(name, volts)
        supply = make_servo_bank(servo, (1,), np.zeros(1), battery=battery).supply
        assert supply.full_voltage >= 1.05 * battery.warn_voltage
        if supply.full_voltage != supply.empty_voltage:  # no bench supply
            assert supply.empty_voltage == battery.empty_voltage


@pytest.mark.parametrize("name", sorted(AT_VOLTS))
def test_servo_at_another_voltage_has_the_data_for_it(name: str) -> None:
    usual, *others = AT_VOLTS[name]
    assert AT_VOLTS[name][usual][0] == STALL_TORQUES[name]
    assert proposed_servo(name, volts=usual) == proposed_servo(name)
    for volts in others:
        servo = proposed_servo(name, volts=volts)
        assert (servo.stall_torque, servo.no_load_speed) != (
            proposed_servo(name).stall_torque,
            proposed_servo(name).no_load_speed,
        )
        assert servo.stiffness == pytest.approx(servo.nominal_stiffness, rel=1e-3)
    with pytest.raises(ValueError, match=f"a voltage of the {name}"):
        proposed_servo(name, volts=5.0)
