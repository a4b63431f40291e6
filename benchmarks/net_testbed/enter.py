"""Run a command in the network of a process.

python -m benchmarks.net_testbed.enter PID COMMAND [ARGUMENT ...] [--parent PID]

PID 0 is the current network, for systems without namespaces. A launcher appends --parent: the command ends when that process
has ended.
"""

import os
import sys

from benchmarks.net_testbed.namespace import enter
from sextant.shared.runtime.shutdown import end_with


def main() -> int:
    """Enter the network, and replace this process by the command."""
    if len(sys.argv) < 3 or not sys.argv[1].isdigit():
        sys.stderr.write(f"a process id and a command expected, found {sys.argv[1:]}\n")
        return 2
    words = sys.argv[2:]
    try:
        if len(words) > 2 and words[-2] == "--parent":
            end_with(int(words[-1]))  # remains in effect for the command
            del words[-2:]
        if process := int(sys.argv[1]):
            enter(process)
        os.execvp(words[0], words)
    except OSError as error:
        sys.stderr.write(f"{error}\n")
    return 1


if __name__ == "__main__":
    sys.exit(main())
