"""Generators of the pages of the commands: of `sextant` in docs/commands.md, of the benchmarks in docs/benchmarks.md.

The first page lists the commands; the pages of its parts have their help.
"""

from collections.abc import Iterable, Iterator

import click

from benchmarks import cli as benchmarks_cli
from docs.reference.parts import Part, split
from sextant.deploy import cli

_WIDTH = 90  # [characters] of the help
_SEXTANT = """# Commands

*`python -m docs.reference commands` makes this page from the commands; a test checks that it is up to date.*

Every command prints its help with `--help`. The exit status is 0 only on success, 1 for a failed run, 2 for invalid input, 130
after Ctrl-C. `--json` prints the result for scripts. A link leads to the arguments and options of the command.
"""
_OF_SEXTANT = (  # end of a page's name, its title and its commands
    ("walk", "walks in simulation", ("demo", "run", "plan", "trials", "trials table")),
    ("robot", "operation of a robot", ("up", "fleet", "order", "drive", "service", "doctor")),
    ("recordings", "recordings and figures", ("record", "video", "figures", "recording")),
    ("network", "topics and certificates", ("keys", "topics")),
    ("servos", "servos", ("servos",)),
    ("hardware", "camera and robot profiles", ("robot", "camera")),
)
_BENCHMARKS = """# Benchmarks

*`python -m docs.reference benchmarks` makes this page from the commands; a test checks that it is up to date.*

The benchmarks compare Sextant with other libraries, inject faults and attack it. They run in a checkout. Of these, `speed`,
`stages`, `passage` and `servos` need the other libraries, which `pip install -e '.[bench]'` brings. A link leads to the
options of the benchmark.
"""
_OF_BENCHMARKS = (
    ("algorithms", "accuracy and speed of algorithms", ("accuracy", "speed", "stages", "maps", "plans", "passage")),
    ("attacks", "attacks", ("access", "strangers", "roles", "fuzz")),
    (
        "robot",
        "servos and faults of the robot",
        ("servos", "bus", "checksums", "cycle", "calibration", "naming", "slow-core", "start", "faults"),
    ),
    (
        "system",
        "the campaign, radio, load and resources",
        ("campaign", "fleet", "latency", "link", "page", "recording", "soak", "size"),
    ),
)


def sextant() -> dict[str, str]:
    """Return the pages of `sextant` in Markdown by their names."""
    return _pages("commands", cli.sextant, "sextant", _SEXTANT, _OF_SEXTANT)


def benchmarks() -> dict[str, str]:
    """Return the pages of the benchmarks in Markdown by their names."""
    return _pages("benchmarks", benchmarks_cli.benchmarks, benchmarks_cli.PROGRAM, _BENCHMARKS, _OF_BENCHMARKS)


def _pages(
    kind: str, group: click.Group, program: str, beginning: str, titles: Iterable[tuple[str, str, tuple[str, ...]]]
) -> dict[str, str]:
    heading = kind.capitalize()
    parts = {
        f"{kind}_{name}": Part(
            f"{heading}: {title}", f"[{heading}]({kind}.md) lists all of them.", tuple(f"{program} {one}" for one in commands)
        )
        for name, title, commands in titles
    }
    context = click.Context(group, info_name=program, terminal_width=_WIDTH)
    text = "\n".join((beginning, *(line for one in _commands(context) for line in _details(one, 2))))
    return split(kind, text, parts, dict(_index(context)))


def _index(context: click.Context) -> Iterator[tuple[str, str]]:
    """Yield each command below a context, as it is typed, and what it does."""
    for one in _commands(context):
        if isinstance(one.command, click.Group):
            yield from _index(one)
        else:
            yield one.command_path, one.command.get_short_help_str()


def _commands(group: click.Context) -> Iterator[click.Context]:
    assert isinstance(group.command, click.Group)
    for name, command in group.command.commands.items():
        if not command.hidden or " " in name:  # a command of two words is hidden from the list only
            yield click.Context(command, group, name, terminal_width=_WIDTH)


def _details(context: click.Context, level: int) -> Iterator[str]:
    """Yield the lines about a command, or about a group and its commands, below a heading of a level."""
    yield from (f"{'#' * level} {context.command_path}", "")
    if isinstance(context.command, click.Group):
        yield from (context.command.help or "", "")
        for one in _commands(context):
            yield from _details(one, level + 1)
    else:
        yield from ("```text", *context.command.get_help(context).splitlines(), "```", "")
