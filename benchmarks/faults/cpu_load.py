"""A process that keeps a core busy: python -m benchmarks.faults.cpu_load."""

import argparse
import os

from sextant.deploy.launch.process_table import ENVIRONMENT, Command
from sextant.shared.runtime.shutdown import end_with


def commands() -> tuple[Command, ...]:
    """Return one command for each core that this process may use."""
    count = len(os.sched_getaffinity(0))
    return tuple(Command(f"hog {i}", ("-m", "benchmarks.faults.cpu_load"), ENVIRONMENT) for i in range(count))


def main() -> None:
    """Compute until the process is terminated."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.faults.cpu_load", description=__doc__)
    parser.add_argument("--parent", type=int, help="id of the parent process; this process ends with it")
    arguments = parser.parse_args()
    if arguments.parent:
        end_with(arguments.parent)
    while True:
        pass


if __name__ == "__main__":
    main()
