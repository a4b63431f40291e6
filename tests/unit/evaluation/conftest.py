"""Synthetic messages of a tripod walk from plain kinematics, with optional faults."""

import functools
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import cv2
import numpy as np
import pytest

from sextant.evaluation.scoring.scorer import Scorer
from sextant.services.simulator.physics.terrain import build_terrain
from sextant.shared.geometry import from_xyz_rpy
from sextant.shared.robot.profiles import load_profile
from sextant.shared.runtime.service import Inbox
from sextant.shared.scenario.scenario import Goal, Scenario
from sextant.shared.scenario.terrain import Plane
from sextant.shared.wire import codec, topics
from sextant.shared.wire.messages import (
    ActuatorState,
    BodyPose,
    GroundTruth,
    Message,
    Mode,
    PassageMap,
    PassagePlan,
    PlannerStatus,
    StepPlan,
    TerrainMap,
)
from tests.support.states import actuator_state

_MS = 1_000_000
_TRIPOD = np.array([True, False, True, False, True, False])
FLAT = Scenario("story", (Plane(),), Goal(0.5))
_NONE = np.zeros(6, dtype=bool)


@dataclass(frozen=True)
class Story:
    """A walk: rest for a second, walk past the goal, rest again.

    {world} is the simulator's unless the start lies elsewhere.
    """

    scenario: Scenario = FLAT
    seed: int = 0
    stride: float = 0.06  # [m] advance of the body in each step
    step_s: float = 0.6
    beyond: float = 0.06  # [m] distance of the end past the goal
    heading_deg: float = 0.0  # of the start in the simulator's {world}
    tilt_deg: float = 0.0  # true roll that was not commanded
    sag: float = 0.0  # [m] height that the body lacks
    bob: float = 0.0  # [m] amplitude of the body's true height
    slip: float = 0.0  # [m] sideways motion of stance feet in each step
    drift: float = 0.0  # [1] error of the estimate relative to the distance
    map_bias: float = 0.0  # [m]
    topple_s: float = np.inf  # [s] the robot begins to fall over
    sink_s: float = np.inf  # [s] the robot sinks to the ground
    sit: str = ""  # reason for which it sits down instead of falling
    shutdown_s: float = np.inf  # [s] a servo shuts down
    flicker: bool = False  # contact drops out for one sample in ten
    tail_s: float = 1.0  # [s] after the last step
    moved_leg: int = -1  # the planner moves this leg's touchdowns by 2 cm
    refusal: str = ""  # the planner's reason once the robot stands
    level: bool = False  # the feet walk at height 0 on any ground
    sections: int = 0  # number of passage sections that the planner publishes in the first second
    way: bool = True  # whether those sections have a way
    passable: bool | None = None  # argument of the scorer

    def __post_init__(self) -> None:
        profile = load_profile(self.scenario.robot)
        object.__setattr__(self, "profile", profile)
        object.__setattr__(self, "terrain", build_terrain(self.scenario, np.random.default_rng([self.seed, 0])))
        object.__setattr__(self, "steps", int(np.ceil((self.scenario.goal.distance + self.beyond) / self.stride)))
        T_sim_start = from_xyz_rpy((0.0, 0.0, 0.0), (0, 0, np.radians(self.heading_deg)))
        object.__setattr__(self, "T_sim_start", T_sim_start)
        rows = 240 + round(self.scenario.goal.distance / 0.01)
        cells = np.meshgrid(0.01 * np.arange(-40, rows - 40), 0.01 * np.arange(-60, 61), indexing="ij")
        xy = np.stack(cells, axis=-1).reshape(-1, 2) @ T_sim_start[:2, :2].T
        object.__setattr__(self, "heights", self.terrain.height_at(xy).reshape(rows, 121))
        object.__setattr__(self, "planted", functools.cache(self._planted))

    def messages(self) -> Iterator[Message]:
        """Yield all messages in the order of their stamps; truth is last at each instant."""
        end_ms = round(1000 * (1.0 + self.steps * self.step_s + self.tail_s))
        for ms in range(0, end_ms, 10):
            t = ms * 1e-3
            if ms % 20 == 0:
                yield self.state(ms)
            if ms % 30 == 0:
                yield self.pose(ms)
            step, phase = self.walked(t)
            if 0.0 <= phase < 0.01 / self.step_s and 1 <= step <= self.steps:
                yield self.plan(ms, step)
            if ms % 100 == 0:
                moved = int(self.moved_leg >= 0 and self.swing(step)[self.moved_leg])
                stands = bool(self.refusal) and step == self.steps and phase == 1.0
                yield PlannerStatus(ms * _MS, "blocked" if stands else "stepping", self.refusal, step, moved, -1)
            if ms % 520 == 0:
                yield self.map(ms)
            if ms % 100 == 0 and ms < 100 * self.sections:
                yield self.passage(ms, 1 + ms // 100)
                yield self.section(ms, 1 + ms // 100)
            yield self.truth(ms)

    def walked(self, t: float) -> tuple[int, float]:
        """Return the number of the running step, from 1, and its phase.

        Step 0 is the rest before the walk.
        """
        if t < 1.0:
            return 0, 1.0
        k = int((t - 1.0) / self.step_s + 1e-9)
        if k >= self.steps:
            return self.steps, 1.0
        return k + 1, max(0.0, (t - 1.0) / self.step_s - k)

    def swing(self, step: int) -> np.ndarray:
        return _TRIPOD if step % 2 else ~_TRIPOD

    def body_x(self, t: float) -> float:
        step, phase = self.walked(t)
        return self.stride * (step - 1 + phase) if step else 0.0

    def _planted(self, step: int) -> np.ndarray:
        """Return the feet (6, 3) [m] {world} at the end of a step."""
        feet = self.profile.rest_feet() + np.array([0.0, 0.0, self.scenario.walk.body_height])
        for swung in range(max(1, step - 1), step + 1):
            legs = self.swing(swung)
            feet[legs, 0] = (self.profile.rest_feet()[:, 0] + self.stride * (swung + 0.5))[legs]
            if self.moved_leg >= 0 and legs[self.moved_leg]:
                feet[self.moved_leg, 1] = self.profile.rest_feet()[self.moved_leg, 1] + 0.02
        sim = feet[:, :2] @ self.T_sim_start[:2, :2].T
        feet[:, 2] = (0.0 if self.level else self.terrain.height_at(sim)) + self.profile.foot.radius
        return feet

    def truth(self, ms: int) -> GroundTruth:
        t = ms * 1e-3
        step, phase = self.walked(t)
        before, after = self.planted(max(step - 1, 0)), self.planted(step)
        airborne = self.swing(step) & (step > 0) & (0.0 < phase < 0.99)
        feet = np.where(airborne[:, None], before + phase * (after - before), np.where(phase < 0.5, before, after))
        feet[:, 2] += np.where(airborne, 0.04 * np.sin(np.pi * phase), 0.0)
        if step and phase < 1.0:
            feet[~airborne, 1] += self.slip * phase
        contact = ~airborne
        if self.flicker and ms % 100 == 50:
            contact = contact & _NONE
        z = self.scenario.walk.body_height - self.sag + self.bob * np.sin(20.0 * t)
        z -= min(max(t - self.sink_s, 0.0), 1.0)
        roll = np.radians(self.tilt_deg) + min(max(t - self.topple_s, 0.0), 1.0)
        T = self.T_sim_start @ from_xyz_rpy((self.body_x(t), 0.0, z), (roll, 0.0, 0.0))
        shutdown = np.zeros((6, 3), dtype=bool)
        shutdown[2, 1] = t >= self.shutdown_s
        torque = np.full((6, 3), 0.3)
        torque[:, 1] = -0.6
        world = feet @ self.T_sim_start[:3, :3].T
        what = (self.scenario.name, self.seed, self.profile.name)
        return GroundTruth(ms * _MS, T, np.zeros((6, 3)), torque, world, contact, contact, shutdown, 11.1, 30.0, *what)

    def state(self, ms: int) -> ActuatorState:
        t = ms * 1e-3
        step, phase = self.walked(t)
        walking = step >= 1 and phase < 1.0
        sits = bool(self.sit) and t >= self.sink_s
        ref = from_xyz_rpy((self.body_x(t), 0.0, self.scenario.walk.body_height), np.zeros(3))
        return actuator_state(
            self.profile,
            stamp_ns=ms * _MS,
            mode=Mode.SIT if sits else Mode.WALK if walking else Mode.HOLD,
            reason=self.sit if sits else "",
            step=step,
            phase=phase,
            swing=self.swing(step) if walking else _NONE,
            contact=~_NONE,
            T_odom_body=ref,
            body_ref=ref,
        )

    def pose(self, ms: int) -> BodyPose:
        T = from_xyz_rpy(
            (self.body_x(ms * 1e-3) * (1 + self.drift), 0.0, self.scenario.walk.body_height - self.sag), np.zeros(3)
        )
        return BodyPose(ms * _MS, T, np.eye(4), np.eye(6) * 1e-6, 1.0, True, "", np.zeros((0, 6)))

    def plan(self, ms: int, step: int) -> StepPlan:
        return StepPlan(
            stamp_ns=ms * _MS,
            epoch=0,
            step=step,
            revision=0,
            T_world_odom=np.eye(4),
            swing=self.swing(step),
            touchdown=self.planted(step),
            clearance=np.full(6, 0.04),
            body_goal=from_xyz_rpy((self.stride * step, 0.0, self.scenario.walk.body_height), np.zeros(3)),
            duration=self.step_s,
            stop=step == self.steps,
        )

    def section(self, ms: int, number: int) -> PassagePlan:
        """Return a section of 0.5 m with one leg per step.

        Its tree has branches to both sides. Without a way the reason differs, and the section ends at the same place.
        """
        begin, k = 0.5 * (number - 1), np.arange(12)
        body = np.column_stack([begin + 0.5 * (k + 1) / 12, 0.0 * k, np.full(len(k), self.scenario.walk.body_height)])
        legs = (k % 6).astype(np.uint8)
        footholds = self.profile.rest_feet()[legs] + body + [0.04, 0.0, 0.0]
        tips = np.column_stack(
            [np.repeat(np.linspace(begin, begin + 0.45, 10), 2) + 0.05, np.tile([-0.04, 0.04], 10), np.full(20, 0.1)]
        )
        edges = np.stack([tips - [0.05, 0.0, 0.0] - tips * [0.0, 1.0, 0.0], tips], axis=1).astype(np.float32)
        where, counts = (
            (np.zeros(2), 0.0, self.scenario.goal.distance, begin + 0.5),
            (100 * number, 10 * number, 12.5),
        )
        state, reason = (
            ("partial", "cells ahead are unknown: look again") if self.way else ("no way", "the gap is 4 cm wider than reach")
        )
        stopped = footholds[-6:-5] if not self.way else np.zeros((0, 3))  # left front foot
        return PassagePlan(ms * _MS, number, state, reason, *where, *counts, legs, footholds, body, edges, stopped)

    def passage(self, ms: int, number: int) -> PassageMap:
        """Return a strip of 1.2 m from the beginning of a section, with true heights.

        Its near fifth is assumed.
        """
        x, y = 0.5 * (number - 1) + 0.01 * np.arange(120), 0.01 * np.arange(-40, 41)
        height = self.terrain.height_at(np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)).reshape(120, 81)
        carries = (np.abs(height) < 0.02).astype(np.uint8)
        inside, outside = (cv2.distanceTransform(cells, cv2.DIST_L2, 3) for cells in (carries, 1 - carries))
        evaluation = np.clip(np.where(carries, -inside, outside), -9, 9).astype(np.int8)
        flat, none = np.zeros((120, 81), np.float32), np.zeros((120, 81), bool)
        up, assumed = np.zeros((120, 81, 3), np.int16), none | (np.arange(120) < 24)[:, None]
        origin = np.array([x[0], y[0]])
        layers = (height.astype(np.float32), up, flat, assumed, evaluation, 0.0, "", np.eye(4), none)
        return PassageMap(ms * _MS, 0.01, origin, 0.0, *layers)

    def map(self, ms: int) -> TerrainMap:
        first = round(self.body_x(ms * 1e-3) / 0.01)
        height = (self.heights[first : first + 200] + self.map_bias).astype(np.float32)
        height[:, :10] = np.nan
        assumed = np.zeros((200, 121), dtype=bool)
        assumed[: max(0, 100 - first)] = True  # up to x = 0.6
        score = np.where(np.abs(np.gradient(height)[0]) > 0.004, 2.0, 0.2).astype(np.float32)
        origin = np.array([0.01 * (first - 40), -0.6])
        evaluation = np.where(score > 1, 1, -1).astype(np.int8)
        return TerrainMap(ms * _MS, 0.01, origin, height, np.full_like(height, 1e-5), score, assumed, evaluation)

    def scorer(self) -> Scorer:
        return Scorer(self.profile, self.scenario, self.seed, passable=self.passable)

    def judged(self) -> Scorer:
        """Return the scorer that has processed the walk; it is the same one each time."""
        return _judged(self)

    def judge(self) -> Scorer:
        """Return a new scorer that has processed the walk."""
        scorer = self.scorer()
        inbox = Inbox([scorer.trigger, *scorer.subscribes], scorer.stages)
        for message in self.messages():
            topic = topics.OF_TYPE[type(message)]
            inbox.now_ns = message.stamp_ns
            if isinstance(message, GroundTruth):
                assert list(scorer.step(message, inbox)) == []
                if scorer.finished:
                    break
            else:
                inbox.receive(topic, codec.encode(message), message.stamp_ns)
        return scorer


@functools.cache
def _judged(story: Story) -> Scorer:
    return story.judge()


@pytest.fixture
def story() -> Callable[..., Story]:
    """Return the class of synthetic walks."""
    return Story
