"""Commands of `sextant servos` for hobby servos, which a board moves by pulses."""

import json
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from typing import TYPE_CHECKING

from sextant.deploy.commands.common import FAILED, SUCCESS, CommandError, complain, say
from sextant.deploy.commands.servo_port import Bus, opener_of

if TYPE_CHECKING:
    from sextant.services.actuator.commissioning.operator_dialogue import Operator
    from sextant.services.actuator.servo_bus.pwm_servos import PwmServos
    from sextant.shared.robot.profile import Calibration, RobotProfile


@contextmanager
def _board(port: str, profile: "RobotProfile") -> "Iterator[PwmServos]":
    """Open the board, and report one that does not answer."""
    from sextant.services.actuator.commissioning.pulse_commissioning import open_servos
    from sextant.services.actuator.servo_bus.bus_setup import BoardSilentError, BusSetupError
    from sextant.services.actuator.servo_bus.triage import instead_of_board

    assert profile.servo.pulses is not None

    try:
        with closing(open_servos(port, profile, time.monotonic_ns)) as board:
            yield board
    except BoardSilentError as error:
        found = instead_of_board(opener_of(Bus("", port), profile), profile.servo.pulses.board)
        raise CommandError("\n  -> ".join(found) if found else str(error)) from None
    except BusSetupError as error:
        raise CommandError(str(error)) from None


def scan(bus: "Bus", profile: "RobotProfile", as_json: bool) -> int:
    """List the channels of the board, and what they send."""
    from sextant.services.actuator.commissioning import pulse_commissioning

    with _board(bus.port, profile) as board:
        found = pulse_commissioning.channels(board, profile)
    if as_json:
        say(json.dumps({"channels": [one._asdict() for one in found], "feedback": pulse_commissioning.NO_FEEDBACK}, indent=1))
        return SUCCESS
    say(pulse_commissioning.in_words(found))
    say(f"the board answers; {pulse_commissioning.NO_FEEDBACK}")
    if any(one.width_us for one in found):
        say(bus.completed("torque is on; `sextant servos off` turns it off"))
    return SUCCESS


def set_id() -> int:
    """Tell that there are no ids to set."""
    from sextant.services.actuator.commissioning.pulse_commissioning import SET_ID

    complain(SET_ID)
    return FAILED


def centre(port: str, profile: "RobotProfile", channel: int, operator: "Operator") -> bool:
    """Send one servo to its middle until the operator has screwed its horn on."""
    from sextant.services.actuator.commissioning import pulse_commissioning

    with _board(port, profile) as board:
        return pulse_commissioning.centre(board, profile, channel, operator)


def find(port: str, profile: "RobotProfile", channel: int, operator: "Operator") -> bool:
    """Turn one servo to and fro."""
    from sextant.services.actuator.commissioning import pulse_commissioning

    with _board(port, profile) as board:
        return pulse_commissioning.wiggle(board, profile, channel, operator, time.sleep)


def calibrate(
    port: str,
    profile: "RobotProfile",
    operator: "Operator",
    keep: "Callable[[Calibration], None]",
    legs: tuple[str, ...],
    pose: tuple[float, float, float],
) -> int:
    """Measure trims by changing pulses."""
    from datetime import date

    from sextant.services.actuator.commissioning import pulse_commissioning

    with _board(port, profile) as board:
        done = pulse_commissioning.calibrate(board, profile, operator, keep, date.today(), legs=legs, pose_deg=pose)
    return SUCCESS if done else FAILED


def test(port: str, profile: "RobotProfile", operator: "Operator", legs: tuple[str, ...]) -> int:
    """Move each joint a little, while the operator watches."""
    from sextant.services.actuator.commissioning.pulse_commissioning import run_joint_test
    from sextant.services.actuator.commissioning.watched_motion import UNWATCHED

    with _board(port, profile) as board:
        wrong = run_joint_test(board, profile, operator, time.sleep, legs=legs)
    if wrong is None:
        return FAILED
    say("not in order:\n  " + "\n  ".join(wrong) if wrong else UNWATCHED if operator.absent else "all joints are in order")
    return FAILED if wrong else SUCCESS
