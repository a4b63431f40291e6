"""What a relay is told, and says: how its radio is by options, orders by lines of standard input, each answered by a line."""

import argparse
import sys
from collections.abc import Iterator, Sequence

from sextant.shared.scenario.scenario import Link

CUT, MEND, ASK = "cut", "mend", "what it carried"


def parser(module: str, what: str | None) -> argparse.ArgumentParser:
    """Options of a radio, for the module that is one."""
    made = argparse.ArgumentParser(prog=f"python -m {module}", description=what)
    made.add_argument("--delay-ms", type=float, default=0.0, help="one way")
    made.add_argument("--mbit", type=float, default=0.0, help="Mbit/s each way; 0: no limit")
    made.add_argument("--loss", type=float, default=0.0, help="share of the packets")
    made.add_argument("--seed", type=int, default=0, help="of what is lost")
    return made


def radio(arguments: argparse.Namespace) -> tuple[Link, int]:
    """The radio that the options describe, and the seed of what it loses."""
    return Link(arguments.delay_ms, arguments.mbit, arguments.loss), arguments.seed


def read(said: str) -> Iterator[str]:
    """The orders of some lines.

    Raises:
        ValueError: One is something else.
    """
    for line in said.splitlines():
        if line not in (CUT, MEND, ASK):
            raise ValueError(f"{CUT!r}, {MEND!r} or {ASK!r} expected, found {line!r}")
        yield line


def answer(now_ns: int, ways: Sequence[tuple[int, int, int]]) -> None:
    """Say what has been carried by a time [ns]: of each way bytes, packets, and packets lost."""
    say(" ".join(map(str, (now_ns, *(number for way in ways for number in way)))))


def say(line: str) -> None:
    """A line to whoever has started this process."""
    sys.stdout.write(line + "\n")
    sys.stdout.flush()
