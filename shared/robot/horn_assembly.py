"""Angles of the joints at which horns are screwed on, with each servo at the middle of its range."""

from sextant.shared.robot.profile import JOINTS, RobotProfile


def angles_at_centre(profile: RobotProfile) -> str:
    """Return the angle of each joint of a leg at its servo's centre, as "coxa 0, femur 0, tibia -57.5 deg (bent down)"."""
    angles = [0.0 - offset for offset in profile.horn_offsets_deg]  # a servo angle is sign * (joint angle + horn offset)
    words = ", ".join(f"{joint} {round(angle, 1) + 0.0:g}" for joint, angle in zip(JOINTS, angles, strict=True))
    bent = "" if round(angles[-1], 1) == 0.0 else " (bent down)" if angles[-1] < 0.0 else " (bent up)"
    return f"{words} deg{bent}"
