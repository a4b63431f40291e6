"""Effect of recording on a walk.

The walks alternate between no recording, recording, a full disk, and a killed recorder.
"""

import math
import resource
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.page.page_robot import PageRobot
from benchmarks.page.scripted_page import ScriptedPage
from benchmarks.peers import kept
from sextant.shared.recording.reader import newest_ns
from sextant.shared.wire.messages import Mode

CYCLE_S = 0.001  # [s] tolerated difference of the cycle's p99 from that of a walk without recording
SAID_S = 2.0  # [s] within which the end of a recording must be reported
KILLED_S = 1.0  # [s] of messages that a killed recorder may lose
_WALK_S = 12.0  # [s] of each timed walk
_BREAK_S = 3.0  # [s] of walking before the failure
_SPEED = 0.09  # [m/s]
_WAYS = ("nobody records", "recording", "the disk fills up", "the recorder is killed")


@dataclass(slots=True)
class Way:
    """One of the four kinds, over all rounds."""

    what: str
    cycles_s: list[NDArray[np.float64]] = field(default_factory=list)  # intervals between goals on the servo bus
    said_s: list[float] = field(default_factory=list)  # delays until the page reported the problem, infinite if it did not
    lost_s: list[float] = field(default_factory=list)  # duration missing at the end of the file


@dataclass(frozen=True, slots=True)
class Summary:
    """Results of one kind."""

    what: str
    walks: int
    p50_ms: float  # of the cycle: intervals between goals on the servo bus
    p99_ms: float
    worst_ms: float
    said_s: tuple[float, ...]  # delays until the page reported the problem
    never_said: int  # problems that the page did not report
    lost_s: tuple[float, ...]  # duration missing at the end of each file

    @classmethod
    def of(cls, way: Way) -> "Summary":
        """Summarise the walks of a kind."""
        p50, p99, worst = (1e3 * np.percentile(np.concatenate(way.cycles_s), [50, 99, 100])).tolist()
        said = tuple(s for s in way.said_s if math.isfinite(s))
        return cls(way.what, len(way.cycles_s), p50, p99, worst, said, len(way.said_s) - len(said), tuple(way.lost_s))


def measure(rounds: int, say: Callable[[str], object]) -> tuple[Summary, ...]:
    """Walk back and forth over level ground, with the four kinds of recording in turn.

    Args:
        rounds: Number of walks of each kind.
        say: Called with the progress.

    Raises:
        TimeoutError: The robot or the recorder does not execute an order.
    """
    ways = tuple(Way(what) for what in _WAYS)
    rng = np.random.default_rng(0)
    with (
        tempfile.TemporaryDirectory() as folder,
        PageRobot("flat", recordings=folder) as robot,
        ScriptedPage(robot.url) as page,
    ):
        robot.stand(lambda: page.ask("order", order="stand"))
        robot.until(lambda: _recorder(page) is not None, what="the recorder's first message")
        forward = _SPEED
        for k in range(rounds):
            for number in rng.permutation(len(ways)):
                _walk(robot, page, ways[number], forward)
                forward = -forward
            say(f"recording: {k + 1} of {rounds} rounds")
    return tuple(Summary.of(way) for way in ways)


def _walk(robot: PageRobot, page: ScriptedPage, way: Way, forward: float) -> None:
    """Walk once, with the recording of the given kind."""
    records = way.what != _WAYS[0]
    if records:
        page.ask("record", on=True)
        robot.until(lambda: _is_recording(page), what="a recording")
    with page.held(forward):
        robot.until(lambda: robot.is_in(Mode.WALK), 15.0, "a walk by the pad")
        since = time.monotonic()
        robot.pass_time(_BREAK_S)
        broken = time.monotonic()
        if way.what == _WAYS[2]:
            _fill_up(robot.pid("recorder"), page)
            _hear(robot, page, way, "the recording ended early", broken)
        elif way.what == _WAYS[3]:
            file = Path(_recorder(page)["file"])
            killed_ns = time.monotonic_ns()
            robot.kill("recorder")
            _hear(robot, page, way, "not recorded", broken)
            way.lost_s.append((killed_ns - newest_ns(file)) * 1e-9)
        robot.pass_time(max(0.0, since + _WALK_S - time.monotonic()))
        until = time.monotonic()
    times = robot.goal_times()
    way.cycles_s.append(np.diff(times[(times >= since) & (times <= until)]))
    robot.until(lambda: robot.is_in(Mode.HOLD), what="standing")
    if way.what == _WAYS[2]:
        resource.prlimit(robot.pid("recorder"), resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    elif records:
        robot.until(lambda: _is_recording(page), what="the recording to continue")
        page.ask("record", on=False)
    robot.until(lambda: _recorder(page) is not None and not _is_recording(page), what="the end of the recording")


def _fill_up(pid: int, page: ScriptedPage) -> None:
    """Prevent the recorder's files from growing, as on a full disk."""
    size = Path(_recorder(page)["file"]).stat().st_size
    resource.prlimit(pid, resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))


def _hear(robot: PageRobot, page: ScriptedPage, way: Way, words: str, since_s: float) -> None:
    """Measure the delay until the page reports a text."""
    try:
        robot.until(lambda: page.said_after(words, since_s) is not None, 5.0)
    except TimeoutError:
        way.said_s.append(math.inf)
        return
    said_s = page.said_after(words, since_s)
    assert said_s is not None
    way.said_s.append(said_s)


def _recorder(page: ScriptedPage) -> dict[str, str]:
    """Return the recorder's status on the page."""
    found: dict[str, str] = page.told.get("state", {}).get("recorder")
    return found


def _is_recording(page: ScriptedPage) -> bool:
    recorder = _recorder(page)
    return recorder is not None and bool(recorder["recording"])


def in_words(found: Sequence[Summary]) -> str:
    """Return the results as Markdown."""
    usual = found[0]
    lines = [
        "| while the robot walks | cycle p50, ms | p99, ms | above the first, ms | worst, ms | reported after, s | lost, s |",
        "|---|---|---|---|---|---|---|",
    ]
    for way in found:
        said = f"{max(way.said_s):.1f} at most" if way.said_s else ""
        said += f", never in {way.never_said}" if way.never_said else ""
        lost = f"{max(way.lost_s):.1f} at most" if way.lost_s else ""
        beside = f"{way.p99_ms - usual.p99_ms:+.2f}" if way is not usual else ""
        lines.append(f"| {way.what} | {way.p50_ms:.2f} | {way.p99_ms:.2f} | {beside} | {way.worst_ms:.1f} | {said} | {lost} |")
    lines += [
        "",
        f"{usual.walks} walks of {_WALK_S:.0f} s per row, in turns. Wanted: p99 within {1e3 * CYCLE_S:.0f} ms of a "
        f"walk without recording, reported within {SAID_S:.0f} s, at most {KILLED_S:.0f} s lost.",
    ]
    return "\n".join(lines)


def to_json(found: Sequence[Summary]) -> str:
    """Return the results as JSON."""
    return kept.rows_to_json(found)


def from_json(text: str) -> list[Summary]:
    """Read results written by `to_json`."""
    return kept.rows_from_json(text, Summary)
