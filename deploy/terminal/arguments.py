"""Command-line parser that reports an error in one line, with the nearest match."""

import argparse
import sys
from collections.abc import Sequence
from typing import Any, NoReturn, Protocol

from sextant.deploy.terminal.output import complain, say
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


class AddCommand(Protocol):
    """Adds a command to a parser."""

    def __call__(self, name: str, command: Any, words: str, to: Any = None, listed: bool = True) -> argparse.ArgumentParser:
        """Add the parser of a command and return it.

        Args:
            name: Word that selects the command.
            command: Function of the parsed arguments that returns the exit status.
            words: Its help, a phrase without period.
            to: Sub-parsers that it belongs to; those of the program by default.
            listed: Whether the program's help names it.
        """


def command_adder(commands: Any) -> AddCommand:
    """Return a function that adds commands to the sub-parsers of a program."""

    def add(name: str, command: Any, words: str, to: Any = None, listed: bool = True) -> argparse.ArgumentParser:
        about = {"help": words} if listed else {}
        description = words[0].upper() + words[1:].replace("%%", "%") + "."
        made: argparse.ArgumentParser = (commands if to is None else to).add_parser(name, description=description, **about)
        made.set_defaults(command=command, name=name, parser=made)
        return made

    return add
