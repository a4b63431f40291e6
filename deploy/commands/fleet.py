"""`sextant fleet`: the base station of several robots, until Ctrl-C."""

import argparse
from pathlib import Path

from sextant.deploy.commands.common import FAILED, INTERRUPTED, complain, say


def fleet(arguments: argparse.Namespace) -> int:
    """`sextant fleet`: run the offboard processes of each robot and one common page."""
    from sextant.deploy.launch.fleet import Base, load
    from sextant.deploy.terminal.interrupts import Interrupts

    asked = load(Path(arguments.file))
    with Interrupts() as interrupts, Base(asked, arguments.open, complain) as base:
        for name, member in asked.robots.items():
            say(f"{name}: {base.half(name).where()}")
            say(f"{name}: starting {', '.join(base.half(name).names)} for {member.robot}")
        say(f"Ctrl-C stops them; page of all robots: {asked.page.url}")
        while not interrupts.asked():
            if problem := base.beat(0.2):
                complain(f"sextant fleet: {problem}")
                return FAILED
        base.stop(interrupts.insisted)
    return INTERRUPTED
