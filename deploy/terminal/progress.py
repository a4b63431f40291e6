"""Progress of a run, from its messages to the terminal.

Only this module and cli.py write to stdout.
"""

import contextlib
import math
import shutil
from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Protocol, TextIO

from sextant.deploy.evaluation.report import InputAges
from sextant.shared.runtime.health_table import HealthTable
from sextant.shared.runtime.lateness import SlowComputer, ages_of
from sextant.shared.runtime.service import AnyTopic, Every, Inbox, Stages
from sextant.shared.wire import topics
from sextant.shared.wire.messages import ActuatorState, BodyPose, CameraState, Health, Message, Mode, PlannerStatus, Tick

_MOST_WARNINGS = 200  # most kinds of warnings per run, because they quote text of services
_SPEED_OVER_NS = 2_000_000_000  # [ns] speed is the mean over the newest two seconds
_SILENT_NS = 3_500_000_000  # [ns] a service is silent without a health report (one per second) for this long
_REAL_TIME = 0.95  # [1] share of real time below which the speed of simulated time is shown
_LINE_EVERY_S = 5.0  # [s] simulated time between two plain lines
_ATTENDING = ("operator", "scorer")  # their status repeats what the line shows
_REMEDY = "use --lockstep or close programs"  # for a computer that is too slow
_BAR = 20  # characters of the progress bar


@dataclass(frozen=True, slots=True)
class View:
    """State of a run at one moment, for its operator."""

    time_s: float = 0.0  # [s] simulated time since the first message of the actuator
    speed: float = 0.0  # [m/s] of the estimated pose over the newest two seconds
    walked: float = 0.0  # [m] along the starting direction
    to_goal: float = 0.0  # [m]
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

    def __init__(self, goal_distance: float, computer: SlowComputer | None = None):
        self.stages = Stages()
        self.lateness = RunLateness(computer or SlowComputer())
        self.view = View(to_goal=goal_distance)
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
            self._began_ns = state.stamp_ns
        if pose is not None:
            self._follow(pose)
        self.view = View(
            time_s=0.0 if self._began_ns is None else (tick.stamp_ns - self._began_ns) * 1e-9,
            speed=self._speed(),
            walked=self._track[-1][1] if self._track else 0.0,
            to_goal=max(0.0, self._goal_distance - (self._track[-1][1] if self._track else 0.0)),
            up=self._began_ns is not None,
            doing={name: health.doing for name, (health, _) in self._services()},
            warnings=(
                *((f"{too_slow}; {_REMEDY}",) if too_slow else ()),
                *_of_camera(inbox.fresh(topics.CAMERA_STATE)),
                *self._warnings(state, pose, inbox.latest(topics.PLANNER_STATUS), tick.stamp_ns),
            ),
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

    def say(self, text: str) -> None:
        """Do nothing."""

    def finish(self) -> None:
        """Do nothing."""


class _Output:
    """A stream that ignores write errors, so that they never end a run."""

    def __init__(self, stream: TextIO):
        self._stream = stream

    def write(self, text: str) -> None:
        """Write and flush a text; ignore errors."""
        with contextlib.suppress(OSError):
            self._stream.write(text)
            self._stream.flush()


class Lines:
    """Plain lines for logs and pipes: the state at intervals, and each warning once."""

    def __init__(self, stream: TextIO):
        self._stream = _Output(stream)
        self._next_s = 0.0
        self._warned: set[str] = set()

    def update(self, view: View) -> None:
        """Write a line every few simulated seconds, and each new warning."""
        for warning in view.warnings:
            if _kind(warning) not in self._warned and len(self._warned) < _MOST_WARNINGS:
                self._warned.add(_kind(warning))
                self.say(f"{view.time_s:6.1f} s  warning: {warning}")
        if view.up and view.time_s >= self._next_s:
            self._next_s = view.time_s + _LINE_EVERY_S
            busy = "; ".join(f"{name}: {doing}" for name, doing in view.doing.items() if name not in _ATTENDING)
            slower = f"  at {view.of_real_time:.2f} of real time" if view.of_real_time < _REAL_TIME else ""
            self.say(f"{view.time_s:6.1f} s{slower}  {view.speed:.3f} m/s  {view.to_goal:.2f} m to the goal  {busy}")

    def say(self, text: str) -> None:
        """Write one line."""
        self._stream.write(text + "\n")

    def finish(self) -> None:
        """Do nothing: no line is open."""


class Terminal:
    """A block of lines at the bottom of a terminal, redrawn in place."""

    def __init__(self, stream: TextIO):
        self._stream = _Output(stream)
        self._height = 0

    def update(self, view: View) -> None:
        """Redraw the block."""
        width = shutil.get_terminal_size().columns
        self._erase()
        lines = [line if len(line) < width else line[: width - 2] + "…" for line in block(view)]
        self._stream.write("".join(f"{line}\n" for line in lines))
        self._height = len(lines)

    def say(self, text: str) -> None:
        """Write a line above the block."""
        self._erase()
        self._stream.write(text + "\n")

    def finish(self) -> None:
        """Keep the last block on the screen."""
        self._height = 0

    def _erase(self) -> None:
        if self._height:
            self._stream.write(f"\x1b[{self._height}F\x1b[J")  # move up by the height, clear to the end of the screen
        self._height = 0


def progress_for(stream: TextIO) -> Progress:
    """Return a redrawn block if the stream is a terminal, else plain lines."""
    return Terminal(stream) if stream.isatty() else Lines(stream)


def block(view: View) -> list[str]:
    """Return the lines of the block."""
    if not view.up:
        head = "waiting for the robot to start"
    else:
        whole = view.walked + view.to_goal
        done = round(_BAR * min(max(view.walked / whole, 0.0), 1.0)) if whole > 0 else _BAR
        bar = "#" * done + "-" * (_BAR - done)
        slower = f"   at {view.of_real_time:.2f} of real time" if view.of_real_time < _REAL_TIME else ""
        head = f"{view.time_s:6.1f} s{slower}   {view.speed:.3f} m/s   {view.to_goal:.2f} m to the goal  [{bar}]"
    return [
        head,
        *(f"  {name:<11} {doing}" for name, doing in view.doing.items()),
        *(f"  ! {warning}" for warning in view.warnings),
    ]


def _kind(warning: str) -> str:
    """Return a warning without its numbers; new numbers are no new warning."""
    return "".join("#" if c.isdigit() else c for c in warning)
