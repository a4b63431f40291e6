"""Scripted operator: stand up, walk to the goal by velocity or by plan, stop.

It knows only the estimated pose.
"""

from collections.abc import Iterator
from dataclasses import replace
from math import atan2, cos, radians, sin
from typing import Literal

import numpy as np

from sextant.shared.geometry import Array, yaw_of
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.runtime.robot_clock import RobotClockEstimate
from sextant.shared.runtime.service import Every, Inbox, Stages
from sextant.shared.scenario.scenario import Scenario
from sextant.shared.wire import topics
from sextant.shared.wire.messages import (
    ActuatorState,
    GapCrossingMode,
    Goal,
    Message,
    Mode,
    ModeCommand,
    PlannerStatus,
    Tick,
    VelocityCommand,
)

# How far beyond the goal line the operator leads the robot by the estimate, so that the true body passes the line too: [m], and
# [1] of the way, by which depths of a camera that is not calibrated may be too long.
_OVERSHOOT, _OVERSHOOT_SHARE = 0.03, 0.03
_BY_TOUCH = 0.15  # [m] further overshoot for a robot that walks blind by odometry
_LATERAL_GAIN = 2.0  # [rad/m] course toward the line per metre of lateral offset
_MAX_COURSE = radians(25.0)  # [rad] off the line's direction
_HEADING_GAIN = 0.5  # [1/s] yaw rate per heading error
_MAX_YAW_RATE = 0.15  # [rad/s]
_APPROACH = 0.15  # [m] before the end, where the speed begins to fall
_CREEP = 0.4  # [1] share of the speed that remains at the end
_TOLERANCE = 0.03  # [m] from the end of a route
_GOAL_NS = round(1e9 / topics.GOAL.rate_hz)
_ORDER_NS = 500_000_000  # [ns] interval of repeated orders, so that a restarted actuator receives them
_BLOCKED_NS = 20_000_000_000  # [ns] patience with a planner that is blocked
_NO_POSE_S = 5.0  # [s] patience without a pose, after the first one
_START_NS = 60_000_000_000  # [ns] patience for the first message of a service
_LOST_NS = 2_000_000_000  # [ns] the planner waits without scans before it is asked to walk blind, if the scenario allows
_AGAIN_NS = (
    1_000_000_000  # [ns] in READY after the order to stand, or in HOLD without having risen, until the order is repeated
)
_FAULT_NS = 10_000_000_000  # [ns] patience with an actuator that is in fault or off
_UNHEARD_S = 10.0  # [s] patience with a planner that rests although it is ordered to walk


