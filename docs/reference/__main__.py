"""Write the reference pages of docs/: `python -m docs.reference [PAGE]...`, in a checkout."""

import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from benchmarks import cli as benchmarks
from docs.reference import commands_page, keys_page, params_page, schema_pages, terrain_pictures
from sextant.deploy import cli
from sextant.deploy.terminal.arguments import Choice, argument, command
from sextant.deploy.terminal.output import say
from sextant.deploy.terminal.run_command import SUCCESS, run_command
from sextant.shared.files import whole_files

FOLDER = Path(__file__).parents[1]
PAGES: dict[str, Callable[[], str]] = {
    "keys": keys_page.page,
    "parameters": params_page.page,
    "commands": lambda: commands_page.page(cli.sextant, "sextant"),
    "benchmarks": lambda: commands_page.page(benchmarks.benchmarks, benchmarks.PROGRAM),
    "scenarios": schema_pages.scenarios,
    "profiles": schema_pages.profiles,
    "report": schema_pages.report,
}


def text_of(name: str) -> str:
    """Return a page as it is in the file."""
    return PAGES[name]().rstrip("\n") + "\n"


@command("python -m docs.reference")
@argument("pages", "pages to write (default: all)", "[PAGE]...", type=Choice(tuple(PAGES)), nargs=-1)
def write(pages: tuple[str, ...]) -> int:
    """Write reference pages into docs/, made from the code; with `scenarios` also the pictures of the terrains."""
    for name in pages or PAGES:
        whole_files.write_text(FOLDER / f"{name}.md", text_of(name))
        if name == "scenarios":
            terrain_pictures.write(FOLDER / "terrain")
        say(f"docs/{name}.md")
    return SUCCESS


def main(argv: Sequence[str]) -> int:
    """Write the pages that the words name, and return the exit status."""
    return run_command(write, "python -m docs.reference", argv)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
