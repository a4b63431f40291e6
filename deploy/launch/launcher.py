"""Starts the processes of a run, watches them, and leaves none behind."""

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

from sextant.deploy.launch.ports import port_taken as port_taken
from sextant.deploy.launch.pulses import LOOK_S, Pulses, unwatched
from sextant.deploy.process_table import Command
from sextant.shared.wire.transport import Endpoints, Router, TransportError

GRACE_S = 1.0  # between SIGTERM and SIGKILL
LAUNCHERS_GRACE_S = 6.0  # likewise for launchers as children: they have children of their own to end, and a router to close
STAYED_UP_S = 60.0  # after which a process has stayed up, and all of its restarts are left again
_REAP_S = 0.5  # a killed process is gone after this
_READY_LOOK_S = 0.05  # between two looks at whether a process is ready
_TAIL = 200  # lines kept of what a process said
_FRAME = re.compile(r'  File ".*?(?P<file>[^/\\"]*)", line (?P<line>\d+) in (?P<function>.*)')  # of `faulthandler`
_FRAMES = 4  # of them that are told
_ROUTER_ATTEMPTS = 5
# Below the ports that the kernel gives to outgoing connections (32768 on), so that none of them is taken meanwhile.
_PORTS = range(20_000, 32_000)
_given: deque[int] = deque(maxlen=1000)  # the ports that this process has taken for free lately


def free_port() -> int:
    """A TCP port of 127.0.0.1 that nobody listens on now, another each time: many are asked for before one is opened."""
    chooser = random.SystemRandom()
    for _ in range(100):
        port = chooser.choice(_PORTS)
        if port not in _given and not port_taken(port):
            _given.append(port)
            return port
    raise TransportError(f"no free TCP port found in {_PORTS.start} to {_PORTS.stop} on 127.0.0.1; close what listens there")


@contextlib.contextmanager
def host_router() -> Iterator[Endpoints]:
    """Host a router in this process, on a loopback port and in a namespace of its own, so that parallel runs do not meet."""
    namespace = f"sextant-{os.getpid()}-{random.SystemRandom().randrange(1 << 32):08x}"
    for attempt in range(_ROUTER_ATTEMPTS):
        endpoint = f"tcp/127.0.0.1:{free_port()}"
        router = Router((endpoint,))
        try:
            router.__enter__()
        except TransportError:  # somebody took the port in between
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
    """A process that ended by itself."""

    name: str
    how: str  # in words: exit status or signal
    last_words: str  # what it said at the end
    restarted: bool  # whether it was started again

    def __str__(self) -> str:
        said = f"; its last words: {self.last_words}" if self.last_words else " without a word"
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
    hung: str = ""  # in words, where it was ended for that


