"""Command line of Sextant: the commands, where old ones have gone, and the exit status.

Every failure states its cause and what to do next.

Exit status: 0 on success only, 1 for a failed run, 2 for invalid input, 130 when the operator interrupts it.
Modules that take long to import are imported by the command that needs them.
"""

import importlib.util
import subprocess
import sys
from collections.abc import Sequence

import click

from sextant.deploy.commands.camera import camera
from sextant.deploy.commands.common import InputError, complain, say
from sextant.deploy.commands.drive import drive
from sextant.deploy.commands.facts import doctor
from sextant.deploy.commands.figures import figures
from sextant.deploy.commands.fleet import fleet
from sextant.deploy.commands.keys import keys
from sextant.deploy.commands.order import order
from sextant.deploy.commands.plan import plan
from sextant.deploy.commands.recordings import record, recording
from sextant.deploy.commands.robot import robot
from sextant.deploy.commands.service import service
from sextant.deploy.commands.servos import servos
from sextant.deploy.commands.topics import topics
from sextant.deploy.commands.trials import table, trials
from sextant.deploy.commands.up import up
from sextant.deploy.commands.video import video
from sextant.deploy.commands.walks import demo, run
from sextant.deploy.terminal.arguments import Command, Group, command
from sextant.deploy.terminal.run_command import run_command
from sextant.evaluation.provenance import version

# Commands that have moved, and their new words; the old ones work in this release, with a hint.
_MOVED = {
    "info": ("recording", "info"),
    "recover": ("recording", "recover"),
    "export": ("recording", "export"),
    "replay": ("recording", "replay"),
    "foxglove": ("topics", "foxglove"),
    "ros2": ("topics", "ros2"),
    "compose": ("service", "compose"),
    "plot": ("figures", "run"),
}
_TO_BENCHMARKS = {"bench": (), "faults": ("faults",), "fuzz": ("fuzz",)}  # commands that have moved out of the package


class _Sextant(Group):
    """The commands, also under the words that they had before."""

    def resolve_command(self, ctx: click.Context, args: list[str]) -> tuple[str | None, click.Command | None, list[str]]:
        """Return the command that the words name, and the words after it."""
        if new := _MOVED.get(args[0]):
            complain(f"`sextant {args[0]}` is now `sextant {' '.join(new)}`")
            args = [*new, *args[1:]]
        if args[:2] == ["topics", "docs"]:
            raise InputError("`sextant topics docs` is now `python -m docs.reference`; run it in a checkout of Sextant")
        if args[:2] == ["trials", "table"]:  # a two-word command whose first word is also a command
            args = ["trials table", *args[2:]]
        return super().resolve_command(ctx, args)


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command and return its exit status."""
    return run_command(sextant, "sextant", sys.argv[1:] if argv is None else argv)


def _moved_to_benchmarks(name: str, new: tuple[str, ...]) -> Command:
    """Return a command that runs the benchmarks."""

    @command(name, hidden=True, add_help_option=False, context_settings={"ignore_unknown_options": True})
    @click.argument("words", nargs=-1, type=click.UNPROCESSED)
    def moved(words: tuple[str, ...]) -> int:
        """Run a command that has moved to the benchmarks."""
        moved = f"`sextant {name}` is now `python -m benchmarks`"
        if importlib.util.find_spec("benchmarks") is None:
            raise InputError(f"{moved}; run it in a checkout of Sextant, because the benchmarks are not installed")
        complain(moved)
        return subprocess.call([sys.executable, "-m", "benchmarks", *new, *words])

    return moved


def _print_version(context: click.Context, _: click.Parameter, asked: bool) -> None:
    if asked:
        say(f"sextant {version() or 'of an unknown version, because it is not installed'}")
        context.exit()


sextant = _Sextant("sextant", "Perception, planning and control of a six-legged robot on rubble, steps and gaps.")
click.option("--version", is_flag=True, is_eager=True, expose_value=False, callback=_print_version, help="print the version")(
    sextant
)
for _command in (
    *(demo, run, trials, table, up, fleet, order, drive, plan, record, video, figures),
    *(keys, recording, service, topics, robot, servos, camera, doctor),
    *(_moved_to_benchmarks(name, new) for name, new in _TO_BENCHMARKS.items()),
):
    sextant.add_command(_command)


if __name__ == "__main__":
    sys.exit(main())
