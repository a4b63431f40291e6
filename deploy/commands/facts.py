"""`sextant doctor`: checks of this machine."""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from sextant.deploy.commands import options
from sextant.deploy.commands.common import FAILED, SUCCESS, InputError, say
from sextant.deploy.commands.servo_port import Bus
from sextant.deploy.terminal.arguments import command, flag, option

if TYPE_CHECKING:
    from sextant.deploy.doctor.check import Check


@command()
@option("--port", "also check this servo port, e.g. /dev/ttyUSB0", "DEVICE")
@flag("--bridge", "a microcontroller on the port drives the servos, see docs/bridge.md")
@option("--camera", "also check this camera: openni2, realsense, oak, orbbec, external, or a folder", "DEVICE", default="")
@option(
    "--stranger",
    "only try to connect to this endpoint without authorisation, e.g. tls/hexapod.local:7448; publishes nothing",
    "ENDPOINT",
)
@option("--keys", "folder of `sextant keys new` with its ca/; --stranger then also tries an expired certificate", "DIR")
@options.robot
@options.as_json
def doctor(
    port: str | None, bridge: bool, camera: str, stranger: str | None, keys: str | None, robot: str, as_json: bool
) -> int:
    """Check that this machine has what the services need."""
    from sextant.deploy.doctor import machine_checks as checks
    from sextant.deploy.doctor.check import Level

    if bridge and port is None:
        raise InputError("--bridge: --port DEVICE expected, the port of the microcontroller")
    found = _strange(stranger, keys) if stranger else checks.examine(port, robot, camera, bridge=bridge)
    bus = Bus(robot, port or "")
    found = [replace(check, advice=bus.completed(check.advice)) for check in found]
    say(checks.to_json(found) if as_json else checks.in_words(found))
    return FAILED if any(check.level is Level.FAIL for check in found) else SUCCESS


def _strange(endpoint: str, keys: str | None) -> "list[Check]":
    """Try to connect to an endpoint without authorisation."""
    try:
        from sextant.deploy.doctor.security_probe import examine
    except ImportError as error:
        raise InputError(f"{error}; it makes the certificates that --stranger tries: pip install 'sextant[access]'") from None
    try:
        return examine(endpoint, Path(keys) if keys else None)
    except ValueError as error:
        raise InputError(f"--stranger: {error}") from None
