"""Frames on a serial line: published vectors of the stuffing, and damaged streams."""

import zlib

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sextant.shared.servo.firmware.framing import MAX_FRAME, MAX_PAYLOAD, Broken, Deframer, frame, stuffed, unstuffed

WILD = settings(deadline=None, derandomize=True, max_examples=300)
PAYLOADS = st.lists(st.binary(min_size=1, max_size=MAX_PAYLOAD - 4), min_size=3, max_size=5)
UP = bytes(range(1, 256))


@pytest.mark.parametrize(
    ("data", "stuffing"),
    [
        ("00", "01 01"),
        ("00 00", "01 01 01"),
        ("00 11 00", "01 02 11 01"),
        ("11 22 00 33", "03 11 22 02 33"),
        ("11 22 33 44", "05 11 22 33 44"),
        ("11 00 00 00", "02 11 01 01 01"),
        (UP[:254].hex(), "FF" + UP[:254].hex()),
        ("00" + UP[:254].hex(), "01 FF" + UP[:254].hex()),
        (UP.hex(), "FF" + UP[:254].hex() + "02 FF"),
        (UP[1:].hex() + "00", "FF" + UP[1:].hex() + "01 01"),
        (UP[2:].hex() + "00 01", "FE" + UP[2:].hex() + "02 01"),
    ],
)
def test_stuffing_matches_publication(data: str, stuffing: str) -> None:
    """Compare with the examples of Cheshire and Baker's encoding on Wikipedia."""
    assert stuffed(bytes.fromhex(data)) == bytes.fromhex(stuffing)
    assert unstuffed(bytes.fromhex(stuffing)) == bytes.fromhex(data)


def test_checksum_matches_standard_check_value() -> None:
    assert zlib.crc32(b"123456789") == 0xCBF43926
    assert frame(b"123456789") == b"\0" + stuffed(b"123456789" + bytes.fromhex("26 39 F4 CB")) + b"\0"


@WILD
@given(st.binary(max_size=1200))
def test_stuffed_data_has_no_zero_and_survives_round_trip(data: bytes) -> None:
    assert 0 not in stuffed(data)
    assert unstuffed(stuffed(data)) == data
    assert len(stuffed(data)) <= len(data) + len(data) // 254 + 1


@WILD
@given(st.lists(st.binary(max_size=900), max_size=8), PAYLOADS)
def test_frame_is_found_after_any_bytes_with_bounded_memory(noise: list[bytes], payloads: list[bytes]) -> None:
    deframer = Deframer()
    for part in noise:
        deframer.feed(part)
        assert deframer.pending <= MAX_FRAME
    assert [payload for sent in payloads for payload in deframer.feed(frame(sent))] == payloads


@pytest.mark.slow
@WILD
@given(PAYLOADS, st.data())
def test_stream_may_be_split_anywhere(payloads: list[bytes], data: st.DataObject) -> None:
    stream = b"".join(map(frame, payloads))
    cuts = sorted(data.draw(st.lists(st.integers(0, len(stream)), max_size=6)))
    parts = [stream[a:b] for a, b in zip([0, *cuts], [*cuts, len(stream)], strict=True)]
    deframer = Deframer()
    assert [payload for part in parts for payload in deframer.feed(part)] == payloads
    assert not deframer.broken


@WILD
@given(PAYLOADS, st.data())
def test_one_byte_error_spoils_at_most_one_frame(payloads: list[bytes], data: st.DataObject) -> None:
    frames = [frame(payload) for payload in payloads]
    stream = bytearray(b"".join(frames))
    at = data.draw(st.integers(0, len(stream) - 1))
    match data.draw(st.sampled_from(["changed", "lost", "added"])):
        case "changed":
            stream[at] ^= data.draw(st.integers(1, 255))
        case "lost":
            del stream[at]
        case "added":
            stream.insert(at, data.draw(st.integers(0, 255)))
    found = Deframer().feed(bytes(stream))
    whole = [payloads[:i] + payloads[i + 1 :] for i in range(len(payloads))]
    assert found == payloads or found in whole


def test_invalid_frames_are_counted_by_reason() -> None:
    deframer = Deframer()
    assert deframer.feed(b"\x00\x00\x00") == []
    assert not deframer.broken, "nothing stood between them"
    assert deframer.feed(b"\x05\x01\x00") == []
    assert deframer.feed(stuffed(b"12345678") + b"\x00") == []
    assert deframer.feed(bytes([1] * (MAX_FRAME + 1)) + b"\x00") == []
    assert deframer.broken == {Broken.STUFFING: 1, Broken.CRC: 1, Broken.LONG: 1}


def test_payload_length_is_limited() -> None:
    longest = bytes(range(1, 200)) * 2
    assert Deframer().feed(frame(longest[: MAX_PAYLOAD - 4])) == [longest[: MAX_PAYLOAD - 4]]
    with pytest.raises(ValueError, match=f"at most {MAX_PAYLOAD - 4} bytes of payload expected, found {MAX_PAYLOAD - 3}"):
        frame(longest[: MAX_PAYLOAD - 3])
