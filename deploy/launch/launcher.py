"""Launcher: starts the processes of a run, watches them, and ends all of them."""

import contextlib
import os
import random
import re
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from types import TracebackType
from typing import Self

from sextant.deploy.launch.process_table import Command
from sextant.deploy.launch.watchdog_listener import LOOK_S, WatchdogListener, is_supported, unwatched
from sextant.shared.wire.ports import free_port, port_taken
from sextant.shared.wire.transport import Endpoints, Router, TransportError

GRACE_S = 1.0  # [s] between SIGTERM and SIGKILL
LAUNCHERS_GRACE_S = 6.0  # [s] the same where the children are launchers, which end children and a router themselves
STAYED_UP_S = 60.0  # [s] after which a process counts as stable and has all of its restarts again
_REAP_S = 0.5  # [s] a killed process is gone after this
_READY_LOOK_S = 0.05  # [s] interval of the readiness check
_TAIL = 200  # output lines kept per process
_FRAME = re.compile(r'  File ".*?(?P<file>[^/\\"]*)", line (?P<line>\d+) in (?P<function>.*)')  # of `faulthandler`
_FRAMES = 4  # stack frames that are reported
_ROUTER_ATTEMPTS = 5


@contextlib.contextmanager
def host_router() -> Iterator[Endpoints]:
    """Host a router in this process, on a loopback port and in its own namespace.

    Parallel runs therefore do not meet.
    """
    namespace = f"sextant-{os.getpid()}-{random.SystemRandom().randrange(1 << 32):08x}"
    for attempt in range(_ROUTER_ATTEMPTS):
        endpoint = f"tcp/127.0.0.1:{free_port()}"
        router = Router((endpoint,))
        try:
            router.__enter__()
        except TransportError:  # another process took the port in the meantime
            if attempt == _ROUTER_ATTEMPTS - 1:
                raise
            continue
        try:
            yield Endpoints((endpoint,), namespace=namespace)
        finally:
            router.__exit__(None, None, None)
        return


@dataclass(frozen=True, slots=True)
class Ended:
    """A process that ended without a request."""

    name: str
    how: str  # exit status or signal, as text
    last_words: str  # its last output
    restarted: bool  # whether it was started again

    def __str__(self) -> str:
        said = f"; last output: {self.last_words}" if self.last_words else " without output"
        return f"{self.name} ended ({self.how}){said}{'; started again' if self.restarted else ''}"


@dataclass(slots=True)
class _Child:
    command: Command
    process: subprocess.Popen[str]
    tail: deque[str]
    reader: threading.Thread
    restarts_left: int
    began_s: float = field(default_factory=time.monotonic)
    reported: bool = False
    hung: str = ""  # as text, if it was ended because it hung


