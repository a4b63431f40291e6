"""Commands of a program, made with click: an error is one line with the nearest match.

A command is a typed function. It is parsed completely before it runs, and returns the exit status.
"""

import functools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, cast

import click

from sextant.shared.spelling import hint, nearest

_Function = Callable[..., Any]
_LARGEST = 2**53  # largest integer that every JSON reader represents exactly
_WIDTH = 120  # [characters] of the widest help
_SETTINGS = {  # options of `sextant servos` and what sets the same in commands that start the actuator
    "--port": "actuator.port=DEVICE",
    "--bridge": "actuator.bridge=true",
    "--echo": "actuator.echo=true",
}


@dataclass(frozen=True, slots=True)
class Chosen:
    """A command whose arguments are parsed."""

    path: str  # such as "sextant topics list"
    values: Mapping[str, Any]  # parameter -> value
    run: Callable[[], int]  # returns the exit status


class _Described(click.Command):
    """A command or a group of commands, as its help and its errors show it."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parse the arguments; an error names this command."""
        try:
            return super().parse_args(ctx, args)
        except click.UsageError as error:
            error.ctx = error.ctx or ctx
            raise

    def get_short_help_str(self, limit: int = 45) -> str:
        """Return the first line of the help, which the list of commands wraps."""
        return (self.help or "").partition("\n")[0].removesuffix(".")

    def get_help_option(self, ctx: click.Context) -> click.Option | None:
        """Return the option that prints the help."""
        made = super().get_help_option(ctx)
        if made is not None:
            made.help = "print this help"
        return made


class Command(_Described):
    """A command; to invoke it is to choose it, so that parsing ends before it runs."""

    def invoke(self, ctx: click.Context) -> Chosen:
        """Return the parsed command."""
        return Chosen(ctx.command_path, ctx.params, functools.partial(super().invoke, ctx))


