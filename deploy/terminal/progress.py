"""Progress of a run, from its messages to the terminal.

Only this module and cli.py write to stdout.
"""

import atexit
import contextlib
import math
import os
import re
import shutil
from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from importlib.util import find_spec
from typing import TYPE_CHECKING, Protocol, TextIO, cast

from sextant.deploy.evaluation.report import InputAges
from sextant.shared.runtime.health_table import HealthTable
from sextant.shared.runtime.lateness import SlowComputer, ages_of
from sextant.shared.runtime.service import AnyTopic, Every, Inbox, Stages
from sextant.shared.wire import topics
from sextant.shared.wire.messages import ActuatorState, BodyPose, CameraState, Health, Message, Mode, PlannerStatus, Tick

if TYPE_CHECKING:
    from rich.console import RenderableType

_MOST_WARNINGS = 200  # most kinds of warnings per run, because they quote text of services
_SPEED_OVER_NS = 2_000_000_000  # [ns] speed is the mean over the newest two seconds
_SILENT_NS = 3_500_000_000  # [ns] a service is silent without a health report (one per second) for this long
_REAL_TIME = 0.95  # [1] share of real time below which the speed of simulated time is shown
_LINE_EVERY_S = 5.0  # [s] simulated time between two plain lines of the position
_CHANGE_EVERY_S = 1.0  # [s] shortest simulated time between two plain lines of one service
_ATTENDING = ("operator", "scorer")  # their status repeats what the line shows
_REMEDY = "use --lockstep or close programs"  # for a computer that is too slow
_WIDTH = 100  # [characters] of the widest table


@dataclass(frozen=True, slots=True)
class View:
    """State of a run at one moment, for its operator."""

    time_s: float = 0.0  # [s] simulated time since the first message of the actuator
    speed: float = 0.0  # [m/s] of the estimated pose over the newest two seconds
    walked: float = 0.0  # [m] along the starting direction
    to_goal: float | None = 0.0  # [m]; None without a goal
    up: bool = False  # whether the actuator has sent a message
    of_real_time: float = 1.0  # [1] speed of simulated time
    doing: Mapping[str, str] = field(default_factory=dict)  # service -> its status as text
    warnings: tuple[str, ...] = ()  # as text


class RunLateness:
    """How late inputs were over a run, and for how long the computer was too slow."""

    def __init__(self, computer: SlowComputer):
        """Initialise for a run.

        Args:
            computer: Detector of a computer that is too slow.
        """
        self.late_s = 0.0
        self.words = ""  # the worst report that the computer was too slow
        self._severity = (False, 0.0)
        self.missed_beats: dict[str, int] = {}
        self._computer = computer
        self._looked_ns: int | None = None
        self._ages: dict[str, tuple[InputAges, int]] = {}  # ages and the number of reports behind them

    def update(self, services: Mapping[str, tuple[Health, int]], now_ns: int) -> str:
        """Process new health reports; return a warning if the computer is too slow.

        Args:
            services: Name -> newest health and when it arrived [ns].
            now_ns: [ns]
        """
        for name, health in self._computer.update(services):
            if health.missed_beats:
                self.missed_beats[name] = health.missed_beats
            for age in ages_of(health):
                before, count = self._ages.get(f"{name} {age.what}", (InputAges(0.0, 0.0, 0.0), 0))
                late = (count * before.late + age.late) / (count + 1)
                self._ages[f"{name} {age.what}"] = InputAges(max(before.max, age.age_s), age.limit_s, late), count + 1
        words = self._computer.words(now_ns)
        if words:
            if self._computer.severity >= self._severity:
                self.words, self._severity = words, self._computer.severity
            self.late_s += 0.0 if self._looked_ns is None else (now_ns - self._looked_ns) * 1e-9
        self._looked_ns = now_ns
        return words

    def ages(self) -> dict[str, InputAges]:
        """Return service and input -> its ages over the run."""
        return {name: ages for name, (ages, _) in sorted(self._ages.items())}


