"""Monitor of a run: its state from the messages, and how late inputs were."""

import math
from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from sextant.evaluation.report import InputAges
from sextant.shared.runtime.health_table import HealthTable
from sextant.shared.runtime.lateness import SlowComputer, ages_of
from sextant.shared.runtime.service import AnyTopic, Every, Inbox, Stages
from sextant.shared.wire import topics
from sextant.shared.wire.messages import ActuatorState, BodyPose, CameraState, Health, Message, Mode, PlannerStatus, Tick

_SPEED_OVER_NS = 2_000_000_000  # [ns] speed is the mean over the newest two seconds
_REFUSED_NS = 10_000_000_000  # [ns] for which refused messages are a warning
_SILENT_NS = 3_500_000_000  # [ns] a service is silent without a health report (one per second) for this long
_REMEDY = "use --lockstep or close programs"  # for a computer that is too slow


@dataclass(frozen=True, slots=True)
class View:
    """State of a run at one moment, for its operator."""

    time_s: float = 0.0  # [s] simulated time since the first ground truth, as in reports and pictures; without, of the actuator
    speed: float = 0.0  # [m/s] of the estimated pose over the newest two seconds
    walked: float = 0.0  # [m] along the starting direction
    to_goal: float | None = 0.0  # [m]; None without a goal
    up: bool = False  # whether the actuator has sent a message
    walks: bool = False  # whether the robot has begun its first step
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
            if health.missed_ticks:
                self.missed_beats[name] = health.missed_ticks
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

    def __init__(self, goal_distance: float | None, computer: SlowComputer | None = None, has_truth: bool = False):
        """Initialise without messages.

        Args:
            goal_distance: [m] from the start; None without a goal.
            computer: Detector of a computer that is too slow.
            has_truth: Whether to subscribe to the ground truth of a simulator, from which the time of the run counts.
        """
        self.subscribes = (*Monitor.subscribes, topics.TRUTH) if has_truth else Monitor.subscribes
        self.stages = Stages()
        self.lateness = RunLateness(computer or SlowComputer())
        self.view = View(to_goal=goal_distance)  # None without a goal
        self._goal_distance = goal_distance
        self._has_truth = has_truth
        self._began_ns: int | None = None  # by the clock of this machine, because the robot's clock may differ
        self._track: deque[tuple[int, float, float]] = deque()  # stamp, x, y
        self._health = HealthTable()
        self._refused: dict[str, tuple[int, int]] = {}  # service -> number of its refused messages, and when [ns] it last rose

    def step(self, tick: Tick, inbox: Inbox) -> Iterable[Message]:
        """Process new messages and update the view."""
        self._health.drain(inbox, tick.stamp_ns)
        too_slow = self.lateness.update(self._health.named(), tick.stamp_ns)
        state, pose = inbox.latest(topics.ACTUATOR_STATE), inbox.latest(topics.BODY_POSE)
        truth = inbox.drain(topics.TRUTH) if self._has_truth else []
        if self._began_ns is None and (truth or state is not None):
            self._began_ns = tick.stamp_ns - (truth[-1].stamp_ns - truth[0].stamp_ns if truth else 0)
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
            up=state is not None,
            walks=self.view.walks or (state is not None and state.mode is Mode.WALK),
            doing={name: _printable(health.status) for name, (health, _) in self._services()},
            warnings=tuple(map(_printable, warnings)),
        )
        return ()

    def status(self) -> str:
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
            if state.plan_refusal:
                yield f"actuator refused a plan: {state.plan_refusal}"
            yield from (f"actuator: {warning}" for warning in state.warnings)
        if pose is not None and not pose.ok:
            yield f"perception: {pose.reason}"
        if planner is not None and planner.state == "blocked":
            yield f"planner: blocked, {planner.reason}"
        for name, (health, heard_ns) in self._services():
            if now_ns - heard_ns > _SILENT_NS:
                yield f"{name}: no message for {(now_ns - heard_ns) * 1e-9:.0f} s"
            if self._refuses(name, health.refused, now_ns):
                yield f"{name}: refused {health.refused} messages, last reason: {health.last_refusal}"

    def _refuses(self, name: str, refused: int, now_ns: int) -> bool:
        """Return whether a service has refused messages lately, by their number since its start."""
        if refused != self._refused.get(name, (0, 0))[0]:
            self._refused[name] = refused, now_ns
        count, rose_ns = self._refused.get(name, (0, 0))
        return count > 0 and now_ns - rose_ns <= _REFUSED_NS


def _of_camera(state: CameraState | None) -> Iterable[str]:
    if state is not None and not state.ok:
        yield f"camera: {state.reason}"


def _printable(text: str) -> str:
    """Return a text of a service without characters that control a terminal."""
    return "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in text)
