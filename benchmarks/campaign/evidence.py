"""Evidence on file: when, where and by which code the result of each part was made."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

from benchmarks.campaign import code_state
from benchmarks.campaign.code_state import Dependencies
from benchmarks.campaign.part import DOCS, Part
from sextant.evaluation.provenance import Made
from sextant.shared.files import config, whole_files
from sextant.shared.files.input_file import parse_json, read_bytes

FILE = DOCS / "evidence.json"
_MOST_BYTES = 1 << 20
_NAMED = 3  # changed files that are named


@dataclass(frozen=True, slots=True)
class Evidence:
    """Origin of a result."""

    commits: tuple[str, ...]  # in alphabetical order
    first: str  # time (UTC, ISO 8601) of its first run
    last: str  # time of its last run
    machine: str  # name of the processor
    digest: str = ""  # of the code and libraries that it depends on; empty if it was made at several commits
    core_hours: float = 0.0  # 0 if not measured
    passed: bool = True  # whether the commands found every limit kept

    @property
    def made(self) -> Made:
        """Commits and times."""
        return Made(self.commits, self.first, self.last)


def read() -> dict[str, Evidence]:
    """Return the evidence of each part on file.

    Raises:
        FileError: The file cannot be read.
        ConfigError: It is invalid.
    """
    if not FILE.exists():
        return {}
    table: Any = parse_json(FILE, read_bytes(FILE, _MOST_BYTES))
    return {name: config.build(entry, Evidence, f"{FILE.name}, {name}") for name, entry in table.items()}


def keep(found: Mapping[str, Evidence]) -> None:
    """Write the evidence of all parts."""
    text = json.dumps({name: asdict(one) for name, one in sorted(found.items())}, indent=1)
    whole_files.write_text(FILE, text + "\n", durable=True)


@dataclass(frozen=True, slots=True)
class Standing:
    """Whether a claim holds by the present code."""

    holds: bool
    reason: str  # why not

    @staticmethod
    def of(part: Part, evidence: Evidence | None) -> "Standing":
        """Compare the code that made the result with the code at HEAD."""
        if evidence is None or not (DOCS / part.kept).exists():
            return Standing(False, "never kept")
        if not evidence.passed:
            return Standing(False, "a limit was not kept")
        dependencies = Dependencies.of(part.modules, part.reads)
        if evidence.digest and evidence.digest == dependencies.digest():
            return Standing(True, "")
        if unknown := [commit for commit in evidence.commits if not code_state.known(commit)]:
            return Standing(False, f"made by other code, {unknown[0]}, which is not in this checkout")
        changed = sorted({path for commit in evidence.commits for path in dependencies.changed(commit)})
        if not changed:
            return Standing(bool(evidence.commits), "" if evidence.commits else "made by an unknown commit")
        named = ", ".join(changed[:_NAMED]) + (", ..." if len(changed) > _NAMED else "")
        return Standing(False, f"{len(changed)} files changed since: {named}")

    @property
    def words(self) -> str:
        """Yes, or no and why."""
        return "yes" if self.holds else f"no: {self.reason}"


def ordered(parts: Mapping[str, Part], found: Mapping[str, Evidence]) -> list[str]:
    """Return the names of the parts, those without evidence first, then those with the oldest."""
    return sorted(parts, key=lambda name: found[name].first if name in found else "")


def stamped(evidence: Evidence, part: Part) -> Evidence:
    """Return evidence with the digest of its code, if it was made at one commit."""
    if len(evidence.commits) != 1:
        return replace(evidence, digest="")
    return replace(evidence, digest=Dependencies.of(part.modules, part.reads).digest(evidence.commits[0]))
