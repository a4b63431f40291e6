"""One MCAP file: the frames of the wire as they are, and beside them what people's tools draw."""

import contextlib
import os
import threading
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol, Self

from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.message import Message as ProtoMessage
from mcap.writer import CompressionType, Writer

from sextant.shared.files import whole_files
from sextant.shared.recording.layout import ENCODING, FRAME_LAYOUT, METADATA, describe
from sextant.shared.runtime.service import AnyTopic
from sextant.shared.wire import topics

# What is lost at most when the process dies: the chunk that is being filled.
_CHUNK_BYTES = 256 << 10
_FLUSH_NS = 500_000_000  # from one chunk to the next at most

RESERVE_BYTES = 4 << 20  # of the disk, for what a run leaves behind beside its recording

# Pictures would be nine tenths of a file, and asking for colour makes the simulator render it.
LEFT_OUT: frozenset[AnyTopic] = frozenset({topics.DEPTH, topics.COLOR})
# The scans, all recorded, make the map again; one map a second shows what came of them.
THINNED_NS: Mapping[AnyTopic, int] = {topics.TERRAIN: 1_000_000_000}


class Translator(Protocol):
    """Says in another language what a frame says."""

    def translate(self, topic: AnyTopic, frame: bytes, at_ns: int) -> Sequence[tuple[str, ProtoMessage]]:
        """(topic of the other language, message) for a frame that came at a time [ns]."""
        ...


class Silent:
    """Translates nothing."""

    def translate(self, topic: AnyTopic, frame: bytes, at_ns: int) -> Sequence[tuple[str, ProtoMessage]]:
        """Nothing."""
        return ()


