"""Two machines connected only by an emulated radio, as context managers."""

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

from benchmarks.net_testbed import orders
from benchmarks.net_testbed.namespace import NetTestbedError
from benchmarks.net_testbed.relay import ROBOT
from benchmarks.net_testbed.tcp_relay import HERE
from sextant.deploy.launch.process_table import ROUTER_ENDPOINT
from sextant.deploy.security.router_security import SECURE_ENDPOINT
from sextant.shared.scenario.scenario import Link
from sextant.shared.wire.ports import free_port

# Ports of the robot's router.
PORT, TLS_PORT = (int(endpoint.rpartition(":")[2]) for endpoint in (ROUTER_ENDPOINT, SECURE_ENDPOINT))
_PATIENCE_S = 20.0  # [s] timeout for the relay's answers


@dataclass(frozen=True, slots=True)
class Carried:
    """Traffic of the radio up to a time."""

    at_ns: int  # this computer's monotonic clock
    from_robot: int  # [bytes]
    packets_from_robot: int
    lost_from_robot: int  # packets
    to_robot: int  # [bytes]
    packets_to_robot: int
    lost_to_robot: int  # packets


class NetTestbed(abc.ABC):
    """The robot's machine, the base station, and the radio; a context manager."""

    robot_address: str  # the robot's address as seen from the base station
    robot_router: str  # endpoint of the robot's router on its machine
    base_router: str  # endpoint of the base station's router on its machine

    def __init__(self, link: Link, seed: int = 0):
        """Use a radio with a link's delay, rate and loss; `seed` determines the losses."""
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
        except NetTestbedError:
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
        with contextlib.suppress(OSError):  # the process has ended already
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
        """Description for a report."""

    @abc.abstractmethod
    def robot_words(self) -> tuple[str, ...]:
        """Return the options with which the robot accepts all clients on its network."""

    @abc.abstractmethod
    def base_words(self) -> tuple[str, ...]:
        """Return the options for the base station's endpoint.

        There are none if the default endpoint is free.
        """

    @abc.abstractmethod
    def seen(self, port: int) -> str:
        """Return HOST:PORT under which the base station reaches a port of the robot."""

    @abc.abstractmethod
    def on_robot(self, *command: str) -> list[str]:
        """Return the command line that runs a command on the robot's machine."""

    @abc.abstractmethod
    def on_base(self, *command: str) -> list[str]:
        """Return the command line that runs a command on the base station."""

    def cut(self) -> Carried:
        """Start an outage in both directions."""
        return self._ask(orders.CUT)

    def mend(self) -> Carried:
        """End the outage."""
        return self._ask(orders.MEND)

    def carried(self) -> Carried:
        """Return the traffic so far."""
        return self._ask(orders.ASK)

    @abc.abstractmethod
    def _command(self) -> tuple[str, ...]:
        """Return the Python arguments of the radio process."""

    @abc.abstractmethod
    def _begun(self, said: list[str]) -> None:
        """Process the first output line of the radio process."""

    def _ask(self, order: str) -> Carried:
        assert self._relay.stdin is not None
        with contextlib.suppress(OSError):  # if the process has ended, it does not answer
            self._relay.stdin.write(f"{order}\n")
        return Carried(*map(int, self._line("the radio between the machines has ended").split()))

    def _line(self, otherwise: str) -> str:
        """Return the next output line.

        Raises:
            NetTestbedError: There is none; the text is `otherwise` and the process's stderr.
        """
        assert self._relay.stdout is not None
        assert self._relay.stderr is not None
        ready, _, _ = select.select([self._relay.stdout], [], [], _PATIENCE_S)
        line = self._relay.stdout.readline() if ready else ""
        if not line:
            self._relay.kill()
            raise NetTestbedError(f"{otherwise}: {self._relay.stderr.read().strip() or 'no output of the relay'}")
        return str(line)


class Namespaces(NetTestbed):
    """Two network namespaces, connected by a packet relay."""

    robot_address = ROBOT
    robot_router = base_router = ROUTER_ENDPOINT

    @property
    def words(self) -> str:
        """Description for a report."""
        control = Path("/proc/sys/net/ipv4/tcp_congestion_control").read_text(encoding="ascii").strip()
        return f"two network namespaces, their packets carried by a relay; TCP with {control}"

    def robot_words(self) -> tuple[str, ...]:
        """Return the options with which the robot accepts all clients on its network."""
        return ("--listen", f"tcp/0.0.0.0:{PORT}")

    def base_words(self) -> tuple[str, ...]:
        """Return no options: the default endpoint is free."""
        return ()

    def seen(self, port: int) -> str:
        """Return HOST:PORT under which the base station reaches a port of the robot."""
        return f"{ROBOT}:{port}"

    def on_robot(self, *command: str) -> list[str]:
        """Return the command line that runs a command on the robot's machine."""
        return _entering(self._robot, command)

    def on_base(self, *command: str) -> list[str]:
        """Return the command line that runs a command on the base station."""
        return _entering(self._base, command)

    def _command(self) -> tuple[str, ...]:
        return ("-m", "benchmarks.net_testbed.relay")

    def _begun(self, said: list[str]) -> None:
        self._robot, self._base = said


class OneMachine(NetTestbed):
    """Both machines on this one, with a relay for their connections.

    It serves where namespaces are not available.
    """

    robot_address = HERE
    robot_router = ROUTER_ENDPOINT

    def __init__(self, link: Link, seed: int = 0, why: str = "", behind: tuple[int, ...] = (PORT, TLS_PORT)):
        """Prepare the relay.

        Args:
            link: Delay, rate and loss of the radio.
            seed: Random seed of the losses.
            why: Why there are no namespaces.
            behind: Ports of this machine that belong to the robot.
        """
        super().__init__(link, seed)
        self._why = f" ({why})" if why else ""
        self._behind = behind
        self.base_router = f"tcp/{HERE}:{free_port()}"

    @property
    def words(self) -> str:
        """Description for a report."""
        return f"one machine, the connections between the halves carried by a relay{self._why}"

    def robot_words(self) -> tuple[str, ...]:
        """Return the options with which the robot accepts all clients on its network."""
        return ("--listen", self.robot_router)

    def base_words(self) -> tuple[str, ...]:
        """Return the options for the base station's endpoint.

        It differs from the robot's.
        """
        return ("--listen", self.base_router)

    def seen(self, port: int) -> str:
        """Return HOST:PORT of the relay for a port of the robot."""
        return f"{HERE}:{self._ports[port]}"

    def on_robot(self, *command: str) -> list[str]:
        """Return the command line for the robot's machine, which is this one."""
        return _entering("0", command)

    def on_base(self, *command: str) -> list[str]:
        """Return the command line for the base station, which is this machine."""
        return _entering("0", command)

    def _command(self) -> tuple[str, ...]:
        return ("-m", "benchmarks.net_testbed.tcp_relay", *(word for port in self._behind for word in ("--to", str(port))))

    def _begun(self, said: list[str]) -> None:
        self._ports = dict(zip(self._behind, map(int, said), strict=True))


@contextlib.contextmanager
def two_machines(link: Link, seed: int = 0) -> Iterator[NetTestbed]:
    """Yield namespaces if available, otherwise one machine; `words` tells which."""
    with contextlib.ExitStack() as stack:
        try:
            bed: NetTestbed = stack.enter_context(Namespaces(link, seed))
        except NetTestbedError as error:
            bed = stack.enter_context(OneMachine(link, seed, str(error)))
        yield bed


def _entering(process: str, command: tuple[str, ...]) -> list[str]:
    return [sys.executable, "-m", "benchmarks.net_testbed.enter", process, *command]
