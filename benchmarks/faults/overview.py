"""The faults of several robots in one table: a row for each robot, and the limits that any of them has missed."""

from collections.abc import Mapping, Sequence
from math import isfinite

from benchmarks.faults.table import Figure, Row

_HEADINGS = (
    "robot",
    "faults",
    "phases of each",
    "keep all limits",
    "falls",
    "least margin [mm]",
    "torque off, latest [ms]",
    "walks again, latest [s]",
    "commit",
)


def markdown(tables: Mapping[str, Sequence[Row]]) -> str:
    """Return the table in Markdown.

    Args:
        tables: The rows of each robot, by its name.
    """
    lines = [f"| {' | '.join(_HEADINGS)} |", "|" + " --- |" * len(_HEADINGS)]
    lines += [f"| {' | '.join(_cells(robot, rows))} |" for robot, rows in tables.items()]
    failed = [(robot, row) for robot, rows in tables.items() for row in rows if row.missed]
    missed = [f"- `{robot}`, {row.fault}: {'; '.join(row.missed)}" for robot, row in failed]
    return "\n".join([*lines, *(["", *missed] if missed else [])])


def _cells(robot: str, rows: Sequence[Row]) -> tuple[str, ...]:
    phases = sorted({row.n for row in rows})
    return (
        f"`{robot}`",
        str(len(rows)),
        str(phases[0]) if len(phases) == 1 else f"{phases[0]} to {phases[-1]}",
        str(sum(row.passed for row in rows)),
        str(sum(row.falls for row in rows)),
        _worst([row.margin_m for row in rows], 1e3, ".0f", least=True),
        _worst([row.off_s for row in rows], 1e3, ".0f"),
        _worst([row.again_s for row in rows], 1.0, ".1f"),
        ", ".join(sorted({commit for row in rows for commit in row.commits})),
    )


def _worst(figures: Sequence[Figure], factor: float, form: str, least: bool = False) -> str:
    known = [one.worst for one in figures if one.n and isfinite(one.worst)]
    return format(factor * (min(known) if least else max(known)), form) if known else "-"
