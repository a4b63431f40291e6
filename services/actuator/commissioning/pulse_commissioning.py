"""Commissioning of hobby servos: pulses of each channel, calibration by pulses, and a test that the operator watches.

The servos measure nothing. A joint jumps to its first pulses. So one joint at a time gets pulses, and the operator confirms
first.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from datetime import date
from typing import NamedTuple

import numpy as np

from sextant.services.actuator.commissioning.calibration import implausible, reachable_pose, see_pose, trims_deg
from sextant.services.actuator.commissioning.joint_test import legs_in_words
from sextant.services.actuator.commissioning.operator_dialogue import Operator
from sextant.services.actuator.commissioning.watched_motion import AGAIN, seen_problem, way_in_words
from sextant.services.actuator.servo_bus.bus_driver import open_port
from sextant.services.actuator.servo_bus.pwm_servos import PwmServos
from sextant.shared.robot.profile import JOINTS, LEGS, Calibration, RobotProfile

NO_FEEDBACK = "no feedback: the angles of the joints are assumed; touch, load, heat and voltage are unknown"
SET_ID = "hobby servos have no id: connect each to the channel of its joint, or state its channel in servo_ids of the profile"
_PATIENCE_NS = 50_000_000  # [ns] to wait for an answer of the board
STEP_DEG = 6.0  # of the joint test
WIGGLE_DEG = 8.0
_WIGGLES = 3
_LARGEST_STEP_DEG = 5.0  # of one typed change of a pulse
_OFF_ATTEMPTS = 3
_STEPS = 40  # in which a test turns a joint


def open_servos(port: str, profile: RobotProfile, clock: Callable[[], int]) -> PwmServos:
    """Open the board of a robot with hobby servos; `clock` is monotonic time [ns].

    Raises:
        BusDisconnectedError: The port cannot be opened.
    """
    assert profile.servo.pulses is not None
    opened = open_port(port, timeout_ns=_PATIENCE_NS)
    return PwmServos(opened, list(profile.servo_names), clock, profile.servo.pulses)


class Channel(NamedTuple):
    """Channel of a board, and what it sends."""

    number: int
    joint: str
    width_us: float  # 0 without pulses
    angle_deg: float  # servo angle of these pulses; 0 without


def channels(servos: PwmServos, profile: RobotProfile) -> list[Channel]:
    """Return what the board sends on the channels of the robot; raises BusSetupError if the board does not answer."""
    servos.setup()
    table, units = servos.model.table, servos.model.units
    found = []
    for number, joint in profile.servo_names.items():
        has_pulses, ticks = servos.read(number, table.torque_enable), servos.read(number, table.goal_position) or 0
        width = servos.width_us(ticks) if has_pulses else 0.0
        found.append(Channel(number, joint, width, float(np.degrees(units.angle(ticks))) if has_pulses else 0.0))
    return found


def in_words(found: Sequence[Channel]) -> str:
    """Return channels as lines of text."""
    return "\n".join(
        f"channel {one.number:2d}  {one.joint:<19} "
        + (f"{one.width_us:6.1f} us  {one.angle_deg:+6.1f} deg" if one.width_us else "no pulses")
        for one in found
    )


def centre(servos: PwmServos, profile: RobotProfile, channel: int, operator: Operator) -> bool:
    """Send one servo to its middle until the operator presses Enter; return whether it was moved.

    Raises:
        BusSetupError: The board does not answer.
        BusDisconnectedError: The port is gone.
    """
    with _one(servos, profile, channel, operator, "at full speed") as name:
        if name:
            operator.ask(f"{name} holds its middle. Screw its horn on, then press Enter to end its pulses: ")
        return bool(name)


def wiggle(servos: PwmServos, profile: RobotProfile, channel: int, operator: Operator, pause: Callable[[float], None]) -> bool:
    """Turn one servo to and fro about its middle; return whether it was moved. Errors are those of `centre`."""
    then = f"at full speed, then turns to and fro by {WIGGLE_DEG:g} deg"
    with _one(servos, profile, channel, operator, then) as name:
        for phase in np.linspace(0.0, 2.0 * np.pi * _WIGGLES, _WIGGLES * _STEPS) if name else ():
            _send(servos, channel, WIGGLE_DEG * float(np.sin(phase)))
            pause(0.02)
        return bool(name)


@contextmanager
def _one(servos: PwmServos, profile: RobotProfile, channel: int, operator: Operator, how: str) -> Iterator[str]:
    """Send one servo to its middle if the operator agrees, give its name or else nothing, and end its pulses."""
    servos.setup()
    name = f"channel {channel} ({profile.servo_names[channel]})"
    if not operator.agree(f"{name} jumps to its middle, {how}. Can its shaft turn freely?"):
        operator.say("nothing was moved")
        yield ""
        return
    try:
        _send(servos, channel, 0.0)
        yield name
    finally:
        off = any(servos.write(channel, servos.model.table.torque_enable, 0) for _ in range(_OFF_ATTEMPTS))
        operator.say("its pulses have ended" if off else "the board does not confirm their end: switch the servos' power off")


def calibrate(
    servos: PwmServos,
    profile: RobotProfile,
    operator: Operator,
    keep: Callable[[Calibration], None],
    today: date,
    *,
    legs: Sequence[str],
    pose_deg: tuple[float, float, float],
) -> bool:
    """Measure trims by changing pulses until each joint is in a pose; return whether all legs were saved.

    Raises:
        ValueError: The pose is beyond a leg's limits.
        BusSetupError: The board does not answer.
        BusDisconnectedError: The port is gone.
    """
    for leg in legs:
        see_pose(profile, leg, pose_deg)
    servos.setup()
    kept = 0
    try:
        for name in legs:
            servos.set_torque(False)
            question = (
                f"Bend the {name} leg by hand to about {', '.join(f'{angle:g}' for angle in pose_deg)} deg. "
                "Its joints get pulses one after another, and jump. Are its surroundings free?"
            )
            if not operator.agree(question):
                operator.say(f"the {name} leg is skipped")
                continue
            turned = _bend(servos, profile, operator, LEGS.index(name), pose_deg)
            if turned is None:
                break
            trims = trims_deg(profile, LEGS.index(name), np.radians(turned), pose_deg)
            if words := implausible(trims):
                operator.say(words)
                continue
            coxa, femur, tibia = np.round(trims, 2).tolist()
            keep(Calibration(name, today, (coxa, femur, tibia)))
            kept += 1
    finally:
        servos.set_torque(False)
        operator.say(f"{kept} of {len(legs)} legs calibrated; torque is off")
    return kept == len(legs)


def _bend(
    servos: PwmServos, profile: RobotProfile, operator: Operator, leg: int, pose_deg: Sequence[float]
) -> list[float] | None:
    """Return the servo angles [deg] at which the joints of a leg are in the pose; None if the operator leaves."""
    q = np.tile(np.radians(pose_deg), (len(LEGS), 1))
    start = np.degrees(profile.servo_angles(q)[leg])
    found = []
    for joint, words in enumerate(JOINTS):
        channel, angle = int(profile.servo_ids[leg, joint]), float(start[joint])
        while True:
            angle = _send(servos, channel, angle)
            answer = operator.ask(
                f"{LEGS[leg]} {words}: servo at {angle:+.1f} deg. Enter if the joint is at {pose_deg[joint]:g} deg; "
                "else by how many degrees to turn it, e.g. 2 or -0.5; q stops: "
            ).strip()
            if not answer:
                break
            if answer.lower() == "q":
                return None
            angle += int(profile.servo_signs[leg, joint]) * _typed(operator, answer)
        found.append(angle)
    return found


def _typed(operator: Operator, answer: str) -> float:
    """Return a typed change [deg], 0 if it is none."""
    try:
        change = float(answer)
    except ValueError:
        change = np.nan
    if abs(change) <= _LARGEST_STEP_DEG:
        return change
    operator.say(f"degrees from -{_LARGEST_STEP_DEG:g} to {_LARGEST_STEP_DEG:g} expected, found {answer!r}")
    return 0.0


def _send(servos: PwmServos, channel: int, angle_deg: float) -> float:
    """Send a servo to an angle [deg] within its range, with pulses; return the angle that it has been sent to."""
    units, table = servos.model.units, servos.model.table
    ticks = min(max(units.ticks(float(np.radians(angle_deg))), 0), units.max_position)
    servos.write(channel, table.goal_position, ticks)
    servos.write(channel, table.torque_enable, 1)
    return float(np.degrees(units.angle(ticks)))


def _turn(servos: PwmServos, channel: int, start: float, turn: float, pause: Callable[[float], None]) -> None:
    """Send a servo from an angle [deg] by a turn [deg] and back, then end its pulses."""
    _send(servos, channel, start)
    pause(1.0)
    for share in (*np.linspace(0.0, 1.0, _STEPS), *np.linspace(1.0, 0.0, _STEPS)):
        _send(servos, channel, start + turn * float(share))
        pause(0.02)
    servos.write(channel, servos.model.table.torque_enable, 0)


def run_joint_test(
    servos: PwmServos, profile: RobotProfile, operator: Operator, pause: Callable[[float], None], *, legs: Sequence[str]
) -> list[str] | None:
    """Move each joint by some degrees and back; return what the operator has seen to be wrong, None if nothing was moved.

    Args:
        servos: The robot's servos.
        profile: The robot.
        operator: Says of each joint whether it has moved, and which way.
        pause: Waits for some seconds.
        legs: Legs to test.

    Raises:
        BusSetupError: The board does not answer.
        BusDisconnectedError: The port is gone.
    """
    servos.setup()
    servos.set_torque(False)
    pose = reachable_pose(profile)
    angles = ", ".join(f"{joint} {angle:g}" for joint, angle in zip(JOINTS, pose, strict=True))
    if not operator.agree(
        f"Each joint of {legs_in_words(legs)} jumps to its angle in the pose {angles} deg, then turns by {STEP_DEG:g} deg and "
        "back. Bend the legs to that pose by hand. Is the robot on a stand, its legs free?"
    ):
        operator.say("nothing was moved, torque is off")
        return None
    start = np.degrees(profile.servo_angles(np.tile(np.radians(pose), (len(LEGS), 1))))
    wrong = []
    try:
        for name in legs:
            leg = LEGS.index(name)
            for joint, words in enumerate(JOINTS):
                up = 1 if np.radians(pose[joint] + STEP_DEG) <= profile.joint_limits[leg, joint, 1] else -1
                way = way_in_words(profile, leg, joint, up)
                turn = up * int(profile.servo_signs[leg, joint]) * STEP_DEG
                seen = AGAIN
                while seen == AGAIN:
                    _turn(servos, int(profile.servo_ids[leg, joint]), float(start[leg, joint]), turn, pause)
                    seen = seen_problem(operator, profile, leg, joint, way)
                if seen:
                    wrong.append(f"{name} {words}: {seen}")
    finally:
        servos.set_torque(False)
        operator.say("torque is off")
    return wrong
