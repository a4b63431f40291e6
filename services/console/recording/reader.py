"""Recordings, read from their beginning in the order in which they were written."""

import contextlib
import struct
from collections.abc import Iterable, Iterator
from pathlib import Path

import zstandard
from mcap.exceptions import McapError
from mcap.records import Channel, Chunk, Metadata, Schema
from mcap.records import Message as Entry
from mcap.stream_reader import CRCValidationError, StreamReader

from services.console.recording.layout import ENCODING, METADATA, RecordingError
from shared import codec, topics
from shared.messages import Message
from shared.service import AnyTopic

MAGIC = b"\x89MCAP0\r\n"
# What reading ends in where a file does: inside a record, a length or a chunk.
CUT_OFF = (McapError, CRCValidationError, zstandard.ZstdError, struct.error, UnicodeDecodeError)
_RECOVERED = ".recovered.mcap"
_INSTEAD = "give the recording.mcap of a run's folder, or a folder of recordings"


class Recording:
    """A recorded run: a file, or a folder whose files follow each other."""

    def __init__(self, path: Path):
        """Open it; nothing but the first bytes of its files is looked at.

        Raises:
            RecordingError: No such file, or not an MCAP file.
        """
        self.path = path
        self.about: dict[str, str] = {}  # filled as `frames` comes across it: at the very beginning of the first file
        self.cut_off: list[Path] = []  # files that `frames` found to end before their end
        self.files = _newest_of_each(files_of(path))
        if not self.files:
            raise RecordingError(f"{path}: no recordings in this folder; {_INSTEAD}")
        for file in self.files:
            _check_magic(file)

    @property
    def complete(self) -> bool:
        """Whether `frames` has come to the end of every file that it has come to."""
        return not self.cut_off

    def frames(self) -> Iterator[tuple[str, bytes, int]]:
        """(topic key, frame, time [ns]) of all that was on the wire; a file that a crash cut off is read as far as it goes."""
        for path in self.files:
            yield from self._frames(path)

    def _frames(self, path: Path) -> Iterator[tuple[str, bytes, int]]:
        keys: dict[int, str] = {}
        foreign: set[int] = set()  # channels that say the same in other words
        own = 0
        with path.open("rb") as file:
            try:
                for record in StreamReader(file, validate_crcs=True).records:
                    match record:
                        case Channel() if record.message_encoding == ENCODING:
                            keys[record.id] = record.topic
                        case Channel():
                            foreign.add(record.id)
                        case Schema():
                            own += record.encoding == ENCODING
                        case Metadata(name=name) if name == METADATA:
                            self.about = self.about or dict(record.metadata)
                        case Entry() if record.channel_id in keys:
                            yield keys[record.channel_id], record.data, record.log_time
                        case Entry() if record.channel_id not in foreign:
                            words = f"a message of channel {record.channel_id}, which the file does not declare"
                            raise RecordingError(f"{path}: damaged: {words}; `sextant recover` keeps what is whole")
            except CUT_OFF:
                self.cut_off.append(path)
        if foreign and not own:
            raise RecordingError(f"{path}: frames of {ENCODING!r} expected, found none; {_INSTEAD}")

    def messages(self, wanted: Iterable[AnyTopic] = topics.TOPICS) -> Iterator[tuple[AnyTopic, Message, int]]:
        """(topic, message, time [ns]) of some topics.

        Raises:
            RecordingError: A frame that this version cannot decode.
        """
        by_key = {topic.key: topic for topic in wanted}
        for key, frame, at_ns in self.frames():
            if key in by_key:
                topic = by_key[key]
                try:
                    message, _ = codec.decode(frame, topic.type, topic.max_bytes)
                except codec.DecodeError as error:
                    raise RecordingError(f"{self.path}: {key}: {error}; read it with the version that wrote it") from None
                yield topic, message, at_ns

    def counts(self) -> dict[str, int]:
        """Topic key -> recorded frames."""
        found: dict[str, int] = {}
        for key, _, _ in self.frames():
            found[key] = found.get(key, 0) + 1
        return dict(sorted(found.items()))


def read(path: Path, wanted: Iterable[AnyTopic] = topics.TOPICS) -> Iterator[tuple[AnyTopic, Message, int]]:
    """(topic, message, time [ns]) of some topics of a recording, in the order in which they were written."""
    return Recording(path).messages(wanted)


def newest_ns(path: Path) -> int:
    """When [ns] the last message came that a file holds, -1 where it holds none; by the chunks, whatever became of its end.

    Raises:
        RecordingError: No such file, or not an MCAP file.
    """
    _check_magic(path)
    newest = -1
    with path.open("rb") as file, contextlib.suppress(*CUT_OFF):
        for record in StreamReader(file, emit_chunks=True).records:
            if isinstance(record, Chunk):
                newest = max(newest, record.message_end_time)
    return newest


def files_of(path: Path) -> list[Path]:
    """A file, or the MCAP files of a folder in their order."""
    return sorted(path.glob("*.mcap")) if path.is_dir() else [path]


def recovered(path: Path) -> Path:
    """Where a file goes when it is made whole."""
    return path.with_name(f"{path.stem}{_RECOVERED}")


def _newest_of_each(files: list[Path]) -> list[Path]:
    """Without those that have been made whole beside."""
    return [path for path in files if path.name.endswith(_RECOVERED) or recovered(path) not in files]


def _check_magic(path: Path) -> None:
    try:
        with path.open("rb") as file:
            magic = file.read(len(MAGIC))
    except OSError as error:
        raise RecordingError(f"{path}: {error.strerror}; {_INSTEAD}") from None
    if magic != MAGIC:
        raise RecordingError(f"{path}: not an MCAP file; {_INSTEAD}")
