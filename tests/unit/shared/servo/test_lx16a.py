"""Bytes of the LX-16A bus: vectors, values of commands, and units.

The maker's document "LewanSoul Bus Servo Communication Protocol" gives lengths, ranges and the checksum, but no bytes. The
vectors are from projects that publish what their servos accept and answer, such as
https://github.com/madhephaestus/lx16a-servo; that of the voltage is from https://tlfong01.blog/2020/09/10/lx-224hv-chat-record/.
"""

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sextant.shared.servo import lx16a
from sextant.shared.servo.lx16a import READS, WRITES, Command, Fault, Led, Mode, PacketParser

WILD = settings(deadline=None, derandomize=True, max_examples=60)
hexed = bytes.fromhex


@pytest.mark.parametrize(
    ("packet", "expected"),
    [
        (lx16a.write(1, Command.MOVE_TIME_WRITE, 500, 1000), "55 55 01 07 01 F4 01 E8 03 16"),
        (lx16a.write(1, Command.MOVE_TIME_WRITE, 400, 1000), "55 55 01 07 01 90 01 E8 03 7A"),
        (lx16a.write(1, Command.MOVE_TIME_WRITE, 900, 1000), "55 55 01 07 01 84 03 E8 03 84"),
        (lx16a.write(1, Command.MOVE_STOP), "55 55 01 03 0C EF"),
        (lx16a.write(1, Command.LOAD_OR_UNLOAD_WRITE, 0), "55 55 01 04 1F 00 DB"),
        (lx16a.write(1, Command.LOAD_OR_UNLOAD_WRITE, 1), "55 55 01 04 1F 01 DA"),
        (lx16a.read(1, Command.POS_READ), "55 55 01 03 1C DF"),
        (lx16a.read(1, Command.VIN_READ), "55 55 01 03 1B E0"),
        (lx16a.write(1, Command.MODE_WRITE, Mode.MOTOR, 100), "55 55 01 07 1D 01 00 64 00 75"),
        (lx16a.read(254, Command.ID_READ), "55 55 FE 03 0E F0"),
        (lx16a.read(1, Command.ID_READ), "55 55 01 03 0E ED"),
    ],
)
def test_commands_match_published_bytes(packet: bytes, expected: str) -> None:
    assert packet == hexed(expected)
    (parsed,) = PacketParser(instructions=True).feed(packet)
    assert lx16a.encode(parsed.servo_id, parsed.code, parsed.parameters) == packet


@pytest.mark.parametrize(
    ("packet", "expected", "values"),
    [
        (lx16a.response(1, Command.POS_READ, 492), "55 55 01 05 1C EC 01 F0", (492,)),
        (lx16a.response(3, Command.ID_READ, 3), "55 55 03 04 0E 03 E7", (3,)),
    ],
)
def test_responses_match_published_bytes(packet: bytes, expected: str, values: tuple[int, ...]) -> None:
    assert packet == hexed(expected)
    (parsed,) = PacketParser().feed(packet)
    assert lx16a.values_of(parsed) == values


def test_lengths_match_document() -> None:
    """Compare with its tables of commands and of responses: command, length."""
    commands = {1: 7, 2: 3, 7: 7, 8: 3, 11: 3, 12: 3, 13: 4, 14: 3, 17: 4, 18: 3, 19: 3, 20: 7, 21: 3, 22: 7, 23: 3}
    commands |= {24: 4, 25: 3, 26: 3, 27: 3, 28: 3, 29: 7, 30: 3, 31: 4, 32: 3, 33: 4, 34: 3, 35: 4, 36: 3}
    responses = {2: 7, 8: 7, 14: 4, 19: 4, 21: 7, 23: 7, 25: 4, 26: 4, 27: 5, 28: 5, 30: 7, 32: 4, 34: 4, 36: 4}
    assert {int(c) for c in Command} == commands.keys()
    for command, layout in WRITES.items():
        assert lx16a.write(1, command, *(field.min for field in layout.fields))[3] == commands[command]
    for command, layout in READS.items():
        assert lx16a.read(1, command)[3] == commands[command]
        assert lx16a.response(1, command, *(field.min for field in layout.fields))[3] == responses[command]
    assert WRITES.keys() | READS.keys() == set(Command)
    assert not WRITES.keys() & READS.keys()


