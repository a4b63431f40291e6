"""Walk of one section: its steps, and whether the feet stand where they were planned."""

import numpy as np

from sextant.services.planner.compiled_terrain import GOOD
from sextant.services.planner.config import Settings
from sextant.services.planner.locomotion.step_planner import PlannedStep, time_to_swing
from sextant.services.planner.roadmap.roadmap import PassageStep
from sextant.services.planner.roadmap.strip_map import StripMap
from sextant.services.planner.robot_estimate import WorldStance
from sextant.shared.geometry import Array, apply, from_xyz_rpy
from sextant.shared.robot.profile import LEGS, RobotProfile

_OFF_PLACE, _OFF_HEIGHT = 0.03, 0.025  # [m] from a standing foot to its planned foothold, from which the robot plans again
_POSE_S = 2.0  # [s] duration of raising or lowering the body


class SectionWalk:
    """Steps of a section that is walked."""

    def __init__(self, name: str, steps: tuple[PassageStep, ...], field: StripMap, step_before: int):
        """Start before the first step.

        Args:
            name: Of the section, for the status.
            steps: Its steps.
            field: The strip.
            step_before: Number of the robot's step before the first one.
        """
        self.name, self._steps, self._field = name, steps, field
        self._before = step_before

    def __len__(self) -> int:
        return len(self._steps)

    def done(self, step: int) -> int:
        """Return how many steps have begun or are over, by the robot's step number."""
        return step - self._before

    def repeat_last(self) -> None:
        """Make the last step due again, because the robot counted but did not take it."""
        self._before += 1

    def describe(self, number: int) -> str:
        """Return the progress as text."""
        return f"gap crossing, {self.name}: step {number} of {len(self._steps)}"

    def planned_step(self, index: int, standing: WorldStance, profile: RobotProfile, settings: Settings) -> PlannedStep:
        """Return a step of the section as a step in {world}, from the stance of the robot."""
        step, T = self._steps[index], self._field.T_world_strip
        swing = np.arange(6) == step.leg
        touchdown = standing.feet.copy()
        clearance = np.full(6, settings.step.path_margin_m)
        if step.leg >= 0:
            touchdown[step.leg], clearance[step.leg] = apply(T, np.asarray(step.touchdown)), step.clearance
        body = T @ from_xyz_rpy(step.body, (0.0, 0.0, step.yaw))
        legs = np.flatnonzero(swing)
        swinging = time_to_swing(profile, settings.step, standing.feet[legs], touchdown[legs], clearance[legs])
        duration = max([profile.stance.step_s, *swinging.tolist()])
        return PlannedStep(swing, touchdown, touchdown[:, :2], clearance, body, body, standing.feet, 0, 1.0, duration, GOOD)

    def stray_foot(self, standing: WorldStance, done: int) -> str:
        """Return which foot stands away from its planned foothold, or "".

        `done` is the number of completed steps of the section.
        """
        feet = apply(self._field.T_strip_world, standing.feet)
        for leg, step in self._newest(done).items():
            off = feet[leg] - step.touchdown
            level, height = float(np.hypot(off[0], off[1])), abs(float(off[2]))
            if level > _OFF_PLACE or height > _OFF_HEIGHT:
                return f"the {LEGS[leg]} foot is {max(level, height) * 100:.0f} cm from its planned foothold"
        return ""

    def sunk_soles(self, standing: WorldStance, done: int, foot_radius_m: float) -> list[Array]:
        """Return undersides (3,) [m] {world} of feet where the ground gave way."""
        feet = apply(self._field.T_strip_world, standing.feet)
        low = [leg for leg, step in self._newest(done).items() if feet[leg, 2] < step.touchdown[2] - _OFF_HEIGHT]
        return [standing.feet[leg] - [0.0, 0.0, foot_radius_m] for leg in low]

    def _newest(self, done: int) -> dict[int, PassageStep]:
        """Return the newest completed step of each leg."""
        return {step.leg: step for step in self._steps[:done] if step.leg >= 0}


def body_step(standing: WorldStance, body: Array) -> PlannedStep:
    """Return a step in which only the body moves, to a pose (4, 4) {world}."""
    feet = standing.feet
    return PlannedStep(np.zeros(6, dtype=np.bool_), feet, feet[:, :2], np.zeros(6), body, body, feet, 0, 1.0, _POSE_S, GOOD)
