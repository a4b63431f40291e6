"""Servos of several models on one bus."""

import numpy as np
import pytest

from sextant.services.actuator.commissioning.bus_survey import Line, hampered, scan, verdict
from sextant.services.actuator.config import Settings
from sextant.services.actuator.servo_bus.bus_driver import BusSetupError
from sextant.services.actuator.servo_bus.group_writes import GroupWrites
from sextant.services.actuator.servo_bus.joints import Joints
from sextant.services.actuator.servo_bus.servo_interface import on_port
from sextant.services.simulator.servo_bus.bus import ServoBusEmulator
from sextant.services.simulator.servo_bus.memory_port import MemoryPort
from sextant.services.simulator.servo_bus.servo_bank import ServoVariation
from sextant.services.simulator.servo_bus.servo_banks import ServoBanks, make_robot_servos
from sextant.shared.geometry import Array
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.servo.models import AX_12A, MX_28, XL430_W250, XL_320
from sextant.shared.servo.servo_model import Kind, Request
from tests.support.families import mixed_robot

PROFILE = mixed_robot("XM430-W350", "XC430-W240", "XL430-W250")
OTHERS = mixed_robot("AX-12A", "MX-28", "AX-12A")  # with other registers in the femurs
EACH = pytest.mark.parametrize("profile", [PROFILE, OTHERS], ids=["one table", "two"])
EXACT = ServoVariation(np.ones(18), np.ones(18), np.zeros(18))


class Rig:
    """Mixed servos on a bus in memory, and the joints."""

    def __init__(self, profile: RobotProfile = PROFILE) -> None:
        self.now_ns = 0
        bank, _ = make_robot_servos(profile, np.zeros(18), 4.0, 1.0, EXACT)
        assert isinstance(bank, ServoBanks)
        self.bank = bank
        for row, one in enumerate(profile.servos.each):
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


@EACH
def test_loads_and_angles_are_in_units_of_each_model(profile: RobotProfile) -> None:
    rig = Rig(profile)
    joints = Joints(profile, Settings(), lambda: rig.port, rig.port.now_ns)
    q, ahead = np.linspace(-0.4, 0.2, 18).reshape(6, 3), np.tile([0.03, -0.05, 0.08], (6, 1))
    servo = profile.servo_angles(q).ravel()
    for cycle in range(8):
        rig.pass_time(servo, np.zeros(18))
        joints.read([])
        if cycle == 0:
            joints.torque_on()
        joints.write(q + ahead)
    ticks = np.array([model.units.tick_rad for model in profile.servos.models]).reshape(6, 3)
    assert (np.abs(joints.q - q) <= 0.51 * ticks).all()
    margins = np.array([bool(model.table.compliance) for model in profile.servos.models]).reshape(6, 3)  # of one tick
    most = np.minimum(profile.servos.stiffness * np.abs(ahead), profile.servos.stall_torque)
    left = np.sign(ahead) * most - joints.load
    assert (np.abs(left) <= profile.servos.stiffness * ticks * (0.51 + margins) + 0.005 * profile.servos.stall_torque).all()
    np.testing.assert_allclose(joints.read_loads(), joints.load, atol=0.05)


@EACH
def test_goals_reach_servos_of_each_model(profile: RobotProfile) -> None:
    rig = Rig(profile)
    joints = Joints(profile, Settings(), lambda: rig.port, rig.port.now_ns)
    rig.pass_time(np.zeros(18), np.zeros(18))
    joints.read([])
    joints.torque_on()
    joints.write(profile.joint_angles(np.full((6, 3), 0.2)))
    rig.pass_time(np.zeros(18), np.zeros(18))
    rig.pass_time(np.zeros(18), np.zeros(18))
    ticks = np.array([model.units.tick_rad for model in profile.servos.models])
    assert (np.abs(rig.command.setpoint - 0.2) <= 1.51 * ticks).all(), "an AX-12A has a margin of one tick"
    torques = rig.command.torque_limit.reshape(6, 3)
    np.testing.assert_allclose(torques, profile.servos.stall_torque)
    np.testing.assert_allclose(rig.command.stiffness.reshape(6, 3), profile.servos.stiffness, rtol=1e-6)


@EACH
def test_all_mixed_servos_are_in_order_in_a_scan(profile: RobotProfile) -> None:
    rig = Rig(profile)
    line = Line(lambda _rate: on_port(profile, Settings(), rig.port, rig.port.now_ns))  # type: ignore[arg-type,return-value]
    found = scan(line, profile.servo_names)
    assert {one.seen.model for one in found} == {model.name for model in profile.servos.models}
    assert not verdict(found, profile)
    assert not hampered((one.seen for one in found), profile)


def test_one_packet_has_the_goals_of_all_servos_with_goals_at_the_same_addresses() -> None:
    models = [AX_12A, MX_28, XL_320, XL430_W250]
    counts = {}
    for pair in ((0, 1), (2, 3)):
        of = [models[k] for k in pair]
        goals, packets = GroupWrites(of[0].protocol, (1, 2), of).goals([1023, 1000], 5)
        assert goals == [1023, 1000]
        counts[pair] = len(packets)
    assert counts == {(0, 1): 1, (2, 3): 2}


def test_goal_beyond_the_range_of_one_model_is_refused() -> None:
    writes = GroupWrites(AX_12A.protocol, (1, 2), [AX_12A, MX_28])
    assert writes.goals([1023, 4095], [0, 1023])[0] == [1023, 4095]
    for goals, speeds in (([1024, 4095], 0), ([0, 4096], 0), (1024, 0), ([0, 0], [0, 1024])):
        with pytest.raises(ValueError, match="takes 0 to"):
            writes.goals(goals, speeds)
    with pytest.raises(ValueError, match=r"integers of shape \(2,\) expected"):
        writes.goals([0, 0, 0], 0)


def test_torque_off_is_a_broadcast_only_if_all_servos_have_it_at_one_address() -> None:
    protocol = AX_12A.protocol
    (one,) = GroupWrites(protocol, (1, 2), [AX_12A, MX_28]).torque_off()
    (packet,) = protocol.instruction_parser().feed(one)
    assert packet.servo_id == protocol.BROADCAST_ID
    assert protocol.request(packet) == Request(Kind.WRITE, AX_12A.table.torque_enable.address, data=b"\x00")
    protocol = XL_320.protocol
    requests = [
        protocol.request(*protocol.instruction_parser().feed(packet))
        for packet in GroupWrites(protocol, (1, 2), [XL_320, XL430_W250]).torque_off()
    ]
    expected = zip((1, 2), (XL_320.table.torque_enable, XL430_W250.table.torque_enable), strict=True)
    assert requests == [Request(Kind.SYNC_WRITE, at.address, 1, rows=((i, b"\x00"),)) for i, at in expected]


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
