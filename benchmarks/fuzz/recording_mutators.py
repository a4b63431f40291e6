"""Fuzz targets: recordings for the reader, the contents and the recovery.

Memory and times are bounded.
"""

import json
import resource
import struct
import tempfile
import zlib
from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from random import Random

import lz4.frame
import zstandard
from mcap.opcode import Opcode
from mcap.writer import CompressionType, Writer

from benchmarks.fuzz import message_corpus
from benchmarks.fuzz.mutators import broken
from benchmarks.fuzz.target import Folder
from sextant.shared.recording.contents import as_table, contents, in_words
from sextant.shared.recording.layout import RecordingError
from sextant.shared.recording.reader import Recording, is_whole
from sextant.shared.recording.records import LARGEST_BYTES, MAGIC
from sextant.shared.recording.recovery import recover
from sextant.shared.recording.writer import Recorder
from sextant.shared.wire import topics

_EXAMPLES = 8
_FRAMES = 12  # frames of an example
_APART_NS = 40_000_000
_LONGEST = 1 << 18  # [bytes] of a recording
_MOST_MEMORY = 4 * LARGEST_BYTES  # [bytes] maximum memory for reading a file
_HEAD = struct.Struct("<BQ")
_CHUNK = struct.Struct("<QQQI")  # start, end, size, checksum
_ODD_LENGTHS = (0, 1, 21, 22, 1 << 16, 1 << 26, (1 << 26) + 1, 3 << 30, 1 << 32, (1 << 63) - 1, (1 << 64) - 1)
_PACKERS: dict[bytes, Callable[[bytes], bytes]] = {b"": bytes, b"zstd": zstandard.compress, b"lz4": lz4.frame.compress}
_BOMB = zstandard.compress(bytes(1 << 20))

_Records = list[tuple[int, bytes]]  # opcode, body


def examples(rng: Random) -> tuple[bytes, ...]:
    """Return example recordings of this program and of others.

    They use each compression, or have no chunks, no checksums or no messages.
    """
    ways = [
        (CompressionType.ZSTD, True, True),
        (CompressionType.LZ4, True, False),
        (CompressionType.NONE, True, True),
        (CompressionType.NONE, False, False),
    ]
    return (*(_own(rng) for _ in range(_EXAMPLES)), *(_foreign(way, 20, rng) for way in ways), _foreign(ways[0], 0, rng))


def twisted(data: bytes, rng: Random) -> bytes:
    """Mutate records of a recording, or their order, with valid framing."""
    records = _records(data, len(MAGIC), len(data) - len(MAGIC))
    for _ in range(rng.randint(1, 3)):
        records = rng.choice(_WAYS)(records, rng)
    odd_length = rng.random() < 0.2
    at = rng.randrange(len(records) or 1)
    out = bytearray(MAGIC)
    for k, (opcode, body) in enumerate(records):
        length = rng.choice(_ODD_LENGTHS) if odd_length and k == at else len(body)
        out += _HEAD.pack(opcode, length) + body
    return bytes(out[:_LONGEST]) + (MAGIC if rng.random() < 0.9 else b"")


class Taker:
    """Reads a recording with every reader of the program, in a separate folder."""

    def __init__(self) -> None:
        self._folder = Folder()
        self._file = self._folder.path / "recording.mcap"
        self._target = self._folder.path / "recording.recovered.mcap"

    def take(self, data: bytes) -> bool:
        """Return whether it contains messages.

        Raise if intact data differs before and after recovery.
        """
        self._file.write_bytes(data)
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        try:
            recording = Recording(self._file)
            count = sum(1 for _ in recording.messages())
            found = contents(self._file)
            in_words(found)
            json.dumps(as_table(found))
            recovered = recover(self._file, self._target)
            if self._target.exists():
                _check_recovered(self._file, self._target, recovered.messages)
        except RecordingError:
            return False
        finally:
            self._target.unlink(missing_ok=True)
            more = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * 1024
            if more > _MOST_MEMORY:
                raise AssertionError(f"{more >> 20} MB of memory were used")
        return count > 0


def _check_recovered(source: Path, target: Path, messages: int) -> None:
    if not is_whole(target):
        raise AssertionError("the recovered file is not complete")
    if sum(track.messages for track in contents(target).tracks.values()) != messages:
        raise AssertionError(f"{messages} messages were recovered, but the file has other ones")
    if Recording(target).about != Recording(source).about:
        raise AssertionError("the recording's description of its run was lost")


def _own(rng: Random) -> bytes:
    """Return a recording of this program with some frames."""
    about = {"robot": "phantomx_mk2", "run": "lockstep", "scenario": "flat", "seed": "3"}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "recording.mcap"
        with Recorder(path, about) as recorder:
            for k in range(_FRAMES):
                topic = rng.choice(topics.TOPICS)
                recorder.write(topic, message_corpus.frame(topic.type, rng), k * _APART_NS)
                if k % 4 == 3:
                    recorder.flush()
        return path.read_bytes()


