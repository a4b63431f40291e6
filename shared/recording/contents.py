"""Summary of a recording, without decoding its messages."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mcap.records import Attachment, Channel, Header, Metadata, Schema
from mcap.records import Message as Entry

from sextant.shared.recording.layout import FOR_PROGRAMS, METADATA
from sextant.shared.recording.reader import Recording, read_records
from sextant.shared.recording.records import Condition, printable


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
        """Mean message rate [Hz], from the first message to the last."""
        span_s = (self.ended_ns - self.began_ns) * 1e-9
        return (self.messages - 1) / span_s if span_s > 0 else 0.0


@dataclass(slots=True)
class Contents:
    """Contents of a recording, by file and by topic."""

    about: dict[str, str] = field(default_factory=dict)
    files: dict[str, int] = field(default_factory=dict)  # name -> bytes
    conditions: dict[str, Condition] = field(default_factory=dict)  # name -> condition of the file
    profiles: list[str] = field(default_factory=list)  # MCAP profiles of the files
    metadata: list[str] = field(default_factory=list)  # names of further metadata
    attachments: dict[str, int] = field(default_factory=dict)  # name -> bytes
    tracks: dict[str, Track] = field(default_factory=dict)  # by topic

    @property
    def cut_off(self) -> list[str]:
        """Names of files that are damaged or have no end, without empty files."""
        return [name for name, condition in self.conditions.items() if not (condition.whole or condition.empty)]

    @property
    def began_ns(self) -> int:
        """Time [ns] of the first message, -1 without messages."""
        return min((t.began_ns for t in self.tracks.values() if t.messages), default=-1)

    @property
    def ended_ns(self) -> int:
        """Time [ns] of the last message, -1 without messages."""
        return max((t.ended_ns for t in self.tracks.values()), default=-1)


def contents(path: Path) -> Contents:
    """Read a file, or all files of a folder, and summarize the contents.

    Raises:
        RecordingError: A file does not exist, or is not an MCAP file.
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
    condition = found.conditions[path.name] = Condition()
    for record in read_records(path, condition):
        match record:
            case Header() if record.profile and record.profile not in found.profiles:
                found.profiles.append(record.profile)
            case Schema():
                schemas[record.id] = record.name
            case Channel():
                topics[record.id] = record.topic
                known = Track(schemas.get(record.schema_id, "?"), record.message_encoding)
                found.tracks.setdefault(record.topic, known)
            case Metadata(name=name) if name == METADATA and not found.about:
                found.about = {k: v for k, v in record.metadata.items() if k not in FOR_PROGRAMS}
            case Metadata(name=name) if name != METADATA:
                found.metadata.append(name)
            case Attachment():
                found.attachments[record.name] = len(record.data)
            case Entry() if record.channel_id in topics:
                _count(found.tracks[topics[record.channel_id]], record)


def _count(track: Track, entry: Entry) -> None:
    track.messages += 1
    track.bytes += len(entry.data)
    track.began_ns = entry.log_time if track.began_ns < 0 else min(track.began_ns, entry.log_time)
    track.ended_ns = max(track.ended_ns, entry.log_time)


def as_table(found: Contents) -> Mapping[str, Any]:
    """Return the contents as a plain table, for scripts."""
    return {
        "about": found.about,
        "files": found.files,
        "cut_off": found.cut_off,
        "lost": {name: condition.lost for name, condition in found.conditions.items() if condition.lost},
        "profiles": found.profiles,
        "metadata": found.metadata,
        "attachments": found.attachments,
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
    """Return the contents as text for the terminal."""
    size = sum(found.files.values())
    duration = max(found.ended_ns - found.began_ns, 0) * 1e-9
    lines = [f"{len(found.files)} file{'s' if len(found.files) > 1 else ''}, {size / 1e6:.1f} MB, {duration:.1f} s"]
    lines += [f"  {printable(name)}: {printable(value)}" for name, value in found.about.items()]
    lines += [f"  profile of MCAP: {printable(profile)}" for profile in found.profiles]
    lines += [f"  further metadata: {', '.join(map(printable, found.metadata))}"] if found.metadata else []
    lines += [f"  attachment {printable(name)}: {size} bytes" for name, size in found.attachments.items()]
    lines += [_condition_words(name, condition) for name, condition in found.conditions.items() if not condition.whole]
    lines.append(f"{'topic':<20} {'schema':<26} {'messages':>8} {'rate':>9} {'size':>10}")
    lines += [
        f"{printable(topic):<20} {printable(track.schema):<26} {track.messages:>8} "
        f"{track.rate_hz:>6.1f} Hz {track.bytes / 1e6:>7.2f} MB"
        for topic, track in found.tracks.items()
    ]
    return "\n".join(lines)


def _condition_words(name: str, condition: Condition) -> str:
    if condition.empty:
        return f"  {name} is an empty recording: nothing to recover"
    if not condition.messages and condition.lost:
        return f"  {name}: no part of it is intact ({', '.join(condition.lost)} lost)"
    if condition.ended:
        lost = ", ".join(condition.lost) or "its index"
        return f"  {name} is damaged ({lost}): `sextant recording recover` keeps the intact parts"
    lost = f" ({', '.join(condition.lost)} lost)" if condition.lost else ""
    return f"  {name} is incomplete{lost}: `sextant recording recover` completes it"
