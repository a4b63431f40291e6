"""Reader of MCAP records that skips and counts damaged ones.

The file may have any content.

Memory is bounded: records, and unpacked chunks, of more than `LARGEST_BYTES` are not loaded.
"""

import re
import struct
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from io import BytesIO
from typing import BinaryIO

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile, McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, DataEnd, Footer, Header, McapRecord, MessageIndex, Metadata, Schema
from mcap.records import Message as Entry

MAGIC = b"\x89MCAP0\r\n"
LARGEST_BYTES = 64_000_000
_LATEST_NS = (1 << 63) - 1  # times [ns] are signed in Sextant
_HEAD = struct.Struct("<BQ")  # head of a record: opcode, length of the contents
_ENTRY = struct.Struct("<HIQQ")  # head of a message: channel, sequence, log time, publish time
_TAIL = struct.Struct("<BQQQI8s")  # end of a file: footer and closing magic
_PIECE_BYTES = 1 << 20  # unpacked, or searched, at a time
_WINDOW_BYTES = 1 << 27  # maximum window of a Zstandard frame
_PRIVATE = 0x80  # first opcode reserved for applications
# Heads of records within the size limit. The lookahead finds overlapping matches: a head may start inside a false one.
_CANDIDATE = re.compile(rb"(?=[\x03-\x0f][\x00-\xff]{3}[\x00-\x04]\x00{4})")
_SEARCH_SHARE = 8  # bytes that a search may examine per byte of the file


class _DamagedError(McapError):
    """The contents of a record are inconsistent."""


@dataclass(slots=True)
class Condition:
    """State of a file, as far as it has been read."""

    size: int = 0  # [bytes]
    ended: bool = False  # whether it has a footer and closing magic
    messages: int = 0  # number of intact messages
    damaged: int = 0  # number of damaged records and chunks, which were skipped
    too_large: Counter[str] = field(default_factory=Counter)  # number of skipped large records, by kind
    lost_bytes: int = 0  # bytes between intact records that belong to no record
    tail_bytes: int = 0  # bytes after the last intact record
    index_damaged: bool = False  # an index does not match the messages, or the summary does not match its checksum
    dropped: Counter[str] = field(default_factory=Counter)  # number of records that cannot be copied, by kind

    @property
    def empty(self) -> bool:
        """Whether the file ends before its first record."""
        return self.size <= len(MAGIC)

    @property
    def whole(self) -> bool:
        """Whether nothing is missing."""
        missing = self.damaged or self.too_large or self.lost_bytes or self.tail_bytes or self.index_damaged
        return self.ended and not missing

    @property
    def lost(self) -> list[str]:
        """List of the losses as text."""
        lost = [f"{self.damaged} damaged parts"] if self.damaged else []
        lost += [f"{self.lost_bytes} bytes between whole parts"] if self.lost_bytes else []
        lost += [f"{self.tail_bytes} bytes at the end"] if self.tail_bytes else []
        return lost + [f"{count} {kind}" for kind, count in (self.too_large + self.dropped).items()]


def records(file: BinaryIO, condition: Condition) -> Iterator[McapRecord]:
    """Yield the intact records of an open file in order.

    The records inside a chunk replace the chunk.

    Args:
        file: Seekable file that begins with `MAGIC`, or with a part of it.
        condition: Updated while records are read.

    Raises:
        OSError: The file cannot be read.
    """
    return _Reader(file, condition).records()


def printable(text: str) -> str:
    """Return a text with its control characters replaced, safe to print on a terminal."""
    return "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in text)


