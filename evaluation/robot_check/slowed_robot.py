"""Slower walking for servos that a profile would overheat."""

from dataclasses import replace

import numpy as np

from sextant.evaluation.robot_check.gait_cycle import walk_cycle
from sextant.evaluation.robot_check.robot_check import MAX_SPEED_SHARE, MIN_MINUTES
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.servo.protection import Protection

_SLOWER = 1.15  # factor of the durations from one attempt to the next
_LONGEST_STEP_S = 2.0  # [s] that a profile allows
_ATTEMPTS = 10


def slow_down(profile: RobotProfile) -> RobotProfile:
    """Return a robot with longer steps and slower feet, as far as its servos need them to bear the tripod gait.

    Its weight may still be too much: then slower steps do not help.
    """
    for _ in range(_ATTEMPTS):
        stance, servos = profile.stance, profile.servos
        cycle = walk_cycle(profile, "tripod")
        duty = float((cycle.rms_torque / servos.stall_torque).max())
        lasts = Protection().time_to_reach(float(servos.temperature_limit.min()), duty) / 60.0 >= MIN_MINUTES
        in_time = bool((np.abs(cycle.rate).max(axis=0) <= MAX_SPEED_SHARE * servos.no_load_speed).all())
        if (lasts and in_time) or stance.step_s >= _LONGEST_STEP_S:
            break
        step_s = min(round(_SLOWER * stance.step_s, 2), _LONGEST_STEP_S)
        slower = replace(
            stance, step_s=step_s, foot_speed=round(stance.foot_speed / _SLOWER, 3), max_speed=round(stance.stride / step_s, 3)
        )
        profile = replace(profile, stance=slower)
    return profile
