"""Command line of the benchmarks: `python -m benchmarks COMMAND`, in a checkout."""

import sys
from collections.abc import Sequence

from benchmarks.commands.benches import benchmarks
from benchmarks.commands.faults import faults
from benchmarks.commands.fuzz import fuzz
from sextant.deploy.commands.common import SUCCESS, say
from sextant.deploy.reference import commands_page
from sextant.deploy.terminal.run_command import run_command

PROGRAM = "python -m benchmarks"

benchmarks.add_command(faults)
benchmarks.add_command(fuzz)


@benchmarks.command("docs")
def docs() -> int:
    """Print docs/benchmarks.md, a page with each benchmark."""
    say(commands_page.page(benchmarks, PROGRAM).rstrip("\n"))
    return SUCCESS


def main(argv: Sequence[str] | None = None) -> int:
    """Run a benchmark and return its exit status."""
    return run_command(benchmarks, PROGRAM, sys.argv[1:] if argv is None else argv)
