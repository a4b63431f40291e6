"""Terminal whose keys arrive one by one, with lines of status that are redrawn in place."""

import contextlib
import os
import select
import shutil
import signal
import sys
import termios
import textwrap
from collections.abc import Callable
from types import FrameType, TracebackType
from typing import Any, Self

from sextant.deploy.terminal.output import say
from sextant.services.console.drive.driver import TerminalLostError

_READ = 1024  # [B] of one reading
_MOST_LINES = 4  # of status
_NO_TERMINAL = "a terminal in the foreground expected on standard input; over SSH start it with `ssh -t ROBOT sextant drive`"


class RawTerminal:
    """Keys of standard input without echo; Ctrl-C and Ctrl-Z are keys too, while entered.

    A process that was suspended, or is in the background, has lost its terminal. For the main thread only.
    """

    def __init__(self, suspended: Callable[[str], object], file: int = 0):
        """Start with the terminal unchanged.

        Args:
            suspended: Receives the reason when a signal suspends or has suspended this process, from the main thread.
            file: File number of the keys.
        """
        self._suspended, self._file = suspended, file
        self._before: list[Any] = []
        self._handlers: dict[signal.Signals, Any] = {}
        self._lines = 0  # of status that are shown
        self._redraws = False

    def __enter__(self) -> Self:
        """Set the terminal.

        Raises:
            TerminalLostError: Standard input is no terminal, or this process is in its background.
        """
        self._check()
        self._before = termios.tcgetattr(self._file)
        self._redraws = sys.stdout.isatty() and os.environ.get("TERM") != "dumb"
        for number in (signal.SIGTSTP, signal.SIGCONT):
            self._handlers[number] = signal.signal(number, self._suspend)
        for number in (signal.SIGTTIN, signal.SIGTTOU):
            self._handlers[number] = signal.signal(number, signal.SIG_IGN)
        raw = termios.tcgetattr(self._file)
        raw[0] &= ~(termios.IXON | termios.ICRNL | termios.INLCR | termios.ISTRIP)
        raw[3] &= ~(termios.ICANON | termios.ECHO | termios.ISIG | termios.IEXTEN)
        raw[6][termios.VMIN], raw[6][termios.VTIME] = 1, 0
        termios.tcsetattr(self._file, termios.TCSAFLUSH, raw)  # what was typed before is discarded
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        with contextlib.suppress(OSError, termios.error, TerminalLostError):
            self._check()  # in the background the terminal is another process's
            termios.tcflush(self._file, termios.TCIFLUSH)  # the shell gets no repetitions of a held key
            termios.tcsetattr(self._file, termios.TCSANOW, self._before)
        for number, handler in self._handlers.items():
            signal.signal(number, handler)
        if self._lines:
            self._write("\n")

    def fileno(self) -> int:
        """Return the file number of the keys, for `select`."""
        return self._file

    def read(self) -> bytes:
        """Return the characters since the last call, without waiting.

        Raises:
            TerminalLostError: The terminal is gone, or this process is in its background.
        """
        self._check()
        if not select.select([self._file], [], [], 0)[0]:
            return b""
        try:
            data = os.read(self._file, _READ)
        except OSError as error:
            raise TerminalLostError(f"the terminal is gone: {error.strerror}") from None
        if not data:
            raise TerminalLostError("the terminal is closed")
        return data

    def show(self, text: str) -> None:
        """Show lines in place of the last ones; on a stream that is no terminal, print them."""
        printable = "".join(sign if sign.isprintable() or sign == "\n" else "?" for sign in text)
        if not self._redraws:
            say(printable.replace("\n", " | "))
            return
        width = shutil.get_terminal_size().columns - 1
        lines = [part for line in printable.split("\n") for part in textwrap.wrap(line, max(width, 20))][:_MOST_LINES]
        up = f"\x1b[{self._lines - 1}A" if self._lines > 1 else ""
        self._lines = len(lines)
        self._write(f"\r{up}\x1b[J" + "\n".join(lines))

    def _check(self) -> None:
        try:
            foreground = os.isatty(self._file) and os.tcgetpgrp(self._file) == os.getpgrp()
        except OSError:
            foreground = False
        if not foreground:
            raise TerminalLostError(_NO_TERMINAL if not self._before else "the terminal is gone, or used by another program")

    def _suspend(self, _number: int, _frame: FrameType | None) -> None:
        self._suspended("this process was suspended")

    def _write(self, text: str) -> None:
        """Write to the terminal; leave it out if the terminal does not take it now."""
        with contextlib.suppress(OSError, ValueError):
            if select.select([], [sys.stdout], [], 0)[1]:
                sys.stdout.write(text)
                sys.stdout.flush()