class Operator:
    """Drives the robot along the line to the goal, or sends the planner the goal.

    {world} has its origin where the robot started, with x along its heading, so the line is the x axis.
    """

    name = "operator"
    subscribes = (topics.BODY_POSE, topics.ACTUATOR_STATE, topics.PLANNER_STATUS)
    publishes = (topics.VELOCITY, topics.GOAL, topics.MODE)

    def __init__(self, profile: RobotProfile, scenario: Scenario, no_pose_s: float = _NO_POSE_S):
        """Prepare the operator.

        Args:
            profile: The robot.
            scenario: The goal, and how to walk there.
            no_pose_s: Patience [s] without a pose, after the first one; infinite for a link that may be cut at will.
        """
        self._no_pose_s = no_pose_s
        self._robot = RobotClockEstimate()  # the robot's clock, which stamps the orders
        self.trigger = Every.hz(topics.VELOCITY.rate_hz)
        self.stages = Stages()
        self.finished = False
        self.reason = ""  # why it is finished, as text
        self.progress = "waiting for the actuator"
        self._line = scenario.goal.distance
        self._goal = self._line + _OVERSHOOT + _OVERSHOOT_SHARE * self._line
        end = (self._goal + _TOLERANCE, 0.0)
        self._route = np.array([*scenario.goal.waypoints, end]) if scenario.goal.route else None
        self._gap_crossing: GapCrossingMode = "always" if scenario.goal.passage else "if needed"
        self._goal_due_ns = 0
        self._walk = replace(scenario.walk, body_height=profile.stance.height_or_own(scenario.walk.body_height))
        self._speed = profile.stance.max_speed
        if not scenario.walk.auto_speed:
            self._speed = min(scenario.walk.speed, self._speed)
        self._order: Literal["stand", "walk"] = "stand"
        self._given_ns = -1  # when that was ordered, by the robot's clock
        self._order_due_ns = 0
        self._rising = False
        self._arrived_ns: int | None = None
        self._by_touch = False  # whether blind walking was requested
        self._since: dict[str, int] = {}  # condition -> since when [ns] it has lasted

    def step(self, tick: Tick, inbox: Inbox) -> Iterator[Message]:
        """Run one cycle: read the inputs, order a mode, steer."""
        now = tick.stamp_ns
        state = inbox.latest(topics.ACTUATOR_STATE)
        if self._robot.see(now, None if state is None else state.stamp_ns):
            self._given_ns = -1
        if self._given_ns < 0 and self._robot.known:
            self._given_ns = self._robot()
        pose = inbox.latest(topics.BODY_POSE)
        steerable = inbox.fresh(topics.BODY_POSE) is not None
        status = inbox.latest(topics.PLANNER_STATUS)
        if self._by_touch and pose is not None and state is not None:  # while walking blind, odometry is the only pose
            pose, steerable = replace(pose, T_world_body=pose.T_world_odom @ state.T_odom_body), True
        if state is not None and self._is_to_repeat(state):
            self._give(self._order)
        if not self.finished:
            self._choose_order(now, state, pose is not None)
            self._ask_for_touch(now, status)
            self._give_up(now, state, status, ever_posed=pose is not None, posed=steerable)
        if now >= self._order_due_ns and self._robot.known:
            self._order_due_ns = now + _ORDER_NS
            yield ModeCommand(self._robot(), self._order, self._given_ns)
        if self._order == "walk":
            known = pose is not None and steerable and not self.finished
            if self._route is None:
                yield self._steer(now, pose.T_world_body if pose is not None and known else None)
            elif not self.finished and now >= self._goal_due_ns:
                self._goal_due_ns = now + _GOAL_NS
                walk = self._walk
                yield Goal(
                    self._robot(),
                    self._route,
                    _TOLERANCE,
                    self._speed,
                    walk.body_height,
                    walk.lift,
                    walk.gait,
                    self._gap_crossing,
                    walk.auto_speed,
                )
            arrived = self._route is not None and status is not None and status.has_arrived_at(self._route[-1])
            if arrived and self._arrived_ns is None:
                self._arrived_ns = now
            self._watch_arrival(now, state, status)
        if not self.finished:
            self.progress = self._words(state, status, pose.T_world_body if pose else None)

    def status(self) -> str:
        """Return the current activity as text."""
        return self.reason or self.progress

    def _choose_order(self, now: int, state: ActuatorState | None, posed: bool) -> None:
        """Order stand until the robot has risen; order walk once it also has a pose."""
        if self._order == "walk" or state is None:
            return
        self._rising |= state.mode is Mode.STAND
        # A robot that was walking when this operator connected treats the order as a stop.
        if state.mode is not (Mode.READY if self._rising else Mode.HOLD):
            self._since.pop("waits", None)
        elif now - self._since.setdefault("waits", now) >= _AGAIN_NS:
            self._since.pop("waits")
            self._give("stand")
        risen = self._rising and state.mode is Mode.HOLD
        if posed and (risen or state.mode is Mode.WALK):
            self._give("walk")

    def _is_to_repeat(self, state: ActuatorState) -> bool:
        """Return whether the actuator requests a repeated order.

        It does so when an order arrived late, unless torque off was ordered in the meantime.
        """
        refused = f"`{self._order}` of operator refused: "
        asked = [words for words in state.warnings if words.startswith(refused) and words.endswith("; order it again")]
        late = [words for words in asked if "ordered off" not in words]
        return bool(late) and not self.finished and state.stamp_ns - self._given_ns > _ORDER_NS

    def _give(self, order: Literal["stand", "walk"]) -> None:
        """Give a new order from now on."""
        self._order, self._given_ns, self._order_due_ns = order, max(self._given_ns + 1, self._robot()), 0

    def _ask_for_touch(self, now: int, status: PlannerStatus | None) -> None:
        """Request blind walking once the robot has waited too long for scans.

        Only where the scenario allows it; the request is permanent.
        """
        waits = self._walk.by_touch and self._order == "walk" and status is not None and status.state == "waiting"
        if not waits:
            self._since.pop("sight", None)
        elif not self._by_touch and now - self._since.setdefault("sight", now) >= _LOST_NS:
            self._by_touch = True
            self._goal += _BY_TOUCH

    def _give_up(
        self, now: int, state: ActuatorState | None, status: PlannerStatus | None, ever_posed: bool, posed: bool
    ) -> None:
        blocked = status is not None and status.state == "blocked"
        why = status.reason if status is not None else ""
        mode, mode_reason = (state.mode, state.reason) if state is not None else (None, "")
        ordered = self._order == "walk"
        led = ordered and posed and self._arrived_ns is None and mode in (Mode.HOLD, Mode.WALK)
        unheard_s = max(_UNHEARD_S, self._no_pose_s)
        checks = (
            ("blocked", blocked, _BLOCKED_NS, f"the planner has been blocked for {_BLOCKED_NS * 1e-9:.0f} s: {why}"),
            (
                "no pose",
                ever_posed and not posed,
                1e9 * self._no_pose_s,
                f"no pose from perception for {self._no_pose_s:.0f} s",
            ),
            (
                "unheard",
                led and status is not None and status.state == "resting",
                1e9 * unheard_s,
                f"for {unheard_s:.0f} s the planner has received no command from here: {why}; if it runs on "
                "another machine, that machine's keys must permit commands from here (docs/access.md)",
            ),
            ("never posed", not ever_posed, _START_NS, f"no pose from perception within {_START_NS * 1e-9:.0f} s"),
            ("no actuator", state is None, _START_NS, f"no message from the actuator within {_START_NS * 1e-9:.0f} s"),
            ("fault", mode is Mode.FAULT, _FAULT_NS, f"the actuator is in fault: {mode_reason}"),
            ("off", ordered and mode is Mode.OFF, _FAULT_NS, f"the torque is off: {mode_reason}"),
        )
        for name, lasts, patience_ns, words in checks:
            if not lasts:
                self._since.pop(name, None)
            elif now - self._since.setdefault(name, now) >= patience_ns:
                self._finish(words)
                return

    def _steer(self, now: int, T_world_body: Array | None) -> VelocityCommand:
        """Return the velocity command; zero without a pose and once the goal is reached."""
        velocity, yaw_rate = np.zeros(2), 0.0
        if T_world_body is not None and self._arrived_ns is None:
            x, y, yaw = float(T_world_body[0, 3]), float(T_world_body[1, 3]), yaw_of(T_world_body)
            remaining = self._goal - x
            if remaining <= 0.0:
                self._arrived_ns = now
            else:
                speed = self._speed * min(1.0, _CREEP + (1.0 - _CREEP) * remaining / _APPROACH)
                course = min(max(-_LATERAL_GAIN * y, -_MAX_COURSE), _MAX_COURSE)
                direction = course - yaw
                velocity = speed * np.array([cos(direction), sin(direction)])
                error = atan2(sin(yaw), cos(yaw))
                yaw_rate = min(max(-_HEADING_GAIN * error, -_MAX_YAW_RATE), _MAX_YAW_RATE)
        walk = self._walk
        how = walk.body_height, walk.lift, walk.gait
        return VelocityCommand(self._robot(), velocity, yaw_rate, *how, self._by_touch, walk.auto_speed)

    def _watch_arrival(self, now: int, state: ActuatorState | None, status: PlannerStatus | None) -> None:
        if self.finished or self._arrived_ns is None or now - self._arrived_ns < _ORDER_NS:
            return  # the planner may not have received the stop yet
        planner_rests = status is None or status.state != "stepping"
        if planner_rests and state is not None and state.mode is not Mode.WALK:
            self._finish("at the goal according to the estimated pose")

    def _finish(self, reason: str) -> None:
        self.finished = True
        self.reason = self.progress = reason

    def _words(self, state: ActuatorState | None, status: PlannerStatus | None, T_world_body: Array | None) -> str:
        if state is None:
            return "waiting for the actuator"
        if self._order == "stand":
            return "waiting for a pose" if T_world_body is None and self._rising else "standing up"
        at = f"{T_world_body[0, 3]:.2f}" if T_world_body is not None else "?"
        return f"at {at} of {self._line:.2f} m" + (f"; planner {status.state}: {status.reason}" if status else "")
