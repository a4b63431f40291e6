"""Selection of the next step: by sight, by touch, or on the spot.

Several velocity commands may lead on; the first one that ground and actuator allow is taken.
"""

import math
from dataclasses import replace

import numpy as np

from sextant.services.planner.config import Settings
from sextant.services.planner.locomotion.auto_gait import AutoGait
from sextant.services.planner.locomotion.blind_walking import BlindStepPlanner
from sextant.services.planner.locomotion.decision import Decision
from sextant.services.planner.locomotion.gait import Pace, directions, gait_of, swing_order
from sextant.services.planner.locomotion.missing_ground import MissingGround
from sextant.services.planner.locomotion.plan_tracking import UNKNOWN_STEP, NumberedStep, PlanTracker
from sextant.services.planner.locomotion.plugin_step_planner import PluginStepPlanner
from sextant.services.planner.locomotion.posture import posture_step
from sextant.services.planner.locomotion.replan_attempts import StepVariant
from sextant.services.planner.locomotion.step_planner import NoStep, PlannedStep, StepPlanner, StepStart
from sextant.services.planner.operator_request import is_new_course, is_still
from sextant.services.planner.robot_estimate import RobotEstimate, is_resting
from sextant.services.planner.terrain import Terrain
from sextant.shared.geometry import Array, apply, inverse, yaw_of
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.runtime.service import Stages
from sextant.shared.wire.messages import PostureCommand, TerrainMap, VelocityCommand

_RETRY_S = 2.0  # [s] pause after the actuator has refused every way of taking a step


