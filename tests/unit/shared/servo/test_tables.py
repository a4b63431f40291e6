"""Rows of the makers' tables, in numbers, since driver and emulator share one table.

Sources: ROBOTIS e-manual, https://emanual.robotis.com/docs/en/dxl/ and the page of the model: ax/ax-12a, ax/ax-18a, ax/ax-12w,
rx/rx-28, rx/rx-64, mx/mx-28, mx/mx-64, x/xl320, x/xl430-w250, x/xc430-w150, x/xc430-w240, x/xm430-w350, x/xm540-w270.
Feetech's memory tables of the STS series and of the SCS series (FD1.9.8); model numbers of both in
https://github.com/huggingface/lerobot/blob/main/src/lerobot/motors/feetech/tables.py.
"""

from collections.abc import Mapping
from random import Random

import pytest

from sextant.shared.servo import dynamixel2, feetech, feetech_scs
from sextant.shared.servo.models import MODEL_NAMED
from sextant.shared.servo.servo_model import Access, Kind, ServoError, signed

# role in the table: address, size, factory value
X430 = {
    "model_number": (0, 2), "id": (7, 1, 1), "baud_rate": (8, 1, 1), "return_delay": (9, 1, 250),
    "high_limit": (48, 4, 4095), "low_limit": (52, 4, 0), "shutdown": (63, 1, 52),
    "torque_enable": (64, 1, 0), "status_return_level": (68, 1, 2), "hardware_error": (70, 1), "position_gain": (84, 2),
    "goal_speed": (112, 4, 0), "goal_position": (116, 4), "moving": (122, 1),
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


PWM_LIMITED = {"max_torque": (36, 2, 885), "torque_limit": (100, 2, 885)}
CURRENT_LIMITED = {"operating_mode": (11, 1, 3), "max_torque": (38, 2, 1193), "torque_limit": (102, 2)}


@pytest.mark.parametrize(
    ("name", "rows"),
    [
        ("XL-320", XL320), ("XL430-W250", X430 | PWM_LIMITED), ("XC430-W150", X430 | PWM_LIMITED),
        ("XC430-W240", X430 | PWM_LIMITED), ("XM430-W350", X430 | CURRENT_LIMITED),
        ("XM540-W270", X430 | CURRENT_LIMITED | {"max_torque": (38, 2, 2047)}), ("STS3215", STS), ("MX-28", MX), ("MX-64", MX),
    ],
)  # fmt: skip
def test_rows_of_the_manual(name: str, rows: dict[str, tuple[int, ...]]) -> None:
    model = MODEL_NAMED[name]
    for role, row in rows.items():
        register = getattr(model.table, role)
        assert (register.address, register.size, *(model.default(register) for _ in row[2:])) == row, role


SCS: Mapping[str, tuple[int, ...]] = {
    "model_number": (3, 2, 1284), "id": (5, 1, 1), "baud_rate": (6, 1, 0), "return_delay": (7, 1, 0),
    "status_return_level": (8, 1, 1), "low_limit": (9, 2, 20), "high_limit": (11, 2, 1003), "temperature_limit": (13, 1, 80),
    "max_voltage": (14, 1, 90), "min_voltage": (15, 1, 45), "max_torque": (16, 2, 1000), "shutdown": (19, 1, 36),
    "position_gain": (21, 1, 15), "torque_enable": (40, 1, 0), "goal_position": (42, 2), "goal_speed": (46, 2, 0),
    "lock": (48, 1, 0), "present_position": (56, 2), "present_speed": (58, 2), "present_load": (60, 2),
    "present_voltage": (62, 1), "present_temperature": (63, 1), "registered": (64, 1), "moving": (66, 1),
}  # fmt: skip


def test_rows_of_the_scs_series() -> None:
    model = MODEL_NAMED["SCS0009"]
    for role, row in SCS.items():
        register = getattr(model.table, role)
        assert (register.address, register.size, *(model.default(register) for _ in row[2:])) == row, role
        assert register.size == 1 or register.order == "big", role
    assert not model.has(model.table.torque_limit)


@pytest.mark.parametrize("name", sorted(MODEL_NAMED))
def test_numbers_of_a_table_have_one_byte_order(name: str) -> None:
    model = MODEL_NAMED[name]
    orders = {register.order for register in model.table.registers if register.size > 1}
    assert orders == ({"big"} if name == "SCS0009" else {"little"})


@pytest.mark.parametrize("name", sorted(MODEL_NAMED))
def test_blocks_hold_their_registers(name: str) -> None:
    table = MODEL_NAMED[name].table
    data = Random(name).randbytes(table.size)
    parts = (table.max_torque, table.torque_enable, table.goal_position, table.torque_limit)
    for block, registers in (
        (table.state, table.measured),
        (table.condition, (*parts, table.present_position, table.present_load)),
        (table.limits, (table.low_limit, table.high_limit)),
        (table.goals, (table.goal_position, table.goal_speed)),
    ):
        held = tuple(one.decode(data[one.address : one.address + one.size]) for one in registers)
        assert block.unpack(data[block.address : block.address + block.size]) == held


def test_potentiometer_servos_have_the_high_byte_first() -> None:
    """The order is stated by Feetech's "Communication Protocol User Manual", section 1.0.

    The write of position 512 and time 20 is a vector of a driver for them: `FF FF 01 09 03 2A 02 00 00 14 00 00 B2`.
    """
    table = MODEL_NAMED["SCS0009"].table
    goal_time = next(register for register in table.registers if register.name == "goal time")
    data = table.goal_position.encode(512) + goal_time.encode(20) + table.goal_speed.encode(0)
    assert feetech_scs.write(1, 42, data) == bytes.fromhex("FF FF 01 09 03 2A 02 00 00 14 00 00 B2")
    (answer,) = feetech_scs.answer_parser(8).feed(feetech_scs.status(1, 0, bytes.fromhex("02 00 80 64 04 0A 3C 1E")))
    assert table.state.unpack(answer.parameters) == (512, 0x8064, 0x040A, 60, 30)
    assert table.present_position.decode(b"\x02\x01") == 513
    units = MODEL_NAMED["SCS0009"].units
    assert (signed(0x8064, units.speed_sign), signed(0x040A, units.load_sign)) == (-100, -10)


# Name of the register: address, size, access, and initial value if the page states one; the EEPROM ends before address 24.
AX_ROWS: Mapping[str, tuple[int, int, str, int | None]] = {
    "model number": (0, 2, "R", 12), "firmware version": (2, 1, "R", None), "id": (3, 1, "RW", 1), "baud rate": (4, 1, "RW", 1),
    "return delay": (5, 1, "RW", 250), "cw angle limit": (6, 2, "RW", 0), "ccw angle limit": (8, 2, "RW", 1023),
    "temperature limit": (11, 1, "RW", 70), "min voltage": (12, 1, "RW", 60), "max voltage": (13, 1, "RW", 140),
    "max torque": (14, 2, "RW", 1023), "status return level": (16, 1, "RW", 2), "alarm led": (17, 1, "RW", 36),
    "shutdown": (18, 1, "RW", 36), "torque enable": (24, 1, "RW", 0), "led": (25, 1, "RW", 0),
    "cw compliance margin": (26, 1, "RW", 1), "ccw compliance margin": (27, 1, "RW", 1),
    "cw compliance slope": (28, 1, "RW", 32), "ccw compliance slope": (29, 1, "RW", 32),
    "goal position": (30, 2, "RW", None), "moving speed": (32, 2, "RW", None),
    "torque limit": (34, 2, "RW", None), "present position": (36, 2, "R", None), "present speed": (38, 2, "R", None),
    "present load": (40, 2, "R", None), "present voltage": (42, 1, "R", None), "present temperature": (43, 1, "R", None),
    "registered": (44, 1, "R", 0), "moving": (46, 1, "R", 0), "lock": (47, 1, "RW", 0), "punch": (48, 2, "RW", 32),
}  # fmt: skip
_COMPLIANCE = ("cw compliance margin", "ccw compliance margin", "cw compliance slope", "ccw compliance slope")
MX_ROWS = {name: row for name, row in AX_ROWS.items() if name not in _COMPLIANCE} | {
    "ccw angle limit": (8, 2, "RW", 4095), "resolution divider": (22, 1, "RW", 1), "d gain": (26, 1, "RW", 0),
    "i gain": (27, 1, "RW", 0), "p gain": (28, 1, "RW", 32), "punch": (48, 2, "RW", 0),
}  # fmt: skip
RX = {"baud rate": 34, "temperature limit": 80, "max voltage": 190}


@pytest.mark.parametrize(
    ("name", "rows", "initial"),
    [
        ("AX-12A", AX_ROWS, {}),
        ("AX-18A", AX_ROWS, {"model number": 18, "temperature limit": 75, "max torque": 983}),
        ("AX-12W", AX_ROWS, {"model number": 300, **dict.fromkeys(_COMPLIANCE[:2], 4), **dict.fromkeys(_COMPLIANCE[2:], 64)}),
        ("RX-28", AX_ROWS, {"model number": 28, **RX}),
        ("RX-64", AX_ROWS, {"model number": 64, **RX}),
        ("MX-64", MX_ROWS, {"model number": 310, "baud rate": 34, "temperature limit": 80, "max voltage": 240}),
    ],
)
def test_all_rows_of_servos_with_protocol_1(
    name: str, rows: Mapping[str, tuple[int, int, str, int | None]], initial: Mapping[str, int]
) -> None:
    model = MODEL_NAMED[name]
    registers = {register.name: register for register in model.table.registers}
    assert registers.keys() == rows.keys()
    for key, (address, size, access, value) in rows.items():
        register = registers[key]
        assert (register.address, register.size, register.access) == (address, size, Access(access)), key
        assert register.eeprom == (address < 24), key
        if value is not None:
            assert model.default(register) == initial.get(key, value), key


# The same of the EEPROM of Protocol 2.0, and of some registers of the RAM.
X_ROWS: Mapping[str, tuple[int, int, str, int]] = {
    "model number": (0, 2, "R", 1060), "id": (7, 1, "RW", 1), "baud rate": (8, 1, "RW", 1), "return delay": (9, 1, "RW", 250),
    "drive mode": (10, 1, "RW", 0), "operating mode": (11, 1, "RW", 3), "homing offset": (20, 4, "RW", 0),
    "temperature limit": (31, 1, "RW", 72), "max voltage": (32, 2, "RW", 140), "min voltage": (34, 2, "RW", 60),
    "pwm limit": (36, 2, "RW", 885), "velocity limit": (44, 4, "RW", 265), "max position limit": (48, 4, "RW", 4095),
    "min position limit": (52, 4, "RW", 0), "shutdown": (63, 1, "RW", 52), "torque enable": (64, 1, "RW", 0),
    "position d gain": (80, 2, "RW", 4000), "position i gain": (82, 2, "RW", 0), "position p gain": (84, 2, "RW", 640),
    "bus watchdog": (98, 1, "RW", 0), "profile acceleration": (108, 4, "RW", 0), "profile velocity": (112, 4, "RW", 0),
}  # fmt: skip
XC = {"temperature limit": 80, "max voltage": 160, "position d gain": 0}
XM = XC | {"min voltage": 95, "position p gain": 800}


@pytest.mark.parametrize(
    ("name", "initial"),
    [
        ("XL430-W250", {}),
        ("XC430-W150", {**XC, "model number": 1070, "velocity limit": 460, "position p gain": 460}),
        ("XC430-W240", {**XC, "model number": 1080, "velocity limit": 306, "position p gain": 700}),
        ("XM430-W350", {**XM, "model number": 1020, "velocity limit": 200, "current limit": 1193}),
        ("XM540-W270", {**XM, "model number": 1120, "velocity limit": 128, "current limit": 2047}),
    ],
)
def test_rows_of_the_x_series(name: str, initial: dict[str, int]) -> None:
    model = MODEL_NAMED[name]
    registers = {register.name: register for register in model.table.registers}
    rows = dict(X_ROWS) | ({"current limit": (38, 2, "RW", 1193)} if "current limit" in initial else {})
    assert ("goal current" in registers) == ("current limit" in initial)
    for key, (address, size, access, value) in rows.items():
        register = registers[key]
        assert (register.address, register.size, register.access) == (address, size, Access(access)), key
        assert register.eeprom == (address < 64), key
        assert model.default(register) == initial.get(key, value), key


def test_units_of_currents() -> None:
    """A tick is 2.69 mA, https://emanual.robotis.com/docs/en/dxl/x/xm430-w350/#goal-current; stall currents of both at 12 V."""
    for name, stall_current in (("XM430-W350", 2.3), ("XM540-W270", 4.4)):
        model = MODEL_NAMED[name]
        assert model.units.torque == model.units.load == pytest.approx(2.69e-3 / stall_current)
        assert model.full_torque == pytest.approx(stall_current / 2.69e-3)
    assert MODEL_NAMED["XL430-W250"].full_torque == 885
    assert MODEL_NAMED["AX-12A"].full_torque == 1023


@pytest.mark.parametrize(
    ("name", "number", "tick_deg", "rpm_per_tick"),
    [
        ("MX-28", 29, 0.088, 0.114), ("XL430-W250", 1060, 0.088, 0.229), ("XM430-W350", 1020, 0.088, 0.229),
        ("STS3215", 777, 0.088, 0.732 / 50), ("XL-320", 350, 0.29, 0.111), ("AX-12A", 12, 0.29, 0.111),
        ("AX-18A", 18, 0.29, 0.111), ("AX-12W", 300, 0.29, 0.111), ("RX-28", 28, 0.29, 0.111), ("RX-64", 64, 0.29, 0.111),
        ("MX-64", 310, 0.088, 0.114), ("XC430-W150", 1070, 0.088, 0.229), ("XC430-W240", 1080, 0.088, 0.229),
        ("XM540-W270", 1120, 0.088, 0.229), ("SCS0009", 1284, 0.293, 0.293 / 6),
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


GOAL_2048 = bytes.fromhex("00 08 00 00 E8 03")  # position 2048, time 0, speed 1000


@pytest.mark.parametrize(
    ("packet", "expected"),
    [
        (feetech.ping(1), "FF FF 01 02 01 FB"),
        (feetech.status(1, 0), "FF FF 01 02 00 FC"),
        (feetech.read(1, 0x38, 2), "FF FF 01 04 02 38 02 BE"),
        (feetech.status(1, 0, b"\x18\x05"), "FF FF 01 04 00 18 05 DD"),
        (feetech.write(254, 5, b"\x01"), "FF FF FE 04 03 05 01 F4"),
        (feetech.write(1, 0x2A, GOAL_2048), "FF FF 01 09 03 2A 00 08 00 00 E8 03 D5"),
        (
            feetech.sync_write(0x2A, 6, [(k, GOAL_2048) for k in (1, 2, 3, 4)]),
            "FF FF FE 20 83 2A 06 01 00 08 00 00 E8 03 02 00 08 00 00 E8 03 03 00 08 00 00 E8 03 04 00 08 00 00 E8 03 58",
        ),
        (feetech.sync_read(0x38, 8, [1, 2]), "FF FF FE 06 82 38 08 01 02 36"),
        (feetech.status(1, 0, bytes.fromhex("00 08 00 00 00 00 79 1E")), "FF FF 01 0A 00 00 08 00 00 00 00 79 1E 55"),
        (feetech.status(2, 0, bytes.fromhex("FF 07 00 00 00 00 77 23")), "FF FF 02 0A 00 FF 07 00 00 00 00 77 23 53"),
    ],
)
def test_packets_match_byte_vectors_of_feetech(packet: bytes, expected: str) -> None:
    """Compare with the examples of Feetech's "Communication Protocol User Manual" of SCS and STS servos.

    It is among the downloads of https://www.feetechrc.com.
    """
    assert packet == bytes.fromhex(expected)


def test_answer_of_feetech_manual_is_a_state() -> None:
    """Its two answers to a read of eight bytes from 0x38: positions 2048 and 2047, 12.1 and 11.9 V, 30 and 35 deg C."""
    parser = feetech.answer_parser(8)
    answers = parser.feed(bytes.fromhex("FF FF 01 0A 00 00 08 00 00 00 00 79 1E 55 FF FF 02 0A 00 FF 07 00 00 00 00 77 23 53"))
    states = [feetech.TABLE.state.unpack(answer.parameters) for answer in answers]
    assert states == [(2048, 0, 0, 121, 30), (2047, 0, 0, 119, 35)]


def test_requests_and_errors_of_the_feetech_bus() -> None:
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
