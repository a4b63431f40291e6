"""Bytes of Protocol 1.0: vectors of the manuals, round trips, and garbage.

The garbage lies between valid packets.
"""

import math
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sextant.shared.servo import dynamixel as dxl
from sextant.shared.servo.dynamixel import Dropped, Instruction, PacketParser
from sextant.shared.servo.models import AX_12A, RX_64
from sextant.shared.servo.servo_model import Access, ServoError, error_words

WILD = settings(deadline=None, derandomize=True)

PACKETS = st.tuples(st.integers(0, 0xFE), st.integers(0, 255), st.binary(max_size=60))


def hexed(text: str) -> bytes:
    return bytes.fromhex(text)


@pytest.mark.parametrize(
    ("packet", "expected"),
    [  # https://emanual.robotis.com/docs/en/dxl/protocol1/
        (dxl.ping(1), "FF FF 01 02 01 FB"),
        (dxl.status(1, 0), "FF FF 01 02 00 FC"),
        (dxl.status(1, 0x24), "FF FF 01 02 24 D8"),
        (dxl.read(1, 43, 1), "FF FF 01 04 02 2B 01 CC"),
        (dxl.status(1, 0, b"\x20"), "FF FF 01 03 00 20 DB"),
        (dxl.write(254, 3, b"\x01"), "FF FF FE 04 03 03 01 F6"),
        (dxl.reg_write(1, 30, hexed("F4 01")), "FF FF 01 05 04 1E F4 01 E2"),
        (dxl.action(), "FF FF FE 02 05 FA"),
        (dxl.reset(0), "FF FF 00 02 06 F7"),
        (dxl.status(1, 0, hexed("00 80")), "FF FF 01 04 00 00 80 7A"),
        (dxl.write(1, 12, bytes((100, 170))), "FF FF 01 05 03 0C 64 AA DC"),
        (
            dxl.sync_write(30, 4, [(0, hexed("10 00 50 01")), (1, hexed("20 02 60 03"))]),
            "FF FF FE 0E 83 1E 04 00 10 00 50 01 01 20 02 60 03 67",
        ),
        # AX-12 user's manual, 2006-06-14, chapter 5, examples 6 to 22
        (dxl.read(1, 0, 3), "FF FF 01 04 02 00 03 F5"),
        (dxl.status(1, 0, hexed("74 00 08")), "FF FF 01 05 00 74 00 08 7D"),
        (dxl.write(1, 3, b"\x00"), "FF FF 01 04 03 03 00 F4"),
        (dxl.write(0, 4, b"\x01"), "FF FF 00 04 03 04 01 F3"),
        (dxl.write(0, 5, b"\x02"), "FF FF 00 04 03 05 02 F1"),
        (dxl.write(0, 8, hexed("FF 01")), "FF FF 00 05 03 08 FF 01 EF"),
        (dxl.write(0, 11, b"\x50"), "FF FF 00 04 03 0B 50 9D"),
        (dxl.write(0, 24, b"\x01\x01"), "FF FF 00 05 03 18 01 01 DD"),
        (dxl.write(0, 26, hexed("01 01 40 40")), "FF FF 00 07 03 1A 01 01 40 40 59"),
        (dxl.write(0, 30, hexed("00 02 00 02")), "FF FF 00 07 03 1E 00 02 00 02 D3"),
        (dxl.reg_write(0, 30, hexed("00 00")), "FF FF 00 05 04 1E 00 00 D8"),
        (dxl.reg_write(1, 30, hexed("FF 03")), "FF FF 01 05 04 1E FF 03 D5"),
        (dxl.write(0, 47, b"\x01"), "FF FF 00 04 03 2F 01 C8"),
        (dxl.status(0, 8), "FF FF 00 02 08 F5"),
        (dxl.write(0, 14, hexed("FF 01")), "FF FF 00 05 03 0E FF 01 E9"),
        (dxl.status(0, 0), "FF FF 00 02 00 FD"),
        (dxl.write(0, 16, b"\x00"), "FF FF 00 04 03 10 00 E8"),
        (dxl.write(0, 17, b"\x04\x04"), "FF FF 00 05 03 11 04 04 DE"),
    ],
)
def test_packets_match_byte_vectors_of_manuals(packet: bytes, expected: str) -> None:
    assert packet == hexed(expected)
    (parsed,) = PacketParser().feed(packet)
    assert parsed.end == len(packet)
    assert dxl.encode(parsed.servo_id, parsed.code, parsed.parameters) == packet


