"""Bytes of Dynamixel Protocol 2.0: vectors of the e-manual, byte stuffing, fast reads, and damage.

Vectors: https://emanual.robotis.com/docs/en/dxl/protocol2/, examples of each instruction.
"""

import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sextant.shared.servo import dynamixel
from sextant.shared.servo import dynamixel2 as dxl
from sextant.shared.servo.dynamixel2 import Error, Instruction, PacketParser
from sextant.shared.servo.servo_model import Packet, ServoError
from sextant.shared.servo.stream_parser import Dropped

WILD = settings(deadline=None, derandomize=True, max_examples=80)
hexed = bytes.fromhex

INSTRUCTIONS = [
    (dxl.ping(1), "FF FF FD 00 01 03 00 01 19 4E"),
    (dxl.ping(254), "FF FF FD 00 FE 03 00 01 31 42"),
    (dxl.read(1, 132, 4), "FF FF FD 00 01 07 00 02 84 00 04 00 1D 15"),
    (dxl.write(1, 116, hexed("00 02 00 00")), "FF FF FD 00 01 09 00 03 74 00 00 02 00 00 CA 89"),
    (dxl.reg_write(1, 104, hexed("C8 00 00 00")), "FF FF FD 00 01 09 00 04 68 00 C8 00 00 00 AE 8E"),
    (dxl.action(1), "FF FF FD 00 01 03 00 05 02 CE"),
    (dxl.reset(1, dxl.Reset.ALL_BUT_ID), "FF FF FD 00 01 04 00 06 01 A1 E6"),
    (dxl.reboot(1), "FF FF FD 00 01 03 00 08 2F 4E"),
    (dxl.clear(1), "FF FF FD 00 01 08 00 10 01 44 58 4C 22 B1 DC"),
    (dxl.sync_read(132, 4, [1, 2]), "FF FF FD 00 FE 09 00 82 84 00 04 00 01 02 CE FA"),
    (
        dxl.sync_write(116, 4, [(1, hexed("96 00 00 00")), (2, hexed("AA 00 00 00"))]),
        "FF FF FD 00 FE 11 00 83 74 00 04 00 01 96 00 00 00 02 AA 00 00 00 82 87",
    ),
    (dxl.fast_sync_read(132, 4, [3, 7, 4]), "FF FF FD 00 FE 0A 00 8A 84 00 04 00 03 07 04 20 F2"),
    (dxl.bulk_read([(1, 144, 2), (2, 146, 1)]), "FF FF FD 00 FE 0D 00 92 01 90 00 02 00 02 92 00 01 00 1A 05"),
    (
        dxl.bulk_write([(1, 32, hexed("A0 00")), (2, 31, b"\x50")]),
        "FF FF FD 00 FE 10 00 93 01 20 00 02 00 A0 00 02 1F 00 01 00 50 B7 68",
    ),
]
STATUSES = [
    ((1, 0, hexed("06 04 26")), "FF FF FD 00 01 07 00 55 00 06 04 26 65 5D"),
    ((2, 0, hexed("06 04 26")), "FF FF FD 00 02 07 00 55 00 06 04 26 6F 6D"),
    ((1, 0, hexed("A6 00 00 00")), "FF FF FD 00 01 08 00 55 00 A6 00 00 00 8C C0"),
    ((2, 0, hexed("1F 08 00 00")), "FF FF FD 00 02 08 00 55 00 1F 08 00 00 BA BE"),
    ((1, 0, b""), "FF FF FD 00 01 04 00 55 00 A1 0C"),
    ((1, 0, hexed("77 00")), "FF FF FD 00 01 06 00 55 00 77 00 C3 69"),
    ((2, 0, b"\x24"), "FF FF FD 00 02 05 00 55 00 24 8B A9"),
]
# Rows of id, error and data, and the response to a fast read.
FAST_SYNC = (
    [(3, 0, hexed("A6 00 00 00")), (7, 0, hexed("1F 08 00 00")), (4, 0, hexed("FF 03 00 00"))],
    "FF FF FD 00 FE 19 00 55 00 03 A6 00 00 00 84 08  00 07 1F 08 00 00 16 CA  00 04 FF 03 00 00 D1 9E",
)
FAST_BULK = (
    [(3, 0, hexed("A6 00 00 00")), (7, 0, hexed("A5 01")), (4, 0, b"\x1f")],
    "FF FF FD 00 FE 14 00 55 00 03 A6 00 00 00 67 A4  00 07 A5 01 24 74  00 04 1F D9 C1",
)


