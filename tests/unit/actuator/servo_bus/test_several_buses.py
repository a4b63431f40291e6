"""Two buses as one list of servos: interleaved reads, units of each family, and a lost bus."""

from collections.abc import Callable

import numpy as np
import pytest

from sextant.services.actuator.config import Settings
from sextant.services.actuator.servo_bus.bus_driver import BusDisconnectedError, BusSetupError, Port
from sextant.services.actuator.servo_bus.joints import Joints
from sextant.services.actuator.servo_bus.servo_interface import connect, port_openers
from sextant.services.actuator.servo_bus.several_buses import SeveralBuses
from sextant.services.simulator.servo_bus.bus import ServoBusEmulator
from sextant.services.simulator.servo_bus.memory_port import MemoryPort
from sextant.services.simulator.servo_bus.servo_bank import ServoVariation
from sextant.services.simulator.servo_bus.servo_banks import make_robot_servos
from sextant.shared.geometry import Array
from sextant.shared.robot.profile import RobotProfile
from tests.support.families import command_robot, mixed_robot, two_bus_robot

PROFILE, COMMANDS = two_bus_robot(), command_robot()
ROBOTS = pytest.mark.parametrize("profile", [PROFILE, COMMANDS], ids=["registers", "commands"])
EXACT = ServoVariation(np.ones(18), np.ones(18), np.zeros(18))
LEFT, RIGHT = (list(bus.rows) for bus in PROFILE.servos.buses)


class Rig:
    """Servos on their buses in memory; the ports share a clock."""

    def __init__(self, profile: RobotProfile = PROFILE) -> None:
        self.now_ns = 0
        self.profile = profile
        self.bank, on_bus = make_robot_servos(profile, np.zeros(18), 4.0, 1.0, EXACT)
        for row, one in enumerate(profile.servos.each):
            model = one.servo_model
            for register, value in {**one.controller_settings, model.table.baud_rate: model.rate_code(model.bus_rate)}.items():
                self.bank.write(row, register.address, register.encode(value))
        names = [bus.name for bus in profile.servos.buses]
        self.emulators = {name: ServoBusEmulator(bank) for name, bank in zip(names, on_bus, strict=True)}
        self.ports: dict[str, MemoryPort] = {}
        self.absent: set[str] = set()

    @property
    def openers(self) -> dict[str, Callable[[], Port]]:
        return {name: lambda name=name: self._open(name) for name in self.emulators}  # type: ignore[misc]

    def _open(self, name: str) -> MemoryPort:
        if name in self.absent:
            raise BusDisconnectedError(f"no {name} adapter")
        self.ports[name] = MemoryPort(self.emulators[name], self.clock, start_ns=self.clock())
        return self.ports[name]

    def clock(self) -> int:
        return max((self.now_ns, *(port.last_ns for port in self.ports.values())))

    def unplug(self, name: str) -> None:
        self.absent.add(name)
        self.ports[name].close()

    def pass_time(self, q: Array | None = None) -> None:
        self.now_ns = self.clock() + 10_000_000
        for emulator in self.emulators.values():
            emulator.advance(self.now_ns)
        self.bank.set_joint_state(np.zeros(18) if q is None else q, np.zeros(18), np.zeros(18), self.now_ns)
        self.command = self.bank.advance(0.01)

    def joints(self) -> Joints:
        return Joints(self.profile, Settings(), self.openers, self.clock)

    def buses(self) -> SeveralBuses:
        found = connect(self.profile, Settings(), self.openers, self.clock)
        assert isinstance(found, SeveralBuses)
        found.setup()
        self.pass_time()
        return found


def test_readings_and_goals_of_two_families_are_those_of_their_joints() -> None:
    rig = Rig()
    joints = rig.joints()
    q, ahead = np.linspace(-0.3, 0.3, 18).reshape(6, 3), np.full((6, 3), 0.04)
    servo = PROFILE.servo_angles(q).ravel()
    for cycle in range(4):
        rig.pass_time(servo)
        assert {reading.index for reading in joints.read([1, 7])} == set(range(18))
        if cycle == 0:
            joints.torque_on()
        joints.write(q + ahead)
    np.testing.assert_allclose(joints.q, q, atol=2e-3)
    np.testing.assert_allclose(joints.load, PROFILE.servos.stiffness * ahead, atol=0.08)
    assert joints.torque.all()
    assert joints.vitals.errors.tolist() == [0] * 18


@pytest.mark.parametrize("models", [("AX-12A",) * 3, ("XM430-W350", "XM430-W350", "XL430-W250"), ("STS3215",) * 3])
def test_two_buses_are_read_in_the_time_of_one(models: tuple[str, str, str]) -> None:
    """A bus with half of the servos takes half of the time, and the other one is read meanwhile."""
    mixed = mixed_robot(*models)
    two = Rig(RobotProfile(**{**vars_of(mixed), "buses": PROFILE.buses}))
    buses = two.buses()
    start = two.clock()
    readings = buses.poll(9_000_000)
    took_ns = two.clock() - start
    left = next(bus for name, _, bus in buses._parts if name == "left")
    two.pass_time()
    start = two.clock()
    alone = left.poll(9_000_000)
    alone_ns = two.clock() - start
    assert len(readings) >= 2 * len(alone) - 1
    assert took_ns < 1.3 * alone_ns


def vars_of(profile: RobotProfile) -> dict[str, object]:
    """Return the fields of a profile."""
    return {name: getattr(profile, name) for name in RobotProfile.__dataclass_fields__}


