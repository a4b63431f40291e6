"""Command-line parser that reports an error in one line, with the nearest match."""

import argparse
import sys
from collections.abc import Sequence
from typing import Any, NoReturn

from sextant.deploy.output import complain, say
from sextant.shared.spelling import hint, nearest


class ArgumentParser(argparse.ArgumentParser):
    """A parser with one-line errors; its sub-commands are parsed by the same class."""

    def error(self, message: str) -> NoReturn:
        """End the program with status 2 and one line on stderr."""
        self.exit(2, f"{self.prog}: {message.removeprefix('argument ')}; see `{self.prog} --help`\n")

    def _print_message(self, message: str, file: object = None) -> None:  # overrides argparse, which ignores write errors
        """Print help on stdout, or errors on stderr.

        A failure to print the help is reported; one to print an error is ignored.
        """
        if file is sys.stdout:
            say(message.rstrip("\n"))
        else:
            complain(message.rstrip("\n"))

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        if action.choices is not None and value not in action.choices:
            known = [str(choice) for choice in action.choices if choice is not argparse.SUPPRESS]
            raise argparse.ArgumentError(action, f"unknown {value!r}; {hint(str(value), known)}")

    def parse_whole(self, words: Sequence[str]) -> argparse.Namespace:
        """Parse all words of a command line; end the program at an unknown one.

        Each sub-command sets its parser as the default of `parser`.
        """
        arguments, rest = self.parse_known_args(words)
        if rest:
            chosen: ArgumentParser = getattr(arguments, "parser", self)
            option = rest[0].partition("=")[0]
            if not option.startswith("-"):
                chosen.error(f"unexpected {option!r}")
            near = nearest(option, chosen.options)
            chosen.error(f"unknown option {option!r}" + (f"; did you mean {near!r}?" if near else ""))
        return arguments

    @property
    def options(self) -> tuple[str, ...]:
        """The parser's long options."""
        return tuple(option for option in self._option_string_actions if option.startswith("--"))
