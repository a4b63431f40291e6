"""Reader of recordings, in the order in which they were written."""

from collections.abc import Iterable, Iterator
from pathlib import Path

from mcap.records import Channel, McapRecord, Metadata, Schema
from mcap.records import Message as Entry

from sextant.shared.recording.layout import ENCODING, METADATA, RecordingError
from sextant.shared.recording.records import MAGIC, Condition, records
from sextant.shared.runtime.service import AnyTopic
from sextant.shared.wire import codec, topics
from sextant.shared.wire.messages import Message

_RECOVERED = ".recovered.mcap"
_INSTEAD = "give the recording.mcap of a run's folder, or a folder of recordings"
_LARGEST_JUMP_NS = 86_400_000_000_000  # [ns] one day, between consecutive messages; a replay waits for that time


class Recording:
    """Recorded run: a file, or a folder of consecutive files.

    It raises only RecordingError, for files with any content. Damaged records are skipped and counted.
    """

    def __init__(self, path: Path):
        """Open a recording; only the first bytes of its files are checked.

        Raises:
            RecordingError: A file does not exist, or is not an MCAP file.
        """
        self.path = path
        self.about: dict[str, str] = {}  # set when `frames` reads it, at the beginning of the first file
        self.conditions: dict[Path, Condition] = {}  # of the files that `frames` has reached
        self.undeclared = 0  # messages of channels without an intact declaration
        self.files = _newest_of_each(files_of(path))
        if not self.files:
            raise RecordingError(f"{path}: no recordings in this folder; {_INSTEAD}")
        for file in self.files:
            check_magic(file)

    @property
    def cut_off(self) -> list[Path]:
        """Files that `frames` found damaged or truncated."""
        return [path for path, condition in self.conditions.items() if not condition.whole]

    @property
    def complete(self) -> bool:
        """Whether all files that `frames` has reached are intact."""
        return not (self.cut_off or self.undeclared)

    def frames(self) -> Iterator[tuple[str, bytes, int]]:
        """Yield (topic key, frame, time [ns]) of all intact frames."""
        self.undeclared = 0
        before_ns = -1
        for path in self.files:
            for key, frame, at_ns in self._frames_of(path):
                if before_ns >= 0 and abs(at_ns - before_ns) > _LARGEST_JUMP_NS:
                    jump = f"{abs(at_ns - before_ns) * 1e-9:.0f} s from one message to the next"
                    raise RecordingError(f"{path}: message times less than a day apart expected, found {jump}")
                before_ns = at_ns
                yield key, frame, at_ns

    def _frames_of(self, path: Path) -> Iterator[tuple[str, bytes, int]]:
        keys: dict[int, str] = {}
        foreign: set[int] = set()  # channels with translations of the frames
        own = 0
        condition = self.conditions[path] = Condition()
        for record in read_records(path, condition):
            match record:
                case Channel() if record.message_encoding == ENCODING:
                    keys[record.id] = topics.RENAMED.get(record.topic, record.topic)
                case Channel():
                    foreign.add(record.id)
                case Schema():
                    own += record.encoding == ENCODING
                case Metadata(name=name) if name == METADATA:
                    self.about = self.about or dict(record.metadata)
                case Entry() if record.channel_id in keys:
                    yield keys[record.channel_id], record.data, record.log_time
                case Entry() if record.channel_id not in foreign:
                    self.undeclared += 1
        if foreign and not own:
            raise RecordingError(f"{path}: frames of {ENCODING!r} expected, found none; {_INSTEAD}")

    def messages(self, wanted: Iterable[AnyTopic] = topics.TOPICS) -> Iterator[tuple[AnyTopic, Message, int]]:
        """Yield (topic, message, time [ns]) of some topics.

        Damaged frames of this version are skipped and counted.

        Raises:
            RecordingError: A frame has another version.
        """
        by_key = {topic.key: topic for topic in wanted}
        for key, frame, at_ns in self.frames():
            if key not in by_key:
                continue
            topic = by_key[key]
            try:
                message, _ = codec.decode(frame, topic.type, topic.max_bytes)
            except codec.DecodeError as error:
                if _of_this_version(frame, topic):
                    self._newest_condition().damaged += 1
                    continue
                raise RecordingError(f"{self.path}: {key}: {error}; read it with the version that wrote it") from None
            yield topic, message, at_ns

    def _newest_condition(self) -> Condition:
        return next(reversed(self.conditions.values()))

    def counts(self) -> dict[str, int]:
        """Return topic key -> number of recorded frames."""
        found: dict[str, int] = {}
        for key, _, _ in self.frames():
            found[key] = found.get(key, 0) + 1
        return dict(sorted(found.items()))


def read(path: Path, wanted: Iterable[AnyTopic] = topics.TOPICS) -> Iterator[tuple[AnyTopic, Message, int]]:
    """Yield (topic, message, time [ns]) of some topics, in the order of writing."""
    return Recording(path).messages(wanted)


def read_records(path: Path, condition: Condition) -> Iterator[McapRecord]:
    """Yield the intact records of a file; `condition` is updated while they are read.

    Raises:
        RecordingError: The file cannot be read, or is not an MCAP file.
    """
    check_magic(path)
    try:
        with path.open("rb") as file:
            yield from records(file, condition)
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror or error}") from None


def newest_ns(path: Path) -> int:
    """Return the newest time [ns] of a message in a file, -1 without messages.

    Raises:
        RecordingError: The file does not exist, or is not an MCAP file.
    """
    times = (record.log_time for record in read_records(path, Condition()) if isinstance(record, Entry))
    return max(times, default=-1)


def is_whole(path: Path) -> bool:
    """Return whether a file has its end, and no damage."""
    condition = Condition()
    try:
        for _ in read_records(path, condition):
            pass
    except RecordingError:
        return False
    return condition.whole


def files_of(path: Path) -> list[Path]:
    """Return a file, or the MCAP files of a folder in order."""
    return sorted(path.glob("*.mcap")) if path.is_dir() else [path]


def recovered(path: Path) -> Path:
    """Return the path of the recovered copy of a file."""
    return path.with_name(f"{path.stem}{_RECOVERED}")


def is_recovered(path: Path, files: Iterable[Path]) -> bool:
    """Return whether a file is the recovered copy of another one in `files`."""
    return path in {recovered(other) for other in files}


def _of_this_version(frame: bytes, topic: AnyTopic) -> bool:
    """Return whether an undecodable frame has this version's schema id, or no header."""
    try:
        return codec.label(frame).schema_id == codec.schema_id(topic.type)
    except codec.DecodeError:
        return True


def _newest_of_each(files: list[Path]) -> list[Path]:
    """Return each recording once.

    The recovered copy is preferred, unless it is missing or damaged.
    """
    whole = {path for path in files if is_recovered(path, files) and is_whole(path)}
    return [path for path in files if (path in whole if is_recovered(path, files) else recovered(path) not in whole)]


def check_magic(path: Path) -> None:
    """Check the first bytes of a file.

    A shorter file with a correct beginning is an empty recording.

    Raises:
        RecordingError: The file cannot be read, or is not an MCAP file.
    """
    try:
        with path.open("rb") as file:
            magic = file.read(len(MAGIC))
    except OSError as error:
        raise RecordingError(f"{path}: {error.strerror}; {_INSTEAD}") from None
    if not MAGIC.startswith(magic):
        raise RecordingError(f"{path}: not an MCAP file; {_INSTEAD}")
