"""The firmware's table of servos, and its integer arithmetic in the units of the wire."""

from pathlib import Path

import pytest

from sextant.shared.servo import firmware, firmware_models, lewansoul, lx16a
from sextant.shared.servo.bridge_protocol import ANGLE_RAD, LOAD, SIGNED_MAX, SPEED_RAD_S, VOLT
from sextant.shared.servo.firmware import commands
from sextant.shared.servo.firmware.servo import ServoModel
from sextant.shared.servo.lx16a import Command
from sextant.shared.servo.models import HX_35H, LX_16A
from sextant.shared.servo.servo_model import ServoModel as HostModel
from sextant.shared.servo.servo_model import unsigned

EACH = pytest.mark.parametrize("model", firmware_models.supported(), ids=lambda model: model.name)
WITH_REGISTERS = pytest.mark.parametrize(
    "model", [model for model in firmware_models.supported() if model.commands is None], ids=lambda model: model.name
)
WITH_COMMANDS = pytest.mark.parametrize("model", [LX_16A, HX_35H], ids=lambda model: model.name)
SMALL = 1 << 30  # integers below do not need the heap of a board with 32 bits


def test_table_is_that_of_models() -> None:
    found = (Path(firmware.__file__).parent / "models.py").read_text(encoding="utf-8")
    assert found == firmware_models.text(), "python -m sextant.shared.servo.firmware_models > shared/servo/firmware/models.py"


@EACH
def test_each_goal_register_survives_the_wire(model: HostModel) -> None:
    ours, units, table = ServoModel(model.name), model.units, model.table
    at, size = table.goal_position.address - table.goals.address, table.goal_position.size
    for ticks in range(units.max_position + 1):
        angle = round(units.angle(ticks) / ANGLE_RAD)
        assert int.from_bytes(ours.goal(angle, 0)[at : at + size], table.goal_position.order) == ticks
        assert units.ticks(ours.angle(ticks) * ANGLE_RAD) == ticks
        assert abs((ticks - units.centre) * ours._angle_unit) < SMALL


@WITH_REGISTERS
def test_goal_speeds_round_trip_and_zero_is_no_limit(model: HostModel) -> None:
    ours, units, table = ServoModel(model.name), model.units, model.table
    at, size = table.goal_speed.address - table.goals.address, table.goal_speed.size
    for ticks in range(min(table.goal_speed.max, int(20.0 / units.speed_rad_s))):
        speed = round(ticks * units.speed_rad_s / SPEED_RAD_S)
        assert int.from_bytes(ours.goal(0, speed)[at : at + size], table.goal_speed.order) == ticks
    assert int.from_bytes(ours.goal(0, 1)[at : at + size], table.goal_speed.order) >= 1
    assert int.from_bytes(ours.goal(0, 32767)[at : at + size], table.goal_speed.order) <= table.goal_speed.max


@WITH_REGISTERS
def test_each_torque_limit_survives_the_wire(model: HostModel) -> None:
    ours, limit = ServoModel(model.name), model.table.torque_limit
    if not model.has(limit):
        assert ours.limit_size == 0
        return
    step = round(LOAD / model.units.torque - 1e-9) // 2  # [ticks] lost where a tick is finer than the wire
    for ticks in range(limit.max + 1):
        sent = int.from_bytes(ours.limit(round(ticks * model.units.torque / LOAD)), "little")
        assert abs(sent - ticks) <= step


@WITH_REGISTERS
def test_state_has_signs_and_units_of_the_registers(model: HostModel) -> None:
    ours, units, table = ServoModel(model.name), model.units, model.table
    for speed, load in ((0, 0), (100, -200), (-100, 200), (-300, -300)):
        data = bytearray(table.state.size)
        values = (
            units.centre + 77,
            unsigned(speed, units.speed_sign, table.present_speed.size),
            unsigned(load, units.load_sign, table.present_load.size),
            123,
            45,
        )
        for register, value in zip(table.measured, values, strict=True):
            at = register.address - table.state.address
            data[at : at + register.size] = value.to_bytes(register.size, register.order)
        found = ours.state(bytes(data))
        expected = (77 * units.tick_rad / ANGLE_RAD, speed * units.speed_rad_s / SPEED_RAD_S, load * units.load / LOAD)
        assert found is not None
        assert found[:3] == pytest.approx(expected, abs=0.6)
        assert found[3:] == (123, 45)


@WITH_COMMANDS
def test_units_of_servos_with_commands(model: HostModel) -> None:
    ours, units = ServoModel(model.name), model.units
    for ticks in range(-units.overrun, units.max_position + units.overrun + 1):
        angle = ours.position(ticks.to_bytes(2, "little", signed=True))
        assert angle is not None
        assert units.ticks(angle * ANGLE_RAD) == ticks
    for ticks in (-units.overrun - 1, units.max_position + units.overrun + 1):
        assert ours.position(ticks.to_bytes(2, "little", signed=True)) is None
    assert ours.voltage(7400) == pytest.approx(7.4 / VOLT, abs=0.5)
    assert ours.spring_load(-500) * LOAD == pytest.approx(-model.gain_stiffness * 500 * ANGLE_RAD, abs=LOAD)
    assert ours.spring_load(2 * 26_180) <= SIGNED_MAX, "from one end to the other"
    for ms in (0, 1, 20, 30_000):
        assert ours.goal(0, ms) == bytes((500 & 0xFF, 500 >> 8)) + ms.to_bytes(2, "little")
    assert ours.goal(0, 40_000)[2:] == (30_000).to_bytes(2, "little")


def test_commands_of_firmware_match_host() -> None:
    kinds = (Command.LOAD_OR_UNLOAD_READ, Command.MOVE_TIME_READ, Command.POS_READ, Command.VIN_READ, Command.TEMP_READ)
    read = {(int(command), lx16a.READS[command].struct.size) for command in kinds}
    assert set(commands._BLOCKS.values()) == read
    assert commands._MOVES == (Command.MOVE_TIME_WRITE, Command.MOVE_TIME_WAIT_WRITE)
    assert commands._MODE == Command.MODE_WRITE
    assert lewansoul.TABLE.goal_time.max == commands._MAX_MS  # type: ignore[union-attr]


def test_impossible_state_is_refused() -> None:
    ours = ServoModel("AX-12A")
    assert ours.state(bytes((0xFF, 0x03, 0, 0, 0, 0, 120, 30))) is not None
    assert ours.state(bytes((0x00, 0x04, 0, 0, 0, 0, 120, 30))) is None, "position"
    assert ours.state(bytes((0x00, 0x02, 0, 0x08, 0, 0, 120, 30))) is None, "speed beyond its sign"


def test_unknown_servo_is_refused_with_known_ones() -> None:
    with pytest.raises(ValueError, match=r"one of the servos \['AX-12A', .* expected, found AX-13"):
        ServoModel("AX-13")
