"""Pulses of the firmware are those of the host's drivers for PCA9685 and a Maestro, and no order but torque on begins them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sextant.services.simulator.servo_bus.bridge_board import Board
from sextant.services.simulator.servo_bus.pulse_board import make_board
from sextant.services.simulator.servo_bus.servo_bank import make_servo_bank
from sextant.shared.robot.profiles import load_profile
from sextant.shared.servo import bridge_protocol, maestro, pca9685, pwm
from sextant.shared.servo.bridge_protocol import ANGLE_RAD, First, Goals, Hello, Limits, Message, State, Torque
from sextant.shared.servo.firmware import config, pulse_senders, wire
from sextant.shared.servo.firmware.pulse_senders import Chip, Maestro, Pca9685, sender_for
from sextant.shared.servo.firmware.pulses import LEG_US, PulseFirmware, RequestMaster
from sextant.shared.servo.pwm import TABLE, Pulses

MS = 1_000_000
PROFILE = load_profile("printed_ds3218")
assert PROFILE.servo.pulses is not None
PULSES = replace(PROFILE.servo.pulses, board="pca9685")
AT_MAESTRO = replace(PULSES, board="maestro")
BOARDS = pytest.mark.parametrize("of_board", [PULSES, AT_MAESTRO], ids=["pca9685", "maestro"])
RATE = 115_200


@pytest.mark.parametrize(
    "found",
    [
        PULSES,
        replace(PULSES, rate_hz=300.0),
        replace(PULSES, us_per_rad=636.6, centre_us=1520.0, range_us=900.0, oscillator_mhz=26.3, device=0x44),
    ],
)
def test_counts_are_those_of_the_host(found: Pulses) -> None:
    ours, units = sender_for(found.of_board, RATE), pwm.model_of(found).units
    assert isinstance(ours, Pca9685)
    hertz = found.oscillator_mhz * 1e6
    assert ours.scale == pca9685.pre_scale(found.rate_hz, hertz)
    assert ours.address == (found.device or pca9685.ADDRESS)
    assert len(ours.name) <= 32
    count_us = pca9685.count_us(ours.scale, hertz)
    for ticks in range(units.max_position + 1):
        angle = round(units.angle(ticks) / ANGLE_RAD)
        assert abs(ours.count(angle) - found.width_us(ticks) / count_us) < 1.0
    for count in range(ours.count(-32767), ours.count(32767) + 1):
        assert ours.count(ours.angle(count)) == count
    assert ours.count(-32767) * count_us == pytest.approx(found.centre_us - found.range_us, abs=count_us)
    assert ours.count(32767) * count_us == pytest.approx(found.centre_us + found.range_us, abs=count_us)


@pytest.mark.parametrize(
    "found",
    [
        AT_MAESTRO,
        replace(AT_MAESTRO, us_per_rad=636.6, centre_us=1520.0, range_us=900.0, rate_hz=100.0, device=12),
        replace(AT_MAESTRO, us_per_rad=2000.0),
    ],
)
def test_targets_of_a_maestro_are_those_of_the_host(found: Pulses) -> None:
    ours, units = sender_for(found.of_board, RATE), pwm.model_of(found).units
    assert isinstance(ours, Maestro)
    assert len(ours.name) <= 32
    for ticks in range(units.max_position + 1):
        angle = round(units.angle(ticks) / ANGLE_RAD)
        exact = found.width_us(units.centre + angle * ANGLE_RAD / units.tick_rad) * 4
        assert abs(ours.count(angle) - exact) < 0.6
    low, high = (round((found.centre_us + way * found.range_us) * 4) for way in (-1, 1))
    assert (ours.count(-32767), ours.count(32767)) == (low, high)
    for count in range(low, high + 1):
        assert ours.count(ours.angle(count)) == count


@pytest.mark.parametrize("device", [None, 12])
def test_commands_to_a_maestro_are_those_of_the_host(device: int | None) -> None:
    ours, chip, parser = Maestro((424_400, 1500, 1000, 50, device or 0), RATE), Chip(0), maestro.CommandParser(12)
    assert ours.read_back(chip, 7) == (maestro.get_errors(device) + maestro.get_position(7, device), 4)
    assert ours.write(chip, 3, [6000, 0, 10_000]) == (maestro.set_multiple_targets(3, [6000, 0, 10_000], device), 0)
    both = maestro.set_speed(5, 0, device) + maestro.set_acceleration(5, 0, device)
    assert ours.wake(chip, [5]) == [(both, 0)]
    assert [(data, size) for _, data, size in ours.status(chip, [5])] == [(maestro.get_errors(device), 2), (both, 0)]

    def ended(channels: list[int]) -> dict[int, int]:
        packets = [packet for data, _ in ours.off(chip, channels) for packet in parser.feed(data)]
        return {channel: target for packet in packets for channel, target in maestro.targets(packet).items()}

    assert ended([0, 1, 2, 9, 11]) == dict.fromkeys((0, 1, 2, 9, 11), maestro.OFF)
    assert ended([]) == dict.fromkeys(range(maestro.MAX_CHANNELS), maestro.OFF)
    assert parser.errors == maestro.BoardError.NONE


@given(st.integers(0, maestro.MAX_TARGET), st.integers(0, 0xFFFF))
def test_answers_of_a_maestro_are_understood(target: int, errors: int) -> None:
    ours = Maestro((424_400, 1500, 1000, 50, 0), RATE)
    count, bits = ours.found(errors.to_bytes(2, "little") + target.to_bytes(2, "little"))
    if errors > maestro.ALL_ERRORS:
        assert (count, bits) == (-1, 0), "another device has sent these bytes"
    else:
        assert count == target
        assert bool(bits) == bool(errors)
        assert bits & 0x3F == errors & 0x3F


def test_settings_and_registers_are_those_of_the_host() -> None:
    ours = pulse_senders
    assert PULSES.of_board == config.PULSES
    assert ours.NAME == pwm.NAME
    assert (ours._MODE1, ours._MODE2, ours._LED0) == (pca9685.MODE1, pca9685.MODE2, pca9685.LED0)
    assert (ours._ALL_LED, ours._PRE_SCALE) == (pca9685.ALL_LED, pca9685.PRE_SCALE)
    assert (ours._SLEEP, ours._AUTO_INCREMENT, ours._FULL) == (pca9685.SLEEP, pca9685.AUTO_INCREMENT, pca9685.FULL)
    assert (ours._TOTEM_POLE, ours._COUNTS, Pca9685.channels) == (pca9685.TOTEM_POLE, pca9685.COUNTS, pca9685.CHANNELS)
    assert (Maestro.channels, ours._KNOWN_ERRORS) == (maestro.MAX_CHANNELS, maestro.ALL_ERRORS)


def test_page_states_the_times_of_transfers() -> None:
    page = (Path(__file__).parents[5] / "docs" / "firmware.md").read_text(encoding="utf-8")
    byte_ms = 9 / 400
    goals = sum(1 + len(pca9685.write(0x40, pca9685.LED0, bytes(4 * count)).data) for count in (16, 2))
    assert f"the goals of 18 servos in two transfers take {goals * byte_ms:.2f} ms" in page
    assert f"a channel that is read back {(1 + 1 + 1 + 4) * byte_ms:.2f} ms" in page
    targets = len(maestro.set_multiple_targets(0, [6000] * 18, None))
    assert f"18 targets are {targets} bytes, {targets * 1e4 / RATE:.2f} ms" in page
    reading = len(maestro.get_errors() + maestro.get_position(0)) + 4
    assert f"a channel that is read back {reading * 1e4 / RATE:.2f} ms" in page
    rest_us = Maestro((424_400, 1500, 1000, 50, 0), RATE).rest_us(4, is_answered=True)
    assert f"the rest after it {rest_us / 1e3:.2f} ms" in page
    assert f"goals and seven readings take {(targets + 7 * (reading + 4)) * 1e4 / RATE:.1f} ms" in page
    assert f"the limits of 18 channels {18 * 8 * 1e4 / RATE:.1f} ms" in page


def test_answers_are_matched_in_order_and_missing_ones_counted() -> None:
    sender = sender_for(PULSES.of_board, RATE)
    master = RequestMaster(sender)
    read, size = sender.read_back(Chip(0), 0)
    assert read == pca9685.frame(pca9685.read(0x40, 6, 4))
    assert master.ask(read, size, "first", 0) == read
    assert master.hear(b"\1\2", 10) == []
    assert master.hear(b"\3\4\5", 20) == [("first", 0, b"\2\3\4\5")]
    master.ask(read, size, "second", 30)
    assert master.hear(bytes(5), 40) == [("second", 30, None)], "not acknowledged"
    master.ask(read, size, "third", 50)
    assert master.hear(b"\1", 60) == []
    assert master.hear(b"", 60 + sender.wait_us(read, size)) == [("third", 50, None)]
    master.ask(read, size, "fourth", 70)
    master.forget()
    assert master.hear(b"\1\2\3\4\5", 80) == []
    assert (master.waits, master.silent) == (False, 2)


def test_orders_to_a_maestro_are_complete_when_they_are_sent() -> None:
    sender = sender_for(AT_MAESTRO.of_board, RATE)
    master = RequestMaster(sender)
    order, size = sender.write(Chip(0), 0, [6000] * 18)
    master.ask(order, size, "order", 0)
    sent_us = round(len(order) * 10e6 / RATE)
    assert master.hear(b"late answer", sent_us - 2) == []
    assert master.hear(b"", sent_us + 1) == [("order", 0, b"")]
    master.ask(*sender.read_back(Chip(0), 1), "reading", 5000)
    assert master.hear(b"\0\0\x70", 5500) == []
    assert master.hear(b"\x17", 5600) == [("reading", 5000, b"\0\0\x70\x17")]
    assert (master.silent, master.waits) == (0, False)


@BOARDS
def test_slow_board_stays_adopting_until_torque_off_is_confirmed(of_board: Pulses) -> None:
    firmware, now_us = PulseFirmware(1, of_board.of_board, "slow", 0, RATE, 80_000), 0
    firmware.step(0, bridge_protocol.encode(Torque(9, 1, 0, 0)))
    firmware.step(1000, bridge_protocol.encode(Hello(bridge_protocol.VERSION, 7, 1000, bytes((0, 1, 2)))))
    while now_us < 1_000_000:
        now_us = max(now_us + 1000, firmware.due_us)
        firmware.step(now_us)
        assert firmware.mode == wire.ADOPTING


class Bench:
    """A microcontroller with four servos at two PCA9685 or a Maestro, and the actions of a host."""

    def __init__(self, torque: bool, of_board: Pulses) -> None:
        self.ids = bytes((0, 1, 15, 16))
        self.bank = make_servo_bank(replace(PROFILE.servo, pulses=of_board), tuple(self.ids), np.zeros(4))
        self.bank.column(TABLE.torque_enable)[:] = torque
        self.chips = make_board(self.bank, of_board, on_uart=True)
        self.board = Board(self.chips, model=self.bank.model, pulses=of_board)
        self.now_ns = self.sequence = 0
        self.receiver = bridge_protocol.Receiver(bridge_protocol.TO_HOST)

    def pass_time(self, ms: int, message: Message | bytes = b"") -> list[Message]:
        data = message if isinstance(message, bytes) else bridge_protocol.encode(message)
        replies = self.board.receive(data, self.now_ns)
        for _ in range(0, ms, 5):
            self.now_ns += 5 * MS
            replies += self.board.unsolicited_replies(self.now_ns)
            self.board.advance(self.now_ns)
        self.chips.advance(self.now_ns + 20 * MS)
        return [message for reply in replies for message in self.receiver.feed(reply.data)]

    def head(self) -> tuple[int, int, int]:
        self.sequence += 1
        return 7, self.sequence, self.now_ns // 1000 + 1_000_000

    @property
    def torque(self) -> list[int]:
        return self.bank.column(TABLE.torque_enable).tolist()  # type: ignore[no-any-return]


ORDERS = st.lists(
    st.tuples(
        st.sampled_from(["goals", "on", "off", "limits", "first", "hello", "new hello", "restart", "wait", "noise"]),
        st.tuples(*[st.integers(-3000, 3000)] * 4),
        st.integers(1, 700),
        st.binary(max_size=30),
    ),
    max_size=20,
)


@pytest.mark.slow
@BOARDS
@settings(deadline=None, derandomize=True, max_examples=60)
@given(orders=ORDERS, torque=st.booleans())
def test_random_orders_begin_pulses_only_by_torque_order(
    of_board: Pulses, orders: list[tuple[str, tuple[int, int, int, int], int, bytes]], torque: bool
) -> None:
    bench = Bench(torque, of_board)
    bench.pass_time(50, Hello(bridge_protocol.VERSION, 7, 1_000_000, bench.ids))
    assert bench.torque == [int(torque)] * 4
    ordered = False
    for what, words, ms, noise in orders:
        before = bench.torque
        message: Message | bytes
        match what:
            case "goals":
                message = Goals(*bench.head(), 200, words, (0,) * 4)
            case "on" | "off":
                message = Torque(*bench.head(), int(what == "on"))
            case "limits":
                message = Limits(*bench.head(), (0,) * 4)
            case "first":
                message = First(*bench.head(), bench.ids)
            case "hello" | "new hello":
                session = 7 if what == "hello" else 7 + ms
                message = Hello(bridge_protocol.VERSION, session, bench.now_ns // 1000 + 1_000_000, bench.ids)
            case "restart":
                bench.chips.restart(bench.now_ns)
                message, before = b"", [0] * 4
            case _:
                message = b"\0" + noise + b"\0" if what == "noise" else b""
        bench.pass_time(ms, message)
        ordered = what == "on" or (ordered and what not in ("off", "restart"))
        if not ordered:
            assert all(now <= then for now, then in zip(bench.torque, before, strict=True)), what
        if what == "off":
            assert not any(bench.torque)


@BOARDS
def test_first_pulses_are_the_goals_and_each_leg_waits_for_the_one_before(of_board: Pulses) -> None:
    bench = Bench(torque=False, of_board=of_board)
    bench.pass_time(50, Hello(bridge_protocol.VERSION, 7, 1_000_000, bench.ids))
    bench.pass_time(10, Goals(*bench.head(), 200, (100, 200, 300, 400), (0,) * 4))
    bench.pass_time(10, Torque(*bench.head(), 1))
    assert bench.torque == [1, 1, 1, 0]
    units = bench.bank.model.units
    angles = [units.angle(int(ticks)) / ANGLE_RAD for ticks in bench.bank.column(TABLE.goal_position)[:3]]
    assert angles == pytest.approx([100, 200, 300], abs=60)
    said: list[Message] = []
    for _ in range(LEG_US // 20_000 - 3):
        said = bench.pass_time(20, Goals(*bench.head(), 200, (100, 200, 300, 400), (0,) * 4))
    assert bench.torque == [1, 1, 1, 0]
    ages = [message.age for message in said if isinstance(message, State)][-1]
    assert [age == bridge_protocol.NEVER for age in ages] == [False, False, False, True]
    for _ in range(5):
        bench.pass_time(20, Goals(*bench.head(), 200, (100, 200, 300, 400), (0,) * 4))
    assert bench.torque == [1, 1, 1, 1]
