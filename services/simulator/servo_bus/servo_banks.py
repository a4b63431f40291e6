"""Emulated servos of a robot with several models or several buses: one bank of each model on each bus, on one supply."""

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sextant.services.simulator.servo_bus.servo_bank import Array, ServoBank, ServoCommand, ServoVariation, make_servo_bank
from sextant.services.simulator.servo_bus.servo_faults import ServoFaults
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.servo.servo_model import Register, ServoModel

Rows = NDArray[np.int64]


class ServoBanks:
    """Several banks as one, with the interface of `ServoBank`."""

    def __init__(self, banks: Sequence[ServoBank], rows: Sequence[Sequence[int]]) -> None:
        """Join banks; `rows` are those that the servos of each bank have here."""
        self._banks = tuple(banks)
        self._rows: list[Rows] = [np.array(of_bank, dtype=np.int64) for of_bank in rows]
        places = {row: (bank, k) for bank, of_bank in zip(banks, rows, strict=True) for k, row in enumerate(of_bank)}
        self._places = [places[row] for row in range(len(places))]
        self.model, self.table = banks[0].model, banks[0].table
        n = len(self._places)
        self._out = ServoCommand(np.zeros(n), np.zeros(n), np.zeros(n))

    def __len__(self) -> int:
        """Number of servos."""
        return len(self._places)

    # --------------------------------------------------------------------------------------- methods for the bus

    def model_of(self, row: int) -> ServoModel:
        """Return the model of a servo."""
        return self._places[row][0].model

    def read(self, row: int, address: int, size: int, at_ns: int | None = None) -> bytes:
        """Return bytes of one servo's control table, see `ServoBank.read`."""
        bank, row = self._places[row]
        return bank.read(row, address, size, at_ns)

    def write(self, row: int, address: int, data: bytes) -> None:
        """Write to one servo's control table, see `ServoBank.write`."""
        bank, row = self._places[row]
        bank.write(row, address, data)

    def error(self, row: int) -> int:
        """Return the error bits of one servo's state."""
        bank, row = self._places[row]
        return bank.error(row)

    def power_up(self, row: int) -> None:
        """Reset the RAM registers of a servo to factory values."""
        bank, row = self._places[row]
        bank.power_up(row)

    def column(self, register: Register) -> NDArray[np.unsignedinteger]:
        """Return one register (n,) of all servos, which must have it; a copy."""
        return np.asarray(self._joined([bank.column(register) for bank in self._banks]))

    def set_faults(self, faults: ServoFaults | None) -> None:
        """Set the active faults, see `ServoBank.set_faults`."""
        for bank, rows in zip(self._banks, self._rows, strict=True):
            bank.set_faults(None if faults is None else _of_rows(faults, rows))

    # ----------------------------------------------------------------------------------- methods for the physics

    def set_joint_state(self, q: Array, qd: Array, torque: Array, at_ns: int | None = None) -> None:
        """Set the joint angles, speeds and torques that the servos measure."""
        for bank, rows in zip(self._banks, self._rows, strict=True):
            bank.set_joint_state(q[rows], qd[rows], torque[rows], at_ns)

    def step(self, q: Array, qd: Array, torque: Array, dt: float) -> ServoCommand:
        """Advance the servos by one physics step, see `ServoBank.step`."""
        self.set_joint_state(q, qd, torque)
        return self.advance(dt)

    def advance(self, dt: float) -> ServoCommand:
        """Advance the servos by one physics step, and share their supply."""
        drawn = [bank.servo_current for bank in self._banks]
        for bank, rows, own in zip(self._banks, self._rows, drawn, strict=True):
            bank.other_current = sum(drawn) - own
            command = bank.advance(dt)
            for whole, part in zip(
                (self._out.setpoint, self._out.stiffness, self._out.torque_limit),
                (command.setpoint, command.stiffness, command.torque_limit),
                strict=True,
            ):
                whole[rows] = part
        return self._out

    @property
    def charge(self) -> float:
        """Charge of the battery, 0 to 1."""
        return self._banks[0].charge

    @charge.setter
    def charge(self, charge: float) -> None:
        for bank in self._banks:
            bank.charge = charge

    @property
    def voltage(self) -> float:
        """Voltage [V] at the servos."""
        return self._banks[0].voltage

    @property
    def temperature(self) -> Array:
        """Temperatures (n,) [deg C]; a copy."""
        return self._joined([bank.temperature for bank in self._banks])

    @property
    def slipped(self) -> Array:
        """Angles (n,) [rad] by which encoders are ahead of their links; a copy."""
        return self._joined([bank.slipped for bank in self._banks])

    @property
    def shutdown(self) -> NDArray[np.bool_]:
        """Servos (n,) that have latched an overload or overheating error."""
        return np.asarray(self._joined([bank.shutdown for bank in self._banks]))

    def _joined(self, parts: Sequence[NDArray[np.generic]]) -> NDArray[np.float64]:
        whole = np.zeros(len(self), dtype=np.result_type(*parts))
        for rows, part in zip(self._rows, parts, strict=True):
            whole[rows] = part
        return whole


def _of_rows(faults: ServoFaults, rows: Rows) -> ServoFaults:
    """Return the faults of some rows, and those of the supply."""
    values = {field.name: getattr(faults, field.name) for field in dataclasses.fields(faults)}
    of_rows: dict[str, Any] = {name: value[rows] for name, value in values.items() if isinstance(value, np.ndarray)}
    return dataclasses.replace(faults, **of_rows)


AnyBank = ServoBank | ServoBanks


class RobotServos(NamedTuple):
    """Servos of a robot, all of them and those on each of its buses."""

    all: AnyBank
    on_bus: tuple[AnyBank, ...]  # in the order of `JointServos.buses`


def make_robot_servos(
    profile: RobotProfile,
    q: Array,
    battery_ah: float,
    battery_resistance: float,
    variation: ServoVariation,
) -> RobotServos:
    """Create the servos of a robot at joint angles q (18,) [rad] in servo coordinates; see `make_servo_bank`."""
    ids, servos = list(profile.servo_names), profile.servos
    if len(servos.buses) == 1 and not profile.servo_groups:
        bank = make_servo_bank(profile.servo, ids, q, battery_ah, battery_resistance, variation, battery=profile.battery)
        return RobotServos(bank, (bank,))
    banks: list[ServoBank] = []
    of_bank: list[list[int]] = []
    on_bus: list[AnyBank] = []
    for bus in servos.buses:
        first, alike = len(banks), {servos.each[row]: list[int]() for row in bus.rows}
        for row in bus.rows:
            alike[servos.each[row]].append(row)
        for servo, rows in alike.items():
            part = ServoVariation(variation.stiffness[rows], variation.torque[rows], variation.backlash[rows])
            of_servo = [ids[row] for row in rows]
            bank = make_servo_bank(
                servo, of_servo, q[rows], battery_ah, battery_resistance, part, profile.servo, profile.battery
            )
            banks.append(bank)
            of_bank.append(rows)
        on_bus.append(ServoBanks(banks[first:], [list(map(bus.rows.index, rows)) for rows in of_bank[first:]]))
    return RobotServos(ServoBanks(banks, of_bank), tuple(on_bus))
