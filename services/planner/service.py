"""The planner: Lotriet's state machine of resting and stepping, on the newest map and pose."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Literal

import numpy as np

from services.planner.config import Settings
from services.planner.gait import directions, swinging_tripod
from services.planner.stride import SHARES, Blocked, Situation, Stride, StridePlanner
from services.planner.terrain import Terrain, flat_terrain
from shared import topics
from shared.geometry import Array, apply, inverse
from shared.messages import ActuatorState, BodyPose, Message, Mode, PlannerStatus, StepPlan, TerrainMap, VelocityCommand
from shared.robot import RobotProfile
from shared.service import AnyTopic, Inbox, Stages

State = Literal["waiting", "resting", "stepping", "blocked"]

_STATUS_PERIOD_NS = 100_000_000
_ANSWER_NS = 100_000_000  # [ns] after a plan the actuator's word is about it
_NEW_COURSE = (0.02, 0.1)  # [m/s] and [rad/s] by which a command must differ to be another one
_STILL = 1e-3  # [m/s] and [rad/s]


class Planner:
    """Plans the next step while the last one is walked, and moves the touchdowns of the running one as the map improves."""

    name = "planner"
    paced_by: AnyTopic = topics.ACTUATOR_STATE
    reads: tuple[AnyTopic, ...] = (topics.BODY_POSE, topics.TERRAIN, topics.VELOCITY)
    writes: tuple[AnyTopic, ...] = (topics.STEP_PLAN, topics.PLANNER_STATUS)

    def __init__(self, profile: RobotProfile, settings: Settings):
        """Begin with no plan."""
        self.stages = Stages()
        self._profile = profile
        self._settings = settings
        self._strides = StridePlanner(profile, settings)
        self._sent: StepPlan | None = None  # the newest plan
        self._running: StepPlan | None = None  # the plan of the step that is being walked
        self._stride: Stride | None = None  # behind the newest plan
        self._running_stride: Stride | None = None
        self._looked_at: tuple[Stride, TerrainMap] | None = None  # for the last retargeting
        self._refused: StepPlan | None = None  # the newest plan of which the actuator has said so
        self._refusals = 0  # of plans for the step that comes next
        self._asked: VelocityCommand | None = None  # what was commanded when they began
        self._due_ns = 0
        self._status_due_ns = 0
        self._state: State = "waiting"
        self._reason = "starting"
        self._blocked_leg = -1

    def doing(self) -> str:
        """State and reason."""
        return f"{self._state}: {self._reason}"

    def step(self, state: ActuatorState, inbox: Inbox) -> Iterator[Message]:
        """Follow the legs; plan when it is time to."""
        self._follow(state)
        if state.stamp_ns >= self._due_ns:
            plan = self._plan(state, inbox)
            if plan is not None:
                self._due_ns = state.stamp_ns + round(self._settings.revise_s * 1e9)
                self._sent = plan
                yield plan
        if state.stamp_ns >= self._status_due_ns:
            self._status_due_ns = state.stamp_ns + _STATUS_PERIOD_NS
            yield self._status(state)

    def _follow(self, state: ActuatorState) -> None:
        """Notice when a plan begins to be walked."""
        if self._sent is not None and state.step == self._sent.step and self._running is not self._sent:
            if self._running is None or self._running.step != self._sent.step:
                self._due_ns = 0  # a new step: its touchdowns may be looked at at once
            self._running, self._running_stride = self._sent, self._stride
        if self._running is not None and state.step != self._running.step:
            self._running = self._running_stride = None  # the actuator walks something else, or began anew

    def _plan(self, state: ActuatorState, inbox: Inbox) -> StepPlan | None:
        """The plan to send now, or none and the reason in the status."""
        pose = inbox.fresh(topics.BODY_POSE, self._settings.pose_age_s)
        command = inbox.fresh(topics.VELOCITY)
        if state.mode not in (Mode.WALK, Mode.HOLD):
            return self._hold("waiting", f"the actuator is in mode {state.mode}: {state.reason}")
        if pose is None:
            return self._hold("waiting", "no fresh pose from perception")
        if command is None:
            return self._hold("resting", "no fresh velocity command")
        terrain = self._terrain(state, pose, inbox)
        if terrain is None:
            return self._hold("waiting", "no fresh terrain map")  # never walk blind
        if state.phase < 1.0 and state.phase < self._settings.retarget_until:
            return self._retarget(state, pose, terrain)
        if np.abs(command.velocity).max() < _STILL and abs(command.yaw_rate) < _STILL:
            return self._hold("resting", "no velocity is commanded")
        if state.phase < self._settings.plan_from:
            return None
        return self._next_step(state, pose, command, terrain)

    def _terrain(self, state: ActuatorState, pose: BodyPose, inbox: Inbox) -> Terrain | None:
        """The map, or for the blind baseline level ground at the height of the standing feet."""
        if self._settings.blind:
            feet = _feet_in_world(state, pose)[~state.swing]
            return flat_terrain(state.stamp_ns, feet[:, :2].mean(axis=0), float(feet[:, 2].mean()) - self._profile.foot.radius)
        map_ = inbox.fresh(topics.TERRAIN, self._settings.map_age_s)
        return None if map_ is None else Terrain(map_)

    def _next_step(self, state: ActuatorState, pose: BodyPose, command: VelocityCommand, terrain: Terrain) -> StepPlan | None:
        at = self._situation(state, pose, command)
        if at is None:
            return self._hold("waiting", "the running step is not one of mine; waiting for its end")
        self._hear_refusal(state, command)
        kept_off = max(0, self._refusals - 1)  # the first time the same may pass, by newer estimates
        if kept_off >= 2 * len(SHARES):
            return self._hold("blocked", f"the actuator refuses every step: {state.refused}")
        other_tripod, passed_over = divmod(kept_off, len(SHARES))
        if other_tripod:
            at = replace(at, swing=~at.swing)
        with self.stages("plan step"):
            found = self._strides.plan(at, terrain, passed_over)
        if isinstance(found, Blocked):
            self._due_ns = state.stamp_ns + round(self._settings.revise_s * 1e9)  # trying all shares is the dearest of all
            return self._hold("blocked", found.reason, found.leg)
        self._state, self._blocked_leg = "stepping", -1
        shorter = "" if found.share == 1.0 else f" at {found.share:.0%} of the stride"
        self._reason = f"{found.moved} of 3 footholds moved from their nominal place{shorter}"
        number = state.step + 1
        revision = self._sent.revision + 1 if self._sent is not None and self._sent.step == number else 1
        self._stride = found
        return self._message(state, pose, found, number, revision)

    def _hear_refusal(self, state: ActuatorState, command: VelocityCommand) -> None:
        """Count how often the actuator has refused the next step: sent as it was, it would be refused again."""
        sent = self._sent
        if sent is None or sent.step != state.step + 1 or _differ(command, self._asked):
            self._refusals, self._asked = 0, command
        elif state.refused and state.stamp_ns - sent.stamp_ns >= _ANSWER_NS and self._refused is not sent:
            self._refusals += 1
            self._refused = sent

    def _situation(self, state: ActuatorState, pose: BodyPose, command: VelocityCommand) -> Situation | None:
        """Where the robot will stand when the running step is over."""
        T_world_odom = pose.T_world_odom
        feet = _feet_in_world(state, pose)
        body = T_world_odom @ state.body_ref
        if state.phase < 1.0:
            running = self._running
            if running is None:
                return None
            moved = T_world_odom @ inverse(running.T_world_odom)  # the world as it is believed to be now
            body = moved @ running.body_goal
            feet[running.swing] = apply(moved, running.touchdown)[running.swing]
        rest = self._profile.rest_feet(command.body_height)
        feet_body = apply(inverse(body), feet)
        swing = swinging_tripod(directions(command.velocity, command.yaw_rate, rest), feet_body, rest)
        return Situation(body, feet, swing, command)

    def _retarget(self, state: ActuatorState, pose: BodyPose, terrain: Terrain) -> StepPlan | None:
        """A revision of the running step, when the newer map moves a touchdown by more than a little."""
        running, stride = self._running, self._running_stride
        if running is None or stride is None:
            return None
        before, self._looked_at = self._looked_at, (stride, terrain.map)
        if before is not None and before[0] is stride and before[1] is terrain.map:
            return None  # nothing has changed since
        found = self._strides.retarget(stride, terrain)
        if np.abs(found.touchdown - stride.touchdown).max() < self._settings.retarget_from_m:
            return None
        self._stride = found
        return self._message(state, pose, found, running.step, running.revision + 1)

    def _message(self, state: ActuatorState, pose: BodyPose, stride: Stride, number: int, revision: int) -> StepPlan:
        return StepPlan(
            stamp_ns=state.stamp_ns,
            step=number,
            revision=revision,
            T_world_odom=np.array(pose.T_world_odom),
            swing=stride.swing,
            touchdown=stride.touchdown,
            clearance=stride.clearance,
            body_goal=stride.body_goal,
            duration=self._settings.step_s,
            stop=False,
        )

    def _hold(self, state: State, reason: str, leg: int = -1) -> StepPlan | None:
        """No plan, and why."""
        self._state, self._reason, self._blocked_leg = state, reason, leg
        return None

    def _status(self, state: ActuatorState) -> PlannerStatus:
        return PlannerStatus(
            stamp_ns=state.stamp_ns,
            state=self._state,
            reason=self._reason,
            step=state.step,
            moved_footholds=0 if self._stride is None else self._stride.moved,
            blocked_leg=self._blocked_leg,
        )


def _feet_in_world(state: ActuatorState, pose: BodyPose) -> Array:
    """Measured feet (6, 3) [m] {world}."""
    return apply(pose.T_world_odom @ state.T_odom_body, state.feet)


def _differ(a: VelocityCommand, b: VelocityCommand | None) -> bool:
    """Whether two commands ask for different steps."""
    if b is None:
        return True
    velocity, yaw_rate = _NEW_COURSE
    return bool(np.abs(a.velocity - b.velocity).max() > velocity or abs(a.yaw_rate - b.yaw_rate) > yaw_rate)
