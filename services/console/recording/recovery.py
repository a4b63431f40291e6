"""What a crash or a bad disk left of a recording, made a whole file again."""

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, McapRecord, Metadata, Schema
from mcap.records import Message as Entry
from mcap.stream_reader import breakup_chunk
from mcap.writer import CompressionType, Writer

from services.console.recording.layout import RecordingError
from services.console.recording.reader import CUT_OFF, MAGIC

_HEAD = struct.Struct("<BQ")  # of a record: opcode, length of what follows
_LARGEST = 1 << 30  # bytes of a record


@dataclass(slots=True)
class Recovered:
    """What became of a file."""

    messages: int = 0
    began_ns: int = 0
    ended_ns: int = 0
    lost_chunks: int = 0  # that did not unpack, and were left out
    tail_bytes: int = 0  # behind the last whole record
    was_whole: bool = False  # it had its end: nothing needed to be done

    @property
    def span_s(self) -> float:
        """[s] from the first message to the last."""
        return (self.ended_ns - self.began_ns) * 1e-9


def recover(source: Path, target: Path) -> Recovered:
    """Copy all that is whole in a file to a new one; the old one stays as it is.

    Raises:
        RecordingError: `source` cannot be read, is no MCAP file, or nothing in it is whole.
        OSError: The new one is there already, or cannot be written.
    """
    found = Recovered()
    try:
        file = source.open("rb")
    except OSError as error:
        raise RecordingError(f"{source}: {error.strerror}; give the recording that was cut off") from None
    with file:
        if file.read(len(MAGIC)) != MAGIC:
            raise RecordingError(f"{source}: not an MCAP file; give the recording that was cut off")
        with target.open("xb") as new:
            _Copy(new).run(_whole_records(file, source.stat().st_size, found), found)
    if found.messages == 0:
        target.unlink()
        raise RecordingError(f"{source}: nothing in it is whole: it was cut off before its first second was written")
    return found


class _Copy:
    """Writes records again, each schema and channel once."""

    def __init__(self, file: BinaryIO):
        self._writer = Writer(file, chunk_size=256 << 10, compression=CompressionType.ZSTD)
        self._writer.start(profile="", library="sextant")
        self._schemas: dict[int, int] = {0: 0}  # by the number in the old file
        self._channels: dict[int, int] = {}

    def run(self, records: Iterator[McapRecord], found: Recovered) -> None:
        for record in records:
            match record:
                case Metadata():
                    self._writer.add_metadata(record.name, record.metadata)
                case Schema() if record.id not in self._schemas:
                    self._schemas[record.id] = self._writer.register_schema(record.name, record.encoding, record.data)
                case Channel() if record.id not in self._channels and record.schema_id in self._schemas:
                    self._channels[record.id] = self._writer.register_channel(
                        record.topic, record.message_encoding, self._schemas[record.schema_id], record.metadata
                    )
                case Entry() if record.channel_id in self._channels:
                    self._writer.add_message(
                        self._channels[record.channel_id], record.log_time, record.data, record.publish_time, record.sequence
                    )
                    found.began_ns = record.log_time if found.messages == 0 else min(found.began_ns, record.log_time)
                    found.ended_ns = max(found.ended_ns, record.log_time)
                    found.messages += 1
        self._writer.finish()  # type: ignore[no-untyped-call]


def _whole_records(file: BinaryIO, size: int, found: Recovered) -> Iterator[McapRecord]:
    """The records of the data section, those within chunks too, as far as they are whole."""
    while True:
        at = file.tell()
        head = file.read(_HEAD.size)
        if len(head) < _HEAD.size:
            found.tail_bytes = size - at
            return
        opcode, length = _HEAD.unpack(head)
        if opcode == Opcode.DATA_END:
            file.seek(-len(MAGIC), 2)
            found.was_whole = file.read() == MAGIC and found.lost_chunks == 0
            return
        if not 0 < opcode < 0x80 or length > _LARGEST or at + _HEAD.size + length > size:
            found.tail_bytes = size - at
            return
        body = file.read(length)
        yield from _read(opcode, body, found)


def _read(opcode: int, body: bytes, found: Recovered) -> list[McapRecord]:
    """A record, or those within a chunk; none where it does not unpack."""
    stream = ReadDataStream(BytesIO(body))
    try:
        match opcode:
            case Opcode.CHUNK:
                return breakup_chunk(Chunk.read(stream), validate_crc=True)
            case Opcode.SCHEMA:
                return [Schema.read(stream)]
            case Opcode.CHANNEL:
                return [Channel.read(stream)]
            case Opcode.MESSAGE:
                return [Entry.read(stream, len(body))]
            case Opcode.METADATA:
                return [Metadata.read(stream)]
    except CUT_OFF:
        found.lost_chunks += 1
    return []  # indexes, which are made anew
