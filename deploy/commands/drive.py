"""`sextant drive`: keys and a gamepad in a terminal."""

import contextlib
import os
import socket
from typing import TYPE_CHECKING

from sextant.deploy.commands import options
from sextant.deploy.commands.common import INTERRUPTED, SUCCESS, CommandError, InputError, complain, say
from sextant.deploy.terminal.arguments import command, option

if TYPE_CHECKING:
    from sextant.shared.wire.messages import GaitRequest


@command()
@options.robot
@options.connection
@option("--gait", "gait of the walk; auto: the planner chooses gait and speed", type=options.GAIT, default="tripod")
@option("--gamepad", "joystick device of Linux, e.g. /dev/input/js0 (default: keys only)", "DEVICE", default="")
def drive(robot: str, connection: options.Connection, gait: "GaitRequest", gamepad: str) -> int:
    """Drive a running robot by keys or a gamepad, in a terminal.

    The robot walks while a key is held, which the terminal shows by repeating it. Hold a key: after its first repetition the
    robot walks, and 0.3 s after the last one it stops. Without repetition of keys only a gamepad can drive.
    """
    from sextant.deploy.live.client_run import run_client
    from sextant.deploy.live.send_command import router_refusal
    from sextant.deploy.terminal.raw_terminal import RawTerminal
    from sextant.services.console.drive.driver import KEYS, PAD, Driver, TerminalLostError
    from sextant.services.console.drive.gamepad import Gamepad, GamepadError
    from sextant.shared.robot.profiles import load_profile
    from sextant.shared.wire import topics

    profile, endpoints = load_profile(robot), connection.endpoints()
    if endpoints.keys is not None and (refused := endpoints.keys.refusal([topics.MODE])):
        raise InputError(f"{refused}; `sextant order stop` may stop the robot with these keys")
    try:
        terminal = RawTerminal(lambda why: driver.end(why))
        pad = Gamepad(gamepad) if gamepad else None
        driver = Driver(profile, f"{socket.gethostname()}:{os.getpid()}", terminal, pad, gait, router_refusal)
        with contextlib.closing(driver), terminal:
            say(KEYS if pad is None else f"{KEYS}\n{PAD}")
            withdrawn = run_client(driver, endpoints, terminal.show)
    except (GamepadError, TerminalLostError) as error:
        raise InputError(str(error)) from None
    if withdrawn is not None:
        complain("stopped by the operator, and so is the robot")
        return INTERRUPTED
    if driver.failed:
        raise CommandError(f"{driver.failed}; the robot was stopped")
    return SUCCESS