class Launcher:
    """Children of this process, from entering to leaving; a context manager.

    A child that has given a sign of life (`sextant.shared.runtime.watchdog`) is ended when it is silent for longer than its
    command allows. Start, poll and stop belong to one thread that outlives the children: Linux ends a child with the thread
    that made it.
    """

    def __init__(
        self,
        commands: Sequence[Command],
        hear: Callable[[str, str], object] = lambda _name, _line: None,
        grace_s: float = GRACE_S,
    ):
        """Prepare the launcher; nothing is started yet.

        Args:
            commands: Processes to start, in this order; each one starts once the processes in its `after` are ready.
            hear: Receives the name and each output line of a process, from threads of the launcher.
            grace_s: [s] between SIGTERM and SIGKILL.
        """
        self._grace_s = grace_s
        self._commands = tuple(commands)
        self._hear = hear
        self._children: dict[str, _Child] = {}
        self._waiting: list[Command] = []  # not started yet, because they wait for others to be ready
        self._stirred = threading.Event()  # a child may have ended
        self._pulses: WatchdogListener | None = None  # signs of life of the watched children

    def __enter__(self) -> Self:
        self._waiting = list(self._commands)
        if is_supported() and any(command.watchdog_s for command in self._commands):
            self._pulses = WatchdogListener(time.monotonic())
        try:
            self._start_waiting()
        except OSError:
            self.stop()
            raise
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.stop()

    def names(self) -> tuple[str, ...]:
        """Return the names of all processes that were started."""
        return tuple(self._children)

    def pid(self, name: str) -> int:
        """Return the process id of a child, the newest one after a restart."""
        return self._children[name].process.pid

    def poll(self) -> list[Ended]:
        """Return the children that ended since the last call, and restart those that may.

        Also start processes whose prerequisites are ready, and kill processes that hang.
        """
        self._start_waiting()
        self._end_hung()
        return [self._bury(child) for child in list(self._children.values()) if not child.reported and _over(child)]

    def wait(self, timeout_s: float) -> list[Ended]:
        """Poll, and wait up to `timeout_s` [s] for a child to end."""
        until = time.monotonic() + timeout_s
        while True:
            self._stirred.clear()
            ended = self.poll()
            remaining = until - time.monotonic()
            if ended or remaining <= 0:
                return ended
            look = _READY_LOOK_S if self._waiting else LOOK_S if self._pulses else remaining
            self._stirred.wait(min(remaining, look))

    def wait_for_start(self, timeout_s: float) -> bool:
        """Wait until every child has been started; return False at a timeout.

        A child is started once the processes in its `after` are ready.
        """
        until = time.monotonic() + timeout_s
        while self._waiting and time.monotonic() < until:
            self.wait(_READY_LOOK_S)
        return not self._waiting

    def kill(self, name: str) -> None:
        """Kill a child to simulate a crash; the restart policy applies."""
        _signal(self._children[name], signal.SIGKILL)

    def freeze(self, name: str) -> None:
        """Freeze a child (SIGSTOP), as if it hung."""
        _signal(self._children[name], signal.SIGSTOP)

    def thaw(self, name: str) -> None:
        """Continue a frozen child."""
        _signal(self._children[name], signal.SIGCONT)

    def stop(self, insisted: Callable[[], bool] = lambda: False) -> list[str]:
        """End all children: send SIGTERM, wait for the grace period, then kill.

        Args:
            insisted: Polled while waiting; True kills at once.

        Returns:
            Names of the children that had to be killed.
        """
        self._waiting.clear()
        for child in self._children.values():
            child.reported = True
        until = time.monotonic() + self._grace_s
        # Dependent processes end first, so that their last output is not an error about a lost dependency.
        needed = {name for child in self._children.values() for name in child.command.after}
        first = [child for name, child in self._children.items() if name not in needed]
        self._ask(first, [child for child in first if child.command.after], until - self._grace_s / 2, insisted)
        rest = [child for name, child in self._children.items() if name in needed]  # one SIGTERM each: a second one insists
        self._ask(rest, list(self._children.values()), until, insisted)
        killed = [name for name, child in self._children.items() if not _over(child)]
        for child in self._children.values():
            with contextlib.suppress(ProcessLookupError):  # also processes that the child started
                os.killpg(child.process.pid, signal.SIGKILL)
        for child in self._children.values():
            with contextlib.suppress(subprocess.TimeoutExpired):
                child.process.wait(_REAP_S)
            child.reader.join(_REAP_S)
        self._children.clear()
        if self._pulses:
            self._pulses.close()
            self._pulses = None
        return killed

    def _ask(self, children: list[_Child], awaited: list[_Child], until: float, insisted: Callable[[], bool]) -> None:
        """Send SIGTERM to `children`; wait for `awaited` until a time or insisted."""
        for child in children:
            _signal(child, signal.SIGTERM)
            _signal(child, signal.SIGCONT)  # a frozen process handles no signal
        while any(not _over(child) for child in awaited) and time.monotonic() < until and not insisted():
            self._stirred.clear()
            self._stirred.wait(0.02)

    def _start_waiting(self) -> None:
        ready = {c.name for c in self._commands if c.name in self._children and (not c.ready_port or port_taken(c.ready_port))}
        for command in list(self._waiting):
            if ready.issuperset(command.after):
                self._waiting.remove(command)
                self._children[command.name] = self._start(command, command.restarts)
                if not command.ready_port:
                    ready.add(command.name)

    def _end_hung(self) -> None:
        if not self._pulses:
            return
        self._pulses.look(time.monotonic())
        for child in self._children.values():
            silent_s = self._pulses.silent_s(child.process.pid)
            if child.command.watchdog_s and silent_s >= child.command.watchdog_s and not _over(child):
                # An aborted process prints its stack, unless it is frozen; it is killed if it is still there at the next poll.
                _signal(child, signal.SIGKILL if child.hung else signal.SIGABRT)
                child.hung = child.hung or f"hung: no sign of life for {silent_s:.1f} s"

    def _start(self, command: Command, restarts_left: int) -> _Child:
        watched = self._pulses.environment(command.watchdog_s) if self._pulses and command.watchdog_s else {}
        process = subprocess.Popen(
            [sys.executable, *command.arguments, "--parent", str(os.getpid())],
            env={**unwatched(os.environ), **command.environment, **watched},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            encoding="utf-8",
            errors="replace",
            process_group=0,  # Ctrl-C at the terminal reaches the launcher only
        )
        if self._pulses:
            self._pulses.watch(process.pid)
        tail: deque[str] = deque(maxlen=_TAIL)

        def read() -> None:
            assert process.stdout is not None
            with process.stdout:
                for line in process.stdout:
                    tail.append(line.rstrip("\n"))
                    self._hear(command.name, tail[-1])
            process.wait()
            self._stirred.set()

        reader = threading.Thread(target=read, name=f"listen to {command.name}", daemon=True)
        reader.start()
        return _Child(command, process, tail, reader, restarts_left)

    def _bury(self, child: _Child) -> Ended:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(child.process.pid, signal.SIGKILL)
        child.reader.join(_REAP_S)
        status = child.process.returncode
        stayed_up = time.monotonic() - child.began_s >= STAYED_UP_S
        restarts_left = child.command.restarts if stayed_up else child.restarts_left
        again = restarts_left > 0 and status != 2  # 2 means a wrong invocation; a restart would fail again
        ended = Ended(child.command.name, child.hung or how_it_ended(status), last_words(list(child.tail)), again)
        child.reported = True
        if self._pulses:
            self._pulses.forget(child.process.pid)
        if again:
            self._children[child.command.name] = self._start(child.command, restarts_left - 1)
        return ended


