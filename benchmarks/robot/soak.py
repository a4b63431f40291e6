"""Soak test: a long walk over Zenoh.

It checks whether memory grows, and whether latencies are longer at the end than at the start.
"""

import contextlib
import json
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np

from benchmarks.page.page_robot import PageRobot
from benchmarks.page.scripted_page import ScriptedPage
from benchmarks.peers.timing import machine
from sextant.deploy.topics import passive_subscriber
from sextant.shared.geometry import Array
from sextant.shared.runtime.service import AnyTopic
from sextant.shared.wire import codec, topics
from sextant.shared.wire.messages import Health, Mode
from sextant.shared.wire.transport import ZenohLink

GROWTH_MB_H = 1.0  # [MB/h] tolerated memory growth of a process
IN_ALL_MB = 2.0  # [MB] tolerated total growth: if two maps were in transit at once, memory for both is kept
LATER_MS = 2.0  # [ms] tolerated increase of a stream's median latency
PARTS = 60  # parts of the time; medians are kept for each
WARM_UP = 12  # parts before the evaluation: maps and memory pools fill up
_LEG_S = 25.0  # [s] of walking in one direction
_SPEED = 0.09  # [m/s]
_SAMPLE_S = 5.0
_SOON_S, _PRESSES = 5.0, 4  # [s] within which a led robot walks, and maximum number of pad presses until then
# Level ground, and a large battery: the usual one is empty before an hour is over, and then the robot lies down.
_COURSE = 'name = "soak"\nbattery_ah = 100.0\n[goal]\ndistance = 1.0\n[[terrain]]\nkind = "plane"\n'
_KEPT_FILES = 3  # files kept of a recording: an hour would fill the disk with gigabytes
# From the camera to the servos, and back to the leader.
_STREAMS: tuple[AnyTopic, ...] = (
    topics.BODY_POSE,
    topics.SCAN,
    topics.TERRAIN,
    topics.STEP_PLAN,
    topics.PLANNER_STATUS,
    topics.ACTUATOR_STATE,
    topics.ODOMETRY,
)
Samples = Sequence[tuple[float, float]]  # time [s] since the start, value


@dataclass(frozen=True, slots=True)
class Soak:
    """Results of a long walk, by part of the time; NaN without data."""

    length_s: float
    legs: int  # number of straight walks, back and forth
    memory_mb: Mapping[str, Sequence[float]]  # process -> (PARTS,) private memory
    age_p50_ms: Mapping[str, Sequence[float]]  # key -> (PARTS,) age of messages at their receipt
    age_p99_ms: Mapping[str, Sequence[float]]
    ended: Sequence[str]  # processes that ended during the test
    refused: Mapping[str, int]  # service -> messages that were not decodable, or had a wrong key
    dropped: Mapping[str, int]  # service -> messages dropped because they came faster than they were read


@dataclass(slots=True)
class _Seen:
    """Data collected during the test."""

    began_s: float
    memory_mb: dict[str, list[tuple[float, float]]] = field(default_factory=dict)
    ages_ms: dict[str, list[tuple[float, float]]] = field(default_factory=dict)
    health: dict[str, Health] = field(default_factory=dict)


def measure(length_s: float, say: Callable[[str], object]) -> Soak:
    """Walk back and forth for `length_s` [s] by the page's pad.

    All processes of a robot run, with its page and its recorder.

    Args:
        length_s: [s] from the first step to the last.
        say: Called with the progress.

    Raises:
        TimeoutError: The robot does not execute an order.
    """
    with tempfile.TemporaryDirectory() as folder, contextlib.ExitStack() as stack:
        course = Path(folder) / "soak.toml"
        course.write_text(_COURSE, encoding="utf-8")
        robot = stack.enter_context(PageRobot(str(course), recordings=folder))
        page = stack.enter_context(ScriptedPage(robot.url))
        robot.stand(lambda: page.ask("order", order="stand"))
        page.ask("record", on=True)
        seen, forward, legs = _Seen(time.monotonic()), _SPEED, 0
        end_s = seen.began_s + length_s
        with _listening(robot, seen):
            while time.monotonic() < end_s:
                with _walking(robot, page, forward):
                    turn_s = min(time.monotonic() + _LEG_S, end_s)
                    while time.monotonic() < turn_s:
                        robot.pass_time(min(_SAMPLE_S, turn_s - time.monotonic()))
                        _weigh(robot, seen)
                robot.until(lambda: robot.is_in(Mode.HOLD), what="standing")
                forward, legs = -forward, legs + 1
                _throw_away(Path(folder))
                say(f"soak: {(time.monotonic() - seen.began_s) / 60:.1f} of {length_s / 60:g} min")
        return _soak(seen, time.monotonic() - seen.began_s, legs, tuple(robot.ended))