def test_instruction_codes_match_manual() -> None:
    packets = {
        Instruction.PING: dxl.ping(3),
        Instruction.READ: dxl.read(3, 36, 8),
        Instruction.WRITE: dxl.write(3, 24, b"\x01"),
        Instruction.REG_WRITE: dxl.reg_write(3, 24, b"\x01"),
        Instruction.ACTION: dxl.action(),
        Instruction.RESET: dxl.reset(3),
        Instruction.SYNC_WRITE: dxl.sync_write(24, 1, [(3, b"\x01")]),
    }
    assert packets.keys() == set(Instruction)
    for instruction, packet in packets.items():
        assert packet[4] == instruction


@pytest.mark.parametrize(("servo_id", "size"), [(255, 0), (-1, 0), (1, 254)])
def test_oversized_packet_content_is_refused(servo_id: int, size: int) -> None:
    with pytest.raises(ValueError, match=r"expected|fit"):
        dxl.encode(servo_id, 1, bytes(size))


def test_sync_write_refuses_rows_of_unequal_size() -> None:
    with pytest.raises(ValueError, match="servo 7: 4 bytes expected, found 3"):
        dxl.sync_write(30, 4, [(7, bytes(3))])


@WILD
@given(st.lists(PACKETS, max_size=8), st.lists(st.integers(1, 20), max_size=200))
def test_packets_survive_any_split_of_stream(packets: list[tuple[int, int, bytes]], cuts: list[int]) -> None:
    stream = b"".join(dxl.encode(*packet) for packet in packets)
    parser, found, rest = PacketParser(), [], stream
    for cut in cuts:
        found += parser.feed(rest[:cut])
        rest = rest[cut:]
    found += parser.feed(rest)
    assert [(p.servo_id, p.code, p.parameters) for p in found] == packets
    assert not parser.dropped
    assert parser.pending == 0


GARBAGE = st.one_of(
    st.binary(max_size=40),
    st.lists(st.sampled_from([0xFF, 0xFF, 0, 1, 2, 4, 200]), max_size=40).map(bytes),  # false headers
)


@WILD
@given(st.lists(st.tuples(GARBAGE, PACKETS), min_size=1, max_size=6), GARBAGE)
def test_valid_packets_are_found_between_garbage(pairs: list[tuple[bytes, tuple[int, int, bytes]]], tail: bytes) -> None:
    parser, stream, ends = PacketParser(), bytearray(), {}
    for noise, packet in pairs:
        stream += noise + dxl.encode(*packet)
        ends[len(stream)] = packet
    stream += tail
    found = parser.feed(bytes(stream)) + parser.flush()
    assert parser.pending == 0
    for p in found:  # each found packet is on the wire at its stated position
        raw = dxl.encode(p.servo_id, p.code, p.parameters)
        assert stream[p.end - len(raw) : p.end] == raw
    spans = [(p.end - len(p.parameters) - dxl.OVERHEAD, p.end) for p in found]
    assert all(a[1] <= b[0] for a, b in pairwise(spans))
    for end, packet in ends.items():
        start = end - len(packet[2]) - dxl.OVERHEAD
        # Only garbage that is itself an intact packet with the good one's first bytes can hide it.
        assert (start, end) in spans or any(a < end and start < b for a, b in spans)


@WILD
@given(st.binary(max_size=300))
def test_corrupted_packet_is_never_accepted(data: bytes) -> None:
    parser = PacketParser(keep_broken=True)
    for packet in parser.feed(data):
        raw = dxl.encode(packet.servo_id, packet.code, packet.parameters) if packet.servo_id <= 0xFE else b""
        assert packet.intact == (data[packet.end - len(raw) : packet.end] == raw)