class Monitor:
    """Service that monitors a run; it publishes nothing but its health."""

    name = "monitor"
    trigger = Every.hz(4.0)
    subscribes: tuple[AnyTopic, ...] = (
        *topics.HEALTH_OF.values(),
        topics.ACTUATOR_STATE,
        topics.BODY_POSE,
        topics.PLANNER_STATUS,
        topics.CAMERA_STATE,
    )
    publishes: tuple[AnyTopic, ...] = ()

    def __init__(self, goal_distance: float | None, computer: SlowComputer | None = None):
        self.stages = Stages()
        self.lateness = RunLateness(computer or SlowComputer())
        self.view = View(to_goal=goal_distance)  # None without a goal
        self._goal_distance = goal_distance
        self._began_ns: int | None = None
        self._track: deque[tuple[int, float, float]] = deque()  # stamp, x, y
        self._health = HealthTable()

    def step(self, tick: Tick, inbox: Inbox) -> Iterable[Message]:
        """Process new messages and update the view."""
        self._health.drain(inbox, tick.stamp_ns)
        too_slow = self.lateness.update(self._health.named(), tick.stamp_ns)
        state, pose = inbox.latest(topics.ACTUATOR_STATE), inbox.latest(topics.BODY_POSE)
        if state is not None and self._began_ns is None:
            self._began_ns = tick.stamp_ns  # of this machine, because the robot's clock may differ
        if pose is not None:
            self._follow(pose)
        walked = self._track[-1][1] if self._track else 0.0
        warnings = (
            *((f"{too_slow}; {_REMEDY}",) if too_slow else ()),
            *_of_camera(inbox.fresh(topics.CAMERA_STATE)),
            *self._warnings(state, pose, inbox.latest(topics.PLANNER_STATUS), tick.stamp_ns),
        )
        self.view = View(
            time_s=0.0 if self._began_ns is None else (tick.stamp_ns - self._began_ns) * 1e-9,
            speed=self._speed(),
            walked=walked,
            to_goal=None if self._goal_distance is None else max(0.0, self._goal_distance - walked),
            up=self._began_ns is not None,
            doing={name: _printable(health.doing) for name, (health, _) in self._services()},
            warnings=tuple(map(_printable, warnings)),
        )
        return ()

    def doing(self) -> str:
        """Return the current activity as text."""
        return "watching"

    def _services(self) -> list[tuple[str, tuple[Health, int]]]:
        """Return name, newest health and its arrival [ns] of every other service."""
        return sorted(item for item in self._health.named().items() if item[0] != self.name)

    def stages_ms(self) -> dict[str, tuple[float, float]]:
        """Return `service.stage` -> 50th and 99th percentile [ms].

        For the latency of a topic it is the slowest of its subscribers.
        """
        found: dict[str, tuple[float, float]] = {}
        for _, (health, _) in self._services():
            service = health.service
            for stage, p50, p99 in zip(health.stages, health.stage_p50_ms, health.stage_p99_ms, strict=True):
                latency = stage.startswith("latency ")
                name = stage if latency or stage == service else f"{service}.{stage}"
                before = found.get(name, (0.0, 0.0))
                found[name] = max(before[0], float(p50)), max(before[1], float(p99))
        return found

    def _follow(self, pose: BodyPose) -> None:
        x, y = float(pose.T_world_body[0, 3]), float(pose.T_world_body[1, 3])
        if not self._track or pose.stamp_ns > self._track[-1][0]:
            self._track.append((pose.stamp_ns, x, y))
        while self._track[-1][0] - self._track[0][0] > _SPEED_OVER_NS:
            self._track.popleft()

    def _speed(self) -> float:
        if len(self._track) < 2:
            return 0.0
        (t0, x0, y0), (t1, x1, y1) = self._track[0], self._track[-1]
        return math.hypot(x1 - x0, y1 - y0) / ((t1 - t0) * 1e-9)

    def _warnings(
        self, state: ActuatorState | None, pose: BodyPose | None, planner: PlannerStatus | None, now_ns: int
    ) -> Iterable[str]:
        if state is not None:
            if state.mode is Mode.FAULT:
                yield f"actuator: fault, {state.reason}"
            if state.refused:
                yield f"actuator refused a plan: {state.refused}"
            yield from (f"actuator: {warning}" for warning in state.warnings)
        if pose is not None and not pose.ok:
            yield f"perception: {pose.reason}"
        if planner is not None and planner.state == "blocked":
            yield f"planner: blocked, {planner.reason}"
        for name, (health, heard_ns) in self._services():
            if now_ns - heard_ns > _SILENT_NS:
                yield f"{name}: no message for {(now_ns - heard_ns) * 1e-9:.0f} s"
            if health.refused:
                yield f"{name}: refused {health.refused} messages, last reason: {health.last_refusal}"


def _of_camera(state: CameraState | None) -> Iterable[str]:
    if state is not None and not state.ok:
        yield f"camera: {state.reason}"


class Progress(Protocol):
    """Display of a run's progress."""

    def update(self, view: View) -> None:
        """Show the current state of the run."""
        ...

    def compiled(self, done: int, total: int) -> None:
        """Show how many functions are compiled before the run."""
        ...

    def say(self, text: str) -> None:
        """Show one event permanently."""
        ...

    def finish(self) -> None:
        """Leave the terminal ready for further output."""
        ...


class Silent:
    """Display that shows nothing."""

    def update(self, view: View) -> None:
        """Do nothing."""

    def compiled(self, done: int, total: int) -> None:
        """Do nothing."""

    def say(self, text: str) -> None:
        """Do nothing."""

    def finish(self) -> None:
        """Do nothing."""


class _Output:
    """A stream that ignores write errors, so that they never end a run."""

    def __init__(self, stream: TextIO):
        self._stream = stream
        self.encoding = stream.encoding

    def write(self, text: str) -> int:
        """Write a text; ignore errors."""
        with contextlib.suppress(OSError):
            self._stream.write(text)
        return len(text)

    def flush(self) -> None:
        """Flush the stream; ignore errors."""
        with contextlib.suppress(OSError):
            self._stream.flush()


