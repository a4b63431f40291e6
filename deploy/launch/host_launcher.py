"""Router and processes of one machine, and the handshake with the other machine."""

import contextlib
import os
import socket
import time
from collections.abc import Callable, Mapping, Sequence
from types import TracebackType
from typing import Self

from sextant.deploy.launch import process_table
from sextant.deploy.launch.launcher import STAYED_UP_S, Ended, Launcher
from sextant.deploy.launch.peer_handshake import PeerHandshake
from sextant.deploy.launch.process_table import Choices, Process, Role
from sextant.deploy.security.router_security import Gate
from sextant.evaluation.provenance import version
from sextant.shared.wire.endpoint import for_clients, occupied
from sextant.shared.wire.ports import port_taken
from sextant.shared.wire.transport import Endpoints, Router, TransportError, ZenohLink

_NEEDED = ("router", "actuator", "simulator")  # the other processes are useless without these
_LOOK_S = 0.05  # [s] interval of looking for other machines before anything is started


class HostLauncher:
    """The processes of one machine, from entering to leaving; a context manager.

    Its methods belong to one thread.
    """

    def __init__(
        self,
        role: Role,
        rows: Sequence[Process],
        chosen: Choices,
        extra: Mapping[str, tuple[str, ...]],
        gated: Gate,
        say: Callable[[str], object],
    ):
        """Prepare the processes; nothing is started yet.

        Args:
            role: Role of this machine.
            rows: The processes that run here.
            chosen: Their settings.
            extra: Process name -> further settings.
            gated: Endpoints of the router, the routers it is chained to, and its access rules.
            say: Receives the output of the processes and the changes of connected machines, from several threads.
        """
        self.names = [row.name for row in rows]
        self._role, self._gated, self._say = role, gated, say
        endpoints = Endpoints((gated.own,), namespace=gated.namespace)
        self._endpoints = endpoints
        off = role == "offboard"
        self._certificate_role = gated.role(off)
        self.commands = process_table.commands(rows, chosen, endpoints, extra, off, self._certificate_role)
        self._router: Launcher | None = None
        self._launcher: Launcher | None = None  # launcher of the processes; None until the other machines are connected
        self._began_s = time.monotonic()  # when they were started
        self._held = contextlib.ExitStack()

    def __enter__(self) -> Self:
        with contextlib.ExitStack() as stack:
            self._router = _host(self._gated, stack, self._pass_on)
            link = stack.enter_context(ZenohLink(self._endpoints))
            machine = f"{socket.gethostname()}-{os.getpid()}"
            about = machine, self._role, version(), self.names
            self._meeting = PeerHandshake(link, *about, time.monotonic_ns, self._say, self._certificate_role)
            if not self._gated.upstream:  # others connect to this machine, once its router is up
                self._launcher = stack.enter_context(Launcher(self.commands, hear=self._pass_on))
            self._held = stack.pop_all()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._held.__exit__(kind, error, trace)

    def where(self) -> str:
        """Return as text where the processes connect, and how clients join."""
        gated = self._gated
        chained = f", connected to {', '.join(gated.upstream)}" if gated.upstream else ""
        joined = f"--connect {for_clients(gated.listen[-1])} --namespace {gated.namespace}{' --keys DIR' if gated.keys else ''}"
        return f"router on {', '.join(gated.listen)}{chained}; other programs connect with {joined}"

    @property
    def has_started(self) -> bool:
        """Whether the processes have been started; a chained machine waits for the others first."""
        return self._launcher is not None

    def pid(self, name: str) -> int:
        """Return the process id of a child, the newest one after a restart.

        Raises:
            KeyError: It has not been started yet.
        """
        if self._launcher is None:
            raise KeyError(name)
        return self._launcher.pid(name)

    def beat(self, wait_s: float) -> str:
        """Do what is due, and wait up to `wait_s` [s] for a process to end.

        On a chained machine, messages of other machines can delay or refuse the start of processes, but they never end a
        running one. A process that fails after it has stayed up does not end the others either: the actuator and the estop
        process go on.

        Returns:
            Why this machine's processes have to end, or an empty string.
        """
        self._meeting.beat()
        if self._launcher is None:
            self._began_s = time.monotonic()
            if refused := self._meeting.start_refusal:
                return refused
            if self._meeting.met:
                self._launcher = self._held.enter_context(Launcher(self.commands, hear=self._pass_on))
            else:
                time.sleep(min(wait_s, _LOOK_S))
        children = [launcher for launcher in (self._launcher, self._router) if launcher is not None]
        waits = [wait_s if launcher is self._launcher else 0.0 for launcher in children]
        for ended in [ended for launcher, wait in zip(children, waits, strict=True) for ended in launcher.wait(wait)]:
            self._say(str(ended))
            if not ended.restarted:
                if ended.name in _NEEDED or time.monotonic() - self._began_s < STAYED_UP_S:
                    return _ended_for_good(ended)
                self._say(f"{ended.name} keeps failing and is left out; the other processes continue")
        return ""

    def stop(self, insisted: Callable[[], bool]) -> None:
        """End the processes; kill them at once when `insisted` returns True."""
        for name in [] if self._launcher is None else self._launcher.stop(insisted):
            self._say(f"{name} did not end on request and was killed")

    def _pass_on(self, _name: str, line: str) -> None:
        self._say(line)


def _ended_for_good(ended: Ended) -> str:
    if ended.how == "exit status 2":  # wrong input, which it has explained
        return f"{ended.name} does not start with this input, see above; stopping all processes"
    return f"{ended.name} keeps failing; stopping all processes; `sextant doctor` checks what they need"


def _host(gated: Gate, stack: contextlib.ExitStack, hear: Callable[[str, str], None]) -> Launcher | None:
    """Host the router, in this process or, where it checks access, in a separate one.

    A separate router logs which clients it admits and refuses.

    Raises:
        TransportError: It did not come up.
    """
    if not gated.guarded:
        stack.enter_context(Router(gated.listen, gated.upstream))
        return None
    if taken := [*filter(None, map(occupied, gated.listen))]:
        raise TransportError("; ".join(taken))
    launcher = stack.enter_context(Launcher((process_table.router_command(gated.own, gated.words()),), hear=hear))
    while not port_taken(int(gated.own.rpartition(":")[2])):
        for ended in launcher.wait(0.05):
            if not ended.restarted:
                raise TransportError(f"the router did not start: {ended}")
    return launcher
