"""Where each horn sits: a leg is bent by hand to a stated pose, and what its servos then say is held against what they should.

Torque is off while the leg is bent. Only where the operator asks for it the leg is then held, gently, to be checked.
"""

from collections.abc import Callable, Collection, Sequence
from datetime import date

import numpy as np

from sextant.services.actuator.commissioning.limited_motion import gently, hold, ready, resting
from sextant.services.actuator.commissioning.set_ids import Operator
from sextant.services.actuator.commissioning.torque_off import limp_if_broken_off
from sextant.services.actuator.servo_bus.dynamixel_bus import ServoBus
from sextant.shared.geometry import Array
from sextant.shared.robot.profile import JOINTS, LEGS, MAX_TRIM_DEG, Calibration, RobotProfile

STRAIGHT_OUT = (0.0, 0.0, 0.0)  # [deg] coxa, femur, tibia: a ruler along the leg is the jig
_MEASURE = _KEEP = ""
_AGAIN, _CHECK, _SKIP, _LEAVE = "b", "h", "s", "q"


def calibrate(
    bus: ServoBus,
    profile: RobotProfile,
    operator: Operator,
    keep: Callable[[Calibration], None],
    today: date,
    *,
    legs: Sequence[str] = LEGS,
    pose_deg: tuple[float, float, float] = STRAIGHT_OUT,
) -> bool:
    """Measure the trims of legs, one after the other, and keep each at once; whether all were kept. It can be left.

    Args:
        bus: The robot's servos.
        profile: The robot; trims that it has already do not matter.
        operator: Who bends the legs.
        keep: Takes each leg's calibration as soon as the operator is content.
        today: The calibration's date.
        legs: Which.
        pose_deg: [deg] coxa, femur and tibia angle to which a leg is bent.

    Raises:
        ValueError: The pose is beyond a leg's limits.
        ServoSilentError: A servo stopped answering; legs that were kept are.
        BusGone: The port is gone.
    """
    for leg in legs:
        see_pose(profile, leg, pose_deg)
    if not ready(bus, profile, operator):
        return False
    kept = 0
    with limp_if_broken_off(bus, operator):
        for leg in legs:
            trims = _measure_leg(bus, profile, operator, LEGS.index(leg), pose_deg)
            if trims == _LEAVE:
                break
            if isinstance(trims, str):
                operator.say(f"the {leg} leg is left out")
                continue
            keep(Calibration(leg, today, trims))
            kept += 1
    operator.say(f"{kept} of {len(legs)} legs calibrated; torque is off")
    return kept == len(legs)


def trims_deg(profile: RobotProfile, leg: int, servo: Array, pose_deg: Sequence[float]) -> Array:
    """Trims (3,) [deg] of a leg whose servos stand at angles (3,) [rad] while its joints are at a pose (3,) [deg]."""
    turned = np.degrees(profile.servo_signs[leg] * servo)
    return np.asarray(turned - pose_deg - profile.horn_offsets_deg)


def implausible(trims: Array) -> str:
    """Why trims (3,) [deg] cannot be those of horns put on as they should, or nothing."""
    far = [f"{joint} {trim:+.1f} deg" for joint, trim in zip(JOINTS, trims, strict=True) if abs(trim) > MAX_TRIM_DEG]
    if not far:
        return ""
    return (
        f"trims of at most {MAX_TRIM_DEG:g} deg either way expected, found {', '.join(far)}: the leg is not in the pose, the "
        f"servo is another joint's, or its horn sits a notch off (take it off and put it on straight)"
    )


def see_pose(profile: RobotProfile, leg: str, pose_deg: Sequence[float]) -> None:
    """Refuse a pose (3,) [deg] that a leg cannot be bent to, with a ValueError."""
    limits = np.degrees(profile.joint_limits[LEGS.index(leg)])
    for joint, angle, (low, high) in zip(JOINTS, pose_deg, limits, strict=True):
        if not low <= angle <= high:
            raise ValueError(
                f"a pose within the {leg} leg's limits expected, found {joint} {angle:g} deg, not {low:.0f} to {high:.0f} deg"
            )


def _measure_leg(
    bus: ServoBus, profile: RobotProfile, operator: Operator, leg: int, pose_deg: Sequence[float]
) -> tuple[float, float, float] | str:
    """Trims [deg] that the operator is content with, else whether the leg is left out, or that is all."""
    ids = profile.servo_ids[leg].tolist()
    pose = ", ".join(f"{joint} {angle:g}" for joint, angle in zip(JOINTS, pose_deg, strict=True))
    straight = " (straight out, level, like a ruler)" if tuple(pose_deg) == STRAIGHT_OUT else ""
    while True:
        question = f"Bend the {LEGS[leg]} leg by hand to {pose} deg{straight}, and press Enter; s leaves it out, q ends here: "
        answer = _choice(operator, question, (_MEASURE, _SKIP, _LEAVE))
        if answer != _MEASURE:
            return answer
        servo = resting(bus, ids)
        if servo is None:
            operator.say("the leg moves; hold it still")
            if operator.absent:
                return _SKIP
            continue
        trims = trims_deg(profile, leg, servo, pose_deg)
        if words := implausible(trims):
            operator.say(words)
            if operator.absent:
                return _SKIP
            continue
        operator.say("trims: " + ", ".join(f"{joint} {trim:+.1f} deg" for joint, trim in zip(JOINTS, trims, strict=True)))
        answer = _content(bus, operator, ids)
        if answer == _KEEP:
            coxa, femur, tibia = np.round(trims, 2).tolist()
            return coxa, femur, tibia
        if answer != _AGAIN:
            return answer


def _content(bus: ServoBus, operator: Operator, ids: Sequence[int]) -> str:
    """Keep, bend again, leave out or end; the leg is held, gently, for as long as the operator wants to check it."""
    question = (
        "Enter keeps them, b bends the leg again, h holds it with little torque to be checked, s leaves it out, q ends here: "
    )
    while (answer := _choice(operator, question, (_KEEP, _AGAIN, _CHECK, _SKIP, _LEAVE))) == _CHECK:
        with gently(bus, ids):
            hold(bus, ids)
            operator.ask("held with little torque; lay the ruler on it, then Enter takes the torque off: ")
    return answer


def _choice(operator: Operator, question: str, choices: Collection[str]) -> str:
    """One of some letters, empty for plain Enter; asked for until it is one."""
    while (answer := operator.ask(question).strip().lower()) not in choices:
        operator.say(f"Enter or one of {', '.join(filter(None, choices))} expected, found {answer!r}")
    return answer
