"""Parts of the campaign: each claim of the documentation, the commands that show it, and the code that it depends on."""

import shlex
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

from sextant.shared.files import config

ROOT = Path(__file__).parents[2]  # of the checkout
DOCS = ROOT / "docs"
_FILE = Path(__file__).with_name("parts.toml")
_PROGRAMS = {"sextant": ("-m", "sextant.deploy.cli"), "python": ()}  # after the name of the interpreter
_WORKERS = "{workers}"  # stands for --jobs N or --cluster ADDRESS


@dataclass(frozen=True, slots=True)
class Part:
    """A claim and its evidence."""

    claim: str  # what the documentation claims
    page: str  # page in docs/ that has the results, without .md
    commands: tuple[str, ...]  # commands that measure; each gets --out and a folder of its own
    result: str  # file that each command leaves in its folder; a name with .jsonl means the runs of trials
    kept: str  # file in docs/ that keeps the result
    modules: tuple[str, ...]  # modules whose code determines the result, with all that they import
    core_hours: float  # on a core of a server, measured or estimated
    reads: tuple[str, ...] = ()  # scenarios and profiles that determine it, as paths from the root; may be patterns

    def __post_init__(self) -> None:
        if not self.commands:
            raise ValueError("at least one command expected, found none")
        if unknown := [line for line in self.commands if shlex.split(line)[0] not in _PROGRAMS]:
            raise ValueError(f"commands that begin with `sextant` or `python` expected, found {unknown[0]!r}")
        if len(self.commands) > 1 and not self.of_trials:
            raise ValueError(f"one command expected, because only runs of trials can be joined, found {len(self.commands)}")

    @property
    def of_trials(self) -> bool:
        """Whether the result is a file of runs, a line each."""
        return self.kept.endswith(".jsonl")

    def steps(self, out: Path, workers: str) -> "list[Step]":
        """Return the commands as they are run, each with its folder.

        Args:
            out: Folder of the part.
            workers: Text such as `--jobs 2` for the commands that divide their work.
        """
        folders = [out / str(number) for number in range(len(self.commands))] if len(self.commands) > 1 else [out]
        lines = (line.replace(_WORKERS, workers) for line in self.commands)
        return [Step(f"{line} --out {shlex.quote(str(folder))}", folder) for line, folder in zip(lines, folders, strict=True)]

    @property
    def told(self) -> str:
        """The first command as a user types it, in Markdown, and how many more there are."""
        first = " ".join(self.commands[0].replace(_WORKERS, "").split())
        return f"`{first}`" + (f" and {len(self.commands) - 1} more" if self.commands[1:] else "")


@dataclass(frozen=True, slots=True)
class Step:
    """A command of a part, and the folder that it writes to."""

    line: str  # as a user types it
    folder: Path

    @property
    def words(self) -> list[str]:
        """The command as words, run by this interpreter."""
        program, *rest = shlex.split(self.line)
        return [sys.executable, *_PROGRAMS[program], *rest]


def load() -> Mapping[str, Part]:
    """Return the parts by their names, in the order of the file.

    Raises:
        ConfigError: The file is invalid; the text lists all errors.
    """
    return MappingProxyType(
        {name: config.build(table, Part, f"{_FILE.name}, {name}") for name, table in config.read(_FILE).items()}
    )
