"""Run the command line as its user does, and find all its descendants."""

import contextlib
import os
import re
import signal
import subprocess
import sys
import threading
import time
import uuid
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Self

import pytest

from sextant.shared.runtime.service import AnyTopic
from sextant.shared.wire import codec, topics
from sextant.shared.wire.messages import ActuatorState, Mode, PlannerStatus
from sextant.shared.wire.ports import port_taken
from sextant.shared.wire.transport import Endpoints, ZenohLink
from tests.support.idle import is_giving_way, weigh_little

ROOT = Path(__file__).parents[2]
PATIENCE_S = 180.0  # for anything that may take long on a busy machine
_LOOK_S = 0.02
_MARK = "SEXTANT_TEST_MARK"


def eventually(
    holds: Callable[[], object], what: str, within_s: float = PATIENCE_S, alive: Callable[[], bool] | None = None
) -> None:
    """Wait for a condition; `alive` tells whether it can still become true."""
    until, never = time.monotonic() + within_s, threading.Event()
    while not holds():
        assert alive is None or alive() or holds(), f"ended while waiting for {what}"
        assert time.monotonic() < until, f"{what}: not within {within_s:g} s"
        never.wait(_LOOK_S)


@dataclass(frozen=True)
class Process:
    """One process of those that a command started."""

    pid: int
    words: tuple[str, ...]  # its command line

    def value(self, option: str) -> str:
        """Return the word that follows an option."""
        return self.words[self.words.index(option) + 1]


class Command:
    """`python -m MODULE WORDS` in a separate process group; the module is that of `sextant` by default.

    A shell starts commands in the same way. This class is a context manager.
    """

    def __init__(self, *words: str, cwd: Path, module: str = "sextant.deploy.cli"):
        self.said: list[str] = []  # lines of stdout and stderr
        self._words = "-m", module, *words
        self._cwd = cwd
        self._mark = uuid.uuid4().hex  # inherited by all descendants, also after their parent has changed

    def __enter__(self) -> Self:
        self.process = subprocess.Popen(
            [sys.executable, *self._words],
            cwd=self._cwd,
            env={**os.environ, **environment(), _MARK: self._mark},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,
        )
        if is_giving_way():
            weigh_little(self.process.pid)
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        for found in self.family():
            with contextlib.suppress(ProcessLookupError):
                os.kill(found.pid, signal.SIGKILL)
        self.process.kill()
        self.process.wait()
        self._reader.join()
        if error is not None:
            error.add_note("it said:\n" + "\n".join(self.said[-30:]))

    def status(self, within_s: float = PATIENCE_S) -> int:
        """Return its exit status after all its output is read."""
        status = self.process.wait(within_s)
        self._reader.join(within_s)
        return status

    def text(self) -> str:
        """Return all its output so far."""
        return "\n".join(self.said)

    def running(self) -> bool:
        return self.process.poll() is None

    def interrupt(self) -> None:
        """Send SIGINT to the foreground process group, as a terminal does on Ctrl-C."""
        os.killpg(self.process.pid, signal.SIGINT)

    def family(self) -> list[Process]:
        """Return the process and all its descendants, except zombies.

        A descendant counts even if its parent has changed.
        """
        mark = f"{_MARK}={self._mark}".encode()
        return [Process(pid, words) for pid, words, around in _processes() if mark in around]

    def service(self, name: str) -> Process | None:
        """Return the running process of a service."""
        return next((found for found in self.family() if f"sextant.services.{name}" in found.words), None)

    def endpoints(self) -> Endpoints:
        """Return the endpoints of its services after they have started."""
        self.wait_for(lambda: self.service("actuator"), "the actuator's process")
        found = self.service("actuator")
        assert found is not None
        return Endpoints((found.value("--connect"),), namespace=found.value("--namespace"))

    def wait_for(self, holds: Callable[[], object], what: str) -> None:
        """Wait for a condition while the command runs."""
        eventually(holds, what, alive=self.running)

    def gone(self, within_s: float = PATIENCE_S) -> None:
        """Wait until no process of it is left."""
        try:
            eventually(lambda: not self.family(), "no orphan", within_s)
        except AssertionError as error:
            error.add_note("\n".join(["left behind:", *map(str, self.family())]))
            raise

    def _read(self) -> None:
        assert self.process.stdout is not None
        with self.process.stdout:
            self.said.extend(line.rstrip("\n") for line in self.process.stdout)


class Ear:
    """A listener for the messages of a run."""

    def __init__(self) -> None:
        self.mode: Mode | None = None
        self.lease: str | None = None
        self.reasons: set[str] = set()
        self.steps: list[int] = []  # numbers of the steps, in the order of arrival
        self.places: list[tuple[float, float]] = []  # [m] {odom} positions of the body in those steps

    @classmethod
    @contextlib.contextmanager
    def at(cls, endpoints: Endpoints) -> Iterator[Self]:
        """Listen while the block runs."""
        ear = cls()
        with ZenohLink(endpoints) as link:
            for topic in (topics.ACTUATOR_STATE, topics.PLANNER_STATUS):
                link.subscribe(topic, ear.hear)
            yield ear

    def hear(self, topic: AnyTopic, frame: bytes) -> None:
        try:
            message = codec.decode(frame, topic.type)[0]
        except codec.DecodeError:
            return  # after a reconnection Zenoh may deliver a frame under another frame's key; services reject it
        match message:
            case ActuatorState():
                self.mode, self.lease = message.mode, message.lease
                self.reasons.add(message.reason)
                if message.mode is Mode.WALK:
                    self.places.append((message.T_odom_body[0, 3], message.T_odom_body[1, 3]))
                if message.mode is Mode.WALK and self.steps[-1:] != [message.step]:
                    self.steps.append(message.step)
            case PlannerStatus():
                self.reasons.add(message.reason)

    def forget(self) -> None:
        """Clear the mode, the steps and the places."""
        self.mode, self.steps, self.places = None, [], []

    def walked(self, steps: int) -> bool:
        """Return whether it walks and has walked more than this number of steps."""
        return self.mode is Mode.WALK and len(self.steps) > steps


def environment() -> dict[str, str]:
    """Return the environment with which a process finds the program from any folder."""
    return {"PYTHONPATH": os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))}


def skip_where_taken(*ports: int) -> None:
    """Skip a test of commands if another process uses one of their ports of 127.0.0.1."""
    for port in ports:
        if port_taken(port):
            pytest.skip(f"port {port} of 127.0.0.1, which these commands use, is taken; end what listens there")


def write_course(folder: Path, name: str, distance: float) -> Path:
    """Write a scenario file as a user might write one: level ground."""
    path = folder / f"{name}.toml"
    text = f'name = "{name}"\ntime_limit_s = 120.0\n[goal]\ndistance = {distance}\n[[terrain]]\nkind = "plane"\n'
    path.write_text(text, encoding="utf-8")
    return path


def _processes() -> Iterator[tuple[int, tuple[str, ...], tuple[bytes, ...]]]:
    """Yield the ID, command line and environment of this user's processes.

    Zombies are omitted.
    """
    for entry in Path("/proc").iterdir():
        if not entry.name.isdigit():
            continue
        try:
            state = re.sub(r"\(.*\)", "", (entry / "stat").read_text()).split()[1]
            words = (entry / "cmdline").read_bytes()
            around = (entry / "environ").read_bytes()
        except OSError:  # another user's process, or one that has ended meanwhile
            continue
        if state not in "ZX":
            yield int(entry.name), tuple(os.fsdecode(word) for word in words.split(b"\0")[:-1]), tuple(around.split(b"\0"))
