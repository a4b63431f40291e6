"""Number of robots that one base station can serve.

Recorded robots are played, each behind a separate router, to a real base station.
"""

import contextlib
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from benchmarks.peers.timing import machine
from benchmarks.robot.replayed_robot import Heard
from sextant.deploy.launch.fleet import Base, Fleet, Member, Page
from sextant.evaluation.lockstep.lockstep_run import run_lockstep
from sextant.evaluation.observers.progress import Progress
from sextant.shared.files import whole_files
from sextant.shared.scenario.loading import load_scenario
from sextant.shared.wire.ports import free_port

SEED = 1003
AFTER_S = 8.0  # [s] at the start that are not measured: the base's processes start with the robot's first messages
PATIENCE_S = 60.0
_PARTS = ("mapper", "planner", "console", "recorder")
_LOOK_S = 0.1
_COLORS = ("#2a7f62", "#58a882", "#93c7ad", "#c5d9cf", "#2f6da8", "#c9ced3")
# Requirements of a robot. It holds when no new plan has arrived for 0.18 s, and continues with the next plan. The planner
# publishes at least ten times a second.
MOST_PAUSE_MS = 350.0
MOST_PLAN_MS = 250.0
MOST_SCAN_MS = 250.0  # from a depth frame until it is in the map, for 99 of 100 scans
LEAST_TAKEN = 0.95  # share of the scans


@dataclass(frozen=True, slots=True)
class Load:
    """Load of a base station with a number of robots; processor times in busy cores."""

    robots: int
    cores: dict[str, float]  # by part of the base station, for all robots together
    players: float  # cores used by the recorded robots
    busy: float  # busy cores of the whole machine
    memory_mb: float  # of the base's processes; shared pages count once
    heard: tuple[Heard, ...]  # results of each robot

    @property
    def limits(self) -> tuple[str, ...]:
        """Violated requirements of the robots as text."""
        found = []
        pause, scan = max(h.pause_max for h in self.heard), max(h.scan_p99 for h in self.heard)
        plan = max(h.plan_p99 for h in self.heard)
        taken = min(h.taken / max(1, h.scans) for h in self.heard)
        if pause > MOST_PAUSE_MS:
            found.append(f"no message of the planner for {pause:.0f} ms")
        if not all(h.plans for h in self.heard):
            found.append("no plan")
        elif plan > MOST_PLAN_MS:
            found.append(f"plans {plan:.0f} ms old")
        if scan > MOST_SCAN_MS:
            found.append(f"scans in the map after {scan:.0f} ms")
        if taken < LEAST_TAKEN:
            found.append(f"{100 * taken:.0f} % of the scans integrated")
        return tuple(found)


def measure(course: str, most: int, progress: Progress, out: Path) -> tuple[Load, ...]:
    """Increase the number of robots until the base station cannot serve them.

    Args:
        course: Scenario that is walked once in lockstep, and played by every robot.
        most: Maximum number of robots.
        progress: Display of the progress.
        out: Folder for the recording.

    Raises:
        TimeoutError: The base station did not start.
    """
    recording = out / "walk" / "recording.mcap"
    recording.parent.mkdir()
    run_lockstep(load_scenario(course), SEED, recording.parent, progress)
    found: list[Load] = []
    for robots in range(1, most + 1):
        found.append(_loaded(robots, recording, progress.say))
        progress.say(f"{robots} robots: {', '.join(found[-1].limits) or 'carried'}")
        if found[-1].limits:
            break
    return tuple(found)


