"""Tables of text as Markdown, CSV or LaTeX.

A cell may hold names in backticks, which Markdown shows as code; LaTeX sets them in typewriter type, CSV leaves them plain.
"""

import csv
import io
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from sextant.shared.errors import SextantError
from sextant.shared.spelling import hint

_CODE = re.compile(r"`([^`]*)`")
_LATEX = {
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "–": "--",
    **{character: f"\\{character}" for character in "&%$#_{}"},
}


class UnknownColumnError(SextantError, ValueError):
    """A table has no column of a name."""


@dataclass(frozen=True, slots=True)
class Table:
    """A table of text with notes below it."""

    headings: Sequence[str]
    rows: Sequence[Sequence[str]]
    notes: Sequence[str] = ()


def selected(table: Table, names: Sequence[str]) -> Table:
    """Return the first column of a table, then those with some headings; the unit of a heading is left out in its name.

    Raises:
        UnknownColumnError: There is no such column.
    """
    known = {heading.partition(",")[0]: k for k, heading in enumerate(table.headings)}
    if unknown := [name for name in names if name not in known]:
        raise UnknownColumnError(f"no column {unknown[0]!r}; {hint(unknown[0], list(known)[1:])}")
    places = [0, *(known[name] for name in names)]
    rows = [[row[k] for k in places] for row in table.rows]
    return Table([table.headings[k] for k in places], rows, table.notes)


def markdown(table: Table) -> str:
    """Format a table in Markdown; its notes are lines below it."""
    lines = [f"| {' | '.join(cells)} |" for cells in table.rows]
    head = [f"| {' | '.join(table.headings)} |", "|---" * len(table.headings) + "|"]
    return "\n".join([*head, *lines, "", *table.notes]) + "\n"


def comma_separated(table: Table) -> str:
    """Format a table as CSV (RFC 4180) without its notes."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerows([_CODE.sub(r"\1", cell) for cell in cells] for cells in (table.headings, *table.rows))
    return text.getvalue()


def latex(table: Table) -> str:
    """Format a table as a LaTeX tabular with the rules of booktabs; its notes are comments."""
    head, *rows = [" & ".join(map(_in_latex, cells)) + r" \\" for cells in (table.headings, *table.rows)]
    columns = "l" + "r" * (len(table.headings) - 1)
    return (
        "\n".join(
            [
                r"% \usepackage{booktabs}",
                *(f"% {note}" for note in table.notes),
                rf"\begin{{tabular}}{{{columns}}}",
                r"\toprule",
                head,
                r"\midrule",
                *rows,
                r"\bottomrule",
                r"\end{tabular}",
            ]
        )
        + "\n"
    )


def _in_latex(cell: str) -> str:
    """Return a cell with LaTeX's special characters escaped."""
    plain_and_code = _CODE.split(cell)  # every second part is code
    escaped = ["".join(_LATEX.get(character, character) for character in part) for part in plain_and_code]
    return "".join(rf"\texttt{{{part}}}" if k % 2 else part for k, part in enumerate(escaped))


FORMATS: Mapping[str, Callable[[Table], str]] = {"markdown": markdown, "csv": comma_separated, "latex": latex}
