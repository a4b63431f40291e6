"""One machine's half of a robot: its router, its processes, and the word that it gives the other machine."""

import contextlib
import os
import socket
import time
from collections.abc import Callable, Mapping, Sequence
from types import TracebackType
from typing import Self

from sextant.deploy import process_table
from sextant.deploy.launch.launcher import STAYED_UP_S, Ended, Launcher, port_taken
from sextant.deploy.network.gate import Gate
from sextant.deploy.network.meeting import Meeting
from sextant.deploy.process_table import Choices, Process, Role
from sextant.deploy.provenance import version
from sextant.shared.wire.endpoint import occupied
from sextant.shared.wire.transport import Endpoints, Router, TransportError, ZenohLink

_NEEDED = ("router", "actuator", "simulator")  # without which the others are of no use
_LOOK_S = 0.05  # between two looks for other machines, before anything is started


class Half:
    """Runs from entering to leaving; a context manager, whose methods belong to one thread."""

    def __init__(
        self,
        role: Role,
        rows: Sequence[Process],
        chosen: Choices,
        extra: Mapping[str, tuple[str, ...]],
        gated: Gate,
        say: Callable[[str], object],
    ):
        """Prepare.

        Args:
            role: Of this machine.
            rows: The processes that run here.
            chosen: What they are told.
            extra: Process name -> further settings.
            gated: Where the router listens, to which it is chained, and whom it lets in.
            say: Is told what the processes say, and who comes and goes, from several threads.
        """
        self.names = [row.name for row in rows]
        self._role, self._gated, self._say = role, gated, say
        endpoints = Endpoints((gated.own,), namespace=gated.namespace)
        self._endpoints = endpoints
        off = role == "offboard"
        self._certificate_role = gated.role(off)
        self.commands = process_table.commands(rows, chosen, endpoints, extra, off, self._certificate_role)
        self._router: Launcher | None = None
        self._launcher: Launcher | None = None  # of the processes; none before other machines have been met
        self._began_s = time.monotonic()  # when they were started
        self._held = contextlib.ExitStack()

    def __enter__(self) -> Self:
        with contextlib.ExitStack() as stack:
            self._router = _host(self._gated, stack, self._pass_on)
            link = stack.enter_context(ZenohLink(self._endpoints))
            machine = f"{socket.gethostname()}-{os.getpid()}"
            about = machine, self._role, version(), self.names
            self._meeting = Meeting(link, *about, time.monotonic_ns, self._say, self._certificate_role)
            if not self._gated.upstream:  # others come to this machine, and not before its router is there
                self._launcher = stack.enter_context(Launcher(self.commands, hear=self._pass_on))
            self._held = stack.pop_all()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._held.__exit__(kind, error, trace)

    def where(self) -> str:
        """Where its processes meet, and how others join them, in words."""
        gated = self._gated
        chained = f", chained to {', '.join(gated.upstream)}" if gated.upstream else ""
        joined = f"--connect {gated.listen[-1]} --namespace {gated.namespace}{' --keys DIR' if gated.keys else ''}"
        return f"router on {', '.join(gated.listen)}{chained}; others join with {joined}"

    def pid(self, name: str) -> int:
        """Process id of a child, the newest one after a restart.

        Raises:
            KeyError: It has not been started yet.
        """
        if self._launcher is None:
            raise KeyError(name)
        return self._launcher.pid(name)

    def beat(self, wait_s: float) -> str:
        """Do what is due, and wait up to a time [s] for a process to end; why this half has to end, in words, or nothing.

        What other machines publish keeps processes from being started where they are chained to; it ends none that runs.
        Nor does a process that has stayed up for a while end the others when it fails: the actuator and its stop path go on.
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
                self._say(f"{ended.name} does not stay up and is left out; the others go on")
        return ""

    def stop(self, insisted: Callable[[], bool]) -> None:
        """End the processes; at once where that is insisted on."""
        for name in [] if self._launcher is None else self._launcher.stop(insisted):
            self._say(f"{name} did not end when asked and was killed")

    def _pass_on(self, _name: str, line: str) -> None:
        self._say(line)


def _ended_for_good(ended: Ended) -> str:
    return f"{ended.name} does not stay up; stopping the others; `sextant doctor` checks what a process needs"


def _host(gated: Gate, stack: contextlib.ExitStack, hear: Callable[[str, str], None]) -> Launcher | None:
    """Host the router: in this process, or where somebody may be refused in one of its own, which hears whom.

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
                raise TransportError(f"the router did not come up: {ended}")
    return launcher
