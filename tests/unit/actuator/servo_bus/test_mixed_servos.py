"""Servos of several models on one bus."""

import numpy as np
import pytest

from sextant.services.actuator.commissioning.set_ids import Line, hampered, scan, verdict
from sextant.services.actuator.config import Settings
from sextant.services.actuator.servo_bus.bus_driver import BusSetupError
from sextant.services.actuator.servo_bus.joints import Joints
from sextant.services.actuator.servo_bus.servo_interface import on_port
from sextant.services.simulator.servo_bus.bus import ServoBusEmulator
from sextant.services.simulator.servo_bus.memory_port import MemoryPort
from sextant.services.simulator.servo_bus.servo_bank import ServoVariation
from sextant.services.simulator.servo_bus.servo_banks import ServoBanks, make_robot_servos
from sextant.shared.geometry import Array
from tests.support.families import mixed_robot

PROFILE = mixed_robot("XM430-W350", "XC430-W240", "XL430-W250")
EXACT = ServoVariation(np.ones(18), np.ones(18), np.zeros(18))


class Rig:
    """Mixed servos on a bus in memory, and the joints."""

    def __init__(self) -> None:
        self.now_ns = 0
        bank, _ = make_robot_servos(PROFILE, np.zeros(18), 4.0, 1.0, EXACT)
        assert isinstance(bank, ServoBanks)
        self.bank = bank
        for row, one in enumerate(PROFILE.servos.each):
            model = one.servo_model
            for register, value in {**one.controller_settings, model.table.baud_rate: model.rate_code(model.bus_rate)}.items():
                bank.write(row, register.address, register.encode(value))
        self.emulator = ServoBusEmulator(bank)
        self.port = MemoryPort(self.emulator, lambda: self.now_ns)

    def pass_time(self, q: Array, torque: Array) -> None:
        self.now_ns = self.port.now_ns() + 20_000_000
        self.emulator.advance(self.now_ns)
        self.bank.set_joint_state(q, np.zeros(18), torque, self.now_ns)
        self.command = self.bank.advance(0.02)


def test_loads_and_angles_are_in_units_of_each_model() -> None:
    rig = Rig()
    joints = Joints(PROFILE, Settings(), lambda: rig.port, rig.port.now_ns)
    q, ahead = np.linspace(-0.4, 0.2, 18).reshape(6, 3), np.tile([0.03, -0.05, 0.08], (6, 1))
    servo = PROFILE.servo_angles(q).ravel()
    for cycle in range(4):
        rig.pass_time(servo, np.zeros(18))
        joints.read([])
        if cycle == 0:
            joints.torque_on()
        joints.write(q + ahead)
    np.testing.assert_allclose(joints.q, q, atol=2e-3)
    np.testing.assert_allclose(joints.load, PROFILE.servos.stiffness * ahead, atol=0.05)
    np.testing.assert_allclose(joints.read_loads(), joints.load, atol=0.05)


def test_goals_reach_servos_of_each_model() -> None:
    rig = Rig()
    joints = Joints(PROFILE, Settings(), lambda: rig.port, rig.port.now_ns)
    rig.pass_time(np.zeros(18), np.zeros(18))
    joints.read([])
    joints.torque_on()
    joints.write(PROFILE.joint_angles(np.full((6, 3), 0.2)))
    rig.pass_time(np.zeros(18), np.zeros(18))
    rig.pass_time(np.zeros(18), np.zeros(18))
    np.testing.assert_allclose(rig.command.setpoint, 0.2, atol=2e-3)
    torques = rig.command.torque_limit.reshape(6, 3)
    np.testing.assert_allclose(torques, PROFILE.servos.stall_torque)
    np.testing.assert_allclose(rig.command.stiffness.reshape(6, 3), PROFILE.servos.stiffness, rtol=1e-6)


def test_all_mixed_servos_are_in_order_in_a_scan() -> None:
    rig = Rig()
    line = Line(lambda _rate: on_port(PROFILE, Settings(), rig.port, rig.port.now_ns))  # type: ignore[arg-type,return-value]
    found = scan(line, PROFILE.servo_names)
    assert {one.seen.model for one in found} == {"XM430-W350", "XC430-W240", "XL430-W250"}
    assert not verdict(found, PROFILE)
    assert not hampered((one.seen for one in found), PROFILE)


def test_servo_of_another_joints_model_is_named() -> None:
    rig = Rig()
    table = PROFILE.servo_model.table
    rig.bank._places[1][0].column(table.model_number)[0] = PROFILE.servo_model.number  # an XM430 at the left front femur
    with pytest.raises(BusSetupError, match=r"servo 2 \(left front femur\) is model 1020 \(XM430-W350\), expected 1080"):
        on_port(PROFILE, Settings(), rig.port, rig.port.now_ns).setup()


def test_banks_share_their_supply() -> None:
    rig = Rig()
    torque = np.zeros(18)
    torque[::3] = PROFILE.servos.stall_torque[:, 0]
    for _ in range(3):
        rig.pass_time(np.zeros(18), torque)
    banks = rig.bank._banks
    np.testing.assert_allclose([bank.voltage for bank in banks], banks[0].voltage, atol=1e-3)
    idle = sum(len(bank) * bank.motor.standby_current for bank in banks) + banks[0].supply.computer_current
    stalled = next(bank for bank in banks if bank.model is PROFILE.servo_model)
    assert banks[0].current == pytest.approx(idle + 6 * stalled.motor.stall_current)
