"""Questions to the operator at the terminal."""

import sys
from collections.abc import Callable

from sextant.deploy.commands.common import InputError, say


class Terminal:
    """The operator at the terminal; with `yes` every question has its default answer."""

    def __init__(self, yes: bool = False, completed: Callable[[str], str] = str) -> None:
        """Initialise without a question; `completed` adds their options to commands that a text names."""
        self._yes = yes
        self._completed = completed

    @property
    def absent(self) -> bool:
        """Whether no operator is present."""
        return self._yes

    def say(self, text: str) -> None:
        """Print a line."""
        say(self._completed(text))

    def ask(self, question: str) -> str:
        """Ask a question and return the typed answer; empty with `yes`."""
        if not self._yes:
            _forget_typed_ahead()  # before the question, so that an answer to it counts at once
        sys.stdout.write(question)
        if self._yes:
            say("")
            return ""
        sys.stdout.flush()
        line = sys.stdin.readline()
        if not line:
            raise InputError("an answer expected, found the end of the input; in a script, give --yes to calibrate and test")
        return line.strip()

    def agree(self, question: str) -> bool:
        """Ask a question; return whether y or yes was typed, True with `yes`."""
        if self._yes:
            say(f"{question} yes (--yes)")
            return True
        return self.ask(f"{question} [y/N] ").lower() in ("y", "yes")


def _forget_typed_ahead() -> None:
    """Drop what was typed before a question: it does not answer this one."""
    if sys.stdin.isatty():
        import termios

        termios.tcflush(sys.stdin, termios.TCIFLUSH)
