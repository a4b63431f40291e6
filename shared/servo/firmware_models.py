"""The table of servo models that the firmware has, computed from `MODELS`.

    python -m sextant.shared.servo.firmware_models > shared/servo/firmware/models.py

writes the table; a test compares it.
"""

import sys

from sextant.shared.servo import dynamixel, dynamixel2, feetech, feetech_scs, lewansoul
from sextant.shared.servo.firmware import wire
from sextant.shared.servo.lx16a import READS, WRITES, Command
from sextant.shared.servo.models import MODELS
from sextant.shared.servo.servo_model import Block, Register, ServoModel, Sign

_PROTOCOLS = {dynamixel.NAME: 1, feetech.NAME: 1, dynamixel2.NAME: 2, lewansoul.NAME: 3, feetech_scs.NAME: 4}
_SCALE = 1 << 14
_COMPLEMENT = -1  # as in servo.py, which cannot be imported before the table exists
_HEAD = '''"""Servo models, computed from those of the host: see `sextant.shared.servo.firmware_models`."""

# ruff: noqa: E501
# fmt: off
'''


def supported() -> list[ServoModel]:
    """Return the models whose bus the firmware speaks."""
    return [model for model in MODELS if model.protocol.NAME in _PROTOCOLS]


def text() -> str:
    """Return the module `firmware/models.py`."""
    models = supported()
    layouts = list(dict.fromkeys(map(layout, models)))
    rows = "".join(f"    {found!r},\n" for found in layouts)
    names = "".join(f'    "{model.name}": {layouts.index(layout(model))},\n' for model in models)
    fields = "# Protocol, table size; errors; hardware errors; torque enable, torque limit, goals, state, adopted; units.\n"
    return f"{_HEAD}{fields}LAYOUTS = (\n{rows})\nMODELS = {{\n{names}}}\n"


def layout(model: ServoModel) -> tuple[object, ...]:
    """Return the registers and units of a model, as `firmware/servo.py` reads them."""
    if model.commands is not None:
        return _layout_of_commands(model)
    table, units, protocol = model.table, model.units, model.protocol
    state, goals = table.state, table.goals
    adopted = Block((table.torque_enable, table.goal_position, table.present_position))
    position = (table.present_position, units.position_sign)
    signs = (position, (table.present_speed, units.speed_sign), (table.present_load, units.load_sign))
    measured = (*signs, (table.present_voltage, None), (table.present_temperature, None))
    fields = tuple(_field(register, state, sign) for register, sign in measured)
    kept = ((table.torque_enable, None), (table.goal_position, None), position)
    limit = table.torque_limit
    return (
        _PROTOCOLS[protocol.NAME],
        table.size,
        _errors(model),
        _hardware_errors(model),
        table.torque_enable.address,
        (limit.address, limit.size, limit.max, _unit(units.torque, wire.LOAD)) if model.has(limit) else (0, 0, 0, 0),
        (
            goals.address,
            goals.size,
            (table.goal_position.address - goals.address, table.goal_position.size),
            (table.goal_speed.address - goals.address, table.goal_speed.size),
            table.goal_speed.max,
        ),
        (state.address, state.size, fields),
        (adopted.address, adopted.size, tuple(_field(register, adopted, sign) for register, sign in kept)),
        (
            units.centre,
            units.max_position,
            0,
            _unit(units.tick_rad, wire.ANGLE_RAD),
            _unit(units.speed_rad_s, wire.SPEED_RAD_S),
            _unit(units.load, wire.LOAD),
            _unit(units.volt, wire.VOLT),
        ),
    )


def _layout_of_commands(model: ServoModel) -> tuple[object, ...]:
    """Return the same of a model with commands, which are its addresses."""
    units, move, position = model.units, WRITES[Command.MOVE_TIME_WRITE], READS[Command.POS_READ]
    return (
        _PROTOCOLS[model.protocol.NAME],
        0,
        (0xFF, ()),
        (-1, (), 0),
        int(Command.LOAD_OR_UNLOAD_WRITE),
        (0, 0, 0, 0),
        (int(Command.MOVE_TIME_WRITE), move.struct.size, (0, 2), (2, 2), move.fields[1].max),
        (int(Command.POS_READ), position.struct.size, ((0, 2, _COMPLEMENT),)),
        (0, 0, ()),
        (
            units.centre,
            units.max_position,
            units.overrun,
            _unit(units.tick_rad, wire.ANGLE_RAD),
            _SCALE,  # a time [ms]
            _unit(wire.ANGLE_RAD * model.gain_stiffness, wire.LOAD),
            _unit(units.volt, wire.VOLT),
        ),
    )


def _unit(tick: float, unit: float) -> int:
    return round(tick / unit * _SCALE)


def _field(register: Register, block: Block, sign: Sign | None) -> tuple[int, int, int]:
    """Return offset and size of a register in a block, and its sign: a bit, 0 for none, or -1 for two's complement."""
    coding = 0 if sign is None else _COMPLEMENT if sign is Sign.COMPLEMENT else sign.largest(register.size) + 1
    return register.address - block.address, register.size, coding


def _errors(model: ServoModel) -> tuple[int, tuple[tuple[int, int], ...]]:
    """Return the bits that an answer's error may have, and what each of them means."""
    if model.protocol.ALERT:
        return model.protocol.ALERT, ()
    meanings = {1 << k: model.protocol.ERRORS[1 << k] for k in range(8)}
    known = sum(bit for bit, error in meanings.items() if not error & ~model.errors)
    return known, tuple((bit, int(error)) for bit, error in meanings.items() if error and bit & known)


def _hardware_errors(model: ServoModel) -> tuple[int, tuple[tuple[int, int], ...], int]:
    """Return the address of the hardware error register, the meaning of its bits, and the bit of an answer that tells of it."""
    register = model.table.hardware_error
    if register is None or not model.protocol.ALERT:
        return -1, (), 0
    meanings = {1 << k: int(model.hardware_errors(1 << k)) for k in range(8)}
    return register.address, tuple((bit, error) for bit, error in meanings.items() if error), model.protocol.ALERT


if __name__ == "__main__":
    sys.stdout.write(text())