class _Reader:
    """Reads record by record, and continues at the next intact record after damage."""

    def __init__(self, file: BinaryIO, condition: Condition):
        self._file, self._condition = file, condition
        self._size = condition.size = file.seek(0, 2)
        self._channels: set[int] = set()
        self._index: dict[int, list[tuple[int, int]]] = {}  # channel -> (time [ns], offset) of messages in the newest chunk
        self._budget = _SEARCH_SHARE * self._size
        self._asked_summary = False

    def records(self) -> Iterator[McapRecord]:
        at = len(MAGIC)
        while at < self._size:
            head = self._head(at)
            if head is None:
                yield from self._declarations()
                found = self._next_whole(at + 1)
                if found < 0:
                    self._condition.tail_bytes = self._size - at
                    return
                self._condition.damaged += 1
                self._condition.lost_bytes += found - at
                at = found
                continue
            opcode, end = head
            before = self._missing
            whole_to, record = self._read(opcode, at, end)
            if isinstance(record, Chunk):
                yield from self._noted(self._inside(record))
            elif record is not None and not isinstance(record, _UNWANTED):
                yield from self._noted(iter((record,)))
            if isinstance(record, MessageIndex) and sorted(record.records) != sorted(self._index.get(record.channel_id, [])):
                self._condition.index_damaged = True
            if isinstance(record, Footer) and self._check_end(record, end):
                return
            if self._missing > before:
                yield from self._declarations()
            if end == self._size or self._head(end) is not None or self._file_ends(end):
                at = end
                continue
            found = self._next_whole(max(whole_to, at + 1))
            if found < 0:
                self._condition.tail_bytes = self._size - whole_to
                return
            self._condition.lost_bytes += found - whole_to
            at = found

    @property
    def _missing(self) -> int:
        return self._condition.damaged + self._condition.too_large.total()

    def _noted(self, found: Iterator[McapRecord]) -> Iterator[McapRecord]:
        for record in found:
            if isinstance(record, Channel):
                self._channels.add(record.id)
            self._condition.messages += isinstance(record, Entry)
            yield record

    def _bytes(self, at: int, count: int) -> bytes:
        self._file.seek(at)
        return self._file.read(count)

    def _head(self, at: int) -> tuple[int, int] | None:
        """Return opcode and end of the record at an offset, or None without a record."""
        data = self._bytes(at, _HEAD.size)
        if len(data) < _HEAD.size:
            return None
        opcode, length = _HEAD.unpack(data)
        if not (opcode in _OPCODES or opcode >= _PRIVATE) or length > self._size - at - _HEAD.size:
            return None
        return opcode, at + _HEAD.size + length

    def _file_ends(self, at: int) -> bool:
        return self._size - at == len(MAGIC) and self._bytes(at, len(MAGIC)) == MAGIC

    def _read(self, opcode: int, at: int, end: int) -> tuple[int, McapRecord | None]:
        """Read a record, and return the end of its intact part and the record or None.

        The end is the start of the record if it is damaged.
        """
        begins = at + _HEAD.size
        if opcode not in _PARSERS:
            if opcode >= _PRIVATE:
                self._condition.dropped[f"private records 0x{opcode:02x}"] += 1
            return end, None
        if end - begins > LARGEST_BYTES:
            self._condition.too_large[f"records of more than {LARGEST_BYTES // 1_000_000} MB"] += 1
            return end, None
        try:
            record, consumed = _parse(opcode, self._bytes(begins, end - begins))
        except _DAMAGE:
            self._condition.damaged += 1
            return at, None
        return begins + consumed, record

    def _inside(self, chunk: Chunk) -> Iterator[McapRecord]:
        """Yield the records in a chunk."""
        self._index = {}
        if chunk.uncompressed_size > LARGEST_BYTES:
            self._condition.too_large[f"chunks that unpack to more than {LARGEST_BYTES // 1_000_000} MB"] += 1
            return
        try:
            data = unpacked(chunk)
        except _DAMAGE:
            self._condition.damaged += 1
            return
        at = 0
        while at < len(data):
            opcode, length = _HEAD.unpack_from(data, at) if len(data) - at >= _HEAD.size else (0, 0)
            begins, end = at + _HEAD.size, at + _HEAD.size + length
            if end > len(data) or not (opcode in _OPCODES or opcode >= _PRIVATE):
                self._condition.damaged += 1
                return
            if opcode in _IN_CHUNKS:
                try:
                    record, _ = _parse(opcode, data[begins:end])
                except _DAMAGE:
                    self._condition.damaged += 1
                else:
                    if isinstance(record, Entry):
                        self._index.setdefault(record.channel_id, []).append((record.log_time, at))
                    yield record
            at = end

    def _check_end(self, footer: Footer, end: int) -> bool:
        """Return whether the file ends after a footer, and check the summary's checksum."""
        if not self._file_ends(end):
            return False
        self._condition.ended = True
        crc_at = end - 4
        if footer.summary_crc and 0 < footer.summary_start <= crc_at <= footer.summary_start + LARGEST_BYTES:
            summary = self._bytes(footer.summary_start, crc_at - footer.summary_start)
            self._condition.index_damaged |= zlib.crc32(summary) != footer.summary_crc
        return True

    def _declarations(self) -> Iterator[McapRecord]:
        """Yield schemas and channels from the summary, once.

        The summary repeats the declarations that may be lost in damaged parts.
        """
        if self._asked_summary or self._size < len(MAGIC) + _TAIL.size:
            return
        self._asked_summary = True
        opcode, length, at, _, _, magic = _TAIL.unpack(self._bytes(self._size - _TAIL.size, _TAIL.size))
        end_of_summary = self._size - _TAIL.size
        if (opcode, length, magic) != (Opcode.FOOTER, 20, MAGIC) or not len(MAGIC) < at < end_of_summary:
            return
        while at < end_of_summary and (head := self._head(at)) is not None:
            opcode, end = head
            if opcode in (Opcode.SCHEMA, Opcode.CHANNEL) and end - at <= LARGEST_BYTES:
                try:
                    record, _ = _parse(opcode, self._bytes(at + _HEAD.size, end - at - _HEAD.size))
                except _DAMAGE:
                    return
                yield from self._noted(iter((record,)))
            at = end

    def _next_whole(self, start: int) -> int:
        """Return the start of the next intact record at or after an offset, or -1."""
        for at in self._candidates(start):
            head = self._head(at)
            if head is None or self._budget <= 0:
                continue
            opcode, end = head
            if end != self._size and self._head(end) is None and not self._file_ends(end):
                continue
            self._budget -= end - at
            if self._is_whole(opcode, self._bytes(at + _HEAD.size, end - at - _HEAD.size)):
                return at
        return -1

    def _candidates(self, start: int) -> Iterator[int]:
        while start < self._size:
            data = self._bytes(start, _PIECE_BYTES + _HEAD.size)
            for match in _CANDIDATE.finditer(data):
                if match.start() < _PIECE_BYTES:
                    yield start + match.start()
            start += _PIECE_BYTES

    def _is_whole(self, opcode: int, body: bytes) -> bool:
        if opcode not in _PARSERS:
            return False
        try:
            record, consumed = _parse(opcode, body)
            if isinstance(record, Chunk):
                unpacked(record)
        except _DAMAGE:
            return False
        if isinstance(record, Entry) and record.channel_id not in self._channels:
            return False
        return bool(consumed == len(body))