@pytest.mark.parametrize(("packet", "expected"), INSTRUCTIONS)
def test_instructions_match_byte_vectors_of_manual(packet: bytes, expected: str) -> None:
    assert packet == hexed(expected)
    (parsed,) = PacketParser(instructions=True).feed(packet)
    assert parsed.end == len(packet)
    assert dxl.encode(parsed.servo_id, parsed.code, parsed.parameters) == packet


@pytest.mark.parametrize(("content", "expected"), STATUSES)
def test_status_packets_match_byte_vectors_of_manual(content: tuple[int, int, bytes], expected: str) -> None:
    assert dxl.status(*content) == hexed(expected)
    (packet,) = PacketParser().feed(hexed(expected))
    assert packet == (*content, len(hexed(expected)), True)


def test_fast_bulk_read_differs_from_bulk_read_in_instruction() -> None:
    """The CRC of this instruction in the e-manual is that of another example."""
    rows = [(3, 132, 4), (7, 124, 2), (4, 146, 1)]
    slow, fast = dxl.bulk_read(rows), dxl.fast_bulk_read(rows)
    assert fast[:-2] == hexed("FF FF FD 00 FE 12 00 9A 03 84 00 04 00 07 7C 00 02 00 04 92 00 01 00")
    assert fast[8:-2] == slow[8:-2]


def test_crc_matches_check_value() -> None:
    """Compare with CRC-16/UMTS in the catalogue of parametrised CRC algorithms, https://reveng.sourceforge.io."""
    assert dxl.crc16(b"123456789") == 0xFEE8
    assert dxl.crc16(b"6789", dxl.crc16(b"12345")) == 0xFEE8
    assert dxl.crc16(b"") == 0


# ---------------------------------------------------------------------------------------------- byte stuffing

MARKS = st.lists(st.sampled_from([b"\xff", b"\xfd", b"\0", b"\xff\xff\xfd", dxl.HEADER, b"\x55"]), max_size=12).map(b"".join)


@WILD
@given(MARKS, MARKS)
def test_no_header_occurs_inside_a_packet(before: bytes, after: bytes) -> None:
    data = before + b"\xff\xff\xfd" + after
    packet = dxl.write(5, 0xFDFF, data)
    assert dxl.HEADER not in packet[4:-2]
    (parsed,) = PacketParser(instructions=True).feed(packet)
    assert parsed.parameters == b"\xff\xfd" + data
    assert len(packet) > 12 + len(data)


def test_every_position_of_a_header_is_stuffed() -> None:
    for size in range(8):
        data = bytes(size) + b"\xff\xff\xfd" + bytes(3)
        packet = dxl.status(1, 0, data)
        assert packet[9:-2] == bytes(size) + b"\xff\xff\xfd\xfd" + bytes(3)
        assert PacketParser().feed(packet)[0].parameters == data
        assert packet[5] == len(data) + 5


def test_stuffing_includes_error_byte() -> None:
    packet = dxl.status(1, 0xFF, b"\xff\xfd")
    assert packet[8:-2] == b"\xff\xff\xfd\xfd"
    assert PacketParser().feed(packet)[0][:3] == (1, 0xFF, b"\xff\xfd")


def test_crc_that_looks_like_a_header_ends_no_packet() -> None:
    """Find packets whose last bytes and CRC are FF FF FD 00, or parts of it."""
    found = 0
    for number in range(1 << 16):
        packet = dxl.status(1, 0, number.to_bytes(2, "little") + b"\xff\xff")
        if packet[-2:] == b"\xfd\0":
            found += 1
            for parser in (PacketParser(), PacketParser()):
                parser.feed(packet[: 3 * found % len(packet)])
                assert len(parser.feed(packet[3 * found % len(packet) :])) == 1
    assert found == 1


def test_longest_answer_fits_its_parser() -> None:
    for size in range(20):
        parser = dxl.answer_parser(size)
        for data in (bytes(size), (b"\xff\xff\xfd" * size)[:size], (b"\xff\xfd\xff" * size)[:size]):
            for error in (0, 0xFF):
                assert [p.parameters for p in parser.feed(dxl.status(9, error, data))] == [data]
        assert parser.feed(dxl.status(9, 0, bytes(2 * size + 8))) == []


# ------------------------------------------------------------------------------------------------- truncation


@WILD
@given(st.integers(8, 30), st.integers(0, 252), st.binary(max_size=20))
def test_packet_after_truncated_one_is_found_at_once(cut: int, servo_id: int, data: bytes) -> None:
    parser = PacketParser()
    whole = dxl.status(servo_id, 0, data)
    found = parser.feed(dxl.status(3, 0, bytes(100))[:cut] + whole)
    assert [(p.servo_id, p.parameters) for p in found] == [(servo_id, data)]
    assert parser.dropped[Dropped.TRUNCATED] == 1
    assert parser.pending == 0


