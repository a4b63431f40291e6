"""What is in a recording, told without decoding it."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mcap.records import Channel, Metadata, Schema
from mcap.records import Message as Entry
from mcap.stream_reader import StreamReader

from services.console.recording.layout import METADATA
from services.console.recording.reader import CUT_OFF, Recording


@dataclass(slots=True)
class Track:
    """One topic of a recording."""

    schema: str
    encoding: str
    messages: int = 0
    bytes: int = 0  # of the messages, before compression
    began_ns: int = -1
    ended_ns: int = -1

    @property
    def rate_hz(self) -> float:
        """Messages a second, from the first to the last."""
        span_s = (self.ended_ns - self.began_ns) * 1e-9
        return (self.messages - 1) / span_s if span_s > 0 else 0.0


@dataclass(slots=True)
class Contents:
    """A recording, file by file and topic by topic."""

    about: dict[str, str] = field(default_factory=dict)
    files: dict[str, int] = field(default_factory=dict)  # name -> bytes
    cut_off: list[str] = field(default_factory=list)  # names of files without an end
    tracks: dict[str, Track] = field(default_factory=dict)  # by topic

    @property
    def began_ns(self) -> int:
        """[ns] of the first message, -1 where there is none."""
        return min((t.began_ns for t in self.tracks.values() if t.messages), default=-1)

    @property
    def ended_ns(self) -> int:
        """[ns] of the last message, likewise."""
        return max((t.ended_ns for t in self.tracks.values()), default=-1)


def contents(path: Path) -> Contents:
    """Read a file, or the files of a folder, through.

    Raises:
        RecordingError: No such file, or not an MCAP file.
    """
    found = Contents()
    for file in Recording(path).files:
        found.files[file.name] = file.stat().st_size
        _read(file, found)
    found.tracks = dict(sorted(found.tracks.items()))
    return found


def _read(path: Path, found: Contents) -> None:
    schemas: dict[int, str] = {0: ""}
    topics: dict[int, str] = {}
    with path.open("rb") as file:
        try:
            for record in StreamReader(file, validate_crcs=True).records:
                match record:
                    case Schema():
                        schemas[record.id] = record.name
                    case Channel():
                        topics[record.id] = record.topic
                        known = Track(schemas.get(record.schema_id, "?"), record.message_encoding)
                        found.tracks.setdefault(record.topic, known)
                    case Metadata(name=name) if name == METADATA:
                        found.about = found.about or {k: v for k, v in record.metadata.items() if k != "frame_layout"}
                    case Entry() if record.channel_id in topics:
                        _count(found.tracks[topics[record.channel_id]], record)
        except CUT_OFF:
            found.cut_off.append(path.name)


def _count(track: Track, entry: Entry) -> None:
    track.messages += 1
    track.bytes += len(entry.data)
    track.began_ns = entry.log_time if track.began_ns < 0 else min(track.began_ns, entry.log_time)
    track.ended_ns = max(track.ended_ns, entry.log_time)


def as_table(found: Contents) -> Mapping[str, Any]:
    """As a plain table, for scripts."""
    return {
        "about": found.about,
        "files": found.files,
        "cut_off": found.cut_off,
        "began_s": found.began_ns * 1e-9,
        "duration_s": round((found.ended_ns - found.began_ns) * 1e-9, 3),
        "topics": {
            topic: {
                "schema": track.schema,
                "encoding": track.encoding,
                "messages": track.messages,
                "rate_hz": round(track.rate_hz, 2),
                "bytes": track.bytes,
            }
            for topic, track in found.tracks.items()
        },
    }


def in_words(found: Contents) -> str:
    """For people."""
    size = sum(found.files.values())
    duration = max(found.ended_ns - found.began_ns, 0) * 1e-9
    lines = [f"{len(found.files)} file{'s' if len(found.files) > 1 else ''}, {size / 1e6:.1f} MB, {duration:.1f} s"]
    lines += [f"  {name}: {value}" for name, value in found.about.items()]
    lines += [f"  {name} has no end: `sextant recover` makes it whole" for name in found.cut_off]
    lines.append(f"{'topic':<20} {'schema':<26} {'messages':>8} {'rate':>9} {'size':>10}")
    lines += [
        f"{topic:<20} {track.schema:<26} {track.messages:>8} {track.rate_hz:>6.1f} Hz {track.bytes / 1e6:>7.2f} MB"
        for topic, track in found.tracks.items()
    ]
    return "\n".join(lines)
