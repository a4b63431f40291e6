"""Planner service: plan the next step from the newest map and pose.

It follows Lotriet's state machine of resting and stepping.
"""

import math
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from sextant.services.planner.config import Settings
from sextant.services.planner.gap_crossing.approach import GapCrossingController
from sextant.services.planner.gap_crossing.state_machine import CannotCross, Completed, NextStep, WorldStance
from sextant.services.planner.locomotion.blind_walking import BlindStepPlanner
from sextant.services.planner.locomotion.gait import GAITS, directions, swing_order
from sextant.services.planner.locomotion.missing_ground import MissingGround
from sextant.services.planner.locomotion.replan_attempts import RefusedSteps, StepVariant
from sextant.services.planner.locomotion.step_planner import NoStep, PlannedStep, StepPlanner, StepStart
from sextant.services.planner.navigation.path_follower import MotionCommand, PathFollower, validation_error
from sextant.services.planner.navigation.path_planner import NoPath
from sextant.services.planner.terrain import Terrain, plane_of
from sextant.shared.geometry import Array, apply, inverse, yaw_of
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.runtime.service import AnyTopic, Inbox, Stages
from sextant.shared.wire import topics
from sextant.shared.wire.messages import (
    ActuatorState,
    BodyPose,
    Goal,
    Message,
    Mode,
    PlannerStatus,
    StepPlan,
    TerrainMap,
    VelocityCommand,
)

State = Literal["waiting", "resting", "stepping", "blocked", "arrived"]

_STATUS_PERIOD_NS = 100_000_000
_TRY_AGAIN_NS = 2_000_000_000  # [ns] pause after the actuator has refused every way of taking a step
_MEASURED_NS = 300_000_000  # [ns] of rest after which a foot that stopped on ground counts as measured
_DOUBT_NS = 1_000_000_000  # [ns] for which a gap crossing continues on leg odometry alone
_UNANSWERED_NS = 300_000_000  # [ns] without an answer from resting legs, after which a plan counts as late
_GAP_NS = 500_000_000  # [ns] between two actuator states, above which the planner counts as delayed
_POSES = 45  # number of remembered poses: 3 s
_KEPT = 40  # number of remembered plans besides the newest
_RENEW_NS = 35_000_000  # [ns] after which the running step is sent again: without a plan the actuator goes on for 180 ms
_MAX_STATE_AGE_S = 0.45  # [s] a plan made from an older actuator state arrives too late to be executed
_NEW_COURSE = (0.02, 0.02, 0.1, 0.005, 0.005)  # [m/s, m/s, rad/s, m, m] changes from which a command is a new one
_STILL = 1e-3  # [m/s] and [rad/s]
_ASKED_AGE_S = 2.0  # [s] maximum difference between the stamp of a command and now, in the past or the future
_NOT_MINE = "unknown step in progress; waiting for it to finish"


