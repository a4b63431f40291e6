import struct
import tracemalloc
import zlib
from io import BytesIO
from pathlib import Path

import lz4.frame
import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.opcode import Opcode
from mcap.records import Channel
from mcap.records import Message as Entry
from mcap.writer import CompressionType, IndexType, Writer

from sextant.deploy import cli
from sextant.shared.recording.layout import RecordingError
from sextant.shared.recording.reader import Recording, is_whole, recovered
from sextant.shared.recording.records import LARGEST_BYTES, MAGIC, Condition, records
from sextant.shared.recording.recovery import recover

COUNT = 300


def foreign(
    compression: CompressionType = CompressionType.ZSTD, chunked: bool = True, crcs: bool = True, count: int = COUNT
) -> bytes:
    """Return a recording of another program: positions 10 ms apart.

    It also contains an attachment, metadata and a profile.
    """
    out = BytesIO()
    writer = Writer(out, chunk_size=600, compression=compression, use_chunking=chunked, enable_crcs=crcs, enable_data_crcs=crcs)
    writer.start(profile="ros2", library="another")
    writer.add_metadata("weather", {"sky": "clear"})
    schema = writer.register_schema("Position", "jsonschema", b'{"type": "object"}')
    channel = writer.register_channel("/положение", "json", schema)
    for k in range(count):
        writer.add_message(channel, log_time=k * 10_000_000, data=b'{"x": %d}' % k, publish_time=k, sequence=k)
    writer.add_attachment(1, 2, "notes.txt", "text/plain", b"mown yesterday")
    writer.finish()
    return out.getvalue()


def numbers(data: bytes) -> tuple[list[int], Condition]:
    """Return the sequence numbers of the messages in a file, and its condition."""
    condition = Condition()
    return [record.sequence for record in records(BytesIO(data), condition) if isinstance(record, Entry)], condition


WAYS = [
    pytest.param(foreign(CompressionType.ZSTD), id="zstd"),
    pytest.param(foreign(CompressionType.LZ4), id="lz4"),
    pytest.param(foreign(CompressionType.NONE), id="unpacked"),
    pytest.param(foreign(chunked=False), id="without chunks"),
    pytest.param(foreign(CompressionType.ZSTD, crcs=False), id="zstd, no checksums"),
    pytest.param(foreign(CompressionType.LZ4, crcs=False), id="lz4, no checksums"),
]


@pytest.mark.parametrize("data", WAYS)
def test_complete_file_of_any_packing_is_read(data: bytes) -> None:
    found, condition = numbers(data)
    assert found == list(range(COUNT))
    assert condition.whole
    assert condition.lost == []


