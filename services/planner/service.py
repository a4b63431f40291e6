"""Planner service: plan the next step from the newest map and pose.

It rests or steps, as in Lotriet's state machine.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from sextant.services.planner.config import Settings
from sextant.services.planner.gap_crossing.approach import GapCrossingController
from sextant.services.planner.goal_follower import GoalFollower
from sextant.services.planner.locomotion.decision import Decision
from sextant.services.planner.locomotion.missing_ground import MissingGround
from sextant.services.planner.locomotion.plan_tracking import PlanTracker
from sextant.services.planner.locomotion.step_selection import StepSelector
from sextant.services.planner.operator_request import OperatorRequest, current_request, is_still
from sextant.services.planner.robot_estimate import RobotEstimate
from sextant.services.planner.terrain import Terrain, plane_of
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.runtime.service import AnyTopic, Inbox, Stages
from sextant.shared.wire import topics
from sextant.shared.wire.messages import ActuatorState, BodyPose, Goal, Message, Mode, PlannerStatus, VelocityCommand

_CAPTURE_TO_PLAN = "capture to plan"  # stage: from a depth image to the actuator state that executes a plan by its map
_STATUS_PERIOD_NS = 100_000_000
_PAUSE_NS = 500_000_000  # [ns] between two actuator states, above which the time between them does not count as a stall
_MAX_STATE_AGE_S = 0.45  # [s] a plan made from an older actuator state arrives too late to be executed
_STEPPING = (Mode.WALK, Mode.HOLD)  # modes of the actuator in which it executes plans


class Planner:
    """Plans the next step, and revises the touchdowns of the running step as the map improves."""

    name = "planner"
    trigger: AnyTopic = topics.ACTUATOR_STATE
    retrigger: AnyTopic = topics.TERRAIN
    subscribes: tuple[AnyTopic, ...] = (
        topics.BODY_POSE,
        topics.TERRAIN,
        topics.VELOCITY,
        topics.GOAL,
        topics.POSTURE,
        topics.CAMERA_STATE,
        topics.SCAN_RECEIPT,
        topics.PASSAGE,
    )
    publishes: tuple[AnyTopic, ...] = (topics.STEP_PLAN, topics.PLANNER_STATUS, topics.PASSAGE_REQUEST, topics.PASSAGE_PLAN)

    def __init__(self, profile: RobotProfile, settings: Settings, may_search: Callable[[], bool] = lambda: True):
        """Start without a plan.

        Args:
            profile: The robot.
            settings: Settings.
            may_search: Whether the search of gap crossings is compiled; before that, no crossing starts.
        """
        self.max_age_s = {topics.ACTUATOR_STATE.key: _MAX_STATE_AGE_S, topics.BODY_POSE.key: settings.revision.pose_age_s}
        if not settings.blind:
            self.max_age_s[topics.TERRAIN.key] = settings.revision.map_age_s
        self.stages = Stages()
        self._settings = settings
        self._foot_radius_m = profile.foot.radius
        self._missing_ground = MissingGround()
        self._plans = PlanTracker(profile.foot.radius)
        self._steps = StepSelector(profile, settings, self._plans, self.stages)
        gap_crossing = GapCrossingController(profile, settings, may_search)
        self._goals = GoalFollower(profile, settings, self._steps, self._plans, self.stages, gap_crossing)
        self._decision = Decision("waiting", "starting")  # the newest one
        self._has_goal = False
        self._moved_footholds = 0  # in the newest plan
        self._state_ns = 0  # [ns] stamp of the newest actuator state
        self._due_ns = self._status_due_ns = 0  # [ns] when the next decision and the next status are due

    def status(self) -> str:
        """Return state and reason."""
        return f"{self._decision.state}: {self._decision.reason}"

    def step(self, state: ActuatorState, inbox: Inbox) -> Iterator[Message]:
        """Track the legs and plan when a plan is due: with each new map, or after a pause."""
        if state.stamp_ns - self._state_ns > _PAUSE_NS:
            self._goals.pause()
        self._state_ns = state.stamp_ns
        map_ns = self._plans.executed_map_ns
        if self._plans.update(state):
            self._due_ns = 0  # a new step: check its touchdowns immediately
        if self._plans.executed_map_ns > map_ns:
            self.stages.add(_CAPTURE_TO_PLAN, (state.stamp_ns - self._plans.executed_map_ns) * 1e-6)
        pose = inbox.latest(topics.BODY_POSE)
        if pose is not None:
            self._goals.add_pose(pose)
            self._missing_ground.update(state, pose.T_world_odom)
        self._steps.auto_gait.update(state, self._missing_ground.count)
        decision = self._decide(state, inbox) if self._is_due(state, inbox) else None
        if decision is not None:
            yield from self._execute(decision, state)
        renewed = self._plans.renew(state, pose)
        if renewed is not None:
            yield renewed
        yield from self._goals.messages(state.stamp_ns)
        if state.stamp_ns >= self._status_due_ns:
            self._status_due_ns = state.stamp_ns + _STATUS_PERIOD_NS
            yield self._status(state)

    def _is_due(self, state: ActuatorState, inbox: Inbox) -> bool:
        """Return whether to decide.

        A decision is due after a pause, for a new posture, or when a map arrives after a step that was planned on an older map.

        Refused steps are replaced after a pause: the refusal of the newest one may be on its way.
        """
        step = self._decision.step
        by_map = step is not None and step.map_ns >= 0 and not self._plans.refusals.count
        posture = _request(state, inbox).posture if state.mode in _STEPPING else None
        is_new = posture is not None and self._steps.is_new_posture(posture)
        return state.stamp_ns >= self._due_ns or is_new or (by_map and inbox.waiting(topics.TERRAIN))

    def _execute(self, decision: Decision, state: ActuatorState) -> Iterator[Message]:
        """Yield the plan of a decision, and keep the decision for the status."""
        self._decision = decision
        if decision.state in ("waiting", "resting"):  # time without data or a command does not count as a stall
            self._goals.pause()
        step = decision.step
        pause_s = decision.retry_s if step is None else self._settings.revision.interval_s
        if pause_s > 0.0 and (step is None or step.number != state.step):
            self._due_ns = state.stamp_ns + round(pause_s * 1e9)
        if step is not None:
            self._moved_footholds = step.planned.moved
            yield self._plans.send(state, step)

    def _decide(self, state: ActuatorState, inbox: Inbox) -> Decision | None:
        """Return what to do now, or None if nothing is due."""
        pose = inbox.fresh(topics.BODY_POSE, self._settings.revision.pose_age_s)
        request = _request(state, inbox)
        command, goal = request.command, request.goal
        self._has_goal = goal is not None
        if command is not None and not is_still(command):
            self._goals.abandon_crossing()  # a zero or missing command keeps it: it may continue later
        if state.mode not in _STEPPING:
            self._goals.abandon_crossing()
            self._plans.refusals.forget()
            return Decision("waiting", f"the actuator is in mode {state.mode}: {state.reason}")
        if command is not None and command.blind_walking:
            if not self._steps.has_touch:
                return Decision("blocked", "by touch: the servos of this robot measure nothing", invalid_command=True)
            known = inbox.latest(topics.BODY_POSE)
            if known is None:
                return Decision("waiting", "by touch: no pose from perception yet, the world frame is unknown")
            return self._steps.select_by_touch(command, RobotEstimate(state, known), self._missing_ground)
        if request.posture is not None:
            self._goals.abandon_crossing()
            known = inbox.latest(topics.BODY_POSE)
            if known is None:
                return Decision("waiting", "posture: no pose from perception yet, the world frame is unknown")
            return self._steps.select_posture(request.posture, RobotEstimate(state, known))
        if pose is None:
            return Decision("waiting", f"no fresh pose from perception{_camera_fault(inbox)}")
        wanted = goal if command is None else command
        if wanted is None:
            return Decision("resting", request.untimely_reason or "no fresh velocity command and no goal")
        decision = self._walk(wanted, RobotEstimate(state, pose), inbox)
        if decision is None or decision.state != "blocked":
            return decision
        return replace(decision, reason=decision.reason + _sight_fault(pose, inbox))

    def _walk(self, request: VelocityCommand | Goal, robot: RobotEstimate, inbox: Inbox) -> Decision | None:
        """Return the next step by sight, a revision of the running one, or None."""
        self._goals.note_certainty(robot)
        self._steps.note_start_place(robot)
        terrain = self._terrain(robot, inbox)
        invalid_reason = "" if terrain is None else terrain.invalid_reason()
        if invalid_reason:
            return Decision("waiting", f"the terrain map is invalid: {invalid_reason}")
        if isinstance(request, Goal) and self._goals.is_crossing(request):
            return self._goals.continue_crossing(request, robot, terrain, inbox.latest(topics.PASSAGE))
        if terrain is None:
            return Decision("waiting", f"no fresh terrain map{_sight_fault(robot.pose, inbox)}")  # never walk blind
        if robot.state.phase < self._settings.revision.retarget_until_phase:
            revised = self._steps.retarget(robot, terrain)
            return None if revised is None else replace(self._decision, step=revised)
        if self._steps.auto_gait.pace is not None and self._plans.is_settled(robot.state):
            return None
        if isinstance(request, Goal):
            return self._goals.follow(request, robot, terrain, inbox.latest(topics.PASSAGE))
        if is_still(request):
            self._plans.refusals.forget()
            return Decision("resting", "the commanded velocity is zero")
        if robot.state.phase < self._settings.revision.plan_from_phase:
            return None
        return self._steps.select((request,), robot, terrain, steered=True)

    def _terrain(self, robot: RobotEstimate, inbox: Inbox) -> Terrain | None:
        """Return the map; for the blind baseline, the plane of the standing feet."""
        if self._settings.blind:
            soles = robot.feet_in_world()[~robot.state.swing] - [0.0, 0.0, self._foot_radius_m]
            return plane_of(robot.now_ns, soles)
        map_ = inbox.fresh(topics.TERRAIN, self._settings.revision.map_age_s)
        return (
            None
            if map_ is None
            else self._missing_ground.marked(Terrain(map_, self._settings.footholds, self._settings.foothold))
        )

    def _status(self, state: ActuatorState) -> PlannerStatus:
        choice = self._steps.auto_gait.choice if self._decision.state in ("stepping", "blocked") else None
        return PlannerStatus(
            stamp_ns=state.stamp_ns,
            state=self._decision.state,
            reason=self._decision.reason,
            step=state.step,
            moved_footholds=self._moved_footholds,
            blocked_leg=self._decision.blocked_leg,
            invalid_command=self._decision.invalid_command,
            path=self._goals.path if self._has_goal else np.zeros((0, 2)),
            gait="" if choice is None else choice.walk.gait,
            speed=choice.walk.speed if choice is not None and choice.sets_speed else 0.0,
            gait_reason="" if choice is None else choice.reason,
        )


def _request(state: ActuatorState, inbox: Inbox) -> OperatorRequest:
    """Return the request that holds now."""
    orders = inbox.fresh(topics.VELOCITY), inbox.fresh(topics.POSTURE), inbox.fresh(topics.GOAL)
    return current_request(*orders, state.stamp_ns, state.speed_scale)


def _sight_fault(pose: BodyPose, inbox: Inbox) -> str:
    """Return the reason of perception, mapper or camera for a map that is old or lacks ground, else ""."""
    if not pose.ok:
        return f"; perception reports: {pose.reason}"
    receipt = inbox.fresh(topics.SCAN_RECEIPT)
    if receipt is not None and receipt.refused:
        return f"; the mapper refuses scans: {receipt.refused}"
    return _camera_fault(inbox)


def _camera_fault(inbox: Inbox) -> str:
    """Return the reason in the camera's status if the camera is the cause, else ""."""
    camera = inbox.fresh(topics.CAMERA_STATE)
    return "" if camera is None or camera.ok else f"; the camera sends no images: {camera.reason}"