def test_dropped_packets_are_counted_by_reason() -> None:
    parser = PacketParser(max_length=20)
    good, broken = dxl.ping(9), bytearray(dxl.ping(9))
    broken[-1] ^= 1
    assert [p.servo_id for p in parser.feed(b"abc" + good)] == [9]
    assert parser.dropped == {Dropped.NOISE: 3}
    assert parser.feed(bytes(broken)) == []
    assert parser.dropped[Dropped.CHECKSUM] == 1
    parser.feed(hexed("FF FF 09 01 00 00"))
    parser.feed(hexed("FF FF 09 C8 00 00"))
    assert parser.dropped[Dropped.LENGTH] == 2
    assert parser.feed(hexed("FF FF 09 0A 00") + good) == []  # announces more bytes than arrive
    assert [p.servo_id for p in parser.flush()] == [9]
    assert parser.dropped[Dropped.TRUNCATED] == 1


def test_header_is_last_two_bytes_of_ff_run() -> None:
    assert [p.servo_id for p in PacketParser().feed(b"\xff" * 5 + dxl.ping(4)[2:])] == [4]


def test_registers_do_not_overlap_and_have_unique_names() -> None:
    assert len({r.name for r in dxl.REGISTERS}) == len(dxl.REGISTERS) == 32
    end = 0
    for register in dxl.REGISTERS:
        assert register.address >= end
        end = register.address + register.size
        assert register.min <= register.default <= register.max
        assert register.eeprom == (register.address < 24)
        assert register.size == 1 or register.address % 2 == 0
    assert end == dxl.TABLE_SIZE
    read_only = {r.address for r in dxl.REGISTERS if r.access is Access.READ}
    assert read_only == {0, 2, 36, 38, 40, 42, 43, 44, 46}


def test_models_differ_as_in_manual() -> None:
    ax, rx = AX_12A.factory_table(), RX_64.factory_table()
    assert {i: (a, b) for i, (a, b) in enumerate(zip(ax, rx, strict=True)) if a != b} == {
        0: (12, 64),
        4: (1, 34),
        11: (70, 80),
        13: (140, 190),
    }
    assert dxl.baud_rate(ax[4]) == 1_000_000
    assert dxl.baud_rate(rx[4]) == 57_143


@WILD
@given(st.integers(0, 1023))
def test_angle_and_tick_conversions_are_inverse(ticks: int) -> None:
    angle = dxl.angle_from_ticks(ticks)
    assert dxl.ticks_from_angle(angle) == ticks
    assert math.degrees(angle) == pytest.approx((ticks - 512) * 300 / 1023)


def test_zero_angle_is_center_and_one_degree_is_3_41_ticks() -> None:
    assert dxl.angle_from_ticks(512) == 0.0
    assert dxl.ticks_from_angle(math.radians(100)) - 512 == pytest.approx(341, abs=0.5)


@WILD
@given(st.integers(-1023, 1023))
def test_signed_register_conversions_are_inverse(value: int) -> None:
    raw = dxl.direction_magnitude(value)
    assert dxl.signed_magnitude(raw) == value
    assert bool(raw & 1 << 10) == (value < 0)
    assert dxl.register_from_speed(dxl.speed_from_register(raw)) == raw
    assert dxl.register_from_load(dxl.load_from_register(raw)) == raw


def test_register_units_match_manual() -> None:
    assert dxl.speed_from_register(300) == pytest.approx(33.3 * 2 * math.pi / 60)
    assert dxl.load_from_register(512) == pytest.approx(0.512)
    assert dxl.load_from_register(1024 + 512) == pytest.approx(-0.512)
    assert dxl.signed_magnitude(1024) == 0


@WILD
@given(st.floats(1e-6, 100.0))
def test_speed_is_never_encoded_as_uncontrolled(speed: float) -> None:
    assert 1 <= dxl.moving_speed_from(speed) <= 1023


@pytest.mark.parametrize("speed", [0.0, -1.0, math.nan])
def test_moving_speed_must_be_positive(speed: float) -> None:
    with pytest.raises(ValueError, match="greater than 0"):
        dxl.moving_speed_from(speed)


def test_error_bits_have_descriptions() -> None:
    assert error_words(0) == ""
    assert error_words(0x24) == "overheating, overload"
    assert all(error_words(bit) for bit in ServoError)
    assert sorted(ServoError) == [1, 2, 4, 8, 16, 32, 64, 128]


def test_register_encoding_checks_range() -> None:
    assert dxl.GOAL_POSITION.encode(0x0210) == b"\x10\x02"
    with pytest.raises(ValueError, match="goal position takes 0 to 1023, found 1024"):
        dxl.GOAL_POSITION.encode(1024)
