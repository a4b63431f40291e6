"""The firmware's decoder and encoder agree with the host's declarations of the messages."""

from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sextant.shared.servo import bridge_protocol
from sextant.shared.servo.bridge_protocol import FROM_HOST, TO_HOST, Message
from sextant.shared.servo.firmware import framing, packing, wire
from sextant.shared.wire.codec import DecodeError, pack_values
from tests.unit.shared.servo.test_bridge_protocol import anything, messages

WILD = settings(deadline=None, derandomize=True, max_examples=200)
PLAIN = st.integers(0, (1 << 64) - 1) | st.binary(max_size=300) | st.text(st.characters(max_codepoint=126), max_size=40)


def payload(message: Message) -> bytes:
    (found,) = framing.Deframer().feed(bridge_protocol.encode(message))
    return found


def plain(message: Message) -> list[Any]:
    return [type(message).code, *(getattr(message, name) for name, _ in bridge_protocol._kinds(type(message)))]


@WILD
@given(messages(FROM_HOST))
def test_firmware_decodes_messages_of_host(message: Message) -> None:
    assert wire.decode(payload(message)) == plain(message)


@WILD
@given(
    st.sampled_from(sorted(kind.code for kind in FROM_HOST)) | st.integers(0, 255), st.lists(anything(), max_size=9), st.data()
)
def test_firmware_refuses_what_host_refuses(code: int, values: list[Any], data: st.DataObject) -> None:
    try:
        sent = pack_values([code, *values])
    except (ValueError, OverflowError):
        return
    check_same_decision(sent)


@WILD
@given(messages(FROM_HOST), st.data())
def test_firmware_refuses_broken_payloads_like_host(message: Message, data: st.DataObject) -> None:
    sent = bytearray(payload(message))
    sent[data.draw(st.integers(0, len(sent) - 1))] ^= data.draw(st.integers(1, 255))
    check_same_decision(bytes(sent[: data.draw(st.integers(0, len(sent)))]))


def check_same_decision(sent: bytes) -> None:
    try:
        expected: list[Any] | None = plain(bridge_protocol.decode(sent, FROM_HOST))
    except bridge_protocol.OtherVersion as error:
        expected = [wire.HELLO, error.version]
    except DecodeError:
        expected = None
    found = wire.decode(sent)
    if found != expected:  # the only difference: the firmware decodes no hello of another version with other types of fields
        assert found is None
        assert expected is not None
        assert expected[:1] == [wire.HELLO]
        assert len(expected) == 2


@WILD
@given(st.lists(PLAIN, max_size=20))
def test_packing_matches_msgpack(values: list[Any]) -> None:
    assert packing.pack(values) == pack_values(values)
    assert packing.unpack(pack_values(values)) == values


@pytest.mark.parametrize("code", sorted(kind.code for kind in TO_HOST))
@WILD
@given(st.data())
def test_host_decodes_messages_of_firmware(code: int, data: st.DataObject) -> None:
    message = data.draw(messages(frozenset({bridge_protocol.MESSAGES[code]})))
    values = plain(message)[1:]
    match message:
        case bridge_protocol.Welcome():
            sent = wire.welcome(*values[1:])
        case bridge_protocol.Answer():
            sent = wire.answer(*map(int, values[:4]), values[4])
        case _:
            sent = wire.state([int(value) for value in values[:11]], [list(column) for column in values[11:]])
    assert sent == bridge_protocol.encode(message)


def test_clock_of_firmware_matches_that_of_host() -> None:
    ours, theirs = wire.RemoteClock(), bridge_protocol.RemoteClock()
    for now_us, delay_us in ((0, 500), (20_000, 0), (40_000, 9_000), (41_000, 8_000), (3_000_000, 300), (3_020_000, 100)):
        arrived_us = now_us + delay_us
        assert ours.age_us(now_us, arrived_us) == pytest.approx(theirs.age_ns(now_us, 1000 * arrived_us) / 1000, abs=1.1)


def test_numbers_of_modes_refusals_and_results_match() -> None:
    for table in (bridge_protocol.Mode, bridge_protocol.Refusal, bridge_protocol.Result, bridge_protocol.Instruction):
        for member in table:
            name = "OTHER_VERSION" if member is bridge_protocol.Refusal.VERSION else member.name
            assert getattr(wire, name) == member.value
