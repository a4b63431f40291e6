"""Generators of the pages of the commands: of `sextant` in docs/commands.md, of the benchmarks in docs/benchmarks.md.

The first page lists the commands; each further one has the help of some of them.
"""

from collections.abc import Iterator, Mapping

import click

from benchmarks import cli as benchmarks_cli
from sextant.deploy import cli

_WIDTH = 90  # [characters] of the help
_Parts = Mapping[str, tuple[str, tuple[str, ...]]]  # end of a page's name -> title of the page, and its commands in order
_SEXTANT = """# Commands

*`python -m docs.reference commands` makes this page from the commands; a test checks that it is up to date.*

Every command prints its help with `--help`. The exit status is 0 only on success, 1 for a failed run, 2 for invalid input, 130
after Ctrl-C. `--json` prints the result for scripts. A link leads to the arguments and options of the command.
"""
_SEXTANT_PARTS: _Parts = {
    "walk": ("walks in simulation", ("demo", "run", "trials", "trials table")),
    "robot": ("operation of a robot", ("up", "fleet", "order", "service", "doctor")),
    "recordings": ("recordings and figures", ("record", "recording", "video", "plot")),
    "network": ("topics and certificates", ("topics", "keys")),
    "hardware": ("servos and robot profiles", ("servos", "robot")),
}
_BENCHMARKS = """# Benchmarks

*`python -m docs.reference benchmarks` makes this page from the commands; a test checks that it is up to date.*

The benchmarks compare Sextant with other libraries, inject faults and attack it. They run in a checkout. Of these, `speed`,
`stages`, `passage` and `servos` need the other libraries, which `pip install -e '.[bench]'` brings.
"""
_PART = """# {heading}: {title}

*`python -m docs.reference {kind}` makes this page from the commands; a test checks that it is up to date.*

[{heading}]({kind}.md) lists all commands.
"""


def sextant() -> dict[str, str]:
    """Return the pages of `sextant` in Markdown by their names."""
    return _pages("commands", cli.sextant, "sextant", _SEXTANT, _SEXTANT_PARTS)


def benchmarks() -> dict[str, str]:
    """Return the page of the benchmarks in Markdown by its name."""
    program = click.Context(benchmarks_cli.benchmarks, info_name=benchmarks_cli.PROGRAM, terminal_width=_WIDTH)
    lines = (line for context in _commands_of(program).values() for line in _details(context, 2))
    return {"benchmarks": "\n".join((_BENCHMARKS, *lines))}


def _pages(kind: str, group: click.Group, program: str, beginning: str, parts: _Parts) -> dict[str, str]:
    """Return the page that lists the commands of a program, named as its kind, and a page for each of its parts.

    Raises:
        ValueError: A command is in none of the parts.
    """
    commands = _commands_of(click.Context(group, info_name=program, terminal_width=_WIDTH))
    if left := commands.keys() - {name for _, names in parts.values() for name in names}:
        raise ValueError(f"commands in no part of {kind}: {', '.join(sorted(left))}")
    table, pages = ["| page | command | what it does |", "|---|---|---|"], {}
    for part, (title, names) in parts.items():
        page, cell = f"{kind}_{part}", f"[{title}]({kind}_{part}.md)"
        for single in (one for name in names for one in _single_commands(commands[name])):
            path, what = single.command_path, single.command.get_short_help_str()
            table.append(f"| {cell} | [`{path}`]({page}.md#{path.replace(' ', '-')}) | {what} |")
            cell = ""
        beginning_of_part = _PART.format(heading=kind.capitalize(), kind=kind, title=title)
        pages[page] = "\n".join((beginning_of_part, *(line for name in names for line in _details(commands[name], 2))))
    return {kind: "\n".join((beginning, *table)), **pages}


def _commands_of(group: click.Context) -> dict[str, click.Context]:
    assert isinstance(group.command, click.Group)
    return {
        name: click.Context(command, group, name, terminal_width=_WIDTH)
        for name, command in group.command.commands.items()
        if not command.hidden or " " in name  # a command of two words is hidden from the list only
    }


def _single_commands(context: click.Context) -> Iterator[click.Context]:
    """Yield a command, or the commands of a group."""
    if not isinstance(context.command, click.Group):
        yield context
        return
    for one in _commands_of(context).values():
        yield from _single_commands(one)


def _details(context: click.Context, level: int) -> Iterator[str]:
    """Yield the lines about a command, or about a group and its commands, below a heading of a level."""
    yield from (f"{'#' * level} {context.command_path}", "")
    if isinstance(context.command, click.Group):
        yield from (context.command.help or "", "")
        for one in _commands_of(context).values():
            yield from _details(one, level + 1)
    else:
        yield from ("```text", *context.command.get_help(context).splitlines(), "```", "")
