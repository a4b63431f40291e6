"""Runs as plain MCAP files: the frames of the wire as they are, a channel per topic, its fields' declarations as schema."""

import json
import queue
import struct
import threading
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, Self

import numpy as np
import zstandard
from mcap.exceptions import McapError
from mcap.records import Channel, Metadata, Schema
from mcap.records import Message as Entry
from mcap.stream_reader import CRCValidationError, StreamReader
from mcap.writer import CompressionType, Writer

from shared import codec, messages, topics
from shared.messages import Message
from shared.service import AnyTopic, Link

ENCODING = "sextant"
# What is lost at most when the process dies: a chunk that is being filled, and what chunks were full since the last flush.
_CHUNK_BYTES = 256 << 10
_FLUSH_NS = 1_000_000_000  # from one flush, which hands full chunks over to the system, to the next
_QUEUE_FRAMES = 2000  # frames that may wait for the disk in a live run

# Pictures would be nine tenths of a file, and asking for colour makes the simulator render it.
LEFT_OUT: frozenset[AnyTopic] = frozenset({topics.DEPTH, topics.COLOR})
# The scans, all recorded, make the map again; one map a second shows what came of them.
THINNED_NS: Mapping[AnyTopic, int] = {topics.TERRAIN: 1_000_000_000}

FRAME_LAYOUT = (
    "uint32 little-endian header length | header | padding to 8 bytes | arrays, each padded to 8 bytes. "
    "The header is msgpack [schema, began_ns, sent_ns, [field, ...]] with the fields in the order of the channel's schema; "
    "an array field is [dtype, [length, ...], offset into the arrays], dtype in NumPy's notation. "
    "A packed one has the number of its bytes behind that: a Zstandard frame of its differences along the first axis, column "
    "by column, zigzag coded, the lowest bytes of all of them first."
)


# What reading ends in where a file does: inside a record, a length or a chunk.
_CUT_OFF = (McapError, CRCValidationError, zstandard.ZstdError, struct.error, UnicodeDecodeError)


class RecordingError(ValueError):
    """A file that is not a recording, or not one that this version can read; says which and what to do."""


def describe(kind: type[Message]) -> str:
    """A message's declaration as JSON text: its schema id, and name, type and shape of every field in their order."""
    fields = [{"name": name, **_described(base, detail)} for name, base, detail in messages.schema(kind)]
    return json.dumps({"schema": codec.schema_id(kind), "doc": kind.__doc__, "fields": fields}, indent=1)


def _described(base: Any, detail: Any) -> dict[str, Any]:
    if base is np.ndarray:
        dtype, dims = detail
        return {"type": "array", "dtype": dtype.str, "shape": list(dims.shape), "finite": dims.finite, "packed": dims.packed}
    if base is Literal:
        return {"type": "str", "one_of": list(detail)}
    if base is tuple:
        return {"type": "list of str"}
    if issubclass(base, str) and base is not str:
        return {"type": "str", "one_of": [str(member) for member in base]}
    return {"type": base.__name__}


class Recorder:
    """Writes frames into an MCAP file; a context manager. Used by one thread at a time."""

    def __init__(
        self,
        path: Path,
        about: Mapping[str, str],
        left_out: Iterable[AnyTopic] = LEFT_OUT,
        thinned_ns: Mapping[AnyTopic, int] = THINNED_NS,
    ):
        """Open the file.

        Args:
            path: File to write; its folder exists.
            about: What the run was, in words, for whoever finds the file.
            left_out: Topics that are not recorded.
            thinned_ns: Topic -> time [ns] that passes between two recorded frames.
        """
        self.skipped = frozenset(left_out)
        self._thinned_ns = thinned_ns
        self._newest_ns: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self._counts: dict[str, int] = {}
        self._file = path.open("wb")
        self._writer = Writer(self._file, chunk_size=_CHUNK_BYTES, compression=CompressionType.ZSTD)
        self._writer.start(profile="", library="sextant")
        self._writer.add_metadata("run", {**about, "frame_layout": FRAME_LAYOUT})
        self._file.flush()
        self._flush_due_ns = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    def write(self, topic: AnyTopic, frame: bytes, at_ns: int) -> None:
        """Append a frame with the time [ns] at which it was sent or came."""
        if topic in self.skipped:
            return
        apart_ns = self._thinned_ns.get(topic, 0)
        if topic.key in self._newest_ns and at_ns - self._newest_ns[topic.key] < apart_ns:
            return
        self._newest_ns[topic.key] = at_ns
        count = self._counts[topic.key] = self._counts.get(topic.key, -1) + 1
        self._writer.add_message(self._channel(topic), log_time=at_ns, publish_time=at_ns, sequence=count, data=frame)
        if at_ns >= self._flush_due_ns:
            self._flush_due_ns = at_ns + _FLUSH_NS
            self._file.flush()

    def close(self) -> None:
        """Finish the file; safe to call twice."""
        if not self._file.closed:
            self._writer.finish()  # type: ignore[no-untyped-call]
            self._file.close()

    def _channel(self, topic: AnyTopic) -> int:
        if topic.key not in self._channels:
            schema = self._writer.register_schema(topic.type.__name__, ENCODING, describe(topic.type).encode())
            self._channels[topic.key] = self._writer.register_channel(topic.key, ENCODING, schema)
        return self._channels[topic.key]


