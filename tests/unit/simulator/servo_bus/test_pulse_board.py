"""Emulated boards for hobby servos, at the bytes of their manuals."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sextant.services.simulator.servo_bus.bus_faults import BusFaults
from sextant.services.simulator.servo_bus.pca9685_chip import Pca9685Chip
from sextant.services.simulator.servo_bus.pulse_board import MaestroEmulator, make_board
from sextant.services.simulator.servo_bus.servo_bank import make_servo_bank
from sextant.shared.robot.profiles import load_profile
from sextant.shared.servo import pca9685
from sextant.shared.servo.bus_fault import BusFault
from sextant.shared.servo.pca9685 import Transfer
from sextant.shared.servo.pwm import TABLE

PROFILE = load_profile("printed_ds3218")
PERIOD_NS = 20_000_000


class Rig:
    """Three servos at the channels 0 to 2 of a Maestro, whose joints stand still at 0.1 rad."""

    def __init__(self) -> None:
        assert PROFILE.servo.pulses is not None
        self.bank = make_servo_bank(PROFILE.servo, (0, 1, 2), np.full(3, 0.1))
        self.board = MaestroEmulator(self.bank, PROFILE.servo.pulses)
        self.now_ns = 0

    def say(self, text: str) -> str:
        """Send bytes, and return the answer."""
        replies = self.board.receive(bytes.fromhex(text), self.now_ns)
        return b"".join(reply.data for reply in replies).hex(" ")

    def run(self) -> None:
        """Let one period of the pulses pass."""
        self.now_ns += PERIOD_NS
        self.board.advance(self.now_ns)
        self.command = self.bank.step(np.full(3, 0.1), np.zeros(3), np.zeros(3), 0.02)


def test_maestro_sends_pulses_from_the_next_period_on() -> None:
    rig = Rig()
    rig.run()
    assert (rig.command.torque_limit == 0.0).all()
    assert rig.say("90 02") == "00 00"
    rig.now_ns += 1
    rig.say("84 02 70 2e")
    assert rig.say("90 02") == "70 17"  # 6000 quarter microseconds, low byte first
    rig.board.advance(rig.now_ns)
    assert rig.bank.column(TABLE.torque_enable).tolist() == [0, 0, 0]
    rig.run()
    assert rig.bank.column(TABLE.torque_enable).tolist() == [0, 0, 1]
    assert (rig.command.torque_limit > 0.0).tolist() == [False, False, True]
    dead_band = 3.0 / 424.4
    assert rig.command.setpoint[2] == pytest.approx(0.0 + dead_band / 2), "it jumps to the first pulse"


def test_target_zero_ends_pulses() -> None:
    rig = Rig()
    rig.say("9f 03 00 70 2e 70 2e 70 2e")
    rig.run()
    assert (rig.command.torque_limit > 0.0).all()
    rig.say("9f 02 01 00 00 00 00")
    rig.run()
    assert (rig.command.torque_limit > 0.0).tolist() == [True, False, False]
    rig.say("aa 0c 22")
    rig.run()
    assert (rig.command.torque_limit == 0.0).all()


def test_errors_are_reported_once() -> None:
    rig = Rig()
    assert rig.say("a1") == "00 00"
    rig.say("84 01 a1")  # an incomplete command, and the answer to the next one
    assert rig.say("05 a1") == "10 00"
    assert rig.say("a1") == "00 00"
    assert rig.say("93") == "00"


def test_pulses_beyond_the_range_leave_the_servo_at_its_stop() -> None:
    rig = Rig()
    rig.say("84 00 00 60")  # 3072 us
    rig.run()
    assert rig.bank.column(TABLE.goal_position)[0] == rig.bank.model.units.max_position


# --------------------------------------------------------------------------------------------------------------- PCA9685


def test_pca9685_begins_asleep_with_all_channels_off() -> None:
    chip = Pca9685Chip(25e6)
    assert chip.transfer(b"\x00", 1) == b"\x11"
    assert chip.transfer(b"\xfe", 1) == b"\x1e"
    assert chip.transfer(b"\x09", 1) == b"\x10"
    assert chip.widths_us() == [0.0] * 16


def test_boards_of_pca9685_answer_after_bytes_of_another_bus() -> None:
    assert PROFILE.servo.pulses is not None
    pulses = replace(PROFILE.servo.pulses, board="pca9685")
    board, request = make_board(make_servo_bank(PROFILE.servo, (0, 1, 2), np.zeros(3)), pulses), Transfer(0x40, b"\xfe", 1)
    assert board.receive(b"\xff\xff\x01\x02\x01\xfb", 0) == []
    (reply,) = board.receive(pca9685.frame(request), 1_000_000_000)
    assert reply.data == b"\x01\x1e"


def test_pca9685_takes_its_rate_only_asleep() -> None:
    chip = Pca9685Chip(25e6)
    chip.transfer(b"\xfe\x79", 0)
    chip.transfer(b"\x00\x20", 0)
    chip.transfer(b"\xfe\x1e", 0)
    assert chip.transfer(b"\xfe", 1) == b"\x79"
    chip.transfer(b"\x00\x30", 0)
    chip.transfer(b"\xfe\x01", 0)
    assert chip.transfer(b"\xfe", 1) == b"\x03", "the hardware has a least value"


def test_pca9685_counts_addresses_up_only_with_auto_increment() -> None:
    chip = Pca9685Chip(25e6)
    chip.transfer(b"\x06\x01\x02", 0)
    assert chip.transfer(b"\x06", 2) == b"\x02\x02"
    chip.transfer(b"\x00\x20", 0)
    chip.transfer(b"\x06\x00\x00\x33\x01\x00\x00\x66\x02", 0)
    assert chip.transfer(b"\x06", 8) == bytes.fromhex("00 00 33 01 00 00 66 02")
    assert chip.transfer(b"\x45", 2) == b"\x10\x20", "after the last channel comes MODE1"


@given(st.integers(1, pca9685.COUNTS - 1))
def test_pca9685_sends_the_counts_of_its_registers(count: int) -> None:
    chip = Pca9685Chip(25e6)
    chip.start(50.0, [0.0] * 16)
    chip.transfer(bytes((pca9685.LED0 + 8,)) + pca9685.channel_registers(count), 0)
    assert chip.widths_us()[2] == pytest.approx(count * 4.88)
    assert not any(chip.widths_us()[:2] + chip.widths_us()[3:])
    chip.transfer(bytes((pca9685.ALL_LED, 0, 0, 0, pca9685.FULL)), 0)
    assert not any(chip.widths_us())


# ---------------------------------------------------------------------------------------------------------------- faults


@pytest.mark.parametrize("kind", ["overload", "hot", "stuck", "wrong", "sign", "bit", "garbage", "slow", "heat"])
def test_faults_of_readings_are_refused(kind: str) -> None:
    rig = Rig()
    faults = BusFaults(rig.board, rig.bank)
    with pytest.raises(ValueError, match="hobby servos report nothing"):
        faults.inject(BusFault("servo", kind, 0.0, servo=1), 0)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="hobby servos report nothing"):
        faults.inject(BusFault("supply", "sag", 0.0), 0)


@pytest.mark.parametrize("cable", [True, False])
def test_a_disconnected_servo_is_limp_and_the_board_does_not_notice(cable: bool) -> None:
    rig = Rig()
    rig.board = BusFaults(rig.board, rig.bank)  # type: ignore[assignment]
    rig.board.inject(BusFault("servo", "silent", 0.1, 0.5, servo=1, cable=cable), 0)  # type: ignore[attr-defined]
    limp = []
    for _ in range(50):
        rig.say("9f 03 00 70 2e 70 2e 70 2e")
        rig.run()
        assert rig.say("90 01") == "70 17"
        limp.append(rig.command.torque_limit[1] == 0.0)
        assert rig.command.torque_limit[0] > 0.0
    assert sum(limp) == pytest.approx(25, abs=3)
    assert not limp[-1], "the next pulse makes it jump"
