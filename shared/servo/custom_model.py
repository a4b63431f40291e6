"""Servo models that a profile states by numbers: those of a known model, with what differs.

A servo whose registers and packets are like those of a known model needs no code.
"""

import dataclasses
import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from types import MappingProxyType
from typing import Any

from sextant.shared.files import config
from sextant.shared.servo.models import MODEL_NAMED, MODELS
from sextant.shared.servo.servo_model import ControlTable, Register, ServoModel

ROLES = tuple(
    sorted({name for model in MODELS for name in vars(model.table) if isinstance(getattr(model.table, name), Register)})
)
_AS_LIKE = -1  # a number that is not stated
_POSITIONS = ("goal_position", "low_limit", "high_limit")  # roles whose values are positions


@dataclass(frozen=True, slots=True)
class RegisterNumbers:
    """Register that differs from that of the known model; -1 stands for the number of that model."""

    role: str  # such as goal_position; one of the roles of `sextant.shared.servo.servo_model.ControlTable`
    address: int = _AS_LIKE  # of its first byte
    size: int = _AS_LIKE  # [bytes] 1, 2 or 4
    default: int = _AS_LIKE  # value after a factory reset
    min: int = _AS_LIKE  # lowest value that may be written
    max: int = _AS_LIKE  # highest value that may be written

    checks = (
        *config.each("role", lambda role: role in ROLES, f"one of {', '.join(ROLES)}"),
        *config.each("address", lambda address: -1 <= address <= 1023, "an address from 0 to 1023"),
        *config.each("size", lambda size: size in (-1, 1, 2, 4), "1, 2 or 4 bytes"),
        *config.each("default min max", lambda value: -1 <= value < 1 << 32, "a value from 0 to 4294967295"),
    )

    def __post_init__(self) -> None:
        config.verify(self)

    def stated(self) -> dict[str, Any]:
        """Return the numbers that are stated."""
        names = [field.name for field in dataclasses.fields(self) if field.name != "role"]
        return {name: value for name in names if (value := getattr(self, name)) != _AS_LIKE}


def _does_not_fit(like: str, registers: tuple[RegisterNumbers, ...]) -> Iterator[config.Misfit]:
    """Yield registers that the known model does not have, that overlap others, or that do not hold their values."""
    if like not in MODEL_NAMED or not all(isinstance(numbers, RegisterNumbers) for numbers in registers):
        return
    table = MODEL_NAMED[like].table
    for k, numbers in enumerate(registers):
        base = getattr(table, numbers.role, None)
        if base is None:
            yield config.Misfit(f"registers[{k}].role", f"a role that {like} has", repr(numbers.role))
            continue
        new = _changed(base, numbers)
        if not 0 <= new.min <= new.default <= new.max < 1 << 8 * new.size:
            expected = f"min <= default <= max, within {new.size} bytes,"
            yield config.Misfit(f"registers[{k}]", expected, f"{new.min}, {new.default} and {new.max}")
    roles = [numbers.role for numbers in registers]
    for k, role in enumerate(roles):
        if role in roles[:k]:
            yield config.Misfit(f"registers[{k}].role", "each role once", repr(role))
    if not any(getattr(table, role, None) is None for role in roles) and len(set(roles)) == len(roles):
        yield from _overlaps(_with_registers(table, registers))


def _overlaps(table: ControlTable) -> Iterator[config.Misfit]:
    """Yield registers of a table at the same addresses, and a RAM that begins before the end of the EEPROM."""
    ordered = sorted(table.registers, key=lambda register: register.address)
    for one, other in itertools.pairwise(ordered):
        if other.address < one.address + one.size:
            expected = f"registers with addresses of their own: {one.name} ends at {one.address + one.size - 1},"
            yield config.Misfit("registers", expected, f"{other.name} at {other.address}")
    if table.ram.start < table.eeprom.stop:
        expected = f"registers that are lost without power behind the EEPROM, which ends at {table.eeprom.stop - 1},"
        yield config.Misfit("registers", expected, f"address {table.ram.start}")


