"""Packets of the firmware are those of the host's protocols, and its parser finds answers in any bytes."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sextant.shared.servo import dynamixel, dynamixel2, lewansoul, lx16a
from sextant.shared.servo.firmware import packets
from sextant.shared.servo.firmware.packets import BROADCAST_ID, LewanSoul, Parser, Protocol1, Protocol2

WILD = settings(deadline=None, derandomize=True, max_examples=200)
BOTH = pytest.mark.parametrize(("ours", "theirs"), [(Protocol1(), dynamixel), (Protocol2(), dynamixel2)], ids=["1.0", "2.0"])
IDS = st.integers(0, dynamixel2.MAX_ID)
# Many of these bytes are those of headers, so that byte stuffing matters.
DATA = st.lists(st.sampled_from([0xFF, 0xFD, 0x00, 0x55]) | st.integers(0, 255), max_size=60).map(bytes)


@BOTH
@WILD
@given(IDS, st.integers(0, 147), st.integers(1, 100), DATA.filter(len))
def test_instructions_match_host(ours, theirs, servo_id: int, address: int, size: int, data: bytes) -> None:  # type: ignore[no-untyped-def]
    assert ours.ping(servo_id) == theirs.ping(servo_id)
    assert ours.read(servo_id, address, size) == theirs.read(servo_id, address, size)
    assert ours.write(BROADCAST_ID, address, data) == theirs.write(BROADCAST_ID, address, data)
    rows = bytes((servo_id,)) + data
    assert ours.sync_write(address, len(data), rows) == theirs.sync_write_rows(address, len(data), rows)
    assert ours.reboot(servo_id) in (b"", dynamixel2.reboot(servo_id))


@BOTH
@WILD
@given(DATA, IDS, DATA, st.integers(0, 0x7F), st.integers(1, 200))
def test_answer_is_found_after_any_bytes(ours, theirs, noise, servo_id, data, error, cut) -> None:  # type: ignore[no-untyped-def]
    parser = Parser(ours, 100)
    parser.feed(noise)
    parser.flush()
    sent = theirs.status(servo_id, error, data)
    assert parser.feed(sent[:cut]) + parser.feed(sent[cut:]) == [(servo_id, error, data)]


@BOTH
@WILD
@given(st.lists(st.tuples(IDS, DATA), min_size=1, max_size=4), st.data())
def test_parser_agrees_with_host_on_broken_answers(ours, theirs, answers, data: st.DataObject) -> None:  # type: ignore[no-untyped-def]
    stream = bytearray(b"".join(theirs.status(servo_id, 0, content) for servo_id, content in answers))
    for _ in range(data.draw(st.integers(0, 3))):
        stream[data.draw(st.integers(0, len(stream) - 1))] ^= data.draw(st.integers(1, 255))
    ours_parser, their_parser = Parser(ours, 100), theirs.answer_parser(100)
    found = ours_parser.feed(bytes(stream)) + ours_parser.flush()
    expected = [packet[:3] for packet in their_parser.feed(bytes(stream)) + their_parser.flush()]
    assert found == [packet for packet in expected if packet[0] <= theirs.MAX_ID] or theirs is dynamixel
    if theirs is dynamixel:
        assert found == expected
    assert bool(ours_parser.dropped) == bool(their_parser.dropped.total())


COMMANDS = st.sampled_from(sorted(lx16a.READS))


def answers() -> st.SearchStrategy[tuple[int, int, bytes]]:
    """Return answers of LewanSoul servos: id, command and parameters."""
    sized = COMMANDS.flatmap(lambda c: st.tuples(st.just(int(c)), st.binary(min_size=size_of(c), max_size=size_of(c))))
    return st.tuples(IDS, sized).map(lambda found: (found[0], *found[1]))


def size_of(command: lx16a.Command) -> int:
    return lx16a.READS[command].struct.size


def test_lewansoul_commands_match_host() -> None:
    ours, sizes = LewanSoul(), {int(command): layout.struct.size for command, layout in lx16a.WRITES.items()}
    assert {int(command): size_of(command) for command in lx16a.READS} == packets.READS
    assert {command: size for command, size in sizes.items() if size} == packets.WRITES
    assert (ours.OVERHEAD, ours.PING_SIZE) == (lewansoul.OVERHEAD, lewansoul.PING_SIZE)
    for servo_id in (0, 7, 253):
        assert ours.ping(servo_id) == lewansoul.ping(servo_id)
        for command in lx16a.READS:
            asked = ours.read(servo_id, command, size_of(command))
            assert asked == lx16a.read(servo_id, command)
            assert ours.answer_code(asked) == lewansoul.answer_code(asked)
        for command, size in packets.WRITES.items():
            data = bytes(range(0x53, 0x53 + size))
            assert ours.write(servo_id, command, data) == lx16a.encode(servo_id, command, data)
    assert ours.write(BROADCAST_ID, 31, b"\0") == lx16a.write(lx16a.BROADCAST_ID, lx16a.Command.LOAD_OR_UNLOAD_WRITE, 0)


@WILD
@given(st.lists(st.sampled_from([0x55, 0x07, 0x03, 0x1C]) | st.integers(0, 255), max_size=60), answers(), st.integers(1, 12))
def test_lewansoul_answer_is_found_after_any_bytes(noise: list[int], answer: tuple[int, int, bytes], cut: int) -> None:
    parser = Parser(LewanSoul(), 200)
    parser.feed(bytes(noise))
    parser.flush()
    sent = lewansoul.status(*answer)
    assert parser.feed(sent[:cut]) + parser.feed(sent[cut:]) == [answer]


@WILD
@given(st.lists(answers(), min_size=1, max_size=4), st.data())
def test_lewansoul_parser_agrees_with_host_on_broken_answers(sent: list[tuple[int, int, bytes]], data: st.DataObject) -> None:
    stream = bytearray(b"".join(lewansoul.status(*answer) for answer in sent))
    for _ in range(data.draw(st.integers(0, 3))):
        stream[data.draw(st.integers(0, len(stream) - 1))] ^= data.draw(st.integers(1, 255))
    ours, theirs = Parser(LewanSoul(), 200), lx16a.PacketParser()
    found = ours.feed(bytes(stream)) + ours.flush()
    assert found == [packet[:3] for packet in theirs.feed(bytes(stream)) + theirs.flush()]
    assert bool(ours.dropped) == bool(theirs.dropped.total())
