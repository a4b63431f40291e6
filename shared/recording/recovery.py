"""Recovery of damaged recordings after a crash or a disk error."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

from mcap.records import Attachment, Channel, Header, McapRecord, Metadata, Schema
from mcap.records import Message as Entry
from mcap.writer import CompressionType, Writer

from sextant.shared.files import whole_files
from sextant.shared.recording.layout import RecordingError
from sextant.shared.recording.reader import read_records
from sextant.shared.recording.records import Condition


@dataclass(slots=True)
class Recovered:
    """Result of a recovery."""

    condition: Condition = field(default_factory=Condition)  # of the source
    messages: int = 0
    began_ns: int = 0
    ended_ns: int = 0
    undeclared: int = 0  # messages of channels without an intact declaration

    @property
    def was_whole(self) -> bool:
        """Whether the source is intact, so nothing was copied."""
        return self.condition.whole

    @property
    def was_empty(self) -> bool:
        """Whether the source ends before its first record, so nothing was copied."""
        return self.condition.empty

    @property
    def span_s(self) -> float:
        """Time [s] from the first message to the last."""
        return (self.ended_ns - self.began_ns) * 1e-9

    @property
    def lost(self) -> list[str]:
        """List of the losses as text."""
        undeclared = [f"{self.undeclared} messages of undeclared topics"] if self.undeclared else []
        return self.condition.lost + undeclared

    def count(self, entry: Entry) -> None:
        """Count a message."""
        self.began_ns = entry.log_time if self.messages == 0 else min(self.began_ns, entry.log_time)
        self.ended_ns = max(self.ended_ns, entry.log_time)
        self.messages += 1


def recover(source: Path, target: Path) -> Recovered:
    """Copy all intact records of a damaged file to a new one, and keep the source.

    An intact or empty file is not copied. The new file appears when it is complete.

    Raises:
        RecordingError: `source` cannot be read, is not an MCAP file, or has no intact messages.
        WriteError: The new file cannot be written.
    """
    found = Recovered()
    for record in read_records(source, found.condition):
        if isinstance(record, Entry):
            found.count(record)
    if found.was_whole or found.was_empty:
        return found
    if found.messages == 0:
        lost = ", ".join(found.lost) or "it ends before its first message"
        raise RecordingError(f"{source}: no part of it is intact: {lost}; there is nothing to recover")
    found = Recovered()
    with whole_files.replacing(target, durable=True) as new:
        _Copy(new).run(read_records(source, found.condition), found)
    return found


class _Copy:
    """Writes copies of records, each schema and channel once."""

    def __init__(self, file: BinaryIO):
        self._writer = Writer(file, chunk_size=256 << 10, compression=CompressionType.ZSTD)
        self._schemas: dict[int, tuple[Schema | None, int]] = {0: (None, 0)}  # by id in the source
        self._channels: dict[int, tuple[Channel, int]] = {}
        self._started = False

    def run(self, records: Iterable[McapRecord], found: Recovered) -> None:
        for record in records:
            if not self._started:
                self._writer.start(profile=record.profile if isinstance(record, Header) else "", library="sextant")
                self._started = True
            self._add(record, found)
        self._writer.finish()  # type: ignore[no-untyped-call]

    def _add(self, record: McapRecord, found: Recovered) -> None:
        match record:
            case Metadata():
                self._writer.add_metadata(record.name, record.metadata)
            case Attachment():
                self._writer.add_attachment(record.create_time, record.log_time, record.name, record.media_type, record.data)
            case Schema() if self._schemas.get(record.id, (None, 0))[0] != record:
                self._schemas[record.id] = record, self._writer.register_schema(record.name, record.encoding, record.data)
            case Channel() if record.schema_id in self._schemas and self._channels.get(record.id, (None, 0))[0] != record:
                _, schema = self._schemas[record.schema_id]
                self._channels[record.id] = (
                    record,
                    self._writer.register_channel(record.topic, record.message_encoding, schema, record.metadata),
                )
            case Entry() if record.channel_id in self._channels:
                _, channel = self._channels[record.channel_id]
                self._writer.add_message(channel, record.log_time, record.data, record.publish_time, record.sequence)
                found.count(record)
            case Entry():
                found.undeclared += 1
