"""Packets in damaged streams: laws that hold for Dynamixel Protocol 2.0 and for the LX-16A."""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sextant.shared.servo import dynamixel, dynamixel2, lx16a
from sextant.shared.servo.servo_model import Packet
from sextant.shared.servo.stream_parser import Dropped, StreamParser

WILD = settings(deadline=None, derandomize=True, max_examples=60)
Content = tuple[int, int, bytes]  # id, error or command, parameters


@dataclass(frozen=True)
class Bus:
    name: str
    parser: Callable[[], StreamParser]
    commands: Callable[[], StreamParser]
    encode: Callable[[int, int, bytes], bytes]
    contents: st.SearchStrategy[Content]
    command: bytes  # from the host
    alphabet: bytes  # of which false headers consist

    def raw(self, packet: Packet) -> bytes:
        return self.encode(packet.servo_id, packet.code, packet.parameters)

    def garbage(self) -> st.SearchStrategy[bytes]:
        whole = self.contents.map(lambda content: self.encode(*content))
        cut = st.tuples(whole, st.integers(0, 40)).map(lambda cut: cut[0][: cut[1]])
        return st.one_of(st.binary(max_size=40), st.lists(st.sampled_from(self.alphabet), max_size=40).map(bytes), cut)


def read_data(command: lx16a.Command) -> st.SearchStrategy[Content]:
    size = lx16a.READS[command].struct.size
    return st.tuples(st.integers(0, 253), st.just(int(command)), st.binary(min_size=size, max_size=size))


STUFFED = st.lists(st.sampled_from([b"\xff", b"\xfd", b"\0", dynamixel2.HEADER, b"\xff\xff\xfd"]), max_size=12).map(b"".join)
BUSES = (
    Bus(
        "dynamixel2",
        dynamixel2.PacketParser,
        lambda: dynamixel2.PacketParser(instructions=True),
        dynamixel2.status,
        st.tuples(st.integers(0, 252), st.integers(0, 255), st.one_of(st.binary(max_size=60), STUFFED)),
        dynamixel2.write(3, 116, b"\xff\xff\xfd\0"),
        b"\xff\xff\xff\xfd\xfd\0\0\x01\x03\x07\x55\xfe",
    ),
    Bus(
        "lx16a",
        lx16a.PacketParser,
        lambda: lx16a.PacketParser(instructions=True),
        lx16a.encode,
        st.sampled_from(list(lx16a.READS)).flatmap(read_data),
        lx16a.write(3, lx16a.Command.MOVE_TIME_WRITE, 500, 1000),
        b"\x55\x55\x55\x01\x03\x04\x05\x07\x1c\x1f",
    ),
)
each_bus = pytest.mark.parametrize("bus", BUSES, ids=lambda bus: bus.name)


def fed(parser: StreamParser, stream: bytes, cuts: list[int]) -> list[Packet]:
    found = []
    for cut in cuts:
        found += parser.feed(stream[:cut])
        stream = stream[cut:]
    return found + parser.feed(stream)


def size_of(packets: list[Packet], bus: Bus) -> int:
    return sum(len(bus.raw(packet)) for packet in packets)


@each_bus
@WILD
@given(st.data())
def test_packets_survive_any_split_of_stream(bus: Bus, data: st.DataObject) -> None:
    contents = data.draw(st.lists(bus.contents, max_size=8))
    cuts = data.draw(st.lists(st.integers(1, 20), max_size=80))
    parser, stream = bus.parser(), b"".join(bus.encode(*content) for content in contents)
    found = fed(parser, stream, cuts)
    assert [(p.servo_id, p.code, p.parameters) for p in found] == contents
    assert all(p.intact for p in found)
    assert [p.end for p in found] == [size_of(found[: n + 1], bus) for n in range(len(found))]
    assert not parser.dropped
    assert parser.pending == 0


@each_bus
@WILD
@given(st.data())
def test_split_does_not_change_what_is_found_in_damaged_stream(bus: Bus, data: st.DataObject) -> None:
    parts = data.draw(st.lists(st.one_of(bus.garbage(), bus.contents.map(lambda c: bus.encode(*c))), max_size=6))
    stream, cuts = b"".join(parts), data.draw(st.lists(st.integers(1, 9), max_size=60))
    whole, split = bus.parser(), bus.parser()
    assert whole.feed(stream) + whole.flush() == fed(split, stream, cuts) + split.flush()
    assert whole.dropped == split.dropped


