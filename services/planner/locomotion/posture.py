"""Posture of a standing robot: its body moves over its feet, without a map."""

import numpy as np

from sextant.services.planner.locomotion.step_planner import PlannedStep
from sextant.services.planner.robot_estimate import WorldStance
from sextant.shared.geometry import Array, align_rigid, from_xyz_rpy, interpolate, inverse, log_so3
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.wire.messages import PostureCommand

_SPEED = 0.06  # [m/s] of the body's origin
_RATE = np.radians(20.0)  # [rad/s] of the body
_DURATION = (0.6, 4.0)  # [s] of one motion
_MOST_M, _MOST_RAD = 0.1, np.radians(12.0)  # of one motion; longer ones are divided, because the actuator refuses them
_REACHED_M, _REACHED_RAD = 5e-4, 1e-3  # differences of the body pose that no motion corrects


def rest_pose(profile: RobotProfile, feet: Array) -> Array:
    """Return the body pose (4, 4) {world} in which feet (6, 3) [m] {world} are nearest to the resting stance."""
    return align_rigid(profile.rest_feet(), feet)


def posture_step(profile: RobotProfile, command: PostureCommand, stance: WorldStance) -> PlannedStep | None:
    """Return the motion of the body to a posture, or None if the body is there.

    Args:
        profile: The robot.
        command: The posture.
        stance: The robot, standing on all feet.
    """
    goal = rest_pose(profile, stance.feet) @ from_xyz_rpy(command.place, command.rpy)
    move = inverse(stance.body) @ goal
    distance, angle = float(np.linalg.norm(move[:3, 3])), float(np.linalg.norm(log_so3(move[:3, :3])))
    if distance < _REACHED_M and angle < _REACHED_RAD:
        return None
    share = min(1.0, _MOST_M / max(distance, _REACHED_M), _MOST_RAD / max(angle, _REACHED_RAD))
    goal = interpolate(stance.body, goal, share)
    return PlannedStep(
        swing=np.zeros(6, dtype=np.bool_),
        touchdown=stance.feet,
        nominal=stance.feet[:, :2],
        clearance=np.zeros(6),
        body_goal=goal,
        body_after=goal,
        start=stance.feet,
        moved=0,
        share=1.0,
        duration=float(np.clip(share * max(distance / _SPEED, angle / _RATE), *_DURATION)),
        room=1.0,
    )
