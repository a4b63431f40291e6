"""`sextant fleet`: the base station of several robots, until Ctrl-C."""

from pathlib import Path

from sextant.deploy.commands.common import INTERRUPTED, CommandError, complain, say
from sextant.deploy.terminal.arguments import argument, command, flag


@command()
@argument("file", "file with the robots and their endpoints, see docs/fleet.md", "FLEET.toml")
@flag("--open", "also connect to robots without certificates; repeats a warning while it runs", "unguarded")
def fleet(file: str, unguarded: bool) -> int:
    """Run the base station of several robots, with one common page, until Ctrl-C."""
    from sextant.deploy.launch.fleet import Base, load
    from sextant.deploy.terminal.interrupts import Interrupts

    asked = load(Path(file))
    with Interrupts() as interrupts, Base(asked, unguarded, complain) as base:
        for name, member in asked.robots.items():
            say(f"{name}: {base.half(name).where()}")
            say(f"{name}: starting {', '.join(base.half(name).names)} for {member.robot}")
        say(f"Ctrl-C stops them; page of all robots: {asked.page.url}")
        while not interrupts.asked():
            if problem := base.beat(0.2):
                raise CommandError(problem)
        base.stop(interrupts.insisted)
    return INTERRUPTED