class LiveRecorder:
    """Records what a link hears, without ever holding the link up: frames wait in a bounded queue for a thread that writes."""

    def __init__(self, recorder: Recorder):
        self.dropped = 0  # frames that found the queue full
        self.problem = ""  # why writing ended early, in words
        self._recorder = recorder
        self._queue: queue.Queue[tuple[AnyTopic, bytes, int] | None] = queue.Queue(_QUEUE_FRAMES)
        self._thread = threading.Thread(target=self._write, name="recorder", daemon=True)

    def take(self, topic: AnyTopic, frame: bytes, at_ns: int) -> None:
        """Have a frame written; from any thread, never blocking."""
        try:
            self._queue.put_nowait((topic, frame, at_ns))
        except queue.Full:
            self.dropped += 1

    def listen(self, link: Link, clock: Any) -> None:
        """Record every topic of the table that is not left out; `clock` gives the time [ns]."""
        for topic in topics.TOPICS:
            if topic not in self._recorder.skipped:
                link.subscribe(topic, lambda heard, frame: self.take(heard, frame, clock()))

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._queue.put(None)
        self._thread.join()
        try:
            self._recorder.close()
        except OSError as error:
            self.problem = f"the recording could not be finished: {error}"

    def _write(self) -> None:
        while (item := self._queue.get()) is not None:
            if self.problem:
                continue  # the walk goes on without its recording
            try:
                self._recorder.write(*item)
            except OSError as error:
                self.problem = f"the recording ended early: {error}"


class Recording:
    """A recorded run, read from its beginning in the order in which it was written."""

    def __init__(self, path: Path):
        """Open a file; nothing but its first bytes is looked at.

        Raises:
            RecordingError: No such file, or not an MCAP file.
        """
        self.path = path
        self.about: dict[str, str] = {}  # filled as `frames` comes across it: at the very beginning of the file
        self.complete = True  # False once `frames` found the file cut off
        try:
            with path.open("rb") as file:
                magic = file.read(8)
        except OSError as error:
            raise RecordingError(f"{path}: {error.strerror}; give the recording.mcap of a run's folder") from None
        if magic != b"\x89MCAP0\r\n":
            raise RecordingError(f"{path}: not an MCAP file; give the recording.mcap of a run's folder")

    def frames(self) -> Iterator[tuple[str, bytes, int]]:
        """(topic key, frame, time [ns]) of everything; a file cut off by a crash is read as far as it goes."""
        keys: dict[int, str] = {}
        with self.path.open("rb") as file:
            try:
                for record in StreamReader(file, validate_crcs=True).records:
                    match record:
                        case Channel():
                            keys[record.id] = record.topic
                        case Schema() if record.encoding != ENCODING:
                            raise RecordingError(f"{self.path}: schemas of {ENCODING!r} expected, found {record.encoding!r}")
                        case Metadata(name="run"):
                            self.about = dict(record.metadata)
                        case Entry():
                            if record.channel_id not in keys:
                                words = f"a message of channel {record.channel_id}, which the file does not declare"
                                raise RecordingError(f"{self.path}: damaged: {words}")
                            yield keys[record.channel_id], record.data, record.log_time
            except _CUT_OFF:
                self.complete = False

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