def _foreign(way: tuple[CompressionType, bool, bool], count: int, rng: Random) -> bytes:
    """Return a recording of another program that also contains frames of this one."""
    compression, chunked, checked = way
    out = BytesIO()
    writer = Writer(out, chunk_size=200, compression=compression, use_chunking=chunked, enable_crcs=checked)
    writer.start(profile="ros2", library="another")
    writer.add_metadata("weather", {"sky": "clear"})
    topic = topics.PLANNER_STATUS
    theirs = writer.register_channel("/положение", "json", writer.register_schema("Position", "jsonschema", b"{}"))
    ours = writer.register_channel(topic.key, "sextant", writer.register_schema(topic.type.__name__, "sextant", b"{}"))
    for k in range(count):
        writer.add_message(theirs, k * _APART_NS, b'{"x": 1}', k, k)
        writer.add_message(ours, k * _APART_NS, message_corpus.frame(topic.type, rng), k, k)
    writer.add_attachment(1, 2, "notes.txt", "text/plain", b"mown yesterday")
    writer.finish()  # type: ignore[no-untyped-call]
    return out.getvalue()


def _records(data: bytes, at: int, end: int) -> _Records:
    """Return opcodes and bodies of the complete records between two offsets."""
    found: _Records = []
    while at + _HEAD.size <= end:
        opcode, length = _HEAD.unpack_from(data, at)
        at += _HEAD.size
        if at + length > end:
            break
        found.append((opcode, data[at : at + length]))
        at += length
    return found


def _dropped(records: _Records, rng: Random) -> _Records:
    at = rng.randrange(len(records) or 1)
    return records[:at] + records[at + 1 :]


def _repeated(records: _Records, rng: Random) -> _Records:
    at = rng.randrange(len(records) or 1)
    return records[: at + 1] * 2 + records[at + 1 :]


def _shuffled(records: _Records, rng: Random) -> _Records:
    return rng.sample(records, len(records))


def _renamed(records: _Records, rng: Random) -> _Records:
    at, opcode = rng.randrange(len(records) or 1), rng.choice((*map(int, Opcode), 0, 0x10, 0x80, 0xFF))
    return [(opcode if k == at else kind, body) for k, (kind, body) in enumerate(records)]


def _odd_body(records: _Records, rng: Random) -> _Records:
    at = rng.randrange(len(records) or 1)
    bodies = [body for _, body in records]
    return [(kind, broken(body, bodies, rng) if k == at else body) for k, (kind, body) in enumerate(records)]


def _odd_chunk(records: _Records, rng: Random) -> _Records:
    """Mutate one chunk.

    It gets wrong header fields, a decompression bomb, or mutated records in a valid chunk.
    """
    chunks = [k for k, (kind, _) in enumerate(records) if kind == Opcode.CHUNK]
    if not chunks:
        return records
    at = rng.choice(chunks)
    start, end, size, crc, compression, packed = _chunk(records[at][1])
    what = rng.randrange(4)
    if what == 0:
        size = rng.choice(_ODD_LENGTHS)
    elif what == 1:
        compression, packed, size, crc = b"zstd", _BOMB * rng.randint(1, 3), rng.choice((*_ODD_LENGTHS, 1 << 20)), 0
    elif what == 2:
        compression = rng.choice((b"", b"lz4", b"zstd", b"bz2", b"\xff\xfe"))
    else:
        inner = _records(plain := _unpacked(compression, packed), 0, len(plain))
        inner = rng.choice((_dropped, _repeated, _shuffled, _renamed, _odd_body))(inner, rng)
        plain = b"".join(_HEAD.pack(kind, len(body)) + body for kind, body in inner)
        compression = rng.choice(list(_PACKERS))
        packed, size, crc = _PACKERS[compression](plain), len(plain), rng.choice((0, zlib.crc32(plain)))
    head = _CHUNK.pack(start, end, size, crc) + struct.pack("<I", len(compression)) + compression
    return [*records[:at], (int(Opcode.CHUNK), head + struct.pack("<Q", len(packed)) + packed), *records[at + 1 :]]


def _chunk(body: bytes) -> tuple[int, int, int, int, bytes, bytes]:
    try:
        (long,) = struct.unpack_from("<I", body, _CHUNK.size)
        begins = _CHUNK.size + 4 + long
        return *_CHUNK.unpack_from(body), body[_CHUNK.size + 4 : begins], body[begins + 8 :]
    except struct.error:  # mutated before
        return 0, 0, 0, 0, b"", b""


def _unpacked(compression: bytes, packed: bytes) -> bytes:
    try:
        match compression:
            case b"zstd":
                return zstandard.ZstdDecompressor().decompress(packed, max_output_size=1 << 20)
            case b"lz4":
                return bytes(lz4.frame.LZ4FrameDecompressor().decompress(packed, max_length=1 << 20))
    except (zstandard.ZstdError, RuntimeError):  # mutated before
        return b""
    return packed


_WAYS: tuple[Callable[[_Records, Random], _Records], ...] = (
    _dropped,
    _repeated,
    _shuffled,
    _renamed,
    _odd_body,
    _odd_body,
    _odd_chunk,
    _odd_chunk,
    _odd_chunk,
)
