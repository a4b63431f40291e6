"""Runs a command in the network of a process: `python -m deploy.bed.enter PID COMMAND [ARGUMENT ...]`."""

import os
import sys

from deploy.bed.namespace import enter


def main() -> int:
    """Go there and become the command."""
    if len(sys.argv) < 3 or not sys.argv[1].isdigit():
        sys.stderr.write(f"a process id and a command expected, found {sys.argv[1:]}\n")
        return 2
    try:
        enter(int(sys.argv[1]))
        os.execvp(sys.argv[2], sys.argv[2:])
    except OSError as error:
        sys.stderr.write(f"{error}\n")
    return 1


if __name__ == "__main__":
    sys.exit(main())
