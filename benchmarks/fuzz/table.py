"""Results of fuzzing, of one process or several, as Markdown and JSON.

This module is pure.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass

from benchmarks.fuzz.fuzzing import GROWTH_MB, Finding, Found, Outcome


@dataclass(frozen=True, slots=True)
class Table:
    """Results of all runs."""

    outcomes: tuple[Outcome, ...]
    findings: tuple[Finding, ...]  # each error once
    growth_mb: float  # of the process with the largest growth
    processes: int

    @property
    def passed(self) -> bool:
        """Whether each message was accepted or refused, and memory did not grow."""
        return not self.findings and self.growth_mb < GROWTH_MB


def table(found: Sequence[Found]) -> Table:
    """Merge the results of all runs."""
    outcomes: dict[str, Outcome] = {}
    growth_mb: dict[int, float] = {}
    findings: dict[tuple[str, str], Finding] = {}
    for one in found:
        growth_mb[one.process] = growth_mb.get(one.process, 0.0) + one.growth_mb
        for name, outcome in one.outcomes.items():
            total = outcomes.setdefault(name, Outcome(name))
            total.messages += outcome.messages
            total.taken += outcome.taken
            total.slowest_s = max(total.slowest_s, outcome.slowest_s)
        for finding in one.findings:
            findings.setdefault((finding.target, finding.error), finding)
    return Table(tuple(outcomes.values()), tuple(findings.values()), max(growth_mb.values(), default=0.0), len(growth_mb))


def markdown(found: Table) -> str:
    """Return the table as Markdown."""
    lines = ["| parser | messages | accepted | refused | neither |", "|---|---|---|---|---|"]
    for one in found.outcomes:
        neither = sum(finding.target == one.target for finding in found.findings)
        refused = f"{100 * (1 - one.taken / one.messages):.0f}%" if one.messages else ""
        taken = f"{100 * one.taken / one.messages:.0f}%" if one.messages else ""
        lines.append(f"| {one.target} | {one.messages:,} | {taken} | {refused} | {neither or 'none'} |")
    total = sum(one.messages for one in found.outcomes)
    lines += [
        "",
        f"{total:,} messages; memory of the process that grew most: {found.growth_mb:+.1f} MB ({GROWTH_MB:g} at most).",
        *(f"- {finding.target}: {finding.error}; {len(finding.data)} bytes" for finding in found.findings),
    ]
    return "\n".join(lines)


def to_json(found: Table) -> str:
    """Return the table as JSON."""
    return json.dumps(
        {
            "passed": found.passed,
            "growth_mb": round(found.growth_mb, 3),
            "processes": found.processes,
            "outcomes": [
                {
                    "target": one.target,
                    "messages": one.messages,
                    "taken": one.taken,
                    "slowest_ms": round(1e3 * one.slowest_s, 3),
                }
                for one in found.outcomes
            ],
            "findings": [
                {"target": finding.target, "error": finding.error, "data": finding.data.hex()} for finding in found.findings
            ],
        },
        indent=1,
    )


def from_json(text: str) -> Table:
    """Read a table written by `to_json`."""
    found = json.loads(text)
    return Table(
        tuple(Outcome(o["target"], o["messages"], o["taken"], 1e-3 * o["slowest_ms"]) for o in found["outcomes"]),
        tuple(Finding(f["target"], f["error"], bytes.fromhex(f["data"])) for f in found["findings"]),
        found["growth_mb"],
        found["processes"],
    )