@dataclass(frozen=True, slots=True)
class ModelNumbers:
    """Servo model by its numbers; 0 stands for the number of the known model."""

    like: str  # known model with the same packets, from which all other numbers are taken
    number: int  # value of the model number register
    no_load_rpm: float  # [rpm] in joint mode, at the highest voltage of its data sheet
    stall_current: float = 0.0  # [A] at the stall torque; only the simulated battery uses it
    positions: int = 0  # number of positions in the range, such as 1024 or 4096
    range_deg: float = 0.0  # [deg] range of these positions, such as 300 or 360
    speed_rpm: float = 0.0  # [rpm] per unit of goal and present speed
    load: float = 0.0  # [1] share of the stall torque per unit of the load register
    volt: float = 0.0  # [V] per unit of the voltage register
    full_torque_deg: float = 0.0  # [deg] position error with full torque, at the factory's position gain
    registers: tuple[RegisterNumbers, ...] = ()  # that differ

    checks = (
        *config.each("like", lambda name: name in MODEL_NAMED, f"one of {', '.join(MODEL_NAMED)}"),
        *config.each("number", lambda number: 0 < number <= 0xFFFF, "a model number from 1 to 65535"),
        *config.each("no_load_rpm", lambda rpm: 0 < rpm <= 10_000, "more than 0 and at most 10000 rpm"),
        *config.each("stall_current", lambda current: 0 <= current <= 100, "a current from 0 to 100 A"),
        *config.each("positions", lambda count: count == 0 or 256 <= count <= 65_536, "256 to 65536 positions"),
        *config.each("range_deg", lambda angle: angle == 0 or 30 <= angle <= 360, "a range from 30 to 360 deg"),
        *config.each("speed_rpm load volt", lambda unit: 0 <= unit <= 10, "a unit from 0 to 10"),
        *config.each("full_torque_deg", lambda angle: 0 <= angle <= 180, "an angle from 0 to 180 deg"),
        config.Check(("like", "registers"), _does_not_fit),
    )

    def __post_init__(self) -> None:
        config.verify(self)


@lru_cache(maxsize=64)
def custom_model(name: str, numbers: ModelNumbers) -> ServoModel:
    """Return the servo model with these numbers."""
    base = MODEL_NAMED[numbers.like]
    positions = numbers.positions or base.units.max_position + 1
    range_rad = math.radians(numbers.range_deg) if numbers.range_deg else base.units.tick_rad * (base.units.max_position + 1)
    units = replace(
        base.units,
        centre=positions // 2,
        max_position=positions - 1,
        tick_rad=range_rad / positions,
        speed_rad_s=numbers.speed_rpm * 2.0 * math.pi / 60.0 or base.units.speed_rad_s,
        load=numbers.load or base.units.load,
        volt=numbers.volt or base.units.volt,
    )
    if base.limits_current:  # a current like the load
        units = replace(units, torque=units.load)
    table = _with_positions(base.table, positions) if numbers.positions else base.table
    table = _with_registers(table, numbers.registers)
    stated = {getattr(base.table, one.role).name for one in numbers.registers if one.default != _AS_LIKE}
    if numbers.positions:
        stated |= {getattr(base.table, role).name for role in _POSITIONS}
    model = replace(
        base,
        name=name,
        number=numbers.number,
        table=table,
        units=units,
        no_load_rpm=numbers.no_load_rpm,
        overrides=MappingProxyType({key: value for key, value in base.overrides.items() if key not in stated}),
        gain_stiffness=base.gain_stiffness * (units.torque / base.units.torque),
    )
    gain = table.position_gain
    if numbers.full_torque_deg and gain is not None:
        model = replace(model, gain_stiffness=1.0 / (math.radians(numbers.full_torque_deg) * max(model.default(gain), 1)))
    return model


def _changed(base: Register, numbers: RegisterNumbers) -> Register:
    return replace(base, **numbers.stated())


def _with_positions(table: ControlTable, positions: int) -> ControlTable:
    """Return a table whose positions go from 0 to `positions` - 1."""
    last = positions - 1
    defaults = {"goal_position": positions // 2, "low_limit": 0, "high_limit": last}
    return _replaced(table, {role: replace(getattr(table, role), default=defaults[role], max=last) for role in _POSITIONS})


def _with_registers(table: ControlTable, registers: tuple[RegisterNumbers, ...]) -> ControlTable:
    return _replaced(table, {one.role: _changed(getattr(table, one.role), one) for one in registers})


def _replaced(table: ControlTable, changed: dict[str, Register]) -> ControlTable:
    """Return a table with other registers for some roles."""
    if not changed:
        return table
    new = {getattr(table, role): register for role, register in changed.items()}
    registers = tuple(new.get(register, register) for register in table.registers)
    ends = {register: register.address + register.size for register in registers}
    ram = {register.address: ends[register] for register in registers if not register.eeprom}
    eeprom_end = max(table.eeprom.stop, *(end for register, end in ends.items() if register.eeprom))
    fields: dict[str, Any] = dict(changed)
    return replace(
        table,
        registers=registers,
        size=max(table.size, *ends.values()),
        eeprom=range(table.eeprom.start, eeprom_end),
        ram=range(min(table.ram.start, *ram), max(table.ram.stop, *ram.values())),
        **fields,
    )
