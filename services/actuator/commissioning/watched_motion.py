"""The operator's view of a joint's motion. It shows a wrong direction or another joint, which no servo measures."""

import numpy as np

from sextant.services.actuator.commissioning.operator_dialogue import Operator
from sextant.shared.robot.profile import JOINTS, LEGS, RobotProfile

UNWATCHED = "a wrong direction or a wrong id shows only without --yes, to someone who watches: do that before the robot walks"
AGAIN = "again"  # the operator has not seen the motion


def way_in_words(profile: RobotProfile, leg: int, joint: int, up: int) -> str:
    """Return where the foot moves, as seen from next to the robot; `up` is the sign of the joint's motion.

    The foot of a leg that hangs on a stand is below its joints, and moves outward where that of a straight leg moves up.
    """
    if JOINTS[joint] != "coxa":
        return "up or outward" if up > 0 else "down or inward"
    ahead = -np.sin(np.radians(profile.legs[leg].neutral_yaw_deg)) * up  # the coxa turns about the body's z axis
    return "forward" if ahead > 0 else "backward"


def seen_problem(operator: Operator, profile: RobotProfile, leg: int, joint: int, way: str) -> str:
    """Ask whether the foot has moved as the profile says; return what is wrong, `AGAIN`, or an empty string."""
    name, servo_id = f"{LEGS[leg]} {JOINTS[joint]}", int(profile.servo_ids[leg, joint])
    if operator.absent:
        return ""
    hobby = profile.servo.pulses is not None
    problems = {
        "y": "",
        "w": f"turns the wrong way: change the sign of the {JOINTS[joint]} in the leg's servo_signs, mirror its "
        f"servo_limits_deg, then calibrate the {LEGS[leg]} leg again",
        "a": f"another joint moved, which has {'channel' if hobby else 'id'} {servo_id}: "
        + (
            "exchange the plugs"
            if hobby
            else "exchange the servo_ids of the two joints in the profile, or `sextant servos set-id`"
        )
        + ", then calibrate the legs of both again",
        "n": "did not move",
        "r": AGAIN,
    }
    question = (
        f"{name}: did the {LEGS[leg]} foot go {way} and back, and nothing else?\n  y yes, w the wrong way, a another joint, "
        "n nothing moved, r repeat: "
    )
    while (answer := operator.ask(question).strip().lower().replace("yes", "y")) not in problems:
        operator.say("one of y, w, a, n and r expected")
    return problems[answer]
