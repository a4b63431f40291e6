"""Slower or faster walking, as far as the servos bear it."""

from dataclasses import replace

import numpy as np

from sextant.evaluation.robot_check.foot_lag import foot_lag
from sextant.evaluation.robot_check.gait_cycle import GaitCycle, walk_cycle
from sextant.evaluation.robot_check.limit import MAX_SPEED_SHARE, MIN_MINUTES
from sextant.evaluation.whole_maps.terrain_map import RESOLUTION_M
from sextant.shared.files.config import ConfigError
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.servo.protection import Protection

_SLOWER = 1.15  # factor of the durations from one attempt to the next
_LONGEST_STEP_S = 2.0  # [s] that a profile allows
_ATTEMPTS = 10
_FASTER = (2.0, 1.75, 1.5, 1.35, 1.2, 1.1, 1.05)  # factors of the speed that are tried


def slow_down(profile: RobotProfile) -> RobotProfile:
    """Return a robot with longer steps and slower feet, as far as its servos need them to bear the tripod gait.

    Its weight may still be too much: then slower steps do not help.
    """
    for _ in range(_ATTEMPTS):
        if _bears(profile, walk_cycle(profile, "tripod")) or profile.stance.step_s >= _LONGEST_STEP_S:
            break
        profile = _faster(profile, 1.0 / _SLOWER)
    return profile


def speed_up(profile: RobotProfile) -> RobotProfile | None:
    """Return the fastest robot, of those tried, whose servos bear the tripod gait; None if no faster one does."""
    for factor in _FASTER:
        try:
            faster = _faster(profile, factor)
        except ConfigError:  # steps that are too short for a profile
            continue
        if _bears(faster, walk_cycle(faster, "tripod")):
            return faster
    return None


def _faster(profile: RobotProfile, factor: float) -> RobotProfile:
    """Return a robot whose steps are shorter, and whose feet and body are faster, by a factor."""
    stance = profile.stance
    step_s = min(round(stance.step_s / factor, 2), _LONGEST_STEP_S)
    foot_speed, max_speed = round(factor * stance.foot_speed, 3), round(stance.stride / step_s, 3)
    return replace(profile, stance=replace(stance, step_s=step_s, foot_speed=foot_speed, max_speed=max_speed))


def _bears(profile: RobotProfile, cycle: GaitCycle) -> bool:
    """Return whether the servos are fast enough for a cycle, stay cool, and place the feet."""
    servos = profile.servos
    if (np.abs(cycle.rate).max(axis=0) > MAX_SPEED_SHARE * servos.no_load_speed).any():
        return False
    duty = float((cycle.rms_torque / servos.stall_torque).max())
    if Protection().time_to_reach(float(servos.temperature_limit.min()), duty) < 60.0 * MIN_MINUTES:
        return False
    lag = foot_lag(profile, cycle)
    return lag.in_air <= cycle.lift and lag.on_ground <= RESOLUTION_M