class Group(_Described, click.Group):
    """Commands in the order in which they are added."""

    command_class = Command

    def __init__(self, name: str, about: str) -> None:
        """Initialise without commands; `about` is the help."""
        super().__init__(name, help=about, no_args_is_help=False)

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the names of the commands."""
        return list(self.commands)


def command(name: str | None = None, **attributes: Any) -> Callable[[_Function], Command]:
    """Return a decorator that makes a command of a function; its docstring is the help."""
    return click.command(name, cls=Command, **attributes)


def option(
    name: str, about: str, metavar: str | None = None, default: Any = None, into: str | None = None, **more: Any
) -> Callable[[_Function], _Function]:
    """Return an option; its help states the default, unless `about` does.

    Args:
        name: Such as "--out".
        about: The help, a phrase without period.
        metavar: The value in the help.
        default: None where there is none.
        into: Parameter of the function, if it has another name.
        more: Further arguments of `click.option`.
    """
    if default is not None:
        more |= {"default": default, "show_default": default != "" and "(default" not in about}
    return click.option(*filter(None, (name, into)), help=about, metavar=metavar, **more)


def flag(name: str, about: str, into: str | None = None, **more: Any) -> Callable[[_Function], _Function]:
    """Return an option without a value; see `option`."""
    return click.option(*filter(None, (name, into)), help=about, is_flag=True, **more)


def argument(name: str, about: str, metavar: str | None = None, **more: Any) -> Callable[[_Function], _Function]:
    """Return an argument of a command; see `option`."""
    return click.argument(name, help=about, metavar=metavar, **more)


def options_of(kind: type, name: str, *options: Callable[[_Function], _Function]) -> Callable[[_Function], _Function]:
    """Return a decorator that adds options to a command, and passes their values as one object.

    Args:
        kind: Dataclass with a field for each option.
        name: Parameter of the command's function that gets the object.
        options: Decorators that `click.option` returns, in the order of the help.
    """

    def decorate(function: _Function) -> _Function:
        @functools.wraps(function)
        def call(**values: Any) -> Any:
            own = {field.name: values.pop(field.name) for field in fields(kind)}
            return function(**values, **{name: kind(**own)})

        return functools.reduce(lambda made, option: option(made), reversed(options), cast(_Function, call))

    return decorate


def parse(program: click.Command, name: str, words: Sequence[str]) -> Chosen:
    """Return the chosen command; where help is printed instead, one that does nothing.

    Raises:
        click.UsageError: The words are invalid.
    """
    try:
        with program.make_context(name, list(words), max_content_width=_WIDTH) as context:
            return cast(Chosen, program.invoke(context))
    except click.exceptions.Exit as ended:
        status = ended.exit_code
        return Chosen(name, {}, lambda: status)


def in_one_line(error: click.UsageError) -> str:
    """Return a usage error as one line: the command, what is wrong, and where the help is."""
    path = error.ctx.command_path if error.ctx else ""
    return f"{path}: {' '.join(_problem(error).split())}; see `{path} --help`"


def _problem(error: click.UsageError) -> str:
    command = error.ctx.command if error.ctx else None
    match error:
        case click.exceptions.NoSuchCommand() if isinstance(command, click.Group):
            known = [name for name, one in command.commands.items() if not one.hidden]
            return f"unknown command {error.command_name!r}; {hint(error.command_name, known)}"
        case click.NoSuchOption():
            offered = [] if command is None else [one for one in command.params if not getattr(one, "hidden", False)]
            words = {word.lstrip("-"): word for one in offered for word in one.opts}  # dashes make any two similar
            near = nearest(error.option_name.lstrip("-"), words)
            if "set" in words and error.option_name in _SETTINGS:
                return f"unknown option {error.option_name!r}; the setting is --set {_SETTINGS[error.option_name]}"
            return f"unknown option {error.option_name!r}" + (f"; did you mean {words[near]!r}?" if near else "")
        case click.MissingParameter():
            return f"{_name(error.param)} expected, found none"
        case click.BadParameter():
            return f"{_name(error.param)}: {error.message}"
        case click.UsageError() if type(error) is click.UsageError and isinstance(command, click.Group):
            return "a command expected, found none"
    return error.message[:1].lower() + error.message[1:].removesuffix(".")


def _name(parameter: click.Parameter | None) -> str:
    """Return a parameter as the command line names it."""
    if parameter is None:
        return "argument"
    return "/".join(parameter.opts) if isinstance(parameter, click.Option) else parameter.human_readable_name


class Choice(click.Choice[str]):
    """One of some words; the error names the nearest one."""

    def get_invalid_choice_message(self, value: Any, ctx: click.Context | None) -> str:
        """Return the error of an unknown word."""
        return f"unknown {value!r}; {hint(str(value), self.choices)}"


class Parsed(click.ParamType[Any]):
    """A value that a function parses; its ValueError is the message."""

    def __init__(self, function: Callable[[str], Any], name: str) -> None:
        self.name = name
        self._function = function

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Parse a text; a default of another type stays as it is."""
        if not isinstance(value, str):
            return value
        try:
            return self._function(value)
        except ValueError as error:
            self.fail(str(error), param, ctx)


def whole(lowest: int, highest: int = _LARGEST) -> Parsed:
    """Return the type of an integer within limits."""
    bounds = f"at least {lowest}" if highest == _LARGEST else f"{lowest} to {highest}"

    def parsed(text: str) -> int:
        if not (text.isascii() and text.isdecimal() and len(text) < 20 and lowest <= int(text) <= highest):
            raise ValueError(f"a whole number of {bounds} expected, found {text[:60]!r}")
        return int(text)

    return Parsed(parsed, "n")


def number(lowest: float, highest: float, unit: str) -> Parsed:
    """Return the type of a number within limits; the unit is for the message."""

    def parsed(text: str) -> float:
        try:
            found = float(text)
        except ValueError:
            found = math.nan
        if not lowest <= found <= highest:
            raise ValueError(f"{unit} from {lowest:g} to {highest:g} expected, found {text[:60]!r}")
        return found

    return Parsed(parsed, "x")