class Planner:
    """Plans the next step and revises running touchdowns as the map improves."""

    name = "planner"
    trigger: AnyTopic = topics.ACTUATOR_STATE
    subscribes: tuple[AnyTopic, ...] = (
        topics.BODY_POSE,
        topics.TERRAIN,
        topics.VELOCITY,
        topics.GOAL,
        topics.CAMERA_STATE,
        topics.PASSAGE,
    )
    publishes: tuple[AnyTopic, ...] = (topics.STEP_PLAN, topics.PLANNER_STATUS, topics.PASSAGE_REQUEST, topics.PASSAGE_PLAN)

    def __init__(self, profile: RobotProfile, settings: Settings):
        """Start without a plan."""
        self.max_age_s = {topics.ACTUATOR_STATE.key: _MAX_STATE_AGE_S, topics.BODY_POSE.key: settings.pose_age_s}
        if not settings.blind:
            self.max_age_s[topics.TERRAIN.key] = settings.map_age_s
        self.stages = Stages()
        self._profile = profile
        self._settings = settings
        self._strides = StepPlanner(profile, settings)
        self._by_touch = BlindStepPlanner(profile, settings)
        self._holes = MissingGround()
        self._pilot = PathFollower(profile)
        self._passage = GapCrossingController(profile, settings)
        self._led = False  # whether the robot follows a goal
        self._sent: list[_Sent] = []  # plans that the actuator may still execute, the newest last
        self._running: _Sent | None = None  # the plan that is being executed, or was last
        self._refusals = RefusedSteps()
        self._asked: VelocityCommand | None = None  # the command for which the refusals were collected
        self._looked_at: tuple[PlannedStep, TerrainMap] | None = None  # step and map of the last retargeting
        self._poses: deque[BodyPose] = deque(maxlen=_POSES)  # poses of the last seconds
        self._stepped_ns = 0
        self._due_ns = 0
        self._renew_ns = 0
        self._step, self._begun_ns = -1, 0  # the running step, or the last one, and when it was first received
        self._sure_ns = 0  # [ns] when perception was last sure of the robot's pose
        self._moved_ns = 0  # [ns] when the legs last moved
        self._taken_back: NDArray[np.bool_] = np.zeros(6, dtype=np.bool_)  # (6,) legs that returned to their previous footholds
        self._put_down: Array | None = None  # (2,) [m] {world} where the robot stood before its first step
        self._status_due_ns = 0
        self._state: State = "waiting"
        self._reason = "starting"
        self._blocked_leg = -1
        self._moved = 0

    def doing(self) -> str:
        """Return state and reason."""
        return f"{self._state}: {self._reason}"

    def step(self, state: ActuatorState, inbox: Inbox) -> Iterator[Message]:
        """Track the legs and plan when a plan is due."""
        if state.stamp_ns - self._stepped_ns > _GAP_NS:
            self._pilot.pause()
        self._stepped_ns = state.stamp_ns
        self._follow(state)
        known = inbox.latest(topics.BODY_POSE)
        if known is not None:
            if not self._poses or known is not self._poses[-1]:
                self._poses.append(known)
            self._holes.update(state, known.T_world_odom)
        if state.stamp_ns >= self._due_ns:
            sent = self._plan(state, inbox)
            if sent is not None:
                self._due_ns = state.stamp_ns + round(self._settings.revise_s * 1e9)
                self._sent = [*self._sent[-_KEPT:], sent]
                self._moved = sent.stride.moved
                self._renew_ns = state.stamp_ns + _RENEW_NS
                yield sent.plan
        renewed = self._renewal(state, known)
        if renewed is not None:
            self._sent = [*self._sent[-_KEPT:], renewed]
            self._renew_ns = state.stamp_ns + _RENEW_NS
            yield renewed.plan
        yield from self._passage.messages(state.stamp_ns)
        if state.stamp_ns >= self._status_due_ns:
            self._status_due_ns = state.stamp_ns + _STATUS_PERIOD_NS
            yield self._status(state)

    def _follow(self, state: ActuatorState) -> None:
        """Note which plan is being executed and which was refused."""
        if state.step != self._step:
            self._step, self._begun_ns = state.step, state.stamp_ns
        if not _rests(state):
            self._moved_ns = state.stamp_ns
        running = self._running
        if running is None or running.plan.stamp_ns != state.plan_ns:
            self._running = next((s for s in self._sent if s.plan.stamp_ns == state.plan_ns), None)
            # None: the actuator executes another plan, or has restarted.
            if self._running is None and running is not None and state.plan_ns < 0 and state.step == running.plan.step:
                self._taken_back = running.stride.swing.copy()
            if self._running is not None and (running is None or running.plan.step != self._running.plan.step):
                self._due_ns = 0  # a new step: check its touchdowns immediately
                self._refusals.forget()
                if not (self._taken_back & self._running.stride.swing).any():
                    self._taken_back = np.zeros(6, dtype=np.bool_)
        refused = next((s for s in self._sent if s.plan.stamp_ns == state.refused_ns), None)
        if refused is not None:
            self._sent.remove(refused)
            waiting = state.phase < 1.0 and any(s.plan.step == refused.plan.step for s in self._sent)
            if refused.plan.step == state.step + 1 and not waiting:
                self._refusals.add(refused.way, state.refused)

    def _plan(self, state: ActuatorState, inbox: Inbox) -> "_Sent | None":
        """Return the plan to send now, or set the reason in the status and return None."""
        pose = inbox.fresh(topics.BODY_POSE, self._settings.pose_age_s)
        velocity, goal = inbox.fresh(topics.VELOCITY), inbox.fresh(topics.GOAL)
        late_velocity, late_goal = _untimely(velocity, state.stamp_ns), _untimely(goal, state.stamp_ns)
        untimely = late_velocity or late_goal
        command = None if late_velocity else _paced(velocity, state.pace)
        goal = None if goal is None or command is not None or late_goal else replace(goal, speed=goal.speed * state.pace)
        self._led = goal is not None
        if command is not None and not _is_still(command):
            self._passage.abandon()  # a zero or missing command keeps it: it may continue later
        if state.mode not in (Mode.WALK, Mode.HOLD):
            self._passage.abandon()
            self._refusals.forget()
            return self._hold("waiting", f"the actuator is in mode {state.mode}: {state.reason}")
        if command is not None and command.by_touch:
            return self._plan_blind_step(state, command, inbox)
        if pose is None:
            return self._hold("waiting", f"no fresh pose from perception{_blamed_on_camera(inbox)}")
        if command is None and goal is None:
            return self._hold("resting", untimely or "no fresh velocity command and no goal")
        self._sure_ns = state.stamp_ns if pose.ok else self._sure_ns
        if state.step == 0 and _rests(state):
            self._put_down = pose.T_world_body[:2, 3].copy()
        terrain = self._terrain(state, pose, inbox)
        if goal is not None and self._passage.is_crossing(goal):
            if state.stamp_ns - self._sure_ns > _DOUBT_NS:
                return self._hold("waiting", f"the robot's pose has been uncertain for {_DOUBT_NS * 1e-9:.0f} s: {pose.reason}")
            return self._cross_gap(goal, state, pose, terrain, inbox)
        if terrain is None:
            blind = f"; perception reports: {pose.reason}" if not pose.ok else _blamed_on_camera(inbox)
            return self._hold("waiting", f"no fresh terrain map{blind}")  # never walk blind
        invalid_reason = terrain.invalid_reason()
        if invalid_reason:
            return self._hold("waiting", f"the terrain map is invalid: {invalid_reason}")
        if state.phase < 1.0 and state.phase < self._settings.retarget_until:
            return self._retarget(state, pose, terrain)
        if goal is not None and self._passage.is_active(goal):
            return self._cross_gap(goal, state, pose, terrain, inbox)
        if command is not None and _is_still(command):
            self._refusals.forget()
            return self._hold("resting", "the commanded velocity is zero")
        if state.phase < self._settings.plan_from:
            return None
        if command is not None:
            return self._plan_first_feasible((command,), state, pose, terrain)
        assert goal is not None
        return self._plan_towards_goal(goal, state, pose, terrain, inbox)

    def _plan_blind_step(self, state: ActuatorState, command: VelocityCommand, inbox: Inbox) -> "_Sent | None":
        """Return the next step by touch alone.

        It uses no map. Leg odometry gives the body pose since the last pose of perception.
        """
        known = inbox.latest(topics.BODY_POSE)
        if known is None:
            return self._hold("waiting", "by touch: no pose from perception yet, the world frame is unknown")
        pose = replace(known, stamp_ns=state.stamp_ns, T_world_body=known.T_world_odom @ state.T_odom_body)
        if state.stamp_ns - self._moved_ns < _MEASURED_NS:
            return None  # where feet in the air will touch down is not known
        if _is_still(command):
            self._refusals.forget()
            return self._hold("resting", "by touch: the commanded velocity is zero")
        terrain = self._holes.marked(self._by_touch.terrain(state.stamp_ns, _feet_in_world(state, pose)))
        situations = self._situations(state, pose, self._by_touch.asked(command))
        if not situations:
            return self._hold("waiting", _NOT_MINE)
        invalid_reason = self._strides.validation_error(situations[0].command)
        if invalid_reason:
            return self._hold("blocked", invalid_reason)
        with self.stages("plan step"):
            found, way = self._by_touch.choose(situations, terrain, self._refusals.of(0))
        if isinstance(found, NoStep):
            self._due_ns = state.stamp_ns + round(self._settings.revise_s * 1e9)
            if self._refusals.count:
                self._refusals.give_up()
                return self._hold("blocked", f"by touch: {self._refusals.words()}")
            return self._hold("blocked", f"by touch: {found.reason}", found.leg)
        self._state, self._blocked_leg = "stepping", -1
        self._reason = "by touch: the feet search for the ground"
        return self._send(state, pose.T_world_odom, found, state.step + 1, (0, way), stop=True)

    def _plan_towards_goal(
        self, goal: Goal, state: ActuatorState, pose: BodyPose, terrain: Terrain, inbox: Inbox
    ) -> "_Sent | None":
        """Return the next step on the way to a goal.

        If no step follows the path, the robot walks without turning or turns on the spot.
        """
        standing = self._standing(state, pose)
        if standing is None:
            return self._hold("waiting", _NOT_MINE)
        body, _ = standing
        asked = VelocityCommand(state.stamp_ns, np.zeros(2), 0.0, goal.body_height, goal.lift, goal.gait)
        invalid_reason = validation_error(goal) or self._strides.validation_error(asked)
        if invalid_reason:
            return self._hold("blocked", invalid_reason)
        if self._passage.ordered(goal):
            return self._cross_gap(goal, state, pose, terrain, inbox)
        if self._is_unanswered(state):
            self._pilot.pause()
        with self.stages("find a way"):
            found = self._pilot.lead(goal, terrain, self._looked_from(terrain, pose), body, state.stamp_ns)
        if isinstance(found, NoPath):
            return self._cross_gap(goal, state, pose, terrain, inbox, found.reason)
        if not found.commands:
            return self._hold("arrived", found.words)
        sent = self._walk_by(found, state, pose, terrain)
        if sent is None:
            self._pilot.note(self._reason)
        return sent

    def _is_unanswered(self, state: ActuatorState) -> bool:
        """Return whether resting legs leave a plan of the next step unanswered.

        They neither execute it nor refuse it for its content: plans arrive too late.
        """
        sent = next((s for s in self._sent if s.plan.step == state.step + 1), None)
        waits = sent is not None and state.phase >= 1.0 and not self._refusals.count
        return waits and sent is not None and state.stamp_ns - sent.plan.stamp_ns > _UNANSWERED_NS

    def _looked_from(self, terrain: Terrain, pose: BodyPose) -> Array:
        """Return the body pose (4, 4) {world} at the newest scan of the map.

        It is the remembered pose nearest in time.
        """
        stamp_ns = terrain.map.stamp_ns
        return min(self._poses, key=lambda known: abs(known.stamp_ns - stamp_ns), default=pose).T_world_body

    def _walk_by(self, found: MotionCommand, state: ActuatorState, pose: BodyPose, terrain: Terrain) -> "_Sent | None":
        """Return the step of the first feasible command and add the path to the reason."""
        sent = self._plan_first_feasible(found.commands, state, pose, terrain)
        if sent is not None:
            self._reason = f"{found.words}; {self._reason}"
        return sent

    def _plan_first_feasible(
        self, commands: tuple[VelocityCommand, ...], state: ActuatorState, pose: BodyPose, terrain: Terrain
    ) -> "_Sent | None":
        """Return the step of the first command that ground and actuator allow.

        Return None if no command has a step or the actuator has refused every way.
        """
        if commands and _differ(commands[0], self._asked):
            self._refusals.forget()
            self._asked = commands[0]
        for number, command in enumerate(commands):
            sent = self._next_step(state, pose, command, terrain, number)
            if sent is not None or self._state == "stepping":  # the robot comes to rest before a step by touch
                return sent
        if commands and self._state == "blocked" and state.phase >= 1.0:
            sent = self._gathering(state, pose, commands[0], terrain)
            if sent is not None:
                return sent
        if self._refusals.count:
            self._refusals.give_up()
            self._due_ns = state.stamp_ns + _TRY_AGAIN_NS
            return self._hold("blocked", self._refusals.words())
        return None

    def _cross_gap(
        self, goal: Goal, state: ActuatorState, pose: BodyPose, terrain: Terrain | None, inbox: Inbox, no_way: str = ""
    ) -> "_Sent | None":
        """Return the next step of a gap crossing, where walking finds no path."""
        found = self._standing(state, pose)
        if found is None:
            return self._hold("waiting", _NOT_MINE)
        refused = self._refusals.reason if self._refusals.count > 1 else ""
        if refused:
            self._refusals.forget()
        map_ = inbox.latest(topics.PASSAGE)
        with self.stages("cross a passage"):
            led = self._passage.lead(goal, state, WorldStance(*found), pose.T_world_body, terrain, map_, refused)
        if isinstance(led, MotionCommand):
            assert terrain is not None
            return None if state.phase < self._settings.plan_from else self._walk_by(led, state, pose, terrain)
        if isinstance(led, NextStep):
            self._state, self._reason, self._blocked_leg = "stepping", led.words, -1
            return self._send(state, pose.T_world_odom, led.stride, led.number, (0, 0), stop=led.stop)
        if isinstance(led, CannotCross):
            self._due_ns = state.stamp_ns + round(self._settings.revise_s * 1e9)
            both = f"{no_way}; no gap crossing: {led.reason}" if no_way else f"no gap crossing: {led.reason}"
            return self._hold("blocked", both)
        if isinstance(led, Completed):
            self._pilot = PathFollower(self._profile)  # its knowledge of the path does not hold here
        return self._hold("stepping" if state.phase < 1.0 else "waiting", led.words)

    def _terrain(self, state: ActuatorState, pose: BodyPose, inbox: Inbox) -> Terrain | None:
        """Return the map; for the blind baseline, the plane of the standing feet."""
        if self._settings.blind:
            return plane_of(state.stamp_ns, _feet_in_world(state, pose)[~state.swing] - [0.0, 0.0, self._profile.foot.radius])
        map_ = inbox.fresh(topics.TERRAIN, self._settings.map_age_s)
        return None if map_ is None else self._holes.marked(Terrain(map_, self._settings.footholds))

    def _next_step(
        self, state: ActuatorState, pose: BodyPose, command: VelocityCommand, terrain: Terrain, number: int
    ) -> "_Sent | None":
        """Return the next step for one of the commands; `number` is its index."""
        situations = self._situations(state, pose, command)
        if not situations:
            return self._hold("waiting", _NOT_MINE)
        invalid_reason = self._strides.validation_error(command)
        if invalid_reason:
            return self._hold("blocked", invalid_reason)
        with self.stages("plan step"):
            found, way = self._strides.choose(situations, terrain, self._refusals.of(number))
        feels = self._running is not None and self._running.plan.stop  # a step by touch leaves an unusual stance
        if isinstance(found, NoStep) and (found.unseen or feels) and self._put_down is not None:
            course = yaw_of(pose.T_world_body) + math.atan2(command.velocity[1], command.velocity[0])
            ground = self._by_touch.fill_unseen_start(terrain, situations[0].feet, self._put_down, course)
            if ground is not None:
                sent = self._plan_blind_start_step(state, pose, command, ground, number)
                if sent is not None or self._state == "stepping":
                    return sent
        if isinstance(found, NoStep):
            self._due_ns = state.stamp_ns + round(self._settings.revise_s * 1e9)  # trying all shares takes the most time
            return self._hold("blocked", found.reason + self._where_to_look(found, command), found.leg)
        if self._refusals.given_up:
            self._state, self._reason = "blocked", self._refusals.words()
        else:
            self._state, self._blocked_leg = "stepping", -1
            shorter = "" if found.share == 1.0 else f", stride shortened to {found.share:.0%}"
            slower = self._strides.describe_slowdown(command, found)
            instead = f"; the legs due first are blocked: {found.instead}" if found.instead else ""
            moved = f"{found.moved} of {found.swing.sum()} footholds moved from their nominal place"
            moved = moved if found.swing.any() else "moving only the body, to make room for a leg"
            self._reason = f"{moved}{shorter}{slower}{instead}"
        return self._send(state, pose.T_world_odom, found, state.step + 1, (number, way))

    def _gathering(self, state: ActuatorState, pose: BodyPose, command: VelocityCommand, terrain: Terrain) -> "_Sent | None":
        """Return a step on the spot for a blocked robot.

        It brings stretched legs back under the body, because no step may be possible from there. The status stays blocked.
        """
        if self._strides.validation_error(command):
            return None
        with self.stages("gather feet"):
            found, way = self._strides.gather(self._situations(state, pose, command), terrain, self._refusals.of(0))
        if isinstance(found, NoStep):
            return None
        self._reason = f"moving the feet back under the body: {self._reason}"
        return self._send(state, pose.T_world_odom, found, state.step + 1, (0, way))

    def _plan_blind_start_step(
        self, state: ActuatorState, pose: BodyPose, command: VelocityCommand, ground: Terrain, number: int
    ) -> "_Sent | None":
        """Return the next step by touch, from the start position onto ground that is seen."""
        if state.stamp_ns - self._moved_ns < _MEASURED_NS:
            return self._hold("stepping", "stopping, to walk by touch over unseen ground")
        situations = self._situations(state, pose, self._by_touch.asked(command))
        with self.stages("plan step"):
            found, way = self._by_touch.choose(situations, ground, self._refusals.of(number))
        if isinstance(found, NoStep):
            return self._hold("blocked", found.reason, found.leg)  # the caller replaces it by the reason by sight
        self._state, self._blocked_leg = "stepping", -1
        self._reason = "walking by touch over unseen ground, until the feet reach seen ground"
        return self._send(state, pose.T_world_odom, found, state.step + 1, (number, way), stop=True)

    def _where_to_look(self, found: NoStep, command: VelocityCommand) -> str:
        """Return advice to turn first if the ground ahead was never in view, else "".

        With a goal, the path follower turns the robot itself.
        """
        lens = self._profile.camera.intrinsics
        direction = math.atan2(command.velocity[1], command.velocity[0])
        in_view = abs(direction) < math.atan2(lens.width / 2, lens.fx) or not command.velocity.any()
        if self._led or in_view or not found.unseen:
            return ""
        return f"; the ground there is unseen: turn {'left' if direction > 0 else 'right'} first to see it"

    def _situations(self, state: ActuatorState, pose: BodyPose, command: VelocityCommand) -> list[StepStart]:
        """Return the possible starts of the next step, most due legs first; [] if unknown."""
        standing = self._standing(state, pose)
        if standing is None:
            return []
        body, feet = standing
        rest = self._profile.rest_feet(command.body_height)
        along = directions(command.velocity, command.yaw_rate, rest)
        order = swing_order(GAITS[command.gait], along, apply(inverse(body), feet), rest)
        order = sorted(order, key=lambda swing: bool((swing & self._taken_back).any()))  # other groups first
        return [StepStart(body, feet, swing, command) for swing in order]

    def _standing(self, state: ActuatorState, pose: BodyPose) -> tuple[Array, Array] | None:
        """Return body (4, 4) and feet (6, 3) [m] {world} at the end of the running step.

        Return None if they are not known.
        """
        T_world_odom = pose.T_world_odom
        feet = _feet_in_world(state, pose)
        body = T_world_odom @ state.body_ref
        if state.phase < 1.0:
            running = self._running
            if running is None:
                return None
            plan = running.plan
            moved = T_world_odom @ inverse(plan.T_world_odom)  # from the plan's estimate of {world} to the newest
            body = moved @ plan.body_goal
            feet[plan.swing] = apply(moved, plan.touchdown)[plan.swing]
            met = plan.swing & state.touch_carries & (state.touch_ns > self._begun_ns)  # met ground early
            feet[met] = apply(T_world_odom, state.touch)[met] + [0.0, 0.0, self._profile.foot.radius]
        return body, feet

    def _retarget(self, state: ActuatorState, pose: BodyPose, terrain: Terrain) -> "_Sent | None":
        """Return a revision of the running step if the new map moves a touchdown enough."""
        running = self._running
        if running is None:
            return None
        before, self._looked_at = self._looked_at, (running.stride, terrain.map)
        if before is not None and before[0] is running.stride and before[1] is terrain.map:
            return None  # nothing has changed since then
        # The legs follow the estimate at the time of the plan; in the current estimate of {world} that leads here.
        stride = running.stride.moved_by(pose.T_world_odom @ inverse(running.plan.T_world_odom))
        found = self._strides.retarget(stride, terrain)
        if np.abs(found.touchdown - stride.touchdown).max() < self._settings.retarget_from_m:
            return None
        return self._send(state, pose.T_world_odom, found, running.plan.step, running.way)

    def _renewal(self, state: ActuatorState, pose: BodyPose | None) -> "_Sent | None":
        """Return the running step unchanged if no plan was sent for a while.

        The robot walks only while it receives plans.
        """
        running = self._running
        if running is None or state.mode is not Mode.WALK or state.phase >= 1.0 or state.stamp_ns < self._renew_ns:
            return None
        plan = running.plan
        T_world_odom = plan.T_world_odom if pose is None else pose.T_world_odom
        stride = running.stride.moved_by(T_world_odom @ inverse(plan.T_world_odom))
        return self._send(state, T_world_odom, stride, plan.step, running.way, plan.stop)

    def _send(
        self, state: ActuatorState, T_world_odom: Array, stride: PlannedStep, number: int, way: StepVariant, stop: bool = False
    ) -> "_Sent":
        """Return a plan of a step, as its next revision."""
        revision = 1 + max((s.plan.revision for s in self._sent if s.plan.step == number), default=0)
        plan = StepPlan(
            stamp_ns=state.stamp_ns,
            epoch=state.epoch,
            step=number,
            revision=revision,
            T_world_odom=np.array(T_world_odom),
            swing=stride.swing,
            touchdown=stride.touchdown,
            clearance=stride.clearance,
            body_goal=stride.body_goal,
            duration=stride.duration,
            stop=stop,
        )
        return _Sent(plan, stride, way)

    def _hold(self, state: State, reason: str, leg: int = -1) -> "_Sent | None":
        """Return no plan and set the reason.

        Time in which data or a command is missing does not count for stall detection.
        """
        if state in ("waiting", "resting"):
            self._pilot.pause()
        self._state, self._reason, self._blocked_leg = state, reason, leg
        return None

    def _status(self, state: ActuatorState) -> PlannerStatus:
        return PlannerStatus(
            stamp_ns=state.stamp_ns,
            state=self._state,
            reason=self._reason,
            step=state.step,
            moved_footholds=self._moved,
            blocked_leg=self._blocked_leg,
            path=self._pilot.path if self._led else np.zeros((0, 2)),
        )


