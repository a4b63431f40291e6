"""Horn calibration: servo angles of a leg bent to a known pose give the trims.

Torque is off while the leg is bent. If the operator asks for a check, the leg is then held with little torque.
"""

from collections.abc import Callable, Collection, Sequence
from datetime import date

import numpy as np

from sextant.services.actuator.commissioning.limited_motion import hold, limited_motion, ready, resting, torque_words
from sextant.services.actuator.commissioning.operator_dialogue import Operator
from sextant.services.actuator.commissioning.torque_off import torque_off_if_interrupted
from sextant.services.actuator.servo_bus.several_buses import AnyBus
from sextant.shared.geometry import Array
from sextant.shared.robot.profile import JOINTS, LEGS, MAX_TRIM_DEG, Calibration, RobotProfile

STRAIGHT_OUT = (0.0, 0.0, 0.0)  # [deg] coxa, femur, tibia: a ruler along the leg is the jig
_MEASURE = _KEEP = ""
_AGAIN, _CHECK, _SKIP, _LEAVE = "b", "h", "s", "q"


def calibrate(
    bus: AnyBus,
    profile: RobotProfile,
    operator: Operator,
    keep: Callable[[Calibration], None],
    today: date,
    *,
    legs: Sequence[str] = LEGS,
    pose_deg: tuple[float, float, float] = STRAIGHT_OUT,
) -> bool:
    """Measure the trims of legs, save each at once; return whether all were saved.

    The operator may stop at any leg.

    Args:
        bus: The robot's servos.
        profile: The robot; its present trims do not matter.
        operator: The person who bends the legs.
        keep: Saves each leg's calibration as soon as the operator accepts it.
        today: The calibration's date.
        legs: Legs to calibrate.
        pose_deg: [deg] coxa, femur and tibia angle to which a leg is bent.

    Raises:
        ValueError: The pose is beyond a leg's limits.
        ServoNotRespondingError: A servo stopped answering; saved calibrations stay.
        BusDisconnectedError: The port is gone.
    """
    for leg in legs:
        see_pose(profile, leg, pose_deg)
    if not ready(bus, profile, operator):
        return False
    kept = 0
    with torque_off_if_interrupted(bus, operator):
        for leg in legs:
            trims = _measure_leg(bus, profile, operator, LEGS.index(leg), pose_deg)
            if trims == _LEAVE:
                break
            if isinstance(trims, str):
                operator.say(f"the {leg} leg is skipped")
                continue
            keep(Calibration(leg, today, trims))
            kept += 1
    operator.say(f"{kept} of {len(legs)} legs calibrated; torque is off")
    return kept == len(legs)


def trims_deg(profile: RobotProfile, leg: int, servo: Array, pose_deg: Sequence[float]) -> Array:
    """Return trims (3,) [deg] from servo angles (3,) [rad] at a pose (3,) [deg]."""
    turned = np.degrees(profile.servo_signs[leg] * servo)
    return np.asarray(turned - pose_deg - profile.horn_offsets_deg)


def implausible(trims: Array) -> str:
    """Return why trims (3,) [deg] are implausible for good horns, or an empty string."""
    far = [f"{joint} {trim:+.1f} deg" for joint, trim in zip(JOINTS, trims, strict=True) if abs(trim) > MAX_TRIM_DEG]
    if not far:
        return ""
    return (
        f"trims of at most {MAX_TRIM_DEG:g} deg either way expected, found {', '.join(far)}: the leg is not in the pose, the "
        f"servo is another joint's, or its horn is not mounted at its angle: `sextant servos centre ID --robot FILE` states it"
    )


def reachable_pose(profile: RobotProfile) -> tuple[float, float, float]:
    """Return a pose [deg] of any leg: straight out, but the middle of the limits for a joint that cannot be straight."""
    limits = np.degrees(profile.joint_limits)
    low, high = limits[..., 0].max(axis=0), limits[..., 1].min(axis=0)
    coxa, femur, tibia = np.where((low <= 0.0) & (high >= 0.0), 0.0, np.round((low + high) / 2.0)).tolist()
    return coxa, femur, tibia


def see_pose(profile: RobotProfile, leg: str, pose_deg: Sequence[float]) -> None:
    """Raise ValueError for a pose (3,) [deg] beyond a leg's limits."""
    reached = " ".join(f"{angle:g}" for angle in reachable_pose(profile))
    limits = np.degrees(profile.joint_limits[LEGS.index(leg)])
    for joint, angle, (low, high) in zip(JOINTS, pose_deg, limits, strict=True):
        if not low <= angle <= high:
            raise ValueError(
                f"a pose within the {leg} leg's limits expected, found {joint} {angle:g} deg, not {low:.0f} to {high:.0f} deg; "
                f"--pose {reached} is one"
            )


def _measure_leg(
    bus: AnyBus, profile: RobotProfile, operator: Operator, leg: int, pose_deg: Sequence[float]
) -> tuple[float, float, float] | str:
    """Return the accepted trims [deg], or the choice to skip the leg or to stop."""
    ids = profile.servo_ids[leg].tolist()
    pose = ", ".join(f"{joint} {angle:g}" for joint, angle in zip(JOINTS, pose_deg, strict=True))
    straight = " (straight out, level, like a ruler)" if tuple(pose_deg) == STRAIGHT_OUT else ""
    while True:
        question = f"Bend the {LEGS[leg]} leg by hand to {pose} deg{straight}, and press Enter; s skips it, q stops: "
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


def _content(bus: AnyBus, operator: Operator, ids: Sequence[int]) -> str:
    """Return the operator's choice; hold the leg gently while it is checked."""
    torque = torque_words(bus.model_of(ids[0]))
    question = f"Enter keeps the trims, b bends the leg again, h holds it with {torque} for a check, s skips the leg, q stops: "
    while (answer := _choice(operator, question, (_KEEP, _AGAIN, _CHECK, _SKIP, _LEAVE))) == _CHECK:
        with limited_motion(bus, ids):
            hold(bus, ids)
            operator.ask(
                f"the leg is held with {torque.rstrip(',')}; check it with a ruler, then press Enter to turn torque off: "
            )
    return answer


def _choice(operator: Operator, question: str, choices: Collection[str]) -> str:
    """Ask until the answer is one of some letters; plain Enter is an empty string."""
    while (answer := operator.ask(question).strip().lower()) not in choices:
        operator.say(f"Enter or one of {', '.join(filter(None, choices))} expected, found {answer!r}")
    return answer
