"""Provenance of results: commit, time and machine."""

import datetime
import hashlib
import importlib.metadata
import itertools
import platform
import re
import subprocess
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

_ROOT = Path(__file__).resolve().parent.parent  # of the checkout, if there is one


@dataclass(frozen=True, slots=True)
class Made:
    """Commits and times of some results."""

    commits: tuple[str, ...] = ()  # in alphabetical order
    first: str = ""  # time (UTC, ISO 8601) of the first result
    last: str = ""  # time of the last result

    @staticmethod
    def of(marks: list[tuple[str, str]]) -> "Made":
        """Combine the (commit, time) pairs of results; empty ones are unknown."""
        commits = sorted({commit for commit, _ in marks if commit})
        times = sorted(time for _, time in marks if time)
        return Made(tuple(commits), times[0], times[-1]) if times else Made(tuple(commits))

    @staticmethod
    def joined(several: Iterable["Made"]) -> "list[Made]":
        """Join those of the same commits; return them in the order of their commits."""
        groups: dict[tuple[str, ...], list[str]] = {}
        for made in several:
            groups.setdefault(made.commits, []).extend(filter(None, (made.first, made.last)))
        return [Made(commits, min(times, default=""), max(times, default="")) for commits, times in sorted(groups.items())]

    @property
    def words(self) -> str:
        """Commits and dates as text."""
        if not self.commits:
            return "by an unknown commit"
        days = sorted({self.first[:10], self.last[:10]} - {""})
        return f"at commit {', '.join(self.commits)}" + (f" on {' to '.join(days)}" if days else "")


def commit() -> str:
    """Return the commit of this checkout, with a plus if files have changed, other than those in docs/.

    Without a checkout it is the version of the package.
    """
    try:
        head = _git(_ROOT, "rev-parse", "--short=7", "HEAD")
        changed = _git(_ROOT, "status", "--porcelain", "--untracked-files=no", "--", ".", ":(exclude)docs")
    except (OSError, subprocess.CalledProcessError):  # no git, or no checkout
        return f"version {version()}" if version() else ""
    return head + ("+" if changed else "")


def seeds_of_commit(count: int) -> list[int]:
    """Derive seeds from the hash of the checkout's commit, so that none is chosen.

    They have seven to nine digits and differ between commits.

    Raises:
        ValueError: There is no checkout, or files have changed since its commit.
    """
    made_by = commit()
    if not re.fullmatch(r"[0-9a-f]{7,}", made_by):
        raise ValueError(f"a checkout without changes expected, because its commit gives the seeds; found {made_by or 'none'}")
    head = _git(_ROOT, "rev-parse", "HEAD")
    found: set[int] = set()
    numbers = itertools.count()
    while len(found) < count:
        digest = hashlib.blake2s(f"{head} {next(numbers)}".encode()).digest()
        found.add(1_000_000 + int.from_bytes(digest[:8], "big") % 999_000_000)
    return sorted(found)


def machine() -> str:
    """Return the name of this machine's processor."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:  # no Linux
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith(("model name", "Model"))]
    return next(iter(names), platform.processor() or platform.machine())


def now() -> str:
    """Return the time (UTC) in ISO 8601, to the second."""
    return datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")


def _git(root: Path, *words: str) -> str:
    return subprocess.run(["git", "-C", str(root), *words], capture_output=True, text=True, check=True).stdout.strip()


def version() -> str:
    """Return the version of the installed Sextant, or an empty string."""
    try:
        return importlib.metadata.version("sextant")
    except importlib.metadata.PackageNotFoundError:
        return ""
