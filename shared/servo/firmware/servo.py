"""Registers of one servo model, and the conversion of their values to the units of the wire.

All numbers are integers, because boards have floats of single precision or none.
"""

import struct

from .models import LAYOUTS, MODELS
from .packets import LewanSoul, Protocol1, Protocol2
from .wire import SIGNED_MAX

SCALE_BITS = 14  # a unit is a whole number of 2^-14 wire units: products then fit the 31 bits of MicroPython's small integers
_ONE = 1 << SCALE_BITS
_HALF = _ONE >> 1
_COMPLEMENT = -1  # coding of negative numbers; otherwise 0 for none, or the bit of the sign
_IMPOSSIBLE = 0x3FFF_FFFF  # [ticks]
_CODES = {1: "B", 2: "H", 4: "I"}
_PROTOCOLS = {1: Protocol1, 2: Protocol2, 3: LewanSoul, 4: Protocol1}
_HIGH_BYTE_FIRST = 4  # protocol of Feetech SCS servos


def to_wire(value: int, unit: int) -> int:
    """Return a number of ticks in wire units, rounded."""
    return (value * unit + _HALF) >> SCALE_BITS


def to_ticks(value: int, unit: int) -> int:
    """Return a number of wire units in ticks, rounded."""
    return (value * _ONE + (unit >> 1)) // unit


class ServoModel:
    """One model of the table in models.py."""

    def __init__(self, name: str):
        """Find a model.

        Raises:
            ValueError: The table has no such model.
        """
        if name not in MODELS:
            raise ValueError(f"one of the servos {sorted(MODELS)} expected, found {name}")
        self.name = name
        self._errors: tuple
        self._hardware_errors: tuple
        protocol, self.size, errors, hardware, torque, limit, goals, state, adopted, units = LAYOUTS[MODELS[name]]
        self.protocol = _PROTOCOLS[protocol]()
        self.has_commands = protocol == 3  # instead of registers: each value has its own request
        self.known_errors, self._errors = errors  # bits of an answer's error, and the errors that they mean
        self.hardware_address, self._hardware_errors, self.alert = hardware
        self.torque_enable = torque
        self.limit_address, self.limit_size, self._limit_max, self._limit_unit = limit
        self.goals_address, self.goals_size, self._goal, self._speed, self._max_speed = goals
        self.state_address, self.state_size, measured = state
        self.adopted_address, self.adopted_size, kept = adopted
        self._order = "big" if protocol == _HIGH_BYTE_FIRST else "little"
        self._state, self._adopted = _Block(measured, self._order), _Block(kept, self._order)
        self._centre, self._max_position, self._overrun, self._angle_unit = units[:4]
        self._speed_unit, self._load_unit, self._volt_unit = units[4:]

    def errors(self, code: int) -> int:
        """Return the errors that an answer reports."""
        return _meaning(code, self._errors) if code else 0

    def hardware_errors(self, value: int) -> int:
        """Return the errors in the hardware error register."""
        return _meaning(value, self._hardware_errors)

    def angle(self, ticks: int) -> int:
        """Return the angle [0.1 mrad] of a position register."""
        return to_wire(ticks - self._centre, self._angle_unit)

    def state(self, data: bytes) -> tuple | None:
        """Return position, speed, load, voltage and temperature in wire units; None if no servo has such values."""
        position, speed, load, voltage, temperature = self._state.unpack(data)
        if not 0 <= position <= self._max_position:
            return None
        position = self.angle(position)
        speed = to_wire(speed, self._speed_unit)
        load = to_wire(load, self._load_unit)
        voltage = self.voltage(voltage)
        if max(abs(position), abs(speed), abs(load)) > SIGNED_MAX or voltage > 0xFF:
            return None
        return position, speed, load, voltage, temperature

    def position(self, data: bytes) -> int | None:
        """Return the angle [0.1 mrad] in the answer of a servo with commands; None if no servo has it."""
        (ticks,) = self._state.unpack(data)
        return self.angle(ticks) if -self._overrun <= ticks <= self._max_position + self._overrun else None

    def voltage(self, ticks: int) -> int:
        """Return the voltage [0.1 V] in a register."""
        return to_wire(ticks, self._volt_unit)

    def spring_load(self, error: int) -> int:
        """Return the load [0.1 %] of a position controller by its error [0.1 mrad], of servos with commands."""
        return to_wire(error, self._load_unit)

    def adopted(self, data: bytes) -> tuple:
        """Return torque enable, and the angles of goal and position [0.1 mrad]; None for a position that no servo has."""
        torque, goal, position = self._adopted.unpack(data)
        if not 0 <= position <= self._max_position:
            return bool(torque), None, None
        return bool(torque), self.angle(min(max(goal, 0), self._max_position)), self.angle(position)

    def goal(self, angle: int, speed: int) -> bytes:
        """Encode goal position and speed of an angle [0.1 mrad] and a speed [1 mrad/s], which is 0 for no limit.

        Servos with commands have a time [ms] in place of the speed.
        """
        row = bytearray(self.goals_size)
        ticks = min(max(to_ticks(angle, self._angle_unit) + self._centre, 0), self._max_position)
        at, size = self._goal
        row[at : at + size] = ticks.to_bytes(size, self._order)  # type: ignore[arg-type]
        at, size = self._speed
        ticks = min(max(to_ticks(speed, self._speed_unit), 1), self._max_speed) if speed else 0
        row[at : at + size] = ticks.to_bytes(size, self._order)  # type: ignore[arg-type]
        return bytes(row)

    def limit(self, share: int) -> bytes:
        """Encode the torque limit of a share [0.1 %] of the stall torque."""
        return min(to_ticks(share, self._limit_unit), self._limit_max).to_bytes(self.limit_size, self._order)  # type: ignore[arg-type]


def _meaning(code: int, errors: tuple) -> int:
    found = 0
    for bit, meaning in errors:
        if code & bit:
            found |= meaning
    return found


class _Block:
    """Registers of one answer, by their offsets, sizes and codings of negative numbers.

    A number with bits beyond its sign is unpacked as one that is larger than any that a servo has.
    """

    def __init__(self, fields: tuple, order: str):
        by_offset = sorted(range(len(fields)), key=lambda k: fields[k][0])
        form, end = ">" if order == "big" else "<", 0
        for k in by_offset:
            at, size, sign = fields[k]
            code = _CODES[size]
            form += "x" * (at - end) + (code.lower() if sign == _COMPLEMENT else code)
            end = at + size
        self._form = form
        self._order = [by_offset.index(k) for k in range(len(fields))]
        self._signs = [(k, field[2]) for k, field in enumerate(fields) if field[2] > 0]

    def unpack(self, data: bytes) -> list[int]:
        """Return the numbers, in the order of the fields."""
        raw = struct.unpack(self._form, data)
        numbers = [raw[k] for k in self._order]
        for k, sign in self._signs:
            value = numbers[k]
            if value >= sign:
                numbers[k] = sign - value if value < 2 * sign else _IMPOSSIBLE
        return numbers
