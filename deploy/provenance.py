"""Which program made a result, and when: what a table of results is worth nothing without."""

import datetime
import hashlib
import importlib.metadata
import itertools
import platform
import re
import subprocess
from dataclasses import dataclass
from pathlib import Path

_ROOT = Path(__file__).resolve().parent.parent  # of the checkout, if there is one


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
    try:
        head = _git(_ROOT, "rev-parse", "--short=7", "HEAD")
        changed = _git(_ROOT, "status", "--porcelain", "--untracked-files=no")
    except (OSError, subprocess.CalledProcessError):  # no git, or no checkout
        return f"version {version()}" if version() else ""
    return head + ("+" if changed else "")


def seeds_of_commit(count: int) -> list[int]:
    """Seeds that nobody chose, different ones for each commit: of seven to nine digits, from the hash of the checkout's commit.

    Raises:
        ValueError: There is no checkout, or files have changed since its commit.
    """
    made_by = commit()
    if not re.fullmatch(r"[0-9a-f]{7,}", made_by):
        raise ValueError(f"a checkout without changes expected, its commit is to give the seeds; found {made_by or 'none'}")
    head = _git(_ROOT, "rev-parse", "HEAD")
    found: set[int] = set()
    numbers = itertools.count()
    while len(found) < count:
        digest = hashlib.blake2s(f"{head} {next(numbers)}".encode()).digest()
        found.add(1_000_000 + int.from_bytes(digest[:8], "big") % 999_000_000)
    return sorted(found)


def machine() -> str:
    """What this machine computes with, in words: its processor as it names itself."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:  # no Linux
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith(("model name", "Model"))]
    return next(iter(names), platform.processor() or platform.machine())


def now() -> str:
    """The time (UTC) in ISO 8601, to the second."""
    return datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")


def _git(root: Path, *words: str) -> str:
    return subprocess.run(["git", "-C", str(root), *words], capture_output=True, text=True, check=True).stdout.strip()


def version() -> str:
    """Of Sextant as it is installed, or nothing."""
    try:
        return importlib.metadata.version("sextant")
    except importlib.metadata.PackageNotFoundError:
        return ""
