"""The command line as its user starts it, and everything that descends from it, alive or left behind."""

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

from sextant.deploy.launch.ports import port_taken
from sextant.shared.runtime.service import AnyTopic
from sextant.shared.wire import codec, topics
from sextant.shared.wire.messages import ActuatorState, Mode, PlannerStatus
from sextant.shared.wire.transport import Endpoints, ZenohLink
from tests.support.idle import is_giving_way, weigh_little

ROOT = Path(__file__).parents[2]
PATIENCE_S = 180.0  # for whatever a busy machine may take long to do
_LOOK_S = 0.02
_MARK = "SEXTANT_TEST_MARK"


def eventually(
    holds: Callable[[], object], what: str, within_s: float = PATIENCE_S, alive: Callable[[], bool] | None = None
) -> None:
    """Wait for a condition; `alive` says whether it can still come."""
    until, never = time.monotonic() + within_s, threading.Event()
    while not holds():
        assert alive is None or alive() or holds(), f"ended while waiting for {what}"
        assert time.monotonic() < until, f"{what}: not within {within_s:g} s"
        never.wait(_LOOK_S)


@dataclass(frozen=True)
class Process:
    """One process of the family."""

    pid: int
    words: tuple[str, ...]  # its command line

    def value(self, option: str) -> str:
        """What follows an option."""
        return self.words[self.words.index(option) + 1]


class Command:
    """`python -m sextant.deploy.cli WORDS` in a process group of its own, as a shell starts it; a context manager."""

    def __init__(self, *words: str, cwd: Path):
        self.said: list[str] = []  # lines of stdout and stderr
        self._words = words
        self._cwd = cwd
        self._mark = uuid.uuid4().hex  # inherited by all descendants, whoever their parent is by then

    def __enter__(self) -> Self:
        self.process = subprocess.Popen(
            [sys.executable, "-m", "sextant.deploy.cli", *self._words],
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
        """Its exit status, once all that it said is read."""
        status = self.process.wait(within_s)
        self._reader.join(within_s)
        return status

    def text(self) -> str:
        """All that it said so far."""
        return "\n".join(self.said)

    def running(self) -> bool:
        return self.process.poll() is None

    def interrupt(self) -> None:
        """Ctrl-C: the terminal signals the whole foreground group."""
        os.killpg(self.process.pid, signal.SIGINT)

    def family(self) -> list[Process]:
        """The processes that descend from it, itself among them, wherever they hang by now; zombies do not count."""
        mark = f"{_MARK}={self._mark}".encode()
        return [Process(pid, words) for pid, words, around in _processes() if mark in around]

    def service(self, name: str) -> Process | None:
        """The running process of a service."""
        return next((found for found in self.family() if f"sextant.services.{name}" in found.words), None)

    def endpoints(self) -> Endpoints:
        """Where its services meet, once they run."""
        self.wait_for(lambda: self.service("actuator"), "the actuator's process")
        found = self.service("actuator")
        assert found is not None
        return Endpoints((found.value("--connect"),), namespace=found.value("--namespace"))

    def wait_for(self, holds: Callable[[], object], what: str) -> None:
        """Wait for a condition while it runs."""
        eventually(holds, what, alive=self.running)

    def gone(self, within_s: float = PATIENCE_S) -> None:
        """Wait until nothing of it is left."""
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
    """Hears what a run says on the wire."""

    def __init__(self) -> None:
        self.mode: Mode | None = None
        self.lease: str | None = None
        self.reasons: set[str] = set()
        self.steps: list[int] = []  # numbers of the steps walked, as they come
        self.places: list[tuple[float, float]] = []  # [m] {odom} of the body in those

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
            return  # where a connection is lost and made anew Zenoh may bring a frame under another's key; services refuse it
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
        """Begin counting anew."""
        self.mode, self.steps, self.places = None, [], []

    def walked(self, steps: int) -> bool:
        """Whether it walks, and has done so for some steps."""
        return self.mode is Mode.WALK and len(self.steps) > steps


def environment() -> dict[str, str]:
    """What a process needs to find the program from any folder."""
    return {"PYTHONPATH": os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))}


def skip_where_taken(*ports: int) -> None:
    """Skip a test of commands that use these ports of 127.0.0.1 where somebody else does."""
    for port in ports:
        if port_taken(port):
            pytest.skip(f"port {port} of 127.0.0.1, which these commands use, is taken; end what listens there")


def write_course(folder: Path, name: str, distance: float) -> Path:
    """A scenario file of somebody who writes his own: level ground."""
    path = folder / f"{name}.toml"
    text = f'name = "{name}"\ntime_limit_s = 120.0\n[goal]\ndistance = {distance}\n[[terrain]]\nkind = "plane"\n'
    path.write_text(text, encoding="utf-8")
    return path


def _processes() -> Iterator[tuple[int, tuple[str, ...], tuple[bytes, ...]]]:
    """Id, command line and environment of every process of this user that is not a zombie."""
    for entry in Path("/proc").iterdir():
        if not entry.name.isdigit():
            continue
        try:
            state = re.sub(r"\(.*\)", "", (entry / "stat").read_text()).split()[1]
            words = (entry / "cmdline").read_bytes()
            around = (entry / "environ").read_bytes()
        except OSError:  # somebody else's, or gone meanwhile
            continue
        if state not in "ZX":
            yield int(entry.name), tuple(os.fsdecode(word) for word in words.split(b"\0")[:-1]), tuple(around.split(b"\0"))