@WILD
@given(st.sampled_from(list(Command)), st.data())
def test_values_survive_round_trip(command: Command, data: st.DataObject) -> None:
    layout = WRITES.get(command) or READS[command]
    values = tuple(data.draw(st.integers(field.min, field.max)) for field in layout.fields)
    instructions = command in WRITES
    packet = (lx16a.write if instructions else lx16a.response)(7, command, *values)
    (parsed,) = PacketParser(instructions=instructions).feed(packet)
    assert (parsed.servo_id, parsed.code) == (7, command)
    assert lx16a.values_of(parsed) == values
    if not instructions:
        (asked,) = PacketParser(instructions=True).feed(lx16a.read(7, command))
        assert lx16a.values_of(asked) == ()


def test_negative_values_are_twos_complement() -> None:
    assert lx16a.write(1, Command.ANGLE_OFFSET_ADJUST, -125)[5] == 0x83
    assert lx16a.write(1, Command.MODE_WRITE, Mode.MOTOR, -1000)[5:-1] == hexed("01 00 18 FC")
    (below,) = PacketParser().feed(hexed("55 55 01 05 1C F6 FF E8"))
    assert lx16a.values_of(below) == (-10,)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: lx16a.write(1, Command.MOVE_TIME_WRITE, 1001, 0), r"position \[ticks\] takes 0 to 1000, found 1001"),
        (
            lambda: lx16a.write(1, Command.MOVE_TIME_WRITE, 500),
            r"2 values expected \(position \[ticks\], time \[ms\]\), found 1",
        ),
        (lambda: lx16a.write(1, Command.MOVE_STOP, 0), r"0 values expected \(none\), found 1"),
        (lambda: lx16a.write(1, Command.POS_READ), "writes expected, found POS_READ; use read"),
        (lambda: lx16a.read(1, Command.MOVE_STOP), "reads expected, found MOVE_STOP; use write"),
        (lambda: lx16a.read(254, Command.POS_READ), "no servo answers POS_READ for all ids"),
        (lambda: lx16a.encode(255, 1), "servo id 0 to 253, or 254 for all, expected, found 255"),
        (lambda: lx16a.encode(1, 1, bytes(5)), "at most 4 parameter bytes expected, found 5"),
    ],
)
def test_wrong_content_is_refused(call: object, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        call()  # type: ignore[operator]


def test_header_is_found_in_a_run_of_its_byte() -> None:
    """The id may be 55 too."""
    for servo_id in (0x54, 0x55, 4):
        answer = lx16a.response(servo_id, Command.VIN_READ, 0x5555)
        for run in range(6):
            parser = PacketParser()
            found = parser.feed(b"\x55" * run + answer) + parser.flush()
            assert [(p.servo_id, p.parameters) for p in found] == [(servo_id, b"\x55\x55")]


def test_unknown_command_and_id_are_no_packets() -> None:
    parser = PacketParser()
    assert parser.feed(hexed("55 55 FF 04 1A 28 BA")) == []
    assert parser.feed(lx16a.encode(1, 99) + lx16a.response(1, Command.TEMP_READ, 40))[0].code == Command.TEMP_READ


@WILD
@given(st.integers(0, 1000))
def test_angle_and_tick_conversions_are_inverse(ticks: int) -> None:
    assert lx16a.ticks_from_angle(lx16a.angle_from_ticks(ticks)) == ticks
    assert math.degrees(lx16a.angle_from_ticks(ticks)) == pytest.approx((ticks - 500) * 0.24)


def test_codes_match_document() -> None:
    assert [int(led) for led in (Led.ON, Led.OFF)] == [0, 1]
    assert Fault.OVERHEATING | Fault.INPUT_VOLTAGE | Fault.STALLED == 7
    assert lx16a.angle_from_ticks(lx16a.TICK_MAX) - lx16a.angle_from_ticks(0) == pytest.approx(math.radians(240))