def test_intact_bytes_that_no_sender_sends_are_no_packets() -> None:
    def with_crc(text: str) -> bytes:
        return hexed(text) + dxl.crc16(hexed(text)).to_bytes(2, "little")

    parser = PacketParser()
    assert parser.feed(with_crc("FF FF FD 00 01 03 00 55")) == [], "a status packet without error byte"
    assert parser.dropped[Dropped.LENGTH] == 1
    for servo_id in ("FD", "FF"):
        assert parser.feed(with_crc(f"FF FF FD 00 {servo_id} 04 00 55 00")) == []
    assert parser.dropped.total() - parser.dropped[Dropped.NOISE] == 1


def test_random_bytes_pass_at_crc_odds() -> None:
    rng, believed, parser = random.Random(0), 0, PacketParser()
    for _ in range(30_000):
        believed += len(parser.feed(hexed("FF FF FD 00 05 08 00 55") + rng.randbytes(7)))
        believed += len(parser.flush())
    assert believed <= 4, "0.5 are expected"


# -------------------------------------------------------------------------------------------------- fast read


@pytest.mark.parametrize(("rows", "expected"), [FAST_SYNC, FAST_BULK])
def test_combined_status_matches_byte_vectors_of_manual(rows: list[tuple[int, int, bytes]], expected: str) -> None:
    raw = hexed(expected)
    assert dxl.combined_status(rows) == raw
    sizes = [len(data) for _, _, data in rows]
    assert dxl.combined_length(sizes) == raw[5]
    for packets in (PacketParser().feed(raw), [p for byte in [PacketParser()] for n in raw for p in byte.feed(bytes((n,)))]):
        (packet,) = packets
        assert packet.servo_id == dxl.BROADCAST_ID
        assert [row[:3] for row in dxl.split_status(packet, sizes)] == rows


ROWS = st.lists(st.tuples(st.integers(0, 252), st.integers(0, 255), st.one_of(st.binary(max_size=12), MARKS)), max_size=6)


@WILD
@given(ROWS, st.lists(st.integers(1, 20), max_size=40))
def test_combined_status_survives_any_split(rows: list[tuple[int, int, bytes]], cuts: list[int]) -> None:
    sizes, parser, found = [len(data) for _, _, data in rows], PacketParser(), []
    stream = dxl.combined_status(rows) + dxl.status(9, 0, b"end") if rows else dxl.status(9, 0, b"end")
    for cut in cuts:
        found += parser.feed(stream[:cut])
        stream = stream[cut:]
    found += parser.feed(stream)
    if rows:
        assert [row[:3] for row in dxl.split_status(found.pop(0), sizes)] == rows
    assert [p.parameters for p in found] == [b"end"]
    assert not parser.dropped


@WILD
@given(ROWS.filter(bool), st.data())
def test_whole_parts_of_a_cut_combined_status_are_found(rows: list[tuple[int, int, bytes]], data: st.DataObject) -> None:
    raw, sizes = dxl.combined_status(rows), [len(d) for _, _, d in rows]
    cut = data.draw(st.integers(9, len(raw) - 1))
    parser = PacketParser(keep_broken=True)
    found = [p for p in parser.feed(raw[:cut]) + parser.flush() if p.servo_id == dxl.BROADCAST_ID]
    ends = [8 + sum(sizes[:n]) + 4 * n for n in range(1, len(rows) + 1)]
    whole = [row for row, end in zip(rows, ends, strict=True) if end <= cut]
    assert not found[0].intact
    assert parser.pending == 0
    assert [row[:3] for row in dxl.split_status(found[0], sizes)] == whole
    assert all(row.intact for row in dxl.split_status(found[0], sizes))


@given(st.integers(1, 6), st.data())
def test_spoilt_part_of_a_combined_status_leaves_the_others_whole(count: int, data: st.DataObject) -> None:
    rows = [(k + 1, 0, bytes([k, 7, 9])) for k in range(count)]
    index = data.draw(st.integers(0, count - 1))
    noise = data.draw(st.binary(min_size=7, max_size=7))
    raw = dxl.combined_status(rows)
    spoilt = dxl.with_part(raw, count, index, lambda size: noise[:size])
    assert len(spoilt) == len(raw)
    (packet,) = (parser := PacketParser(dxl.combined_length([3] * count), keep_broken=True)).feed(spoilt) + parser.flush()
    found = {one.servo_id: bytes(one.parameters) for one in dxl.split_status(packet, [3] * count)}
    by_chance = noise[5:] == dxl.crc16(spoilt[: 8 + 7 * index + 5]).to_bytes(2, "little")
    assert {servo_id: row for servo_id, _, row in rows if servo_id != index + 1}.items() <= found.items() or by_chance
    assert index + 1 not in found or by_chance


