"""Topic statistics: rate and bandwidth per topic, and totals per lane and side.

Measured rates are shown next to those of the topic table.
"""

import threading
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from types import MappingProxyType
from typing import Any

import numpy as np

from sextant.deploy.launch.process_table import TABLE
from sextant.deploy.topics.passive_subscriber import age_ns
from sextant.shared.runtime.service import AnyTopic
from sextant.shared.wire.codec import DecodeError, label, schema_id
from sextant.shared.wire.topics import Lane

_SIDES = {"robot": "onboard", "device": "onboard", "either": "offboard", "page": "offboard", "simulation": "simulation"}
# The first word of a key is the process that publishes it, with these exceptions.
_WRITTEN_BY: Mapping[str, str] = MappingProxyType(
    {"operator": "operators", "imu": "onboard", "external": "all", "passage": "offboard", "health": "all", "machine": "all"}
)
_TOTAL = "{:<22} {:<8} {:>16} {:>11}"
_BUDGET = _TOTAL + " {:>11}"
_LINE = _TOTAL + " {:>9} {:>9} {:>12} {:>18}"
_OF_TOTALS = """sender: side of the publisher; operators: clients that order; all: health and presence of every side,
and poses from elsewhere
at most: the volume if each topic had messages of the largest size at its documented rate"""


def side(topic: AnyTopic) -> str:
    """Return the side of a topic's publisher.

    It is onboard, offboard, operators, simulation, or all.
    """
    word = topic.key.partition("/")[0]
    known = {process.name: _SIDES[process.side] for process in TABLE}
    return _WRITTEN_BY.get(word) or known[word]


@dataclass(slots=True)
class _Count:
    frames: int = 0
    bytes: int = 0
    largest: int = 0  # [bytes]
    last_ns: int = 0
    gap_ns: int = 0  # [ns] longest gap between two frames
    ages_ns: list[int] = field(default_factory=list)
    refused: int = 0
    refusal: str = ""


@dataclass(frozen=True, slots=True)
class Row:
    """Statistics of one topic over the listening time."""

    key: str
    side: str
    lane: Lane
    expected_hz: float
    more: str  # what is sent besides, as text
    frames: int
    rate_hz: float
    bytes_per_s: float
    budget_bytes_per_s: float  # [bytes/s] that its rate and largest size allow
    mean_bytes: float
    largest_bytes: int
    gap_ms: float | None  # longest gap between two frames; None with fewer than two
    age_ms: tuple[float, float] | None  # median and largest; None if stamped by another machine's clock
    refused: int
    refusal: str  # newest reason, as text


class Rates:
    """Counts frames as they arrive; from any thread."""

    def __init__(self, wanted: Iterable[AnyTopic]):
        self._counts = {topic: _Count() for topic in wanted}
        self._lock = threading.Lock()

    def take(self, topic: AnyTopic, frame: bytes, at_ns: int) -> None:
        """Count one frame that arrived at a time [ns]."""
        try:
            found, problem = label(frame), ""
        except DecodeError as error:
            found, problem = None, str(error)
        if found is not None and found.schema_id != schema_id(topic.type):
            problem = f"schema {schema_id(topic.type)} expected, found {found.schema_id}: the sender is another version"
        elif len(frame) > topic.max_bytes:
            problem = f"at most {topic.max_bytes} bytes expected, found {len(frame)}"
        age = age_ns(found, at_ns) if found is not None else None
        with self._lock:
            count = self._counts[topic]
            if count.frames:
                count.gap_ns = max(count.gap_ns, at_ns - count.last_ns)
            count.frames, count.last_ns = count.frames + 1, at_ns
            count.bytes, count.largest = count.bytes + len(frame), max(count.largest, len(frame))
            if age is not None:
                count.ages_ns.append(age)
            if problem:
                count.refused, count.refusal = count.refused + 1, problem

    def rows(self, duration_s: float) -> list[Row]:
        """Return the statistics over a time [s], in the order of the topic table."""
        with self._lock:
            return [_row(topic, count, duration_s) for topic, count in self._counts.items()]


