"""Servo models that a profile may name.

Sources: ROBOTIS e-manual and Feetech data sheets, pages of the models.
"""

import math
from dataclasses import replace
from types import MappingProxyType

from sextant.shared.servo import dynamixel, dynamixel2, feetech, feetech_scs, lewansoul, x_series, xl320
from sextant.shared.servo.servo_model import (
    ALL_OF_PROTOCOL_1,
    Commands,
    Feedback,
    Recovery,
    ServoError,
    ServoModel,
    setting,
)

_NONE: MappingProxyType[str, int] = MappingProxyType({})
_ANSWER_ALL = 2  # status return level
_AX_RATES = MappingProxyType({code: dynamixel.baud_rate(code) for code in range(255)})
_AX_SETTINGS = MappingProxyType({dynamixel.STATUS_RETURN_LEVEL.name: _ANSWER_ALL, dynamixel.RETURN_DELAY.name: 0})


def _ax(name: str, number: int, no_load_rpm: float, **overrides: int) -> ServoModel:
    """Return a model with the control table of the AX-12A."""
    factory = MappingProxyType({register.replace("_", " "): value for register, value in overrides.items()})
    table, units = dynamixel.TABLE, dynamixel.UNITS
    common = tuple(map(dynamixel.baud_rate, (1, 3, 4, 7, 9, 16, 34, 103, 207)))
    return ServoModel(name, number, dynamixel, table, units, _AX_RATES, _AX_SETTINGS, no_load_rpm, factory, common)


# Registers of the MX series that differ from those of the AX-12A.
_MX_LOW = replace(dynamixel.CW_ANGLE_LIMIT, max=4095)
_MX_HIGH = replace(dynamixel.CCW_ANGLE_LIMIT, max=4095, default=4095)
_MX_GOAL = replace(dynamixel.GOAL_POSITION, max=4095, default=2048)
_MX_P = setting("p gain", 28, 1, 32, 0, 254)
_MX_GAINS = (setting("d gain", 26, 1, 0, 0, 254), setting("i gain", 27, 1, 0, 0, 254), _MX_P)
_MX_CHANGED = {dynamixel.CW_ANGLE_LIMIT: _MX_LOW, dynamixel.CCW_ANGLE_LIMIT: _MX_HIGH, dynamixel.GOAL_POSITION: _MX_GOAL}
_MX_DIVIDER = setting("resolution divider", 22, 1, 1, 1, 4, eeprom=True)
_MX_SPEED = 0.114 * 2.0 * math.pi / 60.0  # [rad/s] per tick
MX_TABLE = replace(
    dynamixel.TABLE,
    registers=(
        *(
            _MX_CHANGED.get(register, register)
            for register in dynamixel.REGISTERS
            if register not in dynamixel.TABLE.compliance
        ),
        *_MX_GAINS,
        _MX_DIVIDER,
    ),
    eeprom=range(_MX_DIVIDER.address + 1),
    low_limit=_MX_LOW,
    high_limit=_MX_HIGH,
    goal_position=_MX_GOAL,
    compliance=(),
    position_gain=_MX_P,
)
MX_UNITS = replace(dynamixel.UNITS, centre=2048, max_position=4095, tick_rad=2.0 * math.pi / 4096, speed_rad_s=_MX_SPEED)


def _mx(name: str, number: int, no_load_rpm: float, **overrides: int) -> ServoModel:
    """Return a model of the MX series with the firmware for Protocol 1.0."""
    # The duty cycle is P / 8 per tick of position error, full at 1023.
    return replace(
        _ax(name, number, no_load_rpm, baud_rate=34, temperature_limit=80, **overrides),
        table=MX_TABLE,
        units=MX_UNITS,
        masks=MappingProxyType({_MX_DIVIDER.name: (0xFF, 1)}),
        gain_stiffness=1.0 / (8.0 * 1023.0 * MX_UNITS.tick_rad),
    )


AX_12A = _ax("AX-12A", 12, 59.0)
AX_18A = _ax("AX-18A", 18, 97.0, temperature_limit=75, max_torque=983)
_WIDE = {"cw_compliance_margin": 4, "ccw_compliance_margin": 4, "cw_compliance_slope": 64, "ccw_compliance_slope": 64}
AX_12W = _ax("AX-12W", 300, 54.0, **_WIDE)
RX_64 = _ax("RX-64", 64, 64.0, baud_rate=34, temperature_limit=80, max_voltage=190)
RX_28 = _ax("RX-28", 28, 85.0, baud_rate=34, temperature_limit=80, max_voltage=190)
MX_28 = _mx("MX-28", 29, 67.0, max_voltage=160)
MX_64 = _mx("MX-64", 310, 78.0, max_voltage=240, punch=0)

STS3215 = ServoModel(
    "STS3215",
    777,
    feetech,
    feetech.TABLE,
    feetech.UNITS,
    MappingProxyType(feetech.RATES),
    # The return delay has no function in this servo, so it can tell a servo that is set up from a new one.
    MappingProxyType({"mode": 0, feetech.TABLE.status_return_level.name: 1, feetech.TABLE.return_delay.name: 1}),
    no_load_rpm=45.0,  # 0.222 s for 60 deg, at 12 V
    overrides=_NONE,
    recovery=Recovery.TORQUE_ENABLE,
    errors=ServoError.INPUT_VOLTAGE | ServoError.OVERHEATING | ServoError.OVERLOAD | ServoError.HARDWARE,
    gain_stiffness=17.8 / 2.94 / 32,  # identified 17.8 N m/rad at a gain of 32 (Open Duck Mini), with 2.94 N m of stall torque
    sync_read=feetech.sync_read,
    masks=MappingProxyType({"phase": (0x9C, 0x0C)}),  # speed in ticks per second, 0 for the highest; no turns; not reversed
    unlocks=True,
)

