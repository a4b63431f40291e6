"""A simulated robot with mapper and planner on another machine.

Only the testbed's radio connects the two machines.
"""

import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Self

from benchmarks.net_testbed.listener import Heard
from benchmarks.net_testbed.testbed import PORT, TLS_PORT, NetTestbed
from sextant.deploy.launch.launcher import LAUNCHERS_GRACE_S, Launcher
from sextant.deploy.launch.process_table import ENVIRONMENT, Command

_CLI = ("-m", "sextant.deploy.cli")


class TwoMachines:
    """Processes of both machines, as started by the commands of docs/two_machines.md.

    This is a context manager.
    """

    def __init__(self, bed: NetTestbed, keys: Path | None, scenario: str, seed: int, namespace: str = "sextant"):
        """Prepare the commands.

        Args:
            bed: The two machines; entered by the caller.
            keys: Folder made by `sextant keys new` for the robot's address in the testbed; None accepts any client.
            scenario: Scenario by name or path.
            seed: Seed of the simulator.
            namespace: Prefix of every key.
        """
        self.said: list[str] = []
        self.heard: list[Heard] = []  # in order
        self._helpers: list[subprocess.Popen[str]] = []
        self._reader: threading.Thread | None = None
        self._bed = bed
        self.namespace = namespace
        common = ("--namespace", namespace, "--no-page")
        course = ("--scenario", scenario, "--seed", str(seed))
        if keys is None:
            near: tuple[str, ...] = (*bed.robot_words(), "--open")
            far: tuple[str, ...] = ("--connect", f"tcp/{bed.seen(PORT)}", "--open")
        else:
            near = ("--keys", str(keys / "robot"))
            far = ("--keys", str(keys / "base"), "--connect", f"tls/{bed.seen(TLS_PORT)}")
        # Commands of the robot and the base station, without further options.
        self.commands = (("up", "onboard", *near), ("up", "offboard", *far))
        robot, base = ((*self.commands[0], *course, *common), (*self.commands[1], *bed.base_words(), *common))
        halves = {"robot": bed.on_robot(*_python(*_CLI, *robot)), "base": bed.on_base(*_python(*_CLI, *base))}
        self._launcher = Launcher(
            [Command(name, tuple(words[1:]), ENVIRONMENT, restarts=0) for name, words in halves.items()],
            hear=self._hear,
            grace_s=LAUNCHERS_GRACE_S,
        )

    def __enter__(self) -> Self:
        self._launcher.__enter__()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        for helper in self._helpers:  # each ends when its input is closed
            assert helper.stdin is not None
            helper.stdin.close()
            helper.wait()
            if helper.stderr is not None:
                helper.stderr.close()
        if self._reader is not None:
            self._reader.join()
        self._launcher.__exit__(kind, error, trace)
        if error is not None:
            error.add_note("their output:\n" + "\n".join(self.said[-30:]))

    def meet(self, within_s: float) -> None:
        """Wait until both machines are connected, and the actuator's state is received.

        Raises:
            TimeoutError: This did not happen; the output is noted.
        """
        self.until(lambda: any("(onboard) has connected" in line for line in self.said), within_s, "base and robot to connect")
        words = _python("-m", "benchmarks.net_testbed.listener", self._bed.robot_router, self.namespace)
        ear = subprocess.Popen(self._bed.on_robot(*words), stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        self._helpers.append(ear)
        self._reader = threading.Thread(target=self._listen, args=(ear,), daemon=True)
        self._reader.start()
        self.until(lambda: bool(self.heard), within_s, "a message of the actuator")

    def lead(self, course: str) -> None:
        """Lead the robot along a course from the base station, until the block ends."""
        words = _python("-m", "benchmarks.net_testbed.leader", self._bed.base_router, self.namespace, course)
        leader = subprocess.Popen(self._bed.on_base(*words), stdin=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        self._helpers.append(leader)

    def until(self, holds: Callable[[], bool], within_s: float, what: str) -> None:
        """Wait for a condition.

        Raises:
            TimeoutError: It did not become true, or a process has ended.
        """
        until = time.monotonic() + within_s
        while not holds():
            if ended := self._ended(0.02):
                raise TimeoutError(f"{ended} while waiting for {what}")
            if time.monotonic() > until:
                raise TimeoutError(f"{what}: not within {within_s:g} s")

    def pass_time(self, seconds: float) -> None:
        """Wait for some time.

        Raises:
            TimeoutError: A process has ended.
        """
        until = time.monotonic() + seconds
        while (left := until - time.monotonic()) > 0.0:
            if ended := self._ended(min(left, 0.2)):
                raise TimeoutError(ended)

    @property
    def robot_router(self) -> str:
        """Endpoint of the robot's router on its machine."""
        return self._bed.robot_router

    def on_robot(self, *words: str) -> list[str]:
        """Return the command line of a `sextant` command on the robot's machine."""
        return self._bed.on_robot(*_python(*_CLI, *words))

    def _ended(self, within_s: float) -> str:
        """Return the processes that have ended unexpectedly within a time [s]."""
        if ended := self._launcher.wait(within_s):
            return str(ended[0])
        for helper in self._helpers:
            if helper.poll() is not None:
                why = helper.stderr.read().strip() if helper.stderr is not None else ""
                return f"{helper.args!r} ended, exit status {helper.returncode}: {why}"
        return ""

    def _hear(self, name: str, line: str) -> None:
        self.said.append(f"{name}: {line}")

    def _listen(self, ear: "subprocess.Popen[str]") -> None:
        assert ear.stdout is not None
        with ear.stdout:
            for line in ear.stdout:
                self.heard.append(Heard.of(line))


def _python(*words: str) -> tuple[str, ...]:
    return (sys.executable, *words)
