"""Terminal whose keys arrive one by one: a pseudo-terminal in place of the operator's."""

import os
import pty
import select
import signal
import sys
import termios
from collections.abc import Iterator
from pathlib import Path

import pytest

from sextant.deploy.terminal.raw_terminal import RawTerminal
from sextant.services.console.drive.driver import TerminalLostError

_ARRIVAL_S = 30.0  # [s] for keys to arrive, on a busy machine, too


class Pair:
    """A pseudo-terminal: the operator's end, and that of the program in its foreground."""

    def __init__(self) -> None:
        self.operator, self.program = pty.openpty()
        self.suspended: list[str] = []
        self.terminal = RawTerminal(self.suspended.append, self.program)

    def type(self, keys: bytes) -> None:
        """Type, and wait until the keys have arrived: the kernel delivers them later, by a thread of its own."""
        os.write(self.operator, keys)
        assert select.select([self.program], [], [], _ARRIVAL_S)[0], "the keys have not arrived"

    def modes(self) -> list[object]:
        return termios.tcgetattr(self.program)

    def shown(self) -> str:
        return os.read(self.operator, 4096).decode()

    def hang_up(self) -> None:
        if self.operator >= 0:
            os.close(self.operator)
            self.operator = -1


@pytest.fixture
def pair(monkeypatch: pytest.MonkeyPatch) -> Iterator[Pair]:
    made = Pair()
    monkeypatch.setattr(os, "tcgetpgrp", lambda _: os.getpgrp())
    yield made
    made.hang_up()
    os.close(made.program)


def test_keys_arrive_one_by_one_and_the_terminal_is_as_before_afterwards(pair: Pair) -> None:
    before = pair.modes()
    pair.type(b"typed earlier\n")
    with pair.terminal as terminal:
        assert terminal.read() == b"", "what was typed before the start is discarded"
        pair.type(b"w\x03\x1a\x13\r")
        assert terminal.read() == b"w\x03\x1a\x13\r"
        assert pair.modes() != before
        pair.type(b"www")
    assert pair.modes() == before
    with pair.terminal as terminal:
        assert terminal.read() == b"", "the shell gets no repetitions"


def test_signal_that_suspends_is_reported_and_does_not_suspend(pair: Pair) -> None:
    handlers = [signal.getsignal(number) for number in (signal.SIGTSTP, signal.SIGCONT, signal.SIGTTIN)]
    with pair.terminal:
        for number in (signal.SIGTSTP, signal.SIGCONT, signal.SIGTTIN):
            os.kill(os.getpid(), number)
    assert pair.suspended == ["this process was suspended"] * 2
    assert [signal.getsignal(number) for number in (signal.SIGTSTP, signal.SIGCONT, signal.SIGTTIN)] == handlers


def test_terminal_that_hangs_up_is_lost(pair: Pair) -> None:
    with pair.terminal as terminal:
        pair.hang_up()
        with pytest.raises(TerminalLostError, match=r"the terminal is (gone|closed)"):
            terminal.read()


def test_terminal_of_another_program_is_lost(pair: Pair, monkeypatch: pytest.MonkeyPatch) -> None:
    with pair.terminal as terminal:
        modes = pair.modes()
        monkeypatch.setattr(os, "tcgetpgrp", lambda _: os.getpgrp() + 1)
        with pytest.raises(TerminalLostError, match="used by another program"):
            terminal.read()
    assert pair.modes() == modes, "it is the other program's"


def test_stream_that_is_no_terminal_is_refused(tmp_path: Path) -> None:
    with (tmp_path / "keys").open("w") as file:
        refused = pytest.raises(TerminalLostError, match=r"a terminal in the foreground expected.*ssh -t")
        with refused, RawTerminal(print, file.fileno()):
            pass


def test_status_is_redrawn_in_place_without_control_characters(pair: Pair, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "40")
    with open(os.dup(pair.program), "w") as screen, monkeypatch.context() as patch:  # noqa: PTH123 - a file number
        patch.setattr(sys, "stdout", screen)
        with pair.terminal as terminal:
            terminal.show("walk\n" + "long " * 30)
            first = pair.shown()
            terminal.show("hold\nlease of \x1b]0;evil\x07")
            second = pair.shown()
    lines = first.removeprefix("\r\x1b[J").split("\r\n")
    assert len(lines) == 4
    assert all(len(line) < 40 and line.isprintable() for line in lines)
    assert second == "\r\x1b[3A\x1b[Jhold\r\nlease of ?]0;evil?"


def test_status_on_a_pipe_is_printed_as_lines(
    pair: Pair, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with pair.terminal as terminal:
        terminal.show("walk\nplanner: flat")
    assert capsys.readouterr().out == "walk | planner: flat\n"