def read_and_moved(profile: RobotProfile) -> tuple[float, float]:
    """Return how many positions a cycle of 20 ms reads on average, and how many goals arrive, of 18 that change in each."""
    rig, cycles, read, moved = Rig(profile), 40, 0, 0
    joints = Joints(profile, Settings(), rig.openers if profile.buses else rig.openers[""], rig.clock)
    joints.torque_on()
    rig.pass_time()
    goal = profile.servos.models[0].table.goal_position
    for cycle in range(cycles):
        began, before = rig.clock(), rig.bank.column(goal)
        readings = joints.read([])
        joints.write(profile.joint_angles(np.full((6, 3), 0.01 * (cycle % 30))))
        rig.now_ns = max(rig.clock(), began + 20_000_000)
        for emulator in rig.emulators.values():
            emulator.advance(rig.now_ns)
        rig.bank.set_joint_state(np.zeros(18), np.zeros(18), np.zeros(18), rig.now_ns)
        rig.bank.advance(0.02)
        assert {reading.index for reading in readings} <= set(range(18))
        read, moved = read + len(readings), moved + int((rig.bank.column(goal) != before).sum())
    return read / cycles, moved / cycles


def test_two_buses_read_and_move_twice_as_many_servos_with_commands() -> None:
    one, two = read_and_moved(command_robot(buses=())), read_and_moved(COMMANDS)
    assert two[0] > 1.8 * one[0]
    assert two[1] > 1.4 * one[1]
    assert two[1] > 16.0, "nearly all goals arrive in each cycle"


def test_readings_of_servos_with_commands_are_those_of_their_joints() -> None:
    rig = Rig(COMMANDS)
    joints = rig.joints()
    q, ahead = np.linspace(-0.3, 0.3, 18).reshape(6, 3), np.full((6, 3), 0.02)
    servo, seen = COMMANDS.servo_angles(q).ravel(), set[int]()
    rig.pass_time(servo)
    joints.torque_on()
    for _ in range(30):
        rig.pass_time(servo)
        seen |= {reading.index for reading in joints.read([1, 7])}
        joints.write(q + ahead)
    assert seen == set(range(18))
    np.testing.assert_allclose(joints.q, q, atol=5e-3)
    tick = COMMANDS.servo_model.units.tick_rad
    np.testing.assert_allclose(joints.load / COMMANDS.servos.stiffness, ahead, atol=1.1 * tick)


def test_one_silent_servo_does_not_delay_the_other_bus() -> None:
    rig = Rig()
    buses = rig.buses()
    rig.emulators["left"].cut_off(frozenset((0,)))
    for _ in range(10):
        rig.pass_time()
        read = {reading.index for reading in buses.poll(9_000_000)}
        assert set(RIGHT) <= read
    assert buses.missed[LEFT[0]] > 3
    assert not buses.missed[RIGHT].any()


@ROBOTS
def test_lost_bus_is_named_and_comes_back(profile: RobotProfile) -> None:
    rig = Rig(profile)
    joints = rig.joints()
    rig.pass_time()
    joints.read([])
    rig.unplug("right")
    rig.pass_time()
    assert joints.read([]) == []
    assert joints.trouble.startswith("bus right: the servo port is gone")
    for _ in range(30):
        rig.pass_time()
        joints.read([])
    assert "bus right: no right adapter" in joints.trouble
    rig.absent.clear()
    for _ in range(60):
        rig.pass_time()
        joints.read([])
    assert joints.trouble == ""


@ROBOTS
def test_torque_off_reaches_the_bus_that_is_left(profile: RobotProfile) -> None:
    rig = Rig(profile)
    joints = rig.joints()
    rig.pass_time()
    joints.read([])
    joints.torque_on()
    rig.pass_time()
    assert (rig.command.torque_limit > 0.0).all()
    rig.unplug("right")
    joints.torque_off()
    for _ in range(2):
        joints.read([])
        rig.pass_time()
    assert not rig.command.torque_limit[LEFT].any()
    assert (rig.command.torque_limit[RIGHT] > 0.0).all(), "nothing reaches them"
    rig.absent.clear()
    for _ in range(2):
        joints.read([])
        rig.pass_time()
    assert not rig.command.torque_limit.any()


@ROBOTS
def test_torque_off_ordered_after_the_loss_reaches_the_bus_that_is_left(profile: RobotProfile) -> None:
    rig = Rig(profile)
    joints = rig.joints()
    rig.pass_time()
    joints.read([])
    joints.torque_on()
    rig.pass_time()
    rig.unplug("left")
    joints.read([])
    assert joints.gone
    joints.torque_off()
    joints.read([])
    rig.pass_time()
    assert not rig.command.torque_limit[RIGHT].any()


@ROBOTS
def test_missing_servos_are_named_with_their_bus(profile: RobotProfile) -> None:
    rig = Rig(profile)
    rig.emulators["right"].cut_off(frozenset(range(9)))
    with pytest.raises(BusSetupError, match=r"^bus right: none of the 9 servos answers"):
        connect(profile, Settings(), rig.openers, rig.clock).setup()


def test_robot_with_two_buses_needs_two_ports_and_no_bridge() -> None:
    with pytest.raises(BusSetupError, match=r"actuator\.port: a port for each bus of the robot expected"):
        port_openers(PROFILE, Settings())
    assert port_openers(PROFILE, Settings(port="left=/dev/a, right=/dev/b")).keys() == {"left", "right"}
    with pytest.raises(BusSetupError, match="one servo model and one bus behind a bridge expected"):
        connect(PROFILE, Settings(bridge=True), Rig().openers, lambda: 0)
