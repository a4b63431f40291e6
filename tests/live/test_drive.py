"""`sextant drive` in a real terminal: it walks the simulated robot, and stops it at the end of each input."""

import contextlib
import os
import pty
import re
import signal
import subprocess
import sys
import threading
from pathlib import Path
from types import TracebackType
from typing import Self

import pytest

from sextant.deploy.launch.process_table import BUS_PORT
from sextant.shared.wire.messages import Mode
from sextant.shared.wire.ports import free_port
from sextant.shared.wire.transport import Endpoints
from tests.support.commands import PATIENCE_S, Command, Ear, environment, eventually, skip_where_taken, write_course

pytestmark = pytest.mark.live

REPEAT_S = 0.04  # of a held key
AT_REST_S = 3.0  # [s] within which a robot that has to stop stands on a busy machine; the body rests much earlier
# A shell makes the terminal that of the command's session.
IN_TERMINAL = "import fcntl, os, sys, termios; fcntl.ioctl(0, termios.TIOCSCTTY, 0); os.execv(sys.executable, sys.argv[1:])"


class Operator:
    """`sextant drive` in a terminal, whose keys this class presses."""

    def __init__(self, *words: str, cwd: Path):
        self.screen = ""
        self._words, self._cwd = words, cwd

    def __enter__(self) -> Self:
        self.keys, terminal = pty.openpty()
        words = (sys.executable, "-c", IN_TERMINAL, sys.executable, "-m", "sextant.deploy.cli", "drive", *self._words)
        self.process = subprocess.Popen(
            words,
            cwd=self._cwd,
            env={**os.environ, **environment()},
            stdin=terminal,
            stdout=terminal,
            stderr=terminal,
            start_new_session=True,
        )
        os.close(terminal)
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.process.kill()
        self.process.wait()
        self.hang_up()
        self._reader.join()
        if error is not None:
            error.add_note(f"the terminal showed:\n{self.screen[-3000:]}")

    def _read(self) -> None:
        with contextlib.suppress(OSError):
            while data := os.read(self.keys, 4096):
                self.screen += data.decode(errors="replace")

    def shows(self, words: str) -> bool:
        return re.search(words, self.screen) is not None

    def press(self, keys: str) -> None:
        os.write(self.keys, keys.encode())

    def hang_up(self) -> None:
        """Close the terminal, as a connection that ends does."""
        if self.keys >= 0:
            os.close(self.keys)
            self.keys = -1

    def hold(self, key: str, until: object, what: str) -> None:
        """Repeat a key as a terminal does, until a condition holds."""
        never = threading.Event()

        def holds() -> bool:
            self.press(key)
            never.wait(REPEAT_S)
            return bool(until())  # type: ignore[operator]

        eventually(holds, what)


def test_keys_walk_the_robot_and_each_end_of_input_stops_it(tmp_path: Path) -> None:
    skip_where_taken(BUS_PORT)
    course, endpoint = str(write_course(tmp_path, "wide", 8.0)), f"tcp/127.0.0.1:{free_port()}"
    where = ("--connect", endpoint, "--namespace", "driven")
    with Command("up", "all", "--scenario", course, "--listen", endpoint, *where[2:], cwd=tmp_path) as up:
        up.wait_for(lambda: "the simulated robot takes commands" in up.text(), "ready services")
        with Ear.at(Endpoints((endpoint,), namespace="driven")) as ear:

            def stands() -> bool:
                return ear.mode is not Mode.WALK

            with Operator(*where, cwd=tmp_path) as operator:
                eventually(lambda: operator.shows("lease: free"), "the state of the robot")
                operator.press("j")
                eventually(lambda: ear.mode is Mode.READY, "a sitting robot")
                operator.hold("w", lambda: operator.shows("the robot cannot walk, its mode is ready"), "a refusal")
                operator.press("u")
                eventually(lambda: ear.mode is Mode.HOLD, "a standing robot")
                operator.hold("w", lambda: ear.walked(1), "a walk")
                assert operator.shows(r"walk \| lease: yours \| speed 6\.0 of 12\.0 cm/s \| forward 6\.0 cm/s")
                eventually(stands, "a stop after the release", AT_REST_S)
                ear.forget()
                operator.hold("w", lambda: ear.walked(1), "a second walk")
                operator.press("x")
                assert operator.process.wait(PATIENCE_S) == 0
                eventually(stands, "a stop at the end of the command", AT_REST_S)
            with Operator(*where, cwd=tmp_path) as operator:
                eventually(lambda: ear.lease == "", "the end of the first lease")
                ear.forget()
                operator.hold("\x1b[A", lambda: ear.walked(1), "a walk by an arrow")
                os.kill(operator.process.pid, signal.SIGSTOP)
                eventually(stands, "a stop while the command is suspended", AT_REST_S)
                os.kill(operator.process.pid, signal.SIGCONT)
                assert operator.process.wait(PATIENCE_S) == 1
                assert operator.shows("this process was suspended; the robot was stopped")
            with Operator(*where, cwd=tmp_path) as operator:
                eventually(lambda: ear.lease == "", "the end of the second lease")
                ear.forget()
                operator.hold("d", lambda: ear.walked(1), "a walk to the side")
                operator.hang_up()
                eventually(stands, "a stop after the loss of the terminal", AT_REST_S)
                assert operator.process.wait(PATIENCE_S) in (1, 130)
        up.interrupt()
        assert up.status() == 130
        up.gone()
