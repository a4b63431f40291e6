"""Protocol of a relay process.

Options describe the radio. Commands are lines on standard input; each is answered by a line.
"""

import argparse
import sys
from collections.abc import Iterator, Sequence

from sextant.shared.scenario.scenario import Link

CUT, MEND, ASK = "cut", "mend", "what it carried"


def parser(module: str, what: str | None) -> argparse.ArgumentParser:
    """Return an argument parser with the options of a radio."""
    made = argparse.ArgumentParser(prog=f"python -m {module}", description=what)
    made.add_argument("--delay-ms", type=float, default=0.0, help="one-way delay")
    made.add_argument("--mbit", type=float, default=0.0, help="bandwidth each way [Mbit/s]; 0: no limit")
    made.add_argument("--loss", type=float, default=0.0, help="share of lost packets")
    made.add_argument("--seed", type=int, default=0, help="random seed of the losses")
    return made


def radio(arguments: argparse.Namespace) -> tuple[Link, int]:
    """Return the radio described by the options, and the random seed of its losses."""
    return Link(arguments.delay_ms, arguments.mbit, arguments.loss), arguments.seed


def read(said: str) -> Iterator[str]:
    """Yield the commands in some lines.

    Raises:
        ValueError: A line is not a command.
    """
    for line in said.splitlines():
        if line not in (CUT, MEND, ASK):
            raise ValueError(f"{CUT!r}, {MEND!r} or {ASK!r} expected, found {line!r}")
        yield line


def answer(now_ns: int, ways: Sequence[tuple[int, int, int]]) -> None:
    """Print the traffic up to a time [ns].

    For each way: bytes, packets, and lost packets.
    """
    say(" ".join(map(str, (now_ns, *(number for way in ways for number in way)))))


def say(line: str) -> None:
    """Print a line for the parent process."""
    sys.stdout.write(line + "\n")
    sys.stdout.flush()