@contextlib.contextmanager
def _walking(robot: PageRobot, page: ScriptedPage, forward: float) -> Iterator[None]:
    """Hold the pad for the duration of the block.

    It is pressed again, as by an operator, if the page did not know yet that the robot stands.
    """
    for left in reversed(range(_PRESSES)):
        with page.held(forward):
            try:
                robot.until(lambda: robot.is_in(Mode.WALK), _SOON_S, "a walk by the pad")
            except TimeoutError:
                if left:
                    continue
                raise
            yield
            return


@contextlib.contextmanager
def _listening(robot: PageRobot, seen: _Seen) -> Iterator[None]:
    """Record the age of every frame, and the services' health, during the block."""

    def take(topic: AnyTopic, frame: bytes, at_ns: int) -> None:
        if topic is topics.HEALTH:
            health = codec.decode(frame, Health)[0]
            seen.health[health.service] = health
            return
        age_ns = passive_subscriber.age_ns(codec.label(frame), at_ns)
        if age_ns is not None:
            seen.ages_ms.setdefault(topic.key, []).append((at_ns * 1e-9 - seen.began_s, age_ns * 1e-6))

    with ZenohLink(robot.endpoints) as link:
        passive_subscriber.listen(link, (*_STREAMS, topics.HEALTH), take, time.monotonic_ns)
        yield


def _weigh(robot: PageRobot, seen: _Seen) -> None:
    """Record the memory of each running process."""
    for name in robot.names():
        mb = own_mb(robot.pid(name))
        if np.isfinite(mb):
            seen.memory_mb.setdefault(name, []).append((time.monotonic() - seen.began_s, mb))


def own_mb(pid: int) -> float:
    """Return the private memory [MB] of a process, without mapped files.

    NaN if it has ended.
    """
    try:
        about = Path(f"/proc/{pid}/status").read_text(encoding="ascii", errors="replace")
    except OSError:
        return float("nan")
    kb = [float(line.split()[1]) for line in about.splitlines() if line.startswith("RssAnon:")]
    return kb[0] * 1024e-6 if kb else float("nan")


def _throw_away(folder: Path) -> None:
    """Remove all but the newest files of a recording."""
    for file in sorted(folder.rglob("*.mcap"), key=lambda path: path.stat().st_mtime)[:-_KEPT_FILES]:
        file.unlink()


def _soak(seen: _Seen, length_s: float, legs: int, ended: Sequence[str]) -> Soak:
    ages = seen.ages_ms.items()
    return Soak(
        length_s=round(length_s, 1),
        legs=legs,
        memory_mb={name: by_part(samples, length_s, 50) for name, samples in seen.memory_mb.items()},
        age_p50_ms={key: by_part(samples, length_s, 50) for key, samples in ages},
        age_p99_ms={key: by_part(samples, length_s, 99) for key, samples in ages},
        ended=ended,
        refused={name: health.refused for name, health in sorted(seen.health.items())},
        dropped={name: health.dropped for name, health in sorted(seen.health.items())},
    )


def by_part(samples: Samples, length_s: float, percent: float) -> list[float]:
    """Return a percentile of the samples in each of `PARTS` equal parts of the time.

    Values are rounded to a thousandth; NaN without samples.
    """
    t, values = np.array(samples).reshape(-1, 2).T
    part = np.clip(t / length_s * PARTS, 0, PARTS - 1).astype(np.intp)
    within = [values[part == n] for n in range(PARTS)]
    return [round(float(np.percentile(found, percent)), 3) if len(found) else float("nan") for found in within]