def _row(topic: AnyTopic, count: _Count, duration_s: float) -> Row:
    ages = np.array(count.ages_ns) * 1e-6
    return Row(
        key=topic.key,
        side=side(topic),
        lane=topic.lane,
        expected_hz=topic.rate_hz,
        more=topic.more,
        frames=count.frames,
        rate_hz=count.frames / duration_s,
        bytes_per_s=count.bytes / duration_s,
        budget_bytes_per_s=topic.rate_hz * topic.max_bytes,
        mean_bytes=count.bytes / count.frames if count.frames else 0.0,
        largest_bytes=count.largest,
        gap_ms=count.gap_ns * 1e-6 if count.frames > 1 else None,
        age_ms=(float(np.median(ages)), float(ages.max())) if len(ages) else None,
        refused=count.refused,
        refusal=count.refusal,
    )


@dataclass(frozen=True, slots=True)
class Total:
    """Total rate and bandwidth of a side on a lane."""

    rate_hz: float = 0.0
    bytes_per_s: float = 0.0
    budget_bytes_per_s: float = 0.0  # [bytes/s] of all its topics, including silent ones


def totals(rows: Iterable[Row]) -> dict[tuple[str, Lane], Total]:
    """Return (side, lane) -> total; the side `sum` has all topics of a lane."""
    found: dict[tuple[str, Lane], Total] = {}
    for row in rows:
        for who in (row.side, "sum"):
            before = found.get((who, row.lane), Total())
            found[who, row.lane] = Total(
                before.rate_hz + row.rate_hz,
                before.bytes_per_s + row.bytes_per_s,
                before.budget_bytes_per_s + row.budget_bytes_per_s,
            )
    return found


def in_words(rows: list[Row]) -> str:
    """Format the statistics as lines of text, with silent topics at the end."""
    lines = [_LINE.format("key", "lane", "rate, of", "per second", "mean", "largest", "longest gap", "age (largest)")]
    for row in rows:
        if row.frames:
            beside = f"{row.rate_hz:.1f}, {row.expected_hz:g} Hz{'*' if row.more else ' '}"
            gap = f"{row.gap_ms:.0f} ms" if row.gap_ms is not None else "-"
            age = f"{row.age_ms[0]:.1f} ({row.age_ms[1]:.1f}) ms" if row.age_ms is not None else "another clock"
            sizes = (_size(row.bytes_per_s), _size(row.mean_bytes), _size(row.largest_bytes))
            lines.append(_LINE.format(row.key, row.lane.value, beside, *sizes, gap, age))
    more = [f"{row.key} {row.expected_hz:g} Hz{row.more}" for row in rows if row.frames and row.more]
    lines += [f"* {', '.join(more)}"] if more else []
    lines += ["", _BUDGET.format("sender", "lane", "messages", "per second", "at most")]
    for (who, lane), total in sorted(totals(rows).items(), key=lambda item: (item[0][0] == "sum", item[0][0])):
        if total.rate_hz:
            lines.append(
                _BUDGET.format(
                    who, lane.value, f"{total.rate_hz:.1f} Hz", _size(total.bytes_per_s), _size(total.budget_bytes_per_s)
                )
            )
    lines += ["", _OF_TOTALS]
    silent = [row.key for row in rows if not row.frames]
    lines += [f"\nsilent: {', '.join(silent)}"] if silent else []
    lines += [f"{row.key}: {row.refused} of {row.frames} cannot be decoded: {row.refusal}" for row in rows if row.refused]
    return "\n".join(lines)


def for_scripts(rows: list[Row], duration_s: float) -> dict[str, Any]:
    """Return the statistics as JSON values."""
    sizes = ("bytes_per_s", "budget_bytes_per_s", "mean_bytes", "largest_bytes", "gap_ms")
    names = ("key", "side", "expected_hz", "more", "frames", "rate_hz", *sizes)
    return {
        "duration_s": duration_s,
        "topics": [
            {
                **{name: getattr(row, name) for name in names},
                "lane": row.lane.value,
                "age_ms": None if row.age_ms is None else {"p50": row.age_ms[0], "max": row.age_ms[1]},
                "refused": row.refused,
                "refusal": row.refusal,
            }
            for row in rows
        ],
        "totals": [{"side": who, "lane": lane.value, **asdict(total)} for (who, lane), total in totals(rows).items()],
    }


def _size(count: float) -> str:
    """Format a number of bytes as text."""
    if count < 1000:
        return f"{count:.0f} B"
    return f"{count / 1e3:.1f} kB" if count < 1e6 else f"{count / 1e6:.2f} MB"
