"""`sextant topics`, `doctor` and `compose`: what is on the wire, on this machine, and in containers."""

import argparse
import json
import sys

from deploy.commands.common import FAILED, SUCCESS, say


def list_topics(arguments: argparse.Namespace) -> int:
    """`sextant topics list`: the topic table."""
    from shared.topics import TOPICS

    if arguments.json:
        rows = [{"key": t.key, "type": t.type.__name__, "rate_hz": t.rate_hz, "delivery": t.delivery.value} for t in TOPICS]
        say(json.dumps(rows, indent=1))
        return SUCCESS
    say(f"{'key':<20} {'type':<16} {'rate':>8}  delivery  what")
    for t in TOPICS:
        doc = (t.type.__doc__ or "").split("\n")[0]
        say(f"{t.key:<20} {t.type.__name__:<16} {t.rate_hz:>5.1f} Hz  {t.delivery.value:<8}  {doc}")
    return SUCCESS


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