def growth_mb_h(parts: Sequence[float], length_s: float) -> float:
    """Return the memory growth [MB/h] after warm-up; NaN if unknown.

    This is the median of the slopes between every two parts (Theil 1950; Sen 1968). It is about zero for a process whose memory
    varies with garbage collection. It is also about zero after a single increase, unless that is exactly in the middle, because
    fewer than half of all pairs contain it. A process that grows repeatedly has its full growth rate.
    """
    mb, t = np.array(parts[WARM_UP:]), np.arange(PARTS - WARM_UP) * length_s / PARTS
    earlier, later = np.triu_indices(len(mb), 1)
    return 3600.0 * _median((mb[later] - mb[earlier]) / (t[later] - t[earlier]))


def ends(parts: Sequence[float]) -> tuple[float, float]:
    """Return the medians over the first and the last quarter of the evaluated parts.

    NaN if nothing is known.
    """
    judged: Array = np.array(parts[WARM_UP:])
    quarter = len(judged) // 4
    return _median(judged[:quarter]), _median(judged[-quarter:])


def _median(parts: Array) -> float:
    known = parts[np.isfinite(parts)]
    return float(np.median(known)) if len(known) else float("nan")


def faults(soak: Soak) -> list[str]:
    """Return the violated requirements as text."""
    found = list(soak.ended)
    for name, parts in soak.memory_mb.items():
        growth = growth_mb_h(parts, soak.length_s)
        if not growth < GROWTH_MB_H:
            found.append(f"{name}: memory grows by {growth:.1f} MB/h, less than {GROWTH_MB_H:.0f} wanted")
        first, last = ends(parts)
        if not last - first < IN_ALL_MB:
            found.append(f"{name}: memory has grown by {last - first:.1f} MB in all, less than {IN_ALL_MB:.0f} wanted")
    for key, parts in soak.age_p50_ms.items():
        first, last = ends(parts)
        if not last - first < LATER_MS:
            found.append(f"{key}: age {last:.1f} ms at the end, {first:.1f} ms at the beginning")
    return found + [f"{name}: {count} messages were refused" for name, count in soak.refused.items() if count]


def in_words(soak: Soak) -> str:
    """Return the results as Markdown."""
    lines = ["| process | MB, first quarter | last quarter | grows by, MB/h |", "|---|---|---|---|"]
    for name, parts in soak.memory_mb.items():
        first, last = ends(parts)
        lines.append(f"| {name} | {first:.1f} | {last:.1f} | {growth_mb_h(parts, soak.length_s):+.2f} |")
    lines += ["", "| stream | age p50, first quarter, ms | last quarter | p99, first | last |", "|---|---|---|---|---|"]
    for key, parts in soak.age_p50_ms.items():
        cells = (*ends(parts), *ends(soak.age_p99_ms[key]))
        lines.append(f"| `{key}` | {' | '.join(f'{cell:.1f}' for cell in cells)} |")
    lines += [
        "",
        f"{soak.length_s / 60:.1f} minutes, {soak.legs} times forth or back; the first {100 * WARM_UP / PARTS:.0f} % of the "
        f"time is not judged. Wanted: less than {GROWTH_MB_H:.0f} MB/h and {IN_ALL_MB:.0f} MB in all, no median later by "
        f"{LATER_MS:.0f} ms, no process ends.",
        *(faults(soak) or ["All limits are kept."]),
    ]
    return "\n".join(lines)


def to_json(soak: Soak) -> str:
    """Return the results as JSON; unknown values are null."""
    table = asdict(soak)
    for name in ("memory_mb", "age_p50_ms", "age_p99_ms"):
        table[name] = {key: [v if np.isfinite(v) else None for v in parts] for key, parts in table[name].items()}
    return json.dumps({"machine": machine(), **table}, allow_nan=False)


def from_json(text: str) -> Soak:
    """Read results written by `to_json`."""
    table = json.loads(text)
    del table["machine"]
    for name in ("memory_mb", "age_p50_ms", "age_p99_ms"):
        table[name] = {key: [float("nan") if v is None else v for v in parts] for key, parts in table[name].items()}
    return Soak(**table)
