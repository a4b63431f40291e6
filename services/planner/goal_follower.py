"""Walking to a goal: along a path, or across a gap where there is no path."""

from collections import deque
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from sextant.services.planner.config import Settings
from sextant.services.planner.gap_crossing.approach import GapCrossingController
from sextant.services.planner.gap_crossing.outcome import CannotCross, Completed, NextStep
from sextant.services.planner.locomotion.decision import Decision
from sextant.services.planner.locomotion.plan_tracking import UNKNOWN_STEP, NumberedStep, PlanTracker
from sextant.services.planner.locomotion.step_selection import StepSelector
from sextant.services.planner.navigation.path_follower import MotionCommand, PathFollower, validation_error
from sextant.services.planner.navigation.path_planner import NoPath
from sextant.services.planner.robot_estimate import RobotEstimate, is_resting
from sextant.services.planner.terrain import Terrain
from sextant.shared.geometry import Array
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.runtime.service import Stages
from sextant.shared.wire.messages import BodyPose, Goal, Message, PassageMap, VelocityCommand

_UNCERTAIN_NS = 1_000_000_000  # [ns] for which a gap crossing continues on leg odometry alone
_POSES = 45  # number of remembered poses: 3 s


class GoalFollower:
    """Decides the next step towards a goal."""

    def __init__(
        self,
        profile: RobotProfile,
        settings: Settings,
        steps: StepSelector,
        plans: PlanTracker,
        stages: Stages,
        gap_crossing: GapCrossingController,
    ):
        """Initialize for a robot.

        Args:
            profile: The robot.
            settings: Settings of the planner.
            steps: Selection of steps for the commands that lead to the goal.
            plans: The sent plans.
            stages: Durations of the planner's work.
            gap_crossing: Crosses gaps on the way to a goal.
        """
        self._profile, self._settings, self._steps, self._plans, self._stages = profile, settings, steps, plans, stages
        self._path_follower = PathFollower(profile, settings)
        self._gap_crossing = gap_crossing
        self._poses: deque[BodyPose] = deque(maxlen=_POSES)  # poses of the last seconds
        self._certain_ns = 0  # [ns] when perception was last certain of the robot's pose

    @property
    def path(self) -> Array:
        """Return the corners (k, 2) [m] {world} of the current path; the goal alone once arrived."""
        return self._path_follower.path

    def add_pose(self, pose: BodyPose) -> None:
        """Remember a pose, to know from where a map was made."""
        if not self._poses or pose is not self._poses[-1]:
            self._poses.append(pose)

    def note_certainty(self, robot: RobotEstimate) -> None:
        """Note whether perception is certain of the pose now."""
        if robot.pose.ok:
            self._certain_ns = robot.now_ns

    def pause(self) -> None:
        """Exclude the time until the next decision from stall detection."""
        self._path_follower.pause()

    def abandon_crossing(self) -> None:
        """Discard a gap crossing; the next one starts with six feet on the ground."""
        self._gap_crossing.abandon()

    def messages(self, now_ns: int) -> Iterator[Message]:
        """Yield the map request and the planning results of a gap crossing that are due."""
        yield from self._gap_crossing.messages(now_ns)

    def is_crossing(self, goal: Goal) -> bool:
        """Return whether the robot crosses a gap and needs only the map of the strip."""
        return self._gap_crossing.is_crossing(goal)

    def continue_crossing(
        self, goal: Goal, robot: RobotEstimate, terrain: Terrain | None, strip: PassageMap | None
    ) -> Decision | None:
        """Return the next step of a running crossing, or None if none is due.

        The arguments are those of `follow`.
        """
        if robot.now_ns - self._certain_ns > _UNCERTAIN_NS:
            uncertain = f"the robot's pose has been uncertain for {_UNCERTAIN_NS * 1e-9:.0f} s: {robot.pose.reason}"
            return Decision("waiting", uncertain)
        return self._cross_gap(goal, robot, terrain, strip)

    def follow(self, goal: Goal, robot: RobotEstimate, terrain: Terrain, strip: PassageMap | None) -> Decision | None:
        """Return the next step towards a goal, or None if none is due.

        If no step follows the path, the robot walks without turning or turns on the spot.

        Args:
            goal: The goal.
            robot: The robot.
            terrain: The newest map.
            strip: The newest map of the strip across a gap, or None.
        """
        if self._gap_crossing.is_active(goal):
            return self._cross_gap(goal, robot, terrain, strip)
        if robot.state.phase < self._settings.revision.plan_from_phase:
            return None
        stance = self._plans.stance_after(robot)
        if stance is None:
            return Decision("waiting", UNKNOWN_STEP)
        command = VelocityCommand(robot.now_ns, np.zeros(2), 0.0, goal.body_height, goal.lift, goal.gait)
        invalid_reason = validation_error(goal) or self._steps.validation_error(command)
        if invalid_reason:
            return Decision("blocked", invalid_reason, invalid_command=True)
        if self._gap_crossing.ordered(goal):
            return self._cross_gap(goal, robot, terrain, strip)
        if self._plans.is_unanswered(robot.state):
            self.pause()
        with self._stages("find a way"):
            view, resting = self._view_pose(terrain, robot), is_resting(robot.state)
            found = self._path_follower.lead(goal, terrain, view, stance.body, robot.now_ns, resting)
        if isinstance(found, NoPath) and goal.gap_crossing == "never":
            return Decision("blocked", found.reason, retry_s=self._settings.revision.interval_s)
        if isinstance(found, NoPath):
            return self._cross_gap(goal, robot, terrain, strip, found.reason)
        if not found.commands:
            return Decision("arrived", found.words) if resting else Decision("stepping", f"the running step ends {found.words}")
        decision = self._walk(found, robot, terrain)
        if decision.step is None:
            self._path_follower.note(decision.reason)
        return decision

    def _view_pose(self, terrain: Terrain, robot: RobotEstimate) -> Array:
        """Return the body pose (4, 4) {world} at the newest scan of the map.

        It is the remembered pose nearest in time.
        """
        stamp_ns = terrain.map.stamp_ns
        return min(self._poses, key=lambda known: abs(known.stamp_ns - stamp_ns), default=robot.pose).T_world_body

    def _walk(self, motion: MotionCommand, robot: RobotEstimate, terrain: Terrain) -> Decision:
        """Return the step of the first feasible command, with the path in its reason."""
        decision = self._steps.select(motion.commands, robot, terrain)
        return decision if decision.step is None else replace(decision, reason=f"{motion.words}; {decision.reason}")

    def _cross_gap(
        self, goal: Goal, robot: RobotEstimate, terrain: Terrain | None, strip: PassageMap | None, no_path: str = ""
    ) -> Decision | None:
        """Return the next step of a gap crossing; `no_path` is why there is no path."""
        state = robot.state
        stance = self._plans.stance_after(robot)
        if stance is None:
            return Decision("waiting", UNKNOWN_STEP)
        refusals = self._plans.refusals
        refused = refusals.reason if refusals.count > 1 else ""
        if refused:
            refusals.forget()
        with self._stages("cross a passage"):
            led = self._gap_crossing.lead(goal, state, stance, robot.pose.T_world_body, terrain, strip, refused)
        if isinstance(led, MotionCommand):
            assert terrain is not None
            return None if state.phase < self._settings.revision.plan_from_phase else self._walk(led, robot, terrain)
        if isinstance(led, NextStep):
            step = NumberedStep(led.stride, led.number, (0, 0), robot.T_world_odom, led.stop)
            if terrain is not None:
                step = replace(step, leg_heights=terrain.map.leg_heights)
            return Decision("stepping", led.words, step=step)
        if isinstance(led, CannotCross):
            reason = f"{no_path}; no gap crossing: {led.reason}" if no_path else f"no gap crossing: {led.reason}"
            return Decision("blocked", reason, retry_s=self._settings.revision.interval_s)
        if isinstance(led, Completed):
            self._path_follower = PathFollower(self._profile, self._settings)  # its knowledge of the path does not hold here
        return Decision("stepping" if state.phase < 1.0 else "waiting", led.words)