@each_bus
@WILD
@given(st.data())
def test_valid_packets_are_found_between_garbage(bus: Bus, data: st.DataObject) -> None:
    pairs = data.draw(st.lists(st.tuples(bus.garbage(), bus.contents), min_size=1, max_size=6))
    parser, stream, spans = bus.parser(), b"", []
    for noise, content in pairs:
        raw = bus.encode(*content)
        stream += noise + raw
        spans.append((len(stream) - len(raw), len(stream)))
    stream += data.draw(bus.garbage())
    found = parser.feed(stream) + parser.flush()
    assert parser.pending == 0
    found_spans = [(p.end - len(bus.raw(p)), p.end) for p in found]
    for p, (start, end) in zip(found, found_spans, strict=True):  # each is on the wire at its stated position
        assert stream[start:end] == bus.raw(p)
    assert all(a[1] <= b[0] for a, b in pairwise(found_spans))
    for start, end in spans:
        # Only garbage that is itself an intact packet with the good one's first bytes can hide it.
        assert (start, end) in found_spans or any(a < end and start < b for a, b in found_spans)
    # Each byte is in a packet, is noise, or is the first one of a broken packet.
    if Dropped.DIRECTION not in parser.dropped:
        assert len(stream) == size_of(found, bus) + parser.dropped.total()


@each_bus
@WILD
@given(st.data())
def test_flipped_bits_are_never_believed(bus: Bus, data: st.DataObject) -> None:
    raw = bytearray(bus.encode(*data.draw(bus.contents)))
    flips = 1 if bus.name == "lx16a" else data.draw(st.integers(1, 3))  # which its checksum is sure to detect
    for bit in data.draw(st.lists(st.integers(0, 8 * len(raw) - 1), min_size=flips, max_size=flips, unique=True)):
        raw[bit // 8] ^= 1 << bit % 8
    parser = bus.parser()
    assert parser.feed(bytes(raw)) + parser.flush() == []


@each_bus
def test_parser_returns_one_direction(bus: Bus) -> None:
    answer = bus.encode(*{"dynamixel2": (3, 0, b"\x01"), "lx16a": (3, 26, b"\x28")}[bus.name])
    for parser, wanted in ((bus.parser(), answer), (bus.commands(), bus.command)):
        (whole,) = parser.feed(bus.command + answer)
        assert parser.dropped == {Dropped.DIRECTION: 1}
        assert whole.servo_id == 3
        (alone,) = parser.feed(wanted)
        assert alone == whole._replace(end=alone.end)
        other = answer if wanted is bus.command else bus.command
        assert parser.feed(other) == []
        assert parser.dropped == {Dropped.DIRECTION: 2}


@each_bus
def test_dropped_packets_are_counted_by_reason(bus: Bus) -> None:
    answer = bus.encode(*{"dynamixel2": (9, 0, b"\x28"), "lx16a": (9, 26, b"\x28")}[bus.name])
    broken = answer[:-1] + bytes((answer[-1] ^ 1,))
    parser = bus.parser()
    assert parser.feed(b"abc" + answer)[0].end == 3 + len(answer)
    assert parser.dropped == {Dropped.NOISE: 3}
    assert parser.feed(broken) == []
    assert parser.dropped == {Dropped.NOISE: 3 + len(answer) - 1, Dropped.CHECKSUM: 1}
    size = len(bus.parser().header)
    too_long = answer[: size + 1] + b"\x01\x00" + answer[size + 3 :]  # a length of 1
    assert parser.feed(too_long) == []
    assert parser.dropped[Dropped.LENGTH] == 1
    assert parser.feed(answer[:-1]) == []
    assert parser.pending == len(answer) - 1
    assert parser.flush() == []
    assert parser.dropped[Dropped.TRUNCATED] == 1
    assert parser.pending == 0


@each_bus
def test_broken_packet_is_kept_on_request(bus: Bus) -> None:
    content = {"dynamixel2": (9, 0, b"\x28"), "lx16a": (9, 26, b"\x28")}[bus.name]
    answer = bus.encode(*content)
    kind = type(bus.parser())
    parser = kind(keep_broken=True)
    (packet,) = parser.feed(answer[:-1] + bytes((answer[-1] ^ 1,)))
    assert packet == (*content, len(answer), False)
    assert kind(keep_broken=True, instructions=True).feed(answer[:-1] + b"\0") == []


def test_reasons_are_those_of_protocol_1() -> None:
    assert {reason.value for reason in dynamixel.Dropped} < {reason.value for reason in Dropped}
