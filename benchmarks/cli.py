"""Command line of the benchmarks: `python -m benchmarks COMMAND`, in a checkout."""

import sys
from collections.abc import Sequence

from benchmarks.commands.benches import benchmarks
from benchmarks.commands.campaign import campaign
from benchmarks.commands.faults import faults
from benchmarks.commands.fuzz import fuzz
from sextant.deploy.terminal.run_command import run_command

__all__ = ["PROGRAM", "benchmarks", "main"]

PROGRAM = "python -m benchmarks"

benchmarks.add_command(campaign)
benchmarks.add_command(faults)
benchmarks.add_command(fuzz)


def main(argv: Sequence[str] | None = None) -> int:
    """Run a benchmark and return its exit status."""
    return run_command(benchmarks, PROGRAM, sys.argv[1:] if argv is None else argv)