def how_it_ended(status: int) -> str:
    """Describe an exit status of `subprocess` as text."""
    if status >= 0:
        return f"exit status {status}"
    try:
        return f"killed by {signal.Signals(-status).name}"
    except ValueError:
        return f"killed by signal {-status}"


def last_words(lines: Sequence[str]) -> str:
    """Return the relevant part of a process's last lines.

    It is the stack where the process was aborted, else the exception of a traceback, else the last three lines.
    """
    said = [line for line in lines if line.strip()]
    frames = [match for line in said[_aborted(said) :] if (match := _FRAME.fullmatch(line))][:_FRAMES]
    if frames:
        return "stopped in " + ", called by ".join(f"{frame['function']} ({frame['file']}:{frame['line']})" for frame in frames)
    starts = [i for i, line in enumerate(said) if line.startswith("Traceback (most recent call last)")]
    if starts:
        after = said[starts[-1] + 1 :]
        message = next((i for i, line in enumerate(after) if not line.startswith("  ")), len(after) - 1)
        return " ".join(line.strip() for line in after[message:][:8])
    return " / ".join(line.strip() for line in said[-3:])


def _aborted(said: Sequence[str]) -> int:
    """Return the index of the line where `faulthandler` lists the aborted thread.

    Without such a line it is the number of lines.
    """
    starts = [i for i, line in enumerate(said) if line.startswith("Current thread") and "most recent call first" in line]
    return starts[-1] if starts else len(said)


def _over(child: _Child) -> bool:
    return child.process.poll() is not None


def _signal(child: _Child, number: signal.Signals) -> None:
    if not _over(child):
        with contextlib.suppress(ProcessLookupError):
            os.killpg(child.process.pid, number)