def _loaded(robots: int, recording: Path, say: Callable[[str], object]) -> Load:
    names = [f"robot-{n + 1}" for n in range(robots)]
    waiting: set[str] = set()

    def hear(words: str) -> None:
        if "waiting for the robot" in words:
            waiting.add(words)
        elif " ended (" in words:
            say(words)

    with contextlib.ExitStack() as stack:
        ports = {name: free_port() for name in names}
        players = {name: stack.enter_context(_player(recording, ports[name], name)) for name in names}
        members = {name: Member((f"tcp/127.0.0.1:{ports[name]}",)) for name in names}
        before = Path.cwd()
        os.chdir(recording.parent)
        stack.callback(os.chdir, before)  # the recorders write to this folder
        with Base(Fleet(members, Page(port=free_port())), False, hear) as base:
            _beat(base, PATIENCE_S, lambda: len(waiting) == robots * len(_PARTS))
            for player in players.values():
                _tell(player, "begin")
            _beat(base, AFTER_S)
            meter = _Meter(base, players)
            _beat(base, PATIENCE_S * 2, lambda: all(_over(player) for player in players.values()), meter.look)
            return Load(robots, *meter.found(), tuple(Heard.of(_last_line(player)) for player in players.values()))


@contextlib.contextmanager
def _player(recording: Path, port: int, name: str) -> Iterator[subprocess.Popen[str]]:
    words = ("-m", "benchmarks.robot.replayed_robot", str(recording), f"tcp/127.0.0.1:{port}", name, str(AFTER_S))
    player = subprocess.Popen([sys.executable, *words], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    try:
        assert player.stdout is not None
        if player.stdout.readline() != "ready\n":
            raise RuntimeError("a replayed robot did not start; its output is above")
        yield player
    finally:
        player.kill()
        player.communicate()


def _tell(player: subprocess.Popen[str], word: str) -> None:
    assert player.stdin is not None
    player.stdin.write(f"{word}\n")
    player.stdin.flush()


def _over(player: subprocess.Popen[str]) -> bool:
    return player.poll() is not None


def _last_line(player: subprocess.Popen[str]) -> str:
    assert player.stdout is not None
    return player.stdout.read().strip().splitlines()[-1]


def _beat(
    base: Base, within_s: float, over: Callable[[], bool] = lambda: False, look: Callable[[], object] = lambda: None
) -> None:
    """Run for a time [s], or until a condition is true."""
    until = time.monotonic() + within_s
    while not over() and time.monotonic() < until:
        if problem := base.beat(_LOOK_S):
            raise RuntimeError(problem)
        look()


class _Meter:
    """Meter of processor time and memory, from its creation to the last `look`."""

    def __init__(self, base: Base, players: dict[str, subprocess.Popen[str]]):
        halves = [base.half(name) for name in base.running]
        self._pids = {part: [half.pid(part) for half in halves] for part in _PARTS}
        self._pids["routers"] = [os.getpid()]  # plain routers run in this process
        self._players = [player.pid for player in players.values()]
        self._began = self._ended = self._times()
        self._at = self._until = time.monotonic()
        self._memory_mb = 0.0

    def look(self) -> None:
        """Take a measurement while all processes exist."""
        with contextlib.suppress(OSError):
            self._ended, self._until = self._times(), time.monotonic()
            self._memory_mb = sum(_memory_mb(pid) for pids in self._pids.values() for pid in pids)

    def found(self) -> tuple[dict[str, float], float, float, float]:
        """Return cores by part of the base, of players and machine, and memory [MB]."""
        took = {part: (self._ended[part] - self._began[part]) / (self._until - self._at) for part in self._ended}
        return {part: took[part] for part in self._pids}, took["players"], took["all"], self._memory_mb

    def _times(self) -> dict[str, float]:
        times = {part: sum(map(_time_s, pids)) for part, pids in self._pids.items()}
        return {**times, "players": sum(map(_time_s, self._players)), "all": _busy_s()}


def _time_s(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _busy_s() -> float:
    user, nice, system, _idle, _wait, irq, softirq, *_ = Path("/proc/stat").read_text(encoding="ascii").split()[1:]
    return sum(map(int, (user, nice, system, irq, softirq))) / os.sysconf("SC_CLK_TCK")


def _memory_mb(pid: int) -> float:
    for line in Path(f"/proc/{pid}/smaps_rollup").read_text(encoding="ascii").splitlines():
        if line.startswith("Pss:"):
            return int(line.split()[1]) / 1e3
    return 0.0


def carried(loads: Sequence[Load]) -> int:
    """Return the number of robots that the base station can serve."""
    return max((load.robots for load in loads if not load.limits), default=0)


def in_words(loads: Sequence[Load]) -> str:
    """Return the loads as a table in Markdown."""
    heads = ("robots", *(f"{part}, cores" for part in (*_PARTS, "routers")), "robots played", "machine busy", "MB")
    heads = (*heads, "scan in the map p50, ms", "p99, ms", "taken in", "plan's age p99, ms", "longest gap of the planner, ms")
    lines = [f"| {' | '.join(heads)} |", f"|{'---|' * len(heads)}"]
    for load in loads:
        heard = load.heard
        cells = [
            str(load.robots),
            *(f"{load.cores[part]:.2f}" for part in (*_PARTS, "routers")),
            f"{load.players:.2f}",
            f"{load.busy:.2f}",
            f"{load.memory_mb:.0f}",
            f"{max(h.scan_p50 for h in heard):.0f}",
            f"{max(h.scan_p99 for h in heard):.0f}",
            f"{100 * min(h.taken / max(1, h.scans) for h in heard):.0f} %",
            f"{max(h.plan_p99 for h in heard):.0f}",
            f"{max(h.pause_max for h in heard):.0f}",
        ]
        lines.append(f"| {' | '.join(cells)} |")
    last = loads[-1]
    words = f"{', '.join(last.limits)}, and {last.busy:.1f} cores of the machine are busy"
    more = f"; with {last.robots}: {words}" if last.limits else "; larger numbers were not tried"
    return "\n".join([*lines, "", f"This base station supports {carried(loads)} robots{more}."])


def draw(path: Path, loads: Sequence[Load]) -> None:
    """Plot processor time and delays of scans and plans over the number of robots."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    robots = [load.robots for load in loads]
    with rc_context({"font.size": 11, "axes.spines.top": False, "axes.spines.right": False}):
        figure = Figure(figsize=(11.0, 4.6), dpi=100, facecolor="white", layout="constrained")
        work, late = figure.subplots(1, 2)
        base = [0.0] * len(loads)
        parts = {part: [load.cores[part] for load in loads] for part in loads[0].cores}
        parts["robots played"] = [load.players for load in loads]
        for (part, cores), color in zip(parts.items(), _COLORS, strict=True):
            work.bar(robots, cores, 0.65, base, color=color, label=part)
            base = [below + more for below, more in zip(base, cores, strict=True)]
        work.axhline(os.cpu_count() or 1, color="#b3261e", linewidth=1.2)
        work.text(robots[0] - 0.3, (os.cpu_count() or 1) * 1.02, "all cores", color="#b3261e")
        work.set(xlabel="robots", ylabel="cores busy", title="Load of the base station", xticks=robots)
        work.legend(frameon=False, fontsize=9, loc="upper left", bbox_to_anchor=(0.0, 0.93))
        for words, color, of in (
            ("a scan in the map, p99", "#2a7f62", lambda h: h.scan_p99),
            ("a plan's age, p99", "#2f6da8", lambda h: h.plan_p99),
            ("longest gap of the planner", "#c8862a", lambda h: h.pause_max),
        ):
            late.plot(robots, [max(map(of, load.heard)) for load in loads], "o-", color=color, label=words)
        late.axhline(MOST_SCAN_MS, color="#b3261e", linewidth=1.2)
        words = "later plans make the robot stand"
        late.text(robots[0], MOST_SCAN_MS * 1.02, words, color="#b3261e")
        late.set(xlabel="robots", ylabel="ms, the worst robot's", title="Latency at a robot", xticks=robots, ylim=(0, None))
        late.legend(frameon=False, fontsize=9, loc="upper left")
        whole_files.write_by_name(path, figure.savefig)


def to_json(loads: Sequence[Load]) -> str:
    """Return the loads as JSON."""
    found = {"machine": machine(), "carried": carried(loads), "loads": [asdict(load) for load in loads]}
    return json.dumps(found, indent=1) + "\n"


def from_json(text: str) -> tuple[Load, ...]:
    """Read loads written by `to_json`."""
    kept: list[dict[str, Any]] = json.loads(text)["loads"]
    return tuple(Load(**{**load, "heard": tuple(Heard(**heard) for heard in load["heard"])}) for load in kept)
