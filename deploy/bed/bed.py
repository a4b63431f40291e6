"""Two machines that only a radio joins, for as long as a block runs."""

import abc
import contextlib
import select
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Self

from sextant.deploy.bed import orders
from sextant.deploy.bed.namespace import BedError
from sextant.deploy.bed.relay import ROBOT
from sextant.deploy.bed.tcp_relay import HERE
from sextant.deploy.launch.launcher import free_port
from sextant.deploy.network.gate import SECURE_ENDPOINT
from sextant.deploy.process_table import ROUTER_ENDPOINT
from sextant.shared.scenario.scenario import Link

PORT, TLS_PORT = (int(endpoint.rpartition(":")[2]) for endpoint in (ROUTER_ENDPOINT, SECURE_ENDPOINT))  # of the robot's router
_PATIENCE_S = 20.0  # for the relay's answers


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


class Bed(abc.ABC):
    """The robot's machine, the base, and the radio between them; a context manager."""

    robot_address: str  # by which the base knows the robot
    robot_router: str  # endpoint of the robot's router, on its machine
    base_router: str  # likewise

    def __init__(self, link: Link, seed: int = 0):
        """With a radio of a link's delay, rate and loss; `seed` of what is lost."""
        self._link = link
        self._seed = seed

    def __enter__(self) -> Self:
        link = self._link
        words = ("--delay-ms", link.delay_ms, "--mbit", link.mbit, "--loss", link.loss, "--seed", self._seed)
        command = [sys.executable, *self._command(), *map(str, words)]
        self._relay = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, bufsize=1
        )
        try:
            self._begun(self._line("no two machines here").split())
        except BedError:
            self.__exit__()
            raise
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

    @property
    @abc.abstractmethod
    def words(self) -> str:
        """What it is, for a report."""

    @abc.abstractmethod
    def robot_words(self) -> tuple[str, ...]:
        """Options by which the robot's half listens to everybody who reaches its machine."""

    @abc.abstractmethod
    def base_words(self) -> tuple[str, ...]:
        """Options by which the base's half listens elsewhere than usual, if it must."""

    @abc.abstractmethod
    def seen(self, port: int) -> str:
        """Where the base finds a port of the robot's, as HOST:PORT."""

    @abc.abstractmethod
    def on_robot(self, *command: str) -> list[str]:
        """A command as it runs on the robot's machine."""

    @abc.abstractmethod
    def on_base(self, *command: str) -> list[str]:
        """A command as it runs on the base."""

    def cut(self) -> Carried:
        """Have nothing come through from now on, either way."""
        return self._ask(orders.CUT)

    def mend(self) -> Carried:
        """Have packets come through again."""
        return self._ask(orders.MEND)

    def carried(self) -> Carried:
        """What it has carried so far."""
        return self._ask(orders.ASK)

    @abc.abstractmethod
    def _command(self) -> tuple[str, ...]:
        """Of the process that is the radio, as Python's arguments."""

    @abc.abstractmethod
    def _begun(self, said: list[str]) -> None:
        """Take in the first words of that process."""

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


class Namespaces(Bed):
    """Two network namespaces, whose packets a relay carries."""

    robot_address = ROBOT
    robot_router = base_router = ROUTER_ENDPOINT

    @property
    def words(self) -> str:
        """What it is, for a report."""
        control = Path("/proc/sys/net/ipv4/tcp_congestion_control").read_text(encoding="ascii").strip()
        return f"two network namespaces, their packets carried by a relay; TCP with {control}"

    def robot_words(self) -> tuple[str, ...]:
        """Options by which the robot's half listens to everybody who reaches its machine."""
        return ("--listen", f"tcp/0.0.0.0:{PORT}")

    def base_words(self) -> tuple[str, ...]:
        """None are needed."""
        return ()

    def seen(self, port: int) -> str:
        """Where the base finds a port of the robot's."""
        return f"{ROBOT}:{port}"

    def on_robot(self, *command: str) -> list[str]:
        """A command as it runs on the robot's machine."""
        return _entering(self._robot, command)

    def on_base(self, *command: str) -> list[str]:
        """A command as it runs on the base."""
        return _entering(self._base, command)

    def _command(self) -> tuple[str, ...]:
        return ("-m", "sextant.deploy.bed.relay")

    def _begun(self, said: list[str]) -> None:
        self._robot, self._base = said


class OneMachine(Bed):
    """Both halves on this machine, and a relay of their connections between them: where namespaces cannot be had."""

    robot_address = HERE
    robot_router = ROUTER_ENDPOINT

    def __init__(self, link: Link, seed: int = 0, why: str = "", behind: tuple[int, ...] = (PORT, TLS_PORT)):
        """Prepare.

        Args:
            link: Delay, rate and loss of the radio.
            seed: Of what is lost.
            why: There are no namespaces, in words.
            behind: Ports of this machine that are the robot's.
        """
        super().__init__(link, seed)
        self._why = f" ({why})" if why else ""
        self._behind = behind
        self.base_router = f"tcp/{HERE}:{free_port()}"

    @property
    def words(self) -> str:
        """What it is, for a report."""
        return f"one machine, the connections between the halves carried by a relay{self._why}"

    def robot_words(self) -> tuple[str, ...]:
        """Options by which the robot's half listens to everybody who reaches its machine."""
        return ("--listen", self.robot_router)

    def base_words(self) -> tuple[str, ...]:
        """Options by which the base's half listens elsewhere than the robot's."""
        return ("--listen", self.base_router)

    def seen(self, port: int) -> str:
        """Where the base finds a port of the robot's: a port of the relay."""
        return f"{HERE}:{self._ports[port]}"

    def on_robot(self, *command: str) -> list[str]:
        """A command as it runs on the robot's machine, which is this one."""
        return _entering("0", command)

    def on_base(self, *command: str) -> list[str]:
        """A command as it runs on the base, which is this machine."""
        return _entering("0", command)

    def _command(self) -> tuple[str, ...]:
        return ("-m", "sextant.deploy.bed.tcp_relay", *(word for port in self._behind for word in ("--to", str(port))))

    def _begun(self, said: list[str]) -> None:
        self._ports = dict(zip(self._behind, map(int, said), strict=True))


@contextlib.contextmanager
def two_machines(link: Link, seed: int = 0) -> Iterator[Bed]:
    """Namespaces where they can be had; otherwise one machine, which its words tell."""
    with contextlib.ExitStack() as stack:
        try:
            bed: Bed = stack.enter_context(Namespaces(link, seed))
        except BedError as error:
            bed = stack.enter_context(OneMachine(link, seed, str(error)))
        yield bed


def _entering(process: str, command: tuple[str, ...]) -> list[str]:
    return [sys.executable, "-m", "sextant.deploy.bed.enter", process, *command]