@pytest.mark.parametrize("data", WAYS)
def test_trailing_zeros_lose_only_records_after_them(data: bytes) -> None:
    cut = data[: len(data) // 2] + bytes(70_000)
    found, condition = numbers(cut)
    assert found == list(range(len(found)))
    assert len(found) > COUNT // 4
    assert not condition.whole
    assert condition.tail_bytes >= 60_000


@pytest.mark.parametrize("data", WAYS)
@pytest.mark.parametrize(
    "damage",
    [bytes(200), b"\xff" * 200, b"", b"\x05" + struct.pack("<Q", 1 << 40)],
    ids=["zeros", "ones", "cut out", "a length"],
)
def test_reading_resumes_at_next_record_after_damage(data: bytes, damage: bytes) -> None:
    at = len(data) // 3
    found, condition = numbers(data[:at] + damage + data[at + 200 :])
    assert not condition.whole
    assert sorted(found) == found
    assert {0, COUNT - 1} <= set(found), "what is before and behind it is there"
    assert len(found) > COUNT // 2


def test_damaged_declarations_are_taken_from_summary() -> None:
    data = bytearray(foreign())
    at = data.index(struct.pack("<B", Opcode.CHUNK), len(MAGIC) + 40)
    data[at + 60] ^= 0xFF  # in the first chunk, which declares the channel
    condition = Condition()
    found = list(records(BytesIO(bytes(data)), condition))
    assert condition.damaged == 1
    first = next(k for k, record in enumerate(found) if isinstance(record, Entry))
    assert any(isinstance(record, Channel) for record in found[:first])


@pytest.mark.slow
@settings(max_examples=300, deadline=None)
@given(
    data=st.sampled_from([way.values[0] for way in WAYS]),
    changes=st.lists(st.tuples(st.floats(0, 1), st.binary(min_size=1, max_size=12), st.booleans()), min_size=1, max_size=4),
)
def test_reader_yields_only_records_for_any_bytes(data: bytes, changes: list[tuple[float, bytes, bool]]) -> None:
    for share, run, inserts in changes:
        at = len(MAGIC) + int(share * (len(data) - len(MAGIC)))
        data = data[:at] + run + data[at + (0 if inserts else len(run)) :]
    found, _ = numbers(data)
    assert len(found) <= 2 * COUNT


def record(opcode: int, body: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(body)) + body


def chunk(data: bytes, compression: bytes, claimed: int, crc: int = 0) -> bytes:
    head = struct.pack("<QQQI", 0, 1, claimed, crc) + struct.pack("<I", len(compression)) + compression
    return record(Opcode.CHUNK, head + struct.pack("<Q", len(data)) + data)


ZEROS = 96 << 20
PACKED = {
    b"zstd": zstandard.compress(bytes(ZEROS)),
    b"lz4": lz4.frame.compress(bytes(ZEROS)),
}


@pytest.mark.slow
@pytest.mark.parametrize("compression", PACKED)
@pytest.mark.parametrize("claimed", [3 << 30, LARGEST_BYTES, 1000, 0], ids=["3 GB", "the most", "little", "nothing"])
def test_oversized_chunk_is_skipped_with_little_memory(compression: bytes, claimed: int) -> None:
    data = MAGIC + record(Opcode.HEADER, bytes(8)) + 20 * chunk(PACKED[compression], compression, claimed)
    tracemalloc.start()
    found, condition = numbers(data)
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert found == []
    if claimed > LARGEST_BYTES:
        assert condition.lost == ["20 chunks that unpack to more than 64 MB"]
    else:
        assert condition.damaged == 20
    assert not condition.whole
    assert most < 3 * LARGEST_BYTES


def test_oversized_record_is_skipped(tmp_path: Path) -> None:
    whole = foreign(count=5)
    with (tmp_path / "large.mcap").open("wb") as file:
        file.write(whole[: len(MAGIC)] + struct.pack("<BQ", Opcode.ATTACHMENT, LARGEST_BYTES + 1))
        file.seek(LARGEST_BYTES + 1, 1)  # a hole, which takes no space
        file.write(whole[len(MAGIC) :])
    with (tmp_path / "large.mcap").open("rb") as file:
        condition = Condition()
        assert sum(isinstance(one, Entry) for one in records(file, condition)) == 5
    assert "1 records of more than 64 MB" in condition.lost


def test_message_with_invalid_time_is_damaged() -> None:
    body = struct.pack("<HIQQ", 1, 0, (1 << 64) - 1, 0)
    found, condition = numbers(MAGIC + record(Opcode.MESSAGE, body))
    assert found == []
    assert condition.damaged == 1


@pytest.mark.parametrize("size", range(len(MAGIC) + 1))
def test_file_without_first_record_is_empty(tmp_path: Path, size: int, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "r.mcap"
    path.write_bytes(MAGIC[:size])
    recording = Recording(path)
    assert list(recording.frames()) == []
    assert not recording.complete
    for command in ("info", "recover"):
        assert cli.main(["recording", command, str(path)]) == 0
        said = capsys.readouterr().out
        assert "empty recording" in said
        assert "nothing to recover" in said
    assert [one.name for one in tmp_path.iterdir()] == ["r.mcap"]


def test_complete_file_without_messages_is_complete(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "r.mcap").write_bytes(foreign(count=0))
    assert cli.main(["recording", "recover", str(tmp_path / "r.mcap")]) == 0
    assert "already complete, 0 messages" in capsys.readouterr().out
    assert cli.main(["recording", "info", str(tmp_path / "r.mcap")]) == 0
    said = capsys.readouterr().out
    assert "recover" not in said


def test_foreign_records_are_kept_or_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data = foreign()
    cut = data[: data.index(struct.pack("<B", Opcode.DATA_END) + struct.pack("<Q", 4))]
    (tmp_path / "r.mcap").write_bytes(cut + record(0x91, b"ours alone"))
    assert cli.main(["recording", "recover", str(tmp_path / "r.mcap")]) == 0
    assert "1 private records 0x91" in capsys.readouterr().out
    assert cli.main(["recording", "info", str(recovered(tmp_path / "r.mcap"))]) == 0
    said = capsys.readouterr().out
    assert "profile of MCAP: ros2" in said
    assert "further metadata: weather" in said
    assert "attachment notes.txt: 14 bytes" in said
    assert f"{COUNT}" in said


def test_damaged_recovered_file_does_not_replace_source(tmp_path: Path) -> None:
    source, made = tmp_path / "r.mcap", recovered(tmp_path / "r.mcap")
    source.write_bytes(foreign()[:-60])
    recover(source, made)
    assert is_whole(made)
    assert Recording(tmp_path).files == [made]
    made.write_bytes(made.read_bytes()[:-400])
    assert Recording(tmp_path).files == [source]
    assert cli.main(["recording", "recover", str(tmp_path)]) == 0, "it is made again"
    assert Recording(tmp_path).files == [made]


def test_index_with_wrong_checksum_is_damaged() -> None:
    data = bytearray(foreign())
    data[-60] ^= 1
    assert not numbers(bytes(data))[1].whole


def test_control_characters_do_not_reach_terminal(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with (tmp_path / "r.mcap").open("wb") as file:
        writer = Writer(file, index_types=IndexType.NONE)
        writer.start()
        channel = writer.register_channel("/a\x1b[2J\n", "json", 0)
        writer.add_message(channel, 0, b"", 0)
        writer.finish()
    assert cli.main(["recording", "info", str(tmp_path / "r.mcap")]) == 0
    assert "\x1b" not in capsys.readouterr().out


def test_time_jump_above_one_day_is_refused(tmp_path: Path) -> None:
    (tmp_path / "r.mcap").write_bytes(b"")
    with (tmp_path / "r.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("A", "sextant", b"")
        channel = writer.register_channel("a", "sextant", schema)
        for at_ns in (0, 1 << 62):
            writer.add_message(channel, at_ns, b"", at_ns)
        writer.finish()
    with pytest.raises(RecordingError, match="less than a day apart expected"):
        list(Recording(tmp_path / "r.mcap").frames())


def test_attachment_checksum_is_checked() -> None:
    data = foreign()
    at = data.index(b"mown yesterday")
    assert zlib.crc32(b"") == 0
    _, condition = numbers(data[:at] + b"M" + data[at + 1 :])
    assert condition.damaged == 1