def test_combined_status_without_a_part_is_not_kept() -> None:
    parser = PacketParser(keep_broken=True)
    parser.feed(dxl.combined_status(FAST_SYNC[0])[:8])
    assert parser.flush() == []
    assert parser.dropped[Dropped.TRUNCATED] == 1


def test_part_with_wrong_crc_is_left_out() -> None:
    rows, expected = FAST_SYNC
    for spoilt in range(3):
        raw = bytearray(hexed(expected))
        raw[10 + 8 * spoilt] ^= 1
        for at in range(14 + 8 * (spoilt + 1), len(raw), 8):  # the next servos compute their CRC from the spoilt byte
            raw[at : at + 2] = dxl.crc16(bytes(raw[:at])).to_bytes(2, "little")
        (packet,) = PacketParser(keep_broken=True).feed(bytes(raw))
        assert packet.intact == (spoilt < 2)
        assert [row[:3] for row in dxl.split_status(packet, [4, 4, 4])] == [row for n, row in enumerate(rows) if n != spoilt]


def test_sizes_of_another_read_give_no_parts() -> None:
    (packet,) = PacketParser().feed(dxl.combined_status(FAST_SYNC[0]))
    assert dxl.split_status(packet, [4, 4]) == []
    assert dxl.split_status(packet, [4, 4, 5]) == []
    assert dxl.split_status(packet._replace(intact=False), [4, 4, 3]) == []


# ------------------------------------------------------------------------------------------ errors, bad input


def test_error_bytes_have_descriptions() -> None:
    assert dxl.error_words(0) == ""
    assert dxl.error_words(dxl.ALERT) == "hardware error"
    assert dxl.error_words(dxl.ALERT | Error.DATA_RANGE) == "value out of range, hardware error"
    assert dxl.error_words(0x7F) == "unknown error 127"
    assert all(dxl.error_words(error) for error in Error if error)


def test_errors_have_bits_of_protocol_1() -> None:
    assert len(dxl.ERRORS) == 256
    assert dxl.ERRORS[dxl.ALERT | Error.ACCESS] is dxl.ERRORS[Error.ACCESS] is ServoError.RANGE
    assert {number for number in range(128) if dxl.ERRORS[number]} == {int(error) for error in Error if error}


def test_instruction_numbers_match_manual() -> None:
    assert {int(i) for i in Instruction} == {1, 2, 3, 4, 5, 6, 8, 0x10, 0x55, 0x82, 0x83, 0x8A, 0x92, 0x93, 0x9A}
    assert {packet[7] for packet, _ in INSTRUCTIONS} == {int(i) for i in Instruction} - {0x55, 0x9A}
    assert dxl.action()[4] == dxl.BROADCAST_ID


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: dxl.ping(253), "servo id 0 to 252, or 254 for all, expected, found 253"),
        (lambda: dxl.ping(-1), "found -1"),
        (lambda: dxl.write(1, 0, bytes(65_532)), "at most 65533 bytes .* found 65535; split it"),
        (lambda: dxl.read(1, 65_536, 1), "address or size 0 to 65535 expected, found 65536"),
        (lambda: dxl.sync_read(0, 1, [1, 254]), "servo id 0 to 252 expected, found 254"),
        (lambda: dxl.sync_write(116, 4, [(7, bytes(3))]), "servo 7: 4 bytes expected, found 3"),
        (lambda: dxl.bulk_read([(256, 0, 1)]), "servo id 0 to 252 expected, found 256"),
    ],
)
def test_wrong_content_is_refused(call: object, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        call()  # type: ignore[operator]


def test_names_are_those_of_protocol_1() -> None:
    """Callers may use either module."""
    shared = {"BROADCAST_ID", "MAX_ID", "OVERHEAD", "HEADER", "Instruction", "PacketParser", "encode"}
    shared |= {"ping", "read", "write", "reg_write", "action", "reset", "sync_write", "status"}
    for module in (dynamixel, dxl):
        assert shared <= vars(module).keys()
    assert len(dxl.status(1, 0, bytes(5))) == dxl.OVERHEAD + 5
    assert dxl.status(7, 0).startswith(dxl.answer_start(7))
    assert len(STATUSES[0][0][2]) == dxl.PING_SIZE
    assert isinstance(PacketParser().feed(dxl.status(1, 0))[0], Packet)