SCS0009 = ServoModel(
    "SCS0009",
    1284,
    feetech_scs,
    feetech_scs.TABLE,
    feetech_scs.UNITS,
    MappingProxyType(feetech_scs.RATES),
    # The return delay of 2 us tells a servo that is set up from a new one.
    MappingProxyType({feetech_scs.TABLE.status_return_level.name: 1, feetech_scs.TABLE.return_delay.name: 1}),
    no_load_rpm=100.0,  # 0.1 s for 60 deg, at 6 V
    overrides=_NONE,
    recovery=Recovery.TORQUE_ENABLE,
    errors=ServoError.INPUT_VOLTAGE | ServoError.OVERHEATING | ServoError.OVERLOAD,
    gain_stiffness=1.0 / (15 * math.radians(10.0)),  # full torque at an error of 10 deg with the gain of the factory: assumed
    unlocks=True,
    lacks=feetech_scs.LACKS,
)


def _x(name: str, number: int, no_load_rpm: float, **overrides: int) -> ServoModel:
    """Return a model of the X series."""
    # The PWM is P / 128 per tick of position error.
    units = x_series.UNITS
    return ServoModel(
        name,
        number,
        dynamixel2,
        x_series.TABLE,
        units,
        MappingProxyType(x_series.RATES),
        MappingProxyType(x_series.SETTINGS),
        no_load_rpm,
        MappingProxyType({register.replace("_", " "): value for register, value in overrides.items()}),
        recovery=Recovery.REBOOT,
        errors=ALL_OF_PROTOCOL_1 | ServoError.HARDWARE,
        eeprom_needs_torque_off=True,
        sync_read=dynamixel2.sync_read,
        fast_firmware=x_series.FAST_FIRMWARE,
        gain_stiffness=1.0 / (128.0 * x_series.MAX_PWM * units.tick_rad),
    )


def _xm(name: str, number: int, no_load_rpm: float, stall_current: float, **overrides: int) -> ServoModel:
    """Return a model of the X series that measures and limits its current, with its stall current [A]."""
    base, unit = _x(name, number, no_load_rpm, **overrides), x_series.CURRENT_A / stall_current
    return replace(
        base,
        table=x_series.CURRENT_TABLE,
        units=replace(base.units, load=unit, torque=unit),
        settings=MappingProxyType(x_series.CURRENT_SETTINGS),
        # The current is P / 128 per tick of position error, by assumption in ticks of the goal current.
        gain_stiffness=unit / (128.0 * base.units.tick_rad),
        limits_current=True,
    )


XL430_W250 = _x("XL430-W250", 1060, 61.0, position_p_gain=640, position_d_gain=4000)
XC430_W150 = _x("XC430-W150", 1070, 106.0, temperature_limit=80, max_voltage=160, position_p_gain=460, velocity_limit=460)
XC430_W240 = _x("XC430-W240", 1080, 70.0, temperature_limit=80, max_voltage=160, position_p_gain=700, velocity_limit=306)
_XM = {"temperature_limit": 80, "max_voltage": 160, "min_voltage": 95}
XM430_W350 = _xm("XM430-W350", 1020, 57.0, 2.3, **_XM, velocity_limit=200)
XM540_W270 = _xm("XM540-W270", 1120, 37.0, 4.4, **_XM, velocity_limit=128, current_limit=2047, goal_current=2047)
XL_320 = ServoModel(
    "XL-320",
    350,
    dynamixel2,
    xl320.TABLE,
    dynamixel.UNITS,
    MappingProxyType(xl320.RATES),
    MappingProxyType(xl320.SETTINGS),
    no_load_rpm=114.0,  # at 7.4 V
    overrides=_NONE,
    eeprom_needs_torque_off=True,
    sync_read=dynamixel2.sync_read,
    gain_stiffness=1.0 / (8.0 * 1023.0 * MX_UNITS.tick_rad),  # assumed: that of an MX; the manual states no unit of its gain
    error_bits=MappingProxyType(xl320.ERROR_BITS),
)


def _lewansoul(name: str, number: int, no_load_rpm: float, **overrides: int) -> ServoModel:
    """Return a model with the commands of the LX-16A; the number is ours, because the servo tells none."""
    return ServoModel(
        name,
        number,
        lewansoul,
        lewansoul.TABLE,
        lewansoul.UNITS,
        MappingProxyType(lewansoul.RATES),
        MappingProxyType(lewansoul.SETTINGS),
        no_load_rpm,
        MappingProxyType({register.replace("_", " "): value for register, value in overrides.items()}),
        recovery=Recovery.ITSELF,
        errors=ServoError.NONE,
        gain_stiffness=1.0 / math.radians(10.0),  # full torque at an error of 10 deg: assumed
        masks=MappingProxyType(lewansoul.MASKS),
        feedback=Feedback.POSITION | Feedback.VOLTAGE | Feedback.TEMPERATURE,
        commands=Commands(lewansoul.command_at, lewansoul.answer_code, lewansoul.commands_in, lewansoul.LACKS),
        bus_rate=lewansoul.BAUD_RATE,
    )


LX_16A = _lewansoul("LX-16A", 16, 62.5)  # 0.16 s for 60 deg at 7.4 V
HX_35H = _lewansoul("HX-35H", 35, 55.6, max_voltage=14_000)  # 0.18 s for 60 deg at 11.1 V
MODELS = (
    *(AX_12A, AX_18A, AX_12W, RX_28, RX_64, MX_28, MX_64, XL430_W250, XC430_W150, XC430_W240, XM430_W350),
    *(XM540_W270, XL_320, STS3215, SCS0009, LX_16A, HX_35H),
)
MODEL_NAMED = MappingProxyType({model.name: model for model in MODELS})
