"""Write the reference pages of docs/: `python -m docs.reference [KIND]...`, in a checkout."""

import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from docs.reference import commands_page, keys_page, params_page, results_pages, schema_pages, terrain_pictures
from sextant.deploy.terminal.arguments import Choice, argument, command
from sextant.deploy.terminal.output import say
from sextant.deploy.terminal.run_command import SUCCESS, run_command
from sextant.shared.files import whole_files

FOLDER = Path(__file__).parents[1]
PAGES: dict[str, Callable[[], dict[str, str]]] = {  # of each kind: names of its pages, without .md, and their texts
    "keys": keys_page.pages,
    "parameters": params_page.pages,
    "commands": commands_page.sextant,
    "benchmarks": commands_page.benchmarks,
    "scenarios": schema_pages.scenarios,
    "profiles": schema_pages.profiles,
    "report": lambda: {"report": schema_pages.report()},
}
_RESULTS = "results"


def texts_of(kind: str) -> dict[str, str]:
    """Return the pages of a kind by their names, as they are in the files."""
    return {name: text.rstrip("\n") + "\n" for name, text in PAGES[kind]().items()}


@command("python -m docs.reference")
@argument("kinds", "kinds of pages to write (default: all)", "[KIND]...", type=Choice((*PAGES, _RESULTS)), nargs=-1)
def write(kinds: tuple[str, ...]) -> int:
    """Write reference pages into docs/, made from the code; with `scenarios` also the pictures of the terrains.

    The kind `results` writes the tables of results, made from the data in docs/.
    """
    for kind in kinds or (*PAGES, _RESULTS):
        if kind == _RESULTS:
            for path, text in results_pages.pages(FOLDER.parent).items():
                whole_files.write_text(path, text)
                say(path.relative_to(FOLDER.parent).as_posix())
            continue
        for name, text in texts_of(kind).items():
            whole_files.write_text(FOLDER / f"{name}.md", text)
            say(f"docs/{name}.md")
        if kind == "scenarios":
            terrain_pictures.write(FOLDER / "terrain")
    return SUCCESS


def main(argv: Sequence[str]) -> int:
    """Write the pages that the words name, and return the exit status."""
    return run_command(write, "python -m docs.reference", argv)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
