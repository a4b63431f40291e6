"""`sextant doctor` and `compose`: what is on this machine, and in containers."""

import argparse
import sys

from deploy.commands.common import FAILED, SUCCESS, say


def doctor(arguments: argparse.Namespace) -> int:
    """`sextant doctor`: whether this machine has what the services need."""
    from deploy import doctor as checks
    from deploy.checks import Level

    found = checks.examine(arguments.port, arguments.robot, arguments.camera)
    say(checks.to_json(found) if arguments.json else checks.in_words(found))
    return FAILED if any(check.level is Level.FAIL for check in found) else SUCCESS


def compose(arguments: argparse.Namespace) -> int:
    """`sextant compose`: compose.yaml of a local launch."""
    from deploy.compose import compose_yaml

    sys.stdout.write(compose_yaml(arguments.scenario, arguments.seed))
    return SUCCESS
