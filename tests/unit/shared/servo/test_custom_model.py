"""Servo models that a profile states by numbers."""

import tomllib
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sextant.services.actuator.servo_bus.bus_driver import ServoBus
from sextant.services.simulator.servo_bus.bus import ServoBusEmulator
from sextant.services.simulator.servo_bus.memory_port import MemoryPort
from sextant.services.simulator.servo_bus.servo_bank import make_servo_bank
from sextant.shared.files import config
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.robot.profile_text import profile_text
from sextant.shared.robot.profiles import load_profile
from sextant.shared.robot.servo import Servo
from sextant.shared.servo.custom_model import ModelNumbers, RegisterNumbers, custom_model
from sextant.shared.servo.models import MODEL_NAMED
from tests.support.families import robot_with

W210 = """
like = "XM430-W350"
number = 1030
no_load_rpm = 77.0
"""
SCALED = """
like = "STS3215"
number = 999
no_load_rpm = 60.0
positions = 1024
range_deg = 300.0
speed_rpm = 0.1
load = 0.002
volt = 0.05
full_torque_deg = 5.0

[[registers]]
role = "present_position"
address = 74
[[registers]]
role = "position_gain"
default = 16
"""


def numbers(text: str) -> ModelNumbers:
    return config.build(tomllib.loads(text), ModelNumbers)


def servo(text: str, **changed: Any) -> Servo:
    made = numbers(text)
    base = robot_with(made.like).servo
    return replace(base, model="mine", numbers=made, **changed)


def test_what_is_not_stated_is_that_of_the_known_model() -> None:
    model, like = custom_model("XM430-W210", numbers(W210)), MODEL_NAMED["XM430-W350"]
    assert (model.name, model.number, model.no_load_rpm) == ("XM430-W210", 1030, 77.0)
    assert (model.table, model.units, model.protocol) == (like.table, like.units, like.protocol)
    assert model.default(model.table.model_number) == 1030
    assert {r: model.default(r) for r in model.table.registers[1:]} == {r: like.default(r) for r in like.table.registers[1:]}


def test_stated_units_and_registers_replace_those_of_the_known_model() -> None:
    model = custom_model("mine", numbers(SCALED))
    units, table = model.units, model.table
    assert (units.centre, units.max_position) == (512, 1023)
    assert np.degrees(units.tick_rad) * 1024 == pytest.approx(300.0)
    assert units.speed_rad_s == pytest.approx(0.1 * 2 * np.pi / 60)
    assert (units.load, units.volt) == (0.002, 0.05)
    assert model.gain_stiffness * 16 * np.radians(5.0) == pytest.approx(1.0)
    assert (table.goal_position.max, table.high_limit.default, table.low_limit.max) == (1023, 1023, 1023)
    assert table.present_position.address == 74
    assert (table.size, table.ram.stop, table.eeprom) == (76, 76, MODEL_NAMED["STS3215"].table.eeprom)
    assert len(model.factory_table()) == 76


@pytest.mark.parametrize("text", [W210, SCALED])
def test_bus_of_such_servos_is_read_and_moved(text: str) -> None:
    robot = servo(text)
    model = robot.servo_model
    bank = make_servo_bank(robot, (1, 2), np.array([0.3, -0.2]))
    bank.column(model.table.baud_rate)[:] = model.rate_code(1_000_000)
    emulator, now = ServoBusEmulator(bank), [0]
    port = MemoryPort(emulator, lambda: now[0])
    bus = ServoBus(port, (1, 2), port.now_ns, model=model)
    bus.setup()
    assert bus.read(1, model.table.model_number) == model.number
    readings = bus.poll(20_000_000)
    assert [found.index for found in readings] == [0, 1]
    assert [found.position for found in readings] == pytest.approx([0.3, -0.2], abs=model.units.tick_rad)
    goals = [model.units.ticks(0.1), model.units.ticks(0.0)]
    bus.sync_write_goals(np.array(goals))
    now[0] = port.now_ns() + 20_000_000
    emulator.advance(now[0])
    assert [bus.read(i, model.table.goal_position) for i in (1, 2)] == goals


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (W210.replace("XM430-W350", "XM430-W530"), "like: one of AX-12A, "),
        (W210.replace("1030", "70000"), "number: a model number from 1 to 65535 expected, found 70000"),
        (W210 + "positions = 100\n", "positions: 256 to 65536 positions expected, found 100"),
        (W210 + '[[registers]]\nrole = "gaol_position"\n', "registers[0].role: one of baud_rate, firmware, goal_position, "),
        (W210 + '[[registers]]\nrole = "lock"\n', "registers[0].role: a role that XM430-W350 has expected, found 'lock'"),
        (
            W210 + '[[registers]]\nrole = "goal_position"\nmax = 9\n',
            "registers[0]: min <= default <= max, within 4 bytes, expected, found 0, 2048 and 9",
        ),
        (
            W210 + '[[registers]]\nrole = "goal_position"\naddress = 114\n',
            "registers: registers with addresses of their own: profile velocity ends at 115, expected, "
            "found goal position at 114",
        ),
        (
            W210 + '[[registers]]\nrole = "present_position"\naddress = 40\n',
            "registers: registers that are lost without power behind the EEPROM, which ends at 63, expected, found address 40",
        ),
        (W210 + 2 * '[[registers]]\nrole = "moving"\n', "registers[1].role: each role once expected, found 'moving'"),
    ],
)
def test_numbers_that_do_not_fit_are_refused_by_name(text: str, words: str) -> None:
    with pytest.raises(config.ConfigError) as error:
        numbers(text)
    assert words in str(error.value)


def test_profile_with_numbers_reads_back_as_it_was_written() -> None:
    profile = replace(load_profile("printed_sts3215"), servo=servo(SCALED, no_load_speed=6.28), name="mine")
    assert config.build(tomllib.loads(profile_text(profile)), RobotProfile) == profile


@pytest.mark.parametrize(
    ("model", "stated", "words"),
    [
        ("XM430-W210", None, "one of AX-12A, "),
        (
            "AX-12A",
            ModelNumbers("AX-12A", 12, 59.0),
            "a name that no known model has, since [servo.numbers] is",
        ),
    ],
)
def test_model_is_known_or_has_numbers(model: str, stated: ModelNumbers | None, words: str) -> None:
    with pytest.raises(ValueError, match="model: ") as error:
        replace(load_profile("phantomx_mk2").servo, model=model, numbers=stated)
    assert words in str(error.value)


def test_registers_of_a_role_take_numbers_of_the_known_model_where_none_is_stated() -> None:
    moved = RegisterNumbers("moving", address=200)
    model = custom_model("mine", replace(numbers(W210), registers=(moved,)))
    like = MODEL_NAMED["XM430-W350"].table.moving
    assert model.table.moving == replace(like, address=200)