class StepSelector:
    """Selects the next step of the robot, and revises the running one."""

    def __init__(self, profile: RobotProfile, settings: Settings, plans: PlanTracker, stages: Stages):
        """Initialize for a robot.

        Args:
            profile: The robot.
            settings: Settings of the planner.
            plans: The sent plans; their refusals exclude ways of taking a step.
            stages: Durations of the planner's work.
        """
        self._profile, self._settings, self._plans, self._stages = profile, settings, plans, stages
        self._by_sight = (
            PluginStepPlanner(profile, settings, plans.refusals) if settings.step_planner else StepPlanner(profile, settings)
        )
        self._by_touch = BlindStepPlanner(profile, settings)
        self.auto_gait = AutoGait(profile, settings)
        self._asked: VelocityCommand | None = None  # the command for which the refusals were collected
        self._retargeted: tuple[int, TerrainMap] | None = None  # number of the step and map of the last retargeting
        self._posture = np.zeros((2, 3))  # the posture for which the refusals were collected
        self._start_place: Array | None = None  # (2,) [m] {world} where the robot stood before its first step

    @property
    def has_touch(self) -> bool:
        """Whether the feet of the robot feel the ground."""
        return self._by_touch.has_touch

    def validation_error(self, command: VelocityCommand) -> str:
        """Return why this robot can never execute a command, or ""."""
        return self._by_sight.validation_error(command)

    def note_start_place(self, robot: RobotEstimate) -> None:
        """Note where the robot stands while it rests before its first step."""
        if robot.state.step == 0 and is_resting(robot.state):
            self._start_place = robot.pose.T_world_body[:2, 3].copy()

    def select(
        self, commands: tuple[VelocityCommand, ...], robot: RobotEstimate, terrain: Terrain, steered: bool = False
    ) -> Decision:
        """Return the step of the first command that ground and actuator allow.

        Args:
            commands: At least one command, in order of preference.
            robot: The robot.
            terrain: The map.
            steered: Whether an operator steers, who must turn the robot towards unseen ground.
        """
        refusals = self._plans.refusals
        stance = self._plans.stance_after(robot)
        if stance is None:
            return Decision("waiting", UNKNOWN_STEP)
        commands = self.auto_gait.resolve(commands, robot, terrain, stance.body)
        if is_new_course(commands[0], self._asked):
            refusals.forget()
            self._asked = commands[0]
        retry_s = 0.0
        for number, command in enumerate(commands):
            decision = self._select_for(command, number, robot, terrain, steered)
            retry_s = max(retry_s, decision.retry_s)
            # "stepping" without a step: the robot comes to rest first, then it steps by touch.
            if decision.step is not None or decision.state == "stepping":
                return replace(decision, retry_s=retry_s)
        if decision.state == "blocked" and not decision.invalid_command:
            self.auto_gait.note_failure(robot.now_ns, "there was no step")
        if decision.state == "blocked" and not decision.invalid_command and robot.state.phase >= 1.0:
            step = self._gather(commands[0], robot, terrain)
            if step is not None:
                return replace(decision, reason=f"moving the feet back under the body: {decision.reason}", step=step)
        if refusals.excludes_ways:
            refusals.give_up()
            return Decision("blocked", refusals.words(), retry_s=_RETRY_S)
        return replace(decision, retry_s=retry_s)

    def select_by_touch(self, command: VelocityCommand, robot: RobotEstimate, missing_ground: MissingGround) -> Decision | None:
        """Return the next step by touch alone; None while feet in the air will touch down.

        It uses no map. Leg odometry gives the body pose since the last pose of perception.
        """
        refusals = self._plans.refusals
        self.auto_gait.forget_choice()
        if not self._plans.feet_are_measured(robot.now_ns):
            return None
        if is_still(command):
            refusals.forget()
            return Decision("resting", "by touch: the commanded velocity is zero")
        terrain = missing_ground.marked(self._by_touch.terrain(robot.now_ns, robot.feet_in_world()))
        starts = self._starts(self._by_touch.asked(command), robot)
        if not starts:
            return Decision("waiting", UNKNOWN_STEP)
        invalid_reason = self.validation_error(starts[0].command)
        if invalid_reason:
            return Decision("blocked", invalid_reason, invalid_command=True)
        with self._stages("plan step"):
            found, way = self._by_touch.choose(starts, terrain, refusals.of(0))
        if isinstance(found, PlannedStep):
            step = self._next(robot, found, (0, way), None, stop=True)
            return Decision("stepping", "by touch: the feet search for the ground", step=step)
        if refusals.excludes_ways:
            refusals.give_up()
            return Decision("blocked", f"by touch: {refusals.words()}", retry_s=self._settings.revision.interval_s)
        return Decision("blocked", f"by touch: {found.reason}", found.leg, retry_s=self._settings.revision.interval_s)

    def is_new_posture(self, command: PostureCommand) -> bool:
        """Return whether a posture differs from the last one that was selected."""
        return not np.array_equal([command.place, command.rpy], self._posture)

    def select_posture(self, command: PostureCommand, robot: RobotEstimate) -> Decision | None:
        """Return the motion of the body to a posture; None while a step runs."""
        refusals = self._plans.refusals
        self.auto_gait.forget_choice()
        if self.is_new_posture(command):
            refusals.forget()
            self._posture = np.array([command.place, command.rpy])
        stance = self._plans.stance_after(robot)
        if stance is None:
            return Decision("waiting", UNKNOWN_STEP)
        if robot.state.phase < 1.0:
            return None
        if refusals.count > 1:
            reason = f"posture: {refusals.reason}"
            refusals.forget()
            return Decision("blocked", reason, retry_s=_RETRY_S)
        planned = posture_step(self._profile, command, stance)
        if planned is None:
            return Decision("arrived", "the body is in the commanded posture")
        return Decision("stepping", "moving the body to a posture", step=self._next(robot, planned, (0, 0), None, stop=True))

    def retarget(self, robot: RobotEstimate, terrain: Terrain) -> NumberedStep | None:
        """Return the running step by a new map, or None if the map is not new.

        Its touchdowns are unchanged unless the map moves one enough.
        """
        running = self._plans.running
        if running is None:
            return None
        before, self._retargeted = self._retargeted, (running.step.number, terrain.map)
        if before is not None and before[0] == running.step.number and before[1] is terrain.map:
            return None
        planned = running.planned_in(robot.T_world_odom)
        found = self._by_sight.retarget(planned, terrain)
        if np.abs(found.touchdown - planned.touchdown).max() < self._settings.revision.retarget_from_m:
            found = planned
        return replace(running.step, planned=found, T_world_odom=robot.T_world_odom, map_ns=self._map_ns(terrain))

    def _select_for(
        self, command: VelocityCommand, number: int, robot: RobotEstimate, terrain: Terrain, steered: bool
    ) -> Decision:
        """Return the next step for one of the commands; `number` is its index."""
        starts = self._starts(command, robot, self.auto_gait.pace)
        if not starts:
            return Decision("waiting", UNKNOWN_STEP)
        invalid_reason = self.validation_error(command)
        if invalid_reason:
            return Decision("blocked", invalid_reason, invalid_command=True)
        refusals = self._plans.refusals
        with self._stages("plan step"):
            found, way = self._by_sight.choose(starts, terrain, refusals.of(number))
        if isinstance(found, NoStep):
            by_touch = self._select_on_unseen_start(command, number, robot, terrain, starts[0].feet, found)
            if by_touch is not None:
                return by_touch
            reason = found.reason + (self._advice_to_turn(found, command) if steered else "")
            retry_s = self._settings.revision.interval_s  # all shares take the most time
            return Decision("blocked", reason, found.leg, retry_s=retry_s)
        step = self._next(robot, found, (number, way), terrain)
        if refusals.given_up:  # a trial step: the robot stays blocked until the actuator accepts it
            return Decision("blocked", refusals.words(), step=step)
        return Decision("stepping", self._describe(found, command), step=step)

    def _select_on_unseen_start(
        self, command: VelocityCommand, number: int, robot: RobotEstimate, terrain: Terrain, feet: Array, by_sight: NoStep
    ) -> Decision | None:
        """Return a step by touch from the start position onto ground that is seen.

        Return None if the robot is not at its start, or has no such step.

        Args:
            command: The command.
            number: Its index.
            robot: The robot.
            terrain: The map.
            feet: (6, 3) [m] {world} foot centres at the start of the step.
            by_sight: Why there is no step by sight.
        """
        running = self._plans.running
        feels = running is not None and running.plan.stop  # a step by touch leaves an unusual stance
        if not (by_sight.unseen or feels) or self._start_place is None:
            return None
        course = yaw_of(robot.pose.T_world_body) + math.atan2(command.velocity[1], command.velocity[0])
        ground = self._by_touch.fill_unseen_start(terrain, feet, self._start_place, course)
        if ground is None:
            return None
        how = "by touch" if self._by_touch.has_touch else "as on level ground"
        if not self._plans.feet_are_measured(robot.now_ns):
            return Decision("stepping", f"stopping, to walk {how} over unseen ground")
        starts = self._starts(self._by_touch.asked(command), robot)
        with self._stages("plan step"):
            found, way = self._by_touch.choose(starts, ground, self._plans.refusals.of(number))
        if isinstance(found, NoStep):
            return None
        reason = f"walking {how} over unseen ground, until the feet reach seen ground"
        return Decision("stepping", reason, step=self._next(robot, found, (number, way), terrain, stop=True))

    def _gather(self, command: VelocityCommand, robot: RobotEstimate, terrain: Terrain) -> NumberedStep | None:
        """Return a step on the spot for a blocked robot.

        It brings stretched legs back under the body, because no step may be possible from there.
        """
        if self.validation_error(command):
            return None
        with self._stages("gather feet"):
            starts = self._starts(command, robot, self.auto_gait.pace)
            found, way = self._by_sight.gather(starts, terrain, self._plans.refusals.of(0))
        return None if isinstance(found, NoStep) else self._next(robot, found, (0, way), terrain)

    def _starts(self, command: VelocityCommand, robot: RobotEstimate, pace: Pace | None = None) -> list[StepStart]:
        """Return the possible starts of the next step, most due legs first; [] if unknown."""
        stance = self._plans.stance_after(robot)
        if stance is None:
            return []
        rest = self._profile.rest_feet(command.body_height)
        along = directions(command.velocity, command.yaw_rate, rest)
        order = swing_order(gait_of(command.gait), along, apply(inverse(stance.body), stance.feet), rest)
        order = sorted(order, key=lambda swing: bool((swing & self._plans.reversed_legs).any()))  # other groups first
        number = robot.state.step + 1
        return [StepStart(stance.body, stance.feet, swing, command, pace, number) for swing in order]

    def _next(
        self, robot: RobotEstimate, planned: PlannedStep, variant: StepVariant, terrain: Terrain | None, stop: bool = False
    ) -> NumberedStep:
        legs = np.zeros(6) if terrain is None else terrain.map.leg_heights
        return NumberedStep(planned, robot.state.step + 1, variant, robot.T_world_odom, stop, self._map_ns(terrain), legs)

    def _map_ns(self, terrain: Terrain | None) -> int:
        """Return the stamp [ns] of a map, or -1 where none is used."""
        return -1 if terrain is None or self._settings.blind else terrain.map.stamp_ns

    def _describe(self, planned: PlannedStep, command: VelocityCommand) -> str:
        """Return what differs from the commanded step, as text."""
        moved = self._by_sight.describe(planned)
        shorter = "" if planned.share == 1.0 else f", stride shortened to {planned.share:.0%}"
        slower = "" if self.auto_gait.pace else self._by_sight.describe_slowdown(command, planned)
        instead = f"; the legs due first are blocked: {planned.instead}" if planned.instead else ""
        chosen = f"{self.auto_gait.choice.words}; " if self.auto_gait.choice else ""
        return f"{chosen}{moved}{shorter}{slower}{instead}"

    def _advice_to_turn(self, found: NoStep, command: VelocityCommand) -> str:
        """Return advice to turn first if the ground ahead was never in view, else ""."""
        lens = self._profile.camera.intrinsics
        direction = math.atan2(command.velocity[1], command.velocity[0])
        in_view = abs(direction) < math.atan2(lens.width / 2, lens.fx) or not command.velocity.any()
        if in_view or not found.unseen:
            return ""
        return f"; the ground there is unseen: turn {'left' if direction > 0 else 'right'} first to see it"
