"""Walks in lockstep, with a record of their messages."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from sextant.evaluation.lockstep.lockstep_run import LockstepRun
from sextant.evaluation.report import Report
from sextant.shared.geometry import Array
from sextant.shared.robot.profiles import load_profile
from sextant.shared.runtime.service import AnyTopic, Service
from sextant.shared.scenario.loading import load_scenario
from sextant.shared.scenario.scenario import Goal, Scenario
from sextant.shared.scenario.terrain import Plane
from sextant.shared.wire import codec, topics
from sextant.shared.wire.messages import ActuatorState, Message, PlannerStatus, TerrainMap
from sextant.shared.wire.topics import Topic

S = 1_000_000_000
LOOK_NS = 100_000_000  # simulated time between two looks at a run

M = TypeVar("M", bound=Message)


def flat(distance: float, **changes: Any) -> Scenario:
    """Return a short course on level ground."""
    return replace(Scenario("short", (Plane(),), Goal(distance), time_limit_s=40.0), **changes)


def course(folder: Path, text: str) -> Scenario:
    """Load a scenario from text, as a user might write one."""
    path = folder / "course.toml"
    path.write_text(text, encoding="utf-8")
    return load_scenario(str(path))


@dataclass
class Heard:
    """Frames of some topics in the order in which they were sent."""

    wanted: tuple[AnyTopic, ...]
    frames: list[tuple[AnyTopic, bytes, int]] = field(default_factory=list)

    def tap(self, topic: AnyTopic, frame: bytes, at_ns: int) -> None:
        if topic in self.wanted:
            self.frames.append((topic, frame, at_ns))

    def of(self, topic: Topic[M], from_s: float = 0.0, until_s: float = float("inf")) -> list[M]:
        """Return the messages of a topic that were sent in an interval [s]."""
        return [
            codec.decode(frame, topic.type)[0]
            for sent, frame, at_ns in self.frames
            if sent is topic and from_s <= at_ns * 1e-9 < until_s
        ]


@dataclass(frozen=True)
class Walk:
    """A run that is over."""

    report: Report
    heard: Heard
    run: LockstepRun

    def states(self, from_s: float = 0.0, until_s: float = float("inf")) -> list[ActuatorState]:
        return self.heard.of(topics.ACTUATOR_STATE, from_s, until_s)

    def statuses(self, from_s: float = 0.0, until_s: float = float("inf")) -> list[PlannerStatus]:
        return self.heard.of(topics.PLANNER_STATUS, from_s, until_s)

    def feet(self) -> Array:
        """Return the true foot positions (n, 6, 3) [m] in the simulator's {world}."""
        return np.array([truth.feet for truth in self.heard.of(topics.TRUTH)])


def walk(
    scenario: Scenario,
    seed: int,
    wanted: Iterable[AnyTopic] = (topics.ACTUATOR_STATE, topics.PLANNER_STATUS, topics.TRUTH, topics.BODY_POSE),
    look: Callable[[LockstepRun], None] = lambda _: None,
    guests: Sequence[Service] = (),
    around: Mapping[str, Callable[[Service], Service]] | None = None,
) -> Walk:
    """Walk to the end as `run_lockstep` does, and record messages.

    `look` is called every tenth of a simulated second. Guests are additional services that take part.
    `around` wraps or replaces services by name.
    """
    heard = Heard(tuple(wanted))
    looked_at = topics.DEPTH in heard.wanted
    run = LockstepRun(scenario, seed, load_profile(scenario.robot), heard.tap, guests, looked_at, around)
    while not run.attendance.over():
        assert run.now_ns() < 2 * scenario.time_limit_s * S, "no verdict"
        run.run(run.now_ns() + LOOK_NS)
        look(run)
    return Walk(run.attendance.judge(1.0), heard, run)


def blocked(scenario: Scenario, seed: int, within_s: float = 30.0) -> tuple[str, TerrainMap]:
    """Walk until the planner stops; return its reason and its map at that time."""
    heard = Heard((topics.PLANNER_STATUS, topics.TERRAIN))
    run = LockstepRun(scenario, seed, load_profile(scenario.robot), heard.tap, every_frame=False)
    while run.now_ns() < within_s * S:
        run.run(run.now_ns() + LOOK_NS)
        now_s = run.now_ns() * 1e-9
        for status in heard.of(topics.PLANNER_STATUS, now_s - LOOK_NS * 1e-9):
            if status.state == "blocked":
                return status.reason, heard.of(topics.TERRAIN, now_s - 1.0)[-1]
    raise AssertionError(f"a planner that is blocked within {within_s:g} s expected")
