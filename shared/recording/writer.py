"""Writer of one MCAP file: frames, and their translations for visualization tools."""

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

# If the process dies, at most the chunk that is being filled is lost.
_CHUNK_BYTES = 256 << 10
_FLUSH_NS = 500_000_000  # [ns] maximum time between two chunks

RESERVE_BYTES = 4_000_000  # disk space for the other files of a run, such as the report

# Images would be nine tenths of a file. Colour and views of the floor are made only for subscribers.
LEFT_OUT: frozenset[AnyTopic] = frozenset({topics.DEPTH, topics.EXTERNAL_DEPTH, topics.COLOR, topics.FLOOR})
# All scans are recorded, and they can reproduce the map. One map per second shows the result.
THINNED_NS: Mapping[AnyTopic, int] = {topics.TERRAIN: 1_000_000_000}


class Translator(Protocol):
    """Protocol of a translation of frames to Protobuf messages."""

    def translate(self, topic: AnyTopic, frame: bytes, at_ns: int) -> Sequence[tuple[str, ProtoMessage]]:
        """Return (topic, message) pairs for a frame received at a time [ns]."""
        ...


class Silent:
    """Translator without output."""

    def translate(self, topic: AnyTopic, frame: bytes, at_ns: int) -> Sequence[tuple[str, ProtoMessage]]:
        """Return no messages."""
        return ()


class Recorder:
    """Writes frames to an MCAP file; a context manager.

    It is not thread-safe, except for `sync`.
    """

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
            about: Description of the run, stored as metadata.
            translator: Translator of the recorded frames; None for no translations.
            left_out: Topics that are not recorded.
            thinned_ns: Topic -> minimum time [ns] between two recorded frames.

        Raises:
            WriteError: The file cannot be written.
        """
        self.path = path
        self.skipped = frozenset(left_out)
        self.size = 0  # [bytes] written so far
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
        """Path of the file as text."""
        return str(self.path)

    def takes(self, topic: AnyTopic, at_ns: int) -> bool:
        """Return whether a frame of a topic with a time [ns] would be recorded."""
        if topic in self.skipped:
            return False
        newest_ns = self._newest_ns.get(topic.key)
        return newest_ns is None or at_ns - newest_ns >= self._thinned_ns.get(topic, 0)

    def write(self, topic: AnyTopic, frame: bytes, at_ns: int) -> None:
        """Append a frame with the time [ns] at which it was sent or received.

        Raises:
            WriteError: The frame cannot be written; the recording has ended.
        """
        if not self.takes(topic, at_ns):
            return
        self._newest_ns[topic.key] = at_ns
        try:
            self._add(self._channel(topic), frame, at_ns)
            for name, message in self._translator.translate(topic, frame, at_ns):
                self._add(self._translated(name, message), message.SerializeToString(deterministic=True), at_ns)
        except OSError as error:
            raise self._ended(error) from error
        if at_ns >= self._flush_due_ns:
            self._flush_due_ns = at_ns + _FLUSH_NS
            self.flush()

    def flush(self) -> None:
        """Flush all written data to the operating system.

        The system keeps the data if this process dies.

        Raises:
            WriteError: The data cannot be written, or the disk is nearly full; the recording has ended.
        """
        with self._writing():
            self._writer.flush()  # type: ignore[no-untyped-call]
            self.size = self._file.tell()
        disk = os.fstatvfs(self._file.fileno())
        if disk.f_bavail * disk.f_frsize < RESERVE_BYTES:
            self.close()
            words = f"less than {RESERVE_BYTES // 1_000_000} MB of the disk are free, which the report needs; free some space"
            raise whole_files.WriteError(self.path, OSError(words), f"its first {self.size / 1e6:.1f} MB are intact")

    def sync(self) -> None:
        """Wait until all flushed data is on the disk.

        Any thread may call this, and it does not block other threads.
        """
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
        """Close the file without finishing it; its complete records stay readable."""
        try:
            with self._closing:
                self._file.close()
        except OSError:
            return  # unwritten data is lost; the caller already handles this error

    @contextlib.contextmanager
    def _writing(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise self._ended(error) from error

    def _ended(self, error: OSError) -> whole_files.WriteError:
        """End the recording because of an error, and return what to raise."""
        self.abandon()
        return whole_files.WriteError(self.path, error, f"its first {self.size / 1e6:.1f} MB are kept" if self.size else "")

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
    """Replaces a recorder whose file cannot be made; writing a frame raises the error."""

    size = 0
    skipped = frozenset(LEFT_OUT)

    def __init__(self, path: Path, error: whole_files.WriteError):
        self.target, self._error = str(path), error

    def write(self, topic: AnyTopic, frame: bytes, at_ns: int) -> None:
        """Raise the error of the file."""
        raise self._error

    def flush(self) -> None:
        """Raise the error of the file."""
        raise self._error

    def sync(self) -> None:
        """Do nothing, because there is no file."""

    def close(self) -> None:
        """Do nothing, because there is no file."""

    def abandon(self) -> None:
        """Do nothing, because there is no file."""


def declaration(file: Any) -> FileDescriptorSet:
    """Return the descriptors of a Protobuf file and its imports, imports first.

    MCAP uses them as the schema of a channel.
    """
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
