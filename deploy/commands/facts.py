"""`sextant doctor` and `sextant service compose`: machine checks and compose files."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from sextant.deploy.commands.common import FAILED, SUCCESS, InputError, say

if TYPE_CHECKING:
    from sextant.deploy.doctor.check import Check


def doctor(arguments: argparse.Namespace) -> int:
    """`sextant doctor`: check that this machine meets the services' requirements."""
    from sextant.deploy.doctor import machine_checks as checks
    from sextant.deploy.doctor.check import Level

    if arguments.stranger:
        found = _strange(arguments.stranger, arguments.key_folder)
    else:
        found = checks.examine(arguments.port, arguments.robot, arguments.camera)
    say(checks.to_json(found) if arguments.json else checks.in_words(found))
    return FAILED if any(check.level is Level.FAIL for check in found) else SUCCESS


def _strange(endpoint: str, keys: str | None) -> "list[Check]":
    """Try to connect to an endpoint without authorisation."""
    try:
        from sextant.deploy.security.security_probe import examine
    except ImportError as error:
        raise InputError(f"{error}; it makes the certificates that --stranger tries: pip install 'sextant[access]'") from None
    try:
        return examine(endpoint, Path(keys) if keys else None)
    except ValueError as error:
        raise InputError(f"--stranger: {error}") from None


def compose(arguments: argparse.Namespace) -> int:
    """`sextant service compose`: print compose.yaml of a local or an offboard launch."""
    from sextant.deploy.launch.compose import compose_yaml, offboard_yaml

    text = offboard_yaml() if arguments.offboard else compose_yaml(arguments.scenario, arguments.seed)
    say(text.rstrip("\n"))
    return SUCCESS
