"""Robots and buses with the servos of each family."""

from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any

import numpy as np

from sextant.services.actuator.servo_bus.bus_driver import ServoBus
from sextant.services.actuator.servo_bus.command_bus import bus_of
from sextant.services.simulator.servo_bus.bus import ServoBusEmulator
from sextant.services.simulator.servo_bus.memory_port import MemoryPort
from sextant.services.simulator.servo_bus.motors import MOTOR_AND_SUPPLY
from sextant.services.simulator.servo_bus.servo_bank import make_servo_bank
from sextant.services.simulator.servo_bus.servo_banks import AnyBank, ServoBanks
from sextant.shared.geometry import Array
from sextant.shared.robot.joint_servos import BusJoints, ServoGroup
from sextant.shared.robot.profile import JOINTS, RobotProfile
from sextant.shared.robot.profiles import load_profile
from sextant.shared.robot.servo import Servo
from sextant.shared.robot.servo_proposal import proposed_battery
from sextant.shared.servo.models import MODEL_NAMED
from sextant.shared.servo.servo_model import ServoModel

# One of each control table, at least.
FAMILIES = ("AX-12A", "MX-28", "XL-320", "XL430-W250", "XM430-W350", "STS3215", "SCS0009", "LX-16A")

LEFT_AND_RIGHT = (BusJoints(name="left", joints=("left",)), BusJoints(name="right", joints=("right",)))

MIXED = ("AX-12A+MX-28", "XL-320+XL430-W250")  # on one bus in turn: goals at the same addresses, and everything at others


def robot_with(model_name: str) -> RobotProfile:
    """Return the printed robot with servos of another model, by its data sheet."""
    profile, model = load_profile("printed_sts3215"), MODEL_NAMED[model_name]
    table, stall = model.table, MOTOR_AND_SUPPLY[model_name][0].stall_torque
    gain = model.default(table.position_gain) if table.position_gain else 0
    stiffness = model.gain_stiffness if model.commands else gain * model.gain_stiffness
    servo = Servo(
        model=model_name,
        stall_torque=stall,
        no_load_speed=model.no_load_speed,
        stiffness=stall * stiffness if stiffness else stall / (32 * model.units.tick_rad),
        armature=0.01,
        friction=0.03,
        compliance_slope=32 if table.compliance else 0,
        position_gain=gain,
        temperature_limit=float(model.default(table.temperature_limit)),
    )
    return replace(profile, name=f"robot_{model_name.lower()}", servo=servo, battery=proposed_battery(model_name))


def mixed_robot(*models: str) -> RobotProfile:
    """Return a robot whose coxas, femurs and tibias have these models."""
    base, *_ = robots = [robot_with(model) for model in models]
    groups = [
        ServoGroup(joints=(joint,), **{one.name: getattr(robot.servo, one.name) for one in fields(Servo)})
        for joint, robot in zip(JOINTS, robots, strict=True)
    ]
    return replace(base, name="mixed", servo_groups=tuple(groups[1:]))


def two_bus_robot() -> RobotProfile:
    """Return a robot with XM430 and XL430 servos on its left bus, and STS3215 servos on its right one."""
    base = mixed_robot("XM430-W350", "XM430-W350", "XL430-W250")
    right = robot_with("STS3215").servo
    tibias = replace(base.servo_groups[1], joints=("left front tibia", "left middle tibia", "left rear tibia"))
    sts = ServoGroup(joints=("right",), **{one.name: getattr(right, one.name) for one in fields(Servo)})
    return replace(base, name="two_buses", servo_groups=(tibias, sts), buses=LEFT_AND_RIGHT)


def command_robot(*, buses: tuple[BusJoints, ...] = LEFT_AND_RIGHT) -> RobotProfile:
    """Return a robot with LX-16A servos, and HX-35H servos in its femurs, on two buses."""
    return replace(mixed_robot("LX-16A", "HX-35H", "LX-16A"), name="commands", buses=buses)


def _bank(names: list[str], ids: tuple[int, ...]) -> AnyBank:
    """Return servos of these models in turn, on the supply of the first."""
    servos = [robot_with(name).servo for name in names]
    rows = [tuple(range(k, len(ids), len(names))) for k in range(len(names))][: len(ids)]
    of_rows = list(zip(servos, rows, strict=False))
    banks = [make_servo_bank(one, [ids[k] for k in of], np.zeros(len(of)), powered_like=servos[0]) for one, of in of_rows]
    return banks[0] if len(banks) == 1 else ServoBanks(banks, rows)


class Bench:
    """Some servos on a bus in memory, in virtual time: of one model, or of several in turn, as "AX-12A+MX-28"."""

    def __init__(self, model_name: str, n: int = 3, spoil: Callable[[bytes], bytes] | None = None) -> None:
        names = model_name.split("+")
        self.ids = tuple(range(1, n + 1))
        self.models: list[ServoModel] = [MODEL_NAMED[names[k % len(names)]] for k in range(n)]
        self.model = self.models[0]
        self.servos: Any = _bank(names, self.ids)
        for row, model in enumerate(self.models):
            rate = model.table.baud_rate
            self.servos.write(row, rate.address, rate.encode(model.rate_code(model.bus_rate)))
        self.tick_rad = max(model.units.tick_rad for model in self.models)
        self.emulator = ServoBusEmulator(self.servos)
        self.now_ns = 0
        self.port = MemoryPort(self.emulator, lambda: self.now_ns)
        if spoil is not None:
            read = self.port.read
            self.port.read = lambda size=1: spoil(read(size))  # type: ignore[method-assign]
        self.bus = self.driver()

    def driver(self, *, echo: bool = False) -> ServoBus:
        """Return the driver of the servos on the port."""
        models = dict(zip(self.ids, self.models, strict=True))
        return bus_of(self.model)(self.port, self.ids, self.port.now_ns, model=self.model, models=models, echo=echo)

    def ticks(self, q: Array) -> list[int]:
        """Return the goal registers of angles (n,) [rad]."""
        return [model.units.ticks(angle) for model, angle in zip(self.models, q.tolist(), strict=True)]

    def pass_time(self, seconds: float, q: Array | None = None, torque: Array | None = None) -> None:
        """Let the servos run with joints at q (n,) [rad] and torques (n,) [N m], both 0 by default."""
        zero = np.zeros(len(self.ids))
        self.now_ns = self.port.now_ns() + round(seconds * 1e9)
        self.emulator.advance(self.now_ns)
        self.servos.set_joint_state(zero if q is None else q, zero, zero if torque is None else torque, self.now_ns)
        self.command = self.servos.advance(seconds)