class Lines:
    """Plain lines for logs and pipes: each change and each warning, and the position at intervals."""

    def __init__(self, stream: TextIO):
        self._stream = _Output(stream)
        self._next_s = 0.0
        self._warned: set[str] = set()
        self._told: dict[str, tuple[str, float]] = {}  # service -> kind of its status, and when it was written [s]
        self._compiling = False

    def update(self, view: View) -> None:
        """Write new warnings, what services do now, and every few simulated seconds where the robot is."""
        for warning in view.warnings:
            if _kind(warning) not in self._warned and len(self._warned) < _MOST_WARNINGS:
                self._warned.add(_kind(warning))
                self.say(f"{view.time_s:6.1f} s  warning: {warning}")
        if not view.up:
            return
        for name, doing in view.doing.items():
            kind, before = _kind(_first_clause(doing)), self._told.get(name)
            changed = before is None or (kind != before[0] and view.time_s - before[1] >= _CHANGE_EVERY_S)
            if changed and name not in _ATTENDING:
                self._told[name] = kind, view.time_s
                self.say(f"{view.time_s:6.1f} s  {name}: {doing}")
        if view.time_s >= self._next_s:
            self._next_s = view.time_s + _LINE_EVERY_S
            self.say(f"{view.time_s:6.1f} s  {'  '.join(_motion(view))}")

    def compiled(self, done: int, total: int) -> None:
        """Write once that functions are being compiled."""
        if not self._compiling:
            self._compiling = True
            self.say(f"compiling the inner loops, {done} of {total} so far; the first start takes about a minute")

    def say(self, text: str) -> None:
        """Write one line."""
        self._stream.write(text + "\n")
        self._stream.flush()

    def finish(self) -> None:
        """Do nothing: no line is open."""


class Terminal:
    """A table at the bottom of a terminal, redrawn in place; it has colours unless NO_COLOR is set."""

    def __init__(self, stream: TextIO):
        from rich.console import Console
        from rich.live import Live

        self._console = Console(
            file=cast(TextIO, _Output(stream)), force_terminal=True, highlight=False, markup=False, emoji=False
        )
        self._live = Live(console=self._console, auto_refresh=False, redirect_stdout=False, redirect_stderr=False)
        atexit.register(self._live.stop)  # an error shows the cursor again

    def update(self, view: View) -> None:
        """Redraw the table."""
        self._show(table(view))

    def compiled(self, done: int, total: int) -> None:
        """Show how many functions are compiled."""
        from rich.text import Text

        self._show(Text(f"compiling the inner loops: {done} of {total}; the first start takes about a minute", "cyan"))

    def say(self, text: str) -> None:
        """Write a line above the table."""
        self._console.print(text, soft_wrap=True)

    def finish(self) -> None:
        """Keep the last table on the screen."""
        self._live.stop()

    def _show(self, content: "RenderableType") -> None:
        self._console.width = min(shutil.get_terminal_size().columns, _WIDTH)
        self._live.start()
        self._live.update(content, refresh=True)


def progress_for(stream: TextIO) -> Progress:
    """Return a table that is redrawn on a terminal, or plain lines.

    Lines are for a stream that is no terminal, a terminal that cannot move its cursor, and an installation without rich.
    """
    redrawn = stream.isatty() and os.environ.get("TERM") != "dumb" and find_spec("rich") is not None
    return Terminal(stream) if redrawn else Lines(stream)


def table(view: View) -> "RenderableType":
    """Return the state of a run as a table with a line for each service and warning."""
    from rich.progress_bar import ProgressBar
    from rich.table import Table
    from rich.text import Text

    state = f"{view.time_s:6.1f} s   {'   '.join(_motion(view))}" if view.up else "waiting for the robot to start"
    services = Table.grid(padding=(0, 2), expand=True)
    services.add_column(style="cyan", no_wrap=True)
    services.add_column(no_wrap=True, overflow="ellipsis", ratio=1)
    for name, doing in view.doing.items():
        services.add_row(f"  {name}", Text(doing))
    for warning in view.warnings:
        services.add_row(Text("  warning", "yellow"), Text(warning, "yellow", no_wrap=False, overflow="fold"))
    whole = Table.grid(expand=True)
    whole.add_row(Text(state, "bold", no_wrap=True, overflow="ellipsis"))
    if view.up and view.to_goal is not None:
        way = view.walked + view.to_goal
        whole.add_row(ProgressBar(max(way, 1e-9), view.walked if way > 0 else 1e-9, complete_style="green"))
    whole.add_row(services)
    return whole


def _motion(view: View) -> list[str]:
    """Return speed and way to the goal as texts."""
    slower = [f"at {view.of_real_time:.2f} of real time"] if view.of_real_time < _REAL_TIME else []
    goal = [] if view.to_goal is None else [f"{view.to_goal:.2f} m to the goal"]
    return [*slower, f"{view.speed:.3f} m/s", *goal]


def _printable(text: str) -> str:
    """Return a text of a service without characters that control a terminal."""
    return "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in text)


def _first_clause(doing: str) -> str:
    """Return what a service does without details that change all the time."""
    return re.split("[,;]", doing, maxsplit=1)[0]


def _kind(text: str) -> str:
    """Return a text without its numbers; new numbers are no news."""
    return re.sub(r"\d+(\.\d+)?", "#", text)