class _Body(ReadDataStream):
    """Stream over the bytes of one record; reading beyond its end raises EndOfFile."""

    def __init__(self, data: bytes):
        super().__init__(BytesIO(data))
        self._length = len(data)

    def read(self, length: int) -> bytes:
        if not 0 <= length <= self._length - self.count:
            raise EndOfFile
        return super().read(length)


def _of(kind: type[McapRecord]) -> Callable[[bytes], tuple[McapRecord, int]]:
    def parse(data: bytes) -> tuple[McapRecord, int]:
        body = _Body(data)
        return kind.read(body), body.count  # type: ignore[attr-defined]  # each has it

    return parse


def _entry(data: bytes) -> tuple[McapRecord, int]:
    if len(data) < _ENTRY.size:
        raise _DamagedError
    channel, sequence, log_ns, publish_ns = _ENTRY.unpack_from(data)
    if log_ns > _LATEST_NS:
        raise _DamagedError
    return Entry(channel, log_ns, data[_ENTRY.size :], publish_ns, sequence), len(data)


def _chunk(data: bytes) -> tuple[McapRecord, int]:
    record, consumed = _of(Chunk)(data)
    if consumed != len(data):
        raise _DamagedError
    return record, consumed


def _attachment(data: bytes) -> tuple[McapRecord, int]:
    record, consumed = _of(Attachment)(data)
    (crc,) = struct.unpack_from("<I", data, consumed - 4)
    if crc and zlib.crc32(data[: consumed - 4]) != crc:
        raise _DamagedError
    return record, consumed


_PARSERS: dict[int, Callable[[bytes], tuple[McapRecord, int]]] = {
    Opcode.HEADER: _of(Header),
    Opcode.FOOTER: _of(Footer),
    Opcode.SCHEMA: _of(Schema),
    Opcode.CHANNEL: _of(Channel),
    Opcode.MESSAGE: _entry,
    Opcode.CHUNK: _chunk,
    Opcode.ATTACHMENT: _attachment,
    Opcode.MESSAGE_INDEX: _of(MessageIndex),
    Opcode.METADATA: _of(Metadata),
    Opcode.DATA_END: _of(DataEnd),
}
_UNWANTED = (MessageIndex, DataEnd)  # records that are not yielded
_OPCODES = frozenset(int(opcode) for opcode in Opcode)
_IN_CHUNKS = frozenset((Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE))
_DAMAGE = (McapError, struct.error, UnicodeDecodeError, zstandard.ZstdError, RuntimeError)  # lz4 raises RuntimeError


def _parse(opcode: int, data: bytes) -> tuple[McapRecord, int]:
    """Return a record, and the number of bytes consumed."""
    return _PARSERS[opcode](data)


def unpacked(chunk: Chunk) -> bytes:
    """Decompress the records of a chunk.

    Raises:
        McapError: The size is over the limit or differs from the header, the checksum is wrong, or the compression is unknown.
        ZstdError: The Zstandard data is damaged.
        RuntimeError: The LZ4 data is damaged.
    """
    size = chunk.uncompressed_size
    if size > LARGEST_BYTES:
        raise _DamagedError(f"a chunk of at most {LARGEST_BYTES} bytes expected, found {size}")
    match chunk.compression:
        case "":
            data = chunk.data
        case "zstd":
            data = _zstd(chunk.data, size)
        case "lz4":
            data = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=size + 1)
        case other:
            raise _DamagedError(f"zstd, lz4 or nothing expected as compression, found {other!r}")
    if len(data) != size:
        raise _DamagedError(f"{size} bytes expected in a chunk, found {len(data)} or more")
    if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
        raise _DamagedError("the checksum of a chunk does not match")
    return data


def _zstd(data: bytes, size: int) -> bytes:
    """Decompress Zstandard data, to at most one byte more than expected."""
    out = bytearray()
    with zstandard.ZstdDecompressor(max_window_size=_WINDOW_BYTES).stream_reader(data, read_across_frames=True) as stream:
        while len(out) <= size and (piece := stream.read(min(_PIECE_BYTES, size + 1 - len(out)))):
            out += piece
    return bytes(out)
