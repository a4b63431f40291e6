"""Generator of docs/commands.md and docs/benchmarks.md: each command of a program with its help."""

from collections.abc import Iterator

import click

_WIDTH = 90  # [characters] of the help
_SEXTANT = """# Commands

*`python -m docs.reference commands` makes this page from the commands; a test checks that it is up to date.*

Every command prints its help with `--help`. The exit status is 0 only on success, 1 for a failed run, 2 for invalid input, 130
after Ctrl-C. `--json` prints the result for scripts.
"""
_BENCHMARKS = """# Benchmarks

*`python -m docs.reference benchmarks` makes this page from the commands; a test checks that it is up to date.*

The benchmarks compare Sextant with other libraries, inject faults and attack it. They run in a checkout. Of these, `speed`,
`stages`, `passage` and `servos` need the other libraries, which `pip install -e '.[bench]'` brings.
"""


def page(program: click.Group, name: str) -> str:
    """Return the page of a program in Markdown.

    Args:
        program: The group of its commands; hidden ones are left out.
        name: As it is typed, such as "sextant".
    """
    beginning = _SEXTANT if name == "sextant" else _BENCHMARKS
    context = click.Context(program, info_name=name, terminal_width=_WIDTH)
    return "\n".join((beginning, *_commands(program, context, 2)))


def _commands(group: click.Group, parent: click.Context, level: int) -> Iterator[str]:
    for name, command in group.commands.items():
        if command.hidden and " " not in name:  # a command of two words is hidden from the list only
            continue
        context = click.Context(command, parent, name, terminal_width=_WIDTH)
        yield from (f"{'#' * level} {context.command_path}", "")
        if isinstance(command, click.Group):
            yield from (command.help or "", "")
            yield from _commands(command, context, level + 1)
        else:
            yield from ("```text", *command.get_help(context).splitlines(), "```", "")
