"""Parse the command line, and name what is wrong with it in one line, with the nearest right word."""

import argparse
import sys
from collections.abc import Sequence
from typing import Any, NoReturn

from sextant.deploy.output import complain, say
from sextant.shared.spelling import hint, nearest


class ArgumentParser(argparse.ArgumentParser):
    """A parser whose refusals are one line each; its sub-commands are parsed by the same class."""

    def error(self, message: str) -> NoReturn:
        """End the program with status 2 and one line on stderr."""
        self.exit(2, f"{self.prog}: {message.removeprefix('argument ')}; see `{self.prog} --help`\n")

    def _print_message(self, message: str, file: object = None) -> None:  # of argparse, which ignores what goes wrong
        """Print help on standard output, or say there that it cannot be printed; print what is wrong if that is possible."""
        if file is sys.stdout:
            say(message.rstrip("\n"))
        else:
            complain(message.rstrip("\n"))

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        if action.choices is not None and value not in action.choices:
            known = [str(choice) for choice in action.choices if choice is not argparse.SUPPRESS]
            raise argparse.ArgumentError(action, f"unknown {value!r}; {hint(str(value), known)}")

    def parse_whole(self, words: Sequence[str]) -> argparse.Namespace:
        """All words of a command line; ends the program where one of them is not known.

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
        """The long options that it knows."""
        return tuple(option for option in self._option_string_actions if option.startswith("--"))