class Recorder:
    """Writes frames into an MCAP file; a context manager. Used by one thread at a time, but for `sync`."""

    def __init__(
        self,
        path: Path,
        about: Mapping[str, str],
        translator: Translator | None = None,
        left_out: Iterable[AnyTopic] = LEFT_OUT,
        thinned_ns: Mapping[AnyTopic, int] = THINNED_NS,
    ):
        """Open the file.

        Args:
            path: File to write; its folder exists.
            about: What the run was, in words, for whoever finds the file.
            translator: What is written beside the frames that are recorded; None for nothing.
            left_out: Topics that are not recorded.
            thinned_ns: Topic -> time [ns] that passes between two recorded frames.

        Raises:
            WriteError: The file cannot be written.
        """
        self.path = path
        self.skipped = frozenset(left_out)
        self.size = 0  # written so far
        self._translator = translator or Silent()
        self._thinned_ns = thinned_ns
        self._newest_ns: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}  # of translations, by name
        self._counts: dict[int, int] = {}
        self._closing = threading.Lock()
        with whole_files.explained(path):
            self._file = path.open("wb")
        with self._writing():
            self._writer = Writer(self._file, chunk_size=_CHUNK_BYTES, compression=CompressionType.ZSTD)
            self._writer.start(profile="", library="sextant")
            self._writer.add_metadata(METADATA, {**about, "frame_layout": FRAME_LAYOUT})
            self._file.flush()
        self._flush_due_ns = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    @property
    def target(self) -> str:
        """The file, in words."""
        return str(self.path)

    def write(self, topic: AnyTopic, frame: bytes, at_ns: int) -> None:
        """Append a frame with the time [ns] at which it was sent or came.

        Raises:
            WriteError: It could not be written; the recording has ended.
        """
        if topic in self.skipped:
            return
        apart_ns = self._thinned_ns.get(topic, 0)
        if topic.key in self._newest_ns and at_ns - self._newest_ns[topic.key] < apart_ns:
            return
        self._newest_ns[topic.key] = at_ns
        with self._writing():
            self._add(self._channel(topic), frame, at_ns)
            for name, message in self._translator.translate(topic, frame, at_ns):
                self._add(self._translated(name, message), message.SerializeToString(deterministic=True), at_ns)
        if at_ns >= self._flush_due_ns:
            self._flush_due_ns = at_ns + _FLUSH_NS
            self.flush()

    def flush(self) -> None:
        """Hand all that was written over to the system: what then becomes of this process is nothing to it.

        Raises:
            WriteError: It could not be written, or the disk is nearly full; the recording has ended.
        """
        with self._writing():
            self._writer.flush()  # type: ignore[no-untyped-call]
            self.size = self._file.tell()
        disk = os.fstatvfs(self._file.fileno())
        if disk.f_bavail * disk.f_frsize < RESERVE_BYTES:
            self.close()
            words = f"less than {RESERVE_BYTES >> 20} MB of the disk are free, which the report needs; make room"
            raise whole_files.WriteError(self.path, OSError(words), f"its first {self.size / 1e6:.1f} MB are whole")

    def sync(self) -> None:
        """Wait until what was flushed is on the disk; from any thread, holding nobody else up."""
        with self._closing:
            if self._file.closed:
                return
            descriptor = os.dup(self._file.fileno())
        try:
            with whole_files.explained(self.path):
                os.fdatasync(descriptor)
        finally:
            os.close(descriptor)

    def close(self) -> None:
        """Finish the file; safe to call twice."""
        if not self._file.closed:
            with self._writing():
                self._writer.finish()  # type: ignore[no-untyped-call]
                self.size = self._file.tell()
                with self._closing:
                    self._file.close()

    def abandon(self) -> None:
        """Close the file as it is: it can be read as far as it goes."""
        try:
            with self._closing:
                self._file.close()
        except OSError:
            return  # what could not be written is lost, which whoever abandons it knows

    @contextlib.contextmanager
    def _writing(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            self.abandon()
            kept = f"its first {self.size / 1e6:.1f} MB are kept" if self.size else ""
            raise whole_files.WriteError(self.path, error, kept) from error

    def _add(self, channel: int, data: bytes, at_ns: int) -> None:
        count = self._counts[channel] = self._counts.get(channel, -1) + 1
        self._writer.add_message(channel, log_time=at_ns, publish_time=at_ns, sequence=count, data=data)

    def _channel(self, topic: AnyTopic) -> int:
        if topic.key not in self._channels:
            schema = self._writer.register_schema(topic.type.__name__, ENCODING, describe(topic.type).encode())
            self._channels[topic.key] = self._writer.register_channel(topic.key, ENCODING, schema)
        return self._channels[topic.key]

    def _translated(self, name: str, message: ProtoMessage) -> int:
        if name not in self._channels:
            kind = message.DESCRIPTOR
            if kind.full_name not in self._schemas:
                declared = declaration(kind.file).SerializeToString(deterministic=True)
                self._schemas[kind.full_name] = self._writer.register_schema(kind.full_name, "protobuf", declared)
            self._channels[name] = self._writer.register_channel(name, "protobuf", self._schemas[kind.full_name])
        return self._channels[name]


class Unwritable:
    """Stands in for a recorder whose file cannot be made: the first frame raises why."""

    size = 0
    skipped = frozenset(LEFT_OUT)

    def __init__(self, path: Path, error: whole_files.WriteError):
        self.target, self._error = str(path), error

    def write(self, topic: AnyTopic, frame: bytes, at_ns: int) -> None:
        """Raise why the file cannot be made."""
        raise self._error

    def flush(self) -> None:
        """Raise why the file cannot be made."""
        raise self._error

    def sync(self) -> None:
        """Nothing is there to be brought to the disk."""

    def close(self) -> None:
        """Nothing is open."""

    def abandon(self) -> None:
        """Nothing is open."""


def declaration(file: Any) -> FileDescriptorSet:
    """The descriptor of a Protobuf file with all that it imports, those first: what MCAP has as a Protobuf channel's schema."""
    found: dict[str, Any] = {}

    def visit(one: Any) -> None:
        for needed in one.dependencies:
            visit(needed)
        found.setdefault(one.name, one)

    visit(file)
    declared = FileDescriptorSet()
    for one in found.values():
        one.CopyToProto(declared.file.add())
    return declared