class Launcher:
    """Children of this process, from entering to leaving; a context manager.

    One that has given a sign of life (`sextant.shared.runtime.watchdog`) and is silent for longer than its command allows ends.
    Start, poll and stop belong to one thread that outlives the children: Linux ends a child with the thread that made it.
    """

    def __init__(
        self,
        commands: Sequence[Command],
        hear: Callable[[str, str], None] = lambda _name, _line: None,
        grace_s: float = GRACE_S,
    ):
        """Prepare.

        Args:
            commands: What to start, in this order, each once what it names in `after` is ready.
            hear: Is told each line that a process says, with its name, from threads of the launcher.
            grace_s: [s] between asking them to end and killing them.
        """
        self._grace_s = grace_s
        self._commands = tuple(commands)
        self._hear = hear
        self._children: dict[str, _Child] = {}
        self._waiting: list[Command] = []  # for what must be ready before them
        self._stirred = threading.Event()  # a child may have ended
        self._pulses: Pulses | None = None  # of those that are watched

    def __enter__(self) -> Self:
        self._waiting = list(self._commands)
        if any(command.watchdog_s for command in self._commands):
            self._pulses = Pulses(time.monotonic())
        try:
            self._start_waiting()
        except OSError:
            self.stop()
            raise
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.stop()

    def names(self) -> tuple[str, ...]:
        """What runs or has run so far."""
        return tuple(self._children)

    def pid(self, name: str) -> int:
        """Process id of a child, the newest one after a restart."""
        return self._children[name].process.pid

    def poll(self) -> list[Ended]:
        """Children that ended since the last look; those with restarts left run again.

        Starts what waited for another to be ready, and kills what hangs.
        """
        self._start_waiting()
        self._end_hung()
        return [self._bury(child) for child in list(self._children.values()) if not child.reported and _over(child)]

    def wait(self, timeout_s: float) -> list[Ended]:
        """As `poll`, but waits for a child to end up to a time [s]."""
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
        """Wait until every child has been started, so that what it names in `after` is ready; whether that came in time."""
        until = time.monotonic() + timeout_s
        while self._waiting and time.monotonic() < until:
            self.wait(_READY_LOOK_S)
        return not self._waiting

    def kill(self, name: str) -> None:
        """End a child as a crash would, for a fault test; the restart policy applies."""
        _signal(self._children[name], signal.SIGKILL)

    def freeze(self, name: str) -> None:
        """Stop a child in its tracks, as a hang would."""
        _signal(self._children[name], signal.SIGSTOP)

    def thaw(self, name: str) -> None:
        """Let a frozen child go on."""
        _signal(self._children[name], signal.SIGCONT)

    def stop(self, insisted: Callable[[], bool] = lambda: False) -> list[str]:
        """End all children: ask, wait for as long as they are given, then kill.

        Args:
            insisted: Asked while waiting; True kills at once.

        Returns:
            Names of those that had to be killed.
        """
        self._waiting.clear()
        for child in self._children.values():
            child.reported = True
        until = time.monotonic() + self._grace_s
        # Who needs another goes first, so that nobody's last words are that the other has gone.
        needed = {name for child in self._children.values() for name in child.command.after}
        first = [child for name, child in self._children.items() if name not in needed]
        self._ask(first, [child for child in first if child.command.after], until - self._grace_s / 2, insisted)
        rest = [child for name, child in self._children.items() if name in needed]  # nobody is asked twice, which is to insist
        self._ask(rest, list(self._children.values()), until, insisted)
        killed = [name for name, child in self._children.items() if not _over(child)]
        for child in self._children.values():
            with contextlib.suppress(ProcessLookupError):  # also what the child itself has started
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
        """Ask some to end and wait for those that matter, at most until a time and no longer than the operator wants to."""
        for child in children:
            _signal(child, signal.SIGTERM)
            _signal(child, signal.SIGCONT)  # a frozen one could not hear
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
                # Aborted, it says in which function it is, unless it is frozen; by the next look it has to be gone.
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
            process_group=0,  # the terminal's Ctrl-C reaches the launcher alone
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
        again = restarts_left > 0 and status != 2  # 2: it was started wrongly, and would be again
        ended = Ended(child.command.name, child.hung or how_it_ended(status), last_words(list(child.tail)), again)
        child.reported = True
        if self._pulses:
            self._pulses.forget(child.process.pid)
        if again:
            self._children[child.command.name] = self._start(child.command, restarts_left - 1)
        return ended


def how_it_ended(status: int) -> str:
    """An exit status as `subprocess` gives it, in words."""
    if status >= 0:
        return f"exit status {status}"
    try:
        return f"killed by {signal.Signals(-status).name}"
    except ValueError:
        return f"killed by signal {-status}"


def last_words(lines: Sequence[str]) -> str:
    """What counts of a process's last lines: where it was aborted, the exception of a traceback, or else the last three."""
    said = [line for line in lines if line.strip()]
    frames = [match for line in said[_aborted(said) :] if (match := _FRAME.fullmatch(line))][:_FRAMES]
    if frames:
        return "it was in " + ", called by ".join(f"{frame['function']} ({frame['file']}:{frame['line']})" for frame in frames)
    starts = [i for i, line in enumerate(said) if line.startswith("Traceback (most recent call last)")]
    if starts:
        after = said[starts[-1] + 1 :]
        message = next((i for i, line in enumerate(after) if not line.startswith("  ")), len(after) - 1)
        return " ".join(line.strip() for line in after[message:][:8])
    return " / ".join(line.strip() for line in said[-3:])


def _aborted(said: Sequence[str]) -> int:
    """Index of the line from which `faulthandler` lists the calls of the aborted thread, or how many lines there are."""
    starts = [i for i, line in enumerate(said) if line.startswith("Current thread") and "most recent call first" in line]
    return starts[-1] if starts else len(said)


def _over(child: _Child) -> bool:
    return child.process.poll() is not None


def _signal(child: _Child, number: signal.Signals) -> None:
    if not _over(child):
        with contextlib.suppress(ProcessLookupError):
            os.killpg(child.process.pid, number)
