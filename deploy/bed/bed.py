"""Two machines that only a radio joins, for as long as a block runs."""

import contextlib
import select
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Self

from deploy.bed.namespace import BedError
from deploy.bed.relay import BASE, ROBOT
from shared.scenario import Link

_PATIENCE_S = 20.0  # for the relay's answers
_MODULE = "deploy.bed.relay"


@dataclass(frozen=True, slots=True)
class Carried:
    """What the radio has carried so far, by a time."""

    at_ns: int  # of this computer's monotonic clock
    from_robot: int  # [bytes]
    packets_from_robot: int
    lost_from_robot: int  # packets
    to_robot: int  # [bytes]
    packets_to_robot: int
    lost_to_robot: int  # packets


class Bed:
    """Two network namespaces, the robot's and the base's, and the radio between them; a context manager."""

    robot_address, base_address = ROBOT, BASE

    @staticmethod
    def words() -> str:
        """What it is, for a report."""
        control = Path("/proc/sys/net/ipv4/tcp_congestion_control").read_text(encoding="ascii").strip()
        return f"two network namespaces, their packets carried by a relay; TCP with {control}"

    def __init__(self, link: Link, seed: int = 0):
        """With a radio of a link's delay, rate and loss; `seed` of what is lost."""
        self._link = link
        self._seed = seed

    def __enter__(self) -> Self:
        link = self._link
        words = ("--delay-ms", link.delay_ms, "--mbit", link.mbit, "--loss", link.loss, "--seed", self._seed)
        command = [sys.executable, "-m", _MODULE, *map(str, words)]
        self._relay = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, bufsize=1
        )
        try:
            first = self._line("no two machines here")
        except BedError:
            self.__exit__()
            raise
        self._robot, self._base = first.split()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None = None,
        error: BaseException | None = None,
        trace: TracebackType | None = None,
    ) -> None:
        assert self._relay.stdin is not None
        with contextlib.suppress(OSError):  # it is gone already
            self._relay.stdin.close()
        try:
            self._relay.wait(_PATIENCE_S)
        except subprocess.TimeoutExpired:
            self._relay.kill()
            self._relay.wait()
        for pipe in (self._relay.stdout, self._relay.stderr):
            if pipe is not None:
                pipe.close()

    def on_robot(self, *command: str) -> list[str]:
        """A command as it runs on the robot's machine."""
        return [sys.executable, "-m", "deploy.bed.enter", self._robot, *command]

    def on_base(self, *command: str) -> list[str]:
        """A command as it runs on the base."""
        return [sys.executable, "-m", "deploy.bed.enter", self._base, *command]

    def cut(self) -> Carried:
        """Have nothing come through from now on, either way."""
        return self._ask("cut")

    def mend(self) -> Carried:
        """Have packets come through again."""
        return self._ask("mend")

    def carried(self) -> Carried:
        """What it has carried so far."""
        return self._ask("what it carried")

    def _ask(self, order: str) -> Carried:
        assert self._relay.stdin is not None
        with contextlib.suppress(OSError):  # of one that is gone, which its silence tells
            self._relay.stdin.write(f"{order}\n")
        return Carried(*map(int, self._line("the radio between the machines is gone").split()))

    def _line(self, otherwise: str) -> str:
        """What it says.

        Raises:
            BedError: Nothing: `otherwise`, and its own words.
        """
        assert self._relay.stdout is not None
        assert self._relay.stderr is not None
        ready, _, _ = select.select([self._relay.stdout], [], [], _PATIENCE_S)
        line = self._relay.stdout.readline() if ready else ""
        if not line:
            self._relay.kill()
            raise BedError(f"{otherwise}: {self._relay.stderr.read().strip() or 'the relay said nothing'}")
        return str(line)
