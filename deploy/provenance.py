"""Which program made a result, and when: what a table of results is worth nothing without."""

import datetime
import importlib.metadata
import subprocess
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, slots=True)
class Made:
    """What some results were made by, and when."""

    commits: tuple[str, ...] = ()  # in alphabetical order
    first: str = ""  # time (UTC, ISO 8601) of the first result
    last: str = ""  # and of the last

    @staticmethod
    def of(marks: list[tuple[str, str]]) -> "Made":
        """Of results by their commits and times; results of before these were noted count as of neither."""
        commits = sorted({commit for commit, _ in marks if commit})
        times = sorted(time for _, time in marks if time)
        return Made(tuple(commits), times[0], times[-1]) if times else Made(tuple(commits))

    @property
    def words(self) -> str:
        """In words, for people."""
        if not self.commits:
            return "by an unknown commit"
        days = sorted({self.first[:10], self.last[:10]})
        return f"at commit {', '.join(self.commits)} on {' to '.join(days)}"


def commit() -> str:
    """The commit of this program's checkout, with a plus where files have changed since; without one, its version."""
    root = Path(__file__).parent.parent
    try:
        head = _git(root, "rev-parse", "--short=7", "HEAD")
        changed = _git(root, "status", "--porcelain", "--untracked-files=no")
    except (OSError, subprocess.CalledProcessError):  # no git, or no checkout
        return _version()
    return head + ("+" if changed else "")


def now() -> str:
    """The time (UTC) in ISO 8601, to the second."""
    return datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")


def _git(root: Path, *words: str) -> str:
    return subprocess.run(["git", "-C", str(root), *words], capture_output=True, text=True, check=True).stdout.strip()


def _version() -> str:
    try:
        return f"version {importlib.metadata.version('sextant')}"
    except importlib.metadata.PackageNotFoundError:
        return ""
