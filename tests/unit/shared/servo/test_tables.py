"""Rows of the makers' tables, in numbers, since driver and emulator share one table.

Sources: ROBOTIS e-manual, pages MX-28, XL-320, XL430-W250 and XM430-W350; Feetech's memory table of the STS series.
"""

import pytest

from sextant.shared.servo import dynamixel2, feetech
from sextant.shared.servo.models import MODEL_NAMED
from sextant.shared.servo.servo_model import Kind, ServoError, signed

# role in the table: address, size, factory value
X430 = {
    "model_number": (0, 2), "id": (7, 1, 1), "baud_rate": (8, 1, 1), "return_delay": (9, 1, 250),
    "max_torque": (36, 2, 885), "high_limit": (48, 4, 4095), "low_limit": (52, 4, 0), "shutdown": (63, 1, 52),
    "torque_enable": (64, 1, 0), "status_return_level": (68, 1, 2), "hardware_error": (70, 1), "position_gain": (84, 2),
    "torque_limit": (100, 2, 885), "goal_speed": (112, 4, 0), "goal_position": (116, 4), "moving": (122, 1),
    "present_load": (126, 2), "present_speed": (128, 4), "present_position": (132, 4), "present_voltage": (144, 2),
    "present_temperature": (146, 1),
}  # fmt: skip
STS = {
    "model_number": (3, 2), "id": (5, 1, 1), "baud_rate": (6, 1, 0), "status_return_level": (8, 1, 1), "low_limit": (9, 2, 0),
    "high_limit": (11, 2, 4095), "temperature_limit": (13, 1, 70), "max_torque": (16, 2, 1000), "shutdown": (19, 1, 44),
    "position_gain": (21, 1, 32), "torque_enable": (40, 1, 0), "goal_position": (42, 2), "goal_speed": (46, 2),
    "torque_limit": (48, 2, 1000), "lock": (55, 1, 1), "present_position": (56, 2), "present_speed": (58, 2),
    "present_load": (60, 2), "present_voltage": (62, 1), "present_temperature": (63, 1), "moving": (66, 1),
}  # fmt: skip
MX = {
    "id": (3, 1, 1), "high_limit": (8, 2, 4095), "position_gain": (28, 1, 32), "goal_position": (30, 2), "goal_speed": (32, 2),
    "torque_limit": (34, 2), "present_position": (36, 2), "present_load": (40, 2), "lock": (47, 1, 0),
}  # fmt: skip
XL320 = {
    "model_number": (0, 2, 350), "id": (3, 1, 1), "baud_rate": (4, 1, 3), "return_delay": (5, 1, 250), "low_limit": (6, 2, 0),
    "high_limit": (8, 2, 1023), "temperature_limit": (12, 1, 65), "min_voltage": (13, 1, 60), "max_voltage": (14, 1, 90),
    "max_torque": (15, 2, 1023), "status_return_level": (17, 1, 2), "shutdown": (18, 1, 3), "torque_enable": (24, 1, 0),
    "position_gain": (29, 1, 32), "goal_position": (30, 2), "goal_speed": (32, 2), "torque_limit": (35, 2),
    "present_position": (37, 2), "present_speed": (39, 2), "present_load": (41, 2), "present_voltage": (45, 1),
    "present_temperature": (46, 1), "registered": (47, 1), "moving": (49, 1), "hardware_error": (50, 1),
}  # fmt: skip


@pytest.mark.parametrize(
    ("name", "rows"), [("XL-320", XL320), ("XL430-W250", X430), ("XM430-W350", X430), ("STS3215", STS), ("MX-28", MX)]
)
def test_rows_of_the_manual(name: str, rows: dict[str, tuple[int, ...]]) -> None:
    model = MODEL_NAMED[name]
    for role, row in rows.items():
        register = getattr(model.table, role)
        assert (register.address, register.size, *(model.default(register) for _ in row[2:])) == row, role


@pytest.mark.parametrize(
    ("name", "number", "tick_deg", "rpm_per_tick"),
    [
        ("MX-28", 29, 0.088, 0.114), ("XL430-W250", 1060, 0.088, 0.229), ("XM430-W350", 1020, 0.088, 0.229),
        ("STS3215", 777, 0.088, 0.732 / 50), ("XL-320", 350, 0.29, 0.111), ("AX-12A", 12, 0.29, 0.111),
    ],
)  # fmt: skip
def test_units_of_the_manual(name: str, number: int, tick_deg: float, rpm_per_tick: float) -> None:
    model = MODEL_NAMED[name]
    assert model.number == number
    assert model.units.tick_rad * 57.29578 == pytest.approx(tick_deg, rel=0.02)
    assert model.units.speed_rad_s * 9.549297 == pytest.approx(rpm_per_tick, rel=0.002)
    assert model.units.angle(model.units.centre) == 0.0


def test_numbers_with_a_sign() -> None:
    x, sts = MODEL_NAMED["XL430-W250"].units, MODEL_NAMED["STS3215"].units
    assert signed(0xFFFF_FFFF, x.speed_sign, 4) == -1
    assert signed(0xFF9C, x.load_sign, 2) == -100
    assert signed(0x8064, sts.speed_sign, 2) == -100
    assert signed(0x0464, sts.load_sign, 2) == -100  # bit 10
    assert signed(0x0064, sts.load_sign, 2) == 100


def test_bytes_of_the_feetech_bus() -> None:
    assert feetech.ping(1) == bytes.fromhex("ff ff 01 02 01 fb")
    assert feetech.read(1, 56, 2) == bytes.fromhex("ff ff 01 04 02 38 02 be")
    assert feetech.write(1, 5, b"\x02") == bytes.fromhex("ff ff 01 04 03 05 02 f0")
    assert feetech.sync_read(56, 8, [1, 2]) == bytes.fromhex("ff ff fe 06 82 38 08 01 02 36")
    (packet,) = feetech.instruction_parser().feed(feetech.sync_read(56, 8, [1, 2]))
    request = feetech.request(packet)
    assert request is not None
    assert (request.kind, request.address, request.size, [i for i, _ in request.rows]) == (Kind.SYNC_READ, 56, 8, [1, 2])
    assert feetech.ERRORS[0x24] == ServoError.OVERHEATING | ServoError.OVERLOAD
    assert feetech.error_code(0, int(ServoError.OVERLOAD)) == 0x20


def test_hardware_error_bits_of_the_x_series() -> None:
    model = MODEL_NAMED["XL430-W250"]
    assert model.hardware_errors(0x01) == ServoError.INPUT_VOLTAGE
    assert model.hardware_errors(0x24) == ServoError.OVERHEATING | ServoError.OVERLOAD
    assert model.hardware_errors(0x10) == ServoError.HARDWARE
    assert dynamixel2.ALERT == 0x80


def test_error_bits_of_the_xl_320() -> None:
    model = MODEL_NAMED["XL-320"]
    assert model.hardware_errors(0x03) == ServoError.OVERLOAD | ServoError.OVERHEATING
    assert model.hardware_errors(0x04) == ServoError.INPUT_VOLTAGE
    assert model.hardware_error_code(ServoError.OVERLOAD | ServoError.INPUT_VOLTAGE) == 0x05