def _untimely(asked: VelocityCommand | Goal | None, now_ns: int) -> str:
    """Return why the stamp of a command or goal is not current, or "".

    It is from a recording, or its sender uses another clock.
    """
    age_s = 0.0 if asked is None else (now_ns - asked.stamp_ns) * 1e-9
    if abs(age_s) <= _ASKED_AGE_S:
        return ""
    what = "velocity command" if isinstance(asked, VelocityCommand) else "goal"
    when = f"{age_s:.1f} s old" if age_s > 0.0 else f"stamped {-age_s:.1f} s ahead"
    return f"the {what} is {when} by the robot's clock, at most {_ASKED_AGE_S:.0f} s allowed; the sender must use that clock"


def _blamed_on_camera(inbox: Inbox) -> str:
    """Return the reason in the camera's status if the camera is the cause, else ""."""
    camera = inbox.fresh(topics.CAMERA_STATE)
    return "" if camera is None or camera.ok else f"; the camera sends no images: {camera.reason}"


def _rests(state: ActuatorState) -> bool:
    """Return whether all legs stand: none swings, none searches for ground."""
    return state.phase >= 1.0 and state.mode is not Mode.WALK


def _feet_in_world(state: ActuatorState, pose: BodyPose) -> Array:
    """Return measured foot centres (6, 3) [m] {world}."""
    return apply(pose.T_world_odom @ state.T_odom_body, state.feet)


@dataclass(frozen=True, slots=True, eq=False)
class _Sent:
    """A sent plan with its step."""

    plan: StepPlan
    stride: PlannedStep
    way: StepVariant  # way of taking the step


def _paced(command: VelocityCommand | None, pace: float) -> VelocityCommand | None:
    """Return a command at the speed that the servos can sustain."""
    if command is None or pace >= 1.0:
        return command
    return replace(command, velocity=command.velocity * pace, yaw_rate=command.yaw_rate * pace)


def _is_still(command: VelocityCommand) -> bool:
    """Return whether a command asks for no motion."""
    return bool(np.abs(command.velocity).max() < _STILL and abs(command.yaw_rate) < _STILL)


def _differ(a: VelocityCommand, b: VelocityCommand | None) -> bool:
    """Return whether two commands ask for different steps."""
    if b is None:
        return True
    change = np.abs([*(a.velocity - b.velocity), a.yaw_rate - b.yaw_rate, a.body_height - b.body_height, a.lift - b.lift])
    return bool((change > _NEW_COURSE).any()) or a.gait != b.gait
